"""Cache of optima on disk, with one file for each data center."""

from __future__ import annotations

import hashlib
import json
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sdc_taichi.atomic_file import ClaimedFileError
from sdc_taichi.errors import SdcError, SdcWarning, one_line, printable, shortened
from sdc_taichi.optimum.problem import Agent, Ends
from sdc_taichi.optimum.rollout import LARGEST_TABLE_ERROR, Certificate
from sdc_taichi.sim import snapshot
from sdc_taichi.types import F64

_X = TypeVar("_X")
METHOD = 5
"""Version of the solution method. Cached files of other versions are not used."""
_MOST_FIGURE = 1e15
"""Largest figure of a cached optimum."""
_ROUND_OFF = 1e-9
"""Relative error of a comparison of two figures."""
_Figure = Annotated[float, Field(ge=0.0, le=_MOST_FIGURE)]


class _EntryText(BaseModel):
    """Texts and numbers by name of an entry, which its file contains as JSON."""

    model_config = ConfigDict(strict=True, extra="forbid")

    fingerprint: str
    """Key of the entry."""
    alone: dict[str, _Figure]
    """``Entry.alone``."""
    kind: Annotated[str, Field(pattern="^(bound$|estimate: |none: )")]
    """``Entry.kind``."""
    failures: tuple[str, ...]
    """``Entry.failures``."""
    certificate: dict[str, float]
    """``Entry.certificate``."""
    uncoordinated: dict[str, _Figure] = {}
    """``Entry.uncoordinated``."""
    uncoordinated_failures: tuple[str, ...] = ()
    """``Entry.uncoordinated_failures``."""


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
    loops: F64
    """Commands of the coolant loops in the best plan, (T, 3): supply setpoint in C, flow as a share
    of design, and approach in K; nan holds the loops."""
    uncoordinated: Mapping[str, float] = field(default_factory=dict)
    """Figures of plans that agents make without coordination, by the names of
    ``uncoordinated.uncoordinated``; empty if they were not simulated."""
    uncoordinated_failures: tuple[str, ...] = ()
    """Constraints that plans of ``uncoordinated`` break, in words."""


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

    def find(self, key: str, steps: int, agents: Sequence[Agent]) -> Entry | None:
        """Return the entry of a key, or None if there is no usable entry.

        Args:
            key: Key from ``key_of``.
            steps: Number of steps, T.
            agents: Agents that the plans control.
        """
        return self._read(
            self._path(key),
            lambda arrays: _from_arrays(arrays, key, steps, agents),
            "the optimum is",
        )

    def keep(self, key: str, entry: Entry) -> None:
        """Write an entry atomically."""
        self._write(self._path(key), _to_arrays(entry, key))

    def find_ends(self, key: str) -> dict[Ends, float]:
        """Return the cached bounds of a key, by the states at start and end of the run."""

        def figures(arrays: Mapping[str, Any]) -> dict[Ends, float]:
            if str(arrays["fingerprint"]) != key:
                raise ValueError("is of other configs, inputs or options")
            count = len(np.atleast_1d(arrays["figures"]))
            ends = _numbers(arrays, "ends", (count, len(fields(Ends))), 0.0, _MOST_FIGURE)
            bounds = _numbers(arrays, "figures", (count,), 0.0, _MOST_FIGURE)
            return {
                Ends(*each): figure
                for each, figure in zip(ends.tolist(), bounds.tolist(), strict=True)
            }

        return self._read(self._path(f"{key}-ends"), figures, "bounds of ends are") or {}

    def keep_ends(self, key: str, figures: Mapping[Ends, float]) -> None:
        """Write bounds atomically, by the states at start and end of the run."""
        ends = np.array([astuple(each) for each in figures])
        values = {"fingerprint": key, "ends": ends, "figures": np.array([*figures.values()])}
        self._write(self._path(f"{key}-ends"), values)

    def find_figures(self, key: str, names: Sequence[str]) -> dict[str, float] | None:
        """Return the figures of a key by name, or None if there are none.

        Args:
            key: Key from ``key_of``.
            names: Names of the figures, which may be nan.
        """

        def figures(arrays: Mapping[str, Any]) -> dict[str, float]:
            if str(arrays["fingerprint"]) != key:
                raise ValueError("is of other configs, inputs or options")
            limits = -_MOST_FIGURE, _MOST_FIGURE
            return {x: _numbers(arrays, x, (), *limits, or_nan=True).item() for x in names}

        return self._read(self._path(key), figures, "the optimum is")

    def keep_figures(self, key: str, figures: Mapping[str, float]) -> None:
        """Write figures atomically, by name."""
        values = {name: np.float64(figure) for name, figure in figures.items()}
        self._write(self._path(key), {**values, "fingerprint": key})

    def _read(self, path: Path, parse: Callable[[Mapping[str, Any]], _X], what: str) -> _X | None:
        """Return the content of a file, or None if it is missing or, with a warning, damaged."""
        if not path.is_file():
            return None
        try:
            return parse(snapshot.read(path))
        except (SdcError, ValueError, TypeError, KeyError) as error:
            _warn(f"{printable(path)}: {one_line(str(error))}; {what} solved anew")
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


def cache_in(folder: bool | str | os.PathLike[str]) -> Cache | None:
    """Return the cache in a folder, True for the user's cache; None if ``folder`` is False."""
    if folder is False:
        return None
    return Cache(None if folder is True else Path(folder))


def usual_folder() -> Path:
    """Return the default folder of cached optima, inside the user's cache directory."""
    import platformdirs

    return Path(platformdirs.user_cache_dir("sdc-taichi", appauthor=False)) / "optimum"


def _to_arrays(entry: Entry, key: str) -> dict[str, Any]:
    """Convert an entry to arrays by name; text and dictionaries become one JSON string."""
    values = {f.name: getattr(entry, f.name) for f in fields(Entry)} | {"fingerprint": key}
    text = json.dumps({name: values.pop(name) for name in _EntryText.model_fields}, default=dict)
    return {**values, "text": text}


def _from_arrays(arrays: Mapping[str, Any], key: str, steps: int, agents: Sequence[Agent]) -> Entry:
    """Convert the arrays of a file to an entry.

    Raises:
        ValueError, KeyError: The arrays are no entry, belong to another key, or contradict each
            other.
    """
    try:
        text = _EntryText.model_validate_json(str(arrays["text"]))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{where}: {first['msg']}") from None
    if text.fingerprint != key:
        raise ValueError("is of other configs, inputs or options")
    if set(text.alone) != set(agents):
        raise ValueError(f"alone is of {shortened(sorted(text.alone))}, not of {', '.join(agents)}")
    values: dict[str, Any] = {
        name: _numbers(arrays, name, (), 0.0, _MOST_FIGURE).item()
        for name in ("idle", "idle_dropped_tasks", "achieved")
    }
    for name, most in (("load", 1.0), ("cooling", _MOST_FIGURE), ("battery", 1.0)):
        values[name] = _numbers(arrays, name, (steps,), -most, most)
    values["loops"] = _numbers(arrays, "loops", (steps, 3), 0.0, _MOST_FIGURE, or_nan=True)
    entry = Entry(
        **values,
        bound=_numbers(arrays, "bound", (), -_MOST_FIGURE, _MOST_FIGURE, or_nan=True).item(),
        **text.model_dump(exclude={"fingerprint"}),
    )
    _check_figures(entry)
    return entry


def _check_figures(entry: Entry) -> None:
    """Check that figures, kind of bound and certificate of an entry fit together.

    Raises:
        ValueError: They contradict each other.
    """
    values = entry.certificate
    names = {f.name for f in fields(Certificate)}
    if set(values) != names:
        raise ValueError(f"certificate has {shortened(sorted(values))}, not {', '.join(names)}")
    for name, value in values.items():
        if not math.isfinite(value) and not (name.endswith("_limit_c") and value == math.inf):
            raise ValueError(f"{name} is {value}, not a finite number")
    error = values["table_error"]
    kind = entry.kind.partition(":")[0]
    if kind != "none" and (kind == "bound") != (0.0 <= error <= LARGEST_TABLE_ERROR):
        raise ValueError(f"kind {shortened(entry.kind)} is not that of a table error of {error:g}")
    if (kind == "none") != math.isnan(entry.bound):
        raise ValueError(f"bound {entry.bound:g} is of kind {shortened(entry.kind)}")
    if entry.achieved != values["figure"]:
        raise ValueError(f"achieved {entry.achieved:g}, certificate {values['figure']:g}")
    if entry.achieved < entry.bound - (error + _ROUND_OFF) * abs(entry.bound):
        raise ValueError(f"achieved {entry.achieved:g} is better than the bound {entry.bound:g}")


def _numbers(
    arrays: Mapping[str, Any],
    name: str,
    shape: tuple[int, ...],
    low: float,
    high: float,
    *,
    or_nan: bool = False,
) -> npt.NDArray[np.float64]:
    """Return an array of a file after checking its type, shape and range.

    Raises:
        ValueError, KeyError: The array is missing or not valid.
    """
    values = np.asarray(arrays[name])
    if values.dtype != np.float64 or values.shape != shape:
        raise ValueError(f"{name} is {values.dtype} {values.shape}, expected float64 {shape}")
    valid = (values >= low) & (values <= high)
    if or_nan:
        valid |= np.isnan(values)
    if not valid.all():
        raise ValueError(f"{name} is not within {low:g}..{high:g}")
    return values


def _warn(message: str) -> None:
    warnings.warn(message, OptimumCacheWarning, stacklevel=4)
