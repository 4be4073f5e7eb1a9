"""Functions of the jobs of suites: the optima of a site's weeks, and a row of a case with one seed.

They run on any machine, since all that they need is in their values and inputs. An optimum is
solved once and kept as the files of its job, which are inputs of the rows.
"""

from __future__ import annotations

import contextlib
import io
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from sdc_taichi.benchmark.cases import (
    agents_of,
    data_centers,
    training_settings,
    weeks_of,
)
from sdc_taichi.benchmark.jobs import Inputs, JobResult
from sdc_taichi.benchmark.suite import Case, Part, Row
from sdc_taichi.control import PERFECT, ForecastError, make_controller
from sdc_taichi.envs.agents import AGENT_DEFINITIONS
from sdc_taichi.learning.evaluation import (
    ALL,
    METRICS,
    Contender,
    DataCenterWeeks,
    evaluate,
    prepare,
    validate,
)
from sdc_taichi.optimum.cache import OptimumCacheWarning
from sdc_taichi.run.achievable import AchievedPath, share_of_achievable

if TYPE_CHECKING:
    import pandas as pd

_CURVES = ("training.csv", "validation.csv")
"""Files of a training that are kept beside its settings and policy."""
_ROW = "row"
"""Name of a controller during its evaluation; its rows are named after the row of the suite."""
_SECONDS = "seconds"
"""Column of curves that differs between equal trainings."""


def solve_reference(values: Mapping[str, Any], _inputs: Inputs) -> JobResult:
    """Solve for the optima of a site's weeks, and value the ends of weeks.

    Args:
        values: ``case``, ``part``, the number of the ``site``, and the ``objective``.

    Returns:
        No rows; as files the entries by which ``optimum.solve`` finds the optima again.
    """
    case, part = Case.model_validate(values["case"]), values["part"]
    config = data_centers(case, part)[values["site"]]
    with (
        TemporaryDirectory() as folder,
        prepare(
            [config],
            weeks_of(case, part),
            objective=values["objective"],
            days=case.days,
            cache=folder,
        ) as weeks,
    ):
        files = {path.name: path.read_bytes() for path in sorted(Path(folder).glob("*.npz"))}
        assert weeks.optimum is not None
        metrics = {
            "part": part,
            "site": config.name,
            "weeks": weeks.weeks,
            "idle_figure": weeks.idle.tolist(),
            "achieved_figure": weeks.optimum.achieved.tolist(),
            "bound_figure": weeks.optimum.bound.tolist(),
            "bound_kinds": weeks.optimum.bound_kinds,
        }
    return JobResult(None, metrics, files)


def run_row(values: Mapping[str, Any], inputs: Inputs) -> JobResult:
    """Run a row of a case with one seed: train or choose its controller, and evaluate it.

    Args:
        values: ``case`` and ``row``, the ``name`` of the row, settings of every ``training``, the
            ``objective`` and the ``seed``.
        inputs: optima of the weeks, as ``packed`` packs the files of their jobs.

    Returns:
        A row for each week, with the columns of ``learning.evaluation``; the policy and the curves
        of a training as files.
    """
    task = _Task.model_validate(values)
    with TemporaryDirectory() as scratch:
        optima = Path(scratch) / "optima"
        optima.mkdir()
        for content in inputs.values():
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                archive.extractall(optima)
        made = _made(task, Path(scratch), optima)
        error = task.row.forecast_error
        with _weeks(task, "held-out", optima, error) as weeks:
            rows = _rows(task, made, weeks)
            metrics = _metrics(task, made, weeks)
    rows = rows.drop(columns="training").assign(controller=task.name)
    return JobResult(rows, metrics, made.files)


def packed(files: Mapping[str, bytes]) -> bytes:
    """Files of a reference job as one input: a ZIP archive with the same bits for the same files.

    Args:
        files: content by name.
    """
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name in sorted(files):
            archive.writestr(zipfile.ZipInfo(name), files[name])
    return out.getvalue()


class _Task(BaseModel):
    """Values of a row job: a row of a case with one seed."""

    name: str
    """Name of the row."""
    case: Case
    """Data centers and weeks."""
    row: Row
    """The row."""
    training: dict[str, Any]
    """Settings of every training of the suite."""
    objective: str
    """Objective that is compared."""
    seed: int
    """Seed of all that is random."""


@dataclass(frozen=True, slots=True)
class _Made:
    """The controller of a row, and how it was chosen or trained."""

    spec: str
    """Controller by name; empty for an optimum."""
    metrics: dict[str, Any]
    """How it was chosen or trained, as metrics of the job."""
    files: dict[str, bytes]
    """Policies and curves of trainings by their paths."""
    agents: tuple[str, ...] = ()
    """Of load, cooling and battery what a trained policy moves."""


def _made(task: _Task, scratch: Path, optima: Path) -> _Made:
    """Train or choose the controller of a row."""
    if task.row.train is not None:
        return _trained(task, scratch, optima)
    if task.row.best_of is None:
        return _Made(task.row.controller or "", {}, {})
    with _weeks(task, "validation", optima) as weeks:
        tried = {
            spec: validate(make_controller(spec, weeks.sim.fleet), weeks)
            for spec in task.row.best_of
        }
    best = min(tried, key=lambda spec: tried[spec].change_pct)
    changes = {spec: validation.change_pct for spec, validation in tried.items()}
    return _Made(best, {"chosen": best, "validation_change_pct": changes}, {})


def _trained(task: _Task, scratch: Path, optima: Path) -> _Made:
    """Train the policy of a row, or one for each of its agents."""
    from sdc_taichi.learning import train

    def settings_of(agent: str | None) -> Any:
        return training_settings(
            task.case,
            task.row,
            objective=task.objective,
            seed=task.seed,
            training=task.training,
            agent=agent,
        )

    agents = agents_of(settings_of(None))
    moved = tuple(AGENT_DEFINITIONS[agent].command for agent in agents)
    files: dict[str, bytes] = {}
    metrics, specs = {}, []
    for agent in agents if task.row.apart else (None,):
        part = AGENT_DEFINITIONS[agent].command if agent else ""
        folder = scratch / "training" / part
        folder.parent.mkdir(parents=True, exist_ok=True)
        done = train(settings_of(agent), folder, cache=optima)
        files |= {
            (Path(part) / name).as_posix(): x for name, x in _files_of_training(folder).items()
        }
        metrics[part or "training"] = {
            "updates": done.updates,
            "steps": done.steps,
            "validation": None if done.best is None else done.best._asdict(),
        }
        specs.append(f"{part}=policy:{folder}" if part else f"policy:{folder}")
    return _Made(",".join(specs), {"trainings": metrics}, files, moved)


def _files_of_training(folder: Path) -> dict[str, bytes]:
    """Settings, curves and the best policy of a training, without what differs between equal ones.

    Folders keep their places, so that the folder of the job is a controller ``policy:FOLDER``.
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
def _weeks(
    task: _Task, part: Part, optima: Path, forecast_error: str | None = None
) -> Iterator[DataCenterWeeks]:
    """Data centers and weeks of a part of a case, with their optima.

    Warns where an optimum was not among those that are solved.
    """
    known = set(optima.iterdir())
    with prepare(
        data_centers(task.case, part),
        weeks_of(task.case, part),
        objective=task.objective,
        optimum=task.case.optimum,
        days=task.case.days,
        seed=task.seed,
        forecast_error=PERFECT if forecast_error is None else ForecastError.parse(forecast_error),
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
    """A row for each week of the row's controller, and of what its agents do alone."""
    import pandas as pd

    best = weeks.optimum
    if task.row.optimum is not None:
        assert best is not None
        if task.row.optimum == "bound":
            return _rows_of_figures(weeks, {ALL: best.bound})
        achieved = evaluate(weeks, [Contender(_ROW, AchievedPath(best))], beside=False).rows
        return pd.concat([achieved, _rows_of_figures(weeks, best.alone)], ignore_index=True)
    agents = made.agents if task.row.agents_alone and len(made.agents) > 1 else ()
    controller = make_controller(made.spec, weeks.sim.fleet)
    contender = Contender(_ROW, controller, agents=agents)
    return evaluate(weeks, [contender], beside=False).rows


def _rows_of_figures(weeks: DataCenterWeeks, figures: Mapping[str, Any]) -> pd.DataFrame:
    """Rows of figures alone, by what is moved; nothing is known of other metrics."""
    import numpy as np
    import pandas as pd

    best, nan = weeks.optimum, np.full(weeks.sim.size, np.nan)
    achieved = nan if best is None else best.achieved
    frames = []
    for moves, figure in figures.items():
        columns = {
            "controller": "",
            "training": pd.array([pd.NA] * weeks.sim.size, dtype="Int64"),
            "moves": moves,
            "site": weeks.sites,
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
    """Metrics of a row job: how its controller was chosen or trained, and its weeks."""
    return made.metrics | {
        "objective": str(weeks.objective),
        "unit": weeks.objective.unit,
        "sites": list(dict.fromkeys(weeks.sites)),
        "weeks": list(task.case.weeks),
        "steps": weeks.steps,
        "scored_from": weeks.scored_from,
        "forecast_error": task.row.forecast_error,
        "fingerprint": weeks.sim.fingerprint(),
        "has_optimum": weeks.optimum is not None,
        "bound_kinds": [] if weeks.optimum is None else sorted(set(weeks.optimum.bound_kinds)),
    }
