"""Start Taichi once, on the CPU, at the first reset or step; refuse to run in a forked child."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import threading
from importlib import import_module
from pathlib import Path

from sdc_taichi.errors import ConfigError, RuntimeStateError
from sdc_taichi.kernels.compiler import collector

_forked = False
_starting = threading.Lock()
_known: tuple[object, int] = (None, 0)
"""Runtime of the last call and its threads, which take a while to ask for."""


def _mark_child() -> None:
    """Remember in a forked child that its parent had a runtime, whoever started it."""
    global _forked
    taichi = sys.modules.get("taichi")
    _forked = taichi is not None and taichi.lang.impl.get_runtime().prog is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_child)


def ensure_started() -> int:
    """Start the runtime when none exists and return its number of threads.

    A runtime that another library started is used as it is: a second start would destroy the
    fields of the first. One started here has a thread for each processor that the process may
    use, no more than the quotas of its control groups grant, or ``SDC_TAICHI_THREADS``.

    Raises:
        RuntimeStateError: in a child forked after the start, where Taichi would hang.
        ConfigError: ``SDC_TAICHI_THREADS`` is no positive integer.
    """
    global _known
    if _forked:
        raise RuntimeStateError(
            "this process was forked after Taichi started and would hang; start workers with the "
            "'spawn' method (multiprocessing.get_context('spawn')) or create simulators only in "
            "the children"
        )
    if _known[0] is None:
        with collector.paused():
            import_module("sdc_taichi.kernels.compiler.backend")
    from sdc_taichi.kernels.compiler.backend import ti

    if _known[0] is None or _known[0] is not ti.lang.impl.get_runtime().prog:
        with _starting:
            if ti.lang.impl.get_runtime().prog is None:
                _start()
            # Starting makes another object of the runtime.
            program = ti.lang.impl.get_runtime().prog
            _known = (program, int(ti.lang.impl.current_cfg().cpu_max_num_threads))
    return _known[1]


def _start() -> None:
    from sdc_taichi.kernels.compiler import backend

    before = _thread_ids()
    backend.start(_thread_limit() or int(min(len(_processors()), granted())))
    others = {thread.native_id for thread in threading.enumerate()}
    threads = backend.ti.lang.impl.current_cfg().cpu_max_num_threads
    _bind(_thread_ids() - before - others, threads)


def _thread_ids() -> set[int]:
    """Threads of this process; none where the system does not tell."""
    try:
        return set(map(int, os.listdir("/proc/self/task")))
    except OSError:
        return set()


def _processors() -> list[int]:
    """Those that this process may use, which Taichi would not ask."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def granted(
    groups: Path = Path("/proc/self/cgroup"), mounted: Path = Path("/sys/fs/cgroup")
) -> float:
    """Processors whose time the process is granted, as in containers; inf without a quota.

    Args:
        groups: control groups of the process, one per line (cgroups(7) of Linux).
        mounted: where their settings are. In a container these may begin below the groups' paths.

    Returns:
        The least quota of the groups and those above, rounded up.
    """
    found = [math.inf]
    for line in _text(groups).split("\n"):
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        group = Path(path.lstrip("/"))
        for folder in (group, *group.parents) if path else ():
            if number == "0":
                quota, _, period_us = _text(mounted / folder / "cpu.max").partition(" ")
            elif "cpu" in controllers.split(","):
                quota = _text(mounted / "cpu" / folder / "cpu.cfs_quota_us")
                period_us = _text(mounted / "cpu" / folder / "cpu.cfs_period_us")
            else:
                continue
            # "max" or -1 without a quota.
            if quota.strip().isdecimal() and period_us.strip().isdecimal() and int(period_us):
                found.append(max(1, math.ceil(int(quota) / int(period_us))))
    return min(found)


def _text(file: Path) -> str:
    """What a file of the system says; nothing where there is none."""
    try:
        return file.read_text("utf-8", errors="replace")
    except (OSError, ValueError):  # the latter of names that no file may have
        return ""


def _bind(started: set[int], threads: int) -> None:
    """Bind Taichi's threads to one processor each.

    Linux tends to wake all of them on the processor of the thread that waits for them, and moves
    them apart some milliseconds later, when the step is done. Where threads are fewer or more than
    processors, they are left to the system, which also serves processes beside this one.
    """
    processors = _processors()
    if threads != len(processors) or not hasattr(os, "sched_setaffinity"):
        return
    # Those that compute are created one after the other, so no two of them meet.
    for i, thread in enumerate(sorted(started)):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(thread, {processors[i % threads]})


def _thread_limit() -> int:
    text = os.environ.get("SDC_TAICHI_THREADS", "").strip()
    if not text:
        return 0
    if not text.isdigit() or int(text) < 1:
        raise ConfigError(f"SDC_TAICHI_THREADS={text!r}: valid is a positive integer")
    return int(text)
