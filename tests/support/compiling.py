"""C for tests: who compiles it, with what."""

import shutil
import subprocess
from pathlib import Path

import pytest

import scp_mpc.native

HERE = Path(scp_mpc.native.__file__).parent
CORE = sorted(p for p in HERE.glob("*.c") if p.name != "machine_clock.c")  # it is not exported
FLAGS = ["-std=c99", "-ffp-contract=off", f"-I{HERE}"]
STRICT = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]
SANITIZED = [
    *("-g", "-O1", "-DSCP_POISON", "-fno-sanitize-recover=all"),
    "-fsanitize=address,undefined,float-cast-overflow",
]


def need(*programs):
    """Skip, with the reason, where a program is not there."""
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")


def run(*command, **options):
    """Run a command that has to succeed; return what it wrote."""
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, check=False, **options)
    told = done.stdout[-3000:] + done.stderr[-5000:]
    assert not done.returncode, f"{' '.join(words)[:300]}\n{told}"
    return done.stdout


def compiled(target, *sources, flags=(), compiler="cc"):
    """Compile C sources to a program or, where it is named .so, a library; return where it is."""
    need(compiler)
    kind = ["-fPIC", "-shared"] if target.suffix == ".so" else []
    run(compiler, *FLAGS, *kind, *flags, "-o", target, *sources, "-lm")
    return target


def core_objects(folder, *flags, compiler="cc"):
    """Compile the core; return its object files."""
    need(compiler)
    folder.mkdir(parents=True, exist_ok=True)
    run(compiler, *FLAGS, *flags, "-c", *CORE, cwd=folder)
    return sorted(folder.glob("*.o"))


def replay(folder, objects, *flags, compiler="cc"):
    """Link an export's replay of its test vectors with a core that is compiled already."""
    own = [path for path in (folder / "src").glob("*.c") if path.name not in map(_name, CORE)]
    vectors = sorted((folder / "vectors").glob("*.c"))
    flags = [f"-I{folder / 'include'}", *flags]
    return compiled(folder / "replay", *own, *vectors, *objects, flags=flags, compiler=compiler)


def _name(path):
    return path.name
