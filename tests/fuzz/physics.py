"""A few steps of any valid data center: finite, within physical limits, and with closed ledgers."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fuzz.case import DefectError, Scratch
from ledgers import LEDGERS, TRANSIENT_LEDGERS, Run, quantities, residual, stocks
from sdc_taichi import Actions, DataCenterConfig, Simulator, State, StepResult
from sdc_taichi.sim.sizing import air_j_per_m3_k
from sdc_taichi.types import F64

STEPS = 5
MOST_RACKS, MOST_GROUPS, MOST_QUEUE_STEPS = 200, 2_000, 40_000
"""Larger data centers are read and left at that: they are valid, and take long."""
LIMITS_C = (-60.0, 200.0)
"""Limits of all temperatures of water and air."""
TOLERANCE = {"f64": 1e-7, "f32": 1e-4}
"""Residual of a ledger over its largest term."""

HEAT_BALANCE = ("heat", "cooling load", "coils", "room air", "cooling", "rejected heat")
"""Ledgers that the released formulas of the plant do not close, as their papers do not."""


def closing(config: DataCenterConfig) -> Iterable[str]:
    """Names of the ledgers that the models of a config close."""
    hvac, servers = config.hvac, config.servers
    paper = {"released", "paper"}
    transient = config.simulation.thermal == "transient"
    open_ones: set[str] = set()
    if paper & {hvac.cooling_load_model, hvac.chiller.model, hvac.tower.model}:
        open_ones |= {*HEAT_BALANCE, "grid"}
    # Given approaches make the inlet of a rack the plain mean of its servers' inlets.
    if servers.outlet_model == "released" or config.hall.inlet_model == "approach":
        open_ones |= {"server air"}
    if config.battery.model == "released":
        open_ones |= {"battery", "battery loss"}
    if hvac.water.model in paper:
        open_ones |= {"water", "blowdown"}
    if len(hvac.total_of) < 5:
        open_ones |= {"hvac"}
    if hvac.pumps.model == "released":
        open_ones |= {"hvac"}
    return [name for name in (TRANSIENT_LEDGERS if transient else LEDGERS) if name not in open_ones]


def is_small(config: DataCenterConfig) -> bool:
    """Whether a few steps of a data center take little time and memory."""
    queue_steps = config.workload.age_horizon_h * config.simulation.steps_per_hour
    groups = sum(map(len, config.servers.groups or ()))
    return (
        config.hall.racks <= MOST_RACKS
        and max(groups, config.hall.racks) <= MOST_GROUPS
        and queue_steps <= MOST_QUEUE_STEPS
    )


def run(scratch: Scratch, config: DataCenterConfig) -> None:
    """Simulate some steps with random actions and check every quantity.

    Raises:
        SdcError: the package refuses the data center, or ends the run.
        DefectError: a quantity is not finite or not physical, or a ledger does not close.
    """
    if not is_small(config):
        return
    precision = "f64" if scratch.chance(0.7) else "f32"
    with Simulator(config, precision=precision) as sim:  # type: ignore[arg-type]
        state = sim.reset()
        results = [sim.step(actions(scratch, sim)) for _ in range(STEPS)]
        check(sim, state, results)


def actions(scratch: Scratch, sim: Simulator) -> Actions:
    """Random commands of one step."""
    rng, config = scratch.rng, sim.fleet.configs[0]
    placement = rng.random(sim.fleet.racks) if config.workload.placement == "weights" else None
    fan = float(rng.integers(-1, 2)) if config.hvac.crac.flow_model == "controlled" else 0.0
    return Actions(
        load=float(rng.uniform(-1, 1)),
        cooling=float(rng.integers(-1, 2)),
        battery=float(rng.uniform(-1, 1)),
        fan=fan,
        placement=placement,
    )


def check(sim: Simulator, start: State, results: list[StepResult]) -> None:
    """Check what some steps of one data center have given.

    Raises:
        DefectError: a quantity is not finite or not physical, or a ledger does not close.
    """
    config = sim.fleet.configs[0]
    steps = [quantities(sim.fleet, result) for result in results]
    values = {name: np.array([step[name] for step in steps]) for name in steps[0]}
    for result in results:
        for name in ("rack_inlet_c", "rack_outlet_c", "rack_outlet_max_c", "unit_supply_c"):
            _check_range(name, getattr(result, name), *LIMITS_C)
    for name, found in values.items():
        low, high = limits_of(name, config)
        _check_range(name, found, low, high)
    if config.workload.model == "tasks":
        # Whole tasks that find the queue full count as dropped, and run.
        values["dropped_tasks"] = np.zeros_like(values["dropped_tasks"])
    recorded = Run(
        values,
        stocks(start),
        sim.fleet.values,
        air_j_per_m3_k(sim.fleet),
        sim.step_h,
        config.electrical.losses == "counted",
        np.empty((0, sim.size)),
    )
    for name in closing(config):
        left = residual(LEDGERS[name](recorded), 1e-6)
        if left.max() > TOLERANCE[sim.precision]:
            raise DefectError(f"ledger {name} is open by {left.max():.1e} of its largest term")


def limits_of(name: str, config: DataCenterConfig) -> tuple[float, float]:
    """Lowest and highest physical value of a quantity by its name and unit."""
    if name.endswith("_c"):
        return LIMITS_C
    if name in ("room_heat_kwh", "thermal_storage_w", "battery_loss_kwh", "cooling_load_w",
                "cooling_command", "racks_air_w", "rci_hi_pct", "rci_lo_pct"):  # fmt: skip
        return -np.inf, np.inf
    if name in ("load_command", "battery_command"):
        return -1.0, 1.0
    if name in ("demand", "soc", "powered", "grid_up"):
        return -1e-9, 1.0 + 1e-9
    if name == "utilisation":
        return -1e-9, (1.0 if config.workload.model == "fluid" else 1.01) + 1e-9
    return -1e-6, np.inf


def _check_range(name: str, values: F64, low: float, high: float) -> None:
    found = np.asarray(values, dtype=np.float64)
    wrong = ~(np.isfinite(found) & (found >= low) & (found <= high))
    if wrong.any():
        raise DefectError(f"{name} is {found[wrong].ravel()[0]:g}; valid is {low:g}..{high:g}")
