"""Start Taichi once, on the CPU, at the first reset or step; refuse to run in a forked child."""

from __future__ import annotations

import atexit
import contextlib
import importlib
import io
import math
import os
import shutil
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

from sdc_taichi.errors import ConfigError, RuntimeStateError, SdcWarning, shortened
from sdc_taichi.number_text import parse_whole


def allowed_processors() -> list[int]:
    """Numbers of the processors that this process may run on, ascending."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def processor_quota(
    groups: Path = Path("/proc/self/cgroup"), mounted: Path = Path("/sys/fs/cgroup")
) -> float:
    """Processors whose time the process is granted, as in containers; inf without a quota.

    Args:
        groups: control groups of the process, one per line (cgroups(7) of Linux).
        mounted: where their settings are. In a container these may begin below the groups' paths.

    Returns:
        The least quota of the groups and those above, rounded up.
    """
    quotas = [math.inf]
    for line in _text(groups).split("\n"):
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        group = Path(path.lstrip("/"))
        for folder in (group, *group.parents) if path else ():
            if number == "0":
                quota_us, _, period_us = _text(mounted / folder / "cpu.max").partition(" ")
            elif "cpu" in controllers.split(","):
                quota_us = _text(mounted / "cpu" / folder / "cpu.cfs_quota_us")
                period_us = _text(mounted / "cpu" / folder / "cpu.cfs_period_us")
            else:
                continue
            # "max" or -1 without a quota.
            if quota_us.strip().isdecimal() and period_us.strip().isdecimal() and int(period_us):
                quotas.append(max(1, math.ceil(int(quota_us) / int(period_us))))
    return min(quotas)


def _text(file: Path) -> str:
    """Text of a file of the operating system; empty if it cannot be read."""
    try:
        return file.read_text("utf-8", errors="replace")
    except (OSError, ValueError):  # the latter of names that no file may have
        return ""


def _thread_ids() -> set[int]:
    """Threads of this process; none where the system does not tell."""
    try:
        return set(map(int, os.listdir("/proc/self/task")))
    except OSError:
        return set()


def _bind(threads: set[int], count: int) -> None:
    """Bind threads that compute together to one processor each, if there is one for each.

    Linux tends to wake all of them on the processor of the thread that waits for them, and moves
    them apart some milliseconds later, when the step is done. Where threads are fewer or more than
    processors, they are left to the system, which also serves processes beside this one.

    Args:
        threads: numbers of the threads; those that compute follow each other, others may be among
            them.
        count: how many of them compute at a time.
    """
    processors = allowed_processors()
    if count != len(processors) or not hasattr(os, "sched_setaffinity"):
        return
    for i, thread in enumerate(sorted(threads)):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(thread, {processors[i % count]})


CACHE_VARIABLE = "TI_OFFLINE_CACHE_FILE_PATH"
"""Environment variable that names Taichi's folder of compiled kernels; obeyed here too."""
LOCK_S = 60.0
"""Age, in s, from which a lock of the folder is one that a killed process left; Taichi holds it for
milliseconds."""
_LOCK = "ticache.lock"
_OWN = {
    "ENABLE_TAICHI_HEADER_PRINT": "False",
    "TI_SKIP_VERSION_CHECK": "ON",
    # In notebooks it would print that there is one, and look for text to print at each launch.
    "TI_ENABLE_PYBUF": "0",
}


class KernelCacheWarning(SdcWarning):
    """Compiled kernels cannot be kept for the next process."""


@contextlib.contextmanager
def taichi_environment() -> Iterator[None]:
    """Hide the variables by which users set up other programs of Taichi, such as ``TI_ARCH``.

    Taichi also aborts the process where there is neither ``HOME`` nor ``XDG_CACHE_HOME``.
    """
    hidden = {name: os.environ.pop(name) for name in [*os.environ] if name.startswith("TI_")}
    hidden |= {name: os.environ[name] for name in _OWN if name in os.environ}
    set_here = dict(_OWN)
    if not {"HOME", "XDG_CACHE_HOME"} & os.environ.keys():
        set_here["HOME"] = os.sep
    os.environ.update(set_here)
    try:
        yield
    finally:
        for name in set_here:
            os.environ.pop(name, None)
        os.environ.update(hidden)


def kernel_folder() -> Path:
    """Folder in which Taichi keeps compiled kernels, fit to be used.

    On Linux it is that of all programs of Taichi, or that of ``CACHE_VARIABLE``. Where none can be
    written, it is a temporary one, which is deleted at exit, with a ``KernelCacheWarning``.

    Raises:
        RuntimeStateError: no temporary folder can be written either.
    """
    folder = usual_folder()
    try:
        _make_usable(folder)
    except OSError as error:
        temporary = _temporary_folder(folder)
        reason = error.strerror or error
        message = f"{folder}: cannot be written ({reason}); kernels are compiled in every process"
        warnings.warn(message, KernelCacheWarning, stacklevel=2)
        return temporary
    return folder


def usual_folder() -> Path:
    """Folder in which programs of Taichi keep their kernels."""
    import platformdirs

    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named).absolute()
    return Path(platformdirs.user_cache_dir("taichi", appauthor=False)) / "ticache"


def _make_usable(folder: Path) -> None:
    """Create the folder of kernels, and delete a lock that a killed process has left there.

    Raises:
        OSError: it cannot be written.
    """
    if not folder.is_absolute():  # the system knows no home of this user
        raise OSError("no absolute path")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass
    lock = folder / _LOCK
    # Taichi would wait 2 s for it at every start, and then keep no kernels.
    with contextlib.suppress(FileNotFoundError):
        if time.time() - lock.stat().st_mtime > LOCK_S:
            lock.unlink()


def _temporary_folder(folder: Path) -> Path:
    """Folder of kernels that is deleted at exit.

    Args:
        folder: the one that cannot be written.

    Raises:
        RuntimeStateError: none can be created.
    """
    for parent in (None, "/dev/shm"):
        try:
            made = tempfile.mkdtemp(prefix="sdc-taichi-", dir=parent)
        except OSError:
            continue
        atexit.register(_delete_at_exit, made, os.getpid())
        return Path(made)
    raise RuntimeStateError(
        f"{folder}: cannot be written, nor can a temporary folder; valid is a folder for kernels "
        "in XDG_CACHE_HOME, or for temporary files in TMPDIR"
    )


def _delete_at_exit(folder: str, owner: int) -> None:
    """Delete a temporary folder of kernels, once Taichi, which writes to it last, has ended."""
    if os.getpid() != owner:
        return
    if "taichi" in sys.modules:
        with taichi_environment():
            sys.modules["taichi"].reset()
    shutil.rmtree(folder, ignore_errors=True)


MOST_THREADS = 1024
"""Largest number of threads that may be asked for: more than any machine has processors that gain
from it."""

_forked = False
_starting = threading.Lock()
_known: tuple[object, int] = (None, 0)
"""Runtime of the last call and its threads, which take a while to ask for."""


def _mark_child() -> None:
    """Remember in a forked child that its parent had a runtime, its own or another library's."""
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
    with _starting, taichi_environment():
        try:
            importlib.import_module("taichi")
        except (ImportError, MemoryError) as error:
            raise RuntimeStateError(f"Taichi cannot be loaded: {error}") from error


def _start_taichi() -> None:
    """Start Taichi.

    Raises:
        RuntimeStateError: memory is short.
        ConfigError: ``SDC_TAICHI_THREADS`` is no positive integer.
    """
    import taichi as ti

    threads = _thread_limit() or int(min(len(allowed_processors()), processor_quota()))
    before = _thread_ids()
    folder = kernel_folder()
    with taichi_environment(), _without_banner():
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
        _bind(_thread_ids() - before - others, ti.cfg.cpu_max_num_threads)


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
