"""A training that was published reaches the same figures again."""

from __future__ import annotations

import io

import pandas as pd
import pytest

from published import WAITING, cells, described, suite_of, tolerance
from sdc_taichi.benchmark.jobs import run_job
from sdc_taichi.benchmark.suite_run import row_jobs

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

pytestmark = pytest.mark.repo

SUITE, ROW, TORCH = "small", "ippo", "2.13.0"
"""A published row that learned, and the release of PyTorch by which it did."""


def test_a_training_reaches_what_was_published() -> None:
    if SUITE in WAITING:
        pytest.skip(f"suite {SUITE} waits to be published again: its models have changed")
    published, cell_of = described(SUITE), cells(SUITE)
    (job, *_) = row_jobs(suite_of(SUITE).chosen(rows=[ROW]), ())
    done = run_job(job, {})
    assert not done.error
    (reached,) = pd.read_parquet(io.BytesIO(done.rows)).to_dict("records")
    limit = tolerance(ROW, published)
    figure = reached["figure"]
    if torch.__version__.partition("+")[0] == TORCH and limit < 1e-5:
        assert figure == pytest.approx(cell_of[ROW]["figure"], rel=limit)
    low, high = cell_of[ROW]["lowest_figure"], cell_of[ROW]["highest_figure"]
    assert 2 * low - high <= figure <= 2 * high - low, "as far from the others as they are apart"
