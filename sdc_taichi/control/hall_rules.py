"""Rules for fan speeds and setpoints of the CRAC units of halls with flow model ``controlled``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np

from sdc_taichi.control.rules import Controller, WithoutMemory, trimmed_setpoint_c
from sdc_taichi.control.view import View, limits_of
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.number_text import parse_number
from sdc_taichi.optimum.hall_search import GRID, cost_w, one_speed
from sdc_taichi.plant.cooling import avoid_repeats
from sdc_taichi.sim.commanded_halls import CommandedHalls, HallConditions
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, Actions

LIMIT_C = RECOMMENDED_C[1]
"""Highest server inlet that rules allow, in C: the highest that ASHRAE TC 9.9 recommends."""
REQUEST_C = 26.0
"""Measured inlet above which the zone of a unit requests cooling, in C."""
INTEGRAL_PER_K, PROPORTIONAL_PER_K = 0.02, 0.01
"""Gains of PI control: change of a fan's speed as a share of full speed per kelvin, in 5 min and at
once."""
MOST_ERROR_K = 2.0
"""Largest deviation from the target on which PI control acts, in K."""
SETPOINTS = 37
"""Number of setpoints that ``follow:best`` compares."""
GRIDS = 3
"""Number of grids of 96 pairs of speed and setpoint by which ``one-speed`` searches in a step."""


class FollowNeed(WithoutMemory):
    """Fans that supply what the racks need.

    Args:
        setpoint_c: Setpoint of all units, in C; ``best`` for that of least power in the steady
            state of the coming step, or None to hold setpoints.
    """

    commands = ("cooling", "fan")
    """Fields of ``Actions`` that it gives."""

    def __init__(self, setpoint_c: float | str | None = None) -> None:
        self._setpoint_c = setpoint_c
        self._halls = _Halls(SETPOINTS, "follow_servers")

    def act(self, view: View) -> Actions:
        """Return commands for setpoints and fans."""
        if self._setpoint_c is None:
            setpoint_c = view.state.setpoint_c
        elif self._setpoint_c == "best":
            setpoint_c = self._halls.each(view, _best_setpoint_c)[0]
        else:
            setpoint_c = np.full(view.fleet.units, float(self._setpoint_c))
        return unit_actions(view, needed_speed(view), setpoint_c)


class InletControl:
    """Fans by PI (proportional and integral control) on inlets, at one setpoint.

    Args:
        setpoint_c: Setpoint of all units, in C.
        target_c: Target of the hottest inlet as the sensors measure it, in C.
        common: True for one speed by the hottest zone of the hall, False for a speed of each unit
            by its own zone.
    """

    commands = ("cooling", "fan")
    """Fields of ``Actions`` that it gives."""

    def __init__(
        self, setpoint_c: float = 20.0, target_c: float = 26.0, *, common: bool = False
    ) -> None:
        self._setpoint_c, self._target_c, self._common = setpoint_c, target_c, common
        self._integral: F64 | None = None

    def reset(self, seed: object) -> None:
        """Begin again at the speeds that the fans have."""
        self._integral = None

    def act(self, view: View) -> Actions:
        """Return commands for setpoints and fans."""
        fleet, hottest_c = view.fleet, view.zone_hottest_c
        integral = view.state.fan_speed if self._integral is None else self._integral
        if self._common:
            first = fleet.unit_offsets[:-1]
            hottest_c = np.maximum.reduceat(hottest_c, first)[fleet.unit_dc]
            integral = integral[first][fleet.unit_dc]
        error_k = np.clip(hottest_c - self._target_c, -MOST_ERROR_K, MOST_ERROR_K)
        low, slots = _min_speed(fleet), view.step_h * 12.0
        self._integral = np.clip(integral + INTEGRAL_PER_K * slots * error_k, low, 1.0)
        speed = np.clip(self._integral + PROPORTIONAL_PER_K * error_k, low, 1.0)
        return unit_actions(view, speed, np.full(fleet.units, self._setpoint_c))


class TrimAndRespondByZone(WithoutMemory):
    """Common setpoint by trim and respond, with requests of zones; fans supply the racks' need.

    The sequence is that of ASHRAE Guideline 36 (2021), section 5.1.14: every 5 min +0.1 K, and
    -0.2 K, at most -0.6 K, for each request beyond the first. A zone requests cooling if its unit
    measures an inlet above 26 C.
    """

    commands = ("cooling", "fan")
    """Fields of ``Actions`` that it gives."""

    def act(self, view: View) -> Actions:
        """Return commands for setpoints and fans."""
        requests = view.fleet.unit_sums(view.zone_hottest_c > REQUEST_C)
        target_c = trimmed_setpoint_c(view, requests, ignored=1)
        return unit_actions(view, needed_speed(view), target_c[view.fleet.unit_dc])


class OneSpeed(WithoutMemory):
    """One speed and one setpoint for all units, of least power in the steady state of the step.

    Args:
        limit_c: Highest server inlet, in C.
    """

    commands = ("cooling", "fan")
    """Fields of ``Actions`` that it gives."""

    def __init__(self, limit_c: float = LIMIT_C) -> None:
        self._limit_c = limit_c
        self._halls = _Halls(GRID[0] * GRID[1], "controlled")

    def act(self, view: View) -> Actions:
        """Return commands for setpoints and fans."""

        def search(halls: CommandedHalls, conditions: HallConditions) -> tuple[float, float]:
            best = one_speed(halls, conditions, self._limit_c, GRIDS)
            at = int(np.argmax(conditions.running))
            return float(best.supply_c[at]), float(best.speed[at])

        supply_c, speed = self._halls.each(view, search)
        setpoint_c = supply_c + view.fleet.setpoint_over_supply_k[view.fleet.unit_dc]
        return unit_actions(view, speed, setpoint_c)


class _Halls:
    """Copies of each distinct data center of a fleet, in which commands are tried.

    Args:
        copies: Number of copies.
        fans: Control of the fans, see ``CommandedHalls``.
    """

    def __init__(self, copies: int, fans: Literal["controlled", "follow_servers"]) -> None:
        self._copies, self._fans = copies, fans
        self._halls: dict[tuple[int, bytes], CommandedHalls] = {}

    def each(
        self,
        view: View,
        search: Callable[[CommandedHalls, HallConditions], tuple[float, float]],
    ) -> tuple[F64, F64]:
        """Return the two results of a search for the units of every data center, (U,) each."""
        fleet, now, load, running = view.fleet, view.now, view.rack_load, view.unit_running
        results = []
        for dc, config in enumerate(fleet.configs):
            drivers = view.drivers.take([dc])
            design_c = np.concatenate([drivers.design_outdoor_c, drivers.design_wet_bulb_c])
            key = id(config), design_c.tobytes()
            if key not in self._halls:
                self._halls[key] = CommandedHalls(
                    config, drivers, self._copies, view.precision, self._fans
                )
            conditions = HallConditions(
                load[slice(*fleet.rack_offsets[dc : dc + 2])],
                float(now.outdoor_c[dc]),
                float(now.wet_bulb_c[dc]),
                running[slice(*fleet.unit_offsets[dc : dc + 2])],
            )
            results.append(search(self._halls[key], conditions))
        first, second = np.array(results)[fleet.unit_dc].T
        return first, second


def _best_setpoint_c(halls: CommandedHalls, conditions: HallConditions) -> tuple[float, float]:
    """Return the setpoint of least power if fans follow the need, in C, and this power, in W."""
    supply_c = np.repeat(np.linspace(*halls.setpoint_c, SETPOINTS)[:, None], halls.units, axis=1)
    slowest = np.full_like(supply_c, halls.min_speed)
    cost = cost_w(halls.at(slowest, supply_c, conditions), LIMIT_C)
    at = int(np.argmin(cost))
    return float(supply_c[at, 0]), float(cost[at])


def needed_speed(view: View) -> F64:
    """Return the speed at which each unit just supplies what its racks need, (U,)."""
    ratio = np.maximum(view.zone_supply_ratio, 0.1)
    return np.clip(view.state.fan_speed / ratio, _min_speed(view.fleet), 1.0)


def unit_actions(view: View, speed: F64, setpoint_c: F64) -> Actions:
    """Return the actions that give each unit a speed, as a share of full speed, and a setpoint, C.

    Args:
        view: View before the step.
        speed: Speed of each fan, (U,).
        setpoint_c: Setpoint of each unit, in C, (U,).
    """
    fleet, state, limits = view.fleet, view.state, view.limits
    units = fleet.unit_dc
    within_c = np.clip(setpoint_c, limits.setpoint_low_c[units], limits.setpoint_high_c[units])
    steps = (within_c - state.setpoint_c) / limits.setpoint_step_k[units]
    fan_step = fleet.values("hvac.crac.fan_step")[units]
    return Actions(
        cooling=avoid_repeats(steps, state.cooling_last), fan=(speed - state.fan_speed) / fan_step
    )


def _min_speed(fleet: Fleet) -> F64:
    return fleet.values("hvac.crac.min_flow_ratio")[fleet.unit_dc]


_RULES: dict[str, Callable[..., Any]] = {
    "follow": FollowNeed,
    "local-pi": InletControl,
    "common-pi": partial(InletControl, common=True),
    "g36-trim-respond": TrimAndRespondByZone,
    "one-speed": OneSpeed,
}
HALL_RULES = tuple(_RULES)
"""Names of the rules. ``follow:C`` and ``local-pi:C/C`` give temperatures, see ``hall_rule``."""
_TEMPERATURES = {"follow": 1, "local-pi": 2, "common-pi": 2}
"""Numbers of temperatures that may follow the name of a rule."""


def is_hall_rule(name: str) -> bool:
    """Return True if a controller's name is that of a rule for CRAC units."""
    return name.partition(":")[0] in _RULES


def hall_rule(name: str, fleet: Fleet) -> Controller:
    """Make a rule by its name.

    Args:
        name: One of ``HALL_RULES``; after a colon ``follow`` takes a setpoint in C or ``best``,
            and PI control takes a setpoint and a target of the hottest inlet, such as ``20/26``.
        fleet: Data centers to control.

    Raises:
        ConfigError: The fans are not controlled, or the text after the name is not valid.
    """
    model = fleet.models["crac_flow"]
    if model != "controlled":
        raise ConfigError(
            f"controller {name!r}: commands fans, but hvac.crac.flow_model is {model}; valid is "
            "controlled"
        )
    kind, colon, text = name.partition(":")
    if colon and kind not in _TEMPERATURES:
        raise ConfigError(f"controller {name!r}: {kind} takes no text; valid is {kind}")
    if name == "follow:best":
        return FollowNeed("best")
    values_c = _temperatures_c(name, text, _TEMPERATURES[kind], fleet) if colon else ()
    rule: Controller = _RULES[kind](*values_c)
    return rule


def _temperatures_c(name: str, text: str, count: int, fleet: Fleet) -> list[float]:
    """Return setpoint and, for a count of 2, target in a text such as 20/26, in C."""
    try:
        values = [parse_number(part) for part in text.split("/")]
    except ValueError:
        values = []
    limits = limits_of(fleet)
    low_c, high_c = float(limits.setpoint_low_c.max()), float(limits.setpoint_high_c.min())
    inside = len(values) == count and low_c <= values[0] <= high_c
    if not inside or (count == 2 and not 0.0 <= values[1] <= 60.0):
        target = "" if count == 1 else ", / and the target of the hottest inlet, 0..60 C"
        example = "20" if count == 1 else "20/26"
        raise ConfigError(
            f"controller {name!r}: valid is a setpoint of {low_c:g}..{high_c:g} C (hvac.setpoint)"
            f"{target}, such as {name.partition(':')[0]}:{example}"
        )
    return values
