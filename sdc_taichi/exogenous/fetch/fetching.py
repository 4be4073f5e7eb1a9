"""From a service to a site: downloads, conversion, and the import that every file goes through."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import importing
from sdc_taichi.exogenous.fetch import eia, electricity_maps, entsoe, epw_archive, pvgis
from sdc_taichi.exogenous.fetch.download import Patience
from sdc_taichi.exogenous.fetch.generation import Period, by_column, carbon_table, check_year
from sdc_taichi.exogenous.fetch.kept_downloads import (
    Kept,
    downloads_dir,
    fetch,
    keep_file,
    write_file,
)
from sdc_taichi.exogenous.fetch.request import Request, Service, read_key
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.stamps import Stamp


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
    """Whether to download again what is kept."""
    patience: Patience | None = None
    """Limits of time of each download; None are the usual ones."""
    progress: Callable[[int, int], None] = lambda done, total: None
    """Told the number of downloads that are there, and of all."""

    @contextlib.contextmanager
    def checking(self) -> Iterator[None]:
        """Say where the reader refuses downloads how to have them anew.

        Raises:
            DataError: in place of one without the hint.
        """
        try:
            yield
        except DataError as error:
            raise DataError(f"{error}; --refresh downloads it again") from None

    def downloads(self, requests: Sequence[Request]) -> list[Kept]:
        """Answers to requests, downloaded or kept from before."""
        return fetch(
            requests,
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
        DataError: no typical year is to be had, or it is not valid.
    """
    name = importing.site_name(into.site, into.data_dir)
    request = pvgis.request_year(latitude_deg, longitude_deg)
    pvgis.check_offset(utc_offset_h, longitude_deg)
    if file is not None:
        kept = keep_file(request, file, into.data_dir)
    else:
        (kept,) = into.downloads([request])
    epw = pvgis.to_epw(kept.content, request.url, utc_offset_h)
    path = kept.path.with_name(f"{kept.path.stem}_utc{utc_offset_h:+g}.epw")
    write_file(path, epw.encode())
    notes = ("moved from UTC to local standard time",)
    origin = _origin(pvgis.SERVICE, [kept], notes)
    with into.checking():
        return importing.import_weather(path, name, into.base, into.data_dir, origin=origin)


def fetch_epw(into: Destination, url: str) -> importing.Imported:
    """Weather of an EPW file at an address.

    Args:
        into: the site.
        url: address of the file, or of a ZIP archive that holds it.

    Raises:
        DataError: no EPW file is to be had, or it is not valid.
    """
    name = importing.site_name(into.site, into.data_dir)
    (kept,) = into.downloads([epw_archive.request_file(url)])
    path, plain = kept.path, epw_archive.epw_bytes(kept.content, url)
    if plain is not kept.content:
        path = write_file(path.with_name(f"{path.stem}.unpacked.epw"), plain)
    origin = _origin(epw_archive.SERVICE, [kept])
    with into.checking():
        return importing.import_weather(path, name, into.base, into.data_dir, origin=origin)


def fetch_eia(
    into: Destination, authority: str, year: int, utc_offset_h: float | None = None
) -> importing.Imported:
    """Carbon intensity of a balancing authority of the USA, by its generation in a calendar year.

    Args:
        into: the site.
        authority: code of the balancing authority, such as ``CISO``.
        year: calendar year, in UTC.
        utc_offset_h: of the site, in h; None is that of its weather or base.

    Raises:
        DataError: no key, or the generation is not to be had or not valid.
    """
    check_year(year, eia.FIRST_YEAR, _this_year())
    _check_site(into, utc_offset_h)
    key = read_key(eia.SERVICE, eia.KEY_VARIABLE, "api_key")
    asked = eia.requests_of_year(authority.upper(), year, key)
    table = f"{authority.upper()}_{year}.csv"
    return _import_generation(
        into, asked, eia.generation, eia.COLUMNS, table, year, "auto", utc_offset_h
    )


def fetch_entsoe(
    into: Destination, zone: str, year: int, utc_offset_h: float | None = None
) -> importing.Imported:
    """Carbon intensity of a zone of Europe, by its generation in a calendar year.

    Args:
        into: the site.
        zone: name of the zone, such as ``DE_LU``, or its energy identification code.
        year: calendar year, in UTC.
        utc_offset_h: of the site, in h; None is that of its weather or base.

    Raises:
        DataError: no key, or the generation is not to be had or not valid.
    """
    check_year(year, entsoe.FIRST_YEAR, _this_year())
    _check_site(into, utc_offset_h)
    code = entsoe.zone_code(zone)
    key = read_key(entsoe.SERVICE, entsoe.KEY_VARIABLE, "securityToken")
    asked = entsoe.requests_of_year(zone, year, key)
    return _import_generation(
        into,
        asked,
        entsoe.generation,
        entsoe.COLUMNS,
        f"{code}_{year}.csv",
        year,
        "start",
        utc_offset_h,
    )


def fetch_electricity_maps(
    into: Destination,
    zone: str,
    year: int,
    utc_offset_h: float | None = None,
    release: str = electricity_maps.RELEASE,
) -> importing.Imported:
    """Carbon intensity of a zone by a yearly table of Electricity Maps.

    Args:
        into: the site.
        zone: zone as Electricity Maps calls it, such as ``FR`` or ``US-CAL-CISO``.
        year: calendar year, in UTC.
        utc_offset_h: of the site, in h; None is that of its weather or base.
        release: day of the release of the table.

    Raises:
        DataError: the table is not to be had or not valid.
    """
    check_year(year, electricity_maps.FIRST_YEAR, _this_year())
    _check_site(into, utc_offset_h)
    request = electricity_maps.request_year(zone, year, release)
    (kept,) = into.downloads([request])
    with into.checking():
        return importing.import_carbon(
            kept.path,
            into.site,
            into.base,
            into.data_dir,
            utc_offset_h=utc_offset_h,
            stamp="start",
            columns=electricity_maps.columns_of(kept.content, request.url),
            origin=_origin(electricity_maps.SERVICE, [kept]),
        )


def _import_generation(
    into: Destination,
    asked: Sequence[tuple[Period, Request]],
    generation: Callable[[int, Sequence[tuple[Period, bytes, str]]], dict[str, FloatArray]],
    columns: Mapping[str, str | None],
    file_name: str,
    year: int,
    stamp: Stamp,
    utc_offset_h: float | None,
) -> importing.Imported:
    """Import a carbon table that is made of answers about parts of a year."""
    service = asked[0][1].service
    kept = into.downloads([request for _, request in asked])
    answers = [
        (period, answer.content, request.url)
        for (period, request), answer in zip(asked, kept, strict=True)
    ]
    periods = [period for period, _ in asked]
    values, notes = by_column(generation(year, answers), columns, periods)
    table = carbon_table(np.datetime64(f"{year}-01-01"), values)
    path = write_file(downloads_dir(service, into.data_dir) / file_name, table)
    with into.checking():
        return importing.import_carbon(
            path,
            into.site,
            into.base,
            into.data_dir,
            utc_offset_h=utc_offset_h,
            stamp=stamp,
            origin=_origin(service, kept, notes),
        )


def _check_site(into: Destination, utc_offset_h: float | None) -> None:
    """Check before any download that the site has a valid name and a clock."""
    name = importing.site_name(into.site, into.data_dir)
    importing.site_clock(name, into.base, into.data_dir, utc_offset_h=utc_offset_h)


def _origin(service: Service, kept: Sequence[Kept], notes: Sequence[str] = ()) -> importing.Origin:
    told = ("url", "retrieved", "sha256")
    downloads = tuple({key: answer.origin[key] for key in told} for answer in kept)
    return importing.Origin(service.title, service.licence, downloads, tuple(notes))


def _this_year() -> int:
    return datetime.now(UTC).year
