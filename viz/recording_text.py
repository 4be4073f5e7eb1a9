"""Texts of a recording: its summary, and the log of failures and exceeded limits.

A lasting condition, such as an inlet above its limit, has two entries in the log: one when it
begins and one when it ends.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C, USUAL_CLASS, allowable_c
from sdc_taichi.hall.protection import NORMAL, THROTTLED, TRIPPED
from sdc_taichi.run.failover import DEVICES, LIQUID_DEVICES
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, QUANTITIES, Reals, Status

from .colour_scales import ColourScale
from .hall_rasters import MAX_HALL_PARTS
from .recording_series import FIELD_ROWS

if TYPE_CHECKING:
    from .recording_series import Cadence

MAX_RACKS_PER_STEP = 8
"""Largest number of log entries about single racks per step and data center."""
_LEVELS = {NORMAL: "INFO", THROTTLED: "WARN", TRIPPED: "ERROR"}
_STATUS_NAMES = {NORMAL: "back to normal", THROTTLED: "throttled", TRIPPED: "tripped"}


_INPUTS_TEXTS = {
    True: "These figures rest on **synthetic** inputs, not on measurements.",
    False: "No input is synthetic.",
    None: "",
}
"""Sentence about the inputs of a run, keyed by whether some are synthetic; None is unknown."""


class LogEntry(NamedTuple):
    """One entry of the event log."""

    step: int
    """Step, counted from 0 at reset."""
    dc: int
    """Index of the data center."""
    level: str
    """``INFO``, ``WARN`` or ``ERROR``."""
    text: str
    """Message, on one line."""


class _Condition(NamedTuple):
    """Condition of a data center that holds while a quantity exceeds a limit.

    The log has an entry when the condition begins and an entry when it ends.
    """

    field: str
    """Name of the quantity, a field of ``StepResult``."""
    limit: float
    """Limit above which the condition holds, in the unit of the quantity."""
    level: str
    """Log level of the entry at the begin: ``WARN`` or ``ERROR``."""
    begin: str
    """Text of the entry at the begin, to which the value of the quantity is appended."""
    end: str
    """Text of the entry at the end, to which the maximum or the sum is appended."""
    is_summed: bool = False
    """True if the entry at the end reports the sum of the quantity, False for its maximum."""

    def value_text(self, value: float) -> str:
        """Return a value of the quantity as text with its unit; powers are in kW."""
        unit = QUANTITIES[self.field].unit
        if unit == "C":
            return f"{value:.1f} C"
        if unit == "W":
            value, unit = value / 1e3, "kW"
        return f"{value:{'.3g' if abs(value) < 100 else ',.0f'}} {unit}"


CONDITIONS = (
    _Condition(
        "unmet_w",
        100.0,
        "WARN",
        "cooling plant at its limit, heat stays in the room",
        "cooling plant below its limit again",
    ),
    _Condition("overdue_tasks", 1e-6, "WARN", "work overdue", "no work overdue any more"),
    _Condition("dropped_tasks", 1e-6, "ERROR", "work dropped", "no work dropped any more", True),
    _Condition("lost_tasks", 1e-6, "ERROR", "work lost", "no work lost any more", True),
    _Condition(
        "grid_overload_kwh",
        1e-9,
        "ERROR",
        "grid connection overloaded, above its limit",
        "grid connection within its limit again",
        True,
    ),
    _Condition("unserved_kwh", 1e-9, "ERROR", "energy unserved", "no energy unserved now", True),
)
"""Conditions that are logged for every data center, except those of its inlets.

Limits of inlets depend on the data center, see ``ConditionLog``.
"""


@dataclass(slots=True)
class _Ongoing:
    """State of a condition that has begun and not ended."""

    first_step: int
    """Step in which the condition began, counted from 0 at reset."""
    most: float
    """Maximum of the quantity since the condition began, in the unit of the quantity."""
    total: float
    """Sum of the quantity over the steps since the condition began, in its unit."""


class ConditionLog:
    """Finds the steps at which conditions of a data center begin and end, block by block."""

    def __init__(self, fleet: Fleet, dc: int) -> None:
        config = fleet.configs[dc]
        self._dc, self._per_row = dc, config.hall.racks_per_row
        self._step_h = 1.0 / fleet.steps_per_hour
        allowable_max_c = allowable_c(config.protection.ashrae_class)[1]
        inlets = [
            _Condition(
                "inlet_max_c",
                limit_c + LEAST_EXCESS_K,
                level,
                f"inlet above {name} {limit_c:g} C",
                f"inlets back within {name} {limit_c:g} C",
            )
            for name, limit_c, level in (
                ("recommended", RECOMMENDED_C[1], "WARN"),
                ("allowable", allowable_max_c, "ERROR"),
            )
        ]
        self._conditions = (*inlets, *CONDITIONS)
        self._rows = [FIELD_ROWS[c.field] for c in self._conditions]
        self._limits = np.array([c.limit for c in self._conditions])
        self._ongoing: dict[int, _Ongoing] = {}

    def entries(self, steps: I64, values: F64) -> Iterator[LogEntry]:
        """Yield the log entries of a block, condition by condition.

        Args:
            steps: steps of the block, (T,).
            values: values of ``FIELDS`` and PUE of the data center, (T, F).
        """
        watched = values[:, self._rows]
        over = watched > self._limits
        for index in sorted({*np.flatnonzero(over.any(axis=0)).tolist(), *self._ongoing}):
            yield from self._follow(index, steps, watched[:, index], over[:, index], values)

    def _follow(
        self, index: int, steps: I64, value: F64, over: npt.NDArray[np.bool_], values: F64
    ) -> Iterator[LogEntry]:
        """Yield the log entries of one condition in a block.

        Args:
            index: index of the condition.
            steps: steps of the block, (T,).
            value: values of the condition's quantity, (T,).
            over: True in each step in which the quantity exceeds its limit, (T,).
            values: values of ``FIELDS`` and PUE of the data center, (T, F).
        """
        condition = self._conditions[index]
        for t, step in enumerate(steps.tolist()):
            ongoing, now = self._ongoing.get(index), float(value[t])
            if over[t] and ongoing is None:
                self._ongoing[index] = _Ongoing(step, now, now)
                text = f"{condition.begin}: {condition.value_text(now)}"
                if condition.field == "inlet_max_c":
                    rack, server = (
                        int(values[t, FIELD_ROWS[f"hottest_{part}"]]) for part in ("rack", "server")
                    )
                    text += f" at {rack_place(rack, self._per_row)}, server {server} from the floor"
                yield LogEntry(step, self._dc, condition.level, text)
            elif over[t] and ongoing is not None:
                ongoing.most = max(ongoing.most, now)
                ongoing.total += now
            elif ongoing is not None:
                hours = (step - ongoing.first_step) * self._step_h
                amount = (
                    f"{condition.value_text(ongoing.total)} in all"
                    if condition.is_summed
                    else f"{condition.value_text(ongoing.most)} at the most"
                )
                time = f"{hours:g} h" if hours >= 1.0 else f"{60.0 * hours:.0f} min"
                text = f"{condition.end}, {amount} (after {time})"
                yield LogEntry(step, self._dc, "INFO", text)
                del self._ongoing[index]


def rack_place(rack: int, racks_per_row: int) -> str:
    """Return row and rack as text, such as ``row 2, rack 17``; both count from 0 in the hall."""
    return f"row {rack // racks_per_row}, rack {rack}"


def protection_entries(
    step: int,
    dc: int,
    racks_per_row: int,
    before: Status,
    after: Status,
    inlet_c: Reals,
) -> Iterator[LogEntry]:
    """Yield log entries for racks that throttled, tripped or recovered in a step.

    Args:
        step: the step, counted from 0 at reset.
        dc: index of the data center, which has R racks.
        racks_per_row: number of racks in a row of the hall.
        before: status of the racks before the step, (R,).
        after: status of the racks after the step, (R,).
        inlet_c: hottest server inlet of each rack, in C, (R,).
    """
    changed = np.flatnonzero(before != after)
    # Racks with the worst status come first, so that the limit omits the least important ones.
    ordered = changed[np.argsort(-after[changed].astype(np.int64), kind="stable")].tolist()
    for rack in ordered[:MAX_RACKS_PER_STEP]:
        status = int(after[rack])
        place = rack_place(rack, racks_per_row)
        text = f"rack {_STATUS_NAMES[status]}: {place}, inlet {inlet_c[rack]:.1f} C"
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
    """Yield log entries for failures and weather events that begin or have ended at a step.

    Args:
        step: the step, counted from 0 at reset.
        before: events that were active in the previous step.
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


def _event_text(event: ActiveEvent, fleet: Fleet) -> str:
    """Return the description of an event for the log."""
    if event.kind == "crac_down":
        return "all CRAC units down" if event.target is None else f"CRAC unit {event.target} down"
    devices = DEVICES | LIQUID_DEVICES
    if event.kind in devices:
        return f"{devices[event.kind]}: {event.share:.0%} left"
    if event.kind in ("cdu_down", "cdu_pump_down"):
        cdus = "all CDUs" if event.target is None else f"CDU {event.target}"
        return f"{cdus} down" if event.kind == "cdu_down" else f"a pump down in {cdus}"
    if event.kind == "leak":
        assert event.target is not None
        return f"leak: {rack_place(event.target, fleet.configs[event.dc].hall.racks_per_row)}"
    if event.kind == "rack_fan_failure":
        assert event.target is not None
        place = rack_place(event.target, fleet.configs[event.dc].hall.racks_per_row)
        return f"rack fans failed: {place}, airflow at {event.share:.0%}"
    if event.kind == "heat_wave":
        return f"heat wave, {event.offset_k:+g} K"
    return "links to other sites down" if event.kind == "link_down" else "grid outage"


def summary_markdown(
    description: Mapping[str, Any],
    fleet: Fleet,
    focus: Mapping[int, str],
    scales: Mapping[int, Mapping[str, ColourScale]],
    cadence: Cadence,
    reference: str,
) -> str:
    """Return a Markdown text about the run and its inputs, and about how to read the recording.

    Args:
        description: result of ``describe_run``, or a part of it.
        fleet: the fleet.
        focus: name in the recording of each data center in focus, keyed by its index.
        scales: colour scales of the heat maps by quantity, of each data center in focus.
        cadence: how often and how finely heat maps and 3D halls are recorded.
        reference: name of the reference of the map of changes.
    """
    # Ranges are the same in all data centers in focus.
    of_first = next(iter(scales.values()))
    of_maps = [(name, scale) for name, scale in of_first.items() if scale.unit != "K"]
    ranges = ", ".join(f"{name} {s.low:g} to {s.high:g} {s.unit}" for name, s in of_maps)
    resolution = ", ".join(f"{name} {s.resolution:.4g} {s.unit}" for name, s in of_maps)
    map_every = _steps_text(cadence.map_every_steps)
    map_in_events = _steps_text(cadence.map_every_steps_in_events)
    hall_every = _steps_text(cadence.hall_every_steps)
    in_events = _steps_text(cadence.hall_every_steps_in_events)
    lines = [
        "# sdc-taichi",
        f"{_count_text(fleet.size, 'data center')}, {_count_text(fleet.racks, 'rack')}, "
        f"{_count_text(fleet.servers, 'server')}; a step is {60 // fleet.steps_per_hour} minutes. "
        "Times are the start of the step, local standard time of the data center.",
        "",
        f"Series have every step, heat maps every {map_every} (while an event lasts every "
        f"{map_in_events}), the 3D hall every {hall_every} (every {in_events}). There the front of "
        f"a rack shows the hottest inlet {_levels_text(cadence)}, in the colours of the maps; "
        "aisles are rounded to half a rack's depth.",
        "",
        f"Colours cover: {ranges}; values beyond are drawn in the colours of its ends. The colours "
        f"of inlets jump at {_limits_text(scales, focus)}. Resolution: {resolution}. A pointer on "
        "a map names rack and value.",
        "",
        f"The map of changes shows inlets less those {reference}." * ("change" in of_first),
        "",
        _INPUTS_TEXTS[description.get("synthetic")],
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in _facts(description).items()),
        "",
        "Stage models: " + ", ".join(f"{k} {v}" for k, v in fleet.models.items()) + ".",
        "",
        "Counted as HVAC: " + ", ".join(fleet.configs[0].hvac.total_of) + ".",
    ]
    data_centers = description.get("data_centers", ())
    for dc, name in focus.items():
        about = data_centers[dc] if data_centers else {}
        lines += ["", *_data_center_lines(fleet, dc, name, about)]
    if fleet.size > len(focus):
        rest = _count_text(fleet.size - len(focus), "other data center")
        lines += ["", f"The {rest} count in the fleet series only."]
    return "\n".join(lines)


def _limits_text(scales: Mapping[int, Mapping[str, ColourScale]], names: Mapping[int, str]) -> str:
    """Return the limits of inlets that colours mark, in C, for each data center if they differ."""
    texts = {
        names[dc]: ", ".join(f"{value:g} C ({name})" for value, name in of_dc["inlet"].marks)
        for dc, of_dc in scales.items()
    }
    if len(set(texts.values())) == 1:
        return next(iter(texts.values())) or "no limit, as none is within the range"
    return "; ".join(f"{text} of {name}" for name, text in texts.items())


def _count_text(number: int, noun: str) -> str:
    """Return a number and a noun, with a plural "s" unless the number is 1."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _steps_text(steps: int) -> str:
    """Return an interval of steps as text that follows "every"."""
    return "step" if steps == 1 else f"{steps} steps"


def _levels_text(cadence: Cadence) -> str:
    """Return a text about which temperatures front and back of a rack of the 3D hall show."""
    if not cadence.has_servers:
        return (
            "of its servers, its back the mean outlet (in halls of more than "
            f"{MAX_HALL_PARTS:,} racks the hottest of some adjacent racks)"
        )
    return f"at each of {_count_text(max(cadence.levels), 'height')}, its back the hottest outlet"


def _facts(description: Mapping[str, Any]) -> dict[str, str]:
    """Return the rows of the table about the run: value of each known fact, keyed by name."""
    names = ("controller", "seed", "precision", "fingerprint")
    facts = {name: str(description[name]) for name in names if name in description}
    if versions := description.get("versions"):
        facts["versions"] = ", ".join(f"{name} {number}" for name, number in versions.items())
    if notes := description.get("notes"):
        facts["notes"] = "; ".join(note.replace("|", r"\|") for note in notes)
    return facts


def _data_center_lines(
    fleet: Fleet, dc: int, name: str, description: Mapping[str, Any]
) -> list[str]:
    """Return the lines of Markdown about a data center: site, hall and inputs.

    Args:
        fleet: the fleet.
        dc: index of the data center.
        name: name of the data center in the recording.
        description: entry of the data center in the result of ``describe_run``; may be empty.
    """
    config = fleet.configs[dc]
    first, last = fleet.rack_offsets[dc : dc + 2]
    servers = int(fleet.server_offsets[fleet.group_offsets[last]]) - int(
        fleet.server_offsets[fleet.group_offsets[first]]
    )
    location = description.get("location", config.site.location)
    provenance: Mapping[str, str] = description.get("provenance", {})
    hashes: Mapping[str, str] = description.get("sha256", {})
    server_class = config.protection.ashrae_class or USUAL_CLASS
    return [
        f"## {name}",
        config.description,
        "",
        f"- site {location}, from {config.site.start}",
        f"- hall of {_count_text(config.hall.rows, 'row')} with "
        f"{_count_text(config.hall.racks_per_row, 'rack')} each, {_count_text(servers, 'server')}",
        f"- limits of inlets: those of ASHRAE class {server_class}",
        *(f"- {kind}: {source}" for kind, source in provenance.items()),
        *(f"- SHA-256 of the {kind} file: `{value}`" for kind, value in hashes.items()),
    ]
