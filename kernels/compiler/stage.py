"""Compilation of stage functions: a NumPy function becomes one kernel that runs over all entries.

A stage is a plain function whose arrays all have one entry per data center. It is called once with
traced quantities, which record the operations instead of computing them. The record becomes the
source of a kernel. The kernel computes F64_LANES entries at a time as SIMD vectors and stores no
intermediate results. Values that the stage reads from elsewhere than its arguments become
constants. NumPy needs a call and a temporary array per operation; for a hundred operations this
overhead exceeds the arithmetic, unless there are thousands of data centers.
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
"""Maximum number of characters of an expression that is inserted into another expression."""

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
    """A quantity in a traced function, which records operations instead of computing them.

    Args:
        trace: trace to which the quantity belongs.
        at: number of the operation whose result it is.
        truth: True for a truth value, False for a number.
        rows: its row in the inputs, if it is an argument.
    """

    def __init__(self, trace: "Trace", at: int, truth: bool, rows: tuple[int, ...] = ()) -> None:
        self.trace, self.at, self.truth, self.rows = trace, at, truth, rows

    def __array_ufunc__(self, ufunc: Any, method: str, *operands: Any, **more: Any) -> "Traced":
        if method != "__call__" or more:
            raise TypeError(f"{ufunc.__name__}: only plain calls can be compiled")
        if ufunc is np.power:
            return _power(self.trace.lift(operands[0]), operands[1])
        if ufunc is np.rint:
            return _rint(self.trace.lift(operands[0]))
        if ufunc in _NUMBERS:
            return self.trace.operation(_NUMBERS[ufunc], operands)
        if ufunc in _COMPARISONS:
            return self.trace.operation(_COMPARISONS[ufunc], operands, truth=True)
        if ufunc in _LOGIC:
            count = len(operands)
            return self.trace.operation(_LOGIC[ufunc], operands, of_truths=count, truth=True)
        raise TypeError(f"{ufunc.__name__}: cannot be compiled")

    def __array_function__(
        self, function: Any, types: Any, operands: tuple[Any, ...], more: dict[str, Any]
    ) -> Any:
        if function is np.where and len(operands) == 3:
            return self.trace.operation("ti.select({}, {}, {})", operands, of_truths=1)
        if function is np.clip and len(operands) == 3:
            return np.minimum(np.maximum(operands[0], operands[1]), operands[2])
        if function is np.round and len(operands) == 2:
            scale = 10.0 ** operands[1]
            return np.rint(operands[0] * scale) / scale
        if function is np.broadcast_arrays:
            return operands
        raise TypeError(f"{function.__name__}: cannot be compiled")

    def __bool__(self) -> bool:
        raise TypeError("a compiled stage cannot branch on values; use np.where")


class TracedObject:
    """An argument with arrays as attributes, which records those that the function reads.

    Args:
        trace: trace to which the argument belongs.
        value: the object with the arrays.
    """

    def __init__(self, trace: "Trace", value: Any) -> None:
        self._trace, self._value = trace, value
        self.read: dict[str, Traced] = {}
        """Quantities that the function has read, by attribute name."""

    @property
    def rows(self) -> list[int]:
        """Rows of the inputs for the attributes that were read, in the order of reading."""
        return [row for quantity in self.read.values() for row in quantity.rows]

    def __getattr__(self, name: str) -> Traced:
        if name not in self.read:
            value = getattr(self._value, name)
            if not isinstance(value, float | int) and np.shape(value) != (self._trace.size,):
                raise TypeError(
                    f"{name}: only numbers and arrays ({self._trace.size},) can be compiled"
                )
            self.read[name] = self._trace.argument(value)
        return self.read[name]


class Trace:
    """Record of the operations of a function on arrays (n,), without duplicates.

    Args:
        size: number of entries n.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.inputs = 0
        """Number of input arrays: arguments, or attributes of arguments."""
        self._operations: dict[tuple[str, tuple[int, ...]], int] = {}
        self._known: dict[int, tuple[str, Any]] = {}
        """Text that reads a constant, and the constant itself, by the constant's ``id``."""
        self.shared: list[float] = []
        """Constants with one value for all entries, which need not be loaded per entry."""
        self.constants: list[Any] = []
        """Constants with a value per entry, each (n,)."""

    def argument(self, value: Any) -> Any:
        """Return an argument as Traced (for an array or number) or as TracedObject."""
        if not isinstance(value, np.ndarray | float | int):
            return TracedObject(self, value)
        row, self.inputs = self.inputs, self.inputs + 1
        at = self.entry(f"inputs[{row}, i]").at
        return Traced(self, at, truth=False, rows=(row,))

    def entry(self, text: str, *, of: tuple[int, ...] = (), truth: bool = False) -> Traced:
        """Record an operation and return its result.

        Args:
            text: expression of the operation, with ``{}`` for each operand.
            of: numbers of the operations that compute the operands.
            truth: True if the result is a truth value.
        """
        at = self._operations.setdefault((text, of), len(self._operations))
        return Traced(self, at, truth)

    def operation(
        self, text: str, operands: tuple[Any, ...], *, of_truths: int = 0, truth: bool = False
    ) -> Traced:
        """Record an operation on quantities and constants, and return its result.

        Args:
            text: expression of the operation, with ``{}`` for each operand.
            operands: quantities and constants.
            of_truths: number of leading operands that must be truth values.
            truth: True if the result is a truth value.

        Raises:
            TypeError: if an operand is a number instead of a truth value, or the reverse.
        """
        quantities = [self.lift(x) for x in operands]
        if [x.truth for x in quantities] != [i < of_truths for i in range(len(operands))]:
            raise TypeError(f"{text}: truth values cannot be mixed with numbers; use np.where")
        return self.entry(text, of=tuple(x.at for x in quantities), truth=truth)

    def lift(self, value: Any) -> Traced:
        """Return the traced quantity of a number or of a constant array (n,).

        Raises:
            TypeError: if an array has another shape, or a number is not finite.
        """
        if isinstance(value, Traced):
            return value
        array = np.asarray(value)
        if array.ndim == 0:
            if array.dtype == np.bool_ or not np.isfinite(array):
                raise TypeError(f"{value}: only finite numbers can be compiled")
            # A literal without a type would be rounded to f32.
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
        """Return statements that compute and store the results, without unneeded operations.

        A quantity that is used once is inserted into its user, because Taichi translates statements
        slowly.
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
    """Return a power with a whole exponent, as a product."""
    if isinstance(exponent, Traced) or np.ndim(exponent) or float(exponent) % 1.0 or not exponent:
        raise TypeError(f"power {exponent}: only whole numbers other than 0 can be compiled")
    out = base
    for _ in range(abs(int(exponent)) - 1):
        out = out * base
    return out if exponent > 0 else 1.0 / out


def _rint(x: Traced) -> Traced:
    """Round to the nearest whole number, and halves to the even one, like NumPy."""
    up = np.floor(x + 0.5)
    tie = (up - x == 0.5) & (up - 2.0 * np.floor(0.5 * up) == 1.0)
    rounded: Traced = np.where(tie, up - 1.0, up)
    return rounded


Arrays = Mapping[str, Any]

SERIAL_UP_TO = 4096
"""Largest number of entries that one thread computes faster than several threads."""
COPIED_UP_TO = 1024
"""Largest number of entries for which copying the results is faster than passing a new array."""
_TASK_BLOCKS = 32
"""Vectors per task."""


class CompiledStage:
    """A stage function that runs as one kernel.

    Args:
        stage: function with named arguments: arrays (n,), or objects with arrays (n,) as
            attributes. It returns a mapping of names to arrays (n,) or numbers. It may use
            arithmetic, comparisons and the NumPy functions in ``_NUMBERS``. It must not branch on
            values or change its arguments, and it must not use infinities or NaN. Compilation
            determines the attributes that it reads; later calls need no others.
        size: number of entries n.
    """

    def __init__(self, stage: Callable[..., Arrays], size: int) -> None:
        self._stage: Callable[..., Arrays] | None = stage
        self._size = size
        self._kernel: BoundKernel | None = None

    def __call__(self, **inputs: Any) -> dict[str, npt.NDArray[np.float64]]:
        """Compute the results by name, each (n,), as rows of one new array.

        Raises:
            TypeError: if the stage contains an operation that cannot be compiled, or the argument
                names differ from those of the first call.
        """
        self._set_inputs(inputs)
        return self._new_results()

    def rows(self, **inputs: Any) -> npt.NDArray[np.float64]:
        """Compute the results as rows in their order, (results, n); the next call overwrites them.

        Raises:
            TypeError: if the stage contains an operation that cannot be compiled, or the argument
                names differ from those of the first call.
        """
        self._set_inputs(inputs)
        self._run(self._outputs)
        return self._results

    def _set_inputs(self, inputs: Arrays) -> None:
        """Copy arguments to the input rows; their names must be those of the first call."""
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
        """Run the kernel and return the results by name, as rows of one new array."""
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
        """Functions that return the arrays of each argument; empty if all arguments are arrays."""
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
        # If the stage is a method of the owner of this object, keeping it would create a reference
        # cycle. Only the garbage collector frees a cycle, with all arrays that the object holds.
        self._stage = None


def _reader(argument: Any) -> Callable[[Any], Iterable[Any]]:
    """Return a function that yields the arrays of an argument that the stage reads, in order."""
    if not isinstance(argument, TracedObject):
        return lambda array: (array,)
    names = [*argument.read]
    if len(names) > 1:
        return attrgetter(*names)
    return lambda record: [getattr(record, name) for name in names]


def _source(body: list[str]) -> str:
    """Return the source of a kernel that executes these statements for every vector i.

    The step of the innermost loop is an argument that is always 1. With a known step, compilers
    would unroll the loop, which adds two thirds to the machine code of a short body without gain.
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
    """Return the Taichi kernel of a source text; fleets with equal stages share one kernel."""
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
