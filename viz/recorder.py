"""Recorder of the steps of a simulator, for the Rerun viewer."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from sdc_taichi.errors import SdcError
from sdc_taichi.run.description import RunRequest, describe_run
from sdc_taichi.types import F64, StepResult

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
"""Largest number of data centers in focus, and the number of those taken by default."""
KEEP_BYTES, KEEP_BYTES_PER_VALUE, KEEP_BYTES_PER_DC = 8_000_000, 8, 20_000
"""Bytes that a recording leaves free for the run folder: in all, per value and data center."""


class Recorder:
    """Writes step results to a Rerun recording, or to a viewer that shows them at once.

    A file has its name from the first block on, and holds every whole block whatever ends the run;
    ``close`` adds the index that readers find their way by. Once it cannot go on (a full disk, a
    viewer that was closed) there is one ``RecordingWarning``, and further steps are ignored.

    Args:
        path_or_address: file to write, ending in .rrd, or the address of a running viewer such as
            rerun+http://127.0.0.1:9876/proxy; None with ``serve_port`` alone.
        focus: names of up to 4 data centers to record in full; None is the first 2. The others
            count in the fleet series. Data centers of equal names are called NAME#INDEX.
        every: steps between two heat maps, and between two frames of the 3D hall; None follows the
            number of racks in focus. Series always have every step.
        serve_port: also let viewers connect to this port of 127.0.0.1; 0 picks a free one.

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
        self._episodes = 0
        self._writer: RecordingWriter | None = None

    @property
    def file(self) -> Path | None:
        """File of the present episode, or of the last one."""
        if self._file is None or self._episodes < 2:
            return self._file
        return self._file.with_name(f"{self._file.stem}-{self._episodes}{self._file.suffix}")

    @property
    def served_address(self) -> str | None:
        """Address that viewers connect to, if a port is served."""
        return None if self._port is None else served_at(self._port)

    @property
    def failed(self) -> bool:
        """Whether the recording of the present episode has ended early, after a warning."""
        return self._writer is not None and self._writer.failed

    def begin(self, sim: Simulator, description: Mapping[str, Any] | None = None) -> None:
        """Begin to record an episode of a simulator, before its first step.

        An episode under way is closed. The first is written to the file that was named, the next to
        NAME-2.rrd and so on; nothing is written before there is a step.

        Args:
            sim: the simulator whose steps ``add`` takes.
            description: result of ``describe_run``; None describes the simulator alone.

        Raises:
            SdcError: an unknown name in focus, a file that cannot be written or that another
                process records to, or too little room on its disk.
        """
        self.close()
        self._episodes += 1
        try:
            self._writer = self._new_writer(sim, description)
        except BaseException:
            self._episodes -= 1
            raise

    def _new_writer(self, sim: Simulator, description: Mapping[str, Any] | None) -> RecordingWriter:
        """The writer of an episode, and its output."""
        from .recording_writer import RecordingWriter

        if description is None:
            unknown = ("controller", "seed")
            known = describe_run(sim, RunRequest("", 0))
            description = {name: value for name, value in known.items() if name not in unknown}
        fleet = sim.fleet
        values = int(description.get("steps_asked", 0)) * fleet.size * len(fields(StepResult))
        keep_bytes = KEEP_BYTES + KEEP_BYTES_PER_VALUE * values + KEEP_BYTES_PER_DC * fleet.size
        names = distinct_names(fleet.names)
        focus = _focus_indices(names, self._focus)
        output = RecordingOutput(
            file=self.file,
            address=self._address,
            port=self._port,
            name=self.file.stem if self.file is not None else "sdc-taichi",
            keep_bytes=keep_bytes,
        )
        return RecordingWriter(sim, names, focus, description, output, self._every)

    def add(self, result: StepResult, *, rewards: Mapping[str, F64] | None = None) -> None:
        """Add a step, right after it was done.

        Args:
            result: the result of the step.
            rewards: reward terms by name, each (B,); of every step or of none.

        Raises:
            SdcError: there is no episode, the step is of another simulator, or it does not follow
                the step before.
        """
        if self._writer is None:
            raise SdcError("recorder: begin(sim) comes before the first step")
        self._writer.add(result, rewards)

    def flush(self) -> None:
        """Write the steps that wait for their block to be complete."""
        if self._writer is not None:
            self._writer.flush()

    def close(self) -> None:
        """Write the remaining steps; closing again does nothing."""
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
    """Names of data centers, followed by # and their index where they are not distinct."""
    counts = Counter(names)
    return tuple(n if counts[n] == 1 else f"{n}#{i}" for i, n in enumerate(names))


def _check_focus(focus: Sequence[str]) -> tuple[str, ...]:
    """Check and return the names of the data centers in focus, a list or a single name."""
    names = (focus,) if isinstance(focus, str) else focus
    are_names = isinstance(names, Sequence) and all(isinstance(name, str) for name in names)
    if not (are_names and 0 < len(names) <= MAX_FOCUS and len(set(names)) == len(names)):
        raise SdcError(f"focus {focus!r}: valid are 1 to {MAX_FOCUS} different names")
    return tuple(names)


def _focus_indices(names: Sequence[str], focus: Sequence[str] | None) -> list[int]:
    """Indices of the data centers in focus; None is the first few."""
    if focus is None:
        return list(range(min(len(names), DEFAULT_FOCUS)))
    for name in focus:
        if name not in names:
            shown = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
            raise SdcError(f"focus {name!r}: no such data center; valid: {shown}")
    return [names.index(name) for name in focus]
