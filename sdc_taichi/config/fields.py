"""Types of the fields of a configuration, the base of its sections, and messages about bad values.

Every numeric field has a lower and an upper bound, which a test checks. Bounds are physical limits
and not usual values: they admit every real machine, hall and weather, and reject most values in a
wrong unit. The types below explain their bounds; a field with bounds of its own explains them in
its docstring.
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
"""A share, 0..1."""
WorkingShare = Annotated[float, Field(ge=0.01, le=1)]
"""A share of a machine's design flow or efficiency, 0.01..1: below a hundredth it is out of
order."""
AirC = Annotated[float, Field(ge=0, le=60)]
"""Temperature of air that servers take in or units supply, 0..60 C: coils freeze below, and no
ASHRAE class of servers (A4: 45 C) comes near the upper end."""
OutdoorC = Annotated[float, Field(ge=OUTDOOR_LIMITS_C[0], le=OUTDOOR_LIMITS_C[1])]
"""Temperature outdoors, -90..60 C: the extremes on record (WMO) are -89.2 C (Vostok 1983) and 56.7
C (Furnace Creek 1913)."""
DewPointC = Annotated[float, Field(ge=-40, le=35)]
"""Dew point of outdoor air, -40..35 C: from polar air to the highest on record (Dhahran, 2003)."""
DifferenceK = Annotated[float, Field(ge=-50, le=50)]
"""Difference of two temperatures of a hall or plant, -50..50 K, from the coldest water to the
hottest air."""
RiseK = Annotated[float, Field(ge=0, le=50)]
"""Difference of two temperatures of a hall or plant of which the second is not below the first,
0..50 K."""
ExchangerK = Annotated[float, Field(ge=0.1, le=50)]
"""Difference of temperatures that drives a heat exchanger, 0.1..50 K: towards 0 K its area has no
limit."""
WaterRangeK = Annotated[float, Field(ge=0.5, le=50)]
"""Temperature difference of supply and return water, 0.5..50 K: the flow is the heat divided by
this range, and below 0.5 K it would be ten times that of any plant."""
LengthM = Annotated[float, Field(ge=0.01, le=1000)]
"""Length within a hall, 0.01..1,000 m; the largest buildings measure about a kilometre."""
Hours = Annotated[float, Field(ge=0.001, le=8760)]
"""Duration of part of a year, 0.001..8,760 h."""
ServerW = Annotated[float, Field(ge=1, le=1e5)]
"""Power of a server at full load, 1..100,000 W: from a single-board computer to a rack in one
chassis; less is power in kW given as W."""
IdleW = Annotated[float, Field(ge=0, le=1e5)]
"""Power of a server or its fans at any load, 0..100,000 W."""
DeviceW = Annotated[float, Field(ge=0, le=1e9)]
"""Power of a device that serves a whole hall, 0..1e9 W."""
FlowM3sPerW = Annotated[float, Field(ge=1e-5, le=0.01)]
"""Airflow per power, 1e-5..0.01 m3/s per W: the power warms the air by 81 K at the lower end, more
than any server tolerates, and by less than 0.1 K at the upper."""
PowerRatio = Annotated[float, Field(ge=0, le=2)]
"""Power divided by that at full load, 0..2: turbo clocks and leakage do not double it."""
FlowRatio = Annotated[float, Field(ge=-1, le=10)]
"""Airflow of a server over its full airflow on a straight line, -1..10; below 0 the fans stand."""
CRate = Annotated[float, Field(ge=0.001, le=1000)]
"""Power of a battery divided by its capacity, 0.001..1,000 1/h: from iron-air batteries that last
for days to flywheels and capacitors that last for seconds."""
Count = Annotated[int, Field(ge=1, le=10_000)]
"""A number of parts, 1..10,000: more servers or zones than any rack has."""
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
"""Seed of random numbers, 0..2**63 - 1."""
Text = Annotated[str, Field(max_length=10_000)]
"""Text of up to 10,000 characters, all of which a file can hold."""
Name = Annotated[str, Field(min_length=1, max_length=10_000, pattern=r"\S")]
"""Name of 1 to 10,000 characters, not blank, all of which a file can hold."""
FileName = Annotated[str, Field(min_length=1)]
"""Path of a file."""


class NameIn:
    """Marks a text field whose value names an entry of a registry of models.

    Args:
        registry: models by their names.
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
"""A plant, see ``plant.plants``."""


class Section(BaseModel):
    """Base of every section: frozen, with finite numbers and no unknown keys."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, protected_namespaces=()
    )

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_for_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        # Python takes True for 1.
        assert info.field_name is not None
        if cls.model_fields[info.field_name].annotation is not bool and _has_truth(value):
            raise ValueError("should be a number or text, not true or false")
        return value


def _has_truth(value: Any) -> bool:
    """Whether a value is a boolean, or a list that contains a boolean at any depth."""
    if isinstance(value, list | tuple):
        return any(map(_has_truth, value))
    return isinstance(value, bool)


def _check_ordered(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError(f"({value[0]:g}, {value[1]:g}) must be (low, high) with low < high")
    return value


Ordered = AfterValidator(_check_ordered)
"""Marks a pair of numbers of which the first is below the second."""


def check_one_per_rack(name: str, values: Any, racks: int, *, one_for_all: bool = False) -> None:
    """Check the number of entries of a field; a value that is no tuple counts for all racks.

    Args:
        name: path of the field, for the message.
        values: the field.
        racks: number of racks of the hall.
        one_for_all: whether a tuple of one entry counts for all racks too.

    Raises:
        ValueError: the field has neither one entry per rack nor one for all.
    """
    if not isinstance(values, tuple) or len(values) == racks or (one_for_all and len(values) == 1):
        return
    raise ValueError(
        f"{name} has {len(values)} entries, expected {racks} (rows x racks_per_row), "
        "or one value for all"
    )


Model = TypeVar("Model", bound=BaseModel)

MOST_PROBLEMS = 3
"""Largest number of problems that a message lists; it only counts further ones."""


def validated(model: type[Model], values: Any, label: str) -> Model:
    """Values as a model of pydantic.

    Args:
        model: the schema.
        values: plain values to validate.
        label: where the values come from, at the start of every message.

    Raises:
        ConfigError: naming the key, its value and what would be valid.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(explain(error, label, model)) from None


def explain(error: ValidationError, label: str, model: type[BaseModel]) -> str:
    """One line that names each wrong key, its value and the valid values.

    Args:
        error: errors of pydantic.
        label: where the values come from, at the start of the line.
        model: the schema.
    """
    problems: dict[str, str] = {}
    # An unknown key may be the misspelling of one that is missing.
    items = error.errors(include_url=False)
    for item in sorted(items, key=lambda item: item["type"] != "extra_forbidden"):
        *sections, last = item["loc"] or ("",)
        parts = [part for part in sections if not _is_union_branch(part)]
        # The last part of these is a key of the user's, whatever it looks like.
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
        # Each branch of a union reports a problem; the first suffices.
        problems.setdefault(where, text)
    left_out = len(problems) - MOST_PROBLEMS
    more = f" (and {left_out} more)" if left_out > 0 else ""
    return f"{label}: {'; '.join([*problems.values()][:MOST_PROBLEMS])}{more}"


def _is_union_branch(part: str | int) -> bool:
    """Whether a part of pydantic's location is a branch of a union, and not a key of the user."""
    return isinstance(part, str) and (part in {"int", "float"} or "[" in part)


def _keys_of(model: type[BaseModel], path: Sequence[str | int]) -> list[str]:
    """Valid keys of the section at ``path`` in ``model``; entries of lists are skipped."""
    section = model
    for key in path:
        # Names of a mapping are the user's.
        if isinstance(key, str) and key in section.model_fields:
            section = _section_in(section.model_fields[key].annotation) or section
    return list(section.model_fields)


def _section_in(annotation: Any) -> type[BaseModel] | None:
    """The schema in a field's type, which may list sections or be optional."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_section_in, get_args(annotation))), None)
