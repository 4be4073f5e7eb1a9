"""The fields of a configuration as a document: default, bounds and meaning of each."""

from __future__ import annotations

import ast
import inspect
import itertools
import json
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator
from typing import Any

import yaml
from pydantic import BaseModel

from sdc_taichi.config import fields as types
from sdc_taichi.config.electrical_schema import TariffPeriod
from sdc_taichi.config.event_schema import SampledEvent, ScheduledEvent
from sdc_taichi.config.hall_schema import RackRange, RackType, ServerGroup
from sdc_taichi.config.schema import DataCenterConfig
from sdc_taichi.plant.chiller import CHILLERS

LISTED: dict[str, type[BaseModel]] = {
    "servers.groups": ServerGroup,
    "hall.rack_types": RackType,
    "hall.rack_plan": RackRange,
    "events.scheduled": ScheduledEvent,
    "events.sampled": SampledEvent,
    "tariff.periods": TariffPeriod,
}
"""Schemas of the sections in lists, by the path of the list."""

_TITLES = {"DataCenterConfig": "A data center"}


def fields_markdown() -> str:
    """Tables of all fields, one per section, reasons of shared bounds, and the chiller models."""
    tables = [_table(name, model) for name, model in _sections("", DataCenterConfig)]
    tables += [_table(f"{path}[]", model) for path, model in LISTED.items()]
    reasons = [f"- {text}" for text in _types().values()]
    bounds = "## Bounds that fields share", "\n".join(reasons)
    return "\n\n".join([*tables, *bounds, _chillers()]).replace("``", "`")


def _chillers() -> str:
    """Table of the chiller models, from their records."""
    lines = [
        "## Chiller models",
        "",
        "| `hvac.chiller.model` | condenser | reference COP | chilled water, C | equations |",
        "|---|---|---|---|---|",
    ]
    for name, model in CHILLERS.items():
        places = {"tower water": model.tower_water, "outdoor air": model.outdoor_air}
        condenser = " or ".join(place for place, fits in places.items() if fits)
        bounds = model.chilled_water_bounds_c
        water = "any" if bounds is None else f"{bounds[0]:g}..{bounds[1]:g}"
        about = (inspect.getdoc(model.equations) or "").partition("\n")[0]
        lines.append(f"| `{name}` | {condenser} | {model.reference_cop:g} | {water} | {about} |")
    return "\n".join(lines)


def sections_markdown(sections: Iterable[tuple[str, type[BaseModel]]]) -> str:
    """Tables of the fields of sections.

    Args:
        sections: path and schema of each; that of the outermost is empty.
    """
    return "\n\n".join(_table(path, model) for path, model in sections).replace("``", "`")


def field_names() -> list[str]:
    """Names of all fields that overrides set, such as ``hvac.setpoint.initial_c``."""
    return [
        f"{path}.{name}".lstrip(".")
        for path, model in _sections("", DataCenterConfig)
        for name, entry in model.model_json_schema()["properties"].items()
        if not _is_section(entry)
    ]


def _sections(path: str, model: type[BaseModel]) -> Iterator[tuple[str, type[BaseModel]]]:
    yield path, model
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from _sections(f"{path}.{name}".lstrip("."), kind)


def _table(path: str, model: type[BaseModel]) -> str:
    schema, docs = model.model_json_schema(), _docstrings(model)
    rows = [
        f"| `{name}` | {_default(schema, name)} | {_valid(entry, schema)} | {docs[name]} |"
        for name, entry in schema["properties"].items()
        if not _is_section(entry)
    ]
    title = f"`{path}`" if path else _TITLES.get(model.__name__, "Settings")
    head = [f"## {title}", "", inspect.getdoc(model) or "", ""]
    columns = ["| field | default | valid | meaning |", "|---|---|---|---|"]
    return "\n".join([*head, *(columns + rows if rows else [])]).rstrip()


def _is_section(entry: dict[str, Any]) -> bool:
    kinds = entry.get("anyOf", [entry])
    return all("$ref" in kind or "allOf" in kind for kind in kinds)  # the latter of pydantic 2.8


def _default(schema: dict[str, Any], name: str) -> str:
    if name in schema.get("required", ()):
        return "required"
    value = schema["properties"][name].get("default", [])
    return "" if value == "" else f"`{json.dumps(value)}`"


def _valid(entry: dict[str, Any], schema: dict[str, Any]) -> str:
    """Valid values of an entry of a JSON schema, as text for the column ``valid``."""
    if "anyOf" in entry:
        return " or ".join(_valid(one, schema) for one in entry["anyOf"])
    if "const" in entry:
        return f"`{entry['const']}`"
    if "enum" in entry:
        return ", ".join(f"`{one}`" for one in entry["enum"])
    kind = entry.get("type")
    if kind in ("number", "integer"):
        low = entry.get("minimum", entry.get("exclusiveMinimum"))
        high = entry.get("maximum", entry.get("exclusiveMaximum"))
        above = "above " if "exclusiveMinimum" in entry else ""
        below = "below " if "exclusiveMaximum" in entry else ""
        whole = "whole " if kind == "integer" else ""
        if low is None and high is None:
            return f"{whole}number".removeprefix("whole ")
        if high is None:
            return f"{whole}{above or 'from '}{_number(low)}"
        return f"{whole}{above}{_number(low)}..{below}{_number(high)}"
    if kind == "array":
        if "prefixItems" in entry:
            return f"[{', '.join(_valid(one, schema) for one in entry['prefixItems'])}]"
        items = _valid(entry["items"], schema)
        return f"list of {items.replace('list', 'lists', 1) if items[:4] == 'list' else items}"
    if kind == "object":
        return "names, each with a section as below"
    if "$ref" in entry:
        return "sections as below"
    return {"boolean": "true, false", "null": "null"}.get(str(kind), "text")


def _number(value: Any) -> str:
    if value == 2**63 - 1:
        return "2^63 - 1"
    return re.sub(r"e([+-])0*(\d)", lambda e: f"e{e[1].strip('+')}{e[2]}", f"{value:g}")


def _docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Docstring of each field of a section, inherited ones included, on one line."""
    docs: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if issubclass(kind, BaseModel) and kind is not BaseModel:
            tree = ast.parse(inspect.getsource(sys.modules[kind.__module__]))
            classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
            docs |= _docstrings_in(classes[kind.__name__].body)
    return docs


def _types() -> dict[str, str]:
    """Docstring of each type of numbers that fields share, on one line."""
    docs = _docstrings_in(ast.parse(inspect.getsource(types)).body)
    return {name: text for name, text in docs.items() if ".." in text}


def _docstrings_in(body: list[ast.stmt]) -> dict[str, str]:
    """Docstrings below assignments, by the name assigned to."""
    docs = {}
    for field, text in itertools.pairwise(body):
        target: ast.expr | None = None
        if isinstance(field, ast.AnnAssign):
            target = field.target
        elif isinstance(field, ast.Assign):
            target = field.targets[0]
        doc = text.value if isinstance(text, ast.Expr) else None
        if isinstance(target, ast.Name) and isinstance(doc, ast.Constant):
            docs[target.id] = " ".join(str(doc.value).split())
    return docs


def commented_yaml(config: DataCenterConfig) -> str:
    """YAML of a configuration with a comment above each field; it reads back equal.

    Args:
        config: the configuration.
    """
    lines = _commented(config.model_dump(mode="json"), DataCenterConfig, "")
    return "\n".join(lines).replace("``", "`") + "\n"


def _commented(values: dict[str, Any], model: type[BaseModel], indent: str) -> list[str]:
    """Lines of a section, with what each field is and which values are valid."""
    schema, docs = model.model_json_schema(), _docstrings(model)
    lines = []
    for name, entry in schema["properties"].items():
        kind = model.model_fields[name].annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            about = " ".join((inspect.getdoc(kind) or "").partition("\n\n")[0].split())
            inner = _commented(values[name], kind, f"{indent}  ")
            lines += ["", *_comment(about, indent), f"{indent}{name}:", *inner]
        else:
            valid = _valid(entry, schema).replace("`", "").replace(" as below", "")
            about = re.sub(r"\bNone\b", "null", docs[name])
            lines += _comment(f"{about} Valid: {valid}.", indent)
            lines += [f"{indent}{line}" for line in _entry(name, values[name])]
    return lines


def _entry(name: str, value: Any) -> list[str]:
    """Lines of a field, with lists in brackets."""
    if not isinstance(value, list | dict):
        return yaml.safe_dump({name: value}).splitlines()
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=72)
    return f"{name}: {text}".replace("\n", "\n  ").rstrip().split("\n")


def _comment(text: str, indent: str) -> list[str]:
    """Comment lines of a text."""
    return textwrap.wrap(text, 96, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
