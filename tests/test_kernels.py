"""The hall kernels against their NumPy twin, and what must hold to the bit."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import reference_twin
from random_halls import fleet_of
from sdc_taichi import DataCenterConfig, RuntimeStateError, Simulator, build_fleet, load_config
from sdc_taichi.config import config_from_dict
from sdc_taichi.errors import SdcError
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.sim.hall_solver import SERIAL_GROUPS, Hall
from sdc_taichi.sim.hall_state import Coil, Conditions, HallSums, Precision
from sdc_taichi.types import F64, ServerLayers

# Data centers of any make-up move odd amounts of air.
pytestmark = pytest.mark.filterwarnings("ignore::sdc_taichi.errors.OddInputWarning")

OUTLETS = ("server", "rack", "released")
EXPONENTS = (1.0, 2.5, 3.0)
TOLERANCE: dict[Precision, float] = {"f64": 1e-12, "f32": 1e-5}

SEEDS = st.integers(0, 2**32 - 1)


def preset_values(name: str) -> dict[str, Any]:
    return load_config(name).model_dump(mode="json")


def random_rack(rng: np.random.Generator) -> list[dict[str, float]]:
    """Groups of one rack; no load weight reaches twice their mean."""
    groups = []
    for _ in range(int(rng.integers(1, 5))):
        full = float(rng.uniform(80, 500))
        groups.append(
            {
                "count": int(rng.integers(1, 20)),
                "full_w": full,
                "idle_w": float(rng.uniform(0, 0.6) * full),
                "load_weight": float(rng.uniform(0.8, 1.3)),
                "inlet_offset_k": float(rng.uniform(-0.5, 1.5)),
            }
        )
        if rng.integers(2):
            groups[-1] |= {"full_airflow_m3s": float(rng.uniform(0.08, 0.3))}
            groups[-1] |= {"fan_w": float(rng.uniform(0, 40))}
    return groups


def random_config(
    rng: np.random.Generator, name: str, outlet_model: str, exponent: float
) -> DataCenterConfig:
    """A data center of any size and make-up."""
    values = preset_values("corrected")
    hall, servers = values["hall"], values["servers"]
    hall["inlet_model"] = "approach"
    hall["most_face_velocity_m_s"] = None
    if rng.integers(2):
        servers |= preset_values("sustaindc")["servers"]
        hall["supply_approach_limits_k"] = [3.8, 5.3]
    hall["rows"], hall["racks_per_row"] = (int(n) for n in rng.integers(1, 5, 2))
    racks = hall["rows"] * hall["racks_per_row"]
    hall["supply_approach_k"] = rng.uniform(1, 7, racks).tolist()
    hall["return_approach_k"] = rng.uniform(-5, 0, racks).tolist()
    hall["air_density_kg_m3"] = float(rng.uniform(1.0, 1.25)) if rng.integers(2) else None
    values["site"]["location"] = str(rng.choice(["NY", "AZ", "GA"]))
    servers["outlet_model"], servers["fan_power_exponent"] = outlet_model, exponent
    servers["fan_reference_ratio"] = float(rng.uniform(0.5, 1.5))
    servers["fan_full_airflow_m3s"] = float(rng.uniform(0.08, 0.16))
    kind = rng.integers(3)
    if kind < 2:
        servers["groups"] = [random_rack(rng) for _ in range(racks if kind == 0 else 1)]
        servers["power_w"] = None
    else:
        full = rng.uniform(80, 500, racks)
        servers["power_w"] = np.stack([full, full * rng.uniform(0, 0.6, racks)], axis=1).tolist()
        hall["servers_per_rack"] = rng.integers(1, 80, racks).tolist()
    config = config_from_dict({**values, "name": name}, name)
    if rng.integers(3):
        return config
    nameplate_w = sum(g.count * g.full_w for rack in config.rack_groups() for g in rack)
    hall["capacity_mw"] = nameplate_w * float(rng.uniform(1, 1.5)) / 1e6
    return config_from_dict({**values, "name": name}, name)


def random_fleet(
    seed: int, outlet_model: str = "server", exponent: float = 3.0
) -> tuple[list[DataCenterConfig], F64, F64]:
    """A ragged fleet, supply air and load."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 7))
    configs = [random_config(rng, f"dc{i}", outlet_model, exponent) for i in range(count)]
    load = rng.choice([0.0, 1.0, *rng.uniform(0, 1, 4)], count)
    return configs, rng.uniform(17, 28, count), load


def solve(
    configs: list[DataCenterConfig], supply_c: F64, load: F64, precision: Precision
) -> HallSums:
    """Sums per data center and rack of a fleet."""
    fleet = fleet_of(*configs)
    return Hall(fleet, precision).solve(Conditions(supply_c[fleet.unit_dc], load))


def solve_servers(
    configs: list[DataCenterConfig], supply_c: F64, load: F64, precision: Precision
) -> tuple[HallSums, dict[str, Any]]:
    """Sums and server layers of a fleet."""
    fleet = fleet_of(*configs)
    hall = Hall(fleet, precision)
    sums, layers = hall.solve(Conditions(supply_c[fleet.unit_dc], load)), hall.servers()
    return sums, {f.name: getattr(layers, f.name) for f in fields(layers)}


def assert_close(found: Any, expected: Any, rel: float, name: str) -> None:
    np.testing.assert_allclose(found, expected, rtol=rel, atol=0, err_msg=name)


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize("outlet_model", OUTLETS)
@pytest.mark.parametrize("exponent", EXPONENTS)
@settings(max_examples=8)
@given(seed=SEEDS)
def test_sums_agree_with_the_twin(
    precision: Precision, outlet_model: str, exponent: float, seed: int
) -> None:
    configs, supply_c, load = random_fleet(seed, outlet_model, exponent)
    sums = solve(configs, supply_c, load, precision)
    twin = reference_twin.evaluate(configs, supply_c, load)
    for name, expected in twin.dcs.items():
        assert_close(getattr(sums, name), expected, TOLERANCE[precision], name)
    for name, expected in twin.racks.items():
        assert_close(getattr(sums, f"rack_{name}"), expected, TOLERANCE[precision], f"rack {name}")


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize("outlet_model", OUTLETS)
@pytest.mark.parametrize("seed", [1, 2])
def test_servers_agree_with_the_twin(precision: Precision, outlet_model: str, seed: int) -> None:
    configs, supply_c, load = random_fleet(seed, outlet_model)
    _, servers = solve_servers(configs, supply_c, load, precision)
    twin = reference_twin.evaluate(configs, supply_c, load)
    for name, expected in twin.servers.items():
        assert_close(servers[name], expected, TOLERANCE[precision], f"server {name}")


@pytest.mark.parametrize("field", ["full_w", "count", "inlet_offset_k", "load_weight"])
def test_twin_sees_a_change_of_any_group_value(field: str) -> None:
    rng = np.random.default_rng(5)
    config = random_config(rng, "dc", "server", 3.0).model_dump(mode="json")
    config["servers"] |= {"groups": [random_rack(rng) + random_rack(rng)], "power_w": None}
    config["hall"]["capacity_mw"] = None
    supply, load = np.array([22.0]), np.array([0.6])
    sums = solve([config_from_dict(config)], supply, load, "f64")
    group = config["servers"]["groups"][0][1]
    group[field] += 1 if field == "count" else 1e-6
    twin = reference_twin.evaluate([config_from_dict(config)], supply, load)
    same = np.allclose(sums.rack_cpu_w, twin.racks["cpu_w"], rtol=1e-12, atol=0)
    assert not same, f"{field} has no effect on CPU power"


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("load", [0.0, 0.35, 0.8, 1.0])
def test_load_weights_conserve_the_work_of_a_rack(seed: int, load: float) -> None:
    # With power proportional to load and no fan power, a server's power is its share of the work.
    rng = np.random.default_rng(seed)
    values = preset_values("tiny")
    values["servers"] |= {
        "cpu_power_points": None,
        "cpu_power_ratio_lb": [0.0, 1.0],
        "cpu_power_ratio_ub": [0.0, 1.0],
        "fan_reference_w": 0.0,
        "groups": [
            [{**g, "full_w": 100.0, "idle_w": 0.0, "fan_w": None} for g in random_rack(rng)]
            for _ in range(4)
        ],
    }
    config = config_from_dict(values)
    sums, servers = solve_servers([config], np.array([20.0]), np.array([load]), "f64")
    share = servers["power_w"] / 100.0
    assert np.all((share >= 0.0) & (share <= 1.0))
    counts = [sum(g.count for g in rack) for rack in config.rack_groups()]
    assert_close(np.asarray(sums.rack_cpu_w) / 100.0, load * np.array(counts), 1e-12, "work")
    assert share.sum() == pytest.approx(load * sum(counts), rel=1e-12)
    assert (np.ptp(share) > 0) == (0 < load < 1)


def results_equal(one: HallSums, other: HallSums) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))


def part_of(sums: HallSums, configs: list[DataCenterConfig], index: int) -> HallSums:
    """The sums of one data center of a fleet."""
    fleet = fleet_of(*configs)
    whole = np.arange(fleet.size + 1)
    start: dict[str, Any] = {"rack": fleet.rack_offsets, "unit": fleet.unit_offsets}
    found = {}
    for f in fields(sums):
        kind = f.name.split("_")[0]
        begin, end = start.get(kind, whole)[index : index + 2]
        found[f.name] = getattr(sums, f.name)[begin:end]
    return HallSums(**found)


@cache
def hall_of_many_racks(racks: int) -> DataCenterConfig:
    """Enough racks and servers for every thread to get slices of both kernels."""
    rng = np.random.default_rng(racks)
    values = preset_values("large")
    values["hall"] |= {
        "rows": 1,
        "racks_per_row": racks,
        "supply_approach_k": rng.uniform(3, 6, racks).tolist(),
        "servers_per_rack": rng.integers(20, 60, racks).tolist(),
    }
    values["servers"]["power_w"] = [[f, 0.1 * f] for f in rng.uniform(200, 500, racks).tolist()]
    return config_from_dict(values | {"name": f"racks-{racks}"})


def assert_alone(
    configs: list[DataCenterConfig],
    supply_c: F64,
    load: F64,
    precision: Precision,
    chosen: Iterable[int],
) -> None:
    """Data centers of a batch have the bits that they have alone, of sums and servers."""
    fleet = fleet_of(*configs)
    batch, layers = solve_servers(configs, supply_c, load, precision)
    first = fleet.server_offsets[fleet.group_offsets[fleet.rack_offsets]]
    for i in chosen:
        alone, own = solve_servers([configs[i]], supply_c[i : i + 1], load[i : i + 1], precision)
        assert results_equal(alone, part_of(batch, configs, i)), i
        for name, values in layers.items():
            assert np.array_equal(own[name], values[first[i] : first[i + 1]]), (i, name)


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize("outlet_model", OUTLETS)
@settings(max_examples=6)
@given(seed=SEEDS)
def test_a_data_center_of_a_batch_equals_itself_alone(
    precision: Precision, outlet_model: str, seed: int
) -> None:
    exponent = EXPONENTS[seed % len(EXPONENTS)]
    configs, supply_c, load = random_fleet(seed, outlet_model, exponent)
    assert_alone(configs, supply_c, load, precision, range(len(configs)))


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_unlike_data_centers_of_a_batch_equal_themselves_alone(precision: Precision) -> None:
    """Halls of any size; fan exponents of their own; more halls than one thread computes."""
    rng = np.random.default_rng(11)
    sizes = [hall_of_many_racks(n) for n in (1, 63, 64, 65, 500, 2, 1100)]
    exponents = [random_config(rng, f"dc{e}", "server", e) for e in (3.0, 1.0, 2.5)]
    copies = [load_config("corrected")] * 90
    assert fleet_of(*copies).groups > SERIAL_GROUPS
    for configs in (sizes, exponents, copies):
        size = len(configs)
        supply_c, load = rng.uniform(16, 23, size), rng.uniform(0.1, 1, size)
        assert_alone(configs, supply_c, load, precision, range(0, size, max(1, size // 3)))


def digest_of_large_halls() -> str:
    """Fingerprint of everything the kernels compute for large halls, in single precision."""
    config = hall_of_many_racks(1500)
    digest = hashlib.sha256()
    # Air couples the racks of these, in one task or several by the number of threads.
    coupled = build_fleet(
        [
            load_config(
                "corrected",
                [f"name=dc{rows}", f"hall.rows={rows}", "hall.racks_per_row=30",
                 "hall.supply_approach_k=5", "hall.return_approach_k=-3",
                 "servers.power_w=[200, 20]"],
            )
            for rows in (2, 5, 9, 40)
        ]
    )  # fmt: skip
    met = Conditions(
        np.full(4, 20.0), np.full(4, 0.5),
        rack_load=np.random.default_rng(0).uniform(0.3, 0.9, coupled.racks),
    )  # fmt: skip
    coil = Coil(met.unit_supply_c, np.zeros(4), np.full(4, 1e9), np.full(4, 1e12), np.zeros(4))
    hall = Hall(coupled, "f32")
    steady, state = hall.solve(met), hall.steady_state(met)
    sums, servers = solve_servers([config], np.array([19.0]), np.array([0.55]), "f32")
    for found in (steady, *hall.advance(met, state, coil, 900.0, 300.0), sums):
        for f in fields(found):
            digest.update(np.ascontiguousarray(getattr(found, f.name)).tobytes())
    for values in servers.values():
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    code = (
        "import test_kernels as t; from sdc_taichi.kernels.compiler import runtime;"
        "print(runtime.ensure_started(), t.digest_of_large_halls())"
    )
    threads = 3 if runtime.ensure_started() == 1 else 1
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=os.path.dirname(__file__),
        env={**os.environ, "SDC_TAICHI_THREADS": str(threads)},
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    assert done.stdout.split() == [str(threads), digest_of_large_halls()]


@settings(max_examples=20)
@given(supply_c=st.floats(16, 27), load=st.floats(0, 0.99), warmer_k=st.floats(0, 1), seed=SEEDS)
def test_warmer_air_and_more_load_never_lower_power(
    supply_c: float, load: float, warmer_k: float, seed: int
) -> None:
    config = random_config(np.random.default_rng(seed), "dc", "server", 3.0)
    hall = Hall(build_fleet(config), "f64")
    cool = hall.solve(Conditions(np.array([supply_c]), np.array([load])))
    warm = hall.solve(Conditions(np.array([supply_c + warmer_k]), np.array([load])))
    busy = hall.solve(Conditions(np.array([supply_c]), np.array([min(1.0, load + 0.01)])))
    assert np.all(warm.rack_cpu_w >= cool.rack_cpu_w)
    assert np.all(warm.rack_fan_w >= cool.rack_fan_w)
    assert np.all(busy.cpu_w >= cool.cpu_w * (1 - 1e-12))


def test_server_layers_need_a_solve() -> None:
    hall = Hall(build_fleet(load_config("tiny")), "f32")
    with pytest.raises(RuntimeStateError, match="no step has been done yet"):
        hall.servers()
    hall.solve(Conditions(np.array([20.0]), np.array([0.5])))
    layers = hall.servers()
    assert layers.power_w.shape == (12,)
    assert hall.servers(into=layers) is layers
    hall.discard_last_step()
    with pytest.raises(RuntimeStateError, match="no step has been done yet"):
        hall.servers()


@pytest.mark.parametrize(
    ("supply_c", "any_hot", "any_cold"),
    [(20.0, False, False), (17.0, False, True), (22.0, True, False), (26.0, True, False)],
)
def test_degrees_beyond_the_recommended_range_are_those_of_the_servers(
    supply_c: float, any_hot: bool, any_cold: bool
) -> None:
    """Also where a single rack of a block is the only one beyond."""
    values = preset_values("corrected")
    approach_k = [2.0] * 11
    approach_k[5], approach_k[10] = 0.5, 6.0
    values["hall"] |= {"rows": 1, "racks_per_row": 11, "inlet_model": "approach"}
    values["hall"] |= {"supply_approach_k": approach_k, "return_approach_k": -3.0}
    values["servers"] |= {"power_w": [150, 10]}
    hall = Hall(build_fleet(config_from_dict(values)), "f64")
    sums = hall.solve(Conditions(np.array([supply_c]), np.array([0.5])))
    inlet_c = hall.servers().inlet_c
    for found, beyond_k, is_any in (
        (sums.over_27_sum_k, inlet_c - 27.0, any_hot),
        (sums.under_18_sum_k, 18.0 - inlet_c, any_cold),
    ):
        assert (found[0] > 0.0) == is_any
        np.testing.assert_allclose(found[0], np.maximum(beyond_k, 0.0).sum(), rtol=1e-12)


@pytest.mark.parametrize("outlet_model", ["server", "rack"])
@pytest.mark.parametrize("racks", [12, 16])
def test_what_comes_out_belongs_to_the_caller(racks: int, outlet_model: str) -> None:
    """Another step leaves it alone, and layers do not follow what is written to it."""
    values = preset_values("corrected")
    values["hall"] |= {"rows": 1, "racks_per_row": racks, "inlet_model": "approach"}
    values["hall"] |= {"supply_approach_k": 5.0, "return_approach_k": -3.0}
    values["servers"] |= {"outlet_model": outlet_model, "power_w": [150, 10]}
    hall = Hall(build_fleet(config_from_dict(values)), "f32")
    first = hall.solve(Conditions(np.array([20.0]), np.array([0.5])))
    names = [f.name for f in fields(first) if f.name.startswith("rack_")]
    before = {name: getattr(first, name).copy() for name in names}
    second = hall.solve(Conditions(np.array([22.0]), np.array([0.9])))
    layers = hall.servers()
    for name in names:
        assert np.array_equal(getattr(first, name), before[name]), name
        assert not np.any(getattr(second, name) == before[name]), name
        getattr(second, name)[:] = 0.0
    for f in fields(layers):
        assert np.array_equal(getattr(hall.servers(), f.name), getattr(layers, f.name)), f.name


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_layers_may_lie_anywhere_in_memory(precision: Precision) -> None:
    configs, supply_c, load = random_fleet(9)
    fleet = build_fleet(configs)
    hall = Hall(fleet, precision)
    hall.solve(Conditions(supply_c[fleet.unit_dc], load))
    expected = hall.servers()
    dtype = np.float32 if precision == "f32" else np.float64
    for shift in range(1, 4):
        given: list[Any] = [np.zeros(fleet.servers + 9, dtype) for _ in range(3)]
        hall.servers(ServerLayers(*(layer[shift : shift + fleet.servers] for layer in given)))
        for layer, name in zip(given, ("inlet_c", "outlet_c", "power_w"), strict=True):
            values = layer[shift : shift + fleet.servers]
            assert np.array_equal(values, getattr(expected, name)), name
            assert not layer[:shift].any()
            assert not layer[shift + fleet.servers :].any()


LAYOUTS = {
    "whole vectors": [[8, 16, 40]] * 8,
    "odd counts": [[7, 9, 1, 23]] * 9,
    "within a vector": [[1, 2], [2], [1, 1, 1], [3], [9], [2, 6], [5, 11]],
    "one and many": [[1] * 8, [8], [1, 1, 6], [40, 1], [1] * 16, [3, 1, 20]],
    "each its own": [[1] * 16] * 11,
    "each its own, odd": [[1] * n for n in (11, 1, 8, 9, 16, 3, 24, 7, 2, 5)],
}


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize("outlet_model", ["server", "rack"])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("ahead", [0, 8, 13])
def test_layers_of_any_layout_agree_with_the_twin(
    precision: Precision, outlet_model: str, layout: str, ahead: int
) -> None:
    """Runs that begin, end and lie in vectors of servers in every way, in blocks full or not."""
    rng = np.random.default_rng(12)
    values = preset_values("corrected")
    values["hall"] |= {"inlet_model": "approach", "supply_approach_k": 5.0, "rows": 1}
    values["hall"]["return_approach_k"] = -3.0
    values["servers"] |= {"outlet_model": outlet_model, "fan_full_airflow_m3s": 0.04}
    values["servers"]["power_w"] = None
    configs: list[DataCenterConfig] = []
    for racks in ([[ahead]] if ahead else []), LAYOUTS[layout], [[1, 5]]:
        if racks:
            values["hall"]["racks_per_row"] = len(racks)
            values["servers"]["groups"] = [
                [
                    {
                        "count": count,
                        "full_w": float(rng.uniform(80, 500)),
                        "idle_w": float(rng.uniform(0, 40)),
                        "load_weight": float(rng.uniform(0.8, 1.3)),
                        "inlet_offset_k": float(rng.uniform(-0.5, 1.5)),
                    }
                    for count in counts
                ]
                for counts in racks
            ]
            configs.append(config_from_dict(values | {"name": f"dc{len(configs)}"}))
    supply_c, load = np.linspace(18, 22, len(configs)), np.linspace(0.2, 0.8, len(configs))
    fleet = build_fleet(configs)
    hall = Hall(fleet, precision)
    hall.solve(Conditions(supply_c[fleet.unit_dc], load))
    layers = hall.servers()
    first, counts = fleet.server_offsets[:-1], np.diff(fleet.server_offsets)
    for name, expected in reference_twin.evaluate(configs, supply_c, load).servers.items():
        found = getattr(layers, name)
        assert_close(found, expected, TOLERANCE[precision], name)
        assert np.array_equal(found, np.repeat(found[first], counts)), name
    assert np.array_equal(hall.group_inlets(), layers.inlet_c[first])


def test_the_first_of_alike_racks_is_the_hottest() -> None:
    # Without power all racks take in supply air, but for the rounding of their mixes.
    overrides = ["servers.cpu_power_points=[[20,0,1]]", "servers.fan_reference_w=0"]
    config = load_config("corrected", ["servers.power_w=[300,0]", *overrides])
    sums = Hall(fleet_of(config), "f64").solve(Conditions(np.array([18.0]), np.zeros(1)))
    assert sums.hottest_rack[0] == 0


CRAC_AND_RACK_FAIL = (
    "events.scheduled=[{kind: crac_down, unit: 0, start_h: 0, duration_h: 1},"
    "{kind: rack_fan_failure, rack: 3, start_h: 0, duration_h: 1, share: 0.2},"
    "{kind: grid_outage, start_h: 0.5, duration_h: 1}]"
)


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["hvac.crac.units=2", "protection.ashrae_class=A1", CRAC_AND_RACK_FAIL],
        ["hall.servers_per_rack=12", "hall.height_zones=12", "workload.placement=fill"],
    ],
    ids=["default", "events", "own groups"],
)
def test_the_hottest_outlet_of_a_rack_is_that_of_its_hottest_server(overrides: list[str]) -> None:
    with Simulator(load_config("corrected", overrides), precision="f64") as sim:
        sim.reset(seed=1)
        first_server = sim.fleet.server_offsets[sim.fleet.group_offsets[:-1]]
        for _ in range(5):
            result = sim.step()
            hottest = np.maximum.reduceat(sim.servers().outlet_c, first_server)
            assert_close(result.rack_outlet_max_c, hottest, 1e-12, "hottest outlet")


def test_groups_that_a_rack_has_not_do_not_count_for_its_hottest_outlet() -> None:
    """Loads per group of what lies behind a rack's groups are those of the next rack."""
    fleet = build_fleet(load_config("tiny"))
    hall = Hall(fleet, "f64")
    groups = np.diff(fleet.group_offsets)
    assert groups[0] < groups[1]
    load = np.zeros(fleet.groups)
    load[fleet.group_offsets[1]] = 1.0
    sums = hall.solve(Conditions(np.array([20.0]), np.array([0.2]), group_load=load))
    first_server = fleet.server_offsets[fleet.group_offsets[:-1]]
    hottest = np.maximum.reduceat(hall.servers().outlet_c, first_server)
    assert_close(sums.rack_outlet_max_c, hottest, 1e-12, "hottest outlet")


def test_layers_that_do_not_fit_are_refused() -> None:
    fleet = build_fleet(load_config("tiny"))
    hall = Hall(fleet, "f32")
    hall.solve(Conditions(np.array([20.0]), np.array([0.5])))
    good = [np.zeros(fleet.servers, np.float32) for _ in range(2)]
    wrong: list[Any] = [
        good[0][1:],
        np.zeros(fleet.servers),
        np.zeros(2 * fleet.servers, np.float32)[::2],
        np.frombuffer(bytes(4 * fleet.servers), np.float32),
    ]
    for layer in wrong:
        with pytest.raises(SdcError, match="layer power_w: float"):
            hall.servers(ServerLayers(good[0], good[1], layer))
    assert not wrong[-1].any()


def test_air_beyond_any_number_leaves_no_layers() -> None:
    hall = Hall(build_fleet(load_config("tiny")), "f32")
    hall.solve(Conditions(np.array([20.0]), np.array([0.5])))
    with pytest.raises(SdcError, match="beyond any number"):
        hall.solve(Conditions(np.array([3e38]), np.array([0.5])))
    with pytest.raises(RuntimeStateError, match="no step has been done"):
        hall.servers()


def test_conditions_of_another_size_are_refused() -> None:
    hall = Hall(build_fleet([load_config("tiny", [f"name={name}"]) for name in "ab"]), "f32")
    one = np.array([20.0])
    with pytest.raises(SdcError, match=r"unit_supply_c has shape \(1,\); valid is \(2,\)"):
        hall.solve(Conditions(one, np.full(2, 0.5)))
    with pytest.raises(SdcError, match=r"powered has shape \(1,\); valid is \(8,\)"):
        hall.solve(Conditions(np.full(2, 20.0), np.full(2, 0.5), powered=one))
