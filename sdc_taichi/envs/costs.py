"""Costs of a step for constrained learning: named quantities of at least 0.

Costs are separate from rewards. Libraries for safe reinforcement learning keep the sum of
``info["cost"]`` over an episode below a limit.

A user's cost function takes the result of a step and the view after it. The option ``costs`` takes
the function, the name under which ``register_cost`` registered it, or its import path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, StepResult
from sdc_taichi.user_functions import (
    checked_values,
    function_named,
    import_path,
    register_function,
)

CostFunction = Callable[[StepResult, View], Any]
"""Cost function of the result of a step and the view after it; returns values of at least 0,
(B,)."""


def hot_inlets(result: StepResult, view: View) -> F64:
    """Inlet temperature above the recommended 27 C, mean over servers, K h (ASHRAE TC 9.9)."""
    return result.over_27_mean_k * result.step_h


def throttled_racks(result: StepResult, view: View) -> F64:
    """Racks that protection throttles or has switched off, rack h."""
    return (result.throttled_racks + result.tripped_racks) * result.step_h


def overdue_work(result: StepResult, view: View) -> F64:
    """Work past its deadline in each step that it waits, and work dropped or lost, tasks."""
    return result.overdue_tasks + result.dropped_tasks + result.lost_tasks


def grid_overload(result: StepResult, view: View) -> F64:
    """Energy drawn beyond the limit of the grid connection, kWh."""
    return result.grid_overload_kwh


COSTS: dict[str, CostFunction] = {
    function.__name__: function
    for function in (hot_inlets, throttled_racks, overdue_work, grid_overload)
}
"""Built-in costs by name."""
_registered: dict[str, CostFunction] = {}


def register_cost(name: str, cost: CostFunction) -> None:
    """Make a function available as a name in the option ``costs``.

    Args:
        name: an identifier that no other cost has.
        cost: the function; see ``CostFunction``. It replaces an earlier function of the same module
            and name, for example when a notebook cell runs again.

    Raises:
        ConfigError: the name belongs to another function, or ``cost`` is no function.
    """
    register_function("cost", name, cost, _registered, reserved=tuple(COSTS))


class Costs:
    """Costs of the option ``costs``.

    Args:
        costs: names, functions or import paths, or a dict from them to weights; None for no costs.
        fleet: the data centers.

    Raises:
        ConfigError: an unknown name, one given twice, a weight that is not valid, or a cost that is
            always 0.
    """

    def __init__(self, costs: Any, fleet: Fleet) -> None:
        self._functions: dict[str, CostFunction] = {}
        self._weights: dict[str, float] = {}
        for cost, weight in _with_weights(costs):
            name, function = _named(cost)
            if name in self._functions:
                raise ConfigError(f"costs: {name!r} is named twice")
            self._functions[name], self._weights[name] = function, _checked_weight(name, weight)
        unprotected = all(c.protection.ashrae_class is None for c in fleet.configs)
        if self._functions.get("throttled_racks") is throttled_racks and unprotected:
            raise ConfigError(
                "costs: throttled_racks is always 0 without protection; valid with "
                "protection.ashrae_class"
            )

        limits = [c.electrical for c in fleet.configs]
        unlimited = all(x.grid_limit_kw is x.grid_limit_ratio is None for x in limits)
        if self._functions.get("grid_overload") is grid_overload and unlimited:
            raise ConfigError(
                "costs: grid_overload is always 0 without a limit; valid with "
                "electrical.grid_limit_kw or grid_limit_ratio"
            )

    def of(self, result: StepResult, view: View) -> dict[str, F64]:
        """Costs of a step: their weighted sum as ``cost``, each as ``cost_NAME``, (B,) each.

        Args:
            result: the step.
            view: the view after it.

        Returns:
            Costs by name; empty without the option ``costs``.

        Raises:
            SdcError: a user's function returned values of another shape, not finite, or below 0.
        """
        if not self._functions:
            return {}
        out = {"cost": np.zeros(view.size)}
        for name, function in self._functions.items():
            cost = function(result, view)
            if function is not COSTS.get(name):
                cost = checked_values(f"cost {name}", cost, "all data centers", view.size)
                if (cost < 0.0).any():
                    raise SdcError(f"cost {name}: returned {cost.min():g}; valid is at least 0")
            out["cost"] += self._weights[name] * cost
            out[f"cost_{name}"] = cost
        return out


def costs_markdown() -> str:
    """The table of costs in docs/environments.md."""
    rows = [f"| `{name}` | {function.__doc__} |" for name, function in COSTS.items()]
    return "\n".join(["| cost | of a step |", "|---|---|", *rows])


def _with_weights(costs: Any) -> list[tuple[Any, Any]]:
    """Costs and their weights; without weights each is 1."""
    if costs is None:
        return []
    if isinstance(costs, Mapping) and costs:
        return list(costs.items())
    if isinstance(costs, Sequence) and not isinstance(costs, str | bytes) and costs:
        return [(cost, 1.0) for cost in costs]
    raise ConfigError(
        f"costs {shortened(costs)}: valid is None, a list of costs, or a dict of cost to weight; "
        f"costs are {', '.join([*COSTS, *_registered])}, functions, and import paths module:name"
    )


def _named(cost: Any) -> tuple[str, CostFunction]:
    """Name and function of a cost."""
    if not callable(cost):
        function = function_named(
            "cost", cost, COSTS | _registered, valid=", ".join([*COSTS, *_registered])
        )
        return str(cost).rpartition(":")[2], function
    name = getattr(cost, "__name__", type(cost).__name__)
    if not name.isidentifier():
        raise ConfigError(
            f"cost {import_path(cost)}: has no name; valid is a function with a name, or one that "
            "register_cost gave a name"
        )
    return name, cost


def _checked_weight(name: str, weight: Any) -> float:
    number = isinstance(weight, int | float | np.number) and not isinstance(weight, bool)
    if not number or not 0.0 <= weight < np.inf:
        raise ConfigError(
            f"costs: {name} has weight {shortened(weight)}; valid is a number of at least 0"
        )
    return float(weight)
