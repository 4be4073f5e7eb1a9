"""Errors caused by invalid input, and warnings.

Every error message names the place, the value, and what would be valid. An ``SdcWarning`` reports
a problem after which the work continues.
"""

from __future__ import annotations

import difflib
import sysconfig
import traceback
from collections.abc import Iterable
from numbers import Integral
from pathlib import Path

MOST_CHARACTERS = 800
"""Largest length of a message in characters; the middle of a longer one is cut out."""


def printable(text: object) -> str:
    """Return a text that is safe to print on a terminal.

    Control characters, characters that change the direction of writing, and other invisible
    characters are escaped.

    Args:
        text: the text or object to print, such as the name of a file.
    """
    whole = str(text)
    if whole.isprintable():
        return whole
    return "".join(
        c if c.isprintable() or c == "\u00a0" else c.encode("unicode_escape").decode()
        for c in whole
    )


def one_line(text: str) -> str:
    """Return a message as one printable line of at most about ``MOST_CHARACTERS`` characters."""
    line = printable(" ".join(text.split()))
    if len(line) > MOST_CHARACTERS:
        half = MOST_CHARACTERS // 2
        line = f"{line[:half]} ... {line[-half:]}"
    return line


class SdcError(ValueError):
    """Base class of all errors caused by input; commands print them without a traceback.

    Args:
        message: text that names the place, the value and what would be valid, which ``one_line``
            shortens. It may be an exception, because Gymnasium passes one to re-raise an error of
            a worker process.
    """

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


class ConfigError(SdcError):
    """A configuration, preset or override is not valid."""


class DataError(SdcError):
    """A weather, carbon or workload file or series is not valid."""


class PhysicalLimitError(SdcError):
    """A result is physically impossible for a data center, because of a meaningless input."""


class RuntimeStateError(SdcError):
    """The simulator is in a state in which it cannot run: closed, forked, or not reset."""


class SdcWarning(UserWarning):
    """Base class of all warnings of the package; commands print each as one line."""


class OddInputWarning(SdcWarning):
    """An input is valid, but probably not what the user intended."""


def place_in_user_code(error: BaseException) -> str:
    """Return ``FILE:LINE`` of the innermost call of an error in code that the package called.

    Returns:
        The place; empty if the error passed through no function of a user.
    """
    place, in_package = "", False
    library, installed = sysconfig.get_path("stdlib"), {"site-packages", "dist-packages"}
    for frame, line in traceback.walk_tb(error.__traceback__):
        file = frame.f_code.co_filename
        if str(frame.f_globals.get("__name__")).partition(".")[0] == "sdc_taichi":
            in_package = True
        elif in_package and not (
            file.startswith(("<", library)) or installed & {*Path(file).parts}
        ):
            place = f"{file}:{line}"
    return place


def whole_number(what: str, value: object, low: int, high: int) -> int:
    """Check an integer argument, and return it as a Python ``int``.

    Raises:
        ConfigError: the value is not an integer, or out of bounds.
    """
    # NumPy registers its integer types as Integral.
    if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
        raise ConfigError(
            f"{what} {shortened(value)}: valid is a whole number of {low:,}..{high:,}"
        )
    return int(value)


def shortened(value: object, most: int = 80) -> str:
    """Return the ``repr`` of a value for a message, cut to a number of characters."""
    text = repr(value[: most + 1] if isinstance(value, str | bytes | list | tuple) else value)
    return text if len(text) <= most else text[:most] + "…"


def similar_names(name: object, valid: Iterable[str], most: int = 1) -> list[str]:
    """Return valid names that resemble a misspelt name, most similar first.

    Args:
        name: the unknown name; upper and lower case are equal.
        valid: the valid names.
        most: largest number of returned names.
    """
    by_folded = {x.casefold(): x for x in valid}
    near = difflib.get_close_matches(str(name).strip().casefold(), by_folded, most, cutoff=0.5)
    return [by_folded[x] for x in near]


def suggestion(name: object, valid: Iterable[str], text: str = "; did you mean {!r}?") -> str:
    """Return the end of a message about an unknown name, which suggests a similar valid name.

    Args:
        name: the unknown name.
        valid: the valid names.
        text: format of the suggestion, with one placeholder for the name.

    Returns:
        The formatted suggestion; empty if no valid name is similar.
    """
    near = similar_names(name, valid)
    return text.format(near[0]) if near else ""


def suggestion_or_valid(name: object, valid: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: a similar name, or all valid names."""
    names = list(valid)
    return suggestion(name, names) or f"; valid: {', '.join(names)}"
