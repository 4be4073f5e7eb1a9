"""Liquid-cooled racks, manifolds and CDUs of a fleet as flat arrays, and their design point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.liquid_schema import LiquidConfig, LiquidRack
from sdc_taichi.plant.chiller import CHILLERS, KELVIN
from sdc_taichi.plant.liquid import (
    REJECTION_KINDS,
    REUSE_KINDS,
    CduParameters,
    LiquidFleet,
    PlantParameters,
    RackParameters,
    size_liquid,
)
from sdc_taichi.types import F64

LEAST_LIFT_K = 10.0
"""Smallest difference of sink and source of a heat pump at its design point, in K."""


def liquid_fleet(configs: Sequence[DataCenterConfig]) -> LiquidFleet | None:
    """Return the liquid cooling of data centers as flat arrays; None if no rack has it."""
    if all(config.liquid is None for config in configs):
        return None
    racks_of: dict[int, list[LiquidRack]] = {}
    racks: list[LiquidRack] = []
    cdus: list[LiquidConfig] = []
    racks_per_loop, cdus_per_loop, loops = [], [], []
    for config in configs:
        liquid = config.liquid
        loops.append(0 if liquid is None else liquid.cdus.manifolds)
        if liquid is None:
            continue
        # Copies of a data center share section objects.
        if id(config.hall) not in racks_of:
            racks_of[id(config.hall)] = [*config.liquid_racks().values()]
        of_dc = racks_of[id(config.hall)]
        racks += of_dc
        ends = np.linspace(0, len(of_dc), liquid.cdus.manifolds + 1).round().astype(int)
        racks_per_loop += [end - begin for begin, end in pairwise(ends)]
        cdus_per_loop += [liquid.cdus.per_manifold] * liquid.cdus.manifolds
        cdus += [liquid] * liquid.cdus.count
    usual = LiquidConfig()
    plants = [config.liquid or usual for config in configs]
    return LiquidFleet(
        rack_offsets=_offsets(racks_per_loop),
        cdu_offsets=_offsets(cdus_per_loop),
        manifold_offsets=_offsets(loops),
        racks=_rack_parameters(racks),
        cdus=_cdu_parameters(cdus),
        plants=_plant_parameters(plants),
    )


class LiquidDesign(NamedTuple):
    """Liquid cooling of B data centers at full load; 0 for those without it."""

    liquid_w: F64
    """Heat that goes into the coolant, in W, (B,)."""
    to_air_w: F64
    """Heat of lines and pumps that goes into the air of the hall, in W, (B,)."""
    overhead_w: F64
    """Electric power of pumps, fans, trim chiller and heat pump, in W, (B,)."""
    to_plant_w: F64
    """Heat that the plant of the CRAC units takes from facility water, in W, (B,)."""


def liquid_design(fleet: LiquidFleet) -> LiquidDesign:
    """Return heat and power of liquid cooling at full load and initial setpoints."""
    sized, racks, plants = size_liquid(fleet), fleet.racks, fleet.plants
    size, dc = len(fleet.manifold_offsets) - 1, fleet.manifold_dc
    rack_dc, cdu_dc = dc[fleet.rack_manifold], dc[fleet.cdu_manifold]

    def of_racks(values: Any) -> F64:
        return np.bincount(rack_dc, values, size).astype(np.float64)

    first = np.minimum(fleet.cdu_offsets[fleet.manifold_offsets[:-1]], len(cdu_dc) - 1)
    supply_c, range_k, approach_k, fluid_share = (
        np.asarray(getattr(fleet.cdus, name))[first]
        for name in ("setpoint_c", "range_k", "approach_k", "fluid_share")
    )
    needed = 1.0 - plants.spare / np.maximum(np.bincount(cdu_dc, minlength=size) / _loops(fleet), 1)
    pumps_w = np.bincount(cdu_dc, sized.cdu_pump_w, size) * needed
    warm_k = np.maximum(supply_c + range_k - plants.room_c, 0.0)
    lines_w = of_racks(racks.loss_w_per_k) * warm_k
    losses_w = (1.0 - fluid_share) * pumps_w
    losses_w = losses_w + (1.0 - np.asarray(plants.pump_fluid_share)) * sized.facility_pump_w
    source_k = supply_c - approach_k + 0.5 * range_k - plants.pinch_k + KELVIN
    sink_k = 0.5 * (plants.network_return_c + plants.network_supply_c) + plants.pinch_k + KELVIN
    cop = plants.lorenz * sink_k / np.maximum(sink_k - source_k, LEAST_LIFT_K)
    is_pumped = plants.reuse_kind == REUSE_KINDS.index("heat_pump")
    pumped_w = np.minimum(sized.heat_w / np.maximum(cop - 1.0, 0.1), plants.reuse_demand_w)
    overhead_w = pumps_w + sized.facility_pump_w + sized.fan_w
    to_plant_w = np.asarray(plants.trim_w * plants.trim_by_plant)
    overhead_w = overhead_w + (plants.trim_w - to_plant_w) / CHILLERS["carnot"].reference_cop
    return LiquidDesign(
        liquid_w=of_racks(racks.liquid_design_w),
        to_air_w=lines_w + losses_w,
        overhead_w=overhead_w + np.where(is_pumped, pumped_w, 0.0),
        to_plant_w=to_plant_w,
    )


def _loops(fleet: LiquidFleet) -> F64:
    """Return the number of manifolds of each data center, at least 1, (B,)."""
    return np.maximum(np.diff(fleet.manifold_offsets), 1.0)


def _offsets(counts: Sequence[int]) -> Any:
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


def _rack_parameters(racks: Sequence[LiquidRack]) -> RackParameters:
    """Return the parameters of racks as arrays, (L,) each."""
    names = [f.name for f in fields(RackParameters) if f.name in LiquidRack.model_fields]
    values = {name: _array([getattr(rack, name) for rack in racks]) for name in names}
    return RackParameters(
        **values,
        liquid_design_w=_array([rack.design_liquid_w for rack in racks]),
        door_effectiveness=_array([getattr(rack, "door_effectiveness", 0.0) for rack in racks]),
        door_rise_k=_array([rack.air_rise_k for rack in racks]),
    )


def _cdu_parameters(cdus: Sequence[LiquidConfig]) -> CduParameters:
    """Return the parameters of CDUs as arrays, (C,) each."""
    names = ["approach_k", "range_k", "head_kpa", "pump_efficiency", "wall_share", "side_share"]
    names += ["fluid_share", "min_valve"]
    values = {name: _array([getattr(c.cdus, name) for c in cdus]) for name in names}
    capacity_kw = _array([c.cdus.capacity_kw for c in cdus])
    return CduParameters(
        **values,
        capacity_w=1e3 * capacity_kw,
        setpoint_c=_array([c.setpoint_c for c in cdus]),
        flow=_array([c.flow for c in cdus]),
    )


def _plant_parameters(plants: Sequence[LiquidConfig]) -> PlantParameters:
    """Return the parameters of coolant, facility loop, reuse and cooler as arrays, (B,) each."""

    def of(section: str, *names: str) -> dict[str, F64]:
        return {n: _array([getattr(getattr(p, section), n) for p in plants]) for n in names}

    facility = ["head_kpa", "pump_efficiency", "min_pump", "approach_k", "fan_share", "min_fan"]
    facility += ["adiabatic_effectiveness", "cycles"]
    demand_kw = _array([p.reuse.demand_kw for p in plants])
    return PlantParameters(
        **of("coolant", "density_kg_m3", "heat_capacity_j_per_kg_k"),
        **of("facility", *facility),
        **of("reuse", "network_return_c", "network_supply_c", "lorenz", "pinch_k"),
        coolant_l_per_kw=_array([p.litres_per_kw for p in plants]),
        spare=_array([p.cdus.spare for p in plants]),
        room_c=_array([p.room_c for p in plants]),
        dew_margin_k=_array([p.dew_margin_k for p in plants]),
        rejection=_array([REJECTION_KINDS.index(p.facility.rejection) for p in plants]),
        water_l_per_kw=_array([p.facility.litres_per_kw for p in plants]),
        trim_w=1e3 * _array([p.facility.trim_kw for p in plants]),
        trim_by_plant=_array([p.facility.trim_by == "plant" for p in plants]),
        reuse_kind=_array([REUSE_KINDS.index(p.reuse.kind) for p in plants]),
        reuse_share=_array([p.reuse.share for p in plants]),
        heat_price_per_kwh=_array([p.reuse.price_per_kwh_heat for p in plants]),
        reuse_demand_w=np.where(np.isnan(demand_kw), np.inf, 1e3 * demand_kw),
        reuse_effectiveness=_array([p.reuse.effectiveness for p in plants]),
        substep_s=_array([p.substep_s for p in plants]),
    )


def _array(values: Sequence[float | None]) -> F64:
    """Return values as an array; None becomes nan."""
    return np.array(values, dtype=np.float64)
