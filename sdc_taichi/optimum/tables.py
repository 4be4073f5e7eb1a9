"""Tables of energy, water and inlets by utilisation and setpoint, made by the simulator itself."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, allowable_c
from sdc_taichi.hall.protection import Mask
from sdc_taichi.plant.plants import PLANTS
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.stages import SteadyFacility
from sdc_taichi.types import F64, I64


@dataclass(frozen=True, slots=True)
class FacilityTable:
    """Results of a step by utilisation and setpoint: T steps, I utilisations, J setpoints.

    Values are those of the simulator at constant utilisation and setpoint in the weather of each
    step. Between utilisations they are read linearly.
    """

    utilisation: F64
    """Utilisations, rising from 0 to 1, (I,)."""
    setpoint_c: F64
    """Setpoints, rising in equal steps, in C, (J,)."""
    facility_kwh: F64
    """Energy of the facility without its battery, in kWh, (T, I, J)."""
    water_l: F64
    """Make-up water, in l, (T, I, J)."""
    inlet_max_c: F64
    """Hottest inlet of a server, in C, (T, I, J)."""
    unmet_w: F64
    """Cooling load that stays in the room, in W, (T, I, J); inf where racks would throttle or
    results are beyond what is physical."""


MOST_COPIES = 4096
"""Copies of data centers in a batch, beyond which its arrays leave the caches."""
MOST_RACKS = 2**18
"""Racks of the copies in a batch, which take some 1 kB each."""
UTILISATIONS = (41, 81, 161)
"""Numbers of utilisations that a table may have where none is given; each halves the spacing."""
MOST_ERROR = 1e-4
"""Mean relative error of the energy midway between utilisations up to which a table counts as fine
enough."""
_LEAST_USUAL = 0.15
"""Utilisation below which errors are not counted: work rarely falls so low, and power bends most
where fans leave their lowest speed."""
_SAMPLES = 6
"""Steps of a run whose weather is tried."""


@dataclass(frozen=True, slots=True)
class Nodes:
    """Where the table of one data center has its nodes."""

    dc: int
    """Number of the data center in its fleet."""
    utilisation: F64
    """Utilisations, rising, 0..1, (I,)."""
    setpoint_c: F64
    """Setpoints, rising, in C, (J,)."""

    @property
    def copies(self) -> int:
        """Number of copies of the data center, one for each node."""
        return len(self.utilisation) * len(self.setpoint_c)


OnStep = Callable[[int, int], None]
"""Progress callback ``(done, total)`` in steps of data centers; an error that it raises ends the
work."""


def setpoints_c(config: DataCenterConfig, step_k: float | None = None) -> F64:
    """Setpoints of tables from the lowest to the highest of a data center, in C, (J,).

    Args:
        config: The data center.
        step_k: Largest distance of setpoints, in K; None is 0.5 K with a tower, and half of that
            for plants without, whose energy bends more along the setpoint.
    """
    setpoint = config.hvac.setpoint
    if step_k is None:
        step_k = 0.25 if PLANTS[config.hvac.plant_in_use].dry else 0.5
    intervals = int(np.ceil((setpoint.max_c - setpoint.min_c) / step_k - 1e-9))
    return np.linspace(setpoint.min_c, setpoint.max_c, intervals + 1)


def facility_tables(
    fleet: Fleet,
    drivers: Drivers,
    *,
    start: I64,
    steps: int,
    utilisations: int | None = None,
    setpoint_step_k: float | None = None,
    precision: Precision = "f32",
    on_step: OnStep | None = None,
) -> list[FacilityTable]:
    """Tables of data centers over the steps of a run.

    Utilisation and setpoint are constant in each entry, and the room holds no heat from earlier
    steps. Entries in which racks would throttle, or results are not physical, have an unmet load of
    inf. Data centers that are alike share one table.

    Args:
        fleet: B data centers. Events, thermal mass and protection are left out.
        drivers: Their inputs, whose design temperatures size the devices.
        start: First step of each data center, counted from the beginning of the year, (B,).
        steps: Number of steps, T.
        utilisations: Number of utilisations, evenly from 0 to 1; None is the least of
            ``UTILISATIONS`` that is fine enough for the hall, see ``MOST_ERROR``.
        setpoint_step_k: Largest distance of setpoints, as of ``setpoints_c``.
        precision: Of the server kernels.
        on_step: Called after every step of a batch of data centers.

    Returns:
        A table for each data center, B.

    Raises:
        PhysicalLimitError: A hall that finds no steady air at some utilisation and setpoint.
    """
    known: dict[Hashable, int] = {}
    table_of = [
        known.setdefault(_what_decides(fleet, drivers, start, dc), dc) for dc in range(fleet.size)
    ]
    distinct = list(known.values())
    tables: dict[int, FacilityTable] = {}
    counts = [utilisations or 0] * len(distinct)
    if utilisations is None:
        counts = _fine_enough(fleet, drivers, distinct, start, steps, precision)
    nodes = [
        Nodes(dc, np.linspace(0.0, 1.0, count), setpoints_c(fleet.configs[dc], setpoint_step_k))
        for dc, count in zip(distinct, counts, strict=True)
    ]
    for batch in batches(fleet, nodes):
        outdoor_c, wet_bulb_c = (
            _series_of(series, batch, start, steps)
            for series in (drivers.outdoor_c, drivers.wet_bulb_c)
        )
        done = len(tables) * steps

        def tell(step: int, before: int = done, size: int = len(batch)) -> None:
            if on_step is not None:
                on_step(before + size * step, len(distinct) * steps)

        of_batch = tabulate(fleet, drivers, batch, outdoor_c, wet_bulb_c, precision, tell)
        tables |= {own.dc: table for own, table in zip(batch, of_batch, strict=True)}
    return [tables[dc] for dc in table_of]


def tabulate(
    fleet: Fleet,
    drivers: Drivers,
    nodes: Sequence[Nodes],
    outdoor_c: F64,
    wet_bulb_c: F64,
    precision: Precision,
    on_step: Callable[[int], None] | None = None,
) -> list[FacilityTable]:
    """Tables of some data centers over given weather, in one batch.

    Args:
        fleet: B data centers.
        drivers: Their inputs, of which the design temperatures are read.
        nodes: Nodes of n of them.
        outdoor_c: Dry bulb of each step, in C, (n, T).
        wet_bulb_c: Wet bulb of each step, in C, (n, T).
        precision: Of the server kernels.
        on_step: Called after every step with the number of those done.

    Returns:
        A table for each, n.
    """
    place = np.repeat(np.arange(len(nodes)), [each.copies for each in nodes])
    of = np.array([each.dc for each in nodes])[place]
    facility = SteadyFacility(
        fleet.configs,
        drivers,
        of=of,
        utilisation=np.concatenate([np.repeat(x.utilisation, len(x.setpoint_c)) for x in nodes]),
        setpoint_c=np.concatenate([np.tile(x.setpoint_c, len(x.utilisation)) for x in nodes]),
        precision=precision,
    )
    with closing(facility):
        throttles = _throttles(fleet, facility, of)
        values = _through_weather(facility, place, outdoor_c, wet_bulb_c, throttles, on_step)
    values["inlet_max_c"] = facility.inlet_max_c[None]
    firsts = np.cumsum([0, *(each.copies for each in nodes)])
    steps = outdoor_c.shape[1]
    return [
        FacilityTable(
            utilisation=each.utilisation,
            setpoint_c=each.setpoint_c,
            **{name: _of_one(x, int(first), steps, each) for name, x in values.items()},
        )
        for first, each in zip(firsts, nodes, strict=False)
    ]


def batches(fleet: Fleet, nodes: Sequence[Nodes]) -> Iterator[list[Nodes]]:
    """Parts of a list of nodes whose copies make one batch.

    Args:
        fleet: B data centers.
        nodes: Nodes of some of them.
    """
    racks = np.diff(fleet.rack_offsets)
    part: list[Nodes] = []
    part_copies = part_racks = 0
    for each in nodes:
        its_racks = each.copies * int(racks[each.dc])
        full = part_copies + each.copies > MOST_COPIES or part_racks + its_racks > MOST_RACKS
        if part and full:
            yield part
            part, part_copies, part_racks = [], 0, 0
        part.append(each)
        part_copies, part_racks = part_copies + each.copies, part_racks + its_racks
    if part:
        yield part


def what_decides_facility(fleet: Fleet, drivers: Drivers, dc: int) -> Hashable:
    """Values that decide the energy of a facility, besides weather, load and setpoint.

    Args:
        fleet: B data centers.
        drivers: Their inputs.
        dc: One of them.
    """
    config = fleet.configs[dc]
    setpoint = config.hvac.setpoint
    first_c = setpoint.model_copy(update={"initial_c": setpoint.min_c, "schedule_c": None})
    return (
        config.hall,
        config.servers,
        config.hvac.model_copy(update={"setpoint": first_c}),
        config.electrical,
        config.protection,
        config.site.location,
        config.site.weather_file,
        float(drivers.design_outdoor_c[dc]),
        float(drivers.design_wet_bulb_c[dc]),
    )


def _what_decides(fleet: Fleet, drivers: Drivers, start: I64, dc: int) -> Hashable:
    """Values that decide a table besides its number of steps: facility, weather, first step."""
    series = drivers.outdoor_c, drivers.wet_bulb_c
    weather = tuple((int(each.offsets[dc]), int(each.lengths[dc])) for each in series)
    return what_decides_facility(fleet, drivers, dc), weather, int(start[dc])


def _fine_enough(
    fleet: Fleet,
    drivers: Drivers,
    which: Sequence[int],
    start: I64,
    steps: int,
    precision: Precision,
) -> list[int]:
    """Numbers of utilisations at which the tables of some data centers are fine enough.

    What lies midway between nodes is read by the cubic through four of them, and held against the
    simulator at the lowest and the highest setpoint, in a few steps of the run.
    """
    finest = np.linspace(0.0, 1.0, UTILISATIONS[-1])
    nodes = [
        Nodes(dc, finest, np.unique([setpoint.min_c, setpoint.max_c]))
        for dc, setpoint in ((dc, fleet.configs[dc].hvac.setpoint) for dc in which)
    ]
    sampled = np.linspace(0, steps - 1, min(_SAMPLES, steps)).astype(np.int64)
    counts = []
    for batch in batches(fleet, nodes):
        outdoor_c, wet_bulb_c = (
            _series_of(series, batch, start, steps)[:, sampled]
            for series in (drivers.outdoor_c, drivers.wet_bulb_c)
        )
        for table in tabulate(fleet, drivers, batch, outdoor_c, wet_bulb_c, precision):
            errors = (
                _error_midway(finest, table.facility_kwh, (len(finest) - 1) // (count - 1))
                for count in UTILISATIONS[:-1]
            )
            fine = (
                n for n, error in zip(UTILISATIONS, errors, strict=False) if error <= MOST_ERROR
            )
            counts.append(next(fine, UTILISATIONS[-1]))
    return counts


def _error_midway(utilisation: F64, kwh: F64, spacing: int) -> float:
    """Mean relative error of the energy midway between nodes.

    Args:
        utilisation: Utilisations, (I,).
        kwh: Energy, (T, I, J).
        spacing: Number of utilisations from one node to the next, even.
    """
    node = kwh[:, ::spacing]
    midway = (9.0 * (node[:, 1:-2] + node[:, 2:-1]) - node[:, :-3] - node[:, 3:]) / 16.0
    middle = slice(3 * spacing // 2, len(utilisation) - spacing, spacing)
    error = np.abs(midway / kwh[:, middle] - 1.0)
    return float(error[:, utilisation[middle] >= _LEAST_USUAL].mean())


def _series_of(series: FleetSeries, nodes: Sequence[Nodes], start: I64, steps: int) -> F64:
    """Values of some data centers over the steps of a run, (n, T)."""
    which = np.array([each.dc for each in nodes])
    index = np.asarray(start)[which, None] + np.arange(steps)
    return series.values.take(series.offsets[which, None] + index % series.lengths[which, None])


def _through_weather(
    facility: SteadyFacility,
    place: I64,
    outdoor_c: F64,
    wet_bulb_c: F64,
    throttles: Mask,
    on_step: Callable[[int], None] | None,
) -> dict[str, F64]:
    """Energy, water and unmet load of copies, (T, B) each or (1, B), by their names in a table.

    Args:
        facility: B copies of data centers.
        place: Row of the weather that each copy has, (B,).
        outdoor_c: Dry bulb of each step, in C, (n, T).
        wet_bulb_c: Wet bulb of each step, in C, (n, T).
        throttles: Whether racks of each copy would throttle, (B,).
        on_step: Called after every step with the number of those done.
    """
    copies, steps = len(place), outdoor_c.shape[1]
    facility_kwh, water_l = (np.empty((steps, copies)) for _ in range(2))
    # Mostly all heat is removed, and one row stands for all steps.
    unmet_w = np.zeros((1, copies))
    for step in range(steps):
        result = facility.at(outdoor_c[place, step], wet_bulb_c[place, step])
        facility_kwh[step], water_l[step] = result.facility_kwh, result.water_l
        short_w = np.where(throttles, np.inf, result.unmet_w)
        if len(unmet_w) < steps and short_w.any():
            unmet_w = np.zeros((steps, copies))
        if short_w.any():
            unmet_w[step] = short_w
        if on_step is not None:
            on_step(step + 1)
    return {"facility_kwh": facility_kwh, "water_l": water_l, "unmet_w": unmet_w}


def _throttles(fleet: Fleet, facility: SteadyFacility, of: I64) -> Mask:
    """Whether racks of each copy would throttle by their hottest inlet or outlet, (B,)."""
    limits = [fleet.configs[dc].protection for dc in of]
    inlet_c, outlet_c = (np.full(len(of), np.inf) for _ in range(2))
    for copy, protection in enumerate(limits):
        if protection.ashrae_class is not None:
            inlet_c[copy] = allowable_c(protection.ashrae_class)[1]
            if protection.outlet_limit_c is not None:
                outlet_c[copy] = protection.outlet_limit_c
    return (facility.inlet_max_c > inlet_c + LEAST_EXCESS_K) | (
        facility.outlet_max_c > outlet_c + LEAST_EXCESS_K
    )


def _of_one(values: F64, first: int, steps: int, nodes: Nodes) -> F64:
    """Values of one data center, (T, I, J), from those of all copies, (T, B) or (1, B)."""
    own = np.ascontiguousarray(values[:, first : first + nodes.copies])
    shape = len(nodes.utilisation), len(nodes.setpoint_c)
    return np.broadcast_to(own.reshape(-1, *shape), (steps, *shape))


INLET_MARGIN_K = 0.02
"""Distance by which paths stay below the limit of inlets and bounds go beyond it, in K, since
inlets are not quite linear between the utilisations of a table."""


def at_utilisation(values: F64, nodes: F64, utilisation: F64) -> F64:
    """Values of a table at a utilisation of each step, linear between the nodes, (T, J).

    Args:
        values: Values by step, utilisation and setpoint, (T, I, J).
        nodes: Utilisations of the table, rising, (I,).
        utilisation: Utilisation of each step, (T,); beyond the nodes that of the last node counts.
    """
    low, share = _place(nodes, utilisation)
    step = np.arange(len(utilisation))
    return _between(values[step, low], values[step, low + 1], share[:, None])


def energy_at_utilisation(values: F64, nodes: F64, utilisation: F64) -> F64:
    """Energy of a table at a utilisation of each step, cubic between the nodes, (T, J).

    Args:
        values: Energy by step, utilisation and setpoint, in kWh, (T, I, J).
        nodes: Utilisations of the table, rising, (I,).
        utilisation: Utilisation of each step, (T,); beyond the nodes that of the last node counts.
    """
    columns = [cubic(nodes, values[:, :, j], utilisation) for j in range(values.shape[2])]
    return np.stack(columns, axis=1)


def cubic(nodes: F64, values: F64, at: F64) -> F64:
    """Values of each step from the cubic through four nodes, (T,).

    Args:
        nodes: Places of the nodes, rising, (I,).
        values: Values of each step at them, (T, I).
        at: Place of each step, (T,); beyond the nodes that of the last node counts.
    """
    at = np.clip(at, nodes[0], nodes[-1])
    points = min(4, len(nodes))
    first = np.clip(np.searchsorted(nodes, at) - points // 2, 0, len(nodes) - points)
    x = nodes[first[:, None] + np.arange(points)]
    y = np.take_along_axis(values, first[:, None] + np.arange(points), axis=1)
    total = np.zeros(len(at))
    for k in range(points):
        others = np.delete(x, k, axis=1)
        share = (at[:, None] - others) / (x[:, k : k + 1] - others)
        total += y[:, k] * share.prod(axis=1)
    return total


def at_setpoint(values: F64, nodes: F64, setpoint_c: F64) -> F64:
    """Values at setpoints, linear between the nodes, (...).

    Args:
        values: Values by setpoint, (..., J).
        nodes: Setpoints of the table, rising, in C, (J,).
        setpoint_c: Setpoints, in C, of a shape that broadcasts to (...); beyond the nodes that of
            the last node counts.
    """
    if len(nodes) == 1:
        return values[..., 0].copy()
    low, share = _place(nodes, setpoint_c)
    below, above = (
        np.take_along_axis(values, k[..., None], axis=-1)[..., 0] for k in (low, low + 1)
    )
    return _between(below, above, share)


def facility_kwh(table: FacilityTable, utilisation: F64, setpoint_c: F64) -> F64:
    """Energy of the facility in each step, in kWh, (T,).

    Args:
        table: Table of the steps.
        utilisation: Utilisation of each step, (T,).
        setpoint_c: Setpoint of each step, in C, (T,).
    """
    by_setpoint = energy_at_utilisation(table.facility_kwh, table.utilisation, utilisation)
    return at_setpoint(by_setpoint, table.setpoint_c, setpoint_c)


def barred(inlet_max_c: F64, unmet_w: F64, limit_c: float) -> Mask:
    """Whether a plan may not use a setpoint, (..., J).

    Where no setpoint keeps inlets within the limit, those with the coolest inlets may be used, and
    where none meets the cooling load, those that miss the least of it.

    Args:
        inlet_max_c: Hottest inlet by setpoint, in C, (..., J).
        unmet_w: Cooling load that stays in the room by setpoint, in W, (..., J).
        limit_c: Highest inlet, in C; inf without a limit.
    """
    within = inlet_max_c <= np.maximum(limit_c, coolest_inlet_c(inlet_max_c, unmet_w))
    return np.asarray(~(_meets(unmet_w) & within))


def coolest_inlet_c(inlet_max_c: F64, unmet_w: F64) -> F64:
    """Least of the hottest inlets over setpoints that miss the least of the cooling load, (..., 1).

    Args:
        inlet_max_c: Hottest inlet by setpoint, in C, (..., J).
        unmet_w: Cooling load that stays in the room by setpoint, in W, (..., J).
    """
    return np.asarray(np.where(_meets(unmet_w), inlet_max_c, np.inf).min(axis=-1, keepdims=True))


def _meets(unmet_w: F64) -> Mask:
    """Setpoints that miss the least of the cooling load, (..., J)."""
    return np.asarray(unmet_w <= unmet_w.min(axis=-1, keepdims=True))


def _between(low: F64, high: F64, share: F64) -> F64:
    """Values part of the way from low to high ones, of which one that is not reached may be inf."""
    below, above = np.where(share < 1.0, low, 0.0), np.where(share > 0.0, high, 0.0)
    return np.asarray(below * (1.0 - share) + above * share)


def _place(nodes: F64, at: F64) -> tuple[I64, F64]:
    """Node below each place, and how far it is to the node above, 0..1."""
    low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    share = (at - nodes[low]) / (nodes[low + 1] - nodes[low])
    return low, np.clip(share, 0.0, 1.0)
