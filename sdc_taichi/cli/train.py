"""``sdc-taichi train``: train agents and save their policies."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdc_taichi.cli.options import (
    Quiet,
    Source,
    complete_sites,
    completed_by,
    out_option,
    parse_source,
)
from sdc_taichi.cli.terminal import (
    EXIT_INTERRUPTED,
    ProgressLines,
    duration,
    interruptible,
    stage_bars,
)
from sdc_taichi.errors import ConfigError, printable, suggestion_or_valid

if TYPE_CHECKING:
    from sdc_taichi.learning.evaluation import Validation
    from sdc_taichi.learning.trainer import Progress, Training
    from sdc_taichi.learning.training_settings import TrainingSettings


ENDS_PER_PROGRAMME = 1.3
"""Time for the values of ends of a week, divided by the time for its programmes. Measured with the
default settings and two processors; used for the first estimate only."""


def _algorithms() -> Iterable[str]:
    from sdc_taichi.learning.algorithms import LEARNING_SETTINGS

    return LEARNING_SETTINGS


def train_command(
    algorithm: Annotated[
        str | None,
        typer.Argument(
            metavar="ALGORITHM",
            help="ppo, ippo, mappo, happo, haa2c, had3qn, hasac or cross-entropy.",
            show_default=False,
            autocompletion=completed_by(_algorithms),
        ),
    ] = None,
    source: Source = None,
    site: Annotated[
        str | None,
        typer.Option(
            metavar="SITE[,SITE...]",
            help="Sites to train on. [default: of the config]",
            autocompletion=complete_sites,
        ),
    ] = None,
    steps: Annotated[
        str | None,
        typer.Option(metavar="N", help="Steps of all data centers together. [default: 2e6]"),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, max=2**31 - 1, help="Seed of all random numbers. [default: 0]"),
    ] = None,
    agents: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME]",
            help="Agents that learn: load, cooling, battery, agent_geo, crac, plant, cdu, "
            "power_cap.",
        ),
    ] = None,
    others: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Controller of the other agents. [default: idle]"),
    ] = None,
    rewards: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Rewards by name, or path module:name."),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="carbon, carbon-rich, bill, bill-rich, failures or hall."
        ),
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
    resume: Annotated[bool, typer.Option("--resume", help="Resume the training in --out.")] = False,
    show: Annotated[
        bool, typer.Option("--show", help="Print all settings as YAML, and do not train.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Train agents with PPO, IPPO, MAPPO, HAPPO, HAA2C, HAD3QN, HASAC or cross-entropy search.

    Writes policies, curves and checkpoints to a folder. The policies are a controller:
    policy:FOLDER.
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
    if resume and out is None:
        raise ConfigError("--resume: without --out; valid is with the folder of a training")
    chosen = _settings(values, source, assigned or [], settings, out if resume else None)
    chosen.data_centers_of_sites()  # Refuse unknown fields before anything is shown.
    if show:
        print(chosen.to_yaml(), end="")
        return
    folder = Path("runs") / f"{chosen.algorithm}-{chosen.seed}" if out is None else out
    from sdc_taichi.learning import train

    weeks = chosen.validation_weeks()
    with interruptible() as interrupted, _progress_of_training(weeks, shown=not quiet) as reports:
        done = train(chosen, folder, resume=resume, stop=interrupted, **reports)
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
    changes: dict[str, Any],
    source: list[str] | None,
    assigned: list[str],
    file: Path | None,
    resumed: Path | None,
) -> TrainingSettings:
    """Return the settings of a training.

    They are merged in this order: resumed training, file, ``changes``, config and ``--set``.

    Args:
        changes: settings from options of the command.
        source: preset or file of the data center, and overrides of its fields.
        assigned: values of ``--set``.
        file: YAML file of ``--settings``; None without it.
        resumed: folder of the resumed training; None for a new training.
    """
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
    values = merged(values, changes)
    config, overrides = parse_source(source)
    if config is not None:
        values["config"] = config
    for text in overrides:
        apply_override(values.setdefault("overrides", {}), text)
    for text in assigned:
        apply_override(values, text)
    if "algorithm" not in values:
        from sdc_taichi.learning.algorithms import LEARNING_SETTINGS

        raise ConfigError(f"ALGORITHM: missing; valid: {', '.join(LEARNING_SETTINGS)}")
    return make_settings(values, "train")


def _agents(text: str) -> list[str]:
    """Parse a list of agents, each named by its command (such as ``load``) or its own name."""
    from sdc_taichi.envs.agents import ALL_AGENTS, short_name

    by_name = {short_name(agent): agent for agent in ALL_AGENTS}
    by_name |= {agent: agent for agent in ALL_AGENTS}
    names = []
    for name in (part.strip() for part in text.split(",")):
        if name not in by_name:
            raise ConfigError(f"--agents {text!r}: {name!r}{suggestion_or_valid(name, by_name)}")
        names.append(by_name[name])
    return names


@contextlib.contextmanager
def _progress_of_training(weeks: int, *, shown: bool) -> Iterator[dict[str, Any]]:
    """Show the progress of a training on stderr: bars in a terminal, lines elsewhere.

    Args:
        weeks: number of validation weeks of all sites together.
        shown: True to show progress.

    Yields:
        Keyword arguments ``on_update`` and ``on_stage`` for ``train``.
    """
    if not shown:
        yield {}
        return
    lines, has_lines = ProgressLines(), not sys.stderr.isatty()
    announce = _announcer_of_optima(weeks, lines if has_lines else None)
    with stage_bars(shown=True) as progress:

        def update(now: Progress) -> None:
            progress("training", now.update, now.updates, _line(now))
            if has_lines:
                always = now.update == now.updates or now.validation is not None
                lines.print(f"update {now.update}/{now.updates}: {_line(now)}", always=always)

        def stage(name: str, done: int, total: int) -> None:
            progress(name, done, total)
            announce(name, done, total)

        yield {"on_update": update, "on_stage": stage}


def _announcer_of_optima(
    weeks: int, lines: ProgressLines | None
) -> Callable[[str, int, int], None]:
    """Return a progress callback that says what is solved before a training, and how long it takes.

    Args:
        weeks: number of validation weeks of all sites together.
        lines: printer of further lines; None if bars show the progress.
    """
    begun_s: dict[str, float] = {}
    last_done: dict[str, int] = {}

    def announce(stage: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        if stage == "tables" and not begun_s:  # the first stage, unless all optima are known
            print(
                f"First the optima of {weeks} validation weeks are solved, once: later trainings "
                "read them from the cache. --set validation.optimum=false trains without them.",
                file=sys.stderr,
                flush=True,
            )
        # The battery may be planned again, and then the programmes start anew.
        if done < last_done.get(stage, 0) or stage not in begun_s:
            begun_s[stage] = now_s
        first_piece = done > 0 and not last_done.get(stage)
        last_done[stage] = done
        if stage not in ("programmes", "values of ends") or not done:
            return
        each_s = (now_s - begun_s[stage]) / done
        left_s = each_s * (total - done)
        if stage == "programmes":
            left_s += ENDS_PER_PROGRAMME * each_s * total
        if left_s < 1.0:
            return
        text = f"{stage} of {done}/{total} weeks; training begins in about {duration(left_s)}"
        if lines is not None:
            lines.print(text, always=first_piece)
        elif first_piece:
            print(text, file=sys.stderr, flush=True)

    return announce


def _line(now: Progress) -> str:
    """Return steps, speed, remaining time, returns and validation of an update as one line."""
    parts = [f"{now.steps:,} steps, {now.steps_per_s:,.0f}/s, {duration(now.left_s)} left"]
    returns = {n.partition("/")[2]: x for n, x in now.numbers.items() if n.startswith("return/")}
    if returns:
        parts.append("return " + " ".join(f"{name} {value:.4g}" for name, value in returns.items()))
    if now.validation is not None:
        parts.append(_validation_text(now.validation))
    return "; ".join(parts)


def _validation_text(validation: Validation) -> str:
    """Return change against idle, share of the achievable and broken constraints as text."""
    change = f"{validation.change_pct:+.2f} % against idle"
    share = (
        f", {100.0 * validation.share:.1f} % of the achievable"
        if validation.share == validation.share
        else ""
    )
    broken = (
        f", {validation.broken_weeks} weeks break a constraint" if validation.broken_weeks else ""
    )
    return f"{change}{share}{broken}"


def _print_summary(done: Training) -> None:
    """Print steps and duration of a training, its best policy, and how to use the policy."""
    speed = f"{done.steps:,} steps in {done.updates:,} updates, {duration(done.seconds)}"
    print(f"{speed}; files in {printable(done.folder)}")
    if done.best is not None:
        print(f"Best policy in the validation weeks: {_validation_text(done.best)}")
    print(f"Use it with: --controller policy:{printable(done.folder)}")
