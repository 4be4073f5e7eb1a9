"""Generator of the embedded synthetic year, from a seed and statistics fitted to real data.

Each quantity is a climatology (annual and diurnal harmonics and their products) plus an
autocorrelated residual, mapped onto the percentiles of the real series. Weather consists of dry
bulb, dew point (correlated with dry bulb) and pressure. Carbon intensity follows from a generated
fuel mix. All fuels but the marginal one are drawn, and the marginal one covers the demand that wind
leaves. ``docs/make/fit_year.py`` fits the statistics in ``sdc_taichi.data/coefficients.json``;
``data/README.md`` names the sources.

Random numbers are raw PCG64 bits, converted to normals by Box-Muller: across versions NumPy
guarantees the bit stream but not ``Generator.normal``. Results are rounded to 1e-4 (workload 1e-6),
much coarser than rounding differences of processors, so a seed gives the same year everywhere.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable
from functools import lru_cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous.psychrometrics import (
    relative_humidity_from_dew_point_pct,
    wet_bulb_c,
)
from sdc_taichi.exogenous.series import FloatArray, Series, SiteData
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, HOURS_PER_YEAR

TRACE_HOURS = 53 * 168
"""Length of a generated workload trace, in hours: whole weeks, later cut to the year."""
FUELS = ("WND", "SUN", "WAT", "OIL", "NG", "COL", "NUC", "OTH")
"""Energy sources of EIA-930: wind, sun, water, oil, natural gas, coal, nuclear, other."""
DEFAULT_SEED = 10
"""Seed of the embedded year if the configuration has none."""

# Random number streams of a site: slow and fast residual of fuel i are streams 100 + i and 200 + i.
_STREAM_SLOW_FUEL, _STREAM_FAST_FUEL, _STREAM_TRACE = 100, 200, 300
_WARM_UP_H = 240

Figures = dict[str, Any]
"""Fitted statistics of a site, grid, quantity or trace, by their names in coefficients.json."""


@lru_cache(maxsize=1)
def coefficients() -> Figures:
    """Return all embedded statistics; callers share the object and must not change it."""
    text = files("sdc_taichi.data").joinpath("coefficients.json").read_text(encoding="utf-8")
    figures: Figures = json.loads(text)
    return figures


def emission_factors() -> dict[str, float]:
    """Return life-cycle emission factors by fuel, in g CO2e/kWh, from which ``avg_CI`` follows."""
    factors: dict[str, float] = coefficients()["emission_factors_g_per_kwh"]
    return dict(factors)


def synthetic_sites() -> tuple[str, ...]:
    """Return the names of the embedded sites."""
    return tuple(coefficients()["weather"])


def synthetic_traces() -> tuple[str, ...]:
    """Return the names of the embedded workload traces."""
    return tuple(coefficients()["workload"])


@lru_cache(maxsize=64, typed=True)
def synthetic_site(name: str, seed: int = DEFAULT_SEED) -> SiteData:
    """Generate one hourly year of weather and carbon intensity.

    Args:
        name: one of ``synthetic_sites()``.
        seed: non-negative seed; sites are independent of each other under the same seed.

    Returns:
        The site, with 8760 values per series and ``synthetic`` set.

    Raises:
        DataError: the name is unknown or the seed is not valid.
    """
    if name not in synthetic_sites():
        raise DataError(f"site {shortened(name)}: expected one of {', '.join(synthetic_sites())}")
    _check_seed(seed)
    figures = coefficients()["weather"][name]

    def normals(stream: int) -> FloatArray:
        return seeded_normals(seed, stream, name, HOURS_PER_YEAR)

    outdoor, humidity, pressure = (np.round(x, 4) for x in _weather(figures, normals))
    mix = _fuel_mix(coefficients()["grid"][name], normals)
    factors = np.array([emission_factors()[fuel] for fuel in FUELS])
    generation = np.array([mix[fuel] for fuel in FUELS])
    intensity = factors @ generation / generation.sum(axis=0)

    def series(quantity: str, unit: str, values: FloatArray, fitted_to: str) -> Series:
        source = f"synthetic year, seed {seed}, fitted to {fitted_to}"
        return Series(np.round(values, 4), 60.0, quantity, unit, source, synthetic=True)

    station = f"OneBuilding TMYx {figures['station']}"
    grid = f"EIA-930 2022 {figures['grid']}"
    return SiteData(
        name=name,
        label=figures["label"],
        latitude_deg=figures["lat"],
        longitude_deg=figures["lon"],
        elevation_m=figures["elevation_m"],
        utc_offset_h=figures["utc_offset"],
        outdoor_c=series("outdoor_c", "C", outdoor, station),
        wet_bulb_c=series("wet_bulb_c", "C", wet_bulb_c(outdoor, humidity, pressure), station),
        ci_g_per_kwh=series("ci_g_per_kwh", "g/kWh", intensity, grid),
        relative_humidity_pct=series("relative_humidity_pct", "%", humidity, station),
        pressure_pa=series("pressure_pa", "Pa", pressure, station),
    )


@lru_cache(maxsize=64, typed=True)
def synthetic_trace(name: str, seed: int = DEFAULT_SEED) -> Series:
    """Generate one hourly year of workload, as a share of the capacity.

    Args:
        name: one of ``synthetic_traces()``.
        seed: non-negative seed; traces are independent of each other under the same seed.

    Returns:
        8760 values in [0, 1], with ``synthetic`` set.

    Raises:
        DataError: the name is unknown or the seed is not valid.
    """
    if name not in synthetic_traces():
        raise DataError(f"trace {shortened(name)}: expected one of {', '.join(synthetic_traces())}")
    _check_seed(seed)
    figures = coefficients()["workload"][name]
    values = _workload(figures, lambda i: seeded_normals(seed, i, name, TRACE_HOURS))[
        :HOURS_PER_YEAR
    ]
    source = f"synthetic year, seed {seed}, fitted to {figures['fitted_to']}"
    return Series(np.round(values, 6), 60.0, "utilisation", "1", source, synthetic=True)


def _check_seed(seed: int) -> None:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise DataError(f"seed: {shortened(seed)}, expected a whole number of 0 or more")


class Basis(NamedTuple):
    """Functions of time whose weighted sum is a climatology."""

    columns: FloatArray
    """One function per column, (hours, functions)."""
    products: FloatArray
    """Scalar products of the columns, (functions, functions), precomputed because they are slow."""

    def project(self, z: FloatArray) -> FloatArray:
        """Return least-squares coefficients, (functions,), of values z, (hours,)."""
        return np.asarray(np.linalg.solve(self.products, self.columns.T @ z), dtype=np.float64)


def make_basis(columns: list[FloatArray]) -> Basis:
    """Return the basis of given functions, each (hours,)."""
    stacked = np.stack(columns, axis=1)
    return Basis(stacked, stacked.T @ stacked)


@lru_cache(maxsize=32)
def climatology_basis(annual: int, diurnal: int, products: tuple[int, ...]) -> Basis:
    """Return a basis of constant, annual harmonics, diurnal harmonics, and products of both.

    Args:
        annual: order of the annual harmonics.
        diurnal: order of the diurnal harmonics.
        products: diurnal harmonics to multiply by the first annual one, so that the shape of the
            day changes with the season.

    Returns:
        Basis over the hours of the year.
        Basis of the hours of the year.
    """
    year = 2.0 * np.pi * (np.arange(HOURS_PER_YEAR) + 0.5) / HOURS_PER_YEAR
    day = 2.0 * np.pi * (np.arange(24) + 0.5) / 24.0

    def diurnals(m: int) -> list[FloatArray]:
        return [np.tile(f(m * day), DAYS_PER_YEAR) for f in (np.cos, np.sin)]

    columns = [np.ones(HOURS_PER_YEAR)]
    for m in range(1, annual + 1):
        columns += [np.cos(m * year), np.sin(m * year)]
    for m in range(1, diurnal + 1):
        columns += diurnals(m)
    for m in products:
        columns += [first * each for first in (np.cos(year), np.sin(year)) for each in diurnals(m)]
    return make_basis(columns)


def trace_basis(hours: int, annual: int, diurnal: int, weekly: int) -> Basis:
    """Return a basis of constant and harmonics of year, day and week, from the start of a year.

    Args:
        hours: length of the basis, in hours.
        annual: order of the annual harmonics.
        diurnal: order of the diurnal harmonics.
        weekly: order of the weekly harmonics.
    """
    hour = np.arange(hours)
    columns = [np.ones(hours)]
    for angle, order in (
        (2.0 * np.pi * hour / HOURS_PER_YEAR, annual),
        (2.0 * np.pi * (hour % 24 + 0.5) / 24.0, diurnal),
        (2.0 * np.pi * hour / 168.0, weekly),
    ):
        for m in range(1, order + 1):
            columns += [np.cos(m * angle), np.sin(m * angle)]
    return make_basis(columns)


def solar_envelope(latitude_deg: float, lateness_h: float, saturation: float) -> FloatArray:
    """Return the clear-sky output of a group of solar plants, as a share of its maximum.

    It follows the sine of the solar elevation (declination by Cooper 1969), with saturation as for
    plants with trackers.

    Args:
        latitude_deg: latitude of the plants' centre, in degrees north.
        lateness_h: delay of the plants' solar noon after 12:00 local standard time, in h.
        saturation: 0 for output proportional to the sine; larger values flatten the midday.

    Returns:
        Share of each hour of the year, 0..1, (8760,).
    """
    hour = np.arange(HOURS_PER_YEAR)
    declination = np.radians(23.45) * np.sin(2.0 * np.pi * (284 + hour // 24 + 1) / DAYS_PER_YEAR)
    angle = np.radians(15.0) * (hour % 24 + 0.5 - 12.0 - lateness_h)
    latitude = math.radians(latitude_deg)
    sine = np.maximum(
        0.0,
        math.sin(latitude) * np.sin(declination)
        + math.cos(latitude) * np.cos(declination) * np.cos(angle),
    )
    return np.asarray(
        (1.0 - np.exp(-saturation * sine)) / (1.0 - math.exp(-saturation)), dtype=np.float64
    )


# Random numbers and residuals


def seeded_normals(seed: int, stream: int, name: str, n: int) -> FloatArray:
    """Return standard normals, (n,), of a site's stream, from raw bits (Box and Muller 1958)."""
    key = zlib.crc32(name.encode())
    bits = np.random.PCG64(np.random.SeedSequence([int(seed), stream, key]))
    half = (n + 1) // 2
    u, v = (
        (bits.random_raw(half) >> np.uint64(11)).astype(np.float64) * 2.0**-53 for _ in range(2)
    )
    radius = np.sqrt(-2.0 * np.log(1.0 - u))
    angle = 2.0 * np.pi * v
    return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])[:n]


def _filtered(kicks: FloatArray, phi: float) -> FloatArray:
    """Return x with ``x[t] = phi * x[t - 1] + kicks[t]`` along the first axis.

    The filter works by doubling: the weighted sum of the last 2 n kicks is that of the last n, plus
    ``phi**n`` times that of the n before them.
    """
    x, n, weight = kicks.copy(), 1, phi
    while n < len(x) and weight > 1e-20:
        x[n:] += weight * x[:-n]
        n, weight = 2 * n, weight * weight
    return x


def _ar1(noise: FloatArray, phi: float) -> FloatArray:
    """Return a stationary first-order autoregression of unit variance along the first axis."""
    kicks = noise * math.sqrt(1.0 - phi * phi)
    kicks[0] = noise[0]
    return _filtered(kicks, phi)


def _ar2(noise: FloatArray, memory_h: float, smooth_h: float) -> FloatArray:
    """Return a second-order autoregression with memory ``memory_h``, smooth below ``smooth_h``.

    It is two first-order filters in series, scaled to unit variance (Box, Jenkins and Reinsel 2008,
    eq. 3.2.28). The last kicks serve as warm-up.
    """
    f, g = math.exp(-1.0 / memory_h), math.exp(-1.0 / max(smooth_h, 1e-3))
    a, b = f + g, -f * g
    variance = (1.0 - b) / ((1.0 + b) * ((1.0 - b) ** 2 - a * a))
    kicks = np.concatenate([noise[-_WARM_UP_H:], noise]) / math.sqrt(variance)
    return _filtered(_filtered(kicks, f), g)[_WARM_UP_H:]


def _residual(p: Figures, slow: FloatArray, fast: FloatArray, basis: Basis) -> FloatArray:
    """Return a residual: a slow part plus a fast part, the latter also correlated from day to day.

    The residual is orthogonal to the climatology and has the fitted standard deviation, so it
    changes neither of them.
    """
    if "tm" in p:
        z = math.sqrt(p["w"]) * _ar2(slow, p["ts"], p["tm"])
    else:
        z = math.sqrt(p["w"]) * _ar1(slow, math.exp(-1.0 / p["ts"]))
    if p["w"] < 1.0:
        hourly = _ar1(fast, math.exp(-1.0 / p["tf"]))
        daily = p.get("Phi", 0.0)
        if daily > 0.0:
            hourly = _ar1(hourly.reshape(-1, 24), daily).ravel()
        z = z + math.sqrt(1.0 - p["w"]) * hourly
    z = z - basis.columns @ basis.project(z)
    return np.asarray(z * (p["sd"] / z.std()), dtype=np.float64)


# Quantities


def _match_percentiles(values: FloatArray, percentiles: list[float]) -> FloatArray:
    """Map values onto the fitted percentiles, linearly between their own percentiles."""
    present = np.asarray(np.percentile(values, coefficients()["pins_percent"]), dtype=np.float64)
    knots = np.maximum.accumulate(present + 1e-9 * np.arange(present.size))  # keep ties increasing
    return np.interp(values, knots, percentiles)


def _quantity(p: Figures, slow: FloatArray, fast: FloatArray) -> FloatArray:
    """Generate one quantity for a year: climatology plus residual, with the fitted percentiles.

    Climatology and percentiles are both targets of a typical year, and each disturbs the other a
    little. They are therefore imposed alternately.

    Args:
        p: fitted statistics of the quantity.
        slow: standard normals of the slow part of the residual, (8760,).
        fast: standard normals of its fast part, (8760,).

    Returns:
        Values, (8760,), in the unit of the percentiles.
    """
    annual, diurnal, products = p["h"]
    basis = climatology_basis(annual, diurnal, tuple(products))
    c = np.array(p["c"])
    residual = _residual(p, slow, fast, basis)
    z = basis.columns @ c + residual - basis.columns @ basis.project(residual)
    root = p["link"] == "sqrt"
    values = np.maximum(z, 0.0) ** 2 if root else z
    if "q" not in p:
        return np.asarray(values, dtype=np.float64)
    for _ in range(3):
        pinned = _match_percentiles(values, p["q"])
        z = np.sqrt(np.maximum(pinned, 0.0)) if root else pinned
        z = z + basis.columns @ (c - basis.project(z))
        values = np.maximum(z, 0.0) ** 2 if root else z
    return _match_percentiles(values, p["q"])


# Weather, grid, workload


def _weather(
    figures: Figures, normals: Callable[[int], FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Generate dry bulb (C), relative humidity (%) and station pressure (Pa), each (8760,)."""
    noise = [normals(i) for i in range(5)]
    outdoor = _quantity(figures["T"], noise[0], noise[1])
    rho_slow, rho_fast = figures["D"]["rho"]
    dew_point = _quantity(
        figures["D"],
        rho_slow * noise[0] + math.sqrt(1.0 - rho_slow**2) * noise[2],
        rho_fast * noise[1] + math.sqrt(1.0 - rho_fast**2) * noise[3],
    )
    dew_point = np.minimum(
        dew_point, outdoor
    )  # The two are drawn separately and may cross; the air is then saturated.
    mean, spread, memory_h = figures["P"]
    pressure = mean + spread * _ar1(noise[4], math.exp(-1.0 / memory_h))
    humidity = np.clip(relative_humidity_from_dew_point_pct(outdoor, dew_point), 1.0, 100.0)
    return outdoor, humidity, pressure


def _correlated(names: list[str], pairs: dict[str, float], noise: FloatArray) -> FloatArray:
    """Mix independent rows of noise so that pairs of rows have given correlations.

    Args:
        names: names of the rows.
        pairs: correlations by ``A-B``, 0 for missing pairs. A matrix that is not positive definite
            is replaced by a similar one that is.
        noise: independent standard normals, (rows, hours).

    Returns:
        Correlated rows, (rows, hours).
    """
    matrix = np.eye(len(names))
    for pair, value in pairs.items():
        i, j = (names.index(name) for name in pair.split("-"))
        matrix[i, j] = matrix[j, i] = value
    w, v = np.linalg.eigh(matrix)
    matrix = (v * np.maximum(w, 0.02)) @ v.T
    scale = np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.cholesky(matrix / scale[:, None] / scale) @ noise)


def _fuel_mix(figures: Figures, normals: Callable[[int], FloatArray]) -> dict[str, FloatArray]:
    """Generate the generation of each fuel, in MWh per hour, (8760,).

    NET is the sum of the marginal fuel and wind. It is drawn like a fuel, and the marginal fuel is
    NET minus wind. In a windy hour, wind therefore replaces an equal amount of gas (hydro in WA).
    """
    names: list[str] = figures["order"]
    slow, fast = (
        _correlated(
            names,
            figures.get(f"corr_{part}", {}),
            np.stack([normals(stream + i) for i in range(len(names))]),
        )
        for part, stream in (("slow", _STREAM_SLOW_FUEL), ("fast", _STREAM_FAST_FUEL))
    )
    mix = {fuel: np.full(HOURS_PER_YEAR, float(figures["flat"].get(fuel, 0.0))) for fuel in FUELS}
    for i, name in enumerate(names):
        p = figures["drv"][name]
        if name == "SUN":  # percentiles are of daylight hours, after the envelope
            envelope = solar_envelope(*figures["sun"])
            clear = _quantity({k: x for k, x in p.items() if k != "q"}, slow[i], fast[i])
            output = np.maximum(clear, 0.0) * envelope
            day = envelope > 0.0
            output[day] = _match_percentiles(output[day], p["q"])
            mix[name] = output
        else:
            mix[name] = _quantity(p, slow[i], fast[i])
    mix[figures["marginal"]] = _match_percentiles(mix.pop("NET") - mix["WND"], figures["q"])
    return mix


def _workload(figures: Figures, normals: Callable[[int], FloatArray]) -> FloatArray:
    """Generate utilisation, 0..1, (TRACE_HOURS,): annual, daily, weekly harmonics plus residual."""
    basis = trace_basis(TRACE_HOURS, figures["annual"], figures["D"], figures["W"])
    slow, fast = normals(_STREAM_TRACE), normals(_STREAM_TRACE + 1)
    values = basis.columns @ np.array(figures["c"]) + _residual(figures, slow, fast, basis)
    return _match_percentiles(values, figures["q"])
