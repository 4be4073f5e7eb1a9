"""A file under its name is whole, whatever happens while it is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from sdc_taichi.atomic_file import AtomicFile, atomic_write, delete_leftovers, temporary_name
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


def test_a_discarded_file_never_appears_and_a_committed_one_stays(tmp_path: Path) -> None:
    given_up, kept = AtomicFile(tmp_path / "a"), AtomicFile(tmp_path / "b")
    assert names(tmp_path) == sorted(temporary_name(tmp_path / x).name for x in "ab")
    given_up.discard()
    kept.commit()
    kept.discard()
    assert names(tmp_path) == ["b"]


def test_a_folder_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(SdcError, match=r"missing.a: cannot be written: No such file"):
        AtomicFile(tmp_path / "missing" / "a")


def test_leftovers_of_killed_processes_go(tmp_path: Path) -> None:
    for name in (".a.txt.123.part", ".b.txt.123.part", "a.txt"):
        (tmp_path / name).write_bytes(b"")
    delete_leftovers(tmp_path / "a.txt")
    assert names(tmp_path) == [".b.txt.123.part", "a.txt"]
