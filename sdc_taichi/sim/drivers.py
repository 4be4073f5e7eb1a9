"""Inputs of a fleet over time: weather, carbon intensity of the grid, and demand.

Every series is brought to the time step once per site; a step reads one value per data center.
Series may differ in length; each repeats from its own beginning.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.carbon import MAX_CI_G_PER_KWH
from sdc_taichi.exogenous.registry import load_site, load_trace, site_from_files
from sdc_taichi.exogenous.series import OUTDOOR_LIMITS_C, Series, SiteData, resample
from sdc_taichi.exogenous.workload import read_workload
from sdc_taichi.exogenous.year_clock import day_of_year
from sdc_taichi.types import F64, I64, Exogenous

DESIGN_QUANTILE = 0.996
"""Share of the year that a design temperature covers, the 0.4 % of ASHRAE design conditions."""


@dataclass(frozen=True, slots=True)
class FleetSeries:
    """One series over time for each data center, equal series stored once.

    Series may differ in length; each repeats after its last value.
    """

    values: F64
    """All distinct series end to end, (T,)."""
    offsets: I64
    """Where in ``values`` the series of each data center begins, (B,)."""
    lengths: I64
    """Number of values of each data center's series, (B,)."""

    def at(self, index: I64) -> F64:
        """Values of every data center at steps of its series.

        Args:
            index: a step of each data center, (B,), or several, (B, n); beyond the end of a series
                it begins anew.

        Returns:
            Same shape.
        """
        if index.ndim > 1:
            return self.values.take(self.offsets[:, None] + index % self.lengths[:, None])
        return self.values.take(self.places(index))

    def places(self, index: I64) -> I64:
        """Where in ``values`` a step of each data center's series lies, (B,)."""
        return self.offsets + index % self.lengths

    def sharing_places(self, other: FleetSeries) -> FleetSeries:
        """Copy that shares the offset and length arrays of ``other`` where they are equal.

        Series that share both arrays are read at places that are computed once.
        """
        offsets, lengths = (
            theirs if np.array_equal(own, theirs) else own
            for own, theirs in ((self.offsets, other.offsets), (self.lengths, other.lengths))
        )
        return FleetSeries(self.values, offsets, lengths)

    def distinct(self) -> tuple[list[F64], I64]:
        """The distinct series, and the number of the one that each data center reads, (B,)."""
        parts, which = np.unique(
            np.stack([self.offsets, self.lengths], axis=1), axis=0, return_inverse=True
        )
        return [self.values[first : first + n] for first, n in parts], which.reshape(-1)


@dataclass(frozen=True, slots=True)
class Drivers:
    """Weather, carbon intensity and demand of a fleet over time."""

    outdoor_c: FleetSeries
    """Outdoor dry-bulb temperature, in C."""
    wet_bulb_c: FleetSeries
    """Outdoor wet-bulb temperature, in C."""
    ci_g_per_kwh: FleetSeries
    """Carbon intensity of the grid, in g CO2e/kWh."""
    demand: FleetSeries
    """Work that arrives in a step, as a share of the capacity, 0..1."""
    start: I64
    """First simulated step, counted from the beginning of the year, (B,)."""
    design_outdoor_c: F64
    """Dry bulb that the year exceeds for 0.4 % of its steps, in C, (B,)."""
    design_wet_bulb_c: F64
    """Wet bulb that the year exceeds for 0.4 % of its steps, in C, (B,)."""
    sources: tuple[dict[str, str], ...]
    """Source of weather, carbon and workload of each data center; synthetic ones say so, B."""
    synthetic: tuple[bool, ...]
    """Whether any series of a data center is synthetic, B."""
    notes: tuple[str, ...]
    """Repairs and warnings of the loaders, each text once."""

    @property
    def size(self) -> int:
        """Number of data centers."""
        return len(self.start)

    def digest(self) -> bytes:
        """SHA-256 of all series; equal inputs have equal digests."""
        sha = hashlib.sha256()
        for series in (self.outdoor_c, self.wet_bulb_c, self.ci_g_per_kwh, self.demand):
            for array in (series.values, series.offsets, series.lengths):
                sha.update(array.tobytes())
        return sha.digest()

    def at(self, step: int) -> Exogenous:
        """Inputs of step ``step`` after reset."""
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
        )


def load_drivers(configs: Sequence[DataCenterConfig]) -> Drivers:
    """Read or generate the inputs that the site and workload sections name.

    Raises:
        ConfigError: an unknown site or trace.
        DataError: a file that is not valid.
    """
    steps_per_hour = configs[0].simulation.steps_per_hour
    read_sites: dict[object, _SiteInputs] = {}
    read_traces: dict[object, _TraceInputs] = {}
    sites, traces = [], []
    for config in configs:
        site = config.site
        site_key = (
            site.location,
            site.seed,
            site.weather_file,
            site.carbon_file,
            site.carbon_pairing,
        )
        if site_key not in read_sites:
            read_sites[site_key] = _read_site(config, steps_per_hour)
        sites.append(read_sites[site_key])
        trace_key = site.workload_file or (config.workload.trace, site.seed)
        if trace_key not in read_traces:
            read_traces[trace_key] = _read_trace(config, steps_per_hour)
        traces.append(read_traces[trace_key])
    days = np.array([day_of_year(c.site.start) for c in configs], dtype=np.int64)
    outdoor_c = _fleet_series([site.outdoor_c for site in sites])
    inputs = list(zip(sites, traces, strict=True))
    return Drivers(
        outdoor_c=outdoor_c,
        wet_bulb_c=_fleet_series([x.wet_bulb_c for x in sites]).sharing_places(outdoor_c),
        ci_g_per_kwh=_fleet_series([x.ci_g_per_kwh for x in sites]).sharing_places(outdoor_c),
        demand=_fleet_series([x.demand for x in traces]).sharing_places(outdoor_c),
        start=days * 24 * steps_per_hour,
        design_outdoor_c=np.array([site.design_outdoor_c for site in sites]),
        design_wet_bulb_c=np.array([site.design_wet_bulb_c for site in sites]),
        sources=tuple(
            {
                "weather": site.data.outdoor_c.source,
                "carbon": site.data.ci_g_per_kwh.source,
                "workload": trace.series.source,
            }
            for site, trace in inputs
        ),
        synthetic=tuple(
            any(s.synthetic for s in (site.data.outdoor_c, site.data.ci_g_per_kwh, trace.series))
            for site, trace in inputs
        ),
        notes=tuple(dict.fromkeys(note for pair in inputs for note in _notes(*pair))),
    )


def drivers_from_arrays(
    outdoor_c: npt.ArrayLike,
    wet_bulb_c: npt.ArrayLike,
    ci_g_per_kwh: npt.ArrayLike,
    demand: npt.ArrayLike,
    *,
    size: int = 1,
    source: str = "arrays",
) -> Drivers:
    """Inputs given as arrays at the simulation's time step; the first value is that of step 0.

    Args:
        outdoor_c: dry bulb, -90..60 C, (T,) for all data centers or (B, T).
        wet_bulb_c: wet bulb, not above the dry bulb, in C, (T,) or (B, T).
        ci_g_per_kwh: carbon intensity, 0..2,000 g CO2e/kWh, (T,) or (B, T).
        demand: arriving work as a share of the capacity, 0..1, (T,) or (B, T).
        size: number of data centers for arrays of shape (T,).
        source: text for the provenance.

    Raises:
        DataError: shapes that differ, or values that are not finite or out of range.
    """
    given = {
        "outdoor_c": outdoor_c,
        "wet_bulb_c": wet_bulb_c,
        "ci_g_per_kwh": ci_g_per_kwh,
        "demand": demand,
    }
    rows = {
        name: np.atleast_2d(np.asarray(value, dtype=np.float64)) for name, value in given.items()
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
        **{name: _fleet_series(list(value)) for name, value in rows.items()},
        start=np.zeros(size, dtype=np.int64),
        design_outdoor_c=np.quantile(rows["outdoor_c"], DESIGN_QUANTILE, axis=1),
        design_wet_bulb_c=np.quantile(rows["wet_bulb_c"], DESIGN_QUANTILE, axis=1),
        sources=({"weather": source, "carbon": source, "workload": source},) * size,
        synthetic=(False,) * size,
        notes=(),
    )


@dataclass(frozen=True, slots=True)
class _SiteInputs:
    """Weather and carbon intensity of one site at the time step of the simulation, each (T,)."""

    data: SiteData
    outdoor_c: F64
    wet_bulb_c: F64
    ci_g_per_kwh: F64
    design_outdoor_c: float
    design_wet_bulb_c: float


@dataclass(frozen=True, slots=True)
class _TraceInputs:
    """A workload trace, and its demand at the time step of the simulation, (T,)."""

    series: Series
    demand: F64


def _read_site(config: DataCenterConfig, steps_per_hour: int) -> _SiteInputs:
    site = config.site
    base = load_site(site.location, seed=site.seed)
    data = site_from_files(
        base, weather=site.weather_file, carbon=site.carbon_file, pairing=site.carbon_pairing
    )
    outdoor_c = resample(data.outdoor_c, steps_per_hour)
    wet_bulb_c = resample(data.wet_bulb_c, steps_per_hour)
    ci_g_per_kwh = resample(data.ci_g_per_kwh, steps_per_hour)
    if site.carbon_pairing == "utc_rows" and site.carbon_file is None:
        # Local hour k gets the row of UTC hour k; files come with that pairing already.
        ci_g_per_kwh = np.roll(ci_g_per_kwh, -round(data.utc_offset_h * steps_per_hour))
    return _SiteInputs(
        data=data,
        outdoor_c=outdoor_c,
        wet_bulb_c=wet_bulb_c,
        ci_g_per_kwh=ci_g_per_kwh,
        design_outdoor_c=float(np.quantile(outdoor_c, DESIGN_QUANTILE)),
        design_wet_bulb_c=float(np.quantile(wet_bulb_c, DESIGN_QUANTILE)),
    )


def _read_trace(config: DataCenterConfig, steps_per_hour: int) -> _TraceInputs:
    file = config.site.workload_file
    series = (
        load_trace(config.workload.trace, seed=config.site.seed)
        if file is None
        else read_workload(file)
    )
    return _TraceInputs(series, resample(series, steps_per_hour))


def _notes(site: _SiteInputs, trace: _TraceInputs) -> tuple[str, ...]:
    series = (site.data.outdoor_c, site.data.wet_bulb_c, site.data.ci_g_per_kwh, trace.series)
    return tuple(f"{s.source}: {note}" for s in series for note in s.notes)


def _fleet_series(series: Sequence[F64]) -> FleetSeries:
    """Join one series per data center; the very same array is stored once."""
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
