"""Optimum of fleets: the programme against every placement, its order, and its roll-out."""

from __future__ import annotations

import json
import warnings
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from sdc_taichi import ConfigError, Simulator, load_config, make_controller, with_values
from sdc_taichi.benchmark.cases import check_suite
from sdc_taichi.benchmark.suite import make_suite
from sdc_taichi.benchmark.suite_jobs import packed, run_row, solve_reference
from sdc_taichi.benchmark.suite_run import reference_jobs, row_jobs
from sdc_taichi.cli.app import app
from sdc_taichi.learning.evaluation import Contender, evaluate, prepare, validate
from sdc_taichi.optimum import fleet as fleet_optimum
from sdc_taichi.optimum.fleet import FleetOptimum, Hub, emissions_g, fleet_plan, solve_fleet
from sdc_taichi.optimum.problem import FlexibleWork
from sdc_taichi.optimum.programme import InfeasibleError
from sdc_taichi.optimum.stage_cost import LoadCurves
from sdc_taichi.run.loop import simulate
from sdc_taichi.types import F64


def figure(
    ci: F64, arrivals: F64, *, capacity: float, transfer: float, deadline: int, **more: Any
) -> float:
    """Least cost of unit tasks on sites (rows) and steps, of which each costs the intensity."""
    sites, steps = ci.shape
    arrivals = np.asarray(arrivals, dtype=np.float64)
    nothing = np.zeros(steps)
    width, kwh = np.full(steps, capacity), np.ones(steps)
    curves = [
        LoadCurves(nothing, nothing, nothing, np.arange(steps), width, row, kwh) for row in ci
    ]
    works = [FlexibleWork(row, row, row, width, np.inf, deadline, "fluid") for row in arrivals]
    values: dict[str, Any] = {
        "flexible_tasks": arrivals,
        "most_sent": np.full(sites, np.inf),
        "most_got": np.full(sites, np.inf),
        "groups": (tuple(range(sites)),),
        "delay_h": 0,
        "steps_per_hour": 1,
        "half_weight": np.full(ci.shape, transfer / 2),
        "power_limit_kwh": np.inf,
        "waiting_tasks": np.zeros(ci.shape),
    }
    move = more.pop("move", True)
    return fleet_plan(works, curves, Hub(**values | more), move=move).figure


def every_placement(
    ci: F64, arrivals: F64, *, capacity: float, transfer: float, deadline: int
) -> float:
    sites, steps = ci.shape
    tasks = [(s, t) for s in range(sites) for t in range(steps) for _ in range(int(arrivals[s][t]))]
    choices = [
        [(d, h) for d in range(sites) for h in range(t, min(t + deadline, steps - 1) + 1)]
        for _, t in tasks
    ]
    best = np.inf
    for places in product(*choices):
        load = np.zeros(ci.shape)
        cost = 0.0
        for (s, _), (d, h) in zip(tasks, places, strict=True):
            load[d, h] += 1
            cost += ci[d, h] + transfer * (d != s)
        if (load <= capacity).all():
            best = min(best, cost)
    return best


def test_least_cost_of_unit_tasks() -> None:
    ci = np.array([[496.0, 97, 148], [180, 149, 490]])
    arrivals = np.array([[2.0, 1, 0], [0, 0, 1]])
    case = {"capacity": 3, "transfer": 40, "deadline": 1}
    assert every_placement(ci, arrivals, **case) == 479.0
    assert figure(ci, arrivals, **case) == pytest.approx(479.0, rel=1e-9)
    tried = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        ci = rng.integers(50, 600, (2, 3)).astype(float)
        arrivals = rng.integers(0, 3, (2, 3)).astype(float)
        if arrivals.sum() > 5:
            continue
        case = {"capacity": 2, "transfer": 90, "deadline": int(rng.integers(1, 3))}
        least = every_placement(ci, arrivals, **case)
        if np.isfinite(least):
            assert figure(ci, arrivals, **case) == pytest.approx(least, rel=1e-9), seed
            tried += 1
    assert tried >= 8


def test_limits_of_the_hub() -> None:
    ci = np.array([[500.0, 400, 300, 500], [100, 200, 100, 300], [50, 50, 50, 50]])
    arrivals = np.array([[2.0, 2, 2, 1], [1, 1, 1, 1], [1, 1, 1, 1]])
    case: dict[str, Any] = {"capacity": 3, "transfer": 0, "deadline": 1}
    both = figure(ci, arrivals, **case)
    alone = figure(ci, arrivals, move=False, **case)
    linked = figure(ci, arrivals, most_sent=np.full(3, 0.5), **case)
    got = figure(ci, arrivals, most_got=np.full(3, 0.5), **case)
    grouped = figure(ci, arrivals, groups=((0, 1), (2,)), **case)
    late = figure(ci, arrivals, delay_h=1, **case)
    dear = figure(ci, arrivals, **case | {"transfer": 100})
    for limited in (linked, got, grouped, late, dear):
        assert both < limited < alone
    # Every task needs 1 kWh, so that 16 of them need 4 steps of 4 kWh.
    assert figure(ci, arrivals, power_limit_kwh=4.5, **case) > both
    with pytest.raises(InfeasibleError):
        figure(ci, arrivals, power_limit_kwh=3.0, **case)


def test_a_plan_is_reached_in_the_simulator() -> None:
    config = with_values(
        load_config("corrected", ["site.start=07-09", "workload.flexible_share=0.4"]),
        {"fleet": {"sites": ["AZ", "IL", "WA"], "link_share_per_hour": None}},
    )
    with Simulator(config) as sim:
        found = solve_fleet(sim, steps=96)
        assert found.table_error[0] < 1e-4
        assert found.bound_g[0] < found.achieved_g[0] < found.cooled_g[0] < found.idle_g[0]
        assert found.bound_g[0] < found.stay_g[0] < found.cooled_g[0]
        share = (found.idle_g - found.achieved_g) / (found.idle_g - found.bound_g)
        assert share[0] > 0.93
        assert found.bound_g[0] < 0.85 * found.idle_g[0]


def test_the_command_prints_bound_achieved_and_rules(tmp_path: Path) -> None:
    case = ["optimum", pair_of_sites(tmp_path), "--days", "1", "--quiet"]
    done = CliRunner().invoke(app, [*case, "--json", "--controller", "geo-central"])
    assert done.exit_code == 0, done.output
    content = json.loads(done.stdout)
    (idle,), (bound,), (achieved,) = (content[name] for name in ("idle", "bound", "achieved"))
    assert bound < achieved < content["controllers"]["geo-central"][0] < idle
    shown = CliRunner().invoke(app, [*case[:-1], "--controller", "geo-central"])
    assert shown.stdout.startswith("Optimum of carbon: 1 fleet of 2 sites, 1 day, transfers")
    assert "geo-central (% of the achievable)" in shown.stdout
    for option, message in (
        (["--objective", "cost"], "--objective cost: valid for fleets that share work is carbon"),
        (["--warm-up", "0.5"], "--warm-up: not for fleets that share work"),
        (["workload.placement=weights"], "optimum of a fleet: no bound, since placement weights"),
    ):
        wrong = CliRunner().invoke(app, [*case[:2], *option, *case[2:]])
        assert wrong.exit_code == 2, option
        assert message in wrong.stderr


def pair_of_sites(tmp_path: Path) -> str:
    file = tmp_path / "two.yaml"
    file.write_text("extends: tiny\nfleet: {sites: [AZ, WA]}\n")
    return str(file)


def test_a_fleet_is_evaluated_as_one_data_center(tmp_path: Path) -> None:
    config = load_config(pair_of_sites(tmp_path))
    with prepare([config], (3, 27), days=2, cache=tmp_path) as weeks:
        central = make_controller("geo=geo-central,load=drain", weeks.sim.fleet)
        rows = evaluate(weeks, [Contender("central", central)]).rows.set_index("controller")
        validation = validate(central, weeks)
        done = simulate(weeks.sim, central, weeks.steps, weeks.seed)
        grams = emissions_g(weeks.sim, done.sums["carbon_g"], done.sums["transfer_g"], weeks.steps)
        optimum = weeks.optimum
    assert isinstance(optimum, FleetOptimum)
    of_rule, idle = rows.loc["central"], rows.loc["idle"]
    assert of_rule["figure"].to_numpy() == pytest.approx(grams / 1e3)
    assert idle["figure"].to_numpy() == pytest.approx(optimum.idle)
    assert idle["share"].to_numpy() == pytest.approx(0.0, abs=1e-12)
    assert ((of_rule["share"] > 0.0) & (of_rule["share"] < 1.0)).all()
    assert (of_rule["broken"] == "").all()
    kwh = done.sums["grid_kwh"].reshape(2, 2)
    assert of_rule["grid_kwh"].to_numpy() == pytest.approx(kwh.sum(axis=1))
    highest = (optimum.idle - of_rule["figure"]).sum() / (optimum.idle - optimum.achieved).sum()
    assert validation.share == pytest.approx(highest)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fleet_optimum, "fleet_plan", lambda *_, **__: pytest.fail("solved anew"))
        with prepare([config], (27,), days=2, cache=tmp_path) as again:
            assert again.optimum is not None
            assert again.optimum.bound == optimum.bound[1]
    with pytest.raises(ConfigError, match="cost: valid for fleets that share work is carbon"):
        prepare([config], (3,), days=2, objective="cost")


def test_a_suite_of_fleets_has_a_row_for_each_week(tmp_path: Path) -> None:
    suite = make_suite(
        {
            "name": "pair",
            "title": "Two sites",
            "cases": {"pair": {"config": pair_of_sites(tmp_path), "weeks": [3], "days": 2}},
            "rows": {
                "geo-central": {"controller": "geo=geo-central,load=drain"},
                "optimum": {"optimum": "achieved"},
                "bound": {"optimum": "bound"},
            },
        }
    )
    check_suite(suite)
    (reference,) = reference_jobs(suite)
    solved = solve_reference(reference.values, {})
    assert solved.metrics["site"] == "tiny"
    inputs = {reference.name: packed(solved.files, solved.metrics)}
    figures = {}
    for job in row_jobs(suite, [reference]):
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # such as one that the optimum is solved anew
            rows = run_row(job.values, inputs).rows
        assert rows is not None
        assert rows[["site", "week"]].to_numpy().tolist() == [["tiny", 3]]
        figures[job.partition["row"]] = rows["valued_figure"].item()
    assert figures["bound"] < figures["optimum"] < figures["geo-central"]
