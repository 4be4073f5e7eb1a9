"""The folder of a training: its lock, settings, learning curves and checkpoint.

``settings.yaml`` holds the settings. ``training.csv``, ``validation.csv`` and ``tensorboard`` hold
the learning curves. ``policy`` holds the last policy, and ``best`` the policy with the best result
in the validation weeks. ``checkpoint.safetensors`` holds everything that is needed to resume.

The state in a checkpoint consists of dicts, lists, tuples, strings, numbers, None, NumPy arrays and
torch tensors. Arrays and tensors are entries of the safetensors file. The nesting and all other
values are JSON in the file's metadata.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import FileClaim, atomic_write, naming_errors
from sdc_taichi.config.plain_values import load_json
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.training_settings import TrainingSettings, load_settings
from sdc_taichi.user_file import decoding, list_folder, open_input

SETTINGS_FILE, CHECKPOINT_FILE = "settings.yaml", "checkpoint.safetensors"
"""File names of settings and checkpoint in a training folder."""
TRAINING_FILE, VALIDATION_FILE = "training.csv", "validation.csv"
"""File names of the learning curves in a training folder."""
LAST_POLICY, BEST_POLICY, EVENTS = "policy", "best", "tensorboard"
"""Subfolders of a training folder: last policy, best policy, TensorBoard events."""


@contextlib.contextmanager
def claimed(out: Path, settings: TrainingSettings, *, resume: bool) -> Iterator[None]:
    """Check the folder of a training, and lock it against other processes.

    Args:
        out: the folder; created if it does not exist and ``resume`` is false.
        settings: settings of the training.
        resume: True if the folder must contain a training with these settings; False if it must be
            empty.

    Raises:
        SdcError: the folder contains other files, the training to resume is missing or has
            different settings, another process trains there, or the folder is not writable.
    """
    with naming_errors(out):
        if out.exists() and not out.is_dir():
            raise ConfigError(f"{out}: is a file; valid is a folder to write a training to")
        if not resume:
            out.mkdir(parents=True, exist_ok=True)
        others = [name for name in list_folder(out) if not name.startswith(".")]
    if resume:
        different = settings_of(out, allow_code=True).difference(settings)
        if different is not None:
            raise ConfigError(
                f"{out}: was trained with {different}; valid is to resume with its settings, or "
                "another folder"
            )
    elif SETTINGS_FILE in others:
        raise ConfigError(
            f"{out}: holds a training; go on with it with --resume, or choose another folder"
        )
    elif others:
        some = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
        raise ConfigError(f"{out}: holds other files ({some}); choose an empty folder with --out")
    claim = FileClaim(out / "training")
    try:
        yield
    finally:
        claim.release()


def write_settings(folder: Path, settings: TrainingSettings) -> None:
    """Write the settings file, which marks a folder as a training folder.

    Raises:
        SdcError: the file cannot be written.
    """
    with atomic_write(folder / SETTINGS_FILE) as file:
        file.write(settings.to_yaml().encode())


def settings_of(folder: Path, *, allow_code: bool = False) -> TrainingSettings:
    """Read the settings of the training in a folder.

    Args:
        folder: the folder.
        allow_code: True if import paths ``module:name`` in the settings are valid, as they are
            where no environment is created from the settings.

    Raises:
        ConfigError: the folder contains no training, or the settings are not valid.
    """
    if not (folder / SETTINGS_FILE).is_file():
        raise ConfigError(f"{folder}: holds no training; valid is a folder that train has written")
    return load_settings(folder / SETTINGS_FILE, allow_code=allow_code)


UPDATE = "update"
"""Name of the first column of both learning curves: number of updates done so far."""


class CsvLog:
    """CSV file to which rows are appended; a new name in a row adds a column to the table.

    Args:
        path: the file; it may have rows of an interrupted training.
        until: number of the last valid update; rows of later updates are deleted.

    Raises:
        SdcError: the file cannot be read or written.
    """

    def __init__(self, path: Path, until: int) -> None:
        self._path = path
        self._columns: list[str] = []
        rows = [row for row in self._read() if int(row[UPDATE]) <= until]
        if rows:
            self._write(rows)
        else:
            self._columns = []
            with naming_errors(path):
                path.unlink(missing_ok=True)

    def add(self, row: Mapping[str, Any]) -> None:
        """Append a row, whose first entry is ``update``.

        Raises:
            SdcError: the file cannot be written.
        """
        if new := [name for name in row if name not in self._columns]:
            rows = self._read()
            self._columns += new
            self._write(rows)
        with naming_errors(self._path), self._path.open("ab") as file:
            file.write(self._text([row]))

    def _read(self) -> list[dict[str, str]]:
        """Return the complete rows of the file, and set the columns."""
        if not self._path.exists():
            return []
        with naming_errors(self._path):
            text = self._path.read_text(encoding="utf-8", errors="replace")
        # The last row may be incomplete: the process may have been killed during writing.
        reader = csv.DictReader(text[: text.rfind("\n") + 1].splitlines())
        rows = [row for row in reader if None not in (*row, *row.values())]
        self._columns = list(reader.fieldnames or ())
        return [row for row in rows if row.get(UPDATE, "").isdecimal()]

    def _write(self, rows: Sequence[Mapping[str, Any]]) -> None:
        with atomic_write(self._path) as file:
            file.write(self._text([dict(zip(self._columns, self._columns, strict=True)), *rows]))

    def _text(self, rows: Sequence[Mapping[str, Any]]) -> bytes:
        out = io.StringIO()
        csv.DictWriter(out, self._columns, restval="", lineterminator="\n").writerows(rows)
        return out.getvalue().encode()


class EventLog:
    """Writer of a training's TensorBoard events.

    Args:
        folder: folder of the events; None writes no events.
        after: last valid step; events of an interrupted training after it are discarded.

    Raises:
        SdcError: TensorBoard is not installed, or the folder cannot be written.
    """

    def __init__(self, folder: Path | None, *, after: int) -> None:
        self._writer: Any = None
        if folder is None:
            return
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise SdcError(
                'TensorBoard is not installed: pip install "sdc-taichi[train]", or go without: '
                "--set tensorboard=false"
            ) from None
        with naming_errors(folder):
            self._writer = SummaryWriter(str(folder), purge_step=after + 1)
        self._folder = folder

    def add(self, numbers: Mapping[str, float], step: int) -> None:
        """Write scalar values.

        Args:
            numbers: value of each scalar by name.
            step: number of steps done, summed over all data centers.

        Raises:
            SdcError: the events cannot be written.
        """
        if self._writer is not None:
            with naming_errors(self._folder):
                for name, value in numbers.items():
                    self._writer.add_scalar(name, value, step)

    def flush(self) -> None:
        """Write buffered events to the disk.

        Raises:
            SdcError: the events cannot be written.
        """
        if self._writer is not None:
            with naming_errors(self._folder):
                self._writer.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._writer is not None:
            with naming_errors(self._folder):
                self._writer.close()


FORMAT = "sdc-taichi state"
"""Format name in the metadata of a checkpoint file."""
VERSION = "1"
"""Version of the JSON encoding of states."""
Array = npt.NDArray[Any]


def write_state(path: Path, state: Any) -> None:
    """Write a state to a file; an existing file is replaced atomically.

    Args:
        path: the file; its folder is created if it does not exist.
        state: the state, which ``read_state`` can read back.

    Raises:
        SdcError: the file cannot be written.
        TypeError: the type of a value is not supported.
    """
    from safetensors.numpy import save

    arrays: dict[str, Array] = {}
    text = json.dumps(_encode(state, "state", arrays), allow_nan=False)
    check = str(_checksum(text, arrays))
    about = {"format": FORMAT, "version": VERSION, "crc32": check, "state": text}
    content = save(arrays, about)
    with atomic_write(path, parents=True) as file:
        file.write(content)


def read_state(path: Path) -> Any:
    """Read a state from a file of ``write_state``.

    Raises:
        SdcError: the file does not exist, was not written by ``write_state``, or is damaged.
    """
    from safetensors import safe_open

    with open_input(path), decoding(path, "a saved state"):
        with safe_open(path, framework="numpy") as file:
            about = dict(file.metadata() or {})
            if (about.get("format"), about.get("version")) != (FORMAT, VERSION):
                raise SdcError(
                    f"{path}: is no saved state of version {VERSION} of this program; valid is "
                    "one that it has written"
                )
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
        if str(_checksum(about["state"], arrays)) != about["crc32"]:
            raise SdcError(f"{path}: is damaged (another checksum than when it was written)")
        return _decode(load_json(about["state"]), arrays)


def _encode(value: Any, place: str, arrays: dict[str, Array]) -> Any:
    """Encode a value as JSON data, and add its arrays to ``arrays`` by their path in the state.

    A value of a type that JSON lacks becomes a dict with a single key that begins with ``$``.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if hasattr(value, "detach"):  # a torch tensor, recognised without importing PyTorch
        return {"$tensor": _stored(value.detach().numpy(), place, arrays)}
    if isinstance(value, np.ndarray) and value.dtype.kind == "U":
        return {"$text": value.tolist()}
    if isinstance(value, np.ndarray):
        return {"$array": _stored(value, place, arrays)}
    if isinstance(value, np.generic):
        return {"$number": _stored(np.asarray(value), place, arrays)}
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"$float": str(value)}
    if isinstance(value, list | tuple):
        parts = [_encode(part, f"{place}.{i}", arrays) for i, part in enumerate(value)]
        return parts if isinstance(value, list) else {"$tuple": parts}
    if isinstance(value, Mapping):
        pairs = [(key, _encode(part, f"{place}.{key}", arrays)) for key, part in value.items()]
        if all(isinstance(key, str) and not key.startswith("$") for key, _ in pairs):
            return dict(pairs)
        return {"$dict": [[_encode(key, place, arrays), part] for key, part in pairs]}
    raise TypeError(f"{place}: states hold no {type(value).__name__}")


def _decode(node: Any, arrays: Mapping[str, Array]) -> Any:
    """Decode JSON data that ``_encode`` returned."""
    if isinstance(node, list):
        return [_decode(part, arrays) for part in node]
    if not isinstance(node, dict):
        return node
    match next(iter(node.items()), ("", None)):
        case "$tensor", name:
            import torch

            return torch.from_numpy(arrays[name])
        case "$array", name:
            return arrays[name]
        case "$number", name:
            return arrays[name][()]
        case "$text", texts:
            return np.array(texts)
        case "$float", text:
            return float(text)
        case "$tuple", parts:
            return tuple(_decode(part, arrays) for part in parts)
        case "$dict", pairs:
            return {_decode(key, arrays): _decode(part, arrays) for key, part in pairs}
    return {key: _decode(part, arrays) for key, part in node.items()}


def _stored(array: Array, place: str, arrays: dict[str, Array]) -> str:
    """Add an array to ``arrays`` under an unused name, and return the name."""
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{place}: states hold no arrays of {array.dtype}")
    name = place if place not in arrays else f"{place}#{len(arrays)}"
    arrays[name] = np.asarray(array, order="C")
    return name


def _checksum(text: str, arrays: Mapping[str, Array]) -> int:
    """Return the CRC-32 of the text followed by the arrays in the order of their names."""
    check = zlib.crc32(text.encode())
    for _, array in sorted(arrays.items()):
        check = zlib.crc32(array.reshape(-1).view(np.uint8).data, check)
    return check
