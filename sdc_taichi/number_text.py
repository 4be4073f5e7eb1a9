"""Numbers that users write: plain decimal ones in ASCII, as in every file format read here.

Python's own ``float`` and ``int`` also read ``1_000``, ``infinity`` and the digits of other
scripts, and ``str.isdigit`` is true of ``²``, which neither of them reads.
"""

from __future__ import annotations

import math
import re

from sdc_taichi.errors import shortened

MOST_DIGITS = 300
"""Largest number of digits of a whole number; a float holds as many."""
_WHOLE = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def parse_number(text: str) -> float:
    """A finite number of its decimal text, blanks around it left out.

    Raises:
        ValueError: the text is no number, or one that is beyond the range of a float.
    """
    value = float(text) if _NUMBER.fullmatch(text.strip()) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{shortened(text)} is no finite decimal number")
    return value


def parse_whole(text: str) -> int:
    """A whole number of its decimal text, blanks around it left out.

    Raises:
        ValueError: the text is no whole number, or has over 300 digits.
    """
    if not _WHOLE.fullmatch(text.strip()):
        raise ValueError(f"{shortened(text)} is no whole number")
    if len(text) > MOST_DIGITS:
        raise ValueError(f"{shortened(text)} has over {MOST_DIGITS} digits")
    return int(text)
