"""The README's example runs as printed, and its links lead somewhere."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_there_is_an_example():
    assert EXAMPLES
    lines = [line for line in EXAMPLES[0].splitlines() if line.strip()]
    assert len(lines) <= 15


def test_examples_run_one_after_the_other(capsys):
    names: dict[str, object] = {}
    for example in EXAMPLES:
        exec(compile(example, "README.md", "exec"), names)
        assert names["plan"].ok
    assert str(names["plan"].status) in capsys.readouterr().out


def test_links_within_the_project_lead_somewhere():
    targets = re.findall(r"\]\(([^)#]+)", README) + re.findall(r'src="([^"]+)"', README)
    local = [t for t in targets if "://" not in t]
    assert len(local) >= 4
    for target in local:
        assert (ROOT / target).exists(), target
