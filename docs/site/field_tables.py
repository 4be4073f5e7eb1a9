"""Tables of fields: those of a configuration, of environments, of trainings and of suites."""

from __future__ import annotations

import ast
import inspect
import json
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel

from sdc_taichi.benchmark.suite import Case, OtherDataCenters, Row, Suite
from sdc_taichi.config import fields as types
from sdc_taichi.config.electrical_schema import TariffPeriod
from sdc_taichi.config.event_schema import SampledEvent, ScheduledEvent
from sdc_taichi.config.field_texts import (
    docstrings,
    docstrings_in,
    is_section,
    sections_of,
    valid_values,
)
from sdc_taichi.config.hall_schema import RackRange, RackType, ServerGroup
from sdc_taichi.config.schema import DataCenterConfig
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.learning.algorithms import LEARNING_SETTINGS
from sdc_taichi.learning.training_settings import TrainingSettings, ValidationSettings
from sdc_taichi.plant.chiller import CHILLERS

LISTED: dict[str, type[BaseModel]] = {
    "servers.groups": ServerGroup,
    "hall.rack_types": RackType,
    "hall.rack_plan": RackRange,
    "events.scheduled": ScheduledEvent,
    "events.sampled": SampledEvent,
    "tariff.periods": TariffPeriod,
}
"""Schemas of the sections that stand in lists, by the path of the list."""


def fields_markdown() -> str:
    """Tables of all fields, one per section, reasons of shared bounds, and the chiller models."""
    tables = [_table(name, model) for name, model in sections_of("", DataCenterConfig)]
    tables += [_table(f"{path}[]", model) for path, model in LISTED.items()]
    docs = docstrings_in(ast.parse(inspect.getsource(types)).body)
    reasons = [f"- {text}" for text in docs.values() if ".." in text]
    bounds = "## Bounds that fields share", "\n".join(reasons)
    return "\n\n".join([*tables, *bounds, _chillers()]).replace("``", "`")


def options_markdown() -> str:
    """Table of the options of environments."""
    return _markdown([("", EnvOptions)]).partition("\n\n|")[2].join(("|", ""))


def settings_markdown() -> str:
    """Tables of the settings of a training."""
    learning = [("learning", kind) for kind in dict.fromkeys(LEARNING_SETTINGS.values())]
    return _markdown([("", TrainingSettings), ("validation", ValidationSettings), *learning])


def suite_markdown() -> str:
    """Tables of the fields of a suite."""
    return _markdown(
        [
            ("", Suite),
            ("cases.NAME", Case),
            ("cases.NAME.test", OtherDataCenters),
            ("rows.NAME", Row),
        ]
    )


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


def _markdown(sections: Iterable[tuple[str, type[BaseModel]]]) -> str:
    """Tables of the fields of sections.

    Args:
        sections: path and schema of each; that of the outermost is empty.
    """
    return "\n\n".join(_table(path, model) for path, model in sections).replace("``", "`")


def _table(path: str, model: type[BaseModel]) -> str:
    schema, docs = model.model_json_schema(), docstrings(model)
    rows = [
        f"| `{name}` | {_default(schema, name)} | {valid_values(entry, schema)} | {docs[name]} |"
        for name, entry in schema["properties"].items()
        if not is_section(entry)
    ]
    title = f"`{path}`" if path else "A data center" if model is DataCenterConfig else "Settings"
    head = [f"## {title}", "", inspect.getdoc(model) or "", ""]
    columns = ["| field | default | valid | meaning |", "|---|---|---|---|"]
    return "\n".join([*head, *(columns + rows if rows else [])]).rstrip()


def _default(schema: dict[str, Any], name: str) -> str:
    if name in schema.get("required", ()):
        return "required"
    value = schema["properties"][name].get("default", [])
    return "" if value == "" else f"`{json.dumps(value)}`"
