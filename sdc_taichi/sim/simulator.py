"""The simulator: one step is one pass through the stages, for all data centers at once."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from enum import Enum
from pathlib import Path
from typing import Any, Self
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, RuntimeStateError, SdcError
from sdc_taichi.hall.protection import THROTTLED, TRIPPED
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.plant import cooling, workload
from sdc_taichi.sim.drivers import Drivers, load_drivers
from sdc_taichi.sim.events import ActiveEvent, Disturbance, schedule
from sdc_taichi.sim.facility import Facility, FacilityInputs
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Coil, Conditions, Hall, HallState, HallSums, Precision
from sdc_taichi.sim.queue import Queue
from sdc_taichi.sim.sizing import Sizing, size
from sdc_taichi.sim.work_allocation import WorkAllocation
from sdc_taichi.types import (
    F64,
    I64,
    Actions,
    BatteryAction,
    CoolAction,
    FanAction,
    LoadAction,
    ServerLayers,
    State,
    StepResult,
)

SNAPSHOT_VERSION = 3
_NONE = np.zeros(0)
_MEMORY = tuple(f.name for f in fields(HallState))
_NO_MEMORY = dict.fromkeys(_MEMORY, _NONE)
"""Of quasi-steady halls."""


class Simulator:
    """Data centers that step together.

    Args:
        fleet: a fleet, one config or several.
        drivers: exogenous inputs; None reads what the configs name.
        precision: of the server kernels; sums and all other stages are f64.

    Raises:
        SdcError: a config or input that is not valid.
    """

    def __init__(
        self,
        fleet: Fleet | DataCenterConfig | Iterable[DataCenterConfig],
        *,
        drivers: Drivers | None = None,
        precision: Precision = "f32",
    ) -> None:
        if precision not in ("f32", "f64"):
            raise ConfigError(f"precision {precision!r}: valid are f32 and f64")
        self.fleet = fleet if isinstance(fleet, Fleet) else build_fleet(fleet)
        self.drivers = load_drivers(self.fleet.configs) if drivers is None else drivers
        if self.drivers.size != self.fleet.size:
            raise ConfigError(
                f"drivers of {self.drivers.size} data centers for a fleet of {self.fleet.size}"
            )
        self._initial_start = self.drivers.start
        self.precision: Precision = precision
        self.step_h = 1.0 / self.fleet.steps_per_hour
        self._timeline = schedule(
            self.fleet.configs,
            rack_offsets=self.fleet.rack_offsets,
            unit_offsets=self.fleet.unit_offsets,
            steps_per_hour=self.fleet.steps_per_hour,
            seed=0,
        )
        self._calm = self._timeline.quiet
        self._hall: Hall | None = None
        self._stages: _Stages | None = None
        self._sizing: Sizing | None = None
        self._state: State | None = None
        self._closed = False
        self._prepare_parameters()

    def _prepare_parameters(self) -> None:
        """Read config fields into arrays and look the stage models up by name."""
        v, models = self.fleet.values, self.fleet.models
        per_hour = self.fleet.steps_per_hour
        tasks_per_h = workload.TASKS_PER_STEP * per_hour
        limit_h, deadline_h = v("workload.queue_limit_h"), v("workload.deadline_h")
        self._work = {
            "flexible_share": v("workload.flexible_share"),
            "queue_limit": np.where(
                np.isnan(limit_h), workload.UNLIMITED_TASKS, limit_h * tasks_per_h
            ),
        }
        self._max_utilisation = v("workload.max_utilisation")
        horizon = float(np.max(np.rint(v("workload.age_horizon_h") * per_hour)))
        self._queue_length = int(horizon) + 2
        deadline_steps = np.where(np.isnan(deadline_h), np.inf, np.rint(deadline_h * per_hour))
        due_steps = deadline_steps + workload.DUE_AFTER_STEPS[models["workload"]]
        self._queue = Queue(self._queue_length, due_steps)
        self._unit_dc = self.fleet.unit_dc
        self._setpoint = {
            "step_k": v("hvac.setpoint.step_k")[self._unit_dc],
            "low_c": v("hvac.setpoint.min_c")[self._unit_dc],
            "high_c": v("hvac.setpoint.max_c")[self._unit_dc],
        }
        self._fan_step = v("hvac.crac.fan_step")[self._unit_dc]
        self._coasting = v("hvac.crac.coasting_flow_ratio")[self._unit_dc]
        self._floor = WorkAllocation(self.fleet)
        self._single = self.fleet.units == self.size
        self._all = np.ones(self.size)
        self._all_units = np.ones(self.fleet.units)
        self._min_flow_ratio = v("hvac.crac.min_flow_ratio")
        self._flow_name = models["crac_flow"]
        follows = self._flow_name == "follow_servers"
        lowest = self._min_flow_ratio[self._unit_dc] if follows else self._all_units
        self._fan_range = (lowest, self._all_units)
        self._recirculates = models["inlet"] == "recirculation"
        self._transient = models["thermal"] == "transient"
        self._substep_s = self.fleet.configs[0].simulation.substep_s
        self._work_model = workload.MODELS[models["workload"]]
        self._setpoint_model = cooling.SETPOINTS[models["setpoint"]]

    def __getstate__(self) -> dict[str, Any]:
        if self._hall is not None:
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
    def state(self) -> State:
        """The present state.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        if self._state is None:
            raise RuntimeStateError("the simulator has not been reset; call reset() first")
        return self._state

    @property
    def sizing(self) -> Sizing:
        """Sized devices; sizes them on first use."""
        self._start()
        assert self._sizing is not None
        return self._sizing

    def _start(self) -> Hall:
        if self._closed:
            raise RuntimeStateError("the simulator is closed; create a new one")
        if self._hall is None:
            hall = Hall(self.fleet, self.precision)
            d = self.drivers
            self._sizing = size(self.fleet, hall, d.design_outdoor_c, d.design_wet_bulb_c)
            hall.forget()
            self._stages = _Stages(
                self.fleet, self._sizing, self._work_model, self._work, calm=self._calm
            )
            self._hall = hall
        return self._hall

    def reset(
        self, seed: int | Sequence[int] | I64 | None = None, start: I64 | None = None
    ) -> State:
        """Go back to the first step.

        Args:
            seed: decides the sampled events, an integer of 0..2**63 - 1, or one for each data
                center; None is 0. The stages are deterministic.
            start: index of the first step in the year, (B,); None is the start of the drivers.

        Returns:
            The initial state.

        Raises:
            ConfigError: a seed or start that is not valid.
        """
        seeds = self._seeds(0 if seed is None else seed)
        first = self._initial_start if start is None else np.asarray(start)
        if first.shape != (self.size,) or first.dtype.kind not in "iu" or np.any(first < 0):
            raise ConfigError(
                f"start {start!r}: valid is one integer of at least 0 for each of {self.size} "
                "data centers"
            )
        hall = self._start()
        hall.forget()
        self._timeline = self._timeline.reseeded(seeds)
        self.drivers = replace(self.drivers, start=first.astype(np.int64))
        v, b, fleet = self.fleet.values, self.size, self.fleet
        setpoint_c = v("hvac.setpoint.initial_c")[self._unit_dc]
        inlet_c = v("hvac.setpoint.initial_c")[fleet.rack_dc] + fleet.approach_k
        groups = np.diff(fleet.group_offsets)
        memory = _NO_MEMORY
        if self._transient:
            demand = self.drivers.at(0).demand
            settled = hall.settle(Conditions(setpoint_c, demand, **self._fan_limits(None)))
            memory = _fields(settled)
        self._state = State(
            step=0,
            seed=seeds,
            start=self.drivers.start,
            setpoint_c=setpoint_c,
            cooling_run=np.zeros(fleet.units, dtype=np.int64),
            cooling_last=np.full(fleet.units, np.nan),
            fan_speed=np.ones(fleet.units),
            queue=np.zeros((b, self._queue_length)),
            stored_kwh=v("battery.initial_soc") * self.sizing.battery_kwh,
            room_heat_kwh=np.zeros(b),
            rack_status=np.zeros(fleet.racks, dtype=np.int8),
            group_inlet_c=np.repeat(inlet_c, groups) if self._floor.watches_inlets else _NONE,
            **memory,
        )
        return self._state

    def _seeds(self, given: int | Sequence[int] | I64) -> I64:
        """Seeds of the data centers, (B,)."""
        listed: list[Any] = np.ravel(given).tolist() if np.ndim(given) else [given] * self.size
        whole = all(isinstance(x, int | np.integer) and not isinstance(x, bool) for x in listed)
        if len(listed) != self.size or not whole or not all(0 <= x < 2**63 for x in listed):
            raise ConfigError(
                f"seed {given!r}: valid is an integer of 0..2**63 - 1, or one for each of "
                f"{self.size} data centers"
            )
        return np.array(listed, dtype=np.int64)

    def step(self, actions: Actions | None = None) -> StepResult:
        """Advance all data centers by one step.

        Args:
            actions: named commands; None is neutral load, held setpoint and idle battery.

        Raises:
            RuntimeStateError: before ``reset``, after ``close``, or in a forked child.
            SdcError: a command that is not finite, out of range or of the wrong shape.
        """
        if actions is not None and not isinstance(actions, Actions):
            raise SdcError(f"actions are a {type(actions).__name__}; valid is Actions(...)")
        # Another user of Taichi may have ended the runtime; a forked child has none.
        runtime.ensure_started()
        given = actions or Actions()
        state, sized, step_h = self.state, self.sizing, self.step_h
        hall, stages = self._start(), self._stages
        assert stages is not None
        load_command = self._command("load", given.load, LoadAction, 1.0)
        battery_command = self._command("battery", given.battery, BatteryAction, 1.0)
        cooling_command = self._unit_command("cooling", given.cooling, CoolAction)
        fan_speed = self._fan_speed(state, given.fan)
        calm = self._calm
        event = self._timeline.at(state.step)
        world = self.drivers.at(state.step)
        outdoor_c, wet_bulb_c = world.outdoor_c, world.wet_bulb_c
        if not calm:
            outdoor_c = outdoor_c + event.outdoor_offset_k
            wet_bulb_c = wet_bulb_c + event.outdoor_offset_k

        powered = None if calm else self._powered(state, event)
        floor, status = self._floor, state.rack_status
        capacity, highest = floor.capacity(status, powered, given.placement)
        waiting, due = self._queue.begin_step(state.queue)
        work = stages.work(
            demand=world.demand,
            command=load_command,
            waiting=waiting,
            due=due,
            max_utilisation=np.minimum(self._max_utilisation, highest),
        )
        queued = self._queue.end_step(state.queue, work["dequeued_tasks"], work["deferred_tasks"])
        utilisation = work["utilisation"]
        placed = floor.place(utilisation, capacity, powered, state.group_inlet_c, given.placement)

        setpoint_c, run, last = self._setpoint_model(
            state.setpoint_c,
            cooling_command,
            state.cooling_run,
            state.cooling_last,
            **self._setpoint,
        )
        unit_up, running = None, self._all_units
        if powered is not None:
            unit_up = event.unit_up & (powered > 0)[self._unit_dc]
            running = unit_up.astype(np.float64)
        supply_c = setpoint_c + self._per_unit(state.room_heat_kwh / sized.room_kwh_per_k)
        met = Conditions(
            unit_supply_c=supply_c,
            utilisation=np.minimum(utilisation, 1.0),
            powered=floor.powered(status, powered),
            rack_airflow=None if calm else event.rack_airflow,
            rack_load=placed.rack_load,
            group_load=placed.group_load,
            **self._fan_limits(fan_speed, unit_up),
        )
        plant_setpoint_c, coils = self._coils_in_use(setpoint_c, running)
        around = {
            "plant_setpoint_c": plant_setpoint_c,
            "outdoor_c": outdoor_c,
            "wet_bulb_c": wet_bulb_c,
        }
        if powered is not None:
            around |= {
                "powered": powered,
                "grid_up": event.grid_up.astype(np.float64),
                "chiller_share": event.chiller_share,
                "coils": coils,
            }

        memory = _NO_MEMORY
        if self._transient:
            coil = Coil(
                setpoint_c=setpoint_c,
                room_j=state.room_heat_kwh * 3.6e6,
                room_j_per_k=sized.room_kwh_per_k * 3.6e6,
                limit_w=stages.removable(**around)["removed_w"],
                fan_w_per_m3s=sized.crac_fan_w
                / sized.crac_flow_m3s
                * (1.0 if powered is None else powered),
            )
            before = HallState(**{name: getattr(state, name) for name in _MEMORY})
            air, left = hall.advance(met, before, coil, step_h * 3600.0, self._substep_s)
            memory = _fields(left)
        else:
            air = hall.solve(met)
        after = stages.facility(
            **around,
            **self._of_the_air(air, setpoint_c, fan_speed, running),
            ci_g_per_kwh=world.ci_g_per_kwh,
            battery_command=battery_command,
            stored_kwh=state.stored_kwh,
            room_heat_kwh=state.room_heat_kwh,
        )
        warmed_k = after.pop("warmed_k")

        status = floor.protect(status, air.rack_inlet_max_c)
        lost_tasks = workload.TASKS_PER_STEP * (
            np.maximum(utilisation - placed.utilisation, 0.0)
            + floor.tripped_work(state.rack_status, status, placed, met.powered)
        )
        self._state = State(
            step=state.step + 1,
            seed=state.seed,
            start=state.start,
            setpoint_c=setpoint_c,
            cooling_run=run,
            cooling_last=last,
            fan_speed=fan_speed,
            queue=queued.queue,
            # Not the rows themselves, which would keep all results of the step.
            stored_kwh=after["stored_kwh"].copy(),
            room_heat_kwh=after["room_heat_kwh"].copy(),
            rack_status=status,
            group_inlet_c=hall.group_inlets() if len(state.group_inlet_c) else state.group_inlet_c,
            **memory,
        )
        return StepResult(
            step=state.step,
            step_h=step_h,
            outdoor_c=outdoor_c,
            wet_bulb_c=wet_bulb_c,
            ci_g_per_kwh=world.ci_g_per_kwh,
            demand=world.demand,
            load_command=load_command,
            cooling_command=self._per_dc(cooling_command).copy(),
            battery_command=battery_command,
            utilisation=utilisation,
            arrived_tasks=work["arrived_tasks"],
            executed_tasks=work["executed_tasks"] - lost_tasks,
            deferred_tasks=work["deferred_tasks"],
            drained_tasks=work["drained_tasks"],
            due_tasks=work["due_tasks"],
            overdue_tasks=work["overdue_tasks"],
            dropped_tasks=work["dropped_tasks"],
            lost_tasks=lost_tasks,
            queue_tasks=queued.waiting_tasks,
            oldest_age_h=queued.oldest_age_steps * step_h,
            mean_age_h=queued.mean_age_steps * step_h,
            setpoint_c=self._per_dc(setpoint_c).copy(),
            inlet_mean_c=air.inlet_mean_c,
            inlet_max_c=air.inlet_max_c,
            hottest_rack=air.hottest_rack,
            hottest_server=air.hottest_server,
            throttled_racks=floor.racks_in(status, THROTTLED),
            tripped_racks=floor.racks_in(status, TRIPPED),
            outlet_mean_c=air.outlet_mean_c,
            cpu_w=air.cpu_w,
            it_fan_w=air.it_fan_w,
            it_airflow_m3s=air.it_airflow_m3s,
            thermal_storage_w=air.thermal_storage_w,
            grid_up=event.grid_up.astype(np.float64),
            powered=self._all.copy() if powered is None else powered,
            unit_setpoint_c=setpoint_c.copy(),
            unit_supply_c=setpoint_c + self._per_unit(warmed_k),
            unit_flow_m3s=air.unit_flow_m3s if self._recirculates else after["crac_flow_m3s"],
            unit_running=running.copy(),
            rack_status=status.copy(),
            rack_cpu_w=air.rack_cpu_w,
            rack_fan_w=air.rack_fan_w,
            rack_airflow_m3s=air.rack_airflow_m3s,
            rack_inlet_c=air.rack_inlet_c,
            rack_inlet_max_c=air.rack_inlet_max_c,
            rack_outlet_c=air.rack_outlet_c,
            **after,
        )

    def _coils_in_use(self, setpoint_c: F64, running: F64) -> tuple[F64, F64]:
        """Setpoint that the plant's water serves, and share of the coils in use, each (B,)."""
        if self._calm and self._single:
            return setpoint_c, self._all
        first = self.fleet.unit_offsets[:-1]
        coldest_c = np.minimum.reduceat(np.where(running > 0, setpoint_c, np.inf), first)
        none = np.isinf(coldest_c)
        if np.any(none):
            coldest_c = np.where(none, np.minimum.reduceat(setpoint_c, first), coldest_c)
        design_m3s = self.fleet.unit_design_m3s
        in_use = self.fleet.unit_sums(running * design_m3s)
        return coldest_c, in_use / self.fleet.unit_sums(design_m3s)

    def _of_the_air(
        self, air: HallSums, setpoint_c: F64, fan_speed: F64, running: F64
    ) -> dict[str, F64]:
        """What the facility reads of the halls, see ``FacilityInputs``."""
        sums = self._unit_sums
        out = {
            "cpu_w": air.cpu_w,
            "it_fan_w": air.it_fan_w,
            "it_airflow_m3s": air.it_airflow_m3s,
            "over_27_sum_k": air.over_27_sum_k,
            "under_18_sum_k": air.under_18_sum_k,
            "inlet_m3k_s": air.inlet_m3k_s,
            "outlet_m3k_s": air.outlet_m3k_s,
            "supply_c": air.supply_c,
        }
        flow_m3s = air.unit_flow_m3s
        if self._recirculates:
            out |= {
                "crac_flow_m3s": air.crac_flow_m3s,
                "return_c": air.return_c,
                "cubed_m3s": sums(self.fleet.unit_design_m3s * air.unit_cubed_speed),
                "mixed_m3k_s": sums(flow_m3s * setpoint_c),
            }
        else:
            # Such halls have one unit for all of a data center.
            out |= {"outlet_mean_c": air.outlet_mean_c, "fan_speed": fan_speed}
        if self._transient:
            out |= {
                "cooling_load_w": air.cooling_load_w,
                "coil_w": air.coil_w,
                "room_j": air.room_j,
            }
        if not self._calm:
            idle_m3s = (1.0 - running) * flow_m3s
            out |= {
                "all_running": np.minimum.reduceat(running, self.fleet.unit_offsets[:-1]),
                "idle_m3s": sums(idle_m3s),
                "idle_m3k_s": sums(idle_m3s * setpoint_c),
            }
        return out

    def _powered(self, state: State, event: Disturbance) -> F64:
        """Share of the step with power, (B,).

        In an outage it lasts as long as the battery would carry the facility at its design power,
        which is more than it draws.
        """
        if np.all(event.grid_up):
            return np.ones(self.size)
        design_kw, stages = self.sizing.facility_w / 1e3, self._stages
        assert stages is not None
        carried = stages.run_battery(
            state.stored_kwh, np.full(self.size, -1.0), load_kw=design_kw
        ).discharge_kwh
        return np.where(event.grid_up, 1.0, np.minimum(carried / (design_kw * self.step_h), 1.0))

    def _fan_limits(
        self, speed: F64 | None, unit_up: npt.NDArray[np.bool_] | None = None
    ) -> dict[str, F64]:
        """Speeds between which each CRAC fan follows the servers' airflow, for ``Conditions``."""
        low, high = self._fan_range
        if self._flow_name == "controlled" and speed is not None:
            low = high = speed
        if unit_up is None or np.all(unit_up):
            return {"unit_low": low, "unit_high": high}
        return {
            "unit_low": np.where(unit_up, low, self._coasting),
            "unit_high": np.where(unit_up, high, self._coasting),
            "unit_running": unit_up.astype(np.float64),
        }

    def _fan_speed(self, state: State, given: Any) -> F64:
        if given is FanAction.HOLD:
            return state.fan_speed
        command = self._unit_command("fan", given, FanAction)
        if self._flow_name != "controlled":
            if np.any(command):
                raise SdcError(
                    f"action fan: given, but hvac.crac.flow_model is {self._flow_name}; valid is "
                    "HOLD, or flow model controlled"
                )
            return state.fan_speed
        low = self._min_flow_ratio[self._unit_dc]
        return np.clip(state.fan_speed + command * self._fan_step, low, 1.0)

    def _per_dc(self, per_unit: F64) -> F64:
        """Mean over the CRAC units, (B,)."""
        if self._single:
            return per_unit
        return self.fleet.unit_sums(per_unit) / np.diff(self.fleet.unit_offsets)

    def _per_unit(self, per_dc: F64) -> F64:
        """For each CRAC unit the value of its data center, (U,)."""
        return per_dc if self._single else per_dc[self._unit_dc]

    def _unit_sums(self, per_unit: F64) -> F64:
        """Sum over the CRAC units, (B,)."""
        return per_unit if self._single else self.fleet.unit_sums(per_unit)

    def active_events(self, step: int) -> list[ActiveEvent]:
        """Events that cover step ``step`` of the present run."""
        return self._timeline.active(step)

    def servers(self, into: ServerLayers | None = None) -> ServerLayers:
        """Inlet, outlet and power of every server in the last step, each (S,).

        Args:
            into: layers to overwrite and return; None allocates new ones.

        Raises:
            RuntimeStateError: before the first step.
            SdcError: layers of another shape, type or order, or that may not be written.
        """
        return self._start().servers(into)

    def server_groups(self) -> ServerLayers:
        """As ``servers``, but of one server of each group, whose values all of it have, (G,).

        The next step or call overwrites them.

        Raises:
            RuntimeStateError: before the first step.
        """
        return self._start().groups()

    def state_dict(self, state: State | None = None) -> dict[str, Any]:
        """A state as plain arrays, for ``load_state_dict`` or ``numpy.savez``.

        Args:
            state: one of this simulator's; None is the present one.
        """
        state = self.state if state is None else state
        out = {f.name: np.array(getattr(state, f.name)) for f in fields(State)}
        out["version"] = np.array(SNAPSHOT_VERSION)
        out["fingerprint"] = np.array(self.fingerprint())
        return out

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Continue from a ``state_dict`` of a simulator with the same fleet, inputs and precision.

        Raises:
            SdcError: the snapshot is of another version or fleet, incomplete, or of wrong shape.
        """
        self._start()
        expected = {f.name for f in fields(State)} | {"version", "fingerprint"}
        missing, extra = sorted(expected - set(values)), sorted(set(values) - expected)
        if missing or extra:
            raise SdcError(
                f"snapshot: missing {missing}, unknown {extra}; it is no state of this program"
            )
        if int(values["version"]) != SNAPSHOT_VERSION:
            raise SdcError(f"snapshot: version {values['version']}, expected {SNAPSHOT_VERSION}")
        if str(values["fingerprint"]) != self.fingerprint():
            raise SdcError("snapshot: made by another fleet, inputs or precision than this one")
        like = self._state if self._state is not None else self.reset()
        loaded: dict[str, Any] = {}
        for field in fields(State):
            model = np.asarray(getattr(like, field.name))
            given = np.asarray(values[field.name])
            if given.shape != model.shape or given.dtype != model.dtype:
                raise SdcError(
                    f"snapshot: {field.name} is {given.dtype} {given.shape}, "
                    f"expected {model.dtype} {model.shape}"
                )
            # The last command is not a number before the first step; room heat is below zero while
            # the air is colder than the setpoint.
            signed = field.name.endswith("_c") or field.name == "room_heat_kwh"
            low = -np.inf if signed else 0.0
            valid = np.all(np.isfinite(given) & (given >= low))
            if field.name != "cooling_last" and not valid:
                raise SdcError(f"snapshot: {field.name} has values that are negative or not finite")
            loaded[field.name] = int(given) if given.ndim == 0 else given.copy()
        if np.any(np.diff(loaded["queue"], axis=1) < -workload.NEGLIGIBLE_TASKS):
            raise SdcError("snapshot: queue falls from older to newer work; valid never falls")
        self._start().forget()
        self._state = State(**loaded)
        self._timeline = self._timeline.reseeded(self._state.seed)
        self.drivers = replace(self.drivers, start=self._state.start)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to an .npz file, atomically and without pickle.

        Raises:
            SdcError: the file cannot be written.
        """
        values = self.state_dict()
        with atomic_write(Path(path)) as file:
            np.savez(file, **values)

    def load(self, path: str | os.PathLike[str]) -> None:
        """Continue from a file of ``save``.

        Raises:
            SdcError: the file cannot be read or is no snapshot of this fleet.
        """
        try:
            # Opened here: np.load leaves its own file open when the archive is broken.
            with open(path, "rb") as raw:
                file = np.load(raw, allow_pickle=False)
                values = {name: file[name] for name in file.files}
        except (OSError, ValueError, EOFError, KeyError, AttributeError, BadZipFile) as error:
            raise SdcError(f"{path}: cannot be read as a snapshot ({error})") from None
        self.load_state_dict(values)

    def close(self) -> None:
        """Let go of the kernel arrays; the simulator is unusable afterwards."""
        self._hall = self._stages = None
        self._queue.release()
        self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _unit_command(self, name: str, given: Any, kind: type[Enum]) -> F64:
        """A command for each CRAC unit, (U,), given for all, per data center or per unit."""
        units = self.fleet.units
        command = self._command(name, given, kind, np.inf, units)
        return command if len(command) == units else command[self._unit_dc]

    def _command(self, name: str, given: Any, kind: type[Enum], limit: float, *also: int) -> F64:
        if isinstance(given, Enum):
            if not isinstance(given, kind):
                raise SdcError(f"action {name}: {given} is no {kind.__name__}")
            return np.full(self.size, float(given.value))
        if isinstance(given, list | tuple) and any(isinstance(x, Enum) for x in given):
            given = [x.value if isinstance(x, kind) else x for x in given]
        try:
            command = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise SdcError(
                f"action {name}: {given!r} is neither {kind.__name__} nor numbers"
            ) from None
        if len(command.shape) > 1 or (command.shape and command.shape[0] not in (self.size, *also)):
            valid = dict.fromkeys([(), (self.size,), *((n,) for n in also)])
            raise SdcError(
                f"action {name}: shape {command.shape}, expected {' or '.join(map(str, valid))}"
            )
        largest = np.maximum.reduce(np.abs(command), axis=None)
        # Comparisons with NaN are false, so that it ends here too.
        if not (largest <= limit and largest < np.inf):
            wrong = ~(np.abs(command) <= limit) | ~np.isfinite(command)
            value = command[wrong].flat[0] if command.ndim else command
            raise SdcError(
                f"action {name}: {value}; valid is a finite number within -{limit:g}..{limit:g}"
            )
        return np.full(self.size, float(command)) if command.ndim == 0 else command.copy()

    def fingerprint(self) -> str:
        """SHA-256 of configs, inputs and precision, which tells simulators apart."""
        digest = hashlib.sha256(self.precision.encode())
        # Environments of a batch share their configs.
        texts: dict[int, bytes] = {}
        for config in self.fleet.configs:
            if id(config) not in texts:
                texts[id(config)] = config.model_dump_json().encode()
            digest.update(texts[id(config)])
        digest.update(self.drivers.digest())
        # A matrix that a config names may change under its name.
        if (air := self.fleet.air) is not None:
            mix = air.mix_weights
            for part in (mix.weights, mix.norm, mix.strength, air.exhaust_share, self.fleet.dcs):
                digest.update(part.tobytes())
        return digest.hexdigest()


class _Stages:
    """What runs compiled: decisions about work, and the facility behind the halls.

    Args:
        fleet: B data centers.
        sized: their devices.
        decide: model of ``plant.workload``.
        limits: its constant arguments.
        calm: whether no event can ever happen.
    """

    def __init__(
        self,
        fleet: Fleet,
        sized: Sizing,
        decide: workload.WorkModel,
        limits: Mapping[str, F64],
        *,
        calm: bool,
    ) -> None:
        from sdc_taichi.kernels.compiler.stage import CompiledStage

        models = Facility(fleet, sized, 1.0 / fleet.steps_per_hour, calm=calm)
        self.run_battery = models.run_battery
        self.work = CompiledStage(lambda **x: _fields(decide(**x, **limits)), fleet.size)
        self.facility = CompiledStage(lambda **x: models.step(FacilityInputs(**x)), fleet.size)
        self.removable = CompiledStage(
            lambda **x: models.removable_w(FacilityInputs(**x)), fleet.size
        )


def _fields(record: Any) -> dict[str, Any]:
    """Fields of a dataclass by name."""
    return {f.name: getattr(record, f.name) for f in fields(record)}
