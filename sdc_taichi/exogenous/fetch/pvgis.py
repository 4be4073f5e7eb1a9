"""Typical years of PVGIS, the service of the European Commission's Joint Research Centre.

A typical year joins twelve months of reanalysed weather (ISO 15927-4) at a place given by latitude
and longitude. Its rows are stamped in UTC at full hours; each is taken for the hour that begins
then and is moved to local standard time, where the last hours of the year become the first, or the
other way round.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous.fetch.answers import field, number, read_json
from sdc_taichi.exogenous.fetch.request import Request, Service
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.year_clock import DAYS_PER_MONTH, HOURS_PER_YEAR

SERVICE = Service(
    name="pvgis",
    title="PVGIS 5.3, European Commission, Joint Research Centre",
    licence="CC BY 4.0 (reuse policy of the European Commission, Decision 2011/833/EU)",
    page="https://re.jrc.ec.europa.eu/pvg_tools/en/",
)
ADDRESS = "https://re.jrc.ec.europa.eu/api/v5_3/tmy"
"""Address of the tool for typical years."""
MOST_OFFSET_ERROR_H = 4.0
"""Largest difference, in h, between local standard time and the time of the sun: about 3.2 h in the
west of China is the largest in use, and a wrong sign is mostly beyond."""
_MOST_DISTANCE_DEG = 0.01
_COLUMNS = ("T2m", "RH", "SP", "IR(h)", "G(h)", "Gb(n)", "Gd(h)", "WD10m", "WS10m")
_DATABASE = ("meteo_db", "year_min", "year_max")
_DATES = [
    (month, day) for month, days in enumerate(DAYS_PER_MONTH, 1) for day in range(1, days + 1)
]
_FLAGS = "?9?9?9?9E0?9?9?9?9?9?9?9?9?9?9?9?9?9?9?9*9*9*9*9*9"


class _Year(NamedTuple):
    """A typical year in UTC."""

    place: dict[str, float]
    """``latitude`` and ``longitude`` in degrees, ``elevation`` in m."""
    database: str
    """Database of the weather, with its years."""
    years: FloatArray
    """Calendar year of each row, (8760,)."""
    hourly: dict[str, FloatArray]
    """Columns by their names in PVGIS, in its units, (8760,) each."""


def request_year(latitude_deg: float, longitude_deg: float) -> Request:
    """Request of the typical year of a place.

    Args:
        latitude_deg: latitude, in degrees north.
        longitude_deg: longitude, in degrees east.

    Raises:
        DataError: no place on Earth.
    """
    for name, value, most in (
        ("latitude", latitude_deg, 90.0),
        ("longitude", longitude_deg, 180.0),
    ):
        if not -most <= value <= most:
            raise DataError(f"--{name} {value:g}: expected {-most:g} to {most:g} degrees")
    latitude, longitude = f"{latitude_deg:.4f}", f"{longitude_deg:.4f}"

    def check(content: bytes, url: str) -> None:
        place = _read(content, url).place
        for name, asked in (("latitude", latitude_deg), ("longitude", longitude_deg)):
            if abs(place[name] - asked) > _MOST_DISTANCE_DEG:
                raise DataError(f"{url}: {name} {place[name]:g}, expected {asked:g} as was asked")

    query = {"lat": latitude, "lon": longitude, "outputformat": "json"}
    request = Request(SERVICE, ADDRESS, f"tmy_{latitude}_{longitude}.json", query, check=check)
    by_hand = f"by hand: save {request.url} with a browser, then add --file FILE"
    return replace(request, by_hand=by_hand)


def to_epw(content: bytes, url: str, utc_offset_h: float) -> str:
    """A typical year as text of an EPW file in local standard time.

    Columns that PVGIS has not got carry the codes for missing values of the format.

    Args:
        content: answer of PVGIS.
        url: address, for messages.
        utc_offset_h: local standard time minus UTC, in h.

    Raises:
        DataError: no typical year, or an offset that does not fit the longitude.
    """
    place, database, years, hourly = _read(content, url)
    check_offset(utc_offset_h, place["longitude"])
    shifted = {name: _to_local(values, utc_offset_h) for name, values in hourly.items()}
    # The mean of two directions may be opposite to both.
    shifted["WD10m"] = np.roll(hourly["WD10m"], math.floor(utc_offset_h))
    local_years = np.roll(years, math.floor(utc_offset_h))
    name = f"PVGIS {place['latitude']:.2f}N {place['longitude']:.2f}E"
    lines = [
        f"LOCATION,{name},-,-,{database or SERVICE.name},000000,{place['latitude']:.5f},"
        f"{place['longitude']:.5f},{utc_offset_h:g},{place['elevation']:.1f}",
        "DESIGN CONDITIONS,0",
        "TYPICAL/EXTREME PERIODS,0",
        "GROUND TEMPERATURES,0",
        "HOLIDAYS/DAYLIGHT SAVINGS,No,0,0,0",
        f"COMMENTS 1,{SERVICE.title}; {SERVICE.licence}",
        "COMMENTS 2,moved from UTC to local standard time",
        "DATA PERIODS,1,1,Data,Sunday,1/1,12/31",
    ]
    for hour in range(HOURS_PER_YEAR):
        month, day = _DATES[hour // 24]
        dry, humidity, pressure, infrared, glob, beam, diffuse, towards, wind = (
            float(shifted[column][hour]) for column in _COLUMNS
        )
        lines.append(
            f"{int(local_years[hour])},{month},{day},{hour % 24 + 1},60,{_FLAGS},{dry:.2f},99.9,"
            f"{humidity:.2f},{pressure:.0f},9999,9999,{infrared:.1f},{glob:.1f},{beam:.1f},"
            f"{diffuse:.1f},999999,999999,999999,9999,{towards:.0f},{wind:.2f},99,99,9999,99999,9,"
            "999999999,999,0.999,999,99,999,999,99"
        )
    return "\n".join(lines) + "\n"


def check_offset(utc_offset_h: float, longitude_deg: float) -> None:
    """Check that a UTC offset can be that of a longitude.

    Raises:
        DataError: out of range, or further from the time of the sun than any in use.
    """
    off_h = (utc_offset_h - longitude_deg / 15.0 + 12.0) % 24.0 - 12.0
    if not -12.0 <= utc_offset_h <= 14.0 or abs(off_h) > MOST_OFFSET_ERROR_H:
        raise DataError(
            f"--utc-offset {utc_offset_h:g}: expected local standard time minus UTC in h, which is "
            f"about {longitude_deg / 15.0:+.0f} at longitude {longitude_deg:g}"
        )


def _to_local(values: FloatArray, utc_offset_h: float) -> FloatArray:
    """Hourly values of a year in UTC, on the hours of local standard time, (8760,)."""
    whole = math.floor(utc_offset_h)
    share = utc_offset_h - whole
    return np.asarray((1.0 - share) * np.roll(values, whole) + share * np.roll(values, whole + 1))


def _read(content: bytes, url: str) -> _Year:
    """The typical year of an answer."""
    found = read_json(content, url)
    place = {
        name: number(field(found, url, "inputs", "location", name), url, f"inputs.location.{name}")
        for name in ("latitude", "longitude", "elevation")
    }
    rows = field(found, url, "outputs", "tmy_hourly")
    if not isinstance(rows, list) or len(rows) != HOURS_PER_YEAR:
        count = len(rows) if isinstance(rows, list) else 0
        raise DataError(f"{url}: {count} rows in tmy_hourly, expected {HOURS_PER_YEAR}")
    years = np.empty(HOURS_PER_YEAR)
    hourly = {name: np.empty(HOURS_PER_YEAR) for name in _COLUMNS}
    for hour, row in enumerate(rows):
        month, day = _DATES[hour // 24]
        stamp = field(row, url, "time(UTC)")
        expected = f"{month:02d}{day:02d}:{hour % 24:02d}"
        # Stamps of databases of satellites carry minutes, but only irradiance is meant by them.
        if not isinstance(stamp, str) or stamp[4:11] != expected or not stamp[:4].isdecimal():
            raise DataError(
                f"{url}: row {hour + 1} of tmy_hourly: time(UTC) {shortened(stamp)}, expected "
                f"YYYY{expected}00"
            )
        years[hour] = int(stamp[:4])
        for name, values in hourly.items():
            what = f"row {hour + 1} of tmy_hourly: {name}"
            values[hour] = number(field(row, url, name), url, what)
    database = found["inputs"].get("meteo_data")
    words = [str(database.get(x, "")) for x in _DATABASE] if isinstance(database, dict) else []
    return _Year(place, " ".join(words).replace(",", " ").strip(), years, hourly)
