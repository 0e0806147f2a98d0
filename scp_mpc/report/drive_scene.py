"""One control step of a drive as a picture, in the plane or in space.

The artists are created once and moved from step to step.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from scp_mpc.arrays import FloatArray
from scp_mpc.report.canvas import LIMIT, OBSTACLE, PLAN, REFERENCE, ROBOT
from scp_mpc.report.outline import no_go_outline
from scp_mpc.simulation.drive import Drive, disc_centres

_FADING = (0.5, 0.3, 0.16)  # opacity of the no-go sets, from the first stage shown to the last


class PlanarScene:
    """The artists of a drive in the plane.

    Args:
        axes: Where to draw.
        run: What to draw.
        walls: How many of the bodies, the first ones, stand still and are drawn as walls.
        outline: (nv, 2) the robot's corners in its own frame [m]; its discs if None.
    """

    def __init__(
        self, axes: Axes, run: Drive, walls: int = 0, outline: FloatArray | None = None
    ) -> None:
        """Create the artists; `show` gives them their places."""
        self._run, self._outline = run, outline
        N = run.problem.horizon
        self._stages = [round(N * share) for share in (1 / 3, 2 / 3, 1.0)]
        for body in run.bodies[:walls]:
            assert body.shape is not None
            corners = body.shape.vertices + body.means[0]
            axes.add_patch(Polygon(corners, facecolor="0.55", edgecolor="0.3", zorder=1))
        self._movers = run.bodies[walls:]
        most = max(len(told) for told in run.predictions)
        self._walls = walls
        self._sets = [[self._patch(axes, alpha) for alpha in _FADING] for _ in range(most - walls)]
        (self._reference,) = axes.plot([], [], color=REFERENCE, linewidth=4, alpha=0.6)
        (self._path,) = axes.plot([], [], color=ROBOT, linewidth=1.8)
        (self._plan,) = axes.plot([], [], ".-", color=PLAN, linewidth=1.4, markersize=5, zorder=6)
        self._bodies: list[Polygon | Circle] = []
        for body in self._movers:
            patch: Polygon | Circle
            if body.shape is None:
                patch = Circle((0.0, 0.0), body.radius, color=OBSTACLE, zorder=4)
            else:
                patch = Polygon(body.shape.vertices, color=OBSTACLE, zorder=4)
            axes.add_patch(patch)
            self._bodies.append(patch)
        radius = run.problem.robot_radius
        self._discs = [
            Circle((0, 0), radius, facecolor="none", edgecolor=ROBOT, linewidth=0.8, zorder=5)
            for _ in run.problem.discs
        ]
        for disc in self._discs:
            axes.add_patch(disc)
            if outline is None:
                disc.set_facecolor(ROBOT)
        self._robot = Polygon(np.zeros((4, 2)), color=ROBOT, zorder=5, visible=outline is not None)
        axes.add_patch(self._robot)
        (self._nose,) = axes.plot([], [], color="white", linewidth=1.6, zorder=6)

    def show(self, k: int) -> None:
        """Move everything to where it is at control step k."""
        run, model = self._run, self._run.problem.model
        x, plan = run.states[k], run.plans[min(k, len(run.plans) - 1)]
        told = run.predictions[min(k, len(run.plans) - 1)][self._walls :]
        for patch, body in zip(self._bodies, self._movers, strict=True):
            at = body.means[k]
            if isinstance(patch, Circle):
                patch.center = tuple(at)
            else:
                assert body.shape is not None
                patch.set_xy(body.shape.vertices + at)
        for j, patches in enumerate(self._sets):
            for patch, stage in zip(patches, self._stages, strict=True):
                if j < len(told):
                    s = run.problem.size_for(run.problem.max_obstacles, 1)
                    patch.set_xy(no_go_outline(run.problem, told[j], stage, s))
                else:
                    patch.set_xy(np.full((4, 2), np.nan))
        self._path.set_data(*run.positions[: k + 1].T)
        self._plan.set_data(*plan.X[:, model.position].T)
        self._reference.set_data(*run.references[min(k, len(run.plans) - 1)][:, model.position].T)
        for disc, centre in zip(
            self._discs, disc_centres(model, x, run.problem.discs), strict=True
        ):
            disc.center = tuple(centre)
        if model.heading is None:
            return
        c, s = np.cos(x[model.heading]), np.sin(x[model.heading])
        turn = np.array([[c, -s], [s, c]])
        p = x[model.position]
        if self._outline is not None:
            self._robot.set_xy(self._outline @ turn.T + p)
        else:
            nose = p + run.problem.robot_radius * turn[:, 0]
            self._nose.set_data(*np.stack([p, nose], axis=1))

    def _patch(self, axes: Axes, alpha: float) -> Polygon:
        patch = Polygon(np.zeros((4, 2)), facecolor="none", edgecolor=OBSTACLE, alpha=alpha)
        patch.set_linewidth(1.2)
        axes.add_patch(patch)
        return patch


def limit_lines(axes: Axes, *values: float) -> None:
    """Dashed lines at bounds."""
    for value in values:
        axes.axhline(value, color=LIMIT, linestyle="--", linewidth=0.9)
