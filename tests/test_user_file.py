"""Files and numbers that users name and write: refused by kind and size, read in one way."""

from __future__ import annotations

import io
import os
import threading
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sdc_taichi.config import load_config, load_json, load_yaml
from sdc_taichi.errors import MOST_CHARACTERS, DataError, SdcError
from sdc_taichi.exogenous import read_carbon, read_epw, read_workload
from sdc_taichi.exogenous.importing import file_kind
from sdc_taichi.number_text import parse_number, parse_whole
from sdc_taichi.run.folder_reader import read_run
from sdc_taichi.sim import snapshot
from sdc_taichi.user_file import decoding, open_input, open_parquet, read_bytes, read_parquet

READERS: dict[str, Callable[[Path], Any]] = {
    "weather.epw": read_epw,
    "carbon.csv": lambda path: read_carbon(path, -5.0),
    "workload.csv": read_workload,
    "any.csv": file_kind,
    "state.npz": snapshot.read,
    "config.yaml": load_config,
    "dc_config.json": load_config,
}


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file_is_not_read(name: str, tmp_path: Path) -> None:
    read, pipe = READERS[name], tmp_path / name
    os.mkfifo(pipe)
    for path, message in (
        (pipe, "is a pipe; valid is a file"),
        (Path("/dev/zero"), "is a device; valid is a file"),
        (tmp_path, "is a folder; valid is a file"),
        (tmp_path / "absent", "no such file"),
        (tmp_path / ("x" * 300), "File name too long"),
        (tmp_path / "a\0b", "is no name of a file"),
    ):
        with pytest.raises(SdcError, match=message):
            read(path)


@pytest.mark.parametrize("name", [name for name in READERS if name != "state.npz"])
def test_files_that_are_too_large_are_not_read(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(SdcError, match=r": has 1,099,511\.6 MB; valid is at most"):
        READERS[name](path)


def test_a_run_folder_is_read_as_carefully(tmp_path: Path) -> None:
    with pytest.raises(SdcError, match="no such folder"):
        read_run("x" * 5000)
    with pytest.raises(SdcError, match="no such folder"):
        read_run("a\0b")
    os.mkfifo(tmp_path / "metrics.json")
    with pytest.raises(SdcError, match="is a pipe"):
        read_run(tmp_path)


def test_a_snapshot_that_is_larger_than_its_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    np.savez_compressed(path, soc=np.zeros(1_000_000))
    with pytest.raises(SdcError, match=r"state\.npz: soc has shape \(1000000,\), 8\.0 MB; valid"):
        snapshot.read(path)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("soc.npy", b"\x93NUMPY\x02\x00" + (1 << 30).to_bytes(4, "little"))
    with pytest.raises(SdcError, match=r"state\.npz: cannot be read as array soc"):
        snapshot.read(path)


def test_a_file_takes_the_memory_of_its_content(tmp_path: Path) -> None:
    path = tmp_path / "small"
    path.write_bytes(b"x" * 1000)
    tracemalloc.start()
    assert read_bytes(path, 2**28) == b"x" * 1000
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 1e6
    with pytest.raises(SdcError, match=r"valid is at most 0\.0 MB"):
        read_bytes(path, 999)
    if Path("/proc/self/status").exists():  # a file whose size is 0 until it is read
        assert read_bytes("/proc/self/status", 2**20).startswith(b"Name:")
        with pytest.raises(SdcError, match="has more than 0"):
            read_bytes("/proc/self/status", 10)


def test_errors_are_of_one_class_and_keep_their_cause(tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught, open_input(tmp_path / "a", error=DataError):
        pass
    assert isinstance(caught.value.__cause__, FileNotFoundError)
    for failed in (KeyError("a"), MemoryError(), EOFError(), RecursionError("x" * 999)):
        with pytest.raises(DataError) as caught, decoding("a", "a table", DataError):
            raise failed
        assert str(caught.value).startswith("a: cannot be read as a table: ")
        assert len(str(caught.value)) < MOST_CHARACTERS + 10
    with pytest.raises(SdcError, match="as it is"), decoding("a", "a table", DataError):
        raise SdcError("as it is")


# Numbers


@pytest.mark.parametrize("text", ["²", "1_000", "0x10", "inf", "nan", "", "1e999", "1:30", "1,5"])
def test_texts_that_are_no_number(text: str) -> None:
    with pytest.raises(ValueError, match="is no finite decimal number"):
        parse_number(text)
    with pytest.raises(ValueError, match="is no whole number"):
        parse_whole(text)


@pytest.mark.parametrize(
    ("text", "value"), [("5", 5), (" -5 ", -5), ("+5.", 5), (".5e1", 5), ("5E-1", 0.5), ("007", 7)]
)
def test_numbers(text: str, value: float) -> None:
    assert parse_number(text) == value
    if "." not in text and "E" not in text:
        assert parse_whole(text) == value
    assert load_json(f"[{value}]") == [value]


def test_numbers_of_yaml_are_decimal() -> None:
    values = load_yaml("[1, -1.5, 1.0e-3, .inf, 1:30, 1:30.5, 017, 0x1f, 1_000, 2001-02-03, 1e3]")
    rest = ["1:30", "1:30.5", 17, "0x1f", "1_000", "2001-02-03", "1e3"]
    assert values == [1, -1.5, 0.001, np.inf, *rest]


def test_a_merge_key_is_a_key_like_any_other() -> None:
    rows = "a: &a {k: 1}\nb: {<<: *a, k: 2}\nc: ="
    assert load_yaml(rows) == {"a": {"k": 1}, "b": {"<<": {"k": 1}, "k": 2}, "c": "="}


@pytest.mark.parametrize("text", ["²", "0", "1_0", "١", "99999", "-1", "1.0"])
def test_the_number_of_threads_is_one_that_a_machine_has(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sdc_taichi.kernels.compiler import runtime

    monkeypatch.setenv("SDC_TAICHI_THREADS", text)
    with pytest.raises(SdcError, match="valid is a positive integer up to 1024"):
        runtime._thread_limit()


@pytest.mark.parametrize("row_group", [None, 1])
def test_parquet_files_are_read_in_the_calling_thread(row_group: int | None) -> None:
    threads = set()

    class Watched(io.BytesIO):
        """File that notes the threads that read it."""

        def read(self, size: int | None = -1) -> bytes:
            threads.add(threading.get_ident())
            return super().read(size)

    file = Watched()
    table = pa.table({f"column{i}": np.random.default_rng(i).random(2_000) for i in range(40)})
    pq.write_table(table, file, row_group_size=500)
    read = read_parquet(open_parquet(file), ["column3", "column7", "column39"], row_group)
    expected = table.select([3, 7, 39])
    assert read.equals(expected if row_group is None else expected.slice(500, 500))
    assert read_parquet(open_parquet(file)).equals(table)
    assert threads == {threading.get_ident()}
