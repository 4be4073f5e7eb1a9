"""Searches for the CRAC commands of a hall that need least power within a limit of the inlets.

They minimise the power of the facility in steady states, plus a penalty for inlets above the limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdc_taichi.sim.commanded_halls import CommandedHalls, HallConditions, HallStates
from sdc_taichi.types import F64

PENALTY_W_PER_K = 200e3
"""Penalty for the hottest inlet above the limit, in W/K."""
PENALTY_PER_UNMET = 10.0
"""Penalty for heat that is not removed, in W per W."""
GRID = (12, 8)
"""Numbers of speeds and of setpoints of a grid; ``one_speed`` needs as many copies of a hall."""
_NARROWER = (0.35, 0.4)
"""Factors by which the ranges of speed and setpoint shrink from grid to grid."""


@dataclass(frozen=True, slots=True)
class FoundCommands:
    """Commands of the U CRAC units of a hall, and the steady state under them."""

    speed: F64
    """Speed of each fan as a share of full speed, (U,)."""
    supply_c: F64
    """Supply temperature of each unit, in C, (U,)."""
    cost_w: float
    """Power of the facility with penalties, in W."""
    facility_w: float
    """Power of the facility, in W."""
    cooling_w: float
    """Power of HVAC and of the fans of servers, in W."""
    inlet_max_c: float
    """Hottest server inlet, in C."""


def cost_w(states: HallStates, limit_c: float) -> F64:
    """Return the power of facilities with penalties, in W, (n,).

    Args:
        states: Steady states.
        limit_c: Highest server inlet without penalty, in C.
    """
    above_k = np.maximum(states.inlet_max_c - limit_c, 0.0)
    return states.facility_w + PENALTY_W_PER_K * above_k + PENALTY_PER_UNMET * states.unmet_w


def found(states: HallStates, at: int, supply_c: F64, limit_c: float) -> FoundCommands:
    """Return the commands of one of n copies, with supply temperatures in C, (n, U)."""
    return FoundCommands(
        speed=states.speed[at].copy(),
        supply_c=supply_c[at].copy(),
        cost_w=float(cost_w(states, limit_c)[at]),
        facility_w=float(states.facility_w[at]),
        cooling_w=float(states.cooling_w[at]),
        inlet_max_c=float(states.inlet_max_c[at]),
    )


def one_speed(
    halls: CommandedHalls, conditions: HallConditions, limit_c: float, grids: int
) -> FoundCommands:
    """Find one speed and one supply temperature for all units by successive grids.

    Args:
        halls: At least 96 copies of the hall.
        conditions: Load, weather and failures.
        limit_c: Highest server inlet without penalty, in C.
        grids: Number of grids, each narrower than the one before and around its best pair.
    """
    low_c, high_c = halls.setpoint_c
    speed, half_speed = (1.0 + halls.min_speed) / 2.0, (1.0 - halls.min_speed) / 2.0
    supply_c, half_k = (low_c + high_c) / 2.0, (high_c - low_c) / 2.0
    best: FoundCommands | None = None
    for _ in range(grids):
        speeds = speed + half_speed * np.linspace(-1.0, 1.0, GRID[0])
        supplies_c = supply_c + half_k * np.linspace(-1.0, 1.0, GRID[1])
        pairs = np.meshgrid(
            np.clip(speeds, halls.min_speed, 1.0), np.clip(supplies_c, low_c, high_c), indexing="ij"
        )
        commands = [np.repeat(pair.reshape(-1, 1), halls.units, axis=1) for pair in pairs]
        states = halls.at(commands[0], commands[1], conditions)
        cost = cost_w(states, limit_c)
        at = int(np.argmin(cost))
        if best is None or cost[at] < best.cost_w:
            best = found(states, at, commands[1], limit_c)
        if not np.isfinite(cost[at]):
            speed, half_speed = speed + half_speed / 2.0, half_speed / 2.0
            continue
        speed, supply_c = float(commands[0][at, 0]), float(commands[1][at, 0])
        half_speed, half_k = half_speed * _NARROWER[0], half_k * _NARROWER[1]
    assert best is not None
    return best


def best_found(
    halls: CommandedHalls,
    conditions: HallConditions,
    starts: Sequence[FoundCommands],
    limit_c: float,
    *,
    generations: int,
    seed: int,
) -> FoundCommands:
    """Search the speed and the supply temperature of every unit by a separable CMA-ES.

    Each start begins a search of its own; the result is at least as good as the best start, and
    may still be far from the optimum. The method is that of Ros and Hansen 2008 (*A simple
    modification in CMA-ES achieving linear time and space complexity*, PPSN X), with the variances
    of the coordinates in place of their covariances.

    Args:
        halls: Copies of the hall, one for each member of a generation.
        conditions: Load, weather and failures.
        starts: Commands to begin with.
        limit_c: Highest server inlet without penalty, in C.
        generations: Number of generations of each search.
        seed: Seed of the random numbers.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    best = min(starts, key=lambda start: start.cost_w)
    for start in starts:
        best = min(
            best,
            _search(halls, conditions, start, limit_c, generations, rng),
            key=lambda commands: commands.cost_w,
        )
    return best


def _search(
    halls: CommandedHalls,
    conditions: HallConditions,
    start: FoundCommands,
    limit_c: float,
    generations: int,
    rng: np.random.Generator,
) -> FoundCommands:
    units, best = halls.units, start
    low_c, high_c = halls.setpoint_c
    # Supply temperatures count in tens of kelvins, so that all coordinates have similar ranges.
    low = np.repeat([halls.min_speed, low_c / 10.0], units)
    high = np.repeat([1.0, high_c / 10.0], units)
    mean = np.clip(np.concatenate([start.speed, start.supply_c / 10.0]), low, high)
    size, n = len(mean), halls.copies - 1
    parents = n // 4
    weight = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weight /= weight.sum()
    effective = 1.0 / (weight**2).sum()
    path_rate = (effective + 2) / (size + effective + 5)
    mean_rate = 4.0 / (size + 4)
    separable = (size + 2) / 3.0
    rank_one = 2.0 / ((size + 1.3) ** 2 + effective) * separable
    rank_mu = 2.0 * (effective - 2 + 1 / effective) / ((size + 2) ** 2 + effective) * separable
    rank_mu = min(1.0 - rank_one, rank_mu)
    expected = np.sqrt(size) * (1.0 - 1.0 / (4 * size))
    variance, step = np.ones(size), 0.03
    path, step_path = np.zeros(size), np.zeros(size)
    for generation in range(generations):
        drawn = mean + step * np.sqrt(variance) * rng.standard_normal((n, size))
        members = np.clip(np.concatenate([mean[None], drawn]), low, high)
        supply_c = members[:, units:] * 10.0
        states = halls.at(members[:, :units], supply_c, conditions)
        cost = cost_w(states, limit_c)
        at = int(np.argmin(cost))
        if cost[at] < best.cost_w:
            best = found(states, at, supply_c, limit_c)
        if not np.isfinite(cost[at]):
            mean[:units] = np.clip(mean[:units] + 0.03, low[:units], high[:units])
            step *= 0.6
            continue
        moves = (members[np.argsort(cost[1:], kind="stable")[:parents] + 1] - mean) / step
        move = weight @ moves
        mean = mean + step * move
        step_path = (1 - path_rate) * step_path + np.sqrt(
            path_rate * (2 - path_rate) * effective
        ) * move / np.sqrt(variance)
        length = np.linalg.norm(step_path)
        usual = np.sqrt(1 - (1 - path_rate) ** (2 * (generation + 1))) * expected
        is_usual = length < (1.4 + 2 / (size + 1)) * usual
        path = (1 - mean_rate) * path + is_usual * np.sqrt(
            mean_rate * (2 - mean_rate) * effective
        ) * move
        variance = (1 - rank_one - rank_mu) * variance + rank_one * path**2
        variance = np.maximum(variance + rank_mu * (weight @ moves**2), 1e-12)
        step *= np.exp(np.clip(path_rate * (length / expected - 1), -0.6, 0.6))
    return best
