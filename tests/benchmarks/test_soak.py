"""Twenty thousand steps of the soak, its resumption, and whether it would notice a fault."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
from instances import obstacle, problem, straight_reference
from judge import exact_distances

from benchmarks.audit import _exact, audit
from benchmarks.soak import markdown, run_soak, summarise
from benchmarks.soak_chunk import run_chunk
from benchmarks.soak_worlds import FAULTS, kinds
from scp_mpc import MPC, SCP, InvalidArgumentError, Status

N = 8
REF = straight_reference(N)
WRONG = ("invalid", "lies", "escaped", "traces")


@pytest.mark.slow
def test_twenty_thousand_steps_and_their_resumption(tmp_path):
    shown = []
    total = run_soak(tmp_path, steps=20_000, chunk=1_000, echo=shown.append)
    assert total["steps"] == sum(total["statuses"].values()) == 20_000
    assert {what: total[what] for what in WRONG} == dict.fromkeys(WRONG, 0), total["examples"]
    assert total["statuses"]["CONVERGED"] > 10_000
    assert total["statuses"]["SOFTENED"] > 50
    assert set(total["kinds"]) == {kind.name for kind in kinds()}
    assert set(total["refused"]) == {name for name, *_ in FAULTS}
    assert total["compared"] > 300
    assert all(one["growth_mb"] < 20 for one in total["memory"])  # 10 chunks each: still warming up
    assert 0 < total["median_ms"] < total["p99_ms"] <= 1.1 * total["slowest_ms"]
    assert json.loads((tmp_path / "soak.json").read_text())["steps"] == 20_000
    assert shown[0].count("\n") > 10

    # Stopped in the middle of writing the last line.
    file = tmp_path / "soak.jsonl"
    text = file.read_text()
    file.write_text(text[:-40])
    again = run_soak(tmp_path, steps=20_000, chunk=1_000, workers=1)
    assert len(file.read_text().splitlines()) == 20
    assert file.read_text().startswith(text[: text[:-1].rfind("\n") + 1])
    for key in ("steps", "kinds", "refused"):
        assert again[key] == total[key]
    with pytest.raises(InvalidArgumentError, match="seed 0"):
        run_soak(tmp_path, steps=20_000, chunk=1_000, seed=1)
    with pytest.raises(InvalidArgumentError, match="1000 steps"):
        run_soak(tmp_path, steps=20_000, chunk=500)


@pytest.mark.parametrize("values", [{"steps": 0}, {"workers": 0}, {"chunk": -1}, {"seed": -1}])
def test_bad_soaks_are_refused(values, tmp_path):
    with pytest.raises(InvalidArgumentError, match=next(iter(values))):
        run_soak(tmp_path, **values)


@pytest.fixture(autouse=True)
def logger_as_before():
    """A chunk silences the library in its process, which here is that of the other tests."""
    logger = logging.getLogger("scp_mpc")
    level = logger.level
    yield
    logger.setLevel(level)


def test_nothing_missing_is_nothing_done(tmp_path, monkeypatch):
    file = tmp_path / "soak.jsonl"
    file.write_text(json.dumps(run_chunk(0, 0, 60)) + "\n")
    monkeypatch.setattr("benchmarks.soak.run_chunk", None)
    assert run_soak(tmp_path, steps=60)["steps"] == 60


def solved(obstacles, inflation="exact"):
    case = problem(N, inflation, max_obstacles=2)
    return case, SCP(case).solve(REF[0], REF, obstacles)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_the_audit_finds_what_is_wrong(inflation):
    present = [obstacle(N, (1.6, 0.4)), obstacle(N, (2.5, -2.0))]
    case, plan = solved(present, inflation)
    assert plan.ok
    assert audit(case, REF[0], present, plan) == audit(case, REF[0], [], plan)
    assert not audit(case, REF[0], present, plan).lie

    def found(given=present, **changes):
        return audit(case, REF[0], given, replace(plan, **changes))

    assert "finite" in found(U=plan.U * np.nan).invalid
    assert "shape" in found(U=plan.U[:-1]).invalid
    assert "limit" in found(U=plan.U + 6.0).invalid
    over = plan.U.copy()
    over[0, 0] = np.nextafter(3.0, 4.0)
    assert "limit" in found(U=over).invalid
    assert "follow" in found(X=plan.X + 1e-3).lie
    assert "follow" in found(U=-plan.U).lie
    mirrored = [obstacle(N, (1.6, -0.4)), present[1]]
    assert "violated" in found(mirrored).lie
    a_little = [obstacle(N, (1.6, 0.39)), present[1]]
    assert "violated" in found(a_little).lie
    assert not found(mirrored, status=Status.SOFTENED).lie


def test_the_audit_agrees_with_the_judge():
    """Random ellipsoids, most of them long and thin, in the plane and in space."""
    rng = np.random.default_rng(0)
    for d in (2, 3):
        V = np.linalg.qr(rng.normal(size=(60, d, d)))[0]
        sigma = 10 ** rng.uniform(-4, 1, (60, d))
        Sigma = np.einsum("kij,kj,klj->kil", V, sigma**2, V)
        y = rng.normal(size=(60, d)) * 10 ** rng.uniform(-1, 1.5, (60, 1))
        s, reach = rng.uniform(0, 3, 60), np.full(60, 0.35)
        wanted = exact_distances(y, 0 * y, Sigma, s, 0.35)
        found = _exact(y, Sigma, s, reach)
        assert (found <= wanted + 1e-9).all()
        outside = wanted > -0.35  # of the ellipsoid itself
        np.testing.assert_allclose(found[outside], wanted[outside], atol=1e-8, rtol=1e-8)
        assert outside.any()


def test_the_soak_would_notice_faults(monkeypatch):
    step = MPC.step
    monkeypatch.setattr("benchmarks.soak_chunk._TWIN", 0.0)

    def broken(self, x0, x_ref, obstacles=(), **named):
        plan = step(self, np.nan_to_num(x0), x_ref, obstacles, **named)
        broken.calls += 1
        if broken.calls % 10 == 1:
            return replace(plan, U=plan.U * np.nan)
        if broken.calls % 10 == 2:
            return replace(plan, X=plan.X + 1.0, status=Status.CONVERGED)
        if broken.calls % 10 == 3:
            raise ZeroDivisionError("deep inside")
        return plan

    broken.calls = 0
    monkeypatch.setattr(MPC, "step", broken)
    line = run_chunk(3, 0, 600)
    assert 50 < line["invalid"] < 70
    assert 50 < line["lies"] < 70
    assert line["escaped"] > 50  # with calls that should have been refused
    assert line["examples"]
    assert f"| {line['invalid']} |" in markdown(summarise([line]))


def test_the_soak_would_notice_a_trace_of_a_bad_call(monkeypatch):
    """A controller that forgets its last plan when it is called badly."""
    step = MPC.step

    def forgetful(self, *given, **named):
        try:
            return step(self, *given, **named)
        except InvalidArgumentError:
            self.reset()
            raise

    monkeypatch.setattr("benchmarks.soak_chunk._TWIN", 1.0)
    monkeypatch.setattr("benchmarks.soak_chunk._BAD_CALL", 0.3)
    assert run_chunk(0, 0, 400)["traces"] == 0
    monkeypatch.setattr(MPC, "step", forgetful)
    assert run_chunk(0, 0, 400)["traces"] > 0


def test_chunks_add_up():
    lines = [run_chunk(0, k, 100) for k in range(2)]
    assert lines[0]["bins"] != lines[1]["bins"]
    total = summarise(lines)
    assert total["steps"] == 200
    assert total["slowest_ms"] == 1e3 * max(line["slowest"] for line in lines)
    assert [one["chunks"] for one in total["memory"]] == [2]
    made_up = [line | {"bins": {"-150": 98, "-100": 2}} for line in lines]
    quantiles = summarise(made_up)
    assert quantiles["median_ms"] == pytest.approx(10 ** (1 / 50))
    assert quantiles["p99_ms"] == pytest.approx(10 * 10 ** (1 / 50))
