"""The convex program of a control step, row by row, the obvious way: for tests of the sparse one.

Derivatives are central differences of the model's flow, half-spaces come one at a time. Variables
and rows stand in the order that `scp_mpc/scp/subproblem.py` documents:

    z = [e_1 .. e_N | u_0 .. u_{N-1} | s_1 .. s_M where they move | below | above | slack]
    rows = [dynamics | sizes, inputs, rates, states | half-spaces | slack >= 0]
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc import SCP
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.step import Step
from scp_mpc.trajectory import rollout

SLOTS, ELASTIC_SLOTS = 3, 10  # for half-spaces at each node
_H = 1e-5


@dataclass
class Rebuilt:
    """Arrays of a program, and the plan that it is about.

    Attributes:
        P: (n, n); likewise q (n,), A (m, n), lower and upper (m,).
        states: (N+1, nx) of the plan.
        spaces: Slice of the half-spaces' rows, SLOTS for each node.
        slacks: Slice of the columns of slack; those of the states, below and above, come before.
    """

    P: np.ndarray
    q: np.ndarray
    A: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    states: np.ndarray
    spaces: slice
    slacks: slice


def slopes(function, *arguments):
    """Central differences (k, n) of a function (k,) in all its arguments, side by side."""
    columns = []
    for which, argument in enumerate(arguments):
        for k in range(len(argument)):
            ends = []
            for sign in (1.0, -1.0):
                moved = [np.array(a, dtype=float) for a in arguments]
                moved[which][k] += sign * _H
                ends.append(function(*moved))
            columns.append((ends[0] - ends[1]) / (2 * _H))
    return np.stack(columns, axis=-1)


def bodies(problem, x):
    """Centres (n, d) of the robot's discs in a state."""
    model, at = problem.model, x[problem.model.position]
    if model.heading is None:
        return at[None]
    ahead = np.array([np.cos(x[model.heading]), np.sin(x[model.heading])])
    return at + problem.discs[:, None] * ahead


def nodes(problem, states, inputs):
    """For each collision node: position, stage i, and its derivatives in x_i, u_i and x_{i+1}."""
    K, found = problem.nodes_per_interval, []
    nx, d = problem.model.nx, problem.model.dim
    for i, u in enumerate(inputs):
        for k in range(1, K + 1):
            for disc in range(len(problem.discs)):

                def inner(x, u, k=k, disc=disc):
                    return bodies(problem, problem.model.advance(x, u, k / K))[disc]

                def last(x, disc=disc):
                    return bodies(problem, x)[disc]

                by_x, by_u, by_next = np.zeros((d, nx)), np.zeros((d, len(u))), np.zeros((d, nx))
                if k < K:
                    p, both = inner(states[i], u), slopes(inner, states[i], u)
                    by_x, by_u = both[:, :nx], both[:, nx:]
                else:
                    p, by_next = last(states[i + 1]), slopes(last, states[i + 1])
                found.append((p, i, by_x, by_u, by_next))
    return found


def rebuilt(problem, x0, x_ref, obstacles, inputs, elastic=False, u_last=None, couplings=None):
    """Build the program about the plan of some inputs, with sizes s_ref.

    Args:
        problem: The problem.
        x0: As in `SCP.subproblem`, like the other arguments.
        x_ref: (N+1, nx).
        obstacles: Likewise; all of them near at all nodes.
        inputs: (N, nu), within their bounds.
        elastic: Likewise.
        u_last: Likewise.
        couplings: Coefficients of below and above (N nb,), and of slack, which are free to choose.
    """
    model, N, size = problem.model, problem.horizon, problem.size
    nx, nu, M = model.nx, model.nu, problem.max_obstacles
    faces = state_rows(problem)
    soft = [b for b, (_, _, _, yields) in enumerate(faces) if yields]
    moving = M if size.lower < size.reference else 0
    states = rollout(model.step, x0, inputs).states
    step = Step.read(problem, x0, x_ref, obstacles, u_last=u_last)
    if problem.nodes_per_interval > 1 and obstacles:
        collision = Nodes.of(problem)
        motion = collision.motion(states, inputs)
        step = step.widened(collision.radii(step.radii, step.drift, motion))
    where = nodes(problem, states, inputs)
    slots = min(M, ELASTIC_SLOTS if elastic else SLOTS)
    spare = N * len(soft) if elastic else 0
    at_u, at_s = N * nx, N * (nx + nu)
    at_below = at_s + moving
    at_above, at_slack = at_below + spare, at_below + 2 * spare
    n = at_slack + (len(where) * slots if elastic else 0)
    P, q, rows, lower, upper = np.zeros((n, n)), np.zeros(n), [], [], []

    def row(lo, up, *entries):
        a = np.zeros(n)
        for begin, values in entries:
            a[begin : begin + len(values)] += values
        rows.append(a)
        lower.append(lo)
        upper.append(up)

    for i in range(N):
        x, u = slice(i * nx, (i + 1) * nx), slice(at_u + i * nu, at_u + (i + 1) * nu)
        P[x, x] = 2 * (problem.Qf if i == N - 1 else problem.Q)
        P[u, u] = 2 * problem.R
        q[u] = -2 * problem.R @ model.equilibrium_input
    for j in range(moving):
        P[at_s + j, at_s + j] = 2 * size.weight
        q[at_s + j] = -2 * size.weight * size.reference
    for i, u in enumerate(inputs):
        both = slopes(model.step, states[i], u)
        A, B = both[:, :nx], both[:, nx:]
        for a in range(nx):
            known = states[i + 1, a] - x_ref[i + 1, a] - B[a] @ u
            entries = [(i * nx + a, [1.0]), (at_u + i * nu, -B[a])]
            if i:
                known -= A[a] @ (states[i] - x_ref[i])
                entries.append(((i - 1) * nx, -A[a]))
            row(known, known, *entries)
    for j in range(moving):
        row(size.lower, size.upper, (at_s + j, [1.0]))
    for i in range(N):
        for a in range(nu):
            row(problem.u_min[a], problem.u_max[a], (at_u + i * nu + a, [1.0]))
    if problem.limits_rates:
        for i in range(N):
            for a in range(nu):
                entries, least, most = [(at_u + i * nu + a, [1.0])], *reach(problem, a, u_last)
                if i:
                    entries.append((at_u + (i - 1) * nu + a, [-1.0]))
                    least, most = problem.du_min[a], problem.du_max[a]
                row(least, most, *entries)
    braked = SCP(problem).brake(x0, x0, u_last=u_last).X if faces else None
    for i in range(N):
        for b, (face, least, most, _) in enumerate(faces):
            entries = [(i * nx, face)]
            if elastic and b in soft:
                k = i * len(soft) + soft.index(b)
                entries += [(at_below + k, [couplings[0][k]]), (at_above + k, [-couplings[0][k]])]
            least, most = widened(braked, i, face, least, most, b in soft, elastic)
            row(least - face @ x_ref[i + 1], most - face @ x_ref[i + 1], *entries)
    for c, (p, i, by_x, by_u, by_next) in enumerate(where):
        planes = []
        for j in range(len(obstacles)):
            sets = NoGoSets.pairs(
                step.means[[j], c + 1],
                step.covariances[[j], c + 1],
                step.radii[[j], c],
                None if step.shapes is None else step.shapes.taken(np.array([j])),
            )
            before = (where[c - 1][0] if c else step.here) - step.means[[j], c]
            s = np.array([size.reference])
            spaces = problem.no_go.linearise(sets, p[None, None], s, before)
            planes.append((spaces.value[0, 0], spaces.normal[0, 0], spaces.slope[0, 0], j))
        for slot, (g, normal, slope, j) in enumerate(sorted(planes, key=lambda plane: plane[0])):
            along = normal @ (by_u @ inputs[i] + by_next @ (states[i + 1] - x_ref[i + 1]))
            entries = [(at_u + i * nu, normal @ by_u), (i * nx, normal @ by_next)]
            if i:
                along += normal @ by_x @ (states[i] - x_ref[i])
                entries.append(((i - 1) * nx, normal @ by_x))
            if moving:
                along += slope * size.reference
                entries.append((at_s + j, [slope]))
            if elastic:
                entries.append((at_slack + c * slots + slot, [couplings[1]]))
            row(along - g, np.inf, *entries)
        for slot in range(len(obstacles), slots):
            slack = (at_slack + c * slots + slot, [couplings[1]]) if elastic else (0, [])
            row(-np.inf, np.inf, slack)
    spaces = slice(len(rows) - len(where) * slots, len(rows))
    for k in range(at_below, n):
        row(0.0, np.inf, (k, [1.0]))
    if elastic:
        price = np.tile(couplings[0], 2)
        q[at_below:at_slack] = problem.state_slack_weight * price
        q[at_slack:] = problem.slack_weight * couplings[1]
    matrix = np.array(rows)
    return Rebuilt(
        P, q, matrix, np.array(lower), np.array(upper), states, spaces, slice(at_slack, n)
    )


def state_rows(problem):
    """Rows of the bounded states and faces of the speed's polygon: (row, lower, upper, soft)."""
    nx = problem.model.nx
    bounds = zip(np.eye(nx), problem.x_min, problem.x_max, problem.x_soft, strict=True)
    rows = [row for row in bounds if np.isfinite(row[1:3]).any()]
    if problem.speed_max is not None:
        one, other = problem.model.velocity
        for k in range(8):
            face, angle = np.zeros(nx), (2 * k + 1) * np.pi / 16
            face[[one, other]] = np.cos(angle), np.sin(angle)
            rows.append((face / np.cos(np.pi / 16), *np.array([-1, 1]) * problem.speed_max, False))
    return rows


def widened(states, i, face, least, most, soft, elastic):
    """Bounds of a row at stage i + 1, as far as full braking goes where that is beyond."""
    here, after = face @ states[0], face @ states[i + 1]
    if not soft and (elastic or here > most + 1e-9):
        most = max(most, after)
    if not soft and (elastic or here < least - 1e-9):
        least = min(least, after)
    return least, most


def reach(problem, a, u_last):
    """What rates allow of the first input's entry a."""
    if u_last is None:
        return -np.inf, np.inf
    least = min(u_last[a] + problem.du_min[a], problem.u_max[a])
    return least, max(u_last[a] + problem.du_max[a], problem.u_min[a])


def couplings_of(program, problem):
    """The coefficients with which slack enters its rows, read off an elastic program's prices."""
    N, model, size = problem.horizon, problem.model, problem.size
    moving = problem.max_obstacles if size.lower < size.reference else 0
    begin = N * (model.nx + model.nu) + moving
    spare = N * sum(soft for *_, soft in state_rows(problem))
    states = program.q[begin : begin + spare] / problem.state_slack_weight
    return states, float(program.q[-1]) / problem.slack_weight
