"""The command line, from its arguments to its files."""

import importlib
import json
import sys

import pytest
from typer.testing import CliRunner

import scp_mpc.cli
from scp_mpc import __version__
from scp_mpc.report import FIGURES

SCENARIO_NAMES = ["scenario-1", "scenario-2", "scenario-3", "scenario-4"]


def invoke(*arguments):
    return CliRunner().invoke(scp_mpc.cli.app, [str(argument) for argument in arguments])


def test_version():
    result = invoke("--version")
    assert result.exit_code == 0
    assert result.output == f"scp-mpc {__version__}\n"


def test_report_writes_everything(tmp_path):
    out = tmp_path / "new" / "report"
    result = invoke("report", "--out", out, "--steps", 12)
    assert result.exit_code == 0, result.output
    pictures = {figure.file_name for figure in FIGURES}
    assert len(pictures) == 14
    files = {file.name: file.stat().st_size for file in out.iterdir()}
    assert set(files) == pictures | {"summary.json", "summary.md", "scenario-4.gif"}
    assert min(files.values()) > 500
    summary = json.loads((out / "summary.json").read_text())
    assert [row["name"] for row in summary["scenarios"]] == SCENARIO_NAMES
    assert [row["horizon"] for row in summary["scenarios"]] == [30, 8, 8, 30]
    assert all(row["steps"] == 12 for row in summary["scenarios"])
    assert str(out) in result.output.replace("\n", "")
    assert "[mm]" in result.output  # units survive the console's markup


def test_report_passes_its_options_on(tmp_path, monkeypatch):
    monkeypatch.setattr(scp_mpc.cli, "write_figures", lambda *_: [])
    options = [
        "--inflation",
        "exact",
        "--s-min",
        1.5,
        "--seed",
        3,
        "--no-multi-start",
        "--no-animation",
    ]
    result = invoke("report", "--out", tmp_path, "--steps", 2, *options)
    assert result.exit_code == 0, result.output
    assert not list(tmp_path.glob("*.gif"))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["inflation"] == "exact"
    assert summary["margin"]["lower"] == 1.5
    assert summary["seed"] == 3
    assert summary["settings"]["multi_start"] is False


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--steps", 0], "steps: 0 is less than 1"),
        (["--seed", -1], "seed: -1 is negative"),
        (["--inflation", "round"], "inflation: 'round' is none of"),
        (["--s-min", -0.1], "margin.lower"),
        (["--s-min", 5], "margin.reference"),
        (["--s-min", "nan"], "margin.lower: nan is not finite"),
    ],
)
def test_bad_value_gives_one_line_and_writes_nothing(tmp_path, options, message):
    out = tmp_path / "out"
    result = invoke("report", "--out", out, *options)
    assert result.exit_code == 1
    assert result.output.startswith(f"error: {message}")
    assert result.output.count("\n") == 1
    assert not out.exists()


def test_directory_that_cannot_be_made_gives_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    result = invoke("report", "--out", tmp_path / "file", "--steps", 1)
    assert result.exit_code == 1
    assert result.output.startswith("error: ")
    assert result.output.count("\n") == 1


def test_value_of_the_wrong_kind_is_a_usage_error(tmp_path):
    result = invoke("report", "--out", tmp_path, "--steps", "many")
    assert result.exit_code == 2
    assert "--steps" in result.output
    assert "Traceback" not in result.output


@pytest.mark.parametrize("package", ["typer", "rich.console", "tqdm"])
def test_without_its_extra_the_command_line_says_what_to_install(package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "scp_mpc.cli")
    with pytest.raises(SystemExit, match="the extra 'cli'"):
        importlib.import_module("scp_mpc.cli")
