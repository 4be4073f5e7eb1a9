"""Histories of racks keep every step of short runs, and the highest values of long ones."""

from __future__ import annotations

import numpy as np
import pytest

from sdc_taichi import Simulator, load_config, make_configs
from sdc_taichi.viz import rack_histories
from sdc_taichi.viz.rack_histories import RackHistory


@pytest.mark.parametrize(("times", "stride"), [(None, 1), (64, 4)])
def test_values_are_those_of_the_steps(
    monkeypatch: pytest.MonkeyPatch, times: int | None, stride: int
) -> None:
    if times is not None:
        monkeypatch.setattr(rack_histories, "MAX_BYTES", 1)
        monkeypatch.setattr(rack_histories, "_UNREDUCED_BYTES", 3_000)
    configs = make_configs(load_config("corrected"), count=2)
    with Simulator(configs) as sim:
        sim.reset()
        history = RackHistory(sim.fleet, 1)
        results = []
        for _ in range(150):
            results.append(sim.step())
            history.add(results[-1])
    racks = np.array([3, 0, 19])
    values = history.of_racks(racks)
    assert values.steps.tolist() == list(range(0, 150, stride))
    starts = values.steps
    for shown, field, tolerance in (
        (values.inlet_c, "rack_inlet_max_c", 1 / 256),
        (values.outlet_c, "rack_outlet_c", 1 / 256),
        (values.power_kw, "rack_power_w", 1e-3),
    ):
        every_step = np.array([getattr(r, field)[20 + racks] for r in results])
        if field == "rack_power_w":
            every_step = every_step / 1e3
        expected = np.maximum.reduceat(every_step, starts, axis=0)
        np.testing.assert_allclose(shown, expected, atol=tolerance + 1e-5)
    peak_c = np.max([r.rack_inlet_max_c[20:] for r in results], axis=0)
    np.testing.assert_allclose(history.peak_inlet_c(), peak_c, atol=1 / 256 + 1e-5)
