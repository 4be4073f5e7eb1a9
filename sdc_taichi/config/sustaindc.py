"""Reader of the SustainDC ``dc_config.json`` format."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sdc_taichi.errors import ConfigError, shortened, suggestion

_HALL, _HVAC, _SERVERS = SECTIONS = (
    "data_center_configuration",
    "hvac_configuration",
    "server_characteristics",
)
LARGEST = 1e12
"""Largest number of a file; the bounds of the schema are narrower."""


class _Shape(NamedTuple):
    """What the value of a key is."""

    depth: int = 0
    """How deep lists of numbers are nested, 0 for a number."""
    entries: int | None = None
    """Number of entries of the list; None is any, or ``per_rack``."""
    per_rack: bool = False
    """Whether the list has an entry for each rack."""
    whole: bool = False
    """Whether numbers are positive integers."""
    positive: bool = False
    """Whether numbers are above 0."""


_NUMBER, _COUNT, _PAIR = _Shape(), _Shape(whole=True), _Shape(depth=1, entries=2)
_PER_RACK = _Shape(depth=1, per_rack=True)
_KEYS: dict[str, dict[str, _Shape]] = {
    _HALL: {
        "NUM_ROWS": _COUNT,
        "NUM_RACKS_PER_ROW": _COUNT,
        "RACK_SUPPLY_APPROACH_TEMP_LIST": _PER_RACK,
        "RACK_RETURN_APPROACH_TEMP_LIST": _PER_RACK,
        "CPUS_PER_RACK": _COUNT,
    },
    _HVAC: {
        **dict.fromkeys(("CW_PUMP_EFFICIENCY", "CT_PUMP_EFFICIENCY"), _Shape(positive=True)),
        **dict.fromkeys(
            (
                "C_AIR",
                "RHO_AIR",
                "CRAC_SUPPLY_AIR_FLOW_RATE_pu",
                "CRAC_REFRENCE_AIR_FLOW_RATE_pu",
                "CRAC_FAN_REF_P",
                "CHILLER_COP_BASE",
                "CHILLER_COP_K",
                "CHILLER_COP_T_NOMINAL",
                "CT_FAN_REF_P",
                "CT_REFRENCE_AIR_FLOW_RATE",
                "CW_PRESSURE_DROP",
                "CW_WATER_FLOW_RATE",
                "CT_PRESSURE_DROP",
                "CT_WATER_FLOW_RATE",
            ),
            _NUMBER,
        ),
    },
    _SERVERS: {
        "CPU_POWER_RATIO_LB": _PAIR,
        "CPU_POWER_RATIO_UB": _PAIR,
        "IT_FAN_AIRFLOW_RATIO_LB": _PAIR,
        "IT_FAN_AIRFLOW_RATIO_UB": _PAIR,
        "IT_FAN_FULL_LOAD_V": _NUMBER,
        "ITFAN_REF_V_RATIO": _NUMBER,
        "ITFAN_REF_P": _NUMBER,
        "INLET_TEMP_RANGE": _PAIR,
        "DEFAULT_SERVER_POWER_CHARACTERISTICS": _Shape(depth=2, per_rack=True),
        "HP_PROLIANT": _Shape(depth=1),
    },
}
"""Keys of each section and what their values are; ``CPUS_PER_RACK`` may also be a list."""


def read(values: Mapping[str, Any], label: str) -> dict[str, Any]:
    """Translate a SustainDC file into values of the schema on top of preset ``sustaindc``.

    The CHILLER_COP values and HP_PROLIANT are checked but, as in the released code, not used.

    Args:
        values: content of the JSON file.
        label: path of the file, for messages and the name of the data center.

    Raises:
        ConfigError: for a missing or unknown key, a wrong type, or a wrong length.
    """
    problems = [*_problems(values)]
    if problems:
        raise ConfigError(f"{label}: {'; '.join(problems)}")
    hall, hvac, servers = (values[section] for section in SECTIONS)
    per_rack = hall["CPUS_PER_RACK"]
    return {
        "name": Path(label).stem,
        "description": "read from the SustainDC dc_config.json format",
        "hall": {
            "rows": int(hall["NUM_ROWS"]),
            "racks_per_row": int(hall["NUM_RACKS_PER_ROW"]),
            "servers_per_rack": [int(n) for n in per_rack]
            if isinstance(per_rack, list)
            else int(per_rack),
            "supply_approach_k": hall["RACK_SUPPLY_APPROACH_TEMP_LIST"],
            "return_approach_k": hall["RACK_RETURN_APPROACH_TEMP_LIST"],
            "air_density_kg_m3": hvac["RHO_AIR"],
            "air_heat_capacity_j_per_kg_k": hvac["C_AIR"],
        },
        "servers": {
            "power_w": [
                (pair[0], pair[-1]) for pair in servers["DEFAULT_SERVER_POWER_CHARACTERISTICS"]
            ],
            "cpu_power_ratio_lb": servers["CPU_POWER_RATIO_LB"],
            "cpu_power_ratio_ub": servers["CPU_POWER_RATIO_UB"],
            "inlet_range_c": servers["INLET_TEMP_RANGE"],
            "fan_airflow_ratio_lb": servers["IT_FAN_AIRFLOW_RATIO_LB"],
            "fan_airflow_ratio_ub": servers["IT_FAN_AIRFLOW_RATIO_UB"],
            "fan_full_airflow_m3s": servers["IT_FAN_FULL_LOAD_V"],
            "fan_reference_ratio": servers["ITFAN_REF_V_RATIO"],
            "fan_reference_w": servers["ITFAN_REF_P"],
        },
        "hvac": _hvac_values(hvac),
    }


def _hvac_values(hvac: Mapping[str, Any]) -> dict[str, Any]:
    def pump_w(prefix: str) -> float:
        """Power from pressure drop, flow and efficiency."""
        drop, flow = hvac[f"{prefix}_PRESSURE_DROP"], hvac[f"{prefix}_WATER_FLOW_RATE"]
        return float(drop * flow / hvac[f"{prefix}_PUMP_EFFICIENCY"])

    return {
        "crac": {
            "supply_m3s_per_w": hvac["CRAC_SUPPLY_AIR_FLOW_RATE_pu"],
            "reference_m3s_per_w": hvac["CRAC_REFRENCE_AIR_FLOW_RATE_pu"],
            "released_fan_w": hvac["CRAC_FAN_REF_P"],
        },
        "tower": {
            "paper_fan_w": hvac["CT_FAN_REF_P"],
            "paper_airflow_m3s": hvac["CT_REFRENCE_AIR_FLOW_RATE"],
        },
        "pumps": {"released_chilled_w": pump_w("CW"), "released_condenser_w": pump_w("CT")},
    }


def _problems(values: Mapping[str, Any]) -> Iterator[str]:
    """What is wrong with a file, section by section."""
    for section in values:
        if section not in SECTIONS:
            yield f"{section}: unknown section; valid: {', '.join(SECTIONS)}"
    racks = _racks(values.get(_HALL))
    for section, shapes in _KEYS.items():
        content = values.get(section)
        if not isinstance(content, dict):
            yield f"{section}: missing section"
            continue
        for key in content:
            if key not in shapes:
                yield f"{section}.{key}: unknown key{suggestion(key, shapes)}"
        for key, shape in shapes.items():
            if key == "CPUS_PER_RACK" and isinstance(content.get(key), list):
                shape = _Shape(depth=1, per_rack=True, whole=True)
            problem = _problem(content[key], shape, racks) if key in content else ": missing"
            if problem:
                yield f"{section}.{key}{problem}"


def _racks(hall: Any) -> int | None:
    """Number of racks; None if it is not known."""
    if not isinstance(hall, dict):
        return None
    counts = [hall.get("NUM_ROWS"), hall.get("NUM_RACKS_PER_ROW")]
    if not all(map(_is_count, counts)):
        return None
    return math.prod(int(count) for count in counts if count is not None)


def _problem(value: Any, shape: _Shape, racks: int | None) -> str | None:
    """What is wrong with a value, to be put after its key; None if nothing is."""
    if shape.depth == 0:
        if not _is_number(value):
            return f": {shortened(value)} is not a number within {-LARGEST:g}..{LARGEST:g}"
        if shape.whole and not _is_count(value):
            return f": {shortened(value)} is no positive integer"
        if shape.positive and value <= 0:
            return f": {shortened(value)} must be positive"
        return None
    if not isinstance(value, list) or not value:
        return f": {shortened(value)} is not a list of {'lists of ' * (shape.depth - 1)}numbers"
    expected = racks if shape.per_rack else shape.entries
    if expected is not None and len(value) != expected:
        why = " (NUM_ROWS x NUM_RACKS_PER_ROW)" if shape.per_rack else ""
        return f": length {len(value)}, expected {expected}{why}"
    entry_shape = _PAIR if shape.depth == 2 else _Shape(whole=shape.whole)
    problems = (_problem(entry, entry_shape, racks) for entry in value)
    at, problem = next(((i, text) for i, text in enumerate(problems) if text), (0, None))
    return f"[{at}]{problem}" if problem and shape.depth == 2 else problem


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= LARGEST


def _is_count(value: Any) -> bool:
    return _is_number(value) and 1 <= value <= 1e9 and value == int(value)
