"""Random actions of every kind in batches of environments, none of which may stop a batch.

``python tests/random_actions.py --envs 4096 --steps 10000`` runs every preset with every kind.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi import OddInputWarning, load_config, preset_names, vector_env
from sdc_taichi.envs.agents import AGENTS

PLACED = {"workload.placement": "weights"}
FANS = {"hvac.crac.flow_model": "controlled"}
_OF_LOOPS = {"agents": ["agent_ls", "plant", "cdu", "power_cap"], "actions": "continuous"}
KINDS: dict[str, tuple[dict[str, Any], dict[str, list[str]], dict[str, Any]]] = {
    "discrete": ({}, {}, {}),
    "continuous": ({}, {}, {"actions": "continuous"}),
    "fans": (FANS, {"agent_dc": ["cooling", "fan"]}, {}),
    "continuous fans": (FANS, {"agent_dc": ["cooling", "fan"]}, {"actions": "continuous"}),
    "placement": (PLACED, {"agent_ls": ["load", "placement"]}, {"actions": "continuous"}),
    "units": (
        {},
        {"crac": ["fan", "cooling"], "plant": ["chilled_water"]},
        {"agents": ["crac", "plant"], "actions": "continuous", "neighbours": 2},
    ),
    "loops": ({}, {"plant": ["facility_approach_k", "reuse_share"]}, _OF_LOOPS),
    "discrete loops": (
        {},
        {"plant": ["facility_approach_k", "reuse_share"]},
        {"agents": ["plant", "cdu", "power_cap"]},
    ),
    "sites": ({}, {}, {"agents": [*AGENTS, "agent_geo"], "actions": "continuous"}),
}
"""Overrides, commands and options of environments by kind of actions."""


def cases() -> Iterator[tuple[str, str]]:
    """Yield each preset with each kind of actions that it can have."""
    for preset in preset_names():
        config = load_config(preset)
        of_units = config.hvac.crac.flow_model == "controlled"
        has = {
            "fans": config.hall.inlet_model == "recirculation" and not of_units,
            "placement": not of_units,
            "units": of_units,
            "loops": config.liquid is not None,
            "sites": config.fleet is not None,
        }
        yield from ((preset, kind) for kind in KINDS if has.get(kind.split()[-1], True))


def play(
    preset: str, kind: str, envs: int, steps: int, *, demand: float = 0.95, seed: int = 0
) -> dict[str, int]:
    """Play random actions at a constant demand; return how often episodes ended, by reason.

    Raises:
        AssertionError: A reward, an observation or an info is not finite.
    """
    overrides, commands, options = KINDS[kind]
    if overrides is FANS and preset != "hall_of_2026":
        overrides = overrides | {"hvac.crac.units": 4}
    ended = {"length": 0, "limits": 0}
    rng = np.random.default_rng(seed)
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        trace = Path(folder, "constant.csv")
        trace.write_text("cpu_load\n" + f"{demand}\n" * 8760)
        overrides = overrides | {"site.workload_file": str(trace)}
        warnings.simplefilter("ignore", OddInputWarning)
        arguments = options | ({"commands": commands} if commands else {})
        env = vector_env(envs, preset, days=7, overrides=overrides, **arguments)
    env.reset(seed=seed)
    spaces = env.action_spaces
    for _ in range(steps):
        actions = {}
        for agent, space in spaces.items():
            names = env.core.members[agent]
            members = () if names == (agent,) else (len(names),)
            shape = (envs, *members, *(space.shape or ()))
            is_number = space.dtype is not None and space.dtype.kind == "f"
            drawn = rng.uniform(-1.0, 1.0, shape) if is_number else rng.integers(0, 3, shape)
            actions[agent] = drawn.astype(space.dtype)
        seen, rewards, terminated, truncated, infos = env.step(actions)
        values = [*seen.values(), *rewards.values(), *infos.values()]
        assert all(np.isfinite(array).all() for array in values if array.dtype.kind == "f")
        agent = env.agents[0]
        ended["limits"] += int(terminated[agent].sum())
        ended["length"] += int(truncated[agent].sum())
    env.close()
    return ended


def main() -> None:
    """Play all cases, and print how episodes ended and how long it took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--preset", choices=preset_names(), help="this preset alone")
    parser.add_argument("--kind", choices=KINDS, help="this kind of actions alone")
    arguments = parser.parse_args()
    for preset, kind in cases():
        if arguments.preset in (None, preset) and arguments.kind in (None, kind):
            begin = time.perf_counter()
            ended = play(preset, kind, arguments.envs, arguments.steps)
            took_s = time.perf_counter() - begin
            sys.stdout.write(f"{preset}, {kind}: {ended}, {took_s:.0f} s\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
