"""Observation vectors and rewards of the released SustainDC, batched.

Source: github.com/HewlettPackard/dc-rl (``sustaindc_env.py``, ``utils/managers.py``,
``envs/carbon_ls.py``, ``utils/make_envs_pyenv.py``, ``utils/reward_creator.py``). Observations are
those of its main branch, a92b475; rewards those of the time of the paper (NeurIPS 2024, 4.5, F).

Carbon intensity and dry bulb are scaled by their minimum and maximum over the 30 days from the
first step. That looks at the future, which is why these vectors are not the default. Windows count
steps, so they cover the stated hours at the 15 minutes of the released code alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Box

from sdc_taichi.control.view import View
from sdc_taichi.envs.features import AGE_EDGES_H, AGENTS, Feature
from sdc_taichi.envs.timed import Layout, TimeRows, time_rows
from sdc_taichi.errors import DataError, RuntimeStateError
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS, TASKS_PER_STEP, age_histogram
from sdc_taichi.sim.drivers import Table
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Hall, Precision
from sdc_taichi.sim.sizing import Sizing, released_ranges
from sdc_taichi.types import F32, F64, I64, StepResult

CI_STEPS = 8
"""Steps of carbon intensity ahead (``sustaindc_env.py``)."""
TEMPERATURE_STEPS = 16
"""Steps of dry bulb ahead (``sustaindc_env.py``)."""
PAST_STEPS = 16
"""Steps of carbon intensity back (``sustaindc_env.py``)."""
SMOOTHED_STEPS = 4
"""Steps per mean that the trends of carbon intensity are fitted to (``sustaindc_env.py``)."""
SCALING_DAYS = 30
"""Days from the first step that scale the inputs, fewer where the year ends (``managers.py``)."""
Z_SCORE_EPSILON = 1e-8
"""Added to the standard deviation below the z-score, in scaled units (``sustaindc_env.py``)."""


def _trend_of_smoothed(points: int) -> F64:
    """Weights of a least-squares slope per step over means of ``SMOOTHED_STEPS`` of ``points``."""
    smoothed = points - SMOOTHED_STEPS + 1
    return np.convolve(_trend(smoothed), np.full(SMOOTHED_STEPS, 1.0 / SMOOTHED_STEPS))


def _trend(points: int) -> F64:
    """Weights of the least-squares slope per step."""
    position = np.arange(points) - (points - 1) / 2.0
    return np.asarray(position / np.sum(position**2))


# --- what the entries are -----------------------------------------------------------------------

_WIDE = 10.0
"""Limit of scaled inputs: 0..1 in the first 30 days, beyond in what follows."""
_STEEPEST = 1.0 / Z_SCORE_EPSILON
"""Limit of z-scores, which are as large where the window is flat."""
_OLDEST_DAYS = 400.0
"""Limit of ages; the longest ``workload.age_horizon_h`` is 365 days."""


def _scaled(name: str, description: str) -> Feature:
    return Feature(name, "scaled", -_WIDE, _WIDE, description)


def _slope(name: str, description: str) -> Feature:
    return Feature(name, "scaled/step", -_WIDE, _WIDE, description)


def _share(name: str, description: str, unit: str = "-") -> Feature:
    return Feature(name, unit, 0.0, 1.0, description)


def _window(name: str, what: str, steps: int) -> tuple[Feature, ...]:
    """Entries about the coming steps of an input."""
    return (
        _scaled(f"{name}_mean_next", f"mean {what} of the next {steps} steps"),
        Feature(
            f"{name}_std_next",
            "scaled",
            0.0,
            _WIDE,
            f"standard deviation of the {what} of the next {steps} steps",
        ),
        Feature(
            f"{name}_z_score",
            "-",
            -_STEEPEST,
            _STEEPEST,
            f"{what} less its mean over the next {steps} steps, in standard deviations of these",
        ),
        _share(
            f"{name}_steps_to_peak", f"steps to the next peak over {steps}; 1 without", "window"
        ),
        _share(
            f"{name}_steps_to_valley", f"steps to the next valley over {steps}; 1 without", "window"
        ),
    )


_CI, _DRY_BULB = "carbon intensity", "dry bulb"
_SHARED = (
    _share("time_cos", "0.5 + 0.5 cos of the time of day, which is rounded to a thousandth of it"),
    _share("time_sin", "0.5 + 0.5 sin of the time of day, which is rounded to a thousandth of it"),
    _scaled("ci", f"{_CI} of the step to come"),
    _slope("ci_slope_next", f"trend of the {_CI} over this and the next {CI_STEPS} steps"),
    _slope("ci_slope_past", f"trend of the {_CI} over the last {PAST_STEPS} steps and this one"),
    *_window("ci", _CI, CI_STEPS),
)
_WORKLOAD = _share("workload", "work that arrives in the step to come, as a share of capacity")
_OUTDOOR = _scaled("outdoor", f"{_DRY_BULB} of the step to come")


def _age(name: str, description: str) -> Feature:
    return Feature(name, "d", 0.0, _OLDEST_DAYS, description)


def _age_bins() -> tuple[Feature, ...]:
    """Entries of the age histogram."""
    edges = [f"{edge:g}" for edge in AGE_EDGES_H]
    closed = tuple(
        _share(f"queue_{low}_{high}h", f"share of the queued tasks aged {low} h to {high} h")
        for low, high in pairwise(edges)
    )
    return (*closed, _share(f"queue_{edges[-1]}h", f"1 with a task aged {edges[-1]} h or more"))


_AGES = (
    _age("oldest_age", "age of the oldest queued task"),
    _age("mean_age", "mean age of the queued tasks"),
    _share("queue", "queued tasks over the longest queue; 0 where it has no limit"),
)
_OUTDOOR_AHEAD = (
    _slope(
        "outdoor_slope_next",
        f"trend of the {_DRY_BULB} over this and the next {TEMPERATURE_STEPS} steps",
    ),
    *_window("outdoor", _DRY_BULB, TEMPERATURE_STEPS),
)
_WORKLOAD_NEXT = _share("workload_next", "work that arrives one step later, as a share of capacity")
_OUTDOOR_NEXT = _scaled("outdoor_next", f"{_DRY_BULB} one step later")
_SOC = _share("soc", "state of charge of the battery")

FEATURES: dict[str, tuple[Feature, ...]] = {
    "agent_ls": (*_SHARED, *_AGES, _WORKLOAD, _OUTDOOR, *_OUTDOOR_AHEAD, *_age_bins()),
    "agent_dc": (*_SHARED, _WORKLOAD, _WORKLOAD_NEXT, _OUTDOOR, _OUTDOOR_NEXT),
    "agent_bat": (*_SHARED, _WORKLOAD, _OUTDOOR, _SOC),
}
"""The entries of each agent's vector in order; ranges are those of the values as observed.

``scaled`` is the input less its minimum over the 30 days from the first step, over the range of
these days.
"""


_TIMED = (*_SHARED, _WORKLOAD, _OUTDOOR, *_OUTDOOR_AHEAD, _WORKLOAD_NEXT, _OUTDOOR_NEXT)
"""What depends on time and the first step alone, in the order of ``_Tables.read``."""
_OTHERS = (*_AGES, *_age_bins(), _SOC)
_AT = {feature.name: i for i, feature in enumerate((*_TIMED, *_OTHERS))}


@dataclass(frozen=True, slots=True)
class _Entries:
    """Where entries of an input are that its range scales."""

    levels: tuple[int, ...]
    """0 at the minimum and 1 at the maximum."""
    differences: tuple[int, ...]
    """Differences of levels."""
    std: int
    z_score: int


def _entries(name: str, levels: Sequence[str], slopes: Sequence[str]) -> _Entries:
    return _Entries(
        levels=tuple(_AT[n] for n in (name, f"{name}_mean_next", *levels)),
        differences=tuple(_AT[n] for n in (*slopes, f"{name}_std_next")),
        std=_AT[f"{name}_std_next"],
        z_score=_AT[f"{name}_z_score"],
    )


_CI_ENTRIES = _entries("ci", (), ("ci_slope_next", "ci_slope_past"))
_OUTDOOR_ENTRIES = _entries("outdoor", ("outdoor_next",), ("outdoor_slope_next",))


# --- tables of what depends on time alone -------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Lookup:
    """Rows for each entry of a driver's series, those of all distinct series end to end."""

    table: Table
    """What it was made from."""
    rows: F64
    """(entries, columns)."""
    start: I64
    """Row of the first entry of each data center's series, (B,)."""

    def at(self, index: I64, dc: I64) -> F64:
        """Rows ``index`` of the series of data centers ``dc``, repeating, (n, columns)."""
        return self.rows.take(self.start[dc] + index % self.table.length[dc], axis=0)

    def serves(self, table: Table) -> bool:
        """Whether the rows are those of this table."""
        return (
            self.table.values is table.values
            and np.array_equal(self.table.offset, table.offset)
            and np.array_equal(self.table.length, table.length)
        )


def _look_up(table: Table, build: Callable[[F64], F64]) -> _Lookup:
    """Build the rows of each distinct series once."""
    series, which = table.distinct()
    parts = [build(values) for values in series]
    starts = np.concatenate([[0], np.cumsum([len(part) for part in parts[:-1]])])
    return _Lookup(table, np.concatenate(parts), starts.astype(np.int64)[which])


def _window_columns(now: F64, following: Sequence[F64]) -> F64:
    """Mean, standard deviation, present excess over the mean, steps to peak and valley, (n, 5).

    Args:
        now: present values, (n,).
        following: values of each step of the window, (n,) each.
    """
    count = len(following)
    total = np.zeros_like(now)
    for value in following:
        total = total + value
    mean = total / count
    square = np.zeros_like(now)
    for value in following:
        square = square + (value - mean) ** 2
    path = [now, *following]
    # Central differences, one-sided at the ends, as in numpy.gradient; only the signs matter.
    slopes = [path[min(i + 1, count)] - path[max(i - 1, 0)] for i in range(count + 1)]
    peak, valley = np.full_like(now, count), np.full_like(now, count)
    for i in reversed(range(count)):
        peak = np.where((slopes[i] > 0) & (slopes[i + 1] <= 0), i, peak)
        valley = np.where((slopes[i] < 0) & (slopes[i + 1] >= 0), i, valley)
    return np.stack(
        [mean, np.sqrt(square / count), now - mean, peak / count, valley / count], axis=-1
    )


def _weighted(weights: F64, values: Sequence[F64]) -> F64:
    total = np.zeros_like(values[0])
    for weight, value in zip(weights, values, strict=True):
        total = total + weight * value
    return total


def _ahead(series: F64, steps: int) -> list[F64]:
    """The series as seen 1, 2, .. ``steps`` steps ahead."""
    return [np.roll(series, -k) for k in range(1, steps + 1)]


def _ci_rows(series: F64) -> F64:
    """Value, slopes to come and past, window columns, (n, 8), in g/kWh."""
    following = _ahead(series, CI_STEPS)
    past = [np.roll(series, k) for k in range(PAST_STEPS, 0, -1)]
    slope_past = _weighted(_trend_of_smoothed(PAST_STEPS + 1), [*past, series])
    # A year has no past before its first hours: the released code then sees none.
    slope_past[:PAST_STEPS] = 0.0
    slope_next = _weighted(_trend_of_smoothed(CI_STEPS + 1), [series, *following])
    return np.column_stack([series, slope_next, slope_past, _window_columns(series, following)])


def _temperature_rows(series: F64) -> F64:
    """Value, slope to come, window columns, (n, 7), in C."""
    following = _ahead(series, TEMPERATURE_STEPS)
    slope = _weighted(_trend(TEMPERATURE_STEPS + 1), [series, *following])
    return np.column_stack([series, slope, _window_columns(series, following)])


def _extremes(series: F64, window: int) -> F64:
    """Least and greatest of each entry and those that follow within ``window``, (n, 2).

    Windows end with the series. Each one is the end of a block of ``window`` entries and the start
    of the next, so accumulated extremes of the blocks are enough (van Herk 1992).
    """
    count = len(series)
    blocks = -(-count // window) + 1

    def least(values: F64) -> F64:
        padded = np.full(blocks * window, np.inf)
        padded[:count] = values
        table = padded.reshape(blocks, window)
        forward = np.minimum.accumulate(table, axis=1).reshape(-1)
        backward = np.minimum.accumulate(table[:, ::-1], axis=1)[:, ::-1].reshape(-1)
        return np.minimum(backward[:count], forward[window - 1 : window - 1 + count])

    return np.stack([least(series), -least(-series)], axis=1)


def _time_rows(steps_per_day: int) -> F64:
    """Cosine and sine of the time of day, (steps per day, 2)."""
    share = np.array([round(step / steps_per_day, 3) for step in range(steps_per_day)])
    angle = 2.0 * np.pi * share
    return np.stack([0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle)], axis=1)


class _Tables:
    """What depends on time alone, for the inputs of a fleet, in their own units."""

    def __init__(self, view: View) -> None:
        drivers, per_hour = view.drivers, view.fleet.steps_per_hour
        window = SCALING_DAYS * 24 * per_hour

        def extremes(series: F64) -> F64:
            return _extremes(series, window)

        self._steps_per_hour = per_hour
        self._time = _time_rows(24 * per_hour)
        self._demand = drivers.demand
        self._ci = _look_up(drivers.ci_g_per_kwh, _ci_rows)
        self._outdoor = _look_up(drivers.outdoor_c, _temperature_rows)
        self.ci_extremes = _look_up(drivers.ci_g_per_kwh, extremes)
        self.outdoor_extremes = _look_up(drivers.outdoor_c, extremes)
        self.rows = time_rows(
            (drivers.ci_g_per_kwh, drivers.outdoor_c, drivers.demand),
            self.read,
            period=len(self._time),
            row_bytes=8 * len(_TIMED),
        )
        """Of all steps; None if they are read step by step."""

    def serves(self, view: View) -> bool:
        """Whether the tables are those of the view's inputs."""
        return (
            self._steps_per_hour == view.fleet.steps_per_hour
            and self._demand is view.drivers.demand
            and self._ci.serves(view.drivers.ci_g_per_kwh)
            and self._outdoor.serves(view.drivers.outdoor_c)
        )

    def read(self, index: I64, dc: I64) -> F64:
        """Entries of steps ``index`` of data centers ``dc``, each (n,), ordered as ``_TIMED``."""
        demand = self._demand

        def arriving(step: I64) -> F64:
            return demand.values.take(demand.offset[dc] + step % demand.length[dc])

        return np.column_stack(
            [
                self._time.take(index % len(self._time), axis=0),
                self._ci.at(index, dc),
                arriving(index),
                self._outdoor.at(index, dc),
                arriving(index + 1),
                self._outdoor.at(index + 1, dc)[:, 0],
            ]
        )


class _Episode:
    """What depends on time alone in an episode, scaled by what follows its first step.

    Args:
        tables: of the inputs.
        start: first step, counted from the start of the year, (B,).

    Attributes:
        row: of each data center among those of ``at``, (B,).
    """

    def __init__(self, tables: _Tables, start: I64) -> None:
        dcs = self.row = np.arange(len(start))
        if tables.rows is not None:
            # Data centers that read the same entries from the same step on see the same.
            _, dcs, self.row = np.unique(
                tables.rows.entries(start), return_index=True, return_inverse=True
            )
            rows = tables.rows
            self._read = TimeRows(rows.values, rows.offset[dcs], rows.length[dcs]).at
        else:
            self._read = partial(tables.read, dc=dcs)
        self._start = start[dcs]
        shape = (len(dcs), len(_TIMED))
        self._low, self._span = np.zeros(shape), np.ones(shape)
        found = ((_CI_ENTRIES, tables.ci_extremes), (_OUTDOOR_ENTRIES, tables.outdoor_extremes))
        for entries, extremes in found:
            low, high = extremes.at(self._start, dcs).T
            # Without a range all reads 0, as any part of infinity does.
            span = np.where(high > low, high - low, np.inf)
            self._low[:, entries.levels] = low[:, None]
            self._span[:, [*entries.levels, *entries.differences]] = span[:, None]
        ci, outdoor = _CI_ENTRIES, _OUTDOOR_ENTRIES
        self._std = slice(ci.std, outdoor.std + 1, outdoor.std - ci.std)
        self._z_score = slice(ci.z_score, outdoor.z_score + 1, outdoor.z_score - ci.z_score)
        self._least_std = Z_SCORE_EPSILON * self._span[:, self._std]

    def at(self, step: int) -> F32:
        """Rows of step ``step`` of the episode within their ranges."""
        found = self._read(self._start + step)
        np.add(found[:, self._std], self._least_std, out=self._span[:, self._z_score])
        found -= self._low
        found /= self._span
        return _cut(found.astype(np.float32), *_TIMED_RANGES)


# --- observer -----------------------------------------------------------------------------------


def _ranges(features: Sequence[Feature]) -> tuple[F32, F32]:
    """Lowest and highest value of each entry, (n,) each."""
    low, high = ([getattr(f, side) for f in features] for side in ("low", "high"))
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)


_TIMED_RANGES = _ranges(_TIMED)
_LOW, _HIGH = (side[:, None] for side in _ranges(_OTHERS))
_LAYOUTS = {
    agent: Layout([_AT[f.name] for f in features], len(_TIMED))
    for agent, features in FEATURES.items()
}


class _Seen(NamedTuple):
    """What there is to observe in a view."""

    view: View
    timed: F32
    """Rows of what depends on time alone."""
    others: F32
    """The rest, (m, B)."""


class ReleasedObserver:
    """Observation vectors of the released code, with 26, 14 and 13 entries.

    The inputs are taken from the drivers as they are; the released code cuts its dry bulb at 0 C
    and 45 C beforehand. An input that is constant over the 30 days from the first step has no range
    and reads 0. Entries outside ``FEATURES``' ranges are cut at them.

    Args:
        agents: whose vectors are wanted.
    """

    def __init__(self, agents: Sequence[str] = AGENTS) -> None:
        self._agents = tuple(agents)
        self.features = FEATURES
        self.spaces = {agent: Box(*_ranges(features)) for agent, features in FEATURES.items()}
        self.state_space = Box(*_ranges([f for agent in AGENTS for f in FEATURES[agent]]))
        self._tables: _Tables | None = None
        self._episode: _Episode | None = None
        self._seen: _Seen | None = None
        self._edges_steps = self._queue_limit = self._capacity_kwh = np.zeros(0)

    def reset(self, view: View, keys: Sequence[int] | I64 = ()) -> None:
        """Scale the inputs by what follows the first step.

        Args:
            view: the view before the first step.
            keys: unused, the vectors have no randomness.
        """
        if self._tables is None or not self._tables.serves(view):
            self._tables = _Tables(view)
        self._episode = _Episode(self._tables, view.drivers.start)
        self._seen = None
        per_hour = view.fleet.steps_per_hour
        self._edges_steps = np.array(AGE_EDGES_H) * per_hour
        limit_h = view.fleet.values("workload.queue_limit_h")
        self._queue_limit = np.where(np.isnan(limit_h), np.inf, limit_h * TASKS_PER_STEP * per_hour)
        battery_kwh = view.sizing.battery_kwh
        self._capacity_kwh = np.where(battery_kwh > 0, battery_kwh, 1.0)

    def observe(self, view: View) -> dict[str, F32]:
        """The vectors before a step.

        Args:
            view: the view before the step.

        Returns:
            (B, entries) by agent.

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
        episode, seen = self._episode, self._seen
        if episode is None:
            raise RuntimeStateError("the observer has not been reset; call reset() first")
        if seen is None or seen.view is not view:
            self._seen = seen = _Seen(view, episode.at(view.state.step), self._others(view))
        return {
            agent: (layout := _LAYOUTS[agent]).filled(
                layout.of(seen.timed), episode.row, seen.others
            )
            for agent in agents
        }

    def _others(self, view: View) -> F32:
        """Entries in the order of ``_OTHERS`` within their ranges, (n, B)."""
        state, last = view.state, view.last
        waiting = state.queue[:, -1].copy()
        tasks = age_histogram(state.queue, self._edges_steps).T
        out = np.empty((len(_OTHERS), len(waiting)), dtype=np.float32)
        out[0] = 0.0 if last is None else last.oldest_age_h / 24.0
        out[1] = 0.0 if last is None else last.mean_age_h / 24.0
        out[2] = waiting / self._queue_limit
        out[3:7] = tasks[:-1] / _counted(waiting)
        out[7] = tasks[-1] > NEGLIGIBLE_TASKS
        out[8] = state.stored_kwh / self._capacity_kwh
        return _cut(out, _LOW, _HIGH)


def _counted(waiting: F64) -> F64:
    """What shares of the queued tasks are taken of, (B,).

    Infinity, of which every share is 0, where rounding alone has left some: nothing is read off
    those.
    """
    return np.where(waiting > NEGLIGIBLE_TASKS, waiting, np.inf)


def _cut(values: F32, low: F32, high: F32) -> F32:
    """Values within bounds, in place; bounds are arrays, which NumPy cuts at faster."""
    np.minimum(values, high, out=values)
    return np.maximum(values, low, out=values)


# --- rewards ------------------------------------------------------------------------------------

DROPPED_TASK_REWARD = -10.0
"""Per dropped task (paper, F.2)."""
QUEUED_TASK_REWARD = -0.1
"""Per queued task at full factor, one over 10 (paper, F.2)."""
END_OF_DAY_H = 23.0
"""Queued tasks cost from this hour on (paper, F.2)."""
END_OF_DAY_FACTORS = (0.95833, 0.98935)
"""Shares of the day at which the factor is 0 and 1, as printed (paper, F.2): 23:00 and, by its
digits, just before 23:45, the start of the last quarter hour, where the factor is 1.0075."""
LOWEST_POWER_FACTOR = 0.9
"""Lower bound of the facility's power over the lowest IT power (``make_envs_pyenv.py``)."""


def footprint_reward(norm_ci: F64, grid_kwh: F64, low_kwh: F64, high_kwh: F64) -> F64:
    """Reward of the battery agent, and the energy part of the load agent's (paper, F.2), (B,).

    Args:
        norm_ci: carbon intensity over its range, 0..1, (B,).
        grid_kwh: energy of the step with the battery, (B,).
        low_kwh: least energy of a step, (B,).
        high_kwh: greatest energy of a step, (B,).
    """
    return -norm_ci * (grid_kwh - low_kwh) / (high_kwh - low_kwh)


def load_penalty(dropped_tasks: F64, queue_tasks: F64, day_share: F64) -> F64:
    """What the load agent gets on top, for dropped tasks and a queue at the end of the day, (B,).

    Paper, F.1 and F.2: the factor of the queue rises linearly from 23:00 on.

    Args:
        dropped_tasks: dropped in the step, (B,).
        queue_tasks: queued at its end, (B,).
        day_share: start of the step as a share of the day, 0..1, (B,).
    """
    low, high = END_OF_DAY_FACTORS
    factor = np.where(day_share >= END_OF_DAY_H / 24.0, (day_share - low) / (high - low), 0.0)
    return DROPPED_TASK_REWARD * dropped_tasks + QUEUED_TASK_REWARD * factor * queue_tasks


def cooling_reward(facility_kw: F64, low_kw: F64, high_kw: F64) -> F64:
    """Reward of the cooling agent, IT and HVAC power over its range (``reward_creator.py``), (B,).

    Args:
        facility_kw: IT and HVAC power of the step, (B,).
        low_kw: lower bound, (B,).
        high_kw: upper bound, (B,).
    """
    return -(facility_kw - low_kw) / (high_kw - low_kw)


def load_bounds_kw(fleet: Fleet, sizing: Sizing, precision: Precision) -> tuple[F64, F64]:
    """Bounds of IT and HVAC power, (B,) each.

    From 0.9 times the lowest IT power of 15..22 C and 0..100 % load to the design power of the
    facility, which is 1.1 times highest IT, rated tower and chiller power under ``released``
    sizing. ``make_envs_pyenv.py``; energies of a step are these times its length.
    """
    halls = [(c.hall, c.servers, c.hvac) for c in fleet.configs]
    distinct = dict(zip(halls, fleet.configs, strict=True))
    alike = build_fleet(distinct.values())
    low_w, _ = released_ranges(alike, Hall(alike, precision))["it_w"]
    position = {hall: i for i, hall in enumerate(distinct)}
    lowest_w = low_w[[position[hall] for hall in halls]]
    return LOWEST_POWER_FACTOR * lowest_w / 1e3, sizing.facility_w / 1e3


class ReleasedRewards:
    """Rewards of the released code at the time of the paper, before they are shared.

    Carbon intensity counts as its place between the minimum and maximum of its series, a year as a
    rule (``CI_Manager`` of that time), in the step that the reward is for.
    """

    def __init__(self) -> None:
        self._fleet: Fleet | None = None
        self._bounds_kw = (np.zeros(0), np.zeros(0))
        self._low_ci = self._ci_span = np.zeros(0)

    def reset(self, view: View) -> None:
        """Take the ranges of the fleet and its inputs.

        Raises:
            DataError: a carbon intensity that never changes, so has no range.
        """
        if self._fleet is not view.fleet:
            self._bounds_kw = load_bounds_kw(view.fleet, view.sizing, view.precision)
            self._fleet = view.fleet
        series, which = view.drivers.ci_g_per_kwh.distinct()
        low = np.array([values.min() for values in series])[which]
        high = np.array([values.max() for values in series])[which]
        flat = np.flatnonzero(high == low)
        if len(flat):
            raise DataError(
                f"rewards sustaindc: the carbon intensity of data center {flat[0]} is "
                f"{low[flat[0]]:g} g/kWh throughout; valid is one that varies, as its range scales "
                "the rewards"
            )
        self._low_ci, self._ci_span = low, high - low

    def rewards(self, result: StepResult, view: View) -> dict[str, F64]:
        """Rewards of a step.

        Args:
            result: the step.
            view: the view after it.

        Returns:
            r_LS, r_DC and r_BAT by agent, (B,) each.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        if self._fleet is None:
            raise RuntimeStateError("the rewards have not been reset; call reset() first")
        low_kw, high_kw = self._bounds_kw
        footprint = footprint_reward(
            (result.ci_g_per_kwh - self._low_ci) / self._ci_span,
            result.grid_kwh,
            low_kw * result.step_h,
            high_kw * result.step_h,
        )
        steps_per_day = 24 * view.fleet.steps_per_hour
        day_share = (view.drivers.start + result.step) % steps_per_day / steps_per_day
        return {
            "agent_ls": footprint
            + load_penalty(result.dropped_tasks, result.queue_tasks, day_share),
            "agent_dc": cooling_reward((result.it_w + result.hvac_w) / 1e3, low_kw, high_kw),
            "agent_bat": footprint,
        }
