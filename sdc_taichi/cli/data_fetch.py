"""``sdc-taichi data fetch``: weather and carbon intensity from public services."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sdc_taichi.cli.console import PlainConsole
from sdc_taichi.cli.imported_files import print_imported, print_missing_parts
from sdc_taichi.cli.session import stage_bars
from sdc_taichi.exogenous.fetch import electricity_maps
from sdc_taichi.exogenous.importing import Imported
from sdc_taichi.exogenous.registry import find_name
from sdc_taichi.exogenous.synthetic import synthetic_sites

if TYPE_CHECKING:
    from sdc_taichi.exogenous.fetch.fetching import Destination

fetch_app = typer.Typer(
    help="Fetch weather and carbon intensity from public services.", no_args_is_help=True
)

Site = Annotated[
    str,
    typer.Option("--site", metavar="NAME", help="Name to import under.", show_default=False),
]
Base = Annotated[
    str | None, typer.Option(help="Embedded site that gives what the download does not.")
]
Refresh = Annotated[bool, typer.Option("--refresh", help="Download again what is kept.")]
Year = Annotated[
    int,
    typer.Option(
        "--year", metavar="YYYY", help="Calendar year, one that is over.", show_default=False
    ),
]
CarbonOffset = Annotated[
    float | None,
    typer.Option("--utc-offset", metavar="HOURS", help="UTC offset (h) of a site without weather."),
]


@fetch_app.command("pvgis")
def fetch_pvgis_command(
    latitude: Annotated[
        float, typer.Option(help="Degrees north.", metavar="DEGREES", show_default=False)
    ],
    longitude: Annotated[
        float, typer.Option(help="Degrees east.", metavar="DEGREES", show_default=False)
    ],
    utc_offset: Annotated[
        float,
        typer.Option(
            "--utc-offset",
            metavar="HOURS",
            help="Local standard time minus UTC (h), without daylight saving time.",
            show_default=False,
        ),
    ],
    site: Site,
    base: Base = None,
    file: Annotated[
        Path | None,
        typer.Option("--file", metavar="PATH", help="Answer of PVGIS that was saved by hand."),
    ] = None,
    refresh: Refresh = False,
) -> None:
    """Weather of a typical year at a latitude and longitude, without a key."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_pvgis

    _run(
        site,
        base,
        refresh,
        lambda into: fetch_pvgis(into, latitude, longitude, utc_offset, file),
    )


@fetch_app.command("epw")
def fetch_epw_command(
    url: Annotated[
        str, typer.Argument(help="Address of an EPW file, or of a ZIP archive that holds one.")
    ],
    site: Site,
    base: Base = None,
    refresh: Refresh = False,
) -> None:
    """Weather of an EPW file on the web, such as those of climate.onebuilding.org."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_epw

    _run(site, base, refresh, lambda into: fetch_epw(into, url))


@fetch_app.command("eia-930")
def fetch_eia_command(
    authority: Annotated[
        str, typer.Argument(help="Code of a balancing authority, such as CISO, PJM or ERCO.")
    ],
    year: Year,
    site: Site,
    base: Base = None,
    utc_offset: CarbonOffset = None,
    refresh: Refresh = False,
) -> None:
    """Carbon intensity in the USA by hourly generation; the key is in EIA_API_KEY."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_eia

    _run(site, base, refresh, lambda into: fetch_eia(into, authority, year, utc_offset))


@fetch_app.command("entsoe")
def fetch_entsoe_command(
    zone: Annotated[str, typer.Argument(help="Zone such as DE_LU or FR, or its EIC code.")],
    year: Year,
    site: Site,
    base: Base = None,
    utc_offset: CarbonOffset = None,
    refresh: Refresh = False,
) -> None:
    """Carbon intensity in Europe by generation per type; the key is in ENTSOE_API_KEY."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_entsoe

    _run(site, base, refresh, lambda into: fetch_entsoe(into, zone, year, utc_offset))


@fetch_app.command("electricity-maps")
def fetch_electricity_maps_command(
    zone: Annotated[str, typer.Argument(help="Zone such as FR or US-CAL-CISO.")],
    year: Year,
    site: Site,
    base: Base = None,
    utc_offset: CarbonOffset = None,
    release: Annotated[
        str,
        typer.Option("--release", metavar="YYYY-MM-DD", help="Day of the release of the table."),
    ] = electricity_maps.RELEASE,
    refresh: Refresh = False,
) -> None:
    """Carbon intensity of consumption by a yearly table, without a key."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_electricity_maps

    _run(
        site,
        base,
        refresh,
        lambda into: fetch_electricity_maps(into, zone, year, utc_offset, release),
    )


def _run(
    site: str, base: str | None, refresh: bool, fetch: Callable[[Destination], Imported]
) -> None:
    """Fetch with a progress bar, and print what was imported."""
    from sdc_taichi.exogenous.fetch.fetching import Destination

    if base is not None:
        base = find_name("base", base, synthetic_sites())
    with stage_bars(shown=True) as advance:
        into = Destination(
            site,
            base,
            refresh=refresh,
            progress=lambda done, total: advance("downloading", done, total),
        )
        item = fetch(into)
    console = PlainConsole()
    print_imported(console, item)
    print_missing_parts(console, [item], base)
