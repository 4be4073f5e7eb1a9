"""Shared parts of all pictures: colours, figures, axes and texts.

The package does not use pyplot, so it opens no window and changes no global state. Readers with
colour vision deficiency can distinguish the colours, which are those of Okabe and Ito (2008),
"Color Universal Design", and the colour maps inferno, viridis and cividis.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import SdcError, printable
from sdc_taichi.hall.air_metrics import TIE_K
from sdc_taichi.types import F64

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from PIL.Image import Image

DPI = 100
"""Default resolution of pictures, in pixels per inch."""
MAX_LABELLED_RACKS = 60
"""Largest number of racks of a hall whose racks show their values as numbers."""
MIN_COLOUR_RANGE_K = 2.0
"""Smallest range of a colour bar of temperatures, in K; it keeps tenths of a kelvin faint."""
MAX_NAME_LENGTH = 50
"""Largest number of characters of a name in a picture."""

ON_COLOUR = "on colour"
"""``gid`` of texts and marks on coloured cells, whose colours do not depend on the page."""
_LIGHT_INK, _DARK_PAPER = 0.92, 0.09
"""Greys that replace black and white on a dark page, 0..1; the paper is that of ``report.html``."""
_LARGEST_TINT = 0.02
"""Largest difference between the red, green and blue of a colour that counts as grey."""

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PINK, SKY, GREY = "#CC79A7", "#56B4E9", "#777777"
LINE_COLOURS = (BLUE, ORANGE, GREEN, RED, PINK, SKY, "black", "#B8A800")
"""Colours of the lines of a plot in their order of use; the yellow is darkened for white paper."""
LINE_STYLES = ("-", "--", ":", "-.")
"""Dash styles; ``line_style`` takes the next one each time all colours have been used."""
DAY = np.timedelta64(1, "D")
"""Length of a day."""


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure with the resolution ``DPI``.

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


def drawn(figure: Figure, dpi: int = DPI) -> Image:
    """Draw a figure as an image.

    Args:
        figure: the figure.
        dpi: resolution, in pixels per inch.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL.Image import fromarray

    figure.set_dpi(dpi)
    canvas: Any = FigureCanvasAgg(figure)
    with _without_glyph_warnings():
        canvas.draw()
    return fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def webp(image: Image, colours: int | None = None, quality: int = 60) -> bytes:
    """Encode an image as WebP.

    Args:
        image: the image.
        colours: None for a lossless image, which has two thirds of the size of a PNG. A number, up
            to 256, reduces the image to so many colours, or encodes it with losses if this takes
            less space.
        quality: quality of the encoding with losses, 0..100.
    """
    from PIL.Image import Dither, Quantize

    encodings = [io.BytesIO()]
    if colours is None:
        image.save(encodings[0], "WEBP", lossless=True, method=2, quality=0)
    else:
        encodings.append(io.BytesIO())
        image.save(encodings[1], "WEBP", quality=quality, method=4)
        # Rare colours, such as those of the hottest racks, keep a place among few colours.
        method = Quantize.MEDIANCUT if colours == 256 else Quantize.MAXCOVERAGE
        reduced = image.quantize(colours, method, dither=Dither.NONE).convert("RGB")
        reduced.save(encodings[0], "WEBP", lossless=True, method=4, quality=60)
    return min((each.getvalue() for each in encodings), key=len)


def darken(figure: Figure) -> None:
    """Exchange the ink and paper of a figure for those of a dark page, in place.

    Greys from black to white become greys from light to dark; other colours, and artists with the
    ``gid`` ``ON_COLOUR``, keep theirs. The layout is not computed again.
    """
    figure.set_layout_engine("none")
    for artist in figure.findobj():
        # Figures and axes give the colours of their patches, which are artists too.
        if artist.get_gid() == ON_COLOUR or hasattr(artist, "patch"):
            continue
        for name in ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor"):
            colour = getattr(artist, f"get_{name}", lambda: None)()
            if isinstance(colour, str | tuple):
                getattr(artist, f"set_{name}")(_on_dark(colour))
            elif isinstance(colour, np.ndarray) and colour.shape == (1, 4):
                getattr(artist, f"set_{name}")(_on_dark(tuple(colour[0])))


def _on_dark(colour: Any) -> Any:
    """Return the counterpart of a grey on dark paper; other colours are returned unchanged."""
    from matplotlib.colors import to_rgba

    try:
        *rgb, alpha = to_rgba(colour)
    except ValueError:  # a word such as "none", "auto" or "face"
        return colour
    if max(rgb) - min(rgb) > _LARGEST_TINT:
        return colour
    grey = _LIGHT_INK + (_DARK_PAPER - _LIGHT_INK) * rgb[0]
    return (grey, grey, grey, alpha)


def save_picture(figure: Figure, path: Path, *, parents: bool = False) -> None:
    """Write a figure to a file atomically; after an error no partial file remains.

    Args:
        figure: the figure.
        path: path of the file, whose suffix is the format, such as ``.png``.
        parents: True to create missing parent folders.

    Raises:
        SdcError: the file cannot be written.
    """
    with atomic_write(path, parents=parents) as file, _without_glyph_warnings():
        figure.savefig(file, format=path.suffix.lstrip(".").lower())


@contextlib.contextmanager
def _without_glyph_warnings() -> Iterator[None]:
    """Suppress matplotlib's warnings about characters that the font lacks; they show as boxes."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph ")
        yield


def add_title(figure: Figure, text: str) -> None:
    """Add a left-aligned title above a figure, without math mode; an empty title adds nothing."""
    if text:
        figure.suptitle(text.replace("$", r"\$"), x=0.01, ha="left")


def short_name(name: str) -> str:
    """Return a name on one line, cut to ``MAX_NAME_LENGTH`` characters."""
    line = printable(" ".join(name.split()))
    return line if len(line) <= MAX_NAME_LENGTH else line[: MAX_NAME_LENGTH - 1] + "…"


def literal_text(name: str) -> str:
    """Return a shortened name that matplotlib prints unchanged.

    matplotlib otherwise reads text between dollar signs as a formula, and hides legend entries
    that begin with "_".
    """
    line = short_name(name)
    return (" " if line.startswith("_") else "") + line.replace("$", r"\$")


def format_number(value: float) -> str:
    """Return a number with four significant digits, or from 1000 on as an integer with commas."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:z.4g}"


def date_text(moment: datetime, *, over_a_year: bool) -> str:
    """Return day and month of a time, such as ``1 July``.

    Args:
        moment: the time.
        over_a_year: True if the run is longer than a year; the text then includes the year.
    """
    year = f" {moment.year}" if over_a_year else ""
    return f"{moment.day} {moment:%B}{year}"


def with_local_time(steps: pd.DataFrame) -> pd.DataFrame:
    """Return steps whose column ``time`` is local standard time without a UTC offset.

    Args:
        steps: steps of one data center. A column ``utc_offset_h`` gives its local standard time
            minus UTC, in h, if ``time`` is in UTC because its table has data centers of different
            offsets.
    """
    times = steps["time"]
    if times.dt.tz is None:
        return steps
    if "utc_offset_h" in steps.columns:
        offset = (60 * steps["utc_offset_h"]).round().astype("timedelta64[m]")
        return steps.assign(time=times.dt.tz_convert(None) + offset)
    return steps.assign(time=times.dt.tz_localize(None))


def check_steps(steps: pd.DataFrame, columns: Iterable[str]) -> pd.DataFrame:
    """Check that a DataFrame contains the steps of one data center; return it in local time.

    Raises:
        SdcError: a column is missing, there are fewer than two rows, or the times do not increase.
    """
    missing = [name for name in columns if name not in steps.columns]
    if missing:
        raise SdcError(f"steps: missing columns {', '.join(missing)}")
    steps = with_local_time(steps)
    times = steps["time"].to_numpy()
    if len(times) < 2 or not np.all(times[1:] > times[:-1]):
        raise SdcError(
            f"steps: {len(times)} rows; valid are two or more with increasing time, "
            "of one data center"
        )
    return steps


def is_over_a_year(steps: pd.DataFrame) -> bool:
    """Return True if a run is longer than a year, so that a calendar day can occur twice."""
    return bool(steps["time"].iloc[-1] - steps["time"].iloc[0] >= 365 * DAY)


def rows_of_day(steps: pd.DataFrame, date: str) -> tuple[int, int]:
    """Return the index of the first row of a day, and of the first row after that day.

    Args:
        steps: steps of the data center.
        date: ``MM-DD`` for the first such day of the run, or ``YYYY-MM-DD`` with the year that
            the column ``time`` has on that day.

    Raises:
        SdcError: the run does not contain the day.
    """
    days, first = np.unique(steps["time"].to_numpy().astype("datetime64[D]"), return_index=True)
    names = [str(each) for each in days]
    days_of_date = [i for i, name in enumerate(names) if date in (name, name[-5:])]
    if not days_of_date:
        raise SdcError(
            f"date {date!r}: valid is MM-DD of a day of the run, "
            f"{names[0][-5:]} to {names[-1][-5:]} ({len(days)} days)"
        )
    rows = [*map(int, first), len(steps)]
    first_day = days_of_date[0]
    return rows[first_day], rows[first_day + 1]


def step_edges(steps: pd.DataFrame) -> npt.NDArray[np.datetime64]:
    """Return the begin of each of n >= 2 steps and the end of the last one, (n + 1,)."""
    times: npt.NDArray[np.datetime64] = steps["time"].to_numpy()
    # The length of a step is the smallest difference, because the clock skips 29 February.
    return np.append(times, times[-1] + np.diff(times).min())


def step_hours(steps: pd.DataFrame) -> float:
    """Return the length of a step, in h."""
    return float(np.diff(steps["time"].to_numpy()).min() / np.timedelta64(1, "h"))


def repeat_last(values: npt.ArrayLike) -> F64:
    """Return the values of n steps with the last one repeated, (n + 1,).

    The repeated value lets a step plot extend to the end of the last step.
    """
    array = np.asarray(values, dtype=np.float64)
    return np.append(array, array[-1])


def scale_thousands(values: F64, unit: str, thousands: str) -> tuple[F64, str]:
    """Return values and their unit, divided by 1000 if the largest value reaches 1000.

    Args:
        values: the values.
        unit: unit of the values, such as ``kWh``.
        thousands: unit of a thousand, such as ``MWh``.
    """
    return (values / 1e3, thousands) if values.max() >= 1e3 else (values, unit)


def colour_range(values: F64) -> tuple[float, float]:
    """Return the ends of a colour map for temperatures, at least ``MIN_COLOUR_RANGE_K`` apart."""
    middle = (values.min() + values.max()) / 2
    half = max((values.max() - values.min()) / 2, MIN_COLOUR_RANGE_K / 2)
    return float(middle - half), float(middle + half)


def line_style(index: int) -> dict[str, Any]:
    """Return colour and dash style of a line; they differ for the first 32 indices."""
    colours = len(LINE_COLOURS)
    dashes = LINE_STYLES[index // colours % len(LINE_STYLES)]
    return {"color": LINE_COLOURS[index % colours], "linestyle": dashes}


def draw_steps(axes: Axes, steps: pd.DataFrame, values: npt.ArrayLike, **style: Any) -> None:
    """Draw values as a line that is constant during each step.

    Args:
        axes: axes to draw in.
        steps: steps of one data center.
        values: one value per step.
        style: matplotlib properties of the line.
    """
    style = {"linewidth": 1.4} | style
    axes.plot(step_edges(steps), repeat_last(values), drawstyle="steps-post", **style)


def draw_rack_grid(
    axes: Axes, grid: F64, cmap: str | Colormap, limits: tuple[float, float]
) -> QuadMesh:
    """Draw one coloured cell per rack, with row 0 on top and the racks of a row to the right.

    Args:
        axes: axes to draw in.
        grid: value of each rack, (rows, racks per row).
        cmap: colour map, or its name.
        limits: values at the ends of the colour map.
    """
    image = axes.pcolormesh(
        grid,
        cmap=cmap,
        vmin=limits[0],
        vmax=limits[1],
        edgecolors="white" if grid.size <= MAX_LABELLED_RACKS else "none",
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


def outline_hottest(axes: Axes, grid: F64, outlined: bool | None = None) -> str:
    """Outline the hottest racks of a small hall, or circle the first of them in a large hall.

    Nothing is marked if all racks are equally hot.

    Args:
        axes: axes in which ``draw_rack_grid`` drew the racks.
        grid: temperature of each rack, in C, (rows, racks per row).
        outlined: True to outline, False to circle; None outlines in halls of at most
            ``MAX_LABELLED_RACKS`` racks.

    Returns:
        Row and rack of the hottest rack, as text.
    """
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke

    hottest = np.argwhere(grid >= grid.max() - TIE_K)
    row, rack = np.unravel_index(grid.argmax(), grid.shape)
    place = f"row {row} rack {rack}" + (f" and {len(hottest) - 1} more" * (len(hottest) > 1))
    if len(hottest) == np.ma.count(grid) > 1:  # racks without a value are masked
        place = "all racks alike"
    elif grid.size <= MAX_LABELLED_RACKS if outlined is None else outlined:
        for y, x in hottest + 0.04:
            mark = Rectangle((x, y), 0.92, 0.92, fill=False, color="black", linewidth=1.6)
            mark.set_path_effects([withStroke(linewidth=4.0, foreground="white")])
            mark.set_gid(ON_COLOUR)
            axes.add_patch(mark)
    else:
        axes.plot(rack + 0.5, row + 0.5, "o", color=SKY, markersize=12, mfc="none", mew=2.5)
    return place


def remove_frame(axes: Axes) -> None:
    """Replace the frame of axes by a grid."""
    axes.spines[:].set_visible(False)
    axes.grid(alpha=0.25)


def style_axes(axes: Axes) -> None:
    """Replace the frame of axes by a grid, and remove the horizontal margins beside the curves."""
    axes.margins(x=0)
    remove_frame(axes)


def style_axes_with_legend(axes: Axes) -> None:
    """Replace the frame of axes by a grid, and add a legend above the axes."""
    style_axes(axes)
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


def format_time_axis(axes: Axes) -> None:
    """Label a time axis with days and hours, without the year."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    # With another minimum number of ticks the locator warns that it finds no interval for runs of
    # 4 to 5 days.
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


def format_day_axis(axes: Axes, steps: pd.DataFrame, *, over_a_year: bool) -> None:
    """Set the time axis to the day of the steps, and put the date into its label.

    Args:
        axes: axes whose x axis is the time.
        steps: steps of one day.
        over_a_year: True if the run is longer than a year.
    """
    from matplotlib.dates import DateFormatter, HourLocator

    axes.xaxis.set_major_locator(HourLocator(range(0, 24, 3)))  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_formatter(DateFormatter("%H:%M"))  # type: ignore[no-untyped-call]
    begin = steps["time"].iloc[0].normalize()
    axes.set_xlim(begin, begin + DAY)
    axes.set_xlabel(f"local standard time on {date_text(begin, over_a_year=over_a_year)}")
