"""Start Taichi once, on the CPU, at the first reset or step; refuse to run in a forked child."""

from __future__ import annotations

import contextlib
import io
import os
import sys

from sdc_taichi.errors import ConfigError, RuntimeStateError

_forked = False
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
    fields of the first. ``SDC_TAICHI_THREADS`` limits the threads of a runtime started here.

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
    from sdc_taichi.kernels.backend import ti

    if ti.lang.impl.get_runtime().prog is None:
        options = {"cpu_max_num_threads": _thread_limit()} if _thread_limit() else {}
        # ti.init prints a banner, which would end up in a user's piped output.
        with contextlib.redirect_stdout(io.StringIO()):
            ti.init(arch=ti.cpu, offline_cache=True, log_level=ti.ERROR, **options)
    # Starting makes another object of the runtime.
    program = ti.lang.impl.get_runtime().prog
    if _known[0] is not program:
        _known = (program, int(ti.lang.impl.current_cfg().cpu_max_num_threads))
    return _known[1]


def _thread_limit() -> int:
    text = os.environ.get("SDC_TAICHI_THREADS", "").strip()
    if not text:
        return 0
    if not text.isdigit() or int(text) < 1:
        raise ConfigError(f"SDC_TAICHI_THREADS={text!r}: valid is a positive integer")
    return int(text)
