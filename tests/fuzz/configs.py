"""Configurations: every leaf of the schema, damaged YAML, overrides and the SustainDC format."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import yaml

from fuzz import damage, physics
from fuzz.case import DefectError, Scratch
from sdc_taichi import DataCenterConfig, load_config
from test_malformed_config import DC_CONFIG

BASES = ("tiny",) * 6 + ("corrected",) * 2 + ("sustaindc", "paper")
MODELS = 0.12
"""Share of the drawn leaves that may be names of models, each of which compiles a kernel."""

Schema = dict[str, Any]


@cache
def schema() -> Schema:
    """JSON schema of a data center."""
    return DataCenterConfig.model_json_schema()


def resolved(part: Schema) -> Schema:
    """A part of the schema, in place of its reference."""
    name = part.get("$ref")
    return schema()["$defs"][name.rpartition("/")[2]] if name else part


@cache
def leaves() -> tuple[tuple[tuple[str, ...], Schema], ...]:
    """Path and schema of each field that is no section."""

    def walk(part: Schema, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Schema]]:
        part = resolved(part)
        if "properties" not in part:
            yield path, part
        for name, inner in part.get("properties", {}).items():
            yield from walk(inner, (*path, name))

    return tuple(walk(schema(), ()))


def valid_value(rng: np.random.Generator, part: Schema) -> Any:
    """A plain value that the schema of a field allows, at its bounds as often as between them."""
    part = resolved(part)
    if "anyOf" in part:
        return valid_value(rng, part["anyOf"][int(rng.integers(len(part["anyOf"])))])
    if "enum" in part:
        return part["enum"][int(rng.integers(len(part["enum"])))]
    kind = part.get("type")
    if kind == "object" and "properties" not in part:
        names = rng.choice(["cpu", "gpu", "2", "ü"], int(rng.integers(3)), replace=False)
        (inner,) = part.get("patternProperties", {"": part.get("additionalProperties")}).values()
        return {str(name): valid_value(rng, inner) for name in names}
    if kind == "object":
        needed = part.get("required", ())
        return {
            name: valid_value(rng, inner)
            for name, inner in part["properties"].items()
            if name in needed or rng.random() < 0.3
        }
    if kind == "array":
        items = part.get("prefixItems")
        if items is None:
            items = [part["items"]] * int(rng.choice([0, 1, 1, 2, 4, 20]))
        return [valid_value(rng, item) for item in items]
    if kind == "boolean":
        return bool(rng.integers(2))
    if kind in ("number", "integer"):
        return _number(rng, part, whole=kind == "integer")
    if kind == "string":
        return str(rng.choice(["NY", "ca", "alibaba_2", "07-01", "some text", "2", "null", "ü"]))
    return None


def _number(rng: np.random.Generator, part: Schema, *, whole: bool) -> float | int:
    low = part.get("minimum", part.get("ge", part.get("exclusiveMinimum", part.get("gt"))))
    high = part.get("maximum", part.get("le", part.get("exclusiveMaximum", part.get("lt"))))
    low, high = (-1e3 if low is None else low), (1e4 if high is None else high)
    kind = int(rng.integers(5))
    if kind == 0:
        value = float(rng.choice([low, high]))
    elif kind < 3 and low >= 0 and high > 0:
        value = float(np.exp(rng.uniform(np.log(max(low, 1e-6 * high)), np.log(high))))
    else:
        value = float(rng.uniform(low, high))
    return round(value) if whole else float(f"{value:.6g}")


def drawn_leaf(scratch: Scratch) -> tuple[tuple[str, ...], Schema]:
    """A leaf; names of models are rare."""
    while True:
        path, part = scratch.pick(leaves())
        if "enum" not in part or scratch.chance(MODELS):
            return path, part


def configs(scratch: Scratch) -> None:
    """Read a changed configuration by one of the ways there are, and simulate it."""
    way = scratch.rng.random()
    if way < 0.15:
        config = _from_json(scratch)
    elif way < 0.4:
        config = _from_overrides(scratch)
    else:
        config = _from_yaml(scratch)
    # Errors of inputs and sizing name the data center, or what it names.
    scratch.named.clear()
    copy_of_it = scratch.output("again.yaml")
    copy_of_it.write_text(config.to_yaml(), encoding="utf-8")
    if load_config(copy_of_it) != config:
        raise DefectError("the config written out does not read back equal")
    physics.run(scratch, config)


def _from_yaml(scratch: Scratch) -> DataCenterConfig:
    """A preset written out, with values changed by name or by text."""
    rng = scratch.rng
    values = load_config(scratch.pick(BASES)).model_dump(mode="json")
    texts = {}
    for number in range(int(rng.integers(1, 3))):
        path, part = drawn_leaf(scratch)
        *sections, last = path
        node = values
        for name in sections:
            node = node[name]
        if scratch.chance(0.4):
            node[last] = _near(rng, node[last])
        elif scratch.chance(0.5):
            node[last] = valid_value(rng, part)
        else:
            mark = f"MARK{number}"
            node[last] = mark
            texts[mark] = _yaml_text(scratch)
        if scratch.chance(0.03):
            node[damage.scalar(rng)[:1000]] = 1
    text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True)
    for mark, value in texts.items():
        text = text.replace(mark, value)
    text = damage.lone_surrogates_escaped(text)
    if scratch.chance(0.04):
        text = _many_laughs() + text
    damaged = scratch.chance(0.12)
    content = damage.damaged_text(rng, text) if damaged else text.encode()
    path_of_file = scratch.write("config.yaml", content)
    return load_config(path_of_file)


def _near(rng: np.random.Generator, value: Any) -> Any:
    """A value whose numbers are up to twice or down to half of what they were."""
    if isinstance(value, list):
        return [_near(rng, entry) for entry in value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    changed = value * float(np.exp2(rng.uniform(-1, 1)))
    return round(changed) if isinstance(value, int) else float(f"{changed:.6g}")


def _yaml_text(scratch: Scratch) -> str:
    if scratch.chance(0.5):
        return scratch.pick(damage.YAML_VALUES)
    text = damage.scalar(scratch.rng)
    return text if scratch.chance(0.5) else json.dumps(text)


def _many_laughs() -> str:
    """Lists of lists of lists that a few lines make a thousand million entries long."""
    rows = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    rows += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
    return "\n".join(rows) + "\n"


def _from_overrides(scratch: Scratch) -> DataCenterConfig:
    rng = scratch.rng
    given = []
    for _ in range(int(rng.integers(1, 3))):
        path, part = drawn_leaf(scratch)
        name = ".".join(path)
        if scratch.chance(0.1):
            at = int(rng.integers(len(name)))
            name = name[:at] + str(rng.choice([".", "..", "x", "[0]", ".0", ".²", "=", " "]))
        if scratch.chance(0.6):
            value = yaml.safe_dump(valid_value(rng, part), default_flow_style=True, width=1e9)
            value = value.removesuffix("...\n").strip()
        else:
            value = _yaml_text(scratch)
        given.append(f"{name}={value}")
    return load_config(scratch.pick(BASES), given)


def _from_json(scratch: Scratch) -> DataCenterConfig:
    """The format of SustainDC, with values changed, left out, doubled or damaged."""
    rng = scratch.rng
    values: dict[str, Any] = copy.deepcopy(DC_CONFIG)
    texts = {}
    for number in range(int(rng.integers(1, 3))):
        section = values[scratch.pick(list(values))]
        key = scratch.pick(list(section))
        old = section[key]
        kind = int(rng.integers(5))
        if kind == 0:
            del section[key]
            break
        mark = f"MARK{number}"
        if kind == 1 and isinstance(old, list):
            old[int(rng.integers(len(old)))] = mark
        else:
            section[key] = mark
        if kind < 4:
            texts[f'"{mark}"'] = scratch.pick(damage.JSON_VALUES)
        else:
            factor = float(rng.choice([-1, 0, 1e-3, 0.5, 2, 1e3]))
            number_of = old if isinstance(old, int | float) else 1.0
            texts[f'"{mark}"'] = json.dumps(number_of * factor)
    text = json.dumps(values, indent=1)
    for mark, value in texts.items():
        text = text.replace(mark, value)
    content = damage.damaged_text(rng, text) if scratch.chance(0.2) else text.encode()
    return load_config(scratch.write("dc_config.json", content))
