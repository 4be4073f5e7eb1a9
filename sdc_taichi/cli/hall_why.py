"""``sdc-taichi hall why``: explain inlet or junction of a rack as a sum of its causes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import typer

from sdc_taichi.cli.options import (
    Overrides,
    check_out_file,
    force_option,
    json_option,
    out_option,
    read_config,
)
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, SdcError, printable
from sdc_taichi.hall.rack_selection import parse_rack
from sdc_taichi.sim.inlet_parts import (
    InletParts,
    Inlets,
    exhaust_terms,
    inlet_terms,
    inlet_values,
    rack_text,
    state_texts,
)
from sdc_taichi.types import fields_of

if TYPE_CHECKING:
    from sdc_taichi.run.folder_reader import RunFolder
    from sdc_taichi.sim.junction_parts import JunctionParts


def why_command(
    source: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PRESET|FILE|DIR] [A.B=C]...",
            help="Preset, YAML file or SustainDC dc_config.json, and overrides of its fields; or "
            "the folder of a run.",
            show_default=False,
        ),
    ] = None,
    rack: Annotated[
        str | None,
        typer.Option(
            metavar="RACK|ROW:PLACE", help="The rack, counted from 0. [default: the hottest]"
        ),
    ] = None,
    dc: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Data center of a run. [default: the hottest]"),
    ] = None,
    step: Annotated[
        int | None,
        typer.Option(min=0, help="Step of a run, which is simulated again. [default: the hottest]"),
    ] = None,
    of: Annotated[
        Literal["inlet", "junction"],
        typer.Option("--of", help="Explain the inlet, or the junction of a rack with cold plates."),
    ] = "inlet",
    out: Annotated[
        Path | None,
        out_option("Draw what each rack adds to the inlet on the floor plan.", "FILE.png"),
    ] = None,
    overrides: Overrides = None,
    force: Annotated[bool, force_option()] = False,
    as_json: Annotated[bool, json_option("Print all parts as JSON.")] = False,
) -> None:
    """Say why an inlet or a junction is as warm as it is: a sum of parts without a remainder.

    At the design point of a config, at full load; or in the hottest step of a run, whose folder
    holds the air of that step. Any other step is simulated again from the start of the run, as is
    the step of a junction.
    """
    check_out_file(out, ".png", force=force)
    run_folder = _run_folder(source)
    if of == "junction":
        if out is not None:
            raise ConfigError("--out: given with --of junction; valid with --of inlet")
        if run_folder is None:
            junction = _junction_at_design_point(source, overrides, dc, step, rack)
        else:
            junction = _junction_in_run(run_folder, overrides, dc, step, rack)
        _print_junction(junction, as_json=as_json)
        return
    if run_folder is None:
        name, config, at, inlets = _at_design_point(source, overrides, dc, step)
    else:
        name, config, at, inlets = _in_run(run_folder, overrides, dc, step)
    index = inlets.hottest(1)[0] if rack is None else parse_rack(rack, config.hall)
    parts = inlets.parts(index)
    if out is not None:
        _draw(out, config, parts)
    if as_json:
        typer.echo(json.dumps({"name": name, "at": at, **inlet_values(parts)}, indent=2))
        return
    typer.echo(f"{printable(name)}, {at}")
    typer.echo(describe_inlet(parts, config.hall.racks_per_row))
    if out is not None:
        typer.echo(f"Floor plan: {printable(out)}")


_ExplainedJunction = tuple[str, DataCenterConfig, str, "JunctionParts"]
"""Name of a data center, its config, the moment of its junctions as text, and a junction."""


def _junction_at_design_point(
    source: list[str] | None,
    overrides: list[str] | None,
    dc: str | None,
    step: int | None,
    rack: str | None,
) -> _ExplainedJunction:
    """Compute a junction at the design point of a config; without a rack, the hottest one."""
    from sdc_taichi.sim.design_liquid import solve_design_liquid

    _check_no_run_options(dc, step)
    config, _ = read_config(source, overrides)
    index = None if rack is None else parse_rack(rack, config.hall)
    return config.name, config, "at its design point", solve_design_liquid(config).parts(index)


def _junction_in_run(
    folder: Path,
    overrides: list[str] | None,
    dc: str | None,
    step: int | None,
    rack: str | None,
) -> _ExplainedJunction:
    """Simulate a junction of a run again; without step and rack, the hottest one."""
    from sdc_taichi.run.folder_reader import read_configs, read_steps
    from sdc_taichi.run.inlets_of_run import junction_at_step
    from sdc_taichi.sim.junction_parts import NO_JUNCTIONS

    run = _read_run(folder, overrides)
    steps = read_steps(run, range(len(run.names)), ["junction_max_c"])
    hottest_c = [float(each["junction_max_c"].max()) for each in steps]
    index = _index_of(run, run.names[int(np.argmax(hottest_c))] if dc is None else dc)
    at_step = int(steps[index]["junction_max_c"].argmax()) if step is None else step
    (config,) = read_configs(run, [index])
    if not config.plate_racks():
        raise SdcError(f"{config.name}: {NO_JUNCTIONS}")
    wanted = None if rack is None else parse_rack(rack, config.hall)
    at = "at the end of its hottest step" if step is None else "at the end of step"
    parts = junction_at_step(run, index, at_step, wanted)
    return run.names[index], config, f"{at} {at_step} of {folder}", parts


def _print_junction(explained: _ExplainedJunction, *, as_json: bool) -> None:
    """Print the terms of the junction of a liquid-cooled rack."""
    from sdc_taichi.sim.junction_parts import junction_state, junction_terms

    name, config, at, parts = explained
    if as_json:
        typer.echo(json.dumps({"name": name, "at": at, **fields_of(parts)}, indent=2))
        return
    (first, facility_c), *others = junction_terms(parts)
    lines = [
        f"{printable(name)}, {at}",
        f"{rack_text(parts.rack, config.hall.racks_per_row)}: junction {parts.junction_c:.2f} C",
        f"  {facility_c:>7.2f} C  {first}",
        *(f"  {k:>+7.2f} K  {text}" for text, k in others),
        junction_state(parts),
    ]
    typer.echo("\n".join(lines))


_Explained = tuple[str, DataCenterConfig, str, Inlets]
"""Name of a data center, its config, the moment of its inlets as text, and the inlets."""


def _run_folder(source: list[str] | None) -> Path | None:
    """Return the run folder that the arguments name, or None if they name a preset or file.

    Raises:
        ConfigError: there are further arguments after the run folder.
    """
    folders = [text for text in source or [] if os.path.isdir(text)]
    if not folders:
        return None
    if len(source or []) > 1:
        raise ConfigError(f"{folders[0]}: is the folder of a run; valid is it alone, without more")
    return Path(folders[0])


def _at_design_point(
    source: list[str] | None, overrides: list[str] | None, dc: str | None, step: int | None
) -> _Explained:
    """Compute the inlets at the design point of a config."""
    from sdc_taichi.sim.design_hall import solve_design_hall

    _check_no_run_options(dc, step)
    config, _ = read_config(source, overrides)
    return config.name, config, "at its design point", solve_design_hall(config).inlets


def _check_no_run_options(dc: str | None, step: int | None) -> None:
    """Raise ``ConfigError`` for options that need the folder of a run."""
    for option, value in (("--dc", dc), ("--step", step)):
        if value is not None:
            raise ConfigError(f"{option}: given without a run; valid with the folder of a run")


def _read_run(folder: Path, overrides: list[str] | None) -> RunFolder:
    """Read a run; overrides are an error."""
    from sdc_taichi.run.folder_reader import read_run

    if overrides:
        raise ConfigError("--set: given with the folder of a run; valid with a preset or file")
    return read_run(folder)


def _index_of(run: RunFolder, name: object) -> int:
    """Return the index of a data center of a run by its name."""
    if name not in run.names:
        shown = ", ".join(run.names[:10]) + (", ..." if len(run.names) > 10 else "")
        raise ConfigError(f"--dc {name!r}: no such data center in {run.path}; valid: {shown}")
    return run.names.index(str(name))


def _in_run(
    folder: Path, overrides: list[str] | None, dc: str | None, step: int | None
) -> _Explained:
    """Read or simulate the inlets of a data center at the end of a step of a run."""
    from sdc_taichi.run.folder_reader import is_number
    from sdc_taichi.run.inlets_of_run import hottest_inlets, inlets_at_step

    run = _read_run(folder, overrides)
    name = run.metrics["total"].get("hottest_dc") if dc is None else dc
    index = _index_of(run, name)
    metrics = run.metrics["data_centers"][index]["metrics"]
    hottest_step = metrics.get("hottest_step")
    wanted = hottest_step if step is None else step
    if not (isinstance(wanted, int) and is_number(metrics.get("hottest_inlet_c"))):
        raise SdcError(f"{folder}: no hottest inlet of {name}; simulate the run again")
    air = hottest_inlets(run, index) if wanted == hottest_step else None
    if air is None:
        air = inlets_at_step(run, index, wanted)
    at = "at the end of its hottest step" if air.step == hottest_step else "at the end of step"
    at = f"{at} {air.step} of {folder}, whose hottest inlet is {air.hottest_c:.2f} C"
    return name, air.config, at, air.inlets


def _draw(out: Path, config: DataCenterConfig, parts: InletParts) -> None:
    """Draw the floor plan, with each rack coloured by the warming that its exhaust causes, in K."""
    from sdc_taichi.viz.floor_plan_figure import RackValues, floor_plan_figure
    from sdc_taichi.viz.plotting import save_picture

    shown = RackValues(
        values=parts.exhaust_k,
        label=f"added to the inlet of rack {parts.rack} (K)",
        marked=parts.rack,
        mark_label=f"rack {parts.rack}, inlet {parts.inlet_c:.1f} °C",
        digits=2,
    )
    save_picture(floor_plan_figure(config, shown), out, parents=True)


def describe_inlet(parts: InletParts, racks_per_row: int) -> str:
    """Return a text about the terms of a rack's inlet temperature, and why exhaust reaches it."""
    (first, setpoint_c), *others = inlet_terms(parts, racks_per_row)
    lines = [
        f"{rack_text(parts.rack, racks_per_row)}, server {parts.server} of {parts.servers} from "
        f"the floor: {parts.inlet_c:.2f} C",
        f"  {setpoint_c:>7.2f} C  {first}",
        *(f"  {k:>+7.2f} K  {text}" for text, k in others),
    ]
    why = exhaust_terms(parts)
    if why:
        lines.append(f"exhaust air is {100 * parts.exhaust_share:.1f} % of its intake")
        lines += [f"  {k:>+7.2f} K  {text}" for text, k in why]
    return "\n".join([*lines, *state_texts(parts)])
