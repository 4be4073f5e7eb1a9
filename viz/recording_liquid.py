"""Liquid-cooled racks of a data center in a recording: junctions, loops and CDUs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr

from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.types import F32, F64, StepResult

from .colour_scales import ColourScale, classes_of
from .hall_rasters import heat_maps, tile_grid
from .liquid_loop import BOXES, LOOP_FIELDS, PLACES, has_device, loop_pipes, loop_texts
from .recording_frames import Columns, Entities, Frames
from .recording_series import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SKY,
    Cadence,
    Plot,
    device_lines,
    line_factors,
    low_mean_high,
    series_lines,
)

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

LIQUID_PLOTS: dict[str, Plot] = {
    "junction_c": Plot("hottest junction", "C", (("hottest junction", "junction_max_c", RED),)),
    "loop_c": Plot(
        "coolant and facility water",
        "C",
        (
            ("coolant return", "cdu_return_c", ORANGE),
            ("coolant supply", "cdu_supply_c", PINK),
            ("facility return", "facility_return_c", GREEN),
            ("facility supply", "facility_supply_c", BLUE),
            ("outdoor dry bulb", "outdoor_c", GREY),
        ),
    ),
    "heat_kw": Plot(
        "heat of liquid-cooled racks",
        "kW",
        (
            ("into coolant", "liquid_heat_w", BLUE),
            ("into hall air", "liquid_air_w", GREY),
            ("delivered", "reuse_w", GREEN),
            ("rejected", "liquid_rejected_w", SKY),
            ("to CRAC plant", "liquid_to_plant_w", ORANGE),
            ("stored", "liquid_stored_w", PINK),
        ),
    ),
    "power_kw": Plot(
        "power of the loops",
        "kW",
        (
            ("CDU pumps", "cdu_pump_w", BLUE),
            ("facility pumps", "facility_pump_w", SKY),
            ("cooler fans", "cooler_fan_w", GREEN),
            ("trim chiller", "trim_chiller_w", ORANGE),
            ("heat pump", "heat_pump_w", RED),
        ),
    ),
}
"""Plots of the loops of a data center, keyed by entity."""
CDU_PLOTS = {
    "cdu_supply_c": ("cdu_supply_each_c", "supply [C]", 1.0),
    "cdu_flow_l_s": ("cdu_flow_m3s", "flow [l/s]", 1e3),
    "cdu_heat_kw": ("cdu_heat_w", "heat [kW]", 1e-3),
    "cdu_valve": ("cdu_valve", "valve [-]", 1.0),
}
"""Plots with a line for each CDU, keyed by entity: field of ``StepResult``, title with the unit,
and factor that converts the field to this unit."""
_PIPE_RGB = {"hot": (213, 94, 0), "cold": (0, 114, 178), "heat": (230, 159, 0)}
_BOX_RGB = (135, 135, 135)  # legible on dark and on light backgrounds
_ARROW_HEAD = 3.0
_LINE_APART, _ABOVE_LINE = 12.0, 7.0
"""Distance of two lines of a text, and of the middle of a line from its point above it, in units of
the diagram. The viewer draws a label of one line below each point."""


def liquid_plots(*, has_junctions: bool) -> dict[str, Plot]:
    """Return the plots of the loops of a data center by entity."""
    return {name: x for name, x in LIQUID_PLOTS.items() if has_junctions or name != "junction_c"}


class LiquidPictures:
    """Junction map, diagram of the loops, and series of the loops and CDUs of one data center.

    Args:
        sim: the simulator.
        dc: index of the data center, which has liquid-cooled racks.
        cadence: how often heat maps are recorded, and with them the diagram.
    """

    def __init__(self, sim: Simulator, dc: int, cadence: Cadence) -> None:
        fleet = sim.fleet
        self._dc, self._cadence = dc, cadence
        config = fleet.configs[dc]
        self._hall, liquid = config.hall, config.liquid
        assert liquid is not None
        self._liquid = liquid
        self._racks = slice(*fleet.rack_offsets[dc : dc + 2].tolist())
        self._cdus = slice(*fleet.cdu_offsets[dc : dc + 2].tolist())
        self._cdu_count = int(np.diff(fleet.cdu_offsets)[dc])
        self._has_junctions = bool(config.plate_racks())
        self._plots = liquid_plots(has_junctions=self._has_junctions)
        self._factors = {
            entity: line_factors(plot, sim.step_h) for entity, plot in self._plots.items()
        }
        self._series: Frames[dict[str, F64]] = Frames()
        self._junctions: Frames[F32] = Frames()
        self._texts: Frames[list[str]] = Frames()

    @property
    def size_bytes(self) -> int:
        """Size of the frames that ``take`` returns, in bytes."""
        height, width = tile_grid(self._hall).image_shape
        lines = 20 + len(CDU_PLOTS) * self._cdu_count
        return 8 * lines * len(self._series) + (height * width + 400) * len(self._junctions)

    def add(self, result: StepResult, active: Sequence[ActiveEvent]) -> None:
        """Add the series of a step, and map and diagram if they are due; as in ``Pictures``."""
        values: dict[str, F64] = {}
        for entity, plot in self._plots.items():
            of_plot = [getattr(result, field)[self._dc] for _, field, _ in plot.lines]
            values[entity] = np.array(of_plot) * self._factors[entity]
        for entity, (field, _, factor) in CDU_PLOTS.items():
            values[entity] = getattr(result, field)[self._cdus] * factor
        self._series.append(result.step, values)
        every = self._cadence.map_every_steps
        if active:
            every = self._cadence.map_every_steps_in_events
        if result.step % every == 0:
            junction_c = result.rack_junction_c[self._racks].astype(np.float32)
            # Racks without cold plates have 0.
            self._junctions.append(
                result.step, np.where(junction_c > 0, junction_c, np.float32(np.nan))
            )
            loop = {name: float(getattr(result, name)[self._dc]) for name in LOOP_FIELDS}
            texts = loop_texts(loop, self._liquid, "C").values()
            self._texts.append(result.step, "\n".join(texts).split("\n"))

    def entities(self, scales: Mapping[str, ColourScale]) -> Entities:
        """Yield the static entities; arguments as in ``Pictures``."""
        for entity, plot in self._plots.items():
            names = [f"{name} [{plot.unit}]" for name, *_ in plot.lines]
            yield f"liquid/{entity}", series_lines(names, [colour for *_, colour in plot.lines])
        for entity, (_, title, _) in CDU_PLOTS.items():
            yield f"liquid/{entity}", series_lines(*device_lines(self._cdu_count, "CDU", title))
        yield from self._diagram()

    def _diagram(self) -> Entities:
        """Yield boxes and pipes of the diagram, and the places of its texts."""
        boxes = [box for name, box in BOXES.items() if has_device(self._liquid, name)]
        yield (
            "liquid/loop/devices",
            rr.Boxes2D(
                mins=[(box.left, box.top) for box in boxes],
                sizes=[(box.right - box.left, box.bottom - box.top) for box in boxes],
                colors=_BOX_RGB,
            ),
        )
        for kind, pipes in loop_pipes(self._liquid).items():
            strips = []
            for begin, end in np.array(pipes):
                along = (end - begin) / np.hypot(*(end - begin))
                across = np.array([along[1], -along[0]]) / 2
                back = [end - _ARROW_HEAD * (along + turn * across) for turn in (1.0, -1.0)]
                strips.append([begin, end, back[0], end, back[1]])
            radii = rr.Radius.ui_points(1.5)
            yield (
                f"liquid/loop/{kind}",
                rr.LineStrips2D(strips, colors=_PIPE_RGB[kind], radii=radii),
            )
        some = dict.fromkeys(LOOP_FIELDS, 0.0)
        places = []
        for place, text in loop_texts(some, self._liquid).items():
            (x, y), lines = PLACES[place], text.count("\n") + 1
            first = y - _ABOVE_LINE - _LINE_APART * (lines - 1) / 2
            places += [(x, first + _LINE_APART * line) for line in range(lines)]
        yield (
            "liquid/loop/texts",
            rr.Points2D(places, radii=rr.Radius.ui_points(0.0), colors=_BOX_RGB, show_labels=True),
        )

    def take(self, scales: Mapping[str, ColourScale]) -> Iterator[Columns]:
        """Yield the columns of all frames and forget them; arguments as in ``Pictures``."""
        steps, series = self._series.take()
        if not series:
            return
        for entity in (*self._plots, *CDU_PLOTS):
            values = np.stack([of_step[entity] for of_step in series])
            if entity in CDU_PLOTS:
                values = low_mean_high(values)
            yield f"liquid/{entity}", steps, rr.Scalars.columns(scalars=values)
        if len(self._junctions):
            map_steps, junctions_c = self._junctions.take()
            if self._has_junctions:
                classes = classes_of(np.stack(junctions_c), scales["junction"])
                images = heat_maps(classes, tile_grid(self._hall))
                columns: Any = rr.SegmentationImage.columns(buffer=images.reshape(len(images), -1))
                yield "map/junction", map_steps, columns
            text_steps, texts = self._texts.take()
            labels = rr.Points2D.columns(labels=[text for of_step in texts for text in of_step])
            yield "liquid/loop/texts", text_steps, labels.partition([len(each) for each in texts])
