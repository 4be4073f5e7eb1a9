"""Odd values are refused or simulated, and NumPy has nothing to say of either.

Warnings are errors here, as pyproject.toml says, and so is arithmetic that overflows.
"""

from __future__ import annotations

import pytest

from sdc_taichi import Actions, SdcError, Simulator, load_config

RECIRCULATION = ["hall.inlet_model=recirculation", "hall.rows=1", "hall.racks_per_row=2"]


@pytest.mark.parametrize(
    "value",
    [
        "servers.fan_reference_ratio=1e-30",
        "servers.power_w=[1e308, 1e308]",
        "battery.capacity_kwh=1e308",
        "battery.charge_limit_c_rate=1e308",
        "hall.layout.rack_pitch_m=1e-300",
        "hall.layout.ceiling_m=1e300",
        "hall.room_heat_capacity_kj_per_k_per_server=1e308",
    ],
)
def test_values_beyond_all_bounds_are_refused(value: str) -> None:
    with pytest.raises(SdcError, match=value.partition("=")[0]):
        load_config("corrected", [value])


@pytest.mark.parametrize(
    "values",
    [
        ["battery.capacity_kwh=0"],
        ["workload.flexible_share=0", "workload.queue_limit_h=0.001"],
        ["servers.power_w=[150, 0]"],
        ["hall.layout.containment=1", *RECIRCULATION],
    ],
    ids=" ".join,
)
def test_odd_but_valid_halls_run(values: list[str]) -> None:
    base = ["hall.supply_approach_k=4", "hall.return_approach_k=-3", "servers.power_w=[150, 10]"]
    with Simulator(load_config("corrected", base + values)) as sim:
        sim.reset(0)
        for command in (-1.0, 1.0):
            sim.step(Actions(load=command, cooling=command, battery=-command))
