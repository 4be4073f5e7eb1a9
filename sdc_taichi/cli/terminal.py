"""The terminal of a command: exit codes, tables, notes, warnings, Ctrl-C and progress."""

from __future__ import annotations

import contextlib
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TextIO

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
"""Exit codes of a command that failed, that refused its input, and that Ctrl-C ended."""
MOST_COLUMNS = 12
"""Largest number of data centers that have a column each in a table."""
SECONDS_BETWEEN_LINES = 30.0
"""Least time between two lines of progress where there is no terminal."""


class PlainConsole(Console):
    """A console that reads no markup in texts, and escapes what a terminal would obey."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text as it is shown; every string of a line or table passes here."""
        return super().render_str("\n".join(map(printable, text.split("\n"))), **options)


def wide_console(width: int) -> PlainConsole:
    """A console on standard output, with a given width where that is a pipe or a file."""
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
    from sdc_taichi.optimum import StoppedError

    try:
        yield
    except StoppedError as error:
        print(f"interrupted: {one_line(str(error))}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


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
