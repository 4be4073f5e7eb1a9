"""Stage functions compiled: the same function over arrays, in one pass over its entries.

A stage is a plain function whose arrays all have one entry per data center. It is called once with
quantities that write down what is done to them; from that trace a kernel is made,
which computes F64_LANES entries at a time, as vectors of the processor, and keeps nothing in
between. Whatever the stage reads apart from its arguments is taken as constant. NumPy needs a call
and a temporary per operation, and some hundred of them cost more than the arithmetic unless there
are thousands of data centers.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from hashlib import sha256
from operator import attrgetter
from typing import Any, no_type_check

import numpy as np
import numpy.typing as npt
import taichi as ti
from numpy.lib.mixins import NDArrayOperatorsMixin

from ..elementary import log_and_exp
from .arrays import F64_LANES, unpadded, vector_rows
from .functions import SLICE, larger, smaller
from .launch import BoundKernel
from .named_kernel import define

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


class Traced(NDArrayOperatorsMixin):
    """A quantity of a traced function; what is done to it is written down, not done.

    Args:
        trace: the trace that it belongs to.
        at: number of the operation whose result it is.
        truth: whether it is true or false instead of a number.
        rows: row of the inputs that it is, if it is an argument.
    """

    def __init__(self, trace: "Trace", at: int, truth: bool, rows: tuple[int, ...] = ()) -> None:
        self.trace, self.at, self.truth, self.rows = trace, at, truth, rows

    def __array_ufunc__(self, ufunc: Any, method: str, *given: Any, **more: Any) -> "Traced":
        if method != "__call__" or more:
            raise TypeError(f"{ufunc.__name__}: only plain calls can be compiled")
        if ufunc is np.power:
            return _power(self.trace.lift(given[0]), given[1])
        if ufunc is np.rint:
            return _rint(self.trace.lift(given[0]))
        if ufunc in _NUMBERS:
            return self.trace.operation(_NUMBERS[ufunc], given)
        if ufunc in _COMPARISONS:
            return self.trace.operation(_COMPARISONS[ufunc], given, truth=True)
        if ufunc in _LOGIC:
            return self.trace.operation(_LOGIC[ufunc], given, of_truths=len(given), truth=True)
        raise TypeError(f"{ufunc.__name__}: cannot be compiled")

    def __array_function__(
        self, function: Any, types: Any, given: tuple[Any, ...], more: dict[str, Any]
    ) -> Any:
        if function is np.where and len(given) == 3:
            return self.trace.operation("ti.select({}, {}, {})", given, of_truths=1)
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


class TracedObject:
    """An argument whose arrays are its attributes; those that the function reads are written down.

    Args:
        trace: the trace that it belongs to.
        value: the object.
    """

    def __init__(self, trace: "Trace", value: Any) -> None:
        self._trace, self._value = trace, value
        self.read: dict[str, Traced] = {}
        """Quantities that have been read, by the names of their attributes."""

    @property
    def rows(self) -> list[int]:
        """Rows of the inputs that hold the attributes read, in their order."""
        return [row for quantity in self.read.values() for row in quantity.rows]

    def __getattr__(self, name: str) -> Traced:
        if name not in self.read:
            value = getattr(self._value, name)
            if np.shape(value) != (self._trace.size,):
                raise TypeError(f"{name}: only arrays ({self._trace.size},) can be compiled")
            self.read[name] = self._trace.argument(value)
        return self.read[name]


class Trace:
    """Operations of a function on arrays (n,), each different operation once.

    Args:
        size: n.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.inputs = 0
        """Number of arrays that are arguments, or attributes of them."""
        self._operations: dict[tuple[str, tuple[int, ...]], int] = {}
        self._known: dict[int, tuple[str, Any]] = {}
        """Text that reads a constant, and the constant, by its identity."""
        self.shared: list[float] = []
        """Constants that are the same for all entries, which need not be read for each."""
        self.constants: list[Any] = []
        """Constants that differ between entries, each (n,)."""

    def argument(self, value: Any) -> Any:
        """A quantity in a row of the inputs for an array or number; an object for its arrays."""
        if not isinstance(value, np.ndarray | float | int):
            return TracedObject(self, value)
        row, self.inputs = self.inputs, self.inputs + 1
        at = self.entry(f"inputs[{row}, i]").at
        return Traced(self, at, truth=False, rows=(row,))

    def entry(self, text: str, *, of: tuple[int, ...] = (), truth: bool = False) -> Traced:
        """The result of an operation.

        Args:
            text: expression of the operation, with ``{}`` for each operand.
            of: numbers of the operations whose results are the operands.
            truth: whether the result is true or false.
        """
        at = self._operations.setdefault((text, of), len(self._operations))
        return Traced(self, at, truth)

    def operation(
        self, text: str, given: tuple[Any, ...], *, of_truths: int = 0, truth: bool = False
    ) -> Traced:
        """The result of an operation on quantities and constants.

        Args:
            text: expression of the operation, with ``{}`` for each operand.
            given: operands.
            of_truths: how many of the first operands are true or false.
            truth: whether the result is true or false.

        Raises:
            TypeError: numbers where truth values belong, or the other way round.
        """
        quantities = [self.lift(x) for x in given]
        if [x.truth for x in quantities] != [i < of_truths for i in range(len(given))]:
            raise TypeError(f"{text}: truth values cannot be mixed with numbers; use np.where")
        return self.entry(text, of=tuple(x.at for x in quantities), truth=truth)

    def lift(self, value: Any) -> Traced:
        """The quantity of a number or of an array (n,) that is constant.

        Raises:
            TypeError: an array of another shape, or a number that is not finite.
        """
        if isinstance(value, Traced):
            return value
        array = np.asarray(value)
        if array.ndim == 0:
            if array.dtype == np.bool_ or not np.isfinite(array):
                raise TypeError(f"{value}: only finite numbers can be compiled")
            # Literals without a type would be rounded to f32.
            return self.entry(f"zeros + ti.f64({float(array)!r})")
        if array.shape != (self.size,):
            raise TypeError(f"constant of shape {array.shape}, expected ({self.size},)")
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

    def statements(self, results: list[Traced]) -> list[str]:
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


def _power(base: Traced, exponent: Any) -> Traced:
    """Power of a whole exponent, as products."""
    if isinstance(exponent, Traced) or np.ndim(exponent) or float(exponent) % 1.0 or not exponent:
        raise TypeError(f"power {exponent}: only whole numbers other than 0 can be compiled")
    out = base
    for _ in range(abs(int(exponent)) - 1):
        out = out * base
    return out if exponent > 0 else 1.0 / out


def _rint(x: Traced) -> Traced:
    """The nearest whole number, the even one of two, as NumPy has it."""
    up = np.floor(x + 0.5)
    tie = (up - x == 0.5) & (up - 2.0 * np.floor(0.5 * up) == 1.0)
    rounded: Traced = np.where(tie, up - 1.0, up)
    return rounded


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
            NumPy functions that ``_NUMBERS`` lists, but no branch on values. It never changes its
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
