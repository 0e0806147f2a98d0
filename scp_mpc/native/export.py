"""The native core with one problem's constants, as a CMake package: for robots without Python.

Numbers are written in the shortest decimals that read back as the same bits. The steps that it is
tested by are made by the core here, so that its own replay of them says whether they agree.
"""

import re
from importlib.metadata import version
from pathlib import Path
from textwrap import indent, wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from scp_mpc.errors import InvalidArgumentError
from scp_mpc.models.generated import generated
from scp_mpc.models.model import Model
from scp_mpc.obstacles.polytope import Polytope
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings

if TYPE_CHECKING:
    from scp_mpc.native.core import NativeCore

_HERE = Path(__file__).parent
_NOT_EXPORTED = {"machine_clock.c"}
_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_STEPS = 12


def export(
    problem: Problem,
    settings: Settings,
    folder: str | Path,
    name: str = "robot",
    *,
    polytopes: bool = True,
) -> Path:
    """Write a controller in C99 for one problem; it needs nothing but the mathematical library.

    The folder gets the core's sources, the problem's and the settings' numbers in
    `src/<name>.c`, an example `main.c`, CMake files of a package that `find_package(<name> CONFIG)`
    finds, and a dozen control steps in `vectors/` with a program that replays them. A
    `CasadiModel` and quadrotors bring along the C that CasADi generates.

    Args:
        problem: What to solve.
        settings: How to solve it; `solver`, `qp`, `history` and `staleness` have no meaning there.
        folder: Made if it is not there; files of the same names are replaced.
        name: Of the package, its library and its functions: small letters, digits, underscores.
        polytopes: Make room for obstacles that are polytopes, of up to 16 corners and 16 faces.
            Where all are round, less memory will do.

    Returns:
        The folder.

    Raises:
        InvalidArgumentError: The model is written in Python, or the name is none.
        MissingCoreError: The native core, which makes those steps, is not there.
        MissingExtraError: The model needs CasADi, which is not installed.
    """
    from scp_mpc.native.constants import constants
    from scp_mpc.native.core import NativeCore
    from scp_mpc.native.library import OWN_MODEL

    if not _NAME.fullmatch(name):
        raise InvalidArgumentError("name", f"{name!r} is no name in small letters")
    deadline = settings.time_limit(problem.model.dt)
    values = constants(problem, settings, deadline)
    if not polytopes:
        values |= dict.fromkeys(("max_shapes", "max_corners", "max_faces", "max_edges"), 0)
    box = Polytope.box(np.full(problem.model.dim, 0.5)) if polytopes else None
    own = values["model"] == OWN_MODEL
    model = _model(problem.model, name) if own else ""
    core = NativeCore(problem, settings, room=[box])
    words = {
        "name": name,
        "NAME": name.upper(),
        "version": version("scp-mpc"),
        "what": f"{type(problem.model).__name__}, N = {problem.horizon}, "
        f"M = {problem.max_obstacles} obstacles at most",
        "deadline": "no deadline" if deadline is None else f"{deadline:g} s",
        "steps": str(_STEPS),
    }
    files = {
        f"include/{name}.h": _HEADER.format(**words, bytes=core.bytes),
        f"src/{name}.c": _constants(values, name, own),
        **({f"src/{name}_model.c": model} if own else {}),
        **{f"src/{p.name}": p.read_text("utf-8") for p in sorted(_HERE.glob("*.[ch]"))},
        "include/scp_mpc.h": (_HERE / "scp_mpc.h").read_text("utf-8"),
        "vectors/vectors.h": _VECTORS,
        "vectors/vectors.c": _steps(problem, core, box),
        "vectors/replay.c": _template("replay.c", words),
        **{f: _template(f, words) for f in ("main.c", "README.md", "Config.cmake.in")},
    }
    for absent in ("scp_mpc.h", *_NOT_EXPORTED):
        del files[f"src/{absent}"]
    sources = "\n".join(f for f in files if f.startswith("src/") and f.endswith(".c"))
    words["sources"] = indent(sources, "  ")
    files["CMakeLists.txt"] = _template("CMakeLists.txt", words)
    root = Path(folder)
    for file, text in files.items():
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text(text, encoding="utf-8")
    return root


_HEADER = """\
/* A controller of scp_mpc {version}: {what}. */
#ifndef {NAME}_H
#define {NAME}_H

#include "scp_mpc.h"

#ifdef __cplusplus
extern "C" {{
#endif

/* What scp_size says where pointers have 64 bits; there is no more to it where they are shorter. */
enum {{ {NAME}_BYTES = {bytes} }};

/* Fills in everything but the clock. */
SCP_API void {name}_problem(scp_problem *problem);

#ifdef __cplusplus
}}
#endif
#endif
"""

_VECTORS = f"""\
/* Control steps, one after the other: what came in, and what came out. */
#ifndef VECTORS_H
#define VECTORS_H

typedef struct {{
    int count;
    const double *x0, *x_ref, *means, *covariances, *radii;
    const int *shape;
    int status;
    double cost;
    const double *states, *inputs, *s;
}} vector;

typedef struct {{
    int corners, faces, edges; /* none: there is no box */
    const double *corner, *normal, *offset;
    const int *edge;
}} polytope;

enum {{ STEPS = {_STEPS} }};

extern const vector vectors[STEPS];
extern const polytope box;

#endif
"""


def _template(file: str, words: dict[str, str]) -> str:
    text = (_HERE / "templates" / file).read_text("utf-8")
    for word, value in words.items():
        text = text.replace(f"@{word}@", value)
    return text


def _number(value: Any) -> str:
    """In C, the same bits."""
    if isinstance(value, int | np.integer):
        return str(value)
    return repr(float(value)).replace("inf", "INFINITY").replace("nan", "NAN")


def _numbers(values: Any) -> str:
    return ", ".join(map(_number, np.ravel(values)))


def _array(name: str, values: Any) -> str:
    """A C array; nothing for an empty one."""
    values = np.asarray(values)
    kind = {"f": "double", "i": "int", "u": "uint8_t"}[values.dtype.kind]
    lines = "\n".join(wrap(_numbers(values), 95))
    body = f"\n{indent(lines, '    ')}\n" if "\n" in lines else lines
    return f"static const {kind} {name}[] = {{{body}}};\n"


def _constants(values: dict[str, Any], name: str, own: bool) -> str:
    """The C file of `<name>_problem`."""
    arrays = {k: v for k, v in values.items() if isinstance(v, np.ndarray) and v.size}
    numbers = {k: _number(v) for k, v in values.items() if not isinstance(v, np.ndarray)}
    members = numbers | {k: k for k in arrays} | ({"own": f"{name}_dynamics"} if own else {})
    return "".join(
        [
            f'#include <math.h>\n#include <string.h>\n\n#include "{name}.h"\n\n',
            f"extern const scp_dynamics {name}_dynamics;\n\n" if own else "",
            *(_array(k, v) for k, v in arrays.items()),
            f"\nvoid {name}_problem(scp_problem *problem)\n{{\n",
            "    memset(problem, 0, sizeof *problem);\n",
            *(f"    problem->{k} = {v};\n" for k, v in members.items()),
            "}\n",
        ]
    )


def _model(model: Model, name: str) -> str:
    """The C file of the robot's own dynamics."""
    code = generated(model, name)
    arguments, results, integers, reals = code.work
    words = {
        "name": name,
        "nx": str(model.nx),
        "nu": str(model.nu),
        "d": str(model.dim),
        "position": _numbers(model.position),
        "rest": _numbers(model.equilibrium_input),
        "arguments": str(max(arguments, 3)),
        "results": str(max(results, 3)),
        "integers": str(max(integers, 1)),
        "reals": str(max(reals, 1)),
    }
    stop = "stop_as_given.c" if code.stops else "stop_by_least_squares.c"
    parts = [_template(file, words) for file in ("model.c", stop)]
    table = "advance, linearise, curvature, stopping_input"
    last = f"\nconst scp_dynamics {name}_dynamics = {{NULL, {table}}};\n"
    return "".join([code.source, *parts, last])


def _steps(problem: Problem, core: "NativeCore", box: Polytope | None) -> str:
    """The C file of control steps past made-up obstacles, and what the core makes of them."""
    model, N, views = problem.model, problem.horizon, core.views
    J, rng = min(problem.max_obstacles, 4), np.random.default_rng(0)
    box = box if J > 1 else None
    ahead, aside = np.eye(model.dim)[:2]
    core.inputs.count = J
    core.set_shapes([box if j == 1 else None for j in range(J)])
    views["radii"][:J] = 0.2
    grown = 0.02 + 0.001 * np.arange(N + 1)
    views["covariances"][:J] = np.multiply.outer(grown, np.diag(1.0 + aside))
    pace = min(1.0, problem.speed_max or 1.0)
    x = model.state(np.zeros(model.dim), np.zeros(model.dim))
    parts, table = [], []
    for step in range(_STEPS):
        times = model.dt * (step + np.arange(N + 1))
        way = np.outer(pace * times, ahead)
        views["x0"][:] = x = np.clip(x, problem.x_min, problem.x_max)
        views["x_ref"][:] = model.state(way, np.broadcast_to(pace * ahead, way.shape))
        for j in range(J):  # each is in the way when the robot is to come by
            meeting = 1.5 * (j + 1) * (1 + problem.robot_radius)
            across = 0.1 + (-1) ** j * 0.6 * (times - meeting / pace)
            views["means"][j] = meeting * ahead + np.outer(across, aside)
        wrong = core.step()
        if wrong is not None:
            raise InvalidArgumentError(wrong, f"is refused by the native core in test step {step}")
        given = {k: views[k] for k in ("x0", "x_ref")}
        given |= {k: views[k][:J] for k in ("means", "covariances", "radii", "shape")}
        shapes = {"states": (N + 1, model.nx), "inputs": (N, model.nu), "s": (J,)}
        plan, view = core.outputs.plan, np.ctypeslib.as_array
        found = {k: view(getattr(plan, k), shape) for k, shape in shapes.items()}
        both = given | found
        parts += [_array(f"{k}_{step}", v) for k, v in both.items() if v.size]
        names = [f"{k}_{step}" if v.size else "NULL" for k, v in both.items()]
        came, out = ", ".join(names[: len(given)]), ", ".join(names[len(given) :])
        cost = _number(core.outputs.cost)
        table.append(f"    {{{J}, {came}, {core.outputs.status}, {cost}, {out}}},\n")
        x = model.step(x, found["inputs"][0]) + 0.01 * rng.normal(size=model.nx)
    return "".join(
        [
            '#include <math.h>\n#include <stddef.h>\n\n#include "vectors.h"\n\n',
            *parts,
            f"\nconst vector vectors[STEPS] = {{\n{''.join(table)}}};\n",
            _solid(box),
        ]
    )


def _solid(box: Polytope | None) -> str:
    """The one polytope among those obstacles."""
    if box is None:
        return "\nconst polytope box = {0};\n"
    arrays = {"corner": box.vertices, "normal": box.normals, "offset": box.offsets}
    parts = [_array(k, v) for k, v in arrays.items()] + [_array("edge", box.edges)]
    sizes = _numbers([len(box.vertices), len(box.normals), len(box.edges)])
    return "".join(
        ["\n", *parts, f"const polytope box = {{{sizes}, {', '.join(arrays)}, edge}};\n"]
    )
