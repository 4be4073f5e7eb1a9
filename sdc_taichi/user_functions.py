"""Functions of the user by name: registered ones, and those with an import path."""

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
    """Make a function available by a name.

    A function replaces an earlier one of the same module and name, as when a cell of a notebook is
    run again.

    Args:
        kind: what the function is, for errors.
        name: an identifier that no other function has.
        function: the function.
        registered: functions by name, to which it is added.
        reserved: names that no function may have.

    Raises:
        ConfigError: a name that another function has, or no function.
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
    """A registered function, or one by its import path ``module:name``.

    Args:
        option: name of the option, for errors.
        value: value of the option.
        registered: functions by name.
        valid: what the option takes besides functions and their import paths, for errors.

    Raises:
        ConfigError: an unknown name, or a path without a function.
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
    """Module and name of a function, or of the class of another callable."""
    named = function if hasattr(function, "__qualname__") else type(function)
    return f"{named.__module__}:{named.__qualname__}"


def checked_values(what: str, returned: Any, whose: str, size: int) -> F64:
    """Values that a user's function returned, checked, (B,).

    Args:
        what: what the function is, for errors.
        returned: what it returned.
        whose: for which data centers it returned them, for errors.
        size: number of data centers, B.

    Raises:
        SdcError: values that are no numbers, not finite, or of another shape.
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
    """Whether a function may have a name: nothing had it before, or the same function did.

    A function counts as the same if its module and name are those of the one before.
    """
    return before is None or import_path(function) == import_path(before)
