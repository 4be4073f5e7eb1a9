"""Best value of a swept field in each month, compared with fixed values of the field."""

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
"""Value of column ``month`` in the row of all months together."""


def chosen_grid(sweep: Sweep) -> Grid:
    """Return the field whose best value is searched: the first list of two or more numbers.

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
    """Return the sweep with the configuration's own value added to the chosen field's values.

    The sweep is unchanged if the configuration's value of the field is not a number.

    Raises:
        ConfigError: the sweep has no months, or no field with two or more numbers.
    """
    grid, default = chosen_grid(sweep), value_at(sweep.config, chosen_grid(sweep).field)
    if not isinstance(default, int | float) or isinstance(default, bool):
        return sweep
    varied = tuple(one.with_value(default) if one is grid else one for one in sweep.varied)
    return replace(sweep, varied=varied)


def group_columns(sweep: Sweep) -> list[str]:
    """Return the columns that define a group: controller, and the other varied fields or site."""
    others = [field for field in sweep.fields if field != chosen_grid(sweep).field]
    return ["controller", *(others or ["site"])]


def best_by_month(rows: pd.DataFrame, sweep: Sweep, metric: str) -> pd.DataFrame:
    """Find the value with the lowest metric in each month, and compare it with fixed values.

    The best fixed value has the lowest sum of the metric over all months. Values without results in
    all months are ignored. If several values are equally good, the first is used.

    Args:
        rows: result rows of the sweep.
        sweep: the sweep.
        metric: column of the rows to minimise.

    Returns:
        Table with a row for each group and month, and a row ``ALL_MONTHS`` with the means over the
        months for each group. Besides ``group_columns`` and ``month``, it has the columns ``best``
        (best value of the month), ``fixed`` (best fixed value) and ``default`` (value of the
        configuration), each with its metric, such as ``best_cfp_kg``. ``below_fixed_pct`` and
        ``below_default_pct`` are the savings of the best value, in %.
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
    """Return the data for plots of a metric against month and value of the chosen field.

    Args:
        rows: result rows of the sweep.
        sweep: the sweep.
        metric: column of the rows.

    Returns:
        For each group its name, its M months, its V values, (V,), and the metric, (M, V).
    """
    panels = []
    for names, group in _groups(rows, sweep):
        shown = names if len(sweep.controllers) > 1 else names[1:]
        months, values, figures = _table(group, sweep, metric)
        if values.size:
            panels.append((", ".join(map(str, shown)), months, values, figures))
    return panels


def _groups(rows: pd.DataFrame, sweep: Sweep) -> Iterator[tuple[tuple[Any, ...], pd.DataFrame]]:
    """Yield the values of ``group_columns`` and the rows of each group, in row order."""
    columns = group_columns(sweep)
    for names, group in rows.groupby(columns, sort=False, dropna=False, observed=True):
        yield tuple(names), group


def _table(rows: pd.DataFrame, sweep: Sweep, metric: str) -> tuple[list[int], F64, F64]:
    """Return the months, the values with results in all months, and the metric, (M, V)."""
    wide = rows.pivot_table(
        index="month", columns=chosen_grid(sweep).field, values=metric, dropna=False
    )
    whole = wide.reindex(sorted(sweep.months)).dropna(axis=1)
    return list(whole.index), whole.columns.to_numpy(np.float64), whole.to_numpy(np.float64)


def _months(
    months: Sequence[int], values: F64, figures: F64, default: Any, metric: str
) -> pd.DataFrame:
    """Return the result rows of a group: one for each month, and one for all months together."""
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
