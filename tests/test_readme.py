"""What the README shows runs, and its links lead somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

pytestmark = pytest.mark.repo


def test_python_of_the_readme_runs(tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    printed = ["12000 servers", "'agent_ls': (64, 40)", "lookahead-24h: "]
    for code, text in zip(blocks, printed, strict=True):
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert text in done.stdout


def test_python_of_the_drills_runs() -> None:
    (code,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text("utf-8"), re.S
    )
    run = "\nenv.reset(seed=0)\nprint(env.step({agent: 1 for agent in env.agents})[1])"
    done = subprocess.run(
        [sys.executable, "-c", code + run], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "'agent_bat': -0." in done.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\(([^)#]+)", page.read_text("utf-8"))
    local = [link for link in links if not link.startswith("http")]
    assert [link for link in local if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("script", ["setpoint_study", "plot_hall"])
def test_examples_draw_their_pictures(script: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = ROOT / "examples" / f"{script}.py"
    done = subprocess.run(
        [sys.executable, str(path), str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    pictures = list(tmp_path.glob("*.png"))
    assert pictures
    assert all(p.stat().st_size > 10_000 for p in pictures)


@pytest.mark.parametrize(("name", "lines"), [("thermal", 5), ("env", 3)])
def test_benchmarks_run_at_small_size(name: str, lines: int) -> None:
    path = ROOT / "benchmarks" / f"{name}.py"
    done = subprocess.run(
        [sys.executable, str(path), "--quick"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == lines
