"""What drives each data center of a fleet over time: weather, carbon intensity and demand.

Every series is resampled to the time step once per site; a step gathers one entry per data center.
Series may differ in length; each repeats from its own start.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.registry import load_site, load_trace, site_from_files
from sdc_taichi.exogenous.series import Series, SiteData, resample
from sdc_taichi.exogenous.workload import read_workload
from sdc_taichi.types import F64, I64, Exogenous
from sdc_taichi.year_clock import day_of_year

DESIGN_QUANTILE = 0.996
"""Share of the year that a design temperature covers, the 0.4 % of ASHRAE design conditions."""


@dataclass(frozen=True, slots=True)
class Table:
    """Series of several data centers end to end; data center i reads ``length[i]`` entries."""

    values: F64
    offset: I64
    length: I64

    def at(self, index: I64) -> F64:
        """Entry ``index`` of every data center, repeating, (B,), or entries, (B, n)."""
        if index.ndim > 1:
            return self.values.take(self.offset[:, None] + index % self.length[:, None])
        return self.values.take(self.entries(index))

    def entries(self, index: I64) -> I64:
        """Where in ``values`` entry ``index`` of every data center is, (B,)."""
        return self.offset + index % self.length

    def aligned(self, other: Table) -> Table:
        """This table, with the very places of ``other`` where they are the same."""
        offset, length = (
            theirs if np.array_equal(mine, theirs) else mine
            for mine, theirs in ((self.offset, other.offset), (self.length, other.length))
        )
        return Table(self.values, offset, length)

    def distinct(self) -> tuple[list[F64], I64]:
        """The distinct series, and which of them each data center reads, (B,)."""
        parts, which = np.unique(
            np.stack([self.offset, self.length], axis=1), axis=0, return_inverse=True
        )
        return [self.values[first : first + n] for first, n in parts], which.reshape(-1)


@dataclass(frozen=True, slots=True)
class Drivers:
    """Exogenous inputs of a fleet."""

    outdoor_c: Table
    wet_bulb_c: Table
    ci_g_per_kwh: Table
    demand: Table
    start: I64
    """Index of the first step in the year, (B,)."""
    design_outdoor_c: F64
    design_wet_bulb_c: F64
    sources: tuple[dict[str, str], ...]
    """Where each series of each data center comes from; synthetic ones say so."""
    synthetic: tuple[bool, ...]
    """Whether any series of the data center is synthetic."""
    notes: tuple[str, ...]
    """What the loaders repaired or warned of, each text once."""

    @property
    def size(self) -> int:
        """Number of data centers."""
        return len(self.start)

    def digest(self) -> bytes:
        """SHA-256 of the series, which tells inputs apart."""
        sha = hashlib.sha256()
        for table in (self.outdoor_c, self.wet_bulb_c, self.ci_g_per_kwh, self.demand):
            for array in (table.values, table.offset, table.length):
                sha.update(array.tobytes())
        return sha.digest()

    def at(self, step: int) -> Exogenous:
        """Inputs of step ``step`` after reset."""
        index, first = self.start + step, self.outdoor_c
        entries = first.entries(index)

        def read(table: Table) -> F64:
            alike = table.offset is first.offset and table.length is first.length
            return table.values.take(entries if alike else table.entries(index))

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
    sites: dict[object, _Site] = {}
    traces: dict[object, tuple[Series, F64]] = {}
    chosen: list[tuple[_Site, tuple[Series, F64]]] = []
    for config in configs:
        site, work = config.site, config.workload
        site_key = (
            site.location,
            site.seed,
            site.weather_file,
            site.carbon_file,
            site.carbon_pairing,
        )
        if site_key not in sites:
            sites[site_key] = _read_site(config, steps_per_hour)
        trace_key = site.workload_file or (work.trace, site.seed)
        if trace_key not in traces:
            trace = (
                read_workload(site.workload_file)
                if site.workload_file is not None
                else load_trace(work.trace, seed=site.seed)
            )
            traces[trace_key] = (trace, resample(trace, steps_per_hour))
        chosen.append((sites[site_key], traces[trace_key]))
    days = np.array([day_of_year(c.site.start) for c in configs], dtype=np.int64)
    outdoor_c = _table([site.outdoor_c for site, _ in chosen])
    return Drivers(
        outdoor_c=outdoor_c,
        wet_bulb_c=_table([site.wet_bulb_c for site, _ in chosen]).aligned(outdoor_c),
        ci_g_per_kwh=_table([site.ci_g_per_kwh for site, _ in chosen]).aligned(outdoor_c),
        demand=_table([values for _, (_, values) in chosen]).aligned(outdoor_c),
        start=days * 24 * steps_per_hour,
        design_outdoor_c=np.array([site.design_outdoor_c for site, _ in chosen]),
        design_wet_bulb_c=np.array([site.design_wet_bulb_c for site, _ in chosen]),
        sources=tuple(
            {
                "weather": site.data.outdoor_c.source,
                "carbon": site.data.ci_g_per_kwh.source,
                "workload": trace.source,
            }
            for site, (trace, _) in chosen
        ),
        synthetic=tuple(
            site.data.outdoor_c.synthetic or site.data.ci_g_per_kwh.synthetic or trace.synthetic
            for site, (trace, _) in chosen
        ),
        notes=tuple(
            dict.fromkeys(note for site, (trace, _) in chosen for note in _notes(site, trace))
        ),
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
    """Inputs at the simulation's time step, from step 0 on.

    Args:
        outdoor_c: dry bulb, (T,) for all data centers or (B, T).
        wet_bulb_c: wet bulb, not above dry bulb, as above.
        ci_g_per_kwh: carbon intensity, not negative, as above.
        demand: arriving work as a share of capacity, 0..1, as above.
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
        "outdoor_c": (-90.0, 70.0),
        "wet_bulb_c": (-90.0, rows["outdoor_c"] + 1e-9),
        "ci_g_per_kwh": (0.0, np.inf),
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
        **{name: _table(list(value)) for name, value in rows.items()},
        start=np.zeros(size, dtype=np.int64),
        design_outdoor_c=np.quantile(rows["outdoor_c"], DESIGN_QUANTILE, axis=1),
        design_wet_bulb_c=np.quantile(rows["wet_bulb_c"], DESIGN_QUANTILE, axis=1),
        sources=({"weather": source, "carbon": source, "workload": source},) * size,
        synthetic=(False,) * size,
        notes=(),
    )


@dataclass(frozen=True, slots=True)
class _Site:
    data: SiteData
    outdoor_c: F64
    wet_bulb_c: F64
    ci_g_per_kwh: F64
    design_outdoor_c: float
    design_wet_bulb_c: float


def _read_site(config: DataCenterConfig, steps_per_hour: int) -> _Site:
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
    return _Site(
        data=data,
        outdoor_c=outdoor_c,
        wet_bulb_c=wet_bulb_c,
        ci_g_per_kwh=ci_g_per_kwh,
        design_outdoor_c=float(np.quantile(outdoor_c, DESIGN_QUANTILE)),
        design_wet_bulb_c=float(np.quantile(wet_bulb_c, DESIGN_QUANTILE)),
    )


def _notes(site: _Site, trace: Series) -> tuple[str, ...]:
    series = (site.data.outdoor_c, site.data.wet_bulb_c, site.data.ci_g_per_kwh, trace)
    return tuple(f"{s.source}: {note}" for s in series for note in s.notes)


def _table(rows: Sequence[F64]) -> Table:
    """Put each distinct row once; rows are told apart by identity."""
    first: dict[int, int] = {}
    parts: list[F64] = []
    total = 0
    offsets = []
    for row in rows:
        if id(row) not in first:
            first[id(row)] = total
            parts.append(row)
            total += len(row)
        offsets.append(first[id(row)])
    return Table(
        values=np.concatenate(parts),
        offset=np.array(offsets, dtype=np.int64),
        length=np.array([len(row) for row in rows], dtype=np.int64),
    )
