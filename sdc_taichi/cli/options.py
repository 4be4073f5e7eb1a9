"""Options and groups of options that several commands share, and functions that read them.

A group of options is a dataclass whose fields are options. A command has a parameter with the group
as its type, and ``CommandApp`` gives the command one option for each field.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_type_hints

import typer

from sdc_taichi.config import DataCenterConfig, load_config, load_yaml, preset_names
from sdc_taichi.errors import ConfigError
from sdc_taichi.exogenous.year_clock import day_of_year
from sdc_taichi.user_file import MOST_CONFIG_BYTES, read_text
from sdc_taichi.user_functions import code_permission, set_code_permission

if TYPE_CHECKING:
    from sdc_taichi.control import ForecastError

CommandFunction = TypeVar("CommandFunction", bound=Callable[..., None])
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")]
"""Option of every command; the module ``app`` searches the arguments for it after an error."""
AllowCode = Annotated[
    bool,
    typer.Option(
        "--allow-code",
        help="Run code that files name by import paths module:name; only if you trust the files.",
    ),
]
"""Option of the commands that can run controllers, rewards or costs that a file names."""


class CommandApp(typer.Typer):
    """Set of commands that may have groups of options, and all have the option ``--debug``."""

    def command(
        self, name: str | None = None, *, may_allow_code: bool = False, **settings: Any
    ) -> Callable[[CommandFunction], CommandFunction]:
        """Register the decorated function as a command.

        Args:
            name: name of the command.
            may_allow_code: True to give the command the option ``--allow-code``.
            settings: further arguments of ``typer.Typer.command``.
        """
        register = super().command(name, **settings)

        def decorate(function: CommandFunction) -> CommandFunction:
            register(_flattened(function, may_allow_code=may_allow_code))
            return function

        return decorate


def _flattened(function: Callable[..., None], *, may_allow_code: bool) -> Callable[..., None]:
    """Wrap the function of a command: replace groups of options by fields, add shared options."""
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        group = parameter.annotation
        if isinstance(group, type) and dataclasses.is_dataclass(group):
            groups[parameter.name] = group
            parameters += _parameters_of(group)
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    shared = {"allow_code": AllowCode} if may_allow_code else {}
    for name, option in (shared | {"debug": Debug}).items():
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(name, keyword, default=False, annotation=option))

    @functools.wraps(function)
    def command(**values: Any) -> None:
        del values["debug"]
        permission = code_permission()
        if values.pop("allow_code", False) and permission is not None:
            set_code_permission(permission._replace(any_code=True))
        for name, group in groups.items():
            fields = dataclasses.fields(group)
            values[name] = group(**{field.name: values.pop(field.name) for field in fields})
        function(**values)

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    return command


def _parameters_of(group: type[Any]) -> list[inspect.Parameter]:
    """Return one keyword parameter for each field of a group of options."""
    types = get_type_hints(group, include_extras=True)
    missing, required = dataclasses.MISSING, inspect.Parameter.empty
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=required if field.default is missing else field.default,
            annotation=types[field.name],
        )
        for field in dataclasses.fields(group)
    ]


def completed_by(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return a function that completes a word of the command line to names that begin with it.

    If no name begins with the word, shells offer files.
    """

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


def _presets_and_fields() -> list[str]:
    from sdc_taichi.config.field_texts import field_names

    return [*preset_names(), *(f"{name}=" for name in field_names())]


def _controllers() -> Iterable[str]:
    """Return the names of controllers, up to the colon for names with a value (``constant:C``)."""
    from sdc_taichi.control.registry import controller_names

    return ("".join(name.partition(":")[:2]) for name in controller_names())


def complete_sites(incomplete: str) -> list[str]:
    """Return completions of the last site in a list of sites separated by commas."""
    from sdc_taichi.exogenous.registry import site_names

    before, comma, _ = incomplete.rpartition(",")
    return completed_by(lambda: (f"{before}{comma}{name.lower()}" for name in site_names()))(
        incomplete
    )


complete_controllers = completed_by(_controllers)

Source = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PRESET|FILE] [A.B=C]...",
        help="Preset, YAML file or SustainDC dc_config.json, and overrides of its fields.",
        show_default=False,
        autocompletion=completed_by(_presets_and_fields),
    ),
]
"""Argument of a command that reads a configuration."""
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="A.B=C", help="Override a field of the config; repeatable."),
]
Site = Annotated[
    str | None,
    typer.Option(
        metavar="SITE[,SITE...]",
        help="Sites, one data center each (see data list).",
        autocompletion=complete_sites,
    ),
]
Days = Annotated[float, typer.Option(help="Length, in days; may exceed a year.")]
Start = Annotated[str | None, typer.Option(metavar="MM-DD", help="First day, local standard time.")]


def controllers_option(help: str) -> Any:
    """Return the option ``--controller`` of a command.

    The type of the parameter determines whether the option can be repeated.
    """
    return typer.Option(metavar="NAME", help=help, autocompletion=complete_controllers)


Compared = Annotated[
    list[str] | None, controllers_option("Controller to compare, as of simulate; repeatable.")
]
"""Option of a command that compares controllers with an optimum."""
NoCache = Annotated[bool, typer.Option("--no-cache", help="Solve again, and store nothing.")]
"""Option of a command that solves for an optimum."""
FolderForce = Annotated[bool, typer.Option("--force", help="Write into a folder with other files.")]
"""Option of a command that writes a folder."""
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")]
"""Option of a command that prints a summary."""


def out_option(help: str, metavar: str | None = None) -> Any:
    """Return the option ``--out`` of a command that writes a file or a folder."""
    return typer.Option("--out", metavar=metavar, help=help)


def force_option(help: str = "Replace an existing file.") -> Any:
    """Return the option ``--force``, without which a command replaces no files."""
    return typer.Option("--force", help=help)


def json_option(help: str) -> Any:
    """Return the option ``--json``, with which a command prints JSON instead of text."""
    return typer.Option("--json", help=help)


@dataclass(frozen=True)
class ConfigOptions:
    """Options for the configuration of a data center."""

    source: Source = None
    overrides: Overrides = None

    def read(self) -> tuple[DataCenterConfig, str]:
        """Return the configuration, and the name of its preset or file.

        Raises:
            ConfigError: there are two presets or files, or the configuration is not valid.
        """
        return read_config(self.source, self.overrides)


@dataclass(frozen=True)
class SiteOptions:
    """Options for sites, and for files of weather, carbon intensity and workload."""

    site: Site = None
    weather: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="EPW file; repeated, one per site in their order."),
    ] = None
    carbon: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="Carbon-intensity CSV; repeated, one per site."),
    ] = None
    workload: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="Workload CSV for all sites; or repeated, one per site."),
    ] = None

    def data_centers(
        self,
        base: DataCenterConfig,
        *,
        start: str | None = None,
        dcs: int | None = None,
        sample: Path | None = None,
        seed: int = 0,
    ) -> list[DataCenterConfig]:
        """Return the configurations of the data centers at the sites.

        Args:
            base: configuration from which those of the data centers are derived.
            start: first day of the run (``--start``); None is that of ``base``.
            dcs: number of data centers (``--dcs``); None is one per site.
            sample: file with fields to sample (``--sample``); None samples nothing.
            seed: seed of the sampled fields.

        Raises:
            ConfigError: an option is not valid, or contradicts another option.
        """
        from sdc_taichi.sim.fleet_configs import make_configs

        sites, files = site_names(self.site), self._files()
        base = with_start(base, start)
        # Without --site, all data centers use the files given; with it, each site has its own
        # files, which are set below.
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

    def _files(self) -> dict[str, list[str]]:
        """Return the paths of input files, keyed by their field of section ``site``.

        Each field has one path per site, or a single path for all sites.
        """
        count = max(len(site_names(self.site)), 1)
        files = {}
        for option in ("weather", "carbon", "workload"):
            paths = getattr(self, option)
            if not paths:
                continue
            is_shared = option == "workload" and len(paths) == 1
            if len(paths) != count and not is_shared:
                raise ConfigError(
                    f"--{option}: {len(paths)} given for {count} of --site; valid is one per site, "
                    "in their order"
                )
            files[f"{option}_file"] = [str(Path(path).absolute()) for path in paths]
        return files


@dataclass(frozen=True)
class RunOptions:
    """Options for the seed and the numerical precision of runs."""

    seed: Annotated[
        int,
        typer.Option(
            min=0,
            max=2**63 - 1,
            help="Of controllers, forecast errors, sampled events and samples (not of the "
            "synthetic year).",
        ),
    ] = 0
    precision: Annotated[Literal["f32", "f64"], typer.Option(help="Of the per-server kernels.")] = (
        "f32"
    )


@dataclass(frozen=True)
class ForecastRunOptions(RunOptions):
    """Options for the seed, the numerical precision, and forecast errors of runs."""

    forecast_error: Annotated[
        str | None,
        typer.Option(
            "--forecast-error",
            metavar="ci=SHARE,temperature=K",
            help="Errors of controllers' forecasts at 24 h, such as ci=0.1,temperature=1.",
        ),
    ] = None

    def error(self) -> ForecastError:
        """Return the errors of the forecasts that controllers receive.

        Raises:
            ConfigError: the text of the option is not valid.
        """
        from sdc_taichi.control import PERFECT, ForecastError

        return PERFECT if self.forecast_error is None else ForecastError.parse(self.forecast_error)


def check_out_file(out: Path | None, suffix: str, *, force: bool, option: str = "--out") -> None:
    """Check the output file of an option such as ``--out``; call this before any long work.

    Args:
        out: path of the file; None without the option, which is valid.
        suffix: the only valid suffix, such as ``.png``.
        force: True if an existing file may be replaced.
        option: name of the option, for messages.

    Raises:
        ConfigError: the path has another suffix, is a folder, or exists and ``force`` is False.
    """
    if out is None:
        return
    if out.suffix.lower() != suffix:
        raise ConfigError(f"{option} {out}: valid is a name that ends in {suffix}")
    if os.path.isdir(out):
        raise ConfigError(f"{option} {out}: is a folder; valid is a file")
    if os.path.exists(out) and not force:
        raise ConfigError(f"{option} {out}: exists; choose another name or replace it with --force")


def parse_source(source: list[str] | None) -> tuple[str | None, list[str]]:
    """Split the words of ``Source`` into the preset or file (None without one) and overrides.

    Raises:
        ConfigError: there are two presets or files.
    """
    words = source or []
    files = [text for text in words if "=" not in text or os.path.isfile(text)]
    if len(files) > 1:
        raise ConfigError(
            f"{files[1]!r}: a second preset or file after {files[0]!r}; valid is one, and "
            "overrides section.key=value"
        )
    return next(iter(files), None), [text for text in words if text not in files]


def read_config(
    source: list[str] | None, overrides: list[str] | None = None
) -> tuple[DataCenterConfig, str]:
    """Return the configuration of ``Source`` and ``Overrides``, and the name of its preset or file.

    Raises:
        ConfigError: there are two presets or files, or the configuration is not valid.
    """
    preset, assigned = parse_source(source)
    name = preset or "corrected"
    return load_config(name, [*(overrides or []), *assigned]), name


def site_names(site: str | None) -> list[str]:
    """Return the site names in the value of ``--site``; an absent option gives an empty list.

    Raises:
        ConfigError: a name is empty, or occurs twice.
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


def with_start(config: DataCenterConfig, start: str | None) -> DataCenterConfig:
    """Return a configuration with the first day of ``--start``; None changes nothing.

    Raises:
        ConfigError: the day is not valid.
    """
    if start is None:
        return config
    try:
        day_of_year(start)
    except ValueError as error:
        raise ConfigError(f"--start: {error}") from None
    return _with_site(config, start=start.strip())


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
        fault = f"key {wrong[0]!r}" if wrong else f"the top level is a {type(rules).__name__}"
        raise ConfigError(
            f"{path}: {fault}; valid is a mapping of fields, such as hvac.chiller.reference_cop, "
            "to {uniform: [low, high]} or {choice: [a, b]}"
        )
    return rules
