"""Memory that a step takes."""

from __future__ import annotations

import tracemalloc

import pytest

from sdc_taichi import Simulator, drivers_from_arrays, load_config


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_a_step_has_no_temporary_of_the_size_of_the_servers(thermal: str) -> None:
    days = [20.0] * 96, [15.0] * 96, [300.0] * 96, [0.5] * 96
    overrides = [
        "hall.rows=20",
        "hall.racks_per_row=50",
        "hall.supply_approach_k=5.0",
        "hall.return_approach_k=-3.0",
        "servers.power_w=[200, 20]",
        f"simulation.thermal={thermal}",
    ]
    sim = Simulator(load_config("corrected", overrides), drivers=drivers_from_arrays(*days))
    sim.reset(0)
    sim.step()
    tracemalloc.start()
    try:
        sim.step()
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sim.fleet.servers >= 100_000
    assert most < sim.fleet.servers
