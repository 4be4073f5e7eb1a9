"""Latest steps of all environments, from which batches of transitions are drawn at random."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sdc_taichi.errors import ConfigError, SdcError


class Transitions(NamedTuple):
    """N transitions over one step or several."""

    before: Tensor
    """Situations before the first step, (N, width)."""
    actions: Tensor
    """Actions of the first step, (N, actions)."""
    returns: Tensor
    """Discounted sum of the rewards of the steps, (N,)."""
    steps: Tensor
    """Number of steps, at least 1, (N,)."""
    after: Tensor
    """Situations after the last step, (N, width)."""


class Replay:
    """Latest steps of B environments; their episodes are cut off together.

    The situation that an episode was cut off in has a row of its own, without actions. So the row
    after a step always holds what followed it, and each situation is held once.

    Args:
        size: largest number of situations of all environments together.
        num_envs: number of environments, B.
        width: entries of a situation, which is what all learners and the critic see.
        actions: numbers that are decided in each step.
        steps: largest number of steps of a transition, n.
        discount: weight of a reward one step later.

    Attributes:
        rows: situations in time, at most.
        filled: situations in time, so far.
        num_envs: number of environments, B.

    Raises:
        ConfigError: a size that holds no transition of n steps.
    """

    def __init__(
        self, size: int, num_envs: int, width: int, actions: int, *, steps: int, discount: float
    ) -> None:
        self.rows, self.num_envs = size // num_envs, num_envs
        least = steps + 2
        if self.rows < least:
            raise ConfigError(
                f"learning.replay_size {size}: holds {self.rows} steps of {num_envs} data centers; "
                f"valid is at least {least * num_envs}"
            )
        self._width, self._steps, self._discount = width, steps, discount
        # Situation, actions and reward side by side, so that a draw reads memory in one place.
        self._data = torch.empty(self.rows, num_envs, width + actions + 1)
        self._is_end = torch.zeros(self.rows, dtype=torch.bool)
        self._count = 0
        self._starts: Tensor | None = None
        self._spans = torch.empty(0, dtype=torch.int64)

    @property
    def filled(self) -> int:
        """Number of steps and ends of episodes that are held."""
        return min(self._count, self.rows)

    @property
    def bytes(self) -> int:
        """Memory of the replay, in bytes."""
        return int(self._data.element_size() * self._data.numel())

    def add(self, situations: Tensor, actions: Tensor, rewards: Tensor) -> None:
        """Append a step of all environments.

        Args:
            situations: situations before the step, (B, width).
            actions: (B, actions).
            rewards: (B,).
        """
        row = self._next_row(is_end=False)
        row[:, : self._width] = situations
        row[:, self._width : -1] = actions
        row[:, -1] = rewards

    def end(self, situations: Tensor) -> None:
        """Append the situations, (B, width), in which all episodes were cut off."""
        row = self._next_row(is_end=True)
        row[:, : self._width] = situations
        row[:, self._width :] = 0.0

    def sample(self, number: int, generator: torch.Generator) -> Transitions:
        """Draw transitions, all equally likely.

        One that meets the end of its episode, or the latest step, is as long as it can be.

        Args:
            number: how many, N.
            generator: source of the draws.

        Raises:
            SdcError: fewer than two situations in time.
        """
        if self._starts is None:
            self._starts = self._find_starts()
        draws = torch.randint(
            len(self._starts) * self.num_envs, (number,), generator=generator, dtype=torch.int64
        )
        at = self._starts[draws // self.num_envs]
        environment = draws % self.num_envs
        span = self._spans[at]
        data = self._data.view(-1, self._data.shape[-1])
        first = data.index_select(0, at * self.num_envs + environment)
        later = (at + span) % self.rows * self.num_envs + environment
        after = data.index_select(0, later)[:, : self._width]
        returns = first[:, -1].clone()
        for step in range(1, self._steps):
            row = (at + step) % self.rows
            reward = data[row * self.num_envs + environment, -1]
            returns += torch.where(step < span, self._discount**step * reward, 0.0)
        return Transitions(
            first[:, : self._width], first[:, self._width : -1], returns, span, after
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that ``load_state_dict`` needs."""
        return {
            "data": self._data[: self.filled],
            "is_end": self._is_end[: self.filled],
            "count": self._count,
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Go on from what ``state_dict`` of a replay made alike returned.

        Raises:
            SdcError: made by another replay.
        """
        data = torch.as_tensor(values["data"])
        filled = min(int(values["count"]), self.rows)
        expected = (filled, *self._data.shape[1:])
        if tuple(data.shape) != expected:
            raise SdcError(f"state: replay is {tuple(data.shape)}; valid is {expected}")
        self._count = int(values["count"])
        self._data[:filled] = data
        self._is_end[:filled] = torch.as_tensor(values["is_end"])
        self._starts = None

    def _next_row(self, *, is_end: bool) -> Tensor:
        """The row to write to, (B, columns)."""
        at = self._count % self.rows
        self._is_end[at] = is_end
        self._count += 1
        self._starts = None
        return self._data[at]

    def _find_starts(self) -> Tensor:
        """Rows that a transition can start from; sets how many steps it has from each row."""
        in_time = torch.arange(self._count - self.filled, self._count)
        stops = self._is_end[in_time % self.rows].clone()
        stops[-1] = True
        after_all = len(in_time)
        next_stop = torch.where(stops, torch.arange(after_all), after_all)
        next_stop = next_stop.flip(0).cummin(0).values.flip(0)
        spans = (next_stop - torch.arange(after_all)).clamp_max(self._steps)
        self._spans = torch.zeros(self.rows, dtype=torch.int64)
        self._spans[in_time % self.rows] = spans
        starts = (in_time % self.rows)[~stops]
        if not len(starts):
            raise SdcError("replay: no transitions yet; valid is after two steps")
        return starts
