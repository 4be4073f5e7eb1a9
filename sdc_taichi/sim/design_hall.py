"""Design point of a hall: floor plan, airflows, temperatures and air-management indices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall import air_metrics
from sdc_taichi.hall.floor_plan import FloorPlan, floor_plan, unit_places_m
from sdc_taichi.hall.mix_weights import MixWeights
from sdc_taichi.sim.design_liquid import (
    DesignLiquid,
    design_liquid_values,
    rack_it_w,
    solve_design_liquid,
)
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions, HallSums
from sdc_taichi.sim.inlet_parts import Inlets
from sdc_taichi.types import F64

EXACT_RADIUS_RACKS = 2000
"""Largest number of racks for which the spectral radius is iterated; in larger halls the row sums
of the recirculation matrix bound it."""
_RADIUS_TOLERANCE = 1e-9
_MOST_ITERATIONS = 1000
_NO_APPROACH_K = 1e-9
_ROUND_OFF_SHARE = 1e-9
"""Bypass shares up to this value are round-off and count as 0."""


@dataclass(frozen=True, slots=True)
class AirFlows:
    """Air recirculation in a hall of R racks at its design point."""

    exhaust_share: F64
    """Share r of each rack's intake air that is exhaust air of the racks, dimensionless, (R,)."""
    bypass_share: float
    """Share of the CRAC air that bypasses the racks, dimensionless."""
    return_c: float
    """Temperature of the air that returns to the CRAC units, in C."""
    shi: float
    """Supply heat index, dimensionless."""
    rti_pct: float
    """Return temperature index, in %."""
    spectral_radius_bounds: tuple[float, float]
    """Lower and upper bound of the spectral radius of the recirculation matrix R, dimensionless."""


@dataclass(frozen=True, slots=True)
class DesignHall:
    """A hall of R racks and U CRAC units at full load and design supply air."""

    config: DataCenterConfig
    """Configuration of the data center."""
    plan: FloorPlan
    """Positions of racks, aisles and walls."""
    servers: int
    """Number of servers in the hall."""
    supply_c: float
    """Temperature of the supply air, in C."""
    it_w: F64
    """Power of the servers of each rack, fans included, in W, (R,)."""
    airflow_m3s: F64
    """Airflow through the servers of each rack, in m3/s, (R,)."""
    approach_k: F64
    """Airflow-weighted mean inlet temperature of each rack minus supply temperature, in K, (R,)."""
    inlet_c: F64
    """Airflow-weighted mean inlet temperature of each rack, in C, (R,)."""
    inlet_max_c: F64
    """Inlet temperature of the hottest server of each rack, in C, (R,)."""
    outlet_c: F64
    """Airflow-weighted mean outlet temperature of each rack, in C, (R,)."""
    unit_m3s: F64
    """Airflow of each CRAC unit at full speed, in m3/s, (U,)."""
    design_flow_m3s: float
    """Airflow of all CRAC units at the design point, in m3/s."""
    unit_places_m: F64
    """Position (x, y) of each CRAC unit on the floor plan, in m, (U, 2)."""
    hottest_rack: int
    """Index of the rack that holds the server with the hottest inlet."""
    hottest_server: int
    """Index of the server with the hottest inlet, counted from 0 at the floor of its rack."""
    air: AirFlows | None
    """Air recirculation; None with inlet model ``approach``, which does not compute airflows."""
    inlets: Inlets
    """Inlet temperatures of the racks, split into their causes."""
    liquid: DesignLiquid | None
    """Liquid-cooled racks; None without such racks."""


def solve_design_hall(config: DataCenterConfig) -> DesignHall:
    """Solve a hall at its design point with the kernels that the simulator runs, in f64.

    Raises:
        SdcError: The hall cannot be laid out or has no steady state.
    """
    fleet = build_fleet(config)
    liquid = None if config.liquid is None else solve_design_liquid(config)
    supply_c = config.hall.design_supply_c
    hall = Hall(fleet, "f64", samples=False)
    unit_supply_c = np.full(fleet.units, supply_c)
    speed = np.repeat(fleet.design_speed, fleet.units)
    sums = hall.solve(Conditions(unit_supply_c, np.ones(1), unit_low=speed, unit_high=speed))
    plan = floor_plan(config.hall)
    inlet_c = np.asarray(sums.rack_inlet_c, dtype=np.float64)
    approach_k = inlet_c - supply_c
    # Approach temperatures within round-off of 0 are set to 0.
    approach_k[np.abs(approach_k) < _NO_APPROACH_K] = 0.0
    group = int(np.argmax(air_metrics.rank(hall.group_inlets())))
    rack = int(np.searchsorted(fleet.group_offsets, group, side="right")) - 1
    it_w = np.asarray(sums.rack_cpu_w + sums.rack_fan_w, dtype=np.float64)
    first_server = fleet.server_offsets[fleet.group_offsets[rack]]
    return DesignHall(
        config=config,
        plan=plan,
        servers=fleet.servers,
        supply_c=supply_c,
        it_w=it_w if liquid is None else rack_it_w(liquid, it_w),
        airflow_m3s=np.asarray(sums.rack_airflow_m3s, dtype=np.float64),
        approach_k=approach_k,
        inlet_c=inlet_c,
        inlet_max_c=np.asarray(sums.rack_inlet_max_c, dtype=np.float64),
        outlet_c=np.asarray(sums.rack_outlet_c, dtype=np.float64),
        unit_m3s=fleet.unit_design_m3s,
        design_flow_m3s=float(sums.units_flow_m3s[0] or fleet.design_flow_m3s[0]),
        unit_places_m=unit_places_m(plan, fleet.units),
        hottest_rack=rack,
        hottest_server=int(fleet.server_offsets[group] - first_server),
        air=_air_flows(fleet, sums, approach_k, supply_c),
        inlets=Inlets(fleet, 0, hall.intake_air(unit_supply_c)),
        liquid=liquid,
    )


def _air_flows(fleet: Fleet, sums: HallSums, approach_k: F64, supply_c: float) -> AirFlows | None:
    air = fleet.air
    if air is None:
        return None
    airflow_m3s = np.asarray(sums.rack_airflow_m3s, dtype=np.float64)
    # An inlet mixes supply air with the exhaust mix before the rack; solve for the exhaust share.
    mix_over_supply_k = air.mix_weights.apply(
        np.asarray(sums.rack_outlet_c - supply_c, dtype=np.float64)
    )
    share = np.maximum(approach_k / mix_over_supply_k, 0.0)
    flow_m3s = float(sums.units_flow_m3s[0])
    return_c = float(sums.units_return_c[0])
    inlet_rise, outlet_rise = sums.inlet_m3k_s, sums.outlet_m3k_s
    rise_k = air_metrics.it_rise_k(inlet_rise, outlet_rise, sums.it_airflow_m3s)
    bypass_share = 1.0 - float(np.sum((1.0 - share) * airflow_m3s)) / flow_m3s
    return AirFlows(
        exhaust_share=share,
        bypass_share=bypass_share if bypass_share > _ROUND_OFF_SHARE else 0.0,
        return_c=return_c,
        shi=float(air_metrics.shi(inlet_rise, outlet_rise, sums.it_airflow_m3s)[0]),
        rti_pct=float(air_metrics.rti(return_c, supply_c, rise_k)[0]),
        spectral_radius_bounds=_spectral_radius_bounds(air.mix_weights, share),
    )


def _spectral_radius_bounds(weights: MixWeights, share: F64) -> tuple[float, float]:
    """Return lower and upper bound of the spectral radius of the matrix R = diag(share) w.

    R has no negative entries, so for any positive vector x the spectral radius is between the
    smallest and the largest (R x)_j / x_j (Collatz 1942, Wielandt 1950). With x = 1 these bounds
    are the extreme row sums; power iterations narrow them.
    """
    x, low, high = np.ones(len(share)), float(share.min()), float(share.max())
    if len(share) > EXACT_RADIUS_RACKS or low <= 0.0:
        return low, high
    for _ in range(_MOST_ITERATIONS):
        after = share * weights.apply(x)
        ratio = after / x
        low, high = float(ratio.min()), float(ratio.max())
        x = after / after.max()
        if high - low < _RADIUS_TOLERANCE:
            break
    return low, high


def design_hall_values(solved: DesignHall) -> dict[str, Any]:
    """Convert a hall at its design point to plain values for JSON.

    Keys name the units; lists per rack are in the order of the racks, row by row.
    """
    hall, air = solved.config.hall, solved.air
    flows: dict[str, Any] = {}
    if air is not None:
        flows = {
            "return_c": air.return_c,
            "return_approach_mean_k": air.return_c - float(solved.outlet_c.mean()),
            "bypass_share": air.bypass_share,
            "shi": air.shi,
            "rhi": 1.0 - air.shi,
            "rti_pct": air.rti_pct,
            "spectral_radius": list(air.spectral_radius_bounds),
            "exhaust_share": air.exhaust_share.tolist(),
            "approaches": hall.recirculation.approach_text,
        }
    return {
        "name": solved.config.name,
        "inlet_model": hall.inlet_model,
        "rows": hall.rows,
        "racks_per_row": hall.racks_per_row,
        "servers": solved.servers,
        "length_m": solved.plan.length_m,
        "width_m": solved.plan.width_m,
        "air_m3": solved.plan.air_m3,
        "layout": hall.layout.model_dump(mode="json"),
        "crac_units": [
            {"x_m": float(x), "y_m": float(y), "airflow_m3s": float(flow)}
            for (x, y), flow in zip(solved.unit_places_m, solved.unit_m3s, strict=True)
        ],
        "supply_c": solved.supply_c,
        "it_w": float(solved.it_w.sum()),
        "crac_flow_m3s": solved.design_flow_m3s,
        "hottest_rack": solved.hottest_rack,
        "hottest_server": solved.hottest_server,
        "hottest_inlet_c": float(solved.inlet_max_c.max()),
        **flows,
        **({"liquid": design_liquid_values(solved.liquid)} if solved.liquid is not None else {}),
        **({"rack_types": list(types)} if (types := hall.rack_type_names()) else {}),
        "rack_it_w": solved.it_w.tolist(),
        "rack_airflow_m3s": solved.airflow_m3s.tolist(),
        "approach_k": solved.approach_k.tolist(),
        "inlet_c": solved.inlet_c.tolist(),
        "inlet_max_c": solved.inlet_max_c.tolist(),
        "outlet_c": solved.outlet_c.tolist(),
    }
