"""Settings and fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import numpy as np
import pytest

# Sloppy arithmetic is a failure; code that means it says so with np.errstate.
np.seterr(divide="raise", invalid="raise")

# The same examples on every machine, and no time limit per example: first calls compile kernels.
hypothesis.settings.register_profile("reproducible", derandomize=True, deadline=None)
hypothesis.settings.load_profile("reproducible")
# Others: pytest --hypothesis-profile=others --hypothesis-seed=1
hypothesis.settings.register_profile("others", deadline=None)


LONGEST = (
    "stage", "plants", "guides", "report", "simulator", "envs_api", "hall_events", "ledgers", "cli",
    "recirculation", "optimum_solve", "transients", "kernels", "bench", "hall_commands", "viewer",
)  # fmt: skip
"""Test files that take longest. One that begins last would leave the other processes idle."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first."""
    places = {f"test_{name}": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of measured weather, carbon and workload files, named by SDC_REAL_DATA."""
    name = os.environ.get("SDC_REAL_DATA")
    if not name:
        pytest.skip("SDC_REAL_DATA is not set: no measured files")
    folder = Path(name).resolve()
    if not folder.is_dir():
        pytest.fail(f"SDC_REAL_DATA={name}: not a folder")
    return folder


@pytest.fixture
def user_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of imported files, which does not exist yet."""
    folder = tmp_path / "user"
    monkeypatch.setenv("SDC_TAICHI_DATA", str(folder))
    return folder


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a made-up study of a suite."""
    from made_studies import write_study

    return write_study(tmp_path_factory.mktemp("study") / "made-up")


@pytest.fixture
def one_torch_thread() -> Iterator[None]:
    """Lets PyTorch use one thread, as learners of this package do: sums have the same bits then."""
    torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
