"""The pages in docs/ say of commands, metrics and columns what the program has."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from sdc_taichi import load_config, with_values
from sdc_taichi.cli.app import app
from sdc_taichi.run.folder_reader import read_run
from sdc_taichi.run.metrics import empty_totals, metrics_of_fleet
from sdc_taichi.run.steps_file import KEY_COLUMNS
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.types import DATA_CENTERS, QUANTITIES, meanings

DOCS = Path(__file__).parent.parent / "docs"

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


def test_every_column_of_steps_is_documented(run_folder: Path) -> None:
    columns = list(pd.read_parquet(run_folder / "steps.parquet").columns)
    per_dc = [name for name, each in QUANTITIES.items() if each.axis == DATA_CENTERS]
    assert columns == [*KEY_COLUMNS, *per_dc]
    assert [*meanings()] == [*QUANTITIES]


def test_every_metric_is_documented(run_folder: Path) -> None:
    metrics = read_run(run_folder).metrics
    text = section("run-folder.md", "metrics.json")
    listed = names_in_first_column(text)
    keys, names = list(metrics), list(metrics["total"])
    assert names[:1] != []
    fleet = build_fleet(with_values(load_config("tiny"), {"fleet": {"sites": ["NY", "WA"]}}))
    totals = empty_totals(2, 0.25)
    totals.steps = 1
    of_fleets = set(metrics_of_fleet(totals, fleet)) - set(names)
    assert "moved_tasks" in of_fleets
    assert sorted([*listed, "hottest_dc"]) == sorted([*keys, *names, *of_fleets])
    assert "`hottest_dc`" in text
    assert set(metrics["data_centers"][0]["metrics"]) == set(names) - {"hottest_dc"}
