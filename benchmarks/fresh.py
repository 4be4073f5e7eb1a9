"""Measurements that need a process of their own, for benchmarks/bench.py.

    python benchmarks/fresh.py NAME ARGUMENTS

``ARGUMENTS`` is a JSON list; the last line printed is the result as JSON.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import env
import numpy as np
from thermal import fleet_of
from yardsticks import core_s, interpreter_loop, plain_store

import sdc_taichi
from sdc_taichi.config import with_values
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Conditions, Hall

MEMORY = Path("/proc/self/statm")


def unlike(overrides: list[str], servers: int = 200) -> sdc_taichi.DataCenterConfig:
    """Preset ``corrected`` with a load weight for each server, and an inlet offset if it may."""
    base = sdc_taichi.load_config("corrected", overrides)
    widest_k = 1.0 if base.hall.inlet_model == "approach" else 0.0
    rng = np.random.default_rng(0)
    groups = [
        [
            {"count": 1, "full_w": 150, "idle_w": 10, "load_weight": weight, "inlet_offset_k": k}
            for weight, k in zip(
                rng.uniform(0.5, 1.5, servers).tolist(),
                rng.uniform(-widest_k, widest_k, servers).tolist(),
                strict=True,
            )
        ]
        for _ in range(base.hall.racks)
    ]
    return with_values(base, {"servers.groups": groups, "servers.power_w": None})


def conditions(fleet: Fleet) -> Conditions:
    """Load that differs between data centers."""
    return Conditions(np.full(fleet.units, 18.0), np.linspace(0.1, 0.9, fleet.size))


def stepped(fleet: Fleet) -> tuple[Callable[[], object], Callable[[], object]]:
    """A step of the thermal kernel without and with per-server layers."""
    hall, met = Hall(fleet, "f32"), conditions(fleet)
    hall.solve(met)
    layers = hall.servers()

    def whole() -> None:
        hall.solve(met)
        hall.servers(layers)

    return lambda: hall.solve(met), whole


def first_step(what: str) -> dict[str, float]:
    """When the first step of one data center, or of its environment, ended, and what it took.

    Returns:
        Time of day at the end, core time of the process until then and that of the interpreter
        yardstick right after it, all in s.
    """
    if what == "environment":
        one = sdc_taichi.parallel_env("corrected")
        one.reset(seed=0)
        one.step(dict.fromkeys(one.possible_agents, 1))
    else:
        sim = sdc_taichi.Simulator(sdc_taichi.load_config("corrected"))
        sim.reset()
        sim.step()
    end_s, spent_s = time.time(), time.process_time()
    yardstick = {"yardstick": interpreter_loop()}
    return {
        "end_s": end_s,
        "core_s": spent_s,
        "yardstick_s": float(np.median(core_s(yardstick, 100)["yardstick"])),
    }


def optimum(sites: str, days: int) -> dict[str, float]:
    """Core time, time and memory of solving for the optimum of some sites from 1 July on.

    Returns:
        Time and core time of the process until the end and core time of the interpreter yardstick
        right after it, all in s, and the most memory, in MB.
    """
    from recording import most_mb

    from sdc_taichi.optimum import solve

    base = sdc_taichi.load_config("corrected", ["site.start=07-01"])
    names = sites.split(",")
    configs = sdc_taichi.make_configs(base, count=len(names), sites=names)
    begin = time.time()
    solve(configs, steps=96 * days, cache=False)
    spent_s, wall_s = time.process_time(), time.time() - begin
    yardstick = {"yardstick": interpreter_loop()}
    return {
        "wall_s": wall_s,
        "core_s": spent_s,
        "yardstick_s": float(np.median(core_s(yardstick, 100)["yardstick"])),
        "most_mb": most_mb(),
    }


def resident() -> int:
    """Memory of this process, bytes; Linux only."""
    import resource

    return int(MEMORY.read_text().split()[1]) * resource.getpagesize()


def memory(data_centers: int, each_its_own: bool) -> dict[str, float]:
    """Bytes per server of a simulator that has stepped, with its layers; and at the most."""
    from recording import most_mb

    transient = ["simulation.thermal=transient"]
    config = unlike(transient) if each_its_own else sdc_taichi.load_config("corrected")

    def run(count: int) -> tuple[Any, ...]:
        sim = sdc_taichi.Simulator(sdc_taichi.make_configs(config, count=count))
        sim.reset()
        return sim, sim.step(), sim.servers()

    run(1)
    before = resident()
    kept = run(data_centers)
    servers = kept[0].fleet.servers
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


def rate(what: str, size: list[int], seconds: float) -> float:
    """Steps of ``size`` per second from when a line comes in, which answers ``ready``."""
    if what == "environments":
        batch = sdc_taichi.vector_env(size[0], "corrected")
        batch.reset(seed=0)
        actions = {a: np.ones(size[0], np.int64) for a in batch.possible_agents}

        def step() -> object:
            return batch.step(actions)

        call: Callable[[], object] = step
    elif what == "roof":
        call = plain_store(int(np.prod(size)))
    elif what == "interpreter":
        call = interpreter_loop()
    else:
        reduction, whole = stepped(fleet_of(size[0], size[1], size[2], "approach"))
        call = reduction if what == "reduction" else whole
    for _ in range(3):
        call()
    print("ready", flush=True)
    sys.stdin.readline()
    return env.rate(call, 1, seconds)


PARTS: dict[str, Callable[..., Any]] = {
    f.__name__: f for f in (first_step, optimum, memory, cycles, rate)
}

if __name__ == "__main__":
    print(json.dumps(PARTS[sys.argv[1]](*json.loads(sys.argv[2]))))
