"""The export: the same numbers, the same dynamics, and the same steps without Python."""

import ctypes
import os
import re
import shutil
import subprocess

import numpy as np
import pytest
from compiling import compiled, core_objects, need, replay, run
from exports import OWN, PROBLEMS, SETTINGS, discrete, drag, problem
from native import needs_core
from typer.testing import CliRunner

from scp_mpc import (
    DoubleIntegrator,
    FunctionModel,
    InvalidArgumentError,
    PlanarQuadrotor,
    Quadrotor,
    Settings,
    Unicycle,
    export,
)
from scp_mpc.cli import app
from scp_mpc.models.generated import generated
from scp_mpc.native.constants import constants
from scp_mpc.native.library import Dynamics, ProblemStruct


@needs_core
@pytest.mark.parametrize("name", sorted(set(PROBLEMS) - OWN))
def test_numbers_read_back_as_the_same_bits(name, tmp_path):
    given = PROBLEMS[name]()
    export(given, SETTINGS, tmp_path, name="this_one")
    source = tmp_path / "src" / "this_one.c"
    library = ctypes.CDLL(str(compiled(tmp_path / "x.so", source, flags=[f"-I{tmp_path}/include"])))
    struct = ProblemStruct()
    library.this_one_problem(ctypes.byref(struct))
    expected = constants(given, SETTINGS, 0.05)
    for member, _ in ProblemStruct._fields_:
        found, value = getattr(struct, member), expected.get(member, 0)
        if isinstance(value, np.ndarray) and value.size:
            view = np.ctypeslib.as_array(found, value.shape)
            assert view.tobytes() == np.ascontiguousarray(value).tobytes(), member
        elif not isinstance(value, np.ndarray) and member in expected:
            assert found == value, member
        else:
            assert not found or member == "own", member
    assert not ctypes.cast(struct.own.advance, ctypes.c_void_p).value


def dynamics(model, tmp_path):
    """`scp_dynamics` of a model's generated C."""
    from scp_mpc.native.export import _model  # a problem's file, without a core

    source = tmp_path / "model.c"
    source.write_text(_model(model, "my_robot"))
    library = ctypes.CDLL(str(compiled(tmp_path / "m.so", source)))
    return Dynamics.in_dll(library, "my_robot_dynamics"), library


MODELS = {
    "planar": lambda: PlanarQuadrotor(0.2, substeps=2),
    "quadrotor": lambda: Quadrotor(0.2),
    "drag": drag,
    "discrete": discrete,
    "stops": lambda: drag(stopping_input=lambda x: -x[2:] / 0.2),
}


@pytest.mark.parametrize("name", MODELS)
def test_generated_dynamics_are_those_of_the_model(name, tmp_path):
    pytest.importorskip("casadi")
    model = MODELS[name]()
    own, _library = dynamics(model, tmp_path)
    stop = np.empty(model.nu)
    for state in 0.5 * np.random.default_rng(1).normal(size=(20, model.nx)):
        assert own.stopping_input(None, state.ctypes.data, stop.ctypes.data) == 0
        np.testing.assert_allclose(stop, model.stopping_input(state), rtol=1e-9, atol=1e-9)
    for share in (1.0, 0.25):
        compare(model, own, share)


def compare(model, own, share):
    rng, count, nx, nu = np.random.default_rng(0), 5, model.nx, model.nu
    x = 0.5 * rng.normal(size=(count, nx))
    u = model.equilibrium_input + rng.normal(size=(count, nu))
    y = rng.normal(size=(count, nx))
    y[3] = 0.0
    after, A, B = (np.empty((count, nx, *width)) for width in ((), (nx,), (nu,)))
    bent = np.empty((count, nx + nu, nx + nu))
    at = [array.ctypes.data for array in (x, u)]
    expected = model.linearise(x, u, share)
    assert own.advance(None, count, *at, share, after.ctypes.data) == 0
    np.testing.assert_allclose(after, expected.after, rtol=1e-13, atol=1e-13)
    after[:] = 0
    places = [array.ctypes.data for array in (after, A, B)]
    assert own.linearise(None, count, *at, share, *places) == 0
    for found, wanted in (after, expected.after), (A, expected.A), (B, expected.B):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
    assert own.curvature(None, count, *at, y.ctypes.data, share, bent.ctypes.data) == 0
    wanted = model.curvature(x, u, y, share)
    np.testing.assert_allclose(bent, wanted, rtol=1e-10, atol=1e-10)


def test_what_is_python_is_refused(tmp_path):
    pytest.importorskip("casadi")
    rates = lambda x, u: np.array([x[2], x[3], u[0], u[1]])  # noqa: E731
    model = FunctionModel(rates, nx=4, nu=2, dt=0.2, position=[0, 1])
    with pytest.raises(
        InvalidArgumentError, match=r"model: FunctionModel is Python: .*CasadiModel"
    ):
        export(problem(model), Settings(), tmp_path / "new")
    assert not (tmp_path / "new").exists()

    class Other(Unicycle):
        """May have another f."""

    with pytest.raises(InvalidArgumentError, match="Other is Python"):
        generated(Other(0.1), "x")
    for stops, words in (
        (lambda x: np.array([-x.max(), 0.0]), "takes no CasADi symbol"),
        (lambda x: x[2:] if isinstance(x, np.ndarray) else -x[2:], "is another one"),
    ):
        with pytest.raises(InvalidArgumentError, match=f"stopping_input: {words}"):
            generated(drag(stopping_input=stops), "x")
    with pytest.raises(InvalidArgumentError, match="name: 'My Robot' is no name"):
        export(problem(Unicycle(0.1)), Settings(), tmp_path / "new", name="My Robot")


CPP = """
#include <cstdio>
#include <cstdlib>
#include <robot.h>

int main()
{
    scp_problem problem;
    robot_problem(&problem);
    std::size_t size = scp_size(&problem);
    void *block = std::aligned_alloc(64, (size + 63) / 64 * 64);
    scp_core *core = scp_setup(&problem, block, size);
    scp_in(core)->x_ref[problem.horizon * problem.nx] = 1.0;
    int wrong = scp_step(core);
    std::printf("%d %d %zu %.17g\\n", wrong, scp_out(core)->status, size, scp_out(core)->u0[0]);
    std::free(block);
    return wrong;
}
"""
CPP_LISTS = """
cmake_minimum_required(VERSION 3.16)
project(user LANGUAGES CXX)
find_package(robot 0.1 CONFIG REQUIRED)
add_executable(user user.cpp)
target_link_libraries(user PRIVATE robot::robot)
"""


def built(source, build, *options):
    run("cmake", "-S", source, "-B", build, *options)
    run("cmake", "--build", build)


@pytest.mark.slow
@needs_core
@pytest.mark.parametrize("name", ["unicycle", "drag"])
def test_the_package_is_built_installed_and_found(name, tmp_path):
    need("cmake", "c++")
    source, build, user = tmp_path / "export", tmp_path / "build", tmp_path / "user"
    export(PROBLEMS[name](), SETTINGS, source)
    built(source, build, f"-DCMAKE_INSTALL_PREFIX={tmp_path / 'installed'}")
    run("ctest", "--test-dir", build)
    assert len(run(build / "example").splitlines()) == 50
    run("cmake", "--install", build)
    user.mkdir()
    (user / "user.cpp").write_text(CPP)
    (user / "CMakeLists.txt").write_text(CPP_LISTS)
    built(user, user / "build", f"-DCMAKE_PREFIX_PATH={tmp_path / 'installed'}")
    wrong, status, size, _ = run(user / "build" / "user").split()
    header = (source / "include" / "robot.h").read_text()
    assert (wrong, status) == ("0", "0")
    assert int(re.search(r"ROBOT_BYTES = (\d+)", header)[1]) == int(size)


@pytest.mark.slow
@needs_core
def test_steps_are_replayed_bit_by_bit(tmp_path):
    objects = core_objects(tmp_path / "core", "-O3")
    for name, make in PROBLEMS.items():
        folder = export(make(), SETTINGS, tmp_path / name)
        told = run(replay(folder, objects), *([] if name in OWN else ["--bits"]))
        assert re.match(r"12 steps, \d+ the same bit by bit, at most \S+ apart", told)
        spoilt = (folder / "vectors" / "vectors.c").read_text()
        number = re.search(r"double inputs_7\[\] = {\s*(-?\d+\.\d+)", spoilt)
        wrong = f"{float(number[1]) + 1e-7:.17g}"
        spoilt = spoilt[: number.start(1)] + wrong + spoilt[number.end(1) :]
        (folder / "vectors" / "vectors.c").write_text(spoilt)
        with pytest.raises(AssertionError, match=r"12 steps"):
            run(replay(folder, objects))


AARCH64 = "gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user-static"  # Debian's packages


@pytest.fixture(scope="module")
def aarch64():
    """Install what is missing, if that is allowed here."""
    programs = "aarch64-linux-gnu-gcc", "qemu-aarch64-static"
    if not all(map(shutil.which, programs)) and shutil.which("apt-get") and os.geteuid() == 0:
        command = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *AARCH64.split()]
        subprocess.run(command, capture_output=True, check=False)
    need(*programs)
    return ["qemu-aarch64-static", "-L", "/usr/aarch64-linux-gnu"]


@pytest.mark.slow
@needs_core
def test_another_machine_replays_the_same_steps(aarch64, tmp_path):
    gcc = "aarch64-linux-gnu-gcc"
    objects = core_objects(tmp_path / "core", "-O3", compiler=gcc)
    for name, make in PROBLEMS.items():
        folder = export(make(), SETTINGS, tmp_path / name)
        program = replay(folder, objects, compiler=gcc)
        assert program.read_bytes()[18:20] == b"\xb7\x00"  # EM_AARCH64
        assert "12 steps" in run(*aarch64, program)


@pytest.mark.slow
@needs_core
def test_cmake_compiles_for_another_machine(aarch64, tmp_path):
    need("cmake")
    export(PROBLEMS["drag"](), SETTINGS, tmp_path / "export")
    built(
        *(tmp_path / "export", tmp_path / "build", "-DCMAKE_SYSTEM_NAME=Linux"),
        *("-DCMAKE_SYSTEM_PROCESSOR=aarch64", "-DCMAKE_C_COMPILER=aarch64-linux-gnu-gcc"),
        f"-DCMAKE_CROSSCOMPILING_EMULATOR={';'.join(aarch64)}",
    )
    run("ctest", "--test-dir", tmp_path / "build", "--output-on-failure")


MINE = """
import numpy as np
from scp_mpc import *
problem = Problem(Unicycle(0.1), horizon=5, Q=np.full(4, 0.1), R=[0.1, 0.1], u_min=-1, u_max=1)
settings = Settings(max_candidates=2)
"""


@needs_core
@pytest.mark.parametrize("source", ["scenario-2", "mine.py"])
def test_the_command_writes_a_package(source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    words = ["export", source, "--out", "new/out", "--name", "mine"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    numbers = (tmp_path / "new" / "out" / "src" / "mine.c").read_text()
    own = source == "mine.py"
    assert f"horizon = {5 if own else 8};" in numbers
    assert f"max_candidates = {2 if own else 1};" in numbers
    assert (tmp_path / "new" / "out" / "CMakeLists.txt").exists()


@pytest.mark.parametrize(
    ("text", "message"), [(None, "No such file"), ("x = 1", "mine.py makes no `problem` that is")]
)
def test_the_command_says_in_one_line_what_is_wrong(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    result = CliRunner().invoke(app, ["export", "mine.py", "--out", "out"])
    assert result.exit_code == 1
    assert message in result.output
    assert result.output.startswith("error: ")
    assert not (tmp_path / "out").exists()


@needs_core
@pytest.mark.parametrize(("nodes", "most"), [(1, 2e6), (4, 4.5e6)])
def test_memory_is_small(nodes, most, tmp_path):
    twelve = problem(DoubleIntegrator(0.2), horizon=30, max_obstacles=12, nodes_per_interval=nodes)
    export(twelve, SETTINGS, tmp_path, polytopes=False)
    header = (tmp_path / "include" / "robot.h").read_text()
    assert int(re.search(r"ROBOT_BYTES = (\d+)", header)[1]) < most
