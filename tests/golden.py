"""Digests of what presets of the paper and its code compute, which no change may touch.

``python tests/golden.py FILE`` writes them. They depend on the processor, so a file names the one
that it was made on.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

import sdc_taichi
from sdc_taichi import Actions, Simulator, load_config, make_configs

FILE = Path(__file__).with_name("reference") / "golden.json"
PRESETS = ("paper", "sustaindc")
STEPS = 96
EVENTS = (
    "events.scheduled=[{kind: chiller_derate, share: 0.4, start_h: 12, duration_h: 2}, "
    "{kind: heat_wave, offset_k: 8, start_h: 2, duration_h: 10}]"
)


class Digests:
    """Running digest of each of several named arrays."""

    def __init__(self) -> None:
        self._hashes: dict[str, Any] = {}

    def add(self, named: Iterable[tuple[str, Any]]) -> None:
        for name, value in named:
            digest = self._hashes.setdefault(name, hashlib.sha256())
            array = np.ascontiguousarray(value)
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.tobytes())

    def texts(self) -> dict[str, str]:
        return {name: digest.hexdigest()[:12] for name, digest in sorted(self._hashes.items())}


def _run(overrides: list[str], preset: str, precision: Literal["f32", "f64"]) -> dict[str, str]:
    configs = make_configs(load_config(preset, overrides), sites=["NY", "AZ"])
    digests, rng = Digests(), np.random.default_rng(0)
    with Simulator(configs, precision=precision) as sim:
        sim.reset(seed=0)
        for _ in range(STEPS):
            load, cooling, battery = rng.uniform(-1.0, 1.0, (3, sim.size))
            result = sim.step(Actions(load=load, cooling=2 * cooling, battery=battery))
            names = [f.name for f in fields(result) if f.name != "within_limits"]
            digests.add((name, getattr(result, name)) for name in names)
        servers = sim.servers()
        digests.add((f"servers {f.name}", getattr(servers, f.name)) for f in fields(servers))
    return digests.texts()


def _environment(preset: str) -> dict[str, str]:
    env = sdc_taichi.vector_env(num_envs=3, config=preset, days=1, observations="sustaindc")
    digests = Digests()
    seen, _ = env.reset(seed=7)
    digests.add((f"observation {agent}", value) for agent, value in seen.items())
    spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
    for agent, space in spaces.items():
        space.seed(len(agent))
    for _ in range(STEPS + 4):
        seen, rewards, _, cut, _ = env.step(
            {agent: [space.sample() for _ in range(3)] for agent, space in spaces.items()}
        )
        for kind, values in (("observation", seen), ("reward", rewards), ("cut", cut)):
            digests.add((f"{kind} {agent}", value) for agent, value in values.items())
    env.close()
    return digests.texts()


def cases() -> Iterator[tuple[str, Any]]:
    """Name of each case, and the function that computes its digests."""
    precisions: tuple[Literal["f32", "f64"], ...] = ("f32", "f64")
    for preset, precision, eventful in itertools.product(PRESETS, precisions, (False, True)):
        overrides = ["site.start=07-01", *([EVENTS] if eventful else [])]
        name = f"{preset} {precision}{' with events' if eventful else ''}"
        yield name, lambda o=overrides, p=preset, q=precision: _run(o, p, q)
    for preset in PRESETS:
        yield f"environment {preset}", lambda p=preset: _environment(p)


def processor() -> str:
    from sdc_taichi.run.description import processor_features

    return "; ".join(f"{name} {value}" for name, value in processor_features().items())


def main(path: Path) -> None:
    made = {name: compute() for name, compute in cases()}
    golden = {"processor": processor(), "cases": made}
    path.write_text(json.dumps(golden, indent=0) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
