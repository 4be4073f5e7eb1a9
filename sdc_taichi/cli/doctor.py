"""``sdc-taichi doctor``: check which parts of the package work on this machine."""

from __future__ import annotations

import json
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib import metadata, util
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from sdc_taichi.cli.options import json_option
from sdc_taichi.cli.terminal import PlainConsole
from sdc_taichi.errors import SdcError, one_line


class Extra(NamedTuple):
    """An optional dependency group (extra) of the package."""

    modules: tuple[str, ...]
    """Names of the modules that the extra installs."""
    purpose: str
    """What the extra is needed for, as text."""


EXTRAS = {
    "plot": Extra(("matplotlib",), "pictures and reports"),
    "excel": Extra(("xlsxwriter",), "export to Excel"),
    "fetch": Extra(("requests", "urllib3"), "data fetch"),
    "train": Extra(("torch", "tensorboard"), "training; trained policies run without it"),
    "onnx": Extra(("onnx", "onnxruntime"), "export of policies as ONNX"),
    "scale": Extra(("ray",), "jobs on a cluster (--ray)"),
    "offline": Extra(("minari", "h5py"), "data sets of episodes (collect)"),
}
"""Extras that users can install with ``pip install "sdc-taichi[NAME]"``, by name."""
_LIBRARIES = ("taichi", "numpy", "pandas", "pyarrow", "gymnasium", "pettingzoo", "rerun-sdk")


class Finding(NamedTuple):
    """Result of one check, such as of a library or a folder."""

    what: str
    """Name of the checked item."""
    found: str
    """State of the item, as text."""
    advice: str = ""
    """How to install or repair the item; empty if nothing is missing."""
    is_broken: bool = False
    """True if the simulator cannot run in this state."""


def doctor_command(
    as_json: Annotated[bool, json_option("Print JSON.")] = False,
) -> None:
    """List what this machine has, what is missing, and how to install it.

    Checks versions, processors, folders, the viewer and whether keys are set, and steps a small
    hall. The exit code is 1 if the simulator does not run.
    """
    findings = [*_versions(), *_extras(), *_machine(), *_keys(), _first_step()]
    works = not any(each.is_broken for each in findings)
    if as_json:
        values = [each._asdict() for each in findings]
        print(json.dumps({"works": works, "findings": values}, indent=1))
    else:
        console = PlainConsole(highlight=False, soft_wrap=True)
        width = max(len(each.what) for each in findings)
        for each in findings:
            console.print(f"{each.what:{width}}  {each.found}")
        if advice := [f"  {each.what}: {each.advice}" for each in findings if each.advice]:
            console.print("\n".join(["\nWhat can be mended or added:", *advice]))
        console.print("\nThe simulator works." if works else "\nThe simulator does not work.")
    if not works:
        raise typer.Exit(1)


def _versions() -> Iterator[Finding]:
    """Yield the versions of the package, Python, the operating system and the main libraries."""
    yield Finding("sdc-taichi", metadata.version("sdc-taichi"))
    yield Finding("Python", f"{platform.python_version()}, {sys.executable}")
    yield Finding("system", f"{platform.system()} {platform.release()}, {platform.machine()}")
    for name in _LIBRARIES:
        yield Finding(name, metadata.version(name))


def _extras() -> Iterator[Finding]:
    """Yield for each extra of the package whether all its modules are installed."""
    for name, extra in EXTRAS.items():
        is_whole = all(util.find_spec(module) for module in extra.modules)
        advice = "" if is_whole else f'pip install "sdc-taichi[{name}]"'
        state = "installed" if is_whole else "not installed"
        yield Finding(f"extra {name}", f"{extra.purpose}: {state}", advice)


def _machine() -> Iterator[Finding]:
    """Yield the state of processors, writable folders, and the viewer of recordings."""
    from sdc_taichi.cli.view import viewer_program
    from sdc_taichi.exogenous.registry import user_data_dir
    from sdc_taichi.kernels.compiler.runtime import (
        CACHE_VARIABLE,
        allowed_processors,
        processor_quota,
        usual_folder,
    )

    allowed, quota = len(allowed_processors()), processor_quota()
    limit = f", the container grants {quota:g}" if quota < allowed else ""
    yield Finding("processors", f"{allowed} of {os.cpu_count()} may be used{limit}")
    yield _folder("compiled kernels", usual_folder(), f"XDG_CACHE_HOME or {CACHE_VARIABLE}")
    yield _folder("imported data", user_data_dir(), "SDC_TAICHI_DATA")
    yield _folder("temporary files", Path(tempfile.gettempdir()), "TMPDIR")
    try:
        yield Finding("viewer", str(viewer_program()))
    except SdcError as error:
        yield Finding("viewer", "none", str(error))


def _folder(what: str, folder: Path, variable: str) -> Finding:
    """Check that files can be written to a folder, or to its closest existing parent.

    Args:
        what: content of the folder, such as ``compiled kernels``.
        folder: path of the folder, which need not exist.
        variable: environment variable with which users choose another folder.
    """
    parent = next(each for each in (folder, *folder.parents) if each.exists())
    try:
        with tempfile.TemporaryFile(dir=parent):
            free = shutil.disk_usage(parent).free
    except OSError as error:
        advice = f"name a folder that can be written in {variable}"
        return Finding(what, f"{folder}: cannot be written ({error.strerror or error})", advice)
    return Finding(what, f"{folder}, {free / 2**30:.1f} GiB free")


def _keys() -> Iterator[Finding]:
    """Yield for each API key of a data service whether its environment variable is set."""
    from sdc_taichi.exogenous.fetch.services import services

    keys = {name: service.key for name, service in services().items() if service.key is not None}
    for command, key in keys.items():
        variable = key.variable
        is_set = bool(os.environ.get(variable, "").strip())
        advice = "" if is_set else f"free of charge, see: sdc-taichi data fetch {command} --help"
        yield Finding(variable, "set" if is_set else "not set", advice)


def _first_step() -> Finding:
    """Simulate one step of a small hall, and report the time or the error."""
    begun = time.perf_counter()
    try:
        from sdc_taichi.config import load_config
        from sdc_taichi.kernels.compiler.runtime import ensure_started
        from sdc_taichi.sim.simulator import Simulator

        threads = ensure_started()
        simulator = Simulator([load_config("tiny")])
        simulator.reset(seed=0)
        simulator.step()
    except Exception as error:
        reason = one_line(f"{type(error).__name__}: {error}")
        return Finding("first step", "failed", reason, is_broken=True)
    seconds = time.perf_counter() - begun
    return Finding("first step", f"took {seconds:.1f} s with {threads} threads")
