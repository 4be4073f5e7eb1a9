"""Random data centers, and whether bound <= achieved <= every controller holds for each of them.

    python examples/optimum_scenarios.py [--count 300] [--seed 0]

draws models, sizes, limits, tariffs, sites, seasons, objectives and lengths of one to four days;
data centers of equal models, objective and length are solved and run together. It prints how many
scenarios were drawn, the gaps between bound and achieved figure, and every scenario in which a
figure lies where none may lie.
"""

from __future__ import annotations

import argparse
import random
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi import Simulator, load_config
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import commands_of, make_controller
from sdc_taichi.errors import OddInputWarning
from sdc_taichi.optimum.problem import AGENTS, RAMP_K, Agent
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.optimum.solve import solve
from sdc_taichi.run.achievable import run_beside

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
CONTROLLERS = (
    "random",
    "g36",
    "coldest",
    "warmest",
    "lookahead-3h",
    "lookahead-24h",
    "greedy-ci",
    "load=greedy-ci,cooling=g36,battery=lookahead-24h",
    "mpc-24h",
)
PER_GROUP = 10
SLACK = 1e-9
RELEASED_SLACK = 1e-5
"""Slack with batteries of model ``released``, which gain or lose energy as they round it."""
WATER_CHILLERS = ("centrifugal_vsd", "carnot", "eir_york", "electric_water_cooled", "constant_cop")
OBJECTIVES = ("carbon", "energy", "cost", "water", "carbon+0.002*water", "cost+0.1*carbon")
AGENT_SETS: tuple[tuple[Agent, ...], ...] = (
    AGENTS, AGENTS, AGENTS, ("load",), ("cooling",), ("battery",), ("load", "battery"),
)  # fmt: skip


@dataclass(frozen=True)
class Group:
    """Data centers that are solved together."""

    configs: tuple[DataCenterConfig, ...]
    objective: str
    agents: tuple[Agent, ...]
    steps: int
    scored_from: int
    inlet_limit_c: float | None

    def __str__(self) -> str:
        """Objective, agents and limits that all data centers of the group share, in one line."""
        limit = "" if self.inlet_limit_c is None else f", inlets to {self.inlet_limit_c:.1f} C"
        return (
            f"{self.objective} by {'+'.join(self.agents)}, steps {self.scored_from}..{self.steps}"
            f"{limit}"
        )


@dataclass(frozen=True)
class Finding:
    """A figure of a scenario that lies where none may lie."""

    what: str
    excess: float
    """By how much, over the figure of idle commands."""
    name: str
    overrides: str
    group: str


@dataclass(frozen=True)
class Checked:
    """Result of comparing bound, achieved figure and controllers in one group of scenarios."""

    size: int
    bounded: int
    """Scenarios that have a bound."""
    gaps: tuple[float, ...]
    """Achieved figure less bound, over the figure of idle commands, of those."""
    shares: dict[str, list[float]]
    """Shares of the achievable by controller, of runs that keep the constraints."""
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    """Certificates that do not hold, and reasons against bounds."""


@cache
def base(overrides: tuple[str, ...]) -> DataCenterConfig:
    """The small data center with some models."""
    return load_config("tiny", overrides)


def draw_group(draw: random.Random, size: int, longest_days: float = 4.0) -> Group:
    """A random group of data centers.

    Args:
        draw: Source of what is random.
        size: Number of data centers.
        longest_days: Longest run; the shortest is a quarter of it.
    """
    per_hour = draw.choice((4, 4, 4, 2, 1))
    battery = draw.choice(("clc", "clc", "paper", "released" if per_hour == 4 else "clc"))
    shared = [
        f"simulation.steps_per_hour={per_hour}",
        f"workload.model={draw.choice(('fluid', 'fluid', 'fluid', 'tasks'))}",
        f"battery.model={battery}",
        f"hvac.setpoint.model={draw.choice(('symmetric', 'symmetric', 'accelerating'))}",
        f"electrical.losses={draw.choice(('counted', 'reported'))}",
        *draw_plant(draw),
    ]
    agents = draw.choice(AGENT_SETS)
    objective = draw.choice(OBJECTIVES)
    if objective == "water" and "hvac.plant=air_cooled" in shared:
        # Such a plant needs no water.
        objective = "energy"
    configs = tuple(
        load_config("tiny", [f"name=dc{i}", *shared, *draw_fields(draw, per_hour)])
        for i in range(size)
    )
    limit_c = None
    if draw.random() < 0.3:
        warmest_c = max(config.hvac.setpoint.initial_c for config in configs)
        limit_c = round(warmest_c + draw.uniform(5.6, 8.0), 2)
    steps = max(round(draw.uniform(0.25, 1.0) * longest_days * 24 * per_hour), 2)
    scored_from = draw.choice((0, 0, steps // 4))
    return Group(configs, objective, agents, steps, scored_from, limit_c)


def draw_plant(draw: random.Random) -> list[str]:
    """Overrides of a random plant."""
    plant = draw.choice(("water_cooled", "water_cooled", "air_cooled", "air_side"))
    if plant == "water_cooled":
        return [f"hvac.chiller.model={draw.choice(WATER_CHILLERS)}"]
    return [f"hvac.plant={plant}", "hvac.chiller.model=electric_air_cooled"]


def draw_fields(draw: random.Random, per_hour: int) -> list[str]:
    """Overrides of one data center."""
    # Most ranges are of whole degrees, as tables have them.
    digits = draw.choice((0, 0, 0, 1))
    low_c, width_k = round(draw.uniform(15.0, 19.0), digits), round(draw.uniform(2.0, 6.0), digits)
    first_c = round(draw.uniform(low_c, low_c + width_k), digits)
    prices = [round(draw.uniform(0.02, 0.4), 3) for _ in range(24)]
    values: dict[str, Any] = {
        "site.location": draw.choice(SITES),
        "site.start": f"{draw.randint(1, 12):02d}-{draw.randint(1, 28):02d}",
        "workload.flexible_share": round(draw.choice((0.0, 0.2, draw.uniform(0.0, 0.9))), 3),
        "workload.queue_limit_h": draw.choice(("null", 0.01, 0.5, 2.5, 5.0)),
        "workload.deadline_h": draw.choice(("null", 1, 3, 24)),
        "workload.max_utilisation": draw.choice((1.0, 1.0, 0.9, 0.7)),
        "battery.hours_of_design_load": round(draw.choice((0.0, 1.0, draw.uniform(0, 6))), 2),
        "battery.initial_soc": draw.choice((0.0, 0.0, 0.5, 1.0)),
        "battery.charge_limit_c_rate": round(draw.uniform(0.1, 3.0), 2),
        "battery.discharge_limit_c_rate": round(draw.uniform(0.1, 3.0), 2),
        "hvac.setpoint.min_c": low_c,
        "hvac.setpoint.max_c": round(low_c + width_k, 1),
        "hvac.setpoint.initial_c": min(first_c, round(low_c + width_k, 1)),
        "hvac.setpoint.step_k": draw.choice((0.5, 1.0, 2.0)),
        "tariff.price_per_kwh": draw.choice((0.12, prices)),
        "tariff.demand_charge_per_kw": draw.choice((0.0, 12.0, 40.0)),
        "electrical.grid_limit_ratio": draw.choice(("null", 1.05, 1.25)),
    }
    return [f"{path}={value}" for path, value in values.items()]


def check(group: Group, controllers: Sequence[str] = CONTROLLERS) -> Checked:
    """Solve a group, run the controllers beside it, and compare.

    Args:
        group: Data centers that are solved together.
        controllers: Names of controllers.
    """
    optimum = solve(
        group.configs,
        steps=group.steps,
        objective=group.objective,
        agents=group.agents,
        scored_from=group.scored_from,
        inlet_limit_c=group.inlet_limit_c,
        cache=False,
        precision="f64",
    )
    found = _Findings(group, optimum)
    found.add("achieved figure below the bound", optimum.bound - optimum.achieved)
    found.add("achieved figure above idle", optimum.achieved - optimum.idle)
    shares: dict[str, list[float]] = {}
    with Simulator(group.configs, precision="f64") as sim:
        for name in controllers:
            # An optimum of fewer agents cannot be compared with it.
            controller = make_controller(name, sim.fleet)
            if not set(commands_of(controller)) <= set(group.agents):
                continue
            reached = run_beside(optimum, sim, controller, name)
            assert reached is not None
            keeps = np.array([not broken for broken in reached.broken])
            keeps &= keeps_ramp(group.configs, name)
            above = np.where(keeps, optimum.achieved - reached.valued_figure, np.nan)
            found.add(f"{name} below the achieved figure", above)
            below = np.where(keeps, optimum.bound - reached.valued_figure, np.nan)
            found.add(f"{name} below the bound", below)
            shares[name] = [x for x in np.where(keeps, reached.share, np.nan) if np.isfinite(x)]
    is_bound = np.array([kind == "bound" for kind in optimum.bound_kinds])
    gaps = (optimum.achieved - optimum.bound) / np.maximum(np.abs(optimum.idle), 1e-12)
    notes = [f"{kind} [{group}]" for kind in optimum.bound_kinds if kind != "bound"]
    notes += [
        f"{text} [{group}; {described(config)}]"
        for config, texts in zip(group.configs, optimum.failures, strict=True)
        for text in texts
    ]
    return Checked(
        size=len(group.configs),
        bounded=int(is_bound.sum()),
        gaps=tuple(gaps[is_bound]),
        shares=shares,
        findings=tuple(found.all),
        notes=tuple(notes),
    )


def keeps_ramp(configs: Sequence[DataCenterConfig], name: str) -> npt.NDArray[np.bool_]:
    """Mask of data centers whose setpoints a controller moves no faster than plans may, (B,).

    Setpoints that are held from the first step on get there at once.
    """
    ranges = [config.hvac.setpoint for config in configs]
    change_k = {
        "coldest": [x.initial_c - x.min_c for x in ranges],
        "warmest": [x.max_c - x.initial_c for x in ranges],
    }
    return np.array(change_k.get(name, [0.0] * len(ranges))) <= RAMP_K


class _Findings:
    """Figures that lie where none may lie.

    Args:
        group: The scenarios.
        optimum: What is known of their optima.
    """

    def __init__(self, group: Group, optimum: Optimum) -> None:
        self._group, self._optimum = group, optimum
        self.all: list[Finding] = []

    def add(self, what: str, excess: Any) -> None:
        """Add the scenarios with an excess above rounding, (B,); nan is none."""
        optimum = self._optimum
        size = np.maximum(np.abs(optimum.idle), 1e-12)
        rounds = self._group.configs[0].battery.model == "released"
        slack = RELEASED_SLACK if rounds else SLACK
        for i in np.flatnonzero(excess > slack * size):
            kind = optimum.bound_kinds[i]
            if "bound" in what and kind != "bound":
                continue
            self.all.append(
                Finding(
                    what=what,
                    excess=float(excess[i] / size[i]),
                    name=optimum.names[i],
                    overrides=described(self._group.configs[i]),
                    group=str(self._group),
                )
            )


def described(config: DataCenterConfig) -> str:
    """Fields of a configuration that differ from preset ``tiny``, in one line."""
    found = []

    def walk(prefix: str, here: Any, there: Any) -> None:
        for key, value in here.items():
            path = f"{prefix}{key}"
            if isinstance(value, dict) and isinstance(there.get(key), dict):
                walk(f"{path}.", value, there[key])
            elif value != there.get(key):
                text = f"{value:.4g}" if isinstance(value, float) else str(value)
                found.append(f"{path}={text.replace(' ', '')}")

    walk("", config.model_dump(mode="json"), base(()).model_dump(mode="json"))
    return " ".join(found)


def groups(count: int, seed: int) -> Iterator[Group]:
    """Groups of ``count`` scenarios in all."""
    draw = random.Random(seed)
    while count > 0:
        size = min(PER_GROUP, count)
        yield draw_group(draw, size)
        count -= size


def main(count: int, seed: int, verbose: bool) -> int:
    """Check many scenarios and print what came out; 1 if a figure lies where none may lie."""
    warnings.simplefilter("ignore", OddInputWarning)
    began, done, checked = time.perf_counter(), 0, list[Checked]()
    for group in groups(count, seed):
        checked.append(check(group))
        done += len(group.configs)
        worst = max((f.excess for f in checked[-1].findings), default=0.0)
        print(
            f"{done:4d} of {count}, {time.perf_counter() - began:5.0f} s: {group}: "
            f"{len(checked[-1].findings)} findings, largest {worst:.2e}",
            flush=True,
        )
        if verbose:
            for note in checked[-1].notes:
                print(f"     {note}")
    return report(checked)


def report(checked: Sequence[Checked]) -> int:
    """Print gaps, shares and findings of all groups; 1 if there are findings."""
    gaps = 100.0 * np.array([gap for group in checked for gap in group.gaps])
    bounded = sum(group.bounded for group in checked)
    print(f"\n{sum(group.size for group in checked)} scenarios, {bounded} with a bound")
    if len(gaps):
        quantiles = ", ".join(
            f"{q:.0%} {np.quantile(gaps, q):.3f}" for q in (0.5, 0.9, 0.95, 0.99, 1.0)
        )
        print(f"gap between bound and achieved, % of idle, at most in: {quantiles}")
    for name in CONTROLLERS:
        shares = [share for group in checked for share in group.shares.get(name, [])]
        if shares:
            print(f"{name:50} median share {np.median(shares):7.3f}, {len(shares)} runs")
    findings = sorted((f for group in checked for f in group.findings), key=lambda f: -f.excess)
    print(f"{len(findings)} findings")
    for finding in findings[:40]:
        print(f"{finding.excess:.2e} {finding.what}: {finding.name} [{finding.group}]")
        print(f"         {finding.overrides}")
    return int(bool(findings))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=300, help="number of scenarios")
    parser.add_argument("--seed", type=int, default=0, help="decides what is drawn")
    parser.add_argument("--verbose", action="store_true", help="print notes of all groups")
    options = parser.parse_args()
    raise SystemExit(main(options.count, options.seed, options.verbose))
