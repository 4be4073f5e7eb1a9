"""Damage to texts, bytes and numbers that all areas share."""

from __future__ import annotations

import gzip

import numpy as np

SCALARS = (
    "0", "-1", "-0.0", "1", "0.5", "2", "99", "1000", "1e-12", "1e-30", "1e-300", "1e6", "1e12",
    "1e30", "1e308", "1e400", "-1e308", "9223372036854775808", "1" + "0" * 400, "nan", "inf",
    "-inf", "infinity", "true", "no", "null", "", " ", "²", "١٢", "½", "1_000", "0x10", "1,5",
    "1:30.5", "190:20:30", "2001-01-01", "02-29", "13-01", "<script>alert(1)</script>",
    "../../etc/passwd", "/dev/zero", "/dev/stdin", "%s%n{0}", "int", "float", "a[b",
    "\x1b[31mred\x07", "\u202eevil", "line\nbreak", "\x00", "\ud800", "x" * 300, "é" * 200,
    "x" * 100_000,
)  # fmt: skip
"""Texts that stand where a value is expected."""

_TAGGED = [
    f"!!{tag} {node}"
    for tag in ("null", "bool", "int", "float", "str", "seq", "map", "merge", "value")
    for node in ("x", "''", "[1]", "{a: 1}")
]
YAML_VALUES = (
    *_TAGGED,
    ".nan", ".inf", "-.inf", "~", "''", "[]", "{}", "[[]]", "[1, [2, [3]]]", "{a: 1}", "[null]",
    "!!bool abc", "!!timestamp abc", "!!float x", "!!int ''", "!!binary '#'", "!!set {a, b}",
    "!!omap [a: 1]", "!!python/object/apply:os.abort []", "!!python/name:os.system", "!x y",
    "&a [*a]", "&a {b: *a}", "*nowhere", '"\\e[31m\\a\\0"', '"\\u202E"', '"\\ud800"', "|", "? ",
    "'open", "@", "`", "{int: 1, float: 2, 'a[b': 3}", "{1: 2}", "{[1]: 2}", "{a: 1, a: 2}",
    "{<<: {a: 1}}", "{!!merge m: [{a: 1}]}", "{!!value v: 1}", "=", "1_000", "'1_0'", "'١'",
    "[" * 3000 + "]" * 3000, "{a: " * 300 + "1" + "}" * 300, "[" + "1, " * 20_000 + "1]",
)  # fmt: skip
"""YAML that stands where a value is expected."""

JSON_VALUES = (
    "null", "true", "[]", "{}", "[null]", '{"a": 1}', '""', '"1"', '"²"', "NaN", "Infinity",
    "-Infinity", "1e999", "-1", "0", "1e308", "1e-308", "0.5", "1" + "0" * 400, '"\\ud800"',
    '"\\u001b[31m"', "[[1, 2], [3]]", '{"a": 1, "a": 2}', "[" * 100_000, "[" * 900 + "]" * 900,
    '"' + "x" * 100_000 + '"',
)  # fmt: skip
"""JSON that stands where a value is expected."""

CODINGS = ("utf-16", "utf-8-sig", "cp500", "utf-7", "utf-32-be")


def scalar(rng: np.random.Generator) -> str:
    """A text that stands where a value is expected."""
    return SCALARS[int(rng.integers(len(SCALARS)))]


def lone_surrogates_escaped(text: str) -> str:
    """A text that UTF-8 can hold."""
    return text.encode("utf-8", "backslashreplace").decode()


def damaged_bytes(rng: np.random.Generator, content: bytes) -> bytes:
    """Content of a file, cut, overwritten, doubled, or of another kind."""
    if not content:
        return content
    at, to = sorted(int(i) for i in rng.integers(0, len(content) + 1, 2))
    kind = int(rng.integers(12))
    if kind == 0:
        return b""
    if kind in (1, 2):
        return content[:at]
    if kind == 3:
        return content[:at] + content[to:]
    if kind == 4:
        return content[:to] + content[at:]
    if kind == 5:
        return content[:at] + rng.bytes(int(rng.integers(1, 40))) + content[at:]
    if kind == 6:
        return gzip.compress(content, mtime=0)
    if kind == 7:
        return content[:at] + b"\x00" * int(rng.integers(1, 5000)) + content[at:]
    if kind == 8:
        return rng.bytes(int(rng.integers(1, 4000)))
    out = bytearray(content)
    for place in rng.integers(0, len(out), int(rng.integers(1, 12))):
        out[place] = int(rng.choice([0, 9, 10, 13, 34, 44, 45, 46, 48, 57, 58, 123, 128, 255]))
    return bytes(out)


def damaged_text(rng: np.random.Generator, text: str) -> bytes:
    """A text whose lines, ends of lines or coding are others, or whose bytes are damaged."""
    lines = text.split("\n")
    at = int(rng.integers(len(lines)))
    kind = int(rng.integers(10))
    if kind == 0:
        lines.insert(at, lines[int(rng.integers(len(lines)))])
    elif kind == 1:
        del lines[at]
    elif kind == 2:
        lines[at] += "\x1b[2J\x00\x07"
    elif kind == 3:
        lines[at] = "\t" + lines[at]
    elif kind == 4:
        lines[at] = lines[at].replace(":", "=", 1)[:-1]
    elif kind == 5:
        return "\r\n".join(lines).encode()
    elif kind == 6:
        return text.encode(CODINGS[int(rng.integers(len(CODINGS)))], "replace")
    else:
        return damaged_bytes(rng, text.encode())
    return "\n".join(lines).encode()
