"""Model-predictive control: plans of the coming hours, of which the first step is done.

Before each step it plans work, setpoint and battery over a horizon and gives the first commands of
the plan. It knows what a controller may know: forecasts of weather and carbon intensity, prices,
the work of the step to come, and for later steps the work of the same time on the last days. What
a step costs it reads from a ``FacilityMap``, tables of the simulator at constant load and setpoint:
halls that are transient, events and racks that protect themselves are not foreseen.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.errors import ConfigError
from sdc_taichi.number_text import parse_number
from sdc_taichi.optimum.commands import setpoint_command
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import AGENTS, RAMP_K, Agent
from sdc_taichi.sim.bills import BilledDemand, add_power, no_demand
from sdc_taichi.types import F64, I64, Actions

if TYPE_CHECKING:
    from sdc_taichi.control.plans import QueuePlan, StorePlanner, Weather

HORIZON_H = (1.0, 168.0)
"""Shortest and longest horizon, in h."""
CARBON = Objective(carbon=1.0)
"""The objective of a name without one."""
SETPOINT_STEP_K = 0.5
"""Largest distance of the setpoints to choose from, in K."""
KNOWN_DAYS = 7
"""Days whose mean work is expected to come again."""
FADES_IN_H = 3.0
"""Time in which the departure of the present work from that mean falls to 1/e, in h."""
PEAKS = 8
"""Peaks of the month that are tried where there is a demand charge."""
_NAME = re.compile(r"mpc-(?P<hours>[^:]*)h(?::(?P<objective>.*))?")


def is_mpc(name: str) -> bool:
    """Whether a name is meant for a ``ModelPredictive``."""
    return name.startswith("mpc")


def model_predictive(name: str, agents: tuple[Agent, ...]) -> ModelPredictive:
    """A controller by its name, such as ``mpc-24h`` or ``mpc-72h:cost``.

    Args:
        name: horizon in hours, and an objective unless it is carbon.
        agents: what it commands.

    Raises:
        ConfigError: a horizon or an objective that is not valid.
    """
    found = _NAME.fullmatch(name)
    try:
        hours = parse_number(found["hours"]) if found else math.nan
    except ValueError:
        hours = math.nan
    if found is None or math.isnan(hours):
        raise ConfigError(
            f"controller {name!r}: valid is mpc-HOURSh or mpc-HOURSh:OBJECTIVE, such as mpc-24h or "
            "mpc-72h:cost"
        )
    text = found["objective"]
    objective = CARBON if text is None else Objective.parse(text)
    return ModelPredictive(hours, objective, agents)


class ModelPredictive:
    """Plans the coming hours anew before every step.

    Args:
        hours: horizon, in h.
        objective: what the plan minimises; water is no part of it.
        agents: what it commands; the rest it takes to be neutral.

    Attributes:
        commands: fields of ``Actions`` that it gives.

    Raises:
        ConfigError: a horizon that is out of bounds, or an objective with water.
    """

    def __init__(
        self,
        hours: float,
        objective: Objective = CARBON,
        agents: tuple[Agent, ...] = AGENTS,
    ) -> None:
        if not HORIZON_H[0] <= hours <= HORIZON_H[1]:
            raise ConfigError(
                f"controller 'mpc-{hours:g}h': valid is a horizon of "
                f"{HORIZON_H[0]:g}..{HORIZON_H[1]:g} h, such as mpc-24h"
            )
        if objective.water:
            raise ConfigError(
                f"controller 'mpc-{hours:g}h:{objective}': water is not planned; valid are carbon, "
                "energy, cost, and sums of them"
            )
        self._hours, self._objective, self._agents = hours, objective, agents
        self.commands: tuple[str, ...] = agents
        self._planners: _Planners | None = None
        self.reset(0)

    def reset(self, seed: int | I64) -> None:
        """Forget the episode before."""
        self._bill: BilledDemand | None = None
        self._view: View | None = None
        self._actions = Actions()

    def act(self, view: View) -> Actions:
        """Commands for what it controls; asked again with one view, the same ones."""
        if view is not self._view:
            if self._planners is None or not self._planners.suit(view):
                self._planners = _Planners(view, self._agents)
            self._actions, self._view = self._plan(view, self._planners), view
        return self._actions

    def _plan(self, view: View, planners: _Planners) -> Actions:
        from sdc_taichi.control.plans import EnergyCost, Weather

        coming = view.forecast(self._hours)
        peak_cost = self._objective.kw_month_weight(view.fleet) / view.step_h
        cost = EnergyCost(
            weight=np.ascontiguousarray(
                self._objective.kwh_weight(coming.ci_g_per_kwh, coming.price_per_kwh)
            ),
            peak_kwh=self._month_peak_kw(view) * view.step_h,
            peak_cost=peak_cost,
        )
        peaks = PEAKS if np.any(peak_cost > 0) else 1
        weather = Weather(coming.outdoor_c, coming.wet_bulb_c)
        work = planners.queue.plan(
            view.state.queue,
            expected_demand(view, coming.index),
            weather,
            cost,
            view.setpoint_c,
            peaks=peaks,
        )
        found: dict[str, F64] = {}
        if "load" in self._agents:
            found["load"] = work.load
        if "cooling" in self._agents:
            found["cooling"] = _cooling_command(view, planners, weather, work)
        if planners.store is not None:
            found["battery"] = planners.store.plan(
                view.state.stored_kwh, work.facility_kwh, cost, peaks=peaks
            )
        return Actions(**found)

    def _month_peak_kw(self, view: View) -> F64:
        """Highest power of the month that the step to come belongs to, in kW, (B,)."""
        step = view.state.step
        if self._bill is None:
            self._bill = no_demand(view.state.start, view.fleet.steps_per_hour)
        if view.last is not None:
            add_power(self._bill, step - 1, view.last.grid_kwh / view.step_h)
        return np.where(step >= self._bill.month_end, 0.0, self._bill.month_peak_kw)


class _Planners:
    """What plans are made with, which lasts as long as data centers and weather stay the same."""

    def __init__(self, view: View, agents: tuple[Agent, ...]) -> None:
        from sdc_taichi.control.plans import QueuePlanner, StorePlanner
        from sdc_taichi.optimum.facility_map import facility_map
        from sdc_taichi.optimum.problem import inlet_limits_c

        self._sizing, self._drivers = view.sizing, view.drivers
        self.facility = facility_map(
            view.fleet,
            view.drivers,
            inlet_limit_c=inlet_limits_c(view.fleet),
            setpoint_step_k=SETPOINT_STEP_K,
            precision=view.precision,
        )
        bars = [not allowed.all() for allowed in self.facility.at_own_nodes(self.facility.allowed)]
        self.is_limited = np.array(bars)[self.facility.which]
        """Whether some setpoint is barred in some weather, (B,)."""
        self.queue = QueuePlanner(
            view.fleet,
            self.facility,
            moves_work="load" in agents,
            moves_setpoint="cooling" in agents,
        )
        self.store: StorePlanner | None = None
        if "battery" in agents and np.any(view.sizing.battery_kwh > 0):
            self.store = StorePlanner(view.fleet, view.sizing, view.step_h)

    def suit(self, view: View) -> bool:
        """Whether they were made for the data centers and the weather of a view."""
        own, given = self._drivers, view.drivers
        return (
            view.sizing is self._sizing
            and given.outdoor_c is own.outdoor_c
            and given.wet_bulb_c is own.wet_bulb_c
        )


def expected_demand(view: View, index: I64) -> F64:
    """Work that is expected to arrive, as a share of capacity, (B, H).

    That of the step to come is known. Later steps take the mean work of the same time on the last
    days, and the departure of the present work from that mean, which fades.

    Args:
        view: the situation before the step.
        index: coming steps, counted from the beginning of the year, (B, H).
    """
    demand, per_hour = view.drivers.demand, view.fleet.steps_per_hour
    day, lead = 24 * per_hour, np.arange(index.shape[1])
    last = index - day * -(-lead // day)
    usual = np.mean([demand.at(last - day * back) for back in range(KNOWN_DAYS)], axis=0)
    before = index[:, :1] - day * np.arange(1, KNOWN_DAYS + 1)
    departure = demand.at(index[:, :1]) - demand.at(before).mean(axis=1, keepdims=True)
    expected = usual + departure * np.exp(-lead / (FADES_IN_H * per_hour))
    expected[:, :1] = demand.at(index[:, :1])
    return np.asarray(np.clip(expected, 0.0, 1.0))


def _cooling_command(view: View, planners: _Planners, weather: Weather, work: QueuePlan) -> F64:
    """Command towards the setpoint of least energy at the load and weather of the step, (B,)."""
    now = slice(0, 1)
    best_c = planners.facility.best_setpoint_c(
        (work.executed_tasks / 100.0)[:, None],
        weather.outdoor_c[:, now],
        weather.wet_bulb_c[:, now],
    )[:, 0]
    target_c = np.minimum(best_c, view.setpoint_c + RAMP_K)
    # Downwards there is no waiting where a hot inlet may be the reason.
    slowly_c = np.maximum(target_c, view.setpoint_c - RAMP_K)
    target_c = np.where(planners.is_limited, target_c, slowly_c)
    return setpoint_command(
        target_c,
        setpoint_c=view.setpoint_c,
        step_k=view.limits.setpoint_step_k,
        last=view.cooling_last,
    )
