"""Where a recording may go: a file, the address of a viewer, or a port that viewers connect to."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import TypeGuard
from urllib.parse import urlsplit

from sdc_taichi.errors import SdcError

DEFAULT_PORT = 9876
"""Port on which Rerun viewers listen."""
HOST = "127.0.0.1"
"""Address of this machine on which recordings are served; other machines cannot reach it."""
SCHEMES = ("rerun", "rerun+http", "rerun+https")
"""Schemes of the addresses of Rerun viewers."""
PROBE_S = 0.5
"""Time to wait for the port of a viewer, in s."""


def is_address(target: object) -> TypeGuard[str]:
    """Whether a target is the address of a viewer rather than a file."""
    return isinstance(target, str) and "://" in target


def check_address(address: str) -> str:
    """Check and return the address of a viewer.

    Raises:
        SdcError: the address is not that of a viewer.
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
    """Check and return a free port of this machine; 0 picks one.

    Raises:
        SdcError: the number is not that of a port, or the port is taken.
    """
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port < 65536:
        raise SdcError(f"port {port!r}: valid is 0 to 65535, 0 being any free one")
    with socket.socket() as probe:
        # Servers set this too; a port whose last connections are just closing counts as free.
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
    """Address at which viewers find a recording that is served on a port of this machine."""
    return f"rerun+http://{HOST}:{port}/proxy"


def listens(address: str) -> bool:
    """Whether something listens at the address of a viewer."""
    parts = urlsplit(address)
    assert parts.hostname is not None
    assert parts.port is not None
    try:
        socket.create_connection((parts.hostname, parts.port), PROBE_S).close()
    except OSError:
        return False
    return True
