"""Coverage: how often the truth lay within the predicted ellipses, as a table and a figure."""

from dataclasses import asdict
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from scp_mpc.provenance import provenance
from scp_mpc.report.canvas import (
    HALF_PLANE,
    LIMIT,
    OBSTACLE,
    PLAN,
    ROBOT,
    legend_below,
    new_figure,
    tidy,
)
from scp_mpc.simulation.coverage import Coverage

_COLORS = (ROBOT, PLAN, OBSTACLE, HALF_PLANE)


def coverage_figure(coverage: Coverage) -> Figure:
    """Draw the measured share of each level with two standard errors, and the errors' size."""
    figure = new_figure(10.0, 4.8)
    figure.suptitle(
        f"{coverage.people} people, {coverage.leads[0].samples} predictions; "
        f"measured every {coverage.interval:g} s with errors of {100 * coverage.noise:g} cm"
    )
    shares, errors = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    times = [row.lead for row in coverage.leads]
    for k, level in enumerate(coverage.levels):
        color = _COLORS[k % len(_COLORS)]
        shares.axhline(level, color=color, linestyle="--", linewidth=1)
        shares.errorbar(
            times,
            [row.shares[k] for row in coverage.leads],
            [2 * row.errors[k] for row in coverage.leads],
            color=color,
            marker="o",
            markersize=4,
            capsize=2,
            linewidth=1.2,
            label=f"within the {100 * level:g} % ellipse (dashed: promised)",
        )
    shares.set_ylim(min(0.4, *(share for row in coverage.leads for share in row.shares)), 1.0)
    shares.yaxis.set_major_formatter(PercentFormatter(1.0))
    shares.set_ylabel("share of true positions")
    errors.plot(
        times, [row.rms_error for row in coverage.leads], "o-", color=LIMIT, label="error, rms"
    )
    errors.plot(
        times,
        [row.rms_predicted for row in coverage.leads],
        "--",
        color=HALF_PLANE,
        label="error as predicted, rms",
    )
    errors.set_ylim(0.0, None)
    errors.set_ylabel("distance [m]")
    for axes in (shares, errors):
        tidy(axes)
        axes.set_xlabel("lead time [s]")
    legend_below(figure, (shares, errors), columns=2)
    return figure


def coverage_table(coverage: Coverage) -> list[list[str]]:
    """Return header and rows, ready to be printed; shares with their standard error."""
    header = [
        "Lead\n[s]",
        "Samples",
        "People",
        "Mean\nerror\n[m]",
        "RMS\nerror\n[m]",
        "Pre-\ndicted\n[m]",
    ]
    header += ["NEES", *(f"within\n{100 * level:g} %\n[%]" for level in coverage.levels)]
    rows = [
        [
            f"{row.lead:.1f}",
            str(row.samples),
            str(row.people),
            f"{row.mean_error:.2f}",
            f"{row.rms_error:.2f}",
            f"{row.rms_predicted:.2f}",
            f"{row.nees:.2f}",
            *(
                f"{100 * share:.1f}±{100 * error:.1f}"
                for share, error in zip(row.shares, row.errors, strict=True)
            ),
        ]
        for row in coverage.leads
    ]
    return [header, *rows]


def coverage_numbers(coverage: Coverage) -> dict[str, Any]:
    """Return everything, ready for JSON."""
    return {**asdict(coverage), "provenance": provenance()}
