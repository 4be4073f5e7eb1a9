"""Stage functions compiled: the same function over arrays, in one pass over its entries.

A stage is a plain function whose arrays all have one entry per data center. It is called once with
quantities that write down what is done to them (``trace.py``); from that trace a kernel is made,
which computes F64_LANES entries at a time, as vectors of the processor, and keeps nothing in
between. Whatever the stage reads apart from its arguments is taken as constant. NumPy needs a call
and a temporary per operation, and some hundred of them cost more than the arithmetic unless there
are thousands of data centers.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from hashlib import sha256
from operator import attrgetter
from typing import Any, no_type_check

import numpy as np
import numpy.typing as npt
import taichi as ti

from ..elementary import log_and_exp
from .arrays import F64_LANES, unpadded, vector_rows
from .functions import SLICE, larger, smaller
from .launch import BoundKernel
from .source import define
from .trace import Trace, TracedObject

Arrays = Mapping[str, Any]

SERIAL_UP_TO = 4096
"""Entries that one thread computes sooner than several are woken."""
COPIED_UP_TO = 1024
"""Entries whose results are copied sooner than the kernel is handed another array for them."""
_TASK_BLOCKS = 32
"""Vectors that one task computes."""


class CompiledStage:
    """A stage function that runs as one kernel.

    Args:
        stage: function of arrays (n,), and of objects with arrays (n,) as attributes, by name. It
            returns arrays (n,), or numbers, by name. It may use arithmetic, comparisons and the
            NumPy functions of ``trace.py``, but no branch on values. It never changes its
            arguments, and infinities and NaN are no numbers here. Which attributes it reads is
            found when it is compiled, so later calls need no others.
        size: n.
    """

    def __init__(self, stage: Callable[..., Arrays], size: int) -> None:
        self._stage: Callable[..., Arrays] | None = stage
        self._size = size
        self._kernel: BoundKernel | None = None

    def __call__(self, **inputs: Any) -> dict[str, npt.NDArray[np.float64]]:
        """Results by name, each (n,): rows of one new array.

        Raises:
            TypeError: the stage does what cannot be compiled, or arguments are not those of the
                first call.
        """
        self._set_inputs(inputs)
        return self._new_results()

    def rows(self, **inputs: Any) -> npt.NDArray[np.float64]:
        """Results in their order, (number of results, n); the next call overwrites them.

        Raises:
            TypeError: the stage does what cannot be compiled, or arguments are not those of the
                first call.
        """
        self._set_inputs(inputs)
        self._run(self._outputs)
        return self._results

    def _set_inputs(self, inputs: Arrays) -> None:
        """Copy arguments, of the names of the first call, to the rows of the kernel."""
        if self._kernel is None:
            self._compile(inputs)
        elif tuple(inputs) != self._names:
            raise TypeError(
                f"arguments {[*inputs]}, expected {[*self._names]} as on the first call"
            )
        values: Iterable[Any] = inputs.values()
        if self._readers:
            values = [x for read, of in zip(self._readers, values, strict=True) for x in read(of)]
        for row, value in zip(self._input_rows, values, strict=True):
            row[...] = value

    def _new_results(self) -> dict[str, npt.NDArray[np.float64]]:
        """Run; results by name, rows of one new array."""
        if self._size <= COPIED_UP_TO:
            self._run(self._outputs)
            rows = self._results.copy()
        else:
            out = vector_rows(len(self._result_names), self._size)
            self._run(out)
            rows = unpadded(out, self._size)
        return dict(zip(self._result_names, rows, strict=True))

    def _run(self, out: Any) -> None:
        assert self._kernel is not None
        serial = self._size <= SERIAL_UP_TO
        self._kernel(serial, 1, self._shared, self._constants, self._inputs, out)

    def _compile(self, inputs: Arrays) -> None:
        assert self._stage is not None
        trace = Trace(self._size)
        traced = {name: trace.argument(value) for name, value in inputs.items()}
        results = {name: trace.lift(x) for name, x in self._stage(**traced).items()}
        self._names, self._result_names = tuple(inputs), tuple(results)
        self._readers = []
        """For each argument what returns its arrays; empty if all arguments are arrays."""
        if any(isinstance(x, TracedObject) for x in traced.values()):
            self._readers = [_reader(x) for x in traced.values()]
        self._shared = np.array([*trace.shared, 0.0])
        constants = trace.constants or [np.zeros(self._size)]
        self._constants, self._inputs, self._outputs = (
            vector_rows(n, self._size) for n in (len(constants), trace.inputs or 1, len(results))
        )
        for rows in (self._constants, self._inputs):
            rows[:] = 0.0
        unpadded(self._constants, self._size)[:] = constants
        rows = unpadded(self._inputs, self._size)
        self._input_rows = [rows[i] for x in traced.values() for i in x.rows]
        self._results: npt.NDArray[np.float64] = unpadded(self._outputs, self._size)
        source = _source(trace.statements(list(results.values())))
        self._kernel = BoundKernel(_kernel(source), templates=1)
        # A function that is a method of the stage's owner would make a cycle of references, which
        # only the garbage collector frees, with all arrays that the object holds.
        self._stage = None


def _reader(argument: Any) -> Callable[[Any], Iterable[Any]]:
    """What returns those arrays of an argument that the stage reads, in the order of its rows."""
    if not isinstance(argument, TracedObject):
        return lambda array: (array,)
    names = [*argument.read]
    if len(names) > 1:
        return attrgetter(*names)
    return lambda record: [getattr(record, name) for name in names]


def _source(body: list[str]) -> str:
    """Source of a kernel that does these statements for every vector i.

    The step of the innermost loop is an argument that is always 1: compilers that knew it would
    make copies of the body, for two thirds of the machine code of a short one, and nothing gained.
    """
    head = (
        "@ti.kernel\n"
        "def stage(serial: ti.template(), step: ti.i32, shared: Reals, constants: Rows,\n"
        "          inputs: Rows, out: Rows):\n"
        f"    n_tasks = (out.shape[1] + {_TASK_BLOCKS - 1}) // {_TASK_BLOCKS}\n"
        "    ti.loop_config(serialize=serial)\n"
        f"    for at in range(n_tasks * {SLICE}):\n"
        f"        if at % {SLICE} == 0:\n"
        f"            first = at // {SLICE} * {_TASK_BLOCKS}\n"
        f"            end = ti.min(first + {_TASK_BLOCKS}, out.shape[1])\n"
        "            i = first\n"
        "            while i < end:\n"
        f"                zeros = ti.Vector([ti.f64(0.0)] * {F64_LANES})\n"
    )
    return head + "".join(f"                {line}\n" for line in [*body, "i += step"])


@ti.func
@no_type_check
def _minus(a):
    return a * ti.f64(-1.0)


@cache
def _kernel(source: str) -> Any:
    """The Taichi kernel of a source, one for all fleets whose stages are the same."""
    scope = {
        "ti": ti,
        "Reals": ti.types.ndarray(dtype=ti.f64, ndim=1),
        "Rows": ti.types.ndarray(dtype=ti.types.vector(F64_LANES, ti.f64), ndim=2),
        "larger": larger,
        "smaller": smaller,
        "minus": _minus,
        "exp_of": log_and_exp("f64", F64_LANES)[1],
        "__name__": __name__,
    }
    return define("stage", source, f"<stage {sha256(source.encode()).hexdigest()}>", scope)
