"""HTTP downloads, stored with their origin, so that a repeated fetch needs no network.

A download ends within a limited time, either with a complete answer or with an error of one line.
After temporary failures (no connection, no answer, statuses 408, 425, 429 and 5xx, an incomplete
answer) the request is repeated. The waits double each time, or follow the service's request.
No message, log or file contains the key, or a token in an address that the user gave.

Answers are stored in the folder of imported files, under ``downloads/SERVICE``. Each file is stored
as the service sent it, without the key. ``NAME.origin.json`` beside it has address, time, checksum
and licence.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from http import HTTPStatus
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode, urlsplit

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import DataError, SdcError, shortened
from sdc_taichi.exogenous.fetch.exchange import Answer, ExchangeError, Patience, exchange
from sdc_taichi.exogenous.fetch.redaction import Redaction, secrets_of_query
from sdc_taichi.exogenous.fetch.services import Service
from sdc_taichi.exogenous.registry import user_data_dir
from sdc_taichi.user_file import read_bytes

FORMAT = "sdc-download/1"
"""Name and version of the format of origin files."""
MOST_DOWNLOAD_BYTES = 64_000_000
"""Largest valid answer of a service, in bytes: fifty times a typical year of PVGIS."""
_MOST_ORIGIN_BYTES = 100_000
_PASSING = frozenset({408, 425, 429})
"""Statuses below 500 after which the request is repeated."""
_KEY = re.compile(r"[A-Za-z0-9_-]{8,200}")


@dataclass(frozen=True)
class Request:
    """One download from a service."""

    service: Service
    """Service to which the request is sent."""
    address: str
    """Address without the query."""
    file_name: str
    """Name of the file in which the answer is stored."""
    query: Mapping[str, str] = field(default_factory=dict)
    """Query parameters without the key."""
    key: str = field(default="", repr=False)
    """Key of the user; empty if the service needs none."""
    by_hand: str = ""
    """Instructions for a download by hand, for messages if the service cannot be reached."""
    check: Callable[[bytes, str], object] = lambda content, origin: None
    """Function ``(content, origin)`` that reads an answer, with its address for messages. It raises
    DataError if the answer is not what was requested."""
    most_bytes: int = MOST_DOWNLOAD_BYTES
    """Largest valid answer, in bytes."""
    private_query: str = field(default="", repr=False)
    """Query of an address that the user gave, which may hold tokens: sent, but neither shown nor
    stored."""

    @property
    def url(self) -> str:
        """Address with the query, without the key and the private query."""
        query = urlencode(self.query, quote_via=quote)
        return f"{self.address}?{query}" if query else self.address

    @property
    def private_url(self) -> str:
        """Address as it is sent, with the key and the private query."""
        key = self.service.key
        with_key = urlencode({key.parameter: self.key}, quote_via=quote) if self.key and key else ""
        private = "&".join(filter(None, (self.private_query, with_key)))
        return f"{self.url}{'&' if '?' in self.url else '?'}{private}" if private else self.url

    @property
    def redaction(self) -> Redaction:
        """Redaction of the secrets in the address."""
        return Redaction({self.key} | secrets_of_query(self.private_query))

    @property
    def host(self) -> str:
        """Host to which the request is sent."""
        return urlsplit(self.address).hostname or self.address


@dataclass(frozen=True)
class Kept:
    """An answer of a service, stored in a file."""

    path: Path
    """File with the answer."""
    content: bytes
    """Bytes of the answer."""
    origin: dict[str, Any]
    """Address without the key, time in UTC, checksum, licence and publisher."""


def read_key(service: Service) -> str:
    """Read the user's key of a service from its environment variable.

    Raises:
        DataError: the variable is not set or contains no key; the message does not show its value.
    """
    if service.key is None:
        return ""
    value = os.environ.get(service.key.variable, "").strip()
    if not value:
        raise DataError(
            f"{service.key.variable}: not set, expected the key of {service.title}, which is free "
            f"of charge at {service.page}"
        )
    if not _KEY.fullmatch(value):
        raise DataError(
            f"{service.key.variable}: no key, expected 8 to 200 letters, digits, '-' or '_' as "
            f"{service.page} gives them"
        )
    return value


def fetch(
    requested: Sequence[Request],
    *,
    refresh: bool = False,
    patience: Patience | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Kept]:
    """Return answers to requests, either stored ones or new downloads, which are then stored.

    Args:
        requested: the requests.
        refresh: True to download stored answers again.
        patience: limits on time and attempts of each download.
        progress: callback ``(done, total)`` with numbers of answers.

    Raises:
        DataError: an answer is not available or not valid; earlier answers remain stored.
    """
    answers = []
    for done, request in enumerate(requested):
        progress(done, len(requested))
        stored = None if refresh else _stored(request)
        answers.append(stored or _store(request, download(request, patience)))
    progress(len(requested), len(requested))
    return answers


def keep_file(request: Request, path: Path) -> Kept:
    """Store a file that the user downloaded as the answer to a request.

    Raises:
        DataError: the file cannot be read, or is not what was requested.
    """
    content = read_bytes(path, request.most_bytes, DataError)
    request.check(content, str(path))
    return _store(request, content)


def write_file(path: Path, content: bytes) -> Path:
    """Write a file atomically: readers see the old file or the complete new one.

    Raises:
        DataError: the file cannot be written.
    """
    try:
        with atomic_write(path, parents=True) as file:
            file.write(content)
    except SdcError as error:
        raise DataError(str(error)) from None
    return path


def downloads_dir(service: Service) -> Path:
    """Return the folder in which answers of a service are stored."""
    return user_data_dir() / "downloads" / service.name


def download(
    request: Request,
    patience: Patience | None = None,
    *,
    sleep: Callable[[float], None] = time.sleep,
) -> bytes:
    """Download an answer and check it.

    Args:
        request: the request.
        patience: limits on time and attempts.
        sleep: function that waits for a number of seconds.

    Returns:
        The answer without the key, which some services repeat in their answers.

    Raises:
        DataError: no answer came in time, the answer is too large or not what was requested, or
            the HTTP library is not installed.
    """
    if find_spec("requests") is None:
        raise DataError('data fetch needs the library requests: pip install "sdc-taichi[fetch]"')
    patience = patience or Patience()
    redaction = request.redaction
    try:
        return _download(request, redaction, patience, sleep)
    except DataError as error:
        raise DataError(redaction.in_text(str(error))) from None


def _download(
    request: Request, redaction: Redaction, patience: Patience, sleep: Callable[[float], None]
) -> bytes:
    end = time.monotonic() + patience.total_s
    by_hand = f"; by hand: {request.by_hand}" if request.by_hand else ""
    for attempt in range(1, patience.attempts + 1):
        try:
            return _attempt(request, redaction, patience, end)
        except ExchangeError as failed:
            reason, retry_s, passes = str(failed), failed.wait_s, failed.passes
        if not passes:
            raise DataError(f"{request.host}: {reason}{by_hand}")
        longest_s = patience.first_wait_s * 2 ** (attempt - 1)
        wait_s = random.uniform(0.5, 1.0) * longest_s if retry_s is None else retry_s
        if time.monotonic() + wait_s > end:
            retry = f", and asks to wait {retry_s:,.0f} s" if retry_s else ""
            raise DataError(
                f"{request.host}: {reason}{retry}; no answer within {patience.total_s:g} s, "
                f"try later{by_hand}"
            )
        if attempt < patience.attempts:
            sleep(wait_s)
    raise DataError(f"{request.host}: {reason}, {patience.attempts} times{by_hand}")


def _attempt(request: Request, redaction: Redaction, patience: Patience, end: float) -> bytes:
    answer = exchange(request.private_url, redaction, request.most_bytes, patience, end)
    content = answer.content
    if answer.status != HTTPStatus.OK:
        _refuse(request, answer)
    if re.match(rb"\s*(<!doctype html|<html)", content, re.IGNORECASE):
        raise DataError(
            f"{request.url}: an HTML page came in place of data (of a proxy, a log-in or an error)"
        )
    request.check(content, request.url)
    return content


def _refuse(request: Request, answer: Answer) -> None:
    """Raise an error for a status other than success."""
    status = answer.status
    phrase = next((f" ({each.phrase})" for each in HTTPStatus if each == status), "")
    if status in _PASSING or status >= HTTPStatus.INTERNAL_SERVER_ERROR:
        raise ExchangeError(f"status {status}{phrase}", answer.retry_after_s)
    text = answer.content[:10_000].decode("utf-8", errors="replace")
    # Services explain errors in JSON ("message", "error") or in XML (<text>).
    message = re.search(r'"(?:message|error)"\s*:\s*"(.*?)"|<text>(.*?)</text>', text, re.DOTALL)
    explained = f": {shortened(message[1] or message[2], 200)}" if message else ""
    if request.service.key and status in (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN):
        raise DataError(
            f"{request.host}: status {status}{phrase}{explained}: the key in "
            f"{request.service.key.variable} is not accepted, expected one of "
            f"{request.service.page}"
        )
    raise DataError(f"{request.url}: status {status}{phrase}{explained}")


def _paths(request: Request) -> tuple[Path, Path]:
    """Return the paths of an answer and of its origin file."""
    path = downloads_dir(request.service) / request.file_name
    return path, path.with_name(f"{path.name}.origin.json")


def _stored(request: Request) -> Kept | None:
    """Return the stored answer; None if it is absent, damaged, or of another request."""
    path, origin_path = _paths(request)
    if not (path.is_file() and origin_path.is_file()):
        return None
    try:
        origin = json.loads(read_bytes(origin_path, _MOST_ORIGIN_BYTES, DataError))
        content = read_bytes(path, request.most_bytes, DataError)
        expected = {"format": FORMAT, "url": request.url, "sha256": _sha256(content)}
        return Kept(path, content, origin) if expected.items() <= origin.items() else None
    except (ValueError, AttributeError):
        return None


def _store(request: Request, content: bytes) -> Kept:
    path, origin_path = _paths(request)
    origin = {
        "format": FORMAT,
        "service": request.service.title,
        "licence": request.service.licence,
        "url": request.url,
        "retrieved": datetime.now(UTC).isoformat(timespec="seconds"),
        "sha256": _sha256(content),
        "bytes": len(content),
    }
    write_file(path, content)
    write_file(origin_path, json.dumps(origin, indent=1).encode())
    return Kept(path, content, origin)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
