"""Reads recordings of crowds in the formats in which public data sets come.

    obsmat  frame  id  x  z  y  vx  vz  vy      OpenTraj's obsmat.txt; z is up
    text    frame  id  x  y                     as in trajnet

Numbers between any white space, one row per person and annotated frame, in any order. Empty
lines and lines that begin with # are skipped.
"""

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

_FRAMES_PER_SECOND = 25.0  # of the videos behind obsmat.txt
_ANNOTATIONS_PER_SECOND = 2.5  # of trajnet's, however its frames are numbered
_LONGEST = 60  # characters of an offending line that an error shows


class _Columns(NamedTuple):
    number: int
    x: int
    y: int


_LAYOUTS: dict[str, _Columns] = {"obsmat": _Columns(8, 2, 4), "text": _Columns(4, 2, 3)}


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
        rate: Frame numbers per second. None: 25 for obsmat; for text, whatever makes annotated
            frames 0.4 s apart, as they are 1, 6 or 10 numbers apart in different files.
        layout: Which format it is; told from the number of columns if None. Where it is given,
            rows may have further columns.

    Raises:
        RecordingError: A line that cannot be read, or somebody twice in a frame.
        InvalidArgumentError: The rate is not positive or the layout unknown.
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
        rows.append([row[0], row[1], row[columns.x], row[columns.y]])
    if columns is None or not rows:
        raise RecordingError(path, "holds no rows")
    table = np.array(rows)
    _require_once(path, lines, table)
    if rate is None:
        obsmat = columns is _LAYOUTS["obsmat"]
        rate = _FRAMES_PER_SECOND if obsmat else _ANNOTATIONS_PER_SECOND * _step(table[:, 0])
    return Recording.from_rows(table[:, 0] / rate, table[:, 1].astype(np.intp), table[:, 2:])


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


def _step(frames: FloatArray) -> float:
    """Usual number of frames from one annotated frame to the next; 1 if there is but one."""
    steps, counts = np.unique(np.diff(np.unique(frames)), return_counts=True)
    return float(steps[counts.argmax()]) if len(steps) else 1.0
