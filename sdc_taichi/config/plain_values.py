"""Plain values of YAML and JSON texts: mappings, lists, texts, numbers, booleans and nothing.

Both formats allow more than a configuration has a use for. Here a key is given once, and a number
is decimal: YAML 1.1 also reads ``1:30`` as 90 and ``017`` as 15. Its merge key ``<<``, by which a
few lines make millions of keys, is a key like any other.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any, NoReturn

import yaml

from sdc_taichi.errors import shortened
from sdc_taichi.number_text import parse_number, parse_whole

MOST_VALUES = 10_000_000
"""Largest number of values in a text, each repetition of an anchor counted: four times those of
8,192 racks with 64 groups of servers each."""
_PLAIN_TAGS = ("null", "bool", "int", "float", "str", "seq", "map")
_WHOLE = re.compile(r"[-+]?[0-9]+$")
# A subset of YAML 1.1, whose writer puts every other text that YAML 1.1 takes for a number in
# quotes.
_NUMBER = re.compile(
    r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+][0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"
)


def load_yaml(text: str) -> Any:
    """The plain values that a YAML text holds.

    Raises:
        ValueError: not valid, a key given twice, or too many values; says what is wrong.
    """
    try:
        values = yaml.load(text, _Loader)
        count = _count(values, {})
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except KeyError as error:
        # The table of truth values has no such text, as that of a tag !!bool.
        raise ValueError(f"{error} is neither true nor false") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(str(error)) from None
    if count > MOST_VALUES:
        raise ValueError(
            f"{count:,} values, repetitions of anchors counted; valid is at most {MOST_VALUES:,}"
        )
    return values


def load_json(text: str) -> Any:
    """The plain values that a JSON text holds.

    Raises:
        ValueError: not valid, a key given twice, or a number that is not finite; says what is
            wrong.
    """
    try:
        return json.loads(
            text,
            object_pairs_hook=_mapping,
            parse_float=parse_number,
            parse_int=parse_whole,
            parse_constant=_refuse_constant,
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None


class _Loader(yaml.SafeLoader):
    """Reads plain values, and refuses a mapping that gives a key twice.

    Of such a key, YAML would drop the first value.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise _not_valid("expected a mapping", node)
        seen = set()
        for key in [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]:
            if key.value in seen:
                raise _not_valid(f"{shortened(key.value)} is given twice", key)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave a mapping as it is, even where a key has the tag of merge keys."""


def _number_by(parse: Callable[[str], Any]) -> Callable[[_Loader, yaml.ScalarNode], Any]:
    """Constructor of numbers by a function that raises ``ValueError`` for other texts."""

    def construct(loader: _Loader, node: yaml.ScalarNode) -> Any:
        text = loader.construct_scalar(node)
        if text.lower().lstrip("+-") in (".inf", ".nan"):
            return float(text.replace(".", "", 1))
        try:
            return parse(text)
        except ValueError as error:
            raise _not_valid(str(error), node) from None

    return construct


def _set_plain_tags() -> None:
    """Leave the loader the tags of plain values, and resolve numbers that are decimal alone."""
    tags = {f"tag:yaml.org,2002:{name}": name for name in _PLAIN_TAGS}
    constructors: dict[str | None, Any] = {
        tag: getattr(_Loader, f"construct_yaml_{name}") for tag, name in tags.items()
    }
    constructors["tag:yaml.org,2002:int"] = _number_by(parse_whole)
    constructors["tag:yaml.org,2002:float"] = _number_by(parse_number)
    constructors[None] = yaml.SafeLoader.construct_undefined
    _Loader.yaml_constructors = constructors
    plain_tags = [f"tag:yaml.org,2002:{name}" for name in ("null", "bool")]
    _Loader.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag in plain_tags]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for name, pattern in (("int", _WHOLE), ("float", _NUMBER)):
        _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{name}", pattern, list("-+.0123456789"))


_set_plain_tags()


def _not_valid(problem: str, node: yaml.Node) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(problem=problem, problem_mark=node.start_mark)


def _count(values: Any, counted: dict[int, int]) -> int:
    """Number of values in nested mappings and lists; what stands in two places counts twice.

    Args:
        values: the outermost value.
        counted: numbers of those that have been counted, by ``id``; 0 while one is being counted.

    Raises:
        ValueError: a mapping or list holds itself.
    """
    if not isinstance(values, dict | list):
        return 1
    key = id(values)
    if key not in counted:
        counted[key] = 0
        parts = values.values() if isinstance(values, dict) else values
        counted[key] = 1 + sum(_count(part, counted) for part in parts)
    if not counted[key]:
        raise ValueError("an anchor refers to itself")
    return counted[key]


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in pairs:
        if key in values:
            raise ValueError(f"{shortened(key)} is given twice")
        values[key] = value
    return values


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no finite number")
