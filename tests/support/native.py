"""The native core in tests: skipped, with the reason, where it was not built."""

from pathlib import Path

import pytest

from scp_mpc.errors import MissingCoreError
from scp_mpc.native import library


def _why_not() -> str | None:
    try:
        library.library()
    except MissingCoreError as error:
        return error.reason
    return None


def is_stale() -> bool:
    """Whether a source is newer than the library."""
    folder = Path(library.__file__).parent
    built = (folder / "_core.so").stat().st_mtime
    return any(source.stat().st_mtime > built for source in folder.glob("*.[ch]"))


MISSING = _why_not()
needs_core = pytest.mark.skipif(MISSING is not None, reason=f"no native core: {MISSING}")
