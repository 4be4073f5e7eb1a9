"""Observations and rewards of the released SustainDC code, for batches of data centers.

Observations follow the main branch of github.com/HewlettPackard/dc-rl at commit a92b475
(``sustaindc_env.py``, ``utils/managers.py``, ``envs/carbon_ls.py``). Rewards follow the code at the
time of the paper (NeurIPS 2024, sections 4.5 and F; ``utils/reward_creator.py``,
``utils/make_envs_pyenv.py``).

Carbon intensity and dry bulb are scaled by their minimum and maximum during the 30 days from the
first step. This scaling uses information about the future, so these vectors are not the default.
Windows have a fixed number of steps, so they have the same length in hours as in the released code
only at steps of 15 minutes.

The vectors exist to reproduce published numbers. Entries of weather and carbon intensity are
computed once per series; all other entries are computed in every step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from gymnasium.spaces import Box

from sdc_taichi.control.view import View
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.features import AGE_EDGES_H, Feature
from sdc_taichi.errors import DataError
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS, TASKS_PER_STEP, age_histogram
from sdc_taichi.sim.drivers import FleetSeries
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.sizing import Sizing, released_ranges
from sdc_taichi.types import F32, F64, I64, StepResult

CI_STEPS = 8
"""Number of future steps of carbon intensity in the observations (``sustaindc_env.py``)."""
TEMPERATURE_STEPS = 16
"""Number of future steps of dry bulb in the observations (``sustaindc_env.py``)."""
PAST_STEPS = 16
"""Number of past steps of carbon intensity in the observations (``sustaindc_env.py``)."""
Z_SCORE_EPSILON = 1e-8
"""Summand in the denominator of z-scores, which prevents a division by 0, in scaled units
(``sustaindc_env.py``)."""

SMOOTHED_STEPS = 4
"""Length in steps of the moving average that precedes the fit of carbon-intensity trends
(``sustaindc_env.py``)."""
SCALING_DAYS = 30
"""Length in days of the period from the first step whose range scales the inputs. The period ends
early at the end of the year (``managers.py``)."""

_SCALED_LIMIT = 10.0
"""Limit of scaled inputs, which are 0..1 in the first 30 days and may exceed this range later."""
_Z_SCORE_LIMIT = 1.0 / Z_SCORE_EPSILON
"""Limit of z-scores; a window of constant values gives z-scores of this size."""
_AGE_LIMIT_DAYS = 400.0
"""Limit of ages, in days; the longest valid ``workload.age_horizon_h`` is 365 days."""


def _scaled(name: str, description: str) -> Feature:
    """Describe an entry whose value is an input minus its minimum, divided by its range."""
    return Feature(name, "scaled", -_SCALED_LIMIT, _SCALED_LIMIT, description)


def _slope(name: str, description: str) -> Feature:
    """Describe an entry whose value is the trend of a scaled input per step."""
    return Feature(name, "scaled/step", -_SCALED_LIMIT, _SCALED_LIMIT, description)


def _share(name: str, description: str, unit: str = "-") -> Feature:
    """Describe an entry with values of 0..1."""
    return Feature(name, unit, 0.0, 1.0, description)


def _age(name: str, description: str) -> Feature:
    """Describe an entry whose value is an age of queued tasks, in days."""
    return Feature(name, "d", 0.0, _AGE_LIMIT_DAYS, description)


def _window(name: str, what: str, steps: int) -> tuple[Feature, ...]:
    """Describe the five entries that summarise the coming ``steps`` steps of an input."""
    return (
        _scaled(f"{name}_mean_next", f"mean {what} of the next {steps} steps"),
        Feature(
            f"{name}_std_next",
            "scaled",
            0.0,
            _SCALED_LIMIT,
            f"standard deviation of the {what} of the next {steps} steps",
        ),
        Feature(
            f"{name}_z_score",
            "-",
            -_Z_SCORE_LIMIT,
            _Z_SCORE_LIMIT,
            f"{what} less its mean over the next {steps} steps, in standard deviations of these",
        ),
        _share(
            f"{name}_steps_to_peak", f"steps to the next peak over {steps}; 1 without", "window"
        ),
        _share(
            f"{name}_steps_to_valley", f"steps to the next valley over {steps}; 1 without", "window"
        ),
    )


def _age_bins() -> tuple[Feature, ...]:
    """Describe the entries of the histogram of task ages."""
    edges = [f"{edge:g}" for edge in AGE_EDGES_H]
    closed = tuple(
        _share(f"queue_{low}_{high}h", f"share of the queued tasks aged {low} h to {high} h")
        for low, high in pairwise(edges)
    )
    return (*closed, _share(f"queue_{edges[-1]}h", f"1 with a task aged {edges[-1]} h or more"))


def ranges(features: Sequence[Feature]) -> tuple[F32, F32]:
    """Return the lower and the upper end of each entry's range, (n,) each."""
    low, high = ([getattr(f, side) for f in features] for side in ("low", "high"))
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)


_CI, _DRY_BULB = "carbon intensity", "dry bulb"
_OF_ALL_AGENTS = (
    _share("time_cos", "0.5 + 0.5 cos of the time of day, which is rounded to a thousandth of it"),
    _share("time_sin", "0.5 + 0.5 sin of the time of day, which is rounded to a thousandth of it"),
    _scaled("ci", f"{_CI} of the step to come"),
    _slope("ci_slope_next", f"trend of the {_CI} over this and the next {CI_STEPS} steps"),
    _slope("ci_slope_past", f"trend of the {_CI} over the last {PAST_STEPS} steps and this one"),
    *_window("ci", _CI, CI_STEPS),
)
_WORKLOAD = _share("workload", "work that arrives in the step to come, as a share of capacity")
_OUTDOOR = _scaled("outdoor", f"{_DRY_BULB} of the step to come")
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
    "agent_ls": (*_OF_ALL_AGENTS, *_AGES, _WORKLOAD, _OUTDOOR, *_OUTDOOR_AHEAD, *_age_bins()),
    "agent_dc": (*_OF_ALL_AGENTS, _WORKLOAD, _WORKLOAD_NEXT, _OUTDOOR, _OUTDOOR_NEXT),
    "agent_bat": (*_OF_ALL_AGENTS, _WORKLOAD, _OUTDOOR, _SOC),
}
"""Entries of each agent's observation vector, in order, with the ranges of the observed values.

The unit ``scaled`` means that the input's minimum is subtracted and the result divided by the
input's range. Minimum and range are those of the 30 days from the first step.
"""

_RANGES = {agent: ranges(features) for agent, features in FEATURES.items()}


class ReleasedObserver:
    """Computes the observation vectors of the released code, with 26, 14 and 13 entries.

    The vectors use the inputs of the simulator unchanged, whereas the released code clips the dry
    bulb to 0..45 C. The scaled value of an input that is constant for the 30 days from the first
    step is 0. Entries are clipped to the ranges in ``FEATURES``.

    Attributes:
        features: entries of each agent's vector, in order.
        spaces: space of each agent's vector.
        state_space: space of the concatenated vectors of all agents.
    """

    def __init__(self, agents: Sequence[str] = AGENTS) -> None:
        self._agents = tuple(agents)
        self.features = FEATURES
        self.spaces = {agent: Box(*_RANGES[agent]) for agent in AGENTS}
        self.state_space = Box(*ranges([f for agent in AGENTS for f in FEATURES[agent]]))
        self._ci: _ScaledInput | None = None
        self._outdoor: _ScaledInput | None = None
        self._observed: tuple[View, dict[str, F64]] | None = None

    def reset(self, view: View) -> None:
        """Start an episode: compute the ranges that scale the inputs."""
        per_hour, drivers = view.fleet.steps_per_hour, view.drivers
        window = SCALING_DAYS * 24 * per_hour
        if self._ci is None or not self._ci.is_made_of(drivers.ci_g_per_kwh):
            self._ci = _ScaledInput(drivers.ci_g_per_kwh, _CI_COLUMNS, _ci_columns)
        if self._outdoor is None or not self._outdoor.is_made_of(drivers.outdoor_c):
            self._outdoor = _ScaledInput(drivers.outdoor_c, _OUTDOOR_COLUMNS, _outdoor_columns)
        for scaled in (self._ci, self._outdoor):
            scaled.begin(drivers.start, window)
        self._time_of_day = _time_of_day_rows(24 * per_hour)
        self._observed = None
        self._age_edges_steps = np.array(AGE_EDGES_H) * per_hour
        limit_h = view.fleet.values("workload.queue_limit_h")
        self._queue_limit_tasks = np.where(
            np.isnan(limit_h), np.inf, limit_h * TASKS_PER_STEP * per_hour
        )
        battery_kwh = view.sizing.battery_kwh
        self._capacity_kwh = np.where(battery_kwh > 0, battery_kwh, 1.0)

    def observe(self, view: View) -> dict[str, F32]:
        """Return the vector of each agent before the coming step, (B, entries) each."""
        return {agent: self._vector(agent, view) for agent in self._agents}

    def state(self, view: View) -> F32:
        """Return the concatenated vectors of all agents before the coming step, (B, m)."""
        return np.concatenate([self._vector(agent, view) for agent in AGENTS], axis=1)

    def scaled_ci(self, index: I64) -> F64:
        """Return the carbon intensity in steps of the year, scaled as in the observations, (B,)."""
        assert self._ci is not None, "reset comes first"
        return self._ci.level_at(index)

    def _vector(self, agent: str, view: View) -> F32:
        if self._observed is None or self._observed[0] is not view:
            self._observed = view, self._entries(view)
        entries = self._observed[1]
        vector = np.stack([entries[f.name] for f in FEATURES[agent]], axis=1).astype(np.float32)
        low, high = _RANGES[agent]
        return np.maximum(np.minimum(vector, high), low)

    def _entries(self, view: View) -> dict[str, F64]:
        """Compute the entries of all agents by name, not yet clipped to their ranges, (B,) each."""
        assert self._ci is not None, "reset comes first"
        assert self._outdoor is not None
        state, last, drivers = view.state, view.last, view.drivers
        index = drivers.start + state.step
        time_of_day = self._time_of_day[index % len(self._time_of_day)]
        waiting = state.queue[:, -1].copy()
        tasks = age_histogram(state.queue, self._age_edges_steps).T
        # A queue that is not empty only because of rounding has age shares of 0.
        counted = np.where(waiting > NEGLIGIBLE_TASKS, waiting, np.inf)
        zero = np.zeros(view.size)
        return {
            "time_cos": time_of_day[:, 0],
            "time_sin": time_of_day[:, 1],
            **self._ci.at(index),
            **self._outdoor.at(index),
            "outdoor_next": self._outdoor.level_at(index + 1),
            "workload": drivers.demand.at(index),
            "workload_next": drivers.demand.at(index + 1),
            "oldest_age": zero if last is None else last.oldest_age_h / 24.0,
            "mean_age": zero if last is None else last.mean_age_h / 24.0,
            "queue": waiting / self._queue_limit_tasks,
            **dict(
                zip(_AGE_BINS, [*(tasks[:-1] / counted), tasks[-1] > NEGLIGIBLE_TASKS], strict=True)
            ),
            "soc": state.stored_kwh / self._capacity_kwh,
        }


class _ScaledInput:
    """Computes the entries that follow from one input, carbon intensity or dry bulb.

    The entries are scaled by the range of the input during the 30 days from the first step.

    Args:
        series: the input of each data center.
        names: names of the columns: the level, its trends, then those of ``_window_columns``.
        columns: function from the values of a series, (n,), to columns in its unit, (n, columns).
    """

    def __init__(
        self, series: FleetSeries, names: Sequence[str], columns: Callable[[F64], F64]
    ) -> None:
        self._series, self._names = series, names
        self._distinct, self._which = series.distinct()
        self._columns = np.concatenate([columns(one) for one in self._distinct])
        first_rows = np.cumsum([0, *map(len, self._distinct)])
        self._first_rows = first_rows[self._which]

    def is_made_of(self, series: FleetSeries) -> bool:
        """Return True if the columns were computed from this series."""
        mine = self._series
        return (
            mine.values is series.values
            and np.array_equal(mine.offsets, series.offsets)
            and np.array_equal(mine.lengths, series.lengths)
        )

    def begin(self, start: I64, window: int) -> None:
        """Compute the range of the input in ``window`` steps from step ``start`` of the year, (B,).

        The window ends early at the end of the series.
        """
        starts = start % self._series.lengths
        windows = [
            self._distinct[which][first : first + window]
            for which, first in zip(self._which, starts, strict=True)
        ]
        self._low = np.array([one.min() for one in windows])
        span = np.array([one.max() for one in windows]) - self._low
        # A constant input has no range; dividing by infinity scales all its values to 0.
        self._span = np.where(span > 0, span, np.inf)

    def level_at(self, index: I64) -> F64:
        """Return the scaled input of each data center at a step of the year, (B,)."""
        return np.asarray((self._series.at(index) - self._low) / self._span)

    def at(self, index: I64) -> dict[str, F64]:
        """Return the scaled entries of each data center at a step of the year, by name, (B,)."""
        rows = self._columns.take(self._first_rows + index % self._series.lengths, axis=0)
        columns = dict(zip(self._names, rows.T, strict=True))
        out: dict[str, F64] = {}
        for name, values in columns.items():
            if name.endswith("_z_score"):
                deviation = columns[name.replace("_z_score", "_std_next")]
                out[name] = values / (deviation + Z_SCORE_EPSILON * self._span)
            elif name.endswith(("_to_peak", "_to_valley")):
                out[name] = values
            elif name.endswith(("_slope_next", "_slope_past", "_std_next")):
                out[name] = values / self._span
            else:
                out[name] = (values - self._low) / self._span
        return out


_CI_COLUMNS = tuple(f.name for f in _OF_ALL_AGENTS[2:])
_OUTDOOR_COLUMNS = ("outdoor", *(f.name for f in _OUTDOOR_AHEAD))
_AGE_BINS = tuple(f.name for f in _age_bins())


def _time_of_day_rows(steps_per_day: int) -> F64:
    """Return cosine and sine of the time of day, scaled to 0..1, (steps per day, 2)."""
    share = np.array([round(step / steps_per_day, 3) for step in range(steps_per_day)])
    angle = 2.0 * np.pi * share
    return np.stack([0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle)], axis=1)


def _ci_columns(series: F64) -> F64:
    """Return columns of a carbon intensity in g/kWh, (n, 8).

    The columns are the value, its future and past trend per step, and those of ``_window_columns``.
    """
    following = _ahead(series, CI_STEPS)
    past = [np.roll(series, k) for k in range(PAST_STEPS, 0, -1)]
    slope_past = _weighted_sum(_smoothed_trend_weights(PAST_STEPS + 1), [*past, series])
    # The released code uses a past trend of 0 in the first hours of the year.
    slope_past[:PAST_STEPS] = 0.0
    slope_next = _weighted_sum(_smoothed_trend_weights(CI_STEPS + 1), [series, *following])
    return np.column_stack([series, slope_next, slope_past, _window_columns(series, following)])


def _outdoor_columns(series: F64) -> F64:
    """Return columns of a dry bulb in C, (n, 7).

    The columns are the value, its future trend per step, and those of ``_window_columns``.
    """
    following = _ahead(series, TEMPERATURE_STEPS)
    slope = _weighted_sum(_trend_weights(TEMPERATURE_STEPS + 1), [series, *following])
    return np.column_stack([series, slope, _window_columns(series, following)])


def _window_columns(now: F64, following: Sequence[F64]) -> F64:
    """Summarise the coming steps of a series in five columns, (n, 5).

    The columns are mean and standard deviation of the window, the current value minus this mean,
    and the steps to the next peak and to the next valley, each divided by the window's length.

    Args:
        now: current values, (n,).
        following: values in each later step of the window, (n,) each.
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


def _ahead(series: F64, steps: int) -> list[F64]:
    """Return the values of a series 1, 2, .. ``steps`` steps later, (n,) each."""
    return [np.roll(series, -k) for k in range(1, steps + 1)]


def _weighted_sum(weights: F64, values: Sequence[F64]) -> F64:
    """Return the weighted sum of arrays, added in order so that results repeat bit for bit."""
    total = np.zeros_like(values[0])
    for weight, value in zip(weights, values, strict=True):
        total = total + weight * value
    return total


def _trend_weights(points: int) -> F64:
    """Return the weights of points whose weighted sum is their least-squares slope, (points,)."""
    position = np.arange(points) - (points - 1) / 2.0
    return np.asarray(position / np.sum(position**2))


def _smoothed_trend_weights(points: int) -> F64:
    """Return the weights of points for the slope of their moving average, (points,).

    The slope is a least-squares fit to averages of ``SMOOTHED_STEPS`` points.
    """
    smoothed = points - SMOOTHED_STEPS + 1
    return np.convolve(_trend_weights(smoothed), np.full(SMOOTHED_STEPS, 1.0 / SMOOTHED_STEPS))


DROPPED_TASK_REWARD = -10.0
"""Reward of a dropped task (paper, F.2)."""
QUEUED_TASK_REWARD = -0.1
"""Reward of a queued task at an end-of-day factor of 1, which is -1/10 (paper, F.2)."""
END_OF_DAY_H = 23.0
"""Hour of the day from which queued tasks reduce the reward (paper, F.2)."""
END_OF_DAY_FACTORS = (0.95833, 0.98935)
"""Shares of the day at which the end-of-day factor is 0 and 1, as printed in the paper (F.2).

The first is 23:00. The second is slightly before 23:45, the start of the last quarter hour, so the
factor is 1.0075 at 23:45.
"""
LOWEST_POWER_FACTOR = 0.9
"""Ratio of the lower bound of the facility's power to the lowest IT power
(``make_envs_pyenv.py``)."""


def footprint_reward(norm_ci: F64, grid_kwh: F64, low_kwh: F64, high_kwh: F64) -> F64:
    """Compute the footprint reward: energy times carbon intensity, both scaled to 0..1, (B,).

    It is the reward of the battery agent and a summand of the load agent's reward (paper, F.2).

    Args:
        norm_ci: carbon intensity, scaled to 0..1 by its range, (B,).
        grid_kwh: grid energy of the step, battery included, in kWh, (B,).
        low_kwh: lower bound of the energy of a step, in kWh, (B,).
        high_kwh: upper bound of the energy of a step, in kWh, (B,).
    """
    return -norm_ci * (grid_kwh - low_kwh) / (high_kwh - low_kwh)


def load_penalty(dropped_tasks: F64, queue_tasks: F64, day_share: F64) -> F64:
    """Compute the load agent's penalty for dropped tasks and for a queue at the end of a day, (B,).

    The factor of the queue rises linearly from 23:00 on (paper, F.1 and F.2).

    Args:
        dropped_tasks: tasks dropped in the step, (B,).
        queue_tasks: tasks queued at the end of the step, (B,).
        day_share: start of the step as a share of the day, 0..1, (B,).
    """
    low, high = END_OF_DAY_FACTORS
    factor = np.where(day_share >= END_OF_DAY_H / 24.0, (day_share - low) / (high - low), 0.0)
    return DROPPED_TASK_REWARD * dropped_tasks + QUEUED_TASK_REWARD * factor * queue_tasks


def cooling_reward(facility_kw: F64, low_kw: F64, high_kw: F64) -> F64:
    """Compute the cooling agent's reward, the negative of IT and HVAC power scaled to 0..1, (B,).

    The formula is that of ``reward_creator.py`` in the released code.

    Args:
        facility_kw: IT and HVAC power of the step, in kW, (B,).
        low_kw: lower bound of the power, in kW, (B,).
        high_kw: upper bound of the power, in kW, (B,).
    """
    return -(facility_kw - low_kw) / (high_kw - low_kw)


def power_bounds_kw(fleet: Fleet, sizing: Sizing, precision: Precision) -> tuple[F64, F64]:
    """Compute the bounds by which rewards scale IT and HVAC power, in kW, (B,) each.

    The lower bound is 0.9 times the lowest IT power at setpoints of 15..22 C and loads of 0..100 %.
    The upper bound is the design power of the facility. Under ``released`` sizing this is 1.1 times
    the sum of the highest IT power and the rated powers of tower and chiller
    (``make_envs_pyenv.py``).
    """
    halls = [(c.hall, c.servers, c.hvac) for c in fleet.configs]
    distinct = dict(zip(halls, fleet.configs, strict=True))
    distinct_fleet = build_fleet(distinct.values())
    low_w, _ = released_ranges(distinct_fleet, Hall(distinct_fleet, precision))["it_w"]
    position = {hall: i for i, hall in enumerate(distinct)}
    lowest_w = low_w[[position[hall] for hall in halls]]
    return LOWEST_POWER_FACTOR * lowest_w / 1e3, sizing.facility_w / 1e3


class ReleasedRewards:
    """Computes the individual rewards of the released code at the time of the paper.

    Carbon intensity is scaled to 0..1 by minimum and maximum of its series, which usually covers a
    year (``CI_Manager`` in the code of that time). The value is that of the rewarded step.
    """

    def __init__(self) -> None:
        self._fleet: Fleet | None = None
        self._bounds_kw = (np.zeros(0), np.zeros(0))
        self._low_ci = self._ci_span = np.zeros(0)

    def reset(self, view: View) -> None:
        """Start an episode: compute the ranges of power and carbon intensity.

        Raises:
            DataError: the carbon intensity of a data center is constant, so it has no range.
        """
        if self._fleet is not view.fleet:
            self._bounds_kw = power_bounds_kw(view.fleet, view.sizing, view.precision)
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
        """Compute the individual rewards of a step.

        Args:
            result: result of the step.
            view: the controller's view after the step.

        Returns:
            The rewards r_LS, r_DC and r_BAT of the paper by agent, (B,) each.
        """
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
