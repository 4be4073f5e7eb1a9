"""The stages of a step, made for a fleet: its devices sized, its kernels set up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.sim.actions import ActionDecoder
from sdc_taichi.sim.air import SteadyAir, TransientAir
from sdc_taichi.sim.crac_units import CracUnits
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.facility import Facility, FacilityStage
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Hall, Precision
from sdc_taichi.sim.sizing import Sizing, size
from sdc_taichi.sim.surroundings import SurroundingsModel
from sdc_taichi.sim.unit_index import UnitIndex
from sdc_taichi.sim.work_allocation import WorkAllocation
from sdc_taichi.sim.workload import Workload
from sdc_taichi.types import I64, State


@dataclass(frozen=True, slots=True)
class Stages:
    """Stages of a step, and the objects that they share."""

    hall: Hall
    """Temperatures and power of servers and air."""
    sizing: Sizing
    """Sized devices."""
    decoder: ActionDecoder
    """From actions to commands."""
    surroundings: SurroundingsModel
    """Weather, demand, and what is out of order."""
    workload: Workload
    """Work that runs, waits, is due or dropped."""
    allocation: WorkAllocation
    """Which racks work, and what they protect themselves from."""
    crac_units: CracUnits
    """Setpoints and fan speeds."""
    air: SteadyAir | TransientAir
    """Air of the halls, quasi-steady or transient."""
    facility: FacilityStage
    """Plant, water, battery, grid and carbon."""

    def initial_state(self, fleet: Fleet, seeds: I64, drivers: Drivers) -> State:
        """The state before the first step.

        Args:
            fleet: The B data centers that the stages are of.
            seeds: Seed of the sampled events of each data center, (B,).
            drivers: Inputs, with the first step.
        """
        supply = self.crac_units.initial_supply()
        return State(
            step=0,
            seed=seeds,
            start=drivers.start,
            setpoint_c=supply.unit_setpoint_c,
            cooling_run=supply.cooling_run,
            cooling_last=supply.cooling_last,
            fan_speed=supply.fan_speed,
            queue=self.workload.empty_queue(),
            stored_kwh=fleet.values("battery.initial_soc") * self.sizing.battery_kwh,
            room_heat_kwh=np.zeros(fleet.size),
            rack_status=np.zeros(fleet.racks, dtype=np.int8),
            restart_wait_min=self.allocation.initial_wait_min(),
            **self.air.initial(supply, drivers.at(0).demand),
        )


def make_stages(
    fleet: Fleet, drivers: Drivers, precision: Precision, *, event_free: bool
) -> Stages:
    """Make the stages of a fleet, and size all its devices.

    Args:
        fleet: B data centers.
        drivers: Inputs, with the design temperatures of the sites.
        precision: Of the server kernels.
        event_free: Whether no event can ever happen.

    Raises:
        PhysicalLimitError: A device whose size is negative, infinite or not a number.
    """
    hall, units = Hall(fleet, precision), UnitIndex(fleet)
    sizing = size(fleet, hall, drivers.design_outdoor_c, drivers.design_wet_bulb_c)
    hall.discard_last_step()
    allocation = WorkAllocation(fleet)
    models = Facility(fleet, sizing, event_free=event_free)
    facility = FacilityStage(fleet, models)
    keep = allocation.watches_inlets
    air: SteadyAir | TransientAir = (
        TransientAir(fleet, hall, sizing, facility.removable_w, keep_inlets=keep)
        if fleet.models["thermal"] == "transient"
        else SteadyAir(fleet, hall, sizing, units, keep_inlets=keep)
    )
    return Stages(
        hall=hall,
        sizing=sizing,
        decoder=ActionDecoder(fleet, units),
        surroundings=SurroundingsModel(fleet, units, models.powered_share),
        workload=Workload(fleet),
        allocation=allocation,
        crac_units=CracUnits(fleet, units),
        air=air,
        facility=facility,
    )
