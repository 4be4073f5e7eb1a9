"""The program ``sdc-taichi``: registration of its commands, errors and exit codes."""

from __future__ import annotations

import errno
import io
import os
import sys
import traceback
from collections.abc import Sequence
from importlib import metadata
from typing import Annotated, Any

import typer
import typer.core

from sdc_taichi.cli.benchmark import benchmark_app
from sdc_taichi.cli.collect import collect_command
from sdc_taichi.cli.config import config_app, new_command
from sdc_taichi.cli.data import data_app
from sdc_taichi.cli.doctor import doctor_command
from sdc_taichi.cli.evaluate import evaluate_command
from sdc_taichi.cli.export import export_command
from sdc_taichi.cli.hall import hall_app
from sdc_taichi.cli.jobs import JobsCommand
from sdc_taichi.cli.optimum import optimum_command
from sdc_taichi.cli.options import CommandApp, Debug
from sdc_taichi.cli.policy import policy_app
from sdc_taichi.cli.simulate import simulate_command
from sdc_taichi.cli.sweep import sweep_command
from sdc_taichi.cli.terminal import EXIT_FAILURE, EXIT_INPUT, EXIT_INTERRUPTED, warnings_in_lines
from sdc_taichi.cli.train import train_command
from sdc_taichi.cli.view import compare_command, report_command, view_command
from sdc_taichi.errors import SdcError, one_line, place_in_user_code
from sdc_taichi.user_functions import code_permitted_by

_FIRST_STEPS = """Simulate data centers, and learn to run them with less carbon, energy and water.

  sdc-taichi simulate --days 7 --out runs/first   a week of a data center in New York
  sdc-taichi report runs/first                    its tables and pictures, as one HTML file
  sdc-taichi new my_hall.yaml                     a configuration of your own to start from
  sdc-taichi data list                            sites and workload traces; data import adds yours
  sdc-taichi doctor                               what this machine has, and what is missing
  sdc-taichi --help                               all commands"""
"""Text printed by ``sdc-taichi`` without arguments."""


class _Commands(typer.core.TyperGroup):
    """Group of commands that reports an error as one line on stderr and an exit code."""

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> Any:
        words = sys.argv[1:] if args is None else list(args)
        extra |= {"standalone_mode": False, "obj": words}
        try:
            with warnings_in_lines(), code_permitted_by(words):
                code = super().main(args, *more, **extra)
        except Exception as error:
            if "--debug" in words:
                traceback.print_exc()
            code = _print_error(error)
        sys.exit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()
        except BrokenPipeError:  # without this, Click ends the program with exit code 1
            if not _is_reader_gone():
                raise
            _drop_output()
            return 0
        return result


app = CommandApp(
    cls=_Commands,
    name="sdc-taichi",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(benchmark_app, name="benchmark")
app.add_typer(config_app, name="config")
app.add_typer(data_app, name="data")
app.add_typer(hall_app, name="hall")
app.add_typer(policy_app, name="policy")
app.command("report")(report_command)
app.command("export")(export_command)
app.command("compare")(compare_command)
app.command("view")(view_command)
app.command("doctor")(doctor_command)
app.command("new")(new_command)
app.command("simulate", may_allow_code=True)(simulate_command)
app.command("optimum", may_allow_code=True)(optimum_command)
app.command("train", may_allow_code=True)(train_command)
app.command("evaluate", may_allow_code=True)(evaluate_command)
app.command("sweep", cls=JobsCommand, may_allow_code=True)(sweep_command)
app.command("collect", may_allow_code=True)(collect_command)


def main() -> None:
    """Run the command that this process was started with, and exit."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        app()
    except KeyboardInterrupt:  # outside the part of the program where Typer catches it
        sys.exit(EXIT_INTERRUPTED)


def _show_version(asked: bool) -> None:
    if asked:
        print(f"sdc-taichi {metadata.version('sdc-taichi')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", is_eager=True, callback=_show_version
        ),
    ] = False,
    debug: Debug = False,
) -> None:
    """Simulate data centers: workload, cooling, battery, carbon, and every server's air."""
    if context.invoked_subcommand is None:
        print(_FIRST_STEPS)


def _print_error(error: Exception) -> int:
    """Print an error as one line on stderr, and return the exit code."""
    place = place_in_user_code(error)
    if isinstance(error, typer.TyperException):
        # The message is empty if Typer has shown the help text because of missing arguments.
        text, code = error.format_message(), error.exit_code
    elif isinstance(error, SdcError):
        text, code = f"{error} (at {place})" if place else str(error), EXIT_INPUT
    elif isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EFBIG):
        _drop_output()
        text, code = f"output cannot be written: {error.strerror}", EXIT_INPUT
    elif isinstance(error, MemoryError):
        text, code = f"memory is short{f' ({error})' if str(error) else ''}", EXIT_FAILURE
    else:
        where = f"at {place}" if place else "unexpected; --debug shows where"
        text, code = f"{type(error).__name__}: {error} ({where})", EXIT_FAILURE
    if line := one_line(text):
        print(f"error: {line}", file=sys.stderr)
    return code


def _is_reader_gone() -> bool:
    """Return True if the reader of standard output, such as ``head``, has exited."""
    try:
        print(flush=True)
    except BrokenPipeError:
        return True
    return False


def _drop_output() -> None:
    """Redirect standard output to the null device, so that Python's flush at exit succeeds."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
