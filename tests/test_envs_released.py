"""Observation vectors and rewards of the released SustainDC, against recorded and by-hand numbers.

Folders come from SDC_REFERENCE_DIR, as in ``test_reference``. A folder may hold
``trajectories/*_features.npz``, each with the ``.json`` of its run beside it: inputs at quarter
hours from a midnight on (``temperature_c``, ``ci_g_per_kwh``, ``workload``), ``first_step``, the
index of the first step in them, ``actions`` and the vectors ``obs_ls``, ``obs_dc``, ``obs_bat``,
row 0 from reset. Inputs reach 30 days beyond the first step or to the end of the year.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sdc_taichi import (
    Actions,
    DataCenterConfig,
    Drivers,
    Simulator,
    build_fleet,
    drivers_from_arrays,
    load_config,
)
from sdc_taichi.control.view import View, view_maker
from sdc_taichi.envs import released
from sdc_taichi.envs.released import FEATURES, ReleasedObserver, ReleasedRewards
from sdc_taichi.errors import DataError
from sdc_taichi.sim.drivers import FleetSeries
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.types import F64, I64, StepResult
from test_reference import BATTERY, COOLING, FOLDERS, LOAD, TRAJECTORIES, rack_config

RECORDED = [
    (f"{folder.name}-{path.stem}", path)
    for folder in FOLDERS
    for path in sorted(folder.glob("trajectories/*_features.npz"))
]
VECTORS = {"agent_ls": "obs_ls", "agent_dc": "obs_dc", "agent_bat": "obs_bat"}
YEAR = 35040
DAY = 96


def some_actions(rng: np.random.Generator, size: int) -> Actions:
    return chosen(rng.integers(0, 3, (3, size)))


def chosen(picks: I64) -> Actions:
    """Actions of the agents by their released numbers, (3, B)."""
    load, cooling, battery = picks
    return Actions(
        [LOAD[i] for i in load], [COOLING[i] for i in cooling], [BATTERY[i] for i in battery]
    )


def inputs(seed: int, steps: int = YEAR) -> dict[str, F64]:
    """A day's course and noise."""
    rng = np.random.default_rng(seed)
    wave = np.sin(2 * np.pi * np.arange(steps) / DAY + rng.uniform(0, 6))
    outdoor = 15 + 8 * wave + np.cumsum(rng.normal(0, 0.05, steps))
    return {
        "outdoor_c": np.clip(outdoor, 0, 45),
        "ci_g_per_kwh": 300 + 80 * wave + rng.normal(0, 3, steps),
        "demand": np.clip(0.5 + 0.3 * wave + rng.normal(0, 0.02, steps), 0, 1),
    }


def drivers(*series: dict[str, F64], start: list[int]) -> Drivers:
    """Inputs of data centers with series of their own, which may differ in length."""
    lengths = np.array([len(one["demand"]) for one in series])
    offsets = np.concatenate([[0], np.cumsum(lengths)[:-1]])

    def table(name: str) -> FleetSeries:
        return FleetSeries(np.concatenate([one[name] for one in series]), offsets, lengths)

    return replace(
        drivers_from_arrays(1.0, 1.0, 1.0, 1.0, size=len(series)),
        outdoor_c=table("outdoor_c"),
        wet_bulb_c=table("outdoor_c"),
        ci_g_per_kwh=table("ci_g_per_kwh"),
        demand=table("demand"),
        start=np.array(start),
    )


def run(
    sim: Simulator, actions: list[Actions]
) -> tuple[dict[str, F64], dict[str, F64], list[StepResult], list[View]]:
    """Vectors (steps + 1, B, n), rewards (steps, B), results and views of the steps."""
    observer, rewards = ReleasedObserver(), ReleasedRewards()
    sim.reset()
    look = view_maker(sim)
    view = look(None)
    observer.reset(view)
    rewards.reset(view)
    seen, got, results, views = [observer.observe(view)], [], [], []
    for action in actions:
        results.append(sim.step(action))
        views.append(look(results[-1]))
        seen.append(observer.observe(views[-1]))
        got.append(rewards.rewards(results[-1], views[-1]))
    return (
        {agent: np.array([row[agent] for row in seen]) for agent in FEATURES},
        {agent: np.array([row[agent] for row in got]) for agent in FEATURES},
        results,
        views,
    )


# --- the recorded vectors -----------------------------------------------------------------------


def replay(path: Path, precision: Precision) -> dict[str, F64]:
    """The vectors of preset ``sustaindc`` with the recorded inputs and actions."""
    about = json.loads(
        path.with_name(path.name.replace("_features.npz", ".json")).read_text("utf-8")
    )
    config = load_config("sustaindc", [f"site.location={about['config']['location'].upper()}"])
    with np.load(path) as recorded:
        series = {
            "outdoor_c": recorded["temperature_c"],
            "ci_g_per_kwh": recorded["ci_g_per_kwh"],
            "demand": recorded["workload"],
        }
        first = int(recorded["first_step"])
        actions = [chosen(step[:, None]) for step in recorded["actions"]]
    with Simulator(config, drivers=drivers(series, start=[first]), precision=precision) as sim:
        vectors, _, _, _ = run(sim, actions)
    return {agent: rows[:, 0] for agent, rows in vectors.items()}


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize(("name", "path"), RECORDED, ids=[name for name, _ in RECORDED])
def test_vectors_are_the_recorded_ones(name: str, path: Path, precision: Precision) -> None:
    found = replay(path, precision)
    problems = []
    with np.load(path) as recorded:
        for agent, key in VECTORS.items():
            assert found[agent].shape == recorded[key].shape
            # z-scores reach 1e6 where the window is flat: f32 has 7 digits of those.
            limit = np.maximum(1e-5, 2e-7 * np.abs(recorded[key]))
            wrong = ~(np.abs(found[agent] - recorded[key]) <= limit)
            problems += [
                f"{agent} {feature.name}: {wrong[:, i].sum()} rows, first {row}: "
                f"{found[agent][row, i]!r} for {recorded[key][row, i]!r}"
                for i, feature in enumerate(FEATURES[agent])
                if len(rows := np.flatnonzero(wrong[:, i]))
                for row in rows[:1]
            ]
    assert not problems, f"{name} ({precision}):\n" + "\n".join(problems)


# --- entries ------------------------------------------------------------------------------------


def naive_window(now: float, following: F64) -> list[float]:
    """Five entries by NumPy's own functions."""
    gradient = np.gradient(np.concatenate([[now], following]))
    count = len(following)
    peaks = [i for i in range(count) if gradient[i] > 0 >= gradient[i + 1]]
    valleys = [i for i in range(count) if gradient[i] < 0 <= gradient[i + 1]]
    std = float(np.std(following))
    return [
        float(np.mean(following)),
        std,
        (now - float(np.mean(following))) / (std + 1e-8),
        (peaks[0] if peaks else count) / count,
        (valleys[0] if valleys else count) / count,
    ]


def smoothed_slope(values: F64) -> float:
    means = np.convolve(values, np.full(4, 0.25), "valid")
    return float(np.polyfit(np.arange(len(means)), means, 1)[0])


# Whole numbers: ties and plateaus are common, and sums of few are exact.
SERIES = arrays(np.float64, st.integers(60, 120), elements=st.integers(-40, 40).map(float))


@given(series=SERIES, start=st.integers(0, 200), step=st.integers(0, 50))
def test_entries_of_any_series(series: F64, start: int, step: int) -> None:
    """Against entries by NumPy's own functions, one row at a time; series repeat."""
    count = len(series)
    outdoor, ci = series, series[::-1] + 50.0
    config = load_config("tiny")
    d = drivers(
        {"outdoor_c": outdoor, "ci_g_per_kwh": ci, "demand": np.linspace(0, 1, count)},
        start=[start],
    )
    view = bare_view(config, d, step)
    observer = ReleasedObserver()
    observer.reset(replace(view, state=replace(view.state, step=0)))
    found = observer.observe(view)["agent_ls"][0]

    index = (start + step) % count

    def scaled(values: F64) -> F64:
        window = values[start % count :][: 30 * DAY]
        span = window.max() - window.min()
        return (values - window.min()) / span if span else np.zeros(count)

    def part(values: F64, first: int, length: int) -> F64:
        return np.array([values[(index + first + k) % count] for k in range(length)])

    c, t = scaled(ci), scaled(outdoor)
    hour = round((start + step) % DAY / DAY, 3)
    past = smoothed_slope(part(c, -16, 17)) if index >= 16 else 0.0
    expected = [
        0.5 + 0.5 * np.cos(2 * np.pi * hour),
        0.5 + 0.5 * np.sin(2 * np.pi * hour),
        c[index],
        smoothed_slope(part(c, 0, 9)),
        past,
        *naive_window(c[index], part(c, 1, 8)),
        *(0.0, 0.0, 0.0),
        index / (count - 1),
        t[index],
        float(np.polyfit(np.arange(17), part(t, 0, 17), 1)[0]),
        *naive_window(t[index], part(t, 1, 16)),
        *(0.0,) * 5,
    ]
    low, high = observer.spaces["agent_ls"].low, observer.spaces["agent_ls"].high
    expected_cut = np.clip(expected, low, high)
    # A flat window makes z-scores as great as 1e8, of which differences of sums take digits.
    tolerance = 2e-6 + 1e-6 * np.abs(expected_cut)
    assert np.all(np.abs(found - expected_cut) <= tolerance), np.stack([found, expected_cut])


_VIEWS: dict[str, View] = {}


def bare_view(config: DataCenterConfig, d: Drivers, step: int) -> View:
    """A view of a data center at rest ``step`` steps on, without stepping there."""
    if "tiny" not in _VIEWS:
        sim = Simulator(config, drivers=d)
        sim.reset()
        _VIEWS["tiny"] = view_maker(sim)(None)
    view = _VIEWS["tiny"]
    return replace(view, drivers=d, state=replace(view.state, step=step))


def test_queue_entries_by_hand() -> None:
    """10 tasks of 25 h, 20 of 13 h and 70 fresh ones, in a queue for 1,000."""
    d = drivers(inputs(0), start=[0])
    view = bare_view(load_config("tiny"), d, 3)
    queue = np.zeros((1, 110))
    last = queue.shape[1] - 1
    for age_h, tasks in ((25, 10.0), (13, 20.0), (0, 70.0)):
        queue[0, last - 4 * age_h :] += tasks
    observer = ReleasedObserver()
    observer.reset(view)
    view = replace(
        view, state=replace(view.state, queue=queue, stored_kwh=view.sizing.battery_kwh / 4)
    )
    seen = observer.observe(view)
    names = [f.name for f in FEATURES["agent_ls"]]
    found = dict(zip(names, seen["agent_ls"][0].tolist(), strict=True))
    limit_h = view.fleet.values("workload.queue_limit_h")[0]
    assert found["queue"] == pytest.approx(100 / (limit_h * 400))
    bins = [found[name] for name in names[-5:]]
    assert bins == pytest.approx([0.7, 0.0, 0.2, 0.0, 1.0])
    assert seen["agent_bat"][0, -1] == pytest.approx(0.25)


def test_input_without_range_reads_zero() -> None:
    flat = {"outdoor_c": np.full(YEAR, 20.1), "ci_g_per_kwh": np.full(YEAR, 300.1)}
    d = drivers({**inputs(0), **flat}, start=[17])
    observer = ReleasedObserver()
    view = bare_view(load_config("tiny"), d, 5)
    observer.reset(view)
    seen = observer.observe(view)
    for agent, features in FEATURES.items():
        for i, feature in enumerate(features):
            scaled = feature.unit.startswith("scaled") or feature.name.endswith("z_score")
            assert not scaled or seen[agent][0, i] == 0.0, feature.name


@pytest.mark.parametrize("preset", ["sustaindc", "corrected"])
def test_vectors_lie_in_their_spaces(preset: str) -> None:
    rng = np.random.default_rng(1)
    d = drivers(inputs(3), start=[YEAR - 2 * DAY])
    actions = [some_actions(rng, 1) for _ in range(3 * DAY)]
    with Simulator(load_config(preset), drivers=d) as sim:
        vectors, rewards, _, _ = run(sim, actions)
    for agent, space in ReleasedObserver().spaces.items():
        assert vectors[agent].dtype == np.float32
        assert all(space.contains(row[0]) for row in vectors[agent])
        assert np.all(np.isfinite(rewards[agent]))
    assert np.ptp(vectors["agent_ls"][:, 0, 12]) > 0.01


# --- batches ------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["sustaindc", "tiny"])
def test_batch_equals_alone(preset: str) -> None:
    """Bit by bit, with inputs, lengths, starts and halls that differ."""
    base = load_config(preset)
    bigger = load_config(preset, ["battery.capacity_kwh=900", "hvac.setpoint.initial_c=17"])
    configs = [
        config.model_copy(update={"name": f"dc{i}"})
        for i, config in enumerate((base, bigger, base))
    ]
    series = [inputs(0), inputs(1, 40 * DAY), inputs(2, 33 * DAY)]
    starts = [YEAR - 3, 5 * DAY + 7, 92]
    rng = np.random.default_rng(5)
    picks = rng.integers(0, 3, (60, 3, 3))
    with Simulator(build_fleet(configs), drivers=drivers(*series, start=starts)) as sim:
        vectors, rewards, _, _ = run(sim, [chosen(step) for step in picks])
    for i, config in enumerate(configs):
        alone = [chosen(step[:, [i]]) for step in picks]
        with Simulator(config, drivers=drivers(series[i], start=[starts[i]])) as sim:
            one, one_rewards, _, _ = run(sim, alone)
        for agent in FEATURES:
            assert np.array_equal(vectors[agent][:, i], one[agent][:, 0])
            assert np.array_equal(rewards[agent][:, i], one_rewards[agent][:, 0])


# --- rewards ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("quarter_hour", "dropped", "queue", "expected"),
    [
        (91, 0.0, 500.0, 0.0),
        (91, 3.0, 500.0, -30.0),
        # (92/96 - 0.95833) / (0.98935 - 0.95833) = 0.000107, next 0.335912, 0.671717, 1.007522
        (92, 0.0, 100.0, -0.0010745755),
        (93, 0.0, 100.0, -3.3591231),
        (94, 0.0, 100.0, -6.7171717),
        (95, 0.0, 40.0, -4.0300881),
        (95, 2.0, 40.0, -24.0300881),
        (0, 0.0, 40.0, 0.0),
    ],
)
def test_load_penalty_by_hand(
    quarter_hour: int, dropped: float, queue: float, expected: float
) -> None:
    found = released.load_penalty(
        np.array([dropped]), np.array([queue]), np.array([quarter_hour / 96])
    )
    assert found.tolist() == pytest.approx([expected], rel=1e-6)


@pytest.mark.parametrize(("name", "path"), TRAJECTORIES, ids=[name for name, _ in TRAJECTORIES])
def test_load_bounds_of_recorded_runs(name: str, path: Path) -> None:
    about = json.loads(path.with_suffix(".json").read_text("utf-8"))
    config = rack_config(about["racks"], about["config"]["location"])
    with Simulator(config, drivers=drivers(inputs(0), start=[0]), precision="f64") as sim:
        sim.reset()
        low, high = released.power_bounds_kw(sim.fleet, sim.sizing, "f64")
    assert low.tolist() == pytest.approx([about["sizing"]["power_lb_kw"]], rel=1e-9), name
    assert high.tolist() == pytest.approx([about["sizing"]["power_ub_kw"]], rel=1e-9), name


def test_rewards_of_a_run() -> None:
    """Step by step from the results, with the day's end inside."""
    series = inputs(7)
    ci = series["ci_g_per_kwh"]
    start = 4 * DAY + 80
    rng = np.random.default_rng(2)
    actions = [replace(some_actions(rng, 1), load=LOAD[0]) for _ in range(40)]
    with Simulator(load_config("sustaindc"), drivers=drivers(series, start=[start])) as sim:
        _, rewards, results, _ = run(sim, actions)
        bounds = released.power_bounds_kw(sim.fleet, sim.sizing, sim.precision)
        low, high = (float(v[0]) for v in bounds)
    queued_at_night = 0
    for k, result in enumerate(results):
        norm_ci = (ci[start + k] - ci.min()) / (ci.max() - ci.min())
        share = (float(result.grid_kwh[0]) - low / 4) / (high / 4 - low / 4)
        footprint = -norm_ci * share
        power_kw = float(result.facility_kwh[0]) * 4
        step_of_day = (start + k) % DAY
        penalty = -10.0 * float(result.dropped_tasks[0])
        if step_of_day >= 92:
            queued_at_night += 1
            factor = (step_of_day / 96 - 0.95833) / (0.98935 - 0.95833)
            penalty -= factor * float(result.queue_tasks[0]) / 10
        assert rewards["agent_bat"][k, 0] == pytest.approx(footprint, rel=1e-9)
        assert rewards["agent_dc"][k, 0] == pytest.approx(
            -(power_kw - low) / (high - low), rel=1e-9
        )
        assert rewards["agent_ls"][k, 0] == pytest.approx(footprint + penalty, rel=1e-9)
    assert queued_at_night == 4
    assert min(float(r.queue_tasks[0]) for r in results[12:16]) > 10


def test_rewards_need_a_carbon_intensity_that_varies() -> None:
    series = [inputs(0), {**inputs(1), "ci_g_per_kwh": np.full(YEAR, 310.0)}]
    tiny = load_config("tiny")
    fleet = build_fleet([tiny, tiny.model_copy(update={"name": "other"})])
    with Simulator(fleet, drivers=drivers(*series, start=[0, 0])) as sim:
        sim.reset()
        view = view_maker(sim)(None)
        with pytest.raises(DataError, match="of data center 1 is 310 g/kWh throughout"):
            ReleasedRewards().reset(view)
