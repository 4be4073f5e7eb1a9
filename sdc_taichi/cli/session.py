"""Warnings, Ctrl-C, the progress bar and the Rerun recording during a command."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import typer

from sdc_taichi.cli.scenario import EXIT_INTERRUPTED
from sdc_taichi.errors import ConfigError, SdcWarning, one_line, printable

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from sdc_taichi.run.description import RunRequest
    from sdc_taichi.sim.simulator import Simulator
    from sdc_taichi.types import StepResult
    from sdc_taichi.viz.recorder import Recorder


def print_notes(notes: Iterable[str]) -> None:
    """Print what was found out about the inputs of a run, on stderr."""
    for note in notes:
        print(f"note: {printable(note)}", file=sys.stderr)


@contextlib.contextmanager
def warnings_in_lines() -> Iterator[None]:
    """Print each warning of the package once, as one line on stderr."""
    with warnings.catch_warnings():
        show = warnings.showwarning
        shown: set[str] = set()

        def show_once(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, SdcWarning):
                show(message, category, filename, lineno, file, line)
            elif str(message) not in shown:
                shown.add(str(message))
                print(f"warning: {one_line(str(message))}", file=sys.stderr)

        warnings.simplefilter("always", SdcWarning)
        warnings.showwarning = show_once
        yield


@contextlib.contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Catch Ctrl-C and SIGTERM; a second one ends the program at once.

    Yields:
        A function that says whether the run is to end.
    """
    signals: list[int] = []

    def handle(number: int, _frame: object) -> None:
        if signals:
            raise KeyboardInterrupt
        signals.append(number)

    before = {s: signal.signal(s, handle) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(signals)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def exit_if_stopped() -> Iterator[None]:
    """End the command where Ctrl-C or SIGTERM ends the work on an optimum.

    Raises:
        typer.Exit: the work was stopped; how much of it is kept has been printed.
    """
    from sdc_taichi.optimum.result import StoppedError

    try:
        yield
    except StoppedError as error:
        print(f"interrupted: {one_line(str(error))}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def make_recorder(
    target: str | None, focus: str | None, every: int | None, serve: bool, port: int | None
) -> Recorder | None:
    """The recorder that the options ask for; None if they ask for no recording.

    Args:
        target: file or address of ``--record``.
        focus: names of ``--focus``.
        every: steps of ``--every``.
        serve: whether ``--serve`` is given.
        port: port of ``--serve-port``.

    Raises:
        SdcError: options of a recording without one, or a recording that cannot be made.
    """
    from sdc_taichi.viz.recording_target import DEFAULT_PORT, is_address

    if serve or port is not None:
        port = DEFAULT_PORT if port is None else port
    elif target is None:
        for name, value in (("--focus", focus), ("--every", every)):
            if value is not None:
                raise ConfigError(
                    f"{name}: given without a recording; valid with --record, --serve"
                )
        return None
    from sdc_taichi.viz.recorder import Recorder

    if target is not None and target.endswith(".rrd") and not is_address(target):
        with contextlib.suppress(OSError):  # the recorder says what is wrong with it
            Path(target).parent.mkdir(parents=True, exist_ok=True)
    names = None if focus is None else [name.strip() for name in focus.split(",")]
    return Recorder(target, focus=names, every=every, serve_port=port)


@contextlib.contextmanager
def recording(
    recorder: Recorder | None, sim: Simulator, request: RunRequest
) -> Iterator[Callable[[StepResult], None]]:
    """Keep a recording open while a run lasts, if there is a recorder.

    Args:
        recorder: what records; None records nothing.
        sim: the simulator, before its first step.
        request: what it is to do.

    Yields:
        A function to call with the result of every step.
    """
    if recorder is None:
        yield lambda _: None
        return
    from sdc_taichi.run.description import describe_run

    with recorder:
        recorder.begin(sim, describe_run(sim, request))
        if recorder.served_address is not None:
            command = f"sdc-taichi view {recorder.served_address}"
            print(f"serving the run; watch it with: {command} [--web]", file=sys.stderr)
        yield recorder.add


def print_recording(recorder: Recorder | None) -> None:
    """Print where the recording of a run is, if it is a file."""
    if recorder is not None and recorder.file is not None and not recorder.failed:
        file = printable(recorder.file)
        print(f"Recording: {file} (open with: sdc-taichi view {file})")


def serve_until_interrupted(recorder: Recorder | None, interrupted: Callable[[], bool]) -> None:
    """Keep a run that is done on show until Ctrl-C, if it is served to viewers."""
    if recorder is None or recorder.served_address is None or recorder.failed:
        return
    recorder.flush()
    if not interrupted():
        text = f"the run is done and still served at {recorder.served_address}; Ctrl-C ends it"
        print(text, file=sys.stderr)
    while not interrupted():
        time.sleep(0.1)


@contextlib.contextmanager
def progress_bar(steps: int, *, shown: bool) -> Iterator[Callable[[StepResult], None]]:
    """Show a progress bar on stderr, if that is a terminal.

    Args:
        steps: number of steps of the run.
        shown: whether to show it at all.

    Yields:
        A function to call with the result of every step.
    """
    if not shown or not sys.stderr.isatty():
        yield lambda _: None
        return
    every = max(1, steps // 1000)
    with rich_progress() as progress:
        task = progress.add_task("simulating", total=steps)

        def advance(result: StepResult) -> None:
            if result.step % every == 0:
                progress.update(task, completed=result.step + 1)

        yield advance


@contextlib.contextmanager
def stage_bars(*, shown: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar for each stage of a piece of work on stderr, if that is a terminal.

    Args:
        shown: whether to show them at all.

    Yields:
        A function to call with the name of a stage, how much of it is done, and how much there is.
    """
    if not shown or not sys.stderr.isatty():
        yield lambda _stage, _done, _total: None
        return
    with rich_progress() as progress:
        tasks: dict[str, TaskID] = {}

        def advance(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield advance


def rich_progress() -> Progress:
    """Progress bars on stderr that disappear when they are done."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    text = TextColumn("{task.description}")
    columns = (text, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True), transient=True)
