"""Liquid-cooled halls in recordings, figures, reports and the commands of halls."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgba
from typer.testing import CliRunner, Result

from rrd import images, read, scalars, verify
from sdc_taichi import (
    Actions,
    ConfigError,
    Recorder,
    SdcError,
    Simulator,
    drivers_from_arrays,
    load_config,
    with_values,
)
from sdc_taichi.cli.app import app
from sdc_taichi.control import make_controller
from sdc_taichi.run.description import RunRequest
from sdc_taichi.run.failover import failover_rows, study_failover
from sdc_taichi.run.folder_reader import read_racks, read_run, read_steps
from sdc_taichi.run.folder_writer import simulate_to_folder
from sdc_taichi.sim.design_liquid import design_liquid_values, solve_design_liquid
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.junction_parts import junction_terms
from sdc_taichi.types import QUANTITIES, LiquidQuantities, StepResult
from sdc_taichi.viz import liquid_figures, rack_maps
from sdc_taichi.viz.floor_plan_figure import failover_figure
from sdc_taichi.viz.liquid_loop import LOOP_FIELDS, junction_limits_c, loop_texts
from sdc_taichi.viz.plotting import darken, drawn
from sdc_taichi.viz.recording_liquid import CDU_PLOTS, LIQUID_PLOTS
from sdc_taichi.viz.recording_series import line_factors
from sdc_taichi.viz.report import report_html

SMALL = ["name=ai", "hall.rows=2", "hall.racks_per_row=4", "hall.supply_approach_k=5",
         "hall.return_approach_k=-3", "hvac.sizing.model=design_day",
         "hall.rack_types={gpu: {model: gb200_nvl72}, web: {servers: {count: 18, full_w: 600, "
         "idle_w: 170, design_rise_k: 13}}}",
         "hall.rack_plan=[{type: web, racks: 0-1}, {type: gpu, racks: 2-3}]",
         "liquid={cdus: {per_manifold: 2}, reuse: {kind: heat_pump, share: 0.5}}"]  # fmt: skip
AIR_RACKS, LIQUID_RACKS = [0, 1, 4, 5], [2, 3, 6, 7]
STEPS = 6


@dataclass
class Recorded:
    fleet: Fleet
    results: list[StepResult]
    path: Path
    entities: dict[str, dict[str, list[Any]]]


def with_liquid(result: StepResult, fleet: Fleet) -> StepResult:
    """The result with other values of all liquid quantities, which pictures read."""
    rng = np.random.default_rng(result.step)
    for name in (field.name for field in fields(LiquidQuantities)):
        values = getattr(result, name)
        low, high = {"W": (1e5, 1e6), "C": (20.0, 90.0)}.get(QUANTITIES[name].unit, (0.0, 1.0))
        values[:] = rng.uniform(low, high, values.shape)
    result.rack_junction_c[AIR_RACKS] = 0.0
    return result


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recorded]:
    path, results = tmp_path_factory.mktemp("liquid") / "run.rrd", []
    with Simulator(load_config("corrected", SMALL)) as sim, Recorder(path, every=2) as recorder:
        sim.reset()
        recorder.begin(sim)
        for _ in range(STEPS):
            results.append(with_liquid(sim.step(), sim.fleet))
            recorder.add(results[-1])
        recorder.close()
        yield Recorded(sim.fleet, results, path, read(path))


def test_loops_and_cdus_are_recorded_in_every_step(recorded: Recorded) -> None:
    assert verify(recorded.path).returncode == 0
    for entity, plot in LIQUID_PLOTS.items():
        of_results = [
            [getattr(r, field)[0] for _, field, _ in plot.lines] for r in recorded.results
        ]
        expected = np.array(of_results) * line_factors(plot, recorded.results[0].step_h)
        np.testing.assert_allclose(scalars(recorded.entities[f"/dc/ai/liquid/{entity}"]), expected)
    for entity, (field, _, factor) in CDU_PLOTS.items():
        each = [factor * getattr(result, field) for result in recorded.results]
        np.testing.assert_allclose(scalars(recorded.entities[f"/dc/ai/liquid/{entity}"]), each)


def test_junctions_are_a_map_and_texts_of_the_diagram_move(recorded: Recorded) -> None:
    junctions = recorded.entities["/dc/ai/map/junction"]
    assert junctions["step"] == [0, 2, 4]
    maps = images(junctions)
    height, width = maps.shape[1] // 2, (maps.shape[2] + 1) // 4
    tiles = maps[:, height // 2 :: height + 1, width // 2 :: width].reshape(3, -1)
    each_c = np.array([result.rack_junction_c for result in recorded.results[::2]])
    assert np.isnan(tiles[:, AIR_RACKS]).all()
    np.testing.assert_allclose(tiles[:, LIQUID_RACKS], each_c[:, LIQUID_RACKS], atol=0.26)
    texts = recorded.entities["/dc/ai/liquid/loop/texts"]
    liquid = recorded.fleet.configs[0].liquid
    assert liquid is not None
    for result, labels in zip(recorded.results[::2], texts["Points2D:labels"][-3:], strict=True):
        values = {name: float(getattr(result, name)[0]) for name in LOOP_FIELDS}
        shown = "\n".join(loop_texts(values, liquid, "C").values())
        assert "\n".join(labels) == shown
        assert f"{result.cdu_return_c[0]:.1f} C" in labels
        assert f"heat pump {result.heat_pump_w[0] / 1e3:,.0f} kW" in labels


def test_diagram_shows_the_devices_of_the_config(recorded: Recorded) -> None:
    values = {name: float(getattr(recorded.results[0], name)[0]) for name in LOOP_FIELDS}
    for more, shown, hidden in (
        ([], "heat pump", "trim chiller"),
        (["liquid.reuse={}", "liquid.facility.trim_kw=300"], "trim chiller", "delivered"),
        (["liquid.facility={trim_kw: 300, trim_by: plant}"], "CRAC plant", "trim chiller"),
    ):
        liquid = load_config("corrected", SMALL + more).liquid
        assert liquid is not None
        (axes,) = liquid_figures.loop_diagram(values, liquid, "ai").axes
        text = " ".join(each.get_text() for each in axes.texts)
        assert shown in text
        assert hidden not in text
        assert f"{values['cdu_supply_c']:.1f} °C" in text


def test_junction_map_shows_racks_in_air_grey() -> None:
    config = load_config("corrected", SMALL)
    limits_c = junction_limits_c(config)
    assert limits_c == (85.0, 105.0)
    junction_c = np.zeros(8)
    junction_c[LIQUID_RACKS] = 70.0, 86.0, 72.0, 71.0
    figure: Any = rack_maps.junction_map(junction_c, config.hall, limits_c)
    axes, bar = figure.axes
    assert [text.get_text() for text in axes.texts] == ["70.0", "86.0", "72.0", "71.0"]
    assert "1.0 K above the 85 °C of throttling, at row 0 rack 3" in axes.get_title(loc="left")
    assert "85 throttle" in [text.get_text() for text in bar.get_yticklabels()]
    assert axes.get_facecolor() == to_rgba("#DDDDDD")
    mesh = axes.collections[0]
    cool, warm = mesh.cmap(mesh.norm([84.9, 85.1]))
    assert cool[1] > cool[0]
    assert warm[0] > warm[2] + 0.2


def test_history_stacks_heat_and_power(recorded: Recorded) -> None:
    times = pd.date_range("2026-07-01", periods=STEPS, freq="15min")
    columns = {
        n: [float(getattr(r, n)[0]) for r in recorded.results] for n in liquid_figures.COLUMNS
    }
    steps = pd.DataFrame({"time": times, **columns})
    steps.loc[2, "liquid_stored_w"] = -5e4
    figure: Any = liquid_figures.loop_history(steps, 85.0, "ai")
    temperatures, heat, power = figure.axes
    lines = [
        line.get_ydata()[:-1] for line in temperatures.lines[: len(liquid_figures.TEMPERATURES)]
    ]
    np.testing.assert_array_equal(lines, [steps[n] for n, *_ in liquid_figures.TEMPERATURES])
    for axes, parts in ((heat, liquid_figures.HEAT), (power, liquid_figures.POWER)):
        tops = [part.get_datalim(axes.transData).y1 for part in axes.collections]
        total = np.maximum(steps[[name for name, *_ in parts]], 0.0).sum(axis=1).max() / 1e3
        scale = 1e3 if "(MW)" in axes.get_ylabel() else 1.0
        assert max(tops) * scale == pytest.approx(total, rel=1e-9)
    assert heat.dataLim.y0 * (1e3 if "(MW)" in heat.get_ylabel() else 1.0) == pytest.approx(-50.0)
    light = np.asarray(drawn(figure, 60)).astype(int)
    darken(figure)
    assert light[0, 0].min() - int(np.asarray(drawn(figure, 60))[0, 0].max()) > 200


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    with Simulator(load_config("corrected", SMALL)) as sim:
        simulate_to_folder(sim, make_controller("idle", sim.fleet), RunRequest("idle", 12), out)
    return out


def test_report_shows_loops_and_figures(folder: Path) -> None:
    run = read_run(folder)
    (steps,), (racks,) = read_steps(run, [0]), read_racks(run, [0])
    assert racks["junction_c"].max() == pytest.approx(steps["junction_max_c"].max(), abs=1e-3)
    assert (racks["junction_c"][AIR_RACKS] == 0).all()
    html = report_html(run)
    section = html[html.index("Liquid cooling of ai</h2>") :].partition("</section>")[0]
    assert section.count("<figure>") == 3
    facility_w = steps["it_w"] + steps["overhead_w"]
    for value in (
        steps["reuse_w"].sum() / facility_w.sum(),
        (facility_w - steps["reuse_w"]).sum() / steps["it_w"].sum(),
        facility_w.sum() / (steps["it_w"] - steps["it_fan_w"]).sum(),
    ):
        assert f"<dd>{value:.4g}</dd>" in section
    assert "ASHRAE class W40 for 3 h." in section


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_parts_of_a_junction_add_up(thermal: str) -> None:
    base = with_values(load_config("corrected", SMALL), {"simulation.thermal": thermal})
    causes = {
        "flow_k": None,
        "shortfall_k": {"kind": "heat_wave", "offset_k": 25},
        "limit_k": None,
    }
    configs = [
        with_values(base, {"name": cause, "events.scheduled": [
            {**event, "start_h": 0, "duration_h": 9}] if event else []})
        for cause, event in causes.items()
    ]  # fmt: skip
    actions = Actions(cdu_flow=np.array([0.5, 1.0, 1.0]), power_cap=np.array([1.0, 1.0, 0.6]))
    ones = np.ones(8)
    drivers = drivers_from_arrays(20 * ones, 15 * ones, 0 * ones, ones, size=len(configs))
    with Simulator(configs, drivers=drivers) as sim:
        sim.reset()
        for _ in range(8):
            result = sim.step(actions)
        parts = {cause: sim.junction_parts(3, dc) for dc, cause in enumerate(causes)}
        with pytest.raises(SdcError, match=r"rack 4: has no cold plates; valid is .* such as 2"):
            sim.junction_parts(4)
    for dc, (cause, each) in enumerate(parts.items()):
        terms = dict(junction_terms(each))
        assert sum(terms.values()) == pytest.approx(each.junction_c, abs=0.03)
        assert each.junction_c == pytest.approx(result.rack_junction_c[8 * dc + 3], abs=1e-3)
        assert terms["facility water"] == result.facility_supply_c[dc]
        size_k = {name: abs(getattr(each, name)) for name in causes}
        assert size_k[cause] > 1.0
        others = {abs(getattr(other, cause)) for name, other in parts.items() if name != cause}
        assert size_k[cause] >= max(others)


def test_why_explains_the_hottest_junction_of_config_and_run(folder: Path) -> None:
    command = ["hall", "why", "--of", "junction", "--json"]
    at_design = call(*command, "corrected", *SMALL)
    shown = json.loads(call("hall", "show", "corrected", *SMALL, "--json").stdout)["liquid"]
    assert json.loads(at_design.stdout)["junction_c"] == pytest.approx(shown["junction_max_c"])
    of_run = json.loads(call(*command, folder).stdout)
    (steps,) = read_steps(read_run(folder), [0])
    step = int(steps["junction_max_c"].argmax())
    assert of_run["junction_c"] == pytest.approx(steps["junction_max_c"].iloc[step])
    assert f"hottest step {step} of" in of_run["at"]
    assert (
        "rack 3 (row 0, place 3)"
        in call("hall", "why", folder, "--of", "junction", "--rack", 3).stdout
    )


def test_show_describes_heat_cdus_and_water() -> None:
    config = load_config("corrected", SMALL)
    liquid = solve_design_liquid(config)
    shown = design_liquid_values(liquid)
    heat_w = shown["liquid_heat_w"] + shown["liquid_air_w"] - 0.1 * shown["cdu_pump_w"]
    assert heat_w == pytest.approx(shown["liquid_it_w"], rel=0.02)
    assert shown["liquid_it_w"] == pytest.approx(4 * 132e3, rel=0.02)
    assert shown["facility_setpoint_c"] == 36.0
    assert shown["facility_class"] == "W32"
    # Warmer facility water makes GPUs throttle.
    margin_k = 85.0 - liquid.parts(None).junction_c
    assert shown["warmest_water_c"] > 36.0 + 0.8 * margin_k
    assert shown["warmest_water_c"] < 36.0 + margin_k
    text = call("hall", "show", "corrected", *SMALL).stdout
    assert "type gpu: 4 racks of 132.0 kW: 115.0 kW into 138 l/min of coolant" in text
    assert "1 loop with 2 CDUs of 520 kW each, 1 of them needed (N+1)" in text
    assert "at most 36.0 C keeps the setpoint (class W32)" in text
    hot = [*SMALL, "hvac.sizing.design_outdoor_c=45", "liquid.setpoint_c=25"]
    for trim_by, shown_text in (("chiller", "trim chiller takes"), ("plant", "CRAC units takes")):
        more = f"liquid.facility={{trim_kw: 900, trim_by: {trim_by}}}"
        shown_kw = re.search(
            rf"{shown_text} ([0-9.]+) kW", call("hall", "show", "corrected", *hot, more).stdout
        )
        assert shown_kw is not None
        assert float(shown_kw[1]) > 200.0


def test_a_hall_with_rear_doors_alone_has_no_junctions(tmp_path: Path) -> None:
    doors = [*SMALL[:-3], "hall.rack_types={web: {servers: {count: 18, full_w: 600, idle_w: 170, "
             "design_rise_k: 13}, rear_door: {}}}", "hall.rack_plan=[{type: web}]",
             "liquid={setpoint_c: 22, facility: {trim_kw: 100}}",
             "protection.ashrae_class=A2"]  # fmt: skip
    config = load_config("corrected", doors)
    no_plates = "no rack has cold plates; valid is a hall with liquid-cooled chips"
    command = ["hall", "why", "--of", "junction"]
    for more in ([], ["--rack", "1"]):
        failed = CliRunner().invoke(app, [*command, "corrected", *doors, *more])
        assert failed.exit_code == 2
        assert no_plates in failed.output.replace("\n", " ")
        assert failed.output.count("\n") <= 2
    shown = call("hall", "show", "corrected", *doors)
    assert "junction" not in shown.stdout
    with Simulator(config) as sim, Recorder(tmp_path / "run.rrd") as recorder:
        controller = make_controller("liquid=liquid-reset", sim.fleet)
        simulate_to_folder(sim, controller, RunRequest("liquid=liquid-reset", 3), tmp_path / "run")
        sim.reset()
        recorder.begin(sim)
        recorder.add(sim.step())
    entities = read(tmp_path / "run.rrd")
    assert "/dc/ai/liquid/loop_c" in entities
    assert not any("junction" in entity for entity in entities)
    run = read_run(tmp_path / "run")
    assert "junction_c" not in read_racks(run, [0])[0]
    (steps,) = read_steps(run, [0])
    np.testing.assert_allclose(steps["cdu_supply_c"], 22.0, err_msg="the reset holds setpoints")
    html = report_html(run)
    section = html[html.index("Liquid cooling of ai</h2>") :].partition("</section>")[0]
    assert section.count("<figure>") == 2
    assert "junction" not in section
    study = study_failover(config, "liquid")
    rows = {row["lost"]: row for row in failover_rows(study, range(len(study.losses)))}
    assert rows["no loss"]["time_to_throttle_s"] is None
    lost = rows["facility pumps"]
    assert lost["hottest_inlet_60_min_c"] > rows["no loss"]["hottest_inlet_60_min_c"] + 3.0
    assert all(
        row["time_to_trip_s"] is None or row["time_to_trip_s"] >= 60 for row in rows.values()
    )
    assert rows["leak at rack 0"]["racks_off"] == 0
    curves: Any = failover_figure(study).axes[1]
    assert curves.get_ylabel() == "hottest inlet of the hall (°C)"


def test_failover_of_liquid_cooling_counts_seconds() -> None:
    study = study_failover(load_config("corrected", SMALL), "liquid")
    rows = {row["lost"]: row for row in failover_rows(study, range(len(study.losses)))}
    assert rows["no loss"]["time_to_throttle_s"] is None
    assert rows["CDU 0"]["time_to_throttle_s"] is None, "the other CDU takes its load"
    both, pumps = rows["CDU 0 + 1"], rows["facility pumps"]
    assert both["time_to_trip_s"] <= 2.0
    assert both["racks_off"] == 4
    assert 10.0 < pumps["time_to_throttle_s"] < 60.0
    assert pumps["time_to_trip_s"] > pumps["time_to_throttle_s"]
    leak = rows["leak at rack 2"]
    assert (leak["time_to_throttle_s"], leak["time_to_trip_s"], leak["racks_off"]) == (
        None,
        None,
        1,
    )
    half, whole = (rows[name]["hottest_junction_60_min_c"] for name in ("half of cooler", "cooler"))
    assert rows["no loss"]["hottest_junction_60_min_c"] <= half < whole
    assert study.losses[study.worst[0]].name == "CDU 0 + 1"
    plan, curves, *_ = failover_figure(study).axes
    assert curves.get_ylabel() == "hottest junction of the hall (°C)"
    assert "hottest minute, 1 min after the loss of CDU 0 + 1" in plan.get_title(loc="left")
    worst = study.worst[0]
    assert study.rack_c[worst].max() == study.hottest_c[:, worst].max()
    with pytest.raises(ConfigError, match="no rack is liquid-cooled"):
        study_failover(load_config("corrected"), "liquid")


def call(*arguments: object) -> Result:
    done = CliRunner().invoke(app, list(map(str, arguments)))
    assert done.exit_code == 0, done.output
    return done
