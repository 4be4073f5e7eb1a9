"""Digests of what the package computes, to hold a rewritten version against the one before it.

``python tests/golden.py FILE`` writes them. They depend on the processor, so a file names the one
that it was made on.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

import sdc_taichi
from sdc_taichi import Actions, Simulator, load_config, make_configs, make_controller

FILE = Path(__file__).with_name("reference") / "golden.json"
POLICIES = Path(__file__).with_name("reference") / "benchmark"
STEPS = 96
UNIT_DOWN = "{kind: crac_down, unit: 0, start_h: 6, duration_h: 3}, "
EVENTS = (
    "events.scheduled=[%s{kind: chiller_derate, share: 0.4, start_h: 12, duration_h: 2}, "
    "{kind: heat_wave, offset_k: 8, start_h: 2, duration_h: 10}]"
)
APPROACHES = ("paper", "sustaindc", "tiny", "large")
"""Presets without air that recirculates, where no unit can fail."""
VARIANTS: dict[str, list[str]] = {
    **{
        f"chiller {name}": [
            f"hvac.chiller.model={name}",
            "site.start=06-20",
            "hvac.setpoint.initial_c=18",
        ]
        for name in ("carnot", "eir_york", "electric_water_cooled", "electric_air_cooled")
    },
    "constant cop": ["hvac.chiller.model=constant_cop", "hvac.chiller.reference_cop=5"],
    "air-cooled": ["hvac.plant=air_cooled", "hvac.chiller.model=electric_air_cooled"],
    "outdoor air": ["hvac.plant=air_side", "hvac.chiller.model=electric_air_cooled"],
    "water by mass balance": ["hvac.water.model=mass_balance", "site.start=07-01"],
    "transient": ["simulation.thermal=transient", "hvac.crac.units=4"],
    "controlled fans": ["hvac.crac.flow_model=controlled", "hvac.crac.units=3"],
    "hottest inlet": ["hvac.crac.flow_model=hottest_inlet", "hvac.crac.units=3"],
    "pressure": ["hvac.crac.flow_model=pressure", "hvac.crac.units=2"],
    "return control": [
        "hvac.crac.temperature_control=return",
        "hvac.setpoint.min_c=18",
        "hvac.chiller.model=constant_cop",
        "hvac.chiller.reference_cop=5",
    ],
    "layout": ["hall.layout.containment=0.5", "hall.height_zones=3"],
    "inlet-aware": ["workload.placement=inlet-aware"],
    "fill": ["workload.placement=fill"],
    "whole tasks": ["workload.model=tasks"],
    "small grid connection": ["electrical.grid_limit_kw=400"],
    "tariff": ["tariff.price_per_kwh=0.2", "tariff.demand_charge_per_kw=10"],
}


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


def _run(
    overrides: list[str], preset: str, precision: Literal["f32", "f64"], steps: int = STEPS
) -> dict[str, str]:
    configs = make_configs(load_config(preset, overrides), sites=["NY", "AZ"])
    digests, rng = Digests(), np.random.default_rng(0)
    with Simulator(configs, precision=precision) as sim:
        sim.reset(seed=0)
        fans = any(config.hvac.crac.flow_model == "controlled" for config in configs)
        for _ in range(steps):
            load, cooling, battery = rng.uniform(-1.0, 1.0, (3, sim.size))
            moves = {"fan": rng.uniform(-1.0, 1.0, sim.size)} if fans else {}
            result = sim.step(Actions(load=load, cooling=2 * cooling, battery=battery, **moves))
            names = [f.name for f in fields(result) if f.name != "within_limits"]
            digests.add((name, getattr(result, name)) for name in names)
        servers = sim.servers()
        digests.add((f"servers {f.name}", getattr(servers, f.name)) for f in fields(servers))
    return digests.texts()


def _environment(preset: str, **options: Any) -> dict[str, str]:
    env = sdc_taichi.vector_env(num_envs=3, config=preset, days=1, **options)
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


def _policy(name: str) -> dict[str, str]:
    preset = "corrected"
    configs = make_configs(load_config(preset, ["site.start=04-02"]), sites=["NY", "CA"])
    digests = Digests()
    with Simulator(configs) as sim:
        controller = make_controller(f"policy:{POLICIES / name / 'ippo'}", sim.fleet)
        total = sdc_taichi.simulate(sim, _Recorded(controller, digests), STEPS)
    assert total is not None
    return digests.texts()


def optimum() -> dict[str, float]:
    """Bound and achieved carbon of two days of preset tiny, in kg."""
    command = [sys.executable, "-c", "from sdc_taichi.cli.app import main; main()"]
    command += ["optimum", "tiny", "--days", "2", "--no-cache", "--quiet", "--json"]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    row: dict[str, Any] = json.loads(answer.stdout)["data_centers"][0]
    alone: dict[str, float] = row["alone"]
    return {name: row[name] for name in ("idle", "bound", "achieved")} | alone


class _Recorded:
    """A controller whose actions are digested."""

    def __init__(self, controller: Any, digests: Digests) -> None:
        self._controller, self._digests = controller, digests

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)

    def act(self, view: Any) -> Actions:
        actions: Actions = self._controller.act(view)
        self._digests.add(
            (name, getattr(actions, name))
            for name in ("load", "cooling", "battery")
            if getattr(actions, name) is not None
        )
        return actions

    def reset(self, seed: int) -> None:
        self._controller.reset(seed)


def cases() -> Iterator[tuple[str, Any]]:
    """Name of each case, and the function that computes its digests."""
    precisions: tuple[Literal["f32", "f64"], ...] = ("f32", "f64")
    presets = ("corrected", "hall_of_2026", "large", "paper", "sustaindc", "tiny")
    for preset, precision, eventful in itertools.product(presets, precisions, (False, True)):
        overrides = ["site.start=07-01"]
        if eventful:
            overrides.append(EVENTS % ("" if preset in APPROACHES else UNIT_DOWN))
            if preset not in APPROACHES:
                overrides.append("protection.ashrae_class=A1")
        name = f"{preset} {precision}{' with events' if eventful else ''}"
        yield name, lambda o=overrides, p=preset, q=precision: _run(o, p, q)
    for name, overrides in VARIANTS.items():
        yield name, lambda o=overrides: _run(o, "corrected", "f64", 48)
    for preset, kind in (
        ("tiny", "default"),
        ("corrected", "default"),
        ("sustaindc", "sustaindc"),
    ):
        yield (
            f"environment {preset} {kind}",
            lambda p=preset, k=kind: _environment(p, observations=k),
        )
    yield "environment continuous", lambda: _environment("corrected", actions="continuous")
    for name in ("carbon", "bill"):
        yield f"policy {name}", lambda n=name: _policy(n)


def processor() -> str:
    from sdc_taichi.run.description import processor_features

    return "; ".join(f"{name} {value}" for name, value in processor_features().items())


def same_optimum(figures: dict[str, float], others: dict[str, float]) -> bool:
    """Whether optima agree as closely as the solver's tolerances let them."""
    return figures.keys() == others.keys() and np.allclose(
        list(figures.values()), [others[name] for name in figures], rtol=1e-7, atol=0.0
    )


def main(path: Path) -> None:
    made = {name: compute() for name, compute in cases()}
    golden = {"processor": processor(), "optimum": optimum(), "cases": made}
    path.write_text(json.dumps(golden, indent=0) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
