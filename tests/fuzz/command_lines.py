"""Command lines: every option of every command, with values that fit and others."""

from __future__ import annotations

import contextlib
import unicodedata
from functools import cache
from pathlib import Path
from typing import Any

import typer
from typer.testing import CliRunner

from fuzz import damage
from fuzz.case import DefectError, Scratch, check_line
from fuzz.data_files import SUFFIXES, lines_of
from fuzz.run_folders import run_files
from sdc_taichi import SdcError
from sdc_taichi.cli.app import app
from sdc_taichi.run.folder_reader import read_run

FITTING: dict[str, tuple[str, ...]] = {
    "site": ("ny", "ny,wa", "CA, tx"),
    "days": ("0.0625", "0.125"),
    "start": ("07-01", "12-31"),
    "dcs": ("1", "3"),
    "controller": ("g36", "random", "constant:18", "load=greedy-ci,cooling=coldest"),
    "seed": ("0", "7"),
    "overrides": ("hvac.chiller.reference_cop=5", "battery.capacity_kwh=100"),
    "out": ("run", "new/run", "x.png", "x.npz", "x.html"),
    "cell": ("0.8", "1"),
    "name": ("ny", "alibaba_1"),
    "record": ("x.rrd",),
    "focus": ("ny",),
    "path": ("../../../weather.epw", "../../../carbon.csv", "../../../workload.csv", "../../.."),
    "folders": ("done",),
    "every": ("2",),
    "precision": ("f32", "f64"),
    "stamp": ("auto", "start", "end"),
    "base": ("ny",),
    "utc_offset": ("-5", "5.5"),
}
"""Values that fit an option or argument, by its name."""
MOST = {"days": 0.2, "dcs": 4.0, "seed": 1e30}
"""Larger numbers are valid and take long."""
LEFT_OUT = {"serve", "serve_port", "help", "version", "install_completion", "show_completion"}
"""Options that wait for a viewer, or print a text and end."""
NO_COMMANDS = {"view", "sweep", "fetch"}
"""Commands that open a window, start processes, or ask services on the web."""


@cache
def commands() -> tuple[tuple[tuple[str, ...], Any], ...]:
    """Every command with its words."""

    def walk(command: Any, words: tuple[str, ...]) -> list[tuple[tuple[str, ...], Any]]:
        if not hasattr(command, "commands"):
            return [(words, command)]
        return [
            found
            for name, inner in command.commands.items()
            if name not in NO_COMMANDS
            for found in walk(inner, (*words, name))
        ]

    return tuple(walk(typer.main.get_command(app), ()))


def command_lines(scratch: Scratch) -> None:
    """Call a command in an empty folder, and look at what it prints and leaves."""
    rng = scratch.rng
    words, command = scratch.pick(commands())
    if words[0] == "hall" and words[-1] == "solve" and scratch.chance(0.7):
        words, command = next(one for one in commands() if one[0] == ("simulate",))
    here = scratch.output("a/b")
    here.mkdir(parents=True)
    given = list(words)
    if words[-1] in ("simulate", "solve", "check", "show") and words[0] != "data":
        given += [str(rng.choice(["tiny", "tiny", "tiny", "paper", "tinny", "no.yaml"]))]
    if words[-1] == "solve":
        given += ["--cell", "1"]
    if words[-1] == "simulate":
        given += ["--days", "0.0625", "--out", "run"]
    _write_inputs(scratch, words, here)
    before = set(here.rglob("*"))
    for parameter in command.params:
        likely = 1.0 if parameter.required else 1.5 / len(command.params)
        if parameter.name not in LEFT_OUT and scratch.chance(likely):
            given += _option(scratch, parameter)
    if scratch.chance(0.1):
        given.insert(int(rng.integers(len(given) + 1)), damage.scalar(rng)[:5000])
    given = [damage.lone_surrogates_escaped(text).replace("\x00", "") for text in given]
    done = _called(given, here)
    _check_folder(here, words, set(here.rglob("*")) - before, done.exit_code)
    if done.exit_code == 2:
        lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        if len(lines) != 1:
            raise DefectError(f"{given}: {len(lines)} lines of error: {done.stderr[:500]!r}")
        check_line(lines[0], scratch)
        raise SdcError(lines[0].removeprefix("error: "))
    if done.exit_code:
        raise DefectError(f"{given}: exit code {done.exit_code}: {done.stderr[-500:]!r}")


def _write_inputs(scratch: Scratch, words: tuple[str, ...], here: Path) -> None:
    """Write the files and folders that ``FITTING`` names."""
    if words[-1] == "import":
        for kind, suffix in SUFFIXES.items():
            text = "\n".join(lines_of(kind)) + "\n"
            scratch.write(f"{kind}.{suffix}", text.encode())
        scratch.named.clear()
    elif words[-1] == "report":
        (here / "done").mkdir()
        for name, content in run_files(1).items():
            (here / "done" / name).write_bytes(content)


def _called(given: list[str], here: Path) -> Any:
    with contextlib.chdir(here):
        env = {"SDC_TAICHI_DATA": str(here / "data"), "COLUMNS": "200"}
        done = CliRunner().invoke(app, given, env=env)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    for text in (done.stdout, done.stderr):
        odd = {c for c in text if unicodedata.category(c) in ("Cc", "Cf", "Cs") and c != "\n"}
        if odd:
            raise DefectError(f"{given}: printed {sorted(odd)}")
    return done


def _check_folder(here: Path, words: tuple[str, ...], new: set[Path], code: int) -> None:
    """Check that a command leaves whole files alone, and none if it fails."""
    files = sorted(str(path.relative_to(here)) for path in new if path.is_file())
    if any(".part" in name for name in files) or (code and files):
        raise DefectError(f"{words}: exit code {code}, left {files}")
    for metrics in here.rglob("metrics.json"):
        read_run(metrics.parent)


def _option(scratch: Scratch, parameter: Any) -> list[str]:
    """An option with a value, or the value of an argument."""
    name = parameter.name
    flag = getattr(parameter, "is_flag", False)
    opts = [opt for opt in parameter.opts if opt.startswith("-")]
    if flag:
        return opts[:1]
    fitting = FITTING.get(name, ())
    value = damage.scalar(scratch.rng)[:5000]
    if fitting and scratch.chance(0.6):
        value = scratch.pick(fitting)
    if name in MOST:
        with contextlib.suppress(ValueError):
            value = value if abs(float(value)) <= MOST[name] else fitting[0]
    if name == "out" and value.startswith("/"):
        value = "out" + value
    return [*opts[:1], value]
