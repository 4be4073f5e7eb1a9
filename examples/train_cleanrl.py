"""Independent PPO in a single file, to copy and change, in the manner of CleanRL.

    python examples/train_cleanrl.py [--num-envs 64] [--steps 200000]

Every agent has a network of its own for its commands and one for the value of its observation; all
of them learn at once on a batch of data centers. Prints the mean reward of each agent untrained and
trained, in episodes that were not trained on.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch.distributions import Categorical

import sdc_taichi

GAMMA, LAMBDA = 0.995, 0.95
CLIP, ENTROPY, VALUE = 0.2, 0.01, 0.5
EPOCHS, MINI_BATCHES, RATE = 5, 4, 1e-3


def network(inputs: int, outputs: int, last_gain: float) -> torch.nn.Sequential:
    """Return a network with two hidden layers of 64 and orthogonal weights."""
    layers: list[torch.nn.Module] = []
    for n, m, gain in ((inputs, 64, 2**0.5), (64, 64, 2**0.5), (64, outputs, last_gain)):
        layer = torch.nn.Linear(n, m)
        torch.nn.init.orthogonal_(layer.weight, gain)
        torch.nn.init.zeros_(layer.bias)
        layers += [layer, torch.nn.Tanh()]
    return torch.nn.Sequential(*layers[:-1])


class Agent(torch.nn.Module):
    """Actor and critic of one agent.

    Args:
        features: length of the observation.
        commands: number of commands.
    """

    def __init__(self, features: int, commands: int) -> None:
        super().__init__()
        self.actor, self.critic = network(features, commands, 0.01), network(features, 1, 1.0)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=RATE, eps=1e-5)

    def value(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the value of observations (..., n)."""
        return self.critic(observations).squeeze(-1)

    def update(self, data: Mapping[str, torch.Tensor]) -> None:
        """Take the gradient steps of one rollout.

        Args:
            data: observations, actions, logs of their probabilities, advantages and returns, with
                the steps of all data centers in the first axis.
        """
        size = len(data["action"])
        for _ in range(EPOCHS):
            for part in torch.randperm(size).chunk(MINI_BATCHES):
                now = {name: x[part] for name, x in data.items()}
                policy = Categorical(logits=self.actor(now["observation"]))
                ratio = (policy.log_prob(now["action"]) - now["log_prob"]).exp()
                advantage = now["advantage"]
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                gain = torch.min(
                    advantage * ratio, advantage * ratio.clamp(1 - CLIP, 1 + CLIP)
                ).mean()
                error = (self.value(now["observation"]) - now["return"]).square().mean()
                loss = VALUE * error - gain - ENTROPY * policy.entropy().mean()
                self.optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.parameters(), 0.5)
                self.optimizer.step()


def advantages(
    rewards: torch.Tensor, values: torch.Tensor, next_values: torch.Tensor, ended: torch.Tensor
) -> torch.Tensor:
    """Return generalised advantages (Schulman et al. 2016), (T, B).

    Args:
        rewards: rewards of the steps, (T, B).
        values: values of the observations before the steps, (T, B).
        next_values: values of the observations after the steps, (T, B); 0 after a termination.
        ended: True in the last step of an episode, (T, B).
    """
    errors = rewards + GAMMA * next_values - values
    result, later = torch.zeros_like(rewards), torch.zeros(rewards.shape[1])
    for t in reversed(range(len(rewards))):
        later = errors[t] + GAMMA * LAMBDA * later * ~ended[t]
        result[t] = later
    return result


def print_rewards(moment: str, agents: Mapping[str, Agent], envs: Any, seed: int) -> None:
    """Print the mean reward of each agent in an episode of most probable actions."""
    observations, _ = envs.reset(seed=seed)
    sums = dict.fromkeys(agents, 0.0)
    with torch.no_grad():
        for _ in range(envs.core.steps):
            actions = {
                name: agent.actor(torch.from_numpy(observations[name])).argmax(-1).numpy()
                for name, agent in agents.items()
            }
            observations, rewards, *_ = envs.step(actions)
            for name in agents:
                sums[name] += float(rewards[name].mean()) / envs.core.steps
    print(f"{moment}: mean reward " + ", ".join(f"{a} {x:.4f}" for a, x in sums.items()))


def train(num_envs: int, steps: int, days: int, rollout: int, seed: int) -> dict[str, Agent]:
    """Train, and print mean rewards of other seeds before and after."""
    torch.set_num_threads(1)  # faster than two for networks of this size
    torch.manual_seed(seed)
    envs: Any = sdc_taichi.vector_env(num_envs, days=days, autoreset_mode="SameStep")
    agents = {
        name: Agent(envs.observation_spaces[name].shape[0], int(envs.action_spaces[name].n))
        for name in envs.possible_agents
    }
    print_rewards("untrained", agents, envs, seed + num_envs)
    observations, _ = envs.reset(seed=seed)
    start, updates = time.perf_counter(), max(1, steps // (num_envs * rollout))
    for _ in range(updates):
        kept: dict[str, dict[str, list[torch.Tensor]]] = {
            name: {key: [] for key in ("observation", "action", "log_prob", "value",
                                       "reward", "next_value", "ended")}
            for name in agents
        }  # fmt: skip
        for _ in range(rollout):
            with torch.no_grad():
                before = {name: torch.from_numpy(observations[name]) for name in agents}
                policies = {
                    name: Categorical(logits=agent.actor(before[name]))
                    for name, agent in agents.items()
                }
                actions = {name: policy.sample() for name, policy in policies.items()}
                observations, rewards, terminated, truncated, infos = envs.step(
                    {name: action.numpy() for name, action in actions.items()}
                )
                # The observations are those of the next episode where one has ended.
                after = infos.get("final_obs", observations)
                for name, agent in agents.items():
                    end = torch.from_numpy(terminated[name])
                    next_value = agent.value(torch.from_numpy(after[name])) * ~end
                    values = (
                        before[name], actions[name], policies[name].log_prob(actions[name]),
                        agent.value(before[name]), torch.from_numpy(rewards[name]).float(),
                        next_value, end | torch.from_numpy(truncated[name]),
                    )  # fmt: skip
                    for column, value in zip(kept[name].values(), values, strict=True):
                        column.append(value)
        for name, agent in agents.items():
            data = {key: torch.stack(column) for key, column in kept[name].items()}
            advantage = advantages(
                data.pop("reward"), data["value"], data.pop("next_value"), data.pop("ended")
            )
            data |= {"advantage": advantage, "return": advantage + data.pop("value")}
            agent.update({key: x.flatten(0, 1) for key, x in data.items()})
    speed = updates * rollout * num_envs / (time.perf_counter() - start)
    print(f"{updates * rollout * num_envs} steps, {speed:,.0f} steps/s")
    print_rewards("trained", agents, envs, seed + num_envs)
    envs.close()
    return agents


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=200_000, help="of all environments together")
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollout", type=int, default=96, help="steps between updates")
    parser.add_argument("--seed", type=int, default=0)
    train(**vars(parser.parse_args(arguments)))


if __name__ == "__main__":
    main()
