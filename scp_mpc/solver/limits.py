"""Rows and variables of the sparse program for bounds of states and of rates.

Notation:
    e_i = x_i - xref_i      deviation from the reference, as in `subproblem.py`
    below, above (N, ..)    what a state is beyond its lower, its upper bounds, where it has one
    v                       `Problem.state_slack_weight`

    states      x_min - xref_i <= e_i + below_i - above_i <= x_max - xref_i
    excess      below >= 0, above >= 0, at a cost of v per unit
    rates       du_min <= u_i - u_{i-1} <= du_max, i = 1 .. N-1, and u_0 within `Problem.reach`

A problem without such bounds has none of these rows and variables. The multipliers of the excess
follow from those y of the states: -(v + y) for what is below, y - v for what is above.
"""

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.problem import Problem
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.program import QuadraticProgram
from scp_mpc.qp.sparse_blocks import SparseBlocks

_PAID = 0.01  # share of v; an excess whose bound pushes by more less than v is not meant


class Limits:
    """The part of the sparse program that bounds states and rates.

    Initialisation: sizes; then `place` what stands before, `add` the blocks, `write_constants`.

    Usage: `write_step` once per control step; `pack` and `unpack` as the subproblem does.

    Args:
        problem: Whose bounds.

    Attributes:
        columns: Number of variables.
        rows: Number of rows.
    """

    def __init__(self, problem: Problem) -> None:
        """Count variables and rows."""
        self._problem, N = problem, problem.horizon
        self._bounded = problem.bounded_states
        self._low = np.flatnonzero(np.isfinite(problem.x_min[self._bounded]))
        self._high = np.flatnonzero(np.isfinite(problem.x_max[self._bounded]))
        finite = np.isfinite(problem.du_min) | np.isfinite(problem.du_max)
        self._limited = np.flatnonzero(finite)
        self._sizes = [N * len(part) for part in (self._low, self._high)]
        self.columns = sum(self._sizes)
        self._counts = [N * len(self._bounded), self.columns, N * len(self._limited)]
        self.rows = sum(self._counts)

    def place(self, column: int, row: int) -> None:
        """Take the first column and the first row that are free."""
        below, above = self._sizes
        states, excess, rates = self._counts
        self._below, self._above = (
            slice(column, column + below),
            slice(column + below, column + below + above),
        )
        self._states = slice(row, row + states)
        self._excess = slice(row + states, row + states + excess)
        self._rates = slice(row + states + excess, row + states + excess + rates)

    def add(self, blocks: SparseBlocks, state: IntArray, control: IntArray) -> None:
        """Add the blocks, given the columns (N, nx) of deviations and (N, nu) of inputs."""
        if self._problem.limits_states:
            row = self._table(self._states, len(self._bounded))
            blocks.add("bounded states", row, state[:, self._bounded], 1.0)
            below, above = (
                self._table(self._below, len(self._low)),
                self._table(self._above, len(self._high)),
            )
            blocks.add("below", row[:, self._low], below, 1.0)
            blocks.add("above", row[:, self._high], above, -1.0)
            over = np.arange(self._below.start, self._above.stop)
            blocks.add("excess", np.arange(self._excess.start, self._excess.stop), over, 1.0)
        if self._problem.limits_rates:
            row, inputs = self._table(self._rates, len(self._limited)), control[:, self._limited]
            blocks.add("rates, after", row, inputs, 1.0)
            blocks.add("rates, before", row[1:], inputs[:-1], -1.0)

    def write_constants(self, program: QuadraticProgram) -> None:
        """Write the price of an excess and the bounds that stay."""
        problem = self._problem
        program.q[self._below.start : self._above.stop] = problem.state_slack_weight
        program.lower[self._excess] = 0.0
        program.lower[self._rates] = np.tile(problem.du_min[self._limited], problem.horizon)
        program.upper[self._rates] = np.tile(problem.du_max[self._limited], problem.horizon)

    def write_step(
        self, program: QuadraticProgram, reference: FloatArray, u_last: FloatArray | None
    ) -> None:
        """Write what depends on the reference (N, nx) of a step and the input last applied."""
        problem = self._problem
        if problem.limits_states:
            about = reference[:, self._bounded]
            program.lower[self._states] = (problem.x_min[self._bounded] - about).ravel()
            program.upper[self._states] = (problem.x_max[self._bounded] - about).ravel()
        if problem.limits_rates:
            first = slice(self._rates.start, self._rates.start + len(self._limited))
            lower, upper = problem.reach(u_last)
            program.lower[first], program.upper[first] = lower[self._limited], upper[self._limited]

    def pack(self, iterate: Iterate, z: FloatArray, y: FloatArray) -> None:
        """Write an iterate's excess and multipliers into z and y.

        An excess that its bound's multiplier does not pay for is left out: it violates the bound.
        """
        problem, duals = self._problem, iterate.multipliers
        if problem.limits_states:
            v, x = problem.state_slack_weight, iterate.states[1:, self._bounded]
            force = np.zeros(x.shape)
            if duals is not None and duals.states.size:
                force = duals.states
            low, high = force[:, self._low] + v, v - force[:, self._high]
            lower, upper = problem.x_min[self._bounded], problem.x_max[self._bounded]
            below = np.maximum(0.0, (lower - x)[:, self._low])
            above = np.maximum(0.0, (x - upper)[:, self._high])
            z[self._below] = np.where(low <= _PAID * v, below, 0.0).ravel()
            z[self._above] = np.where(high <= _PAID * v, above, 0.0).ravel()
            y[self._states] = force.ravel()
            y[self._excess] = -np.concatenate([low.ravel(), high.ravel()])
        if problem.limits_rates and duals is not None and duals.rates.size:
            y[self._rates] = duals.rates[:, self._limited].ravel()

    def unpack(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the multipliers of states (N, nb) and of rates (N, nu); empty without bounds."""
        problem, N = self._problem, self._problem.horizon
        states = rates = np.zeros((0, 0))
        if problem.limits_states:
            states = y[self._states].reshape(N, -1)
        if problem.limits_rates:
            rates = np.zeros((N, problem.model.nu))
            rates[:, self._limited] = y[self._rates].reshape(N, -1)
        return states, rates

    def _table(self, part: slice, columns: int) -> IntArray:
        return np.arange(part.start, part.stop).reshape(self._problem.horizon, columns)
