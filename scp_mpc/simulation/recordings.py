"""Reads recordings of crowds in the formats in which public data sets come.

    obsmat  frame  id  x  z  y  vx  vz  vy      OpenTraj's obsmat.txt; z is up
    text    frame  id  x  y                     as in trajnet

Numbers between any white space, one row per person and annotated frame, in any order. Empty
lines and lines that begin with # are skipped.

Neither format says how many frames make a second. The velocities v of obsmat tell it: with the
way d from one annotated frame of a person to the next, k frame numbers later, the rate is
k |v|^2 / v'd.
"""

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.settings import require_positive
from scp_mpc.simulation.recording import Recording

Layout = Literal["obsmat", "text"]

_log = logging.getLogger(__name__)

_SCATTER = 0.3  # between the quartiles of the rates that a file's rows tell, relative to the median
_USUAL = np.array(
    [1, 2, 2.5, 3, 4, 5, 6, 7.5, 8, 10, 12, 12.5, 15, 20, 24, 25, 30, 50, 60, 100, 120]
)
_NEAR = 0.03  # relative distance from a usual rate at which one is taken for it
_OTHER = 0.1  # relative difference of a given rate from the told one that is worth a warning
_LONGEST = 60  # characters of an offending line that an error shows


class _Columns(NamedTuple):
    number: int
    position: tuple[int, int]
    velocity: tuple[int, int] | tuple[()]


_LAYOUTS: dict[str, _Columns] = {
    "obsmat": _Columns(8, (2, 4), (5, 7)),
    "text": _Columns(4, (2, 3), ()),
}


class RecordingError(InvalidArgumentError):
    """A file is no recording.

    Attributes:
        line: Number of the offending line, from 1; None where it is none in particular.
        text: That line.
    """

    def __init__(self, file: Path, problem: str, line: int | None = None, text: str = "") -> None:
        """Name file, line and text."""
        shown = text if len(text) <= _LONGEST else text[:_LONGEST] + " ..."
        where = file.name if line is None else f"{file.name}, line {line}"
        super().__init__(where, f"{problem}: {shown!r}" if line else problem)
        self.line, self.text = line, text


def read_recording(
    file: Path | str, *, rate: float | None = None, layout: Layout | None = None
) -> Recording:
    """Read a recording; times count from frame 0.

    Args:
        file: Text in one of the formats above.
        rate: Frame numbers per second; None for what an obsmat's own velocities tell.
        layout: Which format it is; told from the number of columns if None. Where it is given,
            rows may have further columns.

    Raises:
        RecordingError: A line that cannot be read, or somebody twice in a frame.
        InvalidArgumentError: The rate is not positive, or neither given nor told by the file; the
            layout is unknown; speeds are not those of people, see `Recording.require_plausible`.
        OSError: There is no such file.
    """
    path = Path(file)
    if rate is not None:
        require_positive("rate", rate)
    if layout is not None and layout not in _LAYOUTS:
        raise InvalidArgumentError("layout", f"{layout!r} is none of {', '.join(_LAYOUTS)}")
    lines: list[int] = []
    rows: list[list[float]] = []
    columns = None if layout is None else _LAYOUTS[layout]
    for number, text, row in _rows(path):
        if columns is None:
            columns = _told_by(path, number, text, len(row))
        _check(path, number, text, row, columns, exact=layout is None)
        lines.append(number)
        rows.append([row[0], row[1], *(row[k] for k in columns.position + columns.velocity)])
    if columns is None or not rows:
        raise RecordingError(path, "holds no rows")
    table = np.array(rows)
    _require_once(path, lines, table)
    told = _told_rate(table) if columns.velocity else None
    if rate is None and told is None:
        raise InvalidArgumentError(
            "rate", f"missing: {path.name} does not tell how many frame numbers make a second"
        )
    if rate is not None and told is not None and abs(rate - told) > _OTHER * told:
        _log.warning("%s: rate %g is given, but its velocities tell %.3g", path.name, rate, told)
    times = table[:, 0] / (told if rate is None else rate)
    recording = Recording.from_rows(times, table[:, 1].astype(np.intp), table[:, 2:4])
    recording.require_plausible()
    return recording


def _rows(path: Path) -> Iterator[tuple[int, str, list[float]]]:
    """Yield the number, the text and the numbers of each line that has some."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise RecordingError(path, f"not a text file ({error})") from None
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        try:
            row = [float(word) for word in text.split()]
        except ValueError:
            raise RecordingError(path, "not numbers only", number, text) from None
        yield number, text, row


def _told_by(path: Path, line: int, text: str, count: int) -> _Columns:
    for columns in _LAYOUTS.values():
        if columns.number == count:
            return columns
    known = " or ".join(f"{columns.number} ({name})" for name, columns in _LAYOUTS.items())
    raise RecordingError(path, f"{count} columns are not {known}", line, text)


def _check(
    path: Path, line: int, text: str, row: list[float], columns: _Columns, exact: bool
) -> None:
    if len(row) < columns.number or (exact and len(row) > columns.number):
        raise RecordingError(path, f"{len(row)} columns, not {columns.number}", line, text)
    if not all(map(math.isfinite, row)):
        raise RecordingError(path, "not finite", line, text)
    if max(map(abs, row)) > 1e9:
        raise RecordingError(path, "a number beyond 1e9", line, text)
    if row[1] != int(row[1]):
        raise RecordingError(path, "the id is not a whole number", line, text)


def _require_once(path: Path, lines: list[int], table: FloatArray) -> None:
    """Raise for the first line that repeats frame and person of another."""
    seen: dict[tuple[float, float], int] = {}
    for line, (frame, name) in zip(lines, table[:, :2].tolist(), strict=True):
        before = seen.setdefault((frame, name), line)
        if before != line:
            problem = f"person and frame are those of line {before}"
            raise RecordingError(path, problem, line, f"{frame:g} {name:g}")


def _told_rate(table: FloatArray) -> float | None:
    """Frame numbers per second by the velocities of rows (n, 6); None where they do not tell."""
    table = table[np.lexsort((table[:, 0], table[:, 1]))]
    frames, who, p, v = table[:, 0], table[:, 1], table[:, 2:4], table[:, 4:]
    same = np.diff(who) == 0
    k, d, v = np.diff(frames)[same], np.diff(p, axis=0)[same], (v[1:] + v[:-1])[same] / 2
    speed2, along = (v * v).sum(axis=1), (v * d).sum(axis=1)
    if not (along > 0).any():
        return None
    fast = (speed2 >= np.median(speed2[along > 0])) & (along != 0)
    low, rate, high = np.quantile(k[fast] * speed2[fast] / along[fast], [0.25, 0.5, 0.75])
    if rate <= 0 or high - low > _SCATTER * rate:
        return None
    usual = float(_USUAL[np.abs(_USUAL - rate).argmin()])
    return usual if abs(rate - usual) <= _NEAR * usual else float(rate)
