"""Search for the best combination of a rule for each agent."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from sdc_taichi.optimum.objective import Objective

WINDOWS_H = (6, 12, 24, 48)
"""Windows of rules by rank, in h."""
SHARES = (0.1, 0.2, 0.3, 0.4)
"""Shares of the window that rules by rank count as lowest, and as highest."""
COOLING = ("idle", "coldest", *(f"constant:{setpoint_c}" for setpoint_c in range(17, 24)), "g36")
"""Rules for cooling."""


def best_rules(objective: str, change_pct: Callable[[str], float]) -> str:
    """Return the best combination of a rule for each agent, as the spec of a controller.

    Work and battery are idle or follow a rule by rank of the carbon intensity or price. The search
    begins with idle agents. It replaces the rule of one agent after another by the best one beside
    the present rules of the others, until no rule changes.

    Args:
        objective: Objective of the figures. Rules rank the coming steps by its value of a kWh.
        change_pct: Function that returns the figure of a controller against idle commands, in %.
    """
    figure = cache(change_pct)
    ranked = Objective.parse(objective).of_energy
    names = [f"rank-{hours}h:{share}:{ranked}" for hours in WINDOWS_H for share in SHARES]
    ranks = names if ranked else []
    rules = {"load": ["idle", *ranks], "cooling": [*COOLING], "battery": ["idle", *ranks]}
    best = dict.fromkeys(rules, "idle")
    before: dict[str, str] = {}
    while best != before:
        before = dict(best)
        for agent, of_agent in rules.items():
            combined = [{**best, agent: name} for name in (best[agent], *of_agent)]
            # The first of equal ones is the present one, so the search ends.
            best = min(combined, key=lambda of_agents: figure(_spec(of_agents)))
    return _spec(best)


def _spec(of_agents: dict[str, str]) -> str:
    return ",".join(f"{agent}={name}" for agent, name in of_agents.items())
