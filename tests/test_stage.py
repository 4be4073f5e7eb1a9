"""Compiled stages against the same functions in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sdc_taichi import Simulator, drivers_from_arrays, load_config
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.compiler.stage import COPIED_UP_TO, SERIAL_UP_TO, CompiledStage
from sdc_taichi.plant import workload
from sdc_taichi.plant.chiller import CHILLERS
from sdc_taichi.sim.crac_units import UnitAir
from sdc_taichi.sim.facility import Facility, StepInputs
from sdc_taichi.types import F64

N = 37


@pytest.fixture(autouse=True, scope="module")
def started() -> None:
    runtime.ensure_started()


def compiled(function: Callable[..., Any], **given: F64) -> dict[str, F64]:
    size = len(next(iter(given.values())))
    return CompiledStage(lambda **x: {"y": function(**x)}, size)(**given)


WEIGHTS = np.linspace(0.5, 2.0, N)
ODD = np.arange(N) % 2 == 1
ALIKE = np.full(N, 1.0 / 3.0), np.full(N, 0.1)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: x + 2.0 * y - 1.0,
        lambda x, y: x / (y + 3.0),
        lambda x, y: -x * WEIGHTS + y,
        lambda x, y: np.where(ALIKE[1] > x, y * ALIKE[0], x),
        lambda x, y: np.maximum(x, y) * np.minimum(x, 0.25),
        lambda x, y: np.clip(x, -0.5, y),
        lambda x, y: np.where((x > y) & ~(y >= 0.5), x, np.where(x <= 0.0, y, 7.0)),
        lambda x, y: np.where(ODD | (x < y), x, y),
        lambda x, y: np.where(np.equal(x, y), 1.0, 0.0),
        lambda x, y: x**2 + y**3 + (y + 3.0) ** -3.0,
        lambda x, y: np.sqrt(y + 2.0) + np.exp(-x),
        lambda x, y: np.floor(8.0 * x) + np.ceil(8.0 * y),
        lambda x, y: np.round(x, 2) + np.rint(3.0 * y),
        lambda x, y: np.broadcast_arrays(x * y, 1.0)[0],
    ],
)
def test_every_operation_as_in_numpy(function: Callable[..., Any]) -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-1.0, 1.0, (2, N))
    y[::5] = x[::5]
    expected = function(x, y)
    np.testing.assert_allclose(compiled(function, x=x, y=y)["y"], expected, rtol=1e-14, atol=1e-15)


def test_halves_are_rounded_to_even() -> None:
    x = np.array([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 3.5, 0.49999999999999994])
    assert np.array_equal(compiled(lambda x: np.rint(x), x=x)["y"], np.rint(x))


def test_numbers_keep_all_digits() -> None:
    third = 1.0 / 3.0
    assert compiled(lambda x: x + third, x=np.zeros(1))["y"][0] == third


def test_an_entry_is_the_same_alone_and_among_many() -> None:
    """Few entries are computed by one thread, many by all."""
    size = 2 * SERIAL_UP_TO
    x = np.random.default_rng(0).uniform(0.1, 9.0, size)

    def stage(x: Any) -> Any:
        shared = np.where(np.floor(x) > 4.0, 1.1 * x, np.exp(-x))
        return shared + x**3 / (2.0 + np.sqrt(x)) - 0.3 * x * x

    together = compiled(stage, x=x)["y"]
    alone = [compiled(stage, x=x[i : i + 1])["y"][0] for i in range(0, size, 97)]
    assert np.array_equal(alone, together[::97])


@pytest.mark.parametrize("size", [4, COPIED_UP_TO + 1])
def test_results_are_new_arrays_and_inputs_stay(size: int) -> None:
    stage = CompiledStage(lambda x: {"same": x, "twice": 2.0 * x}, size)
    given = np.arange(float(size))
    x = given.copy()
    first = stage(x=x)
    second = stage(x=x + 1.0)
    rows = stage.rows(x=x + 2.0)
    assert np.array_equal(x, given)
    assert np.array_equal(first["twice"], 2.0 * given)
    assert np.array_equal(second["same"], given + 1.0)
    assert np.array_equal(rows, [given + 2.0, 2.0 * given + 4.0])
    assert not np.shares_memory(first["same"], x)


def test_other_arguments_than_those_of_the_first_call_are_an_error() -> None:
    stage = CompiledStage(lambda x, y: {"sum": x + y}, 2)
    stage(x=np.zeros(2), y=np.ones(2))
    with pytest.raises(TypeError, match=r"arguments \['y', 'x'\]"):
        stage(y=np.zeros(2), x=np.ones(2))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: x if x > 0 else -x, "cannot branch on values"),
        (lambda x: np.sin(x), "sin: cannot be compiled"),
        (lambda x: np.cumsum(x), "cumsum: cannot be compiled"),
        (lambda x: np.add.reduce(x), "only plain calls"),
        (lambda x: x**0.5, "only whole numbers"),
        (lambda x: (x > 0.0) + (x > 1.0), "truth values cannot be mixed"),
        (lambda x: np.minimum(x > 0.0, x > 1.0), "truth values cannot be mixed"),
        (lambda x: x & (x > 0.0), "truth values cannot be mixed"),
        (lambda x: np.where(x, 1.0, 2.0), "truth values cannot be mixed"),
        (lambda x: (x > 0.0) & True, "only finite numbers"),
        (lambda x: x + np.inf, "only finite numbers"),
        (lambda x: x + np.zeros(5), r"constant of shape \(5,\), expected \(3,\)"),
    ],
)
def test_what_cannot_be_compiled_is_an_error(function: Callable[..., Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        compiled(function, x=np.ones(3))


def random_inputs(facility_of: Simulator, rng: np.random.Generator, n: int) -> dict[str, Any]:
    """Anything that a step may meet, with every branch of the models among it."""
    sized = facility_of.sizing

    def some(low: float, high: float) -> F64:
        return rng.uniform(low, high, n)

    setpoint_c, flow_m3s = some(14.0, 27.0), sized.crac_flow_m3s * some(0.3, 1.0)
    supply_c = setpoint_c + some(0.0, 3.0) * (rng.random(n) < 0.3)
    it_w = sized.it_w * some(0.0, 1.1)
    inlet_m3k_s = flow_m3s * some(0.0, 5.0)
    return {
        "state": SimpleNamespace(
            stored_kwh=sized.battery_kwh * rng.choice([0.0, 0.01, 0.5, 0.99, 1.0], n),
            room_heat_kwh=some(0.0, 50.0) * (rng.random(n) < 0.3),
            water_heat_j=some(0.0, 1e8),
            tank_heat_j=some(0.0, 1e8),
        ),
        "commands": SimpleNamespace(battery_command=rng.choice([-1.0, -0.3, 0.0, 0.5, 1.0], n)),
        "surroundings": SimpleNamespace(
            outdoor_c=some(-25.0, 45.0),
            wet_bulb_c=some(-26.0, 29.0),
            ci_g_per_kwh=some(0.0, 900.0),
            price_per_kwh=some(0.0, 0.5),
            powered=rng.choice([0.0, 0.4, 1.0], n),
            grid_up=rng.choice([0.0, 1.0], n),
            pump_share=rng.choice([0.0, 0.5, 1.0], n),
            outdoor_units=rng.choice([0.0, 0.5, 1.0], n),
            chiller_share=rng.choice([0.0, 0.5, 1.0], n),
            no_unit_down=(rng.random(n) < 0.8).astype(np.float64),
        ),
        "supply": SimpleNamespace(
            plant_setpoint_c=setpoint_c,
            water_setpoint_c=setpoint_c - rng.choice([0.0, 2.0], n),
            fan_speed=some(0.3, 1.0),
            coil_share=some(0.3, 1.0),
            coil_limit_w=it_w * some(0.5, 1.5),
        ),
        "air": SimpleNamespace(
            cpu_w=0.9 * it_w,
            it_fan_w=0.1 * it_w,
            it_airflow_m3s=sized.it_airflow_m3s * some(0.3, 1.1),
            over_27_sum_k=some(0.0, 100.0),
            under_18_sum_k=some(0.0, 100.0),
            inlet_m3k_s=inlet_m3k_s,
            outlet_m3k_s=inlet_m3k_s + it_w / 1210.0,
            supply_c=supply_c,
            outlet_mean_c=supply_c + some(5.0, 20.0),
            units_flow_m3s=flow_m3s,
            units_return_c=supply_c + some(0.0, 20.0),
            cubed_flow_m3s=flow_m3s * some(0.1, 1.0),
            units_load_w=it_w * some(0.8, 1.2),
            coil_w=it_w * some(0.8, 1.2),
            most_warmed_k=some(0.0, 8.0),
            water_j=some(0.0, 1e8),
            tank_j=some(0.0, 1e8),
            room_j=some(-1e6, 1e8),
        ),
    }


# Every chiller, and every other choice of models beside one of them: each kernel takes seconds to
# compile.
FACILITIES = {
    "centrifugal_vsd": [],
    "carnot": ["simulation.thermal=transient"],
    "eir_york": ["hvac.crac.capacity_kw=650", "hvac.total_of=[chiller,crac_fan]"],
    "electric_water_cooled": [
        "hvac.water.model=paper", "battery.model=paper", "hvac.chiller.coil_valves=false"
    ],
    "electric_air_cooled": ["hvac.plant=air_side"],
    "eir_air_cooled": ["hall.inlet_model=approach", "hvac.crac.flow_model=controlled"],
    "constant_cop": [
        "hvac.water.model=mass_balance", "hvac.tower.economiser=false",
        "hall.inlet_model=approach", "hvac.crac.flow_model=constant",
    ],
}  # fmt: skip
OF_PRESETS = {"sustaindc": "released", "paper": "paper"}


def test_facilities_have_every_chiller() -> None:
    assert {*FACILITIES, *OF_PRESETS.values()} == {*CHILLERS}
    for preset, chiller in OF_PRESETS.items():
        assert load_config(preset).hvac.chiller_in_use == chiller


@pytest.mark.parametrize(
    ("preset", "given", "event_free"),
    [
        *(
            ("corrected", [f"hvac.chiller.model={name}", *values], i % 2 == 0)
            for i, (name, values) in enumerate(FACILITIES.items())
        ),
        ("corrected", ["simulation.thermal=transient"], True),
        ("sustaindc", [], False),
        ("paper", [], True),
    ],
    ids=str,
)
def test_facility_as_in_numpy(preset: str, given: list[str], event_free: bool) -> None:
    rng, n = np.random.default_rng(7), 200
    year = [20.0, 30.0], [15.0, 20.0], [300.0, 200.0], [0.5, 0.6]
    drivers = drivers_from_arrays(*([column] * n for column in year))
    with Simulator([load_config(preset, given)] * n, drivers=drivers) as sim:
        facility = Facility(sim.fleet, sim.sizing, event_free=event_free)
        inputs = random_inputs(sim, rng, n)
    plant_inputs = {name: inputs[name] for name in ("surroundings", "supply")}
    air = inputs["air"]
    plant_inputs["air"] = UnitAir(air.units_return_c, air.units_flow_m3s, air.most_warmed_k)

    def step(**stages: Any) -> dict[str, F64]:
        return facility.step(StepInputs(**stages))

    pairs: list[tuple[Any, dict[str, Any]]] = [
        (step, inputs),
        (facility.removable_w, plant_inputs),
    ]
    for stage, read in pairs:
        expected, found = stage(**read), CompiledStage(stage, n)(**read)
        assert list(found) == list(expected)
        for name, values in found.items():
            # Differences of large numbers lose digits that both ways round differently.
            lost = 1e-9 + 1e-12 * np.max(np.abs(expected[name]))
            np.testing.assert_allclose(values, expected[name], rtol=1e-10, atol=lost, err_msg=name)


@pytest.mark.parametrize("model", workload.MODELS)
def test_work_as_in_numpy(model: str) -> None:
    rng, n = np.random.default_rng(11), 300
    waiting = rng.uniform(0.0, 400.0, n) * (rng.random(n) < 0.8)
    inputs = {
        "demand": rng.uniform(0.0, 1.0, n),
        "command": rng.choice([-1.0, -0.4, 0.0, 0.7, 1.0], n),
        "waiting": np.rint(waiting),
        "due": np.rint(waiting * rng.choice([0.0, 0.3, 1.0], n)),
        "max_utilisation": rng.choice([0.5, 0.9, 1.0], n),
        "flexible_share": rng.uniform(0.0, 1.0, n),
        "queue_limit": rng.choice([500.0, workload.UNLIMITED_TASKS], n),
    }

    def decide(**x: F64) -> dict[str, F64]:
        return vars(workload.MODELS[model].step(workload.WorkPoint(**x)))

    expected = decide(**inputs)
    for name, values in CompiledStage(decide, n)(**inputs).items():
        np.testing.assert_allclose(values, expected[name], rtol=1e-13, atol=1e-12, err_msg=name)
