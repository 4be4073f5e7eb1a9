"""Costs of a step for constrained learning: named quantities of at least 0.

Costs are separate from rewards. Libraries for safe reinforcement learning keep the sum of
``info["cost"]`` in each episode below a limit.

Users can write a cost function of the result of a step and the controller's view after the step.
The option ``costs`` takes the function itself, its import path, or the name under which
``register_cost`` registered it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.envs.view_terms import HIGHEST_RECOMMENDED_C, LEAST_HEADROOM_K
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
"""Cost function: takes the result of a step and the view after it, and returns one cost of at least
0 per data center, (B,)."""


def hot_inlets(result: StepResult, view: View) -> F64:
    """Excess of inlets over the recommended 27 C, mean of all servers, in K h (ASHRAE TC 9.9)."""
    return result.over_27_mean_k * result.step_h


def hottest_inlet(result: StepResult, view: View) -> F64:
    """Excess of the hottest inlet over the recommended 27 C, in K h."""
    return np.maximum(result.inlet_max_c - HIGHEST_RECOMMENDED_C, 0.0) * result.step_h


def throttled_racks(result: StepResult, view: View) -> F64:
    """Racks that thermal protection throttles or has switched off, in rack hours."""
    return (result.throttled_racks + result.tripped_racks) * result.step_h


def junction_headroom(result: StepResult, view: View) -> F64:
    """Lack of headroom of the hottest GPU junction below 5 K under its throttling limit, in K h."""
    return np.maximum(LEAST_HEADROOM_K - view.junction_headroom_k, 0.0) * result.step_h


def throttled_work(result: StepResult, view: View) -> F64:
    """Work that GPUs at their temperature limit or power cap delay, in tasks."""
    return result.throttled_tasks


def dew_point(result: StepResult, view: View) -> F64:
    """Lack of the lowest setpoint of CDUs to the dew point plus `liquid.dew_margin_k`, in K h."""
    assert view.loops is not None
    return view.loops.dew_shortfall_k(result, view.state) * result.step_h


def overdue_work(result: StepResult, view: View) -> F64:
    """Work past its deadline, counted in each step, and work dropped or lost, in tasks."""
    return result.overdue_tasks + result.dropped_tasks + result.lost_tasks


def grid_overload(result: StepResult, view: View) -> F64:
    """Energy drawn beyond the limit of the grid connection, in kWh."""
    return result.grid_overload_kwh


def fleet_power(result: StepResult, view: View) -> F64:
    """Energy that a fleet draws above its power budget, in kWh, given to sites by their shares."""
    shared = view.fleet.shared_work
    assert shared is not None
    return shared.excess(result.grid_kwh, shared.power_kw(view.sizing.facility_w) * result.step_h)


def fleet_carbon(result: StepResult, view: View) -> F64:
    """Emissions of a fleet, with transfers, above the step's part of its daily budget, in g."""
    shared = view.fleet.shared_work
    assert shared is not None
    emitted = result.carbon_g + result.transfer_g
    return shared.excess(emitted, shared.carbon_limit_g_per_h * result.step_h)


LIQUID_COSTS = (junction_headroom, throttled_work, dew_point)
"""Costs of liquid-cooled racks."""
COSTS: dict[str, CostFunction] = {
    function.__name__: function
    for function in (
        hot_inlets,
        hottest_inlet,
        throttled_racks,
        *LIQUID_COSTS,
        overdue_work,
        grid_overload,
        fleet_power,
        fleet_carbon,
    )
}
"""Built-in costs by name."""
_registered: dict[str, CostFunction] = {}


def register_cost(name: str, cost: CostFunction) -> None:
    """Register a cost function, so that the option ``costs`` accepts its name.

    Args:
        name: Python identifier that no other cost uses.
        cost: the cost function; see ``CostFunction``. It replaces an earlier function of the same
            module and name, for example when a notebook cell runs again.

    Raises:
        ConfigError: the name belongs to another function, or ``cost`` is not a function.
    """
    register_function("cost", name, cost, _registered, reserved=tuple(COSTS))


class Costs:
    """Computes the costs that the option ``costs`` selects.

    Args:
        costs: list of names, functions or import paths, or a dict from these to weights; None
            selects no costs.
        fleet: the data centers.

    Raises:
        ConfigError: a name is unknown or repeated, a weight is not valid, or a cost is always 0 in
            this fleet.
    """

    def __init__(self, costs: Any, fleet: Fleet) -> None:
        self._functions: dict[str, CostFunction] = {}
        self._weights: dict[str, float] = {}
        for cost, weight in _with_weights(costs):
            name, function = _named(cost)
            if name in self._functions:
                raise ConfigError(f"costs: {name!r} is named twice")
            self._functions[name], self._weights[name] = function, _checked_weight(name, weight)
        for function in LIQUID_COSTS:
            name = function.__name__
            if self._functions.get(name) is function and any(
                c.liquid is None for c in fleet.configs
            ):
                raise ConfigError(
                    f"costs: {name} needs liquid-cooled racks; valid with section liquid"
                )
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
        shared = fleet.shared_work
        for name, budgets in (
            ("fleet_power", ("power_limit_kw", "power_limit_ratio")),
            ("fleet_carbon", ("carbon_limit_kg_per_day",)),
        ):
            has_budget = shared is not None and any(
                c.fleet is not None and getattr(c.fleet, field) is not None
                for c in fleet.configs
                for field in budgets
            )
            if self._functions.get(name) is COSTS[name] and not has_budget:
                raise ConfigError(
                    f"costs: {name} is always 0 without a budget; valid with "
                    f"fleet.{' or '.join(budgets)}"
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the costs that ``of`` returns, in order."""
        return ("cost", *(f"cost_{name}" for name in self._functions)) if self._functions else ()

    def of(self, result: StepResult, view: View) -> dict[str, F64]:
        """Return each cost of a step as ``cost_NAME`` and their weighted sum as ``cost``.

        Args:
            result: result of the step.
            view: the controller's view after the step.

        Returns:
            Costs by name, (B,) each; empty without the option ``costs``.

        Raises:
            SdcError: a user's function returned values of a wrong shape, not finite, or below 0.
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
    """Return the Markdown table of costs for docs/environments.md."""
    rows = [f"| `{name}` | {function.__doc__} |" for name, function in COSTS.items()]
    return "\n".join(["| cost | of a step |", "|---|---|", *rows])


def _with_weights(costs: Any) -> list[tuple[Any, Any]]:
    """Return pairs of cost and weight; each weight is 1 if the user named none."""
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
    """Return the name and the function of a cost."""
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
