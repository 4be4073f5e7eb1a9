"""Recordings that cannot go on: disks, viewers and signals; the run itself always ends well."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from rrd import VIEWER_ENVIRONMENT, read, verify
from sdc_taichi import SdcError
from sdc_taichi.cli.app import app
from sdc_taichi.cli.view import viewer_program
from sdc_taichi.viz import recording_output
from sdc_taichi.viz.recorder import Recorder
from sdc_taichi.viz.recording_blocks import MAX_BLOCK_STEPS
from sdc_taichi.viz.recording_output import RecordingWarning, listens, served_at
from simulated import go_on, small

PROGRAM = (sys.executable, "-c", "from sdc_taichi.cli.app import main; main()")
POSIX = pytest.mark.skipif(os.name != "posix", reason="signals and limits of POSIX")


def recorded_steps(path: Path) -> list[int]:
    return list(read(path)["/dc/ny/series/pue"]["step"])


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


HANG_S = 60.0
"""A recording that takes longer than this hangs; steps alone take seconds on a busy machine."""


def wait_for(ready: Callable[[], bool], what: str) -> None:
    limit = time.monotonic() + HANG_S
    while not ready():
        assert time.monotonic() < limit, what
        time.sleep(0.02)


def free_port() -> int:
    return recording_output.check_port(0)


@contextlib.contextmanager
def viewer(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """What listens as a viewer does, without a window."""
    listening = [str(viewer_program()), "--serve-grpc", "--bind", "127.0.0.1", "--port", str(port)]
    process = subprocess.Popen(
        listening,
        env={**os.environ, **VIEWER_ENVIRONMENT},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_for(lambda: listens(served_at(port)), "the viewer did not start")
        yield process
    finally:
        process.kill()
        process.wait()


# Disks


def test_too_little_room_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=5000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with (
        small() as sim,
        pytest.raises(SdcError, match=r"0\.0 MB left on the disk, expected 8\.0 MB"),
    ):
        Recorder(tmp_path / "x.rrd").begin(sim)
    assert not list(tmp_path.iterdir())


def test_room_is_kept_for_the_results_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.rrd"
    with small() as sim, Recorder(path) as rec:
        sim.reset()
        rec.begin(sim)
        go_on(sim, rec, MAX_BLOCK_STEPS + 4)
        usage = shutil.disk_usage(tmp_path)._replace(free=8_000_000)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
        with pytest.warns(RecordingWarning, match="kept for the results of the run") as caught:
            go_on(sim, rec, MAX_BLOCK_STEPS)
        assert len(caught) == 1
        assert rec.failed
    assert recorded_steps(path) == list(range(MAX_BLOCK_STEPS))


@POSIX
def test_file_that_cannot_grow_ends_with_a_whole_block(tmp_path: Path) -> None:
    # The limit of a process on the size of its files, as a full disk or a quota would end them.
    code = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, 1_500_000))
import sys
sys.argv = ["sdc-taichi", "simulate", "tiny", "--days", "25", "--out", "run", "--quiet",
    "--record", "run/x.rrd"]
from sdc_taichi.cli.app import main
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("warning: recording run/x.rrd: cannot be written")
    assert lines[0].endswith("the run goes on without it")
    steps = pd.read_parquet(tmp_path / "run" / "steps.parquet")
    assert (
        len(steps) == json.loads((tmp_path / "run/metrics.json").read_text())["steps_done"] == 2400
    )
    found = recorded_steps(tmp_path / "run/x.rrd")
    assert 0 < len(found) < 2400
    assert len(found) % MAX_BLOCK_STEPS == 0


@POSIX
# Viewers


def test_run_without_a_viewer_goes_on(tmp_path: Path) -> None:
    address = served_at(free_port())
    with small() as sim, Recorder(address) as rec:
        sim.reset()
        begin = time.monotonic()
        with pytest.warns(RecordingWarning, match="no viewer listens"):
            rec.begin(sim)
        go_on(sim, rec, 200)
        assert rec.failed
        rec.close()
        assert time.monotonic() - begin < HANG_S


def test_viewer_that_is_killed_is_told_once() -> None:
    port = free_port()
    with small() as sim, viewer(port) as process, Recorder(served_at(port)) as rec:
        sim.reset()
        rec.begin(sim)
        for _ in range(100):
            rec.add(sim.step())
        process.kill()
        process.wait()
        begin = time.monotonic()
        with pytest.warns(RecordingWarning, match="the viewer has closed") as caught:
            go_on(sim, rec, 3 * MAX_BLOCK_STEPS)
        assert len(caught) == 1
        assert rec.failed
        rec.close()
        assert time.monotonic() - begin < HANG_S


@POSIX
def test_viewer_that_hangs_does_not_hold_the_run_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_output, "MAX_UNSENT_BYTES", 500_000)
    monkeypatch.setattr(recording_output, "VIEWER_WAIT_S", 0.2)
    port = free_port()
    with small() as sim, viewer(port) as process, Recorder(served_at(port)) as rec:
        sim.reset()
        rec.begin(sim)
        rec.add(sim.step())
        process.send_signal(signal.SIGSTOP)
        begin = time.monotonic()
        with pytest.warns(RecordingWarning, match="the viewer hangs, "):
            go_on(sim, rec, 4 * MAX_BLOCK_STEPS)
        assert rec.failed
        rec.close()
        assert time.monotonic() - begin < HANG_S


def test_viewers_get_what_is_served(tmp_path: Path) -> None:
    got = tmp_path / "got.rrd"
    with small() as sim, Recorder(tmp_path / "own.rrd", serve_port=0) as rec:
        sim.reset()
        rec.begin(sim)
        rec.add(sim.step())
        address = rec.served_address
        assert address is not None
        assert address.startswith("rerun+http://127.0.0.1:")
        assert listens(address), "from the first step on"
        port = int(address.split(":")[-1].removesuffix("/proxy"))
        for other in {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None)}:
            if not str(other).startswith(("127.", "::1")):
                with pytest.raises(OSError, match=r"refused|unreach"):
                    socket.create_connection((str(other), port), 1.0).close()
        for _ in range(150):
            rec.add(sim.step())
        rec.flush()
        with subprocess.Popen(
            [viewer_program(), "--bind", "127.0.0.1", "--port", "0", address, "--save", str(got)],
            env={**os.environ, **VIEWER_ENVIRONMENT},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as process:
            try:
                wait_for(lambda: got.exists() and got.stat().st_size > 100_000, "nothing came")
            finally:
                process.terminate()
    assert not listens(address), "closed with the recorder"
    assert recorded_steps(tmp_path / "own.rrd") == list(range(151))


def test_taken_port_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SdcError, match=f"port {port}: cannot be served on 127.0.0.1"):
            Recorder(None, serve_port=port)


# Signals


@POSIX
def test_run_that_is_ended_leaves_a_readable_recording(tmp_path: Path) -> None:
    out, killed = tmp_path / "run", tmp_path / "killed.rrd"
    path = out / "x.rrd"
    command = [*PROGRAM, "simulate", "tiny", "--days", "3650", "--out", str(out)]
    with subprocess.Popen(
        [*command, "--record", str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            wait_for(lambda: path.exists() and path.stat().st_size > 1_000_000, "no recording")
            # Not amid a block, whose end would be missing.
            size = path.stat().st_size
            wait_for(lambda: path.stat().st_size > size, "no further block")
            time.sleep(0.03)
            # What a process leaves that is killed now.
            process.send_signal(signal.SIGSTOP)
            shutil.copy(path, killed)
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGINT)
            _, stderr = process.communicate(timeout=60)
        finally:
            process.kill()
    left = recorded_steps(killed)
    assert len(left) >= MAX_BLOCK_STEPS
    assert len(left) % MAX_BLOCK_STEPS == 0
    assert left == list(range(len(left)))
    found = recorded_steps(path)
    assert found == list(range(len(found)))
    assert process.returncode == 130
    assert "interrupted after" in stderr
    assert len(found) == json.loads((out / "metrics.json").read_text())["steps_done"]
    assert len(pd.read_parquet(out / "steps.parquet")) == len(found)
    assert verify(path).returncode == 0


@POSIX
def test_served_run_is_served_until_it_is_ended(tmp_path: Path) -> None:
    port = free_port()
    out = tmp_path / "run"
    command = [*PROGRAM, "simulate", "tiny", "--days", "2", "--out", str(out), "--quiet"]
    with subprocess.Popen(
        [*command, "--serve", "--serve-port", str(port)], stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stderr is not None
            assert process.stderr.readline().startswith(
                "serving the run; watch it with: sdc-taichi"
            )
            assert "the run is finished and still served" in process.stderr.readline()
            assert listens(served_at(port))
            assert (out / "metrics.json").exists()
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
        finally:
            process.kill()
    assert not listens(served_at(port))


@POSIX
def test_viewer_is_served_to_browsers_of_this_machine(tmp_path: Path) -> None:
    path, port = tmp_path / "x.rrd", free_port()
    with small() as sim, Recorder(path) as rec:
        sim.reset()
        rec.begin(sim)
        rec.add(sim.step())
    with subprocess.Popen(
        [*PROGRAM, "view", str(path), "--web", "--port", str(port)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith(
                f"Viewer: http://127.0.0.1:{port}/?url=rerun%2Bhttp%3A%2F%2F127."
            )
            wait_for(lambda: listens(served_at(port)), "no page")
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10) as page:
                assert b"<html" in page.read().lower()
            process.terminate()
            assert process.wait(30) == 0
        finally:
            process.kill()
    assert not listens(served_at(port)), "the viewer ends with the command"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["view", "none.rrd"], "none.rrd: no such file"),
        (["view", __file__], "no Rerun recording"),
        (["view", "x.rrd", "--port", "80"], "--port: given without --web"),
        (["view", "rerun+http://127.0.0.1:1/proxy"], "nothing listens there"),
        (["view", "http://127.0.0.1:1"], "no address of a viewer"),
        (["simulate", "tiny", "--focus", "ny"], "--focus: given without a recording"),
        (["simulate", "tiny", "--every", "4"], "--every: given without a recording"),
        (["simulate", "tiny", "--record", "x.txt"], "must end in .rrd"),
        (["simulate", "tiny", "--record", "x.rrd", "--focus", "la"], "focus 'la'"),
    ],
)
def test_bad_commands_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = invoke(*arguments)
    assert done.exit_code == 2
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert not list(tmp_path.rglob("*.rrd"))
