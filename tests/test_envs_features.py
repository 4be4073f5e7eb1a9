"""Observations: every feature against a computation of its own, forecasts, heat map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box

from sdc_taichi import (
    Actions,
    ConfigError,
    DataCenterConfig,
    Drivers,
    SdcError,
    Simulator,
    drivers_from_arrays,
    load_config,
)
from sdc_taichi.control import PERFECT, ForecastError, View, view_maker
from sdc_taichi.control.view import RandomWalks
from sdc_taichi.envs import time_rows
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, AGENTS
from sdc_taichi.envs.features import (
    CI_LEADS_H,
    WEATHER_LEADS_H,
    Feature,
    all_features,
)
from sdc_taichi.envs.images import HEAT_MAP_CHANNELS, heat_map, heat_map_space
from sdc_taichi.envs.observer import Observer
from sdc_taichi.envs.options import make_options
from sdc_taichi.envs.time_rows import Forecasts
from sdc_taichi.sim.drivers import FleetSeries

SITES = ("ny", "ca", "az")
STARTS = ("01-01", "07-01", "12-31")
STEPS = 150
Seen = list[tuple[View, dict[str, np.ndarray], np.ndarray, np.ndarray]]


def fleet_of(preset: str, **changes: Any) -> list[DataCenterConfig]:
    """Three sites that start on different days and differ in queue, deadline and battery."""
    unlimited = ["workload.queue_limit_h=null", "workload.deadline_h=null"]
    overrides: tuple[list[str], ...] = ([], unlimited, ["battery.capacity_kwh=0"])
    made = []
    for site, start, extra in zip(SITES, STARTS, overrides, strict=True):
        listed = [f"site.location={site.upper()}", f"site.start={start}", f"name={site}"]
        listed += [*extra, *(f"{k}={v}" for k, v in changes.items())]
        made.append(load_config(preset, listed))
    return made


def keys(count: int, seed: int = 0) -> np.ndarray:
    return 1000 * seed + np.arange(count)


def commands(step: int, size: int, first: int = 0) -> Actions:
    """Deferring for a day, draining in between, everything moving; ``first`` is the number of the
    first data center."""
    load = -1.0 if step % 110 < 100 else 1.0
    phase = first + np.arange(size) + step
    return Actions(
        load=np.full(size, load),
        cooling=np.where(phase % 3 == 0, 1.0, np.where(phase % 3 == 1, -1.0, 0.0)),
        battery=np.where(phase // 8 % 2 == 0, 1.0, -1.0),
    )


def watch(
    configs: list[DataCenterConfig],
    steps: int = STEPS,
    drivers: Drivers | None = None,
    first: int = 0,
    error: ForecastError = PERFECT,
    **options: Any,
) -> tuple[Observer, Seen]:
    """Observations of an episode, the first before any step."""
    with Simulator(configs, drivers=drivers) as sim:
        sim.reset(0)
        look = view_maker(sim, error, keys(first + sim.size)[first:])
        observer = Observer(sim.fleet, make_options(**options))
        view = look(None)
        observer.reset(view)
        seen: Seen = []
        for step in range(steps + 1):
            seen.append((view, observer.observe(view), observer.state(view), heat_map(view)))
            if step < steps:
                view = look(sim.step(commands(step, sim.size, first)))
    return observer, seen


@pytest.fixture(scope="module", params=["tiny", "corrected"])
def episode(request: pytest.FixtureRequest) -> tuple[Observer, Seen]:
    return watch(fleet_of(request.param))


def parts(array: np.ndarray, features: tuple[Feature, ...]) -> dict[str, np.ndarray]:
    """Entries of each feature, (B, size)."""
    ends = np.cumsum([f.size for f in features])
    assert array.shape[1] == ends[-1]
    split = np.split(array, ends[:-1], axis=1)
    return {f.name: part for f, part in zip(features, split, strict=True)}


def at(table: FleetSeries, dc: int, index: int) -> float:
    return float(table.values[table.offsets[dc] + index % table.lengths[dc]])


def by_hand(view: View, dc: int, work: list[list[float]]) -> dict[str, list[float]]:
    """Unscaled features of one data center, from configs, drivers and results in plain Python.

    Args:
        view: before the step.
        dc: the data center.
        work: of each past step, what it put into the queue of ``dc`` and what it took out.
    """
    config, drivers, sizing = view.fleet.configs[dc], view.drivers, view.sizing
    per_hour = config.simulation.steps_per_hour
    index = int(drivers.start[dc]) + view.state.step
    hour = index / per_hour

    layers: list[list[float]] = []  # [step that put it in, tasks], oldest first
    for step, (put, taken) in enumerate(work):
        while taken > 1e-12 and layers:
            part = min(taken, layers[0][1])
            layers[0][1] -= part
            taken -= part
            if layers[0][1] <= 1e-9:
                layers.pop(0)
        layers.append([step, put])
    layers = [layer for layer in layers if layer[1] > 1e-9]
    oldest_h = config.workload.age_horizon_h + 1.0 / per_hour
    ages = [(min((len(work) - 1 - step) / per_hour, oldest_h), tasks) for step, tasks in layers]
    total = sum(tasks for _, tasks in ages)
    edges = [0.0, 6.0, 12.0, 18.0, 24.0, math.inf]
    limit_h = config.workload.queue_limit_h or 10.0

    def ahead(table: FleetSeries, leads_h: tuple[float, ...]) -> list[float]:
        return [at(table, dc, index + round(h * per_hour)) for h in leads_h]

    price = drivers.price_per_kwh
    assert price is not None
    ci = at(drivers.ci_g_per_kwh, dc, index)
    ci_ahead = ahead(drivers.ci_g_per_kwh, CI_LEADS_H)
    lowest, highest = min(ci, *ci_ahead), max(ci, *ci_ahead)
    last = view.last
    kwh_per_w = 1.0 / per_hour / 1000.0
    hvac_w = float(sizing.facility_w[dc] - sizing.it_w[dc] - sizing.counted_loss_w[dc])
    battery_kwh = float(sizing.battery_kwh[dc])
    units = view.state.setpoint_c[view.fleet.unit_offsets[dc] : view.fleet.unit_offsets[dc + 1]]
    return {
        "time_of_day": [math.sin(2 * math.pi * hour / 24), math.cos(2 * math.pi * hour / 24)],
        "time_of_year": [math.sin(2 * math.pi * hour / 8760), math.cos(2 * math.pi * hour / 8760)],
        "ci": [ci],
        "ci_forecast": ci_ahead,
        "ci_change": [value - ci for value in ci_ahead],
        "ci_rank": [sum(value < ci for value in ci_ahead) / len(ci_ahead)],
        "ci_relative": [(value - lowest) / (highest - lowest) for value in (ci, *ci_ahead)],
        "ci_swing": [(highest - lowest) / ci],
        "outdoor": [at(drivers.outdoor_c, dc, index)],
        "outdoor_forecast": ahead(drivers.outdoor_c, WEATHER_LEADS_H),
        "wet_bulb": [at(drivers.wet_bulb_c, dc, index)],
        "wet_bulb_forecast": ahead(drivers.wet_bulb_c, WEATHER_LEADS_H),
        "workload": [at(drivers.demand, dc, index)],
        "price": [at(price, dc, index) / 0.125],
        "price_forecast": [p / 0.125 for p in ahead(price, CI_LEADS_H)],
        "queue": [total / (limit_h * per_hour * 100.0)],
        "oldest_age": [ages[0][0] if ages else 0.0],
        "mean_age": [sum(age * tasks for age, tasks in ages) / total if ages else 0.0],
        "age_histogram": [
            sum(tasks for age, tasks in ages if low <= age < high) / total if ages else 0.0
            for low, high in pairwise(edges)
        ],
        "room": [float(units.mean() if last is None else last.return_c[dc])],
        "hottest_inlet": [float(units.mean() if last is None else last.inlet_max_c[dc])],
        "setpoint": [float(units.mean())],
        "it_energy": [
            0.0 if last is None else float(last.it_kwh[dc] / (sizing.it_w[dc] * kwh_per_w))
        ],
        "hvac_energy": [0.0 if last is None else float(last.hvac_kwh[dc] / (hvac_w * kwh_per_w))],
        "dc_load": [
            0.0
            if last is None
            else float((last.it_w + last.overhead_w)[dc] / sizing.facility_w[dc])
        ],
        "soc": [float(view.state.stored_kwh[dc]) / battery_kwh if battery_kwh else 0.0],
    }


def scaled(feature: Feature, value: float) -> float:
    if feature.low == -feature.high:
        return max(-1.0, min(1.0, value / feature.high))
    return max(0.0, min(1.0, (value - feature.low) / (feature.high - feature.low)))


def test_every_feature_is_what_its_description_says(episode: tuple[Observer, Seen]) -> None:
    observer, seen = episode
    by_name = {f.name: f for f in observer.state_features}
    put_and_taken: list[list[list[float]]] = [[], [], []]
    largest: dict[str, float] = dict.fromkeys(by_name, 0.0)
    for step, (view, _, state, _) in enumerate(seen):
        found = parts(state, observer.state_features)
        for dc in range(3):
            if view.last is not None:
                taken = view.last.drained_tasks + view.last.due_tasks - view.last.overdue_tasks
                put_and_taken[dc].append([float(view.last.deferred_tasks[dc]), float(taken[dc])])
            expected = by_hand(view, dc, put_and_taken[dc])
            assert expected.keys() == by_name.keys()
            for name, values in expected.items():
                want = [scaled(by_name[name], value) for value in values]
                np.testing.assert_allclose(
                    found[name][dc], want, atol=3e-6, err_msg=f"{name}, step {step}, {SITES[dc]}"
                )
                largest[name] = max([largest[name], *map(abs, want)])
    # The run goes through the ranges: nothing is compared at zero alone.
    assert min(largest.values()) > 0.02, largest
    histogram = parts(seen[100][2], observer.state_features)["age_histogram"]
    assert np.all(histogram[1] > 0.02)


def test_agents_get_their_part_of_the_state(episode: tuple[Observer, Seen]) -> None:
    observer, seen = episode
    for view, observed, state, _ in seen[::50]:
        found = parts(state, observer.state_features)
        assert tuple(observed) == AGENTS
        for agent, array in observed.items():
            assert [f.name for f in observer.features[agent]] == list(
                AGENT_DEFINITIONS[agent].features
            )
            want = np.concatenate(
                [found[name] for name in AGENT_DEFINITIONS[agent].features], axis=1
            )
            np.testing.assert_array_equal(array, want)
            assert array.dtype == np.float32
            assert array.flags.c_contiguous
            assert array.shape == (view.size, *observer.spaces[agent].shape)


def test_everything_lies_in_its_space(episode: tuple[Observer, Seen]) -> None:
    observer, seen = episode
    for view, observed, state, image in seen:
        assert observer.state_space.dtype == np.float32
        assert all(observer.state_space.contains(row) for row in state)
        for agent, space in observer.spaces.items():
            assert isinstance(space, Box)
            assert np.all(np.isfinite(space.low))
            assert np.all(np.isfinite(space.high))
            assert all(space.contains(row) for row in observed[agent])
        assert all(heat_map_space(view.fleet).contains(one) for one in image)


@pytest.mark.parametrize(
    "listed",
    [
        ["sustaindc"],
        ["paper"],
        ["corrected", "simulation.thermal=transient"],
        ["tiny", "workload.age_horizon_h=8", "workload.deadline_h=8"],
    ],
    ids=["sustaindc", "paper", "transient", "short-horizon"],
)
def test_other_presets_and_models_fit_too(listed: list[str]) -> None:
    observer, seen = watch([load_config(listed[0], listed[1:])], 110)
    states = np.stack([state for _, _, state, _ in seen])
    assert all(observer.state_space.contains(row) for row in states[:, 0])
    found = parts(states[:, 0], observer.state_features)
    for name in ("room", "hottest_inlet", "it_energy", "hvac_energy", "dc_load"):
        middle = (found[name][1:] > 0.02) & (found[name][1:] < 0.98)
        assert np.all(middle), name
    filled = found["queue"][:, 0] > 1e-6
    np.testing.assert_allclose(found["age_histogram"][filled].sum(axis=1), 1.0, atol=1e-5)
    np.testing.assert_array_equal(found["age_histogram"][0], 0.0)


def test_what_is_handed_out_belongs_to_the_caller() -> None:
    with Simulator(fleet_of("tiny")) as sim:
        sim.reset(0)
        view = view_maker(sim)(None)
        observer = Observer(sim.fleet, make_options())
        observer.reset(view)
        first = observer.state(view), observer.observe(view)
        kept = first[0].copy(), {a: x.copy() for a, x in first[1].items()}
        first[0][:] = 7.0
        for array in first[1].values():
            array[:] = 7.0
        np.testing.assert_array_equal(observer.state(view), kept[0])
        for agent, array in observer.observe(view).items():
            np.testing.assert_array_equal(array, kept[1][agent])


# Forecasts


def walk_forecasts(error: ForecastError, seeds: int, steps: Sequence[int]) -> list[Any]:
    """CI, dry bulb and wet bulb at present and each lead, (seeds, 1 + leads), of a flat world."""
    n = 400
    drivers = drivers_from_arrays(
        np.full(n, 20.0), np.full(n, 15.0), np.full(n, 400.0), np.full(n, 0.5)
    )
    with Simulator([load_config("tiny")], drivers=drivers) as sim:
        sim.reset(0)
        view = view_maker(sim)(None)
    walks = RandomWalks(keys(seeds, 5), view.step_h)
    view = replace(view, forecast_error=error, walks=walks)
    forecasts = Forecasts(4, CI_LEADS_H, WEATHER_LEADS_H)
    forecasts.reset(view)
    index = np.zeros(seeds, dtype=np.int64)
    return [[x.T for x in forecasts.at(index + k, index, k)[:3]] for k in steps]


def test_errors_grow_with_the_square_root_of_the_lead() -> None:
    count = 4000
    [(ci, outdoor, wet_bulb)] = walk_forecasts(ForecastError(0.1, 2.0), count, [100])
    np.testing.assert_array_equal(ci[:, 0], 400.0)
    np.testing.assert_array_equal(outdoor[:, 0], 20.0)
    # Five standard errors of a standard deviation and of a mean.
    for values, truth, at_24_h, leads in (
        (ci, 400.0, 40.0, CI_LEADS_H),
        (outdoor, 20.0, 2.0, WEATHER_LEADS_H),
        (wet_bulb, 15.0, 2.0, WEATHER_LEADS_H),
    ):
        for k, lead_h in enumerate(leads):
            wanted = at_24_h * math.sqrt(lead_h / 24.0)
            error = values[:, k + 1].astype(np.float64) - truth
            assert abs(error.std() / wanted - 1.0) < 5 / math.sqrt(2 * count)
            assert abs(error.mean()) < 5 * wanted / math.sqrt(count)
    np.testing.assert_allclose(outdoor - wet_bulb, 5.0, atol=1e-5)
    independent = np.corrcoef(ci[:, -1], outdoor[:, -1])[0, 1]
    assert abs(independent) < 5 / math.sqrt(count)


def test_successive_forecasts_of_one_hour_are_consistent() -> None:
    """What the error loses from one issue to the next is what the walk did in between."""
    count, error = 3000, ForecastError(0.1, 0.0)
    issued = [ci / 400.0 - 1.0 for ci, *_ in walk_forecasts(error, count, (60, 92, 124, 140, 148))]
    leads = [CI_LEADS_H.index(h) + 1 for h in (24.0, 16.0, 8.0, 4.0, 2.0)]
    errors = np.stack([e[:, k] for e, k in zip(issued, leads, strict=True)]).astype(np.float64)
    revisions = -np.diff(errors, axis=0)
    spans_h = [8.0, 8.0, 4.0, 2.0]
    for revision, hours in zip(revisions, spans_h, strict=True):
        assert revision.std() == pytest.approx(0.1 * math.sqrt(hours / 24), rel=0.08)
    mixed = np.corrcoef(np.vstack([revisions, errors[-1:]])) - np.eye(5)
    assert np.max(np.abs(mixed)) < 5 / math.sqrt(count)


def test_series_that_end_repeat_from_their_own_start() -> None:
    """Series of unlike length, shorter than a lead, and read past their ends."""
    rng = np.random.default_rng(3)
    with Simulator([load_config("tiny")]) as sim:
        drivers = sim.drivers

    def table(n: int, low: float, high: float) -> FleetSeries:
        values = rng.uniform(low, high, n)
        return FleetSeries(values, np.zeros(1, np.int64), np.array([n]))

    odd = replace(
        drivers,
        ci_g_per_kwh=table(31, 100, 400),
        outdoor_c=table(50, 20, 30),
        wet_bulb_c=table(13, 5, 15),
        start=np.array([7]),
    )
    observer, seen = watch([load_config("tiny")], 60, odd)
    spans = {f.name: (f.low, f.high - f.low) for f in observer.state_features}
    for step, (_, _, state, _) in enumerate(seen):
        found = parts(state, observer.state_features)
        for name, leads, series in (
            ("ci", CI_LEADS_H, odd.ci_g_per_kwh),
            ("outdoor", WEATHER_LEADS_H, odd.outdoor_c),
            ("wet_bulb", WEATHER_LEADS_H, odd.wet_bulb_c),
        ):
            low, span = spans[name]
            want = [at(series, 0, 7 + step + round(h * 4)) for h in (0.0, *leads)]
            got = np.append(found[name], found[f"{name}_forecast"]) * span + low
            np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-4)


def test_rows_of_a_year_and_of_short_stretches_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Data centers of two sites, two of which share their rows."""
    configs = [*fleet_of("tiny"), load_config("tiny", ["site.location=NY", "name=other"])]
    _, of_year = watch(configs, 30)
    monkeypatch.setattr(time_rows, "MAX_ROW_BYTES", 0)
    _, of_day = watch(configs, 30)
    monkeypatch.setattr(time_rows, "STRETCH_BYTES", 2**14)
    _, of_few_steps = watch(configs, 30)
    for (_, _, a, _), (_, _, b, _), (_, _, c, _) in zip(of_year, of_day, of_few_steps, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


# Choice of features


def test_features_of_an_agent_are_those_named_in_their_order() -> None:
    names = ["soc", "ci_forecast", "time_of_day"]
    options: dict[str, Any] = {"features": {"agent_bat": names}}
    observer, seen = watch(fleet_of("tiny"), 3, ci_leads_h=[0.5, 3], **options)
    assert [f.name for f in observer.features["agent_bat"]] == names
    default = AGENT_DEFINITIONS["agent_ls"].features
    assert [f.name for f in observer.features["agent_ls"]] == list(default)
    assert len(observer.state_features) == len(all_features())
    _, observed, state, _ = seen[-1]
    found = parts(state, observer.state_features)
    np.testing.assert_array_equal(
        observed["agent_bat"], np.concatenate([found[name] for name in names], axis=1)
    )
    assert observed["agent_bat"].shape == (3, 1 + 2 + 2)
    np.testing.assert_array_equal(observer.spaces["agent_bat"].low, [0, 0, 0, -1, -1])


def test_no_leads_leave_the_forecasts_out() -> None:
    observer, seen = watch(fleet_of("tiny"), 2, ci_leads_h=[], weather_leads_h=[])
    names = {f.name for f in observer.state_features}
    assert not any("forecast" in name or "change" in name for name in names)
    assert all(f.name in names for found in observer.features.values() for f in found)
    assert all(observer.state_space.contains(row) for row in seen[-1][2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"features": {"agent_ls": ["queu"]}}, "did you mean 'queue'"),
        ({"features": {"agent_ls": ["xyzzy"]}}, "valid: time_of_day, .*, soc"),
        ({"features": {"agent_bt": ["soc"]}}, "did you mean 'agent_bat'"),
        ({"features": {"agent_ls": []}}, "agent_ls: .*list of names"),
        ({"features": {"agent_ls": ["soc", "soc"]}}, "'soc' is named twice"),
        ({"ci_leads_h": [0.1]}, "ci_leads_h: 0.1 h; valid is a positive multiple .* 15 min"),
        ({"ci_leads_h": [0.0]}, "ci_leads_h.0: should be greater than 0"),
        ({"ci_leads_h": [float("nan")]}, "ci_leads_h.0: should be a finite number"),
        ({"ci_leads_h": [1e9]}, "ci_leads_h.0: should be less than or equal to 8760"),
        ({"weather_leads_h": [3, 3]}, "weather_leads_h: 3 h after 3 h"),
    ],
)
def test_wrong_choices_name_what_is_valid(options: dict[str, Any], message: str) -> None:
    with Simulator([load_config("tiny")]) as sim, pytest.raises(ConfigError, match=message):
        Observer(sim.fleet, make_options(**options))


# Heat map


def test_heat_map_shows_each_rack_in_its_place(episode: tuple[Observer, Seen]) -> None:
    _, seen = episode
    for view, _, _, image in seen[::75]:
        assert image.dtype == np.float32
        for dc, config in enumerate(view.fleet.configs):
            rows, per_row = config.hall.rows, config.hall.racks_per_row
            assert image[dc].shape == (rows, per_row, 3) == heat_map_space(view.fleet).shape
            for row in range(rows):
                for place in range(per_row):
                    rack = int(view.fleet.rack_offsets[dc]) + row * per_row + place
                    if view.last is None:
                        raw = [18.0, 18.0, 0.0]
                    else:
                        design_w = float(view.sizing.it_w[dc]) / (rows * per_row)
                        raw = [
                            float(view.last.rack_inlet_c[rack]),
                            float(view.last.rack_outlet_c[rack]),
                            float(view.last.rack_power_w[rack]) / design_w,
                        ]
                    want = [scaled(f, x) for f, x in zip(HEAT_MAP_CHANNELS, raw, strict=True)]
                    np.testing.assert_allclose(image[dc, row, place], want, atol=2e-6)


def test_heat_map_needs_halls_of_one_shape() -> None:
    small = load_config("tiny")
    other = load_config("corrected", ["hall.inlet_model=approach"])
    with Simulator([small, other]) as sim:
        sim.reset(0)
        with pytest.raises(ConfigError, match="corrected has 4 x 5 racks, tiny has 2 x 2"):
            heat_map_space(sim.fleet)
        with pytest.raises(SdcError, match="heat map"):
            heat_map(view_maker(sim)(None))


# Documentation


@pytest.mark.parametrize(
    ("counts", "command", "expected_c"),
    [
        ((2, 2), [1.0, -1.0, 0.0, 2.0], [[19, 17], [18, 20]]),
        ((1, 3), [2.0, 1.0, 1.0, -2.0], [[20], [18]]),
    ],
    ids=["equal", "unequal"],
)
def test_setpoints_by_unit_or_as_means_of_unequal_halls(
    counts: tuple[int, int], command: list[float], expected_c: list[list[float]]
) -> None:
    configs = [
        load_config("corrected", [f"hvac.crac.units={count}", f"name=hall-{i}"])
        for i, count in enumerate(counts)
    ]
    with Simulator(configs) as sim:
        sim.reset(0)
        view = view_maker(sim)(sim.step(Actions(cooling=np.array(command))))
        observer = Observer(sim.fleet, make_options())
        observer.reset(view)
        entries = parts(observer.state(view), observer.state_features)["setpoint"]
        np.testing.assert_allclose(entries * 20.0 + 10.0, expected_c, atol=1e-5)


def test_values_beyond_a_range_and_series_that_never_change() -> None:
    n = 200
    config = load_config(
        "tiny", ["hvac.sizing.design_outdoor_c=35", "hvac.sizing.design_wet_bulb_c=25"]
    )
    ci = np.where(np.arange(n) % 2 == 0, 0.0, 2000.0)
    outdoor = np.where(np.arange(n) % 2 == 0, -60.0, 60.0)
    drivers = drivers_from_arrays(outdoor, outdoor - 1.0, ci, np.full(n, 0.5))
    leads: dict[str, Any] = {"ci_leads_h": [0.25], "weather_leads_h": [0.25]}
    observer, seen = watch([config], 1, drivers, **leads)
    first, second = (parts(state, observer.state_features) for _, _, state, _ in seen)
    for name in ("ci", "outdoor", "wet_bulb"):
        assert (first[name].item(), second[name].item()) == (0.0, 1.0)
        assert (first[f"{name}_forecast"].item(), second[f"{name}_forecast"].item()) == (1.0, 0.0)
    constant = drivers_from_arrays(outdoor, outdoor - 1.0, np.full(n, 300.0), np.full(n, 0.5))
    observer, seen = watch([config], 1, constant)
    entries = parts(seen[0][2], observer.state_features)
    for name in ("ci_rank", "ci_relative", "ci_swing"):
        assert not entries[name].any()
