"""Options of commands that run jobs, their progress and their ends."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Self

import pytest
import typer
from typer.testing import CliRunner

import toy_jobs
from sdc_taichi.benchmark.executors import Executor
from sdc_taichi.benchmark.store import ResultStore, Study
from sdc_taichi.cli.jobs import JobOptions, JobsCommand, JobSession, job_session
from sdc_taichi.cli.options import CommandApp
from sdc_taichi.errors import ConfigError

STUDY = Study(kind="sweep", command="sdc-taichi sweep", settings={}, partitions=[])


@pytest.mark.parametrize(
    ("line", "ray", "rest"),
    [
        ("", None, ""),
        ("a --ray", "local", "a"),
        ("a --ray --out x", "local", "a x"),
        ("a --ray auto --out x", "auto", "a x"),
        ("--ray 10.0.0.1:6379 site.location=NY", "10.0.0.1:6379", "site.location=NY"),
        ("--ray=anything a", "anything", "a"),
        ("a -- --ray", None, "a --ray"),
    ],
)
def test_the_address_of_ray_may_be_left_out(line: str, ray: str | None, rest: str) -> None:
    app = CommandApp()

    @app.command(cls=JobsCommand)
    def command(
        words: list[str] = typer.Argument(default=[]),  # noqa: B008
        out: str = "",
        *,
        jobs: JobOptions,
    ) -> None:
        typer.echo(" ".join([str(jobs.ray), *words, out]))

    done = CliRunner().invoke(app, line.split())
    assert done.output.split() == [str(ray), *rest.split()]


def test_jobs_run_on_ray_only_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert JobOptions(jobs=3).executor().workers == 3
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r'--ray needs Ray.*"sdc-taichi\[scale\]"'):
        JobOptions(ray="local").executor()


def test_progress_is_lines_where_there_is_no_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = [toy_jobs.job("without_rows", i) for i in range(3)]
    store = ResultStore(tmp_path)
    with store.claimed(STUDY):
        session = JobSession(store, Executor(), lambda: False)
        session.run("rows", jobs[:1], 1)
        assert capsys.readouterr().err == "rows 1/1: toy/c/without_rows/0 0:00\n"
        session.run("rows", [*jobs, toy_jobs.job("refuse", 3)], 4)
        lines = capsys.readouterr().err.splitlines()
        assert lines == [
            "rows 2/4, 1 kept: toy/c/without_rows/1 0:00",
            "failed: toy/c/refuse/3: number 3: valid is another",
            "rows 4/4, 1 kept: toy/c/refuse/3 failed",
        ]
        with pytest.raises(typer.Exit) as ended:
            session.finish()
        assert ended.value.exit_code == 1
        assert capsys.readouterr().err == "1 of 5 jobs failed; --resume runs them again\n"


def test_a_study_whose_workers_cannot_start_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Absent(Executor):
        def __enter__(self) -> Self:
            raise ConfigError("no workers")

    monkeypatch.setattr(JobOptions, "executor", lambda _: Absent())
    with (
        pytest.raises(ConfigError, match="no workers"),
        job_session(ResultStore(tmp_path), STUDY, JobOptions()),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_study_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JobOptions, "executor", lambda _: Executor())
    store, jobs = ResultStore(tmp_path), [toy_jobs.job("interrupt", 0), toy_jobs.job("draw", 1)]
    with job_session(store, STUDY, JobOptions(jobs=1)) as session:
        assert not session.run("rows", jobs, 2).is_whole
        assert session.run("more", [toy_jobs.job("draw", 2)], 1).done == 0
    with pytest.raises(typer.Exit) as ended:
        session.finish()
    assert ended.value.exit_code == 130
    assert "interrupted after 1 jobs; go on with --resume" in capsys.readouterr().err
    with job_session(store, STUDY, JobOptions(jobs=1, resume=True), quiet=True) as session:
        done = session.run("rows", jobs, 2)
    session.finish()
    assert (done.done, done.kept) == (1, 1)
    assert capsys.readouterr().err == ""
