"""The commands `coverage` and `replay`, from their arguments to their files."""

import json

import pytest
from recordings import street, write_obsmat, write_text
from test_cli import invoke


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_obsmat(street(people=6, frames=30), tmp_path_factory.mktemp("x") / "obsmat.txt")


def test_coverage_prints_a_table_and_writes_files(file, tmp_path):
    numbers, picture = tmp_path / "coverage.json", tmp_path / "coverage.png"
    result = invoke("coverage", file, "--json", numbers, "--figure", picture)
    assert result.exit_code == 0, result.output
    assert "95 %" in result.output
    assert "NEES" in result.output
    table = [line for line in result.output.splitlines() if line.startswith("  ") and "±" in line]
    assert len(table) == 12
    assert max(map(len, table)) <= 80
    found = json.loads(numbers.read_text())
    assert found["people"] == 6
    assert [round(row["lead"], 3) for row in found["leads"][:2]] == [0.4, 0.8]
    assert len(found["leads"]) == 12
    assert picture.stat().st_size > 10_000


def test_coverage_passes_its_options_on(tmp_path):
    text = write_text(street(people=6, frames=30), tmp_path / "crowd.txt", step=1)
    numbers = tmp_path / "coverage.json"
    options = ["--rate", 5, "--noise", 0.2, "--seed", 3, "--layout", "text", "--json", numbers]
    result = invoke("coverage", text, *options)
    assert result.exit_code == 0, result.output
    found = json.loads(numbers.read_text())
    assert found["interval"] == pytest.approx(0.2)
    assert (found["noise"], found["seed"]) == (0.2, 3)
    wide = tmp_path / "wide.json"
    options[-1] = wide
    invoke("coverage", text, *options, "--std-inflation", 2.0)
    wider = json.loads(wide.read_text())["leads"][0]["rms_predicted"]
    assert wider == pytest.approx(2 * found["leads"][0]["rms_predicted"])


def test_replay_prints_and_writes(file, tmp_path):
    out = tmp_path / "new" / "replay"
    result = invoke("replay", file, "--out", out, "--steps", 10)
    assert result.exit_code == 0, result.output
    assert "do not react" in result.output
    for row in ("People; touched", "Contacts; within 1 s", "robot is at rest", "runs into"):
        assert row in result.output
    sizes = {path.name: path.stat().st_size for path in out.iterdir()}
    assert set(sizes) == {"replay.json", "replay.png", "replay.gif"}
    assert min(sizes.values()) > 500
    assert json.loads((out / "replay.json").read_text())["steps"] == 10


def test_replay_passes_its_options_on(file, tmp_path):
    ends = ["--start", -4, 0, "--goal", 4, 1.5, "--no-animation", "--seed", 2, "--noise", 0.1]
    result = invoke("replay", file, "--out", tmp_path, "--steps", 5, *ends)
    assert result.exit_code == 0, result.output
    assert not (tmp_path / "replay.gif").exists()
    numbers = json.loads((tmp_path / "replay.json").read_text())
    assert (numbers["start_m"], numbers["goal_m"]) == ([-4, 0], [4, 1.5])
    assert (numbers["seed"], numbers["noise_m"]) == (2, 0.1)
    assert invoke("replay", file, "--steps", 2, "--course", "across").exit_code == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["replay", "--goal", 1, 2], "start: goes with a goal"),
        (["replay", "--course", "up"], "course: 'up' is neither"),
        (["replay", "--level", 1.5], "level: 1.5"),
        (["replay", "--horizon", 0], "horizon: 0"),
        (["replay", "--steps", 0], "steps: 0"),
        (["replay", "--noise", 0], "noise: 0"),
        (["replay", "--obstacles", 0], "obstacles: 2 exceed max_obstacles = 0"),
        (["replay", "--speed", -1], "speed: -1"),
        (["replay", "--layout", "csv"], "layout: 'csv'"),
        (["coverage", "--rate", -1], "rate: -1"),
        (["coverage", "--layout", "text", "--rate", 25, "--noise", "nan"], "noise: nan"),
        (["coverage", "--layout", "text"], "rate: missing: obsmat.txt does not tell"),
        (["coverage", "--std-inflation", 0], "std_inflation: 0"),
    ],
)
def test_bad_value_gives_one_line(file, options, message):
    result = invoke(options[0], file, *options[1:])
    assert result.exit_code == 1
    lines = [line for line in result.output.splitlines() if "it/s" not in line and "%|" not in line]
    assert lines[-1].startswith(f"error: {message}"), result.output


def test_unreadable_files_give_line_and_text(tmp_path):
    bad = tmp_path / "crowd.txt"
    bad.write_text("0 1 2 3\n10 1 two 3\n")
    for command in ("coverage", "replay"):
        result = invoke(command, bad)
        assert result.exit_code == 1
        assert result.output == ("error: crowd.txt, line 2: not numbers only: '10 1 two 3'\n")
        assert invoke(command, tmp_path / "none.txt").exit_code == 1
