"""Logarithm and exponential of SIMD vectors.

Taichi has both functions for scalars only, as calls that take four to ten times as long per lane.
The functions here sum a series without branches. All lanes do the same operations, so a result
never depends on neighbouring lanes. The error is at most three units in the last digit.
"""

from functools import cache
from math import factorial, log
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import larger, smaller

_FORMATS = {"f32": (23, 127), "f64": (52, 1023)}
"""Number of fraction bits, and bias of the exponent, of each IEEE 754 format."""
_LOG_TERMS = {"f32": 5, "f64": 11}
"""Terms of the logarithm; the first omitted term is below a quarter of the sum's last digit."""
_EXP_TERMS = {"f32": 8, "f64": 14}
"""Terms of the exponential; the first omitted term is below a quarter of the sum's last digit."""
_LOG_2 = log(2.0)
_LOG_2_HIGH, _LOG_2_LOW = 355.0 / 512.0, -2.121944400546905827679e-4
"""Logarithm of 2 as the sum of a high and a low part (Cody and Waite 1980). The high part has few
bits, so its products with whole numbers are exact."""


@cache
def log_and_exp(precision: str, lanes: int) -> tuple[Any, Any]:
    """Return Taichi functions for the natural logarithm and the exponential of vectors (lanes,).

    Both avoid subnormal numbers, infinities and NaN: the logarithm of 0 is that of the smallest
    normal number, so x times a power of x is 0 for x = 0.
    """
    real, whole = {"f32": (ti.f32, ti.i32), "f64": (ti.f64, ti.i64)}[precision]
    fraction_bits, bias = _FORMATS[precision]
    log_series = [2.0 / (2 * n + 1) for n in reversed(range(_LOG_TERMS[precision]))]
    exp_series = [1.0 / factorial(n) for n in reversed(range(_EXP_TERMS[precision]))]
    three_quarters = (2 * bias - 1) << (fraction_bits - 1)

    @ti.func
    @no_type_check
    def with_bits(bits):
        out = ti.Vector([ti.cast(0.0, real)] * lanes)
        for i in range(lanes):
            out[i] = ti.bit_cast(bits[i], real)
        return out

    @ti.func
    @no_type_check
    def log_of(x):
        """Return log(2^e m) for m in [3/4, 3/2), by log m = 2 atanh((m - 1) / (m + 1))."""
        normal = larger(x, ti.Vector([real(2.0 ** (1 - bias))] * lanes))
        bits = ti.Vector([ti.cast(0, whole)] * lanes)
        for i in range(lanes):
            bits[i] = ti.bit_cast(normal[i], whole)
        e = (bits - whole(three_quarters)) >> whole(fraction_bits)
        m = with_bits(bits - (e << whole(fraction_bits)))
        exponent = x
        for i in range(lanes):
            exponent[i] = ti.cast(e[i], real)
        z = (m - real(1.0)) / (m + real(1.0))
        square = z * z
        series = square * real(log_series[0]) + real(log_series[1])
        for n in ti.static(range(2, len(log_series))):
            series = series * square + real(log_series[n])
        return z * series + exponent * real(_LOG_2)

    @ti.func
    @no_type_check
    def exp_of(x):
        """Return exp(k log 2 + r), with whole k and r at most half of log 2 in magnitude."""
        low = ti.Vector([real((1.5 - bias) * _LOG_2)] * lanes)
        high = ti.Vector([real(bias * _LOG_2)] * lanes)
        within = smaller(larger(x, low), high)
        k = ti.floor(within * real(1.0 / _LOG_2) + real(0.5))
        r = (within - k * real(_LOG_2_HIGH)) - k * real(_LOG_2_LOW)
        series = r * real(exp_series[0]) + real(exp_series[1])
        for n in ti.static(range(2, len(exp_series))):
            series = series * r + real(exp_series[n])
        power = ti.Vector([ti.cast(0, whole)] * lanes)
        for i in range(lanes):
            power[i] = ti.cast(k[i], whole)
        return series * with_bits((power + whole(bias)) << whole(fraction_bits))

    return log_of, exp_of
