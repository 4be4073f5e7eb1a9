"""The package as it is listed, built, installed and imported."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.resources
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAPPED = ("configs", "data", "kernels", "viz")
PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES: list[str] = PYPROJECT["tool"]["setuptools"]["packages"]
# Imported by the functions that need them, so that `import sdc_taichi` stays light.
LAZY = {
    *("matplotlib", "pandas", "pettingzoo", "psychrolib", "pyarrow", "rerun", "safetensors"),
    *("taichi", "torch"),
}


def run_python(code: str, cwd: Path) -> str:
    """Run code in a fresh interpreter that sees installed packages alone, and return its output."""
    done = subprocess.run(
        [sys.executable, "-I", "-c", code], cwd=cwd, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def source_files() -> dict[str, Path]:
    """Map each path inside an installed package to its file in the source tree."""
    roots = {"sdc_taichi": "sdc_taichi"} | {name: f"sdc_taichi/{name}" for name in MAPPED}
    return {
        f"{target}/{path.relative_to(ROOT / folder).as_posix()}": path
        for folder, target in roots.items()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.mark.repo
def test_packages_are_the_folders_on_disk() -> None:
    folders = {
        target.rpartition("/")[0].replace("/", ".")
        for target in source_files()
        if target.endswith(".py")
    }
    assert set(PACKAGES) == folders
    assert len(PACKAGES) == len(set(PACKAGES))
    assert [
        name for name in PACKAGES if f"{name.replace('.', '/')}/__init__.py" not in source_files()
    ] == []


@pytest.mark.repo
def test_build_holds_every_source_file(tmp_path: Path) -> None:
    build = "from setuptools import setup; setup()"
    options = ["--quiet", "build_py", "--build-lib", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", build, *options], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    built = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert built == set(source_files())


def test_import_is_light(tmp_path: Path) -> None:
    code = "import sys, sdc_taichi; print(*sys.modules)"
    loaded = {name.partition(".")[0] for name in run_python(code, tmp_path).split()}
    assert "sdc_taichi" in loaded
    assert loaded & LAZY == set()


def test_public_names_are_there(tmp_path: Path) -> None:
    code = """
import sdc_taichi
for name in sdc_taichi.__all__:
    assert name in dir(sdc_taichi), name
    assert getattr(sdc_taichi, name) is not None, name
assert not hasattr(sdc_taichi, "paralel_env")
import gymnasium, sys
print(*(name for name in gymnasium.registry if name.startswith("sdc_taichi/")))
print("taichi" in sys.modules)
"""
    ids, taichi = run_python(code, tmp_path).splitlines()
    assert ids.split() == [f"sdc_taichi/{n}-v0" for n in ("Joint", "Load", "Cooling", "Battery")]
    assert taichi == "False"


@pytest.mark.repo
def test_a_checkout_on_the_path_takes_no_folder_of_an_installed_one(tmp_path: Path) -> None:
    for name in ("sdc_taichi", *MAPPED):
        shutil.copytree(ROOT / name, tmp_path / name)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    names = ", ".join(f"sdc_taichi.{name}" for name in MAPPED)
    code = f"import {names}; print(*(m.__file__ for m in ({names})))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        cwd=tmp_path.parent,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    assert done.stdout.split() == [str(tmp_path / name / "__init__.py") for name in MAPPED]


def test_kernels_evaluate_their_annotations() -> None:
    sources = [
        item.read_text(encoding="utf-8")
        for item in importlib.resources.files("sdc_taichi.kernels").iterdir()
        if item.name.endswith(".py")
    ]
    assert any("@ti.kernel\n" in source for source in sources)
    # Taichi reads annotations as objects; the future import turns them into strings.
    assert not [s for s in sources if re.search(r"from\s+__future__\s+import.*annotations", s)]
