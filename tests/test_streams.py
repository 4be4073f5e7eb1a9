"""What the program prints is safe to print; full disks, closed pipes and Ctrl-C end it properly."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import sdc_taichi
from sdc_taichi import SdcError
from sdc_taichi.cli import app
from sdc_taichi.cli.terminal import PlainConsole
from sdc_taichi.errors import printable

PROGRAM = (sys.executable, "-m", "sdc_taichi")
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


def test_shown_configs_are_safe_to_print_and_read_back_equal(tmp_path: Path) -> None:
    config = sdc_taichi.load_config("tiny").model_copy(update={"description": HOSTILE[:-1]})
    text = config.to_yaml()
    assert all(map(str.isprintable, text.split("\n")))
    (tmp_path / "mine.yaml").write_text(text)
    assert sdc_taichi.load_config(str(tmp_path / "mine.yaml")) == config


@POSIX
def test_a_full_device_is_one_error() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*PROGRAM, "config", "show"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.stderr == "error: output cannot be written: No space left on device\n"
    assert done.returncode == 2


@POSIX
@pytest.mark.parametrize("command", ["show", "list"])  # output beyond a buffer, and within one
def test_a_reader_that_ends_early_ends_a_command_quietly(command: str) -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [*PROGRAM, "config", command], stdout=write, stderr=subprocess.PIPE, text=True
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


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
from sdc_taichi.__main__ import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (MemoryError(), "memory is short", 1),
        (KeyboardInterrupt(), "", 130),
    ],
)
def test_faults_of_the_machine_are_one_line(
    error: BaseException, line: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("sdc_taichi.cli.config.preset_names", fail)
    done = CliRunner().invoke(app.app, ["config", "list"])
    assert done.exit_code == code
    assert len(done.stderr.splitlines()) <= 1
    assert done.stderr.startswith(f"error: {line}" if line else "")
