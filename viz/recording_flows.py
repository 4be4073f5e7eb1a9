"""Work that the sites of a fleet send to each other in a recording: a map, and series by site."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr

from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.types import F64, StepResult

from .recording_frames import Columns, Entities, Frames
from .recording_series import PALETTE

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

FLOW_PLOTS = {
    "sent_tasks": "work sent [tasks/step]",
    "landed_tasks": "work landed [tasks/step]",
    "ci_g_per_kwh": "carbon intensity [g/kWh]",
}
"""Titles of the plots with a line for each site, keyed by the field of ``StepResult``."""
MAP_PATH, ABOUT_PATH = "flows/map", "flows/about"
"""Paths of the map, and of the text that explains it."""
_WIDEST_LINE, _NARROWEST_LINE = 4.0, 0.75
"""Radii of lines, in points of the screen."""
_LARGEST_DISC = 14.0
_COLOURS = np.array([(68, 1, 84), (33, 145, 140), (253, 231, 37)])
"""Colours of the lowest, the middle and the highest carbon intensity: those of viridis."""
_LINE_RGB = (220, 50, 32)
_MAP_POINTS = 600.0
"""Width and height of the map, in points of the screen, that its zoom is made for."""
_BEND, _CURVE_POINTS = 0.16, 12
_HEAD_DEG, _HEAD_SHARE = 2.0, 0.3
"""Largest length of the head of an arrow, in degrees of latitude and as a share of the arrow."""


class FlowPictures:
    """Map and series of the flows of the fleet to which a data center belongs.

    A frame of the map shows the work of the past hour.

    Args:
        sim: the simulator, whose fleets share work.
        names: names of its data centers in the recording.
        dc: index of the data center.
    """

    def __init__(self, sim: Simulator, names: Sequence[str], dc: int) -> None:
        fleet, shared = sim.fleet, sim.fleet.shared_work
        assert shared is not None
        sites = fleet.sites_per_fleet
        self._sim, self._index = sim, dc // sites
        self._sites = slice(self._index * sites, (self._index + 1) * sites)
        self._names = list(names[self._sites])
        self._place_deg = sim.drivers.place_deg[self._sites]
        ci = sim.drivers.ci_g_per_kwh.take(range(fleet.size)[self._sites]).values
        self._ci_range = float(ci.min()), float(max(ci.max(), ci.min() + 1.0))
        capacity = TASKS_PER_STEP * fleet.steps_per_hour
        limit = float(shared.link_tasks[self._sites].max()) * fleet.steps_per_hour
        flexible = float(fleet.values("workload.flexible_share")[self._sites].max())
        self._capacity_tasks, self._most_tasks = capacity, min(limit, flexible * capacity) or 1.0
        self._series: Frames[F64] = Frames()
        self._hours: Frames[tuple[F64, F64, F64]] = Frames()
        self._sums = np.zeros((sites, sites)), np.zeros(sites)

    @property
    def map_zoom(self) -> float | None:
        """Zoom of a map that shows all sites; None if the place of a site is not known.

        At zoom z, a screen of 256 points shows 360 / 2**z degrees of longitude.
        """
        if not np.all(np.isfinite(self._place_deg)):
            return None
        span_deg = float(np.max(np.ptp(self._place_deg, axis=0) * (1.6, 1.0)))
        return float(np.log2(360.0 / max(1.2 * span_deg, 1.0) * _MAP_POINTS / 256.0))

    @property
    def size_bytes(self) -> int:
        """Approximate size of what ``take`` returns, in bytes."""
        sites = len(self._names)
        return 8 * len(FLOW_PLOTS) * sites * len(self._series) + 500 * sites * len(self._hours)

    def add(self, result: StepResult) -> None:
        """Add the last step of the simulator."""
        values = np.array([getattr(result, field)[self._sites] for field in FLOW_PLOTS])
        self._series.append(result.step, values)
        flows, executed = self._sums
        flows += self._sim.flows_tasks()[self._index]
        executed += result.executed_tasks[self._sites]
        if (result.step + 1) % self._sim.fleet.steps_per_hour == 0:
            frame = flows.copy(), executed.copy(), values[-1]
            flows[:], executed[:] = 0.0, 0.0
            self._hours.append(result.step, frame)

    def entities(self) -> Entities:
        """Yield the static entities: styles of lines, and the text about the map."""
        colours = np.array([PALETTE[i % len(PALETTE)] for i in range(len(self._names))], np.uint32)
        for field in FLOW_PLOTS:
            yield f"flows/{field}", rr.SeriesLines(names=self._names, colors=colours)
        low, high = self._ci_range
        text = (
            f"Work that the sites {', '.join(self._names)} sent to each other in the past hour. "
            "Arrows point to the receiver; the widest stand for "
            f"{self._most_tasks:.4g} tasks. Discs are sites: larger ones executed more work, and "
            f"the carbon intensity is from {low:.0f} g/kWh (violet) to {high:.0f} g/kWh (yellow)."
        )
        yield ABOUT_PATH, rr.TextDocument(text)

    def take(self) -> Iterable[Columns]:
        """Yield the columns of all steps that have not been written, and forget these steps."""
        steps, frames = self._series.take()
        if frames:
            for field, values in zip(FLOW_PLOTS, np.stack(frames, axis=1), strict=True):
                yield f"flows/{field}", steps, rr.Scalars.columns(scalars=values)
        hours, maps = self._hours.take()
        if not maps or self.map_zoom is None:
            return
        flows, executed, ci = (np.array(each) for each in zip(*maps, strict=True))
        yield f"{MAP_PATH}/sent", hours, self._arrows(flows)
        radii = _LARGEST_DISC * np.sqrt(executed / self._capacity_tasks)
        marks = np.linspace(*self._ci_range, len(_COLOURS))
        rgb = np.stack([np.interp(ci, marks, channel) for channel in _COLOURS.T], axis=2)
        for site, name in enumerate(self._names):
            columns = rr.GeoPoints.columns(
                positions=np.tile(self._place_deg[site], (len(hours), 1)),
                radii=rr.Radius.ui_points(radii[:, site]),
                colors=rgb[:, site].round().astype(np.uint8),
            )
            yield f"{MAP_PATH}/{rr.escape_entity_path_part(name)}", hours, columns

    def _arrows(self, flows: F64) -> Any:
        """Return the columns of arrows for flows by hour, sender and receiver, (T, S, S)."""
        at = np.argwhere(flows)
        shares = flows[tuple(at.T)] / self._most_tasks
        columns = rr.GeoLineStrings.columns(
            line_strings=[
                _arrow(self._place_deg[sender], self._place_deg[receiver])
                for _, sender, receiver in at
            ],
            radii=rr.Radius.ui_points(np.clip(_WIDEST_LINE * shares, _NARROWEST_LINE, None)),
            colors=np.tile(np.array(_LINE_RGB, np.uint8), (len(at), 1)),
        )
        return columns.partition(np.bincount(at[:, 0], minlength=len(flows)))


def _arrow(begin_deg: F64, end_deg: F64) -> F64:
    """Return the points of a bent arrow with a head, latitude and longitude in degrees, (n, 2)."""
    along = end_deg - begin_deg
    # Degrees of longitude are shorter than those of latitude, and an arrow takes the short way.
    along[1] = (along[1] + 180.0) % 360.0 - 180.0
    shape = np.array([1.0, 1.0 / max(np.cos(np.radians((begin_deg[0] + end_deg[0]) / 2)), 0.1)])
    straight = along / shape
    across = np.array([straight[1], -straight[0]])
    t = np.linspace(0.0, 1.0, _CURVE_POINTS)[:, None]
    curve = t * straight + 2 * t * (1 - t) * _BEND * across
    back = curve[-2] - curve[-1]
    head_deg = min(_HEAD_DEG, _HEAD_SHARE * float(np.hypot(*straight)))
    back *= head_deg / max(float(np.hypot(*back)), 1e-9)
    sides = [curve[-1] + back + turn * np.array([back[1], -back[0]]) for turn in (0.5, -0.5)]
    points = np.concatenate([curve, [sides[0]], curve[-1:], [sides[1]]])
    return np.asarray(begin_deg + points * shape)
