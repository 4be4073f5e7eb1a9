"""Code that files name: refused in every file format, unless the user allows it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import yaml
from typer.testing import CliRunner

from made_studies import frame_of, write_study
from policies import interface, policy
from sdc_taichi import ConfigError, build_fleet, load_config
from sdc_taichi.benchmark.submission import write_submission
from sdc_taichi.benchmark.suite import load_suite
from sdc_taichi.cli.app import app
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.policy import About, Policy
from sdc_taichi.learning.training_folder import settings_of
from sdc_taichi.learning.training_settings import load_settings
from sdc_taichi.run.folder_reader import read_run
from sdc_taichi.run.inlets_of_run import inlets_at_step
from sdc_taichi.run.steps_file import METADATA_KEY

MARK = Path("code_ran")
"""File that appears in the current folder if code of a file runs."""
CONTROLLERS = (f"cProfile:run:open('{MARK}','w')", "marks:Mine", "load=idle,cooling=marks:Mine")
"""Controllers whose code is in the standard library, or in the current folder."""
FUNCTIONS = ("marks:zero", "cProfile:run")
"""Rewards and costs by import path."""
MODULE = f"""
import numpy as np
from sdc_taichi import Actions

open("{MARK}", "w").close()

class Mine:
    def reset(self, seed):
        pass

    def act(self, view):
        return Actions()

def zero(result, view):
    return np.zeros(view.size)
"""
SUITE: dict[str, Any] = {
    "title": "Code",
    "seeds": 1,
    "cases": {"one": {"config": "tiny", "optimum": False, "weeks": [3], "days": 2}},
}
TRAINING: dict[str, Any] = {
    "algorithm": "cross-entropy",
    "config": "tiny",
    "data_centers": 8,
    "learning": {"candidates": 8},
    "weeks": [2, 3],
    "steps": 2000,
    "validation": {"steps": 0},
    "tensorboard": False,
    "environment": {"days": 1},
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The current folder, with a module that leaves the mark when it is imported."""
    monkeypatch.chdir(tmp_path)
    Path("marks.py").write_text(MODULE)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    sys.modules.pop("marks", None)


def invoke(*words: str) -> tuple[int, str]:
    """Run a command; return its exit code and what it printed on stderr."""
    done = CliRunner().invoke(app, words)
    return done.exit_code, done.stderr


def suite(**values: Any) -> str:
    row = {"about": "A row: its text is not a path", "controller": "idle"}
    content = {**SUITE, "rows": {"rewards": row}} | values
    Path("mine.yaml").write_text(yaml.safe_dump(content))
    return "mine.yaml"


def settings(file: str = "mine.yaml", **environment: Any) -> str:
    agents = {"agents": ["agent_ls"]} if "others" in environment else {}
    content = TRAINING | {"environment": {"days": 1, **agents, **environment}}
    Path(file).parent.mkdir(exist_ok=True)
    Path(file).write_text(yaml.safe_dump(content))
    return file


def training(**environment: Any) -> str:
    settings("resumed/settings.yaml", **environment)
    return "resumed"


def policy_folder(others: str) -> str:
    made = policy(interface(agents=("agent_bat",)))
    replace(made, about=About(algorithm="none", others=others)).save(Path("trained"))
    return "trained"


def run_folder(controller: str) -> str:
    assert invoke("simulate", "tiny", "--days", "0.125", "--out", "run", "--quiet")[0] == 0
    path = Path("run/metrics.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"controller": controller}))
    table = pq.read_table("run/steps.parquet")
    metadata = dict(table.schema.metadata)
    about = json.loads(metadata[METADATA_KEY]) | {"controller": controller}
    metadata[METADATA_KEY] = json.dumps(about).encode()
    pq.write_table(table.replace_schema_metadata(metadata), "run/steps.parquet")
    return "run"


def submission(others: str) -> tuple[str, ...]:
    folder, target = Path(policy_folder(others)), write_study(Path("study"))
    files = {f"best/{path.name}": path.read_bytes() for path in folder.iterdir()}
    names = {"suite": "made-up", "case": "two-sites", "row": "theirs", "author": "A"}
    write_submission(Path("row"), {0: frame_of(0.05)}, kind="controller", files={0: files}, **names)
    return ("benchmark", "add", "row", "--to", str(target), "--verify", "1")


def row(**values: Any) -> dict[str, Any]:
    return {"rows": {"theirs": values}}


def trained(environment: dict[str, Any]) -> dict[str, Any]:
    return row(train={"algorithm": "cross-entropy", "environment": environment})


COMMANDS_OF_CONTROLLERS: dict[str, Callable[[str], tuple[str, ...]]] = {
    "row": lambda x: ("benchmark", suite(**row(controller=x))),
    "best_of": lambda x: ("benchmark", suite(**row(best_of=["idle", x]))),
    "others of a row": lambda x: ("benchmark", suite(**trained({"others": x}))),
    "quick": lambda x: ("benchmark", suite(quick={"rows": {"a": {"controller": x}}}), "--quick"),
    "settings": lambda x: ("train", "--settings", settings(others=x)),
    "resumed": lambda x: ("train", "--resume", "--out", training(others=x)),
    "simulate": lambda x: ("simulate", "tiny", "--controller", f"policy:{policy_folder(x)}"),
    "optimum": lambda x: ("optimum", "tiny", "--controller", f"policy:{policy_folder(x)}"),
    "sweep": lambda x: (
        *("sweep", "tiny", "--site", "ny,ca", "--controller"),
        f"policy:{policy_folder(x)}",
    ),
    "evaluate": lambda x: ("evaluate", policy_folder(x), "--config", "tiny"),
    "policy in a row": lambda x: (
        "benchmark",
        suite(**row(controller=f"policy:{policy_folder(x)}")),
    ),
    "run": lambda x: ("hall", "why", run_folder(x), "--step", "1"),
    "submission": submission,
}
COMMANDS_OF_FUNCTIONS: dict[str, Callable[[str], tuple[str, ...]]] = {
    "rewards": lambda x: ("train", "--settings", settings(rewards=x)),
    "costs": lambda x: ("train", "--settings", settings(costs=[x])),
    "weights": lambda x: ("train", "--settings", settings(costs={x: 2.0})),
    "resumed": lambda x: ("train", "--resume", "--out", training(rewards=x)),
    "row": lambda x: ("benchmark", suite(**trained({"rewards": x}))),
    "training": lambda x: ("benchmark", suite(training={"environment": {"costs": [x]}})),
    "case": lambda x: (
        "benchmark",
        suite(cases={"one": SUITE["cases"]["one"] | {"environment": {"rewards": x}}}),
    ),
}
PLACES = [
    *((command, x) for command in COMMANDS_OF_CONTROLLERS.values() for x in CONTROLLERS),
    *((command, x) for command in COMMANDS_OF_FUNCTIONS.values() for x in FUNCTIONS),
]


@pytest.mark.parametrize(("command", "path"), PLACES)
def test_no_command_runs_code_that_a_file_names(
    command: Callable[[str], tuple[str, ...]], path: str
) -> None:
    code, error = invoke(*command(path))
    assert code == 2, error
    assert "is an import path, and code that a file names is not run; valid" in error
    assert "--allow-code" in error
    assert error.count("\n") == 1
    assert path.partition("=")[2].rpartition("=")[2] in error or path in error
    assert not MARK.exists()
    assert "" not in sys.path[1:]


@pytest.mark.parametrize(
    "read",
    [
        lambda x, **allow: load_suite(suite(**row(controller=x)), **allow),
        lambda x, **allow: load_settings(settings(others=x), **allow),
        lambda x, **allow: settings_of(Path(training(others=x)), **allow),
        lambda x, **allow: PolicyController(
            Policy.load(Path(policy_folder(x))), build_fleet(load_config("tiny")), **allow
        ),
        lambda x, **allow: inlets_at_step(read_run(Path(run_folder(x))), 0, 1, **allow),
    ],
    ids=["suite", "settings", "training", "policy", "run"],
)
def test_files_read_in_python_name_code_with_allow_code_alone(
    read: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend("")
    with pytest.raises(ConfigError, match=r"code that a file names is not run.*allow_code=True"):
        read("marks:Mine")
    assert not MARK.exists()
    read("marks:Mine", allow_code=True)


def test_a_suite_runs_code_with_allow_code() -> None:
    file = suite(**row(controller="marks:Mine"))
    assert invoke("benchmark", file, "--allow-code", "--jobs", "1", "--out", "out")[0] == 0
    assert MARK.exists()


@pytest.mark.parametrize("command", ["simulate", "run"])
def test_other_files_name_code_with_allow_code(command: str) -> None:
    words = COMMANDS_OF_CONTROLLERS[command]("marks:Mine")
    more = ("--days", "0.125") if command == "simulate" else ()
    assert invoke(*words, *more, "--allow-code")[0] == 0
    assert MARK.exists()


def test_a_training_with_a_reward_of_the_command_line_resumes_with_allow_code() -> None:
    pytest.importorskip("torch", reason="torch is not installed: make test-train")
    begin = ("train", "--settings", settings(), "--out", "out", "--quiet")
    assert invoke(*begin, "--rewards", "marks:zero") == (0, "")
    resume = ("train", "--resume", "--out", "out", "--steps", "4000", "--quiet")
    code, error = invoke(*resume)
    assert code == 2, error
    assert error.startswith("error: out/settings.yaml: environment.rewards 'marks:zero': is an")
    assert "or --allow-code" in error
    assert invoke(*resume, "--allow-code") == (0, "")


@pytest.mark.parametrize(
    ("words", "runs"),
    [
        (("--controller", "marks:Mine"), True),
        (("--controller=load=idle,cooling=marks:Mine",), True),
        (("--controller", "xmarks:Mine"), False),
    ],
)
def test_the_command_line_names_code(words: tuple[str, ...], runs: bool) -> None:
    code, error = invoke("simulate", "tiny", "--days", "0.125", *words)
    assert (code == 0) is runs is MARK.exists(), error


@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "tiny", "--days", "0.125", "--controller", "faulty:Mine"),
        ("train", "--settings", "mine.yaml", "--rewards", "faulty:reward", "--out", "out"),
        ("train", "--settings", "mine.yaml", "--set", "environment.costs=[faulty:cost]"),
    ],
    ids=["controller", "reward", "cost"],
)
def test_an_error_in_code_of_the_user_names_its_line(words: tuple[str, ...]) -> None:
    if words[0] == "train":
        pytest.importorskip("torch", reason="torch is not installed: make test-train")
    settings()
    Path("faulty.py").write_text(
        "class Mine:\n    commands = ('load',)\n    def reset(self, seed): pass\n"
        "    def act(self, view):\n        return view.no_such_field\n"
        "def reward(result, view):\n    return [1, 2][3]\n"
        "def cost(result, view):\n    return {}['a']\n"
    )
    code, error = invoke(*words)
    sys.modules.pop("faulty", None)
    line = {"simulate": 5, "train": 7 if "--rewards" in words else 9}[words[0]]
    assert code == 1, error
    assert f"faulty.py:{line})\n" in error
    assert error.splitlines()[-1].startswith("error: ")
