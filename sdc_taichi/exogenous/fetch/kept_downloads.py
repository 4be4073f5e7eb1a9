"""Downloads that are kept with their origin, so that a second fetch needs no network.

They lie in the folder of imported files, under ``downloads/SERVICE``: each file as the service
sent it, without the key, and beside it ``NAME.origin.json`` with its address, time, checksum and
licence. A file counts as kept while both agree.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import DataError, SdcError
from sdc_taichi.exogenous.fetch.download import Downloaded, Patience, download
from sdc_taichi.exogenous.fetch.request import Request, Service
from sdc_taichi.exogenous.registry import user_data_dir
from sdc_taichi.user_file import read_bytes

FORMAT = "sdc-download/1"
"""Version of the files that tell origins."""
_MOST_ORIGIN_BYTES = 100_000


@dataclass(frozen=True)
class Kept:
    """An answer of a service that is kept."""

    path: Path
    """File that holds the answer."""
    content: bytes
    """The answer."""
    origin: dict[str, Any]
    """Address without the key, time in UTC, checksum, licence and publisher."""


def downloads_dir(service: Service, data_dir: Path | None = None) -> Path:
    """Folder in which answers of a service are kept."""
    return user_data_dir(data_dir) / "downloads" / service.name


def fetch(
    requests: Sequence[Request],
    data_dir: Path | None = None,
    *,
    refresh: bool = False,
    patience: Patience | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Kept]:
    """Answers to requests: those that are kept, and the others downloaded and kept.

    Args:
        requests: what is asked.
        data_dir: folder of imported files instead of the user's.
        refresh: download what is kept, too.
        patience: limits of time of each download.
        progress: told the number of answers that are there, and of all.

    Raises:
        DataError: an answer cannot be had or kept; those before it are kept.
    """
    found = []
    for done, request in enumerate(requests):
        progress(done, len(requests))
        kept = None if refresh else _kept(request, data_dir)
        found.append(kept or _keep(request, download(request, patience), data_dir))
    progress(len(requests), len(requests))
    return found


def keep_file(request: Request, path: Path, data_dir: Path | None = None) -> Kept:
    """Keep a file that a user has downloaded as the answer to a request.

    Raises:
        DataError: the file cannot be read, or is not what the request asks for.
    """
    content = read_bytes(path, request.most_bytes, DataError)
    request.check(content, str(path))
    return _keep(request, Downloaded(content), data_dir)


def write_file(path: Path, content: bytes) -> Path:
    """Write a file made of answers; readers see the old one or the whole new one.

    Raises:
        DataError: the file cannot be written.
    """
    try:
        with atomic_write(path, parents=True) as file:
            file.write(content)
    except SdcError as error:
        raise DataError(str(error)) from None
    return path


def _paths(request: Request, data_dir: Path | None) -> tuple[Path, Path]:
    """Files of an answer and of its origin."""
    path = downloads_dir(request.service, data_dir) / request.file_name
    return path, path.with_name(f"{path.name}.origin.json")


def _kept(request: Request, data_dir: Path | None) -> Kept | None:
    """The answer that is kept; None if there is none, or it is damaged or to another request."""
    path, origin_path = _paths(request, data_dir)
    if not (path.is_file() and origin_path.is_file()):
        return None
    try:
        origin = json.loads(read_bytes(origin_path, _MOST_ORIGIN_BYTES, DataError))
        content = read_bytes(path, request.most_bytes, DataError)
    except (ValueError, RecursionError):
        return None
    asked = {"format": FORMAT, "url": request.url, "sha256": hashlib.sha256(content).hexdigest()}
    if not isinstance(origin, dict) or any(origin.get(k) != v for k, v in asked.items()):
        return None
    if not isinstance(origin.get("retrieved"), str):
        return None
    return Kept(path, content, origin)


def _keep(request: Request, downloaded: Downloaded, data_dir: Path | None) -> Kept:
    path, origin_path = _paths(request, data_dir)
    origin = {
        "format": FORMAT,
        "service": request.service.title,
        "licence": request.service.licence,
        "url": request.url,
        "retrieved": datetime.now(UTC).isoformat(timespec="seconds"),
        "sha256": hashlib.sha256(downloaded.content).hexdigest(),
        "bytes": len(downloaded.content),
        "etag": downloaded.etag,
        "last_modified": downloaded.last_modified,
    }
    write_file(path, downloaded.content)
    write_file(origin_path, json.dumps(origin, indent=1).encode())
    return Kept(path, downloaded.content, origin)
