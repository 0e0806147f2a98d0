"""Settings of the tracker: how obstacles move, and when tracks begin and end."""

from dataclasses import dataclass

from scipy.special import gammaincinv

from scp_mpc.arrays import as_count, as_number
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.obstacles.motion import Motion
from scp_mpc.settings import require_positive

WALKING = (Motion(density=0.007), Motion(density=0.11, weight=0.2))
WALKING_AND_TURNING = (
    *WALKING,
    Motion(density=0.007, turn_rate=0.35, weight=0.03),
    Motion(density=0.007, turn_rate=-0.35, weight=0.03),
)


@dataclass(frozen=True)
class TrackerSettings:
    """How a tracker works.

    The default motions are for people who walk: straight on most of the time, and now and then
    restless. Densities, weights and sojourn have the largest likelihood of what a recorded street
    scene (148 people, 5.8 at a time) did 0.4 to 4.8 s ahead, seen each 0.4 s with errors of 5 cm.
    Fitted to its first half, they lose 0.02 nats per sample on the second against those fitted to
    all of it. Against one constant velocity they gain 0.09; turns, `WALKING_AND_TURNING`, gain
    another 0.01 and are left out.

    People have heavier tails than any Gaussian: over that scene, ellipses for 50, 90 and 95 % hold
    54 to 67, 88 to 91 and 93 %, so that what is beyond 95 % is 7 % rather than 5. `spread` widens
    them: at 1.2 those for 95 % hold 96 to 97 %, and those for 50 % hold 66 to 76.

    Attributes:
        motions: The ways in which an obstacle may move; at least one. For turns at a rate that is
            not known, several rates: their probabilities are estimated.
        sojourn: Mean time [s] after which the motion is drawn anew, by the motions' weights.
        speed: Standard deviation [m/s] of each component of the velocity of which nothing is
            known yet.
        confirm: Measurements after which a track is told of; the first one says nothing about the
            velocity, so that predictions from it alone are as wide as `speed` makes them.
        keep: Seconds without a measurement after which a track ends.
        gate: Probability that the right measurement is near enough to its track to be taken for
            it; where measurements have no names.
        spread: Factor on the standard deviations of all predictions: for obstacles that are less
            predictable than the motions say, or for more of the tails.
    """

    motions: tuple[Motion, ...] = WALKING
    sojourn: float = 1.3
    speed: float = 1.0
    confirm: int = 2
    keep: float = 1.0
    gate: float = 0.999
    spread: float = 1.0

    def __post_init__(self) -> None:
        """Check every setting."""
        if not isinstance(self.motions, tuple) or not self.motions:
            raise InvalidArgumentError("motions", f"{self.motions!r} is no tuple of Motions")
        for k, motion in enumerate(self.motions):
            if not isinstance(motion, Motion):
                raise InvalidArgumentError(f"motions[{k}]", f"{motion!r} is not a Motion")
        for name in ("sojourn", "speed", "spread"):
            require_positive(name, getattr(self, name))
        as_count("confirm", self.confirm)
        if as_number("keep", self.keep) < 0:
            raise BoundsError("keep", f"{self.keep} s is negative")
        if not 0 < as_number("gate", self.gate) < 1:
            raise BoundsError("gate", f"{self.gate} is not between 0 and 1")

    def gate_at(self, dim: int) -> float:
        """Largest squared Mahalanobis distance within the gate: a chi-square quantile."""
        return float(2 * gammaincinv(dim / 2, self.gate))
