"""Recorder that writes the steps of a simulator for the Rerun viewer."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.rack_selection import RackSelection, parse_racks
from sdc_taichi.run.description import RunRequest, describe_run
from sdc_taichi.types import F64, StepResult

from .colour_scales import InletRange, check_inlet_range
from .recording_output import (
    RecordingOutput,
    check_address,
    check_path,
    check_port,
    import_rerun,
    is_address,
    served_at,
)

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

    from .recording_writer import RecordingWriter

MAX_FOCUS, DEFAULT_FOCUS = 4, 2
"""Largest and default number of data centers in focus, which are recorded in full."""
KEEP_BYTES, KEEP_BYTES_PER_VALUE, KEEP_BYTES_PER_DC = 8_000_000, 8, 20_000
"""Disk space that a recording leaves free for the run folder, in bytes.

The three terms are a constant, a size per value of the steps, and a size per data center.
"""


class Recorder:
    """Writes step results to a Rerun recording file, or to a viewer that shows them at once.

    A file contains every complete block even if the run crashes; ``close`` adds the index of the
    file. If the recording cannot continue (the disk is full, or the viewer was closed), the
    recorder issues one ``RecordingWarning`` and ignores further steps; the simulation goes on.

    Args:
        path_or_address: file to write, ending in .rrd, or the address of a running viewer such as
            rerun+http://127.0.0.1:9876/proxy; None requires ``serve_port``.
        focus: names of up to 4 data centers to record in full; None records the first 2. Other
            data centers are included in the series of the fleet only. Data centers with the same
            name are called NAME#INDEX.
        every: interval of heat maps and of frames of the 3D hall, in steps; None derives it from
            the number of racks in focus. Series always contain every step.
        serve_port: port of 127.0.0.1 to which viewers can connect; 0 picks a free port.
        inlet_range: lowest and highest inlet of the colours of the maps, in C; ``"same"`` is 10 to
            45 C, for recordings that are compared; None is the range that the halls use at the
            beginning of the run, up to their allowable limit at least.
        against: folder of a run of the same halls, which ``begin`` simulates again; a map shows
            inlets less those of this run at the same time of the year. None shows them less the
            last step before an event, if there are events.
        racks: racks whose trends are recorded, such as ``"7,row:3,hottest:10,median"`` (see
            ``hall.rack_selection``); None records the ten hottest of the run and the median one.

    Raises:
        SdcError: rerun-sdk is missing, or an argument is not valid.
    """

    def __init__(
        self,
        path_or_address: str | os.PathLike[str] | None,
        *,
        focus: Sequence[str] | None = None,
        every: int | None = None,
        serve_port: int | None = None,
        inlet_range: InletRange = None,
        racks: str | RackSelection | None = None,
        against: str | os.PathLike[str] | None = None,
    ) -> None:
        import_rerun()
        self._file: Path | None = None
        self._address: str | None = None
        if path_or_address is None:
            if serve_port is None:
                raise SdcError("recorder: neither a file, an address nor a port to serve is given")
        elif is_address(path_or_address):
            self._address = check_address(path_or_address)
        else:
            self._file = check_path(path_or_address)
        if self._address is not None and serve_port is not None:
            raise SdcError(f"recorder: {self._address} and a port to serve; valid is one of them")
        self._port = None if serve_port is None else check_port(serve_port)
        self._focus = None if focus is None else _check_focus(focus)
        is_whole = isinstance(every, int) and not isinstance(every, bool)
        if every is not None and not (is_whole and every > 0):
            raise SdcError(f"every {every!r}: valid is a positive integer")
        self._every = every
        self._racks = parse_racks(racks, "racks") if isinstance(racks, str) else racks
        self._against = None if against is None else Path(against)
        self._inlet_range = check_inlet_range(inlet_range)
        self._episodes = 0
        self._writer: RecordingWriter | None = None

    @property
    def file(self) -> Path | None:
        """File of the current episode, or of the last one if none is open; None without a file."""
        if self._file is None or self._episodes < 2:
            return self._file
        return self._file.with_name(f"{self._file.stem}-{self._episodes}{self._file.suffix}")

    @property
    def served_address(self) -> str | None:
        """Address to which viewers can connect; None without ``serve_port``."""
        return None if self._port is None else served_at(self._port)

    @property
    def failed(self) -> bool:
        """True if the recording of the current episode has ended early, after a warning."""
        return self._writer is not None and self._writer.failed

    def begin(self, sim: Simulator, description: Mapping[str, Any] | None = None) -> None:
        """Begin to record an episode of a simulator; call this before its first step.

        An open episode is closed. The first episode is written to NAME.rrd, the second to
        NAME-2.rrd, and so on. An episode without steps writes nothing.

        Args:
            sim: the simulator whose step results are passed to ``add``.
            description: result of ``describe_run``; None describes the simulator only.

        Raises:
            SdcError: a name in focus is unknown, the file cannot be written, another process
                records to the file, or its disk has too little space.
        """
        self.close()
        self._episodes += 1
        try:
            self._writer = self._new_writer(sim, description)
        except BaseException:
            self._episodes -= 1
            raise

    def _new_writer(self, sim: Simulator, description: Mapping[str, Any] | None) -> RecordingWriter:
        """Create the writer of an episode, with its output."""
        from .recording_writer import RecordingWriter

        if description is None:
            unknown = ("controller", "seed")
            full = describe_run(sim, RunRequest("", 0))
            description = {name: value for name, value in full.items() if name not in unknown}
        fleet = sim.fleet
        values = int(description.get("steps_asked", 0)) * fleet.size * len(fields(StepResult))
        keep_bytes = KEEP_BYTES + KEEP_BYTES_PER_VALUE * values + KEEP_BYTES_PER_DC * fleet.size
        names = distinct_names(fleet.names)
        focus = _focus_indices(names, self._focus)
        reference = None
        if self._against is not None:
            from .recording_reference import simulate_reference

            steps = int(description.get("steps_asked", 0))
            reference = simulate_reference(self._against, sim, names, focus, steps)
        output = RecordingOutput(
            file=self.file,
            address=self._address,
            port=self._port,
            name=self.file.stem if self.file is not None else "sdc-taichi",
            keep_bytes=keep_bytes,
        )
        return RecordingWriter(
            sim,
            names,
            focus,
            description,
            output,
            every_steps=self._every,
            inlet_range=self._inlet_range,
            racks=self._racks,
            reference=reference,
        )

    def add(self, result: StepResult, *, rewards: Mapping[str, F64] | None = None) -> None:
        """Record the latest step of the simulator; call this before the next step.

        Args:
            result: result of the step.
            rewards: reward terms by name, (B,) each. Either all steps of an episode or none have
                rewards.

        Raises:
            SdcError: no episode is open, the step is of another simulator, or it does not follow
                the previous step.
        """
        if self._writer is None:
            raise SdcError("recorder: begin(sim) comes before the first step")
        self._writer.add(result, rewards)

    def flush(self) -> None:
        """Write the steps of the current, incomplete block."""
        if self._writer is not None:
            self._writer.flush()

    def close(self) -> None:
        """Write the remaining steps and end the recording; further calls do nothing."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        writer.close()
        if writer.steps_added == 0:
            self._episodes -= 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def distinct_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of data centers with ``#INDEX`` appended to those that occur more than once."""
    counts = Counter(names)
    return tuple(n if counts[n] == 1 else f"{n}#{i}" for i, n in enumerate(names))


def _check_focus(focus: Sequence[str]) -> tuple[str, ...]:
    """Check and return the names of the data centers in focus; a single name is valid too."""
    names = (focus,) if isinstance(focus, str) else focus
    are_names = isinstance(names, Sequence) and all(isinstance(name, str) for name in names)
    if not (are_names and 0 < len(names) <= MAX_FOCUS and len(set(names)) == len(names)):
        raise SdcError(f"focus {focus!r}: valid are 1 to {MAX_FOCUS} different names")
    return tuple(names)


def _focus_indices(names: Sequence[str], focus: Sequence[str] | None) -> list[int]:
    """Return the indices of the data centers in focus; without names, those of the first few."""
    if focus is None:
        return list(range(min(len(names), DEFAULT_FOCUS)))
    for name in focus:
        if name not in names:
            shown = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
            raise SdcError(f"focus {name!r}: no such data center; valid: {shown}")
    return [names.index(name) for name in focus]
