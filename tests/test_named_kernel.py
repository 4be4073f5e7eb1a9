"""Kernels defined from a spec of their arguments and called by name."""

from typing import Any, no_type_check

import numpy as np
import pytest

from sdc_taichi.kernels.arguments import Argument, in_row_order, row_index
from sdc_taichi.kernels.compiler import runtime

LANES = 8
ROWS = {"given": "what is doubled", "doubled": "twice as much"}
SPEC = {
    "serial": Argument("template"),
    "slices": Argument("i32"),
    "factor": Argument("real"),
    "item_rows": Argument("real", 2, LANES, ROWS, "items"),
    "shifts": Argument("f64", 1),
}


@pytest.fixture(scope="module")
def kernel() -> Any:
    runtime.ensure_started()
    import taichi as ti

    from sdc_taichi.kernels.compiler.named_kernel import define_kernel

    @ti.func
    @no_type_check
    def run_slice(hall: ti.template(), slice_at):
        for i in range(hall.item_rows.shape[1]):
            item = hall.items[i]
            shift = ti.cast(hall.shifts[0], hall.real)
            item.doubled = item.given * hall.factor + hall.zeros + shift

    return define_kernel("double", SPEC, run_slice, precision="f32", lanes=LANES)


@pytest.fixture
def values() -> dict[str, Any]:
    from sdc_taichi.kernels.compiler.arrays import aligned

    rows = aligned((2, 3, LANES), np.float32)
    rows[:] = np.arange(rows.size, dtype=np.float32).reshape(rows.shape)
    return {"serial": True, "slices": 1, "factor": 2.0, "item_rows": rows, "shifts": np.ones(1)}


def named(kernel: Any) -> Any:
    from sdc_taichi.kernels.compiler.named_kernel import NamedKernel

    return NamedKernel(kernel, SPEC)


def test_arguments_stay_until_they_are_given_again(kernel: Any, values: dict[str, Any]) -> None:
    double, rows = named(kernel), values["item_rows"]
    given, doubled = (rows[row_index(ROWS, name)] for name in ROWS)
    double.bind(**values)
    double()
    assert np.array_equal(doubled, 2.0 * given + 1.0)
    double(shifts=np.array([-3.0]))
    assert np.array_equal(doubled, 2.0 * given - 3.0)
    double()
    assert np.array_equal(doubled, 2.0 * given - 3.0)


def test_misspelt_and_missing_names_are_errors(kernel: Any, values: dict[str, Any]) -> None:
    double = named(kernel)
    with pytest.raises(TypeError, match=r"unknown arguments shift$"):
        double.bind(shift=np.ones(1))
    del values["shifts"]
    with pytest.raises(TypeError, match=r"missing arguments shifts$"):
        double(**values)
    with pytest.raises(ValueError, match=r"missing \['doubled'\], unknown \['double'\]"):
        in_row_order(ROWS, {"given": 1, "double": 2})
