"""Answers as PVGIS, EIA-930, ENTSO-E and Electricity Maps give them, with figures of our own."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import cache
from http.server import BaseHTTPRequestHandler
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from faulty_server import Answer, sends

MEGAWATTS = {"COL": 500.0, "NG": 3000.0, "NUC": 2000.0, "SUN": 0.0, "WND": 800.0}
"""Generation of each hour in MWh, besides the sun."""
TYPES = {"B05": 500.0, "B04": 3000.0, "B14": 2000.0, "B16": 0.0, "B19": 800.0}
"""The same by types of ENTSO-E."""


def by_query(make: Callable[[dict[str, str]], bytes], kind: str = "application/json") -> Answer:
    """An answer that depends on the query."""

    def answer(request: BaseHTTPRequestHandler) -> None:
        query = {k: v[0] for k, v in parse_qs(urlsplit(request.path).query).items()}
        sends(make(query), kind=kind)(request)

    return answer


@cache
def _pvgis_rows() -> str:
    hours = np.datetime64("2001-01-01T00", "h") + np.arange(8760)
    rows = []
    for at, hour in enumerate(hours.tolist()):
        # A typical year has months of different years.
        stamp = f"{2004 + hour.month}{hour:%m%d:%H}00"
        pressure = 99870.0 + 50.0 * (hour.day % 7)
        rows.append(
            {"time(UTC)": stamp, "T2m": at / 1000.0, "RH": 60.0, "G(h)": 9.0, "SP": pressure}
        )
    return json.dumps(rows)


def pvgis_year(latitude: float = 45.0, longitude: float = 8.0) -> dict[str, Any]:
    """A typical year of months of twelve years, whose dry bulb is the hour of the year / 1000."""
    location = {"latitude": latitude, "longitude": longitude, "elevation": 250.0}
    return {
        "inputs": {"location": location, "meteo_data": {"meteo_db": "ERA5"}},
        "outputs": {"tmy_hourly": json.loads(_pvgis_rows())},
    }


def solar_mwh(utc_end: datetime, utc_offset_h: float) -> float:
    """Solar generation of the hour that ends at a stamp, symmetric about local noon."""
    local = utc_end + timedelta(hours=utc_offset_h - 0.5)
    hour = local.hour + local.minute / 60.0
    return round(max(0.0, 2500.0 * float(np.cos(np.pi * (hour - 12.0) / 12.0))), 1)


def eia_rows(start: datetime, stop: datetime, utc_offset_h: float = -8.0) -> list[dict[str, Any]]:
    """Rows of EIA-930 from a stamp to another, values as text as the service writes them."""
    rows = []
    while start <= stop:
        for source, mwh in MEGAWATTS.items():
            value = solar_mwh(start, utc_offset_h) if source == "SUN" else mwh
            rows.append(
                {
                    "period": f"{start:%Y-%m-%dT%H}",
                    "respondent": "CISO",
                    "fueltype": source,
                    "value": f"{value:g}",
                    "value-units": "megawatthours",
                }
            )
        start += timedelta(hours=1)
    return rows


def eia_document(rows: list[dict[str, Any]], query: dict[str, str]) -> bytes:
    """An answer of version 2 of the service, which repeats what was asked, the key included."""
    response = {"total": str(len(rows)), "data": rows}
    return json.dumps({"response": response, "request": {"params": query}}).encode()


@cache
def _eia_text(start: str, stop: str) -> str:
    first, last = (datetime.strptime(x, "%Y-%m-%dT%H") for x in (start, stop))
    return json.dumps(eia_rows(first, last))


def eia(change: Callable[[list[dict[str, Any]]], object] = lambda rows: None) -> Answer:
    """EIA-930, with rows that a test changes."""

    def make(query: dict[str, str]) -> bytes:
        rows = json.loads(_eia_text(query["start"], query["end"]))
        change(rows)
        return eia_document(rows, query)

    return by_query(make)


def entsoe_series(
    kind: str,
    start: str,
    end: str,
    points: list[tuple[int, float]],
    resolution: str = "PT60M",
    curve: str = "A01",
    domain: str = "inBiddingZone_Domain.mRID",
    unit: str = "MAW",
) -> str:
    """A TimeSeries of generation."""
    text = "".join(
        f"<Point><position>{at}</position><quantity>{mw:g}</quantity></Point>" for at, mw in points
    )
    return (
        f"<TimeSeries><mRID>1</mRID><businessType>A01</businessType>"
        f"<objectAggregation>A08</objectAggregation>"
        f'<{domain} codingScheme="A01">10Y1001A1001A82H</{domain}>'
        f"<quantity_Measure_Unit.name>{unit}</quantity_Measure_Unit.name>"
        f"<curveType>{curve}</curveType><MktPSRType><psrType>{kind}</psrType></MktPSRType>"
        f"<Period><timeInterval><start>{start}</start><end>{end}</end></timeInterval>"
        f"<resolution>{resolution}</resolution>{text}</Period></TimeSeries>"
    )


def entsoe_document(*series: str) -> bytes:
    """A document of generation per type."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?><GL_MarketDocument '
        'xmlns="urn:iec62325.351:tc57wg16:451-6:generationloaddocument:3:0"><mRID>d</mRID>'
        f"<type>A75</type><process.processType>A16</process.processType>{''.join(series)}"
        "</GL_MarketDocument>"
    ).encode()


def entsoe_acknowledgement(text: str) -> bytes:
    """What the platform answers where it has no data."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?><Acknowledgement_MarketDocument '
        'xmlns="urn:iec62325.351:tc57wg16:451-1:acknowledgementdocument:7:0"><mRID>a</mRID>'
        f"<Reason><code>999</code><text>{text}</text></Reason></Acknowledgement_MarketDocument>"
    ).encode()


def entsoe(utc_offset_h: float = 1.0) -> Answer:
    """ENTSO-E: quarters of hours until June and hours afterwards, and pumps that consume."""

    def make(query: dict[str, str]) -> bytes:
        start, end = (
            datetime.strptime(query[x], "%Y%m%d%H%M") for x in ("periodStart", "periodEnd")
        )
        hours = round((end - start) / timedelta(hours=1))
        per_hour = 4 if start.month <= 6 else 1
        told = (f"{start:%Y-%m-%dT%H:%MZ}", f"{end:%Y-%m-%dT%H:%MZ}")
        resolution = f"PT{60 // per_hour}M"
        series = []
        for kind, mw in TYPES.items():
            points = [(1, mw)]
            if kind == "B16":
                points = [
                    (i * per_hour + 1, solar_mwh(start + timedelta(hours=i + 1), utc_offset_h))
                    for i in range(hours)
                ]
            series.append(entsoe_series(kind, *told, points, resolution, "A03"))
        pumps = "outBiddingZone_Domain.mRID"
        series.append(entsoe_series("B10", *told, [(1, 4000.0)], resolution, "A03", pumps))
        return entsoe_document(*series)

    return by_query(make, "text/xml")


def electricity_maps_table(
    year: int = 2023, column: str = "Carbon intensity gCO₂eq/kWh (Life cycle)"
) -> bytes:
    """A yearly table: the intensity is the hour of the day in UTC plus 100."""
    lines = [f"Datetime (UTC),Zone id,Carbon intensity gCO₂eq/kWh (direct),{column},Data source"]
    hours = np.arange(np.datetime64(f"{year}-01-01T00"), np.datetime64(f"{year + 1}-01-01T00"))
    lines += [f"{at:%Y-%m-%d %H}:00:00,FR,20.0,{100 + at.hour}.25,x" for at in hours.tolist()]
    return ("\n".join(lines) + "\n").encode()
