"""Agents trained for a moment with each set of rewards that learns do better than idle ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

import sdc_taichi  # noqa: E402
from sdc_taichi import load_config  # noqa: E402
from sdc_taichi.envs.agents import AGENTS  # noqa: E402
from sdc_taichi.envs.core import Core  # noqa: E402
from sdc_taichi.learning.algorithms import (  # noqa: E402
    OFF_POLICY,
    ON_POLICY,
    OffPolicySettings,
    OnPolicySettings,
)
from sdc_taichi.learning.off_policy import OffPolicy  # noqa: E402
from sdc_taichi.learning.on_policy import OnPolicy  # noqa: E402
from sdc_taichi.learning.policy import action_levels  # noqa: E402
from sdc_taichi.learning.stream import EnvironmentStream  # noqa: E402

UPDATES = 40
EVENING_PRICES = tuple(0.3 if 16 <= hour < 21 else 0.1 for hour in range(24))


def env_of(num_envs: int, rewards: str) -> Any:
    return sdc_taichi.vector_env(
        num_envs,
        config=[load_config("tiny", [f"site.location={site}"]) for site in ("CA", "NY")],
        days=2,
        rewards=rewards,
        actions="continuous",
        tariff={"price_per_kwh": EVENING_PRICES},
        autoreset_mode="SameStep",
    )


def trained(rewards: str) -> OnPolicy:
    given = OnPolicySettings(rollout_decisions=8, hidden=(32,))
    stream = EnvironmentStream(
        env_of(64, rewards),
        decision_steps=given.decision_steps,
        levels=given.levels,
        shares_state=False,
        seed=0,
    )
    learner = OnPolicy(ON_POLICY["ippo"], given, stream, updates=UPDATES, seed=0)
    for _ in range(UPDATES):
        learner.update(stream)
    return learner


def totals(core: Core, learner: OnPolicy | None) -> dict[str, float]:
    """Sum of each term over other episodes than those of the training; None is idle."""
    observations: Any = core.reset(1000)
    actions: dict[str, Any] = dict.fromkeys(AGENTS, np.zeros((core.num_envs, 1)))
    found: dict[str, float] = {}
    while not core.episode_over:
        if core.view.state.step % 4 == 0:
            for network in learner.networks() if learner else ():
                (agent,) = network.agents
                actions[agent] = action_levels(7)[network.actions(observations[agent])]
        observations = core.step(actions).observations
        for name, values in core.reward_terms().items():
            found[name] = found.get(name, 0.0) + float(values.sum())
    return found


@pytest.mark.usefixtures("one_torch_thread")
@pytest.mark.parametrize("rewards", ["default", "bill"])
def test_agents_trained_for_a_moment_beat_idle_ones(rewards: str) -> None:
    """In carbon or in the bill, with what is stored and waits at the end at its mean worth."""
    core = env_of(16, rewards).core
    idle, found = totals(core, None), totals(core, trained(rewards))
    whole = {"default": "carbon", "bill": "cost"}[rewards]
    parts = [f"{part}_{whole}" for part in ("work", "cooling", "battery")]
    total = idle[whole]
    if rewards == "bill":
        parts.append("demand_charge")
        total += idle["demand_charge"]
    gain = sum(found[name] - idle[name] for name in parts)
    assert gain > 0.005 * -total, (gain, idle, found)
    # Work is in time, and inlets are at most 0.3 K above 27 C in the mean.
    assert found["sla"] > -1.0
    assert found["hot_inlets"] > idle["hot_inlets"] - 0.3 * 16 * 192


@pytest.mark.usefixtures("one_torch_thread")
def test_policies_keep_exploring_though_random_choices_cost_much_on_the_bill() -> None:
    settings = OffPolicySettings(hidden=(32,), gradient_steps=32, batch_size=512)
    stream = EnvironmentStream(env_of(64, "bill"), decision_steps=4, levels=settings.levels, seed=0)
    learner = OffPolicy(OFF_POLICY["hasac"], settings, stream, updates=20, seed=0)
    for _ in range(20):
        logged = learner.update(stream)
    # The target is 0.48 nats. With transitions of four decisions that of the battery falls to 0.06.
    assert all(logged[f"entropy/{agent}"] > 0.3 for agent in AGENTS), logged
