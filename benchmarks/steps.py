"""The steps that benchmarks/bench.py measures, and how they are counted and timed."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

import sdc_taichi
from sdc_taichi.config import with_values
from sdc_taichi.control import view_maker
from sdc_taichi.kernels.compiler.launch import BoundKernel
from sdc_taichi.plant.liquid import LiquidFleet
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions
from sdc_taichi.sim.liquid import Liquid, LiquidInputs
from sdc_taichi.types import I32, StepResult

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
"""Sites with a synthetic year."""


STRAIGHT_LINES = [
    "servers.cpu_power_ratio_lb=[0.01,1]",
    "servers.cpu_power_ratio_ub=[0.03,1.02]",
    "servers.inlet_range_c=[16,28]",
    "servers.fan_airflow_ratio_lb=[0.01,0.225]",
    "servers.fan_airflow_ratio_ub=[0.225,1]",
]
"""Overrides for the server curves of halls that peers compute as well: lines without knees."""


def rate(step: Callable[[], object], num_envs: int, seconds: float) -> float:
    """Best environment steps per second over three runs."""
    for _ in range(3):
        step()
    best = 0.0
    for _ in range(3):
        done, start = 0, time.perf_counter()
        while (spent := time.perf_counter() - start) < seconds or done == 0:
            step()
            done += 1
        best = max(best, done * num_envs / spent)
    return best


def single_step(config: sdc_taichi.DataCenterConfig) -> Callable[[], object]:
    """A step of one PettingZoo environment, which is reset when an episode has ended."""
    one = sdc_taichi.parallel_env(config)
    one.reset(seed=0)
    actions = dict.fromkeys(one.possible_agents, 1)

    def step() -> None:
        if not one.agents:
            one.reset()
        one.step(actions)

    return step


def side_of(racks: int) -> list[str]:
    """Overrides of a hall with that many rows of as many racks."""
    return [f"hall.rows={racks}", f"hall.racks_per_row={racks}"]


def sweeps_of_run(preset: str, count: int) -> I32:
    """Sweeps of each step of a run of ``count`` steps at eight sites, (steps, sites).

    The setpoint changes every other hour by a random step.
    """
    configs = sdc_taichi.make_configs(sdc_taichi.load_config(preset), count=8, sites=SITES)
    rng, sweeps = np.random.default_rng(0), []
    with sdc_taichi.Simulator(configs) as sim:
        sim.reset()
        for step in range(count):
            cooling = np.zeros(sim.size)
            if step % 8 == 0:
                cooling += rng.integers(-1, 2, sim.size)
            sim.step(sdc_taichi.Actions(load=0.0, cooling=cooling, battery=0.0))
            sweeps.append(sim.sweeps)
    return np.array(sweeps, dtype=np.int32)


@contextlib.contextmanager
def controlled_step(preset: str, controller: str, count: int) -> Iterator[Callable[[], object]]:
    """A step of some data centers of eight sites under a named controller."""
    base = sdc_taichi.load_config(preset)
    configs = sdc_taichi.make_configs(base, count=count, sites=SITES[:count])
    with sdc_taichi.Simulator(configs) as sim:
        sim.reset()
        acting = sdc_taichi.make_controller(controller, sim.fleet)
        acting.reset(0)
        view_of = view_maker(sim)
        last: list[StepResult | None] = [None]

        def step() -> None:
            last[0] = sim.step(acting.act(view_of(last[0])))

        step()
        yield step


@contextlib.contextmanager
def batch_step(
    config: sdc_taichi.DataCenterConfig, num_envs: int
) -> Iterator[Callable[[], object]]:
    """A step of the multi-agent batch with random actions."""
    env = sdc_taichi.vector_env(num_envs, config)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = [{a: rng.integers(0, 3, num_envs) for a in env.possible_agents} for _ in range(8)]
    turn = iter(range(10**12))
    yield lambda: env.step(actions[next(turn) % 8])
    env.close()


def fleet_of(n_dcs: int, racks: int, servers: int, inlet_model: str) -> Fleet:
    """A fleet of equal halls of one server type in five height zones."""
    rows = next(r for r in range(int(racks**0.5), 0, -1) if racks % r == 0)
    settings = [
        f"hall.rows={rows}",
        f"hall.racks_per_row={racks // rows}",
        f"hall.servers_per_rack={servers}",
        f"hall.inlet_model={inlet_model}",
        "hall.supply_approach_k=5.15",
        "hall.return_approach_k=-3.1",
        "hall.height_zones=5",
        "servers.power_w=[150, 10]",
        *(STRAIGHT_LINES if inlet_model == "approach" else []),
    ]
    config = sdc_taichi.load_config("corrected", settings)
    return sdc_taichi.build_fleet(sdc_taichi.make_configs(config, count=n_dcs))


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
    """Supply air at 18 C and a utilisation that differs between data centers."""
    return Conditions(np.full(fleet.units, 18.0), np.linspace(0.1, 0.9, fleet.size))


def stepped(fleet: Fleet) -> tuple[Callable[[], object], Callable[[], object]]:
    """A step of the thermal kernel without and with per-server layers."""
    hall, load = Hall(fleet, "f32"), conditions(fleet)
    hall.solve(load)
    layers = hall.servers()

    def whole() -> None:
        hall.solve(load)
        hall.servers(layers)

    return lambda: hall.solve(load), whole


def calls_of(function: Callable[[], object], *events: str) -> int:
    """Events of the profiler while the function runs: ``call`` of Python, ``c_call`` of C."""
    count = 0

    def seen(_frame: object, event: str, _argument: object) -> None:
        nonlocal count
        count += event in events

    former = sys.getprofile()
    sys.setprofile(seen)
    try:
        function()
    finally:
        sys.setprofile(former)
    return count


def kernel_calls_of(function: Callable[[], object]) -> int:
    """Kernels that run while the function does."""
    count, run = 0, BoundKernel.__call__

    def counted(self: BoundKernel, *arguments: object) -> None:
        nonlocal count
        count += 1
        run(self, *arguments)

    setattr(BoundKernel, "__call__", counted)  # noqa: B010 - mypy takes no assignment to a method
    try:
        function()
    finally:
        setattr(BoundKernel, "__call__", run)  # noqa: B010
    return count


def simulator_step(size: int, *overrides: str) -> Callable[[], object]:
    """A step of so many data centers, all compiled."""
    configs = sdc_taichi.make_configs(sdc_taichi.load_config("corrected", overrides), count=size)
    sim = sdc_taichi.Simulator(configs)
    sim.reset(0)
    sim.step()
    return sim.step


def environment_step(size: int) -> Callable[[], object]:
    """A step of so many environments with full observations and rewards, all compiled."""
    env = sdc_taichi.vector_env(size, "corrected")
    env.reset(seed=0)
    actions = {agent: np.ones(size, np.int64) for agent in env.possible_agents}
    for _ in range(3):
        env.step(actions)
    return lambda: env.step(actions)


def coolant_step(count: int, step_s: float) -> Callable[[], object]:
    """A step of transient coolant loops: five CDUs in each data center, each with three racks."""
    fleet = LiquidFleet.of_equal(count, racks=3, cdus=1, manifolds=5)
    racks = len(fleet.rack_manifold)
    loops = Liquid(fleet, step_s=step_s, transient=True)
    inputs = LiquidInputs(
        np.random.default_rng(0).uniform(0.0, 1.0, racks),
        np.ones(racks),
        *(np.full(count, celsius) for celsius in (20.0, 15.0, 10.0)),
    )
    state = loops.initial_state(inputs)

    def step() -> None:
        nonlocal state
        state, _ = loops.step(state, inputs)

    return step
