"""Jobs on a real Ray cluster of two nodes on this machine, and what is lost there."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import toy_jobs
from sdc_taichi.benchmark.executors import Executor, JobSummary, run_jobs
from sdc_taichi.benchmark.jobs import Job, digest_of
from sdc_taichi.benchmark.ray_cluster import RayCluster
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.errors import ConfigError, RuntimeStateError
from test_jobs import content_of, draws

pytest.importorskip("ray", reason="ray is not installed: make test-train")

DRIVER = """
import sys
from pathlib import Path
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.cli.jobs import JobOptions, job_session
from test_jobs import STUDY, draws
if __name__ == "__main__":
    store, jobs = ResultStore(Path(sys.argv[1])), draws(8, seconds=0.3)
    with job_session(store, STUDY, JobOptions(ray=sys.argv[2], resume=True)) as session:
        session.run("draws", jobs, len(jobs))
    session.finish()
"""


@contextlib.contextmanager
def driver(folder: Path, address: str) -> Iterator[subprocess.Popen[str]]:
    """A process, and a group of its own, that does a study of eight draws and has done some."""
    with subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(folder), address],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        deadline = time.monotonic() + 60
        while not list(folder.rglob("metrics.json")) and time.monotonic() < deadline:
            time.sleep(0.05)
        yield process


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """Folder of Ray's sockets, whose paths must be short; nothing of Ray runs there afterwards."""
    with pytest.MonkeyPatch.context() as patch:
        folder = Path(tempfile.mkdtemp(dir="/tmp" if os.path.isdir("/tmp") else None))
        for name in ("HOME", "RAY_TMPDIR"):
            patch.setenv(name, str(folder))
        patch.setenv("RAY_AUTH_MODE", "disabled")
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        yield folder
        deadline = time.monotonic() + 20
        while str(folder) in (running := processes()) and time.monotonic() < deadline:
            time.sleep(0.1)
        shutil.rmtree(folder, ignore_errors=True)
        assert str(folder) not in running


def processes() -> str:
    """Command lines of all processes."""
    return subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def nodes(folder: Path) -> Iterator[Any]:
    """A cluster of two nodes with a processor each, which does without network and dashboard."""
    from ray.cluster_utils import Cluster

    often = {"health_check_period_ms": 500}  # so that a lost node is missed soon
    head = {"num_cpus": 1, "include_dashboard": False, "_system_config": often}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    cluster.add_node(num_cpus=1)
    yield cluster
    cluster.shutdown()


@pytest.fixture(scope="module")
def cluster(nodes: Any) -> Iterator[RayCluster]:
    """The cluster, whose workers serve all tests that do not end the driver."""
    with RayCluster(nodes.address) as cluster:
        yield cluster


def test_results_equal_those_of_one_process_to_the_bit(tmp_path: Path, cluster: RayCluster) -> None:
    content = {"trace": b"a" * 1_000_000, "other": b"b"}
    jobs = draws(4, inputs={"trace": digest_of(content["trace"])})
    assert cluster.workers == 2
    for name, executor in (("ray", cluster), ("here", Executor())):
        done = run_jobs(jobs, ResultStore(tmp_path / name), executor, content)
        assert done == JobSummary(4, 0, (), True)
    assert content_of(tmp_path / "here") == content_of(tmp_path / "ray")


def test_workers_compute_in_one_thread_and_find_modules_of_the_driver(
    tmp_path: Path, cluster: RayCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "module_of_a_user.py").write_text("from toy_jobs import about_process")
    monkeypatch.syspath_prepend(tmp_path)
    job = Job("module_of_a_user:about_process", {}, {"number": "0"})
    (done,) = cluster.results(iter([job]), {}, lambda: False)
    assert done.metrics["taichi"] == "1"
    assert set(done.metrics["pools"]) <= {1}
    assert done.metrics["pid"] != os.getpid()


def test_a_worker_that_is_killed_loses_nothing(tmp_path: Path, cluster: RayCluster) -> None:
    jobs = [*draws(2), toy_jobs.job("killed_once", 2, mark=str(tmp_path / "mark"))]
    for name, executor in (("ray", cluster), ("here", Executor())):
        done = run_jobs(jobs, ResultStore(tmp_path / name), executor)
        assert done == JobSummary(3, 0, (), True)
    assert content_of(tmp_path / "here") == content_of(tmp_path / "ray")


def test_other_source_on_a_machine_ends_the_study(
    tmp_path: Path, cluster: RayCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sdc_taichi.benchmark.ray_cluster.source_digest", lambda: "another")
    with pytest.raises(RuntimeStateError, match="has other source files of sdc-taichi"):
        run_jobs(draws(2), ResultStore(tmp_path), cluster)


def test_ctrl_c_ends_a_study_and_the_cluster_that_was_started_for_it(
    tmp_path: Path, folder: Path
) -> None:
    with driver(tmp_path, "local") as process:
        os.killpg(process.pid, signal.SIGINT)
        said, notes = process.communicate(timeout=60)
    assert said == ""
    assert "jobs; go on with --resume\n" in notes
    assert not list(tmp_path.rglob("*.tmp"))


def test_the_number_of_workers_is_that_of_the_machines() -> None:
    with pytest.raises(ConfigError, match=r"^--jobs 3: given with --ray auto; valid with"):
        RayCluster("auto", workers=3)
