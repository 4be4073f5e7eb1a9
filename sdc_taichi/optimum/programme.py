"""A linear programme in named blocks of variables and rows, solved by HiGHS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from sdc_taichi.types import F64

Matrix = Any
"""A sparse matrix of ``scipy.sparse``."""

_ATTEMPTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("highs-ds", {"presolve": False, "simplex_dual_edge_weight_strategy": "devex"}),
    ("highs-ds", {}),
    ("highs-ipm", {}),
)
"""Methods and options in the order in which they are tried.

The dual simplex method takes a third less with Devex pricing; presolve now and then takes fifty
times as long as all the rest. The interior point method takes several times as long.
"""
_RELIEFS = (0.0, 1e-7, 1e-6)
"""By how much right-hand sides are raised for the attempts, over the largest of them.

Rows that hold by rounding alone, as those of a battery that is full at the beginning, may keep the
solver from telling that it has found an optimum. Raised, they allow more, so that a bound is one.
"""
_INFEASIBLE = 2
"""Status of ``scipy.optimize.linprog`` for rows that contradict each other."""


class InfeasibleError(Exception):
    """No values of the variables keep all rows and bounds."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Values at which a linear programme is least."""

    figure: float
    """The least value of the sum."""
    values: Mapping[str, F64]
    """Values of each block of variables, by its name."""
    prices: Mapping[str, F64]
    """Rise of the figure with the right-hand side of each named block of rows."""


class Programme:
    """A linear programme: minimise a sum over variables within bounds, subject to rows.

    Variables and rows come in blocks, of which rows name those of variables that they read.
    """

    def __init__(self) -> None:
        self.sizes: dict[str, int] = {}
        """Number of variables of each block, by its name."""
        self._lower: list[F64] = []
        self._upper: list[F64] = []
        self._cost: dict[str, F64] = {}
        self._equal: list[tuple[str, F64, Mapping[str, Matrix]]] = []
        self._at_most: list[tuple[str, F64, Mapping[str, Matrix]]] = []

    def variables(
        self,
        name: str,
        size: int,
        *,
        lower: F64 | float = 0.0,
        upper: F64 | float = np.inf,
        cost: F64 | float = 0.0,
    ) -> None:
        """Add a block of variables.

        Args:
            name: of the block.
            size: number of variables, n.
            lower: Least value of each, (n,).
            upper: Largest value of each, (n,).
            cost: What a unit of each adds to the sum, (n,).
        """
        self.sizes[name] = size
        self._lower.append(np.broadcast_to(np.asarray(lower, float), size))
        self._upper.append(np.broadcast_to(np.asarray(upper, float), size))
        self._cost[name] = np.broadcast_to(np.asarray(cost, float), size)

    def add_cost(self, name: str, cost: F64) -> None:
        """Add to what a unit of each variable of a block adds to the sum.

        Args:
            name: of the block.
            cost: What is added, (n,).
        """
        self._cost[name] = self._cost[name] + cost

    def equal(self, name: str, right: F64, **blocks: Matrix) -> None:
        """Add rows whose sum over variables equals the right-hand side.

        Args:
            name: of the block of rows.
            right: Right-hand sides, (m,).
            blocks: Coefficients of the variables of each block, (m, n).
        """
        self._equal.append((name, right, blocks))

    def at_most(self, name: str, right: F64, **blocks: Matrix) -> None:
        """Add rows whose sum over variables is at most the right-hand side.

        Args:
            name: of the block of rows.
            right: Right-hand sides, (m,).
            blocks: Coefficients of the variables of each block, (m, n).
        """
        self._at_most.append((name, right, blocks))

    def solve(self) -> Solution:
        """The least sum, and where it is.

        Raises:
            InfeasibleError: no values keep all rows and bounds.
            RuntimeError: the solver found no optimum.
        """
        from scipy.optimize import linprog

        if not self.sizes:
            return Solution(0.0, {}, {})
        upper, upper_right = self._matrix(self._at_most)
        equal, equal_right = self._matrix(self._equal)
        bounds = np.stack([np.concatenate(self._lower), np.concatenate(self._upper)], axis=1)
        if np.any(bounds[:, 0] > bounds[:, 1]):
            raise InfeasibleError
        room = 0.0 if upper_right is None else max(1.0, float(np.abs(upper_right).max()))
        for relief, (method, options) in product(_RELIEFS, _ATTEMPTS):
            found = linprog(
                np.concatenate(list(self._cost.values())),
                A_ub=upper,
                b_ub=None if upper_right is None else upper_right + relief * room,
                A_eq=equal,
                b_eq=equal_right,
                bounds=bounds,
                method=method,
                options=options,
            )
            if found.status == 0:
                break
        if found.status == _INFEASIBLE:
            raise InfeasibleError
        if found.status != 0:
            raise RuntimeError(f"linear programme: {found.message}")
        return Solution(
            float(found.fun),
            _split(found.x, self.sizes),
            _split(found.ineqlin.marginals, {n: len(r) for n, r, _ in self._at_most})
            | _split(found.eqlin.marginals, {n: len(r) for n, r, _ in self._equal}),
        )

    def _matrix(
        self, rows: list[tuple[str, F64, Mapping[str, Matrix]]]
    ) -> tuple[Matrix | None, F64 | None]:
        """Coefficients and right-hand sides of blocks of rows, None where there are none."""
        from scipy import sparse

        if not rows:
            return None, None
        blocks = [
            [
                b[name] if name in b else sparse.csr_array((len(right), size))
                for name, size in self.sizes.items()
            ]
            for _, right, b in rows
        ]
        return sparse.block_array(blocks, format="csc"), np.concatenate([r for _, r, _ in rows])


def _split(values: F64, sizes: Mapping[str, int]) -> dict[str, F64]:
    """Values end to end, by the names and sizes of their blocks."""
    found, first = {}, 0
    for name, size in sizes.items():
        found[name] = values[first : first + size]
        first += size
    return found
