"""States of racks in a recording: racks that are throttled, tripped or have failed fans."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import rerun as rr

from sdc_taichi.hall.protection import NORMAL, THROTTLED, TRIPPED
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.types import Status, StepResult

from .colour_scales import ColourScale
from .recording_frames import Columns, Entities, Frames, class_image, rgb
from .recording_series import ORANGE, PINK, RED

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

FANS_FAILED = 3
"""Class of racks that are on and whose fans have failed; other classes are the status of racks."""
STATES = {
    NORMAL: ("normal", (90, 90, 90)),
    THROTTLED: ("throttled", rgb(ORANGE)),
    TRIPPED: ("tripped", rgb(RED)),
    FANS_FAILED: ("fans failed", rgb(PINK)),
}
"""Name and colour of each class of the map of states."""


def state_classes(status: Status, active: Sequence[ActiveEvent]) -> npt.NDArray[np.uint8]:
    """Return the class of each rack of a data center in the map of states, (R,).

    Args:
        status: status of each rack, (R,).
        active: events of the data center that are active.
    """
    classes = status.astype(np.uint8)
    for event in active:
        if event.kind == "rack_fan_failure" and classes[event.target] != TRIPPED:
            classes[event.target] = FANS_FAILED
    return classes


class StatePictures:
    """Map of the states of the racks of one data center, recorded when they change."""

    def __init__(self, sim: Simulator, dc: int) -> None:
        fleet = sim.fleet
        self._hall = fleet.configs[dc].hall
        self._racks = slice(*fleet.rack_offsets[dc : dc + 2].tolist())
        self._last_status = b""
        self._active: Sequence[ActiveEvent] | None = None
        self._states: Frames[npt.NDArray[np.uint8]] = Frames()

    @property
    def size_bytes(self) -> int:
        """Size of the frames that ``take`` returns, in bytes."""
        return self._hall.racks * len(self._states)

    def add(self, result: StepResult, active: Sequence[ActiveEvent]) -> None:
        """Record the states after a step if they have changed.

        Args:
            result: result of the step.
            active: events of the data center that are active in the step.
        """
        status = result.rack_status[self._racks]
        if active != self._active or status.tobytes() != self._last_status:
            self._states.append(result.step, state_classes(status, active))
            self._last_status = status.tobytes()
            self._active = active

    def entities(self, scales: Mapping[str, ColourScale]) -> Entities:
        """Yield the static entities; arguments as in ``Pictures``."""
        infos = [rr.AnnotationInfo(number, *state) for number, state in STATES.items()]
        yield "state/racks", rr.AnnotationContext(infos)
        yield "state/racks", class_image(self._hall, "U8")
        yield from _legend()

    def take(self, scales: Mapping[str, ColourScale]) -> Iterator[Columns]:
        """Yield the columns of all frames and forget them; arguments as in ``Pictures``."""
        if len(self._states):
            steps, classes = self._states.take()
            yield "state/racks", steps, rr.SegmentationImage.columns(buffer=np.stack(classes))


def _legend() -> Entities:
    """Yield the legend of the map of states: a coloured point for each state, with its name."""
    places = [(60.0 * number, 0.0) for number in range(len(STATES))]
    points = rr.Points2D(
        places,
        radii=rr.Radius.ui_points(7.0),
        colors=[colour for _, colour in STATES.values()],
        labels=[name for name, _ in STATES.values()],
        show_labels=True,
    )
    yield "legend/state", points
