"""Generation by type of energy, of EIA-930 and ENTSO-E, as tables that ``read_carbon`` reads.

EIA-930 reports MWh of an hour, by balancing authorities of the USA. ENTSO-E (article 16.1.B&C,
document A75) reports mean power in MW of bidding zones and countries of Europe, over intervals of
15, 30 or 60 minutes that begin at their stamp, which are averaged to hours. Stamps are in UTC.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from datetime import date, timedelta
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError, shortened, suggestion
from sdc_taichi.exogenous.fetch.download import Request, read_key
from sdc_taichi.exogenous.fetch.services import STORAGE, Service, services
from sdc_taichi.exogenous.files import MAX_GAP_H
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.synthetic import FUELS, emission_factors
from sdc_taichi.user_file import decoding

MOST_EIA_ROWS = 5000
"""Largest number of rows of an answer of EIA-930."""
_EIA_FIRST_DAYS = (1, 11, 21)
"""Days of a month on which a request to EIA-930 begins: 11 days of 18 sources are 4,752 rows."""
_RESOLUTION_MIN = {"PT15M": 15, "PT30M": 30, "PT60M": 60, "PT1H": 60}
_SLOT_MIN = 15
"""Length of the slots that intervals of ENTSO-E are divided into, in minutes."""
_SLOTS = 60 // _SLOT_MIN
_VARIABLE_BLOCKS = "A03"
"""Curve whose points are left out where the value stays (variable sized block)."""


class Period(NamedTuple):
    """Part of a year that one request covers."""

    first: int
    """First hour, counted from 1 January 00:00 UTC."""
    stop: int
    """Hour after the last."""


class YearOfRequests(NamedTuple):
    """Requests that together cover a calendar year in UTC."""

    area: str
    """Code of the area, for file names."""
    periods: list[Period]
    """Part of the year of each request."""
    requests: list[Request]
    """The requests."""


def year_of_requests(service: Service, area: str, year: int) -> YearOfRequests:
    """Requests of the generation in an area in a calendar year.

    Args:
        service: EIA-930 or ENTSO-E.
        area: code of a balancing authority, or name or code of a zone.
        year: calendar year, in UTC.

    Raises:
        DataError: no such area, or no key.
    """
    is_eia = service.name == "eia-930"
    code = _authority(area) if is_eia else zone_code(area)
    days = _EIA_FIRST_DAYS if is_eia else (1,)
    starts = [date(year, month, day) for month in range(1, 13) for day in days]
    ends = [*starts[1:], date(year + 1, 1, 1)]
    key = read_key(service)
    periods, requests = [], []
    for start, end in zip(starts, ends, strict=True):
        first = (start - date(year, 1, 1)).days * 24
        periods.append(Period(first, first + (end - start).days * 24))
        if is_eia:
            name = f"{code}_{start:%Y-%m-%d}.json"
            query = {
                "frequency": "hourly",
                "data[0]": "value",
                "facets[respondent][]": code,
                "start": f"{start:%Y-%m-%d}T00",
                "end": f"{end - timedelta(days=1):%Y-%m-%d}T23",
                "sort[0][column]": "period",
                "sort[0][direction]": "asc",
                "length": str(MOST_EIA_ROWS),
            }
        else:
            name = f"{code}_{start:%Y-%m}.xml"
            query = {
                "documentType": "A75",
                "processType": "A16",
                "in_Domain": code,
                "periodStart": f"{start:%Y%m%d}0000",
                "periodEnd": f"{end:%Y%m%d}0000",
            }
        check = eia_rows if is_eia else _entsoe_runs
        requests.append(Request(service, service.address, name, query, key, service.by_hand, check))
    return YearOfRequests(code, periods, requests)


def _authority(area: str) -> str:
    code = area.upper()
    if not re.fullmatch("[A-Z0-9]{2,8}", code):
        raise DataError(
            f"balancing authority {shortened(area)}: expected a code such as CISO, PJM or ERCO"
        )
    return code


def zone_code(zone: str) -> str:
    """Energy identification code of a zone of ENTSO-E by its name, or the code itself.

    Raises:
        DataError: neither a name nor a code.
    """
    zones = services()["entsoe"].zones
    name = zone.strip().upper().replace("-", "_")
    if name in zones:
        return zones[name]
    if re.fullmatch(r"\d\dY[A-Z0-9-]{12}[A-Z0-9]", zone.strip()):
        return zone.strip()
    raise DataError(
        f"zone {shortened(zone)}: expected one of {', '.join(zones)}, or an energy identification "
        f"code of 16 characters{suggestion(name, zones)}"
    )


def generation_of_year(
    service: Service, year: int, answers: Sequence[tuple[Period, bytes, str]]
) -> dict[str, FloatArray]:
    """Generation of each type in each hour of a calendar year, by stamp.

    Args:
        service: EIA-930 or ENTSO-E.
        year: calendar year, in UTC.
        answers: period, content and address of each answer.

    Returns:
        MWh in the hour, (T,) for each code of a type; NaN where it is not reported.

    Raises:
        DataError: names the address, row, field and value of what is wrong.
    """
    read = _add_eia if service.name == "eia-930" else _add_entsoe
    start = np.datetime64(f"{year}-01-01", "m")
    end = np.datetime64(f"{year + 1}-01-01", "m")
    slots = int((end - start).astype(int)) // _SLOT_MIN
    by_type: dict[str, FloatArray] = {}
    for period, content, url in answers:
        read(by_type, start, slots, period, content, url)
    return {name: values.reshape(-1, _SLOTS).mean(axis=1) for name, values in by_type.items()}


def eia_rows(content: bytes, url: str) -> list[dict[str, Any]]:
    """Rows of an answer of EIA-930.

    Raises:
        DataError: another format, rows that are left out, or none.
    """
    with decoding(url, "JSON", DataError):
        answer = json.loads(content)
    try:
        rows, total = answer["response"]["data"], int(answer["response"]["total"])
        rows = [dict(row) for row in rows]
    except (KeyError, TypeError, ValueError):
        raise DataError(f"{url}: no response.data, expected rows of EIA-930, version 2") from None
    if total > len(rows):
        raise DataError(f"{url}: {len(rows):,} of {total:,.0f} rows came, expected all of them")
    if not rows:
        raise DataError(
            f"{url}: no rows, expected a balancing authority that reports generation by energy "
            "source in this time, such as CISO, PJM or ERCO"
        )
    return rows


def _add_eia(
    by_type: dict[str, FloatArray],
    start: np.datetime64,
    slots: int,
    period: Period,
    content: bytes,
    url: str,
) -> None:
    """Add the generation of an answer of EIA-930 to that of the year, in slots of an hour."""
    hours = {
        str(start.astype("datetime64[h]") + hour): hour for hour in range(period.first, period.stop)
    }
    for number, row in enumerate(eia_rows(content, url), 1):
        unit, stamp, value = (row.get(name) for name in ("value-units", "period", "value"))
        if unit != "megawatthours":
            raise DataError(
                f"{url}: row {number}: value-units {shortened(unit)}, expected 'megawatthours'"
            )
        if stamp not in hours:
            raise DataError(
                f"{url}: row {number}: period {shortened(stamp)}, expected an hour of the request, "
                f"such as {next(iter(hours))}"
            )
        if "fueltype" not in row:
            raise DataError(f"{url}: row {number}: no fueltype, expected a code such as SUN")
        if value is None:
            continue
        try:
            mwh = float(value)
        except (TypeError, ValueError):
            mwh = np.nan
        if not np.isfinite(mwh):
            raise DataError(f"{url}: row {number}: value: {shortened(value)}, expected a number")
        first = hours[stamp] * _SLOTS
        series = by_type.setdefault(str(row["fueltype"]), np.full(slots, np.nan))
        series[first : first + _SLOTS] = mwh


def _add_entsoe(
    by_type: dict[str, FloatArray],
    start: np.datetime64,
    slots: int,
    period: Period,
    content: bytes,
    url: str,
) -> None:
    """Add the power of an answer of ENTSO-E to that of the year."""
    for kind, run_start, power in _entsoe_runs(content, url):
        at = int((run_start - start).astype(int)) // _SLOT_MIN
        # An answer may hold more than the request; each period has an answer of its own.
        low = max(at, period.first * _SLOTS)
        high = min(at + power.size, period.stop * _SLOTS)
        if low < high:
            series = by_type.setdefault(kind, np.full(slots, np.nan))
            part = power[low - at : high - at]
            series[low:high] = np.where(np.isnan(part), series[low:high], part)


def _entsoe_runs(content: bytes, url: str) -> list[tuple[str, np.datetime64, FloatArray]]:
    """Type, start and mean power in MW, in slots, of each run of intervals of an answer.

    What storage consumes is left out.
    """
    with decoding(url, "XML", DataError):
        root = ElementTree.fromstring(content)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if root.tag == "Acknowledgement_MarketDocument":
        raise DataError(f"{url}: {shortened(' '.join(x.text or '' for x in root.iter('text')))}")
    if root.tag != "GL_MarketDocument":
        raise DataError(f"{url}: {root.tag}, expected GL_MarketDocument")
    every_series = root.findall("TimeSeries")
    if not every_series:
        raise DataError(f"{url}: no TimeSeries, expected generation per type")
    runs = []
    for number, series in enumerate(every_series, 1):
        if series.find("outBiddingZone_Domain.mRID") is not None:
            continue
        unit = _text(series, "quantity_Measure_Unit.name", url)
        if unit != "MAW":
            raise DataError(
                f"{url}: TimeSeries {number}: unit {shortened(unit)}, expected MAW (MW)"
            )
        kind = _text(series, "psrType", url)
        repeated = series.findtext("curveType") == _VARIABLE_BLOCKS
        for period in series.findall("Period"):
            runs.append((kind, *_run(period, kind, repeated=repeated, url=url)))
    return runs


def _run(
    period: ElementTree.Element, kind: str, *, repeated: bool, url: str
) -> tuple[np.datetime64, FloatArray]:
    """Start and power in MW, in slots, of an element Period."""
    resolution = _text(period, "resolution", url)
    minutes = _RESOLUTION_MIN.get(resolution)
    if minutes is None:
        known = ", ".join(_RESOLUTION_MIN)
        raise DataError(f"{url}: resolution {shortened(resolution)}, expected one of {known}")
    start, end = (_time(_text(period, name, url), url) for name in ("start", "end"))
    count = int((end - start).astype(int)) // minutes
    if not 0 < count <= 366 * 24 * _SLOTS or int(start.astype(int)) % _SLOT_MIN:
        raise DataError(f"{url}: a period from {start} to {end}, expected whole intervals")
    power = np.full(count, np.nan)
    for point in period.findall("Point"):
        position, quantity = _text(point, "position", url), _text(point, "quantity", url)
        try:
            at, value = int(position), float(quantity)
        except ValueError:
            at, value = 0, np.nan
        if not 1 <= at <= count or not np.isfinite(value):
            raise DataError(
                f"{url}: type {kind} from {start}: position {shortened(position)} and quantity "
                f"{shortened(quantity)}, expected 1 to {count} and a number of MW"
            )
        power[at - 1] = value
    if repeated:
        last = np.where(np.isnan(power), 0, np.arange(count))
        power = power[np.maximum.accumulate(last)]
    return start, np.repeat(power, minutes // _SLOT_MIN)


def _time(text: str, url: str) -> np.datetime64:
    """A stamp such as 2024-01-31T23:00Z."""
    if not re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d(:00)?Z", text):
        raise DataError(f"{url}: time {shortened(text)}, expected one such as 2024-01-31T23:00Z")
    try:
        return np.datetime64(text.removesuffix("Z"), "m")
    except ValueError:
        raise DataError(f"{url}: time {shortened(text)}, expected a day of the calendar") from None


def _text(element: ElementTree.Element, name: str, url: str) -> str:
    """Text of the first descendant with a name."""
    text = next((x.text for x in element.iter(name) if x.text), None)
    if text is None:
        raise DataError(f"{url}: no {name}, so the format is not the one known here")
    return text.strip()


def by_column(
    by_type: Mapping[str, FloatArray], service: Service, periods: Sequence[Period]
) -> tuple[FloatArray, list[str]]:
    """Generation of the eight columns of a carbon table.

    Services leave out what an area does not have, so a type counts as 0 in more than a day before
    its first and after its last value, and in periods without any value of it. Other hours stay
    missing, for the reader to fill or to refuse.

    Args:
        by_type: generation in each hour of the year, in MWh, (T,) for each type; NaN is missing.
        service: its types and the columns that they count as.
        periods: parts of the year that were requested one by one.

    Returns:
        Generation in MWh, (T, 8), NaN where it is missing, and notes.
    """
    values = np.zeros((periods[-1].stop, len(FUELS)))
    notes = []
    for name, series in sorted(by_type.items()):
        column = service.types[name].counts_as if name in service.types else "OTH"
        if name not in service.types:
            notes.append(f"warning: type {name} is not known and counts as OTH")
        if column == STORAGE:
            notes.append(f"{name} (storage) left out")
            continue
        if column != name:
            notes.append(f"{name} counts as {column}")
        series = series.copy()
        absent = _absent(series, periods)
        series[absent] = 0.0
        if absent.any():
            notes.append(f"{name} is not reported for {int(absent.sum())} h, which count as 0")
        below = series < 0.0
        if below.any():
            notes.append(f"{int(below.sum())} negative values of {name} set to 0")
            series[below] = 0.0
        values[:, FUELS.index(column)] += series
    # An hour of which nothing at all is known.
    values[~(np.nansum(values, axis=1) > 0.0)] = np.nan
    return values, notes


def _absent(series: FloatArray, periods: Sequence[Period]) -> NDArray[np.bool_]:
    """Hours in which a type of energy is not reported rather than missing, (T,)."""
    missing = np.isnan(series)
    absent = np.zeros(missing.size, dtype=bool)
    known = np.flatnonzero(~missing)
    ends = (known[0], known[-1] + 1) if known.size else (missing.size, missing.size)
    for edge in (slice(0, ends[0]), slice(ends[1], None)):
        absent[edge] = absent[edge].size > MAX_GAP_H
    for first, stop in periods:
        if missing[first:stop].all():
            absent[first:stop] = True
    return absent


def carbon_table(start: np.datetime64, values: FloatArray) -> bytes:
    """A carbon table as CSV, with the average intensity by the factors of this package.

    Args:
        start: first hour, in UTC.
        values: generation of each hour in MWh, (T, 8), NaN where it is missing.
    """
    factors = np.array([emission_factors()[fuel] for fuel in FUELS])
    intensity = values @ factors / values.sum(axis=1)
    stamps = start.astype("datetime64[h]") + np.arange(len(values))
    lines = [",".join(("timestamp", *FUELS, "avg_CI"))]
    for stamp, row, average in zip(stamps.tolist(), values.tolist(), intensity, strict=True):
        cells = ["" if np.isnan(x) else f"{x:.6g}" for x in row]
        cells.append("" if np.isnan(average) else f"{average:.3f}")
        lines.append(f"{stamp:%Y-%m-%d %H:%M:%S}+00:00,{','.join(cells)}")
    return ("\n".join(lines) + "\n").encode()
