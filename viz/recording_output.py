"""Output of a recording: a file, a running viewer, or a port to which viewers connect.

An output never stops a simulation. The first failure causes one warning and ends the output; a
file is then cut after its last complete block.
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

from sdc_taichi.atomic_file import FileClaim, naming_errors
from sdc_taichi.errors import SdcError, SdcWarning

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.chunk import Chunk

DEFAULT_PORT = 9876
"""Default port of Rerun viewers."""
HOST = "127.0.0.1"
"""Address on which recordings are served; only programs on the same machine can connect to it."""
SCHEMES = ("rerun", "rerun+http", "rerun+https")
"""Schemes of the addresses of Rerun viewers."""
PROBE_S = 0.5
"""Longest time to wait for a connection to the port of a viewer, in s."""
FILE_BLOCK_S = 5.0
"""Longest time that a file system may take to write one block, in s."""
MAX_UNSENT_BYTES = 256_000_000
"""Largest amount of data that a viewer may be behind, in bytes.

A viewer that is further behind and does not catch up within ``VIEWER_WAIT_S`` counts as hanging.
"""
VIEWER_WAIT_S = 2.0
"""Longest wait for a slow viewer to catch up, and for Rerun to close an output, in s."""
DELETE_EVERY = 8
"""Number of closed recordings that are deleted at once, to end the four threads of each."""
_PROMPT_VIEWER_S = 1e-3  # a flush with 0 s does not tell if a viewer is up to date


class RecordingWarning(SdcWarning):
    """Warning that a recording has ended early, while the simulation run goes on."""


def import_rerun() -> Any:
    """Import and return ``rerun``, with its usage statistics off unless the user enabled them.

    Raises:
        SdcError: rerun-sdk is missing.
    """
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    # Rerun reads RUST_LOG once, on import. Its log is turned off because this module itself warns
    # of lost viewers and full disks.
    silence = "RUST_LOG" not in os.environ
    if silence:
        os.environ["RUST_LOG"] = "off"
    try:
        import rerun
    except ImportError as error:
        raise SdcError(
            f"recording needs rerun-sdk ({error}); install it with: pip install rerun-sdk"
        ) from None
    finally:
        if silence:
            os.environ.pop("RUST_LOG", None)
    return rerun


class RecordingOutput:
    """File and viewers of one recording.

    Args:
        file: file to write, or None.
        address: address of the viewer to connect to, or None.
        port: port of 127.0.0.1 to which viewers can connect, or None.
        name: name of the recording, which viewers show.
        keep_bytes: disk space that the recording must leave free, in bytes.

    Raises:
        SdcError: the file cannot be written, another process is writing it, or its disk has too
            little space.
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
        self._stream: rr.RecordingStream | None = None
        # Chunks of a block are collected and sent at once, because each call wakes Rerun's threads.
        self._chunks: list[Chunk] = []
        self._whole_bytes = 0
        self._unconfirmed_bytes = 0
        self.failed = False
        """True if the output has ended early."""
        self._claim = None if file is None else _claim(file, keep_bytes)
        if address is not None and not listens(address):
            self._fail(f"no viewer listens at {address}")

    @property
    def is_live(self) -> bool:
        """True if a viewer can show the recording during the run."""
        return self._file is None or self._port is not None

    @property
    def is_open(self) -> bool:
        """True if the file and the connections are open."""
        return self._stream is not None

    @property
    def place(self) -> str:
        """Path or address of the output, for warnings."""
        return str(self._file or self._address or served_at(self._port or 0))

    def open(self, blueprint: rrb.Blueprint) -> None:
        """Open the file and the connections, and send the blueprint.

        Args:
            blueprint: Rerun's description of the views of the recording.
        """
        rr = import_rerun()
        sinks: list[Any] = []
        self._stream = rr.RecordingStream("sdc_taichi")
        try:
            if self._file is not None:
                sinks.append(rr.FileSink(self._file))
            if self._address is not None:
                sinks.append(rr.GrpcSink(self._address))
            if self._port is not None:
                # Without HOST, Rerun would listen on every network interface of the machine.
                sinks.append(rr.GrpcServerSink(HOST, self._port))
            self._stream.set_sinks(*sinks)
            self._stream.send_recording_name(self._name)
            closable: Any = _ClosableBlueprint(blueprint)
            self._stream.send_blueprint(closable)
            closable.close()
        except (OSError, RuntimeError) as error:
            self._fail(f"cannot be opened ({error})")

    def has_room_for(self, size_bytes: int) -> bool:
        """Return True if a block can be sent, after checking that earlier blocks have arrived.

        Without space on the disk, or with a viewer that hangs, the output ends with a warning.

        Args:
            size_bytes: approximate size of the block, in bytes.
        """
        if self.failed:
            return False
        self._confirm_sent()
        if not self.failed and self._file is not None:
            try:
                free = shutil.disk_usage(self._file.parent).free
            except OSError as error:  # the folder was deleted during the run
                self._fail(f"cannot be written ({error})")
                return False
            if free < self._keep_bytes + size_bytes:
                self._fail(
                    f"{free / 1e6:.1f} MB left on the disk, {self._keep_bytes / 1e6:.1f} MB of it "
                    "kept for the results of the run"
                )
        behind = self._unconfirmed_bytes > MAX_UNSENT_BYTES
        if not self.failed and behind and not self._arrives_within(VIEWER_WAIT_S):
            self._fail(f"the viewer hangs, {self._unconfirmed_bytes / 1e6:.0f} MB behind")
        self._unconfirmed_bytes += size_bytes
        return not self.failed

    def add_columns(self, entity: str, times: Sequence[Any], columns: Iterable[Any]) -> None:
        """Add data of an entity to the current block, which ``send_block`` sends.

        Args:
            entity: path of the entity.
            times: time columns of Rerun, one per timeline.
            columns: component columns of Rerun, with one row per time.
        """
        from rerun.chunk import Chunk

        self._chunks.append(Chunk.from_columns(entity, times, columns))

    def send_static(self, components: Iterable[tuple[str, Any]]) -> None:
        """Send components of entities that are the same at all times.

        Args:
            components: paths of entities, each with a component or an archetype.
        """
        # Each call makes a chunk, of a kilobyte or more, so that those of an entity share a call.
        by_entity: dict[str, list[Any]] = {}
        for entity, component in components:
            by_entity.setdefault(entity, []).append(component)
        if self._stream is not None:
            for entity, parts in by_entity.items():
                self._stream.log(entity, *parts, static=True, strict=True)

    def send_block(self) -> None:
        """Send the current block; threads of Rerun write it while the simulation continues."""
        chunks, self._chunks = self._chunks, []
        if self._stream is not None:
            self._stream.send_chunks(chunks)

    def close(self) -> None:
        """Write the remaining blocks and the index, and release the claim on the file."""
        try:
            self._finish()
        finally:
            if self._claim is not None:
                self._claim.release()

    def _finish(self) -> None:
        """Write the remaining blocks and the index of the file."""
        if self._stream is None or self.failed:
            return
        self._confirm_sent(VIEWER_WAIT_S)
        if not self.failed and self._file is None and self._unconfirmed_bytes:
            self._fail("the viewer hangs")
        if self.failed:
            return
        self._stream.disconnect()
        self._stream = None
        _delete_closed_recordings()

    def _confirm_sent(self, viewer_s: float = _PROMPT_VIEWER_S) -> None:
        """Check whether all sent blocks have arrived, and end the output if it has failed.

        Args:
            viewer_s: longest wait for a viewer, in s; for a file it is ``FILE_BLOCK_S``.
        """
        if self._stream is None or not self._unconfirmed_bytes:
            return
        if self._file is None:
            if self._arrives_within(viewer_s):
                self._unconfirmed_bytes = 0
            elif self._address is not None and not listens(self._address):
                self._fail("the viewer has closed")
            return
        # The flush runs in a thread of its own because it may never return. While it runs, this
        # thread only waits: to free Python strings that were sent, the flush takes Python's lock.
        flush = _BackgroundCall(lambda s: s.flush(timeout_sec=FILE_BLOCK_S), self._stream)
        try:
            if not flush.ends_within(FILE_BLOCK_S):
                raise RuntimeError(f"nothing was written for {FILE_BLOCK_S:g} s")
            if flush.error is not None:
                raise flush.error
            self._whole_bytes = self._file.stat().st_size
            self._unconfirmed_bytes = 0
        except (OSError, RuntimeError) as error:
            full = self._file.exists() and shutil.disk_usage(self._file.parent).free < 4096
            self._fail("the disk is full" if full else f"cannot be written ({error})")

    def _arrives_within(self, seconds: float) -> bool:
        """Return True if all sent blocks arrive at the viewer within a time in s."""
        assert self._stream is not None
        try:
            self._stream.flush(timeout_sec=seconds)
        except RuntimeError:
            return False
        return True

    def _fail(self, reason: str) -> None:
        """End the output early, with a warning that gives the reason."""
        self.failed = True
        stream, self._stream = self._stream, None
        if stream is not None:
            # Disconnecting may never return, if a viewer hangs or a file cannot be written.
            if not _BackgroundCall(stream.disconnect).ends_within(VIEWER_WAIT_S):
                import rerun as rr

                rr.unregister_shutdown()
                _HANGING_STREAMS.append(stream)
            self._truncate_to_whole_blocks()
        self._warn(reason)

    def _truncate_to_whole_blocks(self) -> None:
        """Cut an incomplete block off the end of the file, because readers reject such a file."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                if self._whole_bytes == 0:
                    self._file.unlink()
                elif self._file.stat().st_size > self._whole_bytes:
                    os.truncate(self._file, self._whole_bytes)

    def _warn(self, reason: str) -> None:
        """Warn that the recording has ended early."""
        warnings.warn(
            f"recording {self.place}: {reason}; the run goes on without it",
            RecordingWarning,
            stacklevel=2,
        )


class _ClosableBlueprint:
    """Blueprint with a method to close the stream that Rerun opens to send it.

    Rerun itself leaves this stream open.
    """

    def __init__(self, blueprint: rrb.Blueprint) -> None:
        self._blueprint = blueprint
        self._stream: rr.RecordingStream | None = None

    def to_blueprint(self) -> Any:
        """Return the blueprint; Rerun calls this method before it sends a blueprint."""
        return self

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        """Send the blueprint to a stream of Rerun, and remember the stream for ``close``."""
        self._stream = stream
        self._blueprint._log_to_stream(stream)

    def close(self) -> None:
        """Close the stream on which Rerun sent the blueprint."""
        if self._stream is not None:
            self._stream.disconnect()
            self._stream = None


_HANGING_STREAMS: list[rr.RecordingStream] = []
"""Streams that hang; this list keeps them alive, because deleting such a stream never returns."""

_closed = itertools.count(1)


def _delete_closed_recordings() -> None:
    """Free the memory and threads of closed recordings, unless this process has open ones.

    With open recordings, ``rr.init`` would first flush these, which never returns if one hangs,
    and Rerun would afterwards log to the global recording only.
    """
    import rerun as rr

    if next(_closed) % DELETE_EVERY:
        return
    others = (issubclass(type(thing), rr.RecordingStream) for thing in gc.get_objects())
    if rr.get_global_data_recording() is None and not any(others):
        rr.init("sdc_taichi", init_logging=False)


class _BackgroundCall(threading.Thread):
    """Function call in a separate thread, for functions that may never return.

    After a write error, a flush of Rerun may never return, regardless of its timeout.
    """

    def __init__(self, call: Callable[..., object], *arguments: object) -> None:
        super().__init__(target=call, args=arguments, daemon=True)
        self.error: RuntimeError | None = None
        """Exception that the call raised, or None."""
        try:
            self.start()
        except RuntimeError as error:  # the system allows no further threads
            self.error = error

    def run(self) -> None:
        """Call the function and store the exception that it raises."""
        try:
            super().run()
        except RuntimeError as error:
            self.error = error

    def ends_within(self, seconds: float) -> bool:
        """Return True if the call ends within a time in s."""
        if self.error is None:
            self.join(seconds)
        return not self.is_alive()


def _claim(file: Path, keep_bytes: int) -> FileClaim:
    """Claim a file, so that no other process records to it, and check its disk space.

    Args:
        file: path of the file.
        keep_bytes: disk space that must remain free, in bytes.
    """
    claim = FileClaim(file)
    try:
        _check_room(file, keep_bytes)
    except BaseException:
        claim.release()
        raise
    return claim


def _check_room(file: Path, keep_bytes: int) -> None:
    """Check that a file can be written and its disk has space; on a full disk Rerun would hang.

    Args:
        file: path of the file.
        keep_bytes: disk space that must remain free, in bytes.
    """
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


def is_address(target: object) -> TypeGuard[str]:
    """Return True if a target is the address of a viewer, and False if it is a file."""
    return isinstance(target, str) and "://" in target


def check_address(address: str) -> str:
    """Check and return the address of a viewer.

    Raises:
        SdcError: the address does not have the form of a viewer's address.
    """
    valid = f"valid is such as {served_at(DEFAULT_PORT)}"
    try:
        parts = urlsplit(address)
        has_host_and_port = parts.hostname is not None and parts.port is not None
    except ValueError as error:
        raise SdcError(f"{address}: no address of a viewer ({error}); {valid}") from None
    if parts.scheme not in SCHEMES or parts.path != "/proxy" or not has_host_and_port:
        raise SdcError(f"{address}: no address of a viewer; {valid}")
    return address


def check_path(path: str | os.PathLike[str]) -> Path:
    """Check and return the path of a file to write a recording to.

    Raises:
        SdcError: the path does not end in .rrd, or no file can be written there.
    """
    if not isinstance(path, str | os.PathLike):
        raise SdcError(f"recorder {path!r}: valid is a file ending in .rrd, or a viewer's address")
    target = Path(path)
    if target.suffix != ".rrd":
        raise SdcError(f"{target}: a recording's name must end in .rrd")
    is_folder = os.path.isdir(target)
    if is_folder or not os.path.isdir(target.parent):
        wrong, state = (target, "is a folder") if is_folder else (target.parent, "is no folder")
        raise SdcError(f"{target}: cannot be written ({wrong} {state})")
    return target


def check_port(port: int) -> int:
    """Check that a port of this machine is free, and return it; 0 picks a free port.

    Raises:
        SdcError: the number is not a valid port, or the port is in use.
    """
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port < 65536:
        raise SdcError(f"port {port!r}: valid is 0 to 65535, 0 being any free one")
    with socket.socket() as probe:
        # With this option, which servers set too, a port whose last connections are closing counts
        # as free.
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
    """Return the address at which viewers find a recording served on a port of this machine."""
    return f"rerun+http://{HOST}:{port}/proxy"


def listens(address: str) -> bool:
    """Return True if a program accepts connections at the address of a viewer."""
    parts = urlsplit(address)
    assert parts.hostname is not None
    assert parts.port is not None
    try:
        socket.create_connection((parts.hostname, parts.port), PROBE_S).close()
    except OSError:
        return False
    return True
