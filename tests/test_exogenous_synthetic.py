"""The embedded year against the statistics of the measured years it is fitted to."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import psychrolib
import pytest

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import (
    Series,
    load_site,
    load_trace,
    statistics,
    stull_wet_bulb_c,
    synthetic_site,
    synthetic_trace,
    wet_bulb_c,
)
from sdc_taichi.exogenous.synthetic import synthetic_sites, synthetic_traces

SEEDS = range(10)
# Measured years in local standard time: OneBuilding TMYx, EIA-930 2022, Alibaba 2018, Google 2011.
REAL: dict[str, dict[str, dict[str, float]]] = json.loads(
    (Path(__file__).parent / "fixtures" / "exogenous" / "real_statistics.json").read_text()
)

# Largest miss of the mean over the ten seeds; one seed alone may miss by twice as much. In
# standard deviations of the measured series for mean, p1 and p99, absolute for correlations, and
# relative for the rest.
STATISTICS = ("mean", "std", "p1", "p99", "diurnal", "seasonal", "daily_std", "acf1", "acf24")
TOLERANCE: dict[str, dict[str, float]] = {
    quantity: dict(zip(STATISTICS, tolerances, strict=True))
    for quantity, tolerances in {
        "outdoor_c": (0.03, 0.02, 0.01, 0.01, 0.05, 0.20, 0.08, 0.005, 0.04),
        "wet_bulb_c": (0.04, 0.03, 0.40, 0.20, 0.08, 0.15, 0.25, 0.01, 0.06),
        "ci_g_per_kwh": (0.12, 0.12, 0.40, 0.25, 0.16, 0.15, 0.25, 0.015, 0.06),
        "utilisation": (0.02, 0.03, 0.02, 0.02, 0.06, np.inf, 0.08, 0.02, 0.12),
    }.items()
}
# Arizona's carbon intensity varies less between months than the measured year: 127 of 151 g/kWh.
# Known, and documented in docs/data.md; the bound keeps it from getting worse.
EXCEPTIONS = {("ci_g_per_kwh", "AZ", "seasonal"): 0.20}


@pytest.fixture(scope="session")
def synthetic_statistics() -> dict[tuple[str, str], list[dict[str, float]]]:
    """Statistics of every quantity and place, one entry per seed."""
    found: dict[tuple[str, str], list[dict[str, float]]] = {}

    def add(place: str, series: Series) -> None:
        found.setdefault((series.name, place), []).append(statistics(series))

    for seed in SEEDS:
        for place in synthetic_sites():
            site = synthetic_site(place, seed)
            for series in (site.outdoor_c, site.wet_bulb_c, site.ci_g_per_kwh):
                add(place, series)
        for place in synthetic_traces():
            add(place, synthetic_trace(place, seed))
    return found


def miss(statistic: str, value: float, real: dict[str, float]) -> float:
    if statistic in ("acf1", "acf24"):
        return abs(value - real[statistic])
    scale = real["std"] if statistic in ("mean", "p1", "p99") else real[statistic]
    return abs(value - real[statistic]) / scale


CASES = [
    (quantity, place, statistic)
    for quantity, statistics_of in TOLERANCE.items()
    for place in REAL[quantity]
    for statistic in statistics_of
    if statistic in REAL[quantity][place]
]


@pytest.mark.parametrize(("quantity", "place", "statistic"), CASES)
def test_synthetic_years_hold_the_tolerances(
    quantity: str,
    place: str,
    statistic: str,
    synthetic_statistics: dict[tuple[str, str], list[dict[str, float]]],
) -> None:
    real = REAL[quantity][place]
    per_seed = [s[statistic] for s in synthetic_statistics[quantity, place]]
    allowed = EXCEPTIONS.get((quantity, place, statistic), TOLERANCE[quantity][statistic])
    assert miss(statistic, float(np.mean(per_seed)), real) <= allowed, "mean of the seeds"
    worst = max(miss(statistic, x, real) for x in per_seed)
    assert worst <= 2.0 * allowed, "a seed"


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("quantity", ["outdoor_c", "ci_g_per_kwh"])
def test_sites_keep_their_order(
    quantity: str,
    seed: int,
    synthetic_statistics: dict[tuple[str, str], list[dict[str, float]]],
) -> None:
    def order(mean: Any) -> list[str]:
        return sorted(REAL[quantity], key=mean, reverse=True)

    real = order(lambda p: REAL[quantity][p]["mean"])
    assert order(lambda p: synthetic_statistics[quantity, p][seed]["mean"]) == real


def test_years_are_physical() -> None:
    for place in synthetic_sites():
        site = synthetic_site(place)
        assert site.relative_humidity_pct is not None
        assert site.pressure_pa is not None
        assert np.all(site.wet_bulb_c.values <= site.outdoor_c.values)
        assert np.all(site.ci_g_per_kwh.values > 0.0)
        assert np.all(site.relative_humidity_pct.values > 0.0)
        assert np.all(site.relative_humidity_pct.values <= 100.0)
        for series in site.series:
            assert series.values.shape == (8760,)
            assert series.synthetic
            assert "synthetic year, seed 10" in series.source
    for name in synthetic_traces():
        trace = synthetic_trace(name)
        assert trace.values.shape == (8760,)
        assert trace.values.min() >= 0.0
        assert trace.values.max() <= 1.0


# Bit stability


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("AZ", "50fbf5feb3028f23"),
        ("CA", "a5fb0823003e63b0"),
        ("GA", "83b0ff5b02bfdcd1"),
        ("IL", "7f5dfd8550255fdc"),
        ("NY", "343e7df0ad94783a"),
        ("TX", "19b60636cf20518e"),
        ("VA", "3e219ee40b6171df"),
        ("WA", "e88414862713fd56"),
        ("alibaba_1", "5b3a0d67a8689a80"),
        ("alibaba_2", "01b9349232dc369a"),
        ("google_1", "48faf43302d960fb"),
    ],
)
def test_seed_10_is_the_same_year_everywhere(name: str, digest: str) -> None:
    """Values to two digits fewer than generated, so a last bit that differs cannot show."""
    if name in synthetic_sites():
        site = synthetic_site(name)
        values = [site.outdoor_c.values, site.wet_bulb_c.values, site.ci_g_per_kwh.values]
        generated = np.rint(np.concatenate(values) * 1e4)
    else:
        generated = np.rint(synthetic_trace(name).values * 1e6)
    coarse = (generated.astype("<i8") + 50) // 100
    assert hashlib.sha256(coarse.tobytes()).hexdigest()[:16] == digest


def test_seeds_differ_and_repeat() -> None:
    synthetic_site.cache_clear()
    first = synthetic_site("NY", 3).outdoor_c.values
    synthetic_site.cache_clear()
    np.testing.assert_array_equal(first, synthetic_site("NY", 3).outdoor_c.values)
    assert not np.array_equal(first, synthetic_site("NY", 4).outdoor_c.values)
    trace = synthetic_trace("google_1", 3).values
    assert not np.array_equal(trace, synthetic_trace("google_1", 4).values)


@pytest.mark.parametrize("seed", [-1, 1.5, True, None])
def test_bad_seeds_are_rejected(seed: object) -> None:
    with pytest.raises(DataError, match="seed"):
        load_site("NY", seed=seed)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="seed"):
        load_trace("google_1", seed=seed)  # type: ignore[arg-type]


# Wet bulb


@pytest.mark.parametrize(
    ("outdoor", "humidity", "pressure", "psychrolib_c", "stull_c"),
    [
        (20.0, 50.0, 101325.0, 13.783369664318617, 13.699341968988136),
        (30.0, 50.0, 101325.0, 22.005235557069273, 22.296833962680253),
        (35.0, 20.0, 101325.0, 18.87039314572958, 19.302351794569628),
        (40.0, 10.0, 97000.0, 18.254538624903528, 18.507283692077245),
        (-5.0, 80.0, 101325.0, -5.883952262502155, -6.472842132525663),
    ],
)
def test_wet_bulb_reference_points(
    outdoor: float, humidity: float, pressure: float, psychrolib_c: float, stull_c: float
) -> None:
    assert float(wet_bulb_c(outdoor, humidity, pressure)) == pytest.approx(psychrolib_c, abs=0.01)
    assert float(stull_wet_bulb_c(outdoor, humidity)) == pytest.approx(stull_c, abs=1e-9)


def test_wet_bulb_agrees_with_psychrolib_everywhere() -> None:
    psychrolib.SetUnitSystem(psychrolib.SI)
    outdoor, humidity, pressure = (
        x.ravel()
        for x in np.meshgrid(
            [-45.0, -20.0, -5.0, -0.5, 0.0, 0.5, 3.0, 12.0, 27.0, 38.0, 50.0],
            [1.0, 5.0, 20.0, 50.0, 80.0, 99.0, 100.0],
            [75_000.0, 97_000.0, 101_325.0, 104_000.0],
        )
    )
    ours = wet_bulb_c(outdoor, humidity, pressure)
    theirs = [
        psychrolib.GetTWetBulbFromRelHum(t, rh / 100.0, p)
        for t, rh, p in zip(outdoor, humidity, pressure, strict=True)
    ]
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=0.01)
    assert np.all(ours <= outdoor)


@pytest.mark.parametrize(
    ("outdoor", "humidity", "pressure", "name"),
    [
        (20.0, 101.0, 101325.0, "relative_humidity_pct"),
        (20.0, -1.0, 101325.0, "relative_humidity_pct"),
        (20.0, np.nan, 101325.0, "relative_humidity_pct"),
        (90.0, 50.0, 101325.0, "outdoor_c"),
        (20.0, 50.0, 1013.25, "pressure_pa"),
    ],
)
def test_wet_bulb_rejects_the_impossible(
    outdoor: float, humidity: float, pressure: float, name: str
) -> None:
    with pytest.raises(DataError, match=name):
        wet_bulb_c(np.array([10.0, outdoor]), humidity, pressure)
