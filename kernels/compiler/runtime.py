"""Start Taichi once, on the CPU, at the first reset or step; refuse to run in a forked child."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import sys
import threading
from collections.abc import Iterator

from sdc_taichi.errors import ConfigError, RuntimeStateError, shortened
from sdc_taichi.kernels.compiler import processors, startup
from sdc_taichi.number_text import parse_whole

MOST_THREADS = 1024
"""Largest number of threads that may be asked for: more than any machine has processors that gain
from it."""

_forked = False
_starting = threading.Lock()
_known: tuple[object, int] = (None, 0)
"""Runtime of the last call and its threads, which take a while to ask for."""


def _mark_child() -> None:
    """Remember in a forked child that its parent had a runtime, whoever started it."""
    global _forked
    taichi = sys.modules.get("taichi")
    _forked = taichi is not None and taichi.cfg is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_child)


def uses_plain_taichi() -> bool:
    """Whether kernels are to be called through Taichi's public interface alone.

    Raises:
        ConfigError: ``SDC_TAICHI_PLAIN`` is neither 0 nor 1.
    """
    text = os.environ.get("SDC_TAICHI_PLAIN", "").strip()
    if text not in ("", "0", "1"):
        raise ConfigError(f"SDC_TAICHI_PLAIN={text!r}: valid are 0 and 1")
    return text == "1"


def ensure_started() -> int:
    """Start the runtime when none exists and return its number of threads.

    A runtime that another library started is used as it is: a second start would destroy the
    fields of the first. One started here has a thread for each processor that the process may
    use, no more than the quotas of its control groups grant, or ``SDC_TAICHI_THREADS``.

    Raises:
        RuntimeStateError: in a child forked after the start, where Taichi would hang; or the
            runtime was started with whole numbers of another length than 32 bits, and
            ``SDC_TAICHI_PLAIN`` is 1; or Taichi cannot be loaded or started.
        ConfigError: ``SDC_TAICHI_THREADS`` is no positive integer.
    """
    global _known
    if _forked:
        raise RuntimeStateError(
            "this process was forked after Taichi started and would hang; start workers with the "
            "'spawn' method (multiprocessing.get_context('spawn')) or create simulators only in "
            "the children"
        )
    if "taichi" not in sys.modules:
        _import_taichi()
    import taichi as ti

    # Gives the same as `ti.cfg` in a fifteenth of the time: steps ask several times.
    runtime = ti.lang.impl.get_runtime
    if _known[0] is None or _known[0] is not runtime().prog:
        with _starting:
            if ti.cfg is None:
                _start_taichi()
            elif uses_plain_taichi() and ti.cfg.default_ip != ti.i32:
                raise RuntimeStateError(
                    f"Taichi was started with default_ip={ti.cfg.default_ip.to_string()}; valid "
                    "with SDC_TAICHI_PLAIN=1 is i32"
                )
            _known = (runtime().prog, int(ti.cfg.cpu_max_num_threads))
    return _known[1]


def _import_taichi() -> None:
    """Import Taichi.

    Raises:
        RuntimeStateError: it is not installed, or memory is short.
    """
    with _starting, startup.taichi_environment():
        try:
            importlib.import_module("taichi")
        except (ImportError, MemoryError) as error:
            raise RuntimeStateError(f"Taichi cannot be loaded: {error}") from error


def _start_taichi() -> None:
    """Start Taichi.

    Raises:
        RuntimeStateError: memory is short, or there is no current folder.
        ConfigError: ``SDC_TAICHI_THREADS`` is no positive integer.
    """
    import taichi as ti

    try:
        os.getcwd()
    except FileNotFoundError:
        raise RuntimeStateError(
            "the current folder has been deleted; valid is one that exists, which Taichi needs"
        ) from None
    threads = _thread_limit() or int(min(len(processors.allowed()), processors.quota()))
    before = processors.thread_ids()
    folder = startup.kernel_folder()
    with startup.taichi_environment(), _without_banner():
        try:
            ti.init(
                arch=ti.cpu,
                offline_cache=True,
                offline_cache_file_path=str(folder),
                log_level=ti.CRITICAL,
                cpu_max_num_threads=threads,
            )
            # Taichi sets up memory at the first launch or here, which has to be in the thread that
            # starts.
            ti.sync()
        except (RuntimeError, MemoryError) as error:
            raise RuntimeStateError(
                f"Taichi cannot start: {error}; it reserves 1 GiB of address space (ulimit -v)"
            ) from error
    if not uses_plain_taichi():
        others = {thread.native_id for thread in threading.enumerate()}
        processors.bind(processors.thread_ids() - before - others, ti.cfg.cpu_max_num_threads)


@contextlib.contextmanager
def _without_banner() -> Iterator[None]:
    """Drop what Taichi prints at its start; pass on what other threads print meanwhile."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        yield
    for line in printed.getvalue().splitlines(keepends=True):
        if not line.startswith("[Taichi]"):
            sys.stdout.write(line)


def _thread_limit() -> int:
    """Number of threads that the environment asks for; 0 where it asks for none."""
    text = os.environ.get("SDC_TAICHI_THREADS", "").strip()
    if not text:
        return 0
    with contextlib.suppress(ValueError):
        if 1 <= (threads := parse_whole(text)) <= MOST_THREADS:
            return threads
    raise ConfigError(
        f"SDC_TAICHI_THREADS={shortened(text)}: valid is a positive integer up to {MOST_THREADS}"
    )
