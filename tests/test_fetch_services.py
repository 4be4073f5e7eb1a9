"""Data of services become sites: formats, units, clocks, origin, and what is wrong in one line."""

from __future__ import annotations

import io
import json
import logging
import re
import zipfile
from collections.abc import Callable, Iterator
from datetime import date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner, Result

import service_answers
from exogenous_builders import epw_lines, text
from faulty_server import Answer, sends, serving
from sdc_taichi.cli.app import app
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import load_site, series_file
from sdc_taichi.exogenous.fetch.download import MOST_DOWNLOAD_BYTES
from sdc_taichi.exogenous.fetch.exchange import Patience
from sdc_taichi.exogenous.fetch.generation import (
    MOST_EIA_ROWS,
    Period,
    carbon_table,
    eia_rows,
    read_generation,
    year_of_requests,
)
from sdc_taichi.exogenous.fetch.services import STORAGE, services
from sdc_taichi.exogenous.fetch.weather import typical_year
from sdc_taichi.exogenous.synthetic import FUELS, emission_factors
from service_answers import (
    eia,
    eia_document,
    electricity_maps_table,
    entsoe,
    entsoe_acknowledgement,
    entsoe_document,
    entsoe_series,
    pvgis_year,
    solar_mwh,
)

KEY = "0123456789abcdef"


@pytest.fixture(autouse=True)
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of imported files, empty; keys are set, and failures come soon."""
    folder = tmp_path / "data"
    monkeypatch.setenv("SDC_TAICHI_DATA", str(folder))
    monkeypatch.setenv("EIA_API_KEY", KEY)
    monkeypatch.setenv("ENTSOE_API_KEY", KEY)
    quick = Patience(attempts=2, first_wait_s=0.01)
    monkeypatch.setattr("sdc_taichi.exogenous.fetch.download.Patience", lambda: quick)
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Result]]:
    """Runs ``data fetch`` with a server in place of the services; None is no answer."""
    with serving() as server:
        for name, service in services().items():
            here = service.model_copy(update={"address": server.url})
            monkeypatch.setitem(services(), name, here)

        def fetch(answer: Answer | None, *args: str) -> Result:
            server.answers = [answer or (lambda request: None)]
            words = [x.replace("SERVER", server.url) for x in args]
            return CliRunner().invoke(app, ["data", "fetch", *words])

        yield fetch


def error(result: Result) -> str:
    """The one line of an input error, which shows no key."""
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    assert KEY not in line
    return line


def metadata(data_dir: Path, part: str, site: str = "here") -> dict[str, Any]:
    found = series_file.read_metadata(data_dir / "sites" / site / f"{part}.parquet")
    assert found is not None
    return found


# PVGIS

PVGIS = ("pvgis", "--latitude=45", "--longitude=8", "--site=here", "--base=NY")


def pvgis_answer(change: Callable[[dict[str, Any]], object] = lambda year: None) -> bytes:
    year = pvgis_year()
    change(year)
    return json.dumps(year).encode()


def test_typical_year_becomes_a_site(run: Callable[..., Result], data_dir: Path) -> None:
    result = run(sends(pvgis_answer()), *PVGIS, "--utc-offset=1")
    assert result.exit_code == 0, result.output
    site = load_site("here")
    assert (site.latitude_deg, site.longitude_deg, site.elevation_m) == (45.0, 8.0, 250.0)
    assert site.utc_offset_h == 1.0
    # Hour h of local time is hour h-1 of UTC.
    expected = np.roll(np.arange(8760) / 1000.0, 1)
    np.testing.assert_allclose(site.outdoor_c.values, expected, atol=0.0051)
    assert site.pressure_pa is not None
    assert site.pressure_pa.values[1] == 99920.0
    found = metadata(data_dir, "weather")
    (download,) = found["origin"]["downloads"]
    assert download["url"].endswith("?lat=45.0000&lon=8.0000&outputformat=json")
    assert set(download) == {"url", "retrieved", "sha256"}
    assert "CC BY 4.0" in found["origin"]["licence"]
    assert "moved from UTC to local standard time" in found["notes"]
    assert site.outdoor_c.source.startswith("PVGIS 5.3, European Commission")
    assert any(note.startswith("licence: CC BY 4.0") for note in site.outdoor_c.notes)
    again = run(None, *PVGIS, "--utc-offset=1")
    assert again.exit_code == 0, again.output


def test_half_hours_are_interpolated() -> None:
    year = json.dumps(pvgis_year(20.0, 77.0)).encode()
    table, place = typical_year(year, "url", 5.5)
    assert (place.latitude_deg, place.longitude_deg, place.utc_offset_h) == (20.0, 77.0, 5.5)
    dry_bulb = pd.read_csv(io.BytesIO(table))["dry_bulb"]
    # Local 06:00 is 00:30 UTC, between the rows of 00:00 and 01:00.
    assert dry_bulb[6] == pytest.approx(0.0005, abs=0.005)
    # Local 00:00 is 18:30 UTC of 31 December.
    assert dry_bulb[0] == pytest.approx((8754 + 8755) / 2000.0, abs=0.005)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda year: year["outputs"]["tmy_hourly"].pop(), "8759 rows in tmy_hourly"),
        (lambda year: year["outputs"]["tmy_hourly"].reverse(), "row 1 of tmy_hourly: time(UTC)"),
        (
            lambda year: year["outputs"]["tmy_hourly"][7].update(T2m=None),
            "row 8 of tmy_hourly: T2m",
        ),
        (lambda year: year["outputs"]["tmy_hourly"][7].update(SP="high"), "expected a number"),
        (lambda year: year["outputs"]["tmy_hourly"][7].pop("RH"), "RH"),
        (lambda year: year["inputs"]["location"].update(latitude=46), "latitude 46, expected 45"),
        (lambda year: year.pop("inputs"), "no 'inputs', expected a typical year"),
        (lambda year: year["outputs"].update(tmy_hourly={}), "expected a typical year of PVGIS"),
    ],
)
def test_a_wrong_typical_year_is_one_line(
    run: Callable[..., Result],
    data_dir: Path,
    change: Callable[[dict[str, Any]], object],
    message: str,
) -> None:
    assert message in error(run(sends(pvgis_answer(change)), *PVGIS, "--utc-offset=1"))
    assert not data_dir.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--utc-offset=-8",), "about +1 at longitude 8"),
        (("--utc-offset=15",), "--utc-offset 15"),
        (("--utc-offset=nan",), "--utc-offset nan"),
        (("--utc-offset=1", "--latitude=91"), "--latitude 91: expected -90 to 90"),
        (("--utc-offset=1", "--longitude=nan"), "--longitude nan"),
        (("--utc-offset=1", "--site=NY"), "is the embedded synthetic one"),
        (("--utc-offset=1", "--site=../x"), "expected 1 to 64 letters"),
        (("--utc-offset=1", "--base=XX"), "expected one of AZ"),
        (("--utc-offset=1", "--file=none.json"), "no such file"),
    ],
)
def test_bad_options_are_found_before_any_download(
    run: Callable[..., Result], options: tuple[str, ...], message: str
) -> None:
    assert message in error(run(None, *PVGIS, *options))


def test_without_a_network_a_file_saved_by_hand_serves(
    run: Callable[..., Result], tmp_path: Path
) -> None:
    line = error(run(None, *PVGIS, "--utc-offset=1"))
    assert "by hand: save http://" in line
    assert "--file FILE" in line
    saved = tmp_path / "saved.json"
    saved.write_bytes(pvgis_answer())
    assert run(None, *PVGIS, "--utc-offset=1", f"--file={saved}").exit_code == 0
    assert run(None, *PVGIS, "--utc-offset=1").exit_code == 0


# EPW


def archive(**files: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in files.items():
            # The bytes name the tests: a time of day would name them otherwise in each process.
            entry = zipfile.ZipInfo(name.replace("_epw", ".epw"))
            made.writestr(entry, content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


EPW = text(epw_lines()).encode()


@pytest.mark.parametrize("content", [EPW, archive(Station_epw=EPW, Station_stat=b"x")])
def test_weather_by_address(run: Callable[..., Result], data_dir: Path, content: bytes) -> None:
    args = ("epw", "--site=here", "--base=NY")
    answer = sends(content, kind="application/octet-stream")
    result = run(answer, *args, "SERVER/a/USA_NY_Station%20x.zip?v=1")
    assert result.exit_code == 0, result.output
    assert load_site("here").label == "Test.Station, NY, USA"
    url = metadata(data_dir, "weather")["origin"]["downloads"][0]["url"]
    assert url.endswith("/a/USA_NY_Station%20x.zip")
    assert run(None, *args, f"{url}?v=1").exit_code == 0
    assert "no connection" in error(run(None, *args, f"{url}?v=2"))


def test_a_token_in_an_address_goes_nowhere(
    run: Callable[..., Result], data_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    token, other = "hunter-2", "3f1c9a0b7e5d4c21aa"
    lines = list(epw_lines())
    lines[5] = f"COMMENTS 1,from /x.epw?token={token}&x={other}"
    epw = text(lines).encode()
    address = f"SERVER/x.epw?token={token}&x={other}&v=1#{token}"
    outputs = []
    for content in (epw, archive(Station_epw=epw)):
        result = run(sends(content), "epw", "--site=here", address, "--refresh")
        assert result.exit_code == 0, result.output
        outputs.append(result.output)
    for answer in (
        sends(json.dumps({"message": f"no {token}"}).encode(), 403),
        sends(f"{token} is no EPW file".encode()),
        sends(b"", 302, Location=f"http://example.invalid/{other}"),
        sends(archive(**{f"{token}_epw": EPW, "b_epw": EPW})),
        None,
    ):
        outputs.append(error(run(answer, "epw", "--site=here", address, "--refresh")))
    outputs.append(error(run(None, "epw", "--site=here", address.replace("SERVER", "ftp://a"))))
    stored = b"".join(path.read_bytes() for path in data_dir.rglob("*") if path.is_file())
    names = [path.name for path in data_dir.rglob("*")]
    for secret in (token, other):
        assert secret not in " ".join([*outputs, *names, caplog.text])
        assert secret.encode() not in stored


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (archive(a_epw=EPW, b_epw=EPW), "a.epw, b.epw; expected one"),
        (archive(a_stat=b"x"), "none; expected one"),
        (archive(a_epw=b"x"), "begins with 'x', expected an EPW file"),
        (archive(a_epw=EPW)[:-40], "cannot be read as a ZIP archive"),
        (
            archive(a_epw=EPW).replace(b"a.epw", b"a.epw", 1)[:500],
            "cannot be read as a ZIP archive",
        ),
        (archive(a_epw=bytes(MOST_DOWNLOAD_BYTES + 1)), "more than 64.0 MB"),
        (b"timestamp,x\n", "expected an EPW file"),
        (b"", "expected an EPW file"),
        (b"<!doctype html>", "an HTML page"),
    ],
)
def test_what_is_no_weather_is_one_line(
    run: Callable[..., Result], data_dir: Path, content: bytes, message: str
) -> None:
    assert message in error(run(sends(content), "epw", "--site=here", "SERVER/x.epw"))
    assert not data_dir.exists()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("file:///etc/passwd", "begins with https://"),
        ("station.epw", "begins with https://"),
        ("https://[::1/x.epw", "begins with https://"),
        ("https://a b/x.epw", "expected an address"),
        ("https://me:hidden@example.org/x.epw", "without"),
    ],
)
def test_what_is_no_address_is_one_line(run: Callable[..., Result], url: str, message: str) -> None:
    line = error(run(None, "epw", url, "--site=here"))
    assert message in line
    assert "hidden" not in line


# EIA-930

EIA = ("eia-930", "ciso", "--year=2023", "--site=here", "--base=CA")


def average_ci(sun: np.ndarray) -> np.ndarray:
    """Intensity of the generation of ``service_answers``, by its sun."""
    factors = emission_factors()
    known = {"COL": 500.0, "NG": 3000.0, "NUC": 2000.0, "WND": 800.0}
    carbon = sum(factors[x] * mwh for x, mwh in known.items()) + factors["SUN"] * sun
    return np.asarray(carbon / (sum(known.values()) + sun))


def test_generation_becomes_carbon_intensity(run: Callable[..., Result], data_dir: Path) -> None:
    result = run(eia(), *EIA)
    assert result.exit_code == 0, result.output
    series = load_site("here").ci_g_per_kwh
    assert series.values.size == 8760
    assert "stamps mark the end of the interval (solar noon)" in series.notes
    # By local standard time: the hour from h to h + 1 ends at h + 1.
    hours = pd.date_range("2023-01-01 01:00", periods=8760, freq="h")
    sun = np.array([solar_mwh(x.to_pydatetime(), 0.0) for x in hours])
    np.testing.assert_allclose(series.values, average_ci(sun), atol=0.01)
    found = metadata(data_dir, "carbon")
    assert len(found["origin"]["downloads"]) == 36
    assert found["origin"]["licence"].startswith("public domain")
    assert found["source_file"] == "CISO_2023.csv"
    for path in data_dir.rglob("*"):
        assert path.is_dir() or KEY.encode() not in path.read_bytes()
    again = run(None, *EIA)
    assert again.exit_code == 0, again.output


def changed_rows(rows: list[dict[str, Any]]) -> None:
    """Storage, a new source, negative and missing values, all in the first part of the year."""
    first = rows[0]
    if first["period"] != "2023-01-01T00":
        return
    rows.append(first | {"fueltype": "BAT", "value": "900"})
    rows.append(first | {"fueltype": "SNB", "value": "100"})
    rows.append(first | {"fueltype": "XYZ", "value": "1"})
    rows[1]["value"] = -5
    rows[7]["value"] = None


def test_odd_rows_are_noted(run: Callable[..., Result]) -> None:
    result = run(eia(changed_rows), *EIA)
    assert result.exit_code == 0, result.output
    for note in (
        "BAT (storage) left out",
        "SNB counts as SUN",
        "warning: type XYZ is not known and counts as OTH",
        "1 negative values of NG set to 0",
        "SNB is not reported for 8759 h, which count as 0",
        "rows without values interpolated",
    ):
        assert note in result.output


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.clear(), "no rows, expected a balancing authority"),
        (lambda rows: rows[3].update({"value-units": "MW"}), "row 4, column value-units: 'MW'"),
        (lambda rows: rows[3].update(period="2023-01-01"), "row 4, column period: '2023-01-01'"),
        (lambda rows: rows[3].update(period="2023-13-01T00"), "row 4, column period"),
        (lambda rows: rows[3].update(period="2022-12-31T23"), "row 4, column period"),
        (lambda rows: rows[3].update(value="many"), "row 4, column value: 'many'"),
        (lambda rows: rows[3].pop("fueltype"), "row 4, column fueltype"),
    ],
)
def test_wrong_rows_are_told(
    change: Callable[[list[dict[str, Any]]], object], message: str
) -> None:
    rows = service_answers.eia_rows(datetime(2023, 1, 1), datetime(2023, 1, 1, 23))
    change(rows)
    period = Period(date(2023, 1, 1), date(2023, 1, 2))
    with pytest.raises(DataError, match=re.escape(message)):
        read_generation(services()["eia-930"], period, eia_document(rows, {}), "url")


def test_a_wrong_row_is_one_line_of_the_command(run: Callable[..., Result]) -> None:
    line = error(run(eia(lambda rows: rows[3].update(value="many")), *EIA))
    assert "row 4, column value: 'many'" in line


def test_rows_that_the_service_leaves_out_are_an_error() -> None:
    document = json.loads(eia_document([{}], {}))
    document["response"]["total"] = 5001
    with pytest.raises(DataError, match="1 of 5,001 rows came"):
        eia_rows(json.dumps(document).encode(), "url")


def test_requests_cover_the_year_without_too_many_rows() -> None:
    service = services()["eia-930"]
    for year in (2023, 2024):
        periods = year_of_requests(service, "PJM", year).periods
        hours = np.concatenate([period.hours() for period in periods])
        expected = pd.date_range(f"{year}-01-01", f"{year + 1}-01-01", freq="h", inclusive="left")
        np.testing.assert_array_equal(hours, expected)
        longest = max(len(period.hours()) for period in periods)
        assert longest * len(service.types) <= MOST_EIA_ROWS


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--year=1999",), "--year 1999: expected 2019 to"),
        (("--year=2999",), "a calendar year that is over"),
        (("--utc-offset=3",), "utc_offset_h: 3"),
    ],
)
def test_bad_options_of_eia(
    run: Callable[..., Result], options: tuple[str, ...], message: str, data_dir: Path
) -> None:
    weather = data_dir.parent / "here.epw"
    weather.write_text(text(epw_lines()), encoding="utf-8")
    CliRunner().invoke(app, ["data", "import", str(weather), "--site=here"])
    assert message in error(run(None, *EIA, *options))


# ENTSO-E

ENTSOE = ("entsoe", "de-lu", "--year=2024", "--site=here", "--utc-offset=1")


def test_generation_per_type_becomes_carbon_intensity(
    run: Callable[..., Result], data_dir: Path
) -> None:
    result = run(entsoe(), *ENTSOE)
    assert result.exit_code == 0, result.output
    series = pd.read_parquet(data_dir / "sites" / "here" / "carbon.parquet")["ci_g_per_kwh"]
    hours = pd.date_range("2023-01-01 01:00", periods=8760, freq="h")
    sun = np.array([solar_mwh(x.to_pydatetime(), 0.0) for x in hours])
    np.testing.assert_allclose(series, average_ci(sun), atol=0.01)
    notes = metadata(data_dir, "carbon")["notes"]
    assert "stamps mark the start of the interval (given)" in notes
    assert "29 February removed (24 rows)" in notes
    assert not any("B10" in note for note in notes)
    assert "CC BY 4.0" in metadata(data_dir, "carbon")["origin"]["licence"]


DAY = ("2024-01-01T00:00Z", "2024-01-02T00:00Z")


def of_first_day(*series: str) -> pd.DataFrame:
    period = Period(date(2024, 1, 1), date(2024, 1, 2))
    return read_generation(services()["entsoe"], period, entsoe_document(*series), "url")


def test_points_that_repeat_are_left_out_in_one_curve_alone() -> None:
    points = [(1, 10.0), (3, 30.0)]
    held = of_first_day(entsoe_series("B16", *DAY, points, curve="A03"))["B16"]
    np.testing.assert_array_equal(held, [10.0, 10.0, *[30.0] * 22])
    missing = of_first_day(entsoe_series("B16", *DAY, points, curve="A01"))["B16"]
    np.testing.assert_array_equal(missing, [10.0, np.nan, 30.0, *[np.nan] * 21])


@pytest.mark.parametrize(("resolution", "per_hour"), [("PT15M", 4), ("PT30M", 2), ("PT60M", 1)])
def test_power_is_averaged_to_hours(resolution: str, per_hour: int) -> None:
    points = [(i + 1, float(i)) for i in range(24 * per_hour)]
    found = of_first_day(entsoe_series("B04", *DAY, points, resolution))["B04"]
    expected = np.arange(24.0 * per_hour).reshape(24, per_hour).mean(axis=1)
    np.testing.assert_allclose(found, expected)


def test_an_answer_beyond_its_period_is_cut() -> None:
    series = entsoe_series("B04", "2023-12-31T12:00Z", "2024-01-03T00:00Z", [(1, 5.0)], curve="A03")
    np.testing.assert_array_equal(of_first_day(series)["B04"], np.full(24, 5.0))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (entsoe_acknowledgement("No matching data found"), "'No matching data found'"),
        (entsoe_document()[:-10], "cannot be read as XML"),
        (entsoe_document(), "no TimeSeries"),
        (b"<a/>", "a, expected GL_MarketDocument"),
        (b'{"a": 1}', "cannot be read as XML"),
        (entsoe_document(entsoe_series("B04", *DAY, [], "PT1M")), "resolution 'PT1M'"),
        (entsoe_document(entsoe_series("B04", *DAY, [], unit="KWH")), "unit 'KWH', expected MAW"),
        (entsoe_document(entsoe_series("B04", *DAY, [(25, 1.0)])), "position '25'"),
        (entsoe_document(entsoe_series("B04", *DAY, [(1, np.inf)])), "quantity 'inf'"),
        (entsoe_document(entsoe_series("B04", *DAY[::-1], [])), "expected whole intervals"),
        (entsoe_document(entsoe_series("B04", "soon", DAY[1], [])), "time 'soon'"),
        (
            entsoe_document(entsoe_series("B04", "2024-02-31T00:00Z", DAY[1], [])),
            "time '2024-02-31",
        ),
        (entsoe_document("<TimeSeries/>"), "no quantity_Measure_Unit.name"),
    ],
)
def test_wrong_documents_are_one_line(
    run: Callable[..., Result], data_dir: Path, content: bytes, message: str
) -> None:
    assert message in error(run(sends(content, kind="text/xml"), *ENTSOE))
    assert not data_dir.exists()


# Electricity Maps

MAPS = ("electricity-maps", "FR", "--year=2023", "--site=here", "--utc-offset=1")


@pytest.mark.parametrize(
    "column",
    ["Carbon intensity gCO₂eq/kWh (Life cycle)", "Carbon Intensity gCO₂eq/kWh (LCA)"],
)
def test_yearly_table_becomes_carbon_intensity(
    run: Callable[..., Result], data_dir: Path, column: str
) -> None:
    result = run(sends(electricity_maps_table(2023, column), kind="text/csv"), *MAPS)
    assert result.exit_code == 0, result.output
    series = pd.read_parquet(data_dir / "sites" / "here" / "carbon.parquet")["ci_g_per_kwh"]
    assert series[:3].tolist() == [123.25, 100.25, 101.25]
    assert "ODbL" in metadata(data_dir, "carbon")["origin"]["licence"]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (sends(b"no such key", 404), "2025-04-03/FR_2023_hourly.csv: status 404 (Not Found)"),
        (sends(b"a,b\n1,2\n"), "columns 'a, b'"),
        (sends(b""), "columns ''"),
        (sends(b"\xff\xfea"), "cannot be read as a CSV table"),
        (sends(b"a\rb\n"), "cannot be read as a CSV table"),
        (sends(electricity_maps_table()[:5000]), "expected at least 8760"),
    ],
)
def test_wrong_tables_are_one_line(
    run: Callable[..., Result], answer: Answer, message: str
) -> None:
    assert message in error(run(answer, *MAPS))


# Generation


def hourly(by_type: dict[str, np.ndarray]) -> pd.DataFrame:
    length = len(next(iter(by_type.values())))
    return pd.DataFrame(by_type, pd.date_range("2023-01-01", periods=length, freq="h"))


def test_storage_is_left_out_and_unreported_time_is_no_gap() -> None:
    by_type = {
        "NG": np.array([1.0, 2.0, 3.0, np.nan]),
        "GEO": np.array([np.nan, np.nan, 5.0, 5.0]),
        "BAT": np.full(4, 9.0),
    }
    whole = hourly(by_type)
    content, notes = carbon_table([whole[:2], whole[2:]], services()["eia-930"])
    assert content.decode().splitlines() == [
        f"timestamp,{','.join(FUELS)},avg_CI",
        "2023-01-01 00:00:00+00:00,0,0,0,0,1,0,0,0,490.000",
        "2023-01-01 01:00:00+00:00,0,0,0,0,2,0,0,0,490.000",
        "2023-01-01 02:00:00+00:00,0,0,0,0,3,0,0,5,327.500",
        "2023-01-01 03:00:00+00:00,0,0,0,0,,0,0,5,",
    ]
    assert notes == [
        "BAT (storage) left out",
        "GEO counts as OTH",
        "GEO is not reported for 2 h, which count as 0",
    ]


def test_short_gaps_and_gaps_within_stay_missing() -> None:
    gas = np.full(1000, 5.0)
    gas[:24] = gas[-25:] = gas[300:400] = np.nan
    by_type = {"NG": gas, "COL": np.full(1000, 1.0)}
    content, notes = carbon_table([hourly(by_type)], services()["eia-930"])
    found = pd.read_csv(io.BytesIO(content))["NG"].to_numpy()
    assert np.isnan(found[:24]).all()
    assert np.isnan(found[300:400]).all()
    np.testing.assert_array_equal(found[-25:], 0.0)
    assert notes == ["NG is not reported for 25 h, which count as 0"]


def test_every_type_counts_as_a_column_or_as_storage() -> None:
    for name in ("eia-930", "entsoe"):
        columns = {each.counts_as for each in services()[name].types.values()}
        assert columns - {STORAGE} <= set(FUELS)
    assert set(services()["entsoe"].types) == {f"B{i:02d}" for i in range(1, 21)} | {"B25"}
