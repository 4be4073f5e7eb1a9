"""The page of a recording that says what it holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sdc_taichi.sim.fleet import Fleet

from .hall_layers import Scale
from .recording_reader import Cadence


def summary(
    about: Mapping[str, Any],
    fleet: Fleet,
    focus: Mapping[int, str],
    scales: Mapping[str, Scale],
    cadence: Cadence,
) -> str:
    """Markdown of what was run, on which inputs, and how to read the recording.

    Args:
        about: of ``describe_run``, or a part of it.
        fleet: the fleet.
        focus: data centers in focus and the names they have here.
        scales: of the heat maps.
        cadence: how often what is recorded.
    """
    ranges = ", ".join(f"{what} {s.low:g} to {s.high:g} {s.unit}" for what, s in scales.items())
    resolution = ", ".join(f"{what} {s.quantum:.4g} {s.unit}" for what, s in scales.items())
    lines = [
        "# sdc-taichi",
        f"{_counted(fleet.size, 'data center')}, {_counted(fleet.racks, 'rack')}, "
        f"{_counted(fleet.servers, 'server')}; a step is {60 // fleet.steps_per_hour} minutes. "
        "Times are the start of the step, local standard time of the data center, in the year "
        "2001.",
        "",
        f"Series have every step, heat maps every {_each(cadence.map_every)}, the 3D hall every "
        f"{_each(cadence.hall_every)}, while an event lasts every "
        f"{_each(cadence.hall_every_in_events)}. There the front of a rack shows the hottest inlet "
        f"{_heights(cadence)}, in the colours of the maps; aisles are rounded to half a rack's "
        "depth.",
        "",
        f"Colours cover: {ranges}; values beyond are drawn as its ends. Resolution: {resolution}.",
        "",
        _inputs(about),
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in _facts(about).items()),
        "",
        "Stage models: " + ", ".join(f"{k} {v}" for k, v in fleet.models.items()) + ".",
        "",
        "Counted as HVAC: " + ", ".join(fleet.configs[0].hvac.total_of) + ".",
    ]
    described = about.get("data_centers", ())
    for dc, name in focus.items():
        lines += ["", *_data_center(fleet, dc, name, described[dc] if described else {})]
    if fleet.size > len(focus):
        rest = _counted(fleet.size - len(focus), "other data center")
        lines += ["", f"The {rest} count in the fleet series only."]
    return "\n".join(lines)


def _counted(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def _each(steps: int) -> str:
    return "step" if steps == 1 else f"{steps} steps"


def _heights(cadence: Cadence) -> str:
    if not cadence.per_server:
        return "of its servers, its back the mean outlet"
    return f"at each of {_counted(max(cadence.zones), 'height')}, its back the hottest outlet"


def _inputs(about: Mapping[str, Any]) -> str:
    if "synthetic" not in about:
        return ""
    if about["synthetic"]:
        return "These figures rest on **synthetic** inputs, not on measurements."
    return "No input is synthetic."


def _facts(about: Mapping[str, Any]) -> dict[str, str]:
    """What there is to say of the run, by name."""
    known = {name: about[name] for name in ("controller", "seed", "precision") if name in about}
    facts = {name: str(value) for name, value in known.items()}
    if "fingerprint" in about:
        facts["fingerprint"] = f"`{about['fingerprint']}`"
    versions: Mapping[str, str] = about.get("versions", {})
    if versions:
        facts["versions"] = ", ".join(f"{name} {number}" for name, number in versions.items())
    notes: Sequence[str] = about.get("notes", ())
    if notes:
        facts["notes"] = "; ".join(note.replace("|", r"\|") for note in notes)
    return facts


def _data_center(fleet: Fleet, dc: int, name: str, described: Mapping[str, Any]) -> list[str]:
    config = fleet.configs[dc]
    first, last = fleet.rack_offsets[dc : dc + 2]
    servers = int(fleet.server_offsets[fleet.group_offsets[last]]) - int(
        fleet.server_offsets[fleet.group_offsets[first]]
    )
    provenance: Mapping[str, str] = described.get("provenance", {})
    hashes: Mapping[str, str] = described.get("sha256", {})
    return [
        f"## {name}",
        config.description,
        "",
        f"- site {config.site.location}, from {config.site.start}, seed {config.site.seed}",
        f"- hall of {_counted(config.hall.rows, 'row')} with "
        f"{_counted(config.hall.racks_per_row, 'rack')} each, {_counted(servers, 'server')}",
        *(f"- {kind}: {source}" for kind, source in provenance.items()),
        *(f"- SHA-256 of the {kind} file: `{value}`" for kind, value in hashes.items()),
    ]
