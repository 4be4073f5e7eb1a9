"""Fit the figures of the embedded synthetic year, data/coefficients.json, to measured files.

    python docs/make/fit_year.py FOLDER OUT.json [--site XX] [--refit]

FOLDER holds weather/USA_XX_*.epw, carbon/XX_NG_&_avgCI.csv and workload/*.csv. With the files named
in data/README.md the result equals data/coefficients.json to the byte.

A quantity is a climatology (harmonics of the year and the day, by least squares) plus a residual.
Of the residual the file keeps its standard deviation and its memory, and of the quantity its
percentiles. See docs/data.md for what to add for a site of your own.

The memory of a residual (keys w, ts, tf, tm and Phi) is read from the present coefficients.json
where that has the quantity: those figures came from a numerical search whose program no longer
exists.
For what it lacks, or for all quantities with --refit, ``fit_memory`` finds w, ts and tf.

--site fits that site alone and keeps the figures of all others, whose files are not needed then.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from sdc_taichi.exogenous.synthetic import (
    FUELS,
    Basis,
    climatology_basis,
    coefficients,
    solar_envelope,
    trace_basis,
)
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, HOURS_PER_YEAR

F64 = npt.NDArray[np.float64]
Figures = dict[str, Any]

PERCENTILES = (0.0, 1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0, 100.0)
"""Percentiles that every quantity carries."""
EMISSION_FACTORS_G_PER_KWH = {
    "WND": 11.0,
    "SUN": 41.0,
    "WAT": 24.0,
    "OIL": 650.0,
    "NG": 490.0,
    "COL": 820.0,
    "NUC": 12.0,
    "OTH": 230.0,
}
"""Life-cycle emissions per fuel; data/README.md has the sources."""
HARMONICS: dict[str, tuple[int, int, tuple[int, ...]]] = {
    "T": (2, 2, (1,)),
    "D": (2, 1, ()),
    "NET": (5, 3, (1, 2)),
    "WND": (2, 1, (1,)),
    "SUN": (2, 0, ()),
    "WAT": (3, 3, (1, 2)),
    "OIL": (2, 2, ()),
    "NG": (5, 1, ()),
    "COL": (5, 2, (1,)),
    "NUC": (5, 0, ()),
    "OTH": (1, 3, (1,)),
}
"""Orders of annual harmonics, of diurnal ones, and of their products, by quantity."""
SQUARE_ROOTS = ("WND", "WAT", "OIL", "OTH")
"""Quantities fitted as square roots, because they are skewed and never below 0."""
LEAST_CORRELATION = 0.15
"""Weaker correlations between fuels are left out."""
LEAST_PRESSURE_STD_PA = 500.0
"""Lowest standard deviation of pressure; the file of VA holds a nearly constant one."""
SUN_WITHIN_DAY = 0.3
"""Share kept of what solar output varies within a day: most is the envelope's error."""
MEMORY = ("w", "ts", "tf", "tm", "Phi")
"""Keys of a residual's memory, in the order of the file."""


@dataclass(frozen=True, slots=True)
class Place:
    """Facts about a site that its measured files do not hold."""

    label: str
    """City and state."""
    authority: str
    """Balancing authority of the carbon file, as EIA-930 names it."""
    drawn: tuple[str, ...]
    """Fuels with a year of their own; NET is the marginal fuel plus wind. Others are constant."""
    marginal: str = "NG"
    """Fuel that takes what wind leaves."""
    solar_latitude_deg: float | None = None
    """Centre of the solar plants, degrees north; None without solar generation."""
    first_end_stamp: int = 0
    """First row of the carbon file whose stamp marks the end of its hour; those before mark the
    start."""
    faulty_rows: tuple[int, ...] = ()
    """Rows of the carbon file, from 0, that are interpolated."""
    nuclear_mwh: tuple[float, float] = (-math.inf, math.inf)
    """Limits of nuclear generation; rows outside are interpolated."""
    other_mwh: tuple[float, float] = (math.nan, math.inf)
    """Usual OTH, and the OTH above which the rest belongs to oil, or to nuclear where that is 0."""


PLACES = {
    "AZ": Place(
        "Phoenix, Arizona",
        "AZPS",
        ("NET", "WND", "SUN", "COL"),
        solar_latitude_deg=33.4,
        faulty_rows=(5776, 7200, 7386),  # gas 5,271 of 1,200 MWh; other fuels 1,340 and 686 of 30
    ),
    "CA": Place(
        "San Jose, California",
        "CISO",
        ("NET", "WND", "SUN", "WAT", "NUC", "OTH"),
        solar_latitude_deg=35.8,
        first_end_stamp=3943,  # 14 June 2022, 07:00 UTC
    ),
    "GA": Place(
        "Atlanta, Georgia", "SOCO", ("NET", "SUN", "WAT", "NUC", "COL"), solar_latitude_deg=32.3
    ),
    "IL": Place(
        "Chicago, Illinois",
        "MISO",
        ("NET", "WND", "SUN", "WAT", "NUC", "COL"),
        solar_latitude_deg=40,
    ),
    "NY": Place(
        "New York, New York",
        "NYIS",
        ("NET", "WND", "WAT", "NUC", "OIL"),
        other_mwh=(190.0, 450.0),
    ),
    "TX": Place(
        "Dallas, Texas", "ERCO", ("NET", "WND", "SUN", "NUC", "COL"), solar_latitude_deg=31.5
    ),
    "VA": Place(
        "Leesburg, Virginia",
        "PJM",
        ("NET", "WND", "SUN", "WAT", "NUC", "COL"),
        solar_latitude_deg=39.3,
        first_end_stamp=HOURS_PER_YEAR,
        nuclear_mwh=(20_000.0, 40_000.0),
    ),
    "WA": Place(
        "Seattle, Washington",
        "BPAT",
        ("NET", "WND", "SUN", "NUC", "NG"),
        marginal="WAT",
        solar_latitude_deg=45.5,
    ),
}
"""Embedded sites, by the two letters in the names of their files."""


@dataclass(frozen=True, slots=True)
class Trace:
    """A workload file."""

    file: str
    """Name within the folder workload."""
    fitted_to: str
    """Source, as the file of figures names it."""
    weeks: int | None = None
    """Weeks to read, for files that repeat them; None for all."""
    transposed: bool = False
    """Whether hour and day are swapped within each week."""
    weekly: int = 0
    """Order of the weekly harmonics."""
    annual: int = 0
    """Order of the annual harmonics."""


TRACES = {
    "alibaba_1": Trace(
        "Alibaba_CPU_Data_Hourly_1.csv",
        "Alibaba cluster-trace-v2018 (first CPU file of SustainDC)",
        weeks=1,
        transposed=True,
    ),
    "alibaba_2": Trace(
        "Alibaba_CPU_Data_Hourly_2.csv",
        "Alibaba cluster-trace-v2018 (second CPU file of SustainDC)",
        weeks=1,
        transposed=True,
    ),
    "google_1": Trace(
        "GoogleClusteData_CPU_Data_Hourly_1.csv",
        "Google clusterdata-2011-2 (CPU file of SustainDC)",
        weekly=3,
        annual=1,
    ),
}
"""Embedded workload traces."""


# Reading


def read_weather(path: Path) -> tuple[list[str], F64]:
    """Fields of the location line, and dry bulb (C), dew point (C) and pressure (Pa), (3, 8760).

    Raises:
        ValueError: not 8,760 rows.
    """
    lines = path.read_text(encoding="latin-1").splitlines()
    rows = [line.split(",") for line in lines[8:]]
    if len(rows) != HOURS_PER_YEAR:
        raise ValueError(f"{path}: {len(rows)} rows, expected {HOURS_PER_YEAR}")
    columns = np.array([[row[6], row[7], row[9]] for row in rows], dtype=np.float64)
    return [field.strip() for field in lines[0].split(",")], columns.T


def read_generation(path: Path, place: Place, utc_offset_h: int) -> dict[str, F64]:
    """Generation by fuel and of NET, MWh in the hour, each (8760,), in local standard time.

    Rows without values, partial hours (total under half of its 25 h median), rows with a single
    fuel and what ``place`` calls faulty are interpolated.
    """
    mwh = pd.read_csv(path)[list(FUELS)].to_numpy(np.float64)[:HOURS_PER_YEAR]
    fuel = {name: mwh[:, i] for i, name in enumerate(FUELS)}  # views, which the repairs write to
    total = pd.Series(mwh.sum(axis=1))
    usual = total.rolling(25, center=True, min_periods=1).median()
    nuclear_low, nuclear_high = place.nuclear_mwh
    faulty = (
        (total < 0.5 * usual).to_numpy()
        | ((mwh > 0.0).sum(axis=1) == 1)
        | (fuel["NUC"] < nuclear_low)
        | (fuel["NUC"] > nuclear_high)
    )
    faulty[list(place.faulty_rows)] = True
    mwh[faulty] = np.nan
    usual_other, most_other = place.other_mwh
    no_nuclear = fuel["NUC"] < 0.05 * np.nanmedian(fuel["NUC"])
    if math.isfinite(most_other):
        misplaced = fuel["OTH"] - usual_other
        oil = ~no_nuclear & (fuel["OTH"] > most_other)
        fuel["NUC"][no_nuclear] = misplaced[no_nuclear]
        fuel["OIL"][oil] += misplaced[oil]
        fuel["OTH"][no_nuclear | oil] = usual_other
    for values in fuel.values():
        known = ~np.isnan(values)
        hour = np.arange(values.size)
        values[~known] = np.interp(hour[~known], hour[known], values[known])
    by_start = _hours_by_start(mwh, place.first_end_stamp)
    local = np.roll(by_start, utc_offset_h, axis=0)
    out = {name: local[:, i] for i, name in enumerate(FUELS)}
    return {**out, "NET": out[place.marginal] + out["WND"]}


def _hours_by_start(rows: F64, first_end_stamp: int) -> F64:
    """Rows in order of the hour they begin at, the first one at the first stamp.

    Where stamps turn from the start of the hour to its end, one hour is reported twice and the
    last of the year never.
    """
    if first_end_stamp >= len(rows):
        return rows
    if first_end_stamp == 0:
        return np.roll(rows, -1, axis=0)
    last = 0.5 * (rows[-1:] + rows[:1])
    return np.concatenate([np.delete(rows, first_end_stamp, axis=0), last])


def read_utilisation(path: Path, trace: Trace) -> F64:
    """Utilisation, 0..1, in the order of the clock, (hours,)."""
    values = pd.read_csv(path)["cpu_load"].to_numpy(np.float64)
    if trace.transposed:
        values = values.reshape(-1, 24, 7).transpose(0, 2, 1).ravel()
    return values if trace.weeks is None else values[: 168 * trace.weeks]


# Fitting


def significant(value: float, digits: int = 5) -> float:
    """The value rounded to so many significant digits."""
    return float(f"{value:.{digits}g}")


def climatology(values: F64, basis: Basis) -> tuple[list[float], F64]:
    """Coefficients of the climatology, as the file holds them, and the residual."""
    fitted = basis.project(values)
    return [significant(c) for c in fitted], values - basis.columns @ fitted


def percentiles(values: F64) -> list[float]:
    """The percentiles that a quantity carries."""
    return [significant(x) for x in np.percentile(values, PERCENTILES)]


def autocorrelation(values: F64, lag: int) -> float:
    """Correlation with the values ``lag`` earlier; the estimate that shrinks with the lag."""
    centred = values - values.mean()
    return float((centred[lag:] * centred[:-lag]).mean() / (centred * centred).mean())


def fit_memory(residual: F64) -> Figures:
    """Slow share w and memories ts and tf, h: w exp(-k/ts) + (1 - w) exp(-k/tf) at lag k.

    Least squares on the autocorrelation at lags from 1 h to a week, each weighted with 1/sqrt(k),
    and twice that for whole days: over all pairs of 240 slow and 120 fast memories, w in 0..1 in
    closed form.
    """
    lags = np.array([1, 2, 3, 6, 12, 24, 48, 72, 168])
    lags = lags[lags < residual.size]
    weight = np.where(lags % 24 == 0, 4.0, 1.0) / lags
    measured = np.array([autocorrelation(residual, int(k)) for k in lags])
    slow_h, fast_h = np.geomspace(20.0, 700.0, 240), np.geomspace(0.3, 24.0, 120)
    fast = np.exp(-lags / fast_h[:, None])
    best: tuple[float, float, float, float] = (math.inf, 0.0, 0.0, 0.0)
    for ts in slow_h:
        gain = np.exp(-lags / ts) - fast
        share = (weight * gain * (measured - fast)).sum(axis=1) / (weight * gain**2).sum(axis=1)
        share = np.clip(share, 0.0, 1.0)
        miss = (weight * (fast + share[:, None] * gain - measured) ** 2).sum(axis=1)
        at = int(np.argmin(miss))
        best = min(best, (float(miss[at]), float(share[at]), float(ts), float(fast_h[at])))
    _, w, ts, tf = best
    return {"w": significant(w, 4), "ts": significant(ts, 4), "tf": significant(tf, 3)}


def memory_of(residual: F64, present: Mapping[str, Any] | None) -> Figures:
    """Memory of a residual: that of the present figures, else fitted."""
    if present is None:
        return fit_memory(residual)
    return {key: present[key] for key in MEMORY if key in present}


def fit_quantity(name: str, values: F64, present: Mapping[str, Any] | None) -> tuple[Figures, F64]:
    """Figures of one quantity, and its residual, (8760,)."""
    annual, diurnal, products = HARMONICS[name]
    root = name in SQUARE_ROOTS
    c, residual = climatology(
        np.sqrt(values) if root else values, climatology_basis(annual, diurnal, products)
    )
    figures: Figures = {
        "h": [annual, diurnal, list(products)],
        "c": c,
        "sd": significant(residual.std(), 4),
        **memory_of(residual, present),
        "link": "sqrt" if root else "id",
    }
    if name != "NET":  # its percentiles are those of the marginal fuel
        figures["q"] = percentiles(values)
    return figures, residual


def fit_sun(values: F64, latitude_deg: float) -> tuple[list[float], Figures, F64]:
    """Envelope (latitude, lateness, saturation), figures and residual of solar generation.

    Output is the clear-sky envelope times an amplitude with a climatology of its own, both by least
    squares. The slow residual is the amplitude of each day, the fast one a share of the rest.
    """
    annual, diurnal, products = HARMONICS["SUN"]
    columns = climatology_basis(annual, diurnal, products).columns

    def fit(lateness_h: float, saturation: float) -> tuple[float, F64, F64, F64]:
        envelope = solar_envelope(latitude_deg, lateness_h, saturation)
        weighted = columns * envelope[:, None]
        c: F64 = np.asarray(np.linalg.lstsq(weighted, values, rcond=None)[0], dtype=np.float64)
        rest = values - weighted @ c
        return float(rest @ rest), envelope, c, rest

    shapes = [(late, bend) for late in np.arange(-1.0, 2.01, 0.25) for bend in (1.0, 2.0, 3.0)]
    lateness_h, saturation = min(shapes, key=lambda shape: fit(*shape)[0])
    _, envelope, c, rest = fit(lateness_h, saturation)
    clear, rest = envelope.reshape(-1, 24), rest.reshape(-1, 24)
    daily = (rest * clear).sum(axis=1) / (clear**2).sum(axis=1)
    within = rest - daily[:, None] * clear
    fast = SUN_WITHIN_DAY**2 * (within**2).sum() / (clear**2).sum()
    variance = daily.var() + fast
    figures = {
        "h": [annual, diurnal, list(products)],
        "c": [significant(x) for x in c],
        "sd": significant(math.sqrt(variance), 4),
        "w": significant(daily.var() / variance, 4),
        "ts": significant(-24.0 / math.log(np.corrcoef(daily[1:], daily[:-1])[0, 1]), 4),
        "tm": 4.0,
        "tf": 3.0,
        "link": "id",
        "q": percentiles(values[envelope > 0.0]),
    }
    residual = (daily[:, None] + SUN_WITHIN_DAY * within).ravel()
    return [latitude_deg, float(lateness_h), saturation], figures, residual


def normal_scores(values: F64) -> F64:
    """The values' ranks as quantiles of the standard normal; equal values share their mean rank."""
    _, group, counts = np.unique(values, return_inverse=True, return_counts=True)
    rank = np.cumsum(counts) - 0.5 * (counts - 1)
    to_normal = NormalDist().inv_cdf
    scores = np.array([to_normal((x - 0.5) / values.size) for x in rank])
    return np.asarray(scores[group], dtype=np.float64)


def slow_and_fast(residual: F64) -> tuple[F64, F64]:
    """Daily means of the residual's normal scores, (365,), and what is left of them, (8760,)."""
    scores = normal_scores(residual).reshape(DAYS_PER_YEAR, 24)
    slow = scores.mean(axis=1)
    return slow, (scores - slow[:, None]).ravel()


def correlation(a: F64, b: F64) -> float:
    """Correlation of two series."""
    return float(np.corrcoef(a, b)[0, 1])


def fit_weather(path: Path, place: Place, present: Mapping[str, Any] | None) -> Figures:
    """Figures of a site's weather."""
    location, (outdoor_c, dew_point_c, pressure_pa) = read_weather(path)
    outdoor, outdoor_residual = fit_quantity("T", outdoor_c, present and present["T"])
    dew_point, dew_point_residual = fit_quantity("D", dew_point_c, present and present["D"])
    parts = zip(slow_and_fast(outdoor_residual), slow_and_fast(dew_point_residual), strict=True)
    percentiles_of_dew_point = dew_point.pop("q")
    return {
        "label": place.label,
        "station": f"{location[1]} {location[5]}",
        "grid": place.authority,
        "lat": float(location[6]),
        "lon": float(location[7]),
        "utc_offset": float(location[8]),
        "elevation_m": float(location[9]),
        "P": [
            significant(pressure_pa.mean(), 6),
            max(LEAST_PRESSURE_STD_PA, significant(pressure_pa.std(), 4)),
            significant(-24.0 / math.log(autocorrelation(pressure_pa, 24)), 4),
        ],
        "T": outdoor,
        "D": {
            **dew_point,
            "kind": "td",
            "q": percentiles_of_dew_point,
            "rho": [significant(correlation(a, b), 3) for a, b in parts],
        },
    }


def fit_grid(
    path: Path, place: Place, utc_offset_h: int, present: Mapping[str, Any] | None
) -> Figures:
    """Figures of a grid's fuel mix."""
    mwh = read_generation(path, place, utc_offset_h)
    drawn: dict[str, Figures] = {}
    residuals: dict[str, F64] = {}
    sun: list[float] = []
    for name in place.drawn:
        if name == "SUN":
            assert place.solar_latitude_deg is not None
            sun, drawn[name], residuals[name] = fit_sun(mwh[name], place.solar_latitude_deg)
        else:
            known = present and present["drv"].get(name)
            drawn[name], residuals[name] = fit_quantity(name, mwh[name], known)
    constant = [f for f in FUELS if f not in (*place.drawn, place.marginal) and mwh[f].any()]
    parts = {name: slow_and_fast(residual) for name, residual in residuals.items()}
    return {
        "order": list(place.drawn),
        "drv": drawn,
        "marginal": place.marginal,
        "utc_offset": utc_offset_h,
        **({"sun": sun} if sun else {}),
        "corr_slow": _correlations({name: slow for name, (slow, _) in parts.items()}),
        "corr_fast": _correlations({name: fast for name, (_, fast) in parts.items()}),
        "q": percentiles(mwh[place.marginal]),
        "flat": {fuel: significant(mwh[fuel].mean()) for fuel in constant},
    }


def _correlations(parts: Mapping[str, F64]) -> dict[str, float]:
    """Correlation of each pair, later before earlier, without the weak ones."""
    names = list(parts)
    pairs = {
        f"{later}-{earlier}": correlation(parts[later], parts[earlier])
        for i, later in enumerate(names)
        for earlier in names[:i]
    }
    return {k: round(value, 2) for k, value in pairs.items() if abs(value) >= LEAST_CORRELATION}


def fit_trace(path: Path, trace: Trace, present: Mapping[str, Any] | None) -> Figures:
    """Figures of a workload trace."""
    diurnal = 3
    values = read_utilisation(path, trace)
    basis = trace_basis(values.size, trace.annual, diurnal, trace.weekly)
    c, residual = climatology(values, basis)
    return {
        "fitted_to": trace.fitted_to,
        "sd": significant(residual.std(), 4),
        **memory_of(residual, present),
        "D": diurnal,
        "W": trace.weekly,
        "annual": trace.annual,
        "c": c,
        "q": percentiles(values),
    }


def fit(
    folder: Path, present: Figures, *, sites: Sequence[str] = (), refit: bool = False
) -> Figures:
    """All figures, or the present ones with those of some sites fitted.

    Args:
        folder: measured files.
        present: figures whose memories are kept.
        sites: keys of ``PLACES``; none fits all of them and the traces.
        refit: fit all memories.

    Raises:
        FileNotFoundError: a file is missing.
    """

    def known(part: str, name: str) -> Any:
        return None if refit else present[part].get(name)

    weather, grid = (dict(present[part]) if sites else {} for part in ("weather", "grid"))
    for name in sites or PLACES:
        place = PLACES[name]
        weather[name] = fit_weather(
            _only(folder, f"weather/USA_{name}_*.epw"), place, known("weather", name)
        )
        grid[name] = fit_grid(
            _only(folder, f"carbon/{name}_NG_*.csv"),
            place,
            round(weather[name]["utc_offset"]),
            known("grid", name),
        )
    traces = {
        name: fit_trace(_only(folder, f"workload/{trace.file}"), trace, known("workload", name))
        for name, trace in ({} if sites else TRACES).items()
    }
    return {
        "format": "sdc-coefficients/1",
        "time": "row k = interval [k%24, k%24+1) of day k//24, local standard time, 365 days, "
        "no DST",
        "pins_percent": list(PERCENTILES),
        "emission_factors_g_per_kwh": EMISSION_FACTORS_G_PER_KWH,
        "weather": weather,
        "grid": grid,
        "workload": traces or present["workload"],
    }


def _only(folder: Path, pattern: str) -> Path:
    files = sorted(folder.glob(pattern))
    if not files:
        raise FileNotFoundError(f"{folder}: no file {pattern}")
    return files[0]


def as_text(figures: Figures) -> str:
    """JSON with one line for each site, grid and trace."""

    def compact(value: Any) -> str:
        return json.dumps(value, separators=(",", ":"))

    def entry(key: str, value: Any) -> str:
        if key not in ("weather", "grid", "workload"):
            return f'"{key}":{compact(value)}'
        lines = [f' "{name}":{compact(inner)}' for name, inner in value.items()]
        return f'"{key}":{{\n' + ",\n".join(lines) + "\n}"

    return "{\n" + ",\n".join(entry(*item) for item in figures.items()) + "\n}\n"


def main() -> None:
    """Fit, and write the file."""
    parser = argparse.ArgumentParser(description="Fit the embedded synthetic year.")
    parser.add_argument("folder", type=Path, help="measured files: weather, carbon, workload")
    parser.add_argument("out", type=Path, help="file to write")
    parser.add_argument(
        "--site",
        action="append",
        default=[],
        choices=PLACES,
        help="fit this site alone; repeatable",
    )
    parser.add_argument("--refit", action="store_true", help="fit the memories of residuals too")
    options = parser.parse_args()
    figures = fit(options.folder, coefficients(), sites=options.site, refit=options.refit)
    options.out.write_text(as_text(figures), "utf-8")


if __name__ == "__main__":
    main()
