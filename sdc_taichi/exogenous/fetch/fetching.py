"""Import from services: download the data of a site, convert them, and import them like files."""

from __future__ import annotations

import contextlib
import csv
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous import importing
from sdc_taichi.exogenous.fetch import weather
from sdc_taichi.exogenous.fetch.download import (
    Kept,
    Request,
    downloads_dir,
    fetch,
    keep_file,
    write_file,
)
from sdc_taichi.exogenous.fetch.generation import (
    carbon_table,
    read_generation,
    year_of_requests,
)
from sdc_taichi.exogenous.fetch.services import ELECTRICITY_MAPS_RELEASE, Service, services
from sdc_taichi.user_file import decoding


@dataclass(frozen=True)
class Destination:
    """Site to which fetched data are added, with options for the download."""

    site: str
    """Name of the site."""
    base: str | None = None
    """Embedded site that supplies missing data; None for no base."""
    refresh: bool = False
    """True to download stored answers again."""
    progress: Callable[[int, int], None] = lambda done, total: None
    """Callback ``(done, total)`` with numbers of downloads."""

    @contextlib.contextmanager
    def checking(self) -> Iterator[None]:
        """Add to a reader's errors how to download the data again.

        Raises:
            DataError: the original error, with the hint.
        """
        try:
            yield
        except DataError as error:
            raise DataError(f"{error}; --refresh downloads it again") from None

    def downloads(self, requested: Sequence[Request]) -> list[Kept]:
        """Return answers to requests, either stored or downloaded."""
        return fetch(requested, refresh=self.refresh, progress=self.progress)


def fetch_pvgis(
    into: Destination,
    latitude_deg: float,
    longitude_deg: float,
    utc_offset_h: float,
    file: Path | None = None,
) -> importing.Imported:
    """Fetch the weather of a typical year from PVGIS.

    Args:
        into: site to which the weather is added.
        latitude_deg: latitude, in degrees north.
        longitude_deg: longitude, in degrees east.
        utc_offset_h: local standard time minus UTC, in h.
        file: PVGIS answer that the user downloaded; None to download it.

    Raises:
        DataError: the typical year is not available or not valid.
    """
    name = importing.site_name(into.site)
    request = weather.request_year(latitude_deg, longitude_deg)
    weather.check_offset(utc_offset_h, longitude_deg)
    if file is not None:
        answer = keep_file(request, file)
    else:
        (answer,) = into.downloads([request])
    table, place = weather.typical_year(answer.content, request.url, utc_offset_h)
    path = answer.path.with_name(f"{answer.path.stem}_utc{utc_offset_h:+g}.csv")
    write_file(path, table)
    origin = _origin(request.service, [answer], ["moved from UTC to local standard time"])
    with into.checking():
        return importing.import_weather(path, name, into.base, place=place, origin=origin)


def fetch_epw(into: Destination, url: str) -> importing.Imported:
    """Fetch the weather of an EPW file from an address.

    Args:
        into: site to which the weather is added.
        url: address of the file, or of a ZIP archive that contains it; its query is not stored.

    Raises:
        DataError: the EPW file is not available or not valid.
    """
    name = importing.site_name(into.site)
    request = weather.request_epw(url)
    (answer,) = into.downloads([request])
    path, plain = answer.path, weather.epw_bytes(answer.content, request.url)
    if plain is not answer.content:
        plain = request.redaction.in_bytes(plain)
        path = write_file(path.with_name(f"{path.stem}.unpacked.epw"), plain)
    origin = _origin(request.service, [answer])
    with into.checking():
        return importing.import_weather(path, name, into.base, origin=origin)


def fetch_generation(
    into: Destination,
    service_name: str,
    area: str,
    year: int,
    utc_offset_h: float | None = None,
) -> importing.Imported:
    """Fetch the carbon intensity of an area, from its generation in a calendar year.

    Args:
        into: site to which the carbon intensity is added.
        service_name: ``eia-930`` or ``entsoe``.
        area: code of a US balancing authority, such as ``CISO``; or name of a European zone, such
            as ``DE_LU``, or its energy identification code.
        year: calendar year, in UTC.
        utc_offset_h: UTC offset of the site, in h; None stands for that of its weather or base.

    Raises:
        DataError: there is no key, or the generation is not available or not valid.
    """
    service = services()[service_name]
    _check(into, service, year, utc_offset_h)
    code, periods, requested = year_of_requests(service, area, year)
    answers = into.downloads(requested)
    parts = [
        read_generation(service, period, answer.content, request.url)
        for period, answer, request in zip(periods, answers, requested, strict=True)
    ]
    table, notes = carbon_table(parts, service)
    path = write_file(downloads_dir(service) / f"{code}_{year}.csv", table)
    with into.checking():
        return importing.import_carbon(
            path,
            into.site,
            into.base,
            utc_offset_h=utc_offset_h,
            stamp=service.stamp,
            origin=_origin(service, answers, notes),
        )


def fetch_electricity_maps(
    into: Destination,
    zone: str,
    year: int,
    utc_offset_h: float | None = None,
    release: str = ELECTRICITY_MAPS_RELEASE,
) -> importing.Imported:
    """Fetch the carbon intensity of a zone from a yearly table of Electricity Maps.

    Args:
        into: site to which the carbon intensity is added.
        zone: name of the zone in Electricity Maps, such as ``FR`` or ``US-CAL-CISO``.
        year: calendar year, in UTC.
        utc_offset_h: UTC offset of the site, in h; None stands for that of its weather or base.
        release: release date of the table.

    Raises:
        DataError: the table is not available or not valid.
    """
    service = services()["electricity-maps"]
    _check(into, service, year, utc_offset_h)
    if not re.fullmatch("[A-Z]{2}(-[A-Z0-9]+){0,3}", zone):
        raise DataError(f"zone {shortened(zone)}: expected a zone such as FR or US-CAL-CISO")
    if not re.fullmatch(r"\d{4}-\d\d-\d\d", release):
        raise DataError(
            f"--release {shortened(release)}: expected a day such as {ELECTRICITY_MAPS_RELEASE}"
        )
    name = f"{zone}_{year}_hourly.csv"
    request = Request(
        service,
        f"{service.address}/{release}/{name}",
        f"{release}_{name}",
        by_hand=f"download {name} from {service.page}, then data import FILE "
        "--map electricity-maps",
        check=_intensity_columns,
    )
    (answer,) = into.downloads([request])
    with into.checking():
        return importing.import_carbon(
            answer.path,
            into.site,
            into.base,
            utc_offset_h=utc_offset_h,
            stamp=service.stamp,
            columns=_intensity_columns(answer.content, request.url),
            origin=_origin(service, [answer]),
        )


def _intensity_columns(content: bytes, url: str) -> dict[str, str]:
    """Return the column names of a table of Electricity Maps, by the names of the reader."""
    layout = services()["electricity-maps"].saved_table
    assert layout is not None
    assert layout.intensity is not None
    with decoding(url, "a CSV table", DataError):
        header = next(csv.reader([content.decode("utf-8-sig").split("\n")[0].rstrip("\r")]), [])
    names = {"timestamp": layout.time, "avg_CI": layout.intensity}
    columns = {
        name: column
        for name, pattern in names.items()
        for column in header
        if re.fullmatch(pattern, column)
    }
    if len(columns) < len(names):
        raise DataError(
            f"{url}: columns {shortened(', '.join(header), 200)}, expected {layout.expected}"
        )
    return columns


def _check(into: Destination, service: Service, year: int, utc_offset_h: float | None) -> None:
    """Check, before any download, that the year has ended, and the site's name and UTC offset."""
    this_year, first = datetime.now(UTC).year, service.first_year or 0
    if not first <= year < this_year:
        raise DataError(
            f"--year {year}: expected {first} to {this_year - 1}, a calendar year that is over"
        )
    name = importing.site_name(into.site)
    importing.site_clock(name, into.base, utc_offset_h=utc_offset_h)


def _origin(service: Service, kept: Sequence[Kept], notes: Sequence[str] = ()) -> importing.Origin:
    fields = ("url", "retrieved", "sha256")
    downloads = tuple({name: answer.origin[name] for name in fields} for answer in kept)
    return importing.Origin(service.title, service.licence, downloads, tuple(notes))
