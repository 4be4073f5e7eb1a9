"""Design point of liquid-cooled racks: heat, flows, CDUs and facility water at full load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.liquid_schema import W_CLASS_LIMITS_C, LiquidConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.drivers import load_drivers
from sdc_taichi.sim.junction_parts import NO_JUNCTIONS, JunctionParts, junction_parts
from sdc_taichi.sim.liquid import Liquid, LiquidInputs, LiquidResult
from sdc_taichi.sim.liquid_fleet import liquid_fleet
from sdc_taichi.types import F64

OUTDOOR_LIMITS_C = (-20.0, 100.0)
"""Range of outdoor temperatures in which the warmest facility water is searched, in C."""
_BISECTIONS = 24
"""Number of bisections of that search, after which its error is below 1e-5 K."""
_DRY_DEW_POINT_C = -60.0
"""Dew point at which no setpoint has to be raised, in C."""


@dataclass(frozen=True, slots=True)
class DesignLiquid:
    """Liquid-cooled racks of a data center at full load in design weather."""

    config: LiquidConfig
    """Config of the loops."""
    liquid: Liquid
    """Model of the racks, after the step at full load."""
    result: LiquidResult
    """Result of this step."""
    indices: dict[int, int]
    """Index of each liquid-cooled rack among these, by its index in the hall."""
    outdoor_c: float
    """Outdoor dry bulb, in C."""
    wet_bulb_c: float
    """Outdoor wet bulb, in C."""
    warmest_water_c: float | None
    """Warmest facility water at which no GPU throttles at full load, in C; None if none or all of
    the temperatures that the cooler reaches in ``OUTDOOR_LIMITS_C`` let GPUs throttle."""

    def parts(self, rack: int | None) -> JunctionParts:
        """Split the junction temperature of a rack of the hall; None is the hottest junction.

        Raises:
            SdcError: The rack has no cold plates, or no rack has.
        """
        return junction_parts(self.liquid, self.indices, rack)


def solve_design_liquid(config: DataCenterConfig) -> DesignLiquid:
    """Solve the liquid-cooled racks of a data center at full load in design weather.

    Raises:
        ConfigError: No rack has coolant.
    """
    fleet = liquid_fleet([config])
    if config.liquid is None or fleet is None:
        raise ConfigError(f"{config.name}: {NO_JUNCTIONS}")
    site, sizing = load_drivers([config]), config.hvac.sizing
    outdoor_c, wet_bulb_c = (
        float(of_site[0]) if configured is None else configured
        for of_site, configured in (
            (site.design_outdoor_c, sizing.design_outdoor_c),
            (site.design_wet_bulb_c, sizing.design_wet_bulb_c),
        )
    )
    liquid, racks = Liquid(fleet, step_s=60.0), list(config.liquid_racks())
    dew_point_c = config.liquid.dew_point_c
    loads = np.ones(len(racks))

    def result_at(outdoor_c: float, wet_bulb_c: float) -> LiquidResult:
        inputs = LiquidInputs(
            utilisation=loads,
            powered=loads,
            outdoor_c=np.array([outdoor_c]),
            wet_bulb_c=np.array([wet_bulb_c]),
            dew_point_c=np.array([_DRY_DEW_POINT_C if dew_point_c is None else dew_point_c]),
        )
        return liquid.step(liquid.initial_state(inputs), inputs)[1]

    low_c, high_c = OUTDOOR_LIMITS_C
    warmest_c: float | None = None
    if result_at(high_c, high_c).throttle_s[0] >= 0.0 > result_at(low_c, low_c).throttle_s[0]:
        for _ in range(_BISECTIONS):
            middle_c = (low_c + high_c) / 2
            result = result_at(middle_c, middle_c)
            if result.throttle_s[0] >= 0.0:
                high_c = middle_c
            else:
                low_c, warmest_c = middle_c, float(result.facility_supply_c[0])
    return DesignLiquid(
        config=config.liquid,
        liquid=liquid,
        result=result_at(outdoor_c, wet_bulb_c),
        indices={rack: index for index, rack in enumerate(racks)},
        outdoor_c=outdoor_c,
        wet_bulb_c=wet_bulb_c,
        warmest_water_c=warmest_c,
    )


def rack_it_w(design: DesignLiquid, it_w: F64) -> F64:
    """Return the power of all racks, in W, (R,), from that with which racks warm the air."""
    it_w = it_w.copy()
    it_w[list(design.indices)] = design.result.it_w
    return it_w


def needed_class(water_c: float) -> str | None:
    """Return the warmest ASHRAE class whose facility water is at most of a temperature in C."""
    kept = [name for name, limit_c in W_CLASS_LIMITS_C.items() if limit_c <= water_c + 1e-6]
    return kept[-1] if kept else None


def design_liquid_values(design: DesignLiquid) -> dict[str, Any]:
    """Convert liquid-cooled racks at full load to plain values for JSON; keys name the units."""
    result, sizes, cdus = design.result, design.liquid.sizing, design.config.cdus
    setpoint_c = float(result.facility_setpoint_c[0])
    names = (
        *("liquid_it_w", "liquid_heat_w", "liquid_air_w", "cdu_supply_c"),
        *("cdu_return_c", "facility_supply_c", "facility_return_c", "cdu_pump_w"),
        *("facility_pump_w", "cooler_fan_w", "trim_load_w", "trim_chiller_w"),
        "liquid_to_plant_w",
    )
    return {
        "racks": len(design.indices),
        **{name: float(getattr(result, name)[0]) for name in names},
        "junction_max_c": float(result.junction_max_c[0]) or None,
        "coolant_m3s": float(result.cdu_flow_m3s.sum()),
        "manifolds": cdus.manifolds,
        "cdus_per_manifold": cdus.per_manifold,
        "spare_cdus_per_manifold": cdus.spare,
        "cdu_w": float(sizes.cdu_w.max()),
        "outdoor_c": design.outdoor_c,
        "wet_bulb_c": design.wet_bulb_c,
        "facility_setpoint_c": setpoint_c,
        "facility_class": needed_class(setpoint_c),
        "warmest_water_c": design.warmest_water_c,
        "warmest_water_class": None
        if design.warmest_water_c is None
        else needed_class(design.warmest_water_c),
    }
