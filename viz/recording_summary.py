"""Summary of a recording: the page that says what was run and how to read the views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sdc_taichi.run.hottest_air import AirAtStep
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.inlet_parts import (
    HOTTEST_RACKS,
    Inlets,
    exhaust_terms,
    inlet_terms,
    rack_text,
    state_texts,
)

from .hall_rasters import ColourScale
from .recording_cadence import Cadence


def summary_markdown(
    description: Mapping[str, Any],
    fleet: Fleet,
    focus: Mapping[int, str],
    scales: Mapping[str, ColourScale],
    cadence: Cadence,
) -> str:
    """Markdown of what was run, on which inputs, and how to read the recording.

    Args:
        description: what ``describe_run`` says of the run, or a part of it.
        fleet: the fleet.
        focus: from the index of each data center in focus to its name in the recording.
        scales: colour scales of the heat maps, by quantity.
        cadence: how often heat maps and halls are recorded.
    """
    ranges = ", ".join(f"{name} {s.low:g} to {s.high:g} {s.unit}" for name, s in scales.items())
    resolution = ", ".join(f"{name} {s.resolution:.4g} {s.unit}" for name, s in scales.items())
    map_every = _steps_text(cadence.map_every_steps)
    hall_every = _steps_text(cadence.hall_every_steps)
    in_events = _steps_text(cadence.hall_every_steps_in_events)
    lines = [
        "# sdc-taichi",
        f"{_count_text(fleet.size, 'data center')}, {_count_text(fleet.racks, 'rack')}, "
        f"{_count_text(fleet.servers, 'server')}; a step is {60 // fleet.steps_per_hour} minutes. "
        "Times are the start of the step, local standard time of the data center, in the year "
        "2001.",
        "",
        f"Series have every step, heat maps every {map_every}, the 3D hall every {hall_every}, "
        f"while an event lasts every {in_events}. There the front of a rack shows the hottest "
        f"inlet {_levels_text(cadence)}, in the colours of the maps; aisles are rounded to half a "
        "rack's depth.",
        "",
        f"Colours cover: {ranges}; values beyond are drawn as its ends. Resolution: {resolution}.",
        "",
        _inputs_text(description),
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
        own = data_centers[dc] if data_centers else {}
        lines += ["", *_data_center_lines(fleet, dc, name, own)]
    if fleet.size > len(focus):
        rest = _count_text(fleet.size - len(focus), "other data center")
        lines += ["", f"The {rest} count in the fleet series only."]
    return "\n".join(lines)


def hottest_markdown(fleet: Fleet, dc: int, found: AirAtStep, clock: str) -> str:
    """Markdown that says why the hottest racks of a data center are as hot as they are.

    Args:
        fleet: the fleet.
        dc: index of the data center.
        found: its air in its hottest step.
        clock: when the step begins, on the clock of the data center.
    """
    per_row = fleet.configs[dc].hall.racks_per_row
    inlets = Inlets(fleet, dc, found.air)
    when = clock[5:].replace("T", " ")
    lines = ["# Why the hottest racks are hot", f"At the end of step {found.step}, {when}."]
    for rack in inlets.hottest(HOTTEST_RACKS):
        parts = inlets.parts(rack)
        (first, setpoint_c), *others = inlet_terms(parts, per_row)
        lines += [
            "",
            f"## {rack_text(rack, per_row)}: {parts.inlet_c:.2f} C",
            "",
            "| | |",
            "|---:|---|",
            f"| {setpoint_c:.2f} C | {first} |",
            *(f"| {k:+.2f} K | {text} |" for text, k in others),
            "",
        ]
        why = ", ".join(f"{k:+.2f} K {text}" for text, k in exhaust_terms(parts))
        if why:
            lines += [f"{100 * parts.exhaust_share:.1f} % of its intake is exhaust air: {why}.", ""]
        lines += [f"- {text}" for text in state_texts(parts)]
    return "\n".join(lines)


def _count_text(number: int, noun: str) -> str:
    """A number and a noun, in the plural unless the number is 1."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _steps_text(steps: int) -> str:
    """An interval in words."""
    return "step" if steps == 1 else f"{steps} steps"


def _levels_text(cadence: Cadence) -> str:
    """Words for the temperatures that front and back of a rack of the 3D hall show."""
    if not cadence.has_servers:
        return "of its servers, its back the mean outlet"
    return f"at each of {_count_text(max(cadence.levels), 'height')}, its back the hottest outlet"


def _inputs_text(description: Mapping[str, Any]) -> str:
    """Whether inputs are synthetic, in words."""
    if "synthetic" not in description:
        return ""
    if description["synthetic"]:
        return "These figures rest on **synthetic** inputs, not on measurements."
    return "No input is synthetic."


def _facts(description: Mapping[str, Any]) -> dict[str, str]:
    """Facts of the run that are known, by name."""
    known = {
        name: description[name]
        for name in ("controller", "seed", "precision")
        if name in description
    }
    facts = {name: str(value) for name, value in known.items()}
    if "fingerprint" in description:
        facts["fingerprint"] = f"`{description['fingerprint']}`"
    versions: Mapping[str, str] = description.get("versions", {})
    if versions:
        facts["versions"] = ", ".join(f"{name} {number}" for name, number in versions.items())
    notes: Sequence[str] = description.get("notes", ())
    if notes:
        facts["notes"] = "; ".join(note.replace("|", r"\|") for note in notes)
    return facts


def _data_center_lines(
    fleet: Fleet, dc: int, name: str, description: Mapping[str, Any]
) -> list[str]:
    """Markdown of a data center: site, hall and inputs."""
    config = fleet.configs[dc]
    first, last = fleet.rack_offsets[dc : dc + 2]
    servers = int(fleet.server_offsets[fleet.group_offsets[last]]) - int(
        fleet.server_offsets[fleet.group_offsets[first]]
    )
    location = description.get("location", config.site.location)
    provenance: Mapping[str, str] = description.get("provenance", {})
    hashes: Mapping[str, str] = description.get("sha256", {})
    return [
        f"## {name}",
        config.description,
        "",
        f"- site {location}, from {config.site.start}",
        f"- hall of {_count_text(config.hall.rows, 'row')} with "
        f"{_count_text(config.hall.racks_per_row, 'rack')} each, {_count_text(servers, 'server')}",
        *(f"- {kind}: {source}" for kind, source in provenance.items()),
        *(f"- SHA-256 of the {kind} file: `{value}`" for kind, value in hashes.items()),
    ]
