"""``sdc-taichi config``: show, check and list configurations."""

from __future__ import annotations

import typer

from sdc_taichi.cli.arguments import Overrides, Source, read_config
from sdc_taichi.cli.session import print_notes
from sdc_taichi.config import load_config, preset_names
from sdc_taichi.errors import printable

config_app = typer.Typer(help="Show and check configurations.", no_args_is_help=True)


@config_app.command("show")
def show_config(source: Source = None, overrides: Overrides = None) -> None:
    """Print a configuration in full, as YAML that can be read back."""
    config, _ = read_config(source, overrides)
    print(config.to_yaml(), end="")


@config_app.command("check")
def check_config(source: Source = None, overrides: Overrides = None) -> None:
    """Check a configuration and the inputs it names, without simulating."""
    from sdc_taichi.sim.drivers import load_drivers
    from sdc_taichi.sim.fleet import build_fleet
    from sdc_taichi.sim.fleet_configs import locations

    config, label = read_config(source, overrides)
    fleet = build_fleet(config)
    drivers = load_drivers(fleet.configs)
    print_notes(drivers.notes)
    nameplate_kw = sum(g.count * g.full_w for rack in config.rack_groups() for g in rack) / 1e3
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
