"""Tables of energy, water and inlets by utilisation and setpoint, computed by the simulator."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, allowable_c
from sdc_taichi.hall.protection import Mask
from sdc_taichi.optimum.loop_map import LoopCommands
from sdc_taichi.plant.plants import PLANTS
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.stages import SteadyFacility
from sdc_taichi.types import F64, I64


@dataclass(frozen=True, slots=True)
class FacilityTable:
    """Results of each of T steps by I utilisations and J setpoints.

    Values are results of the simulator at constant utilisation and setpoint, in the weather of the
    step.
    """

    utilisation: F64
    """Utilisations, increasing from 0 to 1, (I,)."""
    setpoint_c: F64
    """Setpoints, increasing in equal steps, in C, (J,)."""
    facility_kwh: F64
    """Energy of the facility without its battery, in kWh, (T, I, J)."""
    water_l: F64
    """Make-up water, in l, (T, I, J)."""
    inlet_max_c: F64
    """Highest inlet temperature of all servers, in C, (T, I, J)."""
    unmet_w: F64
    """Heat that the cooling does not remove from the room, in W, (T, I, J); inf if racks would
    throttle or results are not physical."""
    loops: F64 | None = None
    """Commands of the coolant loops at each utilisation, (T, I, 3): supply setpoint in C, flow as a
    share of design, and approach in K. None means that the loops are held, or that there are
    none."""


MOST_COPIES = 4096
"""Maximum number of data-center copies in a batch; larger arrays exceed the processor's caches."""
MOST_RACKS = 2**18
"""Maximum number of racks in a batch; a rack needs about 1 kB of memory."""
UTILISATIONS = (41, 81, 161)
"""Candidate numbers of utilisations of a table; each halves the spacing of the previous one."""
MOST_ERROR = 1e-4
"""Maximum mean relative error of the interpolated energy midway between utilisations. A table with
a larger error receives more utilisations."""
_LEAST_USUAL = 0.15
"""Utilisation below which interpolation errors are ignored. Such low utilisations are rare, and the
energy curve bends sharply where fans leave their minimum speed."""
_SAMPLES = 6
"""Number of steps of a run whose weather serves to choose the number of utilisations."""


@dataclass(frozen=True, slots=True)
class Nodes:
    """Utilisations and setpoints of the table of one data center."""

    dc: int
    """Index of the data center in its fleet."""
    utilisation: F64
    """Utilisations, increasing, 0..1, (I,)."""
    setpoint_c: F64
    """Setpoints, increasing, in C, (J,)."""

    @property
    def copies(self) -> int:
        """Number of simulated copies of the data center, one per pair of node values, I * J."""
        return len(self.utilisation) * len(self.setpoint_c)


OnStep = Callable[[int, int], None]
"""Progress callback ``(done, total)``, counted in steps times data centers. An error that it raises
ends the work."""


def setpoints_c(config: DataCenterConfig, step_k: float | None = None) -> F64:
    """Return the setpoints of a table, from minimum to maximum of the data center, in C, (J,).

    Args:
        config: Config of the data center.
        step_k: Maximum spacing of setpoints, in K. None means 0.5 K for plants with a tower and
            0.25 K for all others, whose energy curve along the setpoint bends more sharply.
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
    loops: LoopCommands | None = None,
    on_step: OnStep | None = None,
) -> list[FacilityTable]:
    """Compute the tables of B data centers for the T steps of a run.

    Each entry is a steady state at constant utilisation and setpoint, so the room contains no heat
    of earlier steps. The unmet load is inf for entries in which racks would throttle or results are
    not physical. Equal data centers share one table.

    Args:
        fleet: B data centers. Events, thermal mass and protection are ignored.
        drivers: Inputs of the data centers. Their design temperatures determine device sizes.
        start: First step of each data center, counted from the beginning of the year, (B,).
        steps: Number of steps, T.
        utilisations: Number of utilisations, equally spaced from 0 to 1. None means the smallest
            entry of ``UTILISATIONS`` with an error of at most ``MOST_ERROR``.
        setpoint_step_k: Maximum spacing of setpoints, in K; see ``setpoints_c``.
        precision: Floating-point precision of the server kernels.
        loops: Best commands of the coolant loops, which the entries have; None holds the loops.
        on_step: Called after every step of a batch of data centers.

    Returns:
        A table for each data center, B.

    Raises:
        PhysicalLimitError: A hall has no steady air state at some utilisation and setpoint.
    """
    known: dict[Hashable, int] = {}
    table_of = [
        known.setdefault(_what_decides(fleet, drivers, start, dc), dc) for dc in range(fleet.size)
    ]
    distinct = list(known.values())
    tables: dict[int, FacilityTable] = {}
    if utilisations is None:
        counts = _fine_enough(fleet, drivers, distinct, start, steps, precision, loops)
    else:
        counts = [utilisations] * len(distinct)
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

        of_batch = tabulate(fleet, drivers, batch, outdoor_c, wet_bulb_c, precision, loops, tell)
        tables |= {node.dc: table for node, table in zip(batch, of_batch, strict=True)}
    return [tables[dc] for dc in table_of]


def tabulate(
    fleet: Fleet,
    drivers: Drivers,
    nodes: Sequence[Nodes],
    outdoor_c: F64,
    wet_bulb_c: F64,
    precision: Precision,
    loops: LoopCommands | None = None,
    on_step: Callable[[int], None] | None = None,
) -> list[FacilityTable]:
    """Compute the tables of n data centers for T steps of given weather, in one batch.

    Args:
        fleet: B data centers.
        drivers: Inputs of the B data centers; only their design temperatures are used.
        nodes: Utilisations and setpoints of n of the B data centers.
        outdoor_c: Dry bulb of each step, in C, (n, T).
        wet_bulb_c: Wet bulb of each step, in C, (n, T).
        precision: Floating-point precision of the server kernels.
        loops: Best commands of the coolant loops of the B data centers; None holds the loops.
        on_step: Called after every step with the number of finished steps.

    Returns:
        A table for each of the n data centers.
    """
    commands = [
        _loop_commands(loops, each, dry, wet)
        for each, dry, wet in zip(nodes, outdoor_c, wet_bulb_c, strict=True)
    ]

    def loops_at(step: int) -> F64 | None:
        of_copies = [
            np.repeat(x[step].T, len(each.setpoint_c), axis=1)
            for x, each in zip(commands, nodes, strict=True)
            if x is not None
        ]
        return np.concatenate(of_copies, axis=1) if of_copies else None

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
        values = _through_weather(
            facility, place, outdoor_c, wet_bulb_c, loops_at, throttles, on_step
        )
    values["inlet_max_c"] = facility.inlet_max_c[None]
    firsts = np.cumsum([0, *(each.copies for each in nodes)])
    steps = outdoor_c.shape[1]
    return [
        FacilityTable(
            utilisation=each.utilisation,
            setpoint_c=each.setpoint_c,
            **{name: _of_one(x, int(first), steps, each) for name, x in values.items()},
            loops=of_loops,
        )
        for first, each, of_loops in zip(firsts, nodes, commands, strict=False)
    ]


def batches(fleet: Fleet, nodes: Sequence[Nodes]) -> Iterator[list[Nodes]]:
    """Divide data centers into batches of at most ``MOST_COPIES`` copies and ``MOST_RACKS`` racks.

    Args:
        fleet: B data centers.
        nodes: Utilisations and setpoints of some of the data centers.
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
    """Return all values but weather, load and setpoint on which a facility's energy depends."""
    config = fleet.configs[dc]
    setpoint = config.hvac.setpoint
    first_c = setpoint.model_copy(update={"initial_c": setpoint.min_c, "schedule_c": None})
    return (
        config.hall,
        config.servers,
        config.hvac.model_copy(update={"setpoint": first_c}),
        config.electrical,
        config.liquid,
        config.protection,
        config.site.location,
        config.site.weather_file,
        float(drivers.design_outdoor_c[dc]),
        float(drivers.design_wet_bulb_c[dc]),
    )


def _what_decides(fleet: Fleet, drivers: Drivers, start: I64, dc: int) -> Hashable:
    """Return all values, except the number of steps, on which a data center's table depends."""
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
    loops: LoopCommands | None,
) -> list[int]:
    """Choose the smallest sufficient number of utilisations for the table of each data center.

    The energy midway between nodes, interpolated by the cubic through four nodes, is compared with
    the simulator. The comparison uses the lowest and the highest setpoint in a few steps.
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
        for table in tabulate(fleet, drivers, batch, outdoor_c, wet_bulb_c, precision, loops):
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
    """Return the mean relative error of the energy interpolated midway between nodes.

    Args:
        utilisation: Finest utilisations, (I,).
        kwh: Simulated energy at the finest utilisations, (T, I, J).
        spacing: Even number of finest utilisations from one node of the table to the next.
    """
    node = kwh[:, ::spacing]
    midway = (9.0 * (node[:, 1:-2] + node[:, 2:-1]) - node[:, :-3] - node[:, 3:]) / 16.0
    middle = slice(3 * spacing // 2, len(utilisation) - spacing, spacing)
    error = np.abs(midway / kwh[:, middle] - 1.0)
    return float(error[:, utilisation[middle] >= _LEAST_USUAL].mean())


def _series_of(series: FleetSeries, nodes: Sequence[Nodes], start: I64, steps: int) -> F64:
    """Return the values of a series for n data centers in the T steps of a run, (n, T)."""
    which = np.array([each.dc for each in nodes])
    index = np.asarray(start)[which, None] + np.arange(steps)
    return series.values.take(series.offsets[which, None] + index % series.lengths[which, None])


def _loop_commands(
    loops: LoopCommands | None, nodes: Nodes, outdoor_c: F64, wet_bulb_c: F64
) -> F64 | None:
    """Return the best commands of the loops of a data center, (T, I, 3); None holds the loops.

    Args:
        loops: Best commands of the loops of all data centers; None holds the loops.
        nodes: Utilisations of the data center.
        outdoor_c: Dry bulb of each step, in C, (T,).
        wet_bulb_c: Wet bulb of each step, in C, (T,).
    """
    if loops is None:
        return None
    shape = len(outdoor_c), len(nodes.utilisation)
    commands = loops.of(nodes.dc).at(
        np.broadcast_to(outdoor_c[:, None], shape),
        np.broadcast_to(wet_bulb_c[:, None], shape),
        np.broadcast_to(nodes.utilisation, shape),
    )
    return np.moveaxis(commands, 0, 2)


def _through_weather(
    facility: SteadyFacility,
    place: I64,
    outdoor_c: F64,
    wet_bulb_c: F64,
    loops_at: Callable[[int], F64 | None],
    throttles: Mask,
    on_step: Callable[[int], None] | None,
) -> dict[str, F64]:
    """Simulate B copies of data centers in the weather of each of T steps.

    Args:
        facility: B copies of data centers.
        place: Row of the weather for each copy, (B,).
        outdoor_c: Dry bulb of each step, in C, (n, T).
        wet_bulb_c: Wet bulb of each step, in C, (n, T).
        loops_at: Function that returns the commands of the coolant loops in a step, (3, B), by its
            number; None holds the loops.
        throttles: True for copies whose racks would throttle, (B,).
        on_step: Called after every step with the number of finished steps.

    Returns:
        Energy, water and unmet load by name of the field of ``FacilityTable``, (T, B) each. The
        unmet load is (1, B) if it is the same in all steps.
    """
    copies, steps = len(place), outdoor_c.shape[1]
    facility_kwh, water_l = (np.empty((steps, copies)) for _ in range(2))
    # Usually all heat is removed in all steps; a single row of zeros then represents all of them.
    unmet_w = np.zeros((1, copies))
    for step in range(steps):
        weather = outdoor_c[place, step], wet_bulb_c[place, step]
        result = facility.at(*weather, loops_at(step))
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
    """Return True for copies whose hottest inlet or outlet would throttle racks, (B,)."""
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
    """Extract the values of one data center, (T, I, J), from those of all copies, (T or 1, B)."""
    of_dc = np.ascontiguousarray(values[:, first : first + nodes.copies])
    shape = len(nodes.utilisation), len(nodes.setpoint_c)
    return np.broadcast_to(of_dc.reshape(-1, *shape), (steps, *shape))


INLET_MARGIN_K = 0.02
"""Margin of inlet limits, in K: plans stay below the limit by this margin, and bounds may exceed it
by this margin. It covers the error of linear interpolation of inlets between utilisations."""


def at_utilisation(values: F64, nodes: F64, utilisation: F64) -> F64:
    """Interpolate a table linearly at a utilisation of each step, (T, J).

    Args:
        values: Values by step, utilisation and setpoint, (T, I, J).
        nodes: Utilisations of the table, increasing, (I,).
        utilisation: Utilisation of each step, (T,), clipped to the range of the nodes.
    """
    low, share = _place(nodes, utilisation)
    step = np.arange(len(utilisation))
    return _between(values[step, low], values[step, low + 1], share[:, None])


def energy_at_utilisation(values: F64, nodes: F64, utilisation: F64) -> F64:
    """Interpolate the energy of a table by cubics at a utilisation of each step, in kWh, (T, J).

    Args:
        values: Energy by step, utilisation and setpoint, in kWh, (T, I, J).
        nodes: Utilisations of the table, increasing, (I,).
        utilisation: Utilisation of each step, (T,), clipped to the range of the nodes.
    """
    columns = [cubic(nodes, values[:, :, j], utilisation) for j in range(values.shape[2])]
    return np.stack(columns, axis=1)


def cubic(nodes: F64, values: F64, at: F64) -> F64:
    """Interpolate the values of each step by the cubic through the four nearest nodes, (T,).

    Args:
        nodes: Positions of the nodes, increasing, (I,).
        values: Values of each step at the nodes, (T, I).
        at: Position in each step, (T,), clipped to the range of the nodes.
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
    """Interpolate values linearly at setpoints, (...).

    Args:
        values: Values by setpoint, (..., J).
        nodes: Setpoints of the table, increasing, in C, (J,).
        setpoint_c: Setpoints, in C, of a shape that broadcasts to (...), clipped to the range of
            the nodes.
    """
    if len(nodes) == 1:
        return values[..., 0].copy()
    low, share = _place(nodes, setpoint_c)
    below, above = (
        np.take_along_axis(values, k[..., None], axis=-1)[..., 0] for k in (low, low + 1)
    )
    return _between(below, above, share)


def facility_kwh(table: FacilityTable, utilisation: F64, setpoint_c: F64) -> F64:
    """Interpolate the energy of the facility in each step from a table, in kWh, (T,).

    Args:
        table: Table of the steps.
        utilisation: Utilisation of each step, (T,).
        setpoint_c: Setpoint of each step, in C, (T,).
    """
    by_setpoint = energy_at_utilisation(table.facility_kwh, table.utilisation, utilisation)
    return at_setpoint(by_setpoint, table.setpoint_c, setpoint_c)


def barred(inlet_max_c: F64, unmet_w: F64, limit_c: float) -> Mask:
    """Return True for setpoints that a plan must not use, (..., J).

    If no setpoint meets the cooling load, setpoints with the smallest unmet load are allowed. If no
    setpoint satisfies the inlet limit, setpoints with the coolest inlets are allowed.

    Args:
        inlet_max_c: Hottest inlet by setpoint, in C, (..., J).
        unmet_w: Unmet cooling load by setpoint, in W, (..., J).
        limit_c: Limit of inlet temperatures, in C; inf without a limit.
    """
    within = inlet_max_c <= np.maximum(limit_c, coolest_inlet_c(inlet_max_c, unmet_w))
    return np.asarray(~(_meets(unmet_w) & within))


def coolest_inlet_c(inlet_max_c: F64, unmet_w: F64) -> F64:
    """Return the coolest hottest inlet among setpoints with the smallest unmet load, (..., 1).

    Args:
        inlet_max_c: Hottest inlet by setpoint, in C, (..., J).
        unmet_w: Unmet cooling load by setpoint, in W, (..., J).
    """
    return np.asarray(np.where(_meets(unmet_w), inlet_max_c, np.inf).min(axis=-1, keepdims=True))


def _meets(unmet_w: F64) -> Mask:
    """Return True for the setpoints with the smallest unmet cooling load, (..., J)."""
    return np.asarray(unmet_w <= unmet_w.min(axis=-1, keepdims=True))


def _between(low: F64, high: F64, share: F64) -> F64:
    """Interpolate between low and high values by a share of 0..1.

    An infinite value has no effect if its weight is 0.
    """
    below, above = np.where(share < 1.0, low, 0.0), np.where(share > 0.0, high, 0.0)
    return np.asarray(below * (1.0 - share) + above * share)


def _place(nodes: F64, at: F64) -> tuple[I64, F64]:
    """Return the index of the node below each position, and the fraction to the next node, 0..1."""
    low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    share = (at - nodes[low]) / (nodes[low + 1] - nodes[low])
    return low, np.clip(share, 0.0, 1.0)
