"""What is asked of a service: address, key, largest answer, and how the answer is checked."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from urllib.parse import quote, urlencode, urlsplit

from sdc_taichi.errors import DataError

MOST_DOWNLOAD_BYTES = 64_000_000
"""Largest answer of a service, in bytes: fifty times that of a typical year of PVGIS."""
_KEY = re.compile(r"[A-Za-z0-9_-]{8,200}")


@dataclass(frozen=True)
class Service:
    """A service that data are fetched from."""

    name: str
    """Name in file names and commands, such as ``eia-930``."""
    title: str
    """Name for people, with the publisher."""
    licence: str
    """Licence of the data, or what is known of it."""
    page: str
    """Address of the page for people, where data can be had by hand or a key is asked for."""


@dataclass(frozen=True)
class Key:
    """A key of a user, which is sent to one service and shown nowhere."""

    variable: str
    """Environment variable that holds the key."""
    parameter: str
    """Parameter of the query that carries the key."""
    value: str = field(repr=False)
    """The key itself."""


@dataclass(frozen=True)
class Request:
    """One download from a service."""

    service: Service
    """The service that is asked."""
    address: str
    """Address without query."""
    file_name: str
    """Name of the file that the answer is kept in."""
    query: Mapping[str, str] = field(default_factory=dict)
    """Parameters of the query, without the key."""
    key: Key | None = None
    """Key that the service asks for; None if it asks for none."""
    by_hand: str = ""
    """What a user can do where the service cannot be reached, for messages."""
    check: Callable[[bytes, str], object] = lambda content, origin: None
    """Reads an answer, given the address for messages; raises DataError if it is not what was asked
    for."""
    most_bytes: int = MOST_DOWNLOAD_BYTES
    """Largest valid answer, in bytes."""

    @property
    def url(self) -> str:
        """Address with query, without the key."""
        return self._with_query(self.query)

    @property
    def secret_url(self) -> str:
        """Address with query and key, to be sent and nothing else."""
        if self.key is None:
            return self.url
        return self._with_query({**self.query, self.key.parameter: self.key.value})

    @property
    def host(self) -> str:
        """Host that is asked."""
        return urlsplit(self.address).hostname or self.address

    def without_key(self, content: bytes) -> bytes:
        """Text of a service without the key, which some services repeat in their answers."""
        return content if self.key is None else content.replace(self.key.value.encode(), b"KEY")

    def _with_query(self, query: Mapping[str, str]) -> str:
        return f"{self.address}?{urlencode(query, quote_via=quote)}" if query else self.address


def read_key(service: Service, variable: str, parameter: str) -> Key:
    """The key of a service, from the environment.

    Args:
        service: the service that asks for the key.
        variable: environment variable that holds the key.
        parameter: parameter of the query that carries the key.

    Raises:
        DataError: the variable is not set, or holds no key; the message does not show it.
    """
    value = os.environ.get(variable, "").strip()
    if not value:
        raise DataError(
            f"{variable}: not set, expected the key of {service.title}, which is free of charge at "
            f"{service.page}"
        )
    if not _KEY.fullmatch(value):
        raise DataError(
            f"{variable}: no key, expected 8 to 200 letters, digits, '-' or '_' as {service.page} "
            "gives them"
        )
    return Key(variable, parameter, value)
