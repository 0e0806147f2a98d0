"""The report: arithmetic of the summary, and what the pictures show."""

import json
import subprocess
import sys
from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from scp_mpc import MPC, InvalidArgumentError, ObstaclePrediction, Settings, Status
from scp_mpc.geometry import NoGoSets
from scp_mpc.report import (
    FIGURES,
    summarise,
    write_animation,
    write_figures,
    write_summary,
)
from scp_mpc.report.animation import active_half_planes
from scp_mpc.report.encounters import find_encounters, spans_of
from scp_mpc.report.figures import (
    duration_figure,
    input_figure,
    size_figure,
    trajectory_figure,
    velocity_figure,
)
from scp_mpc.report.outline import no_go_outline
from scp_mpc.report.summary import markdown_table, summarise_all
from scp_mpc.simulation import SCENARIOS, Crowd, simulate

STEPS = 12
KEYS = [
    "name",
    "horizon",
    "steps",
    "rms_tracking_error_m",
    "min_distance_m",
    "min_clearance_m",
    "s_low",
    "s_high",
    "slack_steps",
    "max_slack_m",
    "median_ms",
    "p99_ms",
    "max_ms",
    "over_200_ms",
    "statuses",
    "certified_share",
]


@pytest.fixture(scope="module")
def run():
    """The robot closes in on the obstacle from step 3 on and is closest at the end."""
    return SCENARIOS["scenario-2"].run(steps=STEPS)


@pytest.fixture(scope="module")
def by_hand(run):
    """Three steps with numbers chosen so that every entry can be computed on paper."""
    plan = run.plans[0]
    slack = np.zeros_like(plan.slack)
    softened = slack.copy()
    softened[0, 2] = 0.25
    circles = ObstaclePrediction(np.zeros((9, 2)), np.tile(0.04 * np.eye(2), (9, 1, 1)), radius=0.2)
    return replace(
        run,
        # tracking errors 0, 3, 4 m; distances 5, 4, 3, 5 m
        states=np.array([[5.0, 0, 0, 0], [4.0, 0, 0, 0], [0, 0, 3.0, 0], [5.0, 0, 0, 0]]),
        references=[
            np.tile(row, (9, 1)) for row in ([5.0, 0, 0, 0], [1.0, 0, 0, 0], [0, 0, -1.0, 0])
        ],
        bodies=np.zeros((4, 1, 2)),
        inputs=np.zeros((3, 2)),
        predictions=[[circles]] * 3,
        plans=[
            replace(plan, s=np.array([2.5]), slack=slack, status=Status.CONVERGED),
            replace(plan, s=np.array([2.25]), slack=softened, status=Status.SOFTENED),
            replace(plan, s=np.array([2.75]), slack=slack, status=Status.FEASIBLE),
        ],
        seconds=np.array([0.002, 0.201, 0.2]),
    )


def test_summary_of_a_run_computed_by_hand(by_hand):
    row = summarise(by_hand)
    assert list(row) == KEYS
    assert row["name"] == "scenario-2"
    assert (row["horizon"], row["steps"]) == (8, 3)
    assert row["rms_tracking_error_m"] == pytest.approx(sqrt((9 + 16) / 3))
    assert row["min_distance_m"] == pytest.approx(3.0)
    # A circle of radius s_ref * 0.2 + 0.15 + 0.2, seen from 3 m.
    assert row["min_clearance_m"] == pytest.approx(3.0 - (sqrt(5.991) * 0.2 + 0.35))
    assert (row["s_low"], row["s_high"]) == (2.25, 2.75)
    assert (row["slack_steps"], row["max_slack_m"]) == (1, 0.25)
    assert row["median_ms"] == pytest.approx(200.0)
    assert row["p99_ms"] == pytest.approx(200.98)  # 200 + 0.98 * (201 - 200)
    assert row["max_ms"] == pytest.approx(201.0)
    assert row["over_200_ms"] == 1  # 200 ms sharp is in time
    assert row["statuses"] == {"converged": 1, "softened": 1, "feasible": 1}
    assert row["certified_share"] == 0.5  # of the two steps without slack


def test_nothing_can_be_certified_where_every_step_needs_slack(by_hand):
    slack = np.full_like(by_hand.plans[0].slack, 1e-3)
    row = summarise(replace(by_hand, plans=[replace(p, slack=slack) for p in by_hand.plans]))
    assert row["certified_share"] is None
    assert "| none |" in markdown_table([row])


def test_written_summary_holds_rows_and_provenance(run, tmp_path):
    contents = write_summary([run], tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text()) == contents
    assert [list(row) for row in contents["scenarios"]] == [KEYS]
    assert contents["seed"] == 0
    assert contents["inflation"] == "axes"
    assert contents["settings"]["tolerance"] == run.settings.tolerance
    assert contents["settings"]["qp"]["rho"] == list(run.settings.qp.rho)
    assert contents["margin"]["lower"] == pytest.approx(sqrt(5.991))
    assert {"machine", "cores", "python", "osqp", "commit"} <= set(contents["provenance"])
    text = (tmp_path / "summary.md").read_text()
    assert markdown_table(contents["scenarios"]) in text
    assert f"scp-mpc {contents['provenance']['scp-mpc']}" in text


def test_runs_that_cannot_share_one_summary_are_refused(run):
    with pytest.raises(InvalidArgumentError, match="none to summarise"):
        summarise_all([])
    with pytest.raises(InvalidArgumentError, match="same settings"):
        summarise_all([run, replace(run, settings=Settings(tolerance=1e-4))])
    with pytest.raises(InvalidArgumentError, match="same settings"):
        summarise_all([run, replace(run, seed=1)])


def test_markdown_table_has_one_cell_per_column(by_hand):
    header, rule, row = markdown_table([summarise(by_hand)]).splitlines()
    for line in (header, rule, row):
        assert line.startswith("| ")
        assert line.endswith(" |")
        assert line.count("|") == 16
    cells = dict(zip(header.split(" | "), row.split(" | "), strict=True))
    assert cells["RMS tracking error [m]"] == "2.887"
    assert cells["Max slack [mm]"] == "250.0"
    assert cells["s"] == "2.2500 to 2.7500"
    assert cells["Certified [%]"] == "50.0"
    assert cells["Over 200 ms"] == "1"
    assert "1 converged, 1 feasible, 1 softened" in row


def test_certified_percentage_is_never_rounded_up_to_100(by_hand):
    row = summarise(by_hand) | {"certified_share": 0.9999}
    assert "| 99.9 |" in markdown_table([row])


@pytest.mark.parametrize("inflation", ["axes", "exact"])
@pytest.mark.parametrize("stage", [0, 1, 8])
def test_outline_lies_on_the_boundary_of_the_no_go_set(run, inflation, stage):
    problem = run.scene.problem(inflation)
    prediction = run.predictions[0][0]
    outline = no_go_outline(problem, prediction, stage, problem.margin.reference)
    assert outline[0] == pytest.approx(outline[-1])
    # The same geometry as the solver's, told to look at that stage only.
    only = ObstaclePrediction(
        prediction.means[[stage]].repeat(2, axis=0),
        prediction.covariances[[stage]].repeat(2, axis=0),
        radius=prediction.radius,
    )
    sets = NoGoSets.now([only], problem.robot_radius)
    distances = [problem.no_go.clearance(sets, point[None])[0, 0] for point in outline]
    assert np.abs(distances).max() < 1e-9


@pytest.mark.parametrize("s", [0.0, 1.0, 2.5])
def test_exact_outline_extends_by_the_support_function(run, s):
    outline = no_go_outline(run.scene.problem("exact"), run.predictions[0][0], 0, s)
    # s sqrt(n' Sigma n) + r on either side, with the report's Sigma and r = 0.15 + 0.2
    width, height = 2 * (s * sqrt(0.5) + 0.35), 2 * (s * sqrt(0.2) + 0.35)
    assert np.ptp(outline, axis=0) == pytest.approx([width, height], rel=1e-3)


def test_outline_of_a_position_known_exactly_is_a_disc(run):
    point = ObstaclePrediction(np.ones((9, 2)), np.zeros((9, 2, 2)), radius=0.2)
    disc = no_go_outline(run.scene.problem("exact"), point, 0, 3.0)
    assert np.linalg.norm(disc - 1, axis=1) == pytest.approx(0.35)


def test_outline_of_a_prediction_in_space_is_refused(run):
    solid = ObstaclePrediction(np.zeros((9, 3)), np.tile(np.eye(3), (9, 1, 1)), radius=0.2)
    with pytest.raises(ValueError, match="3 dimensions"):
        no_go_outline(run.problem, solid, 0, 1.0)


def test_spans():
    spans = spans_of(np.array([True, True, False, True]))
    assert [span.tolist() for span in spans] == [[0, 1], [3]]
    assert spans_of(np.zeros(3, dtype=bool)) == []


def test_encounters_are_runs_within_reach(run):
    # Reach: 2.4477 * sqrt(0.6854) + 0.35 = 2.38 m along the longest axis.
    distances = np.array([9.0, 2.3, 1.0, 2.0, 2.5, 9, 9, 2.2, 1.5, 9, 9, 9, 0.1])
    apart = run.bodies[:, 0] + distances[:, None] * np.array([1.0, 0.0])
    states = run.states.copy()
    states[:, run.problem.model.position] = apart
    assert find_encounters(replace(run, states=states)) == [2, 8]


def test_without_encounter_the_closest_step_stands_in(run):
    apart = run.positions + [[5.0 - k, 9] for k in range(13)]
    assert find_encounters(replace(run, bodies=apart[:, None])) == [5]


def test_runs_of_another_scene_are_refused():
    crowd = Crowd(8, 1)
    with pytest.raises(InvalidArgumentError, match="a Crowd, not"):
        summarise(simulate(MPC(crowd.problem()), crowd, steps=1))


def test_figures_are_written_and_not_blank(run, tmp_path):
    files = write_figures([run], tmp_path)
    wanted = [o.file_name for o in FIGURES if o.scenario == "scenario-2"]
    assert [file.name for file in files] == wanted
    assert len(wanted) == 4
    for file in files:
        picture = imread(file)[..., :3]
        assert min(picture.shape[:2]) > 400
        assert (picture.min(axis=-1) < 0.9).mean() > 0.01


def test_trajectories_have_equal_axes(run):
    figure = trajectory_figure(run)
    figure.canvas.draw()
    assert len(figure.axes) == 2
    for axes in figure.axes:
        (x0, y0), (x1, y1) = axes.transData.transform([(0, 0), (1, 1)])
        assert x1 - x0 == pytest.approx(y1 - y0)
        assert axes.get_xlabel() == "x [m]"
        low, high = axes.get_xlim()
        assert high - low == pytest.approx(np.diff(axes.get_ylim())[0])


def test_trajectory_shows_each_set_with_the_size_of_its_plan(run):
    fixed = trajectory_figure(run).axes[0].patches[0]
    grown = replace(run, plans=[replace(plan, s=1.5 * plan.s) for plan in run.plans])
    larger = trajectory_figure(grown).axes[0].patches[0]
    assert np.ptp(larger.get_xy(), axis=0) == pytest.approx(
        # s only stretches the ellipse, not the radii 0.15 + 0.2
        np.ptp(
            no_go_outline(run.problem, run.predictions[11][0], 0, 1.5 * run.plans[11].s[0]), axis=0
        )
    )
    assert (np.ptp(larger.get_xy(), axis=0) > 1.2 * np.ptp(fixed.get_xy(), axis=0)).all()


@pytest.mark.parametrize(
    "draw", [trajectory_figure, size_figure, input_figure, velocity_figure, duration_figure]
)
def test_legend_covers_no_data_and_nothing_is_clipped(run, draw):
    figure = draw(run)
    figure.canvas.draw()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
    for axes in figure.axes:
        extent = axes.get_tightbbox()
        assert extent.x0 >= 0
        assert extent.y0 >= 0
        assert extent.x1 <= figure.bbox.x1
        assert extent.y1 <= figure.bbox.y1


def test_inputs_are_drawn_with_their_bounds(run):
    for row, axes in enumerate(input_figure(run).axes):
        lower, upper, applied = axes.lines
        assert set(lower.get_ydata()) == {-3.0}
        assert set(upper.get_ydata()) == {3.0}
        assert (applied.get_ydata() == run.inputs[:, row]).all()
        assert "[m/s²]" in axes.get_ylabel()


def test_velocities_are_drawn_with_the_reference(run):
    for column, axes in zip((1, 3), velocity_figure(run).axes, strict=True):
        reference, robot = axes.lines
        assert list(reference.get_ydata()) == [x_ref[0, column] for x_ref in run.references]
        assert (robot.get_ydata() == run.states[:, column]).all()


def test_size_and_slack_are_drawn_as_they_are(by_hand):
    size, violation = size_figure(by_hand).axes
    curves = {line.get_label(): line.get_ydata() for line in size.lines}
    assert list(curves["s"]) == [2.5, 2.25, 2.75]
    assert curves[r"$s_\mathrm{ref}$"][0] == pytest.approx(sqrt(5.991))
    assert list(violation.lines[0].get_ydata()) == [0.0, 250.0, 0.0]  # [mm]


def test_durations_are_drawn_on_a_logarithmic_axis_with_the_sampling_time(by_hand):
    (axes,) = duration_figure(by_hand).axes
    assert axes.get_yscale() == "log"
    limit, *_, durations = axes.lines
    assert limit.get_ydata()[0] == pytest.approx(200.0)
    assert durations.get_ydata() == pytest.approx([2.0, 201.0, 200.0])


def test_active_half_planes_touch_the_plan_and_forbid_the_obstacle(run):
    seen = 0
    for k in range(STEPS):
        positions = run.plans[k].X[1:, run.problem.model.position]
        for strip in active_half_planes(run, k):
            edge = strip[1] - strip[0]
            n = np.array([-edge[1], edge[0]]) / np.linalg.norm(edge)
            n *= np.sign(n @ (strip[0] - strip[3]))  # away from the shading
            assert np.abs((positions - strip[0]) @ n).min() < 1e-5
            means = run.predictions[k][0].means[1:]
            nearest = means[np.linalg.norm(means - strip.mean(axis=0), axis=1).argmin()]
            assert (nearest - strip[0]) @ n < 0
            seen += 1
    assert seen >= 5


def test_no_half_plane_is_drawn_where_no_multiplier_is_known(run):
    k = 8
    assert len(active_half_planes(run, k))
    plan = run.plans[k]
    unknown = replace(plan, iterate=replace(plan.iterate, multipliers=None))
    plans = [*run.plans[:k], unknown, *run.plans[k + 1 :]]
    assert active_half_planes(replace(run, plans=plans), k).shape == (0, 4, 2)


def test_animation_has_one_frame_per_step(run, tmp_path):
    path = write_animation(run, tmp_path / "run.gif")
    with Image.open(path) as gif:
        assert gif.n_frames == STEPS
        assert gif.info["duration"] == 100
        first = np.asarray(gif.convert("RGB"))
        gif.seek(STEPS - 1)
        last = np.asarray(gif.convert("RGB"))
    assert first.shape == last.shape
    assert (first != last).any(axis=-1).mean() > 0.001
    assert first[0, 0].min() > 250


def test_report_needs_neither_pyplot_nor_a_display():
    code = "import sys, scp_mpc.report; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
