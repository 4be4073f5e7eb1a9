"""Generation by energy source from EIA-930 and ENTSO-E, as tables that ``read_carbon`` reads.

EIA-930 reports MWh per hour for balancing authorities of the USA. ENTSO-E (article 16.1.B&C,
document A75) reports mean power in MW for bidding zones and countries of Europe. Its intervals of
15, 30 or 60 minutes begin at their stamp and are averaged to hours here. Stamps are in UTC.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Sequence
from datetime import date, datetime, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError, shortened, suggestion
from sdc_taichi.exogenous.fetch.download import Request, read_key
from sdc_taichi.exogenous.fetch.services import STORAGE, Service, services
from sdc_taichi.exogenous.files import MAX_GAP_H, Table
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.synthetic import FUELS, emission_factors
from sdc_taichi.user_file import decoding

if TYPE_CHECKING:
    import pandas as pd

MOST_EIA_ROWS = 5000
"""Maximum number of rows in an answer of EIA-930."""
_EIA_FIRST_DAYS = (1, 11, 21)
"""First days, within a month, of requests to EIA-930; 11 days of 18 sources have 4,752 rows."""
_RESOLUTION_MIN = {"PT15M": 15, "PT30M": 30, "PT60M": 60, "PT1H": 60}
_SLOT_MIN = 15
"""Length of the time slots into which intervals of ENTSO-E are divided, in minutes."""
_MOST_INTERVALS = 366 * 24 * 60 // _SLOT_MIN
_VARIABLE_BLOCKS = "A03"
"""Code of curves in which repeated values are omitted (variable sized block)."""


class Period(NamedTuple):
    """Days in UTC that one request covers."""

    first: date
    """First day."""
    stop: date
    """Day after the last day."""

    def hours(self) -> pd.DatetimeIndex:
        """Return the beginning of each hour."""
        import pandas as pd

        return pd.date_range(self.first, self.stop, freq="h", inclusive="left")


class YearOfRequests(NamedTuple):
    """Requests that together cover a calendar year in UTC."""

    area: str
    """Code of the area, for file names."""
    periods: list[Period]
    """Period of the year that each request covers."""
    requests: list[Request]
    """Requests, one for each period."""


def year_of_requests(service: Service, area: str, year: int) -> YearOfRequests:
    """Build the requests for the generation in an area in a calendar year.

    Args:
        service: EIA-930 or ENTSO-E.
        area: code of a balancing authority, or name or code of a zone.
        year: calendar year, in UTC.

    Raises:
        DataError: the area is unknown, or there is no key.
    """
    is_eia = service.name == "eia-930"
    code = _authority(area) if is_eia else zone_code(area)
    days = _EIA_FIRST_DAYS if is_eia else (1,)
    starts = [date(year, month, day) for month in range(1, 13) for day in days]
    key = read_key(service)
    check: Callable[[bytes, str], object] = eia_rows if is_eia else _entsoe_runs
    periods, requests = [], []
    for start, stop in zip(starts, [*starts[1:], date(year + 1, 1, 1)], strict=True):
        if is_eia:
            name = f"{code}_{start:%Y-%m-%d}.json"
            query = {
                "frequency": "hourly",
                "data[0]": "value",
                "facets[respondent][]": code,
                "start": f"{start:%Y-%m-%d}T00",
                "end": f"{stop - timedelta(days=1):%Y-%m-%d}T23",
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
                "periodEnd": f"{stop:%Y%m%d}0000",
            }
        periods.append(Period(start, stop))
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
    """Return the energy identification code of an ENTSO-E zone, given its name or code.

    Raises:
        DataError: the text is neither a name nor a code.
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


def read_generation(service: Service, period: Period, content: bytes, url: str) -> pd.DataFrame:
    """Read the generation of each type in each hour from an answer.

    Args:
        service: EIA-930 or ENTSO-E.
        period: days that were requested.
        content: the answer.
        url: address, for messages.

    Returns:
        MWh per hour by type code, indexed by the service's UTC stamps of the hours; NaN for values
        that are not reported.

    Raises:
        DataError: the answer is not valid; the message names address, row, field and value.
    """
    if service.name == "eia-930":
        return _eia_generation(content, url, period.hours())
    return _entsoe_generation(content, url, period.hours())


def hourly_means(table: pd.DataFrame, hours: pd.DatetimeIndex, minutes: int) -> pd.DataFrame:
    """Return hourly means of a table; NaN if a part of the hour is missing.

    Args:
        table: values indexed by stamps that are multiples of ``minutes``.
        hours: contiguous hours of the result.
        minutes: resolution of the table, a divisor of 60.
    """
    import pandas as pd

    slots = pd.date_range(hours[0], periods=len(hours) * (60 // minutes), freq=f"{minutes}min")
    values = table.reindex(slots).to_numpy(dtype=np.float64)
    means = values.reshape(len(hours), -1, table.shape[1]).mean(axis=1)
    return pd.DataFrame(means, hours, table.columns)


def eia_rows(content: bytes, url: str) -> list[dict[str, Any]]:
    """Parse the rows of an answer of EIA-930.

    Raises:
        DataError: the format is unknown, rows are missing, or there are none.
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


def _eia_generation(content: bytes, url: str, hours: pd.DatetimeIndex) -> pd.DataFrame:
    """Return hourly generation by type from an answer of EIA-930."""
    import pandas as pd

    rows = pd.DataFrame(eia_rows(content, url))
    rows = rows.reindex(columns=["period", "fueltype", "value", "value-units"])
    rows.index = pd.RangeIndex(1, len(rows) + 1)
    table = Table(url, rows)
    table.refuse("value-units", rows["value-units"] != "megawatthours", "'megawatthours'")
    stamps = pd.to_datetime(rows["period"].astype(str), format="%Y-%m-%dT%H", errors="coerce")
    valid = f"an hour of the request, such as {hours[0]:%Y-%m-%dT%H}"
    table.refuse("period", ~stamps.isin(hours), valid)
    table.refuse("fueltype", rows["fueltype"].isna(), "a code such as SUN")
    values = pd.to_numeric(rows["value"], errors="coerce")
    table.refuse("value", rows["value"].notna() & ~np.isfinite(values), "a number")
    return values.groupby([stamps, rows["fueltype"].astype(str)]).last().unstack().reindex(hours)


def _entsoe_generation(content: bytes, url: str, hours: pd.DatetimeIndex) -> pd.DataFrame:
    """Return hourly generation by type for ``hours``, from an answer of ENTSO-E."""
    import pandas as pd

    by_type: dict[str, pd.Series[float]] = {}
    for kind, start, power in _entsoe_runs(content, url):
        slots = pd.date_range(start, periods=power.size, freq=f"{_SLOT_MIN}min")
        run = pd.Series(power, slots)
        by_type[kind] = run.combine_first(by_type[kind]) if kind in by_type else run
    return hourly_means(pd.DataFrame(by_type), hours, _SLOT_MIN)


def _entsoe_runs(content: bytes, url: str) -> list[tuple[str, datetime, FloatArray]]:
    """Return type, start, and mean power in MW per slot, of each run of intervals in an answer.

    Consumption of storage is skipped.
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
) -> tuple[datetime, FloatArray]:
    """Parse an element Period; return its start and its power in MW per slot."""
    resolution = _text(period, "resolution", url)
    minutes = _RESOLUTION_MIN.get(resolution)
    if minutes is None:
        known = ", ".join(_RESOLUTION_MIN)
        raise DataError(f"{url}: resolution {shortened(resolution)}, expected one of {known}")
    start, end = (_time(_text(period, name, url), url) for name in ("start", "end"))
    count = (end - start) // timedelta(minutes=minutes)
    if not 0 < count <= _MOST_INTERVALS or start.minute % _SLOT_MIN:
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


def _time(text: str, url: str) -> datetime:
    """Parse a UTC time such as 2024-01-31T23:00Z."""
    with contextlib.suppress(ValueError):
        return datetime.strptime(re.sub(r"(:\d\d):00Z$", r"\1Z", text), "%Y-%m-%dT%H:%MZ")
    raise DataError(f"{url}: time {shortened(text)}, expected one such as 2024-01-31T23:00Z")


def _text(element: ElementTree.Element, name: str, url: str) -> str:
    """Return the text of the first descendant element with a given name."""
    text = next((x.text for x in element.iter(name) if x.text), None)
    if text is None:
        raise DataError(f"{url}: no {name}, so the format is not the one known here")
    return text.strip()


def carbon_table(parts: Sequence[pd.DataFrame], service: Service) -> tuple[bytes, list[str]]:
    """Convert generation to a carbon table as CSV, with intensity by our factors, and notes.

    Services omit types that an area does not have. A type therefore counts as 0 before its first
    and after its last value, if that lasts more than a day, and in parts without any value of it.
    Other missing hours remain missing; the reader fills or refuses them.

    Args:
        parts: contiguous parts of the time, each with hourly generation in MWh by type, indexed by
            stamps in UTC; NaN for missing values.
        service: service with its types and the columns as which they count.
    """
    import pandas as pd

    by_type = pd.concat(parts)
    lengths = [len(part) for part in parts]
    values = np.zeros((len(by_type), len(FUELS)))
    notes = []
    for name in sorted(by_type.columns):
        column = service.types[name].counts_as if name in service.types else "OTH"
        if name not in service.types:
            notes.append(f"warning: type {name} is not known and counts as OTH")
        if column == STORAGE:
            notes.append(f"{name} (storage) left out")
            continue
        if column != name:
            notes.append(f"{name} counts as {column}")
        series = by_type[name].to_numpy(dtype=np.float64, copy=True)
        absent = _absent(series, lengths)
        series[absent] = 0.0
        if absent.any():
            notes.append(f"{name} is not reported for {int(absent.sum())} h, which count as 0")
        below = series < 0.0
        if below.any():
            notes.append(f"{int(below.sum())} negative values of {name} set to 0")
            series[below] = 0.0
        values[:, FUELS.index(column)] += series
    # Hours without any known generation are missing.
    values[~(np.nansum(values, axis=1) > 0.0)] = np.nan
    factors = np.array([emission_factors()[fuel] for fuel in FUELS])
    intensity = values @ factors / values.sum(axis=1)
    lines = [",".join(("timestamp", *FUELS, "avg_CI"))]
    for stamp, row, average in zip(by_type.index, values.tolist(), intensity, strict=True):
        cells = ["" if np.isnan(x) else f"{x:.6g}" for x in row]
        cells.append("" if np.isnan(average) else f"{average:.3f}")
        lines.append(f"{stamp:%Y-%m-%d %H:%M:%S}+00:00,{','.join(cells)}")
    return ("\n".join(lines) + "\n").encode(), notes


def _absent(series: FloatArray, lengths: Sequence[int]) -> NDArray[np.bool_]:
    """Return True for each hour in which the area does not have an energy type, (T,).

    Args:
        series: generation of the type, NaN for missing values, (T,).
        lengths: number of hours in each part.
    """
    missing = np.isnan(series)
    absent = np.zeros(missing.size, dtype=bool)
    known = np.flatnonzero(~missing)
    ends = (known[0], known[-1] + 1) if known.size else (missing.size, missing.size)
    for edge in (slice(0, ends[0]), slice(ends[1], None)):
        absent[edge] = absent[edge].size > MAX_GAP_H
    for part in np.split(np.arange(missing.size), np.cumsum(lengths)[:-1]):
        if missing[part].all():
            absent[part] = True
    return absent
