"""A file under its name is whole, whatever happens while it is written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sdc_taichi.atomic_file import AtomicFile, atomic_write
from sdc_taichi.errors import SdcError


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def fail_halfway(path: Path, failure: Exception) -> None:
    with atomic_write(path) as file:
        file.write(b"half")
        raise failure


def test_readers_see_the_old_file_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    with atomic_write(path, parents=True) as file:
        file.write(b"one")
    with atomic_write(path) as file:
        file.write(b"two")
        assert path.read_bytes() == b"one"
    assert path.read_bytes() == b"two"
    assert names(path.parent) == ["a.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"old")
    for failure, error, message in (
        (KeyError("key"), KeyError, "key"),
        (OSError("disk"), SdcError, r"a\.txt: cannot be written: disk"),
    ):
        with pytest.raises(error, match=message):
            fail_halfway(path, failure)
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.txt"]


def test_a_folder_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(SdcError, match=r"missing.a: cannot be written: No such file"):
        AtomicFile(tmp_path / "missing" / "a")


def test_a_file_is_written_by_one_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with AtomicFile(path) as first:
        first.file.write(b"first")
        with pytest.raises(SdcError, match=r"a\.txt: another run is writing it; valid is"):
            AtomicFile(path)
        first.commit()
    with AtomicFile(path) as second:
        assert path.read_bytes() == b"first"
        second.commit()
    assert path.read_bytes() == b""
    assert names(tmp_path) == ["a.txt"]


def test_what_a_killed_process_left_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    code = (
        "import os, sys, pathlib; from sdc_taichi.atomic_file import AtomicFile;"
        "given = AtomicFile(pathlib.Path(sys.argv[1])); given.file.write(b'left over');"
        "given.file.flush(); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", code, path], timeout=60, check=False)
    assert names(tmp_path) == [".a.txt.part"]
    with atomic_write(path) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.skipif(os.name == "nt", reason="there are no locks on Windows")
def test_without_locks_nobody_is_kept_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("fcntl.flock", refuse)
    with atomic_write(tmp_path / "a") as file:
        file.write(b"whole")
        assert names(tmp_path) == [f".a.{os.getpid()}.part"]
    assert (tmp_path / "a").read_bytes() == b"whole"
    assert names(tmp_path) == ["a"]
