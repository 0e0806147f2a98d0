"""The floors of the house: a file imports only from its own floor or lower ones."""

import ast
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "scp_mpc"
FLOORS = [
    {"errors", "arrays", "deadline", "provenance", "trajectory"},
    {"models", "obstacles", "settings"},
    {"geometry"},
    {"problem"},
    {"qp", "native"},
    {"scp"},
    {"control", "tracking"},
    {"simulation"},
    {"report"},
    {"cli", "__init__"},
]
FILES = sorted(PACKAGE.rglob("*.py"))
ONLY_IN = {
    "osqp": {"qp/osqp.py"},
    "piqp": {"qp/others.py"},
    "qpsolvers": {"qp/others.py"},
    "casadi": {"models/casadi.py", "models/generated.py"},
    "daqp": set(),
}


def name(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def room(module: str) -> str:
    return module.split("/")[0].removesuffix(".py")


def floor(which: str) -> int:
    return next(i for i, rooms in enumerate(FLOORS) if which in rooms)


def imports(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.append(node.module)
    return found


def within(path: Path) -> list[str]:
    """Modules of the package that a file imports, as paths."""
    found = []
    for module in imports(path):
        if module.split(".")[0] == "scp_mpc":
            parts = module.split(".")[1:] or ["__init__"]
            found.append("/".join(parts))
    return found


def test_every_room_has_a_floor():
    assert {room(name(path)) for path in FILES} <= set().union(*FLOORS)


@pytest.mark.parametrize("path", FILES, ids=name)
def test_imports_only_from_its_own_floor_or_lower_ones(path):
    mine = floor(room(name(path)))
    for module in within(path):
        assert floor(room(module)) <= mine, f"{name(path)} imports {module}"


def test_no_import_goes_in_a_circle():
    """Among files, a package's own __init__ aside."""
    graph = {
        name(path).removesuffix(".py"): set(within(path))
        for path in FILES
        if path.name != "__init__.py"
    }
    done: set[str] = set()

    def visit(node, trail):
        assert node not in trail, " -> ".join([*trail, node])
        if node not in done and node in graph:
            for child in graph[node]:
                visit(child, [*trail, node])
            done.add(node)

    for node in graph:
        visit(node, [])


def test_solvers_are_imported_in_one_file_each():
    for path in FILES:
        for module in imports(path):
            package = module.split(".")[0]
            assert name(path) in ONLY_IN.get(package, {name(path)}), f"{name(path)}: {package}"


def test_the_core_needs_no_extra():
    """typer, rich and tqdm stay in the command line; casadi in the benchmarks and in models."""
    for path in FILES:
        packages = {module.split(".")[0] for module in imports(path)}
        if name(path) != "cli.py":
            assert not packages & {"typer", "rich"}, name(path)
        if room(name(path)) != "cli":
            assert "tqdm" not in packages, name(path)


def test_no_file_is_a_drawer():
    assert not [path for path in FILES if path.stem in ("utils", "helpers", "common", "misc")]


def test_the_package_knows_nothing_of_the_benchmarks():
    for path in FILES:
        assert not [module for module in imports(path) if module.split(".")[0] == "benchmarks"]


def test_benchmarks_examples_and_notebooks_use_no_private_names():
    paths = [*(ROOT / "benchmarks").rglob("*.py"), *(ROOT / "examples").glob("*.py")]
    sources = {path.name: path.read_text() for path in paths}
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        cells = json.loads(path.read_text())["cells"]
        code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
        lines = "\n".join(code).splitlines()
        sources[path.name] = "\n".join(line for line in lines if not line.startswith("%"))
    assert len(sources) >= 2
    for file, source in sources.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "scp_mpc":
                assert not [alias.name for alias in node.names if alias.name.startswith("_")], file


def test_the_library_never_prints():
    for path in FILES:
        calls = [
            node.func.id
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        ]
        assert "print" not in calls, name(path)
