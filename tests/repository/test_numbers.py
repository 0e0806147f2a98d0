"""Measured tables say what the results say, which come from this history and from scripts here."""

import json
import re
import subprocess
from pathlib import Path

import pytest

from benchmarks.fill_tables import BLOCK, DOCUMENTS, RESULTS, filled
from benchmarks.run import BENCHMARKS

ROOT = Path(__file__).parents[2]
NUMBERS = sorted(RESULTS.glob("*.json"))


def git(*arguments):
    return subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)
def test_tables_are_those_of_the_results(document):
    text = document.read_text()
    assert text.count("<!-- table:") == text.count("<!-- end -->") == len(BLOCK.findall(text))
    assert filled(text) == text, f"python benchmarks/fill_tables.py would change {document.name}"


def test_every_measured_table_is_one_of_them():
    rest = BLOCK.sub("", (ROOT / "docs" / "results.md").read_text())
    assert not re.search(r"^\|", rest, flags=re.MULTILINE)
    assert {"front"} <= {name for _, name, _ in BLOCK.findall((ROOT / "README.md").read_text())}


@pytest.mark.parametrize("file", NUMBERS, ids=lambda path: path.stem)
def test_results_name_a_commit_of_this_history_and_a_command_that_is_there(file):
    origin = json.loads(file.read_text())["provenance"]
    words = origin["command"].split()
    assert words[0] == "python"
    assert (ROOT / words[1]).is_file()
    if words[1] == "benchmarks/run.py" and "--only" in words:
        assert set(words[words.index("--only") + 1 :]) & set(BENCHMARKS)
    commit = origin["commit"]
    assert not commit.endswith("-dirty"), "measured on sources that are not in the history"
    if git("rev-parse", "--is-shallow-repository").stdout.strip() != "false":
        pytest.skip("no history here: not a clone, or a shallow one")
    assert git("merge-base", "--is-ancestor", commit, "HEAD").returncode == 0
