"""Contact of disc against disc (ball against ball), swept: between the samples too.

Within interval i the robot goes the curve of its input, here a polyline through `FINE` points; the
obstacle goes straight. Relative to the obstacle each piece is a segment a -> b, whose smallest
distance from the origin has a closed form:

    t = clip(-a'(b - a) / |b - a|^2, 0, 1),   distance = |a + t (b - a)|

Most intervals are decided by their chord alone. The relative path never is further than h_i from
it, with h_i the robot's own largest distance from its chord at the same time, so that

    chord distance >  r + h_i   no contact
    chord distance <= r - h_i   contact

and only what lies in between is cut into pieces.

Notation:
    p   (N, FINE+1, d)  robot at equal fractions of each interval [m]
    o   (n, N+1, d)     obstacle paths [m]
    h   (N,)            robot's largest distance from its chord [m]
    r                   sum of both radii [m]
"""

from functools import lru_cache

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, as_array, as_number
from scp_mpc.errors import BoundsError, ShapeError
from scp_mpc.models.linear import LinearModel
from scp_mpc.models.model import Model

FINE = 32  # pieces of an interval; at 3 m/s^2 and 0.2 s they are within 0.02 mm of the curve
_CHUNK = 8192  # paths at once: temporaries stay within the processor's caches


def robot_path(model: Model, states: FloatArray, inputs: FloatArray) -> FloatArray:
    """Positions (N, FINE+1, d) of the robot at equal fractions of each interval [m].

    Args:
        model: Dynamics.
        states: (N+1, nx).
        inputs: (N, nu), each held over its interval.
    """
    path = [states[:-1, model.position]]
    if isinstance(model, LinearModel):
        path += [states[:-1] @ C.T + inputs @ D.T for C, D in _pieces(model)]
    else:
        shares = np.arange(1, FINE)[:, None] / FINE
        path += [*model.advance(states[None, :-1], inputs[None], shares)[..., model.position]]
    path.append(states[1:, model.position])
    return np.stack(path, axis=1)


def contacts(path: FloatArray, obstacles: FloatArray, radius: float) -> BoolArray:
    """Whether (n, N) the discs touch during interval i, for each realisation of the obstacle.

    Args:
        path: (N, pieces+1, d) robot at equal fractions of each interval; see `robot_path`.
        obstacles: (n, N+1, d) positions of the obstacle's centre at the samples [m].
        radius: Sum of both radii [m].

    Raises:
        ShapeError: The shapes do not belong together.
        BoundsError: The radius is negative.
    """
    p = as_array("path", path, (-1, -1, 2), (-1, -1, 3))
    o = as_array("obstacles", obstacles, (-1, len(p) + 1, p.shape[-1]))
    if p.shape[1] < 2:
        raise ShapeError("path", f"{p.shape[1]} point(s) per interval; it takes two or more")
    r = as_number("radius", radius)
    if r < 0:
        raise BoundsError("radius", f"{r} m is negative")
    fractions = np.linspace(0.0, 1.0, p.shape[1])[:, None]
    chords = p[:, :1] + fractions * (p[:, -1:] - p[:, :1])
    h = np.linalg.norm(p - chords, axis=-1).max(axis=1) + 1e-12
    touched = np.empty((len(o), len(p)), dtype=np.bool_)
    for begin in range(0, len(o), _CHUNK):
        part = o[begin : begin + _CHUNK]
        distance = _smallest_distance(p[:, 0] - part[:, :-1], p[:, -1] - part[:, 1:])
        hit = distance <= r - h
        which, i = np.nonzero(~hit & (distance <= r + h))
        first, last = part[which, i][:, None], part[which, i + 1][:, None]
        relative = p[i] - (first + fractions * (last - first))
        pieces = _smallest_distance(relative[:, :-1], relative[:, 1:])
        hit[which, i] = pieces.min(axis=1, initial=np.inf) <= r
        touched[begin : begin + _CHUNK] = hit
    return touched


def sampled_contacts(path: FloatArray, obstacles: FloatArray, radius: float) -> BoolArray:
    """Whether (n, N) the discs touch at the end of interval i: what the samples alone show.

    Args:
        path: As in `contacts`.
        obstacles: As in `contacts`.
        radius: Sum of both radii [m].
    """
    there: BoolArray = np.square(path[:, -1] - obstacles[:, 1:]).sum(axis=-1) <= radius**2
    return there


@lru_cache(maxsize=16)
def _pieces(model: LinearModel) -> list[tuple[FloatArray, FloatArray]]:
    """(C, D) with position C x + D u after each piece of an interval but the last."""
    return [model.between(k / FINE) for k in range(1, FINE)]


def _smallest_distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Smallest distances (...) of the segments a -> b (..., d) from the origin."""
    e = b - a
    axes = range(a.shape[-1])
    along = sum((a[..., k] * e[..., k] for k in axes), start=np.zeros(a.shape[:-1]))
    square = sum((e[..., k] * e[..., k] for k in axes), start=np.zeros(a.shape[:-1]))
    t = np.clip(-along / np.maximum(square, np.finfo(np.float64).tiny), 0.0, 1.0)
    nearest = [a[..., k] + t * e[..., k] for k in axes]
    return np.sqrt(sum((x * x for x in nearest), start=np.zeros(a.shape[:-1])))
