"""Names, imports, and sites from files."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

import exogenous_builders as build
from exogenous_builders import run_data as run
from sdc_taichi.cli.data import data_app
from sdc_taichi.errors import DataError, SdcError
from sdc_taichi.exogenous import (
    load_site,
    load_trace,
    read_carbon,
    read_epw,
    read_workload,
    site_from_files,
    site_names,
    site_pressure_pa,
    standard_pressure_pa,
    synthetic_site,
    trace_names,
)
from sdc_taichi.exogenous.files import sha256
from sdc_taichi.exogenous.synthetic import synthetic_sites


@pytest.fixture(scope="session")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SustainDC data folder with one complete site, a second station, and leftovers."""
    folder = tmp_path_factory.mktemp("sustaindc")
    contents = {
        "Weather/USA_NY_New.York-LaGuardia.epw": build.epw_lines(),
        "Weather/USA_NY_New.York-Kennedy.epw": build.epw_lines(),
        "CarbonIntensity/NY_NG_&_avgCI.csv": build.carbon_lines(),
        "CarbonIntensity/NYIS_NG_&_avgCI.csv": build.carbon_lines(),
        "Workload/Trace_1.csv": build.workload_lines(),
    }
    for name, lines in contents.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(build.text(lines))
    return folder


def epw(sources: Path) -> str:
    return str(sources / "Weather" / "USA_NY_New.York-LaGuardia.epw")


def carbon(sources: Path) -> str:
    return str(sources / "CarbonIntensity" / "NY_NG_&_avgCI.csv")


# Names


def test_pressure_of_a_site_follows_from_its_height(sources: Path, user_folder: Path) -> None:
    assert standard_pressure_pa(0.0) == 101_325.0
    # Table 1 of the chapter: 1,000 m.
    assert standard_pressure_pa(1000.0) == pytest.approx(89_875.0, abs=2.0)
    height_m = read_epw(epw(sources)).elevation_m
    at_station = pytest.approx(float(standard_pressure_pa(height_m)))
    assert site_pressure_pa("ny") == pytest.approx(float(standard_pressure_pa(3.4)))
    assert site_pressure_pa("AZ", epw(sources)) == at_station
    run("import", epw(sources), "--site", "home")
    run("import", carbon(sources), "--site", "grid", "--base", "AZ")
    assert site_pressure_pa("home") == at_station
    assert site_pressure_pa("grid") == site_pressure_pa("AZ")
    for bad in ({"name": "nowhere"}, {"name": "NY", "weather_file": carbon(sources)}):
        with pytest.raises(DataError, match="expected"):
            site_pressure_pa(**bad)


def test_unknown_names_suggest_the_nearest(user_folder: Path) -> None:
    with pytest.raises(DataError, match=r"site 'NYC': expected one of AZ.*nearest: NY"):
        load_site("NYC")
    with pytest.raises(DataError, match=r"trace 'alibaba': .*nearest: alibaba_"):
        load_trace("alibaba")


# Sites from files


def test_site_from_both_files(sources: Path) -> None:
    site = site_from_files(None, epw(sources), carbon(sources), "here")
    weather = read_epw(epw(sources))
    expected = read_carbon(carbon(sources), -5.0, longitude_deg=weather.longitude_deg)
    assert (site.name, site.utc_offset_h) == ("here", -5.0)
    np.testing.assert_array_equal(site.outdoor_c.values, weather.outdoor_c.values)
    np.testing.assert_array_equal(site.ci_g_per_kwh.values, expected.values)
    assert not site.synthetic


def test_what_no_file_gives_is_taken_from_the_base(sources: Path) -> None:
    base = synthetic_site("CA")
    site = site_from_files(base, weather=epw(sources))
    assert not site.outdoor_c.synthetic
    assert site.ci_g_per_kwh.synthetic
    assert site.synthetic
    assert any("UTC-8" in note for note in site.ci_g_per_kwh.notes)
    site = site_from_files(synthetic_site("NY"), carbon=carbon(sources))
    assert site.name == "NY"
    assert site.outdoor_c is synthetic_site("NY").outdoor_c
    assert not site.ci_g_per_kwh.synthetic


@pytest.mark.parametrize(("state", "warned"), [("NY", False), ("CA", True)])
def test_carbon_named_after_another_state_is_warned_of(
    state: str, warned: bool, sources: Path, tmp_path: Path
) -> None:
    path = tmp_path / f"{state}_NG_&_avgCI.csv"
    path.write_bytes(Path(carbon(sources)).read_bytes())
    for base, weather in ((None, epw(sources)), (synthetic_site("NY"), None)):
        notes = site_from_files(base, weather, path).ci_g_per_kwh.notes
        assert any("named after CA" in note for note in notes) == warned


# Commands


def test_import_a_folder_and_read_it_back(sources: Path, user_folder: Path) -> None:
    output = run("import", str(sources)).output
    assert "NYIS_NG_&_avgCI.csv: no weather file of NYIS" in output
    assert site_names()[len(synthetic_sites()) :] == ("NY-New-York-Kennedy-real", "NY-real")
    assert trace_names()[3:] == ("Trace_1",)
    direct = site_from_files(None, epw(sources), carbon(sources))
    stored = load_site("ny-REAL")
    for a, b in zip(direct.series, stored.series, strict=True):
        np.testing.assert_array_equal(a.values, b.values)
        assert (a.name, a.unit, a.minutes, a.notes) == (b.name, b.unit, b.minutes, b.notes)
    assert (direct.label, direct.elevation_m) == (stored.label, stored.elevation_m)
    trace = sources / "Workload" / "Trace_1.csv"
    np.testing.assert_array_equal(load_trace("trace_1").values, read_workload(trace).values)
    listed = run("list").output
    assert "NY-real" in listed
    assert "synthetic" in listed
    assert "real" in listed


def test_import_writes_provenance_and_no_rest(sources: Path, user_folder: Path) -> None:
    run("import", epw(sources), "--site", "home")
    run("import", carbon(sources), "--site", "HOME")  # the same site
    folder = user_folder / "sites" / "home"
    assert sorted(p.name for p in folder.iterdir()) == ["carbon.parquet", "weather.parquet"]
    schema = pq.read_schema(folder / "carbon.parquet")
    metadata = json.loads(schema.metadata[b"sdc_taichi"])
    assert metadata["source_file"] == "NY_NG_&_avgCI.csv"
    assert metadata["sha256"] == sha256(Path(carbon(sources)))
    assert metadata["utc_offset_h"] == -5.0
    assert metadata["notes"] == list(load_site("home").ci_g_per_kwh.notes)
    assert metadata["created_by"].startswith("sdc-taichi ")
    # The stored files are input like any other.
    site = site_from_files(None, folder / "weather.parquet", folder / "carbon.parquet")
    np.testing.assert_array_equal(site.outdoor_c.values, load_site("home").outdoor_c.values)


def test_import_says_what_is_missing(sources: Path, user_folder: Path) -> None:
    output = run("import", epw(sources), "--site", "half").output
    assert "site half lacks carbon" in output
    with pytest.raises(DataError, match="imported without carbon"):
        load_site("half")
    assert "incomplete" in run("list").output
    output = run("import", epw(sources), "--site", "half", "--base", "ny").output
    assert "carbon of the embedded NY (synthetic)" in output
    site = load_site("half", seed=3)
    np.testing.assert_array_equal(
        site.ci_g_per_kwh.values, synthetic_site("NY", 3).ci_g_per_kwh.values
    )
    assert site.synthetic


def test_carbon_needs_a_utc_offset(sources: Path, user_folder: Path) -> None:
    with pytest.raises(DataError, match="UTC offset of site 'c' unknown"):
        run("import", carbon(sources), "--site", "c")
    run("import", carbon(sources), "--site", "c", "--base", "NY")
    assert load_site("c").utc_offset_h == -5.0
    run("import", carbon(sources), "--site", "d", "--utc-offset", "-5")
    run("import", epw(sources), "--site", "d")
    assert not load_site("d").synthetic
    with pytest.raises(DataError, match="expected -5 as in the weather file"):
        run("import", carbon(sources), "--site", "d", "--utc-offset", "-8")


@pytest.mark.parametrize("name", ["NY", "ny", "../x", "", "a b", ".hidden", "x" * 65])
def test_names_that_cannot_be_imported(name: str, sources: Path, user_folder: Path) -> None:
    with pytest.raises(DataError, match="site "):
        run("import", epw(sources), "--site", name)
    assert not user_folder.exists()


def test_one_bad_file_in_a_folder(sources: Path, tmp_path: Path, user_folder: Path) -> None:
    folder = tmp_path / "data"
    (folder / "workload").mkdir(parents=True)
    for name, lines in (("a", build.workload_lines(100)), ("b", build.workload_lines())):
        (folder / "workload" / f"{name}.csv").write_text(build.text(lines))
    with pytest.raises(DataError, match=r"1 of 2 files not imported; first: .*a\.csv"):
        run("import", str(folder))
    assert trace_names()[3:] == ("b",)


def test_files_that_are_none_of_the_three(tmp_path: Path, user_folder: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match=r"x\.csv: row 1: expected an EPW file"):
        run("import", str(path), "--site", "x")
    with pytest.raises(DataError, match="expected subfolders CarbonIntensity"):
        run("import", str(tmp_path))
    path.write_text(build.text(build.carbon_lines()))
    with pytest.raises(DataError, match="expected --site NAME"):
        run("import", str(path))


@pytest.mark.parametrize("life_cycle", ["Life cycle", "LCA"])
def test_a_table_of_electricity_maps(life_cycle: str, tmp_path: Path, user_folder: Path) -> None:
    columns = [f"Carbon intensity gCO₂eq/kWh ({kind})" for kind in ("direct", life_cycle)]
    stamps = [line.split(",")[0].removesuffix("+00:00") for line in build.carbon_lines()[1:]]
    rows = (f"{stamp},France,France,FR,20,{i % 24}" for i, stamp in enumerate(stamps))
    path = tmp_path / "FR_2022_hourly.csv"
    header = f"Datetime (UTC),Country,Zone name,Zone id,{','.join(columns)}"
    path.write_text(build.text([header, *rows]))
    hint = "data import FILE --map electricity-maps"
    arguments = ["import", str(path), "--site", "paris", "--utc-offset", "1"]
    assert hint in " ".join(str(CliRunner().invoke(data_app, arguments).exception).split())
    with pytest.raises(DataError, match=r"missing column timestamp, avg_CI.*Electricity Maps"):
        read_carbon(path, 1.0)
    mapped = ["--map", "timestamp=Datetime (UTC)", "--map", f"avg_CI={columns[1]}"]
    assert run(*arguments, *mapped, "--stamp", "start").exit_code == 0
    stored = user_folder / "sites" / "paris" / "carbon.parquet"
    np.testing.assert_array_equal(read_carbon(stored, 1.0).values[:25], [23, *range(24)])


@pytest.mark.parametrize(
    ("mapped", "message"),
    [
        ("avg_CI", "expected NAME=COLUMN"),
        ("avgCI=x", "did you mean 'avg_CI'"),
        ("avg_CI=x", "row 1: expected an EPW file"),
        ("cpu_load=avg_CI", "row 2, column cpu_load: '[0-9.]+', expected a number from 0 to 1"),
    ],
)
def test_mappings_that_are_not_valid(
    mapped: str, message: str, sources: Path, user_folder: Path
) -> None:
    with pytest.raises(DataError, match=message):
        run("import", carbon(sources), "--site", "x", "--map", mapped)
    for path in (epw(sources), str(sources)):
        with pytest.raises(DataError, match="--map"):
            run("import", path, "--map", "avg_CI=x")


def test_show_a_site_and_a_trace(user_folder: Path) -> None:
    output = run("show", "va").output
    assert "Leesburg, Virginia" in output
    assert "synthetic year, seed 10" in output
    assert "seasonal" in output
    assert "utilisation" in run("show", "google_1", "--seed", "4").output
    with pytest.raises(DataError, match="site or trace 'vaa'"):
        run("show", "vaa")


def test_design_conditions_are_imported_and_shown(
    tmp_path: Path, user_folder: Path, sources: Path
) -> None:
    lines = list(build.epw_lines())
    lines[1] = build.DESIGN_LINE
    path = tmp_path / "chicago.epw"
    path.write_text("\n".join(lines))
    run("import", str(path), "--site", "ohare", "--base", "IL")
    assert load_site("ohare").design == read_epw(path).design
    output = run("show", "ohare").output
    assert "dry bulb 32.9 C, wet bulb 25.2 C (exceeded for 0.4 % of the year), 39 C once" in output
    run("import", epw(sources), "--site", "home", "--base", "NY")
    assert load_site("home").design is None
    assert "Design conditions" not in run("show", "home").output


def test_show_draws_a_picture(tmp_path: Path, user_folder: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is the extra plot")
    out = tmp_path / "va.png"
    run("show", "VA", "--out", str(out))
    assert out.read_bytes().startswith(b"\x89PNG")
    assert "matplotlib.pyplot" not in sys.modules
    with pytest.raises(DataError, match=r"va\.xyz: suffix"):
        run("show", "VA", "--out", str(tmp_path / "va.xyz"))
    with pytest.raises(SdcError, match="cannot be written"):
        run("show", "VA", "--out", str(tmp_path / "absent" / "va.png"))
