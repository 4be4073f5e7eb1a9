"""Model-predictive control: plan the coming hours before each step, and apply the first command.

A plan covers work, setpoint, battery and coolant loops up to a horizon. It uses only the
information of a view: forecasts of weather and carbon intensity, prices, and the work of the next
step. The forecast of later work is based on the work at the same time of past days. Energies come
from a ``FacilityMap``, tables of the simulator at constant load and setpoint, so plans ignore
transients, events, and racks that throttle or switch off. B is the number of data centers and H the
number of steps of a plan.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.config.liquid_schema import SETPOINT_LIMITS_C
from sdc_taichi.control.rules import setpoint_command
from sdc_taichi.control.view import View
from sdc_taichi.errors import ConfigError
from sdc_taichi.number_text import parse_number
from sdc_taichi.optimum.loop_map import LOOP_COMMANDS, LoopCommands
from sdc_taichi.optimum.objective import CARBON, Objective
from sdc_taichi.optimum.problem import AGENTS, RAMP_K, Agent
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.bills import BilledDemand, add_power, no_demand
from sdc_taichi.sim.liquid import SETPOINT_STEP_K as LOOP_RAMP_K
from sdc_taichi.types import F64, I64, Actions

if TYPE_CHECKING:
    from sdc_taichi.control.plans import EnergyCost, QueuePlan, StorePlanner, Weather

LOOP_STEP_K = 0.5
"""Spacing of the candidate supply setpoints of CDUs, in K."""
HORIZON_H = (1.0, 168.0)
"""Shortest and longest horizon, in h."""
SETPOINT_STEP_K = 0.5
"""Largest spacing of the candidate setpoints, in K."""
KNOWN_DAYS = 7
"""Number of past days whose mean work is the forecast of work."""
FADES_IN_H = 3.0
"""Time constant with which the deviation of the present work from that mean decays, in h."""
PEAKS = 8
"""Number of candidates for the month's peak power, which plans compare if there is a demand
charge."""
_NAME = re.compile(r"mpc-(?P<hours>[^:]*)h(?::(?P<objective>.*))?")


def is_mpc(name: str) -> bool:
    """Return True if a controller name stands for a ``ModelPredictive`` controller."""
    return name.startswith("mpc")


def model_predictive(name: str, agents: tuple[Agent, ...]) -> ModelPredictive:
    """Make a model-predictive controller from a name such as ``mpc-24h`` or ``mpc-72h:cost``.

    Args:
        name: Name with the horizon in hours, and with the objective unless it is carbon.
        agents: Agents whose commands the controller gives.

    Raises:
        ConfigError: The horizon or the objective is not valid.
    """
    match = _NAME.fullmatch(name)
    try:
        hours = parse_number(match["hours"]) if match else math.nan
    except ValueError:
        hours = math.nan
    if match is None or math.isnan(hours):
        raise ConfigError(
            f"controller {name!r}: valid is mpc-HOURSh or mpc-HOURSh:OBJECTIVE, such as mpc-24h or "
            "mpc-72h:cost"
        )
    text = match["objective"]
    objective = CARBON if text is None else Objective.parse(text)
    return ModelPredictive(hours, objective, agents)


class ModelPredictive:
    """Controller that plans the coming hours before every step.

    Args:
        hours: Horizon, in h.
        objective: Quantity that the plan minimises; it must not include water or heat.
        agents: Agents whose commands the controller gives; it assumes neutral commands of the
            others.

    Attributes:
        commands: Fields of ``Actions`` that the controller gives.

    Raises:
        ConfigError: The horizon is out of bounds, or the objective includes water or heat.
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
        for name in ("water", "heat"):
            if getattr(objective, name):
                raise ConfigError(
                    f"controller 'mpc-{hours:g}h:{objective}': {name} is not planned; valid are "
                    "carbon, energy, cost, and sums of them"
                )
        self._hours, self._objective, self._agents = hours, objective, agents
        loops = LOOP_COMMANDS if "liquid" in agents else ()
        self.commands: tuple[str, ...] = (*(a for a in agents if a in AGENTS), *loops)
        self._planners: _Planners | None = None
        self.reset(0)

    def reset(self, seed: int | I64) -> None:
        """Begin an episode that does not depend on earlier ones."""
        self._bill: BilledDemand | None = None
        self._view: View | None = None
        self._actions = Actions()

    def act(self, view: View) -> Actions:
        """Return the commands of the agents; the same view gives the same commands again."""
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
        commands: dict[str, F64] = {}
        if "load" in self._agents:
            commands["load"] = work.load
        if "cooling" in self._agents:
            commands["cooling"] = _cooling_command(view, planners, weather, work)
        if planners.store is not None:
            commands["battery"] = planners.store.plan(
                view.state.stored_kwh, work.facility_kwh, cost, peaks=peaks
            )
        if planners.loops is not None:
            commands |= _loop_commands(view, planners.loops, weather, work, cost)
        return Actions(**commands)

    def _month_peak_kw(self, view: View) -> F64:
        """Return the highest power so far in the month of the next step, in kW, (B,)."""
        step = view.state.step
        if self._bill is None:
            self._bill = no_demand(view.state.start, view.fleet.steps_per_hour)
        if view.last is not None:
            add_power(self._bill, step - 1, view.last.grid_kwh / view.step_h)
        return np.where(step >= self._bill.month_end, 0.0, self._bill.month_peak_kw)


class _Planners:
    """Planners and tables of a fleet, valid for one set of data centers and weather series."""

    def __init__(self, view: View, agents: tuple[Agent, ...]) -> None:
        from sdc_taichi.control.plans import QueuePlanner, StorePlanner
        from sdc_taichi.optimum.facility_map import facility_map
        from sdc_taichi.optimum.problem import inlet_limits_c, require_traces

        require_traces(view.fleet)
        self._sizing, self._drivers = view.sizing, view.drivers
        self.loops: LoopCommands | None = None
        if "liquid" in agents:
            self.loops = LoopCommands(view.fleet, view.drivers)
        self.facility = facility_map(
            view.fleet,
            view.drivers,
            inlet_limit_c=inlet_limits_c(view.fleet),
            setpoint_step_k=SETPOINT_STEP_K,
            precision=view.precision,
            loops=self.loops,
        )
        allowed = self.facility.at_own_nodes(self.facility.allowed)
        self.is_limited = np.array([not nodes.all() for nodes in allowed])[self.facility.which]
        """True where an inlet limit excludes at least one setpoint in some weather, (B,)."""
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
        """Return True if the planners are valid for the data centers and weather of a view."""
        return (
            view.sizing is self._sizing
            and view.drivers.outdoor_c is self._drivers.outdoor_c
            and view.drivers.wet_bulb_c is self._drivers.wet_bulb_c
        )


def expected_demand(view: View, index: I64) -> F64:
    """Forecast the arriving work as a share of capacity, (B, H).

    The work of the next step is known. The forecast of later work is the mean at the same time of
    the past ``KNOWN_DAYS`` days, plus the decaying deviation of the present work from its mean.

    Args:
        view: View before the step.
        index: Coming steps, counted from the beginning of the year, (B, H).
    """
    demand, per_hour = view.drivers.demand, view.fleet.steps_per_hour
    day, lead = 24 * per_hour, np.arange(index.shape[1])
    last = index - day * -(-lead // day)
    usual = np.mean([demand.at(last - day * back) for back in range(KNOWN_DAYS)], axis=0)
    before = index[:, :1] - day * np.arange(1, KNOWN_DAYS + 1)
    deviation = demand.at(index[:, :1]) - demand.at(before).mean(axis=1, keepdims=True)
    expected = usual + deviation * np.exp(-lead / (FADES_IN_H * per_hour))
    expected[:, :1] = demand.at(index[:, :1])
    return np.asarray(np.clip(expected, 0.0, 1.0))


def _cooling_command(view: View, planners: _Planners, weather: Weather, work: QueuePlan) -> F64:
    """Return the command towards the setpoint of minimum energy in the next step, (B,)."""
    now = slice(0, 1)
    best_c = planners.facility.best_setpoint_c(
        work.executed_tasks[:, now] / TASKS_PER_STEP,
        weather.outdoor_c[:, now],
        weather.wet_bulb_c[:, now],
    )[:, 0]
    target_c = np.minimum(best_c, view.setpoint_c + RAMP_K)
    # Where inlets have a limit, the setpoint may fall faster than the ramp.
    gradual_c = np.maximum(target_c, view.setpoint_c - RAMP_K)
    target_c = np.where(planners.is_limited, target_c, gradual_c)
    return setpoint_command(target_c, view)


def _loop_commands(
    view: View, loops: LoopCommands, weather: Weather, work: QueuePlan, cost: EnergyCost
) -> dict[str, F64]:
    """Return the commands of the coolant loops in the next step, by field of ``Actions``.

    Flow and facility water are the best steady ones. The supply setpoint is the first of a path
    whose steps are up to 2 K high, and whose squared distance from the best steady setpoints,
    weighted with the cost of energy, is least. The square stands for the additional power, which is
    lowest at the best setpoint.
    """
    from sdc_taichi.optimum.paths import setpoint_path

    utilisation = work.executed_tasks / TASKS_PER_STEP
    (first_c, last_c), first_of = SETPOINT_LIMITS_C, view.fleet.cdu_offsets[:-1]
    best = np.stack(
        [
            loops.of(dc).at(weather.outdoor_c[dc], weather.wet_bulb_c[dc], utilisation[dc])
            for dc in range(view.size)
        ],
        axis=1,
    )
    setpoint_c = best[0, :, 0].copy()
    for dc in np.flatnonzero(np.diff(view.fleet.cdu_offsets)).tolist():
        start_c, path_c = float(view.state.cdu_setpoint_c[first_of[dc]]), best[0, dc]
        if np.abs(np.diff(path_c, prepend=start_c)).max() <= LOOP_RAMP_K:
            continue
        # One of the candidates is the best setpoint of the next step.
        below = np.arange(path_c[0], first_c - LOOP_STEP_K, -LOOP_STEP_K)[::-1]
        above = np.arange(path_c[0], last_c + LOOP_STEP_K, LOOP_STEP_K)[1:]
        candidates_c = np.unique(np.clip(np.concatenate([below, above]), first_c, last_c))
        excess = cost.weight[dc, :, None] * (candidates_c - path_c[:, None]) ** 2
        path_c = setpoint_path(excess, candidates_c, ramp_k=LOOP_RAMP_K, start_c=start_c)
        setpoint_c[dc] = path_c[0]
    of_cdus = view.fleet.cdu_dc
    values = setpoint_c[of_cdus], best[1, of_cdus, 0], best[2, :, 0]
    return dict(zip(LOOP_COMMANDS, values, strict=True))
