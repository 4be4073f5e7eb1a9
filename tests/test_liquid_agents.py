"""Agents and controllers of halls with liquid-cooled racks."""

from __future__ import annotations

import itertools
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

import sdc_taichi
from policies import policy
from sdc_taichi import Actions, ConfigError, load_config, make_controller
from sdc_taichi.control import commands_of
from sdc_taichi.control.mpc import _loop_commands
from sdc_taichi.control.plans import EnergyCost, QueuePlan, Weather
from sdc_taichi.envs.agents import TEAM_OF_LIQUID
from sdc_taichi.envs.options import make_options
from sdc_taichi.learning.interface import interface_of
from sdc_taichi.optimum import solve
from sdc_taichi.optimum.loop_map import LOOP_COMMANDS, LoopCommands
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.optimum.problem import AGENTS, ALL_AGENTS
from sdc_taichi.run.achievable import AchievedPath, run_beside
from sdc_taichi.run.loop import simulate
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.step_inputs import LIQUID_COMMANDS
from sdc_taichi.types import F64

HALL_ENV: Any = sdc_taichi.hall_env
VECTOR_ENV: Any = sdc_taichi.vector_env
SMALL = [
    *("hall.rows=2", "hall.racks_per_row=6", "hvac.crac.units=3"),
    "hall.rack_types.ai={model: gb200_nvl72, liquid: {gpu_idle_w: 500}}",
    "hall.rack_types.web={servers: {count: 18, full_w: 600, idle_w: 170}}",
    "hall.rack_plan=[{type: ai, racks: 0-3},{type: web, racks: 4-5}]",
]


def hall(*more: str, manifolds: int = 2, base: str = "hall_of_2026") -> Any:
    """Return a hall of eight racks with 72 GPUs each and four racks in air."""
    reuse = "{kind: direct, share: 0.2, network_return_c: 20, price_per_kwh_heat: 0.05}"
    liquid = f"liquid={{cdus: {{manifolds: {manifolds}}}, reuse: {reuse}}}"
    return load_config(base, [*SMALL, liquid, *more])


HALL = hall()
DOWN = hall("events.scheduled=[{kind: cdu_down, start_h: 0, duration_h: 1, unit: 1}]")


def zeros(env: Any) -> dict[str, Any]:
    return {agent: np.zeros_like(env.action_space(agent).low) for agent in env.possible_agents}


def observed(env: Any, observation: Any, group: str) -> dict[str, Any]:
    """Return the entries of an observation by feature."""
    features = env.core.features[group]
    ends = np.cumsum([f.size for f in features]).tolist()
    return {f.name: observation[end - f.size : end] for f, end in zip(features, ends, strict=True)}


@pytest.mark.filterwarnings("ignore:reset options")
def test_agents_of_liquid_cooling_are_environments() -> None:
    env = HALL_ENV(HALL)
    assert env.possible_agents == ["plant", "cdu_0", "cdu_1", "cdu_2", "cdu_3", "power_cap"]
    assert [env.action_space(a).shape for a in ("plant", "cdu_3", "power_cap")] == [
        (2,),
        (2,),
        (1,),
    ]
    parallel_api_test(env, num_cycles=20)
    parallel_seed_test(lambda: HALL_ENV(HALL), num_cycles=10)
    options: dict[str, Any] = {"agents": ["agent_bat", "cdu"], "config": HALL, "days": 1}
    check_env(gymnasium.make("sdc_taichi/Joint-v0", **options).unwrapped, skip_render_check=True)


def test_actions_are_commands_and_commands_actions() -> None:
    env = HALL_ENV(HALL)
    env.reset(seed=0)
    before = env.core.view.state
    actions = zeros(env) | {
        "cdu_0": np.array([-1.0, -1.0]),
        "cdu_2": np.array([0.5, 1.0]),
        "plant": np.array([0.5, 0.5]),
        "power_cap": np.array([-0.5]),
    }
    env.step(actions)
    commands, state = env.core._last[1], env.core.view.state
    assert commands["facility_approach_k"] == pytest.approx([4.0 + 0.5 * 11.0])
    assert commands["reuse_share"] == pytest.approx([0.2 + 0.5 * 0.8])
    assert commands["power_cap"] == pytest.approx([0.75])
    assert state.cdu_setpoint_c - before.cdu_setpoint_c == pytest.approx([-2.0, 0.0, 1.0, 0.0])
    assert state.cdu_flow - before.cdu_flow == pytest.approx([-0.1, 0.0, 0.1, 0.0])
    env.reset(seed=0)
    again = env.core.actions_of(Actions(**commands))
    assert again["cdu"][0] == pytest.approx(np.array([actions[f"cdu_{i}"] for i in range(4)]))
    assert again["plant"][0] == pytest.approx(actions["plant"])
    assert again["power_cap"][0] == pytest.approx(actions["power_cap"])
    assert not any(env.core.actions_of(Actions())[group].any() for group in env.core.agents)
    # No action at all is the same as the neutral one, to the bit.
    with Simulator(HALL, limits="flag") as sim:
        sim.reset(0)
        held = sim.step(Actions())
        sim.reset(0)
        neutral = sim.step(
            Actions(facility_approach_k=4.0, reuse_share=0.2, power_cap=1.0, cdu_flow=1.0)
        )
    assert np.array_equal(held.cooler_fan_w, neutral.cooler_fan_w)
    assert np.array_equal(held.reuse_w, neutral.reuse_w)


def test_an_agent_sees_its_own_loop() -> None:
    env = HALL_ENV(HALL)
    env.reset(seed=1)
    for _ in range(3):
        observations, *_ = env.step(zeros(env) | {"cdu_3": np.array([-1.0, -1.0])})
    view, result = env.core.view, env.core.view.last
    junction_c = result.rack_junction_c[[0, 1, 2, 3, 6, 7, 8, 9]].reshape(2, 4).max(axis=1)
    for unit in range(4):
        seen = observed(env, observations[f"cdu_{unit}"], "cdu")
        assert seen["cdu_supply"] == pytest.approx((result.cdu_supply_each_c[unit] - 15) / 55, 1e-5)
        assert seen["cdu_junction"] == pytest.approx((junction_c[unit // 2] - 20) / 90, 1e-5)
        assert seen["cdu_headroom"] == pytest.approx((85 - junction_c[unit // 2]) / 50, 1e-5)
        heat_w = result.cdu_flow_m3s[unit] * 1015 * 3900
        return_c = result.cdu_supply_each_c[unit] + result.cdu_heat_w[unit] / heat_w
        assert seen["cdu_return"] == pytest.approx((return_c - 15) / 75, 1e-5)
    flow = result.cdu_flow_m3s
    assert view.cdu_return_c @ flow / flow.sum() == pytest.approx(result.cdu_return_c[0], abs=0.2)
    seen = observed(env, observations["plant"], "plant")
    assert seen["heat_price"] == pytest.approx(0.05 / 0.2)
    assert seen["junction_headroom"] == pytest.approx((85 - junction_c.max()) / 50, 1e-5)
    assert env.state().shape == env.state_space.shape


def test_a_cdu_that_is_down_does_not_act() -> None:
    env = HALL_ENV(DOWN)
    _, infos = env.reset(seed=0)
    assert [infos[f"cdu_{unit}"]["acts"] for unit in range(4)] == [1, 1, 1, 1]
    *_, infos = env.step(zeros(env))
    assert [infos[f"cdu_{unit}"]["acts"] for unit in range(4)] == [1, 0, 1, 1]
    state = env.state_dict()
    _, still, *_ = env.step(zeros(env))
    env.load_state_dict(state)
    _, moved, *_ = env.step(zeros(env) | {"cdu_1": np.array([-1.0, -1.0])})
    assert still == moved


def test_agents_share_one_reward() -> None:
    results = {}
    for rewards in ("default", "bill"):
        with closing(HALL_ENV(HALL, 2, rewards=rewards)) as env:
            env.reset(seed=0)
            actions = env.core.idle_actions() | {"power_cap": np.array([[-1.0], [0.0]])}
            _, values, *_ = env.step(actions)
            terms, view = env.core.reward_terms(), env.core.view
            terms["hot_junctions"] = -np.maximum(5.0 - view.junction_headroom_k, 0.0)
            expected = sum(x * terms[name] for name, x in TEAM_OF_LIQUID[rewards].items())
            assert values["plant"] == pytest.approx(expected, rel=1e-5)
            assert values["power_cap"] == pytest.approx(expected, rel=1e-5)
            assert values["cdu"] == pytest.approx(np.tile(values["plant"][:, None], 4))
            results[rewards] = view.last, terms
    result, terms = results["bill"]
    assert result.throttled_tasks[0] > result.throttled_tasks[1] == 0.0
    assert terms["throttled_work"] == pytest.approx(-result.throttled_tasks / 100.0)
    assert (terms["heat_sales"] > 0.0).all()
    scales = {"cdu": {"carbon": 1.0}, "power_cap": {"throttled_work": 1.0}}
    options: dict[str, Any] = {"agents": ["cdu", "power_cap"], "actions": "continuous", "days": 1}
    with closing(VECTOR_ENV(1, HALL, rewards=scales, collaboration=0.4, **options)) as env:
        env.reset(seed=0)
        _, values, *_ = env.step(env.core.idle_actions() | {"power_cap": np.array([[-1.0]])})
        terms = env.core.reward_terms()
    own, cap = terms["carbon"][0], terms["throttled_work"][0]
    assert values["cdu"] == pytest.approx(np.full((1, 4), 0.4 * own + 0.15 * (3 * own + cap)))
    assert values["power_cap"] == pytest.approx([0.4 * cap + 0.15 * 4 * own])


@pytest.mark.filterwarnings("ignore::sdc_taichi.errors.OddInputWarning")
def test_costs_of_liquid_cooling() -> None:
    costs = ["junction_headroom", "throttled_work", "dew_point"]
    with closing(
        HALL_ENV(hall("liquid.setpoint_c=20", "liquid.dew_point_c=19"), 1, costs=costs)
    ) as env:
        env.reset(seed=0)
        *_, infos = env.step(env.core.idle_actions() | {"power_cap": np.array([[-1.0]])})
    assert infos["cost_dew_point"] == pytest.approx([0.25 * 1.0])
    assert infos["cost_throttled_work"] == infos["throttled_tasks"] > 0.0
    assert infos["cost_junction_headroom"] == [0.0]


def test_data_centers_with_different_numbers_of_cdus_share_arrays() -> None:
    both = [hall(), hall(manifolds=1)]
    rng = np.random.default_rng(0)
    drawn = {"cdu": rng.uniform(-1, 1, (2, 4, 2)), "plant": rng.uniform(-1, 1, (2, 2))}
    drawn["power_cap"] = rng.uniform(-1, 1, (2, 1))
    with closing(HALL_ENV(both, 2)) as env, closing(HALL_ENV(both, 2)) as new:
        env.reset(seed=5)
        assert env.core.masks()["cdu"].tolist() == [[True] * 4, [True, True, False, False]]
        together = env.step(drawn)
        new.load_state_dict(env.state_dict())
        continued = [e.step(drawn) for e in (env, new)]
    for group in drawn:
        for part in (0, 1):
            assert np.array_equal(continued[0][part][group], continued[1][part][group])
    for i, config in enumerate(both):
        with closing(HALL_ENV(config, 1)) as env:
            env.reset(seed=5 + i)
            cdus = env.core.sim.fleet.cdus
            own = {group: values[i : i + 1] for group, values in drawn.items()}
            alone = env.step(own | {"cdu": own["cdu"][:, :cdus]})
        for part in (0, 1):
            assert np.array_equal(alone[part]["cdu"][0], together[part]["cdu"][i, :cdus])
            assert np.array_equal(alone[part]["plant"][0], together[part]["plant"][i])


def test_a_subset_learns_and_controllers_do_the_rest() -> None:
    options: dict[str, Any] = {
        "others": "liquid=liquid-reset,cooling=coldest",
        "actions": "continuous",
        "days": 1,
    }
    env: Any = sdc_taichi.parallel_env(
        HALL, agents=["cdu"], commands={"cdu": ["cdu_flow"]}, **options
    )
    env.reset(seed=0)
    assert env.action_space("cdu_0").shape == (1,)
    for _ in range(12):
        env.step(zeros(env))
    assert env.core.view.setpoint_c[0] == HALL.hvac.setpoint.min_c
    # The group decides its flow alone, so that its setpoints are held.
    assert (env.core.view.state.cdu_setpoint_c == 40.0).all()
    env = sdc_taichi.parallel_env(HALL, agents=["power_cap"], **options)
    env.reset(seed=0)
    for _ in range(3):
        env.step(zeros(env))
    assert (env.core.view.state.cdu_setpoint_c != 40.0).all()


def test_a_policy_of_all_cdus_controls_halls_with_other_numbers(tmp_path: Path) -> None:
    commands = {"plant": ("facility_approach_k", "reuse_share")}
    agents = ("plant", "cdu", "power_cap")
    options = make_options(agents=agents, actions="continuous", commands=commands)
    policy(interface_of(build_fleet(HALL), options)).save(tmp_path)
    with Simulator(hall(manifolds=1)) as sim:
        controller = make_controller(f"liquid=policy:{tmp_path}", sim.fleet)
        assert set(commands_of(controller)) == set(LIQUID_COMMANDS)
        sim.reset(0)
        view = sdc_taichi.control.view_maker(sim)(None)
        controller.reset(0)
        flow: Any = controller.act(view).cdu_flow
        assert flow.shape == (2,)
    assert interface_of(build_fleet(HALL), options, ("cdu",)).policies_of("cdu")[3:] == ("cdu_3",)


def test_rules_command_by_wet_bulb_and_by_headroom() -> None:
    with Simulator(HALL) as sim:
        sim.reset(0)
        view_after = sdc_taichi.control.view_maker(sim)
        rule, reset = (make_controller(f"liquid-{n}", sim.fleet) for n in ("wet-bulb", "reset"))
        view = view_after(None)
        wet_c = view.now.wet_bulb_c[0]
        given = rule.act(view)
        assert given.cdu_setpoint_c == pytest.approx(np.clip([wet_c + 9.56], 20.0, 45.0))
        assert reset.act(view).cdu_setpoint_c == pytest.approx(np.full(4, 40.0))
        view = view_after(sim.step())
        headroom_k = view.cdu_headroom_k
        change_k = np.where(headroom_k < 10.0, (headroom_k - 10.0) / 2.0, 0.2)
        assert reset.act(view).cdu_setpoint_c == pytest.approx(40.0 + change_k)


def test_no_steady_commands_beat_those_of_the_tables() -> None:
    """Simulated brute force over setpoints, flows and facility water, in cold and warm weather."""
    grid = list(itertools.product((20, 26, 32, 38, 44), (0.4, 0.6, 0.8, 1.0), (2.0, 4.0, 8.0)))
    for start_day in ("01-15", "07-20"):
        base = hall(f"site.start={start_day}", "workload.flexible_share=0")
        fleet = build_fleet(base)
        with Simulator(base) as sim:
            sim.reset(0)
            best = LoopCommands(fleet, sim.drivers)
            now = sim.drivers.at(0)
            setpoint_c, flow, approach_k = best.at(now.outdoor_c, now.wet_bulb_c, now.demand)[:, 0]
        tried = [*grid, (setpoint_c, flow, approach_k)]
        copies = [
            hall(f"site.start={start_day}", f"liquid.setpoint_c={s}", f"liquid.flow={f}")
            for s, f, _ in tried
        ]
        with Simulator(copies, precision="f64") as sim:
            sim.reset(0)
            result = sim.step(Actions(facility_approach_k=np.array([a for *_, a in tried])))
        kwh = np.where(result.throttled_tasks > 0.0, np.inf, result.facility_kwh)
        assert kwh[-1] < kwh[:-1].min() * (1.0 + 1e-4)
        assert np.ptp(kwh[np.isfinite(kwh)]) > 0.005 * kwh[-1]


def test_no_run_beats_the_optimum_of_coolant_loops() -> None:
    """Random commands of the loops, and all of load, setpoint, battery and loops together."""
    config = hall("site.start=07-20")
    loops, joint = (
        solve(config, steps=24, objective="energy", agents=agents, cache=False)
        for agents in (("liquid",), None)
    )
    assert joint.agents == ALL_AGENTS
    assert loops.bound_kinds == joint.bound_kinds == ("bound",)
    assert loops.bound[0] <= loops.achieved[0] < 0.995 * loops.idle[0]
    assert joint.bound[0] <= joint.achieved[0] <= min(joint.alone.values())[0]
    assert joint.alone["liquid"] == loops.achieved
    rng = np.random.default_rng(0)
    with Simulator([config] * 16, precision="f64") as sim:
        sim.reset(0)
        score = Score(Objective.parse("energy"), sim)
        lost = np.zeros(16)
        goals = rng.uniform([[24.0], [0.4], [2.0]], [[45.0], [1.1], [8.0]], (3, 16))
        for _ in range(24):
            setpoint_c, flow, approach_k = goals
            result = sim.step(
                Actions(
                    cdu_setpoint_c=setpoint_c,
                    cdu_flow=np.repeat(flow, 4),
                    facility_approach_k=approach_k,
                )
            )
            score.add(result)
            lost += result.throttled_tasks
    assert score.figure[lost == 0.0].min() > loops.bound[0]
    with Simulator(config) as sim:
        reached = run_beside(joint, sim, AchievedPath(joint), "optimum")
        assert reached is not None
        np.testing.assert_allclose(reached.figure, joint.achieved, rtol=1e-9)
        assert not any(reached.broken)


def test_optima_that_hold_or_cannot_bound_coolant_loops() -> None:
    """Held loops have a bound of their own; drawn failures are in the simulated path."""
    held = solve(hall(), steps=8, objective="energy", agents=("cooling",), cache=False)
    assert np.isnan(held.loops).all()
    assert held.bound_kinds == ("bound",)
    drawn = "events.sampled=[{kind: cdu_down, per_year: 4000, duration_h: [1, 2]}]"
    first, second = (
        solve(hall(drawn), steps=8, seed=seed, objective="energy", agents=("liquid",), cache=False)
        for seed in (0, 1)
    )
    assert first.bound_kinds[0].startswith("none: sampled events")
    assert first.idle != second.idle
    water = solve(hall(), steps=4, objective="water", agents=("liquid",), cache=False)
    assert "not of least water" in water.bound_kinds[0]
    with pytest.raises(ConfigError, match="valid is one or more of load, cooling, battery, each"):
        solve(load_config("tiny"), steps=4, agents=("liquid",), cache=False)


def test_plans_move_setpoints_before_the_load_does() -> None:
    """The best setpoint rises from 30 to 38 C, and setpoints move by 2 K a step."""

    class Tables:
        def of(self, dc: int) -> Tables:
            return self

        def at(self, outdoor_c: F64, wet_bulb_c: F64, utilisation: F64) -> F64:
            return np.array([30.0 + 8.0 * utilisation, 0.6 + 0.0 * outdoor_c, 4.0 + utilisation])

    fleet = build_fleet(hall(manifolds=1))
    state = SimpleNamespace(cdu_setpoint_c=np.full(fleet.cdus, 30.0))
    view: Any = SimpleNamespace(fleet=fleet, size=1, state=state)

    def setpoint_c(*load: float) -> float:
        steps = np.zeros((1, len(load)))
        work = QueuePlan(np.zeros(1), 100.0 * np.array([load]), steps)
        cost = EnergyCost(steps + 1.0, np.zeros(1), np.zeros(1))
        given = _loop_commands(view, cast("Any", Tables()), Weather(steps, steps), work, cost)
        assert given["cdu_flow"] == pytest.approx(0.6)
        assert given["facility_approach_k"] == pytest.approx(4.0 + load[0])
        return float(given["cdu_setpoint_c"][0])

    # Squared distances: 2^2 + 4^2 + 2^2 with a first step of 2 K, 0 + 6^2 + 4^2 + 2^2 without.
    assert setpoint_c(0.0, 1.0, 1.0) == pytest.approx(32.0)
    assert setpoint_c(0.0, 0.0, 0.0, 0.1) == 30.0
    assert setpoint_c(0.2, 0.3, 0.2, 0.1) == pytest.approx(31.6)


def test_predictive_control_saves_with_coolant_loops() -> None:
    config = hall("site.start=07-20")
    figures = {}
    for name in ("liquid=liquid-greedy", "liquid=mpc-24h", "mpc-24h:energy"):
        with Simulator(config) as sim:
            controller = make_controller(name, sim.fleet)
            sim.reset(0)
            score = Score(Objective.parse("energy"), sim)
            simulate(sim, controller, 48, 0, on_step=score.add)
            figures[name] = float(score.figure[0])
            commands = {*LOOP_COMMANDS, *(AGENTS if name.startswith("mpc") else ())}
            assert set(commands_of(controller)) == commands
    greedy, loops, joint = figures.values()
    assert loops < greedy * 1.0001
    assert joint < greedy


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HALL_ENV("hall_agents_6", agents=["cdu"]), "needs liquid-cooled racks"),
        (lambda: HALL_ENV(HALL, rewards="paper"), "rewards 'paper'"),
        (lambda: HALL_ENV(HALL, rewards={"cdu": {"zone_heat": 1.0}}), "unknown term 'zone_heat'"),
        (lambda: HALL_ENV("hall_agents_6", costs=["dew_point"]), "dew_point needs liquid"),
        (lambda: HALL_ENV(HALL, others="liquid=g36"), "'g36': does not act on liquid"),
        (lambda: HALL_ENV("hall_agents_6", others="liquid=liquid-reset"), "no liquid-cooled racks"),
        (lambda: HALL_ENV("fleet_of_eight", agents=["power_cap"]), "power_cap in a fleet"),
    ],
)  # fmt: skip
def test_what_agents_of_liquid_cooling_refuse(make: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()
