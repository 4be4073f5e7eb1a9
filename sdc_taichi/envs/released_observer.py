"""Observation vectors of the released SustainDC, batched."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Box

from sdc_taichi.control.view import View
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.features import AGE_EDGES_H
from sdc_taichi.envs.observer import EntryOrder
from sdc_taichi.envs.released_features import (
    ENTRY_NUMBERS,
    FEATURES,
    MEASURED_FEATURES,
    TIME_FEATURES,
    cut,
    ranges,
)
from sdc_taichi.envs.released_rows import ReleasedRows, ScaledEpisode
from sdc_taichi.errors import RuntimeStateError
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS, TASKS_PER_STEP, age_histogram
from sdc_taichi.types import F32, F64, I64

_LOW, _HIGH = (side[:, None] for side in ranges(MEASURED_FEATURES))
_ORDERS = {
    agent: EntryOrder([ENTRY_NUMBERS[f.name] for f in features], len(TIME_FEATURES))
    for agent, features in FEATURES.items()
}


class _Entries(NamedTuple):
    """Entries of all agents' vectors in one view."""

    view: View
    """The view that was observed."""
    time: F32
    """Time entries as rows that data centers share, (rows, n)."""
    measured: F32
    """Entries of queue and battery, (m, B)."""


class ReleasedObserver:
    """Observation vectors of the released code, with 26, 14 and 13 entries.

    The inputs are taken from the drivers as they are; the released code cuts its dry bulb at 0 C
    and 45 C beforehand. An input that is constant over the 30 days from the first step has no range
    and reads 0. Entries outside the ranges of ``FEATURES`` are cut at them.

    Args:
        agents: agents whose vectors are wanted.

    Attributes:
        features: entries of each agent, in the order of its vector.
        spaces: space of each agent's vector.
        state_space: space of the vectors of all agents side by side.
    """

    def __init__(self, agents: Sequence[str] = AGENTS) -> None:
        self._agents = tuple(agents)
        self.features = FEATURES
        self.spaces = {agent: Box(*ranges(features)) for agent, features in FEATURES.items()}
        self.state_space = Box(*ranges([f for agent in AGENTS for f in FEATURES[agent]]))
        self._rows: ReleasedRows | None = None
        self._episode: ScaledEpisode | None = None
        self._entries: _Entries | None = None
        self._age_edges_steps = self._queue_limit_tasks = self._capacity_kwh = np.zeros(0)

    def reset(self, view: View, keys: Sequence[int] | I64 = ()) -> None:
        """Scale the inputs by what follows the first step.

        Args:
            view: the view before the first step.
            keys: unused, as the vectors have no randomness.
        """
        if self._rows is None or not self._rows.made_for(view):
            self._rows = ReleasedRows(view)
        self._episode = ScaledEpisode(self._rows, view.drivers.start)
        self._entries = None
        per_hour = view.fleet.steps_per_hour
        self._age_edges_steps = np.array(AGE_EDGES_H) * per_hour
        limit_h = view.fleet.values("workload.queue_limit_h")
        self._queue_limit_tasks = np.where(
            np.isnan(limit_h), np.inf, limit_h * TASKS_PER_STEP * per_hour
        )
        battery_kwh = view.sizing.battery_kwh
        self._capacity_kwh = np.where(battery_kwh > 0, battery_kwh, 1.0)

    def observe(self, view: View) -> dict[str, F32]:
        """The vector of each agent before the step to come, (B, entries) each.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        return self._vectors(view, self._agents)

    def state(self, view: View) -> F32:
        """The vectors of all agents side by side, (B, m).

        Raises:
            RuntimeStateError: before ``reset``.
        """
        return np.concatenate(list(self._vectors(view, AGENTS).values()), axis=1)

    def _vectors(self, view: View, agents: Sequence[str]) -> dict[str, F32]:
        """Vectors of ``agents``; entries are computed once for each view."""
        episode, entries = self._episode, self._entries
        if episode is None:
            raise RuntimeStateError("the observer has not been reset; call reset() first")
        if entries is None or entries.view is not view:
            entries = _Entries(view, episode.at(view.state.step), self._measure(view))
            self._entries = entries
        return {
            agent: (order := _ORDERS[agent]).assemble(
                order.arrange(entries.time), episode.row_numbers, entries.measured
            )
            for agent in agents
        }

    def _measure(self, view: View) -> F32:
        """Entries in the order of ``MEASURED_FEATURES``, within their ranges, (m, B)."""
        state, last = view.state, view.last
        waiting = state.queue[:, -1].copy()
        tasks = age_histogram(state.queue, self._age_edges_steps).T
        out = np.empty((len(MEASURED_FEATURES), len(waiting)), dtype=np.float32)
        out[0] = 0.0 if last is None else last.oldest_age_h / 24.0
        out[1] = 0.0 if last is None else last.mean_age_h / 24.0
        out[2] = waiting / self._queue_limit_tasks
        out[3:7] = tasks[:-1] / _infinite_where_negligible(waiting)
        out[7] = tasks[-1] > NEGLIGIBLE_TASKS
        out[8] = state.stored_kwh / self._capacity_kwh
        return cut(out, _LOW, _HIGH)


def _infinite_where_negligible(waiting: F64) -> F64:
    """Queued tasks, (B,); infinity, of which all shares are 0, where rounding alone left some."""
    return np.where(waiting > NEGLIGIBLE_TASKS, waiting, np.inf)
