"""The work of the thermal kernel in flat halls, written in Numba and in C, for benchmarks/bench.py.

Both take the groups of a fleet, compute each once and store inlet, outlet and power of every
server, with sums over racks and data centers. Where every server is a group of its own, their loop
over servers is vectorised. Both are free to reorder floating-point sums, which the kernel is not.
"""

import ctypes
import importlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Conditions
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
    """Arrays of one step, as both peers take them; ``sums`` is CPU W, fan W and m3/s, (B, 3)."""

    def __init__(self, fleet: Fleet, conditions: Conditions) -> None:
        if fleet.models["inlet"] != "approach" or fleet.models["outlet"] != "server":
            raise ValueError("peers know inlet model approach and outlet model server alone")
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


def numba_step(arguments: Arguments, threads: int) -> Step:
    """The step in Numba, parallel over racks.

    Raises:
        MissingError: Numba is not installed.
    """
    try:
        numba: Any = importlib.import_module("numba")
    except ImportError:
        raise MissingError("numba is not installed") from None
    prange = numba.prange

    @numba.njit(fastmath=True, inline="always")  # type: ignore[untyped-decorator]
    def operate(dc: Any, inlet_c: Any, load: Any, groups: Any, g: Any) -> Any:
        t = min(inlet_c, dc[13])
        y = min(max(dc[3] * t + dc[4] + dc[5] * load, dc[6]), dc[7])
        speed = y / dc[8]
        cpu_w = max(groups[2, g], groups[1, g] * (dc[0] * t + dc[1] + dc[2] * load))
        fan_w = groups[8, g] * dc[10] * speed * speed * speed
        flow = dc[11] * y * (groups[6, g] - groups[7, g] * t)
        return cpu_w, fan_w, flow, inlet_c + (cpu_w + fan_w) / (dc[12] * flow)

    @numba.njit(parallel=True, fastmath=True)  # type: ignore[untyped-decorator]
    def step(
        rack_offsets: Any,
        rack_dc: Any,
        group_offsets: Any,
        server_offsets: Any,
        groups: Any,
        dcs: Any,
        approach_k: Any,
        supply_c: Any,
        loads: Any,
        racks: Any,
        sums: Any,
        inlet_c: Any,
        outlet_c: Any,
        power_w: Any,
    ) -> None:
        one, zero = np.float32(1.0), np.float32(0.0)
        each_its_own = len(inlet_c) == groups.shape[1]
        for r in prange(len(rack_dc)):
            d = rack_dc[r]
            dc = dcs[d]
            air_c = supply_c[d] + approach_k[r]
            u = loads[d]
            spread = u * (one - u)
            cpu, fan, flow, inlet, outlet = zero, zero, zero, zero, zero
            hottest = np.float32(-1e30)
            if each_its_own:
                for g in range(group_offsets[r], group_offsets[r + 1]):
                    t = air_c + groups[3, g]
                    load = u + groups[4, g] * spread
                    cpu_w, fan_w, m3s, out_c = operate(dc, t, load, groups, g)
                    inlet_c[g] = t
                    outlet_c[g] = out_c
                    power_w[g] = cpu_w + fan_w
                    cpu += cpu_w
                    fan += fan_w
                    flow += m3s
                    inlet += t
                    outlet += m3s * out_c
                    hottest = max(hottest, t)
            else:
                for g in range(group_offsets[r], group_offsets[r + 1]):
                    t = air_c + groups[3, g]
                    load = u + groups[4, g] * spread
                    cpu_w, fan_w, m3s, out_c = operate(dc, t, load, groups, g)
                    drawn_w = cpu_w + fan_w
                    inlet_c[server_offsets[g] : server_offsets[g + 1]] = t
                    outlet_c[server_offsets[g] : server_offsets[g + 1]] = out_c
                    power_w[server_offsets[g] : server_offsets[g + 1]] = drawn_w
                    count = groups[0, g]
                    cpu += count * cpu_w
                    fan += count * fan_w
                    flow += count * m3s
                    inlet += count * t
                    outlet += count * m3s * out_c
                    hottest = max(hottest, t)
            servers = server_offsets[group_offsets[r + 1]] - server_offsets[group_offsets[r]]
            racks[r, 0] = cpu
            racks[r, 1] = fan
            racks[r, 2] = flow
            racks[r, 3] = inlet / servers
            racks[r, 4] = hottest
            racks[r, 5] = outlet / flow
        for d in prange(len(sums)):
            for what in range(3):
                total = 0.0
                for r in range(rack_offsets[d], rack_offsets[d + 1]):
                    total += racks[r, what]
                sums[d, what] = total

    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    return lambda: step(*arguments.listed)


PEERS: dict[str, Callable[[Arguments, int], Step]] = {"numba": numba_step, "c": c_step}
