"""``sdc-taichi config`` and ``new``: show, check, list and create configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.cli.options import (
    CommandApp,
    ConfigOptions,
    check_out_file,
    completed_by,
    force_option,
)
from sdc_taichi.cli.terminal import print_notes
from sdc_taichi.config import load_config, preset_names
from sdc_taichi.errors import printable

config_app = CommandApp(help="Show and check configurations.", no_args_is_help=True)


@config_app.command("show")
def show_config(config: ConfigOptions) -> None:
    """Print a configuration in full, as YAML that can be read back."""
    print(config.read()[0].to_yaml(), end="")


@config_app.command("check")
def check_config(config: ConfigOptions) -> None:
    """Check a configuration and the inputs it names, without simulating."""
    from sdc_taichi.sim.drivers import load_drivers
    from sdc_taichi.sim.fleet import build_fleet
    from sdc_taichi.sim.fleet_configs import locations

    center, label = config.read()
    fleet = build_fleet(center)
    drivers = load_drivers(fleet.configs)
    print_notes(drivers.notes)
    nameplate_kw = sum(g.count * g.full_w for rack in center.rack_groups() for g in rack) / 1e3
    print(
        f"{printable(label)}: valid; {fleet.racks} racks, {fleet.servers:,} servers, "
        f"{nameplate_kw:,.6g} kW nameplate, site {printable(locations(fleet.configs)[0])}"
    )


@config_app.command("list")
def list_configs() -> None:
    """List the presets."""
    names = preset_names()
    width = max(map(len, names))
    for name in names:
        print(f"{name:<{width}}  {load_config(name).description}")


def new_command(
    out: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="File to write.")],
    preset: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="PRESET",
            help="Preset whose values it has.",
            autocompletion=completed_by(preset_names),
        ),
    ] = "corrected",
    force: Annotated[bool, force_option()] = False,
) -> None:
    """Write a configuration to start from, with unit, bounds and meaning above each field."""
    from sdc_taichi.config.field_texts import commented_yaml

    check_out_file(out, ".yaml", force=force, option="FILE")
    head = f"# A data center, from preset {preset}. Fields that are left out have defaults.\n\n"
    content = head + commented_yaml(load_config(preset))
    with atomic_write(out) as file:
        file.write(content.encode())
    place = printable(out)
    print(f"Wrote {place}; try it with: sdc-taichi simulate {place} --days 7 --out runs/first")
