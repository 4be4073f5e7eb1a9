"""Colours of the maps of a recording: ranges, palettes, and classes of values.

A map holds a class for each pixel, which the viewer shows in the colour of the class and names by
its label. Class 0 has no value and no colour; the others are values in equal steps.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.number_text import parse_number
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, Reals

if TYPE_CHECKING:
    import rerun as rr

Classes = npt.NDArray[np.uint8]
"""Classes of values."""
InletRange = tuple[float, float] | str | None
"""Ends of the colours of inlets, in C; ``SAME_RANGE``; or None for the range that a hall uses."""

SAME_RANGE = "same"
"""Name of the ranges ``SAME_RANGES_C``, with which recordings of different halls compare."""
SAME_RANGES_C = {"inlet": (10.0, 45.0), "outlet": (10.0, 60.0)}
"""Ranges of the temperatures of all recordings with ``SAME_RANGE``, in C."""
VALID_RANGE_C = (-50.0, 100.0)
"""Lowest and highest valid end of a range of inlets, in C."""
MAX_CLASSES = 254
"""Largest number of classes with a value, so that classes with class 0 fit into a byte."""
JUNCTION_RANGE_K = 45.0
"""Range of the colours of junctions below the temperature at which GPUs throttle, in K."""
RANGE_CLASSES = 200
"""Largest number of classes within the range of the colours; the others are beyond its ends."""

# Palettes. People with colour vision deficiency can distinguish blues from yellows and reds.
# Lightness changes steadily within a band and jumps at the limits between bands.
TOO_COLD = "#4a2a6b", "#9a86bf"
RECOMMENDED = "#0b2a6f", "#2468b4", "#4fb3c8", "#e3f6d5"
ALLOWABLE = "#ffd84a", "#f48a1d", "#a50f15"
TOO_HOT = "#ff2fd6", "#ffd0f6"
INFERNO = "#160b39", "#57106e", "#a52c60", "#dd513a", "#fb9b06", "#fcffa4"
VIRIDIS = "#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"
DIVERGING = "#053061", "#2f79b5", "#a7cfe4", "#f2f2f2", "#f6b799", "#ca4842", "#67001f"


class Band(NamedTuple):
    """Part of a colour scale, with colours at equal distances from its lower to its upper end."""

    low: float
    """Value at the lower end."""
    high: float
    """Value at the upper end."""
    colours: Sequence[str]
    """Colours as #RRGGBB."""


class ColourScale(NamedTuple):
    """Range, classes and colours of the values of a map."""

    low: float
    """Value at the lower end of the colours; smaller values are drawn in the colour of this end."""
    high: float
    """Value at the upper end of the colours; larger values are drawn in the colour of this end."""
    unit: str
    """Unit of the values: C, K or kW."""
    bands: tuple[Band, ...]
    """Parts of the range, from low to high, with a sharp edge between two parts."""
    resolution: float
    """Step between two classes, to which values are rounded."""
    first: float
    """Value of class 1. Values below count as this value."""
    marks: tuple[tuple[float, str], ...] = ()
    """Values with a name, such as limits, which the colour bar marks."""
    no_value: str = "no rack"
    """Name of class 0."""

    @property
    def digits(self) -> int:
        """Number of decimals that tell two classes apart."""
        return max(0, int(np.ceil(-np.log10(self.resolution) - 1e-9)))


def make_scale(
    low: float,
    high: float,
    unit: str,
    bands: Sequence[Band],
    *,
    beyond: bool = True,
    marks: Sequence[tuple[float, str]] = (),
) -> ColourScale:
    """Return a colour scale with as fine a resolution of 1, 2 or 5 times a power of ten as fits.

    Args:
        low: value at the lower end of the colours.
        high: value at the upper end of the colours.
        unit: unit of the values.
        bands: parts of the range, from low to high.
        beyond: True if there may be values below the range; they get a third of the classes that
            the range does not need.
        marks: values with a name.
    """
    span = high - low
    decade = 10.0 ** np.floor(np.log10(span / RANGE_CLASSES))
    resolution = float(
        next(n * decade for n in (1, 2, 5, 10) if n * decade * RANGE_CLASSES >= span * (1 - 1e-9))
    )
    spare = MAX_CLASSES - 1 - int(np.ceil(span / resolution - 1e-9))
    first = low - resolution * (spare // 3 if beyond else 0)
    inside = tuple((value, name) for value, name in marks if low <= value <= high)
    return ColourScale(low, high, unit, tuple(bands), resolution, first, inside)


def classes_of(values: Reals, scale: ColourScale) -> Classes:
    """Return the classes of values, of the same shape; values that are not finite have class 0."""
    steps = np.rint((values - np.float32(scale.first)) * np.float32(1.0 / scale.resolution))
    with np.errstate(invalid="ignore"):
        classes = np.clip(steps + 1, 1, MAX_CLASSES).astype(np.uint8)
    return np.where(np.isfinite(values), classes, np.uint8(0))


def values_of(scale: ColourScale) -> F64:
    """Return the values of all classes but class 0, in order, (``MAX_CLASSES``,)."""
    return np.asarray(scale.first + scale.resolution * np.arange(MAX_CLASSES), np.float64)


def labels(scale: ColourScale) -> list[str]:
    """Return the names of all classes but class 0, such as ``23.4 C``."""
    names = [f"{value:.{scale.digits}f} {scale.unit}" for value in values_of(scale) + 0.0]
    return [f"{names[0]} or less", *names[1:-1], f"{names[-1]} or more"]


def colours_of(scale: ColourScale) -> npt.NDArray[np.uint32]:
    """Return the colour of every class as 0xRRGGBBAA, (``MAX_CLASSES`` + 1,)."""
    values = np.clip(values_of(scale), scale.low, scale.high)
    rgb = np.zeros((MAX_CLASSES, 3))
    for index, band in enumerate(scale.bands):
        # A value on the edge of two bands belongs to the lower band: a limit is not exceeded yet.
        inside = values > band.low + 1e-6 if index else np.full(MAX_CLASSES, True)
        knots = np.linspace(band.low, band.high, len(band.colours))
        table = np.array([_rgb(colour) for colour in band.colours])
        for channel in range(3):
            rgb[inside, channel] = np.interp(values[inside], knots, table[:, channel])
    red, green, blue = np.rint(rgb).astype(np.uint32).T
    opaque = red << 24 | green << 16 | blue << 8 | 0xFF
    return np.concatenate([np.zeros(1, np.uint32), opaque])


@functools.lru_cache(maxsize=32)
def annotation_context(scale: ColourScale) -> rr.AnnotationContext:
    """Return Rerun's description of the colours and names of the classes of a scale."""
    return named_classes([scale.no_value, *labels(scale)], colours_of(scale).tolist())


def invisible_names(names: Sequence[str]) -> rr.AnnotationContext:
    """Return Rerun's description of classes from 1 that have a name but no colour."""
    return named_classes(names, [0] * len(names), first=1)


def named_classes(
    names: Sequence[str], colours: Sequence[int], first: int = 0
) -> rr.AnnotationContext:
    """Return Rerun's description of classes, from one Arrow array.

    From objects of Rerun, that of 10,000 classes would take half a second.

    Args:
        names: name of each class.
        colours: colour of each class, as 0xRRGGBBAA.
        first: number of the first class.
    """
    import pyarrow as pa
    import rerun as rr

    arrow_type = rr.components.AnnotationContextBatch([]).as_arrow_array().type
    id_field, class_field = arrow_type.value_type
    info_field, *keypoint_fields = class_field.type
    numbers = pa.array(np.arange(first, first + len(names)), id_field.type)
    columns = [numbers, pa.array(names), pa.array(np.asarray(colours, np.uint32))]
    info = pa.StructArray.from_arrays(columns, fields=list(info_field.type))
    no_keypoints = [pa.array([[]] * len(names), field.type) for field in keypoint_fields]
    described = pa.StructArray.from_arrays([info, *no_keypoints], fields=list(class_field.type))
    classes = pa.StructArray.from_arrays([numbers, described], fields=[id_field, class_field])
    context = pa.ListArray.from_arrays([0, len(names)], classes, type=arrow_type)
    return rr.AnnotationContext.from_fields(context=context)


def parse_inlet_range(text: str) -> InletRange:
    """Parse the range of inlets of a recording, ``LOW:HIGH`` in C or ``same``.

    Raises:
        ConfigError: the text is neither of them.
    """
    if text.strip() == SAME_RANGE:
        return SAME_RANGE
    low, _, high = text.partition(":")
    try:
        ends = parse_number(low), parse_number(high)
    except ValueError:
        raise ConfigError(
            f"--inlet-range {shortened(text)}: valid is LOW:HIGH in C, such as 18:32, or "
            f"{SAME_RANGE}"
        ) from None
    return check_inlet_range(ends, "--inlet-range")


def check_inlet_range(inlet_range: object, place: str = "inlet_range") -> InletRange:
    """Check and return the range of inlets of a recording.

    Args:
        inlet_range: the range.
        place: name of the option or argument, for errors.

    Raises:
        ConfigError: the range is not valid.
    """
    if inlet_range is None or inlet_range == SAME_RANGE:
        return SAME_RANGE if inlet_range is not None else None
    lowest, highest = VALID_RANGE_C
    try:
        low, high = (float(end) for end in inlet_range)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not lowest <= low < high <= highest or high - low < 1.0:
        text = f"{low:g}:{high:g}" if np.isfinite(low + high) else shortened(inlet_range)
        raise ConfigError(
            f"{place} {text}: valid is a lower end at least 1 K below the upper end, both within "
            f"{lowest:g} and {highest:g} C, or {SAME_RANGE!r}"
        )
    return low, high


def inlet_scale(
    inlet_range: InletRange, inlet_c: Reals, limits_c: tuple[float, float]
) -> ColourScale:
    """Return the colour scale of inlets, whose colours change at the limits of a server class.

    Without a given range the colours begin 1 K below the 5th percentile of the inlets, and end at
    the 99.9th percentile or the allowable limit, whichever is higher; both are rounded to whole
    degrees.

    Args:
        inlet_range: range that the user has chosen.
        inlet_c: inlets at the beginning of the run, in C, any shape.
        limits_c: highest allowable inlet of the class of this data center and of all data centers
            in the recording, in C.
    """
    allowable_c, highest_limit_c = limits_c
    if inlet_range is None:
        low_c, high_c = np.percentile(inlet_c, [5.0, 99.9])
        low, high = float(np.floor(low_c - 1.0)), float(np.ceil(max(high_c, highest_limit_c)))
        low = min(low, high - 1.0)
    else:
        low, high = SAME_RANGES_C["inlet"] if isinstance(inlet_range, str) else inlet_range
    edges = (-np.inf, *RECOMMENDED_C, allowable_c, np.inf)
    palettes = (TOO_COLD, RECOMMENDED, ALLOWABLE, TOO_HOT)
    bands = [
        Band(max(low, begin), min(high, end), palette)
        for begin, end, palette in zip(edges, edges[1:], palettes, strict=False)
        if max(low, begin) < min(high, end)
    ]
    marks = [
        (RECOMMENDED_C[0], "recommended from"),
        (RECOMMENDED_C[1], "recommended to"),
        (allowable_c, "allowable to"),
    ]
    return make_scale(low, high, "C", bands, marks=marks)


def outlet_scale(inlet_range: InletRange, outlet_c: Reals) -> ColourScale:
    """Return the colour scale of outlets, over the range at the beginning of the run.

    Args:
        inlet_range: range of inlets that the user has chosen; only ``SAME_RANGE`` matters.
        outlet_c: outlets at the beginning of the run, in C, any shape.
    """
    low, high = SAME_RANGES_C["outlet"]
    if inlet_range != SAME_RANGE:
        low_c, high_c = np.percentile(outlet_c, [5.0, 99.9])
        low, high = float(np.floor(low_c - 1.0)), float(np.ceil(high_c + 1.0))
    return make_scale(low, high, "C", [Band(low, high, INFERNO)])


def junction_scale(throttle_c: float, trip_c: float) -> ColourScale:
    """Return the colour scale of junctions, whose colours change where GPUs throttle, in C.

    Args:
        throttle_c: junction temperature at which GPUs throttle, in C.
        trip_c: junction temperature at which racks trip, in C.
    """
    low = throttle_c - JUNCTION_RANGE_K
    bands = [Band(low, throttle_c, RECOMMENDED), Band(throttle_c, trip_c, ALLOWABLE)]
    marks = [(throttle_c, "throttle"), (trip_c, "trip")]
    scale = make_scale(low, trip_c, "C", bands, marks=marks)
    return scale._replace(no_value="cooled by air")


def power_scale(fleet: Fleet) -> ColourScale:
    """Return the colour scale of rack power, in kW.

    The range begins at 0. Its upper end is 1.1 times the largest nameplate power of a rack (a
    tenth for fans), rounded up to 1, 2 or 5 times a power of ten.
    """
    nameplate_w = np.concatenate([count * full_w for count, full_w, *_ in fleet.group_rows])
    liquid_w = [r.design_it_w for config in fleet.configs for r in config.liquid_racks().values()]
    largest_w = max([float(fleet.group_sums(nameplate_w).max()), *liquid_w])
    largest_kw = largest_w * 1.1 / 1e3
    decade = 10.0 ** np.floor(np.log10(largest_kw))
    high = float(decade * next(n for n in (1, 2, 5, 10) if n * decade >= largest_kw * (1 - 1e-9)))
    return make_scale(0.0, high, "kW", [Band(0.0, high, VIRIDIS)], beyond=False)


def difference_scale(largest_k: float, resolution_k: float = 0.1) -> ColourScale:
    """Return a diverging colour scale of temperature differences, in K, with zero in its middle.

    The classes do not depend on the range of the colours, which may thus change afterwards.

    Args:
        largest_k: largest difference that the colours cover, in K, if there are classes for it;
            rounded up to 0.5 K.
        resolution_k: step between two classes, in K.
    """
    end = max(0.5, float(np.ceil(2.0 * largest_k - 1e-9)) / 2.0)
    end = min(end, 126.0 * resolution_k)
    bands = (Band(-end, end, DIVERGING),)
    return ColourScale(-end, end, "K", bands, resolution_k, -126.0 * resolution_k)


def largest_difference_k(counts: I64, scale: ColourScale) -> float:
    """Return the 99.9th percentile of absolute differences, in K.

    Args:
        counts: number of values of every class of the scale, (``MAX_CLASSES`` + 1,).
        scale: scale of differences.
    """
    differences_k = np.abs(values_of(scale))
    order = np.argsort(differences_k, kind="stable")
    total = np.cumsum(counts[1:][order])
    if total[-1] == 0:
        return 0.0
    return float(differences_k[order][np.searchsorted(total, 0.999 * total[-1])])


def _rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of a colour #RRGGBB, 0..255 each."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
