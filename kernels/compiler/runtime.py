"""Start of Taichi, once per process on the CPU; a forked child raises an error."""

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
    """Return the numbers of the processors on which this process may run, ascending."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def processor_quota(
    groups: Path = Path("/proc/self/cgroup"), mounted: Path = Path("/sys/fs/cgroup")
) -> float:
    """Return the CPU quota of this process in processors, as in containers; inf without a quota.

    Args:
        groups: file with the control groups of the process, one per line (cgroups(7) of Linux).
        mounted: folder of the settings of control groups. Inside a container it may start below the
            paths of the groups.

    Returns:
        The smallest quota of the groups and their parents, rounded up.
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
            # Without a quota the value is "max" or -1.
            if quota_us.strip().isdecimal() and period_us.strip().isdecimal() and int(period_us):
                quotas.append(max(1, math.ceil(int(quota_us) / int(period_us))))
    return min(quotas)


def _text(file: Path) -> str:
    """Return the text of a file of the operating system, or an empty text if it is unreadable."""
    try:
        return file.read_text("utf-8", errors="replace")
    except (OSError, ValueError):  # ValueError: invalid file name
        return ""


def _thread_ids() -> set[int]:
    """Return the thread numbers of this process, or an empty set if the system has no list."""
    try:
        return set(map(int, os.listdir("/proc/self/task")))
    except OSError:
        return set()


def _bind(threads: set[int], count: int) -> None:
    """Bind each computing thread to one processor, if there are as many threads as processors.

    Linux tends to wake all threads on the processor of the waiting thread, and distributes them
    some milliseconds later, after the step is done. If the numbers of threads and processors
    differ, the operating system places the threads, as it also serves other processes.

    Args:
        threads: thread numbers; computing threads have consecutive numbers, and other threads may
            be among them.
        count: number of threads that compute at a time.
    """
    processors = allowed_processors()
    if count != len(processors) or not hasattr(os, "sched_setaffinity"):
        return
    for i, thread in enumerate(sorted(threads)):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(thread, {processors[i % count]})


CACHE_VARIABLE = "TI_OFFLINE_CACHE_FILE_PATH"
"""Environment variable with the path of Taichi's folder of compiled kernels."""
KERNELS_BYTES = 1_000_000_000
"""Largest size of the folder. A kernel has some 300 kB, and Taichi's own limit of 100 MB deletes
kernels of other halls that are still in use."""
LOCK_S = 60.0
"""Age of the folder's lock file, in s, from which it counts as the remnant of a killed process;
Taichi holds the lock for milliseconds."""
_LOCK = "ticache.lock"
_OWN = {
    "ENABLE_TAICHI_HEADER_PRINT": "False",
    "TI_SKIP_VERSION_CHECK": "ON",
    # Otherwise Taichi prints a banner in notebooks and polls its print buffer at every launch.
    "TI_ENABLE_PYBUF": "0",
}


class KernelCacheWarning(SdcWarning):
    """Warning that compiled kernels cannot be stored for the next process."""


@contextlib.contextmanager
def taichi_environment() -> Iterator[None]:
    """Hide environment variables meant for other Taichi programs, such as ``TI_ARCH``.

    If neither ``HOME`` nor ``XDG_CACHE_HOME`` is set, set ``HOME``: Taichi would abort the process.
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
    """Return a writable folder for Taichi's compiled kernels.

    On Linux it is the common folder of all Taichi programs, or that of ``CACHE_VARIABLE``. If that
    folder is not writable, create a temporary folder, deleted at exit, and give a
    ``KernelCacheWarning``.

    Raises:
        RuntimeStateError: if no temporary folder can be created either.
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
    """Return the folder in which Taichi programs store their compiled kernels."""
    import platformdirs

    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named).absolute()
    return Path(platformdirs.user_cache_dir("taichi", appauthor=False)) / "ticache"


def _make_usable(folder: Path) -> None:
    """Create the folder of kernels, and delete a lock left there by a killed process.

    Raises:
        OSError: if the folder is not writable.
    """
    if not folder.is_absolute():  # the user has no home folder
        raise OSError("no absolute path")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass
    lock = folder / _LOCK
    # With an old lock, Taichi would wait 2 s at every start and then store no kernels.
    with contextlib.suppress(FileNotFoundError):
        if time.time() - lock.stat().st_mtime > LOCK_S:
            lock.unlink()


def _temporary_folder(folder: Path) -> Path:
    """Return a temporary folder for kernels that is deleted at exit.

    Args:
        folder: the usual folder, which is not writable.

    Raises:
        RuntimeStateError: if no temporary folder can be created.
    """
    for parent in (None, "/dev/shm"):
        try:
            path = tempfile.mkdtemp(prefix="sdc-taichi-", dir=parent)
        except OSError:
            continue
        atexit.register(_delete_at_exit, path, os.getpid())
        return Path(path)
    raise RuntimeStateError(
        f"{folder}: cannot be written, nor can a temporary folder; valid is a folder for kernels "
        "in XDG_CACHE_HOME, or for temporary files in TMPDIR"
    )


def _delete_at_exit(folder: str, owner: int) -> None:
    """Delete a temporary folder of kernels at exit, after Taichi's last write to it."""
    if os.getpid() != owner:
        return
    if "taichi" in sys.modules:
        with taichi_environment():
            sys.modules["taichi"].reset()
    shutil.rmtree(folder, ignore_errors=True)


MOST_THREADS = 1024
"""Largest number of threads that a user may request; no machine gains from more threads."""

_forked = False
_starting = threading.Lock()
_known: tuple[object, int] = (None, 0)
"""Runtime at the last call and its number of threads, cached because the query is slow."""


def _mark_child() -> None:
    """Record in a forked child whether Taichi was already started in its parent."""
    global _forked
    taichi = sys.modules.get("taichi")
    _forked = taichi is not None and taichi.cfg is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_child)


def uses_plain_taichi() -> bool:
    """Return True if kernels must be called through Taichi's public interface only.

    Raises:
        ConfigError: if ``SDC_TAICHI_PLAIN`` is neither 0 nor 1.
    """
    text = os.environ.get("SDC_TAICHI_PLAIN", "").strip()
    if text not in ("", "0", "1"):
        raise ConfigError(f"SDC_TAICHI_PLAIN={text!r}: valid are 0 and 1")
    return text == "1"


def ensure_started() -> int:
    """Start the Taichi runtime if none exists; return its number of threads.

    A runtime of another library is used as it is, because a second start would destroy the fields
    of the first. A runtime started here has one thread for each processor available to the
    process, limited by the quotas of its control groups, or ``SDC_TAICHI_THREADS`` threads.

    Raises:
        RuntimeStateError: in a child forked after the start, where Taichi would hang; if Taichi
            cannot be loaded or started; or if ``SDC_TAICHI_PLAIN`` is 1 and the runtime was started
            with whole numbers of other than 32 bits.
        ConfigError: if ``SDC_TAICHI_THREADS`` is not a positive integer.
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

    # This is equivalent to a check of `ti.cfg`, in a fifteenth of the time; steps call it often.
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
        RuntimeStateError: if Taichi is not installed, or memory is short.
    """
    with _starting, taichi_environment():
        try:
            importlib.import_module("taichi")
        except (ImportError, MemoryError) as error:
            raise RuntimeStateError(f"Taichi cannot be loaded: {error}") from error


def _start_taichi() -> None:
    """Start Taichi with the number of threads of ``ensure_started``.

    Raises:
        RuntimeStateError: if Taichi cannot start, for example because memory is short.
        ConfigError: if ``SDC_TAICHI_THREADS`` is not a positive integer.
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
                offline_cache_max_size_of_files=KERNELS_BYTES,
                log_level=ti.CRITICAL,
                cpu_max_num_threads=threads,
            )
            # Taichi allocates memory at the first launch or here; it must be in the thread that
            # starts it.
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
    """Drop Taichi's own messages at its start; pass on what other threads print meanwhile."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        yield
    for line in printed.getvalue().splitlines(keepends=True):
        if not line.startswith("[Taichi]"):
            sys.stdout.write(line)


def _thread_limit() -> int:
    """Return the number of threads requested by the environment; 0 for no request."""
    text = os.environ.get("SDC_TAICHI_THREADS", "").strip()
    if not text:
        return 0
    with contextlib.suppress(ValueError):
        if 1 <= (threads := parse_whole(text)) <= MOST_THREADS:
            return threads
    raise ConfigError(
        f"SDC_TAICHI_THREADS={shortened(text)}: valid is a positive integer up to {MOST_THREADS}"
    )
