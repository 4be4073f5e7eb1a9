"""Files that users name: their kind and size are checked first, and every failure is one error.

``open_input`` opens a regular file of a limited size, ``decoding`` converts the errors of the
library that reads its content, and ``ArrayFile`` gives the shapes of arrays before it reads them.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import stat
import zipfile
from collections.abc import Iterator
from io import BufferedReader
from typing import Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError

MOST_CONFIG_BYTES = 64_000_000
"""Largest YAML or JSON file of a configuration, in bytes: twice that of 8,192 racks with 64 groups
of servers each."""
MOST_TABLE_BYTES = 512_000_000
"""Largest file of weather, carbon intensity or workload, in bytes: an EPW file of four years of
minutes."""
MOST_MATRIX_BYTES = 2_000_000_000
"""Largest file of a recirculation matrix, in bytes: 8,192 racks, 32 characters per number."""
MOST_METRICS_BYTES = 1_000_000_000
"""Largest metrics.json, in bytes: 10 kB for each of 100,000 data centers."""
_HEADER_BYTES = 1 << 16
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


@contextlib.contextmanager
def open_input(
    path: str | os.PathLike[str],
    most_bytes: float = math.inf,
    error: type[SdcError] = SdcError,
) -> Iterator[BufferedReader]:
    """Open a file for reading, once it is known to be a regular one and not too large.

    Nothing is read of pipes and devices, which may have no end, and none is waited for.

    Args:
        path: the file.
        most_bytes: largest valid size.
        error: class of what is raised.

    Raises:
        SdcError: of class ``error``: there is no such file, it is of another kind or too large, or
            it cannot be read, then or while it is open. Its cause is the OSError.
    """
    try:
        try:
            status = os.stat(path)
        except ValueError as failed:
            raise error(f"{str(path)!r}: is no name of a file ({failed})") from failed
        kind = next((name for is_kind, name in _KINDS if is_kind(status.st_mode)), None)
        if kind is not None:
            raise error(f"{path}: is {kind}; valid is a file")
        if status.st_size > most_bytes:
            raise error(
                f"{path}: has {status.st_size / 1e6:,.1f} MB; valid is at most "
                f"{most_bytes / 1e6:,.1f} MB"
            )
        with open(path, "rb") as file:
            yield file
    except FileNotFoundError as missing:
        raise error(f"{path}: no such file") from missing
    except OSError as failed:
        raise error(f"{path}: cannot be read: {failed.strerror or failed}") from failed


def list_folder(path: str | os.PathLike[str], error: type[SdcError] = SdcError) -> list[str]:
    """Names of what lies in a folder, in order; none where there is no such folder.

    Raises:
        SdcError: of class ``error``: the folder cannot be read.
    """
    try:
        return sorted(os.listdir(path))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as failed:
        raise error(f"{path}: cannot be read: {failed.strerror or failed}") from failed


@contextlib.contextmanager
def decoding(
    path: str | os.PathLike[str], content: str, error: type[SdcError] = SdcError
) -> Iterator[None]:
    """Turn every failure of a library that reads a file into an error that names the file.

    What a library raises of a damaged file is not documented, and differs from version to version.
    Only calls of that library belong into the block.

    Args:
        path: the file.
        content: what it should hold, such as ``a matrix``.
        error: class of what is raised.

    Raises:
        SdcError: of class ``error``; errors of classes of this package pass.
    """
    try:
        yield
    except SdcError:
        raise
    except MemoryError as failed:
        raise error(f"{path}: cannot be read as {content}: not enough memory") from failed
    except Exception as failed:
        reason = str(failed) or type(failed).__name__
        raise error(f"{path}: cannot be read as {content}: {reason}") from failed


def read_bytes(
    path: str | os.PathLike[str], most_bytes: int, error: type[SdcError] = SdcError
) -> bytes:
    """Content of a file.

    Raises:
        SdcError: of class ``error``, as of ``open_input``, or the file holds more than it said, as
            one that grows does.
    """
    with open_input(path, most_bytes, error) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise error(f"{path}: has more than {most_bytes / 1e6:,.1f} MB, the most that is valid")
    return content


def read_text(
    path: str | os.PathLike[str], most_bytes: int, error: type[SdcError] = SdcError
) -> str:
    """Text of a UTF-8 file, with or without a byte-order mark.

    Raises:
        SdcError: of class ``error``, as of ``open_input``, or naming the first byte that is not
            UTF-8.
    """
    content = read_bytes(path, most_bytes, error)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as failed:
        byte = content[failed.start]
        raise error(f"{path}: byte {failed.start} is {byte:#04x}; valid is UTF-8 text") from failed


class ArrayFile:
    """An open .npz file, of which an array is read only once its shape and size are known.

    Args:
        file: the file, open for reading.
        path: its name, for messages.
        error: class of what is raised.

    Raises:
        SdcError: of class ``error``: the file is no .npz file.
    """

    def __init__(
        self, file: BinaryIO, path: str | os.PathLike[str], error: type[SdcError] = SdcError
    ) -> None:
        self._path, self._error = path, error
        with decoding(path, "an .npz file", error):
            self._archive = zipfile.ZipFile(file)
        self.names = [
            name.removesuffix(".npy") for name in self._archive.namelist() if name.endswith(".npy")
        ]

    def header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Shape and type of an array, without its values.

        Raises:
            SdcError: the header is damaged, or the array holds Python objects.
        """
        with self._member(name) as member:
            return self._read_header(name, member)

    def read(self, name: str, most_bytes: float) -> npt.NDArray[Any]:
        """Values of an array.

        Args:
            name: of the array.
            most_bytes: largest valid size of the values.

        Raises:
            SdcError: the array is damaged or too large.
        """
        with self._member(name) as member:
            shape, dtype = self._read_header(name, member)
        size = math.prod(shape) * dtype.itemsize
        if size > most_bytes:
            raise self._error(
                f"{self._path}: {name} has shape {shape}, {size / 1e6:,.1f} MB; valid is at most "
                f"{most_bytes / 1e6:,.1f} MB"
            )
        with self._member(name) as member:
            values = np.lib.format.read_array(member, allow_pickle=False)
            # The checksum is compared at the end of the member.
            if member.read(1):
                raise self._error(f"{self._path}: {name} goes on after its last value")
        return np.asarray(values)

    @contextlib.contextmanager
    def _member(self, name: str) -> Iterator[BinaryIO]:
        with (
            decoding(self._path, f"array {name}", self._error),
            self._archive.open(f"{name}.npy") as member,
        ):
            yield cast(BinaryIO, member)

    def _read_header(self, name: str, member: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
        beginning = io.BytesIO(member.read(_HEADER_BYTES))
        if np.lib.format.read_magic(beginning) == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(beginning)
        else:
            shape, _, dtype = np.lib.format.read_array_header_2_0(beginning)
        if dtype.hasobject or any(n < 0 for n in shape):
            raise self._error(f"{self._path}: {name} is {dtype} {shape}; valid are numbers")
        return shape, dtype
