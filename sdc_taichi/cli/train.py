"""``sdc-taichi train``: train agents, and keep their policies."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdc_taichi.cli.arguments import Debug, out_option
from sdc_taichi.cli.scenario import EXIT_INTERRUPTED
from sdc_taichi.cli.session import interruptible, rich_progress
from sdc_taichi.errors import ConfigError, printable, suggestion_or_valid

if TYPE_CHECKING:
    from sdc_taichi.learning.trainer import Progress, Training
    from sdc_taichi.learning.training_settings import TrainingSettings

SECONDS_BETWEEN_LINES = 30.0
"""Least time between two lines of progress where there is no terminal."""


def train_command(
    algorithm: Annotated[
        str | None,
        typer.Argument(
            metavar="ALGORITHM",
            help="ppo, ippo, mappo, happo, haa2c, had3qn or hasac.",
            show_default=False,
        ),
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PRESET|FILE] [A.B=C]...",
            help="Preset, YAML file or SustainDC dc_config.json, and overrides of its fields.",
            show_default=False,
        ),
    ] = None,
    site: Annotated[
        str | None,
        typer.Option(metavar="SITE[,SITE...]", help="Sites to train on. [default: of the config]"),
    ] = None,
    steps: Annotated[
        str | None,
        typer.Option(metavar="N", help="Steps of all data centers together. [default: 2e6]"),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**31 - 1, help="Of all that is random. [default: 0]")
    ] = None,
    agents: Annotated[
        str | None,
        typer.Option(metavar="NAME[,NAME]", help="Who learns: load, cooling, battery."),
    ] = None,
    others: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Controller of the agents that do not. [default: idle]"),
    ] = None,
    rewards: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Rewards by name, or path module:name."),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="carbon, carbon-rich, bill or bill-rich."),
    ] = None,
    settings: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="YAML of settings, as --show prints them."),
    ] = None,
    assigned: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="A.B=C", help="Change a setting, as learning.epochs=8; repeatable."
        ),
    ] = None,
    out: Annotated[
        Path | None, out_option("Folder of the training. [default: runs/ALGORITHM-SEED]", "DIR")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the training in --out.")
    ] = False,
    show: Annotated[
        bool, typer.Option("--show", help="Print all settings as YAML, and do not train.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")] = False,
    debug: Debug = False,
) -> None:
    """Train agents with PPO, IPPO, MAPPO, HAPPO, HAA2C, HAD3QN or HASAC.

    Writes policies, curves and checkpoints to a folder. What is trained can be used as a
    controller: policy:FOLDER.
    """
    values: dict[str, Any] = {}
    if algorithm is not None:
        values["algorithm"] = algorithm
    for name, value in (("scenario", scenario), ("steps", steps), ("seed", seed)):
        if value is not None:
            values[name] = value
    if site is not None:
        values["sites"] = [name.strip() for name in site.split(",")]
    environment = {"others": others, "rewards": rewards}
    values["environment"] = {k: v for k, v in environment.items() if v is not None}
    if agents is not None:
        values["environment"]["agents"] = _agents(agents)
    chosen = _settings(values, source or [], assigned or [], settings, out if resume else None)
    if show:
        print(chosen.to_yaml(), end="")
        return
    folder = Path("runs") / f"{chosen.algorithm}-{chosen.seed}" if out is None else out
    if resume and out is None:
        raise ConfigError("--resume: without --out; valid is with the folder of a training")
    _require_torch()
    from sdc_taichi.learning.trainer import train

    with interruptible() as interrupted, progress_of_training(shown=not quiet) as on_update:
        done = train(chosen, folder, resume=resume, on_update=on_update, stop=interrupted)
    if not quiet:
        _print_summary(done)
    if not done.is_whole:
        print(
            f"interrupted after {done.steps:,} steps; go on with: sdc-taichi train --resume --out "
            f"{printable(folder)}",
            file=sys.stderr,
        )
        raise typer.Exit(EXIT_INTERRUPTED)


def _settings(
    given: dict[str, Any],
    source: list[str],
    assigned: list[str],
    file: Path | None,
    resumed: Path | None,
) -> TrainingSettings:
    """Settings of a file or of the training that is resumed, with those given on top."""
    from sdc_taichi.config import apply_override
    from sdc_taichi.learning.training_folder import settings_of
    from sdc_taichi.learning.training_settings import (
        make_settings,
        merged,
        read_values,
    )

    values: dict[str, Any] = {}
    if resumed is not None:
        values = settings_of(resumed).model_dump(mode="json")
    if file is not None:
        values = merged(values, read_values(file))
    values = merged(values, given)
    configs = [text for text in source if "=" not in text or Path(text).is_file()]
    if len(configs) > 1:
        raise ConfigError(
            f"{configs[1]!r}: a second preset or file after {configs[0]!r}; valid is one, and "
            "overrides section.key=value"
        )
    if configs:
        values["config"] = configs[0]
    for text in source:
        if text not in configs:
            apply_override(values.setdefault("overrides", {}), text)
    for text in assigned:
        apply_override(values, text)
    if "algorithm" not in values:
        raise ConfigError(
            "ALGORITHM: missing; valid: ppo, ippo, mappo, happo, haa2c, had3qn, hasac"
        )
    return make_settings(values, "train")


def _agents(text: str) -> list[str]:
    """Agents by the names of what they command, or by their own."""
    from sdc_taichi.envs.agents import AGENTS, COMMAND_OF_AGENT

    by_name = {command: agent for agent, command in COMMAND_OF_AGENT.items()}
    by_name |= {agent: agent for agent in AGENTS}
    found = []
    for name in (part.strip() for part in text.split(",")):
        if name not in by_name:
            raise ConfigError(f"--agents {text!r}: {name!r}{suggestion_or_valid(name, by_name)}")
        found.append(by_name[name])
    return found


def _require_torch() -> None:
    """Refuse to train without PyTorch.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import torch  # noqa: F401
    except ImportError:
        raise ConfigError(
            'training needs PyTorch, which is not installed: pip install "sdc-taichi[train]"'
        ) from None


@contextlib.contextmanager
def progress_of_training(*, shown: bool) -> Iterator[Callable[[Progress], None]]:
    """Show how far a training has come on stderr: a bar in a terminal, lines elsewhere.

    Args:
        shown: whether to show it at all.

    Yields:
        A function to call after every update.
    """
    if not shown:
        yield lambda _: None
    elif sys.stderr.isatty():
        with rich_progress() as progress:
            task = progress.add_task("training", total=None)

            def advance(now: Progress) -> None:
                progress.update(
                    task, completed=now.update, total=now.updates, description=_line(now)
                )

            yield advance
    else:
        told = -SECONDS_BETWEEN_LINES

        def tell(now: Progress) -> None:
            nonlocal told
            is_last = now.update == now.updates
            if is_last or now.share is not None or now.passed_s - told >= SECONDS_BETWEEN_LINES:
                told = now.passed_s
                print(f"{now.update}/{now.updates}: {_line(now)}", file=sys.stderr, flush=True)

        yield tell


def _line(now: Progress) -> str:
    """Progress in a few words."""
    parts = [f"{now.steps:,} steps, {now.steps_per_s:,.0f}/s, {_duration(now.left_s)} left"]
    returns = {n.partition("/")[2]: x for n, x in now.numbers.items() if n.startswith("return/")}
    if returns:
        parts.append("return " + " ".join(f"{name} {value:.4g}" for name, value in returns.items()))
    if now.share is not None:
        parts.append(f"{100 * now.share:.1f} % of the achievable")
    return "; ".join(parts)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _print_summary(done: Training) -> None:
    """Say what a training left behind."""
    speed = f"{done.steps:,} steps in {done.updates:,} updates, {_duration(done.seconds)}"
    print(f"{speed}; files in {printable(done.folder)}")
    if done.best_share is not None:
        share = f"{100 * done.best_share:.1f} % of the achievable in the validation weeks"
        print(f"Best policy: {share}")
    print(f"Use it with: --controller policy:{printable(done.folder)}")
