"""``sdc-taichi hall``: describe a hall, and solve its air from the layout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.cli.hall_failover import failover_command
from sdc_taichi.cli.hall_why import why_command
from sdc_taichi.cli.options import (
    CommandApp,
    ConfigOptions,
    check_out_file,
    force_option,
    json_option,
    out_option,
)
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import printable
from sdc_taichi.layout_solver.grid import DEFAULT_CELL_M
from sdc_taichi.types import F64

if TYPE_CHECKING:
    from sdc_taichi.layout_solver.solve import LayoutSolution
    from sdc_taichi.sim.design_hall import DesignHall

hall_app = CommandApp(help="Describe a hall, solve its air.", no_args_is_help=True)
hall_app.command("why")(why_command)
hall_app.command("failover")(failover_command)


@hall_app.command("show")
def show_hall(
    *,
    config: ConfigOptions,
    out: Annotated[Path | None, out_option("Draw the floor plan.", "FILE.png")] = None,
    force: Annotated[bool, force_option()] = False,
    as_json: Annotated[bool, json_option("Print the description as JSON.")] = False,
) -> None:
    """Describe a hall: its measures, CRAC units, and racks at the design point."""
    from sdc_taichi.cli.hall_text import describe_hall
    from sdc_taichi.sim.design_hall import design_hall_values, solve_design_hall

    check_out_file(out, ".png", force=force)
    hall = solve_design_hall(config.read()[0])
    if out is not None:
        _write_floor_plan(out, hall)
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
    solution = solve_at_design_point(center, cell)
    if out is not None:
        _write_matrix(out, solution)
    if as_json:
        typer.echo(json.dumps(layout_solution_values(center, solution), indent=2))
        return
    _print_layout_solution(center, solution)
    if out is not None:
        typer.echo(f"Matrix: {printable(out)} (for hall.recirculation.matrix_file)")


def layout_solution_values(config: DataCenterConfig, solution: LayoutSolution) -> dict[str, Any]:
    """A solved hall as plain values for JSON.

    Units are in the keys; lists per rack are in the order of the racks, row by row.
    """
    inner, outer = _row_means(config, solution.approach_k)
    return {
        "cells": solution.cells,
        "seconds": round(solution.seconds, 3),
        "supply_c": solution.supply_c,
        "return_c": solution.return_c,
        "approach_mean_k": float(solution.approach_k.mean()),
        "approach_outer_rows_k": outer,
        "approach_inner_rows_k": inner,
        "approach_k": solution.approach_k.tolist(),
        "supply_approach_k": config.hall.rack_approach_k().tolist(),
        "recirculated_share": solution.R.sum(axis=1).tolist(),
        "shi": solution.shi,
        "rhi": solution.rhi,
        "rti_pct": solution.rti_pct,
        "rci_hi_pct": solution.rci_hi_pct,
        "rci_lo_pct": solution.rci_lo_pct,
        "mass_residual": solution.mass_residual,
        "share_residual": solution.share_residual,
        "energy_residual": solution.energy_residual,
        "direct_difference_k": solution.direct_difference_k,
        "provenance": solution.provenance,
    }


def _row_means(config: DataCenterConfig, values: F64) -> tuple[float | None, float]:
    """Means over the inner and over the two outer rows; None without inner rows."""
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


def _write_floor_plan(out: Path, hall: DesignHall) -> None:
    from sdc_taichi.viz.floor_plan_figure import floor_plan_figure
    from sdc_taichi.viz.plotting import save_picture

    save_picture(floor_plan_figure(hall), out, parents=True)


def _write_matrix(out: Path, solution: LayoutSolution) -> None:
    text = json.dumps(solution.provenance, sort_keys=True)
    with atomic_write(out, parents=True) as file:
        np.savez(file, R=solution.R, provenance=np.array(text))
