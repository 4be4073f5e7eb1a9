"""Fleet of data centers of any size as flat arrays: racks, server groups and servers by offsets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.hall_schema import MOST_RACK_J_PER_K, SERVER_J_PER_K_W
from sdc_taichi.config.odd_values import warn_of, warn_of_odd_values
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.design_point import design_point, odd_airflow
from sdc_taichi.hall.exposure import TileAir
from sdc_taichi.hall.floor_plan import floor_plan, return_shares, unit_shares
from sdc_taichi.hall.initial_guess import SteadyStateTable, initial_guess
from sdc_taichi.hall.mix_weights import DENSE_RACKS, MixWeights
from sdc_taichi.hall.rack_servers import RackServers, air_properties, rack_servers
from sdc_taichi.hall.recirculation import Recirculation, calibrate
from sdc_taichi.hall.steady_modes import SteadyModes
from sdc_taichi.hall.unit_supply import full_airflow_m3s, unit_weights, weighted_shares
from sdc_taichi.kernels.arguments import in_row_order
from sdc_taichi.kernels.hall_arguments import DC_COEFFICIENTS, GROUP_INPUTS
from sdc_taichi.plant.liquid import LiquidFleet
from sdc_taichi.sim.events import Places
from sdc_taichi.sim.fleet_configs import with_sites
from sdc_taichi.sim.liquid_fleet import liquid_fleet
from sdc_taichi.sim.shared_work import SharedWork, shared_work
from sdc_taichi.types import F64, I32

MOST_ENTRIES = int(np.iinfo(np.int32).max)
"""Maximum number of racks, servers or other entries of a fleet, limited by the kernels' int32
indices."""
NO_LIMIT_W = 1e30
"""Capacity of a coil without a configured limit, in W; sums of it do not overflow f32."""
MOST_UNIT_SHARES = 2**25
"""Maximum number of pairs of rack and CRAC unit in a hall; each pair takes 12 bytes."""
STAGE_MODELS = {
    "inlet": "hall.inlet_model",
    "outlet": "servers.outlet_model",
    "setpoint": "hvac.setpoint.model",
    "crac_flow": "hvac.crac.flow_model",
    "cooling_load": "hvac.cooling_load_model",
    "plant": "hvac.plant",
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
"""Config path of the model name of each stage."""
SHARED_FIELDS = (
    *STAGE_MODELS.values(),
    "simulation.steps_per_hour",
    "hvac.total_of",
    "hvac.tower.setpoint",
    "electrical.losses",
    "simulation.substep_s",
    "workload.age_horizon_h",  # It is the length of the queue array, which the fleet shares.
)
"""Config paths whose values must be equal in all data centers of a fleet."""


SteadyStates = SteadyStateTable | Callable[[SteadyModes], SteadyStateTable]
"""Table of steady states of a hall of up to DENSE_RACKS; for larger halls, the function that
computes the table of the racks that the modes of the hall sample."""


@dataclass(frozen=True, slots=True)
class HallAir:
    """Recirculation and CRAC supply of the R racks of B data centers."""

    mix_weights: MixWeights
    """Weights of the racks' exhausts in the exhaust mix before each rack, for all racks of the
    fleet; copies of a hall share their weights."""
    exhaust_share: F64
    """Share of exhaust air in each rack's intake, for a server of height factor 1, (R,)."""
    unit_shares: F64
    """Share of each CRAC unit in the supply of each rack of its data center, flat: all racks in
    order, and for each rack the units of its data center."""
    rack_need_m3s: F64
    """Supply air that each rack draws in at the design point, in m3/s, (R,)."""
    return_shares: F64 | None
    """Share of each CRAC unit in the returns of each rack, in the order of ``unit_shares``; 0 in
    data centers whose units draw common return air. None if all do."""
    tiles: tuple[TileAir, ...]
    """Exhaust shares at other airflows of the racks, for each distinct hall; empty for sampled
    racks, which are loaded alike."""
    unit_share_offsets: I32
    """First entry of each data center in ``unit_shares``, and the number of entries, (B + 1,)."""
    steady_states: tuple[SteadyStates, ...]
    """Source of the solver's initial guesses for each distinct hall."""
    steady_state_of_dc: I32
    """Index of each data center's hall in ``steady_states``, (B,)."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """Data centers that run in one simulator, as flat arrays.

    The B data centers have R racks, U CRAC units, G server groups and S servers in total. Fields
    listed in ``SHARED_FIELDS`` are equal in all data centers; size, site, season and every other
    parameter may differ.
    """

    configs: tuple[DataCenterConfig, ...]
    """Configuration of each data center, (B,)."""
    models: Mapping[str, str]
    """Model name of each stage of ``STAGE_MODELS``."""
    steps_per_hour: int
    """Number of steps in an hour."""
    rack_offsets: I32
    """First rack of each data center, and the number of racks, (B + 1,)."""
    rack_dc: I32
    """Index of each rack's data center, (R,)."""
    unit_offsets: I32
    """First CRAC unit of each data center, and the number of units, (B + 1,)."""
    group_offsets: I32
    """First server group of each rack, and the number of groups, (R + 1,)."""
    server_offsets: I32
    """First server of each group, and the number of servers, (G + 1,)."""
    approach_k: F64
    """Approach temperature of each rack (mean inlet minus supply temperature), in K, (R,): as
    configured, or with recirculation the value at the design point."""
    group_rows: tuple[F64, ...]
    """Per data center, the rows ``GROUP_INPUTS`` of the hall kernels, (9, groups of the data
    center); equal halls share one array."""
    dcs: F64
    """Rows ``DC_COEFFICIENTS`` of the hall kernels, (18, B)."""
    unit_design_m3s: F64
    """Airflow of each CRAC unit at full speed, in m3/s, (U,)."""
    design_flow_m3s: F64
    """Airflow of all CRAC units at the design point, in m3/s, (B,)."""
    unit_capacity_w: F64
    """Maximum heat that the coil of each CRAC unit removes, in W, (U,); ``NO_LIMIT_W`` if
    unlimited."""
    setpoint_over_supply_k: F64
    """Setpoint of the CRAC units minus their coldest supply temperature, in K, (B,): with control
    of the return air the design temperature rise from supply to return, else 0."""
    plenum_coupling: F64
    """Exponent of the weights by which the shares of the CRAC units in the racks' supply follow
    their airflow, 0..1, (B,); 0 with a single unit."""
    oversupply_decay: F64
    """Decay of exhaust shares per excess of supply over need, dimensionless, (B,)."""
    own_return: npt.NDArray[np.bool_]
    """True if each CRAC unit draws its own return air, (B,); False with a single unit."""
    liquid_racks: I32
    """Index of each liquid-cooled rack among all racks, (L,)."""
    manifold_offsets: I32
    """First manifold (secondary coolant loop) of each data center, and the number of manifolds,
    (B + 1,)."""
    cdu_offsets: I32
    """First coolant distribution unit (CDU) of each data center, and the number of CDUs,
    (B + 1,)."""
    liquid: LiquidFleet | None
    """Liquid-cooled racks with their manifolds, CDUs and facility loops; None without any."""
    air: HallAir | None
    """Recirculation and CRAC supply; None with inlet model ``approach``."""
    shared_work: SharedWork | None
    """Links and budgets of fleets of sites that share work; None if all data centers run alone."""

    @property
    def sites_per_fleet(self) -> int:
        """Number S of consecutive data centers that share work; 1 if all run alone."""
        return 1 if self.shared_work is None else self.shared_work.allowed.shape[1]

    @property
    def units(self) -> int:
        """Number of CRAC units of all data centers."""
        return int(self.unit_offsets[-1])

    @property
    def unit_dc(self) -> I32:
        """Index of each CRAC unit's data center, (U,)."""
        return np.repeat(np.arange(self.size, dtype=np.int32), np.diff(self.unit_offsets))

    @property
    def places(self) -> Places:
        """Racks, CRAC units and CDUs, which events affect."""
        return Places(self.rack_offsets, self.unit_offsets, self.cdu_offsets, self.liquid_racks)

    @property
    def cdus(self) -> int:
        """Number of coolant distribution units (CDUs) of all data centers."""
        return int(self.cdu_offsets[-1])

    @property
    def cdu_dc(self) -> I32:
        """Index of each CDU's data center, (C,)."""
        return np.repeat(np.arange(self.size, dtype=np.int32), np.diff(self.cdu_offsets))

    @property
    def manifold_dc(self) -> I32:
        """Index of each manifold's data center, (M,)."""
        return np.repeat(np.arange(self.size, dtype=np.int32), np.diff(self.manifold_offsets))

    @property
    def design_speed(self) -> F64:
        """Speed of the CRAC fans at the design point, as a share of full speed, (B,).

        The speed is limited to the range from the fans' minimum speed to 1. At minimum speed, units
        that are far too large supply more than the design airflow.
        """
        speed = self.design_flow_m3s / self.unit_sums(self.unit_design_m3s)
        # Round-off in the sums must not keep units that are just large enough from full speed.
        speed = np.where(speed > 1.0 - 1e-9, 1.0, speed)
        return np.maximum(speed, self.values("hvac.crac.min_flow_ratio"))

    @property
    def size(self) -> int:
        """Number of data centers."""
        return len(self.configs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the data centers; only run folders and recordings require distinct names."""
        return tuple(c.name for c in self.configs)

    @property
    def racks(self) -> int:
        """Number of racks of all data centers."""
        return len(self.rack_dc)

    @property
    def groups(self) -> int:
        """Number of server groups of all data centers."""
        return len(self.server_offsets) - 1

    @property
    def servers(self) -> int:
        """Number of servers of all data centers."""
        return int(self.server_offsets[-1])

    def require_distinct_names(self) -> None:
        """Check that the names of the data centers are distinct.

        Raises:
            ConfigError: Two data centers have the same name.
        """
        seen: set[str] = set()
        for name in self.names:
            if name in seen:
                raise ConfigError(f"fleet: the name {name!r} is used twice; names must differ")
            seen.add(name)

    def values(self, path: str) -> F64:
        """Return a numeric config field of every data center, (B,); None becomes nan."""
        return np.array([*map(attrgetter(path), self.configs)], dtype=np.float64)

    def unit_sums(self, values: npt.ArrayLike) -> F64:
        """Sum values of CRAC units, (U,), within each data center, (B,)."""
        return _sums(values, self.unit_offsets)

    def rack_sums(self, values: npt.ArrayLike) -> F64:
        """Sum values of racks, (R,), within each data center, (B,)."""
        return _sums(values, self.rack_offsets)

    def group_sums(self, values: npt.ArrayLike) -> F64:
        """Sum values of server groups, (G,), within each rack, (R,)."""
        return _sums(values, self.group_offsets)

    def per_group_servers(self) -> F64:
        """Return the number of servers of each group, (G,)."""
        return np.diff(self.server_offsets).astype(np.float64)

    def per_rack_servers(self) -> F64:
        """Return the number of servers of each rack, (R,)."""
        return np.diff(self.server_offsets[self.group_offsets]).astype(np.float64)

    def per_dc_servers(self) -> F64:
        """Return the number of servers of each data center, (B,)."""
        counts = np.diff(self.server_offsets[self.group_offsets[self.rack_offsets]])
        return counts.astype(np.float64)

    def server_rack(self) -> I32:
        """Return the index of each server's rack, (S,)."""
        per_rack = np.diff(self.server_offsets[self.group_offsets])
        return np.repeat(np.arange(self.racks, dtype=np.int32), per_rack)


@dataclass(frozen=True, slots=True)
class _HallArrays:
    """Arrays of one hall of R racks, G server groups and U CRAC units."""

    groups_per_rack: I32
    """Number of server groups of each rack, (R,)."""
    groups: F64
    """Rows ``GROUP_INPUTS`` of the hall kernels, (9, G)."""
    approach_k: F64
    """Mean inlet temperature of each rack minus supply temperature at the design point, in K,
    (R,)."""
    dc: F64
    """Rows ``DC_COEFFICIENTS`` of the hall kernels, (18,)."""
    unit_design_m3s: F64
    """Airflow of each CRAC unit at full speed, in m3/s, (U,)."""
    design_flow_m3s: float
    """Airflow of all CRAC units at the design point, in m3/s."""
    setpoint_over_supply_k: float
    """Setpoint of the CRAC units minus their coldest supply temperature, in K."""
    air: _Air | None
    """Recirculation and CRAC supply; None with inlet model ``approach``."""
    liquid_racks: I32
    """Index of each liquid-cooled rack, (racks with liquid cooling,)."""
    odd: tuple[str, ...]
    """Warnings about unusual airflows of the hall."""


@dataclass(frozen=True, slots=True)
class _Air:
    """Recirculation and CRAC supply of one hall of R racks and U CRAC units."""

    mix_weights: MixWeights
    """Weights of the racks' exhausts in the exhaust mix before each rack."""
    exhaust_share: F64
    """Share of exhaust air in each rack's intake, for a server of height factor 1, (R,)."""
    unit_shares: F64
    """Share of each CRAC unit in the supply of each rack, (R, U)."""
    return_shares: F64 | None
    """Share of each CRAC unit in the returns of each rack, (R, U); None if they have one return."""
    rack_need_m3s: F64
    """Supply air that each rack draws in at the design point, in m3/s, (R,)."""
    tiles: TileAir
    """Exhaust shares at other airflows of the racks."""
    steady_states: SteadyStates
    """Source of the solver's initial guesses."""


def build_fleet(configs: DataCenterConfig | Iterable[DataCenterConfig]) -> Fleet:
    """Arrange data centers as flat arrays.

    Args:
        configs: One data center or fleet that shares work, or several; a config of a fleet stands
            for the data centers of its sites.

    Raises:
        ConfigError: There is no data center, a field of ``SHARED_FIELDS`` differs, or sites do not
            fit together.

    Warns:
        OddInputWarning: A value is valid, but probably a mistake.
    """
    listed = _listed(configs)
    warn_of_odd_values(listed)
    shared = {path: _shared(listed, path) for path in SHARED_FIELDS}
    models = {stage: shared[path] for stage, path in STAGE_MODELS.items()}
    models["plant"] = listed[0].hvac.plant_in_use
    models["chiller"] = listed[0].hvac.chiller_in_use
    halls = _distinct_halls(listed)
    warn_of([(config.name, hall.odd) for config, hall in zip(listed, halls, strict=True)])
    racks = np.array([len(h.groups_per_rack) for h in halls])
    rack_offsets = offsets_from_counts(racks, "racks")
    cdus = [None if config.liquid is None else config.liquid.cdus for config in listed]
    return Fleet(
        configs=listed,
        models=models,
        steps_per_hour=shared["simulation.steps_per_hour"],
        rack_offsets=rack_offsets,
        rack_dc=np.repeat(np.arange(len(listed), dtype=np.int32), racks),
        group_offsets=offsets_from_counts(
            np.concatenate([h.groups_per_rack for h in halls]), "server groups"
        ),
        server_offsets=offsets_from_counts(np.concatenate([h.groups[0] for h in halls]), "servers"),
        approach_k=np.concatenate([h.approach_k for h in halls]),
        group_rows=tuple(h.groups for h in halls),
        dcs=np.stack([h.dc for h in halls], axis=1),
        unit_offsets=offsets_from_counts(
            np.array([len(h.unit_design_m3s) for h in halls]), "CRAC units"
        ),
        unit_design_m3s=np.concatenate([h.unit_design_m3s for h in halls]),
        design_flow_m3s=np.array([h.design_flow_m3s for h in halls]),
        unit_capacity_w=np.concatenate([_capacity_w(config) for config in listed]),
        setpoint_over_supply_k=np.array([h.setpoint_over_supply_k for h in halls]),
        plenum_coupling=np.array([c.hvac.crac.coupling for c in listed]),
        oversupply_decay=np.array([c.oversupply_decay for c in listed]),
        own_return=np.array(
            [c.hvac.crac.draws_own_return and models["inlet"] == "recirculation" for c in listed]
        ),
        liquid_racks=np.concatenate(
            [h.liquid_racks + first for h, first in zip(halls, rack_offsets, strict=False)]
        ),
        manifold_offsets=offsets_from_counts(
            [0 if c is None else c.manifolds for c in cdus], "manifolds"
        ),
        cdu_offsets=offsets_from_counts([0 if c is None else c.count for c in cdus], "CDUs"),
        liquid=liquid_fleet(listed),
        air=_hall_air(halls) if models["inlet"] == "recirculation" else None,
        shared_work=shared_work(listed),
    )


def shared_values(config: DataCenterConfig) -> tuple[Any, ...]:
    """Return the values of ``SHARED_FIELDS``, which must be equal for configs of one fleet."""
    return tuple(attrgetter(path)(config) for path in SHARED_FIELDS)


def _listed(configs: DataCenterConfig | Iterable[DataCenterConfig]) -> tuple[DataCenterConfig, ...]:
    """Return the configs of a fleet as a tuple, checked for type and for being non-empty."""
    listed = (configs,) if isinstance(configs, DataCenterConfig) else tuple(configs)
    for config in listed:
        if not isinstance(config, DataCenterConfig):
            raise ConfigError(
                f"fleet: {config!r} is no DataCenterConfig; load_config reads presets and files"
            )
    if not listed:
        raise ConfigError("fleet: no data center given; valid is at least one")
    return tuple(with_sites(listed))


def _distinct_halls(configs: Sequence[DataCenterConfig]) -> list[_HallArrays]:
    """Build the arrays of each data center's hall, once for data centers with equal halls."""
    cache: dict[Any, _HallArrays] = {}
    # Copies of a data center share section objects; comparing ids avoids slow field comparisons.
    by_ids: dict[Any, _HallArrays] = {}
    halls = []
    for config in configs:
        # The density of the air depends on the site unless it is configured.
        place = None
        if config.hall.air_density_kg_m3 is None:
            place = config.site.location, config.site.weather_file
        ids = (*map(id, (config.hall, config.servers, config.hvac)), place)
        if ids not in by_ids:
            setpoint = config.hvac.setpoint
            range_c = setpoint.min_c, setpoint.max_c
            key = config.hall, config.servers, config.hvac.crac, range_c, place
            if key not in cache:
                cache[key] = _remembered_arrays(config)
            by_ids[ids] = cache[key]
        halls.append(by_ids[ids])
    return halls


_REMEMBERED: dict[Any, _HallArrays] = {}
"""Arrays of recently built halls of up to ``DENSE_RACKS`` racks, oldest first."""
_MOST_REMEMBERED = 64


def _remembered_arrays(config: DataCenterConfig) -> _HallArrays:
    """Return the arrays of a hall, which a process keeps for the next fleet if they are small.

    The calibration of a small hall takes longer than the rest of a simulator's construction.
    """
    hall, crac, setpoint = config.hall, config.hvac.crac, config.hvac.setpoint
    # A file may change between two fleets.
    if hall.racks > DENSE_RACKS or hall.recirculation.matrix_file is not None:
        return _hall_arrays(config)
    air = air_properties(config)
    key = hall, config.servers, crac, setpoint.min_c, setpoint.max_c, air
    arrays = _REMEMBERED.pop(key, None) or _hall_arrays(config)
    _REMEMBERED[key] = arrays
    while len(_REMEMBERED) > _MOST_REMEMBERED:
        _REMEMBERED.pop(next(iter(_REMEMBERED)), None)
    return arrays


def _shared(configs: Sequence[DataCenterConfig], path: str) -> Any:
    """Return the value of a config field, checked to be equal in all data centers."""
    values = [*map(attrgetter(path), configs)]
    for config, value in zip(configs, values, strict=True):
        if value != values[0]:
            raise ConfigError(
                f"fleet: {path} is {values[0]!r} in {configs[0].name} and {value!r} in "
                f"{config.name}; it must be the same in all data centers of a fleet"
            )
    return values[0]


def _hall_arrays(config: DataCenterConfig) -> _HallArrays:
    """Build the arrays of the hall of one data center."""
    hall, curves = config.hall, config.servers.curves
    servers = rack_servers(config)
    if servers.count.sum() > MOST_ENTRIES:
        raise ConfigError(
            f"{config.name}: {servers.count.sum():.4g} servers; valid is at most {MOST_ENTRIES:,}"
        )
    air, approach_k, fresh_share = None, hall.rack_approach_k(), 1.0
    if hall.inlet_model == "recirculation":
        recirculation = calibrate(config, servers)
        design, fresh_share = recirculation.design, recirculation.fresh_share
        approach_k = design.approach_k
        shares, unit_design_m3s = _unit_supply(config, recirculation)
        of_groups = servers.per_rack(recirculation.group_exhaust_share)
        steady_states: SteadyStates = partial(initial_guess, config, servers, recirculation)
        if hall.racks <= DENSE_RACKS:
            steady_states = initial_guess(config, servers, recirculation)
        air = _Air(
            mix_weights=recirculation.mix_weights,
            exhaust_share=of_groups / servers.per_rack(servers.height_factor),
            unit_shares=shares,
            return_shares=_return_shares(config, recirculation.need_m3s, unit_design_m3s),
            rack_need_m3s=recirculation.need_m3s,
            tiles=recirculation.tiles,
            steady_states=steady_states,
        )
    else:
        design = design_point(config, servers)
        unit_design_m3s = np.array([design.crac_flow_m3s])
    air_j_per_m3_k = servers.air.j_per_m3_k
    server_j_per_k = _server_heat_capacity_j_per_k(config, servers)
    full_airflow = design.full_airflow_m3s / design.full_airflow_m3s.max()
    least_j_per_k = float((server_j_per_k / full_airflow).min())
    groups = _group_inputs(servers, full_airflow) | {
        "heat_capacity": server_j_per_k / least_j_per_k
    }
    of_lines = asdict(curves)
    del of_lines["cpu_knees"], of_lines["fan_knees"]
    coefficients = of_lines | {
        "fan_full_m3s": float(design.full_airflow_m3s.max()),
        "fan_reference_w": float(servers.fan_reference_w.max()),
        "air_j_per_m3_k": air_j_per_m3_k,
        "fresh_share": fresh_share,
        "server_j_per_k": least_j_per_k,
        "effectiveness": config.servers.heat_exchange_effectiveness,
        "parcel_j_per_k": air_j_per_m3_k * floor_plan(hall).air_m3 / hall.racks,
    }
    return _HallArrays(
        odd=odd_airflow(config, servers, design),
        groups_per_rack=np.diff(servers.group_offsets),
        groups=np.stack(in_row_order(GROUP_INPUTS, groups)),
        approach_k=approach_k,
        dc=np.array(in_row_order(DC_COEFFICIENTS, coefficients)),
        unit_design_m3s=unit_design_m3s,
        design_flow_m3s=design.crac_flow_m3s,
        setpoint_over_supply_k=design.setpoint_over_supply_k(config),
        air=air,
        liquid_racks=np.array([*config.liquid_racks()], dtype=np.int32),
    )


def _capacity_w(config: DataCenterConfig) -> F64:
    """Return the maximum heat that the coil of each CRAC unit removes, in W, (U,)."""
    crac = config.hvac.crac
    limit_w = NO_LIMIT_W if crac.capacity_kw is None else 1e3 * np.asarray(crac.capacity_kw)
    return np.broadcast_to(np.asarray(limit_w, np.float64), (crac.units,))


def _unit_supply(config: DataCenterConfig, recirculation: Recirculation) -> tuple[F64, F64]:
    """Return unit shares in the racks' supply, (R, U), and full-speed airflows, in m3/s, (U,)."""
    crac, racks = config.hvac.crac, config.hall.racks
    if racks * crac.units > MOST_UNIT_SHARES:
        raise ConfigError(
            f"{config.name}: hvac.crac.units {crac.units:,} for {racks:,} racks makes "
            f"{racks * crac.units:,} shares of supply air; valid is at most "
            f"{MOST_UNIT_SHARES // racks:,} units"
        )
    if crac.unit_shares is not None:
        shares = np.array(crac.unit_shares)
    else:
        shares = unit_shares(floor_plan(config.hall), crac.units, crac.supply_length_m)
    need_m3s, design_m3s = recirculation.need_m3s, recirculation.design.crac_flow_m3s
    airflow_m3s = full_airflow_m3s(crac, shares.T @ need_m3s, design_m3s)
    # Configured shares that come with configured airflows are those of the real units.
    measured = crac.unit_shares is not None and crac.airflow_m3s is not None
    if not crac.sized_by_need and not measured:
        # Units with a large airflow supply more of each rack than distance alone suggests.
        shares = weighted_shares(shares, unit_weights(shares, need_m3s, airflow_m3s))
    return shares, airflow_m3s


def _return_shares(config: DataCenterConfig, need_m3s: F64, unit_m3s: F64) -> F64 | None:
    """Return the unit shares in the racks' returns at the design point, (R, U); None if common.

    Args:
        config: The data center.
        need_m3s: Supply air that each rack draws in at the design point, and returns, m3/s, (R,).
        unit_m3s: Airflow of each unit at full speed, m3/s, (U,).
    """
    crac = config.hvac.crac
    if not crac.draws_own_return:
        return None
    shares = return_shares(floor_plan(config.hall), crac.units, crac.supply_length_m)
    return weighted_shares(shares, unit_weights(shares, need_m3s, unit_m3s))


def _server_heat_capacity_j_per_k(config: DataCenterConfig, servers: RackServers) -> F64:
    """Return the heat capacity of one server of each group, in J/K, (G,)."""
    kj_per_k = config.servers.heat_capacity_kj_per_k
    if kj_per_k is None:
        rack_j_per_k = SERVER_J_PER_K_W * servers.per_rack(servers.count * servers.full_w)
        scale = np.minimum(1.0, MOST_RACK_J_PER_K / np.maximum(rack_j_per_k, 1e-30))
        return SERVER_J_PER_K_W * servers.full_w * servers.per_group(scale)
    return np.full(len(servers.full_w), 1e3 * kj_per_k)


def _group_inputs(servers: RackServers, full_airflow: F64) -> dict[str, F64]:
    """Return the rows of ``GROUP_INPUTS`` that depend on servers and air, by name, (G,) each."""
    names = ("count", "full_w", "idle_w", "inlet_offset_k", "load_deviation", "height_factor")
    fan_w = servers.fan_reference_w
    return {name: getattr(servers, name) for name in names} | {
        "full_airflow": full_airflow * servers.air.density_ratio.base,
        "airflow_fall_per_k": full_airflow * servers.air.density_ratio.fall_per_k,
        "full_fan_power": fan_w / fan_w.max() if fan_w.max() > 0 else np.ones(len(fan_w)),
    }


def _hall_air(halls: Sequence[_HallArrays]) -> HallAir:
    """Concatenate the recirculation of all halls; equal halls share weights and steady states."""
    airs = [h.air for h in halls if h.air is not None]
    distinct = list({id(air): air for air in airs}.values())
    entry_of = {id(air): i for i, air in enumerate(distinct)}
    entry = np.array([entry_of[id(air)] for air in airs], dtype=np.int32)
    returns = [
        np.zeros(air.unit_shares.size) if air.return_shares is None else air.return_shares.ravel()
        for air in airs
    ]
    is_common = all(air.return_shares is None for air in distinct)
    return HallAir(
        mix_weights=_joined([air.mix_weights for air in distinct], entry),
        exhaust_share=np.concatenate([air.exhaust_share for air in airs]),
        unit_shares=np.concatenate([air.unit_shares.reshape(-1) for air in airs]),
        return_shares=None if is_common else np.concatenate(returns),
        rack_need_m3s=np.concatenate([air.rack_need_m3s for air in airs]),
        unit_share_offsets=offsets_from_counts(
            [air.unit_shares.size for air in airs], "unit shares"
        ),
        tiles=tuple(air.tiles for air in distinct),
        steady_states=tuple(air.steady_states for air in distinct),
        steady_state_of_dc=entry,
    )


def _joined(distinct: Sequence[MixWeights], entry: I32) -> MixWeights:
    """Combine the mix weights of all halls into one object, with racks numbered over the fleet.

    Args:
        distinct: Weights of each distinct hall.
        entry: Index into ``distinct`` for each data center, (B,).
    """
    halls = [distinct[i] for i in entry]
    first_rack = offsets_from_counts([len(w.norm) for w in halls], "racks")
    first_weight = offsets_from_counts([len(w.weights) for w in distinct], "weights")[entry]
    run_counts = np.concatenate([np.diff(w.run_offsets) for w in halls])
    return MixWeights(
        run_offsets=offsets_from_counts(run_counts, "runs"),
        run_first_rack=np.concatenate(
            [w.run_first_rack + rack for w, rack in zip(halls, first_rack, strict=False)]
        ),
        run_length=np.concatenate([w.run_length for w in halls]),
        run_first_weight=np.concatenate(
            [w.run_first_weight + weight for w, weight in zip(halls, first_weight, strict=True)]
        ),
        weights=np.concatenate([w.weights for w in distinct]),
        strength=np.concatenate([w.strength for w in halls]),
        norm=np.concatenate([w.norm for w in halls]),
    )


def _sums(values: npt.ArrayLike, offsets: I32) -> F64:
    """Sum the values between consecutive offsets."""
    return np.asarray(np.add.reduceat(np.asarray(values, dtype=np.float64), offsets[:-1]))


def offsets_from_counts(counts: npt.ArrayLike, what: str) -> I32:
    """Return the offset of the first part of each entry, and the total, (n + 1,).

    Args:
        counts: Number of parts of each entry, (n,).
        what: Name of the parts, for the error message.

    Raises:
        ConfigError: The total exceeds what the kernels can index.
    """
    offsets = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    if offsets[-1] > MOST_ENTRIES:
        raise ConfigError(f"fleet: {offsets[-1]:,} {what}; valid is at most {MOST_ENTRIES:,}")
    return offsets.astype(np.int32)
