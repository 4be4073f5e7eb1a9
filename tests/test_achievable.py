"""Controllers beside a known optimum: shares, files and the report."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from known_optimum import KWH_VALUE, TASK_VALUE, made_up_optimum
from report_reader import Page, read_blocks, read_page
from sdc_taichi import (
    RunRequest,
    SdcError,
    Simulator,
    load_config,
    make_configs,
    make_controller,
    simulate_to_folder,
)
from sdc_taichi.cli.app import app
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.run.achievable import AchievedPath, Achievement, run_beside
from sdc_taichi.run.comparison import compare_runs
from sdc_taichi.run.folder_reader import read_run
from sdc_taichi.run.optimum_folder import (
    FOLDER,
    find_optimum,
    optimum_content,
    optimum_remarks,
    remarks_beside,
    write_optimum,
)
from sdc_taichi.viz import report
from sdc_taichi.viz.report_pictures import known_optimum, optimum_section

STEPS = 120
SITES = ["NY", "CA"]


@pytest.fixture(scope="module")
def sim() -> Iterator[Simulator]:
    with Simulator(make_configs(load_config("tiny", ["site.start=07-01"]), sites=SITES)) as made:
        yield made


@pytest.fixture(scope="module")
def optimum(sim: Simulator) -> Optimum:
    return made_up_optimum(sim, STEPS)


def run(sim: Simulator, spec: str, out: Path, optimum: Optimum | None = None) -> dict[str, Any]:
    driver = make_controller(spec, sim.fleet)
    written = simulate_to_folder(sim, driver, RunRequest(spec, STEPS), out, optimum=optimum)
    assert written is not None
    return written


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory, sim: Simulator, optimum: Optimum) -> Path:
    out = tmp_path_factory.mktemp("runs")
    greedy = "load=greedy-ci,battery=greedy-ci"
    run(sim, greedy, out / "greedy", optimum)
    assert write_optimum(sim, optimum, out / "greedy" / FOLDER)
    run(sim, "g36", out / "g36")
    run(sim, "battery=lookahead-3h", out / "lookahead")
    reached = [run_beside(optimum, sim, make_controller("g36", sim.fleet), "g36")]
    known = [each for each in reached if each is not None]
    assert write_optimum(sim, optimum, out / "best", reached=known)
    return out


@pytest.fixture(scope="module")
def page(folders: Path) -> Page:
    names = ("greedy", "best", "g36", "lookahead")
    runs = [read_run(folders / name) for name in names]
    with pytest.MonkeyPatch.context() as patch:
        # Other sections take seconds to draw.
        for section in ("fleet_section", "data_center_section", "hot_racks_section"):
            patch.setattr(report, section, lambda *_, **__: [])
        return read_page(
            report.report_html(runs[0], compare_runs(dict(zip(names, runs, strict=True))))
        )


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_score_of_all_steps_is_that_of_the_metrics(sim: Simulator, tmp_path: Path) -> None:
    text = "carbon+0.5*energy+2*cost+0.01*water"
    metrics = run(sim, "g36", tmp_path / "run")["data_centers"]
    sim.reset(0)
    score = Score(Objective.parse(text), sim)
    with Simulator(sim.fleet) as other:
        run_of = make_controller("g36", other.fleet)
        simulate_to_folder(other, run_of, RunRequest("g36", STEPS), tmp_path / "b",
                           on_step=score.add)  # fmt: skip
    for dc, figure in zip(metrics, score.figure, strict=True):
        of = dc["metrics"]
        expected = of["cfp_kg"] + 0.5 * of["grid_kwh"] + 2 * of["cost"] + 0.01 * of["water_l"]
        assert figure == pytest.approx(expected, rel=1e-12)


def test_the_achieved_path_has_share_one_and_idle_commands_zero(
    sim: Simulator, optimum: Optimum
) -> None:
    idle = run_beside(optimum, sim, make_controller("idle", sim.fleet), "idle")
    assert idle is not None
    assert idle.share.tolist() == [0.0, 0.0]
    assert idle.total_share == 0.0
    assert idle.broken == ((), ())
    empty = replace(optimum, bound_of_ends=lambda dc, ends: 0.0)
    best = run_beside(empty, sim, AchievedPath(optimum), "optimum")
    assert best is not None
    assert best.figure.tolist() == optimum.achieved.tolist()
    np.testing.assert_allclose(best.share, 1.0, rtol=1e-12)


def test_ends_are_valued(sim: Simulator, optimum: Optimum) -> None:
    found = run_beside(optimum, sim, make_controller("greedy-ci", sim.fleet), "greedy-ci")
    assert found is not None
    stored, waiting = sim.state.stored_kwh, sim.state.queue[:, -1]
    assert waiting.max() > 1.0
    value = KWH_VALUE * (stored - start_kwh(sim)) - TASK_VALUE * waiting
    np.testing.assert_allclose(found.valued_figure, found.figure - value, rtol=1e-12)


def start_kwh(sim: Simulator) -> Any:
    return sim.reset(0).stored_kwh.copy()


def test_without_a_bound_ends_that_differ_have_no_share(sim: Simulator, optimum: Optimum) -> None:
    without = replace(optimum, bound_of_ends=lambda dc, ends: float("nan"))
    found = run_beside(without, sim, make_controller("load=greedy-ci", sim.fleet), "x")
    assert found is not None
    waits = sim.state.queue[:, -1] > 0.0
    assert waits.any()
    assert np.isnan(found.share).tolist() == waits.tolist()
    assert np.isnan(found.total_share)
    g36 = run_beside(without, sim, make_controller("g36", sim.fleet), "g36")
    assert g36 is not None
    assert np.isfinite(g36.share).all()


def test_constraints_that_break_are_told(sim: Simulator, optimum: Optimum) -> None:
    hot = {**optimum.certificates[0], "hottest_inlet_c": 40.0}
    kept = {**optimum.certificates[1], "hottest_inlet_c": 14.0, "unmet_kwh": -1.0}
    cold = replace(
        optimum,
        inlet_limit_c=np.array([15.0, 15.0]),
        certificates=(hot, kept),
    )
    found = run_beside(cold, sim, make_controller("idle", sim.fleet), "idle")
    assert found is not None
    # At the first data center, no path keeps the limit.
    assert found.broken[0] == ()
    inlet, heat = found.broken[1]
    assert inlet.endswith("over the limit of 15 C")
    assert heat == "leaves 0 kWh of heat in the room"


def test_optima_of_other_inputs_are_refused(sim: Simulator, optimum: Optimum) -> None:
    idle = make_controller("idle", sim.fleet)
    with pytest.raises(SdcError, match="of other configs, inputs, precision, sampled"):
        run_beside(replace(optimum, fingerprint="0" * 64), sim, idle, "idle")
    with pytest.raises(SdcError, match="first day"):
        run_beside(replace(optimum, start=optimum.start + 96), sim, idle, "idle")


def test_optima_of_other_sampled_events_are_refused() -> None:
    outages = "events.sampled=[{kind: grid_outage, per_year: 50, duration_h: [1, 2]}]"
    config = load_config("tiny", [outages])
    with Simulator(config) as sim:
        optimum = made_up_optimum(sim, 4)
        idle = make_controller("idle", sim.fleet)
        assert run_beside(optimum, sim, idle, "idle", seed=0) is not None
        with pytest.raises(SdcError, match="sampled events"):
            run_beside(optimum, sim, idle, "idle", seed=1)


def test_metrics_tell_the_share(folders: Path, optimum: Optimum) -> None:
    metrics = read_run(folders / "greedy").metrics
    assert metrics["optimum"]["objective"] == "carbon"
    assert metrics["optimum"]["agents"] == list(optimum.agents)
    assert metrics["optimum"]["bound_kinds"] == list(optimum.bound_kinds)
    metrics["optimum"]["broken"] = [["drops 3 tasks"], []]
    assert remarks_beside(metrics) == [
        f"{optimum.names[1]}: estimate: made up",
        f"{optimum.names[0]}: this run drops 3 tasks, which the achieved path does not",
    ]
    own = [dc["metrics"] for dc in metrics["data_centers"]]
    total = metrics["total"]
    for name in ("idle_figure", "bound_figure", "achieved_figure", "valued_figure"):
        assert total[name] == pytest.approx(sum(dc[name] for dc in own))
    for dc in (*own, total):
        room = dc["idle_figure"] - dc["achieved_figure"]
        share = (dc["idle_figure"] - dc["valued_figure"]) / room
        assert dc["achievable_share"] == pytest.approx(share)
    assert "optimum" not in read_run(folders / "g36").metrics


def test_the_achieved_path_is_a_run_as_any_other(folders: Path, optimum: Optimum) -> None:
    best = read_run(folders / "best")
    assert best.metrics["controller"] == "optimum"
    cfp = [dc["metrics"]["cfp_kg"] for dc in best.metrics["data_centers"]]
    np.testing.assert_allclose(cfp, optimum.achieved, rtol=1e-12)
    steps = pd.read_parquet(best.steps_path)
    commands = steps["battery_command"].to_numpy().reshape(STEPS, 2)
    assert commands.tolist() == optimum.battery.tolist()
    content = json.loads((folders / "best" / "optimum.json").read_text())
    assert [dc["name"] for dc in content["data_centers"]] == list(optimum.names)
    assert content["total"]["achieved"] == pytest.approx(optimum.achieved.sum())
    assert [each["controller"] for each in content["controllers"]] == ["g36"]
    inside = find_optimum(folders / "greedy", optimum.fingerprint, STEPS)
    assert inside is not None
    assert inside[0] == folders / "greedy" / FOLDER
    assert find_optimum(folders / "greedy", "0" * 64, STEPS) is None


def test_controllers_that_beat_the_achieved_path_are_named(optimum: Optimum) -> None:
    two = np.zeros(2)
    shares = np.array([1.01, 1.01])
    reached = Achievement("better", two, two, shares, 1.01, ((), ("drops 3 tasks",)))
    told = [line for line in optimum_remarks(optimum_content(optimum, [reached])) if "more" in line]
    assert told == [
        f"{optimum.names[0]}: better reaches 101.00 % of the achievable, more than the achieved "
        "path: the best is between it and the bound"
    ]


def test_report_shows_the_optimum_beside_the_run(
    page: Page, folders: Path, optimum: Optimum
) -> None:
    assert page.problems == []
    assert "Known optimum" in page.text
    assert f"{optimum.names[1]}: estimate: made up" in page.text
    assert f"{optimum.names[1]}: does not hold: facility energy off by 1e-3" in page.text
    total = read_run(folders / "greedy").metrics["total"]
    (table,) = [t for t in page.tables if t[0][:3] == ["data center", "idle", "bound"]]
    assert table[0][-2:] == ["this run, ends valued", "share (%)"]
    assert table[-1][0] == "all"
    share = float(table[-1][-1].replace(",", ""))
    assert share == pytest.approx(100 * total["achievable_share"], rel=1e-3)
    alts = [str(image["alt"]) for image in page.all("img")]
    assert len([a for a in alts if a.startswith("Grid, utilisation, setpoint")]) == len(SITES)


def test_report_of_the_achieved_path_lists_the_controllers(folders: Path) -> None:
    best = read_run(folders / "best")
    known = known_optimum([best])
    assert known is not None
    assert known.run is best
    (table,) = read_blocks(optimum_section(best, known, [])).tables
    assert table[0][-1] == "g36, share (%)"


def test_comparison_tells_shares_where_files_tell_them(page: Page, folders: Path) -> None:
    (row,) = page.rows("share of the achievable")
    total = read_run(folders / "greedy").metrics["total"]
    best = json.loads((folders / "best" / "optimum.json").read_text())
    g36 = best["controllers"][0]["share"]
    # The battery of the last run has been used, and its charge at the end is not in metrics.json.
    shares = [total["achievable_share"], 1.0, g36]
    assert row[1:] == ["%", *(f"{100 * share:z.1f}" for share in shares), "–"]
    assert known_optimum([read_run(folders / name) for name in ("g36", "lookahead")]) is None


@pytest.mark.parametrize("text", ["{", "[]", '{"format": "sdc-optimum/0"}',
                                  '{"format": "sdc-optimum/1", "fingerprint": 3}'])  # fmt: skip
def test_damaged_optimum_is_one_line(
    sim: Simulator, optimum: Optimum, tmp_path: Path, text: str
) -> None:
    run(sim, "idle", tmp_path / "run")
    (tmp_path / "run" / "optimum.json").write_text(text)
    done = call("report", tmp_path / "run")
    assert done.exit_code == 2
    assert "optimum.json" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_later_run_into_the_folder_takes_the_optimum_away(
    sim: Simulator, optimum: Optimum, tmp_path: Path
) -> None:
    assert write_optimum(sim, optimum, tmp_path / "run")
    run(sim, "idle", tmp_path / "run")
    assert not (tmp_path / "run" / "optimum.json").exists()


def test_an_interrupted_run_has_no_share(sim: Simulator, optimum: Optimum, tmp_path: Path) -> None:
    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > 10

    driver = make_controller("idle", sim.fleet)
    request = RunRequest("idle", STEPS)
    written = simulate_to_folder(sim, driver, request, tmp_path / "run", optimum=optimum, stop=stop)
    assert written is not None
    assert "optimum" not in written
    asked = 0
    assert not write_optimum(sim, optimum, tmp_path / "best", stop=stop)
    assert not (tmp_path / "best" / "optimum.json").exists()
