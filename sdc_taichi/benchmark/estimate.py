"""Estimate of the processor time of a suite's jobs, before they run.

The times are measured on one core of an AMD EPYC with the suites of the package.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

from sdc_taichi.benchmark.cases import data_centers, number_of_weeks, training_settings, weeks_of
from sdc_taichi.benchmark.jobs import Job
from sdc_taichi.benchmark.suite import TRIAL, Case, Part, Row
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.learning.algorithms import OffPolicySettings, gradient_steps
from sdc_taichi.learning.training_settings import LEAST_DATA_CENTERS, TrainingSettings

START_S = 0.5
"""Processor time of a job with the shortest work, in s."""
OPTIMUM_S_PER_DAY: Mapping[Part, float] = {"held-out": 1.0, "validation": 0.6}
"""Processor time of an optimum, in s per day; in held-out weeks also without coordination."""
PLAN_S_PER_DAY = 0.2
"""Processor time of a controller that plans, in s per data center and day."""
RULES = 60
"""Number of controllers that the search for the best rules tries."""
ALL_STEP_S = 1.2e-3
"""Processor time that a step of a training takes for any number of data centers, in s."""
GRADIENT_STEP_S = 0.02
"""Processor time of a gradient step from a replay buffer, in s."""


class _Pace(NamedTuple):
    """Processor time that one data center takes, by the kind of its hall."""

    run_s_per_day: float
    """Processor time of a controller that does not plan, in s per simulated day."""
    training_step_s: float
    """Processor time of a training step, with the gradient steps of on-policy algorithms, in s."""


_QUASI_STEADY, _LIQUID, _TRANSIENT = _Pace(0.002, 4e-5), _Pace(0.004, 1.8e-4), _Pace(0.1, 7.5e-4)


@lru_cache(maxsize=64)
def _pace_of(case_text: str) -> _Pace:
    """Return the processor times of the first data center of a case, which is given as JSON."""
    config = data_centers(Case.model_validate_json(case_text), "held-out")[0]
    if config.simulation.thermal == "transient":
        return _TRANSIENT
    return _LIQUID if config.liquid_racks() else _QUASI_STEADY


def core_s_of(job: Job) -> float:
    """Return the expected processor time of a job, in s."""
    values = job.values
    case = Case.model_validate(values["case"])
    pace = _pace_of(case.model_dump_json())
    if "part" in values:
        days = len(weeks_of(case, values["part"])) * case.days
        return START_S + days * OPTIMUM_S_PER_DAY[values["part"]]
    row = Row.model_validate(values["row"])
    run_s = START_S
    if not values["name"].startswith(TRIAL):
        per_day_s = PLAN_S_PER_DAY if "mpc" in str(row.controller) else pace.run_s_per_day
        run_s += per_day_s * number_of_weeks(case, "held-out") * case.days
    if "made_by" in values:
        return run_s
    if row.best_of is not None:
        tried = RULES if row.best_of == "rules" else len(row.best_of)
        return run_s + tried * pace.run_s_per_day * number_of_weeks(case, "validation") * case.days
    if row.train is not None:
        settings = training_settings(
            case, row, objective=values["objective"], seed=0, training=values["training"]
        )
        return run_s + _training_s(settings, pace) * (len(AGENTS) if row.apart else 1)
    return run_s


def _training_s(settings: TrainingSettings, pace: _Pace) -> float:
    """Return the expected processor time of a training with its validations, in s."""
    learning, every = settings.learning, settings.validation.steps
    count = settings.data_centers or LEAST_DATA_CENTERS
    seconds = settings.steps * (pace.training_step_s + ALL_STEP_S / count)
    if isinstance(learning, OffPolicySettings):
        updates = settings.steps // (count * learning.steps_per_update(0))
        seconds += GRADIENT_STEP_S * gradient_steps(settings.algorithm, learning, updates)
    if every:
        days = settings.validation_weeks() * settings.validation.days
        seconds += pace.run_s_per_day * days * (settings.steps // every)
    return seconds
