"""Policies of others run again in some weeks of the case that they were told of."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sdc_taichi.benchmark.cases import data_centers
from sdc_taichi.benchmark.submission import Submission
from sdc_taichi.benchmark.suite_results import RowResult, read_suites
from sdc_taichi.control import PERFECT, Controller, ForecastError, Idle, PerAgent
from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.evaluation import ALL, Contender, evaluate, prepare
from sdc_taichi.learning.policy import FOLDERS, WEIGHTS, Policy
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.optimum.solve import Progress
from sdc_taichi.sim.fleet import Fleet

_SAME = 1e-3
"""Largest relative difference of figures: last bits of other processors, which policies magnify."""


def rerun(submission: Submission, to: Path, weeks: int, progress: Progress | None = None) -> float:
    """Run the policies of a row again in some weeks of each site, and compare the figures.

    Args:
        submission: the row.
        to: folder of the study of its suite.
        weeks: number of weeks of each site, 1 or more and no more than there are.
        progress: is told of the results that are compared.

    Returns:
        Largest relative difference of the figure of a week.

    Raises:
        SdcError: no policies, policies that do not fit, fewer weeks, or figures that are not
            reached again.
    """
    (suite,) = read_suites([to])
    worst = 0.0
    for done, result in enumerate(submission.results):
        if progress is not None:
            progress("running again", done, len(submission.results))
        case = suite.cases.get(result.content["partition"]["case"])
        if case is None or suite.name != submission.suite:
            raise ConfigError(f"{result.folder}: no such case in {to}; valid is its suite")
        chosen = case.settings
        known = len(chosen.weeks)
        if weeks > known:
            raise ConfigError(
                f"verify {weeks}: case {case.name} has {known} weeks; valid are no more"
            )
        error = result.content["metrics"].get("forecast_error")
        with prepare(
            data_centers(chosen, "held-out"),
            [chosen.weeks[known * k // weeks] for k in range(weeks)],
            objective=case.objective,
            optimum=False,
            days=chosen.days,
            seed=result.seed,
            forecast_error=PERFECT if error is None else ForecastError.parse(str(error)),
        ) as prepared:
            controller = _controller(result, prepared.sim.fleet)
            own = evaluate(prepared, [Contender("again", controller)], beside=False).rows
        told = result.frame[result.frame["moves"] == ALL].set_index(["site", "week"])["figure"]
        for site, week, figure in zip(own["site"], own["week"], own["figure"], strict=True):
            stated = float(told.get((site, week), np.nan))
            difference = abs(figure - stated) / max(abs(figure), 1e-12)
            if not difference <= _SAME:
                raise ConfigError(
                    f"{result.folder}: week {week} of {site}: figure {stated:.9g}, and its policy "
                    f"reaches {figure:.9g}; valid are figures of the policy"
                )
            worst = max(worst, difference)
    return worst


def _controller(result: RowResult, fleet: Fleet) -> Controller:
    """The policy of a result, or one for each agent.

    Raises:
        SdcError: there is none, or it does not fit.
    """
    if _holds_policy(result.folder):
        return PolicyController(Policy.load(result.folder), fleet, str(result.folder))
    parts = {name: result.folder / name for name in AGENTS if _holds_policy(result.folder / name)}
    if not parts:
        raise ConfigError(f"{result.folder}: holds no policy; valid is to add it without --verify")
    found: dict[str, Controller] = {
        name: PolicyController(Policy.load(folder), fleet, str(folder))
        for name, folder in parts.items()
    }
    return PerAgent(*(found.get(name, Idle()) for name in AGENTS))


def _holds_policy(folder: Path) -> bool:
    """Whether a folder holds a policy, or a training with one."""
    return any((folder / name / WEIGHTS).is_file() for name in ("", *FOLDERS))
