"""Public services of weather and carbon intensity, as ``services.yaml`` describes them."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import yaml
from pydantic import BaseModel, ConfigDict, Field

from sdc_taichi.exogenous.stamps import Stamp

ELECTRICITY_MAPS_RELEASE = "2025-04-03"
"""Release of the tables of Electricity Maps unless another is named; it has 2021 to 2024."""
STORAGE = "storage"
"""What a kind of generation counts as that only gives back what was generated before."""


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class KeySource(_Record):
    """Where the key of a service comes from and goes to."""

    variable: str
    """Environment variable that holds the key."""
    parameter: str
    """Parameter of the query that carries the key."""


class GenerationType(_Record):
    """A kind of generation."""

    counts_as: str = Field(alias="as")
    """Column of a carbon table, or ``storage``."""
    names: tuple[str, ...] = ()
    """Beginnings of its names in tables that were saved by hand."""


class SavedTable(_Record):
    """Layout of tables saved by hand from the pages of a service.

    Names of columns are regular expressions. A table has intensities, or generation with a column
    for each type or with a row for each type.
    """

    time: str
    """Column of the stamps or intervals."""
    time_format: str = "ISO8601"
    """Format of stamps, as of ``strptime``."""
    time_example: str = "2023-01-01 00:00"
    """A valid time, for messages."""
    intensity: str | None = None
    """Column of intensities; None in tables of generation."""
    unit: str = ""
    """Unit of the intensities, as of ``exogenous.columns``; empty is g/kWh."""
    expected: str = ""
    """Columns of a table of intensities, for messages."""
    note: str = ""
    """What a user should know of the intensities."""
    area: str | None = None
    """Column of the area; None if a table holds one area."""
    generation: tuple[str, ...] = ()
    """Columns of generation, whose first group is the name of the type; the first pattern that
    fits any column is used."""
    type: str | None = None
    """Column of the type, in tables with a row for each type."""
    value: str | None = None
    """Column of the generation, in tables with a row for each type."""
    missing: tuple[str, ...] = ()
    """Cells that stand for no value."""


class Service(_Record):
    """A public service."""

    name: str
    """Name in file names and commands, such as ``eia-930``."""
    title: str
    """Name for people, with the publisher."""
    licence: str
    """Licence of the data, or what is known of it."""
    page: str
    """Address of the page for people, where data can be had by hand or a key is asked for."""
    address: str = ""
    """Address that requests go to; empty if none do."""
    key: KeySource | None = None
    """Key that the service asks for; None if it asks for none."""
    first_year: int | None = None
    """First whole calendar year of the data."""
    stamp: Stamp = "auto"
    """What its stamps mark."""
    by_hand: str = ""
    """How a user gets the data where the service cannot be reached."""
    types: dict[str, GenerationType] = {}
    """Kinds of generation by code."""
    zones: dict[str, str] = {}
    """Codes of areas by name."""
    saved_table: SavedTable | None = None
    """Layout of tables saved by hand; None if none are read."""


@cache
def services() -> dict[str, Service]:
    """Services by name."""
    content = files(__package__).joinpath("services.yaml").read_text("utf-8")
    return {name: Service(name=name, **values) for name, values in yaml.safe_load(content).items()}
