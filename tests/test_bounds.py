"""Bounds of inputs: every number has both, and what no machine can do is refused."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel

from sdc_taichi import ConfigError, DataCenterConfig, EnvOptions, load_config, preset_names

BOUNDS = (("minimum", "exclusiveMinimum"), ("maximum", "exclusiveMaximum"))


def numbers(schema: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Path and schema of every number in a JSON schema."""
    if isinstance(schema, dict):
        if schema.get("type") in ("number", "integer"):
            yield path, schema
        for key, value in schema.items():
            yield from numbers(value, f"{path}.{key}")
    elif isinstance(schema, list):
        for index, value in enumerate(schema):
            yield from numbers(value, f"{path}.{index}")


@pytest.mark.parametrize("model", [DataCenterConfig, EnvOptions])
def test_every_number_has_bounds_at_both_ends(model: type[BaseModel]) -> None:
    found = dict(numbers(model.model_json_schema()))
    assert len(found) > 5
    without = [
        path
        for path, schema in found.items()
        if not all(any(name in schema for name in names) for names in BOUNDS)
    ]
    assert without == [], "fields take a type of config/fields.py, or Field(ge=..., le=...)"


def test_presets_lie_within_the_bounds() -> None:
    for name in preset_names():
        load_config(name)


@pytest.mark.parametrize(
    ("preset", "override"),
    [
        ("tiny", "hvac.chiller.reference_cop=1e-12"),
        ("tiny", "hvac.chiller.reference_cop=1000"),
        ("tiny", "hvac.pumps.efficiency=1e-30"),
        ("tiny", "hvac.crac.supply_m3s_per_w=1e-30"),
        ("corrected", "hvac.crac.coasting_flow_ratio=1e-6"),
        ("corrected", "servers.power_w=[0.2, 0.06]"),
        ("tiny", "servers.groups.0.0.full_w=1e9"),
        ("tiny", "hall.supply_approach_k=[5, 5, 5, 400]"),
        ("tiny", "servers.inlet_range_c=[60, 82]"),
        ("tiny", "hvac.setpoint.max_c=73"),
        ("tiny", "hall.air_density_kg_m3=1225"),
        ("tiny", "hvac.sizing.design_wet_bulb_c=95"),
        ("tiny", "battery.charge_efficiency=97"),
        ("tiny", "simulation.steps_per_hour=3600"),
    ],
)
def test_what_no_machine_can_do_is_refused(preset: str, override: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(preset, [override])
    field = override.partition("=")[0]
    assert field in str(caught.value)
    assert "should be" in str(caught.value)


@pytest.mark.parametrize("offset_k", [-300, 1e6])
def test_no_heat_wave_exceeds_the_largest_on_record(offset_k: float) -> None:
    wave = f"{{kind: heat_wave, start_h: 1, duration_h: 2, offset_k: {offset_k}}}"
    with pytest.raises(ConfigError, match=r"events\.scheduled\.0\.offset_k"):
        load_config("tiny", [f"events.scheduled=[{wave}]"])
    wave = f"{{kind: heat_wave, per_year: 1, duration_h: [2, 3], offset_k: {offset_k}}}"
    with pytest.raises(ConfigError, match=r"events\.sampled\.0\.offset_k"):
        load_config("tiny", [f"events.sampled=[{wave}]"])


def test_a_design_wet_bulb_is_not_above_the_dry_bulb() -> None:
    given = ["hvac.sizing.design_outdoor_c=30", "hvac.sizing.design_wet_bulb_c=31"]
    with pytest.raises(ConfigError, match="design_wet_bulb_c 31 must not be above"):
        load_config("tiny", given)
