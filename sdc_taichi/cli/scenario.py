"""Options that name sites, days and files, and the data centers that follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from sdc_taichi.cli import completion
from sdc_taichi.config import DataCenterConfig, load_yaml
from sdc_taichi.errors import ConfigError
from sdc_taichi.exogenous.year_clock import day_of_year
from sdc_taichi.user_file import MOST_CONFIG_BYTES, read_text

EXIT_INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended."""

Site = Annotated[
    str | None,
    typer.Option(
        metavar="SITE[,SITE...]",
        help="Sites, one data center each (see data list).",
        autocompletion=completion.sites,
    ),
]
Days = Annotated[float, typer.Option(help="Length, in days; may exceed a year.")]
Start = Annotated[str | None, typer.Option(metavar="MM-DD", help="First day, local standard time.")]
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        max=2**63 - 1,
        help="Of controllers, forecast errors, sampled events and samples (not of the synthetic "
        "year).",
    ),
]
ErrorOfForecasts = Annotated[
    str | None,
    typer.Option(
        "--forecast-error",
        metavar="ci=SHARE,temperature=K",
        help="Errors of controllers' forecasts at 24 h, such as ci=0.1,temperature=1.",
    ),
]
Precision = Annotated[Literal["f32", "f64"], typer.Option(help="Of the per-server kernels.")]
Weather = Annotated[
    list[str] | None,
    typer.Option(metavar="FILE", help="EPW file; repeated, one per site in their order."),
]
Carbon = Annotated[
    list[str] | None,
    typer.Option(metavar="FILE", help="Carbon-intensity CSV; repeated, one per site."),
]
Workload = Annotated[
    list[str] | None,
    typer.Option(metavar="FILE", help="Workload CSV for all sites; or repeated, one per site."),
]


def data_centers(
    base: DataCenterConfig,
    site: str | None,
    *,
    start: str | None,
    weather: list[str] | None,
    carbon: list[str] | None,
    workload: list[str] | None,
    dcs: int | None = None,
    sample: Path | None = None,
    seed: int = 0,
) -> list[DataCenterConfig]:
    """Configs of the data centers that the options ask for.

    Args:
        base: config that they all begin with.
        site: sites of ``--site``.
        start: first day of ``--start``.
        weather: files of ``--weather``.
        carbon: files of ``--carbon``.
        workload: files of ``--workload``.
        dcs: number of ``--dcs``; None is one per site.
        sample: file of ``--sample``.
        seed: seed of ``--sample``.

    Raises:
        ConfigError: an option that is not valid, or does not fit the others.
    """
    from sdc_taichi.sim.fleet_configs import make_configs

    sites = site_names(site)
    files = _files_of_sites(sites, weather, carbon, workload)
    if start is not None:
        try:
            day_of_year(start)
        except ValueError as error:
            raise ConfigError(f"--start: {error}") from None
        base = _with_site(base, start=start.strip())
    # Files of a site are its own, and without sites there is one of each.
    base = _with_site(base, **{field: None if sites else of[0] for field, of in files.items()})
    rules = None if sample is None else _read_sample(sample)
    try:
        configs = make_configs(base, count=dcs, sites=sites, sample=rules, seed=seed)
    except ConfigError as error:
        if sample is None:
            raise
        raise ConfigError(f"{sample}: {error}") from None
    return [
        _with_site(config, **{field: of[i % len(of)] for field, of in files.items()})
        for i, config in enumerate(configs)
    ]


def default_folder(label: str, configs: Sequence[DataCenterConfig]) -> Path:
    """Folder of a run without ``--out``, named after preset, sites and first day."""
    from sdc_taichi.sim.fleet_configs import place_names

    sites = list(dict.fromkeys(place_names(configs)))
    where = "-".join(sites) if len(sites) <= 4 else f"{len(sites)}sites"
    return Path("runs") / f"{Path(label).stem}-{where}-{configs[0].site.start}"


def site_names(site: str | None) -> list[str]:
    """Names of ``--site``; none without it.

    Raises:
        ConfigError: an empty name, or one that is given twice.
    """
    if site is None:
        return []
    names = [name.strip() for name in site.split(",")]
    folded = [name.casefold() for name in names]
    if not all(names):
        raise ConfigError(f"--site {site!r}: an empty name; valid is SITE or SITE,SITE")
    for index, name in enumerate(folded):
        if name in folded[:index]:
            raise ConfigError(
                f"--site {site!r}: {names[index]} is given twice; valid is each site once "
                "(--dcs makes copies)"
            )
    return names


def _files_of_sites(
    sites: list[str],
    weather: list[str] | None,
    carbon: list[str] | None,
    workload: list[str] | None,
) -> dict[str, list[str]]:
    """Fields of ``site`` that files are given for, and the files, one per site or one for all."""
    count = max(len(sites), 1)
    given = {"weather_file": weather, "carbon_file": carbon, "workload_file": workload}
    found = {}
    for field, paths in given.items():
        if not paths:
            continue
        shared = field == "workload_file" and len(paths) == 1
        if len(paths) != count and not shared:
            option = field.removesuffix("_file")
            raise ConfigError(
                f"--{option}: {len(paths)} given for {count} of --site; valid is one per site, in "
                "their order"
            )
        found[field] = [str(Path(path).absolute()) for path in paths]
    return found


def _with_site(config: DataCenterConfig, **update: str | None) -> DataCenterConfig:
    site = config.site.model_copy(update=update)
    return config.model_copy(update={"site": site})


def _read_sample(path: Path) -> dict[str, Any]:
    text = read_text(path, MOST_CONFIG_BYTES, ConfigError)
    try:
        rules = load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{path}: not valid YAML ({error})") from None
    wrong = [name for name in rules if not isinstance(name, str)] if isinstance(rules, dict) else []
    if not isinstance(rules, dict) or wrong:
        found = f"key {wrong[0]!r}" if wrong else f"the top level is a {type(rules).__name__}"
        raise ConfigError(
            f"{path}: {found}; valid is a mapping of fields, such as hvac.chiller.reference_cop, "
            "to {uniform: [low, high]} or {choice: [a, b]}"
        )
    return rules
