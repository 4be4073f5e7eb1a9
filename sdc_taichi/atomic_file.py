"""Atomic writing: a file gets its name only when complete, and has one writer at a time."""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Self

from sdc_taichi.errors import SdcError

try:
    import fcntl
except ImportError:  # on Windows, where an open file cannot be deleted
    fcntl = None  # type: ignore[assignment]

_SUFFIX = ".part"


@contextlib.contextmanager
def naming_errors(path: Path) -> Iterator[None]:
    """Convert an ``OSError`` of the block into an error whose message names the file.

    Raises:
        SdcError: the block raised an ``OSError``.
    """
    try:
        yield
    except OSError as error:
        raise SdcError(f"{path}: cannot be written: {error.strerror or error}") from error


class ClaimedFileError(SdcError):
    """Another process, or another part of this process, is writing the file."""


class FileClaim:
    """Exclusive right to write a file, which only one process can have at a time.

    The claim opens and locks a hidden file, ``.NAME.part``, in the folder of the file. The
    operating system releases the lock when the process ends, even after a crash; the next writer
    then reuses the hidden file. On a file system without locks, several processes can write at the
    same time, and the content is that of the last one to finish.

    Args:
        path: path of the file to write.

    Raises:
        ClaimedFileError: another process, or another part of this process, is writing the file.
        SdcError: no file can be written at the path.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = path.with_name(f".{path.name}{_SUFFIX}")
        with naming_errors(path):
            try:
                opened = _open_exclusively(self._part)
            except _NoLocksError:
                self._part = path.with_name(f".{path.name}.{os.getpid()}{_SUFFIX}")
                opened = self._part.open("wb")
        if opened is None:
            raise ClaimedFileError(
                f"{path}: another run is writing it; valid is another name, or to wait until it "
                "has ended"
            )
        self.file: IO[bytes] = opened
        """The hidden file, empty and open for writing."""
        self.release = weakref.finalize(self, _delete, self.file, self._part, os.getpid())
        """Function that ends the claim and deletes the hidden file.

        It is called automatically when the claim is garbage-collected or the process ends. It has
        no effect after ``rename``, or when called again.
        """

    def rename(self) -> None:
        """Flush the hidden file to disk, rename it to the claimed name, and end the claim.

        Raises:
            OSError: the file cannot be flushed or renamed.
        """
        self.file.flush()
        os.fsync(self.file.fileno())
        if fcntl is None:
            self.file.close()
        self._part.replace(self.path)
        self.release.detach()
        self.file.close()


class AtomicFile:
    """File open for writing, which replaces an existing file only on ``commit``.

    Until then, readers see the old content. Leaving the context manager without ``commit``
    discards the new content.

    Args:
        path: path that the file gets on ``commit``.
        parents: True to create missing parent folders.

    Raises:
        SdcError: the file cannot be opened, or another process is writing it.
    """

    def __init__(self, path: Path, *, parents: bool = False) -> None:
        self.path = path
        if parents:
            with naming_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
        self._claim = FileClaim(path)
        self.file: IO[bytes] = self._claim.file
        """The file, open for writing."""

    def commit(self) -> None:
        """Flush the file to disk, close it, and give it its final name.

        Raises:
            SdcError: the file cannot be written.
        """
        with naming_errors(self.path):
            self._claim.rename()

    def discard(self) -> None:
        """Close the file and delete the new content; this has no effect after ``commit``."""
        self._claim.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.discard()


@contextlib.contextmanager
def atomic_write(path: Path, *, parents: bool = False) -> Iterator[IO[bytes]]:
    """Open a file for writing that replaces ``path`` when the block ends without an error.

    Args:
        path: path of the file.
        parents: True to create missing parent folders.

    Yields:
        The file, open for writing bytes.

    Raises:
        SdcError: the file cannot be written, or another process is writing it.
    """
    with AtomicFile(path, parents=parents) as opened:
        with naming_errors(path):
            yield opened.file
        opened.commit()


class _NoLocksError(Exception):
    """The file system does not support file locks."""


def _open_exclusively(part: Path) -> IO[bytes] | None:
    """Open, lock and empty the hidden file of a claim; return None if another claim has it.

    Raises:
        OSError: the file cannot be opened.
        _NoLocksError: the file cannot be locked, and was deleted.
    """
    if fcntl is None:
        try:
            part.unlink(missing_ok=True)
            return part.open("xb")
        except (PermissionError, FileExistsError):
            return None
    while True:
        opened = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        file = os.fdopen(opened, "wb")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            return None
        except OSError:
            file.close()
            part.unlink(missing_ok=True)
            raise _NoLocksError from None
        # The file's previous owner may have renamed or deleted it between opening and locking here.
        # In that case the path has another inode or none, and the loop tries again.
        with contextlib.suppress(FileNotFoundError):
            if part.stat().st_ino == os.fstat(file.fileno()).st_ino:
                file.truncate(0)
                return file
        file.close()


def _delete(file: IO[bytes], part: Path, owner: int) -> None:
    """Close and delete the hidden file of a claim, unless this is a forked child process.

    Args:
        file: the open hidden file.
        part: path of the hidden file.
        owner: id of the process that made the claim.
    """
    if os.getpid() != owner:
        return
    if fcntl is not None:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        file.close()
    if fcntl is None:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
