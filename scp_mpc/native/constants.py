"""A problem and settings in the numbers of `scp_problem`, for the binding and for the export."""

from dataclasses import replace
from typing import Any

import numpy as np

from scp_mpc.geometry.margin import JointRisk, Margin
from scp_mpc.models.bicycle import KinematicBicycle
from scp_mpc.models.linear import LinearModel
from scp_mpc.models.model import Model
from scp_mpc.models.unicycle import Unicycle
from scp_mpc.native.library import AXES, BICYCLE, EXACT, LINEAR, OWN_MODEL, UNICYCLE, VERSION
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings

# Room for the shape of one obstacle.
CORNERS, FACES, EDGES = 16, 16, 24
_COUNTS = "max_iterations", "max_candidates", "max_programs", "max_replayed", "multi_start_interval"
# Those of control/backup.py.
BACKUP_SECONDS = 4.0
BACKUP_SPEEDS = 2.0 ** np.arange(-3, 5)


def constants(
    problem: Problem, settings: Settings, deadline: float | None = None
) -> dict[str, Any]:
    """Members of `scp_problem` by name, numbers and arrays; all others are zero or NULL.

    Args:
        problem: The problem.
        settings: How to solve it.
        deadline: Of a step [s]; None for none.
    """
    model, margin, size = problem.model, problem.margin, problem.size
    M, count = problem.max_obstacles, problem.nodes_per_interval * len(problem.discs)
    velocity = () if model.velocity is None else model.velocity
    (low, high), here = problem.row_bounds, np.zeros(model.dim)
    values: dict[str, Any] = {
        "version": VERSION,
        "horizon": problem.horizon,
        "nx": model.nx,
        "nu": model.nu,
        "dim": model.dim,
        "max_obstacles": M,
        "instants": problem.nodes_per_interval,
        "discs": len(problem.discs),
        "dt": model.dt,
        "position": np.array(model.position, dtype=np.intc),
        "heading": -1 if model.heading is None else model.heading,
        "velocity": np.array(velocity, dtype=np.intc),
        "velocities": len(velocity),
        "Q": problem.Q,
        "R": problem.R,
        "Qf": problem.Qf,
        "rest": model.equilibrium_input,
        "moving": np.stack([model.state(here, v * np.eye(model.dim)[0]) for v in BACKUP_SPEEDS]),
        "u_min": problem.u_min,
        "u_max": problem.u_max,
        "limits_rates": int(problem.limits_rates),
        "du_min": problem.du_min,
        "du_max": problem.du_max,
        "rows": len(problem.state_rows),
        "row": problem.state_rows,
        "row_min": low,
        "row_max": high,
        "row_soft": problem.soft_rows.astype(np.uint8),
        "robot_radius": problem.robot_radius,
        "disc": problem.discs,
        "inflation": EXACT if problem.inflation == "exact" else AXES,
        "s_ref": size.reference,
        "s_min": size.lower,
        "s_max": size.upper,
        "s_weight": size.weight,
        "growth_time": problem.growth_time or 0.0,
        "slack_weight": problem.slack_weight,
        "state_slack_weight": problem.state_slack_weight,
        "max_shapes": M,
        "max_corners": CORNERS,
        "max_faces": FACES,
        "max_edges": EDGES,
        "tolerance": settings.tolerance,
        "multi_start": int(settings.multi_start),
        "deadline": deadline or 0.0,
    }
    for name in _COUNTS:
        values[name] = min(getattr(settings, name), np.iinfo(np.intc).max)
    if not isinstance(margin, Margin):
        long = max(problem.horizon, int(np.ceil(BACKUP_SECONDS / model.dt)))
        for name, owner in ("sizes", problem), ("backup_sizes", replace(problem, horizon=long)):
            values[name] = np.array([owner.size_for(j, count) for j in range(M + 1)])
    if isinstance(margin, JointRisk) and margin.allocation == "iterative":
        values["joint_risk"] = margin.delta
    return values | _robot(model, problem)


def _robot(model: Model, problem: Problem) -> dict[str, Any]:
    """Which robot it is, and what that needs; `OWN_MODEL` needs callbacks besides."""
    if isinstance(model, LinearModel):
        C, D, bend_x, bend_u = model.within(problem.nodes_per_interval)
        most = np.maximum(np.abs(problem.u_min), np.abs(problem.u_max))
        bent = (np.abs(bend_u) @ most).reshape(-1, model.dim)
        return {
            "model": LINEAR,
            "A": model.A,
            "B": model.B,
            "stopping": -np.stack([model.stopping_input(x) for x in np.eye(model.nx)], axis=1),
            "between_x": C,
            "between_u": D,
            "bend_x": bend_x,
            "bend_u": bend_u,
            "most_deviation": float(np.linalg.norm(bent, axis=1).max()),
        }
    if type(model) is Unicycle:  # whoever derives from it may have changed it
        return {"model": UNICYCLE}
    if type(model) is KinematicBicycle:
        parts = {name: getattr(model, name) for name in ("wheelbase", "rear", "substeps")}
        return {"model": BICYCLE, **parts}
    return {"model": OWN_MODEL}
