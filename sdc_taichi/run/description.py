"""Description of a run: versions, processor, seed, inputs and data centers."""

from __future__ import annotations

import functools
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import PERFECT, ForecastError
from sdc_taichi.exogenous.files import sha256
from sdc_taichi.sim.fleet_configs import locations
from sdc_taichi.sim.simulator import Simulator

FORMAT = "sdc-run/3"
"""Format version of metrics.json, stored in its field ``format``."""
VECTOR_FEATURES = ("sse4_2", "avx", "avx2", "fma", "avx512f", "asimd", "sve")
"""Linux names of the vector extensions for which libraries have special code."""


@dataclass(frozen=True, slots=True)
class RunRequest:
    """Controller, length and seed of a run, as requested."""

    controller: str
    """Name of the controller, as metrics.json and reports show it."""
    steps: int
    """Number of steps to simulate."""
    seed: int = 0
    """Seed of the simulator's events, the controller and the forecast errors."""
    forecast_error: ForecastError = PERFECT
    """Error model of the forecasts that the controller sees."""


def describe_run(sim: Simulator, request: RunRequest) -> dict[str, Any]:
    """Return the part of metrics.json that is known before the first step."""
    drivers = sim.drivers
    hashes = _file_hashes(sim.fleet.configs)
    return {
        "format": FORMAT,
        "versions": dict(_versions()),
        "fingerprint": sim.fingerprint(),
        "controller": request.controller,
        "seed": request.seed,
        "forecast_error": asdict(request.forecast_error),
        "precision": sim.precision,
        "step_h": sim.step_h,
        "steps_asked": request.steps,
        "synthetic": any(drivers.synthetic),
        "notes": list(drivers.notes),
        "data_centers": [
            {
                "name": config.name,
                "location": location,
                "start": config.site.start,
                "year": int(year),
                "utc_offset_h": float(utc_offset_h),
                "synthetic": synthetic,
                "provenance": sources,
                "sha256": {kind: hashes[path] for kind, path in _input_files(config).items()},
            }
            for config, location, year, utc_offset_h, synthetic, sources in zip(
                sim.fleet.configs,
                locations(sim.fleet.configs),
                drivers.year,
                drivers.utc_offset_h,
                drivers.synthetic,
                drivers.sources,
                strict=True,
            )
        ],
    }


@functools.cache
def _versions() -> Mapping[str, str]:
    """Return the versions and processor features on which results depend.

    The result is cached, because every look-up reads the metadata of packages from disk.
    """
    packages = ("sdc-taichi", "taichi", "numpy", "pyarrow")
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
        **processor_features(),
    }


def _input_files(config: DataCenterConfig) -> dict[str, str]:
    """Return the paths of the input files that a config names, by the kind of input."""
    site = config.site
    named = {
        "weather": site.weather_file,
        "carbon": site.carbon_file,
        "workload": site.workload_file,
        "recirculation": config.hall.recirculation.matrix_file,
    }
    return {kind: path for kind, path in named.items() if path is not None}


def _file_hashes(configs: Sequence[DataCenterConfig]) -> dict[str, str]:
    """Return the SHA-256 of every file that the configs name, by path.

    A file that does not exist has the hash "missing"; it is not an error, because drivers that are
    made from arrays do not need the files.
    """
    paths = {path for config in configs for path in _input_files(config).values()}
    return {p: sha256(Path(p)) if os.path.isfile(p) else "missing" for p in sorted(paths)}


def processor_features(cpuinfo: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """Return the features of processor and libraries on which the last bits of results depend.

    ``architecture`` is the processor architecture. ``processor`` lists the ``VECTOR_FEATURES`` of
    the processor, for which Taichi compiles. ``numpy-simd`` lists the extensions that NumPy uses.
    ``openblas`` is the version of OpenBLAS and the processor type whose code it selected. ``libc``
    is the C library, whose exponentials and powers differ between versions and processors.

    Args:
        cpuinfo: File in which Linux describes the processor (proc(5)).
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
    """Return the ``VECTOR_FEATURES`` of the first processor; "unknown" if Linux lists none."""
    try:
        lines = cpuinfo.read_text("utf-8", errors="replace").splitlines()
    except OSError:
        return "unknown"
    for line in lines:
        name, _, features = line.partition(":")
        # The line is named "flags" on x86 and "Features" on ARM.
        if name.strip().lower() in ("flags", "features"):
            has = features.split()
            return " ".join(each for each in VECTOR_FEATURES if each in has) or "none"
    return "unknown"
