"""Exponential decay of vectors: (1 - exp(-x)) / x to the last digits of small x.

A difference from ``elementary``'s exponential would lose them.
"""

from math import factorial
from typing import no_type_check

import taichi as ti

FIT_END = 5
"""Of the constants, the first after those of the outlet fit."""
SERIES_TO = 0.25
SERIES_TERMS = {"f32": 6, "f64": 12}
"""Terms of the series of (1 - exp(-x)) / x that give the last digit up to there; an even number."""
MOST_DOUBLINGS = 60
"""Of larger x; what lasts longer is at its end."""


def decay_constants(precision: str) -> list[float]:
    """Series of (1 - exp(-x)) / x, highest power first."""
    return [(-1.0) ** k / factorial(k + 1) for k in reversed(range(SERIES_TERMS[precision]))]


@ti.func
@no_type_check
def doublings(hall: ti.template(), most):
    """How often ``most`` is halved to be where the series holds."""
    count = 0
    while most > hall.real(SERIES_TO) and count < MOST_DOUBLINGS:
        most *= hall.real(0.5)
        count += 1
    return count


@ti.func
@no_type_check
def halved(hall: ti.template(), times):
    """0.5 to so many times."""
    x, time = hall.real(1.0), 0
    while time < times:
        x *= hall.real(0.5)
        time += hall.step
    return x


@ti.func
@no_type_check
def gone_per(hall: ti.template(), y, times):
    """(1 - exp(-x)) / y, where y >= 0 doubled so many times is x.

    By the series of its mean, and doubled again. To the last digits of small x too, whose
    differences large capacities multiply.
    """
    # Terms in pairs, since each addition waits for the one before.
    square = y * y
    gone = y * hall.constants[FIT_END] + hall.constants[FIT_END + 1]
    for i in ti.static(range(FIT_END + 2, FIT_END + hall.series_terms, 2)):
        gone = gone * square + (y * hall.constants[i] + hall.constants[i + 1])
    time = 0
    while time < times:
        gone *= hall.real(2.0) - y * gone
        time += hall.step
    return gone
