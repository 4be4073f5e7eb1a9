"""Exponential decay of vectors: phi1 = (1 - exp(-x)) / x, exact to the last digits of small x.

A difference from the exponential of ``elementary.py`` would lose those digits. Larger x are halved
until the series holds, and the result is doubled as often.
"""

from math import factorial
from typing import no_type_check

import taichi as ti

SERIES_TO = 0.25
"""Largest x for which the series is summed."""
SERIES_TERMS = {"f32": 6, "f64": 12}
"""Terms of the series that give the last digit up to SERIES_TO; an even number."""
MOST_HALVINGS = 60
"""Halvings of larger x; a decay that lasts longer is at its end."""


def decay_series(precision: str) -> tuple[float, ...]:
    """Coefficients of the series of (1 - exp(-x)) / x, highest power first."""
    return tuple((-1.0) ** k / factorial(k + 1) for k in reversed(range(SERIES_TERMS[precision])))


@ti.func
@no_type_check
def halvings_for(hall: ti.template(), most):
    """How often ``most``, a number, is halved to be where the series holds."""
    count = 0
    while most > hall.real(SERIES_TO) and count < MOST_HALVINGS:
        most *= hall.real(0.5)
        count += 1
    return count


@ti.func
@no_type_check
def power_of_half(hall: ti.template(), halvings):
    """0.5 to the power ``halvings``."""
    x, i = hall.real(1.0), 0
    while i < halvings:
        x *= hall.real(0.5)
        i += hall.one
    return x


@ti.func
@no_type_check
def phi1(hall: ti.template(), y, halvings):
    """(1 - exp(-x)) / y with x = y * 2^halvings and y >= 0, a vector.

    With 1 - exp(-2a) = (1 - exp(-a)) (2 - (1 - exp(-a))), each halving is undone.
    """
    # Terms in pairs, since each addition waits for the one before.
    square = y * y
    value = y * hall.real(hall.decay_series[0]) + hall.real(hall.decay_series[1])
    for i in ti.static(range(2, len(hall.decay_series), 2)):
        pair = y * hall.real(hall.decay_series[i]) + hall.real(hall.decay_series[i + 1])
        value = value * square + pair
    doubled = 0
    while doubled < halvings:
        value *= hall.real(2.0) - y * value
        doubled += hall.one
    return value
