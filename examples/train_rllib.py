"""RLlib's PPO on all three agents, with a module for each.

    python examples/train_rllib.py [--num-envs 16] [--steps 50000]

The data centers are PettingZoo environments in RLlib's own wrapper, within the process of the
algorithm; RLlib values what an episode ended with, as it was cut off rather than over. The modules
then act without exploring on a native batch, which needs no Python environment per data center.
Prints the mean episode return of each agent when idling, untrained and trained.

RLlib makes an empty folder in ``~/ray_results`` for each algorithm, and Ray writes logs to a folder
``ray`` among the temporary files of the system.
"""

from __future__ import annotations

import argparse
import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read on import; nothing is sent

import numpy as np
import ray
import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

import sdc_taichi

Act = Callable[[Mapping[str, Any]], dict[str, Any]]
"""Actions of a batch from its observations, both by agent."""
AGENTS = ("agent_ls", "agent_dc", "agent_bat")


def ppo(*, num_envs: int, rollout: int, days: int, hidden: Sequence[int], seed: int) -> PPOConfig:
    """Settings of an independent PPO for each agent.

    Args:
        num_envs: data centers, each a Python environment.
        rollout: steps between updates.
        days: length of an episode.
        hidden: units of the hidden layers of policies and critics.
        seed: decides episodes, weights and actions.
    """
    name = "sdc_taichi"
    register_env(name, lambda _: ParallelPettingZooEnv(sdc_taichi.parallel_env(days=days)))
    steps = num_envs * rollout
    return (
        PPOConfig()
        .environment(name, disable_env_checking=True)
        .env_runners(
            num_env_runners=0, num_envs_per_env_runner=num_envs, rollout_fragment_length=rollout
        )
        .learners(num_learners=0)
        .multi_agent(policies=set(AGENTS), policy_mapping_fn=lambda agent, *_, **__: agent)
        .rl_module(
            model_config=DefaultModelConfig(fcnet_hiddens=list(hidden), fcnet_activation="tanh")
        )
        .training(
            train_batch_size_per_learner=steps,
            minibatch_size=max(1, steps // 4),
            num_epochs=5,
            gamma=0.995,
            lr=3e-4,
            entropy_coeff=0.01,
        )
        .debugging(seed=seed, log_level="ERROR")
    )


def greedy(algorithm: Algorithm) -> Act:
    """Each agent's most probable actions."""

    def act(observations: Mapping[str, Any]) -> dict[str, Any]:
        actions = {}
        for agent, rows in observations.items():
            with torch.no_grad():
                given = {Columns.OBS: torch.from_numpy(rows)}
                scores = algorithm.get_module(agent).forward_inference(given)
            actions[agent] = scores[Columns.ACTION_DIST_INPUTS].argmax(-1).numpy()
        return actions

    return act


def idle(observations: Mapping[str, Any]) -> dict[str, Any]:
    """The actions in the middle, which change nothing."""
    return {agent: np.ones(len(rows), dtype=np.int64) for agent, rows in observations.items()}


def score(env: Any, act: Act, seed: int) -> dict[str, float]:
    """Mean return of each agent in the episodes that begin with a seed."""
    observations, _ = env.reset(seed=seed)
    returns, ended = dict.fromkeys(env.agents, 0.0), False
    while not ended:
        observations, rewards, _, truncated, _ = env.step(act(observations))
        returns = {agent: total + float(rewards[agent].mean()) for agent, total in returns.items()}
        ended = all(flags.all() for flags in truncated.values())
    return returns


def train(config: PPOConfig, updates: int, env: Any, seed: int) -> dict[str, dict[str, float]]:
    """Returns when idling, untrained and trained, after printing the speed of training.

    Args:
        config: from ``ppo``.
        updates: number of rollouts and updates.
        env: the batch on which returns are measured.
        seed: of its episodes.
    """
    algorithm = config.build_algo()
    try:
        returns = {"idle": score(env, idle, seed)}
        returns["untrained"] = score(env, greedy(algorithm), seed)
        start = time.perf_counter()
        for _ in range(updates):
            algorithm.train()
        speed = updates * config.train_batch_size_per_learner / (time.perf_counter() - start)
        print(f"{speed:,.0f} steps/s with {config.num_envs_per_env_runner} data centers")
        returns["trained"] = score(env, greedy(algorithm), seed)
    finally:
        algorithm.stop()
    return returns


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--steps", type=int, default=50_000, help="of all environments together")
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollout", type=int, default=96, help="steps between updates")
    parser.add_argument("--hidden", type=int, nargs="+", default=[64, 64])
    parser.add_argument("--seed", type=int, default=0)
    given = vars(parser.parse_args(arguments))
    steps, seed = given.pop("steps"), given["seed"]
    torch.set_num_threads(1)  # faster than two for networks of this size
    config = ppo(**given)
    updates = max(1, steps // (given["num_envs"] * given["rollout"]))
    env = sdc_taichi.vector_env(given["num_envs"], days=given["days"])
    with ray.init(
        num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR
    ):
        returns = train(config, updates, env, seed + given["num_envs"])
    env.close()
    for name, by_agent in returns.items():
        shown = ", ".join(f"{agent} {value:.3f}" for agent, value in by_agent.items())
        print(f"{name}: mean episode return {shown}")


if __name__ == "__main__":
    main()
