"""Known optima: bound, achieved figure and certificates, and the files that keep them."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sdc_taichi import ConfigError, DataCenterConfig, Simulator, load_config
from sdc_taichi.control import make_controller
from sdc_taichi.optimum import Objective, Optimum, StoppedError, solve
from sdc_taichi.optimum.cache import Cache, OptimumCacheWarning
from sdc_taichi.optimum.problem import AGENTS, Agent, Ends, Problem
from sdc_taichi.optimum.rollout import Targets
from sdc_taichi.optimum.tables import FacilityTable, facility_tables
from sdc_taichi.run.achievable import AchievedPath, achievement, begin_score
from sdc_taichi.run.loop import simulate
from sdc_taichi.sim import snapshot

DAY = 96


def config_of(site: str = "CA", *changes: str, preset: str = "tiny") -> DataCenterConfig:
    named = [f"name={site}", f"site.location={site}", "site.start=07-01"]
    return load_config(preset, [*named, *changes])


def solved(configs: Any, steps: int = DAY, **arguments: Any) -> Optimum:
    return solve(configs, steps=steps, **{"cache": False, **arguments})


@pytest.fixture(scope="module")
def joint() -> Optimum:
    return solved([config_of("CA"), config_of("NY")])


def test_what_is_achieved_lies_between_bound_and_idle(joint: Optimum) -> None:
    assert np.all(joint.bound <= joint.achieved)
    assert np.all(joint.achieved < joint.idle)
    assert np.all(joint.gap_points < 1.0)
    for agent in AGENTS:
        assert np.all(joint.achieved <= joint.alone[agent])
        assert np.all(joint.alone[agent] <= joint.idle)
    assert joint.failures == ((), ())


def test_the_commands_are_what_the_figure_is_of(joint: Optimum) -> None:
    with Simulator([config_of("CA"), config_of("NY")]) as sim:
        score = begin_score(joint, sim, 0)
        simulate(sim, AchievedPath(joint), joint.steps, on_step=score.add)
        np.testing.assert_array_equal(score.figure, joint.achieved)
        assert np.all(score.dropped_tasks == 0.0)
        assert np.all(score.end_kwh >= score.start_kwh - 1e-9)
        assert np.all(score.end_tasks <= 1e-6)
        reached = achievement(joint, "optimum", score)
    np.testing.assert_allclose(reached.share, 1.0, atol=1e-6)


def test_no_controller_is_better_once_its_ends_are_valued(joint: Optimum) -> None:
    with Simulator([config_of("CA"), config_of("NY")]) as sim:
        for name in ("idle", "greedy-ci", "lookahead-24h", "random"):
            score = begin_score(joint, sim, 0)
            simulate(sim, make_controller(name, sim.fleet), joint.steps, on_step=score.add)
            reached = achievement(joint, name, score)
            assert np.all(joint.bound <= reached.valued_figure * (1.0 + 1e-9)), name
            if name == "idle":
                np.testing.assert_allclose(reached.share, 0.0, atol=1e-9)


def test_a_batch_equals_each_data_center_alone(joint: Optimum) -> None:
    alone = solved(config_of("NY"))
    for name in ("idle", "bound", "achieved"):
        assert getattr(alone, name)[0] == getattr(joint, name)[1]
    for name in ("load", "cooling", "battery"):
        np.testing.assert_array_equal(getattr(alone, name)[:, 0], getattr(joint, name)[:, 1])


@pytest.mark.parametrize("agents", [("load",), ("cooling",), ("battery",), ("load", "battery")])
def test_fewer_agents_achieve_no_more(joint: Optimum, agents: tuple[Any, ...]) -> None:
    found = solved(config_of("CA"), agents=agents)
    assert found.agents == agents
    assert set(found.alone) == set(agents)
    assert found.bound[0] <= found.achieved[0] <= found.idle[0]
    assert found.bound[0] >= joint.bound[0] * (1.0 - 1e-6)
    moved = {"load": found.load, "cooling": found.cooling, "battery": found.battery}
    for agent in set(AGENTS) - set(agents):
        assert not moved[agent].any(), agent


@pytest.mark.parametrize("objective", ["energy", "cost", "water", "carbon+0.002*water"])
def test_objectives_are_all_bounded(objective: str) -> None:
    found = solved(config_of("CA"), objective=objective)
    assert found.objective == Objective.parse(objective)
    assert found.bound[0] <= found.achieved[0] <= found.idle[0]
    assert found.failures == ((),)


def test_a_warm_up_leaves_the_state_of_the_first_scored_step_free() -> None:
    found = solved(config_of("CA"), steps=2 * DAY, scored_from=DAY)
    of = found.certificates[0]
    assert of["end_kwh"] >= of["start_kwh"] - 1e-6
    assert of["end_tasks"] <= of["start_tasks"] + 1e-6
    assert found.bound[0] <= found.achieved[0] < found.idle[0]
    with Simulator(config_of("CA")) as sim:
        score = begin_score(found, sim, 0)
        simulate(sim, AchievedPath(found), found.steps, on_step=score.add)
    assert score.figure[0] == found.achieved[0]


def test_batteries_that_end_with_too_little_are_planned_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = config_of("CA", "battery.initial_soc=0.5")
    right = solved(config, steps=24)
    module = sys.modules["sdc_taichi.optimum.solve"]
    path_of = module.path_of

    def short(problem: Problem, agents: tuple[Agent, ...], *check: Any) -> Targets:
        path: Targets = path_of(problem, agents, *check)
        path.stored_kwh[-1] -= 0.001 * problem.storage.capacity_kwh
        return path

    monkeypatch.setattr(module, "path_of", short)
    found = solved(config, steps=24)
    assert found.failures == ((),)
    assert found.achieved[0] == pytest.approx(right.achieved[0], rel=1e-3)
    assert found.alone["battery"][0] == pytest.approx(right.alone["battery"][0], rel=1e-3)
    monkeypatch.setattr(module._Work, "_plan_short_ends_again", lambda *_: None)
    (texts,) = solved(config, steps=24).failures
    assert any("path of battery ends with" in text for text in texts)


def test_inlets_stay_within_a_limit() -> None:
    free = solved(config_of("CA"))
    hottest_c = free.certificates[0]["hottest_inlet_c"]
    limit_c = hottest_c - 1.0
    found = solved(config_of("CA"), inlet_limit_c=limit_c)
    assert found.certificates[0]["hottest_inlet_c"] <= limit_c + 1e-3
    assert found.achieved[0] >= free.achieved[0]
    assert found.bound[0] >= free.bound[0] * (1.0 - 1e-9)
    np.testing.assert_array_equal(found.inlet_limit_c, [limit_c])


def test_queues_of_whole_tasks_are_empty_at_the_end() -> None:
    found = solved(config_of("CA", "workload.model=tasks"), steps=2 * DAY, agents=("load",))
    assert found.failures == ((),)
    assert found.bound[0] <= found.achieved[0] < 0.99 * found.idle[0]


def test_a_path_that_is_as_cool_as_can_be_counts_where_no_setpoint_keeps_the_limit() -> None:
    config = config_of("NY", preset="corrected")
    found = solved(config, steps=6, agents=("cooling",), inlet_limit_c=20.0)
    limit, *texts = found.failures[0]
    measured = found.certificates[0]
    over_k = float(solved(config, steps=6, agents=("battery",)).certificates[0]["hottest_inlet_c"])
    assert any(f"path of idle commands has inlets up to {over_k - 20.0:.3g} K" in x for x in texts)
    assert not any("path of cooling" in text for text in texts)
    assert 20.0 < measured["hottest_inlet_c"] <= measured["reachable_limit_c"] + 1e-3
    least_c = float(re.findall(r"least reachable limit is ([\d.]+) C", limit)[0])
    assert 0.0 <= least_c - measured["reachable_limit_c"] < 0.1
    with Simulator(config) as sim:
        score = begin_score(found, sim, 0)
        simulate(sim, AchievedPath(found), found.steps, on_step=score.add)
        assert achievement(found, "optimum", score).broken == ((),)
        score = begin_score(found, sim, 0)
        simulate(sim, make_controller("idle", sim.fleet), found.steps, on_step=score.add)
        ((text,),) = achievement(found, "idle", score).broken
        assert text.endswith(f"over {measured['hottest_inlet_c']:.2f} C")
    reachable = solved(config, steps=6, agents=("cooling",), inlet_limit_c=least_c)
    assert not any("least reachable" in text for text in reachable.failures[0])
    assert reachable.certificates[0]["hottest_inlet_c"] <= least_c + 1e-3


# These presets have models that preset tiny of the other tests lacks.
@pytest.mark.parametrize("preset", ["paper", "sustaindc", "hall_of_2026", "ai_hall_2026"])
def test_presets_have_optima(preset: str) -> None:
    found = solved(config_of("CA", preset=preset), steps=24)
    assert found.achieved[0] <= found.idle[0]
    assert not found.bound[0] > found.achieved[0]
    assert not any(found.failures)


def test_loads_by_zone_have_no_optimum() -> None:
    with pytest.raises(ConfigError, match="zone_loads: plans need the work of a trace"):
        solved(config_of("CA", preset="hall_agents_6"), steps=24)


def test_idle_setpoints_follow_their_schedule() -> None:
    hours = ",".join(str(17 + hour % 3) for hour in range(24))
    config = config_of("CA", f"hvac.setpoint.schedule_c=[{hours}]")
    found = solved(config, steps=24, agents=("load",))
    with Simulator(config) as sim:
        score = begin_score(found, sim, 0)
        simulate(sim, make_controller("idle", sim.fleet), found.steps, on_step=score.add)
    np.testing.assert_allclose(found.idle, score.figure, rtol=1e-6)


def test_halls_without_a_table_have_no_bound_and_say_so() -> None:
    found = solved(config_of("CA", "simulation.thermal=transient", preset="corrected"), steps=8)
    assert found.bound_kinds[0].startswith("none: ")
    assert np.isnan(found.bound[0])
    assert found.achieved[0] <= found.idle[0]
    assert np.isnan(found.bound_of_ends(0, None))  # type: ignore[arg-type]


def test_a_battery_that_the_grid_makes_move_leaves_no_bound_to_other_agents() -> None:
    changes = "battery.initial_soc=1", "electrical.grid_limit_ratio=0.55"
    config = config_of("CA", *changes)
    agents: tuple[Any, ...]
    for agents, kind in ((("load",), "none: the facility may need"), (("battery",), "bound")):
        assert solved(config, steps=4, agents=agents).bound_kinds[0].startswith(kind)
    assert solved(config_of("CA", changes[0]), steps=4, agents=("load",)).bound_kinds == ("bound",)


def test_tables_that_are_off_make_the_bound_an_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    right = facility_tables

    def off(*arguments: Any, **named: Any) -> list[FacilityTable]:
        return [
            dataclasses.replace(table, facility_kwh=1.01 * table.facility_kwh)
            for table in right(*arguments, **named)
        ]

    monkeypatch.setattr("sdc_taichi.optimum.task.facility_tables", off)
    found = solved(config_of("CA"), steps=24)
    assert found.bound_kinds[0].startswith("estimate: ")
    assert found.certificates[0]["table_error"] == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("weight", [0.1234567890123, 1e-7, 2.0, 1e20, 1 / 3])
def test_the_text_of_an_objective_says_its_weights_exactly(weight: float) -> None:
    objective = Objective(carbon=weight, water=1.0)
    assert Objective.parse(str(objective)) == objective


@pytest.mark.parametrize("weight", [1e-90, 1e-12, 1e20, 1e90])
def test_the_size_of_weights_does_not_matter(weight: float) -> None:
    """The tolerances of the solver are absolute."""
    one, scaled = (
        solved(config_of("CA"), steps=24, objective=Objective(energy=size, water=size))
        for size in (1.0, weight)
    )
    for name in ("idle", "bound", "achieved"):
        np.testing.assert_allclose(getattr(scaled, name) / weight, getattr(one, name), rtol=1e-6)


def test_terms_of_very_different_weights_are_solved() -> None:
    water = solved(config_of("CA"), steps=24, objective=Objective(water=1e90))
    both = solved(config_of("CA"), steps=24, objective=Objective(carbon=1.0, water=1e90))
    np.testing.assert_allclose(both.bound, water.bound, rtol=1e-6)


@pytest.mark.parametrize("weight", ["1e300", "1e-300", "1e400"])
def test_weights_that_overflow_are_refused(weight: str) -> None:
    valid = r"valid is 0, or 1e-100 to 1e\+100|is no number"
    with pytest.raises(ConfigError, match=rf"^objective.* weight .*({valid})$"):
        Objective.parse(f"carbon+{weight}*water")


def test_what_is_kept_is_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = solved(config_of("CA"), steps=24, cache="kept")
    assert len(list((tmp_path / "kept").iterdir())) == 1

    def fails(*_: Any, **__: Any) -> Any:
        raise AssertionError("solved again")

    monkeypatch.setattr("sdc_taichi.optimum.task.facility_tables", fails)
    again = solved(config_of("CA"), steps=24, cache="kept")
    for name in ("idle", "bound", "achieved", "load", "cooling", "battery"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert first.certificates == again.certificates
    assert first.alone.keys() == again.alone.keys()
    with pytest.raises(AssertionError, match="solved again"):
        solved(config_of("CA"), steps=25, cache="kept")
    with pytest.raises(AssertionError, match="solved again"):
        solved(config_of("CA"), steps=24, cache="kept", objective="energy")
    with pytest.raises(AssertionError, match="solved again"):
        solved(config_of("NY"), steps=24, cache="kept")


def test_bounds_of_ends_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ends = Ends(2.0, 0.0, 1.0, 5.0)
    first = solved(config_of("CA"), steps=24, cache=tmp_path).bound_of_ends(0, ends)
    (kept,) = tmp_path.glob("*-ends.npz")

    def fails(*_: Any, **__: Any) -> Any:
        raise AssertionError("solved again")

    monkeypatch.setattr("sdc_taichi.optimum.result.bound", fails)
    again = solved(config_of("CA"), steps=24, cache=tmp_path).bound_of_ends
    assert again(0, ends) == first
    with pytest.raises(AssertionError, match="solved again"):
        again(0, Ends(2.0, 0.0, 1.0, 6.0))
    kept.write_bytes(kept.read_bytes()[:100])
    with (
        pytest.warns(OptimumCacheWarning, match="bounds of ends are solved anew"),
        pytest.raises(AssertionError, match="solved again"),
    ):
        solved(config_of("CA"), steps=24, cache=tmp_path).bound_of_ends(0, ends)


def test_files_that_are_damaged_or_swapped_are_solved_anew(tmp_path: Path) -> None:
    configs = [config_of("CA"), config_of("NY")]
    first = solved(configs, steps=24, cache=tmp_path)
    one, other = sorted(tmp_path.iterdir())
    one_bytes, other_bytes = one.read_bytes(), other.read_bytes()
    one.write_bytes(other_bytes)
    other.write_bytes(one_bytes)
    with pytest.warns(OptimumCacheWarning, match="other configs"):
        swapped = solved(configs, steps=24, cache=tmp_path)
    np.testing.assert_array_equal(swapped.achieved, first.achieved)
    one.write_bytes(one_bytes[: len(one_bytes) // 2])
    with pytest.warns(OptimumCacheWarning, match=r"solved anew"):
        damaged = solved(configs, steps=24, cache=tmp_path)
    np.testing.assert_array_equal(damaged.achieved, first.achieved)
    assert solved(configs, steps=24, cache=tmp_path).names == ("CA", "NY")


def edited_text(arrays: dict[str, Any], **values: Any) -> dict[str, Any]:
    return {"text": np.array(json.dumps(json.loads(str(arrays["text"])) | values))}


def certified(arrays: dict[str, Any], **values: Any) -> dict[str, Any]:
    text = json.loads(str(arrays["text"]))
    return edited_text(arrays, certificate=text["certificate"] | values)


FORGERIES: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "achieved below 0": lambda _: {"achieved": np.array(-1e9)},
    "achieved better than the bound": lambda x: {
        "achieved": 0.9 * x["bound"],
        **certified(x, figure=float(0.9 * x["bound"])),
    },
    "an estimate better than the bound": lambda x: {
        "achieved": 0.5 * x["bound"],
        **edited_text(x, kind="estimate: rough"),
    },
    "achieved of another certificate": lambda x: {"achieved": 1.01 * x["achieved"]},
    "achieved nan": lambda _: {"achieved": np.array(np.nan)},
    "achieved text": lambda _: {"achieved": np.array("1")},
    "achieved list": lambda x: {"achieved": np.full(3, x["achieved"])},
    "achieved whole": lambda _: {"achieved": np.array(3)},
    "idle infinite": lambda _: {"idle": np.array(np.inf)},
    "no bound": lambda _: {"bound": np.array(np.nan)},
    "load nan": lambda x: {"load": x["load"] * np.nan},
    "load of 2": lambda x: {"load": x["load"] + 2.0},
    "battery of texts": lambda x: {"battery": np.array(["x"] * len(x["battery"]))},
    "other shape": lambda x: {"cooling": x["cooling"][None]},
    "text of a number": lambda _: {"text": np.array(3.0)},
    "text of a list": lambda _: {"text": np.array("[1]")},
    "deep text": lambda _: {"text": np.array("[" * 100_000)},
    "alone null": lambda x: edited_text(x, alone=None),
    "alone empty": lambda x: edited_text(x, alone={}),
    "alone text": lambda x: edited_text(x, alone=dict.fromkeys(AGENTS, "x")),
    "kind number": lambda x: edited_text(x, kind=1),
    "kind other": lambda x: edited_text(x, kind="proof"),
    "failures null": lambda x: edited_text(x, failures=None),
    "failures numbers": lambda x: edited_text(x, failures=[1]),
    "certificate empty": lambda x: edited_text(x, certificate={}),
    "certificate list": lambda x: edited_text(x, certificate=[1.0]),
    "limit of inlets null": lambda x: certified(x, inlet_limit_c=None),
    "end nan": lambda x: certified(x, end_kwh=float("nan")),
    "more": lambda x: edited_text(x, more=1),
}


@pytest.fixture(scope="module")
def cached(tmp_path_factory: pytest.TempPathFactory) -> tuple[Optimum, Path]:
    """An optimum, and the folder that keeps it."""
    folder = tmp_path_factory.mktemp("kept")
    return solved(config_of("CA"), steps=24, cache=folder), folder


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_optimum_is_not_read(
    cached: tuple[Optimum, Path], tmp_path: Path, name: str
) -> None:
    first, folder = cached
    (kept,) = folder.iterdir()
    assert Cache(folder).find(kept.stem, first.steps, first.agents) is not None
    arrays = snapshot.read(kept)
    snapshot.write(tmp_path / kept.name, arrays | FORGERIES[name](arrays))
    with pytest.warns(OptimumCacheWarning, match=r"npz: .*; the optimum is solved anew") as told:
        assert Cache(tmp_path).find(kept.stem, first.steps, first.agents) is None
    assert "\n" not in str(told[0].message)


def test_a_forged_optimum_is_solved_anew(cached: tuple[Optimum, Path], tmp_path: Path) -> None:
    first, folder = cached
    (kept,) = folder.iterdir()
    forged, arrays = tmp_path / kept.name, snapshot.read(kept)
    snapshot.write(forged, arrays | FORGERIES["achieved better than the bound"](arrays))
    with pytest.warns(OptimumCacheWarning, match="the optimum is solved anew"):
        again = solved(config_of("CA"), steps=24, cache=tmp_path)
    assert again.achieved.tolist() == first.achieved.tolist()
    assert again.bound.tolist() == first.bound.tolist()
    assert forged.read_bytes() == kept.read_bytes()


@pytest.mark.parametrize(
    "edit",
    [
        {"figures": np.array([-1e9])},
        {"figures": np.array([np.nan])},
        {"figures": np.array("x")},
        {"figures": np.array(1.0)},
        {"ends": np.array([[1.0, 2.0]])},
        {"ends": np.array([["a", "b", "c", "d"]])},
        {"ends": np.array(1.0)},
    ],
)
def test_forged_bounds_of_ends_are_solved_anew(tmp_path: Path, edit: dict[str, Any]) -> None:
    ends = Ends(2.0, 0.0, 1.0, 5.0)
    first = solved(config_of("CA"), steps=24, cache=tmp_path).bound_of_ends(0, ends)
    (kept,) = tmp_path.glob("*-ends.npz")
    snapshot.write(kept, snapshot.read(kept) | edit)
    with pytest.warns(OptimumCacheWarning, match="bounds of ends are solved anew"):
        again = solved(config_of("CA"), steps=24, cache=tmp_path).bound_of_ends(0, ends)
    assert again == first


def test_a_folder_that_cannot_be_written_keeps_nothing(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.warns(OptimumCacheWarning, match="not kept"):
        found = solved(config_of("CA"), steps=24, cache=blocked / "folder")
    assert found.achieved[0] <= found.idle[0]


def test_progress_is_told_and_work_can_be_stopped() -> None:
    told: list[tuple[str, int, int]] = []
    solved(config_of("CA"), steps=24, progress=lambda *each: told.append(each))
    stages = [stage for stage, _ in itertools.groupby(stage for stage, _, _ in told)]
    assert stages[:3] == ["tables", "programmes", "runs"]
    assert all(done <= total for _, done, total in told)
    assert {done == total for stage, done, total in told if stage == "runs"} == {False, True}
    for stage in ("tables", "programmes", "runs"):
        told.clear()

        def stop(stage: str = stage) -> bool:
            return any(name == stage for name, _, _ in told)

        with pytest.raises(StoppedError, match="0 of 1 data centers are kept"):
            solved(config_of("CA"), steps=24, progress=lambda *each: told.append(each), stop=stop)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"steps": 0}, "steps 0"),
        ({"scored_from": DAY}, "scored_from 96"),
        ({"agents": ()}, "agents"),
        ({"agents": ("load", "load")}, "agents"),
        ({"agents": ("fan",)}, "fan"),
        ({"objective": "coal"}, "coal"),
        ({"inlet_limit_c": 1000.0}, "inlet_limit_c"),
        ({"start": [1, 2]}, "start"),
        ({"precision": "f16"}, "precision"),
    ],
)
def test_arguments_that_mean_nothing_are_refused(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        solved(config_of("CA"), **arguments)
