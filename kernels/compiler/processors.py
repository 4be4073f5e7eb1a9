"""Processors that this process may use, and the binding of threads to them."""

import contextlib
import math
import os
from pathlib import Path


def allowed() -> list[int]:
    """Numbers of the processors that this process may run on, ascending."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def quota(
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
                quota_us, _, period_us = _text(mounted / folder / "cpu.max").partition(" ")
            elif "cpu" in controllers.split(","):
                quota_us = _text(mounted / "cpu" / folder / "cpu.cfs_quota_us")
                period_us = _text(mounted / "cpu" / folder / "cpu.cfs_period_us")
            else:
                continue
            # "max" or -1 without a quota.
            if quota_us.strip().isdecimal() and period_us.strip().isdecimal() and int(period_us):
                found.append(max(1, math.ceil(int(quota_us) / int(period_us))))
    return min(found)


def _text(file: Path) -> str:
    """Text of a file of the operating system; empty if it cannot be read."""
    try:
        return file.read_text("utf-8", errors="replace")
    except (OSError, ValueError):  # the latter of names that no file may have
        return ""


def thread_ids() -> set[int]:
    """Threads of this process; none where the system does not tell."""
    try:
        return set(map(int, os.listdir("/proc/self/task")))
    except OSError:
        return set()


def bind(threads: set[int], count: int) -> None:
    """Bind threads that compute together to one processor each, if there is one for each.

    Linux tends to wake all of them on the processor of the thread that waits for them, and moves
    them apart some milliseconds later, when the step is done. Where threads are fewer or more than
    processors, they are left to the system, which also serves processes beside this one.

    Args:
        threads: numbers of the threads; those that compute follow each other, others may be among
            them.
        count: how many of them compute at a time.
    """
    processors = allowed()
    if count != len(processors) or not hasattr(os, "sched_setaffinity"):
        return
    for i, thread in enumerate(sorted(threads)):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(thread, {processors[i % count]})
