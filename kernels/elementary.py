"""Logarithm and exponential of vectors of the processor.

Taichi has them for single numbers, as calls that take four to ten times as long per lane. Both are
series without branches, the same for all lanes, so that results never depend on a lane's
neighbours. Both err by at most three units in the last digit.
"""

from functools import cache
from math import factorial, log
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import larger, smaller

_FORMATS = {"f32": (23, 127), "f64": (52, 1023)}
"""Bits of the fraction, and bias of the exponent (IEEE 754)."""
_LOG_TERMS = {"f32": 5, "f64": 11}
"""Terms of the logarithm; the first left out is less than a quarter of the sum's last digit."""
_EXP_TERMS = {"f32": 8, "f64": 14}
"""Terms of the exponential; the first left out is less than a quarter of the sum's last digit."""
_LOG_2 = log(2.0)
_LOG_2_HIGH, _LOG_2_LOW = 355.0 / 512.0, -2.121944400546905827679e-4
"""Log 2 as a sum of two (Cody and Waite 1980); the first has few bits, so that its products with
whole numbers are exact."""


@cache
def log_and_exp(precision: str, lanes: int) -> tuple[Any, Any]:
    """Taichi functions of a vector, (lanes,): its natural logarithm, and its exponential.

    Both stay within normal numbers: the logarithm of 0 is that of the smallest, and x times a power
    of x is 0 where x is.
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
        """Logarithm of 2^e m with m in [3/4, 3/2); log m = 2 atanh((m - 1) / (m + 1))."""
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
        """Exponential of k log 2 + r with r at most half of log 2."""
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
