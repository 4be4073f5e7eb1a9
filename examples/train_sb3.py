"""Stable-Baselines3 PPO on one of the three agents, the others idle.

    python examples/train_sb3.py [--agent Battery] [--num-envs 64] [--steps 200000]

``BatchVecEnv`` makes the native batch of ``gym.make_vec`` a Stable-Baselines3 ``VecEnv`` without a
Python environment per data center. Prints the mean episode reward of a random policy, of the
trained one and steps per second.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import sdc_taichi  # noqa: F401  registers the environments

IDS = {name: f"sdc_taichi/{name}-v0" for name in ("Load", "Cooling", "Battery")}


class BatchVecEnv(VecEnv):
    """A Gymnasium batch with SAME_STEP reset as Stable-Baselines3 expects it.

    Args:
        env: the batch; its ``final_obs`` become the ``terminal_observation`` of the infos.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        self._env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> npt.NDArray[np.float32]:
        """First observations, (B, n); environment i gets the seed of environment 0 plus i."""
        observations, _ = self._env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return np.asarray(observations)

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        """Observations, rewards, whether episodes ended, and one info per environment."""
        observations, rewards, terminated, truncated, info = self._env.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            infos[i]["terminal_observation"] = info["final_obs"][i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return observations, np.asarray(rewards, dtype=np.float32), done, infos

    def close(self) -> None:
        """Close the batch."""
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute of the batch, once per environment."""
        return [getattr(self._env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse to set an attribute, as all belong to the whole batch."""
        raise NotImplementedError(f"cannot set {attr_name} of single environments of a batch")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Refuse to call a method, as all belong to the whole batch."""
        raise NotImplementedError(f"cannot call {method_name} of single environments of a batch")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Whether a wrapper is around the batch, once per environment."""
        return [isinstance(self._env, wrapper_class)] * len(list(self._get_indices(indices)))


def make(agent: str, num_envs: int, days: int, seed: int) -> VecMonitor:
    """The batch of one agent, with episode rewards in its infos."""
    batch = gymnasium.make_vec(IDS[agent], num_envs=num_envs, days=days, autoreset_mode="SameStep")
    env = BatchVecEnv(batch)
    env.seed(seed)
    return VecMonitor(env)


def train(agent: str, num_envs: int, steps: int, days: int, rollout: int, seed: int) -> PPO:
    """Train, and print mean episode rewards of other seeds before and after."""
    torch.set_num_threads(1)  # faster than two for networks of this size
    env = make(agent, num_envs, days, seed)
    batch_size = max(2, num_envs * rollout // 4)
    model = PPO(
        *("MlpPolicy", env), n_steps=rollout, batch_size=batch_size, n_epochs=5, gamma=0.995,
        ent_coef=0.01, seed=seed, device="cpu",
    )  # fmt: skip
    for moment, length in (("untrained", 0), ("trained", steps)):
        start = time.perf_counter()
        if length:
            model.learn(length)
            speed = model.num_timesteps / (time.perf_counter() - start)
            print(f"{model.num_timesteps} steps, {speed:,.0f} steps/s")
        other = make(agent, num_envs, days, seed + num_envs)
        mean, _ = evaluate_policy(model, other, n_eval_episodes=num_envs)
        other.close()
        print(f"{agent}, {moment}: mean episode reward {mean:.3f}")
    env.close()
    return model


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--agent", choices=IDS, default="Battery")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=200_000, help="of all environments together")
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollout", type=int, default=96, help="steps between updates")
    parser.add_argument("--seed", type=int, default=0)
    train(**vars(parser.parse_args(arguments)))


if __name__ == "__main__":
    main()
