"""One control step as a picture: where everything is, what is planned, what is forbidden.

The artists are created once and moved from step to step, which is several times faster than
drawing anew.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Polygon

from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.report.canvas import HALF_PLANE, OBSTACLE, PLAN, REFERENCE, ROBOT
from scp_mpc.report.outline import no_go_outline
from scp_mpc.simulation.closed_loop import ClosedLoop

_FADING = (1.0, 0.7, 0.5, 0.35, 0.2)  # opacity of the no-go sets along the horizon
_HALF_LENGTH, _DEPTH = 1.2, 0.35  # [m] of a half-plane's edge and of its shading


class Scene:
    """The artists on one pair of axes.

    Args:
        axes: Where to draw.
        run: What to draw.
        start: Control step at which the travelled path begins.
        half_planes: How many active half-planes to draw at most.
    """

    def __init__(self, axes: Axes, run: ClosedLoop, start: int, half_planes: int) -> None:
        """Create the artists; `show` gives them their places."""
        self._run, self._start = run, start
        stages = np.linspace(0, run.problem.horizon, len(_FADING)).round()
        self._stages = [int(stage) for stage in stages]
        circle = run.reference[:, run.problem.model.position]
        axes.plot(*circle.T, color=REFERENCE, linewidth=4, alpha=0.6, label="reference")
        self._sets = [_polygon(axes, OBSTACLE, alpha) for alpha in _FADING]
        self._sets[0].set(alpha=None, fill=True, facecolor=(*to_rgb(OBSTACLE), 0.15))
        self._sets[0].set_label("no-go sets, now and predicted")
        (self._path,) = axes.plot([], [], color=ROBOT, linewidth=1.5, label="travelled")
        (self._plan,) = axes.plot(
            [], [], ".-", color=PLAN, linewidth=1.2, markersize=5, label="planned"
        )
        self._shades = [_polygon(axes, HALF_PLANE, 0.25, filled=True) for _ in range(half_planes)]
        self._edges = [
            axes.plot([], [], color=HALF_PLANE, linewidth=2.5)[0] for _ in range(half_planes)
        ]
        if self._edges:
            self._edges[0].set_label("active half-planes")
        self._obstacle = Circle((0, 0), run.scenario.obstacle.radius, color=OBSTACLE, zorder=4)
        self._robot = Circle((0, 0), run.problem.robot_radius, color=ROBOT, zorder=5)
        axes.add_patch(self._obstacle)
        axes.add_patch(self._robot)

    def show(self, k: int) -> None:
        """Move everything to where it is at control step k."""
        run, plan, prediction = self._run, self._run.plans[k], self._run.predictions[k]
        self._robot.center = tuple(run.positions[k])
        self._obstacle.center = tuple(run.obstacle[k])
        self._path.set_data(*run.positions[self._start : k + 1].T)
        self._plan.set_data(*plan.X[:, run.problem.model.position].T)
        for patch, stage in zip(self._sets, self._stages, strict=True):
            patch.set_xy(no_go_outline(run.problem, prediction, stage, float(plan.s[0])))
        strips = active_half_planes(run, k)
        for index, (shade, edge) in enumerate(zip(self._shades, self._edges, strict=True)):
            strip = strips[index] if index < len(strips) else np.full((4, 2), np.nan)
            shade.set_xy(strip)
            edge.set_data(*strip[:2].T)


def _polygon(axes: Axes, color: str, opacity: float, filled: bool = False) -> Polygon:
    width = 0.0 if filled else 1.2
    patch = Polygon(np.zeros((4, 2)), color=color, alpha=opacity, fill=filled, linewidth=width)
    axes.add_patch(patch)
    return patch


def active_half_planes(run: ClosedLoop, k: int) -> list[FloatArray]:
    """Return a strip (4, 2) [m] of each half-plane that holds the plan of step k back.

    The first two corners lie on the edge, next to the planned position; the others on the
    forbidden side. Half-planes are about the plan itself, so that their edges touch it.
    """
    plan = run.plans[k]
    if plan.multipliers is None:
        return []
    step, i = plan.step, np.flatnonzero(plan.iterate.touched[0])
    positions = step.nodes.positions(plan.X, plan.U)[i]
    sets = NoGoSets.pairs(step.means[0, i + 1], step.covariances[0, i + 1], step.radii[0, i])
    start = np.tile(step.here - step.means[0, 0], (len(i), 1))
    s = np.full(len(i), plan.iterate.s[0])
    spaces = run.problem.no_go.linearise(sets, positions[:, None], s, start)
    strips = []
    for p, normal, value in zip(positions, spaces.normal[:, 0], spaces.value[:, 0], strict=True):
        length = np.linalg.norm(normal)
        n = normal / length
        foot = p - value / length * n
        along = _HALF_LENGTH * np.array([-n[1], n[0]])
        edge = np.stack([foot - along, foot + along])
        strips.append(np.concatenate([edge, edge[::-1] - _DEPTH * n]))
    return strips
