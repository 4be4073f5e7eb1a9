"""Cache of optima on disk, with one file for each data center."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sdc_taichi.atomic_file import ClaimedFileError
from sdc_taichi.errors import SdcError, SdcWarning, printable
from sdc_taichi.optimum.problem import Ends
from sdc_taichi.sim import snapshot
from sdc_taichi.types import F64

_X = TypeVar("_X")
METHOD = 1
"""Version of the solution method. Cached files of other versions are not used."""
_TEXT = ("fingerprint", "alone", "kind", "failures", "certificate")


class OptimumCacheWarning(SdcWarning):
    """Warning that a cached optimum cannot be read, or that an optimum cannot be cached."""


@dataclass(frozen=True, slots=True)
class Entry:
    """Cached optimum of one data center for a run of T steps.

    Figures are values of the objective; smaller figures are better.
    """

    idle: float
    """Figure under idle commands."""
    idle_dropped_tasks: float
    """Work that is dropped because the queue is full under idle commands, in tasks."""
    bound: float
    """Lower bound of the figure; nan if there is none."""
    achieved: float
    """Lowest figure of the simulated plans that satisfy the constraints."""
    alone: Mapping[str, float]
    """Lowest figure of simulated plans that move one agent alone, by agent."""
    kind: str
    """Kind of the bound: ``bound``, or ``estimate: `` or ``none: `` followed by the reason."""
    failures: tuple[str, ...]
    """Constraints that simulated plans break, in words."""
    certificate: Mapping[str, float]
    """Measurements of the simulator for the best plan, by name."""
    load: F64
    """Load commands of the best plan, (T,)."""
    cooling: F64
    """Cooling commands of the best plan, in steps of the setpoint, (T,)."""
    battery: F64
    """Battery commands of the best plan, (T,)."""


def key_of(fingerprint: str, arguments: Mapping[str, Any]) -> str:
    """Return the SHA-256 of everything that determines a cache entry.

    Args:
        fingerprint: Fingerprint of the data center's config, inputs and precision.
        arguments: All other arguments of the optimisation, as values that JSON can represent.
    """
    versions = {name: version(name) for name in ("sdc-taichi", "scipy", "numpy")}
    text = json.dumps([METHOD, versions, fingerprint, arguments], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


class Cache:
    """Reads and writes cached optima, one file per entry.

    A file that is damaged or belongs to other inputs is ignored, and nothing is stored in a folder
    without write permission. Both cases give an ``OptimumCacheWarning``.

    Args:
        folder: Folder of the files; None means ``usual_folder``.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = usual_folder() if folder is None else folder.absolute()

    def find(self, key: str, steps: int) -> Entry | None:
        """Return the entry of a key, or None if there is no usable entry.

        Args:
            key: Key from ``key_of``.
            steps: Number of steps, T.
        """
        return self._read(
            self._path(key), lambda arrays: _from_arrays(arrays, key, steps), "the optimum is"
        )

    def keep(self, key: str, entry: Entry) -> None:
        """Write an entry atomically."""
        self._write(self._path(key), _to_arrays(entry, key))

    def find_ends(self, key: str) -> dict[Ends, float]:
        """Return the cached bounds of a key, by the states at start and end of the run.

        Args:
            key: Key from ``key_of``.
        """

        def figures(arrays: Mapping[str, Any]) -> dict[Ends, float]:
            if str(arrays["fingerprint"]) != key:
                raise ValueError("is of other configs, inputs or options")
            pairs = zip(arrays["ends"].tolist(), arrays["figures"].tolist(), strict=True)
            return {Ends(*map(float, ends)): float(figure) for ends, figure in pairs}

        return self._read(self._path(f"{key}-ends"), figures, "bounds of ends are") or {}

    def keep_ends(self, key: str, figures: Mapping[Ends, float]) -> None:
        """Write bounds atomically, by the states at start and end of the run.

        Args:
            key: Key from ``key_of``.
            figures: Bounds by ``Ends``.
        """
        ends = np.array([astuple(each) for each in figures])
        values = {"fingerprint": key, "ends": ends, "figures": np.array([*figures.values()])}
        self._write(self._path(f"{key}-ends"), values)

    def _read(self, path: Path, parse: Callable[[Mapping[str, Any]], _X], what: str) -> _X | None:
        """Return the content of a file, or None if it is missing or, with a warning, damaged."""
        if not path.is_file():
            return None
        try:
            return parse(snapshot.read(path))
        except (SdcError, ValueError, TypeError, KeyError) as error:
            _warn(f"{printable(path)}: {error}; {what} solved anew")
            return None

    def _write(self, path: Path, values: Mapping[str, Any]) -> None:
        try:
            if not path.is_absolute():  # The user has no home directory.
                raise OSError("no absolute path")
            path.parent.mkdir(parents=True, exist_ok=True)
            snapshot.write(path, values)
        except ClaimedFileError:
            pass  # Another process has solved the same problem and is writing this file.
        except (SdcError, OSError) as error:
            _warn(f"{printable(path.parent)}: optima are not kept ({error})")

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.npz"


def usual_folder() -> Path:
    """Return the default folder of cached optima, inside the user's cache directory."""
    import platformdirs

    return Path(platformdirs.user_cache_dir("sdc-taichi", appauthor=False)) / "optimum"


def _to_arrays(entry: Entry, key: str) -> dict[str, Any]:
    """Convert an entry to arrays by name; text and dictionaries become one JSON string."""
    values = {f.name: getattr(entry, f.name) for f in fields(Entry)} | {"fingerprint": key}
    text = json.dumps({name: values.pop(name) for name in _TEXT}, default=dict)
    return {**values, "text": text}


def _from_arrays(arrays: Mapping[str, Any], key: str, steps: int) -> Entry:
    """Convert the arrays of a file to an entry.

    Raises:
        ValueError, TypeError, KeyError: The arrays are no entry, or belong to another key.
    """
    values: dict[str, Any] = json.loads(str(arrays["text"]))
    if values.pop("fingerprint") != key:
        raise ValueError("is of other configs, inputs or options")
    values["failures"] = tuple(values["failures"])
    for name in ("load", "cooling", "battery"):
        values[name] = arrays[name]
        if values[name].shape != (steps,):
            raise ValueError(f"has no {name} commands of {steps} steps")
    for name in ("idle", "idle_dropped_tasks", "bound", "achieved"):
        values[name] = float(arrays[name])
    return Entry(**values)


def _warn(message: str) -> None:
    warnings.warn(message, OptimumCacheWarning, stacklevel=4)
