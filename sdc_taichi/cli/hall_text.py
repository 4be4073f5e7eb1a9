"""The text of ``sdc-taichi hall show``."""

from __future__ import annotations

import numpy as np

from sdc_taichi.errors import printable
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.sim.design_hall import DesignHall
from sdc_taichi.types import F64

LISTED_ROWS = 12
"""Number of rows up to which all are listed; of larger halls the hottest rows are."""
LISTED_UNITS = 8
"""Number of CRAC units up to which each has a line of its own."""


def describe_hall(found: DesignHall) -> str:
    """Room, CRAC units, air and rows of a hall at its design point, as lines of text."""
    return "\n".join([*_room_lines(found), *_unit_lines(found), *_air_lines(found), *_rows(found)])


def _room_lines(found: DesignHall) -> list[str]:
    hall, plan = found.config.hall, found.plan
    size = hall.layout
    grilles = "in the end walls" if size.returns == "end_wall" else "above the hot aisles"
    cold, hot = hall.rows // 2, (hall.rows - 1) // 2
    return [
        f"{printable(found.config.name)}: {_count(hall.rows, 'row')} of "
        f"{_count(hall.racks_per_row, 'rack')}, {found.servers:,} servers, "
        f"inlet model {hall.inlet_model}",
        f"room          {plan.length_m:.4g} x {plan.width_m:.4g} x {size.ceiling_m:.4g} m, "
        f"{plan.air_m3:,.4g} m3 of air",
        f"racks         {size.rack_pitch_m:g} m wide, {size.rack_depth_m:g} m deep, "
        f"{size.rack_height_m:g} m high",
        *_type_lines(found),
        f"aisles        {cold} cold of {size.cold_aisle_m:g} m and {hot} hot of "
        f"{size.hot_aisle_m:g} m between rows; {size.side_margin_m:g} m beside the outer rows, "
        f"{size.end_margin_m:g} m at the row ends",
        f"containment   {100 * size.containment:g} %; returns {grilles}",
    ]


def _type_lines(found: DesignHall) -> list[str]:
    """A line for each type of racks: how many, and what one of them draws at the design point."""
    hall = found.config.hall
    named = np.array(hall.rack_type_names())
    rise_k = found.outlet_c - found.inlet_c
    lines = []
    for name in hall.rack_types:
        of_type = named == name
        if not of_type.any():
            lines.append(f"  type {printable(name)}: no racks")
            continue
        groups = found.config.rack_groups()[int(np.argmax(of_type))]
        servers = " + ".join(f"{g.count:,} x {g.full_w:,.6g} W" for g in groups)
        lines.append(
            f"  type {printable(name)}: {_count(int(of_type.sum()), 'rack')} of {servers}, "
            f"{_span(found.it_w[of_type] / 1e3, 1)} kW, "
            f"{_span(found.airflow_m3s[of_type], 3)} m3/s, "
            f"{_span(rise_k[of_type], 1)} K of rise"
        )
    return lines


def _unit_lines(found: DesignHall) -> list[str]:
    flow = found.unit_m3s
    count = len(flow)
    head = f"CRAC units    {count}, {flow.sum():,.4g} m3/s at full speed"
    if count > LISTED_UNITS:
        return [f"{head}, {flow.min():.4g}..{flow.max():.4g} each, along both end walls"]
    return [
        head,
        *(
            f"  unit {i}      at x {x:.4g}, y {y:.4g} m: {flow[i]:.4g} m3/s"
            for i, (x, y) in enumerate(found.unit_places_m)
        ),
    ]


def _air_lines(found: DesignHall) -> list[str]:
    inlet, air = found.inlet_c, found.air
    row, place = divmod(found.hottest_rack, found.config.hall.racks_per_row)
    lines = [
        f"design point  full load, supply air {found.supply_c:g} C",
        f"IT power      {found.it_w.sum() / 1e3:,.1f} kW, per rack {_span(found.it_w / 1e3, 1)} kW",
        f"airflow       {found.airflow_m3s.sum():,.4g} m3/s through the servers, per rack "
        f"{_span(found.airflow_m3s, 3)} m3/s",
        f"rack inlets   {inlet.min():.2f}..{inlet.max():.2f} C, mean {inlet.mean():.2f} C; "
        f"over supply {_span(found.approach_k, 2)} K",
        f"hottest       {found.inlet_max_c.max():.2f} C: server {found.hottest_server} of rack "
        f"{found.hottest_rack} (row {row}, place {place}, servers counted from the floor)",
    ]
    if air is None:
        return lines
    low, high = air.spectral_radius_bounds
    known = "at most " if high - low > 1e-6 else ""
    share = air.exhaust_share
    return [
        *lines,
        f"exhaust share {100 * share.mean():.2f} % of the racks' intake (r), per rack "
        f"{_span(100 * share, 2)} %; spectral radius of R {known}{high:.4f}",
        f"bypass        {100 * air.bypass_share:.2f} % of the CRAC air",
        f"return air    {air.return_c:.2f} C, {air.return_c - found.outlet_c.mean():+z.2f} K from "
        "the mean outlet",
        f"indices       SHI {air.shi:.3f}, RHI {1 - air.shi:.3f}, RTI {air.rti_pct:.1f} %",
    ]


def _rows(found: DesignHall) -> list[str]:
    hall = found.config.hall

    def per_row(values: F64) -> F64:
        return values.reshape(hall.rows, hall.racks_per_row)

    hottest = per_row(found.inlet_max_c).max(axis=1)
    listed = np.arange(hall.rows)
    note = []
    if hall.rows > LISTED_ROWS:
        order = np.argsort(-rank(hottest), kind="stable")
        listed = np.sort(order[:LISTED_ROWS])
        note = [f"({LISTED_ROWS} hottest of {hall.rows:,} rows)"]
    approach, inlet = per_row(found.approach_k), per_row(found.inlet_c)
    power, airflow = per_row(found.it_w) / 1e3, per_row(found.airflow_m3s)
    lines = [
        "",
        f"{'row':>5} {'faces':>6} {'IT':>9} {'airflow':>9} {'approach':>9} "
        f"{'rack inlets (C)':>23} {'hottest':>8}",
        f"{'':>5} {'':>6} {'kW':>9} {'m3/s/rack':>9} {'K':>9} "
        f"{'min':>7} {'mean':>7} {'max':>7} {'server':>8}",
    ]
    for i in listed:
        faces = "+y" if i % 2 == 0 else "-y"
        lines.append(
            f"{i:>5} {faces:>6} {power[i].sum():>9,.1f} {airflow[i].mean():>9.3f} "
            f"{approach[i].mean():>9.2f} {inlet[i].min():>7.2f} {inlet[i].mean():>7.2f} "
            f"{inlet[i].max():>7.2f} {hottest[i]:>8.2f}"
        )
    return lines + note


def _span(values: F64, digits: int) -> str:
    low, high = f"{values.min():.{digits}f}", f"{values.max():.{digits}f}"
    return low if low == high else f"{low}..{high}"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}" + ("s" if number != 1 else "")
