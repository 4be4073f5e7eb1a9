"""Stages of a step for a fleet, and quasi-steady facilities at constant load and setpoint."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.event_schema import EventsConfig, ProtectionConfig
from sdc_taichi.errors import OddInputWarning
from sdc_taichi.sim.air import SteadyAir, TransientAir
from sdc_taichi.sim.crac_units import CracUnits
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.sim.events import schedule
from sdc_taichi.sim.facility import Facility, FacilityStage
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import HallSums, Precision
from sdc_taichi.sim.liquid_halls import LiquidHalls, LiquidStep, no_liquid_state
from sdc_taichi.sim.physical_limits import AIR_LIMITS_C
from sdc_taichi.sim.sizing import Sizing, size
from sdc_taichi.sim.step_inputs import ActionDecoder, SurroundingsModel, UnitIndex
from sdc_taichi.sim.transfer import Transfer
from sdc_taichi.sim.work_allocation import WorkAllocation
from sdc_taichi.sim.workload import Workload
from sdc_taichi.sim.zone_loads import RackLoads
from sdc_taichi.types import F64, I64, State


@dataclass(frozen=True, slots=True)
class Stages:
    """Models of the stages of a step, and the objects that they share."""

    hall: Hall
    """Solver for temperatures and power of servers and air."""
    sizing: Sizing
    """Sized devices."""
    decoder: ActionDecoder
    """Converter from actions to commands."""
    surroundings: SurroundingsModel
    """Model of weather, demand and failures."""
    transfer: Transfer
    """Transfers of work between the sites of a fleet."""
    workload: Workload
    """Workload model and queues."""
    allocation: WorkAllocation
    """Placement of work on racks, and thermal protection of the racks."""
    crac_units: CracUnits
    """Model of setpoints and fan speeds."""
    air: SteadyAir | TransientAir
    """Air model of the halls, quasi-steady or transient."""
    facility: FacilityStage
    """Models of plant, water, battery, grid and carbon."""
    liquid: LiquidHalls | None
    """Model of liquid-cooled racks; None for fleets without any."""

    def initial_state(
        self, fleet: Fleet, seeds: I64, drivers: Drivers, loads: RackLoads | None = None
    ) -> State:
        """Return the state before the first step.

        Args:
            fleet: The B data centers for which the stages were made.
            seeds: Seed of the sampled events of each data center, (B,).
            drivers: Inputs, which define the first step of the run.
            loads: Loads of the racks in the first step; None loads them evenly by ``drivers``.
        """
        supply = self.crac_units.initial_supply()
        demand, rack_load = drivers.at(0).demand, None
        if loads is not None:
            demand, rack_load = loads.demand, loads.rack_load
        liquid = no_liquid_state()
        if self.liquid is not None:
            weather = drivers.at(0)
            each = demand[fleet.rack_dc] if rack_load is None else rack_load
            liquid = self.liquid.initial((weather.outdoor_c, weather.wet_bulb_c), each, supply)
        return State(
            step=0,
            seed=seeds,
            start=drivers.start,
            setpoint_c=supply.unit_setpoint_c,
            cooling_run=supply.cooling_run,
            cooling_last=supply.cooling_last,
            fan_speed=supply.fan_speed,
            queue=self.workload.empty_queue(),
            in_flight=self.transfer.nothing_in_flight(),
            stored_kwh=fleet.values("battery.initial_soc") * self.sizing.battery_kwh,
            room_heat_kwh=np.zeros(fleet.size),
            rack_status=np.zeros(fleet.racks, dtype=np.int8),
            restart_wait_min=self.allocation.initial_wait_min(),
            **self.air.initial(supply, demand, rack_load),
            **liquid,
        )


def make_stages(
    fleet: Fleet, drivers: Drivers, precision: Precision, *, event_free: bool
) -> Stages:
    """Create the stages of a fleet, and size all its devices.

    Args:
        fleet: B data centers.
        drivers: Inputs, which contain the design temperatures of the sites.
        precision: Precision of the server kernels.
        event_free: True if no event can ever occur.

    Raises:
        PhysicalLimitError: The size of a device is negative, infinite or NaN.
    """
    hall, units = Hall(fleet, precision), UnitIndex(fleet)
    sizing = size(fleet, hall, drivers.design_outdoor_c, drivers.design_wet_bulb_c)
    hall.discard_last_step()
    liquid = None if fleet.liquid is None else LiquidHalls(fleet, hall, sizing)
    allocation = WorkAllocation(fleet)
    models = Facility(fleet, sizing, event_free=event_free)
    facility = FacilityStage(fleet, models)
    keep = allocation.watches_inlets
    air: SteadyAir | TransientAir = (
        TransientAir(fleet, hall, sizing, facility.limits_w, keep_inlets=keep)
        if fleet.models["thermal"] == "transient"
        else SteadyAir(fleet, hall, sizing, units, keep_inlets=keep)
    )
    return Stages(
        hall=hall,
        sizing=sizing,
        decoder=ActionDecoder(fleet, units),
        surroundings=SurroundingsModel(fleet, units, models.powered_share),
        transfer=Transfer(fleet, sizing),
        workload=Workload(fleet),
        allocation=allocation,
        crac_units=CracUnits(fleet, units),
        air=air,
        facility=facility,
        liquid=liquid,
    )


@dataclass(frozen=True, slots=True)
class SteadyStep:
    """Results of one step of B data centers without heat stored by earlier steps."""

    facility_kwh: F64
    """Energy of IT and overhead, without the battery, in kWh, (B,)."""
    water_l: F64
    """Make-up water, in l, (B,)."""
    unmet_w: F64
    """Cooling load that is not removed, in W, (B,); inf if GPUs throttle or a result is beyond its
    physical limits."""


class SteadyFacility:
    """Copies of data centers, each at a constant utilisation and setpoint, in any weather.

    The copies are quasi-steady, without events, rack protection and queued work. Their devices have
    the same sizes as those of the originals.

    Args:
        configs: Configs of the data centers to copy.
        drivers: Inputs of these data centers; only the design temperatures are read.
        of: Index into ``configs`` for each copy, (B,).
        utilisation: Utilisation of each copy, 0..1, (B,).
        setpoint_c: Setpoint of each copy, within the range of its config, in C, (B,).
        precision: Precision of the server kernels.

    Raises:
        PhysicalLimitError: The air of a hall has no steady state.
    """

    def __init__(
        self,
        configs: Sequence[DataCenterConfig],
        drivers: Drivers,
        of: I64,
        utilisation: F64,
        setpoint_c: F64,
        precision: Precision,
    ) -> None:
        with warnings.catch_warnings():
            # The same warnings have been issued for the originals.
            warnings.simplefilter("ignore", OddInputWarning)
            fleet = build_fleet(_copies(configs, of, setpoint_c))
        self._step_h, self._cdu_dc = 1.0 / fleet.steps_per_hour, fleet.cdu_dc
        # ``at`` sets the weather; carbon intensity and price do not affect its results.
        still = FleetSeries(np.zeros(1), np.zeros_like(of), np.ones_like(of))
        inputs = replace(
            drivers,
            outdoor_c=still,
            wet_bulb_c=still,
            ci_g_per_kwh=still,
            demand=FleetSeries(utilisation, np.arange(len(of)), np.ones_like(of)),
            start=np.zeros_like(of),
            design_outdoor_c=drivers.design_outdoor_c[of],
            design_wet_bulb_c=drivers.design_wet_bulb_c[of],
            sources=(),
            synthetic=(),
            notes=(),
            price_per_kwh=still,
        )
        self._stages = stages = make_stages(fleet, inputs, precision, event_free=True)
        self._state = stages.initial_state(fleet, np.zeros_like(of), inputs)
        self._commands = stages.decoder.decode(None)
        timeline = schedule(
            fleet.configs,
            fleet.places,
            steps_per_hour=fleet.steps_per_hour,
            seed=0,
        )
        self._surroundings = stages.surroundings.at(
            inputs.at(0), timeline.at(0), self._state.stored_kwh
        )
        self._supply = stages.crac_units.initial_supply()
        self._liquid: LiquidStep | None = None
        self._air = self._solve_air()
        self.inlet_max_c: F64 = self._air.inlet_max_c
        """Highest server inlet temperature of each copy, in C, (B,)."""
        self.outlet_max_c: F64 = np.maximum.reduceat(
            self._air.rack_outlet_max_c.astype(np.float64), fleet.rack_offsets[:-1]
        )
        """Highest server outlet temperature of each copy, in C, (B,)."""

    def at(self, outdoor_c: F64, wet_bulb_c: F64, loops: F64 | None = None) -> SteadyStep:
        """Run one step in the given weather.

        Args:
            outdoor_c: Outdoor dry bulb, in C, (B,).
            wet_bulb_c: Outdoor wet bulb, in C, (B,).
            loops: Supply setpoint of the CDUs in C, flow divided by the design flow, and approach
                of the facility water in K, (3, B); None keeps those of the configs.
        """
        if loops is not None:
            setpoint_c, flow = loops[:2, self._cdu_dc]
            self._state = replace(self._state, cdu_setpoint_c=setpoint_c, cdu_flow=flow)
            self._commands = replace(self._commands, facility_approach_k=loops[2])
        self._surroundings.outdoor_c, self._surroundings.wet_bulb_c = outdoor_c, wet_bulb_c
        if self._liquid is not None:
            # The heat that liquid-cooled racks leave to the air depends on the weather.
            self._air = self._solve_air()
        results = self._stages.facility.step(
            self._state,
            self._commands,
            self._surroundings,
            self._supply,
            self._air,
            self._liquid,
        )
        possible = (results["within_limits"] > 0) & (self.outlet_max_c <= AIR_LIMITS_C[1])
        if self._liquid is not None:
            possible &= self._liquid.throttled_tasks <= 0.0
        return SteadyStep(
            facility_kwh=results["it_kwh"] + results["overhead_w"] * self._step_h / 1e3,
            water_l=results["water_l"],
            unmet_w=np.where(possible, results["unmet_w"], np.inf),
        )

    def close(self) -> None:
        """Release the kernel arrays."""
        self._stages.workload.close()
        if self._stages.liquid is not None:
            self._stages.liquid.close()

    def _solve_air(self) -> HallSums:
        """Solve airflows, temperatures and power of the halls at their constant load."""
        stages, surroundings = self._stages, self._surroundings
        capacity = stages.allocation.capacity(self._state, self._commands, surroundings)
        work = stages.workload.run(
            self._state.queue,
            surroundings.demand,
            self._commands.load_command,
            capacity.utilisation,
        )
        placement = stages.allocation.place(
            self._state, self._commands, surroundings, work, capacity
        )
        if stages.liquid is not None:
            self._liquid = stages.liquid.step(
                self._state, self._commands, surroundings, placement, self._supply
            )
        air, _ = stages.air.solve(self._state, placement, self._supply, surroundings)
        return air


def _copies(
    configs: Sequence[DataCenterConfig], of: I64, setpoint_c: F64
) -> list[DataCenterConfig]:
    """Create copies of configs with given initial setpoints; equal copies share one object."""
    plain: dict[int, DataCenterConfig] = {}
    at: dict[tuple[int, float], DataCenterConfig] = {}
    for which, value_c in dict.fromkeys(zip(of.tolist(), setpoint_c.tolist(), strict=True)):
        if which not in plain:
            plain[which] = without_memory(configs[which])
        hvac = plain[which].hvac
        setpoint = hvac.setpoint.model_copy(update={"initial_c": value_c})
        hvac = hvac.model_copy(update={"setpoint": setpoint})
        at[which, value_c] = plain[which].model_copy(update={"hvac": hvac})
    return [at[key] for key in zip(of.tolist(), setpoint_c.tolist(), strict=True)]


def without_memory(config: DataCenterConfig) -> DataCenterConfig:
    """Return a config without events, protection, transfers and thermal storage.

    Its steps are independent.

    Only queue and battery still connect the steps.
    """
    work, simulation = config.workload, config.simulation
    return config.model_copy(
        update={
            "events": EventsConfig(),
            "fleet": None,
            "protection": ProtectionConfig(),
            "workload": work.model_copy(update={"model": "fluid", "max_utilisation": 1.0}),
            "simulation": simulation.model_copy(update={"thermal": "quasi_steady"}),
        }
    )
