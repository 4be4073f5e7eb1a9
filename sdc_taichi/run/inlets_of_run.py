"""Causes of inlet and junction temperatures in a finished run, in one of its steps."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import make_controller
from sdc_taichi.errors import ConfigError, OddInputWarning, SdcError, shortened
from sdc_taichi.run.folder_reader import RunFolder, read_configs, read_hottest_air, read_steps
from sdc_taichi.run.folder_writer import METRICS_FILE
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.steps_file import air_from_values
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.inlet_parts import Inlets
from sdc_taichi.sim.junction_parts import JunctionParts
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import StepResult

SAME_K = 1e-3
"""Tolerance for the hottest inlet of a step that is simulated again, in K."""


@dataclass(frozen=True, slots=True)
class InletsAtStep:
    """Inlet temperatures of one data center in one step of a run."""

    step: int
    """Index of the step, counted from 0 at reset."""
    hottest_c: float
    """Highest server inlet temperature of the step, in C; in transient halls the maximum over the
    substeps, whereas ``inlets`` describes the end of the step."""
    config: DataCenterConfig
    """Config of the data center."""
    inlets: Inlets
    """Inlet temperatures of the data center, split into parts."""


def hottest_inlets(run: RunFolder, dc: int) -> InletsAtStep | None:
    """Read the inlets of a data center in its hottest step from the air in steps.parquet.

    Returns:
        The inlets; None if the run was too large to store its air.

    Raises:
        SdcError: steps.parquet is damaged, or a matrix file that the config names is missing.
    """
    values = read_hottest_air(run, dc)
    if values is None:
        return None
    fleet = _fleet_of(run, dc)
    place = f"{run.steps_path}: sdc_taichi_air[{dc}]"
    if not isinstance(values, dict):
        raise SdcError(f"{place} is {shortened(values)}; valid is an object")
    try:
        hottest = air_from_values(
            values, racks=fleet.racks, units=fleet.units, steps=run.metrics["steps_done"]
        )
    except ValueError as error:
        raise SdcError(f"{place}: {error}") from None
    hottest_c = float(run.metrics["data_centers"][dc]["metrics"]["hottest_inlet_c"])
    return InletsAtStep(hottest.step, hottest_c, fleet.configs[0], Inlets(fleet, 0, hottest.air))


def inlets_at_step(run: RunFolder, dc: int, step: int, *, allow_code: bool = False) -> InletsAtStep:
    """Compute the inlets of a data center in a step by simulating the run again up to that step.

    The data center is simulated alone, with controller, seed, precision and input files of the run,
    which reproduces the run exactly. Its hottest inlet is checked against that of the run.

    Args:
        run: The run.
        dc: Index of the data center.
        step: Index of the step, counted from 0 at reset.
        allow_code: True if the run's controller may be an import path.

    Raises:
        SdcError: The step does not exist, the controller is not available by name, an input file is
            missing, or the run is not reproduced.
    """
    with _simulated_to(run, dc, step, allow_code=allow_code) as (sim, result):
        inlets = Inlets(sim.fleet, 0, sim.intake_air())
        return InletsAtStep(step, float(result.inlet_max_c[0]), sim.fleet.configs[0], inlets)


def junction_at_step(run: RunFolder, dc: int, step: int, rack: int | None) -> JunctionParts:
    """Split a junction temperature by simulating the run again, as ``inlets_at_step`` does.

    Args:
        run: The run.
        dc: Index of the data center.
        step: Index of the step, counted from 0 at reset.
        rack: Index of the rack in its data center; None is that of the hottest junction.

    Raises:
        SdcError: As ``inlets_at_step``, or the rack has no cold plates.
    """
    with _simulated_to(run, dc, step) as (sim, _):
        return sim.junction_parts(rack)


@contextlib.contextmanager
def _simulated_to(
    run: RunFolder, dc: int, step: int, *, allow_code: bool = False
) -> Iterator[tuple[Simulator, StepResult]]:
    """Simulate a data center of a run alone up to a step; give simulator and result of the step."""
    metrics = run.metrics
    if not 0 <= step < metrics["steps_done"]:
        raise ConfigError(f"step {step}: valid is 0..{metrics['steps_done'] - 1} of {run.path}")
    fleet = _fleet_of(run, dc)
    results: list[StepResult] = []
    try:
        controller = make_controller(metrics["controller"], fleet, allow_code=allow_code)
    except SdcError as error:
        raise ConfigError(f"{run.path / METRICS_FILE}: {error}") from None
    with Simulator(fleet, precision=metrics["precision"]) as sim:
        simulate(
            sim,
            controller,
            metrics["steps_asked"],
            metrics["seed"],
            on_step=lambda result: results.__setitem__(slice(None), [result]),
            stop=lambda: bool(results) and results[0].step == step,
        )
        (steps,) = read_steps(run, [dc], ["inlet_max_c"])
        stored_c, again_c = float(steps["inlet_max_c"].iloc[step]), float(results[0].inlet_max_c[0])
        if not abs(stored_c - again_c) <= SAME_K:
            raise SdcError(
                f"{run.path}: step {step} of {run.names[dc]}, simulated again alone, has a hottest "
                f"inlet of {again_c:.3f} C, and had {stored_c:.3f} C; valid is a run whose input "
                "files and versions are those of today, under a controller that treats a data "
                "center alike in any batch"
            )
        yield sim, results[0]


def _fleet_of(run: RunFolder, dc: int) -> Fleet:
    """Build the fleet of one data center of a run."""
    with warnings.catch_warnings():
        # The same warnings were issued by the run itself.
        warnings.simplefilter("ignore", OddInputWarning)
        return build_fleet(read_configs(run, [dc]))
