"""Recirculating halls: against their NumPy twin, and what must hold for every layout and load."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import reference_twin
from sdc_taichi import ConfigError, DataCenterConfig, build_fleet, load_config
from sdc_taichi.config import HallConfig, config_from_dict
from sdc_taichi.hall import Conditions, Hall, HallSums, Precision
from sdc_taichi.recirculation import DENSE_RACKS, calibrate, layout_exchange
from sdc_taichi.types import F64, I64, ServerLayers

SEEDS = st.integers(0, 2**32 - 1)
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
        try:
            calibrate(config)
        except ConfigError as error:
            assert "approach" in str(error) or "breathe" in str(error), error
            continue
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
        group_load=rng.uniform(0, 1, len(fleet.groups[0])) if kind == 2 else None,
        powered=rng.choice([0.0, 0.4, 1.0, 1.0, 1.0], racks),
        rack_airflow=rng.choice([0.5, 1.0, 1.0], racks),
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
    powered: F64
    breath: F64


def parts(configs: list[DataCenterConfig], met: Conditions) -> list[Part]:
    """Every data center of a fleet, for the twin."""
    fleet, out = build_fleet(configs), []
    for i, config in enumerate(configs):
        racks = slice(*fleet.rack_start[i : i + 2])
        groups = slice(fleet.group_start[racks.start], fleet.group_start[racks.stop])
        servers = slice(fleet.server_start[groups.start], fleet.server_start[groups.stop])
        units = slice(*fleet.unit_start[i : i + 2])
        twin = reference_twin.calibrated(config)
        if met.group_load is not None:
            counts = np.diff(fleet.server_start)[groups]
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
        powered=part.powered,
        breath=part.breath,
    )


def assert_close(found: Any, expected: Any, rel: float, name: object, scale: float = 0.0) -> None:
    """Equal to ``rel`` of themselves or of ``scale``."""
    np.testing.assert_allclose(found, expected, rtol=rel, atol=rel * scale, err_msg=str(name))
