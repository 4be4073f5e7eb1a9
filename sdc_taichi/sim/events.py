"""Events of a run: failures, outages and heat waves of each config, as arrays per step.

An event covers every step that it overlaps, from the step in which it starts to the step in which
it ends. An event whose limits are not step boundaries is thereby extended to whole steps, by one
step on average.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import get_args

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig, EventKind, SampledEvent, ScheduledEvent
from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F64, I64

HOURS_PER_BLOCK = 8760
"""Length of the blocks of sampled events, in h (365 days); each block has its own random stream."""
_HOURS_PER_WINDOW = 120
"""Length of the windows in which events are looked up together, in h; it divides a block."""
_KINDS: tuple[EventKind, ...] = get_args(EventKind)
_PLANT_SHARES: dict[str, tuple[EventKind, ...]] = {
    "chiller_share": ("chiller_derate",),
    "pump_share": ("pump_down",),
    "tank_share": ("tank_down",),
    "outdoor_units": ("tower_cell_down", "dry_cooler_down", "outdoor_air_closed"),
    "facility_pump": ("facility_pump_down",),
    "cooler_share": ("cooler_down",),
}
"""Event kinds that reduce each share of plant devices, by the field of ``Disturbance``."""
_KINDS_WITH_SHARE = {"rack_fan_failure"}.union(*_PLANT_SHARES.values())
_NO_TARGET = -1
"""Target index of events that affect all CRAC units or CDUs, or that have no target."""

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Effects of events on one step, as read-only arrays: U CRAC units, R racks, B data centers."""

    active: bool
    """True if any event covers the step; otherwise all other fields have their normal values."""
    active_events: F64
    """Number of events that cover the step, (B,)."""
    unit_up: Mask
    """True for each CRAC unit that has not failed, (U,)."""
    chiller_share: F64
    """Chiller capacity that is available, as a share of its full capacity, 0..1, (B,)."""
    rack_airflow: F64
    """Remaining airflow of each rack's fans as a share of their full airflow, 0..1, (R,)."""
    outdoor_offset_k: F64
    """Offset that heat waves add to both dry bulb and wet bulb, in K, (B,)."""
    grid_up: Mask
    """True for each data center that the grid supplies, (B,)."""
    pump_share: F64
    """Share of the chilled-water pumps that work, 0..1, (B,)."""
    tank_share: F64
    """Share of the buffer tank that is in use, 0..1, (B,)."""
    outdoor_units: F64
    """Share of the tower cells, dry coolers or outdoor air openings that work, 0..1, (B,)."""
    link_up: Mask
    """True for each data center whose links to the sites of its fleet work, (B,)."""
    facility_pump: F64
    """Share of the pumps of the facility water that work, 0..1, (B,)."""
    cooler_share: F64
    """Share of the fans that cool the facility water that work, 0..1, (B,)."""
    cdu_up: Mask
    """True for each CDU that has not failed, (C,)."""
    cdu_pump_up: Mask
    """True for each CDU of which no pump has failed, (C,)."""
    rack_leaks: Mask
    """True for each liquid-cooled rack that leaks, (L,)."""
    leaked_l: F64
    """Coolant lost by leaks in the step, in l, (B,)."""


@dataclass(frozen=True, slots=True)
class Places:
    """Places of a fleet that events affect, as first indices of each data center and totals."""

    rack_offsets: npt.NDArray[np.integer]
    """First rack of each data center, and the number of racks, (B + 1,)."""
    unit_offsets: npt.NDArray[np.integer]
    """First CRAC unit of each data center, and the number of units, (B + 1,)."""
    cdu_offsets: npt.NDArray[np.integer]
    """First CDU of each data center, and the number of CDUs, (B + 1,)."""
    liquid_racks: npt.NDArray[np.integer]
    """Index of each liquid-cooled rack among all racks, (L,)."""

    def targets(self, kind: EventKind, dc: int) -> I64:
        """Return the indices within a data center among which a sampled event draws its target.

        The result is empty for kinds without a target.
        """
        if kind in ("crac_down", "cdu_down", "cdu_pump_down"):
            offsets = self.unit_offsets if kind == "crac_down" else self.cdu_offsets
            return np.arange(int(offsets[dc + 1] - offsets[dc]))
        first, end = int(self.rack_offsets[dc]), int(self.rack_offsets[dc + 1])
        if kind == "rack_fan_failure":
            return np.arange(end - first)
        racks = np.asarray(self.liquid_racks, dtype=np.int64)
        inside = (racks >= first) & (racks < end) & (kind == "leak")
        return np.asarray(racks[inside] - first)


@dataclass(frozen=True, slots=True)
class ActiveEvent:
    """One event that covers a step."""

    kind: EventKind
    """Kind of event, as in section ``events`` of the config."""
    dc: int
    """Index of the affected data center, counted from 0."""
    target: int | None
    """Index of the affected CRAC unit, CDU or rack within its data center; None if the event
    affects all units or has no target."""
    share: float | None
    """Remaining share of capacity or airflow, 0..1; None for kinds without a share."""
    offset_k: float | None
    """Addition to the outdoor temperatures, in K; None for kinds without an offset."""
    start_step: int
    """First step since reset that the event covers."""
    end_step: int
    """First step since reset after the event."""


@dataclass(frozen=True, slots=True)
class _Events:
    """Arrays of E events.

    The events of a data center have the same order in every fleet.
    """

    kind: I64
    """Index of the event kind in ``_KINDS``, (E,)."""
    dc: I64
    """Index of the data center, counted from 0, (E,)."""
    target: I64
    """Index of the CRAC unit, CDU or rack within the data center, (E,); -1 for all units or no
    target."""
    value: F64
    """Remaining share, 0..1, temperature offset, in K, or loss by a leak, in l, (E,); nan for kinds
    without any."""
    first_step: I64
    """First step since reset that the event covers, (E,)."""
    end_step: I64
    """First step since reset after the event, (E,)."""

    def where(self, mask: Mask) -> _Events:
        """Return the events for which ``mask``, (E,), is True, in their order."""
        return _Events(*(getattr(self, f.name)[mask] for f in fields(self)))


@dataclass(frozen=True, slots=True)
class _Rule:
    """Rule that samples random events of one data center from one distribution."""

    dc: int
    """Index of the data center, counted from 0."""
    key: tuple[int, int]
    """Key of the random stream: CRC-32 of the data center's name, and the index of the rule."""
    targets: I64
    """Indices of CRAC units, CDUs or racks to draw a target from; empty for kinds without one."""
    event: SampledEvent
    """Rate, duration and effect, as in the config."""


class Timeline:
    """Events of a fleet by step, created by ``schedule``.

    The events of a step depend only on configs, seed and step, not on earlier calls. A snapshot of
    the simulator therefore stores only the seed.
    """

    def __init__(
        self,
        scheduled: _Events,
        rules: tuple[_Rule, ...],
        *,
        places: Places,
        steps_per_hour: int,
        seed: I64 | int,
    ) -> None:
        self._scheduled, self._rules = scheduled, rules
        size = len(places.rack_offsets) - 1
        self._seed = np.broadcast_to(np.asarray(seed, dtype=np.int64), (size,))
        self._places = places
        self._steps_per_hour = steps_per_hour
        longest_h = max((rule.event.duration_h[1] for rule in rules), default=0.0)
        self._blocks_back = int(np.ceil(longest_h / HOURS_PER_BLOCK))
        self._blocks: dict[int, _Events] = {}
        self._window = -1
        self._in_window = scheduled
        self._normal = _read_only(
            Disturbance(
                active=False,
                active_events=np.zeros(size),
                unit_up=np.ones(places.unit_offsets[-1], dtype=np.bool_),
                chiller_share=np.ones(size),
                pump_share=np.ones(size),
                tank_share=np.ones(size),
                outdoor_units=np.ones(size),
                rack_airflow=np.ones(places.rack_offsets[-1]),
                outdoor_offset_k=np.zeros(size),
                grid_up=np.ones(size, dtype=np.bool_),
                link_up=np.ones(size, dtype=np.bool_),
                facility_pump=np.ones(size),
                cooler_share=np.ones(size),
                cdu_up=np.ones(places.cdu_offsets[-1], dtype=np.bool_),
                cdu_pump_up=np.ones(places.cdu_offsets[-1], dtype=np.bool_),
                rack_leaks=np.zeros(len(places.liquid_racks), dtype=np.bool_),
                leaked_l=np.zeros(size),
            )
        )

    @property
    def event_free(self) -> bool:
        """True if no event can ever occur."""
        return not self._rules and not len(self._scheduled.kind)

    def reseeded(self, seed: I64 | int) -> Timeline:
        """Return a timeline whose sampled events use other seeds, (B,) or one for all."""
        if not self._rules:
            return self
        return Timeline(
            self._scheduled,
            self._rules,
            places=self._places,
            steps_per_hour=self._steps_per_hour,
            seed=seed,
        )

    def at(self, step: int) -> Disturbance:
        """Return the effects of events on step ``step``, counted from 0 at reset.

        Steps without events share one object.
        """
        events = self._covering(step)
        if not len(events.kind):
            return self._normal
        normal = self._normal
        grid_up, places = normal.grid_up.copy(), self._places
        link_up = normal.link_up.copy()
        airflow = normal.rack_airflow.copy()
        offset_k = normal.outdoor_offset_k.copy()
        is_kind = {kind: events.kind == code for code, kind in enumerate(_KINDS)}
        leaks = events.where(is_kind["leak"])
        leaking = places.rack_offsets[leaks.dc] + leaks.target
        begin = leaks.where(leaks.first_step == step)
        shares = {}
        for name, kinds in _PLANT_SHARES.items():
            shares[name] = getattr(normal, name).copy()
            left = events.where(np.logical_or.reduce([is_kind[kind] for kind in kinds]))
            np.multiply.at(shares[name], left.dc, left.value)
        failed = events.where(is_kind["rack_fan_failure"])
        np.multiply.at(airflow, places.rack_offsets[failed.dc] + failed.target, failed.value)
        wave = events.where(is_kind["heat_wave"])
        np.add.at(offset_k, wave.dc, wave.value)
        grid_up[events.dc[is_kind["grid_outage"]]] = False
        link_up[events.dc[is_kind["link_down"]]] = False
        return _read_only(
            Disturbance(
                active=True,
                active_events=np.bincount(events.dc, minlength=len(grid_up)).astype(np.float64),
                unit_up=_still_up(places.unit_offsets, events.where(is_kind["crac_down"])),
                cdu_up=_still_up(places.cdu_offsets, events.where(is_kind["cdu_down"])),
                cdu_pump_up=_still_up(places.cdu_offsets, events.where(is_kind["cdu_pump_down"])),
                rack_leaks=np.isin(places.liquid_racks, leaking),
                leaked_l=np.bincount(begin.dc, begin.value, len(grid_up)).astype(np.float64),
                **shares,
                rack_airflow=airflow,
                outdoor_offset_k=offset_k,
                grid_up=grid_up,
                link_up=link_up,
            )
        )

    def active(self, step: int) -> list[ActiveEvent]:
        """Return the events that cover step ``step``, sorted by data center, then by start."""
        events = self._covering(step)
        out = []
        for i in np.lexsort((events.first_step, events.dc)):
            kind, value = _KINDS[events.kind[i]], float(events.value[i])
            target = int(events.target[i])
            out.append(
                ActiveEvent(
                    kind=kind,
                    dc=int(events.dc[i]),
                    target=None if target == _NO_TARGET else target,
                    share=value if kind in _KINDS_WITH_SHARE else None,
                    offset_k=value if kind == "heat_wave" else None,
                    start_step=int(events.first_step[i]),
                    end_step=int(events.end_step[i]),
                )
            )
        return out

    def _covering(self, step: int) -> _Events:
        if self.event_free:
            return self._scheduled
        steps = _HOURS_PER_WINDOW * self._steps_per_hour
        window = step // steps
        if window != self._window:
            self._in_window = self._overlapping(window * steps, (window + 1) * steps)
            self._window = window
        events = self._in_window
        return events.where((events.first_step <= step) & (step < events.end_step))

    def _overlapping(self, low: int, high: int) -> _Events:
        """Return events that cover any of the steps low..high-1, all of which are in one block."""
        listed = [self._scheduled]
        if self._rules:
            last = low // (HOURS_PER_BLOCK * self._steps_per_hour)
            wanted = range(max(0, last - self._blocks_back), last + 1)
            self._blocks = {
                block: self._blocks[block] if block in self._blocks else self._sampled(block)
                for block in wanted
            }
            listed += self._blocks.values()
        together = _concatenated(listed)
        return together.where((together.first_step < high) & (low < together.end_step))

    def _sampled(self, block: int) -> _Events:
        return _concatenated([self._sampled_by_rule(rule, block) for rule in self._rules])

    def _sampled_by_rule(self, rule: _Rule, block: int) -> _Events:
        """Sample the events of one rule that start in one block of 365 days."""
        sequence = np.random.SeedSequence([int(self._seed[rule.dc]), *rule.key, block])
        rng = np.random.Generator(np.random.PCG64(sequence))
        event = rule.event
        n = int(rng.poisson(event.per_year))
        start_h = HOURS_PER_BLOCK * (block + rng.random(n))
        duration_h = rng.uniform(*event.duration_h, n)
        target = np.full(n, _NO_TARGET)
        if len(rule.targets):
            target = rule.targets[rng.integers(len(rule.targets), size=n)]
        return _events(
            event, rule.dc, target, start_h, duration_h, steps_per_hour=self._steps_per_hour
        )


def schedule(
    configs: Sequence[DataCenterConfig], places: Places, *, steps_per_hour: int, seed: I64 | int
) -> Timeline:
    """Create the timeline of scheduled and sampled events of a fleet.

    Each sampling rule is a Poisson process with uniformly distributed durations, units and racks.
    Its random stream depends only on the seed, the data center's name and the rule, so a data
    center has the same events alone and in a fleet. No event starts before step 0. If events
    overlap, shares multiply, offsets add, and a unit is down while any event has it down.

    Args:
        configs: Configs of B data centers.
        places: CRAC units, CDUs and racks of these data centers.
        steps_per_hour: Number of steps in an hour.
        seed: Seed of the sampled events, at least 0, (B,) or one for all.
    """
    listed, rules = [_EMPTY], []
    for dc, config in enumerate(configs):
        for event in config.events.scheduled:
            # All sites of a fleet have the events of its configuration.
            if event.site is not None and event.site.upper() != config.site.location.upper():
                continue
            target = event.unit if event.rack is None else event.rack
            listed.append(
                _events(
                    event,
                    dc,
                    np.array([_NO_TARGET if target is None else target]),
                    np.array([event.start_h]),
                    np.array([event.duration_h]),
                    steps_per_hour=steps_per_hour,
                )
            )
        key = zlib.crc32(config.name.encode())
        for i, rule in enumerate(config.events.sampled):
            rules.append(_Rule(dc, (key, i), places.targets(rule.kind, dc), rule))
    return Timeline(
        _concatenated(listed),
        tuple(rules),
        places=places,
        steps_per_hour=steps_per_hour,
        seed=seed,
    )


def seeds_of_fleet(seed: int, names: Sequence[str]) -> I64:
    """Return an event seed for each data center such that no two have the same events, (B,).

    The first data center of each name gets ``seed`` itself, as in a run alone. Further data centers
    with the same name get successive numbers of NumPy's ``SeedSequence(seed)``, so that their
    seeds do not collide with those of runs with neighbouring seeds.

    Args:
        seed: Seed of the run, 0..2**63 - 1.
        names: Names of the B data centers.
    """
    seen = Counter[str]()
    copies = []
    for name in names:
        copies.append(seen[name])
        seen[name] += 1
    # The k-th number of a seed sequence does not depend on its length. The shift by one bit makes
    # the numbers valid int64 seeds.
    drawn = np.random.SeedSequence(seed).generate_state(max(copies), np.uint64) >> 1
    return np.concatenate([[seed], drawn.astype(np.int64)])[copies]


def require_events_start_before(
    end_h: float, configs: Sequence[DataCenterConfig], what: str = "the run"
) -> None:
    """Check that every scheduled event starts before the end of a run.

    Args:
        end_h: Length of the run, in h.
        configs: Configs of the data centers.
        what: Name of the run, for the error message.

    Raises:
        ConfigError: An event starts at or after the end; the message names the event.
    """
    for config in configs:
        for index, event in enumerate(config.events.scheduled):
            if event.start_h >= end_h:
                raise ConfigError(
                    f"{config.name}: events.scheduled.{index}.start_h {event.start_h:g}: {what} "
                    f"ends after {end_h:g} h; valid is an earlier start or a later end"
                )


def _events(
    event: ScheduledEvent | SampledEvent,
    dc: int,
    target: I64,
    start_h: F64,
    duration_h: F64,
    *,
    steps_per_hour: int,
) -> _Events:
    # The tolerance absorbs round-off in times that are meant to be step boundaries.
    start = np.floor(start_h * steps_per_hour + 1e-9)
    end = np.ceil((start_h + duration_h) * steps_per_hour - 1e-9)
    value = next((x for x in (event.share, event.offset_k, event.litres) if x is not None), None)
    n = len(start)
    return _Events(
        kind=np.full(n, _KINDS.index(event.kind)),
        dc=np.full(n, dc),
        target=target,
        value=np.full(n, np.nan if value is None else value),
        first_step=start.astype(np.int64),
        end_step=np.maximum(end, start + 1.0).astype(np.int64),
    )


def _still_up(offsets: npt.NDArray[np.integer], down: _Events) -> Mask:
    """Return True for each unit that none of the events has down.

    Args:
        offsets: First unit of each data center, and the number of units, (B + 1,).
        down: Events that have one unit, or all units of a data center, down.
    """
    up = np.ones(offsets[-1], dtype=np.bool_)
    one = down.target != _NO_TARGET
    up[offsets[down.dc[one]] + down.target[one]] = False
    without = np.zeros(len(offsets) - 1, dtype=np.bool_)
    without[down.dc[~one]] = True
    return np.asarray(up & ~np.repeat(without, np.diff(offsets)))


def _concatenated(listed: Sequence[_Events]) -> _Events:
    return _Events(*(np.concatenate([getattr(e, f.name) for e in listed]) for f in fields(_Events)))


def _read_only(disturbance: Disturbance) -> Disturbance:
    for field in fields(disturbance):
        if isinstance(values := getattr(disturbance, field.name), np.ndarray):
            values.flags.writeable = False
    return disturbance


_EMPTY = _Events(*(np.empty(0, np.int64),) * 3, np.empty(0), *(np.empty(0, np.int64),) * 2)
