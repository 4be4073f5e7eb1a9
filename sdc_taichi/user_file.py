"""Safe reading of files that users name, with every failure reported as one class of error.

``open_input`` opens a file after checking its kind and size. ``decoding`` converts exceptions of
the library that parses the content. ``ArrayFile`` checks the shapes of arrays before it reads them.
``open_parquet`` and ``read_parquet`` read Parquet files without background threads.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import stat
import zipfile
from collections.abc import Iterator, Sequence
from io import BufferedReader
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

MOST_CONFIG_BYTES = 64_000_000
"""Largest size of a YAML or JSON file of a configuration, in bytes.

This is twice the size of a configuration of 8,192 racks with 64 groups of servers each.
"""
MOST_TABLE_BYTES = 512_000_000
"""Largest size of a file of weather, carbon intensity or workload, in bytes.

An EPW file with four years of values per minute has this size.
"""
MOST_MATRIX_BYTES = 2_000_000_000
"""Largest size of a file of a recirculation matrix, in bytes.

A matrix of 8,192 racks with 32 characters per number has this size.
"""
MOST_METRICS_BYTES = 1_000_000_000
"""Largest size of metrics.json, in bytes: 10 kB for each of 100,000 data centers."""
_HEADER_BYTES = _CHUNK_BYTES = 1 << 16
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
    """Open a file for reading after checking that it is a regular file and not too large.

    Pipes and devices are rejected without opening them, because they may block or have no end.

    Args:
        path: path of the file.
        most_bytes: largest valid size, in bytes.
        error: class of the raised error.

    Yields:
        The file, open for reading bytes.

    Raises:
        SdcError: the file does not exist, is not a regular file, is too large, or cannot be read.
            The error is of class ``error``. An ``OSError`` in the block is converted too.
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
    """Return the sorted names of files and folders in a folder; empty if the folder is missing.

    Raises:
        SdcError: the folder cannot be read; the error is of class ``error``.
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
    """Convert every exception of a library that parses a file into an error that names the file.

    Which exceptions a library raises for a damaged file is undocumented and differs between
    versions, so all are converted. The block should therefore contain calls of that library only.

    Args:
        path: path of the file.
        content: expected content of the file, such as ``a matrix``, for the message.
        error: class of the raised error.

    Raises:
        SdcError: the block raised an exception. An ``SdcError`` passes unchanged; others are
            converted to class ``error``.
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
    """Return the content of a file.

    Raises:
        SdcError: the file cannot be opened or read (see ``open_input``), or it is longer than its
            size said, because it is growing. The error is of class ``error``.
    """
    with open_input(path, most_bytes, error) as file:
        # A read takes memory for as many bytes as it is asked for.
        content = file.read(min(os.fstat(file.fileno()).st_size, most_bytes) + 1)
        while len(content) <= most_bytes and (more := file.read(_CHUNK_BYTES)):
            content += more
    if len(content) > most_bytes:
        raise error(f"{path}: has more than {most_bytes / 1e6:,.1f} MB, the most that is valid")
    return content


def read_text(
    path: str | os.PathLike[str], most_bytes: int, error: type[SdcError] = SdcError
) -> str:
    """Return the text of a UTF-8 file, with or without a byte-order mark.

    Raises:
        SdcError: the file cannot be opened or read (see ``open_input``), or is not UTF-8; the
            message then names the first invalid byte. The error is of class ``error``.
    """
    content = read_bytes(path, most_bytes, error)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as failed:
        byte = content[failed.start]
        raise error(f"{path}: byte {failed.start} is {byte:#04x}; valid is UTF-8 text") from failed


def open_parquet(file: BinaryIO, **options: Any) -> pq.ParquetFile:
    """Open a Parquet file for ``read_parquet``, without background threads that read ahead.

    Args:
        file: the file, open for reading.
        options: further arguments of ``pyarrow.parquet.ParquetFile``.
    """
    import pyarrow.parquet as pq

    return pq.ParquetFile(file, pre_buffer=False, **options)


def read_parquet(
    opened: pq.ParquetFile, columns: Sequence[str] | None = None, row_group: int | None = None
) -> pa.Table:
    """Read columns of a Parquet file in the calling thread.

    A background thread of PyArrow may still free the bytes it got from a Python file after the read
    has returned. If the interpreter exits at that moment, as it does soon after Ctrl-C, the thread
    aborts the process.

    Args:
        opened: the file, opened with ``open_parquet``.
        columns: names of the columns; None reads all.
        row_group: index of the row group; None reads all.
    """
    names = None if columns is None else list(columns)
    if row_group is None:
        return opened.read(names, use_threads=False)
    return opened.read_row_group(row_group, names, use_threads=False)


class ArrayFile:
    """Reader of a .npz file that checks shape and size of an array before it reads the values.

    Args:
        file: the file, open for reading.
        path: path of the file, for messages.
        error: class of the raised errors.

    Raises:
        SdcError: the file is not a .npz file; the error is of class ``error``.
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
        """Return shape and type of an array without reading its values.

        Raises:
            SdcError: the header is damaged, or the array contains Python objects.
        """
        with self._member(name) as member:
            return self._read_header(name, member)

    def read(self, name: str, most_bytes: float) -> npt.NDArray[Any]:
        """Read the values of an array.

        Args:
            name: name of the array.
            most_bytes: largest valid size of the values, in bytes.

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
            # Reading to the end makes zipfile verify the checksum, and reveals surplus data.
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
