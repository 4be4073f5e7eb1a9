"""Hourly generation by energy source of balancing authorities of the USA: form EIA-930.

Stamps are in UTC. They mark the end of the hour, but not with every authority, so that the reader
finds out from the solar generation (``exogenous.stamps``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, timedelta
from typing import Any

import numpy as np

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous.fetch.answers import field, number, read_json
from sdc_taichi.exogenous.fetch.generation import STORAGE, Period, hours_of_year
from sdc_taichi.exogenous.fetch.request import Key, Request, Service
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.synthetic import FUELS

SERVICE = Service(
    name="eia-930",
    title="EIA-930, U.S. Energy Information Administration",
    licence="public domain (work of the U.S. government)",
    page="https://www.eia.gov/opendata/register.php",
)
ADDRESS = "https://api.eia.gov/v2/electricity/rto/fuel-type-data/data/"
"""Address of generation by energy source, version 2 of the service."""
KEY_VARIABLE = "EIA_API_KEY"
"""Environment variable of the key."""
FIRST_YEAR = 2019
"""First whole year of generation by energy source."""
COLUMNS: dict[str, str | None] = {
    **{fuel: fuel for fuel in FUELS},
    # Reported by some authorities since 2024, and as one of the above before.
    "SNB": "SUN",
    "WNB": "WND",
    "GEO": "OTH",
    "UNK": "OTH",
    **dict.fromkeys(("BAT", "PS", "OES", "UES"), STORAGE),
}
"""Column of each energy source: SNB and WNB are solar and wind plants with batteries, GEO is
geothermal, UNK unknown; BAT, PS, OES and UES are batteries, pumped and other storage."""
MOST_ROWS = 5000
"""Largest number of rows of an answer."""
_AUTHORITY = re.compile(r"[A-Z0-9]{2,8}")
_FIRST_DAYS = (1, 11, 21)
"""Days on which a request begins: 11 days of 18 sources are 4,752 rows."""


def requests_of_year(authority: str, year: int, key: Key) -> list[tuple[Period, Request]]:
    """Requests of the generation of a balancing authority in a calendar year, in UTC.

    Args:
        authority: code of the balancing authority, such as ``CISO``.
        year: calendar year.
        key: key of the service.

    Raises:
        DataError: no code.
    """
    if not _AUTHORITY.fullmatch(authority):
        raise DataError(
            f"balancing authority {shortened(authority)}: expected a code such as CISO, PJM or ERCO"
        )
    starts = [date(year, month, day) for month in range(1, 13) for day in _FIRST_DAYS]
    ends = [*starts[1:], date(year + 1, 1, 1)]
    found = []
    for start, end in zip(starts, ends, strict=True):
        first = (start - date(year, 1, 1)).days * 24
        period = Period(first, first + (end - start).days * 24)
        query = {
            "frequency": "hourly",
            "data[0]": "value",
            "facets[respondent][]": authority,
            "start": f"{start:%Y-%m-%d}T00",
            "end": f"{end - timedelta(days=1):%Y-%m-%d}T23",
            "sort[0][column]": "period",
            "sort[0][direction]": "asc",
            "length": str(MOST_ROWS),
        }
        name = f"{authority}_{start:%Y-%m-%d}.json"
        request = Request(
            SERVICE,
            ADDRESS,
            name,
            query,
            key,
            by_hand="by hand: download hourly generation by energy source from "
            "https://www.eia.gov/electricity/gridmonitor, then data import --map eia-930",
            check=rows_of,
        )
        found.append((period, request))
    return found


def rows_of(content: bytes, url: str) -> list[dict[str, Any]]:
    """Rows of an answer.

    Raises:
        DataError: another format, rows that are left out, or none.
    """
    found = read_json(content, url)
    rows = field(found, url, "response", "data")
    total = number(field(found, url, "response", "total"), url, "response.total")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{url}: response.data is no list of rows")
    if total > len(rows):
        raise DataError(f"{url}: {len(rows):,} of {total:,.0f} rows came, expected all of them")
    if not rows:
        raise DataError(
            f"{url}: no rows, expected a balancing authority that reports generation by energy "
            "source in this time, such as CISO, PJM or ERCO"
        )
    return rows


def generation(year: int, answers: Sequence[tuple[Period, bytes, str]]) -> dict[str, FloatArray]:
    """Generation of each energy source in each hour of a calendar year, by stamp.

    Args:
        year: calendar year, in UTC.
        answers: period, content and address of each answer.

    Returns:
        MWh in the hour, (T,) for each source; NaN where nothing is reported.

    Raises:
        DataError: names the address, row, field and value of what is wrong.
    """
    hours = hours_of_year(year)
    start = np.datetime64(f"{year}-01-01T00", "h")
    found: dict[str, FloatArray] = {}
    for (first, stop), content, url in answers:
        for row, cells in enumerate(rows_of(content, url), 1):
            unit, stamp = cells.get("value-units"), cells.get("period")
            if unit != "megawatthours":
                raise DataError(
                    f"{url}: row {row}: value-units {shortened(unit)}, expected 'megawatthours'"
                )
            hour = _hour(stamp, start)
            if hour is None or not first <= hour < stop:
                raise DataError(
                    f"{url}: row {row}: period {shortened(stamp)}, expected an hour of the "
                    f"request, such as {start + first}"
                )
            source = field(cells, url, "fueltype")
            if cells.get("value") is None:
                continue
            value = number(cells["value"], url, f"row {row}: value")
            found.setdefault(str(source), np.full(hours, np.nan))[hour] = value
    return found


def _hour(stamp: object, start: np.datetime64) -> int | None:
    """Hours from ``start`` to a stamp such as 2024-01-31T23; None if it is no stamp."""
    if not isinstance(stamp, str) or not re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d", stamp):
        return None
    try:
        return int((np.datetime64(stamp, "h") - start).astype(int))
    except ValueError:
        return None
