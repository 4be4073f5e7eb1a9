"""Animated WebP of a hall's rack temperatures.

Every pixel of the picture belongs to one rack, so a frame is two look-ups: rack temperatures to
colours, pixels to racks. Colour bar and labels are drawn once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, StepResult

from .figures import step_time
from .plotting import colour_range, short_name

if TYPE_CHECKING:
    from PIL import Image as PillowImage

MAP_WIDTH_PX = 600
"""Width that racks are enlarged to, in pixels; racks of longer rows are a pixel each."""
MAX_SIDE_PX = 16_383
"""Longest side of a picture that WebP stores, in pixels."""
_MARGIN_PX, _TITLE_PX, _BAR_PX, _LABEL_PX = 12, 34, 14, 22
_FONT_PX = 15
_LEVELS = 256


def write_animation(
    path: str | Path,
    results: Iterable[StepResult],
    fleet: Fleet,
    dc: int = 0,
    *,
    what: Literal["inlet", "outlet"] = "inlet",
    limits_c: tuple[float, float] | None = None,
    frame_ms: int = 100,
) -> None:
    """Write an animation of the racks of one hall, with time, hottest rack and colour bar.

    Args:
        path: the file, named ``.webp``; one that exists is replaced.
        results: the steps to show, in order; only the racks' temperatures are kept in memory.
        fleet: the fleet they belong to.
        dc: index of the data center.
        what: whether inlet or outlet temperatures are shown.
        limits_c: ends of the colour bar, in C, beyond which colours stay; None is the range of all
            frames.
        frame_ms: time that a frame is shown, in ms.

    Raises:
        SdcError: Pillow or matplotlib is missing, the path does not end in ``.webp`` or cannot be
            written, there are no steps, they do not fit the fleet, or the hall is too large.
    """
    target = Path(path)
    _check_arguments(target, fleet, dc, what, limits_c, frame_ms)
    from PIL import Image, ImageDraw

    values, times = _temperatures(results, fleet, dc, what)
    low, high = colour_range(values) if limits_c is None else limits_c
    levels = np.clip((values - low) * ((_LEVELS - 1) / (high - low)) + 0.5, 0, _LEVELS - 1)
    hall = fleet.configs[dc].hall
    rack_of_pixel = _rack_of_pixel(hall.rows, hall.racks_per_row)
    palette = _palette()
    font = _font()
    canvas, corner = _canvas(rack_of_pixel, palette, (low, high), what, font)
    picture: Any = canvas.copy()

    def draw_frame(frame: int) -> None:
        rack, when = int(rank(values[frame]).argmax()), times[frame]
        row, column = divmod(rack, hall.racks_per_row)
        text = (
            f"{short_name(fleet.names[dc])}: {when.day} {when:%b %H:%M}, hottest "
            f"{values[frame, rack]:.1f} °C, row {row} rack {column}"
        )
        colours = np.append(palette[levels[frame].astype(np.uint8)], [[255, 255, 255]], axis=0)
        picture.paste(canvas)
        picture.paste(Image.fromarray(colours.astype(np.uint8)[rack_of_pixel]), corner)
        ImageDraw.Draw(picture).text((_MARGIN_PX, 8), text, fill="black", font=font)

    # Pillow asks a picture of several frames for one after the other, so one is in memory.
    picture.n_frames, picture.seek = len(times), draw_frame
    draw_frame(0)
    with atomic_write(target) as file:
        picture.save(
            file,
            "WEBP",
            save_all=True,
            duration=frame_ms,
            loop=0,
            lossless=True,
            quality=0,
            method=3,
        )


def _check_arguments(
    path: Path,
    fleet: Fleet,
    dc: int,
    what: str,
    limits_c: Sequence[float] | None,
    frame_ms: int,
) -> None:
    """Refuse arguments that are not valid, before any step is computed."""
    try:
        import matplotlib  # noqa: F401
        import PIL  # noqa: F401
    except ImportError as error:
        raise SdcError(
            f"animations need matplotlib and Pillow ({error}); install them with: "
            'pip install "sdc-taichi[plot]"'
        ) from None
    if path.suffix.lower() != ".webp":
        raise SdcError(f"{path}: valid is a name that ends in .webp")
    if not 0 <= dc < fleet.size:
        raise SdcError(f"data center {dc}: valid is 0..{fleet.size - 1}")
    if what not in ("inlet", "outlet"):
        raise SdcError(f"what {what!r}: valid is inlet or outlet")
    if limits_c is not None and not -np.inf < limits_c[0] < limits_c[1] < np.inf:
        raise SdcError(f"limits_c {limits_c}: valid are two temperatures, the lower one first")
    if frame_ms < 1:
        raise SdcError(f"frame_ms {frame_ms}: valid is 1 or more")


def _temperatures(
    results: Iterable[StepResult], fleet: Fleet, dc: int, what: str
) -> tuple[F64, list[datetime]]:
    """Temperatures of the hall's racks in every step, in C, (n, R), and the times of the steps."""
    racks = slice(*fleet.rack_offsets[dc : dc + 2])
    rows, times = [], []
    for result in results:
        values = result.rack_inlet_c if what == "inlet" else result.rack_outlet_c
        if len(values) != fleet.racks:
            raise SdcError(f"result of {len(values)} racks, expected {fleet.racks} as in the fleet")
        rows.append(np.array(values[racks], dtype=np.float32))
        times.append(step_time(result, fleet, dc).astype(datetime))
    if not rows:
        raise SdcError("no steps to show; valid is one or more")
    return np.stack(rows).astype(np.float64), times


def _rack_of_pixel(rows: int, per_row: int) -> npt.NDArray[np.int64]:
    """Rack of every pixel, row 0 on top; pixels of gaps have the number of racks."""
    wide = max(1, MAP_WIDTH_PX // per_row)
    high = max(1, min(wide, MAP_WIDTH_PX // rows))
    if high < wide // 3:
        wide = 3 * high
    width, height = per_row * wide, rows * high
    if max(width + 2 * _MARGIN_PX, height + _TITLE_PX + _BAR_PX + _LABEL_PX) > MAX_SIDE_PX:
        raise SdcError(
            f"{rows} rows of {per_row} racks: too large for WebP, which holds {MAX_SIDE_PX} "
            "pixels a side"
        )
    index = np.arange(rows * per_row).reshape(rows, per_row)
    index = np.repeat(np.repeat(index, high, axis=0), wide, axis=1)
    if min(wide, high) >= 8:
        index[high - 1 :: high] = rows * per_row
        index[:, wide - 1 :: wide] = rows * per_row
    return index


def _palette() -> npt.NDArray[np.float64]:
    """Colours of the map, (256, 3), 0..255."""
    from matplotlib import colormaps

    return np.round(255.0 * colormaps["inferno"](np.arange(_LEVELS))[:, :3])


def _font() -> Any:
    """The font that matplotlib ships, which has the degree sign on every machine."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(
        str(Path(get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), _FONT_PX
    )


def _canvas(
    rack_of_pixel: npt.NDArray[np.int64],
    palette: F64,
    limits_c: tuple[float, float],
    what: str,
    font: Any,
) -> tuple[PillowImage.Image, tuple[int, int]]:
    """The picture without racks and title, and the corner where the racks go, in pixels."""
    from PIL import Image, ImageDraw

    height, width = rack_of_pixel.shape
    wide = max(width, MAP_WIDTH_PX)
    size = (wide + 2 * _MARGIN_PX, height + _TITLE_PX + _BAR_PX + _LABEL_PX + _MARGIN_PX)
    picture = Image.new("RGB", size, "white")
    bar = palette[np.arange(wide) * _LEVELS // wide].astype(np.uint8)
    top = _TITLE_PX + height + _MARGIN_PX // 2
    strip = np.repeat(bar[None], _BAR_PX - 2, axis=0)
    picture.paste(Image.fromarray(strip), (_MARGIN_PX, top))
    draw = ImageDraw.Draw(picture)
    low, high = limits_c
    for share, anchor in ((0.0, "la"), (0.5, "ma"), (1.0, "ra")):
        text = f"{low + share * (high - low):.1f} °C"
        if share == 0.5:
            text = f"rack {what}, {text}"
        draw.text((_MARGIN_PX + share * wide, top + _BAR_PX), text, fill="black", font=font,
                  anchor=anchor)  # fmt: skip
    return picture, (_MARGIN_PX + (wide - width) // 2, _TITLE_PX)
