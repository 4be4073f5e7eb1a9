"""skrl's MAPPO on all three agents of a batch of data centers.

    python examples/train_skrl.py [--num-envs 64] [--steps 200000]

``BatchWrapper`` makes a multi-agent batch the environment of skrl, without a Python environment for
each data center; critics see the shared state. Prints the mean reward of each agent untrained and
trained, in episodes that were not trained on.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from skrl.envs.wrappers.torch import MultiAgentEnvWrapper
from skrl.memories.torch import RandomMemory
from skrl.models.torch import CategoricalMixin, DeterministicMixin, Model
from skrl.multi_agents.torch.mappo import MAPPO, MAPPO_CFG
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg
from skrl.utils import set_seed

import sdc_taichi
from sdc_taichi.envs.vector import MultiAgentVectorEnv

Tensors = dict[str, torch.Tensor]


class BatchWrapper(MultiAgentEnvWrapper):
    """A multi-agent batch as skrl expects it.

    skrl values the observations after the last step of an episode, so the batch must begin new
    episodes in the step after it.

    Args:
        env: batch of ``sdc_taichi.vector_env`` with ``autoreset_mode="NextStep"``.
        seed: seed of the first reset.
    """

    def __init__(self, env: MultiAgentVectorEnv, seed: int) -> None:
        super().__init__(env)
        self._seed: int | None = seed

    def reset(self) -> tuple[Tensors, dict[str, Any]]:
        """Return first observations, (B, n) for each agent; later resets continue the seed."""
        observations, _ = self._env.reset(seed=self._seed)
        self._seed = None
        return self._tensors(observations), {}

    def step(self, actions: Tensors) -> tuple[Tensors, Tensors, Tensors, Tensors, dict[str, Any]]:
        """Return observations, and rewards and ends of episodes as columns (B, 1)."""
        chosen = {agent: x.squeeze(-1).numpy() for agent, x in actions.items()}
        observations, *results, _ = self._env.step(chosen)
        rewards, terminated, truncated = (
            {agent: x.unsqueeze(-1) for agent, x in self._tensors(result).items()}
            for result in results
        )
        rewards = {agent: x.float() for agent, x in rewards.items()}
        return self._tensors(observations), rewards, terminated, truncated, {}

    def state(self) -> Tensors:
        """Return the shared state, (B, n), for each agent."""
        return dict.fromkeys(self.possible_agents, torch.from_numpy(self._env.state()))

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Show nothing; the option ``recorder`` records episodes."""

    def close(self) -> None:
        """Close the batch."""
        self._env.close()

    def _tensors(self, arrays: Mapping[str, Any]) -> Tensors:
        return {agent: torch.from_numpy(x) for agent, x in arrays.items()}


def network(inputs: int, outputs: int) -> torch.nn.Sequential:
    """Return a network with two hidden layers of 64."""
    return torch.nn.Sequential(
        torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh(),
        torch.nn.Linear(64, outputs),
    )  # fmt: skip


class Actor(CategoricalMixin, Model):
    """Policy of one agent over its three commands."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces, device="cpu")
        CategoricalMixin.__init__(self)
        self.net = network(self.num_observations, self.num_actions)

    def compute(self, inputs: Mapping[str, Any], role: str = "") -> tuple[torch.Tensor, Any]:
        """Return logits, (B, 3)."""
        return self.net(inputs["observations"]), {}


class Critic(DeterministicMixin, Model):
    """Value of the shared state for one agent."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces, device="cpu")
        DeterministicMixin.__init__(self)
        self.net = network(self.num_states, 1)

    def compute(self, inputs: Mapping[str, Any], role: str = "") -> tuple[torch.Tensor, Any]:
        """Return values, (B, 1)."""
        return self.net(inputs["states"]), {}


def make(num_envs: int, days: int, seed: int) -> BatchWrapper:
    """Return a batch of data centers with preset ``corrected``."""
    return BatchWrapper(sdc_taichi.vector_env(num_envs, days=days, autoreset_mode="NextStep"), seed)


def print_rewards(moment: str, learner: MAPPO, num_envs: int, days: int, seed: int) -> None:
    """Print the mean reward of each agent in an episode of most probable actions."""
    env = make(num_envs, days, seed)
    observations, _ = env.reset()
    sums = dict.fromkeys(env.possible_agents, 0.0)
    with torch.no_grad():
        for _ in range(env.core.steps):
            _, outputs = learner.act(observations, env.state(), timestep=0, timesteps=0)
            best = {a: out["net_output"].argmax(-1, keepdim=True) for a, out in outputs.items()}
            observations, rewards, *_ = env.step(best)
            for agent, reward in rewards.items():
                sums[agent] += reward.mean().item() / env.core.steps
    env.close()
    print(f"{moment}: mean reward " + ", ".join(f"{a} {x:.4f}" for a, x in sums.items()))


def train(num_envs: int, steps: int, days: int, rollout: int, seed: int) -> None:
    """Train, and print mean rewards of other seeds before and after."""
    torch.set_num_threads(1)  # faster than two for networks of this size
    set_seed(seed)
    env = make(num_envs, days, seed)
    agents = env.possible_agents
    spaces = {
        agent: {
            "observation_space": env.observation_space(agent),
            "state_space": env.state_space(agent),
            "action_space": env.action_space(agent),
        }
        for agent in agents
    }
    # Arguments of what is not used; skrl 2.1 refuses its own default, an empty dictionary.
    names = ("learning_rate_scheduler", "observation_preprocessor", "state_preprocessor",
             "value_preprocessor")  # fmt: skip
    unused: Any = {f"{name}_kwargs": {agent: {} for agent in agents} for name in names}
    with tempfile.TemporaryDirectory() as folder:
        settings = MAPPO_CFG(
            rollouts=rollout, learning_epochs=5, mini_batches=4, discount_factor=0.995,
            learning_rate=3e-4, entropy_loss_scale=0.01, time_limit_bootstrap=True, **unused,
        )  # fmt: skip
        settings.experiment.directory = folder
        settings.experiment.write_interval = settings.experiment.checkpoint_interval = 0
        learner = MAPPO(
            possible_agents=agents,
            models={a: {"policy": Actor(**x), "value": Critic(**x)} for a, x in spaces.items()},
            memories={
                a: RandomMemory(memory_size=rollout, num_envs=num_envs, device="cpu")
                for a in agents
            },
            observation_spaces={a: x["observation_space"] for a, x in spaces.items()},
            state_spaces=env.state_spaces,
            action_spaces={a: x["action_space"] for a, x in spaces.items()},
            device="cpu",
            cfg=settings,
        )
        trainer = SequentialTrainer(
            cfg=SequentialTrainerCfg(
                timesteps=max(steps // num_envs, rollout), headless=True,
                disable_progressbar=True, close_environment_at_exit=False,
            ),
            env=env,
            agents=learner,
        )  # fmt: skip
        print_rewards("untrained", learner, num_envs, days, seed + num_envs)
        trainer.train()
        print_rewards("trained", learner, num_envs, days, seed + num_envs)
    env.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=64, help="at least 2")
    parser.add_argument("--steps", type=int, default=200_000, help="of all environments together")
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollout", type=int, default=96, help="steps between updates")
    parser.add_argument("--seed", type=int, default=0)
    train(**vars(parser.parse_args(arguments)))


if __name__ == "__main__":
    main()
