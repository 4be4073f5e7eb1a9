"""Benchmark suites: YAML files that define which controllers are compared in which data centers.

A suite has cases and rows. A case is a set of data centers and weeks. A row is a controller, or a
method that finds one, such as a training. Each row runs in the cases that it is intended for, once
per seed; the seed determines everything that is random.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import yaml
from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from sdc_taichi.config import load_config, load_yaml, preset_names, validated
from sdc_taichi.config.fields import Section, Text
from sdc_taichi.control import PERFECT, ForecastError
from sdc_taichi.control.registry import parts_of
from sdc_taichi.errors import ConfigError, SdcError, shortened, suggestion_or_valid
from sdc_taichi.learning.split import DAYS_PER_WEEK, UNSCORED_DAYS, WEEKS, parse_weeks
from sdc_taichi.learning.training_settings import (
    MOST_STEPS,
    SCENARIOS,
    HallDraws,
    Years,
    merged,
    read_values,
)
from sdc_taichi.optimum.objective import Objective

REFERENCE, TRIAL = "reference", "trial"
"""Name prefixes of jobs that compute optima, and of trials of settings; names of rows must not
begin with them."""
Part = Literal["held-out", "validation"]
"""Part of a case: held-out weeks for the results, or validation weeks for choices."""
_QUICK: Mapping[str, Any] = {
    "seeds": 1,
    "training": {"steps": 100_000, "data_centers": 32, "validation": {"steps": 50_000}},
}
"""Values of the short version of every suite, beside those that depend on its cases."""
_QUICK_DAYS, _QUICK_PLACES, _QUICK_TRAINING_WEEKS, _QUICK_CANDIDATES = 3, 2, 8, 16
"""Short version: days of a week, sites and weeks of results and validation, training weeks, and
candidates of cross-entropy, of which there are no more than data centers."""
_CONTENT = ("controller", "best_of", "train", "optimum")
_OF_RESULTS = ("about", "trained_in", "test", "weeks", "rows")
"""Fields of a case with ``trained_in`` that may differ from those of the other case."""


def _weeks(value: Any) -> Any:
    """Convert text such as ``held-out`` to weeks of the year; return other values unchanged."""
    return parse_weeks(value) if isinstance(value, str) else value


def _content(value: Any) -> Any:
    """Replace the path of a configuration file by its content, which other machines can read."""
    if isinstance(value, str) and value not in preset_names():
        try:
            return json.loads(load_config(value).model_dump_json())
        except SdcError as error:
            raise ValueError(str(error)) from None
    return value


Source = Annotated[
    Annotated[str, Field(min_length=1)] | dict[str, Any] | None, AfterValidator(_content)
]
"""Configuration of a data center: a preset, a file, or the sections of a configuration."""
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=80)]
"""Name of a suite, case or row: lower-case letters, digits, ``.``, ``_`` and ``-``."""
Weeks = Annotated[
    tuple[Annotated[int, Field(strict=True, ge=0, lt=WEEKS)], ...],
    BeforeValidator(_weeks),
    Field(min_length=1),
]
"""Weeks of the year, 0..51: a list, or ``training``, ``validation`` or ``held-out``."""
Seeds = Annotated[int, Field(strict=True, ge=1, le=1000)]
"""Number of seeds, 1..1,000; the seeds are 0, 1, 2 and so on."""


class OtherDataCenters(Section):
    """Data centers for the results of a case, if they differ from those of the training."""

    config: Source = None
    """Configuration of the data center: a preset, a file, or the sections of a configuration; None
    selects that of the training."""
    overrides: dict[str, Any] = Field(default={})
    """Values that replace those of the configuration and of the training's overrides, by
    section."""
    sites: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Sites, with one data center for each site; an empty list selects those of the training."""
    halls: HallDraws | None = None
    """Halls drawn at random; None selects those of the training."""
    years: Years = ()
    """Seeds of the synthetic years of each data center; an empty list selects those of the
    training."""


class Case(Section):
    """Data centers and weeks in which controllers are compared."""

    about: Text = ""
    """Description of the case in one sentence."""
    trained_in: Name | None = None
    """Name of another case, in which the policies of trained rows learn and the best of several
    controllers is chosen. All fields but those of the results are those of that case."""
    scenario: str | None = None
    """Training scenario that provides default data centers and rewards; None selects no
    scenario."""
    config: Source = None
    """Configuration of the data center: a preset, a file, or the sections of a configuration; None
    selects that of the scenario, or preset ``corrected``."""
    overrides: dict[str, Any] = Field(default={})
    """Values that replace those of the configuration, by section."""
    sites: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Sites, with one data center for each site; an empty list selects the sites of the scenario,
    or the site of the configuration."""
    halls: HallDraws | None = None
    """Halls drawn at random from the family of the configuration, which have the sites in turn;
    None selects the hall of the configuration."""
    years: Years = ()
    """Seeds of the synthetic years of the training, which pairs of site and week have in turn; an
    empty list selects the year of the configuration."""
    validation_years: Years = ()
    """Seeds of the synthetic years of each data center in the validation weeks; an empty list
    selects those of the training."""
    environment: dict[str, Any] = Field(default={})
    """Options of the training environments, such as their rewards."""
    forecast_error: str | None = None
    """Errors of the forecasts in training, validation and held-out weeks, such as
    ``ci=0.1,temperature=1``; None gives perfect forecasts."""
    training_weeks: Weeks = Field(default="training", validate_default=True)
    """Weeks of the year, 0..51, in which agents learn."""
    validation_weeks: Weeks = Field(default="validation", validate_default=True)
    """Weeks of the year, 0..51, for choosing the best policy of a training and the best of several
    controllers."""
    weeks: Weeks = Field(default="held-out", validate_default=True)
    """Weeks of the year, 0..51, for which results are reported."""
    days: Annotated[int, Field(strict=True, gt=UNSCORED_DAYS, le=DAYS_PER_WEEK)] = DAYS_PER_WEEK
    """Number of days simulated in each held-out and validation week, 2..7; the first day is not
    scored."""
    test: OtherDataCenters = OtherDataCenters()
    """Data centers for the results, if they differ from those of the training."""
    rows: tuple[Name, ...] | None = None
    """Names of the rows that run in the case; None selects those whose ``cases`` has it."""
    optimum: bool = True
    """True to compute optima, which give the share of the achievable saving, and the value of
    stored energy and waiting work at the end of a week."""

    def short(self) -> dict[str, Any]:
        """Return the values of the case that differ in the short version of a suite."""
        sites = self.sites or SCENARIOS.get(self.scenario or "", {}).get("sites", ())
        years = self.validation_years or self.years
        years_of_results = self.test.years or self.years
        test = {"sites": self.test.sites[:_QUICK_PLACES], "years": years_of_results[:1]}
        of_results = {
            "weeks": _spread(self.weeks, _QUICK_PLACES),
            "test": {name: list(x) for name, x in test.items() if x},
        }
        if self.trained_in is not None:
            return of_results
        return of_results | {
            "sites": list(sites[:_QUICK_PLACES]),
            "training_weeks": _spread(self.training_weeks, _QUICK_TRAINING_WEEKS),
            "validation_weeks": _spread(self.validation_weeks, _QUICK_PLACES),
            "validation_years": list(years[:1]),
            "days": min(self.days, _QUICK_DAYS),
        }

    @property
    def error(self) -> ForecastError:
        """Sizes of the errors of the forecasts."""
        return PERFECT if self.forecast_error is None else ForecastError.parse(self.forecast_error)

    @field_validator("forecast_error")
    @classmethod
    def _has_sizes(cls, value: str | None) -> str | None:
        if value is not None:
            ForecastError.parse(value)
        return value

    @model_validator(mode="after")
    def _nothing_is_chosen_on_held_out_weeks(self) -> Self:
        for name in ("training_weeks", "validation_weeks", "weeks"):
            weeks = getattr(self, name)
            if len(set(weeks)) < len(weeks):
                raise ValueError(f"{name} {list(weeks)}: valid is each week once")
        for name in ("training_weeks", "validation_weeks"):
            both = sorted(set(getattr(self, name)) & set(self.weeks))
            if both:
                raise ValueError(
                    f"{name}: week {both[0]} stands in weeks too, by which nothing may be chosen"
                )
        return self


class Row(Section):
    """Entry of a suite that is compared with others: a controller, or a method that finds one.

    Exactly one of ``controller``, ``best_of``, ``train`` and ``optimum`` is set. Choices are made
    in the validation weeks.
    """

    about: Text = ""
    """Description of the row in one sentence."""
    controller: Annotated[str, Field(min_length=1)] | None = None
    """Name of a controller, such as ``g36`` or ``load=greedy-ci,cooling=g36``."""
    best_of: tuple[Annotated[str, Field(min_length=1)], ...] | Literal["rules"] | None = None
    """Names of controllers, of which the row uses the one with the best result in the validation
    weeks; or ``rules`` for a rule for each agent that ``benchmark.rules_search`` finds in these
    weeks."""
    train: dict[str, Any] | None = None
    """Settings of a training, as for ``sdc-taichi train``; they take precedence over those of the
    case and of the suite."""
    optimum: Literal["achieved", "bound"] | None = None
    """Reference from the optimum: ``achieved`` for the path that the optimum achieves in
    simulation, ``bound`` for the bound of the objective."""
    apart: bool = False
    """True to train the agents one after another (load, cooling, battery), each while those that
    were trained before act and the others are idle, and to run all agents together afterwards."""
    agents_alone: bool = False
    """True to run each trained agent also alone, while the others are idle."""
    seeds: Seeds | None = None
    """Number of seeds, 1..1,000; None selects the number of the suite for rows with randomness, and
    1 for others."""
    cases: tuple[Name, ...] | None = None
    """Cases in which the row runs; None selects all cases. A case with ``rows`` decides itself."""

    @model_validator(mode="after")
    def _is_one_thing(self) -> Self:
        contents = [name for name in _CONTENT if getattr(self, name) is not None]
        if len(contents) != 1:
            names = " and ".join(contents) or "nothing"
            raise ValueError(f"{names} given; valid is one of {', '.join(_CONTENT)}")
        for name in ("apart", "agents_alone"):
            if getattr(self, name) and self.train is None:
                raise ValueError(f"{name}: valid with train")
        if self.best_of is not None and not self.best_of:
            raise ValueError("best_of: none given; valid is one or more")
        if len(set(self.controllers)) < len(self.controllers):
            raise ValueError(f"best_of: {', '.join(self.controllers)}; valid is each once")
        return self

    @property
    def chooses(self) -> bool:
        """True if the controller of the row is trained, or chosen among several."""
        return self.train is not None or self.best_of is not None

    @property
    def controllers(self) -> tuple[str, ...]:
        """Names of the controllers in ``controller`` or ``best_of``."""
        if self.controller is not None:
            return (self.controller,)
        return self.best_of if isinstance(self.best_of, tuple) else ()

    @property
    def is_random(self) -> bool:
        """True if the behaviour of the row depends on the seed, also with perfect forecasts."""
        if self.train is not None:
            return True
        return any("random" in (parts_of(x).values() or [x]) for x in self.controllers)


class Tuning(Section):
    """Search for settings of trainings, with the same number of trials for each algorithm.

    Trial 0 has the default settings. Each other trial draws a value of each setting. The settings
    with the best result in the validation weeks are those of all rows of the algorithm.
    """

    trials: Annotated[int, Field(strict=True, ge=1, le=1000)]
    """Number of trials of each algorithm in each case, 1..1,000."""
    steps: Annotated[int, Field(strict=True, ge=1, le=MOST_STEPS)]
    """Number of steps of a trial, summed over all data centers."""
    space: dict[str, dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]]]
    """Values of each setting in section ``learning``, by setting, by algorithm."""

    def learning(self, algorithm: str, trial: int) -> dict[str, Any]:
        """Return the settings of a trial, which are random but always the same.

        Args:
            algorithm: name of the algorithm.
            trial: number of the trial, from 0; trial 0 has the default settings.
        """
        seed = np.random.SeedSequence([trial, *algorithm.encode()])
        generator = np.random.Generator(np.random.PCG64(seed))
        drawn = {
            name: values[int(generator.integers(len(values)))]
            for name, values in self.space[algorithm].items()
        }
        return drawn if trial else {}


class Suite(Section):
    """Benchmark suite: cases and rows, with the objective and the texts of the result tables."""

    name: Name
    """Name of the suite; the default is the name of its file."""
    title: Text
    """Title of the result tables."""
    about: Text = ""
    """Text that explains what the tables show and what they do not show."""
    objective: str = "carbon"
    """Objective by which rows are compared, lower is better: ``carbon``, ``energy``, ``cost``,
    ``water``, or a sum such as ``carbon+0.002*water``."""
    accounting: Literal["standard", "paper"] = "standard"
    """Units and definitions of the tables: ``standard`` for those of this package, ``paper`` for
    those of the SustainDC paper (NeurIPS 2024)."""
    seeds: Seeds = 5
    """Number of seeds of rows with randomness, 1..1,000."""
    training: dict[str, Any] = Field(default={})
    """Default settings of all trainings; settings of a row take precedence."""
    tuning: Tuning | None = None
    """Search for the settings of trainings; None trains with the settings of the rows alone."""
    cases: dict[Name, Case] = Field(min_length=1)
    """Data centers and weeks in which controllers are compared, by name."""
    rows: dict[Name, Row] = Field(min_length=1)
    """Controllers and methods to compare, by name, in the order of the tables."""
    quick: dict[str, Any] = Field(default={})
    """Values that replace others in the short version of the suite, which runs in minutes; the
    value null removes a case or row. By default it has two sites in one year, two weeks of three
    days, short trainings and no tuning."""

    @field_validator("objective")
    @classmethod
    def _is_one(cls, value: str) -> str:
        return str(Objective.parse(value))

    @field_validator("quick")
    @classmethod
    def _sections_are_by_name(cls, value: dict[str, Any]) -> dict[str, Any]:
        for kind in ("cases", "rows"):
            if not isinstance(value.get(kind, {}), dict):
                raise ValueError(f"{kind} {shortened(value[kind])}; valid are {kind} by name")
        return value

    @field_validator("rows")
    @classmethod
    def _names_are_free(cls, value: dict[str, Row]) -> dict[str, Row]:
        for name in value:
            if name.startswith((REFERENCE, TRIAL)):
                valid = f"a name that does not begin with {REFERENCE} or {TRIAL}"
                raise ValueError(f"{name}: valid is {valid}")
        return value

    @model_validator(mode="before")
    @classmethod
    def _cases_have_fields_of_others(cls, values: Any) -> Any:
        """Add to cases with ``trained_in`` the fields of the other case."""
        cases = values.get("cases") if isinstance(values, Mapping) else None
        if not isinstance(cases, Mapping):
            return values
        filled = dict(cases)
        for name, case in cases.items():
            trained_in = case.get("trained_in") if isinstance(case, Mapping) else None
            other = cases.get(trained_in) if isinstance(trained_in, str) else None
            if isinstance(other, Mapping):
                base = {k: v for k, v in other.items() if k not in ("about", "rows")}
                filled[name] = merged(base, case)
        return {**values, "cases": filled}

    @model_validator(mode="after")
    def _cases_are_trained_in_others(self) -> Self:
        trained = {name: case.trained_in for name, case in self.cases.items() if case.trained_in}
        for name, other in trained.items():
            valid = [x for x in self.cases if x not in trained]
            if other not in valid:
                raise ValueError(f"cases.{name}.trained_in {other!r}; valid: {', '.join(valid)}")
            for field in Case.model_fields:
                equal = getattr(self.cases[name], field) == getattr(self.cases[other], field)
                if field not in _OF_RESULTS and not equal:
                    raise ValueError(f"cases.{name}.{field}: is that of {other}; valid is without")
            for label, row in self.rows.items():
                if row.chooses and self.is_for(label, name) and not self.is_for(label, other):
                    raise ValueError(f"rows.{label}: runs in case {name}, and not in {other}")
        return self

    @model_validator(mode="after")
    def _rows_are_for_cases(self) -> Self:
        for name, row in self.rows.items():
            for case in row.cases or ():
                if case not in self.cases:
                    raise ValueError(
                        f"rows.{name}.cases: no case {case!r}; valid: {', '.join(self.cases)}"
                    )
            without = [x for x, case in self.cases.items() if not case.optimum]
            without = [case for case in without if self.is_for(name, case)]
            if row.optimum is not None and without:
                raise ValueError(f"rows.{name}: case {without[0]} has optimum false")
        for name, settings in self.cases.items():
            for label in settings.rows or ():
                if label not in self.rows:
                    raise ValueError(
                        f"cases.{name}.rows: no row {label!r}; valid: {', '.join(self.rows)}"
                    )
        return self

    def to_yaml(self) -> str:
        """Return the suite as YAML text, from which ``load_suite`` reads an equal suite."""
        return yaml.safe_dump(self._values(), sort_keys=False, allow_unicode=True)

    def _values(self) -> dict[str, Any]:
        """Return the plain values that are not defaults or those of another case."""
        values = self.model_dump(mode="json", exclude_defaults=True)
        cases = values["cases"]
        for name, case in self.cases.items():
            if case.trained_in is not None:
                cases[name] = _without(cases[name], cases[case.trained_in])
        return values

    def short(self, label: str) -> Suite:
        """Return the short version of the suite.

        Args:
            label: origin of the suite, which begins every error message.

        Raises:
            ConfigError: ``quick`` names unknown cases or rows, or a value is not valid.
        """
        values = self._values()
        values.pop("tuning", None)
        changes = values.pop("quick", {})
        for kind in ("cases", "rows"):
            for name in changes.get(kind, ()):
                if name not in values[kind]:
                    meant = suggestion_or_valid(name, values[kind])
                    raise ConfigError(f"{label}: quick.{kind}: no {kind[:-1]} {name!r}{meant}")
        cases = {name: case.short() for name, case in self.cases.items()}
        rows: dict[str, Any] = {}
        for name, row in self.rows.items():
            if row.train is not None and "steps" in row.train:
                rows[name] = {"train": {"steps": _QUICK["training"]["steps"]}}
            elif row.train is not None and row.train.get("algorithm") == "cross-entropy":
                rows[name] = {"train": {"learning": {"candidates": _QUICK_CANDIDATES}}}
        values = merged(merged(values, {**_QUICK, "cases": cases, "rows": rows}), changes)
        return make_suite(_without_null(values), label)

    def is_for(self, row: str, case: str) -> bool:
        """Return True if a row runs in a case.

        Args:
            row: name of the row.
            case: name of the case.
        """
        if (rows := self.cases[case].rows) is not None:
            return row in rows
        cases = self.rows[row].cases
        return cases is None or case in cases

    def chosen(
        self, *, cases: Sequence[str] = (), rows: Sequence[str] = (), seeds: int | None = None
    ) -> Suite:
        """Return the suite reduced to selected cases and rows, or with another number of seeds.

        Args:
            cases: names of the cases; an empty sequence selects all cases. Cases that these were
                trained in are added.
            rows: names of the rows; an empty sequence selects all rows.
            seeds: number of seeds; None selects the number of the suite.

        Raises:
            ConfigError: the suite has no case or row with a given name, or no selected row runs in
                a selected case.
        """
        values = self.model_dump()
        values["seeds"] = self.seeds if seeds is None else seeds
        for kind, names in (("cases", cases), ("rows", rows)):
            for name in names:
                if name not in values[kind]:
                    meant = suggestion_or_valid(name, values[kind])
                    raise ConfigError(f"suite {self.name}: no {kind[:-1]} {name!r}{meant}")
            chosen = [*names, *(self.cases[x].trained_in for x in names if kind == "cases")]
            values[kind] = {k: v for k, v in values[kind].items() if not names or k in chosen}
        for case in values["cases"].values():
            if case["rows"] is not None:
                case["rows"] = tuple(row for row in case["rows"] if row in values["rows"])
        for name, row in list(values["rows"].items()):
            if row["cases"] is not None:
                row["cases"] = tuple(case for case in row["cases"] if case in values["cases"])
                if not row["cases"]:
                    del values["rows"][name]
        if not values["rows"]:
            raise ConfigError(f"suite {self.name}: none of these rows is for these cases")
        for kind in values["quick"].keys() & {"cases", "rows"}:
            changes = values["quick"][kind]
            values["quick"][kind] = {k: v for k, v in changes.items() if k in values[kind]}
        for name, changes in values["quick"].get("rows", {}).items():
            if changes and changes.get("cases"):
                remaining = [case for case in changes["cases"] if case in values["cases"]]
                values["quick"]["rows"][name] = (
                    {**changes, "cases": remaining} if remaining else None
                )
        return make_suite(values, f"suite {self.name}")


def suite_names() -> list[str]:
    """Return the names of the suites that are part of the package."""
    folder = resources.files("sdc_taichi.configs").joinpath("suites")
    return sorted(x.name[:-5] for x in folder.iterdir() if x.name.endswith(".yaml"))


def load_suite(source: str, *, quick: bool = False, allow_code: bool = False) -> Suite:
    """Read a suite.

    Args:
        source: name of a suite in the package, or path of a YAML file.
        quick: True to read the short version of the suite.
        allow_code: True if import paths ``module:name`` in a file are valid.

    Raises:
        ConfigError: a value is not valid; the message names the file, the key, the value and valid
            values.
    """
    if source in suite_names():
        label, name = f"suite {source}", source
        folder = resources.files("sdc_taichi.configs").joinpath("suites")
        values = load_yaml(folder.joinpath(f"{source}.yaml").read_text("utf-8"))
    else:
        label, name = source, Path(source).stem
        try:
            values = read_values(source, allow_code=allow_code)
        except ConfigError as error:
            if not isinstance(error.__cause__, FileNotFoundError):
                raise
            meant = suggestion_or_valid(source, suite_names())
            raise ConfigError(f"{source}: no such suite or file{meant}") from None
    suite = make_suite(_extended({"name": name} | values, label), label)
    return suite.short(label) if quick else suite


def make_suite(values: Mapping[str, Any], label: str = "suite") -> Suite:
    """Create a checked suite from plain values.

    Args:
        values: values as in a YAML file.
        label: origin of the values, which begins every error message.

    Raises:
        ConfigError: a value is not valid; the message names the key, the value and valid values.
    """
    return validated(Suite, values, label)


def _spread(weeks: Sequence[int], number: int) -> list[int]:
    """Return at most a number of weeks, spread evenly over those given."""
    return [*weeks[:: max(len(weeks) // number, 1)][:number]]


def _without_null(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a suite without the cases and rows that are null."""
    kept = {
        kind: {name: x for name, x in values[kind].items() if x is not None}
        for kind in ("cases", "rows")
        if isinstance(values.get(kind), Mapping)
    }
    return {**values, **kept}


def _extended(values: Mapping[str, Any], label: str) -> dict[str, Any]:
    """Return the values of a suite on top of those of the suite that it extends, if it does.

    Raises:
        ConfigError: ``extends`` is not the name of a suite of the package.
    """
    base = values.get("extends")
    if base is None:
        return dict(values)
    if base not in suite_names():
        meant = suggestion_or_valid(str(base), suite_names())
        raise ConfigError(f"{label}: extends {shortened(base)}{meant}")
    over = {name: value for name, value in values.items() if name != "extends"}
    return _without_null(merged(load_suite(base)._values(), over))


def _without(values: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values without those that ``base`` has too, as ``merged`` adds them again."""
    return {
        name: _without(value, base[name]) if isinstance(value, Mapping) and name in base else value
        for name, value in values.items()
        if name not in base or base[name] != value
    }
