"""Weather files by address: an EPW file, or a ZIP archive that holds one.

climate.onebuilding.org and the EnergyPlus weather pages offer typical years of thousands of
stations, the first as archives.
"""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from urllib.parse import unquote, urlsplit

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous.fetch.request import MOST_DOWNLOAD_BYTES, Request, Service
from sdc_taichi.user_file import decoding

SERVICE = Service(
    name="epw",
    title="EPW file from the web",
    licence="told by the publisher, not by the file",
    page="https://climate.onebuilding.org",
)
_ARCHIVE = b"PK\x03\x04"


def request_file(url: str) -> Request:
    """Request of a weather file.

    Args:
        url: address of an EPW file or of a ZIP archive with one.

    Raises:
        DataError: no address of the web, or one with a password.
    """
    try:
        parts = urlsplit(url)
    except ValueError:
        parts = urlsplit("")
    # HTTP libraries differ in whether they ask for a host whose name holds a space.
    if parts.scheme not in ("http", "https") or not parts.hostname or " " in parts.netloc:
        raise DataError(f"{shortened(url)}: expected an address that begins with https://")
    if parts.username is not None or parts.password is not None:
        raise DataError(f"{parts.hostname}: an address with a password, expected one without")
    name = unquote(parts.path.rsplit("/", 1)[-1])
    name = re.sub(r"[^A-Za-z0-9._-]", "-", name).strip(".-")[-100:] or "weather"
    # Equal names of different addresses are different files.
    name = f"{hashlib.sha256(url.encode()).hexdigest()[:8]}_{name}"
    hint = "by hand: save it with a browser, then data import FILE --site NAME"
    return Request(SERVICE, url, name, by_hand=hint, check=epw_bytes)


def epw_bytes(content: bytes, url: str) -> bytes:
    """The EPW file of an answer, taken from its archive if it lies in one.

    Raises:
        DataError: no EPW file, an archive with none or with several, or one that is too large or
            damaged.
    """
    if content.startswith(_ARCHIVE):
        content = _unpacked(content, url)
    if not content.lstrip(b"\xef\xbb\xbf").lstrip()[:9].upper().startswith(b"LOCATION,"):
        start = content[:20].decode("latin-1")
        raise DataError(
            f"{url}: begins with {shortened(start)}, expected an EPW file (LOCATION,...) or a ZIP "
            "archive that holds one"
        )
    return content


def _unpacked(content: bytes, url: str) -> bytes:
    """The one EPW file of a ZIP archive."""
    with decoding(url, "a ZIP archive", DataError):
        archive = zipfile.ZipFile(io.BytesIO(content))
        members = [x for x in archive.infolist() if x.filename.lower().endswith(".epw")]
        if len(members) != 1:
            names = ", ".join(x.filename for x in members[:5]) or "none"
            raise DataError(f"{url}: EPW files in the archive: {names}; expected one")
        with archive.open(members[0]) as member:
            # What the archive tells of sizes may be wrong.
            plain = member.read(MOST_DOWNLOAD_BYTES + 1)
    if len(plain) > MOST_DOWNLOAD_BYTES:
        raise DataError(
            f"{url}: the EPW file in the archive has more than {MOST_DOWNLOAD_BYTES / 1e6:,.1f} "
            "MB, the most that is valid"
        )
    return plain
