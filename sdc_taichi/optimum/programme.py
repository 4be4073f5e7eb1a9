"""Linear programmes as equations between blocks of variables, solved with HiGHS.

The example charges a battery within three hours at changing prices; it must be full at the end::

    programme = Programme()
    charge = programme.variables("charge", 3, upper=2.0, cost=np.array([0.3, 0.1, 0.2]))
    stored = programme.variables("stored", 3, upper=4.0)
    programme.equal("energy", stored, stored.before(1.0) + 0.9 * charge)
    programme.at_most("full", 4.0, stored[-1])
    solution = programme.solve()
    solution.of(stored)  # array of the energy stored after each hour
    solution.prices["full"]  # dual price of the row: cost per kWh that must be stored at the end

``charge``, ``stored`` and expressions of them are ``Linear`` objects. Such an object has one row
for each step; a row is a constant plus a sum of variables with coefficients. The solver receives
blocks and rows in the order in which they were added.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from sdc_taichi.hall.protection import Mask
from sdc_taichi.types import F64, I64

Matrix = Any
"""A sparse matrix of ``scipy.sparse``."""

_ATTEMPTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("highs-ds", {"presolve": False, "simplex_dual_edge_weight_strategy": "devex"}),
    ("highs-ds", {}),
    ("highs-ipm", {}),
)
"""HiGHS methods and options, in the order in which they are tried.

The dual simplex method without presolve and with Devex pricing is the fastest. Devex pricing saves
a third of the time. Presolve sometimes takes fifty times as long as the rest of the solution. The
interior point method always takes several times as long as the dual simplex method.
"""
_RELIEFS = (0.0, 1e-7, 1e-6)
"""Relaxations of the upper limits of rows, tried in order, as a share of the largest limit.

Rows that hold only up to rounding errors, such as those of an initially full battery, can prevent
the solver from recognising an optimum. Relaxed limits allow more solutions, so the minimum is still
a lower bound.
"""
_INFEASIBLE = 2
"""Status that ``scipy.optimize.linprog`` returns for an infeasible problem."""

_COST_LIMITS = (0.01, 1e12)
"""Limits of the largest cost coefficient that the solver receives. Its tolerances are absolute, and
it takes costs of 1e20 for infinite, so others are scaled."""


class InfeasibleError(Exception):
    """No values of the variables satisfy all rows and bounds."""


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Linear expressions of variables, one per row: m rows of matrices @ variables + constant.

    Expressions, arrays (m,) and numbers can be added and subtracted. An operand with one row is
    repeated to the number of rows of the other operand.
    """

    constant: F64
    """Constant of each row, (m,)."""
    terms: Mapping[str, Matrix] = field(default_factory=dict)
    """Coefficients of the variables of each block, by its name, (m, n) each."""

    __array_ufunc__ = None  # NumPy arrays leave arithmetic with expressions to this class.

    def __len__(self) -> int:
        """Number of rows, m."""
        return len(self.constant)

    def __add__(self, other: Linear | F64 | float) -> Linear:
        """Sum of two expressions, row by row."""
        right = _linear(other)
        rows = len(right) if len(self) == 1 else len(self)
        left, right = self._repeated(rows), right._repeated(rows)
        terms = dict(left.terms)
        for name, matrix in right.terms.items():
            terms[name] = terms[name] + matrix if name in terms else matrix
        return Linear(left.constant + right.constant, terms)

    __radd__ = __add__

    def __mul__(self, factor: float) -> Linear:
        """Every row times a number."""
        terms = {name: factor * matrix for name, matrix in self.terms.items()}
        return Linear(factor * self.constant, terms)

    __rmul__ = __mul__

    def __neg__(self) -> Linear:
        """Every row with the opposite sign."""
        return -1.0 * self

    def __sub__(self, other: Linear | F64 | float) -> Linear:
        """Difference of two expressions, row by row."""
        return self + -1.0 * _linear(other)

    def __getitem__(self, rows: int | I64 | Mask) -> Linear:
        """Select rows by index or by a boolean mask (m,)."""
        index = np.arange(len(self))[np.atleast_1d(rows)]
        return Linear(self.constant[index], {n: matrix[index] for n, matrix in self.terms.items()})

    def sum(self) -> Linear:
        """Return the sum of all rows as an expression with one row."""
        return self._times(np.ones((1, len(self))))

    def shifted(self, steps: int) -> Linear:
        """Return rows shifted by ``steps``: row i is the old row i - steps, or 0 without one."""
        from scipy import sparse

        return self._times(sparse.eye_array(len(self), k=-min(steps, len(self)), format="csr"))

    def before(self, start: Linear | float) -> Linear:
        """Return the predecessor of each row; the predecessor of the first row is ``start``."""
        first = np.zeros((len(self), 1))
        first[0] = 1.0
        return self.shifted(1) + _linear(start)._times(first)

    def _repeated(self, rows: int) -> Linear:
        return self if len(self) == rows else self._times(np.ones((rows, 1)))

    def _times(self, matrix: Matrix) -> Linear:
        """Return a matrix, (k, m), times the m rows."""
        from scipy import sparse

        factor = sparse.csr_array(matrix)
        return Linear(factor @ self.constant, {n: factor @ m for n, m in self.terms.items()})


@dataclass(frozen=True, slots=True)
class Solution:
    """Optimal solution of a linear programme."""

    figure: float
    """Minimum of the objective."""
    values: Mapping[str, F64]
    """Optimal values of each block of variables, by the block's name."""
    prices: Mapping[str, F64]
    """Dual prices: rise of the figure per unit of a row's right-hand side, by name of the block of
    rows."""

    def of(self, expression: Linear) -> F64:
        """Return the value of each row of an expression at the optimum, (m,)."""
        value = expression.constant.copy()
        for name, matrix in expression.terms.items():
            value += matrix @ self.values[name]
        return value


class Programme:
    """A linear programme: minimises a weighted sum of bounded variables subject to rows."""

    def __init__(self) -> None:
        self._sizes: dict[str, int] = {}
        self._lower: list[F64] = []
        self._upper: list[F64] = []
        self._cost: dict[str, F64] = {}
        self._equal: dict[str, Linear] = {}
        self._at_most: dict[str, Linear] = {}

    def variables(
        self,
        name: str,
        size: int,
        *,
        lower: F64 | float = 0.0,
        upper: F64 | float = np.inf,
        cost: F64 | float = 0.0,
    ) -> Linear:
        """Add a block of variables.

        Args:
            name: Name of the block.
            size: Number of variables, n.
            lower: Lower bound of each variable, (n,) or one number.
            upper: Upper bound of each variable, (n,) or one number.
            cost: Coefficient of each variable in the objective, (n,) or one number.

        Returns:
            Expressions of the single variables, n rows.
        """
        from scipy import sparse

        self._sizes[name] = size
        self._lower.append(np.broadcast_to(np.asarray(lower, float), size))
        self._upper.append(np.broadcast_to(np.asarray(upper, float), size))
        self._cost[name] = np.broadcast_to(np.asarray(cost, float), size)
        return Linear(np.zeros(size), {name: sparse.eye_array(size, format="csr")})

    def add_cost(self, name: str, cost: F64) -> None:
        """Increase the objective's coefficients of a block of variables by ``cost``, (n,)."""
        self._cost[name] = self._cost[name] + cost

    def equal(self, name: str, left: Linear, right: Linear | F64 | float) -> None:
        """Require that two expressions are equal in every row.

        Args:
            name: Name of the block of rows.
            left: First expression, m rows.
            right: Second expression, m rows, an array (m,), or a number.
        """
        self._equal[name] = left - right

    def at_most(self, name: str, left: Linear | F64 | float, right: Linear | F64 | float) -> None:
        """Require that an expression is at most another in every row.

        Args:
            name: Name of the block of rows.
            left: Expression that must not be larger, m rows.
            right: Expression that must not be smaller, m rows.
        """
        self._at_most[name] = _linear(left) - right

    def solve(self) -> Solution:
        """Minimise the objective.

        Raises:
            InfeasibleError: No values satisfy all rows and bounds.
            RuntimeError: The solver found no optimum.
        """
        from scipy.optimize import linprog

        if not self._sizes:
            return Solution(0.0, {}, {})
        upper, upper_right = self._matrix(self._at_most)
        equal, equal_right = self._matrix(self._equal)
        bounds = np.stack([np.concatenate(self._lower), np.concatenate(self._upper)], axis=1)
        if np.any(bounds[:, 0] > bounds[:, 1]):
            raise InfeasibleError
        largest = 0.0 if upper_right is None else max(1.0, float(np.abs(upper_right).max()))
        cost = np.concatenate(list(self._cost.values()))
        scale = _scale(cost)
        for relief, (method, options) in product(_RELIEFS, _ATTEMPTS):
            result = linprog(
                cost * scale,
                A_ub=upper,
                b_ub=None if upper_right is None else upper_right + relief * largest,
                A_eq=equal,
                b_eq=equal_right,
                bounds=bounds,
                method=method,
                options=options,
            )
            if result.status == 0:
                break
        if result.status == _INFEASIBLE:
            raise InfeasibleError
        if result.status != 0:
            raise RuntimeError(f"linear programme: {result.message}")
        rows = [{n: len(row) for n, row in block.items()} for block in (self._at_most, self._equal)]
        return Solution(
            float(result.fun) / scale,
            _split(result.x, self._sizes),
            _split(result.ineqlin.marginals / scale, rows[0])
            | _split(result.eqlin.marginals / scale, rows[1]),
        )

    def _matrix(self, rows: Mapping[str, Linear]) -> tuple[Matrix | None, F64 | None]:
        """Return coefficients and right-hand sides of blocks of rows; None if there are no rows."""
        from scipy import sparse

        if not rows:
            return None, None
        blocks = [
            [
                row.terms.get(name, sparse.csr_array((len(row), size)))
                for name, size in self._sizes.items()
            ]
            for row in rows.values()
        ]
        right = np.concatenate([-row.constant for row in rows.values()])
        return sparse.block_array(blocks, format="csc"), right


def _scale(cost: F64) -> float:
    """Return the factor, a power of two, by which the solver receives costs, (n,)."""
    largest = float(np.abs(cost).max())
    low, high = _COST_LIMITS
    if largest == 0.0 or low <= largest <= high:
        return 1.0
    return math.ldexp(1.0, -math.frexp(largest)[1])


def _linear(value: Linear | F64 | float) -> Linear:
    """Return an expression unchanged; convert an array or a number to a constant expression."""
    return value if isinstance(value, Linear) else Linear(np.atleast_1d(np.asarray(value, float)))


def _split(values: F64, sizes: Mapping[str, int]) -> dict[str, F64]:
    """Split concatenated values into blocks of given names and sizes."""
    ends = np.cumsum([*sizes.values()], dtype=np.int64)
    return dict(zip(sizes, np.split(values, ends), strict=False))
