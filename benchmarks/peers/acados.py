"""acados (Verschueren et al., 2022): SQP in generated C with HPIPM, and its real-time iteration.

    python -m benchmarks.peers.acados       installs the wheel, into a folder of its own

The registry's wheel `comma-deps-acados` holds version 0.2.2 and a CasADi of its own, which would
hide the real one: it is put beside the environment's packages, not among them. Where
ACADOS_SOURCE_DIR names a build of acados with its Python interface, that one is taken. A C compiler
is needed. What is written and compiled for a problem is kept.

What acados solves is in `acados_build.py`, what one step does in `acados_step.c`: all of a step is
one call from Python, so that its time is acados's own and not its interface's.
"""

import ctypes
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from importlib.metadata import distributions
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.peers.nlp import require_round
from benchmarks.peers.plan import PeerMissingError, PeerPlan
from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.models.model import Model
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate, as_iterate
from scp_mpc.scp.step import Step
from scp_mpc.trajectory import Trajectory

HOME = Path(sys.prefix) / "acados"
COMMAND = "python -m benchmarks.peers.acados"
_WHEEL = "comma-deps-acados"
_HERE = Path(__file__).resolve().parent
_SOURCES = [_HERE / name for name in ("acados.py", "acados_build.py", "acados_step.c")]
_SOLVED, _LAST = 0, 2  # acados's statuses: converged; the last iteration allowed
_STATUSES = ("solved", "failure", "too many iterations", "step too small", "QP failed")

_RTLD_DI_LMID = 1
_namespace = ctypes.c_long(-1)  # of acados's libraries; -1 asks for a new one

Method = Literal["SQP", "SQP_RTI"]


@dataclass(frozen=True)
class Installation:
    """Where a build of acados is.

    Attributes:
        root: Folder with `lib`, `include` and `bin`.
        interface: Folder that holds the package `acados_template`.
        version: What tables call it.
    """

    root: Path
    interface: Path
    version: str

    @classmethod
    def find(cls, home: Path = HOME) -> "Installation":
        """That of ACADOS_SOURCE_DIR, else the wheel in `home`.

        Raises:
            PeerMissingError: There is neither, or no C compiler.
        """
        source = os.environ.get("ACADOS_SOURCE_DIR")
        root = Path(source) if source else home / "acados" / "install"
        if not (root / "lib").is_dir():
            raise PeerMissingError("acados", f"{root}/lib is not there; {COMMAND} installs a wheel")
        if compiler() is None:
            raise PeerMissingError("acados", "it needs a C compiler: $CC, cc, gcc or clang")
        if source:
            return cls(root, root / "interfaces" / "acados_template", _described(root))
        found = {found.name: found.version for found in distributions(path=[str(home)])}
        version = found.get(_WHEEL, "?").split(".post")[0]
        return cls(root, home / "acados", f"acados {version} wheel")


def install(home: Path = HOME) -> Installation:
    """Install the wheel into `home`, without the CasADi that it brings along.

    Raises:
        PeerMissingError: pip fails.
    """
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--quiet", "--target", str(home)]
    done = subprocess.run([*pip, _WHEEL], capture_output=True, text=True, check=False)
    if done.returncode:
        raise PeerMissingError("acados", f"pip: {done.stderr.strip()[-300:]}")
    shutil.rmtree(home / "casadi", ignore_errors=True)
    return Installation.find(home)


def compiler() -> str | None:
    """A C compiler, or None."""
    names = (os.environ.get("CC", ""), "cc", "gcc", "clang")
    return next((found for found in map(shutil.which, names) if found), None)


class Acados:
    """One of acados's solvers, written and compiled for a problem in the plane.

    Args:
        problem: What to solve.
        method: "SQP", to a residual of 1e-6, or "SQP_RTI", one iteration.
        home: Where the wheel is, and where solvers are kept.

    Attributes:
        version: Which acados it is.

    Raises:
        PeerMissingError: acados is not installed, or does not get along with the compiler.
        InvalidArgumentError: The problem has what acados is not told of here.
    """

    def __init__(self, problem: Problem, method: Method = "SQP", home: Path = HOME) -> None:
        """Compile what is not compiled yet, and set up the solver."""
        _refuse(problem)
        installation = Installation.find(home)
        self.problem, self.version = problem, installation.version
        self._library = _loaded(_compiled(problem, method, installation, home))
        self._library.peer_setup.restype = ctypes.c_void_p
        self._solver = self._library.peer_setup()
        if not self._solver:
            raise PeerMissingError("acados", "its solver cannot be set up")
        self._call = self._library.peer_step
        self._call.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
        self._data = _Data(problem)
        self._began = False

    def __del__(self) -> None:
        """Give back its memory."""
        if getattr(self, "_solver", None):
            self._library.peer_free(ctypes.c_void_p(self._solver))

    def step(
        self,
        x0: FloatArray,
        x_ref: FloatArray,
        means: FloatArray,
        covariances: FloatArray,
        radii: FloatArray,
    ) -> int:
        """Plan from the last plan, shifted; at first from the reference. The leanest way.

        The plan is in `X` (N+1, nx), `U` (N, nu) and `s` (M,) until the next step; where acados
        fails, it is the last one, shifted.

        Args:
            x0: (nx,) state.
            x_ref: (N+1, nx) reference, its heading unwrapped from that of the state.
            means: (J, N+1, 2) expected positions [m].
            covariances: (J, N+1, 2, 2) [m^2].
            radii: (J,) of the obstacles [m].

        Returns:
            acados's status: 0 for solved, 2 for too many iterations, else a failure.
        """
        data = self._data
        if not self._began:
            data.X[:], data.U[:], data.S[:] = x_ref, 0.0, self.problem.size.reference
        data.write(x0, x_ref, means, covariances, radii, self._began)
        self._began = True
        status: int = self._call(self._solver, data.address)
        return status

    @property
    def X(self) -> FloatArray:  # noqa: N802
        """States (N+1, nx) of the plan."""
        return self._data.X

    @property
    def U(self) -> FloatArray:  # noqa: N802
        """Inputs (N, nu) of the plan."""
        return self._data.U

    @property
    def s(self) -> FloatArray:
        """Sizes (M,) of the plan."""
        return self._data.S

    def reset(self) -> None:
        """Forget the last plan, and what HPIPM remembers of it."""
        self._library.peer_reset(ctypes.c_void_p(self._solver))
        self._began = False

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        guess: Trajectory | Iterate,
    ) -> PeerPlan:
        """Plan from the state x0; arguments as for `SCP.solve`."""
        began = perf_counter()
        step = Step.read(self.problem, x0, x_ref, obstacles)
        require_round(step.obstacles)
        start, data = as_iterate(guess, self.problem), self._data
        data.X[:], data.U[:], data.S[:] = start.states, start.inputs, start.s
        told = step.obstacles
        data.write(step.x0, step.x_ref, told.means, told.covariances, told.radii, False)
        status = self._call(self._solver, data.address)
        return PeerPlan.judged(
            self.problem,
            step,
            obstacles,
            (self.X.copy(), self.U.copy(), self.s.copy()),
            seconds=perf_counter() - began,
            ok=status == _SOLVED,
            message=_STATUSES[status] if status < len(_STATUSES) else f"status {status}",
        )


class _Data:
    """`peer_data` of `acados_step.c` over arrays that stay where they are."""

    def __init__(self, problem: Problem) -> None:
        N, M, nx, nu = problem.horizon, problem.max_obstacles, problem.model.nx, problem.model.nu
        self._robot = problem.robot_radius
        self._position = problem.model.position.astype(np.intc)
        self.x0, self.x_ref = np.zeros(nx), np.zeros((N + 1, nx))
        self.means, self.covariances = np.zeros((M, N + 1, 2)), np.zeros((M, N + 1, 2, 2))
        self.radii = np.zeros(M)
        self.X, self.U, self.S = np.zeros((N + 1, nx)), np.zeros((N, nu)), np.zeros(M)
        given = [self.x0, self.x_ref, self.means, self.covariances, self.radii]
        size = problem.size
        self._struct = _Struct(
            *(0, 0, nx, M, self._position.ctypes.data, size.lower, size.upper, size.reference),
            *(array.ctypes.data for array in [*given, self.X, self.U, self.S]),
        )
        self.address = ctypes.addressof(self._struct)

    def write(
        self,
        x0: FloatArray,
        x_ref: FloatArray,
        means: FloatArray,
        covariances: FloatArray,
        radii: FloatArray,
        shift: bool,
    ) -> None:
        count = len(radii)
        self.x0[:], self.x_ref[:] = x0, x_ref
        if count:
            self.means[:count], self.covariances[:count] = means, covariances
            self.radii[:count] = radii + self._robot
        self._struct.obstacles, self._struct.shift = count, shift


class _Struct(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("obstacles", "shift", "nx", "slots")),
        ("position", ctypes.c_void_p),
        *((name, ctypes.c_double) for name in ("s_min", "s_max", "s_ref")),
        *((name, ctypes.c_void_p) for name in ("x0", "x_ref", "means", "covariances", "radii")),
        *((name, ctypes.c_void_p) for name in ("X", "U", "S")),
    )


def _compiled(problem: Problem, method: str, acados: Installation, home: Path) -> Path:
    """The solver's shared library, from the folder where it is kept or made anew."""
    told = _numbers(problem), _numbers(problem.model), method, acados
    digest = sha256(pickle.dumps(told))
    for source in _SOURCES:
        digest.update(source.read_bytes())
    folder = home / "solvers" / digest.hexdigest()[:16]
    library = folder / "peer.so"
    if library.exists():
        return library
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "problem.pickle").write_bytes(pickle.dumps((problem, method)))
    paths = [str(_HERE.parent.parent), str(acados.interface), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {
        "ACADOS_SOURCE_DIR": str(acados.root),
        "ACADOS_PYTHON_INTERFACE_PATH": str(acados.interface / "acados_template"),
        "LD_LIBRARY_PATH": f"{acados.root / 'lib'}:{os.environ.get('LD_LIBRARY_PATH', '')}",
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
    }
    script = [sys.executable, "-m", "benchmarks.peers.acados_build", str(folder)]
    _run(script, folder, environment)
    code, lib = folder / "c_generated_code", acados.root / "lib"
    sources = [path for path in code.rglob("*.c") if "main" not in path.name]
    sources = [path for path in sources if "_sim_" not in path.name]
    header = acados.root / "include" / "acados_c" / "ocp_nlp_interface.h"
    recent = "ocp_nlp_in *in, ocp_nlp_out *out, int stage" in header.read_text(encoding="utf-8")
    names = ("", "acados", "blasfeo/include", "hpipm/include", "acados_c")
    _run(
        [
            *(str(compiler()), "-O2", "-fPIC", "-shared", "-std=c99", "-o", str(library) + ".part"),
            *(["-DPEER_RECENT"] if recent else []),
            *(f"-I{acados.root / 'include' / name}" for name in names),
            *(f"-I{code}", *map(str, sources), str(_HERE / "acados_step.c")),
            *(f"-L{lib}", "-lacados", "-lhpipm", "-lblasfeo", "-lm"),
            # Its own functions, not those of another solver; where those libraries find theirs.
            f"-Wl,-Bsymbolic,--disable-new-dtags,-rpath,{lib}",
        ],
        folder,
        environment,
    )
    return Path(str(library) + ".part").rename(library)


def _loaded(path: Path) -> ctypes.CDLL:
    """The library among libraries of its own, where the system can do that.

    CasADi's solvers bring other builds of HPIPM and BLASFEO along, under the same names: whichever
    comes second would take the other's, and crash.
    """
    own = ctypes.CDLL(None)
    if not hasattr(own, "dlmopen"):
        return ctypes.CDLL(str(path))
    own.dlmopen.restype = ctypes.c_void_p
    own.dlmopen.argtypes = [ctypes.c_long, ctypes.c_char_p, ctypes.c_int]
    own.dlinfo.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p]
    handle = own.dlmopen(_namespace.value, os.fsencode(path), os.RTLD_NOW)
    if not handle or own.dlinfo(handle, _RTLD_DI_LMID, ctypes.byref(_namespace)):
        own.dlerror.restype = ctypes.c_char_p
        raise PeerMissingError("acados", str(own.dlerror()))
    return ctypes.CDLL(str(path), handle=handle)


def _numbers(owner: Any) -> list[object]:
    """What a problem or a model is made of, without what was derived from it meanwhile."""
    values = ((field.name, getattr(owner, field.name)) for field in fields(owner))
    kept = ((name, value) for name, value in values if not isinstance(value, Model))
    return [type(owner).__name__, *kept]


def _run(command: Sequence[str], folder: Path, environment: dict[str, str]) -> None:
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise PeerMissingError("acados", f"{command[0]}: {done.stderr.strip()[-500:]}")


def _described(root: Path) -> str:
    """The version of a build from sources, as git describes it."""
    git = ["git", "-C", str(root), "describe", "--tags", "--always"]
    done = subprocess.run(git, capture_output=True, text=True, check=False)
    return f"acados {done.stdout.strip() or 'of ACADOS_SOURCE_DIR'}"


def _refuse(problem: Problem) -> None:
    """Refuse what acados is not told of.

    Raises:
        InvalidArgumentError: There is some of it.
    """
    plain = {
        "nodes_per_interval": problem.nodes_per_interval == 1,
        "speed_max": problem.speed_max is None,
        "x_soft": not problem.x_soft.any(),
        "du_max": not problem.limits_rates,
        "discs": len(problem.discs) == 1 and not problem.discs.any(),
        "growth_time": problem.growth_time is None,
        "model": problem.model.dim == 2 and not problem.model.equilibrium_input.any(),
    }
    for name, fine in plain.items():
        if not fine:
            value = getattr(problem, name)
            raise InvalidArgumentError(f"problem.{name}", f"{value} is not for this peer")


if __name__ == "__main__":
    print(install().version)
