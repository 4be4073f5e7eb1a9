"""Log of a recording: limits passed, work lost, racks protecting themselves, failures.

What lasts has an entry when it begins and one when it ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C, allowable_c
from sdc_taichi.hall.protection import NORMAL, THROTTLED, TRIPPED
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, Reals, Status

from .recording_series import FIELD_ROWS

MAX_RACKS_PER_STEP = 8
"""Largest number of racks named when those of a data center change status in one step."""
_LEVELS = {NORMAL: "INFO", THROTTLED: "WARN", TRIPPED: "ERROR"}
_STATUS_NAMES = {NORMAL: "back to normal", THROTTLED: "throttled", TRIPPED: "tripped"}


class LogEntry(NamedTuple):
    """One line of the log."""

    step: int
    """Step, counted from 0 at reset."""
    dc: int
    """Index of the data center."""
    level: str
    """``INFO``, ``WARN`` or ``ERROR``."""
    text: str
    """Message, on one line."""


def _short_number(value: float) -> str:
    """A number with three digits, or all those before the point."""
    return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"


class _Condition(NamedTuple):
    """State of a data center that lasts while a field exceeds a limit."""

    begin_text: str
    """Text of the first entry, with ``{value}`` and ``{place}`` of the hottest server."""
    end_text: str
    """Text of the last entry, with ``{most}`` and ``{total}`` of the field since the first one."""
    field: str
    """Field of ``StepResult``."""
    limit: float
    """Value that the field exceeds, in its unit."""
    level: str
    """Level of the first entry."""
    factor: float = 1.0
    """Unit of the field over the unit of the text."""
    number_format: Callable[[float], str] = _short_number
    """Writes a number, in the unit of the text."""


def _conditions(allowable_max_c: float) -> tuple[_Condition, ...]:
    """Conditions of a data center.

    Args:
        allowable_max_c: highest allowable inlet temperature, in C.
    """
    recommended = RECOMMENDED_C[1]
    return (
        _Condition(
            f"inlet above recommended {recommended:g} C: {{value}} C at {{place}}",
            f"inlets back within recommended {recommended:g} C, hottest was {{most}} C",
            "inlet_max_c",
            recommended + LEAST_EXCESS_K,
            "WARN",
            number_format="{:.1f}".format,
        ),
        _Condition(
            f"inlet above allowable {allowable_max_c:g} C: {{value}} C at {{place}}",
            f"inlets back within allowable {allowable_max_c:g} C, hottest was {{most}} C",
            "inlet_max_c",
            allowable_max_c + LEAST_EXCESS_K,
            "ERROR",
            number_format="{:.1f}".format,
        ),
        _Condition(
            "cooling plant at its limit: {value} kW of heat stay in the room",
            "cooling plant below its limit again, {most} kW at the most",
            "unmet_w",
            1.0,
            "WARN",
            factor=1e-3,
        ),
        _Condition(
            "work overdue: {value} tasks found no capacity",
            "no work overdue any more, {most} tasks at the most",
            "overdue_tasks",
            1e-6,
            "WARN",
        ),
        _Condition(
            "work dropped: {value} tasks found the queue full",
            "no work dropped any more, {total} tasks in all",
            "dropped_tasks",
            1e-6,
            "ERROR",
        ),
        _Condition(
            "work lost: {value} tasks went down with their servers",
            "no work lost any more, {total} tasks in all",
            "lost_tasks",
            1e-6,
            "ERROR",
        ),
        _Condition(
            "grid connection overloaded: {value} kWh beyond its limit in the step",
            "grid connection within its limit again, {total} kWh beyond it in all",
            "grid_overload_kwh",
            1e-9,
            "ERROR",
        ),
        _Condition(
            "energy unserved: {value} kWh",
            "no energy unserved any more, {total} kWh in all",
            "unserved_kwh",
            1e-9,
            "ERROR",
        ),
    )


@dataclass(slots=True)
class _Ongoing:
    """A condition that lasts."""

    first_step: int
    """Step in which the condition began, counted from 0 at reset."""
    most: float
    """Highest value since, in the unit of the field."""
    total: float
    """Sum of the values since, in the unit of the field."""


class ConditionLog:
    """Finds where conditions of a data center begin and end, block by block.

    Args:
        fleet: the fleet.
        dc: index of the data center.
    """

    def __init__(self, fleet: Fleet, dc: int) -> None:
        config = fleet.configs[dc]
        self._dc, self._per_row = dc, config.hall.racks_per_row
        self._step_h = 1.0 / fleet.steps_per_hour
        self._conditions = _conditions(allowable_c(config.protection.ashrae_class)[1])
        self._rows = [FIELD_ROWS[c.field] for c in self._conditions]
        self._limits = np.array([c.limit for c in self._conditions])
        self._ongoing: dict[int, _Ongoing] = {}

    def entries(self, steps: I64, values: F64) -> Iterator[LogEntry]:
        """Entries of a block, condition by condition.

        Args:
            steps: steps of the block, (T,).
            values: values of ``FIELDS``, (T, F).
        """
        watched = values[:, self._rows]
        over = watched > self._limits
        for index in sorted({*np.flatnonzero(over.any(axis=0)).tolist(), *self._ongoing}):
            yield from self._follow(index, steps, watched[:, index], over[:, index], values)

    def _follow(
        self, index: int, steps: I64, value: F64, over: npt.NDArray[np.bool_], values: F64
    ) -> Iterator[LogEntry]:
        """Entries of one condition in a block.

        Args:
            index: index of the condition.
            steps: steps of the block, (T,).
            value: values of the condition's field, (T,).
            over: whether these exceed the limit, (T,).
            values: values of ``FIELDS``, (T, F).
        """
        condition = self._conditions[index]
        for t in range(len(steps)):
            ongoing = self._ongoing.get(index)
            if over[t]:
                if ongoing is None:
                    first = float(value[t])
                    self._ongoing[index] = _Ongoing(int(steps[t]), first, first)
                    place = rack_place(
                        int(values[t, FIELD_ROWS["hottest_rack"]]),
                        self._per_row,
                        int(values[t, FIELD_ROWS["hottest_server"]]),
                    )
                    shown = condition.number_format(value[t] * condition.factor)
                    text = condition.begin_text.format(value=shown, place=place)
                    yield LogEntry(int(steps[t]), self._dc, condition.level, text)
                else:
                    ongoing.most = max(ongoing.most, float(value[t]))
                    ongoing.total += float(value[t])
            elif ongoing is not None:
                hours = (int(steps[t]) - ongoing.first_step) * self._step_h
                most, total = (
                    condition.number_format(x * condition.factor)
                    for x in (ongoing.most, ongoing.total)
                )
                text = condition.end_text.format(most=most, total=total)
                yield LogEntry(int(steps[t]), self._dc, "INFO", f"{text} (after {hours:g} h)")
                del self._ongoing[index]


def rack_place(rack: int, racks_per_row: int, server: int | None = None) -> str:
    """Words for the place of a rack in its hall, or of a server in it; all count from 0."""
    place = f"row {rack // racks_per_row}, rack {rack}"
    return place if server is None else f"{place}, server {server} from the floor"


def protection_entries(
    step: int,
    dc: int,
    racks_per_row: int,
    before: Status,
    after: Status,
    hottest: Callable[[int], tuple[int | None, float]],
) -> Iterator[LogEntry]:
    """Racks of a data center that throttled, tripped or came back in a step.

    Args:
        step: the step, counted from 0 at reset.
        dc: index of the data center.
        racks_per_row: number of racks in a row of its hall.
        before: status of its racks before the step, (R,).
        after: status of its racks after the step, (R,).
        hottest: from a rack to its hottest server, None if that is not known, and the server's
            inlet in C.
    """
    changed = np.flatnonzero(before != after)
    # The worst first, so that those not named are the harmless ones.
    ordered = changed[np.argsort(-after[changed].astype(np.int64), kind="stable")].tolist()
    for rack in ordered[:MAX_RACKS_PER_STEP]:
        status = int(after[rack])
        server, inlet_c = hottest(rack)
        place = rack_place(rack, racks_per_row, server)
        text = f"rack {_STATUS_NAMES[status]}: {place}, inlet {inlet_c:.1f} C"
        yield LogEntry(step, dc, _LEVELS[status], text)
    if len(ordered) > MAX_RACKS_PER_STEP:
        rest = after[ordered[MAX_RACKS_PER_STEP:]]
        worst = int(rest.max())
        counts = ", ".join(
            f"{np.count_nonzero(rest == status)} {name}"
            for status, name in _STATUS_NAMES.items()
            if np.any(rest == status)
        )
        yield LogEntry(step, dc, _LEVELS[worst], f"and more racks: {counts}")


def failure_entries(
    step: int,
    before: Sequence[ActiveEvent],
    now: Sequence[ActiveEvent],
    fleet: Fleet,
) -> Iterator[LogEntry]:
    """Failures and weather events that begin or end with a step.

    Args:
        step: the step, counted from 0 at reset.
        before: events that were active in the step before.
        now: events that are active in the step.
        fleet: the fleet.
    """
    for event in now:
        if event not in before:
            text = f"{_event_text(event, fleet)}, steps {event.start_step} to {event.end_step - 1}"
            yield LogEntry(step, event.dc, "ERROR", text)
    for event in before:
        if event not in now:
            yield LogEntry(step, event.dc, "INFO", f"over: {_event_text(event, fleet)}")


_SHARE_LEFT: dict[str, str] = {
    "chiller_derate": "chiller at {} of its capacity",
    "pump_down": "{} of the chilled-water pumps left",
    "tower_cell_down": "{} of the tower cells left",
    "dry_cooler_down": "{} of the dry coolers left",
    "outdoor_air_closed": "{} of the openings for outdoor air left",
}
"""Words for events that leave a share of a device of the plant, by their kind."""


def _event_text(event: ActiveEvent, fleet: Fleet) -> str:
    """Words for an event."""
    if event.kind == "crac_down":
        return "all CRAC units down" if event.target is None else f"CRAC unit {event.target} down"
    if event.kind in _SHARE_LEFT:
        return _SHARE_LEFT[event.kind].format(f"{event.share:.0%}")
    if event.kind == "rack_fan_failure":
        assert event.target is not None
        place = rack_place(event.target, fleet.configs[event.dc].hall.racks_per_row)
        return f"rack fans failed: {place}, airflow at {event.share:.0%}"
    if event.kind == "heat_wave":
        return f"heat wave, {event.offset_k:+g} K"
    return "grid outage"


def hottest_server(inlet_c: Reals, fleet: Fleet, rack: int) -> tuple[int, float]:
    """Hottest server of a rack, counted from the floor, and its inlet in C.

    Args:
        inlet_c: inlets of the server groups, in C, (G,).
        fleet: the fleet.
        rack: index of the rack, counted over the whole fleet.
    """
    first, last = fleet.group_offsets[rack : rack + 2]
    group = first + int(np.argmax(inlet_c[first:last]))
    return int(fleet.server_offsets[group] - fleet.server_offsets[first]), float(inlet_c[group])
