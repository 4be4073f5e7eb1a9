"""Observation entries that depend on time alone, gathered from rows computed once.

An observation has entries of two kinds. Time entries (clock, weather, carbon intensity, arriving
work) depend on the step of the year and the site alone: one row for every step and distinct site,
read by all data centers of that site. Measured entries (queue, hall, battery) are computed in every
step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.control.view import PERFECT, ForecastError, RandomWalks, View
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.features import (
    AGE_EDGES_H,
    UNLIMITED_QUEUE_H,
    Feature,
    all_features,
    feature_slices,
    features_by_agent,
    features_space,
    measured_features,
    scale,
    time_features,
)
from sdc_taichi.envs.forecasts import (
    CI_LEADS_H,
    WEATHER_LEADS_H,
    ExtendedSeries,
    Forecasts,
)
from sdc_taichi.errors import RuntimeStateError
from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS, TASKS_PER_STEP
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.types import F32, F64, I64

if TYPE_CHECKING:
    from sdc_taichi.kernels.compiler.stage import CompiledStage

MAX_ROW_BYTES = 2**28
"""Most memory that the rows of one observer take, in bytes; series that need more are read
in stretches."""
STRETCH_BYTES = 2**23
"""Memory of the rows of a stretch, in bytes."""
_ENDLESS = 2**62
"""Length of rows that do not repeat, in steps."""


@dataclass(frozen=True, slots=True)
class TimeRows:
    """Rows of several series end to end, and which of them each data center reads."""

    values: npt.NDArray[Any]
    """Rows of all distinct series end to end, (rows, columns)."""
    first_rows: I64
    """First row that each data center reads, (B,)."""
    lengths: I64
    """Number of rows after which the series of each data center repeats, (B,)."""

    def row_numbers(self, index: I64) -> I64:
        """Row of ``values`` that each data center reads at step ``index`` of its series, (B,)."""
        return self.first_rows + index % self.lengths

    def at(self, index: I64) -> npt.NDArray[Any]:
        """Rows of all data centers at step ``index`` of their series, (B, columns)."""
        return self.values.take(self.row_numbers(index), axis=0)


def time_rows(
    series: Sequence[FleetSeries],
    read: Callable[[I64, I64], npt.NDArray[Any]],
    *,
    period: int,
    row_bytes: int,
) -> TimeRows | None:
    """Compute the rows of all steps, once for data centers that read the same series.

    Args:
        series: the series that the rows depend on, each for all data centers.
        read: computes rows, (n, columns), from steps of the year, (n,), and data centers, (n,).
        period: steps after which the clock repeats, as far as the rows depend on it.
        row_bytes: memory of a row and of whatever else is kept per row, in bytes.

    Returns:
        None where there can be no such rows: the series of a data center differ in length, end
        within a period, or need more memory than ``MAX_ROW_BYTES``.
    """
    length = series[0].lengths
    alike = all(np.array_equal(one.lengths, length) for one in series)
    if not alike or np.any(length % period):
        return None
    places = np.stack([*(one.offsets for one in series), length], axis=1)
    _, first, which = np.unique(places, axis=0, return_index=True, return_inverse=True)
    lengths = length[first]
    if int(lengths.sum()) * row_bytes > MAX_ROW_BYTES:
        return None
    parts = [read(np.arange(n), np.full(n, dc)) for dc, n in zip(first, lengths, strict=True)]
    first_rows = np.cumsum(lengths) - lengths
    return TimeRows(np.concatenate(parts), first_rows[which.reshape(-1)], length)


class RowStretches:
    """Rows of an episode, computed for some steps ahead at a time.

    They are computed once for data centers that read the same series from the same step on.

    Args:
        series: the series that the rows depend on, each for all data centers.
        read: computes rows, (n, columns), from steps of the year, (n,), and data centers, (n,).
        start: first step of each data center in the year, (B,).
        most_steps: largest number of steps of a stretch.
        row_bytes: memory of a row and of whatever else is kept per row, in bytes.
    """

    def __init__(
        self,
        series: Sequence[FleetSeries],
        read: Callable[[I64, I64], npt.NDArray[Any]],
        *,
        start: I64,
        most_steps: int,
        row_bytes: int,
    ) -> None:
        places = [start, *(a for one in series for a in (one.offsets, one.lengths))]
        _, first, which = np.unique(
            np.stack(places, axis=1), axis=0, return_index=True, return_inverse=True
        )
        self._read, self._start, self._first = read, start, first
        # Few enough rows that the processor keeps them in its cache.
        self._steps = min(max(STRETCH_BYTES // (len(first) * row_bytes), 1), most_steps)
        self._dcs = np.repeat(first, self._steps)
        self._first_rows = which.reshape(-1) * self._steps - start
        self._lengths = np.full(len(start), _ENDLESS, dtype=np.int64)

    def beginning_at(self, step: int) -> tuple[TimeRows, range]:
        """Rows of the stretch that begins at a step, and the steps that they are for."""
        steps = range(step, step + self._steps)
        index = self._start[self._first][:, None] + np.array(steps)
        rows = self._read(index.reshape(-1), self._dcs)
        return TimeRows(rows, self._first_rows - step, self._lengths), steps


class EntryOrder:
    """The order of an observation's entries, taken from time entries and measured entries.

    Args:
        columns: where each entry of the observation comes from: below ``time_width`` the column of
            a time row, from there on ``time_width`` plus the row of the measured entries.
        time_width: number of time entries that a row has.

    Attributes:
        width: number of entries of the observation.
    """

    def __init__(self, columns: Sequence[int], time_width: int) -> None:
        given = np.array(columns)
        self.width = len(given)
        # Places of measured entries take any time entry and are written over afterwards.
        self._time_columns = np.where(given < time_width, given, 0)
        breaks = np.diff(given, prepend=-2) != 1
        run_starts = np.flatnonzero(breaks | (given == time_width)).tolist()
        # Measured entries that are neighbours in the observation and in their source are copied
        # together.
        self._measured_runs = [
            (slice(here, end), slice(source, source + end - here))
            for here, end in zip(run_starts, [*run_starts[1:], self.width], strict=True)
            if (source := int(given[here]) - time_width) >= 0
        ]

    def arrange(self, time_rows: F32) -> F32:
        """Time rows, (n, time_width), in the order of this observation, (n, width)."""
        return time_rows.take(self._time_columns, axis=1)

    def assemble(self, arranged: F32, row_numbers: I64 | None, measured: F32) -> F32:
        """Observations of all data centers, (B, width).

        Args:
            arranged: rows that ``arrange`` gave, (n, width).
            row_numbers: row of each data center, (B,); None if ``arranged`` has a row for each,
                which is then written to.
            measured: measured entries of all data centers, (m, B).
        """
        out = arranged if row_numbers is None else arranged.take(row_numbers, axis=0)
        for here, source in self._measured_runs:
            out[:, here] = measured[source].T
        return out


class Observer:
    """Observations of each agent, and the shared state, of a fleet.

    Args:
        fleet: the data centers.
        agents: agents whose observations are wanted.
        features: names of the features of each agent; None is ``DEFAULT_FEATURES``.
        ci_leads_h: leads of the carbon-intensity forecast in h, rising multiples of the step.
        weather_leads_h: leads of the weather forecasts in h, rising multiples of the step.
        forecast_error: how forecasts err.
        new_inputs: whether episodes may have other inputs than those before.
        commands: commands that agents decide, by agent; None is the default ones.

    Attributes:
        features: features of each agent, in the order of its observation.
        spaces: space of each agent's observation.
        state_features: all features, in the order of the shared state.
        state_space: space of the shared state.

    Raises:
        ConfigError: an unknown agent or feature, or leads that are not valid.
    """

    def __init__(
        self,
        fleet: Fleet,
        *,
        agents: Sequence[str] = AGENTS,
        features: Mapping[str, Sequence[str]] | None = None,
        ci_leads_h: Sequence[float] = CI_LEADS_H,
        weather_leads_h: Sequence[float] = WEATHER_LEADS_H,
        forecast_error: ForecastError = PERFECT,
        new_inputs: bool = False,
        commands: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        forecasts = Forecasts(
            fleet.steps_per_hour,
            ci_leads_h=ci_leads_h,
            weather_leads_h=weather_leads_h,
            error=forecast_error,
        )
        units_of_each = np.diff(fleet.unit_offsets)
        self._equal_units = bool(np.all(units_of_each == units_of_each[0]))
        self._units = int(units_of_each[0]) if self._equal_units else 1
        decided = {name for names in (commands or {}).values() for name in names}
        self._fans = self._units if "fan" in decided else 0
        self._racks = int(fleet.rack_offsets[1]) if "placement" in decided else 0
        self.state_features = all_features(
            ci_leads_h, weather_leads_h, self._units, self._fans, self._racks
        )
        self.state_space = features_space(self.state_features)
        self.features = features_by_agent(features, self.state_features, commands)
        self.spaces = {agent: features_space(found) for agent, found in self.features.items()}

        self._measured = measured_features(self._units, self._fans, self._racks)
        self._measured_width = sum(feature.size for feature in self._measured)
        self._time = _TimeEntries(
            time_features(ci_leads_h, weather_leads_h),
            forecasts,
            fleet.steps_per_hour,
            new_inputs,
        )
        slices = feature_slices(self.state_features)
        entry_numbers = range(self._time.width + self._measured_width)
        self._orders = {
            agent: EntryOrder(
                [i for f in self.features[agent] for i in entry_numbers[slices[f.name]]],
                self._time.width,
            )
            for agent in agents
        }
        self._arranged_rows: dict[str, F32] = {}
        per_hour = fleet.steps_per_hour
        limit_h = fleet.values("workload.queue_limit_h")
        limit_h = np.where(np.isnan(limit_h), UNLIMITED_QUEUE_H, limit_h)
        self._per_task = 1.0 / (limit_h * per_hour * TASKS_PER_STEP)
        self._age_edges_steps = np.asarray(AGE_EDGES_H) * per_hour
        self._age_columns: list[int] = []
        self._sizing: Sizing | None = None
        self._stage: CompiledStage | None = None
        self._entries: _Entries | None = None

    def reset(self, view: View, keys: Sequence[int] | I64 = ()) -> None:
        """Start an episode.

        Args:
            view: the view before the first step.
            keys: seeds of the errors of forecasts that err, one for each data center, where the
                view has no walks.

        Raises:
            ConfigError: another number of keys than of data centers.
        """
        arranged_width = sum(order.width for order in self._orders.values())
        walks = keys if view.walks is None else view.walks
        if self._time.reset(view.drivers, walks, arranged_width):
            self._arrange_rows()
        if view.sizing is not self._sizing:
            oldest = view.state.queue.shape[1] - 1
            # Column k of the queue counts the tasks that are at least (oldest - k) steps old.
            self._age_columns = np.maximum(oldest - self._age_edges_steps, 0).astype(int).tolist()
            self._stage, self._sizing = self._measuring_stage(view.sizing, view.step_h), view.sizing
        self._entries = None

    def observe(self, view: View) -> dict[str, F32]:
        """Observation of each agent before the step to come, (B, n) each.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        entries = self._entries_of(view)
        return {
            agent: order.assemble(
                order.arrange(entries.time)
                if entries.row_numbers is None
                else self._arranged_rows[agent],
                entries.row_numbers,
                entries.measured,
            )
            for agent, order in self._orders.items()
        }

    def state(self, view: View) -> F32:
        """Shared state: all features side by side, (B, m).

        Raises:
            RuntimeStateError: before ``reset``.
        """
        entries, first = self._entries_of(view), self._time.width
        rows = entries.time
        if entries.row_numbers is not None:
            rows = rows.take(entries.row_numbers, axis=0)
        out = np.empty((len(rows), first + self._measured_width), dtype=np.float32)
        out[:, :first] = rows
        out[:, first:] = entries.measured.T
        return out

    def _entries_of(self, view: View) -> _Entries:
        """Entries of all features in a view, computed once for each view."""
        entries, time = self._entries, self._time
        if entries is not None and entries.view is view:
            return entries
        if self._stage is None:
            raise RuntimeStateError("the observer has not been reset; call reset() first")
        index = view.drivers.start + view.state.step
        if time.next_stretch(view.state.step):
            self._arrange_rows()
        rows, measured = time.rows, self._measure(view)
        if rows is None:
            entries = _Entries(view, time.compute(index, view.state.step), None, measured)
        else:
            entries = _Entries(view, rows.values, rows.row_numbers(index), measured)
        self._entries = entries
        return entries

    def _arrange_rows(self) -> None:
        """Bring the rows of time entries into the order of each agent's observation."""
        self._arranged_rows = {}
        if (rows := self._time.rows) is not None:
            self._arranged_rows = {a: o.arrange(rows.values) for a, o in self._orders.items()}

    def _measure(self, view: View) -> F32:
        """Scaled entries of queue, hall and battery, (m, B), one contiguous row each."""
        assert self._stage is not None
        state, last = view.state, view.last
        setpoints = (
            state.setpoint_c.reshape(-1, self._units).T
            if self._equal_units
            else [mean_setpoint_c(view)]
        )
        given = {f"setpoint_{i}": setpoint_c for i, setpoint_c in enumerate(setpoints)}
        given |= {f"at_least_{i}": state.queue[:, k] for i, k in enumerate(self._age_columns)}
        given |= {"waiting": state.queue[:, -1], "stored_kwh": state.stored_kwh}
        if last is None:
            # A hall at rest at the setpoint.
            at_c, none = mean_setpoint_c(view), np.zeros(len(state.stored_kwh))
            of_last_step = (none, none, at_c, at_c, none, none, none)
        else:
            of_last_step = _read_last_step(last)
        given |= zip(_LAST_STEP_QUANTITIES, of_last_step, strict=True)
        if self._fans:
            speeds = state.fan_speed.reshape(-1, self._fans).T
            given |= {f"fan_{i}": speed for i, speed in enumerate(speeds)}
        measured: F32 = self._stage.rows(**given).astype(np.float32)
        return np.concatenate([measured, self._rack_inlets(view)]) if self._racks else measured

    def _rack_inlets(self, view: View) -> F32:
        """Scaled hottest inlet of each rack in the last step, (racks, B)."""
        if view.last is None:
            inlet_c = np.tile(mean_setpoint_c(view).astype(np.float32), (self._racks, 1))
        else:
            inlet_c = view.last.rack_inlet_max_c.reshape(-1, self._racks).T.astype(np.float32)
        return scale(inlet_c, self._measured[-1])

    def _measuring_stage(self, sizing: Sizing, step_h: float) -> CompiledStage:
        """The compiled stage from the quantities in ``_measure`` to scaled entries in order."""
        from sdc_taichi.kernels.compiler.stage import CompiledStage

        kwh = step_h / 1e3
        per_it_kwh = _inverse(sizing.it_w * kwh)
        per_hvac_kwh = _inverse((sizing.facility_w - sizing.counted_loss_w - sizing.it_w) * kwh)
        per_facility_kwh = _inverse(sizing.facility_w * kwh)
        per_battery_kwh = _inverse(sizing.battery_kwh)
        edges, units = range(len(self._age_columns)), range(self._units)
        # Racks may be many, and have nothing in common with other entries.
        compiled = [f for f in self._measured if f.name != "rack_inlets"]

        def entries(**x: F64) -> dict[str, F64]:
            counts = x["waiting"] > NEGLIGIBLE_TASKS
            per_task = np.where(counts, 1.0 / np.where(counts, x["waiting"], 1.0), 0.0)
            at_least: list[Any] = [*(x[f"at_least_{i}"] for i in edges), 0.0]
            values = {
                "queue": [x["waiting"] * self._per_task],
                "oldest_age": [x["oldest_age_h"]],
                "mean_age": [x["mean_age_h"]],
                "age_histogram": [(a - b) * per_task for a, b in pairwise(at_least)],
                "room": [x["return_c"]],
                "hottest_inlet": [x["inlet_max_c"]],
                "setpoint": [x[f"setpoint_{i}"] for i in units],
                "it_energy": [x["it_kwh"] * per_it_kwh],
                "hvac_energy": [x["hvac_kwh"] * per_hvac_kwh],
                "dc_load": [x["facility_kwh"] * per_facility_kwh],
                "soc": [x["stored_kwh"] * per_battery_kwh],
                "fan_speed": [x[f"fan_{i}"] for i in range(self._fans)],
            }
            return {
                f"{f.name}_{i}": np.clip((value - f.low) / (f.high - f.low), 0.0, 1.0)
                for f in compiled
                for i, value in enumerate(values[f.name])
            }

        return CompiledStage(entries, len(self._per_task))


_LAST_STEP_QUANTITIES = (
    "oldest_age_h",
    "mean_age_h",
    "return_c",
    "inlet_max_c",
    "it_kwh",
    "hvac_kwh",
    "facility_kwh",
)
"""Fields of ``StepResult`` that are observed."""
_read_last_step = attrgetter(*_LAST_STEP_QUANTITIES)


class _Entries(NamedTuple):
    """Scaled entries of all features in one view."""

    view: View
    """The view that was observed."""
    time: F32
    """Time entries: rows that data centers share, (rows, n), or one row for each, (B, n)."""
    row_numbers: I64 | None
    """Row of ``time`` that each data center reads, (B,); None if it has one for each."""
    measured: F32
    """Measured entries, (m, B)."""


class _TimeEntries:
    """Scaled features that depend on time alone, as rows of all steps if these are few enough.

    Else there are rows of a stretch of steps ahead, and with forecasts that err none.

    Args:
        features: what ``time_features`` gives.
        forecasts: carbon intensity and weather at the leads of ``features``.
        steps_per_hour: number of steps in an hour.
        new_inputs: whether episodes may have other inputs than those before, so that rows of all
            steps do not pay.

    Attributes:
        width: number of entries.
        rows: rows of all steps, once per site, or of a stretch; None with forecasts that err.
    """

    def __init__(
        self,
        features: Sequence[Feature],
        forecasts: Forecasts,
        steps_per_hour: int,
        new_inputs: bool,
    ) -> None:
        self._new_inputs = new_inputs
        self._features = {f.name: f for f in features}
        self._slices = feature_slices(features)
        self.width = sum(f.size for f in features)
        self._row_bytes = 4 * self.width
        self._forecasts = forecasts
        self._price_leads = forecasts.ci_leads
        self._price: ExtendedSeries | None = None
        self._time_of_day = _sine_and_cosine(24 * steps_per_hour)
        self._time_of_year = _sine_and_cosine(HOURS_PER_YEAR * steps_per_hour)
        self._series: tuple[FleetSeries, ...] = ()
        self._stretches: RowStretches | None = None
        self.rows: TimeRows | None = None
        # Steps after reset that the rows of a stretch are for.
        self._stretch = range(0)

    def reset(
        self, drivers: Drivers, walks: RandomWalks | Sequence[int] | I64, arranged_width: int
    ) -> bool:
        """Start an episode.

        Args:
            drivers: inputs of the fleet.
            walks: walks of the errors of forecasts, or a seed for each data center.
            arranged_width: entries that the observer keeps for each row besides those of ``rows``.

        Returns:
            Whether ``rows`` are others than before.
        """
        demand = drivers.demand
        changed = self._forecasts.reset(drivers, walks)
        changed = changed or not self._series or demand is not self._series[-1]
        self._stretch = range(0)
        if changed:
            price = drivers.price_per_kwh
            assert price is not None, "a simulator has filled it in"
            self._price = ExtendedSeries(_over_mean(price), self._price_leads)
            weather = drivers.outdoor_c, drivers.wet_bulb_c
            self._series = (drivers.ci_g_per_kwh, *weather, price, demand)
            self._row_bytes = 4 * (self.width + arranged_width)
            self.rows = self._stretches = None
            if self._forecasts.perfect and not self._new_inputs:
                period = len(self._time_of_year)
                self.rows = time_rows(
                    self._series, self._read, period=period, row_bytes=self._row_bytes
                )
        if self._forecasts.perfect and (self.rows is None or self._stretches is not None):
            self._stretches = RowStretches(
                self._series,
                self._read,
                start=drivers.start,
                most_steps=len(self._time_of_day),
                row_bytes=self._row_bytes,
            )
        return changed

    def next_stretch(self, step: int) -> bool:
        """Go on to the stretch with a step, if rows are made in stretches.

        Args:
            step: the step after reset.

        Returns:
            Whether ``rows`` are others than before.
        """
        if self._stretches is None or step in self._stretch:
            return False
        self.rows, self._stretch = self._stretches.beginning_at(step)
        return True

    def _read(self, index: I64, dc: I64) -> F32:
        """Entries of data centers ``dc`` at steps of the year, (n, width)."""
        demand = self._series[-1]
        now = demand.values[demand.offsets[dc] + index % demand.lengths[dc]]
        return self._scaled(index, now, self._forecasts.truth(index, dc), dc)

    def compute(self, index: I64, step: int) -> F32:
        """Entries of all data centers, (B, n), at steps of the year, (B,), ``step`` after reset."""
        demand = self._series[-1].at(index)
        return self._scaled(index, demand, self._forecasts.forecast(index, step))

    def _scaled(
        self,
        index: I64,
        demand: F64,
        forecasts: tuple[F32, F32, F32],
        dc: I64 | slice = slice(None),
    ) -> F32:
        """Scaled entries, (n, width).

        Args:
            index: steps of the year, (n,).
            demand: arriving work as a share of capacity, (n,).
            forecasts: carbon intensity, dry bulb and wet bulb, (1 + leads, n) each, the present
                first.
            dc: data center of each step, (n,); one step for each by default.
        """
        assert self._price is not None
        price = self._price.at(index, dc)
        ci, outdoor, wet_bulb = forecasts
        out = np.empty((len(index), self.width), dtype=np.float32)
        day, year = self._time_of_day, self._time_of_year
        out[:, self._slices["time_of_day"]] = day.take(index % len(day), axis=0)
        out[:, self._slices["time_of_year"]] = year.take(index % len(year), axis=0)
        values = {
            "ci": ci[:1],
            "ci_forecast": ci[1:],
            "ci_change": ci[1:] - ci[:1],
            **_relative_to_extremes(ci),
            "outdoor": outdoor[:1],
            "outdoor_forecast": outdoor[1:],
            "wet_bulb": wet_bulb[:1],
            "wet_bulb_forecast": wet_bulb[1:],
            "workload": demand[None].astype(np.float32),
            "price": price[:1],
            "price_forecast": price[1:],
        }
        for name, of_feature in values.items():
            if name in self._features:
                out[:, self._slices[name]] = scale(of_feature, self._features[name]).T
        return out


def _relative_to_extremes(ci: F32) -> dict[str, F32]:
    """Carbon intensities, (1 + leads, n), the present first, in relation to each other.

    The result does not depend on how much a site's intensity swings, which is ten times more at
    some sites than at others. Without leads there is none.
    """
    if len(ci) == 1:
        return {}
    lowest, highest = ci.min(axis=0), ci.max(axis=0)
    swing = highest - lowest
    moves = swing > 0
    return {
        "ci_rank": (ci[1:] < ci[:1]).mean(axis=0, keepdims=True, dtype=np.float32),
        "ci_relative": (ci - lowest) / np.where(moves, swing, 1.0),
        "ci_swing": (swing / np.where(ci[0] > 0, ci[0], 1.0))[None],
    }


def mean_setpoint_c(view: View) -> F64:
    """Mean setpoint over the CRAC units of each data center, in C, (B,)."""
    fleet = view.fleet
    return np.asarray(fleet.unit_sums(view.state.setpoint_c) / np.diff(fleet.unit_offsets))


def _over_mean(series: FleetSeries) -> FleetSeries:
    """Values of each series over their mean; those of a series of zeros stay."""
    values = series.values.copy()
    for first, length in {*zip(series.offsets.tolist(), series.lengths.tolist(), strict=True)}:
        own = values[first : first + length]
        mean = own.mean()
        own /= mean if mean > 0 else 1.0
    return FleetSeries(values, series.offsets, series.lengths)


def _inverse(values: F64) -> F64:
    """1 over values, and 0 where they are 0, of the same shape."""
    return np.where(values > 0, 1.0 / np.where(values > 0, values, 1.0), 0.0)


def _sine_and_cosine(period: int) -> F32:
    """Sine and cosine of each step of a period, (period, 2)."""
    angle = 2.0 * np.pi * np.arange(period) / period
    return np.stack([np.sin(angle), np.cos(angle)], axis=1).astype(np.float32)
