"""The search for a rule for each agent."""

from __future__ import annotations

from collections.abc import Callable

from sdc_taichi import load_config
from sdc_taichi.benchmark.rules_search import best_rules
from sdc_taichi.sim.fleet import build_fleet

AIR = build_fleet(load_config("corrected"))


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
    assert best_rules("carbon", figures(best, asked), AIR) == ",".join(
        f"{agent}={name}" for agent, name in best.items()
    )
    assert len(asked) == len(set(asked))
    # Each of two passes tries at most every name of every agent.
    assert len(asked) <= 2 * (17 + 10 + 17)


def test_idle_stays_where_no_rule_is_better() -> None:
    assert best_rules("cost", lambda _: 0.0, AIR) == "load=idle,cooling=idle,battery=idle"


def test_rules_rank_by_the_value_of_a_kwh() -> None:
    asked: list[str] = []

    def figure(spec: str) -> float:
        asked.append(spec)
        return 0.0

    best_rules("cost+0.1*carbon+20*heat", figure, AIR)
    assert "load=rank-6h:0.1:0.1*carbon+cost,cooling=idle,battery=idle" in asked
    asked.clear()
    best_rules("heat", figure, AIR)
    assert len(asked) == 10


def test_liquid_cooled_racks_have_a_rule_too_and_setpoints_are_valid() -> None:
    asked: list[str] = []
    best = {"load": "idle", "cooling": "idle", "battery": "idle", "liquid": "liquid-reset"}
    fleet = build_fleet(load_config("ai_hall_2026"))
    assert best_rules("carbon", figures(best, asked), fleet).endswith("liquid=liquid-reset")
    assert any("cooling=constant:18," in spec for spec in asked)
    assert not any("constant:17" in spec for spec in asked)
