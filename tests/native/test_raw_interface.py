"""The C interface trusts nobody: bad members and inputs are named, and it stays in its block."""

from types import SimpleNamespace

import numpy as np
import pytest
from instances import problem
from native import needs_core

from scp_mpc import CovarianceError, DoubleIntegrator, Polytope, Settings
from scp_mpc.arrays import require_positive_semidefinite
from scp_mpc.native.constants import constants
from scp_mpc.native.core import NativeCore, _filled
from scp_mpc.native.library import Inputs, library

pytestmark = needs_core

N, NAN, INF = 4, np.nan, np.inf
SETTINGS = Settings(deadline=None)
ROBOT = problem(
    N,
    model=DoubleIntegrator(dt=0.2),
    max_obstacles=2,
    nodes_per_interval=2,
    du_min=-1.0,
    du_max=[1.0, INF],
    x_max=[1.0, INF, 2.0, INF],
    x_soft=True,
)
VALUES = constants(ROBOT, SETTINGS, 0.1)
TRIANGLE = Polytope([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
NUMBERS = {
    "version": (0, 2),
    "model": (-1, 4),
    "horizon": (0, -1, 2**31 - 1),
    "nx": (0, -1),
    "dim": (1, 4),
    "max_obstacles": (-1, 2**31 - 1),
    "instants": (0,),
    "discs": (0, 3),
    "dt": (0.0, NAN, INF, 1e-12),
    "heading": (-2, 4),
    "robot_radius": (-0.1, NAN),
    "inflation": (-1, 2),
    "s_min": (-1.0, 5.0, NAN),
    "s_max": (1.0, INF),
    "joint_risk": (-0.1, 0.5, NAN),
    "slack_weight": (0.0, NAN),
    "max_corners": (2, 2**31 - 1),
    "tolerance": (0.0, NAN),
    "max_programs": (0,),
    "multi_start": (2,),
    "deadline": (-1.0, INF),
}
ARRAYS = {
    "position": (-1, 4),
    "A": (NAN, 1e16),
    "between_x": (INF,),
    "Q": (-1.0, NAN),
    "u_min": (5.0, NAN),
    "du_min": (0.1, NAN, INF),
    "du_max": (-0.1, -INF),
    "row_max": (NAN, -INF),
    "row_soft": (2,),
    "moving": (NAN,),
}


def refused(**changes):
    """The name of the member that is refused."""
    struct, kept = _filled(VALUES | changes)
    wrong = library().scp_check(struct)
    assert (library().scp_size(struct) > 0) == (not wrong)
    assert len(kept)
    return library().scp_name(wrong).decode()


def test_bad_members_are_named():
    assert not refused()
    for name, values in NUMBERS.items():
        for value in values:
            assert refused(**{name: value}) == name
    for name, values in ARRAYS.items():
        optional = name == "moving"
        assert refused(**{name: None}) == ("" if optional else name)
        for value in values:
            changed = np.array(VALUES[name])
            changed.flat[0] = value
            wanted = "u_max" if (name, value) == ("u_min", 5.0) else name
            assert refused(**{name: changed}) == wanted


def test_it_stays_in_its_block_and_leaves_no_byte_to_chance():
    core, (struct, kept) = library(), _filled(VALUES)
    size, made = core.scp_size(struct), []
    for before in (0, 0xAB):
        block = np.full(size + 256, before, dtype=np.uint8)
        begin = -block.ctypes.data % 64 + 64
        at = block.ctypes.data + begin
        assert not core.scp_setup(struct, at, size - 1)
        assert not core.scp_setup(struct, at + 8, size)
        assert not core.scp_setup(struct, None, size)
        assert core.scp_setup(struct, at, size) == at
        assert (block[:begin] == before).all()
        assert (block[begin + size :] == before).all()
        words = block[begin : begin + size // 8 * 8].view(np.int64)
        made.append(SimpleNamespace(at=at, words=words))
    one, two = made  # but for addresses within the block they are equal
    moved = (two.words - one.words)[one.words != two.words]
    assert (moved == two.at - one.at).all()
    assert len(kept)


@pytest.fixture
def core():
    made = NativeCore(ROBOT, SETTINGS, room=[TRIANGLE])
    views, inputs = made.views, made.inputs
    for name in ("x0", "x_ref", "u_last", "robot_covariance"):
        views[name][:] = 0.0
    views["means"][:] = [[[1.5, 0.1]], [[3.0, 1.0]]]
    views["covariances"][:], views["radii"][:] = 0.01 * np.eye(2), 0.2
    made.set_shapes([TRIANGLE, None])
    inputs.count, inputs.has_u_last, inputs.has_robot_covariance = 2, 1, 1
    assert made.solve(0, True, False) is None
    return made


def test_bad_inputs_are_named_and_nothing_happens(core):
    names, before = [name for name, _ in Inputs._fields_], bytes(core.outputs)
    bad = dict.fromkeys(
        ("x0", "x_ref", "u_last", "means"), (NAN, INF, 1100000000000000.0, -1100000000000000.0)
    )
    bad |= dict.fromkeys(("robot_covariance", "corner", "offset"), (NAN, INF))
    bad |= {"radii": (NAN, -1e-9), "covariances": (NAN, -0.1), "normal": (NAN, 3.0)}
    bad |= {"shape": (-2, 99), "corners": (2, 99), "faces": (2, 99)}
    for name, values in bad.items():
        for value in values:
            view = core.views[name]
            kept, view.flat[0] = view.flat[0], value
            assert core.solve(0, True, False) == name
            view.flat[0] = kept
    for name, values in {"count": (-1, 3), "shapes": (0, 99)}.items():
        for value in values:
            kept = getattr(core.inputs, name)
            setattr(core.inputs, name, value)
            assert core.solve(0, True, False) == name
            setattr(core.inputs, name, kept)
    assert bytes(core.outputs) == before
    count = names.index("has_robot_covariance")
    known = [library().scp_input_name(k + 1).decode() for k in range(count)]
    assert known == names[: len(known)]
    assert core.solve(0, True, False) is None


@pytest.mark.parametrize("dim", [2, 3])
def test_covariances_are_refused_by_pythons_rule(dim):
    model = DoubleIntegrator(dt=0.2, dim=dim)
    robot = problem(1, model=model, margin=None, Q=np.ones(model.nx), R=np.ones(model.nu))
    core, rng = NativeCore(robot, SETTINGS), np.random.default_rng(0)
    core.inputs.count = 1
    refusals = 0
    for _ in range(300):
        basis = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
        least = rng.choice([-1.0, -2e-9, -5e-10, 0.0, 1.0])
        spread = np.append(rng.uniform(0.9, 1.0, dim - 1) * rng.choice([0.0, 1.0]), least)
        Sigma = (basis * spread) @ basis.T * 10.0 ** rng.integers(-9, 9)
        Sigma[0, 1] += rng.choice([0.0, 5e-10, 3e-9]) * np.abs(Sigma).max()
        try:
            require_positive_semidefinite("covariances", Sigma[None])
            wanted = None
        except CovarianceError:
            wanted = "covariances"
        core.views["covariances"][0] = Sigma
        assert core.solve(0, False, False) == wanted
        refusals += wanted is not None
    assert 0 < refusals < 300
