"""The simulator: one step is one pass through the stages, for all data centers at once."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import fields
from enum import Enum
from pathlib import Path
from typing import Any, Self
from zipfile import BadZipFile

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.drivers import Drivers, load_drivers
from sdc_taichi.errors import ConfigError, RuntimeStateError, SdcError
from sdc_taichi.fleet import Fleet, build_fleet
from sdc_taichi.hall import Hall, Precision
from sdc_taichi.plant import cooling, water_side, workload
from sdc_taichi.plant.battery import BATTERIES
from sdc_taichi.plant.carbon import emitted_g
from sdc_taichi.plant.chiller import CHILLERS
from sdc_taichi.plant.tower import TOWERS
from sdc_taichi.plant.water import WATER
from sdc_taichi.sizing import Sizing, air_j_per_m3_k, mean_return_approach_k, size
from sdc_taichi.types import (
    F64,
    Actions,
    BatteryAction,
    CoolAction,
    LoadAction,
    ServerLayers,
    State,
    StepResult,
)

SNAPSHOT_VERSION = 1


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
        self.precision: Precision = precision
        self.step_h = 1.0 / self.fleet.steps_per_hour
        self._hall: Hall | None = None
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
            "max_utilisation": v("workload.max_utilisation"),
            "queue_limit": np.where(np.isnan(limit_h), np.inf, limit_h * tasks_per_h),
            "deadline_steps": np.where(
                np.isnan(deadline_h), np.inf, np.rint(deadline_h * per_hour)
            ),
        }
        horizon = float(np.max(np.rint(v("workload.age_horizon_h") * per_hour)))
        self._queue_length = int(horizon) + 2
        self._setpoint = {
            "step_k": v("hvac.setpoint.step_k"),
            "low_c": v("hvac.setpoint.min_c"),
            "high_c": v("hvac.setpoint.max_c"),
        }
        self._air_j_per_m3_k = air_j_per_m3_k(self.fleet)
        self._return_approach_k = mean_return_approach_k(self.fleet)
        self._min_flow_ratio = v("hvac.crac.min_flow_ratio")
        self._supply_m3s_per_w = v("hvac.crac.supply_m3s_per_w")
        self._water = {
            "cycles_of_concentration": v("hvac.water.cycles_of_concentration"),
            "drift_share": v("hvac.water.drift_share"),
        }
        self._battery = {
            name: v(f"battery.{name}")
            for name in (
                "charge_efficiency",
                "discharge_factor",
                "charge_limit_c_rate",
                "discharge_limit_c_rate",
                "upper_u_h",
                "upper_v",
                "lower_u_h",
                "lower_v",
            )
        }
        self._counted = self.fleet.configs[0].hvac.total_of
        self._stores_heat = models["cooling_load"] in cooling.STORES_UNMET_HEAT
        self._work_model = workload.MODELS[models["workload"]]
        self._setpoint_model = cooling.SETPOINTS[models["setpoint"]]
        self._flow_model = cooling.FLOWS[models["crac_flow"]]
        self._load_model = cooling.LOADS[models["cooling_load"]]
        self._chiller_model = CHILLERS[models["chiller"]]
        self._tower_model = TOWERS[models["tower"]]
        self._water_model = WATER[models["water"]]
        self._battery_model = BATTERIES[models["battery"]]

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
            exact = hall if self.precision == "f64" else Hall(self.fleet, "f64")
            d = self.drivers
            self._sizing = size(self.fleet, exact, d.design_outdoor_c, d.design_wet_bulb_c)
            self._hall = hall
        return self._hall

    def reset(self, seed: int | None = None) -> State:
        """Go back to the first step.

        The stages are deterministic; ``seed`` is accepted for callers that treat all environments
        alike and must be a non-negative integer.

        Returns:
            The initial state.
        """
        if seed is not None and (not isinstance(seed, int | np.integer) or seed < 0):
            raise ConfigError(f"seed {seed!r}: valid is a non-negative integer")
        self._start().forget()
        v, b = self.fleet.values, self.size
        self._state = State(
            step=0,
            setpoint_c=v("hvac.setpoint.initial_c"),
            cooling_run=np.zeros(b, dtype=np.int64),
            cooling_last=np.full(b, np.nan),
            cooling_scale=np.ones(b),
            queue=np.zeros((b, self._queue_length)),
            stored_kwh=v("battery.initial_soc") * self.sizing.battery_kwh,
            room_heat_kwh=np.zeros(b),
        )
        return self._state

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
        state, sized, step_h = self.state, self.sizing, self.step_h
        hall = self._start()
        load_command, cooling_command, battery_command = self._commands(actions or Actions())
        world = self.drivers.at(state.step)

        work = self._work_model(world.demand, load_command, state.queue, **self._work)

        setpoint_c, run, last, scale = self._setpoint_model(
            state.setpoint_c,
            cooling_command,
            state.cooling_run,
            state.cooling_last,
            state.cooling_scale,
            **self._setpoint,
        )
        supply_c = setpoint_c + state.room_heat_kwh / sized.room_kwh_per_k

        air = hall.solve(supply_c, work.utilisation)
        it_w = air.cpu_w + air.fan_w

        crac_flow, fan_speed = self._flow_model(
            it_w,
            air.airflow_m3s,
            design_flow_m3s=sized.crac_flow_m3s,
            design_it_airflow_m3s=sized.it_airflow_m3s,
            min_ratio=self._min_flow_ratio,
            supply_m3s_per_w=self._supply_m3s_per_w,
        )
        fan_w = sized.crac_fan_w * fan_speed**3
        return_c, load_w = self._load_model(
            it_w,
            fan_w,
            crac_flow,
            supply_c,
            setpoint_c,
            air.outlet_mean_c,
            air_j_per_m3_k=self._air_j_per_m3_k,
            return_approach_k=self._return_approach_k,
        )

        plant = water_side.operate(
            load_w + state.room_heat_kwh * 1e3 / step_h,
            setpoint_c=setpoint_c,
            outdoor_c=world.outdoor_c,
            wet_bulb_c=world.wet_bulb_c,
            design=sized.water_side,
            chiller=self._chiller_model,
            tower=self._tower_model,
            limited=self._stores_heat,
        )
        unmet_w, recovered_w, room_heat_kwh = cooling.hold_heat(
            load_w, plant.removed_w, state.room_heat_kwh, step_h
        )

        water = self._water_model(
            rejected_w=plant.rejected_w,
            range_k=plant.tower_range_k,
            water_kg_s=plant.tower_water_kg_s,
            wet_bulb_c=world.wet_bulb_c,
            return_c=return_c,
            supply_setpoint_c=setpoint_c,
            dt_s=step_h * 3600.0,
            **self._water,
        )

        devices = {
            "chiller": plant.chiller_w,
            "tower_fan": plant.tower_fan_w,
            "chilled_pump": plant.chilled_pump_w,
            "condenser_pump": plant.condenser_pump_w,
            "crac_fan": fan_w,
        }
        hvac_w = sum((devices[name] for name in self._counted), np.zeros(self.size))
        facility_kw = (it_w + hvac_w) / 1e3

        battery = self._battery_model(
            state.stored_kwh,
            battery_command,
            capacity_kwh=sized.battery_kwh,
            load_kw=facility_kw,
            dt_h=step_h,
            **self._battery,
        )
        self._state = State(
            step=state.step + 1,
            setpoint_c=setpoint_c,
            cooling_run=run,
            cooling_last=last,
            cooling_scale=scale,
            queue=work.queue,
            stored_kwh=battery.stored_kwh,
            room_heat_kwh=room_heat_kwh,
        )
        capacity = np.where(sized.battery_kwh > 0, sized.battery_kwh, 1.0)
        return StepResult(
            step=state.step,
            step_h=step_h,
            outdoor_c=world.outdoor_c,
            wet_bulb_c=world.wet_bulb_c,
            ci_g_per_kwh=world.ci_g_per_kwh,
            demand=world.demand,
            load_command=load_command,
            cooling_command=cooling_command,
            battery_command=battery_command,
            utilisation=work.utilisation,
            arrived_tasks=work.arrived,
            executed_tasks=work.executed,
            deferred_tasks=work.deferred,
            drained_tasks=work.drained,
            due_tasks=work.due,
            overdue_tasks=work.overdue,
            dropped_tasks=work.dropped,
            queue_tasks=work.queue[:, -1].copy(),
            oldest_age_h=work.oldest_age_steps * step_h,
            mean_age_h=work.mean_age_steps * step_h,
            setpoint_c=setpoint_c,
            supply_c=supply_c,
            inlet_mean_c=air.inlet_mean_c,
            inlet_max_c=air.inlet_max_c,
            outlet_mean_c=air.outlet_mean_c,
            cpu_w=air.cpu_w,
            it_fan_w=air.fan_w,
            it_w=it_w,
            it_airflow_m3s=air.airflow_m3s,
            crac_flow_m3s=crac_flow,
            return_c=return_c,
            cooling_load_w=load_w,
            chilled_water_c=plant.chilled_water_c,
            condenser_water_c=plant.condenser_water_c,
            economiser_w=plant.economiser_w,
            chiller_load_w=plant.chiller_load_w,
            unmet_w=unmet_w if self._stores_heat else np.zeros(self.size),
            recovered_w=recovered_w if self._stores_heat else np.zeros(self.size),
            heat_removed_w=plant.removed_w,
            rejected_w=plant.rejected_w,
            room_heat_kwh=room_heat_kwh,
            chiller_w=plant.chiller_w,
            tower_fan_w=plant.tower_fan_w,
            chilled_pump_w=plant.chilled_pump_w,
            condenser_pump_w=plant.condenser_pump_w,
            crac_fan_w=fan_w,
            hvac_w=hvac_w,
            evaporation_l=water.evaporation_l,
            drift_l=water.drift_l,
            blowdown_l=water.blowdown_l,
            water_l=water.makeup_l,
            stored_kwh=battery.stored_kwh,
            soc=battery.stored_kwh / capacity,
            charge_kwh=battery.charge_kwh,
            discharge_kwh=battery.discharge_kwh,
            battery_loss_kwh=battery.loss_kwh,
            it_kwh=it_w * step_h / 1e3,
            hvac_kwh=hvac_w * step_h / 1e3,
            grid_kwh=battery.grid_kwh,
            carbon_g=emitted_g(battery.grid_kwh, world.ci_g_per_kwh),
            rack_cpu_w=air.rack_cpu_w,
            rack_fan_w=air.rack_fan_w,
            rack_airflow_m3s=air.rack_airflow_m3s,
            rack_inlet_c=air.rack_inlet_c,
            rack_inlet_max_c=air.rack_inlet_max_c,
            rack_outlet_c=air.rack_outlet_c,
        )

    def servers(self) -> ServerLayers:
        """Inlet, outlet and power of every server in the last step, each (S,).

        Raises:
            RuntimeStateError: before the first step.
        """
        return self._start().servers()

    def state_dict(self) -> dict[str, Any]:
        """The state as plain arrays, for ``load_state_dict`` or ``numpy.savez``."""
        state = self.state
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
            # The last command is not a number before the first step.
            low = -np.inf if field.name == "setpoint_c" else 0.0
            valid = np.all(np.isfinite(given) & (given >= low))
            if field.name != "cooling_last" and not valid:
                raise SdcError(f"snapshot: {field.name} has values that are negative or not finite")
            loaded[field.name] = int(given) if given.ndim == 0 else given.copy()
        self._start().forget()
        self._state = State(**loaded)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to an .npz file, atomically and without pickle.

        Raises:
            SdcError: the file cannot be written.
        """
        values, target = self.state_dict(), Path(path)
        part = target.with_name(f".{target.name}.{os.getpid()}.part")
        try:
            with part.open("wb") as file:
                np.savez(file, **values)
            part.replace(target)
        except OSError as error:
            raise SdcError(f"{path}: cannot be written ({error})") from None
        finally:
            part.unlink(missing_ok=True)

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
        self._hall = None
        self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _commands(self, actions: Actions) -> tuple[F64, F64, F64]:
        return (
            self._command("load", actions.load, LoadAction, 1.0),
            self._command("cooling", actions.cooling, CoolAction, np.inf),
            self._command("battery", actions.battery, BatteryAction, 1.0),
        )

    def _command(self, name: str, given: Any, kind: type[Enum], limit: float) -> F64:
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
        if command.shape not in ((), (self.size,)):
            raise SdcError(f"action {name}: shape {command.shape}, expected () or ({self.size},)")
        wrong = ~(np.abs(command) <= limit) | ~np.isfinite(command)
        if np.any(wrong):
            value = command[wrong].flat[0] if command.ndim else command
            raise SdcError(
                f"action {name}: {value}; valid is a finite number within -{limit:g}..{limit:g}"
            )
        return np.broadcast_to(command, (self.size,)).copy()

    def fingerprint(self) -> str:
        """SHA-256 of configs, inputs and precision, which tells simulators apart."""
        digest = hashlib.sha256(self.precision.encode())
        for config in self.fleet.configs:
            digest.update(config.model_dump_json().encode())
        digest.update(self.drivers.digest())
        return digest.hexdigest()
