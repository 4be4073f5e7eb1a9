"""Types of the fields of a configuration, the base of its sections, and messages about bad values.

Every numeric field has a lower and an upper bound, which a test checks. Bounds are physical limits,
not usual values: they allow every real machine, hall and weather, and reject most values in a wrong
unit. The docstrings of the types below, or of the field, explain the bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from sdc_taichi.errors import ConfigError, shortened, suggestion_or_valid
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
    """Annotation of a text field whose value must be a name in a registry of models.

    Args:
        registry: Models by their names.
    """

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
        raise ConfigError(explain(error, label, model)) from None


def explain(error: ValidationError, label: str, model: type[BaseModel]) -> str:
    """Return a line of text that names each invalid key, its value and the valid values.

    Args:
        error: Validation error of pydantic.
        label: Source of the values, with which the text begins.
        model: Class of the pydantic model.
    """
    problems: dict[str, str] = {}
    # List unknown keys first, because they may be misspellings of missing keys.
    items = error.errors(include_url=False)
    for item in sorted(items, key=lambda item: item["type"] != "extra_forbidden"):
        *sections, last = item["loc"] or ("",)
        parts = [part for part in sections if not _is_union_branch(part)]
        # For these errors the last part is always a user's key, even if it looks like a branch.
        if item["type"] in ("extra_forbidden", "invalid_key") or not _is_union_branch(last):
            parts.append(last)
        where = ".".join(map(str, parts))
        if item["type"] == "extra_forbidden":
            valid = _keys_of(model, parts[:-1])
            text = f"{where}: unknown key{suggestion_or_valid(last, valid)}"
        elif item["type"] == "missing":
            text = f"{where}: missing"
        else:
            message = item["msg"].removeprefix("Value error, ")
            text = f"{where}: {message}" if where else message
            value = item["input"]
            if value is None or isinstance(value, str | int | float | bool):
                text += f" (got {shortened(value)})"
        # Keep only the first problem at each key, because each branch of a union reports one.
        problems.setdefault(where, text)
    left_out = len(problems) - MOST_PROBLEMS
    more = f" (and {left_out} more)" if left_out > 0 else ""
    return f"{label}: {'; '.join([*problems.values()][:MOST_PROBLEMS])}{more}"


def _is_union_branch(part: str | int) -> bool:
    """Return True if a part of pydantic's location is a branch of a union, not a user's key."""
    return isinstance(part, str) and (part in {"int", "float"} or "[" in part)


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
