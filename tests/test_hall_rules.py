"""Rules for CRAC units, the steady states in which they try commands, and searches over these."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sdc_taichi import Actions, ConfigError, Simulator, load_config, simulate
from sdc_taichi.control import make_controller, view_maker
from sdc_taichi.optimum.hall_search import best_found, cost_w, one_speed
from sdc_taichi.sim.commanded_halls import CommandedHalls, HallConditions
from sdc_taichi.sim.drivers import load_drivers
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.hall_family import DENSE, hall_family
from sdc_taichi.sim.zone_loads import zone_of_rack
from sdc_taichi.types import F64

QUIET = ["events.sampled=[]", "workload.zone_loads.fixed=[0.9, 0.3, 0.6, 0.6]"]
HALL = load_config("hall_agents_6", QUIET)
LOAD = np.array([0.9, 0.3, 0.6, 0.6])[zone_of_rack(HALL)]
MILD = HallConditions(LOAD, 20.0, 15.0, np.ones(6))


@pytest.mark.parametrize("down", [None, 2])
def test_commanded_halls_are_in_the_state_of_a_simulated_step(down: int | None) -> None:
    values = [*QUIET, "simulation.thermal=quasi_steady"]
    running = np.ones(6)
    if down is not None:
        event = f"{{kind: crac_down, start_h: 0, duration_h: 9, unit: {down}}}"
        values.append(f"events.scheduled=[{event}]")
        running[down] = 0.0
    config = load_config("hall_agents_6", values)
    speed = np.array([0.9, 0.7, 0.8, 0.75, 0.6, 0.85])
    supply_c = np.array([20.0, 21, 22, 20, 21, 23])
    with Simulator(config, precision="f64") as sim:
        sim.reset()
        fan = (speed - sim.state.fan_speed) / 0.05
        result = sim.step(Actions(fan=fan, cooling=supply_c - 23.0))
        halls = CommandedHalls(config, sim.drivers, 3)
    conditions = HallConditions(
        LOAD, float(result.outdoor_c[0]), float(result.wet_bulb_c[0]), running
    )
    others = np.array([np.full(6, 0.9), speed])
    states = halls.at(others, np.array([supply_c, supply_c]), conditions)
    facility_w = result.it_w + result.overhead_w
    np.testing.assert_allclose(states.facility_w[1], facility_w[0], rtol=1e-6)
    np.testing.assert_allclose(states.cooling_w[1], (result.hvac_w + result.it_fan_w)[0], rtol=1e-5)
    np.testing.assert_allclose(states.rack_inlet_max_c[1], result.rack_inlet_max_c, atol=1e-3)
    np.testing.assert_allclose(states.speed[1], np.where(running > 0, speed, 0.1))
    again = halls.at(others[1:], supply_c[None], conditions)
    np.testing.assert_array_equal(again.facility_w, states.facility_w[1:])


def test_searches_find_less_power_within_the_limit() -> None:
    halls = CommandedHalls(HALL, load_drivers([HALL]), 96)
    common = one_speed(halls, MILD, 27.0, grids=4)
    assert common.inlet_max_c < 27.05
    assert np.ptp(common.speed) < 1e-12
    grid = np.linspace(0.4, 1.0, 12)
    supplies_c = np.linspace(18.0, 27.0, 8)
    pairs = [x.reshape(-1, 1).repeat(6, 1) for x in np.meshgrid(grid, supplies_c)]
    coarse = cost_w(halls.at(pairs[0], pairs[1], MILD), 27.0)
    assert common.cost_w <= coarse.min()
    best = [best_found(halls, MILD, [common], 27.0, generations=8, seed=seed) for seed in (1, 1)]
    assert best[0].cost_w <= common.cost_w
    np.testing.assert_array_equal(best[0].speed, best[1].speed)
    # Without units no heat is removed, which costs more than any power.
    still = halls.at(pairs[0], pairs[1], HallConditions(LOAD, 20.0, 15.0, np.zeros(6)))
    assert cost_w(still, 27.0).min() > 5 * coarse.max()


def acted(name: str, **zones: F64) -> tuple[Simulator, Any, Any]:
    sim = Simulator(HALL)
    sim.reset(seed=3)
    view_of = view_maker(sim)
    view = view_of(sim.step(Actions(fan=np.array([4.0, 0, 0, 0, 0, -1.0]))))
    controller = make_controller(name, sim.fleet)
    controller.reset(0)
    return sim, view, controller.act(view)


def commanded(sim: Simulator, actions: Any) -> tuple[F64, F64]:
    return sim.state.fan_speed + 0.05 * actions.fan, sim.state.setpoint_c + actions.cooling


def test_local_and_common_control_follow_the_measured_inlets() -> None:
    for name, target_c, setpoint_c in (("local-pi", 26.0, 20.0), ("common-pi:21.5/25", 25.0, 21.5)):
        sim, view, actions = acted(name)
        with sim:
            hottest_c, speed = view.zone_hottest_c, sim.state.fan_speed
            if name != "local-pi":
                hottest_c, speed = np.full(6, hottest_c.max()), np.full(6, speed[0])
            error_k = np.clip(hottest_c - target_c, -2.0, 2.0)
            expected = np.clip(np.clip(speed + 0.02 * error_k, 0.3, 1) + 0.01 * error_k, 0.3, 1)
            found, setpoints_c = commanded(sim, actions)
            np.testing.assert_allclose(found, expected, rtol=1e-12)
            np.testing.assert_allclose(setpoints_c, setpoint_c)


def test_fans_follow_the_need_and_trim_and_respond_counts_zones() -> None:
    for name in ("follow", "follow:19", "g36-trim-respond"):
        sim, view, actions = acted(name)
        with sim:
            speed, setpoints_c = commanded(sim, actions)
            np.testing.assert_allclose(speed, sim.state.fan_speed / view.zone_supply_ratio)
            requests = int((view.zone_hottest_c > 26.0).sum())
            trimmed_c = 23.1 - min(0.2 * max(requests - 1, 0), 0.6)
            expected_c = {"follow": 23.0, "follow:19": 19.0}.get(name, trimmed_c)
            np.testing.assert_allclose(setpoints_c, expected_c)


def test_followed_need_is_met() -> None:
    with Simulator(load_config("hall_agents_16", QUIET)) as sim:
        sim.reset()
        controller, view_of, result = make_controller("follow", sim.fleet), view_maker(sim), None
        for _ in range(24):
            result = sim.step(controller.act(view_of(result)))
        at_least = sim.state.fan_speed <= 0.3 + 1e-9
        np.testing.assert_allclose(view_of(result).zone_supply_ratio[~at_least], 1.0, atol=0.02)
        assert (~at_least).any()


@pytest.mark.parametrize("name", ["one-speed", "follow:best"])
def test_rules_that_try_commands_act_alike_alone_and_in_a_fleet(name: str) -> None:
    configs = [load_config("hall_agents_16", QUIET), HALL]
    with Simulator(configs) as sim, Simulator(HALL) as alone:
        sim.reset(seed=[1, 2])
        alone.reset(seed=[2])
        rules = [make_controller(name, each.fleet) for each in (sim, alone)]
        views = [view_maker(sim), view_maker(alone)]
        results: list[Any] = [None, None]
        for _ in range(3):
            actions = [
                rule.act(view(r)) for rule, view, r in zip(rules, views, results, strict=True)
            ]
            results = [sim.step(actions[0]), alone.step(actions[1])]
        np.testing.assert_array_equal(sim.state.fan_speed[16:], alone.state.fan_speed)
        np.testing.assert_array_equal(sim.state.setpoint_c[16:], alone.state.setpoint_c)
        assert 0.3 < alone.state.fan_speed[0] < 1.0


def test_rules_run_through_failures() -> None:
    config = load_config("hall_agents_6", ["events.sampled.0.per_year=8000"])
    for name in ("follow", "local-pi:20/25", "common-pi", "g36-trim-respond"):
        with Simulator([config] * 2) as sim:
            assert simulate(sim, make_controller(name, sim.fleet), 30, 1).steps == 30


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("local-pi:30/26", "valid is a setpoint of 18..27 C .*such as local-pi:20/26"),
        ("local-pi:20", "and the target of the hottest inlet"),
        ("common-pi:20/90", "0..60 C, such as common-pi:20/26"),
        ("follow:warm", "such as follow:20"),
        ("one-speed:26", "one-speed takes no text; valid is one-speed"),
        ("load=local-pi", "does not act on load"),
    ],
)
def test_names_of_rules_that_are_not_valid(name: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        make_controller(name, build_fleet(HALL))


def test_halls_of_a_family_differ_and_run() -> None:
    halls = hall_family(np.random.default_rng(1), 6, row_pairs=(1, 4), units=(3, 10))
    assert halls == hall_family(np.random.default_rng(1), 6, row_pairs=(1, 4), units=(3, 10))
    assert len({hall.name for hall in halls}) == 6
    assert {hall.hall.rows for hall in halls} > {2}
    assert all(3 <= hall.hvac.crac.units <= 10 for hall in halls)
    dense = hall_family(np.random.default_rng(2), 1, dense_share=(1.0, 1.0))[0]
    assert set(dense.hall.rack_type_names()) <= set(DENSE)
    with Simulator(halls) as sim:
        assert simulate(sim, make_controller("common-pi", sim.fleet), 6, 1).steps == 6


def test_families_that_are_not_valid() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigError, match=r"family: units 0..4; valid is a range within 2..1000"):
        hall_family(rng, 1, units=(0, 4))
    with pytest.raises(ConfigError, match=r"containment 0.9..0.3; .* the lower number first"):
        hall_family(rng, 1, containment=(0.9, 0.3))
    with pytest.raises(ConfigError, match="tiny has no rack type storage, compute, gpu, gpu_dense"):
        hall_family(rng, 1, load_config("tiny"))


@pytest.fixture(scope="module")
def study() -> Any:
    path = Path(__file__).parent.parent / "benchmarks" / "hall_agents.py"
    spec = importlib.util.spec_from_file_location("hall_agents", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hall_agents"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.repo
def test_two_common_numbers_win_back_what_local_control_loses(study: Any) -> None:
    study.CASES["6"] = study.CASES["6"][1::2]
    rows = study.study(["6"], "preset", study.QUICK)
    assert [row.down for row in rows] == [(), (0,)]
    for row in rows:
        assert 0.0 <= row.excess["one speed, one setpoint"] < 1.0
        assert row.excess["local PI, sensors ±.5 K"] > 4.0
        assert (row.excess["local PI, tuned"] or 99.0) > 3.0
        assert row.excess["fixed 23 C"] is None
        assert row.best["inlet_max_c"] < 27.01
    assert study.table(rows).count("\n") == 3
    # All blow less since the others blow, so the hall is too warm.
    assert rows[0].alone["each alone, played together"] is None
    assert (rows[0].alone["one after another"] or 99.0) > 1.0


@pytest.mark.repo
def test_servers_that_draw_more_air_when_warm_make_a_cliff(study: Any) -> None:
    states = {round(state["air"], 2): state for state in study.cliff("sustaindc")}
    assert 32.0 < states[0.98]["excess_pct"] < 36.0
    assert states[0.98]["inlet_max_c"] - states[1.0]["inlet_max_c"] > 5.0
    assert abs(study.cliff("preset")[3]["excess_pct"]) < 1.5
