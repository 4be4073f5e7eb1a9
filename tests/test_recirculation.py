"""Recirculating halls: against their NumPy twin, and what must hold for every layout and load."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import reference_twin
from sdc_taichi import (
    ConfigError,
    DataCenterConfig,
    RuntimeStateError,
    SdcError,
    build_fleet,
    load_config,
)
from sdc_taichi.config import config_from_dict
from sdc_taichi.hall.mix_weights import DENSE_RACKS, layout_weights
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.sim.hall_solver import MOST_SWEEPS, Conditions, Hall, HallSums, Precision
from sdc_taichi.types import F64, ServerLayers

SEEDS = st.integers(0, 2**32 - 1)
# A seed that fails is no simpler than another, so none is looked for.
AS_FOUND = (Phase.explicit, Phase.generate)
PRECISIONS: tuple[Precision, ...] = ("f64", "f32")
TOLERANCE: dict[Precision, float] = {"f64": 1e-12, "f32": 1e-5}

SMALL = ((1, 1), (1, 4), (2, 3), (3, 2), (4, 5), (5, 3), (8, 8))
MERGED = ((5, 14), (9, 8))
"""More racks than are kept whole, in rows that are summed whole."""
LONG = ((1, 70), (2, 66))
"""Rows that are cut where their racks are out of reach."""


def random_values(
    rng: np.random.Generator, name: str, shape: tuple[int, int], *, even: bool = False
) -> dict[str, Any]:
    """Plain values of a hall of any measures and make-up; ``even`` for racks that are all alike."""
    values = load_config("corrected").model_dump(mode="json")
    hall, servers, crac = values["hall"], values["servers"], values["hvac"]["crac"]
    racks = shape[0] * shape[1]
    hall["rows"], hall["racks_per_row"] = shape
    hall["layout"] = {
        "rack_pitch_m": float(rng.uniform(0.5, 0.9)),
        "rack_depth_m": float(rng.uniform(0.8, 1.3)),
        "rack_height_m": float(rng.uniform(1.8, 2.4)),
        "cold_aisle_m": float(rng.uniform(0.9, 2.4)),
        "hot_aisle_m": float(rng.uniform(0.9, 2.4)),
        "end_margin_m": float(rng.uniform(0.5, 4.0)),
        "side_margin_m": float(rng.uniform(0.5, 3.0)),
        "ceiling_m": float(rng.uniform(2.6, 5.0)),
        "containment": float(rng.choice([0.0, 0.0, 0.3, 0.8])),
    }
    hall["recirculation"] = {
        "decay_m": float(rng.uniform(1.5, 8.0)),
        "cutoff": float(rng.choice([0.0, 1e-4, 1e-3])),
    }
    hall["supply_approach_k"] = rng.uniform(1.5, 5.0, racks).tolist()
    hall["return_approach_k"] = rng.uniform(-5.0, 0.0, racks).tolist()
    hall["height_zones"] = int(rng.integers(1, 8))
    hall["height_gradient"] = float(rng.uniform(0.0, 0.6))
    crac["units"] = int(rng.integers(1, 5))
    crac["supply_length_m"] = float(rng.uniform(2.0, 10.0))
    if rng.integers(3) == 0:
        shares = rng.dirichlet(np.ones(crac["units"]), racks)
        crac["unit_shares"] = (shares / shares.sum(axis=1, keepdims=True)).tolist()
    if even or rng.integers(2):
        hall["servers_per_rack"] = int(rng.integers(1, 40))
        servers["power_w"] = [float(rng.uniform(100, 400)), float(rng.uniform(0, 50))]
    else:
        servers["power_w"] = None
        servers["groups"] = [
            [
                {
                    "count": int(rng.integers(3, 12)),
                    "full_w": float(full_w),
                    "idle_w": float(rng.uniform(0.0, 0.4) * full_w),
                    "load_weight": float(rng.uniform(0.8, 1.2)),
                }
                for full_w in rng.uniform(150, 300, rng.integers(2, 4))
            ]
            for _ in range(racks)
        ]
    return {**values, "name": name}


def random_hall(
    rng: np.random.Generator, name: str, shape: tuple[int, int], *, even: bool = False
) -> DataCenterConfig:
    """A hall that closes: some draws breathe more air than their neighbours exhaust."""
    for _ in range(50):
        config = config_from_dict(random_values(rng, name, shape, even=even))
        with suppress(ConfigError):
            calibrate(config)
            return config
    raise AssertionError(f"no hall of {shape} closes")


def random_halls(seed: int) -> list[DataCenterConfig]:
    """A ragged fleet of one to four halls."""
    rng = np.random.default_rng(seed)
    shapes = [SMALL[i] for i in rng.integers(len(SMALL), size=rng.integers(1, 5))]
    if rng.integers(2):
        shapes[0] = (MERGED + LONG)[int(rng.integers(len(MERGED + LONG)))]
    return [random_hall(rng, f"dc{i}", shape) for i, shape in enumerate(shapes)]


def random_conditions(
    rng: np.random.Generator, configs: list[DataCenterConfig], *, kind: int | None = None
) -> Conditions:
    """Anything that a hall may meet; ``kind`` 0 loads racks alike, 1 by rack and 2 by group."""
    fleet = build_fleet(configs)
    units, racks = fleet.units, fleet.racks
    kind = int(rng.integers(3)) if kind is None else kind
    low = rng.uniform(0.5, 1.0, units)
    return Conditions(
        unit_supply_c=rng.uniform(16, 26, fleet.size)[fleet.unit_dc] + rng.uniform(0, 2, units),
        utilisation=rng.choice([0.0, 1.0, *rng.uniform(0, 1, 4)], fleet.size),
        rack_load=rng.uniform(0, 1, racks) if kind == 1 else None,
        group_load=rng.uniform(0, 1, fleet.groups) if kind == 2 else None,
        powered=rng.choice([0.0, 0.4, 1.0, 1.0, 1.0], racks),
        rack_airflow=rng.choice([0.05, 0.5, 1.0, 1.0, 1.0], racks),
        unit_low=low,
        unit_high=np.minimum(low + rng.choice([0.0, 0.3], units), 1.2),
        unit_running=rng.choice([0.0, 1.0], units),
    )


@dataclass(frozen=True)
class Part:
    """Where one data center lies in a fleet, and what it meets."""

    twin: reference_twin.HallTwin
    units: slice
    racks: slice
    groups: slice
    servers: slice
    supply_c: F64
    load: F64
    low: F64
    high: F64
    running: F64
    powered: F64
    breath: F64


def parts(configs: list[DataCenterConfig], met: Conditions) -> list[Part]:
    """Every data center of a fleet, for the twin."""
    fleet, out = build_fleet(configs), []
    for i, config in enumerate(configs):
        racks = slice(*fleet.rack_offsets[i : i + 2])
        groups = slice(fleet.group_offsets[racks.start], fleet.group_offsets[racks.stop])
        servers = slice(fleet.server_offsets[groups.start], fleet.server_offsets[groups.stop])
        units = slice(*fleet.unit_offsets[i : i + 2])
        twin = reference_twin.calibrated(config)
        if met.group_load is not None:
            counts = np.diff(fleet.server_offsets)[groups]
            load = np.repeat(met.group_load[groups], counts)
        elif met.rack_load is not None:
            load = twin.load(met.rack_load[racks])
        else:
            load = twin.load(np.full(config.hall.racks, met.utilisation[i]))
        ones, full = np.ones(config.hall.racks), np.ones(config.hvac.crac.units)
        out.append(
            Part(
                twin, units, racks, groups, servers, met.unit_supply_c[units], load,
                full if met.unit_low is None else met.unit_low[units],
                full if met.unit_high is None else met.unit_high[units],
                full if met.unit_running is None else met.unit_running[units],
                ones if met.powered is None else met.powered[racks],
                ones if met.rack_airflow is None else met.rack_airflow[racks],
            )
        )  # fmt: skip
    return out


def steady_twin(part: Part) -> reference_twin.Twin:
    return reference_twin.steady(
        part.twin,
        part.supply_c,
        part.load,
        low=part.low,
        high=part.high,
        running=part.running,
        powered=part.powered,
        breath=part.breath,
    )


def assert_close(found: Any, expected: Any, rel: float, name: object, scale: float = 0.0) -> None:
    """Equal to ``rel`` of themselves or of ``scale``."""
    np.testing.assert_allclose(found, expected, rtol=rel, atol=rel * scale, err_msg=str(name))


def assert_agrees(configs: list[DataCenterConfig], met: Conditions, precision: Precision) -> None:
    """Everything that the kernels compute against the twin."""
    rel = {"f64": 1e-11, "f32": 5e-4}[precision]
    hall = Hall(build_fleet(configs), precision)
    sums, layers = hall.solve(met), hall.servers()
    for i, part in enumerate(parts(configs, met)):
        twin, name = steady_twin(part), configs[i].name
        for field, expected in twin.dcs.items():
            where = part.units if field.startswith("unit_") else slice(i, i + 1)
            # Sums over what exceeds a limit inherit the absolute error of each inlet.
            scale = float(len(part.load)) if field in ("over_27_sum_k", "under_18_sum_k") else 0.0
            assert_close(getattr(sums, field)[where], expected, rel, (name, field), scale)
        for field, expected in twin.racks.items():
            found = getattr(sums, f"rack_{field}")[part.racks]
            assert_close(found, expected, rel, (name, "rack", field))
        for field, expected in twin.servers.items():
            found = getattr(layers, field)[part.servers]
            assert_close(found, expected, rel, (name, "server", field))
        hottest = layers.inlet_c[part.servers].max()
        fleet = build_fleet(configs)
        rack = part.racks.start + int(sums.hottest_rack[i])
        server = fleet.server_offsets[fleet.group_offsets[rack]] + int(sums.hottest_server[i])
        assert layers.inlet_c[server] == hottest == sums.inlet_max_c[i]


# --- against the twin ---------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=8)
@given(seed=SEEDS)
def test_steady_halls_agree_with_the_twin(precision: Precision, seed: int) -> None:
    configs = random_halls(seed)
    met = random_conditions(np.random.default_rng(seed + 1), configs)
    assert_agrees(configs, met, precision)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", [0, 1, 2], ids=["mean load", "rack loads", "group loads"])
@pytest.mark.parametrize("shape", [(4, 5), *MERGED[:1], *LONG])
def test_every_kind_of_exchange_and_load_agrees_with_the_twin(
    shape: tuple[int, int], kind: int, precision: Precision
) -> None:
    rng = np.random.default_rng(shape[1] + kind)
    config = random_hall(rng, "dc", shape)
    assert_agrees([config], random_conditions(rng, [config], kind=kind), precision)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("speed", [0.5, 0.8, 1.0])
def test_full_load_at_the_highest_setpoint_agrees_with_the_twin_at_any_fan_speed(
    speed: float, precision: Precision
) -> None:
    # Where sweeps start is the answer here, but for the airflow of the CRAC units.
    given = np.array([speed])
    met = Conditions(np.array([23.0]), np.ones(1), unit_low=given, unit_high=given)
    assert_agrees([load_config("corrected")], met, precision)


@pytest.mark.parametrize(
    "overrides",
    [[], ["hall.servers_per_rack=12", "hall.height_zones=12"],
     ["hall.rows=5", "hall.racks_per_row=16", "hall.supply_approach_k=5.15",
      "hall.return_approach_k=-3.1", "servers.power_w=[150, 10]"]],
    ids=["default", "each server its own", "80 racks"],
)  # fmt: skip
def test_most_sweeps_start_where_they_end(overrides: list[str]) -> None:
    config = load_config("corrected", overrides)
    fleet, rng = build_fleet([config] * 300), np.random.default_rng(0)
    hall = Hall(fleet, "f32")
    hall.solve(Conditions(rng.uniform(16.0, 23.0, 300), rng.uniform(0.0, 1.0, 300)))
    assert hall.sweeps.mean() < 1.6
    # Setpoints move by whole kelvins, where the table has its entries.
    hall.solve(Conditions(rng.integers(16, 24, 300).astype(float), rng.integers(0, 65, 300) / 64))
    assert hall.sweeps.max() == 1


@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_server_may_be_its_own(precision: Precision) -> None:
    config = load_config("corrected", ["hall.servers_per_rack=12", "hall.height_zones=12"])
    fleet = build_fleet(config)
    assert fleet.groups == fleet.servers == 20 * 12
    rng = np.random.default_rng(3)
    assert_agrees([config], random_conditions(rng, [config], kind=2), precision)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_fans_without_limits_of_their_airflow(precision: Precision) -> None:
    # Twenty racks leave places of blocks empty.
    config = load_config(
        "corrected", ["servers.fan_power_exponent=2.5", "servers.fan_airflow_ratio_limits=null"]
    )
    assert_agrees([config], Conditions(np.array([18.0]), np.array([0.05])), precision)
    # The curve is below 0 here, and fans do not blow backwards; heat goes to the room all the same.
    sums = Hall(build_fleet(config), precision).solve(Conditions(np.array([4.0]), np.zeros(1)))
    assert sums.it_airflow_m3s[0] == sums.it_fan_w[0] == 0.0
    carried = 1.225 * 1006.0 * sums.crac_flow_m3s[0] * (sums.return_c[0] - 4.0)
    assert carried == pytest.approx(sums.cpu_w[0], rel=TOLERANCE[precision])


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("shape", [(4, 5), (10, 14)], ids=["one chunk", "two chunks"])
def test_halls_of_any_size_give_up_after_as_many_sweeps(
    shape: tuple[int, int], precision: Precision
) -> None:
    config = load_config(
        "corrected",
        [f"hall.rows={shape[0]}", f"hall.racks_per_row={shape[1]}", "hall.supply_approach_k=5",
         "hall.return_approach_k=-3", "servers.power_w=[200, 20]"],
    )  # fmt: skip
    hall, least = Hall(build_fleet(config), precision), np.array([1e-3])
    still = Conditions(np.array([20.0]), np.ones(1), unit_low=least, unit_high=least)
    with pytest.raises(SdcError, match=r"or set simulation\.thermal") as error:
        hall.solve(still)
    assert f"no steady air temperatures in {MOST_SWEEPS} sweeps" in str(error.value)
    with pytest.raises(RuntimeStateError, match="no step has been done"):
        hall.servers()
    assert hall.solve(Conditions(np.array([20.0]), np.ones(1))).inlet_mean_c[0] < 26


@pytest.mark.parametrize("inlet_model", ["approach", "recirculation"])
def test_conditions_that_are_no_numbers_are_refused(inlet_model: str) -> None:
    config = load_config("corrected", [f"hall.inlet_model={inlet_model}"])
    for supply_c, load in ((np.nan, 0.5), (18.0, np.nan)):
        hall = Hall(build_fleet(config), "f32")
        with pytest.raises(SdcError, match="is not finite; valid are finite numbers"):
            hall.solve(Conditions(np.array([supply_c]), np.array([load])))


def test_twin_sees_a_change_of_any_measure_of_the_hall() -> None:
    values = random_values(np.random.default_rng(0), "dc", (3, 4))
    values["hall"]["layout"]["containment"] = 0.2
    values["hall"] |= {"height_zones": 4, "height_gradient": 0.4, "servers_per_rack": 12}
    values["servers"] |= {"power_w": [200, 20], "groups": None}
    values["hvac"]["crac"] |= {"units": 3, "unit_shares": None}
    met = Conditions(
        np.array([18.0, 21.0, 24.0]), np.array([0.6]), unit_low=np.full(3, 0.6),
        unit_high=np.full(3, 0.6),
    )  # fmt: skip
    config = config_from_dict(values)
    twin = steady_twin(parts([config], met)[0])
    changes = {f"layout.{name}": 1.01 for name in values["hall"]["layout"]}
    del changes["layout.ceiling_m"], changes["layout.end_margin_m"], changes["layout.side_margin_m"]
    changes |= {"recirculation.decay_m": 1.01, "height_gradient": 1.01, "height_zones": 2}
    for path, factor in changes.items():
        section = dict(config.hall.model_dump(mode="json"))
        *outer, last = path.split(".")
        inner = section[outer[0]] if outer else section
        inner[last] = inner[last] * factor
        changed = config_from_dict({**values, "hall": section})
        sums = Hall(build_fleet(changed), "f64").solve(met)
        difference = np.max(np.abs(sums.rack_inlet_max_c - twin.racks["inlet_max_c"]))
        assert difference > 1e-6, f"{path} has no effect on the inlets"


# --- weights ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SMALL + MERGED + LONG)
def test_weights_are_those_of_the_paths(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape[0] * shape[1])
    hall = config_from_dict(random_values(rng, "dc", shape)).hall
    flow = rng.uniform(0.5, 2.0, hall.racks)
    exchange = layout_weights(hall, flow)
    dense, expected = exchange.dense(), reference_twin.layout_weights(hall, flow)
    assert_close(dense, expected, 1e-12, "weights", scale=1.0)
    assert_close(dense.sum(axis=1), np.ones(hall.racks), 1e-12, "rows sum to 1")
    assert np.all(dense >= 0)
    values = rng.uniform(-3, 30, hall.racks)
    assert_close(exchange.apply(values), expected @ values, 1e-11, "apply", scale=1.0)
    found = exchange.apply_transposed(values)
    assert_close(found, expected.T @ values, 1e-11, "transposed", scale=1.0)


@pytest.mark.parametrize("shape", [(14, 8), (5, 70)])
@pytest.mark.parametrize("cutoff", [0.0, 1e-3, 4e-3])
def test_rows_of_deep_racks_are_within_reach(shape: tuple[int, int], cutoff: float) -> None:
    values = random_values(np.random.default_rng(6), "dc", shape)
    values["hall"]["layout"] |= {"rack_depth_m": 6.0, "cold_aisle_m": 1.0, "hot_aisle_m": 1.0}
    values["hall"]["recirculation"] = {"decay_m": 3.0, "cutoff": cutoff}
    hall = config_from_dict(values).hall
    expected = reference_twin.layout_weights(hall, np.ones(hall.racks))
    assert_close(layout_weights(hall).dense(), expected, 1e-12, "weights", scale=1.0)
    assert np.all(expected > 0) == (cutoff == 0)


@pytest.mark.parametrize("shape", [(4, 5), *MERGED, *LONG])
def test_paths_of_many_decay_lengths_leave_weights(shape: tuple[int, int]) -> None:
    # Measures in mm, as they come by mistake: exp(-path / decay) is below any number.
    values = random_values(np.random.default_rng(7), "dc", shape, even=True)
    layout = values["hall"]["layout"]
    values["hall"]["layout"] = {
        k: v if k in ("containment", "returns") else 1e3 * v for k, v in layout.items()
    }
    config = config_from_dict(values)
    dense = layout_weights(config.hall).dense()
    assert_close(dense.sum(axis=1), np.ones(config.hall.racks), 1e-12, "rows sum to 1")


def test_a_cutoff_that_leaves_no_source_is_refused() -> None:
    for shape, cutoff in (((10, 100), 0.01), ((200, 500), 1e-4)):
        values = random_values(np.random.default_rng(8), "dc", (10, 100), even=True)
        values["hall"] |= {
            "rows": shape[0], "racks_per_row": shape[1], "layout": {},
            "supply_approach_k": 5.0, "return_approach_k": -3.0,
            "recirculation": {"decay_m": 50.0, "cutoff": cutoff},
        }  # fmt: skip
        values["hvac"]["crac"]["unit_shares"] = None
        hall = config_from_dict(values).hall
        with pytest.raises(ConfigError, match="without any source: their largest") as error:
            layout_weights(hall)
        assert f"hall.recirculation.cutoff {cutoff:g} with decay_m 50" in str(error.value)
        largest = float(str(error.value).split("weight is ")[1].split(";")[0])
        if shape == (10, 100):
            smaller = hall.recirculation.model_copy(update={"cutoff": 0.5 * largest})
            exchange = layout_weights(hall.model_copy(update={"recirculation": smaller}))
            assert np.all(np.isfinite(exchange.norm))


def test_more_weights_than_fit_are_refused() -> None:
    values = random_values(np.random.default_rng(8), "dc", (1, 2), even=True)
    values["hall"] |= {
        "rows": 400, "racks_per_row": 2000, "layout": {}, "supply_approach_k": 5.0,
        "return_approach_k": -3.0, "recirculation": {"cutoff": 0.0},
    }  # fmt: skip
    values["hvac"]["crac"]["unit_shares"] = None
    with pytest.raises(ConfigError, match=r"keeps 6.39e.09 weights for 800,000 racks; valid is at"):
        layout_weights(config_from_dict(values).hall)


@pytest.mark.parametrize("shape", MERGED + LONG)
@pytest.mark.parametrize("cutoff", [1e-4, 1e-3, 1e-2])
def test_large_halls_drop_small_weights_alone(shape: tuple[int, int], cutoff: float) -> None:
    assert shape[0] * shape[1] > DENSE_RACKS
    values = random_values(np.random.default_rng(4), "dc", shape)
    values["hall"]["recirculation"] = {"decay_m": 1.5, "cutoff": 0.0}
    every = layout_weights(config_from_dict(values).hall).dense()
    assert np.all(every > 0)
    values["hall"]["recirculation"]["cutoff"] = cutoff
    cut = layout_weights(config_from_dict(values).hall).dense()
    kept = cut > 0
    assert 0 < np.mean(~kept) < 1
    # Racks at the rim collect down to a quarter of what those amid the hall do.
    assert np.all(every[~kept] < 4 * cutoff * every.sum(axis=1).max())
    ratio = np.divide(cut, every, out=np.full(cut.shape, np.nan), where=kept)
    assert np.nanmax(np.nanmax(ratio, axis=1) - np.nanmin(ratio, axis=1)) < 1e-9
    assert np.all(np.nanmin(ratio, axis=1) >= 1.0)


@settings(phases=AS_FOUND, max_examples=20)
@given(seed=SEEDS)
def test_recirculation_takes_less_than_there_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flows = calibrate(random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))]))
    matrix = flows.matrix()
    assert np.all(matrix >= 0)
    assert np.all(matrix.sum(axis=1) <= 1.0)
    assert np.all((flows.group_exhaust_share >= 0) & (flows.group_exhaust_share < 1))
    assert np.max(np.abs(np.linalg.eigvals(matrix))) < 1.0
    airflow = flows.design.airflow_m3s
    assert np.all(airflow - matrix.T @ airflow >= 0), "a rack gives more air than it exhausts"


# --- calibration --------------------------------------------------------------------------------


def at_design(configs: list[DataCenterConfig]) -> HallSums:
    setpoint_c = np.concatenate(
        [np.full(c.hvac.crac.units, c.hvac.setpoint.max_c) for c in configs]
    )
    return Hall(build_fleet(configs), "f64").solve(Conditions(setpoint_c, np.ones(len(configs))))


def test_design_point_of_the_paper_comes_out() -> None:
    sums = at_design([load_config("corrected")])
    approach_k = np.repeat([5.3, 5.0, 5.3], [5, 10, 5])
    np.testing.assert_allclose(sums.rack_inlet_c - 23.0, approach_k, rtol=0, atol=1e-9)
    mean_return_k = sums.return_c[0] - np.mean(sums.rack_outlet_c)
    assert mean_return_k == pytest.approx(-3.1, abs=1e-9)
    assert sums.inlet_mean_c[0] - 23.0 == pytest.approx(5.15, abs=1e-9)


@pytest.mark.parametrize("full_m3s", [0.012, 0.02])
def test_design_point_comes_out_with_any_airflow_of_the_servers(full_m3s: float) -> None:
    config = load_config("corrected", [f"servers.fan_full_airflow_m3s={full_m3s}"])
    sums = at_design([config])
    approach_k = np.repeat([5.3, 5.0, 5.3], [5, 10, 5])
    np.testing.assert_allclose(sums.rack_inlet_c - 23.0, approach_k, rtol=0, atol=1e-9)


@settings(phases=AS_FOUND, max_examples=12)
@given(seed=SEEDS)
def test_any_design_point_comes_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))])
    open_hall = config.hall.layout.model_copy(update={"containment": 0.0})
    hall = config.hall.model_copy(update={"layout": open_hall})
    sums = at_design([config.model_copy(update={"hall": hall})])
    found = sums.rack_inlet_c - config.hvac.setpoint.max_c
    np.testing.assert_allclose(found, hall.supply_approach_k, rtol=0, atol=1e-9)
    mean_return_k = sums.return_c[0] - np.mean(sums.rack_outlet_c)
    assert mean_return_k == pytest.approx(np.mean(hall.return_approach_k), abs=1e-9)


def test_containment_takes_its_share_of_the_paths() -> None:
    whole = calibrate(load_config("corrected")).matrix()
    for containment in (0.25, 0.9, 1.0):
        config = load_config("corrected", [f"hall.layout.containment={containment}"])
        part = calibrate(config).matrix()
        np.testing.assert_allclose(part, (1 - containment) * whole, rtol=1e-12, atol=1e-15)


# --- matrices of the user's -----------------------------------------------------------------------


def random_matrix(rng: np.random.Generator, racks: int) -> F64:
    """An R of a hall of equal racks: no more leaves than comes out, a rack that breathes none."""
    matrix = rng.uniform(0, 1, (racks, racks)) * (rng.random((racks, racks)) < 0.7)
    matrix *= 0.35 / np.maximum(matrix.sum(axis=0), matrix.sum(axis=1)).max()
    matrix[1] = 0.0
    return matrix


def heat_matrix(matrix: F64, overrides: list[str], scaled: bool, folder: Path) -> F64:
    """D of a hall with this R: T_in - T_sup = R (I - R)^-1 K^-1 P, with its design airflow."""
    path = folder / "known.npz"
    np.savez(path, R=matrix)
    given = [f"hall.recirculation.matrix_file={json.dumps(str(path))}",
             f"hall.recirculation.calibrate={str(scaled).lower()}"]  # fmt: skip
    config = load_config("corrected", [*overrides, *given])
    per_k = config.hall.air_density_kg_m3 * config.hall.air_heat_capacity_j_per_kg_k
    airflow_m3s = calibrate(config).design.airflow_m3s
    return np.asarray(matrix @ np.linalg.inv(np.eye(len(matrix)) - matrix) / (per_k * airflow_m3s))


@pytest.mark.parametrize("kind", ["R.npz", "D.npz", "R.csv", "D.csv"])
@pytest.mark.parametrize("scaled", [True, False], ids=["calibrated", "as given"])
def test_matrix_of_a_file_agrees_with_the_twin(kind: str, scaled: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    matrix = random_matrix(rng, 6)
    if scaled:
        # Calibration needs exhaust air for a rack with an approach temperature.
        matrix[1] = matrix[0]
    overrides = [
        "hall.rows=2", "hall.racks_per_row=3", "hall.supply_approach_k=3",
        "hall.return_approach_k=-3", "servers.power_w=[200, 20]",
    ]  # fmt: skip
    name, path = kind[0], tmp_path / kind
    given = matrix if name == "R" else heat_matrix(matrix, overrides, scaled, tmp_path)
    if path.suffix == ".npz":
        np.savez(path, **{name: given})  # type: ignore[arg-type]
    else:
        np.savetxt(path, given, delimiter=",")
    config = load_config(
        "corrected",
        [
            *overrides,
            f"hall.recirculation.matrix_file={json.dumps(str(path))}",
            f"hall.recirculation.matrix_kind={name}",
            f"hall.recirculation.calibrate={str(scaled).lower()}",
        ],
    )
    met = Conditions(np.array([20.0]), np.array([0.7]))
    twin = reference_twin.calibrated(config, matrix)
    if not scaled:
        np.testing.assert_allclose(calibrate(config).matrix(), matrix, rtol=1e-9, atol=1e-12)
    ones, full = np.ones(6), np.ones(1)
    expected = reference_twin.steady(
        twin, met.unit_supply_c, twin.load(np.full(6, 0.7)), low=full, high=full, running=full,
        powered=ones, breath=ones,
    )  # fmt: skip
    sums = Hall(build_fleet(config), "f64").solve(met)
    for field in ("inlet_c", "outlet_c", "cpu_w", "airflow_m3s"):
        assert_close(getattr(sums, f"rack_{field}"), expected.racks[field], 1e-10, field)
    if not scaled:
        assert sums.rack_inlet_c[1] == pytest.approx(20.0, abs=1e-9)


def test_power_of_a_rack_warms_the_others_by_d(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(5), tmp_path / "cfd.npz"
    overrides = [
        "hall.rows=2", "hall.racks_per_row=3", "hall.supply_approach_k=3",
        "hall.return_approach_k=-3", "servers.power_w=[200, 20]",
        "servers.fan_full_airflow_m3s=0.012", "servers.fan_airflow_ratio_lb=[1,1]",
        "servers.fan_airflow_ratio_ub=[1,1]",
    ]  # fmt: skip
    flow = calibrate(load_config("corrected", overrides)).design.airflow_m3s
    matrix = random_matrix(rng, 6)
    d_k_per_w = matrix @ np.linalg.inv(np.eye(6) - matrix) / (1.225 * 1006.0 * flow)
    np.savez(path, D=d_k_per_w)
    config = load_config(
        "corrected",
        [
            *overrides,
            f"hall.recirculation.matrix_file={json.dumps(str(path))}",
            "hall.recirculation.calibrate=false",
        ],
    )
    met = Conditions(np.array([19.0]), np.array([0.5]), rack_load=rng.uniform(0, 1, 6))
    sums = Hall(build_fleet(config), "f64").solve(met)
    power_w = sums.rack_cpu_w + sums.rack_fan_w
    np.testing.assert_allclose(sums.rack_inlet_c, 19.0 + d_k_per_w @ power_w, rtol=1e-9)


@pytest.mark.parametrize("full_m3s", [None, 0.02])
def test_d_holds_at_the_design_point_of_servers_with_curves(
    full_m3s: float | None, tmp_path: Path
) -> None:
    overrides = ["hall.rows=2", "hall.racks_per_row=3", "hall.supply_approach_k=3",
                 "hall.return_approach_k=-3", "servers.power_w=[200, 20]",
                 f"servers.fan_full_airflow_m3s={json.dumps(full_m3s)}"]  # fmt: skip
    matrix = random_matrix(np.random.default_rng(0), 6)
    d_k_per_w = heat_matrix(matrix, overrides, False, tmp_path)
    np.savez(tmp_path / "cfd.npz", D=d_k_per_w)
    path = json.dumps(str(tmp_path / "cfd.npz"))
    named = [f"hall.recirculation.matrix_file={path}", "hall.recirculation.calibrate=false"]
    sums = at_design([load_config("corrected", [*overrides, *named])])
    rise_k = d_k_per_w @ (sums.rack_cpu_w + sums.rack_fan_w)
    np.testing.assert_allclose(sums.rack_inlet_c - 23.0, rise_k, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"R": np.full((4, 4), 0.1)}, r"R has shape \(4, 4\), expected \(6, 6\)"),
        ({"R": np.full((6, 6), np.nan)}, r"R\[0, 0\] is nan; valid is a finite number"),
        ({"D": np.full((6, 6), -0.1)}, r"D\[0, 0\] is -0.1 K/W; valid is at least 0"),
        ({"R": np.full((6, 6), 0.1j)}, "R holds complex128; valid are real numbers"),
        ({"R": np.full((6, 6), True)}, "R holds bool; valid are real numbers"),
        ({"R": np.full((6, 6), -0.1)}, "rack 0 takes a share of -0.1 of its air from rack 0"),
        ({"R": np.full((6, 6), 0.2)}, "row 0 sums to 1.2; valid is below 1"),
        ({"R": np.zeros((6, 6)), "D": np.zeros((6, 6))}, "valid is one of the arrays R and D"),
        ({"X": np.zeros((6, 6))}, r"holds \['X'\]; valid is one of the arrays R and D"),
        (b"no archive", "cannot be read as a matrix"),
    ],
)
def test_a_matrix_that_cannot_be_is_refused(
    content: dict[str, F64] | bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "cfd.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, **content)  # type: ignore[arg-type]
    config = load_config(
        "corrected",
        ["hall.rows=2", "hall.racks_per_row=3", "hall.supply_approach_k=3",
         "hall.return_approach_k=-3", "servers.power_w=[200, 20]",
         f"hall.recirculation.matrix_file={json.dumps(str(path))}",
         "hall.recirculation.calibrate=false"],
    )  # fmt: skip
    with pytest.raises(ConfigError, match=message) as error:
        build_fleet(config)
    assert "cfd.npz" in str(error.value)
    assert "\n" not in str(error.value)


def matrix_hall(path: Path, *more: str) -> DataCenterConfig:
    return load_config(
        "corrected",
        ["hall.rows=2", "hall.racks_per_row=3", "hall.supply_approach_k=[0, 3, 3, 3, 3, 3]",
         "hall.return_approach_k=-3", "servers.power_w=[200, 20]",
         f"hall.recirculation.matrix_file={json.dumps(str(path))}", *more],
    )  # fmt: skip


def test_files_that_are_no_matrix_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", np.full((6, 6), 0.1))
    (tmp_path / "one.npy").rename(tmp_path / "one.npz")
    with pytest.raises(ConfigError, match=r"one\.npz: holds one array without a name; valid is an"):
        build_fleet(matrix_hall(tmp_path / "one.npz"))
    with pytest.raises(ConfigError, match=r"ends in '.txt'; valid are .npz and .csv"):
        build_fleet(matrix_hall(tmp_path / "r.txt", "hall.recirculation.matrix_kind=R"))


def test_a_rack_without_exhaust_air_cannot_be_warmed_by_it(tmp_path: Path) -> None:
    path, matrix = tmp_path / "r.npz", np.full((6, 6), 0.05)
    matrix[[0, 2]] = 0.0
    np.savez(path, R=matrix)
    with pytest.raises(ConfigError, match=r"row 2 is zero, so .* rack 2 by the 3 K of hall.supply"):
        build_fleet(matrix_hall(path))
    matrix[2] = 0.05
    np.savez(path, R=matrix)
    found = at_design([matrix_hall(path)]).rack_inlet_c - 23.0
    np.testing.assert_allclose(found, [0, 3, 3, 3, 3, 3], atol=1e-9)


def test_settings_that_a_matrix_leaves_without_effect_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"containment 0.5 with recirculation.matrix_file: .* 0$"):
        matrix_hall(tmp_path / "r.npz", "hall.layout.containment=0.5")
    with pytest.raises(ConfigError, match="matrix_kind D needs a matrix_file; valid without one"):
        load_config("corrected", ["hall.recirculation.matrix_kind=D"])


# --- conservation -------------------------------------------------------------------------------


def leaving(part: Part, sums: HallSums, layers: ServerLayers) -> tuple[float, float, F64]:
    """Heat that leaves a hall with its air, IT power, and what no rack takes of each exhaust.

    From R, the flows that the servers' power and warming tell, and the outlets; not from the
    return temperature.
    """
    twin, air = part.twin, part.twin.air_j_per_m3_k
    inlet, outlet, power = (
        getattr(layers, f.name)[part.servers].astype(np.float64) for f in fields(layers)
    )
    warming = outlet - inlet
    flow = np.where(warming > 0, power / (air * np.where(warming > 0, warming, 1.0)), 0.0)
    moved = reference_twin.flows(twin, flow, part.low, part.high)
    outlets = np.asarray(sums.rack_outlet_c[part.racks], dtype=np.float64)
    _, left_over = reference_twin.return_air(
        twin, moved, twin.per_rack(flow), outlets, part.supply_c, part.breath
    )
    heat = left_over @ outlets + (moved.bypass - moved.unit) @ part.supply_c
    return air * float(heat), float(power.sum()), left_over


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=12)
@given(seed=SEEDS)
def test_all_power_leaves_with_the_air(precision: Precision, seed: int) -> None:
    configs = random_halls(seed)
    met = random_conditions(np.random.default_rng(seed + 1), configs)
    hall = Hall(build_fleet(configs), precision)
    sums, layers = hall.solve(met), hall.servers()
    for i, part in enumerate(parts(configs, met)):
        heat_w, power_w, left_over = leaving(part, sums, layers)
        it_w = sums.cpu_w[i] + sums.it_fan_w[i]
        assert power_w == pytest.approx(it_w, rel=TOLERANCE[precision])
        # In f32 what the last sweep leaves counts ten times where units give a third of the need.
        rel = {"f64": 1e-12, "f32": 1e-4}[precision]
        assert heat_w == pytest.approx(power_w, rel=rel, abs=1e-6)
        assert left_over.sum() >= -1e-6
        # The kernel's own sums close without the help of another sweep.
        carried = part.twin.air_j_per_m3_k * sums.crac_flow_m3s[i]
        found = carried * (sums.return_c[i] - sums.supply_c[i])
        assert found == pytest.approx(it_w, rel=TOLERANCE[precision], abs=1e-6 * carried)


@pytest.mark.parametrize("failed", [[10], [0], [5, 6, 7, 8, 9]], ids=["one", "corner", "row"])
@pytest.mark.parametrize("share", [0.5, 0.1, 0.02])
def test_racks_with_failing_fans_give_no_more_heat_than_they_have(
    share: float, failed: list[int]
) -> None:
    config, breath = load_config("corrected"), np.ones(20)
    breath[failed] = share
    hall = Hall(build_fleet(config), "f64")
    before = hall.solve(Conditions(np.array([18.0]), np.ones(1)))
    met = Conditions(np.array([18.0]), np.ones(1), rack_airflow=breath)
    sums, layers = hall.solve(met), hall.servers()
    part = parts([config], met)[0]
    heat_w, power_w, left_over = leaving(part, sums, layers)
    assert heat_w == pytest.approx(power_w, rel=1e-12)
    assert np.all(left_over >= -1e-9)
    # Heat in the intakes of others, over what the exhaust of the failed racks carries.
    flow = np.repeat(sums.rack_airflow_m3s / 200, 200)
    moved = reference_twin.flows(part.twin, flow, part.low, part.high)
    taken = moved.captured[:, None] * reference_twin.mixing(part.twin, breath)
    np.fill_diagonal(taken, 0.0)
    assert np.all(taken.sum(axis=0)[failed] <= sums.rack_airflow_m3s[failed])
    assert np.all(sums.rack_outlet_c[failed] > before.rack_outlet_c[failed] + 5)
    if len(failed) == 1:
        # Most of what it gives off goes back to the units and not to its neighbours.
        others = np.delete(sums.rack_inlet_c - before.rack_inlet_c, failed)
        assert np.all(np.abs(others) < 0.6)


@settings(phases=AS_FOUND, max_examples=15)
@given(seed=SEEDS, load=st.floats(0, 1), supply_c=st.floats(16, 23))
def test_racks_loaded_alike_give_no_more_air_than_they_exhaust(
    seed: int, load: float, supply_c: float
) -> None:
    rng = np.random.default_rng(seed)
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))])
    met = Conditions(np.full(config.hvac.crac.units, supply_c), np.array([load]))
    hall = Hall(build_fleet(config), "f64")
    sums, layers = hall.solve(met), hall.servers()
    part = parts([config], met)[0]
    heat_w, power_w, left_over = leaving(part, sums, layers)
    assert heat_w == pytest.approx(power_w, rel=1e-12)
    assert np.all(left_over >= 0)
    rise_k = power_w / (part.twin.air_j_per_m3_k * sums.crac_flow_m3s[0])
    assert sums.return_c[0] - supply_c == pytest.approx(rise_k, rel=1e-12)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("change", ["hall.supply_approach_k=0", "hall.layout.containment=1"])
def test_without_recirculation_servers_breathe_supply_air(
    change: str, precision: Precision
) -> None:
    config = load_config("corrected", [change, "hvac.crac.units=3"])
    # A contained hall needs more supply air than an open one.
    met = Conditions(np.full(3, 19.0), np.array([0.3]))
    hall = Hall(build_fleet(config), precision)
    hall.solve(met)
    assert_close(hall.servers().inlet_c, np.full(4000, 19.0), TOLERANCE[precision] / 10, "inlet")


def flat(config: DataCenterConfig) -> DataCenterConfig:
    """Servers whose power and airflow depend on the load alone."""
    servers = config.servers.model_copy(
        update={
            "cpu_power_ratio_ub": config.servers.cpu_power_ratio_lb,
            "fan_airflow_ratio_lb": (0.3, 1.0),
            "fan_airflow_ratio_ub": (0.3, 1.0),
        }
    )
    return config.model_copy(update={"servers": servers})


@pytest.mark.parametrize("simple", [True, False], ids=["flat", "curves"])
@settings(phases=AS_FOUND, max_examples=8)
@given(seed=SEEDS, load=st.floats(0.2, 1))
def test_more_supply_air_never_warms_an_inlet(simple: bool, seed: int, load: float) -> None:
    rng = np.random.default_rng(seed)
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))])
    config = flat(config) if simple else config
    hall, units = Hall(build_fleet(config), "f64"), np.ones(config.hvac.crac.units)
    inlets = [
        hall.solve(
            Conditions(20 * units, np.array([load]), unit_low=f * units, unit_high=f * units)
        ).rack_inlet_c
        for f in (0.5, 0.6, 0.75, 0.9, 1.0, 1.3)
    ]
    assert np.all(np.diff(inlets, axis=0) <= 1e-9)


# --- places -------------------------------------------------------------------------------------


def moved_load_k(
    config: DataCenterConfig, giver: int, taker: int, power_w: float
) -> tuple[F64, float]:
    """Change of all inlets when a rack takes ``power_w`` from another, and what really moved."""
    hall, racks = Hall(build_fleet(config), "f64"), config.hall.racks
    load = np.full(racks, 0.5)

    def solve(change: float) -> HallSums:
        now = load.copy()
        now[giver] -= change
        now[taker] += change
        return hall.solve(Conditions(np.array([20.0]), np.array([0.5]), rack_load=now))

    before = solve(0.0)
    low, high = 0.0, 0.5
    for _ in range(40):
        middle = (low + high) / 2
        after = solve(middle)
        gained = float((after.rack_cpu_w - before.rack_cpu_w)[taker])
        low, high = (middle, high) if gained < power_w else (low, middle)
    return np.asarray(after.rack_inlet_c - before.rack_inlet_c), gained


def test_moving_15_kw_between_two_racks_moves_their_neighbours_most() -> None:
    config = load_config("corrected")
    giver, taker = 0, 19
    change_k, moved_w = moved_load_k(config, giver, taker, 15e3)
    assert moved_w == pytest.approx(15e3, rel=1e-9)
    assert change_k[taker - 1] > 0.02
    assert change_k[giver + 1] < -0.02
    # Along the rows at the walls, from the two racks in the corners.
    assert np.all(np.diff(change_k[[19, 18, 17, 16, 15]]) < 0)
    assert np.all(np.diff(change_k[[0, 1, 2, 3, 4]]) > 0)


def test_effect_of_a_rack_fades_with_distance() -> None:
    config = load_config(
        "corrected",
        ["hall.rows=6", "hall.racks_per_row=20", "hall.supply_approach_k=5",
         "hall.return_approach_k=-3", "servers.power_w=[200, 20]"],
    )  # fmt: skip
    giver, taker = 119, 0
    change_k, _ = moved_load_k(config, giver, taker, 15e3)
    path_m = reference_twin.path_lengths_m(config.hall)
    near = (path_m[:, taker] < path_m[:, giver]) & (np.arange(120) != taker)
    bins = np.digitize(path_m[near, taker], np.arange(3.0, 12.0, 1.5))
    means = [change_k[near][bins == b].mean() for b in np.unique(bins)]
    assert len(means) >= 5
    assert np.all(np.diff(means) < 0)
    assert means[0] > 10 * abs(means[-1])


@settings(phases=AS_FOUND, max_examples=10)
@given(seed=SEEDS)
def test_servers_agree_with_their_racks_and_get_warmer_upwards(seed: int) -> None:
    rng = np.random.default_rng(seed)
    config = random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))], even=True)
    met = random_conditions(rng, [config], kind=0)
    hall = Hall(build_fleet(config), "f64")
    sums, layers = hall.solve(met), hall.servers()
    fleet = build_fleet(config)
    rack, air = fleet.server_rack(), reference_twin.calibrated(config).air_j_per_m3_k
    warming = layers.outlet_c - layers.inlet_c
    on = warming > 0
    flow = np.where(on, layers.power_w / (air * np.where(on, warming, 1.0)), 0.0)

    def total(values: Any) -> F64:
        return np.asarray(np.bincount(rack, values, fleet.racks), dtype=np.float64)

    assert_close(total(layers.power_w), sums.rack_cpu_w + sums.rack_fan_w, 1e-12, "power")
    assert_close(total(flow), sums.rack_airflow_m3s, 1e-11, "airflow")
    blown = sums.rack_airflow_m3s > 0
    for name in ("inlet_c", "outlet_c"):
        mean = total(flow * getattr(layers, name))[blown] / sums.rack_airflow_m3s[blown]
        assert_close(mean, getattr(sums, f"rack_{name}")[blown], 1e-12, name)
    columns = layers.inlet_c.reshape(fleet.racks, -1)
    zones = min(config.hall.height_zones, columns.shape[1])
    for column in columns:
        assert np.all(np.diff(column) >= 0)
        assert len(np.unique(column)) <= zones
    # A rack whose exhaust mix is as warm as its supply has nothing to tell its zones apart by.
    if config.hall.height_gradient > 1e-3 and config.hall.layout.containment < 1:
        warm = np.ptp(columns, axis=1) > 0
        assert all(len(np.unique(c)) == zones for c in columns[warm])


# --- batches ------------------------------------------------------------------------------------


def own_part(values: HallSums, configs: list[DataCenterConfig], index: int) -> dict[str, Any]:
    """What a fleet computed for one of its data centers."""
    fleet = build_fleet(configs)
    racks = slice(*fleet.rack_offsets[index : index + 2])
    units = slice(*fleet.unit_offsets[index : index + 2])
    out = {}
    for f in fields(values):
        where = slice(index, index + 1)
        if f.name.startswith("rack_"):
            where = racks
        elif f.name.startswith("unit_"):
            where = units
        out[f.name] = getattr(values, f.name)[where]
    return out


def own_conditions(met: Conditions, configs: list[DataCenterConfig], index: int) -> Conditions:
    fleet = build_fleet(configs)
    racks = slice(*fleet.rack_offsets[index : index + 2])
    where = {
        "utilisation": slice(index, index + 1),
        "rack_load": racks,
        "powered": racks,
        "rack_airflow": racks,
        "group_load": slice(fleet.group_offsets[racks.start], fleet.group_offsets[racks.stop]),
    }
    units = slice(*fleet.unit_offsets[index : index + 2])
    own: dict[str, Any] = {
        f.name: None if (v := getattr(met, f.name)) is None else v[where.get(f.name, units)]
        for f in fields(met)
    }
    return Conditions(**own)


@pytest.mark.parametrize("precision", PRECISIONS)
@settings(phases=AS_FOUND, max_examples=8)
@given(seed=SEEDS)
def test_a_hall_of_a_batch_equals_itself_alone(precision: Precision, seed: int) -> None:
    configs = random_halls(seed)
    met = random_conditions(np.random.default_rng(seed + 1), configs)
    batch = Hall(build_fleet(configs), precision)
    together, layers = batch.solve(met), batch.servers()
    for i, (config, part) in enumerate(zip(configs, parts(configs, met), strict=True)):
        alone = Hall(build_fleet(config), precision)
        sums, own = alone.solve(own_conditions(met, configs, i)), alone.servers()
        for name, expected in own_part(together, configs, i).items():
            assert np.array_equal(getattr(sums, name), expected), (config.name, name)
        for f in fields(own):
            found = getattr(layers, f.name)[part.servers]
            assert np.array_equal(getattr(own, f.name), found), (config.name, f.name)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_hall_forgets_what_it_solved_before(precision: Precision) -> None:
    configs = random_halls(5)
    rng = np.random.default_rng(0)
    first, second = (random_conditions(rng, configs) for _ in range(2))
    hall, fresh = (Hall(build_fleet(configs), precision) for _ in range(2))
    hall.solve(first)
    hall.servers()
    again, expected = hall.solve(second), fresh.solve(second)
    for f in fields(expected):
        assert np.array_equal(getattr(again, f.name), getattr(expected, f.name)), f.name
