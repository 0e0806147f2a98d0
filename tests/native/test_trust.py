"""What the core must never do: allocate, print, warn, write elsewhere, be another one twice."""

import re
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from compiling import CORE, HERE, SANITIZED, STRICT, compiled, core_objects, need, replay, run
from driving import bits, drive
from exports import PROBLEMS, SETTINGS
from instances import problem
from native import needs_core

from scp_mpc import MPC, Settings, export

NATIVE = Settings(solver="native", deadline=None)
FUZZ = Path(__file__).parent / "fuzz.c"
MATHEMATICS = re.compile(
    "a?(cos|sin|tan)|atan2|ceil|erfc?|expm?[12]?|fabs|floor|fmax|fmin|fmod|hypot|ldexp|log(1p)?|"
    "nearbyint|pow|round|sincos|sqrt|tanh|trunc"
)
MEMORY = re.compile("mem(cmp|cpy|move|set)")
LOADER = re.compile(r"_ITM_\w+|__cxa_finalize|__gmon_start__")


@needs_core
def test_it_asks_for_mathematics_and_memory_copies_alone():
    need("nm")
    words = run("nm", "--dynamic", "--undefined-only", HERE / "_core.so").split()
    names = {word.split("@")[0] for word in words if len(word) > 1}
    assert "memcpy" in names
    kinds = MATHEMATICS, MEMORY, LOADER
    others = {name for name in names if not any(kind.fullmatch(name) for kind in kinds)}
    assert others <= {"clock_gettime"}  # machine_clock.c, the binding's


def test_it_includes_nothing_else():
    allowed = {"math", "string", "stdint", "stddef", "float", "limits"}
    for path in CORE:
        assert set(re.findall(r"#include <(.*)\.h>", path.read_text())) <= allowed, path.name


@needs_core
def test_the_same_steps_give_the_same_bits():
    """From call to call, after a reset, and in six threads at once."""
    mpc = MPC(problem(8), NATIVE)
    first = bits(drive(mpc, 12))
    mpc.reset()
    assert bits(drive(mpc, 12)) == first

    def again(_):
        return bits(drive(MPC(problem(8), NATIVE), 12))

    with ThreadPoolExecutor(6) as pool:
        assert set(pool.map(again, range(12))) == {first}


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("level", ["-O0", "-O3"])
def test_there_is_no_warning(compiler, level, tmp_path):
    core_objects(tmp_path / "core", *STRICT, level, compiler=compiler)


@pytest.mark.slow
@needs_core
def test_other_compilers_give_the_same_bits(tmp_path):
    folder = export(PROBLEMS["bicycle"](), SETTINGS, tmp_path / "export")
    for compiler, level in (("gcc", "-O0"), ("clang", "-O3"), ("gcc", "-O2")):
        if shutil.which(compiler):
            objects = core_objects(tmp_path / f"{compiler}{level}", level, compiler=compiler)
            run(replay(folder, objects, compiler=compiler), "--bits")


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    return core_objects(tmp_path_factory.mktemp("sanitized"), *SANITIZED)


@pytest.mark.slow
@needs_core
def test_sanitizers_see_nothing_in_a_replay(sanitized, tmp_path):
    for name, make in PROBLEMS.items():
        folder = export(make(), SETTINGS, tmp_path / name)
        run(replay(folder, sanitized, *SANITIZED))


@pytest.fixture(scope="module")
def fuzz(sanitized, tmp_path_factory):
    program = tmp_path_factory.mktemp("fuzz") / "fuzz"
    return compiled(program, FUZZ, *sanitized, flags=["-std=gnu99", *SANITIZED])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(0, 4000, 1000))
def test_nothing_random_brings_it_down(fuzz, seed):
    """Sanitizers watch, walls are around its blocks, every call is made twice; see fuzz.c."""
    run(fuzz, seed, 1000, timeout=1800)


@pytest.mark.slow
def test_the_fuzzer_notices_a_write_beyond_an_array(tmp_path):
    """One entry too far, in the block as well as at its end."""
    source, line = (HERE / "linalg.c").read_text(), "i < n; i++)\n        y[i] += alpha"
    assert source.count(line) == 1
    wrong = source.replace(line, line.replace("<", "<="))
    spoilt = tmp_path / "linalg.c"
    spoilt.write_text(wrong)
    others = [path for path in CORE if path.name != "linalg.c"]
    program = compiled(tmp_path / "fuzz", FUZZ, spoilt, *others, flags=["-std=gnu99", *SANITIZED])
    with pytest.raises(AssertionError, match=r"use-after-poison|SEGV"):
        run(program, 0, 200, timeout=600)


@pytest.mark.slow
def test_libfuzzer_finds_nothing_in_two_minutes(tmp_path):
    need("clang")
    flags = [*SANITIZED, "-std=gnu99", "-DFUZZER", "-fsanitize=fuzzer"]
    program = compiled(tmp_path / "fuzzer", FUZZ, *CORE, flags=flags, compiler="clang")
    strings = np.random.default_rng(0)
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    for k in range(200):
        (corpus / str(k)).write_bytes(strings.bytes(int(strings.integers(100, 4000))))
    options = ["-max_len=6000", "-len_control=0", "-timeout=120", "-max_total_time=120"]
    done = subprocess.run(
        [program, corpus, *options], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert not done.returncode, done.stderr[-3000:]


@pytest.mark.slow
@needs_core
@pytest.mark.parametrize("name", ["double", "unicycle", "drag"])
def test_valgrind_sees_nothing_in_a_replay(name, tmp_path):
    need("valgrind")
    folder = export(PROBLEMS[name](), SETTINGS, tmp_path / "export")
    program = replay(folder, core_objects(tmp_path / "core", "-g", "-O1"))
    run("valgrind", "--error-exitcode=9", "--track-origins=yes", "--quiet", program)
