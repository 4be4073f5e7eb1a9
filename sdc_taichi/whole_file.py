"""Files that appear under their name only when they are whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from sdc_taichi.errors import ConfigError, SdcError


def part_of(path: Path) -> Path:
    """Hidden name beside ``path`` under which this process writes it."""
    return path.with_name(f".{path.name}.{os.getpid()}.part")


def check_new_file(out: Path, suffix: str, *, force: bool) -> None:
    """Check the file of an option ``--out``.

    Raises:
        ConfigError: it has another suffix, is a folder, or exists and ``force`` is not set.
    """
    if out.suffix.lower() != suffix:
        raise ConfigError(f"--out {out}: valid is a name that ends in {suffix}")
    if out.is_dir():
        raise ConfigError(f"--out {out}: is a folder; valid is a file")
    if out.exists() and not force:
        raise ConfigError(f"--out {out}: exists; choose another name or replace it with --force")


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a failure of the file system into an error that names the file."""
    try:
        yield
    except OSError as error:
        raise SdcError(f"{path}: cannot be written: {error.strerror or error}") from error


@contextlib.contextmanager
def whole_file(path: Path, *, parents: bool = False) -> Iterator[IO[bytes]]:
    """Open a file for writing; a reader sees the old one or the whole new one.

    Args:
        path: the file.
        parents: also create the folders it lies in.

    Raises:
        SdcError: it cannot be written.
    """
    part = part_of(path)
    try:
        with writing(path):
            if parents:
                path.parent.mkdir(parents=True, exist_ok=True)
            with part.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
    finally:
        # Missing after success; NotADirectoryError when a parent is a file.
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
