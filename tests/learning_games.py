"""Games with known answers, as streams of transitions for tests of learners."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from sdc_taichi.learning.algorithms import (
    CrossEntropySettings,
    OffPolicySettings,
    OnPolicySettings,
)
from sdc_taichi.learning.stream import LearnerSpaces, StreamStep


def chosen(learner: Any, observation: Tensor) -> list[float]:
    """Choices or numbers of all players from one observation, (n,), side by side."""
    seen = observation[None].numpy()
    return [float(x) for network in learner.networks() for x in network.actions(seen)[0]]


COMMON: dict[str, Any] = {"decision_steps": 1, "hidden": (16,), "discount": 0.9, "anneal": False}
ON = OnPolicySettings(**COMMON, rollout_decisions=6, rate=0.05, epochs=3, mini_batches=1)
OFF = OffPolicySettings(
    **COMMON, rollout_decisions=2, gradient_steps=2, batch_size=64, replay_size=2048, n_steps=1,
    rate=0.01, target_rate=0.05, temperature=0.1,
)  # fmt: skip
SEARCH = CrossEntropySettings(decision_steps=1, candidates=16)


def weights(learner: Any) -> list[np.ndarray[Any, Any]]:
    """Weights and biases of all policies."""
    return [array for net in learner.networks() for layer in net.layers for array in layer]


def assert_same_bits(one: Any, other: Any) -> None:
    """All policies of two learners are equal to the bit."""
    for mine, others in zip(weights(one), weights(other), strict=True):
        np.testing.assert_array_equal(mine, others)


class Game:
    """A game of several players in many tables at once, whose rooms all of them see.

    All players are paid the same, and the shared state is what each observes. Episodes begin in
    room 0 and are cut off together.

    Args:
        players: number of players.
        discrete: whether players choose among three, or else numbers within -1..1.
        width: numbers that a player decides.
    """

    size: int = 32
    rooms: ClassVar = 1
    length: ClassVar = 2

    def __init__(self, players: int = 1, discrete: bool = True, width: int = 1) -> None:
        names = [f"player_{i}" for i in range(players)]
        self.spaces = {
            n: LearnerSpaces((n,), self.rooms, width, 3 if discrete else None) for n in names
        }
        self.learners = tuple(names)
        self.state_width = self.rooms
        self.masks: dict[str, Tensor] = {}
        self.room = torch.zeros(self.size, dtype=torch.int64)
        self.turn = 0

    @property
    def episode_steps(self) -> int:
        return self.length

    @property
    def state(self) -> Tensor:
        return torch.nn.functional.one_hot(self.room, self.rooms).float()

    @property
    def observations(self) -> dict[str, Tensor]:
        return {name: self.state for name in self.spaces}

    def play(self, room: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Pay of each table and its next room, of actions of all players, (B, players * k)."""
        raise NotImplementedError

    def pay(self, player: int, pay: Tensor) -> Tensor:
        """What a player is paid, (B,)."""
        return pay

    def first_room(self) -> Tensor:
        """Rooms that the next episodes begin in, (B,)."""
        return torch.zeros_like(self.room)

    def step(self, actions: dict[str, Tensor]) -> StreamStep:
        pay, self.room = self.play(self.room, torch.cat(list(actions.values()), 1))
        after = self.observations, self.state
        self.turn += 1
        ended = self.turn % self.length == 0
        if ended:
            self.room = self.first_room()
        rewards = {name: self.pay(i, pay) for i, name in enumerate(self.spaces)}
        team = torch.stack(list(rewards.values())).mean(0)
        return StreamStep(rewards, rewards, team, ended, *after, self.masks)

    def state_dict(self) -> dict[str, Any]:
        return {"room": self.room.clone(), "turn": self.turn}

    def load_state_dict(self, values: dict[str, Any]) -> None:
        self.room, self.turn = values["room"].clone(), values["turn"]


class Meeting(Game):
    """Choices are paid best as 0, 1, 2, 0 ..., and less with each that differs."""

    def play(self, room: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        right = actions == torch.arange(actions.shape[1]) % 3
        return right.float().mean(1), room


class Coordination(Game):
    """The reward of two players is highest where both choose 0, which no player leaves alone.

    Against a player who chooses at random, 2 is better.
    """

    rewards = torch.tensor([[5.0, -3.0, 4.0], [-3.0, 1.0, 2.0], [4.0, 2.0, 3.0]])

    def play(self, room: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        return self.rewards[actions[:, 0], actions[:, 1]], room


class Temptation(Game):
    """Each choice pays its player as much as it is high, and costs the other player twice that."""

    def play(self, room: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        choices = actions.float()
        return choices - 2.0 * choices.flip(1), room

    def pay(self, player: int, pay: Tensor) -> Tensor:
        return pay[:, player]


class Patience(Game):
    """Choice 0 pays 1 at once; choice 2 pays nothing, and leads to a room where any pays 3."""

    rooms = 2

    def play(self, room: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        choice = actions[:, 0]
        pay = torch.where(room == 1, 3.0, (choice == 0).float())
        return pay, ((room == 0) & (choice == 2)).long()


class Aim(Game):
    """Numbers are paid best as 0.5 and -0.5 in turn."""

    def play(self, room: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        aim = torch.tensor([0.5, -0.5]).repeat(actions.shape[1])[: actions.shape[1]]
        return -(actions - aim).square().sum(1), room


class Rooms(Game):
    """Chance leads from room to room, and what is paid depends on the room, action and player."""

    rooms = 3
    length = 5

    def __init__(self, players: int = 1, discrete: bool = True, width: int = 1) -> None:
        super().__init__(players, discrete, width)
        self.chance = torch.Generator().manual_seed(7)

    def play(self, room: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        pay = (room + 1.0) * actions.float().sum(1)
        return pay, torch.randint(0, self.rooms, room.shape, generator=self.chance)

    def pay(self, player: int, pay: Tensor) -> Tensor:
        return pay * (player + 1.0)

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"chance": self.chance.get_state()}

    def load_state_dict(self, values: dict[str, Any]) -> None:
        super().load_state_dict(values)
        self.chance.set_state(values["chance"])


class Turnstile(Game):
    """Room 0 pays 1 for ever and room 1 nothing; episodes of 5 steps begin in one and the other."""

    rooms = 2
    length = 5

    def play(self, room: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        return (room == 0).float(), room

    def first_room(self) -> Tensor:
        return torch.full_like(self.room, (self.turn // self.length) % 2)


class Crowd(Game):
    """A group of three agents beside a player; an agent sees its kind, which is its best choice.

    Args:
        down: agents of the group without effect, whose observations and rewards are random.
        alone: whether the agents are those of three times as many tables, without the player.
        discrete: whether agents choose among three, or else numbers within -1..1.
    """

    rooms = 3
    count: ClassVar = 3

    def __init__(
        self, down: tuple[int, ...] = (), *, alone: bool = False, discrete: bool = True
    ) -> None:
        super().__init__(1, discrete)
        choices = 3 if discrete else None
        group = LearnerSpaces(("group",), 3, 1, choices, 1 if alone else self.count, bool(down))
        self.spaces = {"group": group} if alone else {"group": group} | self.spaces
        self.learners = tuple(self.spaces)
        self.alone, self.noise = alone, torch.Generator().manual_seed(0)
        self.acting = torch.ones(Game.size, self.count, dtype=torch.bool)
        self.acting[:, list(down)] = False
        if down:
            self.masks = {"group": self.acting.flatten()}
        if alone:
            self.size = Game.size * self.count

    @property
    def state(self) -> Tensor:
        return torch.ones(self.size, self.rooms)

    @property
    def observations(self) -> dict[str, Tensor]:
        kinds = torch.arange(self.count).repeat(Game.size)
        seen = torch.nn.functional.one_hot(kinds, 3).float()
        random = torch.rand(seen.shape, generator=self.noise)
        seen = torch.where(self.acting.flatten()[:, None], seen, random)
        return {"group": seen} if self.alone else {"group": seen, "player_0": self.state}

    def step(self, actions: dict[str, Tensor]) -> StreamStep:
        kinds = torch.arange(self.count).repeat(Game.size)
        pay = -(actions["group"][:, 0].float() - kinds).abs()
        random = torch.rand(pay.shape, generator=self.noise)
        acting = self.acting.flatten()
        by_table = (pay * acting).view(self.size, -1).sum(1) / self.count
        rewards, means = {"group": torch.where(acting, pay, random)}, {"group": by_table}
        if not self.alone:
            rewards["player_0"] = means["player_0"] = by_table + actions["player_0"][:, 0]
        team = torch.stack(list(means.values())).mean(0)
        self.turn += 1
        ended = self.turn % self.length == 0
        after = self.observations, self.state, self.masks
        return StreamStep(rewards, means, team, ended, *after)
