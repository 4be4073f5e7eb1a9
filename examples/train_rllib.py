"""RLlib's PPO on all three agents, with a module for each.

    python examples/train_rllib.py [--num-envs 16] [--steps 50000]

The data centers are PettingZoo environments in RLlib's own wrapper, within the process of the
algorithm; RLlib values what an episode ended with, as it was cut off rather than over. The modules
then act without exploring on a native batch, which needs no Python environment per data center.
Prints the mean episode return of each agent when idle, untrained and trained.

RLlib makes an empty folder in ``~/ray_results`` for each algorithm, and Ray writes logs to a folder
``ray`` among the temporary files of the system.
"""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Mapping, Sequence
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

AGENTS = ("agent_ls", "agent_dc", "agent_bat")


def settings(num_envs: int, days: int, rollout: int, seed: int) -> PPOConfig:
    """Settings of an independent PPO for each agent.

    Args:
        num_envs: data centers, each a Python environment.
        days: length of an episode.
        rollout: steps between updates.
        seed: decides episodes, weights and actions.
    """
    name, steps = "sdc_taichi", num_envs * rollout
    register_env(name, lambda _: ParallelPettingZooEnv(sdc_taichi.parallel_env(days=days)))
    runners = {"num_env_runners": 0, "num_envs_per_env_runner": num_envs}
    model = DefaultModelConfig(fcnet_hiddens=[64, 64], fcnet_activation="tanh")
    return (
        PPOConfig()
        .environment(name, disable_env_checking=True)
        .env_runners(**runners, rollout_fragment_length=rollout)
        .learners(num_learners=0)
        .multi_agent(policies=set(AGENTS), policy_mapping_fn=lambda agent, *_, **__: agent)
        .rl_module(model_config=model)
        .training(train_batch_size_per_learner=steps, minibatch_size=max(1, steps // 4))
        .training(num_epochs=5, gamma=0.995, lr=3e-4, entropy_coeff=0.01)
        .debugging(seed=seed, log_level="ERROR")
    )


def actions(algorithm: Algorithm | None, observations: Mapping[str, Any]) -> dict[str, Any]:
    """Most probable actions of each agent; without an algorithm, those that change nothing."""
    if algorithm is None:
        return {agent: np.ones(len(rows), dtype=np.int64) for agent, rows in observations.items()}
    chosen = {}
    for agent, rows in observations.items():
        with torch.no_grad():
            inputs = {Columns.OBS: torch.from_numpy(rows)}
            scores = algorithm.get_module(agent).forward_inference(inputs)
        chosen[agent] = scores[Columns.ACTION_DIST_INPUTS].argmax(-1).numpy()
    return chosen


def print_returns(name: str, env: Any, algorithm: Algorithm | None, seed: int) -> None:
    """Print the mean return of each agent in the episodes that begin with a seed."""
    observations, _ = env.reset(seed=seed)
    returns, ended = dict.fromkeys(env.agents, 0.0), False
    while not ended:
        observations, rewards, _, truncated, _ = env.step(actions(algorithm, observations))
        returns = {agent: total + float(rewards[agent].mean()) for agent, total in returns.items()}
        ended = all(flags.all() for flags in truncated.values())
    shown = ", ".join(f"{agent} {value:.3f}" for agent, value in returns.items())
    print(f"{name}: mean episode return {shown}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--steps", type=int, default=50_000, help="of all environments together")
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollout", type=int, default=96, help="steps between updates")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)  # faster than two for networks of this size
    config = settings(given.num_envs, given.days, given.rollout, given.seed)
    env = sdc_taichi.vector_env(given.num_envs, days=given.days)
    quiet = {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.ERROR}
    with ray.init(num_cpus=1, **quiet):
        algorithm = config.build_algo()
        seed = given.seed + given.num_envs
        print_returns("idle", env, None, seed)
        print_returns("untrained", env, algorithm, seed)
        updates = max(1, given.steps // (given.num_envs * given.rollout))
        for _ in range(updates):
            algorithm.train()
        print_returns("trained", env, algorithm, seed)
        algorithm.stop()
    env.close()


if __name__ == "__main__":
    main()
