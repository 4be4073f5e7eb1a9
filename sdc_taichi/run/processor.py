"""What of the processor and its libraries the last bits of results depend on."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_info

VECTOR_FEATURES = ("sse4_2", "avx", "avx2", "fma", "avx512f", "asimd", "sve")
"""Features of processors that libraries have own code for, as Linux names them."""


def processor_features(cpuinfo: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """Features by name, the same in every process that sees the same environment.

    ``architecture``: of the processor. ``processor``: those of its ``VECTOR_FEATURES`` that the
    system tells, for which Taichi compiles. ``numpy-simd``: extensions that NumPy uses.
    ``openblas``: version of OpenBLAS, and the processor whose code it picked. ``libc``: the C
    library, whose exponentials and powers differ between versions and processors.

    Args:
        cpuinfo: What Linux tells of the processor (proc(5)).
    """
    simd = np.show_config(mode="dicts")["SIMD Extensions"]
    openblas = [
        f"{library['version']} {library['architecture']}"
        for library in threadpool_info()
        if library["internal_api"] == "openblas" and "numpy" in library["filepath"]
    ]
    return {
        "architecture": platform.machine() or "unknown",
        "processor": _vector_features(cpuinfo),
        "numpy-simd": " ".join([*simd["baseline"], *simd.get("found", [])]),
        "openblas": ", ".join(openblas) or "unknown",
        "libc": " ".join(platform.libc_ver()).strip() or platform.system(),
    }


def _vector_features(cpuinfo: Path) -> str:
    """Features of the first processor; unknown where the system does not tell."""
    try:
        lines = cpuinfo.read_text("utf-8", errors="replace").splitlines()
    except OSError:
        return "unknown"
    for line in lines:
        name, _, features = line.partition(":")
        # "flags" of x86, "Features" of ARM.
        if name.strip().lower() in ("flags", "features"):
            has = features.split()
            return " ".join(each for each in VECTOR_FEATURES if each in has) or "none"
    return "unknown"
