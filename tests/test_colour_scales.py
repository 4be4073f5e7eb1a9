"""Colours of the maps of a recording: their ranges, limits and classes."""

from __future__ import annotations

import numpy as np
import pytest

from sdc_taichi import ConfigError
from sdc_taichi.viz import colour_scales
from sdc_taichi.viz.colour_scales import (
    ColourScale,
    InletRange,
    classes_of,
    colours_of,
    difference_scale,
    inlet_scale,
    labels,
    largest_difference_k,
    parse_inlet_range,
)

COOL_HALL_C = np.linspace(22.0, 24.0, 1000)


def scale_of(inlet_c: np.ndarray = COOL_HALL_C, inlet_range: InletRange = None) -> ColourScale:
    return inlet_scale(inlet_range, inlet_c, (35.0, 35.0))


def rgb(scale: ColourScale, *values: float) -> np.ndarray:
    colours = colours_of(scale)[classes_of(np.array(values), scale)]
    return np.stack([colours >> 24, colours >> 16 & 255, colours >> 8 & 255], axis=1).astype(int)


def test_range_is_that_of_the_hall_up_to_the_allowable_limit() -> None:
    assert scale_of()[:2] == (21.0, 35.0)
    hot = scale_of(np.linspace(22.0, 41.3, 10_000))
    assert hot[:2] == (21.0, 42.0)
    assert scale_of(np.full(10, 34.9))[:2] == (33.0, 35.0)
    assert scale_of(np.full(10, 50.0))[:2] == (49.0, 50.0)
    assert scale_of(inlet_range=(18.0, 32.0))[:2] == (18.0, 32.0)
    assert scale_of(inlet_range="same")[:2] == (10.0, 45.0)


@pytest.mark.parametrize(("limit_c", "others"), [(27.0, 26.0), (35.0, 34.0), (18.0, 19.0)])
def test_colours_jump_at_the_limits(limit_c: float, others: float) -> None:
    scale = scale_of(inlet_range="same")
    below, at, above = rgb(scale, limit_c - scale.resolution, limit_c, limit_c + scale.resolution)
    assert np.abs(at - below).sum() < 60 < 150 < np.abs(above - at).sum()
    side, beside = rgb(scale, others, others + scale.resolution)
    assert np.abs(side - beside).sum() < 60, "and only there"


def test_small_differences_within_the_recommended_range_are_visible() -> None:
    colours = rgb(scale_of(), 22.0, 22.5, 23.0, 23.5, 24.0)
    assert np.all(np.abs(np.diff(colours, axis=0)).sum(axis=1) > 30)


def test_values_beyond_the_range_keep_their_label_and_the_colour_of_the_end() -> None:
    scale = scale_of()
    names = labels(scale)
    assert names[int(classes_of(np.array(36.4), scale)) - 1] == "36.4 C"
    np.testing.assert_array_equal(*rgb(scale, 35.0 + scale.resolution, 38.0))
    assert names[0].endswith(" C or less")
    assert names[-1].endswith(" C or more")
    assert classes_of(np.array([-300.0, 300.0]), scale).tolist() == [1, len(names)]
    assert classes_of(np.array([np.nan, np.inf]), scale).tolist() == [0, 0]
    assert colours_of(scale)[0] == 0, "no value has no colour"


@pytest.mark.parametrize("largest", [0.3, 4.2, 12.0])
def test_differences_are_white_at_zero_and_change_to_both_sides(largest: float) -> None:
    scale = difference_scale(largest)
    assert scale.high == -scale.low >= max(0.5, largest)
    assert scale.high <= max(0.5, largest + 0.5)
    below, zero, above = rgb(scale, -scale.high, 0.0, scale.high)
    assert np.ptp(zero) < 12
    assert below[2] > 2 * below[0]
    assert above[0] > 2 * above[2]
    assert labels(scale)[int(classes_of(np.array(0.0), scale)) - 1].split()[0].strip("0.") == ""


def test_colours_of_differences_fit_all_but_the_largest() -> None:
    scale = difference_scale(5.0)
    differences = np.concatenate([np.full(9995, -0.2), [-3.1], np.full(4, 12.0)])
    counts = np.bincount(classes_of(differences, scale), minlength=255)
    assert largest_difference_k(counts, scale) == pytest.approx(0.2)
    counts[classes_of(np.array([-3.1]), scale)] += 10_000
    assert largest_difference_k(counts, scale) == pytest.approx(3.1)
    assert largest_difference_k(np.zeros(255, np.int64), scale) == 0.0


@pytest.mark.parametrize("text", ["18:32", "same"])
def test_ranges_are_parsed(text: str) -> None:
    assert parse_inlet_range(text) == ("same" if text == "same" else (18.0, 32.0))


@pytest.mark.parametrize(
    "text", ["", "18", "18:", "18:x", "32:18", "18:18", "18:18.5", "-60:30", "20:200", "1:2:3"]
)
def test_bad_ranges_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"--inlet-range .*: valid is"):
        parse_inlet_range(text)


@pytest.mark.parametrize("value", [3, "hot", (1,), (32, 18), (np.nan, 3), ("a", "b")])
def test_bad_arguments_are_refused(value: object) -> None:
    with pytest.raises(ConfigError, match=r"inlet_range .*: valid is"):
        colour_scales.check_inlet_range(value)
