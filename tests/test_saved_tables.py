"""Tables that were saved by hand from the pages of services, of ``data import --map SERVICE``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import exogenous_builders as build
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import read_carbon
from sdc_taichi.exogenous.fetch.saved_tables import import_saved_tables, saved_table_services
from sdc_taichi.exogenous.series_file import read_metadata

EIA_NAMES = {
    "NG": "Net Generation (MW) from Natural Gas",
    "NUC": "Net Generation (MW) from Nuclear",
    "SUN": "Net Generation (MW) from Solar",
}
BRUSSELS = "Europe/Brussels"

pytestmark = pytest.mark.usefixtures("user_folder")


def generation(year: int = 2022) -> pd.DataFrame:
    """Sun, gas and nuclear of ``build.carbon_lines`` in MW, by the start of the hour in UTC."""
    lines = [line.split(",") for line in build.carbon_lines(f"{year}-01-01", f"{year + 1}-01-01")]
    table = pd.DataFrame(lines[1:], columns=lines[0])
    table.index = pd.to_datetime(table["timestamp"]).dt.tz_localize(None)
    return table[["SUN", "NG", "NUC"]].astype(float)


def expected_intensity(tmp_path: Path, stamp: str, year: int = 2022) -> np.ndarray:
    path = tmp_path / "expected.csv"
    path.write_text(build.text(build.carbon_lines(f"{year}-01-01", f"{year + 1}-01-01")))
    series = read_carbon(path, -5.0, "start" if stamp == "start" else "auto")
    return series.values


def eia_files(folder: Path) -> list[Path]:
    """Half years with two authorities; the second half with the columns of July 2024."""
    table, paths = generation(), []
    for half, part in (("Jan_Jun", table[: 181 * 24]), ("Jul_Dec", table[181 * 24 :])):
        rows = []
        for area, scale in (("CISO", 1.0), ("PJM", 7.0)):
            text = (
                pd.DatetimeIndex(part.index)
                .strftime("%m/%d/%Y %I:%M:%S %p")
                .str.replace(" 0", " ", regex=False)
            )
            frame = pd.DataFrame({"Balancing Authority": area, "UTC Time at End of Hour": text})
            for code, name in EIA_NAMES.items():
                values = [f"{x * scale:,.1f}" for x in part[code]]
                if half == "Jan_Jun":
                    frame[name] = values
                    frame[f"{name} (Imputed)"] = ""
                    frame[f"{name} (Adjusted)"] = values
                    continue
                split = " without Integrated Battery Storage" if code == "SUN" else ""
                frame[f"{name}{split}"] = "1"
                frame[f"{name}{split}  (Adjusted)"] = values
            if half == "Jul_Dec":
                frame["Net Generation (MW) from Pumped Storage  (Adjusted)"] = "-50"
                solar = "Net Generation (MW) from Solar with Integrated Battery Storage"
                frame[f"{solar} (Adjusted)"] = ""
            rows.append(frame)
        path = folder / f"EIA930_BALANCE_2022_{half}.csv"
        pd.concat(rows).to_csv(path, index=False)
        paths.append(path)
    return paths


def entsoe_wide(folder: Path, header: str = "MTU", zone: str = "UTC") -> list[Path]:
    """A year in columns, as the platform has had them, of hours in UTC or in Brussels."""
    table = generation()
    starts = (
        pd.DatetimeIndex(table.index)
        .tz_localize("UTC")
        .tz_convert(BRUSSELS if zone != "UTC" else "UTC")
    )
    ends = starts + pd.Timedelta(1, "h")
    frame = pd.DataFrame(
        {
            "Area": "BZN|DE-LU",
            header: [
                f"{a:%d.%m.%Y %H:%M} - {b:%d.%m.%Y %H:%M}{' (UTC)' if zone == 'UTC' else ''}"
                for a, b in zip(starts, ends, strict=True)
            ],
            "Biomass  - Actual Aggregated [MW]": "n/e",
            "Fossil Gas  - Actual Aggregated [MW]": table["NG"].to_numpy(),
            "Hydro Pumped Storage  - Actual Aggregated [MW]": "-",
            "Hydro Pumped Storage  - Actual Consumption [MW]": "12",
            "Nuclear  - Actual Aggregated [MW]": table["NUC"].to_numpy(),
            "Solar  - Actual Aggregated [MW]": table["SUN"].to_numpy(),
        }
    )
    path = folder / "generation.csv"
    frame.to_csv(path, index=False)
    return [path]


def entsoe_long(folder: Path) -> list[Path]:
    """A year of quarter hours with a row for each type, and marks where clocks go back."""
    table = generation()
    quarters = table.reindex(
        pd.date_range(table.index[0], periods=len(table) * 4, freq="15min")
    ).ffill()
    starts = pd.DatetimeIndex(quarters.index).tz_localize("UTC").tz_convert(BRUSSELS)
    ends = starts + pd.Timedelta(15, "min")
    wall = starts.tz_localize(None)
    twice = wall.duplicated(keep=False)

    def stamp(at: pd.Timestamp, *, marked: bool) -> str:
        return f"{at:%d/%m/%Y %H:%M:%S}" + (f" ({at.tzname()})" if marked else "")

    text = [
        f"{stamp(a, marked=bool(m))} - {stamp(b, marked=bool(m))}"
        for a, b, m in zip(starts, ends, twice, strict=True)
    ]
    parts = [
        pd.DataFrame(
            {
                "MTU (CET/CEST)": text,
                "Area": "BZN|DE-LU",
                "Production Type": kind,
                "Generation (MW)": quarters[code].to_numpy(),
            }
        )
        for code, kind in (("NG", "Fossil Gas"), ("NUC", "Nuclear"), ("SUN", "Solar"))
    ]
    path = folder / "AGGREGATED_GENERATION_PER_TYPE.csv"
    pd.concat(parts).to_csv(path, index=False)
    return [path]


def watttime(folder: Path) -> list[Path]:
    """Two months of a year in each file, of five minutes, with the columns of version 3."""
    stamps = pd.date_range("2022-01-01", "2023-01-01", freq="5min", inclusive="left")
    values = np.round(800 + 200 * np.sin(np.arange(stamps.size) / 500), 3)
    paths = []
    for month in range(1, 13, 2):
        chosen = (stamps.month == month) | (stamps.month == month + 1)
        path = folder / f"CAISO_NORTH_{month:02d}.csv"
        text = stamps[chosen].strftime("%Y-%m-%dT%H:%M:%S+00:00")
        pd.DataFrame({"point_time": text, "value": values[chosen]}).to_csv(path, index=False)
        paths.append(path)
    return paths[::-1]


def electricity_maps(folder: Path) -> list[Path]:
    hours = pd.date_range("2021-01-01", "2023-01-01", freq="h", inclusive="left")
    values = np.arange(hours.size) % 500
    paths = []
    for year in (2022, 2021):
        chosen = hours.year == year
        path = folder / f"FR_{year}_hourly.csv"
        columns = {
            "Datetime (UTC)": hours[chosen].strftime("%Y-%m-%d %H:%M:%S"),
            "Carbon intensity gCO₂eq/kWh (direct)": 1.0,
            "Carbon intensity gCO₂eq/kWh (Life cycle)": values[chosen],
        }
        pd.DataFrame(columns).to_csv(path, index=False)
        paths.append(path)
    return paths


MADE: dict[str, Callable[[Path], list[Path]]] = {
    "electricity-maps": electricity_maps,
    "eia-930": eia_files,
    "entsoe": entsoe_wide,
    "watttime": watttime,
}


def imported(paths: list[Path], service: str, area: str | None = None) -> np.ndarray:
    item = import_saved_tables(paths, service, "x", area=area, utc_offset_h=-5.0)
    return read_carbon(item.target, -5.0).values


def test_half_years_of_eia(tmp_path: Path) -> None:
    item = import_saved_tables(
        eia_files(tmp_path)[::-1],
        "eia-930",
        "x",
        area="ciso",
        utc_offset_h=-5.0,
    )
    expected = expected_intensity(tmp_path, "auto")
    np.testing.assert_allclose(read_carbon(item.target, -5.0).values, expected, atol=2e-3)
    notes = " ".join(item.notes)
    assert "PS (storage) left out" in notes
    assert "stamps mark the end of the interval (solar noon)" in notes


@pytest.mark.parametrize("layout", ["utc", "header", "cell"])
def test_columns_of_the_transparency_platform(layout: str, tmp_path: Path) -> None:
    if layout == "utc":
        paths = entsoe_wide(tmp_path)
    else:
        header = "MTU (CET/CEST)" if layout == "header" else "MTU"
        paths = entsoe_wide(tmp_path, header, "CET/CEST")
    expected = expected_intensity(tmp_path, "start")
    np.testing.assert_allclose(imported(paths, "entsoe"), expected, atol=2e-3)


def test_rows_of_the_transparency_platform(tmp_path: Path) -> None:
    paths = entsoe_long(tmp_path)
    expected = expected_intensity(tmp_path, "start")
    found = imported(paths, "entsoe", "DE-LU")
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_years_of_electricity_maps_are_joined(tmp_path: Path) -> None:
    paths = electricity_maps(tmp_path)
    item = import_saved_tables(paths, "electricity-maps", "x", utc_offset_h=0.0)
    values = read_carbon(item.target, 0.0).values
    np.testing.assert_array_equal(values, np.arange(2 * 8760) % 500)


@pytest.mark.parametrize("service", saved_table_services())
def test_origin_and_source_are_kept(service: str, tmp_path: Path) -> None:
    paths = MADE[service](tmp_path)
    area = "CISO" if service == "eia-930" else None
    item = import_saved_tables(paths, service, "x", area=area, utc_offset_h=-5.0)
    origin = (read_metadata(item.target) or {})["origin"]
    assert origin["service"] == saved_table_services()[service].title
    assert [each["file"] for each in origin["downloads"]] == [path.name for path in paths]
    assert all(len(each["sha256"]) == 64 for each in origin["downloads"])


def damage(path: Path, old: str, new: str, count: int = 1) -> None:
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new, count), "utf-8")


@pytest.mark.parametrize(
    ("service", "old", "new", "message"),
    [
        ("eia-930", "02/01/2022 5:00:00 AM", "2022-02-01 05:00", r"row \d+, column UTC Time at"),
        ("eia-930", "02/01/2022 5:00:00 AM", "02/01/2022 4:00:00 AM", "04:00:00 UTC comes twice"),
        (
            "eia-930",
            '"8,000.0",,"8,000.0"',
            '"8,000.0",,many',
            "column Net Generation .* 'many', expected a number",
        ),
        (
            "eia-930",
            "Natural Gas (Adj",
            "Fairy Dust (Adj",
            "type of generation 'Fairy Dust', expected",
        ),
        ("eia-930", "UTC Time at End of Hour", "UTC", "expected UTC Time at End of Hour"),
        ("entsoe", "02.01.2022 05:00 - ", "2022-01-02 05:00 - ", r"row 31, column MTU: .*interval"),
        ("entsoe", "02.01.2022 05:00 - ", "02.13.2022 05:00 - ", "row 31, .*a day of the calendar"),
        ("entsoe", "02.01.2022 05:00 - ", "02.01.2022 05:10 - ", "steps of 60 min, expected"),
        ("entsoe", "Nuclear  -", "Nuklear  -", "type of generation 'Nuklear', .*did you mean"),
        ("watttime", "2022-11-02T00:05:00+00:00", "soon", "row 291, column point_time: 'soon'"),
        ("watttime", "point_time,value", "time,value", "expected point_time, value or timestamp"),
        ("electricity-maps", "Datetime (UTC)", "When", "expected 'Datetime .UTC.'"),
    ],
)
def test_damaged_tables(
    service: str, old: str, new: str, message: str, tmp_path: Path, user_folder: Path
) -> None:
    paths = MADE[service](tmp_path)
    damage(paths[0], old, new)
    with pytest.raises(DataError, match=message):
        imported(paths, service, "CISO" if service == "eia-930" else None)
    assert not list(user_folder.rglob("*.parquet"))


@pytest.mark.parametrize(
    ("service", "area", "message"),
    [
        ("eia-930", None, "column Balancing Authority: expected --area to be one of CISO, PJM"),
        ("eia-930", "MISO", "expected --area 'MISO' to be one of CISO, PJM"),
        ("watttime", "CISO", "--area 'CISO': a file of this service holds one area"),
        ("entsoe", "FR", "expected --area 'FR' to be one of BZN|DE-LU"),
        ("entso-e", None, "did you mean 'entsoe'"),
    ],
)
def test_areas(service: str, area: str | None, message: str, tmp_path: Path) -> None:
    paths = MADE.get(service, entsoe_wide)(tmp_path)
    with pytest.raises(DataError, match=message.replace("|", r"\|")):
        imported(paths, service, area)


def test_months_of_watttime_are_joined(tmp_path: Path) -> None:
    paths = watttime(tmp_path)
    item = import_saved_tables(paths, "watttime", "x", utc_offset_h=0.0)
    series = read_carbon(item.target, 0.0)
    stamps = np.arange(365 * 288)
    expected = 0.45359237 * np.round(800 + 200 * np.sin(stamps / 500), 3)
    assert series.minutes == 5.0
    np.testing.assert_allclose(series.values, expected, atol=1e-3)
    assert any("marginal intensity" in note for note in item.notes)
