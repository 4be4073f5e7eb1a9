"""Curves of a training: CSV files of whole rows, and TensorBoard events."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sdc_taichi.atomic_file import atomic_write, naming_errors
from sdc_taichi.errors import SdcError

UPDATE = "update"
"""Column that every row has: the number of the update after which it was written."""


class CsvLog:
    """A table that grows by rows; a row with a new column widens it.

    Args:
        path: the file; rows that it has are gone on from.
        until: last update whose rows are kept; those of later ones are to be written anew.

    Raises:
        SdcError: the file cannot be read or written.
    """

    def __init__(self, path: Path, until: int) -> None:
        self._path = path
        self._columns: list[str] = []
        rows = self._read()
        kept = [row for row in rows if _is_whole(row, self._columns) and int(row[0]) <= until]
        if kept:
            self._write(kept)
        else:
            self._columns = []
            with naming_errors(path):
                path.unlink(missing_ok=True)

    def add(self, row: Mapping[str, Any]) -> None:
        """Append a row, whose first entry is ``update``.

        Raises:
            SdcError: the file cannot be written.
        """
        new = [name for name in row if name not in self._columns]
        if new:
            rows = self._read()
            self._columns += new
            self._write(rows)
        with naming_errors(self._path), self._path.open("ab") as file:
            file.write(_line([row.get(name, "") for name in self._columns]))

    def _read(self) -> list[list[str]]:
        """Rows of the file, once its columns are known."""
        if not self._path.exists():
            return []
        with naming_errors(self._path):
            text = self._path.read_text(encoding="utf-8", errors="replace")
        rows = list(csv.reader(text.splitlines()))
        self._columns = rows[0] if rows else []
        # A row without its end was being written when the process was killed.
        return rows[1:] if text.endswith("\n") else rows[1:-1]

    def _write(self, rows: Sequence[Sequence[str]]) -> None:
        width = len(self._columns)
        with atomic_write(self._path) as file:
            file.write(_line(self._columns))
            for row in rows:
                file.write(_line([*row, *[""] * (width - len(row))]))


class EventLog:
    """TensorBoard events of a training.

    Args:
        folder: folder of the events; None writes none.
        after: step after which events of an earlier process are void.

    Raises:
        SdcError: TensorBoard is not installed, or the folder cannot be written.
    """

    def __init__(self, folder: Path | None, *, after: int) -> None:
        self._writer: Any = None
        if folder is None:
            return
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise SdcError(
                'TensorBoard is not installed: pip install "sdc-taichi[train]", or go without: '
                "--set tensorboard=false"
            ) from None
        with naming_errors(folder):
            self._writer = SummaryWriter(str(folder), purge_step=after + 1)
        self._folder = folder

    def add(self, numbers: Mapping[str, float], step: int) -> None:
        """Write numbers by name.

        Args:
            numbers: the numbers.
            step: steps of all data centers together before them.

        Raises:
            SdcError: the events cannot be written.
        """
        if self._writer is not None:
            with naming_errors(self._folder):
                for name, value in numbers.items():
                    self._writer.add_scalar(name, value, step)

    def flush(self) -> None:
        """Write events that wait.

        Raises:
            SdcError: the events cannot be written.
        """
        if self._writer is not None:
            with naming_errors(self._folder):
                self._writer.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._writer is not None:
            with naming_errors(self._folder):
                self._writer.close()


def _is_whole(row: Sequence[str], columns: Sequence[str]) -> bool:
    return len(row) == len(columns) and columns[0] == UPDATE and row[0].isdecimal()


def _line(values: Sequence[Any]) -> bytes:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(values)
    return out.getvalue().encode()
