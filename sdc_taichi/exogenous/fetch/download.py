"""Downloads over HTTP that end: whole, within their time and size, or in one line of error.

Attempts are repeated after what may pass (no connection, no answer, statuses 408, 429 and 5xx, an
answer that is cut off), with waits that double and are spread at random, or that last as long as
the service asks for. An answer that is cut off goes on where it ended if the service can tell that
it is still the same (RFC 9110, sections 13.1.5 and 14.2). No text of the HTTP library reaches a
message, because it would quote the address with the key.
"""

from __future__ import annotations

import contextlib
import json
import logging
import random
import re
import socket
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, NoReturn
from urllib.parse import urljoin, urlsplit

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous.fetch.request import Request

if TYPE_CHECKING:
    import requests

MOST_REDIRECTS = 5
"""Largest number of redirects that an attempt follows."""
_CHUNK_BYTES = 1 << 16
_MOST_ERROR_BYTES = 1 << 16
_REDIRECTS = frozenset({301, 302, 303, 307, 308})
_PASSING = frozenset({408, 425, 429})
"""Statuses below 500 after which an attempt is repeated."""
_HTML = re.compile(rb"\s*(<!doctype html|<html)", re.IGNORECASE)
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")


@dataclass(frozen=True)
class Patience:
    """How long a download may take, and how often it is tried."""

    connect_s: float = 10.0
    """Longest wait for a connection, in s."""
    read_s: float = 60.0
    """Longest wait for the next bytes of an answer, in s."""
    total_s: float = 300.0
    """Longest time of a download with all its attempts and waits, in s."""
    attempts: int = 6
    """Largest number of attempts."""
    first_wait_s: float = 1.0
    """Longest wait after the first attempt, in s; it doubles from attempt to attempt."""


@dataclass(frozen=True)
class Downloaded:
    """The whole answer of a service."""

    content: bytes
    """The answer, decompressed, without the key."""
    etag: str = ""
    """Version of the answer as the service calls it; empty if it does not tell."""
    last_modified: str = ""
    """Time of the last change as the service tells it; empty if it does not tell."""


class _PassingError(Exception):
    """A failure that may pass."""

    def __init__(self, reason: str, wait_s: float | None = None) -> None:
        super().__init__(reason)
        self.wait_s = wait_s


class _NoNetworkError(Exception):
    """A failure that is not worth another attempt: without a network, or a proxy, none succeeds."""


@dataclass
class _Part:
    """The beginning of an answer."""

    content: bytearray
    """Bytes of the answer as they were sent."""
    validator: str = ""
    """Strong ETag, or else the time of the last change, by which the service recognises the answer;
    empty if the answer cannot be continued."""

    def forget(self) -> None:
        """Begin again."""
        self.content.clear()
        self.validator = ""


def download(
    request: Request,
    patience: Patience | None = None,
    *,
    sleep: Callable[[float], None] = time.sleep,
) -> Downloaded:
    """Download an answer and check it.

    Args:
        request: what is asked.
        patience: limits of time and attempts.
        sleep: waits for a number of seconds.

    Raises:
        DataError: no answer in time, an answer that is too large or not what was asked for, or no
            library for HTTP.
    """
    try:
        import requests
    except ImportError:
        raise DataError(
            'data fetch needs the library requests: pip install "sdc-taichi[fetch]"'
        ) from None
    patience = patience or Patience()
    end = time.monotonic() + patience.total_s
    part = _Part(bytearray())
    by_hand = f"; {request.by_hand}" if request.by_hand else ""
    with requests.Session() as session, _without_key_in_logs(request):
        # Redirects are followed here; the library would read their whole content first.
        session.get_redirect_target = lambda resp: None  # type: ignore[method-assign]
        for attempt in range(1, patience.attempts + 1):
            try:
                return _attempt(session, request, part, patience, end)
            except _NoNetworkError as failed:
                raise DataError(f"{request.host}: {failed}{by_hand}") from None
            except _PassingError as failed:
                reason, asked_s = str(failed), failed.wait_s
            longest_s = patience.first_wait_s * 2 ** (attempt - 1)
            wait_s = random.uniform(0.5, 1.0) * longest_s if asked_s is None else asked_s
            if time.monotonic() + wait_s > end:
                asked = f", and asks to wait {asked_s:,.0f} s" if asked_s else ""
                raise DataError(
                    f"{request.host}: {reason}{asked}; no answer within {patience.total_s:g} s, "
                    f"try later{by_hand}"
                )
            if attempt < patience.attempts:
                sleep(wait_s)
    raise DataError(f"{request.host}: {reason}, {patience.attempts} times{by_hand}")


def _attempt(
    session: requests.Session, request: Request, part: _Part, patience: Patience, end: float
) -> Downloaded:
    """One attempt, with its redirects."""
    with contextlib.closing(_answer(session, request, part, patience, end)) as response:
        status = int(response.status_code)
        if status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and part.content:
            part.forget()
            raise _PassingError("the rest of the answer is not to be had")
        if status not in (HTTPStatus.OK, HTTPStatus.PARTIAL_CONTENT):
            _refuse(request, response, end)
        _begin(request, part, response)
        _read(request, part, response, end)
        content = _decompressed(request, bytes(part.content), response)
        headers = response.headers
        etag, last_modified = headers.get("ETag", ""), headers.get("Last-Modified", "")
    if _HTML.match(content[:256]):
        raise DataError(
            f"{request.url}: an HTML page came in place of data (of a proxy, a log-in or an error)"
        )
    content = request.without_key(content)
    request.check(content, request.url)
    return Downloaded(content, etag, last_modified)


def _answer(
    session: requests.Session, request: Request, part: _Part, patience: Patience, end: float
) -> requests.Response:
    """Status and headers of an answer that is no redirect."""
    url = request.secret_url
    # Compressed answers could not be continued. Credentials of a .netrc file are for other uses.
    headers = {"Accept-Encoding": "identity", "User-Agent": _user_agent()}
    if part.validator:
        headers |= {"Range": f"bytes={len(part.content)}-", "If-Range": part.validator}
    for _ in range(MOST_REDIRECTS + 1):
        left_s = max(0.001, end - time.monotonic())
        timeout = (min(patience.connect_s, left_s), min(patience.read_s, left_s))
        with _naming_failures(patience):
            response = session.get(
                url,
                headers=headers,
                timeout=timeout,
                stream=True,
                allow_redirects=False,
                auth=lambda prepared: prepared,
            )
        if response.status_code not in _REDIRECTS:
            return response
        response.close()
        url = _redirected(request, url, response.headers.get("Location", ""))
    raise DataError(f"{request.url}: more than {MOST_REDIRECTS} redirects")


def _user_agent() -> str:
    from importlib.metadata import version

    return f"sdc-taichi/{version('sdc-taichi')}"


def _redirected(request: Request, url: str, location: str) -> str:
    """Address that a redirect leads to, if it may be followed."""
    old, new, target = urlsplit(url), urlsplit(""), ""
    with contextlib.suppress(ValueError):
        target = urljoin(url, location) if location else ""
        new = urlsplit(target)
    if new.scheme not in ("http", "https") or not new.hostname:
        raise DataError(f"{request.url}: a redirect to no address of the web")
    if old.scheme == "https" and new.scheme != "https":
        raise DataError(f"{request.url}: a redirect to {new.hostname} without encryption, refused")
    if request.key is not None and (old.scheme, old.netloc) != (new.scheme, new.netloc):
        raise DataError(
            f"{request.url}: a redirect to {new.hostname}, refused, since the key in "
            f"{request.key.variable} is for {request.host} alone"
        )
    return target


def _refuse(request: Request, response: requests.Response, end: float) -> NoReturn:
    """Raise what a status other than success means."""
    status = int(response.status_code)
    phrase = next((f" ({x.phrase})" for x in HTTPStatus if x == status), "")
    if status in _PASSING or status >= HTTPStatus.INTERNAL_SERVER_ERROR:
        raise _PassingError(f"status {status}{phrase}", _asked_wait_s(response))
    part = _Part(bytearray())
    with contextlib.suppress(_PassingError, DataError):
        _read(request, part, response, end, most_bytes=_MOST_ERROR_BYTES)
    said = _message(request.without_key(bytes(part.content)))
    if request.key is not None and status in (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN):
        raise DataError(
            f"{request.host}: status {status}{phrase}{said}: the key in {request.key.variable} is "
            f"not accepted, expected one of {request.service.page}"
        )
    raise DataError(f"{request.url}: status {status}{phrase}{said}")


def _asked_wait_s(response: requests.Response) -> float | None:
    """Seconds that Retry-After asks to wait; None if it asks for none or is not readable."""
    from urllib3.exceptions import InvalidHeader
    from urllib3.util import Retry

    with contextlib.suppress(InvalidHeader, ValueError, OverflowError):
        asked = response.headers.get("Retry-After")
        return None if asked is None else max(0.0, float(Retry().parse_retry_after(asked)))
    return None


def _message(content: bytes) -> str:
    """What a service says of an error, in JSON or XML, to follow a status; empty if nothing."""
    text = content.decode("utf-8", errors="replace")
    said: Any = None
    with contextlib.suppress(ValueError, RecursionError):
        said = json.loads(text)
    for name in ("error", "message"):
        if isinstance(said, dict):
            said = said.get(name, said)
    if not isinstance(said, str):
        found = re.search(r"<text>(.*?)</text>", text, re.DOTALL)
        said = found[1] if found else ""
    return f": {shortened(said.strip(), 200)}" if said.strip() else ""


def _begin(request: Request, part: _Part, response: requests.Response) -> None:
    """Prepare ``part`` for the bytes of an answer, whether it is the whole or the rest."""
    headers = response.headers
    if response.status_code == HTTPStatus.PARTIAL_CONTENT:
        found = _CONTENT_RANGE.fullmatch(headers.get("Content-Range", ""))
        if not found or int(found[1]) != len(part.content):
            part.forget()
            raise _PassingError("another part of the answer came than the rest")
        return
    part.forget()
    told = headers.get("Content-Length", "")
    if told.isdecimal() and int(told) > request.most_bytes:
        raise _too_large(request)
    if not headers.get("Content-Encoding"):
        etag = headers.get("ETag", "")
        part.validator = etag if etag.startswith('"') else headers.get("Last-Modified", "")


def _read(
    request: Request,
    part: _Part,
    response: requests.Response,
    end: float,
    *,
    most_bytes: int | None = None,
) -> None:
    """Append the bytes of an answer to ``part``."""
    most_bytes = request.most_bytes if most_bytes is None else most_bytes
    while True:
        with _naming_failures(None):
            # One read of the socket, so that a slow answer does not outlast the time.
            chunk = response.raw.read1(_CHUNK_BYTES, decode_content=False)
        if not chunk:
            return
        part.content += chunk
        if len(part.content) > most_bytes:
            raise _too_large(request)
        if time.monotonic() > end:
            raise _PassingError(f"a slow answer, {len(part.content):,} bytes so far", 0.0)


def _too_large(request: Request) -> DataError:
    return DataError(
        f"{request.url}: the answer has more than {request.most_bytes / 1e6:,.1f} MB, the most "
        "that is valid"
    )


def _decompressed(request: Request, content: bytes, response: requests.Response) -> bytes:
    """Content of an answer that was compressed although that was not asked for."""
    encoding = response.headers.get("Content-Encoding", "").strip().lower()
    if encoding in ("", "identity"):
        return content
    if encoding not in ("gzip", "x-gzip", "deflate"):
        raise DataError(
            f"{request.url}: compressed as {shortened(encoding)}, expected none or gzip"
        )
    decoder = zlib.decompressobj(wbits=zlib.MAX_WBITS | 32)
    try:
        plain = decoder.decompress(content, request.most_bytes + 1)
    except zlib.error:
        raise DataError(f"{request.url}: damaged, expected {encoding}") from None
    if len(plain) > request.most_bytes:
        raise _too_large(request)
    if not decoder.eof:
        raise _PassingError("an answer that is cut off")
    return plain


@contextlib.contextmanager
def _naming_failures(patience: Patience | None) -> Iterator[None]:
    """Turn failures of the HTTP library into reasons without its text, which may hold the key."""
    import requests
    import urllib3

    reason, final = "", ""
    try:
        yield
    except (requests.exceptions.ConnectTimeout, urllib3.exceptions.ConnectTimeoutError):
        reason = f"no connection within {patience.connect_s:g} s" if patience else "no connection"
    except (requests.exceptions.Timeout, urllib3.exceptions.TimeoutError, TimeoutError):
        reason = f"no answer within {patience.read_s:g} s" if patience else "a silent answer"
    except requests.exceptions.SSLError:
        final = "has no certificate that is trusted here"
    except requests.exceptions.InvalidURL:
        final = "not a valid address"
    except requests.exceptions.ProxyError:
        final = "the proxy does not connect"
    except (requests.exceptions.RequestException, urllib3.exceptions.HTTPError, OSError) as failed:
        if any(isinstance(each, socket.gaierror) for each in _causes(failed)):
            final = "not found (is there a network?)"
        else:
            reason = _reason(failed) if patience else "an answer that is cut off"
    # Outside of the handlers, so that no traceback shows what the library said.
    if final:
        raise _NoNetworkError(final)
    if reason:
        raise _PassingError(reason)


def _reason(failed: BaseException) -> str:
    """Why no answer came, in the words of the system where an error in the chain is of it."""
    for each in _causes(failed):
        if isinstance(each, OSError) and each.errno is not None and each.strerror:
            return f"no connection ({each.strerror})"
    return "a connection that ended without an answer"


def _causes(failed: BaseException) -> Iterator[BaseException]:
    """An error and those that it came from."""
    seen: BaseException | None = failed
    while seen is not None:
        yield seen
        seen = seen.__cause__ or seen.__context__


@contextlib.contextmanager
def _without_key_in_logs(request: Request) -> Iterator[None]:
    """Keep the key out of the debugging log of the HTTP library."""
    key = request.key
    if key is None:
        yield
        return

    def hide(record: logging.LogRecord) -> bool:
        record.msg, record.args = record.getMessage().replace(key.value, "KEY"), ()
        return True

    logger = logging.getLogger("urllib3.connectionpool")
    logger.addFilter(hide)
    try:
        yield
    finally:
        logger.removeFilter(hide)
