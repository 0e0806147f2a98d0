"""Finished measurements in a JSON-lines file, so that an interrupted run can go on."""

import json
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parent.parent


class Store:
    """Records by key; a record counts only for the code, seed and sizes it was measured with.

    Args:
        path: File to read and to append to; None for memory only.
        run: What else a record depends on: seed, number of samples, ...
    """

    def __init__(self, path: Path | None, **run: int) -> None:
        """Read what is there; a last line that was cut off is dropped."""
        self._path = path
        self._run = {"code": _code(), **run}
        self._records: dict[str, dict[str, Any]] = {}
        if path is not None and path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                self._take(line)

    def __contains__(self, key: str) -> bool:
        return key in self._records

    def get(self, key: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The record under `key`, measured and written down if there is none."""
        if key not in self._records:
            self._records[key] = measure()
            if self._path is not None:
                line = json.dumps({"key": key, "run": self._run, "record": self._records[key]})
                self._path.parent.mkdir(parents=True, exist_ok=True)
                with self._path.open("a", encoding="utf-8") as file:
                    file.write("\n" + line)  # a line that was cut off stays alone
        return self._records[key]

    def _take(self, line: str) -> None:
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            return
        if entry["run"] == self._run:
            self._records[entry["key"]] = entry["record"]


@cache
def _code() -> str:
    """Digest of the sources: numbers of other code are not mixed in."""
    digest = sha256()
    folders = (_ROOT / "scp_mpc", _ROOT / "benchmarks")
    for path in sorted(path for folder in folders for path in folder.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
