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
from sdc_taichi.envs.core import Core
from sdc_taichi.envs.features import AGENTS
from sdc_taichi.envs.options import make_options
from sdc_taichi.envs.rewards import (
    CI_G_PER_KWH,
    FOSSIL_G_PER_KWH,
    TERMS,
    WATER_L_PER_KWH,
    register_reward,
    share,
)
from sdc_taichi.types import F64

DEFER = dict.fromkeys(AGENTS, np.array([0]))


def core(overrides: list[str] | None = None, num_envs: int = 1, **options: Any) -> Core:
    config = load_config("tiny", overrides or [])
    return Core(config, make_options(**{"days": 1, "start": "fixed", **options}), num_envs)


def act(size: int, command: int) -> dict[str, Any]:
    return {agent: np.full(size, command) for agent in AGENTS}


def test_terms_are_what_their_names_say() -> None:
    env = core(num_envs=2)
    env.reset(0)
    result = [env.step(act(2, 2)).result for _ in range(5)][-1]
    design_kwh = env.sim.sizing.facility_w / 4e3
    found = env.terms()
    assert set(found) == set(TERMS)
    expected = {
        "carbon": -result.carbon_g / (CI_G_PER_KWH * design_kwh),
        "total_energy": -result.grid_kwh / design_kwh,
        "facility_energy": -(result.it_kwh + result.hvac_kwh) / design_kwh,
        "it_energy": -result.it_kwh / design_kwh,
        "hvac_energy": -result.hvac_kwh / design_kwh,
        "fossil_share": -result.grid_kwh * (result.ci_g_per_kwh / FOSSIL_G_PER_KWH) / design_kwh,
        "pue": 1.0 - result.pue,
        "water": -result.water_l / (WATER_L_PER_KWH * design_kwh),
        "hot_inlets": -result.hot_k,
        "dropped": -result.dropped_tasks,
        "sla": -(result.overdue_tasks + result.dropped_tasks + result.lost_tasks) / 100,
    }
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-12, err_msg=name)
    for name, values in found.items():
        assert values.shape == (2,), name
        assert np.all(values <= 0), name
    assert np.all(found["carbon"] < -0.05)


def test_queued_tasks_cost_in_the_last_hour_of_the_day() -> None:
    env = core()
    env.reset(0)
    for step in range(96):
        queued = env.step(act(1, 0)).result.queue_tasks[0]
        weight = max(0.0, (step / 4 - 23.0) / 0.75)
        assert env.terms()["queue"][0] == pytest.approx(-weight * queued / 10.0, abs=1e-12)
    assert queued > 0


def test_an_hourly_step_has_its_whole_penalty_at_23() -> None:
    env = core(["simulation.steps_per_hour=1"])
    env.reset(0)
    for step in range(24):
        queued = env.step(act(1, 0)).result.queue_tasks[0]
        assert env.terms()["queue"][0] == pytest.approx(-queued / 10 if step == 23 else 0.0)


def test_cost_follows_the_hour_and_the_peak_of_the_episode() -> None:
    prices = tuple(0.01 * hour for hour in range(24))
    scales = {agent: {"cost": 1.0} for agent in AGENTS}
    env = core(
        rewards=scales,
        collaboration=1.0,
        tariff={"price_per_kwh": prices, "demand_charge_per_kw": 3.0},
    )
    for _ in range(2):  # An episode does not know the peak of the one before.
        env.reset(0)
        peak_kw = 0.0
        for step in range(12):
            done = env.step(act(1, 2 * (step % 2)))
            kwh = done.result.grid_kwh[0]
            above_kw = max(0.0, kwh * 4 - peak_kw)
            peak_kw = max(peak_kw, kwh * 4)
            paid = kwh * prices[step // 4] + 3.0 * above_kw
            design_kwh = env.sim.sizing.facility_w[0] / 4e3
            assert done.rewards["agent_ls"][0] == pytest.approx(-paid / (0.1 * design_kwh))
            assert env.terms()["cost"][0] == done.rewards["agent_ls"][0]
        assert peak_kw > 0


def test_default_rewards_are_those_of_the_paper() -> None:
    env = core(collaboration=1.0)
    env.reset(0)
    for _ in range(94):
        done = env.step(act(1, 0))
        terms = env.terms()
        own = {
            "agent_ls": terms["carbon"] + terms["queue"] + 10.0 * terms["dropped"],
            "agent_dc": terms["facility_energy"],
            "agent_bat": terms["carbon"],
        }
        for agent, expected in own.items():
            np.testing.assert_allclose(done.rewards[agent], expected, rtol=1e-12)
    assert terms["queue"][0] < 0


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3),
    st.floats(0, 1),
)
def test_sharing_keeps_the_sum(own: list[float], a: float) -> None:
    given = {agent: np.array([r]) for agent, r in zip(AGENTS, own, strict=True)}
    total = sum(float(r[0]) for r in share(given, a).values())
    assert total == pytest.approx(math.fsum(own), abs=1e-9)
    for agent, r in share(given, 1.0).items():
        assert r[0] == pytest.approx(given[agent][0], abs=1e-12)


def test_agents_not_mentioned_keep_their_default() -> None:
    env = core(rewards={"agent_dc": {"pue": 2.0, "water": 0.5}}, collaboration=1.0)
    env.reset(0)
    done = env.step(act(1, 1))
    terms = env.terms()
    np.testing.assert_allclose(
        done.rewards["agent_dc"], 2 * terms["pue"] + 0.5 * terms["water"], rtol=1e-12
    )
    np.testing.assert_allclose(done.rewards["agent_bat"], terms["carbon"], rtol=1e-12)


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
    register_reward("saved_water", water_saved)
    assert core(rewards="saved_water") is not None
    with pytest.raises(ConfigError, match="'saved_water': valid is a name that is not taken"):
        register_reward("saved_water", water_saved)


@pytest.mark.parametrize(
    ("rewards", "message"),
    [
        ("sustain", "'sustain': unknown; valid: default, sustaindc"),
        ("no_such_module:f", "cannot be imported"),
        ("math:pi", "is a float; valid is a function"),
        ({"agent_xy": {}}, "unknown agent 'agent_xy'"),
        ({"agent_dc": {"watr": 1.0}}, "unknown term 'watr'; did you mean 'water'"),
        ({"agent_dc": {"water": math.inf}}, "water is inf"),
    ],
)
def test_wrong_rewards_are_named(rewards: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        core(rewards=rewards)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (np.zeros(3), r"\(3,\) for agent_ls; valid is \(1,\)"),
        (np.array([np.nan]), "of finite numbers"),
        ({"agent_ls": np.zeros(1)}, "returned none for agent_dc"),
    ],
)
def test_wrong_results_of_a_function_are_named(returned: Any, message: str) -> None:
    env = core(rewards=lambda result, view: returned)
    env.reset(0)
    with pytest.raises(SdcError, match=message):
        env.step(act(1, 1))
