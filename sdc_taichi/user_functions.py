"""Lookup of user-defined functions, by a registered name or by an import path."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.types import F64


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


def function_named(option: str, value: Any, registered: dict[str, Any], *, valid: str) -> Any:
    """Return the function with a registered name or with an import path ``module:name``.

    Args:
        option: name of the option, for error messages.
        value: value of the option: a registered name or an import path.
        registered: registered functions by name.
        valid: other valid values of the option, for error messages.

    Raises:
        ConfigError: the name is unknown, or the import path leads to no function.
    """
    module, _, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    if isinstance(value, str) and value in registered:
        return registered[value]
    if not module or not name or module.startswith("."):
        raise ConfigError(
            f"{option} {shortened(value)}: unknown; valid: {valid}, a function, or its import path "
            "module:name"
        )
    try:
        function = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{option} {shortened(value)}: cannot be imported ({error})") from None
    if not callable(function):
        raise ConfigError(
            f"{option} {shortened(value)}: is a {type(function).__name__}; valid is a function"
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
