"""From a service to a site: downloads, conversion, and the import that every file goes through."""

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
    Patience,
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
    """The site that fetched data become part of, and how they are fetched."""

    site: str
    """Name of the site."""
    base: str | None = None
    """Embedded site that gives what the data do not; None if none does."""
    data_dir: Path | None = None
    """Folder of imported files instead of the user's."""
    refresh: bool = False
    """Whether to download again what is stored."""
    patience: Patience | None = None
    """Limits of time of each download; None are the usual ones."""
    progress: Callable[[int, int], None] = lambda done, total: None
    """Callback with the number of downloads that are there, and of all."""

    @contextlib.contextmanager
    def checking(self) -> Iterator[None]:
        """Add to errors of the reader how to download the data again.

        Raises:
            DataError: in place of one without the hint.
        """
        try:
            yield
        except DataError as error:
            raise DataError(f"{error}; --refresh downloads it again") from None

    def downloads(self, requested: Sequence[Request]) -> list[Kept]:
        """Answers to requests, downloaded or from the store."""
        return fetch(
            requested,
            self.data_dir,
            refresh=self.refresh,
            patience=self.patience,
            progress=self.progress,
        )


def fetch_pvgis(
    into: Destination,
    latitude_deg: float,
    longitude_deg: float,
    utc_offset_h: float,
    file: Path | None = None,
) -> importing.Imported:
    """Weather of a typical year of PVGIS.

    Args:
        into: the site.
        latitude_deg: latitude, in degrees north.
        longitude_deg: longitude, in degrees east.
        utc_offset_h: local standard time minus UTC, in h.
        file: answer of PVGIS that was downloaded by hand; None to download it.

    Raises:
        DataError: no typical year is available, or it is not valid.
    """
    name = importing.site_name(into.site, into.data_dir)
    request = weather.request_year(latitude_deg, longitude_deg)
    weather.check_offset(utc_offset_h, longitude_deg)
    if file is not None:
        kept = keep_file(request, file, into.data_dir)
    else:
        (kept,) = into.downloads([request])
    table, place = weather.typical_year(kept.content, request.url, utc_offset_h)
    path = kept.path.with_name(f"{kept.path.stem}_utc{utc_offset_h:+g}.csv")
    write_file(path, table)
    origin = _origin(request.service, [kept], ["moved from UTC to local standard time"])
    with into.checking():
        return importing.import_weather(
            path, name, into.base, into.data_dir, place=place, origin=origin
        )


def fetch_epw(into: Destination, url: str) -> importing.Imported:
    """Weather of an EPW file at an address.

    Args:
        into: the site.
        url: address of the file, or of a ZIP archive that holds it.

    Raises:
        DataError: no EPW file is available, or it is not valid.
    """
    name = importing.site_name(into.site, into.data_dir)
    request = weather.request_epw(url)
    (kept,) = into.downloads([request])
    path, plain = kept.path, weather.epw_bytes(kept.content, url)
    if plain is not kept.content:
        path = write_file(path.with_name(f"{path.stem}.unpacked.epw"), plain)
    origin = _origin(request.service, [kept])
    with into.checking():
        return importing.import_weather(path, name, into.base, into.data_dir, origin=origin)


def fetch_generation(
    into: Destination,
    service_name: str,
    area: str,
    year: int,
    utc_offset_h: float | None = None,
) -> importing.Imported:
    """Carbon intensity of an area, by its generation in a calendar year.

    Args:
        into: the site.
        service_name: ``eia-930`` or ``entsoe``.
        area: code of a balancing authority of the USA, such as ``CISO``; name of a zone of Europe,
            such as ``DE_LU``, or its energy identification code.
        year: calendar year, in UTC.
        utc_offset_h: of the site, in h; None is that of its weather or base.

    Raises:
        DataError: no key, or the generation is not available or not valid.
    """
    service = services()[service_name]
    _check(into, service, year, utc_offset_h)
    code, periods, requested = year_of_requests(service, area, year)
    kept = into.downloads(requested)
    parts = [
        read_generation(service, period, answer.content, request.url)
        for period, answer, request in zip(periods, kept, requested, strict=True)
    ]
    table, notes = carbon_table(parts, service)
    path = write_file(downloads_dir(service, into.data_dir) / f"{code}_{year}.csv", table)
    with into.checking():
        return importing.import_carbon(
            path,
            into.site,
            into.base,
            into.data_dir,
            utc_offset_h=utc_offset_h,
            stamp=service.stamp,
            origin=_origin(service, kept, notes),
        )


def fetch_electricity_maps(
    into: Destination,
    zone: str,
    year: int,
    utc_offset_h: float | None = None,
    release: str = ELECTRICITY_MAPS_RELEASE,
) -> importing.Imported:
    """Carbon intensity of a zone by a yearly table of Electricity Maps.

    Args:
        into: the site.
        zone: zone as Electricity Maps calls it, such as ``FR`` or ``US-CAL-CISO``.
        year: calendar year, in UTC.
        utc_offset_h: of the site, in h; None is that of its weather or base.
        release: day of the release of the table.

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
    (kept,) = into.downloads([request])
    with into.checking():
        return importing.import_carbon(
            kept.path,
            into.site,
            into.base,
            into.data_dir,
            utc_offset_h=utc_offset_h,
            stamp=service.stamp,
            columns=_intensity_columns(kept.content, request.url),
            origin=_origin(service, [kept]),
        )


def _intensity_columns(content: bytes, url: str) -> dict[str, str]:
    """Columns of a table of Electricity Maps, by the names of the reader."""
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
    """Check, before any download, that the year has ended and the site has a name and a clock."""
    this_year, first = datetime.now(UTC).year, service.first_year or 0
    if not first <= year < this_year:
        raise DataError(
            f"--year {year}: expected {first} to {this_year - 1}, a calendar year that is over"
        )
    name = importing.site_name(into.site, into.data_dir)
    importing.site_clock(name, into.base, into.data_dir, utc_offset_h=utc_offset_h)


def _origin(service: Service, kept: Sequence[Kept], notes: Sequence[str] = ()) -> importing.Origin:
    fields = ("url", "retrieved", "sha256")
    downloads = tuple({name: answer.origin[name] for name in fields} for answer in kept)
    return importing.Origin(service.title, service.licence, downloads, tuple(notes))
