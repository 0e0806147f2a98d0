"""The package installs with a compiler and without one, and says which it did."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
SOURCES = ("hatch_build.py", "pyproject.toml", "README.md", "LICENSE", ".gitignore")
COMPILER = re.compile(r"(.*-)?(cc|gcc|clang|c99|c89|tcc|zig)(-[\d.]+)?$")
WITHOUT = {"PATH": "", "CC": "false", "SCP_MPC_NO_ZIG": "1"}
STEPS = """
import numpy as np
from scp_mpc import *
robot, ones = DoubleIntegrator(dt=0.2), np.ones(4)
problem = Problem(robot, horizon=9, Q=ones, R=ones[:2], u_min=-3, u_max=3, robot_radius=0.1)
for solver in ("osqp", "native"):
    try:
        print(MPC(problem, Settings(solver=solver)).step(0 * ones, ones).status.name)
    except MissingCoreError as error:
        print(error)
"""
needs_compiler = pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler here")


def run(*command, cwd, **environment):
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert not done.returncode, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.fixture
def tree(tmp_path):
    """The sources, with a library in place that is of no use."""
    to = tmp_path / "tree"
    shutil.copytree(ROOT / "scp_mpc", to / "scp_mpc", ignore=shutil.ignore_patterns("*.so"))
    for name in SOURCES:
        shutil.copy(ROOT / name, to / name)
    (to / "scp_mpc" / "native" / "_core.so").write_bytes(b"of another machine")
    os.utime(to / "scp_mpc" / "native" / "_core.so", (0, 0))
    return to


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """A fresh environment that sees what else the package needs, but not the package."""
    home = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", home, cwd=home)
    own = next((home / "lib").glob("python*/site-packages"))
    (own / "others.pth").write_text(f"{Path(np.__file__).parents[1]}\n")
    return home / "bin" / "python"


def wheel_of(source, to, **environment):
    """Build a wheel; its path and its files."""
    pip = sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", to, source
    run(*pip, cwd=to.parent, **environment)
    (wheel,) = to.glob("*.whl")
    return wheel, set(zipfile.ZipFile(wheel).namelist())


def said_by(python, wheel):
    """What comes out of a step of either engine, once the wheel is installed."""
    pip = python, "-m", "pip", "install", "--quiet", "--no-deps", "--force-reinstall", wheel
    run(*pip, cwd=wheel.parent)
    return run(python, "-c", STEPS, cwd=wheel.parent).splitlines()


def sources():
    folder = ROOT / "scp_mpc" / "native"
    return {f"scp_mpc/native/{path.name}" for path in folder.glob("*.[ch]")}


@needs_compiler
def test_with_a_compiler_the_wheel_is_for_the_platform(tree, python, tmp_path):
    wheel, names = wheel_of(tree, tmp_path / "wheels", SCP_MPC_NO_ZIG="1")
    assert re.fullmatch(r"scp_mpc-[\d.]+-py3-none-(linux|macosx|win)\w+\.whl", wheel.name)
    assert "manylinux" not in wheel.name
    assert sources() | {"scp_mpc/native/_core.so"} <= names
    assert "scp_mpc/native/not_built.txt" not in names
    metadata = next(name for name in names if name.endswith(".dist-info/WHEEL"))
    assert "Root-Is-Purelib: false" in zipfile.ZipFile(wheel).read(metadata).decode()
    assert said_by(python, wheel) == ["CONVERGED", "CONVERGED"]


@pytest.mark.parametrize(
    ("environment", "reason"),
    [
        (WITHOUT, r"no C compiler is there .*; zig's was switched off by SCP_MPC_NO_ZIG"),
        (WITHOUT | {"CC": f"{sys.executable} -c 1/0"}, r"-c 1/0 .* failed \(1\): .*; zig's"),
        ({"SCP_MPC_PURE": "1"}, "it was switched off by SCP_MPC_PURE"),
    ],
    ids=["none", "a bad one", "pure"],
)
def test_without_one_the_wheel_is_pure_and_says_why(tree, python, tmp_path, environment, reason):
    wheel, names = wheel_of(tree, tmp_path / "wheels", **environment)
    assert re.fullmatch(r"scp_mpc-[\d.]+-py3-none-any\.whl", wheel.name)
    assert sources() | {"scp_mpc/native/not_built.txt"} <= names
    assert not [name for name in names if name.endswith(".so")]
    default, native = said_by(python, wheel)
    assert default == "CONVERGED"
    assert re.search(f"'native' is not there: .*{reason}.*install a C compiler", native)


@needs_compiler
def test_a_bad_compiler_is_passed_over(tree, tmp_path):
    _, names = wheel_of(tree, tmp_path / "wheels", CC="false")
    assert "scp_mpc/native/_core.so" in names


def test_zigs_compiler_is_found_where_there_is_no_other(tree, python, tmp_path):
    wheel, names = wheel_of(tree, tmp_path / "wheels", PATH="", CC="")
    if "scp_mpc/native/_core.so" not in names:
        why = zipfile.ZipFile(wheel).read("scp_mpc/native/not_built.txt").decode()
        assert "pip" in why
        pytest.skip(f"zig is out of reach: {why}")
    assert said_by(python, wheel) == ["CONVERGED", "CONVERGED"]


@needs_compiler
def test_a_source_distribution_makes_the_same_wheel(tree, tmp_path):
    pip = sys.executable, "-m", "pip", "install", "--quiet", "--target", tmp_path / "hatchling"
    run(*pip, "hatchling>=1.22.5", cwd=tmp_path)
    make = f"from hatchling.build import build_sdist; build_sdist({str(tmp_path)!r})"
    run(sys.executable, "-c", make, cwd=tree, PYTHONPATH=str(tmp_path / "hatchling"))
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        packed = {name.split("/", 1)[1] for name in archive.getnames()}
    assert sources() | {"hatch_build.py"} <= packed
    assert not [name for name in packed if name.endswith(".so")]
    unpacked, plain = (
        wheel_of(source, tmp_path / name) for source, name in ((sdist, "again"), (tree, "wheels"))
    )
    assert unpacked[1] == plain[1]
    assert unpacked[0].name == plain[0].name


@needs_compiler
def test_in_place_it_is_built_where_a_source_is_newer(tree, python):
    native = tree / "scp_mpc" / "native"
    library, reason = native / "_core.so", native / "not_built.txt"

    def install(**environment):
        pip = python, "-m", "pip", "install", "--quiet", "--no-deps", "--editable", tree
        run(*pip, cwd=tree, **environment)
        return library.stat().st_mtime_ns if library.exists() else None

    built = install()
    assert built
    assert run(python, "-c", STEPS, cwd=tree).splitlines() == ["CONVERGED", "CONVERGED"]
    assert install() == built
    source = native / "core.c"
    os.utime(source)
    assert install() > built
    os.utime(source)
    assert install(**WITHOUT) is None  # what is older than its sources is of no use
    assert "no C compiler" in reason.read_text()
    assert "no C compiler" in run(python, "-c", STEPS, cwd=tree)
    assert install()
    assert not reason.exists()


@pytest.mark.parametrize("compiler", [True, False])
def test_both_commands_of_the_readme(tree, tmp_path, compiler):
    """On a machine that has make and Python, and a compiler or none."""
    shutil.copy(ROOT / "Makefile", tree)
    shutil.copytree(ROOT / "tests", tree / "tests")
    tools = tmp_path / "tools"
    tools.mkdir()
    for folder in os.environ["PATH"].split(os.pathsep):
        for tool in Path(folder).glob("*") if Path(folder).is_dir() else ():
            if (compiler or not COMPILER.match(tool.name)) and not (tools / tool.name).exists():
                (tools / tool.name).symlink_to(tool)
    some = "tests/native/test_library.py tests/native/test_native_plans.py -q"
    given = {"PATH": str(tools), "CC": "", "SCP_MPC_NO_ZIG": "1", "PYTEST_ADDOPTS": some}
    make = "make", f"PYTHON={Path(sys.base_prefix) / 'bin' / 'python3'}"
    assert "Written to out" in run(*make, "demo", cwd=tree, **given)
    said = run(*make, "test", cwd=tree, **given)
    assert ("passed" in said, "skipped" in said) == (True, not compiler), said[-1000:]
    assert compiler or "no native core: no C compiler is there" in said
