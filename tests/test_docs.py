"""The pages in docs/ say of commands, metrics and columns what the program has."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

from sdc_taichi.cli.app import app
from sdc_taichi.run.folder_reader import read_run
from sdc_taichi.types import DATA_CENTERS, QUANTITIES, meanings

DOCS = Path(__file__).parent.parent / "docs"
PAGES_OF_COMMANDS = ("cli.md", "data.md", "layout-solver.md")

pytestmark = pytest.mark.repo


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs") / "run"
    done = CliRunner().invoke(app, ["simulate", "tiny", "--days=0.25", f"--out={folder}"])
    assert done.exit_code == 0, done.output
    return folder


def section(page: str, heading: str) -> str:
    """The text of a page from a heading to the next one."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.split(r"^#+ .*$", text.split(f"# {heading}\n", 1)[1], maxsplit=1, flags=re.M)[0]


def names_in_first_column(text: str) -> list[str]:
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    return re.findall(r"`([a-z0-9_]+)`", " ".join(cells))


def commands() -> dict[str, Any]:
    root: Any = typer.main.get_command(app)
    found: dict[str, Any] = root.commands
    return found


def test_synopsis_lists_every_command() -> None:
    synopsis = re.findall(
        r"^    sdc-taichi ([a-z]+) ?([a-z|]*)", section("cli.md", "Command line"), re.M
    )
    listed = {name: {s for s in subcommands.split("|") if s} for name, subcommands in synopsis}
    expected = {name: set(getattr(each, "commands", {})) for name, each in commands().items()}
    assert listed == expected
    assert len(synopsis) == len(listed)


def test_every_option_is_documented() -> None:
    text = "".join((DOCS / page).read_text(encoding="utf-8") for page in PAGES_OF_COMMANDS)
    known = set(re.findall(r"--[a-z][a-z-]+", text))

    def with_subcommands(command: Any) -> Iterator[Any]:
        yield command
        for each in getattr(command, "commands", {}).values():
            yield from with_subcommands(each)

    missing = [
        f"{each.name} {option}"
        for command in commands().values()
        for each in with_subcommands(command)
        for parameter in each.params
        for option in parameter.opts
        if option.startswith("--") and option not in known
    ]
    assert missing == []


def test_every_column_of_steps_is_documented(run_folder: Path) -> None:
    columns = list(pd.read_parquet(run_folder / "steps.parquet").columns)
    per_dc = [name for name, each in QUANTITIES.items() if each.axis == DATA_CENTERS]
    assert columns == ["dc", "step", "time", *per_dc]
    assert [*meanings()] == [*QUANTITIES]


def test_every_metric_is_documented(run_folder: Path) -> None:
    metrics = read_run(run_folder).metrics
    text = section("run-folder.md", "metrics.json")
    listed = names_in_first_column(text)
    keys, names = list(metrics), list(metrics["total"])
    assert names[:1] != []
    assert sorted([*listed, "hottest_dc"]) == sorted([*keys, *names])
    assert "`hottest_dc`" in text
    assert set(metrics["data_centers"][0]["metrics"]) == set(names) - {"hottest_dc"}
