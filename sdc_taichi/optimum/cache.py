"""Entries of the cache of optima, one file for each data center."""

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
"""Version of how optima are found; files of another one are not read."""
_TEXT = ("fingerprint", "alone", "kind", "failures", "certificate")


class OptimumCacheWarning(SdcWarning):
    """A kept optimum cannot be used or kept."""


@dataclass(frozen=True, slots=True)
class Entry:
    """Optimum of one data center over T steps, as the cache keeps it."""

    idle: float
    """Figure under idle commands."""
    idle_dropped_tasks: float
    """Work that finds the queue full under idle commands, in tasks."""
    bound: float
    """Bound of the figure; nan without one."""
    achieved: float
    """Lowest figure that the simulator reached."""
    alone: Mapping[str, float]
    """Lowest figure reached with one agent alone, by its name."""
    kind: str
    """Kind of the bound: ``bound``, or ``estimate: `` or ``none: `` and why."""
    failures: tuple[str, ...]
    """Certificates that do not hold, in words."""
    certificate: Mapping[str, float]
    """Measurements of the simulator along the achieved path, by name."""
    load: F64
    """Load commands of the achieved path, (T,)."""
    cooling: F64
    """Cooling commands of the achieved path, in steps of the setpoint, (T,)."""
    battery: F64
    """Battery commands of the achieved path, (T,)."""


def key_of(fingerprint: str, arguments: Mapping[str, Any]) -> str:
    """SHA-256 of everything that decides an entry.

    Args:
        fingerprint: Of the data center's config, inputs and precision.
        arguments: Everything else that decides it, as values that JSON can hold.
    """
    versions = {name: version(name) for name in ("sdc-taichi", "scipy", "numpy")}
    text = json.dumps([METHOD, versions, fingerprint, arguments], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


class Cache:
    """Kept entries, one file each, in the folder of the user's caches.

    A file that is damaged or of other inputs is computed anew, and a folder that cannot be written
    keeps nothing, each with an ``OptimumCacheWarning``.

    Args:
        folder: Folder of the files; None is ``usual_folder``.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = usual_folder() if folder is None else folder.absolute()

    def find(self, key: str, steps: int) -> Entry | None:
        """The entry of a key; None where there is none that can be used.

        Args:
            key: Key of ``key_of``.
            steps: Number of steps, T.
        """
        return self._read(
            self._path(key), lambda arrays: _from_arrays(arrays, key, steps), "the optimum is"
        )

    def keep(self, key: str, entry: Entry) -> None:
        """Keep an entry, whole or not at all."""
        self._write(self._path(key), _to_arrays(entry, key))

    def find_ends(self, key: str) -> dict[Ends, float]:
        """Bounds with given ends that are kept under a key.

        Args:
            key: Key of ``key_of``.
        """

        def figures(arrays: Mapping[str, Any]) -> dict[Ends, float]:
            if str(arrays["fingerprint"]) != key:
                raise ValueError("is of other configs, inputs or options")
            pairs = zip(arrays["ends"].tolist(), arrays["figures"].tolist(), strict=True)
            return {Ends(*map(float, ends)): float(figure) for ends, figure in pairs}

        return self._read(self._path(f"{key}-ends"), figures, "bounds of ends are") or {}

    def keep_ends(self, key: str, figures: Mapping[Ends, float]) -> None:
        """Keep bounds with given ends, whole or not at all.

        Args:
            key: Key of ``key_of``.
            figures: The bounds.
        """
        ends = np.array([astuple(each) for each in figures])
        values = {"fingerprint": key, "ends": ends, "figures": np.array([*figures.values()])}
        self._write(self._path(f"{key}-ends"), values)

    def _read(self, path: Path, parse: Callable[[Mapping[str, Any]], _X], what: str) -> _X | None:
        """Content of a file; None, with a warning, where it is damaged."""
        if not path.is_file():
            return None
        try:
            return parse(snapshot.read(path))
        except (SdcError, ValueError, TypeError, KeyError) as error:
            _warn(f"{printable(path)}: {error}; {what} solved anew")
            return None

    def _write(self, path: Path, values: Mapping[str, Any]) -> None:
        try:
            if not path.is_absolute():  # the system knows no home of this user
                raise OSError("no absolute path")
            path.parent.mkdir(parents=True, exist_ok=True)
            snapshot.write(path, values)
        except ClaimedFileError:
            pass  # another process has solved the same and is keeping it
        except (SdcError, OSError) as error:
            _warn(f"{printable(path.parent)}: optima are not kept ({error})")

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.npz"


def usual_folder() -> Path:
    """Folder in which optima are kept, among the user's caches."""
    import platformdirs

    return Path(platformdirs.user_cache_dir("sdc-taichi", appauthor=False)) / "optimum"


def _to_arrays(entry: Entry, key: str) -> dict[str, Any]:
    """Arrays of an entry by name, with texts and dictionaries as JSON."""
    values = {f.name: getattr(entry, f.name) for f in fields(Entry)} | {"fingerprint": key}
    text = json.dumps({name: values.pop(name) for name in _TEXT}, default=dict)
    return {**values, "text": text}


def _from_arrays(arrays: Mapping[str, Any], key: str, steps: int) -> Entry:
    """The entry that a file holds.

    Raises:
        ValueError, TypeError, KeyError: It holds none, or that of another key.
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
