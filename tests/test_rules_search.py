"""The search for a rule for each agent."""

from __future__ import annotations

from collections.abc import Callable

from sdc_taichi.benchmark.rules_search import COOLING, best_rules


def figures(best: dict[str, str], asked: list[str]) -> Callable[[str], float]:
    """Return a figure that falls by 1 for each agent with its best rule, and by 1 more if work and
    battery both have theirs."""

    def figure(spec: str) -> float:
        asked.append(spec)
        of_agents = dict(part.split("=") for part in spec.split(","))
        hits = {agent for agent, name in of_agents.items() if best[agent] == name}
        return -len(hits) - ({"load", "battery"} <= hits)

    return figure


def test_search_finds_the_best_of_each_agent_and_asks_once() -> None:
    best = {
        "load": "rank-12h:0.4:carbon",
        "cooling": "constant:19",
        "battery": "rank-24h:0.1:carbon",
    }
    asked: list[str] = []
    assert best_rules("carbon", figures(best, asked)) == ",".join(
        f"{agent}={name}" for agent, name in best.items()
    )
    assert len(asked) == len(set(asked))
    # Each of two passes tries at most every name of every agent.
    assert len(asked) <= 2 * (17 + len(COOLING) + 17)


def test_idle_stays_where_no_rule_is_better() -> None:
    assert best_rules("cost", lambda _: 0.0) == "load=idle,cooling=idle,battery=idle"


def test_rules_rank_by_the_value_of_a_kwh() -> None:
    asked: list[str] = []

    def figure(spec: str) -> float:
        asked.append(spec)
        return 0.0

    best_rules("cost+0.1*carbon+20*heat", figure)
    assert "load=rank-6h:0.1:0.1*carbon+cost,cooling=idle,battery=idle" in asked
    asked.clear()
    best_rules("heat", figure)
    assert len(asked) == len(COOLING)
