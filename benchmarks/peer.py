"""The work of the thermal kernel in flat halls, written in C (hall.c), for benchmarks/bench.py.

It takes the groups of a fleet, computes each once and stores inlet, outlet and power of every
server, with sums over racks and data centers. Where every server is a group of its own, its loop
over servers is vectorised. It is free to reorder floating-point sums, which the kernel is not.
"""

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_state import Conditions
from sdc_taichi.types import ServerLayers

# Threads that wait must not look like threads that work.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

Step = Callable[[], object]
# All of -ffast-math, which would also flush small numbers of the whole process to zero.
REORDERED = (
    *("-fassociative-math", "-freciprocal-math", "-ffinite-math-only"),
    *("-fno-signed-zeros", "-fno-trapping-math", "-fno-math-errno"),
)
COMPILED = ("-O3", "-march=native", *REORDERED, "-fopenmp", "-shared", "-fPIC")


class MissingError(Exception):
    """A peer that cannot run here; the message says why."""


class Arguments:
    """Arrays of one step, as the C code takes them; ``sums`` is CPU W, fan W and m3/s, (B, 3)."""

    def __init__(self, fleet: Fleet, conditions: Conditions) -> None:
        if fleet.models["inlet"] != "approach" or fleet.models["outlet"] != "server":
            raise ValueError("the peer knows inlet model approach and outlet model server alone")
        self.layers = ServerLayers(*(np.zeros(fleet.servers, np.float32) for _ in range(3)))
        self.sums = np.zeros((fleet.size, 3))
        self.racks = np.zeros((fleet.racks, 6), np.float32)
        self.listed: tuple[Any, ...] = (
            *(fleet.rack_offsets, fleet.rack_dc, fleet.group_offsets, fleet.server_offsets),
            *(
                np.ascontiguousarray(a, np.float32)
                for a in (
                    np.concatenate(fleet.group_rows, axis=1),
                    fleet.dcs.T,
                    fleet.approach_k,
                    conditions.unit_supply_c,
                    conditions.utilisation,
                )
            ),
            *(self.racks, self.sums),
            *(self.layers.inlet_c, self.layers.outlet_c, self.layers.power_w),
        )


def c_step(arguments: Arguments, threads: int) -> Step:
    """The step in C with OpenMP, compiled into a folder that is gone once it is loaded.

    Raises:
        MissingError: no compiler, or one without these options.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        raise MissingError("no C compiler (cc)")
    source = Path(__file__).with_name("hall.c")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        library = Path(folder, "hall.so")
        command = [compiler, *COMPILED, str(source), "-o", str(library)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise MissingError(f"cc fails: {done.stderr.strip().splitlines()[-1]}")
        loaded = ctypes.CDLL(str(library))
    loaded.omp_set_num_threads(threads)
    counts = (ctypes.c_int32(len(arguments.sums)), ctypes.c_int32(len(arguments.listed[3]) - 1))
    pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in arguments.listed]
    return lambda: loaded.hall_step(*counts, *pointers)
