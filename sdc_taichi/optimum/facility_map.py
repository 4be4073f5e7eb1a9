"""Energy of a step by weather, utilisation and setpoint, for plans on forecast weather.

A table holds the weather of each step. A forecast may be wrong, so a map has nodes throughout the
weather of the year and is interpolated linearly between them.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.hall.protection import Mask
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
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.types import F64, I64

MARGIN_K = 5.0
"""Distance by which a map extends beyond the weather of the year, for forecasts that err, in K."""
_FEW = 4
"""Number of nodes of the wet-bulb depression (dry bulb minus wet bulb), on which towers and dry
coolers hardly depend. Plants that let outdoor air in switch by its humidity, and have nodes as
close as those of the dry bulb."""


_BARRED = 1e6
"""Factor by which the energy of a barred setpoint exceeds that of the dearest one."""


@dataclass(frozen=True, slots=True)
class FacilityMap:
    """Energy of a step of B data centers, M of which differ, by weather, load and setpoint.

    The first axis of the weather is the wet bulb where heat goes to a tower, else the dry bulb; the
    second is the dry bulb less the wet bulb. Weather beyond the nodes is read at the last ones.
    """

    which: I64
    """Entry of each data center among those that differ, (B,)."""
    by_wet_bulb: bool
    """Whether the first axis of the weather is the wet bulb."""
    first_c: F64
    """First node of the first axis, in C, (M,)."""
    last_c: F64
    """Last node of the first axis that is a data center's own, in C, (M,)."""
    step_k: float
    """Distance of its nodes, in K."""
    depression_step_k: F64
    """Distance of the nodes of dry bulb less wet bulb, the first of which is 0, in K, (M,)."""
    last_depression_k: F64
    """Last of these nodes that is a data center's own, in K, (M,)."""
    utilisation: F64
    """Utilisations, evenly from 0 to 1, (I,)."""
    setpoint_c: F64
    """Setpoints, rising in equal steps to the highest, which fills what is left, in C, (M, J)."""
    facility_kwh: F64
    """Energy of the facility without its battery, in kWh, (M, W, P, I, J)."""
    allowed: Mask
    """Whether a plan may choose a setpoint: its hottest inlet is within the limit and it leaves no
    heat in the room, or no setpoint does better, (M, W, P, I, J)."""
    least_kwh: F64 = field(init=False)
    """Least energy among the setpoints that are allowed, in kWh, (M, W, P, I)."""

    def __post_init__(self) -> None:
        """Find the least energy among setpoints."""
        least_kwh = np.where(self.allowed, self.facility_kwh, np.inf).min(axis=-1)
        object.__setattr__(self, "least_kwh", least_kwh)

    def best_setpoint_c(self, utilisation: F64, outdoor_c: F64, wet_bulb_c: F64) -> F64:
        """The setpoint of least energy among the nodes that are allowed, in C, (B, H).

        Args:
            utilisation: Utilisation, 0..1, (B, H).
            outdoor_c: Dry bulb, in C, (B, H).
            wet_bulb_c: Wet bulb, in C, (B, H).
        """
        places = self.places_of_weather(outdoor_c, wet_bulb_c)
        kwh = self._in_weather(self.facility_kwh, *places)
        bars = self._in_weather(np.where(self.allowed, 0.0, 1.0), *places)
        # A number, so that shares of nodes can be taken of it.
        kwh += _BARRED * (1.0 + kwh.max(axis=-1, keepdims=True)) * (bars > 0.0)
        intervals = len(self.utilisation) - 1
        low, share = _place(utilisation * intervals, intervals + 1)
        below, above = (
            np.take_along_axis(kwh, at[..., None, None], axis=2)[:, :, 0] for at in (low, low + 1)
        )
        best = (below + share[..., None] * (above - below)).argmin(axis=-1)
        return np.asarray(np.take_along_axis(self.setpoint_c[self.which], best, axis=1))

    def places_of_weather(self, outdoor_c: F64, wet_bulb_c: F64) -> tuple[F64, F64]:
        """Places of the weather on the two axes, counted in nodes, each (B, H).

        Args:
            outdoor_c: Dry bulb, in C, (B, H).
            wet_bulb_c: Wet bulb, in C, (B, H).
        """
        which, (lead_nodes, depression_nodes) = self.which[:, None], self.facility_kwh.shape[1:3]
        lead_c = wet_bulb_c if self.by_wet_bulb else outdoor_c
        lead_c = np.minimum(lead_c, self.last_c[which])
        below_k = np.minimum(outdoor_c - wet_bulb_c, self.last_depression_k[which])
        return (
            np.clip((lead_c - self.first_c[which]) / self.step_k, 0.0, lead_nodes - 1),
            np.clip(below_k / self.depression_step_k[which], 0.0, depression_nodes - 1),
        )

    def _in_weather(self, values: F64, lead: F64, depression: F64) -> F64:
        """Values at places of the weather, (B, H, ...), from those at nodes, (M, W, P, ...)."""
        wet, dry = values.shape[1:3]
        low, share = _place(lead, wet)
        low_k, share_k = _place(depression, dry)
        flat = values.reshape(-1, *values.shape[3:])
        at = (self.which[:, None] * wet + low) * dry + low_k
        added = (1,) * (values.ndim - 3)
        share, share_k = (x.reshape(*x.shape, *added) for x in (share, share_k))
        found: F64 = flat[at] * ((1.0 - share) * (1.0 - share_k))
        found += flat[at + dry] * (share * (1.0 - share_k))
        found += flat[at + 1] * ((1.0 - share) * share_k)
        found += flat[at + dry + 1] * (share * share_k)
        return found

    def at_own_nodes(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        """Values of each entry without nodes of weather that only other entries need, M of them.

        Args:
            values: Values at all nodes, (M, W, P, ...).
        """
        wet = np.rint((self.last_c - self.first_c) / self.step_k).astype(np.int64) + 1
        dry = np.rint(self.last_depression_k / self.depression_step_k).astype(np.int64) + 1
        return [each[:w, :d] for each, w, d in zip(values, wet, dry, strict=True)]

    def places_of_setpoints(self, setpoint_c: F64) -> tuple[I64, F64]:
        """Node below each setpoint, and its share of the way to the next, each (B, H)."""
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
) -> FacilityMap:
    """Map of the data centers of a fleet over the weather of their year.

    Args:
        fleet: B data centers. Events, thermal mass and protection are left out.
        drivers: Their inputs, whose design temperatures size the devices.
        inlet_limit_c: Highest inlet that a plan may cause where it has a choice, in C, (B,); inf
            without a limit.
        weather_step_k: Distance of the nodes of the first axis of the weather, in K.
        margin_k: How far the map reaches beyond the weather of the year, in K.
        utilisations: Number of utilisations, evenly from 0 to 1.
        setpoint_step_k: Largest distance of setpoints, in K.
        precision: Of the server kernels.

    Raises:
        PhysicalLimitError: A hall that finds no steady air at some utilisation and setpoint.
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
    # The highest setpoint is repeated to the number of all.
    nodes = [
        Nodes(dc, levels, np.pad(x, (0, setpoints - len(x)), mode="edge"))
        for dc, x in zip(dcs, of_each, strict=True)
    ]
    tables: list[FacilityTable] = []
    for part in batches(fleet, nodes):
        own = slice(len(tables), len(tables) + len(part))
        at = weather.outdoor_c[own], weather.wet_bulb_c[own]
        tables += tabulate(fleet, drivers, part, *at, precision)
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
    """Nodes of the weather of M data centers, W of the first axis and P of the second."""

    first_c: F64
    """First node of the first axis, in C, (M,)."""
    last_c: F64
    """Last node of the first axis that is a data center's own, in C, (M,)."""
    depression_step_k: F64
    """Distance of the nodes of the second axis, in K, (M,)."""
    last_depression_k: F64
    """Last node of the second axis that is a data center's own, in K, (M,)."""
    shape: tuple[int, int]
    """Numbers of nodes of the two axes, W and P."""
    outdoor_c: F64
    """Dry bulb of all pairs of nodes, in C, (M, W P)."""
    wet_bulb_c: F64
    """Wet bulb of all pairs of nodes, in C, (M, W P)."""


def _weather_nodes(
    low_c: F64, high_c: F64, most_k: F64, step_k: float, plant: str
) -> _WeatherNodes:
    """Nodes from the lowest to the highest of the first axis, C, and to a depression, K, (M,)."""
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
    """Values that decide the map of a data center."""
    series = drivers.outdoor_c, drivers.wet_bulb_c
    weather = tuple((int(each.offsets[dc]), int(each.lengths[dc])) for each in series)
    return what_decides_facility(fleet, drivers, dc), weather, float(inlet_limit_c[dc])


def _ranges(
    fleet: Fleet, drivers: Drivers, which: I64, by_wet_bulb: bool, margin_k: float
) -> tuple[F64, F64, F64]:
    """Weather of the year: least and most of the first axis, C, most depression, K, each (M,)."""
    found: dict[int, tuple[float, float, float]] = {}
    for dc, entry in enumerate(which.tolist()):
        if entry not in found:
            both = drivers.outdoor_c, drivers.wet_bulb_c
            length = max(int(series.lengths[dc]) for series in both)
            outdoor_c, wet_bulb_c = (_year_of(series, dc, length) for series in both)
            lead_c = wet_bulb_c if by_wet_bulb else outdoor_c
            most_k = float(np.max(outdoor_c - wet_bulb_c)) + margin_k
            found[entry] = float(lead_c.min()) - margin_k, float(lead_c.max()) + margin_k, most_k
    low_c, high_c, most_k = np.array([found[entry] for entry in range(len(found))]).T
    return low_c, high_c, most_k


def _year_of(series: FleetSeries, dc: int, length: int) -> F64:
    """The first values of one data center, (T,)."""
    places = int(series.offsets[dc]) + np.arange(length) % int(series.lengths[dc])
    return series.values.take(places)


def _place(position: F64, nodes: int) -> tuple[I64, F64]:
    """Node below a position, counted in nodes, and its share of the way to the next."""
    within = np.clip(position, 0.0, nodes - 1)
    low = np.minimum(within.astype(np.int64), max(nodes - 2, 0))
    return low, within - low
