"""The report of a run: it says what the files hold, and needs nothing beside itself."""

from __future__ import annotations

import functools
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from report_reader import Page, pictures, read_blocks, read_page
from sdc_taichi import (
    DataCenterConfig,
    SdcError,
    Simulator,
    StepResult,
    load_config,
    make_configs,
)
from sdc_taichi.cli.app import app
from sdc_taichi.control import make_controller
from sdc_taichi.hall.air_metrics import TIE_K
from sdc_taichi.run import comparison, folder_reader
from sdc_taichi.run.description import RunRequest
from sdc_taichi.run.folder_reader import read_racks, read_run, read_steps
from sdc_taichi.run.folder_writer import simulate_to_folder
from sdc_taichi.run.steps_file import AIR_KEY, METADATA_KEY, RACKS_KEY
from sdc_taichi.viz import (
    report,
    report_html,
    report_metrics,
    report_pictures,
)
from sdc_taichi.viz.plotting import format_number, with_local_time

NASTY = '<script>alert("1")</script> & $x_{$\n</style>東'
STEPS = 2 * 96
HALL = ("name=hall", "site.start=07-01")


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


def simulate(
    out: Path,
    configs: list[DataCenterConfig],
    steps: int,
    controller: str = "idle",
    done: int | None = None,
) -> dict[str, Any]:
    """Record a run that is stopped after ``done`` steps."""
    count = 0

    def stop() -> bool:
        nonlocal count
        count += 1
        return done is not None and count > done

    with Simulator(configs) as sim:
        driver = make_controller(controller, sim.fleet)
        written = simulate_to_folder(sim, driver, RunRequest(controller, steps), out, stop=stop)
    assert written is not None
    return written


def two_halls() -> list[DataCenterConfig]:
    """Two sites, one with a name that is HTML and a heat wave at the end of February."""
    heat = "events.scheduled=[{kind: heat_wave, start_h: 12, duration_h: 3, offset_k: 8}]"
    ny, ca = make_configs(load_config("tiny", ["site.start=02-28"]), sites=["NY", "CA"])
    hot = load_config("tiny", ["site.start=02-28", heat])
    ca = ca.model_copy(update={"name": NASTY, "events": hot.events, "description": NASTY})
    return [ny, ca]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs")
    simulate(out / "greedy", two_halls(), STEPS, "load=greedy-ci,battery=greedy-ci")
    simulate(out / "idle", two_halls(), STEPS)
    return out


@pytest.fixture(scope="module")
def html(folder: Path) -> str:
    done = call(folder / "greedy", folder / "idle")
    assert done.exit_code == 0, done.output
    assert done.stdout == f"Report: {folder / 'greedy' / 'report.html'}\n"
    return (folder / "greedy" / "report.html").read_text("utf-8")


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return read_page(html)


def test_page_is_whole_and_needs_nothing_else(html: str, page: Page) -> None:
    assert page.problems == []
    assert html.startswith("<!DOCTYPE html>\n")
    assert page.all("html") == [{"lang": "en"}]
    ids = [str(a["id"]) for _, a in page.elements if "id" in a]
    assert [str(a["href"])[1:] for a in page.all("a")] == ids
    assert all(len(str(image["alt"])) > 40 for image in page.all("img"))
    assert not page.all("script") + page.all("link") + page.all("iframe")
    assert not any(name.startswith("on") for _, attributes in page.elements for name in attributes)
    assert not re.search(r"https?:|@import|url\(", html)
    assert not re.search(
        r"""\b(src|srcset|href|data|action)\s*=\s*(?!"data:image/webp;base64,|"#)""", html
    )
    (policy,) = [m for m in page.all("meta") if m.get("http-equiv")]
    assert policy["content"] == "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def test_pictures_are_in_the_page(page: Page) -> None:
    # Bars, rack maps of each data center, two of the fleet, two of each data center, four inputs.
    images = pictures(page)
    assert len(images) == 1 + 2 + 2 + 2 * 2 + 4
    for image in images:
        assert len(image.convert("RGB").getcolors(1 << 20)) > 30


def test_names_are_text(html: str, page: Page) -> None:
    line = " ".join(NASTY.split())
    assert f"Data center {line}" in page.text
    assert f"ny, {line}: idle against greedy" in page.text
    assert f"Data center {line} of greedy" in page.text
    assert "<script" not in html
    assert html.count("</style>") == 1


def test_tables_hold_the_metrics(folder: Path, page: Page) -> None:
    about = json.loads((folder / "greedy" / "metrics.json").read_text("utf-8"))
    columns = [dc["metrics"] for dc in about["data_centers"]] + [about["total"]]
    for _, group in report_metrics.METRICS:
        for key, label, unit in group:
            expected = [report_html.metric_text(column, key) for column in columns]
            if key == "pue_with_losses" and all(c[key] == c["pue"] for c in columns):
                assert not page.rows(label)
                continue
            assert [label, unit, *expected] in page.rows(label), key
    assert ["metric", "unit", "ny", NASTY, "all"] in page.rows("metric")


def test_every_metric_is_in_the_tables(folder: Path) -> None:
    about = json.loads((folder / "greedy" / "metrics.json").read_text("utf-8"))
    listed = [key for _, group in report_metrics.METRICS for key, *_ in group]
    assert len(set(listed)) == len(listed)
    # Said elsewhere: where the hottest inlet was; the same as what the battery delivered.
    others = {"hottest_dc", "hottest_row", "hottest_rack", "hottest_server", "hottest_step"}
    others |= {"battery_throughput_kwh"}
    assert set(about["total"]) == set(listed) | others


def test_summary_says_what_ran(folder: Path, page: Page) -> None:
    about = json.loads((folder / "greedy" / "metrics.json").read_text("utf-8"))
    assert "2 data centers, 2 days from 28 February 00:00 to 2 March 00:00" in page.text
    (row,) = page.rows("fingerprint of configs, inputs and precision")
    assert row[1] == about["fingerprint"]
    assert page.rows("controller")[-1] == ["controller", "load=greedy-ci,battery=greedy-ci"]
    assert "taichi" in page.rows("versions")[0][1]
    assert "Inputs are SYNTHETIC" in page.text
    for kind in ("weather", "carbon", "workload"):
        rows = [row for row in page.rows(kind) if "a year" not in row[1] + row[2]]
        assert rows
        for row in rows:
            assert "synthetic year, seed 10" in row[1]
            assert row[2] == "–"
    total = about["total"]
    hot = pd.read_parquet(
        folder / "greedy" / "steps.parquet", columns=["time", "utc_offset_h", "inlet_max_c"]
    )
    hottest_row = int(hot["inlet_max_c"].to_numpy().argmax())
    when = with_local_time(hot)["time"].iloc[hottest_row]
    dc = total["hottest_dc"]
    racks = next(c for c in two_halls() if c.name == dc).hall.racks_per_row
    rack = total["hottest_rack"]
    assert (
        f"The hottest inlet was {total['hottest_inlet_c']:.4g} °C in {' '.join(dc.split())}, "
        f"row {rack // racks}, rack {rack}, server {total['hottest_server']} from the floor, on "
        f"{when.day} {when:%B %H:%M}."
    ) in page.text


def test_equal_inputs_share_a_line(page: Page) -> None:
    work, weather = (
        next(str(i["alt"]) for i in page.all("img") if str(i["alt"]).startswith(what))
        for what in ("Arriving work", "Outdoor temperature")
    )
    assert re.search(rf"Means: ny, {re.escape(NASTY)} [\d.]+\.", work)
    assert re.search(rf"Means: ny [-\d.]+, {re.escape(NASTY)} [-\d.]+\.", weather)


def many_events(run: folder_reader.RunFolder) -> folder_reader.RunFolder:
    about = json.loads(json.dumps(run.metrics))
    first, second = about["data_centers"]
    first["events"] = [
        {"kind": "crac_down", "target": 1, "start_step": 4 * i, "end_step": 4 * i + 2}
        for i in range(30, 0, -1)
    ]
    second["events"] += [{"kind": "grid_outage", "start_step": i, "end_step": i + 4}
                         for i in range(20)]  # fmt: skip
    return folder_reader.RunFolder(run.path, about)


def test_of_many_events_the_first_are_listed(folder: Path) -> None:
    page = read_blocks(report.events_section(many_events(read_run(folder / "greedy"))))
    ((_, first, *others),) = page.tables
    assert first == ["ny", "crac down", "1", "", "1 March 06:00", "0.5", "120 to 121"]
    assert len(others) == report_html.MAX_ROWS - 1
    assert "51 events that the run met, the first 40; all are in metrics.json" in page.text


def test_events_are_listed(page: Page) -> None:
    (row,) = page.rows(NASTY)
    assert row[1:] == ["heat wave", "", "+8 K", "28 February 12:00", "3", "48 to 59"]
    assert "1 event that the run met" in page.text


def test_runs_are_compared(folder: Path, page: Page) -> None:
    ours, theirs = (
        json.loads((folder / name / "metrics.json").read_text("utf-8"))["total"]
        for name in ("greedy", "idle")
    )
    change = 100 * (theirs["cfp_kg"] / ours["cfp_kg"] - 1)
    a_year = 8760 / 48 / 1000
    saving, row = page.rows("carbon")[:2]
    assert row[:3] == ["carbon", "t CO₂e a year", format_number(ours["cfp_kg"] * a_year)]
    assert row[3] == f"{format_number(theirs['cfp_kg'] * a_year)} ({change:+.1f} %)"
    saved = (ours["cfp_kg"] - theirs["cfp_kg"]) * a_year
    assert saving[2] == f"{format_number(saved)} ({-change:z.1f} %)"
    assert page.rows("controller")[0][1:] == ["load=greedy-ci,battery=greedy-ci", "idle"]
    assert "The runs cover 2 days. Figures a year are those of the runs times 182.5" in page.text
    assert "Money is at the example prices" in page.text
    assert not page.rows("simple payback")


def comparison_of(*words: object, **options: Any) -> comparison.Comparison:
    return comparison.compare_runs(comparison.named_runs([*map(str, words)]), **options)


@pytest.fixture(scope="module")
def variants(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hall as it is, with warmer air, and with warmer air at other prices."""
    out = tmp_path_factory.mktemp("variants")
    warmer = ["hvac.setpoint.initial_c=22", *HALL]
    simulate(out / "today", [load_config("corrected", [*HALL])], 30)
    simulate(out / "warmer", [load_config("corrected", warmer)], 30)
    free = [*warmer, "tariff.price_per_kwh=0", "tariff.demand_charge_per_kw=0"]
    simulate(out / "free", [load_config("corrected", free)], 30)
    turned = ["hall.rows=5", "hall.racks_per_row=4", *HALL]
    simulate(out / "other", [load_config("corrected", turned)], 30)
    return out


def test_comparison_says_what_differs_and_when_it_pays(variants: Path) -> None:
    found = comparison_of(
        f"as is={variants / 'today'}", variants / "warmer", costs={"warmer": 1000.0}
    )
    assert found.names == ["as is", "warmer"]
    (difference,) = found.differences
    assert difference.name == "hvac.setpoint.initial_c"
    assert difference.meaning == "Setpoint after a reset, in C"
    assert difference.values == ("18.0", "22.0")
    today, warmer = (run.metrics["total"] for run in found.runs.values())
    of = {figure.key: figure for figure in found.figures}
    years = 30 * 0.25 / 8760
    for key, factor in (("grid_kwh", 1e-3), ("cost", 1.0), ("water_l", 1e-3)):
        expected = [factor * total[key] / years for total in (today, warmer)]
        assert of[key].values == pytest.approx(expected)
    assert of["hottest_inlet_c"].values == (today["hottest_inlet_c"], warmer["hottest_inlet_c"])
    saved = of["cost"].savings()[1]
    assert saved is not None
    assert saved > 0
    assert found.payback_years() == {"warmer": pytest.approx(1000.0 / saved)}
    back = comparison_of(variants / "warmer", variants / "today", costs={"today": 1.0})
    assert back.payback_years() == {"today": None}


def test_names_of_runs_are_those_of_the_user(variants: Path, tmp_path: Path) -> None:
    shutil.copytree(variants / "warmer", tmp_path / "a" / "run")
    shutil.copytree(variants / "today", tmp_path / "b=c" / "run")
    words = [tmp_path / "a" / "run", tmp_path / "b=c" / "run", f"x y={variants / 'today'}"]
    assert comparison_of(*words).names == ["a/run", "b=c/run", "x y"]


def test_redundancy_is_found_where_asked(variants: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    losses = [(), (0,), (1,), (0, 1)]
    minutes = {"today": [np.nan, np.nan, 7.0, 2.0], "warmer": [np.nan] * 4}
    studied = iter(minutes.values())

    def study(_: DataCenterConfig) -> Any:
        cases = [SimpleNamespace(units=units) for units in losses]
        return SimpleNamespace(losses=cases, throttle_min=np.array(next(studied)))

    monkeypatch.setattr(comparison, "study_failover", study)
    found = comparison_of(variants / "today", variants / "warmer", failover=True)
    texts = [each.text() for each in found.redundancy.values()]
    assert texts == ["0 (throttles 7 min after one more)", "2 or more"]


def test_compare_prints_tables_and_json(variants: Path) -> None:
    words = ["compare", str(variants / "today"), str(variants / "warmer"), "--cost", "warmer=1000"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    for text in ("hvac.setpoint.initial_c", "electricity bill", "simple payback", "MWh a year"):
        assert text in done.stdout
    done = CliRunner().invoke(app, [*words, "--json"])
    values = json.loads(done.stdout)
    assert values["reference"] == "today"
    assert values["payback_years"]["warmer"] > 0
    assert values["differences"][0]["values"] == {"today": "18.0", "warmer": "22.0"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["today"], "1 run to compare; valid are 2 to 12"),
        (["today", "other"], "hall has 5 x 4 racks, hall of .*today 4 x 5; runs to compare must"),
        (["today", "free", "--cost", "free=1"], "the run 'free' has no prices"),
        (["today", "warmer", "--cost", "wamer=1"], "'wamer' is no run; valid are 'warmer'; did"),
        (["today", "warmer", "--cost", "today=1"], "'today' is the run that the others"),
        (["today", "warmer", "--cost", "warmer=x"], "'x'; valid is an amount"),
        (["today", "warmer", "--cost", "warmer=1", "--cost", "warmer=2"], "a second cost"),
        (["x=today", "x=warmer"], "a second run 'x'"),
        (["today", "today"], "is given twice"),
    ],
)
def test_runs_that_cannot_be_compared(
    variants: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
) -> None:
    monkeypatch.chdir(variants)
    for command in ("compare", "report"):
        if command == "report" and words == ["today"]:
            continue
        done = CliRunner().invoke(app, [command, *words])
        assert done.exit_code == 2, done.output
        assert re.search(message, done.stderr), done.stderr
        assert done.stderr.count("\n") == 1
        assert not list(variants.glob("*/report.html"))


def test_report_of_variants_is_about_the_hall(variants: Path) -> None:
    found = comparison_of(variants / "today", variants / "warmer")
    html = report.report_html(found.runs["today"], found)
    assert len(html) < 1_500_000
    page = read_page(html)
    assert page.problems == []
    assert page.texts[page.texts.index("hall: warmer against today")]
    assert "idle" not in page.text.partition("Provenance")[0].replace("controller idle", "")
    assert "tasks" not in page.text.rpartition("Inputs")[0].partition("Inputs")[0]
    assert any("Bars of energy" in str(image["alt"]) for image in page.all("img"))
    assert not any("Radar" in str(image["alt"]) for image in page.all("img"))


def test_reports_of_large_halls_are_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    simulate(tmp_path, [load_config("hall_of_2026", ["site.start=07-01"])], 30, "g36")
    run = read_run(tmp_path)
    html = report.report_html(run)
    assert 100_000 < len(html.encode()) < 1_500_000
    most = int(0.85 * len(html.encode()))
    monkeypatch.setattr(report_html, "MAX_BYTES", most)
    smaller = report.report_html(run)
    assert len(smaller.encode()) <= most
    before, after = (pictures(read_page(each)) for each in (html, smaller))
    assert [image.size for image in after] == [image.size for image in before]


def test_runs_of_other_length_are_refused(folder: Path, tmp_path: Path) -> None:
    simulate(tmp_path / "short", two_halls(), STEPS, done=50)
    done = call(folder / "greedy", tmp_path / "short", "--out", tmp_path / "x.html")
    assert done.exit_code == 2
    assert "short: 12.5 h" in done.stderr
    assert "must be of equal length" in done.stderr
    assert not (tmp_path / "x.html").exists()


def test_interrupted_run_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_pictures, "_data_center_pictures", lambda *_: [])
    simulate(tmp_path / "cut", [load_config("tiny")], 960, done=30)
    (tmp_path / "cut" / "report.html").write_text("older")
    done = call(tmp_path / "cut")
    assert done.exit_code == 0, done.output
    assert done.stderr == f"note: {tmp_path / 'cut'}: interrupted after 30 of 960 steps\n"
    html = (tmp_path / "cut" / "report.html").read_text("utf-8")
    assert "The run was interrupted: 30 of 960 steps" in read_page(html).text
    assert sorted(p.name for p in (tmp_path / "cut").iterdir()) == [
        "config.yaml", "metrics.json", "report.html", "steps.parquet",
    ]  # fmt: skip


def test_equal_runs_give_equal_bytes(folder: Path, html: str) -> None:
    run = read_run(folder / "greedy")
    for text in (
        report.summary_section(run),
        report_metrics.metrics_section(run),
        report_pictures.fleet_section(run),
    ):
        assert report_html.html_blocks(text) in html


def test_alike_racks_are_equally_long_the_hottest(tmp_path: Path) -> None:
    alike = load_config("corrected", ["hall.recirculation.calibrate=rack"])
    with Simulator(make_configs(alike, sites=["NY", "CA"])) as sim:
        names = ("rack_inlet_max_c", "inlet_max_c", "hottest_rack")
        seen: dict[str, list[Any]] = {name: [] for name in names}

        def keep(result: StepResult) -> None:
            for name, values in seen.items():
                values.append(np.array(getattr(result, name)))

        driver = make_controller("random", sim.fleet)
        request = RunRequest("random", 40)
        simulate_to_folder(sim, driver, request, tmp_path / "run", on_step=keep)
        first = sim.fleet.rack_offsets
    inlet_c, highest_c = (np.array(seen[name]) for name in names[:2])
    for dc, racks in enumerate(read_racks(read_run(tmp_path / "run"), [0, 1])):
        own_c = inlet_c[:, first[dc] : first[dc + 1]]
        hottest = own_c >= highest_c[:, [dc]] - TIE_K
        np.testing.assert_array_equal(racks["hottest_h"], 0.25 * hottest.sum(axis=0))
        np.testing.assert_allclose(racks["inlet_max_c"], own_c.max(axis=0), atol=6e-4)
        np.testing.assert_array_equal(racks["above_27_h"], 0.25 * (own_c > 27.0).sum(axis=0))
        assert 0.0 < racks["above_27_h"].max() < 10.0
        assert np.count_nonzero(racks["hottest_h"] == racks["hottest_h"].max()) > 1
        by_one = np.bincount([int(step[dc]) for step in seen["hottest_rack"]], minlength=len(racks))
        assert np.all(racks["hottest_h"] >= 0.25 * by_one)


def test_one_step_has_tables_alone(tmp_path: Path) -> None:
    simulate(tmp_path / "run", [load_config("tiny")], 1)
    page = read_page(report.report_html(read_run(tmp_path / "run")))
    assert page.problems == []
    assert "A single step has no pictures." in page.text
    assert not page.all("img")


def test_files_are_named_with_their_hashes(folder: Path) -> None:
    run = read_run(folder / "idle")
    digest = "ab" * 32
    run.metrics["synthetic"] = False
    for dc in run.metrics["data_centers"]:
        dc["provenance"]["weather"] = "LGA.epw"
        dc["sha256"] = {"weather": digest, "recirculation": digest}
    page = read_blocks(report.provenance_section(run))
    assert page.rows("weather") == [["weather", "LGA.epw", digest, f"ny, {NASTY}"]]
    assert page.rows("recirculation")[0][2] == digest
    assert report.input_notes(run) == []


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fleet") / "run"
    rules = {
        "hvac.chiller.reference_cop": {"uniform": [4.0, 6.5]},
        "hvac.setpoint.initial_c": {"choice": [18.0, 20.0, 22.0]},
    }
    configs = make_configs(load_config("tiny"), count=60, sites=["NY", "CA", "WA"], sample=rules)
    simulate(out, configs, 24)
    return out


def test_large_fleet_shows_extremes(fleet: Path) -> None:
    run = read_run(fleet)
    page = read_blocks(report_metrics.metrics_section(run))
    by_pue = sorted(run.metrics["data_centers"], key=lambda dc: dc["metrics"]["pue"])
    worst, best = by_pue[-1], by_pue[0]
    (row,) = page.rows("PUE")
    number = format_number
    mean = np.mean([dc["metrics"]["pue"] for dc in by_pue])
    assert row[2:] == [
        f"{number(best['metrics']['pue'])} {best['name']}",
        number(float(mean)),
        f"{number(worst['metrics']['pue'])} {worst['name']}",
        number(run.metrics["total"]["pue"]),
    ]
    (first, _) = page.rows("1")
    assert first[2] == f"{worst['name']}:\u00a0{number(worst['metrics']['pue'])}"
    assert first[5] == "all 0", "nothing was dropped, so nobody is ranked"


def test_large_fleet_has_few_pictures(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = read_run(fleet)
    drawn = []

    def draw(_: object, dc: Any, *__: object) -> list[report_html.Block]:
        drawn.append(dc.index)
        return []

    monkeypatch.setattr(report_pictures, "_data_center_pictures", draw)
    html = report.report_html(run)
    page = read_page(html)
    assert page.problems == []
    assert "60 data centers" in page.text
    sections = re.findall(r"Data center ([a-z0-9-]+)</h2>", html)
    assert sections == [run.names[index] for index in drawn]
    assert 2 <= len(sections) <= report_pictures.MAX_SHOWN_DCS
    worst = max(run.metrics["data_centers"], key=lambda dc: dc["metrics"]["pue"])
    assert worst["name"] in sections
    assert re.search(r"Shown because it has the [^.]*highest PUE[^.]* of 60\.", page.text)
    assert "The 40 hottest of 60 are shown." in page.text


def test_fleet_sums_and_maxima(fleet: Path) -> None:
    run = read_run(fleet)
    found = folder_reader.read_fleet_steps(run)
    steps = pd.read_parquet(fleet / "steps.parquet")
    by_step = steps.groupby("step")
    for name in ("it_w", "overhead_w", "carbon_g"):
        np.testing.assert_allclose(found.series[name], by_step[name].sum())
    np.testing.assert_array_equal(found.series["inlet_max_c"], by_step["inlet_max_c"].max())
    np.testing.assert_allclose(found.series["inlet_high_c"], by_step["inlet_max_c"].quantile(0.9))
    inlets = steps["inlet_max_c"].to_numpy().reshape(24, 60)
    np.testing.assert_array_equal(found.inlet_max_c, inlets)


def test_rows_are_read_across_row_groups(fleet: Path, tmp_path: Path) -> None:
    """Several row groups, and intervals that cross them."""
    copy = copied(fleet.parent, tmp_path, fleet.name)
    table = pq.read_table(fleet / "steps.parquet")
    pq.write_table(table, copy / "steps.parquet", row_group_size=60 * 5)
    assert pq.ParquetFile(copy / "steps.parquet").num_row_groups == 5
    run = read_run(copy)
    one, other = read_steps(run, [3, 59], ["soc", "inlet_max_c"])
    steps = table.to_pandas()
    for found, dc in ((one, 3), (other, 59)):
        expected = steps[steps["dc"] == run.names[dc]].reset_index(drop=True)
        for column in ("step", "time", "soc", "inlet_max_c"):
            assert (found[column] == expected[column]).all()


def test_long_runs_are_shown_in_intervals(tmp_path: Path) -> None:
    simulate(tmp_path / "run", two_halls(), 900)
    found = folder_reader.read_fleet_steps(read_run(tmp_path / "run"))
    inlets = pd.read_parquet(tmp_path / "run" / "steps.parquet")["inlet_max_c"].to_numpy()
    # 900 steps of a quarter of an hour in at most 400 intervals: an hour each.
    expected = np.reshape(inlets, (225, 4, 2)).max(axis=1)
    np.testing.assert_array_equal(found.inlet_max_c, expected)
    assert found.edge_times[1] - found.edge_times[0] == np.timedelta64(1, "h")
    assert found.edge_times[-1] == np.datetime64("2018-03-09T09:00"), "the end of the run"


# Bad input


def copied(folder: Path, tmp_path: Path, name: str = "idle") -> Path:
    return Path(shutil.copytree(folder / name, tmp_path / "copy"))


def edit_metrics(folder: Path, place: str, value: object) -> None:
    """Write a value into metrics.json at a path of keys and indices; ... removes the key."""
    path = folder / "metrics.json"
    about = json.loads(path.read_text("utf-8"))
    *keys, last = [int(key) if key.isdigit() else key for key in place.split(".")]
    at = functools.reduce(lambda part, key: part[key], keys, about)
    if value is ...:
        del at[last]
    else:
        at[last] = value
    path.write_text(json.dumps(about), "utf-8")


def edit_steps(folder: Path, change: Callable[[Any], Any]) -> None:
    path = folder / "steps.parquet"
    table = pq.read_table(path)
    changed = change(table)
    stored = pq.read_metadata(path).metadata
    kept = {key: stored[key] for key in (METADATA_KEY, RACKS_KEY, AIR_KEY)} | dict(
        changed.schema.metadata
    )
    pq.write_table(changed.replace_schema_metadata(kept), path)


def edit_air(folder: Path, **values: object) -> None:
    """Write other values of the air of the first data center into the file's metadata."""
    air = json.loads(pq.read_metadata(folder / "steps.parquet").metadata[AIR_KEY])
    air[0].update(values)
    edit_stored(folder, AIR_KEY, air)


def edit_stored(folder: Path, key: bytes, content: object) -> None:
    """Write other content under a key of the file's metadata."""
    stored = {key: json.dumps(content).encode()}
    edit_steps(folder, lambda t: t.replace_schema_metadata({**t.schema.metadata, **stored}))


def rack_values(**values: object) -> dict[str, object]:
    """Statistics of a hall of one rack."""
    return {"hottest_steps": [1], "inlet_max_c": [25.0], "above_27_steps": [0], **values}


def flip(path: Path) -> None:
    """Damage the pages of the columns that are read last, not the footer."""
    data = bytearray(path.read_bytes())
    for at in range(len(data) // 8, len(data) // 2):
        data[at] ^= 0x5A
    path.write_bytes(data)


BAD_METRICS: dict[str, tuple[object, str]] = {
    "format": ("sdc-run/0", r"format 'sdc-run/0'; valid is 'sdc-run/3'"),
    "seed": (..., "seed is missing; valid is of type int"),
    "steps_done": (10_000, "steps_done 10000 of steps_asked 192"),
    "data_centers": ([], "data_centers is empty"),
    "data_centers.1.name": (..., r"data_centers\[1\]\.name is missing"),
    "data_centers.1.events.0.end_step": (..., r".*events\[0\]\.end_step is missing"),
    "data_centers.1.events.0.share": ("x", r".*\.share is 'x'; valid is a number 0\.\.1"),
    "data_centers.1.events.0.offset_k": (1e308, r".*\.offset_k is 1e"),
    "data_centers.1.events.0.start_step": (-9, r".*: steps -9 to 60; valid is a start in 0\.\.191"),
    "total.cfp_kg": (float("nan"), "not valid JSON: NaN is no finite number"),
}
"""Values that metrics.json refuses, by their place, and the error; ... is a missing value."""

BAD_FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no metrics": (lambda f: (f / "metrics.json").unlink(), r"metrics\.json: no such file"),
    "no JSON": (lambda f: (f / "metrics.json").write_text("{"), r"metrics\.json: not valid JSON"),
    "no steps": (lambda f: (f / "steps.parquet").unlink(), r"steps\.parquet: no such file"),
    "empty": (lambda f: (f / "steps.parquet").write_bytes(b""), r"steps\.parquet: cannot be read"),
    "damaged": (
        lambda f: flip(f / "steps.parquet"),
        r"steps\.parquet: cannot be read as row group 0",
    ),
    "not ours": (
        lambda f: pq.write_table(pa.table({"x": [1]}), f / "steps.parquet"),
        r"steps\.parquet: no sdc_taichi metadata",
    ),
    "another run": (
        lambda f: edit_metrics(f, "fingerprint", "0"),
        r"steps\.parquet: fingerprint '[0-9a-f]{64}' is not that of metrics\.json, '0'",
    ),
    "another name": (
        lambda f: edit_metrics(f, "data_centers.0.name", "x"),
        r"steps\.parquet: data_centers\[0\]\.name 'ny' is not that of metrics\.json, 'x'",
    ),
    "fewer rows": (
        lambda f: edit_steps(f, lambda t: t.slice(0, 100)),
        r"steps\.parquet: 100 rows, expected 384",
    ),
    "other order": (
        lambda f: edit_steps(f, lambda t: t.take(np.arange(384).reshape(-1, 2).T.ravel())),
        r"steps\.parquet: row group 0: rows are not in order of step and data center",
    ),
    "no column": (
        lambda f: edit_steps(f, lambda t: t.drop_columns(["inlet_max_c"])),
        r"steps\.parquet: no column inlet_max_c",
    ),
    "racks without numbers": (
        lambda f: edit_stored(f, RACKS_KEY, [{"hottest_steps": ["x"], "inlet_max_c": None}] * 2),
        r"steps\.parquet: sdc_taichi_racks\[0\] is .*; valid are hottest_steps and above_27_st",
    ),
    "longer above 27 C than the run": (
        lambda f: edit_stored(f, RACKS_KEY, [rack_values(above_27_steps=[STEPS + 1])] * 2),
        r"steps\.parquet: sdc_taichi_racks\[0\] is .*; valid are hottest_steps and above_27",
    ),
    "air of fewer data centers": (
        lambda f: edit_stored(f, AIR_KEY, [{}]),
        r"steps\.parquet: no sdc_taichi_air of 2 data centers",
    ),
    "air after the run": (
        lambda f: edit_air(f, step=STEPS),
        rf"steps\.parquet: sdc_taichi_air\[0\]: step {STEPS}; valid is 0\.\.{STEPS - 1}",
    ),
    "air of another hall": (
        lambda f: edit_air(f, mixed_c=[20.0]),
        r"steps\.parquet: sdc_taichi_air\[0\]: mixed_c; valid is a list of \d+ numbers",
    ),
}


def check_refused(folder: Path, message: str) -> None:
    done = call(folder)
    assert done.exit_code == 2, done.output
    assert re.match(rf"error: {re.escape(str(folder))}/{message}", done.stderr), done.stderr
    assert done.stderr.count("\n") == 1
    assert not (folder / "report.html").exists()


@pytest.mark.parametrize("place", BAD_METRICS)
def test_bad_metrics_are_one_line(folder: Path, tmp_path: Path, place: str) -> None:
    copy = copied(folder, tmp_path)
    value, message = BAD_METRICS[place]
    edit_metrics(copy, place, value)
    check_refused(copy, rf"metrics\.json: {message}")


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_are_one_line(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    # Air files are read after these sections, whose pictures take seconds to draw.
    if case.startswith("air"):
        for section in ("fleet_section", "data_center_section"):
            monkeypatch.setattr(report, section, lambda *_, **__: [])
    copy = copied(folder, tmp_path)
    spoil, message = BAD_FILES[case]
    spoil(copy)
    check_refused(copy, message)


def test_folders_that_hold_no_run(folder: Path, tmp_path: Path) -> None:
    for arguments, message in (
        ([tmp_path / "none"], "none: no such folder"),
        ([folder / "idle" / "metrics.json"], "metrics.json: is a file; valid is a folder"),
        ([tmp_path], "metrics.json: no such file"),
        ([folder / "idle", folder / "idle"], "idle: is given twice"),
        ([folder / "idle", "--force"], "--force: valid with --out; DIR/report.html is replaced"),
        ([folder / "idle", "--out", tmp_path / "x.pdf"], r"valid is a name that ends in .html"),
        ([folder / "idle", "--out", tmp_path / "none" / "x.html"], "cannot be written"),
    ):
        done = call(*arguments)
        assert done.exit_code == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_other_file_is_replaced_only_with_force(tmp_path: Path) -> None:
    simulate(tmp_path / "run", [load_config("tiny")], 1)
    out = tmp_path / "x.html"
    out.write_text("older")
    done = call(tmp_path / "run", "--out", out)
    assert done.exit_code == 2
    assert out.read_text() == "older"
    assert call(tmp_path / "run", "--out", out, "--force").exit_code == 0
    assert out.read_text().startswith("<!DOCTYPE html>")
    assert not (tmp_path / "run" / "report.html").exists()


def test_configs_are_read_from_the_steps(folder: Path) -> None:
    run = read_run(folder / "idle")
    first, second = folder_reader.read_configs(run, [0, 1])
    assert [first, second] == two_halls()
    with pytest.raises(SdcError):
        folder_reader.read_configs(folder_reader.RunFolder(folder / "none", run.metrics), [0])
