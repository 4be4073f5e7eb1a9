"""Downloads from a server that fails in every way: whole, or one line of error and nothing kept."""

from __future__ import annotations

import gzip
import json
import logging
import socket
import time
import traceback
from dataclasses import replace
from pathlib import Path

import pytest

from faulty_server import Answer, drips, sends, serving, silent
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.fetch.download import Patience, Request, download, fetch, read_key
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
    bomb = gzip.compress(bytes(50_000_000))
    assert len(bomb) < 100_000
    assert "more than 0.0 MB" in failure(sends(CONTENT), most_bytes=1000)
    packed = sends(bomb, Content_Encoding="gzip")
    assert "more than 1.0 MB" in failure(packed, most_bytes=1_000_000)


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
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    echo = json.dumps({"request": {"params": {"api_key": SECRET}}, "rows": []}).encode()
    caplog.set_level(logging.DEBUG)
    with serving(sends(echo)) as server:
        (kept,) = fetch([request_to(server.url, key=SECRET)], tmp_path, patience=QUICK)
    assert "GET /data" in caplog.text
    assert SECRET not in caplog.text
    for path in tmp_path.rglob("*"):
        assert path.is_dir() or SECRET.encode() not in path.read_bytes()
    assert SECRET not in repr(request_to("", key=SECRET))
    assert b'"api_key": "KEY"' in kept.content


def test_a_second_fetch_needs_no_network(tmp_path: Path) -> None:
    with serving(sends(CONTENT)) as server:
        request = request_to(server.url)
        (first,) = fetch([request], tmp_path, patience=QUICK)
    (second,) = fetch([request], tmp_path, patience=QUICK)
    assert second == first
    assert first.origin["licence"] == "none"
    assert first.origin["url"].endswith("/data?a=1")
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
