"""Reports of suites: one page and Markdown, of made-up studies."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from made_studies import ROWS, done_job, frames_of_row, write_study
from report_reader import Page, read_page
from sdc_taichi.benchmark.report import write_report
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.cli.app import app


def page_of(folder: Path, out: Path) -> tuple[Page, tuple[str, ...]]:
    notes = write_report([folder], html=out)
    return read_page(out.read_text("utf-8")), notes


def test_a_page_has_tables_pictures_and_how_to_read_them(study: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    page, notes = page_of(study, tmp_path / "report.html")
    assert notes == ()
    assert page.problems == []
    assert len(page.all("img")) == 2
    (standing, *_) = page.rows("mpc-24h")
    assert standing[1] == "1"
    assert "What it shows & <what> not." in page.text
    assert "a | pipe, <b>markup</b> and _more_" in page.text
    assert "sdc-taichi benchmark made-up" in page.text
    assert "Agarwal" in page.text


def test_without_matplotlib_tables_stand_alone(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    page, (note,) = page_of(study, tmp_path / "report.html")
    assert 'pip install "sdc-taichi[plot]"' in note
    assert page.all("img") == []
    assert page.rows("mpc-24h")
    out = tmp_path / "tables.md"
    command = ["benchmark", "report", str(study), "--out", str(tmp_path / "page.html")]
    done = CliRunner().invoke(app, [*command, "--markdown", str(out)])
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[-1] == f"Tables: {out}"
    assert "note: tables alone: pictures need matplotlib" in done.stderr
    done = CliRunner().invoke(app, command)
    assert f"--out {tmp_path / 'page.html'}: exists" in done.stderr
    done = CliRunner().invoke(app, ["benchmark", "report", str(study), str(study)])
    assert "is given twice" in done.stderr


def test_markdown_shows_texts_as_they_are(study: Path, tmp_path: Path) -> None:
    out = tmp_path / "tables.md"
    write_report([study], markdown=out)
    lines = out.read_text("utf-8").splitlines()
    assert lines[0] == "# A made-up suite"
    assert "    sdc-taichi benchmark made-up" in lines
    assert "- g36: a \\| pipe, \\<b\\>markup\\</b\\> and \\_more\\_" in lines
    assert any(line.startswith("| mpc-24h | 1 | 1 | -8.97 (") for line in lines)


def test_notes_tell_what_is_missing_or_mixed(tmp_path: Path) -> None:
    left = [f"made-up/two-sites/ippo/{seed}" for seed in (1, 2)]
    store = ResultStore(write_study(tmp_path / "made-up", leave_out=left))
    store.keep(done_job("g36", 0, frames_of_row("g36", 0), spec=ROWS["g36"], source="1" * 64))
    out = tmp_path / "tables.md"
    write_report([store.folder], markdown=out)
    notes = [line for line in out.read_text("utf-8").splitlines() if line.startswith("> ")]
    assert notes == [
        "> Unfinished, without two-sites: ippo, seed 1, two-sites: ippo, seed 2.",
        "> Results of several states of the source: 000000000000 (6), 111111111111 (1).",
        "> two-sites: fewer than 3 seeds of ippo, so what another training would reach is not "
        "known, and there is no place.",
    ]
