"""The how-to guides and the first page of the site: their Python and their commands run."""

from __future__ import annotations

import inspect
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner

from exogenous_builders import carbon_lines, epw_lines, text
from sdc_taichi.cli.app import app

pytestmark = pytest.mark.repo

DOCS = Path(__file__).parent.parent / "docs"
PAGES = [DOCS / "index.md", *(x for x in sorted(DOCS.glob("how-to/*.md")) if x.stem != "index")]
NOT_RUN = ("train", "benchmark")
"""Commands that take long or need an extra: it is seen that they are valid."""
_LINE = re.compile(r"^ {4}(\S.*)$", re.M)


def blocks(page: Path) -> list[tuple[str, str]]:
    """Python and command lines of a page in their order, each with its kind."""
    found = []
    for part in re.split(r"(^```.*?^```$)", page.read_text("utf-8"), flags=re.M | re.S):
        if part.startswith("```python\n"):
            found.append(("python", part.removeprefix("```python\n").removesuffix("```")))
        elif not part.startswith("```"):
            found += [("command", line) for line in _LINE.findall(part)]
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_guide_shows_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDC_TAICHI_DATA", str(tmp_path / "data"))
    Path("station.epw").write_text(text(epw_lines()))
    Path("ci.csv").write_text(text(carbon_lines()))
    names: dict[str, Any] = {}
    shown = blocks(page)
    for kind, code in shown:
        if kind == "python":
            exec(compile(inspect.cleandoc(code), str(page), "exec"), names)
        else:
            run(code)
    assert shown or page.stem in ("cite", "run-in-a-container")


def run(line: str) -> None:
    """Run a command line, or see that it is valid."""
    program, *words = shlex.split(line)
    if program == "pip":
        return
    assert program == "sdc-taichi", line
    if words[0] in NOT_RUN:
        check(words)
        return
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, f"{line}: {done.output}"


def check(words: list[str]) -> None:
    """See that a command takes the arguments and options of a line."""
    command: Any = typer.main.get_command(app)
    names = []
    while within := getattr(command, "commands", {}):
        # `benchmark SUITE` runs a suite, by a command that has a name of its own.
        name = words.pop(0) if words[0] in within else "run"
        names.append(name)
        command = within[name]
    command.make_context(" ".join(names), words)


@pytest.mark.parametrize(
    "line", ["train ippo --sites ny", "benchmark carbon --no", "benchmark report"]
)
def test_what_is_not_run_is_parsed(line: str) -> None:
    with pytest.raises(typer.TyperException):
        check(line.split())
