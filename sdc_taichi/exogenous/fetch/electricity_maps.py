"""Yearly tables of hourly carbon intensity of Electricity Maps.

Intensities are of the electricity consumed in a zone, imports included, and of the life cycle of
the plants. Stamps are in UTC and mark the start of the hour.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous.fetch.request import Request, Service
from sdc_taichi.user_file import decoding

SERVICE = Service(
    name="electricity-maps",
    title="Electricity Maps",
    licence="Open Database License (ODbL) 1.0",
    page="https://portal.electricitymaps.com/datasets",
)
ADDRESS = "https://data.electricitymaps.com"
"""Address of the folders of releases."""
RELEASE = "2025-04-03"
"""Release of the tables that is asked for unless another is named; it has 2021 to 2024."""
FIRST_YEAR = 2021
"""First year of the tables."""
STAMP_COLUMN = "Datetime (UTC)"
"""Column of the stamps."""
_ZONE = re.compile(r"[A-Z]{2}(-[A-Z0-9]+){0,3}")
_RELEASE = re.compile(r"\d{4}-\d\d-\d\d")


def request_year(zone: str, year: int, release: str = RELEASE) -> Request:
    """Request of the table of a zone and a calendar year.

    Args:
        zone: zone as Electricity Maps calls it, such as ``FR`` or ``US-CAL-CISO``.
        year: calendar year.
        release: day of the release, which is a part of the address.

    Raises:
        DataError: no zone, or no day.
    """
    if not _ZONE.fullmatch(zone):
        raise DataError(f"zone {shortened(zone)}: expected a zone such as FR or US-CAL-CISO")
    if not _RELEASE.fullmatch(release):
        raise DataError(f"--release {shortened(release)}: expected a day such as {RELEASE}")
    name = f"{zone}_{year}_hourly.csv"
    hint = (
        f"by hand: download {name} from {SERVICE.page}, then data import FILE "
        "--map electricity-maps"
    )
    return Request(
        SERVICE, f"{ADDRESS}/{release}/{name}", f"{release}_{name}", by_hand=hint, check=columns_of
    )


def columns_of(content: bytes, url: str) -> dict[str, str]:
    """Columns of a table that hold stamps and life-cycle intensity, by the names of the reader.

    Raises:
        DataError: not UTF-8, or no such columns.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as failed:
        raise DataError(f"{url}: byte {failed.start} is not UTF-8, expected a CSV table") from None
    with decoding(url, "a CSV table", DataError):
        header = next(csv.reader([text.partition("\n")[0].rstrip("\r")]), [])
    return intensity_columns(header, url)


def intensity_columns(header: Sequence[str], place: str) -> dict[str, str]:
    """Columns of stamps and life-cycle intensity among those of a table.

    Args:
        header: columns of the table.
        place: address or file, for messages.

    Raises:
        DataError: no such columns.
    """
    found = [
        column
        for column in header
        if column.casefold().startswith("carbon intensity gco")
        and re.search("life cycle|lca", column.casefold())
    ]
    if STAMP_COLUMN not in header or len(found) != 1:
        raise DataError(
            f"{place}: columns {shortened(', '.join(header), 200)}, expected {STAMP_COLUMN!r} and "
            "a carbon intensity of the life cycle"
        )
    return {"timestamp": STAMP_COLUMN, "avg_CI": found[0]}
