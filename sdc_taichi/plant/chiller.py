"""Chillers: electric power for a cooling load, each model a pure function chosen by name.

Every model has the same signature, so a caller can look it up in `CHILLERS` and pass:

    load_w          cooling load, W; a load below zero counts as none
    reference_w     cooling capacity at the model's reference point, W
    chilled_water_c leaving chilled water, C
    condenser_c     entering condenser water, C
    outdoor_c       outdoor dry bulb, C (air-cooled models)
    reference_cop   coefficient of performance at the reference point, W/W
    min_plr         part-load ratio below which the machine cycles on and off, above 0; each model
                    has the default of its machine
    min_lift_k      smallest lift, entering condenser water over leaving chilled water, K

Arguments are float64 arrays of shape (B,), or anything that broadcasts to it. A model reads only
what its equations need. Temperatures beyond a curve's bounds are evaluated at the nearest bound:
`CHILLED_WATER_BOUNDS_C` and `CONDENSER_BOUNDS_C` name them. A plant makes no chilled water beyond
them: colder water is an error of the configuration, and for warmer air the water stays at the
warmest.

Sources: EnergyPlus Engineering Reference, "Chillers" (Chiller:Electric, Chiller:Electric:EIR,
Chiller:ConstantCOP); York and Trane data sets as in Modelica Buildings,
Fluid.Chillers.Data.ElectricEIR; coefficient sets of the EnergyPlus test files named at each model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sdc_taichi.types import F64, Values

KELVIN = 273.15
"""0 C in kelvin."""

# York YT 1055 kW / 5.96 COP, inlet vanes: biquadratics in (1, Te, Te^2, Tc, Tc^2, Te*Tc), C.
YORK_CAPACITY = (
    1.785912e-01,
    -5.900023e-02,
    -5.946963e-04,
    9.297889e-02,
    -2.841024e-03,
    4.974221e-03,
)
YORK_EIR = (5.245110e-01, -2.850126e-02, 8.034720e-04, 1.893133e-02, 1.151629e-04, -9.340642e-05)
YORK_PART_LOAD = (2.619878e-01, 2.393605e-01, 4.988306e-01)

# Trane CVHE 1442 kW / 6.61 COP with variable speed: part-load curve, and the lift at which its
# full-load energy input ratio would be 0 if it stayed a straight line.
VSD_PART_LOAD = (9.299787e-02, 3.244475e-01, 5.818753e-01)
VSD_LIFT_OFFSET_K = 22.0
"""Lift that ``centrifugal_vsd`` adds to that between the waters, in K.

Fitted to the full-load map of the Trane data set, 4.44..8.89 C chilled and 12.78..35 C condenser
water: 0.9 % root mean square, at most 3 %. It stands for the temperature differences in evaporator
and condenser, and for the efficiency that the compressor loses at low lift.
"""

CHILLED_WATER_BOUNDS_C: dict[str, tuple[float, float]] = {
    "centrifugal_vsd": (4.0, 20.0),
    "carnot": (4.0, 20.0),
    "eir_york": (4.44, 8.89),
}
"""Leaving chilled water within which each model is evaluated, in C; a plant makes no warmer."""
ANY_WATER_C = (0.0, 100.0)
"""Chilled water of models that have no bounds, in C."""
CONDENSER_BOUNDS_C: dict[str, tuple[float, float]] = {"eir_york": (12.78, 35.0)}
"""Entering condenser water within which each model is evaluated, in C."""

YORK_CHILLED_WATER_C = 6.67
"""Leaving chilled water at the reference point of the York data set, in C."""
YORK_CONDENSER_C = 29.44
"""Entering condenser water at the reference point of the York data set, in C."""

MIN_LIFT_K = 6.11
"""Smallest lift of ``carnot`` and ``centrifugal_vsd`` by default, in K.

The York data set admits condenser water down to 12.78 C against chilled water at 6.67 C: below that
difference a centrifugal compressor has no head to work against, and the flow through the expansion
device, not the lift, limits it. Without a floor a constant Carnot effectiveness diverges as the two
temperatures meet.
"""

MIN_DELTA_K = -15.0
"""Smallest temperature difference of Chiller:Electric, in K: its capacity parabola turns over near
it, and colder condenser water would start to cost capacity."""

ELECTRIC_PART_LOAD = (0.03303, 0.6852, 0.2818)
"""Power over full-load power of Chiller:Electric, a quadratic in the part-load ratio."""


@dataclass(frozen=True, slots=True)
class ChillerResult:
    """One step of the chillers of B data centers."""

    power_w: F64
    """Electric power, in W, (B,)."""
    evaporator_w: F64
    """Heat taken from the chilled water, in W, (B,); the load is evaporator_w + unmet_w."""
    available_w: F64
    """Cooling capacity under the present temperatures, in W, (B,)."""
    unmet_w: F64
    """Load beyond the available capacity, in W, (B,)."""
    plr: F64
    """Part-load ratio evaporator_w / available_w, 0..1, (B,); the mean over on and off when the
    machine cycles."""
    cop: F64
    """Coefficient of performance evaporator_w / power_w, in W/W, (B,); 0 when the machine is
    off."""
    rejected_w: F64
    """Heat that the model hands to the cooling tower, in W, (B,)."""


def chilled_water_bounds_c(model: str) -> tuple[float, float]:
    """Coldest and warmest chilled water of a model, in C."""
    return CHILLED_WATER_BOUNDS_C.get(model, ANY_WATER_C)


def centrifugal_vsd(
    load_w: Values,
    *,
    reference_w: Values,
    chilled_water_c: Values,
    condenser_c: Values,
    outdoor_c: Values,
    reference_cop: Values,
    min_plr: Values = 0.1,
    min_lift_k: Values = MIN_LIFT_K,
) -> ChillerResult:
    """Water-cooled centrifugal chiller with variable speed, fitted to a Trane CVHE of 1442 kW.

    COP = c * Te / (max(Tc - Te, min_lift_k) + 22 K) in kelvin, with c such that the COP is
    `reference_cop` at 6.67 C chilled and 29.44 C condenser water and full load (the data set has
    5.97 there); capacity does not depend on temperature. The part-load curve of the data set is
    divided by its value at full load (0.9993).

    Args:
        load_w: Cooling load, W.
        reference_w: Capacity, W.
        chilled_water_c: Leaving chilled water, C; evaluated within 4..20 C.
        condenser_c: Entering condenser water, C.
        outdoor_c: Not used.
        reference_cop: COP at the reference point.
        min_plr: Part-load ratio below which the machine cycles.
        min_lift_k: Smallest lift between the two waters, K.

    Returns:
        The chiller's step.
    """
    evaporator_k = np.clip(chilled_water_c, *CHILLED_WATER_BOUNDS_C["centrifugal_vsd"]) + KELVIN
    lift_k = np.maximum(condenser_c + KELVIN - evaporator_k, min_lift_k) + VSD_LIFT_OFFSET_K
    reference_lift_k = YORK_CONDENSER_C - YORK_CHILLED_WATER_C + VSD_LIFT_OFFSET_K
    reference_carnot = (YORK_CHILLED_WATER_C + KELVIN) / reference_lift_k
    return _from_curves(
        load_w,
        reference_w,
        eir=reference_carnot / reference_cop * lift_k / evaporator_k,
        part_load=tuple(c / sum(VSD_PART_LOAD) for c in VSD_PART_LOAD),
        min_plr=min_plr,
    )


def carnot(
    load_w: Values,
    *,
    reference_w: Values,
    chilled_water_c: Values,
    condenser_c: Values,
    outdoor_c: Values,
    reference_cop: Values,
    min_plr: Values = 0.1,
    min_lift_k: Values = MIN_LIFT_K,
) -> ChillerResult:
    """Constant Carnot effectiveness with the part-load curve of the York machine.

    COP = eta * Te / max(Tc - Te, min_lift_k) in kelvin, with eta such that the COP is
    `reference_cop` at 6.67 C chilled and 29.44 C condenser water and full load; capacity does not
    depend on temperature. The part-load curve is divided by its value at full load (1.0002).

    Args:
        load_w: Cooling load, W.
        reference_w: Capacity, W.
        chilled_water_c: Leaving chilled water, C; evaluated within 4..20 C.
        condenser_c: Entering condenser water, C.
        outdoor_c: Not used.
        reference_cop: COP at the reference point.
        min_plr: Part-load ratio below which the machine cycles.
        min_lift_k: Smallest lift between the two waters, K.

    Returns:
        The chiller's step.
    """
    evaporator_k = np.clip(chilled_water_c, *CHILLED_WATER_BOUNDS_C["carnot"]) + KELVIN
    lift_k = np.maximum(condenser_c + KELVIN - evaporator_k, min_lift_k)
    reference_carnot = (YORK_CHILLED_WATER_C + KELVIN) / (YORK_CONDENSER_C - YORK_CHILLED_WATER_C)
    full_load_cop = reference_cop / reference_carnot * evaporator_k / lift_k
    return _from_curves(
        load_w,
        reference_w,
        eir=1.0 / full_load_cop,
        part_load=tuple(c / sum(YORK_PART_LOAD) for c in YORK_PART_LOAD),
        min_plr=min_plr,
    )


def eir_york(
    load_w: Values,
    *,
    reference_w: Values,
    chilled_water_c: Values,
    condenser_c: Values,
    outdoor_c: Values,
    reference_cop: Values,
    min_plr: Values = 0.1,
    min_lift_k: Values = MIN_LIFT_K,
) -> ChillerResult:
    """York YT centrifugal chiller by its Chiller:Electric:EIR curves.

    Q_avail = Q_ref*CapFT, P = Q_avail/COP_ref*EIRFT*EIRFPLR*min(1, PLR/min_plr)
    (EnergyPlus Engineering Reference, Chiller:Electric:EIR). The curves are evaluated within
    4.44..8.89 C chilled and 12.78..35 C condenser water.

    Args:
        load_w: Cooling load, W.
        reference_w: Capacity at 6.67 C chilled and 29.44 C entering condenser water, W.
        chilled_water_c: Leaving chilled water, C.
        condenser_c: Entering condenser water, C.
        outdoor_c: Not used.
        reference_cop: COP at the reference point (5.96 for this machine).
        min_plr: Part-load ratio below which the machine cycles.
        min_lift_k: Not used.

    Returns:
        The chiller's step.
    """
    evaporator_c = np.clip(chilled_water_c, *CHILLED_WATER_BOUNDS_C["eir_york"])
    entering_c = np.clip(condenser_c, *CONDENSER_BOUNDS_C["eir_york"])
    return _from_curves(
        load_w,
        reference_w * _biquadratic(YORK_CAPACITY, evaporator_c, entering_c),
        eir=_biquadratic(YORK_EIR, evaporator_c, entering_c) / reference_cop,
        part_load=YORK_PART_LOAD,
        min_plr=min_plr,
    )


def electric_water_cooled(
    load_w: Values,
    *,
    reference_w: Values,
    chilled_water_c: Values,
    condenser_c: Values,
    outdoor_c: Values,
    reference_cop: Values,
    min_plr: Values = 0.15,
    min_lift_k: Values = MIN_LIFT_K,
) -> ChillerResult:
    """Water-cooled Chiller:Electric (EnergyPlus Engineering Reference, after BLAST).

    Coefficients of the EnergyPlus unit test ChillerElectric; its nominal COP is 4.75.

    Args:
        load_w: Cooling load, W.
        reference_w: Nominal capacity (6.667 C chilled, 29.44 C condenser water), W.
        chilled_water_c: Leaving chilled water, C.
        condenser_c: Entering condenser water, C.
        outdoor_c: Not used.
        reference_cop: Nominal COP.
        min_plr: Part-load ratio below which the machine cycles.
        min_lift_k: Not used.

    Returns:
        The chiller's step.
    """
    delta_k = (condenser_c - 29.44) / 2.682759 - (chilled_water_c - 6.667)
    return _electric(
        load_w,
        reference_w=reference_w,
        delta_k=np.maximum(delta_k, MIN_DELTA_K),
        capacity_ratio=(0.944836, -0.0570088, -0.00185486),
        power_ratio=(1.907846, -1.204987, 0.2634623),
        reference_cop=reference_cop,
        min_plr=min_plr,
    )


def electric_air_cooled(
    load_w: Values,
    *,
    reference_w: Values,
    chilled_water_c: Values,
    condenser_c: Values,
    outdoor_c: Values,
    reference_cop: Values,
    min_plr: Values = 0.05,
    min_lift_k: Values = MIN_LIFT_K,
) -> ChillerResult:
    """Air-cooled Chiller:Electric: the condenser sees the outdoor dry bulb.

    Coefficients of the EnergyPlus test file AirCooledElectricChiller.idf.

    Args:
        load_w: Cooling load, W.
        reference_w: Nominal capacity (6.67 C chilled water, 35 C outdoors), W.
        chilled_water_c: Leaving chilled water, C.
        condenser_c: Not used.
        outdoor_c: Outdoor dry bulb, C.
        reference_cop: Nominal COP.
        min_plr: Part-load ratio below which the machine cycles.
        min_lift_k: Not used.

    Returns:
        The chiller's step.
    """
    delta_k = (outdoor_c - 35.0) / 2.778 - (chilled_water_c - 6.67)
    return _electric(
        load_w,
        reference_w=reference_w,
        delta_k=np.maximum(delta_k, MIN_DELTA_K),
        capacity_ratio=(0.9949, -0.045954, -0.0013543),
        power_ratio=(2.333, -1.975, 0.6121),
        reference_cop=reference_cop,
        min_plr=min_plr,
    )


def constant_cop(
    load_w: Values,
    *,
    reference_w: Values,
    chilled_water_c: Values,
    condenser_c: Values,
    outdoor_c: Values,
    reference_cop: Values,
    min_plr: Values = 0.0,
    min_lift_k: Values = MIN_LIFT_K,
) -> ChillerResult:
    """Constant COP up to the capacity (EnergyPlus Engineering Reference, Chiller:ConstantCOP).

    Args:
        load_w: Cooling load, W.
        reference_w: Capacity, W.
        chilled_water_c: Not used.
        condenser_c: Not used.
        outdoor_c: Not used.
        reference_cop: COP.
        min_plr: Not used.
        min_lift_k: Not used.

    Returns:
        The chiller's step.
    """
    load = np.maximum(load_w, 0.0)
    evaporator_w = np.minimum(load, reference_w)
    power_w = evaporator_w / reference_cop
    return _chiller(load, evaporator_w, reference_w, power_w, rejected_w=evaporator_w + power_w)


def released(
    load_w: Values,
    *,
    reference_w: Values,
    chilled_water_c: Values,
    condenser_c: Values,
    outdoor_c: Values,
    reference_cop: Values,
    min_plr: Values = 0.05,
    min_lift_k: Values = MIN_LIFT_K,
) -> ChillerResult:
    """The chiller of the released SustainDC code: Chiller:Electric with three departures.

    The difference from design is (T_amb - 35)/2.778 - (6.67 - 35), so the chilled water never
    enters and 28.33 K too much does; the last capacity coefficient is positive; the cooling load,
    not the heat rejected by the condenser, goes to the tower. As a consequence capacity grows as
    it gets hotter above -1 C outdoors, and at part load power falls.

    Args:
        load_w: Cooling load, W.
        reference_w: Largest cooling load of the sizing day, W.
        chilled_water_c: Not used.
        condenser_c: Not used.
        outdoor_c: Outdoor dry bulb, C.
        reference_cop: COP; the released code has 3.
        min_plr: Part-load ratio below which the machine cycles.
        min_lift_k: Not used.

    Returns:
        The chiller's step.
    """
    result = _electric(
        load_w,
        reference_w=reference_w,
        delta_k=(outdoor_c - 35.0) / 2.778 - (6.67 - 35.0),
        capacity_ratio=(0.944836, -0.0570088, 0.00185486),
        power_ratio=(2.333, -1.975, 0.6121),
        reference_cop=reference_cop,
        min_plr=min_plr,
    )
    return replace(result, rejected_w=result.evaporator_w + result.unmet_w)


def paper(
    load_w: Values,
    *,
    reference_w: Values,
    chilled_water_c: Values,
    condenser_c: Values,
    outdoor_c: Values,
    reference_cop: Values,
    min_plr: Values = 0.0,
    min_lift_k: Values = MIN_LIFT_K,
) -> ChillerResult:
    """Appendix A.2.2 as printed: P_chiller = P_cool*(1 + 1/COP), counted as electricity.

    The term is the heat a condenser rejects; the paper adds it to the HVAC power and hands the
    same quantity to the tower. No capacity is printed, so none limits the load.

    Args:
        load_w: Cooling load, W.
        reference_w: Capacity the part-load ratio refers to, W; it limits nothing.
        chilled_water_c: Not used.
        condenser_c: Not used.
        outdoor_c: Not used.
        reference_cop: COP (CHILLER_COP_BASE of the configuration).
        min_plr: Not used.
        min_lift_k: Not used.

    Returns:
        The chiller's step.
    """
    load = np.maximum(load_w, 0.0)
    power_w = load * (1.0 + 1.0 / reference_cop)
    return _chiller(load, load, np.maximum(reference_w, load), power_w, rejected_w=power_w)


CHILLERS: dict[str, Callable[..., ChillerResult]] = {
    "centrifugal_vsd": centrifugal_vsd,
    "carnot": carnot,
    "eir_york": eir_york,
    "electric_water_cooled": electric_water_cooled,
    "electric_air_cooled": electric_air_cooled,
    "constant_cop": constant_cop,
    "released": released,
    "paper": paper,
}
"""Chiller models by the names that ``hvac.chiller.model`` takes."""
REFERENCE_COPS = {"electric_water_cooled": 4.75, "electric_air_cooled": 3.0, "released": 3.0}
"""COP at the reference point of machines other than the default, in W/W, by their models."""
DEFAULT_REFERENCE_COP = 5.96
"""COP at the reference point of the York machine, and of the Trane machine, in W/W."""
AIR_COOLED = frozenset({"electric_air_cooled", "constant_cop"})
"""Models of chillers that reject their heat to outdoor air."""


def _electric(
    load_w: Values,
    *,
    reference_w: Values,
    delta_k: Values,
    capacity_ratio: tuple[float, float, float],
    power_ratio: tuple[float, float, float],
    reference_cop: Values,
    min_plr: Values,
) -> ChillerResult:
    """Chiller:Electric: capacity from the temperature difference, full-load power from capacity."""
    capacity = np.maximum(_quadratic(capacity_ratio, delta_k), 0.0)
    return _from_curves(
        load_w,
        reference_w * capacity,
        eir=_quadratic(power_ratio, capacity) / reference_cop,
        part_load=ELECTRIC_PART_LOAD,
        min_plr=min_plr,
    )


def _from_curves(
    load_w: Values,
    available_w: Values,
    *,
    eir: Values,
    part_load: tuple[float, ...],
    min_plr: Values,
) -> ChillerResult:
    """Power from the energy input ratio at full load, a part-load curve, and cycling.

    P = Q_avail*EIR*f(max(PLR, min_plr))*min(1, PLR/min_plr) (EnergyPlus Engineering Reference,
    Chiller:Electric:EIR).
    """
    load = np.maximum(load_w, 0.0)
    evaporator_w = np.minimum(load, available_w)
    plr = _quotient(evaporator_w, available_w)
    cycling = np.minimum(plr / min_plr, 1.0)
    power_w = available_w * eir * _quadratic(part_load, np.maximum(plr, min_plr)) * cycling
    return _chiller(load, evaporator_w, available_w, power_w, rejected_w=evaporator_w + power_w)


def _chiller(
    load_w: Values,
    evaporator_w: Values,
    available_w: Values,
    power_w: Values,
    *,
    rejected_w: Values,
) -> ChillerResult:
    """Result of a step, with unmet load, part-load ratio and COP from the heat and the power."""
    load, evaporator, available, power, rejected = np.broadcast_arrays(
        load_w, evaporator_w, available_w, power_w, rejected_w
    )
    return ChillerResult(
        power_w=power,
        evaporator_w=evaporator,
        available_w=available,
        unmet_w=load - evaporator,
        plr=_quotient(evaporator, available),
        cop=_quotient(evaporator, power),
        rejected_w=rejected,
    )


def _quotient(numerator: Values, denominator: Values) -> F64:
    """Numerator / denominator, 0 where the denominator is 0."""
    positive = np.greater(denominator, 0.0)
    result: F64 = np.where(positive, numerator / np.where(positive, denominator, 1.0), 0.0)
    return result


def _quadratic(c: tuple[float, ...], x: Values) -> Values:
    """c0 + c1*x + c2*x^2."""
    return c[0] + x * (c[1] + x * c[2])


def _biquadratic(c: tuple[float, ...], x: Values, y: Values) -> Values:
    """c0 + c1*x + c2*x^2 + c3*y + c4*y^2 + c5*x*y."""
    return c[0] + c[1] * x + c[2] * x**2 + c[3] * y + c[4] * y**2 + c[5] * x * y
