"""The best value of a field by month, beside the best fixed one and that of the config."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.benchmark.sweep import Sweep
from sdc_taichi.benchmark.vary import Grid, value_at
from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F64

if TYPE_CHECKING:
    import pandas as pd

ALL_MONTHS = "all"
"""Month of the row of all months together."""


def chosen_grid(sweep: Sweep) -> Grid:
    """The field whose best value is looked for: the first grid of two or more numbers.

    Raises:
        ConfigError: the sweep has no months, or no such field.
    """
    if not sweep.months:
        raise ConfigError("best: the runs are not by month; valid is --months all or --months 1,7")
    for one in sweep.varied:
        if isinstance(one, Grid) and one.kind in ("int64", "float64") and len(one.values) > 1:
            return one
    raise ConfigError("best: no field varies in numbers; valid is one, such as START:STOP:STEP")


def with_default(sweep: Sweep) -> Sweep:
    """A sweep whose chosen field also takes the value of the config, if that is a number.

    Raises:
        ConfigError: no field can be chosen.
    """
    grid, default = chosen_grid(sweep), value_at(sweep.config, chosen_grid(sweep).field)
    if not isinstance(default, int | float) or isinstance(default, bool):
        return sweep
    varied = tuple(one.with_value(default) if one is grid else one for one in sweep.varied)
    return replace(sweep, varied=varied)


def group_columns(sweep: Sweep) -> list[str]:
    """Columns that define a group of rows: controller, and the other varied fields or else site."""
    others = [field for field in sweep.fields if field != chosen_grid(sweep).field]
    return ["controller", *(others or ["site"])]


def best_by_month(rows: pd.DataFrame, sweep: Sweep, metric: str) -> pd.DataFrame:
    """The value of least metric in each month, beside fixed values.

    The best fixed value is the one of least sum over all months that are run. A value that lacks a
    month is none, as one that is not valid. Of equal values the first in order counts.

    Args:
        rows: rows of the sweep.
        sweep: the sweep.
        metric: a column of the rows, of which less is better.

    Returns:
        For each group a row for each month and one, ``ALL_MONTHS``, with the means over the months.
        Columns are those of ``group_columns`` and ``month``; ``best``, ``fixed`` and ``default``,
        the last the value of the config, with the metric there, such as ``best_cfp_kg``; and
        ``below_fixed_pct`` and ``below_default_pct``, by how much the best is below them, in %.
    """
    import pandas as pd

    default = value_at(sweep.config, chosen_grid(sweep).field)
    tables = []
    for names, group in _groups(rows, sweep):
        months, values, figures = _table(group, sweep, metric)
        if values.size:
            table = _months(months, values, figures, default, metric)
            for place, (column, name) in enumerate(zip(group_columns(sweep), names, strict=True)):
                table.insert(place, column, name)
            tables.append(table)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def figures_by_month(
    rows: pd.DataFrame, sweep: Sweep, metric: str
) -> list[tuple[str, list[int], F64, F64]]:
    """Figures for pictures: name of each group, its months, its values and the metric there.

    Args:
        rows: rows of the sweep.
        sweep: the sweep.
        metric: a column of the rows.

    Returns:
        For each group its name, M months, V values, (V,), and the metric, (M, V).
    """
    panels = []
    for names, group in _groups(rows, sweep):
        shown = names if len(sweep.controllers) > 1 else names[1:]
        months, values, figures = _table(group, sweep, metric)
        if values.size:
            panels.append((", ".join(map(str, shown)), months, values, figures))
    return panels


def _groups(rows: pd.DataFrame, sweep: Sweep) -> Iterator[tuple[tuple[Any, ...], pd.DataFrame]]:
    """Values of ``group_columns`` and rows of each group, in the order of the rows."""
    columns = group_columns(sweep)
    for names, group in rows.groupby(columns, sort=False, dropna=False, observed=True):
        yield tuple(names), group


def _table(rows: pd.DataFrame, sweep: Sweep, metric: str) -> tuple[list[int], F64, F64]:
    """Months of some rows, values that have all of them, and the metric of each, (M, V)."""
    wide = rows.pivot_table(
        index="month", columns=chosen_grid(sweep).field, values=metric, dropna=False
    )
    whole = wide.reindex(sorted(sweep.months)).dropna(axis=1)
    return list(whole.index), whole.columns.to_numpy(np.float64), whole.to_numpy(np.float64)


def _months(
    months: Sequence[int], values: F64, figures: F64, default: Any, metric: str
) -> pd.DataFrame:
    """Rows of a group: of each month, and of all months together."""
    import pandas as pd

    each = np.arange(len(months))
    best, fixed = figures.argmin(axis=1), figures.sum(axis=0).argmin()
    at_default = np.flatnonzero(values == default)
    nan = np.full(len(months), np.nan)
    table = pd.DataFrame(
        {
            "month": [str(month) for month in months],
            "best": values[best],
            f"best_{metric}": figures[each, best],
            "fixed": values[fixed],
            f"fixed_{metric}": figures[:, fixed],
            "default": values[at_default[0]] if at_default.size else nan,
            f"default_{metric}": figures[:, at_default[0]] if at_default.size else nan,
        }
    )
    table.loc[len(months)] = {**table.mean(numeric_only=True), "month": ALL_MONTHS, "best": np.nan}
    for name in ("fixed", "default"):
        table[f"below_{name}_pct"] = 100.0 * (
            1.0 - table[f"best_{metric}"] / table[f"{name}_{metric}"]
        )
    return table
