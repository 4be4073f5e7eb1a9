"""Parsers of YAML and JSON texts into mappings, lists, texts, numbers, booleans and None.

The parsers are stricter than the formats. A key may appear only once in a mapping. All numbers are
decimal, whereas YAML 1.1 reads ``1:30`` as 90 and ``017`` as 15. The merge key ``<<`` of YAML is an
ordinary key.
"""

from __future__ import annotations

import json
import re
from typing import Any, NoReturn

import yaml

from sdc_taichi.errors import shortened
from sdc_taichi.number_text import parse_number, parse_whole

_WHOLE = re.compile(r"[-+]?[0-9]+$")
# This pattern is a subset of the numbers of YAML 1.1. Writers of YAML 1.1 quote every text that
# looks like one of its numbers, so the subset reads their output correctly.
_NUMBER = re.compile(
    r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+][0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"
)


def load_yaml(text: str) -> Any:
    """Parse a YAML text into plain values.

    Raises:
        ValueError: The text is not valid YAML, or a mapping has a key twice.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None


def load_json(text: str) -> Any:
    """Parse a JSON text into plain values.

    Raises:
        ValueError: The text is not valid JSON, a mapping has a key twice, or a number is not
            finite.
    """
    return json.loads(
        text,
        object_pairs_hook=_mapping,
        parse_float=parse_number,
        parse_int=parse_whole,
        parse_constant=_refuse_constant,
    )


class _Loader(yaml.SafeLoader):
    """YAML loader of plain values that rejects mappings with duplicate keys.

    PyYAML itself would silently ignore all but the last value of a duplicate key.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key in [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"{shortened(key.value)} is given twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Do nothing, so that merge keys stay ordinary keys."""


_Loader.yaml_implicit_resolvers = {
    first: [pair for pair in resolvers if pair[0].endswith((":null", ":bool"))]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _name, _pattern in (("int", _WHOLE), ("float", _NUMBER)):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", _pattern, list("-+.0123456789"))
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: parse_whole(node.value))


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in pairs:
        if key in values:
            raise ValueError(f"{shortened(key)} is given twice")
        values[key] = value
    return values


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no finite number")
