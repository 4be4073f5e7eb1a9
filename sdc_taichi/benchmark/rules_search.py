"""Search for the best combination of a rule for each agent."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from sdc_taichi.control.view import limits_of
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.sim.fleet import Fleet

WINDOWS_H = (6, 12, 24, 48)
"""Windows of rules by rank, in h."""
SHARES = (0.1, 0.2, 0.3, 0.4)
"""Shares of the window that rules by rank count as lowest, and as highest."""
SETPOINTS_C = tuple(range(17, 24))
"""Constant setpoints of cooling, in C, as far as a data center allows them."""
LIQUID = ("idle", "liquid-wet-bulb", "liquid-reset", "liquid-greedy")
"""Rules for liquid-cooled racks."""


def best_rules(objective: str, change_pct: Callable[[str], float], fleet: Fleet) -> str:
    """Return the best combination of a rule for each agent, as the spec of a controller.

    Work and battery are idle or follow a rule by rank of the carbon intensity or price, and
    liquid-cooled racks have a rule too. The search begins with idle agents. It replaces the rule of
    one agent after another by the best one beside the present rules of the others, until no rule
    changes.

    Args:
        objective: Objective of the figures. Rules rank the coming steps by its value of a kWh.
        change_pct: Function that returns the figure of a controller against idle commands, in %.
        fleet: The data centers to control.
    """
    figure = cache(change_pct)
    ranked = Objective.parse(objective).of_energy
    names = [f"rank-{hours}h:{share}:{ranked}" for hours in WINDOWS_H for share in SHARES]
    ranks = names if ranked else []
    rules = {"load": ["idle", *ranks], "cooling": _cooling(fleet), "battery": ["idle", *ranks]}
    if fleet.cdus:
        rules["liquid"] = [*LIQUID]
    best = dict.fromkeys(rules, "idle")
    before: dict[str, str] = {}
    while best != before:
        before = dict(best)
        for agent, of_agent in rules.items():
            combined = [{**best, agent: name} for name in (best[agent], *of_agent)]
            # The first of equal ones is the present one, so the search ends.
            best = min(combined, key=lambda of_agents: figure(_spec(of_agents)))
    return _spec(best)


def _cooling(fleet: Fleet) -> list[str]:
    """Return the rules for cooling, with the constant setpoints that all data centers allow."""
    limits = limits_of(fleet)
    low, high = limits.setpoint_low_c.max(), limits.setpoint_high_c.min()
    constant = [f"constant:{setpoint_c}" for setpoint_c in SETPOINTS_C if low <= setpoint_c <= high]
    return ["idle", "coldest", *constant, "g36"]


def _spec(of_agents: dict[str, str]) -> str:
    return ",".join(f"{agent}={name}" for agent, name in of_agents.items())
