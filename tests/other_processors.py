"""Tests on results, run as on other processors: `make test-processors`.

Programs cannot be told of another processor, but each library that has own code for newer ones can
be held back: NumPy, OpenBLAS and the C library by environment variables, and LLVM, which compiles
Taichi's kernels, by replacing the two functions by which it learns what processor it is on
(``pytest -p other_processors`` with ``SDC_TEST_PROCESSOR`` set). Their addresses are in the symbol
table of Taichi's library for Linux.
"""

from __future__ import annotations

import ctypes
import importlib.util
import mmap
import os
import platform
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.run.description import processor_features

TESTS = ("reference", "ledgers", "kernels", "transients", "airflow", "air_metrics")
"""Test files that hold results against other computations: parity, ledgers, halls and kernels."""
LEFT_OUT = (
    "number_of_threads", "all_threads", "large_and_small_halls", "transient_year", "converged_in"
)  # fmt: skip
"""Tests in them that take long and hold nothing that shorter ones do not."""
LEVELS = ("x86-64-v2", "x86-64-v3")
"""Processors by the names of the x86-64 ABI: without AVX, and with AVX2 but without AVX-512."""
CPU_NAME = "_ZN4llvm3sys14getHostCPUNameEv"
"""``StringRef llvm::sys::getHostCPUName()``."""
CPU_FEATURES = "_ZN4llvm3sys18getHostCPUFeaturesERNS_9StringMapIbNS_15MallocAllocatorEEE"
"""``bool llvm::sys::getHostCPUFeatures(StringMap<bool> &)``; of its own it adds to the name's."""

_NUMPY_KEEPS = {"X86_V2", "SSE", "SSE2", "SSE3", "SSSE3", "SSE41", "POPCNT", "SSE42"}
_ENVIRONMENT = {
    "x86-64-v2": {
        "OPENBLAS_CORETYPE": "Nehalem",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-FMA4,-AVX",
    },
    "x86-64-v3": {
        "OPENBLAS_CORETYPE": "Haswell",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F",
    },
}
_kept: list[Any] = []
"""Memory that replaced functions read."""


class _StringRef(ctypes.Structure):
    """LLVM's reference to a text."""

    _fields_ = (("start", ctypes.c_void_p), ("length", ctypes.c_size_t))


def settings() -> dict[str, dict[str, str] | str]:
    """Environment variables of each setting by its name, or why it cannot be had."""
    return {level: _level(level) for level in LEVELS}


def _level(level: str) -> dict[str, str] | str:
    """Environment variables for an older processor, or why it cannot be had."""
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        return f"needs Linux on x86_64, not {platform.system()} on {platform.machine()}"
    if missing := {CPU_NAME, CPU_FEATURES} - offsets().keys():
        return f"Taichi's library has no symbol {', '.join(sorted(missing))}"
    keeps = _NUMPY_KEEPS | (
        {"X86_V3", "AVX", "F16C", "FMA3", "AVX2"} if level[-1] == "3" else set()
    )
    newer = [x for x in np.show_config(mode="dicts")["SIMD Extensions"]["found"] if x not in keeps]
    if not newer:
        return "the processor is no newer"
    return {
        **_ENVIRONMENT[level],
        "NPY_DISABLE_CPU_FEATURES": " ".join(newer),
        "SDC_TEST_PROCESSOR": level,
    }


# --- LLVM in Taichi's library ---------------------------------------------------------------------


def library() -> Path:
    """Taichi's library, found without loading it."""
    spec = importlib.util.find_spec("taichi")
    assert spec is not None
    assert spec.origin is not None
    return next((Path(spec.origin).parent / "_lib" / "core").glob("taichi_python*.so")).resolve()


def offsets() -> dict[str, int]:
    """Addresses of both functions over that of the library, from its symbol table (elf(5))."""
    with library().open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as elf:
        (at,) = struct.unpack_from("<Q", elf, 0x28)
        size, count = struct.unpack_from("<HH", elf, 0x3A)
        sections = [struct.unpack_from("<IIQQQQIIQQ", elf, at + i * size) for i in range(count)]
        found = {}
        for _, kind, _, _, start, length, link, *_ in sections:
            if kind != 2:  # SHT_SYMTAB
                continue
            names, names_length = sections[link][4:6]
            table = np.frombuffer(elf[start : start + length], np.dtype("<u4, <u4, <u8, <u8"))
            for name in (CPU_NAME, CPU_FEATURES):
                text = elf.find(f"\0{name}\0".encode(), names, names + names_length)
                entry = np.flatnonzero(table["f0"] == text + 1 - names)
                if text >= 0 and entry.size:
                    found[name] = int(table["f2"][entry[0]])
    return found


def _addresses() -> dict[str, int]:
    """Addresses of both functions in this process."""
    import taichi  # noqa: F401  (loads the library)

    path = str(library())
    with open("/proc/self/maps") as maps:
        base = min(int(line.split("-")[0], 16) for line in maps if line.rstrip().endswith(path))
    return {name: base + offset for name, offset in offsets().items()}


def llvm_processor() -> str:
    """Processor that LLVM compiles for."""
    name = ctypes.CFUNCTYPE(_StringRef)(_addresses()[CPU_NAME])()
    return ctypes.string_at(name.start, name.length).decode()


def pretend(level: str) -> None:
    """Make LLVM compile for another processor; before Taichi starts."""
    text = ctypes.create_string_buffer(level.encode())
    _kept.append(text)
    code = {
        # mov rax, text; mov edx, length; ret
        CPU_NAME: struct.pack(
            "<2sQBIB", b"\x48\xb8", ctypes.addressof(text), 0xBA, len(level), 0xC3
        ),
        CPU_FEATURES: b"\x31\xc0\xc3",  # xor eax, eax; ret
    }
    libc = ctypes.CDLL(None, use_errno=True)
    for name, address in _addresses().items():
        page = address & -mmap.PAGESIZE
        span = ctypes.c_size_t(address + len(code[name]) - page)
        for rights in (7, 5):  # read, write and execute; read and execute
            if libc.mprotect(ctypes.c_void_p(page), span, rights):
                raise OSError(ctypes.get_errno(), "mprotect")
            if rights == 7:
                ctypes.memmove(address, code[name], len(code[name]))


# --- plugin of pytest -----------------------------------------------------------------------------


def pytest_configure() -> None:
    """Pretend before any test starts Taichi, in every process of pytest-xdist."""
    if level := os.environ.get("SDC_TEST_PROCESSOR"):
        pretend(level)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say what processor the libraries saw."""
    seen = processor_features()
    if platform.system() == "Linux":
        seen["llvm"] = llvm_processor()
    seen["threads"] = os.environ.get("SDC_TAICHI_THREADS", "all")
    terminalreporter.write_line("; ".join(f"{name} {value}" for name, value in seen.items()))


# --- all settings ---------------------------------------------------------------------------------


def run(name: str, values: Mapping[str, str], options: list[str]) -> int:
    """Run the tests under one setting, with kernels compiled anew; return pytest's exit code."""
    tests = Path(__file__).parent
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, **values, "XDG_CACHE_HOME": cache, "PYTHONPATH": str(tests)}
        files = [str(tests / f"test_{each}.py") for each in TESTS]
        chosen = " and ".join(f"not {each}" for each in LEFT_OUT)
        command = [sys.executable, "-m", "pytest", "-p", "other_processors", "-k", chosen]
        command += [*options, *files]
        code = subprocess.run(command, env=environment, cwd=tests.parent).returncode
    print(f"-- {name}: exit code {code}, {time.monotonic() - begun:.0f} s", flush=True)
    return code


def main(options: list[str]) -> int:
    """Run the tests under every setting that can be had; return 1 if any fails."""
    codes = []
    for name, values in settings().items():
        print(f"-- {name}", flush=True)
        if isinstance(values, str):
            print(f"-- {name}: skipped, {values}", flush=True)
        else:
            codes.append(run(name, values, options))
    return int(any(codes))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
