"""What a step costs, counted instead of timed: kernel calls, Python calls, memory."""

from __future__ import annotations

import re
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from call_counts import calls_of
from sdc_taichi import Actions, Simulator, drivers_from_arrays, load_config
from sdc_taichi.envs.core import Core
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.kernels.compiler.launch import BoundKernel


def simulator(size: int, *overrides: str) -> Simulator:
    days = [20.0] * 96, [15.0] * 96, [300.0] * 96, [0.5] * 96
    sim = Simulator(
        [load_config("corrected", list(overrides))] * size,
        drivers=drivers_from_arrays(*([day] * size for day in days)),
    )
    sim.reset(0)
    return sim


def stepper(core: Core) -> Callable[[], Any]:
    actions = {agent: np.zeros(core.num_envs, dtype=np.int64) for agent in core.agents}
    core.reset(seed=0)
    # The first steps compile kernels and fill caches.
    for _ in range(3):
        core.step(actions)
    return lambda: core.step(actions)


@pytest.mark.parametrize(
    ("overrides", "kernels"),
    [((), 4), (("simulation.thermal=transient",), 5), (("hall.inlet_model=approach",), 4)],
    ids=str,
)
def test_kernels_of_a_step(
    overrides: tuple[str, ...], kernels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Work, queue, halls and facility are one call each, the limit of the plant one more."""
    sim = simulator(64, *overrides)
    sim.step()
    calls = 0
    run = BoundKernel.__call__

    def counted(self: BoundKernel, *given: Any) -> None:
        nonlocal calls
        calls += 1
        run(self, *given)

    monkeypatch.setattr(BoundKernel, "__call__", counted)
    sim.step(Actions(cooling=np.linspace(-2.0, 2.0, 64)))
    assert calls == kernels


def test_python_calls_do_not_grow_with_the_number_of_data_centers() -> None:
    few, many = simulator(2), simulator(96)
    for sim in (few, many):
        sim.step()
    assert calls_of(few.step, "call") == calls_of(many.step, "call") < 300


def test_python_calls_do_not_grow_with_the_number_of_environments() -> None:
    steps = [stepper(Core([load_config("corrected")], EnvOptions(), num_envs=n)) for n in (2, 96)]
    few, many = (calls_of(step, "call") for step in steps)
    assert few == many < 350


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_a_step_has_no_temporary_of_the_size_of_the_servers(thermal: str) -> None:
    sim = simulator(
        1,
        "hall.rows=20",
        "hall.racks_per_row=50",
        "hall.supply_approach_k=5.0",
        "hall.return_approach_k=-3.0",
        "servers.power_w=[200, 20]",
        f"simulation.thermal={thermal}",
    )
    sim.step()
    tracemalloc.start()
    try:
        sim.step()
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sim.fleet.servers >= 100_000
    assert most < sim.fleet.servers


SHOW_CODE = """
import taichi as ti
ti.init(arch=ti.cpu, offline_cache=False, print_kernel_llvm_ir_optimized=True, log_level=ti.ERROR)
from sdc_taichi import Simulator, load_config
sim = Simulator(load_config("corrected"))
sim.reset()
sim.step()
"""


def test_arithmetic_of_the_halls_is_on_vectors(tmp_path: Path) -> None:
    """Most of what the compiled f32 kernel multiplies and adds is eight racks at once or more."""
    subprocess.run(
        [sys.executable, "-c", SHOW_CODE],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        timeout=300,
    )
    shown = (path.read_text() for path in sorted(tmp_path.glob("*.ll")))
    # Devices are sized by the kernel of the run: another would take as long to compile.
    (code,) = (text for text in shown if "@hall_c" in text)
    on_vectors = len(re.findall(r" = f(?:mul|add|sub|div) .*<[0-9]+ x float>", code))
    one_by_one = len(re.findall(r" = f(?:mul|add|sub|div) (?:[a-z]+ )*float ", code))
    assert on_vectors > 150
    assert on_vectors > 4 * one_by_one
    # At every start machine code is made of it; copies of loop bodies would double it.
    assert code.count("\n") < 4300
