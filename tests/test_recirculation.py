"""Recirculating halls: against their NumPy twin, and what must hold for every layout and load."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import reference_twin
from random_halls import (
    AS_FOUND,
    LONG,
    MERGED,
    PRECISIONS,
    SEEDS,
    SMALL,
    TOLERANCE,
    Part,
    assert_agrees,
    assert_close,
    at_design,
    flat,
    fleet_of,
    own_conditions,
    own_part,
    parts,
    random_conditions,
    random_hall,
    random_halls,
    random_values,
    steady_twin,
)
from sdc_taichi import (
    DataCenterConfig,
    PhysicalLimitError,
    RuntimeStateError,
    SdcError,
    Simulator,
    build_fleet,
    load_config,
)
from sdc_taichi.config import config_from_dict
from sdc_taichi.hall.mix_weights import layout_weights
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.hall.steady_modes import extended_modes
from sdc_taichi.kernels.arguments import row_index
from sdc_taichi.kernels.hall_arguments import DC_COEFFICIENTS
from sdc_taichi.sim.hall_solver import MOST_SWEEPS, Hall
from sdc_taichi.sim.hall_state import Conditions, HallSums, Precision
from sdc_taichi.types import F64, ServerLayers

# --- against the twin ---------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=4)
@given(seed=SEEDS)
def test_steady_halls_agree_with_the_twin(precision: Precision, seed: int) -> None:
    configs = random_halls(seed)
    met = random_conditions(np.random.default_rng(seed + 1), configs)
    assert_agrees(configs, met, precision)


@pytest.mark.parametrize(("kind", "precision"), [(0, "f32"), (1, "f64"), (2, "f64")])
@pytest.mark.parametrize("shape", [(4, 5), *MERGED[:1], *LONG])
def test_every_kind_of_exchange_and_load_agrees_with_the_twin(
    shape: tuple[int, int], kind: int, precision: Precision
) -> None:
    """Kinds are mean loads, loads of racks and loads of groups."""
    rng = np.random.default_rng(shape[1] + kind)
    config = random_hall(rng, "dc", shape)
    assert_agrees([config], random_conditions(rng, [config], kind=kind), precision)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("speed", [0.5, 0.8, 1.0])
def test_full_load_at_the_highest_setpoint_agrees_with_the_twin_at_any_fan_speed(
    speed: float, precision: Precision
) -> None:
    # Where sweeps start is the answer here, but for the airflow of the CRAC units.
    given = np.array([speed])
    met = Conditions(np.array([23.0]), np.ones(1), unit_low=given, unit_high=given)
    assert_agrees([load_config("corrected")], met, precision)


@pytest.mark.parametrize(
    "overrides",
    [[], ["hall.servers_per_rack=12", "hall.height_zones=12"],
     ["hall.rows=5", "hall.racks_per_row=16", "hall.supply_approach_k=5.15",
      "hall.return_approach_k=-3.1", "servers.power_w=[150, 10]",
      "hall.recirculation.calibrate=rack"]],
    ids=["default", "each server its own", "80 racks alike"],
)  # fmt: skip
def test_most_sweeps_start_where_they_end(overrides: list[str]) -> None:
    config = load_config("corrected", overrides)
    fleet, rng = build_fleet([config] * 300), np.random.default_rng(0)
    hall = Hall(fleet, "f32")
    hall.solve(Conditions(rng.uniform(16.0, 23.0, 300), rng.uniform(0.0, 1.0, 300)))
    assert hall.sweeps.mean() < 1.6
    # Setpoints move by whole kelvins, where the table has its entries.
    hall.solve(Conditions(rng.integers(16, 24, 300).astype(float), rng.integers(0, 161, 300) / 160))
    assert hall.sweeps.mean() < 1.3


@pytest.mark.parametrize(("preset", "most"), [("large", 1.4), ("hall_of_2026", 1.8)])
def test_sampled_racks_start_the_sweeps_of_large_halls(preset: str, most: float) -> None:
    config = load_config(preset)
    fleet, rng, setpoint = (
        build_fleet([config] * 40),
        np.random.default_rng(0),
        config.hvac.setpoint,
    )
    hall = Hall(fleet, "f32")
    supply_c = rng.uniform(setpoint.min_c, setpoint.max_c, 40)[fleet.unit_dc]
    load, least = rng.uniform(0.1, 1.0, 40), fleet.values("hvac.crac.min_flow_ratio")
    fans = {"unit_low": least[fleet.unit_dc], "unit_high": np.ones(fleet.units)}
    hall.solve(Conditions(supply_c, load, **fans))
    assert hall.sweeps.mean() < most


def test_modes_of_the_worked_example() -> None:
    outlet_k = np.array([[8.0, 10.0, 6.0], [8.0, 9.0, 5.0]])
    modes = extended_modes(None, outlet_k, 0.5 * outlet_k, most=3)
    assert modes.racks.tolist() == [1, 0]
    assert modes.outlet_k == pytest.approx(np.array([[0.8, 1.0, 0.6], [1.0, 0.0, -0.5]]))
    # Any other sum of both states follows from the outlets of racks 1 and 0.
    state = 0.3 * outlet_k[0] + 1.2 * outlet_k[1]
    amounts = modes.amounts_per_k @ state[modes.racks]
    assert amounts @ modes.outlet_k == pytest.approx(state)
    assert amounts @ modes.mix_k == pytest.approx(0.5 * state)
    # A state between them adds no mode, a third one does.
    assert len(extended_modes(modes, state[None], 0.5 * state[None], most=3).racks) == 2
    assert len(extended_modes(modes, np.eye(3), np.eye(3), most=3).racks) == 3


def test_runs_that_share_their_weights_are_summed_together() -> None:
    weights = layout_weights(load_config("large").hall)
    values = np.random.default_rng(0).normal(size=1000)
    assert weights.apply(values) == pytest.approx(weights.dense() @ values, abs=1e-13)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_units_that_approach_steady_air_slowly_are_extrapolated(precision: Precision) -> None:
    # Units 3 to 5 are at the limit of their coils: each sweep changes their supply air by 0.985 of
    # the change before.
    fleet = fleet_of(load_config("hall_of_2026"))
    hall = Hall(fleet, precision)
    speed = np.array([0.647, 0.31, 0.454, 0.939, 0.886, 0.957])
    supply_c = np.array([18.7326, 20.6355, 18.1213, 26.5123, 20.739, 21.9697])
    sums = hall.solve(Conditions(supply_c, np.array([0.9943]), unit_low=speed, unit_high=speed))
    assert hall.sweeps[0] < {"f32": 100, "f64": 400}[precision]
    # All power of the servers leaves with the air.
    it_w = sums.cpu_w + sums.it_fan_w
    air_w = sums.outlet_m3k_s - sums.inlet_m3k_s
    air_w *= fleet.dcs[row_index(DC_COEFFICIENTS, "air_j_per_m3_k")]
    assert air_w == pytest.approx(it_w, rel=10 * TOLERANCE[precision])


@pytest.mark.parametrize("design_supply_c", [18.0, 18.01, 18.05, 18.1])
def test_units_that_just_cover_the_need_have_steady_air(design_supply_c: float) -> None:
    config = load_config("hall_of_2026", [f"hall.design_supply_c={design_supply_c}"])
    with Simulator(config, precision="f64") as sim:
        sim.reset()
        assert sim.step().inlet_max_c[0] < 30.0


@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_server_may_be_its_own(precision: Precision) -> None:
    config = load_config("corrected", ["hall.servers_per_rack=12", "hall.height_zones=12"])
    fleet = fleet_of(config)
    assert fleet.groups == fleet.servers == 20 * 12
    rng = np.random.default_rng(3)
    assert_agrees([config], random_conditions(rng, [config], kind=2), precision)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_fans_without_limits_of_their_airflow(precision: Precision) -> None:
    # Twenty racks leave places of blocks empty.
    changes = ["fan_model=linear", "fan_power_exponent=2.5", "fan_airflow_ratio_limits=null"]
    config = load_config("corrected", [f"servers.{change}" for change in changes])
    assert_agrees([config], Conditions(np.array([18.0]), np.array([0.05])), precision)
    # The curve is below 0 here, and fans do not blow backwards.
    hall = Hall(fleet_of(config), precision)
    with pytest.raises(PhysicalLimitError, match="larger airflows"):
        hall.solve(Conditions(np.array([4.0]), np.zeros(1)))


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("shape", [(4, 5), (10, 14)], ids=["one chunk", "two chunks"])
def test_halls_of_any_size_give_up_after_as_many_sweeps(
    shape: tuple[int, int], precision: Precision
) -> None:
    config = load_config(
        "corrected",
        [f"hall.rows={shape[0]}", f"hall.racks_per_row={shape[1]}", "hall.supply_approach_k=5",
         "hall.return_approach_k=-3", "servers.power_w=[200, 20]"],
    )  # fmt: skip
    hall, least = Hall(fleet_of(config), precision), np.array([1e-3])
    still = Conditions(np.array([20.0]), np.ones(1), unit_low=least, unit_high=least)
    with pytest.raises(SdcError, match=r"or set simulation\.thermal") as error:
        hall.solve(still)
    assert f"no steady air temperatures in {MOST_SWEEPS} sweeps" in str(error.value)
    with pytest.raises(RuntimeStateError, match="no step has been done"):
        hall.servers()
    assert hall.solve(Conditions(np.array([20.0]), np.ones(1))).inlet_mean_c[0] < 26


@pytest.mark.parametrize("inlet_model", ["approach", "recirculation"])
def test_conditions_that_are_no_numbers_are_refused(inlet_model: str) -> None:
    config = load_config("corrected", [f"hall.inlet_model={inlet_model}"])
    for supply_c, load in ((np.nan, 0.5), (18.0, np.nan)):
        hall = Hall(fleet_of(config), "f32")
        with pytest.raises(SdcError, match="is not finite; valid are finite numbers"):
            hall.solve(Conditions(np.array([supply_c]), np.array([load])))


def test_twin_sees_a_change_of_any_measure_of_the_hall() -> None:
    values = random_values(np.random.default_rng(0), "dc", (3, 4))
    values["hall"]["layout"]["containment"] = 0.2
    values["hall"] |= {"height_zones": 4, "height_gradient": 0.4, "servers_per_rack": 12}
    values["servers"] |= {"power_w": [200, 20], "groups": None}
    values["hvac"]["crac"] |= {"units": 3, "unit_shares": None}
    met = Conditions(
        np.array([18.0, 21.0, 24.0]), np.array([0.6]), unit_low=np.full(3, 0.6),
        unit_high=np.full(3, 0.6),
    )  # fmt: skip
    config = config_from_dict(values)
    twin = steady_twin(parts([config], met)[0])
    changes = {f"layout.{name}": 1.01 for name in values["hall"]["layout"]}
    for unseen in ("returns", "ceiling_m", "end_margin_m", "side_margin_m"):
        del changes[f"layout.{unseen}"]
    changes |= {"recirculation.decay_m": 1.01, "height_gradient": 1.01, "height_zones": 2}
    for path, factor in changes.items():
        section = dict(config.hall.model_dump(mode="json"))
        *outer, last = path.split(".")
        inner = section[outer[0]] if outer else section
        inner[last] = inner[last] * factor
        changed = config_from_dict({**values, "hall": section})
        sums = Hall(build_fleet(changed), "f64").solve(met)
        difference = np.max(np.abs(sums.rack_inlet_max_c - twin.racks["inlet_max_c"]))
        assert difference > 1e-6, f"{path} has no effect on the inlets"


# --- calibration --------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*up to 25 K is usual")
@pytest.mark.parametrize("airflow", [None, 0.012, 0.02])
def test_design_point_of_the_paper_comes_out_with_any_airflow_of_the_servers(
    airflow: float | None,
) -> None:
    overrides = [] if airflow is None else [f"servers.fan_full_airflow_m3s={airflow}"]
    config = load_config("corrected", ["hall.recirculation.calibrate=rack", *overrides])
    sums = at_design([config])
    approach_k = np.repeat([5.3, 5.0, 5.3], [5, 10, 5])
    np.testing.assert_allclose(sums.rack_inlet_c - 23.0, approach_k, rtol=0, atol=1e-9)
    mean_return_k = sums.units_return_c[0] - np.mean(sums.rack_outlet_c)
    if not overrides:
        assert mean_return_k == pytest.approx(-3.1, abs=1e-9)


@settings(phases=AS_FOUND, max_examples=8)
@given(seed=SEEDS)
def test_any_design_point_comes_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Means of rows and halls hold in the reference hall, which is a hall of racks that are alike.
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))], even=True)
    settings = config.hall.recirculation.model_copy(update={"approach_of": "hall"})
    hall = config.hall.model_copy(update={"recirculation": settings})
    sums = at_design([config.model_copy(update={"hall": hall})])
    found = sums.rack_inlet_c - config.hall.design_supply_c
    scaled_to, given = hall.recirculation.scaled_to, np.array(hall.supply_approach_k)
    if scaled_to == "row":
        found, given = (k.reshape(hall.rows, -1).mean(axis=1) for k in (found, given))
    elif scaled_to == "hall":
        found, given = found.mean(), given.mean()
    np.testing.assert_allclose(found, given, rtol=0, atol=1e-9)
    if all(g.design_rise_k is None for rack in config.rack_groups() for g in rack):
        mean_return_k = sums.units_return_c[0] - np.mean(sums.rack_outlet_c)
        assert mean_return_k == pytest.approx(np.mean(hall.return_approach_k), abs=1e-9)


def test_containment_takes_its_share_of_the_paths() -> None:
    by_rack = "hall.recirculation={calibrate: rack, approach_of: open_hall}"
    whole = calibrate(load_config("corrected", [by_rack])).matrix()
    for containment in (0.25, 0.9, 1.0):
        config = load_config("corrected", [f"hall.layout.containment={containment}", by_rack])
        part = calibrate(config).matrix()
        np.testing.assert_allclose(part, (1 - containment) * whole, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("containment", [0.0, 0.3, 0.85, 0.999])
@pytest.mark.parametrize("zones", [1, 5])
@pytest.mark.parametrize("more", [[], ["hvac.crac={units: 4, spare_units: 1}"]])
def test_measured_approaches_are_those_of_the_hall_as_it_stands(
    containment: float, zones: int, more: list[str]
) -> None:
    measured_k = np.random.default_rng(zones).uniform(1.0, 6.0, 20)
    contained = [f"hall.layout.containment={containment}", f"hall.height_zones={zones}", *more]
    measured = [f"hall.supply_approach_k={measured_k.tolist()}", *contained]
    scaled_to_racks = [*measured, "hall.recirculation.calibrate=rack"]
    by_rack = at_design([load_config("corrected", scaled_to_racks)])
    np.testing.assert_allclose(by_rack.rack_inlet_c - 23.0, measured_k, rtol=0, atol=1e-9)
    for scaled_to, shape in (("row", (4, 5)), ("hall", (1, 20))):
        settings = f"hall.recirculation={{calibrate: {scaled_to}, approach_of: hall}}"
        alike = [*measured, settings, "servers.power_w=[130, 10]"]
        means = at_design([load_config("corrected", alike)])
        np.testing.assert_allclose(
            means.rack_inlet_c.reshape(shape).mean(axis=1) - 23.0,
            measured_k.reshape(shape).mean(axis=1),
            rtol=0,
            atol=1e-9,
        )


def test_closed_hall_with_measured_approaches_is_refused() -> None:
    measured = ["hall.layout.containment=1", "hall.recirculation.calibrate=rack"]
    with pytest.raises(SdcError, match=r"containment 1 leaves no path .* valid is conta"):
        load_config("corrected", measured)
    load_config("corrected", [*measured, "hall.recirculation.approach_of=open_hall"])
    assert at_design([load_config("corrected", [*measured, "hall.supply_approach_k=0"])])


# --- conservation -------------------------------------------------------------------------------


def leaving(part: Part, sums: HallSums, layers: ServerLayers) -> tuple[float, float, F64]:
    """Heat that leaves a hall with its air, IT power, and what no rack takes of each exhaust.

    From R, the flows that the servers' power and warming tell, and the outlets; not from the
    return temperature.
    """
    twin, air = part.twin, part.twin.air_j_per_m3_k
    inlet, outlet, power = (
        getattr(layers, f.name)[part.servers].astype(np.float64) for f in fields(layers)
    )
    warming = outlet - inlet
    flow = np.where(warming > 0, power / (air * np.where(warming > 0, warming, 1.0)), 0.0)
    moved = reference_twin.flows(twin, flow, part.low, part.high)
    outlets = np.asarray(sums.rack_outlet_c[part.racks], dtype=np.float64)
    _, left_over = reference_twin.return_air(
        twin, moved, twin.per_rack(flow), outlets, part.supply_c, part.breath
    )
    heat = left_over @ outlets + (moved.bypass - moved.unit) @ part.supply_c
    return air * float(heat), float(power.sum()), left_over


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=4)
@given(seed=SEEDS)
def test_all_power_leaves_with_the_air(precision: Precision, seed: int) -> None:
    configs = random_halls(seed)
    met = random_conditions(np.random.default_rng(seed + 1), configs)
    hall = Hall(fleet_of(*configs), precision)
    sums, layers = hall.solve(met), hall.servers()
    for i, part in enumerate(parts(configs, met)):
        part = replace(part, supply_c=sums.unit_supply_c[part.units])
        heat_w, power_w, left_over = leaving(part, sums, layers)
        it_w = sums.cpu_w[i] + sums.it_fan_w[i]
        assert power_w == pytest.approx(it_w, rel=TOLERANCE[precision])
        # In f32 what the last sweep leaves counts ten times where units give a third of the need.
        rel = {"f64": 1e-12, "f32": 1e-4}[precision]
        assert heat_w == pytest.approx(power_w, rel=rel, abs=1e-6)
        assert left_over.sum() >= -1e-6
        # The kernel's own sums close without the help of another sweep.
        carried = part.twin.air_j_per_m3_k * sums.units_flow_m3s[i]
        found = carried * (sums.units_return_c[i] - sums.supply_c[i])
        assert found == pytest.approx(it_w, rel=TOLERANCE[precision], abs=1e-6 * carried)


@pytest.mark.parametrize("failed", [[10], [0], [5, 6, 7, 8, 9]], ids=["one", "corner", "row"])
@pytest.mark.parametrize("share", [0.5, 0.1, 0.02])
def test_racks_with_failing_fans_give_no_more_heat_than_they_have(
    share: float, failed: list[int]
) -> None:
    config, breath = load_config("corrected"), np.ones(20)
    breath[failed] = share
    hall = Hall(fleet_of(config), "f64")
    before = hall.solve(Conditions(np.array([18.0]), np.ones(1)))
    met = Conditions(np.array([18.0]), np.ones(1), rack_airflow=breath)
    sums, layers = hall.solve(met), hall.servers()
    part = parts([config], met)[0]
    heat_w, power_w, left_over = leaving(part, sums, layers)
    assert heat_w == pytest.approx(power_w, rel=1e-12)
    assert np.all(left_over >= -1e-9)
    # Heat in the intakes of others, over what the exhaust of the failed racks carries.
    flow = np.repeat(sums.rack_airflow_m3s / 200, 200)
    moved = reference_twin.flows(part.twin, flow, part.low, part.high)
    taken = moved.captured[:, None] * reference_twin.mixing(part.twin, breath)
    np.fill_diagonal(taken, 0.0)
    assert np.all(taken.sum(axis=0)[failed] <= sums.rack_airflow_m3s[failed])
    assert np.all(sums.rack_outlet_c[failed] > before.rack_outlet_c[failed] + 5)
    if len(failed) == 1:
        # Most of what it gives off goes back to the units and not to its neighbours. Its tiles give
        # air that the far end of its aisle lacks.
        others = np.delete(sums.rack_inlet_c - before.rack_inlet_c, failed)
        assert np.all(np.abs(others) < 1.2)


@settings(phases=AS_FOUND, max_examples=10)
@given(seed=SEEDS, load=st.floats(0, 1), supply_c=st.floats(16, 23))
def test_racks_loaded_alike_give_no_more_air_than_they_exhaust(
    seed: int, load: float, supply_c: float
) -> None:
    rng = np.random.default_rng(seed)
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))])
    met = Conditions(np.full(config.hvac.crac.units, supply_c), np.array([load]))
    hall = Hall(fleet_of(config), "f64")
    sums, layers = hall.solve(met), hall.servers()
    part = parts([config], met)[0]
    heat_w, power_w, left_over = leaving(part, sums, layers)
    assert heat_w == pytest.approx(power_w, rel=1e-12)
    assert np.all(left_over >= 0)
    rise_k = power_w / (part.twin.air_j_per_m3_k * sums.units_flow_m3s[0])
    assert sums.units_return_c[0] - supply_c == pytest.approx(rise_k, rel=1e-12)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("change", ["hall.supply_approach_k=0", "hall.layout.containment=1"])
def test_without_recirculation_servers_breathe_supply_air(
    change: str, precision: Precision
) -> None:
    config = load_config("corrected", [change, "hvac.crac.units=3"])
    # A contained hall needs more supply air than an open one.
    met = Conditions(np.full(3, 19.0), np.array([0.3]))
    hall = Hall(fleet_of(config), precision)
    hall.solve(met)
    assert_close(hall.servers().inlet_c, np.full(4000, 19.0), TOLERANCE[precision] / 10, "inlet")


@pytest.mark.parametrize("simple", [True, False], ids=["flat", "curves"])
@settings(phases=AS_FOUND, max_examples=5)
@given(seed=SEEDS, load=st.floats(0.2, 1))
def test_more_supply_air_never_warms_an_inlet(simple: bool, seed: int, load: float) -> None:
    rng = np.random.default_rng(seed)
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))])
    config = flat(config) if simple else config
    hall, units = Hall(fleet_of(config), "f64"), np.ones(config.hvac.crac.units)
    inlets = [
        hall.solve(
            Conditions(20 * units, np.array([load]), unit_low=f * units, unit_high=f * units)
        ).rack_inlet_c
        for f in (0.5, 0.6, 0.75, 0.9, 1.0, 1.3)
    ]
    assert np.all(np.diff(inlets, axis=0) <= 1e-9)


# --- places -------------------------------------------------------------------------------------


def moved_load_k(
    config: DataCenterConfig, giver: int, taker: int, power_w: float
) -> tuple[F64, float]:
    """Change of all inlets when a rack takes ``power_w`` from another, and what really moved."""
    hall, racks = Hall(fleet_of(config), "f64"), config.hall.racks
    load = np.full(racks, 0.5)

    def solve(change: float) -> HallSums:
        now = load.copy()
        now[giver] -= change
        now[taker] += change
        return hall.solve(Conditions(np.array([20.0]), np.array([0.5]), rack_load=now))

    before = solve(0.0)
    low, high = 0.0, 0.5
    for _ in range(40):
        middle = (low + high) / 2
        after = solve(middle)
        gained = float((after.rack_cpu_w - before.rack_cpu_w)[taker])
        low, high = (middle, high) if gained < power_w else (low, middle)
    return np.asarray(after.rack_inlet_c - before.rack_inlet_c), gained


def test_moving_15_kw_between_two_racks_moves_their_neighbours_most() -> None:
    # Of racks that breathe alike: those at the ends of rows feel any change more.
    config = load_config("corrected", ["hall.recirculation.calibrate=rack"])
    giver, taker = 0, 19
    change_k, moved_w = moved_load_k(config, giver, taker, 15e3)
    assert moved_w == pytest.approx(15e3, rel=1e-9)
    assert change_k[taker - 1] > 0.02
    assert change_k[giver + 1] < -0.02
    # Along the rows at the walls, from the two racks in the corners.
    assert np.all(np.diff(change_k[[19, 18, 17, 16, 15]]) < 0)
    assert np.all(np.diff(change_k[[0, 1, 2, 3, 4]]) > 0)


@settings(phases=AS_FOUND, max_examples=7)
@given(seed=SEEDS)
def test_servers_agree_with_their_racks_and_get_warmer_upwards(seed: int) -> None:
    rng = np.random.default_rng(seed)
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))], even=True)
    met = random_conditions(rng, [config], kind=0)
    hall = Hall(fleet_of(config), "f64")
    sums, layers = hall.solve(met), hall.servers()
    fleet = fleet_of(config)
    rack, air = fleet.server_rack(), reference_twin.calibrated(config).air_j_per_m3_k
    warming = layers.outlet_c - layers.inlet_c
    on = warming > 0
    flow = np.where(on, layers.power_w / (air * np.where(on, warming, 1.0)), 0.0)

    def total(values: Any) -> F64:
        return np.asarray(np.bincount(rack, values, fleet.racks), dtype=np.float64)

    assert_close(total(layers.power_w), sums.rack_cpu_w + sums.rack_fan_w, 1e-12, "power")
    assert_close(total(flow), sums.rack_airflow_m3s, 1e-11, "airflow")
    blown = sums.rack_airflow_m3s > 0
    for name in ("inlet_c", "outlet_c"):
        mean = total(flow * getattr(layers, name))[blown] / sums.rack_airflow_m3s[blown]
        assert_close(mean, getattr(sums, f"rack_{name}")[blown], 1e-12, name)
    columns = layers.inlet_c.reshape(fleet.racks, -1)
    zones = min(config.hall.height_zones, columns.shape[1])
    for column in columns:
        assert np.all(np.diff(column) >= 0)
        assert len(np.unique(column)) <= zones
    # A rack whose exhaust mix is as warm as its supply has nothing to tell its zones apart by.
    if config.hall.height_gradient > 1e-3 and config.hall.layout.containment < 1:
        warm = np.ptp(columns, axis=1) > 0
        assert all(len(np.unique(c)) == zones for c in columns[warm])


# --- batches ------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=6)
@given(seed=SEEDS)
def test_a_hall_of_a_batch_equals_itself_alone(precision: Precision, seed: int) -> None:
    configs = random_halls(seed)
    met = random_conditions(np.random.default_rng(seed + 1), configs)
    batch = Hall(fleet_of(*configs), precision)
    together, layers = batch.solve(met), batch.servers()
    for i, (config, part) in enumerate(zip(configs, parts(configs, met), strict=True)):
        alone = Hall(fleet_of(config), precision)
        sums, own = alone.solve(own_conditions(met, configs, i)), alone.servers()
        for name, expected in own_part(together, configs, i).items():
            assert np.array_equal(getattr(sums, name), expected), (config.name, name)
        for f in fields(own):
            found = getattr(layers, f.name)[part.servers]
            assert np.array_equal(getattr(own, f.name), found), (config.name, f.name)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_hall_forgets_what_it_solved_before(precision: Precision) -> None:
    configs = random_halls(5)
    rng = np.random.default_rng(0)
    first, second = (random_conditions(rng, configs) for _ in range(2))
    hall, fresh = (Hall(fleet_of(*configs), precision) for _ in range(2))
    hall.solve(first)
    hall.servers()
    again, expected = hall.solve(second), fresh.solve(second)
    for f in fields(expected):
        assert np.array_equal(getattr(again, f.name), getattr(expected, f.name)), f.name
