"""Behaviour cloning: policies learn the actions that an expert would take in their situations.

In the first update the expert acts. In later ones policies may, and the expert tells what it would
do where they have come to (DAgger; Ross, Gordon, Bagnell 2011); each update learns from its own
situations alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from sdc_taichi.control import Controller
from sdc_taichi.learning.networks import perceptron, policy_network
from sdc_taichi.learning.normalise import RunningMoments
from sdc_taichi.learning.policy import PolicyNetwork
from sdc_taichi.learning.settings import CloningSettings
from sdc_taichi.learning.stream import EnvironmentStream, LearnerSpaces


class Cloning:
    """Behaviour cloning of an expert; an update is an episode of each data center.

    Args:
        settings: the settings.
        expert: the controller to imitate.
        spaces: what each learner sees and does.
        episode_steps: number of steps of an episode.
        updates: number of updates of the whole training.
        seed: seed of all that is drawn.

    Attributes:
        steps_per_update: steps of each data center per update.
    """

    def __init__(
        self,
        settings: CloningSettings,
        expert: Controller,
        spaces: Mapping[str, LearnerSpaces],
        *,
        episode_steps: int,
        updates: int,
        seed: int,
    ) -> None:
        self._settings, self._spaces, self._updates = settings, dict(spaces), updates
        self.steps_per_update = episode_steps
        self._done = 0
        self._expert = expert
        self._generator = torch.Generator().manual_seed(seed)
        self._nets: dict[str, nn.Sequential] = {}
        self._adams: dict[str, torch.optim.Adam] = {}
        self._moments: dict[str, RunningMoments] = {}
        for name, of in self._spaces.items():
            self._nets[name] = net = perceptron(
                of.observation_width,
                settings.hidden,
                of.action_width * (of.choices or 1),
                activation=settings.activation,
                last_gain=0.01,
                generator=self._generator,
            )
            self._adams[name] = torch.optim.Adam(net.parameters(), settings.rate)
            self._moments[name] = RunningMoments(of.observation_width)

    def update(self, stream: EnvironmentStream) -> dict[str, float]:
        """Run an episode, and fit the policies to the actions of the expert in it.

        Args:
            stream: the environments, at the beginning of an episode.

        Returns:
            Numbers to log: ``reward/NAME``, the mean over steps; ``policy_loss/NAME``;
            ``agreement/NAME``, the share of numbers that the policy chose, or came within 0.1 of,
            as the expert would.
        """
        observations, advice, logged = self._collect(stream)
        self._done += 1
        rate = 1.0 - (self._done - 1) / max(self._updates, 1)
        for name in self._spaces:
            if self._done == 1:
                self._moments[name].add(observations[name])
            seen = self._moments[name].normalise(observations[name])
            for group in self._adams[name].param_groups:
                group["lr"] = self._settings.rate * rate
            logged |= self._fit(name, seen, advice[name])
        return logged

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """The policies as they are."""
        activation = self._settings.activation
        return tuple(
            policy_network(self._nets[name], self._moments[name], of, activation)
            for name, of in self._spaces.items()
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides how the training goes on."""
        return {
            "done": self._done,
            "generator": self._generator.get_state(),
            "learners": {
                name: {
                    "net": self._nets[name].state_dict(),
                    "adam": self._adams[name].state_dict(),
                    "moments": self._moments[name].state_dict(),
                }
                for name in self._spaces
            },
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Go on from what ``state_dict`` returned, of an algorithm made alike."""
        self._done = int(values["done"])
        self._generator.set_state(values["generator"])
        for name, of in values["learners"].items():
            self._nets[name].load_state_dict(of["net"])
            self._adams[name].load_state_dict(of["adam"])
            self._moments[name].load_state_dict(of["moments"])

    def _collect(
        self, stream: EnvironmentStream
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, float]]:
        """Observations and the expert's actions of an episode, (T * B, n or k), and numbers."""
        self._expert.reset(stream.view.state.seed)
        seen: dict[str, list[Tensor]] = {name: [] for name in self._spaces}
        told: dict[str, list[Tensor]] = {name: [] for name in self._spaces}
        rewards = dict.fromkeys(self._spaces, 0.0)
        draws = torch.rand(stream.size, 1, generator=self._generator)
        by_policy = draws < (self._settings.policy_share if self._done else 0.0)
        ended = False
        while not ended:
            advice = stream.actions_of(self._expert.act(stream.view))
            for name in self._spaces:
                seen[name].append(stream.observations[name])
                told[name].append(advice[name])
            actions = advice
            if by_policy.any():
                own = self._actions(stream)
                actions = {n: torch.where(by_policy, own[n], advice[n]) for n in own}
            after = stream.step(actions)
            ended = after.ended
            for name, reward in after.rewards.items():
                rewards[name] += float(reward.mean()) / self.steps_per_update
        return (
            {name: torch.cat(rows) for name, rows in seen.items()},
            {name: torch.cat(rows) for name, rows in told.items()},
            {f"reward/{name}": mean for name, mean in rewards.items()},
        )

    def _actions(self, stream: EnvironmentStream) -> dict[str, Tensor]:
        """Actions of the policies, (B, k) each."""
        actions = {}
        for name, of in self._spaces.items():
            with torch.no_grad():
                out = self._nets[name](self._moments[name].normalise(stream.observations[name]))
            actions[name] = _actions(out, of.choices)
        return actions

    def _fit(self, name: str, seen: Tensor, advice: Tensor) -> dict[str, float]:
        """Fit a network to the expert's actions, in several passes; loss and agreement to log."""
        net, adam, choices = self._nets[name], self._adams[name], self._spaces[name].choices
        total = torch.zeros(2)
        count = 0
        for _ in range(self._settings.epochs):
            order = torch.randperm(len(seen), generator=self._generator)
            for batch in order.split(self._settings.batch_size):
                out = net(seen[batch])
                loss = cloning_loss(out, advice[batch], choices)
                adam.zero_grad()
                loss.backward()
                adam.step()
                total += torch.stack(
                    [loss.detach(), _agreement(_actions(out.detach(), choices), advice[batch])]
                )
                count += 1
        loss_mean, agreement = (total / count).tolist()
        return {f"policy_loss/{name}": loss_mean, f"agreement/{name}": agreement}


def cloning_loss(outputs: Tensor, advice: Tensor, choices: int | None) -> Tensor:
    """Cross-entropy of choices, or half the mean squared error of numbers.

    Args:
        outputs: outputs of a policy's network, (n, k * choices), or (n, k) for numbers.
        advice: actions of the expert, (n, k).
        choices: number of choices; None for numbers.
    """
    if choices is None:
        return 0.5 * (outputs - advice).square().mean()
    scores = outputs.unflatten(-1, (-1, choices)).transpose(1, 2)
    return nn.functional.cross_entropy(scores, advice)


def _actions(outputs: Tensor, choices: int | None) -> Tensor:
    """Actions, (n, k): numbers of choices, or numbers within -1..1."""
    if choices is None:
        return outputs.clamp(-1.0, 1.0)
    return outputs.unflatten(-1, (-1, choices)).argmax(-1)


def _agreement(actions: Tensor, advice: Tensor) -> Tensor:
    """Share of actions that are those of the expert; numbers may be a tenth off."""
    return ((actions - advice).abs() < 0.1).float().mean()
