"""Traces of NumPy functions: what is done to arrays, written down as statements of a kernel."""

from collections import Counter
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

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
