"""The native core at work: a problem laid out in one block of memory, and views of what is in it.

    write what a step brings into the views of the inputs
    one call                                        the GIL is free meanwhile
    take what came out: one copy of numbers, unpacked when they are asked for

Notation as in `scp_mpc.h`.
"""

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from scp_mpc.arrays import FloatArray, frozen
from scp_mpc.deadline import Timer
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.models.model import Model
from scp_mpc.native.constants import constants
from scp_mpc.native.library import (
    OWN_MODEL,
    Advance,
    Clock,
    Curvature,
    IterateStruct,
    Linearise,
    Outputs,
    ProblemStruct,
    StoppingInput,
    library,
)
from scp_mpc.obstacles.solid import Solid
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings

_ALIGNED = 64  # bytes
_PLANS = ("plan", "obstacle_free")  # of the outputs
_PARTS = ("corners", "vertices"), ("faces", "normals"), ("edges", "edges")  # of a `Solid`


@dataclass(frozen=True, eq=False)
class IterateLayout:
    """Where the arrays of a `scp_iterate` are, in doubles from the first of them.

    Attributes:
        places: Where each begins and ends, and its shape, by name.
        size: To the end of the last one.
    """

    places: dict[str, tuple[int, int, tuple[int, ...]]]
    size: int

    @classmethod
    def of(cls, struct: IterateStruct, shapes: dict[str, tuple[int, ...]]) -> "IterateLayout":
        """Read the addresses: the states come first."""
        first, places = _address(struct.states), {}
        for name, shape in shapes.items():
            size = prod(shape)
            at = (_address(getattr(struct, name)) - first) // 8 if size else 0
            places[name] = at, at + size, shape
        assert min(at for at, _, _ in places.values()) == 0
        return cls(places, max(end for _, end, _ in places.values()))


class Outcome(NamedTuple):
    """What a step of the core came to, copied out of it.

    Attributes:
        raw: The struct `scp_outputs`.
        plan: Numbers of the plan.
        obstacle_free: Those of the plan that ignores the obstacles; None where it is the same.
        layout: Where in them is what.
    """

    raw: bytes
    plan: FloatArray
    obstacle_free: FloatArray | None
    layout: IterateLayout

    @property
    def outputs(self) -> Outputs:
        """The struct; its pointers lead nowhere."""
        return Outputs.from_buffer_copy(self.raw)

    def part(self, numbers: FloatArray, name: str) -> FloatArray:
        """One of the arrays within all of the numbers of a plan."""
        at, end, shape = self.layout.places[name]
        return numbers[at:end].reshape(shape)

    def iterate(self, which: str) -> tuple[bool, dict[str, FloatArray]]:
        """Whether the "plan" or the "obstacle_free" one has multipliers; its arrays by name."""
        numbers: FloatArray = getattr(self, which)
        has = bool(getattr(self.outputs, which).has_multipliers)
        return has, {name: self.part(numbers, name) for name in self.layout.places}


class NativeCore:
    """One problem and its settings, laid out once.

    Args:
        problem: What to solve.
        settings: How to solve it.
        deadline: Of a step [s]; None for none.
        timer: Tells the time [s] to deadlines; None for the machine's clock.
        room: Shapes of obstacles for which there has to be room.

    Attributes:
        inputs: The struct of a step's inputs.
        views: Its arrays by name, to be written into.
        outputs: The struct of what came out.
        bytes: How large it is.

    Raises:
        MissingCoreError: There is no library.
        InvalidArgumentError: The core refuses the problem; says which number of it.
    """

    def __init__(
        self,
        problem: Problem,
        settings: Settings,
        deadline: float | None = None,
        timer: Timer | None = None,
        room: Sequence[Solid | None] = (),
    ) -> None:
        """Hand the numbers over and lay everything out."""
        self._call = library()
        self._error: BaseException | None = None
        values = constants(problem, settings, deadline)
        solids = [solid for solid in room if solid is not None]
        for name, part in _PARTS:  # room for shapes is made when the first ones come
            largest = max((len(getattr(solid, part)) for solid in solids), default=0)
            values[f"max_{name}"] = max(largest, values[f"max_{name}"]) if solids else 0
        values["max_shapes"] *= bool(solids)
        struct, self._kept = _filled(values)
        self._calls_back = values["model"] == OWN_MODEL or timer is not None
        if values["model"] == OWN_MODEL:
            self._bind(struct, problem.model)
        if deadline is not None:
            struct.clock = self._clock(timer)
            self._kept.append(struct.clock)
        wrong = self._call.scp_check(struct)
        if wrong:
            name = self._call.scp_name(wrong).decode()
            raise InvalidArgumentError(name, "is refused by the native core")
        size = self._call.scp_size(struct)
        self._block = np.zeros(size + _ALIGNED, dtype=np.uint8)
        begin = self._block.ctypes.data
        self._core = self._call.scp_setup(struct, begin + -begin % _ALIGNED, size)
        self._raise()
        if not self._core:
            raise InvalidArgumentError("problem", f"cannot be set up in {size} bytes")
        self.bytes = size
        self._look(problem, values)

    def _look(self, problem: Problem, values: dict[str, Any]) -> None:
        """Make the views."""
        model, N, M = problem.model, problem.horizon, problem.max_obstacles
        d, nb = model.dim, len(problem.state_rows)
        C = N * problem.nodes_per_interval * len(problem.discs)
        P, V, F, E = (values[f"max_{name}"] for name in ("shapes", "corners", "faces", "edges"))
        self.inputs = self._call.scp_in(self._core).contents
        self.outputs = self._call.scp_out(self._core).contents
        self._at_outputs = ctypes.addressof(self.outputs)
        shapes: dict[str, tuple[int, ...]] = {
            "x0": (model.nx,),
            "x_ref": (N + 1, model.nx),
            "u_last": (model.nu,),
            "means": (M, N + 1, d),
            "covariances": (M, N + 1, d, d),
            "radii": (M,),
            "shape": (M,),
            **dict.fromkeys(("corners", "faces", "edges"), (P,)),
            "corner": (P, V, d),
            "normal": (P, F, d),
            "offset": (P, F),
            "edge": (P, E, 2),
            "robot_covariance": (N + 1, d, d),
        }
        self.views = {name: _view(self.inputs, name, shape) for name, shape in shapes.items()}
        iterate: dict[str, tuple[int, ...]] = {
            "states": (N + 1, model.nx),
            "inputs": (N, model.nu),
            "s": (M,),
            "slack": (M, C),
            "dynamics": (N, model.nx),
            "input_bounds": (N, model.nu),
            "margin": (M,),
            "obstacles": (M, C),
            "pins": (M, C),
            "state_bounds": (N, nb),
            "rates": (N, model.nu),
        }
        calls = self._call.scp_guess, self._call.scp_guess_free
        self._guesses = [call(self._core).contents for call in calls]
        self._guess_views = [
            {name: _view(struct, name, shape) for name, shape in iterate.items()}
            for struct in self._guesses
        ]
        self._layout = IterateLayout.of(self.outputs.plan, iterate)
        words = np.frombuffer(self.outputs, dtype=np.uintp)
        self._plans = [words[getattr(Outputs, n).offset // 8 :][:1] for n in _PLANS]
        self._numbers: dict[int, FloatArray] = {}
        self._room = {"corners": V, "faces": F, "edges": E}
        self._solids: list[Solid] = []

    def guess(self, which: int, has_multipliers: bool) -> dict[str, NDArray[Any]]:
        """Arrays by name to write where to start from: 0 the plan, 1 the obstacle-free one."""
        self._guesses[which].has_multipliers = has_multipliers
        return self._guess_views[which]

    def has_room(self, shapes: Sequence[Solid | None]) -> bool:
        """Whether these shapes of obstacles fit in."""
        solids = [solid for solid in shapes if solid is not None]
        return all(len(getattr(s, part)) <= self._room[n] for n, part in _PARTS for s in solids)

    def set_shapes(self, shapes: Sequence[Solid | None] | None) -> None:
        """Say which obstacles are polytopes, and write them if any is new; None: all are round."""
        if shapes is None:
            if self._solids:
                self._solids, self.inputs.shapes, self.views["shape"][:] = [], 0, -1
            return
        solids = list({id(s): s for s in shapes if s is not None}.values())
        number = {id(solid): k for k, solid in enumerate(self._solids)}
        if any(id(solid) not in number for solid in solids):
            self._solids = solids
            number = {id(solid): k for k, solid in enumerate(solids)}
            for k, solid in enumerate(solids):
                self._write(k, solid)
        self.inputs.shapes = len(self._solids)
        self.views["shape"][: len(shapes)] = [-1 if s is None else number[id(s)] for s in shapes]

    def _write(self, k: int, solid: Solid) -> None:
        for name, part in _PARTS:
            self.views[name][k] = len(getattr(solid, part))
        for name, values in (
            ("corner", solid.vertices),
            ("normal", solid.normals),
            ("offset", solid.offsets),
            ("edge", solid.edges),
        ):
            self.views[name][k, : len(values)] = values

    def solve(self, guesses: int, multi_start: bool, brake_first: bool) -> str | None:
        """Solve one step; return the name of an input that is refused, None if none is.

        Args:
            guesses: How many of `guess` and `guess_free` have been written.
            multi_start: Whether to look for other ways past the obstacles.
            brake_first: Whether braking comes before the last plan.
        """
        self.inputs.multi_start, self.inputs.brake_first = multi_start, brake_first
        return self._done(self._call.scp_solve(self._core, guesses))

    def step(self) -> str | None:
        """`solve` with memory: from the last plan, with its backup."""
        return self._remembered(self._call.scp_step)

    def reset(self) -> None:
        """Forget the steps before."""
        self._call.scp_reset(self._core)

    def brake(self) -> str | None:
        """A step without predictions, with memory, too."""
        return self._remembered(self._call.scp_brake)

    def _remembered(self, call: Callable[[int], int]) -> str | None:
        """Where the caller's own code raises meanwhile, nothing of the step is remembered."""
        before = self.memory if self._calls_back else None
        wrong = call(self._core)
        if self._error is not None and before is not None:
            self.memory = before
        return self._done(wrong)

    def outcome(self) -> Outcome:
        """Copy what came out."""
        plan = self._copied(self._plans[0])
        free = self._copied(self._plans[1]) if self.outputs.has_obstacle_free else None
        raw = ctypes.string_at(self._at_outputs, ctypes.sizeof(Outputs))
        return Outcome(raw, plan, free, self._layout)

    def _copied(self, pointer: NDArray[np.uintp]) -> FloatArray:
        """Numbers of an iterate of the core's, which come and go among a few places."""
        address = int(pointer[0])
        if address not in self._numbers:
            self._numbers[address] = _numbers(address, self._layout.size)
        return frozen(self._numbers[address].copy())

    def backup(self) -> FloatArray | None:
        """Inputs (k, nu) that are left of the last step's backup; None for no backup."""
        nu, pointer = self.views["u_last"].shape[0], ctypes.POINTER(ctypes.c_double)()
        steps = self._call.scp_backup(self._core, pointer)
        if steps < 0:
            return None
        return _numbers(_address(pointer), steps * nu).reshape(steps, nu).copy()

    @property
    def memory(self) -> FloatArray:
        """What is remembered of the steps before, for another core of the same problem."""
        numbers = np.empty(self._call.scp_memory_size(self._core))
        self._call.scp_remember(self._core, numbers.ctypes.data)
        return numbers

    @memory.setter
    def memory(self, numbers: FloatArray) -> None:
        if numbers.shape != (self._call.scp_memory_size(self._core),):
            raise InvalidArgumentError("memory", f"shape {numbers.shape} is of another problem")
        numbers = np.ascontiguousarray(numbers)
        self._call.scp_recall(self._core, numbers.ctypes.data)

    def _done(self, wrong: int) -> str | None:
        self._raise()
        return self._call.scp_input_name(wrong).decode() if wrong else None

    def _raise(self) -> None:
        """Go on with what went wrong in Python while the core asked for it."""
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _guarded(self, function: Callable[..., None]) -> Callable[..., int]:
        """A callback that keeps what is raised, and says that there is no value.

        Where a model has no value, as at a singular point, the core goes on without one.
        """

        def call(*arguments: Any) -> int:
            try:
                function(*arguments)
            except (ArithmeticError, np.linalg.LinAlgError, InvalidArgumentError):
                return 1
            except BaseException as error:  # nothing may pass through the core
                self._error = self._error or error
                return 1
            return 0

        return call

    def _bind(self, struct: ProblemStruct, model: Model) -> None:
        """Let the core ask a model of Python's."""
        nx, nu = model.nx, model.nu
        n = nx + nu

        def points(count: int, x: int, u: int) -> tuple[FloatArray, FloatArray]:
            # Copies: what a user's function does with them is its own business.
            return _at(x, count, nx).copy(), _at(u, count, nu).copy()

        def advance(_: Any, count: int, x: int, u: int, share: float, after: int) -> None:
            states, inputs = points(count, x, u)
            if count == 1 and share == 1.0:
                _at(after, nx)[:] = model.step(states[0], inputs[0])
            else:
                _at(after, count, nx)[:] = model.advance(states, inputs, share)

        def linearise(
            _: Any, count: int, x: int, u: int, share: float, after: int, A: int, B: int
        ) -> None:
            there = model.linearise(*points(count, x, u), share)
            _at(after, count, nx)[:] = there.after
            _at(A, count, nx, nx)[:] = there.A
            _at(B, count, nx, nu)[:] = there.B

        def curvature(
            _: Any, count: int, x: int, u: int, costates: int, share: float, bent: int
        ) -> None:
            weights = _at(costates, count, nx).copy()
            found = model.curvature(*points(count, x, u), weights, share)
            _at(bent, count, n, n)[:] = found

        def stopping_input(_: Any, x: int, u: int) -> None:
            _at(u, nu)[:] = model.stopping_input(_at(x, nx).copy())

        struct.own.advance = Advance(self._guarded(advance))
        struct.own.linearise = Linearise(self._guarded(linearise))
        struct.own.curvature = Curvature(self._guarded(curvature))
        struct.own.stopping_input = StoppingInput(self._guarded(stopping_input))
        self._kept.append(struct.own)

    def _clock(self, timer: Timer | None) -> Any:
        if timer is None:
            return ctypes.cast(self._call.scp_machine_clock, Clock)

        def now(_: Any) -> float:
            try:
                return timer()
            except BaseException as error:
                self._error = self._error or error
                return np.inf

        return Clock(now)


def _filled(values: dict[str, Any]) -> tuple[ProblemStruct, list[Any]]:
    """The struct, and what has to stay as long as it is used."""
    struct, kept = ProblemStruct(), list[Any]()
    for name, kind in ProblemStruct._fields_:
        value = values.get(name)
        if isinstance(value, np.ndarray):
            value = np.ascontiguousarray(value)
            kept.append(value)
            value = value.ctypes.data_as(kind)
        if value is not None:
            setattr(struct, name, value)
    return struct, kept


def _address(pointer: Any) -> int:
    return ctypes.cast(pointer, ctypes.c_void_p).value or 0


def _view(struct: Any, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """The array that a member points to."""
    pointer = getattr(struct, name)
    kind: DTypeLike = np.float64 if pointer._type_ is ctypes.c_double else np.intc
    if not np.prod(shape):
        return np.zeros(shape, kind)
    return np.ctypeslib.as_array(pointer, shape)


def _numbers(address: int, count: int) -> FloatArray:
    buffer: Any = (ctypes.c_double * count).from_address(address)
    return np.frombuffer(buffer)


def _at(address: int, *shape: int) -> FloatArray:
    """The numbers at an address, for the time of a callback."""
    size = 1
    for length in shape:
        size *= length
    return _numbers(address, size).reshape(shape)
