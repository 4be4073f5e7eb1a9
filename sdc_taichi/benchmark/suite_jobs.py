"""Functions that the jobs of a suite run: compute the optima of a site, or run a row with one seed.

The jobs can run on any machine, because their values and inputs contain everything they need. An
optimum is computed once and stored in the files of its job, which are inputs of the rows' jobs.
"""

from __future__ import annotations

import contextlib
import io
import json
import time
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from sdc_taichi.benchmark.cases import (
    agents_of,
    data_centers,
    training_settings,
    weeks_of,
    years_of,
)
from sdc_taichi.benchmark.jobs import Inputs, JobResult
from sdc_taichi.benchmark.result_table import read_suite_rows
from sdc_taichi.benchmark.rules_search import best_rules
from sdc_taichi.benchmark.store import METRICS_FILE, ROWS_FILE, Record
from sdc_taichi.benchmark.suite import Case, Part, Row
from sdc_taichi.benchmark.suite_results import RowMetrics, TrialMetrics
from sdc_taichi.config import validated
from sdc_taichi.control import make_controller
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, short_name
from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.algorithms import gradient_steps
from sdc_taichi.learning.evaluation import (
    ALL,
    METRICS,
    Contender,
    DataCenterWeeks,
    evaluate,
    prepare,
    validate,
)
from sdc_taichi.learning.training_settings import merged
from sdc_taichi.optimum.cache import OptimumCacheWarning
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.run.achievable import AchievedPath, share_of_achievable

if TYPE_CHECKING:
    import pandas as pd

    from sdc_taichi.learning.training_settings import TrainingSettings

_CURVES = ("training.csv", "validation.csv")
"""Learning curves of a training, which are stored with its settings and policy."""
_ROW = "row"
"""Placeholder name of the controller during an evaluation."""
_SECONDS = "seconds"
"""Column of learning curves that differs between repetitions of the same training."""


def solve_reference(values: Mapping[str, Any], _inputs: Inputs) -> JobResult:
    """Compute the optima of a site's weeks, and the value of energy and work left at their ends.

    In held-out weeks, agents that do not plan together are solved for as well.

    Args:
        values: ``case``, ``part``, index of the ``site``, ``year`` or None, and ``objective``.

    Returns:
        Result without rows; its files are cache entries from which ``optimum.solve`` reads the
        optima.
    """
    case, part = Case.model_validate(values["case"]), values["part"]
    config, year = data_centers(case, part)[values["site"]], values["year"]
    with (
        TemporaryDirectory() as folder,
        prepare(
            [config],
            weeks_of(case, part),
            years=() if year is None else (year,),
            objective=values["objective"],
            uncoordinated=part == "held-out",
            days=case.days,
            cache=folder,
        ) as weeks,
    ):
        files = {path.name: path.read_bytes() for path in sorted(Path(folder).glob("*.npz"))}
        assert weeks.optimum is not None
        metrics = {
            "part": part,
            "site": config.name,
            "year": year,
            "weeks": weeks.weeks,
            "idle_figure": weeks.idle.tolist(),
            "achieved_figure": weeks.optimum.achieved.tolist(),
            "bound_figure": weeks.optimum.bound.tolist(),
            "bound_kinds": _bound_kinds(weeks),
        }
    return JobResult(None, metrics, files)


def run_row(values: Mapping[str, Any], inputs: Inputs) -> JobResult:
    """Run a row of a case with one seed: train or choose the controller, and evaluate it.

    Args:
        values: ``case``, ``row``, ``name`` of the row, ``training`` (settings of all trainings),
            ``objective`` and ``seed``; and ``made_by``, the input with the result of the job that
            trained or chose the controller, if this job does not.
        inputs: optima of the weeks and results of other jobs, as archives from ``packed``.

    Returns:
        Result with a table row for each week, with the columns of ``learning.evaluation``; its
        files are policy and learning curves of a training.
    """
    task = _Task.model_validate(values)
    with TemporaryDirectory() as scratch:
        optima = _extracted(inputs, task, Path(scratch))
        made = _made(task, Path(scratch), optima)
        with _weeks(task, "held-out", optima) as weeks:
            rows = _rows(task, made, weeks)
            metrics = _metrics(task, made, weeks)
    rows = rows.drop(columns="training").assign(controller=task.name)
    return JobResult(rows, metrics, made.files, made.training_core_s)


def run_trial(values: Mapping[str, Any], inputs: Inputs) -> JobResult:
    """Train with the settings of a trial, and judge them in the validation weeks.

    Args:
        values: as for ``run_row``.
        inputs: optima of the validation weeks, as archives from ``packed``.

    Returns:
        Result without rows; its metrics are those of the training and its settings ``learning``.
    """
    task = _Task.model_validate(values)
    with TemporaryDirectory() as scratch:
        made = _trained(task, Path(scratch), _extracted(inputs, task, Path(scratch)))
    learning = {"learning": (task.row.train or {})["learning"]}
    return JobResult(None, learning | made.metrics, training_core_s=made.training_core_s)


def _extracted(inputs: Inputs, task: _Task, scratch: Path) -> Path:
    """Extract the inputs of a job into ``optima`` and folders of other jobs; return ``optima``."""
    optima = scratch / "optima"
    optima.mkdir()
    for name, content in inputs.items():
        is_of_rows = name == task.made_by or name in task.trials
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            archive.extractall(scratch / "inputs" / name if is_of_rows else optima)
    return optima


def packed(files: Mapping[str, bytes], metrics: Mapping[str, Any]) -> bytes:
    """Return metrics and files of a job as a reproducible ZIP archive, for use as an input."""
    contents = {**files, METRICS_FILE: json.dumps(metrics, sort_keys=True).encode()}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name in sorted(contents):
            archive.writestr(zipfile.ZipInfo(name), contents[name])
    return out.getvalue()


class _SolvedMetrics(Record):
    """Metrics of a job that computed the optima of a site's weeks, one entry per week."""

    part: Part
    site: str
    year: int | None
    weeks: list[int]
    idle_figure: list[float]
    achieved_figure: list[float]
    bound_figure: list[float | None]
    bound_kinds: list[str]


def _check_without_rows(
    kind: type[Record], _values: Mapping[str, Any], metrics: Mapping[str, Any], rows: bytes
) -> None:
    """Check the metrics of a job whose result has no table rows.

    Raises:
        SdcError: a metric is missing or of another type, or there are rows.
    """
    validated(kind, metrics, METRICS_FILE)
    if rows:
        raise ConfigError(f"{ROWS_FILE}: valid is a result without rows")


check_reference = partial(_check_without_rows, _SolvedMetrics)
"""Check of what is stored for ``solve_reference``."""
check_trial = partial(_check_without_rows, TrialMetrics)
"""Check of what is stored for ``run_trial``."""


def check_row(values: Mapping[str, Any], metrics: Mapping[str, Any], rows: bytes) -> None:
    """Check metrics and table rows that are stored for ``run_row``.

    Args:
        values: values of the job.
        metrics: the metrics.
        rows: content of the Parquet file with the table rows.

    Raises:
        SdcError: a metric or value is missing or not valid, or rows are of other weeks.
    """
    validated(RowMetrics, metrics, METRICS_FILE)
    if values["row"]["best_of"] is not None and metrics.get("chosen") is None:
        raise ConfigError(f"{METRICS_FILE}: chosen: missing")
    frame = read_suite_rows(rows, Path(ROWS_FILE))
    if frame["week"].unique().tolist() != values["case"]["weeks"]:
        raise ConfigError(f"{ROWS_FILE}: column week; valid are the weeks of the case")


class _Task(BaseModel):
    """Values of a job that runs a row of a case with one seed."""

    name: str
    """Name of the row."""
    case: Case
    """Data centers and weeks."""
    row: Row
    """The row (controller, or method that finds one)."""
    training: dict[str, Any]
    """Settings of all trainings of the suite."""
    objective: str
    """Objective by which rows are compared."""
    seed: int
    """Seed of all random numbers."""
    trials: tuple[str, ...] = ()
    """Inputs with results of trials, whose best settings the training has."""
    made_by: str | None = None
    """Input with the result of the job that trained or chose the controller; None if this job
    does."""


@dataclass(frozen=True, slots=True)
class _Made:
    """The controller of a row, with a record of its choice or training."""

    spec: str
    """Name of the controller; empty for an optimum."""
    metrics: dict[str, Any]
    """Metrics of the choice or training, which become metrics of the job."""
    files: dict[str, bytes]
    """Content of policies and learning curves of trainings, by path."""
    agents: tuple[str, ...] = ()
    """Agents (load, cooling, battery) that a trained policy controls."""
    training_core_s: float = 0.0
    """Processor time of the trainings, in s."""


def _made(task: _Task, scratch: Path, optima: Path) -> _Made:
    """Train or choose the controller of a row, if necessary, or take it from another job."""
    if task.made_by is not None:
        return _made_before(task, scratch / "inputs" / task.made_by)
    if task.row.train is not None:
        folders = [scratch / "inputs" / name for name in task.trials]
        tried = [json.loads((x / METRICS_FILE).read_text("utf-8")) for x in folders]
        if not tried:
            return _trained(task, scratch, optima)
        best = min(tried, key=lambda metrics: TrialMetrics.model_validate(metrics).change_pct)
        training = merged(task.training, {"learning": best["learning"]})
        made = _trained(task.model_copy(update={"training": training}), scratch, optima)
        return replace(made, metrics=made.metrics | {"tuned": best["learning"]})
    if task.row.best_of is None:
        return _Made(task.row.controller or "", {}, {})
    changes: dict[str, float] = {}
    with _weeks(task, "validation", optima) as weeks:

        def change_pct(spec: str) -> float:
            controller = make_controller(spec, weeks.sim.fleet)
            changes[spec] = validate(controller, weeks).change_pct
            return changes[spec]

        if task.row.best_of == "rules":
            best = best_rules(task.objective, change_pct, weeks.sim.fleet)
        else:
            best = min(task.row.best_of, key=change_pct)
    return _Made(best, {"chosen": best, "validation_change_pct": changes}, {})


def _made_before(task: _Task, folder: Path) -> _Made:
    """Return the controller of a row that another job has trained or chosen."""
    metrics = json.loads((folder / METRICS_FILE).read_text("utf-8"))
    made_by: dict[str, Any] = {"made_by": task.made_by}
    if task.row.best_of is not None:
        return _Made(metrics["chosen"], made_by | {"chosen": metrics["chosen"]}, {})
    parts = metrics["trainings"] if task.row.apart else [""]
    moved = tuple(short_name(agent) for agent in agents_of(_settings(task)))
    return _Made(_spec({part: folder / part for part in parts}), made_by, {}, moved)


def _spec(folders: Mapping[str, Path]) -> str:
    """Return the name of the controller with the policy of each part, or of all agents (``""``)."""
    return ",".join(
        f"{part}=policy:{folder}" if part else f"policy:{folder}"
        for part, folder in folders.items()
    )


def _settings(task: _Task, agent: str | None = None) -> TrainingSettings:
    """Return the settings of the training of a row, or of one of its agents alone."""
    return training_settings(
        task.case,
        task.row,
        objective=task.objective,
        seed=task.seed,
        training=task.training,
        agent=agent,
    )


def _trained(task: _Task, scratch: Path, optima: Path) -> _Made:
    """Train the policy of a row, or of each of its agents while those trained before act."""
    from sdc_taichi.learning import train

    agents = agents_of(_settings(task))
    moved = tuple(short_name(agent) for agent in agents)
    files: dict[str, bytes] = {}
    metrics: dict[str, Any] = {}
    folders: dict[str, Path] = {}
    begun_s = time.process_time()
    for agent in agents if task.row.apart else (None,):
        part = AGENT_DEFINITIONS[agent].command if agent else ""
        folder = scratch / "training" / part
        folder.parent.mkdir(parents=True, exist_ok=True)
        settings = _settings(task, agent)
        done = train(settings, folder, others=_spec(folders) or None, cache=optima)
        files |= {
            (Path(part) / name).as_posix(): x for name, x in _files_of_training(folder).items()
        }
        metrics[part or "training"] = {
            "updates": done.updates,
            "steps": done.steps,
            "gradient_steps": gradient_steps(settings.algorithm, settings.learning, done.updates),
            "validation": None if done.best is None else done.best._asdict(),
        }
        folders[part] = folder
    core_s = time.process_time() - begun_s
    return _Made(_spec(folders), {"trainings": metrics}, files, moved, core_s)


def _files_of_training(folder: Path) -> dict[str, bytes]:
    """Return settings, learning curves and best policy of a training, by relative path.

    Data that differ between repetitions, such as times, are left out. Subfolders are preserved, so
    that ``policy:FOLDER`` with the folder of the job is a valid controller.
    """
    import pandas as pd

    from sdc_taichi.learning.policy import FOLDERS
    from sdc_taichi.learning.training_folder import SETTINGS_FILE

    chosen = next(name for name in FOLDERS if (folder / name).is_dir())
    paths = [folder / SETTINGS_FILE, *sorted((folder / chosen).iterdir())]
    contents = {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in paths if path.is_file()
    }
    for name in _CURVES:
        if (path := folder / name).is_file():
            curve = pd.read_csv(path, dtype=str, keep_default_na=False).drop(columns=_SECONDS)
            contents[name] = curve.to_csv(index=False, lineterminator="\n").encode()
    return contents


@contextlib.contextmanager
def _weeks(task: _Task, part: Part, optima: Path) -> Iterator[DataCenterWeeks]:
    """Yield data centers and weeks of a part of a case, with their optima.

    A warning is issued if an optimum was missing and had to be computed again.
    """
    known = set(optima.iterdir())
    with prepare(
        data_centers(task.case, part),
        weeks_of(task.case, part),
        years=years_of(task.case, part),
        objective=task.objective,
        optimum=task.case.optimum,
        uncoordinated=part == "held-out" and task.row.optimum == "achieved",
        days=task.case.days,
        seed=task.seed,
        forecast_error=task.case.error,
        cache=optima,
    ) as weeks:
        if set(optima.iterdir()) > known:
            warnings.warn(
                "optima were solved anew, as those of this study are of a processor with other "
                "features or of other libraries",
                OptimumCacheWarning,
                stacklevel=2,
            )
        yield weeks


def _rows(task: _Task, made: _Made, weeks: DataCenterWeeks) -> pd.DataFrame:
    """Evaluate the row's controller, and its agents alone; return a table row for each week."""
    import pandas as pd

    best = weeks.optimum
    if task.row.optimum is not None:
        assert best is not None
        if task.row.optimum == "bound":
            return _rows_of_figures(weeks, {ALL: best.bound})
        if not isinstance(best, Optimum):
            return _rows_of_figures(weeks, {ALL: best.achieved})
        achieved = evaluate(weeks, [Contender(_ROW, AchievedPath(best))], beside=False).rows
        others = _rows_of_figures(weeks, {**best.alone, **best.uncoordinated})
        return pd.concat([achieved, others], ignore_index=True)
    agents = made.agents if task.row.agents_alone and len(made.agents) > 1 else ()
    controller = make_controller(made.spec, weeks.sim.fleet)
    contender = Contender(_ROW, controller, agents=agents)
    return evaluate(weeks, [contender], beside=False).rows


def _rows_of_figures(weeks: DataCenterWeeks, figures: Mapping[str, Any]) -> pd.DataFrame:
    """Return table rows with objective values only; other metrics are nan.

    Args:
        weeks: data centers and weeks.
        figures: objective of each week, (B,), by value of column ``moves``.
    """
    import numpy as np
    import pandas as pd

    best, nan = weeks.optimum, np.full(len(weeks.sites), np.nan)
    achieved = nan if best is None else best.achieved
    frames = []
    for moves, figure in figures.items():
        columns = {
            "controller": "",
            "training": pd.array([pd.NA] * len(weeks.sites), dtype="Int64"),
            "moves": moves,
            "site": weeks.sites,
            "year": weeks.years,
            "week": weeks.weeks,
            "figure": figure,
            "valued_figure": figure,
            "idle_figure": weeks.idle,
            "achieved_figure": achieved,
            "share": share_of_achievable(figure, weeks.idle, achieved),
            "broken": "",
            **{name: nan for name in METRICS},
        }
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def _metrics(task: _Task, made: _Made, weeks: DataCenterWeeks) -> dict[str, Any]:
    """Return the metrics of a row's job: choice or training of its controller, and its weeks."""
    return made.metrics | {
        "objective": str(weeks.objective),
        "unit": weeks.objective.unit,
        "sites": list(dict.fromkeys(weeks.sites)),
        "weeks": list(task.case.weeks),
        "steps": weeks.steps,
        "scored_from": weeks.scored_from,
        "fingerprint": weeks.sim.fingerprint(),
        "has_optimum": weeks.optimum is not None,
        "bound_kinds": sorted(set(_bound_kinds(weeks))),
    }


def _bound_kinds(weeks: DataCenterWeeks) -> list[str]:
    """Return the kind of the bound of each week; empty without an optimum."""
    best = weeks.optimum
    if isinstance(best, Optimum):
        return list(best.bound_kinds)
    return [] if best is None else ["bound"] * len(weeks.sites)
