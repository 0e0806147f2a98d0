"""Recordings: both formats, who is where in between, and files that are none."""

import numpy as np
import pytest
from recordings import rows as street_rows
from recordings import street, write_obsmat, write_text

from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.simulation import (
    Recording,
    RecordingError,
    measure_coverage,
    read_recording,
    recorded_people,
    replay,
)


def assert_same(read, made):
    assert np.allclose(read.times, made.times)
    for mine, theirs in zip(read.names, made.names, strict=True):
        assert (mine == theirs).all()
    for mine, theirs in zip(read.positions, made.positions, strict=True):
        assert np.allclose(mine, theirs, atol=1e-8)


def test_obsmat(tmp_path):
    made = street()
    read = read_recording(write_obsmat(made, tmp_path / "obsmat.txt"))
    assert_same(read, made)
    assert read.interval == pytest.approx(0.4)
    assert not read.positions[0].flags.writeable


@pytest.mark.parametrize("step", [1, 6, 10])
@pytest.mark.parametrize("between", [" ", "\t", "  \t "])
def test_text_of_any_step(tmp_path, step, between):
    made = street()
    file = write_text(made, tmp_path / "crowd.txt", step, between)
    assert_same(read_recording(file, rate=step / 0.4), made)


def test_the_rate_is_of_frame_numbers(tmp_path):
    made = street()
    file = write_text(made, tmp_path / "crowd.txt", step=6)
    assert read_recording(file, rate=15.0).interval == pytest.approx(0.4)
    assert read_recording(file, rate=30.0).interval == pytest.approx(0.2)
    file = write_obsmat(made, tmp_path / "obsmat.txt", step=6)
    assert read_recording(str(file)).interval == pytest.approx(0.4)


@pytest.mark.parametrize(("interval", "step"), [(0.4, 10), (0.4, 6), (0.1, 1), (0.04, 1), (1.0, 5)])
def test_the_velocities_tell_the_rate(tmp_path, interval, step, caplog):
    """25, 15, 10, 25 and 5 per second; a given one that is another one is warned of."""
    made = street(interval=interval)
    file = write_obsmat(made, tmp_path / "obsmat.txt", step)
    assert_same(read_recording(file), made)
    assert_same(read_recording(file, rate=step / interval), made)
    assert not caplog.records
    assert read_recording(file, rate=2.0).interval == pytest.approx(step / 2)
    (record,) = caplog.records
    assert f"rate 2 is given, but its velocities tell {step / interval:g}" in record.getMessage()


def test_noise_on_the_positions_moves_no_rate(tmp_path):
    made, rng = street(people=12), np.random.default_rng(0)
    rows = write_obsmat(made, tmp_path / "obsmat.txt", 6).read_text().splitlines()[2:]
    table = np.array([[float(word) for word in row.split()] for row in rows])
    table[:, [2, 4]] += rng.normal(0, 0.03, (len(table), 2))
    np.savetxt(tmp_path / "noisy.txt", table)
    assert read_recording(tmp_path / "noisy.txt").interval == pytest.approx(0.4)


@pytest.mark.parametrize("spoilt", ["text", "zeros", "random", "backwards"])
def test_a_rate_that_nothing_tells_must_be_given(tmp_path, spoilt):
    made, file = street(), tmp_path / "crowd.txt"
    if spoilt == "text":
        write_text(made, file)
    elif spoilt == "random":
        rows = np.array([[f, n, x, 0, y, 0, 0, 0] for f, n, x, y in street_rows(made, 10)])
        rows[:, [5, 7]] = np.random.default_rng(0).normal(size=(len(rows), 2))
        np.savetxt(file, rows)
    else:
        write_obsmat(made, file, scale=0.0 if spoilt == "zeros" else -1.0)
    with pytest.raises(InvalidArgumentError, match=r"rate: missing: crowd\.txt does not tell"):
        read_recording(file)
    assert_same(read_recording(file, rate=25.0), made)


@pytest.mark.parametrize(("scale", "words"), [(40.0, "beyond"), (1e3, "beyond"), (1e-3, "faster")])
def test_other_units_are_refused_with_the_speed(tmp_path, scale, words):
    """Pixels, millimetres, kilometres."""
    made = street()
    scaled = Recording(made.times, made.names, tuple(scale * p for p in made.positions))
    file = write_obsmat(scaled, tmp_path / "obsmat.txt")
    for refuse in (
        lambda: read_recording(file),
        lambda: measure_coverage(scaled),
        lambda: replay(scaled),
    ):
        with pytest.raises(InvalidArgumentError, match=rf"recording: .*{words}.* m/s") as error:
            refuse()
        speed = float(str(error.value).split(" m/s")[0].split()[-1])
        assert 0.9 * scale < speed < 1.6 * scale


def test_people_who_stand_are_plausible():
    times = np.repeat([0.0, 0.4, 0.8], 2)
    who, places = np.tile([1, 2], 3), np.tile([[0.0, 0.0], [3.0, 1.0]], (3, 1))
    Recording.from_rows(times, who, places).require_plausible()
    Recording.from_rows(times[:2], who[:2], places[:2]).require_plausible()


def test_rows_in_any_order_and_frames_left_out(tmp_path):
    file = tmp_path / "crowd.txt"
    file.write_text("30 1 3 0\n0 1 0 0\n10 2 5 5\n20 1 2 0\n0 2 4 4\n\n10 1 1 0\n90 7 1 1\n")
    read = read_recording(file, rate=25.0)
    assert np.allclose(read.times, [0, 0.4, 0.8, 1.2, 3.6])
    assert [who.tolist() for who in read.names] == [[1, 2], [1, 2], [1], [1], [7]]
    assert read.positions[1].tolist() == [[1, 0], [5, 5]]
    assert np.allclose(read.paths[1][1][:, 0], [0, 1, 2, 3])


def test_forced_layouts_take_further_columns(tmp_path):
    file = tmp_path / "crowd.txt"
    file.write_text("0 1 2 3 0.5 0 0 0\n10 1 2 4 0.5 0 0 0\n")
    assert read_recording(file, rate=25.0).positions[0].tolist() == [[2, 0.5]]
    assert read_recording(file, rate=25.0, layout="text").positions[0].tolist() == [[2, 3]]
    with pytest.raises(InvalidArgumentError, match="'csv' is none of obsmat, text"):
        read_recording(file, layout="csv")


def test_who_is_present_and_where():
    times = np.array([0.0, 0.4, 0.4, 0.8, 1.6])
    places = np.array([[0, 0], [1, 0], [9, 9], [1, 2], [9, 5]], float)
    made = Recording.from_rows(times, np.array([1, 1, 2, 1, 2]), places)
    for t, people in (
        (0.0, {1: [0, 0]}),
        (0.3, {1: [0.75, 0]}),
        (0.6, {1: [1, 1], 2: [9, 9 - 4 / 6]}),
        (1.0, {2: [9, 7]}),
        (1.6, {2: [9, 5]}),
        (1.7, {}),
        (-0.1, {}),
    ):
        for body in recorded_people(made):
            assert np.allclose(body.at(t), people.get(body.name, np.nan), equal_nan=True)


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("0 1 2 3\n10 1 x 3\n", 2, "not numbers only: '10 1 x 3'"),
        ("0 1 2 3\n10 1 2\n", 2, "3 columns, not 4: '10 1 2'"),
        ("0 1 2 3\n\n10 1 2 3 4\n", 3, "5 columns, not 4"),
        ("0 1 2 3 4\n", 1, "5 columns are not 8 (obsmat) or 4 (text)"),
        ("# x\n0 1 2 nan\n", 2, "not finite: '0 1 2 nan'"),
        ("0 1 2 1e300\n", 1, "beyond 1e9"),
        ("0 1.5 2 3\n", 1, "the id is not a whole number"),
        ("0 1 2 3\n0 2 2 3\n0 1 4 4\n", 3, "person and frame are those of line 1: '0 1'"),
        ("0,1,2,3\n", 1, "not numbers only: '0,1,2,3'"),
        ("0 1 2 3\n" + "word " * 100, 2, "..."),
        ("", None, "holds no rows"),
        ("# nothing\n\n", None, "holds no rows"),
    ],
)
def test_what_is_no_recording_is_told_by_line(tmp_path, text, line, words):
    file = tmp_path / "crowd.txt"
    file.write_text(text)
    with pytest.raises(RecordingError) as error:
        read_recording(file)
    assert isinstance(error.value, InvalidArgumentError)
    assert error.value.line == line
    assert words in str(error.value)
    assert "crowd.txt" in str(error.value)
    assert len(str(error.value)) < 200


def test_files_that_are_no_text(tmp_path):
    (tmp_path / "crowd.bin").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match="not a text file"):
        read_recording(tmp_path / "crowd.bin")
    with pytest.raises(FileNotFoundError):
        read_recording(tmp_path / "none.txt")
    with pytest.raises(BoundsError, match="rate"):
        read_recording(tmp_path / "none.txt", rate=0.0)


def test_rows_must_make_sense():
    with pytest.raises(InvalidArgumentError, match="empty"):
        Recording.from_rows(np.zeros(0), np.zeros(0, np.intp), np.zeros((0, 2)))
    with pytest.raises(InvalidArgumentError, match="7 is given twice at 2 s"):
        Recording.from_rows(np.array([2.0, 2.0]), np.array([7, 7]), np.zeros((2, 2)))
