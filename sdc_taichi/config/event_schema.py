"""Sections ``events`` and ``protection``: failures in a run, and protection of hot servers."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from sdc_taichi.config.fields import AirC, Name, Plant, RiseK, Section, Share

EventKind = Literal[
    "crac_down",
    "chiller_derate",
    "pump_down",
    "tank_down",
    "tower_cell_down",
    "dry_cooler_down",
    "outdoor_air_closed",
    "rack_fan_failure",
    "heat_wave",
    "grid_outage",
    "link_down",
    "cdu_down",
    "cdu_pump_down",
    "facility_pump_down",
    "cooler_down",
    "leak",
]

WaveK = Annotated[float, Field(ge=-40, le=40)]
"""Addition to outdoor temperatures, -40..40 K: the largest recorded deviation from the climate is
39 K (Dome C, Antarctica, March 2022)."""

DurationH = Annotated[float, Field(ge=0.001, le=876_000)]
"""Duration of an event, 0.001..876,000 h: from a few seconds to a century."""

OutletC = Annotated[float, Field(ge=20, le=120)]
"""Outlet air temperature of servers, 20..120 C: from usual inlets to temperatures that damage any
circuit board."""

Litres = Annotated[float, Field(ge=0, le=1e6)]
"""Coolant lost by a leak, 0..1e6 l: from a drop to a large storage tank."""

LEAST_DRAUGHT_SHARE = 0.01
"""Smallest airflow of a rack with failed fans, as a share of its normal airflow. It is not 0,
because warm air rises through the rack."""

_REQUIRED: dict[EventKind, tuple[str, ...]] = {
    "crac_down": (),
    "chiller_derate": ("share",),
    "pump_down": ("share",),
    "tank_down": ("share",),
    "tower_cell_down": ("share",),
    "dry_cooler_down": ("share",),
    "outdoor_air_closed": ("share",),
    "rack_fan_failure": ("rack", "share"),
    "heat_wave": ("offset_k",),
    "grid_outage": (),
    "link_down": (),
    "cdu_down": (),
    "cdu_pump_down": (),
    "facility_pump_down": ("share",),
    "cooler_down": ("share",),
    "leak": ("rack", "litres"),
}
_OPTIONAL: dict[EventKind, tuple[str, ...]] = {
    **dict.fromkeys(("crac_down", "cdu_down", "cdu_pump_down"), ("unit",)),
    "link_down": ("site",),
}
LIQUID_EVENTS: tuple[EventKind, ...] = (
    "cdu_down",
    "cdu_pump_down",
    "facility_pump_down",
    "cooler_down",
    "leak",
)
"""Kinds of events that need liquid-cooled racks."""
PLANT_OF_EVENT: dict[EventKind, Plant] = {
    "tower_cell_down": "water_cooled",
    "dry_cooler_down": "air_cooled",
    "outdoor_air_closed": "air_side",
}
"""Plant that an event requires, by kind of event; kinds that are not listed fit every plant."""


class ProtectionConfig(Section):
    """Response of servers to inlets above the allowable range of their class, and to hot outlets.

    Above a limit a rack throttles. Above a trip temperature it switches off and loses the work of
    the step. It may restart after its cooling has worked, with an inlet of at most ``restart_c``,
    for ``restart_hold_min``. The racks of a data center then restart in stages.
    """

    ashrae_class: Literal["A1", "A2", "A3", "A4"] | None = None
    """ASHRAE TC 9.9 (2021) class of the servers. The upper end of its allowable range is the limit
    of inlet temperatures. None means no protection."""
    throttle_share: Share = 0.5
    """Highest utilisation of a throttled rack, 0..1."""
    trip_margin_k: RiseK = 5.0
    """Inlet temperature at which a rack switches off minus the inlet limit, in K."""
    restart_c: AirC | None = None
    """Highest inlet temperature at which a rack that has switched off restarts, in C; None means
    the mean of the recommended 27 C and the limit of the class."""
    outlet_limit_c: OutletC | None = 70.0
    """Outlet temperature above which a rack throttles, in C; None ignores outlets. 70 C is the
    default exhaust limit of Dell PowerEdge servers (``ThermalSettings.AirExhaustTemp`` of
    iDRAC)."""
    outlet_trip_c: OutletC = 80.0
    """Outlet temperature above which a throttled rack switches off, in C. 80 C is the critical
    threshold of the exhaust sensor of Dell PowerEdge R750 servers."""
    restart_hold_min: Annotated[float, Field(ge=0, le=1440)] = 5.0
    """Time for which cooling must work and the inlet must be cool enough before a rack restarts, in
    min, 0..1,440: from no wait to a day."""
    restart_share: Annotated[float, Field(ge=0.001, le=1)] = 0.1
    """Share of the racks of a data center that restart per minute, 0.001..1: from a thousand
    minutes for all racks to all at once. At least one rack restarts per step."""

    @model_validator(mode="after")
    def _throttles_before_it_trips(self) -> Self:
        limit_c = self.outlet_limit_c
        if limit_c is not None and limit_c > self.outlet_trip_c:
            raise ValueError(
                f"outlet_limit_c {limit_c:g} must not exceed outlet_trip_c {self.outlet_trip_c:g}"
            )
        return self


class ScheduledEvent(Section):
    """Failure or weather event at a fixed time."""

    kind: EventKind
    """Kind of event."""
    start_h: Annotated[float, Field(ge=0, le=876_000)]
    """Start of the event, in h after reset, 0..876,000 (a century); it must be before the end of
    the run."""
    duration_h: DurationH
    """Duration of the event, in h."""
    unit: Annotated[int, Field(ge=0, le=9_999)] | None = None
    """Number of the CRAC unit or CDU that fails, counted from 0; None means all of them."""
    rack: Annotated[int, Field(ge=0, le=9_999_999)] | None = None
    """Number of the rack whose fans fail or that leaks, counted from 0, row by row."""
    site: Name | None = None
    """Site of the fleet whose links fail; None means all sites."""
    share: Share | None = None
    """Chiller capacity, pumps, buffer tanks, tower cells, dry coolers, openings for outdoor air,
    rack airflow, pumps of facility water or fans of its cooler that remain, as a share of all,
    0..1."""
    offset_k: WaveK | None = None
    """Addition of a heat wave to the dry bulb and the wet bulb alike, in K."""
    litres: Litres | None = None
    """Coolant that a leak loses in its first step, in l. Until it ends, a rack with cold plates is
    off, and a rear door takes no heat."""

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> Self:
        _check_fields_of_kind(self)
        return self


class SampledEvent(Section):
    """Failures or weather events at random times: a Poisson process with uniform durations.

    All CRAC units, CDUs or racks are equally likely to fail. Each site of a fleet has events of its
    own.
    """

    kind: EventKind
    """Kind of event."""
    per_year: Annotated[float, Field(ge=1e-6, le=8760)]
    """Mean number of events per year, from one in a million years to one per hour."""
    duration_h: tuple[DurationH, DurationH]
    """Shortest and longest duration of an event, in h."""
    share: Share | None = None
    """Chiller capacity, pumps, buffer tanks, tower cells, dry coolers, openings for outdoor air,
    rack airflow, pumps of facility water or fans of its cooler that remain, as a share of all,
    0..1."""
    offset_k: WaveK | None = None
    """Addition of a heat wave to the dry bulb and the wet bulb alike, in K."""
    litres: Litres | None = None
    """Coolant that a leak loses in its first step, in l. Until it ends, a rack with cold plates is
    off, and a rear door takes no heat."""

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
    """Events at fixed times."""
    sampled: tuple[SampledEvent, ...] = ()
    """Events at random times."""


def _check_fields_of_kind(event: ScheduledEvent | SampledEvent) -> None:
    required, optional = _REQUIRED[event.kind], _OPTIONAL.get(event.kind, ())
    for name in ("unit", "rack", "site", "share", "offset_k", "litres"):
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
