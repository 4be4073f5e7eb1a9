"""Saved states of simulators and environments: damaged, they are refused and change nothing."""

from __future__ import annotations

import copy
import io
from functools import cache
from typing import Any

import numpy as np

import sdc_taichi
from fuzz import damage, physics
from fuzz.case import DefectError, Scratch
from sdc_taichi import SdcError, Simulator

TROUBLED = (
    "simulation.thermal=transient", "hall.rows=2", "hall.racks_per_row=2",
    "hall.servers_per_rack=20", "hall.supply_approach_k=4", "hall.return_approach_k=-3",
    "servers.power_w=[150, 10]", "hvac.crac.units=2", "protection.ashrae_class=A1",
    "events.sampled=[{kind: crac_down, per_year: 400, duration_h: [1, 4]}]",
)  # fmt: skip
CONFIGS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("tiny", ()),
    ("corrected", TROUBLED),
    ("sustaindc", ()),
)


@cache
def simulator(which: int) -> Simulator:
    """A simulator that cases share."""
    return Simulator(sdc_taichi.load_config(*CONFIGS[which]), precision="f64")


@cache
def environment(which: int) -> Any:
    """An environment that cases share."""
    config = sdc_taichi.load_config(*CONFIGS[which % 2])
    if which < 2:
        return sdc_taichi.parallel_env(config, days=1)
    return sdc_taichi.vector_env(2, config, days=1)


def states(scratch: Scratch) -> None:
    """Give a simulator or an environment a changed state, and go on from it."""
    if scratch.chance(0.5):
        _of_simulator(scratch)
    else:
        _of_environment(scratch)


def _of_simulator(scratch: Scratch) -> None:
    sim = simulator(int(scratch.rng.integers(len(CONFIGS))))
    sim.reset(seed=int(scratch.rng.integers(5)))
    for _ in range(int(scratch.rng.integers(3))):
        sim.step(physics.actions(scratch, sim))
    values: Any = sim.state_dict()
    by_file = scratch.chance(0.3)
    if by_file:
        buffer = io.BytesIO()
        np.savez(buffer, **(values if scratch.chance(0.5) else changed(scratch, values)))
        content = buffer.getvalue()
        if scratch.chance(0.6):
            content = damage.damaged_bytes(scratch.rng, content)
        path = scratch.write("state.npz", content)
        scratch.named.append("snapshot")
    else:
        values = changed(scratch, values)
    before = sim.state_dict()
    try:
        if by_file:
            sim.load(path)
        else:
            sim.load_state_dict(values)
    except SdcError:
        _check_equal(before, sim.state_dict())
        raise
    start = sim.state
    physics.check(sim, start, [sim.step(physics.actions(scratch, sim)) for _ in range(3)])


def _of_environment(scratch: Scratch) -> None:
    env = environment(int(scratch.rng.integers(3)))
    env.reset(seed=int(scratch.rng.integers(5)))
    for _ in range(int(scratch.rng.integers(3))):
        env.step(_sampled(env))
    values = changed(scratch, env.state_dict())
    before = env.state_dict()
    try:
        env.load_state_dict(values)
    except SdcError:
        _check_equal(before, env.state_dict())
        raise
    for _ in range(3):
        observations, rewards, *_ = env.step(_sampled(env))
        for found in (observations, rewards):
            for name, value in found.items():
                if not np.all(np.isfinite(np.asarray(value, dtype=np.float64))):
                    raise DefectError(f"{name}: {value}")


def _sampled(env: Any) -> dict[str, Any]:
    """Neutral actions, and the same in every run of a case."""
    if hasattr(env, "num_envs"):
        return {agent: np.ones(env.num_envs, dtype=np.int64) for agent in env.agents}
    return dict.fromkeys(env.agents or env.possible_agents, 1)


def _check_equal(before: Any, after: Any) -> None:
    if isinstance(before, dict):
        for name in before:
            _check_equal(before[name], after[name])
    elif isinstance(before, list):
        for one, other in zip(before, after, strict=True):
            _check_equal(one, other)
    elif not np.array_equal(before, after, equal_nan=np.asarray(before).dtype.kind == "f"):
        raise DefectError("a state that was refused has changed something")


def changed(scratch: Scratch, values: dict[str, Any]) -> dict[str, Any]:
    """A copy with an entry somewhere left out, added or changed."""
    values = copy.deepcopy(values)
    node: Any = values
    while True:
        if isinstance(node, list):
            key: Any = int(scratch.rng.integers(len(node))) if node else None
        else:
            key = scratch.pick(sorted(node))
        if key is None or not isinstance(node[key], dict | list) or scratch.chance(0.15):
            break
        if not node[key]:
            break
        node = node[key]
    how = int(scratch.rng.integers(8))
    if key is None or how == 0:
        if isinstance(node, list):
            node.append(1)
        else:
            node["extra"] = 1
    elif how == 1:
        del node[key]
    elif how == 2:
        node[key] = scratch.pick((None, "x", -1, 1e308, float("nan"), [], {}, b"x", 2**80, ...))
    elif isinstance(node[key], np.ndarray) and node[key].dtype.kind in "fiu":
        node[key] = _changed_array(scratch, node[key])
    elif isinstance(node[key], int | float):
        node[key] = node[key] * scratch.pick((-1, 2, 0, 1e9)) + scratch.pick((0, 1))
    return values


def _changed_array(scratch: Scratch, array: Any) -> Any:
    rng = scratch.rng
    how = int(rng.integers(7))
    if how == 0:
        kinds = ("f4", "f8", "i8", "i4", "?", "U8", "object", "complex128")
        with np.errstate(all="ignore"):
            return np.zeros(array.shape, dtype=kinds[int(rng.integers(len(kinds)))])
    if how == 1:
        return array.ravel()[:-1] if scratch.chance(0.5) else array[None]
    out = np.array(array)
    if not out.size:
        return out
    at = np.unravel_index(int(rng.integers(out.size)), out.shape) if out.ndim else ()
    if out.dtype.kind == "f":
        out[at] = scratch.pick((np.nan, np.inf, -np.inf, 1e308, -1e6, 1e6, -1.0, 0.0, 1.5, 60.0))
    else:
        limits = np.iinfo(out.dtype)
        out[at] = scratch.pick((limits.max, limits.min, -1 if limits.min else 0, 0, 1, 2, 3, 99))
    return out
