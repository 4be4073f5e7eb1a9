"""Fan speed and placement as actions of environments, beside what agents decide by default."""

from __future__ import annotations

import re
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, MultiDiscrete
from gymnasium.utils.env_checker import check_env

import random_actions
import sdc_taichi
from sdc_taichi import Actions, ConfigError, View, load_config
from sdc_taichi.envs.actions import PLACEMENT_FACTOR
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.types import I64

CONTROLLED = load_config(
    "corrected",
    ["hvac.crac.units=2", "hvac.crac.flow_model=controlled", "workload.placement=weights"],
)
RACKS = CONTROLLED.hall.racks
ALL: dict[str, Any] = {
    "config": CONTROLLED,
    "days": 1,
    "commands": {"agent_ls": ["load", "placement"], "agent_dc": ["fan", "cooling"]},
}


def fan_speed(env: Any) -> list[float]:
    return [round(x, 9) for x in env.core.view.state.fan_speed]


def test_discrete_fan_and_placement() -> None:
    env = sdc_taichi.parallel_env(**ALL)
    assert env.action_space("agent_ls") == MultiDiscrete([3] * (1 + RACKS))
    assert env.action_space("agent_dc") == MultiDiscrete([3] * 4)
    env.reset(seed=0)
    before = env.core.view.state.setpoint_c.copy()
    first = {"agent_ls": [1, 0] + [1] * (RACKS - 2) + [2], "agent_dc": [0, 1, 1, 2], "agent_bat": 1}
    env.step(first)
    step = CONTROLLED.hvac.crac.fan_step
    assert fan_speed(env) == [1 - step, 1.0]
    moved = env.core.view.state.setpoint_c - before
    assert moved.tolist() == [0.0, CONTROLLED.hvac.setpoint.step_k]
    last = env.core._last
    assert last is not None
    assert last[1]["placement"].tolist() == [0.1] + [1.0] * (RACKS - 2) + [10.0]
    result = env.core.view.last
    assert result is not None
    env.step({"agent_ls": [1] * (1 + RACKS), "agent_dc": [1] * 4, "agent_bat": 1})
    even = env.core.view.last
    assert even is not None
    assert result.rack_cpu_w[0] < even.rack_cpu_w[0]
    assert result.rack_cpu_w[-1] > even.rack_cpu_w[-1]


def test_continuous_fan_and_placement_are_scaled() -> None:
    env = sdc_taichi.parallel_env(**ALL, actions="continuous", fan_change=0.3)
    assert env.action_space("agent_dc") == Box(-1.0, 1.0, (4,), dtype=np.float32)
    assert env.action_space("agent_ls") == Box(-1.0, 1.0, (1 + RACKS,), dtype=np.float32)
    env.reset(seed=0)
    placement = np.linspace(-1, 1, RACKS)
    env.step(
        {
            "agent_ls": np.concatenate([[0.0], placement]),
            "agent_dc": np.array([-1.0, -0.5, 0.0, 0.0]),
            "agent_bat": [0.0],
        }
    )
    assert fan_speed(env) == [0.7, 0.85]
    commands = env.core._last[1]  # type: ignore[index]
    np.testing.assert_allclose(commands["placement"], PLACEMENT_FACTOR**placement)
    assert commands["placement"][0] == pytest.approx(0.1)


def test_neutral_actions_are_those_without_the_commands() -> None:
    plain = sdc_taichi.parallel_env(CONTROLLED, days=1)
    env = sdc_taichi.parallel_env(**ALL)
    plain.reset(seed=0)
    env.reset(seed=0)
    for _ in range(5):
        a = plain.step({"agent_ls": 1, "agent_dc": [1, 1], "agent_bat": 1})
        b = env.step({"agent_ls": [1] * (1 + RACKS), "agent_dc": [1] * 4, "agent_bat": 1})
    assert a[1] == pytest.approx(b[1], rel=1e-12)


def test_agents_see_what_they_act_on() -> None:
    env: Any = sdc_taichi.parallel_env(**ALL)
    observed, _ = env.reset(seed=0)
    plain: Any = sdc_taichi.parallel_env(CONTROLLED, days=1)
    for agent, more in (("agent_ls", RACKS), ("agent_dc", 2), ("agent_bat", 0)):
        width = plain.observation_space(agent).shape[0]
        assert observed[agent].shape == env.observation_space(agent).shape == (width + more,)
    assert env.state_space.shape[0] == plain.state_space.shape[0] + 2 + RACKS
    actions = {"agent_ls": [1] + [0, 2] * (RACKS // 2), "agent_dc": [0] * 4, "agent_bat": 1}
    for _ in range(3):
        observed = env.step(actions)[0]
    last = env.core.view.last
    assert last is not None
    expected = np.clip((last.rack_inlet_max_c - 10) / 40, 0, 1)
    np.testing.assert_allclose(observed["agent_ls"][-RACKS:], expected, rtol=1e-6)
    np.testing.assert_allclose(observed["agent_dc"][-2:], fan_speed(env), rtol=1e-6)
    np.testing.assert_array_equal(env.state()[-RACKS:], observed["agent_ls"][-RACKS:])
    chosen = sdc_taichi.parallel_env(**ALL, features={"agent_dc": ["fan_speed", "rack_inlets"]})
    assert chosen.observation_space("agent_dc").shape == (2 + RACKS,)


@pytest.mark.parametrize("mode", ["discrete", "continuous"])
def test_every_kind_of_environment_takes_them(mode: str) -> None:
    options: dict[str, Any] = {**ALL, "actions": mode}
    batch: Any = gymnasium.make_vec("sdc_taichi/Joint-v0", num_envs=2, **options)
    multi = sdc_taichi.vector_env(2, **options)
    single: Any = gymnasium.make("sdc_taichi/Joint-v0", **options)
    check_env(single.unwrapped, skip_render_check=True)
    batch.action_space.seed(1)
    batch.reset(seed=4), multi.reset(seed=4), single.reset(seed=5)
    for _ in range(4):
        action = batch.action_space.sample()
        parts = np.split(action, [1 + RACKS, 5 + RACKS], axis=1)
        if mode == "discrete":
            parts[2] = parts[2][:, 0]
        of_batch = batch.step(action)
        of_multi = multi.step(dict(zip(AGENTS, parts, strict=True)))
        of_single = single.step(action[1])
    assert np.array_equal(of_batch[0][1], of_single[0])
    assert of_batch[4]["grid_kwh"].tolist() == of_multi[4]["grid_kwh"].tolist()
    assert of_batch[4]["grid_kwh"][1] == of_single[4]["grid_kwh"]


def test_one_learner_of_fans_alone_beside_rules() -> None:
    env: Any = gymnasium.make(
        "sdc_taichi/Cooling-v0",
        config=CONTROLLED,
        days=1,
        commands={"agent_dc": ["fan", "placement"]},
        others="battery=greedy-ci",
    )
    assert env.action_space == MultiDiscrete([3] * (2 + RACKS))
    env.reset(seed=0)
    core = env.unwrapped.core
    before = core.view.state.setpoint_c.copy()
    env.step(np.zeros(2 + RACKS, dtype=int))
    assert np.array_equal(core.view.state.setpoint_c, before)
    assert all(speed < 1 for speed in fan_speed(env.unwrapped))


CONTINUOUS: dict[str, Any] = {"actions": "continuous"}


@pytest.mark.parametrize(
    ("commands", "options", "message"),
    [
        ({"agent_dx": ["fan"]}, {}, "unknown agent 'agent_dx'; did you mean"),
        ({"agent_dc": ["fans"]}, {}, "agent_dc: 'fans'; did you mean 'fan'?"),
        ({"agent_bat": ["fan"]}, {}, "agent_bat: 'fan'; valid: battery"),
        ({"agent_dc": []}, {}, "agent_dc: []; valid is one or more, each once"),
        ({"agent_dc": ["fan", "fan"]}, {}, "valid is one or more, each once"),
        (
            {"agent_ls": ["placement"], "agent_dc": ["placement"]},
            {},
            "placement is decided by agent_ls and agent_dc; valid is one",
        ),
        ({"agent_dc": ["fan"]}, {"config": "corrected"}, "fan needs hvac.crac.flow_model=control"),
        (
            {"agent_ls": ["placement"]},
            {"config": "corrected"},
            "commands: placement needs workload.placement=weights; it is uniform",
        ),
        (ALL["commands"], {"agents": ["agent_bat"]}, "commands: without effect for agent_"),
        (ALL["commands"], {"fan_change": 0.1}, "fan_change: without effect with actions discrete"),
        (None, {**CONTINUOUS, "fan_change": 0.1}, "without effect without the command fan"),
        (
            {"agent_dc": ["fan"]},
            {**CONTINUOUS, "setpoint_change_k": 1},
            "without effect without the command cooling",
        ),
    ],
)
def test_commands_that_are_not_valid(commands: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        sdc_taichi.parallel_env(**{"config": CONTROLLED, **options, "commands": commands})


def test_placement_needs_halls_of_as_many_racks() -> None:
    large = load_config("corrected", ["workload.placement=weights"])
    small = load_config(
        "corrected",
        [
            "workload.placement=weights",
            "hall.rows=2",
            "hall.racks_per_row=2",
            "hall.supply_approach_k=5",
            "hall.return_approach_k=-3",
            "servers.power_w=[300, 40]",
        ],
    )
    with pytest.raises(ConfigError, match=r"same number of racks; it is \[20, 4\]"):
        sdc_taichi.vector_env(config=[large, small], commands={"agent_ls": ["placement"]})


@pytest.mark.parametrize(
    ("preset", "kind"),
    [
        (preset, kind)
        for preset, kind in random_actions.cases()
        # Halls of the other presets differ from these in size.
        if preset in ("sustaindc", "corrected", "hall_of_2026", "ai_hall_2026", "hall_agents_6")
        or kind == "sites"
    ],
)
def test_random_actions_of_every_kind_stop_no_batch(preset: str, kind: str) -> None:
    envs, steps = (2, 20) if preset in ("fleet_of_eight", "hall_agents_6") else (16, 30)
    ended = random_actions.play(preset, kind, envs, steps)
    assert ended["length"] == 0


class ColdWater:
    """Commands chilled water of 6 C, but leaves it to the setpoints in the first step."""

    commands = ("chilled_water",)

    def reset(self, seed: int | I64) -> None:
        """Begin an episode."""

    def act(self, view: View) -> Actions:
        return Actions(chilled_water=None if view.last is None else 6.0)


def test_a_controller_commands_chilled_water_and_its_state_is_saved() -> None:
    actions = {"agent_bat": np.zeros(2, dtype=np.int64)}
    with closing(
        sdc_taichi.vector_env(2, config="tiny", agents=["agent_bat"], others=ColdWater())
    ) as env:
        env.reset(seed=1)
        for water_c in (10.0, 6.0):
            env.step(actions)
            last: Any = env.core.view.last
            assert last.chilled_water_c == pytest.approx([water_c] * 2)
            saved = env.state_dict()
            rewards = env.step(actions)[1]["agent_bat"]
            env.load_state_dict(saved)
            np.testing.assert_array_equal(env.step(actions)[1]["agent_bat"], rewards)
            env.load_state_dict(saved)


def test_no_agent_learns_chilled_water() -> None:
    with pytest.raises(ConfigError, match=r"agent_dc: 'chilled_water'"):
        sdc_taichi.vector_env(2, config="tiny", commands={"agent_dc": ["chilled_water"]})
