"""What the program prints is safe to print, and what keeps it from printing ends no command."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import sdc_taichi
from sdc_taichi import SdcError
from sdc_taichi.cli import app, streams
from sdc_taichi.cli.terminal import PlainConsole
from sdc_taichi.errors import MOST_CHARACTERS, one_line, printable

PROGRAM = (sys.executable, "-c", "import sdc_taichi_command as c; c.main()")
POSIX = pytest.mark.skipif(os.name == "nt", reason="POSIX files and signals")
HOSTILE = "a\x1b[31m\x07\0b\u202ec\udcff"
ESCAPED = r"a\x1b[31m\x07\x00b\u202ec\udcff"


def test_control_characters_are_escaped() -> None:
    assert printable(HOSTILE) == ESCAPED
    assert printable("Zürich, 21\u00a0°C – 工") == "Zürich, 21\u00a0°C – 工"
    assert str(SdcError(f"{HOSTILE}\n  more")) == f"{ESCAPED} more"
    shown = io.StringIO()
    PlainConsole(file=shown, width=200).print(f"[red]{HOSTILE}\nnext", soft_wrap=True)
    assert shown.getvalue() == f"[red]{ESCAPED}\nnext\n"


def test_long_messages_keep_their_ends() -> None:
    message = one_line(f"dc.yaml: name {'x' * 3_000_000!r}; valid is a name")
    assert len(message) <= MOST_CHARACTERS + 5
    assert message.startswith("dc.yaml: name 'xxx")
    assert message.endswith("xxx'; valid is a name")


def test_a_hostile_file_name_is_escaped_in_errors(tmp_path: Path) -> None:
    done = CliRunner().invoke(app.app, ["config", "show", f"{tmp_path}/\x1b]0;mine\x07.yaml"])
    assert done.exit_code == 2
    assert r"/\x1b]0;mine\x07.yaml" in done.stderr
    assert done.stderr.rstrip("\n").isprintable()


def test_shown_configs_are_safe_to_print_and_read_back_equal(tmp_path: Path) -> None:
    config = sdc_taichi.load_config("tiny").model_copy(update={"description": HOSTILE[:-1]})
    text = config.to_yaml()
    assert all(map(str.isprintable, text.split("\n")))
    (tmp_path / "mine.yaml").write_text(text)
    assert sdc_taichi.load_config(str(tmp_path / "mine.yaml")) == config


def test_any_name_may_stand_in_a_picture(tmp_path: Path) -> None:
    plan = tmp_path / "plan.png"
    done = CliRunner().invoke(
        app.app, ["hall", "show", "tiny", r'name="$x_{ \e[2J 工"', "--out", str(plan)]
    )
    assert (done.exit_code, done.stderr) == (0, "")
    assert done.stdout.startswith(r"$x_{ \x1b[2J 工: 2 rows of 2 racks")
    assert plan.read_bytes()[1:4] == b"PNG"


@POSIX
def test_what_cannot_be_written_is_remembered_and_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    def guarded(file: Any) -> None:
        monkeypatch.setattr(sys, "stdout", file)
        monkeypatch.setattr(sys, "__stdout__", file)
        for name in ("stderr", "__stderr__"):
            monkeypatch.setattr(sys, name, getattr(sys, name))
        streams.guard_streams()
        for _ in range(3):
            sys.stdout.write(10_000 * "x" + "\udcff\n")

    with open("/dev/full", "w") as full:
        guarded(full)
        assert streams.output_failure() == (
            "standard output: cannot be written: No space left on device"
        )
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as pipe:
        guarded(pipe)
        assert streams.output_failure() is None, "a reader that wants no more is no failure"


@POSIX
def test_closed_streams_and_a_full_device(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*PROGRAM, "--version"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60
        )
    assert done.stderr == "error: standard output: cannot be written: No space left on device\n"
    assert done.returncode == 2
    closed = subprocess.run(
        [*PROGRAM, "data", "show", "NY"], preexec_fn=lambda: os.closerange(0, 3), timeout=60
    )
    assert closed.returncode == 0


@POSIX
def test_an_interrupt_while_the_package_is_imported_ends_the_program_quietly() -> None:
    code = """
import os, signal, sys

# Processes of a shell's background jobs ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
import sdc_taichi_command
sdc_taichi_command.main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@POSIX
def test_an_interrupt_after_a_command_is_done_does_not_undo_its_exit_code() -> None:
    code = """
import os, signal, sys
sys.argv = ["sdc-taichi", "--version"]
import sdc_taichi_command

try:
    sdc_taichi_command.main()
finally:
    os.kill(os.getpid(), signal.SIGINT)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("sdc-taichi ")


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (MemoryError(), "memory is short", 1),
        (FileNotFoundError(2, "gone"), "the current folder has been deleted; valid is one", 2),
        (KeyboardInterrupt(), "", 130),
    ],
)
def test_faults_of_the_machine_are_one_line(
    error: BaseException, line: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        if isinstance(error, FileNotFoundError):
            monkeypatch.setattr(os, "getcwd", fail)
        raise error

    monkeypatch.setattr("sdc_taichi.cli.config.preset_names", fail)
    done = CliRunner().invoke(app.app, ["config", "list"])
    assert done.exit_code == code
    assert len(done.stderr.splitlines()) <= 1
    assert done.stderr.startswith(f"error: {line}" if line else "")
