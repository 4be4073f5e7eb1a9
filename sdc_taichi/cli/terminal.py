"""Terminal functions of commands: exit codes, tables, notes, warnings, Ctrl-C and progress."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TextIO

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sdc_taichi.errors import SdcWarning, one_line, printable

if TYPE_CHECKING:
    import pandas as pd
    from rich.progress import Progress, TaskID

    from sdc_taichi.types import StepResult

EXIT_FAILURE, EXIT_INPUT, EXIT_INTERRUPTED = 1, 2, 130
"""Exit codes of the program for failure, invalid input, and interruption by Ctrl-C."""
MOST_COLUMNS = 12
"""Largest number of data centers with one column each in a table."""
SECONDS_BETWEEN_LINES = 30.0
"""Smallest time between two lines of progress if stderr is not a terminal, in s."""
_SECONDS_BETWEEN_BARS = 0.1


class PlainConsole(Console):
    """Rich console that does not interpret markup and escapes control characters."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text with control characters escaped; Rich calls this for every string."""
        return super().render_str("\n".join(map(printable, text.split("\n"))), **options)


def wide_console(width: int) -> PlainConsole:
    """Return a console for standard output, which has a fixed width if that is not a terminal."""
    return PlainConsole(
        highlight=False, width=None if sys.stdout.isatty() else width, soft_wrap=True
    )


def print_table(title: str, table: pd.DataFrame) -> None:
    """Print a table with a title; its first column is left-aligned, the others right-aligned."""
    from sdc_taichi.learning.evaluation_table import text_rows

    console = wide_console(240)
    console.print(title)
    titles, rows = text_rows(table)
    shown = Table()
    for i, head in enumerate(titles):
        shown.add_column(head, justify="right" if i else "left", no_wrap=True)
    for cells in rows:
        shown.add_row(*cells)
    console.print(shown)


def figures_table(
    console: Console,
    titles: Sequence[str],
    names: Sequence[str],
    columns: Sequence[Sequence[float | None]],
    total: Sequence[float | None],
    number_format: str,
) -> Table:
    """Return a table with the figures of each data center, and of all data centers together.

    Each data center has a column if the table fits on the console. Otherwise the columns show
    minimum, mean and maximum over the data centers.

    Args:
        console: console on which the table will be printed.
        titles: titles of the rows.
        names: names of the data centers.
        columns: values of the rows for each data center; None is an unknown value.
        total: values of the rows for all data centers together.
        number_format: format specification of values below 1000.
    """

    def make_table(heads: Sequence[str], values: Sequence[Sequence[float | None]]) -> Table:
        table = Table("")
        for head in heads:
            table.add_column(head, justify="right", no_wrap=True)
        for title, *row in zip(titles, *values, strict=True):
            table.add_row(title, *(figure_text(value, number_format) for value in row))
        return table

    is_fleet = len(names) > 1
    heads = [*names, "all"] if is_fleet else names
    table = make_table(heads, [*columns, total] if is_fleet else columns)
    if len(names) <= MOST_COLUMNS and console.measure(table).maximum <= console.width:
        return table
    spread = [_spread(row) for row in zip(*columns, strict=True)]
    return make_table(["lowest", "mean", "highest", "all"], [*zip(*spread, strict=True), total])


def _spread(values: Sequence[float | None]) -> tuple[float | None, float | None, float | None]:
    """Return minimum, mean and maximum of the known values; all None without known values."""
    known = [value for value in values if value is not None]
    return (min(known), sum(known) / len(known), max(known)) if known else (None, None, None)


def figure_text(value: float | None, number_format: str) -> str:
    """Return a figure as text: formatted, an integer with commas from 1000 on, a dash for None."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else format(value, number_format)


def count_text(number: float, noun: str) -> str:
    """Return a number and a noun, with a plural "s" unless the number is 1."""
    return f"{number:,.10g} {noun}" + ("" if number == 1 else "s")


def first_lines(lines: Sequence[str], most: int, rest: str) -> list[str]:
    """Return the first lines, and a line with the number of further ones.

    Args:
        lines: all lines.
        most: largest number of lines to return unchanged.
        rest: text after the number of further lines, such as ``, see metrics.json``.
    """
    more = len(lines) - most
    return [*lines[:most], f"and {more} more{rest}"] if more > 0 else [*lines]


def print_notes(notes: Iterable[str]) -> None:
    """Print notes on the inputs of a run on stderr."""
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
    """Catch the first Ctrl-C or SIGTERM; a second one raises ``KeyboardInterrupt``.

    Yields:
        A function that returns True after the first signal, so that the run can end in order.
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
def exit_on_interrupt() -> Iterator[None]:
    """End the process at Ctrl-C with a message, during work that leaves no files or processes.

    A ``KeyboardInterrupt`` may be lost while modules are imported and kernels are compiled.
    """

    def handle(*_: object) -> None:
        # Python may be writing to sys.stderr itself.
        os.write(2, b"interrupted; nothing written\n")
        os._exit(EXIT_INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler:  # Ctrl-C is ignored, or ends the process already
        yield
        return
    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def exit_if_stopped() -> Iterator[None]:
    """End the command with a message if Ctrl-C or SIGTERM stopped the solver of an optimum.

    Raises:
        typer.Exit: the solver was stopped; a message on stderr says which results are stored.
    """
    from sdc_taichi.optimum import StoppedError

    try:
        yield
    except StoppedError as error:
        print(f"interrupted: {one_line(str(error))}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


@contextlib.contextmanager
def progress_bar(steps: int, *, shown: bool) -> Iterator[Callable[[StepResult], None]]:
    """Show the progress of a simulation run on stderr, if that is a terminal.

    Yields:
        A function to call with the result of every step.
    """
    with stage_bars(shown=shown) as progress:
        yield lambda result: progress("simulating", result.step + 1, steps)


class StageProgress(Protocol):
    """Progress callback ``(stage, done, total, text)`` of work with several stages."""

    def __call__(self, stage: str, done: int, total: int, text: str | None = None) -> None:
        """Show the progress of a stage.

        Args:
            stage: name of the stage.
            done: number of finished units of work, such as steps.
            total: number of all units of work in the stage.
            text: text beside the bar; None is the name of the stage.
        """


@contextlib.contextmanager
def stage_bars(*, shown: bool) -> Iterator[StageProgress]:
    """Show a progress bar for each stage of some work on stderr, if that is a terminal.

    Yields:
        The progress callback.
    """
    if not shown or not sys.stderr.isatty():
        yield lambda stage, done, total, text=None: None
        return
    with _rich_progress() as progress:
        tasks: dict[str, TaskID] = {}
        updated_s = 0.0

        def advance(stage: str, done: int, total: int, text: str | None = None) -> None:
            nonlocal updated_s
            now_s = time.monotonic()
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            elif done < total and now_s - updated_s < _SECONDS_BETWEEN_BARS:
                return
            updated_s = now_s
            progress.update(tasks[stage], completed=done, total=total, description=text or stage)

        yield advance


class ProgressLines:
    """Printer of progress lines on stderr, at most one per ``SECONDS_BETWEEN_LINES``.

    Commands use it if stderr is not a terminal.
    """

    def __init__(self) -> None:
        self._printed_s = -math.inf

    def print(self, text: str, *, always: bool) -> None:
        """Print a line unless the previous line was printed a short time ago.

        Args:
            text: the line.
            always: True to print the line in any case.
        """
        now_s = time.monotonic()
        if always or now_s - self._printed_s >= SECONDS_BETWEEN_LINES:
            self._printed_s = now_s
            print(text, file=sys.stderr, flush=True)


def _rich_progress() -> Progress:
    """Create progress bars on stderr, which disappear at the end."""
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


def duration(seconds: float) -> str:
    """Return a duration in s as text, ``M:SS`` or from one hour on ``H:MM:SS``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
