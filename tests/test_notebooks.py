"""Notebooks are stored without what their runs add; building the site runs them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.repo

FOLDER = Path(__file__).parent.parent / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def content(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return found


def test_the_index_lists_every_notebook() -> None:
    index = (FOLDER / "index.md").read_text("utf-8")
    tree = index.split("```{toctree}")[1].split()
    assert sorted(tree[1:-1]) == [path.stem for path in NOTEBOOKS]
    assert all(f"({path.name})" in index for path in NOTEBOOKS)
    assert len(NOTEBOOKS) >= 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_clean(path: Path) -> None:
    found = content(path)
    assert found["nbformat"] == 4
    assert found["metadata"]["kernelspec"]["name"] == "python3"
    assert found["cells"][0]["cell_type"] == "markdown"
    for cell in found["cells"]:
        assert cell["cell_type"] in ("markdown", "code")
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
    names = [cell["id"] for cell in found["cells"]]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_links_of_notebooks_lead_to_pages(path: Path) -> None:
    for cell in content(path)["cells"]:
        if cell["cell_type"] != "markdown":
            continue
        for to in re.findall(r"\]\(([^)#:]+)\)", "".join(cell["source"])):
            assert (FOLDER / to).is_file(), to
