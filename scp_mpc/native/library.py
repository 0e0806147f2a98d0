"""The native core's library: found, loaded, and the structs of `scp_mpc.h` mirrored for ctypes.

The header says what each member means. Whoever changes one changes the other: a test compares them.
"""

import ctypes
from ctypes import POINTER, c_double, c_int, c_size_t, c_uint8, c_void_p
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from scp_mpc.errors import MissingCoreError

VERSION = 1
MOST_CANDIDATES = 34
LINEAR, UNICYCLE, BICYCLE, OWN_MODEL = range(4)
EXACT, AXES = range(2)

_FOLDER = Path(__file__).parent
_doubles, _ints, _bytes = POINTER(c_double), POINTER(c_int), POINTER(c_uint8)

Advance = ctypes.CFUNCTYPE(c_int, c_void_p, c_int, c_void_p, c_void_p, c_double, c_void_p)
Linearise = ctypes.CFUNCTYPE(
    *(c_int, c_void_p, c_int, c_void_p, c_void_p, c_double, c_void_p, c_void_p, c_void_p)
)
Curvature = ctypes.CFUNCTYPE(
    *(c_int, c_void_p, c_int, c_void_p, c_void_p, c_void_p, c_double, c_void_p)
)
StoppingInput = ctypes.CFUNCTYPE(c_int, c_void_p, c_void_p, c_void_p)
Clock = ctypes.CFUNCTYPE(c_double, c_void_p)

Members = list[tuple[str, Any]]


def _all(kind: Any, names: str) -> Members:
    return [(name, kind) for name in names.split()]


class Dynamics(ctypes.Structure):
    """`scp_dynamics`."""

    _fields_: ClassVar[Members] = [
        ("context", c_void_p),
        ("advance", Advance),
        ("linearise", Linearise),
        ("curvature", Curvature),
        ("stopping_input", StoppingInput),
    ]


class ProblemStruct(ctypes.Structure):
    """`scp_problem`."""

    _fields_: ClassVar[Members] = [
        *_all(c_int, "version model horizon nx nu dim max_obstacles instants discs"),
        ("dt", c_double),
        ("position", _ints),
        ("heading", c_int),
        ("velocity", _ints),
        ("velocities", c_int),
        *_all(_doubles, "A B stopping between_x between_u bend_x bend_u"),
        *_all(c_double, "most_deviation wheelbase rear"),
        ("substeps", c_int),
        ("own", Dynamics),
        *_all(_doubles, "Q R Qf rest moving u_min u_max"),
        ("limits_rates", c_int),
        *_all(_doubles, "du_min du_max"),
        ("rows", c_int),
        *_all(_doubles, "row row_min row_max"),
        ("row_soft", _bytes),
        ("robot_radius", c_double),
        ("disc", _doubles),
        ("inflation", c_int),
        *_all(c_double, "s_ref s_min s_max s_weight"),
        *_all(_doubles, "sizes backup_sizes"),
        *_all(c_double, "joint_risk growth_time slack_weight state_slack_weight"),
        *_all(c_int, "max_shapes max_corners max_faces max_edges"),
        ("tolerance", c_double),
        *_all(c_int, "max_iterations max_candidates max_programs max_replayed"),
        *_all(c_int, "multi_start multi_start_interval"),
        ("deadline", c_double),
        ("clock", Clock),
        ("clock_context", c_void_p),
    ]


class Inputs(ctypes.Structure):
    """`scp_inputs`."""

    _fields_: ClassVar[Members] = [
        *_all(_doubles, "x0 x_ref u_last"),
        *_all(c_int, "has_u_last count"),
        *_all(_doubles, "means covariances radii"),
        ("shape", _ints),
        ("shapes", c_int),
        *_all(_ints, "corners faces edges"),
        *_all(_doubles, "corner normal offset"),
        ("edge", _ints),
        ("robot_covariance", _doubles),
        *_all(c_int, "has_robot_covariance multi_start brake_first"),
    ]


class IterateStruct(ctypes.Structure):
    """`scp_iterate`."""

    _fields_: ClassVar[Members] = [
        *_all(_doubles, "states inputs s slack"),
        ("has_multipliers", c_int),
        *_all(_doubles, "dynamics input_bounds margin obstacles pins state_bounds rates"),
    ]


class CandidateStruct(ctypes.Structure):
    """`scp_candidate`."""

    _fields_: ClassVar[Members] = [
        ("obstacle", c_int),
        ("side", c_double * 3),
        *_all(c_double, "time merit"),
    ]


class Outputs(ctypes.Structure):
    """`scp_outputs`."""

    _fields_: ClassVar[Members] = [
        *_all(c_int, "status iterations"),
        *_all(c_double, "cost merit stationarity feasibility complementarity curvature"),
        *_all(c_int, "kkt solved ranked cut infeasible switched candidates"),
        ("candidate", CandidateStruct * MOST_CANDIDATES),
        *_all(IterateStruct, "plan obstacle_free"),
        *_all(c_int, "has_obstacle_free contact"),
        ("seconds", c_double),
        ("u0", _doubles),
        ("replayed", c_int),
    ]


_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "scp_check": (c_int, [POINTER(ProblemStruct)]),
    "scp_name": (ctypes.c_char_p, [c_int]),
    "scp_size": (c_size_t, [POINTER(ProblemStruct)]),
    "scp_setup": (c_void_p, [POINTER(ProblemStruct), c_void_p, c_size_t]),
    "scp_in": (POINTER(Inputs), [c_void_p]),
    "scp_out": (POINTER(Outputs), [c_void_p]),
    "scp_guess": (POINTER(IterateStruct), [c_void_p]),
    "scp_guess_free": (POINTER(IterateStruct), [c_void_p]),
    "scp_solve": (c_int, [c_void_p, c_int]),
    "scp_input_name": (ctypes.c_char_p, [c_int]),
    "scp_step": (c_int, [c_void_p]),
    "scp_reset": (None, [c_void_p]),
    "scp_brake": (c_int, [c_void_p]),
    "scp_backup": (c_int, [c_void_p, POINTER(_doubles)]),
    "scp_memory_size": (c_size_t, [c_void_p]),
    "scp_remember": (None, [c_void_p, c_void_p]),
    "scp_recall": (None, [c_void_p, c_void_p]),
}


@cache
def library() -> ctypes.CDLL:
    """The loaded library, its functions typed.

    Raises:
        MissingCoreError: It was not built or cannot be loaded; says why, and how to get it.
    """
    return loaded(_FOLDER)


def loaded(folder: Path) -> ctypes.CDLL:
    """The library in a folder; see `library`."""
    path, reason = folder / "_core.so", folder / "not_built.txt"
    if not path.exists():
        why = f"{path} is not there"
        raise MissingCoreError(reason.read_text("utf-8").strip() if reason.exists() else why)
    try:
        core = ctypes.CDLL(str(path))
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(core, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise MissingCoreError(str(error)) from None
    return core
