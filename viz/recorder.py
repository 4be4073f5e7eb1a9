"""Recordings of a run for the Rerun viewer: rack heat maps and series of a few data centers.

Everything is written as the run goes, in blocks of steps, so memory does not grow with its length.
"""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import first_step_day
from sdc_taichi.errors import SdcError
from sdc_taichi.fleet import Fleet
from sdc_taichi.types import F64, I64, StepResult
from sdc_taichi.whole_file import writing

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

BLOCK_STEPS = 96
"""Steps per column of the file; every column costs some kB on top of its values."""
MAX_FOCUS = 4
MIN_FREE_BYTES = 2_000_000
EVERY_STEP_UP_TO_RACKS = 200
QUANTUM_K = 1 / 16
"""Resolution of the heat maps: exact in half precision below 64 C, and it compresses well."""

MAPS = {"inlet": (10.0, 45.0), "outlet": (10.0, 60.0)}
"""Heat maps and their fixed ranges in C, so that colours mean the same in every recording."""

_BLUE, _ORANGE, _GREEN, _RED = 0x0072B2FF, 0xE69F00FF, 0x009E73FF, 0xD55E00FF
_PINK, _SKY, _GREY = 0xCC79A7FF, 0x56B4E9FF, 0x999999FF

PLOTS: dict[str, tuple[tuple[str, str, float, int], ...]] = {
    "temperature_c": (
        ("outdoor [C]", "outdoor_c", 1.0, _GREY),
        ("wet bulb [C]", "wet_bulb_c", 1.0, _SKY),
        ("setpoint [C]", "setpoint_c", 1.0, _BLUE),
        ("inlet max [C]", "inlet_max_c", 1.0, _ORANGE),
        ("outlet mean [C]", "outlet_mean_c", 1.0, _RED),
    ),
    "power_kw": (("IT [kW]", "it_w", 1e-3, _BLUE), ("HVAC [kW]", "hvac_w", 1e-3, _ORANGE)),
    "hvac_kw": (
        ("chiller [kW]", "chiller_w", 1e-3, _BLUE),
        ("tower fan [kW]", "tower_fan_w", 1e-3, _SKY),
        ("chilled-water pump [kW]", "chilled_pump_w", 1e-3, _GREEN),
        ("condenser pump [kW]", "condenser_pump_w", 1e-3, _PINK),
        ("CRAC fan [kW]", "crac_fan_w", 1e-3, _ORANGE),
    ),
    "pue": (("PUE [-]", "pue", 1.0, _BLUE),),
    "carbon_intensity": (("grid carbon intensity [g/kWh]", "ci_g_per_kwh", 1.0, _RED),),
    "grid_kwh": (
        ("IT + HVAC [kWh/step]", "facility_kwh", 1.0, _GREY),
        ("grid [kWh/step]", "grid_kwh", 1.0, _BLUE),
    ),
    "battery": (("state of charge [-]", "soc", 1.0, _GREEN),),
    "queue": (("queue [tasks]", "queue_tasks", 1.0, _PINK),),
}
"""Series of a focus data center: entity to (name, field of StepResult, factor, colour)."""

FLEET_PLOTS: dict[str, tuple[str, int]] = {
    "mean_pue": ("mean PUE [-]", _BLUE),
    "carbon_kg": ("total carbon [kg/step]", _RED),
    "hottest_inlet_c": ("hottest inlet [C]", _ORANGE),
}
"""Series over all data centers of the fleet: entity to (name, colour)."""


class Recorder:
    """Writes step results to a Rerun recording (.rrd) that ``rerun FILE`` shows.

    Focus data centers get rack heat maps and series; the whole fleet gets mean PUE, total carbon
    and hottest inlet. Time ``step`` counts from reset and ``sim_time`` is the start of the step on
    the data center's own clock in the year 2001 (fleet series: the first data center's clock).

    The file appears under its name on ``close``, also after an exception when used as a context
    manager, and then holds every step logged so far; an older file of that name is replaced.

    Args:
        path: file to write, ending in .rrd.
        fleet: the fleet of the simulator whose results are logged.
        every: steps between two heat maps; None is 1 up to 200 racks in focus and 4 beyond. Series
            always have every step.
        focus: names of up to 4 data centers to record in full; None is the first 4.
        sources: where the inputs come from, ``Drivers.sources``; None says what the configs name.

    Raises:
        SdcError: rerun-sdk is missing, or an argument is not valid, or the file cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        fleet: Fleet,
        *,
        every: int | None = None,
        focus: Sequence[str] | None = None,
        sources: Sequence[dict[str, str]] | None = None,
    ) -> None:
        rr = _import_rerun()
        fleet.require_distinct_names()
        self._target = _check_path(path)
        self._fleet = fleet
        self._focus = _check_focus(fleet, focus)
        racks = sum(fleet.configs[dc].hall.racks for dc in self._focus)
        self._every = _check_every(every, racks)
        self._origin = {dc: _first_step(fleet, dc) for dc in {0, *self._focus}}
        self._tiles = {dc: tile_index(*_grid(fleet, dc)) for dc in self._focus}
        self._steps: list[int] = []
        self._map_steps: list[int] = []
        self._series: dict[str, list[F64]] = {plot: [] for plot in PLOTS}
        self._fleet_series: list[tuple[float, ...]] = []
        self._racks: dict[tuple[int, str], list[npt.NDArray[np.float32]]] = {
            (dc, what): [] for dc in self._focus for what in MAPS
        }
        self._last_step = -1
        self._open = False
        # Hidden and of another ending, so that nothing takes an unfinished file for a recording.
        self._temporary = self._target.with_name(f".{self._target.name}.{uuid.uuid4().hex}.part")
        _check_writable(self._target, self._temporary)
        self._stream = rr.RecordingStream("sdc_taichi")
        try:
            self._stream.save(self._temporary, default_blueprint=_blueprint(fleet, self._focus))
            self._open = True
            self._log_static(_summary(fleet, self._focus, self._every, sources))
        except BaseException as error:
            self._discard()
            if isinstance(error, OSError | RuntimeError):
                raise SdcError(f"{self._target}: cannot be written ({error})") from None
            raise

    def log(self, result: StepResult) -> None:
        """Add one step.

        Raises:
            SdcError: the recorder is closed, the result is of another fleet, or its step is not
                after the one logged last.
        """
        if not self._open:
            raise SdcError(f"{self._target}: the recorder is closed; create a new one")
        found = (len(result.it_w), len(result.rack_inlet_c))
        expected = (self._fleet.size, self._fleet.racks)
        if found != expected:
            raise SdcError(
                f"{self._target}: result of {found[0]} data centers and {found[1]} racks, "
                f"expected {expected[0]} and {expected[1]}"
            )
        if result.step <= self._last_step:
            raise SdcError(
                f"{self._target}: step {result.step} after step {self._last_step}; "
                "a recording holds one run, steps in order"
            )
        self._last_step = result.step
        focus = list(self._focus)
        self._steps.append(result.step)
        for plot, lines in PLOTS.items():
            columns = [getattr(result, field)[focus] * factor for _, field, factor, _ in lines]
            self._series[plot].append(np.stack(columns, axis=1))
        totals = (result.pue.mean(), result.carbon_g.sum() / 1e3, result.inlet_max_c.max())
        self._fleet_series.append(tuple(map(float, totals)))
        if result.step % self._every == 0:
            self._map_steps.append(result.step)
            rack_c = {"inlet": result.rack_inlet_c, "outlet": result.rack_outlet_c}
            for dc, what in self._racks:
                first, last = self._fleet.rack_start[dc : dc + 2]
                self._racks[dc, what].append(rack_c[what][first:last].astype(np.float32))
        if len(self._steps) == BLOCK_STEPS:
            self._write_block()

    def close(self) -> None:
        """Write what is left and give the file its name; closing again does nothing.

        Without a step there is no file, and a former one stays.

        Raises:
            SdcError: the file cannot be written.
        """
        if not self._open:
            return
        self._open = False
        if self._last_step < 0:
            self._discard()
            return
        try:
            self._write_block()
            self._stream.flush()
            self._stream.disconnect()
            os.replace(self._temporary, self._target)
        except (OSError, RuntimeError) as error:
            raise SdcError(f"{self._target}: cannot be written ({error})") from None
        finally:
            self._discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _discard(self) -> None:
        self._open = False
        self._stream.disconnect()
        self._temporary.unlink(missing_ok=True)

    def _entity(self, dc: int, *parts: str) -> str:
        return "/".join((_dc_path(self._fleet, dc), *parts))

    def _log_static(self, summary: str) -> None:
        import rerun as rr

        rec = self._stream
        rec.send_recording_name(self._target.stem)
        rec.log("summary", rr.TextDocument(summary, media_type="text/markdown"), static=True)
        for what in MAPS:
            _log_colour_bar(rec, what)
        for entity, (name, colour) in FLEET_PLOTS.items():
            line = rr.SeriesLines(names=[name], colors=np.array([colour], np.uint32))
            rec.log(f"fleet/{entity}", line, static=True)
        for dc in self._focus:
            height, width = self._tiles[dc].shape
            for what, limits in MAPS.items():
                image = rr.DepthImage.from_fields(
                    format=rr.components.ImageFormat(
                        width=width, height=height, color_model="L", channel_datatype="F16"
                    ),
                    colormap="inferno",
                    depth_range=limits,
                    meter=1.0,
                    magnification_filter="Nearest",
                )
                rec.log(self._entity(dc, "map", what), image, static=True)
            for plot, lines in PLOTS.items():
                # An array, because a list of three or four numbers is read as one colour.
                colours = np.array([colour for *_, colour in lines], np.uint32)
                series = rr.SeriesLines(names=[name for name, *_ in lines], colors=colours)
                rec.log(self._entity(dc, "series", plot), series, static=True)

    def _write_block(self) -> None:
        import rerun as rr

        if not self._steps:
            return
        rec = self._stream
        totals = np.array(self._fleet_series)
        for column, entity in enumerate(FLEET_PLOTS):
            values = rr.Scalars.columns(scalars=totals[:, column])
            rec.send_columns(f"fleet/{entity}", self._times(0, self._steps), values)
        for index, dc in enumerate(self._focus):
            times = self._times(dc, self._steps)
            for plot, blocks in self._series.items():
                values = rr.Scalars.columns(scalars=np.stack([block[index] for block in blocks]))
                rec.send_columns(self._entity(dc, "series", plot), times, values)
        if self._map_steps:
            for (dc, what), shots in self._racks.items():
                pixels = heat_map_pixels(np.stack(shots), self._tiles[dc], MAPS[what])
                buffer = pixels.reshape(len(shots), -1).view(np.uint8)
                times = self._times(dc, self._map_steps)
                images = rr.DepthImage.columns(buffer=buffer)
                rec.send_columns(self._entity(dc, "map", what), times, images)
        for kept in (self._steps, self._map_steps, self._fleet_series):
            kept.clear()
        for rows in self._series.values():
            rows.clear()
        for maps in self._racks.values():
            maps.clear()

    def _times(self, dc: int, steps: Sequence[int]) -> list[rr.TimeColumn]:
        import rerun as rr

        step = np.array(steps, dtype=np.int64)
        seconds = step * (3600 // self._fleet.steps_per_hour)
        when = self._origin[dc] + seconds.astype("timedelta64[s]")
        return [
            rr.TimeColumn("step", sequence=step),
            rr.TimeColumn("sim_time", timestamp=when.astype("datetime64[ns]")),
        ]


def tile_index(rows: int, racks_per_row: int) -> I64:
    """Rack of every pixel of a hall map, shape (height, width); gaps are ``rows * racks_per_row``.

    A rack is a tile, with one pixel between tiles, shaped so that the hall is about 1.8 times as
    wide as high however many rows it has (tiles at most 8:1).
    """
    ratio = min(max(1.8 * rows / racks_per_row, 1 / 8), 8.0)
    short = 8 if rows * racks_per_row <= EVERY_STEP_UP_TO_RACKS else 4
    height, width = round(short / min(ratio, 1.0)), round(short * max(ratio, 1.0))
    racks = np.arange(rows * racks_per_row).reshape(rows, 1, racks_per_row, 1)
    index = np.full((rows, height + 1, racks_per_row, width + 1), rows * racks_per_row)
    index[:, :height, :, :width] = racks
    return index.reshape(rows * (height + 1), racks_per_row * (width + 1))[:-1, :-1]


def heat_map_pixels(
    rack_c: npt.NDArray[np.float32], tiles: I64, limits: tuple[float, float]
) -> npt.NDArray[np.float16]:
    """Rack temperatures (T, racks) as images (T, height, width), clamped to ``limits``.

    Clamping and filling gaps with the lower limit is needed because the viewer in a browser draws
    what is below the range, and nan, as hot.
    """
    rounded = np.rint(rack_c / QUANTUM_K) * QUANTUM_K
    gap = np.full((len(rack_c), 1), limits[0])
    padded = np.concatenate([np.clip(rounded, *limits), gap], axis=1).astype(np.float16)
    return np.take(padded, tiles, axis=1)


def _import_rerun() -> Any:
    # Recording reports nothing home unless the user has chosen otherwise.
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    try:
        import rerun
    except ImportError as error:
        raise SdcError(
            f"recording needs rerun-sdk ({error}); install it with: pip install rerun-sdk"
        ) from None
    return rerun


def _check_path(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    if target.suffix != ".rrd":
        raise SdcError(f"{target}: a recording's name must end in .rrd")
    if target.is_dir() or not target.parent.is_dir():
        wrong = target if target.is_dir() else target.parent
        state = "is a folder" if target.is_dir() else "is no folder"
        raise SdcError(f"{target}: cannot be written ({wrong} {state})")
    return target


def _check_writable(target: Path, temporary: Path) -> None:
    """Create the temporary file; Rerun waits for ever when the disk is full from the start."""
    free = shutil.disk_usage(target.parent).free
    if free < MIN_FREE_BYTES:
        raise SdcError(
            f"{target}: {free / 1e6:.1f} MB left on the disk, expected {MIN_FREE_BYTES / 1e6:g} MB"
        )
    with writing(target):
        temporary.touch(exist_ok=False)


def _check_focus(fleet: Fleet, focus: Sequence[str] | None) -> tuple[int, ...]:
    if focus is None:
        return tuple(range(min(fleet.size, MAX_FOCUS)))
    names = (focus,) if isinstance(focus, str) else tuple(focus)
    if len(names) > MAX_FOCUS or len(set(names)) < len(names):
        raise SdcError(f"focus {', '.join(names)}: valid are up to {MAX_FOCUS} different names")
    for name in names:
        if name not in fleet.names:
            shown = ", ".join(fleet.names[:10]) + (", ..." if fleet.size > 10 else "")
            raise SdcError(f"focus {name!r}: no such data center; valid: {shown}")
    return tuple(fleet.names.index(name) for name in names)


def _check_every(every: int | None, racks: int) -> int:
    if every is None:
        return 1 if racks <= EVERY_STEP_UP_TO_RACKS else 4
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise SdcError(f"every {every!r}: valid is a positive integer")
    return every


def _grid(fleet: Fleet, dc: int) -> tuple[int, int]:
    hall = fleet.configs[dc].hall
    return hall.rows, hall.racks_per_row


def _first_step(fleet: Fleet, dc: int) -> np.datetime64:
    return np.datetime64("2001-01-01", "s") + np.timedelta64(
        first_step_day(fleet.configs[dc].site.start), "D"
    )


def _dc_path(fleet: Fleet, dc: int) -> str:
    import rerun as rr

    return f"dc/{rr.escape_entity_path_part(fleet.names[dc])}"


def _log_colour_bar(rec: rr.RecordingStream, what: str) -> None:
    """The viewer has no colour bar: a gradient with labelled points."""
    import rerun as rr

    low, high = MAPS[what]
    width, height = 240, 10
    gradient = np.tile(np.linspace(low, high, width, dtype=np.float32), (height, 1))
    bar = rr.DepthImage(gradient, meter=1.0, colormap="inferno", depth_range=(low, high))
    rec.log(f"legend/{what}/bar", bar, static=True)
    ticks = np.arange(low, high + 1.0, 5.0 if high - low <= 40 else 10.0)
    x = (ticks - low) / (high - low) * width
    points = rr.Points2D(
        np.stack([x, np.full_like(x, height + 2.0)], axis=1),
        radii=rr.Radius.ui_points(1.5),
        colors=[200, 200, 200],
        labels=[f"{tick:g} C" for tick in ticks],
        show_labels=True,
    )
    rec.log(f"legend/{what}/ticks", points, static=True)


def _summary(
    fleet: Fleet, focus: Sequence[int], every: int, sources: Sequence[dict[str, str]] | None
) -> str:
    minutes = 60 // fleet.steps_per_hour
    lines = [
        "# sdc-taichi",
        f"{fleet.size} data centers, {fleet.racks} racks, {fleet.servers} servers; "
        f"a step is {minutes} minutes. Times are the start of the step, local standard time, "
        "year 2001. Series have every step, heat maps every "
        + ("step." if every == 1 else f"{every} steps."),
        "",
        "Stage models: " + ", ".join(f"{k} {v}" for k, v in fleet.models.items()) + ".",
        "Counted as HVAC: " + ", ".join(fleet.configs[0].hvac.total_of) + ".",
    ]
    for dc in focus:
        config = fleet.configs[dc]
        named = _named_sources(fleet, dc) if sources is None else sources[dc]
        rows, per_row = _grid(fleet, dc)
        lines += [
            "",
            f"## {config.name}",
            config.description,
            "",
            f"- site {config.site.location}, from {config.site.start}, seed {config.site.seed}",
            f"- hall of {rows} rows with {per_row} racks each",
            *(f"- {kind}: {source}" for kind, source in named.items()),
        ]
    if fleet.size > len(focus):
        rest = fleet.size - len(focus)
        lines += ["", f"The other {rest} data centers are recorded only in the fleet series."]
    return "\n".join(lines)


def _named_sources(fleet: Fleet, dc: int) -> dict[str, str]:
    """What the config names as inputs, for callers that pass no sources."""
    from sdc_taichi.exogenous.synthetic import synthetic_sites, synthetic_traces

    site, trace = fleet.configs[dc].site, fleet.configs[dc].workload.trace
    folded = {name.casefold() for name in (*synthetic_sites(), *synthetic_traces())}

    def describe(file: str | None, name: str) -> str:
        if file is not None:
            return f"file {file}"
        kind = "synthetic" if name.casefold() in folded else "imported"
        return f"{name}, {kind}, seed {site.seed}" if kind == "synthetic" else f"{name}, {kind}"

    return {
        "weather (as configured)": describe(site.weather_file, site.location),
        "carbon (as configured)": describe(site.carbon_file, site.location),
        "workload (as configured)": describe(site.workload_file, trace),
    }


def _blueprint(fleet: Fleet, focus: Sequence[int]) -> rrb.Blueprint:
    import rerun as rr
    import rerun.blueprint as rrb

    # On a timestamp timeline plots open on one minute around the cursor: pin the whole run.
    whole_run = rrb.TimeAxis(
        link="Independent",
        view_range=rrb.TimeRange(
            start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite()
        ),
    )

    def plot(origin: str, name: str, limits: tuple[float, float] | None = None) -> Any:
        return rrb.TimeSeriesView(
            origin=origin,
            name=name,
            axis_x=whole_run,
            axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
            plot_legend=rrb.PlotLegend("RightTop"),
        )

    def heat_map(path: str, what: str) -> list[Any]:
        low, high = MAPS[what]
        scale = rrb.Spatial2DView(
            origin=f"legend/{what}",
            name=f"{what} scale, {low:g} to {high:g} C",
            visual_bounds=rrb.VisualBounds2D(x_range=(-8, 252), y_range=(-4, 24)),
        )
        return [rrb.Spatial2DView(origin=f"{path}/map/{what}", name=f"rack {what} [C]"), scale]

    tabs: list[Any] = []
    for dc in focus:
        path = _dc_path(fleet, dc)
        series = f"{path}/series"
        maps = rrb.Vertical(
            *heat_map(path, "inlet"), *heat_map(path, "outlet"), row_shares=[4, 1, 4, 1]
        )
        plots = rrb.Grid(
            plot(f"{series}/temperature_c", "temperature [C]"),
            plot(f"{series}/power_kw", "power [kW]"),
            plot(f"{series}/hvac_kw", "HVAC by device [kW]"),
            plot(f"{series}/pue", "PUE [-]"),
            plot(f"{series}/carbon_intensity", "grid carbon intensity [g/kWh]"),
            plot(f"{series}/grid_kwh", "energy [kWh/step]"),
            plot(f"{series}/battery", "battery state of charge [-]", (0.0, 1.0)),
            plot(f"{series}/queue", "queue [tasks]"),
            grid_columns=2,
        )
        tabs.append(rrb.Horizontal(maps, plots, column_shares=[4, 5], name=fleet.names[dc]))
    overall = [plot(f"fleet/{entity}", name) for entity, (name, _) in FLEET_PLOTS.items()]
    summary = rrb.TextDocumentView(origin="summary", name="summary")
    tabs.append(rrb.Grid(*overall, summary, grid_columns=2, name="fleet"))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(
            timeline="sim_time", playback_speed=14_400.0, play_state="paused", state="collapsed"
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
