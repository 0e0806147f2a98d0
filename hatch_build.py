"""Build hook: compiles the native core, `scp_mpc/native/*.c`, into one shared library.

    $CC, cc, gcc, clang     the first that works
    else zig                a C compiler in a wheel, installed by pip into a temporary folder
    else                    a warning, and a package without the core, which works all the same

The library needs no Python, so that one wheel per platform serves all: py3-none-<platform>. It is
for any processor of its kind (no -march=native) and does the same arithmetic on all (no contraction
to fused operations). Installed in place, as by `pip install --editable`, it is written next to its
sources. Where there is none, `not_built.txt` says why, for whoever asks for it.

SCP_MPC_NO_ZIG=1 asks nobody for a compiler; SCP_MPC_PURE=1 builds no core at all.
"""

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import sys_tags

FOLDER = "scp_mpc/native"
LIBRARY, REASON = "_core.so", "not_built.txt"
FLAGS = ["-std=c99", "-O3", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden"]
ANY_PROCESSOR = [
    "-mcpu=baseline",
    "-s",
]  # zig: else the one it runs on; with symbols 80 times larger


class NativeCore(BuildHookInterface):
    """Adds the library to the wheel, or says why it is not there."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile into a temporary folder, in place for an editable installation."""
        home = Path(self.root) / FOLDER
        self.folder = Path(tempfile.mkdtemp(prefix="scp_mpc-"))
        target = home if version == "editable" else self.folder
        sources = sorted(home.glob("*.[ch]"))
        if is_newer(target / LIBRARY, [*sources, Path(__file__)]):
            return
        for name in (LIBRARY, REASON):
            (target / name).unlink(missing_ok=True)
        reason = built([s for s in sources if s.suffix == ".c"], target / LIBRARY, self.folder)
        if reason:
            self.app.display_warning(f"scp_mpc without its native core: {reason}")
            (target / REASON).write_text(reason + "\n", encoding="utf-8")
        if version != "editable":
            name = REASON if reason else LIBRARY
            build_data["force_include"][str(target / name)] = f"{FOLDER}/{name}"
            if not reason:
                build_data["pure_python"] = False
                build_data["tag"] = f"py3-none-{platform()}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        """Remove the temporary folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def is_newer(library: Path, sources: list[Path]) -> bool:
    """Whether a library is there that was built from these sources."""
    return library.exists() and library.stat().st_mtime >= max(s.stat().st_mtime for s in sources)


def built(sources: list[Path], library: Path, scratch: Path) -> str:
    """Compile; return why that failed, or nothing."""
    if os.environ.get("SCP_MPC_PURE"):
        return "it was switched off by SCP_MPC_PURE"
    reasons = []
    for compiler in ("$CC", "cc", "gcc", "clang"):
        command = shlex.split(os.environ.get("CC", "")) if compiler == "$CC" else [compiler]
        if command and shutil.which(command[0]):
            reason = compiled(command, sources, library)
            if not reason:
                return ""
            reasons.append(reason)
    if not reasons:
        reasons.append("no C compiler is there ($CC, cc, gcc, clang)")
    if os.environ.get("SCP_MPC_NO_ZIG"):
        return "; ".join([*reasons, "zig's was switched off by SCP_MPC_NO_ZIG"])
    zig = scratch / "zig"
    pip = [sys.executable, "-I", "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    reason = run([*pip, "--target", str(zig), "ziglang"])
    if not reason:
        command = [str(zig / "ziglang" / "zig"), "cc", *ANY_PROCESSOR]
        reason = compiled(command, sources, library, {"ZIG_GLOBAL_CACHE_DIR": str(zig / "cache")})
    return "; ".join([*reasons, reason]) if reason else ""


def compiled(
    command: list[str], sources: list[Path], library: Path, extra: dict[str, str] | None = None
) -> str:
    """Compile and link with one compiler; return why that failed, or nothing."""
    part = library.with_suffix(".part")
    reason = run([*command, *FLAGS, "-o", str(part), *map(str, sources), "-lm"], extra)
    if not reason and not part.exists():
        reason = f"{shlex.join(command)} wrote nothing"
    if reason:
        part.unlink(missing_ok=True)
    else:
        part.replace(library)  # whoever has the old one loaded keeps it
    return reason


def run(command: list[str], extra: dict[str, str] | None = None) -> str:
    """Run a command; return why that failed, or nothing."""
    try:
        done = subprocess.run(
            command, env=os.environ | (extra or {}), capture_output=True, text=True, check=False
        )
    except OSError as error:
        return str(error)
    if not done.returncode:
        return ""
    said = (done.stderr.strip() or done.stdout.strip()).splitlines() or ["it says nothing"]
    return f"{shlex.join(command[:4])} ... failed ({done.returncode}): {said[0]}"


def platform() -> str:
    """This machine's platform tag, of no promise about the C library's age."""
    return next(t.platform for t in sys_tags() if not t.platform.startswith(("many", "musl")))
