"""Robots as users write them: f and Jacobians by hand, in any units, about any origin.

A robot is g(x, u) = S [rates(S^-1 (x - o), T^-1 u)], S and T the units of states and inputs and o
the origin; `discrete` makes an Euler step of it. Jacobians come from a complex step, then are
taken for written by hand: `wrong` spoils one entry of them, everywhere.
"""

from dataclasses import dataclass

import numpy as np


def _unicycle(x, u):
    return x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), u[1], u[0]


def _bicycle(x, u):
    omega = x[3] * np.tan(0.3 * np.sin(x[4])) / 2.5
    return x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), omega, u[0], u[1]


def _drag(x, u):
    speed = np.sqrt(x[2] ** 2 + x[3] ** 2 + 0.01)
    return x[2], x[3], u[0] - 0.3 * speed * x[2], u[1] - 0.3 * speed * x[3]


def _terrain(x, u):
    """The ground is a hill, so that places differ."""
    hill = np.exp(-0.1 * (x[0] ** 2 + x[1] ** 2))
    return x[2], x[3], u[0] + 0.5 * x[0] * hill, u[1] + 0.5 * x[1] * hill


def _planar_quadrotor(x, u):
    return (
        x[3],
        x[4],
        x[5],
        -(u[0] + u[1]) * np.sin(x[2]),
        (u[0] + u[1]) * np.cos(x[2]) - 9.81,
        ((u[1] - u[0]) * 4.0),
    )


def _arm(x, u):
    """A mobile base that drags a trailer, and a lag in its inputs."""
    return (
        x[5] * np.cos(x[2]), x[5] * np.sin(x[2]), x[4], x[5] * np.sin(x[2] - x[3]) / 1.5,
        2.0 * (u[1] - x[4]), 1.5 * (u[0] - x[5]),
    )  # fmt: skip


# rates, states' kinds, inputs' kinds: p and l scale with length, a are angles, r rates of angles
ROBOTS = {
    "unicycle": (_unicycle, "ppal", "lr"),
    "bicycle": (_bicycle, "ppala", "lr"),
    "drag": (_drag, "ppll", "ll"),
    "terrain": (_terrain, "ppll", "ll"),
    "planar quadrotor": (_planar_quadrotor, "ppallr", "ll"),
    "trailer": (_arm, "ppaarl", "lr"),
}
UNITS = {"m": 1.0, "mm": 1e3, "km": 1e-3}
UTM = (388096.0, 3948996.0)


@dataclass(frozen=True)
class UserRobot:
    """One robot; see the head of this file."""

    name: str
    dt: float
    discrete: bool
    unit: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    wrong: tuple[int, int, float] | None = None

    @property
    def scales(self):
        return tuple(
            np.array([self.unit if kind in "pl" else 1.0 for kind in kinds])
            for kinds in ROBOTS[self.name][1:]
        )

    @property
    def sizes(self):
        return tuple(len(kinds) for kinds in ROBOTS[self.name][1:])

    @property
    def about(self):
        """(x, u) with the position at the origin of the map."""
        x = np.zeros(self.sizes[0])
        x[:2] = self.origin
        return x, np.zeros(self.sizes[1])

    def rates(self, x, u):
        """Textbook style: x[0], x[1], ... and so of columns (nx, K), too."""
        S, T = self.scales
        o = self.about[0]
        columns = (slice(None),) + (None,) * (np.ndim(x) - 1)
        own = ROBOTS[self.name][0]((x - o[columns]) / S[columns], u / T[columns])
        return np.array(np.broadcast_arrays(*own)) * S[columns]

    def function(self, x, u):
        return x + self.dt * self.rates(x, u) if self.discrete else self.rates(x, u)

    def jacobians(self, x, u):
        nx, nu = self.sizes
        slopes = np.empty((nx, nx + nu))
        for i in range(nx + nu):
            aside = np.zeros(nx + nu, dtype=complex)
            aside[i] = 1e-30j
            slopes[:, i] = np.imag(self.rates(x + aside[:nx], u + aside[nx:])) / 1e-30
        if self.discrete:
            slopes = np.eye(nx, nx + nu) + self.dt * slopes
        if self.wrong is not None:
            row, column, factor = self.wrong
            slopes[row, column] *= factor
        return slopes[:, :nx], slopes[:, nx:]

    @property
    def arguments(self):
        nx, nu = self.sizes
        kinds = ROBOTS[self.name][1]
        return {
            "nx": nx, "nu": nu, "dt": self.dt, "position": [0, 1], "discrete": self.discrete,
            "heading": kinds.index("a") if "a" in kinds else None,
        }  # fmt: skip


def draw_robot(rng, wrong=False):
    """Any robot; where `wrong`, with one entry, that is not zero throughout, off by 1 % or more."""
    name = str(rng.choice(list(ROBOTS)))
    dt = float(10 ** rng.uniform(-2, 0))
    unit = float(rng.choice(list(UNITS.values())))
    origin = tuple(np.array(UTM) * unit) if rng.random() < 0.5 else (0.0, 0.0)
    right = UserRobot(name, dt, bool(rng.random() < 0.5), unit, origin)
    if not wrong:
        return right
    x, u = right.about
    x, u = x + rng.normal(size=len(x)) * right.scales[0], u + rng.normal(size=len(u))
    entries = np.argwhere(np.abs(np.concatenate(right.jacobians(x, u), axis=1)) > 0)
    row, column = entries[rng.integers(len(entries))].tolist()
    factor = 1 + float(rng.choice([-1, 1])) * float(10 ** rng.uniform(-2, 0.3))
    return UserRobot(name, dt, right.discrete, unit, origin, (row, column, factor))
