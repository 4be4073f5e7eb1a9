"""Downloads from a server that fails in every way: whole, or one line of error and nothing kept."""

from __future__ import annotations

import gzip
import json
import logging
import socket
import time
from dataclasses import replace
from pathlib import Path

import pytest

from faulty_server import Answer, drips, sends, sends_by_range, serving, silent
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.fetch.answers import read_json
from sdc_taichi.exogenous.fetch.download import Patience, download
from sdc_taichi.exogenous.fetch.kept_downloads import fetch
from sdc_taichi.exogenous.fetch.request import Key, Request, Service, read_key

SERVICE = Service("test", "Test service", "none", "https://example.org/key")
SECRET = "abcdef-0123456789"
KEY = Key("TEST_KEY", "api_key", SECRET)
QUICK = Patience(connect_s=20.0, read_s=20.0, total_s=60.0, attempts=3, first_wait_s=0.01)
CONTENT = json.dumps({"rows": list(range(5000))}).encode()


def request_to(url: str, **changes: object) -> Request:
    made = Request(
        SERVICE,
        f"{url}/data",
        "data.json",
        {"a": "1"},
        by_hand="by hand: like this",
        check=read_json,
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def failure(*answers: Answer, **changes: object) -> str:
    """Message of a download that fails; it holds no key, and nothing was kept."""
    with serving(*answers) as server, pytest.raises(DataError) as raised:
        download(request_to(server.url, **changes), QUICK)
    message = str(raised.value)
    assert SECRET not in message
    assert len(message.splitlines()) == 1
    return message


def test_answer_comes_whole() -> None:
    with serving(sends(CONTENT, ETag='"v1"')) as server:
        found = download(request_to(server.url, key=KEY), QUICK)
    assert found.content == CONTENT
    assert found.etag == '"v1"'
    (path, headers) = server.seen[0]
    assert path == f"/data?a=1&api_key={SECRET}"
    assert headers["Accept-Encoding"] == "identity"


@pytest.mark.parametrize("status", [408, 429, 500, 502, 503, 504])
def test_statuses_that_may_pass_are_tried_again(status: int) -> None:
    with serving(sends(b"", status), sends(b"", status), sends(CONTENT)) as server:
        assert download(request_to(server.url), QUICK).content == CONTENT
    assert len(server.seen) == 3


def test_attempts_end() -> None:
    with serving(sends(b"", 503)) as server, pytest.raises(DataError) as raised:
        download(request_to(server.url), QUICK)
    assert len(server.seen) == QUICK.attempts
    assert str(raised.value) == (
        "127.0.0.1: status 503 (Service Unavailable), 3 times; by hand: like this"
    )


def test_waits_double_and_are_spread() -> None:
    waits: list[float] = []
    with serving(sends(b"", 500)) as server, pytest.raises(DataError):
        download(request_to(server.url), replace(QUICK, attempts=5), sleep=waits.append)
    assert len(waits) == 4
    for i, wait in enumerate(waits):
        assert 0.5 * 0.01 * 2**i <= wait <= 0.01 * 2**i


def test_retry_after_is_honoured() -> None:
    waits: list[float] = []
    with serving(sends(b"", 429, Retry_After="2"), sends(CONTENT)) as server:
        download(request_to(server.url), QUICK, sleep=waits.append)
    assert waits == [2.0]


def test_retry_after_beyond_the_total_time_ends_at_once() -> None:
    begin = time.monotonic()
    message = failure(sends(b"", 429, Retry_After="3600"))
    assert "asks to wait 3,600 s" in message
    assert time.monotonic() - begin < 30.0


def test_statuses_of_a_bad_request_end_at_once_with_what_the_service_says() -> None:
    said = json.dumps({"message": "Location over the sea."}).encode()
    with serving(sends(said, 400)) as server, pytest.raises(DataError, match="over the sea"):
        download(request_to(server.url), QUICK)
    assert len(server.seen) == 1


@pytest.mark.parametrize("status", [401, 403])
def test_a_refused_key_names_its_variable_alone(status: int) -> None:
    said = f"<r><text>token {SECRET} unknown</text></r>".encode()
    message = failure(sends(said, status, kind="application/xml"), key=KEY)
    assert "TEST_KEY" in message
    assert "token KEY unknown" in message


def test_a_silent_server_ends() -> None:
    with serving(silent(lambda: server.stopped)) as server, pytest.raises(DataError) as raised:
        download(request_to(server.url), replace(QUICK, read_s=0.1))
    assert "no answer within 0.1 s, 3 times" in str(raised.value)


def test_a_slow_answer_ends_in_the_total_time() -> None:
    begin = time.monotonic()
    with (
        serving(drips(CONTENT, 0.02, lambda: server.stopped)) as server,
        pytest.raises(DataError, match=r"no answer within 0\.5 s, try later"),
    ):
        download(request_to(server.url), replace(QUICK, total_s=0.5))
    assert time.monotonic() - begin < 20.0


def test_no_server_is_an_error_with_what_to_do_by_hand() -> None:
    with serving(sends(b"")) as server:
        pass
    with pytest.raises(DataError, match=r"no connection .*, 3 times; by hand: like this"):
        download(request_to(server.url), QUICK)


def test_no_such_host_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(DataError) as raised:
        download(request_to("http://example.invalid"), QUICK, sleep=lambda _: pytest.fail("waits"))
    assert str(raised.value) == (
        "example.invalid: not found (is there a network?); by hand: like this"
    )


def test_an_answer_that_is_cut_off_goes_on_where_it_ended() -> None:
    with serving(sends_by_range(CONTENT, '"v1"', first=1000)) as server:
        assert download(request_to(server.url), QUICK).content == CONTENT
    (_, second) = server.seen[1]
    assert second["Range"] == "bytes=1000-"
    assert second["If-Range"] == '"v1"'
    assert len(server.seen) == 2


def test_another_version_begins_again() -> None:
    new = CONTENT.replace(b"4999", b"7777")
    first = sends(CONTENT[:1000], length=len(CONTENT), ETag='"v1"')
    with serving(first, sends(new, ETag='"v2"')) as server:
        assert download(request_to(server.url), QUICK).content == new


def test_a_weak_version_is_not_continued() -> None:
    first = sends(CONTENT[:1000], length=len(CONTENT), ETag='W/"v1"')
    with serving(first, sends(CONTENT)) as server:
        assert download(request_to(server.url), QUICK).content == CONTENT
    assert "Range" not in server.seen[1][1]


@pytest.mark.parametrize(
    "again",
    [
        sends(CONTENT[500:], 206, Content_Range="bytes 500-9/*"),
        sends(CONTENT[500:], 206),
        sends(b"", 416),
    ],
)
def test_a_wrong_rest_is_not_joined(again: Answer) -> None:
    first = sends(CONTENT[:1000], length=len(CONTENT), ETag='"v1"')
    with serving(first, again, sends(CONTENT)) as server:
        assert download(request_to(server.url), QUICK).content == CONTENT
    assert "Range" not in server.seen[2][1]


def test_an_answer_that_is_always_cut_off_is_an_error() -> None:
    message = failure(sends(CONTENT[:1000], length=len(CONTENT)))
    assert "an answer that is cut off, 3 times" in message


def test_more_than_the_told_length_is_not_read() -> None:
    message = failure(sends(CONTENT, length=1000))
    assert "expected JSON" in message


def test_a_large_answer_is_refused_before_it_is_read() -> None:
    assert "more than 0.0 MB" in failure(sends(CONTENT), most_bytes=1000)


def test_a_large_answer_without_a_length_is_refused() -> None:
    def endless(request: object) -> None:
        request.send_response(200)  # type: ignore[attr-defined]
        request.end_headers()  # type: ignore[attr-defined]
        for _ in range(100):
            request.wfile.write(b"x" * 65536)  # type: ignore[attr-defined]

    assert "more than 1.0 MB" in failure(endless, most_bytes=1_000_000)


def test_an_answer_in_chunks_comes_whole_and_cut_off_it_does_not() -> None:
    def chunks(end: bytes) -> Answer:
        def answer(request: object) -> None:
            request.send_response(200)  # type: ignore[attr-defined]
            request.send_header("Transfer-Encoding", "chunked")  # type: ignore[attr-defined]
            request.end_headers()  # type: ignore[attr-defined]
            for part in (CONTENT[:1000], CONTENT[1000:]):
                line = f"{len(part):x}\r\n".encode()
                request.wfile.write(line + part + b"\r\n")  # type: ignore[attr-defined]
            request.wfile.write(end)  # type: ignore[attr-defined]

        return answer

    with serving(chunks(b"0\r\n\r\n")) as server:
        assert download(request_to(server.url), QUICK).content == CONTENT
    assert "cut off" in failure(chunks(b""))


def test_a_compressed_answer_is_unpacked() -> None:
    with serving(sends(gzip.compress(CONTENT), Content_Encoding="gzip")) as server:
        assert download(request_to(server.url), QUICK).content == CONTENT


def test_a_gzip_bomb_is_refused() -> None:
    bomb = gzip.compress(bytes(50_000_000))
    assert len(bomb) < 100_000
    assert "more than 1.0 MB" in failure(sends(bomb, Content_Encoding="gzip"), most_bytes=1_000_000)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (sends(gzip.compress(CONTENT)[:-20], Content_Encoding="gzip"), "cut off"),
        (sends(b"plain", Content_Encoding="gzip"), "damaged, expected gzip"),
        (sends(CONTENT, Content_Encoding="br"), "compressed as 'br'"),
        (sends(b"<!DOCTYPE html><p>Log in", kind="text/html"), "an HTML page"),
        (sends(b" <HTML>", kind="application/json"), "an HTML page"),
        (sends(b"\x89PNG\r\n", kind="image/png"), "expected JSON"),
        (sends(b'{"a": "\xff"}'), "byte 7 is not UTF-8"),
        (sends(b"[1, 2]"), "expected a JSON object"),
        (sends(b"[" * 100_000), "expected JSON"),
        (sends(b""), "expected JSON"),
    ],
)
def test_what_was_not_asked_for_is_refused(answer: Answer, message: str) -> None:
    assert message in failure(answer)


def test_redirects_are_followed_and_end() -> None:
    # The content of a redirect, here one that never ends, is not read.
    redirect = sends(b"moved", 302, length=10**12, Location="/there")
    with serving(redirect, sends(CONTENT)) as server:
        assert download(request_to(server.url), QUICK).content == CONTENT
    assert [path for path, _ in server.seen] == ["/data?a=1", "/there"]
    assert "more than 5 redirects" in failure(sends(b"", 302, Location="/there"))


@pytest.mark.parametrize("target", ["file:///etc/passwd", "ftp://example.org/x", "http://[x", ""])
def test_redirects_lead_to_the_web_alone(target: str) -> None:
    assert "a redirect to no address of the web" in failure(sends(b"", 302, Location=target))


def test_the_key_does_not_follow_to_another_host() -> None:
    with serving(sends(CONTENT)) as other:
        target = f"{other.url}/data?api_key={SECRET}"
        message = failure(sends(b"", 302, Location=target), key=KEY)
        assert other.seen == []
        assert "the key in TEST_KEY is for 127.0.0.1 alone" in message
        # Without a key, another host may be asked.
        with serving(sends(b"", 302, Location=other.url)) as server:
            assert download(request_to(server.url), QUICK).content == CONTENT


def test_the_key_is_neither_logged_nor_kept(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    echo = json.dumps({"request": {"params": {"api_key": SECRET}}, "rows": []}).encode()
    caplog.set_level(logging.DEBUG)
    with serving(sends(echo)) as server:
        (kept,) = fetch([request_to(server.url, key=KEY)], tmp_path, patience=QUICK)
    assert "GET /data" in caplog.text
    assert SECRET not in caplog.text
    for path in tmp_path.rglob("*"):
        assert path.is_dir() or SECRET.encode() not in path.read_bytes()
    assert SECRET not in repr(request_to("", key=KEY))
    assert b'"api_key": "KEY"' in kept.content


def test_the_key_is_not_in_the_traceback_of_a_failure() -> None:
    import traceback

    with serving(sends(b"")) as server:
        pass
    try:
        download(request_to(server.url, key=KEY), QUICK)
    except DataError:
        assert SECRET not in traceback.format_exc()


def test_cookies_and_netrc_are_not_sent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    netrc = tmp_path / "netrc"
    netrc.write_text("machine 127.0.0.1 login me password mine\n")
    netrc.chmod(0o600)
    monkeypatch.setenv("NETRC", str(netrc))
    with serving(sends(CONTENT)) as server:
        download(request_to(server.url), QUICK)
    assert "Authorization" not in server.seen[0][1]


def test_a_second_fetch_needs_no_network(tmp_path: Path) -> None:
    with serving(sends(CONTENT, ETag='"v1"')) as server:
        request = request_to(server.url)
        (first,) = fetch([request], tmp_path, patience=QUICK)
    (second,) = fetch([request], tmp_path, patience=QUICK)
    assert second == first
    assert first.origin["licence"] == "none"
    assert first.origin["url"].endswith("/data?a=1")
    assert first.origin["etag"] == '"v1"'
    assert sorted(x.name for x in first.path.parent.iterdir()) == [
        "data.json",
        "data.json.origin.json",
    ]


@pytest.mark.parametrize("damage", ["content", "origin", "no origin", "request"])
def test_what_is_damaged_is_downloaded_again(tmp_path: Path, damage: str) -> None:
    with serving(sends(CONTENT)) as server:
        request = request_to(server.url)
        (kept,) = fetch([request], tmp_path, patience=QUICK)
        origin = kept.path.with_name("data.json.origin.json")
        if damage == "content":
            kept.path.write_bytes(CONTENT[:-1])
        elif damage == "origin":
            origin.write_text("{")
        elif damage == "no origin":
            origin.unlink()
        else:
            request = replace(request, query={"a": "2"})
        fetch([request], tmp_path, patience=QUICK)
        assert len(server.seen) == 2
        fetch([request], tmp_path, patience=QUICK, refresh=True)
        assert len(server.seen) == 3


def test_nothing_is_kept_of_a_bad_answer(tmp_path: Path) -> None:
    with serving(sends(b"no json")) as server, pytest.raises(DataError):
        fetch([request_to(server.url)], tmp_path, patience=QUICK)
    assert list(tmp_path.rglob("*")) == []


def test_fetching_goes_on_after_a_failure(tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    with serving(sends(CONTENT), sends(b"", 404), sends(CONTENT)) as server:
        asked = [request_to(server.url, file_name=f"{i}.json") for i in range(2)]
        with pytest.raises(DataError, match="404"):
            fetch(asked, tmp_path, patience=QUICK)
        found = fetch(
            asked, tmp_path, patience=QUICK, progress=lambda now, total: done.append((now, total))
        )
    assert len(found) == 2
    assert len(server.seen) == 3
    assert done == [(0, 2), (1, 2), (2, 2)]


@pytest.mark.parametrize("value", ["", "  ", "abc", "has space 123", "naïve-key-123", "x" * 300])
def test_what_is_no_key_is_refused_without_showing_it(
    monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    monkeypatch.setenv("TEST_KEY", value)
    with pytest.raises(DataError, match=r"TEST_KEY.*https://example.org/key") as raised:
        read_key(SERVICE, "TEST_KEY", "api_key")
    assert not value.strip() or value not in str(raised.value)
