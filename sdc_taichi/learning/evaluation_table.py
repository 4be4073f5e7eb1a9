"""Result tables of an evaluation (by controller, site, agent, and pair), and their output folder.

A "figure" is the value of the objective. If the optimum is known, it also determines the value of
stored energy and waiting work at the end, which the figures then include. Confidence intervals are
those of ``statistics.bootstrap_interval``, with the same random draws for all rows of a table.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import ConfigError, SdcError, printable
from sdc_taichi.learning.evaluation import ALL, IDLE, MOVES, DataCenterWeeks, Evaluation
from sdc_taichi.learning.policy import Policy
from sdc_taichi.learning.statistics import (
    Statistic,
    bootstrap_interval,
    change_pct,
    interquartile_mean,
    probability_of_improvement,
    share_pct,
)
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.run.achievable import OPTIMUM
from sdc_taichi.types import F64
from sdc_taichi.user_file import list_folder

if TYPE_CHECKING:
    import pandas as pd

_SEED = 0
"""Seed of the bootstrap for confidence intervals."""
_AGAINST_IDLE = {
    "carbon_pct": "cfp_kg",
    "energy_pct": "grid_kwh",
    "water_pct": "water_l",
    "cost_pct": "cost",
    "peak_pct": "peak_kw",
}
"""Metric from which each column with a change relative to idle commands is computed."""
TITLES = {
    "controller": "controller",
    "moves": "moves",
    "trainings": "seeds",
    "change_pct": "against idle (%)",
    "interquartile_mean_pct": "interquartile mean (%)",
    "share_pct": "share (%)",
    "alone_pct": "optimum alone (%)",
    "carbon_pct": "carbon (%)",
    "energy_pct": "energy (%)",
    "water_pct": "water (%)",
    "cost_pct": "cost (%)",
    "peak_pct": "peak (%)",
    "over_27_degree_h": "over 27 C (K h)",
    "overdue_task_h": "overdue (task h)",
    "dropped_pct": "dropped (%)",
    "broken_pct": "broken weeks (%)",
    "than": "than",
    "points": "difference (points)",
    "probability": "improves (probability)",
}
"""Title of each column in printed tables."""


def summary(evaluation: Evaluation) -> pd.DataFrame:
    """Return the results over all weeks, a row for each controller.

    ``change_pct`` is the change of the objective relative to idle commands, in %, after summing
    over all weeks; ``carbon_pct``, ``energy_pct`` and so on are the same for single metrics.
    ``interquartile_mean_pct`` is the interquartile mean of the changes of single weeks.
    ``share_pct`` is the saving as a share of the achievable saving. These three have a 95 %
    interval with ends ``_low`` and ``_high``; single metrics have none. ``over_27_degree_h`` (K h,
    mean over the servers) and ``overdue_task_h`` are means per week. ``dropped_pct`` is the share
    of arrived work that was dropped, and ``broken_pct`` is the share of weeks that violate a
    constraint of the optimum.
    """
    import pandas as pd

    return pd.DataFrame(
        [
            {"controller": name, "trainings": len(_sample(rows, "figure"))}
            | _results(evaluation, rows)
            for name, rows in _groups(evaluation, ALL)
        ]
    )


def by_site(evaluation: Evaluation) -> pd.DataFrame:
    """Return the change against idle commands, in %, a row per controller and column per site."""
    import pandas as pd

    sites = list(dict.fromkeys(evaluation.rows["site"])) if len(evaluation.rows) else []
    table = []
    for name, rows in _groups(evaluation, ALL):
        rows_by_site = {site: rows[rows["site"] == site] for site in sites}
        changes = {
            site: float(change_pct(_sample(site_rows, _column(evaluation)), _base(site_rows)))
            for site, site_rows in rows_by_site.items()
        }
        table.append({"controller": name} | changes)
    return pd.DataFrame(table)


def by_agent(evaluation: Evaluation) -> pd.DataFrame:
    """Return results with one acting agent and idle others, a row per agent and controller.

    The table has the columns of ``summary`` and ``alone_pct``, the change in % that the optimum
    achieves with this agent alone. The table is empty if no agent ran alone.
    """
    import pandas as pd

    table = []
    for agent in MOVES:
        best = evaluation.alone.get(agent)
        for name, rows in _groups(evaluation, agent):
            alone = math.nan if best is None else float(change_pct(best[None], _base(rows)))
            row = {"moves": agent, "controller": name, "alone_pct": alone}
            table.append(row | _results(evaluation, rows, best))
    return pd.DataFrame(table)


def differences(evaluation: Evaluation, controller: str) -> pd.DataFrame:
    """Compare one controller with each other controller in the same weeks.

    Returns:
        Table with a row for each other controller. ``points`` is the controller's change against
        idle commands minus the other's, in percentage points (negative is better), with the ends of
        a 95 % interval. ``probability`` is the probability, 0..1, that a training of the controller
        has a lower objective in a week than the other controller.
    """
    import pandas as pd

    groups = dict(_groups(evaluation, ALL))
    figures, base = _sample(groups[controller], _column(evaluation)), _base(groups[controller])

    def points(one: F64, idle: F64, other: F64, other_idle: F64) -> F64:
        return np.asarray(change_pct(one, idle) - change_pct(other, other_idle))

    table = []
    for name, rows in groups.items():
        if name == controller:
            continue
        others = _sample(rows, _column(evaluation))
        row: dict[str, Any] = {"controller": controller, "than": name}
        row |= _interval(evaluation, "points", points, figures, base, others, _base(rows))
        table.append(row | {"probability": float(probability_of_improvement(figures, others))})
    return pd.DataFrame(table)


def samples(evaluation: Evaluation, moves: str = ALL) -> dict[str, tuple[F64, F64]]:
    """Return the objective values of each controller and of idle commands.

    Args:
        evaluation: the evaluation.
        moves: agents that acted: ``all``, or one of load, cooling and battery.

    Returns:
        For each controller, its objective values by training and week, (S, W), and those of idle
        commands, (1, W), or (S, W) if they depend on the seed.
    """
    return {
        name: (_sample(rows, _column(evaluation)), _base(rows))
        for name, rows in _groups(evaluation, moves)
    }


def column_samples(evaluation: Evaluation, column: str) -> dict[str, F64]:
    """Return a column's values by training and week, (S, W), for each controller.

    Only runs in which all agents of the controller acted are included.
    """
    return {name: _sample(rows, column) for name, rows in _groups(evaluation, ALL)}


def text_rows(
    table: pd.DataFrame, titles: Mapping[str, str] = TITLES
) -> tuple[list[str], list[list[str]]]:
    """Return titles and cells of a table as text, with intervals in brackets and a dash for nan.

    Args:
        table: one of the tables of this module.
        titles: title of each column; the default is the column's name.
    """
    shown = [str(name) for name in table.columns if not str(name).endswith(("_low", "_high"))]
    rows = []
    for values in table.to_dict("records"):
        cells = []
        for name in shown:
            decimals = 3 if name == "probability" else 2
            text = _cell(values[name], decimals)
            low, high = values.get(f"{name}_low"), values.get(f"{name}_high")
            if low is not None and high is not None and high - low > 1e-9:
                text += f" ({_cell(low, decimals)} to {_cell(high, decimals)})"
            cells.append(text)
        rows.append(cells)
    return [titles.get(name, name) for name in shown], rows


def markdown(table: pd.DataFrame, titles: Mapping[str, str] = TITLES) -> str:
    """Return a table as Markdown, with special characters escaped.

    Args:
        table: one of the tables of this module.
        titles: title of each column; the default is the column's name.
    """
    heads, rows = text_rows(table, titles)
    lines = [" | ".join(map(literal_markdown, cells)) for cells in (heads, *rows)]
    lines = [f"| {line} |" for line in lines]
    return "\n".join([lines[0], "|---" + "|---:" * (len(heads) - 1) + "|", *lines[1:]])


def literal_markdown(text: str) -> str:
    """Return a text as one line of Markdown, with special characters escaped."""
    return re.sub(r"([\\`*_\[\]<>|])", r"\\\1", printable(" ".join(text.split())))


def _groups(evaluation: Evaluation, moves: str) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield name and rows of each controller, out of the runs with this value of ``moves``."""
    rows = evaluation.rows
    if len(rows):
        for name, group in rows[rows["moves"] == moves].groupby("controller", sort=False):
            yield str(name), group


def _results(
    evaluation: Evaluation, rows: pd.DataFrame, best: F64 | None = None
) -> dict[str, float]:
    """Return the results of one controller, by column of ``summary``.

    Args:
        evaluation: the evaluation.
        rows: rows of the controller.
        best: objective values that count as a share of 100 %, (B,); None selects the achieved
            path of the optimum of all agents.
    """
    base, figures = _base(rows), _sample(rows, _column(evaluation))
    achieved = _sample(rows, "achieved_figure")[:1] if best is None else best[None]
    changes = 100.0 * (figures / base - 1.0)
    idle = dict(_groups(evaluation, ALL)).get(IDLE)
    arrived = rows["arrived_tasks"].sum(skipna=False)
    # Rows without metrics are bounds of the optimum, which violate no constraint.
    checked = rows["broken"][rows["broken"].notna() & rows["cfp_kg"].notna()]
    return {
        **_interval(evaluation, "change_pct", change_pct, figures, base),
        **_interval(evaluation, "interquartile_mean_pct", interquartile_mean, changes),
        **_interval(evaluation, "share_pct", share_pct, figures, base, achieved),
        **{
            name: math.nan
            if idle is None
            else float(change_pct(_sample(rows, metric), _sample(idle, metric)))
            for name, metric in _AGAINST_IDLE.items()
        },
        "over_27_degree_h": float(rows["over_27_degree_h"].mean()),
        "overdue_task_h": float(rows["overdue_task_h"].mean()),
        "dropped_pct": 100.0 * float(rows["dropped_tasks"].sum() / arrived) if arrived else 0.0,
        "broken_pct": 100.0 * float((checked != "").mean()) if len(checked) else math.nan,
    }


def _interval(
    evaluation: Evaluation, name: str, statistic: Statistic, *samples: F64
) -> dict[str, float]:
    """Return table columns of a statistic and its interval; all rows use the same random draws."""
    generator = np.random.Generator(np.random.PCG64(_SEED))
    paired = len(_base(evaluation.rows)) > 1
    interval = bootstrap_interval(statistic, samples, evaluation.strata, generator, paired=paired)
    return interval.columns(name)


def _column(evaluation: Evaluation) -> str:
    """Return the name of the column with the objective values to compare."""
    has_optimum = bool(evaluation.rows["achieved_figure"].notna().any())
    return "valued_figure" if has_optimum else "figure"


def _base(rows: pd.DataFrame) -> F64:
    """Return the objective of idle commands, (1, W), or (S, W) if it depends on the seed."""
    base = _sample(rows, "idle_figure")
    return base[:1] if np.array_equal(base, np.broadcast_to(base[:1], base.shape)) else base


def _sample(rows: pd.DataFrame, column: str) -> F64:
    """Return a column's values by training and week, (S, W); weeks stay in row order."""
    width = len(set(zip(rows["site"], rows["year"], rows["week"], strict=True)))
    return rows[column].to_numpy(np.float64).reshape(-1, width)


def _cell(value: Any, decimals: int = 2) -> str:
    """Return a table value as text; numbers that are not finite become a dash."""
    if isinstance(value, str):
        return value
    if isinstance(value, int | np.integer):
        return str(value)
    return "-" if not math.isfinite(value) else f"{value:z.{decimals}f}"


def is_compared(name: str) -> bool:
    """Return True unless the name stands for idle commands or the optimum (the references)."""
    return name not in (IDLE, OPTIMUM)


FORMAT = "sdc-evaluation/1"
"""Format version in ``evaluation.json``."""
EVALUATION_FILE, ROWS_FILE, TABLE_FILE = "evaluation.json", "rows.csv", "table.md"
"""Names of the files of an evaluation."""


def evaluation_content(
    evaluation: Evaluation,
    weeks: DataCenterWeeks,
    *,
    command: str = "",
    folders: Sequence[Path] = (),
) -> dict[str, Any]:
    """Return the content of ``evaluation.json``.

    Args:
        evaluation: the evaluation.
        weeks: the weeks of the evaluation.
        command: command line that reproduces the evaluation.
        folders: folders of the evaluated trainings or policies.
    """
    names = [n for n in dict.fromkeys(evaluation.rows.get("controller", ())) if is_compared(n)]
    return {
        "format": FORMAT,
        "version": version("sdc-taichi"),
        "command": command,
        "objective": str(weeks.objective),
        "unit": weeks.objective.unit,
        "sites": list(dict.fromkeys(weeks.sites)),
        "years": list(dict.fromkeys(weeks.years)),
        "weeks": list(dict.fromkeys(weeks.weeks)),
        "steps": weeks.steps,
        "scored_from": weeks.scored_from,
        "seed": weeks.seed,
        "forecast_error": asdict(weeks.forecast_error),
        "fingerprint": weeks.sim.fingerprint(),
        "has_optimum": weeks.optimum is not None,
        "policies": [{"folder": str(f), **Policy.load(f).about.model_dump()} for f in folders],
        "summary": _records(summary(evaluation)),
        "by_site": _records(by_site(evaluation)),
        "by_agent": _records(by_agent(evaluation)),
        "differences": _records(differences(evaluation, names[0])) if names else [],
        "missing": list(evaluation.missing),
        "remarks": remarks(weeks),
    }


def remarks(weeks: DataCenterWeeks) -> list[str]:
    """Return warnings about weeks in which energy and work left at the end have no value."""
    if weeks.optimum is None:
        return ["Without an optimum ends have no value: an empty battery or work put off saves."]
    if not isinstance(weeks.optimum, Optimum):
        return []
    names, kinds = weeks.optimum.names, weeks.optimum.bound_kinds
    return [
        f"{name}: bound {kind}; ends that differ have no value there"
        for name, kind in zip(names, kinds, strict=True)
        if kind.startswith("none")
    ]


def tables_of(evaluation: Evaluation, weeks: DataCenterWeeks) -> list[tuple[str, pd.DataFrame]]:
    """Return titles and tables: all weeks together, by site, by agent, and differences."""
    names = [n for n in dict.fromkeys(evaluation.rows["controller"]) if is_compared(n)]
    days = weeks.steps // (24 * weeks.sim.fleet.steps_per_hour)
    scored = "day 2" if days == 2 else f"days 2 to {days}"
    title = f"{weeks.objective}, {scored} of {len(weeks.weeks)} data-center weeks, 95 % intervals"
    tables = [
        (title, summary(evaluation)),
        ("against idle commands by site (%)", by_site(evaluation)),
        ("each agent alone, the others idle", by_agent(evaluation)),
    ]
    if names:
        tables.append((f"{names[0]} against the others", differences(evaluation, names[0])))
    return [(title, table) for title, table in tables if len(table)]


def prepare_evaluation_folder(out: Path, *, force: bool = False) -> None:
    """Create the folder of an evaluation, or check that its files may be replaced.

    Args:
        out: the folder.
        force: True to accept a folder that contains other files.

    Raises:
        SdcError: ``out`` is a file, holds other files, or cannot be created.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out}: is a file; valid is a folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SdcError(f"--out {out}: cannot be made: {error.strerror or error}") from None
    others = [name for name in list_folder(out) if not name.startswith(".")]
    if others and EVALUATION_FILE not in others and not force:
        some = ", ".join(sorted(others)[:3])
        raise ConfigError(
            f"--out {out}: holds other files ({some}); choose another folder, or --force"
        )


def write_evaluation(
    out: Path, evaluation: Evaluation, weeks: DataCenterWeeks, content: Mapping[str, Any]
) -> None:
    """Write ``rows.csv``, ``table.md`` and, last, ``evaluation.json``.

    Raises:
        SdcError: a file cannot be written.
    """
    tables = [
        text
        for title, table in tables_of(evaluation, weeks)
        for text in (f"## {title[:1].upper()}{title[1:]}", markdown(table))
    ]
    texts = {
        ROWS_FILE: evaluation.rows.to_csv(index=False),
        TABLE_FILE: "\n\n".join([*tables, *content["remarks"], f"    {content['command']}"]) + "\n",
        EVALUATION_FILE: content_json(content),
    }
    for name, text in texts.items():
        with atomic_write(out / name) as file:
            file.write(text.encode())


def content_json(content: Mapping[str, Any]) -> str:
    """Return the content of ``evaluation.json`` as text."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _records(table: pd.DataFrame) -> Any:
    """Return the rows of a table as dicts for JSON, with None in place of nan."""
    return table.astype(object).where(table.notna(), None).to_dict("records")
