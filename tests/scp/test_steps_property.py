"""Any single step: a finite input within its limits, and a status that is true."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from judge import judge
from worlds import problems, steps

from scp_mpc import SCP, Settings

KINDS = [
    Settings(),
    Settings(multi_start=False, max_iterations=1),
    Settings(solver="piqp", multi_start=False),
    Settings(solver="piqp", max_iterations=1),
    Settings(deadline=1e-6),
    Settings(solver="piqp", deadline=1e-6),
]


def profile(examples):
    return hypothesis_settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def hold(problem, step, settings):
    plan = SCP(problem, settings).solve(*step.given)
    assert np.isfinite(plan.u0).all(), plan.status
    assert (plan.u0 >= problem.u_min).all(), plan.u0 - problem.u_min
    assert (plan.u0 <= problem.u_max).all(), plan.u0 - problem.u_max
    assert judge(problem, *step.given, plan).complaints == []


@pytest.mark.parametrize(
    "settings", KINDS, ids=["default", "one", "piqp", "piqp one", "no time", "piqp no time"]
)
@profile(40)
@given(st.data())
def test_in_the_plane(settings, data):
    problem = data.draw(problems(horizons=(3, 8)))
    hold(problem, data.draw(steps(problem)), settings)


@profile(15)
@given(st.data())
def test_in_space(data):
    problem = data.draw(problems(dim=3, horizons=(1, 5)))
    hold(problem, data.draw(steps(problem)), data.draw(st.sampled_from([KINDS[0], KINDS[2]])))


@pytest.mark.slow
@profile(1000)
@given(st.data())
def test_many_in_the_plane(data):
    problem = data.draw(problems())
    hold(problem, data.draw(steps(problem)), data.draw(st.sampled_from(KINDS)))


@pytest.mark.slow
@profile(300)
@given(st.data())
def test_many_in_space(data):
    problem = data.draw(problems(dim=3, horizons=(1, 5)))
    hold(problem, data.draw(steps(problem)), data.draw(st.sampled_from([KINDS[0], KINDS[2]])))
