"""The studies of the hall show what the documents say they show."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sdc_taichi import SdcError, load_config

pytestmark = pytest.mark.repo

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(scope="module")
def study() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        yield importlib.import_module("hall_studies")


@pytest.fixture(scope="module")
def moved(study: ModuleType) -> Any:
    return study.move_load()


def test_moved_load_changes_inlets_by_an_amount_that_falls_with_distance(moved: Any) -> None:
    assert moved.moved_kw[moved.source] == pytest.approx(-15.0, abs=0.6)
    assert moved.moved_kw[moved.target] == pytest.approx(15.0, abs=0.6)
    others = np.delete(moved.moved_kw, [moved.source, moved.target])
    assert np.abs(others).max() < 0.1
    # Every rack feels it; those nearer the rack with more load get warmer, the others cooler.
    change = np.abs(moved.change_k)
    assert change.min() > 1e-4
    rows = moved.change_k.reshape(moved.config.hall.rows, -1)
    assert np.all(rows[:4] < 0)
    assert np.all(rows[4:] > 0)
    edges = [0.0, 1.5, 2.5, 3.5, 4.5, 6.0]
    means = [
        change[(moved.distance_m >= low) & (moved.distance_m < high)].mean()
        for low, high in pairwise(edges)
    ]
    assert np.all(np.diff(means) < 0)
    assert means[0] > 5 * means[-1]
    nearest = np.argsort(moved.distance_m)[:2]
    assert set(np.argsort(-change)[:2]) == set(nearest)


def test_failed_unit_is_felt_near_it_first_and_recovers(study: ModuleType) -> None:
    sim, results = study.failing_units(0, steps_per_hour=12, hours=4.0)
    before, first, after = (results[i] for i in (11, 12, -1))
    assert before.unit_running.tolist() == [1.0] * 4
    assert first.unit_running.tolist() == [0.0, 1.0, 1.0, 1.0]
    rise = (first.rack_inlet_c - before.rack_inlet_c).astype(np.float64)
    assert np.all(rise > 0)
    plan_front = study.floor_plan(sim.fleet.configs[0].hall).front_m
    distance = np.hypot(*(plan_front - [0.0, 2.7]).T)
    assert np.corrcoef(distance, rise)[0, 1] < -0.8
    # It goes on while the servers warm, until they throttle, and comes back.
    warmest_c = np.max([r.rack_inlet_c for r in results[12:24]], axis=0)
    assert np.all(warmest_c > first.rack_inlet_c + 1.0)
    np.testing.assert_allclose(after.rack_inlet_c, before.rack_inlet_c, atol=0.05)
    assert after.tripped_racks[0] == 0.0


def test_loss_of_all_units_trips_servers_in_time_only_with_memory(study: ModuleType) -> None:
    _, moving = study.failing_units(None, steps_per_hour=60, hours=3.0)
    _, steady = study.failing_units(None, thermal="quasi_steady", steps_per_hour=60, hours=3.0)
    hottest = {name: max(float(r.inlet_max_c[0]) for r in rs) for name, rs in
               (("moving", moving), ("steady", steady))}  # fmt: skip
    assert 40.0 < hottest["moving"] < 45.0
    assert hottest["steady"] > 100.0
    down = [float(r.tripped_racks[0]) for r in moving]
    assert down[59] == 0.0
    assert max(down) >= 19.0
    assert down[-1] == 0.0
    assert float(moving[-1].executed_tasks[0]) == pytest.approx(90.0)
    assert sum(float(r.lost_tasks[0]) for r in moving) > 0.0


@pytest.mark.parametrize("rack_kw", [5, 28])
def test_halls_without_cooling_warm_as_fast_as_published(study: ModuleType, rack_kw: int) -> None:
    # Opengate Data Systems: servers shut down 3 min 9 s after the loss, at 5 kW per rack.
    inlet_c = study.uncooled(rack_kw, "kind: crac_down", 12)
    assert inlet_c[0] < 28.0
    assert 42.0 < inlet_c[3] < 46.0
    # Then servers of 30 J/(K W), coils and floor of 15 and some air warm by the power alone.
    assert 1 / 48 < (inlet_c[12] - inlet_c[10]) / 120 < 1 / 30
    slower = study.uncooled(rack_kw, "kind: chiller_derate, share: 0", 12)
    assert 34.0 < slower[3] < 38.0


def test_side_by_side_gives_each_its_own_controller(study: ModuleType) -> None:
    alone = study.run_mode([], 8, sites=("NY",), seasons={"x": "07-01"}, controllers=("warmest",))
    mixed = study.run_mode(
        [], 8, sites=("NY",), seasons={"x": "07-01"}, controllers=("idle", "warmest")
    )
    np.testing.assert_array_equal(mixed.inlet_max_c[:, 1], alone.inlet_max_c[:, 0])
    assert np.all(mixed.inlet_max_c[1:, 0] < mixed.inlet_max_c[1:, 1] - 2.0)
    same = study.compare_ranking(mixed, mixed, "facility_kwh")
    assert (same.pairs, same.swapped, same.best_kept, same.situations) == (1, 0, 1, 1)
    turned = study.ModeRun(
        mixed.names, mixed.metrics[::-1], mixed.inlet_max_c, mixed.it_w, mixed.hvac_w, 1.0
    )
    other = study.compare_ranking(mixed, turned, "facility_kwh")
    assert (other.swapped, other.best_kept) == (1, 0)
    low, high = sorted(mixed.column("facility_kwh"))
    assert other.largest_gap == pytest.approx(high / low - 1)


@pytest.mark.slow
def test_quick_run_writes_small_pictures_and_all_tables(
    study: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study.main(tmp_path / "out", quick=True)
    text = capsys.readouterr().out
    files = {p.name: p for p in (tmp_path / "out").iterdir()}
    assert sorted(files) == [
        "crac_failure.png",
        "crac_failure_maps.png",
        "hall_plan.png",
        "modes.png",
        "moved_load.png",
    ]
    for path in files.values():
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size < 150_000
    assert len(re.findall(r"^[14] of 4 units ", text, re.MULTILINE)) == 12
    assert re.search(r"ranking by cfp_kg: \d+ of 6 pairs", text)
    errors = [float(x) for x in re.findall(r"^ *\d+ s +(\S+)", text, re.MULTILINE)]
    assert len(errors) == 4
    # First order in the substep.
    assert np.all(np.diff(errors) > 0)
    assert 1.5 < errors[3] / errors[2] < 2.5


def test_pictures_refuse_what_does_not_fit(study: ModuleType, moved: Any) -> None:
    hall = moved.config.hall
    with pytest.raises(SdcError, match=r"change_k has shape \(3,\), expected \(80,\)"):
        study.hall_figures.load_shift(hall, np.zeros(3), moved.distance_m, (0, 1))
    sim, results = study.failing_units(0, steps_per_hour=4, hours=1.0)
    with pytest.raises(SdcError, match="hours 9: the run has no step that ends then"):
        study.hall_figures.failure_maps(results, sim.fleet, [9.0])
    with pytest.raises(SdcError, match="run 'none' has no steps"):
        study.hall_figures.failure_curves({"none": []}, sim.fleet)


def test_pictures_need_matplotlib(study: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(SdcError, match=r'pip install "sdc-taichi\[plot\]"'):
        study.hall_figures.thermal_modes({}, "")
    with pytest.raises(SdcError, match=r'pip install "sdc-taichi\[plot\]"'):
        study.hall_figures.load_shift(load_config("tiny").hall, np.zeros(4), np.zeros(4), (0, 1))
