"""The simulator as a whole: repeatable, resumable, independent of its batch, clear when misused."""

from __future__ import annotations

import gc
import resource
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sdc_taichi import (
    Actions,
    BatteryAction,
    ConfigError,
    CoolAction,
    DataCenterConfig,
    Drivers,
    LoadAction,
    RuntimeStateError,
    SdcError,
    Simulator,
    StepResult,
    load_config,
    load_drivers,
    make_configs,
)
from sdc_taichi.config import apply_overrides
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.types import F64
from simulated import actions_of, assert_same, part_of, random_actions, run, short_drivers

PRECISIONS: tuple[Precision, ...] = ("f32", "f64")
WEIGHTS = ["workload.placement=weights"]


def mixed_fleet(preset: str = "corrected") -> list[DataCenterConfig]:
    """Data centers of different size, site, season, make-up and parameters."""
    base = load_config(preset)
    changes: list[list[str]] = [
        ["site.location=NY"],
        ["site.location=AZ", "site.start=07-01", "hall.capacity_mw=0.9", "site.seed=4"],
        ["site.location=WA", "site.start=12-31", "workload.trace=google_1"],
        ["hall.rows=1", "hall.racks_per_row=3", "hall.supply_approach_k=4.2",
         "hall.return_approach_k=-3", "servers.power_w=[300, 60]", "hall.servers_per_rack=[7,1,9]"],
        ["hvac.setpoint.initial_c=21", "hvac.sizing.margin=1.5", "battery.capacity_kwh=0"],
        ["workload.flexible_share=0.7", "workload.max_utilisation=0.8",
         "workload.queue_limit_h=0.5", "workload.deadline_h=3"],
        ["battery.initial_soc=0.8", "battery.hours_of_design_load=4", "site.location=TX"],
        ["workload.queue_limit_h=null", "workload.deadline_h=null"],
    ]  # fmt: skip
    return [
        apply_overrides(base, change).model_copy(update={"name": f"dc{i}"})
        for i, change in enumerate(changes)
    ]


def grouped_fleet() -> list[DataCenterConfig]:
    """Racks of unlike servers beside a hall of one rack with another fan law."""
    base = load_config("tiny")
    return [
        base,
        apply_overrides(
            base.model_copy(update={"name": "one"}),
            ["hall.rows=1", "hall.racks_per_row=1", "hall.supply_approach_k=3",
             "hall.return_approach_k=-3", "servers.groups=[[{count: 4, full_w: 90, idle_w: 9}]]",
             "servers.fan_power_exponent=2.5"],
        ),
        base.model_copy(update={"name": "again"}),
    ]  # fmt: skip


def results_of(
    configs: Sequence[DataCenterConfig],
    actions: Sequence[Actions],
    precision: Precision,
    drivers: Drivers | None = None,
) -> list[StepResult]:
    with Simulator(configs, precision=precision, drivers=drivers) as sim:
        sim.reset()
        return run(sim, actions)


# --- repeatable ---------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    "fleet",
    [mixed_fleet, grouped_fleet, lambda: mixed_fleet("sustaindc"), lambda: mixed_fleet("paper")],
    ids=["corrected", "groups", "sustaindc", "paper"],
)
def test_a_day_of_a_batch_equals_each_data_center_alone(
    fleet: Callable[[], list[DataCenterConfig]], precision: Precision
) -> None:
    configs = fleet()
    actions = random_actions(96, configs, seed=2)
    batch = results_of(configs, actions, precision)
    for i, config in enumerate(configs):
        own = [actions_of(a, configs, i) for a in actions]
        alone = results_of([config], own, precision)
        assert_same(alone, [part_of(together, configs, i) for together in batch])


RESULT_HALLS = {
    "one unit": ("corrected", []),
    "flat": ("corrected", ["hall.inlet_model=approach"]),
    "units that accelerate": (
        "corrected", ["hvac.crac.units=3", "hvac.setpoint.model=accelerating"]
    ),
    "transient": ("corrected", ["simulation.thermal=transient"]),
    "events": (
        "corrected",
        ["workload.placement=coolest-first",
         "events.scheduled=[{kind: rack_fan_failure, rack: 1, share: 0.5, start_h: 0, "
         "duration_h: 9}]"],
    ),
    "released": ("sustaindc", []),
}  # fmt: skip


@pytest.mark.parametrize("hall", RESULT_HALLS)
def test_results_share_nothing_with_actions_and_later_steps(hall: str) -> None:
    preset, changes = RESULT_HALLS[hall]
    configs = make_configs(load_config(preset, changes), count=2)
    spoilt, kept = (Simulator(configs, drivers=short_drivers(2)) for _ in range(2))
    with spoilt, kept:
        spoilt.reset()
        kept.reset()
        for given, same in zip(*(random_actions(6, configs) for _ in range(2)), strict=True):
            result, expected = spoilt.step(given), kept.step(same)
            for f in fields(Actions):
                if isinstance(values := getattr(given, f.name), np.ndarray):
                    values[...] = -1
            assert_same([result], [expected])
            for f in fields(StepResult):
                if isinstance(values := getattr(result, f.name), np.ndarray):
                    values[...] = -1


def test_queues_of_a_state_are_read_only() -> None:
    """Their sums are known beforehand, so half of an edit would be obeyed."""
    with Simulator(load_config("tiny"), drivers=short_drivers()) as sim:
        sim.reset()
        for _ in range(2):
            sim.step(Actions(LoadAction.DEFER))
            with pytest.raises(ValueError, match="read-only"):
                sim.state.queue[:] = 0.0


def test_enums_and_numbers_are_the_same_commands() -> None:
    config, drivers = load_config("tiny"), short_drivers()
    for load in LoadAction:
        for cooling in CoolAction:
            for battery in BatteryAction:
                named = Actions(load, cooling, battery)
                numbers = Actions(float(load.value), float(cooling.value), float(battery.value))
                pair = [results_of([config], [a] * 2, "f32", drivers) for a in (named, numbers)]
                assert_same(*pair)


def test_series_repeat_after_their_end() -> None:
    drivers = short_drivers(steps=10)
    results = results_of([load_config("tiny")], [Actions()] * 23, "f32", drivers)
    for name in ("outdoor_c", "wet_bulb_c", "ci_g_per_kwh", "demand"):
        seen = np.concatenate([getattr(r, name) for r in results])
        assert np.array_equal(seen[:10], getattr(drivers, name).values)
        assert np.array_equal(seen[10:], seen[:13])


# --- time step ----------------------------------------------------------------------------------


def test_energy_of_a_day_does_not_depend_on_the_time_step() -> None:
    totals = []
    for per_hour in (1, 4, 12):
        config = load_config("corrected", [f"simulation.steps_per_hour={per_hour}"])
        results = results_of([config], [Actions()] * (24 * per_hour), "f64")
        totals.append([np.sum([getattr(r, n) for r in results]) for n in ("it_kwh", "water_l")])
    np.testing.assert_allclose(totals, [totals[1]] * 3, rtol=0.01)


# --- snapshots ----------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("preset", ["corrected", "sustaindc"])
def test_a_snapshot_continues_to_the_bit(preset: str, precision: Precision, tmp_path: Path) -> None:
    configs = mixed_fleet(preset)
    actions = random_actions(120, configs, seed=9)
    with Simulator(configs, precision=precision) as sim:
        sim.reset()
        first = run(sim, actions[:60])
        snapshot = sim.state_dict()
        sim.save(tmp_path / "state.npz")
        expected = run(sim, actions[60:])
        sim.load_state_dict(snapshot)
        assert_same(expected, run(sim, actions[60:]))
        sim.reset()
        assert_same(first + expected, run(sim, actions))
    with Simulator(configs, precision=precision) as other:
        other.load(tmp_path / "state.npz")
        assert_same(expected, run(other, actions[60:]))
    assert expected[0].step == 60


def test_a_snapshot_is_a_copy() -> None:
    with Simulator(load_config("tiny"), drivers=short_drivers()) as sim:
        sim.reset()
        sim.step(Actions(LoadAction.DEFER, CoolAction.RAISE, BatteryAction.CHARGE))
        snapshot = sim.state_dict()
        kept = {name: np.copy(value) for name, value in snapshot.items()}
        sim.load_state_dict(snapshot)
        for _ in range(4):
            sim.step(Actions(LoadAction.DRAIN, CoolAction.LOWER, BatteryAction.DISCHARGE))
        assert all(np.array_equal(snapshot[name], value) for name, value in kept.items())


def test_snapshot_files_hold_no_pickle_and_leave_nothing_else(tmp_path: Path) -> None:
    with Simulator(load_config("tiny"), drivers=short_drivers()) as sim:
        sim.reset()
        sim.save(tmp_path / "state.npz")
        sim.save(tmp_path / "state.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]
    with np.load(tmp_path / "state.npz", allow_pickle=False) as file:
        assert {file[name].dtype.kind for name in file.files} <= set("fiU")


def broken(**changes: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """A snapshot with some entries replaced, or taken out where the value is None."""
    return lambda snapshot: {
        name: value for name, value in {**snapshot, **changes}.items() if value is not None
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (broken(queue=None), r"missing \['queue'\]"),
        (broken(extra=np.zeros(1)), r"unknown \['extra'\]"),
        (broken(version=np.array(99)), "version 99, expected"),
        (broken(fingerprint=np.array("0" * 64)), "made by another fleet"),
        (broken(setpoint_c=np.zeros(3)), r"setpoint_c is float64 \(3,\), expected float64 \(1,\)"),
        (broken(stored_kwh=np.zeros(1, np.float32)), "stored_kwh is float32"),
        (broken(cooling_run=np.zeros(1)), "cooling_run is float64"),
    ],
)
def test_a_wrong_snapshot_is_refused(
    change: Callable[[dict[str, Any]], dict[str, Any]], message: str
) -> None:
    with Simulator(load_config("tiny"), drivers=short_drivers()) as sim:
        sim.reset()
        sim.step()
        good = sim.state_dict()
        sim.step()
        before = sim.state_dict()
        with pytest.raises(SdcError, match=message):
            sim.load_state_dict(change(good))
        after = sim.state_dict()
        assert all(np.array_equal(before[name], after[name]) for name in before), "half loaded"


@pytest.mark.parametrize(
    ("change", "precision"),
    [
        (["servers.fan_reference_w=11"], "f32"),
        (["simulation.steps_per_hour=12"], "f32"),
        ([], "f64"),
        (None, "f32"),
    ],
    ids=["other config", "other time step", "other precision", "other order"],
)
def test_a_snapshot_of_another_simulator_is_refused(
    change: list[str] | None, precision: Precision
) -> None:
    configs = grouped_fleet() if change is None else [load_config("tiny")]
    others = configs[1:] + configs[:1] if change is None else [load_config("tiny", change)]
    drivers = short_drivers(len(configs))
    with Simulator(configs, drivers=drivers) as sim:
        sim.reset()
        snapshot = sim.state_dict()
    with (
        Simulator(others, drivers=drivers, precision=precision) as sim,
        pytest.raises(SdcError, match="made by another fleet, inputs or precision"),
    ):
        sim.load_state_dict(snapshot)


def test_a_file_that_is_no_snapshot_is_refused(tmp_path: Path) -> None:
    with Simulator(load_config("tiny"), drivers=short_drivers()) as sim:
        sim.reset()
        sim.save(tmp_path / "state.npz")
        whole = (tmp_path / "state.npz").read_bytes()
        np.save(tmp_path / "array.npy", np.zeros(3))
        array = (tmp_path / "array.npy").read_bytes()
        damaged = whole[:200] + bytes(60) + whole[260:]
        for content in (b"", b"no zip archive", whole[: len(whole) // 2], damaged, array):
            (tmp_path / "other.npz").write_bytes(content)
            with pytest.raises(SdcError, match=r"other\.npz: cannot be read as "):
                sim.load(tmp_path / "other.npz")
        with pytest.raises(SdcError, match=r"none\.npz: no such file"):
            sim.load(tmp_path / "none.npz")


# --- misuse -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "overrides", "action", "value", "message"),
    [
        ("tiny", [], "load", 1.5, r"load: 1\.5; valid is a finite number within -1\.\.1"),
        ("tiny", [], "cooling", np.inf, "cooling: inf"),
        ("tiny", [], "load", np.array([0.0, np.nan]), "load: nan"),
        ("tiny", [], "load", np.zeros(3), r"load: shape \(3,\), expected \(\) or \(2,\)"),
        ("tiny", [], "battery", np.zeros((2, 1)), r"battery: shape \(2, 1\)"),
        ("tiny", [], "load", CoolAction.LOWER, "load: CoolAction.LOWER is no LoadAction"),
        ("tiny", [], "battery", "charge", "battery: 'charge' is neither"),
        ("tiny", [], "cooling", [BatteryAction.IDLE] * 2, "cooling: .* is neither"),
        ("corrected", [], "fan", 1.0, "fan: given, but hvac.crac.flow_model is follow_servers"),
        ("corrected", [], "placement", np.ones(40), "workload.placement is uniform"),
        ("corrected", WEIGHTS, "placement", np.ones(7), r"shape \(7,\), expected \(40,\), one per"),
        ("corrected", WEIGHTS, "placement", -np.ones(40), "placement weight 0 is -1"),
        ("corrected", WEIGHTS, "placement", np.zeros(40), "all placement weights are 0"),
    ],
)
def test_a_wrong_action_is_refused_and_changes_nothing(
    preset: str, overrides: list[str], action: str, value: Any, message: str
) -> None:
    configs = make_configs(load_config(preset, overrides), count=2)
    with Simulator(configs, drivers=short_drivers(2)) as sim:
        sim.reset()
        sim.step()
        before = sim.state_dict()
        with pytest.raises(SdcError, match=message):
            sim.step(Actions(**{action: value}))
        after = sim.state_dict()
        assert all(np.array_equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("seed", [-1, 1.5, "7", True, 2**63])
def test_wrong_arguments_are_refused(seed: Any) -> None:
    with (
        Simulator(load_config("tiny"), drivers=short_drivers()) as sim,
        pytest.raises(ConfigError, match=r"valid is an integer of 0\.\.2\*\*63 - 1"),
    ):
        sim.reset(seed=seed)
    with pytest.raises(ConfigError, match="'f16': valid are f32 and f64"):
        Simulator(load_config("tiny"), precision="f16")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="drivers of 2 data centers for a fleet of 1"):
        Simulator(load_config("tiny"), drivers=short_drivers(2))


def test_steps_need_a_reset() -> None:
    with Simulator(load_config("tiny"), drivers=short_drivers()) as sim:
        for use in (sim.step, sim.state_dict, lambda: sim.state):
            with pytest.raises(RuntimeStateError, match="has not been reset"):
                use()
        with pytest.raises(RuntimeStateError, match="no step has been done"):
            sim.servers()


def test_a_closed_simulator_says_so() -> None:
    sim = Simulator(load_config("tiny"), drivers=short_drivers())
    sim.reset()
    snapshot = sim.state_dict()
    sim.close()
    sim.close()
    uses: tuple[Callable[[], object], ...] = (
        sim.reset,
        sim.step,
        sim.servers,
        lambda: sim.sizing,
        lambda: sim.load_state_dict(snapshot),
    )
    for use in uses:
        with pytest.raises(RuntimeStateError, match="is closed"):
            use()


@pytest.mark.parametrize("preset", ["tiny", "transient"])
def test_server_layers_belong_to_the_last_step(preset: str) -> None:
    config = load_config("tiny")
    if preset == "transient":
        config = load_config("corrected", ["simulation.thermal=transient"])
    with Simulator(config, drivers=short_drivers()) as sim:
        sim.reset()
        with pytest.raises(RuntimeStateError, match="no step has been done"):
            sim.servers()
        result = sim.step()
        layers = sim.servers()
        assert layers.power_w.shape == (sim.fleet.servers,)
        assert float(layers.power_w.sum(dtype=np.float64)) == pytest.approx(
            result.it_w[0], rel=1e-6
        )
        if preset == "tiny":
            assert layers.inlet_c.max() == result.inlet_max_c[0]
        snapshot = sim.state_dict()
        sim.load_state_dict(snapshot)
        with pytest.raises(RuntimeStateError, match="no step has been done"):
            sim.servers()
        sim.step()
        sim.reset()
        with pytest.raises(RuntimeStateError, match="no step has been done"):
            sim.servers()


# --- processes and memory -----------------------------------------------------------------------


def resident_mb() -> float:
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip("no /proc: resident memory cannot be read")
    return int(statm.read_text().split()[1]) * resource.getpagesize() / 1e6


def test_memory_does_not_grow_with_simulators_made_and_closed() -> None:
    configs = [load_config("tiny"), load_config("corrected")]
    drivers = short_drivers(steps=4)

    def cycle(i: int) -> None:
        with Simulator(configs[i % 2], drivers=drivers) as sim:
            sim.reset()
            sim.step()
            sim.servers()

    for i in range(12):
        cycle(i)
    gc.collect()
    before = resident_mb()
    for i in range(60):
        cycle(i)
    gc.collect()
    assert resident_mb() - before < 5.0


# --- inputs -------------------------------------------------------------------------------------


def test_drivers_follow_site_season_and_trace() -> None:
    configs = mixed_fleet()[:3]
    drivers = load_drivers(configs)
    table: F64 = drivers.outdoor_c.at(drivers.start)
    assert len(set(table)) == 3
    same = load_drivers([configs[0], configs[0]])
    assert np.array_equal(same.outdoor_c.offsets, [0, 0]), "one copy serves equal sites"
    july = load_drivers([configs[1]])
    assert july.start[0] == 181 * 96
    assert july.outdoor_c.at(july.start)[0] > table[2]


@pytest.mark.parametrize("preset", ["corrected", "paper", "sustaindc"])
def test_heat_indices_are_those_of_the_racks(preset: str) -> None:
    with Simulator(load_config(preset), drivers=short_drivers(), precision="f64") as sim:
        sim.reset()
        result = [sim.step() for _ in range(3)][-1]
    flow, supply_c = result.rack_airflow_m3s, result.supply_c[0]
    inlet = np.sum(flow * (result.rack_inlet_c - supply_c))
    outlet = np.sum(flow * (result.rack_outlet_c - supply_c))
    assert result.shi[0] == pytest.approx(inlet / outlet, rel=1e-6)
    rise_k = (outlet - inlet) / flow.sum()
    assert result.rti_pct[0] == pytest.approx(
        100.0 * (result.return_c[0] - supply_c) / rise_k, rel=1e-6
    )


def test_matrices_of_different_magnitude_are_told_apart(tmp_path: Path) -> None:
    path, found = tmp_path / "hall.npz", set()
    config = load_config(
        "corrected",
        [f"hall.recirculation.matrix_file={path}", "hall.recirculation.calibrate=none"],
    )
    for share in (0.005, 0.01):
        np.savez(path, R=np.full((20, 20), share))
        with Simulator(config, drivers=short_drivers()) as sim:
            found.add(sim.fingerprint())
    assert len(found) == 2
