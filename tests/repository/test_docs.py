"""The code in docs/ runs as printed, and its links and pictures lead somewhere."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").glob("*.md"))
EACH = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def test_there_are_pages():
    assert PAGES


@EACH
def test_code_runs_block_after_block(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where pictures go
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    assert blocks or page.stem == "results"
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, page.name, "exec"), names)
    assert not blocks or names["plan"].ok


@EACH
def test_links_lead_somewhere(page):
    targets = [t for t in re.findall(r"\]\(([^)#]+)", page.read_text()) if "://" not in t]
    assert targets
    for target in targets:
        assert (page.parent / target).exists(), target
    for target, anchor in re.findall(r"\]\(([^):#]*\.md)#([^)]+)\)", page.read_text()):
        titles = re.findall(r"^#+ (.*)$", (page.parent / target).read_text(), flags=re.MULTILINE)
        assert anchor in [re.sub(r"[^a-z -]", "", t.lower()).replace(" ", "-") for t in titles]


def test_the_program_by_hand_leads_to_the_solvers_plan():
    page = (ROOT / "docs" / "programs.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE)
    names: dict[str, object] = {}
    for block in blocks[:3]:
        exec(compile(block, "programs.md", "exec"), names)
    assert abs(names["plan"].U - names["guess"].inputs).max() < 1e-5
