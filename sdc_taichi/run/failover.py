"""Failover study of a hall: loss of CRAC units, plant devices or liquid cooling at full load.

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
from sdc_taichi.types import F64, I64, StepResult

Lost = Literal["units", "plant", "liquid"]
"""Kind of loss: CRAC units, devices of the cooling plant, or devices that cool coolant."""

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
"""Minutes after which studies report the hottest inlet or junction."""
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
LIQUID_DEVICES: dict[EventKind, str] = {
    "facility_pump_down": "facility pumps",
    "cooler_down": "cooler",
}
"""Text for the devices of liquid cooling of which each kind of event leaves a share."""
LEAK_L = 10.0
"""Coolant that a leak of a study loses, in l."""
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
    lost: Lost
    """Kind of the losses."""
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
    hottest_c: F64
    """Highest temperature of the racks in each minute, in C, (T, N). The temperatures of racks are
    those of their junctions if ``of_junctions``, and otherwise of their inlets."""
    rack_c: F64
    """Highest temperature of each rack in minute ``shown_min``, in C, (N, R); 0 for the junctions
    of racks without cold plates."""
    shown_min: I64
    """Minute of ``rack_c``, counted from 1, (N,): that of the hottest rack for losses of liquid
    cooling, since junctions cool once racks trip, and otherwise ``SHOWN_AFTER_MIN[0]``."""
    throttle_min: F64
    """Minutes until the first rack throttles or trips, nan if none does, (N,): by inlets to the end
    of a whole minute, by coolant exactly."""
    trip_min: F64
    """Minutes until the first rack trips, nan if none does, (N,); as ``throttle_min``."""
    racks_off: F64
    """Number of racks that are off at the end, (N,)."""
    water_c: F64
    """Supply of chilled water, or for losses of liquid cooling of coolant, at the end of each
    minute, in C, (T, N)."""
    tank_full_min: F64
    """Minutes until warm water fills the stratified buffer tank, nan if it does not or if there is
    no such tank, (N,)."""

    @property
    def of_junctions(self) -> bool:
        """True if the temperatures of racks are those of junctions."""
        return _of_junctions(self.config, self.lost)

    @property
    def worst(self) -> list[int]:
        """Indices of the losses, worst first: by times to trip and to throttle, and temperature."""
        hottest_c = self.hottest_c.max(axis=0)
        never = float(MINUTES + 1)
        trip, throttle = (np.nan_to_num(x, nan=never) for x in (self.trip_min, self.throttle_min))
        return [int(i) for i in np.lexsort((-hottest_c, throttle, trip))]


def study_failover(config: DataCenterConfig, lost: Lost = "units") -> Failover:
    """Study losses of CRAC units, of plant devices or of liquid cooling at full load.

    Each CRAC unit and pair of units is lost, or half and all of each plant device, or CDUs with
    their pumps, facility pumps, the cooler and the coolant of a rack.

    The study uses design weather, transient halls, the design supply temperature within the range
    of setpoints, and the configured ASHRAE class of the servers, or else ``CLASS``.

    Args:
        config: Config of the data center; its events are ignored.
        lost: Kind of loss.

    Raises:
        ConfigError: The inlet model is ``approach``, which models neither CRAC units nor room air,
            or no rack has coolant and losses of liquid cooling are asked for.
    """
    base, supply_c = _studied(config)
    losses, note = unit_losses(base) if lost == "units" else (plant_losses(base), "")
    if lost == "liquid":
        losses, note = liquid_losses(base)
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
    of_junctions = _of_junctions(config, lost)
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
        steps = ((step, sim.step()) for step in range(MINUTES))
        results = [_copied(result, step, lost, of_junctions) for step, result in steps]
    throttled, tripped = (np.array([r[name] for r in results]) for name in ("hot", "tripped"))
    # A rack whose cold plates leak is off at once.
    leaks = np.array([sum(e.kind == "leak" for e in loss.events) for loss in losses]) * of_junctions
    throttle_min, trip_min = (_first_minute(count > leaks) for count in (throttled, tripped))
    hottest_c = np.array([r["hottest_c"] for r in results])
    shown = np.full(len(losses), SHOWN_AFTER_MIN[0] - 1)
    if lost == "liquid":
        by_coolant = [
            _first_time_min(np.array([r[name] for r in results]))
            for name in ("throttle_s", "trip_s")
        ]
        trip_min = np.fmin(trip_min, by_coolant[1])
        throttle_min = np.fmin(np.fmin(throttle_min, by_coolant[0]), trip_min)
        shown = hottest_c.argmax(axis=0)
    tank_kwh = np.array([r["tank_kwh"] for r in results])
    tank_left = [
        next((e.share for e in loss.events if e.kind == "tank_down"), 1.0) for loss in losses
    ]
    rack_c = [results[step]["rack_c"].reshape(len(losses), -1)[i] for i, step in enumerate(shown)]
    return Failover(
        config=base,
        lost=lost,
        losses=losses,
        note=note,
        supply_c=supply_c,
        outdoor_c=outdoor_c,
        wet_bulb_c=wet_bulb_c,
        it_kw=float(results[0]["it_w"][0]) / 1e3,
        hottest_c=hottest_c,
        rack_c=np.array(rack_c),
        shown_min=shown + 1,
        throttle_min=throttle_min,
        trip_min=trip_min,
        racks_off=tripped[-1],
        water_c=np.array([r["water_c"] for r in results]),
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


def liquid_losses(config: DataCenterConfig) -> tuple[tuple[Loss, ...], str]:
    """Return the case without a loss and the losses of liquid cooling, and a note on omitted ones.

    Raises:
        ConfigError: No rack has coolant.
    """
    if config.liquid is None:
        raise ConfigError(
            f"{config.name}: no rack is liquid-cooled; valid are losses of units or of the plant"
        )
    cdus = config.liquid.cdus
    of_manifold = range(cdus.per_manifold)
    rack = next(iter(config.plate_racks() or config.liquid_racks()))
    losses = [Loss("no loss", (), ())]
    for kind, text in (("cdu_down", "CDU"), ("cdu_pump_down", "a pump of CDU")):
        for lost in dict.fromkeys((of_manifold[:1], of_manifold)):
            name = f"{text} {' + '.join(map(str, lost))}"
            losses.append(Loss(name, (), tuple(_event(kind, unit=cdu) for cdu in lost)))
    for device_kind, device in LIQUID_DEVICES.items():
        for name, share in ((f"half of {device}", 0.5), (device, 0.0)):
            losses.append(Loss(name, (), (_event(device_kind, share=share),)))
    losses.append(Loss(f"leak at rack {rack}", (), (_event("leak", rack=rack, litres=LEAK_L),)))
    note = f"Of {cdus.manifolds} manifolds, the first loses its CDUs." if cdus.manifolds > 1 else ""
    return tuple(losses), note


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


def _of_junctions(config: DataCenterConfig, lost: Lost) -> bool:
    """Return True if losses are judged by junctions: of liquid cooling, in halls with some."""
    return lost == "liquid" and bool(config.plate_racks())


def _copied(result: StepResult, step: int, lost: Lost, of_junctions: bool) -> dict[str, Any]:
    """Return copies of the quantities of a step that a study needs."""
    is_liquid = lost == "liquid"
    values: dict[str, Any] = {
        "hottest_c": result.junction_max_c if of_junctions else result.inlet_max_c,
        "tripped": result.tripped_racks,
        "hot": result.throttled_racks + result.tripped_racks,
        "throttle_s": result.throttle_s,
        "trip_s": result.trip_s,
        "water_c": result.cdu_supply_c if is_liquid else result.chilled_water_c,
        "tank_kwh": result.tank_heat_kwh,
    }
    if step == 0:
        values["it_w"] = result.it_w
    if is_liquid or step == SHOWN_AFTER_MIN[0] - 1:
        values["rack_c"] = result.rack_junction_c if of_junctions else result.rack_inlet_max_c
    return {name: np.array(each, dtype=np.float64) for name, each in values.items()}


def _first_minute(happens: Any) -> F64:
    """Return the minutes to the end of the first step in which ``happens`` is True, (N,).

    The result is nan if it is never True. ``happens`` has shape (T, N).
    """
    return np.where(happens.any(axis=0), np.argmax(happens, axis=0) + 1.0, np.nan)


def _first_time_min(time_s: F64) -> F64:
    """Return the minutes to the first time of a study, nan without one, (N,).

    Args:
        time_s: Time from the start of each minute, in s, (T, N); negative if there is none.
    """
    minute = np.argmax(time_s >= 0.0, axis=0)
    first_s = np.take_along_axis(time_s, minute[None], axis=0)[0]
    return np.where(first_s >= 0.0, minute + first_s / 60.0, np.nan)


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
    is_liquid, first = study.lost == "liquid", SHOWN_AFTER_MIN[0]
    times = {"throttle": study.throttle_min, "trip": study.trip_min}
    unit, per_min = ("s", 60.0) if is_liquid else ("min", 1.0)
    place = "junction" if study.of_junctions else "inlet"
    water = "coolant" if is_liquid else "chilled_water"
    return [
        {
            "lost": study.losses[i].name,
            **{
                f"time_to_{name}_{unit}": finite_or_none(per_min * time_min[i])
                for name, time_min in times.items()
            },
            **{
                f"hottest_{place}_{minute}_min_c": float(study.hottest_c[minute - 1, i])
                for minute in SHOWN_AFTER_MIN
            },
            f"{water}_{first}_min_c": float(study.water_c[first - 1, i]),
            **({} if is_liquid else {"tank_full_min": finite_or_none(study.tank_full_min[i])}),
            "racks_off": int(study.racks_off[i]),
        }
        for i in order
    ]
