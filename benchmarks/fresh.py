"""Measurements that need a new process, for benchmarks/bench.py.

    python benchmarks/fresh.py NAME ARGUMENTS

``ARGUMENTS`` is a JSON list; the last line printed is the result as JSON.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import steps
from yardsticks import core_s, interpreter_loop

import sdc_taichi

MEMORY = Path("/proc/self/statm")


def yardstick_s() -> float:
    """Core time of the interpreter yardstick, in s."""
    return float(np.median(core_s({"yardstick": interpreter_loop()}, 100)["yardstick"]))


def first_step(what: str) -> dict[str, float]:
    """When the first step of one data center, or of its environment, ended, and what it took.

    Args:
        what: ``simulator`` or ``environment`` of one data center, or ``100,000 racks``.

    Returns:
        Time of day at the end, core time of the process until then and that of the interpreter
        yardstick right after it, all in s.
    """
    if what == "environment":
        one = sdc_taichi.parallel_env("corrected")
        one.reset(seed=0)
        one.step(dict.fromkeys(one.possible_agents, 1))
    else:
        large = what == "100,000 racks"
        config = ("large", steps.side_of(320)) if large else ("corrected",)
        sim = sdc_taichi.Simulator(sdc_taichi.load_config(*config))
        sim.reset()
        sim.step()
    end_s, spent_s = time.time(), time.process_time()
    return {
        "end_s": end_s,
        "core_s": spent_s,
        "yardstick_s": yardstick_s(),
    }


def optimum(sites: str, days: int) -> dict[str, float]:
    """Core time, time and memory of solving for the optimum of some sites from 1 July on.

    Returns:
        Time and core time of the process until the end and core time of the interpreter yardstick
        right after it, all in s, and the most memory, in MB.
    """
    from sdc_taichi.optimum import solve

    base = sdc_taichi.load_config("corrected", ["site.start=07-01"])
    names = sites.split(",")
    configs = sdc_taichi.make_configs(base, count=len(names), sites=names)
    begin = time.time()
    solve(configs, steps=96 * days, cache=False)
    spent_s, wall_s = time.process_time(), time.time() - begin
    return {
        "wall_s": wall_s,
        "core_s": spent_s,
        "yardstick_s": yardstick_s(),
        "most_mb": most_mb(),
    }


def most_mb() -> float:
    """The most memory that this process has held, MB."""
    status = Path("/proc/self/status")
    if status.exists():
        # Not what getrusage says, which a process on Linux has from its parent.
        (line,) = (x for x in status.read_text().splitlines() if x.startswith("VmHWM:"))
        return float(line.split()[1]) / 1e3
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 1e6 if sys.platform == "darwin" else most / 1e3


def resident() -> int:
    """Memory of this process, bytes; Linux only."""
    import resource

    return int(MEMORY.read_text().split()[1]) * resource.getpagesize()


def memory(data_centers: int, each_its_own: bool) -> dict[str, float]:
    """Bytes per server of a simulator that has stepped, with its layers; and at the most."""
    transient = ["simulation.thermal=transient"]
    config = steps.unlike(transient) if each_its_own else sdc_taichi.load_config("corrected")

    def run(count: int) -> tuple[Any, ...]:
        sim = sdc_taichi.Simulator(sdc_taichi.make_configs(config, count=count))
        sim.reset()
        return sim, sim.step(), sim.servers()

    run(1)
    before = resident()
    built = run(data_centers)  # all of it stays in memory until it is measured
    servers = built[0].fleet.servers
    most = 1e6 * most_mb()
    return {"held": (resident() - before) / servers, "most": (most - before) / servers}


def cycles(count: int) -> float:
    """Bytes by which the process grows over so many simulators that step once and close."""
    config = sdc_taichi.load_config("tiny")
    drivers = sdc_taichi.load_drivers([config])
    before = 0
    for cycle in range(count + count // 10):
        with sdc_taichi.Simulator(config, drivers=drivers) as sim:
            sim.reset(cycle)
            sim.step()
        if cycle == count // 10:
            before = resident()
    return float(resident() - before)


PARTS: dict[str, Callable[..., Any]] = {
    f.__name__: f for f in (first_step, optimum, memory, cycles)
}

if __name__ == "__main__":
    print(json.dumps(PARTS[sys.argv[1]](*json.loads(sys.argv[2]))))
