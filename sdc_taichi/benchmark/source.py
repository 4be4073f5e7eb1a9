"""Digest of the source files of the package, which tells results of other code apart."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_FOLDERS = ("", "configs", "data", "kernels", "viz")
_SUFFIXES = (".py", ".yaml", ".csv", ".json")


@cache
def source_digest() -> str:
    """SHA-256 of names and content of the package's source files, equal wherever it is installed.

    A result keeps it beside the version, which many states of the source share.
    """
    digest = hashlib.sha256()
    for name, path in sorted(_source_files().items()):
        content = path.read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def _source_files() -> dict[str, Path]:
    """Source files by their path in an installed package."""
    found = {}
    for folder in _FOLDERS:
        spec = find_spec(f"sdc_taichi.{folder}".rstrip("."))
        for root in (spec and spec.submodule_search_locations) or ():
            for path in Path(root).rglob("*"):
                if path.suffix in _SUFFIXES and "__pycache__" not in path.parts:
                    found[str(Path(folder, path.relative_to(root)).as_posix())] = path
    return found
