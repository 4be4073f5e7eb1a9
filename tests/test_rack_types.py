"""Racks of unlike servers: their types, airflow, fans and heights."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from ledgers import LEDGERS, TRANSIENT_LEDGERS, residual
from sdc_taichi import (
    ConfigError,
    DataCenterConfig,
    OddInputWarning,
    build_fleet,
    drivers_from_arrays,
    load_config,
)
from sdc_taichi.hall.rack_servers import rack_servers
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.types import F64
from test_ledgers import record

MIXED = """
extends: corrected
name: mixed
hall:
  rows: 4
  racks_per_row: 5
  supply_approach_k: 5
  return_approach_k: -3
  rack_types:
    cpu: {servers: {count: 40, full_w: 200, idle_w: 40}}
    gpu: {servers: {count: 40, full_w: 750, idle_w: 90}}
  rack_plan:
  - {rows: 0-2, type: cpu}
  - {rows: 3, racks: "0, 3-4", type: cpu}
  - {rows: 3, racks: 1-2, type: gpu}
"""
SETTINGS = ["hall.supply_approach_k=5", "hall.return_approach_k=-3"]


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    path = tmp_path / "mixed.yaml"
    path.write_text(MIXED)
    return path


def rises_k(config: DataCenterConfig) -> F64:
    design = calibrate(config).design
    return np.asarray(design.outlet_rise_k - design.approach_k)


def test_a_plan_places_types(mixed: Path, tmp_path: Path) -> None:
    config = load_config(mixed)
    assert config.hall.rack_type_names() == ("cpu",) * 16 + ("gpu",) * 2 + ("cpu",) * 2
    assert config.rack_nameplate_w().tolist() == [8e3] * 16 + [30e3] * 2 + [8e3] * 2
    assert build_fleet(config).servers == 800
    again = tmp_path / "again.yaml"
    again.write_text(config.to_yaml())
    assert load_config(again) == config
    assert hash(load_config(again).hall) == hash(config.hall)


def test_racks_of_8_and_30_kw_warm_their_air_alike(mixed: Path) -> None:
    alike = "hall.recirculation.calibrate=rack"
    rise_k = rises_k(load_config(mixed, [alike]))
    assert np.ptp(rise_k) < 0.1
    assert rise_k.mean() == pytest.approx(12.65, abs=0.1)
    # One airflow per server, on which the racks of 8 kW warm their air by 13 K.
    equal = ["servers.fan_full_airflow_m3s=0.032", "hvac.crac.supply_m3s_per_w=6e-5"]
    with pytest.raises(ConfigError, match=r"racks 16, 17 warm the air by 4[78]\.\d K .* 40 K"):
        build_fleet(load_config(mixed, [alike, *equal]))


@pytest.mark.filterwarnings("ignore::sdc_taichi.errors.OddInputWarning")
@pytest.mark.parametrize("rack_kw", [100, 132])
def test_racks_beyond_what_air_cools_are_refused_unless_asked_for(rack_kw: int) -> None:
    dense = [f"servers.power_w=[{rack_kw * 5}, 10]"]
    with pytest.raises(
        ConfigError, match=r"rack \d+ with servers of [\d.]+ kW needs .* m/s through its front"
    ):
        build_fleet(load_config("corrected", dense))
    # A wider rack has a larger front, and warmer exhaust needs less air.
    wide = ["hall.layout.rack_pitch_m=1.6"]
    for asked in (["hall.most_face_velocity_m_s=7"], ["hall.most_face_velocity_m_s=null"], wide):
        build_fleet(load_config("corrected", [*dense, *asked]))


def test_densest_racks_of_air_cooled_servers_are_allowed() -> None:
    """Four servers with eight accelerators, 14.3 kW each."""
    servers = "{count: 4, full_w: 14300, idle_w: 3000, design_rise_k: 17, height_u: 10}"
    build_fleet(load_config("hall_of_2026", [f"hall.rack_types.gpu_dense.servers={servers}"]))


def test_odd_airflow_is_warned_of(mixed: Path) -> None:
    warm = load_config(mixed, ["hall.rack_types.gpu.servers.design_rise_k=28"])
    with pytest.warns(OddInputWarning, match=r"racks 16, 17 warm the air by 28 K .* 25 K is us"):
        build_fleet(warm)
    # Approach temperatures of an open hall without order.
    stirred = load_config("corrected", ["hall.supply_approach_k=11", "hall.return_approach_k=-3"])
    with pytest.warns(OddInputWarning, match=r"through rack \d+ .* RTI 22\d %; up to 200 % is us"):
        build_fleet(stirred)


def test_usual_halls_are_not_odd(mixed: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("corrected", "tiny", "paper", "sustaindc", str(mixed)):
            build_fleet(load_config(name))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("hall.rack_plan=[{rows: 0-2, type: cpu}]", "rack 0 of row 3 has no type, as 5 of 20"),
        ("hall.rack_plan=[{type: cpu}, {rows: 1, type: gpu}]", "rack 0 of row 1 has a type alr"),
        ("hall.rack_plan=[{type: gpo}]", "rack_plan.0.type: 'gpo' is not in rack_types; did you"),
        ("hall.rack_plan=[{type: cpu, rows: 2-7}]", r"rack_plan.0.rows 2-7: valid are 0\.\.3"),
        ("hall.rack_plan=[{type: cpu, racks: 3-1}]", "3-1: valid are .* the lower number first"),
        ("hall.rack_plan=[{type: cpu, rows: first}]", "rows: valid are numbers and ranges, such"),
        ("hall.rack_plan=[]", "rack 0 of row 0 has no type"),
        ("hall.rack_types.gpu.servers=[]", "rack_types.gpu.servers: .* at least 1 item"),
        ("hall.rack_types.gpu.servers.ful_w=3", "ful_w: unknown key; did you mean 'full_w'"),
        ("hall.rack_types.gpu.servers.height_u=2", "gpu: servers of 80 units of height; .* 58"),
        ("hall.rack_types.gpu.servers.design_rise_k=50", "design_rise_k: .* equal to 40"),
    ],
)
def test_types_and_plans_that_are_not_valid(change: str, message: str, mixed: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(mixed, [change])


def test_types_take_the_place_of_inherited_servers_and_the_other_way_round(mixed: Path) -> None:
    one = "hall.rack_types={a: {servers: {count: 10, full_w: 300, idle_w: 10}}}"
    config = load_config("corrected", [one])
    assert config.servers.power_w is None
    assert set(config.hall.rack_type_names()) == {"a"}
    assert load_config(mixed, ["servers.power_w=[150, 10]"]).hall.rack_types == {}
    values = load_config(mixed).model_dump(mode="json")
    values["servers"]["power_w"] = [[150, 10]]
    with pytest.raises(ValueError, match=r"rack_types and servers\.power_w are both given"):
        DataCenterConfig.model_validate(values)


def test_a_design_rise_and_an_airflow_hold_whatever_others_have(mixed: Path) -> None:
    own = ["design_rise_k=18", "full_airflow_m3s=0.1"]
    for setting in own:
        alike = "hall.recirculation.calibrate=rack"
        config = load_config(mixed, [alike, f"hall.rack_types.gpu.servers.{setting}"])
        rise_k, design = rises_k(config), calibrate(config).design
        np.testing.assert_allclose(rise_k[:16], rise_k[0], atol=0.1)
        if "rise" in setting:
            np.testing.assert_allclose(rise_k[16:18], 18.0, atol=0.3)
        of_gpu = np.flatnonzero(rack_servers(config).full_w == 750)
        if "airflow" in setting:
            assert np.all(design.full_airflow_m3s[of_gpu] == 0.1)


def test_tall_servers_fill_a_rack_from_the_floor(mixed: Path) -> None:
    tall = "{count: 2, full_w: 3000, idle_w: 300, height_u: 10}"
    small = "{count: 20, full_w: 200, idle_w: 20, height_u: 1}"
    changes = [f"hall.rack_types.gpu.servers=[{tall}, {small}]", "hall.height_zones=4"]
    servers = rack_servers(load_config(mixed, changes))
    first, end = servers.group_offsets[16:18]
    count, full_w = servers.count[first:end], servers.full_w[first:end]
    assert count.tolist() == [1, 1, 10, 10]
    assert full_w.tolist() == [3000, 3000, 200, 200]
    assert np.all(np.diff(servers.height_factor[first:end]) > 0)


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_every_ledger_closes_in_a_mixed_hall(thermal: str, mixed: Path) -> None:
    fans = "[{count: 20, full_w: 900, idle_w: 90, fan_w: 150, design_rise_k: 17},"
    fans += " {count: 20, full_w: 300, idle_w: 30, full_airflow_m3s: 0.09}]"
    config = load_config(
        mixed, [f"hall.rack_types.gpu.servers={fans}", f"simulation.thermal={thermal}"]
    )
    count = 96
    load = np.linspace(0.05, 1.0, count)
    drivers = drivers_from_arrays(
        15.0 + 10.0 * load, 12.0 + 8.0 * load, np.full(count, 300.0), load
    )
    run = record([config], count, drivers, "f64")
    for name in LEDGERS if thermal == "quasi_steady" else TRANSIENT_LEDGERS:
        assert residual(LEDGERS[name](run), 1e-6).max() < 1e-11, name


def test_servers_without_air_are_refused() -> None:
    still = [f"servers.fan_airflow_ratio_{end}=[1e-6, 1e-6]" for end in ("lb", "ub")]
    still += ["servers.fan_airflow_ratio_limits=null"]
    with pytest.raises(ConfigError, match=r"racks 0, 1, 2 and 1 more warm .* at most 40"):
        build_fleet(load_config("tiny", still))
