"""Input time series of a fleet: weather, carbon intensity of the grid, demand and prices.

Every series is resampled to the time step once per site; a step reads one value per data center.
Series may differ in length; each repeats from its beginning after its last value.
"""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, DataError
from sdc_taichi.exogenous.carbon import MAX_CI_G_PER_KWH, Pairing
from sdc_taichi.exogenous.registry import load_site, load_trace, site_from_files
from sdc_taichi.exogenous.series import (
    DESIGN_QUANTILE,
    OUTDOOR_LIMITS_C,
    Series,
    SiteData,
    rarely_exceeded,
    resample,
)
from sdc_taichi.exogenous.workload import read_workload
from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR, TYPICAL_YEAR, day_of_year, step_times
from sdc_taichi.types import F64, I64, Exogenous

MAX_KEPT_BYTES = 2**28
"""Maximum memory of the cache of input series, in bytes: about 900 synthetic years of a site and a
trace."""


def common_digits(values: F64) -> bytes:
    """Return the bytes of ``values`` rounded to f32.

    The rounding hides differences in the last bits of f64 results between processors.
    """
    with np.errstate(over="ignore", under="ignore"):
        return values.astype(np.float32).tobytes()


@dataclass(frozen=True, slots=True)
class FleetSeries:
    """One time series for each of B data centers; series that several share are stored once.

    Series may differ in length; each repeats after its last value.
    """

    values: F64
    """All distinct series, concatenated, (T,)."""
    offsets: I64
    """Index into ``values`` of the first value of each data center's series, (B,)."""
    lengths: I64
    """Number of values of each data center's series, (B,)."""

    def at(self, index: I64) -> F64:
        """Return the values of every data center at the given steps, in the shape of ``index``.

        Args:
            index: One step of each data center, (B,), or several, (B, n); a step beyond the end of
                a series continues from its beginning.
        """
        if index.ndim > 1:
            return self.values.take(self.offsets[:, None] + index % self.lengths[:, None])
        return self.values.take(self.places(index))

    def places(self, index: I64) -> I64:
        """Return the index into ``values`` of step ``index`` of each data center's series, (B,)."""
        return self.offsets + index % self.lengths

    def sharing_places(self, other: FleetSeries) -> FleetSeries:
        """Return a copy that uses the offset and length arrays of ``other`` where they are equal.

        For series that share both arrays, ``Drivers.at`` computes the indices into ``values`` only
        once.
        """
        offsets, lengths = (
            theirs if np.array_equal(mine, theirs) else mine
            for mine, theirs in ((self.offsets, other.offsets), (self.lengths, other.lengths))
        )
        return FleetSeries(self.values, offsets, lengths)

    def take(self, where: Sequence[int]) -> FleetSeries:
        """Return the series of some data centers, without the values of the other data centers.

        Args:
            where: Indices of the data centers; an index may occur more than once.
        """
        chosen = list(where)
        first_places: dict[tuple[int, int], int] = {}
        pieces, offsets, end = [], [], 0
        for part in zip(self.offsets[chosen].tolist(), self.lengths[chosen].tolist(), strict=True):
            if part not in first_places:
                offset, length = part
                first_places[part] = end
                pieces.append(self.values[offset : offset + length])
                end += length
            offsets.append(first_places[part])
        return FleetSeries(np.concatenate(pieces), np.array(offsets), self.lengths[chosen])

    def distinct(self) -> tuple[list[F64], I64]:
        """Return the list of distinct series, and each data center's index into it, (B,)."""
        parts, which = np.unique(
            np.stack([self.offsets, self.lengths], axis=1), axis=0, return_inverse=True
        )
        return [self.values[first : first + n] for first, n in parts], which.reshape(-1)


@dataclass(frozen=True, slots=True)
class Drivers:
    """Input time series of a fleet of B data centers."""

    outdoor_c: FleetSeries
    """Outdoor dry-bulb temperature, in C."""
    wet_bulb_c: FleetSeries
    """Outdoor wet-bulb temperature, in C."""
    ci_g_per_kwh: FleetSeries
    """Carbon intensity of the grid, in g CO2e/kWh."""
    demand: FleetSeries
    """Arriving work of a step as a share of capacity, 0..1."""
    start: I64
    """First simulated step, counted from the beginning of the year in local standard time, (B,).
    Sites of a fleet that shares work begin at the same time in UTC."""
    year: I64
    """Calendar year of the first step in time stamps, (B,): that of the config, or else that of the
    weather, of the carbon intensity or of the workload, or else ``TYPICAL_YEAR``."""
    utc_offset_h: F64
    """Local standard time minus UTC, in h, (B,)."""
    place_deg: F64
    """Latitude and longitude of the weather station, in degrees north and east, nan if they are not
    known, (B, 2)."""
    design_outdoor_c: F64
    """Design dry bulb in C, (B,): that of the weather file, or else the dry bulb exceeded in 0.4 %
    of the year."""
    design_wet_bulb_c: F64
    """Design wet bulb in C, (B,): that of the weather file, or else the wet bulb exceeded in 0.4 %
    of the year."""
    sources: tuple[dict[str, str], ...]
    """Text on the source of the weather, carbon and workload series, one dict per data center."""
    synthetic: tuple[bool, ...]
    """True for each data center that has a synthetic series."""
    notes: tuple[str, ...]
    """Repairs and warnings of the loaders, without duplicates."""
    price_per_kwh: FleetSeries | None = None
    """Price of a kWh from the grid, in the currency of the tariff; None uses the config's
    tariff."""

    @property
    def size(self) -> int:
        """Number of data centers."""
        return len(self.start)

    def take(self, where: Sequence[int]) -> Drivers:
        """Return the inputs of some data centers, without the series of the other data centers.

        Args:
            where: Indices of the data centers; an index may occur more than once.
        """
        chosen, price = list(where), self.price_per_kwh
        first = self.outdoor_c.take(chosen)
        return replace(
            self,
            outdoor_c=first,
            wet_bulb_c=self.wet_bulb_c.take(chosen).sharing_places(first),
            ci_g_per_kwh=self.ci_g_per_kwh.take(chosen).sharing_places(first),
            demand=self.demand.take(chosen).sharing_places(first),
            price_per_kwh=None if price is None else price.take(chosen).sharing_places(first),
            start=self.start[chosen],
            year=self.year[chosen],
            utc_offset_h=self.utc_offset_h[chosen],
            place_deg=self.place_deg[chosen],
            design_outdoor_c=self.design_outdoor_c[chosen],
            design_wet_bulb_c=self.design_wet_bulb_c[chosen],
            sources=tuple(self.sources[i] for i in chosen),
            synthetic=tuple(self.synthetic[i] for i in chosen),
        )

    def times(self, steps: I64, steps_per_hour: int) -> npt.NDArray[np.datetime64]:
        """Return the local standard time at which each of n steps begins, (n, B).

        Args:
            steps: Steps, counted from 0 at reset, (n,).
            steps_per_hour: Number of steps in an hour.
        """
        return step_times(self.start, steps, steps_per_hour, self.year)

    def digest(self) -> bytes:
        """Return the SHA-256 of all series.

        Values are rounded to f32, so that inputs computed on different processors, which differ in
        the last bits, normally have equal digests.
        """
        sha = hashlib.sha256()
        all_series = (self.outdoor_c, self.wet_bulb_c, self.ci_g_per_kwh, self.demand)
        for series in (*all_series, *(() if self.price_per_kwh is None else (self.price_per_kwh,))):
            sha.update(common_digits(series.values))
            for array in (series.offsets, series.lengths):
                sha.update(array.tobytes())
        return sha.digest()

    def at(self, step: int) -> Exogenous:
        """Return the inputs of step ``step``, counted from 0 at reset."""
        index, first = self.start + step, self.outdoor_c
        places = first.places(index)

        def read(series: FleetSeries) -> F64:
            shared = series.offsets is first.offsets and series.lengths is first.lengths
            return series.values.take(places if shared else series.places(index))

        return Exogenous(
            outdoor_c=read(first),
            wet_bulb_c=read(self.wet_bulb_c),
            ci_g_per_kwh=read(self.ci_g_per_kwh),
            demand=read(self.demand),
            price_per_kwh=(
                np.zeros(self.size) if self.price_per_kwh is None else read(self.price_per_kwh)
            ),
        )


class InputReader:
    """Reads the inputs of a fleet as configured, or for other years and workload traces.

    Inputs are cached up to ``MAX_KEPT_BYTES``; the least recently used ones are evicted first.
    """

    def __init__(self, configs: Sequence[DataCenterConfig]) -> None:
        self._steps_per_hour = configs[0].simulation.steps_per_hour
        self._sites = [_site_key(config) for config in configs]
        self._traces = [
            _trace_key(c.site.workload_file or c.workload.trace, c.site.seed, c.site.workload_file)
            for c in configs
        ]
        self._days = np.array([day_of_year(c.site.start) for c in configs], dtype=np.int64)
        self._shares_clock = np.array([c.fleet is not None for c in configs])
        self._years = [c.site.year for c in configs]
        self._cache: OrderedDict[_SiteKey | _TraceKey, SiteData | Series] = OrderedDict()
        self._cache_bytes = 0
        self._design_c: tuple[F64, F64] | None = None

    def read(
        self, years: Sequence[int] | None = None, traces: Sequence[str] | None = None
    ) -> Drivers:
        """Read the inputs of the fleet and resample them to its time step.

        Design temperatures always come from the years of the configs, because a data center is
        sized only once.

        Args:
            years: Seed of the synthetic series of each data center; None uses ``site.seed``.
            traces: Workload trace of each data center, by name or file (see ``is_file``); None uses
                the trace of the config.

        Raises:
            ConfigError: A site or trace is unknown.
            DataError: A file is not valid.
        """
        site_keys, trace_keys = self._sites, self._traces
        if traces is not None:
            trace_keys = [
                _trace_key(trace, site.seed, trace if is_file(trace) else None)
                for trace, site in zip(traces, site_keys, strict=True)
            ]
        if years is not None:
            site_keys = self._of_years(site_keys, years)
            trace_keys = self._of_years(trace_keys, years)
        sites = {key: self._site(key) for key in dict.fromkeys(site_keys)}
        series = {key: self._trace(key) for key in dict.fromkeys(trace_keys)}
        of_sites = {key: self._site_arrays(key, site) for key, site in sites.items()}
        of_traces = {key: resample(x, self._steps_per_hour) for key, x in series.items()}
        if self._design_c is None:
            self._design_c = self._design_temperatures()
        outdoor_c = fleet_series([of_sites[key].outdoor_c for key in site_keys])
        inputs = [(sites[s], series[t]) for s, t in zip(site_keys, trace_keys, strict=True)]
        utc_offset_h = np.array([site.utc_offset_h for site, _ in inputs])
        return Drivers(
            outdoor_c=outdoor_c,
            wet_bulb_c=fleet_series([of_sites[key].wet_bulb_c for key in site_keys]).sharing_places(
                outdoor_c
            ),
            ci_g_per_kwh=fleet_series(
                [of_sites[key].ci_g_per_kwh for key in site_keys]
            ).sharing_places(outdoor_c),
            demand=fleet_series([of_traces[key] for key in trace_keys]).sharing_places(outdoor_c),
            start=local_start(
                self._days * 24 * self._steps_per_hour,
                np.where(self._shares_clock, utc_offset_h, 0.0),
                self._steps_per_hour,
            ),
            year=np.array(
                [
                    _calendar_year(year, site, trace)
                    for year, (site, trace) in zip(self._years, inputs, strict=True)
                ]
            ),
            utc_offset_h=utc_offset_h,
            place_deg=np.array([(site.latitude_deg, site.longitude_deg) for site, _ in inputs]),
            design_outdoor_c=self._design_c[0],
            design_wet_bulb_c=self._design_c[1],
            sources=tuple(
                {
                    "weather": site.outdoor_c.source,
                    "carbon": site.ci_g_per_kwh.source,
                    "workload": trace.source,
                }
                for site, trace in inputs
            ),
            synthetic=tuple(_site_is_synthetic(site) or trace.synthetic for site, trace in inputs),
            notes=tuple(
                dict.fromkeys(
                    note
                    for site, trace in dict.fromkeys(zip(site_keys, trace_keys, strict=True))
                    for note in _notes(sites[site], series[trace])
                )
            ),
        )

    def is_synthetic(self) -> list[bool]:
        """Return True for each data center with a synthetic series, which depends on the seed."""
        return [
            self._is_synthetic(site) or self._is_synthetic(trace)
            for site, trace in zip(self._sites, self._traces, strict=True)
        ]

    def check_trace(self, trace: str) -> Series:
        """Read a workload trace by name or file, to find errors before an episode needs it.

        Raises:
            DataError: The name is unknown or the file is not valid.
        """
        return self._trace(
            _trace_key(trace, self._sites[0].seed, trace if is_file(trace) else None)
        )

    def _of_years(self, keys: Sequence[_Key], years: Sequence[int]) -> list[_Key]:
        """Replace the seed of each synthetic key; measured series do not depend on a seed."""
        synthetic = {key: self._is_synthetic(key) for key in dict.fromkeys(keys)}
        return [
            key._replace(seed=int(year)) if synthetic[key] else key
            for key, year in zip(keys, years, strict=True)
        ]

    def _is_synthetic(self, key: _SiteKey | _TraceKey) -> bool:
        if isinstance(key, _TraceKey):
            return self._trace(key).synthetic
        return _site_is_synthetic(self._site(key))

    def _design_temperatures(self) -> tuple[F64, F64]:
        """Return design dry bulb and wet bulb for the years of the configs, in C, (B,) each."""
        design = {}
        for key in dict.fromkeys(self._sites):
            site = self._site(key)
            design[key] = (
                (rarely_exceeded(site.outdoor_c), rarely_exceeded(site.wet_bulb_c))
                if site.design is None
                else (site.design.outdoor_c, site.design.wet_bulb_c)
            )
        outdoor_c, wet_bulb_c = np.array([design[key] for key in self._sites]).T
        return outdoor_c.copy(), wet_bulb_c.copy()

    def _site(self, key: _SiteKey) -> SiteData:
        site: Any = self._cached(key, _read_site)
        return site  # type: ignore[no-any-return]

    def _trace(self, key: _TraceKey) -> Series:
        trace: Any = self._cached(key, _read_trace)
        return trace  # type: ignore[no-any-return]

    def _cached(
        self, key: _SiteKey | _TraceKey, read: Callable[[Any], SiteData | Series]
    ) -> SiteData | Series:
        if key not in self._cache:
            self._cache[key] = read(key)
            self._cache_bytes += _size_bytes(self._cache[key])
            while self._cache_bytes > MAX_KEPT_BYTES and len(self._cache) > 1:
                self._cache_bytes -= _size_bytes(self._cache.popitem(last=False)[1])
        self._cache.move_to_end(key)
        return self._cache[key]

    def _site_arrays(self, key: _SiteKey, site: SiteData) -> _SiteArrays:
        outdoor_c = resample(site.outdoor_c, self._steps_per_hour)
        wet_bulb_c = resample(site.wet_bulb_c, self._steps_per_hour)
        ci_g_per_kwh = resample(site.ci_g_per_kwh, self._steps_per_hour)
        if key.carbon_pairing == "utc_rows" and key.carbon_file is None:
            # Local hour k gets the row of UTC hour k; carbon files have been paired by the loader.
            ci_g_per_kwh = np.roll(ci_g_per_kwh, -round(site.utc_offset_h * self._steps_per_hour))
        return _SiteArrays(outdoor_c, wet_bulb_c, ci_g_per_kwh)


def load_drivers(configs: Sequence[DataCenterConfig]) -> Drivers:
    """Read or generate the inputs that the ``site`` and ``workload`` sections of configs name.

    Raises:
        ConfigError: A site or trace is unknown.
        DataError: A file is not valid.
    """
    return InputReader(configs).read()


def local_start(start_utc: I64, utc_offset_h: F64, steps_per_hour: int) -> I64:
    """Return first steps in local standard time for first steps in UTC, (B,).

    Both count from the beginning of a year of 8,760 h; a time before it is one of its last hours.

    Args:
        start_utc: First step of each data center in UTC, (B,).
        utc_offset_h: Local standard time minus UTC, in h, (B,); see ``Drivers.utc_offset_h``.
        steps_per_hour: Number of steps in an hour.

    Raises:
        ConfigError: An offset is no whole number of steps.
    """
    steps = utc_offset_h * steps_per_hour
    if np.any(steps != np.rint(steps)):
        offset_h = utc_offset_h[np.argmax(steps != np.rint(steps))]
        raise ConfigError(
            f"simulation.steps_per_hour {steps_per_hour}: a site of the fleet is {offset_h:g} h "
            "from UTC; valid are steps that divide this time"
        )
    local = start_utc + steps.astype(np.int64)
    return np.where(local < 0, local + HOURS_PER_YEAR * steps_per_hour, local)


def utc_start(local_start: I64, utc_offset_h: F64, steps_per_hour: int) -> F64:
    """Return first steps in UTC, within the year, for first steps in local standard time, (B,).

    They are no whole numbers where an offset is no whole number of steps.

    Args:
        local_start: First step of each data center in local standard time, (B,).
        utc_offset_h: Local standard time minus UTC, in h, (B,).
        steps_per_hour: Number of steps in an hour.
    """
    return (local_start - utc_offset_h * steps_per_hour) % (HOURS_PER_YEAR * steps_per_hour)


def is_file(trace: str) -> bool:
    """Return True if ``trace`` is a file path, which contains a dot or a slash, not a name."""
    return "." in trace or "/" in trace or os.sep in trace


def drivers_from_arrays(
    outdoor_c: npt.ArrayLike,
    wet_bulb_c: npt.ArrayLike,
    ci_g_per_kwh: npt.ArrayLike,
    demand: npt.ArrayLike,
    *,
    size: int = 1,
    source: str = "arrays",
) -> Drivers:
    """Create inputs from arrays at the simulation's time step, whose first value is that of step 0.

    Args:
        outdoor_c: Outdoor dry bulb, -90..60 C, (T,) for all data centers or (B, T).
        wet_bulb_c: Outdoor wet bulb, not above the dry bulb, in C, (T,) or (B, T).
        ci_g_per_kwh: Carbon intensity, 0..2,000 g CO2e/kWh, (T,) or (B, T).
        demand: Arriving work as a share of capacity, 0..1, (T,) or (B, T).
        size: Number of data centers for arrays of shape (T,).
        source: Text on the source of the data, for ``Drivers.sources``.

    Raises:
        DataError: Shapes differ, or values are not finite or out of range.
    """
    arrays = {
        "outdoor_c": outdoor_c,
        "wet_bulb_c": wet_bulb_c,
        "ci_g_per_kwh": ci_g_per_kwh,
        "demand": demand,
    }
    rows = {
        name: np.atleast_2d(np.asarray(value, dtype=np.float64)) for name, value in arrays.items()
    }
    size = max([size, *(len(v) for v in rows.values())])
    shape = (size, rows["outdoor_c"].shape[1])
    for name, value in rows.items():
        if len(value) not in (1, size) or value.shape[1] != shape[1] or value.size == 0:
            raise DataError(
                f"{source}: {name} has shape {value.shape}, expected {shape} or {shape[1:]}"
            )
        if not np.all(np.isfinite(value)):
            raise DataError(f"{source}: {name} has values that are not finite")
        rows[name] = np.broadcast_to(value, shape)
    limits: dict[str, tuple[float, float | F64]] = {
        "outdoor_c": OUTDOOR_LIMITS_C,
        "wet_bulb_c": (-100.0, rows["outdoor_c"] + 1e-9),
        "ci_g_per_kwh": (0.0, MAX_CI_G_PER_KWH),
        "demand": (0.0, 1.0),
    }
    for name, (low, high) in limits.items():
        bad = (rows[name] < low) | (rows[name] > high)
        if np.any(bad):
            dc, step = (int(i[0]) for i in np.nonzero(bad))
            valid = "at most the dry bulb" if name == "wet_bulb_c" else f"within {low}..{high}"
            raise DataError(
                f"{source}: {name} of data center {dc} at step {step} is {rows[name][dc, step]:g}; "
                f"valid is {valid}"
            )
    return Drivers(
        **{name: fleet_series(list(value)) for name, value in rows.items()},
        start=np.zeros(size, dtype=np.int64),
        year=np.full(size, TYPICAL_YEAR, dtype=np.int64),
        utc_offset_h=np.zeros(size),
        place_deg=np.full((size, 2), np.nan),
        design_outdoor_c=np.quantile(rows["outdoor_c"], DESIGN_QUANTILE, axis=1),
        design_wet_bulb_c=np.quantile(rows["wet_bulb_c"], DESIGN_QUANTILE, axis=1),
        sources=({"weather": source, "carbon": source, "workload": source},) * size,
        synthetic=(False,) * size,
        notes=(),
    )


class _SiteKey(NamedTuple):
    """Settings that determine the weather and carbon series of a data center."""

    location: str
    """Name of the site."""
    seed: int
    """Seed of the synthetic year."""
    weather_file: str | None
    """Weather file; None uses the built-in weather of the site."""
    carbon_file: str | None
    """Carbon-intensity file; None uses the built-in series of the site."""
    carbon_pairing: Pairing
    """Rule that aligns the carbon series with the weather in time."""


class _TraceKey(NamedTuple):
    """Settings that determine the series of arriving work of a data center."""

    name: str
    """Name of the trace, or its file path."""
    seed: int
    """Seed of the synthetic year."""
    file: str | None
    """File path of the trace; None for a built-in trace."""


_Key = TypeVar("_Key", _SiteKey, _TraceKey)


class _SiteArrays(NamedTuple):
    """Weather and carbon series of one site, resampled to the simulation's time step, (T,) each."""

    outdoor_c: F64
    """Outdoor dry-bulb temperature, in C, (T,)."""
    wet_bulb_c: F64
    """Outdoor wet-bulb temperature, in C, (T,)."""
    ci_g_per_kwh: F64
    """Carbon intensity of the grid, in g CO2e/kWh, (T,)."""


def _site_key(config: DataCenterConfig) -> _SiteKey:
    site = config.site
    return _SiteKey(
        site.location, site.seed, site.weather_file, site.carbon_file, site.carbon_pairing
    )


def _trace_key(name: str, seed: int, file: str | None) -> _TraceKey:
    """Return the key of a trace; the key of a file has seed 0, because a file has no seed."""
    return _TraceKey(name, seed if file is None else 0, file)


def _read_site(key: _SiteKey) -> SiteData:
    """Read weather and carbon intensity, and drop the series that the simulation does not read."""
    base = load_site(key.location, seed=key.seed)
    data = site_from_files(
        base, weather=key.weather_file, carbon=key.carbon_file, pairing=key.carbon_pairing
    )
    return replace(data, relative_humidity_pct=None, pressure_pa=None)


def _read_trace(key: _TraceKey) -> Series:
    return load_trace(key.name, seed=key.seed) if key.file is None else read_workload(key.file)


def _calendar_year(year: int | None, site: SiteData, trace: Series) -> int:
    """Return the calendar year of the first step (``Drivers.year``)."""
    years = (year, *(series.year for series in (site.outdoor_c, site.ci_g_per_kwh, trace)))
    return next((each for each in years if each is not None), TYPICAL_YEAR)


def _site_is_synthetic(site: SiteData) -> bool:
    return site.outdoor_c.synthetic or site.ci_g_per_kwh.synthetic


def _size_bytes(stored: SiteData | Series) -> int:
    if isinstance(stored, Series):
        return stored.values.nbytes
    return sum(_size_bytes(x) for x in (stored.outdoor_c, stored.wet_bulb_c, stored.ci_g_per_kwh))


def _notes(site: SiteData, trace: Series) -> tuple[str, ...]:
    series = (site.outdoor_c, site.wet_bulb_c, site.ci_g_per_kwh, trace)
    return tuple(f"{s.source}: {note}" for s in series for note in s.notes)


def fleet_series(series: Sequence[F64]) -> FleetSeries:
    """Concatenate one series per data center; the same array object is stored only once."""
    offset_of: dict[int, int] = {}
    stored: list[F64] = []
    total = 0
    offsets = []
    for values in series:
        if id(values) not in offset_of:
            offset_of[id(values)] = total
            stored.append(values)
            total += len(values)
        offsets.append(offset_of[id(values)])
    return FleetSeries(
        values=np.concatenate(stored),
        offsets=np.array(offsets, dtype=np.int64),
        lengths=np.array([len(values) for values in series], dtype=np.int64),
    )
