"""Reader of the SustainDC ``dc_config.json`` format."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sdc_taichi.errors import ConfigError, shortened, suggestion

_HALL, _HVAC, _SERVERS = SECTIONS = (
    "data_center_configuration",
    "hvac_configuration",
    "server_characteristics",
)
_KEYS: dict[str, tuple[str, ...]] = {
    _HALL: (
        "NUM_ROWS",
        "NUM_RACKS_PER_ROW",
        "RACK_SUPPLY_APPROACH_TEMP_LIST",
        "RACK_RETURN_APPROACH_TEMP_LIST",
        "CPUS_PER_RACK",
    ),
    _HVAC: (
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
        "CW_PUMP_EFFICIENCY",
        "CT_PRESSURE_DROP",
        "CT_WATER_FLOW_RATE",
        "CT_PUMP_EFFICIENCY",
    ),
    _SERVERS: (
        "CPU_POWER_RATIO_LB",
        "CPU_POWER_RATIO_UB",
        "IT_FAN_AIRFLOW_RATIO_LB",
        "IT_FAN_AIRFLOW_RATIO_UB",
        "IT_FAN_FULL_LOAD_V",
        "ITFAN_REF_V_RATIO",
        "ITFAN_REF_P",
        "INLET_TEMP_RANGE",
        "DEFAULT_SERVER_POWER_CHARACTERISTICS",
        "HP_PROLIANT",
    ),
}
LARGEST = 1e12
"""Largest number of a file; the bounds of the schema are narrower."""
_PER_RACK = (
    (_HALL, "RACK_SUPPLY_APPROACH_TEMP_LIST"),
    (_HALL, "RACK_RETURN_APPROACH_TEMP_LIST"),
    (_SERVERS, "DEFAULT_SERVER_POWER_CHARACTERISTICS"),
)
_DEPTHS = {
    "RACK_SUPPLY_APPROACH_TEMP_LIST": 1,
    "RACK_RETURN_APPROACH_TEMP_LIST": 1,
    "CPU_POWER_RATIO_LB": 1,
    "CPU_POWER_RATIO_UB": 1,
    "IT_FAN_AIRFLOW_RATIO_LB": 1,
    "IT_FAN_AIRFLOW_RATIO_UB": 1,
    "INLET_TEMP_RANGE": 1,
    "DEFAULT_SERVER_POWER_CHARACTERISTICS": 2,
    "HP_PROLIANT": 1,
}
"""How deep lists of numbers are nested in the values of keys that are no single number."""
_PAIRS = (
    "CPU_POWER_RATIO_LB",
    "CPU_POWER_RATIO_UB",
    "IT_FAN_AIRFLOW_RATIO_LB",
    "IT_FAN_AIRFLOW_RATIO_UB",
    "INLET_TEMP_RANGE",
)


def read(values: Mapping[str, Any], label: str) -> dict[str, Any]:
    """Translate a SustainDC file into values of the schema on top of preset ``sustaindc``.

    The CHILLER_COP values and HP_PROLIANT are checked but, as in the released code, not used.

    Args:
        values: content of the JSON file.
        label: path of the file, for messages and the name of the data center.

    Raises:
        ConfigError: for a missing or unknown key, a wrong type, or a wrong length.
    """
    problems = _problems(values)
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


def _problems(values: Mapping[str, Any]) -> list[str]:
    problems = [
        f"{section}: unknown section; valid: {', '.join(SECTIONS)}"
        for section in values
        if section not in SECTIONS
    ]
    for section, keys in _KEYS.items():
        found = values.get(section)
        if not isinstance(found, dict):
            problems.append(f"{section}: missing section")
            continue
        problems.extend(
            f"{section}.{key}: unknown key{suggestion(key, keys)}"
            for key in found
            if key not in keys
        )
        problems.extend(f"{section}.{key}: missing" for key in keys if key not in found)
    if not all(isinstance(values.get(section), dict) for section in SECTIONS):
        return problems
    racks, count_problems = _count_racks(values[_HALL])
    return [
        *problems,
        *_number_problems(values),
        *count_problems,
        *_length_problems(values, racks),
        *_servers_per_rack_problems(values[_HALL], racks),
        *_efficiency_problems(values[_HVAC]),
        *_pair_problems(values[_SERVERS]),
    ]


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= LARGEST


def _is_count(value: Any) -> bool:
    return _is_number(value) and 1 <= value <= 1e9 and value == int(value)


def _length(value: Any) -> int:
    return len(value) if isinstance(value, list) else 0


def _number_problems(values: Mapping[str, Any]) -> Iterator[str]:
    for section, keys in _KEYS.items():
        for key in keys:
            if key not in values[section]:
                continue
            value, depth = values[section][key], _DEPTHS.get(key, 0)
            if key == "CPUS_PER_RACK" and isinstance(value, list):
                depth = 1
            problem = _shape_problem(value, depth)
            if problem:
                yield f"{section}.{key}: {problem}"


def _shape_problem(value: Any, depth: int) -> str | None:
    """What is wrong with a number, or with lists of numbers that are nested ``depth`` deep."""
    if depth == 0:
        text = f"{shortened(value)} is not a number within {-LARGEST:g}..{LARGEST:g}"
        return None if _is_number(value) else text
    if not isinstance(value, list) or not value:
        return f"{shortened(value)} is not a list of {'lists of ' * (depth - 1)}numbers"
    return next(filter(None, (_shape_problem(entry, depth - 1) for entry in value)), None)


def _count_racks(hall: Mapping[str, Any]) -> tuple[int | None, list[str]]:
    """Number of racks, None if it cannot be told, and what is wrong with rows and racks per row."""
    counts = {key: hall.get(key, 1) for key in ("NUM_ROWS", "NUM_RACKS_PER_ROW")}
    problems = [
        f"{_HALL}.{key}: {shortened(count)} is no positive integer"
        for key, count in counts.items()
        if _is_number(count) and not _is_count(count)
    ]
    counted = all(key in hall and _is_count(count) for key, count in counts.items())
    return (math.prod(int(count) for count in counts.values()) if counted else None), problems


def _length_problems(values: Mapping[str, Any], racks: int | None) -> Iterator[str]:
    for section, key in _PER_RACK:
        if racks is not None and key in values[section]:
            length = _length(values[section][key])
            if length != racks:
                yield (
                    f"{section}.{key}: length {length}, expected {racks} "
                    "(NUM_ROWS x NUM_RACKS_PER_ROW)"
                )


def _servers_per_rack_problems(hall: Mapping[str, Any], racks: int | None) -> Iterator[str]:
    where = f"{_HALL}.CPUS_PER_RACK"
    per_rack = hall.get("CPUS_PER_RACK", 1)
    for count in per_rack if isinstance(per_rack, list) else [per_rack]:
        if _is_number(count) and not _is_count(count):
            yield f"{where}: {shortened(count)} is no positive integer"
    if isinstance(per_rack, list) and racks is not None and len(per_rack) != racks:
        yield f"{where}: length {len(per_rack)}, expected {racks}"


def _efficiency_problems(hvac: Mapping[str, Any]) -> Iterator[str]:
    for key in ("CW_PUMP_EFFICIENCY", "CT_PUMP_EFFICIENCY"):
        efficiency = hvac.get(key, 1)
        if _is_number(efficiency) and efficiency <= 0:
            yield f"{_HVAC}.{key}: {shortened(efficiency)} must be positive"


def _pair_problems(servers: Mapping[str, Any]) -> Iterator[str]:
    for key in _PAIRS:
        if key in servers and _length(servers[key]) != 2:
            yield f"{_SERVERS}.{key}: length {_length(servers[key])}, expected 2"
    pairs = servers.get("DEFAULT_SERVER_POWER_CHARACTERISTICS", [])
    for index, pair in enumerate(pairs if isinstance(pairs, list) else []):
        if _length(pair) != 2:
            yield (
                f"{_SERVERS}.DEFAULT_SERVER_POWER_CHARACTERISTICS[{index}]: "
                f"length {_length(pair)}, expected 2 (full, idle)"
            )
