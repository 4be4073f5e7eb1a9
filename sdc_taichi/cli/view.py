"""``sdc-taichi report``, ``compare`` and ``view``: show runs and their recordings."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

import numpy as np
import typer
from rich.markup import escape

from sdc_taichi.cli.options import check_out_file, force_option, json_option, out_option
from sdc_taichi.errors import ConfigError, SdcError, printable
from sdc_taichi.user_file import open_input

if TYPE_CHECKING:
    from sdc_taichi.run.comparison import Comparison
    from sdc_taichi.run.folder_reader import RunFolder

WEB_PORT = 9090
"""Preferred port of the page that ``--web`` serves; if it is in use, another port is taken."""
_RECORDING_MAGIC = b"RRF"
_STOP_WAIT_S = 5.0
_LOADING_WAIT_S = 120.0


Runs = Annotated[
    list[str],
    typer.Argument(
        metavar="[NAME=]DIR...",
        help="Folders of runs of one hall, each shown as NAME if that is given.",
        show_default=False,
    ),
]
Costs = Annotated[
    list[str] | None,
    typer.Option(
        "--cost",
        metavar="NAME=AMOUNT",
        help="What it costs to make a variant, for its simple payback; repeatable.",
    ),
]
StudiesFailover = Annotated[
    bool,
    typer.Option("--failover", help="Find out how many CRAC units may fail, as of hall failover."),
]


def report_command(
    folders: Runs,
    cost: Costs = None,
    failover: StudiesFailover = False,
    out: Annotated[
        Path | None,
        out_option("Output file. [default: DIR/report.html]", "FILE.html"),
    ] = None,
    force: Annotated[bool, force_option("Replace an existing file of --out.")] = False,
) -> None:
    """Write a report of a recorded run: one HTML file with summary, tables and pictures.

    Further folders, of runs of the same hall and length, are compared with the first as by
    compare. The file needs no network.
    """
    from sdc_taichi.run.comparison import named_runs
    from sdc_taichi.viz.report import write_report

    if force and out is None:
        raise ConfigError("--force: valid with --out; DIR/report.html is replaced without it")
    check_out_file(out, ".html", force=force)
    runs = named_runs(folders)
    for run in runs.values():
        done, asked = run.metrics["steps_done"], run.metrics["steps_asked"]
        if done < asked:
            typer.echo(
                f"note: {printable(run.path)}: interrupted after {done} of {asked} steps", err=True
            )
    if len(runs) == 1 and (cost or failover):
        raise ConfigError("--cost, --failover: one run; valid are two or more to compare")
    comparison = None if len(runs) == 1 else _compare(runs, cost, failover=failover)
    written = write_report(next(iter(runs.values())), comparison, out)
    typer.echo(f"Report: {printable(written)}")


def compare_command(
    folders: Runs,
    cost: Costs = None,
    failover: StudiesFailover = False,
    as_json: Annotated[bool, json_option("Print the comparison as JSON.")] = False,
) -> None:
    """Compare runs of one hall: what differs, figures a year, and savings against the first.

    report with the same folders writes this as an HTML file, with pictures.
    """
    from sdc_taichi.run.comparison import comparison_values, named_runs
    from sdc_taichi.viz.report_comparison import (
        difference_rows,
        figure_rows,
        saving_rows,
        savings_title,
    )

    comparison = _compare(named_runs(folders), cost, failover=failover)
    if as_json:
        typer.echo(json.dumps(comparison_values(comparison), indent=2))
        return
    names = comparison.names
    every = range(len(names))
    if comparison.differences:
        _print_rows("What differs", ["", *names], difference_rows(comparison, every))
    _print_rows(
        f"Figures; percentages are changes against {names[0]}",
        ["", "unit", *names],
        figure_rows(comparison, every),
    )
    _print_rows(
        savings_title(comparison),
        ["", "unit", *names[1:]],
        saving_rows(comparison, every[1:]),
    )
    for note in comparison.notes:
        typer.echo(printable(note))


def _compare(
    runs: Mapping[str, RunFolder], cost: Sequence[str] | None, *, failover: bool
) -> Comparison:
    """Compare runs, and tell on stderr whose failover is studied."""
    from sdc_taichi.run.comparison import compare_runs, parse_costs

    def tell(name: str) -> None:
        typer.echo(f"failover of {printable(name)}", err=True)

    costs = parse_costs(cost or [], list(runs))
    return compare_runs(runs, costs, failover=failover, on_study=tell)


def _print_rows(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table whose first column, and ``unit``, are aligned to the left."""
    from rich.table import Table

    from sdc_taichi.cli.terminal import wide_console

    console = wide_console(200)
    console.print(printable(title), markup=False)
    shown = Table()
    for index, head in enumerate(heads):
        is_text = index == 0 or head == "unit"
        shown.add_column(escape(printable(head)), justify="left" if is_text else "right")
    for cells in rows:
        shown.add_row(*(escape(printable(cell)) for cell in cells))
    console.print(shown)


def view_command(
    recording: Annotated[
        str,
        typer.Argument(
            metavar="FILE.rrd|ADDRESS",
            help="Recording, or address that a run serves (simulate --serve).",
        ),
    ],
    web: Annotated[
        bool, typer.Option("--web", help="Serve the viewer to browsers of this machine.")
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help=f"Of the page with --web; 0 is any free one. [default: {WEB_PORT}, or any]",
        ),
    ] = None,
) -> None:
    """Show a recording in Rerun's viewer, or serve it on 127.0.0.1 to a browser.

    The viewer begins at the hottest moment of the run, or of its first event. Ends with the viewer,
    or on Ctrl-C.
    """
    from sdc_taichi.viz.recording_output import check_address, is_address, listens

    if port is not None and not web:
        raise SdcError("--port: given without --web; valid is both")
    if is_address(recording):
        check_address(recording)
        if not listens(recording):
            raise SdcError(f"{recording}: nothing listens there; valid is the address of a run")
        moment = None
    else:
        check_recording(Path(recording))
        moment = moment_of(Path(recording))
    command, page = viewer_command(recording, web=web, port=port)
    if page is not None:
        typer.echo(f"Viewer: {page} (Ctrl-C ends it)")
        if moment is not None:
            typer.echo(f"Hottest, or in its first event: {moment.replace('T', ' ')}")
    elif moment is not None:
        port_of_viewer = int(command[command.index("--port") + 1])
        threading.Thread(target=show_moment, args=(port_of_viewer, moment), daemon=True).start()
    code = _run_viewer(command)
    if code:
        hint = "" if web else "; without a screen, serve it to a browser with --web"
        raise SdcError(f"{recording}: the viewer ended with exit code {code}{hint}")


def check_recording(path: Path) -> None:
    """Check that a file is a Rerun recording.

    Raises:
        SdcError: the file cannot be read, or is not a Rerun recording.
    """
    with open_input(path) as file:
        beginning = file.read(len(_RECORDING_MAGIC))
    if beginning != _RECORDING_MAGIC:
        raise SdcError(f"{path}: no Rerun recording; valid is a file of simulate --record")


def moment_of(path: Path) -> str | None:
    """Return the time of a recording that a viewer shows first, in ISO format; None without one.

    A recording of a run that was killed has none, nor has a file that this version cannot read.
    """
    from sdc_taichi.viz.recording_output import import_rerun

    import_rerun()
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of recordings that were cut short
            chunks = RrdReader(path).stream().filter(content="/moment").to_chunks()
        texts = [chunk.to_record_batch().to_pydict()["TextDocument:text"] for chunk in chunks]
        return str(np.datetime64(texts[-1][-1][0])) if texts else None
    except (OSError, RuntimeError, ValueError, LookupError, TypeError):
        return None


def show_moment(port: int, moment: str) -> None:
    """Move the viewer of a port to a time once it has loaded its recording, and pause it there.

    A viewer that cannot be controlled stays at the beginning.

    Args:
        port: port on which the viewer listens.
        moment: the time, in ISO format.
    """
    from rerun.experimental import ViewerClient

    from sdc_taichi.viz.recording_output import served_at

    deadline = time.monotonic() + _LOADING_WAIT_S
    while time.monotonic() < deadline:
        time.sleep(0.2)
        try:
            viewer = ViewerClient.connect(served_at(port))
            state = viewer.get_state()
            if state.active_recording and not state.loading:
                timestamp = np.datetime64(moment, "ns")
                viewer.set_time("sim_time", timestamp=timestamp, play_state="paused")
                return
        except Exception:  # of any kind, while the viewer starts or after it has been closed
            continue


def viewer_command(recording: str, *, web: bool, port: int | None) -> tuple[list[str], str | None]:
    """Return the command line of the viewer, and the URL of the page it serves (None without one).

    Args:
        recording: path of a recording, or address of a running recording.
        web: True to serve the viewer to browsers.
        port: port of the page; 0 is any free port, None is ``WEB_PORT`` if free or any free port.

    Raises:
        SdcError: rerun-sdk is missing, or the port is in use.
    """
    from sdc_taichi.viz.recording_output import HOST, check_port, is_address, served_at

    command = [str(viewer_program()), recording, "--bind", HOST]
    data_port = check_port(0)
    if not web:
        return [*command, "--port", str(data_port)], None
    page_port = _page_port() if port is None else check_port(port)
    if page_port == data_port:
        data_port = check_port(0)
    command += ["--serve-web", "--web-viewer-port", str(page_port), "--port", str(data_port)]
    data = recording if is_address(recording) else served_at(data_port)
    return command, f"http://{HOST}:{page_port}/?url={quote(data, safe='')}"


def _page_port() -> int:
    from sdc_taichi.viz.recording_output import check_port

    try:
        return check_port(WEB_PORT)
    except SdcError:
        return check_port(0)


def viewer_program() -> Path:
    """Return the path of the viewer's binary.

    The ``rerun`` script is not used, because ending the script leaves the viewer running.

    Raises:
        SdcError: rerun-sdk is missing.
    """
    if named := os.environ.get("RERUN_CLI_PATH"):
        return Path(named)
    try:
        import rerun_cli
    except ImportError as error:
        raise SdcError(
            f"viewing needs rerun-sdk ({error}); install it with: pip install rerun-sdk"
        ) from None
    folder = Path(rerun_cli.__file__).parent
    candidates = [
        folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun",
        folder / "rerun.exe",
        folder / "rerun",
    ]
    viewer = next((path for path in candidates if path.is_file()), None)
    if viewer is None:
        raise SdcError(f"{folder}: no viewer there; install it with: pip install rerun-sdk")
    return viewer


def _run_viewer(command: list[str]) -> int:
    """Run the viewer, and return its exit code; 0 if Ctrl-C or SIGTERM ended it."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    environment = {"RERUN_ANALYTICS": "0", "RUST_LOG": "error", **os.environ}
    try:
        process = subprocess.Popen(command, env=environment)
    except OSError as error:
        raise SdcError(f"{command[0]}: cannot be run: {error.strerror}") from None
    try:
        return process.wait()
    except KeyboardInterrupt:
        return 0
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_STOP_WAIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
