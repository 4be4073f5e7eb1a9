"""Tables 2 to 7 of the SustainDC paper: our results in the paper's units, with the printed values.

The columns of these tables do not have the units in their headings. "HVAC energy" and "IT energy"
are mean powers in kW. "CFP" is the mean carbon emission of a quarter hour, with a carbon intensity
that is too high by the value of the first hour of the year, because the released code adds noise
with that mean instead of mean 0 (``CI_Manager`` in ``utils/managers.py`` of
github.com/HewlettPackard/dc-rl). "Water usage" is the sum of hourly rates, taken at every quarter
hour. All these values can be computed from the metrics of a run with preset ``sustaindc``.
"""

from __future__ import annotations

import math
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import yaml
from pydantic import Field

from sdc_taichi.benchmark.suite_results import SuiteResults
from sdc_taichi.config.fields import Section, Text
from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.evaluation import ALL
from sdc_taichi.learning.split import UNSCORED_DAYS
from sdc_taichi.learning.statistics import (
    Interval,
    Statistic,
    bootstrap_interval,
    change_pct,
    sample_mean,
)
from sdc_taichi.types import F64

if TYPE_CHECKING:
    import pandas as pd

CONSTANT_ROW = "coldest"
"""Name of the row with constant lowest setpoint, the reference of all other rows."""
_METRICS = ("cfp_kg", "grid_kwh", "hvac_kwh", "it_kwh", "queue_mean_tasks", "water_l")
_QUARTERS_PER_H = 4
_SEED = 0
"""Seed of the bootstrap for confidence intervals."""
_NO_FIGURE = Interval(math.nan, math.nan, math.nan)


PAPER = "paper"
"""Value of ``Suite.accounting`` for tables with the definitions of the SustainDC paper."""
PAPER_UNITS = (
    "Columns are in the units that the printed ones hold, not in those of their headings: mean "
    "powers, carbon of a quarter hour at an intensity that is raised by that of the first hour of "
    "the year, and a sum of hourly rates of water."
)
"""Text that explains the units of the columns."""
_COLUMNS = {
    "cfp_kg": "CFP (kg per quarter hour)",
    "hvac_kw": "HVAC (kW)",
    "it_kw": "IT (kW)",
    "queue_tasks": "task queue",
    "water_m3h": "water (sum of m3/h)",
}
PAPER_TITLES = (
    {
        "table": "table",
        "label": "row",
        "seeds": "seeds",
        "against_constant": f"CFP against {CONSTANT_ROW} (%)",
    }
    | _COLUMNS
    | {f"printed_{name}": f"printed {title}" for name, title in _COLUMNS.items()}
)
"""Title of each column of ``paper_rows``."""


class PaperFigures(NamedTuple):
    """The five values in a row of the paper's tables, with their actual units."""

    cfp_kg: float
    """Mean carbon emission of a quarter hour at the raised carbon intensity, in kg; printed as CFP
    (kgCO2)."""
    hvac_kw: float
    """Mean power of chiller and cooling tower, in kW; printed as HVAC energy (kWh)."""
    it_kw: float
    """Mean power of the servers, in kW; printed as IT energy (kWh)."""
    queue_tasks: float
    """Mean waiting work, in tasks (one task is 1 % of the capacity for one step); printed as task
    queue."""
    water_m3h: float
    """Hourly water rate, summed over all quarter hours, in m3/h; printed as water usage (litre)."""


class PrintedRow(Section):
    """A row of a printed table."""

    label: Text
    """Printed name of the row."""
    figures: PaperFigures
    """Printed values of the row."""


class PaperTable(Section):
    """A table of the SustainDC paper, and the case of suite ``paper`` that reproduces it."""

    number: int
    """Number of the table, 2..7."""
    panel: Annotated[str, Field(pattern="^[a-f]$")]
    """Panel of the paper's figure 4 with the same results, a..f."""
    title: Text
    """Subject of the table."""
    case: str
    """Case of suite ``paper`` with the same data center and months."""
    site: str
    """Site of the data center."""
    noise_base_g_per_kwh: Annotated[float, Field(ge=0, le=2000)]
    """Carbon intensity of the first hour of 2022, in g/kWh, by which the released code raises the
    carbon intensity of all steps."""
    water_steps: Annotated[int, Field(ge=1, le=35_040)]
    """Number of quarter hours in the sum of water rates."""
    rows: dict[str, PrintedRow]
    """Printed rows, by the name of the reproducing row in suite ``paper``."""


@cache
def paper_tables() -> tuple[PaperTable, ...]:
    """Return tables 2 to 7 of the SustainDC paper as printed."""
    text = resources.files("sdc_taichi.data").joinpath("paper_tables.yaml").read_text("utf-8")
    return tuple(PaperTable.model_validate(values) for values in yaml.safe_load(text))


def compared(table: PaperTable, rows: pd.DataFrame, scored_h: float) -> pd.DataFrame:
    """Return our results beside the printed values: printed rows first, then all other rows.

    Args:
        table: the printed table.
        rows: results of the suite, with the columns of ``learning.evaluation`` and ``case``,
            ``row`` and ``seed``.
        scored_h: number of scored hours of each week.

    Returns:
        Table with the columns of ``PAPER_TITLES`` except ``table``, and the ends ``_low`` and
        ``_high`` of 95 % intervals; missing values are nan.

    Raises:
        ConfigError: rows of the case have different weeks.
    """
    import pandas as pd

    in_case = rows[(rows["case"] == table.case) & (rows["site"].str.upper() == table.site)]
    in_case = in_case[(in_case["moves"] == ALL) & in_case["it_kwh"].notna()]
    samples = {
        str(name): _samples(group, table, scored_h)
        for name, group in in_case.groupby("row", sort=False)
    }
    constant = samples.get(CONSTANT_ROW)
    elsewhere = {name for each in paper_tables() for name in each.rows} - set(table.rows)
    names = [*table.rows, *(x for x in samples if x not in table.rows and x not in elsewhere)]
    return pd.DataFrame([_compared_row(name, table, samples.get(name), constant) for name in names])


def _samples(rows: pd.DataFrame, table: PaperTable, scored_h: float) -> F64:
    """Return the values of the five columns by seed and week, (5, S, W); weeks are sorted."""
    ordered = rows.sort_values(["seed", "week"])
    seeds, weeks = ordered["seed"].nunique(), ordered["week"].nunique()
    if seeds * weeks != len(ordered):
        raise ConfigError(
            f"table {table.number}: {len(ordered)} rows of {ordered['row'].iloc[0]} for {seeds} "
            f"seeds and {weeks} weeks; valid is one for each"
        )
    metrics = {name: ordered[name].to_numpy(np.float64) for name in _METRICS}
    carbon_kg = metrics["cfp_kg"] + table.noise_base_g_per_kwh / 1e3 * metrics["grid_kwh"]
    figures = {
        "cfp_kg": carbon_kg / (scored_h * _QUARTERS_PER_H),
        "hvac_kw": metrics["hvac_kwh"] / scored_h,
        "it_kw": metrics["it_kwh"] / scored_h,
        "queue_tasks": metrics["queue_mean_tasks"],
        "water_m3h": metrics["water_l"] / 1e3 / scored_h * table.water_steps,
    }
    return np.stack([figures[name] for name in PaperFigures._fields]).reshape(-1, seeds, weeks)


def _compared_row(
    name: str, table: PaperTable, sample: F64 | None, constant: F64 | None
) -> dict[str, Any]:
    """Return a table row with our values and the printed ones.

    Args:
        name: name of the row.
        table: the printed table.
        sample: our values by column, seed and week, (5, S, W); None if there are no results.
        constant: the same for the row with constant setpoint.
    """
    printed = table.rows.get(name)
    row: dict[str, Any] = {
        "label": name if printed is None else printed.label,
        "seeds": 0 if sample is None else sample.shape[1],
    }
    for index, column in enumerate(PaperFigures._fields):
        ours = _NO_FIGURE if sample is None else _interval(sample_mean, sample[index])
        row |= ours.columns(column) if column == "cfp_kg" else {column: ours.value}
        row[f"printed_{column}"] = math.nan if printed is None else printed.figures[index]
    against_constant = _NO_FIGURE
    if sample is not None and constant is not None:
        if constant.shape[2] != sample.shape[2]:
            raise ConfigError(
                f"table {table.number}: {name} has {sample.shape[2]} weeks and {CONSTANT_ROW} "
                f"{constant.shape[2]}; valid is the same weeks"
            )
        against_constant = _interval(change_pct, sample[0], constant[0])
    return row | against_constant.columns("against_constant")


def _interval(statistic: Statistic, *samples: F64) -> Interval:
    """Return a statistic of samples from one site with its bootstrap interval."""
    strata = np.zeros((samples[0].shape[1], 2), dtype=np.int64)
    generator = np.random.Generator(np.random.PCG64(_SEED))
    return bootstrap_interval(statistic, samples, strata, generator)


def paper_rows(suite: SuiteResults) -> pd.DataFrame:
    """Return our results beside the printed values, for all tables whose cases have results.

    Args:
        suite: results of suite ``paper``.

    Returns:
        Table with the columns of ``PAPER_TITLES`` and the ends ``_low`` and ``_high`` of 95 %
        intervals; missing values are nan.
    """
    import pandas as pd

    tables = {table.number: rows for table, rows in compared_tables(suite)}
    return pd.concat(tables, names=["table"]).reset_index(level=0).reset_index(drop=True)


def compared_tables(suite: SuiteResults) -> list[tuple[PaperTable, pd.DataFrame]]:
    """Return each printed table whose case has results, with its comparison from ``compared``.

    Args:
        suite: results of suite ``paper``.
    """
    import pandas as pd

    tables = []
    for table in paper_tables():
        if (case := suite.cases.get(table.case)) is not None:
            frames = [
                x.frame.assign(case=table.case, row=x.record.partition["row"], seed=x.seed)
                for x in case.results
            ]
            scored_h = 24.0 * (case.settings.days - UNSCORED_DAYS)
            rows = compared(table, pd.concat(frames, ignore_index=True), scored_h)
            tables.append((table, rows))
    return tables
