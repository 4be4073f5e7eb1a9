"""Errors a user can cause; every message names the place, the value and what would be valid.

What a user should know while the work continues is an ``SdcWarning``.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from numbers import Integral

MOST_CHARACTERS = 800
"""Length of the longest message; the middle of a longer one is left out."""


def printable(text: object) -> str:
    """Text that is safe to print: control characters, which a terminal obeys, are escaped.

    So are characters that change the direction of writing, and other invisible ones.

    Args:
        text: what is to be printed, such as the name of a file.
    """
    whole = str(text)
    if whole.isprintable():
        return whole
    return "".join(
        c if c.isprintable() or c == "\u00a0" else c.encode("unicode_escape").decode()
        for c in whole
    )


def one_line(text: str) -> str:
    """Text of a message on one line of bounded length that is safe to print."""
    line = printable(" ".join(text.split()))
    if len(line) > MOST_CHARACTERS:
        half = MOST_CHARACTERS // 2
        line = f"{line[:half]} ... {line[-half:]}"
    return line


class SdcError(ValueError):
    """Base of all errors caused by input; the command line prints them without a traceback.

    Args:
        message: place, value, and what would be valid, which ``one_line`` shortens; or an error,
            from which Gymnasium rebuilds errors of worker processes.
    """

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


class ConfigError(SdcError):
    """A configuration, preset or override is not valid."""


class DataError(SdcError):
    """A weather, carbon or workload file or series is not valid."""


class PhysicalLimitError(SdcError):
    """A result is beyond what any data center can reach, which points to a meaningless input."""


class RuntimeStateError(SdcError):
    """The simulator was used in a state that cannot work (closed, forked, not reset)."""


class SdcWarning(UserWarning):
    """Base of all warnings of the package; the command line prints each as one line."""


class OddInputWarning(SdcWarning):
    """An input is possible, but probably not what was meant."""


def whole_number(what: str, value: object, low: int, high: int) -> int:
    """A whole number of Python or NumPy that was given as an argument.

    Args:
        what: name of the argument, for the message.
        value: what was given.
        low: least valid value.
        high: largest valid value.

    Raises:
        ConfigError: no whole number, or one out of bounds.
    """
    # NumPy's whole numbers are registered as integral.
    if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
        raise ConfigError(
            f"{what} {shortened(value)}: valid is a whole number of {low:,}..{high:,}"
        )
    return int(value)


def shortened(value: object, most: int = 80) -> str:
    """A value as messages quote it, cut to a number of characters.

    Args:
        value: any value; its ``repr`` is quoted.
        most: number of characters after which it is cut.
    """
    text = repr(value[: most + 1] if isinstance(value, str | bytes | list | tuple) else value)
    return text if len(text) <= most else text[:most] + "…"


def similar_names(name: object, valid: Iterable[str], most: int = 1) -> list[str]:
    """Valid names that a misspelt ``name`` may have meant, the most similar first.

    Args:
        name: what was given; compared without regard to case.
        valid: the names to choose from.
        most: at most this many are returned.
    """
    by_folded = {x.casefold(): x for x in valid}
    near = difflib.get_close_matches(str(name).strip().casefold(), by_folded, most, cutoff=0.5)
    return [by_folded[x] for x in near]


def suggestion(name: object, valid: Iterable[str], text: str = "; did you mean {!r}?") -> str:
    """End of a message about an unknown name: the most similar valid name.

    Args:
        name: what was given.
        valid: the names to choose from.
        text: format of the suggestion, with one placeholder for the name.

    Returns:
        The text; empty if no valid name is similar.
    """
    near = similar_names(name, valid)
    return text.format(near[0]) if near else ""


def suggestion_or_valid(name: object, valid: Iterable[str]) -> str:
    """End of a message about an unknown name: the most similar valid name, or all valid names."""
    names = list(valid)
    return suggestion(name, names) or f"; valid: {', '.join(names)}"
