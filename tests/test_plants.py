"""Plants as a whole: what they remove in any weather, and what they cannot be made of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest

from ledgers import LEDGERS, TRANSIENT_LEDGERS, residual
from model_steps import chiller_step
from sdc_taichi import ConfigError, Simulator, StepResult, drivers_from_arrays, load_config
from sdc_taichi.config import apply_overrides
from sdc_taichi.errors import PhysicalLimitError
from sdc_taichi.plant import moist_air, plants
from sdc_taichi.plant.chiller import CHILLERS, ChillerPoint
from sdc_taichi.plant.plants import PLANTS, Devices, PlantPoint, fits, water_cooled
from sdc_taichi.plant.tower import TOWERS, TowerPoint
from sdc_taichi.plant.water_side import (
    WaterSideDesign,
    chilled_water_c,
    chilled_water_load_w,
    coil_capacity_w,
    economiser_share,
    loop_pump_w,
)
from sdc_taichi.sim.drivers import load_drivers
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.types import F64, WaterSideResult
from test_ledgers import assert_closes, record, sites_and_seasons

SETPOINTS = ["reset", "approach"]
WATER_COOLED = ["centrifugal_vsd", "carnot", "eir_york", "electric_water_cooled", "constant_cop"]


@pytest.mark.parametrize("model", WATER_COOLED)
def test_full_load_is_removed_in_any_weather(model: str) -> None:
    base = load_config(
        "corrected",
        [f"hvac.chiller.model={model}", "hvac.sizing.design_wet_bulb_c=26",
         "hvac.sizing.design_outdoor_c=33", "workload.max_utilisation=1"],
    )  # fmt: skip
    weather = [(-20.0, 16), (-10.0, 18), (-10.0, 23), (5.0, 20), (15.0, 16), (26.0, 16), (26.0, 23)]
    configs = [
        apply_overrides(
            base, [f"hvac.setpoint.initial_c={c}", f"hvac.tower.economiser={economiser}"]
        )
        for economiser in ("true", "false")
        for _, c in weather
    ]
    wet_bulb_c = np.array([[wet_bulb_c] for wet_bulb_c, _ in 2 * weather])
    full = np.ones_like(wet_bulb_c)
    with Simulator(
        configs, drivers=drivers_from_arrays(wet_bulb_c + 5.0, wet_bulb_c, 300.0 * full, full)
    ) as sim:
        sim.reset()
        for _ in range(3):
            result = sim.step()
    np.testing.assert_array_equal(result.unmet_w, 0.0)
    np.testing.assert_allclose(result.heat_removed_w, result.cooling_load_w, rtol=1e-12)
    np.testing.assert_allclose(result.supply_c, result.setpoint_c, atol=1e-4)


def test_york_machine_is_sized_for_cold_condenser_water() -> None:
    drivers = drivers_from_arrays([20.0], [15.0], [300.0], [0.5])
    overrides = ["hvac.chiller.model=eir_york", "hvac.sizing.design_wet_bulb_c=26"]
    with Simulator(load_config("corrected", overrides), drivers=drivers) as sim:
        design = sim.sizing.water_side
    for condenser_c in np.linspace(12.78, 30.0, 9):
        for chilled_c in (8.0, 8.89):
            machine = chiller_step(
                "eir_york",
                design.cooling_w,
                reference_w=design.chiller_w,
                chilled_water_c=chilled_c,
                condenser_c=condenser_c,
                outdoor_c=0.0,
                reference_cop=5.96,
            )
            # The margin of 1.15 counts at the design wet bulb, 5 % of it at any other.
            need_w = design.cooling_w * (1.0 if condenser_c == 30.0 else 1.05 / 1.15)
            assert machine.available_w >= need_w * (1.0 - 1e-9)


@pytest.mark.parametrize(("model", "warmest_c"), [("eir_york", 8.89), ("centrifugal_vsd", 20.0)])
def test_plant_makes_no_warmer_water_than_its_chiller_is_valid_for(
    model: str, warmest_c: float
) -> None:
    base = load_config("corrected", [f"hvac.chiller.model={model}", "hvac.setpoint.max_c=30"])
    configs = [apply_overrides(base, [f"hvac.setpoint.initial_c={c}"]) for c in (16, 23, 30)]
    drivers = drivers_from_arrays([20.0], [15.0], [300.0], [0.5], size=3)
    with Simulator(configs, drivers=drivers) as sim:
        sim.reset()
        result = sim.step()
    expected_c = np.minimum([8.0, 15.0, 22.0], warmest_c)
    np.testing.assert_allclose(result.chilled_water_c, expected_c, rtol=1e-12)


# Plants without a tower

DRY = {
    "air_cooled": ["hvac.chiller.model=electric_air_cooled"],
    "air_side": ["hvac.chiller.model=electric_air_cooled", "hvac.plant=air_side"],
}
TUCSON = ["hvac.sizing.design_outdoor_c=40.5", "hvac.sizing.design_wet_bulb_c=23"]


def steady(
    overrides: list[str], outdoor_c: list[float], wet_bulb_c: list[float], load: float = 1.0
) -> tuple[StepResult, WaterSideDesign]:
    """A step of data centers that differ in their weather alone, and their sizes."""
    config = load_config("corrected", ["workload.max_utilisation=1", *TUCSON, *overrides])
    dry, wet = (np.array(values)[:, None] for values in (outdoor_c, wet_bulb_c))
    same = np.ones_like(dry)
    drivers = drivers_from_arrays(dry, wet, 300.0 * same, load * same)
    with Simulator([config] * len(outdoor_c), drivers=drivers, precision="f64") as sim:
        sim.reset()
        return sim.step(), sim.sizing.water_side


def pump_heat_w(result: StepResult) -> F64:
    """Heat that the chilled-water pumps give the water, W, (B,)."""
    return 0.9 * result.chilled_pump_w


@pytest.mark.parametrize("plant", ["water_cooled", *DRY])
def test_plants_take_the_heat_of_the_chilled_water_pumps(plant: str) -> None:
    chosen = [*DRY.get(plant, []), "hvac.pumps.min_flow_ratio=1"]
    hot, cold = [30.0, 2.0], [22.0, 0.0]
    warmed, design = steady(chosen, hot, cold)
    pinned, smaller = steady([*chosen, "hvac.pumps.heat_to_water_share=0"], hot, cold)
    taken_w, removed_w = (
        of.economiser_w + of.chiller_load_w - of.heat_removed_w for of in (warmed, pinned)
    )
    np.testing.assert_allclose(taken_w, pump_heat_w(warmed), rtol=1e-9)
    np.testing.assert_allclose(removed_w, 0.0, atol=1e-6)
    np.testing.assert_array_equal(warmed.heat_removed_w, pinned.heat_removed_w)
    # In the heat, 300 kPa at 6 K and an efficiency of 0.75 are 1.4 % of the design load.
    assert warmed.chiller_load_w[0] / pinned.chiller_load_w[0] == pytest.approx(1.017, abs=0.003)
    assert warmed.chiller_w[0] > pinned.chiller_w[0]
    more = design.chiller_w / smaller.chiller_w - 1.0
    np.testing.assert_allclose(more, 0.9 * design.chilled_pump_w / design.cooling_w, rtol=1e-9)
    assert np.all(design.rejected_w / smaller.rejected_w - 1.0 > 0.9 * more)


@pytest.mark.parametrize("plant", ["water_cooled", *DRY])
def test_pumps_without_cooling_do_not_heat_the_hall(plant: str) -> None:
    lost = "events.scheduled=[{kind: %s, start_h: 0, duration_h: 1, share: 0}]"
    for kind in ("chiller_derate", "pump_down"):
        result, _ = steady([*DRY.get(plant, []), lost % kind], [38.0], [22.0])
        assert result.heat_removed_w == result.chiller_load_w == 0
        assert (result.chilled_pump_w == 0) == (kind == "pump_down")


def test_plants_have_a_default_chiller() -> None:
    for plant, model in (("water_cooled", "centrifugal_vsd"), ("air_cooled", "eir_air_cooled"),
                         ("air_side", "eir_air_cooled"), ("null", "centrifugal_vsd")):  # fmt: skip
        config = load_config("corrected", [f"hvac.plant={plant}"])
        assert config.hvac.chiller_in_use == model
        assert build_fleet(config).models["chiller"] == model
    named = load_config("corrected", ["hvac.chiller.model=eir_air_cooled"])
    assert named.hvac.plant_in_use == "air_cooled"


def test_air_cooled_chiller_in_a_desert_july_sees_the_air_and_uses_no_water() -> None:
    result, design = steady(DRY["air_cooled"], [24.0, 32.0, 40.0], [19.0, 21.0, 23.0])
    cop = result.chiller_load_w / result.chiller_w
    assert np.all((cop > 3.0) & (cop < 4.5))
    assert np.all(np.diff(cop) < 0)
    for name in ("water_l", "evaporation_l", "drift_l", "blowdown_l", "economiser_w",
                 "tower_fan_w", "condenser_pump_w", "unmet_w"):  # fmt: skip
        np.testing.assert_array_equal(getattr(result, name), 0.0, err_msg=name)
    np.testing.assert_array_equal(result.condenser_water_c, result.outdoor_c)
    assert np.all(design.tower_water_kg_s == 0)


def test_dry_cooler_does_in_frost_what_the_chiller_does_in_summer() -> None:
    # At 18 C of supply air: chilled water of 10 C that returns at 16 C and a little more at less
    # than the sized load, and an approach of 8 K.
    result, design = steady(DRY["air_cooled"], [-20.0, 2.0, 9.0, 16.0], [-21.0, 0.0, 5.0, 10.0])
    taken_w = result.heat_removed_w + pump_heat_w(result)
    share = result.economiser_w / taken_w
    np.testing.assert_allclose(share, [1.0, 1.0, 0.5, 0.0], atol=0.025)
    assert share[0] == share[1] == 1
    np.testing.assert_allclose(result.chiller_w[:2], 0.0)
    cooler_w = design.cooling_w + design.pump_heat_share * design.chilled_pump_w
    full_w = design.tower_fan_w * (taken_w / cooler_w) ** 4
    assert result.tower_fan_w[2] == pytest.approx(full_w[2], rel=1e-9)
    assert 0.9 * full_w[1] < result.tower_fan_w[1] < full_w[1]
    assert 0 < result.tower_fan_w[0] < 0.1 * result.tower_fan_w[1]
    without, _ = steady([*DRY["air_cooled"], "hvac.dry_cooler.free_cooling=false"], [2.0], [0.0])
    assert without.economiser_w == without.tower_fan_w == without.condenser_pump_w == 0
    assert without.chiller_load_w == without.heat_removed_w + pump_heat_w(without)


def test_dry_cooler_makes_no_water_colder_than_the_air() -> None:
    # A close approach and a wide range at little load: water that returns at 10 + 17 K or so.
    wide = ["hvac.dry_cooler.approach_k=1", "hvac.chiller.chilled_water_range_k=12",
            "hvac.crac.supply_m3s_per_w=4e-5"]  # fmt: skip
    outdoor_c = [9.0, 12.0, 15.0, 18.0]
    result, design = steady(
        [*DRY["air_cooled"], *wide], outdoor_c, [c - 6.0 for c in outdoor_c], load=0.01
    )
    load_share = np.clip(result.heat_removed_w / design.cooling_w, 0.1, 1.0)
    range_k = 12.0 * load_share**-0.25
    assert np.all(range_k > 13.0)
    left_k = range_k * result.chiller_load_w / result.heat_removed_w
    assert np.all(result.chilled_water_c + left_k >= result.outdoor_c - 1e-9)
    assert result.chiller_load_w[0] == 0


def test_outdoor_air_cools_while_it_is_cool_and_neither_dry_nor_humid() -> None:
    weather = {
        "cool": (12.0, 8.0),
        "warm and dry": (24.0, 13.0),
        "warm and humid": (24.0, 20.0),
        "hot and dry": (40.0, 18.0),
        "cool and humid": (16.5, 16.3),
    }
    outdoor_c, wet_bulb_c = (list(x) for x in zip(*weather.values(), strict=True))
    result, design = steady(DRY["air_side"], outdoor_c, wet_bulb_c)
    share = dict(zip(weather, result.economiser_w / result.heat_removed_w, strict=True))
    assert share["cool"] == pytest.approx(1.0)
    assert 0.5 < share["warm and dry"] < 0.8
    assert share["warm and humid"] == share["hot and dry"] == share["cool and humid"] == 0
    # All of the air comes from outdoors in the warm: rho cp V (T_return - T_outdoor).
    warm = design.air_j_per_m3_k[1] * result.crac_flow_m3s[1] * (result.return_c[1] - 24.0)
    assert result.economiser_w[1] == pytest.approx(warm, rel=1e-12)
    fan_w = design.tower_fan_w[1] * (result.crac_flow_m3s[1] / design.tower_air_m3s[1]) ** 3
    assert result.tower_fan_w[1] == pytest.approx(fan_w, rel=1e-12)
    assert 0 < result.tower_fan_w[0] < fan_w
    np.testing.assert_array_equal(result.water_l, 0.0)
    np.testing.assert_array_equal(result.unmet_w, 0.0)


def test_outdoor_air_that_is_too_dry_is_wetted_or_left_outside() -> None:
    frost = [-15.0], [-16.2]
    wetted, _ = steady(DRY["air_side"], *frost)
    assert wetted.economiser_w == wetted.heat_removed_w
    # Dew points of -24 and -9 C are 0.0004 and 0.0018 kg/kg; a third of the air is from outdoors.
    assert 3.0 < wetted.evaporation_l < 15.0
    assert wetted.water_l == pytest.approx(1.25 * wetted.evaporation_l)
    left, _ = steady([*DRY["air_side"], "hvac.outdoor_air.humidifier=false"], *frost)
    assert left.economiser_w == left.water_l == 0
    assert left.chiller_load_w == left.heat_removed_w + pump_heat_w(left)


def test_moisture_that_condenses_on_the_coils_is_a_load_of_the_chiller() -> None:
    # Air of 20 C with a dew point of 11.6 C, chilled water of 10 C, and coils that cool from 20 to
    # 18 C; limits that admit all of the air.
    admitting = ["hvac.outdoor_air.max_dew_point_c=25", "hvac.outdoor_air.max_humidity_pct=100"]
    result, design = steady([*DRY["air_side"], *admitting], [20.0, 20.0], [14.8, 12.0])
    flow_w_k = design.air_j_per_m3_k * result.crac_flow_m3s
    sensible_w = flow_w_k * (result.return_c - 20.0)
    coil_w = result.heat_removed_w - sensible_w
    latent_w = result.chiller_load_w - coil_w - pump_heat_w(result)
    np.testing.assert_allclose(result.economiser_w, sensible_w - latent_w, rtol=1e-9)
    assert latent_w[1] == pytest.approx(0.0, abs=1.0)
    # Kilograms of water per kilogram of air: outdoors, at the coil, and from the balance of the
    # hall between them, in which the coils bring a share of the air to 10 C.
    outdoors, at_coil = (
        moist_air.vapour_ratio(pa, design.pressure_pa[0])
        for pa in (
            plants.outdoor_vapour_pa(np.array([20.0]), np.array([14.8]), design.pressure_pa[:1]),
            moist_air.saturation_pa(10.0),
        )
    )
    share = (coil_w / flow_w_k / (20.0 - 10.0))[0]
    hall = (outdoors + share * at_coil) / (1.0 + share)
    condensed_w = 2486.0 * flow_w_k[0] * share * (hall - at_coil)
    assert latent_w[0] == pytest.approx(float(condensed_w[0]), rel=1e-3)
    assert 0.1 < latent_w[0] / coil_w[0] < 0.4


@pytest.mark.parametrize(
    ("plant", "kind"),
    [
        ("water_cooled", "tower_cell_down"),
        ("air_cooled", "dry_cooler_down"),
        ("air_side", "outdoor_air_closed"),
        *((plant, "pump_down") for plant in ("water_cooled", *DRY)),
    ],
)
def test_plants_do_with_the_devices_that_are_left(plant: str, kind: str) -> None:
    event = "[{kind: %s, start_h: 0, duration_h: 1, share: %g}]"
    weather = [26.0, 5.0], [22.0, 2.0]
    runs = {
        share: steady([*DRY.get(plant, []), "events.scheduled=" + event % (kind, share)], *weather)
        for share in (1.0, 0.5, 0.0)
    }
    design = runs[1.0][1]
    unmet, free = (
        {share: getattr(result, name) for share, (result, _) in runs.items()}
        for name in ("unmet_w", "economiser_w")
    )
    np.testing.assert_array_equal(unmet[1.0], 0.0)
    for share, (result, _) in runs.items():
        np.testing.assert_allclose(result.heat_removed_w + result.unmet_w, result.cooling_load_w)
        assert np.all(result.rejected_w >= result.heat_removed_w), share
    if kind == "pump_down":
        load_w = runs[0.5][0].cooling_load_w
        # Half of the water warms up by more than half again, but not by twice as much.
        removed_w = load_w[0] - unmet[0.5][0]
        assert 0.55 * design.cooling_w[0] < removed_w < 0.85 * design.cooling_w[0]
        # Outdoor air needs no water.
        assert unmet[0.0][1] == pytest.approx(0.0 if plant == "air_side" else load_w[1])
    elif kind == "tower_cell_down":
        np.testing.assert_array_equal(unmet[0.5], 0.0)
        np.testing.assert_allclose(unmet[0.0], runs[0.0][0].cooling_load_w)
        warmer_k = runs[0.5][0].condenser_water_c[0] - runs[1.0][0].condenser_water_c[0]
        assert 1.0 < warmer_k < 6.0
        assert runs[0.5][0].chiller_w[0] > runs[1.0][0].chiller_w[0]
    else:
        # Free cooling falls, and the chiller makes up for it.
        np.testing.assert_array_equal([*unmet[0.5], *unmet[0.0]], 0.0)
        assert free[1.0][1] > 0
        assert free[0.5][1] <= free[1.0][1]
        assert free[0.0][1] == 0


# Continuity, and free cooling that never costs more than it saves

SWEPT = [
    *(("water_cooled", name, setpoint) for name in WATER_COOLED for setpoint in SETPOINTS),
    *(
        (plant, name, "approach")
        for plant, model in PLANTS.items()
        for name, chiller in CHILLERS.items()
        if model.dry and fits(chiller, model)
    ),
]
"""Plants, chillers and setpoints of the tower, but for the models of presets sustaindc and paper,
which keep the jumps of their sources."""
STEP_K, STEP_LOAD, LARGEST_JUMP = 0.002, 2e-4, 0.005
LARGEST_JUMP_OF_DAMPERS = 0.015
"""Largest relative change of power in a step while dampers close because the air is humid."""


class Swept(NamedTuple):
    """Conditions that a sweep changes one at a time."""

    load: F64 | float
    setpoint_c: F64 | float
    outdoor_c: F64 | float
    depression_k: F64 | float


SWEEPS = {
    "load": ("load", np.arange(0.4, 1.0, STEP_LOAD)),
    "setpoint": ("setpoint_c", np.arange(14.0, 27.0, STEP_K)),
    "dry bulb with wet bulb": ("outdoor_c", np.arange(-20.0, 42.0, STEP_K)),
    "wet bulb": ("depression_k", np.arange(0.0, 14.0, STEP_K)),
}
STARTS = [
    Swept(load, setpoint_c, outdoor_c, depression_k)
    for load in (0.6, 0.95)
    for setpoint_c in (14.0, 18.0, 24.0)
    for outdoor_c, depression_k in ((-8.0, 1.0), (6.0, 2.0), (13.0, 3.0), (19.0, 6.0), (26.0, 9.0))
]


def sweeps(every: int = 1) -> Iterator[tuple[str, F64, Swept, Swept]]:
    """Yield each different sweep: its name, what is swept, where it starts and the conditions."""
    for sweep, (field, all_values) in SWEEPS.items():
        values = all_values[::every]
        starts = {start._replace(**{field: 0.0}): start for start in STARTS}
        for start in starts.values():
            yield sweep, values, start, start._replace(**{field: values})


@cache
def sized(plant: str, chiller: str, setpoint: str) -> Sizing:
    overrides = [f"hvac.plant={plant}", f"hvac.chiller.model={chiller}",
                 f"hvac.tower.setpoint={setpoint}", "hvac.setpoint.min_c=14",
                 "hvac.setpoint.max_c=27", *TUCSON]  # fmt: skip
    if chiller == "eir_york":
        overrides.append("hvac.chiller.coil_approach_k=9")
    drivers = drivers_from_arrays([20.0], [15.0], [300.0], [0.5])
    with Simulator(load_config("corrected", overrides), drivers=drivers) as sim:
        return sim.sizing


def hvac_w(
    names: tuple[str, str, str], at: Swept, *, free: bool = True, outdoor_units: float = 1.0
) -> F64:
    """Power of the plant and of CRAC fans that follow the load, of the shape of what is swept; nan
    where the plant does not remove all heat."""
    sizing = sized(*names)
    design = replace(sizing.water_side, outdoor_units=np.array([outdoor_units]))
    load, setpoint_c, outdoor_c, depression_k = np.broadcast_arrays(*at)
    if not free:
        none = np.zeros_like(design.economiser)
        design = replace(design, economiser=none, most_vapour_pa=none + 1.0)
    load_w, speed = load * design.cooling_w, np.maximum(load, 0.3)
    rise_k = load_w / (design.air_j_per_m3_k * speed * sizing.crac_flow_m3s)
    plant = PLANTS[names[0]].step(
        load_w,
        PlantPoint(
            setpoint_c=setpoint_c,
            water_setpoint_c=setpoint_c,
            return_c=setpoint_c + rise_k,
            airflow_m3s=speed * sizing.crac_flow_m3s,
            outdoor_c=outdoor_c,
            wet_bulb_c=outdoor_c - depression_k,
        ),
        design,
        Devices(CHILLERS[names[1]], TOWERS["yorkcalc"], limited=True, reset=names[2] == "reset"),
    )
    pumps_w = plant.chilled_pump_w + plant.condenser_pump_w
    power_w = plant.chiller_w + plant.tower_fan_w + pumps_w + sizing.crac_fan_w * speed**3
    return np.where(plant.heat_removed_w >= load_w * (1.0 - 1e-9), power_w, np.nan)


def dampers_move(names: tuple[str, str, str], at: Swept) -> Any:
    """Return True where dampers admit only a part of the outdoor air because of its moisture."""
    design = sized(*names).water_side
    _, setpoint_c, outdoor_c, depression_k = np.broadcast_arrays(*at)
    vapour_pa = plants.outdoor_vapour_pa(outdoor_c, outdoor_c - depression_k, design.pressure_pa)
    share = plants.admitted_share(vapour_pa, setpoint_c, design)
    return (names[0] == "air_side") & (share > 0.0) & (share < 1.0)


@pytest.mark.parametrize(
    ("names", "outdoor_units"),
    [*((names, 1.0) for names in SWEPT),
     *((names, 0.5) for names in SWEPT if names[1] in ("centrifugal_vsd", "eir_air_cooled"))],
    ids=lambda x: "-".join(x) if isinstance(x, tuple) else str(x),
)  # fmt: skip
def test_power_of_plants_has_no_jumps(names: tuple[str, str, str], outdoor_units: float) -> None:
    jumps = []
    for sweep, values, start, at in sweeps():
        power_w = hvac_w(names, at, outdoor_units=outdoor_units)
        steps = np.abs(np.diff(power_w)) / power_w[1:]
        over = steps - np.where(dampers_move(names, at)[1:], LARGEST_JUMP_OF_DAMPERS,
                                LARGEST_JUMP)  # fmt: skip
        if np.nanmax(over, initial=0.0) > 0.0:
            i = int(np.nanargmax(over))
            jumps.append(f"{sweep} {values[i]:.4f}, {start}: {steps[i]:.2%} of HVAC")
    assert not jumps, "\n".join(jumps)


@pytest.mark.parametrize("names", SWEPT, ids="-".join)
def test_free_cooling_never_costs_more_than_none(names: tuple[str, str, str]) -> None:
    more = []
    for sweep, values, start, at in sweeps(every=25):
        ratio = hvac_w(names, at) / hvac_w(names, at, free=False) - 1.0
        if np.nanmax(ratio, initial=0.0) > 1e-9:
            i = int(np.nanargmax(ratio))
            more.append(f"{sweep} {values[i]:.3f}, {start}: {ratio[i]:+.2%}")
    assert not more, "\n".join(more)


@cache
def sized_plant(*overrides: str) -> tuple[WaterSideDesign, Devices]:
    """Sizes of a data center for 25.6 C wet bulb and 33 C dry bulb, and the models of its plant."""
    design_day = ["hvac.sizing.design_wet_bulb_c=25.6", "hvac.sizing.design_outdoor_c=33"]
    config = load_config("corrected", [*design_day, *overrides])
    with Simulator(config, drivers=drivers_from_arrays([20.0], [15.0], [300.0], [0.5])) as sim:
        sim.reset()
        hvac = config.hvac
        models = CHILLERS[hvac.chiller_in_use], TOWERS[hvac.tower.model]
        return sim.sizing.water_side, Devices(*models, limited=True, reset=hvac.tower.resets)


def stepped(
    sized: tuple[WaterSideDesign, Devices], load: Any, setpoint_c: Any, wet_bulb_c: Any
) -> WaterSideResult:
    """A step of a water-cooled plant; the load is a share of the capacity of the coils."""
    design, devices = sized
    load, setpoint_c, wet_bulb_c, one = np.broadcast_arrays(load, setpoint_c, wet_bulb_c, [1.0])
    point = PlantPoint(setpoint_c, setpoint_c, setpoint_c + 12.0, one, wet_bulb_c + 6.0, wet_bulb_c)
    return water_cooled(load * design.cooling_w, point, design, devices)


def power_w(result: WaterSideResult) -> F64:
    """Power of the plant, in W, (B,)."""
    pumps_w = result.chilled_pump_w + result.condenser_pump_w
    return result.chiller_w + result.tower_fan_w + pumps_w


def merkel_number(
    wet_bulb_c: float, range_k: float, approach_k: float, water_per_air: float
) -> float:
    """Integral of Merkel for a tower in counterflow, at some kg of water per kg of air."""

    def enthalpy(c: F64) -> F64:
        """Enthalpy of saturated air, J/kg, with the formula of Magnus for the vapour."""
        vapour_pa = 611.2 * np.exp(17.62 * c / (243.12 + c))
        ratio = 0.622 * vapour_pa / (101_325.0 - vapour_pa)
        return np.asarray(1006.0 * c + ratio * (2.501e6 + 1860.0 * c))

    cold_c = wet_bulb_c + approach_k
    water_c = cold_c + range_k * (np.arange(200) + 0.5) / 200
    air = enthalpy(np.array([wet_bulb_c])) + water_per_air * 4184.0 * (water_c - cold_c)
    gap = enthalpy(water_c) - air
    return float(4184.0 * range_k * np.mean(1.0 / gap)) if gap.min() > 0 else np.inf


@pytest.mark.parametrize("wet_bulb_c", [22.0, 25.6])
@pytest.mark.parametrize(("load", "cells"), [(0.6, 0.5), (0.85, 0.5), (0.85, 0.75), (0.5, 0.3)])
def test_cells_that_are_left_cool_all_water_as_far_as_merkel_says(
    load: float, cells: float, wet_bulb_c: float
) -> None:
    # Setpoints near the wet bulb keep the fans at full speed.
    design, devices = sized_plant("hvac.tower.economiser=false", "hvac.tower.setpoint=approach")
    left = replace(design, outdoor_units=np.array([cells]))
    result = stepped((left, devices), load, 23.0, wet_bulb_c)
    assert result.heat_removed_w == pytest.approx(load * design.cooling_w)
    flow = float(result.tower_water_kg_s[0] / design.tower_water_kg_s[0]) / cells
    # The fill at design; its transfer number falls with the water, KaV/L ~ (L/G)^-0.5.
    wanted = merkel_number(25.6, 5.56, 4.0, 1.4) * flow**-0.5
    grid = np.linspace(0.5, 25.0, 2451)
    numbers = [merkel_number(wet_bulb_c, result.tower_range_k[0], k, 1.4 * flow) for k in grid]
    approach_k = grid[np.argmax(np.array(numbers) < wanted)]
    assert result.condenser_water_c[0] - wet_bulb_c == pytest.approx(approach_k, abs=0.6)


@pytest.mark.parametrize("chiller", WATER_COOLED)
def test_chiller_unloads_to_what_few_cells_reject(chiller: str) -> None:
    design, devices = sized_plant(f"hvac.chiller.model={chiller}")
    cells = np.array([0.0, 0.002, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0])
    few = replace(design, outdoor_units=cells)
    result = stepped((few, devices), 0.87, 18.0, 25.6)
    removed = result.heat_removed_w / design.cooling_w
    assert removed[0] == pytest.approx(0.0, abs=0.005)
    assert np.all(np.diff(removed) >= -1e-9)
    assert np.all(removed[1:] >= np.minimum(cells[1:], 0.87) - 0.003)
    assert removed[-1] == pytest.approx(0.87)
    limited = removed[1:] < 0.86
    hottest_c = result.condenser_water_c[1:][limited]
    assert limited.any()
    assert np.all(hottest_c[1:] < design.max_condenser_c[0] + 2.5)
    np.testing.assert_allclose(hottest_c[1:3], design.max_condenser_c[0], atol=2.5)
    np.testing.assert_allclose(
        result.rejected_w, 4184.0 * result.tower_water_kg_s * result.tower_range_k, atol=1.0
    )


def test_warm_condenser_water_takes_capacity_of_the_default_chiller() -> None:
    # Trane CVHE 1442 kW with variable speed (Modelica Buildings, Data.ElectricEIR): capacity
    # divided by that at 6.67 and 29.44 C.
    published = {(6.67, 31.0): 0.939, (6.67, 33.0): 0.847, (6.67, 35.0): 0.740,
                 (4.44, 29.44): 0.896, (4.44, 33.0): 0.731, (8.89, 35.0): 0.863}  # fmt: skip
    for (chilled_c, condenser_c), share in published.items():
        machine = chiller_step(
            "centrifugal_vsd",
            2.0,
            reference_w=1.0,
            chilled_water_c=chilled_c,
            condenser_c=condenser_c,
            outdoor_c=30.0,
            reference_cop=5.96,
        )
        assert machine.available_w == pytest.approx(share, abs=0.03)
        assert machine.unmet_w == pytest.approx(2.0 - share, abs=0.03)


def test_coils_warm_little_water_more() -> None:
    """A coil in counterflow with the resistances of the design point, against its formula."""
    design, _ = sized_plant()
    air_k, water_k = float(design.coil_rise_k[0]), float(design.chilled_water_range_k[0])
    entering_k = air_k + float(design.coil_approach_k[0])

    def heat(flow: float, conductance: float) -> float:
        """Heat by the kelvin of the design's entering difference, in units of the design heat."""
        small, large = sorted([flow / water_k, 1.0 / air_k])
        ratio, units = small / large, conductance / small
        gone = np.exp(-units * (1.0 - ratio))
        return float(entering_k * small * (1.0 - gone) / (1.0 - ratio * gone))

    conductance = np.linspace(0.01, 2.0, 20_000)
    at_design = conductance[np.argmin([abs(heat(1.0, c) - 1.0) for c in conductance])]
    for flow in (0.3, 0.5, 0.75, 1.0):
        film = at_design / (0.5 + 0.5 * flow**-0.75)
        few = replace(design, pumped_w=flow * design.cooling_w)
        capacity = coil_capacity_w(few) / design.cooling_w
        assert capacity == pytest.approx(heat(flow, film), rel=0.05)
        _, pump_w, range_ratio = chilled_water_load_w(
            capacity * design.cooling_w, few, limited=True
        )
        assert range_ratio == pytest.approx(capacity / flow, rel=1e-9)
        assert pump_w == pytest.approx(design.chilled_pump_w * max(flow, 0.6) ** 3)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_dry_coolers_that_are_left_receive_all_water(share: float) -> None:
    event = "events.scheduled=[{kind: dry_cooler_down, start_h: 0, duration_h: 1, share: %g}]"
    weather = [7.0], [3.0]
    result, design = steady([*DRY["air_cooled"], event % share], *weather)
    over_k = (
        float(result.chilled_water_c[0])
        + 6.0 * (result.heat_removed_w[0] / design.cooling_w[0]) ** -0.25
        - 7.0
    )
    full_w = (design.cooling_w + 0.9 * design.chilled_pump_w)[0] * over_k / 14.0
    # Coolers in counterflow whose capacity flows of air and water are equal at design: the
    # effectiveness of 6/14 is N/(1 + N), with N = 0.75 transfer units. The water of those that are
    # left flows 1/share times as fast, and each kilogram has N share of them.
    gone = np.exp(-0.75 * share * (1.0 - 1.0 / share))
    effectiveness = (1.0 - gone) / (1.0 - gone / share)
    assert result.economiser_w[0] / full_w == pytest.approx(effectiveness / (6.0 / 14.0), rel=0.05)
    assert result.economiser_w[0] / full_w > share


# Free cooling and the reset of the condenser water


LARGEST_RISE = {"eir_york": 2e-3, "electric_water_cooled": 1e-3}
"""Largest power of the plant above that of warmer weather, relative to it, of chillers whose power
is nearly independent of their water in a part of its range: there the reset cools a little more
than is worthwhile, because it takes the power as linear in the temperature of the water."""


@pytest.mark.parametrize("economiser", [True, False])
@pytest.mark.parametrize("chiller", [*WATER_COOLED, "paper"])
def test_reset_draws_no_more_as_it_gets_cooler(chiller: str, economiser: bool) -> None:
    sized = sized_plant(
        f"hvac.chiller.model={chiller}",
        f"hvac.tower.economiser={economiser}",
        *(["hvac.chiller.coil_approach_k=9"] if chiller == "eir_york" else []),
    )
    # The design wet bulb, 25.6 C, is within the range.
    wet_bulb_c = np.arange(-5.0, 28.0, 0.25)
    for load in (0.1, *np.arange(0.2, 1.01, 0.1)):
        for setpoint_c in (16.0, 18.0, 23.0, 27.0):
            result = stepped(sized, load, setpoint_c, wet_bulb_c)
            complete = result.heat_removed_w >= load * sized[0].cooling_w * (1.0 - 1e-9)
            drawn_w = power_w(result)[complete]
            warmer_w = np.minimum.accumulate(drawn_w[::-1])[::-1]
            assert np.all(drawn_w <= warmer_w * (1.0 + LARGEST_RISE.get(chiller, 1e-6)))


def least_power_w(
    sized: tuple[WaterSideDesign, Devices], load: float, setpoint_c: float, wet_bulb_c: F64
) -> F64:
    """Least power of the plant over all temperatures of the tower water, in W, (B,)."""
    design, devices = sized
    taken_w, pump_w, range_ratio = chilled_water_load_w(
        load * design.cooling_w, design, limited=True
    )
    chilled_c = chilled_water_c(np.array([setpoint_c]), design)
    return_c = chilled_c + design.chilled_water_range_k * range_ratio
    least_w = np.full(len(wet_bulb_c), np.inf)
    for water_c in np.arange(-10.0, 45.0, 0.2):
        share = design.economiser * economiser_share(
            return_c,
            chilled_water_c=chilled_c,
            tower_water_c=water_c + design.exchanger_approach_k,
        )
        condenser_c = np.maximum(water_c, design.min_condenser_c)
        at = ChillerPoint(design.chiller_w, chilled_c, condenser_c, condenser_c, design.machine)
        machine = devices.chiller.step(taken_w * (1.0 - share), at)
        heat_w = taken_w * share + machine.rejected_w
        flow = np.maximum(heat_w / design.rejected_w, design.pump_min_ratio)
        tower = devices.tower.step(
            heat_w,
            TowerPoint(wet_bulb_c, wet_bulb_c + 6.0, np.array([water_c]), chilled_c,
                       flow * design.tower_water_kg_s, design.tower_reference_kg_s,
                       design.tower_air_m3s, design.tower_fan_w, design.air_j_per_m3_k),
        )  # fmt: skip
        reached = (tower.leaving_c <= water_c + 1e-9) & (machine.unmet_w <= 0.0)
        condenser_pump_w = loop_pump_w(heat_w, design.rejected_w, design.condenser_pump_w, design)
        drawn_w = machine.power_w + tower.fan_w + pump_w + condenser_pump_w
        least_w = np.minimum(least_w, np.where(reached, drawn_w, np.inf))
    return least_w


@pytest.mark.parametrize("site", ["AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA"])
def test_reset_is_near_the_best_of_each_hour(site: str) -> None:
    drivers = load_drivers([load_config("corrected", [f"site.location={site}"])])
    wet_bulb_c = np.sort(np.ravel(drivers.wet_bulb_c.values))[::173]
    sized = sized_plant(f"hvac.sizing.design_wet_bulb_c={drivers.design_wet_bulb_c[0]}")
    losses = []
    for load in (0.3, 0.6, 0.8):
        for setpoint_c in (18.0, 23.0):
            least_w = least_power_w(sized, load, setpoint_c, wet_bulb_c)
            drawn_w = power_w(stepped(sized, load, setpoint_c, wet_bulb_c))
            reachable = np.isfinite(least_w)
            assert np.mean(reachable) > 0.98
            losses.append(np.sum(drawn_w[reachable]) / np.sum(least_w[reachable]) - 1.0)
    assert np.mean(losses) < 0.01
    assert np.max(losses) < 0.0125


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
@pytest.mark.parametrize("plant", DRY)
def test_ledgers_of_dry_plants_close_on_every_step(plant: str, thermal: str) -> None:
    overrides = [*DRY[plant], f"simulation.thermal={thermal}", "events.sampled=[{kind: pump_down, "
                 "per_year: 200, duration_h: [1, 6], share: 0.1}]",
                 "servers.heat_capacity_kj_per_k=4.155"]  # fmt: skip
    configs = sites_and_seasons(overrides, ("AZ", "IL", "WA"), ("01-10", "04-20", "07-15"))
    run = record(configs, 4 * 96, None, "f64")
    for name in LEDGERS if thermal == "quasi_steady" else TRANSIENT_LEDGERS:
        assert_closes(name, run, 1e-12, floor=1e-6)
    assert run["economiser_w"].max() > 0
    assert run["unmet_w"].max() > 0
    without_free = [run["heat_removed_w"], -run["chiller_load_w"]]
    assert np.max(residual(without_free)) > 0.1
    assert np.all(run["water_l"] >= run["evaporation_l"])
    assert (run["water_l"].max() > 0) == (plant == "air_side")


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["hvac.plant=air_cooled", "hvac.chiller.model=carnot"],
         ["plant air_cooled", "chiller.model carnot", ", eir_air_cooled, electric_air_cooled"]),
        (["hvac.plant=water_cooled", *DRY["air_cooled"]],
         ["plant water_cooled", "chiller.model electric_air_cooled"]),
        (["hvac.outdoor_air.max_dew_point_c=-20"], ["min_dew_point_c -9", "max_dew_point_c -20"]),
        ([*DRY["air_cooled"], "events.scheduled=[{kind: tower_cell_down, start_h: 0, "
          "duration_h: 1, share: 0.5}]"],
         ["events.scheduled.0.kind tower_cell_down", "hvac.plant water_cooled, not air_cooled"]),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_an_error(overrides: list[str], parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("corrected", overrides)
    assert all(part in str(caught.value) for part in parts), caught.value


def test_chiller_that_falls_short_in_frost_gets_warmer_condenser_water() -> None:
    event = "events.scheduled=[{kind: chiller_derate, start_h: 0, duration_h: 1, share: %g}]"
    york = ["hvac.chiller.model=eir_york", "hvac.tower.economiser=false", "hvac.sizing.margin=1"]
    full, design = steady([*york, event % 1], [-5.0], [-6.0])
    derated, _ = steady([*york, event % 0.9], [-5.0], [-6.0])
    assert full.unmet_w == derated.unmet_w == 0
    assert design.fullest_condenser_c > 20.0
    # The lift of warmer water costs power; the water is no warmer than the load needs.
    assert 1.03 * full.chiller_w < derated.chiller_w < 1.3 * full.chiller_w
    broken, _ = steady([*york, event % 0.5], [-5.0], [-6.0])
    assert broken.unmet_w > 0.2 * broken.cooling_load_w


def test_chiller_without_capacity_is_an_error() -> None:
    hot = ["hvac.chiller.model=electric_water_cooled", "hvac.chiller.min_condenser_c=60",
           "hvac.chiller.coil_approach_k=11"]  # fmt: skip
    with pytest.raises(PhysicalLimitError, match="no capacity at its design weather, 60 C of cond"):
        steady(hot, [20.0], [15.0])
