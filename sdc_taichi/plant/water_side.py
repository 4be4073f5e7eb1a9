"""Chilled water, economiser, chiller, tower and pumps as one plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from sdc_taichi.plant.air import economiser_share, pump_w
from sdc_taichi.plant.chiller import Chiller
from sdc_taichi.plant.tower import Tower
from sdc_taichi.types import F64


@dataclass(frozen=True, slots=True)
class Design:
    """Sized devices of the plant, each (B,)."""

    cooling_w: F64
    """Capacity of coils, exchanger and chilled-water pumps."""
    chiller_w: F64
    """Cooling capacity of the chiller at its reference point."""
    reference_cop: F64
    rejected_w: F64
    tower_water_kg_s: F64
    tower_reference_kg_s: F64
    """Water flow at which the tower's water flow ratio is 1."""
    tower_air_m3s: F64
    tower_fan_w: F64
    air_j_per_m3_k: F64
    chilled_pump_w: F64
    condenser_pump_w: F64
    pump_min_ratio: F64
    """Lowest flow of the pumps over design flow; 1 is constant flow."""
    coil_approach_k: F64
    chilled_water_range_k: F64
    approach_min_k: F64
    exchanger_approach_k: F64
    min_condenser_c: F64
    economiser: F64
    """1 with economiser, 0 without."""


@dataclass(frozen=True, slots=True)
class WaterSide:
    """One step of the plant, each (B,)."""

    removed_w: F64
    economiser_w: F64
    chiller_load_w: F64
    chiller_w: F64
    rejected_w: F64
    chilled_water_c: F64
    condenser_water_c: F64
    tower_range_k: F64
    tower_water_kg_s: F64
    tower_fan_w: F64
    chilled_pump_w: F64
    condenser_pump_w: F64

    def scaled(self, share: F64) -> WaterSide:
        """Means over a step of which the plant ran a share, (B,); temperatures are those then."""
        flows = [f.name for f in fields(self) if f.name.endswith(("_w", "_kg_s"))]
        return replace(self, **{name: getattr(self, name) * share for name in flows})


def operate(
    request_w: F64,
    *,
    setpoint_c: F64,
    outdoor_c: F64,
    wet_bulb_c: F64,
    design: Design,
    chiller: Callable[..., Chiller],
    tower: Callable[..., Tower],
    limited: bool,
) -> WaterSide:
    """Remove up to ``request_w`` from the chilled water and reject it outside.

    Chilled water follows the air, T_chw = setpoint - coil approach. The integrated economiser
    precools the return water with tower water as cold as the weather allows; the chiller does the
    rest. Tower and chiller depend on each other: the tower is solved for the chiller's power at
    the tower setpoint, then chiller and economiser at the water that the tower gives.

    Args:
        request_w: heat to remove, (B,).
        setpoint_c: CRAC supply setpoint, (B,).
        outdoor_c: dry bulb, (B,).
        wet_bulb_c: wet bulb, (B,).
        design: sized devices.
        chiller: model of ``plant.chiller``.
        tower: model of ``plant.tower``.
        limited: whether the plant's capacity limits the heat removed.
    """
    wanted_w = np.minimum(request_w, design.cooling_w) if limited else request_w
    chilled_c = setpoint_c - design.coil_approach_k
    return_c = chilled_c + design.chilled_water_range_k

    def precooled_share(tower_water_c: F64) -> F64:
        exchanger_c = tower_water_c + design.exchanger_approach_k
        return design.economiser * economiser_share(
            return_c, chilled_water_c=chilled_c, tower_water_c=exchanger_c
        )

    def run_chiller(share: F64, tower_water_c: F64) -> Chiller:
        return chiller(
            wanted_w * (1.0 - share),
            reference_w=design.chiller_w,
            chilled_water_c=chilled_c,
            condenser_c=np.maximum(tower_water_c, design.min_condenser_c),
            outdoor_c=outdoor_c,
            reference_cop=design.reference_cop,
        )

    coldest_c = wet_bulb_c + design.approach_min_k
    share = precooled_share(coldest_c)
    useful_c = np.where(share > 0, chilled_c - design.exchanger_approach_k, design.min_condenser_c)
    tower_setpoint_c = np.maximum(coldest_c, useful_c)
    expected = run_chiller(share, tower_setpoint_c)
    heat_w = wanted_w * share + expected.rejected_w
    flow = np.maximum(heat_w / design.rejected_w, design.pump_min_ratio)
    tower_water_kg_s = design.tower_water_kg_s * flow
    cooled = tower(
        heat_w,
        wet_bulb_c=wet_bulb_c,
        outdoor_c=outdoor_c,
        condenser_setpoint_c=tower_setpoint_c,
        supply_setpoint_c=setpoint_c,
        water_kg_s=tower_water_kg_s,
        reference_water_kg_s=design.tower_reference_kg_s,
        reference_air_m3s=design.tower_air_m3s,
        design_fan_w=design.tower_fan_w,
        air_j_per_m3_k=design.air_j_per_m3_k,
    )
    share = precooled_share(cooled.leaving_c)
    machine = run_chiller(share, cooled.leaving_c)
    economiser_w = wanted_w * share
    removed_w = wanted_w - machine.unmet_w if limited else wanted_w
    return WaterSide(
        removed_w=removed_w,
        economiser_w=economiser_w,
        chiller_load_w=removed_w - economiser_w,
        chiller_w=machine.power_w,
        rejected_w=economiser_w + machine.rejected_w,
        chilled_water_c=chilled_c,
        condenser_water_c=cooled.leaving_c,
        tower_range_k=cooled.range_k,
        tower_water_kg_s=tower_water_kg_s,
        tower_fan_w=cooled.fan_w,
        chilled_pump_w=pump_w(
            removed_w,
            design_flow=design.cooling_w,
            design_w=design.chilled_pump_w,
            min_flow_ratio=design.pump_min_ratio,
        ),
        condenser_pump_w=pump_w(
            heat_w,
            design_flow=design.rejected_w,
            design_w=design.condenser_pump_w,
            min_flow_ratio=design.pump_min_ratio,
        ),
    )
