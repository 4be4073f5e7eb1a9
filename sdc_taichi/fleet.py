"""Many data centers of any size as flat arrays: racks, server groups and servers by offsets."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import (
    DataCenterConfig,
    cpu_coefficients,
    fan_coefficients,
    with_values,
)
from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F64

I32 = npt.NDArray[np.int32]

MOST_SERVERS = int(np.iinfo(np.int32).max)
STAGE_MODELS = {
    "inlet": "hall.inlet_model",
    "outlet": "servers.outlet_model",
    "setpoint": "hvac.setpoint.model",
    "crac_flow": "hvac.crac.flow_model",
    "cooling_load": "hvac.cooling_load_model",
    "chiller": "hvac.chiller.model",
    "tower": "hvac.tower.model",
    "pumps": "hvac.pumps.model",
    "water": "hvac.water.model",
    "sizing": "hvac.sizing.model",
    "battery": "battery.model",
    "workload": "workload.model",
}
"""Where the config names the model of each stage."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """Data centers that run in one simulator; B of them, R racks, G server groups, S servers.

    All of them share the stage models, the time step and the age horizon of the queue; size, site,
    season and every other parameter may differ.
    """

    configs: tuple[DataCenterConfig, ...]
    models: Mapping[str, str]
    steps_per_hour: int
    rack_start: I32
    """First rack of each data center, (B + 1,)."""
    rack_dc: I32
    """Data center of each rack, (R,)."""
    group_start: I32
    """First group of each rack, (R + 1,)."""
    server_start: I32
    """First server of each group, (G + 1,)."""
    approach_k: F64
    """Supply approach temperature, within the limits of the config, (R,)."""
    groups: F64
    """Rows GROUP_ROWS of the thermal kernel, (5, G)."""
    dcs: F64
    """Rows DC_ROWS of the thermal kernel, (14, B)."""

    @property
    def size(self) -> int:
        """Number of data centers."""
        return len(self.configs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the data centers, unique."""
        return tuple(c.name for c in self.configs)

    @property
    def racks(self) -> int:
        """Number of racks of all data centers."""
        return len(self.rack_dc)

    @property
    def servers(self) -> int:
        """Number of servers of all data centers."""
        return int(self.server_start[-1])

    def values(self, path: str) -> F64:
        """A numeric config field of every data center, (B,); None becomes nan."""
        found = [reduce(getattr, path.split("."), c) for c in self.configs]
        return np.array([np.nan if v is None else v for v in found], dtype=np.float64)

    def per_dc_servers(self) -> F64:
        """Servers of each data center, (B,)."""
        counts = np.diff(self.server_start[self.group_start[self.rack_start]])
        return counts.astype(np.float64)

    def server_rack(self) -> I32:
        """Rack of each server, (S,)."""
        per_rack = np.diff(self.server_start[self.group_start])
        return np.repeat(np.arange(self.racks, dtype=np.int32), per_rack)


@dataclass(frozen=True, slots=True)
class _HallArrays:
    groups_per_rack: I32
    counts: I32
    groups: F64
    approach_k: F64
    dc: F64


def build_fleet(configs: DataCenterConfig | Iterable[DataCenterConfig]) -> Fleet:
    """Lay data centers out as flat arrays.

    Raises:
        ConfigError: no data center, equal names, or stage models, time steps or age horizons that
            differ.
    """
    listed = (configs,) if isinstance(configs, DataCenterConfig) else tuple(configs)
    for config in listed:
        if not isinstance(config, DataCenterConfig):
            raise ConfigError(
                f"fleet: {config!r} is no DataCenterConfig; load_config reads presets and files"
            )
    if not listed:
        raise ConfigError("fleet: no data center given; valid is at least one")
    models = {stage: _shared(listed, path) for stage, path in STAGE_MODELS.items()}
    steps_per_hour = _shared(listed, "simulation.steps_per_hour")
    _shared(listed, "hvac.total_of")
    # One queue array serves the fleet; ages are read off its length.
    _shared(listed, "workload.age_horizon_h")
    _check_names(listed)
    # Copies share their hall and server sections, which are laid out once.
    cache: dict[tuple[int, int], _HallArrays] = {}
    for config in listed:
        key = (id(config.hall), id(config.servers))
        if key not in cache:
            cache[key] = _hall_arrays(config)
    halls = [cache[id(c.hall), id(c.servers)] for c in listed]
    racks = np.array([len(h.groups_per_rack) for h in halls])
    return Fleet(
        configs=listed,
        models=models,
        steps_per_hour=steps_per_hour,
        rack_start=_starts(racks),
        rack_dc=np.repeat(np.arange(len(listed), dtype=np.int32), racks),
        group_start=_starts(np.concatenate([h.groups_per_rack for h in halls])),
        server_start=_starts(np.concatenate([h.counts for h in halls])),
        approach_k=np.concatenate([h.approach_k for h in halls]),
        groups=np.concatenate([h.groups for h in halls], axis=1),
        dcs=np.stack([h.dc for h in halls], axis=1),
    )


def make_configs(
    base: DataCenterConfig,
    *,
    count: int | None = None,
    sites: Sequence[str] = (),
    sample: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> list[DataCenterConfig]:
    """Copies of one data center over sites, with domain randomisation.

    Args:
        base: the data center to copy.
        count: number of copies; None is one per site. Sites are dealt in turn.
        sites: location names; empty keeps the location of ``base``.
        sample: config path to ``{"uniform": [low, high]}`` or ``{"choice": [a, b, ...]}``.
        seed: seed of the sampling; copy i draws the same values whatever ``count`` is.

    Raises:
        ConfigError: count below 1, or a sampling rule or drawn value that is not valid.
    """
    if isinstance(sites, str):
        raise ConfigError(f"sites {sites!r}: valid is a list of names")
    count = max(len(sites), 1) if count is None else count
    if count < 1:
        raise ConfigError(f"fleet: {count} data centers; valid is at least 1")
    if count < len(sites):
        raise ConfigError(
            f"fleet: {count} data centers for {len(sites)} sites; valid is at least one per site"
        )
    rules = dict(sample or {})
    for path, rule in rules.items():
        _check_rule(base, path, rule)
    out = []
    for index in range(count):
        config = base
        if sites:
            site = base.site.model_copy(update={"location": sites[index % len(sites)].upper()})
            config = config.model_copy(update={"site": site})
        if rules:
            rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, index])))
            config = with_values(config, {path: _draw(rule, rng) for path, rule in rules.items()})
        stem = config.site.location.lower()
        name = stem if count <= max(len(sites), 1) else f"{stem}-{index:0{len(str(count - 1))}d}"
        out.append(config.model_copy(update={"name": name}))
    return out


def _check_rule(base: DataCenterConfig, path: str, rule: Any) -> None:
    where = f"sample {path}"
    if not isinstance(rule, Mapping) or len(rule) != 1:
        raise ConfigError(f"{where}: valid is {{uniform: [low, high]}} or {{choice: [a, b, ...]}}")
    ((kind, values),) = rule.items()
    if kind not in ("uniform", "choice"):
        near = difflib.get_close_matches(str(kind), ("uniform", "choice"), n=1)
        raise ConfigError(
            f"{where}: unknown kind {kind!r}; valid: uniform, choice"
            + (f" (did you mean {near[0]!r}?)" if near else "")
        )
    if not isinstance(values, list | tuple) or not values:
        raise ConfigError(f"{where}: {kind} needs a list, got {values!r}")
    if kind == "uniform":
        numbers = all(isinstance(v, int | float) and abs(v) < np.inf for v in values)
        numbers &= not any(isinstance(v, bool) for v in values)
        if len(values) != 2 or not numbers or not values[0] <= values[1]:
            raise ConfigError(
                f"{where}: uniform needs [low, high] with low <= high, got {values!r}"
            )
    with_values(base, {path: values[0]})


def _draw(rule: Mapping[str, Any], rng: np.random.Generator) -> Any:
    ((kind, values),) = rule.items()
    if kind == "choice":
        return values[int(rng.integers(len(values)))]
    low, high = values
    if isinstance(low, int) and isinstance(high, int):
        return int(rng.integers(low, high + 1))
    return float(rng.uniform(low, high))


def _shared(configs: Sequence[DataCenterConfig], path: str) -> Any:
    found = [reduce(getattr, path.split("."), c) for c in configs]
    for config, value in zip(configs, found, strict=True):
        if value != found[0]:
            raise ConfigError(
                f"fleet: {path} is {found[0]!r} in {configs[0].name} and {value!r} in "
                f"{config.name}; it must be the same in all data centers of a fleet"
            )
    return found[0]


def _check_names(configs: Sequence[DataCenterConfig]) -> None:
    seen: set[str] = set()
    for config in configs:
        if config.name in seen:
            raise ConfigError(f"fleet: the name {config.name!r} is used twice; names must differ")
        seen.add(config.name)


def _hall_arrays(config: DataCenterConfig) -> _HallArrays:
    hall, servers = config.hall, config.servers
    per_rack = config.rack_groups()
    columns = []
    for rack in per_rack:
        mean = sum(g.count * g.load_weight for g in rack) / sum(g.count for g in rack)
        columns += [
            (g.count, g.full_w, g.idle_w, g.inlet_offset_k, g.load_weight / mean - 1.0)
            for g in rack
        ]
    groups = np.array(columns, dtype=np.float64).T
    if groups[0].sum() > MOST_SERVERS:
        raise ConfigError(
            f"{config.name}: {groups[0].sum():.4g} servers; valid is at most {MOST_SERVERS:,}"
        )
    fan_low, fan_high = servers.fan_airflow_ratio_limits or (-np.inf, np.inf)
    dc = (
        *cpu_coefficients(servers),
        *fan_coefficients(servers),
        fan_low,
        fan_high,
        servers.fan_reference_ratio,
        servers.fan_power_exponent,
        servers.fan_reference_w,
        servers.fan_full_airflow_m3s,
        hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k,
        np.inf if servers.curve_limit_c is None else servers.curve_limit_c,
    )
    return _HallArrays(
        groups_per_rack=np.array([len(rack) for rack in per_rack], dtype=np.int32),
        counts=groups[0].astype(np.int32),
        groups=groups,
        approach_k=hall.rack_approach_k(),
        dc=np.array(dc),
    )


def _starts(counts: npt.NDArray[Any]) -> I32:
    starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    if starts[-1] > MOST_SERVERS:
        raise ConfigError(f"fleet: {starts[-1]:,} servers; valid is at most {MOST_SERVERS:,}")
    return starts.astype(np.int32)
