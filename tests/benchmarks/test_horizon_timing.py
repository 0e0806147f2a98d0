"""The script benchmarks/horizon_timing.py on a few steps: rows, files, and life without CasADi."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOLVERS = ("scp_mpc", "scp_mpc, one start", "ipopt", "slsqp")
EVERYBODY = [(solver, horizon) for horizon in (8, 30) for solver in SOLVERS]


def run(out, steps, **environment):
    """Cells of the printed table and the rows of the file."""
    command = [sys.executable, "benchmarks/horizon_timing.py", "--steps", steps, "--out", out]
    done = subprocess.run(
        list(map(str, command)),
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == (out / "horizon_timing.md").read_text()
    assert (out / "horizon_timing.png").read_bytes().startswith(b"\x89PNG")
    content = json.loads((out / "horizon_timing.json").read_text())
    assert content["provenance"]["machine"] in done.stdout
    lines = [line for line in done.stdout.splitlines() if line.startswith("| ")][1:]
    return [line.strip("| ").split(" | ") for line in lines], content["rows"]


def test_everybody_has_a_row_per_horizon(tmp_path):
    cells, rows = run(tmp_path, 3)
    assert [(name, int(N)) for name, N, *_ in cells] == EVERYBODY
    assert [(row["solver"], row["horizon"]) for row in rows] == EVERYBODY
    for row in rows:
        assert (row["steps"], row["every"], row["failures"]) == (3, 1, 0)
        assert 0 < row["median_ms"] <= row["p99_ms"] <= row["max_ms"]
        if row["solver"] == "scp_mpc":  # the others end in worse local optima at N = 30
            assert row["max_cost_gap"] < 1e-3
        assert row["max_violation"] < 1e-6
        yardstick = next(other for other in rows if other["horizon"] == row["horizon"])
        assert row["ratio"] == pytest.approx(row["median_ms"] / yardstick["median_ms"])
        assert (row["programs"] is not None) == row["solver"].startswith("scp_mpc")


@pytest.mark.slow
def test_without_casadi_its_row_says_so(tmp_path):
    (tmp_path / "casadi.py").write_text("raise ImportError('not here')")
    cells, rows = run(tmp_path, 1, PYTHONPATH=str(tmp_path))
    assert [(name, int(N)) for name, N, *_ in cells] == EVERYBODY
    for line, row in zip(cells, rows, strict=True):
        assert (line[-1] == "not installed") == (row["solver"] == "ipopt")
        assert (row["median_ms"] is None) == (row["solver"] == "ipopt")
