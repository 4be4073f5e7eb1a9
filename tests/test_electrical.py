"""The grid connection: what it carries, what does not fit, and what exceeds it."""

from __future__ import annotations

import numpy as np
import pytest

from sdc_taichi import Actions, Simulator, StepResult, load_config
from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F64


def charged(overrides: list[str], command: float = 1.0, steps: int = 8) -> list[StepResult]:
    """Results of some steps in July with one battery command."""
    with Simulator(load_config("corrected", ["site.start=07-01", *overrides])) as sim:
        sim.reset()
        return [sim.step(Actions(battery=command)) for _ in range(steps)]


def column(results: list[StepResult], name: str) -> F64:
    return np.array([getattr(r, name)[0] for r in results])


def design_kw(overrides: list[str]) -> float:
    with Simulator(load_config("corrected", overrides)) as sim:
        return float(sim.sizing.facility_w[0]) / 1e3


def test_a_charge_is_no_stroke_of_lightning() -> None:
    """At 3 C without a limit, one step fills three quarters and draws several times the design."""
    at_3c = ["battery.charge_limit_c_rate=3", "electrical.grid_limit_ratio=null"]
    fast, built = charged(at_3c), charged([])
    assert column(fast, "soc")[0] > 0.7
    assert column(fast, "grid_kwh").max() * 4 > 3 * design_kw([])
    np.testing.assert_allclose(column(built, "soc")[:4], [0.125, 0.25, 0.375, 0.5], rtol=1e-9)
    assert column(built, "grid_kwh").max() * 4 < 1.25 * design_kw([])


@pytest.mark.parametrize("limit", ["grid_limit_kw=500", "grid_limit_ratio=0.664"])
def test_what_does_not_fit_is_not_charged(limit: str) -> None:
    found = charged([f"electrical.{limit}"])
    limit_kw = 500 if "kw" in limit else 0.664 * design_kw([])
    load_kwh = column(found, "it_kwh") + column(found, "hvac_kwh")
    assert np.all(load_kwh < limit_kw / 4), "the load alone fits"
    np.testing.assert_allclose(column(found, "grid_kwh"), limit_kw / 4, rtol=1e-9)
    assert not column(found, "grid_overload_kwh").any()


def test_a_load_above_the_limit_empties_the_battery_and_then_overloads_the_connection() -> None:
    """The battery guards the connection whatever it is commanded, here to charge."""
    found = charged(["electrical.grid_limit_kw=150", "battery.initial_soc=0.1"])
    grid_kwh, over_kwh = column(found, "grid_kwh"), column(found, "grid_overload_kwh")
    assert grid_kwh[0] == pytest.approx(37.5)
    assert over_kwh[0] == 0 < column(found, "discharge_kwh")[0]
    assert column(found, "soc")[-1] < 0.01
    assert over_kwh[-1] > 20
    np.testing.assert_allclose(over_kwh, np.maximum(grid_kwh - 37.5, 0), atol=1e-6)


def test_presets_of_the_paper_have_no_limit() -> None:
    for preset in ("paper", "sustaindc"):
        config = load_config(preset)
        assert config.electrical.grid_limit_kw is config.electrical.grid_limit_ratio is None
    assert load_config("corrected").electrical.grid_limit_ratio == 1.25


def test_a_battery_of_an_hour_carries_an_outage_at_one_c() -> None:
    outage = "events.scheduled=[{kind: grid_outage, start_h: 0.25, duration_h: 0.5}]"
    found = charged([outage, "battery.initial_soc=1"], command=0.0, steps=4)
    assert np.all(column(found, "powered") == 1)
    assert not column(found, "unserved_kwh").any()


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("electrical.grid_limit_kw=0", r"electrical\.grid_limit_kw"),
        ("electrical.grid_limit_ratio=-1", r"electrical\.grid_limit_ratio"),
        ("electrical.grid_limit=1", "did you mean"),
    ],
)
def test_bad_limits_are_named(override: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        load_config("corrected", [override])
