"""What a hall looks like and how warm it is at its design point: for ``sdc-taichi hall show``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall import air_metrics
from sdc_taichi.hall.floor_plan import Plan, floor_plan, unit_places_m
from sdc_taichi.hall.recirculation import Exchange
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Conditions, Hall, HallSums
from sdc_taichi.types import F64
from sdc_taichi.whole_file import check_new_file, whole_file

LISTED_ROWS = 12
"""Halls up to this many rows list all of them, larger ones the hottest."""
LISTED_UNITS = 8
EXACT_RADIUS_RACKS = 2000
"""Up to this size the spectral radius is computed, beyond it is bounded by the row sums."""
_RADIUS_TOLERANCE = 1e-9
_MOST_ITERATIONS = 1000
_TIE_DIGITS = 6
_NO_APPROACH_K = 1e-9


@dataclass(frozen=True, slots=True)
class AirFlows:
    """How air recirculates in a hall of R racks at its design point."""

    exhaust_share: F64
    """Share of each rack's intake that is exhaust of the racks, r, (R,)."""
    bypass_share: float
    """Share of the CRAC air that no rack takes in."""
    return_c: float
    shi: float
    rti_pct: float
    radius: tuple[float, float]
    """Between these lies the spectral radius of the matrix R."""


@dataclass(frozen=True, slots=True)
class DesignHall:
    """A hall of R racks and U CRAC units at full load and the highest setpoint."""

    config: DataCenterConfig
    plan: Plan
    servers: int
    supply_c: float
    it_w: F64
    """(R,), as the next five."""
    airflow_m3s: F64
    approach_k: F64
    """Airflow-weighted mean inlet over supply."""
    inlet_c: F64
    inlet_max_c: F64
    """Of the hottest server."""
    outlet_c: F64
    unit_m3s: F64
    """(U,)."""
    unit_places_m: F64
    """(U, 2)."""
    hottest_rack: int
    hottest_server: int
    """Counted from the floor of its rack."""
    air: AirFlows | None
    """None with inlet model ``approach``, whose inlets follow from no flows."""


def at_design(config: DataCenterConfig) -> DesignHall:
    """A hall at its design point, from the kernels that the simulator runs, in f64.

    Raises:
        SdcError: a hall that cannot be laid out or has no steady state.
    """
    fleet = build_fleet(config)
    supply_c = config.hvac.setpoint.max_c
    hall = Hall(fleet, "f64")
    sums = hall.solve(Conditions(np.full(fleet.units, supply_c), np.ones(1)))
    plan = floor_plan(config.hall)
    inlet_c = np.asarray(sums.rack_inlet_c, dtype=np.float64)
    approach_k = inlet_c - supply_c
    # What rounding leaves, of either sign, is none.
    approach_k[np.abs(approach_k) < _NO_APPROACH_K] = 0.0
    # Racks that are alike differ in the last bits; the first of them is named.
    group = int(np.argmax(np.round(hall.group_inlets(), _TIE_DIGITS)))
    rack = int(np.searchsorted(fleet.group_offsets, group, side="right")) - 1
    first_server = fleet.server_offsets[fleet.group_offsets[rack]]
    return DesignHall(
        config=config,
        plan=plan,
        servers=fleet.servers,
        supply_c=supply_c,
        it_w=np.asarray(sums.rack_cpu_w + sums.rack_fan_w, dtype=np.float64),
        airflow_m3s=np.asarray(sums.rack_airflow_m3s, dtype=np.float64),
        approach_k=approach_k,
        inlet_c=inlet_c,
        inlet_max_c=np.asarray(sums.rack_inlet_max_c, dtype=np.float64),
        outlet_c=np.asarray(sums.rack_outlet_c, dtype=np.float64),
        unit_m3s=fleet.unit_design_m3s,
        unit_places_m=unit_places_m(plan, fleet.units),
        hottest_rack=rack,
        hottest_server=int(fleet.server_offsets[group] - first_server),
        air=_air_flows(fleet, sums, approach_k, supply_c),
    )


def _air_flows(fleet: Fleet, sums: HallSums, approach_k: F64, supply_c: float) -> AirFlows | None:
    air = fleet.air
    if air is None:
        return None
    exchange = Exchange(
        air.run_start, air.run_first, air.run_length, air.run_offset, air.weights, air.strength,
        air.norm,
    )  # fmt: skip
    airflow_m3s = np.asarray(sums.rack_airflow_m3s, dtype=np.float64)
    # A rack's inlet lies between supply air and the mix before it, by the share it takes of each.
    mix_over_supply_k = exchange.apply(np.asarray(sums.rack_outlet_c - supply_c, dtype=np.float64))
    share = np.maximum(approach_k / mix_over_supply_k, 0.0)
    flow_m3s = float(sums.crac_flow_m3s[0])
    return_c = float(sums.return_c[0])
    inlet_rise, outlet_rise = sums.inlet_m3k_s, sums.outlet_m3k_s
    rise_k = air_metrics.it_rise_k(inlet_rise, outlet_rise, sums.it_airflow_m3s)
    return AirFlows(
        exhaust_share=share,
        bypass_share=max(1.0 - float(np.sum((1.0 - share) * airflow_m3s)) / flow_m3s, 0.0),
        return_c=return_c,
        shi=float(air_metrics.shi(inlet_rise, outlet_rise)[0]),
        rti_pct=float(air_metrics.rti(return_c, supply_c, rise_k)[0]),
        radius=_spectral_radius(exchange, share),
    )


def _spectral_radius(exchange: Exchange, share: F64) -> tuple[float, float]:
    """Bounds of the spectral radius of R = diag(share) w, which is not negative.

    For any positive x it lies between the least and the largest (R x)_j / x_j (Collatz 1942,
    Wielandt 1950); with x = 1 these are the row sums, and the power method brings them together.
    """
    x, low, high = np.ones(len(share)), float(share.min()), float(share.max())
    if len(share) > EXACT_RADIUS_RACKS or low <= 0.0:
        return low, high
    for _ in range(_MOST_ITERATIONS):
        after = share * exchange.apply(x)
        ratio = after / x
        low, high = float(ratio.min()), float(ratio.max())
        x = after / after.max()
        if high - low < _RADIUS_TOLERANCE:
            break
    return low, high


def show(
    config: DataCenterConfig,
    out: Path | None = None,
    *,
    force: bool = False,
    as_json: bool = False,
) -> str:
    """Text for the terminal, and the floor plan as a file.

    Args:
        config: the data center.
        out: PNG to write; None writes none.
        force: replace an existing file.
        as_json: give the text as JSON, see ``report``.

    Raises:
        SdcError: a hall that cannot be solved, a file that exists or cannot be written, or
            matplotlib is missing.
    """
    if out is not None:
        check_new_file(out, ".png", force=force)
    found = at_design(config)
    if out is not None:
        _write_png(out, found)
    if as_json:
        return json.dumps(report(found), indent=2)
    drawn = [] if out is None else [f"Floor plan: {out}"]
    return "\n".join([describe(found), *drawn])


def report(found: DesignHall) -> dict[str, Any]:
    """Plain values; entries per rack in the order of the racks, row by row."""
    hall, air = found.config.hall, found.air
    flows: dict[str, Any] = {}
    if air is not None:
        flows = {
            "return_c": air.return_c,
            "return_approach_mean_k": air.return_c - float(found.outlet_c.mean()),
            "bypass_share": air.bypass_share,
            "shi": air.shi,
            "rhi": 1.0 - air.shi,
            "rti_pct": air.rti_pct,
            "spectral_radius": list(air.radius),
            "exhaust_share": air.exhaust_share.tolist(),
        }
    return {
        "name": found.config.name,
        "inlet_model": hall.inlet_model,
        "rows": hall.rows,
        "racks_per_row": hall.racks_per_row,
        "servers": found.servers,
        "length_m": found.plan.length_m,
        "width_m": found.plan.width_m,
        "air_m3": found.plan.air_m3,
        "layout": hall.layout.model_dump(mode="json"),
        "crac_units": [
            {"x_m": float(x), "y_m": float(y), "airflow_m3s": float(flow)}
            for (x, y), flow in zip(found.unit_places_m, found.unit_m3s, strict=True)
        ],
        "supply_c": found.supply_c,
        "it_w": float(found.it_w.sum()),
        "crac_flow_m3s": float(found.unit_m3s.sum()),
        "hottest_rack": found.hottest_rack,
        "hottest_server": found.hottest_server,
        "hottest_inlet_c": float(found.inlet_max_c.max()),
        **flows,
        "rack_it_w": found.it_w.tolist(),
        "rack_airflow_m3s": found.airflow_m3s.tolist(),
        "approach_k": found.approach_k.tolist(),
        "inlet_c": found.inlet_c.tolist(),
        "inlet_max_c": found.inlet_max_c.tolist(),
        "outlet_c": found.outlet_c.tolist(),
    }


def describe(found: DesignHall) -> str:
    """Room, units, air and rows of a hall, as lines of text."""
    return "\n".join([*_room_lines(found), *_unit_lines(found), *_air_lines(found), *_rows(found)])


def _room_lines(found: DesignHall) -> list[str]:
    hall, plan = found.config.hall, found.plan
    size = hall.layout
    grilles = "in the end walls" if size.returns == "end_wall" else "above the hot aisles"
    cold, hot = hall.rows // 2, (hall.rows - 1) // 2
    return [
        f"{found.config.name}: {_count(hall.rows, 'row')} of {_count(hall.racks_per_row, 'rack')}, "
        f"{found.servers:,} servers, inlet model {hall.inlet_model}",
        f"room          {plan.length_m:.4g} x {plan.width_m:.4g} x {size.ceiling_m:.4g} m, "
        f"{plan.air_m3:,.4g} m3 of air",
        f"racks         {size.rack_pitch_m:g} m wide, {size.rack_depth_m:g} m deep, "
        f"{size.rack_height_m:g} m high",
        f"aisles        {cold} cold of {size.cold_aisle_m:g} m and {hot} hot of "
        f"{size.hot_aisle_m:g} m between rows; {size.side_margin_m:g} m beside the outer rows, "
        f"{size.end_margin_m:g} m at the row ends",
        f"containment   {100 * size.containment:g} %; returns {grilles}",
    ]


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
    low, high = air.radius
    known = "at most " if high - low > 1e-6 else ""
    share = air.exhaust_share
    return [
        *lines,
        f"exhaust share {100 * share.mean():.2f} % of the racks' intake (r), per rack "
        f"{_span(100 * share, 2)} %; spectral radius of R {known}{high:.4f}",
        f"bypass        {100 * air.bypass_share:.2f} % of the CRAC air",
        f"return air    {air.return_c:.2f} C, {air.return_c - found.outlet_c.mean():+.2f} K from "
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
        order = np.argsort(-np.round(hottest, _TIE_DIGITS), kind="stable")
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


def _write_png(out: Path, found: DesignHall) -> None:
    """Write the file so that a reader sees the old one or the whole new one."""
    from sdc_taichi.viz.floor_plan import draw

    figure = draw(found)
    with whole_file(out, parents=True) as file:
        figure.savefig(file, format="png")
