"""Causes of inlet temperatures: the inlet temperature of a rack as an exact sum of parts.

Symbols: T_sup is the temperature of the supply air that reaches rack j, X_i the exhaust
temperature of rack i, w_ji its weight in the exhaust mix before rack j, and T_mix = sum_i w_ji X_i
the temperature of this mix. CRAC unit k covers the share f_k of the supply air that its racks
demand and has the share s_jk in the supply of rack j. r_j is the exhaust share of rack j, and g the
height factor of a server. Then

    e     = 1 - (1 - r_j g) sum_k s_jk f_k       share of exhaust air in the server's intake
    T_in  = T_sup + e (T_mix - T_sup) = setpoint + (T_sup - setpoint) + sum_i e w_ji (X_i - T_sup)
    e     = r_j + r_j (g - 1) + (1 - r_j g) (1 - sum_k s_jk f_k)

The second line splits the inlet temperature by the rack whose exhaust causes it. The third line
splits the exhaust share into the effects of the layout, of the server's height, and of CRAC units
that supply less than the racks demand (equations of docs/hall.md). Neither sum has a remainder.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.hall.unit_supply import largest_shares, weighted_shares
from sdc_taichi.kernels.hall_arguments import GROUP_INPUTS, RACK_OUT
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_tables import HallTables
from sdc_taichi.types import F64, I64, fields_of


@dataclass(frozen=True, slots=True)
class IntakeAir:
    """Air before the racks of a fleet with R racks and U CRAC units after a step.

    In transient halls, values are those at the end of the step, except ``airflow_m3s``,
    ``power_w``, ``outlet_c`` and ``unit_m3s``, which are means over the step.
    """

    mixed_c: F64
    """Temperature of the recirculated air before each rack, in C, (R,)."""
    exhaust_c: F64
    """Exhaust temperature of each rack, in C, (R,): that of its outlet, mixed with ``mixed_c`` for
    the airflow that failed fans lack."""
    airflow_m3s: F64
    """Airflow through each rack, in m3/s, (R,)."""
    power_w: F64
    """Power of each rack including its fans, in W, (R,)."""
    outlet_c: F64
    """Outlet temperature of each rack, in C, (R,)."""
    fan_airflow: F64
    """Remaining airflow of each rack's fans as a share of full airflow, 0..1, (R,)."""
    powered: F64
    """Share of the step during which each rack is on, 0..1, (R,)."""
    exhaust_share: F64
    """Share of exhaust air in the intake of each rack where CRAC units cover its demand, 0..1,
    (R,)."""
    setpoint_c: F64
    """Supply air setpoint of each CRAC unit, in C, (U,)."""
    supply_c: F64
    """Supply temperature of each CRAC unit, in C, (U,)."""
    fresh_ratio: F64
    """Share of the demanded supply airflow that each CRAC unit covers, 0..1, (U,)."""
    unit_m3s: F64
    """Airflow of each CRAC unit, in m3/s, (U,)."""
    unit_weight: F64
    """Weight of each CRAC unit in the supply of all racks, above 0, (U,): 1 where shares are those
    of the layout."""
    supply_ratio: F64
    """Supply air of each CRAC unit that reaches racks, divided by their need at the exhaust shares
    of the design point, (U,); 1 where no unit of the hall delivers more than that."""


UNIT_FIELDS = (
    *("setpoint_c", "supply_c", "fresh_ratio", "unit_m3s", "unit_weight", "supply_ratio"),
)
"""Fields of ``IntakeAir`` with an entry per CRAC unit."""
RACK_FIELDS = tuple(f.name for f in fields(IntakeAir) if f.name not in UNIT_FIELDS)
"""Fields of ``IntakeAir`` with an entry per rack."""


def read_intake_air(tables: HallTables, rack_out: Any, exhaust: Any, setpoint_c: F64) -> IntakeAir:
    """Read the air before the racks from the arrays of the kernels after a step.

    Args:
        tables: Arrays of the kernels.
        rack_out: Kernel rows ``RACK_OUT``, padded to whole blocks of racks.
        exhaust: Exhaust temperature times strength of each rack after the last sweep, padded.
        setpoint_c: Supply setpoint of each CRAC unit, in C, (U,).
    """
    out = dict(zip(RACK_OUT, rack_out.reshape(len(RACK_OUT), -1), strict=True))
    rack, unit = tables.rows("rack_inputs"), tables.rows("unit_state")
    exceeds = np.repeat(tables.rows("dc_doubles")["exceeds_used"] > 0, tables.units_per_dc)
    strength = rack["strength"]
    rows = {
        "mixed_c": tables.rows("rack_state")["mixed_c"],
        "exhaust_c": exhaust.reshape(-1) / np.where(strength > 0, strength, 1.0),
        "airflow_m3s": out["airflow_m3s"],
        "power_w": out["cpu_w"] + out["fan_w"],
        "outlet_c": out["outlet_c"],
        "fan_airflow": rack["fan_airflow"],
        "powered": rack["powered"],
        "exhaust_share": rack["exhaust_share"],
    }
    racks = tables.places.values_of_racks(np.stack([*rows.values()]))
    return IntakeAir(
        **dict(zip(rows, racks.astype(np.float64), strict=True)),
        setpoint_c=np.array(setpoint_c),
        supply_c=unit["supply_c"].copy(),
        fresh_ratio=unit["fresh_ratio_used"].copy(),
        unit_m3s=unit["flow_m3s"].copy(),
        unit_weight=tables.plenum.weight * unit["strength_used"],
        supply_ratio=np.where(exceeds, unit["supply_ratio_used"], 1.0),
    )


def intake_air_of(fleet: Fleet, air: IntakeAir, dc: int) -> IntakeAir:
    """Return the part of ``air`` that belongs to data center ``dc`` of a fleet."""
    racks = slice(fleet.rack_offsets[dc], fleet.rack_offsets[dc + 1])
    units = slice(fleet.unit_offsets[dc], fleet.unit_offsets[dc + 1])
    parts = {name: getattr(air, name)[racks] for name in RACK_FIELDS}
    return IntakeAir(**parts, **{name: getattr(air, name)[units] for name in UNIT_FIELDS})


LISTED_SOURCES = 5
"""Number of other racks whose exhaust is listed by name; the remaining exhaust is summed."""
HOTTEST_RACKS = 5
"""Number of racks whose inlet temperatures reports and recordings explain."""
LISTED_UNITS = 8
"""Number of CRAC units that are described, those with the largest shares."""
LEAST_K = 0.005
"""Minimum absolute size of a temperature part that texts mention, in K."""
LEAST_SHARE = 0.0005
"""Minimum share of a CRAC unit in the supply air of a rack that texts mention."""
_HEIGHT_ROW = list(GROUP_INPUTS).index("height_factor")
_OFFSET_ROW = list(GROUP_INPUTS).index("inlet_offset_k")


@dataclass(frozen=True, slots=True)
class InletParts:
    """Inlet temperature of a rack's hottest server, split into parts; R racks, U CRAC units.

    ``inlet_c`` is the sum of ``setpoint_c``, ``warming_k``, ``approach_k``, all entries of
    ``exhaust_k``, and ``lag_k``. The parts ``layout_k``, ``height_k`` and ``shortfall_k`` split the
    sum of ``exhaust_k`` and ``lag_k`` in another way.
    """

    rack: int
    """Index of the rack, counted from 0 in its hall."""
    server: int
    """Index of the server, counted from 0 at the floor of its rack; the lowest of equal ones."""
    servers: int
    """Number of servers of the rack."""
    inlet_c: float
    """Inlet temperature of the server, in C."""
    setpoint_c: float
    """Setpoint of the supply air that reaches the rack, in C, mean over the CRAC units weighted by
    their supply; with control of the return air, the coldest supply temperature instead."""
    controls_return: bool
    """True if the setpoints of the CRAC units are those of the return air."""
    warming_k: float
    """Supply temperature at the rack minus ``setpoint_c``, in K, due to insufficient cooling."""
    approach_k: float
    """Configured approach temperature of the rack plus offset of the server, in K; 0 with inlet
    model ``recirculation``."""
    exhaust_k: F64
    """Contribution of the exhaust of each rack of the hall to the inlet temperature, in K, (R,); 0
    with inlet model ``approach``."""
    lag_k: float
    """Contribution of the thermal lag of the room air before the rack, which is warmer or colder
    than the mix of current exhausts, in K; only round-off in quasi-steady halls."""
    exhaust_share: float
    """Share of exhaust air in the server's intake, 0..1."""
    layout_k: float
    """Contribution of the exhaust share that the layout causes at mean server height, in K."""
    height_k: float
    """Contribution of the server's height in its rack, in K; negative near the floor."""
    shortfall_k: float
    """Contribution of the exhaust air that replaces missing supply air of the CRAC units, in K."""
    approaches: str
    """Text on whether approach temperatures are imposed by the config or computed."""
    containment: float
    """Share of the air paths between exhausts and inlets that containment closes, 0..1."""
    contained_k: float | None
    """Reduction of the inlet temperature by containment at the same exhaust temperatures, in K;
    None if containment closes every path, or if the measured exhaust share leaves the open hall no
    supply air."""
    airflow_m3s: float
    """Airflow through the rack, in m3/s."""
    power_w: float
    """Power of the rack including its fans, in W."""
    outlet_c: float
    """Outlet temperature of the rack, in C."""
    fan_airflow: float
    """Remaining airflow of the rack's fans as a share of full airflow, 0..1; below 1 if fans
    fail."""
    powered: float
    """Share of the step during which the rack is on, 0..1."""
    unit_share: F64
    """Share of each CRAC unit in the supply air that reaches the rack, 0..1, (U,)."""
    unit_supply_c: F64
    """Supply temperature of each CRAC unit, in C, (U,)."""
    unit_fresh_ratio: F64
    """Share of the demanded supply airflow that each CRAC unit covers, 0..1, (U,)."""
    unit_m3s: F64
    """Airflow of each CRAC unit, in m3/s, (U,)."""

    @property
    def supply_c(self) -> float:
        """Temperature of the supply air that reaches the rack, in C."""
        return self.setpoint_c + self.warming_k

    @property
    def rise_k(self) -> float:
        """Inlet temperature minus the temperature of the supply air that reaches the rack, in K."""
        return self.inlet_c - self.supply_c

    @property
    def own_exhaust_k(self) -> float:
        """Contribution of the rack's own exhaust to its inlet temperature, in K."""
        return float(self.exhaust_k[self.rack])

    def sources(self, most: int = LISTED_SOURCES) -> list[tuple[int, float]]:
        """Return the other racks with the largest contributions, as (rack, K), largest first."""
        others = np.flatnonzero(self.exhaust_k > 0.0)
        others = others[others != self.rack]
        order = np.argsort(-rank(self.exhaust_k[others]), kind="stable")[:most]
        return [(int(rack), float(self.exhaust_k[rack])) for rack in others[order]]


class Inlets:
    """Explains the inlet temperatures of one data center from the air before its R racks."""

    def __init__(self, fleet: Fleet, dc: int, air: IntakeAir) -> None:
        self._fleet, self._dc, self._air = fleet, dc, air
        self._first_rack = int(fleet.rack_offsets[dc])
        self._racks = int(fleet.rack_offsets[dc + 1]) - self._first_rack
        self._group_rows = fleet.group_rows[dc]
        offsets = fleet.group_offsets[self._first_rack : self._first_rack + self._racks + 1]
        self._group_offsets = offsets - offsets[0]
        if fleet.air is None:
            self._shares, self._weight = np.ones((self._racks, 1)), np.ones(1)
            self._covered, self._covered_c = (
                np.ones(self._racks),
                np.full(self._racks, air.supply_c[0]),
            )
            self._exhaust_share = air.exhaust_share
        else:
            first, end = fleet.air.unit_share_offsets[dc : dc + 2]
            self._shares = fleet.air.unit_shares[first:end].reshape(self._racks, -1)
            weight = self._weight = air.unit_weight
            # One product with all rows reads the shares of large halls only once.
            rows = np.stack([np.ones(len(weight)), air.fresh_ratio, air.supply_ratio])
            rows = np.concatenate([rows, rows[1:2] * air.supply_c]) * weight
            total, covered, supply, covered_c = (self._shares @ rows.T).T
            self._covered, self._covered_c = covered / total, covered_c / total
            excess = np.maximum(supply / total - 1.0, 0.0)
            self._exhaust_share = air.exhaust_share * np.exp(-fleet.oversupply_decay[dc] * excess)
        self._group_inlet_c = self._group_inlets()

    def hottest(self, most: int) -> list[int]:
        """Return the indices of the ``most`` racks with the hottest inlets, hottest first."""
        hottest_c = np.maximum.reduceat(self._group_inlet_c, self._group_offsets[:-1])
        ranked, chosen = rank(hottest_c), np.arange(self._racks)
        if 0 < most < self._racks:
            # Sorting all racks of a large hall would take longer than this selection.
            coldest = np.partition(ranked, self._racks - most)[self._racks - most]
            chosen = np.flatnonzero(ranked >= coldest)
        order = np.argsort(-ranked[chosen], kind="stable")[:most]
        return [int(rack) for rack in chosen[order]]

    def main_units(self) -> tuple[I64, F64]:
        """Return the CRAC unit that gives each rack most of its supply air, and its share, (R,).

        Units are counted from 0 in their hall; shares are 0..1, and 0 where no unit gives air.
        """
        return largest_shares(self._shares, self._weight * self._air.fresh_ratio)

    def parts(self, rack: int) -> InletParts:
        """Split the inlet temperature of a rack's hottest server into parts."""
        air, fleet = self._air, self._fleet
        first, end = self._group_offsets[rack : rack + 2]
        group = int(first + np.argmax(rank(self._group_inlet_c[first:end])))
        group_0 = fleet.group_offsets[self._first_rack]
        ends = fleet.server_offsets[group_0 + np.array([first, group, end])]
        shares = weighted_shares(self._shares[rack, None], self._weight)[0]
        covered = shares * air.fresh_ratio
        cover = float(covered.sum())
        # If no unit supplies air, the configured shares define a nominal supply temperature.
        unit_share = covered / cover if cover > 0.0 else shares
        setpoint_c = float(unit_share @ air.setpoint_c)
        supply_c = float(unit_share @ air.supply_c)
        plain = InletParts(
            rack=rack,
            server=int(ends[1] - ends[0]),
            servers=int(ends[2] - ends[0]),
            inlet_c=float(self._group_inlet_c[group]),
            setpoint_c=setpoint_c,
            controls_return=fleet.configs[self._dc].hvac.crac.temperature_control == "return",
            warming_k=supply_c - setpoint_c,
            approach_k=0.0,
            exhaust_k=np.zeros(self._racks),
            lag_k=0.0,
            exhaust_share=0.0,
            layout_k=0.0,
            height_k=0.0,
            shortfall_k=0.0,
            approaches=fleet.configs[self._dc].hall.recirculation.approach_text,
            containment=fleet.configs[self._dc].hall.layout.containment,
            contained_k=0.0,
            airflow_m3s=float(air.airflow_m3s[rack]),
            power_w=float(air.power_w[rack]),
            outlet_c=float(air.outlet_c[rack]),
            fan_airflow=float(air.fan_airflow[rack]),
            powered=float(air.powered[rack]),
            unit_share=unit_share,
            unit_supply_c=air.supply_c,
            unit_fresh_ratio=air.fresh_ratio,
            unit_m3s=air.unit_m3s,
        )
        if fleet.air is None:
            offset_k = float(self._group_rows[_OFFSET_ROW, group])
            approach_k = float(fleet.approach_k[self._first_rack + rack]) + offset_k
            return replace(plain, approach_k=approach_k)
        return self._with_exhaust(plain, cover, float(self._group_rows[_HEIGHT_ROW, group]))

    def _with_exhaust(self, plain: InletParts, cover: float, height: float) -> InletParts:
        """Add the contributions of exhaust air.

        Args:
            plain: Parts without exhaust air.
            cover: Share of the rack's demand for supply air that the units cover.
            height: Height factor of the server.
        """
        assert self._fleet.air is not None
        rack, supply_c, closed = plain.rack, plain.supply_c, plain.containment
        share = float(self._exhaust_share[rack])
        mix_k = float(self._air.mixed_c[rack]) - supply_c
        fresh = 1.0 - share * height
        exhaust_share = 1.0 - fresh * cover
        sources, weights = self._fleet.air.mix_weights.row(self._first_rack + rack)
        exhaust_k = np.zeros(self._racks)
        np.add.at(exhaust_k, sources - self._first_rack, exhaust_share * weights)
        exhaust_k *= self._air.exhaust_c - supply_c
        open_share = share / (1.0 - closed) if closed < 1.0 else np.nan
        contained_k = (open_share - share) * height * cover * mix_k
        is_known = open_share * height < 1.0
        return replace(
            plain,
            exhaust_k=exhaust_k,
            lag_k=exhaust_share * mix_k - float(exhaust_k.sum()),
            exhaust_share=exhaust_share,
            layout_k=share * mix_k,
            height_k=share * (height - 1.0) * mix_k,
            shortfall_k=fresh * (1.0 - cover) * mix_k,
            contained_k=contained_k if is_known else None,
        )

    def _group_inlets(self) -> F64:
        """Compute the inlet temperature of every server group of the data center, in C, (G,)."""
        air, counts = self._air, np.diff(self._group_offsets)
        if self._fleet.air is None:
            first = self._first_rack
            rack_c = air.supply_c[0] + self._fleet.approach_k[first : first + self._racks]
            return np.asarray(np.repeat(rack_c, counts) + self._group_rows[_OFFSET_ROW])
        fresh_k = self._covered_c - self._covered * air.mixed_c
        taken = np.repeat(self._exhaust_share, counts) * self._group_rows[_HEIGHT_ROW]
        mixed_c, fresh_k = np.repeat(air.mixed_c, counts), np.repeat(fresh_k, counts)
        return np.asarray(mixed_c + (1.0 - taken) * fresh_k)


def inlet_terms(parts: InletParts, racks_per_row: int) -> list[tuple[str, float]]:
    """Return the parts of an inlet temperature with texts: first the setpoint in C, then K.

    Parts smaller than ``LEAST_K`` are omitted.

    Args:
        parts: The parts of the inlet temperature.
        racks_per_row: Number of racks in each row of the hall.
    """
    listed = parts.sources()
    others_k = float(parts.exhaust_k.sum()) - parts.own_exhaust_k - sum(k for _, k in listed)
    others = len(parts.exhaust_k) - 1 - len(listed)
    terms = [
        ("supply air over that temperature", parts.warming_k),
        ("approach temperature of the config", parts.approach_k),
        *((f"exhaust of {rack_text(i, racks_per_row)}", k) for i, k in listed),
        (f"exhaust of {others:,} other rack{'' if others == 1 else 's'}", others_k),
        ("its own exhaust", parts.own_exhaust_k),
        ("room air that is warmer than the exhausts of the moment", parts.lag_k),
    ]
    shown = [(text, k) for text, k in terms if abs(k) >= LEAST_K]
    first = "coldest supply air that its setpoint of return air admits"
    first = first if parts.controls_return else "setpoint of its supply air"
    return [(first, parts.setpoint_c), *shown]


def exhaust_terms(parts: InletParts) -> list[tuple[str, float]]:
    """Return the reasons why exhaust air reaches an inlet, as texts with contributions in K."""
    terms = [
        ("by the layout, at mean height", parts.layout_k),
        (f"by the height of server {parts.server} of {parts.servers}", parts.height_k),
        ("in place of air that the CRAC units do not give", parts.shortfall_k),
    ]
    return [(text, k) for text, k in terms if abs(k) >= LEAST_K]


def state_texts(parts: InletParts) -> list[str]:
    """Describe containment, CRAC units and fans of a rack in sentences."""
    texts = []
    if parts.exhaust_share > 0:
        texts.append(f"approach temperatures are {parts.approaches}")
    if parts.containment > 0:
        kept_out = (
            "" if parts.contained_k is None else f", which keeps out {parts.contained_k:.2f} K"
        )
        texts.append(f"containment closes {100 * parts.containment:g} % of the paths{kept_out}")
    units = np.argsort(-parts.unit_share, kind="stable")[:LISTED_UNITS]
    texts += [
        f"CRAC unit {i} gives {100 * parts.unit_share[i]:.1f} % of its supply air, at "
        f"{parts.unit_supply_c[i]:.2f} C; its {parts.unit_m3s[i]:.4g} m3/s cover "
        f"{100 * parts.unit_fresh_ratio[i]:.1f} % of what its racks ask for"
        for i in units
        if parts.exhaust_share > 0 and parts.unit_share[i] >= LEAST_SHARE
    ]
    rest = 1.0 - float(parts.unit_share[units].sum())
    if parts.exhaust_share > 0 and rest >= LEAST_SHARE:
        texts.append(f"the other CRAC units give {100 * rest:.1f} %")
    fans = f"the rack draws {parts.power_w / 1e3:.1f} kW, its fans move {parts.airflow_m3s:.3f} "
    fans += f"m3/s, its outlet is {parts.outlet_c:.1f} C"
    if parts.fan_airflow < 1.0:
        fans += f"; the fans fail and keep {100 * parts.fan_airflow:.0f} % of their airflow"
    if parts.powered < 1.0:
        fans += f"; the rack is on for {100 * parts.powered:.0f} % of the step"
    return [*texts, fans]


def rack_text(rack: int, racks_per_row: int) -> str:
    """Return the text for a rack: its index, its row and its place in the row."""
    row, place = divmod(rack, racks_per_row)
    return f"rack {rack} (row {row}, place {place})"


def inlet_values(parts: InletParts) -> dict[str, Any]:
    """Convert the parts of an inlet temperature to plain values for JSON.

    Keys name the units; lists are by rack or CRAC unit.
    """
    values = fields_of(parts) | {"supply_c": parts.supply_c, "rise_k": parts.rise_k}
    return {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in values.items()}
