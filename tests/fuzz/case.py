"""One case: its random numbers and folder, how it ended, and what counts as a clean error."""

from __future__ import annotations

import contextlib
import io
import shutil
import signal
import traceback
import unicodedata
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import taichi  # noqa: F401  whose import warns

from sdc_taichi import SdcError
from sdc_taichi.cli import app
from sdc_taichi.errors import MOST_CHARACTERS

T = TypeVar("T")

LONGEST_ERROR = MOST_CHARACTERS + 20
"""Characters of the longest line of error, the names of files not counted: those of the message and
what stands before and in place of what is left out."""
OUTPUT = "out"
"""Folder beside the inputs in which a case may write."""
TIME_LIMIT_S = 60
"""Longest time for a case, compilation of kernels included."""


class DefectError(AssertionError):
    """The package did what it must not, or did not do what it must."""


@dataclass
class Scratch:
    """Random numbers of a case, and the folder that holds its inputs."""

    rng: np.random.Generator
    """Source of everything that is random in the case."""
    folder: Path
    """Folder of the input files, which the package must leave as they are."""
    named: list[str] = field(default_factory=list)
    """Texts of which an error has to name one; none is any error."""
    sealed: dict[Path, bytes] = field(default_factory=dict)
    """Content of the input files."""

    def write(self, name: str, content: bytes) -> Path:
        """Write an input file, which an error has to name."""
        path = self.folder / name
        path.write_bytes(content)
        self.sealed[path] = content
        self.named.append(name)
        return path

    def output(self, name: str) -> Path:
        """Path of a file that a case may write."""
        folder = self.folder / OUTPUT
        folder.mkdir(exist_ok=True)
        return folder / name

    def chance(self, share: float) -> bool:
        """True in this share of the cases."""
        return bool(self.rng.random() < share)

    def pick(self, options: Sequence[T]) -> T:
        """One of the options, each equally likely."""
        return options[int(self.rng.integers(len(options)))]


Area = Callable[[Scratch], None]


@dataclass(frozen=True)
class Outcome:
    """How a case ended."""

    area: str
    """Name of the area."""
    number: int
    """Number of the case in its area."""
    kind: Literal["error", "run", "failure"]
    """Clean error, correct run or failure."""
    text: str
    """The line of error, or what failed and where."""


def run_case(name: str, area: Area, seed: int, number: int, keep: Path) -> Outcome:
    """Run a case in a folder of its own below ``keep``, which is left there if the case fails."""
    folder = keep / f"{name}-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    scratch = Scratch(rng, folder)
    try:
        with _time_limit(), _own_warnings_alone():
            kind, text = _clean_or_correct(area, scratch)
    except Exception as error:
        lines = "".join(traceback.format_exception(error, limit=-8)).splitlines()
        text = "\n".join(line[:600] for line in lines)
        (folder / "failure.txt").write_text(text, errors="backslashreplace")
        return Outcome(name, number, "failure", text)
    shutil.rmtree(folder, ignore_errors=True)
    return Outcome(name, number, kind, text)


def _clean_or_correct(area: Area, scratch: Scratch) -> tuple[Literal["error", "run"], str]:
    kind: Literal["error", "run"] = "run"
    line = ""
    try:
        area(scratch)
    except SdcError as error:
        kind, line = "error", printed(error)
        check_line(line, scratch)
    for path, content in scratch.sealed.items():
        if path.read_bytes() != content:
            raise DefectError(f"{path.name} has been changed")
    others = {p for p in scratch.folder.iterdir() if p.name != OUTPUT} - set(scratch.sealed)
    if others:
        raise DefectError(f"left beside the inputs: {sorted(p.name for p in others)}")
    return kind, line


def printed(error: Exception) -> str:
    """An error as the command line prints it."""
    with contextlib.redirect_stderr(io.StringIO()) as stderr:
        app._print_error(error)
    return stderr.getvalue()


def check_line(text: str, scratch: Scratch) -> None:
    """Check that a text is one printable line of bearable length that names what is wrong.

    Raises:
        DefectError: it is not.
    """
    line = text.removesuffix("\n")
    if not line.startswith("error: ") or line == "error: ":
        raise DefectError(f"no line of error: {line[:200]!r}")
    if "unexpected;" in line:
        raise DefectError(f"an error that nobody expected: {line[:500]!r}")
    odd = sorted({c for c in line if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")})
    if odd:
        raise DefectError(f"characters {odd} in {line[:500]!r}")
    length = len(line.replace(str(scratch.folder), ""))
    if length > LONGEST_ERROR:
        raise DefectError(f"{length} characters: {line[:500]!r}")
    if scratch.named and not any(name in line for name in scratch.named):
        raise DefectError(f"names none of {scratch.named}: {line[:500]!r}")


@contextlib.contextmanager
def _own_warnings_alone() -> Iterator[None]:
    """Refuse warnings of Python, NumPy and other libraries, which tell a user nothing."""
    with (
        warnings.catch_warnings(record=True) as caught,
        np.errstate(divide="warn", over="warn", invalid="warn"),
    ):
        warnings.simplefilter("always")
        yield
    for warning in caught:
        if not warning.category.__module__.startswith("sdc_taichi"):
            where = f"{warning.filename}:{warning.lineno}"
            raise DefectError(f"{warning.category.__name__} at {where}: {warning.message}")


@contextlib.contextmanager
def _time_limit() -> Iterator[None]:
    """Raise an error after ``TIME_LIMIT_S``, where the system has alarms."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def stop(*_: object) -> None:
        raise DefectError(f"no end within {TIME_LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(TIME_LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
