"""Evaluation of controllers in weeks of the year, compared with idle commands and the optimum.

All controllers begin in the same weeks and states. The first day of each week is simulated but not
scored. Stored energy and waiting work at the end of a week have a value, so that a controller gains
nothing by emptying the battery or postponing work.

A "figure" is the value of the objective over the scored steps (for ``carbon``, kg of CO2; lower is
better). B is the number of data-center weeks.
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
from sdc_taichi.control import (
    PERFECT,
    Controller,
    ForecastError,
    Idle,
    PerAgent,
    View,
    commands_of,
)
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, ALL_AGENTS, short_name
from sdc_taichi.errors import ConfigError, whole_number
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.policy import Policy
from sdc_taichi.learning.split import DAYS_PER_WEEK, UNSCORED_DAYS, data_center_weeks
from sdc_taichi.learning.statistics import change_pct, share_pct
from sdc_taichi.learning.training_folder import SETTINGS_FILE, settings_of
from sdc_taichi.learning.training_settings import TrainingSettings
from sdc_taichi.optimum import StoppedError
from sdc_taichi.optimum.fleet import FleetOptimum, FleetScore, solve_fleet
from sdc_taichi.optimum.objective import CARBON, Objective, Score
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.optimum.result import Optimum, with_tabled_ends
from sdc_taichi.optimum.solve import Progress, solve
from sdc_taichi.run.achievable import (
    OPTIMUM,
    AchievedPath,
    Achievement,
    achievement,
    begin_score,
    fleet_achievement,
)
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.metrics import add_step, empty_totals, metrics_per_dc
from sdc_taichi.sim.bills import no_demand
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64, Actions, StepResult

if TYPE_CHECKING:
    import pandas as pd

IDLE = "idle"
"""Name of the baseline controller, which gives no commands."""
ALL = "all"
"""Value of column ``moves`` for a run in which all agents of a controller act."""
MOVES = tuple(short_name(agent) for agent in ALL_AGENTS)
"""Values of column ``moves`` for runs in which a single group of agents acts."""
METRICS = (
    *("cfp_kg", "grid_kwh", "it_kwh", "hvac_kwh", "water_l", "cost", "peak_kw"),
    *("over_27_degree_h", "hottest_inlet_c", "arrived_tasks", "executed_tasks", "dropped_tasks"),
    *("overdue_task_h", "queue_mean_tasks", "battery_throughput_kwh", "unmet_cooling_kwh"),
    *("lost_tasks", "throttled_rack_h", "tripped_rack_h", "unserved_kwh", "grid_overload_kwh"),
)
"""Metrics of ``run.metrics`` that each row of an evaluation reports, over the scored steps."""

_HIGHEST, _MEANS = ("peak_kw", "hottest_inlet_c"), ("over_27_degree_h", "queue_mean_tasks")
"""Metrics that are maxima and means over the sites of a fleet; all others are sums."""


@dataclass(frozen=True, slots=True)
class DataCenterWeeks:
    """Data centers in weeks of the year, with the figures of idle commands and of the optimum.

    A ``with`` block closes the simulator at its end.
    """

    sim: Simulator
    """Simulator of B data-center weeks."""
    sites: tuple[str, ...]
    """Name of each data center, or fleet that shares work, without its week."""
    years: tuple[int, ...]
    """Seed of the synthetic year of each data center or fleet (``site.seed``)."""
    weeks: tuple[int, ...]
    """Week of the year of each data center, 0..51, B."""
    objective: Objective
    """Objective by which controllers are compared; lower values are better."""
    steps: int
    """Number of simulated steps of each week."""
    scored_from: int
    """Index of the first scored step."""
    seed: int
    """Seed of sampled events, of controllers and of forecast errors."""
    forecast_error: ForecastError
    """Sizes of the errors of the forecasts that controllers get."""
    idle: F64
    """Objective of idle commands over the scored steps, in the unit of the objective, (B,)."""
    optimum: Optimum | FleetOptimum | None
    """Optimum of the same weeks; None if it was not computed."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.sim.close()

    @property
    def strata(self) -> I64:
        """Index of site and year of each data-center week, for the bootstrap, (B, 2)."""
        return strata_of(self.sites, self.years)


class Validation(NamedTuple):
    """Result of a controller over all validation weeks together."""

    change_pct: float
    """Change of the objective relative to idle commands, in %; if the optimum is known, the
    objective includes the value of energy and work left at the end."""
    share: float
    """Saving of the controller divided by the saving of the optimum's achieved path, both relative
    to idle commands; nan without an optimum."""
    broken_weeks: int
    """Number of weeks that violate a constraint of the optimum; 0 without an optimum."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A controller to evaluate."""

    name: str
    """Name of the controller in the tables; trainings with the same name share a table row."""
    controller: Controller
    """Controller to run."""
    seed: int | None = None
    """Seed of the training of the controller; None if it was not trained."""
    agents: tuple[str, ...] = ()
    """Agents, as in ``MOVES``, that also run one at a time while the others are idle."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Figures and metrics of controllers in each data-center week."""

    rows: pd.DataFrame
    """Table with a row for each controller, training, set of acting agents and data-center week.
    Its columns are ``controller``, ``training``, ``moves``, ``site``, ``year``, ``week``,
    ``figure``, ``valued_figure``, ``idle_figure``, ``achieved_figure``, ``share``, ``broken``
    and the names in ``METRICS``."""
    objective: Objective
    """Objective of the figures."""
    alone: dict[str, F64]
    """Optimal objective of each week if only one agent acts, (B,), by agent; empty without an
    optimum."""
    uncoordinated: dict[str, F64]
    """Optimal objective of each week if agents do not plan together, (B,), by the names of
    ``optimum.uncoordinated``; empty if it was not computed."""
    strata: I64
    """Index of site and year of each data-center week, (B, 2)."""
    missing: tuple[str, ...]
    """Names of the runs that did not finish before ``stop`` returned true."""


def strata_of(sites: Iterable[str], years: Iterable[int]) -> I64:
    """Return the index of site and year of each data-center week, for the bootstrap, (B, 2).

    Args:
        sites: site of each data-center week, B.
        years: seed of the synthetic year of each data-center week, B.
    """
    pairs = np.array(list(zip(sites, map(str, years), strict=True))).reshape(-1, 2)
    columns = [np.unique(column, return_inverse=True)[1].reshape(-1) for column in pairs.T]
    return np.stack(columns, axis=1).astype(np.int64)


def prepare(
    configs: Iterable[DataCenterConfig],
    weeks: Sequence[int],
    *,
    years: Sequence[int] = (),
    objective: Objective | str = "carbon",
    optimum: bool = True,
    exact_ends: bool = False,
    uncoordinated: bool = False,
    days: int = DAYS_PER_WEEK,
    seed: int = 0,
    forecast_error: ForecastError = PERFECT,
    precision: Precision = "f32",
    cache: bool | str | os.PathLike[str] = True,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> DataCenterWeeks:
    """Build the data centers of all weeks; compute the objective of idle commands and optimum.

    Args:
        configs: data centers, such as one for each site.
        weeks: weeks of the year, 0..51.
        years: seeds of the synthetic years of each data center; an empty sequence selects its
            ``site.seed``.
        objective: objective by which controllers are compared, or its text, such as ``carbon``.
        optimum: whether to compute the optimum, which gives the value of energy and work left at
            the end, and the share of the achievable saving.
        exact_ends: True to value energy and work left at the end of each run by a linear programme,
            which takes about a second per week; False to interpolate the value from curves.
        uncoordinated: True to compute with the optimum also the figures of agents that do not plan
            together.
        days: days of each week to run, 2..7; the first day is not scored.
        seed: seed of sampled events, controllers and forecast errors.
        forecast_error: sizes of the errors of the controllers' forecasts.
        precision: precision of the server kernels.
        cache: whether to read and write optima in the user's cache, or the folder to use instead.
        progress: progress callback ``(stage, done, total)`` of the optimiser.
        stop: called repeatedly; the computation ends when it returns true.

    Raises:
        ConfigError: there are no data centers or weeks, or an argument is not valid.
        StoppedError: ``stop`` returned true.
    """
    sites, numbers = list(configs), tuple(weeks)
    if not sites or not numbers:
        what = "weeks" if sites else "data centers"
        raise ConfigError(f"evaluation: no {what}; valid is one or more")
    days = whole_number("days", days, UNSCORED_DAYS + 1, DAYS_PER_WEEK)
    aim = Objective.parse(objective) if isinstance(objective, str) else objective
    of_weeks = data_center_weeks(sites, numbers, years)
    sim = Simulator(of_weeks, precision=precision)
    try:
        per_day = 24 * sim.fleet.steps_per_hour
        steps, scored_from = days * per_day, UNSCORED_DAYS * per_day
        best: Optimum | FleetOptimum | None = None
        if sim.fleet.shared_work is not None:
            scored_from = 0
            if aim != CARBON:
                raise ConfigError(f"objective {aim}: valid for fleets that share work is carbon")
            if optimum:
                best = solve_fleet(sim, steps=steps, cache=cache, stop=stop or (lambda: False))
        elif optimum:
            best = solve(
                sim.fleet,
                steps=steps,
                seed=seed,
                drivers=sim.drivers,
                objective=aim,
                scored_from=scored_from,
                precision=precision,
                uncoordinated=uncoordinated,
                cache=cache,
                progress=progress,
                stop=stop,
            )
            if not exact_ends:
                best = with_tabled_ends(best, sim, progress=progress, stop=stop)
        idle = np.empty(0) if best is None else best.idle
        prepared = DataCenterWeeks(
            sim=sim,
            sites=tuple(np.repeat([x.name for x in sites], len(of_weeks) // len(sites)).tolist()),
            years=tuple(config.site.seed for config in of_weeks),
            weeks=numbers * (len(of_weeks) // len(numbers)),
            objective=aim,
            steps=steps,
            scored_from=scored_from,
            seed=seed,
            forecast_error=forecast_error,
            idle=idle,
            optimum=best,
        )
        if best is None:
            score, is_whole = _run(prepared, Idle(), stop=stop)
            if not is_whole:
                raise StoppedError("idle commands are not run to the end, nothing is kept")
            prepared = replace(prepared, idle=score.figure)
        return prepared
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
    reached = _achievement(best, score)
    figure = reached.valued_figure[None]
    return Validation(
        float(change_pct(figure, weeks.idle[None])),
        float(share_pct(figure, weeks.idle[None], best.achieved[None])) / 100.0,
        sum(map(bool, reached.broken)),
    )


def check_contenders(contenders: Iterable[Contender]) -> None:
    """Check that name and seed identify each controller, and that the agents exist.

    Raises:
        ConfigError: two controllers have the same name and seed, a controller is called ``idle`` or
            ``optimum``, or an agent is not in ``MOVES``.
    """
    names = set()
    for each in contenders:
        if each.name == OPTIMUM or (each.name == IDLE and not isinstance(each.controller, Idle)):
            raise ConfigError(
                f"evaluation: {each.name} names other rows of the tables; valid is another name"
            )
        if each.name != IDLE and (each.name, each.seed) in names:
            of = "" if each.seed is None else f" of seed {each.seed}"
            raise ConfigError(f"evaluation: {each.name}{of} is given twice; valid is each once")
        names.add((each.name, each.seed))
        for agent in each.agents:
            if agent not in MOVES:
                raise ConfigError(f"agent {agent!r} of {each.name}: valid are {', '.join(MOVES)}")


def evaluate(
    weeks: DataCenterWeeks,
    contenders: Iterable[Contender],
    *,
    beside: bool = True,
    on_run: Callable[[str], Callable[[StepResult], None] | None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Evaluation:
    """Run each controller in the same weeks, and return a row for each run and week.

    Args:
        weeks: the weeks.
        contenders: the controllers.
        beside: whether to add rows of idle commands at the beginning and, with an optimum, rows of
            its achieved path at the end.
        on_run: called with the name of each run before the run begins; it may return a function
            that is then called with the result of every step.
        stop: called before every step; if it returns true, the evaluation ends, and the result has
            the rows of the finished runs.

    Raises:
        ConfigError: ``check_contenders`` refuses a name or an agent.
    """
    import pandas as pd

    frames, missing = [], []
    for name, moves, contender in _runs(weeks, contenders, beside=beside):
        if stop is not None and stop():
            missing.append(name)
            continue
        on_step = None if on_run is None else on_run(name)
        controller = contender.controller
        if moves in AGENTS:
            controller = PerAgent(*(controller if a == moves else Idle() for a in AGENTS))
        elif moves != ALL:
            controller = _OneGroup(controller, moves)
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
        alone=dict(best.alone) if isinstance(best, Optimum) else {},
        uncoordinated=dict(best.uncoordinated) if isinstance(best, Optimum) else {},
        strata=weeks.strata,
        missing=tuple(dict.fromkeys(missing)),
    )


class _OneGroup:
    """Controller whose commands take effect for a single group of agents.

    Attributes:
        commands: fields of ``Actions`` that the controller gives.
    """

    def __init__(self, controller: Controller, group: str) -> None:
        self._controller = controller
        decided: Sequence[str] = AGENT_DEFINITIONS[group].commands
        if isinstance(controller, PolicyController):
            decided = controller.policy.interface.commands[group]
        self.commands = tuple(name for name in commands_of(controller) if name in decided)

    def reset(self, seed: int | I64) -> None:
        """Begin a new episode."""
        self._controller.reset(seed)

    def act(self, view: View) -> Actions:
        """Return the commands of the group."""
        actions = self._controller.act(view)
        return Actions(**{name: getattr(actions, name) for name in self.commands})


def _runs(
    weeks: DataCenterWeeks, contenders: Iterable[Contender], *, beside: bool
) -> list[tuple[str, str, Contender]]:
    """Return run name, value of column ``moves`` and contender of each run, in row order."""
    listed = list(contenders)
    check_contenders(listed)
    if beside:
        listed = [Contender(IDLE, Idle()), *(each for each in listed if each.name != IDLE)]
    if beside and isinstance(weeks.optimum, Optimum):
        listed.append(Contender(OPTIMUM, AchievedPath(weeks.optimum)))
    runs = []
    for each in listed:
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
    """Run a controller and return a row for each data-center week; None if it was stopped."""
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
    best, nan = weeks.optimum, np.full(len(weeks.sites), np.nan)
    valued, share, achieved = nan, nan, nan
    broken: Sequence[str | None] = [None] * len(weeks.sites)
    if best is not None:
        reached = _achievement(best, score)
        valued, share, achieved = reached.valued_figure, reached.share, best.achieved
        broken = ["; ".join(texts) for texts in reached.broken]
    per_dc = metrics_per_dc(totals, fleet)
    metrics = {x: np.array([float(dc[x] or 0.0) for dc in per_dc]) for x in METRICS}
    return pd.DataFrame(
        {
            "site": weeks.sites,
            "year": weeks.years,
            "week": weeks.weeks,
            "figure": score.figure,
            "valued_figure": valued,
            "idle_figure": weeks.idle,
            "achieved_figure": achieved,
            "share": share,
            "broken": broken,
            **{name: _of_fleets(name, values, fleet) for name, values in metrics.items()},
        }
    )


def _run(
    weeks: DataCenterWeeks,
    controller: Controller,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> tuple[Score, bool]:
    """Return the score of a run through the weeks, and True if the run was not stopped early."""
    score: Score
    if weeks.sim.fleet.shared_work is not None:
        weeks.sim.reset(weeks.seed)
        score = FleetScore(weeks.sim)
    elif weeks.optimum is None:
        weeks.sim.reset(weeks.seed)
        score = Score(weeks.objective, weeks.sim, weeks.scored_from)
    else:
        assert isinstance(weeks.optimum, Optimum)
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


def _achievement(best: Optimum | FleetOptimum, score: Score) -> Achievement:
    """Compare the score of a run with the optimum of the same weeks."""
    if isinstance(best, FleetOptimum):
        assert isinstance(score, FleetScore)
        return fleet_achievement(best, score)
    return achievement(best, "", score)


def _of_fleets(name: str, values: F64, fleet: Fleet) -> F64:
    """Return a metric of B data centers for each fleet that shares work, or as it is without."""
    if fleet.shared_work is None:
        return values
    of_sites = values.reshape(-1, fleet.sites_per_fleet)
    together = np.max if name in _HIGHEST else np.mean if name in _MEANS else np.sum
    return np.asarray(together(of_sites, axis=1))


def training_settings(folders: Sequence[Path]) -> TrainingSettings | None:
    """Return the settings of the first training; None if the folders hold policies only.

    Raises:
        ConfigError: settings are not valid, or the trainings have different data centers.
    """
    trainings = [folder for folder in folders if (folder / SETTINGS_FILE).is_file()]
    settings = [settings_of(folder, allow_code=True) for folder in trainings]
    for folder, other in zip(trainings[1:], settings[1:], strict=True):
        for name in ("config", "overrides"):
            if getattr(other, name) != getattr(settings[0], name):
                raise ConfigError(
                    f"{folder}: was trained with another {name} than {trainings[0]}; valid with "
                    "both is --config"
                )
    return settings[0] if settings else None


def contenders_of(
    folders: Sequence[Path], fleet: Fleet, *, agents_alone: bool = True
) -> list[Contender]:
    """Return trained policies as contenders; trainings that differ only in seed share a name.

    Args:
        folders: folders of trainings or policies.
        fleet: data centers to control.
        agents_alone: whether each agent of a policy with several agents also runs alone.

    Raises:
        SdcError: a folder has no policy, or a policy does not fit the data centers.
    """
    policies = [Policy.load(folder) for folder in folders]
    keys = [_key(folder, policy) for folder, policy in zip(folders, policies, strict=True)]
    names = _names(folders, policies, keys)
    contenders = []
    for folder, policy, key in zip(folders, policies, keys, strict=True):
        controller = PolicyController(policy, fleet, f"policy {folder}")
        parts = tuple(short_name(agent) for agent in policy.interface.agents)
        alone = parts if agents_alone and len(parts) > 1 else ()
        contenders.append(Contender(names[key], controller, policy.about.seed, alone))
    return contenders


def _key(folder: Path, policy: Policy) -> str:
    """Return a text that is equal for two trainings if they differ only in their seed."""
    about = policy.about.model_dump(exclude={"seed", "fingerprint"})
    settings = {}
    if (folder / SETTINGS_FILE).is_file():
        settings = settings_of(folder, allow_code=True).model_dump(mode="json", exclude={"seed"})
        about.pop("steps")  # differs by seed: the best policy may come from any update
    return json.dumps([about, policy.interface.model_dump(), settings], sort_keys=True)


def _names(
    folders: Sequence[Path], policies: Sequence[Policy], keys: Sequence[str]
) -> dict[str, str]:
    """Return a name for each key: its algorithm, or its folder if keys share the algorithm."""
    first = {key: i for i, key in reversed(list(enumerate(keys)))}
    algorithms = [policies[i].about.algorithm for i in first.values()]
    names: dict[str, str] = {}
    for key, i in first.items():
        name = policies[i].about.algorithm
        if algorithms.count(name) > 1:
            name = re.sub(r"[-_.]?(seed)?[-_.]?\d+$", "", folders[i].absolute().name) or name
        names[key] = name if name not in names.values() else str(folders[i])
    return names
