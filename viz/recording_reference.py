"""Reference of a recording: another run of the same halls, simulated again for its inlets."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.control import make_controller
from sdc_taichi.errors import ConfigError, OddInputWarning, SdcError
from sdc_taichi.exogenous.year_clock import MINUTES_PER_YEAR
from sdc_taichi.run.folder_reader import RunFolder, read_configs, read_run
from sdc_taichi.run.folder_writer import METRICS_FILE
from sdc_taichi.run.loop import simulate
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64

from .rack_histories import RackHistory

if TYPE_CHECKING:
    from sdc_taichi.types import StepResult


@dataclass(frozen=True, slots=True)
class Reference:
    """Inlets of a reference run at the times of a recorded run."""

    name: str
    """Name of the reference, for titles."""
    histories: Sequence[RackHistory]
    """Histories of the data centers in focus, from the reference run."""
    offsets: I64
    """Step of the reference at the time of step 0 of the recorded run, for each data center in
    focus, (n,)."""
    steps_per_year: int
    """Number of steps in a year."""

    def inlet_c(self, step: int) -> F64 | None:
        """Return the reference's inlets at the time of the year of a step of the recorded run.

        Args:
            step: step of the recorded run, counted from 0 at reset.

        Returns:
            Hottest inlet of each rack in focus, in C, (R,); None if the reference lacks this time.
        """
        steps = (self.offsets + step) % self.steps_per_year
        inlets = [h.inlet_c(int(at)) for h, at in zip(self.histories, steps, strict=True)]
        present = [inlet_c for inlet_c in inlets if inlet_c is not None]
        return np.concatenate(present) if len(present) == len(inlets) else None


def simulate_reference(
    folder: Path, sim: Simulator, names: Sequence[str], focus: Sequence[int], steps: int
) -> Reference:
    """Simulate the run of a folder again, for the inlets of the racks of data centers in focus.

    Args:
        folder: folder of the reference run.
        sim: simulator of the recorded run.
        names: names of all data centers in the recording.
        focus: indices of the data centers in focus.
        steps: number of steps of the recorded run; 0 if it is not known.

    Raises:
        SdcError: the folder holds no run, a run of other halls or of other times, or a run that
            cannot be simulated again.
    """
    run = read_run(folder)
    metrics = run.metrics
    dcs = [_data_center_of(run, names[dc]) for dc in focus]
    with warnings.catch_warnings():
        # The run itself has issued the same warnings.
        warnings.simplefilter("ignore", OddInputWarning)
        fleet = build_fleet(read_configs(run, dcs))
    here = sim.fleet
    for index, dc in enumerate(focus):
        theirs, ours = fleet.configs[index].hall, here.configs[dc].hall
        if (theirs.rows, theirs.racks_per_row) != (ours.rows, ours.racks_per_row):
            raise ConfigError(
                f"--against {folder}: {theirs.rows} rows of {theirs.racks_per_row} racks in "
                f"{run.names[dcs[index]]}, and {ours.rows} rows of {ours.racks_per_row} in "
                f"{names[dc]}; valid is a run of halls of equal size"
            )
    if fleet.steps_per_hour != here.steps_per_hour:
        raise ConfigError(
            f"--against {folder}: {fleet.steps_per_hour} steps an hour; valid are "
            f"{here.steps_per_hour}, as in the recorded run"
        )
    steps_per_year = MINUTES_PER_YEAR // 60 * here.steps_per_hour
    histories = [RackHistory(fleet, dc) for dc in range(fleet.size)]
    done = int(metrics["steps_done"])

    def keep(result: StepResult) -> None:
        for history in histories:
            history.add(result)

    try:
        controller = make_controller(metrics["controller"], fleet)
    except SdcError as error:
        raise ConfigError(f"{folder / METRICS_FILE}: {error}") from None
    with Simulator(fleet, precision=metrics["precision"]) as reference:
        offsets = (sim.drivers.start[list(focus)] - reference.drivers.start) % steps_per_year
        last = int(offsets.max()) + steps if steps else done
        if np.any((offsets >= done) & (offsets + max(steps, 1) <= steps_per_year)):
            raise ConfigError(
                f"--against {folder}: {done} steps from {fleet.configs[0].site.start}; valid is a "
                f"run at the time of the recorded run, from {here.configs[focus[0]].site.start}"
            )
        wanted = min(done, last)
        simulate(
            reference, controller, metrics["steps_asked"], metrics["seed"], on_step=keep,
            stop=lambda: reference.state.step >= wanted,
        )  # fmt: skip
    return Reference(str(folder), histories, offsets, steps_per_year)


def _data_center_of(run: RunFolder, name: str) -> int:
    """Return the index of the data center of a run with a name, or the only one."""
    if len(run.names) == 1:
        return 0
    if name not in run.names:
        shown = ", ".join(run.names[:10]) + (", ..." if len(run.names) > 10 else "")
        raise ConfigError(f"--against {run.path}: no data center {name!r}; it has {shown}")
    return run.names.index(name)
