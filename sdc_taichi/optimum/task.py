"""Optimisation task: data centers with their inputs and options, and its division into parts."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sdc_taichi.errors import ConfigError
from sdc_taichi.optimum.cache import key_of
from sdc_taichi.optimum.loop_map import SAMPLES, LoopCommands
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import Agent, Problem, movable_agents, problems_of
from sdc_taichi.optimum.tables import (
    UTILISATIONS,
    OnStep,
    facility_kwh,
    facility_tables,
    setpoints_c,
)
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim import snapshot
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.snapshot import LAST_START
from sdc_taichi.types import I64

MOST_STEPS = 100 * 8760
"""Maximum number of steps of a plan."""
MOST_TABLE_BYTES = 2**28
"""Maximum memory of the tables of data centers that are solved together, in bytes."""
INLET_LIMITS_C = -50.0, 100.0
"""Smallest and largest valid limit of inlet temperatures, in C."""


@dataclass(frozen=True, slots=True)
class Task:
    """Optimisation task: the optima of B data centers with inputs and options."""

    fleet: Fleet
    """The B data centers."""
    drivers: Drivers
    """Inputs of the data centers, including prices."""
    start: I64
    """First step of each data center, counted from the beginning of the year, (B,)."""
    seed: I64
    """Seed of the sampled events of each data center, (B,); 0 without sampled events."""
    steps: int
    """Number of steps, T."""
    objective: Objective
    """Objective that plans minimise."""
    agents: tuple[Agent, ...]
    """Agents that plans may control."""
    scored_from: int
    """Number of the first scored step."""
    inlet_limit_c: float | None
    """Highest inlet temperature that plans may cause if another setpoint avoids it, in C. None
    means the limit of ``protection.ashrae_class``."""
    precision: Precision
    """Floating-point precision of the hall kernels."""
    uncoordinated: bool = False
    """True to simulate also the plans of agents that do not plan together. Cached results of both
    kinds have the same key."""

    def part(self, where: Sequence[int]) -> Task:
        """Return the task of some of the data centers."""
        chosen = list(where)
        return replace(
            self,
            fleet=build_fleet([self.fleet.configs[i] for i in chosen]),
            drivers=self.drivers.take(chosen),
            start=self.start[chosen],
            seed=self.seed[chosen],
        )

    def parts(self, where: Sequence[int]) -> Iterator[list[int]]:
        """Divide data centers into parts whose tables fit into memory; yield the indices of each.

        Args:
            where: indices of the data centers to divide.
        """
        part, size = list[int](), 0.0
        tables = 2 if "liquid" in self.agents else 1
        for i in where:
            nodes = UTILISATIONS[0] * len(setpoints_c(self.fleet.configs[i]))
            table_bytes = 4.0 * 8.0 * self.steps * nodes * tables
            if part and size + table_bytes > MOST_TABLE_BYTES:
                yield part
                part, size = [], 0.0
            part.append(i)
            size += table_bytes
        if part:
            yield part

    def keys(self) -> list[str]:
        """Return the cache key of each of B data centers: a hash of config, inputs and options."""
        options = {
            "steps": self.steps,
            "objective": str(self.objective),
            "agents": self.agents,
            "scored_from": self.scored_from,
            "inlet_limit_c": self.inlet_limit_c,
        }
        halls: dict[Hashable, Fleet] = {}
        keys = []
        for i, config in enumerate(self.fleet.configs):
            site = config.site
            same = config.hall, config.servers, config.hvac, site.location, site.weather_file
            if same not in halls:
                halls[same] = build_fleet(config)
            fingerprint = snapshot.fingerprint(
                replace(halls[same], configs=(config,)),
                self.drivers.take([i]),
                self.precision,
            )
            of_run = {"start": int(self.start[i]), "seed": int(self.seed[i])}
            keys.append(key_of(fingerprint, options | of_run))
        return keys

    def problems(self, on_step: OnStep | None = None) -> list[Problem]:
        """Compute the tables and the planning problem of each of B data centers.

        Args:
            on_step: Progress callback ``(done, total)`` of the tables.
        """
        tables_with = partial(
            facility_tables,
            self.fleet,
            self.drivers,
            start=self.start,
            steps=self.steps,
            precision=self.precision,
            on_step=on_step,
        )
        tables, held, loops = tables_with(loops=None), None, None
        if "liquid" in self.agents:
            loops = LoopCommands(self.fleet, self.drivers)
            tables, held = tables_with(loops=loops), tables
        with Simulator(self.fleet, drivers=self.drivers, precision=self.precision) as sim:
            problems = problems_of(
                self.fleet,
                self.drivers,
                sim.sizing,
                tables,
                start=self.start,
                objective=self.objective,
                agents=self.agents,
                scored_from=self.scored_from,
                inlet_limit_c=self.inlet_limit_c,
                held=held,
            )
        if loops is None:
            return problems
        return [
            replace(problem, loops_error=self._loops_error(dc, loops, problem))
            for dc, problem in enumerate(problems)
        ]

    def _loops_error(self, dc: int, loops: LoopCommands, problem: Problem) -> float:
        """Return by how much the energy of the commands of coolant loops exceeds the least one.

        It is the mean of steps under idle commands plus two standard errors, relative.
        """
        if self.fleet.configs[dc].liquid is None:
            return 0.0
        utilisation = np.minimum(problem.work.idle_tasks / TASKS_PER_STEP, 1.0)
        kwh = facility_kwh(problem.table, utilisation, problem.idle_setpoint_c)
        scored = self.steps - self.scored_from
        chosen = np.linspace(self.scored_from, self.steps - 1, min(SAMPLES, scored)).astype(int)
        outdoor_c, wet_bulb_c = (
            series.at(self.start[:, None] + chosen)[dc]
            for series in (self.drivers.outdoor_c, self.drivers.wet_bulb_c)
        )
        excess_w = loops.excess_w(dc, outdoor_c, wet_bulb_c, utilisation[chosen])
        if np.isinf(excess_w).any():
            return np.inf
        share = excess_w * problem.step_h / 1e3 / kwh[chosen]
        return float(share.mean() + 2.0 * share.std() / np.sqrt(len(chosen)))


def seeds_of_sampled_events(seed: I64, fleet: Fleet) -> I64:
    """Set the seeds of data centers without sampled events to 0, (B,)."""
    return np.where([bool(config.events.sampled) for config in fleet.configs], seed, 0)


def checked_start(start: I64 | Sequence[int], size: int) -> I64:
    """Check the first steps of B data centers and return them as int64, (B,).

    Raises:
        ConfigError: the steps are not valid.
    """
    first = np.asarray(start)
    whole = first.shape == (size,) and first.dtype.kind in "iu"
    if not whole or np.any((first < 0) | (first > LAST_START)):
        raise ConfigError(
            f"start {start!r}: valid is one integer of 0..{LAST_START:,} for each of {size} data "
            "centers"
        )
    return first.astype(np.int64)


def checked_agents(agents: Sequence[Agent] | None, fleet: Fleet) -> tuple[Agent, ...]:
    """Check names of agents and return them in the order of ``ALL_AGENTS``.

    Args:
        agents: the names; None stands for all agents of the fleet.
        fleet: the data centers.

    Raises:
        ConfigError: there is no name, or a name is unknown or repeated, or no data center has
            coolant loops.
    """
    known = movable_agents(fleet)
    if agents is None:
        return known
    named = (agents,) if isinstance(agents, str) else tuple(agents)
    if not named or len(set(named)) < len(named) or not set(named) <= set(known):
        raise ConfigError(
            f"agents {list(named)!r}: valid is one or more of {', '.join(known)}, each once"
        )
    return tuple(agent for agent in known if agent in named)
