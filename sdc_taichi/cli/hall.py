"""``sdc-taichi hall``: describe a hall, solve its air, place racks, and let its cooling fail."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.cli.hall_why import why_command
from sdc_taichi.cli.options import (
    CommandApp,
    ConfigOptions,
    check_out_file,
    force_option,
    json_option,
    out_option,
)
from sdc_taichi.cli.terminal import (
    ProgressLines,
    count_text,
    duration,
    exit_on_interrupt,
    stage_bars,
    wide_console,
)
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import printable
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.layout_solver.grid import DEFAULT_CELL_M
from sdc_taichi.types import F64

if TYPE_CHECKING:
    from sdc_taichi.layout_solver.solve import LayoutSolution, SolverProgress
    from sdc_taichi.run.failover import Failover
    from sdc_taichi.run.rack_places import RackPlaces
    from sdc_taichi.sim.design_hall import DesignHall

LEAST_TOLD_S = 5.0
"""Shortest expected time of a solution, in s, that ``hall solve`` announces."""

hall_app = CommandApp(help="Describe a hall, solve its air, place racks.", no_args_is_help=True)
hall_app.command("why", may_allow_code=True)(why_command)


@hall_app.command("show")
def show_hall(
    *,
    config: ConfigOptions,
    out: Annotated[Path | None, out_option("Draw the floor plan.", "FILE.png")] = None,
    force: Annotated[bool, force_option()] = False,
    as_json: Annotated[bool, json_option("Print the description as JSON.")] = False,
) -> None:
    """Describe a hall: its measures, CRAC units, and racks at the design point."""
    from sdc_taichi.sim.design_hall import design_hall_values, solve_design_hall

    check_out_file(out, ".png", force=force)
    hall = solve_design_hall(config.read()[0])
    if out is not None:
        from sdc_taichi.viz.floor_plan_figure import floor_plan_figure
        from sdc_taichi.viz.plotting import save_picture

        save_picture(floor_plan_figure(hall), out, parents=True)
    if as_json:
        typer.echo(json.dumps(design_hall_values(hall), indent=2))
        return
    typer.echo(describe_hall(hall))
    if out is not None:
        typer.echo(f"Floor plan: {printable(out)}")


@hall_app.command("solve")
def solve_hall(
    *,
    config: ConfigOptions,
    cell: Annotated[
        float, typer.Option(metavar="M", help="Longest cell of the grid.")
    ] = DEFAULT_CELL_M,
    out: Annotated[
        Path | None,
        out_option("Write R and its provenance, for recirculation.matrix_file.", "FILE.npz"),
    ] = None,
    force: Annotated[bool, force_option()] = False,
    as_json: Annotated[bool, json_option("Print the report as JSON.")] = False,
) -> None:
    """Solve air and temperatures at the design point, and write the recirculation matrix R.

    Potential flow on a grid: racks, floor tiles, returns and containment of hall.layout, full load
    at hall.design_supply_c. docs/layout-solver.md says what potential flow cannot tell.
    """
    from sdc_taichi.layout_solver.solve import solve_at_design_point

    check_out_file(out, ".npz", force=force)
    center, _ = config.read()
    with _solver_progress() as progress:
        solution = solve_at_design_point(center, cell, progress)
    if out is not None:
        provenance = np.array(json.dumps(solution.provenance, sort_keys=True))
        with atomic_write(out, parents=True) as file:
            np.savez(file, R=solution.R, provenance=provenance)
    if as_json:
        typer.echo(json.dumps(layout_solution_values(center, solution), indent=2))
        return
    _print_layout_solution(center, solution)
    if out is not None:
        typer.echo(f"Matrix: {printable(out)} (for hall.recirculation.matrix_file)")


@contextlib.contextmanager
def _solver_progress() -> Iterator[SolverProgress]:
    """Print how long the layout solver will take, and show its progress on stderr."""
    lines, is_terminal = ProgressLines(), sys.stderr.isatty()
    start_s = time.monotonic()
    with stage_bars(shown=True) as bars:

        def show(done: int, total: int, expected_s: float) -> None:
            if done == 0 and expected_s >= LEAST_TOLD_S:
                text = f"about {duration(expected_s)} of computing for {total:,} tags"
                print(text, file=sys.stderr, flush=True)
            elif not is_terminal and done < total and expected_s >= LEAST_TOLD_S:
                passed = duration(time.monotonic() - start_s)
                lines.print(f"{done:,} of {total:,} tags after {passed}", always=False)
            bars("air flow", done, total)

        yield show


def layout_solution_values(config: DataCenterConfig, solution: LayoutSolution) -> dict[str, Any]:
    """Return the solution of a hall's airflow as plain values for JSON.

    Keys end with the unit. Lists have one value per rack, row by row.
    """
    inner, outer = _row_means(config, solution.approach_k)
    values = {each.name: getattr(solution, each.name) for each in fields(solution)}
    figures = {name: value for name, value in values.items() if isinstance(value, int | float)}
    return {
        **figures,
        "approach_mean_k": float(solution.approach_k.mean()),
        "approach_outer_rows_k": outer,
        "approach_inner_rows_k": inner,
        "approach_k": solution.approach_k.tolist(),
        "supply_approach_k": config.hall.rack_approach_k().tolist(),
        "recirculated_share": solution.R.sum(axis=1).tolist(),
        "provenance": solution.provenance,
    }


def _row_means(config: DataCenterConfig, values: F64) -> tuple[float | None, float]:
    """Return the mean of rack values over the inner rows (None without any), and the outer rows."""
    rows = values.reshape(config.hall.rows, -1)
    outer = np.concatenate([rows[:1], rows[1:][-1:]])
    inner = rows[1:-1]
    return (float(inner.mean()) if inner.size else None), float(outer.mean())


def _print_layout_solution(config: DataCenterConfig, solution: LayoutSolution) -> None:
    console = Console()
    grid = " x ".join(str(n) for n in solution.provenance["grid"])
    hall = config.hall
    typer.echo(
        f"{printable(config.name)}: {hall.rows} rows of {hall.racks_per_row} racks, grid {grid}, "
        f"{solution.cells:,} cells of air, {solution.seconds:.1f} s"
    )
    table = Table("inlet over supply, K")
    for name in ("mean", "outer rows", "inner rows", "lowest", "highest"):
        table.add_column(name, justify="right")
    for label, values in (
        ("solved", solution.approach_k),
        ("configured (supply_approach_k)", hall.rack_approach_k()),
    ):
        inner, outer = _row_means(config, values)
        cells = (float(values.mean()), outer, inner, float(values.min()), float(values.max()))
        table.add_row(label, *("" if x is None else f"{x:z.2f}" for x in cells))
    console.print(table)
    exhaust = 100 * solution.R.sum(axis=1)
    lines = (
        f"exhaust in the intake: {exhaust.min():.1f}..{exhaust.max():.1f} % per rack, mean "
        f"{exhaust.mean():.1f} %",
        f"supply {solution.supply_c:.2f} C, return {solution.return_c:.2f} C",
        f"SHI {solution.shi:.3f}, RHI {solution.rhi:.3f}, RTI {solution.rti_pct:.1f} %, "
        f"RCI hi {solution.rci_hi_pct:.1f} %, lo {solution.rci_lo_pct:.1f} %",
        f"residuals: mass {solution.mass_residual:.1e}, shares {solution.share_residual:.1e}, "
        f"energy {solution.energy_residual:.1e}; inlets through R and on the grid differ by at "
        f"most {solution.direct_difference_k:.1e} K",
    )
    typer.echo("\n".join(lines))


LISTED = 30
"""Largest number of losses in the table that ``hall failover`` prints."""


@hall_app.command("failover")
def failover_command(
    *,
    config: ConfigOptions,
    of: Annotated[
        Literal["units", "plant", "liquid"],
        typer.Option("--of", help="Lose CRAC units, devices of the plant, or liquid cooling."),
    ] = "units",
    out: Annotated[
        Path | None,
        out_option("Draw floor plan and curves, and write all losses beside it.", "FILE.png"),
    ] = None,
    force: Annotated[bool, force_option()] = False,
    as_json: Annotated[bool, json_option("Print all losses as JSON.")] = False,
) -> None:
    """Lose each CRAC unit and each pair of them at full load: time to throttle and to trip.

    An hour of transient temperatures in design weather. --of liquid loses CDUs, their pumps,
    facility pumps, the cooler, and the coolant of a rack. --out FILE.png also writes FILE.csv.
    """
    from sdc_taichi.run.failover import failover_rows, failover_values, study_failover

    check_out_file(out, ".png", force=force)
    table_path = None if out is None else out.with_suffix(".csv")
    check_out_file(table_path, ".csv", force=force)
    study = study_failover(config.read()[0], of)
    if out is not None and table_path is not None:
        import pandas as pd

        from sdc_taichi.viz.floor_plan_figure import failover_figure
        from sdc_taichi.viz.plotting import save_picture

        save_picture(failover_figure(study), out, parents=True)
        rows = pd.DataFrame(failover_rows(study, study.worst))
        with atomic_write(table_path, parents=True) as file:
            file.write(rows.to_csv(index=False, lineterminator="\r\n").encode())
    if as_json:
        typer.echo(json.dumps(failover_values(study), indent=2))
        return
    _print_study(study)
    if out is not None:
        typer.echo(f"Figure: {printable(out)}, all losses: {printable(str(table_path))}")


def _print_study(study: Failover) -> None:
    """Print the conditions of a failover study, and a table of the worst losses."""
    from sdc_taichi.run.failover import MINUTES, SHOWN_AFTER_MIN, failover_rows

    hall = study.config.hall
    typer.echo(
        f"{printable(study.config.name)}: {hall.racks:,} racks at full load, {study.it_kw:,.0f} kW "
        f"IT, supply {study.supply_c:g} C, outdoors {study.outdoor_c:.1f} C (wet bulb "
        f"{study.wet_bulb_c:.1f} C), class {study.config.protection.ashrae_class}"
    )
    is_liquid = study.lost == "liquid"
    has_tank = bool(np.isfinite(study.tank_full_min).any())
    unit = "s" if is_liquid else "min"
    names = (
        *(f"throttle, {unit}", f"trip, {unit}"),
        *(f"C, {m} min" for m in SHOWN_AFTER_MIN),
        *(("coolant, C",) if is_liquid else ()),
        *(("tank, min",) if has_tank else ()),
        "racks off",
    )
    table = Table()
    table.add_column("lost", no_wrap=True)
    for name in names:
        table.add_column(name, justify="right")
    order = [0, *(i for i in study.worst if i != 0)]
    for row in failover_rows(study, order[: LISTED + 1]):
        tank = row.pop("tank_full_min", None)
        name, throttle, trip, *hottest_c, water_c, off = row.values()
        times = ["-" if x is None else f"{x:.0f}" for x in (throttle, trip, tank)]
        temperatures_c = [*hottest_c, *([water_c] if is_liquid else [])]
        table.add_row(
            name,
            *times[:2],
            *(f"{x:.1f}" for x in temperatures_c),
            *times[2:][: int(has_tank)],
            f"{off}",
        )
    wide_console(100).print(table)
    if len(order) > LISTED + 1:
        typer.echo(f"The worst {LISTED} of {len(order) - 1} losses.")
    if study.note:
        typer.echo(study.note)
    if is_liquid:
        place = "junction" if study.of_junctions else "inlet"
        typer.echo(
            f"C is the hottest {place} of the hall; - is not within {MINUTES} min; coolant is "
            f"what the racks get after {SHOWN_AFTER_MIN[0]} min; racks off are those after "
            f"{MINUTES} min."
        )
        return
    typer.echo(
        "C is the hottest inlet of the hall; times count to the end of a whole minute, - is not "
        f"within {MINUTES} min; tank is the time until warm water fills the buffer tank; racks off "
        f"are those after {MINUTES} min."
    )


MOST_PLACES = 15
"""Largest number of candidates in the table that ``hall place`` prints."""


@hall_app.command("place")
def place_command(
    *,
    config: ConfigOptions,
    rack_type: Annotated[
        str, typer.Option("--type", metavar="TYPE", help="Type of the new racks, of rack_types.")
    ],
    count: Annotated[int, typer.Option(min=1, help="Number of new racks.")],
    replace: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TYPE",
            help="Type of racks to replace; repeatable. [default: racks of at most 0.2 kW]",
        ),
    ] = None,
    keep: Annotated[
        Literal["n", "n+1"],
        typer.Option("--keep", help="n+1: within limits also with any one CRAC unit down."),
    ] = "n",
    limit: Annotated[
        float | None,
        typer.Option(
            "--limit-c",
            metavar="C",
            min=10.0,
            max=60.0,
            help="Highest inlet. [default: allowable of the class]",
        ),
    ] = None,
    out: Annotated[
        Path | None, out_option("Draw the best candidate on the floor plan.", "FILE.png")
    ] = None,
    force: Annotated[bool, force_option()] = False,
    as_json: Annotated[bool, json_option("Print all candidates as JSON.")] = False,
) -> None:
    """Find where racks of a type fit: positions ranked by the hottest inlet at full load.

    CRAC units, plant and floor stay those of the hall as it is.
    """
    check_out_file(out, ".png", force=force)
    with exit_on_interrupt():
        from sdc_taichi.run.rack_places import place_values, study_places

        study = study_places(
            config.read()[0],
            rack_type,
            count,
            replaced=replace or (),
            keep=keep,
            inlet_limit_c=limit,
        )
    if out is not None:
        from sdc_taichi.viz.floor_plan_figure import places_figure
        from sdc_taichi.viz.plotting import save_picture

        save_picture(places_figure(study), out, parents=True)
    if as_json:
        typer.echo(json.dumps(place_values(study), indent=2))
        return
    _print_places(study)
    if out is not None:
        typer.echo(f"Floor plan: {printable(out)}")


def _print_places(study: RackPlaces) -> None:
    """Print the hall as it is, and a table of the best candidates."""
    typer.echo(
        f"{printable(study.config.name)} at full load: {study.base_it_kw:,.0f} kW IT, hottest "
        f"inlet {study.base_hottest_c:.1f} C, limit {study.inlet_limit_c:g} C"
    )
    fitting = sum(not each.exceeded for each in study.candidates)
    typer.echo(
        f"{study.count} x {printable(study.type)} instead of "
        f"{printable(', '.join(study.replaced))}: {fitting} of "
        f"{count_text(len(study.candidates), 'candidate')} fit"
    )
    has_lost = study.candidates[0].lost_unit_c is not None
    table = Table()
    table.add_column("places")
    names = ["hottest, C", "new racks, C", "IT, kW", "CRAC air, %"]
    for name in [*names, *["unit down, C"] * has_lost]:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("exceeds")
    for each in study.candidates[:MOST_PLACES]:
        lost = [] if each.lost_unit_c is None else [f"{each.lost_unit_c:.1f}"]
        lost = lost if each.has_steady_air else ["-"]
        table.add_row(
            each.places,
            f"{each.hottest_c:.1f}",
            f"{each.hottest_new_c:.1f}",
            f"{each.it_kw:,.0f}",
            f"{100 * each.airflow_share:.0f}",
            *lost,
            ", ".join(each.exceeded) or "-",
        )
    wide_console(160).print(table)
    if len(study.candidates) > MOST_PLACES:
        typer.echo(f"The best {MOST_PLACES} of {len(study.candidates)} candidates.")
    if study.note:
        typer.echo(study.note)


LISTED_ROWS = 12
"""Largest number of rows that ``describe_hall`` lists; larger halls list only the hottest rows."""
LISTED_UNITS = 8
"""Largest number of CRAC units for which ``describe_hall`` has a line each."""


def describe_hall(design: DesignHall) -> str:
    """Return a text about room, CRAC units, air and rows of a hall at its design point."""
    return "\n".join(
        [
            *_room_lines(design),
            *_unit_lines(design),
            *_air_lines(design),
            *_liquid_lines(design),
            *_rows(design),
        ]
    )


def _room_lines(design: DesignHall) -> list[str]:
    hall, plan = design.config.hall, design.plan
    size = hall.layout
    grilles = "in the end walls" if size.returns == "end_wall" else "above the hot aisles"
    cold, hot = hall.rows // 2, (hall.rows - 1) // 2
    return [
        f"{printable(design.config.name)}: {count_text(hall.rows, 'row')} of "
        f"{count_text(hall.racks_per_row, 'rack')}, {design.servers:,} servers, "
        f"inlet model {hall.inlet_model}",
        f"room          {plan.length_m:.4g} x {plan.width_m:.4g} x {size.ceiling_m:.4g} m, "
        f"{plan.air_m3:,.4g} m3 of air",
        f"racks         {size.rack_pitch_m:g} m wide, {size.rack_depth_m:g} m deep, "
        f"{size.rack_height_m:g} m high",
        *_type_lines(design),
        f"aisles        {cold} cold of {size.cold_aisle_m:g} m and {hot} hot of "
        f"{size.hot_aisle_m:g} m between rows; {size.side_margin_m:g} m beside the outer rows, "
        f"{size.end_margin_m:g} m at the row ends",
        f"containment   {100 * size.containment:g} %; returns {grilles}",
    ]


def _type_lines(design: DesignHall) -> list[str]:
    """Return a line for each rack type: number of racks, and power and airflow of one rack."""
    hall = design.config.hall
    named = np.array(hall.rack_type_names())
    rise_k = design.outlet_c - design.inlet_c
    lines = []
    for name in hall.rack_types:
        of_type = named == name
        if not of_type.any():
            lines.append(f"  type {printable(name)}: no racks")
            continue
        if (rack := hall.rack_types[name].liquid_rack) is not None:
            lines.append(
                f"  type {printable(name)}: {count_text(int(of_type.sum()), 'rack')} of "
                f"{rack.design_it_w / 1e3:,.1f} kW: {rack.design_liquid_w / 1e3:,.1f} kW into "
                f"{rack.design_lpm:,.0f} l/min of coolant, {rack.air_w(1.0) / 1e3:,.1f} kW into "
                f"{_span(design.airflow_m3s[of_type], 3)} m3/s of air"
            )
            continue
        groups = design.config.rack_groups()[int(np.argmax(of_type))]
        servers = " + ".join(f"{g.count:,} x {g.full_w:,.6g} W" for g in groups)
        lines.append(
            f"  type {printable(name)}: {count_text(int(of_type.sum()), 'rack')} of {servers}, "
            f"{_span(design.it_w[of_type] / 1e3, 1)} kW, "
            f"{_span(design.airflow_m3s[of_type], 3)} m3/s, "
            f"{_span(rise_k[of_type], 1)} K of rise"
        )
    return lines


def _unit_lines(design: DesignHall) -> list[str]:
    flow = design.unit_m3s
    count = len(flow)
    head = f"CRAC units    {count}, {flow.sum():,.4g} m3/s at full speed"
    if count > LISTED_UNITS:
        return [f"{head}, {flow.min():.4g}..{flow.max():.4g} each, along both end walls"]
    return [
        head,
        *(
            f"  unit {i}      at x {x:.4g}, y {y:.4g} m: {flow[i]:.4g} m3/s"
            for i, (x, y) in enumerate(design.unit_places_m)
        ),
    ]


def _air_lines(design: DesignHall) -> list[str]:
    inlet, air = design.inlet_c, design.air
    row, place = divmod(design.hottest_rack, design.config.hall.racks_per_row)
    lines = [
        f"design point  full load, supply air {design.supply_c:g} C",
        f"IT power      {design.it_w.sum() / 1e3:,.1f} kW, per rack "
        f"{_span(design.it_w / 1e3, 1)} kW",
        f"airflow       {design.airflow_m3s.sum():,.4g} m3/s through the servers, per rack "
        f"{_span(design.airflow_m3s, 3)} m3/s",
        f"rack inlets   {inlet.min():.2f}..{inlet.max():.2f} C, mean {inlet.mean():.2f} C; "
        f"over supply {_span(design.approach_k, 2)} K",
        f"hottest       {design.inlet_max_c.max():.2f} C: server {design.hottest_server} of rack "
        f"{design.hottest_rack} (row {row}, place {place}, servers counted from the floor)",
    ]
    if air is None:
        return lines
    lines.append(f"approaches    {design.config.hall.recirculation.approach_text}")
    low, high = air.spectral_radius_bounds
    known = "at most " if high - low > 1e-6 else ""
    share = air.exhaust_share
    return [
        *lines,
        f"exhaust share {100 * share.mean():.2f} % of the racks' intake (r), per rack "
        f"{_span(100 * share, 2)} %; spectral radius of R {known}{high:.4f}",
        f"bypass        {100 * air.bypass_share:.2f} % of the CRAC air",
        f"return air    {air.return_c:.2f} C, {air.return_c - design.outlet_c.mean():+z.2f} K from "
        "the mean outlet",
        f"indices       SHI {air.shi:.3f}, RHI {1 - air.shi:.3f}, RTI {air.rti_pct:.1f} %",
    ]


def _liquid_lines(design: DesignHall) -> list[str]:
    """Return the lines about liquid-cooled racks at full load in design weather."""
    from sdc_taichi.sim.design_liquid import design_liquid_values

    if design.liquid is None:
        return []
    v, config = design_liquid_values(design.liquid), design.liquid.config

    def class_text(name: str | None) -> str:
        return f"class {name}" if name else "colder than any class"

    per_loop = count_text(v["cdus_per_manifold"], "CDU")
    needed = v["cdus_per_manifold"] - v["spare_cdus_per_manifold"]
    redundancy = f"N+{v['spare_cdus_per_manifold']}" if v["spare_cdus_per_manifold"] else "N"
    trimmed = ""
    if v["trim_load_w"] > 0.0:
        trimmed = (
            f"; trim chiller takes {v['trim_load_w'] / 1e3:,.1f} kW with "
            f"{v['trim_chiller_w'] / 1e3:,.1f} kW"
        )
    elif v["liquid_to_plant_w"] > 0.0:
        trimmed = f"; plant of the CRAC units takes {v['liquid_to_plant_w'] / 1e3:,.1f} kW"
    lines = [
        f"liquid        {count_text(v['racks'], 'rack')}, {v['liquid_it_w'] / 1e3:,.1f} kW IT: "
        f"{v['liquid_heat_w'] / 1e3:,.1f} kW into coolant, {v['liquid_air_w'] / 1e3:,.1f} kW into "
        "the air of the hall",
        f"coolant       {1e3 * v['coolant_m3s']:,.4g} l/s, {v['cdu_supply_c']:.1f} C to "
        f"{v['cdu_return_c']:.1f} C"
        + (f"; hottest junction {v['junction_max_c']:.1f} C" if v["junction_max_c"] else ""),
        f"CDUs          {count_text(v['manifolds'], 'loop')} with {per_loop} of "
        f"{v['cdu_w'] / 1e3:,.0f} kW each, {needed} of them needed ({redundancy}); pumps "
        f"{v['cdu_pump_w'] / 1e3:,.1f} kW",
        f"facility      {v['facility_supply_c']:.1f} C to {v['facility_return_c']:.1f} C outdoors "
        f"at {v['outdoor_c']:.1f} C, wet bulb {v['wet_bulb_c']:.1f} C; {config.facility.rejection} "
        f"cooler, fans {v['cooler_fan_w'] / 1e3:,.1f} kW, pumps "
        f"{v['facility_pump_w'] / 1e3:,.1f} kW" + trimmed,
        f"water         at most {v['facility_setpoint_c']:.1f} C keeps the setpoint "
        f"({class_text(v['facility_class'])})",
    ]
    if v["warmest_water_c"] is not None:
        lines[-1] += (
            f"; GPUs throttle above {v['warmest_water_c']:.1f} C "
            f"({class_text(v['warmest_water_class'])})"
        )
    return lines


def _rows(design: DesignHall) -> list[str]:
    hall = design.config.hall

    def per_row(values: F64) -> F64:
        return values.reshape(hall.rows, hall.racks_per_row)

    hottest = per_row(design.inlet_max_c).max(axis=1)
    listed = np.arange(hall.rows)
    note = []
    if hall.rows > LISTED_ROWS:
        order = np.argsort(-rank(hottest), kind="stable")
        listed = np.sort(order[:LISTED_ROWS])
        note = [f"({LISTED_ROWS} hottest of {hall.rows:,} rows)"]
    approach, inlet = per_row(design.approach_k), per_row(design.inlet_c)
    power, airflow = per_row(design.it_w) / 1e3, per_row(design.airflow_m3s)
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
