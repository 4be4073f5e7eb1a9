"""The source of the documentation site, and what is checked of the built one."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import sdc_taichi
from sdc_taichi import load_config

pytestmark = pytest.mark.repo

ROOT = Path(__file__).parent.parent


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "docs" / "site")
    return importlib.import_module(name)


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return load("stage", monkeypatch)


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return load("check", monkeypatch)


def test_every_link_between_pages_leads_somewhere(stage: ModuleType, tmp_path: Path) -> None:
    assert stage.stage(tmp_path) == []
    assert (tmp_path / "development" / "contributing.md").is_file()
    (tmp_path / "gone.md").write_text("# Gone\n")
    stage.stage(tmp_path)
    assert not (tmp_path / "gone.md").exists()


@pytest.mark.parametrize(
    ("path", "text", "staged"),
    [
        ("docs/hall.md", "[a](physics.md#x)", "[a](physics.md#x)"),
        ("docs/hall.md", "[physics.md](physics.md)", "[A page](physics.md)"),
        ("docs/hall.md", "[how](../CONTRIBUTING.md)", "[how](development/contributing.md)"),
        ("CONTRIBUTING.md", "[a](docs/hall.md)", "[a](../hall.md)"),
        ("docs/hall.md", "[the step](../sdc_taichi/types.py)", "the step (`sdc_taichi/types.py`)"),
        ("docs/hall.md", "[`types.py`](../sdc_taichi/types.py)", "`types.py`"),
        ("docs/hall.md", "![a plan](img/plan.png)", "![a plan](img/plan.png)"),
        ("docs/hall.md", "[a](https://rerun.io) [b](#c)", "[a](https://rerun.io) [b](#c)"),
        ("docs/hall.md", "`[a](no.md)`", "`[a](no.md)`"),
        ("docs/hall.md", "```\n[a](no.md)\n```\n", "```\n[a](no.md)\n```\n"),
    ],
)
def test_links_are_those_of_the_site(
    stage: ModuleType, monkeypatch: pytest.MonkeyPatch, path: str, text: str, staged: str
) -> None:
    monkeypatch.setattr(stage, "title_of", lambda _: "A page")
    places = {"docs/hall.md": "hall.md", "docs/physics.md": "physics.md"} | stage.ELSEWHERE
    places |= {"docs/img/plan.png": "img/plan.png"}
    errors: list[str] = []
    assert stage.with_site_links(text, path, places, errors.append) == staged
    assert errors == []


def test_tables_of_code_stand_in_their_pages(stage: ModuleType, tmp_path: Path) -> None:
    stage.stage(tmp_path)
    for page, names in (
        ("environments", ("rewards", "work_carbon", "hot_inlets")),
        ("observations", ("ci_rank",)),
    ):
        text = (tmp_path / f"{page}.md").read_text("utf-8")
        assert "<!-- table" not in text
        assert all(f"\n| `{name}` |" in text for name in names)


def test_every_field_of_a_configuration_has_an_anchor(
    stage: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fields(values: Any, path: str) -> Iterator[str]:
        for name, value in values.items():
            if isinstance(value, dict) and value:
                yield from fields(value, f"{path}{name}.")
            else:
                yield path + name

    tables = load("field_tables", monkeypatch)
    made = tables.fields_markdown()
    assert "| `min_condenser_c` | `12.78` | 0..60 |" in made
    assert "| `electric_air_cooled` | outdoor air | 3 | any |" in made
    text = stage.with_field_anchors(made)
    assert "| `seeds` |" in tables.suite_markdown()
    assert "| `memory_rate` |" in tables.settings_markdown()
    anchors = re.findall(r'id="([^"]+)"', text)
    assert len(anchors) == len(set(anchors))
    named = set(fields(load_config("corrected").model_dump(), ""))
    assert named | {"servers.groups.count", "events.sampled.per_year"} <= set(anchors)


def test_a_link_to_nothing_is_told(stage: ModuleType) -> None:
    errors: list[str] = []
    stage.with_site_links("[a](no.md)", "docs/hall.md", {"docs/hall.md": "hall.md"}, errors.append)
    assert errors == ["docs/hall.md: link to no.md: there is no such file"]


def test_generated_pages_have_every_command_and_public_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    generate = load("generate", monkeypatch)
    pages = generate.pages()
    documented = set(re.findall(r"^\.\. auto\w+:: [\w.]+\.(\w+)$", "".join(pages.values()), re.M))
    assert set(sdc_taichi.__all__) <= documented
    for module in ("sdc_taichi.control", "sdc_taichi.exogenous", "sdc_taichi.optimum"):
        assert set(importlib.import_module(module).__all__) <= documented
    for part in generate.API:
        for module, names in part.names:
            if "learning" not in module:  # which needs torch for some
                assert all(hasattr(importlib.import_module(module), name) for name in names)
    text = pages["commands"]
    assert "## `sdc-taichi simulate`" in text
    assert "## `sdc-taichi hall why`" in text
    for option in ("`--site", "`--controller", "`--resume`", "`--ray"):
        assert option in text


def write(folder: Path, **pages: str) -> None:
    folder.mkdir(exist_ok=True)
    for name, body in pages.items():
        (folder / f"{name}.html").write_text(f"<html><body>{body}</body></html>")


def test_a_site_holds_what_is_checked(check: ModuleType, tmp_path: Path) -> None:
    write(
        tmp_path,
        index='<a href="a.html">a</a> <a href="https://rerun.io/x.html">out</a>',
        a='<h1 id="top">a</h1> <a href="b.html#here">b</a> <a href="#top">up</a>',
        b='<p id="here">b</p> <a href="./index.html">home</a>',
    )
    assert check.check(tmp_path) == []


@pytest.mark.parametrize(
    ("b", "problem"),
    [
        ('<a href="no.html">', "b.html: link to no.html: there is no such page"),
        ('<a href="a.html#no">', "b.html: link to a.html#no: the page has no such place"),
        ('<script src="https://cdn.x/y.js">', "b.html: loads https://cdn.x/y.js, which is of"),
        ('<link rel="stylesheet" href="//fonts.x/y.css">', "b.html: loads //fonts.x/y.css"),
        ('<a href="c.html">', "c.html: is 3 clicks from the first page; valid are at most 2"),
    ],
)
def test_what_does_not_hold_is_told(
    check: ModuleType, tmp_path: Path, b: str, problem: str
) -> None:
    write(tmp_path, index='<a href="a.html">', a='<a href="b.html">', b=b)
    if "c.html" in problem:
        write(tmp_path, c="c")
    (found,) = check.check(tmp_path)
    assert found.startswith(problem)
