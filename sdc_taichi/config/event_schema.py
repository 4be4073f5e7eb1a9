"""Sections ``events`` and ``protection``: failures in a run, and how servers protect themselves."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from sdc_taichi.config.fields import AirC, Plant, RiseK, Section, Share

EventKind = Literal[
    "crac_down",
    "chiller_derate",
    "pump_down",
    "tower_cell_down",
    "dry_cooler_down",
    "outdoor_air_closed",
    "rack_fan_failure",
    "heat_wave",
    "grid_outage",
]

WaveK = Annotated[float, Field(ge=-40, le=40)]
"""Addition to temperatures outdoors, -40..40 K: the largest departure from the climate on record is
39 K (Dome C, Antarctica, March 2022)."""

DurationH = Annotated[float, Field(ge=0.001, le=876_000)]
"""Duration of an event, 0.001..876,000 h: from a few seconds to a century."""

OutletC = Annotated[float, Field(ge=20, le=120)]
"""Temperature of the air that leaves servers, 20..120 C: from inlets to what damages any board."""

LEAST_DRAUGHT_SHARE = 0.01
"""Least share of its airflow that a rack keeps without fans, as warm air rises through it."""

_REQUIRED: dict[EventKind, tuple[str, ...]] = {
    "crac_down": (),
    "chiller_derate": ("share",),
    "pump_down": ("share",),
    "tower_cell_down": ("share",),
    "dry_cooler_down": ("share",),
    "outdoor_air_closed": ("share",),
    "rack_fan_failure": ("rack", "share"),
    "heat_wave": ("offset_k",),
    "grid_outage": (),
}
_OPTIONAL: dict[EventKind, tuple[str, ...]] = {"crac_down": ("unit",)}
PLANT_OF_EVENT: dict[EventKind, Plant] = {
    "tower_cell_down": "water_cooled",
    "dry_cooler_down": "air_cooled",
    "outdoor_air_closed": "air_side",
}
"""Plant that has the device of an event; the other kinds happen with every plant."""


class ProtectionConfig(Section):
    """Response of servers to inlets above the allowable range of their class, and to hot outlets.

    Above a limit a rack throttles; above a trip temperature it switches off and loses the work of
    the step. It stays off until cooling has been in order, and its inlet at most ``restart_c``, for
    ``restart_hold_min``; then racks start again in stages.
    """

    ashrae_class: Literal["A1", "A2", "A3", "A4"] | None = None
    """ASHRAE TC 9.9 (2021) class of the servers; the upper end of its allowable range is the limit
    of the inlets. None is no protection."""
    throttle_share: Share = 0.5
    """Utilisation that a throttled rack may reach, 0..1."""
    trip_margin_k: RiseK = 5.0
    """Inlet above the limit at which a rack switches off, in K."""
    restart_c: AirC | None = None
    """Warmest inlet at which a rack that has switched off starts again, in C; None is midway
    between the recommended 27 C and the limit of the class."""
    outlet_limit_c: OutletC | None = 70.0
    """Outlet above which a rack throttles, in C; None leaves outlets out. 70 C is the default limit
    of the exhaust of Dell PowerEdge servers (``ThermalSettings.AirExhaustTemp`` of iDRAC)."""
    outlet_trip_c: OutletC = 80.0
    """Outlet above which a throttled rack switches off, in C. 80 C is the critical threshold of the
    exhaust sensor of Dell PowerEdge R750 servers."""
    restart_hold_min: Annotated[float, Field(ge=0, le=1440)] = 5.0
    """Time for which cooling and inlet have to be in order before a rack starts again, in min,
    0..1,440: from at once to a day."""
    restart_share: Annotated[float, Field(ge=0.001, le=1)] = 0.1
    """Share of the racks of a data center that start again in a minute, at least one rack in a
    step, 0.001..1: from a day for a thousand racks to all at once."""

    @model_validator(mode="after")
    def _throttles_before_it_trips(self) -> Self:
        limit_c = self.outlet_limit_c
        if limit_c is not None and limit_c > self.outlet_trip_c:
            raise ValueError(
                f"outlet_limit_c {limit_c:g} must not exceed outlet_trip_c {self.outlet_trip_c:g}"
            )
        return self


class ScheduledEvent(Section):
    """A failure or weather event at a known time."""

    kind: EventKind
    """Kind of event."""
    start_h: Annotated[float, Field(ge=0, le=876_000)]
    """Start of the event after reset, in h, before the end of the run; at most 876,000, a
    century."""
    duration_h: DurationH
    """Duration of the event, in h."""
    unit: Annotated[int, Field(ge=0, le=9_999)] | None = None
    """CRAC unit that is down, counted from 0, below their number; None is all of them."""
    rack: Annotated[int, Field(ge=0, le=9_999_999)] | None = None
    """Rack whose fans fail, counted from 0, row by row, below their number."""
    share: Share | None = None
    """Chiller capacity, pumps, tower cells, dry coolers, openings for outdoor air or rack airflow
    that remain, as a share of all, 0..1."""
    offset_k: WaveK | None = None
    """Addition of a heat wave to the dry bulb and the wet bulb alike, in K."""

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> Self:
        _check_fields_of_kind(self)
        return self


class SampledEvent(Section):
    """Failures or weather events at random times: a Poisson process with uniform durations.

    CRAC units and racks are drawn evenly.
    """

    kind: EventKind
    """Kind of event."""
    per_year: Annotated[float, Field(ge=1e-6, le=8760)]
    """Mean number of events in a year, from one in a million years to one an hour."""
    duration_h: tuple[DurationH, DurationH]
    """Shortest and longest duration of an event, in h."""
    share: Share | None = None
    """Chiller capacity, pumps, tower cells, dry coolers, openings for outdoor air or rack airflow
    that remain, as a share of all, 0..1."""
    offset_k: WaveK | None = None
    """Addition of a heat wave to the dry bulb and the wet bulb alike, in K."""

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> Self:
        low, high = self.duration_h
        if not low <= high:
            raise ValueError(f"duration_h ({low:g}, {high:g}) must be (low, high) with low <= high")
        _check_fields_of_kind(self)
        return self


class EventsConfig(Section):
    """Failures and weather events of a run."""

    scheduled: tuple[ScheduledEvent, ...] = ()
    """Events at known times."""
    sampled: tuple[SampledEvent, ...] = ()
    """Events at random times."""


def _check_fields_of_kind(event: ScheduledEvent | SampledEvent) -> None:
    required, optional = _REQUIRED[event.kind], _OPTIONAL.get(event.kind, ())
    for name in ("unit", "rack", "share", "offset_k"):
        if name not in type(event).model_fields:
            continue
        has_value = getattr(event, name) is not None
        if has_value and name not in required and name not in optional:
            raise ValueError(f"{name} has no meaning for {event.kind}")
        if not has_value and name in required:
            raise ValueError(f"{event.kind} needs {name}")
    if event.kind == "rack_fan_failure" and (event.share or 0.0) < LEAST_DRAUGHT_SHARE:
        raise ValueError(
            f"share {event.share:g} leaves a rack without air; valid is at least "
            f"{LEAST_DRAUGHT_SHARE:g}"
        )
