"""Inlets of a run that is done, as sums of parts: in its hottest step, or in any of its steps."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import make_controller
from sdc_taichi.errors import ConfigError, OddInputWarning, SdcError, shortened
from sdc_taichi.run.folder_reader import RunFolder, read_configs, read_hottest_air, read_steps
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.steps_file import air_from_values
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.inlet_parts import Inlets
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import StepResult

SAME_K = 1e-3
"""Difference of the hottest inlets up to which a step that is simulated again is the same, in K."""


@dataclass(frozen=True, slots=True)
class InletsAtStep:
    """Inlets of one data center in one step of a run."""

    step: int
    """The step, counted from 0 at reset."""
    hottest_c: float
    """Hottest server inlet of the step, in C; in transient halls of any substep, while ``inlets``
    are those at the end of the step."""
    config: DataCenterConfig
    """Config of the data center."""
    inlets: Inlets
    """Its inlets as sums of parts."""


def hottest_inlets(run: RunFolder, dc: int) -> InletsAtStep | None:
    """Inlets of a data center in its hottest step, from the air that steps.parquet holds.

    Args:
        run: the run.
        dc: index of the data center.

    Returns:
        The inlets; None where the run is too large for its air to be kept.

    Raises:
        SdcError: steps.parquet is damaged, or a matrix file that the config names has gone.
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


def inlets_at_step(run: RunFolder, dc: int, step: int) -> InletsAtStep:
    """Inlets of a data center in a step of a run, by simulating the run again up to that step.

    The data center runs alone, with its controller, seed, precision and input files, which gives
    the same bits; that its hottest inlet is that of the run is checked.

    Args:
        run: the run.
        dc: index of the data center.
        step: the step, counted from 0 at reset.

    Raises:
        SdcError: no such step, a controller that has no name, an input file that has gone, or a run
            that does not repeat.
    """
    metrics = run.metrics
    if not 0 <= step < metrics["steps_done"]:
        raise ConfigError(f"step {step}: valid is 0..{metrics['steps_done'] - 1} of {run.path}")
    fleet = _fleet_of(run, dc)
    results: list[StepResult] = []
    with Simulator(fleet, precision=metrics["precision"]) as sim:
        simulate(
            sim,
            make_controller(metrics["controller"], fleet, imports=False),
            metrics["steps_asked"],
            metrics["seed"],
            on_step=lambda result: results.__setitem__(slice(None), [result]),
            stop=lambda: bool(results) and results[0].step == step,
        )
        air = sim.intake_air()
    (steps,) = read_steps(run, [dc], ["inlet_max_c"])
    before_c, again_c = float(steps["inlet_max_c"].iloc[step]), float(results[0].inlet_max_c[0])
    if not abs(before_c - again_c) <= SAME_K:
        raise SdcError(
            f"{run.path}: step {step} of {run.names[dc]}, simulated again alone, has a hottest "
            f"inlet of {again_c:.3f} C, and had {before_c:.3f} C; valid is a run whose input files "
            "and versions are those of today, under a controller that treats a data center alike "
            "in any batch"
        )
    return InletsAtStep(step, again_c, fleet.configs[0], Inlets(fleet, 0, air))


def _fleet_of(run: RunFolder, dc: int) -> Fleet:
    """A fleet of one data center of a run."""
    with warnings.catch_warnings():
        # The run itself has given these warnings.
        warnings.simplefilter("ignore", OddInputWarning)
        return build_fleet(read_configs(run, [dc]))
