"""Faults around a run: signals, full disks, absent homes, closed streams, two at a time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fuzz.case import DefectError, Scratch, check_line
from sdc_taichi import SdcError
from sdc_taichi.run.folder_reader import read_run

PROGRAM = str(Path(sys.executable).with_name("sdc-taichi"))
TIMEOUT_S = 50
MOST_LINES = 4
"""Lines on stderr of a quiet run that met a fault: warnings, and at most one error."""


def start(arguments: Sequence[object], **options: Any) -> subprocess.Popen[bytes]:
    """Start the command line as a user would."""
    command = [PROGRAM, *map(str, arguments)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, **options)


def end(process: subprocess.Popen[bytes], codes: Sequence[int], scratch: Scratch) -> int:
    """Wait for a process and check its exit code and what it printed.

    Raises:
        SdcError: it ended with one clear error.
        DefectError: it ended in another way than the exit codes allow.
    """
    try:
        _, raw = process.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise DefectError(f"no end within {TIMEOUT_S} s") from None
    stderr = (raw or b"").decode(errors="replace")
    code = process.returncode
    if code not in codes or "Traceback" in stderr or len(stderr.splitlines()) > MOST_LINES:
        raise DefectError(f"exit code {code} (valid: {list(codes)}): {stderr[-800:]}")
    if code == 2 and raw is not None:
        errors = [line for line in stderr.splitlines() if line.startswith("error: ")]
        if len(errors) != 1:
            raise DefectError(f"{len(errors)} lines of error: {stderr[-800:]}")
        check_line(errors[0], scratch)
        raise SdcError(errors[0].removeprefix("error: "))
    return code


def simulation(out: Path, days: float = 0.25) -> list[object]:
    """Words of a short and quiet run."""
    return ["simulate", "tiny", "--days", days, "--out", out, "--quiet"]


def check_whole(out: Path, *, leftovers: bool = False) -> None:
    """Check that a run folder is whole, or has no metrics.json and no parts."""
    if (out / "metrics.json").exists():
        read_run(out)
    parts = [path.name for path in out.glob("*") if ".part" in path.name] if out.is_dir() else []
    if parts and not leftovers:
        raise DefectError(f"left {parts}")
    if (out / "metrics.json").exists() and parts:
        raise DefectError(f"a whole run beside {parts}")


def killed(scratch: Scratch, out: Path) -> None:
    """Kill a run at any time; the next one into its folder works."""
    process = start(simulation(out, 20))
    time.sleep(scratch.rng.uniform(0.2, 4.0))
    process.kill()
    process.communicate()
    check_whole(out, leftovers=True)
    end(start(simulation(out)), (0,), scratch)
    check_whole(out)


def signalled(scratch: Scratch, out: Path) -> None:
    """Interrupt a run at any time; it leaves whole files or none."""
    process = start(simulation(out, 20))
    time.sleep(scratch.rng.uniform(0.3, 4.0))
    sent = scratch.pick((signal.SIGINT, signal.SIGINT, signal.SIGTERM))
    process.send_signal(sent)
    # Before the run begins, SIGTERM ends the process as it does any other.
    codes = (0, 130, -sent) if sent == signal.SIGTERM else (0, 130)
    code = end(process, codes, scratch)
    check_whole(out)
    if code == 0 and not (out / "metrics.json").exists():
        raise DefectError("done without metrics.json")


def full_disk(scratch: Scratch, out: Path) -> None:
    """Let no file grow beyond some size; a run says so and leaves nothing."""
    import resource

    size = int(scratch.pick((0, 100, 3_000, 30_000, 10_000_000)))

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    env = {**os.environ, "HOME": str(out.parent)}
    code = 0
    try:
        code = end(start(simulation(out), preexec_fn=limit, env=env), (0, 2), scratch)
    finally:
        check_whole(out)
    if code == 0:
        read_run(out)


def full_stdout(scratch: Scratch, out: Path) -> None:
    """Print into a full device."""
    commands: list[list[object]] = [["config", "show"], ["data", "list"]]
    words = scratch.pick([*commands, [*simulation(out), "--json"]])
    with open("/dev/full", "wb") as full:
        end(start(words, stdout=full), (2,), scratch)


def homeless(scratch: Scratch, out: Path) -> None:
    """Run without a home, or with one that cannot be written."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(("HOME", "XDG", "SDC_"))}
    home = scratch.pick((None, "/nonexistent", "/dev/null", "/proc", ""))
    if home is not None:
        env |= {"HOME": home, "XDG_CACHE_HOME": f"{home}/cache"}
    end(start(simulation(out), env=env), (0,), scratch)
    read_run(out)


def two_at_a_time(scratch: Scratch, out: Path) -> None:
    """Start two runs into one folder; at least one ends well, and its files are whole."""
    first = start(simulation(out, 5))
    time.sleep(scratch.rng.uniform(0.0, 2.0))
    second = start(simulation(out, 5))
    errors = []
    for process in (first, second):
        try:
            end(process, (0, 2), scratch)
        except SdcError as error:
            errors.append(error)
    read_run(out)
    check_whole(out)
    if len(errors) == 2:
        raise DefectError(f"both refused: {errors}")
    if errors:
        raise errors[0]


def closed_pipe(scratch: Scratch, out: Path) -> None:
    """Run with an output that nobody reads to its end."""
    words = scratch.pick(
        (
            "config show | head -1",
            "data list | head -1",
            f"simulate tiny --days 0.25 --out {out} |:",
        )
    )
    command = ["bash", "-o", "pipefail", "-c", f"'{PROGRAM}' {words}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    end(process, (0, 1), scratch)
    check_whole(out)


def little_memory(scratch: Scratch, out: Path) -> None:
    """Run in little address space."""
    import resource

    size = int(scratch.rng.uniform(0.2, 6.0) * 2**30)

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (size, size))

    try:
        end(start(simulation(out), preexec_fn=limit), (0, 1, 2), scratch)
    finally:
        check_whole(out)


def odd_environment(scratch: Scratch, out: Path) -> None:
    """Run with variables that mean something to Taichi, NumPy or Python."""
    name = scratch.pick(
        ("TI_ARCH=cuda", "TI_DEBUG=1", "TI_LOG_LEVEL=trace", "TI_OFFLINE_CACHE=0", "TI_X=²",
         "TI_DEFAULT_FP=f64", "TI_NUM_THREADS=0", "TI_CPU_MAX_NUM_THREADS=x", "COLUMNS=0",
         "TI_OFFLINE_CACHE_FILE_PATH=/proc/x", "SDC_TAICHI_THREADS=²", "SDC_TAICHI_PLAIN=2",
         "SDC_TAICHI_DATA=/dev/null", "LANG=C", "PYTHONIOENCODING=ascii", "TMPDIR=/proc")
    )  # fmt: skip
    key, _, value = name.partition("=")
    end(start(simulation(out), env={**os.environ, key: value}), (0, 2), scratch)
    read_run(out)


FAULTS: tuple[Callable[[Scratch, Path], None], ...] = (
    killed, signalled, full_disk, full_stdout, homeless, two_at_a_time, closed_pipe,
    little_memory, odd_environment,
)  # fmt: skip


def faults(scratch: Scratch) -> None:
    """Let one fault meet a run."""
    scratch.pick(FAULTS)(scratch, scratch.output("run"))
