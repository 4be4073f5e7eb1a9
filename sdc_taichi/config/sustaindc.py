"""Reader of the SustainDC ``dc_config.json`` format.

The schema below has the keys of the format, and its error messages name these keys. The resulting
configuration checks narrower bounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from sdc_taichi.config.fields import Count, Section, check_one_per_rack, validated
from sdc_taichi.config.hall_schema import RackCount

Number = Annotated[float, Field(ge=-1e12, le=1e12)]
"""Any number with an absolute value of at most 1e12."""
Efficiency = Annotated[float, Field(gt=0, le=1e12)]
"""Positive number, which serves as a divisor."""
Pair = tuple[Number, Number]
"""Two numbers."""


class _Hall(Section):
    """Racks, their approach temperatures in K, and their servers."""

    NUM_ROWS: RackCount
    NUM_RACKS_PER_ROW: RackCount
    RACK_SUPPLY_APPROACH_TEMP_LIST: tuple[Number, ...]
    RACK_RETURN_APPROACH_TEMP_LIST: tuple[Number, ...]
    CPUS_PER_RACK: Count | tuple[Count, ...]


class _Hvac(Section):
    """Air, CRAC units, chiller, tower and pumps.

    The CHILLER_COP values are checked but not used, as in the released code.
    """

    C_AIR: Number
    RHO_AIR: Number
    CRAC_SUPPLY_AIR_FLOW_RATE_pu: Number
    CRAC_REFRENCE_AIR_FLOW_RATE_pu: Number
    CRAC_FAN_REF_P: Number
    CHILLER_COP_BASE: Number
    CHILLER_COP_K: Number
    CHILLER_COP_T_NOMINAL: Number
    CT_FAN_REF_P: Number
    CT_REFRENCE_AIR_FLOW_RATE: Number
    CW_PRESSURE_DROP: Number
    CW_WATER_FLOW_RATE: Number
    CW_PUMP_EFFICIENCY: Efficiency
    CT_PRESSURE_DROP: Number
    CT_WATER_FLOW_RATE: Number
    CT_PUMP_EFFICIENCY: Efficiency


class _Servers(Section):
    """Curves and power of servers; HP_PROLIANT is checked but not used, as in the released code."""

    CPU_POWER_RATIO_LB: Pair
    CPU_POWER_RATIO_UB: Pair
    IT_FAN_AIRFLOW_RATIO_LB: Pair
    IT_FAN_AIRFLOW_RATIO_UB: Pair
    IT_FAN_FULL_LOAD_V: Number
    ITFAN_REF_V_RATIO: Number
    ITFAN_REF_P: Number
    INLET_TEMP_RANGE: Pair
    DEFAULT_SERVER_POWER_CHARACTERISTICS: tuple[Pair, ...]
    HP_PROLIANT: tuple[Number, ...]


class _File(Section):
    """Complete file of the SustainDC format."""

    data_center_configuration: _Hall
    hvac_configuration: _Hvac
    server_characteristics: _Servers

    @model_validator(mode="after")
    def _one_entry_per_rack(self) -> Self:
        hall, servers = self.data_center_configuration, self.server_characteristics
        for section, key in (
            (hall, "RACK_SUPPLY_APPROACH_TEMP_LIST"),
            (hall, "RACK_RETURN_APPROACH_TEMP_LIST"),
            (hall, "CPUS_PER_RACK"),
            (servers, "DEFAULT_SERVER_POWER_CHARACTERISTICS"),
        ):
            check_one_per_rack(key, getattr(section, key), hall.NUM_ROWS * hall.NUM_RACKS_PER_ROW)
        return self


def is_of_format(values: Mapping[str, Any]) -> bool:
    """Return True if the content of a JSON file has the SustainDC format."""
    return "data_center_configuration" in values


def read(values: Mapping[str, Any], label: str) -> dict[str, Any]:
    """Translate a SustainDC file into configuration values, to be merged into preset ``sustaindc``.

    Args:
        values: Content of the JSON file.
        label: Path of the file, for error messages and for the name of the data center.

    Raises:
        ConfigError: A key is missing or unknown, or a value has the wrong type or length.
    """
    hall, hvac, servers = validated(_File, values, label).model_dump(mode="json").values()
    chilled_w, condenser_w = (
        hvac[f"{loop}_PRESSURE_DROP"]
        * hvac[f"{loop}_WATER_FLOW_RATE"]
        / hvac[f"{loop}_PUMP_EFFICIENCY"]
        for loop in ("CW", "CT")
    )
    return {
        "name": Path(label).stem,
        "description": "read from the SustainDC dc_config.json format",
        "hall": {
            "rows": hall["NUM_ROWS"],
            "racks_per_row": hall["NUM_RACKS_PER_ROW"],
            "servers_per_rack": hall["CPUS_PER_RACK"],
            "supply_approach_k": hall["RACK_SUPPLY_APPROACH_TEMP_LIST"],
            "return_approach_k": hall["RACK_RETURN_APPROACH_TEMP_LIST"],
            "air_density_kg_m3": hvac["RHO_AIR"],
            "air_heat_capacity_j_per_kg_k": hvac["C_AIR"],
        },
        "servers": {
            "power_w": servers["DEFAULT_SERVER_POWER_CHARACTERISTICS"],
            "cpu_power_ratio_lb": servers["CPU_POWER_RATIO_LB"],
            "cpu_power_ratio_ub": servers["CPU_POWER_RATIO_UB"],
            "inlet_range_c": servers["INLET_TEMP_RANGE"],
            "fan_airflow_ratio_lb": servers["IT_FAN_AIRFLOW_RATIO_LB"],
            "fan_airflow_ratio_ub": servers["IT_FAN_AIRFLOW_RATIO_UB"],
            "fan_full_airflow_m3s": servers["IT_FAN_FULL_LOAD_V"],
            "fan_reference_ratio": servers["ITFAN_REF_V_RATIO"],
            "fan_reference_w": servers["ITFAN_REF_P"],
        },
        "hvac": {
            "crac": {
                "supply_m3s_per_w": hvac["CRAC_SUPPLY_AIR_FLOW_RATE_pu"],
                "reference_m3s_per_w": hvac["CRAC_REFRENCE_AIR_FLOW_RATE_pu"],
                "released_fan_w": hvac["CRAC_FAN_REF_P"],
            },
            "tower": {
                "paper_fan_w": hvac["CT_FAN_REF_P"],
                "paper_airflow_m3s": hvac["CT_REFRENCE_AIR_FLOW_RATE"],
            },
            "pumps": {"released_chilled_w": chilled_w, "released_condenser_w": condenser_w},
        },
    }
