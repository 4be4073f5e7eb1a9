"""The rooms of the package: how many there are, which may import which, and what each explains."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAPPED = ("configs", "data", "kernels", "viz")
ROOMS = (
    "errors",
    "types",
    "atomic_file",
    "user_file",
    "number_text",
    "user_functions",
    "configs",
    "data",
    "kernels",
    "plant",
    "exogenous",
    "config",
    "hall",
    "layout_solver",
    "sim",
    "optimum",
    "control",
    "run",
    "viz",
    "envs",
    "compat",
    "learning",
    "benchmark",
    "cli",
    "__main__",
    "__init__",
)
"""From the ground up: a room imports rooms that stand before it, and no others."""
LEANS_ON_ITS_NEIGHBOUR = re.compile(
    r"^(This and|These and|Likewise|The same\b|As (the|in the|above|before)|Of (halls|those|it)\b"
    r"|It is\b|They are\b|See above)|as the next|the next (two|three|four|five|six)|as before\b"
)

pytestmark = pytest.mark.repo


def source_files() -> dict[str, Path]:
    """Map each module, by its name below ``sdc_taichi``, to its file."""
    found = {}
    for folder in ("sdc_taichi", *MAPPED):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = list(path.relative_to(ROOT).with_suffix("").parts)
            parts = parts[1:] if folder == "sdc_taichi" else parts
            found[".".join(parts)] = path
    return found


FILES = source_files()


@functools.cache
def nodes(module: str) -> list[ast.AST]:
    """All nodes of the syntax tree of a module, the tree itself first."""
    return list(ast.walk(ast.parse(FILES[module].read_text(encoding="utf-8"))))


@pytest.fixture(scope="module", autouse=True)
def _nodes_are_forgotten() -> Iterator[None]:
    yield
    nodes.cache_clear()


def module_of(name: str) -> str:
    """The module that ``name``, a dotted path below ``sdc_taichi``, names or lies in."""
    parts = name.split(".") if name else []
    for end in range(len(parts), -1, -1):
        stem = ".".join(parts[:end])
        for candidate in (stem, f"{stem}.__init__" if stem else "__init__"):
            if candidate in FILES:
                return candidate
    raise AssertionError(f"{name}: no module of the package")


@functools.cache
def imported(module: str) -> frozenset[str]:
    """Modules of the package that a module imports anywhere, in functions and for types too."""
    package = module.split(".")[:-1]
    found: set[str] = set()
    for node in nodes(module):
        if isinstance(node, ast.Import):
            names = [a.name for a in node.names if a.name.split(".")[0] == "sdc_taichi"]
            found |= {module_of(name.partition(".")[2]) for name in names}
        elif isinstance(node, ast.ImportFrom):
            named = (node.module or "").split(".")
            if node.level:
                parts = [*package[: len(package) - node.level + 1], *filter(None, named)]
            elif named[0] == "sdc_taichi":
                parts = named[1:]
            else:
                continue
            stem = ".".join(parts)
            found |= {module_of(f"{stem}.{a.name}".strip(".")) for a in node.names}
    return frozenset(found - {module})


def room_of(module: str) -> str:
    return module.split(".")[0]


def test_there_are_few_rooms_and_each_has_its_place() -> None:
    rooms = {room_of(module) for module in FILES}
    assert rooms <= set(ROOMS), "say in ROOMS what the new room may import"
    assert set(ROOMS) <= rooms, "a room of ROOMS is gone"
    assert len(rooms - {*MAPPED, "__main__"}) <= 21


def test_no_import_runs_upwards() -> None:
    upwards = {
        (module, other)
        for module in FILES
        for other in imported(module)
        if ROOMS.index(room_of(other)) > ROOMS.index(room_of(module))
    }
    assert upwards == set(), "these modules import from rooms above their own"


def test_modules_of_a_room_do_not_import_each_other_in_a_circle() -> None:
    inside = {
        m: {o for o in imported(m) if room_of(o) == room_of(m) and not o.endswith("__init__")}
        for m in FILES
    }
    while leaves := [m for m, others in inside.items() if not others]:
        for leaf in leaves:
            del inside[leaf]
        for others in inside.values():
            others.difference_update(leaves)
    assert inside == {}, "these modules import each other"


def test_parquet_files_are_read_through_one_function() -> None:
    """Only ``read_parquet`` makes sure that no background thread of PyArrow outlives a read."""
    readers = {"ParquetFile", "ParquetDataset", "iter_batches", "read_row_group", "read_parquet"}
    calls = {
        (room_of(module), called.attr)
        for module in FILES
        for node in nodes(module)
        if isinstance(node, ast.Call)
        and isinstance(called := node.func, ast.Attribute)
        and (
            called.attr in readers
            or (called.attr == "read_table" and ast.unparse(called.value) == "pq")
        )
    }
    assert calls == {("user_file", "ParquetFile"), ("user_file", "read_row_group")}


def test_plant_is_pure_functions() -> None:
    for module in FILES:
        if room_of(module) != "plant":
            continue
        assert {room_of(other) for other in imported(module)} <= {"plant", "types", "errors"}
        for node in nodes(module):
            assert not isinstance(node, ast.Global | ast.Nonlocal), f"{module}:{node.lineno}"
            if isinstance(node, ast.ClassDef):
                kinds = [ast.unparse(d) for d in node.decorator_list]
                bases = {ast.unparse(base) for base in node.bases}
                is_frozen = any("frozen=True" in k for k in kinds)
                assert is_frozen or bases & {"Protocol", "NamedTuple"}, (
                    f"{module}.{node.name} may change"
                )


@pytest.mark.parametrize("module", [m for m in FILES if m.endswith("__init__")])
def test_each_folder_says_in_three_sentences_what_lives_there(module: str) -> None:
    tree = nodes(module)[0]
    assert isinstance(tree, ast.Module)
    said = ast.get_docstring(tree) or ""
    sentences = re.findall(r"[^.]\.(?:\s|$)", said)
    assert len(sentences) >= 3 or module == "__init__", f"{module}: {said!r}"


def fields_of_records() -> Iterator[tuple[str, str | None]]:
    """Each public field of a public class that holds data, and its docstring."""
    for module in FILES:
        for node in nodes(module):
            if not isinstance(node, ast.ClassDef) or node.name.startswith("_"):
                continue
            if module.startswith("cli.") and node.name.endswith("Options"):
                continue  # the help of each option says what it is
            marks = [ast.unparse(x) for x in (*node.decorator_list, *node.bases)]
            if not any(re.search(r"dataclass|BaseModel|_Section|NamedTuple", m) for m in marks):
                continue
            for field, after in zip(node.body, [*node.body[1:], None], strict=True):
                if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
                    continue
                name = field.target.id
                if name.startswith("_") or "ClassVar" in ast.unparse(field.annotation):
                    continue
                said = None
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    said = str(after.value.value)
                yield f"{module}.{node.name}.{name}", said


def test_every_public_field_has_a_docstring_that_stands_alone() -> None:
    fields = list(fields_of_records())
    assert [name for name, said in fields if not said] == []
    leaning = [name for name, said in fields if LEANS_ON_ITS_NEIGHBOUR.search(said or "")]
    assert leaning == []
