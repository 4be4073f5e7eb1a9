"""Where a recording goes: a file, a viewer that is connected to, or viewers that connect here.

A stream never stops or slows a simulation. What it cannot write is told in one warning, after which
it is lost; a file then ends with the last whole block.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import shutil
import socket
import threading
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import naming_errors
from sdc_taichi.errors import SdcError

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.chunk import Chunk

DEFAULT_PORT = 9876
"""On which viewers listen."""
HOST = "127.0.0.1"
SCHEMES = ("rerun", "rerun+http", "rerun+https")
PROBE_S = 0.5
"""How long to wait for a viewer's port."""
CONFIRM_S = 5.0
"""How long a file system may take for one block."""
MOST_BEHIND_BYTES = 256_000_000
"""What may wait for a slow viewer; with more it is waited for once, and then given up."""
WAIT_S = 2.0
_SOON_S = 1e-3
"""How long a block waits for a viewer that keeps up; 0 would not tell whether it does."""
_FOOTER = b"RRF2FOOT"
_FOOTER_END = 12


class RecordingWarning(UserWarning):
    """A recording has ended early; the run goes on without it."""


def import_rerun() -> Any:
    """The module ``rerun``, which reports nothing home unless the user has chosen otherwise.

    Raises:
        SdcError: rerun-sdk is missing.
    """
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    # Read once, on import. What it would say of a lost viewer or a full disk is said here.
    quiet = "RUST_LOG" not in os.environ
    if quiet:
        os.environ["RUST_LOG"] = "off"
    try:
        import rerun
    except ImportError as error:
        raise SdcError(
            f"recording needs rerun-sdk ({error}); install it with: pip install rerun-sdk"
        ) from None
    finally:
        if quiet:
            os.environ.pop("RUST_LOG", None)
    return rerun


def is_address(target: object) -> TypeGuard[str]:
    """Whether a target is the address of a viewer rather than a file."""
    return isinstance(target, str) and "://" in target


def check_address(address: str) -> str:
    """The address.

    Raises:
        SdcError: it is none.
    """
    valid = f"valid is such as {served_at(DEFAULT_PORT)}"
    try:
        parts = urlsplit(address)
        found = parts.hostname is not None and parts.port is not None
    except ValueError as error:
        raise SdcError(f"{address}: no address of a viewer ({error}); {valid}") from None
    if parts.scheme not in SCHEMES or parts.path != "/proxy" or not found:
        raise SdcError(f"{address}: no address of a viewer; {valid}")
    return address


def check_path(path: str | os.PathLike[str]) -> Path:
    """The path.

    Raises:
        SdcError: it cannot be that of a recording.
    """
    if not isinstance(path, str | os.PathLike):
        raise SdcError(f"recorder {path!r}: valid is a file ending in .rrd, or a viewer's address")
    target = Path(path)
    if target.suffix != ".rrd":
        raise SdcError(f"{target}: a recording's name must end in .rrd")
    if target.is_dir() or not target.parent.is_dir():
        wrong = target if target.is_dir() else target.parent
        state = "is a folder" if target.is_dir() else "is no folder"
        raise SdcError(f"{target}: cannot be written ({wrong} {state})")
    return target


def check_port(port: int) -> int:
    """A port of this machine that is free; 0 picks one.

    Raises:
        SdcError: it is no port, or taken.
    """
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port < 65536:
        raise SdcError(f"port {port!r}: valid is 0 to 65535, 0 being any free one")
    with socket.socket() as probe:
        # As servers do, so that a port whose last connections are just closing counts as free.
        if os.name == "posix":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise SdcError(
                f"port {port}: cannot be served on {HOST} ({error.strerror}); valid is a free "
                "port, or 0 for any"
            ) from None
        return int(probe.getsockname()[1])


def served_at(port: int) -> str:
    """Address of what is served on a port of this machine."""
    return f"rerun+http://{HOST}:{port}/proxy"


def listens(address: str) -> bool:
    """Whether something listens at an address."""
    parts = urlsplit(address)
    assert parts.hostname is not None
    assert parts.port is not None
    try:
        socket.create_connection((parts.hostname, parts.port), PROBE_S).close()
    except OSError:
        return False
    return True


class _Flat:
    """Values of a column end to end, as Rerun asks for them."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def as_arrow_array(self) -> Any:
        """The values."""
        return self._array


class Times(_Flat):
    """Times of rows, (rows,): steps, or datetime64[ns]."""

    def __init__(self, timeline: str, values: npt.NDArray[Any]) -> None:
        super().__init__(_arrow(values))
        self._timeline = timeline

    def timeline_name(self) -> str:
        """The timeline they are on."""
        return self._timeline


def column(descriptor: rr.ComponentDescriptor, values: npt.NDArray[Any]) -> rr.ComponentColumn:
    """A column with a list of numbers per row, (rows, n).

    Equal to ``columns`` of the archetype, at a third of its cost.
    """
    import rerun as rr

    return rr.ComponentColumn(descriptor, _Flat(_arrow(values)), offsets=_offsets(*values.shape))


def blobs(descriptor: rr.ComponentDescriptor, values: npt.NDArray[Any]) -> rr.ComponentColumn:
    """A column with the bytes of each row, (rows, n)."""
    import pyarrow as pa
    import rerun as rr

    raw = np.ascontiguousarray(values).view(np.uint8)
    inner = pa.ListArray.from_arrays(
        _offsets(*raw.shape),
        _arrow(raw),
        type=pa.list_(pa.field("item", pa.uint8(), nullable=False)),
    )
    return rr.ComponentColumn(descriptor, _Flat(inner), offsets=_offsets(len(values), 1))


def _offsets(rows: int, each: int) -> Any:
    return _arrow(np.arange(0, rows * each + 1, each, dtype=np.int32))


def _arrow(values: npt.NDArray[Any]) -> Any:
    """Values end to end in memory of Arrow's own; to let go of NumPy's takes Python's lock."""
    import pyarrow as pa

    buffer = pa.allocate_buffer(values.nbytes)
    np.frombuffer(buffer, values.dtype).reshape(values.shape)[...] = values
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), values.size, [None, buffer])


class Stream:
    """One recording on its way.

    Args:
        file: file to write, or None.
        address: viewer to connect to, or None.
        port: port of 127.0.0.1 to serve viewers on, or None.
        name: of the recording.
        keep_bytes: what the file leaves free on its disk.

    Raises:
        SdcError: the file cannot be written, or there is too little room for it.
    """

    def __init__(
        self,
        *,
        file: Path | None,
        address: str | None,
        port: int | None,
        name: str,
        keep_bytes: int,
    ) -> None:
        self._file, self._address, self._port, self._name = file, address, port, name
        self._keep_bytes = keep_bytes
        self._rec: rr.RecordingStream | None = None
        self._chunks: list[Chunk] = []
        """Of the block under way; each that is sent by itself wakes Rerun's threads."""
        self._whole_bytes = 0
        self._behind_bytes = 0
        self.lost = False
        """Whether it has ended early."""
        if file is not None:
            _check_room(file, keep_bytes)
        if address is not None and not listens(address):
            self._lose(f"no viewer listens at {address}")

    @property
    def live(self) -> bool:
        """Whether somebody may be watching."""
        return self._file is None or self._port is not None

    @property
    def started(self) -> bool:
        """Whether anything has been sent."""
        return self._rec is not None

    @property
    def place(self) -> str:
        """File or address."""
        return str(self._file or self._address or served_at(self._port or 0))

    def start(self, blueprint: rrb.Blueprint) -> None:
        """Open files and connections."""
        rr = import_rerun()
        sinks: list[Any] = []
        self._rec = rr.RecordingStream("sdc_taichi")
        try:
            if self._file is not None:
                sinks.append(rr.FileSink(self._file))
            if self._address is not None:
                sinks.append(rr.GrpcSink(self._address))
            if self._port is not None:
                # The default binds every interface of the machine.
                sinks.append(rr.GrpcServerSink(HOST, self._port))
            self._rec.set_sinks(*sinks)
            self._rec.send_recording_name(self._name)
            layout: Any = _Layout(blueprint)
            self._rec.send_blueprint(layout)
            layout.end()
        except (OSError, RuntimeError) as error:
            self._lose(f"cannot be opened ({error})")

    def room_for(self, size_bytes: int) -> bool:
        """Whether a block of this size may be sent; what was sent before is whole after this."""
        if self.lost:
            return False
        self._confirm()
        if not self.lost and self._file is not None:
            try:
                free = shutil.disk_usage(self._file.parent).free
            except OSError as error:  # its folder has gone
                self._lose(f"cannot be written ({error})")
                return False
            if free < self._keep_bytes + size_bytes:
                self._lose(
                    f"{free / 1e6:.1f} MB left on the disk, {self._keep_bytes / 1e6:.1f} MB of it "
                    "kept for the results of the run"
                )
        if not self.lost and self._behind_bytes > MOST_BEHIND_BYTES and not self._flushed(WAIT_S):
            self._lose(f"the viewer hangs, {self._behind_bytes / 1e6:.0f} MB behind")
        self._behind_bytes += size_bytes
        return not self.lost

    def columns(self, entity: str, times: Sequence[Any], columns: Iterable[Any]) -> None:
        """A block of an entity, which ``end_block`` sends."""
        from rerun.chunk import Chunk

        self._chunks.append(Chunk.from_columns(entity, times, columns))

    def static(self, entity: str, what: Any) -> None:
        """Send something that holds at all times."""
        if self._rec is not None:
            self._rec.log(entity, what, static=True, strict=True)

    def end_block(self) -> None:
        """Send the block, which Rerun's threads write out meanwhile."""
        chunks, self._chunks = self._chunks, []
        if self._rec is not None:
            self._rec.send_chunks(chunks)

    def close(self) -> None:
        """Write what is left, with the index of the file."""
        if self._rec is None or self.lost:
            return
        self._confirm(WAIT_S)
        if not self.lost and self._file is None and self._behind_bytes:
            self._lose("the viewer hangs")
        if self.lost:
            return
        self._rec.disconnect()
        self._rec = None
        _delete_ended()
        if self._file is not None and not _is_indexed(self._file):
            self._cut()
            self._warn("its index could not be written")

    def _confirm(self, viewer_s: float = _SOON_S) -> None:
        """Find out whether what was sent has arrived."""
        if self._rec is None or not self._behind_bytes:
            return
        if self._file is None:
            if self._flushed(viewer_s):
                self._behind_bytes = 0
            elif self._address is not None and not listens(self._address):
                self._lose("the viewer has closed")
            return
        # Not while Python computes: this lets go of texts that were sent, with Python's lock.
        writing = _Call(lambda rec: rec.flush(timeout_sec=CONFIRM_S), self._rec)
        try:
            if not writing.ends(CONFIRM_S):
                raise RuntimeError(f"nothing was written for {CONFIRM_S:g} s")
            if writing.failed is not None:
                raise writing.failed
            self._whole_bytes = self._file.stat().st_size
            self._behind_bytes = 0
        except (OSError, RuntimeError) as error:
            full = self._file.exists() and shutil.disk_usage(self._file.parent).free < 4096
            self._lose("the disk is full" if full else f"cannot be written ({error})")

    def _flushed(self, seconds: float) -> bool:
        """Whether what was sent to a viewer arrives in time."""
        assert self._rec is not None
        try:
            self._rec.flush(timeout_sec=seconds)
        except RuntimeError:
            return False
        return True

    def _lose(self, reason: str) -> None:
        self.lost = True
        rec, self._rec = self._rec, None
        if rec is not None:
            # Rerun waits for a viewer that hangs, and for a file that it cannot write, for ever.
            if not _Call(rec.disconnect).ends(WAIT_S):
                import rerun as rr

                rr.unregister_shutdown()
                _ABANDONED.append(rec)
            self._cut()
        self._warn(reason)

    def _cut(self) -> None:
        """Cut a block off that was not written whole, which readers would not pass."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                if self._whole_bytes == 0:
                    self._file.unlink()
                elif self._file.stat().st_size > self._whole_bytes:
                    os.truncate(self._file, self._whole_bytes)

    def _warn(self, reason: str) -> None:
        warnings.warn(
            f"recording {self.place}: {reason}; the run goes on without it",
            RecordingWarning,
            stacklevel=2,
        )


class _Layout:
    """A layout that knows what Rerun logs it to, which would otherwise never end."""

    def __init__(self, blueprint: rrb.Blueprint) -> None:
        self._blueprint = blueprint
        self._log: rr.RecordingStream | None = None

    def to_blueprint(self) -> Any:
        """What Rerun sends."""
        return self

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        self._log = stream
        self._blueprint._log_to_stream(stream)

    def end(self) -> None:
        """Let go of what has been sent."""
        if self._log is not None:
            self._log.disconnect()
            self._log = None


_ABANDONED: list[rr.RecordingStream] = []
"""Recordings that Rerun would wait for when they are deleted."""

DELETE_EVERY = 8
"""Recordings that have ended are deleted together; until then Rerun keeps four threads of each."""
_ended = itertools.count(1)


def _delete_ended() -> None:
    """Delete recordings that have ended, while there are no others, whoever made them.

    Rerun would write these out first, wait for ever for one that hangs, and log to no other than
    the global one any more.
    """
    import rerun as rr

    if next(_ended) % DELETE_EVERY:
        return
    others = (issubclass(type(thing), rr.RecordingStream) for thing in gc.get_objects())
    if rr.get_global_data_recording() is None and not any(others):
        rr.init("sdc_taichi", init_logging=False)


class _Call(threading.Thread):
    """A call beside the run that may never return.

    A flush of Rerun's may not, whatever its timeout, once writing has failed.
    """

    def __init__(self, call: Callable[..., object], *arguments: object) -> None:
        super().__init__(target=call, args=arguments, daemon=True)
        self.failed: RuntimeError | None = None
        try:
            self.start()
        except RuntimeError as error:  # as many threads as the system grants
            self.failed = error

    def run(self) -> None:
        try:
            super().run()
        except RuntimeError as error:
            self.failed = error

    def ends(self, seconds: float) -> bool:
        """Whether it ends in time."""
        if self.failed is None:
            self.join(seconds)
        return not self.is_alive()


def _check_room(file: Path, keep_bytes: int) -> None:
    """Make sure that the file can be opened and begun; Rerun waits for ever on a full disk."""
    with naming_errors(file):
        new = not file.exists()
        with file.open("ab"):
            pass
        if new:
            file.unlink()
        free = shutil.disk_usage(file.parent).free
    if free < keep_bytes:
        raise SdcError(
            f"{file}: {free / 1e6:.1f} MB left on the disk, expected {keep_bytes / 1e6:.1f} MB for "
            "the results of the run besides the recording"
        )


def _is_indexed(file: Path) -> bool:
    """Whether a recording was written to its end."""
    try:
        with file.open("rb") as opened:
            opened.seek(-_FOOTER_END, os.SEEK_END)
            return opened.read(len(_FOOTER)) == _FOOTER
    except OSError:
        return False
