from __future__ import annotations

from dataclasses import fields
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sdc_taichi.config import (
    DataCenterConfig,
    EventsConfig,
    SampledEvent,
    ScheduledEvent,
    load_config,
)
from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.events import (
    HOURS_PER_BLOCK,
    ActiveEvent,
    Places,
    Timeline,
    schedule,
    seeds_of_fleet,
)

BASE = load_config("corrected")
HOURLY = "{kind: grid_outage, per_year: 8760, duration_h: [1, 2]}"
KINDS: dict[str, dict[str, Any]] = {
    "crac_down": {},
    "chiller_derate": {"share": 0.3},
    "rack_fan_failure": {"share": 0.7},
    "heat_wave": {"offset_k": 4.5},
    "grid_outage": {},
}


def data_center(name: str = "dc", **events: Any) -> DataCenterConfig:
    return BASE.model_copy(update={"name": name, "events": EventsConfig(**events)})


def timeline(
    *configs: DataCenterConfig,
    racks: tuple[int, ...] | None = None,
    units: tuple[int, ...] | None = None,
    steps_per_hour: int = 4,
    seed: int = 7,
) -> Timeline:
    rack_offsets = np.cumsum([0, *(racks or (3,) * len(configs))])
    return schedule(
        configs,
        Places(
            rack_offsets,
            np.cumsum([0, *(units or (2,) * len(configs))]),
            2 * np.arange(len(configs) + 1),
            rack_offsets[:-1],
        ),
        steps_per_hour=steps_per_hour,
        seed=seed,
    )


def scheduled(kind: str, start_h: float, duration_h: float, **more: Any) -> ScheduledEvent:
    return ScheduledEvent(kind=kind, start_h=start_h, duration_h=duration_h, **more)  # type: ignore[arg-type]


def sampled(kind: str, per_year: float, low: float, high: float) -> SampledEvent:
    return SampledEvent(kind=kind, per_year=per_year, duration_h=(low, high), **KINDS[kind])  # type: ignore[arg-type]


ALL_SAMPLED = tuple(sampled(kind, 300.0, 0.5, 40.0) for kind in KINDS)


def met(line: Timeline, low: int, high: int) -> set[ActiveEvent]:
    return {event for step in range(low, high) for event in line.active(step)}


def arrays(line: Timeline, step: int) -> list[np.ndarray]:
    disturbance = line.at(step)
    return [
        getattr(disturbance, f.name) for f in fields(disturbance) if not f.name.startswith("active")
    ]


def test_each_kind_does_what_it_says_to_its_own_data_center() -> None:
    events = (
        scheduled("crac_down", 1.0, 1.0, unit=1),
        scheduled("chiller_derate", 2.0, 1.0, share=0.4),
        scheduled("rack_fan_failure", 3.0, 1.0, rack=2, share=0.25),
        scheduled("heat_wave", 4.0, 1.0, offset_k=6.0),
        scheduled("grid_outage", 5.0, 1.0),
        scheduled("crac_down", 6.0, 1.0),
        scheduled("pump_down", 7.0, 1.0, share=0.5),
        scheduled("tower_cell_down", 8.0, 1.0, share=0.75),
        scheduled("tank_down", 9.0, 1.0, share=0.25),
        scheduled("link_down", 16.0, 1.0),
        scheduled("facility_pump_down", 10.0, 1.0, share=0.5),
        scheduled("cooler_down", 11.0, 1.0, share=0.25),
        scheduled("cdu_down", 12.0, 1.0, unit=1),
        scheduled("cdu_pump_down", 13.0, 1.0),
        scheduled("leak", 14.0, 2.0, rack=0, litres=30.0),
    )
    line = timeline(
        data_center("a"),
        data_center("b", scheduled=events),
        racks=(2, 4),
        units=(3, 2),
        steps_per_hour=1,
    )
    assert not line.event_free
    normal = [[True] * 5, [1.0, 1.0], [1.0] * 6, [0.0, 0.0], [True, True], *[[1.0, 1.0]] * 3]
    normal += [[True, True], [1.0, 1.0], [1.0, 1.0], [True] * 4, [True] * 4]
    normal += [[False, False], [0.0, 0.0]]
    expected: dict[int, tuple[Any, ...]] = {
        1: (0, [True, True, True, True, False]),
        2: (1, [1.0, 0.4]),
        3: (2, [1.0, 1.0, 1.0, 1.0, 0.25, 1.0]),
        4: (3, [0.0, 6.0]),
        5: (4, [True, False]),
        6: (0, [True, True, True, False, False]),
        7: (5, [1.0, 0.5]),
        8: (7, [1.0, 0.75]),
        9: (6, [1.0, 0.25]),
        10: (9, [1.0, 0.5]),
        11: (10, [1.0, 0.25]),
        12: (11, [True, True, True, False]),
        13: (12, [True, True, False, False]),
        14: (13, [False, True], 14, [0.0, 30.0]),
        # A leak empties at once, and its rack stays off.
        15: (13, [False, True]),
        16: (8, [True, False]),
    }
    for step in range(18):
        wanted = list(normal)
        changes = expected.get(step, ())
        for place, values in zip(changes[::2], changes[1::2], strict=True):
            wanted[place] = values
        assert line.at(step).active == (step in expected)
        assert line.at(step).active_events.tolist() == [0.0, float(step in expected)]
        for found, values in zip(arrays(line, step), wanted, strict=True):
            np.testing.assert_array_equal(found, values)
    assert line.active(0) == []
    assert line.active(1) == [ActiveEvent("crac_down", 1, 1, None, None, 1, 2)]
    assert line.active(2) == [ActiveEvent("chiller_derate", 1, None, 0.4, None, 2, 3)]
    assert line.active(3) == [ActiveEvent("rack_fan_failure", 1, 2, 0.25, None, 3, 4)]
    assert line.active(4) == [ActiveEvent("heat_wave", 1, None, None, 6.0, 4, 5)]
    assert line.active(6) == [ActiveEvent("crac_down", 1, None, None, None, 6, 7)]


def test_overlapping_events_add_up() -> None:
    events = (
        scheduled("chiller_derate", 0.0, 3.0, share=0.5),
        scheduled("chiller_derate", 1.0, 1.0, share=0.5),
        scheduled("rack_fan_failure", 0.0, 3.0, rack=0, share=0.8),
        scheduled("rack_fan_failure", 1.0, 1.0, rack=0, share=0.5),
        scheduled("heat_wave", 0.0, 3.0, offset_k=2.0),
        scheduled("heat_wave", 1.0, 1.0, offset_k=-5.0),
        scheduled("crac_down", 0.0, 2.0, unit=0),
        scheduled("crac_down", 1.0, 2.0, unit=0),
    )
    line = timeline(data_center(scheduled=events), steps_per_hour=1)
    found = [line.at(step) for step in range(4)]
    assert [d.chiller_share[0] for d in found] == [0.5, 0.25, 0.5, 1.0]
    assert [d.rack_airflow[0] for d in found] == [0.8, 0.4, 0.8, 1.0]
    assert [d.outdoor_offset_k[0] for d in found] == [2.0, -3.0, 2.0, 0.0]
    assert [list(d.unit_up) for d in found] == [[False, True]] * 3 + [[True, True]]


@pytest.mark.parametrize(
    ("start_h", "duration_h", "steps_per_hour", "covered"),
    [
        (1.0, 1.0, 4, range(4, 8)),
        (1.1, 0.01, 4, range(4, 5)),
        (1.2, 0.1, 4, range(4, 6)),
        (0.0, 1e-3, 4, range(1)),
        # In binary (0.1 + 0.2)*10 is above 3 and 2.05*60 below 123.
        (0.1, 0.2, 10, range(1, 3)),
        (2.05, 1.0, 60, range(123, 183)),
    ],
)
def test_an_event_covers_every_step_it_has_a_part_in(
    start_h: float, duration_h: float, steps_per_hour: int, covered: range
) -> None:
    event = scheduled("grid_outage", start_h, duration_h)
    line = timeline(data_center(scheduled=(event,)), steps_per_hour=steps_per_hour)
    assert [s for s in range(200) if not line.at(s).grid_up[0]] == list(covered)


@given(st.integers(0, 10), st.lists(st.integers(0, 2 * HOURS_PER_BLOCK), max_size=12))
@settings(max_examples=15)
def test_arrays_are_what_the_listed_events_say(seed: int, steps: list[int]) -> None:
    racks, units = (3, 5), (1, 4)
    line = timeline(
        data_center("a", sampled=ALL_SAMPLED),
        data_center("b", sampled=ALL_SAMPLED[::-1]),
        racks=racks,
        units=units,
        steps_per_hour=1,
        seed=seed,
    )
    for step in steps:
        disturbance = line.at(step)
        for dc in range(2):
            own = [e for e in line.active(step) if e.dc == dc]
            assert all(e.start_step <= step < e.end_step for e in own)
            first_rack, first_unit = sum(racks[:dc]), sum(units[:dc])
            for rack in range(racks[dc]):
                here = [e for e in own if e.kind == "rack_fan_failure" and e.target == rack]
                share = 0.7 ** len(here)
                assert disturbance.rack_airflow[first_rack + rack] == pytest.approx(share)
            for unit in range(units[dc]):
                down = any(e.kind == "crac_down" and e.target == unit for e in own)
                assert disturbance.unit_up[first_unit + unit] == (not down)
            derated = [e for e in own if e.kind == "chiller_derate"]
            assert disturbance.chiller_share[dc] == pytest.approx(0.3 ** len(derated))
            waves = [e.offset_k for e in own if e.kind == "heat_wave"]
            assert disturbance.outdoor_offset_k[dc] == pytest.approx(4.5 * len(waves))
            assert disturbance.grid_up[dc] == (not any(e.kind == "grid_outage" for e in own))


def test_a_data_center_meets_the_same_alone_and_in_a_fleet() -> None:
    configs = [
        data_center("a", sampled=(sampled("heat_wave", 5.0, 9000.0, 20000.0),)),
        data_center(
            "b", sampled=ALL_SAMPLED, scheduled=(scheduled("heat_wave", 5, 50, offset_k=0.1),)
        ),
        data_center("c", sampled=ALL_SAMPLED),
    ]
    racks, units = (2, 3, 3), (1, 2, 2)
    fleet = timeline(*configs, racks=racks, units=units)
    alone = timeline(configs[1])
    rack, unit = slice(2, 5), slice(1, 3)
    affected = 0
    for step in range(0, 3 * HOURS_PER_BLOCK * 4, 1009):
        whole, own = fleet.at(step), alone.at(step)
        np.testing.assert_array_equal(whole.unit_up[unit], own.unit_up)
        np.testing.assert_array_equal(whole.rack_airflow[rack], own.rack_airflow)
        for name in ("chiller_share", "outdoor_offset_k", "grid_up"):
            np.testing.assert_array_equal(getattr(whole, name)[1:2], getattr(own, name))
        affected += own is not alone.at(0)
    assert affected > 50
    # The same rules under another name meet other events.
    assert {e.start_step for e in met(fleet, 0, 500) if e.dc == 1} != {
        e.start_step for e in met(fleet, 0, 500) if e.dc == 2
    }


def test_answers_do_not_depend_on_what_was_asked_before() -> None:
    config = data_center(sampled=ALL_SAMPLED)
    steps = np.random.default_rng(1).integers(0, 4 * HOURS_PER_BLOCK, 60)
    used = timeline(config, steps_per_hour=1)
    for step in (*steps, *sorted(steps), *sorted(steps)[::-1]):
        fresh = timeline(config, steps_per_hour=1)
        assert used.active(step) == fresh.active(step)
        for a, b in zip(arrays(used, step), arrays(fresh, step), strict=True):
            np.testing.assert_array_equal(a, b)


def test_the_seed_decides_sampled_events_alone() -> None:
    events: dict[str, Any] = {
        "sampled": ALL_SAMPLED,
        "scheduled": (scheduled("grid_outage", 2.0, 3.0),),
    }
    line = timeline(data_center(**events), seed=1)
    assert met(line.reseeded(1), 0, 2000) == met(line, 0, 2000)
    other = line.reseeded(2)
    assert met(other, 0, 2000) == met(timeline(data_center(**events), seed=2), 0, 2000)
    shared = met(other, 0, 2000) & met(line, 0, 2000)
    assert shared == {ActiveEvent("grid_outage", 0, None, None, None, 8, 20)}


def test_copies_of_runs_with_other_seeds_have_other_seeds() -> None:
    runs = (0, 1, 2, 3, 2**63 - 2, 2**63 - 1)
    found = [seeds_of_fleet(seed, ["a", "b", "a", "a", "b"]) for seed in runs]
    for seed, seeds in zip(runs, found, strict=True):
        assert seeds.dtype == np.int64
        assert seeds.min() >= 0
        assert seeds.tolist() == [seed, seed, seeds[2], seeds[3], seeds[2]]
        assert seeds_of_fleet(seed, ["a", "a"]).tolist() == [seed, seeds[2]]
    assert len(set(np.ravel(found).tolist())) == 3 * len(runs)


@pytest.mark.parametrize("high_h", [30.0, 30000.0])
def test_events_reach_over_the_end_of_a_block(high_h: float) -> None:
    line = timeline(
        data_center(sampled=(sampled("grid_outage", 400.0, 20.0, high_h),)), steps_per_hour=1
    )
    reaching = set()
    for block in (1, 2, 3, 4):
        edge = block * HOURS_PER_BLOCK
        before, after = line.active(edge - 1), line.active(edge)
        expected = {e for e in before if e.end_step > edge}
        assert {e for e in after if e.start_step < edge} == expected
        reaching |= expected
    assert reaching
    if high_h > HOURS_PER_BLOCK:
        # Some last for more than two blocks and are still there.
        long = [e for e in line.active(2000) if e.end_step > 3 * HOURS_PER_BLOCK]
        assert long
        assert all(e in line.active(3 * HOURS_PER_BLOCK - 1) for e in long)
    # Nothing has begun before the run does.
    assert all(e.start_step >= 0 for e in line.active(0))


def test_sampled_events_have_the_asked_statistics() -> None:
    rule = sampled("rack_fan_failure", 50.0, 2.0, 10.0)
    years, racks = 40, 8
    line = timeline(data_center(sampled=(rule,)), racks=(racks,), steps_per_hour=1)
    # Events last at least two steps, so every other step meets all of them.
    found = {e for step in range(0, years * HOURS_PER_BLOCK, 2) for e in line.active(step)}
    expected = rule.per_year * years
    # Five standard deviations of each estimate.
    assert abs(len(found) - expected) < 5.0 * np.sqrt(expected)
    starts = np.sort([e.start_step for e in found])
    gaps = np.diff(starts)
    mean = HOURS_PER_BLOCK / rule.per_year
    assert abs(gaps.mean() - mean) < 5.0 * mean / np.sqrt(len(gaps))
    assert abs(gaps.std() - mean) < 5.0 * mean / np.sqrt(len(gaps)) * np.sqrt(2.0)
    covered = np.array([e.end_step - e.start_step for e in found])
    # Durations of 6 h on average, and one step more on account of partly covered ones.
    assert abs(covered.mean() - 7.0) < 5.0 * np.sqrt((8.0**2 + 2.0) / 12.0 / len(found))
    assert covered.min() >= 2
    assert covered.max() <= 11
    counts = np.bincount([e.target or 0 for e in found], minlength=racks)
    assert len(counts) == racks
    assert np.all(np.abs(counts - expected / racks) < 5.0 * np.sqrt(expected / racks))


def test_rules_of_a_data_center_are_independent() -> None:
    rule = sampled("grid_outage", 100.0, 1.0, 2.0)
    line = timeline(data_center(sampled=(rule, rule)))
    starts = sorted(e.start_step for e in met(line, 0, 4 * HOURS_PER_BLOCK))
    assert len(starts) > 120
    assert sum(a == b for a, b in pairwise(starts)) < 10


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (
            "scheduled=[{kind: heat_wave, start_h: 0, duration_h: 1, offset_k: 1},"
            " {kind: crac_down, start_h: 0, duration_h: 1, unit: 2}]",
            r"events\.scheduled\.1\.unit 2: valid is 0\.\.1$",
        ),
        (
            "scheduled=[{kind: rack_fan_failure, start_h: 0, duration_h: 1, rack: 20, share: 0.5}]",
            r"events\.scheduled\.0\.rack 20: valid is 0\.\.19$",
        ),
        (
            "sampled=[{kind: grid_outage, per_year: 9000, duration_h: [1, 2]}]",
            r"events\.sampled\.0\.per_year: .* 8760 \(got 9000\)$",
        ),
        (
            "sampled=[{kind: link_down, per_year: 1, duration_h: [1, 2]}]",
            r"events\.sampled\.0\.kind link_down needs a fleet; valid with fleet\.sites$",
        ),
        (
            "scheduled=[{kind: grid_outage, start_h: 0, duration_h: 1, site: NY}]",
            r"events\.scheduled\.0: site has no meaning for grid_outage$",
        ),
    ],
)
def test_events_that_do_not_fit_are_named(events: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config("corrected", ["hvac.crac.units=2", f"events.{events}"])
    assert load_config("corrected", [f"events.sampled=[{HOURLY}]"]).events.sampled[0].per_year
