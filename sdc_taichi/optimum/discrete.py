"""The best sequence of discrete actions, by a beam search over exact states.

A beam search goes through the steps with a limited number of labels and follows all commands from
each. What it leaves out is what costs most together with the rest of the run as
``discrete_values`` estimates it; while nothing has to be left out, the best label is the optimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.optimum.discrete_labels import DiscreteModel, Labels, Successors
from sdc_taichi.optimum.discrete_values import CostsToGo, costs_to_go, guide_of
from sdc_taichi.optimum.problem import Ends, Plan, Problem
from sdc_taichi.types import F64, I64

BEAM = 500
"""Labels that are kept after each step."""
PLANS = 64
"""Sequences that are returned at most."""
_BINS = 40
"""Parts of the range of queue and of stored energy of which a full beam keeps the best."""
_SLACK_TASKS = 1e-6
"""Work that rounding may leave over, in tasks."""
_SLACK_SHARE = 1e-9
"""Stored energy that rounding may leave short, over capacity."""


@dataclass(frozen=True, slots=True)
class DiscretePlans:
    """The best sequences of discrete actions that were found, best first: K sequences, T steps."""

    load: F64
    """Load commands, each -1, 0 or 1, (K, T)."""
    cooling: F64
    """Cooling commands, each -1, 0 or 1, (K, T)."""
    battery: F64
    """Battery commands, each -1, 0 or 1, (K, T)."""
    figure: F64
    """Weighed energy, water and demand of the scored steps by the table, (K,)."""
    is_complete: bool
    """Whether no state was left out, so that no sequence is better by the table."""


def discrete_plans(
    problem: Problem,
    config: DataCenterConfig,
    demand: F64,
    *,
    guide: Plan | None = None,
    ends: Ends | None = None,
    beam: int = BEAM,
    plans: int = PLANS,
) -> DiscretePlans:
    """The best sequences of discrete actions of a data center.

    Commands are those of discrete environments: -1, 0 or 1 for work, setpoint and battery, as far
    as agents move them. A sequence drops no more work and leaves no more of it overdue than the
    commands 0 do, keeps the inlet limit where single steps of the setpoint allow it, and leaves at
    least the stored energy and at most the queue that there were at the first scored step.

    Args:
        problem: The planning problem.
        config: Configuration of the data center.
        demand: Work that arrives in each step, as a share of capacity, 0..1, (T,).
        guide: A good plan of continuous actions, around which the search estimates what states are
            worth; None takes commands that are all 0.
        ends: What is to be left at the end in place of what there was; its ``start_kwh`` and
            ``start_tasks`` are not read.
        beam: Most labels to keep after each step.
        plans: Most sequences to return.

    Returns:
        The best sequences; none where no sequence that was followed keeps all constraints.
    """
    model = DiscreteModel(problem, config, demand)
    values = costs_to_go(model, guide_of(model, guide), ends)
    idle = _after_idle_commands(model)
    most_dropped = float(idle.dropped_tasks[0]) + _SLACK_TASKS
    most_overdue = float(idle.overdue_tasks[0]) + _SLACK_TASKS
    labels, trail, is_complete, still = model.first(), _Trail(model.shape), True, 0
    steps = problem.steps
    for t in range(steps):
        found = model.successors(labels, t)
        fails = (found.dropped_tasks > most_dropped) | (found.overdue_tasks > most_overdue)
        found.cost[np.broadcast_to(fails[:, :, None, None], found.cost.shape)] = np.inf
        if t + 1 < steps:
            kept, still, left_out = _kept(model, found, values, t, beam, still)
            is_complete &= not left_out
        else:
            kept = _finished(model, found, ends, plans, t)
        labels = model.pick(found, kept, t)
        trail.add(kept)
    load, cooling, battery = trail.commands(model)
    return DiscretePlans(load, cooling, battery, labels.cost, is_complete)


def _after_idle_commands(model: DiscreteModel) -> Labels:
    """The state after the last step of commands that are all 0, one label."""
    labels = model.first()
    for t in range(model.problem.steps):
        labels = model.pick(model.successors(labels, t), np.array([model.neutral]), t)
    return labels


class _Trail:
    """Which label and which commands each label came from.

    Args:
        shape: Numbers of load, cooling and battery commands.
    """

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self._shape = shape
        self._chosen: list[I64] = []

    def add(self, chosen: I64) -> None:
        """Add a step, by the places of what was kept in (n, l, c, b)."""
        self._chosen.append(chosen)

    def commands(self, model: DiscreteModel) -> tuple[F64, F64, F64]:
        """Commands of the labels after the last step, (K, T) each."""
        per_label = int(np.prod(self._shape))
        row = np.arange(len(self._chosen[-1]))
        found: list[I64] = []
        for chosen in reversed(self._chosen):
            row, command = np.divmod(chosen[row], per_label)
            found.append(command)
        places = np.unravel_index(np.stack(found[::-1], axis=1), self._shape)
        load, cooling, battery = (
            values[place] for values, place in zip(model.commands.values(), places, strict=True)
        )
        return load, cooling, battery


def _kept(
    model: DiscreteModel, found: Successors, values: CostsToGo, t: int, beam: int, still: int
) -> tuple[I64, int, bool]:
    """Successors to follow after step ``t``, of equal states the cheapest.

    That of commands that were 0 in all steps, which leaves what it has to, is among them.

    Args:
        model: The discrete actions of the data center.
        found: All successors, n labels with l load, c cooling and b battery commands each.
        values: What states are worth.
        t: The step.
        beam: Most to keep.
        still: Label of commands that were 0 in all steps; -1 without one.

    Returns:
        Places in (n, l, c, b), which of them is that of commands that were all 0, and whether any
        state was left out.
    """
    cost, keys = found.cost.reshape(-1), model.keys(found, t).reshape(-1)
    places = np.flatnonzero(np.isfinite(cost))
    order = np.lexsort((cost[places], keys[places]))
    places = places[order]
    ordered = keys[places]
    places = places[np.append(True, ordered[1:] != ordered[:-1])[: len(places)]]
    neutral = still * int(np.prod(model.shape)) + model.neutral
    stays = still >= 0 and bool(np.isfinite(cost[neutral]))
    protected = places[keys[places] == keys[neutral]] if stays else places[:0]
    left_out = len(places) > beam
    if left_out:
        rank = values.rank(found, t).reshape(-1)[places]
        best = _best(found, values, places, rank, beam)
        places = np.concatenate([protected, best[~np.isin(best, protected)]])[:beam]
    where = np.flatnonzero(np.isin(places, protected))
    return places, int(where[0]) if len(where) else -1, left_out


def _best(found: Successors, values: CostsToGo, places: I64, rank: F64, beam: int) -> I64:
    """Successors for a beam that cannot hold all: the best of each kind, then the best of all.

    Estimates of what states are worth miss what the quantities are worth together, so half of the
    beam holds labels that are the best of their setpoint, part of the queue and of the store.
    """
    order = np.argsort(rank, kind="stable")
    places = places[order]
    row, load, cooling, _ = np.unravel_index(places, found.cost.shape)
    queue = _parts(found.queue_tasks[row, load], values.queue_tasks[-1])
    store = _parts(found.stored_kwh.reshape(-1)[places], values.stored_kwh[-1])
    setpoint = np.rint(found.setpoint_c[row, cooling] * 1e3).astype(np.int64)
    kind = (setpoint * (_BINS + 1) + queue) * (_BINS + 1) + store
    is_first = np.zeros(len(places), np.bool_)
    is_first[np.unique(kind, return_index=True)[1]] = True
    of_kind = np.flatnonzero(is_first)[: beam // 2]
    chosen = np.zeros(len(places), np.bool_)
    chosen[of_kind] = True
    chosen[np.flatnonzero(~chosen)[: beam - len(of_kind)]] = True
    return np.asarray(places[chosen])


def _parts(amount: F64, most: float) -> I64:
    """Which of equal parts of a range amounts are in."""
    return np.asarray(np.rint(amount * (_BINS / most if most > 0 else 0.0)), np.int64)


def _finished(
    model: DiscreteModel, found: Successors, ends: Ends | None, plans: int, t: int
) -> I64:
    """Places of the cheapest last successors that leave what they have to, best first."""
    labels: Labels = found.labels
    slack_kwh = _SLACK_SHARE * model.problem.storage.capacity_kwh
    if ends is None:
        least_kwh, most_tasks = labels.start_kwh[:, None, None, None], labels.start_tasks[:, None]
    else:
        least_kwh, most_tasks = np.asarray(ends.end_kwh), np.asarray(ends.end_tasks)
    leaves = found.stored_kwh >= least_kwh - slack_kwh
    leaves &= (found.queue_tasks <= most_tasks + _SLACK_TASKS)[:, :, None, None]
    cost = np.where(leaves, found.cost, np.inf).reshape(-1)
    order = np.argsort(cost, kind="stable")
    return np.asarray(order[: min(plans, int(np.isfinite(cost).sum()))])
