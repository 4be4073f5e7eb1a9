"""Readers of configurations from presets, files, overrides and plain values."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from sdc_taichi.config import sustaindc
from sdc_taichi.config.fields import validated
from sdc_taichi.config.plain_values import load_json, load_yaml
from sdc_taichi.config.schema import DataCenterConfig
from sdc_taichi.errors import ConfigError, shortened, suggestion
from sdc_taichi.number_text import parse_whole
from sdc_taichi.user_file import MOST_CONFIG_BYTES, read_text

DEFAULT_PRESET = "corrected"
"""Preset that is loaded by default."""
_MOST_FILES = 20
"""Largest number of files that extend each other in turn."""
_REPLACES: dict[str, dict[str, Any]] = {
    "servers.power_w": {"servers.groups": None, "hall.rack_types": {}, "hall.rack_plan": []},
    "servers.groups": {"servers.power_w": None, "hall.rack_types": {}, "hall.rack_plan": []},
    "hall.rack_types": {"servers.power_w": None, "servers.groups": None},
    "servers.cpu_power_ratio_lb": {"servers.cpu_power_points": None},
    "servers.cpu_power_ratio_ub": {"servers.cpu_power_points": None},
    "servers.fan_airflow_ratio_lb": {"servers.fan_airflow_points": None},
    "servers.fan_airflow_ratio_ub": {"servers.fan_airflow_points": None},
    "servers.inlet_range_c": {
        "servers.cpu_power_points": None,
        "servers.fan_airflow_points": None,
    },
    "servers.fan_model": {"servers.fan_airflow_points": None},
    "servers.fan_reference_w": {"servers.fan_reference_share": None},
    "servers.fan_reference_share": {"servers.fan_reference_w": None},
}
"""Fields that exclude others: by path, the paths and neutral values of the excluded fields."""


def preset_names() -> list[str]:
    """Return the names of the presets that are part of the package."""
    folder = resources.files("sdc_taichi.configs")
    names = {entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".yaml")}
    return sorted(names - {"racks"})


def load_config(
    source: str | os.PathLike[str] | None = None, overrides: Sequence[str] = ()
) -> DataCenterConfig:
    """Read a preset, a YAML file or a SustainDC ``dc_config.json``.

    Args:
        source: Name of a preset (see ``preset_names``) or path of a file. A YAML file has the
            schema of ``DataCenterConfig``. It may start from a preset or from another file, which
            it names under ``extends``; a relative path begins at the folder of the file that names
            it. A file in the SustainDC JSON format starts from preset ``sustaindc``. None means
            preset ``corrected``.
        overrides: ``a.b=c`` assignments, applied last; ``c`` is parsed as YAML.

    Raises:
        ConfigError: A value is invalid; the message names file, key, value and valid values.
    """
    if isinstance(overrides, str):
        raise ConfigError(f"overrides {shortened(overrides)}: valid is a list of section.key=value")
    label, values = _read_source(DEFAULT_PRESET if source is None else source)
    for override in overrides:
        apply_override(values, override)
    return config_from_dict(values, label)


def config_from_dict(values: dict[str, Any], label: str = "config") -> DataCenterConfig:
    """Build a configuration from plain values.

    Args:
        values: Content of a YAML file with the schema of ``DataCenterConfig``.
        label: Source of the values, with which every error message begins.

    Raises:
        ConfigError: A value is invalid; the message names key, value and valid values.
    """
    return validated(DataCenterConfig, values, label)


def apply_overrides(config: DataCenterConfig, overrides: Sequence[str]) -> DataCenterConfig:
    """Return a copy of a configuration with assignments in the syntax of the command line.

    Args:
        config: Configuration to copy.
        overrides: ``a.b=c`` assignments, applied in their order; ``c`` is parsed as YAML.

    Raises:
        ConfigError: An assignment is invalid; the message names it, or key, value and valid values.
    """
    values = config.model_dump(mode="json")
    for override in overrides:
        apply_override(values, override)
    return config_from_dict(values, config.name)


def with_values(config: DataCenterConfig, assigned: Mapping[str, Any]) -> DataCenterConfig:
    """Return a validated copy of a configuration with new values at some paths.

    ``with_values(config, {"hvac.setpoint.initial_c": 20, "hall.supply_approach_k.2": 5.5})``

    Args:
        config: Configuration to copy.
        assigned: Plain values, as in a YAML file, by the dotted path of a field or of a list entry.
            A section is replaced as a whole; fields that are missing in its new value take their
            defaults.

    Raises:
        ConfigError: A value is invalid; the message names path or key, value and valid values.
    """
    if not isinstance(assigned, Mapping) or not all(isinstance(path, str) for path in assigned):
        raise ConfigError(
            f"values {shortened(assigned)}: valid is a mapping of dotted paths to values, such as "
            "{'hvac.setpoint.initial_c': 20}"
        )
    values = _opened(config, {path.strip().partition(".")[0] for path in assigned})
    for path, value in assigned.items():
        _assign(values, path, value, f"{path}={shortened(value)}")
    return config_from_dict(values, config.name)


def _opened(config: DataCenterConfig, sections: set[str]) -> dict[str, Any]:
    """Return the values of a configuration with the named sections as mutable mappings.

    ``hall`` and ``servers`` both describe the servers of a rack, so both become mappings together.
    """
    opened = sections | ({"hall", "servers"} if sections & {"hall", "servers"} else set())
    values = dict(config)
    return values | config.model_dump(mode="json", include=opened & set(values))


def _read_source(source: str | os.PathLike[str]) -> tuple[str, dict[str, Any]]:
    """Return label and values of a preset or file, merged with what it extends."""
    if isinstance(source, str) and source in preset_names():
        return f"preset {source}", _read_preset(source)
    try:
        return _read_file(Path(source), ())
    except ConfigError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise
        meant = suggestion(source, preset_names())
        raise ConfigError(
            f"{source}: no such file or preset{meant} (presets: {', '.join(preset_names())})"
        ) from None


def _read_file(path: Path, extended_by: tuple[Path, ...]) -> tuple[str, dict[str, Any]]:
    """Return label and values of a file, merged with the preset or file that it extends.

    Args:
        path: Path of the file.
        extended_by: Files that extend each other in turn, the last of which extends this file.
    """
    text = read_text(path, MOST_CONFIG_BYTES, ConfigError)
    label, is_json = str(path), path.suffix.lower() == ".json"
    values = _parse(text, label, "JSON" if is_json else "YAML")
    if is_json and sustaindc.is_of_format(values):
        return label, _merged(_read_preset("sustaindc"), sustaindc.read(values, label))
    base = values.pop("extends", None)
    if base is None:
        return label, values
    if base in preset_names():
        return label, _extended(_read_preset(base), values)
    chain = (*extended_by, path)
    base_label, base_values = _read_file(_extended_path(base, chain), chain)
    return f"{label} (extends {base_label})", _extended(base_values, values)


def _extended_path(base: Any, chain: tuple[Path, ...]) -> Path:
    """Return the path of the file that the last file of a chain of files names under ``extends``.

    Raises:
        ConfigError: There is no such file, a file extends itself, or the chain is too long.
    """
    where = f"{chain[-1]}: extends: "
    valid = f"valid is a preset ({', '.join(preset_names())}) or a file"
    if not isinstance(base, str) or not base.strip():
        raise ConfigError(f"{where}{shortened(base)} is no name; {valid}")
    path = chain[-1].parent / base
    if not os.path.isfile(path):
        meant = suggestion(base, preset_names())
        raise ConfigError(
            f"{where}{shortened(base)} is no preset, and {shortened(str(path))} is no file{meant}; "
            f"{valid}"
        )
    files = [*map(os.path.realpath, chain)]
    if os.path.realpath(path) in files:
        cycle = [*map(str, chain[files.index(os.path.realpath(path)) :]), str(path)]
        raise ConfigError(
            f"{where}{' -> '.join(cycle)} is a cycle; {valid} that does not extend this one"
        )
    if len(chain) == _MOST_FILES:
        raise ConfigError(
            f"{where}{shortened(base)} is file {_MOST_FILES + 1} of a chain of files that begins "
            f"with {chain[0]}; valid are at most {_MOST_FILES}"
        )
    return path


def _read_preset(name: str) -> dict[str, Any]:
    return deepcopy(_parse_preset(name))


@cache
def _parse_preset(name: str) -> dict[str, Any]:
    text = resources.files("sdc_taichi.configs").joinpath(f"{name}.yaml").read_text("utf-8")
    values = _parse(text, f"preset {name}")
    base = values.pop("extends", None)
    return values if base is None else _extended(_read_preset(base), values)


def _extended(base: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a base with those of a preset or file that extends it."""
    merged = _merged(base, values)
    _replace_excluded(merged, values)
    return merged


def _replace_excluded(merged: dict[str, Any], values: Mapping[str, Any]) -> None:
    """Unset inherited fields that fields of ``values`` exclude, see ``_REPLACES``."""
    assigned = {
        f"{section}.{name}": value
        for section in ("hall", "servers")
        if isinstance(fields := values.get(section), dict)
        for name, value in fields.items()
    }
    for new, replaced in _REPLACES.items():
        if assigned.get(new) in (None, {}):
            continue
        for path, unset in replaced.items():
            section, _, name = path.partition(".")
            fields = merged.setdefault(section, {})
            if path not in assigned and isinstance(fields, dict):
                fields[name] = unset


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in over.items():
        old = out.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            value = _merged(old, value)
        out[key] = value
    return out


def _parse(text: str, label: str, kind: str = "YAML") -> dict[str, Any]:
    """Parse a YAML or JSON text into a mapping of sections."""
    try:
        values = load_json(text) if kind == "JSON" else load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{label}: not valid {kind} ({error})") from None
    if not isinstance(values, dict):
        kind = type(values).__name__
        raise ConfigError(f"{label}: the top level is a {kind}; valid is a mapping of sections")
    return values


def apply_override(values: dict[str, Any], override: str) -> None:
    """Apply an assignment to plain values, without validating them.

    Args:
        values: Mapping of sections, which is changed in place.
        override: Assignment ``a.b=c``; ``c`` is parsed as YAML.

    Raises:
        ConfigError: The text is not an assignment, or its path is not in a section.
    """
    path, sign, text = override.partition("=")
    if not sign:
        raise ConfigError(f"override {shortened(override)}: valid is section.key=value")
    try:
        value = load_yaml(text)
    except ValueError as error:
        raise ConfigError(
            f"override {shortened(override)}: {shortened(text)} is no YAML value ({error})"
        ) from None
    _assign(values, path, value, override)


def _assign(values: dict[str, Any], path: str, value: Any, override: str) -> None:
    """Assign a value to a dotted path; error messages quote ``override``."""
    *sections, last = path.strip().split(".")
    if not all([*sections, last]):
        raise ConfigError(f"override {shortened(override)}: valid is section.key=value")
    node: Any = values
    for key in sections:
        if isinstance(node, list):
            node = node[_list_index(node, key, override)]
        else:
            node = node.setdefault(key, {})
        if not isinstance(node, dict | list):
            raise ConfigError(f"override {shortened(override)}: {key} is a value, not a section")
    if isinstance(node, list):
        node[_list_index(node, last, override)] = value
    else:
        if sections[:2] == ["hall", "rack_types"] and last == "model":
            # Values of the present model must not replace those of the new one.
            node.clear()
        node[last] = value
        if len(sections) == 1:
            _replace_excluded(values, {sections[0]: {last: value}})


def _list_index(node: list[Any], key: str, override: str) -> int:
    with contextlib.suppress(ValueError):
        if 0 <= (index := parse_whole(key)) < len(node):
            return index
    raise ConfigError(
        f"override {shortened(override)}: index {shortened(key)} is not in 0..{len(node) - 1}"
    )
