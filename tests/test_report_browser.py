"""A browser opens the report, shows its pictures and prints it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from report_reader import Page, read_page
from sdc_taichi import Simulator, load_config, make_configs
from sdc_taichi.control import make_controller
from sdc_taichi.run.description import RunRequest
from sdc_taichi.run.folder_reader import read_run
from sdc_taichi.run.folder_writer import simulate_to_folder
from sdc_taichi.viz.report import write_report

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@pytest.fixture(scope="module")
def browser() -> str:
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip("chromium is not installed: the report was not opened in a browser")
    return found


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("browser") / "run"
    long = "a_hall_with_a_name_that_does_not_break_" + 80 * "x"
    configs = make_configs(load_config("tiny"), count=2, sites=["NY", "CA"])
    configs[0] = configs[0].model_copy(update={"name": f"<b>&amp;{long}"})
    with Simulator(configs) as sim:
        simulate_to_folder(
            sim, make_controller("greedy-ci", sim.fleet), RunRequest("greedy-ci", 60), out
        )
    return write_report(read_run(out))


def run_browser(browser: str, report: Path, tmp_path: Path, *arguments: str) -> bytes:
    command = [browser, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", *arguments]
    done = subprocess.run([*command, report.as_uri()], capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    return done.stdout


def heads(page: Page) -> list[tuple[str, dict[str, str | None]]]:
    return [(tag, attributes) for tag, attributes in page.elements if tag in ("h1", "h2", "img")]


def test_browser_reads_what_was_written(browser: str, report: Path, tmp_path: Path) -> None:
    dom = run_browser(browser, report, tmp_path, "--dump-dom").decode("utf-8")
    seen, written = read_page(dom), read_page(report.read_text("utf-8"))
    assert heads(seen) == heads(written)
    assert seen.tables == written.tables
    assert seen.text == written.text
    assert "<b>&amp;a_hall" in seen.text
    assert not seen.all("b")


def test_browser_prints_pages(browser: str, report: Path, tmp_path: Path) -> None:
    target = tmp_path / "report.pdf"
    run_browser(browser, report, tmp_path, "--no-pdf-header-footer", f"--print-to-pdf={target}")
    data = target.read_bytes()
    assert data.startswith(b"%PDF-")
    pages = len(re.findall(rb"/Type\s*/Page\b", data))
    assert 5 <= pages <= 30
    # A4, in points of which Chromium rounds the last.
    boxes = {tuple(map(float, b.split())) for b in re.findall(rb"/MediaBox\s*\[([^\]]+)\]", data)}
    (box,) = boxes
    np.testing.assert_allclose(box, [0, 0, 595, 842], atol=1.0)
    if shutil.which("pdftotext") is not None and os.name == "posix":
        text = subprocess.run(
            ["pdftotext", "-layout", str(target), "-"], capture_output=True, text=True, check=True
        ).stdout
        for heading in ("Summary", "Metrics", "Events", "All data centers", "Inputs", "Provenance"):
            assert re.search(rf"^\s*{heading}\s*$", text, re.MULTILINE), heading
        for words in ("input", "carbon", "weather", "data centers"):
            assert re.search(rf"\b{words}\b", text.partition("Provenance")[2]), words
        total = read_run(report.parent).metrics["total"]["facility_kwh"]
        row = re.search(r"facility energy, IT and HVAC\s.*", text)
        assert row is not None
        assert row[0].rstrip().endswith(f"{total:.4g}"), "the last column is on the page"
