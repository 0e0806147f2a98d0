"""The race: who takes part, what is counted of a loop that is driven several times, going on."""

import numpy as np
import pytest

from benchmarks import race, run
from benchmarks.peers import PeerMissingError
from benchmarks.race import COURSES, Course, Planned, markdown, rows
from scp_mpc import SCP, InvalidArgumentError
from scp_mpc.simulation import SCENARIOS

SHORT = (Course("N = 8", SCENARIOS["scenario-2"]),)
TIMES = iter(())


class Stub:
    """Our plans without obstacles, at times that were agreed on; disowns its third one."""

    label = "stub"

    def __init__(self, problem):
        self._solver, self._count = SCP(problem), 0

    def plan(self, given):
        plan = self._solver.solve(given.x0, given.x_ref)
        self._count += 1
        seconds = next(TIMES) if self._count else 0.0
        s = np.full(len(given.radii), 2.0)
        told = {"ok": self._count != 3, "shaped": self._count % 2 == 0}
        return Planned(seconds, 0.5 * seconds, plan.X, plan.U, s, **told)

    def reset(self):
        self._count = 0


def missing(problem):
    raise PeerMissingError("ghost", f"nobody has seen it at N = {problem.horizon}")


@pytest.fixture
def stub(monkeypatch):
    """A stub, timed in two repeats of three steps, each after a warm-up, and a missing engine."""
    first, second = (9.0, 1e-3, 3e-3, 4e-3), (9.0, 2e-3, 1e-3, 6e-3)
    monkeypatch.setitem(globals(), "TIMES", iter(first + second))
    monkeypatch.setattr(race, "ENGINES", {"stub": (Stub, "black"), "ghost": (missing, "red")})


@pytest.mark.usefixtures("stub")
def test_least_and_plain_times_by_hand(tmp_path):
    mine, ghost = rows(3, repeats=2, courses=SHORT, store=tmp_path / "race.jsonl")
    assert mine["least_us"] == pytest.approx({"median": 1e3, "p99": 3.94e3, "max": 4e3})
    assert mine["processor_us"]["max"] == pytest.approx(2e3)
    assert mine["first_us"] == pytest.approx(500)
    assert mine["plain_us"]["median"] == pytest.approx(2.5e3)
    assert mine["plain_us"]["max"] == pytest.approx(6e3)
    assert (mine["steps"], mine["repeats"], mine["failures"]) == (3, 2, 1)
    assert (mine["shaped"], mine["shaped_us"]) == (1, pytest.approx(1e3))
    assert mine["deviation"] == 0
    problem = SHORT[0].problem
    x, cost = SHORT[0].world.start(), 0.0
    for k in range(3):
        x_ref = SHORT[0].world.x_ref(0.2 * k)
        plan = SCP(problem).solve(x, x_ref)
        cost += problem.cost(plan.X, plan.U, np.full(1, 2.0), x_ref)
        x = problem.model.step(x, plan.u0)
    assert mine["cost"] == pytest.approx(cost)
    assert ghost["missing"] == "ghost is not installed; nobody has seen it at N = 8"
    text = markdown([mine, ghost])
    assert "| N = 8 | stub | 1,000 / 3,940 / 4,000 | 500 / 1,970 / 2,000 | 1,000 in 1 steps" in text
    assert "Without ghost (N = 8): ghost is not installed; nobody has seen it at N = 8." in text


@pytest.mark.usefixtures("stub")
def test_an_interrupted_race_goes_on(monkeypatch, tmp_path):
    store = tmp_path / "race.jsonl"
    rows(3, repeats=1, courses=SHORT, store=store)
    both = rows(3, repeats=2, courses=SHORT, store=store)
    assert next(TIMES, None) is None  # the first repeat was not driven again
    monkeypatch.setattr(race, "_race", lambda *_: pytest.fail("driven again"))
    assert rows(3, repeats=2, courses=SHORT, store=store) == both


def test_ours_and_ipopt_race(monkeypatch, tmp_path):
    engines = {name: race.ENGINES[name] for name in ("osqp", "ipopt")}
    monkeypatch.setattr(race, "ENGINES", engines)
    monkeypatch.setattr(race, "in_one_thread", lambda _, *given: race.rows(*given))
    monkeypatch.setattr(race, "COURSES", SHORT)
    shown = []
    run.run("race", tmp_path, 6, 0, shown.append)
    assert (tmp_path / "race.md").read_text().rstrip("\n") == shown[0]
    assert (tmp_path / "race.png").read_bytes().startswith(b"\x89PNG")
    assert "| N = 8 | scp_mpc, osqp |" in shown[0]
    assert "| N = 8 | ipopt |" in shown[0]
    ours, ipopt = rows(6, repeats=1, courses=SHORT)
    assert ours["failures"] == ipopt["failures"] == 0
    assert ours["cost"] == pytest.approx(ipopt["cost"], rel=1e-4)  # of one side, so far
    assert ours["shaped"] == ipopt["shaped"] > 0


def test_no_scene_of_that_name(tmp_path):
    with pytest.raises(InvalidArgumentError, match="N = 9"):
        race.main(tmp_path, 1, 0, scenes=["N = 9"])


def test_all_engines_get_the_same_problem_on_round_obstacles():
    for course in COURSES:
        if course.nodes == 1 and course.problem.max_obstacles > 1:
            told = course.world.predictions(0.0, course.problem.model.dt, course.problem.horizon)
            for one in told:
                np.testing.assert_allclose(one.covariances[:, 0, 1], 0.0)
                np.testing.assert_allclose(one.covariances[:, 0, 0], one.covariances[:, 1, 1])
