"""A fixed sample of the fuzzed cases: each ends in one clear error or in a correct run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.areas import AREAS, SEED
from fuzz.case import run_case


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, plan in AREAS.items() if plan.sample])
def test_every_case_ends_in_a_clear_error_or_a_correct_run(name: str, tmp_path: Path) -> None:
    if name == "faults" and not hasattr(os, "fork"):
        pytest.skip("the faults are those of POSIX systems")
    plan = AREAS[name]
    found = [run_case(name, plan.area, SEED, number, tmp_path) for number in range(plan.sample)]
    failures = [f"{o.area}:{o.number}\n{o.text}" for o in found if o.kind == "failure"]
    assert not failures, "\n".join(failures)
    assert {outcome.kind for outcome in found} == {"error", "run"}, "all cases are of one kind"


def test_a_case_is_the_same_in_every_run(tmp_path: Path) -> None:
    first, again = (run_case("configs", AREAS["configs"].area, 1, 4, tmp_path) for _ in "ab")
    assert first == again


WATCHED = r"""
import sys
seen = []

def watch(event, arguments):
    writes = event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+")
    if writes or event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.link"):
        seen.append(arguments[0])
    elif event == "os.rename":
        seen.extend(arguments[:2])
    elif event in ("socket.connect", "socket.bind", "os.system"):
        seen.append(event)

sys.addaudithook(watch)
from sdc_taichi.cli.app import app
try:
    app(["simulate", "tiny", "--days", "0.0625", "--out", "out", "--quiet"])
finally:
    print(*(one for one in seen if not isinstance(one, int)), sep="\n")
"""


def test_a_run_writes_nowhere_else_and_asks_no_network(tmp_path: Path) -> None:
    # The kernels of other tests, which take long to compile.
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    home, own = tmp_path / "home", {tmp_path / "out", tmp_path / "tmp", Path(cache)}
    for name in ("tmp", "home"):
        (tmp_path / name).mkdir()
    env = {k: v for k, v in os.environ.items() if not k.startswith("XDG")}
    env["XDG_CACHE_HOME"] = cache
    done = subprocess.run(
        [sys.executable, "-B", "-c", WATCHED],
        cwd=tmp_path, env=env | {"HOME": str(home), "TMPDIR": str(tmp_path / "tmp")},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    touched = {tmp_path / line for line in done.stdout.splitlines()} - {Path(os.devnull)}
    assert tmp_path / "out" in touched
    assert {p for p in touched if not own & {p, *p.parents}} == set()
    assert {path.name for path in tmp_path.iterdir()} <= {"out", "tmp", "home"}
