"""``sdc-taichi hall why``: whose exhaust, and what else, makes the inlet of a rack warm."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from sdc_taichi.cli.arguments import Overrides, Source, json_option, read_config
from sdc_taichi.config import HallConfig
from sdc_taichi.errors import ConfigError, printable
from sdc_taichi.sim.inlet_parts import (
    InletParts,
    exhaust_terms,
    inlet_terms,
    inlet_values,
    rack_text,
    state_texts,
)


def why_command(
    source: Source = None,
    rack: Annotated[
        str | None,
        typer.Option(
            metavar="RACK|ROW:PLACE", help="The rack, counted from 0. [default: the hottest]"
        ),
    ] = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, json_option("Print all parts as JSON.")] = False,
) -> None:
    """Say why the inlet of a rack is as warm as it is: a sum of parts without a remainder.

    At the design point, at full load.
    """
    from sdc_taichi.sim.design_hall import solve_design_hall

    config, _ = read_config(source, overrides)
    index = None if rack is None else rack_number(rack, config.hall)
    inlets = solve_design_hall(config).inlets
    parts = inlets.parts(inlets.hottest(1)[0] if index is None else index)
    if as_json:
        typer.echo(json.dumps({"name": config.name, **inlet_values(parts)}, indent=2))
        return
    typer.echo(f"{printable(config.name)} at its design point")
    typer.echo(describe_inlet(parts, config.hall.racks_per_row))


def rack_number(text: str, hall: HallConfig) -> int:
    """Index of a rack that a user names by number or as ROW:PLACE.

    Raises:
        ConfigError: no such rack.
    """
    row, colon, place = text.strip().partition(":")
    try:
        numbers = [int(part) for part in ((row, place) if colon else (row,))]
    except ValueError:
        numbers = [-1]
    tops = (hall.rows, hall.racks_per_row) if colon else (hall.racks,)
    if len(numbers) == len(tops) and all(0 <= n < m for n, m in zip(numbers, tops, strict=True)):
        return numbers[0] * hall.racks_per_row + numbers[1] if colon else numbers[0]
    raise ConfigError(
        f"--rack {text!r}: valid is a rack 0..{hall.racks - 1}, or ROW:PLACE up to "
        f"{hall.rows - 1}:{hall.racks_per_row - 1}"
    )


def describe_inlet(parts: InletParts, racks_per_row: int) -> str:
    """The inlet of a rack as a sum, and why exhaust reaches it, as lines of text."""
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
