"""Transient halls: against twin and differential equations, energy, time constants, memory."""

from __future__ import annotations

import warnings
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import reference_twin
from random_halls import (
    AS_FOUND,
    PRECISIONS,
    SMALL,
    Part,
    flat,
    fleet_of,
    own_conditions,
    own_part,
    parts,
    random_conditions,
    random_hall,
    random_halls,
)
from sdc_taichi import (
    Actions,
    DataCenterConfig,
    Drivers,
    SdcError,
    Simulator,
    build_fleet,
    drivers_from_arrays,
    load_config,
)
from sdc_taichi.config import apply_overrides
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import ChilledWater, Coil, Conditions, HallState, HallSums, Precision
from sdc_taichi.sim.sizing import air_j_per_m3_k
from sdc_taichi.types import F64

SEEDS = st.integers(0, 2**32 - 1)
TOLERANCE: dict[Precision, float] = {"f64": 1e-12, "f32": 1e-5}


def random_coil(rng: np.random.Generator, fleet: Fleet, setpoint_c: F64) -> Coil:
    """Plants that suffice and plants that do not, rooms that are and are not warmed."""
    servers = fleet.per_dc_servers()
    design_w = fleet.unit_design_m3s.sum() / fleet.size * 1.7e4
    return Coil(
        setpoint_c=setpoint_c,
        room_j=rng.choice([0.0, 3e3], fleet.size) * servers,
        room_j_per_k=2e3 * servers,
        limit_w=rng.choice([0.0, 0.5, 10.0], fleet.size) * design_w,
        fan_w_per_m3s=rng.uniform(400, 1000, fleet.size),
    )


def random_state(rng: np.random.Generator, fleet: Fleet, precision: Precision) -> HallState:
    """A memory that no steady state leaves behind."""
    real = np.float64 if precision == "f64" else np.float32
    assert fleet.air is not None
    groups = fleet.groups
    need_m3s = fleet.unit_design_m3s * rng.uniform(0.2, 1.2, fleet.units)
    return HallState(
        server_c=rng.uniform(22, 50, groups).astype(real),
        mixed_c=rng.uniform(20, 40, fleet.racks).astype(real),
        exhaust_c=(fleet.air.mix_weights.strength * rng.uniform(25, 45, fleet.racks)).astype(real),
        captured_m3s=rng.uniform(0, 1, fleet.racks).astype(real),
        need_m3s=need_m3s,
        # No unit of these halls lowers exhaust shares.
        plain_m3s=need_m3s,
        following=rng.uniform(0.2, 1.1, fleet.units),
        supply_excess_k=rng.uniform(0.0, 3.0, fleet.units),
        casing_c=rng.uniform(16, 40, fleet.units),
        return_air_c=rng.uniform(25, 40, fleet.size)[fleet.unit_dc],
        water_heat_j=np.zeros(fleet.size),
        tank_heat_j=np.zeros(fleet.size),
    )


def random_water(rng: np.random.Generator, fleet: Fleet) -> ChilledWater:
    """Water and tanks of any size, and pumps that fail."""
    servers = fleet.per_dc_servers()
    design_w = fleet.unit_design_m3s.sum() / fleet.size * 1.7e4
    return ChilledWater(
        carried_w=rng.choice([0.0, 0.7, 10.0], fleet.size) * design_w,
        j_per_k=rng.choice([0.0, 1e3, 1e4], fleet.size) * servers,
        tank_most_j=rng.choice([0.0, 3e4], fleet.size) * servers,
        tank_share=rng.choice([0.0, 0.5, 1.0], fleet.size),
    )


def twin_memory(
    fleet: Fleet, part: Part, state: HallState, room_j: float, dc: int
) -> reference_twin.Memory:
    assert fleet.air is not None
    counts = np.diff(fleet.server_offsets)[part.groups]
    return reference_twin.Memory(
        server_c=np.repeat(np.asarray(state.server_c, np.float64)[part.groups], counts),
        mixed_c=np.asarray(state.mixed_c, np.float64)[part.racks],
        given_c=(np.asarray(state.exhaust_c, np.float64) / fleet.air.mix_weights.strength)[
            part.racks
        ],
        captured_m3s=np.asarray(state.captured_m3s, np.float64)[part.racks],
        need_m3s=state.need_m3s[part.units],
        following=state.following[part.units],
        room_j=room_j,
        excess_k=state.supply_excess_k[part.units],
        casing_c=state.casing_c[part.units],
        return_c=float(state.return_air_c[part.units][0]),
    )


@pytest.mark.parametrize(("substeps", "precision"), [(1, "f64"), (4, "f32"), (15, "f64")])
@settings(phases=AS_FOUND, max_examples=4)
@given(seed=SEEDS)
def test_transient_halls_agree_with_the_twin(
    substeps: int, precision: Precision, seed: int
) -> None:
    rel = {"f64": 1e-10, "f32": 1e-4}[precision]
    configs, rng = random_halls(seed), np.random.default_rng(seed + 1)
    fleet, met = fleet_of(*configs), random_conditions(rng, configs)
    coil = random_coil(rng, fleet, met.unit_supply_c)
    before = random_state(rng, fleet, precision)
    sums, after = Hall(fleet, precision).advance(met, before, coil, 900.0, 900.0 / substeps)
    for i, part in enumerate(parts(configs, met)):
        found, left = reference_twin.advance(
            part.twin,
            twin_memory(fleet, part, before, coil.room_j[i], i),
            part.supply_c,
            part.load,
            low=part.low,
            high=part.high,
            running=part.running,
            powered=part.powered,
            breath=part.breath,
            room_j_per_k=coil.room_j_per_k[i],
            limit_w=coil.limit_w[i],
            fan_w_per_m3s=coil.fan_w_per_m3s[i],
            step_s=900.0,
            substeps=substeps,
        )
        own = twin_memory(fleet, part, after, sums.room_j[i], i)
        # Heat that flows in and out counts against what passes through.
        through = float(np.sum(found["outlet_m3k_s"])) * part.twin.air_j_per_m3_k
        through += coil.room_j[i] / 900.0
        for name, expected in found.items():
            where: Any = slice(i, i + 1)
            if name.startswith(("rack_", "unit_")):
                where = part.racks if name.startswith("rack_") else part.units
            scale = through if name in ("thermal_storage_w", "cooling_load_w", "coil_w") else 0.0
            if name == "inlet_m3k_s":
                scale = float(found["outlet_m3k_s"])
            if name in ("over_27_sum_k", "under_18_sum_k"):
                # What exceeds a limit inherits the absolute error of each inlet.
                scale = 0.01 * len(part.twin.rack)
            np.testing.assert_allclose(
                getattr(sums, name)[where], expected, rtol=rel, atol=rel * abs(scale) + 1e-9,
                err_msg=f"{configs[i].name} {name}",
            )  # fmt: skip
        for f in fields(reference_twin.Memory):
            # The recirculated air of a rack, in m3/s, is a small difference of large airflows.
            scale = {"room_j": 900.0 * through, "captured_m3s": 1e-3}.get(f.name, 0.0)
            np.testing.assert_allclose(
                getattr(own, f.name), getattr(left, f.name), rtol=rel, atol=rel * abs(scale) + 1e-9,
                err_msg=f"{configs[i].name} {f.name}",
            )  # fmt: skip


# --- against the differential equations ---------------------------------------------------------


def rates(part: Part, state: F64, supply_c: F64, capacity: F64) -> tuple[F64, reference_twin.Flows]:
    """Time derivatives of server and mix temperatures, every flow at its present temperature."""
    twin, air = part.twin, part.twin.air_j_per_m3_k
    server_c, mixed_c = np.split(state, [len(twin.rack)])
    following = np.ones(len(supply_c))
    for _ in range(60):
        ratio = following
        unit_share = twin.unit_shares[twin.rack]
        from_unit = (1.0 - twin.captured)[:, None] * unit_share * ratio
        inlet_c = (1.0 - from_unit.sum(axis=1)) * mixed_c[twin.rack] + from_unit @ supply_c
        cpu, fan, flow = twin.servers(inlet_c, part.load, part.powered, part.breath)
        moved = reference_twin.flows(twin, flow, part.low, part.high, ratio)
        following = moved.fresh_ratio
        if np.max(np.abs(following - ratio)) < 1e-13:
            break
    effectiveness = twin.config.servers.heat_exchange_effectiveness
    to_air = effectiveness * air * flow * (server_c - inlet_c)
    outlet_c = twin.per_rack(flow * inlet_c + (to_air + fan) / air) / twin.per_rack(flow)
    stirred = moved.unit.sum() / len(mixed_c) * air / twin.parcel_j_per_k
    through = np.maximum(moved.captured * air / twin.parcel_j_per_k, min(stirred, 1.0 / 128.0))
    given_c = mixed_c + part.breath * (outlet_c - mixed_c)
    mixing = through * (twin.weights @ given_c - mixed_c)
    return np.concatenate([(cpu - to_air) / capacity, mixing]), moved


@pytest.mark.parametrize("low", [1.0, 0.6], ids=["enough air", "too little air"])
def test_substeps_converge_to_the_differential_equations(low: float) -> None:
    rng = np.random.default_rng(6)
    config = random_hall(rng, "dc", (2, 3))
    fleet, units = build_fleet(config), config.hvac.crac.units
    supply_c, speed = np.full(units, 20.0), np.full(units, low)
    before, after = (
        Conditions(
            supply_c, np.array([u]), unit_low=speed, unit_high=speed,
            unit_running=np.ones(units),
        )
        for u in (0.2, 0.9)
    )  # fmt: skip
    hall = Hall(fleet, "f64")
    settled = hall.steady_state(before)
    part = parts([config], after)[0]
    capacity = reference_twin.heat_capacity_j_per_k(part.twin)
    counts = np.diff(fleet.server_offsets)
    state = np.concatenate([np.repeat(settled.server_c, counts), settled.mixed_c])
    change, _ = rates(parts([config], before)[0], state, supply_c, capacity)
    assert np.max(np.abs(change)) < 1e-9, "the hall was not settled"
    h = 3.0
    for _ in range(300):
        k1 = rates(part, state, supply_c, capacity)[0]
        k2 = rates(part, state + h / 2 * k1, supply_c, capacity)[0]
        k3 = rates(part, state + h / 2 * k2, supply_c, capacity)[0]
        k4 = rates(part, state + h * k3, supply_c, capacity)[0]
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    coil = Coil(supply_c, np.zeros(1), np.ones(1), np.full(1, 1e9), np.zeros(1))
    errors = []
    for substep_s in (60.0, 30.0, 15.0, 7.5):
        _, end = hall.advance(after, settled, coil, 900.0, substep_s)
        found = np.concatenate([np.repeat(end.server_c, counts), end.mixed_c])
        errors.append(np.max(np.abs(found - state)))
    assert np.max(np.abs(state[: len(part.load)] - np.repeat(settled.server_c, counts))) > 5
    assert errors[0] < 1.5
    # First order: what one substep does to the air, the servers learn in the next.
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert np.all((ratios > 1.6) & (ratios < 2.6)), errors


HEAVY_SERVERS = "servers.heat_capacity_kj_per_k=4.155"
"""Servers that take six minutes to warm."""


def breathing_supply_air(*overrides: str) -> DataCenterConfig:
    """Servers whose inlet is the supply air, whatever the others do."""
    return load_config("corrected", ["hall.supply_approach_k=0", HEAVY_SERVERS, *overrides])


@pytest.mark.parametrize("precision", PRECISIONS)
def test_servers_follow_the_exact_exponential_in_any_number_of_substeps(
    precision: Precision,
) -> None:
    config = breathing_supply_air()
    fleet, hall = fleet_of(config), Hall(fleet_of(config), precision)
    settled = hall.steady_state(Conditions(np.array([20.0]), np.array([0.1])))
    met = Conditions(np.array([20.0]), np.array([0.8]))
    coil = Coil(np.array([20.0]), np.zeros(1), np.ones(1), np.full(1, 1e9), np.zeros(1))
    ends = []
    for substeps in (1, 3, 15, 60):
        _, state = hall.advance(met, settled, coil, 900.0, 900.0 / substeps)
        ends.append(state.server_c.astype(np.float64))
    rel = {"f64": 1e-12, "f32": 3e-6}[precision]
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], rtol=rel)
    twin = reference_twin.calibrated(config)
    on = np.ones(20)
    cpu, _, flow = twin.servers(np.full(4000, 20.0), twin.load(0.8 * on), on, on)
    per_k = config.servers.heat_exchange_effectiveness * twin.air_j_per_m3_k * flow
    start = np.repeat(np.asarray(settled.server_c, np.float64), np.diff(fleet.server_offsets))
    final = 20.0 + cpu / per_k
    expected = final + (start - final) * np.exp(
        -900.0 * per_k / reference_twin.heat_capacity_j_per_k(twin)
    )
    found = np.repeat(ends[0], np.diff(fleet.server_offsets))
    np.testing.assert_allclose(found, expected, rtol=rel)
    assert np.all((expected > start + 1) & (expected < final - 1))


# --- energy -------------------------------------------------------------------------------------


def held_j(fleet: Fleet, state: HallState, room_j: F64) -> F64:
    """Heat in servers, recirculated air and room, from temperatures, (B,)."""
    twins = [reference_twin.calibrated(c) for c in fleet.configs]
    of_servers = np.concatenate([reference_twin.heat_capacity_j_per_k(t) for t in twins])
    capacity = np.add.reduceat(of_servers, fleet.server_offsets[:-1])
    per_group = capacity * np.asarray(state.server_c, np.float64)
    servers = np.add.reduceat(per_group, fleet.group_offsets[fleet.rack_offsets[:-1]])
    parcels = np.add.reduceat(np.asarray(state.mixed_c, np.float64), fleet.rack_offsets[:-1])
    per_parcel = np.array([t.parcel_j_per_k for t in twins])
    casings = fleet.unit_sums(0.3 * fleet.unit_design_m3s * state.casing_c) * air_j_per_m3_k(fleet)
    return np.asarray(servers + parcels * per_parcel + casings + room_j, dtype=np.float64)


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=6)
@given(seed=SEEDS)
def test_heat_that_comes_in_stays_or_leaves(precision: Precision, seed: int) -> None:
    configs, rng = random_halls(seed), np.random.default_rng(seed + 1)
    fleet = fleet_of(*configs)
    state = random_state(rng, fleet, precision)
    hall = Hall(fleet, precision)
    room_j = np.zeros(fleet.size)
    for _ in range(3):
        met = random_conditions(rng, configs)
        coil = replace(random_coil(rng, fleet, met.unit_supply_c), room_j=room_j)
        coil = replace(coil, water=random_water(rng, fleet))
        before = held_j(fleet, state, room_j)
        sums, state = hall.advance(met, state, coil, 900.0, 60.0)
        room_j = sums.room_j
        fans = coil.fan_w_per_m3s * sums.cubed_flow_m3s
        generated = sums.cpu_w + sums.it_fan_w + fans
        kept = held_j(fleet, state, room_j) - before
        # Against all heat that moves, for some halls are idle.
        moved = np.abs(generated) + np.abs(sums.coil_w) + np.abs(kept) / 900.0
        left = np.abs((generated - sums.coil_w) * 900.0 - kept)
        largest = np.maximum(900.0 * moved, np.abs(before) * {"f64": 1e-3, "f32": 0.1}[precision])
        assert np.max(left / largest) < TOLERANCE[precision]


def test_a_warmer_setpoint_than_the_room_loses_no_heat() -> None:
    # Air that comes back colder than the setpoint must be warmed by something.
    config = load_config(
        "corrected", ["simulation.thermal=transient", "hvac.setpoint.initial_c=16"]
    )
    with Simulator(config, drivers=constant_drivers(demand=0.0), precision="f64") as sim:
        sim.reset()
        fleet, before = sim.fleet, sim.state
        for step in range(12):
            result = sim.step(Actions(cooling=7.0 if step == 2 else 0.0))
            kept_kwh = (
                held_j(fleet, memory_of(sim), sim.state.room_heat_kwh * 3.6e6)
                - held_j(fleet, memory_of(before), before.room_heat_kwh * 3.6e6)
            ) / 3.6e6
            in_kwh = (result.it_w + result.crac_fan_w) * 0.25e-3
            out_kwh = result.heat_removed_w * 0.25e-3
            assert kept_kwh[0] == pytest.approx((in_kwh - out_kwh)[0], abs=1e-9), f"step {step}"
            before = sim.state


def memory_of(source: Any) -> HallState:
    """The hall's part of the state of a simulator."""
    state = source.state if isinstance(source, Simulator) else source
    return HallState(**{f.name: getattr(state, f.name) for f in fields(HallState)})


def constant_drivers(size: int = 1, demand: Any = 0.7) -> Drivers:
    series = np.broadcast_to(np.asarray(demand, np.float64), (size, np.size(demand)))
    steps = series.shape[1]
    return drivers_from_arrays(
        np.full((size, steps), 20.0), np.full((size, steps), 14.0),
        np.full((size, steps), 300.0), series.copy(),
    )  # fmt: skip


@pytest.mark.parametrize("precision", PRECISIONS)
def test_an_uncooled_hall_warms_by_its_power_over_its_heat_capacity(precision: Precision) -> None:
    rng = np.random.default_rng(8)
    config = flat(random_hall(rng, "dc", (3, 4)))
    fleet, hall = fleet_of(config), Hall(fleet_of(config), precision)
    units = np.ones(fleet.units)
    met = Conditions(
        20 * units, np.array([0.6]), unit_low=0.3 * units, unit_high=0.3 * units,
        unit_running=0 * units,
    )  # fmt: skip
    state, room_j = hall.steady_state(replace(met, unit_low=units, unit_high=units)), np.zeros(1)
    servers = fleet.per_dc_servers()
    coil = Coil(20 * units, room_j, 2e3 * servers, np.full(1, 1e9), np.full(1, 800.0))
    means = []
    for _ in range(24):
        sums, state = hall.advance(met, state, replace(coil, room_j=room_j), 900.0, 60.0)
        room_j = sums.room_j
        assert sums.coil_w[0] == 0.0
        means.append((sums.inlet_mean_c[0], sums.outlet_mean_c[0], sums.supply_c[0]))
    parcels = reference_twin.calibrated(config).parcel_j_per_k * fleet.racks
    capacity = servers * (1e3 * config.server_heat_capacity_kj_per_k + 2000.0) + parcels
    capacity = capacity + 0.3 * fleet.unit_design_m3s.sum() * air_j_per_m3_k(fleet)
    expected = 900.0 * (sums.cpu_w + sums.it_fan_w) / capacity
    rel = {"f64": 1e-6, "f32": 1e-3}[precision]
    np.testing.assert_allclose(np.diff(means, axis=0)[-1], np.full(3, expected[0]), rtol=rel)


# --- in the long run ----------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=5)
@given(seed=SEEDS)
@example(seed=119144)  # 270 steps
def test_constant_conditions_end_in_the_quasi_steady_state(precision: Precision, seed: int) -> None:
    rng = np.random.default_rng(seed)
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))])
    fleet, hall = build_fleet(config), Hall(build_fleet(config), precision)
    met = replace(random_conditions(rng, [config]), powered=None)
    # A rack with little air of its own takes days.
    breath = rng.choice([0.5, 1.0], fleet.racks)
    met = replace(met, unit_running=np.ones(fleet.units), rack_airflow=breath)
    expected = hall.solve(met)
    other = replace(met, utilisation=1.0 - met.utilisation, rack_load=None, group_load=None)
    state = hall.steady_state(other)
    coil = Coil(
        met.unit_supply_c, np.zeros(1), np.ones(1), np.full(1, 1e12), np.zeros(1)
    )  # fmt: skip
    # Some halls take days, until a step changes less than they may be off in the end.
    change_k = np.inf
    for _ in range(3000):
        before = state
        sums, state = hall.advance(met, state, coil, 900.0, 100.0)
        change_k = max(
            np.max(np.abs(getattr(state, name) - getattr(before, name)))
            for name in ("server_c", "mixed_c")
        )
        if change_k <= {"f64": 1e-9, "f32": 1e-5}[precision]:
            break
    else:
        raise AssertionError(f"still changes by {change_k} K in a step")
    rel = {"f64": 1e-7, "f32": 1e-4}[precision]
    through = float(expected.cpu_w[0] + expected.it_fan_w[0]) + 1.0
    for f in fields(HallSums):
        if f.name in ("hottest_rack", "hottest_server", "coil_w", "units_load_w", "room_j"):
            continue
        scale = {
            "thermal_storage_w": through,
            # Each server's inlet errs on its own.
            "over_27_sum_k": float(fleet.servers),
            "under_18_sum_k": float(fleet.servers),
        }.get(f.name, 1.0)
        np.testing.assert_allclose(
            getattr(sums, f.name), getattr(expected, f.name), rtol=rel, atol=30 * rel * scale,
            err_msg=f.name,
        )  # fmt: skip
    assert sums.coil_w[0] == pytest.approx(through - 1.0, rel=rel)


def test_a_failed_unit_is_felt_over_steps_and_forgotten_again() -> None:
    event = "[{kind: crac_down, unit: 0, start_h: 2, duration_h: 1.5}]"
    base = load_config("corrected", ["simulation.thermal=transient", "hvac.crac.units=2"])
    runs = []
    for config in (base, apply_overrides(base, [f"events.scheduled={event}"])):
        with Simulator(config, drivers=constant_drivers(), precision="f64") as sim:
            sim.reset()
            runs.append(np.array([sim.step().rack_inlet_c for _ in range(48)]))
    warmer = runs[1] - runs[0]
    assert np.array_equal(runs[0][:8], runs[1][:8])
    down, mean = slice(8, 14), warmer.mean(axis=1)
    assert np.all(np.diff(mean[down]) > 0), "warms step by step"
    assert mean[8] < 0.6 * mean[13]
    assert np.all(warmer[13] > 0.5), "every rack feels it"
    assert np.all(np.diff(mean[14:30]) < 0), "recovers step by step"
    assert mean[14] > 0.05
    assert np.max(np.abs(warmer[-1])) < 1e-3


@pytest.mark.parametrize("servers", [3, 7, 20, 200])
def test_air_in_a_dark_hall_stays_between_what_it_was(servers: int) -> None:
    # Few servers have a room with little heat capacity around them, which the air may outweigh.
    config = load_config(
        "corrected",
        ["hall.rows=1", "hall.racks_per_row=1", "hall.supply_approach_k=3",
         "hall.return_approach_k=-3", f"hall.servers_per_rack={servers}",
         "servers.power_w=[300, 60]", "simulation.thermal=transient", "battery.capacity_kwh=0",
         "events.scheduled=[{kind: grid_outage, start_h: 1, duration_h: 2}]"],
    )  # fmt: skip
    with Simulator(config, drivers=constant_drivers(), precision="f64") as sim:
        hottest = float(sim.reset().server_c.max()) + 1e-6
        for step in range(20):
            result = sim.step()
            assert 18.0 - 1e-6 <= result.supply_c[0] <= hottest, step
            assert 18.0 - 1e-6 <= result.inlet_max_c[0] <= hottest, step
        assert result.inlet_max_c[0] < 25


# --- server layers ------------------------------------------------------------------------------


def test_server_layers_are_those_of_the_end_of_the_step() -> None:
    config = load_config("corrected", ["simulation.thermal=transient", HEAVY_SERVERS])
    demand = np.repeat([0.2, 0.9], [2, 80])[None]
    with Simulator(config, drivers=constant_drivers(demand=demand), precision="f64") as sim:
        sim.reset()
        rack = sim.fleet.server_rack()
        for step in range(82):
            before = sim.state.server_c.copy() if step == 2 else None
            result, layers = sim.step(), None
            if before is not None:
                layers = sim.servers()
                # Power leaves the servers later than it enters them.
                air = float(air_j_per_m3_k(sim.fleet)[0])
                warming = layers.outlet_c - layers.inlet_c
                share = air * result.rack_airflow_m3s.sum() * np.mean(warming) / result.it_w[0]
                assert share < 0.9
        layers = sim.servers()
        warming = layers.outlet_c - layers.inlet_c
        flow = layers.power_w / (air_j_per_m3_k(sim.fleet)[0] * warming)
        moved = np.bincount(rack, flow)
        np.testing.assert_allclose(moved, result.rack_airflow_m3s, rtol=1e-6)
        for name in ("inlet_c", "outlet_c"):
            mean = np.bincount(rack, flow * getattr(layers, name)) / moved
            np.testing.assert_allclose(mean, getattr(result, f"rack_{name}"), rtol=1e-6)
        power = np.bincount(rack, layers.power_w)
        np.testing.assert_allclose(power, result.rack_power_w, rtol=1e-6)


# --- batches and memory -------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=5)
@given(seed=SEEDS)
def test_a_transient_hall_of_a_batch_equals_itself_alone(precision: Precision, seed: int) -> None:
    configs, rng = random_halls(seed), np.random.default_rng(seed + 1)
    fleet, met = fleet_of(*configs), random_conditions(rng, configs)
    coil = random_coil(rng, fleet, met.unit_supply_c)
    batch = Hall(fleet, precision)
    settled = batch.steady_state(replace(met, powered=None))
    together, after = batch.advance(met, settled, coil, 900.0, 60.0, shortest_s=5.0)
    layers = batch.servers()
    for i, (config, part) in enumerate(zip(configs, parts(configs, met), strict=True)):
        alone = Hall(fleet_of(config), precision)
        of_units = ["need_m3s", "plain_m3s", "following", "supply_excess_k"]
        of_units += ["casing_c", "return_air_c"]
        of_dc = "water_heat_j", "tank_heat_j"
        where = {"server_c": part.groups} | dict.fromkeys(of_dc, slice(i, i + 1))
        where |= dict.fromkeys(of_units, part.units)
        own = own_conditions(met, configs, i)
        start = alone.steady_state(replace(own, powered=None))
        one = slice(i, i + 1)
        sums, end = alone.advance(
            own,
            start,
            Coil(
                coil.setpoint_c[part.units], coil.room_j[one], coil.room_j_per_k[one],
                coil.limit_w[one], coil.fan_w_per_m3s[one],
            ),
            900.0,
            60.0,
            shortest_s=5.0,
        )  # fmt: skip
        for state, other in ((start, settled), (end, after)):
            for f in fields(state):
                found = getattr(other, f.name)[where.get(f.name, part.racks)]
                assert np.array_equal(getattr(state, f.name), found), (config.name, f.name)
        for name, expected in own_part(together, configs, i).items():
            assert np.array_equal(getattr(sums, name), expected), (config.name, name)
        for f in fields(layers):
            found = getattr(layers, f.name)[part.servers]
            assert np.array_equal(getattr(alone.servers(), f.name), found), (config.name, f.name)


# --- chilled water and buffer tanks -------------------------------------------------------------

TRIP_H = 0.25
WATER = {
    "none": ["hvac.chilled_water.volume_l_per_kw=0"],
    "loop": [],
    "mixed": ["hvac.chilled_water.tank_m3=20", "hvac.chilled_water.tank=mixed"],
    "stratified": ["hvac.chilled_water.tank_m3=20"],
}


def tripped_chillers(*events: str, names: Any = (*WATER,), steps: int = 90) -> Any:
    """Minutes of halls at full load whose chillers trip; results by quantity, (T, B)."""
    configs = [
        load_config(
            "corrected",
            ["simulation.thermal=transient", "simulation.steps_per_hour=60", "hvac.crac.units=4",
             "hvac.tower.economiser=false", *WATER[name], f"name={name}",
             f"events.scheduled=[{', '.join(events)}]"],
        )
        for name in names
    ]  # fmt: skip
    results = []
    with Simulator(configs, drivers=constant_drivers(len(configs), 1.0), precision="f64") as sim:
        sim.reset()
        for _ in range(steps):
            results.append(sim.step().per_dc())
        capacity_kwh = sim.sizing.chilled_water.stratified_tank_j / 3.6e6
    return {name: np.array([r[name] for r in results]) for name in results[0]}, capacity_kwh


def loses(kind: str, duration_h: float = 0.25, share: float = 0.0) -> str:
    return f"{{kind: {kind}, start_h: {TRIP_H}, duration_h: {duration_h}, share: {share}}}"


def test_water_takes_up_the_heat_of_a_chiller_that_trips_and_returns_it() -> None:
    run, tank_kwh = tripped_chillers(loses("chiller_derate"), steps=150)
    # After five minutes, the more water a hall has the colder it is; a stratified tank keeps it.
    inlet_c, water_c = run["inlet_mean_c"], run["chilled_water_c"]
    assert np.all(np.diff(inlet_c[20]) < -1.0)
    assert inlet_c[20, 3] < inlet_c[14, 3] + 0.1
    np.testing.assert_allclose(water_c[:15], water_c[[0]].repeat(15, axis=0), atol=1e-9)
    assert np.all(water_c[20, [1, 2]] > water_c[0, [1, 2]] + 1.5)
    assert water_c[20, 3] == pytest.approx(water_c[0, 3], abs=1e-9)
    # Warm water fills the tank, and the loop warms only then.
    assert tank_kwh[:3].tolist() == [0.0, 0.0, 0.0]
    assert run["tank_heat_kwh"][:, 3].max() == pytest.approx(tank_kwh[3])
    assert np.all(np.diff(run["tank_heat_kwh"][15:24, 3]) > 0)
    # All that is generated is removed or stored, and the plant gives back what was stored.
    rise_kwh = np.diff(run["room_heat_kwh"], axis=0)
    kept_w = run["it_w"] + run["crac_fan_w"] - run["heat_removed_w"] - run["thermal_storage_w"]
    np.testing.assert_allclose(rise_kwh, kept_w[1:] / 6e4, atol=1e-7)
    stored_kwh = run["water_heat_kwh"] + run["tank_heat_kwh"]
    assert np.all(stored_kwh[29, 1:] > 10.0)
    assert np.all(run["heat_removed_w"][31, 1:] > run["cooling_load_w"][31, 1:] * 1.01)
    assert np.all(run["room_heat_kwh"][-1] < 0.7 * run["room_heat_kwh"].max(axis=0))
    assert np.all(np.abs(run["room_heat_kwh"][-1, 2:]) < 1e-6)


def test_pumps_run_while_water_and_tank_take_up_the_heat() -> None:
    run, _ = tripped_chillers(loses("chiller_derate"), steps=22)
    pump_w, before_w = run["chilled_pump_w"], run["chilled_pump_w"][10]
    assert np.all(run["heat_removed_w"][16:22] == 0.0)
    # A tank supplies water at the setpoint, and so needs the flow of before.
    np.testing.assert_allclose(pump_w[16:18, 3], before_w[3], rtol=0.02)
    # Without a tank the water warms, and the valves of the coils open.
    assert np.all(pump_w[20, :3] > 1.5 * before_w[:3])
    np.testing.assert_allclose(run["hvac_w"][17, 3], (pump_w + run["crac_fan_w"])[17, 3])


def test_water_stands_still_while_its_pumps_are_down() -> None:
    run, _ = tripped_chillers(
        loses("chiller_derate", 0.1), loses("pump_down", 0.1).replace("0.25", "0.35"), steps=40
    )
    water_kwh = run["water_heat_kwh"] + run["tank_heat_kwh"]
    assert np.all(water_kwh[20, 1:] > 1.0)
    np.testing.assert_allclose(water_kwh[26], water_kwh[22], atol=1e-12)
    assert np.all(np.abs(run["heat_removed_w"][22:26]) < 1e-6)
    assert np.all(run["inlet_mean_c"][26] > run["inlet_mean_c"][22] + 1.0)


def test_a_tank_that_is_cut_off_takes_up_nothing() -> None:
    run, tank_kwh = tripped_chillers(
        loses("chiller_derate"), loses("tank_down"), names=("loop", "mixed", "stratified"), steps=30
    )
    np.testing.assert_allclose(
        run["inlet_mean_c"], run["inlet_mean_c"][:, [0]].repeat(3, axis=1), atol=1e-6
    )
    half, _ = tripped_chillers(loses("chiller_derate"), loses("tank_down", share=0.5), steps=30)
    assert half["tank_heat_kwh"][:, 3].max() == pytest.approx(0.5 * tank_kwh[2])


def test_halls_with_water_equal_themselves_alone_and_after_a_saved_state() -> None:
    names = ("stratified", "loop", "mixed")
    together, _ = tripped_chillers(loses("chiller_derate", 0.2), names=names, steps=45)
    for i, name in enumerate(names):
        alone, _ = tripped_chillers(loses("chiller_derate", 0.2), names=(name,), steps=45)
        for quantity, values in alone.items():
            assert np.array_equal(values[:, 0], together[quantity][:, i]), (name, quantity)
    config = load_config(
        "corrected",
        ["simulation.thermal=transient", "hvac.chilled_water.tank_m3=20",
         f"events.scheduled=[{loses('chiller_derate', 1.0)}]"],
    )  # fmt: skip
    with Simulator(config, drivers=constant_drivers()) as sim:
        sim.reset()
        for _ in range(3):
            sim.step()
        saved = sim.state_dict()
        assert saved["tank_heat_j"][0] > 0.0
        expected = sim.step().inlet_max_c[0]
        sim.reset()
        sim.load_state_dict(saved)
        assert sim.step().inlet_max_c[0] == expected
        old = {n: v for n, v in saved.items() if n != "tank_heat_j"} | {"version": np.array(3)}
        with pytest.raises(SdcError, match="snapshot: version 3, expected 6"):
            sim.load_state_dict(old)


MILD = {"water_cooled": (20.0, 16.0), "air_cooled": (13.0, 8.0), "air_side": (24.0, 14.0)}
"""Dry and wet bulb at which free cooling alone does not hold the setpoint, by plant, in C."""
CUTS = {"chiller": [], "and half of the pumps": [loses("pump_down", 9.0, 0.5)],
        "and a CRAC unit": [loses("crac_down", 9.0).replace(", share: 0.0", ", unit: 0")],
        "and a tank": []}  # fmt: skip


@pytest.mark.parametrize("plant", MILD)
def test_free_cooling_alone_gives_all_that_warm_water_and_air_let_it(plant: str) -> None:
    configs = [
        load_config(
            "corrected",
            ["simulation.thermal=transient", "simulation.steps_per_hour=60", "hvac.crac.units=4",
             f"hvac.plant={plant}", f"name=dc{i}", "hvac.sizing.design_wet_bulb_c=25.6",
             "hvac.sizing.design_outdoor_c=35", *(WATER["stratified"] if "tank" in name else []),
             f"events.scheduled=[{', '.join([loses('chiller_derate', 9.0), *more])}]"],
        )
        for i, (name, more) in enumerate(CUTS.items())
    ]  # fmt: skip
    outdoor_c, wet_bulb_c = (np.full((len(configs), 1), x) for x in MILD[plant])
    one = np.ones_like(outdoor_c)
    drivers = drivers_from_arrays(outdoor_c, wet_bulb_c, 300.0 * one, 0.6 * one)
    with Simulator(configs, drivers=drivers, precision="f64") as sim:
        sim.reset()
        design, results = sim.sizing.water_side, [sim.step() for _ in range(120)]
    result, removed_w = results[-1], np.array([r.heat_removed_w for r in results])
    # Water and air become as warm as it takes to carry the whole load without a chiller.
    np.testing.assert_allclose(removed_w[-1], result.cooling_load_w, rtol=0.03)
    np.testing.assert_allclose(result.chiller_w, 0.0, atol=1e-6)
    assert np.all(result.supply_c > result.setpoint_c + 1.0)
    assert np.all(result.inlet_max_c < 45.0)
    # No heat passes from cold to warm.
    free_w, water_c = result.economiser_w, result.chilled_water_c
    if plant == "water_cooled":
        coldest_c = result.condenser_water_c + design.exchanger_approach_k
        np.testing.assert_allclose(water_c[[0, 3]], coldest_c[[0, 3]], atol=0.4)
    elif plant == "air_cooled":
        return_k = design.chilled_water_range_k * result.heat_removed_w / design.cooling_w
        over_k = water_c + return_k - result.outdoor_c
        full_w = design.cooling_w + design.pump_heat_share * design.chilled_pump_w
        np.testing.assert_allclose(free_w[[0, 3]], (full_w * over_k / 14.0)[[0, 3]], rtol=0.03)
    else:
        over_k = result.return_c - result.outdoor_c
        flow_w_k = design.air_j_per_m3_k * result.crac_flow_m3s
        np.testing.assert_allclose(free_w, flow_w_k * over_k, rtol=0.03)


def test_quasi_steady_halls_ignore_their_water_and_say_so() -> None:
    found = []
    for overrides in WATER.values():
        config = load_config("corrected", overrides)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fleet = build_fleet(config)
        assert any("tank acts only" in str(w.message) for w in caught) == (
            config.hvac.chilled_water.tank_m3 > 0
        )
        with Simulator(fleet, drivers=constant_drivers()) as sim:
            sim.reset()
            result = sim.step()
            assert result.water_heat_kwh[0] == result.tank_heat_kwh[0] == 0.0
            found.append(float(result.hvac_w[0]))
    assert found == [found[0]] * 4


def test_dense_halls_warm_faster_without_cooling() -> None:
    # Dense racks are not heavier than others, and hold no more air.
    event = "[{kind: crac_down, start_h: 0, duration_h: 1}]"
    rates = []
    for server_w in (25.0, 50.0, 138.5):
        config = load_config(
            "corrected",
            ["simulation.thermal=transient", "simulation.steps_per_hour=60",
             f"servers.power_w=[{server_w}, {server_w / 5}]", f"events.scheduled={event}"],
        )  # fmt: skip
        assert config.server_heat_capacity_kj_per_k * 200 == pytest.approx(
            min(30e-3 * server_w * 200, 410.0)
        )
        with Simulator(config, drivers=constant_drivers(demand=1.0), precision="f64") as sim:
            sim.reset()
            inlet_c = [sim.step().inlet_mean_c[0] for _ in range(10)]
        rates.append((inlet_c[9] - inlet_c[2]) / 7)
    assert rates[0] < rates[1] < rates[2]
    assert 1.5 * rates[0] < rates[2] < 3.0 * rates[0]


@pytest.mark.parametrize("tank", ["stratified", "mixed"])
@pytest.mark.parametrize("tank_down", [False, True])
def test_chiller_and_fans_have_no_jumps_after_a_restart_of_the_chiller(
    tank: str, tank_down: bool
) -> None:
    """The plant cools warm water and tank, in weather near the limits of its operation."""
    # Among others, tank just full, plant just short of the heat, economiser just of use.
    wet_bulb_c = np.concatenate([start + 0.002 * np.arange(5) for start in (4.598, 6.186, 10.064)])
    steps = 24
    events = ["{kind: chiller_derate, start_h: 0.0666667, duration_h: 0.1, share: 0}"]
    if tank_down:
        events.append("{kind: tank_down, start_h: 0.0833333, duration_h: 0.1333333, share: 0}")
    config = load_config("corrected", [
        "simulation.thermal=transient", "simulation.steps_per_hour=60",
        "hvac.sizing.design_wet_bulb_c=25.6", "hvac.sizing.design_outdoor_c=33",
        "workload.max_utilisation=1", "hvac.chilled_water.tank_m3=5",
        f"hvac.chilled_water.tank={tank}", f"events.scheduled=[{', '.join(events)}]",
    ])  # fmt: skip
    same = np.ones((len(wet_bulb_c), steps))
    wet = same * wet_bulb_c[:, None]
    drivers = drivers_from_arrays(wet + 3.0, wet, 300.0 * same, 0.8 * same)
    with Simulator([config] * len(wet_bulb_c), drivers=drivers, precision="f64") as sim:
        sim.reset()
        results = [sim.step() for _ in range(steps)]
    # Pumps are left out: they give their full flow for as long as the plant needs it.
    power_w = np.array([r.chiller_w + r.tower_fan_w + r.crac_fan_w for r in results])
    power_w = power_w.reshape(steps, 3, 5)
    jumps = np.abs(np.diff(power_w, axis=2)) / power_w[:, :, 1:]
    assert np.max(jumps) < 0.02
