"""Sizing of all devices of a fleet for design load and design weather."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sdc_taichi.errors import PhysicalLimitError
from sdc_taichi.exogenous import site_pressure_pa
from sdc_taichi.kernels.arguments import row_index
from sdc_taichi.kernels.hall_arguments import DC_COEFFICIENTS
from sdc_taichi.plant import moist_air
from sdc_taichi.plant.chiller import CHILLERS, ChillerParameters, ChillerPoint, ChillerResult
from sdc_taichi.plant.electrical import NO_LIMIT_KW, LossyDevice, PowerPath
from sdc_taichi.plant.plants import PLANTS
from sdc_taichi.plant.tower import TOWERS, TowerDesignPoint, design_water_kg_s
from sdc_taichi.plant.water_side import WaterSideDesign, hydraulic_pump_w
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions, HallSums
from sdc_taichi.sim.liquid_fleet import liquid_design
from sdc_taichi.types import F64, Values, fields_of

WATER_DENSITY_KG_M3 = 1000.0
"""Density of water, in kg/m3."""
WATER_J_PER_M3_K = 4.19e6
"""Volumetric heat capacity of water, in J/(m3 K)."""
STRATIFIED_SHARE = 0.9
"""Share of the water of a stratified tank that leaves it at the supply temperature, or figure of
merit: up to 0.9 in measurements (Karim 2009, Performance evaluation of a stratified chilled-water
thermal storage system)."""
RELEASED_OUTDOOR_C = {"NY": 30.0, "WA": 20.0}
"""Design dry bulbs of the released SustainDC, in C, by the first two letters of the site; 50 C for
all other sites."""

OFF_DESIGN_MARGIN = 1.05
"""Maximum factor of chiller capacity to design load at water temperatures off the design point; it
covers the growth of IT power with the setpoint, a few percent."""
_SLOPE_K = 5.0
"""Distance of the condenser-water temperatures that give the slope of the chiller's power, in K."""
_LOADS = (0.2, 0.6)
"""Loads of the chiller, as shares of its reference capacity, that give the dependences on load."""
_GRID = np.linspace(0.0, 1.0, 5)
"""Positions, within their ranges, of the water temperatures for which chiller capacity is
checked."""


@dataclass(frozen=True, slots=True)
class ChilledWaterDesign:
    """Chilled water and buffer tanks of B data centers, which store heat in transient halls."""

    loop_j_per_k: F64
    """Heat capacity of the water in pipes, coils and chiller, in J/K, (B,)."""
    mixed_tank_j_per_k: F64
    """Heat capacity of the water in a mixed tank, in J/K, (B,); 0 without such a tank."""
    stratified_tank_j: F64
    """Heat that a stratified tank takes up at the design range of the water, in J, (B,); 0 without
    such a tank."""


@dataclass(frozen=True, slots=True)
class Sizing:
    """Sized devices of B data centers."""

    it_w: F64
    """IT power at full load and design supply air, in W, (B,)."""
    it_airflow_m3s: F64
    """Airflow through the servers at full load and design supply air, in m3/s, (B,)."""
    crac_flow_m3s: F64
    """Total airflow of the CRAC units at full fan speed, in m3/s, (B,)."""
    crac_fan_w: F64
    """Total power of the CRAC fans at full speed, in W, (B,)."""
    design_outdoor_c: F64
    """Design dry bulb of the site, in C, (B,)."""
    design_wet_bulb_c: F64
    """Design wet bulb of the site, in C, (B,)."""
    facility_w: F64
    """IT power, HVAC power and ``counted_loss_w`` at the design point, in W, (B,)."""
    counted_loss_w: F64
    """Losses of UPS and distribution at the design point, in W, (B,); 0 if the losses are reported
    without being counted in the facility power."""
    battery_kwh: F64
    """Capacity of the battery, in kWh, (B,)."""
    grid_limit_kw: F64
    """Power limit of the grid connection, in kW, (B,); ``NO_LIMIT_KW`` without a limit."""
    room_kwh_per_k: F64
    """Heat capacity of the room, in kWh/K, (B,); in quasi-steady halls with the servers."""
    chilled_water: ChilledWaterDesign
    """Chilled water and buffer tank."""
    water_side: WaterSideDesign
    """Sized chiller, tower, pumps and economiser."""
    power_path: PowerPath
    """Sized UPS and distribution."""


def size(fleet: Fleet, hall: Hall, design_outdoor_c: F64, design_wet_bulb_c: F64) -> Sizing:
    """Size every device of a fleet by the configured sizing model.

    Args:
        fleet: B data centers.
        hall: Hall solver of the fleet; its precision limits the precision of the sizes.
        design_outdoor_c: Design dry bulb of each site's weather, in C, (B,); a configured value
            takes precedence.
        design_wet_bulb_c: Design wet bulb of each site's weather, in C, (B,); a configured value
            takes precedence.

    Raises:
        PhysicalLimitError: The size of a device is negative, infinite or NaN.
    """
    outdoor_c = fleet.values("hvac.sizing.design_outdoor_c")
    wet_bulb_c = fleet.values("hvac.sizing.design_wet_bulb_c")
    model = MODELS[fleet.models["sizing"]]
    sized = model(
        fleet,
        hall,
        np.where(np.isnan(outdoor_c), design_outdoor_c, outdoor_c),
        np.where(np.isnan(wet_bulb_c), design_wet_bulb_c, wet_bulb_c),
    )
    _check_sizes(fleet, sized)
    return sized


def _check_sizes(fleet: Fleet, sized: Sizing) -> None:
    """Check that capacities, flows and powers of sized devices are finite and not negative."""
    sizes = fields_of(sized) | fields_of(sized.water_side) | fields_of(sized.chilled_water)
    for name, values in sizes.items():
        skipped = "water_side", "power_path", "machine", "chilled_water"
        if name in skipped or name.endswith(("_c", "_w_k")):
            continue
        wrong = ~(np.isfinite(values) & (values >= 0))
        if wrong.any():
            dc = int(np.argmax(wrong))
            raise PhysicalLimitError(
                f"{fleet.names[dc]}: sized {name} is {values[dc]:g}; physical is a finite number "
                "of at least 0. Power, airflow and setpoints of the configuration do not fit "
                "together"
            )


def design_day(fleet: Fleet, hall: Hall, outdoor_c: F64, wet_bulb_c: F64) -> Sizing:
    """Size devices for full load, design supply air and design weather, plus a margin.

    The margin is ``hvac.sizing.margin``.

    Args:
        fleet: B data centers.
        hall: Hall solver of the fleet.
        outdoor_c: Design dry bulb, in C, (B,).
        wet_bulb_c: Design wet bulb, in C, (B,).
    """
    v = fleet.values
    full = _solve(fleet, hall, v("hall.design_supply_c"), np.ones(fleet.size))
    it_w = air_w = full.cpu_w + full.it_fan_w
    liquid_overhead_w: F64 | float = 0.0
    facility_water_w = np.zeros(fleet.size)
    if fleet.liquid is not None:
        liquid = liquid_design(fleet.liquid)
        it_w, air_w = air_w + liquid.liquid_w, air_w + liquid.to_air_w
        liquid_overhead_w, facility_water_w = liquid.overhead_w, liquid.to_plant_w
    crac_flow_m3s = fleet.unit_sums(fleet.unit_design_m3s)
    crac_fan_w = v("hvac.crac.fan_w_per_m3s") * crac_flow_m3s
    # With spare units, all units run at part speed.
    crac_at_design_w = crac_fan_w * fleet.design_speed**3
    cooling_w = (air_w + crac_at_design_w) * v("hvac.sizing.margin") + facility_water_w
    pump_heat_w = v("hvac.pumps.heat_to_water_share") * _chilled_pump_w(fleet, cooling_w)
    chiller_w, at_design, fullest_c = _design_chiller(
        fleet, cooling_w + pump_heat_w, outdoor_c, wet_bulb_c
    )
    water_side = _water_side(
        fleet,
        cooling_w,
        chiller_w,
        at_design.rejected_w,
        crac_flow_m3s,
        outdoor_c,
        wet_bulb_c,
        facility_water_w,
    )
    water_side = replace(water_side, fullest_condenser_c=fullest_c)
    power_path, counted_loss_w = _power_path(fleet, it_w)
    facility_w = (
        it_w
        + counted_loss_w
        + crac_at_design_w
        + at_design.power_w
        + water_side.tower_fan_w
        + water_side.chilled_pump_w
        + water_side.condenser_pump_w
        + liquid_overhead_w
    )
    hours = v("battery.hours_of_design_load")
    return Sizing(
        it_w=it_w,
        it_airflow_m3s=full.it_airflow_m3s,
        crac_flow_m3s=crac_flow_m3s,
        crac_fan_w=crac_fan_w,
        design_outdoor_c=outdoor_c,
        design_wet_bulb_c=wet_bulb_c,
        facility_w=facility_w,
        counted_loss_w=counted_loss_w,
        battery_kwh=_battery_kwh(fleet, facility_w * hours / 1e3),
        grid_limit_kw=_grid_limit_kw(fleet, facility_w / 1e3),
        room_kwh_per_k=_room_kwh_per_k(fleet),
        chilled_water=_chilled_water(fleet, cooling_w),
        water_side=water_side,
        power_path=power_path,
    )


def released(fleet: Fleet, hall: Hall, outdoor_c: F64, wet_bulb_c: F64) -> Sizing:
    """Size devices by the rules of the released SustainDC.

    The rated load is the heat that cools the return air at full load and maximum setpoint down to
    the minimum setpoint. The tower's airflow removes this load with a temperature difference of
    50 - (design outdoor - minimum setpoint) K. The battery stores one hour of 1.1 times the sum of
    maximum IT power at supply temperatures of 15..22 C, rated load and chiller power.

    Args:
        fleet: B data centers.
        hall: Hall solver of the fleet.
        outdoor_c: Design dry bulb, in C, (B,); ignored in favour of ``RELEASED_OUTDOOR_C``.
        wet_bulb_c: Design wet bulb, in C, (B,).
    """
    v = fleet.values
    listed_c = np.array(
        [RELEASED_OUTDOOR_C.get(c.site.location.upper()[:2], 50.0) for c in fleet.configs]
    )
    configured_c = v("hvac.sizing.design_outdoor_c")
    outdoor_c = np.where(np.isnan(configured_c), listed_c, configured_c)
    low_c, supply_m3s_per_w = v("hvac.setpoint.min_c"), v("hvac.crac.supply_m3s_per_w")
    full = _solve(fleet, hall, v("hvac.setpoint.max_c"), np.ones(fleet.size))
    it_w = full.cpu_w + full.it_fan_w
    crac_flow_m3s = supply_m3s_per_w * it_w
    rise_k = np.maximum(full.outlet_mean_c + mean_return_approach_k(fleet) - low_c, 0.0)
    rated_w = air_j_per_m3_k(fleet) * crac_flow_m3s * rise_k
    highest_w = released_ranges(fleet, hall)["it_w"][1]
    machine = CHILLERS["released"].step(
        highest_w,
        ChillerPoint(
            reference_w=rated_w,
            chilled_water_c=low_c,
            condenser_c=outdoor_c,
            outdoor_c=outdoor_c,
            machine=_machine(fleet),
        ),
    )
    power_path, counted_loss_w = _power_path(fleet, it_w)
    facility_w = 1.1 * (highest_w + rated_w + machine.power_w) + counted_loss_w
    flow_ratio = supply_m3s_per_w / v("hvac.crac.reference_m3s_per_w")
    return Sizing(
        it_w=it_w,
        it_airflow_m3s=full.it_airflow_m3s,
        crac_flow_m3s=crac_flow_m3s,
        crac_fan_w=v("hvac.crac.released_fan_w") * flow_ratio**3,
        design_outdoor_c=outdoor_c,
        design_wet_bulb_c=wet_bulb_c,
        facility_w=facility_w,
        counted_loss_w=counted_loss_w,
        battery_kwh=_battery_kwh(fleet, facility_w / 1e3),
        grid_limit_kw=_grid_limit_kw(fleet, facility_w / 1e3),
        room_kwh_per_k=_room_kwh_per_k(fleet),
        chilled_water=_chilled_water(fleet, rated_w),
        water_side=_water_side(
            fleet, rated_w, rated_w, rated_w, crac_flow_m3s, outdoor_c, wet_bulb_c
        ),
        power_path=power_path,
    )


MODELS: dict[str, Callable[[Fleet, Hall, F64, F64], Sizing]] = {
    "design_day": design_day,
    "released": released,
}
"""Sizing models by their names in ``hvac.sizing.model``."""


def released_ranges(fleet: Fleet, hall: Hall) -> dict[str, tuple[F64, F64]]:
    """Return ranges of IT power and outlet temperature for supply air of 15..22 C and any load.

    Returns:
        Minimum and maximum, (B,) each, of ``it_w``, the IT power in W, and of ``outlet_c``, the
        mean outlet temperature in C.
    """
    it_w, outlet_c = [], []
    for supply_c in range(15, 23):
        for percent in range(0, 101, 10):
            sums = _solve(
                fleet,
                hall,
                np.full(fleet.size, float(supply_c)),
                np.full(fleet.size, percent / 100),
            )
            it_w.append(sums.cpu_w + sums.it_fan_w)
            outlet_c.append(sums.outlet_mean_c)
    return {
        "it_w": (np.min(it_w, axis=0), np.max(it_w, axis=0)),
        "outlet_c": (np.min(outlet_c, axis=0), np.max(outlet_c, axis=0)),
    }


def _solve(fleet: Fleet, hall: Hall, supply_c: F64, utilisation: F64) -> HallSums:
    """Solve the halls without failures, at a supply temperature and the design CRAC airflow."""
    speed = fleet.design_speed[fleet.unit_dc]
    supply_c = supply_c[fleet.unit_dc]
    return hall.solve(Conditions(supply_c, utilisation, unit_low=speed, unit_high=speed))


def air_j_per_m3_k(fleet: Fleet) -> F64:
    """Return the volumetric heat capacity of air, in J/(m3 K), (B,)."""
    return np.asarray(fleet.dcs[row_index(DC_COEFFICIENTS, "air_j_per_m3_k")])


def sites_pressure_pa(fleet: Fleet) -> F64:
    """Return the standard-atmosphere pressure at the elevation of each site, in Pa, (B,)."""
    places = [(c.site.location, c.site.weather_file) for c in fleet.configs]
    pressure_pa = {place: site_pressure_pa(*place) for place in dict.fromkeys(places)}
    return np.array([pressure_pa[place] for place in places])


def mean_return_approach_k(fleet: Fleet) -> F64:
    """Compute the mean over the racks of the return approach temperature, in K, (B,)."""
    return np.array([np.mean(np.asarray(c.hall.return_approach_k)) for c in fleet.configs])


def _machine(fleet: Fleet) -> ChillerParameters:
    """Return the chiller parameters; the default of the COP is that of the chiller model."""
    configured = {name: fleet.values(f"hvac.chiller.{name}") for name in ChillerParameters._fields}
    usual = CHILLERS[fleet.models["chiller"]].reference_cop
    cop = configured.pop("reference_cop")
    return ChillerParameters(reference_cop=np.where(np.isnan(cop), usual, cop), **configured)


def _design_chiller(
    fleet: Fleet, cooling_w: F64, outdoor_c: F64, wet_bulb_c: F64
) -> tuple[F64, ChillerResult, F64]:
    """Size the chiller.

    At the design wet bulb, the chiller cools ``cooling_w``, which includes the sizing margin. At
    all other water temperatures of the plant, it cools the load without this margin plus up to
    5 %. These are chilled water for every setpoint, and condenser water from the minimum of the
    chiller up to the design temperature, because capacity can fall in cold condenser water.

    Returns:
        Reference capacity in W; result of the chiller at the design point; and the condenser water
        temperature of maximum capacity in C; (B,) each.

    Raises:
        PhysicalLimitError: The chiller has no capacity at some of these temperatures.
    """
    v, name = fleet.values, fleet.models["chiller"]
    model, machine = CHILLERS[name], _machine(fleet)
    zero_w, unit_w = np.zeros(fleet.size), np.ones(fleet.size)

    def at(chilled_c: F64, condenser_c: F64, load_w: F64, reference_w: F64) -> ChillerResult:
        point = ChillerPoint(reference_w, chilled_c, condenser_c, outdoor_c, machine)
        return model.step(load_w, point)

    coldest_c = v("hvac.chiller.min_condenser_c")
    design_c = np.maximum(wet_bulb_c + v("hvac.tower.approach_min_k"), coldest_c)
    water_below_k = fleet.setpoint_over_supply_k + v("hvac.chiller.coil_approach_k")
    low_c, high_c = (
        np.minimum(v(f"hvac.setpoint.{end}_c") - water_below_k, model.warmest_water_c)
        for end in ("min", "max")
    )
    chilled_c = [low_c + x * (high_c - low_c) for x in _GRID]
    condenser_c = [coldest_c + x * (design_c - coldest_c) for x in _GRID]
    w_per_w = np.array(
        [[at(c, t, zero_w, unit_w).available_w for c in chilled_c] for t in condenser_c]
    ).min(axis=1)
    design_w_per_w = at(low_c, design_c, zero_w, unit_w).available_w
    least_w_per_w = np.minimum(w_per_w.min(axis=0), design_w_per_w)
    if not PLANTS[fleet.models["plant"]].dry and TOWERS[fleet.models["tower"]].water_loop:
        too_warm = design_c > v("hvac.chiller.max_condenser_c")
        least_w_per_w = np.where(too_warm, 0.0, least_w_per_w)
    if np.any(least_w_per_w <= 0):
        dc = int(np.argmin(least_w_per_w))
        raise PhysicalLimitError(
            f"{fleet.names[dc]}: hvac.chiller.model {name} has no capacity at its design weather, "
            f"{design_c[dc]:g} C of condenser water and {outdoor_c[dc]:g} C outdoors; valid are a "
            "lower hvac.chiller.min_condenser_c, tower approach or design temperature"
        )
    margin = v("hvac.sizing.margin")
    share = np.minimum(margin, OFF_DESIGN_MARGIN) / margin
    chiller_w = cooling_w * np.maximum(1.0 / design_w_per_w, share / least_w_per_w)
    # Chiller power is highest at the coldest chilled water.
    at_design = at(low_c, design_c, cooling_w, chiller_w)
    return chiller_w, at_design, np.choose(w_per_w.argmax(axis=0), condenser_c)


def _water_side(
    fleet: Fleet,
    cooling_w: F64,
    chiller_w: F64,
    rejected_w: F64,
    crac_flow_m3s: F64,
    outdoor_c: F64,
    wet_bulb_c: F64,
    facility_water_w: Values = 0.0,
) -> WaterSideDesign:
    """Size tower, pumps and economiser for the given heat flows and CRAC airflow, (B,) each.

    ``cooling_w`` contains ``facility_water_w``, which the coils do not remove.
    """
    v = fleet.values
    approach_k = v("hvac.tower.approach_min_k")
    if PLANTS[fleet.models["plant"]].dry:
        outdoor = _dry_units(fleet, cooling_w, crac_flow_m3s)
    else:
        outdoor = _tower(fleet, cooling_w, rejected_w, outdoor_c, wet_bulb_c)
    return WaterSideDesign(
        cooling_w=cooling_w,
        chiller_w=chiller_w,
        machine=_machine(fleet),
        rejected_w=rejected_w,
        coil_approach_k=v("hvac.chiller.coil_approach_k"),
        chilled_water_range_k=v("hvac.chiller.chilled_water_range_k"),
        coil_valves=v("hvac.chiller.coil_valves"),
        approach_min_k=approach_k,
        exchanger_approach_k=v("hvac.tower.economiser_approach_k") - approach_k,
        min_condenser_c=v("hvac.chiller.min_condenser_c"),
        fullest_condenser_c=v("hvac.chiller.min_condenser_c"),
        tower_range_k=v("hvac.tower.water_range_k"),
        max_condenser_c=v("hvac.chiller.max_condenser_c"),
        coil_rise_k=(cooling_w - facility_water_w) / (air_j_per_m3_k(fleet) * crac_flow_m3s),
        facility_water_w=facility_water_w,
        **_condenser_slopes(fleet, outdoor_c, wet_bulb_c),
        warmest_chilled_c=np.full(fleet.size, CHILLERS[fleet.models["chiller"]].warmest_water_c),
        pumped_w=cooling_w,
        outdoor_units=np.ones(fleet.size),
        dry_cooler_approach_k=v("hvac.dry_cooler.approach_k"),
        **_outdoor_air_limits(fleet),
        **outdoor,
        **_pumps(fleet, cooling_w, rejected_w),
    )


def _condenser_slopes(fleet: Fleet, outdoor_c: F64, wet_bulb_c: F64) -> dict[str, F64]:
    """Return what the reset of the condenser water needs to know of the chiller, (B,) each.

    The figures are those of the setpoint in the middle of its range, and of linear dependences on
    condenser water and load.
    """
    v, model = fleet.values, CHILLERS[fleet.models["chiller"]]
    machine, ones = _machine(fleet), np.ones(fleet.size)
    coldest_c, hottest_c = v("hvac.chiller.min_condenser_c"), v("hvac.chiller.max_condenser_c")
    design_c = np.maximum(wet_bulb_c + v("hvac.tower.approach_min_k"), coldest_c)
    middle_c = 0.5 * (v("hvac.setpoint.min_c") + v("hvac.setpoint.max_c"))
    water_below_k = fleet.setpoint_over_supply_k + v("hvac.chiller.coil_approach_k")
    chilled_c = np.minimum(middle_c - water_below_k, model.warmest_water_c)

    def power(load: float, condenser_c: F64) -> F64:
        point = ChillerPoint(ones, chilled_c, condenser_c, outdoor_c, machine)
        return np.asarray(model.step(load * ones, point).power_w)

    low, high = _LOADS
    at_low, at_high = (
        (power(load, design_c) - power(load, design_c - _SLOPE_K)) / _SLOPE_K for load in _LOADS
    )
    by_load, load_w_per_w = (
        (of_high - of_low) / (high - low)
        for of_high, of_low in (
            (at_high, at_low),
            (power(high, coldest_c), power(low, coldest_c)),
        )
    )
    return {
        "design_condenser_c": design_c,
        "hot_evaporator_share": high / (high + power(high, hottest_c)),
        "idle_w_per_w_k": at_low - low * by_load,
        "load_w_per_w_k": by_load,
        "idle_w_per_w": np.maximum(power(low, coldest_c) - low * load_w_per_w, 0.0),
        "load_w_per_w": np.maximum(load_w_per_w, 0.0),
    }


def _outdoor_air_limits(fleet: Fleet) -> dict[str, F64]:
    """Return the limits of vapour pressure (Pa) and relative humidity for outdoor air, (B,)."""
    v = fleet.values
    least_pa, most_pa = (
        np.asarray(moist_air.saturation_pa(v(f"hvac.outdoor_air.{end}_dew_point_c")))
        for end in ("min", "max")
    )
    return {
        "pressure_pa": sites_pressure_pa(fleet),
        "least_vapour_pa": least_pa,
        "most_vapour_pa": most_pa,
        "humidifier": v("hvac.outdoor_air.humidifier"),
        "most_humidity": v("hvac.outdoor_air.max_humidity_pct") / 100.0,
    }


def _dry_units(fleet: Fleet, cooling_w: F64, crac_flow_m3s: F64) -> dict[str, F64]:
    """Size the fans of a dry cooler or of outdoor air, as fields of a tower without water."""
    v = fleet.values
    sized = {
        "economiser": v("hvac.dry_cooler.free_cooling"),
        "tower_water_kg_s": np.zeros(fleet.size),
        "tower_reference_kg_s": np.zeros(fleet.size),
        "tower_air_m3s": np.zeros(fleet.size),
        "tower_fan_w": v("hvac.dry_cooler.fan_w_per_w_cooled") * cooling_w,
        "air_j_per_m3_k": air_j_per_m3_k(fleet),
    }
    if fleet.models["plant"] == "air_side":
        sized["tower_air_m3s"] = crac_flow_m3s
        sized["tower_fan_w"] = v("hvac.outdoor_air.fan_w_per_m3s") * crac_flow_m3s
    return sized


def _tower(
    fleet: Fleet, cooling_w: F64, rejected_w: F64, outdoor_c: F64, wet_bulb_c: F64
) -> dict[str, F64]:
    """Size water flow, airflow and fan of the tower by the rule of its model."""
    v, air = fleet.values, air_j_per_m3_k(fleet)
    range_k = v("hvac.tower.water_range_k")
    water_kg_s = np.asarray(design_water_kg_s(rejected_w, range_k=range_k))
    tower = TOWERS[fleet.models["tower"]].size(
        TowerDesignPoint(
            cooling_w=cooling_w,
            rejected_w=rejected_w,
            water_kg_s=water_kg_s,
            outdoor_c=outdoor_c,
            wet_bulb_c=wet_bulb_c,
            lowest_setpoint_c=v("hvac.setpoint.min_c"),
            air_j_per_m3_k=air,
            value=lambda name: v(f"hvac.tower.{name}"),
        )
    )
    return {
        "economiser": v("hvac.tower.economiser"),
        "tower_water_kg_s": water_kg_s,
        "tower_reference_kg_s": tower.reference_water_kg_s,
        "tower_air_m3s": tower.air_m3s,
        "tower_fan_w": tower.fan_w,
        "air_j_per_m3_k": air,
    }


def _pumps(fleet: Fleet, cooling_w: F64, rejected_w: F64) -> dict[str, F64]:
    """Return power and limits of the chilled-water pumps and of the condenser or dry-cooler pumps.

    Pump model ``released`` uses configured powers; other models size the pumps for their flow.
    """
    v = fleet.values
    chilled = {
        "chilled_pump_w": _chilled_pump_w(fleet, cooling_w),
        "pump_heat_share": v("hvac.pumps.heat_to_water_share"),
    }
    if fleet.models["pumps"] == "released":
        return {
            **chilled,
            "condenser_pump_w": v("hvac.pumps.released_condenser_w"),
            "pump_min_ratio": np.ones(fleet.size),
        }
    second_loop_w = {
        "water_cooled": _sized_pump_w(fleet, rejected_w, v("hvac.tower.water_range_k")),
        "air_cooled": chilled["chilled_pump_w"] * v("hvac.dry_cooler.free_cooling"),
        "air_side": np.zeros(fleet.size),
    }
    return {
        **chilled,
        "condenser_pump_w": second_loop_w[fleet.models["plant"]],
        "pump_min_ratio": v("hvac.pumps.min_flow_ratio"),
    }


def _chilled_pump_w(fleet: Fleet, cooling_w: F64) -> F64:
    """Return the design power of the chilled-water pumps, in W, (B,)."""
    if fleet.models["pumps"] == "released":
        return fleet.values("hvac.pumps.released_chilled_w")
    return _sized_pump_w(fleet, cooling_w, fleet.values("hvac.chiller.chilled_water_range_k"))


def _sized_pump_w(fleet: Fleet, heat_w: F64, range_k: F64) -> F64:
    """Return the power of pumps in W, (B,), for a heat flow (W) and a water range (K)."""
    v = fleet.values
    flow = np.asarray(design_water_kg_s(heat_w, range_k=range_k)) / WATER_DENSITY_KG_M3
    return hydraulic_pump_w(
        v("hvac.pumps.pressure_drop_pa"), flow, efficiency=v("hvac.pumps.efficiency")
    )


def _battery_kwh(fleet: Fleet, sized_kwh: F64) -> F64:
    """Return the battery capacity in kWh, (B,): the configured value, or ``sized_kwh``."""
    configured_kwh = fleet.values("battery.capacity_kwh")
    return np.where(np.isnan(configured_kwh), sized_kwh, configured_kwh)


def _power_path(fleet: Fleet, it_w: F64) -> tuple[PowerPath, F64]:
    """Size UPS and distribution for an IT power in W, (B,).

    Returns:
        The sized devices, and the losses that count in the facility power, in W, (B,).
    """

    def device(name: str, carried_w: F64) -> LossyDevice:
        rated_w = fleet.values("electrical.capacity_ratio") * carried_w
        shares = LossyDevice._fields[1:]
        return LossyDevice(rated_w, *(fleet.values(f"electrical.{name}.{s}") for s in shares))

    distribution = device("distribution", it_w)
    path = PowerPath(device("ups", np.asarray(it_w + distribution.loss_w(it_w))), distribution)
    counted = fleet.configs[0].electrical.losses == "counted"
    return path, np.asarray(sum(path.losses_w(it_w)) if counted else 0.0 * it_w)


def _grid_limit_kw(fleet: Fleet, design_kw: F64) -> F64:
    """Return the grid connection limit in kW, (B,): configured, or a ratio to the design power."""
    configured_kw = fleet.values("electrical.grid_limit_kw")
    ratio = fleet.values("electrical.grid_limit_ratio")
    sized_kw = np.where(np.isnan(ratio), NO_LIMIT_KW, ratio * design_kw)
    limit_kw = np.where(np.isnan(configured_kw), sized_kw, configured_kw)
    return np.minimum(limit_kw, NO_LIMIT_KW)


def _chilled_water(fleet: Fleet, cooling_w: F64) -> ChilledWaterDesign:
    """Return the chilled water and the tanks for a cooling capacity in W, (B,)."""
    v = fleet.values
    loop_m3 = v("hvac.chilled_water.volume_l_per_kw") * cooling_w / 1e6
    tank_m3 = v("hvac.chilled_water.tank_m3")
    is_mixed = np.array([c.hvac.chilled_water.tank == "mixed" for c in fleet.configs])
    usable_k = STRATIFIED_SHARE * v("hvac.chiller.chilled_water_range_k")
    return ChilledWaterDesign(
        loop_j_per_k=WATER_J_PER_M3_K * loop_m3,
        mixed_tank_j_per_k=WATER_J_PER_M3_K * tank_m3 * is_mixed,
        stratified_tank_j=WATER_J_PER_M3_K * tank_m3 * usable_k * ~is_mixed,
    )


def _room_kwh_per_k(fleet: Fleet) -> F64:
    """Return the heat capacity of the room, in kWh/K, (B,).

    In quasi-steady halls it includes the servers. In transient halls, servers and the air before
    the racks have separate temperatures.
    """
    per_server = fleet.values("room_heat_capacity_kj_per_k")
    if fleet.models["thermal"] == "quasi_steady":
        per_server = per_server + fleet.values("server_heat_capacity_kj_per_k")
    return np.asarray(per_server * fleet.per_dc_servers() / 3600.0)
