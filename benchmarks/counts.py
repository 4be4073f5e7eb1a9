"""Calls of a step, a measure of its cost that other jobs on the machine do not disturb."""

import sys
from collections.abc import Callable

import numpy as np

import sdc_taichi
from sdc_taichi.kernels.compiler.launch import BoundKernel


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
