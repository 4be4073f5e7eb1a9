"""The terminal of a command: exit codes, tables, notes, warnings, Ctrl-C and progress."""

from __future__ import annotations

import contextlib
import math
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
"""Exit codes: failure, invalid input, and interruption by Ctrl-C."""
MOST_COLUMNS = 12
"""Largest number of data centers that have a column each in a table."""
SECONDS_BETWEEN_LINES = 30.0
"""Least time between two lines of progress where there is no terminal, in s."""
_SECONDS_BETWEEN_BARS = 0.1


class PlainConsole(Console):
    """A console without markup that escapes control characters."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Escaped text; every string of a line or table passes through here."""
        return super().render_str("\n".join(map(printable, text.split("\n"))), **options)


def wide_console(width: int) -> PlainConsole:
    """A console on standard output, of this width if that is a pipe or a file."""
    return PlainConsole(
        highlight=False, width=None if sys.stdout.isatty() else width, soft_wrap=True
    )


def print_table(title: str, table: pd.DataFrame) -> None:
    """Print a table with a title, the first column to the left and the others to the right."""
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
    """Table of the figures of data centers, and of all of them together.

    Each data center has a column where these fit on the console. Otherwise there are columns for
    the lowest, mean and highest value.

    Args:
        console: where the table is to be printed.
        titles: titles of the rows.
        names: names of the data centers.
        columns: values of the rows for each data center; None is an unknown value.
        total: values of the rows for all data centers together.
        number_format: format of values below 1000.
    """

    def made(heads: Sequence[str], values: Sequence[Sequence[float | None]]) -> Table:
        table = Table("")
        for head in heads:
            table.add_column(head, justify="right", no_wrap=True)
        for title, *row in zip(titles, *values, strict=True):
            table.add_row(title, *(figure_text(value, number_format) for value in row))
        return table

    table = made([*names, "all"], [*columns, total]) if len(names) > 1 else made(names, columns)
    if len(names) <= MOST_COLUMNS and console.measure(table).maximum <= console.width:
        return table
    spread = [_spread(row) for row in zip(*columns, strict=True)]
    return made(["lowest", "mean", "highest", "all"], [*zip(*spread, strict=True), total])


def _spread(values: Sequence[float | None]) -> tuple[float | None, float | None, float | None]:
    """Lowest, mean and highest of the known values."""
    known = [value for value in values if value is not None]
    return (min(known), sum(known) / len(known), max(known)) if known else (None, None, None)


def figure_text(value: float | None, number_format: str) -> str:
    """A figure in a format, or whole with separators from 1000 on; a dash if it is unknown."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else format(value, number_format)


def count_text(number: float, noun: str) -> str:
    """A number and a noun, in the plural where that is due."""
    return f"{number:,.10g} {noun}" + ("" if number == 1 else "s")


def first_lines(lines: Sequence[str], most: int, rest: str) -> list[str]:
    """The first of many lines, and a line that counts the others.

    Args:
        lines: the lines.
        most: largest number of lines that are shown.
        rest: where the other lines are, or what they are.
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
    """End the command if Ctrl-C or SIGTERM stops the work on an optimum.

    Raises:
        typer.Exit: the work was stopped; a message says how much of it is stored.
    """
    from sdc_taichi.optimum import StoppedError

    try:
        yield
    except StoppedError as error:
        print(f"interrupted: {one_line(str(error))}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


@contextlib.contextmanager
def progress_bar(steps: int, *, shown: bool) -> Iterator[Callable[[StepResult], None]]:
    """Show the progress of a run on stderr, if that is a terminal.

    Args:
        steps: number of steps of the run.
        shown: whether to show it at all.

    Yields:
        A function to call with the result of every step.
    """
    with stage_bars(shown=shown) as progress:
        yield lambda result: progress("simulating", result.step + 1, steps)


class StageProgress(Protocol):
    """Progress callback of a piece of work that has stages."""

    def __call__(self, stage: str, done: int, total: int, text: str | None = None) -> None:
        """Show how much of a stage is done.

        Args:
            stage: name of the stage.
            done: how much of it is done.
            total: how much there is.
            text: text beside the bar; None is the name of the stage.
        """


@contextlib.contextmanager
def stage_bars(*, shown: bool) -> Iterator[StageProgress]:
    """Show a progress bar for each stage of a piece of work on stderr, if that is a terminal.

    Args:
        shown: whether to show them at all.

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
    """Progress as lines on stderr where there is no terminal: one every half a minute."""

    def __init__(self) -> None:
        self._printed_s = -math.inf

    def print(self, text: str, *, always: bool) -> None:
        """Print a line if the last one is old enough.

        Args:
            text: the line.
            always: print it in any case.
        """
        now_s = time.monotonic()
        if always or now_s - self._printed_s >= SECONDS_BETWEEN_LINES:
            self._printed_s = now_s
            print(text, file=sys.stderr, flush=True)


def _rich_progress() -> Progress:
    """Progress bars on stderr that disappear when they are done."""
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
    """A length of time as minutes and seconds, and hours from one on."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
