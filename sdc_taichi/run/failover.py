"""Failover study of a hall: loss of CRAC units or plant devices at full load.

For each loss, a copy of the data center runs in one simulator. The loss lasts for the whole study.
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
from sdc_taichi.sim.air import J_PER_KWH, SHORTEST_SUBSTEP_S
from sdc_taichi.sim.drivers import drivers_from_arrays, load_drivers
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult

Lost = Literal["units", "plant"]
"""Kind of loss: CRAC units, or devices of the cooling plant."""

MINUTES = 60
"""Length of a study, in one-minute steps."""
MOST_UNITS_PAIRED = 12
"""Maximum number of CRAC units for which every pair is studied; with more units, each unit is
paired only with its nearest neighbour."""
MOST_LOSSES = 200
"""Maximum number of losses of a study; with more CRAC units, an evenly spaced selection is
studied."""
MOST_UNIT_SHARES = 100_000_000
"""Maximum number of shares of units in the supply of racks, summed over all losses: about 2 GB."""
SHOWN_AFTER_MIN = (15, 60)
"""Minutes after which studies report the hottest inlet."""
FULL = 0.999
"""Heat in a stratified tank divided by the most that it takes up, from which it counts as full."""
DEVICES: dict[EventKind, str] = {
    "chiller_derate": "chiller",
    "pump_down": "chilled-water pumps",
    "tank_down": "buffer tank",
    "tower_cell_down": "tower cells",
    "dry_cooler_down": "dry cooler",
    "outdoor_air_closed": "outdoor air",
}
"""Text for the plant devices that each kind of event disables."""
CLASS = "A2"
"""ASHRAE class for thermal protection of the servers, if the config names no class."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Devices that fail at the start of a study and stay down."""

    name: str
    """Text for the failed devices."""
    units: tuple[int, ...]
    """Failed CRAC units, counted from 0; empty for devices of the plant."""
    events: tuple[ScheduledEvent, ...]
    """Events that disable the devices; empty for the case without a loss."""


@dataclass(frozen=True, slots=True)
class Failover:
    """Results of a failover study: N losses in a hall of R racks at full load, over T minutes.

    The first of the N cases is the hall without a loss.
    """

    config: DataCenterConfig
    """Config of the studied data center, without events."""
    losses: tuple[Loss, ...]
    """The N losses, of which the first is the case without a loss."""
    note: str
    """Sentence on omitted losses; empty if none was omitted."""
    supply_c: float
    """Supply temperature at full load without a loss, in C."""
    outdoor_c: float
    """Outdoor dry bulb, in C."""
    wet_bulb_c: float
    """Outdoor wet bulb, in C."""
    it_kw: float
    """IT power in the first minute without a loss, in kW."""
    inlet_max_c: F64
    """Highest inlet temperature of the hall in each minute, in C, (T, N)."""
    rack_inlet_c: F64
    """Highest inlet temperature of each rack after ``SHOWN_AFTER_MIN[0]`` minutes, in C, (N, R)."""
    throttle_min: F64
    """Minutes until the first rack throttles or trips, nan if none does, (N,)."""
    trip_min: F64
    """Minutes until the first rack trips, nan if none does, (N,)."""
    racks_off: F64
    """Number of racks that are off at the end, (N,)."""
    chilled_water_c: F64
    """Chilled water supply at the end of each minute, in C, (T, N)."""
    tank_full_min: F64
    """Minutes until warm water fills the stratified buffer tank, nan if it does not or if there is
    no such tank, (N,)."""

    @property
    def worst(self) -> list[int]:
        """Indices of the losses, worst first: by time to trip, time to throttle, hottest inlet."""
        inlet_c = self.inlet_max_c.max(axis=0)
        never = float(MINUTES + 1)
        trip, throttle = (np.nan_to_num(x, nan=never) for x in (self.trip_min, self.throttle_min))
        return [int(i) for i in np.lexsort((-inlet_c, throttle, trip))]


def study_failover(config: DataCenterConfig, lost: Lost = "units") -> Failover:
    """Study the loss of each CRAC unit and pair of units, or of each plant device, at full load.

    The study uses design weather, transient halls, the design supply temperature within the range
    of setpoints, and the configured ASHRAE class of the servers, or else ``CLASS``.

    Args:
        config: Config of the data center; its events are ignored.
        lost: Kind of loss.

    Raises:
        ConfigError: The inlet model is ``approach``, which models neither CRAC units nor room air.
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
        tank_most_kwh = sim.sizing.chilled_water.stratified_tank_j / J_PER_KWH
        results = [_copied(sim.step(), step) for step in range(MINUTES)]
    throttled, tripped = (np.array([r[name] for r in results]) for name in ("hot", "tripped"))
    tank_kwh = np.array([r["tank_kwh"] for r in results])
    tank_left = [
        next((e.share for e in loss.events if e.kind == "tank_down"), 1.0) for loss in losses
    ]
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
        chilled_water_c=np.array([r["chilled_water_c"] for r in results]),
        tank_full_min=_first_minute((tank_kwh > 0) & (tank_kwh > FULL * tank_most_kwh * tank_left)),
    )


def unit_losses(config: DataCenterConfig) -> tuple[tuple[Loss, ...], str]:
    """Return the case without a loss, each unit and each pair, and a note on omitted losses."""
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
    """Return the case without a loss, and the loss of half and all of each plant device.

    A buffer tank, which alone is not missed, is lost together with the chiller.
    """
    plant, has_tank = config.hvac.plant_in_use, config.hvac.chilled_water.tank_m3 > 0
    no_chiller = _event("chiller_derate", share=0.0)
    losses = [Loss("no loss", (), ())]
    for kind, device in DEVICES.items():
        if PLANT_OF_EVENT.get(kind, plant) != plant or (kind == "tank_down" and not has_tank):
            continue
        beside = (no_chiller,) if kind == "tank_down" else ()
        label = f"chiller and {device}" if beside else device
        half = f"chiller, half of {device}" if beside else f"half of {device}"
        for name, share in ((half, 0.5), (label, 0.0)):
            losses.append(Loss(name, (), (*beside, _event(kind, share=share))))
    return tuple(losses)


def _event(kind: Any, **more: Any) -> ScheduledEvent:
    """Return an event that lasts for a whole study."""
    return ScheduledEvent(kind=kind, start_h=0.0, duration_h=float(MINUTES), **more)


def _neighbours(config: DataCenterConfig) -> list[tuple[int, ...]]:
    """Return a pair of each CRAC unit and its nearest neighbour; within a pair, units ascend."""
    places = unit_places_m(floor_plan(config.hall), config.hvac.crac.units)
    out: list[tuple[int, ...]] = []
    for unit, place in enumerate(places):
        distance_m = np.hypot(*(places - place).T)
        distance_m[unit] = np.inf
        out.append(tuple(sorted((unit, int(np.argmin(distance_m))))))
    return out


def _studied(config: DataCenterConfig) -> tuple[DataCenterConfig, float]:
    """Return the config for the study, without events, and its supply temperature in C."""
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
        "simulation.substep_s": SHORTEST_SUBSTEP_S,
        "hvac.setpoint.initial_c": setpoint_c,
        "hvac.setpoint.schedule_c": None,
        "protection.ashrae_class": config.protection.ashrae_class or CLASS,
        "events": {},
    }
    return with_values(config, values), setpoint_c - over_supply_k


def _copied(result: StepResult, step: int) -> dict[str, Any]:
    """Return copies of the quantities of a step that a study needs."""
    values: dict[str, Any] = {
        "inlet_max_c": result.inlet_max_c,
        "tripped": result.tripped_racks,
        "hot": result.throttled_racks + result.tripped_racks,
        "chilled_water_c": result.chilled_water_c,
        "tank_kwh": result.tank_heat_kwh,
    }
    if step == 0:
        values["it_w"] = result.it_w
    if step == SHOWN_AFTER_MIN[0] - 1:
        values["rack_inlet_c"] = result.rack_inlet_max_c
    return {name: np.array(each, dtype=np.float64) for name, each in values.items()}


def _first_minute(happens: Any) -> F64:
    """Return the minutes to the end of the first step in which ``happens`` is True, (N,).

    The result is nan if it is never True. ``happens`` has shape (T, N).
    """
    return np.where(happens.any(axis=0), np.argmax(happens, axis=0) + 1.0, np.nan)


def failover_values(study: Failover) -> dict[str, Any]:
    """Convert a study to plain values for JSON; keys name the units, None means never."""
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
    """Convert losses in the given order to plain values; keys name the units, None means never."""
    return [
        {
            "lost": study.losses[i].name,
            "time_to_throttle_min": finite_or_none(study.throttle_min[i]),
            "time_to_trip_min": finite_or_none(study.trip_min[i]),
            **{
                f"hottest_inlet_{minute}_min_c": float(study.inlet_max_c[minute - 1, i])
                for minute in SHOWN_AFTER_MIN
            },
            f"chilled_water_{SHOWN_AFTER_MIN[0]}_min_c": float(
                study.chilled_water_c[SHOWN_AFTER_MIN[0] - 1, i]
            ),
            "tank_full_min": finite_or_none(study.tank_full_min[i]),
            "racks_off": int(study.racks_off[i]),
        }
        for i in order
    ]
