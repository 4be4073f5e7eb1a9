"""Lookup of user-defined functions, by a registered name or by an import path.

An import path runs the code that it names, so its origin decides whether it may be resolved. In a
command, the words of the command line may name code, and no other text may, unless the command has
the option ``--allow-code``. In Python, arguments of a call may name code, and files may only if the
function that reads them is called with ``allow_code=True``.
"""

from __future__ import annotations

import contextlib
import importlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sdc_taichi.errors import ConfigError, SdcError, place_in_user_code, shortened
from sdc_taichi.types import F64

OPTIONS = ("controller", "best_of", "others", "rewards", "costs")
"""Names of the options and fields whose values can be import paths."""
_REFUSED = "is an import path, and code that a file names is not run"
_ALLOWED = "--allow-code (in Python allow_code=True) if you trust the file"


class CodePermission(NamedTuple):
    """Import paths that a command may resolve."""

    words: tuple[str, ...]
    """Words of the command line; the import paths in them are permitted."""
    any_code: bool = False
    """True to permit all import paths, as ``--allow-code`` does."""


_permission: CodePermission | None = None
"""Permission of the command that this process runs; None outside of commands."""


def code_permission() -> CodePermission | None:
    """Return the permission of the command that this process runs; None outside of commands."""
    return _permission


def set_code_permission(permission: CodePermission | None) -> None:
    """Set the permission of this process, such as that of a worker process of a command."""
    global _permission
    _permission = permission


@contextlib.contextmanager
def code_permitted_by(words: Sequence[str]) -> Iterator[None]:
    """Permit only the import paths in the words of a command line, until the block ends."""
    before = _permission
    set_code_permission(CodePermission(tuple(words)))
    try:
        yield
    finally:
        set_code_permission(before)


def check_code(place: str, path: str, *, valid: str, allow_code: bool) -> None:
    """Check that an import path may be resolved, and let commands find it in the current folder.

    Args:
        place: option or field with its value, which begins the error message.
        path: import path ``module:name``.
        valid: valid values besides import paths, for the error message.
        allow_code: True if the path may be resolved outside of commands.

    Raises:
        ConfigError: the path may not be resolved.
    """
    if not (allow_code if _permission is None else _is_permitted(path)):
        raise ConfigError(f"{place}: {_REFUSED}; valid: {valid}, or {_ALLOWED}")
    # The current folder comes last, so that its files cannot hide installed modules.
    if _permission is not None and "" not in sys.path:
        sys.path.append("")


def check_file_names(
    values: Mapping[Any, Any],
    file: object,
    *,
    is_path: Callable[[str], bool],
    allow_code: bool,
) -> None:
    """Check that the ``OPTIONS`` in the values of a file name no code, unless it is permitted.

    Args:
        values: nested values of the file.
        file: path of the file, for the error message.
        is_path: returns True for an import path, and False for a name.
        allow_code: True to check nothing; a command still resolves permitted paths only.

    Raises:
        ConfigError: a value is an import path; the message names the file and the field.
    """
    for field, text in _option_texts("", values):
        for name in map(str.strip, re.split("[,=]", text)):
            path = ":".join(name.split(":")[:2])
            if is_path(name) and not (allow_code or _is_permitted(path)):
                raise ConfigError(
                    f"{file}: {field} {shortened(text)}: {_REFUSED}; valid is a registered name, "
                    f"or {_ALLOWED}"
                )


def _is_permitted(path: str) -> bool:
    """Return True if the command line permits an import path; False outside of commands."""
    if _permission is None:
        return False
    whole = re.compile(rf"(?<![\w.:/]){re.escape(path)}(?![\w./])")
    return _permission.any_code or any(map(whole.search, _permission.words))


def _option_texts(place: str, values: Any) -> Iterator[tuple[str, str]]:
    """Yield the dotted name of each of the ``OPTIONS`` in nested values, with each of its texts."""
    if isinstance(values, list | tuple):
        for each in values:
            yield from _option_texts(place, each)
    if not isinstance(values, Mapping):
        return
    for key, value in values.items():
        name = f"{place}.{key}".lstrip(".")
        if key in OPTIONS:
            # Costs are a text, a list of texts, or a mapping from texts to weights.
            texts = [value] if isinstance(value, str) else value
            if isinstance(texts, list | tuple | Mapping):
                yield from ((name, text) for text in texts if isinstance(text, str))
        yield from _option_texts(name, value)


def register_function(
    kind: str,
    name: str,
    function: Callable[..., Any],
    registered: dict[str, Any],
    *,
    reserved: Sequence[str] = (),
) -> None:
    """Register a function under a name.

    A function replaces a registered one of the same module and name, so that a notebook cell that
    registers a function can run again.

    Args:
        kind: kind of function, such as ``reward``, for error messages.
        name: an identifier that is not the name of another function.
        function: the function.
        registered: registered functions by name, to which the function is added.
        reserved: names that are not allowed.

    Raises:
        ConfigError: the name is invalid or in use, or ``function`` is not callable.
    """
    if not callable(function):
        raise ConfigError(
            f"{kind} {shortened(name)}: is a {type(function).__name__}; valid is a function"
        )
    identifier = isinstance(name, str) and name.isidentifier()
    if not identifier or name in reserved or not is_replacement(registered.get(name), function):
        raise ConfigError(f"{kind} {shortened(name)}: valid is a name that is not taken")
    registered[name] = function


def function_named(option: str, value: Any, registered: Mapping[str, Any], *, valid: str) -> Any:
    """Return the function with a registered name or with an import path ``module:name``.

    Args:
        option: name of the option, for error messages.
        value: value of the option: a registered name or an import path.
        registered: registered functions by name.
        valid: other valid values of the option, for error messages.

    Raises:
        ConfigError: the name is unknown, the import path leads to no function, or it may not be
            resolved.
    """
    module, _, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    if isinstance(value, str) and value in registered:
        return registered[value]
    if not module or not name or module.startswith("."):
        raise ConfigError(
            f"{option} {shortened(value)}: unknown; valid: {valid}, a function, or its import path "
            "module:name"
        )
    check_code(f"{option} {shortened(value)}", value, valid=valid, allow_code=True)
    return imported(option, value)


def imported(option: str, path: str) -> Any:
    """Import the function with an import path ``module:name`` that may be resolved.

    Args:
        option: name of the option, for error messages.
        path: the import path.

    Raises:
        ConfigError: the import path leads to no function.
    """
    module, _, name = path.partition(":")
    try:
        function = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        where = place_in_user_code(error)
        reason = f"{error}, at {where}" if where else f"{error}"
        raise ConfigError(f"{option} {shortened(path)}: cannot be imported ({reason})") from None
    if not callable(function):
        raise ConfigError(
            f"{option} {shortened(path)}: is a {type(function).__name__}; valid is a function"
        )
    return function


def import_path(function: Callable[..., Any]) -> str:
    """Return the import path ``module:name`` of a function, or of a callable object's class."""
    named = function if hasattr(function, "__qualname__") else type(function)
    return f"{named.__module__}:{named.__qualname__}"


def checked_values(what: str, returned: Any, whose: str, size: int) -> F64:
    """Check the values that a user-defined function returned, and return them with shape (B,).

    Args:
        what: name of the function, for error messages.
        returned: value that the function returned: a scalar or an array (B,).
        whose: data centers or agent of the values, such as ``all data centers``, for messages.
        size: number B of data centers.

    Raises:
        SdcError: the values are not numbers, not finite, or of another shape.
    """
    try:
        values = np.asarray(returned, dtype=np.float64)
    except (TypeError, ValueError):
        raise SdcError(
            f"{what}: returned {shortened(returned)} for {whose}; valid is ({size},) of numbers"
        ) from None
    finite = np.isfinite(values)
    if values.shape not in ((), (size,)) or not finite.all():
        odd = "" if finite.all() else f" with {values[~finite].flat[0]}"
        raise SdcError(
            f"{what}: returned {values.dtype} {values.shape}{odd} for {whose}; valid is "
            f"({size},) of finite numbers"
        )
    return np.broadcast_to(values, (size,))


def is_replacement(before: Callable[..., Any] | None, function: Callable[..., Any]) -> bool:
    """Return True if a function may take a name: the name is free, or has the same function.

    Functions with the same module and name count as the same function.

    Args:
        before: function that has the name so far; None if the name is free.
        function: function that is to take the name.
    """
    return before is None or import_path(function) == import_path(before)
