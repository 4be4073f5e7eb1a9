"""Environment variables and cache folder of compiled kernels with which Taichi starts."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

from sdc_taichi.errors import RuntimeStateError, SdcWarning

CACHE_VARIABLE = "TI_OFFLINE_CACHE_FILE_PATH"
"""Environment variable that names Taichi's folder of compiled kernels; obeyed here too."""
LOCK_S = 60.0
"""Age, in s, from which a lock of the folder is one that a killed process left; Taichi holds it for
milliseconds."""
_LOCK, _INDEX = "ticache.lock", "ticache.tcb"
_OWN = {
    "ENABLE_TAICHI_HEADER_PRINT": "False",
    "TI_SKIP_VERSION_CHECK": "ON",
    # In notebooks it would print that there is one, and look for text to print at each launch.
    "TI_ENABLE_PYBUF": "0",
}
# Layout of the index of Taichi 1.7.4: length of the file, version, sum of sizes and number of
# kernels; then, for each kernel, its key twice, each after its length, its size and two times.
_HEADER_BYTES, _ENTRY_BYTES, _KEY_BYTES = 30, 170, 65
_VERSION = b"\1\0\7\0\4\0"


class KernelCacheWarning(SdcWarning):
    """Compiled kernels cannot be kept for the next process."""


@contextlib.contextmanager
def taichi_environment() -> Iterator[None]:
    """Hide the variables by which users set up other programs of Taichi, such as ``TI_ARCH``.

    Taichi also aborts the process where there is neither ``HOME`` nor ``XDG_CACHE_HOME``.
    """
    hidden = {name: os.environ.pop(name) for name in [*os.environ] if name.startswith("TI_")}
    hidden |= {name: os.environ[name] for name in _OWN if name in os.environ}
    own = dict(_OWN)
    if not {"HOME", "XDG_CACHE_HOME"} & os.environ.keys():
        own["HOME"] = os.sep
    os.environ.update(own)
    try:
        yield
    finally:
        for name in own:
            os.environ.pop(name, None)
        os.environ.update(hidden)


def kernel_folder() -> Path:
    """Folder in which Taichi keeps compiled kernels, fit to be used.

    On Linux it is that of all programs of Taichi, or that of ``CACHE_VARIABLE``. Where none can be
    written, it is a temporary one, which is deleted at exit, with a ``KernelCacheWarning``.

    Raises:
        RuntimeStateError: no temporary folder can be written either.
    """
    folder = usual_folder()
    try:
        _make_usable(folder)
    except OSError as error:
        temporary = _temporary_folder(folder)
        reason = error.strerror or error
        message = f"{folder}: cannot be written ({reason}); kernels are compiled in every process"
        warnings.warn(message, KernelCacheWarning, stacklevel=2)
        return temporary
    return folder


def usual_folder() -> Path:
    """Folder in which programs of Taichi keep their kernels."""
    import platformdirs

    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named).absolute()
    return Path(platformdirs.user_cache_dir("taichi", appauthor=False)) / "ticache"


def _make_usable(folder: Path) -> None:
    """Create the folder of kernels, and delete what killed processes and faults have left there.

    Raises:
        OSError: it cannot be written.
    """
    if not folder.is_absolute():  # the system knows no home of this user
        raise OSError("no absolute path")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass
    lock, index = folder / _LOCK, folder / _INDEX
    # Taichi would wait 2 s for it at every start, and then keep no kernels.
    with contextlib.suppress(FileNotFoundError):
        if time.time() - lock.stat().st_mtime > LOCK_S:
            lock.unlink()
    with contextlib.suppress(FileNotFoundError):
        with index.open("r+b") as opened:
            content = opened.read()
        if _is_damaged(content):
            index.unlink()


def _is_damaged(index: bytes) -> bool:
    """Whether an index of Taichi's kernel cache is damaged; reading it could exhaust memory.

    Taichi notices a wrong length of the file, but trusts the lengths within it.
    """
    if index[8:14] != _VERSION or int.from_bytes(index[:8], "little") != len(index):
        return False
    count = int.from_bytes(index[22:30], "little")
    length = _KEY_BYTES.to_bytes(8, "little")
    entries = range(_HEADER_BYTES, len(index), _ENTRY_BYTES)
    return _HEADER_BYTES + count * _ENTRY_BYTES != len(index) or not all(
        index[at : at + 8] == length == index[at + 8 + _KEY_BYTES : at + 16 + _KEY_BYTES]
        for at in entries
    )


def _temporary_folder(folder: Path) -> Path:
    """Folder of kernels that is deleted at exit.

    Args:
        folder: the one that cannot be written.

    Raises:
        RuntimeStateError: none can be created.
    """
    for parent in (None, "/dev/shm"):
        try:
            made = tempfile.mkdtemp(prefix="sdc-taichi-", dir=parent)
        except OSError:
            continue
        atexit.register(_delete_at_exit, made, os.getpid())
        return Path(made)
    raise RuntimeStateError(
        f"{folder}: cannot be written, nor can a temporary folder; valid is a folder for kernels "
        "in XDG_CACHE_HOME, or for temporary files in TMPDIR"
    )


def _delete_at_exit(folder: str, owner: int) -> None:
    """Delete a temporary folder of kernels, once Taichi, which writes to it last, has ended."""
    if os.getpid() != owner:
        return
    if "taichi" in sys.modules:
        with taichi_environment():
            sys.modules["taichi"].reset()
    shutil.rmtree(folder, ignore_errors=True)
