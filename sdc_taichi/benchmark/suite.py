"""Suites: which controllers are compared in which weeks of which data centers, as YAML files say.

A suite has cases, each of data centers and weeks, and rows, each a controller or a way to find one.
Every row is run in every case that it is for, and seeds decide all that is random in it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import BeforeValidator, Field, field_validator, model_validator

from sdc_taichi.config import load_config, load_yaml, preset_names, validated
from sdc_taichi.config.fields import Section, Text
from sdc_taichi.control import ForecastError
from sdc_taichi.control.registry import parts_of
from sdc_taichi.errors import ConfigError, SdcError, shortened, suggestion_or_valid
from sdc_taichi.learning.split import DAYS_PER_WEEK, UNSCORED_DAYS, WEEKS, parse_weeks
from sdc_taichi.learning.training_settings import merged, read_values
from sdc_taichi.optimum.objective import Objective

REFERENCE = "reference"
"""Beginning of the names of jobs that solve for optima, which no row may have."""
Part = Literal["held-out", "validation"]
"""Part of a case: the weeks that results are shown for, or those that choices are made by."""
_CONTENT = ("controller", "best_of", "train", "optimum")


def _weeks(value: Any) -> Any:
    """Weeks of the year from the name of a part of the year, or as they are."""
    return parse_weeks(value) if isinstance(value, str) else value


Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=80)]
"""Name of a suite, case or row: lower-case letters, digits, ``.``, ``_`` and ``-``."""
Weeks = Annotated[
    tuple[Annotated[int, Field(strict=True, ge=0, lt=WEEKS)], ...],
    BeforeValidator(_weeks),
    Field(min_length=1),
]
"""Weeks of the year, 0..51: a list, or ``training``, ``validation`` or ``held-out``."""
Seeds = Annotated[int, Field(strict=True, ge=1, le=1000)]
"""Number of seeds, 1..1,000; they are 0, 1 and so on."""


class OtherDataCenters(Section):
    """Data centers that results are shown for, as far as they differ from those trained in."""

    config: Annotated[str, Field(min_length=1)] | dict[str, Any] | None = None
    """Data center: a preset, a file, or the sections of a configuration; None is that of the
    training."""
    overrides: dict[str, Any] = Field(default={})
    """Values put into the configuration on top of those of the training, section by section."""
    sites: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Sites, one data center for each; none are those of the training."""

    @field_validator("config")
    @classmethod
    def _whole(cls, value: Any) -> Any:
        return _content(value)


class Case(Section):
    """Data centers and weeks in which controllers are compared."""

    about: Text = ""
    """Description of the case in a sentence."""
    scenario: str | None = None
    """Scenario of trainings whose data centers and rewards lie beneath those given here; None is
    none."""
    config: Annotated[str, Field(min_length=1)] | dict[str, Any] | None = None
    """Data center: a preset, a file, or the sections of a configuration; None is that of the
    scenario, or preset ``corrected``."""
    overrides: dict[str, Any] = Field(default={})
    """Values put into the configuration, section by section."""
    sites: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Sites, one data center for each; none are those of the scenario, or that of the
    configuration."""
    environment: dict[str, Any] = Field(default={})
    """Options of the environments that trainings learn in, such as their rewards."""
    training_weeks: Weeks = Field(default="training", validate_default=True)
    """Weeks of the year, 0..51, that trainings learn in."""
    validation_weeks: Weeks = Field(default="validation", validate_default=True)
    """Weeks of the year, 0..51, by which the best policy of a training and the best of several
    controllers are chosen."""
    weeks: Weeks = Field(default="held-out", validate_default=True)
    """Weeks of the year, 0..51, that results are shown for."""
    days: Annotated[int, Field(strict=True, gt=UNSCORED_DAYS, le=DAYS_PER_WEEK)] = DAYS_PER_WEEK
    """Days of each held-out and validation week that are run, 2..7; the first is not scored."""
    test: OtherDataCenters = OtherDataCenters()
    """Data centers that results are shown for, as far as they differ from those trained in."""
    optimum: bool = True
    """Whether optima are solved for, which value what is stored or waits at the end of a week, and
    of which the share of the achievable is derived."""

    @field_validator("config")
    @classmethod
    def _whole(cls, value: Any) -> Any:
        return _content(value)

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
    """A controller, or how to find one: ``controller``, ``best_of``, ``train`` or ``optimum``.

    A training is that of ``sdc-taichi train``; what is chosen, is chosen in the validation weeks.
    """

    about: Text = ""
    """Description of the row in a sentence."""
    controller: Annotated[str, Field(min_length=1)] | None = None
    """Controller by name, such as ``g36`` or ``load=greedy-ci,cooling=g36``."""
    best_of: tuple[Annotated[str, Field(min_length=1)], ...] | None = None
    """Controllers by name, of which the one is taken that does best in the validation weeks."""
    train: dict[str, Any] | None = None
    """Settings of a training, on top of those of the case and of the suite."""
    optimum: Literal["achieved", "bound"] | None = None
    """Whether the row is the path that the optimum achieves, or the bound."""
    apart: bool = False
    """Whether each agent of a training is trained alone, the others idle, and all act together
    afterwards."""
    agents_alone: bool = False
    """Whether each agent of what was trained is also run alone, the others idle."""
    forecast_error: str | None = None
    """Errors of the forecasts that the row sees in held-out weeks, such as
    ``ci=0.1,temperature=1``; None is none."""
    seeds: Seeds | None = None
    """Number of seeds, 1..1,000; None is that of the suite where anything is random, and else 1."""
    cases: tuple[Name, ...] | None = None
    """Cases that the row is for; None is all."""

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
        if self.best_of is not None and len(set(self.best_of)) < len(self.best_of):
            raise ValueError(f"best_of: {', '.join(self.best_of)}; valid is each once")
        if self.forecast_error is not None:
            if self.optimum is not None:
                raise ValueError("forecast_error: without effect on an optimum; valid is without")
            ForecastError.parse(self.forecast_error)
        return self

    @property
    def controllers(self) -> tuple[str, ...]:
        """Controllers that the row names."""
        return (self.controller,) if self.controller is not None else self.best_of or ()

    @property
    def is_random(self) -> bool:
        """Whether seeds make a difference to what the row does."""
        if self.train is not None or self.forecast_error is not None:
            return True
        return any("random" in (parts_of(x).values() or [x]) for x in self.controllers)


class Suite(Section):
    """Cases and rows, and what the tables of them are about."""

    name: Name
    """Name of the suite; by default that of its file."""
    title: Text
    """Title of the tables."""
    about: Text = ""
    """Text on what the tables show, and what they do not."""
    objective: str = "carbon"
    """Compared figure, less is better: ``carbon``, ``energy``, ``cost``, ``water``, or a sum such
    as ``carbon+0.002*water``."""
    accounting: Literal["standard", "paper"] = "standard"
    """Units and definitions of the tables: those of this package, or those of the tables of
    SustainDC (NeurIPS 2024)."""
    seeds: Seeds = 5
    """Number of seeds of rows in which anything is random, 1..1,000."""
    training: dict[str, Any] = Field(default={})
    """Settings of all trainings, beneath those of the rows."""
    cases: dict[Name, Case] = Field(min_length=1)
    """Data centers and weeks in which controllers are compared, by name."""
    rows: dict[Name, Row] = Field(min_length=1)
    """Controllers by name, in the order of the tables."""
    quick: dict[str, Any] = Field(default={})
    """Values that replace others for a run of minutes; a case or row that is null is left out."""

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
            if name.startswith(REFERENCE):
                raise ValueError(f"{name}: valid is a name that does not begin with {REFERENCE}")
        return value

    @model_validator(mode="after")
    def _rows_are_for_cases(self) -> Self:
        for name, row in self.rows.items():
            for case in row.cases or ():
                if case not in self.cases:
                    raise ValueError(
                        f"rows.{name}.cases: no case {case!r}; valid: {', '.join(self.cases)}"
                    )
            cases = row.cases if row.cases is not None else tuple(self.cases)
            without = [case for case in cases if not self.cases[case].optimum]
            if row.optimum is not None and without:
                raise ValueError(f"rows.{name}: case {without[0]} has optimum false")
        return self

    def to_yaml(self) -> str:
        """YAML text of all values, ``quick`` left out."""
        values = self.model_dump(mode="json", exclude={"quick"}, exclude_defaults=True)
        return yaml.safe_dump(values, sort_keys=False, allow_unicode=True)

    def is_for(self, row: str, case: str) -> bool:
        """Whether a row is run in a case.

        Args:
            row: name of the row.
            case: name of the case.
        """
        cases = self.rows[row].cases
        return cases is None or case in cases

    def chosen(
        self, *, cases: Sequence[str] = (), rows: Sequence[str] = (), seeds: int | None = None
    ) -> Suite:
        """The suite with some of its cases and rows, or another number of seeds.

        Args:
            cases: names of the cases; none is all.
            rows: names of the rows; none is all.
            seeds: number of seeds; None is that of the suite.

        Raises:
            ConfigError: a name that the suite does not have, or rows that are for none of the
                cases.
        """
        values = self.model_dump()
        values["seeds"] = self.seeds if seeds is None else seeds
        for kind, names in (("cases", cases), ("rows", rows)):
            for name in names:
                if name not in values[kind]:
                    meant = suggestion_or_valid(name, values[kind])
                    raise ConfigError(f"suite {self.name}: no {kind[:-1]} {name!r}{meant}")
            values[kind] = {k: v for k, v in values[kind].items() if not names or k in names}
        for name, row in list(values["rows"].items()):
            if row["cases"] is not None:
                row["cases"] = tuple(case for case in row["cases"] if case in values["cases"])
                if not row["cases"]:
                    del values["rows"][name]
        if not values["rows"]:
            raise ConfigError(f"suite {self.name}: none of these rows is for these cases")
        return make_suite(values, f"suite {self.name}")


def suite_names() -> list[str]:
    """Names of the suites that come with the package."""
    folder = resources.files("sdc_taichi.configs").joinpath("suites")
    return sorted(x.name[:-5] for x in folder.iterdir() if x.name.endswith(".yaml"))


def load_suite(source: str, *, quick: bool = False) -> Suite:
    """Read a suite.

    Args:
        source: name of a suite that comes with the package, or a YAML file.
        quick: whether its quick form is wanted.

    Raises:
        ConfigError: naming the file, the key, the value and what would be valid.
    """
    if source in suite_names():
        label, name = f"suite {source}", source
        folder = resources.files("sdc_taichi.configs").joinpath("suites")
        values = load_yaml(folder.joinpath(f"{source}.yaml").read_text("utf-8"))
    else:
        label, name = source, Path(source).stem
        try:
            values = read_values(source)
        except ConfigError as error:
            if not isinstance(error.__cause__, FileNotFoundError):
                raise
            meant = suggestion_or_valid(source, suite_names())
            raise ConfigError(f"{source}: no such suite or file{meant}") from None
    values = {"name": name} | values
    if quick:
        make_suite(values, label)
        values = _quick(values, label)
    return make_suite(values, label)


def make_suite(values: Mapping[str, Any], label: str = "suite") -> Suite:
    """A suite of plain values.

    Args:
        values: values as in a YAML file.
        label: where they come from, at the start of every message.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    return validated(Suite, values, label)


def _quick(values: Mapping[str, Any], label: str) -> dict[str, Any]:
    """Values of the quick form of a suite.

    Raises:
        ConfigError: it has none, or one of other cases or rows.
    """
    changes = values.get("quick")
    if not changes:
        raise ConfigError(f"{label}: has no quick form; valid is one with values in quick")
    changed = merged({k: v for k, v in values.items() if k != "quick"}, changes)
    for kind in ("cases", "rows"):
        for name in changes.get(kind, ()):
            if name not in values[kind]:
                meant = suggestion_or_valid(name, values[kind])
                raise ConfigError(f"{label}: quick.{kind}: no {kind[:-1]} {name!r}{meant}")
        changed[kind] = {name: x for name, x in changed[kind].items() if x is not None}
    return changed


def _content(value: Any) -> Any:
    """A configuration that a file holds as its sections, since other machines have no such file."""
    if isinstance(value, str) and value not in preset_names():
        try:
            return json.loads(load_config(value).model_dump_json())
        except SdcError as error:
            raise ValueError(str(error)) from None
    return value
