"""Fixed work to compare steps with: the memory roof and the interpreter yardstick.

Times of steps mean nothing without the machine that they were measured on. Their ratio to the time
of fixed work of the same kind, measured in the same run, is far less tied to it. Steps of large
batches are compared with the memory roof, which stores the layers of as many servers; steps of few
data centers, starts and the fixed cost of a step are compared with the interpreter yardstick.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np

from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.types import F64

RUN = 32
"""Vectors that one value is stored to, as to the servers of a group."""


def core_s(calls: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, F64]:
    """Core time of each call in each round, s, (rounds,).

    The calls of a round follow each other, so that what memory and processors have to bear from
    outside meets all of them: what a call takes over another is the median over the rounds.
    """
    for call in calls.values():
        call()
    spent = {name: np.zeros(rounds) for name in calls}
    for at in range(rounds):
        for name, call in calls.items():
            start = time.process_time()
            call()
            spent[name][at] = time.process_time() - start
    return spent


def repeated(call: Callable[[], object], seconds: float = 0.01) -> tuple[Callable[[], object], int]:
    """The call in a loop of about that much time, and how many times the loop calls."""
    call()
    start = time.perf_counter()
    call()
    times = max(1, round(seconds / max(time.perf_counter() - start, 1e-9)))

    def loop() -> None:
        for _ in range(times):
            call()

    return loop, times


def core_ratios(
    calls: Mapping[str, Callable[[], object]], yardstick: Callable[[], object], rounds: int
) -> dict[str, float]:
    """Core time of one call over that of one call of the yardstick, medians over the rounds."""
    loops = {name: repeated(call) for name, call in {"": yardstick, **calls}.items()}
    spent = core_s({name: loop for name, (loop, _) in loops.items()}, rounds)
    each = {name: spent[name] / times for name, (_, times) in loops.items()}
    return {name: float(np.median(each[name] / each[""])) for name in calls}


@dataclass(slots=True)
class Reading:
    """Result of one round of the interpreter yardstick."""

    mean: F64
    """Mean of the inputs, (B,)."""
    hottest: F64
    """Largest of the inputs, (B,)."""
    late: bool
    """Whether the largest input of any data center exceeds the yardstick's limit."""


def interpreter_loop(rounds: int = 12) -> Callable[[], object]:
    """Python and NumPy on arrays of one data center, of the kinds of calls that a step makes.

    A round has some twenty calls of NumPy on arrays of 1 to 32 entries and as many operations of
    Python: attributes, dictionaries, calls, tuples and the making of an object.
    """
    rows = np.linspace(0.0, 1.0, 32).reshape(32, 1)
    table = np.arange(96.0)
    rolling = np.zeros((32, 1))
    names = [f"quantity_{number}" for number in range(12)]

    def bounded(values: F64, least: float, most: float) -> F64:
        return np.minimum(np.maximum(values, least), most)

    def one(step: int) -> Reading:
        np.multiply(rows, 0.5, out=rolling)
        rolling[step % 32] = table[step % 96]
        mean, hottest = rolling.mean(axis=0), rolling.max(axis=0)
        load = bounded(mean * 1.2 - 0.1, 0.0, 1.0)
        power = np.where(load > 0.5, load**2, load) + table[step % 96]
        quantities = {name: rolling[number] for number, name in enumerate(names)}
        total = 0.0
        for name, value in quantities.items():
            if name != "quantity_3":
                total += float(value[0])
        joined = np.concatenate([power, load, mean]).astype(np.float32)
        limit = np.asarray(total + joined.sum())
        return Reading(mean.copy(), hottest, bool(np.any(hottest > limit)))

    def loop() -> list[bool]:
        return [one(step).late for step in range(rounds)]

    return loop


def plain_store(servers: int) -> Callable[[], object]:
    """A store of three layers of ``servers`` values on all threads, in whole vectors."""
    import taichi as ti

    from sdc_taichi.kernels.compiler.arrays import aligned
    from sdc_taichi.kernels.compiler.functions import SLICE, part_of
    from sdc_taichi.kernels.compiler.launch import BoundKernel

    lanes, slices = 8, 64
    blocks_1d = ti.types.ndarray(dtype=ti.types.vector(lanes, ti.f32), ndim=1)

    @ti.kernel
    @no_type_check
    def store(slices: ti.i32, values: blocks_1d, a: blocks_1d, b: blocks_1d, c: blocks_1d):
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                first, end = part_of(k // SLICE, slices, values.shape[0])
                for run in range(first, end):
                    x = values[run]
                    for at in range(run * RUN, (run + 1) * RUN):
                        a[at] = x
                        b[at] = x
                        c[at] = x

    runtime.ensure_started()
    runs = -(-servers // (lanes * RUN))
    arrays: list[Any] = [aligned((n, lanes), np.float32) for n in (runs, *[runs * RUN] * 3)]
    for array in arrays:
        array[:] = 0.0
    bound = BoundKernel(store, templates=0)
    return lambda: bound(slices, *arrays)
