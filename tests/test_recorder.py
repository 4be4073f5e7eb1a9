"""Recordings read back equal to the run, value by value."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest

from rrd import classes, images, read, scalars, texts, verify, voxels
from sdc_taichi import (
    Actions,
    DataCenterConfig,
    SdcError,
    Simulator,
    StepResult,
    build_fleet,
    load_config,
    make_configs,
)
from sdc_taichi.cli.view import moment_of
from sdc_taichi.control import View, make_controller
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.hall.zones import hall_zones
from sdc_taichi.plant.workload import age_histogram
from sdc_taichi.run.description import RunRequest, describe_run
from sdc_taichi.run.folder_writer import simulate_to_folder
from sdc_taichi.run.loop import simulate
from sdc_taichi.sim.design_hall import solve_design_hall
from sdc_taichi.sim.inlet_parts import Inlets
from sdc_taichi.types import F64, QUANTITIES, ServerLayers
from sdc_taichi.viz import (
    hall_rasters,
    plotting,
    recording_airflow,
    recording_blocks,
    recording_series,
    recording_states,
    recording_zones,
)
from sdc_taichi.viz.recorder import Recorder
from sdc_taichi.viz.recording_text import failure_entries, protection_entries
from simulated import go_on, small

STEPS = 130  # of blocks of 96 in this test: more than one, and no multiple
ODD_NAME = "hall/1 [a]"
HALL = (
    "hall.rows=2",
    "hall.racks_per_row=2",
    "hall.servers_per_rack=12",
    "hall.supply_approach_k=5.3",
    "hall.return_approach_k=-3",
    "hvac.crac.units=2",
    "servers.power_w=[150, 10]",
    "protection.ashrae_class=A1",
)
ZONES = 10
FAILURES = (
    "events.scheduled=["
    "{kind: crac_down, unit: 0, start_h: 3, duration_h: 2},"
    "{kind: crac_down, start_h: 6, duration_h: 2},"
    "{kind: rack_fan_failure, rack: 2, share: 0.2, start_h: 10, duration_h: 4},"
    "{kind: chiller_derate, share: 0.5, start_h: 20, duration_h: 5},"
    "{kind: heat_wave, offset_k: 6, start_h: 23, duration_h: 3},"
    "{kind: grid_outage, start_h: 28, duration_h: 1}]"
)


def configs() -> list[DataCenterConfig]:
    """Six halls: one with failures and protection, a name that needs escaping, another season."""
    base = load_config("corrected", HALL)
    out = make_configs(base, count=6, sites=["NY", "CA"])
    failing = load_config("corrected", [*HALL, FAILURES])
    out[0] = failing.model_copy(update={"name": "ny-0"})
    out[1] = out[1].model_copy(update={"name": ODD_NAME})
    summer = out[2].site.model_copy(update={"start": "07-01"})
    out[2] = out[2].model_copy(update={"site": summer})
    return out


class Wild:
    """Defers work for ten hours, so that it grows old; all else is without pattern."""

    def __init__(self) -> None:
        self.reset(0)

    def reset(self, seed: int) -> None:
        self._rng, self._steps = np.random.default_rng(seed), 0

    def act(self, view: View) -> Actions:
        load, cooling, battery = np.round(self._rng.uniform(-1.0, 1.0, (3, 6)), 1)
        self._steps += 1
        return Actions(load=-1.0 if self._steps < 40 else load, cooling=cooling, battery=battery)


@dataclass
class Run:
    """A run, its recording, and what it should hold."""

    sim: Simulator
    results: list[StepResult]
    servers: list[ServerLayers]
    queues: list[F64]
    rewards: list[F64]
    steps: pd.DataFrame
    path: Path
    recorded: dict[str, dict[str, list[Any]]]

    def column(self, name: str, dc: int) -> npt.NDArray[Any]:
        """A column of steps.parquet, with times as local standard time."""
        rows = self.steps[self.steps["dc"] == self.sim.fleet.names[dc]]
        return plotting.with_local_time(rows)[name].to_numpy()


FOCUS = {0: "ny-0", 1: r"hall\/1\ \[a\]", 2: "ny-2"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    out = tmp_path_factory.mktemp("run")
    path = out / "run.rrd"
    results: list[StepResult] = []
    servers: list[ServerLayers] = []
    queues: list[F64] = []
    rewards: list[F64] = []
    with Simulator(configs()) as sim:
        asked = RunRequest("wild", STEPS)
        with (
            pytest.MonkeyPatch.context() as patch,
            Recorder(path, focus=["ny-0", ODD_NAME, "ny-2"], every=2) as rec,
        ):
            patch.setattr(recording_blocks, "MAX_BLOCK_STEPS", 96)
            rec.begin(sim, describe_run(sim, asked))

            def each(result: StepResult) -> None:
                results.append(result)
                servers.append(sim.servers())
                queues.append(sim.state.queue.copy())
                rewards.append(-result.carbon_g / 7.0)
                rec.add(result, rewards={"carbon": rewards[-1], "water": -result.water_l})

            simulate_to_folder(sim, Wild(), asked, out / "files", on_step=each)
        steps = pd.read_parquet(out / "files" / "steps.parquet")
        yield Run(sim, results, servers, queues, rewards, steps, path, read(path))


def test_rerun_verifies_the_recording(run: Run) -> None:
    done = verify(run.path)
    assert done.returncode == 0, done.stderr
    assert "1 file verified without error" in done.stdout + done.stderr
    assert not [entity for entity in run.recorded if "liquid" in entity or "junction" in entity]


@pytest.mark.parametrize("dc", FOCUS)
def test_series_are_the_columns_of_the_run(run: Run, dc: int) -> None:
    compared = 0
    for entity, plot in recording_series.PLOTS.items():
        found = run.recorded[f"/dc/{FOCUS[dc]}/series/{entity}"]
        assert found["step"] == list(range(STEPS))
        assert [np.datetime64(t) for t in found["sim_time"]] == list(run.column("time", dc))
        assert found["SeriesLines:names"] == [[f"{n} [{plot.unit}]" for n, *_ in plot.lines]]
        for (name, field, _), values in zip(plot.lines, scalars(found).T, strict=True):
            if field == "pue":
                it_w, overhead_w = run.column("it_w", dc), run.column("overhead_w", dc)
                some = it_w > 0
                expected = np.where(some, 1.0 + overhead_w / np.where(some, it_w, 1.0), np.nan)
            else:
                factor = {"W": 1e-3, "kWh": 4.0, "g CO2e": 1e-3}.get(QUANTITIES[field].unit, 1.0)
                expected = run.column(field, dc) * factor
            np.testing.assert_allclose(values, expected, rtol=1e-15, err_msg=name)
            compared += 1
    assert compared > 30
    assert run.recorded[f"/dc/{FOCUS[2]}/series/pue"]["sim_time"][0].month == 7


def test_queue_by_age_adds_up(run: Run) -> None:
    edges = np.array(recording_series.AGE_EDGES_H) * 4
    for dc, name in FOCUS.items():
        found = scalars(run.recorded[f"/dc/{name}/series/queue_tasks"])
        expected = [age_histogram(queue, edges)[dc] for queue in run.queues]
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_allclose(found.sum(axis=1), run.column("queue_tasks", dc), atol=1e-9)
    assert np.count_nonzero(found[:, 1:]) > 0, "work of more than one age"


def test_units_rewards_and_fleet_are_recorded(run: Run) -> None:
    first = run.sim.fleet.unit_offsets[1]
    air = scalars(run.recorded[f"/dc/{FOCUS[1]}/crac/temperature_c"])
    np.testing.assert_array_equal(air[:, 0], [r.unit_supply_c[first] for r in run.results])
    np.testing.assert_array_equal(air[:, 1], [r.unit_supply_c[first + 1] for r in run.results])
    np.testing.assert_array_equal(air[:, 2], run.column("return_c", 1))
    flow = scalars(run.recorded[f"/dc/{FOCUS[1]}/crac/airflow_m3s"])
    np.testing.assert_array_equal(flow[:, 0], [r.unit_flow_m3s[first] for r in run.results])
    terms = run.recorded[f"/dc/{FOCUS[2]}/series/rewards"]
    assert terms["SeriesLines:names"] == [["carbon [-]", "water [-]"]]
    np.testing.assert_array_equal(scalars(terms)[:, 0], [r[2] for r in run.rewards])
    np.testing.assert_array_equal(scalars(terms)[:, 1], -run.column("water_l", 2))
    by_step = run.steps.groupby("step")
    expected = {
        "pue": 1.0 + by_step["overhead_w"].sum() / by_step["it_w"].sum(),
        "hottest_inlet_c": by_step["inlet_max_c"].max(),
        "it_kw": by_step["it_w"].sum() / 1e3,
        "carbon_kg": by_step["carbon_g"].sum() / 1e3,
        "water_l": by_step["water_l"].sum(),
        "queue_tasks": by_step["queue_tasks"].sum(),
        "lost_tasks": by_step["dropped_tasks"].sum() + by_step["lost_tasks"].sum(),
        "protected_racks": by_step["throttled_racks"].sum() + by_step["tripped_racks"].sum(),
    }
    assert set(expected) == set(recording_series.FLEET_PLOTS)
    for entity, values in expected.items():
        found = scalars(run.recorded[f"/fleet/{entity}"])[:, 0]
        np.testing.assert_allclose(found, values, rtol=1e-12, atol=1e-9, err_msg=entity)


@pytest.mark.parametrize("dc", FOCUS)
def test_actions_are_states_that_change(run: Run, dc: int) -> None:
    for entity, (command, states) in recording_series.COMMAND_STATES.items():
        found = run.recorded[f"/dc/{FOCUS[dc]}/actions/{entity}"]
        assert found["StateConfiguration:values"] == [list(states)]
        changes = dict(zip(found["step"], (s for (s,) in found["StateChange:state"]), strict=True))
        listed = list(changes.values())
        assert all(a != b for a, b in itertools.pairwise(listed)), "only changes"
        now = ""
        for step, value in enumerate(run.column(command, dc)):
            now = changes.get(step, now)
            assert now == states[int(np.sign(value)) + 1], (entity, step)


@pytest.mark.parametrize("dc", FOCUS)
def test_heat_maps_are_the_racks_to_their_resolution(run: Run, dc: int) -> None:
    fleet = run.sim.fleet
    hall, racks = fleet.configs[dc].hall, slice(*fleet.rack_offsets[dc : dc + 2])
    tiles = hall_rasters.tile_grid(hall)
    for what in recording_blocks.MAP_QUANTITIES:
        entity = run.recorded[f"/dc/{FOCUS[dc]}/map/{what}"]
        assert entity["step"] == list(range(0, STEPS, 2))
        values, _ = classes(entity)
        resolution = np.median(np.diff(values[1:]))
        shots = images(entity)
        for step, pixels in zip(entity["step"], shots, strict=True):
            result = run.results[step]
            racks_now = {
                "inlet": result.rack_inlet_max_c,
                "outlet": result.rack_outlet_c,
                "power": result.rack_power_w / 1e3,
                "rise": result.rack_inlet_max_c - result.supply_c[fleet.rack_dc],
            }[what][racks]
            for rack, value in enumerate(np.clip(racks_now, values[1], values[-1])):
                row, column = divmod(rack, hall.racks_per_row)
                y, x = row * (tiles.tile_height + 1), column * (tiles.tile_width + 1)
                tile = pixels[y : y + tiles.tile_height, x : x + tiles.tile_width]
                assert np.ptp(tile) == 0
                assert abs(tile[0, 0] - value) <= resolution / 2 + 1e-4
            assert np.all(np.isnan(pixels[tiles.tile_height]))
        assert np.ptp(shots[:, 0, 0]) > 0, "values change"


@pytest.mark.parametrize("dc", FOCUS)
def test_changes_are_from_the_step_before_an_event(run: Run, dc: int) -> None:
    racks = slice(*run.sim.fleet.rack_offsets[dc : dc + 2])
    entity = run.recorded[f"/dc/{FOCUS[dc]}/map/change"]
    assert entity["step"] == list(range(12, STEPS, 2)), "none before the first event"
    tiles = hall_rasters.tile_grid(run.sim.fleet.configs[dc].hall)
    shots = images(entity)[:, :: tiles.tile_height + 1, :: tiles.tile_width + 1]
    values, _ = classes(entity)
    befores = {12: 11, 24: 23, 40: 39, 80: 79, 92: 79, 112: 111}  # one event begins in another
    for step, pixels in zip(entity["step"], shots, strict=True):
        before = befores[max(begin for begin in befores if begin <= step)]
        now_c, before_c = (run.results[at].rack_inlet_max_c[racks] for at in (step, before))
        expected = np.clip(now_c - before_c, values[1], values[-1])
        np.testing.assert_allclose(pixels.reshape(-1), expected, atol=0.0501)


def test_changes_are_from_a_reference_run_at_the_same_time(tmp_path: Path) -> None:
    def simulated(start: str, *overrides: str) -> Simulator:
        return Simulator(load_config("tiny", [f"site.start={start}", *overrides]))

    before = tmp_path / "before"
    with simulated("03-01") as sim:
        driver = make_controller("coldest", sim.fleet)
        simulate_to_folder(sim, driver, RunRequest("coldest", 120), before)
    results = []
    path = tmp_path / "after.rrd"
    with simulated("03-02", "servers.power_w=[120, 12]") as sim:
        sim.reset()
        with Recorder(path, against=before) as rec:
            rec.begin(sim, describe_run(sim, RunRequest("idle", 40)))
            for _ in range(40):
                results.append(sim.step())
                rec.add(results[-1])
    with simulated("03-01") as sim:
        driver = make_controller("coldest", sim.fleet)
        reference: list[StepResult] = []
        simulate(sim, driver, 120, on_step=reference.append)
    (name,) = {entity.split("/")[2] for entity in read(path) if entity.startswith("/dc/")}
    entity = read(path)[f"/dc/{name}/map/change"]
    assert entity["step"] == list(range(24)), "while the reference lasts"
    tiles = hall_rasters.tile_grid(load_config("tiny").hall)
    shots = images(entity)[:, :: tiles.tile_height + 1, :: tiles.tile_width + 1]
    for step, pixels in enumerate(shots):
        expected = results[step].rack_inlet_max_c - reference[96 + step].rack_inlet_max_c
        np.testing.assert_allclose(pixels.reshape(-1), expected, atol=0.056)
    assert shots.min() > 1.0, "and differ"


@pytest.mark.parametrize(
    ("overrides", "match"),
    [
        (
            ["hall.rows=1", "hall.racks_per_row=4"],
            "2 rows of 2 .* valid is a run of halls of equal",
        ),
        (["site.start=05-01"], "8 steps from 01-01; valid is a run at the time of the recorded"),
        (["simulation.steps_per_hour=2"], "4 steps an hour; valid are 2"),
    ],
)
def test_references_that_do_not_fit_are_refused(
    tmp_path: Path, overrides: list[str], match: str
) -> None:
    before = tmp_path / "before"
    with Simulator(load_config("tiny")) as sim:
        simulate_to_folder(sim, make_controller("idle", sim.fleet), RunRequest("idle", 8), before)
    rec = Recorder(tmp_path / "x.rrd", against=before)
    with Simulator(load_config("tiny", overrides)) as sim:
        sim.reset()
        with pytest.raises(SdcError, match=match):
            rec.begin(sim)
    assert not (tmp_path / "x.rrd").exists()


@pytest.mark.parametrize("dc", FOCUS)
def test_maps_name_their_racks(run: Run, dc: int) -> None:
    hall = run.sim.fleet.configs[dc].hall
    entity = run.recorded[f"/dc/{FOCUS[dc]}/map/racks"]
    (context,) = entity["AnnotationContext:context"][0]
    names = {entry["class_id"]: entry["class_description"]["info"]["label"] for entry in context}
    (((form,),)) = entity["SegmentationImage:format"]
    (buffer,) = entity["SegmentationImage:buffer"][0]
    pixels = np.frombuffer(bytes(buffer), np.uint16).reshape(form["height"], form["width"])
    tiles = hall_rasters.tile_grid(hall)
    firsts = pixels[:: tiles.tile_height + 1, :: tiles.tile_width + 1].reshape(-1)
    shown = [names[number] for number in firsts.tolist()]
    assert shown == ["row 0, rack 0", "row 0, rack 1", "row 1, rack 2", "row 1, rack 3"]


@pytest.mark.parametrize("dc", FOCUS)
def test_maps_mark_the_hottest_rack(run: Run, dc: int) -> None:
    racks = slice(*run.sim.fleet.rack_offsets[dc : dc + 2])
    entity = run.recorded[f"/dc/{FOCUS[dc]}/map/hottest_text"]
    outlines = run.recorded[f"/dc/{FOCUS[dc]}/map/hottest"]
    assert set(range(0, STEPS, 2)) <= set(entity["step"]) == set(outlines["step"])
    for step, (label,) in zip(entity["step"], entity["Points2D:labels"], strict=True):
        inlet_c = run.results[step].rack_inlet_max_c[racks]
        rack = int(np.argmax(rank(inlet_c)))
        assert label == f"hottest: row {rack // 2}, rack {rack}, {inlet_c[rack]:.1f} C"


def test_maps_mark_units_that_are_down(run: Run) -> None:
    entity = run.recorded[f"/dc/{FOCUS[0]}/map/down"]
    marks = dict(zip(entity["step"], entity["Points2D:labels"], strict=True))
    assert marks == {12: ["CRAC 0 down"], 20: [], 24: ["CRAC 0 down", "CRAC 1 down"], 32: []}
    boxes = run.recorded[f"/dc/{FOCUS[0]}/hall/down"]
    assert dict(zip(boxes["step"], boxes["Boxes3D:labels"], strict=True)) == marks
    texts_of_units = run.recorded[f"/dc/{FOCUS[0]}/map/down_text"]
    shown = dict(zip(texts_of_units["step"], texts_of_units["Points2D:labels"], strict=True))
    assert shown == {12: ["CRAC 0 down"], 20: [], 24: ["CRAC 0, 1 down"], 32: []}
    assert f"/dc/{FOCUS[1]}/map/down" not in run.recorded or (
        "step" not in run.recorded[f"/dc/{FOCUS[1]}/map/down"]
    )


@pytest.mark.parametrize("dc", FOCUS)
def test_trends_are_those_of_the_hottest_racks(run: Run, dc: int) -> None:
    fleet = run.sim.fleet
    first = fleet.rack_offsets[dc]
    inlet_c = np.array([r.rack_inlet_max_c[first : first + 4] for r in run.results])
    peak_c = np.floor((inlet_c.max(axis=0) + 50.0) * 128 + 0.5)
    order = np.argsort(-peak_c, kind="stable")
    for entity, field, factor in (
        ("inlet_c", "rack_inlet_max_c", 1.0),
        ("outlet_c", "rack_outlet_c", 1.0),
        ("power_kw", "rack_power_w", 1e-3),
    ):
        trend = run.recorded[f"/dc/{FOCUS[dc]}/racks/{entity}"]
        assert trend["step"] == list(range(STEPS))
        values = np.array([getattr(r, field)[first + order] for r in run.results]) * factor
        np.testing.assert_allclose(scalars(trend), values, atol=0.004)
        (names,) = trend["SeriesLines:names"]
        assert [name.split(",")[1] for name in names] == [f" rack {rack}" for rack in order]


def test_hottest_row_is_drawn_by_time(run: Run) -> None:
    first = run.sim.fleet.rack_offsets[0]
    inlet_c = np.array([r.rack_inlet_max_c[first : first + 4] for r in run.results])
    step, rack = np.unravel_index(int(np.argmax(inlet_c)), inlet_c.shape)
    row = run.recorded[f"/dc/{FOCUS[0]}/row/inlet"]
    (pixels,) = images(row)
    values, _ = classes(row)
    down, across = pixels.shape[0] // 2, pixels.shape[1] // STEPS
    shown = pixels[down // 2 :: down, across // 2 :: across].T
    racks = slice(rack // 2 * 2, rack // 2 * 2 + 2)
    expected = np.clip(inlet_c[:, racks], values[1], values[-1])
    resolution = np.median(np.diff(values[1:]))
    np.testing.assert_allclose(shown, expected, atol=resolution / 2 + 0.005)
    ((_, mark),) = run.recorded[f"/dc/{FOCUS[0]}/row/hottest"]["Points2D:labels"]
    clock = str(run.column("time", 0)[step])
    assert mark.startswith(f"hottest: row {rack // 2}, rack {rack}, {inlet_c.max():.1f} C, ")
    assert mark.endswith(f"{clock[5:10]} {clock[11:16]}")


def test_viewers_begin_at_the_hottest_step_of_the_first_event(run: Run) -> None:
    hottest_c = np.array([[r.inlet_max_c[dc] for dc in FOCUS] for r in run.results])
    step = 12 + int(np.argmax(hottest_c[12:20].max(axis=1)))
    assert moment_of(run.path) == str(run.column("time", 0)[step])[:19]


@pytest.mark.parametrize("dc", FOCUS)
def test_hall_shows_the_hottest_server_of_every_height(run: Run, dc: int) -> None:
    fleet = run.sim.fleet
    hall = fleet.configs[dc].hall
    for what, layer in (("inlet", "inlet_c"), ("outlet", "outlet_c")):
        entity = run.recorded[f"/dc/{FOCUS[dc]}/hall/{what}"]
        of_class, colours = classes(run.recorded[f"/dc/{FOCUS[dc]}/map/{what}"])
        for step, cells in zip(entity["step"], voxels(entity), strict=True):
            values = getattr(run.servers[step], layer)
            expected = []
            for rack in range(*fleet.rack_offsets[dc : dc + 2]):
                first, last = fleet.server_offsets[fleet.group_offsets[rack : rack + 2]]
                height = np.arange(12) * ZONES // 12
                expected += [values[first:last][height == zone].max() for zone in range(ZONES)]
            nearest = np.abs(of_class[1:, None] - np.array(expected)).argmin(axis=0) + 1
            around = colours[np.clip(nearest + np.array([[-1], [0], [1]]), 1, len(colours) - 1)]
            assert np.all(np.any(cells == around, axis=0)), "within a rounding of the value"
        (indices,) = entity["VoxelGridMap:voxel_indices"]
        assert len({tuple(index) for index in indices}) == hall.racks * ZONES


def test_log_tells_begin_and_end_of_everything_with_its_place(run: Run) -> None:
    entity = run.recorded[f"/dc/{FOCUS[0]}/events"]
    log = list(zip(entity["step"], texts(entity), strict=True))
    told = {(step, text[12:]) for step, text in log}

    def steps_with(part: str) -> list[int]:
        return [step for step, text in log if part in text]

    assert (12, "CRAC unit 0 down, steps 12 to 19") in told
    assert (20, "over: CRAC unit 0 down") in told
    assert (24, "all CRAC units down, steps 24 to 31") in told
    where = "row 1, rack 2, airflow at 20%"
    assert (40, f"rack fans failed: {where}, steps 40 to 55") in told
    assert (56, f"over: rack fans failed: {where}") in told
    assert (80, "chiller: 50% left, steps 80 to 99") in told
    assert (92, "heat wave, +6 K, steps 92 to 103") in told
    assert (112, "grid outage, steps 112 to 115") in told
    for field, limit, begins, ends in (
        ("inlet_max_c", 27.0, "inlet above recommended 27 C", "within recommended 27 C"),
        ("inlet_max_c", 32.0, "inlet above allowable 32 C", "within allowable 32 C"),
        ("unmet_w", 100.0, "plant at its limit", "plant below its limit"),
        ("lost_tasks", 1e-6, "work lost:", "no work lost"),
        ("dropped_tasks", 1e-6, "work dropped:", "no work dropped"),
        ("overdue_tasks", 1e-6, "work overdue:", "no work overdue"),
    ):
        over = np.concatenate([[False], run.column(field, 0) > limit]).astype(int)
        edges = np.diff(over)
        assert steps_with(begins) == np.flatnonzero(edges > 0).tolist(), begins
        assert steps_with(ends) == np.flatnonzero(edges < 0).tolist(), ends
    assert steps_with("inlet above recommended")
    for step in steps_with("inlet above allowable"):
        rack = int(run.column("hottest_rack", 0)[step])
        server = int(run.column("hottest_server", 0)[step])
        row = rack // run.sim.fleet.configs[0].hall.racks_per_row
        hottest = run.column("inlet_max_c", 0)[step]
        place = f"{hottest:.1f} C at row {row}, rack {rack}, server {server} from the floor"
        assert (step, f"inlet above allowable 32 C: {place}") in told


def test_log_names_racks_that_protect_themselves(run: Run) -> None:
    fleet = run.sim.fleet
    changes = 0
    for dc, name in FOCUS.items():
        entity = run.recorded.get(f"/dc/{name}/events", {"step": [], "TextLog:text": []})
        log = {(step, text[12:]) for step, text in zip(entity["step"], texts(entity), strict=True)}
        before = np.zeros(4, dtype=np.int8)
        for step, result in enumerate(run.results):
            after = result.rack_status[slice(*fleet.rack_offsets[dc : dc + 2])]
            for rack in np.flatnonzero(after != before):
                inlet_c = result.rack_inlet_max_c[fleet.rack_offsets[dc] + rack]
                verb = ("back to normal", "throttled", "tripped")[after[rack]]
                place = f"row {rack // 2}, rack {rack}"
                assert (step, f"rack {verb}: {place}, inlet {inlet_c:.1f} C") in log
                changes += 1
            before = after
    assert changes > 2


def test_racks_beyond_the_named_ones_are_counted() -> None:
    before, after = np.zeros(40, np.int8), np.ones(40, np.int8)
    after[30:33] = 2
    found = list(protection_entries(7, 0, 10, before, after, np.full(40, 33.0)))
    assert len(found) == 9
    assert [e.text for e in found[:3]] == [
        f"rack tripped: row 3, rack {rack}, inlet 33.0 C" for rack in (30, 31, 32)
    ]
    assert found[-1].text == "and more racks: 32 throttled"
    assert not list(failure_entries(3, [], [], build_fleet(load_config("tiny"))))


def test_recording_explains_itself(run: Run) -> None:
    from rerun.chunk import RrdReader

    assert not [path for path in run.recorded if "ca-3" in path or "ny-4" in path]
    (((text,),)) = run.recorded["/summary"]["TextDocument:text"]
    about = describe_run(run.sim, RunRequest("wild", STEPS))
    for expected in (
        ODD_NAME, "site CA", "**synthetic**", "synthetic year, seed 10", "centrifugal_vsd", "wild",
        about["fingerprint"], f"taichi {about['versions']['taichi']}", "inlets jump at",
        run.sim.fleet.configs[0].description, "every 2 steps",
        "The 3 other data centers count in the fleet series only",
    ):  # fmt: skip
        assert expected in text
    for what, mark in (
        ("inlet", "40 C"),
        ("outlet", "40 C"),
        ("power", "1 kW"),
        ("rise", "0 K"),
        ("change", "0 K"),
    ):
        legend = run.recorded[f"/dc/{FOCUS[0]}/legend/{what}/ticks"]
        assert mark in legend["Points2D:labels"][0]
    (limits,) = run.recorded[f"/dc/{FOCUS[0]}/legend/inlet/limit_names"]["Points2D:labels"]
    assert limits[-2:] == ["27", "allowable to 32"]
    assert "limits of inlets: those of ASHRAE class A1" in text
    (blueprint,) = RrdReader(run.path).blueprints()
    chunks = RrdReader(run.path).stream(store=blueprint).to_chunks()
    shown = str([chunk.to_record_batch().to_pydict() for chunk in chunks])
    for expected in (
        "ny-0", ODD_NAME, "fleet", "sim_time", "HVAC by device [kW]", "reward terms",
        "StateTimeline", "TextLog", "3D",
    ):  # fmt: skip
        assert expected in shown


def test_larger_halls_are_recorded_more_coarsely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    large = load_config(
        "corrected",
        [
            "hall.rows=30", "hall.racks_per_row=10", "hall.servers_per_rack=40",
            "hall.inlet_model=approach", "hall.supply_approach_k=5", "hall.return_approach_k=-3",
            "servers.power_w=[400, 40]",
        ],
    )  # fmt: skip
    path = tmp_path / "large.rrd"
    monkeypatch.setattr(recording_blocks, "MAX_BLOCK_BYTES", 1_000_000)
    with Simulator(make_configs(large)) as sim, Recorder(path) as rec:
        sim.reset()
        rec.begin(sim)
        results = []
        for _ in range(100):
            results.append(sim.step())
            rec.add(results[-1])
    entities = read(path)
    assert entities["/dc/ny/series/pue"]["step"] == list(range(100))
    inlets = entities["/dc/ny/map/inlet"]
    assert inlets["step"] == list(range(0, 100, 4))
    tiles = hall_rasters.tile_grid(large.hall)
    pixels = images(inlets)[-1][:: tiles.tile_height + 1, :: tiles.tile_width + 1].reshape(-1)
    np.testing.assert_allclose(pixels, results[96].rack_inlet_max_c, atol=0.0501)
    assert entities["/dc/ny/hall/outlet"]["step"] == list(range(0, 100, 12))
    assert voxels(entities["/dc/ny/hall/outlet"]).shape == (9, 300 * 5)
    from rerun.chunk import RrdReader

    blocks = [
        chunk.num_rows
        for chunk in RrdReader(path).stream().to_chunks()
        if chunk.entity_path == "/dc/ny/series/pue" and not chunk.is_static
    ]
    assert len(blocks) > 1, "shorter blocks"


def test_hall_is_shown_more_often_in_events(tmp_path: Path) -> None:
    wave = "events.scheduled=[{kind: heat_wave, offset_k: 5, start_h: 4.5, duration_h: 3}]"
    path = tmp_path / "x.rrd"
    with Simulator(load_config("tiny", [wave])) as sim, Recorder(path) as rec:
        sim.reset()
        rec.begin(sim)
        for _ in range(48):
            rec.add(sim.step())
    (name,) = {entity.split("/")[2] for entity in read(path) if entity.startswith("/dc/")}
    assert read(path)[f"/dc/{name}/hall/inlet"]["step"] == [0, 12, 20, 24, 28, 36]


def test_voxels_stand_where_the_racks_do() -> None:
    hall = load_config("large").hall
    grid = hall_rasters.rack_voxels(hall, 5)
    from sdc_taichi.hall.floor_plan import floor_plan

    plan, measures = floor_plan(hall), hall.layout
    offset = np.array([measures.end_margin_m, 0.0])
    for cells, middle in ((grid.front, plan.front_m), (grid.back, plan.back_m)):
        centre = (cells + 0.5) * np.array(grid.size_m)
        per_rack = centre.reshape(hall.racks, 5, 3)
        np.testing.assert_allclose(
            per_rack[..., 2], np.tile((np.arange(5) + 0.5) * 0.42, (1000, 1))
        )
        # A quarter of a rack's depth lies between a face and the middle of its half, and another
        # is what aisles may be rounded by.
        apart = np.abs(per_rack[:, 0, :2] + offset - middle)
        assert np.all(apart <= [1e-9, measures.rack_depth_m / 2 + 1e-9])
    assert not {tuple(c) for c in grid.front} & {tuple(c) for c in grid.back}


def test_large_3d_halls_show_the_hottest_of_adjacent_racks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hall_rasters, "MAX_HALL_PARTS", 400)
    with Simulator(load_config("large")) as sim:
        sim.reset()
        cadence = recording_blocks.choose_cadence(sim.fleet, [0], None)
        builder = recording_blocks.BlockBuilder(sim, [0], cadence)
        result = sim.step()
        builder.add(result, None)
    rows = result.rack_inlet_max_c.reshape(50, 20)
    expected = np.stack([rows[:, i : i + 3].max(axis=1) for i in range(0, 20, 3)], axis=1)
    (inlets,) = builder.take().halls["inlet"]
    np.testing.assert_array_equal(inlets, expected.reshape(-1).astype(np.float32))
    grid = hall_rasters.rack_voxels(sim.fleet.configs[0].hall, 1)
    assert len({tuple(index) for index in grid.front}) == len(inlets) == 350
    assert grid.size_m[0] == pytest.approx(3 * 0.6)


def test_episodes_get_files_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    with small() as sim, Recorder(path, every=1) as rec:
        for steps in (0, 3, 5):
            sim.reset()
            rec.begin(sim)
            for _ in range(steps):
                rec.add(sim.step())
        assert rec.file == tmp_path / "run-2.rrd"
    assert {p.name for p in tmp_path.iterdir()} == {"run.rrd", "run-2.rrd"}
    assert len(read(path)["/dc/ny/series/pue"]["step"]) == 3
    assert len(read(tmp_path / "run-2.rrd")["/dc/ny/map/power"]["step"]) == 5


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_interrupted_recording_is_whole(tmp_path: Path, error: type[BaseException]) -> None:
    path, steps = tmp_path / "cut.rrd", recording_blocks.MAX_BLOCK_STEPS + 16
    path.write_text("older")

    def cut(sim: Simulator) -> None:
        with Recorder(path) as rec:
            sim.reset()
            rec.begin(sim)
            for step in range(steps):
                rec.add(sim.step())
                if step < recording_blocks.MAX_BLOCK_STEPS - 1:
                    assert path.read_text() == "older", "replaced with the first block"
            raise error

    with small() as sim, pytest.raises(error):
        cut(sim)
    assert [p.name for p in tmp_path.iterdir()] == ["cut.rrd"]
    assert verify(path).returncode == 0
    assert len(read(path)["/dc/ny/series/pue"]["step"]) == steps


@pytest.mark.parametrize("what", ["_by_quantity", "age_histogram"])
def test_recording_that_is_interrupted_amid_a_step_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr(recording_blocks, "_UNREDUCED_BYTES", 20_000)
    monkeypatch.setattr(recording_blocks, "MAX_BLOCK_STEPS", 96)
    path, rec = tmp_path / "x.rrd", Recorder(tmp_path / "x.rrd", every=1)
    with small(2) as sim:
        sim.reset()
        rec.begin(sim)
        for _ in range(3):
            rec.add(sim.step())
        with monkeypatch.context() as patch:
            patch.setattr(recording_blocks, what, Mock(side_effect=KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                go_on(sim, rec, 100)
        rec.close()
    entities = read(path)
    steps = entities["/dc/ny-0/series/pue"]["step"]
    assert len(steps) >= 3
    assert steps == list(range(len(steps)))
    shots = entities["/dc/ny-0/hall/inlet"]["step"]
    assert shots == list(range(len(shots)))
    assert verify(path).returncode == 0


def test_names_that_are_not_distinct_are_told_apart(tmp_path: Path) -> None:
    twins = make_configs(load_config("tiny")) * 3
    with Simulator(twins) as sim, Recorder(tmp_path / "x.rrd", focus=["ny#0", "ny#2"]) as rec:
        sim.reset()
        rec.begin(sim)
        rec.add(sim.step())
    maps = [path for path in read(tmp_path / "x.rrd") if path.endswith("map/inlet")]
    assert sorted(maps) == [r"/dc/ny\#0/map/inlet", r"/dc/ny\#2/map/inlet"]


def test_results_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with small() as sim, small(2) as other, Recorder(tmp_path / "a.rrd") as rec:
        sim.reset()
        with pytest.raises(SdcError, match="begin"):
            rec.add(sim.step())
        sim.reset()
        rec.begin(sim)
        first = sim.step()
        for values in (np.zeros(2), np.zeros((1, 1)), 0.0):
            with pytest.raises(SdcError, match=r"reward a has shape .*; valid is one value per"):
                rec.add(first, rewards={"a": values})  # type: ignore[dict-item]
        rec.add(first, rewards={"a": np.zeros(1)})
        with pytest.raises(SdcError, match="step 0 after step 0"):
            rec.add(first, rewards={"a": np.zeros(1)})
        with pytest.raises(SdcError, match="rewards none, expected a"):
            rec.add(sim.step())
        with pytest.raises(SdcError, match="the simulator has done 2 steps"):
            rec.add(first)
        with pytest.raises(SdcError, match="step 2 after step 0; an episode has all of its steps"):
            rec.add(sim.step(), rewards={"a": np.zeros(1)})
        other.reset()
        with pytest.raises(SdcError, match="2 data centers and 8 racks, expected 1 and 4"):
            rec.add(other.step())


@pytest.mark.parametrize(
    ("target", "arguments", "message"),
    [
        ("x.txt", {}, r"must end in \.rrd"),
        ("none/x.rrd", {}, "is no folder"),
        ("", {}, "must end"),
        (None, {}, "neither a file"),
        ("x.rrd", {"every": 0}, "every 0"),
        ("x.rrd", {"every": 2.0}, "every 2.0"),
        ("x.rrd", {"focus": ["ny-0", "ny"]}, "focus 'ny': no such data center; valid: ny-0"),
        ("x.rrd", {"focus": ["ny-0"] * 2}, "1 to 4 different"),
        ("x.rrd", {"focus": []}, "1 to 4 different"),
        ("x.rrd", {"focus": [1]}, "1 to 4 different"),
        ("x.rrd", {"focus": [f"ny-{i}" for i in range(5)]}, "1 to 4 different"),
        ("x.rrd", {"serve_port": 99999}, "port 99999"),
        ("rerun+http://127.0.0.1:9876/proxy", {"serve_port": 0}, "valid is one of them"),
        ("http://127.0.0.1:9876/proxy", {}, "no address of a viewer"),
        ("rerun+http://127.0.0.1:port/proxy", {}, "no address of a viewer"),
        ("rerun+http://127.0.0.1/proxy", {}, "no address of a viewer"),
    ],
)
def test_bad_arguments(
    tmp_path: Path, target: str | None, arguments: dict[str, Any], message: str
) -> None:
    address = target is None or "://" in target
    with small(3) as sim, pytest.raises(SdcError, match=message):
        Recorder(target if address else tmp_path / str(target), **arguments).begin(sim)
    assert not list(tmp_path.iterdir())


THREADS_OF_RECORDINGS = """
import os, sys
from pathlib import Path
import rerun as rr
from sdc_taichi import Simulator, load_config
from sdc_taichi.viz import recording_output
from sdc_taichi.viz.recorder import Recorder

recording_output.DELETE_EVERY = 1

def recording(name):
    sim = Simulator(load_config("tiny"))
    sim.reset()
    rec = Recorder(Path(sys.argv[1], f"{name}.rrd"))
    rec.begin(sim)
    rec.add(sim.step())
    rec.flush()
    return rec

def threads():
    return len(os.listdir("/proc/self/task"))

recording(0).close()
print(threads())
for i in range(1, 6):
    recording(i).close()
print(threads())
theirs = rr.RecordingStream("theirs")
for i in range(6, 11):
    recording(i).close()
print(threads())
del theirs
first, second = recording(11), recording(12)
first.close()
second.close()
print(threads())
rr.init("of the process")
recording(13).close()
print(rr.get_application_id() == "of the process")
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="no /proc that tells of threads")
def test_recordings_that_have_ended_leave_no_threads(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", THREADS_OF_RECORDINGS, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    *threads, global_stays = done.stdout.split()
    after_one, after_six, after_others, in_the_end = map(int, threads)
    # Threads that have ended may be listed for a moment.
    assert max(after_six, in_the_end) < after_one + 4
    # What others record is neither written out nor waited for.
    assert after_others > after_one + 12
    assert global_stays == "True"
    assert len(list(tmp_path.iterdir())) == 14


def test_missing_rerun_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SdcError, match="pip install rerun-sdk"):
        Recorder(tmp_path / "x.rrd")
    assert not list(tmp_path.iterdir())


def test_states_of_racks_are_recorded_when_they_change(run: Run) -> None:
    entity = run.recorded[f"/dc/{FOCUS[0]}/state/racks"]
    names = [info["class_description"]["info"]["label"] for info in entity[CONTEXT][0][0]]
    assert names == ["normal", "throttled", "tripped", "fans failed"]
    (((form,),)) = entity["SegmentationImage:format"]
    assert (form["height"], form["width"]) == (2, 2)
    frames = dict(zip(entity["step"], entity["SegmentationImage:buffer"], strict=True))
    now, states = b"", set()
    for step, result in enumerate(run.results):
        (now,) = map(bytes, frames.get(step, [now]))
        expected = result.rack_status[:4].tolist()
        if 40 <= step < 56 and expected[2] != 2:
            expected[2] = recording_states.FANS_FAILED
        assert list(now) == expected, step
        states.update(expected)
    assert states >= {0, 2, 3}
    assert len(frames) < len(run.results) / 2


CONTEXT = "AnnotationContext:context"


@pytest.fixture(scope="module")
def failing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Simulator, Any]]:
    """A day of a hall of 12 x 18 racks, in which one of six CRAC units is down for three hours."""
    down = "events.scheduled=[{kind: crac_down, unit: 2, start_h: 14, duration_h: 3}]"
    path = tmp_path_factory.mktemp("failing") / "run.rrd"
    with Simulator(load_config("hall_of_2026", [down])) as sim:
        sim.reset()
        with Recorder(path) as rec:
            rec.begin(sim)
            for _ in range(60):
                rec.add(sim.step())
        yield sim, read(path)


def test_share_map_names_the_unit_that_feeds_each_rack(failing: tuple[Simulator, Any]) -> None:
    sim, recorded = failing
    entity = recorded["/dc/hall_of_2026/airflow/shares/units"]
    infos = [info["class_description"]["info"] for info in entity[CONTEXT][0][0]]
    frames = dict(zip(entity["step"], entity["SegmentationImage:buffer"], strict=True))
    assert 56 in frames, "a frame when the unit fails"
    seen = {step: np.frombuffer(bytes(frame), np.uint16) for step, (frame,) in frames.items()}
    before, after = (seen[max(s for s in seen if s <= step)] for step in (55, 59))
    inlets = Inlets(sim.fleet, 0, sim.intake_air())
    for rack in (0, 17, 98, 215):
        share = inlets.parts(rack).unit_share
        low = int(share.max() * 4) * 25
        assert f"CRAC {share.argmax()} gives" in infos[after[rack]]["label"]
        assert f"{low} to {low + 25} %" in infos[after[rack]]["label"].replace("up to", "0 to")
    fed = {step: np.mean((pixels - 1) // 4 == 2) for step, pixels in seen.items()}
    assert np.mean((after - 1) // 4 == 2) < 0.5 * np.mean((before - 1) // 4 == 2)
    assert fed[0] > 0.1
    colours = {infos[1 + 4 * unit + 3]["color"] for unit in range(6)}
    assert len(colours) == 6


def test_close_ups_show_where_exhaust_comes_from(failing: tuple[Simulator, Any]) -> None:
    sim, recorded = failing
    path = "/dc/hall_of_2026/airflow/close_ups"
    titles, arrows = recorded[f"{path}/titles"], recorded[f"{path}/arrows"]
    steps = titles["step"]
    assert steps == arrows["step"]
    assert {0, 56} <= set(steps), "at the beginning, and when the unit fails"
    shown = [
        {rack: float(c) for rack, c in re.findall(r"rack (\d+): (\S+) C", "\n".join(names))}
        for names in titles["Points2D:labels"]
    ]
    for step, before, after in zip(steps[1:], shown, shown[1:], strict=False):
        changes_k = [abs(c - before[rack]) for rack, c in after.items() if rack in before]
        has_changed = after.keys() != before.keys() or max(changes_k) > 0.9  # rounded to 0.1 C
        assert has_changed or step == 56, "no frame shows the same as that before"
    inlets = Inlets(sim.fleet, 0, sim.intake_air())
    hall = sim.fleet.configs[0].hall
    close_ups = recording_airflow.CloseUps(hall)
    for number, rack in enumerate(inlets.hottest(5)):
        parts = inlets.parts(rack)
        found = close_ups.arrows(number, parts)
        sources = [*parts.sources(), (rack, parts.own_exhaust_k)]
        np.testing.assert_allclose(found.warming_k, [k for _, k in sources])
        image = close_ups.image([0] * number + [rack], np.arange(hall.racks, dtype=np.float32))
        for (x, y), (source, _) in zip(found.start, sources, strict=True):
            assert image[int(y), int(x)] == source, "an arrow begins at its source"
        (x, _), ends = close_ups.title_place(number), found.end[:, 0]
        assert np.all(np.abs(ends - x) < 0.5), "arrows end at the hot rack"
    for radii, labels in zip(arrows["Arrows2D:radii"], arrows["Arrows2D:labels"], strict=True):
        warming_k = np.array([float(label.split()[0]) for label in labels])
        relative = warming_k / warming_k.max()
        # Labels are rounded to 0.01 K.
        np.testing.assert_allclose(radii / np.max(radii), relative, atol=0.02 / warming_k.max())
        assert np.ptp(relative) > 0.2
    (text,) = recorded["/dc/hall_of_2026/airflow/sources"]["TextDocument:text"][0]
    assert text.count("\n") == 6
    assert "| row " in text


def test_arrows_from_racks_beyond_a_close_up_begin_at_its_edge() -> None:
    inlets = solve_design_hall(load_config("large")).inlets
    parts = inlets.parts(500)
    far = np.zeros(1000)
    far[[0, 999]] = 2.0, 1.0
    close_ups = recording_airflow.CloseUps(load_config("large").hall)
    found = close_ups.arrows(0, replace(parts, exhaust_k=far))
    assert found.warming_k.tolist() == [2.0, 1.0]
    height, width = close_ups.image_shape
    assert np.all(found.start >= -1.0)
    assert np.all(found.start <= [width, height + 1.0])


def test_racks_of_changed_zones_are_recorded_within_a_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = [
        "hall.rows=42", "hall.racks_per_row=50", "hvac.crac.units=8",
        "events.scheduled=[{kind: crac_down, unit: 3, start_h: 3, duration_h: 3}]",
    ]  # fmt: skip
    monkeypatch.setattr(recording_zones, "MOST_RACKS_PER_STEP", 400)
    path = tmp_path / "zones.rrd"
    with Simulator(load_config("large", values)) as sim, Recorder(path) as rec:
        sim.reset()
        rec.begin(sim)
        results = []
        for _ in range(20):
            results.append(sim.step())
            rec.add(results[-1])
    recorded = read(path)
    hall, zones = sim.fleet.configs[0].hall, hall_zones(sim.fleet.configs[0].hall)
    assert zones.count > 10
    plain = recorded["/dc/large/zones/map"]
    assert plain["step"] == list(range(20))
    shown_c = images(plain)
    for step, result in enumerate(results):
        for zone, (x, y) in enumerate(recording_zones.zone_pixels(zones)):
            racks = zones.racks(zone)
            inside, edge = shown_c[step, int(y), int(x)], shown_c[step, int(y - 2.9), int(x)]
            assert abs(inside - result.rack_inlet_c[racks].mean()) < 0.051
            assert abs(edge - result.rack_inlet_max_c[racks].max()) < 0.051
    labels = [label for (label,) in recorded["/dc/large/zones/hottest_text"]["Points2D:labels"]]
    for label, result in zip(labels, results, strict=True):
        rack = int(result.rack_inlet_max_c.argmax())
        zone = int(zones.of_racks(np.array([rack]))[0])
        place = f"zone {zone}, row {rack // hall.racks_per_row}, rack {rack}"
        assert label.startswith(f"hottest: {place}, ")
    recorded_racks = np.zeros(20, np.int64)
    for zone in range(zones.count):
        entity = recorded[f"/dc/large/zone_racks/{zone}"]
        entity[CONTEXT] = recorded["/dc/large/zone_racks"][CONTEXT]
        racks = zones.racks(zone)
        for step, pixels in zip(entity["step"], images(entity), strict=True):
            recorded_racks[step] += len(racks)
            found = pixels.reshape(-1)
            np.testing.assert_allclose(found, results[step].rack_inlet_max_c[racks], atol=0.051)
    assert recorded_racks[0] == hall.racks
    assert 0 < recorded_racks[1:].max() <= 400
    assert recorded_racks[12] > 0, "the unit that fails warms its zones"
