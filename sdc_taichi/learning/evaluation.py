"""Evaluation of controllers in given weeks, against idle commands and the optimum of these weeks.

All begin in equal weeks and states. The first day of a week is run but not scored, and what is
stored or waits at the end is valued, so that an empty battery or work put off is no saving.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import PERFECT, Controller, ForecastError, Idle, PerAgent
from sdc_taichi.envs.agents import AGENT_DEFINITIONS
from sdc_taichi.errors import ConfigError, whole_number
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.policy import Policy
from sdc_taichi.learning.split import DAYS_PER_WEEK, UNSCORED_DAYS, data_center_weeks
from sdc_taichi.learning.statistics import change_pct, share_pct
from sdc_taichi.learning.training_folder import SETTINGS_FILE, settings_of
from sdc_taichi.learning.training_settings import TrainingSettings
from sdc_taichi.optimum import StoppedError
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.optimum.result import Optimum, with_tabled_ends
from sdc_taichi.optimum.solve import Progress, solve
from sdc_taichi.run.achievable import OPTIMUM, AchievedPath, achievement, begin_score
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.metrics import add_step, empty_totals, metrics_per_dc
from sdc_taichi.sim.bills import no_demand
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64, StepResult

if TYPE_CHECKING:
    import pandas as pd

IDLE = "idle"
"""Name of the controller that all others are compared with."""
ALL = "all"
"""Text for a controller that gives all its commands, where others stand for one agent alone."""
METRICS = (
    *("cfp_kg", "grid_kwh", "it_kwh", "hvac_kwh", "water_l", "cost", "peak_kw"),
    *("over_27_degree_h", "hottest_inlet_c", "arrived_tasks", "executed_tasks", "dropped_tasks"),
    *("overdue_task_h", "queue_mean_tasks", "battery_throughput_kwh", "unmet_cooling_kwh"),
    *("lost_tasks", "throttled_rack_h", "tripped_rack_h", "unserved_kwh", "grid_overload_kwh"),
)
"""Metrics of ``run.metrics`` over the scored steps that each row holds."""


@dataclass(frozen=True, slots=True)
class DataCenterWeeks:
    """Data centers in weeks of the year, with the figures of idle commands and of the optimum.

    As a context manager it closes its simulator.
    """

    sim: Simulator
    """Simulator of B data-center weeks."""
    sites: tuple[str, ...]
    """Name of each data center without its week, B."""
    weeks: tuple[int, ...]
    """Week of the year of each data center, 0..51, B."""
    objective: Objective
    """Objective whose figure is compared, less is better."""
    steps: int
    """Number of steps of a week that are run."""
    scored_from: int
    """First step that is scored."""
    seed: int
    """Seed of sampled events, of controllers and of errors of forecasts."""
    forecast_error: ForecastError
    """Sizes of the errors of the forecasts that controllers get."""
    idle: F64
    """Figure of idle commands over the scored steps, in the unit of the objective, (B,)."""
    optimum: Optimum | None
    """Known optimum of the same weeks; None if there is none to compare with."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.sim.close()

    @property
    def strata(self) -> I64:
        """Number of the site of each week, for the bootstrap, (B,)."""
        names = list(dict.fromkeys(self.sites))
        return np.array([names.index(site) for site in self.sites], dtype=np.int64)


class Validation(NamedTuple):
    """Result of a controller over all validation weeks together."""

    change_pct: float
    """Change of the figure against idle commands, in %, with valued ends if there is an optimum."""
    share: float
    """Share of the achievable; nan without an optimum."""
    broken_weeks: int
    """Number of weeks in which a constraint that the optimum keeps was broken; 0 without an
    optimum."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A controller to evaluate."""

    name: str
    """Name of the controller in rows; trainings of one name are put together."""
    controller: Controller
    """Controller that is run."""
    seed: int | None = None
    """Seed of the training of the controller; None if it was not trained."""
    agents: tuple[str, ...] = ()
    """Agents (load, cooling, battery) that are also run one at a time, the others idle."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Figures and metrics of controllers in each data-center week."""

    rows: pd.DataFrame
    """A row for each controller, training, what it moves, and data-center week, with the columns
    ``controller``, ``training``, ``moves``, ``site``, ``week``, ``figure``, ``valued_figure``,
    ``idle_figure``, ``achieved_figure``, ``share``, ``broken`` and those of ``METRICS``."""
    objective: Objective
    """Objective of the figures."""
    alone: dict[str, F64]
    """Figures of the optimum of each agent alone, by agent, in each week, (B,) each; empty without
    an optimum."""
    strata: I64
    """Number of the site of each week, (B,)."""
    missing: tuple[str, ...]
    """Controllers that an interruption left out."""


def prepare(
    configs: Iterable[DataCenterConfig],
    weeks: Sequence[int],
    *,
    objective: Objective | str = "carbon",
    optimum: bool = True,
    exact_ends: bool = False,
    days: int = DAYS_PER_WEEK,
    seed: int = 0,
    forecast_error: ForecastError = PERFECT,
    precision: Precision = "f32",
    cache: bool | str | os.PathLike[str] = True,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> DataCenterWeeks:
    """Make the data centers of weeks ready for controllers to run in.

    Args:
        configs: data centers, such as one for each site.
        weeks: weeks of the year, 0..51.
        objective: what is compared, or its text.
        optimum: whether to solve for the optimum, which values ends and gives the share of the
            achievable.
        exact_ends: whether to value the ends of each run by programmes of their own, at about a
            second for each week, and not by curves.
        days: days of each week to run, 2..7; the first is not scored.
        seed: of sampled events, of controllers and of errors of forecasts.
        forecast_error: how the forecasts of controllers err.
        precision: of the server kernels.
        cache: whether to read and keep optima among the user's caches, or a folder for them.
        progress: is told of the stages of solving.
        stop: asked now and then; true ends the work.

    Raises:
        ConfigError: no data centers or weeks, or arguments that are not valid.
        StoppedError: ``stop`` was true.
    """
    given, chosen = list(configs), tuple(weeks)
    if not given or not chosen:
        what = "weeks" if given else "data centers"
        raise ConfigError(f"evaluation: no {what}; valid is one or more")
    days = whole_number("days", days, UNSCORED_DAYS + 1, DAYS_PER_WEEK)
    aim = Objective.parse(objective) if isinstance(objective, str) else objective
    sim = Simulator(data_center_weeks(given, chosen), precision=precision)
    try:
        per_day = 24 * sim.fleet.steps_per_hour
        steps, scored_from = days * per_day, UNSCORED_DAYS * per_day
        best = None
        if optimum:
            best = solve(
                sim.fleet,
                steps=steps,
                seed=seed,
                drivers=sim.drivers,
                objective=aim,
                scored_from=scored_from,
                precision=precision,
                cache=cache,
                progress=progress,
                stop=stop,
            )
            if not exact_ends:
                best = with_tabled_ends(best, sim, progress=progress, stop=stop)
        idle = np.empty(0) if best is None else best.idle
        made = DataCenterWeeks(
            sim=sim,
            sites=tuple(config.name for config in given for _ in chosen),
            weeks=chosen * len(given),
            objective=aim,
            steps=steps,
            scored_from=scored_from,
            seed=seed,
            forecast_error=forecast_error,
            idle=idle,
            optimum=best,
        )
        if best is None:
            score, is_whole = _run(made, Idle(), stop=stop)
            if not is_whole:
                raise StoppedError("idle commands are not run to the end, nothing is kept")
            made = replace(made, idle=score.figure)
        return made
    except BaseException:
        sim.close()
        raise


def validate(controller: Controller, weeks: DataCenterWeeks) -> Validation:
    """Compare a controller with idle commands and the optimum over all weeks together.

    Args:
        controller: gives the commands.
        weeks: the weeks.
    """
    score, _ = _run(weeks, controller)
    figure, best = score.figure[None], weeks.optimum
    if best is None:
        return Validation(float(change_pct(figure, weeks.idle[None])), float("nan"), 0)
    reached = achievement(best, "", score)
    figure = reached.valued_figure[None]
    return Validation(
        float(change_pct(figure, weeks.idle[None])),
        float(share_pct(figure, weeks.idle[None], best.achieved[None])) / 100.0,
        sum(map(bool, reached.broken)),
    )


def check_contenders(contenders: Iterable[Contender]) -> None:
    """Refuse controllers whose rows could not be told apart, and agents that do not exist.

    Args:
        contenders: the controllers.

    Raises:
        ConfigError: a name and seed that is given twice, ``idle`` or ``optimum`` for another
            controller, or an agent that is neither load, cooling nor battery.
    """
    seen = set()
    for each in contenders:
        if each.name == OPTIMUM or (each.name == IDLE and not isinstance(each.controller, Idle)):
            raise ConfigError(
                f"evaluation: {each.name} names other rows of the tables; valid is another name"
            )
        if each.name != IDLE and (each.name, each.seed) in seen:
            of = "" if each.seed is None else f" of seed {each.seed}"
            raise ConfigError(f"evaluation: {each.name}{of} is given twice; valid is each once")
        seen.add((each.name, each.seed))
        for agent in each.agents:
            if agent not in AGENTS:
                raise ConfigError(f"agent {agent!r} of {each.name}: valid are {', '.join(AGENTS)}")


def evaluate(
    weeks: DataCenterWeeks,
    contenders: Iterable[Contender],
    *,
    beside: bool = True,
    on_run: Callable[[str], Callable[[StepResult], None] | None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Evaluation:
    """Run controllers in the same weeks.

    Args:
        weeks: the weeks.
        contenders: the controllers.
        beside: whether rows of idle commands come first and, where there is an optimum, those of
            its achieved path last.
        on_run: called with the name of each run before it; what it returns is called with the
            result of every step.
        stop: asked before every step; true ends the evaluation, and rows of whole runs are kept.

    Raises:
        ConfigError: names or agents that ``check_contenders`` refuses.
    """
    import pandas as pd

    frames, missing = [], []
    for name, moves, contender in _runs(weeks, contenders, beside=beside):
        if stop is not None and stop():
            missing.append(name)
            continue
        on_step = None if on_run is None else on_run(name)
        controller = contender.controller
        if moves != ALL:
            controller = PerAgent(*(controller if a == moves else Idle() for a in AGENTS))
        frame = _rows(weeks, controller, on_step, stop)
        if frame is None:
            missing.append(name)
            continue
        frame.insert(0, "controller", contender.name)
        frame.insert(1, "training", contender.seed)
        frame.insert(2, "moves", moves)
        frames.append(frame)
    rows = pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()
    if frames:
        rows["training"] = rows["training"].astype("Int64")
    best = weeks.optimum
    return Evaluation(
        rows=rows,
        objective=weeks.objective,
        alone={} if best is None else dict(best.alone),
        strata=weeks.strata,
        missing=tuple(dict.fromkeys(missing)),
    )


def _runs(
    weeks: DataCenterWeeks, contenders: Iterable[Contender], *, beside: bool
) -> list[tuple[str, str, Contender]]:
    """Name, what is moved, and controller of each run, in the order of their rows."""
    every = list(contenders)
    check_contenders(every)
    if beside:
        every = [Contender(IDLE, Idle()), *(each for each in every if each.name != IDLE)]
    if beside and weeks.optimum is not None:
        every.append(Contender(OPTIMUM, AchievedPath(weeks.optimum)))
    runs = []
    for each in every:
        label = each.name if each.seed is None else f"{each.name}, seed {each.seed}"
        runs.append((label, ALL, each))
        runs += [(f"{label}, {agent} alone", agent, each) for agent in each.agents]
    return runs


def _rows(
    weeks: DataCenterWeeks,
    controller: Controller,
    on_step: Callable[[StepResult], None] | None,
    stop: Callable[[], bool] | None,
) -> pd.DataFrame | None:
    """A row for each data-center week; None if the run was stopped."""
    import pandas as pd

    totals = empty_totals(weeks.sim.size, weeks.sim.step_h)
    fleet, from_step = weeks.sim.fleet, weeks.scored_from

    def add(result: StepResult) -> None:
        if result.step == from_step:
            totals.demand = no_demand(weeks.sim.drivers.start + from_step, fleet.steps_per_hour)
        if result.step >= from_step:
            add_step(totals, result)
        if on_step is not None:
            on_step(result)

    score, is_whole = _run(weeks, controller, add, stop)
    if not is_whole:
        return None
    best, nan = weeks.optimum, np.full(weeks.sim.size, np.nan)
    valued, share, achieved = nan, nan, nan
    broken: Sequence[str | None] = [None] * weeks.sim.size
    if best is not None:
        reached = achievement(best, "", score)
        valued, share, achieved = reached.valued_figure, reached.share, best.achieved
        broken = ["; ".join(texts) for texts in reached.broken]
    metrics = metrics_per_dc(totals, fleet)
    return pd.DataFrame(
        {
            "site": weeks.sites,
            "week": weeks.weeks,
            "figure": score.figure,
            "valued_figure": valued,
            "idle_figure": weeks.idle,
            "achieved_figure": achieved,
            "share": share,
            "broken": broken,
            **{name: [float(dc[name] or 0.0) for dc in metrics] for name in METRICS},
        }
    )


def _run(
    weeks: DataCenterWeeks,
    controller: Controller,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> tuple[Score, bool]:
    """Score of a run through the weeks, and whether it came to its end."""
    if weeks.optimum is None:
        weeks.sim.reset(weeks.seed)
        score = Score(weeks.objective, weeks.sim, weeks.scored_from)
    else:
        score = begin_score(weeks.optimum, weeks.sim, weeks.seed)

    def add(result: StepResult) -> None:
        score.add(result)
        if on_step is not None:
            on_step(result)

    done = simulate(
        weeks.sim,
        controller,
        weeks.steps,
        weeks.seed,
        forecast_error=weeks.forecast_error,
        on_step=add,
        stop=stop,
    )
    return score, done.steps == weeks.steps


def training_settings(folders: Sequence[Path]) -> TrainingSettings | None:
    """Settings of the first of several trainings; None if none of the folders is of a training.

    Args:
        folders: folders of trainings or policies.

    Raises:
        ConfigError: settings that are not valid, or trainings on other data centers than the first.
    """
    found: tuple[Path, TrainingSettings] | None = None
    for folder in folders:
        if not (folder / SETTINGS_FILE).is_file():
            continue
        settings = settings_of(folder)
        if found is None:
            found = folder, settings
        for name in ("config", "overrides"):
            if getattr(settings, name) != getattr(found[1], name):
                raise ConfigError(
                    f"{folder}: was trained with another {name} than {found[0]}; valid with both "
                    "is --config"
                )
    return None if found is None else found[1]


def contenders_of(
    folders: Sequence[Path], fleet: Fleet, *, agents_alone: bool = True
) -> list[Contender]:
    """Policies of trainings as contenders; those that differ in their seed alone share a name.

    Args:
        folders: folders of trainings or policies.
        fleet: data centers that they are to control.
        agents_alone: whether each agent of a policy of several also runs alone.

    Raises:
        SdcError: a folder without a policy, or a policy that does not fit the data centers.
    """
    policies = [Policy.load(folder) for folder in folders]
    keys = [_key(folder, policy) for folder, policy in zip(folders, policies, strict=True)]
    names = _names(folders, policies, keys)
    found = []
    for folder, policy, key in zip(folders, policies, keys, strict=True):
        controller = PolicyController(policy, fleet, f"policy {folder}")
        parts = _parts(policy)
        alone = parts if agents_alone and len(parts) > 1 else ()
        found.append(Contender(names[key], controller, policy.about.seed, alone))
    return found


def _key(folder: Path, policy: Policy) -> str:
    """Text that is equal for trainings which differ in their seed alone."""
    about = policy.about.model_dump(exclude={"seed", "fingerprint"})
    settings = {}
    if (folder / SETTINGS_FILE).is_file():
        settings = settings_of(folder).model_dump(mode="json", exclude={"seed"})
        about.pop("steps")  # the best policies of seeds come from different updates
    return json.dumps([about, policy.interface.model_dump(), settings], sort_keys=True)


def _names(
    folders: Sequence[Path], policies: Sequence[Policy], keys: Sequence[str]
) -> dict[str, str]:
    """Name of each key: its algorithm, or its folder where another key has that algorithm."""
    first = {key: i for i, key in reversed(list(enumerate(keys)))}
    algorithms = [policies[i].about.algorithm for i in first.values()]
    names: dict[str, str] = {}
    for key, i in first.items():
        name = policies[i].about.algorithm
        if algorithms.count(name) > 1:
            name = re.sub(r"[-_.]?(seed)?[-_.]?\d+$", "", folders[i].absolute().name) or name
        names[key] = name if name not in names.values() else str(folders[i])
    return names


def _parts(policy: Policy) -> tuple[str, ...]:
    """Of load, cooling and battery what the agents of a policy move."""
    return tuple(AGENT_DEFINITIONS[agent].command for agent in policy.interface.agents)
