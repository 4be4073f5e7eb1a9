"""Reading of JSON answers, with errors that name the address and the place."""

from __future__ import annotations

import json
from typing import Any

from sdc_taichi.errors import DataError, shortened


def read_json(content: bytes, url: str) -> dict[str, Any]:
    """The JSON object of an answer.

    Raises:
        DataError: not UTF-8, not JSON, or no object.
    """
    try:
        found = json.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as failed:
        raise DataError(f"{url}: byte {failed.start} is not UTF-8, expected JSON") from None
    except (ValueError, RecursionError):
        start = content[:40].decode("latin-1")
        raise DataError(f"{url}: begins with {shortened(start)}, expected JSON") from None
    if not isinstance(found, dict):
        raise DataError(f"{url}: {type(found).__name__}, expected a JSON object")
    return found


def field(found: Any, url: str, *names: str | int) -> Any:
    """A value within JSON.

    Args:
        found: what was read.
        url: address, for messages.
        names: keys and indices that lead to the value.

    Raises:
        DataError: there is no such value.
    """
    for name in names:
        try:
            found = found[name]
        except (KeyError, IndexError, TypeError):
            path = ".".join(map(str, names))
            raise DataError(f"{url}: no {path}, so the format is not the one known here") from None
    return found


def number(value: Any, url: str, what: str) -> float:
    """A number within JSON, which may be written as text.

    Args:
        value: what was read.
        url: address, for messages.
        what: the field, for messages.

    Raises:
        DataError: no finite number.
    """
    try:
        found = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = float("nan")
    if not abs(found) < float("inf"):
        raise DataError(f"{url}: {what}: {shortened(value)}, expected a number")
    return found
