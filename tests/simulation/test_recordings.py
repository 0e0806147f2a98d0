"""Recordings: both formats, who is where in between, and files that are none."""

import numpy as np
import pytest
from recordings import street, write_obsmat, write_text

from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.simulation import Recording, RecordingError, read_recording, recorded_people


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
    assert_same(read_recording(write_text(made, tmp_path / "crowd.txt", step, between)), made)


def test_the_rate_is_of_frame_numbers(tmp_path):
    made = street()
    file = write_text(made, tmp_path / "crowd.txt", step=6)
    assert read_recording(file, rate=15.0).interval == pytest.approx(0.4)
    assert read_recording(file, rate=30.0).interval == pytest.approx(0.2)
    file = write_obsmat(made, tmp_path / "obsmat.txt", step=6)
    assert read_recording(str(file)).interval == pytest.approx(6 / 25)


def test_rows_in_any_order_and_frames_left_out(tmp_path):
    file = tmp_path / "crowd.txt"
    file.write_text("30 1 3 0\n0 1 0 0\n10 2 5 5\n20 1 2 0\n0 2 4 4\n\n10 1 1 0\n90 7 1 1\n")
    read = read_recording(file)
    assert np.allclose(read.times, [0, 0.4, 0.8, 1.2, 3.6])
    assert [who.tolist() for who in read.names] == [[1, 2], [1, 2], [1], [1], [7]]
    assert read.positions[1].tolist() == [[1, 0], [5, 5]]
    assert np.allclose(read.paths[1][1][:, 0], [0, 1, 2, 3])


def test_forced_layouts_take_further_columns(tmp_path):
    file = tmp_path / "crowd.txt"
    file.write_text("0 1 2 3 0.5 0 0 0\n10 1 2 4 0.5 0 0 0\n")
    assert read_recording(file).positions[0].tolist() == [[2, 0.5]]
    assert read_recording(file, layout="text").positions[0].tolist() == [[2, 3]]
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
