"""Memory that a step takes, and that what was closed or dropped gives back."""

from __future__ import annotations

import gc
import tracemalloc
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import sdc_taichi
from sdc_taichi import ForecastError, Simulator, drivers_from_arrays, load_config


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_a_step_has_no_temporary_of_the_size_of_the_servers(thermal: str) -> None:
    days = [20.0] * 96, [15.0] * 96, [300.0] * 96, [0.5] * 96
    overrides = [
        "hall.rows=20",
        "hall.racks_per_row=50",
        "hall.supply_approach_k=5.0",
        "hall.return_approach_k=-3.0",
        "servers.power_w=[200, 20]",
        f"simulation.thermal={thermal}",
    ]
    sim = Simulator(load_config("corrected", overrides), drivers=drivers_from_arrays(*days))
    sim.reset(0)
    sim.step()
    tracemalloc.start()
    try:
        sim.step()
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sim.fleet.servers >= 100_000
    assert most < sim.fleet.servers


TRANSIENT = ["simulation.thermal=transient"]
HOLD = {"agent_ls": 1, "agent_dc": 1, "agent_bat": 1}
MAKERS: dict[str, Callable[[Path], Any]] = {
    "parallel": lambda _: sdc_taichi.parallel_env("tiny", days=1),
    "aec": lambda _: sdc_taichi.aec_env("tiny", days=1),
    "gymnasium": lambda _: gymnasium.make("sdc_taichi/Joint-v0", config="tiny", days=1),
    "make_vec": lambda _: gymnasium.make_vec("sdc_taichi/Joint-v0", config="tiny", days=1),
    "vector_env": lambda _: sdc_taichi.vector_env(1, "tiny", days=1),
    "with everything": lambda folder: sdc_taichi.parallel_env(
        load_config("corrected", TRANSIENT),
        days=1,
        heat_map=True,
        forecast_error=ForecastError(0.1, 1.0),
        rewards=lambda result, view: -result.grid_kwh,
        recorder=folder / "run.rrd",
    ),
    "released": lambda _: sdc_taichi.parallel_env(
        "sustaindc", days=1, observations="sustaindc", rewards="sustaindc"
    ),
}


@pytest.fixture
def no_garbage_collection() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def use(env: Any, steps: int) -> None:
    """Reset and step, whatever the standard."""
    env.reset(seed=1)
    for _ in range(steps):
        if hasattr(env, "agent_iter"):
            env.step(1)
        elif hasattr(env, "possible_agents"):
            env.step({a: [1] for a in HOLD} if hasattr(env, "num_envs") else HOLD)
        else:
            env.step(np.ones(env.action_space.shape, dtype=np.int64))


@pytest.mark.usefixtures("no_garbage_collection")
@pytest.mark.parametrize("steps", [0, 2])
@pytest.mark.parametrize("kind", MAKERS)
def test_an_environment_frees_its_memory_without_garbage_collection(
    kind: str, steps: int, tmp_path: Path
) -> None:
    env = MAKERS[kind](tmp_path)
    use(env, steps)
    core = env.unwrapped.core
    left = [
        weakref.ref(part)
        for part in (core.sim, core.sim._stages.hall, core._observer, core._rewards, core)
    ]
    env.close()
    # Of what was closed but is still referred to, nothing large is left.
    assert [ref() is None for ref in left] == [False, True, True, True, False]
    del core, env
    assert [ref() for ref in left] == [None] * 5


@pytest.mark.usefixtures("no_garbage_collection")
def test_dropped_without_being_closed() -> None:
    env, sim = sdc_taichi.vector_env(2, "tiny", days=1), Simulator(load_config("tiny"))
    use(env, 0)
    sim.reset()
    sim.step()
    left = [weakref.ref(x) for x in (env.core, env.core._observer, sim, sim._stages.hall)]  # type: ignore[union-attr]
    del env, sim
    assert [ref() for ref in left] == [None] * 4


@pytest.mark.usefixtures("no_garbage_collection")
@pytest.mark.parametrize("kind", ["gymnasium", "vector_env", "simulator"])
def test_what_is_closed_and_kept_holds_next_to_nothing(kind: str, tmp_path: Path) -> None:
    def closed() -> Any:
        env = Simulator(load_config("tiny")) if kind == "simulator" else MAKERS[kind](tmp_path)
        if isinstance(env, Simulator):
            env.reset()
            env.step()
        else:
            use(env, 2)
        env.close()
        return env

    closed()
    tracemalloc.start()
    try:
        kept = [closed() for _ in range(4)]
        with_kept, _ = tracemalloc.get_traced_memory()
        count = len(kept)
        # Python keeps the memory of some freed objects for later ones, and tracemalloc counts it.
        # The bytes that become free with the environments do not include it.
        kept.clear()
        without, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # 200 of them hold less than 20 MB.
    assert with_kept - without < count * 100_000
