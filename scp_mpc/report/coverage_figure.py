"""Coverage over lead time: how much the ellipses hold, and how large the errors are."""

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

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
