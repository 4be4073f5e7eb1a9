"""Logarithm and exponential of vectors against NumPy."""

from typing import Any, no_type_check

import numpy as np
import pytest

from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.types import F64

LANES = 8


def of_vectors(precision: str, which: int, x: F64) -> Any:
    """Logarithms (0) or exponentials (1) of (n, LANES), as kernels compute them."""
    runtime.ensure_started()
    import taichi as ti

    from sdc_taichi.kernels.compiler.arrays import aligned
    from sdc_taichi.kernels.compiler.launch import BoundKernel
    from sdc_taichi.kernels.elementary import log_and_exp

    real = {"f32": ti.f32, "f64": ti.f64}[precision]
    vectors = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=1)
    function = log_and_exp(precision, LANES)[which]

    @ti.kernel
    @no_type_check
    def each(given: vectors, out: vectors):
        for i in range(out.shape[0]):
            out[i] = function(given[i])

    given, out = (aligned(x.shape, np.dtype(precision.replace("f", "float"))) for _ in range(2))
    given[:] = x
    BoundKernel(each, templates=0)(given, out)
    return given, out


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_logarithm_and_exponential_to_the_last_digits(precision: str) -> None:
    rng = np.random.default_rng(5)
    spread = np.stack([10.0 ** rng.uniform(-30, 30, LANES), rng.uniform(0.5, 2.0, LANES)] * 500)
    for which, x, numpys in ((0, spread, np.log), (1, np.log(spread), np.exp)):
        given, found = of_vectors(precision, which, x)
        expected = numpys(given.astype(np.longdouble))
        last_digit = np.spacing(np.abs(expected).astype(given.dtype))
        assert np.max(np.abs(found - expected) / last_digit) < 3.0


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_at_the_ends_of_their_range(precision: str) -> None:
    x = np.array([[0.0, 1.0, 1e-37, 1e37] * 2])
    logarithm = of_vectors(precision, 0, x)[1][0]
    assert logarithm[1] == 0.0
    assert np.all(np.isfinite(logarithm))
    assert logarithm[0] < -87.0
    exponential = of_vectors(precision, 1, np.array([[0.0, -1e4, 1e4, 1.0] * 2]))[1][0]
    assert exponential[0] == 1.0
    assert 0.0 < exponential[1] < 1e-37
    assert np.isfinite(exponential[2])
