"""Maps of a step's energy by weather, utilisation and setpoint, for plans with forecast weather.

A ``FacilityTable`` covers only the actual weather of each step. Forecast weather may differ from
it, so a map has nodes throughout the weather of the year and interpolates linearly between them.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.hall.protection import Mask
from sdc_taichi.optimum.loop_map import LoopCommands
from sdc_taichi.optimum.tables import (
    FacilityTable,
    Nodes,
    barred,
    batches,
    setpoints_c,
    tabulate,
    what_decides_facility,
)
from sdc_taichi.plant.plants import PLANTS
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.types import F64, I64

MARGIN_K = 5.0
"""Margin of a map beyond the extreme weather of the year, for wrong forecasts, in K."""
_FEW = 4
"""Number of nodes of the wet-bulb depression (dry bulb minus wet bulb) for towers and dry coolers.

Their energy hardly depends on the depression. Air-side plants switch modes by outdoor humidity, so
their depression nodes have the same spacing as those of the dry bulb.
"""


_BARRED = 1e6
"""Factor by which a setpoint that is not allowed counts as dearer than the dearest setpoint."""


@dataclass(frozen=True, slots=True)
class FacilityMap:
    """Energy of a step by weather, utilisation and setpoint, for B data centers with M maps.

    The first weather axis, with W nodes, is the wet bulb for plants with a tower, and the dry bulb
    for all others. The second axis, with P nodes, is the wet-bulb depression, dry bulb minus wet
    bulb. Weather outside the nodes counts as that of the nearest node.
    """

    which: I64
    """Index of each data center's map among the M distinct maps, (B,)."""
    by_wet_bulb: bool
    """True if the first weather axis is the wet bulb, False if it is the dry bulb."""
    first_c: F64
    """First node of the first weather axis, in C, (M,)."""
    last_c: F64
    """Last node of the first weather axis that a map needs, in C, (M,). Later nodes only pad the
    array."""
    step_k: float
    """Spacing of the nodes of the first weather axis, in K."""
    depression_step_k: F64
    """Spacing of the nodes of wet-bulb depression (dry bulb minus wet bulb, first node 0), in K,
    (M,)."""
    last_depression_k: F64
    """Last node of wet-bulb depression that a map needs, in K, (M,). Later nodes only pad the
    array."""
    utilisation: F64
    """Utilisations, equally spaced from 0 to 1, (I,)."""
    setpoint_c: F64
    """Setpoints, increasing in equal steps, in C, (M, J). Maps with fewer than J setpoints repeat
    the highest one."""
    facility_kwh: F64
    """Energy of the facility without its battery, in kWh, (M, W, P, I, J)."""
    allowed: Mask
    """True if a plan may choose a setpoint, (M, W, P, I, J): its hottest inlet is within the limit
    and no heat remains in the room, or no other setpoint is better in this respect."""
    least_kwh: F64 = field(init=False)
    """Minimum energy of the allowed setpoints, in kWh, (M, W, P, I)."""

    def __post_init__(self) -> None:
        """Compute the minimum energy of the allowed setpoints."""
        least_kwh = np.where(self.allowed, self.facility_kwh, np.inf).min(axis=-1)
        object.__setattr__(self, "least_kwh", least_kwh)

    def best_setpoint_c(self, utilisation: F64, outdoor_c: F64, wet_bulb_c: F64) -> F64:
        """Return the allowed setpoint with the lowest energy in each of H steps, in C, (B, H).

        Args:
            utilisation: Utilisation, 0..1, (B, H).
            outdoor_c: Dry bulb, in C, (B, H).
            wet_bulb_c: Wet bulb, in C, (B, H).
        """
        places = self.places_of_weather(outdoor_c, wet_bulb_c)
        kwh = self._in_weather(self.facility_kwh, *places)
        bars = self._in_weather(np.where(self.allowed, 0.0, 1.0), *places)
        # The penalty is finite because infinite values cannot be interpolated between nodes.
        kwh += _BARRED * (1.0 + kwh.max(axis=-1, keepdims=True)) * (bars > 0.0)
        intervals = len(self.utilisation) - 1
        low, share = _place(utilisation * intervals, intervals + 1)
        below, above = (
            np.take_along_axis(kwh, at[..., None, None], axis=2)[:, :, 0] for at in (low, low + 1)
        )
        best = (below + share[..., None] * (above - below)).argmin(axis=-1)
        return np.asarray(np.take_along_axis(self.setpoint_c[self.which], best, axis=1))

    def least_kwh_in(self, outdoor_c: F64, wet_bulb_c: F64) -> F64:
        """Return the minimum energy of the allowed setpoints, in kWh, (B, H, I).

        Args:
            outdoor_c: Dry bulb, in C, (B, H).
            wet_bulb_c: Wet bulb, in C, (B, H).
        """
        return self._in_weather(self.least_kwh, *self.places_of_weather(outdoor_c, wet_bulb_c))

    def places_of_weather(self, outdoor_c: F64, wet_bulb_c: F64) -> tuple[F64, F64]:
        """Return fractional node indices of the weather on both axes, (B, H) each.

        Args:
            outdoor_c: Dry bulb, in C, (B, H).
            wet_bulb_c: Wet bulb, in C, (B, H).
        """
        which, (lead_nodes, depression_nodes) = self.which[:, None], self.facility_kwh.shape[1:3]
        lead_c = wet_bulb_c if self.by_wet_bulb else outdoor_c
        lead_c = np.minimum(lead_c, self.last_c[which])
        depression_k = np.minimum(outdoor_c - wet_bulb_c, self.last_depression_k[which])
        return (
            np.clip((lead_c - self.first_c[which]) / self.step_k, 0.0, lead_nodes - 1),
            np.clip(depression_k / self.depression_step_k[which], 0.0, depression_nodes - 1),
        )

    def _in_weather(self, values: F64, lead: F64, depression: F64) -> F64:
        """Interpolate values at weather nodes, (M, W, P, ...), at node indices, to (B, H, ...)."""
        wet, dry = values.shape[1:3]
        low, share = _place(lead, wet)
        low_k, share_k = _place(depression, dry)
        flat = values.reshape(-1, *values.shape[3:])
        at = (self.which[:, None] * wet + low) * dry + low_k
        added = (1,) * (values.ndim - 3)
        share, share_k = (x.reshape(*x.shape, *added) for x in (share, share_k))
        interpolated: F64 = flat[at] * ((1.0 - share) * (1.0 - share_k))
        interpolated += flat[at + dry] * (share * (1.0 - share_k))
        interpolated += flat[at + 1] * ((1.0 - share) * share_k)
        interpolated += flat[at + dry + 1] * (share * share_k)
        return interpolated

    def at_own_nodes(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        """Return the values of each of the M maps without weather nodes that only pad the array.

        Args:
            values: Values at all nodes, (M, W, P, ...).
        """
        wet = np.rint((self.last_c - self.first_c) / self.step_k).astype(np.int64) + 1
        dry = np.rint(self.last_depression_k / self.depression_step_k).astype(np.int64) + 1
        return [each[:w, :d] for each, w, d in zip(values, wet, dry, strict=True)]

    def places_of_setpoints(self, setpoint_c: F64) -> tuple[I64, F64]:
        """Return the node below each setpoint, and the fraction to the next node, (B, H) each."""
        nodes_c = self.setpoint_c[self.which]
        step_k = nodes_c[:, 1:2] - nodes_c[:, :1] if nodes_c.shape[1] > 1 else np.zeros(1)
        within_c = np.clip(setpoint_c, nodes_c[:, :1], nodes_c[:, -1:])
        place = (within_c - nodes_c[:, :1]) / np.where(step_k > 0, step_k, 1.0)
        return _place(place, nodes_c.shape[1])


def facility_map(
    fleet: Fleet,
    drivers: Drivers,
    *,
    inlet_limit_c: F64,
    weather_step_k: float = 1.0,
    margin_k: float = MARGIN_K,
    utilisations: int = 21,
    setpoint_step_k: float = 1.0,
    precision: Precision = "f32",
    loops: LoopCommands | None = None,
) -> FacilityMap:
    """Compute the map of each data center of a fleet for the weather of its year.

    Args:
        fleet: B data centers. Events, thermal mass and protection are ignored.
        drivers: Inputs of the data centers. Their design temperatures determine device sizes.
        inlet_limit_c: Highest inlet temperature that a plan may cause if another setpoint avoids
            it, in C, (B,); inf without a limit.
        weather_step_k: Spacing of the nodes of the first weather axis, in K.
        margin_k: Margin of the map beyond the extreme weather of the year, in K.
        utilisations: Number of utilisations, equally spaced from 0 to 1.
        setpoint_step_k: Maximum spacing of setpoints, in K.
        precision: Floating-point precision of the server kernels.
        loops: Best commands of the coolant loops, which the entries have; None holds the loops.

    Raises:
        PhysicalLimitError: A hall has no steady air state at some utilisation and setpoint.
    """
    by_wet_bulb = not PLANTS[fleet.models["plant"]].dry
    entries: dict[Hashable, int] = {}
    keys = [_what_decides(fleet, drivers, dc, inlet_limit_c) for dc in range(fleet.size)]
    for key in keys:
        entries.setdefault(key, len(entries))
    which = np.array([entries[key] for key in keys])
    dcs = [keys.index(key) for key in entries]
    reach = _ranges(fleet, drivers, which, by_wet_bulb, margin_k)
    weather = _weather_nodes(*reach, weather_step_k, fleet.models["plant"])
    levels = np.linspace(0.0, 1.0, utilisations)
    of_each = [setpoints_c(fleet.configs[dc], setpoint_step_k) for dc in dcs]
    setpoints = max(map(len, of_each))
    # Repeat the highest setpoint, so that all maps have the same number of setpoints.
    nodes = [
        Nodes(dc, levels, np.pad(x, (0, setpoints - len(x)), mode="edge"))
        for dc, x in zip(dcs, of_each, strict=True)
    ]
    tables: list[FacilityTable] = []
    for part in batches(fleet, nodes):
        rows = slice(len(tables), len(tables) + len(part))
        at = weather.outdoor_c[rows], weather.wet_bulb_c[rows]
        tables += tabulate(fleet, drivers, part, *at, precision, loops)
    shape = len(dcs), *weather.shape, utilisations, setpoints
    return FacilityMap(
        which=which,
        by_wet_bulb=by_wet_bulb,
        first_c=weather.first_c,
        last_c=weather.last_c,
        step_k=weather_step_k,
        depression_step_k=weather.depression_step_k,
        last_depression_k=weather.last_depression_k,
        utilisation=levels,
        setpoint_c=np.array([each.setpoint_c for each in nodes]),
        facility_kwh=np.stack([t.facility_kwh for t in tables]).reshape(shape),
        allowed=np.stack(
            [
                ~barred(table.inlet_max_c, table.unmet_w, inlet_limit_c[dc])
                for table, dc in zip(tables, dcs, strict=True)
            ]
        ).reshape(shape),
    )


@dataclass(frozen=True, slots=True)
class _WeatherNodes:
    """Weather nodes of the maps of M data centers, with W x P nodes on two axes.

    The first axis is the wet bulb or the dry bulb, the second the wet-bulb depression.
    """

    first_c: F64
    """First node of the first weather axis, in C, (M,)."""
    last_c: F64
    """Last node of the first weather axis that a map needs, in C, (M,)."""
    depression_step_k: F64
    """Spacing of the nodes of wet-bulb depression, in K, (M,)."""
    last_depression_k: F64
    """Last node of wet-bulb depression that a map needs, in K, (M,)."""
    shape: tuple[int, int]
    """Numbers of nodes of the two weather axes, W and P."""
    outdoor_c: F64
    """Dry bulb of all pairs of nodes, in C, (M, W * P)."""
    wet_bulb_c: F64
    """Wet bulb of all pairs of nodes, in C, (M, W * P)."""


def _weather_nodes(
    low_c: F64, high_c: F64, most_k: F64, step_k: float, plant: str
) -> _WeatherNodes:
    """Compute the weather nodes of M maps.

    Args:
        low_c: Lowest value of the first weather axis, in C, (M,).
        high_c: Highest value of the first weather axis, in C, (M,).
        most_k: Largest wet-bulb depression, in K, (M,).
        step_k: Spacing of the nodes of the first weather axis, in K.
        plant: Name of the plant model.
    """
    steps = np.maximum(np.ceil((high_c - low_c) / step_k), 1.0)
    few = np.full(len(low_c), _FEW - 1.0)
    depressions = np.maximum(np.ceil(most_k / step_k), few) if plant == "air_side" else few
    wet, dry = int(steps.max()) + 1, int(depressions.max()) + 1
    depression_step_k = most_k / depressions
    first, second = np.broadcast_arrays(
        (low_c[:, None] + step_k * np.arange(wet))[:, :, None],
        (depression_step_k[:, None] * np.arange(dry))[:, None, :],
    )
    towers = not PLANTS[plant].dry
    return _WeatherNodes(
        first_c=low_c,
        last_c=low_c + step_k * steps,
        depression_step_k=depression_step_k,
        last_depression_k=most_k,
        shape=(wet, dry),
        outdoor_c=(first + second if towers else first).reshape(len(low_c), -1),
        wet_bulb_c=(first if towers else first - second).reshape(len(low_c), -1),
    )


def _what_decides(fleet: Fleet, drivers: Drivers, dc: int, inlet_limit_c: F64) -> Hashable:
    """Return all values on which the map of a data center depends; equal values share a map."""
    series = drivers.outdoor_c, drivers.wet_bulb_c
    weather = tuple((int(each.offsets[dc]), int(each.lengths[dc])) for each in series)
    return what_decides_facility(fleet, drivers, dc), weather, float(inlet_limit_c[dc])


def _ranges(
    fleet: Fleet, drivers: Drivers, which: I64, by_wet_bulb: bool, margin_k: float
) -> tuple[F64, F64, F64]:
    """Compute the extreme weather of the year, with margins, for M maps.

    Returns:
        Minimum and maximum of the first weather axis, in C, and maximum wet-bulb depression, in K,
        (M,) each.
    """
    ranges: dict[int, tuple[float, float, float]] = {}
    for dc, entry in enumerate(which.tolist()):
        if entry not in ranges:
            both = drivers.outdoor_c, drivers.wet_bulb_c
            length = max(int(series.lengths[dc]) for series in both)
            outdoor_c, wet_bulb_c = (_year_of(series, dc, length) for series in both)
            lead_c = wet_bulb_c if by_wet_bulb else outdoor_c
            most_k = float(np.max(outdoor_c - wet_bulb_c)) + margin_k
            ranges[entry] = float(lead_c.min()) - margin_k, float(lead_c.max()) + margin_k, most_k
    low_c, high_c, most_k = np.array([ranges[entry] for entry in range(len(ranges))]).T
    return low_c, high_c, most_k


def _year_of(series: FleetSeries, dc: int, length: int) -> F64:
    """Return the first ``length`` values of one data center's series, repeated if necessary."""
    places = int(series.offsets[dc]) + np.arange(length) % int(series.lengths[dc])
    return series.values.take(places)


def _place(position: F64, nodes: int) -> tuple[I64, F64]:
    """Split a fractional node index into the node below and the fraction to the next node."""
    within = np.clip(position, 0.0, nodes - 1)
    low = np.minimum(within.astype(np.int64), max(nodes - 2, 0))
    return low, within - low
