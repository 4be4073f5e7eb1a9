"""Experts for cloning: the commands of optima from any state, and commands as actions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sdc_taichi
from sdc_taichi import Simulator, load_config, make_controller, simulate
from sdc_taichi.learning.experts import FollowedOptimum, make_expert
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.optimum.solve import solve
from sdc_taichi.types import Actions, BatteryAction, CoolAction, LoadAction
from test_envs_commands import CONTROLLED, RACKS

CARBON = Objective(carbon=1.0)


def test_the_followed_optimum_reaches_what_is_achieved(tmp_path: Any, monkeypatch: Any) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with Simulator([load_config("tiny", ["site.location=CA", "site.start=07-01"])]) as sim:
        figures = []
        for _ in range(2):
            sim.reset(0)
            score = Score(CARBON, sim, 0)
            simulate(sim, FollowedOptimum(24, CARBON), 24, on_step=score.add)
            figures.append(score.figure)
        optimum = solve(sim.fleet, steps=24, start=sim.drivers.start, drivers=sim.drivers)
    np.testing.assert_allclose(figures, [optimum.achieved] * 2, rtol=1e-6)


def test_experts_by_name() -> None:
    with Simulator([load_config("tiny")]) as sim:
        assert isinstance(make_expert("optimum:cost", sim.fleet, 96), FollowedOptimum)
        known = make_controller("g36", sim.fleet)
        assert type(make_expert("g36", sim.fleet, 96)) is type(known)
        with pytest.raises(sdc_taichi.ConfigError, match="objective"):
            make_expert("optimum:joy", sim.fleet, 96)
        with pytest.raises(sdc_taichi.ConfigError, match=r"learning\.expert 'g37'.*did you mean"):
            make_expert("g37", sim.fleet, 96)


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_actions_of_decoded_commands_are_the_actions(actions: str) -> None:
    env = sdc_taichi.parallel_env(
        config=CONTROLLED,
        actions=actions,
        commands={"agent_ls": ["load", "placement"], "agent_dc": ["fan", "cooling"]},
        days=1,
    )
    env.reset(seed=0)
    core = env.core
    rng = np.random.default_rng(1)
    for _ in range(3):
        widths = {"agent_ls": 1 + RACKS, "agent_dc": 4, "agent_bat": 1}
        if actions == "discrete":
            given: Any = {a: rng.integers(3, size=(1, k)) for a, k in widths.items()}
            given["agent_bat"] = given["agent_bat"][:, 0]
        else:
            given = {a: rng.uniform(-1.0, 1.0, (1, k)) for a, k in widths.items()}
        commands = Actions(**core._decoder.decode(given, core.view.state))
        for agent, found in core.actions_of(commands).items():
            np.testing.assert_allclose(found, given[agent], rtol=1e-12)


def test_named_commands_and_those_between_choices_are_the_nearest_actions() -> None:
    env = sdc_taichi.vector_env(2, "tiny", days=1)
    env.reset(seed=0)
    named = Actions(LoadAction.DEFER, CoolAction.RAISE, BatteryAction.CHARGE)
    assert {a: x.tolist() for a, x in env.core.actions_of(named).items()} == {
        "agent_ls": [0, 0],
        "agent_dc": [2, 2],
        "agent_bat": [0, 0],
    }
    between = Actions(load=np.array([0.4, 0.6]), battery=np.array([-0.4, -0.6]))
    assert {a: x.tolist() for a, x in env.core.actions_of(between).items()} == {
        "agent_ls": [1, 2],
        "agent_dc": [1, 1],
        "agent_bat": [1, 2],
    }
    env.close()
