"""What a fleet did, and the balances that every step of it closes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sdc_taichi import State, StepResult
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import air_j_per_m3_k
from sdc_taichi.types import F64


@dataclass(frozen=True)
class Run:
    """What a fleet did: every quantity of a step by name, (T, B), and the state before step 0."""

    values: dict[str, F64]
    start: dict[str, F64]
    fleet_values: Callable[[str], F64]
    air_j_per_m3_k: F64
    """Heat capacity of the air, (B,)."""
    step_h: float
    counts_losses: bool
    flow_balance: F64
    """Of every watched step, (n, B)."""
    battery_kwh: F64
    """Capacity of the battery, (B,)."""

    def __getitem__(self, name: str) -> F64:
        return self.values[name]

    def before(self, name: str) -> F64:
        """A stock at the start of each step, (T, B)."""
        return np.concatenate([self.start[name][None], self.values[name][:-1]])

    def kwh(self, name: str) -> F64:
        return self.values[name] * self.step_h / 1e3


def stocks(state: State) -> dict[str, F64]:
    """What a state stores, (B,)."""
    return {
        "stored_kwh": state.stored_kwh,
        "room_heat_kwh": state.room_heat_kwh,
        "queue_tasks": state.queue[:, -1],
    }


def started(result: StepResult) -> F64:
    """Work that starts in a step, in tasks, (B,)."""
    return np.asarray(100.0 * result.utilisation)


def quantities(fleet: Fleet, result: StepResult) -> dict[str, F64]:
    """All quantities of a step, and sums over the racks, (B,)."""
    first = fleet.rack_offsets[:-1]
    air = air_j_per_m3_k(fleet)[fleet.rack_dc]
    rack_cpu, rack_fan, rack_flow, rack_in, rack_out = (
        getattr(result, f"rack_{name}").astype(np.float64)
        for name in ("cpu_w", "fan_w", "airflow_m3s", "inlet_c", "outlet_c")
    )
    liquid_w = np.zeros(fleet.racks)
    liquid_w[fleet.liquid_racks] = rack_cpu[fleet.liquid_racks]
    return result.per_dc() | {
        # Throttled work for which the queue has no room is a part of the lost work.
        "unplaced_tasks": np.clip(
            result.throttled_tasks + result.lost_tasks + result.executed_tasks - started(result),
            0.0,
            None,
        ),
        "liquid_racks_w": np.add.reduceat(liquid_w, first),
        "racks_cpu_w": np.add.reduceat(rack_cpu, first),
        "racks_fan_w": np.add.reduceat(rack_fan, first),
        "racks_airflow_m3s": np.add.reduceat(rack_flow, first),
        "racks_air_w": np.add.reduceat(air * rack_flow * (rack_out - rack_in), first),
    }


Ledger = Callable[[Run], list[F64]]
"""The terms of a balance with their signs, each (T, B); they add up to zero."""


def air_w(run: Run) -> F64:
    """Heat of servers, and of the lines and pumps of liquid cooling, in the hall's air, (T, B)."""
    return np.asarray(run["it_w"] - run["liquid_racks_w"] + run["liquid_air_w"])


def pump_heat_w(run: Run) -> F64:
    """Heat of the chilled-water pumps that economiser and chiller take, (T, B); where they take
    less than that, nothing is left for the hall."""
    heat_w = run.fleet_values("hvac.pumps.heat_to_water_share") * run["chilled_pump_w"]
    return np.asarray(np.minimum(heat_w, run["economiser_w"] + run["chiller_load_w"]))


def converted_kwh(run: Run, sign: float) -> F64:
    """Energy that the inverter draws (sign 1) or delivers (-1) less its square loss, (T, B)."""
    standby_kwh = run.fleet_values("battery.standby_per_h") * run.battery_kwh * run.step_h
    bus_kwh = run["charge_kwh"] - run["discharge_kwh"] - standby_kwh * run["grid_up"]
    square_per_kwh = run.fleet_values("battery.square_loss_h") / (run.battery_kwh * run.step_h)
    moved_kwh = np.maximum(sign * bus_kwh, 0.0)
    return np.asarray(moved_kwh - sign * square_per_kwh * moved_kwh**2)


def concentrating_l(run: Run) -> F64:
    """Water that has to leave for the concentration to hold, drift included, (T, B)."""
    cycles = run.fleet_values("hvac.water.cycles_of_concentration")
    return np.asarray(run["evaporation_l"] / (cycles - 1.0))


LEDGERS: dict[str, Ledger] = {
    "heat": lambda r: [
        air_w(r) * r.step_h / 1e3,
        r.kwh("crac_fan_w"),
        -r.kwh("thermal_storage_w"),
        -r.kwh("heat_removed_w"),
        r.before("room_heat_kwh"),
        -r["room_heat_kwh"],
    ],
    "cooling load": lambda r: [
        r["cooling_load_w"],
        -r["heat_removed_w"],
        -r["unmet_w"],
        r["recovered_w"],
    ],
    "coils": lambda r: [r["cooling_load_w"], -air_w(r), -r["crac_fan_w"], r["thermal_storage_w"]],
    "server air": lambda r: [air_w(r), -r["racks_air_w"]],
    "room air": lambda r: [
        air_w(r),
        -r.air_j_per_m3_k * r["crac_flow_m3s"] * (r["return_c"] - r["supply_c"]),
    ],
    "cooling": lambda r: [
        r["heat_removed_w"],
        pump_heat_w(r),
        -r["economiser_w"],
        -r["chiller_load_w"],
        r["liquid_to_plant_w"],
    ],
    "rejected heat": lambda r: [
        r["rejected_w"],
        -r["heat_removed_w"],
        -pump_heat_w(r),
        -r["chiller_w"],
        -r["liquid_to_plant_w"],
    ],
    "work": lambda r: [
        r["arrived_tasks"],
        -r["executed_tasks"],
        -r["lost_tasks"],
        -r["dropped_tasks"],
        r.before("queue_tasks"),
        -r["queue_tasks"],
    ],
    "queue": lambda r: [
        r.before("queue_tasks"),
        r["deferred_tasks"],
        -r["drained_tasks"],
        r["overdue_tasks"] - r["due_tasks"],
        -r["queue_tasks"],
        r["throttled_tasks"] - r["unplaced_tasks"],
    ],
    "battery": lambda r: [
        r.before("stored_kwh"),
        r.fleet_values("battery.charge_efficiency") * converted_kwh(r, 1.0),
        -r.fleet_values("battery.discharge_factor") * converted_kwh(r, -1.0),
        -r["stored_kwh"],
    ],
    "battery loss": lambda r: [
        r.before("stored_kwh"),
        r["charge_kwh"],
        -r["discharge_kwh"],
        -r["battery_loss_kwh"],
        -r["stored_kwh"],
    ],
    "grid": lambda r: [
        r["grid_kwh"],
        r["unserved_kwh"],
        -r.kwh("it_w"),
        -r.kwh("overhead_w"),
        -r["charge_kwh"],
        r["discharge_kwh"],
    ],
    "hvac": lambda r: [
        r["hvac_w"],
        -r["chiller_w"],
        -r["tower_fan_w"],
        -r["chilled_pump_w"],
        -r["condenser_pump_w"],
        -r["crac_fan_w"],
        -r["cdu_pump_w"],
        -r["facility_pump_w"],
        -r["cooler_fan_w"],
        -r["trim_chiller_w"],
        -r["heat_pump_w"],
    ],
    "liquid": lambda r: [
        r["liquid_racks_w"],
        r["cdu_pump_w"],
        r["facility_pump_w"],
        r["trim_chiller_w"],
        r["heat_pump_w"],
        -r["liquid_air_w"],
        -r["reuse_w"],
        -r["liquid_rejected_w"],
        -r["liquid_to_plant_w"],
        -r["liquid_stored_w"],
    ],
    "overhead": lambda r: [
        r["overhead_w"],
        -r["hvac_w"],
        -r["ups_loss_w"] * r.counts_losses,
        -r["distribution_loss_w"] * r.counts_losses,
    ],
    "cost": lambda r: [r["energy_cost"], -r["grid_kwh"] * r["price_per_kwh"]],
    "water": lambda r: [
        r["water_l"],
        -r["evaporation_l"],
        -r["drift_l"],
        -r["blowdown_l"],
        -r["cooler_water_l"],
        -r["leak_l"],
    ],
    "blowdown": lambda r: [
        concentrating_l(r),
        # Without heat to evaporate water, drift alone thins what is left.
        -np.minimum(r["drift_l"], concentrating_l(r)),
        -r["blowdown_l"],
    ],
    "carbon": lambda r: [r["carbon_g"], -r["grid_kwh"] * r["ci_g_per_kwh"]],
    "server power": lambda r: [r["it_w"], -r["cpu_w"], -r["it_fan_w"]],
    "rack CPU power": lambda r: [r["cpu_w"], -r["racks_cpu_w"]],
    "rack fan power": lambda r: [r["it_fan_w"], -r["racks_fan_w"]],
    "rack airflow": lambda r: [r["it_airflow_m3s"], -r["racks_airflow_m3s"]],
}


TRANSIENT_LEDGERS = [name for name in LEDGERS if name not in ("server air", "room air")]
"""Servers and air hold heat there, and products of means are no means of products."""


def residual(terms: list[F64], floor: float = 0.0) -> F64:
    """What is left over the largest term, at least ``floor`` of that of the whole run, (T, B)."""
    total = np.sum(terms, axis=0)
    largest = np.max(np.abs(terms), axis=0)
    largest = np.maximum(largest, floor * largest.max(axis=0))
    return np.asarray(np.abs(total) / np.where(largest > 0, largest, 1.0))


OF_LIQUID = {"queue": 1, "cooling": 1, "rejected heat": 1, "hvac": 5, "water": 2, "liquid": 10}
"""Number of the last terms of each balance that only halls with liquid-cooled racks have."""
