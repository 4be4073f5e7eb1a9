"""Why inlets are warm: the parts of an inlet temperature, and ``sdc-taichi hall why``."""

from __future__ import annotations

import json
import re
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from sdc_taichi import Simulator, load_config
from sdc_taichi.cli.hall import hall_app
from sdc_taichi.control import make_controller
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.run.description import RunRequest
from sdc_taichi.run.folder_reader import RunFolder, read_run, read_steps
from sdc_taichi.run.folder_writer import simulate_to_folder
from sdc_taichi.run.inlets_of_run import hottest_inlets, inlets_at_step
from sdc_taichi.run.steps_file import METADATA_KEY
from sdc_taichi.sim.design_hall import solve_design_hall
from sdc_taichi.sim.fleet_configs import make_configs
from sdc_taichi.sim.inlet_parts import InletParts, Inlets, inlet_terms, intake_air_of, rack_text
from sdc_taichi.viz.report import hot_racks_section
from sdc_taichi.viz.report_html import html_blocks

FAILURES = (
    "hvac.crac.units=4",
    "events.scheduled=[{kind: crac_down, unit: 1, start_h: 0.5, duration_h: 2}, "
    "{kind: crac_down, unit: 2, start_h: 0.5, duration_h: 2}, "
    "{kind: crac_down, unit: 3, start_h: 0.5, duration_h: 2}, "
    "{kind: rack_fan_failure, rack: 7, share: 0.3, start_h: 0.5, duration_h: 2}]",
)
"""Three of four units down and the fans of rack 7 failing, at the fourth step of a quarter hour."""
HALLS = {
    "open": ("corrected",),
    "contained": ("corrected", "hall.layout.containment=0.7", "hvac.crac.units=2"),
    "failures": ("corrected", *FAILURES),
    "transient": ("corrected", "simulation.thermal=transient", *FAILURES),
    "sparse": ("large",),
    "approach": ("sustaindc",),
}


def total_c(parts: InletParts) -> float:
    """The parts of an inlet, added up, in C."""
    others_k = parts.warming_k + parts.approach_k + parts.lag_k + parts.exhaust_k.sum()
    return float(parts.setpoint_c + others_k)


@pytest.mark.parametrize("name", HALLS)
def test_the_parts_add_up_to_the_inlets_of_the_kernels(name: str) -> None:
    preset, *overrides = HALLS[name]
    config = load_config(preset, overrides)
    twin = config.model_copy(update={"name": "twin"})
    with Simulator([config, twin], precision="f64") as sim:
        sim.reset()
        for _ in range(4):
            result = sim.step()
        groups_c = sim.server_groups().inlet_c[len(sim.fleet.server_offsets) // 2 :]
        ends = sim.fleet.group_offsets[: config.hall.racks + 1]
        hottest_c = np.maximum.reduceat(groups_c, ends[:-1])
        inlets = Inlets(sim.fleet, 1, intake_air_of(sim.fleet, sim.intake_air(), 1))
    main_unit, main_share = inlets.main_units()
    assert inlets.hottest(3) == inlets.hottest(config.hall.racks)[:3]
    for rack in {0, 7, config.hall.racks - 1, *inlets.hottest(3)}:
        parts = inlets.parts(rack)
        assert main_share[rack] == pytest.approx(parts.unit_share.max())
        assert parts.unit_share[main_unit[rack]] == pytest.approx(main_share[rack])
        assert parts.inlet_c == pytest.approx(hottest_c[rack], abs=1e-9)
        assert total_c(parts) == pytest.approx(hottest_c[rack], abs=1e-9)
        why_k = parts.layout_k + parts.height_k + parts.shortfall_k + parts.approach_k
        assert why_k == pytest.approx(parts.rise_k, abs=1e-9)
        assert parts.unit_share.sum() == pytest.approx(1.0)
    if config.simulation.thermal == "quasi_steady":
        np.testing.assert_allclose(hottest_c, result.rack_inlet_max_c[-len(hottest_c) :])
        assert abs(parts.lag_k) < 1e-9
    first = inlets.hottest(1)[0]
    assert hottest_c[first] == pytest.approx(hottest_c.max())


def test_a_unit_that_is_down_shows_as_air_that_falls_short() -> None:
    parts = {}
    for name, overrides in (("well", FAILURES[:1]), ("down", FAILURES)):
        with Simulator(load_config("corrected", overrides), precision="f64") as sim:
            sim.reset()
            for _ in range(4):
                sim.step()
            parts[name] = Inlets(sim.fleet, 0, sim.intake_air()).parts(7)
    well, down = parts["well"], parts["down"]
    assert well.shortfall_k == pytest.approx(0.0, abs=1e-9)
    assert down.shortfall_k > 1.0
    assert down.unit_fresh_ratio[1] < 0.5 < well.unit_fresh_ratio[1]
    assert down.unit_share[1] < well.unit_share[1]
    assert (well.fan_airflow, down.fan_airflow) == (1.0, 0.3)


def test_containment_keeps_out_what_the_open_hall_lets_in() -> None:
    """At equal exhausts, r (1 - c) of the intake in place of r is exhaust."""
    inlets = solve_design_hall(load_config("corrected", ["hall.layout.containment=0.5"])).inlets
    parts = inlets.parts(3)
    assert parts.contained_k == pytest.approx(parts.layout_k + parts.height_k)
    closed = solve_design_hall(load_config("corrected", ["hall.layout.containment=1"])).inlets
    assert closed.parts(3).contained_k is None
    assert closed.parts(3).layout_k == 0.0


def test_the_nearest_racks_warm_an_inlet_most() -> None:
    hall = solve_design_hall(load_config("corrected"))
    parts = hall.inlets.parts(0)
    assert [rack for rack, _ in parts.sources(2)] == [1, 5]
    assert len(parts.sources()) == 5
    words = [text for text, _ in inlet_terms(parts, 5)]
    assert words[0] == "setpoint of its supply air"
    assert words[1] == "exhaust of rack 1 (row 0, place 1)"
    assert words[-2:] == ["exhaust of 14 other racks", "its own exhaust"]
    assert sum(k for _, k in inlet_terms(parts, 5)) == pytest.approx(parts.inlet_c, abs=0.02)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A day of two halls with failures, under ``g36``."""
    out = tmp_path_factory.mktemp("runs") / "run"
    configs = make_configs(load_config("corrected", FAILURES), sites=["NY", "AZ"])
    with Simulator(configs) as sim:
        controller = make_controller("g36", sim.fleet)
        simulate_to_folder(sim, controller, RunRequest("g36", 96, 3), out)
    return read_run(out)


def test_a_run_keeps_the_air_of_its_hottest_step(run: RunFolder) -> None:
    for dc, content in enumerate(run.metrics["data_centers"]):
        metrics = content["metrics"]
        found = hottest_inlets(run, dc)
        assert found is not None
        assert found.step == metrics["hottest_step"]
        hottest = found.inlets.parts(found.inlets.hottest(1)[0])
        assert hottest.inlet_c == pytest.approx(metrics["hottest_inlet_c"], abs=1e-4)
        assert (hottest.rack, hottest.server) == (
            metrics["hottest_rack"],
            metrics["hottest_server"],
        )
        again = inlets_at_step(run, dc, found.step)
        assert again.inlets.parts(7).inlet_c == pytest.approx(
            found.inlets.parts(7).inlet_c, abs=1e-5
        )


def test_any_step_of_a_run_is_simulated_again(run: RunFolder) -> None:
    (steps,) = read_steps(run, [1], ["inlet_max_c", "setpoint_c"])
    found = inlets_at_step(run, 1, 30)
    parts = found.inlets.parts(found.inlets.hottest(1)[0])
    assert parts.inlet_c == pytest.approx(steps["inlet_max_c"][30], abs=1e-4)
    assert parts.setpoint_c == pytest.approx(steps["setpoint_c"][30])
    with pytest.raises(ConfigError, match=r"step 96: valid is 0\.\.95"):
        inlets_at_step(run, 1, 96)


def test_a_run_that_does_not_repeat_is_an_error(run: RunFolder, tmp_path: Path) -> None:
    folder = shutil.copytree(run.path, tmp_path / "run")
    path = folder / "metrics.json"
    path.write_text(path.read_text().replace('"seed": 3', '"seed": 4'))
    table = pq.read_table(folder / "steps.parquet")
    metadata = dict(table.schema.metadata)
    metadata[METADATA_KEY] = metadata[METADATA_KEY].replace(b'"seed": 3', b'"seed": 4')
    metadata[METADATA_KEY] = metadata[METADATA_KEY].replace(b"g36", b"coldest")
    path.write_text(path.read_text().replace("g36", "coldest"))
    pq.write_table(table.replace_schema_metadata(metadata), folder / "steps.parquet")
    with pytest.raises(SdcError, match="step 30 of az, simulated again alone, has a hottest inlet"):
        inlets_at_step(read_run(folder), 1, 30)


def test_report_explains_the_five_hottest_racks(run: RunFolder) -> None:
    text = html_blocks(hot_racks_section(run, [0, 1]))
    found = hottest_inlets(run, 1)
    assert found is not None
    for rack in found.inlets.hottest(5):
        assert rack_text(rack, 5) in text
        assert f"{found.inlets.parts(rack).inlet_c:.2f}" in text
    assert text.count("<tr>") == 2 * 5 + 2


def test_given_inlets_are_explained_by_their_approach_temperatures(tmp_path: Path) -> None:
    with Simulator(load_config("tiny")) as sim:
        controller = make_controller("idle", sim.fleet)
        simulate_to_folder(sim, controller, RunRequest("idle", 2, 1), tmp_path / "run")
    report = html_blocks(hot_racks_section(read_run(tmp_path / "run"), [0]))
    assert "approach temperature (K)" in report
    assert "exhaust of other racks" not in report
    assert "is exhaust air" not in report


def why(*arguments: object) -> str:
    """Output of ``sdc-taichi hall why``."""
    done = CliRunner().invoke(hall_app, ["why", *map(str, arguments)])
    if done.exception is not None:
        raise done.exception
    return done.stdout


def test_command_explains_a_run(run: RunFolder) -> None:
    call = partial(why, run.path)
    hottest = run.metrics["total"]["hottest_dc"]
    step = run.metrics["total"]["hottest_step"]
    assert call().startswith(f"{hottest}, at the end of its hottest step {step} of ")
    assert f"{run.metrics['total']['hottest_inlet_c']:.2f} C" in call()
    assert "rack 7 (row 1, place 2)" in call("--rack", 7, "--dc", "az")
    assert "at the end of step 4 of" in call("--rack", 7, "--dc", "az", "--step", 4)
    for message, arguments in (
        ("no such data center", ("--dc", "tx")),
        ("valid is 0..95", ("--step", 96)),
        ("valid with a preset or file", ("--set", "name=x")),
        ("valid is it alone", ("name=x",)),
    ):
        with pytest.raises(SdcError, match=re.escape(message)):
            call(*arguments)
    for option in ("--dc", "--step"):
        with pytest.raises(SdcError, match=f"{option}: given without a run"):
            why("corrected", option, "1")


def test_setpoints_of_return_air_are_named_so() -> None:
    control = ["hvac.crac.temperature_control=return", "hvac.setpoint.min_c=28"]
    limits = ["hvac.setpoint.max_c=38", "hvac.setpoint.initial_c=34"]
    with Simulator(load_config("corrected", [*control, *limits]), precision="f64") as sim:
        sim.reset()
        sim.step()
        parts = Inlets(sim.fleet, 0, sim.intake_air()).parts(3)
    (text, setpoint_c), (over, warming_k) = inlet_terms(parts, 5)[:2]
    assert text == "coldest supply air that its setpoint of return air admits"
    assert over == "supply air over that temperature"
    assert setpoint_c < 34.0
    assert warming_k > 1.0
    assert total_c(parts) == pytest.approx(parts.inlet_c, abs=1e-9)


def test_command_names_a_rack_by_number_or_by_row_and_place(tmp_path: Path) -> None:
    text = why("--rack", "7")
    assert "rack 7 (row 1, place 2)" in text
    assert why("corrected", "--rack", "1:2") == text
    assert "exhaust of 14 other racks" in text
    values = json.loads(why("--rack", "7", "--json"))
    parts_k = values["warming_k"] + sum(values["exhaust_k"])
    assert values["setpoint_c"] + parts_k == pytest.approx(values["inlet_c"], abs=1e-9)
    picture = tmp_path / "why.png"
    assert why("--rack", "7", "--out", str(picture)) == f"{text}Floor plan: {picture}\n"
    assert picture.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match="exists; choose another name"):
        why("--out", str(picture))
    hottest = json.loads(why("--json"))
    assert hottest["inlet_c"] >= values["inlet_c"]
    for bad in ("20", "4:0", "0:5", "-1", "x", "1:", "1:2:3"):
        with pytest.raises(ConfigError, match=r"valid is a rack 0\.\.19, or ROW:PLACE up to 3:4"):
            why("--rack", bad)
