"""Pictures of results with matplotlib: a hall's rack temperatures and a dashboard of a run.

``hall_map``, ``overview`` and ``readme_picture`` return a ``matplotlib.figure.Figure``, which
``figure.savefig(path)`` writes; the other functions are what all pictures share. pyplot is not
used, so no window or global state is touched. Colours are those of Okabe and Ito (2008), "Color
Universal Design", and the maps inferno, viridis and cividis, which readers with colour vision
deficiency can tell apart.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterable
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.floor_plan import FloorPlan
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, Reals, StepResult
from sdc_taichi.year_clock import FIRST_YEAR, day_of_year, step_times

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

DPI = 100
LABELLED_RACKS = 60
"""Largest hall whose racks show their temperature as a number."""
MIN_COLOUR_RANGE_K = 2.0
NAME_LENGTH = 50
TIE_K = 0.05
"""Racks this close to the hottest one count as equally hot; the labels show no finer steps."""

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PINK, SKY, GREY = "#CC79A7", "#56B4E9", "#777777"

POWERS = {
    "it_w": ("IT", BLUE),
    "chiller_w": ("chiller", ORANGE),
    "tower_fan_w": ("tower fan", SKY),
    "chilled_pump_w": ("chilled-water pump", GREEN),
    "condenser_pump_w": ("condenser pump", PINK),
    "crac_fan_w": ("CRAC fan", RED),
}
"""Stacked powers: column to name and colour."""

COLUMNS = (
    "time",
    "outdoor_c",
    "wet_bulb_c",
    "setpoint_c",
    *POWERS,
    "hvac_w",
    "ci_g_per_kwh",
    "carbon_g",
    "queue_tasks",
    "soc",
)
"""Columns that a picture of a run reads."""


def hall_map(result: StepResult, fleet: Fleet, dc: int = 0) -> Figure:
    """Inlet and outlet temperature of every rack of one hall, hottest racks outlined.

    Args:
        result: one step.
        fleet: the fleet it belongs to.
        dc: index of the data center.

    Raises:
        SdcError: matplotlib is missing, or result, fleet and index do not fit together.
    """
    figure = new_figure(9.6, 4.2)
    _check_result(result, fleet, dc)
    for what, axes in zip(("inlet", "outlet"), figure.subplots(1, 2), strict=True):
        _draw_hall(axes, what, result, fleet, dc)
    set_title(figure, f"{short(fleet.names[dc])}: {_clock(result, fleet, dc)}")
    return figure


def step_at(results: Iterable[StepResult], fleet: Fleet, when: str, dc: int = 0) -> StepResult:
    """The first of some steps that covers a time of the data center's clock.

    Args:
        results: steps in order, such as a list or what a loop yields; read up to the one found.
        fleet: the fleet they belong to.
        when: ``MM-DD HH:MM``, local standard time.
        dc: index of the data center.

    Raises:
        SdcError: the text is no such time, or no step covers it.
    """
    if re.fullmatch(r"\d\d-\d\d \d\d:\d\d", when) is None:
        raise SdcError(f"time {when!r}: valid is MM-DD HH:MM, for example 07-01 15:00")
    found: list[str] = []
    for result in results:
        begin = step_time(result, fleet, dc).astype(datetime)
        found = [*found[:1], f"{begin:%m-%d %H:%M}"]
        minutes = (int(when[6:8]) - begin.hour) * 60 + int(when[9:]) - begin.minute
        if when[:5] == f"{begin:%m-%d}" and 0 <= minutes < 60 * result.step_h:
            return result
    span = f"the steps are those from {found[0]} to {found[-1]}" if found else "there are no steps"
    raise SdcError(f"time {when!r}: no step covers it; {span}")


def overview(steps: pd.DataFrame) -> Figure:
    """A run of one data center: weather, power by device, carbon, queue and battery.

    Args:
        steps: one row per step with ``time`` and the columns of ``StepResult.per_dc``.

    Raises:
        SdcError: matplotlib is missing, a column is missing, fewer than two rows, or times that do
            not increase.
    """
    figure = new_figure(12.0, 9.0)
    check_steps(steps)
    draws = (draw_temperatures, draw_power, draw_carbon, draw_storage)
    all_axes = figure.subplots(4, 1, sharex=True, height_ratios=[3, 4, 3, 3])
    for axes, draw in zip(all_axes, draws, strict=True):
        draw(axes, steps)
    format_time(all_axes[-1])
    return figure


def readme_picture(result: StepResult, fleet: Fleet, steps: pd.DataFrame, dc: int = 0) -> Figure:
    """The hall at one step beside power and carbon of the run, 1600 x 700 pixels at 100 dpi.

    Args:
        result: one step of the run; it is marked in the series.
        fleet: the fleet it belongs to.
        steps: the run of that data center, as for ``overview``.
        dc: index of the data center.

    Raises:
        SdcError: as ``hall_map`` and ``overview``, or a step that the run does not have.
    """
    figure = new_figure(16.0, 7.0)
    _check_result(result, fleet, dc)
    check_steps(steps)
    when = step_time(result, fleet, dc)
    if when not in steps["time"].to_numpy():
        raise SdcError(f"step {result.step} at {when}: the run has no such time")
    left, right = figure.subfigures(1, 2, width_ratios=[4, 5], squeeze=False)[0]
    for what, axes in zip(("inlet", "outlet"), left.subplots(2, 1), strict=True):
        _draw_hall(axes, what, result, fleet, dc)
    left.suptitle(f"Racks on {_clock(result, fleet, dc)}", fontsize=13)
    right.suptitle("Power, carbon, queue and battery", fontsize=13)
    all_axes = right.subplots(3, 1, sharex=True, height_ratios=[4, 3, 3])
    for axes, draw in zip(all_axes, (draw_power, draw_carbon, draw_storage), strict=True):
        draw(axes, steps)
        axes.axvline(when, color="black", linewidth=1, linestyle=":")
    format_time(all_axes[-1])
    return figure


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure of ``DPI``.

    Raises:
        SdcError: matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise SdcError(
            f'pictures need matplotlib ({error}); install it with: pip install "sdc-taichi[plot]"'
        ) from None
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def webp(figure: Figure, dpi: int = DPI) -> tuple[int, int, bytes]:
    """Width, height and content of a lossless WebP, two thirds of the size of a PNG.

    Args:
        figure: what to draw.
        dpi: pixels per inch.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    figure.set_dpi(dpi)
    canvas: Any = FigureCanvasAgg(figure)
    with warnings.catch_warnings():
        # Characters that the font lacks show as boxes, which need no warning each.
        warnings.filterwarnings("ignore", message="Glyph ")
        canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    out = io.BytesIO()
    picture.save(out, "WEBP", lossless=True, method=2, quality=0)
    return (*picture.size, out.getvalue())


def set_title(figure: Figure, text: str) -> None:
    """Write a title above at the left, unless it is empty; lines are kept, formulas not read."""
    if text:
        figure.suptitle(text.replace("$", r"\$"), x=0.01, ha="left")


def short(name: str) -> str:
    """A name on one line, cut after ``NAME_LENGTH`` characters."""
    line = " ".join(name.split())
    return line if len(line) <= NAME_LENGTH else line[: NAME_LENGTH - 1] + "…"


def plain(name: str) -> str:
    """``short``, such that matplotlib writes it unchanged.

    matplotlib reads formulas between dollar signs and hides legends that begin with "_".
    """
    line = short(name)
    return (" " if line.startswith("_") else "") + line.replace("$", r"\$")


def check_steps(steps: pd.DataFrame, columns: Iterable[str] = COLUMNS) -> None:
    """Check that a table is a run of one data center.

    Raises:
        SdcError: a column is missing, fewer than two rows, or times that do not increase.
    """
    missing = [name for name in columns if name not in steps.columns]
    if missing:
        raise SdcError(f"steps: missing columns {', '.join(missing)}")
    times = steps["time"].to_numpy()
    if len(times) < 2 or not np.all(times[1:] > times[:-1]):
        raise SdcError(
            f"steps: {len(times)} rows; valid are two or more with increasing time, "
            "of one data center"
        )


def step_edges(steps: pd.DataFrame) -> npt.NDArray[np.datetime64]:
    """Beginnings of n steps and the end of the last, (n + 1,); n of two or more."""
    times: npt.NDArray[np.datetime64] = steps["time"].to_numpy()
    # The shortest, because the clock skips 29 February.
    return np.append(times, times[-1] + np.diff(times).min())


def step_hours(steps: pd.DataFrame) -> float:
    """Length of the steps."""
    return float(np.diff(steps["time"].to_numpy()).min() / np.timedelta64(1, "h"))


def day_of_run(moment: datetime, *, over_a_year: bool) -> str:
    """Day and month, and the year of the run where a day occurs more than once."""
    year = f" (year {moment.year - FIRST_YEAR + 1})" if over_a_year else ""
    return f"{moment.day} {moment:%B}{year}"


def closed(values: npt.ArrayLike) -> F64:
    """Values of n steps for drawing them to the end of the last, (n + 1,)."""
    given = np.asarray(values, dtype=np.float64)
    return np.append(given, given[-1])


def scaled(values: F64, unit: str, thousands: str) -> tuple[F64, str]:
    """Values with their unit, or in thousands if one of them is as large."""
    return (values / 1e3, thousands) if values.max() >= 1e3 else (values, unit)


def colour_range(values: F64) -> tuple[float, float]:
    """Range of the values, widened so that differences of a few tenths look small."""
    middle = (values.min() + values.max()) / 2
    half = max((values.max() - values.min()) / 2, MIN_COLOUR_RANGE_K / 2)
    return float(middle - half), float(middle + half)


def is_turned(plan: FloorPlan) -> bool:
    """Whether y runs to the right on the page, where the longer side of the room lies."""
    return plan.width_m > plan.length_m


def on_page(plan: FloorPlan, xy: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Coordinates on the page of those in the room, (..., 2)."""
    return xy[..., ::-1] if is_turned(plan) else xy


def rack_boxes(plan: FloorPlan, pitch_m: float, depth_m: float) -> F64:
    """Corners of the racks on the page, (R, 4, 2)."""
    half = np.array([pitch_m / 2, depth_m / 2])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return on_page(plan, plan.centre_m[:, None] + corners * half)


def _check_result(result: StepResult, fleet: Fleet, dc: int) -> None:
    if not 0 <= dc < fleet.size:
        raise SdcError(f"data center {dc}: valid is 0..{fleet.size - 1}")
    if len(result.rack_inlet_c) != fleet.racks:
        raise SdcError(
            f"result of {len(result.rack_inlet_c)} racks, expected {fleet.racks} as in the fleet"
        )


def step_time(result: StepResult, fleet: Fleet, dc: int) -> np.datetime64:
    """Start of a step on the clock of a data center, as in steps.parquet."""
    day = day_of_year(fleet.configs[dc].site.start)
    start = np.array([day * 24 * fleet.steps_per_hour])
    found = step_times(start, np.array([result.step]), fleet.steps_per_hour)
    return np.datetime64(found[0, 0], "s")


def _clock(result: StepResult, fleet: Fleet, dc: int) -> str:
    when: datetime = step_time(result, fleet, dc).astype(datetime)
    return f"{when.day} {when:%B %H:%M}"


def _draw_hall(axes: Axes, what: str, result: StepResult, fleet: Fleet, dc: int) -> None:
    from matplotlib.ticker import MaxNLocator

    hall = fleet.configs[dc].hall
    every: Reals = result.rack_inlet_c if what == "inlet" else result.rack_outlet_c
    grid = np.asarray(every[slice(*fleet.rack_offsets[dc : dc + 2])], dtype=np.float64)
    grid = grid.reshape(hall.rows, hall.racks_per_row)
    low, high = colour_range(grid)
    image = rack_grid(axes, grid, "inferno", (low, high))
    if grid.size <= LABELLED_RACKS:
        for (row, rack), value in np.ndenumerate(grid):
            ink = "black" if value > (low + high) / 2 else "white"
            axes.text(rack + 0.5, row + 0.5, f"{value:.1f}", color=ink, ha="center", va="center")
    hottest = outline_hottest(axes, grid)
    title = f"Rack {what}: hottest {grid.max():.1f} °C, {hottest}"
    axes.set_title(title, fontsize=10, loc="left")
    ticks = MaxNLocator(6, steps=[1, 2, 5, 10])
    axes.figure.colorbar(image, ax=axes, label=f"{what} (°C)", ticks=ticks)


def rack_grid(axes: Axes, grid: F64, cmap: str, limits: tuple[float, float]) -> QuadMesh:
    """Racks as a grid, row 0 on top, racks of a row to the right, (rows, racks per row)."""
    image = axes.pcolormesh(
        grid,
        cmap=cmap,
        vmin=limits[0],
        vmax=limits[1],
        edgecolors="white" if grid.size <= LABELLED_RACKS else "none",
        linewidth=1.5,
    )
    axes.invert_yaxis()
    for axis, count in zip((axes.yaxis, axes.xaxis), grid.shape, strict=True):
        shown = np.arange(0, count, max(1, count // 10))
        axis.set_ticks(shown + 0.5, [str(i) for i in shown])
        axis.set_tick_params(length=0)
    axes.set(xlabel="rack in row", ylabel="row")
    axes.spines[:].set_visible(False)
    return image


def outline_hottest(axes: Axes, grid: F64) -> str:
    """Outline the hottest racks of a small hall, ring the first in a large one; where it is."""
    from matplotlib.patches import Rectangle

    hottest = np.argwhere(grid >= grid.max() - TIE_K)
    row, rack = np.unravel_index(grid.argmax(), grid.shape)
    where = f"row {row} rack {rack}" + (f" and {len(hottest) - 1} more" * (len(hottest) > 1))
    if len(hottest) == grid.size > 1:
        where = "all racks alike"
    elif grid.size <= LABELLED_RACKS:
        for y, x in hottest + 0.04:
            axes.add_patch(Rectangle((x, y), 0.92, 0.92, fill=False, color=SKY, linewidth=2.5))
    else:
        axes.plot(rack + 0.5, row + 0.5, "o", color=SKY, markersize=12, mfc="none", mew=2.5)
    return where


def draw_steps(axes: Axes, steps: pd.DataFrame, values: npt.ArrayLike, **style: Any) -> None:
    """A line of what held during each step."""
    style = {"linewidth": 1.4} | style
    axes.plot(step_edges(steps), closed(values), drawstyle="steps-post", **style)


def draw_temperatures(axes: Axes, steps: pd.DataFrame) -> None:
    """Weather and setpoint."""
    for name, colour, label in (
        ("outdoor_c", RED, "outdoor"),
        ("wet_bulb_c", SKY, "wet bulb"),
        ("setpoint_c", "black", "setpoint"),
    ):
        draw_steps(axes, steps, steps[name], color=colour, linewidth=1.2, label=label)
    axes.set_ylabel("temperature (°C)")
    finish(axes)


def draw_power(axes: Axes, steps: pd.DataFrame) -> None:
    """Power by device, stacked."""
    powers = [steps[column] / 1e3 for column in POWERS]
    axes.stackplot(
        step_edges(steps),
        [closed(power) for power in powers],
        labels=[name for name, _ in POWERS.values()],
        colors=[colour for _, colour in POWERS.values()],
        linewidth=0,
        step="post",
    )
    counted = (steps["it_w"] + steps["hvac_w"]) / 1e3
    # Presets may leave devices out of the HVAC total.
    if not np.allclose(counted, sum(powers), rtol=1e-6):
        draw_steps(axes, steps, counted, color="black", linewidth=1.2, label="counted in total")
    axes.set_ylabel("power (kW)")
    axes.set_ylim(bottom=0)
    finish(axes)


def draw_carbon(axes: Axes, steps: pd.DataFrame) -> None:
    """Carbon intensity, and what was emitted."""
    emitted = axes.twinx()
    kg_per_h = steps["carbon_g"] / 1e3 / step_hours(steps)
    emitted.fill_between(step_edges(steps), closed(kg_per_h), color=GREY, alpha=0.35,
                         linewidth=0, step="post")  # fmt: skip
    emitted.set_ylabel("emitted (kg CO₂e/h)", color=GREY)
    emitted.set_ylim(bottom=0)
    draw_steps(axes, steps, steps["ci_g_per_kwh"], color=RED)
    axes.set_ylabel("carbon intensity\n(g CO₂e/kWh)", color=RED)
    _put_in_front(axes, emitted)


def draw_storage(axes: Axes, steps: pd.DataFrame) -> None:
    """Queue and battery, at the ends of the steps, for which they stand."""
    ends = step_edges(steps)[1:]
    charge = axes.twinx()
    charge.fill_between(ends, 100 * steps["soc"], color=GREEN, alpha=0.3, linewidth=0)
    charge.set_ylabel("battery charge (%)", color=GREEN)
    charge.set_ylim(0, 100)
    axes.plot(ends, steps["queue_tasks"], color=PINK, linewidth=1.4)
    axes.set_ylabel("queue (tasks)", color=PINK)
    axes.set_ylim(0, 1.05 * max(1.0, steps["queue_tasks"].max()))
    _put_in_front(axes, charge)


def _put_in_front(axes: Axes, behind: Axes) -> None:
    axes.set_zorder(behind.get_zorder() + 1)
    axes.patch.set_visible(False)
    behind.spines[:].set_visible(False)
    clean(axes)


def clean(axes: Axes) -> None:
    """Grid instead of a frame; the curves run from edge to edge."""
    axes.margins(x=0)
    axes.spines[:].set_visible(False)
    axes.grid(alpha=0.25)


def finish(axes: Axes) -> None:
    """``clean``, with a legend above."""
    clean(axes)
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=7,
        fontsize=9,
        frameon=False,
        borderaxespad=0.2,
        columnspacing=1.2,
        handlelength=1.2,
    )


def format_time(axes: Axes) -> None:
    """Days and hours without the year, which is a placeholder."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    # With fewer or more at least, it finds no interval for 4 to 5 days, and warns.
    locator = AutoDateLocator(minticks=4, maxticks=9)  # type: ignore[no-untyped-call]
    formats = ["%b", "%b", "%d %b", "%H:%M", "%H:%M", "%H:%M:%S"]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(
        ConciseDateFormatter(  # type: ignore[no-untyped-call]
            locator,
            formats=formats,
            zero_formats=["%b", "%b", "%d %b", "%d %b", "%H:%M", "%H:%M"],
            show_offset=False,
        )
    )
    axes.set_xlabel("local standard time")
