"""Any sequence of calls: good steps, bad ones, resets, late ones, obstacles that come and go.

After each good step: the input is finite and within its limits, the status is true (`judge.py`),
and the plan is bit for bit that of a twin that never saw a bad call.
"""

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)
from judge import judge
from worlds import covariances, problems, steps

from scp_mpc import (
    MPC,
    InvalidArgumentError,
    NotFiniteError,
    ObstaclePrediction,
    Settings,
    ShapeError,
    Status,
)
from scp_mpc.qp.backend import ProgramSolver

SETTINGS = {
    "plain": Settings(deadline=None),
    "one side": Settings(deadline=None, multi_start=False),
    "piqp": Settings(deadline=None, solver="piqp", multi_start=False),
    "late": Settings(deadline=1e-6),  # so early that every step is late in the same way
    "short": Settings(deadline=None, max_iterations=2),
}


class Control(RuleBasedStateMachine):
    """A controller among bad calls, and its twin without them."""

    @initialize(data=st.data(), kind=st.sampled_from(sorted(SETTINGS)))
    def build(self, data, kind):
        self.problem = data.draw(problems(horizons=(3, 8), most=2))
        settings = SETTINGS[kind]
        self.mpc, self.twin = MPC(self.problem, settings), MPC(self.problem, settings)
        self.step, self.plan = data.draw(steps(self.problem)), None

    @rule(data=st.data())
    def another_world(self, data):
        """Other obstacles, more or fewer of them; the robot is somewhere else."""
        self.step = data.draw(steps(self.problem))

    @rule(data=st.data())
    def one_moves(self, data):
        """The same world a moment later, the last obstacle known differently."""
        if self.step.obstacles:
            last = self.step.obstacles[-1]
            self.step.obstacles[-1] = ObstaclePrediction(
                last.means + 0.05, data.draw(covariances(2)), last.radius
            )

    @rule()
    def names(self):
        """From now on those that vanish are known by name, and kept."""
        known = [replace(o, name=f"{j}") for j, o in enumerate(self.step.obstacles)]
        self.step.obstacles[:] = known

    @rule()
    def one_vanishes(self):
        del self.step.obstacles[:1]

    @precondition(lambda self: self.step.obstacles)
    @rule()
    def too_old(self):
        """All predictions are from before the first step: the robot brakes, whatever else."""
        old = [replace(o, stamp=-9.0) for o in self.step.obstacles]
        given = self.step.x0, self.step.x_ref, old
        mine, other = self.mpc.step(*given), self.twin.step(*given)
        assert mine.status is Status.STALE
        assert not mine.ok
        assert equal(mine, other)

    @rule(repeats=st.integers(1, 3))
    def good(self, repeats):
        for _ in range(repeats):
            self.check(self.mpc.step(*self.step.given), self.twin.step(*self.step.given))

    @rule()
    def late(self):
        """The solver dawdles; time may not matter to what is found unless there is a deadline."""
        solve = ProgramSolver.solve

        def slow(solver, *given):
            time.sleep(1e-4)
            return solve(solver, *given)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ProgramSolver, "solve", slow)
            mine = self.mpc.step(*self.step.given)
        self.check(mine, self.twin.step(*self.step.given))

    @precondition(lambda self: self.plan is not None)
    @rule()
    def drive_on(self):
        """Apply the input, as a loop would."""
        x = self.problem.model.step(self.step.x0, self.plan.u0)
        object.__setattr__(self.step, "x0", x)

    @rule()
    def reset(self):
        self.mpc.reset()
        self.twin.reset()
        fresh = MPC(self.problem, self.mpc.settings)
        mine, other = self.mpc.step(*self.step.given), self.twin.step(*self.step.given)
        self.check(mine, other)
        assert equal(mine, fresh.step(*self.step.given))

    @rule(bad=st.sampled_from([np.nan, np.inf, -np.inf]), where=st.integers(0, 3))
    def not_finite(self, bad, where):
        x0, x_ref, obstacles = self.step.given
        spoilt = np.where(np.arange(4) == where, bad, x0)
        self.refused(NotFiniteError, spoilt, x_ref, obstacles)
        self.refused(NotFiniteError, x0, spoilt, obstacles)

    @rule()
    def shapes(self):
        x0, x_ref, obstacles = self.step.given
        self.refused(ShapeError, x0[:3], x_ref, obstacles)
        self.refused(ShapeError, x0, np.zeros((self.problem.horizon, 4)), obstacles)
        long = ObstaclePrediction(np.zeros((self.problem.horizon + 2, 2)), np.eye(2), 0.1)
        self.refused(ShapeError, x0, x_ref, [long])

    @rule()
    def things(self):
        x0, x_ref, obstacles = self.step.given
        self.refused(InvalidArgumentError, x0, x_ref, [None])
        self.refused(InvalidArgumentError, "here", x_ref, obstacles)
        self.refused(InvalidArgumentError, x0, x_ref, 7)

    @rule()
    def too_many(self):
        x0, x_ref, _ = self.step.given
        one = ObstaclePrediction(np.ones((self.problem.horizon + 1, 2)), np.eye(2), 0.1)
        self.mpc.step(x0, x_ref, [one] * 3)
        assert self.twin.step(x0, x_ref, [one] * 3).left_out >= 3 - self.problem.max_obstacles

    @rule()
    def breaks_off(self):
        """The caller's own iterator fails in the middle of reading."""

        def broken():
            yield from self.step.obstacles
            raise RuntimeError("sensor")

        with pytest.raises(RuntimeError, match="sensor"):
            self.mpc.step(self.step.x0, self.step.x_ref, broken())

    def refused(self, error, *given):
        with pytest.raises(error):
            self.mpc.step(*given)

    def check(self, plan, other):
        assert np.isfinite(plan.u0).all()
        assert (plan.u0 >= self.problem.u_min).all()
        assert (plan.u0 <= self.problem.u_max).all()
        known = list(self.mpc.obstacles)  # those given, and those kept
        if not self.step.obstacles or self.step.obstacles[0].name is None:
            assert len(known) >= len(self.step.obstacles)
        assert judge(self.problem, self.step.x0, self.step.x_ref, known, plan).complaints == []
        assert equal(plan, other)
        self.plan = plan


def equal(first, second):
    """Whether two plans are the same, bit for bit."""
    parts = ("X", "U", "s", "slack")
    return first.status is second.status and all(
        getattr(first, part).tobytes() == getattr(second, part).tobytes() for part in parts
    )


@pytest.mark.parametrize("examples", [25, pytest.param(100, marks=pytest.mark.slow)])
def test_any_sequence_of_calls(examples):
    run_state_machine_as_test(
        Control,
        settings=hypothesis_settings(
            max_examples=examples,
            stateful_step_count=25,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
