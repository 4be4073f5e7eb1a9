"""The embedded year: a seeded generator driven only by fitted figures.

Each quantity is a climatology (annual and diurnal harmonics and their product) plus an
autocorrelated residual, mapped onto the percentiles of the real series. Weather is dry bulb, dew
point correlated with it, and pressure; carbon intensity follows from a generated fuel mix in which
every fuel but the marginal one is drawn and the marginal one takes what wind leaves. The figures
are in ``sdc_taichi.data/coefficients.json``; where they come from is in ``data/README.md``.

Random numbers are raw PCG64 bits turned to normals by Box-Muller, because NumPy guarantees the bit
stream but not ``Generator.normal`` across versions. Results are rounded to 1e-4 (workload 1e-6),
far above the last bits in which processors differ, so that a seed means one year everywhere.
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

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.psychrometrics import (
    relative_humidity_from_dew_point_pct,
    wet_bulb_c,
)
from sdc_taichi.exogenous.series import FloatArray, Series, SiteData
from sdc_taichi.year_clock import DAYS_PER_YEAR, HOURS_PER_YEAR

TRACE_HOURS = 53 * 168  # whole weeks, as the fitted traces; cut to the year at the end
FUELS = ("WND", "SUN", "WAT", "OIL", "NG", "COL", "NUC", "OTH")
DEFAULT_SEED = 10

# Streams of random numbers of one site; slow and fast residuals of fuel i are 100 + i and 200 + i.
_STREAM_SLOW_FUEL, _STREAM_FAST_FUEL, _STREAM_TRACE = 100, 200, 300
_WARM_UP = 240
"""Hours."""

_Table = dict[str, Any]


@lru_cache(maxsize=1)
def coefficients() -> _Table:
    """The embedded figures (read only)."""
    text = files("sdc_taichi.data").joinpath("coefficients.json").read_text(encoding="utf-8")
    table: _Table = json.loads(text)
    return table


def emission_factors() -> dict[str, float]:
    """Life-cycle emissions per fuel, g CO2e/kWh, that turn a fuel mix into ``avg_CI``."""
    table: dict[str, float] = coefficients()["emission_factors_g_per_kwh"]
    return dict(table)


def synthetic_sites() -> tuple[str, ...]:
    """Names of the embedded sites."""
    return tuple(coefficients()["weather"])


def synthetic_traces() -> tuple[str, ...]:
    """Names of the embedded workload traces."""
    return tuple(coefficients()["workload"])


@lru_cache(maxsize=64, typed=True)
def synthetic_site(name: str, seed: int = DEFAULT_SEED) -> SiteData:
    """Generate one hourly year of weather and carbon intensity.

    Args:
        name: one of ``synthetic_sites()``.
        seed: non-negative; sites draw independently of each other under the same seed.

    Returns:
        The site, 8760 values per series, ``synthetic`` set.

    Raises:
        DataError: unknown name or invalid seed.
    """
    if name not in synthetic_sites():
        raise DataError(f"site {name!r}: expected one of {', '.join(synthetic_sites())}")
    _check_seed(seed)
    table = coefficients()["weather"][name]

    def normals(stream: int) -> FloatArray:
        return _normals(seed, stream, name, HOURS_PER_YEAR)

    outdoor, humidity, pressure = (np.round(x, 4) for x in _weather(table, normals))
    mix = _fuel_mix(coefficients()["grid"][name], normals)
    factors = np.array([emission_factors()[fuel] for fuel in FUELS])
    generation = np.array([mix[fuel] for fuel in FUELS])
    intensity = factors @ generation / generation.sum(axis=0)

    def series(quantity: str, unit: str, values: FloatArray, fitted_to: str) -> Series:
        source = f"synthetic year, seed {seed}, fitted to {fitted_to}"
        return Series(np.round(values, 4), 60.0, quantity, unit, source, synthetic=True)

    station = f"OneBuilding TMYx {table['station']}"
    grid = f"EIA-930 2022 {table['grid']}"
    return SiteData(
        name=name,
        label=table["label"],
        latitude_deg=table["lat"],
        longitude_deg=table["lon"],
        elevation_m=table["elevation_m"],
        utc_offset_h=table["utc_offset"],
        outdoor_c=series("outdoor_c", "C", outdoor, station),
        wet_bulb_c=series("wet_bulb_c", "C", wet_bulb_c(outdoor, humidity, pressure), station),
        ci_g_per_kwh=series("ci_g_per_kwh", "g/kWh", intensity, grid),
        relative_humidity_pct=series("relative_humidity_pct", "%", humidity, station),
        pressure_pa=series("pressure_pa", "Pa", pressure, station),
    )


@lru_cache(maxsize=64, typed=True)
def synthetic_trace(name: str, seed: int = DEFAULT_SEED) -> Series:
    """Generate one hourly year of workload, share of the capacity.

    Args:
        name: one of ``synthetic_traces()``.
        seed: non-negative; traces draw independently of each other under the same seed.

    Returns:
        8760 values in [0, 1], ``synthetic`` set.

    Raises:
        DataError: unknown name or invalid seed.
    """
    if name not in synthetic_traces():
        raise DataError(f"trace {name!r}: expected one of {', '.join(synthetic_traces())}")
    _check_seed(seed)
    table = coefficients()["workload"][name]
    values = _workload(table, lambda i: _normals(seed, i, name, TRACE_HOURS))[:HOURS_PER_YEAR]
    source = f"synthetic year, seed {seed}, fitted to {table['fitted_to']}"
    return Series(np.round(values, 6), 60.0, "utilisation", "1", source, synthetic=True)


def _check_seed(seed: int) -> None:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise DataError(f"seed: {seed!r}, expected a whole number of 0 or more")


class _Basis(NamedTuple):
    """Columns, and their products with each other, which take longer than all else of a fit."""

    columns: FloatArray
    products: FloatArray

    def project(self, z: FloatArray) -> FloatArray:
        """Least-squares coefficients of z."""
        return np.asarray(np.linalg.solve(self.products, self.columns.T @ z), dtype=np.float64)


def _basis(columns: list[FloatArray]) -> _Basis:
    stacked = np.stack(columns, axis=1)
    return _Basis(stacked, stacked.T @ stacked)


# Random numbers and residuals


def _normals(seed: int, stream: int, name: str, n: int) -> FloatArray:
    """Standard normals of one stream of one site, from raw bits (Box and Muller 1958)."""
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
    """``x[t] = phi * x[t - 1] + kicks[t]`` along the first axis.

    By doubling: the sum over 2 n kicks is that over n plus ``phi**n`` times that over the n before.
    """
    x, n, weight = kicks.copy(), 1, phi
    while n < len(x) and weight > 1e-20:
        x[n:] += weight * x[:-n]
        n, weight = 2 * n, weight * weight
    return x


def _ar1(noise: FloatArray, phi: float) -> FloatArray:
    """First-order autoregression of unit variance along the first axis, in its stationary state."""
    kicks = noise * math.sqrt(1.0 - phi * phi)
    kicks[0] = noise[0]
    return _filtered(kicks, phi)


def _ar2(noise: FloatArray, memory_h: float, smooth_h: float) -> FloatArray:
    """Two first-order filters in a row: memory of ``memory_h``, smooth below ``smooth_h``.

    Unit variance (Box, Jenkins and Reinsel 2008, eq. 3.2.28); the last kicks warm it up.
    """
    f, g = math.exp(-1.0 / memory_h), math.exp(-1.0 / max(smooth_h, 1e-3))
    a, b = f + g, -f * g
    variance = (1.0 - b) / ((1.0 + b) * ((1.0 - b) ** 2 - a * a))
    kicks = np.concatenate([noise[-_WARM_UP:], noise]) / math.sqrt(variance)
    return _filtered(_filtered(kicks, f), g)[_WARM_UP:]


def _residual(p: _Table, slow: FloatArray, fast: FloatArray, basis: _Basis) -> FloatArray:
    """Slow part and fast part with a day-to-day memory, orthogonal to the climatology."""
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


# Climatology


@lru_cache(maxsize=32)
def _climatology(annual: int, diurnal: int, products: tuple[int, ...]) -> _Basis:
    """Columns: 1, annual and diurnal harmonics, first annual times given diurnal harmonics."""
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
    return _basis(columns)


def _pin(values: FloatArray, percentiles: list[float]) -> FloatArray:
    """Monotone piecewise-linear map of the values' own percentiles onto the fitted ones."""
    own = np.asarray(np.percentile(values, coefficients()["pins_percent"]), dtype=np.float64)
    knots = np.maximum.accumulate(own + 1e-9 * np.arange(own.size))  # ties stay increasing
    return np.interp(values, knots, percentiles)


def _series(p: _Table, slow: FloatArray, fast: FloatArray) -> FloatArray:
    """Climatology and residual, then percentiles and climatology imposed in turn.

    Both are targets of a typical year, and each disturbs the other a little.
    """
    annual, diurnal, products = p["h"]
    basis = _climatology(annual, diurnal, tuple(products))
    c = np.array(p["c"])
    residual = _residual(p, slow, fast, basis)
    z = basis.columns @ c + residual - basis.columns @ basis.project(residual)
    root = p["link"] == "sqrt"
    values = np.maximum(z, 0.0) ** 2 if root else z
    if "q" not in p:
        return np.asarray(values, dtype=np.float64)
    for _ in range(3):
        pinned = _pin(values, p["q"])
        z = np.sqrt(np.maximum(pinned, 0.0)) if root else pinned
        z = z + basis.columns @ (c - basis.project(z))
        values = np.maximum(z, 0.0) ** 2 if root else z
    return _pin(values, p["q"])


# Weather, grid, workload


def _weather(
    table: _Table, normals: Callable[[int], FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Dry bulb (C), relative humidity (%) and station pressure (Pa)."""
    g = [normals(i) for i in range(5)]
    outdoor = _series(table["T"], g[0], g[1])
    rho_slow, rho_fast = table["D"]["rho"]
    dew_point = _series(
        table["D"],
        rho_slow * g[0] + math.sqrt(1.0 - rho_slow**2) * g[2],
        rho_fast * g[1] + math.sqrt(1.0 - rho_fast**2) * g[3],
    )
    dew_point = np.minimum(dew_point, outdoor)  # drawn apart, so they can cross: saturated air
    mean, spread, memory_h = table["P"]
    pressure = mean + spread * _ar1(g[4], math.exp(-1.0 / memory_h))
    humidity = np.clip(relative_humidity_from_dew_point_pct(outdoor, dew_point), 1.0, 100.0)
    return outdoor, humidity, pressure


def _solar_envelope(latitude_deg: float, lateness_h: float, saturation: float) -> FloatArray:
    """Clear-sky output of a fleet of plants in [0, 1].

    Sine of the solar elevation (declination by Cooper 1969), saturating as trackers do.
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


def _correlated(names: list[str], pairs: dict[str, float], noise: FloatArray) -> FloatArray:
    """Mix independent rows to the given pairwise correlations, made positive definite."""
    matrix = np.eye(len(names))
    for pair, value in pairs.items():
        i, j = (names.index(name) for name in pair.split("-"))
        matrix[i, j] = matrix[j, i] = value
    w, v = np.linalg.eigh(matrix)
    matrix = (v * np.maximum(w, 0.02)) @ v.T
    scale = np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.cholesky(matrix / scale[:, None] / scale) @ noise)


def _fuel_mix(table: _Table, normals: Callable[[int], FloatArray]) -> dict[str, FloatArray]:
    """Generation per fuel, MWh in the hour.

    NET is marginal fuel plus wind: a windy hour pushes gas (hydro in WA) down one for one.
    """
    names: list[str] = table["order"]
    slow, fast = (
        _correlated(
            names,
            table.get(f"corr_{part}", {}),
            np.stack([normals(stream + i) for i in range(len(names))]),
        )
        for part, stream in (("slow", _STREAM_SLOW_FUEL), ("fast", _STREAM_FAST_FUEL))
    )
    mix = {fuel: np.full(HOURS_PER_YEAR, float(table["flat"].get(fuel, 0.0))) for fuel in FUELS}
    for i, name in enumerate(names):
        p = table["drv"][name]
        if name == "SUN":  # percentiles are those of daylight hours, after the envelope
            envelope = _solar_envelope(*table["sun"])
            clear = _series({k: x for k, x in p.items() if k != "q"}, slow[i], fast[i])
            output = np.maximum(clear, 0.0) * envelope
            day = envelope > 0.0
            output[day] = _pin(output[day], p["q"])
            mix[name] = output
        else:
            mix[name] = _series(p, slow[i], fast[i])
    mix[table["marginal"]] = _pin(mix.pop("NET") - mix["WND"], table["q"])
    return mix


def _workload(table: _Table, normals: Callable[[int], FloatArray]) -> FloatArray:
    """Utilisation over TRACE_HOURS hours: annual, daily and weekly harmonics plus residual."""
    hour = np.arange(TRACE_HOURS)
    day = 2.0 * np.pi * (hour % 24 + 0.5) / 24.0
    columns = [np.ones(TRACE_HOURS)]
    for angle, order in (
        (2.0 * np.pi * hour / HOURS_PER_YEAR, table["annual"]),
        (day, table["D"]),
        (2.0 * np.pi * hour / 168.0, table["W"]),
    ):
        for m in range(1, order + 1):
            columns += [np.cos(m * angle), np.sin(m * angle)]
    basis = _basis(columns)
    slow, fast = normals(_STREAM_TRACE), normals(_STREAM_TRACE + 1)
    values = basis.columns @ np.array(table["c"]) + _residual(table, slow, fast, basis)
    return _pin(values, table["q"])
