"""``sdc-taichi hall failover``: what is lost, how long the hall lasts, table and figure."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sdc_taichi import ConfigError, Simulator, drivers_from_arrays, load_config, with_values
from sdc_taichi.cli.app import app
from sdc_taichi.run import failover
from sdc_taichi.run.failover import Failover, failover_rows, study_failover, unit_losses

SMALL = ["hall.rows=2", "hall.racks_per_row=3", "hall.supply_approach_k=5",
         "hall.return_approach_k=-3", "servers.power_w=[150, 10]", "hvac.crac.units=3",
         "hvac.sizing.design_wet_bulb_c=26", "hvac.sizing.design_outdoor_c=35"]  # fmt: skip


@pytest.fixture(scope="module")
def study() -> Failover:
    return study_failover(load_config("corrected", SMALL))


def test_each_unit_and_each_pair_is_lost(study: Failover) -> None:
    assert [loss.units for loss in study.losses] == [(), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2)]
    assert study.note == ""
    base = load_config("corrected", SMALL)
    many, note = unit_losses(with_values(base, {"hvac.crac.units": 20}))
    assert "20 CRAC units" in note
    assert sum(len(loss.units) == 1 for loss in many) == 20
    pairs = [loss.units for loss in many if len(loss.units) == 2]
    # Units alternate between both end walls: neighbours stand on one wall.
    assert {b - a for a, b in pairs} == {2}
    assert {unit for pair in pairs for unit in pair} == set(range(20))


def test_losses_of_a_large_hall_fit_into_memory() -> None:
    big = load_config("large", ["hall.rows=100", "hall.racks_per_row=100", "hvac.crac.units=1000"])
    losses, note = unit_losses(big)
    assert [loss.units for loss in losses[:3]] == [(), (0,), (125,)]
    assert losses[-1].units == (999,)
    assert note == "Of 1,000 CRAC units, 9 are lost, one at a time."


def test_a_hall_lasts_longer_with_more_units(study: Failover) -> None:
    assert np.isnan(study.throttle_min[0])
    assert np.ptp(study.hottest_c[:, 0]) < 0.01
    hottest_c = study.hottest_c[:2].max(axis=0)
    for i, loss in enumerate(study.losses):
        assert study.hottest_c[0, i] > study.hottest_c[0, 0] or i == 0
        for j, other in enumerate(study.losses):
            if set(loss.units) < set(other.units):
                assert hottest_c[i] < hottest_c[j]
                never = 99.0
                first, second = np.nan_to_num(study.throttle_min[[i, j]], nan=never)
                assert first >= second
    assert len(study.losses[study.worst[0]].units) == 2
    assert study.worst[-1] == 0


def test_a_loss_is_the_run_of_a_hall_whose_unit_is_down(study: Failover) -> None:
    config = with_values(
        study.config,
        {"events": {"scheduled": [{"kind": "crac_down", "unit": 1, "start_h": 0,
                                   "duration_h": 5}]}},
    )  # fmt: skip
    ones = np.ones(5)
    drivers = drivers_from_arrays(35 * ones, 26 * ones, 0 * ones, ones)
    with Simulator(config, drivers=drivers) as sim:
        sim.reset()
        inlet_c = [float(sim.step().inlet_max_c[0]) for _ in range(5)]
    np.testing.assert_array_equal(study.hottest_c[:5, 2], inlet_c)


def test_without_a_chiller_racks_throttle_and_then_trip() -> None:
    found = study_failover(load_config("corrected", SMALL), "plant")
    rows = {row["lost"]: row for row in failover_rows(found, range(len(found.losses)))}
    assert rows["no loss"]["time_to_throttle_min"] is None
    lost = rows["chiller"]
    assert 0 < lost["time_to_throttle_min"] < lost["time_to_trip_min"] <= 60
    assert lost["racks_off"] > 0
    half = rows["half of chiller"]["time_to_throttle_min"]
    assert half is None or half > lost["time_to_throttle_min"]


@pytest.mark.parametrize(
    "overrides",
    [
        ["hvac.crac.temperature_control=return",
         "hvac.setpoint={min_c: 28, max_c: 45, initial_c: 30}"],
        [f"hvac.setpoint.schedule_c={[20.0] * 24}"],
    ],
)  # fmt: skip
def test_air_is_that_of_the_design_point_whatever_the_setpoint_is(overrides: list[str]) -> None:
    config = load_config("corrected", [*SMALL, *overrides])
    base, supply_c = failover._studied(config)
    assert supply_c == pytest.approx(23.0)
    ones = np.ones(2)
    with Simulator(base, drivers=drivers_from_arrays(35 * ones, 26 * ones, 0 * ones, ones)) as sim:
        sim.reset()
        assert sim.step().supply_c == pytest.approx(23.0, abs=0.2)


def test_the_command_prints_and_writes_all_losses(tmp_path: Path) -> None:
    out = tmp_path / "new" / "failover.png"
    runner, command = CliRunner(), ["hall", "failover", "corrected", *SMALL, "--out", str(out)]
    result = runner.invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "6 racks at full load" in result.output
    assert "CRAC 0 + 1" in result.output
    assert out.read_bytes().startswith(b"\x89PNG")
    rows = [*csv.DictReader(out.with_suffix(".csv").read_text().splitlines())]
    assert len(rows) == 7
    assert rows[-1]["lost"] == "no loss"
    assert rows[-1]["time_to_throttle_min"] == ""
    again = runner.invoke(app, command)
    assert again.exit_code == 2
    assert "exists" in again.output
    printed = runner.invoke(app, ["hall", "failover", "corrected", *SMALL, "--json"])
    listed = json.loads(printed.stdout)["losses"]
    assert [row["lost"] for row in listed][:2] == ["no loss", "CRAC 0"]


def test_a_hall_without_air_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"tiny: hall\.inlet_model approach .* recirculation"):
        study_failover(load_config("tiny"))
