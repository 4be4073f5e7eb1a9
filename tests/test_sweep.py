"""Sweeps: what is varied, runs that equal those alone, combinations that fail, and best values."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from typer.testing import CliRunner, Result

from sdc_taichi import (
    Simulator,
    load_config,
    make_configs,
    make_controller,
    simulate,
    with_values,
)
from sdc_taichi.benchmark.best_value import best_by_month, with_default
from sdc_taichi.benchmark.executors import Executor
from sdc_taichi.benchmark.jobs import JobResult
from sdc_taichi.benchmark.sweep import (
    Sweep,
    check_sweep,
    combinations,
    metric_names,
    run_part,
    sweep_inputs,
    sweep_jobs,
)
from sdc_taichi.benchmark.vary import Grid, Range, draw, parse_vary
from sdc_taichi.cli.app import app
from sdc_taichi.cli.jobs import JobOptions
from sdc_taichi.errors import SdcError
from sdc_taichi.run.metrics import metrics_per_dc

TINY = load_config("tiny")
SETPOINT = "hvac.setpoint.initial_c"


def varied(*texts: str) -> tuple[Grid | Range, ...]:
    return tuple(parse_vary(text, TINY, 1000) for text in texts)


def results(sweep: Sweep) -> list[JobResult]:
    inputs = sweep_inputs(sweep)
    return [run_part(job.values, inputs) for job in sweep_jobs(sweep, inputs)]


def rows_of(sweep: Sweep) -> pd.DataFrame:
    return pd.concat([result.rows for result in results(sweep)], ignore_index=True)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        (f"{SETPOINT}=16:18:1", (16.0, 17.0, 18.0)),
        (f"{SETPOINT}=16:17:0.1", tuple(round(16 + i / 10, 1) for i in range(11))),
        (f"{SETPOINT}=20,16", (20.0, 16.0)),
        ("site.seed=1:3:1", (1, 2, 3)),
        ("site.location=NY,CA", ("NY", "CA")),
        ("hvac.plant=null,air_side", (None, "air_side")),
        ("hvac.setpoint.schedule_c=[16, 18],[20, 22]", ([16, 18], [20, 22])),
    ],
)
def test_texts_give_values(text: str, values: tuple[Any, ...]) -> None:
    assert parse_vary(text, TINY, 1000) == Grid(text.partition("=")[0].strip(), values)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SETPOINT, "valid is FIELD=A,B,C"),
        ("site=NY", "valid is a field of a section"),
        (f"{SETPOINT}=16:20:0", "step 0"),
        (f"{SETPOINT}=20:16:1", "no values"),
        (f"{SETPOINT}=16:20:1e-9", "4,000,000,001 values; valid are at most 1,000"),
        (f"{SETPOINT}=20..16", "the range is empty"),
        ("site.seed=1..2.5", "valid are whole LOW and HIGH"),
        (f"{SETPOINT}=16,16", "16 is given twice"),
        (f"{SETPOINT}=16,.nan", "no list of YAML values"),
    ],
)
def test_texts_that_are_not_valid_are_told(text: str, said: str) -> None:
    with pytest.raises(SdcError, match=f"^vary '{text[:20]}.*{said}"):
        parse_vary(text, TINY, 1000)


def test_combinations_are_those_of_grids_with_samples_in_the_order_of_the_fields() -> None:
    fields = varied(f"{SETPOINT}=16..20", "site.location=NY,CA", "site.seed=1..3")
    drawn = list(combinations(Sweep(TINY, fields, samples=3, seed=4)))
    assert len(drawn) == 6
    assert [site for _, site, _ in drawn] == ["NY", "CA"] * 3
    assert [each[0] for each in drawn[::2]] == [each[0] for each in drawn[1::2]]
    assert all(16 <= setpoint < 20 and seed in (1, 2, 3) for setpoint, _, seed in drawn)


def test_samples_cover_a_range_and_more_of_them_begin_with_the_same() -> None:
    ranges = [Range("site.seed", 1, 4, True), Range(SETPOINT, 16.0, 20.0, False)]
    few, many = list(draw(ranges, 8, 5)), list(draw(ranges, 64, 5))
    assert many[:8] == few != list(draw(ranges, 8, 6))
    counts = np.bincount([whole for whole, _ in many], minlength=5)
    assert counts.tolist() == [0, 16, 16, 16, 16]
    assert np.histogram([x for _, x in many], 16, (16, 20))[0].tolist() == [4] * 16


@pytest.mark.parametrize(
    ("texts", "options", "said"),
    [
        (["hvac.setpoint.initial=16,17"], {}, "unknown key; did you mean 'initial_c'"),
        ([f"{SETPOINT}=cold,warm"], {}, "should be a valid number"),
        ([f"{SETPOINT}=16..20"], {}, "is a range; valid is a number of samples .--sample"),
        ([f"{SETPOINT}=16,18"], {"samples": 4}, r"valid is FIELD=LOW\.\.HIGH"),
        ([f"{SETPOINT}=16,18", f"{SETPOINT}=20,22"], {}, "is given twice"),
        ([f"{SETPOINT}=16:23:0.1"], {"months": (1, 7)}, "142 runs .71 combinations"),
        ([f"{SETPOINT}=16,18"], {"days": 0.001}, "makes whole steps"),
        ([f"{SETPOINT}=16,18"], {"controllers": ("idel",)}, "did you mean 'idle'"),
        ([f"{SETPOINT}=16,18"], {"controllers": ("idle", "idle")}, "given twice"),
    ],
)
def test_sweeps_that_cannot_begin_are_refused(
    texts: Sequence[str], options: dict[str, Any], said: str
) -> None:
    with pytest.raises(SdcError, match=said):
        check_sweep(Sweep(TINY, varied(*texts), **options), most_runs=100)


def test_a_weather_file_is_not_read_for_several_sites() -> None:
    config = with_values(TINY, {"site.weather_file": "x.epw"})
    with pytest.raises(SdcError, match="would be read for each location"):
        check_sweep(Sweep(config, varied("site.location=NY,CA")))


def test_a_run_equals_that_of_its_data_center_alone_in_any_batch() -> None:
    horizon = "workload.age_horizon_h"  # the same in all data centers of a fleet
    fields = varied(f"{SETPOINT}=18,20", f"{horizon}=24,48", "site.location=CA,NY")
    options: dict[str, Any] = {"months": (7,), "days": 0.5, "controllers": ("random",), "seed": 3}
    rows = rows_of(Sweep(TINY, fields, **options))
    pd.testing.assert_frame_equal(rows, rows_of(Sweep(TINY, fields, batch=3, **options)))
    assert rows[SETPOINT].tolist() == [18.0] * 4 + [20.0] * 4
    last = rows.iloc[-1]
    config = with_values(
        TINY,
        {field: last[field] for field in (SETPOINT, horizon, "site.location")}
        | {"site.start": "07-01"},
    )
    with Simulator(config) as sim:
        totals = simulate(sim, make_controller("random", sim.fleet), 48, 3)
        alone = metrics_per_dc(totals, sim.fleet)[0]
    assert {name: last[name] for name in ("cfp_kg", "grid_kwh", "water_l")} == {
        name: alone[name] for name in ("cfp_kg", "grid_kwh", "water_l")
    }
    assert set(metric_names(TINY)) == set(alone) == set(rows.columns[4:])


def test_combinations_that_fail_are_named_and_the_others_run() -> None:
    fields = varied(f"{SETPOINT}=18,40", "site.location=NY,nowhere,CA")
    (result,) = results(Sweep(TINY, fields, days=0.25))
    assert result.rows is not None
    assert result.rows["site"].tolist() == ["NY", "CA"]
    failed = {each["combination"]: each["error"] for each in result.metrics["failed"]}
    assert len(failed) == 4
    assert "initial_c 40 must lie within" in failed[f"{SETPOINT}=40.0, site.location=NY"]
    assert "site 'nowhere'" in failed[f"{SETPOINT}=18.0, site.location=nowhere"]


def test_files_travel_with_the_jobs_and_keep_their_names(tmp_path: Path) -> None:
    good, bad = tmp_path / "load.csv", tmp_path / "words.csv"
    good.write_text("cpu_load\n" + "\n".join(["0.25", "0.75"] * 4380) + "\n")
    bad.write_text("cpu_load\nhigh\n")
    fields = varied(f"site.workload_file={good},{bad}")
    sweep = Sweep(TINY, fields, days=0.25)
    inputs = sweep_inputs(sweep)
    (job,) = sweep_jobs(sweep, inputs)
    good.unlink()
    bad.unlink()
    result = run_part(job.values, inputs)
    assert result.rows is not None
    assert result.rows["site.workload_file"].tolist() == [str(good)]
    (failed,) = result.metrics["failed"]
    assert failed["error"].startswith(str(bad))
    bad.write_text("cpu_load\n0.5\n")
    good.write_text("cpu_load\n0.5\n")
    (changed,) = sweep_jobs(sweep, sweep_inputs(sweep))
    assert changed.key != job.key


def test_the_best_value_of_each_month_stands_beside_fixed_ones() -> None:
    fields = (Grid("site.location", ("NY", "CA")), Grid(SETPOINT, (16.0, 17.0, 19.0)))
    sweep = with_default(Sweep(TINY, fields, months=(1, 7)))
    assert sweep.varied[1] == Grid(SETPOINT, (16.0, 17.0, 19.0, 18.0))
    figures = {16.0: (5.0, 9.0), 17.0: (6.0, 6.0), 18.0: (8.0, 8.0), 19.0: (1.0, None)}
    rows = pd.DataFrame(
        [
            {"controller": "idle", "site.location": site, SETPOINT: value, "month": month}
            | {"cfp_kg": figure}
            for site in ("NY", "CA")
            for value, pair in figures.items()
            for month, figure in zip((1, 7), pair, strict=True)
            if figure is not None
        ]
    )
    table = best_by_month(rows, sweep, "cfp_kg")
    assert table["site.location"].tolist() == ["NY"] * 3 + ["CA"] * 3
    january, july, both = table[:3].to_dict("records")
    assert [january["best"], july["best"]] == [16.0, 17.0]
    assert [both[name] for name in ("month", "best_cfp_kg", "fixed", "fixed_cfp_kg")] == [
        "all",
        5.5,
        17.0,
        6.0,
    ]
    assert [january["default"], january["default_cfp_kg"]] == [18.0, 8.0]
    assert january["below_fixed_pct"] == pytest.approx(100 / 6)
    assert both["below_default_pct"] == pytest.approx(100 * (1 - 5.5 / 8))


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["sweep", *map(str, arguments)])


@pytest.fixture
def _in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run jobs in this process, which needs no start."""
    monkeypatch.setattr(JobOptions, "executor", lambda _: Executor())


@pytest.mark.usefixtures("_in_process")
def test_the_command_keeps_rows_and_tells_the_best_value(tmp_path: Path) -> None:
    out = tmp_path / "sweep"
    asked = ["tiny", "--site", "ny,ca", "--vary", f"{SETPOINT}=16:24:4", "--months", "1,7"]
    asked += ["--days", "0.25", "--best", "cfp_kg", "--batch", "5", "--out", str(out)]
    done = call(*asked)
    assert done.exit_code == 1, done.output
    failed = [line for line in done.stderr.splitlines() if line.startswith("failed")]
    assert len(failed) == 1
    assert "site.location=NY, hvac.setpoint.initial_c=24.0 and 3 more: tiny: " in failed[0]
    assert "12 of 16 runs have their rows in" in done.stdout
    rows = pd.read_parquet(out / "results")
    assert set(rows["month"]) == {1, 7}
    assert len(rows) == 12
    table = pd.read_csv(out / "best.csv")
    assert len(table) == 6
    assert set(table["default"]) == {18.0}
    assert (table["below_fixed_pct"] >= 0).all()
    assert (out / "best.png").stat().st_size > 1000
    assert "holds a study" in call(*asked).stderr
    again = call(*asked, "--resume")
    assert "kept" in again.stderr
    pd.testing.assert_frame_equal(pd.read_parquet(out / "results"), rows)


def test_what_would_run_is_shown_and_nothing_written(tmp_path: Path) -> None:
    asked = ["tiny", "--vary", "battery.capacity_kwh=0..500", "--sample", "8", "--site", "ny,ca"]
    done = call(*asked, "--months", "all", "--show", "--out", tmp_path / "sweep")
    assert done.exit_code == 0, (done.output, done.exception)
    shown = yaml.safe_load(done.stdout)
    assert (shown["runs"], shown["combinations"], shown["jobs"]) == (192, 16, 12)
    assert not (tmp_path / "sweep").exists()


def test_a_sweep_starts_on_the_day_of_its_option(tmp_path: Path) -> None:
    rows = []
    for name, begins in (("by option", ["--start", "07-01"]), ("by field", ["site.start=07-01"])):
        asked = ["tiny", "--vary", f"{SETPOINT}=18,20", "--days", "0.25", *begins]
        done = call(*asked, "--out", tmp_path / name)
        assert done.exit_code == 0, (done.output, done.exception)
        rows.append(pd.read_parquet(tmp_path / name / "results"))
    pd.testing.assert_frame_equal(rows[0], rows[1])


def test_a_run_keeps_the_name_and_thus_the_events_of_its_data_center() -> None:
    rule = {"kind": "heat_wave", "offset_k": 9, "per_year": 2000, "duration_h": [1, 3]}
    base = with_values(TINY, {"name": "mine", "events.sampled": [rule]})
    found = rows_of(Sweep(base, varied(f"{SETPOINT}=18,20"), days=0.5))
    config = with_values(base, {SETPOINT: 20.0})
    for named, is_equal in ((config, True), (config.model_copy(update={"name": "ny"}), False)):
        with Simulator(make_configs(named)) as sim:
            totals = simulate(sim, make_controller("idle", sim.fleet), 48, 0)
            alone = metrics_per_dc(totals, sim.fleet)[0]
        assert bool(alone["cfp_kg"] == found["cfp_kg"].iloc[-1]) is is_equal


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--months", "1", "--start", "07-01"], "--start 07-01 with --months 1: .* one of the two"),
        (["--start", "07-32"], "--start: .*07-32"),
        (["--months", "13"], "valid are all, or months 1..12"),
        (["--best", "cfp", "--months", "1"], "did you mean 'cfp_kg'"),
        (["--most", "5", "--months", "1,7"], "8 runs .* as many as --most allows"),
        (["--best", "cfp_kg"], "best: the runs are not by month"),
    ],
)
def test_options_that_are_not_valid_are_one_line(options: list[str], said: str) -> None:
    done = call("tiny", "--vary", f"{SETPOINT}=16:19:1", *options)
    assert done.exit_code == 2
    assert re.search(said, done.stderr), done.stderr
    assert len(done.stderr.splitlines()) == 1
