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
from itertools import pairwise

import numpy as np
from gymnasium.spaces import Box

from sdc_taichi.control.view import View
from sdc_taichi.drivers import Table
from sdc_taichi.envs.features import AGE_EDGES_H, Feature
from sdc_taichi.envs.forecasts import F32
from sdc_taichi.errors import DataError, RuntimeStateError
from sdc_taichi.fleet import Fleet, build_fleet
from sdc_taichi.hall import Hall
from sdc_taichi.plant.workload import TASKS_PER_STEP, age_histogram
from sdc_taichi.sizing import Sizing, released_ranges
from sdc_taichi.types import F64, I64, StepResult

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

_NEGLIGIBLE_TASKS = 1e-9
"""Queues of divisible work keep rounding errors; nothing is read off those."""


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


FEATURES: dict[str, tuple[Feature, ...]] = {
    "agent_ls": (
        *_SHARED,
        _age("oldest_age", "age of the oldest queued task"),
        _age("mean_age", "mean age of the queued tasks"),
        _share("queue", "queued tasks over the longest queue; 0 where it has no limit"),
        _WORKLOAD,
        _OUTDOOR,
        _slope(
            "outdoor_slope_next",
            f"trend of the {_DRY_BULB} over this and the next {TEMPERATURE_STEPS} steps",
        ),
        *_window("outdoor", _DRY_BULB, TEMPERATURE_STEPS),
        *_age_bins(),
    ),
    "agent_dc": (
        *_SHARED,
        _WORKLOAD,
        _share("workload_next", "work that arrives one step later, as a share of capacity"),
        _OUTDOOR,
        _scaled("outdoor_next", f"{_DRY_BULB} one step later"),
    ),
    "agent_bat": (
        *_SHARED,
        _WORKLOAD,
        _OUTDOOR,
        _share("soc", "state of charge of the battery"),
    ),
}
"""The entries of each agent's vector in order; ranges are those of the values as observed.

``scaled`` is the input less its minimum over the 30 days from the first step, over the range of
these days.
"""


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

    def at(self, index: I64) -> F64:
        """Row ``index`` of every data center's series, repeating, (B, columns)."""
        return self.rows[self.start + index % self.table.length]

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


@dataclass(frozen=True, slots=True)
class _Tables:
    """Rows of the inputs of a fleet, in their own units."""

    steps_per_hour: int
    time: F64
    ci: _Lookup
    ci_extremes: _Lookup
    outdoor: _Lookup
    outdoor_extremes: _Lookup

    def serves(self, view: View) -> bool:
        """Whether the tables are those of the view's inputs."""
        return (
            self.steps_per_hour == view.fleet.steps_per_hour
            and self.ci.serves(view.drivers.ci_g_per_kwh)
            and self.outdoor.serves(view.drivers.outdoor_c)
        )


def _tables(view: View) -> _Tables:
    per_hour, drivers = view.fleet.steps_per_hour, view.drivers
    window = SCALING_DAYS * 24 * per_hour

    def extremes(series: F64) -> F64:
        return _extremes(series, window)

    return _Tables(
        steps_per_hour=per_hour,
        time=_time_rows(24 * per_hour),
        ci=_look_up(drivers.ci_g_per_kwh, _ci_rows),
        ci_extremes=_look_up(drivers.ci_g_per_kwh, extremes),
        outdoor=_look_up(drivers.outdoor_c, _temperature_rows),
        outdoor_extremes=_look_up(drivers.outdoor_c, extremes),
    )


@dataclass(frozen=True, slots=True)
class _Scale:
    """Minimum and range of an input in each environment, (B,); without a range all reads 0."""

    low: F64
    span: F64

    def of(self, value: F64) -> F64:
        """Level, 0 at the minimum and 1 at the maximum."""
        return self.of_difference(value - self.low)

    def of_difference(self, value: F64) -> F64:
        """Difference of levels, over the range."""
        return np.divide(value, self.span, out=np.zeros_like(value), where=self.span > 0)

    def window(self, columns: F64) -> list[F64]:
        """Scaled mean, standard deviation, z-score, steps to peak and valley, (B,) each."""
        mean, std, excess, peak, valley = columns.T
        spread = std + Z_SCORE_EPSILON * self.span
        z_score = np.divide(excess, spread, out=np.zeros_like(excess), where=self.span > 0)
        return [self.of(mean), self.of_difference(std), z_score, peak, valley]


# --- observer -----------------------------------------------------------------------------------


class ReleasedObserver:
    """Observation vectors of the released code, with 26, 14 and 13 entries.

    The inputs are taken from the drivers as they are; the released code cuts its dry bulb at 0 C
    and 45 C beforehand. An input that is constant over the 30 days from the first step has no range
    and reads 0. Entries outside ``FEATURES``' ranges are cut at them.
    """

    def __init__(self) -> None:
        self.features = FEATURES
        self.spaces = {agent: _space(features) for agent, features in FEATURES.items()}
        self._tables: _Tables | None = None
        self._ci = self._outdoor = _Scale(np.zeros(0), np.zeros(0))
        self._queue_limit = np.zeros(0)

    def reset(self, view: View, keys: Sequence[int] | I64 = ()) -> None:
        """Scale the inputs by what follows the first step.

        Args:
            view: the view before the first step.
            keys: unused, the vectors have no randomness.
        """
        if self._tables is None or not self._tables.serves(view):
            self._tables = _tables(view)
        tables, start = self._tables, view.drivers.start
        low, high = tables.ci_extremes.at(start).T
        self._ci = _Scale(low, high - low)
        low, high = tables.outdoor_extremes.at(start).T
        self._outdoor = _Scale(low, high - low)
        limit_h = view.fleet.values("workload.queue_limit_h")
        limit = limit_h * TASKS_PER_STEP * tables.steps_per_hour
        self._queue_limit = np.where(np.isnan(limit_h), np.inf, limit)

    def observe(self, view: View) -> dict[str, F32]:
        """The vectors before a step.

        Args:
            view: the view before the step.

        Returns:
            (B, entries) by agent.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        if self._tables is None:
            raise RuntimeStateError("the observer has not been reset; call reset() first")
        tables, drivers = self._tables, view.drivers
        index = drivers.start + view.state.step
        shared = self._shared(tables, index)
        workload = [drivers.demand.at(index)]
        temperature = self._temperature(tables, index)
        outdoor, outdoor_next = temperature[:1], drivers.outdoor_c.at(index + 1)
        battery_kwh = view.sizing.battery_kwh
        soc = view.state.stored_kwh / np.where(battery_kwh > 0, battery_kwh, 1.0)
        ages, shares = self._queue(view, tables.steps_per_hour)
        entries = {
            "agent_ls": [*shared, *ages, *workload, *temperature, *shares],
            "agent_dc": [
                *shared,
                *workload,
                drivers.demand.at(index + 1),
                *outdoor,
                self._outdoor.of(outdoor_next),
            ],
            "agent_bat": [*shared, *workload, *outdoor, soc],
        }
        return {agent: self._cut(agent, columns) for agent, columns in entries.items()}

    def _cut(self, agent: str, columns: Sequence[F64]) -> F32:
        """The entries of an agent within their ranges, (B, entries)."""
        space, entries = self.spaces[agent], np.array(columns, dtype=np.float32)
        np.clip(entries, space.low[:, None], space.high[:, None], out=entries)
        return np.ascontiguousarray(entries.T)

    def _shared(self, tables: _Tables, index: I64) -> list[F64]:
        """Time and carbon intensity, which all agents see."""
        columns, scale = tables.ci.at(index), self._ci
        return [
            *tables.time[index % len(tables.time)].T,
            scale.of(columns[:, 0]),
            scale.of_difference(columns[:, 1]),
            scale.of_difference(columns[:, 2]),
            *scale.window(columns[:, 3:]),
        ]

    def _temperature(self, tables: _Tables, index: I64) -> list[F64]:
        """Dry bulb, its slope and its window."""
        columns, scale = tables.outdoor.at(index), self._outdoor
        return [
            scale.of(columns[:, 0]),
            scale.of_difference(columns[:, 1]),
            *scale.window(columns[:, 2:]),
        ]

    def _queue(self, view: View, steps_per_hour: int) -> tuple[list[F64], list[F64]]:
        """Ages in days and share of the longest queue; shares by age."""
        queue = view.state.queue
        waiting = queue[:, -1]
        some = waiting > _NEGLIGIBLE_TASKS
        tasks = age_histogram(queue, np.array(AGE_EDGES_H) * steps_per_hour)
        shares = tasks / np.where(some, waiting, 1.0)[:, None]
        *closed, _ = np.where(some[:, None], shares, 0.0).T
        days = (
            [np.zeros(view.size)] * 2
            if view.last is None
            else [view.last.oldest_age_h / 24.0, view.last.mean_age_h / 24.0]
        )
        old = (tasks[:, -1] > _NEGLIGIBLE_TASKS).astype(np.float64)
        return [*days, waiting / self._queue_limit], [*closed, old]


def _space(features: Sequence[Feature]) -> Box:
    low, high = ([getattr(f, side) for f in features] for side in ("low", "high"))
    return Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32))


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


def load_bounds_kw(fleet: Fleet, sizing: Sizing) -> tuple[F64, F64]:
    """Bounds of IT and HVAC power, (B,) each.

    From 0.9 times the lowest IT power of 15..22 C and 0..100 % load to the design power of the
    facility, which is 1.1 times highest IT, rated tower and chiller power under ``released``
    sizing. ``make_envs_pyenv.py``; energies of a step are these times its length.
    """
    halls = [(c.hall, c.servers, c.hvac) for c in fleet.configs]
    distinct = dict(zip(halls, fleet.configs, strict=True))
    alike = build_fleet(distinct.values())
    low_w, _ = released_ranges(alike, Hall(alike, "f64"))["it_w"]
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
        self._ci = _Scale(np.zeros(0), np.zeros(0))

    def reset(self, view: View) -> None:
        """Take the ranges of the fleet and its inputs.

        Raises:
            DataError: a carbon intensity that never changes, so has no range.
        """
        if self._fleet is not view.fleet:
            self._bounds_kw = load_bounds_kw(view.fleet, view.sizing)
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
        self._ci = _Scale(low, high - low)

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
            self._ci.of(result.ci_g_per_kwh),
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
