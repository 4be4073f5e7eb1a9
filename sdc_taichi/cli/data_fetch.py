"""``sdc-taichi data fetch``: download weather and carbon intensity from public services."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sdc_taichi.cli.options import CommandApp
from sdc_taichi.cli.terminal import PlainConsole, stage_bars
from sdc_taichi.exogenous.fetch.services import ELECTRICITY_MAPS_RELEASE
from sdc_taichi.exogenous.importing import Imported
from sdc_taichi.exogenous.registry import find_name, imported_sites
from sdc_taichi.exogenous.synthetic import synthetic_sites

if TYPE_CHECKING:
    from sdc_taichi.exogenous.fetch.fetching import Destination

fetch_app = CommandApp(
    help="Fetch weather and carbon intensity from public services.", no_args_is_help=True
)


@dataclass(frozen=True)
class TargetOptions:
    """Options for the site under whose name a download is imported."""

    site: Annotated[
        str,
        typer.Option("--site", metavar="NAME", help="Name to import under.", show_default=False),
    ]
    base: Annotated[
        str | None, typer.Option(help="Embedded site that gives what the download does not.")
    ] = None
    refresh: Annotated[bool, typer.Option("--refresh", help="Download again what is stored.")] = (
        False
    )

    def fetch(self, fetch: Callable[[Destination], Imported]) -> None:
        """Run a download with a progress bar, and print what was imported.

        Args:
            fetch: function that downloads and imports into the given destination.
        """
        from sdc_taichi.exogenous.fetch.fetching import Destination

        base = None if self.base is None else find_name("base", self.base, synthetic_sites())
        with stage_bars(shown=True) as advance:
            into = Destination(
                self.site,
                base,
                refresh=self.refresh,
                progress=lambda done, total: advance("downloading", done, total),
            )
            item = fetch(into)
        console = PlainConsole()
        print_imported(console, item)
        print_missing_parts(console, [item], base)


@dataclass(frozen=True)
class YearOptions:
    """Options for the year of a carbon-intensity series, and for the time zone of its site."""

    year: Annotated[
        int,
        typer.Option(
            "--year", metavar="YYYY", help="Calendar year in the past.", show_default=False
        ),
    ]
    utc_offset: Annotated[
        float | None,
        typer.Option(
            "--utc-offset", metavar="HOURS", help="UTC offset (h) of a site without weather."
        ),
    ] = None


@fetch_app.command("pvgis")
def fetch_pvgis_command(
    *,
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
    target: TargetOptions,
    file: Annotated[
        Path | None,
        typer.Option("--file", metavar="PATH", help="Answer of PVGIS that was saved by hand."),
    ] = None,
) -> None:
    """Weather of a typical year at a latitude and longitude, without a key."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_pvgis

    target.fetch(lambda into: fetch_pvgis(into, latitude, longitude, utc_offset, file))


@fetch_app.command("epw")
def fetch_epw_command(
    *,
    url: Annotated[
        str, typer.Argument(help="Address of an EPW file, or of a ZIP archive that holds one.")
    ],
    target: TargetOptions,
) -> None:
    """Weather of an EPW file on the web, such as those of climate.onebuilding.org."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_epw

    target.fetch(lambda into: fetch_epw(into, url))


@fetch_app.command("eia-930")
def fetch_eia_command(
    *,
    authority: Annotated[
        str, typer.Argument(help="Code of a balancing authority, such as CISO, PJM or ERCO.")
    ],
    year: YearOptions,
    target: TargetOptions,
) -> None:
    """Carbon intensity in the USA by hourly generation; the key is in EIA_API_KEY."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_generation

    target.fetch(
        lambda into: fetch_generation(into, "eia-930", authority, year.year, year.utc_offset)
    )


@fetch_app.command("entsoe")
def fetch_entsoe_command(
    *,
    zone: Annotated[str, typer.Argument(help="Zone such as DE_LU or FR, or its EIC code.")],
    year: YearOptions,
    target: TargetOptions,
) -> None:
    """Carbon intensity in Europe by generation per type; the key is in ENTSOE_API_KEY."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_generation

    target.fetch(lambda into: fetch_generation(into, "entsoe", zone, year.year, year.utc_offset))


@fetch_app.command("electricity-maps")
def fetch_electricity_maps_command(
    *,
    zone: Annotated[str, typer.Argument(help="Zone such as FR or US-CAL-CISO.")],
    year: YearOptions,
    target: TargetOptions,
    release: Annotated[
        str,
        typer.Option("--release", metavar="YYYY-MM-DD", help="Day of the release of the table."),
    ] = ELECTRICITY_MAPS_RELEASE,
) -> None:
    """Carbon intensity of consumption by a yearly table, without a key."""
    from sdc_taichi.exogenous.fetch.fetching import fetch_electricity_maps

    target.fetch(
        lambda into: fetch_electricity_maps(into, zone, year.year, year.utc_offset, release)
    )


def print_imported(console: PlainConsole, item: Imported) -> None:
    """Print kind, name and path of an imported file, with notes on repairs and warnings."""
    console.print(
        f"{item.kind} {item.name}: {item.source.name} -> {item.target}",
        soft_wrap=True,
    )
    for note in item.notes:
        console.print(f"  {note}", soft_wrap=True)


def print_missing_parts(console: PlainConsole, done: Sequence[Imported], base: str | None) -> None:
    """Print which input each imported site lacks, and where that input comes from.

    Args:
        console: console to print on.
        done: imported files.
        base: embedded site that supplies missing inputs; None without ``--base``.
    """
    for name in dict.fromkeys(item.name for item in done if item.kind != "workload"):
        missing = {"weather", "carbon"} - set(imported_sites().get(name, {}))
        if not missing:
            continue
        part = missing.pop()
        text = (
            f"site {name} lacks {part}: import a {part} file with --site {name}, or import "
            "again with --base SITE to take it from an embedded site"
            if base is None
            else f"site {name}: {part} of the embedded {base} (synthetic)"
        )
        console.print(text, soft_wrap=True)
