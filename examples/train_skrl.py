"""The three agents of a batch of data centers under skrl, by IPPO or MAPPO.

    python examples/train_skrl.py [--algorithm mappo] [--num-envs 256] [--steps 1000000]

IPPO gives each agent a critic of its own observations, MAPPO one of the shared state. Prints steps
per second and the mean reward of each agent in the first and the last rollout.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from skrl import logger
from skrl.envs.wrappers.torch import MultiAgentEnvWrapper
from skrl.memories.torch import RandomMemory
from skrl.models.torch import CategoricalMixin, DeterministicMixin, Model
from skrl.multi_agents.torch.ippo import IPPO
from skrl.multi_agents.torch.mappo import MAPPO
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

import sdc_taichi
from sdc_taichi.envs.vector import MultiAgentVectorEnv

Tensors = dict[str, torch.Tensor]


class BatchEnv(MultiAgentEnvWrapper):
    """A multi-agent batch for skrl: arrays become tensors without copies.

    skrl looks at what it gets back from ``step`` both for acting and for the value of the state an
    episode was cut off at. The batch has started the next episode by then, so the observations and
    states before that are in ``infos["final"]``, where ``SeesFinal`` finds them.

    Args:
        env: what ``sdc_taichi.vector_env`` returns with ``autoreset_mode="SameStep"``.
        seed: of the first reset.
    """

    def __init__(self, env: MultiAgentVectorEnv, seed: int) -> None:
        super().__init__(env)
        self._device = torch.device("cpu")
        self._seed: int | None = seed
        self.rewards: list[list[float]] = []
        """Mean over the batch, by step and agent."""

    def reset(self) -> tuple[Tensors, dict[str, Any]]:
        """Start episodes."""
        observations, infos = self._env.reset(seed=self._seed)
        self._seed = None
        return tensors(observations), infos

    def step(self, actions: Tensors) -> tuple[Tensors, Tensors, Tensors, Tensors, dict[str, Any]]:
        """Step with actions of shape (B, 1)."""
        chosen = {agent: index.squeeze(-1).numpy() for agent, index in actions.items()}
        observations, rewards, terminated, truncated, infos = self._env.step(chosen)
        self.rewards.append([float(rewards[agent].mean()) for agent in self.possible_agents])
        if "final_obs" in infos:
            infos["final"] = tensors(infos["final_obs"]), self._shared(infos["final_state"])
        columns = (
            {agent: torch.from_numpy(values).unsqueeze(-1) for agent, values in given.items()}
            for given in (rewards, terminated, truncated)
        )
        return tensors(observations), *columns, infos

    def state(self) -> Tensors:
        """The shared state, the same tensor for all agents."""
        return self._shared(self._env.state())

    def _shared(self, state: Any) -> Tensors:
        return dict.fromkeys(self.possible_agents, torch.from_numpy(state))

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Nothing is shown while training."""

    def close(self) -> None:
        """Close the batch."""
        self._env.close()


def tensors(arrays: Mapping[str, Any]) -> Tensors:
    """Tensors on the arrays' memory."""
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


class SeesFinal:
    """Gives the learner what an episode ended with, in place of what the next one starts with."""

    def record_transition(self, **given: Any) -> None:
        """Record a step."""
        if "final" in given["infos"]:
            given["next_observations"], given["next_states"] = given["infos"]["final"]
        super().record_transition(**given)  # type: ignore[misc]


class Ippo(SeesFinal, IPPO):
    """Independent PPO: critics see what their agent sees."""


class Mappo(SeesFinal, MAPPO):
    """Multi-agent PPO: critics see the shared state."""


ALGORITHMS = {"ippo": (Ippo, "observations"), "mappo": (Mappo, "states")}
"""Class, and what its critics see."""


class Policy(CategoricalMixin, Model):
    """Probabilities of the actions."""

    def __init__(self, spaces: Mapping[str, Any], hidden: Sequence[int]) -> None:
        Model.__init__(self, **spaces, device="cpu")
        CategoricalMixin.__init__(self)
        self.net = perceptron(self.num_observations, hidden, self.num_actions)

    def compute(self, inputs: Mapping[str, torch.Tensor], role: str) -> tuple[torch.Tensor, Any]:
        """Logits of the actions, (B, n)."""
        return self.net(inputs["observations"]), {}


class Critic(DeterministicMixin, Model):
    """Value of a situation."""

    def __init__(self, spaces: Mapping[str, Any], hidden: Sequence[int], sees: str) -> None:
        Model.__init__(self, **spaces, device="cpu")
        DeterministicMixin.__init__(self)
        self.sees = sees
        width = self.num_states if sees == "states" else self.num_observations
        self.net = perceptron(width, hidden, 1)

    def compute(self, inputs: Mapping[str, torch.Tensor], role: str) -> tuple[torch.Tensor, Any]:
        """Value, (B, 1)."""
        return self.net(inputs[self.sees]), {}


def perceptron(width: int, hidden: Sequence[int], out: int) -> nn.Sequential:
    """Layers of tanh units."""
    layers: list[nn.Module] = []
    for units in hidden:
        layers += [nn.Linear(width, units), nn.Tanh()]
        width = units
    return nn.Sequential(*layers, nn.Linear(width, out))


def learner(
    env: BatchEnv,
    algorithm: str,
    *,
    rollout: int,
    hidden: Sequence[int],
    **settings: Any,
) -> Any:
    """A skrl agent for all agents of a batch.

    Args:
        env: the batch.
        algorithm: ``ippo`` or ``mappo``.
        rollout: steps between updates.
        hidden: units of the hidden layers of policies and critics.
        settings: of skrl, over those chosen here.
    """
    kind, critics_see = ALGORITHMS[algorithm]
    models, memories = {}, {}
    for agent in env.possible_agents:
        spaces = {
            "observation_space": env.observation_space(agent),
            "state_space": env.state_space(agent),
            "action_space": env.action_space(agent),
        }
        models[agent] = {
            "policy": Policy(spaces, hidden),
            "value": Critic(spaces, hidden, critics_see),
        }
        memories[agent] = RandomMemory(memory_size=rollout, num_envs=env.num_envs, device="cpu")

    def sizes(of: Mapping[str, Any]) -> dict[str, Any]:
        return {agent: {"size": size, "device": "cpu"} for agent, size in of.items()}

    return kind(
        possible_agents=env.possible_agents,
        models=models,
        memories=memories,
        observation_spaces=env.observation_spaces,
        action_spaces=env.action_spaces,
        state_spaces=env.state_spaces,
        device="cpu",
        cfg={
            "rollouts": rollout,
            "learning_epochs": 5,
            "mini_batches": 4,
            "discount_factor": 0.995,
            "learning_rate": 3e-4,
            "learning_rate_scheduler_kwargs": {agent: {} for agent in env.possible_agents},
            "entropy_loss_scale": 0.01,
            "time_limit_bootstrap": True,
            "observation_preprocessor": RunningStandardScaler,
            "observation_preprocessor_kwargs": sizes(env.observation_spaces),
            "state_preprocessor": RunningStandardScaler,
            "state_preprocessor_kwargs": sizes(env.state_spaces),
            "value_preprocessor": RunningStandardScaler,
            "value_preprocessor_kwargs": sizes(dict.fromkeys(env.possible_agents, 1)),
            "experiment": {"write_interval": 0, "checkpoint_interval": 0},
        }
        | settings,
    )


def trainer(env: BatchEnv, agent: Any, timesteps: int) -> SequentialTrainer:
    """A trainer whose ``train`` makes ``timesteps`` steps of each environment.

    Args:
        env: the batch.
        agent: from ``learner``.
        timesteps: a multiple of the rollout, so that no rollout is cut by the reset of the next.
    """
    return SequentialTrainer(
        env=env,
        agents=agent,
        cfg={
            "timesteps": timesteps,
            "headless": True,
            "disable_progressbar": True,
            "close_environment_at_exit": False,
        },
    )


def prepare(seed: int) -> None:
    """Seeds, one thread, and warnings alone on the terminal."""
    torch.set_num_threads(1)  # faster than two for networks of this size
    logger.setLevel(logging.WARNING)
    set_seed(seed)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="ippo")
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1_000_000, help="of all environments together")
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollout", type=int, default=48, help="steps between updates")
    parser.add_argument("--hidden", type=int, nargs="+", default=[64, 64])
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    prepare(given.seed)
    batch = sdc_taichi.vector_env(given.num_envs, days=given.days, autoreset_mode="SameStep")
    env = BatchEnv(batch, given.seed)
    agent = learner(env, given.algorithm, rollout=given.rollout, hidden=given.hidden)
    rollouts = max(1, given.steps // (given.num_envs * given.rollout))
    start = time.perf_counter()
    trainer(env, agent, rollouts * given.rollout).train()
    speed = rollouts * given.rollout * given.num_envs / (time.perf_counter() - start)
    env.close()
    print(f"{given.algorithm}: {speed:,.0f} steps/s with {given.num_envs} data centers")
    rewards = np.array(env.rewards)
    first, last = rewards[: given.rollout].mean(0), rewards[-given.rollout :].mean(0)
    for name, before, after in zip(env.possible_agents, first, last, strict=True):
        print(f"{name}: mean reward {before:.4f} in the first rollout, {after:.4f} in the last")


if __name__ == "__main__":
    main()
