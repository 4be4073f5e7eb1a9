"""``sdc-taichi doctor``: what this machine has of what the package can use."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from importlib import metadata, util
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from sdc_taichi.cli.options import json_option
from sdc_taichi.cli.terminal import PlainConsole
from sdc_taichi.errors import SdcError, SdcWarning, one_line

MODULES = {
    "plot": ("matplotlib",),
    "fetch": ("requests", "urllib3"),
    "train": ("torch", "tensorboard"),
    "onnx": ("onnx", "onnxruntime"),
    "scale": ("ray",),
    "offline": ("minari", "h5py"),
}
"""Modules of each extra that users install."""
PURPOSES = {
    "plot": "pictures and reports",
    "fetch": "data fetch",
    "train": "training; trained policies run without it",
    "onnx": "export of policies as ONNX",
    "scale": "jobs on a cluster (--ray)",
    "offline": "data sets of episodes (collect)",
}
"""What each extra is for."""
_LIBRARIES = ("taichi", "numpy", "pandas", "pyarrow", "gymnasium", "pettingzoo", "rerun-sdk")
_LEAST_FREE_BYTES = 1 << 30
"""Memory that Taichi reserves at its start, and disk that recordings soon fill."""
_GIB = 1 << 30


class Finding(NamedTuple):
    """One thing that was looked at."""

    what: str
    """Its name."""
    found: str
    """What was found."""
    advice: str = ""
    """How to get what is missing; empty where nothing is."""
    is_broken: bool = False
    """Whether the simulator cannot run like this."""


def doctor_command(
    as_json: Annotated[bool, json_option("Print JSON.")] = False,
) -> None:
    """Say what this machine has, what is missing, and how to get it.

    Looks at versions, processor, memory, folders, viewer and keys (whether they are set, not what
    they are), and steps a small hall. Ends with exit code 1 if the simulator does not run.
    """
    findings = [finding for check in CHECKS for finding in _checked(check)]
    works = not any(each.is_broken for each in findings)
    if as_json:
        found = [each._asdict() for each in findings]
        print(json.dumps({"works": works, "findings": found}, indent=1))
    else:
        _print(findings, works=works)
    if not works:
        raise typer.Exit(1)


def _checked(check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """What a check finds; an error of its own is a finding too."""
    try:
        yield from check()
    except Exception as error:
        what = check.__name__.strip("_").replace("_", " ")
        text = str(error) if isinstance(error, SdcError) else f"{type(error).__name__}: {error}"
        yield Finding(what, "cannot be told", one_line(text))


def _print(findings: list[Finding], *, works: bool) -> None:
    console = PlainConsole(highlight=False, soft_wrap=True)
    width = max(len(each.what) for each in findings)
    for each in findings:
        console.print(f"{each.what:{width}}  {each.found}")
    if advice := [f"  {each.what}: {each.advice}" for each in findings if each.advice]:
        console.print("\nWhat can be mended or added:")
        console.print("\n".join(advice))
    console.print("\nThe simulator works." if works else "\nThe simulator does not work.")


# --- Checks ---------------------------------------------------------------------------------------


def _versions() -> Iterator[Finding]:
    yield Finding("sdc-taichi", metadata.version("sdc-taichi"))
    yield Finding("Python", f"{platform.python_version()}, {sys.executable}")
    yield Finding("system", f"{platform.system()} {platform.release()}, {platform.machine()}")
    for name in _LIBRARIES:
        try:
            yield Finding(name, metadata.version(name))
        except metadata.PackageNotFoundError:
            # Recordings alone need it.
            is_needed = name != "rerun-sdk"
            yield Finding(name, "not installed", f"pip install {name}", is_broken=is_needed)


def _extras() -> Iterator[Finding]:
    for extra, modules in MODULES.items():
        missing = [name for name in modules if util.find_spec(name) is None]
        found = f"{PURPOSES[extra]}: {'not installed' if missing else 'installed'}"
        advice = f'pip install "sdc-taichi[{extra}]"' if missing else ""
        yield Finding(f"extra {extra}", found, advice)


def _processors() -> Iterator[Finding]:
    from sdc_taichi.kernels.compiler.runtime import allowed_processors, processor_quota
    from sdc_taichi.run.processor import processor_features

    allowed, quota = len(allowed_processors()), processor_quota()
    limits = [f"{allowed} of {os.cpu_count()} may be used"]
    if quota < allowed:
        limits.append(f"the container grants {quota:g}")
    yield Finding("processors", ", ".join(limits))
    yield Finding("vector features", processor_features()["processor"])


def _memory() -> Iterator[Finding]:
    total, free = memory_bytes()
    if total is None:
        yield Finding("memory", "the system does not tell")
        return
    text = f"{total / _GIB:.1f} GiB" + ("" if free is None else f", {free / _GIB:.1f} GiB free")
    short = (total if free is None else free) < _LEAST_FREE_BYTES
    yield Finding("memory", text, "at least 1 GiB is needed" if short else "")


def _kernel_cache() -> Iterator[Finding]:
    from sdc_taichi.kernels.compiler.runtime import CACHE_VARIABLE, usual_folder

    advice = f"name a folder that can be written in XDG_CACHE_HOME or {CACHE_VARIABLE}"
    yield _folder("compiled kernels", usual_folder(), advice)


def _data() -> Iterator[Finding]:
    from sdc_taichi.exogenous.registry import imported_sites, imported_traces, user_data_dir

    finding = _folder("imported data", user_data_dir(), "name a folder in SDC_TAICHI_DATA")
    count = f"{len(imported_sites())} sites, {len(imported_traces())} traces"
    yield finding._replace(found=f"{finding.found}; {count}")


def _folders() -> Iterator[Finding]:
    yield _folder("temporary files", Path(tempfile.gettempdir()), "name another in TMPDIR")
    yield _folder("current folder", Path.cwd(), "results go here unless --out names another")


def _viewer() -> Iterator[Finding]:
    from sdc_taichi.cli.view import viewer_program

    try:
        program = viewer_program()
    except SdcError as error:
        yield Finding("viewer", "none", str(error))
        return
    yield Finding("viewer", str(program))
    has_screen = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    advice = "view recordings with: sdc-taichi view --web FILE.rrd"
    yield Finding("screen", "found" if has_screen else "none", "" if has_screen else advice)


def _browser() -> Iterator[Finding]:
    import webbrowser

    try:
        name = getattr(webbrowser.get(), "name", "") or "found"
    except webbrowser.Error:
        advice = "view --web and reports are shown by a browser, on any machine"
        yield Finding("browser", "none", advice)
        return
    yield Finding("browser", name)


def _keys() -> Iterator[Finding]:
    from sdc_taichi.exogenous.fetch.services import services

    for command, service in services().items():
        if service.key is None:
            continue
        variable = service.key.variable
        is_set = bool(os.environ.get(variable, "").strip())
        advice = "" if is_set else f"free of charge, see: sdc-taichi data fetch {command} --help"
        yield Finding(variable, "set" if is_set else "not set", advice)


def _simulator() -> Iterator[Finding]:
    begun = time.perf_counter()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            threads = _step_small_hall()
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        advice = one_line(text)
        yield Finding("first step", "failed", advice, is_broken=True)
        return
    ours = [each.message for each in caught if issubclass(each.category, SdcWarning)]
    told = "; ".join(dict.fromkeys(map(str, ours)))
    took = time.perf_counter() - begun
    yield Finding("first step", f"took {took:.1f} s with {threads} threads", told)


CHECKS = (
    *(_versions, _extras, _processors, _memory, _kernel_cache, _data, _folders, _viewer, _browser),
    *(_keys, _simulator),
)
"""What is looked at, in this order."""


# --- Helpers --------------------------------------------------------------------------------------


def _step_small_hall() -> int:
    """Step a small hall once, and tell the number of threads."""
    from sdc_taichi.config import load_config
    from sdc_taichi.kernels.compiler.runtime import ensure_started
    from sdc_taichi.sim.simulator import Simulator

    threads = ensure_started()
    simulator = Simulator([load_config("tiny")])
    simulator.reset(seed=0)
    simulator.step()
    return threads


def _folder(what: str, folder: Path, advice: str) -> Finding:
    """Whether files can be written to a folder, or to the one that it would be made in."""
    parent = folder
    while not parent.exists() and parent != parent.parent:
        parent = parent.parent
    try:
        with tempfile.TemporaryFile(dir=parent):
            pass
        free = shutil.disk_usage(parent).free
    except OSError as error:
        return Finding(what, f"{folder}: cannot be written ({error.strerror or error})", advice)
    text = f"{folder}, {free / _GIB:.1f} GiB free"
    return Finding(what, text, "the disk is nearly full" if free < _LEAST_FREE_BYTES else "")


def memory_bytes(
    meminfo: Path = Path("/proc/meminfo"),
    groups: Path = Path("/proc/self/cgroup"),
    mounted: Path = Path("/sys/fs/cgroup"),
) -> tuple[int | None, int | None]:
    """Memory that this process may use, and what of it is free; None where it is not known.

    Args:
        meminfo: what Linux tells of the memory (proc(5)).
        groups: control groups of the process (cgroups(7)).
        mounted: where their settings are.
    """
    told = {
        name: int(kib) << 10 for name, kib in re.findall(r"(\w+): +(\d+) kB", _text_of(meminfo))
    }
    total, free = told.get("MemTotal"), told.get("MemAvailable")
    if total is None and hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for line in _text_of(groups).splitlines():
        group = Path(line.rpartition(":")[2].lstrip("/"))
        for folder in (group, *group.parents):
            for at in (mounted / folder, mounted / "memory" / folder):
                for most, used in (
                    ("memory.max", "memory.current"),
                    ("memory.limit_in_bytes", "memory.usage_in_bytes"),
                ):
                    limit = _text_of(at / most).strip()
                    if limit.isdecimal() and total is not None and int(limit) < total:
                        total = int(limit)
                        now = _text_of(at / used).strip()
                        left = max(0, total - int(now)) if now.isdecimal() else total
                        free = left if free is None else min(free, left)
    return total, free


def _text_of(file: Path) -> str:
    """Text of a file of the operating system; empty if it cannot be read."""
    try:
        return file.read_text("utf-8", errors="replace")
    except (OSError, ValueError):
        return ""
