"""Where numbers come from: machine, versions, commit and date."""

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("scp-mpc", "numpy", "scipy", "osqp", "daqp", "piqp", "casadi")
_HERE = Path(__file__).resolve().parent


def provenance() -> dict[str, str | int | None]:
    """Return machine, cores, versions, commit and date; None for what cannot be found out."""
    return {
        "machine": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{package: _version(package) for package in _PACKAGES},
        "commit": _commit(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def library_version() -> str:
    """Version of the installed library."""
    return version("scp-mpc")


def _processor() -> str:
    """The processor's model on Linux, else what the platform calls it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit of this checkout, marked if sources differ; None outside of one."""
    # An installed package may lie within somebody else's repository, which does not track it.
    if _git("ls-files", "--error-unmatch", "problem.py") is None:
        return None
    commit = _git("describe", "--always")
    return f"{commit}-dirty" if commit and _git("diff", "--name-only", "HEAD", ":/*.py") else commit


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=_HERE, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None
