"""The examples: each drives, stays clear, does so again, and is drawn."""

import numpy as np
import pytest

from examples import doorway, flight, overtaking

STEPS = 3
EACH = pytest.mark.parametrize(
    "example", [overtaking, flight, doorway], ids=lambda example: example.__name__
)


@pytest.fixture(scope="module")
def runs():
    return {example: example.drive(STEPS) for example in (overtaking, flight, doorway)}


@EACH
def test_it_drives_clear_of_everything(example, runs):
    run = runs[example]
    assert run.ok.all()
    assert run.clearances.shape == (STEPS, len(run.scene.bodies))
    assert run.clearances.min() > 0
    assert np.linalg.norm(run.positions[-1] - run.positions[0]) > 0.01


@EACH
def test_it_drives_the_same_way_again(example, runs):
    np.testing.assert_array_equal(example.drive(2).states, runs[example].states[:3])


def test_another_seed_is_another_drive(runs):
    assert not np.array_equal(flight.drive(1, seed=1).bodies, runs[flight].bodies[:2])
    other, same = doorway.drive(2, seed=1).predictions[1], runs[doorway].predictions[1]
    assert other[-1].name == same[-1].name
    assert not np.array_equal(other[-1].means, same[-1].means)


@EACH
def test_it_is_drawn(example, runs, tmp_path):
    figure = example.picture(runs[example], steps=(0, 2))
    figure.savefig(tmp_path / "instants.png", dpi=40)
    count = len(example.traces(runs[example]))
    assert len(figure.axes) == 2 + count
    assert all(axes.get_xlabel().endswith("[m]") for axes in figure.axes[:2])
    assert figure.axes[-1].get_xlabel() == "time [s]"
    written = example.animate(runs[example], tmp_path / "run.gif")
    assert written.read_bytes()[:4] == b"GIF8"


@pytest.mark.parametrize("example", [overtaking, doorway], ids=lambda example: example.__name__)
def test_scales_are_equal(example, runs):
    """In space they are by the box's aspect; see `flight.draw`."""
    assert all(axes.get_aspect() == 1 for axes in example.picture(runs[example], (1,)).axes[:1])
