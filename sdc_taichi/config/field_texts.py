"""Texts about the fields of a configuration: names, valid values and meaning of each."""

from __future__ import annotations

import ast
import inspect
import itertools
import re
import sys
import textwrap
from collections.abc import Iterator
from typing import Any

import yaml
from pydantic import BaseModel

from sdc_taichi.config.schema import DataCenterConfig


def field_names() -> list[str]:
    """Return the paths of all fields that an override can set, like ``hvac.setpoint.initial_c``."""
    return [
        f"{path}.{name}".lstrip(".")
        for path, model in sections_of("", DataCenterConfig)
        for name, entry in model.model_json_schema()["properties"].items()
        if not is_section(entry)
    ]


def sections_of(path: str, model: type[BaseModel]) -> Iterator[tuple[str, type[BaseModel]]]:
    """Yield path and schema of a section and of all its subsections.

    Args:
        path: Path of the section; empty for the top level.
        model: Schema of the section.
    """
    yield path, model
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from sections_of(f"{path}.{name}".lstrip("."), kind)


def is_section(entry: dict[str, Any]) -> bool:
    """Return True if an entry of a JSON schema is a section, not a field."""
    kinds = entry.get("anyOf", [entry])
    return all("$ref" in kind or "allOf" in kind for kind in kinds)  # the latter of pydantic 2.8


def valid_values(entry: dict[str, Any], schema: dict[str, Any]) -> str:
    """Return a text that describes the valid values of a field.

    Args:
        entry: Entry of the field in the JSON schema of its section.
        schema: JSON schema of the section.
    """
    if "anyOf" in entry:
        return " or ".join(valid_values(one, schema) for one in entry["anyOf"])
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
            return f"[{', '.join(valid_values(one, schema) for one in entry['prefixItems'])}]"
        items = valid_values(entry["items"], schema)
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


def docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each field of a section, each on one line, by field name."""
    docs: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if issubclass(kind, BaseModel) and kind is not BaseModel:
            tree = ast.parse(inspect.getsource(sys.modules[kind.__module__]))
            classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
            docs |= docstrings_in(classes[kind.__name__].body)
    return docs


def docstrings_in(body: list[ast.stmt]) -> dict[str, str]:
    """Return the docstrings below assignments, by the name of the assigned variable."""
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
    """Return a configuration as YAML with a comment above each field.

    ``load_config`` reads the text back as an equal configuration.
    """
    lines = _commented(config.model_dump(mode="json"), DataCenterConfig, "")
    return "\n".join(lines).replace("``", "`") + "\n"


def _commented(values: dict[str, Any], model: type[BaseModel], indent: str) -> list[str]:
    """Return the lines of a section, with comments on meaning and valid values of each field."""
    schema, docs = model.model_json_schema(), docstrings(model)
    lines = []
    for name, entry in schema["properties"].items():
        kind = model.model_fields[name].annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            about = " ".join((inspect.getdoc(kind) or "").partition("\n\n")[0].split())
            inner = _commented(values[name], kind, f"{indent}  ")
            lines += ["", *_comment(about, indent), f"{indent}{name}:", *inner]
        else:
            valid = valid_values(entry, schema).replace("`", "").replace(" as below", "")
            about = re.sub(r"\bNone\b", "null", docs[name])
            lines += _comment(f"{about} Valid: {valid}.", indent)
            lines += [f"{indent}{line}" for line in _entry(name, values[name])]
    return lines


def _entry(name: str, value: Any) -> list[str]:
    """Return the YAML lines of a field, with lists in brackets."""
    if not isinstance(value, list | dict):
        return yaml.safe_dump({name: value}).splitlines()
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=72)
    return f"{name}: {text}".replace("\n", "\n  ").rstrip().split("\n")


def _comment(text: str, indent: str) -> list[str]:
    """Return a text as wrapped comment lines."""
    return textwrap.wrap(text, 96, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
