"""Groups of agents: one agent for each CRAC unit of a hall, and for each site of a fleet."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from pettingzoo.test import parallel_api_test, parallel_seed_test

import sdc_taichi
from sdc_taichi import Actions, ConfigError, SdcError, load_config, make_controller
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, AGENTS
from sdc_taichi.envs.site_order import cleaner_first
from sdc_taichi.envs.view_terms import OF_DATA_CENTERS, UTILISATIONS
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.transfer import task_kwh
from small_halls import DOWN, hall

# Observations have several types, of which these environments return one.
HALL_ENV: Any = sdc_taichi.hall_env
PARALLEL_ENV: Any = sdc_taichi.parallel_env
VECTOR_ENV: Any = sdc_taichi.vector_env
HALL = hall(3)
FLEET = load_config("fleet_of_eight", ["fleet.sites=[AZ, CA, WA]"])
TWICE: dict[str, Any] = {"agents": ["crac", "agent_dc"], "commands": {"agent_dc": ["fan"]}}
WRONG = {"crac": {"zone_carbon": 1.0}}
GEO: dict[str, Any] = {
    "config": FLEET,
    "agents": (*AGENTS, "agent_geo"),
    "actions": "continuous",
    "days": 1,
}


def zeros(env: Any) -> dict[str, Any]:
    return {agent: np.zeros_like(env.action_space(agent).low) for agent in env.possible_agents}


@pytest.mark.filterwarnings("ignore:reset options")
def test_agents_of_a_hall_are_a_pettingzoo_environment() -> None:
    env = HALL_ENV(HALL)
    assert env.possible_agents == ["crac_0", "crac_1", "crac_2", "plant"]
    assert env.action_space("crac_2") == env.action_space("plant") == Box(-1, 1, (1,), np.float32)
    parallel_api_test(env, num_cycles=20)
    parallel_seed_test(lambda: HALL_ENV(HALL), num_cycles=10)
    discrete = HALL_ENV(HALL, actions="discrete", agents=["crac"])
    assert discrete.possible_agents == ["crac_0", "crac_1", "crac_2"]
    assert discrete.action_space("crac_0") == Discrete(3)
    discrete.reset(seed=0)
    speed = discrete.core.view.state.fan_speed.copy()
    discrete.step({"crac_0": 0, "crac_1": 1, "crac_2": 2})
    step = HALL.hvac.crac.fan_step
    moved = discrete.core.view.state.fan_speed - speed
    assert moved == pytest.approx([-step, 0.0, min(step, 1.0 - speed[2])])


def test_an_agent_sees_its_own_unit_and_its_neighbours() -> None:
    env = HALL_ENV(HALL, neighbours=2)
    env.reset(seed=1)
    actions = zeros(env) | {"crac_0": np.array([-1.0]), "crac_1": np.array([0.5])}
    observations, *_ = env.step(actions)
    view = env.core.view
    first = {
        f.name: slice(end - f.size, end)
        for f, end in zip(
            env.core.features["crac"],
            np.cumsum([f.size for f in env.core.features["crac"]]).tolist(),
            strict=True,
        )
    }
    for unit in range(3):
        seen = observations[f"crac_{unit}"]
        assert seen[first["unit_speed"]] == pytest.approx(view.state.fan_speed[unit])
        hottest = (view.zone_hottest_c - 15) / 25
        assert seen[first["zone_hottest"]] == pytest.approx(hottest[unit], rel=1e-5)
        others = [u for u in view.nearest_units[:2, unit].tolist()]
        assert sorted([*others, unit]) == [0, 1, 2]
        pairs = [x for u in others for x in (view.state.fan_speed[u], hottest[u])]
        assert seen[first["neighbours"]] == pytest.approx(pairs, rel=1e-5)
    assert env.state().shape == env.state_space.shape
    true_c, error_k = view.zone_hottest_true_c, view.zone_hottest_c - view.zone_hottest_true_c
    assert 0.0 < np.abs(error_k).max() <= HALL.hall.sensor_error_k
    assert true_c.max() == pytest.approx(view.last.inlet_max_c[0])


def test_a_unit_that_is_down_does_not_act() -> None:
    env = HALL_ENV(hall(3, *DOWN))
    _, infos = env.reset(seed=0)
    assert [infos[f"crac_{unit}"]["acts"] for unit in range(3)] == [1, 1, 1]
    *_, infos = env.step(zeros(env))
    assert [infos[f"crac_{unit}"]["acts"] for unit in range(3)] == [1, 0, 1]
    assert "acts" not in infos["plant"]
    over_k = np.maximum(env.core.view.zone_hottest_true_c - 27.0, 0.0)
    heat_k_h = [infos[f"crac_{unit}"]["zone_heat_k_h"] for unit in range(3)]
    assert heat_k_h == pytest.approx(over_k / 12)
    state = env.state_dict()
    still, *_ = env.step(zeros(env))
    env.load_state_dict(state)
    moved, *_ = env.step(zeros(env) | {"crac_1": np.array([-1.0])})
    for agent in ("crac_0", "crac_2"):
        assert np.array_equal(still[agent], moved[agent])


def test_rewards_of_units_are_parts_of_those_of_the_hall() -> None:
    rewards = {"crac": {"zone_power": 1.0}, "plant": {"hall_power": 1.0}}
    with closing(HALL_ENV(HALL, 2, rewards=rewards, collaboration=1.0)) as env:
        env.reset(seed=0)
        speeds = np.array([[[-1.0], [0.5], [0.0]], [[0.0], [0.0], [-0.3]]])
        _, own, *_ = env.step({"crac": speeds, "plant": np.zeros((2, 1))})
    assert own["crac"].mean(axis=1) == pytest.approx(own["plant"], rel=1e-4)
    assert np.ptp(own["crac"], axis=1).min() > 1e-3
    with closing(HALL_ENV(HALL, 2, rewards=rewards, collaboration=0.4)) as env:
        env.reset(seed=0)
        _, mixed, *_ = env.step({"crac": speeds, "plant": np.zeros((2, 1))})
    with closing(HALL_ENV(HALL, 2)) as env:
        env.reset(seed=0)
        _, team, *_ = env.step({"crac": speeds, "plant": np.zeros((2, 1))})
    assert team["crac"] == pytest.approx(np.tile(team["plant"][:, None], 3), abs=1e-6)
    total = own["crac"].sum(axis=1) + own["plant"]
    by_hand = 0.4 * own["crac"] + 0.2 * (total[:, None] - own["crac"])
    assert mixed["crac"] == pytest.approx(by_hand, abs=1e-5)
    assert mixed["plant"] == pytest.approx(
        0.4 * own["plant"] + 0.2 * (total - own["plant"]), abs=1e-5
    )


def test_reward_of_a_hall_compares_with_fans_that_follow() -> None:
    """A hall whose fans follow the servers at an even load has a power reward of about 0."""
    load = f"workload.zone_loads.fixed=[{', '.join(['0.6'] * 4)}]"
    steady = ["simulation.thermal=quasi_steady", "events.sampled=[]", load]
    rewards = {"crac": {"zone_power": 1.0}, "plant": {"hall_power": 1.0}}
    follower = hall(3, *steady, "hvac.crac.flow_model=follow_servers")
    with closing(VECTOR_ENV(1, follower, agents=["plant"], rewards=rewards, days=1)) as env:
        env.reset(seed=0, options={"start_day": "04-20"})
        _, following, *_ = env.step({"plant": np.array([1])})
    with closing(HALL_ENV(hall(3, *steady), 1, rewards=rewards)) as env:
        env.reset(seed=0, options={"start_day": "04-20"})
        for _ in range(4):
            _, fast, *_ = env.step({"crac": np.full((1, 3, 1), 1.0), "plant": np.zeros((1, 1))})
    assert abs(following["plant"][0]) < 0.1
    assert fast["plant"][0] < following["plant"][0] - 0.02
    assert len(UTILISATIONS) == 6


def test_halls_with_different_numbers_of_units_share_arrays() -> None:
    both = [hall(3), hall(2)]
    with closing(HALL_ENV(both, 2, neighbours=1)) as env:
        first, _ = env.reset(seed=5)
        assert first["crac"].shape[:2] == (2, 3)
        assert env.core.masks()["crac"].tolist() == [[True] * 3, [True, True, False]]
        speeds = np.array([[[-1.0], [0.5], [0.0]], [[0.4], [-0.3], [0.9]]])
        together, rewards, *_ = env.step({"crac": speeds, "plant": np.zeros((2, 1))})
        assert not together["crac"][1, 2].any() or rewards["crac"][1, 2] == 0.0
    for i, config in enumerate(both):
        with closing(HALL_ENV(config, 1, neighbours=1)) as env:
            env.reset(seed=5 + i)
            units = config.hvac.crac.units
            alone, reward, *_ = env.step(
                {"crac": speeds[i : i + 1, :units], "plant": np.zeros((1, 1))}
            )
        assert np.array_equal(alone["crac"][0], together["crac"][i, :units])
        assert np.array_equal(reward["crac"][0], rewards["crac"][i, :units])


def test_the_plant_cools_the_water_further() -> None:
    commands = {"plant": ("cooling", "chilled_water")}
    water_c = []
    for reset in (1.0, 0.0, -1.0):
        env = HALL_ENV(HALL, commands=commands)
        env.reset(seed=0)
        env.step(zeros(env) | {"plant": np.array([0.0, reset])})
        water_c.append(env.core.view.last.chilled_water_c[0])
    assert water_c[0] == water_c[1]
    assert 1.0 < water_c[1] - water_c[2] <= 6.0 + 1e-9


def test_each_unit_can_have_a_setpoint_of_its_own() -> None:
    commands = {"crac": ("fan", "cooling")}
    env = HALL_ENV(HALL, agents=["crac"], commands=commands, setpoint_change_k=1.0)
    env.reset(seed=0)
    before = env.core.view.state.setpoint_c.copy()
    env.step({f"crac_{unit}": np.array([0.0, (unit - 1) * 0.5]) for unit in range(3)})
    assert env.core.view.state.setpoint_c - before == pytest.approx([-0.5, 0.0, 0.5])


def test_a_controller_acts_for_the_plant() -> None:
    options: dict[str, Any] = {"agents": ["crac"], "others": "cooling=coldest"}
    env = HALL_ENV(HALL, **options)
    env.reset(seed=0)
    for _ in range(12):
        env.step({f"crac_{unit}": np.array([0.0]) for unit in range(3)})
    assert env.core.view.setpoint_c[0] == HALL.hvac.setpoint.min_c


def test_state_of_a_hall_continues_to_the_bit() -> None:
    with closing(HALL_ENV(HALL, 2)) as env, closing(HALL_ENV(HALL, 2)) as new:
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        for _ in range(4):
            speeds = rng.uniform(-1, 1, (2, 3, 1))
            env.step({"crac": speeds, "plant": np.zeros((2, 1))})
        new.load_state_dict(env.state_dict())
        steps = [e.step({"crac": speeds, "plant": np.zeros((2, 1))}) for e in (env, new)]
    for name in ("crac", "plant"):
        assert np.array_equal(steps[0][0][name], steps[1][0][name])
        assert np.array_equal(steps[0][1][name], steps[1][1][name])


@pytest.mark.filterwarnings("ignore:reset options")
def test_agents_of_a_fleet_have_the_names_of_their_sites() -> None:
    env = PARALLEL_ENV(**GEO)
    assert env.possible_agents[:3] == ["AZ/agent_ls", "CA/agent_ls", "WA/agent_ls"]
    assert env.possible_agents[-1] == "WA/agent_geo"
    assert len(env.possible_agents) == 12
    assert env.action_space("AZ/agent_geo") == Box(-1, 1, (2,), np.float32)
    parallel_api_test(env, num_cycles=20)
    _, infos = env.reset(seed=0, options={"start_day": 180})
    assert {info["start_day"] for info in infos.values()} == {180}
    clocks = env.core.view.state.start - env.core.view.drivers.utc_offset_h.astype(int) * 4
    assert np.ptp(clocks) == 0


@pytest.mark.parametrize("rewards_of", ["default", {"agent_geo": {"geo_cost": 10.0}}])
def test_a_site_sends_work_to_the_cleanest_site_first(rewards_of: Any) -> None:
    env = PARALLEL_ENV(**GEO, rewards=rewards_of, collaboration=1.0)
    env.reset(seed=0, options={"start_day": 180})
    view = env.core.view
    ci = view.now.ci_g_per_kwh
    order = cleaner_first(view)
    for site in range(3):
        assert sorted(order[site]) == [s for s in range(3) if s != site]
        assert ci[order[site][0]] <= ci[order[site][1]]
    dirtiest, names = int(np.argmax(ci)), ("AZ", "CA", "WA")
    agent = f"{names[dirtiest]}/agent_geo"
    _, rewards, *_, infos = env.step(zeros(env) | {agent: np.array([0.5, -1.0])})
    flows = env.core.view.flows_tasks[0]
    assert np.flatnonzero(flows.sum(axis=0)).tolist() == [order[dirtiest][0]]
    assert infos[agent]["sent_tasks"] == flows.sum() > 0
    result, terms = env.core.view.last, env.core._rewards._context
    sizing = env.core.view.sizing
    to = order[dirtiest][0]
    coming, now, scale = terms.coming_ci, result.ci_g_per_kwh, 500.0
    if rewards_of != "default":
        coming, now, scale = terms.coming_price, result.price_per_kwh, 0.1
    moved = flows.sum() * task_kwh(env.core.sim.fleet, sizing)[0] * (coming[to] - coming[dirtiest])
    total = moved + (result.transfer_kwh * now).sum()
    design = sizing.facility_w[dirtiest] * env.core.sim.step_h / 1e3 * scale
    assert rewards[agent] == pytest.approx(-10.0 * total / design, rel=1e-6)
    assert total != 0.0
    idle = [f"{name}/agent_geo" for i, name in enumerate(names) if i != dirtiest]
    assert [rewards[name] for name in idle] == [0.0, 0.0]
    assert AGENT_DEFINITIONS["agent_geo"].scales["bill"] == {"geo_cost": 10.0, "high_power": 10.0}
    terms = ["hall_power", "hall_heat", "hot_junctions", "geo_carbon", "geo_cost"]
    assert list(OF_DATA_CENTERS) == terms


def test_agents_of_a_site_whose_links_are_down_do_not_act() -> None:
    cut = load_config(
        "fleet_of_eight",
        [
            "fleet.sites=[AZ, CA, WA]",
            "events.scheduled=[{kind: link_down, site: WA, start_h: 0, duration_h: 0.5}]",
        ],
    )
    env = PARALLEL_ENV(**(GEO | {"config": cut}))
    _, infos = env.reset(seed=0)
    assert [infos[f"{site}/agent_geo"]["acts"] for site in ("AZ", "CA", "WA")] == [1, 1, 1]
    assert "acts" not in infos["WA/agent_ls"]
    names = [f.name for f in env.core.features["agent_geo"] for _ in range(f.size)]
    rooms, link = np.array(names) == "site_room", np.array(names) == "site_link"
    for step in range(1, 4):
        observations, *_, infos = env.step(zeros(env))
        is_down = step < 3
        assert infos["WA/agent_geo"]["acts"] == 1 - is_down
        assert infos["CA/agent_geo"]["acts"] == 1
        assert (observations["WA/agent_geo"][link] == 0) == is_down
        # WA has the cleanest grid.
        seen = observations["AZ/agent_geo"]
        assert (seen[rooms] == 0).tolist() == [is_down, False]
        assert seen[link] > 0
        view = env.core.view
        for rule in ("geo-all-to-cleanest", "geo-three-cleanest", "geo-all-cleaner", "geo-central"):
            transfer = make_controller(rule, view.fleet).act(view).transfer
            assert transfer is not None
            assert bool(transfer[:, 2].any()) == (not is_down)
            assert not transfer[2].any()
            assert transfer.any()


def test_commands_of_controllers_are_actions_of_sites() -> None:
    with closing(VECTOR_ENV(2, **GEO)) as env:
        env.reset(seed=0)
        shares = np.random.default_rng(0).uniform(0, 0.3, (6, 3))
        shares[np.arange(6), np.arange(6) % 3] = 0.0
        actions = env.core.actions_of(Actions(transfer=shares))
        assert actions["agent_geo"].shape == (2, 3, 2)
        env.step(actions)
        last = env.core._last
        assert last is not None
        assert last[1]["transfer"] == pytest.approx(shares)
        joint = env.core.view.last
        assert joint is not None
        assert joint.sent_tasks.min() > 0


def test_a_fleet_alone_equals_itself_in_a_batch() -> None:
    with (
        closing(VECTOR_ENV(2, **GEO)) as both,
        closing(VECTOR_ENV(1, **GEO)) as one,
    ):
        both.reset(seed=3)
        one.reset(seed=4)
        rng = np.random.default_rng(0)
        for _ in range(3):
            actions = {
                group: rng.uniform(-1, 1, (2, 3, *both.action_spaces[group].shape))
                for group in both.agents
            }
            of_both = both.step(actions)
            alone = one.step({group: values[1:] for group, values in actions.items()})
        for i in (0, 1):
            for group in both.agents:
                assert np.array_equal(of_both[i][group][1], alone[i][group][0])
        assert np.array_equal(both.state()[1], one.state()[0])
        one.load_state_dict(one.state_dict())
        assert np.array_equal(both.state()[1], one.state()[0])


def test_joint_reward_of_a_fleet_is_the_mean_of_its_sites() -> None:
    with closing(VECTOR_ENV(2, **GEO, rewards="paper", collaboration=1.0)) as env:
        env.reset(seed=0)
        transition = env.core.step(env.core.idle_actions())
        sums = sum(reward.sum(axis=1) for reward in transition.rewards.values())
        assert transition.joint_reward == pytest.approx(sums / 3)
        assert transition.terminated.shape == (2,)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PARALLEL_ENV(agents=["agent_geo"]), "agent_geo needs a fleet"),
        (lambda: HALL_ENV(FLEET), "crac, plant in a fleet"),
        (lambda: HALL_ENV("corrected"), "hvac.crac.flow_model=controlled"),
        (lambda: HALL_ENV(HALL, **TWICE), "fan is decided by agent_dc and crac"),
        (lambda: HALL_ENV(HALL, rewards="bill"), "rewards 'bill': crac has none"),
        (lambda: HALL_ENV(HALL, rewards=WRONG), "unknown term 'zone_carbon'"),
        (lambda: HALL_ENV(HALL, neighbours=9), "neighbours"),
        (lambda: PARALLEL_ENV(neighbours=1), "crac does not learn"),
        (lambda: PARALLEL_ENV(FLEET, heat_map=True), "heat_map True: in a fleet"),
        (lambda: build_fleet(load_config("hall_agents_6", ["hvac.crac.units=0"])), "units"),
    ],
)  # fmt: skip
def test_what_groups_refuse(make: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message.replace("[", r"\[")):
        make()


def test_missing_actions_of_a_unit_are_named() -> None:
    env = HALL_ENV(HALL)
    env.reset(seed=0)
    actions = zeros(env)
    del actions["crac_1"]
    with pytest.raises(SdcError, match="none for crac_1"):
        env.step(actions)
    with pytest.raises(SdcError, match="crac_9"):
        env.step(zeros(env) | {"crac_9": np.zeros(1)})


def test_every_episode_has_halls_of_its_own() -> None:
    few = {"row_pairs": (1, 1), "racks_per_row": (4, 8)}
    family = sdc_taichi.HallFamily(units=(2, 4), ranges=few)
    with closing(HALL_ENV(family, 3)) as env:
        counts = []
        for seed in (0, 1, 2):
            first, _ = env.reset(seed=seed)
            counts.append(env.core.masks()["crac"].sum(axis=1).tolist())
            assert first["crac"].shape[:2] == (3, 4)
        assert len({tuple(c) for c in counts}) > 1
        # Environment i has the seed of the batch plus i.
        assert counts[0][1:] == counts[1][:2]
        still = {"crac": np.zeros((3, 4, 1)), "plant": np.zeros((3, 1))}
        env.step(still)
        state, (expected, *_) = env.state_dict(), env.step(still)
    with closing(HALL_ENV(family, 3)) as env:
        env.load_state_dict(state)
        continued, *_ = env.step(still)
    assert all(np.array_equal(continued[group], expected[group]) for group in expected)
    env = HALL_ENV(lambda rng: hall(int(rng.integers(2, 5))))
    with closing(env), pytest.raises(ConfigError, match="most_units"):
        any(env.reset(seed=seed) is None for seed in range(9))
    with closing(HALL_ENV(HALL, 3)) as env, pytest.raises(SdcError, match="another fleet"):
        env.load_state_dict(state)
