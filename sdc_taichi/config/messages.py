"""One line on what is wrong with values that a schema refuses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from sdc_taichi.errors import ConfigError, shortened, suggestion_or_valid

Model = TypeVar("Model", bound=BaseModel)

MOST_PROBLEMS = 3
"""Number of problems that a message lists; of further ones it gives the number."""


def validated(model: type[Model], values: Any, label: str) -> Model:
    """Values as a model of pydantic.

    Args:
        model: the schema.
        values: what is to be validated against it.
        label: where the values come from, at the start of every message.

    Raises:
        ConfigError: naming the key, its value and what would be valid.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(explain(error, label, model)) from None


def explain(error: ValidationError, label: str, model: type[BaseModel]) -> str:
    """One line on what is wrong, with key, value and what is valid.

    Args:
        error: what pydantic found.
        label: where the values come from, at the start of the line.
        model: the schema that was validated against.
    """
    problems: dict[str, str] = {}
    for item in error.errors(include_url=False):
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
        # Each branch of a union has a problem of its own; the first says enough.
        problems.setdefault(where, text)
    left_out = len(problems) - MOST_PROBLEMS
    more = f" (and {left_out} more)" if left_out > 0 else ""
    return f"{label}: {'; '.join([*problems.values()][:MOST_PROBLEMS])}{more}"


def _is_union_branch(part: str | int) -> bool:
    """Whether a part of pydantic's location is the tried type of a union and no key of the user."""
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
