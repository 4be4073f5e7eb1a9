"""Observations: named features with fixed ranges, computed from what a controller may see.

Every feature has a range in its unit that no data and no result changes. A value v is scaled to
``(v - low) / (high - low)``, 0..1, or, where the range lies evenly about zero, to ``v / high``,
-1..1. What exceeds the range is cut at it. Nothing looks ahead but the demand of the step to come
and the forecasts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box

from sdc_taichi.control.view import View
from sdc_taichi.envs.forecasts import CI_LEADS_H, PERFECT, WEATHER_LEADS_H, ForecastError, Forecasts
from sdc_taichi.envs.timed import Layout, TimeRows, time_rows
from sdc_taichi.errors import ConfigError, RuntimeStateError, suggestion_or_valid
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS, TASKS_PER_STEP
from sdc_taichi.sim.drivers import Drivers, Table
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.types import F32, F64, I64
from sdc_taichi.year_clock import HOURS_PER_YEAR

if TYPE_CHECKING:
    from sdc_taichi.kernels.compiler.stage import CompiledStage


@dataclass(frozen=True, slots=True)
class Feature:
    """One named entry of an observation, or several of one kind side by side."""

    name: str
    unit: str
    low: float
    """In ``unit``; what lies below is cut at it, and above ``high`` alike."""
    high: float
    description: str
    size: int = 1


AGENTS = ("agent_ls", "agent_dc", "agent_bat")
AGE_EDGES_H = (0.0, 6.0, 12.0, 18.0, 24.0)
"""Lower edges of the age bins, those of the released code (``carbon_ls.py``); the last is open."""
UNLIMITED_QUEUE_H = 10.0
"""Hours of full work that a queue without limit is measured by."""

_CLOCK = ("time_of_day", "time_of_year")
_CI = ("ci", "ci_forecast")
_WEATHER = ("outdoor", "outdoor_forecast", "wet_bulb", "wet_bulb_forecast")
DEFAULT_FEATURES: dict[str, tuple[str, ...]] = {
    "agent_ls": (
        *_CLOCK,
        "workload",
        "queue",
        "oldest_age",
        "mean_age",
        "age_histogram",
        *_CI,
        "ci_change",
        "outdoor",
        "outdoor_forecast",
        "soc",
    ),
    "agent_dc": (
        *_CLOCK,
        "workload",
        *_CI,
        *_WEATHER,
        "room",
        "hottest_inlet",
        "setpoint",
        "it_energy",
        "hvac_energy",
    ),
    "agent_bat": (*_CLOCK, *_CI, "ci_change", "dc_load", "soc"),
}
"""What each agent observes unless told otherwise: the paper's lists (A.1.2, A.2.4, A.3.3), ages,
weather for the load agent, the work to come for the cooling agent, and the change of the CI."""

HEAT_MAP_FEATURES = (
    Feature("rack_inlet", "C", 10.0, 50.0, "inlet of the rack, mean over its servers"),
    Feature("rack_outlet", "C", 10.0, 70.0, "outlet of the rack"),
    Feature("rack_power", "share", 0.0, 2.0, "IT power over the hall's design power per rack"),
)
"""Channels of the heat map; all of the last step."""


def catalogue(
    ci_leads_h: Sequence[float] = CI_LEADS_H,
    weather_leads_h: Sequence[float] = WEATHER_LEADS_H,
    units: int = 1,
) -> tuple[Feature, ...]:
    """All features in the order of the shared state.

    Args:
        ci_leads_h: leads of the CI forecast, hours.
        weather_leads_h: leads of the weather forecasts, hours.
        units: setpoints side by side.
    """
    return (*_timed(ci_leads_h, weather_leads_h), *_inside(units))


def _timed(ci_leads_h: Sequence[float], weather_leads_h: Sequence[float]) -> tuple[Feature, ...]:
    """What depends on time alone: clock, carbon intensity, weather and arriving work."""
    ci, weather = (", ".join(f"{h:g}" for h in leads) for leads in (ci_leads_h, weather_leads_h))
    n, k = len(ci_leads_h), len(weather_leads_h)
    found = (
        Feature("time_of_day", "1", -1.0, 1.0, "sine and cosine of the local time", 2),
        Feature("time_of_year", "1", -1.0, 1.0, "sine and cosine of the share of the year", 2),
        Feature("ci", "g/kWh", 0.0, 1000.0, "carbon intensity of the step to come"),
        Feature("ci_forecast", "g/kWh", 0.0, 1000.0, f"CI in {ci} h", n),
        Feature("ci_change", "g/kWh", -300.0, 300.0, f"CI in {ci} h less `ci`", n),
        Feature("outdoor", "C", -30.0, 50.0, "dry bulb of the step to come"),
        Feature("outdoor_forecast", "C", -30.0, 50.0, f"dry bulb in {weather} h", k),
        Feature("wet_bulb", "C", -30.0, 40.0, "wet bulb of the step to come"),
        Feature("wet_bulb_forecast", "C", -30.0, 40.0, f"wet bulb in {weather} h", k),
        Feature("workload", "share", 0.0, 1.0, "work that arrives in the step to come"),
    )
    return tuple(feature for feature in found if feature.size)


def _inside(units: int) -> tuple[Feature, ...]:
    """Queue, hall and battery."""
    bins = [f"{a:g}-{b:g}" for a, b in pairwise(AGE_EDGES_H)]
    ages = f"{', '.join(bins)}, over {AGE_EDGES_H[-1]:g} h"
    limit = f"`workload.queue_limit_h`, or {UNLIMITED_QUEUE_H:g} h of full work where there is none"
    setpoint = "of the CRAC unit, mean of several" if units == 1 else "of each CRAC unit"
    return (
        Feature("queue", "share", 0.0, 1.0, f"queued work over {limit}"),
        Feature("oldest_age", "h", 0.0, 24.0, "age of the oldest queued work"),
        Feature("mean_age", "h", 0.0, 24.0, "mean age of queued work"),
        Feature("age_histogram", "share", 0.0, 1.0, f"of the queue by age: {ages}", 5),
        Feature("room", "C", 10.0, 60.0, "return air of the last step"),
        Feature("hottest_inlet", "C", 10.0, 50.0, "hottest server inlet of the last step"),
        Feature("setpoint", "C", 10.0, 30.0, f"supply setpoint {setpoint}", units),
        Feature("it_energy", "share", 0.0, 1.2, "IT energy of the last step over design"),
        Feature("hvac_energy", "share", 0.0, 1.2, "HVAC energy of the last step over design"),
        Feature("dc_load", "share", 0.0, 1.2, "IT and HVAC power of the last step over design"),
        Feature("soc", "share", 0.0, 1.0, "state of charge; 0 without a battery"),
    )


def bounds(features: Sequence[Feature]) -> tuple[F32, F32]:
    """Lowest and highest scaled value of each entry, (n,) each."""
    low = np.concatenate([np.full(f.size, -1.0 if _signed(f) else 0.0) for f in features])
    return low.astype(np.float32), np.ones(len(low), dtype=np.float32)


def space(features: Sequence[Feature]) -> Box:
    """The space of an observation made of ``features``."""
    return Box(*bounds(features), dtype=np.float32)


def select(
    chosen: Mapping[str, Sequence[str]] | None, known: Sequence[Feature]
) -> dict[str, tuple[Feature, ...]]:
    """Features of each agent by name; agents not mentioned keep the default.

    Raises:
        ConfigError: an unknown agent or feature, a feature named twice, or no feature.
    """
    given = dict(chosen or {})
    for agent in given:
        if agent not in AGENTS:
            raise ConfigError(
                f"features: unknown agent {agent!r}{suggestion_or_valid(agent, AGENTS)}"
            )
    by_name = {feature.name: feature for feature in known}
    out: dict[str, tuple[Feature, ...]] = {}
    for agent in AGENTS:
        names = given.get(agent, [n for n in DEFAULT_FEATURES[agent] if n in by_name])
        if isinstance(names, str) or not names:
            raise ConfigError(f"features of {agent}: {names!r}; valid is a list of names")
        for name in names:
            if name not in by_name:
                raise ConfigError(
                    f"features of {agent}: unknown {name!r}{suggestion_or_valid(name, by_name)}"
                )
        twice = next((name for name in names if list(names).count(name) > 1), None)
        if twice is not None:
            raise ConfigError(f"features of {agent}: {twice!r} is named twice")
        out[agent] = tuple(by_name[name] for name in names)
    return out


class Observer:
    """Observations of each agent and the shared state of a fleet.

    Args:
        fleet: the data centers.
        agents: whose observations are wanted.
        features: names of the features of each agent; None is ``DEFAULT_FEATURES``.
        ci_leads_h: leads of the CI forecast, rising multiples of the step.
        weather_leads_h: leads of the weather forecasts, likewise.
        forecast_error: how forecasts err.

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
    ) -> None:
        forecasts = Forecasts(
            fleet.steps_per_hour,
            ci_leads_h=ci_leads_h,
            weather_leads_h=weather_leads_h,
            error=forecast_error,
        )
        per_dc = np.diff(fleet.unit_offsets)
        self._alike = bool(np.all(per_dc == per_dc[0]))
        self._units = int(per_dc[0]) if self._alike else 1
        self.state_features = catalogue(ci_leads_h, weather_leads_h, self._units)
        self.state_space = space(self.state_features)
        self.features = select(features, self.state_features)
        self.spaces = {agent: space(found) for agent, found in self.features.items()}

        inside = _inside(self._units)
        self._inside_width = sum(feature.size for feature in inside)
        self._timed = _Timed(_timed(ci_leads_h, weather_leads_h), forecasts, fleet.steps_per_hour)
        at, _ = _places(self.state_features)
        self._layouts = {
            agent: Layout(
                [i for f in self.features[agent] for i in range(at[f.name].start, at[f.name].stop)],
                self._timed.width,
            )
            for agent in agents
        }
        self._rows: dict[str, F32] = {}
        per_hour = fleet.steps_per_hour
        limit_h = fleet.values("workload.queue_limit_h")
        limit_h = np.where(np.isnan(limit_h), UNLIMITED_QUEUE_H, limit_h)
        self._per_task = 1.0 / (limit_h * per_hour * TASKS_PER_STEP)
        self._edges_steps = np.asarray(AGE_EDGES_H) * per_hour
        self._edge_entries: list[int] = []
        self._sizing: Sizing | None = None
        self._stage: CompiledStage | None = None
        self._seen: _Seen | None = None

    def reset(self, view: View, keys: Sequence[int] | I64 = ()) -> None:
        """Start an episode.

        Args:
            view: the view before the first step.
            keys: one per data center, seeds of the errors of forecasts that err.

        Raises:
            ConfigError: another number of keys than of data centers.
        """
        layouts, timed = self._layouts, self._timed
        if timed.reset(view.drivers, keys, sum(layout.width for layout in layouts.values())):
            self._rows = {}
            if timed.rows is not None:
                self._rows = {a: layout.of(timed.rows.values) for a, layout in layouts.items()}
        if view.sizing is not self._sizing:
            oldest = view.state.queue.shape[1] - 1
            self._edge_entries = np.maximum(oldest - self._edges_steps, 0).astype(int).tolist()
            self._stage, self._sizing = self._stage_of(view.sizing, view.step_h), view.sizing
        self._seen = None

    def observe(self, view: View) -> dict[str, F32]:
        """Observation of each agent, (B, n) each.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        seen = self._look(view)
        return {
            agent: layout.filled(
                layout.of(seen.timed) if seen.entries is None else self._rows[agent],
                seen.entries,
                seen.inside,
            )
            for agent, layout in self._layouts.items()
        }

    def state(self, view: View) -> F32:
        """All features side by side, (B, m).

        Raises:
            RuntimeStateError: before ``reset``.
        """
        seen, first = self._look(view), self._timed.width
        out = np.empty((seen.inside.shape[1], first + self._inside_width), dtype=np.float32)
        out[:, :first] = (
            seen.timed if seen.entries is None else seen.timed.take(seen.entries, axis=0)
        )
        out[:, first:] = seen.inside.T
        return out

    def _look(self, view: View) -> _Seen:
        """What there is to observe; kept until the next view."""
        seen, timed = self._seen, self._timed
        if seen is not None and seen.view is view:
            return seen
        if self._stage is None:
            raise RuntimeStateError("the observer has not been reset; call reset() first")
        index, rows = view.drivers.start + view.state.step, timed.rows
        inside = self._inside(view)
        if rows is None:
            seen = _Seen(view, timed.look(index, view.state.step), None, inside)
        else:
            seen = _Seen(view, rows.values, rows.entries(index), inside)
        self._seen = seen
        return seen

    def _inside(self, view: View) -> F32:
        """Scaled queue, hall and battery, (n, B): one contiguous row each."""
        assert self._stage is not None
        state, last, alike = view.state, view.last, self._alike
        setpoints = (
            state.setpoint_c.reshape(-1, self._units).T if alike else [_setpoint_mean_c(view)]
        )
        given = {f"setpoint_{i}": setpoint_c for i, setpoint_c in enumerate(setpoints)}
        given |= {f"at_least_{i}": state.queue[:, k] for i, k in enumerate(self._edge_entries)}
        given |= {"waiting": state.queue[:, -1], "stored_kwh": state.stored_kwh}
        if last is None:
            # A hall at rest at the setpoint.
            at_c, none = _setpoint_mean_c(view), np.zeros(len(state.stored_kwh))
            of_last = (none, none, at_c, at_c, none, none)
        else:
            of_last = _of_last(last)
        given |= zip(_OF_LAST, of_last, strict=True)
        return self._stage.rows(**given).astype(np.float32)

    def _stage_of(self, sizing: Sizing, step_h: float) -> CompiledStage:
        """The stage from what ``_inside`` gives to its entries, in their order."""
        from sdc_taichi.kernels.compiler.stage import CompiledStage

        kwh = step_h / 1e3
        per_it_kwh = _inverse(sizing.it_w * kwh)
        per_hvac_kwh = _inverse((sizing.facility_w - sizing.it_w) * kwh)
        per_facility_kwh = _inverse(sizing.facility_w * kwh)
        per_battery_kwh = _inverse(sizing.battery_kwh)
        edges, units = range(len(self._edge_entries)), range(self._units)

        def entries(**x: F64) -> dict[str, F64]:
            counts = x["waiting"] > NEGLIGIBLE_TASKS
            per_task = np.where(counts, 1.0 / np.where(counts, x["waiting"], 1.0), 0.0)
            at_least: list[Any] = [*(x[f"at_least_{i}"] for i in edges), 0.0]
            found = {
                "queue": [x["waiting"] * self._per_task],
                "oldest_age": [x["oldest_age_h"]],
                "mean_age": [x["mean_age_h"]],
                "age_histogram": [(a - b) * per_task for a, b in pairwise(at_least)],
                "room": [x["return_c"]],
                "hottest_inlet": [x["inlet_max_c"]],
                "setpoint": [x[f"setpoint_{i}"] for i in units],
                "it_energy": [x["it_kwh"] * per_it_kwh],
                "hvac_energy": [x["hvac_kwh"] * per_hvac_kwh],
                "dc_load": [(x["it_kwh"] + x["hvac_kwh"]) * per_facility_kwh],
                "soc": [x["stored_kwh"] * per_battery_kwh],
            }
            return {
                f"{f.name}_{i}": np.clip((value - f.low) / (f.high - f.low), 0.0, 1.0)
                for f in _inside(self._units)
                for i, value in enumerate(found[f.name])
            }

        return CompiledStage(entries, len(self._per_task))


_OF_LAST = ("oldest_age_h", "mean_age_h", "return_c", "inlet_max_c", "it_kwh", "hvac_kwh")
_of_last = attrgetter(*_OF_LAST)
"""What is observed of the last step."""


def _inverse(values: F64) -> F64:
    """1 over values, 0 where they are 0."""
    return np.where(values > 0, 1.0 / np.where(values > 0, values, 1.0), 0.0)


class _Seen(NamedTuple):
    """What there is to observe in a view."""

    view: View
    timed: F32
    """What depends on time alone: rows that data centers read, or one for each, (B, n)."""
    entries: I64 | None
    """Row of each data center, (B,); None if each has its own."""
    inside: F32
    """The rest, (m, B)."""


def heat_map(view: View) -> F32:
    """Racks of the last step as an image, 0..1, (B, rows, racks per row, channels).

    Float rather than bytes: 8 bits would leave steps of 0.16 K. Before the first step all air has
    the temperature of the setpoint and no rack draws power.

    Raises:
        ConfigError: halls that differ in rows or racks per row.
    """
    shape = _hall_shape(view.fleet)
    racks = shape[0] * shape[1]
    channels = np.empty((view.size, racks, len(HEAT_MAP_FEATURES)), dtype=np.float32)
    if view.last is None:
        channels[...] = _setpoint_mean_c(view)[:, None, None]
        channels[:, :, 2] = 0.0
    else:
        design_w = view.sizing.it_w[:, None] / racks
        channels[:, :, 0] = view.last.rack_inlet_c.reshape(view.size, racks)
        channels[:, :, 1] = view.last.rack_outlet_c.reshape(view.size, racks)
        channels[:, :, 2] = view.last.rack_power_w.reshape(view.size, racks) / design_w
    for k, feature in enumerate(HEAT_MAP_FEATURES):
        channels[:, :, k] = _scaled(channels[:, :, k], feature)
    return channels.reshape(view.size, *shape, len(HEAT_MAP_FEATURES))


def heat_map_space(fleet: Fleet) -> Box:
    """Space of the heat map of one data center.

    Raises:
        ConfigError: halls that differ in rows or racks per row.
    """
    return Box(0.0, 1.0, (*_hall_shape(fleet), len(HEAT_MAP_FEATURES)), dtype=np.float32)


class _Timed:
    """Scaled features that depend on time alone: rows of all steps if they are few.

    Args:
        features: what ``_timed`` gives.
        forecasts: of the same leads.
        steps_per_hour: of the simulation.

    Attributes:
        width: number of entries.
        rows: of all steps, once per site; None if they are read step by step.
    """

    def __init__(
        self, features: Sequence[Feature], forecasts: Forecasts, steps_per_hour: int
    ) -> None:
        self._features = {f.name: f for f in features}
        self._at, self.width = _places(features)
        self._forecasts = forecasts
        self._day = _circle(24 * steps_per_hour)
        self._year = _circle(HOURS_PER_YEAR * steps_per_hour)
        self._demand: Table | None = None
        self.rows: TimeRows | None = None

    def reset(self, drivers: Drivers, keys: Sequence[int] | I64, kept: int) -> bool:
        """Start an episode.

        Args:
            drivers: inputs of the fleet.
            keys: seeds of the errors of forecasts.
            kept: entries per row that are kept besides those of ``rows``.

        Returns:
            Whether ``rows`` are others than before.
        """
        demand = drivers.demand
        new = self._forecasts.reset(drivers, keys) or demand is not self._demand
        self._demand = demand
        if new and self._forecasts.perfect:
            self.rows = time_rows(
                (drivers.ci_g_per_kwh, drivers.outdoor_c, drivers.wet_bulb_c, demand),
                lambda index, dc: self._scaled(
                    index,
                    demand.values[demand.offset[dc] + index],
                    self._forecasts.truth(index, dc),
                ),
                period=len(self._year),
                row_bytes=4 * (self.width + kept),
            )
        return new

    def look(self, index: I64, step: int) -> F32:
        """Entries of all data centers, (B, n)."""
        assert self._demand is not None
        return self._scaled(index, self._demand.at(index), self._forecasts.look(index, step))

    def _scaled(self, index: I64, demand: F64, seen: tuple[F32, F32, F32]) -> F32:
        """Entries (n, width) from demand, (n,), and present and leads seen, (1 + k, n) each."""
        ci, outdoor, wet_bulb = seen
        out = np.empty((len(index), self.width), dtype=np.float32)
        out[:, self._at["time_of_day"]] = self._day.take(index % len(self._day), axis=0)
        out[:, self._at["time_of_year"]] = self._year.take(index % len(self._year), axis=0)
        found = {
            "ci": ci[:1],
            "ci_forecast": ci[1:],
            "ci_change": ci[1:] - ci[:1],
            "outdoor": outdoor[:1],
            "outdoor_forecast": outdoor[1:],
            "wet_bulb": wet_bulb[:1],
            "wet_bulb_forecast": wet_bulb[1:],
            "workload": demand[None].astype(np.float32),
        }
        for name, values in found.items():
            if name in self._features:
                out[:, self._at[name]] = _scaled(values, self._features[name]).T
        return out


def _scaled(values: F32, feature: Feature) -> F32:
    if _signed(feature):
        return np.asarray(np.clip(values / feature.high, -1.0, 1.0))
    return np.asarray(np.clip((values - feature.low) / (feature.high - feature.low), 0.0, 1.0))


def _places(features: Sequence[Feature]) -> tuple[dict[str, slice], int]:
    """Entries of each feature among those of all, and the number of entries."""
    ends = np.cumsum([0, *(f.size for f in features)])
    starts = zip(features, ends, strict=False)
    return {f.name: slice(int(start), int(start) + f.size) for f, start in starts}, int(ends[-1])


def _circle(steps: int) -> F32:
    """Sine and cosine of each step of a period, (steps, 2)."""
    angle = 2.0 * np.pi * np.arange(steps) / steps
    return np.stack([np.sin(angle), np.cos(angle)], axis=1).astype(np.float32)


def _setpoint_mean_c(view: View) -> F64:
    """Mean setpoint of the CRAC units, (B,)."""
    fleet = view.fleet
    return np.asarray(fleet.unit_sums(view.state.setpoint_c) / np.diff(fleet.unit_offsets))


def _hall_shape(fleet: Fleet) -> tuple[int, int]:
    shapes = [(c.hall.rows, c.hall.racks_per_row) for c in fleet.configs]
    for config, shape in zip(fleet.configs, shapes, strict=True):
        if shape != shapes[0]:
            raise ConfigError(
                f"heat map: {config.name} has {shape[0]} x {shape[1]} racks, "
                f"{fleet.configs[0].name} has {shapes[0][0]} x {shapes[0][1]}; "
                "valid is one shape for all"
            )
    return shapes[0]


def _signed(feature: Feature) -> bool:
    return feature.low == -feature.high


def table_markdown() -> str:
    """The default features as a Markdown table; a dot marks who observes what."""
    lines = [
        "| feature | entries | what it is | unit | range | load | cooling | battery |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for f in catalogue():
        seen = [" " if f.name not in DEFAULT_FEATURES[agent] else "●" for agent in AGENTS]
        cells = (f"`{f.name}`", str(f.size), f.description, f.unit, f"{f.low:g}..{f.high:g}", *seen)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
