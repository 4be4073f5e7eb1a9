"""Chillers: electric power for a cooling load, one record per model in ``CHILLERS``.

A record holds the equations of a model, the medium that cools its condenser (tower water or outdoor
air), its reference COP, and the temperatures within which its curves are valid. The valid values of
``hvac.chiller.model``, the plant of a chiller, its sizing and the table in the documentation are
derived from the records.

The equations take the load and a ``ChillerPoint`` of float64 arrays (B,), B data centers, or
anything that broadcasts to that shape. A negative load counts as zero. Temperatures beyond the
bounds of a record are replaced by the nearest bound.

Sources: EnergyPlus Engineering Reference, "Chillers" (Chiller:Electric, Chiller:Electric:EIR,
Chiller:ConstantCOP); York and Trane data sets as in Modelica Buildings,
Fluid.Chillers.Data.ElectricEIR; coefficient sets of the EnergyPlus test files named at each model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64, Values

KELVIN = 273.15
"""Temperature of 0 C, in K."""
FREEZING_C, BOILING_C = 0.0, 100.0
"""Range of the chilled water of models without bounds, in C."""

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

# Part-load curve of the Trane CVHE 1442 kW / 6.61 COP with variable speed. Its energy input ratio
# at full load is nearly linear in the lift and would reach 0 at the negative of the lift offset.
VSD_PART_LOAD = (9.299787e-02, 3.244475e-01, 5.818753e-01)
VSD_CAPACITY_PER_K = 0.046
"""Capacity that ``centrifugal_vsd`` loses per kelvin of lift above that of its reference point,
as a share of its reference capacity, in 1/K. Within 0.03, it gives the capacities of the Trane
data set at lifts of 22.8 to 30.6 K, divided by that at the reference point."""
VSD_LIFT_OFFSET_K = 22.0
"""Lift that ``centrifugal_vsd`` adds to condenser minus chilled-water temperature, in K.

The value is fitted to the full-load map of the Trane data set (4.44..8.89 C chilled water,
12.78..35 C condenser water), with a root-mean-square error of 0.9 % and a largest error of 3 %. It
represents the temperature differences inside evaporator and condenser, and the efficiency that the
compressor loses at low lift.
"""

YORK_CHILLED_WATER_C = 6.67
"""Leaving chilled-water temperature at the reference point of the York data set, in C."""
YORK_CONDENSER_C = 29.44
"""Entering condenser-water temperature at the reference point of the York data set, in C."""

YORK_COP = 5.96
"""COP of the York chiller at its reference point, also used for the Trane chiller, in W/W."""
MIN_LIFT_K = 6.11
"""Smallest lift of ``carnot`` and ``centrifugal_vsd`` by default, in K.

The York data set allows condenser water down to 12.78 C with chilled water at 6.67 C, a difference
of 6.11 K. At smaller differences the flow through the expansion device, not the lift, limits a
centrifugal compressor. Without a smallest lift, the COP of a constant Carnot effectiveness would
diverge as the two temperatures become equal.
"""

ELECTRIC_DELTA = (29.44, 2.682759, 6.667)
"""Condenser water at the reference point of ``electric_water_cooled`` in C, its change divided by
the change of the chilled water at constant capacity, and chilled water at that point in C."""
MIN_DELTA_K = -15.0
"""Smallest temperature difference at which Chiller:Electric is evaluated, in K. Its capacity is a
parabola with a maximum near this value; below it, colder condenser water would reduce capacity."""

# Curves of eir_air_cooled, in x = (outdoor air - 35) - 0.8*(leaving chilled water - 6.67), in K.
AIR_COOLED_EIR = (1.0, 0.0263, 0.00037)
AIR_COOLED_WATER_PER_AIR = 0.8
AIR_COOLED_CAPACITY = (1.0, 0.0327, -0.0114, -0.00043)
AIR_COOLED_PART_LOAD = (0.003, 0.907, 0.09)
AIR_COOLED_REFERENCE_C = (6.67, 35.0)
"""Leaving chilled water and outdoor air at the reference point of ``eir_air_cooled``, in C (AHRI
550/590)."""
AIR_COOLED_BOUNDS_C = (10.0, 60.0)
"""Outdoor temperatures at which ``eir_air_cooled`` is evaluated, in C.

Air colder than the lower bound does not help, because head-pressure control slows the condenser
fans to keep the condensing pressure that the expansion valves need; the lowest temperature in the
catalogue is 12.8 C. At the upper bound, no compressor runs.
"""
AIR_COOLED_UNLOADS_C = 52.0
"""Outdoor temperature above which the compressors of ``eir_air_cooled`` unload because their
pressure is at its limit, in C; York publishes ratings up to 51.7 C."""

ELECTRIC_PART_LOAD = (0.03303, 0.6852, 0.2818)
"""Coefficients of power divided by full-load power of Chiller:Electric, in powers 0, 1 and 2 of the
part-load ratio."""


@dataclass(frozen=True, slots=True)
class ChillerResult:
    """One step of the chillers of B data centers."""

    power_w: F64
    """Electric power, in W, (B,)."""
    evaporator_w: F64
    """Heat taken from the chilled water, in W, (B,); the load is evaporator_w + unmet_w."""
    available_w: F64
    """Cooling capacity at the temperatures of the step, in W, (B,)."""
    unmet_w: F64
    """Part of the load above the available capacity, in W, (B,)."""
    plr: F64
    """Part-load ratio evaporator_w / available_w, 0..1, (B,); for a chiller that cycles, the mean
    over its on and off times."""
    cop: F64
    """Coefficient of performance evaporator_w / power_w, in W/W, (B,); 0 when the chiller is
    off."""
    rejected_w: F64
    """Heat that the model passes to the cooling tower, in W, (B,)."""


class ChillerParameters(NamedTuple):
    """Parameters of a chiller, named like the fields of the section ``hvac.chiller``."""

    reference_cop: Values
    """Coefficient of performance at the reference point of the model, in W/W, (B,)."""
    min_lift_k: Values = MIN_LIFT_K
    """Smallest lift (entering condenser water minus leaving chilled water), in K, (B,)."""


class ChillerPoint(NamedTuple):
    """Chiller size, temperatures and parameters in one step."""

    reference_w: Values
    """Cooling capacity at the reference point of the model, in W, (B,)."""
    chilled_water_c: Values
    """Leaving chilled-water temperature, in C, (B,)."""
    condenser_c: Values
    """Entering condenser-water temperature, in C, (B,)."""
    outdoor_c: Values
    """Outdoor dry-bulb temperature, in C, (B,)."""
    machine: ChillerParameters
    """Chiller parameters from the configuration."""


@dataclass(frozen=True, slots=True)
class ChillerModel:
    """Chiller model: its equations and the properties that plants and sizing need."""

    equations: Callable[[Values, ChillerPoint], ChillerResult]
    """Function from a cooling load in W, (B,), and a point within the bounds to power and heat."""
    least_useful_c: Callable[[Values, ChillerParameters], Values] | None = None
    """Function from leaving chilled-water temperature, in C, (B,), and parameters to the entering
    condenser-water temperature below which colder condenser water no longer saves power, in C,
    (B,); None if there is no such temperature."""
    tower_water: bool = True
    """True if the water of a cooling tower can cool the condenser."""
    outdoor_air: bool = False
    """True if outdoor air can cool the condenser."""
    reference_cop: float = YORK_COP
    """Default COP at the reference point, in W/W, used if the configuration sets none."""
    chilled_water_bounds_c: tuple[float, float] | None = None
    """Lowest and highest leaving chilled-water temperature for which the curves are valid, in C;
    None allows any value. A configuration that needs colder water is an error. If the supply air
    would allow warmer water, the plant makes water at the upper bound."""
    condenser_bounds_c: tuple[float, float] | None = None
    """Lowest and highest entering condenser-water temperature for which the curves are valid, in C;
    None allows any value."""

    @property
    def water_range_c(self) -> tuple[float, float]:
        """Lowest and highest chilled-water temperature that may be commanded, in C."""
        return self.chilled_water_bounds_c or (FREEZING_C, BOILING_C)

    @property
    def warmest_water_c(self) -> float:
        """Highest chilled-water temperature of a plant with this chiller, in C."""
        return self.water_range_c[1]

    def step(self, load_w: Values, point: ChillerPoint) -> ChillerResult:
        """Compute one step of the chillers of B data centers.

        Args:
            load_w: Cooling load, W, (B,).
            point: Chiller sizes, temperatures and parameters.
        """
        if self.chilled_water_bounds_c is not None:
            bounded_c = np.clip(point.chilled_water_c, *self.chilled_water_bounds_c)
            point = point._replace(chilled_water_c=bounded_c)
        if self.condenser_bounds_c is not None:
            bounded_c = np.clip(point.condenser_c, *self.condenser_bounds_c)
            point = point._replace(condenser_c=bounded_c)
        return self.equations(load_w, point)


def centrifugal_vsd(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """Water-cooled centrifugal chiller with variable speed, fitted to a Trane CVHE of 1442 kW.

    COP = c * Te / (max(Tc - Te, min_lift_k) + 22 K), with the temperatures of leaving chilled water
    Te and entering condenser water Tc in kelvin. The constant c is chosen so that the COP is
    `reference_cop` at 6.67 C chilled water, 29.44 C condenser water and full load (5.97 in the
    data set). Above the lift of that point the capacity falls in proportion to the lift. The
    part-load curve of the data set is divided by its value at full load (0.9993).
    """
    evaporator_k = point.chilled_water_c + KELVIN
    water_lift_k = point.condenser_c + KELVIN - evaporator_k
    lift_k = np.maximum(water_lift_k, point.machine.min_lift_k) + VSD_LIFT_OFFSET_K
    full_lift_k = YORK_CONDENSER_C - YORK_CHILLED_WATER_C
    reference_lift_k = full_lift_k + VSD_LIFT_OFFSET_K
    lost = VSD_CAPACITY_PER_K * np.maximum(water_lift_k - full_lift_k, 0.0)
    reference_carnot = (YORK_CHILLED_WATER_C + KELVIN) / reference_lift_k
    return _from_curves(
        load_w,
        point.reference_w * np.maximum(1.0 - lost, 0.0),
        eir=reference_carnot / point.machine.reference_cop * lift_k / evaporator_k,
        part_load=tuple(c / sum(VSD_PART_LOAD) for c in VSD_PART_LOAD),
        min_plr=0.1,
    )


def carnot(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """Constant Carnot effectiveness with the part-load curve of a York YT chiller.

    COP = eta * Te / max(Tc - Te, min_lift_k), with the temperatures of leaving chilled water Te and
    entering condenser water Tc in kelvin. The effectiveness eta is chosen so that the COP is
    `reference_cop` at 6.67 C chilled water, 29.44 C condenser water and full load. Capacity does
    not depend on temperature. The part-load curve is divided by its value at full load (1.0002).
    """
    evaporator_k = point.chilled_water_c + KELVIN
    lift_k = np.maximum(point.condenser_c + KELVIN - evaporator_k, point.machine.min_lift_k)
    reference_carnot = (YORK_CHILLED_WATER_C + KELVIN) / (YORK_CONDENSER_C - YORK_CHILLED_WATER_C)
    full_load_cop = point.machine.reference_cop / reference_carnot * evaporator_k / lift_k
    return _from_curves(
        load_w,
        point.reference_w,
        eir=1.0 / full_load_cop,
        part_load=tuple(c / sum(YORK_PART_LOAD) for c in YORK_PART_LOAD),
        min_plr=0.1,
    )


def eir_york(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """York YT centrifugal chiller with its Chiller:Electric:EIR curves.

    The available capacity is Q_avail = Q_ref*CapFT and the power is
    P = Q_avail/COP_ref*EIRFT*EIRFPLR*min(1, PLR/min_plr)
    (EnergyPlus Engineering Reference, Chiller:Electric:EIR).
    """
    evaporator_c, entering_c = point.chilled_water_c, point.condenser_c
    return _from_curves(
        load_w,
        point.reference_w * biquadratic(YORK_CAPACITY, evaporator_c, entering_c),
        eir=biquadratic(YORK_EIR, evaporator_c, entering_c) / point.machine.reference_cop,
        part_load=YORK_PART_LOAD,
        min_plr=0.1,
    )


def electric_water_cooled(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """Water-cooled Chiller:Electric (EnergyPlus Engineering Reference, after BLAST).

    The coefficients are those of the EnergyPlus unit test ChillerElectric, whose nominal COP is
    4.75.
    """
    condenser_c, per_chilled_k, chilled_water_c = ELECTRIC_DELTA
    delta_k = (point.condenser_c - condenser_c) / per_chilled_k - (
        point.chilled_water_c - chilled_water_c
    )
    return _electric(
        load_w,
        reference_w=point.reference_w,
        delta_k=np.maximum(delta_k, MIN_DELTA_K),
        capacity_ratio=(0.944836, -0.0570088, -0.00185486),
        power_ratio=(1.907846, -1.204987, 0.2634623),
        reference_cop=point.machine.reference_cop,
        min_plr=0.15,
    )


def electric_air_cooled(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """Air-cooled Chiller:Electric, whose condenser takes in air at the outdoor dry bulb.

    The coefficients are those of the EnergyPlus test file AirCooledElectricChiller.idf.
    """
    delta_k = (point.outdoor_c - 35.0) / 2.778 - (point.chilled_water_c - 6.67)
    return _electric(
        load_w,
        reference_w=point.reference_w,
        delta_k=np.maximum(delta_k, MIN_DELTA_K),
        capacity_ratio=(0.9949, -0.045954, -0.0013543),
        power_ratio=(2.333, -1.975, 0.6121),
        reference_cop=point.machine.reference_cop,
        min_plr=0.05,
    )


def eir_air_cooled(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """Air-cooled chiller with scroll or screw compressors, condenser fans included.

    The form is that of Chiller:Electric:EIR (see ``eir_york``). The energy input ratio at full load
    is a parabola in the lift between outdoor air and chilled water, which is evaluated down to its
    minimum, so that neither colder air nor warmer water ever costs power:

        x = (T_outdoor - 35) - 0.8 (T_chilled - 6.67),  EIRFT = 1 + 0.0263 x + 0.00037 x^2
        CapFT = 1 + 0.0327 (T_chilled - 6.67) - 0.0114 (T_outdoor - 35)
                - 0.00043 (T_chilled - 6.67) (T_outdoor - 35)
        EIRFPLR = 0.003 + 0.907 PLR + 0.09 PLR^2

    The coefficients are fitted to the catalogue of a Trane CGAF (CG-PRC007-EN, 2003: EER 9.7 at
    35 C and full load, 11.9 at 29.2 C and 82 %, 14.8 at 18.5 C and 52 %, 17.6 at 12.8 C and 32 %),
    which they meet within 3.5 %, and to the full-load curves of screw and scroll chillers in the
    OpenStudio standards (after DOE-2), which they meet within 5 % at 4.4..10 C of water and
    23.9..46.1 C of air. Below a quarter of their capacity, the machines cycle on and off. Above
    52 C outdoors the compressors unload, down to nothing at 60 C.
    """
    water_c, air_c = AIR_COOLED_REFERENCE_C
    outdoor_c = np.clip(point.outdoor_c, *AIR_COOLED_BOUNDS_C)
    warmer_k, hotter_k = point.chilled_water_c - water_c, outdoor_c - air_c
    constant, slope, curvature = AIR_COOLED_EIR
    lift_k = np.maximum(hotter_k - AIR_COOLED_WATER_PER_AIR * warmer_k, -slope / (2.0 * curvature))
    base, by_water, by_air, by_both = AIR_COOLED_CAPACITY
    capacity = base + by_water * warmer_k + hotter_k * (by_air + by_both * warmer_k)
    hottest_c = AIR_COOLED_BOUNDS_C[1]
    loaded = np.minimum((hottest_c - outdoor_c) / (hottest_c - AIR_COOLED_UNLOADS_C), 1.0)
    return _from_curves(
        load_w,
        point.reference_w * capacity * loaded,
        eir=_quadratic((constant, slope, curvature), lift_k) / point.machine.reference_cop,
        part_load=AIR_COOLED_PART_LOAD,
        min_plr=0.25,
    )


def constant_cop(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """Constant COP up to the capacity (EnergyPlus Engineering Reference, Chiller:ConstantCOP)."""
    load = np.maximum(load_w, 0.0)
    evaporator_w = np.minimum(load, point.reference_w)
    power_w = evaporator_w / point.machine.reference_cop
    return _chiller(
        load, evaporator_w, point.reference_w, power_w, rejected_w=evaporator_w + power_w
    )


def released(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """Chiller of the released SustainDC code: Chiller:Electric with three departures.

    First, the temperature difference from design is (T_amb - 35)/2.778 - (6.67 - 35), which ignores
    the chilled-water temperature and is 28.33 K too large. Second, the last capacity coefficient is
    positive. Third, the tower receives the cooling load instead of the heat rejected by the
    condenser. As a consequence, above -1 C outdoors, capacity grows with the outdoor temperature,
    and power at part load falls with it.
    """
    result = _electric(
        load_w,
        reference_w=point.reference_w,
        delta_k=(point.outdoor_c - 35.0) / 2.778 - (6.67 - 35.0),
        capacity_ratio=(0.944836, -0.0570088, 0.00185486),
        power_ratio=(2.333, -1.975, 0.6121),
        reference_cop=point.machine.reference_cop,
        min_plr=0.05,
    )
    return replace(result, rejected_w=result.evaporator_w + result.unmet_w)


def paper(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """Chiller of the SustainDC paper (appendix A.2.2): power P_chiller = P_cool*(1 + 1/COP).

    This expression is the heat that a condenser rejects, but the paper adds it to the HVAC power
    and also passes it to the tower. The paper states no capacity, so the load is not limited.
    """
    load = np.maximum(load_w, 0.0)
    power_w = load * (1.0 + 1.0 / point.machine.reference_cop)
    return _chiller(load, load, np.maximum(point.reference_w, load), power_w, rejected_w=power_w)


def _at_least_lift(chilled_water_c: Values, machine: ChillerParameters) -> Values:
    """Return the condenser water at the smallest lift, in C, (B,)."""
    return chilled_water_c + machine.min_lift_k


def _at_least_delta(chilled_water_c: Values, machine: ChillerParameters) -> Values:
    """Return the condenser water at ``MIN_DELTA_K`` of ``electric_water_cooled``, in C, (B,)."""
    condenser_c, per_chilled_k, reference_c = ELECTRIC_DELTA
    return condenser_c + per_chilled_k * (chilled_water_c - reference_c + MIN_DELTA_K)


CHILLERS: dict[str, ChillerModel] = {
    "centrifugal_vsd": ChillerModel(
        centrifugal_vsd, least_useful_c=_at_least_lift, chilled_water_bounds_c=(4.0, 20.0)
    ),
    "carnot": ChillerModel(
        carnot, least_useful_c=_at_least_lift, chilled_water_bounds_c=(4.0, 20.0)
    ),
    "eir_york": ChillerModel(
        eir_york, chilled_water_bounds_c=(4.44, 8.89), condenser_bounds_c=(12.78, 35.0)
    ),
    "electric_water_cooled": ChillerModel(
        electric_water_cooled, least_useful_c=_at_least_delta, reference_cop=4.75
    ),
    "electric_air_cooled": ChillerModel(
        electric_air_cooled, tower_water=False, outdoor_air=True, reference_cop=3.0
    ),
    "eir_air_cooled": ChillerModel(
        eir_air_cooled,
        tower_water=False,
        outdoor_air=True,
        reference_cop=2.84,
        chilled_water_bounds_c=(4.0, 20.0),
    ),
    "constant_cop": ChillerModel(constant_cop, outdoor_air=True),
    "released": ChillerModel(released, reference_cop=3.0),
    "paper": ChillerModel(paper),
}
"""Chiller models by their names, the valid values of ``hvac.chiller.model``."""


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
    """Step a Chiller:Electric, whose capacity depends on a temperature difference ``delta_k``.

    Its power at full load depends on that capacity.
    """
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
    """Compute power from the energy input ratio at full load, a part-load curve, and cycling.

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
    """Build the result of a step, with unmet load, part-load ratio and COP."""
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
    """Return numerator / denominator, and 0 where the denominator is 0."""
    positive = np.greater(denominator, 0.0)
    result: F64 = np.where(positive, numerator / np.where(positive, denominator, 1.0), 0.0)
    return result


def _quadratic(c: tuple[float, ...], x: Values) -> Values:
    """Return the quadratic c0 + c1*x + c2*x^2."""
    return c[0] + x * (c[1] + x * c[2])


def biquadratic(c: tuple[float, ...], x: Values, y: Values) -> Values:
    """Return the biquadratic c0 + c1*x + c2*x^2 + c3*y + c4*y^2 + c5*x*y."""
    return c[0] + c[1] * x + c[2] * x**2 + c[3] * y + c[4] * y**2 + c[5] * x * y
