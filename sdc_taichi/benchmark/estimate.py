"""Estimate of the processor time of a suite's jobs, before they run.

The times are measured on one core of an AMD EPYC with preset ``corrected``; halls with more racks,
fleets and liquid cooling take longer.
"""

from __future__ import annotations

from collections.abc import Mapping

from sdc_taichi.benchmark.cases import number_of_weeks, training_settings, weeks_of
from sdc_taichi.benchmark.jobs import Job
from sdc_taichi.benchmark.suite import TRIAL, Case, Part, Row
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.learning.algorithms import OffPolicySettings, gradient_steps
from sdc_taichi.learning.training_settings import LEAST_DATA_CENTERS, TrainingSettings

START_S = 2.0
"""Processor time of a job with the shortest work, in s."""
OPTIMUM_S_PER_DAY: Mapping[Part, float] = {"held-out": 1.0, "validation": 0.6}
"""Processor time of an optimum, in s per day; in held-out weeks also without coordination."""
RUN_S_PER_DAY, PLAN_S_PER_DAY = 0.005, 0.2
"""Processor time of running a controller, and of one that plans, in s per data center and day."""
RULES = 60
"""Number of controllers that the search for the best rules tries."""
STEPS_PER_S = 15_000.0
"""Steps of a training per s of processor time, with the gradient steps of on-policy algorithms."""
GRADIENT_STEP_S = 0.02
"""Processor time of a gradient step from a replay buffer, in s."""


def core_s_of(job: Job) -> float:
    """Return the expected processor time of a job, in s.

    Args:
        job: a job of a suite.
    """
    values = job.values
    case = Case.model_validate(values["case"])
    if "part" in values:
        days = len(weeks_of(case, values["part"])) * case.days
        return START_S + days * OPTIMUM_S_PER_DAY[values["part"]]
    row = Row.model_validate(values["row"])
    run_s = START_S
    if not values["name"].startswith(TRIAL):
        per_day_s = PLAN_S_PER_DAY if "mpc" in str(row.controller) else RUN_S_PER_DAY
        run_s += per_day_s * number_of_weeks(case, "held-out") * case.days
    if "made_by" in values:
        return run_s
    if row.best_of is not None:
        tried = RULES if row.best_of == "rules" else len(row.best_of)
        return run_s + tried * RUN_S_PER_DAY * number_of_weeks(case, "validation") * case.days
    if row.train is not None:
        settings = training_settings(
            case, row, objective=values["objective"], seed=0, training=values["training"]
        )
        return run_s + _training_s(settings) * (len(AGENTS) if row.apart else 1)
    return run_s


def _training_s(settings: TrainingSettings) -> float:
    """Return the expected processor time of a training with its validations, in s."""
    learning, every = settings.learning, settings.validation.steps
    seconds = settings.steps / STEPS_PER_S
    if isinstance(learning, OffPolicySettings):
        count = settings.data_centers or LEAST_DATA_CENTERS
        updates = settings.steps // (count * learning.steps_per_update(0))
        seconds += GRADIENT_STEP_S * gradient_steps(settings.algorithm, learning, updates)
    if every:
        days = settings.validation_weeks() * settings.validation.days
        seconds += RUN_S_PER_DAY * days * (settings.steps // every)
    return seconds
