"""What the documentation shows: commands and Python of its pages run, or are valid."""

from __future__ import annotations

import inspect
import re
import shlex
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer.main
from typer.testing import CliRunner

import made_studies
from exogenous_builders import carbon_lines, epw_lines, text, workload_lines
from sdc_taichi.benchmark.executors import Executor
from sdc_taichi.cli.app import app
from sdc_taichi.cli.jobs import JobOptions
from sdc_taichi.control import registry
from sdc_taichi.envs import costs, rewards
from sdc_taichi.viz import report

pytestmark = pytest.mark.repo

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
HOW_TO = DOCS / "how-to.md"
WHOLE_GUIDES = [
    *DOCS.glob("index.md"),
    *(x for x in sorted(DOCS.glob("tutorials/*.md")) if x.stem != "index"),
]
GUIDES = {page.stem: page.read_text("utf-8") for page in WHOLE_GUIDES} | {
    answer.partition("\n")[0]: answer
    for page in DOCS.glob("how-to.md")
    for answer in re.split("^## ", page.read_text("utf-8"), flags=re.M)[1:]
}
"""Texts whose commands are run as they stand: pages, and each answer of the how-to guides."""
PAGES = [
    ROOT / "README.md",
    *(
        page
        for page in sorted(DOCS.rglob("*.md"))
        if page not in (*WHOLE_GUIDES, HOW_TO) and "site" not in page.relative_to(DOCS).parts
    ),
]
"""Pages whose Python is run, and whose commands have to be valid."""
POLICY = ROOT / "tests" / "reference" / "benchmark" / "carbon" / "ippo"
NOT_RUN = ("train", "evaluate", "benchmark")
"""Commands that take long or need an extra: it is seen that they are valid."""
DRAWN = ("fleet_section", "data_center_section", "hot_racks_section", "inputs_section")
"""Sections of reports that take seconds to draw; tests/test_report.py holds what they show."""
SHOWN = ("train",)
"""Those of them that check all values if they are to show them, and are not resumed."""
_NOT_RUN_MARK = re.compile(r"<!-- not run: .+ -->\s*\Z")
_LINE = re.compile(r"^ {4}(\S.*)$", re.M)
_SYNOPSIS = re.compile(r"^# Command line\n\n(?: {4}.*\n)+", re.M)


class Shown(NamedTuple):
    """A piece of a page."""

    kind: str
    """``python``, or ``line`` of what stands indented."""
    code: str
    """The text."""
    is_run: bool = True
    """Whether no mark before it says that it is not run."""


def shown_on(page: Path) -> list[Shown]:
    """Python and indented lines of a page in their order."""
    return shown_in(page.read_text("utf-8"))


def shown_in(text: str) -> list[Shown]:
    """Python and indented lines of a text in their order."""
    found = []
    content = _SYNOPSIS.sub("", text)
    is_run = True
    for part in re.split(r"(^```.*?^```$)", content, flags=re.M | re.S):
        if part.startswith("```python\n"):
            code = part.removeprefix("```python\n").removesuffix("```")
            found.append(Shown("python", code, is_run))
        elif part.startswith("```\n"):
            lines = part.splitlines()[1:-1]
            found += [Shown("line", line) for line in lines if line.startswith("sdc-taichi ")]
        elif not part.startswith("```"):
            joined = re.sub(r" \\\n +", " ", part)
            found += [Shown("line", line) for line in _LINE.findall(joined)]
        is_run = not _NOT_RUN_MARK.search(part)
    return found


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that pages speak of; what pages register is forgotten."""
    for module in (costs, rewards):
        monkeypatch.setattr(module, "_registered", {})
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    for section in DRAWN:
        monkeypatch.setattr(report, section, lambda *_, **__: [])
    # Processes of their own would compile kernels again.
    monkeypatch.setattr(JobOptions, "executor", lambda _: Executor())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDC_TAICHI_DATA", str(tmp_path / "data"))
    Path("station.epw").write_text(text(epw_lines()))
    Path("ci.csv").write_text(text(carbon_lines()))
    Path("my_trace.csv").write_text(text(workload_lines()))
    shutil.copytree(POLICY, "runs/ippo")
    return tmp_path


@pytest.mark.parametrize("guide", GUIDES)
def test_what_a_guide_shows_runs(
    guide: str, there: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names: dict[str, Any] = {}
    shown = shown_in(GUIDES[guide])
    for kind, code, _ in shown:
        if kind == "python":
            exec(compile(inspect.cleandoc(code), guide, "exec"), names)
        else:
            run(code)
    assert shown or guide in ("Cite", "Run in a container")


def run(line: str) -> None:
    """Run a command line, or see that it is valid."""
    program, *words = shlex.split(re.sub(r"--days \d+", "--days 1", line))
    if program == "pip":
        return
    assert program == "sdc-taichi", line
    if words[0] in SHOWN and "--resume" not in words:
        words = [*words, "--show"]
    elif words[0] in NOT_RUN:
        check(words)
        return
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, f"{line}: {done.output}"


@cache
def commands() -> Any:
    """The command line."""
    return typer.main.get_command(app)


def check(words: list[str]) -> None:
    """See that a command takes the arguments and options of a line."""
    command = commands()
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_of_a_page_are_valid(page: Path) -> None:
    for line in commands_on(page):
        try:
            check(line)
        except (typer.TyperException, KeyError) as error:
            pytest.fail(f"{shlex.join(line)}: {error}")


def commands_on(page: Path) -> Iterator[list[str]]:
    """Words of the commands of a page, without redirections and what follows them."""
    for shown in shown_on(page):
        if shown.kind == "line" and shown.code.startswith("sdc-taichi "):
            for part in shown.code.split(" && "):
                words = shlex.split(part, comments=True)
                end = words.index(">") if ">" in words else len(words)
                yield words[1:end]


def test_pages_show_commands() -> None:
    """The expression that looks for commands finds most of them."""
    assert sum(1 for page in PAGES for _ in commands_on(page)) > 50


PYTHON_PAGES = [
    page
    for page in PAGES
    if page.stem != "README" and any(shown.kind == "python" for shown in shown_on(page))
]


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=lambda page: page.stem)
def test_python_of_a_page_runs(
    page: Path, there: Path, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(runs, there, dirs_exist_ok=True)
    names: dict[str, Any] = {"__name__": "shown"}
    for kind, code, is_run in shown_on(page):
        if kind == "python":
            compiled = compile(code, str(page), "exec")
            if is_run:
                exec(compiled, names)


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs, a policy, a sweep and results of a study, under the names that pages give them."""
    folder = tmp_path_factory.mktemp("shown")
    for name in ("demo", "july", "july-idle"):
        out = str(folder / "runs" / name)
        command = ["simulate", "tiny", "--start", "07-01", "--days", "1", "--out", out, "--quiet"]
        assert CliRunner().invoke(app, command).exit_code == 0
    shutil.copytree(POLICY, folder / "runs" / "happo")
    made_studies.write_study(folder / "results")
    command = ["sweep", "tiny", "--vary", "hvac.setpoint.initial_c=16:17:1", "--days", "1"]
    command += ["--out", str(folder / "sweeps" / "setpoints"), "--quiet"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(JobOptions, "executor", lambda _: Executor())
        assert CliRunner().invoke(app, command).exit_code == 0
    (folder / "evaluation").mkdir()
    return folder
