"""Exports of run folders: CSV, Excel and logs of points, read back by other libraries."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from sdc_taichi.cli.app import app
from sdc_taichi.run import export
from sdc_taichi.types import QUANTITIES


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(each) for each in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "run"
    done = run(
        *("simulate", "hall_of_2026", "--days", 0.25, "--start", "07-01", "--site", "ny,ca"),
        *("--racks", "row:1,hottest:2", "--rack-history", "every=1h", "--out", out, "--quiet"),
    )
    assert done.exit_code == 0, done.stderr
    return out


def exported(folder: Path, out: Path, *arguments: object) -> Path:
    done = run("export", folder, "--out", out, *arguments)
    assert done.exit_code == 0, done.stderr
    assert str(out) in done.stdout
    return out


@pytest.mark.parametrize("table", ["steps", "racks"])
@pytest.mark.parametrize(("kind", "end"), [("csv", ".csv"), ("xlsx", ".xlsx")])
def test_tables_are_the_columns_of_the_run(
    folder: Path, tmp_path: Path, table: str, kind: str, end: str
) -> None:
    path = exported(folder, tmp_path / f"x{end}", "--to", kind, "--table", table)
    stored = pd.read_parquet(folder / f"{table}.parquet")
    local = stored["time"].dt.tz_convert(None) + pd.to_timedelta(stored["utc_offset_h"], unit="h")
    found = pd.read_csv(path) if kind == "csv" else pd.read_excel(path, engine="calamine")
    assert list(found.columns) == list(stored.columns)
    if kind == "csv":
        offset = np.where(stored["dc"] == "ny", "-05:00", "-08:00")
        expected = local.dt.strftime("%Y-%m-%dT%H:%M:%S") + offset
        assert found["time"].tolist() == expected.tolist()
        assert (pd.to_datetime(found["time"], utc=True) == stored["time"]).all()
    else:
        assert (pd.to_datetime(found["time"]) == local).all()
        columns = pd.read_excel(path, sheet_name="columns", engine="calamine")
        assert columns["column"].tolist() == list(stored.columns)
        assert columns["meaning"].notna().all()
    assert found["dc"].tolist() == stored["dc"].tolist()
    for name in stored.columns.drop(["dc", "time"]):
        np.testing.assert_allclose(found[name], stored[name], rtol=1e-6, err_msg=name)


def test_points_have_names_utc_times_values_and_units(folder: Path, tmp_path: Path) -> None:
    names = ["inlet_max_c", "it_w", "setpoint_c"]
    arguments = ("--to", "bms", "--columns", ",".join(names), "--dc", "ca")
    points = pd.read_csv(exported(folder, tmp_path / "x.csv", *arguments), keep_default_na=False)
    steps = pd.read_parquet(folder / "steps.parquet")
    steps = steps[steps["dc"] == "ca"]
    assert list(points.columns) == ["point", "time", "value", "unit"]
    assert points["point"].tolist() == [f"ca/{name}" for name in names] * len(steps)
    assert points["unit"].tolist() == [QUANTITIES[name].unit for name in names] * len(steps)
    np.testing.assert_allclose(points["value"], steps[names].to_numpy().reshape(-1), rtol=1e-12)
    assert points["time"].iloc[0] == "2018-07-01T08:00:00Z"
    assert (pd.to_datetime(points["time"]) == np.repeat(steps["time"].to_numpy(), 3)).all()


def test_points_of_racks_follow_a_template(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "_VALUES_AT_A_TIME", 7)
    template = "{dc}.R{row:02}.{place}.{quantity}"
    arguments = ("--to", "bms", "--table", "racks", "--racks", "1:2", "--points", template)
    points = pd.read_csv(exported(folder, tmp_path / "x.csv", *arguments))
    racks = pd.read_parquet(folder / "racks.parquet")
    rack = racks.loc[racks["row"] == 1, "rack"].min() + 2
    racks = racks[(racks["rack"] == rack) & (racks["dc"] == "ny")]
    inlets = points[points["point"] == "ny.R01.2.inlet_c"]
    np.testing.assert_allclose(inlets["value"], racks["inlet_c"])
    assert set(points["unit"].dropna()) == {"C", "W", "m3/s"}


def test_hottest_racks_are_those_of_the_run(folder: Path, tmp_path: Path) -> None:
    arguments = ("--to", "csv", "--table", "racks", "--racks", "hottest:1", "--dc", "ny")
    found = pd.read_csv(exported(folder, tmp_path / "x.csv", *arguments))
    racks = pd.read_parquet(folder / "racks.parquet")
    racks = racks[racks["dc"] == "ny"]
    highest = racks.groupby("rack")["inlet_max_c"].max()
    assert found["rack"].nunique() == 1
    assert found["inlet_max_c"].max() == pytest.approx(highest.max(), abs=1e-3)


def test_libraries_read_a_history_alike(folder: Path) -> None:
    path = folder / "racks.parquet"
    by_pandas = pd.read_parquet(path).groupby("rack")["inlet_max_c"].max()
    table = pq.read_table(path, columns=["rack", "inlet_max_c"])
    by_arrow = table.group_by("rack").aggregate([("inlet_max_c", "max")]).to_pandas()
    assert dict(by_arrow.itertuples(index=False)) == by_pandas.to_dict()
    query = f"SELECT rack, max(inlet_max_c) FROM '{path}' GROUP BY rack"
    assert dict(duckdb.execute(query).fetchall()) == by_pandas.to_dict()


def test_exports_of_a_former_run_are_removed(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(folder, out)
    assert run("export", out, "--to", "csv").exit_code == 0
    assert (out / "steps.csv").exists()
    assert run("simulate", "tiny", "--days", 0.25, "--out", out, "--quiet").exit_code == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "config.yaml",
        "metrics.json",
        "steps.parquet",
    ]


# --- bad input ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--to csv --columns itw", "--columns 'itw': valid are it_w"),
        ("--to csv --dc la", "--dc 'la': valid are ca"),
        ("--to csv --racks 3", "--racks: racks of a table; valid with --table racks"),
        ("--to csv --table racks --racks row:99", "--racks 'row:99': the hall of ny has"),
        ("--to csv --points x", "--points: names of points; valid with --to bms"),
        ("--to bms --points {dc}", "--points '{dc}': several points have the name 'ca'"),
        ("--to bms --points {x}", "--points '{x}': valid are texts and {dc}, {quantity}"),
        ("--to bms --points {", "--points '{': valid are texts and {dc}, {quantity}"),
        ("--to bms --points {dc:d}", "--points '{dc:d}': "),
        ("--to xlsx --out x.csv", "--out x.csv: valid is a name that ends in .xlsx"),
        ("--to csv --out nowhere/x.csv", "nowhere/x.csv: cannot be written: No such file"),
    ],
)
def test_bad_requests_are_one_line_and_write_nothing(
    arguments: str, message: str, folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(folder.iterdir())
    done = run("export", folder, *arguments.split())
    assert done.exit_code == 2
    assert re.search(re.escape(message), done.stderr), done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted(folder.iterdir()) == before
    assert not [*tmp_path.iterdir()]


def test_what_does_not_fit_is_told(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(export, "MOST_SHEET_ROWS", 48)
    done = run("export", folder, "--to", "xlsx")
    assert "--to xlsx: 49 rows" in done.stderr
    monkeypatch.setitem(sys.modules, "xlsxwriter", None)
    done = run("export", folder, "--to", "xlsx")
    assert 'pip install "sdc-taichi[excel]"' in done.stderr
    free = shutil.disk_usage(folder)._replace(free=50_000_100)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: free)
    done = run("export", folder, "--to", "csv")
    assert re.search(r"steps.csv: about [\de.-]+ GB for 48 rows", done.stderr), done.stderr
    simulated = tmp_path / "run"
    assert run("simulate", "tiny", "--days", 0.25, "--out", simulated, "--quiet").exit_code == 0
    done = run("export", simulated, "--to", "csv", "--table", "racks")
    assert "racks.parquet: no such file; valid is a run of simulate with --racks" in done.stderr
