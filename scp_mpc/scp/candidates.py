"""Candidates that pass an obstacle on its other sides, or one stage earlier or later.

One linearisation keeps to one side of an obstacle, and at each stage to where it stands in front of
it, beside it or behind it. A plan that trails behind an obstacle, or passes it one sample too late,
is a local optimum. A candidate is a path that need not obey the dynamics: the plan that ignores the
obstacles; but during one conflict it is put off or brought forward by a stage or two of the
relative motion and pushed out of the no-go set, and during the other conflicts it is the present
plan. Or it stays in front of the first obstacle in its way. For an obstacle that crosses, the two
sides are before it and behind it. Linearising about the path gives half-spaces on that side, sound
as any. Polytopes often stand together, as walls do: there are candidates that pass all of them on
one side, the first few on either, or none.

Notation:
    C                   collision nodes of the plan
    p       (C, d)      positions of the plan that ignores the obstacles
    v       (d,)        motion relative to the obstacle in one stage, over the conflict [m]
    n       (d,)        side: a unit vector square to v
    tau                 stages by which the candidate passes later (negative) or earlier
    e       (k, d)      semi-axes s sigma + r of ellipsoids; w and m: offset and n in units of them
    rho     (k,)        s sigma + r, by which polytopes are rounded, or their faces put forward [m]
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice, product

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.scp.step import Step

MAX_CANDIDATES = 16  # in one control step, whatever the number of obstacles
MOST_AMONG_WALLS = 32  # the same where there are polytopes
_AROUND = 3  # stages before and after a conflict that a candidate may change
_NO_RELATIVE_MOTION = 1e-6  # relative motion in one stage, over the distance, that counts as none
_MIXED = 3  # polytopes whose sides are tried in all combinations
_COSINE = 0.9  # of the angle between two directions that count as one side
_TOUCH = 1e-9  # [m] less than that within is not within
_PARALLEL = 1e-9  # cosine below which a face is never reached
# Whether to leave the no-go set away from its middle, and tau: as the free plan would, one stage
# later or earlier, two later
_VARIANTS = ((False, (0.0, -1.0, 1.0)), (True, (-2.0,)))


@dataclass(frozen=True, eq=False)
class CandidatePath:
    """Where and when to pass which obstacle.

    Attributes:
        obstacle: Its index.
        normal: (d,) from the obstacle to where the path passes.
        time: Stages by which it passes earlier than the free plan would.
        path: (C, d) positions to linearise about.
        waits: Whether it stays in front of the obstacle.
    """

    obstacle: int
    normal: FloatArray
    time: float
    path: FloatArray
    waits: bool = False


@dataclass(frozen=True, eq=False)
class PassingPattern:
    """How a plan passes the obstacles.

    Attributes:
        path: (C, d) its positions.
        touched: (J, C) which obstacles push it, at which points.
    """

    path: FloatArray
    touched: BoolArray


def candidate_paths(
    step: Step,
    free: FloatArray,
    present: FloatArray,
    s: FloatArray,
    most: int = MAX_CANDIDATES,
) -> list[CandidatePath]:
    """Return the ways past the obstacles in conflict, first conflicts first, and one that waits.

    Args:
        step: The control step.
        free: (C, d) positions of the plan that ignores the obstacles.
        present: (C, d) positions of the best plan so far.
        s: (M,) sizes of the ellipsoids.
        most: How many ways past to return at most.
    """
    conflict = step.depths(free, s) > 0
    first = np.where(conflict.any(axis=1), conflict.argmax(axis=1), conflict.shape[1])
    count = np.count_nonzero(first < conflict.shape[1])
    order = np.argsort(first, kind="stable")[:count].tolist()
    ways: Iterator[CandidatePath] = (
        side
        for j in order
        for side in _paths_past(
            step, free, _elsewhere(step, free, present, conflict, j), s, j, conflict[j]
        )
    )
    if step.shapes is not None:
        ways = chain(_together(step, free, s, conflict, step.shapes.slots), ways)
    return [*islice(ways, most), *(_waiting(step, free, j, conflict[j]) for j in order[:1])]


def _waiting(step: Step, free: FloatArray, j: int, conflict: BoolArray) -> CandidatePath:
    """Stay where the free plan comes into conflict, in front of the obstacle."""
    points = np.flatnonzero(conflict)
    v, _ = _directions(free - step.means[j, 1:], points, step.nodes.count)
    path = free.copy()
    path[points[0] :] = free[points[0] - 1] if points[0] else step.here
    return CandidatePath(j, -v / np.linalg.norm(v), 0.0, path, waits=True)


def _together(
    step: Step, free: FloatArray, s: FloatArray, conflict: BoolArray, walls: IntArray
) -> Iterator[CandidatePath]:
    """Pass the polytopes in conflict, each on either side."""
    hit = conflict[walls]
    if not hit.any():
        return
    points = np.flatnonzero(hit.any(axis=0))
    order = np.argsort(np.where(hit.any(axis=1), hit.argmax(axis=1), len(free)), kind="stable")
    walls = walls[order]
    j = int(walls[0])
    _, normals = _directions(free - step.means[j, 1:], points, step.nodes.count)
    body = Walls.of(step, s, walls, slice(0, len(free)))
    for n in normals if len(walls) > 1 else ():
        yield CandidatePath(j, n, 0.0, body.aside(free[None], n[None])[0])
    for mixed in product(*[normals[:2]] * min(len(walls), _MIXED)):
        if len(walls) > 1 and any(n is not mixed[0] for n in mixed):
            # Those beyond the first few go with the last of them.
            sides = np.array([*mixed, *[mixed[-1]] * (len(walls) - len(mixed))])
            yield CandidatePath(j, mixed[0], 0.0, body.apart(free, sides))


def varied(step: Step, way: PassingPattern, s: FloatArray) -> list[FloatArray]:
    """Paths that pass one polytope at one stage by another face than a way does."""
    assert step.shapes is not None
    walls = step.shapes.slots
    body = Walls.of(step, s, walls, slice(0, len(way.path)))
    return body.flips(way.path, way.touched[walls], step.nodes.count)


def _elsewhere(
    step: Step, free: FloatArray, present: FloatArray, conflict: BoolArray, j: int
) -> FloatArray:
    """The free plan, and the present one during all conflicts but the first with obstacle j."""
    reach = _AROUND * step.nodes.count
    others = conflict.copy()
    others[j, _first_run(conflict[j], reach)] = False
    points = np.flatnonzero(others.any(axis=0))
    around = (points[:, None] + np.arange(-reach, reach + 1)).clip(0, len(free) - 1)
    path = free.copy()
    path[around] = present[around]
    return path


def same_pattern(step: Step, first: PassingPattern, second: PassingPattern) -> bool:
    """Whether two plans are pushed by the same obstacles at the same stages on the same side."""
    K = step.nodes.count
    mine, theirs = (step.nodes.stages(p.touched).any(axis=2) for p in (first, second))
    if not np.array_equal(mine, theirs):
        return False
    j, i = np.nonzero(mine)
    i = K * (i + 1) - 1  # the samples of those stages
    a, b = (_outward(step, passing.path, j, i) for passing in (first, second))
    apart = (a * b).sum(axis=1) < _COSINE * np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
    return not apart.any()


def _outward(step: Step, path: FloatArray, j: IntArray, i: IntArray) -> FloatArray:
    """Directions (K, d) in which points lie from their obstacles: of polytopes, the normals."""
    y = path[i] - step.means[j, i + 1]
    if step.shapes is not None:
        shapes = step.shapes.taken(j)
        k = shapes.slots
        y[k] = shapes.taken(k).nearest(y[k, None]).normal[:, 0]
    return y


def _paths_past(
    step: Step,
    free: FloatArray,
    elsewhere: FloatArray,
    s: FloatArray,
    j: int,
    conflict: BoolArray,
) -> Iterator[CandidatePath]:
    K, around = step.nodes.count, _AROUND * step.nodes.count
    points = _first_run(conflict, around)
    v, normals = _directions(free - step.means[j, 1:], points, K)
    reach = slice(max(points[0] - around, 0), points[-1] + around + 1)
    body: Ellipsoids | Walls = Ellipsoids.of(step, float(s[j]), j, reach)
    if step.shapes is not None and step.shapes.kind[j] >= 0:
        body = Walls.of(step, s, np.array([j]), reach)
        for n in body.faces(normals):
            path = elsewhere.copy()
            path[reach] = body.aside(free[None, reach], n[None])[0]
            yield CandidatePath(j, n, 0.0, path)
    for outward, times in _VARIANTS:
        shifts, sides = np.repeat(times, len(normals)), np.tile(np.array(normals), (len(times), 1))
        moved = free[reach] + shifts[:, None, None] * v
        paths = np.repeat(elsewhere[None], len(sides), axis=0)
        paths[:, reach] = (body.outward if outward else body.aside)(moved, sides)
        for time, n, path in zip(shifts.tolist(), sides, paths, strict=True):
            yield CandidatePath(j, n, time, path)


def _first_run(conflict: BoolArray, around: int) -> IntArray:
    """Points of the first conflict; gaps shorter than its surroundings do not end it."""
    points = np.flatnonzero(conflict)
    gaps = np.flatnonzero(np.diff(points) > around)
    return points[: gaps[0] + 1] if len(gaps) else points


def _directions(
    relative: FloatArray, points: IntArray, count: int
) -> tuple[FloatArray, list[FloatArray]]:
    begin, end = max(points[0] - count, 0), min(points[-1] + count, len(relative) - 1)
    v = (relative[end] - relative[begin]) * (count / max(end - begin, 1))
    if np.linalg.norm(v) <= _NO_RELATIVE_MOTION * np.linalg.norm(relative[begin]):
        v = relative[begin] if relative[begin].any() else np.eye(len(v))[0]
    # The rows of the rotation that takes v onto the first axis: the others are square to it.
    square = np.linalg.svd(v[None])[2][1:]
    return v, [sign * n for n in square for sign in (1.0, -1.0)]


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """Ellipsoids, their axes lengthened by the radii."""

    means: FloatArray
    scaling: FloatArray  # (k, d, d) takes offsets to units of the semi-axes

    @classmethod
    def of(cls, step: Step, s: float, j: int, reach: slice) -> "Ellipsoids":
        """Those of obstacle j at some points, at size s."""
        variances, rotations = np.linalg.eigh(step.covariances[j, 1:][reach])
        radii = step.radii[j, reach, None]
        e = np.maximum(s * np.sqrt(np.maximum(variances, 0.0)) + radii, 1e-9)
        return cls(step.means[j, 1:][reach], np.swapaxes(rotations, 1, 2) / e[..., None])

    def aside(self, paths: FloatArray, sides: FloatArray) -> FloatArray:
        """Move the points of paths (c, k, d) that lie within along sides (c, d) to the boundary."""
        w = (self.scaling @ (paths - self.means)[..., None])[..., 0]
        m = (self.scaling @ sides[:, None, :, None])[..., 0]
        mm, wm = (m * m).sum(axis=-1), (w * m).sum(axis=-1)
        room = 1 - (w * w).sum(axis=-1)  # positive inside
        shift = np.where(room > 0, (np.sqrt(wm**2 + mm * np.maximum(room, 0.0)) - wm) / mm, 0.0)
        moved: FloatArray = paths + shift[..., None] * sides[:, None]
        return moved

    def outward(self, paths: FloatArray, sides: FloatArray) -> FloatArray:
        """Move them away from the middle, and half as much towards the side, to the boundary."""
        w = (self.scaling @ (paths - self.means)[..., None])[..., 0]
        m = (self.scaling @ sides[:, None, :, None])[..., 0]
        within = (w * w).sum(axis=-1) < 1
        w[within] += 0.5 * m[within] / np.linalg.norm(m[within], axis=-1, keepdims=True)
        w[within] /= np.maximum(np.linalg.norm(w[within], axis=-1, keepdims=True), 1e-12)
        boundary: FloatArray = self.means + np.linalg.solve(self.scaling, w[..., None])[..., 0]
        return boundary


@dataclass(frozen=True, eq=False)
class Walls:
    """One or several polytopes (w of them), left together; their faces are put forward by rho."""

    shapes: Polytopes
    means: FloatArray  # (w, k, d)
    rho: FloatArray  # (w, k)

    @classmethod
    def of(cls, step: Step, s: FloatArray, slots: IntArray, reach: slice) -> "Walls":
        """Those of some obstacles at some points, at sizes s (M,)."""
        assert step.shapes is not None
        variances = np.linalg.eigvalsh(step.covariances[slots, 1:][:, reach])[..., -1]
        rho = step.radii[slots, reach] + s[slots, None] * np.sqrt(np.maximum(variances, 0.0))
        return cls(step.shapes.taken(slots), step.means[slots, 1:][:, reach], rho)

    def faces(self, known: list[FloatArray]) -> list[FloatArray]:
        """Normals of faces that are not nearly those known, nor each other: at most two an axis."""
        found: list[FloatArray] = []
        for n in self.shapes.normals[self.shapes.kind[0]]:
            if len(found) < 2 * len(n) and all(n @ other < _COSINE for other in known + found):
                found.append(n)
        return found

    def aside(self, paths: FloatArray, sides: FloatArray) -> FloatArray:
        """Move the points of paths (c, k, d) that lie within along sides (c, d) to the boundary."""
        return np.array([self._out(path, n) for path, n in zip(paths, sides, strict=True)])

    def apart(self, path: FloatArray, normals: FloatArray) -> FloatArray:
        """The same, but out of each polytope towards a side of its own (w, d)."""
        return self._out(path, normals[:, None])

    def outward(self, paths: FloatArray, sides: FloatArray) -> FloatArray:
        """Move them away from the first one, and half as much towards the side, to the boundary."""
        first = self.shapes.taken(np.zeros(1, dtype=np.intp))
        moved = []
        for path, n in zip(paths, sides, strict=True):
            away = first.nearest((path - self.means[0])[None]).normal[0] + 0.5 * n
            moved.append(self._out(path, away / np.linalg.norm(away, axis=1, keepdims=True)))
        return np.array(moved)

    def _out(self, path: FloatArray, along: FloatArray) -> FloatArray:
        """Move what is within along unit vectors (w, k, d): out of one, and of what comes next."""
        along = np.broadcast_to(along, self.means.shape)
        speed = along @ np.swapaxes(self.shapes.normals[self.shapes.kind], 1, 2)
        ahead, points = speed > _PARALLEL, np.arange(len(path))
        for _ in self.means:
            y = path - self.means
            within = self.shapes.distance(y) < self.rho - _TOUCH
            if not within.any():
                break
            room = self.rho[..., None] - self.shapes.depths(y)
            way = np.where(ahead, room / np.where(ahead, speed, 1.0), np.inf).min(axis=2)
            way = np.where(within, way, 0.0)
            which = way.argmax(axis=0)
            path = path + way[which, points][:, None] * along[which, points]
        return path

    def flips(self, path: FloatArray, touched: BoolArray, count: int) -> list[FloatArray]:
        """Paths that pass one polytope at one stage by another face than a path (k, d) does.

        What does not push the path need not be moved: to give it more room would gain nothing.

        Args:
            path: Positions.
            touched: (w, k) which polytopes push it, at which points.
            count: Points in a stage.
        """
        y = path - self.means
        stages = touched.reshape(len(y), -1, count).any(axis=2)
        found = []
        for w, i in np.argwhere(stages).tolist():
            at = slice(i * count, (i + 1) * count)
            one = self.shapes.taken(np.array([w]))
            normals = one.normals[one.kind[0]]
            here = one.nearest(y[None, w, at]).normal[0, -1]
            for f in np.unique(normals, axis=0, return_index=True)[1].tolist():
                if normals[f] @ here < _COSINE:
                    new = path.copy()
                    over = one.over(f, y[w, at]) + self.rho[w, at, None] * normals[f]
                    new[at] = self.means[w, at] + over
                    found.append(new)
        return found
