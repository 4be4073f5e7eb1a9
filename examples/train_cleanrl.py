"""PPO in one file, in the manner of CleanRL, on all three agents as one learner.

    python examples/train_cleanrl.py [--num-envs 256] [--steps 1000000]

Needs torch and the native batch of ``gymnasium.make_vec``, nothing else. Proximal policy
optimisation (J. Schulman et al., 2017) with generalised advantage estimation (J. Schulman et al.,
2016); the policy has three probabilities for each agent, and observations and returns are
normalised. Episodes are cut off rather than over, so the critic values what each ended with.
Prints the mean episode return of idling and of the policy before and after training.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from torch import nn

import sdc_taichi  # noqa: F401  registers the environments

Array = npt.NDArray[Any]
DISCOUNT, TRACE = 0.995, 0.95
LEARNING_RATE, EPOCHS, MINIBATCHES = 1e-3, 5, 4
CLIP, ENTROPY, LARGEST_GRADIENT = 0.2, 0.005, 0.5


class Moments:
    """Running mean and variance of columns, by which numbers are scaled."""

    def __init__(self, width: int) -> None:
        self.mean, self.variance, self.count = torch.zeros(width), torch.ones(width), 1e-4

    def update(self, rows: torch.Tensor) -> None:
        """Take in rows, (N, width)."""
        share = len(rows) / (self.count + len(rows))
        change = rows.mean(0) - self.mean
        spread = rows.var(0, correction=0) - self.variance + (1 - share) * change**2
        self.mean, self.variance = self.mean + share * change, self.variance + share * spread
        self.count += len(rows)

    def scaled(self, rows: torch.Tensor) -> torch.Tensor:
        """Rows with mean 0 and variance 1."""
        return (rows - self.mean) / (self.variance + 1e-8).sqrt()


class ActorCritic(nn.Module):
    """Policy and critic of a learner that makes choices among three actions.

    Args:
        env: the batch.
        seed: decides weights and actions.
    """

    def __init__(self, env: Any, seed: int) -> None:
        super().__init__()
        width, choices = env.single_observation_space.shape[0], env.single_action_space.shape[0]
        self.random, self.choices = torch.Generator().manual_seed(seed), choices
        self.inputs, self.returns = Moments(width), Moments(1)
        self.actor = perceptron(width, 3 * choices, 0.01, self.random)
        self.critic = perceptron(width, 1, 1.0, self.random)

    def policy(self, inputs: torch.Tensor) -> torch.Tensor:
        """Log probability of each action, (N, k, 3)."""
        return self.actor(inputs).unflatten(-1, (self.choices, 3)).log_softmax(-1)

    def value(self, inputs: torch.Tensor) -> torch.Tensor:
        """Expected return, (N,)."""
        scaled = self.critic(inputs)
        return (scaled * (self.returns.variance + 1e-8).sqrt() + self.returns.mean).squeeze(-1)

    def best(self, observations: Array) -> Array:
        """The most probable actions, (N, k)."""
        with torch.no_grad():
            policy = self.policy(self.inputs.scaled(torch.from_numpy(observations)))
        return np.asarray(policy.argmax(-1))


def perceptron(width: int, out: int, gain: float, random: torch.Generator) -> nn.Sequential:
    """Two layers of 64 tanh units and a linear one, its weights times ``gain``."""
    layers = [nn.Linear(width, 64), nn.Linear(64, 64), nn.Linear(64, out)]
    for layer, scale in zip(layers, (2**0.5, 2**0.5, gain), strict=True):
        nn.init.orthogonal_(layer.weight, scale, generator=random)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


def chosen(policy: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """Log probability of the actions that a learner takes together, (N,)."""
    return policy.gather(-1, actions.unsqueeze(-1)).sum((-2, -1))


def collect(
    env: Any, agent: ActorCritic, observations: Array, rollout: int
) -> tuple[list[torch.Tensor], Array]:
    """Inputs, actions, their log probabilities, advantages and returns, and last observations.

    All are over the steps of all environments, (T·B, ...). Where an episode was cut off, its reward
    includes the discounted value of its last observation.
    """
    steps = []
    for _ in range(rollout):
        rows = torch.from_numpy(observations)
        agent.inputs.update(rows)
        inputs = agent.inputs.scaled(rows)
        policy = agent.policy(inputs)
        actions = torch.multinomial(policy.exp().flatten(0, 1), 1, generator=agent.random)
        actions = actions.view(len(rows), -1)
        observations, paid, _, truncated, infos = env.step(actions.numpy())
        rewards = torch.from_numpy(paid).float()
        if "final_obs" in infos:
            last = agent.inputs.scaled(torch.from_numpy(np.stack(infos["final_obs"])))
            rewards += DISCOUNT * agent.value(last)
        goes_on = 1.0 - torch.from_numpy(truncated).float()
        taken = chosen(policy, actions)
        steps.append((inputs, actions, taken, rewards, goes_on, agent.value(inputs)))
    inputs, actions, taken, rewards, goes_on, values = map(torch.stack, zip(*steps, strict=True))
    after = agent.value(agent.inputs.scaled(torch.from_numpy(observations)))
    advantages, later = torch.empty_like(values), torch.zeros_like(after)
    for t in reversed(range(rollout)):
        surprise = rewards[t] + DISCOUNT * goes_on[t] * after - values[t]
        advantages[t] = later = surprise + DISCOUNT * TRACE * goes_on[t] * later
        after = values[t]
    found = (inputs, actions, taken, advantages, advantages + values)
    return [numbers.flatten(0, 1) for numbers in found], observations


def update(agent: ActorCritic, optimiser: torch.optim.Optimizer, steps: list[torch.Tensor]) -> None:
    """Some epochs of the clipped objective over what ``collect`` found."""
    agent.returns.update(steps[-1].unsqueeze(-1))
    steps[-1] = agent.returns.scaled(steps[-1])
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(steps[0]), generator=agent.random).chunk(MINIBATCHES):
            inputs, actions, taken, gain, returns = (numbers[rows] for numbers in steps)
            policy = agent.policy(inputs)
            ratio = (chosen(policy, actions) - taken).exp()
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            objective = torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain)
            entropy = -(policy.exp() * policy).sum((-2, -1))
            error = (agent.critic(inputs).squeeze(-1) - returns).square()
            optimiser.zero_grad()
            (0.5 * error - objective - ENTROPY * entropy).mean().backward()
            nn.utils.clip_grad_norm_(agent.parameters(), LARGEST_GRADIENT)
            optimiser.step()


def train(env: Any, *, steps: int, rollout: int, seed: int) -> ActorCritic:
    """A policy trained for at least one rollout.

    Args:
        env: a batch that starts episodes in the step that ends the last ones.
        steps: of all environments together.
        rollout: steps of each environment between updates.
        seed: decides episodes, weights and actions.
    """
    agent = ActorCritic(env, seed)
    optimiser = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    observations, _ = env.reset(seed=seed)
    for _ in range(max(1, steps // (rollout * env.num_envs))):
        with torch.no_grad():
            found, observations = collect(env, agent, observations, rollout)
        update(agent, optimiser, found)
    return agent


def score(env: Any, act: Callable[[Array], Array], seed: int) -> float:
    """Mean return of the episodes that begin with a seed."""
    observations, _ = env.reset(seed=seed)
    total, ended = 0.0, False
    while not ended:
        observations, rewards, _, truncated, _ = env.step(act(observations))
        total, ended = total + float(rewards.mean()), bool(truncated.all())
    return total


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1_000_000, help="of all environments together")
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollout", type=int, default=48, help="steps between updates")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)  # faster than two for networks of this size
    options: dict[str, Any] = {"days": given.days, "autoreset_mode": "SameStep"}
    env = gymnasium.make_vec("sdc_taichi/Joint-v0", num_envs=given.num_envs, **options)
    untrained, start = ActorCritic(env, given.seed), time.perf_counter()
    trained = train(env, steps=given.steps, rollout=given.rollout, seed=given.seed)
    print(f"{given.steps / (time.perf_counter() - start):,.0f} steps/s")
    # The action in the middle of three changes nothing.
    idle = np.ones((given.num_envs, trained.choices), np.int64)
    for name, act in (
        ("idle", lambda _: idle),
        ("untrained", untrained.best),
        ("trained", trained.best),
    ):
        print(f"{name}: mean episode return {score(env, act, given.seed + given.num_envs):.3f}")
    env.close()


if __name__ == "__main__":
    main()
