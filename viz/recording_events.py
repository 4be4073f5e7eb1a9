"""What a recording logs as text: limits passed, work lost, racks protecting themselves, failures.

Everything is told once when it begins and once when it ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.hall.air_metrics import RECOMMENDED_C, allowable_c
from sdc_taichi.hall.protection import NORMAL, THROTTLED, TRIPPED
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, Reals, Status

from .recording_series import ROW

MOST_RACKS_PER_STEP = 8
"""Racks named when more of a data center change their status in one step; the rest are counted."""
_LEVELS = {NORMAL: "INFO", THROTTLED: "WARN", TRIPPED: "ERROR"}
_VERBS = {NORMAL: "back to normal", THROTTLED: "throttled", TRIPPED: "tripped"}


class Entry(NamedTuple):
    """One line of the log."""

    step: int
    dc: int
    level: str
    text: str


def _figure(value: float) -> str:
    """Three digits or all before the point."""
    return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"


class _Condition(NamedTuple):
    """Something that a data center does while a field exceeds a limit."""

    begins: str
    """Text with the value, and the place of the hottest server."""
    ends: str
    """Text with the highest value and the sum since it began."""
    field: str
    limit: float
    level: str
    factor: float = 1.0
    form: Callable[[float], str] = _figure


def _conditions(high_c: float) -> tuple[_Condition, ...]:
    recommended = RECOMMENDED_C[1]
    return (
        _Condition(
            f"inlet above recommended {recommended:g} C: {{value}} C at {{place}}",
            f"inlets back within recommended {recommended:g} C, hottest was {{most}} C",
            "inlet_max_c",
            recommended,
            "WARN",
            form="{:.1f}".format,
        ),
        _Condition(
            f"inlet above allowable {high_c:g} C: {{value}} C at {{place}}",
            f"inlets back within allowable {high_c:g} C, hottest was {{most}} C",
            "inlet_max_c",
            high_c,
            "ERROR",
            form="{:.1f}".format,
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
            "energy unserved: {value} kWh",
            "no energy unserved any more, {total} kWh in all",
            "unserved_kwh",
            1e-9,
            "ERROR",
        ),
    )


@dataclass(slots=True)
class _Since:
    """What a condition has come to since it began."""

    step: int
    most: float
    total: float


class Watch:
    """Finds where conditions of a data center begin and end, block by block.

    Args:
        fleet: the fleet.
        dc: the data center.
    """

    def __init__(self, fleet: Fleet, dc: int) -> None:
        config = fleet.configs[dc]
        self._dc, self._per_row = dc, config.hall.racks_per_row
        self._step_h = 1.0 / fleet.steps_per_hour
        self._conditions = _conditions(allowable_c(config.protection.ashrae_class)[1])
        self._rows = [ROW[c.field] for c in self._conditions]
        self._limits = np.array([c.limit for c in self._conditions])
        self._since: dict[int, _Since] = {}

    def look(self, steps: I64, values: F64) -> Iterator[Entry]:
        """Entries of a block.

        Args:
            steps: of the block, (T,).
            values: of ``FIELDS``, (T, fields).
        """
        watched = values[:, self._rows]
        over = watched > self._limits
        for index in sorted({*np.flatnonzero(over.any(axis=0)).tolist(), *self._since}):
            yield from self._follow(index, steps, watched[:, index], over[:, index], values)

    def _follow(
        self, index: int, steps: I64, value: F64, over: npt.NDArray[np.bool_], values: F64
    ) -> Iterator[Entry]:
        condition = self._conditions[index]
        for t in range(len(steps)):
            since = self._since.get(index)
            if over[t]:
                if since is None:
                    self._since[index] = _Since(int(steps[t]), float(value[t]), float(value[t]))
                    where = place(
                        int(values[t, ROW["hottest_rack"]]),
                        self._per_row,
                        int(values[t, ROW["hottest_server"]]),
                    )
                    shown = condition.form(value[t] * condition.factor)
                    text = condition.begins.format(value=shown, place=where)
                    yield Entry(int(steps[t]), self._dc, condition.level, text)
                else:
                    since.most = max(since.most, float(value[t]))
                    since.total += float(value[t])
            elif since is not None:
                hours = (int(steps[t]) - since.step) * self._step_h
                most, total = (
                    condition.form(x * condition.factor) for x in (since.most, since.total)
                )
                text = condition.ends.format(most=most, total=total)
                yield Entry(int(steps[t]), self._dc, "INFO", f"{text} (after {hours:g} h)")
                del self._since[index]


def place(rack: int, racks_per_row: int, server: int | None = None) -> str:
    """Where a rack of a data center stands, or a server in it; all count from 0."""
    found = f"row {rack // racks_per_row}, rack {rack}"
    return found if server is None else f"{found}, server {server} from the floor"


def protection_entries(
    step: int,
    dc: int,
    racks_per_row: int,
    before: Status,
    after: Status,
    hottest: Callable[[int], tuple[int | None, float]],
) -> Iterator[Entry]:
    """Racks of a data center that throttled, tripped or came back in a step.

    Args:
        step: the step.
        dc: the data center.
        racks_per_row: of its hall.
        before: status of its racks before the step, (R,).
        after: status after it, (R,).
        hottest: from a rack to its hottest server, if it is known, and that one's inlet in C.
    """
    changed = np.flatnonzero(before != after)
    # The worst first, so that those not named are the harmless ones.
    ordered = changed[np.argsort(-after[changed].astype(np.int64), kind="stable")].tolist()
    for rack in ordered[:MOST_RACKS_PER_STEP]:
        status = int(after[rack])
        server, inlet_c = hottest(rack)
        where = place(rack, racks_per_row, server)
        yield Entry(
            step, dc, _LEVELS[status], f"rack {_VERBS[status]}: {where}, inlet {inlet_c:.1f} C"
        )
    if len(ordered) > MOST_RACKS_PER_STEP:
        rest = after[ordered[MOST_RACKS_PER_STEP:]]
        worst = int(rest.max())
        counts = ", ".join(
            f"{np.count_nonzero(rest == status)} {verb}"
            for status, verb in _VERBS.items()
            if np.any(rest == status)
        )
        yield Entry(step, dc, _LEVELS[worst], f"and more racks: {counts}")


def failure_entries(
    step: int,
    before: Sequence[ActiveEvent],
    now: Sequence[ActiveEvent],
    fleet: Fleet,
) -> Iterator[Entry]:
    """Failures and weather events that begin or end with a step."""
    for event in now:
        if event not in before:
            text = f"{_told(event, fleet)}, steps {event.start_step} to {event.end_step - 1}"
            yield Entry(step, event.dc, "ERROR", text)
    for event in before:
        if event not in now:
            yield Entry(step, event.dc, "INFO", f"over: {_told(event, fleet)}")


def _told(event: ActiveEvent, fleet: Fleet) -> str:
    if event.kind == "crac_down":
        return "all CRAC units down" if event.target is None else f"CRAC unit {event.target} down"
    if event.kind == "chiller_derate":
        return f"chiller at {event.share:.0%} of its capacity"
    if event.kind == "rack_fan_failure":
        assert event.target is not None
        where = place(event.target, fleet.configs[event.dc].hall.racks_per_row)
        return f"rack fans failed: {where}, airflow at {event.share:.0%}"
    if event.kind == "heat_wave":
        return f"heat wave, {event.offset_k:+g} K"
    return "grid outage"


def hottest_server(inlet_c: Reals, fleet: Fleet, rack: int) -> tuple[int, float]:
    """Hottest server of a rack of the fleet, counted from the floor, and its inlet.

    Args:
        inlet_c: layer of the server groups, (G,).
        fleet: the fleet.
        rack: counted over the whole fleet.
    """
    first, last = fleet.group_offsets[rack : rack + 2]
    group = first + int(np.argmax(inlet_c[first:last]))
    return int(fleet.server_offsets[group] - fleet.server_offsets[first]), float(inlet_c[group])
