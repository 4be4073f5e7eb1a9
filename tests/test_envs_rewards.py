"""Reward terms by hand, scales, collaboration, and functions of the user's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sdc_taichi import ConfigError, SdcError, StepResult, load_config
from sdc_taichi.control import View
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.core import Core
from sdc_taichi.envs.options import make_options
from sdc_taichi.envs.reward_terms import (
    CI_G_PER_KWH,
    FOSSIL_G_PER_KWH,
    TERMS,
    WATER_L_PER_KWH,
    TermContext,
    reward_term,
)
from sdc_taichi.envs.rewards import collaborative_rewards, register_reward
from sdc_taichi.envs.single import SdcEnv
from sdc_taichi.types import F64

DEFER = dict.fromkeys(AGENTS, np.array([0]))


def core(overrides: list[str] | None = None, num_envs: int = 1, **options: Any) -> Core:
    config = load_config("tiny", overrides or [])
    return Core([config], make_options(**{"days": 1, "start": "fixed", **options}), num_envs)


def act(size: int, command: int) -> dict[str, Any]:
    return {agent: np.full(size, command) for agent in AGENTS}


def test_terms_are_what_their_names_say() -> None:
    env = core(num_envs=2)
    env.reset(0)
    result = [env.step(act(2, 2)).result for _ in range(5)][-1]
    design_kwh = env.sim.sizing.facility_w / 4e3
    found = env.reward_terms()
    assert set(found) == set(TERMS)
    expected = {
        "carbon": -result.carbon_g / (CI_G_PER_KWH * design_kwh),
        "total_energy": -result.grid_kwh / design_kwh,
        "facility_energy": -(result.it_kwh + result.overhead_w / 4e3) / design_kwh,
        "it_energy": -result.it_kwh / design_kwh,
        "hvac_energy": -result.hvac_kwh / design_kwh,
        "fossil_share": -result.grid_kwh * (result.ci_g_per_kwh / FOSSIL_G_PER_KWH) / design_kwh,
        "pue": 1.0 - result.pue,
        "water": -result.water_l / (WATER_L_PER_KWH * design_kwh),
        "hot_inlets": -result.over_27_mean_k,
        "dropped": -result.dropped_tasks,
        "high_power": -40.0
        * np.maximum(result.grid_kwh / design_kwh - 0.5, 0.0) ** 2
        * (12.0 / (720.0 * 0.1)),
        "sla": -(result.overdue_tasks + result.dropped_tasks + result.lost_tasks) / 100,
    }
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-12, err_msg=name)
    for name, values in found.items():
        assert values.shape == (2,), name
        assert np.all(values <= 0) or name.partition("_")[0] in ("work", "battery"), name
    assert np.all(found["carbon"] < -0.05)


def test_a_term_of_ones_own_has_a_name_of_its_own() -> None:
    def chilled(r: StepResult, c: TermContext) -> F64:
        """Cooling energy."""
        return -r.hvac_kwh / c.design_kwh

    def another(r: StepResult, c: TermContext) -> F64:
        return -r.hvac_kwh

    another.__name__ = "chilled"
    for _ in range(2):  # A notebook cell may run twice.
        reward_term(chilled)
    try:
        with pytest.raises(ConfigError, match="'chilled': valid is a name that is not taken"):
            reward_term(another)
        env = core(rewards={"agent_dc": {"chilled": 1.0}}, collaboration=1.0)
        env.reset(0)
        done = env.step(act(1, 1))
        assert done.rewards["agent_dc"] == env.reward_terms()["hvac_energy"] < 0
    finally:
        del TERMS["chilled"]


def test_queued_tasks_cost_in_the_last_hour_of_the_day() -> None:
    env = core()
    env.reset(0)
    for step in range(96):
        queued = env.step(act(1, 0)).result.queue_tasks[0]
        weight = max(0.0, (step / 4 - 23.0) / 0.75)
        assert env.reward_terms()["queue"][0] == pytest.approx(-weight * queued / 10.0, abs=1e-12)
    assert queued > 0


def test_cost_follows_the_hour_and_the_peak_of_the_episode() -> None:
    prices = tuple(0.01 * hour for hour in range(24))
    scales = {"agent_ls": {"cost": 1.0}, "agent_bat": {"demand_charge": 1.0}}
    env = core(
        rewards=scales,
        collaboration=1.0,
        tariff={"price_per_kwh": prices, "demand_charge_per_kw": 3.0},
    )
    for _ in range(2):  # An episode does not know the peak of the one before.
        env.reset(0)
        design_kw = env.sim.sizing.facility_w[0] / 1e3
        peak_kw, charged = 0.5 * design_kw, 0.0
        for step in range(12):
            done = env.step(act(1, 2 * (step % 2)))
            kwh = done.result.grid_kwh[0]
            above_kw = max(0.0, kwh * 4 - peak_kw)
            peak_kw = max(peak_kw, kwh * 4)
            design_kwh = env.sim.sizing.facility_w[0] / 4e3
            paid = kwh * prices[step // 4]
            assert done.rewards["agent_ls"][0] == pytest.approx(-paid / (0.1 * design_kwh))
            assert env.reward_terms()["cost"][0] == done.rewards["agent_ls"][0]
            # A day's part of a bill of 30 days.
            charge = 3.0 * above_kw / 30.0
            assert done.rewards["agent_bat"][0] == pytest.approx(-charge / (0.1 * design_kwh))
            charged += done.rewards["agent_bat"][0]
        # Half the design power is billed anyway.
        assert peak_kw > 0.5 * design_kw
        assert charged == pytest.approx((0.5 * design_kw - peak_kw) / (design_kw / 4))


PARTS = {"carbon": ("work_carbon", "cooling_carbon", "battery_carbon")}
PARTS["cost"] = ("work_cost", "cooling_cost", "battery_cost")
PRICES = tuple(0.05 + 0.01 * hour for hour in range(24))


@pytest.mark.parametrize("whole", PARTS)
@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["battery.model=released", "workload.model=tasks"],
        ["workload.queue_limit_h=0.1", "workload.deadline_h=2"],
        ["battery.hours_of_design_load=0", "simulation.steps_per_hour=1"],
    ],
)
def test_parts_of_agents_add_up_to_the_whole_and_what_is_left(
    whole: str, overrides: list[str]
) -> None:
    """Whatever agents do, the parts differ from the whole by what no action changes and by ends."""
    env = core(overrides, num_envs=2, actions="continuous", tariff={"price_per_kwh": PRICES})
    env.reset(0)
    view, rng = env.view, np.random.default_rng(1)
    task_kwh = view.sizing.it_w * view.step_h / 1e5
    series, unit = (
        (view.drivers.ci_g_per_kwh, CI_G_PER_KWH)
        if whole == "carbon"
        else (view.drivers.price_per_kwh, 0.1)
    )
    assert series is not None
    first = view.drivers.start
    step = np.arange(round(24 / view.step_h))
    total, expected = np.zeros(2), np.zeros(2)
    for left in reversed(range(env.steps)):
        actions = {a: rng.uniform(-1, 1, (2, 1)).astype(np.float32) for a in AGENTS}
        if left == 0:  # Work waits at the end.
            actions["agent_ls"][:] = -1.0
        done = env.step(actions)
        r, terms = done.result, env.reward_terms()
        total += sum(terms[name] for name in PARTS[whole])
        gone_tasks = r.arrived_tasks - r.executed_tasks
        gone_tasks -= r.deferred_tasks - r.drained_tasks - (r.due_tasks - r.overdue_tasks)
        rate = series.at(first + r.step)
        arrived = rate * task_kwh * (r.arrived_tasks - gone_tasks)
        expected += terms[whole] + arrived / (unit * view.sizing.facility_w * view.step_h / 1e3)
    mean = series.at(first[:, None] + env.steps + step).mean(axis=1)
    worth = mean * (r.stored_kwh - task_kwh * r.queue_tasks)
    expected += worth / (unit * view.sizing.facility_w * view.step_h / 1e3)
    np.testing.assert_allclose(total, expected, rtol=1e-8)
    assert np.any(r.queue_tasks > 0)


@pytest.mark.parametrize("collaboration", [0.8, 1.0])
def test_all_agents_as_one_get_each_term_once(collaboration: float) -> None:
    env = core(collaboration=collaboration)
    env.reset(0)
    env.step(act(1, 0))
    done, terms = env.step(act(1, 2)), env.reward_terms()
    parts = sum(terms[name] for name in PARTS["carbon"])
    expected = 10.0 * parts + 20.0 * terms["sla"] + 0.1 * terms["hot_inlets"]
    np.testing.assert_allclose(done.joint_reward, expected, rtol=1e-12)
    own = sum(done.rewards.values())
    np.testing.assert_allclose(own, expected + 10.0 * terms["cooling_carbon"], rtol=1e-12)


def test_those_who_learn_as_one_get_their_own_terms_alone() -> None:
    def joint(*agents: str) -> tuple[Any, dict[str, Any], Any]:
        env = core(agents=agents, collaboration=1.0)
        env.reset(0)
        done = env.step({agent: np.zeros(1, dtype=np.int64) for agent in agents})
        return done.joint_reward, env.reward_terms(), done.rewards

    reward, _, own = joint("agent_bat")
    np.testing.assert_array_equal(reward, own["agent_bat"])
    reward, terms, _ = joint("agent_dc", "agent_bat")
    expected = 10.0 * (terms["cooling_carbon"] + terms["battery_carbon"])
    np.testing.assert_allclose(reward, expected + 0.1 * terms["hot_inlets"], rtol=1e-12)


def test_each_agent_is_paid_for_its_own_part() -> None:
    def rewards(**commands: int) -> dict[str, F64]:
        env = core(["site.location=CA"], days=2, collaboration=1.0)
        env.reset(0)
        kept = []
        for _ in range(96):
            done = env.step(act(1, 1) | {a: np.array([c]) for a, c in commands.items()})
            kept.append(done.rewards | {"ci": done.result.ci_g_per_kwh})
        return {name: np.concatenate([one[name] for one in kept]) for name in kept[0]}

    idle = rewards()
    np.testing.assert_array_equal(idle["agent_bat"], 0.0)
    np.testing.assert_allclose(idle["agent_ls"], idle["agent_dc"], rtol=1e-12)
    assert np.all(idle["agent_dc"] < 0)
    # Deferring pays where the grid is dirtier than the coming day is on average, and only there.
    deferring = rewards(agent_ls=0)
    np.testing.assert_array_equal(deferring["agent_bat"], 0.0)
    gain = deferring["agent_ls"] - idle["agent_ls"]
    assert gain[idle["ci"].argmax()] > 0 > gain[idle["ci"].argmin()]
    charging = rewards(agent_bat=0)
    np.testing.assert_array_equal(charging["agent_ls"], idle["agent_ls"])
    np.testing.assert_array_equal(charging["agent_dc"], idle["agent_dc"])
    assert charging["agent_bat"][0] != 0


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3),
    st.floats(0, 1),
)
def test_sharing_keeps_the_sum(own: list[float], a: float) -> None:
    given = [np.array([r]) for r in own]
    assert math.fsum(r[0] for r in collaborative_rewards(given, a)) == pytest.approx(
        math.fsum(own), abs=1e-9
    )
    assert np.array(collaborative_rewards(given, 1.0)) == pytest.approx(np.array(given), abs=1e-12)
    # To the bit what several at once get.
    three = np.array(collaborative_rewards([np.tile(r, 3) for r in given], a))
    assert np.array_equal(three[:, 1:2], collaborative_rewards(given, a))


def test_agents_not_mentioned_keep_their_default() -> None:
    env = core(rewards={"agent_dc": {"pue": 2.0, "water": 0.5}}, collaboration=1.0)
    env.reset(0)
    done = env.step(act(1, 1))
    terms = env.reward_terms()
    np.testing.assert_allclose(
        done.rewards["agent_dc"], 2 * terms["pue"] + 0.5 * terms["water"], rtol=1e-12
    )
    np.testing.assert_allclose(
        done.rewards["agent_bat"], 10.0 * terms["battery_carbon"], rtol=1e-12
    )


def water_saved(result: StepResult, view: View) -> F64:
    assert view.last is result
    return -result.water_l


def test_functions_of_the_user() -> None:
    for spec in (water_saved, f"{__name__}:water_saved"):
        env = core(rewards=spec)
        env.reset(0)
        done = env.step(act(1, 1))
        for agent in AGENTS:
            np.testing.assert_array_equal(done.rewards[agent], -done.result.water_l)
    for factor in (1.0, 2.0):  # A notebook cell may run twice, with changes.

        def energy_drawn(result: StepResult, view: View, factor: float = factor) -> F64:
            return -factor * result.grid_kwh

        register_reward("energy_drawn", energy_drawn)
    env = core(rewards="energy_drawn")
    env.reset(0)
    done = env.step(act(1, 1))
    np.testing.assert_array_equal(done.rewards["agent_dc"], -2.0 * done.result.grid_kwh)
    register_reward("saved_water", water_saved)
    for name in ("saved_water", "default", "not a name", 3):
        with pytest.raises(ConfigError, match=f"{name!r}: valid is a name that is not taken"):
            register_reward(name, lambda result, view: -result.water_l)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="'water_x': is a float; valid is a function"):
        register_reward("water_x", 1.0)  # type: ignore[arg-type]


def test_functions_of_the_user_answer_for_those_that_learn() -> None:
    def by_agent(result: StepResult, view: View) -> dict[str, F64]:
        return {"agent_bat": -result.carbon_g, "agent_dc": -result.hvac_kwh}

    env = core(rewards=by_agent, agents=["agent_bat"])
    env.reset(0)
    done = env.step({"agent_bat": np.array([1])})
    assert set(done.rewards) == {"agent_bat"}
    np.testing.assert_array_equal(done.rewards["agent_bat"], -done.result.carbon_g)


def test_a_joint_learner_gets_one_value_for_all_once() -> None:
    alike = core(rewards=water_saved)
    each = core(rewards=lambda result, view: dict.fromkeys(AGENTS, -result.water_l))
    for env, times in ((alike, 1), (each, 3)):
        env.reset(0)
        done = env.step(act(1, 1))
        np.testing.assert_allclose(done.joint_reward, -times * done.result.water_l, rtol=1e-12)
    single = SdcEnv(load_config("tiny"), days=1, start="fixed", rewards=water_saved)
    single.reset(seed=0)
    _, reward, *_ = single.step([1, 1, 1])
    assert reward == -done.result.water_l[0] != 0


@pytest.mark.parametrize(
    ("rewards", "message"),
    [
        ("sustain", "'sustain': unknown; valid: default, bill, paper, sustaindc"),
        ("no_such_module:f", "cannot be imported"),
        ("math:pi", "is a float; valid is a function"),
        ({"agent_xy": {}}, "unknown agent 'agent_xy'"),
        ({"agent_dc": {"watr": 1.0}}, "unknown term 'watr'; did you mean 'water'"),
        ({"agent_dc": {"water": math.inf}}, "water is inf"),
        ({"agent_ls": {"carbon": "x"}}, "rewards of agent_ls: carbon is 'x'; valid is a number"),
        ({"agent_ls": {"carbon": True}}, "carbon is True; valid is a number"),
        ({"agent_ls": ["carbon"]}, "valid is a dict of term to scale"),
        ({"carbon": 1.0}, "unknown agent 'carbon'; valid: agent_ls, agent_dc, agent_bat"),
        (3, "rewards 3: unknown; valid: default, bill, paper, sustaindc"),
    ],
)
def test_wrong_rewards_are_named(rewards: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        core(rewards=rewards)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (np.zeros(3), r"\(3,\) for all agents; valid is \(1,\)"),
        ("much", "returned 'much' for all agents; valid is"),
        (None, "for all agents; valid is"),
        ({**dict.fromkeys(AGENTS, 0.0), "agent_dc": "x"}, "returned 'x' for agent_dc"),
        ({**dict.fromkeys(AGENTS, 0.0), "agent_x": 0.0}, "unknown agent 'agent_x'"),
        ({"agent_ls": np.zeros(2), "agent_dc": 0.0, "agent_bat": 0.0}, r"\(2,\) for agent_ls"),
        (np.array([np.nan]), "with nan .* of finite numbers"),
        ({"agent_ls": np.zeros(1)}, "returned none for agent_dc"),
    ],
)
def test_wrong_results_of_a_function_are_named(returned: Any, message: str) -> None:
    env = core(rewards=lambda result, view: returned)
    env.reset(0)
    with pytest.raises(SdcError, match=message):
        env.step(act(1, 1))
