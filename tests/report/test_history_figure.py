"""The figure of the SCP iterations: what is on it, and whom it refuses."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import same_color

from scp_mpc import (
    SCP,
    DoubleIntegrator,
    InvalidArgumentError,
    ObstaclePrediction,
    Polytope,
    Problem,
    Settings,
)
from scp_mpc.report import history_figure
from scp_mpc.report.canvas import HALF_PLANE
from scp_mpc.simulation import SCENARIOS

EXAMPLE = Path(__file__).parents[2] / "examples" / "see_scp_at_work.py"
KEPT = Settings(history=True, deadline=None)


def planned(nodes=1, settings=KEPT, obstacle=None):
    scenario = SCENARIOS["scenario-1"]
    problem = scenario.problem("exact", nodes_per_interval=nodes)
    x_ref = scenario.x_ref(0.4)
    obstacles = scenario.predictions(0.4, 0.2, 30) if obstacle is None else [obstacle]
    return SCP(problem, settings).solve(x_ref[0], x_ref, obstacles)


@pytest.mark.parametrize("nodes", [1, 4])
def test_every_iteration_is_drawn_and_nothing_is_cut_off(nodes):
    plan = planned(nodes)
    figure = history_figure(plan)
    plane, *numbers = figure.axes
    assert plane.get_aspect() == 1.0
    assert [axes.get_ylabel() for axes in (plane, numbers[1])] == ["y [m]", "violation\n[m]"]
    (low_x, high_x), (low_y, high_y) = plane.get_xlim(), plane.get_ylim()
    for record in plan.history:
        assert (record.positions >= [low_x, low_y]).all()
        assert (record.positions <= [high_x, high_y]).all()
        assert any(np.array_equal(line.get_xydata(), record.positions) for line in plane.lines)
    for axes, name in zip(numbers[:4], ("cost", "violation", "residual", "step"), strict=True):
        values = [getattr(record, name) for record in plan.history]
        np.testing.assert_array_equal(axes.lines[0].get_ydata(), values)
    heights = [bar.get_height() for bar in numbers[4].patches]
    assert heights == [record.iterations for record in plan.history]


def test_active_half_planes_touch_the_no_go_sets():
    plane = history_figure(planned(4)).axes[0]
    sets, _ = plane.collections
    edges = [line.get_xydata() for line in plane.lines if same_color(line.get_color(), HALF_PLANE)]
    assert edges
    outlines = np.concatenate([path.vertices for path in sets.get_paths()])
    for start, end in edges:
        along = (end - start) / np.linalg.norm(end - start)
        away = (outlines - start) @ [-along[1], along[0]]
        assert min(abs(away.min()), abs(away.max())) < 0.05


def test_walls_are_outlined_too():
    wall = Polytope([[3.0, 5.0], [5.0, 5.0], [5.0, 9.0], [3.0, 9.0]]).static(30)
    assert history_figure(planned(obstacle=wall)).axes[0].collections


def test_plans_without_iterations_or_in_space_are_refused():
    with pytest.raises(InvalidArgumentError, match="history=True"):
        history_figure(planned(settings=Settings()))
    robot = DoubleIntegrator(dt=0.2, dim=3)
    weights = {"Q": np.ones(6), "R": np.ones(3)}
    problem = Problem(robot, horizon=8, **weights, u_min=-3.0, u_max=3.0, robot_radius=0.1)
    x_ref = np.zeros((9, 6))
    x_ref[:, 0] = np.linspace(0.0, 4.0, 9)
    ball = ObstaclePrediction(np.tile([0.9, 0.1, 0.0], (9, 1)), 0.01 * np.eye(3), 0.3)
    plan = SCP(problem, KEPT).solve(x_ref[0], x_ref, [ball])
    assert plan.history
    with pytest.raises(InvalidArgumentError, match="3 dimensions"):
        history_figure(plan)


def test_the_example_draws(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), str(tmp_path / "history.png")])
    runpy.run_path(str(EXAMPLE))
    assert (tmp_path / "history.png").stat().st_size > 10_000
    assert "KKT residual" in capsys.readouterr().out
