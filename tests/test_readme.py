"""What the README shows runs, and its links lead somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def python_blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.S)


def test_python_of_the_readme_runs(tmp_path: Path) -> None:
    printed = ["12000 servers", "'agent_ls': (64, 40)"]
    check_output(python_blocks("README.md"), printed, tmp_path)


@pytest.mark.repo
def test_python_of_the_contributing_page_runs(tmp_path: Path) -> None:
    (drill,) = python_blocks("CONTRIBUTING.md")
    drill += "\nenv.reset(seed=0)\nprint(env.step({agent: 1 for agent in env.agents})[1])"
    check_output([drill], ["'agent_bat': -0."], tmp_path)


def check_output(blocks: list[str], printed: list[str], tmp_path: Path) -> None:
    """Each block without the names of the others; one process loads the libraries for all."""
    run = "import sys\nfor code in sys.argv[1:]: exec(code, {}); print(end='\\f', flush=True)"
    done = subprocess.run(
        [sys.executable, "-c", run, *blocks],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for text, out in zip(printed, done.stdout.split("\f")[:-1], strict=True):
        assert text in out


@pytest.mark.repo
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\(([^)#]+)", page.read_text("utf-8"))
    made = ("http", "reference/generated/")  # the second when the site is built
    local = [link for link in links if not link.startswith(made)]
    assert [link for link in local if not (page.parent / link).exists()] == []
