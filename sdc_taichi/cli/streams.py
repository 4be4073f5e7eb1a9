"""Standard output and error of the program, which never end a command that has work to do."""

from __future__ import annotations

import errno
import io
import os
import sys
from typing import IO, Any, TextIO


class _Stream(io.FileIO):
    """A standard stream that remembers its first failure and drops what it cannot write."""

    failure: OSError | None = None
    """Error of the first write that failed; None if all succeeded."""

    def write(self, data: object) -> int | None:  # type: ignore[override]
        """Write bytes, or drop them."""
        try:
            return super().write(data)  # type: ignore[arg-type]
        except OSError as error:
            self.failure = self.failure or error
            return memoryview(data).nbytes  # type: ignore[arg-type]


def guard_streams() -> None:
    """Have the standard streams drop what cannot be written, and escape what cannot be encoded."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if os.name == "nt" and stream.isatty():  # consoles of Windows are no files
            continue
        raw = _Stream(stream.fileno(), "w", closefd=False)
        # With PYTHONUNBUFFERED, Python's own streams write at once, and so do these.
        buffer: Any = raw if stream.write_through else io.BufferedWriter(raw)
        guarded = io.TextIOWrapper(
            buffer,
            encoding=stream.encoding,
            errors="backslashreplace",
            line_buffering=stream.line_buffering,
            write_through=stream.write_through,
        )
        setattr(sys, name, guarded)
        # Taichi takes another one for that of a notebook.
        setattr(sys, f"__{name}__", guarded)


def output_failure() -> str | None:
    """Message of the first failed write to standard output; None if there is none to report.

    A reader that wanted no more, such as ``head``, is no failure.
    """
    sys.stdout.flush()
    failure = getattr(_raw(sys.stdout), "failure", None)
    if failure is None or failure.errno == errno.EPIPE:
        return None
    return f"standard output: cannot be written: {failure.strerror}"


def _raw(stream: TextIO) -> IO[bytes] | None:
    """The file below a text stream, if there is one."""
    buffer = getattr(stream, "buffer", None)
    return getattr(buffer, "raw", buffer)
