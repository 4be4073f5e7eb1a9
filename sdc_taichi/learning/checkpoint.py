"""Files of nested states: of a training that can be resumed, to the bit.

A state is made of dicts, lists, tuples, texts, numbers, None, NumPy arrays and torch tensors. Its
file is one of the format safetensors: arrays and tensors as such, and how they are nested, with all
that is no array, as JSON in its metadata. A single file is either the old state or the new one,
whenever a process ends. Nothing in it is code.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors import safe_open

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.config.plain_values import load_json
from sdc_taichi.errors import SdcError
from sdc_taichi.user_file import decoding, open_input

FORMAT = "sdc-taichi state"
"""Name of the format, in the metadata of a file."""
VERSION = "1"
"""Version of how states are written as JSON."""
_KINDS = {
    np.dtype(kind): name
    for kind, name in {
        "?": "BOOL", "u1": "U8", "u2": "U16", "u4": "U32", "u8": "U64", "i1": "I8", "i2": "I16",
        "i4": "I32", "i8": "I64", "f2": "F16", "f4": "F32", "f8": "F64",
    }.items()
}  # fmt: skip
"""Names that the format has for the types of numbers."""
_ALIGNMENT = 8

Array = npt.NDArray[Any]


def write_state(path: Path, state: Any) -> None:
    """Write a state; readers see the old file until the new one is whole on the disk.

    Args:
        path: the file; its folder is made if need be.
        state: what ``read_state`` is to return.

    Raises:
        SdcError: the file cannot be written.
        TypeError: a value of another kind.
    """
    arrays: dict[str, Array] = {}
    text = json.dumps(_encode(state, "state", arrays), allow_nan=False)
    entries: dict[str, Any] = {}
    end, check = 0, zlib.crc32(text.encode())
    for name, array in sorted(arrays.items()):
        span = [end, end + array.nbytes]
        entries[name] = {
            "dtype": _KINDS[array.dtype],
            "shape": list(array.shape),
            "data_offsets": span,
        }
        end, check = span[1], zlib.crc32(_bytes_of(array), check)
    about = {"format": FORMAT, "version": VERSION, "crc32": str(check), "state": text}
    header = json.dumps({"__metadata__": about, **entries}).encode()
    header += b" " * (-len(header) % _ALIGNMENT)
    with atomic_write(path, parents=True) as file:
        file.write(len(header).to_bytes(8, "little"))
        file.write(header)
        for name in entries:
            file.write(_bytes_of(arrays[name]))


def read_state(path: Path) -> Any:
    """Read what ``write_state`` wrote.

    Raises:
        SdcError: no such file, one that was not written by ``write_state``, or a damaged one.
    """
    with open_input(path), decoding(path, "a saved state"):
        with safe_open(path, framework="numpy") as file:
            about = dict(file.metadata() or {})
            if (about.get("format"), about.get("version")) != (FORMAT, VERSION):
                raise SdcError(
                    f"{path}: is no saved state of version {VERSION} of this program; valid is "
                    "one that it has written"
                )
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
        check = zlib.crc32(about["state"].encode())
        for array in arrays.values():
            check = zlib.crc32(_bytes_of(array), check)
        if str(check) != about["crc32"]:
            raise SdcError(f"{path}: is damaged (another checksum than when it was written)")
        return _decode(load_json(about["state"]), arrays)


def _encode(value: Any, place: str, arrays: dict[str, Array]) -> Any:
    """A value as JSON has it; numbers of arrays go into ``arrays`` under the name of their place.

    Whatever JSON lacks is a dict of one key that begins with ``$``.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, torch.Tensor):
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
    """The value that ``_encode`` was given."""
    if isinstance(node, list):
        return [_decode(part, arrays) for part in node]
    if not isinstance(node, dict):
        return node
    match next(iter(node.items()), ("", None)):
        case "$tensor", name:
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
    """Put an array under a name of its own, and return the name."""
    if array.dtype.newbyteorder("=") not in _KINDS:
        raise TypeError(f"{place}: states hold no arrays of {array.dtype}")
    name = place if place not in arrays else f"{place}#{len(arrays)}"
    arrays[name] = np.asarray(array, dtype=array.dtype.newbyteorder("<"), order="C")
    return name


def _bytes_of(array: Array) -> memoryview:
    """Bytes of a contiguous array, without a copy."""
    return array.reshape(-1).view(np.uint8).data
