"""Loaders on well-formed files: alignment, repairs, leap days, any length and resolution."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import exogenous_builders as build
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import (
    read_carbon,
    read_epw,
    read_workload,
    site_from_files,
    statistics,
    wet_bulb_c,
)
from sdc_taichi.exogenous.importing import file_kind
from sdc_taichi.exogenous.series import DesignConditions
from sdc_taichi.exogenous.series_file import read_metadata, write_parquet
from sdc_taichi.exogenous.stamps import Stamp
from sdc_taichi.exogenous.weather import read_city, read_elevation_m
from sdc_taichi.exogenous.weather_table import Place, read_weather_table


def write(path: Path, lines: list[str] | tuple[str, ...], newline: str = "\n") -> Path:
    path.write_bytes(build.text(lines, newline).encode())
    return path


# Carbon: time


@pytest.mark.parametrize("offset", [-8.0, -5.0, 0.0, 1.0, 5.5, 10.0])
@pytest.mark.parametrize("marks", ["end", "start"])
@pytest.mark.parametrize("given", [True, False])
def test_solar_dip_lands_on_local_noon(
    offset: float, marks: str, given: bool, tmp_path: Path
) -> None:
    path = write(tmp_path / "ci.csv", build.carbon_lines(utc_offset_h=offset, marks=marks))
    series = read_carbon(path, offset, marks if given else "auto")  # type: ignore[arg-type]
    assert series.values.shape == (8760,)
    by_hour = series.values.reshape(365, 24).mean(axis=0)
    # The dip is symmetric about 12:00, the edge between the intervals 11 and 12.
    np.testing.assert_allclose(by_hour, by_hour[::-1], rtol=0, atol=1e-3 * by_hour.max())
    assert set(np.argsort(by_hour)[:2]) == {11, 12}
    assert not series.synthetic


@pytest.mark.parametrize(("longitude_deg", "warned"), [(-75, False), (-95, False), (-110, True)])
@pytest.mark.parametrize("stamp", ["auto", "end"])
def test_the_sun_of_another_region_is_warned_of(
    longitude_deg: float, warned: bool, stamp: Stamp, tmp_path: Path
) -> None:
    path = write(tmp_path / "ci.csv", build.carbon_lines())
    series = read_carbon(path, -5.0, stamp, longitude_deg=longitude_deg)
    found = [note for note in series.notes if "another region" in note]
    assert len(found) == warned
    assert all("warning: solar generation is centred" in note for note in found)


@pytest.mark.parametrize(("first", "second"), [("start", "end"), ("end", "start")])
def test_a_change_of_what_stamps_mark_is_found(first: str, second: str, tmp_path: Path) -> None:
    lines = build.carbon_lines(marks=first, change="2022-06-15")
    series = read_carbon(write(tmp_path / "ci.csv", lines), -5.0)
    note = next(n for n in series.notes if "until" in n)
    assert f"the {first} until 2022-06-1" in note
    assert f"then the {second}" in note
    assert series.values.size == 8760
    for part in (series.values[: 24 * 150], series.values[24 * 180 :]):
        by_hour = part.reshape(-1, 24).mean(axis=0)
        assert set(np.argsort(by_hour)[:2]) == {11, 12}


def test_hours_before_the_year_wrap_to_its_end(tmp_path: Path) -> None:
    lines = build.carbon_lines()
    numbered = [
        lines[0].split(",")[0] + ",avg_CI",
        *(f"{row.split(',')[0]},{100 + 0.01 * i:.2f}" for i, row in enumerate(lines[1:])),
    ]
    path = write(tmp_path / "ci.csv", numbered)
    series = read_carbon(path, -5.0, "end")
    # Row i (UTC, end) is the local interval that starts 6 h earlier.
    assert series.values[0] == pytest.approx(100.06)
    assert series.values[8753] == pytest.approx(100 + 0.01 * 8759)
    assert series.values[8754] == pytest.approx(100.0)
    assert "6 rows before 1 January 00:00 moved to the end" in series.notes
    east = read_carbon(path, 3.0, "start")
    assert "3 rows after 31 December 24:00 moved to the start" in east.notes
    assert east.values[3] == pytest.approx(100.0)
    assert east.values[0] == pytest.approx(100 + 0.01 * 8757)
    kept = read_carbon(path, -5.0, pairing="utc_rows")
    np.testing.assert_allclose(kept.values, 100 + 0.01 * np.arange(8760))


def test_half_hour_offsets_average_by_overlap(tmp_path: Path) -> None:
    lines = build.carbon_lines()
    numbered = [
        "timestamp,avg_CI",
        *(f"{row.split(',')[0]},{100 + i % 24}" for i, row in enumerate(lines[1:])),
    ]
    series = read_carbon(write(tmp_path / "ci.csv", numbered), 5.5, "start")
    # Local 06:00 holds the second half of UTC hour 0 and the first half of UTC hour 1.
    assert series.values[24 * 10 + 6] == pytest.approx(100.5)
    assert series.values.mean() == pytest.approx(111.5)


@pytest.mark.parametrize(
    ("start", "stop", "minutes", "rows", "year"),
    [
        ("2024-01-01", "2025-01-01", 60, 8760, 2024),
        ("2021-01-01", "2024-01-01", 60, 3 * 8760, 2021),
        ("2023-01-01", "2026-01-01", 60, 3 * 8760, 2023),
        ("2022-01-01", "2023-01-01", 5, 105_120, 2022),
        ("2022-01-01", "2023-01-01", 30, 17_520, 2022),
        ("2022-07-01", "2023-07-01", 60, 8760, 2022),
        ("2023-07-01", "2024-07-01", 60, 8760, 2023),
        ("2022-10-01", "2023-10-01", 60, 8760, 2023),
        ("2021-10-01", "2024-10-01", 60, 3 * 8760, 2022),
        ("2022-01-01", "2023-02-15", 60, 8760, 2022),
    ],
)
def test_any_span_and_resolution(
    start: str, stop: str, minutes: int, rows: int, year: int, tmp_path: Path
) -> None:
    lines = build.carbon_lines(start, stop, -8.0, minutes)
    series = read_carbon(write(tmp_path / "ci.csv", lines), -8.0)
    assert series.values.shape == (rows,)
    assert series.minutes == minutes
    assert series.year == year
    by_step = series.values.reshape(-1, 1440 // minutes).mean(axis=0)
    half = by_step.size // 2
    assert set(np.argsort(by_step)[:2]) == {half - 1, half}


def test_29_february_is_the_local_day(tmp_path: Path) -> None:
    lines = build.carbon_lines("2024-01-01", "2025-01-01")
    numbered = ["timestamp,avg_CI"]
    for row in lines[1:]:
        stamp = row.split(",")[0]
        local = np.datetime64(stamp[:10]) + np.timedelta64(int(stamp[11:13]) - 5, "h")
        is_leap_day = str(local)[5:10] == "02-29"
        numbered.append(f"{stamp},{999 if is_leap_day else 100}")
    series = read_carbon(write(tmp_path / "ci.csv", numbered), -5.0, "start")
    assert np.all(series.values == 100.0)
    assert "29 February removed (24 rows)" in series.notes


# Carbon: repairs


def test_carbon_repairs_are_counted(tmp_path: Path) -> None:
    lines: list[str] = build.carbon_lines()
    clean = read_carbon(write(tmp_path / "clean.csv", lines), -5.0, "end")
    for row in (100, 101, 102):
        lines = build.with_cell(lines, row, 9, "")
    partial = lines[4999].split(",")
    lines[4999] = f"{partial[0]},0,0,0,0,900,0,100,0,{(900 * 490 + 100 * 12) / 1000}"
    lines = build.without_rows(lines, 7001, 7024)
    lines[0] = lines[0].replace("timestamp", "")
    path = tmp_path / "damaged.csv"
    path.write_text("\n".join(lines))  # no final newline
    series = read_carbon(path, -5.0, "end")
    assert "blank first header read as timestamp" in series.notes
    assert "24 absent rows interpolated" in series.notes
    assert "3 rows without values interpolated" in series.notes
    assert any(n.startswith("1 rows with under half of the 25 h median") for n in series.notes)
    changed = np.flatnonzero(series.values != clean.values)
    assert changed.size <= 3 + 1 + 24
    assert np.abs(series.values - clean.values).max() < 250.0


def test_carbon_oddities_are_warned_of_and_kept(tmp_path: Path) -> None:
    lines: list[str] = build.carbon_lines()
    for row in range(2000, 2010):
        cells = lines[row - 1].split(",")
        sun, gas = float(cells[2]), float(cells[5])
        mix = (41 * sun + 490 * gas + 230 * 2000) / 10_000
        lines[row - 1] = f"{cells[0]},0,{sun},0,0,{gas},0,0,2000,{mix}"
    for row in (3000, 3001):
        cells = lines[row - 1].split(",")
        gas = 90_000.0
        sun = float(cells[2])
        mix = (41 * sun + 490 * gas + 12 * 2000) / (sun + gas + 2000)
        lines[row - 1] = f"{cells[0]},0,{sun},0,0,{gas},0,2000,0,{mix}"
    series = read_carbon(write(tmp_path / "ci.csv", lines), -5.0, "end")
    warnings = [n for n in series.notes if n.startswith("warning")]
    assert len(warnings) == 2
    assert "10 rows with no nuclear but high OTH" in warnings[1]
    assert "first: row 2000" in warnings[1]
    assert "2 rows with over twice" in warnings[0]
    # Row 3000 is kept: data index 2998, stamped at its end, 5 h behind UTC.
    assert series.values[2998 - 1 - 5] == pytest.approx(float(lines[2999].split(",")[-1]))


# Weather


def test_epw_hour_one_is_the_first_interval(tmp_path: Path) -> None:
    lines = build.epw_lines()
    weather = read_epw(write(tmp_path / "x.epw", lines, "\r\n"))
    assert weather.outdoor_c.values.shape == (8760,)
    first = lines[len(build.EPW_HEADER)].split(",")
    assert first[3] == "1"
    assert weather.outdoor_c.values[0] == float(first[6])
    assert (weather.latitude_deg, weather.longitude_deg) == (40.7, -75.0)
    assert (weather.utc_offset_h, weather.elevation_m) == (-5.0, 10.0)
    assert weather.label == "Test.Station, NY, USA"
    assert weather.pressure_pa is not None
    expected = wet_bulb_c(weather.outdoor_c.values, 60.0, weather.pressure_pa.values)
    np.testing.assert_allclose(weather.wet_bulb_c.values, expected, rtol=0, atol=1e-12)
    assert weather.outdoor_c.notes == (
        "no design conditions: plants are sized for a dry bulb of 26.8 C and a wet bulb of 21.0 C, "
        "which this year exceeds for 0.4 % of its hours",
    )


@pytest.mark.parametrize(
    ("start", "stop", "per_hour", "rows", "removed"),
    [
        ("2024-01-01", "2025-01-01", 1, 8760, 24),
        ("2021-01-01", "2024-01-01", 1, 3 * 8760, 0),
        ("2023-01-01", "2026-01-01", 1, 3 * 8760, 24),
        ("2022-01-01", "2023-01-01", 12, 105_120, 0),
        ("2024-01-01", "2025-01-01", 4, 35_040, 96),
        ("2022-07-01", "2023-07-01", 1, 8760, 0),
        ("2022-01-01", "2023-03-01", 1, 8760, 0),
    ],
)
def test_epw_of_any_span_and_resolution(
    start: str, stop: str, per_hour: int, rows: int, removed: int, tmp_path: Path
) -> None:
    weather = read_epw(write(tmp_path / "x.epw", build.epw_lines(start, stop, per_hour)))
    series = weather.outdoor_c
    assert series.values.shape == (rows,)
    assert series.minutes == 60 / per_hour
    assert series.year == int(start[:4])
    assert (f"29 February removed ({removed} rows)" in series.notes) == bool(removed)
    by_day = series.values.reshape(-1, 24 * per_hour)
    assert 14 * per_hour <= int(by_day.mean(axis=0).argmax()) <= 16 * per_hour
    assert abs(int(by_day[:365].mean(axis=1).argmin()) - 14) <= 2  # mid January


def test_epw_mixed_years_are_one_year(tmp_path: Path) -> None:
    lines = list(build.epw_lines())
    for at in range(8, len(lines)):
        cells = lines[at].split(",", 2)
        lines[at] = f"{2000 + int(cells[1]) % 5},{cells[1]},{cells[2]}"
    mixed = read_epw(write(tmp_path / "x.epw", lines))
    plain = read_epw(write(tmp_path / "y.epw", build.epw_lines()))
    np.testing.assert_array_equal(mixed.outdoor_c.values, plain.outdoor_c.values)
    assert (mixed.outdoor_c.year, plain.outdoor_c.year) == (None, 2021)


def test_epw_missing_codes_and_gaps_are_interpolated(tmp_path: Path) -> None:
    lines: list[str] = list(build.epw_lines())
    clean = read_epw(write(tmp_path / "clean.epw", lines)).outdoor_c.values
    for row, (column, code) in enumerate([(6, "99.9"), (8, "999"), (9, "999999.")], start=1000):
        lines = build.with_cell(lines, row, column, code)
    lines = build.with_cell(lines, 3000, 8, "104")
    lines = build.without_rows(lines, 5001, 5020)
    weather = read_epw(write(tmp_path / "x.epw", lines))
    notes = weather.outdoor_c.notes
    assert "1 missing values of dry bulb (column 7) interpolated" in notes
    assert "1 missing values of relative humidity (column 9) interpolated" in notes
    assert "1 missing values of station pressure (column 10) interpolated" in notes
    assert "1 values of relative humidity over 100 % set to 100 %" in notes
    assert "20 absent rows interpolated" in notes
    at = 1000 - 9
    assert weather.outdoor_c.values[at] == pytest.approx((clean[at - 1] + clean[at + 1]) / 2)


# Workload


def test_workload_longer_than_a_year_is_cut_and_repetition_warned_of(tmp_path: Path) -> None:
    week = [f"{0.3 + 0.001 * (i * 37 % 168):.3f}" for i in range(168)]
    lines = ["cpu_load", *(week * 53)]
    series = read_workload(write(tmp_path / "w.csv", lines))
    assert series.values.shape == (8760,)
    assert "warning: the same 168 rows repeat 53 times" in series.notes
    assert "truncated to 1 x 365 days (144 rows cut)" in series.notes


def test_workload_of_five_minutes_and_of_three_years(tmp_path: Path) -> None:
    lines = ["cpu_load", *(f"{0.5 + i % 7 / 100}" for i in range(105_120))]
    path = write(tmp_path / "w.csv", lines)
    assert read_workload(path, minutes=5.0).days == 365
    assert read_workload(path).days == 12 * 365  # hourly unless told
    stamps = np.datetime_as_string(
        np.arange(np.datetime64("2022-03-01T00:00"), np.datetime64("2023-03-01T00:00"), 30)
    )
    stamped = ["timestamp,cpu_load", *(f"{t},{0.2 + 0.3 * (t[5:7] < '03')}" for t in stamps)]
    series = read_workload(write(tmp_path / "s.csv", stamped))
    assert series.minutes == 30.0
    by_day = series.values.reshape(365, 48).mean(axis=1)
    np.testing.assert_allclose(by_day[:59], 0.5)  # January and February lead
    np.testing.assert_allclose(by_day[59:], 0.2)


def test_columns_by_other_names(tmp_path: Path) -> None:
    plain = build.workload_lines()
    path = write(tmp_path / "a.csv", plain)
    renamed = write(tmp_path / "b.csv", [plain[0].replace("cpu_load", "cpu [1]"), *plain[1:]])
    series = read_workload(renamed, columns={"cpu_load": "cpu [1]"})
    np.testing.assert_array_equal(series.values, read_workload(path).values)
    assert "cpu [1] read as cpu_load" in series.notes
    with pytest.raises(DataError, match="missing column load; found"):
        read_workload(path, columns={"cpu_load": "load"})
    with pytest.raises(
        DataError, match="expected each column once, and no name that another column"
    ):
        read_workload(path, columns={"timestamp": "cpu_load", "cpu_load": "cpu_load"})


def test_workload_gaps_are_interpolated(tmp_path: Path) -> None:
    lines = build.with_cell(build.workload_lines(8800), 50, 1, "NaN")
    lines = build.without_rows(lines, 2001, 2010)
    series = read_workload(write(tmp_path / "w.csv", lines))
    assert "10 absent rows interpolated" in series.notes
    assert "1 rows without values interpolated" in series.notes
    middle = 0.5 * (series.values[47] + series.values[49])
    assert series.values[48] == pytest.approx(middle)


def test_design_conditions_are_those_of_the_header(tmp_path: Path) -> None:
    lines = list(build.epw_lines())
    assert read_epw(write(tmp_path / "none.epw", lines)).design is None
    lines[1] = build.DESIGN_LINE
    weather = read_epw(write(tmp_path / "some.epw", lines))
    assert weather.design == DesignConditions(32.9, 25.2, 39.0)
    assert not weather.outdoor_c.notes
    for good, bad in (("25.2,30.7", "x,30.7"), (",32.9,", ",22.9,")):
        lines[1] = build.DESIGN_LINE.replace(good, bad)
        weather = read_epw(write(tmp_path / "damaged.epw", lines))
        assert weather.design is None
        assert "design conditions of the header are not usable" in weather.outdoor_c.notes[0]


@pytest.mark.parametrize("per_hour", [1, 4])
def test_spikes_of_temperature_are_told(per_hour: int, tmp_path: Path) -> None:
    lines = list(build.epw_lines(per_hour=per_hour))
    lines[1] = build.DESIGN_LINE
    assert read_epw(write(tmp_path / "x.epw", lines)).outdoor_c.notes == ()
    around = [float(lines[at].split(",")[6]) for at in (99 - per_hour, 99 + per_hour)]
    lines[99] = ",".join([*lines[99].split(",")[:6], "55.0", *lines[99].split(",")[7:]])
    weather = read_epw(write(tmp_path / "x.epw", lines))
    (note,) = weather.outdoor_c.notes
    assert note.startswith("warning: 2 changes of the dry bulb by more than 15 K in an hour kept")
    assert note.endswith(f", up to {55.0 - min(around):.1f} K (first: row 100)")
    assert 55.0 in weather.outdoor_c.values


def test_spikes_in_a_weather_table_are_told(tmp_path: Path) -> None:
    rows = [
        f"{day} {hour:02}:00,{10 + hour / 4},50"
        for day in build.days("2021-01-01", "2022-01-01")
        for hour in range(24)
    ]
    rows[30] = rows[30].replace(",11.5,", ",-14.0,")
    place = Place("roof", 40.0, -75.0, 10.0, -5.0)
    path = write(tmp_path / "roof.csv", ["timestamp,dry_bulb,relative_humidity", *rows])
    weather = read_weather_table(path, place, columns={})
    notes = "\n".join(weather.outdoor_c.notes)
    assert "2 changes of the dry bulb by more than 15 K in an hour kept, up to 25.8 K" in notes
    assert "(first: row 32)" in notes
    assert "no design conditions: plants are sized for a dry bulb of 15." in notes


@pytest.mark.parametrize("counted_mwh", [-316.0, 0.0])
def test_an_hour_of_negative_generation_counts_as_none(counted_mwh: float, tmp_path: Path) -> None:
    """Whatever the file counts it as in its average."""
    lines, noon = build.carbon_lines(), 498
    values = dict(zip(build.CARBON_HEADER.split(","), lines[noon].split(","), strict=True))
    sun, nuclear = float(values["SUN"]), float(values["NUC"])

    def intensity(gas: float) -> float:
        carbon = 41.0 * sun + 12.0 * nuclear + 490.0 * gas
        return carbon / (sun + nuclear + gas)

    lines[noon] = ",".join(
        (values | {"NG": "-316", "avg_CI": f"{intensity(counted_mwh):.4f}"}).values()
    )
    series = read_carbon(write(tmp_path / "ci.csv", lines), 0.0, "start")
    note = "warning: 1 negative values of NG set to 0, the lowest is -316 MWh (first: row 499)"
    assert note in series.notes
    assert series.values[noon - 1] == pytest.approx(intensity(0.0), abs=1e-3)


def test_a_row_of_negative_generation_alone_is_interpolated(tmp_path: Path) -> None:
    lines = build.carbon_lines()
    lines[500] = lines[500].split(",")[0] + ",0,0,0,0,-316,0,0,0,490"
    series = read_carbon(write(tmp_path / "ci.csv", lines), 0.0, "start")
    assert series.values[499] == pytest.approx(np.mean(series.values[[498, 500]]))


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_the_header_of_weather_is_read_with_any_line_end(end: str, tmp_path: Path) -> None:
    path = write(tmp_path / "x.epw", build.epw_lines(), end)
    assert (read_city(path), read_elevation_m(path)) == ("Test.Station", 10.0)
    assert file_kind(path) == "weather"
    assert read_epw(path).elevation_m == 10.0


def test_a_pressure_that_does_not_fit_the_elevation_is_told(tmp_path: Path) -> None:
    """Tucson's file: 101 kPa at 809 m from May to September."""
    lines = list(build.epw_lines())
    lines[0] = lines[0].replace(",10.0", ",809.0")
    summer = {"5", "6", "7", "8", "9"}
    for at, line in enumerate(lines[8:], 8):
        cells = line.split(",")
        cells[9] = "101000" if cells[1] in summer else "92000"
        lines[at] = ",".join(cells)
    lines[1] = build.DESIGN_LINE
    (note,) = read_epw(write(tmp_path / "tucson.epw", lines)).outdoor_c.notes
    assert note == (
        "warning: station pressure of 101.0 kPa in May, Jun, Jul, Aug, Sep does not fit the "
        "elevation of 809 m, which has about 92.0 kPa"
    )


def test_series_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "x.parquet"
    write_parquet(path, {"x": np.arange(3.0)}, {"kind": "weather"})
    before = path.read_bytes()
    assert (read_metadata(path) or {})["kind"] == "weather"
    with pytest.raises(DataError, match=r"y\.parquet: cannot be written: "):
        write_parquet(path / "y.parquet", {"x": np.arange(3.0)}, {})
    (tmp_path / "folder").mkdir()
    with pytest.raises(DataError, match="folder: cannot be written: "):
        write_parquet(tmp_path / "folder", {"x": np.arange(3.0)}, {})
    assert [p.name for p in path.parent.iterdir()] == ["x.parquet"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "new"]
    assert path.read_bytes() == before


@pytest.mark.parametrize("state", ["AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA"])
def test_measured_files_have_the_statistics_that_years_are_fitted_to(
    state: str, real_data: Path
) -> None:
    """Only where SDC_REAL_DATA names a folder of measured files."""
    from test_exogenous_synthetic import REAL

    site = site_from_files(
        None,
        next((real_data / "weather").glob(f"USA_{state}_*.epw")),
        real_data / "carbon" / f"{state}_NG_&_avgCI.csv",
    )
    # The fitted statistics also repaired what is only warned of here, so those are wider.
    carbon = 0.05 if state in ("NY", "VA") else 5e-3
    for series, tolerance in (
        (site.outdoor_c, 1e-3), (site.wet_bulb_c, 1e-3), (site.ci_g_per_kwh, carbon)
    ):  # fmt: skip
        found = statistics(series)
        for statistic, real in REAL[series.name][state].items():
            allowed = tolerance * max(abs(real), 0.1)
            assert found[statistic] == pytest.approx(real, abs=allowed), statistic


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"utc_offset_h": 20.0}, "utc_offset_h"),
        ({"utc_offset_h": -5.0, "stamp": "middle"}, "stamp"),
        ({"utc_offset_h": -5.0, "pairing": "rows"}, "pairing"),
    ],
)
def test_arguments_that_are_not_valid(
    arguments: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=message):
        read_carbon(tmp_path / "ci.csv", **arguments)
