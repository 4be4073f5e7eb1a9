"""Types of the fields of a configuration, the base of its sections, and checks that they share."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field


def _no_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("should be a number")
    return value


def _bounded(value: float) -> float:
    # Beyond any hall, and products of two still fit the kernels' f32.
    if abs(value) > 1e12:
        raise ValueError("should be within -1e12..1e12")
    return value


Finite = Annotated[
    float, BeforeValidator(_no_bool), AfterValidator(_bounded), Field(allow_inf_nan=False)
]
"""Any number within -1e12..1e12."""
Positive = Annotated[Finite, Field(gt=0)]
"""A number above 0."""
NonNegative = Annotated[Finite, Field(ge=0)]
"""A number of at least 0."""
Share = Annotated[Finite, Field(ge=0, le=1)]
"""A number within 0..1."""
PositiveShare = Annotated[Finite, Field(gt=0, le=1)]
"""A number above 0 and at most 1."""
Whole = Annotated[int, BeforeValidator(_no_bool)]
"""Any integer."""
Count = Annotated[Whole, Field(ge=1)]
"""An integer of at least 1."""
Index = Annotated[Whole, Field(ge=0)]
"""An integer of at least 0."""
Pair = tuple[Finite, Finite]
"""Two numbers."""
FileName = Annotated[str, Field(min_length=1)]
"""Path of a file."""


class Section(BaseModel):
    """Base of every section: frozen, and without keys that it does not name."""

    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())


def check_ordered(value: Pair | None) -> Pair | None:
    """A pair unchanged; None passes.

    Raises:
        ValueError: its first entry is not below its second.
    """
    if value is not None and not value[0] < value[1]:
        raise ValueError(f"({value[0]:g}, {value[1]:g}) must be (low, high) with low < high")
    return value


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
