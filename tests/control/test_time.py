"""Time: the default deadline, pauses, old plans and budgets, by a clock that is handed in."""

import subprocess
import sys

import numpy as np
import pytest
from instances import obstacle, problem, straight_reference

from scp_mpc import MPC, SCP, InvalidArgumentError, Settings, Status

N = 10
TICK = 2e-5  # [s] that each look at the clock takes


class Timer:
    """A clock that goes on by itself, with one pause."""

    def __init__(self, pause=None, seconds=0.06):
        self.looks, self.now, self.pause, self.seconds = 0, 0.0, pause, seconds

    def __call__(self):
        self.looks += 1
        self.now += TICK + (self.seconds if self.looks == self.pause else 0.0)
        return self.now


def ahead(x):
    """Somebody just ahead, always."""
    return [obstacle(N, (x[0] + 1.0, 0.05), (0.8, 0.0))]


def drive(mpc, steps):
    x, plans = np.array([0.0, 1.5, 0.0, 0.0]), []
    for _ in range(steps):
        plans.append(mpc.step(x, straight_reference(N) + [x[0], 0, 0, 0], ahead(x)))
        x = mpc.problem.model.step(x, plans[-1].u0)
    return plans


def old(plan):
    return plan.status in (Status.PREVIOUS, Status.BRAKING)


def test_the_default_deadline_of_a_controller_is_the_sampling_interval():
    """Read in a process of its own: here the default is not to have one."""
    code = (
        "from scp_mpc import MPC, SCP, DoubleIntegrator, Problem, Settings\n"
        "p = Problem(DoubleIntegrator(0.2), horizon=3, Q=1.0, R=1.0, u_min=-1, u_max=1)\n"
        "s = Settings()\n"
        "print(s.deadline, s.time_limit(0.2), s.time_limit(), MPC(p).settings.deadline)\n"
    )
    code = code.replace("Q=1.0, R=1.0", "Q=[1.0] * 4, R=[1.0] * 2")
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["dt", "0.2", "None", "dt"]
    with pytest.raises(InvalidArgumentError, match="deadline"):
        Settings(deadline="soon")


def test_steps_end_within_the_interval_on_the_clock_that_is_given():
    """A slow clock: each look takes 2 ms, of an interval of 200."""
    this, timer = problem(N), Timer()
    mpc = MPC(this, Settings(deadline="dt"), timer)
    drive(mpc, 5)
    per_step = timer.now / 5
    slow = Timer(pause=None)
    slow_tick = 0.15 / (per_step / TICK)

    def lagging():
        slow.looks += 1
        slow.now += 2 * slow_tick
        return slow.now

    hurried = MPC(this, Settings(deadline="dt"), lagging)
    plans = drive(hurried, 30)
    assert sum(plan.timing.total > 0.2 for plan in plans[3:]) <= 3
    assert hurried.overruns == sum(plan.timing.total > 0.2 for plan in plans)


@pytest.mark.parametrize("share", np.linspace(0.02, 0.98, 5))
def test_a_pause_costs_at_most_a_few_steps(share):
    """60 ms under a deadline of 10 ms, at any point of a step: planning again within five."""
    this, count = problem(N), Timer()
    settings = Settings(deadline=0.01)
    mpc = MPC(this, settings, count)
    drive(mpc, 8)
    begun = count.looks
    drive(mpc, 1)
    looks = count.looks - begun
    timer = Timer(pause=begun + 1 + int(share * looks))
    paused = MPC(this, settings, timer)
    plans = drive(paused, 30)
    assert timer.looks > timer.pause
    assert sum(plan.timing.total > 0.05 for plan in plans) <= 1
    assert sum(map(old, plans)) <= 5
    assert not any(map(old, plans[14:]))


def test_replayed_counts_and_brakes_in_the_end():
    """Without any time, the last plan is followed for so many steps; then the robot brakes."""
    this, timer = problem(30), Timer()
    mpc = MPC(this, Settings(deadline=1.0, max_replayed=3), timer)
    x, ref = np.array([0.0, 1.0, 0.0, 0.0]), straight_reference(30, 1.0)
    near = [obstacle(30, (4.0, 0.1), covariance=0.01 * np.eye(2), growth=0.0)]
    first = mpc.step(x, ref, near)
    assert first.ok
    assert mpc.replayed == 0
    x = this.model.step(x, first.u0)
    timer.seconds, seen = 0.0, []
    mpc._deadline = 1e-9
    for _ in range(8):
        plan = mpc.step(x, ref + [x[0], 0, 0, 0], near)
        seen.append((plan.status.name, mpc.replayed))
        x = this.model.step(x, plan.u0)
    names = [name for name, _ in seen]
    assert names == ["PREVIOUS"] * 3 + ["BRAKING"] * 5
    assert [count for _, count in seen] == list(range(1, 9))
    assert abs(x[1]) < 1e-6
    mpc.reset()
    assert mpc.replayed == 0


def test_a_budget_bounds_the_programs_of_a_step():
    crowd = [obstacle(N, (1.0 + 0.5 * k, 0.3 * (-1) ** k), (-1.0, 0.0)) for k in range(5)]
    this, ref = problem(N, max_obstacles=5), straight_reference(N, 3.0)
    for budget in (1, 5, 20):
        plan = SCP(this, Settings(max_programs=budget)).solve(ref[0], ref, crowd)
        spent = {name: count for name, count in plan.qps.items() if name not in ("kkt", "cut")}
        # An iteration solves one program, and once more where obstacles or states have to yield.
        assert sum(spent.values()) <= 3 * budget
    with pytest.raises(InvalidArgumentError, match="max_programs"):
        Settings(max_programs=0)
