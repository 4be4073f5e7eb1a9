"""A server on this machine that answers as a test tells it to, faults included."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from unittest import mock

Answer = Callable[[BaseHTTPRequestHandler], None]
"""Sends an answer to a request."""


class FaultyServer:
    """A server whose answers are given one by one; the last one is repeated.

    ``seen`` holds path and headers of every request.
    """

    def __init__(self) -> None:
        self.answers: list[Answer] = []
        self.seen: list[tuple[str, dict[str, str]]] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                outer.seen.append((self.path, dict(self.headers)))
                answer = outer.answers.pop(0) if len(outer.answers) > 1 else outer.answers[0]
                self.close_connection = True
                with contextlib.suppress(ConnectionError):
                    answer(self)

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.stopped = threading.Event()
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the server."""
        return f"http://127.0.0.1:{self._server.server_port}"

    def close(self) -> None:
        self.stopped.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@contextlib.contextmanager
def serving(*answers: Answer) -> Iterator[FaultyServer]:
    """A server that runs within the block."""
    server = FaultyServer()
    server.answers = list(answers)
    try:
        with mock.patch.dict(os.environ, {"NO_PROXY": "127.0.0.1", "no_proxy": "127.0.0.1"}):
            yield server
    finally:
        server.close()


def sends(
    content: bytes,
    status: int = 200,
    *,
    length: int | None = None,
    kind: str = "application/json",
    **headers: str,
) -> Answer:
    """Content with a status; ``length`` is told instead of the true one."""

    def answer(request: BaseHTTPRequestHandler) -> None:
        request.send_response(status)
        request.send_header("Connection", "close")
        request.send_header("Content-Type", kind)
        request.send_header("Content-Length", str(len(content) if length is None else length))
        for name, value in headers.items():
            request.send_header(name.replace("_", "-"), value)
        request.end_headers()
        request.wfile.write(content)

    return answer


def drips(content: bytes, pause_s: float, stopped: Callable[[], threading.Event]) -> Answer:
    """Content byte by byte, with a pause before each."""

    def answer(request: BaseHTTPRequestHandler) -> None:
        request.send_response(200)
        request.send_header("Content-Length", str(len(content)))
        request.end_headers()
        for i in range(len(content)):
            if stopped().wait(pause_s):
                return
            request.wfile.write(content[i : i + 1])
            request.wfile.flush()

    return answer


def drips_within(
    head: bytes, drop: bytes, tail: bytes, pause_s: float, stopped: Callable[[], threading.Event]
) -> Answer:
    """Bytes of an answer as they are: a head, for some seconds drop after drop, then a tail."""

    def answer(request: BaseHTTPRequestHandler) -> None:
        request.wfile.write(head)
        for _ in range(round(8.0 / pause_s)):
            if stopped().wait(pause_s):
                return
            request.wfile.write(drop)
            request.wfile.flush()
        request.wfile.write(tail)

    return answer


def sends_bytes(content: bytes) -> Answer:
    """Bytes of an answer as they are, with status line and headers."""

    def answer(request: BaseHTTPRequestHandler) -> None:
        request.wfile.write(content)

    return answer


def silent(stopped: Callable[[], threading.Event]) -> Answer:
    """No answer while the server runs."""

    def answer(request: BaseHTTPRequestHandler) -> None:
        stopped().wait(30.0)

    return answer
