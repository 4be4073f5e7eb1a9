"""The grid connection and its limit, prices of electricity, and bills."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sdc_taichi import Actions, Simulator, StepResult, load_config, preset_names
from sdc_taichi.config.electrical_schema import TariffConfig
from sdc_taichi.control import view_maker
from sdc_taichi.errors import ConfigError
from sdc_taichi.exogenous.year_clock import DAYS_PER_MONTH, FIRST_DAY_OF_MONTH
from sdc_taichi.plant.electrical import LossyDevice
from sdc_taichi.sim.bills import add_power, billed_kw_months, no_demand
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


def test_a_battery_of_an_hour_carries_an_outage_at_one_c() -> None:
    outage = "events.scheduled=[{kind: grid_outage, start_h: 0.25, duration_h: 0.5}]"
    found = charged([outage, "battery.initial_soc=1"], command=0.0, steps=4)
    assert np.all(column(found, "powered") == 1)
    assert not column(found, "unserved_kwh").any()


# Tariff


def prices(values: dict[str, Any]) -> F64:
    """Prices by day of the year and hour, (365, 24)."""
    return TariffConfig.model_validate(values).hourly_prices().reshape(365, 24)


def test_prices_follow_hour_weekday_and_season() -> None:
    summer_peak = {
        "months": [6, 7, 8, 9], "days": "weekdays", "from_h": 16, "to_h": 21, "price_per_kwh": 0.4,
    }  # fmt: skip
    night = {"from_h": 22, "to_h": 6, "price_per_kwh": 0.05}
    weekend = {"days": "weekends", "price_per_kwh": 0.08}
    found = prices({"price_per_kwh": [0.1], "periods": [summer_peak, night, weekend]})
    # 1 January is a Monday, so 1 July, day 181, is a Sunday.
    assert np.all(found[181] == 0.08)
    monday = [0.05] * 6 + [0.1] * 10 + [0.4] * 5 + [0.1] + [0.05] * 2
    assert found[182].tolist() == monday
    assert set(found[0]) == {0.05, 0.1}
    assert np.all(found[5:7] == 0.08)
    for flat in (0.13, [0.13], [0.13] * 24):
        assert np.all(prices({"price_per_kwh": flat}) == 0.13)


def test_a_data_center_pays_its_own_tariff_from_its_own_day_on() -> None:
    """Prices of a fleet are those of each alone, whatever the inputs are stored as."""
    weekend = "tariff.periods=[{days: weekends, price_per_kwh: 0.01}]"
    configs = [
        load_config("tiny", ["name=a", "site.start=07-01"]),
        load_config("tiny", ["name=b", "site.start=07-02", weekend]),
        load_config("tiny", ["name=c", "site.start=07-01", weekend]),
        load_config("tiny", ["name=d", "site.location=CA", "site.start=07-02"]),
    ]
    with Simulator(configs) as sim:
        sim.reset()
        results = [sim.step() for _ in range(40)]
        ahead = view_maker(sim)(None).forecast(24.0).price_per_kwh
    for i, config in enumerate(configs):
        first = 182 if config.site.start == "07-02" else 181
        hours = first * 24 + np.arange(136) // 4
        expected = config.tariff.hourly_prices()[hours]
        paid = [r.price_per_kwh[i] for r in results]
        np.testing.assert_array_equal(paid, expected[:40])
        np.testing.assert_array_equal(ahead[i], expected[40:136])
        cost = [r.energy_cost[i] / r.grid_kwh[i] for r in results]
        np.testing.assert_allclose(cost, expected[:40], rtol=1e-12)


def test_months_pay_their_peaks_by_the_part_that_a_run_covers() -> None:
    """Three years from 1 January, from 11 January and from the last hours of a year."""
    rng = np.random.default_rng(1)
    start = np.array([0, 10 * 24 + 5, 364 * 24 + 20])
    power_kw = rng.uniform(0, 100, (3 * 365 * 24 - 700, 3))
    demand = no_demand(start, 1)
    for step, kw in enumerate(power_kw):
        add_power(demand, step, kw)
    found = billed_kw_months(demand, len(power_kw))
    months = [(year * 365 + first, days)
              for year in range(5)
              for first, days in zip(FIRST_DAY_OF_MONTH, DAYS_PER_MONTH, strict=False)]  # fmt: skip
    for i in range(3):
        day = (start[i] + np.arange(len(power_kw))) // 24
        inside = [(day >= first) & (day < first + days) for first, days in months]
        expected = sum(
            power_kw[covered, i].max() * covered.sum() / (24 * days)
            for covered, (_, days) in zip(inside, months, strict=True)
            if covered.any()
        )
        assert found[i] == pytest.approx(expected, rel=1e-12)
    np.testing.assert_array_equal(demand.peak_kw, power_kw.max(axis=0))


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("electrical.grid_limit_kw=0", r"electrical\.grid_limit_kw"),
        ("electrical.grid_limit_ratio=-1", r"electrical\.grid_limit_ratio"),
        ("electrical.grid_limit=1", "did you mean"),
        ("tariff.price_per_kwh=[1,2]", "2 prices; valid is 1, or 24"),
        ("tariff.price_per_kwh=[-1]", r"tariff\.price_per_kwh"),
        ("tariff.periods=[{months: [6, 6], price_per_kwh: 1}]", "each once"),
        ("tariff.periods=[{days: sundays, price_per_kwh: 1}]", "weekdays"),
        ("tariff.periods=[{from_h: 24, price_per_kwh: 1}]", "from_h"),
        ("tariff.periods=[{from_h: 3}]", "price_per_kwh"),
        ("tariff.demand_charge_per_kw=.inf", "demand_charge_per_kw"),
    ],
)
def test_bad_limits_and_tariffs_are_named(override: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        load_config("corrected", [override])


# Losses


@pytest.mark.parametrize(
    ("device", "load_shares", "efficiencies"),
    [
        ("ups", [0.25, 0.5, 1.0], [0.941, 0.963, 0.970]),
        # 99.02 % at 35 % of the load by regulation, less 0.35 % in the wiring.
        ("distribution", [0.35, 1.0], [0.9902 - 0.0034, 0.975]),
    ],
)
def test_efficiencies_are_the_published_ones(
    device: str, load_shares: list[float], efficiencies: list[float]
) -> None:
    config = getattr(load_config("corrected").electrical, device)
    load_w = 2e5 * np.array(load_shares)
    lost_w = LossyDevice(2e5, **config.model_dump()).loss_w(load_w)
    np.testing.assert_allclose(load_w / (load_w + lost_w), efficiencies, atol=6e-4)


def test_reported_losses_change_nothing_else_and_counted_ones_are_paid_for() -> None:
    reported = ["electrical.losses=reported"]
    # Its standby is a share of the capacity, which is sized for the losses that count.
    same = ["battery.capacity_kwh=500"]
    told, paid = charged([*reported, *same], command=0.0), charged(same, command=0.0)
    for name in ("it_w", "hvac_w", "ups_loss_w", "distribution_loss_w"):
        np.testing.assert_array_equal(column(told, name), column(paid, name))
    lost_kwh = (column(told, "ups_loss_w") + column(told, "distribution_loss_w")) / 4e3
    share = lost_kwh / column(told, "it_kwh")
    assert np.all((share > 0.04) & (share < 0.12)), share
    np.testing.assert_allclose(
        column(paid, "grid_kwh") - column(told, "grid_kwh"), lost_kwh, rtol=1e-9
    )
    np.testing.assert_allclose(column(paid, "pue") - column(told, "pue"), share, rtol=1e-9)
    np.testing.assert_array_equal(column(told, "overhead_w"), column(told, "hvac_w"))
    carbon = column(paid, "carbon_g") / column(told, "carbon_g")
    cost = column(paid, "energy_cost") / column(told, "energy_cost")
    np.testing.assert_allclose(carbon, cost, rtol=1e-12)
    assert design_kw([]) > 1.03 * design_kw(reported)


def test_losses_count_but_in_the_presets_of_paper_and_released_code() -> None:
    for preset in preset_names():
        losses = load_config(preset).electrical.losses
        assert (losses == "reported") == (preset in ("paper", "sustaindc")), preset


def test_nothing_is_lost_without_power() -> None:
    outage = "events.scheduled=[{kind: grid_outage, start_h: 0.25, duration_h: 0.5}]"
    found = charged([outage, "battery.capacity_kwh=0"], 0.0, 4)
    for name in ("ups_loss_w", "distribution_loss_w", "overhead_w", "grid_kwh"):
        lost = column(found, name)
        assert lost[0] > 0 == lost[1] == lost[2] < lost[3], name
