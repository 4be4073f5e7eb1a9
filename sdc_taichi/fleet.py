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
from sdc_taichi.layout import floor_plan, unit_shares
from sdc_taichi.recirculation import (
    DesignPoint,
    RackServers,
    Recirculation,
    calibrate,
    design_point,
    rack_servers,
)
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
    "placement": "workload.placement",
    "thermal": "simulation.thermal",
}
"""Where the config names the model of each stage."""


@dataclass(frozen=True, slots=True)
class HallAir:
    """Recirculation and CRAC supply of all racks."""

    run_start: I32
    """First run of weights of each rack, (R + 1,); see ``recirculation.Exchange``."""
    run_first: I32
    run_length: I32
    run_offset: I32
    weights: F64
    norm: F64
    """(R,)."""
    unit_shares: F64
    """Share of each unit in each rack's supply, rack by rack."""
    share_start: I32
    """First entry of each data center in ``unit_shares``, (B,)."""
    strength: F64
    """Exhaust airflow of each rack over the mean of its hall, (R,)."""
    rise_k: F64
    """How much each rack warms its air at the design point, (R,)."""
    mixed_approach_k: F64
    """Approach temperatures in the exhaust mix before each rack, (R,)."""
    mixed_rise_k: F64
    """Rises in the exhaust mix before each rack, (R,)."""
    captured: F64
    """Recirculated share of each rack's intake where ``height`` is 1, (R,)."""
    table: I32
    """Entry of each data center in the next three, (B,)."""
    supply_c: F64
    """Supply air of the expectations, (H, n)."""
    expected: F64
    """Approach and rise of a mean rack over those at the design point, and what is left of a
    deviation of the exhaust mix after it has passed the racks once; by hall, supply air and load
    of LOADS, (H n len(LOADS), 3)."""


LOADS = np.linspace(0.0, 1.0, 65)


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
    unit_start: I32
    """First CRAC unit of each data center, (B + 1,)."""
    group_start: I32
    """First group of each rack, (R + 1,)."""
    server_start: I32
    """First server of each group, (G + 1,)."""
    approach_k: F64
    """Supply approach temperature, within the limits of the config, (R,)."""
    groups: F64
    """Rows GROUP_ROWS of the thermal kernel, (6, G)."""
    dcs: F64
    """Rows DC_ROWS of the thermal kernel, (18, B)."""
    unit_design_m3s: F64
    """Airflow of each CRAC unit at full speed, (U,)."""
    it_airflow_m3s: F64
    """Airflow through all servers at the design point, (B,)."""
    air: HallAir | None
    """How air moves in the halls; None with inlet model ``approach``."""

    @property
    def units(self) -> int:
        """Number of CRAC units of all data centers."""
        return int(self.unit_start[-1])

    @property
    def unit_dc(self) -> I32:
        """Data center of each CRAC unit, (U,)."""
        return np.repeat(np.arange(self.size, dtype=np.int32), np.diff(self.unit_start))

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
    groups: F64
    approach_k: F64
    dc: F64
    unit_design_m3s: F64
    it_airflow_m3s: float
    shares: F64
    recirculation: Recirculation | None
    captured: F64
    mixed_k: F64
    expected: tuple[F64, F64]


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
    _shared(listed, "simulation.substep_s")
    # One queue array serves the fleet; ages are read off its length.
    _shared(listed, "workload.age_horizon_h")
    _check_names(listed)
    # Data centers that share these sections share one hall, which is laid out once.
    cache: dict[Any, _HallArrays] = {}
    halls = []
    for config in listed:
        key = (config.hall, config.servers, config.hvac)
        if key not in cache:
            cache[key] = _hall_arrays(config)
        halls.append(cache[key])
    racks = np.array([len(h.groups_per_rack) for h in halls])
    return Fleet(
        configs=listed,
        models=models,
        steps_per_hour=steps_per_hour,
        rack_start=_starts(racks),
        rack_dc=np.repeat(np.arange(len(listed), dtype=np.int32), racks),
        group_start=_starts(np.concatenate([h.groups_per_rack for h in halls])),
        server_start=_starts(np.concatenate([h.groups[0] for h in halls])),
        approach_k=np.concatenate([h.approach_k for h in halls]),
        groups=np.concatenate([h.groups for h in halls], axis=1),
        dcs=np.stack([h.dc for h in halls], axis=1),
        unit_start=_starts(np.array([len(h.unit_design_m3s) for h in halls])),
        unit_design_m3s=np.concatenate([h.unit_design_m3s for h in halls]),
        it_airflow_m3s=np.array([h.it_airflow_m3s for h in halls]),
        air=_hall_air(halls) if models["inlet"] == "recirculation" else None,
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
    hall, servers, crac = config.hall, config.servers, config.hvac.crac
    racks = rack_servers(config)
    if racks.count.sum() > MOST_SERVERS:
        raise ConfigError(
            f"{config.name}: {racks.count.sum():.4g} servers; valid is at most {MOST_SERVERS:,}"
        )
    shares = np.ones((hall.racks, 1))
    if hall.inlet_model == "recirculation":
        flows: Recirculation | None = calibrate(config, racks)
        assert flows is not None
        design, captured, fresh_share = flows.design, flows.captured, flows.fresh_share
        shares = (
            unit_shares(floor_plan(hall), crac.units, crac.supply_length_m)
            if crac.unit_shares is None
            else np.array(crac.unit_shares)
        )
        # Units are sized for the racks they supply.
        need = shares.T @ ((1.0 - flows.share) * design.airflow_m3s)
        unit_design_m3s = design.crac_flow_m3s * need / need.sum()
    else:
        flows, captured, fresh_share = None, np.zeros(len(racks.count)), 1.0
        design = design_point(config)
        unit_design_m3s = np.array([design.crac_flow_m3s])
    fan_low, fan_high = servers.fan_airflow_ratio_limits or (-np.inf, np.inf)
    air = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
    dc = (
        *cpu_coefficients(servers),
        *fan_coefficients(servers),
        fan_low,
        fan_high,
        servers.fan_reference_ratio,
        servers.fan_power_exponent,
        servers.fan_reference_w,
        design.fan_full_airflow_m3s,
        air,
        np.inf if servers.curve_limit_c is None else servers.curve_limit_c,
        fresh_share,
        servers.heat_capacity_kj_per_k * 1e3,
        servers.heat_exchange_effectiveness,
        air * floor_plan(hall).air_m3 / hall.racks,
    )
    return _HallArrays(
        groups_per_rack=np.diff(racks.start),
        groups=np.stack(
            [racks.count, racks.full_w, racks.idle_w, racks.offset_k, racks.deviation, racks.height]
        ),
        approach_k=hall.rack_approach_k(),
        dc=np.array(dc),
        unit_design_m3s=unit_design_m3s,
        it_airflow_m3s=float(design.airflow_m3s.sum()),
        shares=shares,
        recirculation=flows,
        captured=racks.per_rack(captured) / racks.per_rack(racks.height),
        mixed_k=_mixed_k(hall.rack_approach_k(), design, flows),
        expected=_expectations(config, racks, design) if flows else (np.zeros(0), np.zeros(0)),
    )


def _mixed_k(approach_k: F64, design: DesignPoint, flows: Recirculation | None) -> F64:
    """Approach temperatures and design rises in the exhaust mix before each rack, (2, R)."""
    if flows is None:
        return np.zeros((2, 0))
    rise_k = design.outlet_rise_k - design.approach_k
    return np.stack([flows.exchange.apply(approach_k), flows.exchange.apply(rise_k)])


def _expectations(
    config: DataCenterConfig, racks: RackServers, design: DesignPoint
) -> tuple[F64, F64]:
    """Where sweeps of the hall start: one mean rack, from up to 32 of the hall, in steady state.

    Returns:
        Supply temperatures, (n,), and what ``HallAir.expected`` holds, (3, n, len(LOADS)).
    """
    servers, setpoint = config.servers, config.hvac.setpoint
    slope, offset, shift = cpu_coefficients(servers)
    every = max(1, config.hall.racks // 16)
    chosen = np.zeros(config.hall.racks, dtype=np.bool_)
    chosen[::every] = True
    group = racks.per_group(chosen.astype(np.float64)) > 0
    count, full_w, idle_w = racks.count[group], racks.full_w[group], racks.idle_w[group]
    approach_k = (racks.per_group(design.approach_k) * design.height)[group]
    limit_c = np.inf if servers.curve_limit_c is None else servers.curve_limit_c
    approach = float(design.approach_k[chosen].mean())
    rise_k = float((design.outlet_rise_k - design.approach_k)[chosen].mean())

    def outlet(scale: F64, supply_c: F64, load: F64) -> tuple[F64, F64]:
        """Inlet over supply air in K, weighted by airflow, and heat over airflow."""
        inlet_k = scale[..., None] * approach_k
        on_curve = np.minimum(supply_c[..., None] + inlet_k, limit_c)
        load = load[..., None]
        ratio = config.airflow_ratio(supply_c[..., None] + inlet_k, load)
        heat_w = np.maximum(idle_w, full_w * (slope * on_curve + offset + shift * load))
        fan_w = servers.fan_reference_w * (ratio / servers.fan_reference_ratio) ** (
            servers.fan_power_exponent
        )
        flow = np.sum(count * ratio, axis=-1)
        inlet = np.sum(count * ratio * inlet_k, axis=-1) / flow
        return inlet, np.sum(count * (heat_w + fan_w), axis=-1) / flow

    one = np.ones((1, 1))
    per_w = rise_k / outlet(one, one * design.supply_c, one)[1]
    setpoints_c = np.linspace(setpoint.min_c, setpoint.max_c, 16)
    at, load = np.broadcast_arrays(setpoints_c[:, None], LOADS[None, :])

    def mixed(scale: F64) -> F64:
        inlet_k, heat = outlet(scale, at, load)
        return np.asarray((inlet_k + heat * per_w) / (approach + rise_k))

    def kept(scale: F64) -> F64:
        return np.asarray(np.clip((mixed(scale + 1e-4) - mixed(scale)) / 1e-4, -0.9, 0.9))

    scale = np.ones(at.shape)
    for _ in range(8):
        before = scale
        scale = before + (mixed(before) - before) / (1.0 - kept(before))
        if np.max(np.abs(scale - before)) < 1e-9:
            break
    inlet_k, heat = outlet(scale, at, load)
    parts = inlet_k / max(approach, 1e-9), heat * per_w / rise_k, kept(scale)
    return setpoints_c, np.stack(parts)


def _hall_air(halls: Sequence[_HallArrays]) -> HallAir:
    """Exchanges end to end; copies of a hall share its weights."""
    found = [h.recirculation for h in halls if h.recirculation is not None]
    tables: dict[int, int] = {}
    weights: list[F64] = []
    total = 0
    first_rack = 0
    firsts, offsets, lengths, runs = [], [], [], []
    for flows in found:
        exchange = flows.exchange
        if id(exchange) not in tables:
            tables[id(exchange)] = total
            weights.append(exchange.weights)
            total += len(exchange.weights)
        firsts.append(exchange.first + first_rack)
        offsets.append(exchange.offset.astype(np.int64) + tables[id(exchange)])
        lengths.append(exchange.length)
        runs.append(np.diff(exchange.run_start))
        first_rack += len(exchange.norm)
    sizes = np.array([h.shares.size for h in halls])
    distinct = list({id(h): h for h in halls}.values())
    entries = {id(h): i for i, h in enumerate(distinct)}
    return HallAir(
        run_start=_starts(np.concatenate(runs)),
        run_first=np.concatenate(firsts).astype(np.int32),
        run_length=np.concatenate(lengths),
        run_offset=np.concatenate(offsets).astype(np.int32),
        weights=np.concatenate(weights),
        norm=np.concatenate([f.exchange.norm for f in found]),
        strength=np.concatenate([f.exchange.strength for f in found]),
        mixed_approach_k=np.concatenate([h.mixed_k[0] for h in halls]),
        mixed_rise_k=np.concatenate([h.mixed_k[1] for h in halls]),
        captured=np.concatenate([h.captured for h in halls]),
        unit_shares=np.concatenate([h.shares.reshape(-1) for h in halls]),
        share_start=_starts(sizes)[:-1],
        rise_k=np.concatenate([f.design.outlet_rise_k - f.design.approach_k for f in found]),
        table=np.array([entries[id(h)] for h in halls], dtype=np.int32),
        supply_c=np.stack([h.expected[0] for h in distinct]),
        expected=np.concatenate([h.expected[1].reshape(3, -1).T for h in distinct]),
    )


def _starts(counts: npt.NDArray[Any]) -> I32:
    starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    if starts[-1] > MOST_SERVERS:
        raise ConfigError(f"fleet: {starts[-1]:,} servers; valid is at most {MOST_SERVERS:,}")
    return starts.astype(np.int32)
