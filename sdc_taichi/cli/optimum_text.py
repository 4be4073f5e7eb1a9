"""The table of ``sdc-taichi optimum``, and what its figures are, in the terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

TABLE_DCS = 12
"""Number of data centers up to which each has a column of its own."""
MOST_LINES = 12
"""Number of remarks on single data centers up to which all are printed."""


def print_optimum(content: Mapping[str, Any], steps_per_hour: int) -> None:
    """Print the figures of an optimum, and what they are.

    Args:
        content: content of optimum.json.
        steps_per_hour: number of steps in an hour.
    """
    from sdc_taichi.cli.terminal import PlainConsole
    from sdc_taichi.run.optimum_folder import optimum_remarks

    # A pipe or a file has no width to fit into.
    width = None if sys.stdout.isatty() else 200
    console = PlainConsole(highlight=False, width=width, soft_wrap=True)
    dcs, scored = content["data_centers"], content["steps"] - content["scored_from"]
    days = scored / steps_per_hour / 24
    count = "1 data center" if len(dcs) == 1 else f"{len(dcs)} data centers"
    warm_up = content["scored_from"] / steps_per_hour / 24
    after = f" after a warm-up of {_days(warm_up)}" if warm_up else ""
    console.print(f"Optimum of {content['objective']}: {count}, {_days(days)}{after}")
    table = _table(content)
    if len(dcs) > TABLE_DCS or console.measure(table).maximum > console.width:
        table = _spread(content)
    console.print(table)
    remarks = optimum_remarks(content)
    for line in remarks[:MOST_LINES]:
        console.print(line)
    if len(remarks) > MOST_LINES:
        console.print(f"and {len(remarks) - MOST_LINES} more, see --json")


def _titles(content: Mapping[str, Any]) -> list[str]:
    """Titles of the rows."""
    return [
        f"idle ({content['unit']})",
        "bound (% against idle)",
        "achieved (% against idle)",
        "gap (points)",
        *(f"{name} alone (%)" for name in content["total"]["alone"]),
        *(f"{each['controller']} (% of the achievable)" for each in content["controllers"]),
    ]


def _values(figures: Mapping[str, Any], shares: Sequence[float | None]) -> list[float | None]:
    """Values of the rows of a data center, or of all."""
    idle = figures["idle"]

    def change(value: float | None) -> float | None:
        return None if value is None or not idle else 100.0 * (value / idle - 1.0)

    alone = [change(value) for value in figures["alone"].values()]
    own = [None if share is None else 100.0 * share for share in shares]
    both = change(figures["bound"]), change(figures["achieved"])
    return [idle, *both, figures["gap_points"], *alone, *own]


def _columns(content: Mapping[str, Any]) -> list[list[float | None]]:
    """Values of the rows of each data center."""
    shares = [each["data_centers"] for each in content["controllers"]]
    return [
        _values(dc, [own[i]["share"] for own in shares])
        for i, dc in enumerate(content["data_centers"])
    ]


def _table(content: Mapping[str, Any]) -> Table:
    """A column for each data center, and one for all of several."""
    names, columns = [dc["name"] for dc in content["data_centers"]], _columns(content)
    if len(names) > 1:
        names, columns = [*names, "all"], [*columns, _total(content)]
    rows = zip(_titles(content), *columns, strict=True)
    return _of_rows(names, rows)


def _spread(content: Mapping[str, Any]) -> Table:
    """Lowest, mean and highest value of the data centers, and that of all."""
    rows = []
    for title, total, *values in zip(
        _titles(content), _total(content), *_columns(content), strict=True
    ):
        known = [value for value in values if value is not None]
        spread = [min(known), sum(known) / len(known), max(known)] if known else [None] * 3
        rows.append([title, *spread, total])
    return _of_rows(["lowest", "mean", "highest", "all"], rows)


def _of_rows(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> Table:
    """A table of rows, each a title and its values."""
    from rich.table import Table

    table = Table("")
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    for title, *values in rows:
        table.add_row(title, *map(_figure, values))
    return table


def _total(content: Mapping[str, Any]) -> list[float | None]:
    """Values of the rows of all data centers together."""
    return _values(content["total"], [each["share"] for each in content["controllers"]])


def _days(count: float) -> str:
    """A number of days."""
    return f"{count:g} day" + ("" if count == 1 else "s")


def _figure(value: float | None) -> str:
    """A value with two decimals, or whole with separators from 1000 on; a dash where none is."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:z.2f}"
