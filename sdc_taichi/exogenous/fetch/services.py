"""Descriptions of public services of weather and carbon intensity, from ``services.yaml``."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import yaml
from pydantic import BaseModel, ConfigDict, Field

from sdc_taichi.exogenous.stamps import Stamp

ELECTRICITY_MAPS_RELEASE = "2025-04-03"
"""Default release of the tables of Electricity Maps, with the years 2021 to 2024."""
STORAGE = "storage"
"""Value of ``as`` for types that only return energy generated earlier."""


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class KeySource(_Record):
    """Source of the key of a service, and its place in the query."""

    variable: str
    """Environment variable with the key."""
    parameter: str
    """Query parameter for the key."""


class GenerationType(_Record):
    """A type of generation of a service."""

    counts_as: str = Field(alias="as")
    """Column of the carbon table to which this type is added, or ``storage``."""
    names: tuple[str, ...] = ()
    """Initial words of the type's names in tables that users saved."""


class SavedTable(_Record):
    """Layout of tables that users saved from the pages of a service.

    Column names are regular expressions. A table contains either intensities or generation, the
    latter with a column for each type or with a row for each type.
    """

    time: str
    """Column of the stamps or intervals."""
    time_format: str = "ISO8601"
    """Format of stamps, in the syntax of ``strptime``."""
    time_example: str = "2023-01-01 00:00"
    """A valid time, for messages."""
    intensity: str | None = None
    """Column of intensities; None in tables of generation."""
    unit: str = ""
    """Unit of the intensities, in the syntax of ``exogenous.columns``; empty for g/kWh."""
    expected: str = ""
    """Description of the columns of a table of intensities, for messages."""
    note: str = ""
    """Remark on the intensities for the user."""
    area: str | None = None
    """Column of the area; None if a table covers one area."""
    generation: tuple[str, ...] = ()
    """Patterns of columns of generation; the first group is the name of the type. The first pattern
    that matches any column is used."""
    type: str | None = None
    """Column of the type, in tables with a row for each type."""
    value: str | None = None
    """Column of the generation, in tables with a row for each type."""
    missing: tuple[str, ...] = ()
    """Cells that represent a missing value."""


class Service(_Record):
    """A public service."""

    name: str
    """Name in file names and commands, such as ``eia-930``."""
    title: str
    """Title with the publisher, for messages and notes."""
    licence: str
    """Licence of the data, as far as it is known."""
    page: str
    """Web page from which users get data by hand or apply for a key."""
    address: str = ""
    """Address for requests; empty if there are none."""
    key: KeySource | None = None
    """Key that the service needs; None if it needs none."""
    first_year: int | None = None
    """First complete calendar year of the data."""
    stamp: Stamp = "auto"
    """Moment of an interval that the service's stamps mark."""
    by_hand: str = ""
    """Instructions for getting the data by hand if the service cannot be reached."""
    types: dict[str, GenerationType] = {}
    """Types of generation by code."""
    zones: dict[str, str] = {}
    """Codes of areas by name."""
    saved_table: SavedTable | None = None
    """Layout of tables saved by users; None if the service has no such tables."""


@cache
def services() -> dict[str, Service]:
    """Return the services by name."""
    content = files(__package__).joinpath("services.yaml").read_text("utf-8")
    return {name: Service(name=name, **values) for name, values in yaml.safe_load(content).items()}
