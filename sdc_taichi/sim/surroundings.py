"""Surroundings of a step: weather, carbon intensity, demand, and effects of events on the fleet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sdc_taichi.sim.events import Disturbance
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.unit_index import UnitIndex
from sdc_taichi.types import F64, Exogenous, SiteQuantities


@dataclass
class Surroundings(SiteQuantities):
    """Surroundings of one step of B data centers, U CRAC units and R racks."""

    fully_powered: bool
    """Whether all data centers have power throughout the step."""
    chiller_share: F64
    """Chiller capacity that is available, as a share of its full capacity, 0..1, (B,)."""
    pump_share: F64
    """Chilled-water pumps that are in order, as a share of all, 0..1, (B,)."""
    outdoor_units: F64
    """Tower cells, dry coolers or openings for outdoor air in order, as a share of all, 0..1,
    (B,)."""
    no_unit_down: F64
    """1 if all CRAC units run, 0 if one is down, (B,)."""
    all_running: bool
    """Whether all CRAC units of all data centers run."""
    rack_airflow: F64 | None
    """Airflow of each rack that remains, as a share of its full airflow, 0..1, (R,); None is 1."""


class SurroundingsModel:
    """Puts together what a step meets.

    Args:
        fleet: B data centers.
        units: Their CRAC units.
        powered_share: ``Facility.powered_share``: how long batteries carry them in an outage.
    """

    def __init__(
        self,
        fleet: Fleet,
        units: UnitIndex,
        powered_share: Callable[[npt.NDArray[np.bool_], F64], F64],
    ) -> None:
        self._units, self._powered_share = units, powered_share
        self._ones, self._zeros = np.ones(fleet.size), np.zeros(fleet.size)
        self._unit_ones = np.ones(fleet.units)

    def at(self, exogenous: Exogenous, event: Disturbance, stored_kwh: F64) -> Surroundings:
        """Surroundings of one step.

        Args:
            exogenous: Weather, carbon intensity and demand of the step.
            event: What events do to the step.
            stored_kwh: Energy in the batteries at the start of the step, kWh, (B,).
        """
        if not event.active:
            return Surroundings(
                outdoor_c=exogenous.outdoor_c,
                wet_bulb_c=exogenous.wet_bulb_c,
                ci_g_per_kwh=exogenous.ci_g_per_kwh,
                demand=exogenous.demand,
                active_events=self._zeros.copy(),
                price_per_kwh=exogenous.price_per_kwh,
                grid_up=self._ones.copy(),
                powered=self._ones.copy(),
                fully_powered=True,
                chiller_share=self._ones,
                pump_share=self._ones,
                outdoor_units=self._ones,
                unit_running=self._unit_ones.copy(),
                no_unit_down=self._ones,
                all_running=True,
                rack_airflow=None,
            )
        powered = self._powered_share(event.grid_up, stored_kwh)
        running = event.unit_up & (self._units.of_each(powered) > 0)
        unit_running = running.astype(np.float64)
        return Surroundings(
            outdoor_c=exogenous.outdoor_c + event.outdoor_offset_k,
            wet_bulb_c=exogenous.wet_bulb_c + event.outdoor_offset_k,
            ci_g_per_kwh=exogenous.ci_g_per_kwh,
            demand=exogenous.demand,
            active_events=event.active_events.copy(),
            price_per_kwh=exogenous.price_per_kwh,
            grid_up=event.grid_up.astype(np.float64),
            powered=powered,
            fully_powered=bool(np.all(powered == 1.0)),
            chiller_share=event.chiller_share,
            pump_share=event.pump_share,
            outdoor_units=event.outdoor_units,
            unit_running=unit_running,
            no_unit_down=self._units.lowest(unit_running),
            all_running=bool(np.all(running)),
            rack_airflow=event.rack_airflow,
        )
