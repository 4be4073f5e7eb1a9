"""Parsers of numbers in the input of users, which accept plain decimal numbers in ASCII only.

They are stricter than Python's ``float`` and ``int``, which also accept ``1_000``, ``infinity`` and
digits of other scripts. ``str.isdigit`` is no substitute, because it is true for ``²``.
"""

from __future__ import annotations

import math
import re

from sdc_taichi.errors import shortened

MOST_DIGITS = 300
"""Largest number of digits of an integer, so that the integer is in the range of a float."""
_WHOLE = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def parse_number(text: str) -> float:
    """Parse a finite decimal number, ignoring surrounding white space.

    Raises:
        ValueError: the text is not a decimal number, or exceeds the range of a float.
    """
    value = float(text) if _NUMBER.fullmatch(text.strip()) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{shortened(text)} is no finite decimal number")
    return value


def parse_whole(text: str) -> int:
    """Parse a decimal integer, ignoring surrounding white space.

    Raises:
        ValueError: the text is not a decimal integer, or has more than ``MOST_DIGITS`` characters.
    """
    if not _WHOLE.fullmatch(text.strip()):
        raise ValueError(f"{shortened(text)} is no whole number")
    if len(text) > MOST_DIGITS:
        raise ValueError(f"{shortened(text)} has over {MOST_DIGITS} digits")
    return int(text)
