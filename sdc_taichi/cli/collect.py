"""``sdc-taichi collect``: write episodes of controllers as data sets for offline learning."""

from __future__ import annotations

import math
import re
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sdc_taichi.cli.options import (
    Quiet,
    RunOptions,
    SiteOptions,
    Source,
    controllers_option,
    force_option,
    out_option,
    read_config,
)
from sdc_taichi.cli.terminal import EXIT_INTERRUPTED, interruptible, stage_bars
from sdc_taichi.errors import ConfigError, printable

if TYPE_CHECKING:
    from sdc_taichi.benchmark.data_set import DataSet
    from sdc_taichi.config import DataCenterConfig


def collect_command(
    context: typer.Context,
    *,
    source: Source = None,
    sites: SiteOptions,
    controller: Annotated[
        list[str] | None,
        controllers_option(
            "Controller as of simulate, or random, optimum, optimum:OBJECTIVE; repeatable."
        ),
    ] = None,
    weeks: Annotated[
        str,
        typer.Option(metavar="NAME|N,N", help="training, validation, held-out, or weeks 0..51."),
    ] = "training",
    days: Annotated[int, typer.Option(min=1, max=7, help="Days of an episode.")] = 7,
    repeats: Annotated[
        int, typer.Option(min=1, help="Episodes of each controller and week, of other seeds.")
    ] = 1,
    agent: Annotated[
        Literal["load", "cooling", "battery"] | None,
        typer.Option(help="The one agent that acts. [default: all as one]"),
    ] = None,
    assigned: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="environment.A=B",
            help="Option of the environment, as environment.rewards=bill; repeatable.",
        ),
    ] = None,
    run: RunOptions,
    name: Annotated[
        str | None,
        typer.Option(
            "--name",  # older versions of Typer would take the metavar for it
            metavar="NAME",
            help="Name in Minari, to which -SITE-v0 is added. [default: sdc_taichi/PRESET]",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, out_option("Folder of all data sets.", "DIR")] = Path("datasets"),
    force: Annotated[bool, force_option("Replace data sets that are there.")] = False,
    quiet: Quiet = False,
) -> None:
    """Collect episodes of controllers for offline learning, in Minari's format.

    Writes a data set and a card for each site: observations, actions, rewards and a few quantities
    of every step. The environment in its metadata reproduces them.
    """
    from sdc_taichi.benchmark.episodes import Collection
    from sdc_taichi.benchmark.offline import data_set_folder, require_minari, write_data_set
    from sdc_taichi.learning.split import parse_weeks
    from sdc_taichi.optimum import StoppedError

    if not controller:
        raise ConfigError("--controller: none; valid is one or more, such as random, mpc-24h")
    require_minari()
    base, label = read_config(source)
    configs = sites.data_centers(base)
    stem = name if name is not None else f"sdc_taichi/{_identifier(Path(label).stem)}"
    names = _data_set_names(stem, configs)
    collections = [
        Collection(
            config=config,
            controllers=tuple(controller),
            weeks=parse_weeks(weeks),
            days=days,
            repeats=repeats,
            seed=run.seed,
            agent=_agent_of(agent),
            environment=_environment(assigned or []),
            precision=run.precision,
        )
        for config in configs
    ]
    # Invalid input must fail before the first episode is simulated.
    for data_set_name in names:
        data_set_folder(out, data_set_name, replace=force)
    for collection in collections:
        collection.check()
    command = shlex.join(["sdc-taichi", *context.obj])
    done: list[str] = []
    with interruptible() as stop:
        for collection, data_set_name in zip(collections, names, strict=True):
            try:
                with stage_bars(shown=not quiet) as progress:
                    made = write_data_set(
                        collection,
                        out,
                        data_set_name,
                        command=command,
                        replace=force,
                        progress=progress,
                        stop=stop,
                    )
            except StoppedError:
                whole = f"; whole: {', '.join(done)}" if done else ""
                text = f"interrupted; nothing of {data_set_name} is kept{whole}"
                print(text, file=sys.stderr)
                raise typer.Exit(EXIT_INTERRUPTED) from None
            done.append(data_set_name)
            if not quiet:
                _print_summary(made)


def _environment(assigned: list[str]) -> dict[str, Any]:
    """Return the environment options of ``--set``, by name.

    Args:
        assigned: values of ``--set``, each ``environment.OPTION=VALUE``.
    """
    from sdc_taichi.config import apply_override

    values: dict[str, Any] = {}
    for text in assigned:
        if not text.startswith("environment."):
            raise ConfigError(
                f"--set {text!r}: valid is environment.OPTION=VALUE; fields of the data center "
                "follow the preset, as workload.flexible_share=0.4"
            )
        apply_override(values, text)
    options: dict[str, Any] = values.get("environment", {})
    return options


def _agent_of(command: str | None) -> str | None:
    """Return the name of the agent that decides a command, such as ``load``; None for None."""
    from sdc_taichi.envs.agents import AGENT_DEFINITIONS

    return next((agent for agent, d in AGENT_DEFINITIONS.items() if d.command == command), None)


def _data_set_names(stem: str, configs: list[DataCenterConfig]) -> list[str]:
    """Return the name in Minari of the data set of each site, ``STEM-SITE-v0``."""
    from sdc_taichi.sim.fleet_configs import place_names

    return [f"{stem}-{_identifier(place)}-v0" for place in place_names(configs)]


def _identifier(text: str) -> str:
    """Replace runs of characters that are invalid in Minari's names by ``_``."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text)


def _print_summary(made: DataSet) -> None:
    """Print episodes, steps and mean return per controller, and the folder of a data set."""
    from sdc_taichi.benchmark.offline import CARD_FILE

    for name in made.collection.controllers:
        row: dict[str, Any] = dict(made.returns.loc[name])
        score = made.score(name)
        text = "" if math.isnan(score) else f", score {100.0 * score:.1f} %"
        print(
            f"{name}: {int(row['episodes']):,} episodes, {int(row['steps']):,} steps, mean return "
            f"{row['mean_return']:.2f}{text}"
        )
    folder = printable(made.folder)
    print(f"{made.id} in {folder}; {CARD_FILE} there describes it and how to load it")
