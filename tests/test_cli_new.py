"""``sdc-taichi new``, and the command line without arguments."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from sdc_taichi import load_config
from sdc_taichi.cli.app import app


@pytest.mark.parametrize("preset", ["tiny", "sustaindc", "ai_hall_2026", "fleet_of_eight"])
def test_a_new_file_has_the_values_of_its_preset(preset: str, tmp_path: Path) -> None:
    out = tmp_path / "hall.yaml"
    done = CliRunner().invoke(app, ["new", str(out), "--from", preset])
    assert done.exit_code == 0, done.output
    assert "sdc-taichi simulate" in done.output
    assert load_config(str(out)) == load_config(preset)


def test_every_field_has_a_comment_with_what_is_valid(tmp_path: Path) -> None:
    out = tmp_path / "hall.yaml"
    CliRunner().invoke(app, ["new", str(out)])
    text = out.read_text("utf-8")
    assert max(map(len, text.splitlines())) <= 100
    lines = text.splitlines()
    fields = [i for i, line in enumerate(lines) if ": " in line and line.lstrip()[0].isalpha()]
    assert len(fields) > 150
    assert all(lines[i - 1].lstrip().startswith("#") for i in fields)
    assert "None" not in text


def test_an_existing_file_is_kept_without_force(tmp_path: Path) -> None:
    out = tmp_path / "hall.yaml"
    out.write_text("mine")
    done = CliRunner().invoke(app, ["new", str(out)])
    assert (done.exit_code, out.read_text()) == (2, "mine")
    assert "exists; choose another name or replace it with --force" in done.output
    assert CliRunner().invoke(app, ["new", str(out), "--force"]).exit_code == 0
    assert load_config(str(out)) == load_config("corrected")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["hall.txt"], "valid is a name that ends in .yaml"),
        (["hall.yaml", "--from", "corected"], "did you mean 'corrected'"),
        (["no/folder/hall.yaml"], "no/folder"),
    ],
)
def test_what_cannot_be_written_is_one_line(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["new", *words])
    assert done.exit_code == 2
    assert said in done.output
    assert done.output.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_alone_says_what_to_do_first() -> None:
    done = CliRunner().invoke(app, [])
    assert done.exit_code == 0
    assert "sdc-taichi simulate --days 7 --out runs/first" in done.output
    assert len(done.output.splitlines()) == 8
