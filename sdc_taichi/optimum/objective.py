"""Objectives of plans, and the value of an objective for a simulated run."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace

import numpy as np

from sdc_taichi.errors import ConfigError, suggestion
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.number_text import parse_number
from sdc_taichi.sim.bills import add_power, billed_kw_months, no_demand
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult

_UNITS = {
    "carbon": "kg CO2e",
    "energy": "kWh",
    "cost": "currency of the tariff",
    "water": "L",
    "heat": "K h",
}
"""Units of the objectives that consist of a single term with weight 1."""
WEIGHT_LIMITS = (1e-100, 1e100)
"""Limits of weights above 0, within which figures neither overflow nor lose digits."""
_TERM = re.compile(r"(?:(?P<weight>[^*]+)\*)?(?P<name>[^*]+)")


@dataclass(frozen=True, slots=True)
class Objective:
    """Weights of the terms of an objective, each at least 0.

    The figure of a run is the value of its objective: the weighted sum of the emissions in kg CO2e,
    the energy bought in kWh, the electricity bill, the make-up water in litres, and the heat of the
    hottest inlet in K h.

    Raises:
        ConfigError: a weight is neither 0 nor within 1e-100..1e100, or no weight is above 0.
    """

    carbon: float = 0.0
    """Weight of a kg CO2e emitted by the energy bought."""
    energy: float = 0.0
    """Weight of a kWh bought."""
    cost: float = 0.0
    """Weight of a currency unit of the electricity bill, which adds energy and demand charges."""
    water: float = 0.0
    """Weight of a litre of make-up water."""
    heat: float = 0.0
    """Weight of an hour in which the hottest server inlet is 1 K above the recommended 27 C; plans
    do not support it."""

    def __post_init__(self) -> None:
        """Check the weights."""
        weights = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, weight in weights.items():
            low, high = WEIGHT_LIMITS
            if weight != 0.0 and not low <= weight <= high:
                raise ConfigError(
                    f"objective: weight {weight:g} of {name}; valid is 0, or {low:g} to {high:g}"
                )
        if not any(weights.values()):
            raise ConfigError(f"objective: no weight is above 0; valid terms: {', '.join(weights)}")

    @classmethod
    def parse(cls, text: str) -> Objective:
        """Create an objective from text such as ``carbon`` or ``carbon+0.002*water``.

        Args:
            text: names of terms, joined by ``+``. A term without a weight has weight 1.

        Raises:
            ConfigError: a term is unknown or repeated, or a weight is not a number.
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
        """Return the text from which ``parse`` creates this objective."""
        weights = {f.name: getattr(self, f.name) for f in fields(self)}
        return "+".join(
            name if weight == 1.0 else f"{_shortest(weight)}*{name}"
            for name, weight in weights.items()
            if weight
        )

    @property
    def of_energy(self) -> str:
        """Text of the terms that give a kWh its value: carbon, energy and cost; empty if none."""
        weights = (self.carbon, self.energy, self.cost)
        return str(replace(self, water=0.0, heat=0.0)) if any(weights) else ""

    @property
    def unit(self) -> str:
        """Unit of the figure; an objective with several terms has its text as unit."""
        return _UNITS.get(str(self), str(self))

    def kwh_weight(self, ci_g_per_kwh: F64, price_per_kwh: F64) -> F64:
        """Return the weight of a kWh bought in each step, without demand charges, (B, T).

        Args:
            ci_g_per_kwh: Carbon intensity, in g CO2e/kWh, (B, T).
            price_per_kwh: Price, in the currency of the tariff, (B, T).
        """
        return self.energy + self.carbon * ci_g_per_kwh / 1e3 + self.cost * price_per_kwh

    def kw_month_weight(self, fleet: Fleet) -> F64:
        """Return the weight of a kW of the month's highest power, (B,)."""
        return np.asarray(self.cost * fleet.values("tariff.demand_charge_per_kw"))

    def figure(
        self,
        *,
        cfp_kg: F64,
        grid_kwh: F64,
        cost: F64,
        water_l: F64,
        heat_kh: F64 | float = 0.0,
    ) -> F64:
        """Return the figure of a run of B data centers, (B,).

        Args:
            cfp_kg: Carbon of the energy bought, in kg CO2e, (B,).
            grid_kwh: Energy bought, in kWh, (B,).
            cost: Bill of energy and demand, in the currency of the tariff, (B,).
            water_l: Make-up water, in l, (B,).
            heat_kh: Excess of the hottest inlet over 27 C, summed over time, in K h, (B,) or 0.
        """
        without_heat = (
            self.carbon * cfp_kg + self.energy * grid_kwh + self.cost * cost + self.water * water_l
        )
        return without_heat + self.heat * heat_kh if self.heat else without_heat


CARBON = Objective(carbon=1.0)
"""Objective of controllers whose name does not state one."""


def _shortest(weight: float) -> str:
    """Return the shortest text, without plus signs, that ``float`` converts to this number."""
    return repr(float(weight)).removesuffix(".0").replace("e+", "e")


class Score:
    """Accumulates sums and extremes of the scored steps of B data centers.

    Args:
        objective: objective whose value the figure is.
        sim: the simulator, directly after a reset.
        scored_from: number of the first scored step.
    """

    def __init__(self, objective: Objective, sim: Simulator, scored_from: int = 0) -> None:
        fleet, start = sim.fleet, sim.drivers.start
        self._objective, self._step_h, self._from = objective, sim.step_h, scored_from
        self._charge_per_kw = fleet.values("tariff.demand_charge_per_kw")
        self._demand = no_demand(start + scored_from, fleet.steps_per_hour)
        names = ("carbon_g", "grid_kwh", "energy_cost", "water_l", "dropped_tasks", "unmet_w")
        self._sums = {name: np.zeros(sim.size) for name in names}
        self._heat_kh = np.zeros(sim.size)
        self._steps = 0
        self.start_kwh, self.start_tasks = _memory(sim)
        """Stored energy in kWh, and waiting work in tasks, at the first scored step, (B,) each."""
        self.end_kwh, self.end_tasks = _memory(sim)
        """Stored energy in kWh, and waiting work in tasks, after the last step, (B,) each."""
        self.most_overdue_tasks = np.zeros(sim.size)
        """Maximum overdue work in a scored step, in tasks, (B,)."""
        self.hottest_inlet_c = np.full(sim.size, -np.inf)
        """Highest inlet temperature in the scored steps, in C, (B,)."""

    def add(self, result: StepResult) -> None:
        """Add the result of the next step; steps must be added in order."""
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
        excess_k = np.maximum(result.inlet_max_c - RECOMMENDED_C[1], 0.0)
        self._heat_kh += excess_k * self._step_h

    @property
    def figure(self) -> F64:
        """Value of the objective for the scored steps, (B,)."""
        kw_months = billed_kw_months(self._demand, self._steps)
        return self._objective.figure(
            cfp_kg=self._sums["carbon_g"] / 1e3,
            grid_kwh=self._sums["grid_kwh"],
            cost=self._sums["energy_cost"] + kw_months * self._charge_per_kw,
            water_l=self._sums["water_l"],
            heat_kh=self._heat_kh,
        )

    @property
    def dropped_tasks(self) -> F64:
        """Work dropped because the queue was full, in tasks, (B,)."""
        return self._sums["dropped_tasks"]

    @property
    def unmet_kwh(self) -> F64:
        """Heat that the cooling did not remove from the room, in kWh, (B,)."""
        return self._sums["unmet_w"] * self._step_h / 1e3


def _memory(sim: Simulator) -> tuple[F64, F64]:
    """Return stored energy in kWh and waiting work in tasks of each data center, (B,) each."""
    state = sim.state
    return state.stored_kwh.copy(), state.queue[:, -1].copy()
