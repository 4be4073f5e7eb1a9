"""Generation per type of bidding zones and countries in Europe: ENTSO-E, article 16.1.B&C (A75).

Values are mean power in MW over intervals of 15, 30 or 60 minutes that begin at their stamp, in
UTC. They are averaged to hours.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from datetime import date
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from sdc_taichi.errors import DataError, shortened, suggestion
from sdc_taichi.exogenous.fetch.generation import STORAGE, Period, hours_of_year
from sdc_taichi.exogenous.fetch.request import Key, Request, Service
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.user_file import decoding

SERVICE = Service(
    name="entsoe",
    title="ENTSO-E Transparency Platform",
    licence="CC BY 4.0 for what is on the platform's list of data for free re-use",
    page="https://transparency.entsoe.eu",
)
ADDRESS = "https://web-api.tp.entsoe.eu/api"
"""Address of the service."""
KEY_VARIABLE = "ENTSOE_API_KEY"
"""Environment variable of the key, which the platform calls a security token."""
FIRST_YEAR = 2015
"""First whole year of the platform."""
COLUMNS: dict[str, str | None] = {
    **dict.fromkeys(("B02", "B05", "B07", "B08"), "COL"),
    **dict.fromkeys(("B03", "B04"), "NG"),
    "B06": "OIL",
    **dict.fromkeys(("B11", "B12"), "WAT"),
    "B14": "NUC",
    "B16": "SUN",
    **dict.fromkeys(("B18", "B19"), "WND"),
    **dict.fromkeys(("B01", "B09", "B13", "B15", "B17", "B20"), "OTH"),
    **dict.fromkeys(("B10", "B25"), STORAGE),
}
"""Column of each type of the platform: lignite, hard coal, oil shale and peat count as COL, gas
made of coal as NG; biomass, geothermal, marine, other renewable, waste and other as OTH; pumped
hydro and other storage are left out. Electricity Maps groups them likewise (parser of ENTSO-E of
the project electricitymaps-contrib)."""
ZONES = {
    "AL": "10YAL-KESH-----5",
    "AT": "10YAT-APG------L",
    "BA": "10YBA-JPCC-----D",
    "BE": "10YBE----------2",
    "BG": "10YCA-BULGARIA-R",
    "CH": "10YCH-SWISSGRIDZ",
    "CY": "10YCY-1001A0003J",
    "CZ": "10YCZ-CEPS-----N",
    "DE": "10Y1001A1001A83F",
    "DE_LU": "10Y1001A1001A82H",
    "DK": "10Y1001A1001A65H",
    "DK_1": "10YDK-1--------W",
    "DK_2": "10YDK-2--------M",
    "EE": "10Y1001A1001A39I",
    "ES": "10YES-REE------0",
    "FI": "10YFI-1--------U",
    "FR": "10YFR-RTE------C",
    "GR": "10YGR-HTSO-----Y",
    "HR": "10YHR-HEP------M",
    "HU": "10YHU-MAVIR----U",
    "IE_SEM": "10Y1001A1001A59C",
    "IT": "10YIT-GRTN-----B",
    "IT_CALA": "10Y1001C--00096J",
    "IT_CNOR": "10Y1001A1001A70O",
    "IT_CSUD": "10Y1001A1001A71M",
    "IT_NORD": "10Y1001A1001A73I",
    "IT_SARD": "10Y1001A1001A74G",
    "IT_SICI": "10Y1001A1001A75E",
    "IT_SUD": "10Y1001A1001A788",
    "LT": "10YLT-1001A0008Q",
    "LV": "10YLV-1001A00074",
    "ME": "10YCS-CG-TSO---S",
    "MK": "10YMK-MEPSO----8",
    "NL": "10YNL----------L",
    "NO_1": "10YNO-1--------2",
    "NO_2": "10YNO-2--------T",
    "NO_3": "10YNO-3--------J",
    "NO_4": "10YNO-4--------9",
    "NO_5": "10Y1001A1001A48H",
    "PL": "10YPL-AREA-----S",
    "PT": "10YPT-REN------W",
    "RO": "10YRO-TEL------P",
    "RS": "10YCS-SERBIATSOV",
    "SE_1": "10Y1001A1001A44P",
    "SE_2": "10Y1001A1001A45N",
    "SE_3": "10Y1001A1001A46L",
    "SE_4": "10Y1001A1001A47J",
    "SI": "10YSI-ELES-----O",
    "SK": "10YSK-SEPS-----K",
}
"""Energy identification codes of bidding zones and countries (ENTSO-E, allocated EIC codes)."""
_CODE = re.compile(r"\d\dY[A-Z0-9-]{12}[A-Z0-9]")
_SLOT_MIN = 15
"""Length of the slots that intervals are spread over, in minutes."""
_SLOTS = 60 // _SLOT_MIN
_RESOLUTION_MIN = {"PT15M": 15, "PT30M": 30, "PT60M": 60, "PT1H": 60}
_REPEATED = "A03"
"""Curve whose points are left out where the value stays (variable sized block)."""


class _Points(NamedTuple):
    """A run of intervals of one type."""

    type: str
    """Type of generation, such as ``B16``."""
    start: np.datetime64
    """Start of the run, UTC, in minutes."""
    minutes: int
    """Length of an interval."""
    power_mw: FloatArray
    """Mean power of each interval, (T,); NaN where it is missing."""


def zone_code(zone: str) -> str:
    """Energy identification code of a zone by its name, or the code itself.

    Raises:
        DataError: neither a name nor a code.
    """
    name = zone.strip().upper().replace("-", "_")
    if name in ZONES:
        return ZONES[name]
    if _CODE.fullmatch(zone.strip()):
        return zone.strip()
    raise DataError(
        f"zone {shortened(zone)}: expected one of {', '.join(ZONES)}, or an energy identification "
        f"code of 16 characters{suggestion(name, ZONES)}"
    )


def requests_of_year(zone: str, year: int, key: Key) -> list[tuple[Period, Request]]:
    """Requests of the generation of a zone in a calendar year, in UTC, a month each.

    Args:
        zone: name or code of the zone.
        year: calendar year.
        key: key of the service.

    Raises:
        DataError: no such zone.
    """
    code = zone_code(zone)
    found = []
    for month in range(1, 13):
        start = date(year, month, 1)
        end = date(year + month // 12, month % 12 + 1, 1)
        first = (start - date(year, 1, 1)).days * 24
        query = {
            "documentType": "A75",
            "processType": "A16",
            "in_Domain": code,
            "periodStart": f"{start:%Y%m%d}0000",
            "periodEnd": f"{end:%Y%m%d}0000",
        }
        request = Request(
            SERVICE,
            ADDRESS,
            f"{code}_{start:%Y-%m}.xml",
            query,
            key,
            by_hand="by hand: export actual generation per production type from "
            "https://transparency.entsoe.eu, then data import --map entsoe",
            check=lambda content, url: list(_runs(content, url)),
        )
        found.append((Period(first, first + (end - start).days * 24), request))
    return found


def generation(year: int, answers: Sequence[tuple[Period, bytes, str]]) -> dict[str, FloatArray]:
    """Generation of each type in each hour of a calendar year; a stamp marks the start.

    Args:
        year: calendar year, in UTC.
        answers: period, content and address of each answer.

    Returns:
        MWh in the hour, (T,) for each type; NaN where a part of the hour is missing.

    Raises:
        DataError: names the address and what is wrong.
    """
    slots = hours_of_year(year) * _SLOTS
    begin = np.datetime64(f"{year}-01-01T00:00", "m")
    found: dict[str, FloatArray] = {}
    for (first, stop), content, url in answers:
        for run in _runs(content, url):
            power = np.repeat(run.power_mw, run.minutes // _SLOT_MIN)
            at = int((run.start - begin).astype(int)) // _SLOT_MIN
            # An answer may hold more than the request; each period has an answer of its own.
            low, high = max(at, first * _SLOTS), min(at + power.size, stop * _SLOTS)
            if low < high:
                series = found.setdefault(run.type, np.full(slots, np.nan))
                part = power[low - at : high - at]
                series[low:high] = np.where(np.isnan(part), series[low:high], part)
    return {name: x.reshape(-1, _SLOTS).mean(axis=1) for name, x in found.items()}


def _runs(content: bytes, url: str) -> Iterator[_Points]:
    """Runs of generation of an answer; consumption of storage is left out."""
    with decoding(url, "XML", DataError):
        root = ElementTree.fromstring(content)
    if _name(root) == "Acknowledgement_MarketDocument":
        texts = [x.text.strip() for x in root.iter() if _name(x) == "text" and x.text]
        raise DataError(f"{url}: {shortened(' '.join(texts), 300)}")
    if _name(root) != "GL_MarketDocument":
        raise DataError(f"{url}: {_name(root)}, expected GL_MarketDocument")
    count = 0
    for series in (x for x in root if _name(x) == "TimeSeries"):
        count += 1
        if any(_name(x) == "outBiddingZone_Domain.mRID" for x in series):
            continue
        unit = _text(series, "quantity_Measure_Unit.name", url)
        if unit != "MAW":
            raise DataError(f"{url}: TimeSeries {count}: unit {shortened(unit)}, expected MAW (MW)")
        kind = _text(series, "psrType", url)
        curve = next((x.text for x in series if _name(x) == "curveType"), "")
        for period in (x for x in series if _name(x) == "Period"):
            yield _run(period, kind, repeated=curve == _REPEATED, url=url)
    if not count:
        raise DataError(f"{url}: no TimeSeries, expected generation per type")


def _run(period: ElementTree.Element, kind: str, *, repeated: bool, url: str) -> _Points:
    """Intervals of an element Period."""
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
    for point in (x for x in period if _name(x) == "Point"):
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
    return _Points(kind, start, minutes, power)


def _time(text: str, url: str) -> np.datetime64:
    """A stamp such as 2024-01-31T23:00Z."""
    if not re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d(:00)?Z", text):
        raise DataError(f"{url}: time {shortened(text)}, expected one such as 2024-01-31T23:00Z")
    try:
        return np.datetime64(text.removesuffix("Z"), "m")
    except ValueError:
        raise DataError(f"{url}: time {shortened(text)}, expected a day of the calendar") from None


def _text(element: ElementTree.Element, name: str, url: str) -> str:
    """Text of the first descendant of a name."""
    for found in element.iter():
        if _name(found) == name and found.text:
            return found.text.strip()
    raise DataError(f"{url}: no {name}, so the format is not the one known here")


def _name(element: ElementTree.Element) -> str:
    """Name of an element without its namespace."""
    return element.tag.rpartition("}")[2]
