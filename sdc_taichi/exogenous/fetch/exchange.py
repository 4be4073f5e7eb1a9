"""One HTTP exchange: a request, its redirects and the answer, within limits of time and size."""

from __future__ import annotations

import contextlib
import gzip
import io
import re
import socket
import threading
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urljoin, urlsplit

from sdc_taichi.exogenous.fetch.redaction import Redaction

if TYPE_CHECKING:
    import requests
    import urllib3
    from requests.adapters import HTTPAdapter

_MOST_REDIRECTS = 10
_CHUNK_BYTES = 1 << 14
_LENGTH = re.compile(r"\d{1,15}")


@dataclass(frozen=True)
class Patience:
    """Limits on time and attempts of a download."""

    connect_s: float = 10.0
    """Maximum wait for a connection, in s."""
    read_s: float = 60.0
    """Maximum wait for the next bytes of an answer, in s."""
    total_s: float = 300.0
    """Maximum duration of a download with all attempts and waits, in s."""
    attempts: int = 6
    """Maximum number of attempts."""
    first_wait_s: float = 1.0
    """Maximum wait after the first attempt, in s; it doubles after each further attempt."""


class Answer(NamedTuple):
    """An answer that arrived completely."""

    status: int
    """HTTP status."""
    retry_after_s: float | None
    """Wait before another attempt that the service requests, in s; None if it requests none."""
    content: bytes
    """Content, unpacked and without the secrets of the request."""


class ExchangeError(Exception):
    """A failed exchange, with the wait in s that the service requests, if any.

    ``passes`` is True for a temporary failure, after which another attempt may succeed.
    """

    def __init__(self, reason: str, wait_s: float | None = None, *, passes: bool = True) -> None:
        super().__init__(reason)
        self.wait_s = wait_s
        self.passes = passes


def exchange(
    url: str, redaction: Redaction, most_bytes: int, patience: Patience, end: float
) -> Answer:
    """Request an address and return the answer.

    The exchange runs in a thread, which is left at the end of the time. HTTP libraries limit the
    wait for the next bytes only, and a server can send single bytes of status lines, headers,
    interim answers or chunk sizes for ever.

    Args:
        url: address with query and key.
        redaction: redaction of the secrets in the address.
        most_bytes: largest valid content, in bytes.
        patience: limits on the waits for a connection and for the next bytes.
        end: time of ``time.monotonic`` at which the exchange ends, in s.

    Raises:
        ExchangeError: there is no complete answer in time. The reason never quotes the HTTP
            library, because its text contains the address with the key.
    """
    connections = _Connections()
    outcome: list[Answer | ExchangeError] = []

    def run() -> None:
        try:
            outcome.append(_follow(url, redaction, most_bytes, patience, end, connections))
        except ExchangeError as failed:
            # The error of the library, its context, quotes the address and holds connections open.
            failed.__context__ = failed.__traceback__ = None
            outcome.append(failed)

    thread = threading.Thread(target=run, name="sdc-taichi-download", daemon=True)
    thread.start()
    try:
        thread.join(max(0.0, end - time.monotonic()))
        # Closing the connections below ends an answer early, which may then seem to be complete.
        result = outcome[0] if outcome else ExchangeError("a slow answer", 0.0)
    finally:
        connections.close()
    if isinstance(result, ExchangeError):
        raise result
    return result


class _Connections:
    """Open connections of an exchange, which another thread can close."""

    def __init__(self) -> None:
        self._sockets: list[socket.socket] = []
        self._closed = False

    def add(self, opened: socket.socket) -> None:
        """Add a connection; it is closed at once if ``close`` was called."""
        self._sockets.append(opened)
        if self._closed:
            self.close()

    def close(self) -> None:
        """Close all connections, so that a thread that waits for one of them continues."""
        self._closed = True
        while self._sockets:
            with contextlib.suppress(OSError):
                self._sockets.pop().shutdown(socket.SHUT_RDWR)

    def adapter(self) -> HTTPAdapter:
        """Return an adapter of the HTTP library whose connections are added here."""
        from requests.adapters import HTTPAdapter

        add = self.add

        class Adapter(HTTPAdapter):
            def get_connection_with_tls_context(self, *args: Any, **kwargs: Any) -> Any:
                pool = super().get_connection_with_tls_context(*args, **kwargs)

                class Connection(type(pool).ConnectionCls):  # type: ignore[misc]
                    def connect(self) -> None:
                        super().connect()
                        add(self.sock)

                pool.ConnectionCls = Connection
                return pool

        return Adapter()


def _follow(
    url: str,
    redaction: Redaction,
    most_bytes: int,
    patience: Patience,
    end: float,
    connections: _Connections,
) -> Answer:
    """Send a request, follow redirects and return the last answer; see ``exchange``."""
    import requests
    from requests.utils import default_user_agent

    headers = {"User-Agent": default_user_agent(), "Accept-Encoding": "gzip", "Accept": "*/*"}
    # Sessions follow redirects with cookies and read their content without a limit. The adapter
    # does not, and knows no credentials of .netrc files, which are for other purposes.
    session = requests.Session()
    with (
        redaction.in_logs(),
        _naming_failures(patience),
        contextlib.closing(connections.adapter()) as adapter,
    ):
        for _ in range(_MOST_REDIRECTS + 1):
            prepared = requests.Request("GET", url, headers=headers).prepare()
            settings = session.merge_environment_settings(url, {}, True, None, None)
            left_s = max(0.001, end - time.monotonic())
            waits = (min(patience.connect_s, left_s), min(patience.read_s, left_s))
            with contextlib.closing(adapter.send(prepared, timeout=waits, **settings)) as response:
                if not response.is_redirect:
                    return _answer(response, redaction, most_bytes)
                location = response.headers["Location"].encode("latin-1").decode()
            target = urljoin(url, location)
            if urlsplit(target).scheme not in ("http", "https"):
                raise ExchangeError("a redirect to an address that is not HTTP", passes=False)
            if redaction.in_text(target) != target and session.should_strip_auth(url, target):
                raise ExchangeError("a redirect that sends the key to another host", passes=False)
            url = target
    raise ExchangeError("too many redirects", passes=False)


def _answer(response: requests.Response, redaction: Redaction, most_bytes: int) -> Answer:
    lengths = set(re.split(r"\s*,\s*", response.headers.get("Content-Length", "0")))
    if len(lengths) > 1 or not all(map(_LENGTH.fullmatch, lengths)):
        raise ExchangeError("an answer with a wrong Content-Length", passes=False)
    encoding = response.headers.get("Content-Encoding", "identity").strip().lower()
    if encoding not in ("", "identity", "gzip", "x-gzip"):
        raise ExchangeError("an answer in an encoding other than gzip", passes=False)
    file: Any = _Body(response.raw)
    if "gzip" in encoding:
        # The decoder of the HTTP library loses members after the first one.
        file = gzip.GzipFile(fileobj=file)
    content = bytearray()
    while chunk := file.read(_CHUNK_BYTES):
        content += chunk
        if len(content) > most_bytes:
            most = f"{most_bytes / 1e6:,.1f} MB, the most that is valid"
            raise ExchangeError(f"an answer of more than {most}", passes=False)
    retry_after = response.headers.get("Retry-After", "")
    wait_s = float(retry_after) if re.fullmatch("[0-9]{1,9}", retry_after) else None
    # Editing would damage an archive, whose content is packed in any case.
    is_archive = content.startswith(b"PK\x03\x04")
    plain = bytes(content) if is_archive else redaction.in_bytes(bytes(content))
    return Answer(response.status_code, wait_s, plain)


class _Body(io.RawIOBase):
    """Content of an answer as the service sent it, possibly packed.

    ``read1`` reads at most what was requested, whatever size a chunk claims.
    """

    def __init__(self, response: urllib3.BaseHTTPResponse) -> None:
        self._response = response

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        content = self._response.read1(len(buffer), decode_content=False)
        buffer[: len(content)] = content
        return len(content)


@contextlib.contextmanager
def _naming_failures(patience: Patience) -> Iterator[None]:
    """Convert failures of the HTTP library to reasons without its text, which may show the key."""
    import requests.exceptions as failures
    from urllib3.exceptions import HTTPError, NameResolutionError, ReadTimeoutError

    reason, passes = "", True
    try:
        yield
    except ExchangeError:
        raise
    except failures.ConnectTimeout:
        reason = f"no connection within {patience.connect_s:g} s"
    except (failures.Timeout, ReadTimeoutError):
        reason = f"no answer within {patience.read_s:g} s"
    except (HTTPError, EOFError, zlib.error, gzip.BadGzipFile):
        reason = "an answer that is cut off"
    except failures.SSLError:
        reason, passes = "no certificate that is trusted here", False
    except failures.ProxyError:
        reason, passes = "the proxy does not connect", False
    except failures.ConnectionError as failed:
        cause = getattr(failed.args[0] if failed.args else None, "reason", None)
        passes = not isinstance(cause, NameResolutionError)
        reason = "no connection" if passes else "not found (is there a network?)"
    except (failures.InvalidURL, failures.InvalidProxyURL):
        reason, passes = "no valid address", False
    except Exception:
        # Which exceptions the libraries raise for a malformed answer is not documented.
        reason, passes = "an answer that is not valid HTTP", False
    # Raise outside of the handlers, so that no traceback shows the text of the library.
    if reason:
        raise ExchangeError(reason, passes=passes)
