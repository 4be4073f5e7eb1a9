"""Stage functions compiled: the same function over arrays, in one pass over its entries.

A stage is a plain function whose arrays all have one entry per data center. It is called once with
quantities that write down what is done to them; from that record a kernel is made, which computes
F64_LANES entries at a time, as vectors of the processor, and keeps nothing in between. Whatever the
stage reads apart from its arguments is taken as constant. NumPy needs a call and a temporary per
operation, and some hundred of them cost more than the arithmetic unless there are thousands of data
centers.
"""

import linecache
from collections import Counter
from collections.abc import Callable, Mapping
from functools import cache
from hashlib import sha256
from typing import Any, no_type_check

import numpy as np
import numpy.typing as npt
from numpy.lib.mixins import NDArrayOperatorsMixin

from ..elementary import log_and_exp
from .backend import (
    F64_LANES,
    SLICE,
    BoundKernel,
    func,
    held,
    kernel,
    larger,
    smaller,
    ti,
    vector_rows,
)

Arrays = Mapping[str, Any]

SERIAL_UP_TO = 4096
"""Entries that one thread computes sooner than several are woken."""
COPIED_UP_TO = 1024
"""Entries whose results are copied sooner than the kernel is handed another table for them."""
_TASK_BLOCKS = 32
"""Vectors that one task computes."""
_LONGEST_TERM = 80
"""Letters of a quantity that is written within another."""

_NUMBERS = {
    np.add: "{} + {}",
    np.subtract: "{} - {}",
    np.multiply: "{} * {}",
    np.divide: "{} / {}",
    np.maximum: "larger({}, {})",
    np.minimum: "smaller({}, {})",
    np.negative: "minus({})",
    np.sqrt: "ti.sqrt({})",
    np.exp: "exp_of({})",
    np.floor: "ti.floor({})",
    np.ceil: "minus(ti.floor(minus({})))",
}
_COMPARISONS = {
    np.greater: "{} > {}",
    np.greater_equal: "{} >= {}",
    np.less: "{} < {}",
    np.less_equal: "{} <= {}",
    np.equal: "{} == {}",
}
_LOGIC = {
    np.bitwise_and: "{} & {}",
    np.bitwise_or: "{} | {}",
    np.invert: "{} == 0",
}


class CompiledStage:
    """A stage function that runs as one kernel.

    Args:
        stage: function of arrays (n,) by name that returns arrays (n,), or numbers, by name. It may
            use arithmetic, comparisons and the functions of NumPy in this module, but no branch on
            values. It never changes its arguments, and infinities and NaN are no numbers here.
        size: n.

    Raises:
        TypeError: the stage does something else, or arguments are not those of the first call.
    """

    def __init__(self, stage: Callable[..., Arrays], size: int) -> None:
        self._stage, self._size = stage, size
        self._kernel: BoundKernel | None = None

    def __call__(self, **given: npt.NDArray[np.float64]) -> dict[str, npt.NDArray[np.float64]]:
        """Results by name, each (n,): rows of one new array."""
        if self._size <= COPIED_UP_TO:
            rows = self.rows(**given).copy()
        else:
            self._take(given)
            out = vector_rows(len(self._results), self._size)
            self._run(out)
            rows = held(out, self._size)
        return dict(zip(self._results, rows, strict=True))

    def rows(self, **given: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Results in their order, (number of results, n); the next call overwrites them."""
        self._take(given)
        self._run(self._outputs)
        return self._found

    def _take(self, given: Arrays) -> None:
        """Arguments to their rows, which are the same in every call."""
        if self._kernel is None:
            self._compile(tuple(given))
        if tuple(given) != self._names:
            raise TypeError(f"arguments {[*given]}, expected {[*self._names]} as on the first call")
        for row, values in zip(self._given, given.values(), strict=True):
            row[...] = values

    def _run(self, out: Any) -> None:
        assert self._kernel is not None
        serial = self._size <= SERIAL_UP_TO
        self._kernel(serial, 1, self._shared, self._constants, self._inputs, out)

    def _compile(self, names: tuple[str, ...]) -> None:
        record = _Record(self._size)
        given = {name: record.entry(f"given[{row}, i]") for row, name in enumerate(names)}
        results = {name: record.lift(x) for name, x in self._stage(**given).items()}
        self._names, self._results = names, tuple(results)
        self._shared = np.array([*record.shared, 0.0])
        constants = record.constants or [np.zeros(self._size)]
        self._constants, self._inputs, self._outputs = (
            vector_rows(len(x), self._size) for x in (constants, names, results)
        )
        for rows in (self._constants, self._inputs):
            rows[:] = 0.0
        held(self._constants, self._size)[:] = constants
        self._given = list(held(self._inputs, self._size))
        self._found: npt.NDArray[np.float64] = held(self._outputs, self._size)
        source = _source(record.lines(list(results.values())))
        self._kernel = BoundKernel(_kernel(source), templates=1)


class Recorded(NDArrayOperatorsMixin):
    """A quantity of a stage; what is done to it is written down, not done."""

    def __init__(self, record: "_Record", at: int, truth: bool) -> None:
        self.record, self.at, self.truth = record, at, truth

    def __array_ufunc__(self, ufunc: Any, method: str, *given: Any, **more: Any) -> "Recorded":
        if method != "__call__" or more:
            raise TypeError(f"{ufunc.__name__}: only plain calls can be compiled")
        if ufunc is np.power:
            return _power(self.record.lift(given[0]), given[1])
        if ufunc is np.rint:
            return _rint(self.record.lift(given[0]))
        if ufunc in _NUMBERS:
            return self.record.operation(_NUMBERS[ufunc], given)
        if ufunc in _COMPARISONS:
            return self.record.operation(_COMPARISONS[ufunc], given, truth=True)
        if ufunc in _LOGIC:
            return self.record.operation(_LOGIC[ufunc], given, of_truths=len(given), truth=True)
        raise TypeError(f"{ufunc.__name__}: cannot be compiled")

    def __array_function__(
        self, function: Any, types: Any, given: tuple[Any, ...], more: dict[str, Any]
    ) -> Any:
        if function is np.where and len(given) == 3:
            return self.record.operation("ti.select({}, {}, {})", given, of_truths=1)
        if function is np.clip and len(given) == 3:
            return np.minimum(np.maximum(given[0], given[1]), given[2])
        if function is np.round and len(given) == 2:
            scale = 10.0 ** given[1]
            return np.rint(given[0] * scale) / scale
        if function is np.broadcast_arrays:
            return given
        raise TypeError(f"{function.__name__}: cannot be compiled")

    def __bool__(self) -> bool:
        raise TypeError("a compiled stage cannot branch on values; use np.where")


class _Record:
    """What a stage does, each different operation once."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._operations: dict[tuple[str, tuple[int, ...]], int] = {}
        self._known: dict[int, tuple[str, Any]] = {}
        """Text that reads a constant, and the constant, by its identity."""
        self.shared: list[float] = []
        """Constants that are the same for all entries, which need not be read for each."""
        self.constants: list[Any] = []

    def entry(self, text: str, *, of: tuple[int, ...] = (), truth: bool = False) -> Recorded:
        at = self._operations.setdefault((text, of), len(self._operations))
        return Recorded(self, at, truth)

    def operation(
        self, text: str, given: tuple[Any, ...], *, of_truths: int = 0, truth: bool = False
    ) -> Recorded:
        """An operation on quantities, the first ``of_truths`` of which are true or false."""
        quantities = [self.lift(x) for x in given]
        if [x.truth for x in quantities] != [i < of_truths for i in range(len(given))]:
            raise TypeError(f"{text}: truth values cannot be mixed with numbers; use np.where")
        return self.entry(text, of=tuple(x.at for x in quantities), truth=truth)

    def lift(self, value: Any) -> Recorded:
        """A quantity, from a number or an array that is constant."""
        if isinstance(value, Recorded):
            return value
        array = np.asarray(value)
        if array.ndim == 0:
            if array.dtype == np.bool_ or not np.isfinite(array):
                raise TypeError(f"{value}: only finite numbers can be compiled")
            # Literals without a type would be rounded to f32.
            return self.entry(f"zeros + ti.f64({float(array)!r})")
        if array.shape != (self._size,):
            raise TypeError(f"constant of shape {array.shape}, expected ({self._size},)")
        if id(value) not in self._known:
            if np.all(array == array[0]):
                text = f"zeros + shared[{len(self.shared)}]"
                self.shared.append(float(array[0]))
            else:
                text = f"constants[{len(self.constants)}, i]"
                self.constants.append(value)
            self._known[id(value)] = text, value
        read = self.entry(self._known[id(value)][0])
        return read > 0.5 if array.dtype == np.bool_ else read

    def lines(self, results: list[Recorded]) -> list[str]:
        """Statements that compute the results and store them, without what none of them needs.

        What is used once stands where it is used, since Taichi is slow at statements.
        """
        known = list(self._operations)
        needed: set[int] = set()
        open_ends = [result.at for result in results]
        while open_ends:
            at = open_ends.pop()
            if at not in needed:
                needed.add(at)
                open_ends += known[at][1]
        uses = Counter(x for at in needed for x in known[at][1])
        body: list[str] = []
        names: dict[int, str] = {}
        for at in sorted(needed):
            text, of = known[at]
            text = text.format(*(names[x] for x in of))
            names[at] = f"v{at}"
            if uses[at] == 1 and len(text) < _LONGEST_TERM:
                names[at] = f"({text})"
            else:
                body.append(f"v{at} = {text}")
        return body + [f"out[{row}, i] = {names[x.at]}" for row, x in enumerate(results)]


def _power(base: Recorded, exponent: Any) -> Recorded:
    if isinstance(exponent, Recorded) or np.ndim(exponent) or float(exponent) % 1.0 or not exponent:
        raise TypeError(f"power {exponent}: only whole numbers other than 0 can be compiled")
    out = base
    for _ in range(abs(int(exponent)) - 1):
        out = out * base
    return out if exponent > 0 else 1.0 / out


def _rint(x: Recorded) -> Recorded:
    """The nearest whole number, the even one of two, as NumPy has it."""
    up = np.floor(x + 0.5)
    tie = (up - x == 0.5) & (up - 2.0 * np.floor(0.5 * up) == 1.0)
    rounded: Recorded = np.where(tie, up - 1.0, up)
    return rounded


def _source(body: list[str]) -> str:
    """A kernel that does these statements for every vector i.

    It goes on by a step of 1 that compilers cannot know: they would make copies of the body, for
    two thirds of the machine code of a short one, and nothing gained.
    """
    head = (
        "@kernel\n"
        "def stage(serial: ti.template(), step: ti.i32, shared: Reals, constants: Rows,\n"
        "          given: Rows, out: Rows):\n"
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


@func
@no_type_check
def _minus(a):
    return a * ti.f64(-1.0)


@cache
def _kernel(source: str) -> Any:
    """The Taichi kernel of this source, compiled once for all fleets whose stages are the same."""
    # Taichi reads the source of a kernel by the name of its file.
    name = f"<stage {sha256(source.encode()).hexdigest()}>"
    linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)
    scope = {
        "ti": ti,
        "kernel": kernel,
        "Reals": ti.types.ndarray(dtype=ti.f64, ndim=1),
        "Rows": ti.types.ndarray(dtype=ti.types.vector(F64_LANES, ti.f64), ndim=2),
        "larger": larger,
        "smaller": smaller,
        "minus": _minus,
        "exp_of": log_and_exp("f64", F64_LANES)[1],
        "__name__": __name__,
    }
    exec(compile(source, name, "exec"), scope)
    return scope["stage"]
