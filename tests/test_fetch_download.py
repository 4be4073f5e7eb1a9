"""Downloads from a server that fails in every way: whole, or one line of error and nothing kept."""

from __future__ import annotations

import base64
import contextlib
import gzip
import json
import logging
import socket
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import pytest

from faulty_server import (
    Answer,
    drips,
    drips_within,
    sends,
    sends_bytes,
    serving,
    silent,
)
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.fetch.download import Request, download, fetch, read_key
from sdc_taichi.exogenous.fetch.exchange import Patience
from sdc_taichi.exogenous.fetch.redaction import Redaction
from sdc_taichi.exogenous.fetch.services import KeySource, Service
from sdc_taichi.user_file import decoding

SERVICE = Service(
    name="test",
    title="Test service",
    licence="none",
    page="https://example.org/key",
    key=KeySource(variable="TEST_KEY", parameter="api_key"),
)
SECRET = "abcdef-0123456789"
QUICK = Patience(connect_s=20.0, read_s=20.0, total_s=60.0, attempts=3, first_wait_s=0.01)
CONTENT = json.dumps({"rows": list(range(5000))}).encode()


def check_json(content: bytes, url: str) -> None:
    with decoding(url, "JSON", DataError):
        json.loads(content)


def request_to(url: str, **changes: object) -> Request:
    made = Request(
        SERVICE, f"{url}/data", "data.json", {"a": "1"}, by_hand="like this", check=check_json
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def failure(*answers: Answer, **changes: object) -> str:
    """Message of a download that fails; it holds no key."""
    with serving(*answers) as server, pytest.raises(DataError) as raised:
        download(request_to(server.url, **changes), QUICK)
    message = str(raised.value)
    assert SECRET not in message
    assert len(message.splitlines()) == 1
    return message


def test_answer_comes_whole() -> None:
    with serving(sends(CONTENT)) as server:
        assert download(request_to(server.url, key=SECRET), QUICK) == CONTENT
    assert server.seen[0][0] == f"/data?a=1&api_key={SECRET}"


@pytest.mark.parametrize("status", [408, 429, 500, 503])
def test_statuses_that_may_pass_are_tried_again(status: int) -> None:
    with serving(sends(b"", status), sends(b"", status), sends(CONTENT)) as server:
        assert download(request_to(server.url), QUICK) == CONTENT
    assert len(server.seen) == 3


def test_attempts_end_and_waits_double() -> None:
    waits: list[float] = []
    with serving(sends(b"", 503)) as server, pytest.raises(DataError) as raised:
        download(request_to(server.url), replace(QUICK, attempts=5), sleep=waits.append)
    assert len(server.seen) == 5
    assert str(raised.value) == (
        "127.0.0.1: status 503 (Service Unavailable), 5 times; by hand: like this"
    )
    assert len(waits) == 4
    for i, wait in enumerate(waits):
        assert 0.5 * 0.01 * 2**i <= wait <= 0.01 * 2**i


def test_a_wait_that_the_service_asks_for_is_kept_within_the_total_time() -> None:
    waits: list[float] = []
    with serving(sends(b"", 429, Retry_After="2"), sends(CONTENT)) as server:
        download(request_to(server.url), QUICK, sleep=waits.append)
    assert waits == [2.0]
    assert "asks to wait 3,600 s" in failure(sends(b"", 429, Retry_After="3600"))


def test_a_bad_request_ends_at_once_with_the_message_of_the_service() -> None:
    message = json.dumps({"message": "Location over the sea."}).encode()
    with serving(sends(message, 400)) as server, pytest.raises(DataError, match="over the sea"):
        download(request_to(server.url), QUICK)
    assert len(server.seen) == 1


def test_a_refused_key_names_its_variable_alone() -> None:
    answer = f"<r><text>token {SECRET} unknown</text></r>".encode()
    message = failure(sends(answer, 401, kind="application/xml"), key=SECRET)
    assert "TEST_KEY" in message
    assert "token KEY unknown" in message


def test_a_silent_server_ends() -> None:
    with serving(silent(lambda: server.stopped)) as server, pytest.raises(DataError) as raised:
        download(request_to(server.url), replace(QUICK, read_s=0.1))
    assert "no answer within 0.1 s, 3 times" in str(raised.value)


def test_a_slow_answer_ends_in_the_total_time() -> None:
    begin = time.monotonic()
    with (
        serving(drips(CONTENT, 0.001, lambda: server.stopped)) as server,
        pytest.raises(DataError, match=r"no answer within 0\.5 s, try later"),
    ):
        download(request_to(server.url), replace(QUICK, total_s=0.5))
    assert time.monotonic() - begin < 60.0


EMPTY = bytes(50_000_000)
OK = b"HTTP/1.1 200 OK\r\n"
PLAIN = b"Content-Length: 3\r\n\r\n[1]"
CHUNKED = OK + b"Transfer-Encoding: chunked\r\n\r\n"


@pytest.mark.parametrize(
    ("head", "drop", "tail"),
    [
        (b"HTTP/1.1 200 O", b"K", b"\r\n" + PLAIN),
        (OK + b"ETag: ", b"a", b"\r\n" + PLAIN),
        (OK, b"", PLAIN),
        (b"", b"HTTP/1.1 100 Continue\r\n\r\n", OK + PLAIN),
        (b"HTTP/1.1 100 Continue\r\nETag: ", b"a", b"\r\n\r\n" + OK + PLAIN),
        (CHUNKED, b"0", b"3\r\n[1]\r\n0\r\n\r\n"),
        (CHUNKED + b"3;", b"a", b"\r\n[1]\r\n0\r\n\r\n"),
        (CHUNKED, b"1\r\n \r\n", b"3\r\n[1]\r\n0\r\n\r\n"),
        (CHUNKED + b"3\r\n[1]\r\n0\r\n", b"ETag: a\r\n", b"\r\n"),
        (OK + b"\r\n", b" ", b"[1]"),
        (b"HTTP/1.1 302 Found\r\nLocation: /", b"a", b"\r\nContent-Length: 0\r\n\r\n"),
    ],
)
def test_a_dripping_answer_ends_in_the_total_time(head: bytes, drop: bytes, tail: bytes) -> None:
    answer = drips_within(head, drop, tail, 0.02, lambda: server.stopped)
    with serving(answer) as server, pytest.raises(DataError) as raised:
        download(request_to(server.url), replace(QUICK, total_s=0.4))
    assert "; no answer within 0.4 s, try later" in str(raised.value)
    no_thread_is_left()


def no_thread_is_left() -> None:
    for thread in threading.enumerate():
        if thread.name == "sdc-taichi-download":
            thread.join(30.0)
            assert not thread.is_alive()


def test_a_host_that_is_not_found_in_time_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()

    def slow(*_: object) -> None:
        go_on.wait(30.0)
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    with pytest.raises(DataError, match=r"no answer within 0\.2 s, try later"):
        download(request_to("http://example.invalid"), replace(QUICK, total_s=0.2))
    go_on.set()
    no_thread_is_left()


def test_a_dripping_handshake_ends_in_the_total_time() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def handshake() -> None:
            peer, _ = server.accept()
            with peer, contextlib.suppress(OSError):
                peer.sendall(b"\x16\x03\x03\x40\x00\x02\x00\x3f\xfc")
                for _ in range(400):
                    time.sleep(0.02)
                    peer.sendall(b"\0")

        thread = threading.Thread(target=handshake, daemon=True)
        thread.start()
        url = f"https://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(DataError, match=r"no answer within 0\.4 s, try later"):
            download(request_to(url), replace(QUICK, total_s=0.4))


@pytest.mark.parametrize(
    "content",
    [
        OK + b"Content-Length: " + b"9" * 5000 + b"\r\n\r\n[1]",
        OK + b"Content-Length: " + b"9" * 4000 + b"\r\n\r\n[1]",
        OK + b"Content-Length: -3\r\n\r\n[1]",
        OK + b"Content-Length: 3, 4\r\n\r\n[1]",
        CHUNKED + b"-5\r\n[1]",
        CHUNKED + b"f" * 5000 + b"\r\n[1]",
        CHUNKED + b"three\r\n[1]",
        OK + b"Content-Encoding: gzip\r\nContent-Length: 3\r\n\r\n[1]",
        OK + b"Content-Encoding: br\r\nContent-Length: 3\r\n\r\n[1]",
        b"HTTP/1.1 " + b"9" * 5000 + b" OK\r\n\r\n",
        b"HTTP/1.1 302 Found\r\nLocation: http://[::1/\r\n\r\n",
        b"HTTP/1.1 302 Found\r\nLocation: http://a:99999/\r\n\r\n",
        b"HTTP/1.1 302 Found\r\nLocation: http://\xff/\r\n\r\n",
        b"HTTP/1.1 302 Found\r\nLocation: file:///etc/passwd\r\n\r\n",
        b"HTTP/1.1 503 No\r\nContent-Length: 0\r\nRetry-After: " + b"9" * 5000 + b"\r\n\r\n",
        bytes(range(32)),
    ],
)
def test_malformed_answers_are_one_line(content: bytes) -> None:
    assert failure(sends_bytes(content)).startswith("127.0.0.1: ")


def test_every_member_of_a_packed_answer_counts() -> None:
    parts = [CONTENT[i : i + 4000] for i in range(0, len(CONTENT), 4000)]
    packed = b"".join(gzip.compress(part) for part in parts)
    with serving(sends(packed, Content_Encoding="gzip")) as server:
        assert download(request_to(server.url), QUICK) == CONTENT
    chunks = b"".join(b"%x\r\n%s\r\n" % (len(x), x) for x in [*map(gzip.compress, parts), b""])
    answer = CHUNKED.replace(b"\r\n\r\n", b"\r\nContent-Encoding: gzip\r\n\r\n") + chunks
    with serving(sends_bytes(answer)) as server:
        assert download(request_to(server.url), QUICK) == CONTENT
    assert "cut off" in failure(sends(packed[:-9], Content_Encoding="gzip"))


def test_no_server_is_an_error_with_what_to_do_by_hand() -> None:
    with serving(sends(b"")) as server:
        pass
    with pytest.raises(DataError, match=r"no connection, 3 times; by hand: like this") as raised:
        download(request_to(server.url, key=SECRET), QUICK)
    assert SECRET not in "".join(traceback.format_exception(raised.value))


def test_no_such_host_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(DataError) as raised:
        download(request_to("http://example.invalid"), QUICK, sleep=lambda _: pytest.fail("waits"))
    assert str(raised.value) == (
        "example.invalid: not found (is there a network?); by hand: like this"
    )


def test_an_answer_that_is_cut_off_is_tried_again() -> None:
    cut = sends(CONTENT[:1000], length=len(CONTENT))
    with serving(cut, sends(CONTENT)) as server:
        assert download(request_to(server.url), QUICK) == CONTENT
    assert "an answer that is cut off, 3 times" in failure(cut)


def test_large_answers_are_refused() -> None:
    bomb = gzip.compress(EMPTY)
    assert len(bomb) < 100_000
    assert "more than 0.0 MB" in failure(sends(CONTENT), most_bytes=1000)
    for packed in (sends(bomb, Content_Encoding="gzip"), sends_bytes(CHUNKED + b"-1\r\n" + EMPTY)):
        assert "more than 1.0 MB" in failure(packed, most_bytes=1_000_000)
    head = b"HTTP/1.1 302 Found\r\nLocation: /there\r\n\r\n"
    with serving(sends_bytes(head + EMPTY), sends(CONTENT)) as server:
        assert download(request_to(server.url), QUICK) == CONTENT


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"<!DOCTYPE html><p>Log in", "an HTML page"),
        (b"\x89PNG\r\n", "cannot be read as JSON"),
        (b"", "cannot be read as JSON"),
    ],
)
def test_other_content_is_refused(content: bytes, message: str) -> None:
    assert message in failure(sends(content))


def test_redirects_are_followed_without_the_key_and_end() -> None:
    with serving(sends(CONTENT)) as other:
        with serving(sends(b"", 302, Location=f"{other.url}/there")) as server:
            assert download(request_to(server.url, key=SECRET), QUICK) == CONTENT
        assert [path for path, _ in other.seen] == ["/there"]
    assert "too many redirects" in failure(sends(b"", 302, Location="/there"))


def test_the_key_is_neither_logged_nor_kept(
    caplog: pytest.LogCaptureFixture, user_folder: Path
) -> None:
    echo = json.dumps({"request": {"params": {"api_key": SECRET}}, "rows": []}).encode()
    caplog.set_level(logging.DEBUG)
    with serving(sends(echo)) as server:
        (kept,) = fetch([request_to(server.url, key=SECRET)], patience=QUICK)
    assert "GET /data" in caplog.text
    assert SECRET not in caplog.text
    for path in user_folder.rglob("*"):
        assert path.is_dir() or SECRET.encode() not in path.read_bytes()
    assert SECRET not in repr(request_to("", key=SECRET))
    assert b'"api_key": "KEY"' in kept.content


ECHOES: list[Callable[[str], str]] = [
    lambda secret: secret,
    str.upper,
    lambda secret: "".join(f"%{ord(c):02X}" for c in secret),
    lambda secret: quote(quote(secret.replace("-", "%2d"))),
    lambda secret: "".join(f"\\u{ord(c):04x}" for c in secret),
    lambda secret: secret.replace("a", "\\\\u0061"),
    lambda secret: "".join(f"&#{ord(c)};" for c in secret),
    lambda secret: "".join(f"&#x{ord(c):X};" for c in secret),
    lambda secret: secret.encode().hex(),
    lambda secret: base64.b64encode(secret.encode()).decode(),
    lambda secret: base64.urlsafe_b64encode(f"me:{secret}".encode()).decode(),
    lambda secret: base64.b64encode(f"you:{secret}:x".encode()).decode(),
]


@pytest.mark.parametrize("echo", ECHOES)
def test_an_echo_of_the_key_goes_nowhere(
    echo: Callable[[str], str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    # The ends of base64 depend on the text around the key.
    text, core = echo(SECRET), echo(SECRET)[4:-4].casefold()
    header = text.encode()
    redirect = b"HTTP/1.1 302 Found\r\nContent-Length: 0\r\nLocation: http://"
    echoes = {
        "message": sends(b'{"message": "no %s"}' % header, 400),
        "status": sends_bytes(b"HTTP/1.1 400 " + header + b"\r\nContent-Length: 0\r\n\r\n"),
        "host": sends_bytes(redirect + header + b".invalid/\r\n\r\n"),
        "user": sends_bytes(redirect + header + b"@example.invalid/\r\n\r\n"),
        "path": sends_bytes(redirect + b"example.invalid/" + header + b"\r\n\r\n"),
        "query": sends_bytes(redirect + b"example.invalid/?k=" + header + b"\r\n\r\n"),
        "ETag": sends(b"", 400, ETag=text),
        "Content-Encoding": sends(b"[1]", Content_Encoding=text),
        "Content-Length": sends_bytes(OK + b"Content-Length: " + header + b"\r\n\r\n[1]"),
        "Retry-After": sends(b"", 503, Retry_After=text),
        "no header": sends_bytes(OK + header + b"\r\n" + PLAIN.replace(b"[1]", b"[1,")),
        "chunk": sends_bytes(CHUNKED + header + b"\r\n[1]"),
        "content": sends(header),
        "status line": sends_bytes(header + b"\r\n\r\n"),
    }
    for where, answer in echoes.items():
        message = failure(answer, key=SECRET)
        assert core not in message.casefold(), where
        assert core not in caplog.text.casefold(), where


def test_words_that_resemble_no_key_stay() -> None:
    redaction = Redaction([SECRET, "short", ""])
    for text in ("short", SECRET[:-1], SECRET.replace("-", ""), "é\ud800"):
        assert redaction.in_text(text) == text


def test_cookies_do_not_carry_the_key_to_another_host() -> None:
    with serving(sends(CONTENT)) as other:
        move = sends(b"", 302, Location=f"{other.url}/there", Set_Cookie=f"k={SECRET}; Path=/")
        with serving(move) as server:
            download(request_to(server.url, key=SECRET), QUICK)
        assert SECRET not in str(other.seen)


@pytest.mark.usefixtures("user_folder")
def test_a_second_fetch_needs_no_network() -> None:
    with serving(sends(CONTENT)) as server:
        request = request_to(server.url)
        (first,) = fetch([request], patience=QUICK)
    (second,) = fetch([request], patience=QUICK)
    assert second == first
    assert first.origin["licence"] == "none"
    assert first.origin["url"].endswith("/data?a=1")
    assert sorted(x.name for x in first.path.parent.iterdir()) == [
        "data.json",
        "data.json.origin.json",
    ]


@pytest.mark.parametrize("damage", ["content", "origin", "no origin", "request"])
@pytest.mark.usefixtures("user_folder")
def test_what_is_damaged_is_downloaded_again(damage: str) -> None:
    with serving(sends(CONTENT)) as server:
        request = request_to(server.url)
        (kept,) = fetch([request], patience=QUICK)
        origin = kept.path.with_name("data.json.origin.json")
        if damage == "content":
            kept.path.write_bytes(CONTENT[:-1])
        elif damage == "origin":
            origin.write_text("{")
        elif damage == "no origin":
            origin.unlink()
        else:
            request = replace(request, query={"a": "2"})
        fetch([request], patience=QUICK)
        assert len(server.seen) == 2
        fetch([request], patience=QUICK, refresh=True)
        assert len(server.seen) == 3


def test_nothing_is_kept_of_a_bad_answer(user_folder: Path) -> None:
    with serving(sends(b"no json")) as server, pytest.raises(DataError):
        fetch([request_to(server.url)], patience=QUICK)
    assert not user_folder.exists()


@pytest.mark.parametrize("value", ["", "  ", "abc", "has space 123", "naïve-key-123", "x" * 300])
def test_what_is_no_key_is_refused_without_showing_it(
    monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    monkeypatch.setenv("TEST_KEY", value)
    with pytest.raises(DataError, match=r"TEST_KEY.*https://example.org/key") as raised:
        read_key(SERVICE)
    assert not value.strip() or value not in str(raised.value)


def test_netrc_is_not_sent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    netrc = tmp_path / "netrc"
    netrc.write_text("machine 127.0.0.1 login me password mine\n")
    netrc.chmod(0o600)
    monkeypatch.setenv("NETRC", str(netrc))
    with serving(sends(CONTENT)) as server:
        download(request_to(server.url), QUICK)
    assert "Authorization" not in server.seen[0][1]
