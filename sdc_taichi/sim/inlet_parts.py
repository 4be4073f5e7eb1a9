"""Why the inlet of a rack is as warm as it is: its temperature as a sum of parts.

With T_sup the supply air that reaches rack j, T_mix = sum_i w_ji X_i the exhaust mix before it, X_i
what rack i gives to the mixes, f_k the share of its racks' need that CRAC unit k covers, s_jk the
unit's share in their supply air, r_j the rack's exhaust share and g the height factor of a server,

    e     = 1 - (1 - r_j g) sum_k s_jk f_k       share of the server's intake that is exhaust
    T_in  = T_sup + e (T_mix - T_sup) = setpoint + (T_sup - setpoint) + sum_i e w_ji (X_i - T_sup)
    e     = r_j + r_j (g - 1) + (1 - r_j g) (1 - sum_k s_jk f_k)

The second line says whose exhaust warms the inlet by how much; the third says whether it reaches
the inlet by the layout, by the height of the server, or because the units fall short of the need
(equations of docs/hall.md). Both are sums without a remainder.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.hall.unit_supply import weighted_shares
from sdc_taichi.kernels.hall_arguments import GROUP_INPUTS, RACK_OUT
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_tables import HallTables
from sdc_taichi.types import F64, fields_of


@dataclass(frozen=True, slots=True)
class IntakeAir:
    """Air before the racks of a fleet with R racks and U CRAC units at one moment.

    Of quasi-steady halls in the last step, of transient halls at its end; ``airflow_m3s``,
    ``power_w``, ``outlet_c`` and ``unit_m3s`` are means over the step.
    """

    mixed_c: F64
    """Recirculated air before each rack, in C, (R,)."""
    exhaust_c: F64
    """Temperature that each rack gives to the exhaust mixes, in C, (R,): its outlet, and for the
    share of its air that failing fans do not move the mix before it."""
    airflow_m3s: F64
    """Airflow through each rack, in m3/s, (R,)."""
    power_w: F64
    """Power of each rack with its fans, in W, (R,)."""
    outlet_c: F64
    """Outlet of each rack, in C, (R,)."""
    fan_airflow: F64
    """Share of their airflow left to the fans of each rack, 0..1, (R,)."""
    powered: F64
    """Share of the step that each rack is on, 0..1, (R,)."""
    setpoint_c: F64
    """Supply air setpoint of each CRAC unit, in C, (U,)."""
    supply_c: F64
    """Supply air of each CRAC unit, in C, (U,)."""
    fresh_ratio: F64
    """Share of its racks' need for supply air that each CRAC unit covers, 0..1, (U,)."""
    unit_m3s: F64
    """Airflow of each CRAC unit, in m3/s, (U,)."""
    unit_weight: F64
    """Weight of each CRAC unit in the supply of all racks, 0..1, (U,): 1 while all units run."""


UNIT_FIELDS = ("setpoint_c", "supply_c", "fresh_ratio", "unit_m3s", "unit_weight")
"""Fields of ``IntakeAir`` with an entry per CRAC unit."""
RACK_FIELDS = tuple(f.name for f in fields(IntakeAir) if f.name not in UNIT_FIELDS)
"""Fields of ``IntakeAir`` with an entry per rack."""


def read_intake_air(tables: HallTables, rack_out: Any, exhaust: Any, setpoint_c: F64) -> IntakeAir:
    """Air before the racks from the arrays of the kernels after a step.

    Args:
        tables: arrays of the kernels.
        rack_out: rows RACK_OUT by place.
        exhaust: what racks gave to the mixes in the last sweep, times their strength, by place.
        setpoint_c: supply setpoint of each CRAC unit, in C, (U,).
    """
    out = dict(zip(RACK_OUT, rack_out.reshape(len(RACK_OUT), -1), strict=True))
    rack, unit = tables.rows("rack_inputs"), tables.rows("unit_state")
    strength = rack["strength"]
    rows = {
        "mixed_c": tables.rows("rack_state")["mixed_c"],
        "exhaust_c": exhaust.reshape(-1) / np.where(strength > 0, strength, 1.0),
        "airflow_m3s": out["airflow_m3s"],
        "power_w": out["cpu_w"] + out["fan_w"],
        "outlet_c": out["outlet_c"],
        "fan_airflow": rack["fan_airflow"],
        "powered": rack["powered"],
    }
    racks = tables.places.values_of_racks(np.stack([*rows.values()]))
    return IntakeAir(
        **dict(zip(rows, racks.astype(np.float64), strict=True)),
        setpoint_c=np.array(setpoint_c),
        supply_c=unit["supply_c"].copy(),
        fresh_ratio=unit["fresh_ratio_used"].copy(),
        unit_m3s=unit["flow_m3s"].copy(),
        unit_weight=tables.plenum.weight.copy(),
    )


def intake_air_of(fleet: Fleet, air: IntakeAir, dc: int) -> IntakeAir:
    """The part of ``air`` that belongs to one data center of a fleet."""
    racks = slice(fleet.rack_offsets[dc], fleet.rack_offsets[dc + 1])
    units = slice(fleet.unit_offsets[dc], fleet.unit_offsets[dc + 1])
    parts = {name: getattr(air, name)[racks] for name in RACK_FIELDS}
    return IntakeAir(**parts, **{name: getattr(air, name)[units] for name in UNIT_FIELDS})


LISTED_SOURCES = 5
"""Racks whose exhaust is listed by name; that of the others is summed."""
HOTTEST_RACKS = 5
"""Racks whose inlets reports and recordings explain."""
LISTED_UNITS = 8
"""CRAC units that are described, those that give most."""
LEAST_K = 0.005
"""Least part of an inlet, of either sign, that is put into words, in K."""
LEAST_SHARE = 0.0005
"""Least share of a CRAC unit in the supply air of a rack that is put into words."""
_HEIGHT_ROW = list(GROUP_INPUTS).index("height_factor")
_OFFSET_ROW = list(GROUP_INPUTS).index("inlet_offset_k")


@dataclass(frozen=True, slots=True)
class InletParts:
    """The inlet of the hottest server of a rack, in a hall of R racks and U CRAC units, as a sum.

    ``inlet_c`` is the sum of ``setpoint_c``, ``warming_k``, ``approach_k``, ``exhaust_k`` over the
    racks and ``lag_k``. ``layout_k``, ``height_k`` and ``shortfall_k`` add up to the last two.
    """

    rack: int
    """The rack, counted from 0 in its hall."""
    server: int
    """The server, counted from 0 at the floor of its rack; the first of those that are alike."""
    servers: int
    """Servers of the rack."""
    inlet_c: float
    """Inlet temperature of the server, in C."""
    setpoint_c: float
    """Setpoint of the supply air that reaches the rack, mean over its units by what they give, in
    C; with control of the return air the coldest supply air that its setpoint admits."""
    controls_return: bool
    """Whether the CRAC units control the return air."""
    warming_k: float
    """Temperature of that supply air over its setpoint, in K: what the coils do not cool."""
    approach_k: float
    """Approach temperature of the rack and offset of the server as the config gives them, in K; 0
    where the air of the hall recirculates."""
    exhaust_k: F64
    """What the exhaust of each rack of the hall adds to the inlet, in K, (R,); 0 without
    recirculation."""
    lag_k: float
    """What the room air before the rack is warmer than the exhausts that flow into it, times the
    share that the server takes in, in K; round-off in quasi-steady halls."""
    exhaust_share: float
    """Share of the server's intake that is exhaust air, 0..1."""
    layout_k: float
    """What exhaust air adds where a server of the mean height gets the supply air it asks for, in
    K."""
    height_k: float
    """What the height of the server in its rack adds, in K; below 0 near the floor."""
    shortfall_k: float
    """What exhaust air adds in place of supply air that the CRAC units do not give, in K."""
    containment: float
    """Share of the paths between exhausts and inlets that containment closes, 0..1."""
    contained_k: float | None
    """What containment keeps from the inlet at the same exhaust temperatures, in K; None where it
    closes every path."""
    airflow_m3s: float
    """Airflow through the rack, in m3/s."""
    power_w: float
    """Power of the rack with its fans, in W."""
    outlet_c: float
    """Outlet of the rack, in C."""
    fan_airflow: float
    """Share of its airflow left to the fans of the rack, 0..1; below 1 where they fail."""
    powered: float
    """Share of the step that the rack is on, 0..1."""
    unit_share: F64
    """Share of each CRAC unit in the supply air that reaches the rack, 0..1, (U,)."""
    unit_supply_c: F64
    """Supply air of each CRAC unit, in C, (U,)."""
    unit_fresh_ratio: F64
    """Share of its racks' need for supply air that each CRAC unit covers, 0..1, (U,)."""
    unit_m3s: F64
    """Airflow of each CRAC unit, in m3/s, (U,)."""

    @property
    def supply_c(self) -> float:
        """Supply air that reaches the rack, in C."""
        return self.setpoint_c + self.warming_k

    @property
    def rise_k(self) -> float:
        """Inlet over the supply air that reaches the rack, in K."""
        return self.inlet_c - self.supply_c

    @property
    def own_exhaust_k(self) -> float:
        """What the rack's own exhaust adds to its inlet, in K."""
        return float(self.exhaust_k[self.rack])

    def sources(self, most: int = LISTED_SOURCES) -> list[tuple[int, float]]:
        """Other racks whose exhaust adds most to the inlet, and by how many K, the most first."""
        others_k = self.exhaust_k.copy()
        others_k[self.rack] = -np.inf
        order = np.argsort(-rank(others_k), kind="stable")[: min(most, len(others_k) - 1)]
        return [(int(i), float(others_k[i])) for i in order if others_k[i] > 0.0]


class Inlets:
    """The inlets of one data center of a fleet, from the air before its R racks.

    Args:
        fleet: the data centers.
        dc: index of the data center.
        air: air before its racks.
    """

    def __init__(self, fleet: Fleet, dc: int, air: IntakeAir) -> None:
        self._fleet, self._dc, self._air = fleet, dc, air
        self._first_rack = int(fleet.rack_offsets[dc])
        self._racks = int(fleet.rack_offsets[dc + 1]) - self._first_rack
        self._group_rows = fleet.group_rows[dc]
        offsets = fleet.group_offsets[self._first_rack : self._first_rack + self._racks + 1]
        self._group_offsets = offsets - offsets[0]
        if fleet.air is None:
            self._shares = np.ones((self._racks, 1))
            self._exhaust_share = np.zeros(self._racks)
        else:
            first, end = fleet.air.unit_share_offsets[dc : dc + 2]
            shares = fleet.air.unit_shares[first:end].reshape(self._racks, -1)
            self._shares = weighted_shares(shares, air.unit_weight)
            racks = slice(self._first_rack, self._first_rack + self._racks)
            self._exhaust_share = fleet.air.exhaust_share[racks]
        self._group_inlet_c = self._group_inlets()

    def hottest(self, most: int) -> list[int]:
        """The racks with the hottest inlets, hottest first."""
        hottest_c = np.maximum.reduceat(self._group_inlet_c, self._group_offsets[:-1])
        order = np.argsort(-rank(hottest_c), kind="stable")
        return [int(rack) for rack in order[:most]]

    def parts(self, rack: int) -> InletParts:
        """The inlet of the hottest server of a rack as a sum of parts."""
        air, fleet = self._air, self._fleet
        first, end = self._group_offsets[rack : rack + 2]
        group = int(first + np.argmax(rank(self._group_inlet_c[first:end])))
        group_0 = fleet.group_offsets[self._first_rack]
        ends = fleet.server_offsets[group_0 + np.array([first, group, end])]
        shares = self._shares[rack]
        covered = shares * air.fresh_ratio
        cover = float(covered.sum())
        # Where no unit gives anything, the supply air is what their shares would make it.
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
        """Parts with what exhaust air adds.

        Args:
            plain: parts without it.
            cover: share of the rack's need for supply air that the units cover.
            height: height factor of the server.
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
        return replace(
            plain,
            exhaust_k=exhaust_k,
            lag_k=exhaust_share * mix_k - float(exhaust_k.sum()),
            exhaust_share=exhaust_share,
            layout_k=share * mix_k,
            height_k=share * (height - 1.0) * mix_k,
            shortfall_k=fresh * (1.0 - cover) * mix_k,
            contained_k=contained_k if closed < 1.0 else None,
        )

    def _group_inlets(self) -> F64:
        """Inlet of every server group of the data center, in C, (G,)."""
        air, counts = self._air, np.diff(self._group_offsets)
        if self._fleet.air is None:
            first = self._first_rack
            rack_c = air.supply_c[0] + self._fleet.approach_k[first : first + self._racks]
            return np.asarray(np.repeat(rack_c, counts) + self._group_rows[_OFFSET_ROW])
        covered = self._shares * air.fresh_ratio
        fresh_k = covered @ air.supply_c - covered.sum(axis=1) * air.mixed_c
        taken = np.repeat(self._exhaust_share, counts) * self._group_rows[_HEIGHT_ROW]
        mixed_c, fresh_k = np.repeat(air.mixed_c, counts), np.repeat(fresh_k, counts)
        return np.asarray(mixed_c + (1.0 - taken) * fresh_k)


def inlet_terms(parts: InletParts, racks_per_row: int) -> list[tuple[str, float]]:
    """The sum that an inlet temperature is, in words: from C of the setpoint, each term in K.

    Parts that are 0 but for round-off are left out.

    Args:
        parts: the inlet.
        racks_per_row: racks in each row of the hall.
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
    """Why exhaust air reaches an inlet, in words, each term in K."""
    terms = [
        ("by the layout, at mean height", parts.layout_k),
        (f"by the height of server {parts.server} of {parts.servers}", parts.height_k),
        ("in place of air that the CRAC units do not give", parts.shortfall_k),
    ]
    return [(text, k) for text, k in terms if abs(k) >= LEAST_K]


def state_texts(parts: InletParts) -> list[str]:
    """Containment, CRAC units and fans of a rack, in words."""
    texts = []
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
    """A rack in words, with its row and its place in it."""
    row, place = divmod(rack, racks_per_row)
    return f"rack {rack} (row {row}, place {place})"


def inlet_values(parts: InletParts) -> dict[str, Any]:
    """An inlet as plain values for JSON; units are in the keys, lists are by rack or CRAC unit."""
    values = fields_of(parts) | {"supply_c": parts.supply_c, "rise_k": parts.rise_k}
    return {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in values.items()}
