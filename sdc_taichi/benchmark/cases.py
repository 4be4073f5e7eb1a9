"""Conversion of suite cases and rows to data centers, training settings and seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from sdc_taichi.benchmark.suite import Case, Part, Row, Suite
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import make_controller
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.training_settings import (
    TrainingSettings,
    make_settings,
    merged,
    whole_steps,
)
from sdc_taichi.sim.fleet import build_fleet

_FIXED = ("weeks", "years", "seed", "scenario", "config", "overrides", "sites", "halls")
"""Training settings that the case or the seed determines; a row cannot set them."""


def data_centers(case: Case, part: Part) -> list[DataCenterConfig]:
    """Return the data centers of a part of a case, one for each site.

    Args:
        case: the case.
        part: ``held-out`` for the data centers of the results, ``validation`` for those of the
            training.

    Raises:
        ConfigError: a file, value or site is not valid.
    """
    return _settings_of_data_centers(case, part).data_centers_of_sites()


def number_of_weeks(case: Case, part: Part) -> int:
    """Return the number of weeks of a part of a case, summed over its data centers and years."""
    places = _settings_of_data_centers(case, part).places
    return places * max(len(years_of(case, part)), 1) * len(weeks_of(case, part))


def _settings_of_data_centers(case: Case, part: Part) -> TrainingSettings:
    """Return settings of a training that has the data centers of a part of a case."""
    values = _data_center_values(case)
    if part == "held-out":
        changes = case.test.model_dump(exclude={"years"}, exclude_defaults=True)
        values = merged(values, changes)
    # The settings require an algorithm, which does not affect the data centers.
    return make_settings({"algorithm": "ippo"} | values, "case")


def weeks_of(case: Case, part: Part) -> tuple[int, ...]:
    """Return the weeks of the year, 0..51, of a part of a case."""
    return case.weeks if part == "held-out" else case.validation_weeks


def years_of(case: Case, part: Part) -> tuple[int, ...]:
    """Return the seeds of the synthetic years of a part of a case; empty for that of the sites."""
    return (case.test.years if part == "held-out" else case.validation_years) or case.years


def training_settings(
    case: Case,
    row: Row,
    *,
    objective: str,
    seed: int,
    training: Mapping[str, Any],
    agent: str | None = None,
) -> TrainingSettings:
    """Return the settings for the training of a row in a case.

    Args:
        case: the case.
        row: the row, whose ``train`` is set.
        objective: objective of the suite, by which the best policy is chosen.
        seed: seed of the training.
        training: settings of all trainings of the suite.
        agent: the only agent that learns, beside idle others; None selects the agents of the row.

    Raises:
        ConfigError: a setting is not valid, or is determined by the case.
    """
    settings = merged(training, row.train or {})
    for name in _FIXED:
        if name in settings:
            raise ConfigError(f"train: {name}: is that of the case; valid is without")
    of_case: dict[str, Any] = {
        "weeks": case.training_weeks,
        "years": case.years,
        "seed": seed,
        "tensorboard": False,
        "validation": {
            "weeks": case.validation_weeks,
            "years": years_of(case, "validation"),
            "days": case.days,
            "objective": objective,
            "optimum": case.optimum,
        },
    }
    if case.forecast_error is not None:
        of_case["environment"] = {"forecast_error": asdict(case.error)}
    values = merged(merged(_data_center_values(case), of_case), settings)
    if agent is not None:
        values = merged(values, {"environment": {"agents": [agent], "others": "idle"}})
    return make_settings(values, "train")


def training_steps(training: Mapping[str, Any], train: Mapping[str, Any]) -> int:
    """Return the number of steps of a training, summed over all data centers.

    Args:
        training: settings of all trainings of the suite.
        train: settings of the row.
    """
    default = TrainingSettings.model_fields["steps"].default
    steps = whole_steps({"steps": default, **training, **train}["steps"])
    return int(steps)


def agents_of(settings: TrainingSettings) -> tuple[str, ...]:
    """Return the names of the agents that learn in a training."""
    return tuple(settings.environment.agents or AGENTS)


def number_of_seeds(suite: Suite, case: str, row: str) -> int:
    """Return the number of seeds of a row in a case; 1 if neither row nor case is random.

    A case is random if it samples events or has errors of forecasts, which optima do not have.
    """
    chosen = suite.rows[row]
    if chosen.seeds is not None:
        return chosen.seeds
    settings = suite.cases[case]
    varies = any(dc.events.sampled for dc in data_centers(settings, "held-out")) or (
        settings.forecast_error is not None and chosen.optimum is None
    )
    return suite.seeds if varies or chosen.is_random else 1


def check_suite(suite: Suite) -> None:
    """Check a suite completely before any job runs.

    Raises:
        ConfigError: data centers, controllers or training settings are not valid; the message names
            the case and the row.
    """
    for name, case in suite.cases.items():
        place = f"suite {suite.name}: cases.{name}"
        try:
            configs = data_centers(case, "held-out")
            fleet = build_fleet(configs)
            data_centers(case, "validation")
        except SdcError as error:
            raise ConfigError(f"{place}: {error}") from None
        if fleet.shared_work is not None and suite.objective != "carbon":
            raise ConfigError(
                f"{place}: objective {suite.objective}; valid for fleets that share work is carbon"
            )
        if case.optimum and any(config.events.sampled for config in configs):
            raise ConfigError(
                f"{place}: optimum true with sampled events, which no optimum foresees; valid is "
                "optimum: false"
            )
        for label, row in suite.rows.items():
            if not suite.is_for(label, name):
                continue
            try:
                for spec in row.controllers:
                    make_controller(spec, fleet)
                if row.train is not None:
                    training_settings(
                        case, row, objective=suite.objective, seed=0, training=suite.training
                    )
            except SdcError as error:
                raise ConfigError(f"suite {suite.name}: rows.{label}: {error}") from None
    space = {} if suite.tuning is None else suite.tuning.space
    case = next(iter(suite.cases.values()))
    for algorithm, values in space.items():
        for setting, value in (
            (name, x) for name, of_setting in values.items() for x in of_setting
        ):
            row = Row(train={"algorithm": algorithm, "learning": {setting: value}})
            try:
                training_settings(
                    case, row, objective=suite.objective, seed=0, training=suite.training
                )
            except SdcError as error:
                place = f"suite {suite.name}: tuning.space.{algorithm}.{setting}"
                raise ConfigError(f"{place}: {error}") from None


def _data_center_values(case: Case) -> dict[str, Any]:
    """Return the values of a case that are also training settings: data centers and options."""
    names = {"scenario", "config", "overrides", "sites", "halls", "environment"}
    return case.model_dump(include=names, exclude_defaults=True)
