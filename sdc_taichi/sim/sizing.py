"""Size every device of a fleet for its load and its site."""

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
from sdc_taichi.sim.hall_solver import Conditions, Hall, HallSums
from sdc_taichi.types import F64, fields_of

WATER_DENSITY_KG_M3 = 1000.0
"""Density of water, in kg/m3."""
RELEASED_OUTDOOR_C = {"NY": 30.0, "WA": 20.0}
"""Design dry bulbs of the released SustainDC, in C, by the first letters of the site; else 50 C."""

OFF_DESIGN_MARGIN = 1.05
"""Largest margin of the chiller's capacity over the design load at other than the design water;
power and airflow of a hall grow by a few percent with its setpoint."""
_GRID = np.linspace(0.0, 1.0, 5)
"""Where within their ranges the temperatures of the water are tried at which a chiller is sized."""


@dataclass(frozen=True, slots=True)
class Sizing:
    """Sized devices of B data centers."""

    it_w: F64
    """IT power at full load and design supply air, in W, (B,)."""
    it_airflow_m3s: F64
    """Airflow through the servers at full load and design supply air, in m3/s, (B,)."""
    crac_flow_m3s: F64
    """Airflow of the CRAC units at full fan speed, in m3/s, (B,)."""
    crac_fan_w: F64
    """Power of the CRAC fans at full speed, in W, (B,)."""
    design_outdoor_c: F64
    """Design dry bulb of the site, in C, (B,)."""
    design_wet_bulb_c: F64
    """Design wet bulb of the site, in C, (B,)."""
    facility_w: F64
    """IT and HVAC power at the design point, and ``counted_loss_w``, in W, (B,)."""
    counted_loss_w: F64
    """Losses of UPS and distribution at the design point, in W, (B,); 0 where they are only
    reported."""
    battery_kwh: F64
    """Capacity of the battery, in kWh, (B,)."""
    grid_limit_kw: F64
    """Most power that the grid connection carries, in kW, (B,); ``NO_LIMIT_KW`` without a limit."""
    room_kwh_per_k: F64
    """Heat that warms the room, and its servers if quasi-steady, by 1 K, in kWh/K, (B,)."""
    water_side: WaterSideDesign
    """Sized chiller, tower, pumps and economiser."""
    power_path: PowerPath
    """Sized UPS and distribution."""


def size(fleet: Fleet, hall: Hall, design_outdoor_c: F64, design_wet_bulb_c: F64) -> Sizing:
    """Size every device of a fleet by the sizing model that its configs name.

    Args:
        fleet: B data centers.
        hall: Their halls; sizes are as exact as its precision.
        design_outdoor_c: Design dry bulb of each site's weather, C, (B,); that of a config goes
            first.
        design_wet_bulb_c: Design wet bulb of each site's weather, C, (B,); that of a config goes
            first.

    Raises:
        PhysicalLimitError: A device whose size is negative, infinite or not a number.
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
    """Make sure that devices can be built: capacities, flows and powers are finite and positive."""
    sizes = fields_of(sized) | fields_of(sized.water_side)
    for name, values in sizes.items():
        if name in ("water_side", "power_path", "machine") or name.endswith("_c"):
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
    """Full load, design supply air and design wet bulb, with the margin of the config on top.

    Args:
        fleet: B data centers.
        hall: Their halls.
        outdoor_c: Design dry bulb, C, (B,).
        wet_bulb_c: Design wet bulb, C, (B,).
    """
    v = fleet.values
    full = _solve(fleet, hall, v("hall.design_supply_c"), np.ones(fleet.size))
    it_w = full.cpu_w + full.it_fan_w
    crac_flow_m3s = fleet.unit_sums(fleet.unit_design_m3s)
    crac_fan_w = v("hvac.crac.fan_w_per_m3s") * crac_flow_m3s
    # Spare units let all run at part speed.
    crac_at_design_w = crac_fan_w * fleet.design_speed**3
    cooling_w = (it_w + crac_at_design_w) * v("hvac.sizing.margin")
    pump_heat_w = v("hvac.pumps.heat_to_water_share") * _chilled_pump_w(fleet, cooling_w)
    chiller_w, at_design, fullest_c = _design_chiller(
        fleet, cooling_w + pump_heat_w, outdoor_c, wet_bulb_c
    )
    water_side = _water_side(
        fleet, cooling_w, chiller_w, at_design.rejected_w, crac_flow_m3s, outdoor_c, wet_bulb_c
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
        water_side=water_side,
        power_path=power_path,
    )


def released(fleet: Fleet, hall: Hall, outdoor_c: F64, wet_bulb_c: F64) -> Sizing:
    """The sizing rules of the released SustainDC.

    Tower air and rated load: the cooling load at full load and highest setpoint, taken down to the
    lowest setpoint, with 50 - (design outdoor - lowest setpoint) K of air. Battery: one hour of
    1.1 times the highest IT power of 15..22 C plus 1.1 times rated load and chiller power.

    Args:
        fleet: B data centers.
        hall: Their halls.
        outdoor_c: Design dry bulb, C, (B,); not used, sites have those of ``RELEASED_OUTDOOR_C``.
        wet_bulb_c: Design wet bulb, C, (B,).
    """
    v = fleet.values
    listed_c = np.array(
        [RELEASED_OUTDOOR_C.get(c.site.location.upper()[:2], 50.0) for c in fleet.configs]
    )
    given_c = v("hvac.sizing.design_outdoor_c")
    outdoor_c = np.where(np.isnan(given_c), listed_c, given_c)
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
        water_side=_water_side(
            fleet, rated_w, rated_w, rated_w, crac_flow_m3s, outdoor_c, wet_bulb_c
        ),
        power_path=power_path,
    )


MODELS: dict[str, Callable[[Fleet, Hall, F64, F64], Sizing]] = {
    "design_day": design_day,
    "released": released,
}
"""Sizing models by the names that ``hvac.sizing.model`` takes."""


def released_ranges(fleet: Fleet, hall: Hall) -> dict[str, tuple[F64, F64]]:
    """Lowest and highest values of a fleet over 15..22 C of supply air and 0..100 % of load.

    Returns:
        ``it_w``: IT power, W; ``outlet_c``: mean outlet, C; each as lowest and highest, (B,).
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
    """The hall in order, at one supply temperature and the CRAC airflow of the design point."""
    speed = fleet.design_speed[fleet.unit_dc]
    supply_c = supply_c[fleet.unit_dc]
    return hall.solve(Conditions(supply_c, utilisation, unit_low=speed, unit_high=speed))


def air_j_per_m3_k(fleet: Fleet) -> F64:
    """Heat capacity of air per volume, J/(m3 K), (B,)."""
    return np.asarray(fleet.dcs[row_index(DC_COEFFICIENTS, "air_j_per_m3_k")])


def sites_pressure_pa(fleet: Fleet) -> F64:
    """Air pressure of the standard atmosphere at the height of each site, Pa, (B,)."""
    places = [(c.site.location, c.site.weather_file) for c in fleet.configs]
    pressure_pa = {place: site_pressure_pa(*place) for place in dict.fromkeys(places)}
    return np.array([pressure_pa[place] for place in places])


def mean_return_approach_k(fleet: Fleet) -> F64:
    """Return approach temperature, mean over the racks, K, (B,)."""
    return np.array([np.mean(np.asarray(c.hall.return_approach_k)) for c in fleet.configs])


def _machine(fleet: Fleet) -> ChillerParameters:
    """Parameters of the chillers; the COP is that of the model where the config gives none."""
    configured = {name: fleet.values(f"hvac.chiller.{name}") for name in ChillerParameters._fields}
    usual = CHILLERS[fleet.models["chiller"]].reference_cop
    cop = configured.pop("reference_cop")
    return ChillerParameters(reference_cop=np.where(np.isnan(cop), usual, cop), **configured)


def _design_chiller(
    fleet: Fleet, cooling_w: F64, outdoor_c: F64, wet_bulb_c: F64
) -> tuple[F64, ChillerResult, F64]:
    """Size of the chiller.

    It cools ``cooling_w`` at the design wet bulb, and the load within, with a margin of up to 5 %,
    with any other water that the plant meets: chilled water of every setpoint, condenser water from
    the coldest that the chiller takes. Capacity may fall in cold condenser water.

    Returns:
        Reference capacity, W, the chiller as it cools at design, and the condenser water at which
        it has most capacity, C, each (B,).

    Raises:
        PhysicalLimitError: The chiller has no capacity in such weather.
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
    # The coldest chilled water asks most of the chiller.
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
) -> WaterSideDesign:
    """Chiller, tower, pumps and economiser for the given heat and CRAC airflow, each (B,)."""
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
        warmest_chilled_c=np.full(fleet.size, CHILLERS[fleet.models["chiller"]].warmest_water_c),
        pumped_w=cooling_w,
        outdoor_units=np.ones(fleet.size),
        dry_cooler_approach_k=v("hvac.dry_cooler.approach_k"),
        **_outdoor_air_limits(fleet),
        **outdoor,
        **_pumps(fleet, cooling_w, rejected_w),
    )


def _outdoor_air_limits(fleet: Fleet) -> dict[str, F64]:
    """Vapour pressures, Pa, and relative humidity within which outdoor air is let in, (B,)."""
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
    """Fans of a dry cooler or of outdoor air, in the fields of a tower, which has no water."""
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
    """Water, air and fan of the tower, by the rule of its model."""
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
    """Pumps of chilled water and of the loop outdoors: sized for their flow, or unscaled."""
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
    """Power of the chilled-water pumps at design, W, (B,)."""
    if fleet.models["pumps"] == "released":
        return fleet.values("hvac.pumps.released_chilled_w")
    return _sized_pump_w(fleet, cooling_w, fleet.values("hvac.chiller.chilled_water_range_k"))


def _sized_pump_w(fleet: Fleet, heat_w: F64, range_k: F64) -> F64:
    """Power of pumps whose water carries a heat, W, with a range, K, each (B,)."""
    v = fleet.values
    flow = np.asarray(design_water_kg_s(heat_w, range_k=range_k)) / WATER_DENSITY_KG_M3
    return hydraulic_pump_w(
        v("hvac.pumps.pressure_drop_pa"), flow, efficiency=v("hvac.pumps.efficiency")
    )


def _battery_kwh(fleet: Fleet, sized_kwh: F64) -> F64:
    """Capacity of the battery, kWh, (B,): that of the config, or as sized."""
    configured_kwh = fleet.values("battery.capacity_kwh")
    return np.where(np.isnan(configured_kwh), sized_kwh, configured_kwh)


def _power_path(fleet: Fleet, it_w: F64) -> tuple[PowerPath, F64]:
    """UPS and distribution for an IT power, W, (B,), and the losses there that count, W, (B,)."""

    def device(name: str, carried_w: F64) -> LossyDevice:
        rated_w = fleet.values("electrical.capacity_ratio") * carried_w
        shares = LossyDevice._fields[1:]
        return LossyDevice(rated_w, *(fleet.values(f"electrical.{name}.{s}") for s in shares))

    distribution = device("distribution", it_w)
    path = PowerPath(device("ups", np.asarray(it_w + distribution.loss_w(it_w))), distribution)
    counted = fleet.configs[0].electrical.losses == "counted"
    return path, np.asarray(sum(path.losses_w(it_w)) if counted else 0.0 * it_w)


def _grid_limit_kw(fleet: Fleet, design_kw: F64) -> F64:
    """Most power of the grid connection, kW, (B,): as given, or in proportion to the design."""
    given_kw = fleet.values("electrical.grid_limit_kw")
    ratio = fleet.values("electrical.grid_limit_ratio")
    sized_kw = np.where(np.isnan(ratio), NO_LIMIT_KW, ratio * design_kw)
    return np.minimum(np.where(np.isnan(given_kw), sized_kw, given_kw), NO_LIMIT_KW)


def _room_kwh_per_k(fleet: Fleet) -> F64:
    """Heat capacity that follows the supply air, kWh/K, (B,).

    Quasi-steady halls: with the servers. Transient ones: servers and the air before the racks,
    which is that of the room, have temperatures of their own.
    """
    per_server = fleet.values("room_heat_capacity_kj_per_k")
    if fleet.models["thermal"] == "quasi_steady":
        per_server = per_server + fleet.values("server_heat_capacity_kj_per_k")
    return np.asarray(per_server * fleet.per_dc_servers() / 3600.0)
