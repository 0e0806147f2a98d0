"""The shortest path around what stands: what a plan does not see beyond its horizon.

    points of a grid that are clear of all that stands, each joined to its eight neighbours
    Dijkstra's algorithm from the start
    from the start on, straight to the farthest point of that way that can be seen
    back from the goal likewise, which makes good what the first lines went too far

Notation:
    J, K    obstacles that stand, points
    n       (2,) points of the grid along each axis
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from scp_mpc.arrays import BoolArray, FloatArray, IntArray, as_array, as_number
from scp_mpc.control.path import Path
from scp_mpc.errors import BoundsError, ShapeError
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictions import as_predictions
from scp_mpc.problem import Problem
from scp_mpc.settings import require_positive

_MOVES = ((1, 0), (0, 1), (1, 1), (1, -1))  # to half of the neighbours; edges have no direction


def shortest_path(
    problem: Problem,
    start: ArrayLike,
    goal: ArrayLike,
    obstacles: Sequence[ObstaclePrediction],
    *,
    clearance: float = 0.05,
    tolerance: float = 0.0,
    standing: float = 0.3,
    cell: float = 0.05,
) -> Path | None:
    """Return straight lines from start to goal around the obstacles that stand; None for no way.

    The path keeps `clearance` to their no-go sets as they are now, or what start and goal have
    where that is less; between its samples, a cell apart, it may come nearer by cell^2 / 4r at a
    corner rounded by r. The position keeps its bounds, `x_min` and `x_max`. What moves, by more
    than a cell within the horizon, is for the controller to avoid, and the robot's least turning
    radius is not known here.

    Args:
        problem: Whose radius, margin, inflation and bounds count; its robot is planar.
        start: (2,) [m].
        goal: (2,) [m].
        obstacles: Predictions.
        clearance: [m].
        tolerance: How far from the goal the path may end, where it cannot be reached [m].
        standing: Speed up to which an obstacle counts as standing [m/s].
        cell: Distance of the grid's points [m]: gaps have to be about two of them wider than the
            robot with its clearance. Time and memory grow with the number of points.

    Raises:
        InvalidArgumentError: Or a subclass: the robot is not planar, the goal is where the path
            starts, a number is negative.
    """
    if problem.model.dim != 2:
        raise ShapeError("problem", f"its robot moves in {problem.model.dim}-D, not in the plane")
    ends = np.stack([as_array("start", start, (2,)), as_array("goal", goal, (2,))])
    if np.array_equal(*ends):
        raise BoundsError("goal", f"{ends[1].tolist()} m is where the path starts")
    given = {"clearance": clearance, "tolerance": tolerance, "standing": standing}
    for name, value in given.items():
        if as_number(name, value) < 0:
            raise BoundsError(name, f"{value} is negative")
    require_positive("cell", cell)
    slow = standing * problem.model.dt
    still = [
        o
        for o in as_predictions(obstacles)
        if np.hypot(*(o.means[-1] - o.means[0])) <= slow * o.horizon
    ]
    room = _Room(problem, still, ends, clearance)
    way = _searched(room, ends, cell, tolerance)
    if way is None:
        return None
    path = Path.polyline(_shortened(room, way, cell))
    back = np.union1d(path.knots, np.arange(0.0, path.length, cell))[::-1]
    return Path.polyline(_shortened(room, path.positions(back), cell)[::-1])


class _Room:
    """Where the robot may be."""

    def __init__(
        self,
        problem: Problem,
        standing: Sequence[ObstaclePrediction],
        ends: FloatArray,
        clearance: float,
    ) -> None:
        """Measure what stands, and how far the way round it may lead."""
        at = problem.model.position
        self._sets, self._no_go = NoGoSets.now(standing, problem.robot_radius), problem.no_go
        self._middles = self._sets.means.reshape(-1, 2)
        spread = problem.size.reference * self._sets.deviations.max(axis=2) + self._sets.radii
        sizes = np.array([0.0 if o.shape is None else o.shape.size for o in standing])
        self._reach = spread[:, 0] + sizes + clearance
        self._need = np.full(len(standing), float(clearance))
        j, k, gaps = self._gaps(ends)
        np.minimum.at(self._need, j[k == 0], gaps[k == 0])
        np.minimum.at(self._need, j[k == 1], np.maximum(gaps[k == 1], 0.0))
        self._low = np.minimum(problem.x_min[at], ends[0])
        self._high = np.maximum(problem.x_max[at], ends[0])
        low, high = (self._middles + side * 1.1 * self._reach[:, None] for side in (-1, 1))
        self.low = np.maximum(np.concatenate([ends, low]).min(axis=0), self._low)
        self.high = np.minimum(np.concatenate([ends, high]).max(axis=0), self._high)

    def is_clear(self, points: FloatArray) -> BoolArray:
        """Whether (K,) the robot may be at points (K, 2)."""
        clear = np.all((self._low <= points) & (points <= self._high), axis=1)
        j, k, gaps = self._gaps(points)
        clear[k[gaps < self._need[j]]] = False
        return clear

    def _gaps(self, points: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Obstacles and points (K, 2) that are near each other, and their distances [m]."""
        away = np.hypot(*(points[:, i] - self._middles[:, i, None] for i in (0, 1)))
        j, k = np.nonzero(away <= self._reach[:, None])
        return j, k, self._no_go.clearance(self._sets.taken(j), points[k, None])[:, 0]


def _searched(room: _Room, ends: FloatArray, cell: float, tolerance: float) -> FloatArray | None:
    """The way (K, 2) over the grid, from end to end, or to the point nearest to the goal."""
    before = np.floor((ends[0] - room.low) / cell)
    n = (before + np.floor((room.high - ends[0]) / cell)).astype(int) + 1
    index = np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), axis=-1)
    points = (ends[0] + cell * (index - before)).reshape(-1, 2)  # the start is one of them
    clear = room.is_clear(points).reshape(n)
    number = np.arange(clear.size).reshape(n)
    first = int(number[tuple(before.astype(int))])
    clear.flat[first] = True
    rows, columns, lengths = list[IntArray](), list[IntArray](), list[FloatArray]()
    for move in _MOVES:
        here, there = (
            tuple(slice(max(sign * m, 0), min(sign * m, 0) or None) for m in move)
            for sign in (-1, 1)
        )
        both = clear[here] & clear[there]
        rows.append(number[here][both])
        columns.append(number[there][both])
        lengths.append(np.full(len(rows[-1]), cell * np.hypot(*move)))
    edges = np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))
    graph = coo_array(edges, shape=(clear.size, clear.size)).tocsr()
    far, previous = dijkstra(graph, directed=False, indices=[first], return_predecessors=True)
    away = np.where(np.isfinite(far[0]), np.linalg.norm(points - ends[1], axis=1), np.inf)
    way = [int(away.argmin())]
    near = away[way[0]] <= cell and bool(room.is_clear(ends[1:])[0])
    if not near and (away[way[0]] > tolerance or way[0] == first):
        return None
    while way[-1] != first:
        way.append(int(previous[0, way[-1]]))
    found = points[way[::-1]]
    return np.concatenate([found, ends[1:]]) if near and away[way[0]] > 0 else found


def _shortened(room: _Room, way: FloatArray, cell: float) -> FloatArray:
    """The corners (K, 2) of straight lines from point to point of a way."""
    corners, at = [0], 0
    while at < len(way) - 1:
        seen, hidden = at + 1, len(way)
        while hidden - seen > 1:  # the last one first, then by halves
            tried = len(way) - 1 if hidden == len(way) else (seen + hidden) // 2
            count = int(np.ceil(np.linalg.norm(way[tried] - way[at]) / cell)) + 1
            line = np.linspace(way[at], way[tried], count)[1:]
            seen, hidden = (tried, hidden) if room.is_clear(line).all() else (seen, tried)
        corners.append(at := seen)
    return way[corners]
