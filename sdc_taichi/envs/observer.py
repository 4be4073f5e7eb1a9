"""Observations of named features, computed from the view that controllers receive.

Module ``features`` defines how a feature follows from its inputs. The observer computes all
features once per view, by three methods. Entries that depend on time alone are copied from shared
rows (``time_rows``). Entries measured in the data center come from one compiled stage. Entries of
single racks and units are computed with NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.control.view import View, mean_setpoint_c
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, HALL_AGENTS
from sdc_taichi.envs.features import (
    AGE_EDGES_H,
    UNLIMITED_QUEUE_H,
    Design,
    Feature,
    Layout,
    Measurements,
    all_features,
    feature_slices,
    features_by_agent,
    features_space,
    measured_features,
    scale,
    time_features,
    unit_features,
    view_features,
)
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.envs.released import ReleasedObserver
from sdc_taichi.envs.time_rows import Forecasts, TimeRows
from sdc_taichi.envs.unit_slots import UnitSlots, slots_of_groups
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.types import F32, F64, I64


class Observer:
    """Computes the observation of each agent, and the shared state, for a fleet.

    Forecasts have the forecast errors of the view. The shared state concatenates all features of
    the data center and, if agents of units observe, all features of each unit, unit by unit.

    Args:
        fleet: the B data centers.
        options: environment options, among them agents, features and leads.
        new_inputs: True if inputs may differ from episode to episode.
        slots: places of units in the observations of their agents, by group; None means as few as
            fit.

    Attributes:
        features: features of each agent, in the order of its observation.
        spaces: observation space of each agent.
        state_features: all features of data centers, in the order of the shared state.
        state_space: space of the shared state.

    Raises:
        ConfigError: an agent or feature is unknown, or leads do not fit the step.
    """

    def __init__(
        self,
        fleet: Fleet,
        options: EnvOptions,
        *,
        new_inputs: bool = False,
        slots: Mapping[str, UnitSlots] | None = None,
    ) -> None:
        agents, leads = options.agents, (options.ci_leads_h, options.weather_leads_h)
        commands: dict[str, tuple[str, ...]] = {a: options.commands_of(a) for a in agents}
        forecasts = Forecasts(fleet.steps_per_hour, *leads)
        units = np.diff(fleet.unit_offsets)
        self._equal_units = bool(np.all(units == units[0]))
        of_dcs = [agent for agent in agents if not AGENT_DEFINITIONS[agent].per_unit]
        of_units = [agent for agent in agents if AGENT_DEFINITIONS[agent].per_unit]
        decided = {name for agent in of_dcs for name in commands[agent]}
        count = int(units[0]) if self._equal_units else 1
        self._layout = layout = Layout(
            *leads,
            units=count,
            fans=count if "fan" in decided else 0,
            racks=int(fleet.rack_offsets[1]) if "placement" in decided else 0,
            hall=int(not set(agents).isdisjoint(HALL_AGENTS)),
            liquid=int(all(config.liquid is not None for config in fleet.configs)),
            neighbours=options.neighbours,
            other_sites=fleet.sites_per_fleet - 1 if "agent_geo" in agents else 0,
        )
        of_time, self._measured = time_features(layout), measured_features(layout)
        self._of_view = view_features(layout)
        self.state_features = all_features(layout)
        self._slots = slots_of_groups(fleet, agents) if slots is None else slots
        # Groups of one kind of unit share slots and features.
        self._slots_of_axis = {AGENT_DEFINITIONS[a].axis: self._slots[a] for a in of_units}
        self._of_units = {axis: unit_features(layout, axis) for axis in self._slots_of_axis}
        by_slot = [
            f for axis, x in self._slots_of_axis.items() for f in x.width * self._of_units[axis]
        ]
        self.state_space = features_space((*self.state_features, *by_slot))
        self.features = features_by_agent(
            options.features or {}, self.state_features, self._of_units, commands
        )
        self.spaces = {agent: features_space(x) for agent, x in self.features.items()}
        observed = {f for of_agent in self.features.values() for f in of_agent}
        self._observed_of_view = [f for f in self._of_view if f in observed]
        self._only_in_state = [f for f in self._of_view if f not in observed]
        self._rows_of_measured = feature_slices((*self._measured, *self._of_view))

        slices, self._time_width = feature_slices(self.state_features), sum(f.size for f in of_time)
        entries = np.arange(sum(f.size for f in self.state_features))
        # Features of units, which follow those of data centers, are added by ``observe``.
        columns = {
            agent: np.concatenate(
                [entries[slices[f.name]] for f in self.features[agent] if f.name in slices]
                or [entries[:0]]
            )
            for agent in agents
        }
        self._in_observation = {a: _entries_of_units(self.features[a], slices) for a in of_units}
        self._unit_slices = {axis: feature_slices(x) for axis, x in self._of_units.items()}
        # Measured entries first receive an arbitrary time entry, which ``observe`` overwrites.
        from_rows: dict[str, I64] = {
            a: np.where(c < self._time_width, c, 0) for a, c in columns.items()
        }
        self._runs = {agent: _runs(c - self._time_width) for agent, c in columns.items()}
        self._time = TimeRows(
            of_time,
            forecasts,
            from_rows,
            steps_per_hour=fleet.steps_per_hour,
            new_inputs=new_inputs,
        )
        limit_h = fleet.values("workload.queue_limit_h")
        limit_h = np.where(np.isnan(limit_h), UNLIMITED_QUEUE_H, limit_h)
        self._per_full_queue = 1.0 / (limit_h * fleet.steps_per_hour * TASKS_PER_STEP)
        self._age_edges_steps = np.asarray(AGE_EDGES_H) * fleet.steps_per_hour
        self._sizing: Sizing | None = None
        self._entries: _Entries | None = None

    def reset(self, view: View) -> None:
        """Start an episode."""
        self._time.reset(view)
        if view.sizing is not self._sizing:
            self._compile(view)
        self._entries = None

    def observe(self, view: View) -> dict[str, F32]:
        """Return the observation of each agent before the coming step, (B, n) each.

        Those of agents of units are (B, W, n), with the slots of ``UnitSlots``.

        ``reset`` must have been called.
        """
        entries = self._entries_of(view)
        observations: dict[str, F32] = {}
        for agent, runs in self._runs.items():
            observations[agent] = out = entries.arranged[agent].take(entries.row_numbers, axis=0)
            for places, source in runs:
                out[:, places] = entries.measured[source].T
        for agent, columns in self._in_observation.items():
            of_dc, axis = observations[agent], AGENT_DEFINITIONS[agent].axis
            slices, of_units = self._unit_slices[axis], entries.of_units[axis]
            out = np.empty((*self._slots[agent].exists.shape, len(columns)), dtype=np.float32)
            out[..., ~columns] = of_dc[:, None]
            chosen = [of_units[slices[f.name]] for f in self.features[agent] if f.name in slices]
            out[..., columns] = np.moveaxis(np.concatenate(chosen), 0, -1)
            observations[agent] = out
        return observations

    def state(self, view: View) -> F32:
        """Return the shared state, which concatenates all features, (B, m).

        ``reset`` must have been called.
        """
        entries, width = self._entries_of(view), self._time_width
        self._set_rows(entries.measured, self._only_in_state, view)
        end = width + len(entries.measured)
        out = np.empty((view.size, *(self.state_space.shape or ())), dtype=np.float32)
        out[:, :width] = entries.time.take(entries.row_numbers, axis=0)
        out[:, width:end] = entries.measured.T
        by_slot = [np.moveaxis(x, 0, -1).reshape(view.size, -1) for x in entries.of_units.values()]
        if by_slot:
            out[:, end:] = np.concatenate(by_slot, axis=1)
        return out

    def _entries_of(self, view: View) -> _Entries:
        """Return the entries of all features in a view, from a cache if the view is the same."""
        if self._entries is None or self._entries.view is not view:
            measured, of_units = self._measure(view), self._measure_units(view)
            self._entries = _Entries(view, *self._time.rows(view), measured, of_units)
        return self._entries

    def _measure_units(self, view: View) -> dict[str, F32]:
        """Compute the scaled entries of all features of units, by kind of unit, (m, B, W) each."""
        return {
            axis: self._slots_of_axis[axis].fill(
                np.concatenate(
                    [scale(f.value(view)[: f.size].astype(np.float32), f) for f in features]
                )
            )
            for axis, features in self._of_units.items()
        }

    def _measure(self, view: View) -> F32:
        """Compute the scaled entries measured in the data center, (m, B), a contiguous row each.

        The rows of features that only the state contains are set by ``state``.
        """
        state, layout = view.state, self._layout
        setpoints = (
            state.setpoint_c.reshape(-1, layout.units).T
            if self._equal_units
            else [mean_setpoint_c(view)]
        )
        inputs = {f"setpoint_{i}": setpoint_c for i, setpoint_c in enumerate(setpoints)}
        inputs |= {f"at_least_{i}": state.queue[:, k] for i, k in enumerate(self._age_columns)}
        inputs["waiting"], inputs["stored_kwh"] = state.queue[:, -1], state.stored_kwh
        if layout.fans:
            speeds = state.fan_speed.reshape(-1, layout.fans).T
            inputs |= {f"fan_{i}": speed for i, speed in enumerate(speeds)}
        last = _AtRest(view) if view.last is None else view.last
        compiled = self._stage.rows(last=last, **inputs)
        measured = np.empty(
            (len(compiled) + sum(f.size for f in self._of_view), view.size), np.float32
        )
        measured[: len(compiled)] = compiled
        self._set_rows(measured, self._observed_of_view, view)
        return measured

    def _set_rows(self, measured: F32, features: Sequence[Feature], view: View) -> None:
        """Set the scaled entries of features of a view in an array of all measured entries."""
        for f in features:
            entries = scale(f.value(view).astype(np.float32), f)
            measured[self._rows_of_measured[f.name]] = entries

    def _compile(self, view: View) -> None:
        """Compile the stage that maps the inputs from ``_measure`` to scaled entries."""
        from sdc_taichi.kernels.compiler.stage import CompiledStage

        oldest = view.state.queue.shape[1] - 1
        # Column k of the queue counts the tasks that are at least (oldest - k) steps old.
        self._age_columns = np.maximum(oldest - self._age_edges_steps, 0).astype(int).tolist()
        features, layout, edges = self._measured, self._layout, range(len(self._age_columns))
        design = _design(view.sizing, view.step_h, self._per_full_queue)

        def entries(last: Any, **x: F64) -> dict[str, F64]:
            inputs = Measurements(
                last=last,
                waiting_tasks=x["waiting"],
                at_least_tasks=[x[f"at_least_{i}"] for i in edges],
                setpoints_c=[x[f"setpoint_{i}"] for i in range(layout.units)],
                fan_speeds=[x[f"fan_{i}"] for i in range(layout.fans)],
                stored_kwh=x["stored_kwh"],
                design=design,
            )

            return {
                f"{f.name}_{i}": np.clip((value - f.low) / (f.high - f.low), 0.0, 1.0)
                for f in features
                for i, value in enumerate(f.value(inputs))
            }

        self._sizing, self._stage = view.sizing, CompiledStage(entries, view.size)


class _Entries(NamedTuple):
    """Scaled entries of all features in one view."""

    view: View
    """View to which the entries belong."""
    time: F32
    """Rows of entries that depend on time alone, shared by data centers, (rows, width)."""
    arranged: dict[str, F32]
    """The same rows in the order of each agent's observation, (rows, n)."""
    row_numbers: I64
    """Index into ``time`` of the row of each data center, (B,)."""
    measured: F32
    """Entries that do not depend on time alone, (m, B)."""
    of_units: dict[str, F32]
    """Entries of units, by kind of unit of which agents observe, (m, B, W) each."""


class _AtRest:
    """Substitute for the result of a step before the first step.

    Its temperatures equal the mean setpoint; all other quantities are 0.
    """

    def __init__(self, view: View) -> None:
        self._air_c, self._zero = mean_setpoint_c(view), np.zeros(view.size)

    def __getattr__(self, name: str) -> F64:
        return self._air_c if name.endswith("_c") else self._zero


def make_observer(
    fleet: Fleet,
    options: EnvOptions,
    *,
    new_inputs: bool = False,
    slots: Mapping[str, UnitSlots] | None = None,
) -> Observer | ReleasedObserver:
    """Create the observer of the agents that learn, with the arguments of ``Observer``.

    Raises:
        ConfigError: features or leads do not fit the data centers.
    """
    if options.observations == "sustaindc":
        return ReleasedObserver(options.agents)
    return Observer(fleet, options, new_inputs=new_inputs, slots=slots)


def _entries_of_units(
    features: Sequence[Feature], of_dc: Mapping[str, slice]
) -> npt.NDArray[np.bool_]:
    """Return True for the entries of an observation that belong to features of units, (n,).

    Args:
        features: features of the observation, in order.
        of_dc: the features of data centers, by name.
    """
    return np.repeat([f.name not in of_dc for f in features], [f.size for f in features])


def _runs(sources: I64) -> list[tuple[slice, slice]]:
    """Find runs of observation entries whose sources are contiguous too, to copy each at once.

    Args:
        sources: for each entry of an observation, the index of the measured entry to copy, (n,); a
            negative index marks an entry from a time row.

    Returns:
        Pairs of slices: of the observation, and of the measured entries.
    """
    breaks = np.diff(sources, prepend=-(2**31)) != 1
    starts = np.flatnonzero(breaks | (sources == 0)).tolist()
    return [
        (slice(here, end), slice(source, source + end - here))
        for here, end in zip(starts, [*starts[1:], len(sources)], strict=True)
        if (source := int(sources[here])) >= 0
    ]


def _design(sizing: Sizing, step_h: float, per_full_queue: F64) -> Design:
    """Compute the reciprocals of the design quantities that make measured features relative."""
    kwh = step_h / 1e3
    return Design(
        per_full_queue=per_full_queue,
        per_it_kwh=_inverse(sizing.it_w * kwh),
        per_hvac_kwh=_inverse((sizing.facility_w - sizing.counted_loss_w - sizing.it_w) * kwh),
        per_facility_kwh=_inverse(sizing.facility_w * kwh),
        per_battery_kwh=_inverse(sizing.battery_kwh),
    )


def _inverse(values: F64) -> F64:
    """Return the reciprocals of positive values and 0 for all others, in the same shape."""
    return np.where(values > 0, 1.0 / np.where(values > 0, values, 1.0), 0.0)
