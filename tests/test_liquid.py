"""Liquid-cooled racks, CDUs and facility loops against closed forms, data sheets and balances.

Figures without a closed form come from a NumPy model of one CDU (docs/liquid.md).
"""

from dataclasses import fields, replace
from typing import Any, no_type_check

import numpy as np
import pytest

from sdc_taichi.kernels.arguments import Argument
from sdc_taichi.kernels.compiler.named_kernel import NamedKernel, define_kernel
from sdc_taichi.plant import liquid as plant
from sdc_taichi.plant.liquid import CduParameters, LiquidFleet, PlantParameters, RackParameters
from sdc_taichi.sim.liquid import Liquid, LiquidInputs, LiquidResult

STEP_S = 900.0
LPM = 1.0 / 60000.0
EPSILON = 1e-12


def fleet_of(
    size: int = 1,
    racks: int = 10,
    *,
    cdus: int = 1,
    manifolds: int = 1,
    of_rack: dict[str, Any] | None = None,
    of_cdu: dict[str, Any] | None = None,
    **of_plant: Any,
) -> LiquidFleet:
    return replace(
        LiquidFleet.of_equal(size, racks=racks, cdus=cdus, manifolds=manifolds),
        racks=RackParameters(**of_rack or {}),
        cdus=CduParameters(**{"capacity_w": 1.3e6, **(of_cdu or {})}),
        plants=PlantParameters(**of_plant),
    )


def inputs_of(
    fleet: LiquidFleet,
    utilisation: Any = 1.0,
    outdoor_c: Any = 25.0,
    wet_bulb_c: Any = 15.0,
    *,
    powered: Any = 1.0,
    dew_point_c: float = 15.0,
    **more: Any,
) -> LiquidInputs:
    racks, size = fleet.rack_offsets[-1], len(fleet.manifold_offsets) - 1

    def full(value: Any, count: int) -> Any:
        return np.broadcast_to(value, count).astype(np.float64)

    return LiquidInputs(
        full(utilisation, racks),
        full(powered, racks),
        full(outdoor_c, size),
        full(wet_bulb_c, size),
        full(dew_point_c, size),
        **{name: full(*value) for name, value in more.items()},
    )


def steady(fleet: LiquidFleet, *conditions: Any, **more: Any) -> LiquidResult:
    liquid = Liquid(fleet, step_s=STEP_S)
    state = liquid.initial_state(inputs_of(fleet))
    _, result = liquid.step(state, inputs_of(fleet, *conditions, **more))
    return result


def values(result: LiquidResult, *names: str) -> list[float]:
    return [float(getattr(result, name)[0]) for name in names]


def close(value: Any, expected: Any, tolerance: float) -> None:
    np.testing.assert_allclose(value, expected, rtol=tolerance, atol=0.0)


# ------------------------------------------------------------------------------- exchangers
def test_effectiveness_needs_no_case_for_equal_capacity_rates() -> None:
    close(plant.effectiveness(1.0, 0.5), 0.5647334016064162, 1e-14)
    close(plant.effectiveness(3.0, 1.0), 0.75, 1e-14)
    close(plant.effectiveness(3.0, 1 - 1e-9), 0.75, 1e-9)


def test_effectiveness_is_that_of_4000_cells() -> None:
    for ntu in (0.1, 1.0, 3.0, 6.0):
        for ratio in (0.05, 0.5, 0.9, 0.999999, 1.0):
            rates = np.array([[-ntu, ntu], [-ntu * ratio, ntu * ratio]]) / 4000.0
            cell, power = np.eye(2), np.eye(2)
            for k in range(1, 5):  # a step of the Runge-Kutta method of order 4
                power = power @ rates / k
                cell = cell + power
            # Side s enters at 1 on the left, side f at 0 on the right.
            through = np.linalg.matrix_power(cell, 4000)
            left_f = -through[1, 0] / through[1, 1]
            left_s = through[0, 0] + left_f * through[0, 1]
            assert abs(plant.effectiveness(ntu, ratio) - (1.0 - left_s)) < 1e-12


def test_data_sheets_of_cdus_and_coolers() -> None:
    ua = plant.exchanger_ua_w_per_k(1368e3, 20.6 * 3950, 20.6 * 4184, approach_k=4.0)
    close(ua, 307167.3963257587, 1e-9)  # Vertiv XDU1350
    c_s, c_f = 31.48 * 3900, 32.30 * 4184  # OCP Project Deschutes
    ua = plant.exchanger_ua_w_per_k(2e6, c_s, c_f, approach_k=3.0)
    k = plant.conductance_w_per_k(ua, c_s, c_f)
    close(26.8 + 2e6 / k - 2e6 / c_s, 29.8, 1e-9)
    # BAC TDFS1238N: 46.11 to 40.55 C with air of 35 C
    c_w = 2931e3 / (319.26 - 313.70)
    ua = plant.exchanger_ua_w_per_k(2931e3, c_w, c_w, approach_k=313.70 - 308.15)
    close([5.56 / 11.11, ua / c_w, 117680 / 2931e3], [0.50045, 1.0018, 0.04015], 1e-4)
    sizes = plant.size_liquid(fleet_of())
    close([sizes.cdu_w_per_k[0], sizes.cdu_ua_w_per_k[0]], [1.3e6 / 12, 3 * 1.3e6 / 12], EPSILON)


def test_films_and_walls_are_in_series() -> None:
    share = plant.ua_share(0.5, 0.5, wall_share=0.1, side_share=0.5)
    close(share, 0.6197270725547392, 1e-14)


def test_six_newton_steps_find_the_flow_for_a_conductance() -> None:
    from functools import cache

    import taichi as ti

    from sdc_taichi.kernels.compiler import runtime
    from sdc_taichi.kernels.decay import decay_series
    from sdc_taichi.kernels.liquid import flow_for

    spec = {
        "serial": Argument("template"),
        "slices": Argument("i32"),
        "one": Argument("i32"),
        "wanted": Argument("f64", 1),
        "y_s": Argument("f64", 1),
        "starts": Argument("f64", 1),
        "out": Argument("f64", 2),
    }

    @ti.func
    @no_type_check
    def run(test: ti.template(), number):
        for i in range(test.wanted.shape[0]):
            y, k = flow_for(
                test, test.wanted[i], test.real(325e3), test.real(0.1), test.real(0.5),
                test.real(325e3 / 3) * test.y_s[i], test.y_s[i], test.real(325e3 / 3),
                test.real(0.05), test.real(1.2), test.starts[i],
            )  # fmt: skip
            test.out[0, i], test.out[1, i] = y, k

    @cache
    def kernel() -> Any:
        return define_kernel(
            "flows", spec, run, precision="f64", constants={"decay_series": decay_series("f64")}
        )

    rng = np.random.default_rng(0)
    y, y_s = np.exp(rng.uniform(np.log(0.06), np.log(1.19), 4000)), rng.uniform(0.3, 1.2, 4000)
    c = 325e3 / 3
    ua = 325e3 * plant.ua_share(y_s, y, wall_share=0.1, side_share=0.5)
    wanted, out = plant.conductance_w_per_k(ua, c * y_s, c * y), np.zeros((2, 4000))
    runtime.ensure_started()
    starts = np.where(rng.random(4000) < 0.5, 0.0, y * rng.uniform(0.8, 1.25, 4000))
    NamedKernel(kernel(), spec)(
        serial=True, slices=1, one=1, wanted=wanted, y_s=y_s, starts=starts, out=out
    )
    close(out[1], wanted, 1e-8)
    close(out[0], y, 1e-6)


# ------------------------------------------------------------------------------------ racks
def gpu_w(result: LiquidResult) -> float:
    return (float(result.it_w[0]) - 36 * 300.0 - 34800.0) / 72.0


def test_resistance_of_cold_plates() -> None:
    racks, lpm = RackParameters(), np.array([0.5, 0.8, 1.0, 1.4, 2.0, 2.4])
    close(
        racks.r0_k_per_w + racks.a_k_lpm_per_w / lpm,
        [0.0325, 0.0265, 0.0245, 0.0220, 0.0204, 0.0197],
        0.01,
    )


def test_rack_at_full_load_without_leakage() -> None:
    result = steady(fleet_of(of_rack={"leak_per_k": 0.0}))
    close([result.it_w[0], result.liquid_w[0]], [132e3, 115e3], 1e-3)


def test_racks_of_frontier() -> None:
    node_w = (4 * 560 + 280 + 74.26 + 4 * 20 + 30) / (0.98 * 0.96)
    other_w = 128 * (node_w - 4 * 560 - 280) + 32 * 250
    of_rack = {"gpus": 512, "gpu_max_w": 560.0, "cpus": 128, "cpu_max_w": 280.0, "leak_per_k": 0.0}
    of_rack["liquid_design_w"] = 350e3
    result = steady(
        fleet_of(of_rack={**of_rack, "other_max_w": other_w}, of_cdu={"capacity_w": 4e6})
    )
    close([result.it_w[0], 74 * result.it_w[0]], [3.760e5, 2.782e7], 2e-3)


def test_leakage_and_throttling_of_gpus() -> None:
    result = steady(fleet_of())
    close(
        [gpu_w(result), result.junction_max_c[0]], [1220.8651799824067, 78.69382499266953], EPSILON
    )
    assert result.throttle_s[0] == -1.0
    result = steady(fleet_of(of_cdu={"setpoint_c": 50.0}))
    # The supply is at its setpoint within the tolerance of the valve.
    clock = 1.0 - result.lost_utilisation[0]
    close([gpu_w(result), result.junction_max_c[0]], [1104.3178416059773, 85.0], EPSILON)
    close(clock, 0.9550915075547389, EPSILON)
    assert result.throttle_s[0] == 0.0


def test_power_cap_lowers_power_and_clock() -> None:
    result = steady(fleet_of(), power_cap=(0.6, 1))
    close(gpu_w(result), 720.0, EPSILON)
    free_w = (1200 + 2.4 * (40 - 70)) / (1 - 2.4 * 0.99 * (0.0264 + 0.00807 / 1.4375))
    close(1.0 - result.lost_utilisation[0], np.cbrt((720 - 140) / (free_w - 140)), EPSILON)


def test_flows_and_pump_of_a_manifold_with_a_throttled_valve() -> None:
    fleet = fleet_of()
    valve = np.ones(10)
    valve[-1] = 0.5
    result = steady(fleet, rack_valve=(valve, 10))
    flows = result.rack_m3s / LPM
    close([flows[-1], flows[0]], [72.63157894736842, 145.26315789473685], EPSILON)
    close(result.cdu_pump_w, 10100.992613111728, EPSILON)
    result = steady(fleet, 0.5, cdu_flow=(0.6, 1))
    close(result.cdu_pump_w, 0.216 * 250e3 * 0.023 / 0.6, EPSILON)


# ------------------------------------------------------------------------------------ plant
PLANT = (
    "liquid_it_w", "liquid_heat_w", "cdu_supply_c", "cdu_return_c", "junction_max_c", "cdu_valve",
    "facility_supply_c", "cdu_pump_w", "facility_pump_w", "cooler_fan_w",
)  # fmt: skip


def test_plant_at_full_and_part_load() -> None:
    full, part = steady(fleet_of()), steady(fleet_of(), 0.3, 10.0)
    close(
        values(full, *PLANT),
        [1335022.93, 1164724.7, 40.0, 52.7742721, 78.693825, 0.843373159, 36.0, 9583.33333,
         4803.11864, 6216.97257],
        1e-6,
    )  # fmt: skip
    close(
        values(part, *PLANT),
        [590722.487, 487218.862, 40.0, 45.3654238, 54.0527767, 0.528089155, 36.0, 9583.33333,
         1179.19529, 71.1307169],
        1e-6,
    )  # fmt: skip
    lost_w = [400.0 * (result.cdu_return_c[0] - 27.0) for result in (full, part)]
    close(lost_w, [10309.7088, 7346.16952], 1e-6)


def test_hot_days_warm_the_coolant_or_need_a_trim_chiller() -> None:
    hot = steady(fleet_of(), 1.0, 40.0)
    close(
        [*values(hot, "cdu_supply_c", "junction_max_c", "liquid_it_w", "cooler_fan_w")],
        [49.0568241, 85.0, 1272535.35, 26000.0],
        1e-6,
    )
    close(1.0 - hot.lost_utilisation[0], 0.965529831, 1e-6)
    trim = steady(fleet_of(trim_w=1.3e6, trim_cop=6.0), 1.0, 40.0)
    close(
        values(trim, "cdu_supply_c", "trim_load_w", "trim_chiller_w"),
        [40.0, 606764.068, 101127.345],
        1e-6,
    )
    cooler_w = trim.liquid_rejected_w - trim.trim_load_w - trim.trim_chiller_w
    close(cooler_w, 560598.731, 1e-6)
    by_model = steady(fleet_of(trim_w=1.3e6), 1.0, 40.0)
    # Water of 36 C and a condenser at 47 C: a lift of 11 K.
    reference = 5.96 * 22.77 / 279.82
    assert (
        0.9
        < by_model.trim_load_w[0] / by_model.trim_chiller_w[0] / (reference * 309.15 / 11.0)
        < 1.2
    )


def test_pads_are_wet_only_where_dry_air_does_not_suffice() -> None:
    fleet = fleet_of(rejection=plant.REJECTION_KINDS.index("adiabatic"))
    wet, mild = steady(fleet, 1.0, 40.0, 20.0), steady(fleet, 1.0, 20.0, 10.0)
    close(wet.cdu_supply_c, 40.0, 1e-9)
    z = np.cbrt(wet.cooler_fan_w / 26000.0)
    evaporated_kg_s = 1.3e6 / 12 * z * 16.0 / 2.45e6
    close(wet.cooler_water_l, evaporated_kg_s * STEP_S * 5.0 / 4.0, 1e-9)
    assert mild.cooler_water_l[0] == 0.0


def test_towers_hold_the_setpoint_with_less_fan_power_than_dry_coolers() -> None:
    tower = fleet_of(rejection=plant.REJECTION_KINDS.index("tower"))
    cool, warm = steady(tower, 1.0, 30.0, 15.0), steady(tower, 1.0, 40.0, 26.0)
    close(cool.cdu_supply_c, 40.0, 1e-6)
    assert 0.0 < cool.cooler_fan_w[0] < steady(fleet_of(), 1.0, 30.0).cooler_fan_w[0]
    assert cool.cooler_fan_w[0] < warm.cooler_fan_w[0] <= 26000.0
    close(warm.cooler_water_l, warm.liquid_rejected_w / 2.45e6 * STEP_S * 1.25, 1e-9)


# ------------------------------------------------------------------------------------ reuse
HEAT_PUMP: dict[str, Any] = {"reuse_kind": plant.REUSE_KINDS.index("heat_pump"), "reuse_share": 1.0}
DIRECT: dict[str, Any] = {"reuse_kind": plant.REUSE_KINDS.index("direct"), "reuse_share": 1.0}


def test_direct_reuse_and_heat_pump() -> None:
    direct = steady(fleet_of(**DIRECT), 1.0, 10.0)
    close(direct.reuse_w, 1006982.5790038795, 1e-9)
    pump = steady(fleet_of(**HEAT_PUMP), 1.0, 10.0)
    taken_w = pump.reuse_w - pump.heat_pump_w
    close(
        [pump.reuse_w[0] / pump.heat_pump_w[0], pump.reuse_w[0] / taken_w[0]],
        [8.220391527638013, 1.1384966447002531],
        1e-9,
    )
    fans_and_pumps_w = pump.cdu_pump_w + pump.facility_pump_w + pump.cooler_fan_w
    facility_w = pump.liquid_it_w + fans_and_pumps_w + pump.heat_pump_w + 0.3 * pump.liquid_air_w
    pue, erf = facility_w / pump.liquid_it_w, pump.reuse_w / facility_w
    close(
        [pue[0], erf[0], ((1.0 - erf) * pue)[0]],
        [1.1728077118071074, 0.8488326302315576, 0.17729025703802578],
        # The powers follow the valves, whose tolerance is 1e-10.
        1e-9,
    )


@pytest.mark.parametrize("kind", [DIRECT, HEAT_PUMP])
def test_reuse_delivers_at_most_the_demand(kind: dict[str, Any]) -> None:
    limited = steady(fleet_of(**kind, reuse_demand_w=4e5, heat_price_per_kwh=0.04), 1.0, 10.0)
    assert limited.reuse_w[0] <= 4e5
    close(limited.reuse_w, 4e5, 1e-4)
    close(limited.heat_income, limited.reuse_w * 0.25 * 0.04 / 1e3, EPSILON)
    none = steady(fleet_of(**kind), 1.0, 10.0, reuse_share=(0.0, 1))
    assert none.reuse_w[0] == none.heat_pump_w[0] == 0.0


# ------------------------------------------------------------------------------- protection
def test_setpoints_stay_above_the_dew_point_and_move_slowly() -> None:
    fleet = fleet_of(of_cdu={"setpoint_c": 10.0})
    close(steady(fleet, 1.0, 0.0).cdu_supply_c, 17.0, 1e-9)
    liquid = Liquid(fleet_of(), step_s=STEP_S)
    inputs = inputs_of(liquid.fleet, cdu_setpoint_c=(30.0, 1), cdu_flow=(0.8, 1))
    state, _ = liquid.step(liquid.initial_state(inputs), inputs)
    assert state.cdu_setpoint_c[0] == 38.0
    assert state.cdu_flow[0] == 0.8


def test_a_spare_cdu_takes_over_and_a_missing_one_trips_racks() -> None:
    fleet = fleet_of(cdus=2, spare=1.0)
    both = steady(fleet)
    down = steady(fleet, cdu_up=([0.0, 1.0], 2))
    close(down.cdu_supply_c, both.cdu_supply_c, 1e-6)
    close(both.cdu_flow_m3s, [0.0115, 0.0115], EPSILON)
    close(down.cdu_flow_m3s, [0.0, 0.023], EPSILON)
    # Each of two pumps runs at half flow, of which the branches take the full head.
    close(both.cdu_pump_w, 9583.3333333333 * (0.25 + 1.0) / 2.0, 1e-9)
    assert not down.tripped.any()
    half = steady(fleet_of(), cdu_pumps=(0.3, 1))
    assert half.tripped.all()
    assert half.trip_s[0] == 0.0
    assert half.liquid_it_w[0] == 0.0
    assert steady(fleet_of(), facility_pump=(0.0, 1)).tripped.all()


def test_cdus_of_a_manifold_hold_setpoints_of_their_own() -> None:
    fleet = fleet_of(cdus=2, of_cdu={"setpoint_c": np.array([36.0, 40.0])})
    result = steady(fleet)
    close(result.cdu_supply_each_c, [36.0, 40.0], 1e-8)
    close(result.cdu_supply_c, 38.0, 1e-8)
    assert result.cdu_heat_w[0] > result.cdu_heat_w[1]


def test_rear_doors_take_more_heat_with_colder_coolant() -> None:
    of_rack = {
        "gpus": 0, "cpus": 0, "other_idle_w": 4e3, "other_max_w": 12e3, "lpm_per_kw": 2.0,
        "door_effectiveness": 0.6, "liquid_design_w": 12e3, "door_rise_k": 13.0,
    }  # fmt: skip
    of_cdu = {"capacity_w": np.nan, "setpoint_c": 22.0}
    result = steady(fleet_of(of_rack=of_rack, of_cdu=of_cdu), 1.0, 5.0)
    share = 0.6 * (1.0 + (27.0 - 22.0) / 13.0)
    close(result.liquid_heat_w / result.liquid_it_w, share, 1e-8)
    assert result.junction_max_c == 0.0
    # Without heat for the CDUs, pipes lose what doors take.
    hot = steady(fleet_of(of_rack=of_rack, of_cdu={**of_cdu, "setpoint_c": 45.0}))
    assert hot.cdu_heat_w[0] == 0.0
    lost_w = 400.0 * (hot.cdu_return_c[0] - 27.0)
    close(hot.liquid_heat_w[0] + 0.9 * hot.cdu_pump_w[0], lost_w, 1e-9)
    assert 37.0 < hot.cdu_supply_c[0] < 40.0


# ---------------------------------------------------------------------------------- ledgers
def random_fleet(rng: np.random.Generator, size: int) -> LiquidFleet:
    """Return data centers of 1 or 2 manifolds, without and with a spare CDU, of every kind."""
    manifolds = rng.integers(1, 3, size)
    spare = rng.integers(0, 2, size)
    loops = int(manifolds.sum())
    cdus = np.repeat(spare, manifolds) + rng.integers(1, 3, loops)
    racks = rng.integers(2, 6, loops)
    n_racks, n_cdus = int(racks.sum()), int(cdus.sum())
    door = rng.random(n_racks) < 0.2

    def offsets(counts: Any) -> Any:
        return np.concatenate([[0], np.cumsum(counts)])

    return LiquidFleet(
        offsets(racks),
        offsets(cdus),
        offsets(manifolds),
        racks=RackParameters(
            gpus=np.where(door, 0, 72),
            cpus=np.where(door, 0, 36),
            door_effectiveness=np.where(door, 0.6, 0.0),
            liquid_design_w=np.where(door, 2e4, 115e3),
            throttle_c=rng.uniform(70.0, 90.0, n_racks),
        ),
        cdus=CduParameters(setpoint_c=rng.uniform(20.0, 45.0, n_cdus), fluid_share=0.8),
        plants=PlantParameters(
            spare=spare.astype(float),
            rejection=rng.integers(0, 3, size).astype(float),
            trim_w=rng.choice([0.0, 1e5], size),
            trim_cop=rng.choice([np.nan, 5.0], size),
            reuse_kind=rng.integers(0, 3, size).astype(float),
            reuse_share=rng.uniform(0.0, 1.0, size),
            reuse_demand_w=rng.choice([1e5, np.inf], size),
        ),
    )


def random_inputs(rng: np.random.Generator, fleet: LiquidFleet, failures: bool) -> LiquidInputs:
    size, racks = len(fleet.manifold_offsets) - 1, fleet.rack_offsets[-1]
    cdus, outdoor_c = fleet.cdu_offsets[-1], rng.uniform(-15.0, 42.0, size)
    inputs = inputs_of(
        fleet,
        rng.uniform(0.0, 1.0, racks),
        outdoor_c,
        outdoor_c - rng.uniform(0.0, 15.0, size),
        powered=rng.choice([0.0, 0.5, 1.0, 1.0, 1.0], racks),
        cdu_flow=(rng.uniform(0.5, 1.1, cdus), cdus),
        power_cap=(rng.choice([0.7, 1.0], size), size),
    )
    if failures:
        inputs.cdu_up = (rng.random(cdus) > 0.1).astype(float)
        inputs.cdu_pumps = rng.choice([0.6, 1.0], cdus)
        inputs.facility_pump = rng.choice([0.0, 0.5, 1.0, 1.0], size)
        inputs.cooler_share = rng.choice([0.0, 0.5, 1.0, 1.0], size)
        inputs.rack_valve = rng.choice([0.0, 0.5, 1.0, 1.0], racks)
    return inputs


def heat_terms(result: LiquidResult) -> dict[str, Any]:
    """Return electricity that becomes heat, and where the heat goes with a minus sign, in W."""
    gains = ("liquid_it_w", "cdu_pump_w", "facility_pump_w", "trim_chiller_w", "heat_pump_w")
    losses = ("liquid_air_w", "reuse_w", "liquid_rejected_w", "liquid_stored_w")
    terms = {name: getattr(result, name) for name in gains}
    return terms | {name: -getattr(result, name) for name in losses}


def random_run(*, transient: bool, failures: bool, seed: int, size: int = 60) -> Any:
    rng = np.random.default_rng(seed)
    fleet = random_fleet(rng, size)
    liquid = Liquid(fleet, step_s=300.0, transient=transient)
    state = liquid.initial_state(random_inputs(rng, fleet, failures=False))
    inputs = random_inputs(rng, fleet, failures)
    after, result = liquid.step(state, inputs)
    return fleet, state, inputs, after, result


@pytest.mark.parametrize("transient", [False, True])
def test_heat_is_conserved_on_random_plants(transient: bool) -> None:
    for failures in (False, True):
        fleet, _, inputs, _, result = random_run(transient=transient, failures=failures, seed=1)
        terms = heat_terms(result)
        gross_w = 1e3 + sum(np.abs(x) for x in terms.values())
        for x in fields(result):
            assert np.isfinite(getattr(result, x.name)).all(), x.name
        assert np.max(np.abs(sum(terms.values())) / gross_w) < 1e-12
        for name in terms:
            if name != "liquid_stored_w" or transient:
                rest = sum(x for other, x in terms.items() if other != name)
                assert np.max(np.abs(rest) / gross_w) > 1e-6, name
        # Racks with power pass on all heat into the air.
        shut = fleet.has_plates & (inputs.rack_valve is not None and inputs.rack_valve == 0.0)
        powered = np.where(shut, 0.0, inputs.powered)
        dc = fleet.manifold_dc[fleet.rack_manifold]
        air_w = np.bincount(dc, result.air_w * powered, len(gross_w))
        has_power = np.bincount(dc, powered, len(gross_w)) > 0.0
        gap = np.abs(air_w - result.liquid_air_w)[has_power]
        assert has_power.any()
        assert np.max(gap / gross_w[has_power]) < 1e-12


def test_exchangers_transfer_what_their_flows_allow() -> None:
    fleet, _, _, after, result = random_run(transient=False, failures=False, seed=2)
    sizes, loop = plant.size_liquid(fleet), fleet.cdu_manifold
    dc = fleet.manifold_dc[loop]
    c_s = result.cdu_flow_m3s * 1015.0 * 3900.0
    open_ = result.cdu_valve > 0.05 * (1.0 + 1e-6)
    y_f = np.where(open_, result.cdu_valve, 1.0)
    y_s = np.where(open_, c_s / sizes.cdu_w_per_k, 1.0)
    ua = sizes.cdu_ua_w_per_k * plant.ua_share(y_s, y_f, wall_share=0.1, side_share=0.5)
    k = plant.conductance_w_per_k(ua, y_s * sizes.cdu_w_per_k, y_f * sizes.cdu_w_per_k)
    difference_k = after.manifold_return_c[loop] - result.facility_supply_c[dc]
    gap = np.abs(result.cdu_heat_w - k * difference_k)[open_] / result.cdu_heat_w[open_]
    assert np.count_nonzero(open_) > 60
    assert np.max(gap) < 1e-12
    # Side s cools by its heat.
    cooled_k = after.manifold_return_c[loop] - result.cdu_supply_each_c
    close(c_s * cooled_k + 1.0, result.cdu_heat_w + 1.0, 1e-9)


def part(fleet: LiquidFleet, i: int) -> tuple[LiquidFleet, dict[int, Any]]:
    """Return data center i alone, and a function for its part of each array by axis."""
    loops = slice(*fleet.manifold_offsets[i : i + 2])
    racks = slice(fleet.rack_offsets[loops.start], fleet.rack_offsets[loops.stop])
    cdus = slice(fleet.cdu_offsets[loops.start], fleet.cdu_offsets[loops.stop])

    def cut(record: Any, at: slice) -> Any:
        arrays = {f.name: getattr(record, f.name) for f in fields(record)}
        return replace(record, **{k: v[at] for k, v in arrays.items() if isinstance(v, np.ndarray)})

    alone = LiquidFleet(
        fleet.rack_offsets[loops.start : loops.stop + 1] - racks.start,
        fleet.cdu_offsets[loops.start : loops.stop + 1] - cdus.start,
        np.array([0, loops.stop - loops.start]),
        racks=cut(fleet.racks, racks),
        cdus=cut(fleet.cdus, cdus),
        plants=cut(fleet.plants, slice(i, i + 1)),
    )
    sizes = {len(fleet.rack_manifold): racks, len(fleet.cdu_manifold): cdus}
    sizes |= {len(fleet.manifold_dc): loops, len(fleet.manifold_offsets) - 1: slice(i, i + 1)}
    assert len(sizes) == 4
    return alone, sizes


@pytest.mark.parametrize("transient", [False, True])
def test_a_data_center_alone_has_the_bits_of_the_batch(transient: bool) -> None:
    fleet, state, inputs, after, result = random_run(transient=transient, failures=True, seed=3)
    for i in (0, 17, 59):
        alone, sizes = part(fleet, i)

        def cut(record: Any, sizes: dict[int, Any] = sizes) -> Any:
            names = [f.name for f in fields(record)]
            arrays = {k: getattr(record, k) for k in names if getattr(record, k) is not None}
            return type(record)(**{k: v[sizes[len(v)]] for k, v in arrays.items()})

        liquid = Liquid(alone, step_s=300.0, transient=transient)
        after_alone, result_alone = liquid.step(cut(state), cut(inputs))
        for of_batch, of_one in ((cut(after), after_alone), (cut(result), result_alone)):
            for f in fields(of_one):
                np.testing.assert_array_equal(getattr(of_batch, f.name), getattr(of_one, f.name))


def test_data_centers_without_liquid_racks_have_zeros() -> None:
    fleet = replace(fleet_of(), manifold_offsets=np.array([0, 0, 1, 1]))
    result = steady(fleet)
    assert result.liquid_it_w[1] > 1e6
    for f in fields(result):
        values_of = getattr(result, f.name)
        if len(values_of) == 3:
            expected = -1.0 if f.name in ("throttle_s", "trip_s") else 0.0
            assert values_of[0] == values_of[2] == expected, f.name


# -------------------------------------------------------------------------------- transient
FIXED_FLOW: dict[str, Any] = {"of_cdu": {"min_valve": 1.0, "max_valve": 1.0}, "min_pump": 1.0}
"""Facility water at its design flow."""


def trajectory(
    fleet: LiquidFleet, dt: float, count: int, *, utilisation: float = 1.0, **more: Any
) -> tuple[dict[str, Any], LiquidResult]:
    """Return junction, supply and power after each of many steps of one substep, from full load.

    With ``start`` among the keywords, the run starts from the steady state at that utilisation.
    """
    start = more.pop("start", 1.0)
    liquid = Liquid(
        replace(fleet, plants=replace(fleet.plants, substep_s=dt)), step_s=dt, transient=True
    )
    state = liquid.initial_state(inputs_of(fleet, start))
    rows = []
    for _ in range(count):
        state, result = liquid.step(state, inputs_of(fleet, utilisation, **more))
        rows.append([state.junction_c[0], state.manifold_supply_c[0], result.it_w[0]])
        terms = heat_terms(result)
        assert abs(sum(terms.values())[0]) < 1e-12 * result.liquid_it_w[0]
    names = ("junction_c", "supply_c", "it_w")
    return dict(zip(names, np.array(rows).T, strict=True)), result


def first_s(run: dict[str, Any], name: str, limit: float, dt: float) -> float:
    return float(dt * (1 + np.flatnonzero(run[name] >= limit)[0]))


def test_transient_at_rest_equals_steady() -> None:
    fleet = fleet_of()
    liquid = Liquid(fleet, step_s=STEP_S, transient=True)
    cold = liquid.initial_state(inputs_of(fleet, 0.3))
    inputs = inputs_of(fleet)
    state = cold
    for _ in range(12):
        state, result = liquid.step(state, inputs)
    close(
        [state.junction_c[0], state.manifold_return_c[0], state.manifold_supply_c[0]],
        [78.6938249926695, 52.77427211061733, 40.0],
        1e-9,
    )
    rest = steady(fleet)
    for f in fields(rest):
        np.testing.assert_allclose(
            getattr(result, f.name), getattr(rest, f.name), rtol=1e-6, atol=1.0, err_msg=f.name
        )


def test_random_plants_that_hold_their_setpoint_are_at_rest() -> None:
    rng = np.random.default_rng(5)
    fleet = random_fleet(rng, 100)
    inputs = replace(random_inputs(rng, fleet, failures=False), cdu_flow=None)
    inputs.powered[:] = 1.0
    state = Liquid(fleet, step_s=300.0).initial_state(inputs)
    after, result = Liquid(fleet, step_s=300.0, transient=True).step(state, inputs)
    # Water that is too warm opens valves further in transient halls only.
    holds = np.abs(result.facility_supply_c - result.facility_setpoint_c) < 1e-4
    assert np.count_nonzero(holds) > 60
    loops = holds[fleet.manifold_dc]
    axes = {
        "junction_c": loops[fleet.rack_manifold],
        "manifold_return_c": loops,
        "manifold_supply_c": loops,
        "facility_return_c": holds,
        "facility_supply_c": holds,
    }
    for name, chosen in axes.items():
        gap_k = np.abs(getattr(after, name) - getattr(state, name))[chosen]
        assert np.max(gap_k) < 1e-3, name
    stored = np.abs(result.liquid_stored_w / (1.0 + result.liquid_it_w))[holds]
    assert np.max(stored) < 1e-4


def test_rates_of_chips_and_loops() -> None:
    of_rack = {"leak_per_k": 0.0, "stagnant_w_per_k": 0.0, "trip_flow_share": 0.0}
    fleet = fleet_of(of_rack={**of_rack, "throttle_c": 1e6, "trip_c": 1e6})
    before = Liquid(fleet, step_s=1.0).initial_state(inputs_of(fleet)).junction_c[0]
    run, _ = trajectory(fleet, 1.0, 1, cdu_up=(0.0, 1))
    close(run["junction_c"][0] - before, 3.96, 1e-9)
    # A load change decays with 1/e over one time constant.
    tau_s = 300.0 * (0.0264 + 0.00807 / (138.0 * 0.75 / 72.0))
    close(tau_s, 9.604173913043478, 1e-9)
    cold, hot = (
        Liquid(fleet, step_s=1.0).initial_state(inputs_of(fleet, u)).junction_c[0]
        for u in (0.3, 1.0)
    )
    run, _ = trajectory(fleet, tau_s, 1, start=0.3)
    close(hot - run["junction_c"][0], (hot - cold) / np.e, 1e-9)
    close(1150e3 / plant.size_liquid(fleet).loop_j_per_k[0], 0.22347, 1e-3)


def test_times_after_loss_of_pumps_water_and_fans() -> None:
    held = {"throttle_c": 1e6, "trip_c": 1e6, "trip_flow_share": 0.0}
    run, _ = trajectory(fleet_of(of_rack=held), 0.1, 80, cdu_up=(0.0, 1))
    times_s = [first_s(run, "junction_c", limit, 0.1) for limit in (85.0, 105.0)]
    np.testing.assert_allclose(times_s, [1.6, 6.6], atol=0.15)
    run, _ = trajectory(fleet_of(**FIXED_FLOW), 1.0, 60, facility_pump=(0.0, 1))
    times_s = [first_s(run, "supply_c", 45.0, 1.0), first_s(run, "junction_c", 84.999, 1.0)]
    np.testing.assert_allclose(times_s, [13.0, 25.0], atol=1.0)
    gpus_w = (run["it_w"][-1] - 36 * 300.0 - 34800.0) / 72.0
    np.testing.assert_allclose(gpus_w / 1200.0, 0.699, atol=0.01)
    run, _ = trajectory(fleet_of(**FIXED_FLOW), 5.0, 60, cooler_share=(0.0, 1))
    times_s = [first_s(run, "supply_c", 45.0, 5.0), first_s(run, "junction_c", 84.999, 5.0)]
    np.testing.assert_allclose(times_s, [155.0, 190.0], atol=5.0)


@pytest.mark.parametrize(("dt", "most_k"), [(5.0, 0.25), (15.0, 1.0)])
def test_substeps_follow_the_coupled_equations(dt: float, most_k: float) -> None:
    fleet = fleet_of(of_rack={"throttle_c": 1e6})
    run, _ = trajectory(fleet, dt, int(120 / dt), start=0.3)
    fine, _ = trajectory(fleet, 0.02, 6000, start=0.3)
    gap_k = np.abs(run["junction_c"] - fine["junction_c"][round(dt / 0.02) - 1 :: round(dt / 0.02)])
    assert 0.5 * most_k < np.max(gap_k) < most_k


def test_racks_throttle_and_trip_within_a_step() -> None:
    fleet = fleet_of(2)
    liquid = Liquid(fleet, step_s=300.0, transient=True)
    start = liquid.initial_state(inputs_of(fleet))
    _, dry = liquid.step(start, inputs_of(fleet, facility_pump=([0.0, 1.0], 2)))
    assert dry.throttle_s.tolist() == [25.0, -1.0]
    assert dry.junction_max_c[1] < 79.0
    after, stopped = liquid.step(start, inputs_of(fleet, cdu_up=([0.0, 1.0], 2)))
    assert stopped.trip_s.tolist() == [1.0, -1.0]
    assert stopped.tripped[:10].all()
    assert not stopped.tripped[10:].any()
    close(stopped.liquid_it_w[0], stopped.liquid_it_w[1] / 300.0, 0.02)
    assert after.junction_c[0] < stopped.junction_each_c[0] < 85.0
