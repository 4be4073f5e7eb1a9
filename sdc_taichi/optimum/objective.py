"""Objectives of plans, and the figure of a run under an objective."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields

import numpy as np

from sdc_taichi.errors import ConfigError, suggestion
from sdc_taichi.number_text import parse_number
from sdc_taichi.sim.bills import add_power, billed_kw_months, no_demand
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult

_UNITS = {"carbon": "kg CO2e", "energy": "kWh", "cost": "currency of the tariff", "water": "L"}
"""Units of the objectives of one term with weight 1."""
_TERM = re.compile(r"(?:(?P<weight>[^*]+)\*)?(?P<name>[^*]+)")


@dataclass(frozen=True, slots=True)
class Objective:
    """Weights of the terms of an objective, each 0 or more.

    The figure of a run is the sum of ``carbon`` for each kg CO2e, ``energy`` for each kWh that is
    bought, ``cost`` for each unit of the bill, and ``water`` for each litre that is made up.

    Raises:
        ConfigError: a weight that is negative or not finite, or no weight above 0.
    """

    carbon: float = 0.0
    """Weight of a kg CO2e of the energy bought."""
    energy: float = 0.0
    """Weight of a kWh bought."""
    cost: float = 0.0
    """Weight of a unit of the tariff's currency, of energy and of demand charges."""
    water: float = 0.0
    """Weight of a litre of make-up water."""

    def __post_init__(self) -> None:
        """Check the weights."""
        weights = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, weight in weights.items():
            if not 0.0 <= weight < np.inf:
                raise ConfigError(f"objective: weight {weight:g} of {name}; valid is 0 or more")
        if not any(weights.values()):
            raise ConfigError(f"objective: no weight is above 0; valid terms: {', '.join(weights)}")

    @classmethod
    def parse(cls, text: str) -> Objective:
        """An objective from its text, such as ``carbon`` or ``carbon+0.002*water``.

        Args:
            text: names of terms, joined by ``+``, each with a weight before it or with weight 1.

        Raises:
            ConfigError: an unknown term, one that is given twice, or a weight that is no number.
        """
        valid = [f.name for f in fields(cls)]
        weights: dict[str, float] = {}
        for part in text.split("+"):
            term = _TERM.fullmatch(part.strip())
            name = term["name"].strip() if term else part.strip()
            if term is None or name not in valid:
                meant = suggestion(name, valid, " (did you mean {!r}?)")
                raise ConfigError(
                    f"objective {text!r}: {part.strip()!r}; valid are {', '.join(valid)}, and sums "
                    f"such as carbon+0.002*water{meant}"
                )
            if name in weights:
                raise ConfigError(f"objective {text!r}: {name} is given twice; valid is each once")
            try:
                weights[name] = parse_number(term["weight"]) if term["weight"] else 1.0
            except ValueError:
                raise ConfigError(
                    f"objective {text!r}: weight {term['weight']!r} is no number"
                ) from None
        return cls(**weights)

    def __str__(self) -> str:
        """The text that ``parse`` reads."""
        weights = {f.name: getattr(self, f.name) for f in fields(self)}
        return "+".join(
            name if weight == 1.0 else f"{_shortest(weight)}*{name}"
            for name, weight in weights.items()
            if weight
        )

    @property
    def unit(self) -> str:
        """Unit of the figure; of a sum, the text of the objective."""
        return _UNITS.get(str(self), str(self))

    def kwh_weight(self, ci_g_per_kwh: F64, price_per_kwh: F64) -> F64:
        """Weight of a kWh bought in each step, without demand charges, (B, T).

        Args:
            ci_g_per_kwh: Carbon intensity, in g CO2e/kWh, (B, T).
            price_per_kwh: Price, in the currency of the tariff, (B, T).
        """
        return self.energy + self.carbon * ci_g_per_kwh / 1e3 + self.cost * price_per_kwh

    def kw_month_weight(self, fleet: Fleet) -> F64:
        """Weight of each kW of the highest power of a month, (B,)."""
        return np.asarray(self.cost * fleet.values("tariff.demand_charge_per_kw"))

    def figure(self, *, cfp_kg: F64, grid_kwh: F64, cost: F64, water_l: F64) -> F64:
        """The figure of a run, (B,).

        Args:
            cfp_kg: Carbon of the energy bought, in kg CO2e, (B,).
            grid_kwh: Energy bought, in kWh, (B,).
            cost: Bill of energy and demand, in the currency of the tariff, (B,).
            water_l: Make-up water, in l, (B,).
        """
        return (
            self.carbon * cfp_kg + self.energy * grid_kwh + self.cost * cost + self.water * water_l
        )


def _shortest(weight: float) -> str:
    """The shortest text that is read as this very number, without a plus sign."""
    return repr(float(weight)).removesuffix(".0").replace("e+", "e")


class Score:
    """Sums and extremes of the scored steps of B data centers.

    Args:
        objective: objective that the figure counts.
        sim: the simulator, which has been reset and has done no step.
        scored_from: first step that counts.
    """

    def __init__(self, objective: Objective, sim: Simulator, scored_from: int = 0) -> None:
        fleet, start = sim.fleet, sim.drivers.start
        self._objective, self._step_h, self._from = objective, sim.step_h, scored_from
        self._charge_per_kw = fleet.values("tariff.demand_charge_per_kw")
        self._demand = no_demand(start + scored_from, fleet.steps_per_hour)
        names = ("carbon_g", "grid_kwh", "energy_cost", "water_l", "dropped_tasks", "unmet_w")
        self._sums = {name: np.zeros(sim.size) for name in names}
        self._steps = 0
        self.start_kwh, self.start_tasks = _memory(sim)
        """Energy stored, in kWh, and work that waits, in tasks, at the first scored step, (B,)."""
        self.end_kwh, self.end_tasks = _memory(sim)
        """Energy stored, in kWh, and work that waits, in tasks, after the last step, (B,)."""
        self.most_overdue_tasks = np.zeros(sim.size)
        """Most overdue work of a scored step, in tasks, (B,)."""
        self.hottest_inlet_c = np.full(sim.size, -np.inf)
        """Hottest inlet of the scored steps, in C, (B,)."""

    def add(self, result: StepResult) -> None:
        """Add the step that follows those added before."""
        self.end_kwh = result.stored_kwh.copy()
        self.end_tasks = result.queue_tasks.copy()
        if result.step < self._from:
            self.start_kwh, self.start_tasks = self.end_kwh, self.end_tasks
            return
        add_power(self._demand, self._steps, result.grid_kwh / self._step_h)
        self._steps += 1
        for name, total in self._sums.items():
            total += getattr(result, name)
        np.maximum(self.most_overdue_tasks, result.overdue_tasks, out=self.most_overdue_tasks)
        np.maximum(self.hottest_inlet_c, result.inlet_max_c, out=self.hottest_inlet_c)

    @property
    def figure(self) -> F64:
        """The figure of the scored steps, in the unit of the objective, (B,)."""
        kw_months = billed_kw_months(self._demand, self._steps)
        return self._objective.figure(
            cfp_kg=self._sums["carbon_g"] / 1e3,
            grid_kwh=self._sums["grid_kwh"],
            cost=self._sums["energy_cost"] + kw_months * self._charge_per_kw,
            water_l=self._sums["water_l"],
        )

    @property
    def dropped_tasks(self) -> F64:
        """Work that found the queue full, in tasks, (B,)."""
        return self._sums["dropped_tasks"]

    @property
    def unmet_kwh(self) -> F64:
        """Heat that stayed in the room, in kWh, (B,)."""
        return self._sums["unmet_w"] * self._step_h / 1e3


def _memory(sim: Simulator) -> tuple[F64, F64]:
    """Energy stored, in kWh, and work that waits, in tasks, of each data center, (B,)."""
    state = sim.state
    return state.stored_kwh.copy(), state.queue[:, -1].copy()
