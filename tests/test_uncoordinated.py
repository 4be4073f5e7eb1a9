"""Plans without coordination: a game by hand, and the agents of a small data center."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sdc_taichi import DataCenterConfig, build_fleet, load_config
from sdc_taichi.optimum import Optimum, solve
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.paths import best_response, targets_of
from sdc_taichi.optimum.problem import AGENTS, Agent
from sdc_taichi.optimum.task import Task
from sdc_taichi.optimum.uncoordinated import WAYS, title_of, uncoordinated
from sdc_taichi.sim.bills import with_prices
from sdc_taichi.sim.drivers import load_drivers
from sdc_taichi.types import F64

PRICES = (1.0, 1.5)
"""Price of a job in each of two hours; an hour with both jobs costs 2 more."""
DAY = 96
CONFIG = ("site.location=CA", "site.start=07-01")
GRID = ("electrical.grid_limit_ratio=1.25",)


def figure(hours: Mapping[str, int]) -> float:
    is_shared = len(set(hours.values())) < len(hours)
    return sum(PRICES[hour] for hour in hours.values()) + 2.0 * is_shared


def best_hour(player: str, others: Mapping[str, int]) -> int:
    return min((0, 1), key=lambda hour: figure({**others, player: hour}))


def test_two_jobs_share_two_hours() -> None:
    """Both take the cheap hour, and, as both then flee from it, never part."""
    ways = uncoordinated(("a", "b"), best_hour, rounds=(1, 2, 10))
    assert ways == {
        "together": {"a": 0, "b": 0},
        "in_turn": {"a": 0, "b": 1},
        "round_1": {"a": 1, "b": 1},
        "round_2": {"a": 0, "b": 0},
        "round_10": {"a": 0, "b": 0},
    }
    figures = {name: figure(plans) for name, plans in ways.items()}
    joint = min(figure({"a": a, "b": b}) for a in (0, 1) for b in (0, 1))
    assert joint == figures["in_turn"] == 2.5
    assert (figures["together"], figures["round_1"]) == (4.0, 5.0)
    assert tuple(uncoordinated(("a", "b"), best_hour)) == WAYS
    assert title_of("round_1") == "best responses, 1 round"


def config(*changes: str) -> DataCenterConfig:
    return load_config("tiny", [*CONFIG, *GRID, *changes])


def solved(folder: Path, objective: str, days: int = 3, **options: Any) -> Optimum:
    options = {"scored_from": (days - 1) * DAY // 2, "cache": folder, **options}
    return solve(config(), steps=days * DAY, objective=objective, **options)


def test_a_bill_grows_with_each_step_away_from_planning_together(tmp_path: Path) -> None:
    bill = solved(tmp_path, "cost", uncoordinated=True)
    assert tuple(bill.uncoordinated) == WAYS
    figures = {way: float(of_way[0]) for way, of_way in bill.uncoordinated.items()}
    slack = 1e-4 * bill.idle[0]
    assert bill.achieved[0] <= figures["in_turn"] + slack
    assert figures["in_turn"] < figures["together"] + slack
    saved = bill.idle[0] - bill.achieved[0]
    # The battery and the load avoid the peak in the same hours, as each expects the other idle.
    assert figures["together"] - bill.achieved[0] > 0.05 * saved
    assert bill.failures == ((),)


def test_carbon_hardly_needs_coordination(tmp_path: Path) -> None:
    carbon = solved(tmp_path, "carbon", uncoordinated=True)
    saved = carbon.idle[0] - carbon.achieved[0]
    for way in ("in_turn", "round_10"):
        assert abs(carbon.uncoordinated[way][0] - carbon.achieved[0]) < 0.05 * saved


def test_plans_without_coordination_change_no_other_result_and_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = solved(tmp_path, "cost", 1)
    assert plain.uncoordinated == {}
    more = solved(tmp_path, "cost", 1, uncoordinated=True)
    assert tuple(more.uncoordinated) == WAYS
    for name in ("idle", "bound", "achieved", "load", "cooling", "battery"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(more, name))
    one = solved(tmp_path, "cost", 1, agents=("load",), uncoordinated=True)
    assert one.uncoordinated == {}
    monkeypatch.setattr("sdc_taichi.optimum.task.facility_tables", None)
    kept = solved(tmp_path, "cost", 1, uncoordinated=True)
    assert {way: x.tolist() for way, x in kept.uncoordinated.items()} == {
        way: x.tolist() for way, x in more.uncoordinated.items()
    }
    assert solved(tmp_path, "cost", 1).uncoordinated == {}


def test_agents_stay_idle_where_no_plan_does_all_work() -> None:
    crowded = config("workload.max_utilisation=0.3", "workload.queue_limit_h=0.5")
    found = solve(crowded, steps=24, agents=("load", "battery"), uncoordinated=True, cache=False)
    assert found.bound_kinds[0].startswith("none: ")
    assert found.uncoordinated["together"][0] <= found.idle[0]
    assert any("one after another ends with" in text for text in found.failures[0])


def test_the_load_plans_around_a_battery_that_it_knows() -> None:
    """With a demand charge, load plans avoid the hours in which the given battery plan charges."""
    configs = [config("tariff.demand_charge_per_kw=1000")]
    drivers = load_drivers(configs)
    task = Task(
        fleet=build_fleet(configs),
        drivers=with_prices(drivers, configs),
        start=drivers.start,
        seed=np.zeros(1, dtype=np.int64),
        steps=DAY,
        objective=Objective(cost=1.0),
        agents=AGENTS,
        scored_from=0,
        inlet_limit_c=None,
        precision="f32",
    )
    (problem,) = task.problems()
    storage, charging = problem.storage, slice(48, 56)
    bus_kwh = np.zeros(DAY)
    bus_kwh[charging] = 0.05 * storage.capacity_kwh
    stored_kwh = storage.stored_kwh + np.cumsum(storage.charge_efficiency * bus_kwh)

    def peak_kwh(others: Mapping[Agent, F64]) -> float:
        plan = best_response(problem, "load", others)
        bought_kwh = targets_of(problem, {"load": plan}).facility_kwh[:, 0] + bus_kwh
        return float(bought_kwh.max())

    assert peak_kwh({"battery": stored_kwh}) < 0.97 * peak_kwh({})
