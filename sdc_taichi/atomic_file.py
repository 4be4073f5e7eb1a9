"""Files that appear under their name only when they are whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from sdc_taichi.errors import SdcError

_SUFFIX = ".part"


def temporary_name(path: Path) -> Path:
    """Hidden name beside ``path`` under which this process writes the file."""
    return path.with_name(f".{path.name}.{os.getpid()}{_SUFFIX}")


def delete_leftovers(path: Path) -> None:
    """Delete what killed processes left of their attempts to write ``path``.

    Raises:
        OSError: a leftover cannot be deleted.
    """
    for leftover in path.parent.glob(f".{path.name}.*{_SUFFIX}"):
        leftover.unlink()


@contextlib.contextmanager
def naming_errors(path: Path) -> Iterator[None]:
    """Turn a failure of the file system into an error that names the file.

    Raises:
        SdcError: in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise SdcError(f"{path}: cannot be written: {error.strerror or error}") from error


class AtomicFile:
    """A file open for writing; readers see the old one until ``commit`` and the new one after.

    Args:
        path: the name that the file gets on ``commit``.
        parents: also create the folders it lies in.

    Raises:
        SdcError: the file cannot be opened.
    """

    def __init__(self, path: Path, *, parents: bool = False) -> None:
        self.path = path
        self._temporary = temporary_name(path)
        with naming_errors(path):
            if parents:
                path.parent.mkdir(parents=True, exist_ok=True)
            self.file: IO[bytes] = self._temporary.open("wb")

    def commit(self) -> None:
        """Close the file and give it its name, once its content is on the disk.

        Raises:
            SdcError: the file cannot be written.
        """
        with naming_errors(self.path):
            self.file.flush()
            os.fsync(self.file.fileno())
            self.file.close()
            self._temporary.replace(self.path)

    def discard(self) -> None:
        """Close the file and delete what was written; without effect after ``commit``."""
        with contextlib.suppress(OSError):
            self.file.close()
        with contextlib.suppress(OSError):
            self._temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_write(path: Path, *, parents: bool = False) -> Iterator[IO[bytes]]:
    """Open a file for writing that replaces ``path`` when the block ends without an error.

    Args:
        path: the file.
        parents: also create the folders it lies in.

    Raises:
        SdcError: the file cannot be written.
    """
    opened = AtomicFile(path, parents=parents)
    try:
        with naming_errors(path):
            yield opened.file
        opened.commit()
    finally:
        opened.discard()
