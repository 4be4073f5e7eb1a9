"""Failover of a hall: each CRAC unit and each pair of units lost at full load, side by side.

Every loss is a copy of the data center in one simulator, and lasts from the first step to the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np

from sdc_taichi.config import (
    DataCenterConfig,
    EventKind,
    EventsConfig,
    ScheduledEvent,
    with_values,
)
from sdc_taichi.config.event_schema import PLANT_OF_EVENT
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.design_point import design_point
from sdc_taichi.hall.floor_plan import floor_plan, unit_places_m
from sdc_taichi.run.metrics import finite_or_none
from sdc_taichi.sim.drivers import drivers_from_arrays, load_drivers
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult

Lost = Literal["units", "plant"]
"""What is lost: CRAC units, or devices of the plant."""

MINUTES = 60
"""Length of a study, in steps of a minute."""
SUBSTEP_S = 5.0
"""Longest substep, in s: air before racks follows its mix within some 20 s."""
MOST_UNITS_PAIRED = 12
"""Most CRAC units of which all pairs are lost; of more, each with its nearest neighbour."""
MOST_LOSSES = 200
"""Most losses of a study; of more CRAC units than that, evenly spread ones are lost."""
MOST_UNIT_SHARES = 100_000_000
"""Most shares of units in the supply of racks, over all losses of a study: some 2 GB."""
SHOWN_AFTER_MIN = (15, 60)
"""Minutes after which studies report the hottest inlet."""
DEVICES: dict[EventKind, str] = {
    "chiller_derate": "chiller",
    "pump_down": "chilled-water pumps",
    "tower_cell_down": "tower cells",
    "dry_cooler_down": "dry cooler",
    "outdoor_air_closed": "outdoor air",
}
"""Devices of plants by the event that takes them, in words."""
CLASS = "A2"
"""Class of the servers, whose limits they throttle and trip at, where the config names none."""


@dataclass(frozen=True, slots=True)
class Loss:
    """What goes out of order at the start of a study, and stays so."""

    name: str
    """What is lost, in words."""
    units: tuple[int, ...]
    """CRAC units that are down, counted from 0; empty for devices of the plant."""
    events: tuple[ScheduledEvent, ...]
    """Events of a config that lose it; none for a hall in order."""


@dataclass(frozen=True, slots=True)
class Failover:
    """What N losses do to a hall of R racks at full load, over T minutes.

    The first of them is no loss at all.
    """

    config: DataCenterConfig
    """The data center as it was studied, without events."""
    losses: tuple[Loss, ...]
    """The losses, N."""
    note: str
    """Which losses were left out, as a sentence; empty for none."""
    supply_c: float
    """Supply air at full load without a loss, in C."""
    outdoor_c: float
    """Dry bulb outside, in C."""
    wet_bulb_c: float
    """Wet bulb outside, in C."""
    it_kw: float
    """IT power in the first minute without a loss, in kW."""
    inlet_max_c: F64
    """Hottest inlet of the hall in each minute, in C, (T, N)."""
    rack_inlet_c: F64
    """Hottest inlet of each rack in the last minute of the first of ``SHOWN_AFTER_MIN``, in C,
    (N, R)."""
    throttle_min: F64
    """Minutes until the first rack throttles or trips, nan for never, (N,)."""
    trip_min: F64
    """Minutes until the first rack trips, nan for never, (N,)."""
    racks_off: F64
    """Racks that are off at the end, (N,)."""

    @property
    def worst(self) -> list[int]:
        """Losses by how soon racks trip, then throttle, then by the hottest inlet, (N,)."""
        inlet_c = self.inlet_max_c.max(axis=0)
        never = float(MINUTES + 1)
        trip, throttle = (np.nan_to_num(x, nan=never) for x in (self.trip_min, self.throttle_min))
        return [int(i) for i in np.lexsort((-inlet_c, throttle, trip))]


def study_failover(config: DataCenterConfig, lost: Lost = "units") -> Failover:
    """Lose each CRAC unit and each pair of them, or each device of the plant, at full load.

    In design weather, at the supply air of the design point as far as the setpoint reaches it, with
    temperatures that take time to change and the class of the config, or ``CLASS``.

    Args:
        config: The data center; its own events are left out.
        lost: What is lost.

    Raises:
        ConfigError: Inlet model ``approach``, which knows no CRAC units and no room.
    """
    base, supply_c = _studied(config)
    losses, note = unit_losses(base) if lost == "units" else (plant_losses(base), "")
    copies = [
        base.model_copy(
            update={
                "name": f"{config.name}, {loss.name}",
                "events": EventsConfig(scheduled=loss.events),
            }
        )
        for loss in losses
    ]
    site = load_drivers([config])
    sizing, ones = config.hvac.sizing, np.ones(MINUTES)
    outdoor_c, wet_bulb_c = (
        float(of_site[0]) if configured is None else configured
        for of_site, configured in (
            (site.design_outdoor_c, sizing.design_outdoor_c),
            (site.design_wet_bulb_c, sizing.design_wet_bulb_c),
        )
    )
    outdoor_c = max(outdoor_c, wet_bulb_c)
    drivers = drivers_from_arrays(
        outdoor_c * ones, wet_bulb_c * ones, 0.0 * ones, ones, size=len(copies)
    )
    with Simulator(build_fleet(copies), drivers=drivers) as sim:
        sim.reset()
        results = [_kept(sim.step(), step) for step in range(MINUTES)]
    throttled, tripped = (np.array([r[name] for r in results]) for name in ("hot", "tripped"))
    shown = results[SHOWN_AFTER_MIN[0] - 1]["rack_inlet_c"]
    return Failover(
        config=base,
        losses=losses,
        note=note,
        supply_c=supply_c,
        outdoor_c=outdoor_c,
        wet_bulb_c=wet_bulb_c,
        it_kw=float(results[0]["it_w"][0]) / 1e3,
        inlet_max_c=np.array([r["inlet_max_c"] for r in results]),
        rack_inlet_c=np.asarray(shown).reshape(len(losses), -1),
        throttle_min=_first_minute(throttled > 0),
        trip_min=_first_minute(tripped > 0),
        racks_off=tripped[-1],
    )


def unit_losses(config: DataCenterConfig) -> tuple[tuple[Loss, ...], str]:
    """No loss, each CRAC unit and each pair of them, and which of them are left out."""
    units = config.hvac.crac.units
    most = min(MOST_LOSSES, max(2, MOST_UNIT_SHARES // (config.hall.racks * units)))
    singles: list[tuple[int, ...]] = [(unit,) for unit in range(units)]
    pairs: list[tuple[int, ...]]
    if units <= MOST_UNITS_PAIRED:
        pairs, note = [*combinations(range(units), 2)], ""
    elif 2 * units < most:
        pairs = sorted(set(_neighbours(config)))
        note = f"Of {units} CRAC units, each is paired with its nearest neighbour alone."
    else:
        chosen = np.linspace(0, units - 1, min(units, most - 1)).round().astype(int)
        singles, pairs = [(int(unit),) for unit in chosen], []
        note = f"Of {units:,} CRAC units, {len(singles)} are lost, one at a time."
    return (
        Loss("no loss", (), ()),
        *(
            Loss(
                f"CRAC {' + '.join(map(str, lost))}",
                lost,
                tuple(_event("crac_down", unit=unit) for unit in lost),
            )
            for lost in singles + pairs
        ),
    ), note


def plant_losses(config: DataCenterConfig) -> tuple[Loss, ...]:
    """No loss, and half and all of each device that the plant of a config has."""
    plant = config.hvac.plant_in_use
    return (
        Loss("no loss", (), ()),
        *(
            Loss(name, (), (_event(kind, share=share),))
            for kind, device in DEVICES.items()
            if PLANT_OF_EVENT.get(kind, plant) == plant
            for name, share in ((f"half of {device}", 0.5), (device, 0.0))
        ),
    )


def _event(kind: Any, **more: Any) -> ScheduledEvent:
    """An event that lasts from the start of a study beyond its end."""
    return ScheduledEvent(kind=kind, start_h=0.0, duration_h=float(MINUTES), **more)


def _neighbours(config: DataCenterConfig) -> list[tuple[int, ...]]:
    """Each CRAC unit and the nearest other one, in order."""
    places = unit_places_m(floor_plan(config.hall), config.hvac.crac.units)
    out: list[tuple[int, ...]] = []
    for unit, place in enumerate(places):
        distance_m = np.hypot(*(places - place).T)
        distance_m[unit] = np.inf
        out.append(tuple(sorted((unit, int(np.argmin(distance_m))))))
    return out


def _studied(config: DataCenterConfig) -> tuple[DataCenterConfig, float]:
    """A data center as it is studied, without events, and its supply air in C."""
    if config.hall.inlet_model != "recirculation":
        raise ConfigError(
            f"{config.name}: hall.inlet_model {config.hall.inlet_model} has no air that a loss of "
            "cooling would warm; valid is recirculation"
        )
    limits = config.hvac.setpoint
    over_supply_k = design_point(config).setpoint_over_supply_k(config)
    wanted_c = config.hall.design_supply_c + over_supply_k
    setpoint_c = float(np.clip(wanted_c, limits.min_c, limits.max_c))
    values = {
        "simulation.thermal": "transient",
        "simulation.steps_per_hour": 60,
        "simulation.substep_s": SUBSTEP_S,
        "hvac.setpoint.initial_c": setpoint_c,
        "hvac.setpoint.schedule_c": None,
        "protection.ashrae_class": config.protection.ashrae_class or CLASS,
        "events": {},
    }
    return with_values(config, values), setpoint_c - over_supply_k


def _kept(result: StepResult, step: int) -> dict[str, Any]:
    """Quantities of a step that a study needs, copied."""
    values: dict[str, Any] = {
        "inlet_max_c": result.inlet_max_c,
        "tripped": result.tripped_racks,
        "hot": result.throttled_racks + result.tripped_racks,
    }
    if step == 0:
        values["it_w"] = result.it_w
    if step == SHOWN_AFTER_MIN[0] - 1:
        values["rack_inlet_c"] = result.rack_inlet_max_c
    return {name: np.array(each, dtype=np.float64) for name, each in values.items()}


def _first_minute(happens: Any) -> F64:
    """Minutes to the end of the first step in which something happens, nan for never, (N,)."""
    return np.where(happens.any(axis=0), np.argmax(happens, axis=0) + 1.0, np.nan)


def failover_values(study: Failover) -> dict[str, Any]:
    """A study as plain values for JSON; units are in the keys, None is never."""
    return {
        "name": study.config.name,
        "supply_c": study.supply_c,
        "outdoor_c": study.outdoor_c,
        "wet_bulb_c": study.wet_bulb_c,
        "it_kw": study.it_kw,
        "ashrae_class": study.config.protection.ashrae_class,
        "note": study.note,
        "losses": failover_rows(study, range(len(study.losses))),
    }


def failover_rows(study: Failover, order: Sequence[int]) -> list[dict[str, Any]]:
    """Losses in an order, each as plain values: units are in the keys, None is never."""
    return [
        {
            "lost": study.losses[i].name,
            "time_to_throttle_min": finite_or_none(study.throttle_min[i]),
            "time_to_trip_min": finite_or_none(study.trip_min[i]),
            **{
                f"hottest_inlet_{minute}_min_c": float(study.inlet_max_c[minute - 1, i])
                for minute in SHOWN_AFTER_MIN
            },
            "racks_off": int(study.racks_off[i]),
        }
        for i in order
    ]
