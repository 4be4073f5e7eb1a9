"""Weather from the web: typical years of PVGIS, and EPW files from an address.

A typical year joins twelve months of reanalysed weather (ISO 15927-4) for a latitude and
longitude. Its rows have UTC stamps at full hours. Each row counts for the hour that begins at its
stamp and is moved to local standard time, with the year closed to a circle: hours that cross its
end continue at its start.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import zipfile
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous.fetch.download import MOST_DOWNLOAD_BYTES, Request
from sdc_taichi.exogenous.fetch.services import services
from sdc_taichi.exogenous.weather_table import Place
from sdc_taichi.exogenous.year_clock import UTC_OFFSETS_H
from sdc_taichi.user_file import decoding

MOST_OFFSET_ERROR_H = 4.0
"""Largest valid difference between local standard time and solar time, in h. The largest one in
use is about 3.2 h, in the west of China; a wrong sign of the offset usually exceeds the limit."""
_MOST_DISTANCE_DEG = 0.01
_COLUMNS = {"T2m": "dry_bulb", "RH": "relative_humidity", "SP": "pressure"}
"""Columns of a weather table by the names of PVGIS, in the same units."""
_COMMON_YEAR = np.datetime64("2001-01-01T00", "h") + np.arange(8760)
"""Stamps of the hours of a year without 29 February, for the rows of a typical year."""
_ARCHIVE = b"PK\x03\x04"


def request_year(latitude_deg: float, longitude_deg: float) -> Request:
    """Build the request for the typical year of a location.

    Raises:
        DataError: the coordinates are out of range.
    """
    place = {"latitude": latitude_deg, "longitude": longitude_deg}
    for (name, value), most in zip(place.items(), (90.0, 180.0), strict=True):
        if not -most <= value <= most:
            raise DataError(f"--{name} {value:g}: expected {-most:g} to {most:g} degrees")

    def check(content: bytes, url: str) -> None:
        answered, _ = _read(content, url)
        for name, value in place.items():
            if abs(answered[name] - value) > _MOST_DISTANCE_DEG:
                raise DataError(f"{url}: {name} {answered[name]:g}, expected {value:g} as asked")

    service = services()["pvgis"]
    latitude, longitude = f"{latitude_deg:.4f}", f"{longitude_deg:.4f}"
    return Request(
        service,
        service.address,
        f"tmy_{latitude}_{longitude}.json",
        {"lat": latitude, "lon": longitude, "outputformat": "json"},
        by_hand=f"save {service.address}?lat={latitude}&lon={longitude}&outputformat=json with a "
        "browser, then add --file FILE",
        check=check,
    )


def typical_year(content: bytes, url: str, utc_offset_h: float) -> tuple[bytes, Place]:
    """Convert a typical year to a weather table in local standard time; return it with its place.

    For an offset with a half hour, each value is the mean of two rows.

    Args:
        content: answer of PVGIS.
        url: address, for messages.
        utc_offset_h: local standard time minus UTC, in h.

    Raises:
        DataError: the answer is not a typical year, or the offset does not fit the longitude.
    """
    place, table = _read(content, url)
    check_offset(utc_offset_h, place["longitude"])
    whole = math.floor(utc_offset_h)
    share = utc_offset_h - whole
    values = table[list(_COLUMNS)].to_numpy(float)
    table[list(_COLUMNS)] = (1.0 - share) * np.roll(values, whole, axis=0) + share * np.roll(
        values, whole + 1, axis=0
    )
    table["timestamp"] = [f"{stamp:%Y-%m-%d %H:%M}" for stamp in _COMMON_YEAR.tolist()]
    table = table.rename(columns=_COLUMNS)[["timestamp", *_COLUMNS.values()]]
    table = table.round({"dry_bulb": 2, "relative_humidity": 2, "pressure": 0})
    label = f"PVGIS {place['latitude']:.2f}N {place['longitude']:.2f}E"
    where = (place["latitude"], place["longitude"], place["elevation"])
    return table.to_csv(index=False).encode(), Place(label, *where, utc_offset_h)


def check_offset(utc_offset_h: float, longitude_deg: float) -> None:
    """Check that a UTC offset is possible at a longitude.

    Raises:
        DataError: the offset is out of range, or too far from solar time.
    """
    off_h = (utc_offset_h - longitude_deg / 15.0 + 12.0) % 24.0 - 12.0
    low, high = UTC_OFFSETS_H
    if not low <= utc_offset_h <= high or abs(off_h) > MOST_OFFSET_ERROR_H:
        raise DataError(
            f"--utc-offset {utc_offset_h:g}: expected local standard time minus UTC in h, which is "
            f"about {longitude_deg / 15.0:+.0f} at longitude {longitude_deg:g}"
        )


def _read(content: bytes, url: str) -> tuple[dict[str, float], Any]:
    """Parse an answer: latitude, longitude (degrees) and elevation (m), and rows in UTC."""
    import pandas as pd

    with decoding(url, "JSON", DataError):
        answer = json.loads(content)
    try:
        location = answer["inputs"]["location"]
        place = {name: float(location[name]) for name in ("latitude", "longitude", "elevation")}
        table = pd.DataFrame(answer["outputs"]["tmy_hourly"])
        stamps = table["time(UTC)"].astype(str)
        values = table[list(_COLUMNS)].apply(pd.to_numeric, errors="coerce")
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{url}: no {shortened(error.args[0])}, expected a typical year of PVGIS with "
            f"inputs.location and outputs.tmy_hourly, columns time(UTC), {', '.join(_COLUMNS)}"
        ) from None
    if len(table) != _COMMON_YEAR.size:
        raise DataError(f"{url}: {len(table)} rows in tmy_hourly, expected {_COMMON_YEAR.size}")
    # Stamps of satellite databases have minutes, which concern only irradiance.
    expected = [f"{stamp:%m%d:%H}" for stamp in _COMMON_YEAR.tolist()]
    wrong = (stamps.str[4:11] != expected).to_numpy()
    if wrong.any():
        at = int(wrong.argmax())
        raise DataError(
            f"{url}: row {at + 1} of tmy_hourly: time(UTC) {shortened(stamps[at])}, expected "
            f"YYYY{expected[at]}00"
        )
    for name in _COLUMNS:
        if values[name].isna().any():
            at = int(values[name].isna().to_numpy().argmax())
            raise DataError(
                f"{url}: row {at + 1} of tmy_hourly: {name} {shortened(table[name][at])}, expected "
                "a number"
            )
    return place, values


def request_epw(url: str) -> Request:
    """Build the request for a weather file.

    Args:
        url: address of an EPW file, or of a ZIP archive with one, as at climate.onebuilding.org.
            Its query may hold a token, so it is neither shown nor stored.

    Raises:
        DataError: the text is not a web address, or it contains a password.
    """
    try:
        parts = urlsplit(url)
    except ValueError:
        parts = urlsplit("")
    # HTTP libraries differ on host names with a space, so refuse them here.
    if parts.scheme not in ("http", "https") or not parts.hostname or " " in parts.netloc:
        shown = re.sub("//.*@", "//", re.split("[?#]", url)[0])
        raise DataError(f"{shortened(shown)}: expected an address that begins with https://")
    if parts.username is not None or parts.password is not None:
        raise DataError(f"{parts.hostname}: an address with a password, expected one without")
    name = unquote(parts.path.rsplit("/", 1)[-1])
    name = re.sub(r"[^A-Za-z0-9._-]", "-", name).strip(".-")[-100:] or "weather"
    # Different addresses may end in equal file names, so add a hash of the address.
    name = f"{hashlib.sha256(url.encode()).hexdigest()[:8]}_{name}"
    by_hand = "save it with a browser, then data import FILE --site NAME"
    return Request(
        services()["epw"],
        parts._replace(query="", fragment="").geturl(),
        name,
        private_query=parts.query,
        by_hand=by_hand,
        check=epw_bytes,
    )


def epw_bytes(content: bytes, url: str) -> bytes:
    """Return the EPW file in an answer, unpacked if the answer is an archive.

    Raises:
        DataError: there is no EPW file, or the archive has none or several, is too large or is
            damaged.
    """
    if content.startswith(_ARCHIVE):
        with decoding(url, "a ZIP archive", DataError):
            archive = zipfile.ZipFile(io.BytesIO(content))
            members = [x for x in archive.infolist() if x.filename.lower().endswith(".epw")]
            if len(members) != 1:
                names = ", ".join(x.filename for x in members[:5]) or "none"
                raise DataError(f"{url}: EPW files in the archive: {names}; expected one")
            with archive.open(members[0]) as member:
                content = member.read(MOST_DOWNLOAD_BYTES + 1)
        if len(content) > MOST_DOWNLOAD_BYTES:
            raise DataError(
                f"{url}: the EPW file in the archive has more than "
                f"{MOST_DOWNLOAD_BYTES / 1e6:,.1f} MB, the most that is valid"
            )
    if not content.lstrip(b"\xef\xbb\xbf").lstrip()[:9].upper().startswith(b"LOCATION,"):
        start = content[:20].decode("latin-1")
        raise DataError(
            f"{url}: begins with {shortened(start)}, expected an EPW file (LOCATION,...) or a ZIP "
            "archive that holds one"
        )
    return content
