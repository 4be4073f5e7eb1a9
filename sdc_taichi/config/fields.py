"""Types of the fields of a configuration, the base of its sections, and messages about bad values.

Every numeric field has a lower and an upper bound, which a test checks. Bounds are physical limits,
not usual values: they allow every real machine, hall and weather, and reject most values in a wrong
unit. The docstrings of the types below, or of the field, explain the bounds.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic_core import CoreSchema, ErrorDetails, PydanticKnownError, core_schema

from sdc_taichi.errors import ConfigError, shortened, similar_names, suggestion_or_valid
from sdc_taichi.exogenous.series import OUTDOOR_LIMITS_C
from sdc_taichi.plant.plants import PLANTS

Share = Annotated[float, Field(ge=0, le=1)]
"""Share, 0..1."""
WorkingShare = Annotated[float, Field(ge=0.01, le=1)]
"""Share of a machine's design flow, or efficiency, 0.01..1: a machine with less than 0.01 does not
work."""
AirC = Annotated[float, Field(ge=0, le=60)]
"""Inlet air temperature of servers, or supply air temperature of CRAC units, 0..60 C: below 0 C
coils freeze, and all ASHRAE classes of servers end far below 60 C (A4: 45 C)."""
OutdoorC = Annotated[float, Field(ge=OUTDOOR_LIMITS_C[0], le=OUTDOOR_LIMITS_C[1])]
"""Outdoor temperature, -90..60 C: the recorded extremes (WMO) are -89.2 C (Vostok 1983) and 56.7 C
(Furnace Creek 1913)."""
DewPointC = Annotated[float, Field(ge=-40, le=35)]
"""Dew point of outdoor air, -40..35 C: from polar air to the highest recorded (Dhahran, 2003)."""
DifferenceK = Annotated[float, Field(ge=-50, le=50)]
"""Difference of two temperatures of a hall or plant, -50..50 K: the difference of the coldest water
and the hottest air is about 50 K."""
RiseK = Annotated[float, Field(ge=0, le=50)]
"""Difference of two temperatures of a hall or plant that cannot be negative, 0..50 K."""
ExchangerK = Annotated[float, Field(ge=0.1, le=50)]
"""Temperature difference of a heat exchanger, 0.1..50 K: the required area grows without limit as
the difference approaches 0 K."""
WaterRangeK = Annotated[float, Field(ge=0.5, le=50)]
"""Temperature difference of supply and return water, 0.5..50 K: the water flow is inversely
proportional to it, and below 0.5 K would be ten times that of any plant."""
LengthM = Annotated[float, Field(ge=0.01, le=1000)]
"""Length within a hall, 0.01..1,000 m; the largest buildings measure about a kilometre."""
Hours = Annotated[float, Field(ge=0.001, le=8760)]
"""Duration of part of a year, 0.001..8,760 h."""
ServerW = Annotated[float, Field(ge=1, le=1e5)]
"""Power of a server at full load, 1..100,000 W: from a single-board computer to a whole rack in one
chassis. The lower bound detects values in kW."""
IdleW = Annotated[float, Field(ge=0, le=1e5)]
"""Power of a server or its fans at any load, 0..100,000 W."""
DeviceW = Annotated[float, Field(ge=0, le=1e9)]
"""Power of a device that serves a whole hall, 0..1e9 W."""
FlowM3sPerW = Annotated[float, Field(ge=1e-5, le=0.01)]
"""Airflow divided by power, 1e-5..0.01 m3/s per W: the power heats the air by 81 K at the lower
bound, more than any server tolerates, and by less than 0.1 K at the upper bound."""
PowerRatio = Annotated[float, Field(ge=0, le=2)]
"""Power divided by power at full load, 0..2: turbo clocks and leakage raise it by less than 2."""
FlowRatio = Annotated[float, Field(ge=-1, le=10)]
"""Airflow of a server divided by its full airflow, at a point of a linear curve, -1..10; the fans
stand still where the curve is below 0."""
CRate = Annotated[float, Field(ge=0.001, le=1000)]
"""Power of a battery divided by its capacity, 0.001..1,000 1/h: from iron-air batteries that
discharge for days to flywheels and capacitors that discharge within seconds."""
Count = Annotated[int, Field(ge=1, le=10_000)]
"""Number of servers or zones of a rack, 1..10,000: more than any rack has."""
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
"""Seed of random numbers, 0..2**63 - 1."""
Text = Annotated[str, Field(max_length=10_000)]
"""Text of up to 10,000 characters."""
Name = Annotated[str, Field(min_length=1, max_length=10_000, pattern=r"\S")]
"""Name of 1 to 10,000 characters, not blank."""
FileName = Annotated[str, Field(min_length=1)]
"""Path of a file."""


class NameIn:
    """Annotation of a text field whose value must be a name in a registry of models."""

    def __init__(self, registry: Mapping[str, object]) -> None:
        self._registry = registry

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._check)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return {"enum": list(self._registry), "type": "string"}

    def _check(self, value: Any) -> str:
        if isinstance(value, str) and value in self._registry:
            return value
        *names, last = map(repr, self._registry)
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(names)} or {last}"})


Plant = Annotated[str, NameIn(PLANTS)]
"""Name of a plant model, see ``plant.plants``."""


class Section(BaseModel):
    """Base class of all sections: frozen, with finite numbers only, and without unknown keys."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, protected_namespaces=()
    )

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_for_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        # Reject booleans explicitly, because Python treats True as 1.
        assert info.field_name is not None
        if cls.model_fields[info.field_name].annotation is not bool and _has_truth(value):
            raise ValueError("should be a number or text, not true or false")
        return value


def _has_truth(value: Any) -> bool:
    """Return True if a value is a boolean, or a list that contains a boolean at any depth."""
    if isinstance(value, list | tuple):
        return any(map(_has_truth, value))
    return isinstance(value, bool)


def _check_ordered(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError(f"({value[0]:g}, {value[1]:g}) must be (low, high) with low < high")
    return value


Ordered = AfterValidator(_check_ordered)
"""Annotation of a pair of numbers whose first must be smaller than its second."""


def check_one_per_rack(name: str, values: Any, racks: int, *, one_for_all: bool = False) -> None:
    """Check that a field has one entry per rack; a value that is not a tuple is always valid.

    Args:
        name: Path of the field, for the error message.
        values: Value of the field.
        racks: Number of racks of the hall.
        one_for_all: True if a tuple of one entry is valid too.

    Raises:
        ValueError: The field has neither one entry per rack nor one for all racks.
    """
    if not isinstance(values, tuple) or len(values) == racks or (one_for_all and len(values) == 1):
        return
    raise ValueError(
        f"{name} has {len(values)} entries, expected {racks} (rows x racks_per_row), "
        "or one value for all"
    )


Model = TypeVar("Model", bound=BaseModel)

MOST_PROBLEMS = 3
"""Largest number of problems that an error message lists; further problems are only counted."""


_MESSAGES = {
    "missing": "missing",
    "greater_than": "should be greater than {gt}",
    "greater_than_equal": "should be greater than or equal to {ge}",
    "less_than": "should be less than {lt}",
    "less_than_equal": "should be less than or equal to {le}",
    "finite_number": "should be a finite number",
    "float_type": "should be a valid number",
    "float_parsing": "should be a valid number",
    "int_type": "should be a valid integer",
    "int_parsing": "should be a valid integer",
    "int_from_float": "should be a valid integer",
    "int_parsing_size": "should be a valid integer of at most 19 digits",
    "bool_type": "should be true or false",
    "bool_parsing": "should be true or false",
    "string_type": "should be a text",
    "string_too_short": "should have at least {min_length} character(s)",
    "string_too_long": "should have at most {max_length} characters",
    "string_pattern_mismatch": "should match the pattern {pattern}",
    "tuple_type": "should be a list",
    "list_type": "should be a list",
    "dict_type": "should be a mapping",
    "mapping_type": "should be a mapping",
    "model_type": "should be a mapping of fields",
    "model_attributes_type": "should be a mapping of fields",
    "too_short": "should be a list of at least {min_length} item(s), not {actual_length}",
    "too_long": "should be a list of at most {max_length} item(s)",
    "literal_error": "should be {expected}",
    "none_required": "should be null",
    "invalid_key": "key should be a text",
    "value_error": "{error}",
    "assertion_error": "{error}",
}
"""Messages by pydantic's type of error, formatted with the context of the error. Pydantic's own
messages name its classes, and not what a file may contain."""
_WRONG_KIND = ("_type", "_parsing", "none_required", "literal_error", "int_from_float", "too_short")
"""Ends of the types of errors that say that a value is of another kind than its field. Pydantic
does not count invalid entries, so a list with an invalid entry may be too short as well."""


def validated(model: type[Model], values: Any, label: str) -> Model:
    """Validate plain values and return them as an object of a pydantic model.

    Args:
        model: Class of the pydantic model.
        values: Plain values to validate.
        label: Source of the values, with which every error message begins.

    Raises:
        ConfigError: A value is invalid; the message names the key, its value and valid values.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(explain(error, label, model, values)) from None


@dataclass(frozen=True)
class _Problem:
    """Invalid value of a key."""

    where: str
    """Dotted path of the key."""
    text: str
    """Rule that the value breaks, such as "should be at least 1"."""
    got: str
    """The value in brackets, and a hint; empty if the value is missing or a section."""
    is_wrong_kind: bool
    """True if the value is of another kind than the field, such as a text for a number."""


def explain(error: ValidationError, label: str, model: type[BaseModel], values: Any) -> str:
    """Return a line of text that names each invalid key, its value and the valid values.

    Args:
        error: Validation error of pydantic.
        label: Source of the values, with which the text begins.
        model: Class of the pydantic model.
        values: Plain values that were validated.
    """
    at_key: dict[str, list[_Problem]] = {}
    # List unknown keys first, because they may be misspellings of missing keys.
    items = error.errors(include_url=False)
    for item in sorted(items, key=lambda item: item["type"] != "extra_forbidden"):
        problem = _problem(item, model, values)
        at_key.setdefault(problem.where, []).append(problem)
    lines = []
    for where, problems in at_key.items():
        # Each branch of a union reports its own problem. A branch that takes values of this kind
        # says what is wrong; the other branches do not matter.
        inside = any(other.startswith(f"{where}.") for other in at_key)
        matching = [problem for problem in problems if not problem.is_wrong_kind]
        if inside and not matching:
            continue
        texts = dict.fromkeys(problem.text for problem in matching[:1] or problems)
        first, *others = texts
        text = " or ".join([first, *(other.removeprefix("should be ") for other in others)])
        lines.append((f"{where}: {text}" if where else text) + problems[0].got)
    left_out = len(lines) - MOST_PROBLEMS
    more = f" (and {left_out} more)" if left_out > 0 else ""
    return f"{label}: {'; '.join(lines[:MOST_PROBLEMS])}{more}"


def _problem(item: ErrorDetails, model: type[BaseModel], values: Any) -> _Problem:
    """Return the problem that an item of a validation error describes."""
    kind, value = item["type"], item["input"]
    parts = _keys_in(values, item["loc"], is_missing=kind in ("missing", "extra_forbidden"))
    where = ".".join(map(str, parts))
    if kind == "extra_forbidden":
        text = f"unknown key{_known_key(model, parts)}"
        return _Problem(where, text, "", is_wrong_kind=False)
    template = _MESSAGES.get(kind)
    context = item.get("ctx", {})
    shown = {k: f"{v:.15g}" if isinstance(v, float) else v for k, v in context.items()}
    text = item["msg"] if template is None else template.format(**shown)
    count = re.search(r"\d+(?= \w+\(s\))", text)
    text = text.replace("(s)", "" if count is not None and count[0] == "1" else "s")
    is_wrong_kind = kind.endswith(_WRONG_KIND)
    is_shown = value is None or isinstance(value, str | int | float | bool)
    is_shown |= is_wrong_kind and isinstance(value, list | tuple | dict)
    got = f" (got {shortened(value)})" if is_shown and kind != "missing" else ""
    if kind.startswith("greater_than") and _is_in_w(parts) and float(value) > 0:
        got += "; power is in W, not kW"
    return _Problem(where, text, got, is_wrong_kind=is_wrong_kind)


def _keys_in(values: Any, location: Sequence[str | int], *, is_missing: bool) -> list[str | int]:
    """Return a location of pydantic without the names of branches of unions.

    Args:
        values: Plain values that were validated.
        location: Location of an error in the values.
        is_missing: True if the last part is a key even if the values do not have it.
    """
    keys: list[str | int] = []
    for i, part in enumerate(location):
        if isinstance(values, BaseModel):
            values = dict(values)
        is_key, inside = False, None
        if isinstance(values, Mapping):
            is_key, inside = part in values, values.get(part)
        elif isinstance(values, list | tuple) and isinstance(part, int):
            is_key, inside = True, values[part] if part < len(values) else None
        if is_key or (is_missing and i == len(location) - 1):
            keys.append(part)
            values = inside
    return keys


def _is_in_w(parts: Sequence[str | int]) -> bool:
    """Return True if a path is that of a power in W, by the name of its field."""
    names = [part for part in parts if isinstance(part, str)]
    return bool(names) and names[-1].endswith("_w") and not names[-1].endswith("_per_w")


def _known_key(model: type[BaseModel], parts: Sequence[str | int]) -> str:
    """Return the end of a message about an unknown key: the key that was probably meant.

    It is a similar key of the same section, the same key of another section, or any key of the
    section.
    """
    *sections, last = parts
    valid = _keys_of(model, sections)
    elsewhere = [
        f"{name}.{last}"
        for name, field in model.model_fields.items()
        if (section := _section_in(field.annotation)) is not None and last in section.model_fields
    ]
    if elsewhere and not similar_names(last, valid):
        return f"; did you mean {elsewhere[0]!r}?"
    return suggestion_or_valid(last, valid)


def _keys_of(model: type[BaseModel], path: Sequence[str | int]) -> list[str]:
    """Return the valid keys of the section at ``path`` in ``model``, ignoring list indices."""
    section = model
    for key in path:
        # Skip keys of mappings, which users choose freely.
        if isinstance(key, str) and key in section.model_fields:
            section = _section_in(section.model_fields[key].annotation) or section
    return list(section.model_fields)


def _section_in(annotation: Any) -> type[BaseModel] | None:
    """Return the section class in a field's type, which may be a list or optional; else None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_section_in, get_args(annotation))), None)
