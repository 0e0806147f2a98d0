"""See the SCP iterations of one control step: python examples/see_scp_at_work.py [file.png]."""

import sys
from pathlib import Path

import numpy as np

from scp_mpc import SCP, DoubleIntegrator, ObstaclePrediction, Problem, Settings
from scp_mpc.report import history_figure, save

N = 30
robot = DoubleIntegrator(dt=0.2)  # x = [px, vx, py, vy], u = [ax, ay]
problem = Problem(
    robot,
    horizon=N,
    Q=[0.2, 0.05, 0.2, 0.05],
    R=[0.001, 0.001],
    u_min=-3.0,
    u_max=3.0,
    robot_radius=0.15,
)
x, goal = np.zeros(4), np.array([8.0, 0.0, 0.0, 0.0])
means = [[5.0 - 0.1 * i, 0.1] for i in range(N + 1)]  # it comes towards the robot
covariances = [(0.02 + 0.001 * i) * np.eye(2) for i in range(N + 1)]
obstacle = ObstaclePrediction(means, covariances, radius=0.2)

plan = SCP(problem, Settings(history=True)).solve(x, goal, [obstacle])
for k, record in enumerate(plan.history, start=1):
    print(
        f"{k}: cost {record.cost:.4f}, violation {record.violation:.0e} m, "
        f"KKT residual {record.residual:.0e}, {record.iterations} ADMM iterations"
    )
path = Path(sys.argv[1] if len(sys.argv) > 1 else "history.png")
print(f"{plan.status.value} See {save(history_figure(plan), path)}.")
