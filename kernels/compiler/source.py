"""Kernels whose source is made at run time."""

import linecache
from collections.abc import Mapping
from typing import Any


def define(name: str, source: str, file: str, scope: Mapping[str, Any]) -> Any:
    """Define a function from its source, and keep the source where Taichi looks for it.

    Args:
        name: of the function in the source.
        source: Python source of the function with its decorators.
        file: name that stands for the source in messages, different for each source.
        scope: globals of the function.

    Returns:
        The function.
    """
    # Taichi reads the source of a kernel by the name of its file, as `inspect` does.
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    names = dict(scope)
    exec(compile(source, file, "exec"), names)
    return names[name]
