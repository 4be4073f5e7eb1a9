"""Kinds of hostile input for ``fuzz.py``, each a function that draws a case from a Generator."""

from __future__ import annotations

import copy
import functools
import gzip
import io
import json
import shutil
import tempfile
import threading
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pyarrow as pa
import yaml
from numpy.random import Generator
from typer.testing import CliRunner

import exogenous_builders as build
import test_malformed_config as configs
import test_malformed_data as data
import test_optimum_solve as optimum
import test_result_table as results
import test_saved_states as states
import test_user_functions as code
from faulty_server import drips_within, sends_bytes, serving
from made_studies import ROWS, done_job, frame_of, frames_of_row, write_study
from policies import interface, policy
from sdc_taichi import (
    PhysicalLimitError,
    RuntimeStateError,
    SdcError,
    load_config,
    parallel_env,
    preset_names,
    vector_env,
)
from sdc_taichi.benchmark.jobs import DoneJob, digest_of, run_job
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.submission import write_submission
from sdc_taichi.benchmark.sweep import sweep_inputs, sweep_jobs
from sdc_taichi.cli.app import app
from sdc_taichi.config import validated
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.exogenous.fetch.download import fetch
from sdc_taichi.learning.policy import WEIGHTS
from sdc_taichi.optimum.cache import OptimumCacheWarning
from sdc_taichi.sim import snapshot
from test_config import sustaindc_values
from test_fetch_download import ECHOES, QUICK, SECRET, request_to


@dataclass(frozen=True)
class Case:
    """One hostile input: it must end in a correct run, or in an ``SdcError`` of one line."""

    about: str
    """Description of the hostile input, printed if the case fails."""
    run: Callable[[], object]
    """Use the input; raise an ``SdcError`` if it is refused."""
    must_refuse: bool = False
    """True if the input must be refused."""
    secret: str = ""
    """Text that may appear in no message, log or file."""


Draw = Callable[[Generator, Path], Case]
KINDS: dict[str, tuple[Draw, float]] = {}
"""Function that draws a case of each kind, and the kind's share of all cases, relative to 1."""


def kind(share: float = 1.0) -> Callable[[Draw], Draw]:
    """Register a function that draws the cases of a kind, by its name."""

    def register(draw: Draw) -> Draw:
        KINDS[draw.__name__.replace("_", "-")] = draw, share
        return draw

    return register


# Values, nested values, bytes and commands

ODD: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 3, 2**31, 2**63, 10**30, -(10**30), 0.5, -0.0),
    *(1e-300, 1e300, -1e300, float("nan"), float("inf"), float("-inf")),
    *(
        "",
        " ",
        "x",
        "1",
        "nan",
        "é",
        "\u202e",
        "a\nb",
        "a\0b",
        "../../x",
        "/etc/passwd",
        "x" * 9999,
    ),
    *([], [None], [[1]], [1.0] * 5000, ["x"], {}, {"": 1}, {"a": {"b": []}}, {"x": None}),
)
"""Values that fit hardly anywhere."""
ODD_CELLS = ("", " ", "nan", "1e999", "-1", "999", "x", "1,5", '"', "'", "\0", "=1+1", "٣", "1_0")
"""Cells that fit in hardly any column of a table of text."""


def pick(rng: Generator, values: Any) -> Any:
    """Draw one of a sequence, whose type it keeps."""
    return values[int(rng.integers(len(values)))]


def odd_value(rng: Generator) -> Any:
    """Draw one of ``ODD``, or a number of any size."""
    if rng.random() < 0.8:
        return copy.deepcopy(pick(rng, ODD))
    return float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-320.0, 308.0))


def mutated(rng: Generator, values: Any) -> tuple[str, Any]:
    """Replace, remove, rename or repeat one of nested values; return what was done, and them."""
    *outer, name = pick(rng, [path for path in configs.places(values) if path])
    values = copy.deepcopy(values)
    parent = functools.reduce(lambda x, key: x[key], outer, values)
    place, action = ".".join(map(str, [*outer, name])), rng.random()
    if action < 0.7:
        parent[name] = odd_value(rng)
        return f"{place} = {str(parent[name])[:60]!r}", values
    if action < 0.8:
        del parent[name]
        return f"without {place}", values
    if isinstance(parent, dict):
        parent[f"{name}x"] = parent[name]
        return f"{place} twice, as {name}x", values
    parent.extend(parent * 50)
    return f"entries of {place} 51 times", values


def damaged(rng: Generator, content: bytes) -> tuple[str, bytes]:
    """Damage bytes; return what was done, and the bytes."""
    a, b = sorted(rng.integers(0, len(content) + 1, 2).tolist())
    near = min(b, a + 200)
    ways: dict[str, Callable[[], bytes]] = {
        f"cut at {a}": lambda: content[:a],
        f"without {a}:{near}": lambda: content[:a] + content[near:],
        f"{a}:{near} twice": lambda: content[:near] + content[a:],
        f"zeros in {a}:{near}": lambda: content[:a] + bytes(near - a) + content[near:],
        f"random bytes at {a}": lambda: content[:a] + rng.bytes(9) + content[a:],
        f"another byte at {a}": lambda: content[:a] + rng.bytes(1) + content[a + 1 :],
        "BOM": lambda: b"\xef\xbb\xbf" + content,
        "UTF-16": lambda: content.decode("latin-1").encode("utf-16"),
        "CR line ends": lambda: content.replace(b"\n", b"\r"),
        "bytes after the end": lambda: content + rng.bytes(50),
    }
    what = pick(rng, list(ways))
    return what, ways[what]()


def command(*words: str) -> None:
    """Run a command in this process; raise the ``SdcError`` that it prints with exit code 2."""
    done = CliRunner().invoke(app, words)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]
    if done.exit_code == 0:
        return
    if done.exit_code != 2 or len(lines) != 1 or not lines[0].startswith("error: "):
        raise AssertionError(f"{words}: exit code {done.exit_code}, stderr {done.stderr!r}")
    raise SdcError(lines[0])


def check_finite(values: Any) -> None:
    """Check that all numbers in nested values are finite."""
    if isinstance(values, Mapping):
        values = list(values.values())
    if isinstance(values, list | tuple):
        for each in values:
            check_finite(each)
    elif not np.isfinite(np.asarray(values, dtype=float)).all():
        raise AssertionError(f"numbers that are not finite: {values}")


def of_worker(make: Callable[[], Any]) -> Callable[[], Any]:
    """Let a function make its value once in each process."""
    return functools.cache(make)


@of_worker
def worker_folder() -> Path:
    """Folder of this process for what several cases share."""
    return Path(tempfile.mkdtemp(prefix="shared-"))


# Import paths


ODD_PATHS = (
    *(
        "marks:Mine",
        "marks:zero",
        "marks:Mine.reset",
        "marks:no_such",
        " marks:Mine",
        "marks :Mine",
    ),
    *(
        "marks::Mine",
        ":Mine",
        "marks:",
        "marks:Mine:1",
        "..marks:Mine",
        ".marks:Mine",
        "marks.x:Mine",
    ),
    *(
        "Marks:Mine",
        "ｍarks:Mine",
        "marks\u200b:Mine",
        "marks/:Mine",
        "./marks:Mine",
        "marks.py:Mine",
    ),
    *("load=idle,cooling=marks:Mine", "cooling=marks:zero", "load=marks:Mine,battery=idle"),
    *(
        "marks:" + "Mine." * 500,
        "a" * 3000 + ":b",
        "marks:Mine\nidle",
        "marks\0:Mine",
        "[marks:Mine]",
    ),
)
MODULES = (
    "cProfile",
    "timeit",
    "os",
    "subprocess",
    "code",
    "runpy",
    "pdb",
    "builtins",
    "json.tool",
)
"""Modules of the standard library, whose functions run what they are given."""


@kind(1.2)
def import_paths(rng: Generator, folder: Path) -> Case:
    """Import paths in every field of every file format that can hold the name of a function."""
    (folder / "marks.py").write_text(code.MODULE)
    if rng.random() < 0.5:
        path = pick(rng, ODD_PATHS)
    else:
        name = pick(rng, ("run", "system", "call", "main", "eval", "x.y", "_run", ""))
        path = f"{pick(rng, MODULES)}:{name}:open('{code.MARK}','w')"
    places = {**code.COMMANDS_OF_CONTROLLERS, **code.COMMANDS_OF_FUNCTIONS}
    place = pick(rng, list(places))
    return Case(f"{path!r} in {place}", lambda: command(*places[place](path)), must_refuse=True)


# Result folders from foreign sources


@of_worker
def made_study() -> Path:
    return write_study(worker_folder() / "made-up")


@of_worker
def finished_sweep() -> tuple[Path, list[Any], dict[str, bytes]]:
    inputs = sweep_inputs(results.SWEEP)
    jobs = list(sweep_jobs(results.SWEEP, inputs))
    for job in jobs:
        ResultStore(worker_folder() / "sweep").keep(run_job(job, inputs))
    return worker_folder() / "sweep", jobs, inputs


def forged_rows(rng: Generator, frame: pd.DataFrame) -> tuple[str, bytes]:
    """Rows of a result with a forged column, or damaged bytes; return what was done, and them."""
    if rng.random() < 0.2:
        return damaged(rng, results.parquet_of(frame))
    name, tables = pick(rng, list(frame.columns)), results.NUMBERS | results.TEXTS
    what = pick(rng, [*tables, "number", "one number", "type"])
    number = float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-320.0, 308.0))
    of_type = pick(rng, (pa.int8(), pa.uint64(), pa.float16(), pa.string(), pa.date32()))
    forge = {
        "number": results.column(number),
        "one number": results.cell(number),
        "type": results.column(None, of_type),
    }.get(what) or tables[what]
    try:
        return f"{what} in {name}", results.parquet_of(forge(frame, name))
    except (pa.ArrowInvalid, pa.ArrowTypeError):  # texts and numbers in one column
        return f"{name} of another type", results.parquet_of(results.column(number)(frame, name))


@kind(0.9)
def forged_results(rng: Generator, folder: Path) -> Case:
    """Rows and records of results that report, add and resume read."""
    user = pick(rng, ("report", "report record", "add", "resume", "resume record"))
    target = folder / "target"
    record = {"suite": "made-up", "case": "two-sites", "row": "g36", "seed": "0"}
    if user.startswith("report"):
        shutil.copytree(made_study(), target)
        if user == "report":
            what, rows = forged_rows(rng, frames_of_row("g36", 0))
            done = done_job("g36", 0, frames_of_row("g36", 0), spec=ROWS["g36"])
            ResultStore(target).keep(DoneJob(done.job, rows=rows, metrics=done.metrics))
        else:
            what = forged_record(rng, ResultStore(target).folder_of(record))
        words: tuple[str, ...] = (
            "benchmark",
            "report",
            str(target),
            "--out",
            "a.html",
            "--markdown",
            "a.md",
        )
        return Case(f"{user}: {what}", lambda: command(*words))
    if user == "add":
        shutil.copytree(made_study(), target)
        of_row: dict[str, Any] = {"suite": "made-up", "case": "two-sites", "row": "theirs"}
        write_submission(
            folder / "row", {0: frame_of(0.05)}, kind="controller", author="a", **of_row
        )
        store = ResultStore(folder / "row")
        (theirs,) = store.results()
        what, rows = forged_rows(rng, frame_of(0.05))
        store.write(theirs.model_copy(update={"rows_sha256": digest_of(rows)}), rows, {})
        words = ("benchmark", "add", str(folder / "row"), "--to", str(target))
        return Case(f"add: {what}", lambda: command(*words))
    swept = finished_sweep()
    copied = results.copied(swept, folder)
    store = ResultStore(copied)
    if user == "resume":
        theirs = store.result(swept[1][1].partition)
        what, rows = forged_rows(rng, pd.read_parquet(io.BytesIO(store.rows_file(theirs))))
        store.write(theirs.model_copy(update={"rows_sha256": digest_of(rows)}), rows, {})
    else:
        what = forged_record(rng, store.folder_of(swept[1][1].partition))
    return Case(f"{user}: {what}", lambda: results.resumed(copied, *swept[1:]))


def forged_record(rng: Generator, folder: Path) -> str:
    """Change the record of a job; return what was done."""
    path = folder / "metrics.json"
    if rng.random() < 0.3:
        what, content = damaged(rng, path.read_bytes())
        path.write_bytes(content)
    else:
        what, values = mutated(rng, json.loads(path.read_text()))
        path.write_text(json.dumps(values))
    return what


# Policies


@kind(1.2)
def forged_policies(rng: Generator, folder: Path) -> Case:
    """Policies whose header, weights or bytes are forged."""
    from safetensors.numpy import load, save

    policy(interface(agents=("agent_bat",))).save(folder)
    path, part = folder / WEIGHTS, rng.random()
    weights, described = load(path.read_bytes()), json.loads((folder / "policy.json").read_text())
    if part < 0.3:
        what, content = damaged(rng, path.read_bytes())
    elif part < 0.7:
        what, described = mutated(rng, described)
        content = save(weights, {"policy": json.dumps(described)})
    else:
        name = pick(rng, list(weights))
        forms: dict[str, Callable[[Any], Any]] = {
            "nan": lambda x: x * np.nan,
            "1e39 of f64": lambda x: np.full(x.shape, 1e39),
            "3e38": lambda x: np.full_like(x, 3e38),
            "0": np.zeros_like,
            "flat": lambda x: x.reshape(-1)[:-1],
            "int8": lambda x: x.astype(np.int8),
            "bool": lambda x: x > 0,
            "one more axis": lambda x: x[None],
            "nothing": lambda x: x.reshape(-1)[:0],
        }
        form = pick(rng, list(forms))
        what = f"{name} {form}"
        with np.errstate(all="ignore"):
            weights[name] = np.ascontiguousarray(forms[form](weights[name]))
        content = save(weights, {"policy": json.dumps(described)})
    path.write_bytes(content)
    words = pick(
        rng,
        (
            ("policy", "show", str(folder)),
            ("simulate", "tiny", "--days", "0.0625", "--controller", f"policy:{folder}", "--quiet"),
        ),
    )
    return Case(f"{words[0]}: {what}", lambda: command(*words))


# Cached optima


@of_worker
def cached_optimum() -> tuple[Any, Path]:
    cache = worker_folder() / "optimum"
    first = optimum.solved(optimum.config_of("CA"), steps=4, cache=cache)
    (path,) = cache.iterdir()
    return first, path


@kind(0.25)
def forged_optima(rng: Generator, folder: Path) -> Case:
    """Cached optima: those that are not believed are solved anew, with the same figures."""
    first, path = cached_optimum()
    forged, arrays, part = folder / "cache" / path.name, snapshot.read(path), rng.random()
    forged.parent.mkdir()
    if part < 0.2:
        what, content = damaged(rng, path.read_bytes())
        forged.write_bytes(content)
    else:
        if part < 0.4:
            what = pick(rng, list(optimum.FORGERIES))
            edit = optimum.FORGERIES[what](arrays)
        elif part < 0.7:
            what, text = mutated(rng, json.loads(str(arrays["text"])))
            edit = {"text": np.array(json.dumps(text))}
        else:
            name = pick(rng, list(arrays))
            value = pick(rng, (-1.0, 1e300, np.nan, 3, "x", [], [1.0] * 4, [[1.0] * 4], True, b"x"))
            what, edit = f"{name} = {value}", {name: np.array(value)}
        snapshot.write(forged, arrays | edit)

    def run() -> None:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            again = optimum.solved(optimum.config_of("CA"), steps=4, cache=forged.parent)
        check_finite([again.idle, again.achieved])
        if told:
            assert [each.category for each in told] == [OptimumCacheWarning], told
            assert again.achieved.tolist() == first.achieved.tolist()
            assert again.bound.tolist() == first.bound.tolist()
        assert np.all(again.bound <= again.achieved * (1.0 + 1e-6))

    return Case(what, run)


# Servers


@kind(1.2)
def hostile_servers(rng: Generator, folder: Path) -> Case:
    """Servers that send odd answers, slowly, with the user's key in them."""
    echo = pick(rng, ECHOES)(SECRET).encode()
    text = pick(rng, (echo, b"", b"9" * 5000, b"-1", b"\xff\0", b"x" * 70_000, b"a: b", b"1, 2"))
    status = pick(rng, (b"200 OK", b"302 Found", b"400 Bad", b"401 No", b"503 No", b"999 ?", echo))
    names = (b"Content-Length", b"ETag", b"Content-Encoding", b"Retry-After", b"Content-Type")
    header = pick(rng, (*names, b"Transfer-Encoding", b"Set-Cookie", echo))
    place = pick(
        rng,
        (b"/" + echo, b"http://" + echo + b".invalid/", b"file:///" + echo, b"//[", b"?k=" + echo),
    )
    body = pick(
        rng, (b'{"message": "' + echo + b'"}', b"[1]", b"<html>" + echo, b"\x1f\x8b" + echo)
    )
    if rng.random() < 0.3:
        body = gzip.compress(body * int(rng.integers(1, 50)))
    if rng.random() < 0.4:  # Otherwise hardly any answer is taken.
        status, body = b"200 OK", b"[1]"
    lines = [b"HTTP/1.1 " + status]
    if rng.random() < 0.7:
        lines.append(header + b": " + text)
    if b"302" in status or rng.random() < 0.1:
        lines.append(b"Location: " + place)
    packed = pick(rng, ("plain", "length", "chunked", "gzip"))
    if packed == "gzip":
        lines.append(b"Content-Encoding: gzip")
    if packed == "chunked":
        lines.append(b"Transfer-Encoding: chunked")
        size = pick(rng, (b"%x" % len(body), b"-1", b"f" * 40, b"1", echo, b"0x3"))
        body = size + b"\r\n" + body + b"\r\n0\r\n\r\n"
    elif packed == "length":
        lines.append(b"Content-Length: %d" % (len(body) + int(rng.integers(-2, 3))))
    whole = b"\r\n".join([*lines, b"", body])
    if rng.random() < 0.2:
        whole = damaged(rng, whole)[1]
    at, drop = (
        int(rng.integers(len(whole) + 1)),
        pick(rng, (b"", b"a", b" ", b"0", b"\r\n", b"x: y\r\n")),
    )
    dripping = rng.random() < 0.4

    def run() -> None:
        patience = replace(QUICK, total_s=0.3)
        with serving() as server:
            slow = drips_within(whole[:at], drop, whole[at:], 0.02, lambda: server.stopped)
            server.answers = [slow if dripping else sends_bytes(whole)]
            try:
                fetch([request_to(server.url, key=SECRET)], patience=patience)
            finally:
                server.stopped.set()
                for thread in threading.enumerate():
                    if thread.name == "sdc-taichi-download":
                        thread.join(10.0)
                        assert not thread.is_alive(), "a download goes on after its time"

    about = f"{whole[:300]!r}" + (
        f", after {at} bytes {drop!r} again and again" if dripping else ""
    )
    return Case(about, run, secret=SECRET[4:-4])


# Configurations, data files and saved states

TINY = load_config("tiny").model_dump(mode="json")


@kind(1.6)
def malformed_configurations(rng: Generator, folder: Path) -> Case:
    """Configurations and settings with values, names and bytes that do not fit."""
    form = pick(rng, ("model", "file", "override", "bytes", "SustainDC", "sample"))
    if form == "model":
        model, values = pick(rng, configs.SETTINGS)
        what, values = mutated(rng, values)
        return Case(f"{model.__name__}: {what}", lambda: validated(model, values, "file"))
    path = folder / "mine.yaml"
    words: tuple[str, ...] = ("config", "check", str(path))
    if form == "override":
        place = ".".join(map(str, pick(rng, [x for x in configs.places(TINY) if x])))
        text = yaml.safe_dump(odd_value(rng), default_flow_style=True).removesuffix("\n...\n")
        what = f"{place}={text.strip()}"
        return Case(what[:200], lambda: command("config", "check", "tiny", what))
    if form == "sample":
        sample = {
            "hvac.chiller.reference_cop": {"uniform": [4.0, 6.0]},
            "hall.rows": {"choice": [2]},
        }
        what, values = mutated(rng, sample)
        path.write_text(yaml.safe_dump(values))
        words = (
            "simulate",
            "tiny",
            "--dcs",
            "2",
            "--days",
            "0.0625",
            "--sample",
            str(path),
            "--quiet",
        )
    elif form == "file":
        what, values = mutated(rng, {"extends": "tiny", **TINY})
        path.write_text(yaml.safe_dump(values))
        if rng.random() < 0.5:
            words = ("simulate", str(path), "--days", "0.0625", "--quiet")
    elif form == "bytes":
        what, content = damaged(rng, yaml.safe_dump(TINY).encode())
        path.write_bytes(content)
    else:
        path = folder / "dc_config.json"
        what, values = mutated(rng, sustaindc_values())
        path.write_text(json.dumps(values))
        words = ("config", "check", str(path))
    return Case(f"{form}: {what}", lambda: command(*words))


@of_worker
def undamaged() -> dict[str, bytes]:
    return {name: make() for name, make in data.UNDAMAGED.items()}


@kind(1.3)
def malformed_data(rng: Generator, folder: Path) -> Case:
    """Weather, carbon and workload files with cells, rows and bytes that do not fit."""
    name = pick(rng, list(undamaged()))
    content, path = undamaged()[name], folder / name
    if name.endswith(".parquet") or rng.random() < 0.3:
        what, content = damaged(rng, content)
    else:
        lines, whats = content.decode().splitlines(), []
        for _ in range(int(rng.integers(1, 4))):
            row = int(rng.integers(1, min(len(lines), pick(rng, (10, 9000)))))
            column = int(rng.integers(lines[row - 1].count(",") + 1))
            last = min(row + int(rng.integers(0, 40)), len(lines) - 1)
            changes: dict[str, Callable[[list[str]], list[str]]] = {
                "cell": data.cell(row, column, pick(rng, ODD_CELLS)),
                "rows removed": data.cut(row, last),
                "row repeated": data.repeat_row(row),
                "rows swapped": data.swap_rows(row),
                "other row": data.replace_row(row, pick(rng, ODD_CELLS)),
                "separators": lambda x: [line.replace(",", ";") for line in x],
                "long cell": data.cell(row, column, "x" * 200_000),
            }
            if not name.endswith(".epw"):
                changes["column removed"] = data.without_column(column)
            what = pick(rng, list(changes))
            lines = changes[what](lines)
            whats.append(f"{what} at row {row}, column {column}")
            if what in ("separators", "other row", "column removed"):
                break
        what, content = "; ".join(whats), build.text(lines).encode()
    path.write_bytes(content)
    if rng.random() < 0.3 and not name.endswith(".parquet"):
        words = ("data", "import", str(path), "--site", "mine", "--base", "ny")
        return Case(f"import {name}: {what}", lambda: command(*words))
    return Case(f"{name}: {what}", lambda: data.read(path))


@functools.cache
def saved_episode(name: str) -> tuple[Any, Any]:
    """Return an environment or simulator, and its state after some steps."""
    env = states.MAKERS[name]()
    env.reset(seed=2)
    states.play(env, states.STEPS)
    return env, env.state_dict()


def mutated_state(rng: Generator, state: Any) -> tuple[str, Any]:
    """Change one entry of a saved state; return what was done, and the state."""
    state = copy.deepcopy(state)
    *outer, name = pick(rng, [path for path in configs.places(state) if path])
    parent = functools.reduce(lambda x, key: x[key], outer, state)
    place, old = ".".join(map(str, [*outer, name])), parent[name]
    if not isinstance(old, np.ndarray) or rng.random() < 0.2:
        if rng.random() < 0.2:
            del parent[name]
            return f"without {place}", state
        parent[name] = odd_value(rng)
        return f"{place} = {str(parent[name])[:60]!r}", state
    forms: dict[str, Callable[[Any], Any]] = {
        "one number": lambda a: np.full(a.shape, pick(rng, (np.nan, np.inf, -1e15, 1e6, 0.5))),
        "f16": lambda a: a.astype(np.float16),
        "objects": lambda a: a.astype(object),
        "texts": lambda a: a.astype(str),
        "flat": lambda a: a.reshape(-1)[:-1],
        "empty": lambda a: a.reshape(-1)[:0],
        "one more axis": lambda a: a[None],
        "other bits": lambda a: np.frombuffer(rng.bytes(a.nbytes), a.dtype).reshape(a.shape),
    }
    if old.dtype.kind in "biuf":
        factor = rng.uniform(-3.0, 3.0)
        forms["scaled"] = lambda a: (a * factor).astype(a.dtype)
    form = pick(rng, list(forms))
    with np.errstate(all="ignore"):
        parent[name] = forms[form](old)
    return f"{place} {form}", state


@kind(1.7)
def saved_states(rng: Generator, folder: Path) -> Case:
    """Saved states with changed entries: refused without an effect, or continued."""
    name = pick(rng, list(states.MAKERS))
    env, saved = saved_episode(name)
    what, state = mutated_state(rng, saved)

    def run() -> None:
        env.load_state_dict(copy.deepcopy(saved))
        try:
            env.load_state_dict(state)
        except SdcError:
            try:
                after = env.state_dict()
            except RuntimeStateError:  # No step can follow this state, which a reset mends.
                env.reset(seed=2)
            else:
                assert states.equal(after, saved), "a refused state has changed the episode"
            raise
        try:
            played = states.play(env, 2)
        except PhysicalLimitError:
            return
        if name not in ("simulator", "steady simulator"):
            check_finite([each[:2] for each in played])

    return Case(f"{name}: {what}", run)


# Actions

FORMS = ("parallel", "aec", "single", "joint", "make_vec", "vector")
IDS = {"agent_ls": "Load", "agent_dc": "Cooling", "agent_bat": "Battery"}
BATCH = 3
LARGE_HALLS = ("frontier_like", "hall_agents_16", "hall_agents_64")
"""Presets that differ from ``hall_agents_6`` in size alone."""
ACTIONS: dict[str, Callable[[Generator, gymnasium.Space[Any], tuple[int, ...], Any], Any]] = {
    "random": lambda rng, space, shape, valid: valid,
    "lowest": lambda rng, space, shape, valid: np.zeros_like(valid) - (valid.dtype.kind == "f"),
    "highest": lambda rng, space, shape, valid: valid * 0 + (1 if valid.dtype.kind == "f" else 2),
    "beyond": lambda rng, space, shape, valid: valid * 0 + pick(rng, (3, -7)),
    "huge": lambda rng, space, shape, valid: np.full(shape, pick(rng, (1e300, -1e300, 2.0**63))),
    "nan": lambda rng, space, shape, valid: np.full(shape, pick(rng, (np.nan, np.inf, -np.inf))),
    "other shape": lambda rng, space, shape, valid: np.zeros((*shape, 2), valid.dtype),
    "texts": lambda rng, space, shape, valid: np.full(shape, "x"),
    "None": lambda rng, space, shape, valid: None,
    "dict": lambda rng, space, shape, valid: {"a": 1},
}
"""Actions of an agent from its space, the shape of the action, and valid random actions."""
VALID_ACTIONS = ("random", "lowest", "highest")
CLIPPED_ACTIONS = ("beyond", "huge")


def options_of_environment(rng: Generator, form: str) -> dict[str, Any]:
    """Draw preset, precision, commands and kind of actions of an environment."""
    preset = pick(rng, [name for name in preset_names() if name not in LARGE_HALLS])
    overrides: dict[str, Any] = {"workload.trace": pick(rng, ("alibaba_1", "google_1"))}
    commands: dict[str, list[str]] = {}
    config = load_config(preset)
    closed = config.hall.inlet_model == "recirculation"
    of_units = config.hvac.crac.flow_model == "controlled"
    if closed and rng.random() < 0.5:
        overrides["hvac.crac.flow_model"] = "controlled"
        commands["agent_dc"] = ["cooling", "fan"]
    if closed and rng.random() < 0.5:
        overrides["workload.placement"] = "weights"
        commands["agent_ls"] = ["load", "placement"]
    if closed and config.hvac.crac.spare_units == 0 and rng.random() < 0.3:
        overrides["hvac.crac.units"] = int(rng.integers(2, 5))
    options: dict[str, Any] = {
        "config": preset,
        "overrides": overrides,
        "days": 1,
        "actions": pick(rng, ("discrete", "continuous")),
        "precision": pick(rng, ("f32", "f64")),
        "rewards": pick(rng, ("default", "bill", "paper")),
    }
    if options["actions"] == "continuous" and rng.random() < 0.6:
        options["clip_actions"] = pick(rng, (None, True, False))
    if form not in ("single", "make_vec"):
        agents = [agent for agent in AGENTS if rng.random() < 0.7] or ["agent_dc"]
        options["agents"] = agents
        commands = {agent: names for agent, names in commands.items() if agent in agents}
        if len(agents) < 3:
            options["others"] = pick(
                rng, ("idle", "constant:20" if "agent_dc" not in agents else "idle")
            )
    if form in ("parallel", "vector", "aec"):
        options["heat_map"] = bool(rng.random() < 0.1) and config.fleet is None
        if of_units and rng.random() < 0.6:
            options["agents"] = pick(rng, (["crac"], ["plant"], ["crac", "plant"]))
            options |= {"rewards": "default", "others": "idle"}
            commands = {}
            if "crac" in options["agents"]:
                options["neighbours"] = int(rng.integers(0, 4))
        if config.liquid is not None and rng.random() < 0.6:
            groups = ["plant", "cdu", "power_cap"]
            options["agents"] = [x for x in groups if rng.random() < 0.6] or ["cdu"]
            others = pick(rng, ("idle", "liquid=liquid-reset", "liquid=liquid-wet-bulb"))
            options |= {"rewards": pick(rng, ("default", "bill")), "others": others}
            if {"cdu", "power_cap"} <= set(options["agents"]):
                options["others"] = "idle"
            of_plant = {"plant": ["facility_approach_k", "reuse_share"]}
            commands = of_plant if "plant" in options["agents"] else {}
            options.pop("neighbours", None)
        if config.fleet is not None and options["rewards"] != "bill":
            options["agents"] = [*options["agents"], "agent_geo"]
            options.pop("others", None)
    return options | ({"commands": commands} if commands else {})


def made_environment(form: str, options: dict[str, Any], agent: str) -> Any:
    if form == "parallel":
        return parallel_env(**options)
    if form == "aec":
        from sdc_taichi import aec_env

        return aec_env(**options)
    if form == "vector":
        return vector_env(BATCH, **options)
    commands = options.get("commands", {})
    if form != "joint":
        own = {"commands": {agent: commands[agent]}} if agent in commands else {}
        options = {k: v for k, v in options.items() if k != "commands"} | own
    if form == "make_vec":
        return gymnasium.make_vec(f"sdc_taichi/{IDS[agent]}-v0", num_envs=BATCH, **options)
    name = "Joint" if form == "joint" else IDS[agent]
    return gymnasium.make(f"sdc_taichi/{name}-v0", disable_env_checker=True, **options)


def agent_spaces(env: Any, form: str) -> dict[str, gymnasium.Space[Any]]:
    """Return the space of one environment's action by agent; '' names a single learner."""
    if form in ("single", "joint"):
        return {"": env.action_space}
    if form == "make_vec":
        return {"": env.single_action_space}
    if form == "vector":
        return dict(env.action_spaces)
    return {agent: env.action_space(agent) for agent in env.possible_agents}


def step(env: Any, form: str, actions: dict[str, Any]) -> bool:
    """Do a step, and check that its results are finite; return True if an episode has ended."""
    if form == "aec":
        for agent in list(env.agents):
            env.step(actions[agent])
        check_finite([[env.observe(agent) for agent in env.agents], env.rewards])
        return any([*env.terminations.values(), *env.truncations.values()])
    observations, rewards, *ends, _ = env.step(actions.get("", actions))
    check_finite([observations, rewards])
    return any(np.any([*each.values()] if isinstance(each, dict) else each) for each in ends)


@kind(1.3)
def actions(rng: Generator, folder: Path) -> Case:
    """Actions of every kind in every form of environment: valid ones give finite results."""
    form, agent = pick(rng, FORMS), pick(rng, AGENTS)
    options = options_of_environment(rng, form)
    kinds = [pick(rng, VALID_ACTIONS if rng.random() < 0.6 else list(ACTIONS)) for _ in range(6)]
    clips = options.get("clip_actions")
    clips = (form in ("make_vec", "vector")) if clips is None else clips
    clips = clips and options["actions"] == "continuous"
    batch = (BATCH,) if form in ("make_vec", "vector") else ()

    def run() -> None:
        env = made_environment(form, options, agent)
        env.reset(seed=int(rng.integers(1000)))
        spaces = agent_spaces(env, form)
        for name in kinds:
            drawn = {}
            for of_agent, space in spaces.items():
                names = env.core.members.get(of_agent, ()) if form == "vector" else ()
                members = (len(names),) if names not in ((), (of_agent,)) else ()
                rows = (*batch, *members)
                shape = (*rows, *(space.shape or ()))
                space.seed(int(rng.integers(2**31)))
                samples = [space.sample() for _ in range(int(np.prod(rows)))]
                valid = np.stack(samples).reshape(shape)
                drawn[of_agent] = ACTIONS[name](rng, space, shape, valid)
            accepted = name in VALID_ACTIONS or (clips and name in CLIPPED_ACTIONS)
            try:
                ended = step(env, form, drawn)
            except SdcError as error:
                if accepted or "\n" in str(error):
                    raise AssertionError(f"{name} actions are refused") from error
                # PettingZoo's AEC environment keeps refused actions of the agents that acted first.
                if form == "aec":
                    env.reset(seed=0)
            else:
                assert accepted, f"{name} actions are accepted"
                if ended:
                    return

    return Case(f"{form} {agent} {options}: {', '.join(kinds)}", run)
