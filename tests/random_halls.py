"""Recirculating halls of any measures and make-up, and their NumPy twins, for tests."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
from hypothesis import Phase
from hypothesis import strategies as st

import reference_twin
from sdc_taichi import ConfigError, DataCenterConfig, OddInputWarning, build_fleet, load_config
from sdc_taichi.config import config_from_dict
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions, HallSums, Precision
from sdc_taichi.types import F64

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
        "calibrate": str(rng.choice(["rack", "row", "row", "hall"])),
    }
    hall["layout"]["returns"] = str(rng.choice(["ceiling", "end_wall"]))
    hall["supply_approach_k"] = rng.uniform(1.5, 5.0, racks).tolist()
    hall["return_approach_k"] = rng.uniform(-5.0, 0.0, racks).tolist()
    hall["air_density_kg_m3"] = 1.2 if rng.integers(3) == 0 else None
    hall["height_zones"] = int(rng.integers(1, 8))
    hall["height_gradient"] = float(rng.uniform(0.0, 0.6))
    crac["units"] = int(rng.integers(1, 5))
    # The twin has fixed shares and common return air; test_shared_plenum.py tests the others.
    crac["plenum_coupling"] = hall["recirculation"]["oversupply_decay"] = 0.0
    crac["return_air"] = "common"
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
                    "height_u": float(rng.choice([1.0, 1.0, 1.5])),
                    "fan_w": float(rng.uniform(5, 30)) if rng.integers(2) else None,
                    "design_rise_k": float(rng.uniform(9, 16)) if rng.integers(3) == 0 else None,
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
        values = random_values(rng, name, shape, even=even)
        with suppress(ConfigError):
            config = config_from_dict(values)
            calibrate(config)
            return config
    raise AssertionError(f"no hall of {shape} closes")


@lru_cache(maxsize=128)
def fleet_of(*configs: DataCenterConfig) -> Fleet:
    """The fleet of these data centers, which tests of both precisions share."""
    with warnings.catch_warnings():
        # Halls of any make-up move odd amounts of air.
        warnings.simplefilter("ignore", OddInputWarning)
        return build_fleet(configs)


@lru_cache(maxsize=32)
def random_halls(seed: int) -> tuple[DataCenterConfig, ...]:
    """A ragged fleet of one to four halls."""
    rng = np.random.default_rng(seed)
    shapes = [SMALL[i] for i in rng.integers(len(SMALL), size=rng.integers(1, 5))]
    if rng.integers(2):
        shapes[0] = (MERGED + LONG)[int(rng.integers(len(MERGED + LONG)))]
    return tuple(random_hall(rng, f"dc{i}", shape) for i, shape in enumerate(shapes))


def random_conditions(
    rng: np.random.Generator, configs: Sequence[DataCenterConfig], *, kind: int | None = None
) -> Conditions:
    """Anything that a hall may meet; ``kind`` 0 loads racks alike, 1 by rack and 2 by group."""
    fleet = fleet_of(*configs)
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


def parts(configs: Sequence[DataCenterConfig], met: Conditions) -> list[Part]:
    """Every data center of a fleet, for the twin."""
    fleet, out = fleet_of(*configs), []
    for i, config in enumerate(configs):
        racks = slice(*fleet.rack_offsets[i : i + 2])
        groups = slice(fleet.group_offsets[racks.start], fleet.group_offsets[racks.stop])
        servers = slice(fleet.server_offsets[groups.start], fleet.server_offsets[groups.stop])
        units = slice(*fleet.unit_offsets[i : i + 2])
        twin = reference_twin.calibrated(config)
        if met.unit_running is not None:
            twin = reference_twin.with_units_down(twin, met.unit_running[units])
        if met.group_load is not None:
            counts = np.diff(fleet.server_offsets)[groups]
            load = np.repeat(met.group_load[groups], counts)
        elif met.rack_load is not None:
            load = twin.load(met.rack_load[racks])
        else:
            load = twin.load(np.full(config.hall.racks, met.utilisation[i]))
        ones, full = np.ones(config.hall.racks), np.ones(config.hvac.crac.units)
        powered = ones if met.powered is None else met.powered[racks]
        breath = ones if met.rack_airflow is None else met.rack_airflow[racks]
        given = (met.rack_load, met.group_load, met.powered, met.rack_airflow)
        if any(values is not None for values in given):
            whole = load if met.rack_load is None else met.rack_load[racks][twin.rack]
            if met.rack_load is None and met.group_load is None:
                whole = np.full(len(load), met.utilisation[i])
            twin = reference_twin.at_loads(twin, whole, powered, breath)
        out.append(
            Part(
                twin, units, racks, groups, servers, met.unit_supply_c[units], load,
                full if met.unit_low is None else met.unit_low[units],
                full if met.unit_high is None else met.unit_high[units],
                full if met.unit_running is None else met.unit_running[units],
                powered,
                breath,
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


def assert_agrees(
    configs: Sequence[DataCenterConfig], met: Conditions, precision: Precision
) -> None:
    """Everything that the kernels compute against the twin."""
    rel = {"f64": 1e-11, "f32": 5e-4}[precision]
    hall = Hall(fleet_of(*configs), precision)
    sums, layers = hall.solve(met), hall.servers()
    for i, part in enumerate(parts(configs, met)):
        twin, name = steady_twin(part), configs[i].name
        for field, expected in twin.dcs.items():
            where = part.units if field.startswith("unit_") else slice(i, i + 1)
            # Sums over what exceeds a limit inherit the absolute error of each inlet.
            limit_c = {"over_27_sum_k": 27.0, "under_18_sum_k": 18.0}.get(field, 0.0)
            scale = limit_c * len(part.load)
            if field == "inlet_m3k_s":
                # A difference to the supply air, which may be none.
                scale = float(np.sum(twin.dcs["outlet_m3k_s"]))
            # Power rises with the cube of an airflow that rises by up to 7 % per K of inlet.
            of_field = 3.0 * rel if field == "it_fan_w" else rel
            assert_close(getattr(sums, field)[where], expected, of_field, (name, field), scale)
        for field, expected in twin.racks.items():
            found = getattr(sums, f"rack_{field}")[part.racks]
            of_field = 3.0 * rel if field == "fan_w" else rel
            assert_close(found, expected, of_field, (name, "rack", field))
        for field, expected in twin.servers.items():
            found = getattr(layers, field)[part.servers]
            assert_close(found, expected, rel, (name, "server", field))
        hottest = layers.inlet_c[part.servers].max()
        fleet = fleet_of(*configs)
        rack = part.racks.start + int(sums.hottest_rack[i])
        server = fleet.server_offsets[fleet.group_offsets[rack]] + int(sums.hottest_server[i])
        assert hottest == sums.inlet_max_c[i]
        assert rank(layers.inlet_c[server]) == rank(hottest)


def at_design(configs: Sequence[DataCenterConfig]) -> HallSums:
    setpoint_c = np.concatenate(
        [np.full(c.hvac.crac.units, c.hall.design_supply_c) for c in configs]
    )
    fleet = fleet_of(*configs)
    speed = fleet.design_speed[fleet.unit_dc]
    conditions = Conditions(setpoint_c, np.ones(len(configs)), unit_low=speed, unit_high=speed)
    return Hall(fleet, "f64").solve(conditions)


def flat(config: DataCenterConfig) -> DataCenterConfig:
    """Servers whose power and airflow depend on the load alone."""
    servers = config.servers.model_copy(
        update={
            "cpu_power_points": ((20.0, 0.01, 1.0),),
            "fan_airflow_points": ((20.0, 0.3, 1.0),),
        }
    )
    return config.model_copy(update={"servers": servers})


def own_part(values: HallSums, configs: Sequence[DataCenterConfig], index: int) -> dict[str, Any]:
    """What a fleet computed for one of its data centers."""
    fleet = fleet_of(*configs)
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


def own_conditions(met: Conditions, configs: Sequence[DataCenterConfig], index: int) -> Conditions:
    fleet = fleet_of(*configs)
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
