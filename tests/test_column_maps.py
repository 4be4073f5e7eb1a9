"""``data import --map``: columns of other names and units, and weather in tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import Result

import exogenous_builders as build
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import load_site, read_carbon, read_epw, read_workload
from sdc_taichi.exogenous.columns import column_map
from sdc_taichi.exogenous.weather_table import Place, read_weather_table

PLACE = Place("roof", 40.7, -75.0, 10.0, -5.0)
STATION = ("--latitude", "40.7", "--longitude", "-75", "--elevation", "10", "--utc-offset", "-5")
WEATHER = ("timestamp=when", "dry_bulb:F=t", "dew_point:F=td", "pressure:inHg=p")


def run(*arguments: str) -> Result:
    return build.run_data("import", *arguments)


def maps(*mapped: str) -> list[str]:
    return [part for text in mapped for part in ("--map", text)]


# Units


@pytest.mark.parametrize(
    ("name", "unit", "value", "expected"),
    [
        # NIST Special Publication 811 and the definitions of the scales.
        ("avg_CI", "lb/MWh", 1000.0, 453.59237),
        ("avg_CI", "kg/kWh", 0.4, 400.0),
        ("avg_CI", "t/MWh", 0.4, 400.0),
        ("avg_CI", "kg/MWh", 400.0, 400.0),
        ("avg_CI", "g/MJ", 100.0, 360.0),
        ("dry_bulb", "F", 212.0, 100.0),
        ("dry_bulb", "F", -40.0, -40.0),
        ("dew_point", "K", 273.15, 0.0),
        ("relative_humidity", "1", 0.5, 50.0),
        ("pressure", "hPa", 1013.25, 101325.0),
        ("pressure", "inHg", 29.92126, 101325.0),
        ("pressure", "mmHg", 760.0, 101325.0),
        ("cpu_load", "%", 50.0, 0.5),
        ("cpu_load", "kW,120..800", 120.0, 0.0),
        ("cpu_load", "kW,120..800", 800.0, 1.0),
        ("cpu_load", "MW,0..2.5", 0.5, 0.2),
        ("WND", "kW", 1500.0, 1.5),
        ("NUC", "GWh", 1.5, 1500.0),
    ],
)
def test_units(name: str, unit: str, value: float, expected: float) -> None:
    found = column_map({f"{name}:{unit}": "column"}).unit(name)
    assert found.convert(value) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert found.invert(found.convert(value)) == pytest.approx(value, rel=1e-12, abs=1e-9)
    assert found.convert(np.array([value])) == pytest.approx([expected], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("avg_CI:lbs/MWh", "did you mean 'lb/MWh'"),
        ("avg_CI:", "column avg_CI: unit '', expected one of g/kWh, kg/MWh"),
        ("dry_bulb:Fahrenheit", "expected one of C, F, K"),
        ("timestamp:UTC", "column timestamp: unit 'UTC', expected none"),
        ("cpu_load:kW", "kW,120..800"),
        ("cpu_load:kW,800..120", "kW,120..800"),
        ("cpu_load:kW,x..120", "kW,120..800"),
        ("drybulb", "did you mean 'dry_bulb'"),
    ],
)
def test_units_that_are_not_known(key: str, message: str) -> None:
    with pytest.raises(DataError, match=message.replace(".", r"\.")):
        column_map({key: "column"})


def test_carbon_and_workload_in_other_units(tmp_path: Path, user_folder: Path) -> None:
    plain = tmp_path / "plain.csv"
    plain.write_text(build.text(build.carbon_lines()))
    expected = read_carbon(plain, -5.0).values
    rows = [line.split(",") for line in build.carbon_lines()[1:]]
    table = tmp_path / "pounds.csv"
    table.write_text(
        build.text(
            [
                "when,rate,unused",
                *(f"{row[0]},{float(row[-1]) / 0.45359237:.9f},x" for row in rows),
            ]
        )
    )
    columns = {"timestamp": "when", "avg_CI:lb/MWh": "rate"}
    series = read_carbon(table, -5.0, "end", columns=columns)
    np.testing.assert_allclose(series.values, expected, rtol=1e-8)
    assert "rate read as avg_CI, in lb/MWh" in series.notes

    power = tmp_path / "power.csv"
    load = [float(line.split(",")[-1]) for line in build.workload_lines()[1:]]
    power.write_text(build.text(["IT power [kW]", *(f"{120 + 680 * x:.9f}" for x in load)]))
    done = run(str(power), "--site", "hall", *maps("cpu_load:kW,120..800=IT power [kW]"))
    assert "IT power [kW] read as cpu_load, in kW,120..800" in done.output
    stored = read_workload(user_folder / "traces" / "hall.parquet")
    np.testing.assert_allclose(stored.values, load, rtol=1e-8)


@pytest.mark.parametrize("end", ["\r", "\r\n", "\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_any_line_end_is_read(end: str, mark: str, tmp_path: Path, user_folder: Path) -> None:
    lines = build.carbon_lines()
    lines[0] = mark + lines[0].replace("avg_CI", '"rate, g/kWh"')
    table = tmp_path / "table.csv"
    table.write_bytes(end.join(lines).encode())
    columns = maps("avg_CI=rate, g/kWh")
    result = run(str(table), "--site=here", "--base=NY", *columns)
    assert result.exit_code == 0, result.output
    plain = tmp_path / "plain.csv"
    plain.write_text(build.text(build.carbon_lines()))
    stored = load_site("here").ci_g_per_kwh.values
    np.testing.assert_array_equal(stored, read_carbon(plain, -5.0).values)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_columns_of_one_name_are_refused(suffix: str, tmp_path: Path) -> None:
    rows = [line.split(",") for line in build.workload_lines()[1:]]
    path = tmp_path / f"load{suffix}"

    def write(*header: str) -> None:
        cells = [[*row, row[-1]][: len(header)] for row in rows]
        if suffix == ".csv":
            path.write_text(build.text([",".join(row) for row in ([*header], *cells)]))
        else:
            arrays = [pa.array(column) for column in zip(*cells, strict=True)]
            pq.write_table(pa.Table.from_arrays(arrays, list(header)), path)

    write("", "cpu_load", "cpu_load")
    twice = r"row 1: columns 2 and 3 are both named 'cpu_load', expected each name once"
    with pytest.raises(DataError, match=twice):
        read_workload(path)
    write("", "load", "load")
    with pytest.raises(DataError, match="columns 2 and 3 are both named 'load'"):
        read_workload(path, columns={"cpu_load": "load"})
    write("flag", "load", "flag")
    with pytest.raises(DataError, match="columns 1 and 3 are both named 'flag'"):
        read_workload(path)


def test_other_columns_may_share_a_name(tmp_path: Path) -> None:
    path = tmp_path / "load.csv"
    rows = [f"{line},ok,ok" for line in build.workload_lines()[1:]]
    path.write_text(build.text([",load,state,state", *rows]))
    assert read_workload(path, columns={"cpu_load": "load"}).values.size == 8760


def test_errors_are_in_the_unit_of_the_file(tmp_path: Path) -> None:
    power = tmp_path / "power.csv"
    power.write_text(build.text(["kW", "119", *["400"] * 8759]))
    with pytest.raises(DataError, match=r"row 2, column cpu_load: '119', .* from 120 to 800 kW"):
        read_workload(power, columns={"cpu_load:kW,120..800": "kW"})
    table = tmp_path / "ci.csv"
    hours = [f"2022-01-01 {hour:02d}:00+00:00,9000" for hour in range(5)]
    table.write_text(build.text(["timestamp,ci", *hours]))
    with pytest.raises(DataError, match=r"'9000', expected a number from 0 to 4409.25 lb/MWh"):
        read_carbon(table, 0.0, columns={"avg_CI:lb/MWh": "ci"})


# Weather in tables


def weather_lines(stamp: str = "{day} {hour:02d}:00:00", humidity: bool = False) -> list[str]:
    """The weather of ``build.epw_lines`` in degrees Fahrenheit and inches of mercury."""
    lines = ["when,t,rh,p" if humidity else "when,t,td,p"]
    for line in build.epw_lines()[8:]:
        year, month, day, hour, *_, dry, dew, percent, pascal = line.split(",")[:10]
        at = stamp.format(day=f"{year}-{int(month):02d}-{int(day):02d}", hour=int(hour) - 1)
        second = f"{int(percent) / 100}" if humidity else f"{float(dew) * 1.8 + 32:.6f}"
        lines.append(f"{at},{float(dry) * 1.8 + 32:.6f},{second},{float(pascal) / 3386.389:.8f}")
    return lines


def test_a_table_equals_the_epw_file_of_the_same_weather(tmp_path: Path) -> None:
    epw, table = tmp_path / "a.epw", tmp_path / "a.csv"
    epw.write_text(build.text(build.epw_lines()))
    table.write_text(build.text(weather_lines(humidity=True)))
    expected = read_epw(epw)
    columns = {
        "timestamp": "when",
        "dry_bulb:F": "t",
        "relative_humidity:1": "rh",
        "pressure:inHg": "p",
    }
    found = read_weather_table(table, PLACE, columns=columns)
    for name in ("outdoor_c", "wet_bulb_c", "relative_humidity_pct", "pressure_pa"):
        series = getattr(found, name)
        np.testing.assert_allclose(series.values, getattr(expected, name).values, atol=2e-3)
        assert (series.minutes, series.source, series.synthetic) == (60.0, "a.csv", False)
    assert (found.latitude_deg, found.utc_offset_h, found.label) == (40.7, -5.0, "roof")


def test_stamps_with_an_offset_are_moved(tmp_path: Path) -> None:
    local, moved, late = (tmp_path / f"{name}.csv" for name in ("local", "moved", "late"))
    local.write_text(build.text(weather_lines()))
    moved.write_text(build.text(weather_lines("{day}T{hour:02d}:00:00-05:00")))
    utc = weather_lines()
    stamps = np.datetime64("2021-01-01T06") + np.arange(8760)
    rows = [f"{at}:00Z,{line.split(',', 1)[1]}" for at, line in zip(stamps, utc[1:], strict=True)]
    late.write_text(build.text([utc[0], *rows]))
    columns = dict(text.split("=") for text in WEATHER)
    expected = read_weather_table(local, PLACE, columns=columns)
    same = read_weather_table(moved, PLACE, columns=columns)
    np.testing.assert_array_equal(same.outdoor_c.values, expected.outdoor_c.values)
    ends = read_weather_table(late, PLACE, columns=columns, stamp="end")
    np.testing.assert_array_equal(ends.outdoor_c.values, expected.outdoor_c.values)


@pytest.mark.parametrize(
    ("row", "cell", "value", "message"),
    [
        (5, 0, "01/02/2021 03:00", "row 5, column timestamp: '01/02/2021 03:00', expected a time"),
        (5, 0, "2021-01-01 03:00+00:00", "row 5, column timestamp: .*a UTC offset in each row"),
        (9, 0, "2021-01-01 06:00:00", "row 9, column timestamp: .*a stamp not seen before"),
        (7, 1, "200", "row 7, column dry_bulb: '200', expected a number from -130 to 140 F"),
        (7, 1, "warm", "row 7, column dry_bulb: 'warm'"),
        (7, 2, "120", "row 7, column dew_point: .*at most the dry bulb"),
        (7, 3, "101325", "row 7, column pressure: '101325', .* inHg"),
    ],
)
def test_damaged_weather_tables(
    row: int, cell: int, value: str, message: str, tmp_path: Path
) -> None:
    table = tmp_path / "a.csv"
    lines = weather_lines()
    cells = lines[row - 1].split(",")
    cells[cell] = value
    lines[row - 1] = ",".join(cells)
    table.write_text(build.text(lines))
    columns = dict(text.split("=") for text in WEATHER)
    with pytest.raises(DataError, match=message):
        read_weather_table(table, PLACE, columns=columns)


def test_degrees_fahrenheit_are_not_taken_for_celsius(tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text(build.text(weather_lines()))
    columns = {"timestamp": "when", "dry_bulb": "t", "dew_point": "td"}
    with pytest.raises(DataError, match=r"to 60 C \(degrees Fahrenheit are read with --map"):
        read_weather_table(table, PLACE, columns=columns)


def test_gaps_and_leap_days(tmp_path: Path) -> None:
    lines = weather_lines()
    table = tmp_path / "a.csv"
    table.write_text(build.text([*lines[:100], *lines[103:500], *lines[500:]]))
    columns = dict(text.split("=") for text in WEATHER)
    weather = read_weather_table(table, PLACE, columns=columns)
    assert weather.outdoor_c.values.size == 8760
    assert "3 absent rows interpolated" in weather.outdoor_c.notes
    table.write_text(build.text([*lines[:100], *lines[130:]]))
    with pytest.raises(DataError, match=r"row 101, .*gaps of at most 24 h, not 30 h"):
        read_weather_table(table, PLACE, columns=columns)
    table.write_text(build.text(lines[:5000]))
    with pytest.raises(DataError, match=r"expected at least 8760 \(365 days\)"):
        read_weather_table(table, PLACE, columns=columns)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (maps(*WEATHER), "expected --latitude, --longitude, --elevation, --utc-offset"),
        ([*maps(*WEATHER), *STATION[2:]], "a weather table, expected --latitude of its station"),
        ([*maps(*WEATHER), "--latitude", "99", *STATION[2:]], "latitude: 99, expected -90 to 90"),
        ([*maps("timestamp=when", "dry_bulb:F=t"), *STATION], "missing column dew_point"),
        (maps("dry_bulb:F=T"), "dry_bulb"),
        (maps("dry_bulb:F=t", "dry_bulb=t"), "each name once"),
        (maps("dry_bulb:X=t"), "--map: column dry_bulb: unit 'X', expected one of C, F, K"),
        ([*maps(*WEATHER), "--area", "DE"], "--area DE: only tables of a service"),
    ],
)
def test_weather_tables_that_say_too_little(
    arguments: list[str], message: str, tmp_path: Path, user_folder: Path
) -> None:
    table = tmp_path / "roof.csv"
    table.write_text(build.text(weather_lines()[:50]))
    with pytest.raises(DataError, match=message):
        run(str(table), "--site", "roof", *arguments)
    assert not user_folder.exists()
