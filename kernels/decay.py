"""Exponential decay of vectors: phi1 = (1 - exp(-x)) / x, to full precision also for small x.

Subtracting the exponential of ``elementary.py`` from 1 would lose digits for small x. The series
of phi1 is summed instead. A large x is first halved until the series converges; a formula for
doubled arguments then undoes each halving.
"""

from math import factorial
from typing import no_type_check

import taichi as ti

SERIES_TO = 0.25
"""Largest x for which the series is summed directly."""
SERIES_TERMS = {"f32": 6, "f64": 12}
"""Number of series terms (even) that gives full precision for x up to SERIES_TO."""
MOST_HALVINGS = 60
"""Maximum number of halvings of x; a longer decay has practically reached its final value."""


def decay_series(precision: str) -> tuple[float, ...]:
    """Return the coefficients of the series of (1 - exp(-x)) / x, highest power first."""
    return tuple((-1.0) ** k / factorial(k + 1) for k in reversed(range(SERIES_TERMS[precision])))


@ti.func
@no_type_check
def halvings_for(hall: ti.template(), most):
    """Return how many halvings bring the scalar ``most`` down to SERIES_TO or less."""
    count = 0
    while most > hall.real(SERIES_TO) and count < MOST_HALVINGS:
        most *= hall.real(0.5)
        count += 1
    return count


@ti.func
@no_type_check
def power_of_half(hall: ti.template(), halvings):
    """Return 0.5 to the power ``halvings``."""
    x, i = hall.real(1.0), 0
    while i < halvings:
        x *= hall.real(0.5)
        i += hall.one
    return x


@ti.func
@no_type_check
def phi1(hall: ti.template(), y, halvings):
    """Return (1 - exp(-x)) / y for a vector y >= 0, with x = y * 2^halvings.

    Each halving is undone by 1 - exp(-2a) = (1 - exp(-a)) (2 - (1 - exp(-a))).
    """
    # Sum the terms in pairs: it shortens the chain of dependent additions.
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
