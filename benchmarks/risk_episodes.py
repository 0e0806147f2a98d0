"""Closed-loop episodes: the true obstacle is one realisation, the controller predicts at each step.

The model, which truth and controller share:

    truth           o(t) = o_0 + t (v + w),  w ~ N(0, Sigma_v) drawn once per episode
    measurement     m_k = o(t_k) + e_k,  e_k ~ N(0, Sigma_e) independent at each step
    prediction      N(m_k + i dt v, Sigma_e + (i dt)^2 Sigma_v): the mean velocity v is known, its
                    error is not, and nothing is learned from earlier measurements

Given m_k alone, that is the distribution of o(t_k + i dt). A promise is about one plan; what an
episode of many plans adds up to is measured, not promised.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.risk_scenes import DT, rotated
from benchmarks.risk_settings import RiskSetting, problem_for
from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.obstacles.predictors import ConstantVelocityPredictor
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.simulation.contact import contacts, robot_path

HORIZON = 8
STEPS = 15
RADIUS = 0.4  # [m] of robot and obstacle alike
_SPEED = 1.5  # [m/s] of the reference
_POSITION_ERROR = (0.10, 0.01)  # [m], the first along a drawn direction
_VELOCITY_ERROR = (0.10, 0.02)  # [m/s], the first along the same direction


@dataclass(frozen=True, eq=False)
class Encounter:
    """A drawn world: the robot drives along the x-axis, the obstacle comes its way.

    Attributes:
        positions: (K+1, 2) true positions of the obstacle [m].
        measured: (K, 2) what the controller is told of them [m].
        velocity: (2,) mean velocity of the obstacle [m/s].
        predictor: What the controller makes of both.
    """

    positions: FloatArray
    measured: FloatArray
    velocity: FloatArray
    predictor: ConstantVelocityPredictor

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Encounter":
        """Draw where the obstacle comes from, slower than the robot; then the errors."""
        bearing, gap = rng.uniform(-0.4, 0.4), rng.uniform(1.4, 1.8)
        start = gap * np.array([np.cos(bearing), np.sin(bearing)])
        velocity = np.array([rng.uniform(0.2, 1.0), -start[1] / rng.uniform(1.0, 3.0)])
        along = rng.choice([-1, 1]) * np.pi / 4
        Sigma_e, Sigma_v = rotated(_POSITION_ERROR, along), rotated(_VELOCITY_ERROR, along)
        error = np.linalg.cholesky(Sigma_v) @ rng.standard_normal(2)
        times = DT * np.arange(STEPS + 1)[:, None]
        positions = start + times * (velocity + error)
        noise = rng.standard_normal((STEPS, 2)) @ np.linalg.cholesky(Sigma_e).T
        predictor = ConstantVelocityPredictor(Sigma_e, Sigma_v)
        return cls(positions, positions[:-1] + noise, velocity, predictor)


@dataclass(frozen=True)
class Outcome:
    """What came of some episodes.

    Attributes:
        episodes: How many.
        contacts: How many of them ended in contact.
        steps: Control steps driven; an episode ends with the first contact.
        unsafe: Those whose plan was not ok, and was followed all the same.
    """

    episodes: int
    contacts: int
    steps: int
    unsafe: int


def episode_problem(setting: RiskSetting) -> Problem:
    """What the controller solves at each step of every episode."""
    return problem_for(setting, DoubleIntegrator(DT), HORIZON, 1, robot_radius=RADIUS)


def drive(setting: RiskSetting, episodes: int, seed: int) -> Outcome:
    """Drive episodes under one promise; all promises meet the same encounters.

    Args:
        setting: The promise.
        episodes: How many.
        seed: Of the encounters.
    """
    mpc = MPC(episode_problem(setting), Settings(deadline=None))
    touched = steps = unsafe = 0
    for episode in range(episodes):
        mpc.reset()
        encounter = Encounter.drawn(np.random.default_rng([seed, episode]))
        touches, ok = _drive_one(mpc, encounter)
        touched += touches
        steps += len(ok)
        unsafe += len(ok) - sum(ok)
    return Outcome(episodes, touched, steps, unsafe)


def _drive_one(mpc: MPC, encounter: Encounter) -> tuple[bool, list[bool]]:
    model = mpc.problem.model
    x, ok = np.array([0.0, _SPEED, 0.0, 0.0]), []
    times = DT * np.arange(HORIZON + 1)
    for k in range(STEPS):
        x_ref = np.zeros((HORIZON + 1, 4))
        x_ref[:, 0], x_ref[:, 1] = _SPEED * (k * DT + times), _SPEED
        told = encounter.predictor.predict(
            encounter.measured[k], encounter.velocity, RADIUS, HORIZON, DT
        )
        plan = mpc.step(x, x_ref, [told])
        ok.append(plan.ok)
        following = model.step(x, plan.u0)
        path = robot_path(model, np.stack([x, following]), plan.u0[None])
        if contacts(path, encounter.positions[None, k : k + 2], 2 * RADIUS).any():
            return True, ok
        x = following
    return False, ok
