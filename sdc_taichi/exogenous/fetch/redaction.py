"""Removal of secrets, such as keys and tokens, from texts that a user or a file may keep."""

from __future__ import annotations

import base64
import contextlib
import logging
import re
from collections.abc import Iterable, Iterator
from urllib.parse import unquote_plus

LEAST_CHARACTERS = 6
"""Shortest secret that is searched for; a shorter one would match parts of ordinary words."""
_SUBSTITUTE = b"KEY"
_LIBRARIES = ("requests", "urllib3")
_SECRET_NAMES = re.compile(
    "token|key|sig|secret|pass|pwd|pin|auth|cred|code|session|jwt|login|otp|hmac|ticket", re.I
)
"""Words in names of query parameters with a secret value."""
_RANDOM = re.compile(r"(?=.*\d)(?=.*[A-Za-z])[\w+/=~-]{16,}")
"""Values that look like a secret under any name of a query parameter."""


def secrets_of_query(query: str) -> set[str]:
    """Return the values of a query that are or may be secrets, as they stand and decoded.

    Args:
        query: query of an address, without ``?``.
    """
    secrets = set()
    for parameter in query.split("&"):
        name, _, value = parameter.rpartition("=") if "=" in parameter else ("", "", parameter)
        if _SECRET_NAMES.search(name) or _RANDOM.fullmatch(value):
            secrets |= {value, unquote_plus(value)}
    return secrets


class Redaction:
    """Replaces secrets in texts by ``KEY``, also where an echo has encoded them.

    Recognised are upper and lower case, percent encoding, escapes of JSON and HTML, hexadecimal
    digits, and base64 within a longer text.

    Args:
        secrets: the secrets, of which those with fewer than ``LEAST_CHARACTERS`` are ignored.
    """

    def __init__(self, secrets: Iterable[str]) -> None:
        # The longest secret comes first, because a secret may begin with another one.
        ordered = sorted((x.encode() for x in secrets if len(x) >= LEAST_CHARACTERS), key=len)
        forms = [form for secret in reversed(ordered) for form in _forms(secret)]
        self._pattern = re.compile(b"|".join(forms), re.IGNORECASE) if forms else None

    def in_bytes(self, content: bytes) -> bytes:
        """Return a content without the secrets."""
        return self._pattern.sub(_SUBSTITUTE, content) if self._pattern else content

    def in_text(self, text: str) -> str:
        """Return a text without the secrets."""
        content = text.encode(errors="surrogatepass")
        return self.in_bytes(content).decode(errors="surrogatepass")

    @contextlib.contextmanager
    def in_logs(self) -> Iterator[None]:
        """Remove the secrets from what the HTTP libraries log within the block."""

        def redact(record: logging.LogRecord) -> bool:
            record.msg, record.args = self.in_text(record.getMessage()), ()
            # Tracebacks quote addresses and headers as well.
            record.exc_info = record.exc_text = record.stack_info = None
            return True

        names = [x for x in logging.root.manager.loggerDict if x.split(".")[0] in _LIBRARIES]
        loggers = [logging.getLogger(name) for name in names]
        for logger in loggers:
            logger.addFilter(redact)
        try:
            yield
        finally:
            for logger in loggers:
                logger.removeFilter(redact)


def _forms(secret: bytes) -> Iterator[bytes]:
    """Yield regular expressions for a secret and its encodings."""
    yield b"".join(_escaped(byte) for byte in secret)
    yield secret.hex().encode()
    for before in range(3):
        # The characters of base64 depend on the position modulo 3, and those at the ends also on
        # the bytes before and after the secret.
        encoded = base64.b64encode(bytes(before) + secret)
        whole = encoded[-(-8 * before // 6) : 8 * (before + len(secret)) // 6]
        yield whole.replace(b"+", rb"(?:[+-]|%2b)").replace(b"/", rb"(?:\\?/|_|%2f)")


def _escaped(byte: int) -> bytes:
    """Return a regular expression for a byte, plain, percent-encoded, or escaped."""
    digits = b"%02x" % byte
    return (
        rb"(?:\\*"
        + re.escape(bytes([byte]))
        + rb"|%(?:25)*"
        + digits
        + rb"|\\+(?:u00|x)"
        + digits
        + rb"|&(?:amp;)*#(?:0*%d|x0*%x);)" % (byte, byte)
    )
