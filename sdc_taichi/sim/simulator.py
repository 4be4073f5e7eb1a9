"""The simulator: each step runs all stages once, for all data centers together."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from operator import itemgetter
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, PhysicalLimitError, RuntimeStateError, SdcError
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.sim import snapshot
from sdc_taichi.sim.air import STATE_AXES, held_air, plain_supply_air, with_entries_of
from sdc_taichi.sim.bills import with_prices
from sdc_taichi.sim.crac_units import Supply
from sdc_taichi.sim.drivers import Drivers, load_drivers, utc_start
from sdc_taichi.sim.events import ActiveEvent, schedule, seeds_of_fleet
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_state import HallSums, Precision
from sdc_taichi.sim.inlet_parts import IntakeAir
from sdc_taichi.sim.junction_parts import NO_JUNCTIONS, JunctionParts
from sdc_taichi.sim.liquid_halls import LiquidStep, no_liquid_state, with_leaks, without_liquid
from sdc_taichi.sim.physical_limits import AIR_LIMITS_C, limit_error
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.snapshot import LAST_START
from sdc_taichi.sim.stages import Stages, make_stages
from sdc_taichi.sim.step_inputs import Commands, Surroundings
from sdc_taichi.sim.transfer import TransferResult
from sdc_taichi.sim.work_allocation import RackOutcome
from sdc_taichi.sim.workload import WorkResult
from sdc_taichi.sim.zone_loads import with_loads, zone_loads
from sdc_taichi.types import F64, I32, I64, Actions, ServerLayers, State, StepResult, joined


class Simulator:
    """Simulates one or many data centers together, step by step.

    Args:
        fleet: A fleet, one config or several.
        drivers: Exogenous inputs; None reads the inputs that the configs name.
        precision: Precision of the server kernels; sums and all other stages use f64.
        limits: Outcome of a step in which a hall has no steady air, or in which a result is beyond
            its physical limits. With ``raise`` the step raises an error. With ``flag``, only
            ``within_limits`` of this data center becomes 0. Its air in this step is that of its
            last step within limits, or supply air without heat before any such step, and the
            temperatures in its state stay. It has air of its own again as soon as that is
            physical. The other data centers do not change.

    Raises:
        SdcError: A config or input is not valid.
    """

    def __init__(
        self,
        fleet: Fleet | DataCenterConfig | Iterable[DataCenterConfig],
        *,
        drivers: Drivers | None = None,
        precision: Precision = "f32",
        limits: Literal["raise", "flag"] = "raise",
    ) -> None:
        if precision not in ("f32", "f64"):
            raise ConfigError(f"precision {precision!r}: valid are f32 and f64")
        if limits not in ("raise", "flag"):
            raise ConfigError(f"limits {limits!r}: valid are raise and flag")
        self._flags_limits = limits == "flag"
        # Air of the last step within limits; None before a step, and with limits="raise".
        self._last_air: HallSums | None = None
        # Liquid cooling of the last step; None before a step, and without liquid-cooled racks.
        self._liquid: LiquidStep | None = None
        # True for data centers beyond their limits in the last step, (B,); None without any.
        self._beyond: npt.NDArray[np.bool_] | None = None
        self.fleet = fleet if isinstance(fleet, Fleet) else build_fleet(fleet)
        inputs = load_drivers(self.fleet.configs) if drivers is None else drivers
        # The inputs are None after ``close``.
        self._drivers: Drivers | None = self._checked_drivers(inputs)
        self._initial_start = inputs.start
        self.precision: Precision = precision
        self.step_h = 1.0 / self.fleet.steps_per_hour
        self._timeline = schedule(
            self.fleet.configs,
            self.fleet.places,
            steps_per_hour=self.fleet.steps_per_hour,
            seed=0,
        )
        self.zone_loads = zone_loads(self.fleet, np.zeros(self.fleet.size, dtype=np.int64))
        """Loads of the zones of the halls; None if no data center has ``workload.zone_loads``."""
        self._stages: Stages | None = None
        self._state: State | None = None
        # State before the first step of the run; None if it has to be computed.
        self._first_state: State | None = None

    def __getstate__(self) -> dict[str, Any]:
        if self._stages is not None:
            raise RuntimeStateError(
                "a simulator or environment that has been in use cannot be copied or pickled; "
                "valid before reset(), or state_dict() into load_state_dict() of another made alike"
            )
        return self.__dict__

    @property
    def size(self) -> int:
        """Number of data centers, B."""
        return self.fleet.size

    @property
    def drivers(self) -> Drivers:
        """Exogenous inputs; their ``start`` is the first step of the current run.

        Raises:
            RuntimeStateError: The simulator is closed.
        """
        self._check_open()
        assert self._drivers is not None
        return self._drivers

    @property
    def state(self) -> State:
        """State before the next step.

        Raises:
            RuntimeStateError: The simulator has not been reset or is closed.
        """
        if self._state is None:
            self._check_open()
            raise RuntimeStateError("the simulator has not been reset; call reset() first")
        return self._state

    @property
    def sizing(self) -> Sizing:
        """Sized devices; the first access sizes them."""
        return self._started().sizing

    def reset(
        self,
        seed: int | Sequence[int] | I64 | None = None,
        start: I64 | None = None,
        drivers: Drivers | None = None,
    ) -> State:
        """Start a new run at its first step.

        Args:
            seed: Seed of the sampled events, an integer of 0..2**63 - 1, or one integer per data
                center; None means 0. With a single seed, data centers with different names have
                different events. Of data centers with equal names, the first uses the seed itself,
                and the others use seeds drawn from it. All stages are deterministic.
            start: First step of the run, counted from the beginning of the year in local standard
                time, 0 to ``LAST_START``, (B,); None uses the start of the drivers. Sites of a
                fleet must begin at the same time in UTC, see ``local_start``.
            drivers: New inputs; None keeps the current inputs. Devices keep the sizes that they got
                with the first inputs.

        Returns:
            The initial state.

        Raises:
            ConfigError: Seed, start or drivers are not valid.
        """
        seeds = self._seeds(0 if seed is None else seed)
        inputs = self._checked_drivers(self.drivers if drivers is None else drivers)
        initial = self._initial_start if drivers is None else drivers.start
        first = initial if start is None else np.asarray(start)
        is_valid = first.shape == (self.size,) and first.dtype.kind in "iu"
        if not is_valid or np.any((first < 0) | (first > LAST_START)):
            raise ConfigError(
                f"start {start!r}: valid is one integer of 0..{LAST_START:,} for each of "
                f"{self.size} data centers"
            )
        inputs = replace(inputs, start=first.astype(np.int64))
        self._check_clocks(inputs)
        self.continue_from(self._initial_state(seeds, inputs), inputs)
        self._first_state = self._state
        self._initial_start = initial
        return self.state

    def _initial_state(self, seeds: I64, drivers: Drivers) -> State:
        """Return the state before the first step; see ``reset``."""
        demand = drivers.at(0).demand
        loads = None
        if self.zone_loads is not None:
            self.zone_loads.reseed(seeds)
            loads = self.zone_loads.at(0, demand)
        return self._started().initial_state(self.fleet, seeds, drivers, loads)

    def step(self, actions: Actions | None = None) -> StepResult:
        """Advance all data centers by one step.

        Args:
            actions: Commands; None means neutral load, held or scheduled setpoint, idle battery.

        Raises:
            PhysicalLimitError: A result is physically impossible, and ``limits`` is ``raise``; the
                state does not change.
            RuntimeStateError: The simulator is not reset or is closed, or runs in a forked process.
            SdcError: A command is not finite, out of range or of the wrong shape.
        """
        state, stages = self.state, self._started()
        # Other code may have reset the Taichi runtime, and a forked process has no runtime.
        runtime.ensure_started()
        commands = stages.decoder.decode(actions)
        exogenous = self.drivers.at(state.step)
        if self.zone_loads is not None:
            loads = self.zone_loads.at(state.step, exogenous.demand)
            exogenous, commands = with_loads(loads, self.fleet, exogenous, commands)
        event = self._timeline.at(state.step)
        surroundings = stages.surroundings.at(exogenous, event, state.stored_kwh)
        state = with_leaks(state, surroundings, self.fleet)
        capacity = stages.allocation.capacity(state, commands, surroundings)
        transfer = stages.transfer.run(
            state,
            commands.transfer_shares,
            surroundings.demand,
            surroundings.ci_g_per_kwh,
            capacity.utilisation,
            event.link_up,
        )
        work = stages.workload.run(
            state.queue, surroundings.demand, commands.load_command, capacity.utilisation, transfer
        )
        placement = stages.allocation.place(state, commands, surroundings, work, capacity)
        supply = stages.crac_units.supply(state, commands, surroundings)
        liquid = None
        if stages.liquid is not None:
            liquid = stages.liquid.step(state, commands, surroundings, placement, supply)
            work, liquid.without_room_tasks = stages.workload.put_back(work, liquid.throttled_tasks)
        self._liquid = liquid
        try:
            air, thermal = stages.air.solve(
                state,
                placement,
                supply,
                surroundings,
                None if liquid is None else liquid.to_plant_w,
            )
        except PhysicalLimitError as error:
            raise PhysicalLimitError(f"{error} (step {state.step})") from None
        plant = stages.facility.step(state, commands, surroundings, supply, air, liquid)
        self._beyond = None
        inside, hall = plant["within_limits"], stages.hall
        is_hot = hall.hottest_outlet_c > AIR_LIMITS_C[1]
        if is_hot or np.minimum.reduce(inside) < 1.0 or hall.beyond_limits is not None:
            if not self._flags_limits:
                quantities = {**vars(surroundings), **vars(air), **plant}
                raise limit_error(inside, quantities, state.step, self.fleet)
            air, thermal, plant = self._hold_air(
                state, commands, surroundings, supply, air, thermal, plant, liquid
            )
        if self._flags_limits:
            self._last_air = air
        racks = stages.allocation.protect(state, surroundings, work, placement, air, plant, liquid)
        stage_results = map(vars, (commands, surroundings, transfer, work, supply, air, racks))
        step = {"step": state.step, "step_h": self.step_h}
        of_liquid = without_liquid(self.fleet) if liquid is None else liquid.quantities
        values = joined(step, *stage_results, plant, of_liquid)
        if liquid is not None and stages.liquid is not None:
            values |= stages.liquid.with_liquid(air, liquid)
        result = StepResult(*_values_of_result(values))
        thermal = thermal | (no_liquid_state() if liquid is None else liquid.state)
        self._state = _next_state(state, transfer, work, supply, plant, racks, thermal)
        return result

    def _hold_air(
        self,
        state: State,
        commands: Commands,
        surroundings: Surroundings,
        supply: Supply,
        air: HallSums,
        thermal: dict[str, Any],
        plant: dict[str, Any],
        liquid: LiquidStep | None,
    ) -> tuple[HallSums, dict[str, Any], dict[str, Any]]:
        """Continue with air of an earlier step where a data center is beyond its limits.

        Args:
            state: State at the start of the step.
            commands: Commands of the step.
            surroundings: Surroundings of the step.
            supply: Operation of the CRAC units.
            air: Results of the halls.
            thermal: Temperatures at the end of the step.
            plant: Results of the facility.
            liquid: Liquid cooling, which does not change; None for fleets without it.

        Returns:
            ``air``, ``thermal`` and ``plant`` with the values of these data centers replaced.
        """
        fleet, stages = self.fleet, self._started()
        hottest_c = np.maximum.reduceat(air.rack_outlet_max_c, fleet.rack_offsets[:-1])
        beyond = ~((plant["within_limits"] > 0.0) & (hottest_c <= AIR_LIMITS_C[1]))
        if stages.hall.beyond_limits is not None:
            beyond |= stages.hall.beyond_limits
        last = self._last_air
        if last is None:
            last = plain_supply_air(air, supply, fleet)
        air, thermal = held_air(air, thermal, beyond, last=last, state=state, fleet=fleet)
        plant = stages.facility.step(state, commands, surroundings, supply, air, liquid)
        plant["within_limits"] = np.where(beyond, 0.0, plant["within_limits"])
        self._beyond = beyond
        return air, thermal, plant

    def active_events(self, step: int) -> list[ActiveEvent]:
        """Return the events that cover step ``step`` of the current run."""
        return self._timeline.active(step)

    @property
    def sweeps(self) -> I32:
        """Sweeps, or substeps of transient halls, of each data center in the last step, (B,)."""
        return self._started().hall.sweeps

    def supply_ratio(self) -> F64:
        """Return the supply air of each CRAC unit divided by the racks' need of it, 0..10, (U,).

        Need is that at the exhaust shares of the design point, at the end of the last step; the
        result is 1 without recirculation.
        """
        return self._started().hall.supply_ratio()

    def servers(self, into: ServerLayers | None = None) -> ServerLayers:
        """Return inlet, outlet and power of every server in the last step, (S,) each.

        Args:
            into: Layers to overwrite and return; None allocates new ones.

        Raises:
            RuntimeStateError: No step has been done.
            SdcError: ``into`` has a wrong shape, type or memory order, or is read-only.
        """
        stages = self._started()
        layers, per_rack = stages.hall.servers(into), self.fleet.per_rack_servers()
        if stages.liquid is not None and self._liquid is not None:
            stages.liquid.add_power(layers.power_w, per_rack, self._liquid)
        return self._with_held(layers, per_rack)

    def server_groups(self) -> ServerLayers:
        """Return inlet, outlet and power of one server of each group in the last step, (G,) each.

        All servers of a group have equal values. The next step or call overwrites the arrays.

        Raises:
            RuntimeStateError: No step has been done.
        """
        stages = self._started()
        layers, per_rack = stages.hall.groups(), np.diff(self.fleet.group_offsets)
        if stages.liquid is not None and self._liquid is not None:
            stages.liquid.add_power(layers.power_w, per_rack, self._liquid)
        return self._with_held(layers, per_rack)

    def _with_held(self, layers: ServerLayers, per_rack: npt.NDArray[Any]) -> ServerLayers:
        """Overwrite layers of data centers beyond their limits with means of their racks.

        Args:
            layers: Layers of the last step, with ``per_rack`` entries of each rack.
            per_rack: Number of entries of each rack, (R,).
        """
        if self._beyond is None or self._last_air is None:
            return layers
        counts, air = per_rack.astype(np.int64), self._last_air
        rows = np.repeat(self._beyond[self.fleet.rack_dc], counts)
        server_w = (air.rack_cpu_w + air.rack_fan_w) / self.fleet.per_rack_servers()
        for layer, of_rack in (
            (layers.inlet_c, air.rack_inlet_c),
            (layers.outlet_c, air.rack_outlet_c),
            (layers.power_w, server_w),
        ):
            layer[rows] = np.repeat(of_rack, counts)[rows]
        return layers

    def flows_tasks(self) -> F64:
        """Return the work that sites of each fleet sent to each other in the last step, in tasks.

        The axes are fleet, sender and receiver, (F, S, S). It is 0 if no transfer was commanded.
        """
        return self._started().transfer.flows_tasks()

    def link_up(self) -> F64:
        """Return 1 for data centers whose links worked in the last step, else 0, (B,).

        Data centers that run alone, and those before their first step, have 1.
        """
        last = self.state.step - 1
        if last < 0:
            return np.ones(self.size)
        return self._timeline.at(last).link_up.astype(np.float64)

    def intake_air(self) -> IntakeAir:
        """Return the air before the racks in the last step, the input of ``Inlets``.

        Raises:
            RuntimeStateError: No step has been done.
        """
        stages = self._started()
        return stages.hall.intake_air(stages.crac_units.coldest_supply_c(self.state.setpoint_c))

    def junction_parts(self, rack: int | None = None, dc: int = 0) -> JunctionParts:
        """Split the junction temperature of a liquid-cooled rack at the end of the last step.

        Args:
            rack: Index of the rack in its data center; None is that of the hottest junction.
            dc: Index of the data center.

        Raises:
            RuntimeStateError: No step has been done.
            SdcError: The rack has no cold plates, or no rack has.
        """
        stages = self._started()
        if stages.liquid is None:
            raise SdcError(NO_JUNCTIONS)
        return stages.liquid.junction_parts(dc, rack)

    def state_dict(self, state: State | None = None) -> dict[str, Any]:
        """Return a state as plain arrays, for ``load_state_dict`` or ``numpy.savez``.

        Args:
            state: A state of this simulator; None uses the current state.
        """
        return snapshot.to_dict(self.state if state is None else state, self.fingerprint())

    def load_state_dict(self, values: Mapping[str, Any], drivers: Drivers | None = None) -> None:
        """Continue from a ``state_dict`` of a simulator with the same fleet, inputs and precision.

        Args:
            values: The return value of ``state_dict``.
            drivers: New inputs; None keeps the current inputs.

        Raises:
            SdcError: The snapshot is of another version or fleet, incomplete, or not valid; the
                simulator does not change.
        """
        self.continue_from(self.read_state(values, drivers), drivers)

    def read_state(self, values: Mapping[str, Any], drivers: Drivers | None = None) -> State:
        """Check a ``state_dict`` and return its state, without changing the simulator.

        Args:
            values: The return value of ``state_dict``.
            drivers: Inputs with which it was created; None means the current inputs.

        Raises:
            SdcError: The snapshot is of another version or fleet, incomplete, or not valid.
        """
        inputs = self._checked_drivers(self.drivers if drivers is None else drivers)
        snapshot.check_origin(values, self.fingerprint(inputs))
        like = self._state
        if like is None:
            like = self._initial_state(np.zeros(self.size, dtype=np.int64), inputs)
        return snapshot.to_state(values, like)

    def continue_from(self, state: State, drivers: Drivers | None = None) -> None:
        """Continue from a state of this simulator.

        Args:
            state: Return value of ``read_state``, or an earlier value of ``state``.
            drivers: New inputs; None keeps the current inputs.
        """
        inputs = self.drivers if drivers is None else self._checked_drivers(drivers)
        self._started().hall.discard_last_step()
        self._last_air = self._beyond = self._first_state = None
        self._state = state
        self._timeline = self._timeline.reseeded(state.seed)
        if self.zone_loads is not None:
            self.zone_loads.reseed(state.seed)
        self._drivers = replace(inputs, start=state.start)

    def restart(self, chosen: npt.NDArray[np.bool_]) -> None:
        """Give some data centers the state that they had before the first step of the run.

        The clock goes on: weather, demand and events continue for all data centers.

        Args:
            chosen: True for these data centers, (B,).
        """
        state = self.state
        if self._first_state is None:
            self._first_state = self._initial_state(state.seed, self.drivers)
        now = {name: getattr(state, name) for name in STATE_AXES}
        values = with_entries_of(self._first_state, now, chosen, STATE_AXES, self.fleet)
        values["queue"].flags.writeable = False
        self._state = replace(state, **values)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the current state to an .npz file, atomically and without pickle.

        Raises:
            SdcError: The file cannot be written.
        """
        snapshot.write(path, self.state_dict())

    def load(self, path: str | os.PathLike[str]) -> None:
        """Continue from the state in a file of ``save``.

        Raises:
            SdcError: The file cannot be read or is no snapshot of this fleet.
        """
        self.load_state_dict(snapshot.read(path))

    def fingerprint(self, drivers: Drivers | None = None) -> str:
        """Return the SHA-256 of configs, inputs and precision, which identifies a simulator.

        Args:
            drivers: Inputs; None means the current inputs.
        """
        return snapshot.fingerprint(
            self.fleet,
            self.drivers if drivers is None else self._checked_drivers(drivers),
            self.precision,
        )

    def close(self) -> None:
        """Release state, inputs and kernel arrays; a closed simulator keeps only its ``fleet``."""
        if self._stages is not None:
            self._stages.transfer.close()
            self._stages.workload.close()
            if self._stages.liquid is not None:
                self._stages.liquid.close()
        self._stages = self._state = self._drivers = self._last_air = self._first_state = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _started(self) -> Stages:
        """Return the stages, created on first use, since they size devices and start Taichi."""
        self._check_open()
        if self._stages is None:
            self._stages = make_stages(
                self.fleet, self.drivers, self.precision, event_free=self._timeline.event_free
            )
            self._stages.hall.flags_limits = self._flags_limits
        return self._stages

    def _check_open(self) -> None:
        if self._drivers is None:
            raise RuntimeStateError("the simulator is closed; create a new one")

    def _checked_drivers(self, drivers: Drivers) -> Drivers:
        """Check the number of data centers of inputs, and add prices.

        Raises:
            ConfigError: The inputs are of more or fewer data centers than the fleet.
        """
        if drivers.size != self.fleet.size:
            raise ConfigError(
                f"drivers of {drivers.size} data centers for a fleet of {self.fleet.size}"
            )
        return with_prices(drivers, self.fleet.configs)

    def _check_clocks(self, drivers: Drivers) -> None:
        """Check that the sites of each fleet begin a run at the same time in UTC.

        Raises:
            ConfigError: They begin at different times.
        """
        utc = utc_start(drivers.start, drivers.utc_offset_h, self.fleet.steps_per_hour)
        of_fleets = utc.reshape(-1, self.fleet.sites_per_fleet)
        same = (of_fleets == of_fleets[:, :1]).reshape(-1)
        if not same.all():
            at = int(np.argmin(same))
            raise ConfigError(
                f"start {drivers.start[at]} of {self.fleet.names[at]}: sites of a fleet begin at "
                "the same time in UTC; valid is a start of sdc_taichi.sim.drivers.local_start"
            )

    def _seeds(self, seed: int | Sequence[int] | I64) -> I64:
        """Check a seed argument and return a seed for each data center, (B,)."""
        listed: list[Any] = np.ravel(seed).tolist() if np.ndim(seed) else [seed]
        integers = all(isinstance(x, int | np.integer) and not isinstance(x, bool) for x in listed)
        expected = self.size if np.ndim(seed) else 1
        if len(listed) != expected or not integers or not all(0 <= x < 2**63 for x in listed):
            raise ConfigError(
                f"seed {seed!r}: valid is an integer of 0..2**63 - 1, or one for each of "
                f"{self.size} data centers"
            )
        if not np.ndim(seed):
            return seeds_of_fleet(int(listed[0]), self.fleet.names)
        return np.array(listed, dtype=np.int64)


def _next_state(
    state: State,
    transfer: TransferResult,
    work: WorkResult,
    supply: Supply,
    plant: Mapping[str, Any],
    racks: RackOutcome,
    thermal: Mapping[str, Any],
) -> State:
    """Return the state at the end of a step.

    Arrays that a ``StepResult`` contains are copied, because callers can modify results.
    """
    return State(
        step=state.step + 1,
        seed=state.seed,
        start=state.start,
        setpoint_c=supply.unit_setpoint_c.copy(),
        cooling_run=supply.cooling_run,
        cooling_last=supply.cooling_last,
        fan_speed=supply.fan_speed,
        queue=work.queue,
        in_flight=transfer.in_flight,
        stored_kwh=plant["stored_kwh"].copy(),
        room_heat_kwh=plant["room_heat_kwh"].copy(),
        rack_status=racks.rack_status.copy(),
        restart_wait_min=racks.restart_wait_min,
        **thermal,
    )


_values_of_result = itemgetter(*(f.name for f in fields(StepResult)))
