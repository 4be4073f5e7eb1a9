"""Study of where racks of a type fit into a hall: positions ranked by the hottest inlet.

Every candidate is a copy of the hall in which racks of the type replace others. Its floor, CRAC
units and plant stay those of the hall as it is. All candidates are solved side by side at full load
with the kernels that the simulator runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sdc_taichi.config import DataCenterConfig, with_values
from sdc_taichi.errors import ConfigError, suggestion_or_valid
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, allowable_c, rank
from sdc_taichi.plant.electrical import NO_LIMIT_KW
from sdc_taichi.sim.drivers import load_drivers
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions
from sdc_taichi.sim.sizing import size
from sdc_taichi.types import F64

Kept = Literal["n", "n+1"]
"""Redundancy of the CRAC units that must remain: none, or the loss of any one unit."""

MOST_CANDIDATES = 96
"""Largest number of candidates that are solved; of more, an even selection is."""
MOST_CANDIDATE_RACKS = 40_000
"""Largest number of racks of all candidates together; it bounds time and memory."""
MOST_RACKS = 2_000
"""Largest number of racks of a hall."""
FREE_KW = 0.2
"""Power of a rack, in kW, up to which its position counts as free."""
_FAST = 4.0
"""Speed of CRAC fans, as a multiple of full speed, at which units deliver whatever racks need."""
LEAST_SHORTFALL = 1e-3
"""Smallest share of the air of the racks that counts as missing."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Positions for the new racks, and the hall at full load with them."""

    places: str
    """Rows and places in the rows, as text."""
    racks: tuple[int, ...]
    """Positions of the new racks, counted row by row."""
    hottest_c: float
    """Hottest inlet of the hall, in C."""
    hottest_new_c: float
    """Hottest inlet of the new racks, in C."""
    rack_inlet_c: F64
    """Hottest inlet of each rack, in C, (R,)."""
    hottest_rack: int
    """Rack with the hottest inlet."""
    it_kw: float
    """IT power of the hall, in kW."""
    airflow_share: float
    """Airflow that the racks need from the CRAC units, divided by that at full speed."""
    lost_unit_c: float | None
    """Hottest inlet if the worst single CRAC unit is down, in C; inf if there is no steady air,
    None if it was not studied."""
    exceeded: tuple[str, ...]
    """Limits that the candidate exceeds, in words; empty if the racks fit."""

    @property
    def has_steady_air(self) -> bool:
        """False if there is no steady air with a CRAC unit down."""
        return self.lost_unit_c is None or bool(np.isfinite(self.lost_unit_c))


@dataclass(frozen=True, slots=True)
class RackPlaces:
    """Candidates for the positions of new racks, best first."""

    config: DataCenterConfig
    """Config of the hall as it is."""
    type: str
    """Type of the new racks."""
    count: int
    """Number of new racks."""
    replaced: tuple[str, ...]
    """Types of racks whose positions may be taken."""
    candidates: tuple[Candidate, ...]
    """Candidates: those within all limits first, then by hottest inlet."""
    best: DataCenterConfig
    """Config of the hall with the first candidate."""
    base_hottest_c: float
    """Hottest inlet of the hall as it is at full load, in C."""
    base_it_kw: float
    """IT power of the hall as it is at full load, in kW."""
    inlet_limit_c: float
    """Highest allowed inlet, in C."""
    cooling_kw: float
    """Heat that plant and coils of the hall can remove, in kW."""
    note: str
    """Sentence on candidates that were left out; empty if none were."""


def study_places(
    config: DataCenterConfig,
    type_name: str,
    count: int,
    *,
    replaced: Sequence[str] = (),
    keep: Kept = "n",
    inlet_limit_c: float | None = None,
) -> RackPlaces:
    """Rank positions for racks of a type by the hottest inlet of the hall at full load.

    Candidates are blocks of adjacent positions in one or more adjacent rows, positions spread
    evenly over the hall, and the coolest positions.

    Args:
        config: The hall as it is, with the type in ``hall.rack_types``.
        type_name: Type of the new racks.
        count: Number of new racks.
        replaced: Types of racks whose positions may be taken; empty takes racks of at most
            ``FREE_KW``, whose positions count as free.
        keep: ``n+1`` also requires the limits with any one CRAC unit down.
        inlet_limit_c: Highest allowed inlet, in C; None is the allowable limit of the ASHRAE class.

    Raises:
        ConfigError: A type is unknown, the hall has no rack types or too few positions, or its
            approach temperatures do not follow from the layout.
    """
    types = _checked_types(config, type_name, replaced)
    hall = config.hall
    base_fleet = build_fleet(config)
    if keep == "n+1" and base_fleet.units < 2:
        raise ConfigError(f"{config.name}: one CRAC unit, so no n+1; valid is --keep n")
    kw_of = {name: _full_kw(config, name) for name in dict.fromkeys(types)}
    taken = tuple(replaced) or tuple(name for name, kw in kw_of.items() if kw <= FREE_KW)
    if not taken:
        raise ConfigError(
            f"{config.name}: no free positions (racks of at most {FREE_KW:g} kW); valid is "
            f"--replace with one of {', '.join(kw_of)}"
        )
    is_open = np.isin(types, taken) & (np.array(types) != type_name)
    if not 1 <= count <= int(is_open.sum()):
        raise ConfigError(
            f"--count {count}: {int(is_open.sum())} positions of {', '.join(taken)}; valid is "
            "1 to that number, or other types with --replace"
        )
    limit_c = allowable_c(config.protection.ashrae_class)[1]
    limit_c = limit_c if inlet_limit_c is None else inlet_limit_c
    # Solved on several threads as the candidates are, the hall shares their compiled kernel.
    base_solver = Hall(base_fleet, "f64", samples=False, serial_groups=0)
    base = _solve(base_fleet, base_solver, np.ones(base_fleet.units))
    limits = _limits(base_fleet, base_solver)
    fixed = _fixed_hall(config, base_fleet, float(base.it_kw[0]) / hall.racks)
    grid = is_open.reshape(hall.rows, hall.racks_per_row)
    positions = _candidates(grid, count, base.rack_inlet_c[0])
    most = max(4, min(MOST_CANDIDATES, MOST_CANDIDATE_RACKS // hall.racks))
    note = ""
    if len(positions) > most:
        chosen = np.unique(np.linspace(0, len(positions) - 1, most).round().astype(int))
        note = f"Of {len(positions):,} candidates, {len(chosen)} were solved, evenly chosen."
        positions = [positions[i] for i in chosen]
    configs = [_with_racks(fixed, types, racks, type_name, i) for i, racks in enumerate(positions)]
    fleet = build_fleet(configs)
    solver = Hall(fleet, "f64", samples=False, serial_groups=0)
    solved = _solve(fleet, solver, np.ones(fleet.units))
    airflow_share = _needed_airflow_share(fleet, solver)
    lost_c = np.full(len(configs), np.nan)
    lost_short, lost_airflow = np.zeros(len(configs)), np.zeros(len(configs))
    if keep == "n+1":
        flow_m3s = base_fleet.unit_design_m3s
        lost_airflow = airflow_share * flow_m3s.sum() / (flow_m3s.sum() - flow_m3s.max())
        lost_c = np.full(len(configs), -np.inf)
        solver.flags_limits = True
        for unit in range(base_fleet.units):
            running = np.tile(np.arange(base_fleet.units) != unit, len(configs)).astype(float)
            case = _solve(fleet, solver, running)
            lost_c = np.maximum(lost_c, case.rack_inlet_c.max(axis=1))
            lost_short = np.maximum(lost_short, case.cooling_kw - limits.lost_kw(unit))
    candidates = []
    for i, racks in enumerate(positions):
        inlet_c = solved.rack_inlet_c[i]
        over = limits.exceeded(solved, i)
        if airflow_share[i] > 1 + LEAST_SHORTFALL:
            over.append(f"airflow {100 * airflow_share[i]:.0f} % of the CRAC units")
        if inlet_c.max() > limit_c + LEAST_EXCESS_K:
            over.append(f"inlet {inlet_c.max():.1f} C")
        if np.isinf(lost_c[i]):
            over.append("no steady air with a unit down")
        elif keep == "n+1" and lost_c[i] > limit_c + LEAST_EXCESS_K:
            over.append(f"{lost_c[i]:.1f} C with a unit down")
        if keep == "n+1" and lost_airflow[i] > 1 + LEAST_SHORTFALL:
            over.append(f"airflow {100 * lost_airflow[i]:.0f} % with a unit down")
        if keep == "n+1" and lost_short[i] > 0.0:
            over.append("coils with a unit down")
        candidates.append(
            Candidate(
                places=_places_text(racks, hall.racks_per_row),
                racks=racks,
                hottest_c=float(inlet_c.max()),
                hottest_new_c=float(inlet_c[list(racks)].max()),
                rack_inlet_c=inlet_c,
                hottest_rack=int(np.argmax(rank(inlet_c))),
                it_kw=float(solved.it_kw[i]),
                airflow_share=float(airflow_share[i]),
                lost_unit_c=float(lost_c[i]) if keep == "n+1" else None,
                exceeded=tuple(over),
            )
        )

    def badness(index: int) -> tuple[bool, float, float]:
        each = candidates[index]
        worst_c = max(each.hottest_c, each.lost_unit_c or -np.inf)
        return bool(each.exceeded), float(rank(np.array(worst_c))), each.hottest_new_c

    order = sorted(range(len(candidates)), key=badness)
    return RackPlaces(
        config=config,
        type=type_name,
        count=count,
        replaced=taken,
        candidates=tuple(candidates[i] for i in order),
        best=configs[order[0]],
        base_hottest_c=float(base.rack_inlet_c.max()),
        base_it_kw=float(base.it_kw[0]),
        inlet_limit_c=limit_c,
        cooling_kw=limits.cooling_kw,
        note=note,
    )


def place_values(study: RackPlaces) -> dict[str, Any]:
    """Convert a study to plain values for JSON; keys name the units."""
    return {
        "name": study.config.name,
        "type": study.type,
        "count": study.count,
        "replaced": list(study.replaced),
        "inlet_limit_c": study.inlet_limit_c,
        "cooling_kw": study.cooling_kw,
        "base_hottest_inlet_c": study.base_hottest_c,
        "base_it_kw": study.base_it_kw,
        "note": study.note,
        "candidates": [
            {
                "places": each.places,
                "racks": list(each.racks),
                "fits": not each.exceeded,
                "exceeded": list(each.exceeded),
                "hottest_inlet_c": each.hottest_c,
                "hottest_new_inlet_c": each.hottest_new_c,
                "hottest_rack": each.hottest_rack,
                "it_kw": each.it_kw,
                "airflow_share": each.airflow_share,
                "hottest_inlet_unit_down_c": each.lost_unit_c if each.has_steady_air else None,
            }
            for each in study.candidates
        ],
    }


@dataclass(frozen=True, slots=True)
class _Solved:
    """N halls of R racks at full load."""

    rack_inlet_c: F64
    """Hottest inlet of each rack, in C, (N, R); inf in halls without steady air."""
    it_kw: F64
    """IT power of each hall, in kW, (N,)."""
    cooling_kw: F64
    """Heat of servers and CRAC fans, in kW, (N,); 0 in halls without steady air."""


@dataclass(frozen=True, slots=True)
class _Limits:
    """Limits of power and cooling of the hall before racks are added."""

    cooling_kw: float
    """Heat that plant and coils can remove, in kW."""
    unit_kw: F64
    """Heat that the coil of each CRAC unit can remove, in kW; inf without a limit, (U,)."""
    grid_kw: float
    """Limit of the grid connection, in kW; inf without a limit."""
    ups_kw: float
    """IT power that the UPS can supply, in kW."""
    facility_per_it: float
    """Facility power divided by IT power at the design point."""

    def lost_kw(self, unit: int) -> float:
        """Return the heat that the coils can remove without one unit, in kW."""
        return float(np.delete(self.unit_kw, unit).sum())

    def exceeded(self, solved: _Solved, index: int) -> list[str]:
        """Return the limits of power and cooling that a hall exceeds, in words."""
        out = []
        facility_kw = solved.it_kw[index] * self.facility_per_it
        if facility_kw > self.grid_kw:
            out.append(f"power {facility_kw:,.0f} of {self.grid_kw:,.0f} kW")
        if solved.cooling_kw[index] > self.cooling_kw * (1 + 1e-6):
            out.append(f"cooling {solved.cooling_kw[index]:,.0f} of {self.cooling_kw:,.0f} kW")
        if solved.it_kw[index] > self.ups_kw * (1 + 1e-6):
            out.append(f"UPS {solved.it_kw[index]:,.0f} of {self.ups_kw:,.0f} kW")
        return out


def _limits(fleet: Fleet, solver: Hall) -> _Limits:
    """Return what plant, coils, UPS and grid connection of a hall can do, as it is sized."""
    inputs = load_drivers(fleet.configs)
    sizing = size(fleet, solver, inputs.design_outdoor_c, inputs.design_wet_bulb_c)
    plant_kw = float(sizing.water_side.coils_w[0]) / 1e3
    unit_kw = np.where(np.isfinite(fleet.unit_capacity_w), fleet.unit_capacity_w / 1e3, np.inf)
    grid_kw = float(sizing.grid_limit_kw[0])
    ups_w = np.broadcast_to(sizing.power_path.ups.rated_w, 1)[0]
    loss_w = sizing.power_path.distribution.loss_w(sizing.it_w)
    return _Limits(
        min(plant_kw, float(unit_kw.sum())),
        unit_kw,
        np.inf if grid_kw >= NO_LIMIT_KW else grid_kw,
        float(ups_w - np.broadcast_to(loss_w, 1)[0]) / 1e3,
        float(sizing.facility_w[0] / sizing.it_w[0]),
    )


def _checked_types(
    config: DataCenterConfig, type_name: str, replaced: Sequence[str]
) -> tuple[str, ...]:
    """Return the type of each rack, after a check of hall and types."""
    hall = config.hall
    if not hall.rack_types:
        raise ConfigError(f"{config.name}: no hall.rack_types; valid is a hall with named types")
    for option, name in (("--type", type_name), *(("--replace", name) for name in replaced)):
        if name not in hall.rack_types:
            raise ConfigError(
                f"{option} {name!r}: not in hall.rack_types"
                f"{suggestion_or_valid(name, list(hall.rack_types))}"
            )
    settings = hall.recirculation
    follows = settings.scaled_to in ("row", "hall") and settings.matrix_file is None
    if hall.inlet_model != "recirculation" or not follows:
        raise ConfigError(
            f"{config.name}: inlets do not follow from the places of racks; valid is "
            "hall.inlet_model recirculation with hall.recirculation.calibrate row or hall"
        )
    if hall.racks > MOST_RACKS:
        raise ConfigError(f"{config.name}: {hall.racks:,} racks; valid are up to {MOST_RACKS:,}")
    return hall.rack_type_names()


def _full_kw(config: DataCenterConfig, type_name: str) -> float:
    """Return the power of the servers of a rack type at full load, in kW."""
    servers = config.hall.rack_types[type_name].air_servers
    return float(sum(group.count * group.full_w for group in servers)) / 1e3


def _fixed_hall(config: DataCenterConfig, fleet: Fleet, rack_kw: float) -> DataCenterConfig:
    """Return a hall whose floor and CRAC units stay those of the hall when its racks change.

    Args:
        config: The hall as it is.
        fleet: The hall as it is.
        rack_kw: Mean power of its racks, in kW.
    """
    known_kw = config.hall.recirculation.reference_rack_kw
    return with_values(
        config,
        {
            "hall.recirculation.reference_rack_kw": known_kw or rack_kw,
            "hvac.crac.airflow_m3s": [float(flow) for flow in fleet.unit_design_m3s],
            "hvac.crac.spare_units": 0,
            "hvac.crac.unit_sizes": None,
        },
    )


def _with_racks(
    config: DataCenterConfig, types: Sequence[str], racks: Sequence[int], type_name: str, index: int
) -> DataCenterConfig:
    """Return a hall in which racks of a type replace those at some positions."""
    named = np.array(types, dtype=object)
    named[list(racks)] = type_name
    rows = named.reshape(config.hall.rows, config.hall.racks_per_row)
    plan = []
    for row, of_row in enumerate(rows):
        for name in dict.fromkeys(of_row):
            at = ", ".join(str(i) for i in np.flatnonzero(of_row == name))
            plan.append({"type": name, "rows": str(row), "racks": at})
    return with_values(config, {"name": f"{config.name} {index}", "hall.rack_plan": plan})


def _solve(fleet: Fleet, solver: Hall, running: F64) -> _Solved:
    """Solve halls at full load with design supply air.

    Args:
        fleet: The halls.
        solver: Their solver.
        running: 1 for CRAC units that run, 0 for those that are down, (U,).
    """
    sums = solver.solve(_conditions(fleet, running, running))
    full_m3s = fleet.unit_sums(fleet.unit_design_m3s)
    share = np.array(sums.units_flow_m3s) / full_m3s
    it_w = np.asarray(sums.cpu_w + sums.it_fan_w, dtype=np.float64)
    fan_w = fleet.values("hvac.crac.fan_w_per_m3s") * full_m3s * share**3
    inlet_c = np.array(sums.rack_inlet_max_c, dtype=np.float64).reshape(fleet.size, -1)
    cooling_kw = (it_w + fan_w) / 1e3
    if solver.beyond_limits is not None:
        inlet_c[solver.beyond_limits] = np.inf
        cooling_kw[solver.beyond_limits] = 0.0
    return _Solved(inlet_c, it_w / 1e3, cooling_kw)


def _needed_airflow_share(fleet: Fleet, solver: Hall) -> F64:
    """Return the airflow that racks need, divided by that of all CRAC units at full speed, (N,)."""
    running = np.ones(fleet.units)
    # With faster fans the units deliver what the racks need.
    sums = solver.solve(_conditions(fleet, running, _FAST * running))
    return np.asarray(sums.units_flow_m3s / fleet.unit_sums(fleet.unit_design_m3s))


def _conditions(fleet: Fleet, running: F64, unit_high: F64) -> Conditions:
    """Return conditions of full load and design supply air.

    Args:
        fleet: The halls.
        running: 1 for CRAC units that run, 0 for those that are down, (U,).
        unit_high: Highest speed of each CRAC fan, as a share of full speed, (U,).
    """
    units = np.diff(fleet.unit_offsets)
    return Conditions(
        np.repeat(fleet.values("hall.design_supply_c"), units),
        np.ones(fleet.size),
        unit_low=np.repeat(fleet.values("hvac.crac.min_flow_ratio"), units) * running,
        unit_high=unit_high,
        unit_running=running,
    )


def _candidates(is_open: Any, count: int, inlet_c: F64) -> list[tuple[int, ...]]:
    """Return sets of positions for new racks: blocks, evenly spread ones, and the coolest.

    Args:
        is_open: True where a rack may be placed, (rows, racks per row).
        count: Number of new racks.
        inlet_c: Hottest inlet of each rack as it is, in C, (R,).
    """
    rows, width = is_open.shape
    index = np.arange(rows * width).reshape(rows, width)
    open_racks = index[is_open]
    found: dict[tuple[int, ...], None] = {}
    coolest = open_racks[np.argsort(rank(inlet_c[open_racks]), kind="stable")[:count]]
    spread = open_racks[np.unique(np.linspace(0, len(open_racks) - 1, count).round().astype(int))]
    for racks in (coolest, spread):
        if len(racks) == count:
            found[tuple(sorted(map(int, racks)))] = None
    for deep in range(1, rows + 1):
        wide = -(-count // deep)
        if wide > width or (deep > 1 and -(-count // (deep - 1)) == wide):
            continue
        for row, place in itertools.product(range(rows - deep + 1), range(width - wide + 1)):
            block = index[row : row + deep, place : place + wide].reshape(-1)[:count]
            if is_open.reshape(-1)[block].all():
                found[tuple(map(int, block))] = None
    for row in range(rows):
        of_row = index[row][is_open[row]]
        if len(of_row) >= count:
            even = of_row[np.linspace(0, len(of_row) - 1, count).round().astype(int)]
            found[tuple(map(int, even))] = None
    return list(found)


def _places_text(racks: Sequence[int], racks_per_row: int) -> str:
    """Return rows and places as text, such as ``row 3, racks 4-9; row 4, racks 4-9``."""
    parts = []
    for row, of_row in itertools.groupby(sorted(racks), key=lambda rack: rack // racks_per_row):
        places = [rack % racks_per_row for rack in of_row]
        spans = []
        for _, run in itertools.groupby(enumerate(places), key=lambda pair: pair[1] - pair[0]):
            run_places = [place for _, place in run]
            first, last = run_places[0], run_places[-1]
            spans.append(str(first) if first == last else f"{first}-{last}")
        parts.append(f"row {row} rack{'s' * (len(places) > 1)} {', '.join(spans)}")
    return "; ".join(parts)
