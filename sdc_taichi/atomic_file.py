"""Files that appear under their name only when they are whole, written by one process at a time."""

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
except ImportError:  # not on Windows, where a file that is open cannot be deleted
    fcntl = None  # type: ignore[assignment]

_SUFFIX = ".part"


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


class ClaimedFileError(SdcError):
    """Another process, or another part of this one, is writing a file."""


class FileClaim:
    """The right to write a file, which one process has at a time.

    The claim is a hidden file, ``.NAME.part``, beside the file to be written, which is open and
    locked. The system frees the lock when the process ends, for any reason; the next writer takes
    over the hidden file. On a file system without locks several processes can write at a time, and
    the last one to end determines the content.

    Args:
        path: the file that is to be written.

    Raises:
        ClaimedFileError: another process, or another part of this one, is writing it.
        SdcError: nothing can be written there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = path.with_name(f".{path.name}{_SUFFIX}")
        with naming_errors(path):
            try:
                opened = _open_alone(self._part)
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
        """Deletes the hidden file; without effect after ``rename``, or when called again. Happens
        by itself when the claim is forgotten and when the process ends."""

    def rename(self) -> None:
        """Give the hidden file its name, once its content is on the disk, and end the claim.

        Raises:
            OSError: the file system refuses.
        """
        self.file.flush()
        os.fsync(self.file.fileno())
        if fcntl is None:
            self.file.close()
        self._part.replace(self.path)
        self.release.detach()
        self.file.close()


class AtomicFile:
    """A file open for writing; readers see the old one until ``commit`` and the new one after.

    As a context manager it discards what was not committed.

    Args:
        path: the name that the file gets on ``commit``.
        parents: also create the folders it lies in.

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
        """Close the file and give it its name, once its content is on the disk.

        Raises:
            SdcError: the file cannot be written.
        """
        with naming_errors(self.path):
            self._claim.rename()

    def discard(self) -> None:
        """Close the file and delete what was written; without effect after ``commit``."""
        self._claim.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.discard()


@contextlib.contextmanager
def atomic_write(path: Path, *, parents: bool = False) -> Iterator[IO[bytes]]:
    """Open a file for writing that replaces ``path`` when the block ends without an error.

    Args:
        path: the file.
        parents: also create the folders it lies in.

    Raises:
        SdcError: the file cannot be written, or another process is writing it.
    """
    with AtomicFile(path, parents=parents) as opened:
        with naming_errors(path):
            yield opened.file
        opened.commit()


class _NoLocksError(Exception):
    """The file system locks no files."""


def _open_alone(part: Path) -> IO[bytes] | None:
    """Open the hidden file of a claim, and empty it; None while another claim holds it.

    Raises:
        OSError: it cannot be opened.
        _NoLocksError: it cannot be locked; it is deleted.
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
        # Renamed or deleted by the former owner since it was opened here.
        with contextlib.suppress(FileNotFoundError):
            if part.stat().st_ino == os.fstat(file.fileno()).st_ino:
                file.truncate(0)
                return file
        file.close()


def _delete(file: IO[bytes], part: Path, owner: int) -> None:
    """Close and delete the hidden file of a claim, unless this is a child of its owner."""
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
