"""Halls and events that are not valid: one line that names the place and the way out."""

from __future__ import annotations

import pytest

from sdc_taichi import ConfigError, build_fleet, load_config

EVENT = "events.scheduled=[{{kind: {}, start_h: 1, duration_h: 1{}}}]"


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("hall.recirculation.calibrate=none", ["calibrate none needs a matrix_file"]),
        ("hall.recirculation.cutoff=0.5", ["hall.recirculation.cutoff", "0.01", "0.5"]),
        ("hall.layout.ceiling_m=1", ["ceiling_m 1 must be above rack_height_m 2.1"]),
        ("hall.layout.containment=1.5", ["hall.layout.containment", "1.5"]),
        ("hall.height_gradient=1", ["hall.height_gradient", "less than 1"]),
        ("hvac.crac.units=20000", ["hvac.crac.units", "10000", "20000"]),
        ("hvac.crac.spare_units=1", ["spare_units 1 must be below units 1"]),
        ("hvac.crac={unit_sizes: equal, airflow_m3s: 30}", ["unit_sizes 'equal'"]),
        ("hvac.crac.capacity_kw=[9, 9]", ["capacity_kw has 2 entries, expected 1 (units)"]),
        (
            "hvac.crac.temperature_control=return",
            ["setpoint.min_c 16", "the rise of the air of 14.7 K", "chilled water of -6.7"],
        ),
        ("hvac.crac.airflow_m3s=[9, 9]", ["airflow_m3s has 2 entries, expected 1 (units)"]),
        ("hvac.crac.unit_shares=[[1]]", ["hvac.crac.unit_shares has 1 entries, expected 20"]),
        (
            f"hvac.crac.unit_shares={[[0.5]] * 20}",
            ["unit_shares of rack 0", "1 entries that sum to 0.5", "sum to 1"],
        ),
        ("hvac.crac.flow_model=per_watt", ["another hvac.crac.flow_model than per_watt"]),
        ("servers.outlet_model=rack", ["recirculation needs servers.outlet_model server"]),
        ("hall.supply_approach_limits_k=[3, 5]", ["needs hall.supply_approach_limits_k null"]),
        (
            "servers.groups=[[{count: 3, full_w: 150, idle_w: 10, inlet_offset_k: 1}]]",
            ["inlet_offset_k 0", "hall.height_zones takes its place"],
        ),
        ("simulation.substep_s=500", ["simulation.substep_s", "120", "500"]),
        ("simulation.thermal=slow", ["simulation.thermal", "'quasi_steady' or 'transient'"]),
        ("workload.placement=best", ["workload.placement", "'coolest-first'", "'best'"]),
        ("protection.ashrae_class=A5", ["protection.ashrae_class", "'A4'", "'A5'"]),
        (EVENT.format("crac_down", ", unit: 3"), ["events.scheduled.0.unit 3: valid is 0..0"]),
        (
            EVENT.format("rack_fan_failure", ", rack: 20, share: 0.5"),
            ["events.scheduled.0.rack 20: valid is 0..19"],
        ),
        (EVENT.format("rack_fan_failure", ", rack: 2, share: 0"), ["share 0 leaves a rack"]),
        (EVENT.format("chiller_derate", ""), ["chiller_derate needs share"]),
        (EVENT.format("heat_wave", ", share: 0.5"), ["share has no meaning for heat_wave"]),
        (EVENT.format("grid_outage", ", unit: 0"), ["unit has no meaning for grid_outage"]),
        (EVENT.format("flood", ""), ["events.scheduled.0.kind", "'grid_outage'", "'flood'"]),
        (
            EVENT.format("crac_down", ", start: 2"),
            ["events.scheduled.0.start: unknown key; did you mean 'start_h'?"],
        ),
        (
            "events.sampled=[{kind: grid_outage, per_year: 2, duration_h: [3, 2]}]",
            ["duration_h (3, 2) must be (low, high) with low <= high"],
        ),
        (
            "events.sampled=[{kind: grid_outage, per_year: 2, hours: [3, 2]}]",
            ["events.sampled.0.hours: unknown key"],
        ),
    ],
)
def test_field_is_refused(override: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("corrected", [override])
    text = str(caught.value)
    assert "\n" not in text
    for part in parts:
        assert part in text


@pytest.mark.parametrize(
    ("override", "what"),
    [
        ("hvac.crac.units=2", "hvac.crac.units 2"),
        ("simulation.thermal=transient", "simulation.thermal transient"),
        (EVENT.format("crac_down", ""), "event crac_down"),
        (EVENT.format("rack_fan_failure", ", rack: 0, share: 0.5"), "event rack_fan_failure"),
    ],
)
def test_given_inlets_know_no_air(override: str, what: str) -> None:
    with pytest.raises(ConfigError, match=f"{what} needs hall.inlet_model recirculation"):
        load_config("corrected", ["hall.inlet_model=approach", override])


@pytest.mark.parametrize(
    ("override", "calibrate", "parts"),
    [
        (
            "servers.fan_full_airflow_m3s=0.051",
            "rack",
            ["servers draw 4", "CRAC units give 3", "servers.fan_full_airflow_m3s"],
        ),
        ("hall.supply_approach_k=14", "rack", ["of rack ", " needs 1.0", "valid is below 1"]),
        ("hall.supply_approach_k=16", "row", ["is 16 K on the mean", "valid is at most 90 %"]),
        ("hall.supply_approach_k=18", "row", ["fan_full_airflow_m3s null", "leave -0.", "above 0"]),
    ],
)
def test_hall_that_cannot_close_is_refused(override: str, calibrate: str, parts: list[str]) -> None:
    config = load_config("corrected", [override, f"hall.recirculation.calibrate={calibrate}"])
    with pytest.raises(ConfigError) as caught:
        build_fleet(config)
    for part in parts:
        assert part in str(caught.value)
