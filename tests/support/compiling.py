"""C for tests: who compiles it, with what, and where the native core is."""

import shutil
import subprocess
from pathlib import Path

import pytest

import scp_mpc.native

HERE = Path(scp_mpc.native.__file__).parent
CORE = sorted(p for p in HERE.glob("*.c") if p.name != "machine_clock.c")
FLAGS = ["-std=c99", "-ffp-contract=off", f"-I{HERE}"]
NEEDS_CORE = pytest.mark.skipif(
    not (HERE / "_core.so").exists(), reason="the native core is not built"
)


def need(*programs):
    """Skip, with the reason, where a program is not there."""
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")


def run(*command, **options):
    """Run a command that has to succeed; return what it wrote."""
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, check=False, **options)
    assert not done.returncode, "\n".join(
        [" ".join(words), done.stdout[-3000:], done.stderr[-3000:]]
    )
    return done.stdout


def compiled(target, *sources, flags=(), compiler="cc"):
    """Compile C sources to a program or, where it is named .so, a library; return where it is."""
    need(compiler)
    kind = ["-fPIC", "-shared"] if target.suffix == ".so" else []
    run(compiler, *FLAGS, *kind, *flags, "-o", target, *sources, "-lm")
    return target
