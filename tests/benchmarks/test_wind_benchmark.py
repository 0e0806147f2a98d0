"""A small run of the real comparison under wind."""

import numpy as np
import pytest

from benchmarks import wind
from benchmarks.wind_report import markdown, wind_figure
from benchmarks.wind_variants import (
    ALONE,
    BEST,
    CALM,
    EXACT,
    MAIN,
    NOMINAL,
    OTHERS,
    PREDICTION,
    REPORT,
    Variant,
    measures,
)


def test_variants_are_all_different_and_named_so():
    variants = [*MAIN, *CALM, *ALONE, *PREDICTION, *OTHERS, *EXACT]
    assert len({variant.name for variant in variants}) == len(variants)
    assert (MAIN[0].horizon, MAIN[0].rejects, MAIN[0].terminal_input_weight) == (30, False, None)
    assert all(row.disturbance == "report's wind" for row in MAIN)


def test_all_variants_meet_the_same_wind():
    runs = [variant.run(seed=3, steps=5) for variant in (NOMINAL, BEST)]
    pushed = [
        run.states[1:]
        - [run.problem.model.step(x, u) for x, u in zip(run.states, run.inputs, strict=False)]
        for run in runs
    ]
    np.testing.assert_allclose(*pushed, atol=1e-12)
    assert np.abs(pushed[0]).max() > 0.02
    assert np.abs(runs[0].inputs - runs[1].inputs).max() > 0.02


def test_without_a_disturbance_rejection_is_no_worse():
    """Long enough to pass the obstacle, for which an N of 8 is short."""
    nominal, plain, best = (
        measures(Variant(8, rejects, "none", terminal_input_weight), 0, 100)
        for rejects, terminal_input_weight in (
            (False, None),
            (True, None),
            (True, BEST.terminal_input_weight),
        )
    )
    assert nominal["rms"] > 0.5
    assert plain["rms"] == pytest.approx(nominal["rms"], abs=1e-6)
    assert best["rms"] < nominal["rms"]
    assert not any(run["slack"] or run["not_ok"] for run in (nominal, plain, best))


def test_the_reports_way_is_the_last_plans():
    ours, report = (Variant(30, False, multi_start=sides).run(0, 12) for sides in (True, False))
    assert Variant(30, False, multi_start=False) == REPORT
    assert max(len(plan.candidates) for plan in ours.plans[1:]) > 1
    assert not any(plan.candidates for plan in report.plans)


def test_a_row_says_how_far_it_is_from_the_reports_way():
    variants = [Variant(8, False), Variant(8, True), Variant(8, False, multi_start=False)]
    runs = [
        {"rms": rms, "median": rms, "clearance": 0.0, "distance": 0.0}
        | dict.fromkeys(("contact", "slack", "not_ok"), 0)
        for rms in (1.0, 0.7, 3.0)
    ]
    row = wind.summary(variants[1], [runs[1]], [runs[0]], [runs[2]])
    assert (row["excess"], row["beyond"]) == pytest.approx((-0.3, -2.3))
    assert "beyond" not in wind.summary(variants[1], [runs[1]], [runs[0]])
    assert "-2.300 (-2.300 to -2.300)" in markdown({"main": [row]}, 40)


def test_measured_rows_are_kept_and_shown(tmp_path):
    variants = (Variant(8, False, obstacle=False), Variant(8, True, obstacle=False))
    store = tmp_path / "wind.jsonl"
    rows = wind.measured(variants, seeds=3, steps=40, store=store)
    assert rows[1]["usual"] < rows[0]["usual"]
    assert rows[0]["excess"] == 0
    assert rows[1]["excess"] == pytest.approx(rows[1]["rms_mean"] - rows[0]["rms_mean"])
    assert rows[1]["rms_interval"][0] <= rows[1]["rms_mean"] <= rows[1]["rms_interval"][1]
    assert (rows[0]["runs"], rows[0]["contact"], len(rows[0]["rms"])) == (3, 0, 3)
    run = variants[1].run(1, 40)
    expected = np.sqrt(np.mean(run.tracking_errors[1:] ** 2))
    assert rows[1]["rms"][1] == pytest.approx(expected)
    before = store.read_text()
    assert wind.measured(variants, seeds=3, steps=40, store=store) == rows
    assert store.read_text() == before
    text = markdown({"main": rows, "others": []}, 40)
    assert text.count("\n| 8 |") == 2
    assert len({line.count("|") for line in text.splitlines() if line.startswith("|")}) == 1
    figure = wind_figure(rows, rows)
    assert len(figure.axes) == 3
    assert len(wind_figure(rows).axes) == 2


def test_interval_of_a_mean_covers_it():
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(100):
        low, high = wind.interval(rng.standard_normal(40))
        inside += low <= 0 <= high
    assert 86 <= inside <= 100
