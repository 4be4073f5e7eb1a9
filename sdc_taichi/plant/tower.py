"""Cooling towers: fan power and water temperature for the heat to reject, models in ``TOWERS``.

Arguments are float64 arrays of shape (B,), B data centers, or anything that broadcasts to it.

YorkCalc gives the approach (leaving water minus wet-bulb temperature) as a polynomial with 27
coefficients in wet bulb, range (entering minus leaving water temperature) and liquid-to-gas ratio.
That ratio is the water flow divided by its reference, divided by the same ratio of the airflow.
Sources:
EnergyPlus Engineering Reference, CoolingTower:VariableSpeed (YorkCalc correlation, its bounds and
the free-convection share); Modelica Buildings, Fluid.HeatExchangers.CoolingTowers.YorkCalc
(reference flow and fan power per water flow).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.types import F64, Values, as_array

WATER_J_PER_KG_K = 4184.0
"""Specific heat capacity of water, in J/(kg K)."""

YORKCALC = np.array(
    [
        [
            [-0.359741205, -0.055053608, 0.0023850432],
            [0.173926877, -0.0248473764, 0.00048430224],
            [-0.005589849456, 0.0005770079712, -0.00001342427256],
        ],
        [
            [2.84765801111111, -0.121765149, 0.0014599242],
            [1.680428651, -0.0166920786, -0.0007190532],
            [-0.025485194448, 0.0000487491696, 0.00002719234152],
        ],
        [
            [-0.0653766255555556, -0.002278167, 0.0002500254],
            [-0.0910565458, 0.00318176316, 0.000038621772],
            [-0.0034285382352, 0.00000856589904, -0.000001516821552],
        ],
    ]
)
"""Coefficients of the approach, in K. The axes are the powers of the liquid-to-gas ratio, of the
range in K, and of the wet bulb in C."""
WET_BULB_BOUNDS_C = (-34.4, 26.7)
"""Lowest and highest wet-bulb temperature at which YorkCalc is evaluated, in C."""
MIN_RANGE_K, MAX_RANGE_K = 1.1, 22.2
"""Bounds of the range (entering minus leaving water) of the measurements behind YorkCalc, in K. It
is evaluated up to the upper bound."""
MAX_LIQUID_GAS_RATIO = 8.0
"""Largest liquid-to-gas ratio at which YorkCalc is evaluated."""

FREE_CONVECTION_SHARE = 0.125
"""Cooling and airflow of a tower with its fan off, divided by those at full fan speed (default of
EnergyPlus)."""
MIN_AIR_RATIO = 0.2
"""Lowest airflow of a running fan divided by that at full speed; for smaller mean airflows the fan
cycles on and off (default of EnergyPlus)."""
CYCLING_APPROACH_RATIO = 0.8
"""Largest approach while a cycling fan is on, divided by that with the fan off. At very small heat,
YorkCalc gives the slowest fan a larger approach than free convection; there a cycling fan runs
faster, so that its mean power begins at 0."""

OVERFED_SHARE = 0.2
"""Share of the water above a cell's design flow that does not count in the liquid-to-gas ratio.

More water wets more of the fill, so that a cell that receives the water of failed cells cools it
better than YorkCalc, measured at 75 to 125 % of the design flow, gives at the same ratio. The share
is fitted to the integral of Merkel with a transfer number KaV/L proportional to (L/G)^-0.5, in the
middle of published exponents (ASHRAE Handbook, HVAC Systems and Equipment, "Cooling towers"). At
twice the flow and 25.6 C wet bulb, it gives an approach of 8.0 K, as does the integral.
"""
NO_LIMIT_KG_S = 1e30
"""Water flow that no cell receives."""
LEAST_W = 1e-3
"""Lower bound of the design fan power in the rule for the fan speed, in W."""

_LEAST_K = 1e-9
"""Lower bound of a divisor that is a difference of approaches, in K; prevents division by zero."""


class TowerPoint(NamedTuple):
    """Weather, setpoints and sizes in one step of the towers."""

    wet_bulb_c: Values
    """Outdoor wet-bulb temperature, in C, (B,)."""
    outdoor_c: Values
    """Outdoor dry-bulb temperature, in C, (B,)."""
    condenser_setpoint_c: Values
    """Setpoint of the water that leaves the tower, in C, (B,)."""
    supply_setpoint_c: Values
    """CRAC supply setpoint, in C, (B,)."""
    water_kg_s: Values
    """Condenser water flow, in kg/s, (B,); above 0 wherever there is heat to reject."""
    reference_water_kg_s: Values
    """Reference water flow of the liquid-to-gas ratio, in kg/s, above 0, (B,)."""
    reference_air_m3s: Values
    """Airflow at full fan speed, in m3/s, above 0, (B,)."""
    design_fan_w: Values
    """Fan power at full speed, in W, (B,)."""
    air_j_per_m3_k: Values
    """Volumetric heat capacity of air, in J/(m3 K), (B,)."""
    cells_water_kg_s: Values = NO_LIMIT_KG_S
    """Design water flow of the cells that work, in kg/s, (B,)."""


class TowerDesignPoint(NamedTuple):
    """Design point and configuration: the input of tower sizing."""

    cooling_w: F64
    """Cooling capacity of the plant, in W, (B,)."""
    rejected_w: F64
    """Heat that the tower rejects at design, in W, (B,)."""
    water_kg_s: F64
    """Condenser water flow, in kg/s, (B,)."""
    outdoor_c: F64
    """Outdoor dry-bulb temperature at design, in C, (B,)."""
    wet_bulb_c: F64
    """Outdoor wet-bulb temperature at design, in C, (B,)."""
    lowest_setpoint_c: F64
    """Lowest CRAC supply setpoint, in C, (B,)."""
    air_j_per_m3_k: F64
    """Volumetric heat capacity of air, in J/(m3 K), (B,)."""
    value: Callable[[str], F64]
    """Function that returns the values of a field of section ``hvac.tower`` by its name, (B,)."""


class TowerSize(NamedTuple):
    """Sizes of the towers of B data centers."""

    reference_water_kg_s: F64
    """Reference water flow of the liquid-to-gas ratio, in kg/s, (B,)."""
    air_m3s: F64
    """Airflow at full fan speed, in m3/s, (B,)."""
    fan_w: F64
    """Fan power at full speed, in W, (B,)."""


@dataclass(frozen=True, slots=True)
class TowerResult:
    """One step of the cooling towers of B data centers."""

    fan_w: F64
    """Fan power, in W, (B,)."""
    air_ratio: F64
    """Mean airflow of the step divided by its reference value, (B,). With the fan off it is the
    airflow of free convection, or 0 for models without free convection."""
    leaving_c: F64
    """Temperature of the water that leaves the tower, in C, (B,)."""
    range_k: F64
    """Range: entering minus leaving water temperature, in K, (B,)."""
    approach_k: F64
    """Approach: leaving water temperature minus wet bulb, in K, (B,)."""


@dataclass(frozen=True, slots=True)
class TowerModel:
    """Cooling tower model: its equations and its sizing rule."""

    step: Callable[[Values, TowerPoint], TowerResult]
    """Function that computes one step from the heat to reject in W, (B,): the heat of the chiller's
    condenser plus the heat of the economiser."""
    size: Callable[[TowerDesignPoint], TowerSize]
    """Function that sizes the towers for a design point."""
    water_loop: bool = False
    """True if heat, weather and fan speed determine the temperature of the water; False if the
    water is always at its setpoint."""


def yorkcalc_approach_k(wet_bulb_c: Values, range_k: Values, liquid_gas_ratio: Values) -> F64:
    """Return the approach of a York tower: leaving water minus wet-bulb temperature, in K.

    Args:
        wet_bulb_c: Outdoor wet-bulb temperature, C; values are clipped to -34.4..26.7 C.
        range_k: Entering minus leaving water temperature, K; values are clipped to 0..22.2 K.
        liquid_gas_ratio: Water flow ratio divided by airflow ratio; values are clipped to 8.

    Returns:
        Approach, K, at least 0.
    """
    return _approach_at(liquid_gas_ratio, *_approach_parabola(wet_bulb_c, range_k))


def yorkcalc_liquid_gas_ratio(wet_bulb_c: Values, range_k: Values, approach_k: Values) -> F64:
    """Invert YorkCalc: return the largest liquid-to-gas ratio (least air) for an approach.

    For a given wet bulb and range, the approach is a + b*x + c*x^2 in the ratio x, with b > 0
    within the bounds. For a target approach t, the root on the branch that rises from x = 0 is
    2*(t - a)/(b + sqrt(b^2 + 4*c*(t - a))), which is also valid for c = 0.

    Args:
        wet_bulb_c: Outdoor wet-bulb temperature, C.
        range_k: Entering minus leaving water temperature, K.
        approach_k: Target approach, K.

    Returns:
        The ratio, 0..8. It is 0 where no airflow reaches the approach. It is 8, the bound of the
        correlation, where an even smaller airflow would suffice.
    """
    return _ratio_at(approach_k, *_approach_parabola(wet_bulb_c, range_k))


def _approach_at(liquid_gas_ratio: Values, a: Values, b: Values, c: Values) -> F64:
    """Return the approach a + b*x + c*x^2 at the liquid-to-gas ratio x, in K."""
    x = np.minimum(liquid_gas_ratio, MAX_LIQUID_GAS_RATIO)
    return as_array(np.maximum(a + x * (b + x * c), 0.0))


def _ratio_at(approach_k: Values, a: Values, b: Values, c: Values) -> F64:
    """Return the liquid-to-gas ratio x, 0..8, that solves a + b*x + c*x^2 = approach_k."""
    above_intercept = approach_k - a
    discriminant = b**2 + 4.0 * c * above_intercept
    # A negative discriminant has two possible causes. Either the parabola opens downwards and
    # stays below the approach, so that any airflow suffices. Or it opens upwards and stays above
    # the approach, so that no airflow suffices; in that case the approach is also below the
    # intercept, and the last line returns 0.
    reached = discriminant >= 0.0
    root = 2.0 * above_intercept / (b + np.sqrt(np.where(reached, discriminant, 0.0)))
    ratio = np.where(reached, np.minimum(root, MAX_LIQUID_GAS_RATIO), MAX_LIQUID_GAS_RATIO)
    return as_array(np.where(above_intercept > 0.0, ratio, 0.0))


def yorkcalc_reference_water_kg_s(
    water_kg_s: Values, *, wet_bulb_c: Values, range_k: Values, approach_k: Values
) -> F64:
    """Return the reference water flow for which full airflow meets the design approach, in kg/s.

    Args:
        water_kg_s: Design water flow, kg/s.
        wet_bulb_c: Design wet-bulb temperature, C.
        range_k: Design range, K.
        approach_k: Design approach, K.

    Returns:
        Water flow at which the water flow ratio is 1, kg/s.

    Raises:
        SdcError: No airflow reaches the design approach.
    """
    ratio = yorkcalc_liquid_gas_ratio(wet_bulb_c, range_k, approach_k)
    if np.any(ratio <= 0.0):
        t, r, a, _ = np.broadcast_arrays(wet_bulb_c, range_k, approach_k, ratio)
        i = int(np.argmin(ratio))
        raise SdcError(
            f"cooling tower: no airflow reaches a design approach of {a.flat[i]:g} K at wet bulb "
            f"{t.flat[i]:g} C and range {r.flat[i]:g} K; the approach must be above "
            f"{_approach_parabola(t.flat[i], r.flat[i])[0]:.2f} K there"
        )
    return as_array(water_kg_s / ratio)


def design_water_kg_s(heat_w: Values, *, range_k: Values) -> Values:
    """Return the condenser water flow that carries a heat flow at a range, in kg/s.

    Args:
        heat_w: Heat to reject, W, (B,).
        range_k: Entering minus leaving water temperature, K, (B,).
    """
    return heat_w / (WATER_J_PER_KG_K * range_k)


def fan_power_w(air_ratio: Values, *, design_fan_w: Values) -> Values:
    """Return the fan power by the affinity law, in W: design power times air_ratio^3.

    Args:
        air_ratio: Airflow divided by airflow at full speed, (B,).
        design_fan_w: Fan power at full speed, W, (B,).
    """
    return design_fan_w * air_ratio**3


def yorkcalc(heat_w: Values, point: TowerPoint) -> TowerResult:
    """Step a York tower with a variable-speed fan that holds the condenser water at its setpoint.

    The tower always rejects all heat: the range is r = heat_w/(c*m). If the fan cannot hold the
    setpoint even at full speed, the leaving water is warmer than the setpoint. Otherwise the fan
    runs as slowly as the setpoint allows. If that speed is below ``MIN_AIR_RATIO``, the fan cycles
    on and off at ``MIN_AIR_RATIO``, or at very small heat at the speed that
    ``CYCLING_APPROACH_RATIO`` gives. With the fan off the tower has the share f of its full-speed
    cooling (EnergyPlus: T_out = T_in - f*(T_in - T_out_full)). A tower with range r and fan off
    would thus have the range r/f at full speed, and its approach is A_full(r/f) + r*(1 - f)/f. A
    bypass prevents water colder than the setpoint: with the fan off, air and water pass each other
    only as much as the heat needs, see ``_free_convection_share``.
    """
    range_k = _range_k(heat_w, point.water_kg_s)
    water_ratio = _water_ratio(point)
    wanted_k = point.condenser_setpoint_c - point.wet_bulb_c
    parabola = _approach_parabola(point.wet_bulb_c, range_k)
    full_speed_k = _approach_at(water_ratio, *parabola)
    fan_off_k = _fan_off_approach_k(point.wet_bulb_c, range_k, water_ratio)
    low_speed_k = _approach_at(water_ratio / MIN_AIR_RATIO, *parabola)
    low_speed_k = np.minimum(low_speed_k, CYCLING_APPROACH_RATIO * fan_off_k)
    low_speed_k = np.maximum(low_speed_k, full_speed_k)

    # If full speed cannot reach the wanted approach, use the liquid-to-gas ratio of full speed.
    loaded = range_k > 0.0
    running_k = np.minimum(wanted_k, low_speed_k)
    ratio = np.maximum(_ratio_at(running_k, *parabola), np.where(loaded, water_ratio, 1.0))
    speed = np.maximum(water_ratio / ratio, MIN_AIR_RATIO)
    # A cycling fan gives an approach that is linear in the share of time during which it is on.
    on_share = (fan_off_k - wanted_k) / np.maximum(fan_off_k - low_speed_k, _LEAST_K)
    on_share = np.where(loaded, np.clip(on_share, 0.0, 1.0), 0.0)
    at_rest = _free_convection_share(point.wet_bulb_c, range_k, water_ratio, wanted_k)
    free_ratio = FREE_CONVECTION_SHARE * np.where(on_share > 0.0, 1.0, at_rest)
    air_ratio = on_share * speed + (1.0 - on_share) * free_ratio
    return _tower(
        on_share * fan_power_w(speed, design_fan_w=point.design_fan_w),
        np.where(loaded, air_ratio, 0.0),
        leaving_c=point.wet_bulb_c + np.where(loaded, np.maximum(wanted_k, full_speed_k), wanted_k),
        range_k=range_k,
        wet_bulb_c=point.wet_bulb_c,
    )


def yorkcalc_reset_c(
    heat_w: Values, point: TowerPoint, w_per_k: tuple[Values, ...]
) -> tuple[F64, tuple[F64, ...]]:
    """Return the temperatures of the leaving water at full fan speed and at the best fan speeds.

    At the best speed s, the power of the fan and the power of the plant, which grows with the water
    temperature T, change by the same amount: 3 P_des s^2 = -k dT/ds. With T = T_wb + a + b w/s +
    c (w/s)^2, in which w is the liquid-to-gas ratio at full speed,

        s^4 = k w (b + 2 c w/s) / (3 P_des),    with w/s = w on the right side, since c is small.

    That fan and chiller draw least where their marginal powers balance is the basis of the
    near-optimal tower control of Braun and Diderrich (ASHRAE Transactions 96(2), 1990; ASHRAE
    Handbook, HVAC Applications, "Supervisory control strategies and optimization") and of
    extremum-seeking control of tower fans (arXiv:2605.15431).

    Args:
        heat_w: Heat to reject, W, (B,).
        point: Weather, flows and sizes; the setpoint is not used.
        w_per_k: Growth of the power of the plant with the water temperature, k, in W/K, (B,), for
            each best speed.

    Returns:
        Temperature at full speed and those at the best speeds, C, (B,).
    """
    w = _water_ratio(point)
    a, b, c = _approach_parabola(point.wet_bulb_c, _range_k(heat_w, point.water_kg_s))
    slope = w * np.maximum(b + 2.0 * c * w, 0.0) / (3.0 * np.maximum(point.design_fan_w, LEAST_W))
    speeds = (np.clip(np.sqrt(np.sqrt(k * slope)), MIN_AIR_RATIO, 1.0) for k in w_per_k)
    full_c, *best_c = (
        as_array(point.wet_bulb_c + _approach_at(w / s, a, b, c)) for s in (1.0, *speeds)
    )
    return full_c, tuple(best_c)


def yorkcalc_largest_w(leaving_c: Values, range_k: Values, point: TowerPoint) -> F64:
    """Return the largest heat that leaves the water at a temperature, at full fan speed, in W.

    Args:
        leaving_c: Temperature of the leaving water, C, (B,).
        range_k: Range at which the pumps adapt the water flow to the heat, K, (B,).
        point: Weather and sizes; its water flow is the smallest of the pumps. If the cells cannot
            take that much at ``range_k``, the range is smaller.
    """
    approach_k = leaving_c - point.wet_bulb_c
    counted_kg_s = point.reference_water_kg_s * _ratio_at(
        approach_k, *_approach_parabola(point.wet_bulb_c, range_k)
    )
    excess_kg_s = np.maximum(counted_kg_s - point.cells_water_kg_s, 0.0)
    water_kg_s = counted_kg_s + excess_kg_s * OVERFED_SHARE / (1.0 - OVERFED_SHARE)
    a, b, c = _approach_by_range(point.wet_bulb_c, _water_ratio(point))
    above_k = np.maximum(approach_k - a, 0.0)
    slope_k = b + np.sqrt(np.maximum(b**2 + 4.0 * c * above_k, 0.0))
    small_range_k = np.minimum(2.0 * above_k / np.maximum(slope_k, _LEAST_K), range_k)
    largest_kg_k_s = np.maximum(water_kg_s * range_k, 0.0)
    at_smallest_flow = water_kg_s < point.water_kg_s
    return as_array(
        WATER_J_PER_KG_K
        * np.where(at_smallest_flow, point.water_kg_s * small_range_k, largest_kg_k_s)
    )


def released(heat_w: Values, point: TowerPoint) -> TowerResult:
    """Step the tower of the released SustainDC code: fan power is cubic in the airflow.

    The airflow is V = Q/(cp*rho*max(50 - (T_amb - T_set), 1)) and the power is
    P = P_ref*min(V/V_ref, 1)^3, or 0 below 5 C outdoors. The released code has no water loop, so
    the leaving water is always at the condenser setpoint.
    """
    air_m3s = _air_m3s(heat_w, point)
    running = np.greater_equal(point.outdoor_c, 5.0)
    air_ratio = np.where(running, np.minimum(air_m3s / point.reference_air_m3s, 1.0), 0.0)
    return _tower(
        fan_power_w(air_ratio, design_fan_w=point.design_fan_w),
        air_ratio,
        leaving_c=point.condenser_setpoint_c,
        range_k=_range_k(heat_w, point.water_kg_s),
        wet_bulb_c=point.wet_bulb_c,
    )


def paper(heat_w: Values, point: TowerPoint) -> TowerResult:
    """Step the tower of the paper (appendix A.2.2): P_CT = P_ref*(V/V_ref)^-3.

    With this printed exponent, less airflow needs more power. The paper refers to Breen et al. 2010
    for f_ct_delta; this model uses the temperature difference of the released code instead,
    max(50 - (T_amb - T_set), 1). Without airflow the fan is off, because the printed power would be
    infinite. Unlike the released code, the paper neither switches the fan off below 5 C nor limits
    the airflow to V_ref.
    """
    air_m3s = _air_m3s(heat_w, point)
    air_ratio = air_m3s / point.reference_air_m3s
    moving = air_ratio > 0.0
    return _tower(
        np.where(moving, point.design_fan_w * np.where(moving, air_ratio, 1.0) ** -3.0, 0.0),
        air_ratio,
        leaving_c=point.condenser_setpoint_c,
        range_k=_range_k(heat_w, point.water_kg_s),
        wet_bulb_c=point.wet_bulb_c,
    )


def yorkcalc_size(design: TowerDesignPoint) -> TowerSize:
    """Size towers so that they meet the design approach at full airflow.

    Raises:
        SdcError: No airflow reaches the design approach.
    """
    return TowerSize(
        reference_water_kg_s=yorkcalc_reference_water_kg_s(
            design.water_kg_s,
            wet_bulb_c=design.wet_bulb_c,
            range_k=design.value("water_range_k"),
            approach_k=design.value("approach_min_k"),
        ),
        air_m3s=design.value("airflow_m3s_per_w_rejected") * design.rejected_w,
        fan_w=design.value("fan_w_per_w_rejected") * design.rejected_w,
    )


def released_size(design: TowerDesignPoint) -> TowerSize:
    """Size towers by the rule of the released SustainDC code.

    The design airflow carries the cooling load with a temperature rise of
    50 - (design outdoor - lowest setpoint) K. At full speed the fan power equals the cooling load.
    """
    rise_k = np.maximum(50.0 - (design.outdoor_c - design.lowest_setpoint_c), 1.0)
    air_m3s = design.cooling_w / (design.air_j_per_m3_k * rise_k)
    return TowerSize(design.water_kg_s, air_m3s, design.cooling_w)


def paper_size(design: TowerDesignPoint) -> TowerSize:
    """Size towers by the figures printed in the paper, whatever the load."""
    return TowerSize(
        design.water_kg_s, design.value("paper_airflow_m3s"), design.value("paper_fan_w")
    )


TOWERS: dict[str, TowerModel] = {
    "yorkcalc": TowerModel(yorkcalc, yorkcalc_size, water_loop=True),
    "released": TowerModel(released, released_size),
    "paper": TowerModel(paper, paper_size),
}
"""Tower models by their names, the valid values of ``hvac.tower.model``."""


def _approach_parabola(wet_bulb_c: Values, range_k: Values) -> tuple[Values, Values, Values]:
    """Return the coefficients of the approach in powers 0, 1 and 2 of the liquid-to-gas ratio."""
    t = np.clip(wet_bulb_c, *WET_BULB_BOUNDS_C)
    r = np.clip(range_k, 0.0, MAX_RANGE_K)
    in_range = [[p + t * (q + t * u) for p, q, u in powers] for powers in YORKCALC]
    a, b, c = (p + r * (q + r * u) for p, q, u in in_range)
    return a, b, c


def _approach_by_range(
    wet_bulb_c: Values, liquid_gas_ratio: Values
) -> tuple[Values, Values, Values]:
    """Return the coefficients of the approach in powers 0, 1 and 2 of the range."""
    t = np.clip(wet_bulb_c, *WET_BULB_BOUNDS_C)
    x = np.minimum(liquid_gas_ratio, MAX_LIQUID_GAS_RATIO)
    by_ratio = [[p + t * (q + t * u) for p, q, u in powers] for powers in YORKCALC]
    a, b, c = (r0 + x * (r1 + x * r2) for r0, r1, r2 in zip(*by_ratio, strict=True))
    return a, b, c


def _water_ratio(point: TowerPoint) -> Values:
    """Return the liquid-to-gas ratio at full fan speed; see ``OVERFED_SHARE``."""
    excess_kg_s = np.maximum(point.water_kg_s - point.cells_water_kg_s, 0.0)
    return (point.water_kg_s - OVERFED_SHARE * excess_kg_s) / point.reference_water_kg_s


def _fan_off_approach_k(wet_bulb_c: Values, range_k: Values, water_ratio: Values) -> F64:
    """Return the approach with the fan off (free convection only), in K."""
    at_full_speed_k = range_k / FREE_CONVECTION_SHARE
    full_speed_k = _approach_at(water_ratio, *_approach_parabola(wet_bulb_c, at_full_speed_k))
    return as_array(full_speed_k + at_full_speed_k - range_k)


def _free_convection_share(
    wet_bulb_c: Values, range_k: Values, water_ratio: Values, wanted_k: Values
) -> F64:
    """Return the share of the tower's free convection that holds the water at its setpoint, 0..1.

    Water that enters at wanted_k + range_k above the wet bulb is cooled by free convection by
    f*e*(wanted_k + range_k). Here e = R/(A_full(R) + R) is the effectiveness at full fan speed,
    range divided by the distance of the entering water from the wet bulb. It hardly depends on
    the load (EnergyPlus Engineering Reference, variable speed towers, free convection and fluid
    bypass). The bypass leads the rest of the water around the tower, so the airflow that takes up
    the heat is proportional to the heat. Without it, air would evaporate water by its own warmth
    alone, whatever the heat.
    """
    at_full_speed_k = range_k / FREE_CONVECTION_SHARE
    # The approach of YorkCalc does not vanish with the range, below the bound of its measurements.
    measured_k = np.maximum(at_full_speed_k, MIN_RANGE_K)
    approach_k = _approach_at(water_ratio, *_approach_parabola(wet_bulb_c, measured_k))
    effectiveness = measured_k / (approach_k + measured_k)
    reached_k = effectiveness * np.maximum(wanted_k + range_k, _LEAST_K)
    return as_array(np.minimum(at_full_speed_k / reached_k, 1.0))


def _range_k(heat_w: Values, water_kg_s: Values) -> F64:
    """Return the range Q/(c*m) of the tower water, in K, and 0 without water flow."""
    flowing = np.greater(water_kg_s, 0.0)
    carried = np.maximum(heat_w, 0.0) / (WATER_J_PER_KG_K * np.where(flowing, water_kg_s, 1.0))
    return as_array(np.where(flowing, carried, 0.0))


def _air_m3s(heat_w: Values, point: TowerPoint) -> F64:
    """Return the airflow, in m3/s, that carries a heat flow at a rise of 50 - (T_amb - T_set) K.

    The temperature rise is at least 1 K.
    """
    delta_k = np.maximum(50.0 - (point.outdoor_c - point.supply_setpoint_c), 1.0)
    return as_array(np.maximum(heat_w, 0.0) / (point.air_j_per_m3_k * delta_k))


def _tower(
    fan_w: Values, air_ratio: Values, *, leaving_c: Values, range_k: Values, wet_bulb_c: Values
) -> TowerResult:
    """Build the result of a step with all fields broadcast to the same shape."""
    return TowerResult(
        *np.broadcast_arrays(fan_w, air_ratio, leaving_c, range_k, leaving_c - wet_bulb_c)
    )
