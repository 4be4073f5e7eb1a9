"""Workflows, container and notes of a release name what there is."""

from __future__ import annotations

import importlib.util
import json
import re
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

pytestmark = pytest.mark.repo

ROOT = Path(__file__).parent.parent


def load(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def release(root: Path, **changed: str) -> Path:
    files = {
        "pyproject.toml": '[project]\nversion = "1.2.0"\n',
        "CITATION.cff": "cff-version: 1.2.0\nversion: 1.2.0\n",
        "CHANGELOG.md": "## [1.2.0] - 2026-01-31\n\n- New.\n\n## [1.1.0] - 2025-01-31\n",
    }
    for name, text in (files | changed).items():
        (root / name).write_text(text)
    return root


def test_notes_of_a_release_are_its_section(tmp_path: Path) -> None:
    assert load(".ci/release_notes.py").notes(release(tmp_path), "v1.2.0") == "- New.\n"


@pytest.mark.parametrize(
    ("tag", "changed", "message"),
    [
        ("v1.3.0", {}, "tag v1.3.0: pyproject.toml has version 1.2.0"),
        ("1.2.0", {}, "expected tag v1.2.0"),
        ("v1.2.0.dev0", {"pyproject.toml": '[project]\nversion = "1.2.0.dev0"\n'}, "not that of a"),
        ("v1.2.0", {"CITATION.cff": "version: 1.1.0\n"}, "CITATION.cff: expected version 1.2.0"),
        ("v1.2.0", {"CHANGELOG.md": "## [1.2.0] - unreleased\n\n- New.\n"}, "expected a section"),
        ("v1.2.0", {"CHANGELOG.md": "## [1.2.0] - 2026-01-31\n\n"}, "expected a section"),
    ],
)
def test_a_tag_that_fits_no_release_is_refused(
    tmp_path: Path, tag: str, changed: dict[str, str], message: str
) -> None:
    with pytest.raises(SystemExit, match=re.escape(message)):
        load(".ci/release_notes.py").notes(release(tmp_path, **changed), tag)


def test_wheels_that_differ_are_told(tmp_path: Path) -> None:
    for name, content in (("a", "1"), ("b", "1"), ("c", "2")):
        with zipfile.ZipFile(tmp_path / name, "w") as file:
            file.writestr("module.py", content)
            if name == "c":
                file.writestr("more.py", "")
    differences = load(".ci/compare_wheels.py").differences
    assert differences(tmp_path / "a", tmp_path / "b") == []
    assert differences(tmp_path / "a", tmp_path / "c") == ["module.py", "more.py"]


def test_sites_of_versions_stand_side_by_side(tmp_path: Path) -> None:
    put, build, pages = load("docs/site/versions.py").put, tmp_path / "html", tmp_path / "pages"
    build.mkdir()
    address = "https://example.org/sdc/"
    with pytest.raises(SystemExit, match="no index"):
        put(pages, build, "dev", address)
    (build / "index.html").write_text("first")
    (build / "old.html").touch()
    for name in ("dev", "0.9.0", "0.10.0"):
        put(pages, build, name, address)
    (build / "old.html").unlink()
    put(pages, build, "dev", address)
    assert not (pages / "dev" / "old.html").exists()
    listed = json.loads((pages / "switcher.json").read_text())
    assert [x["version"] for x in listed] == ["dev", "0.10.0", "0.9.0"]
    assert listed[1]["url"] == "https://example.org/sdc/0.10.0/"
    assert [x["version"] for x in listed if x.get("preferred")] == ["0.10.0"]
    assert 'url=0.10.0/"' in (pages / "index.html").read_text()
    with pytest.raises(SystemExit, match="expected dev or a version"):
        put(pages, build, "../dev", address)
