"""Liquid cooling with the published parameters of Frontier, beside what was published of it.

    python examples/frontier_study.py [--hours 300]

Racks are those of ``configs/racks.yaml``, after ExaDigiT/RAPS; three of them and a CDU stand for
all, whose load is equal. Random hours of a year in Atlanta have random loads of 0..1. The script
prints power, water temperatures and PUE, and how much of the cooling energy the best flow and
supply setpoint of each hour save.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from sdc_taichi.config.liquid_schema import LiquidRack, with_model
from sdc_taichi.exogenous import load_site
from sdc_taichi.plant.liquid import (
    REJECTION_KINDS,
    CduParameters,
    LiquidFleet,
    PlantParameters,
    RackParameters,
)
from sdc_taichi.sim.liquid import Liquid, LiquidInputs, LiquidResult

F64 = npt.NDArray[np.float64]
RACKS, RACKS_PER_CDU = 74, 3
SETPOINT_C, RANGE_K = 28.0, 4.0
"""Supply setpoint without control, which gives the lowest published return temperature of 30 C, and
largest change of it by control."""
FLOWS = np.arange(0.4, 1.01, 0.1)
AIR_W_PER_W = 0.3
"""Power that cools the air of the hall, for each watt of heat in it: an assumption."""


@dataclass(frozen=True)
class Hours:
    """Weather and load of some hours, (hours,)."""

    outdoor_c: F64
    wet_bulb_c: F64
    load: F64

    @classmethod
    def drawn(cls, count: int, seed: int = 0) -> Hours:
        """Draw hours of a year, and loads."""
        rng = np.random.default_rng(seed)
        weather = load_site("GA")
        at = rng.choice(len(weather.outdoor_c.values), count, replace=False)
        return cls(
            np.asarray(weather.outdoor_c.values)[at],
            np.asarray(weather.wet_bulb_c.values)[at],
            rng.uniform(0.0, 1.0, count),
        )


def simulated(hours: Hours, setpoint_c: float = SETPOINT_C, flow: float = 1.0) -> LiquidResult:
    """Steady results of all hours with one setpoint and one flow."""
    cabinet = LiquidRack(**with_model({"model": "frontier_cabinet"})["liquid"])
    names = {field.name for field in fields(RackParameters)} & {*LiquidRack.model_fields}
    count = len(hours.load)
    fleet = replace(
        LiquidFleet.of_equal(count, racks=RACKS_PER_CDU),
        racks=RackParameters(
            **{name: getattr(cabinet, name) for name in names},
            liquid_design_w=cabinet.design_liquid_w,
        ),
        cdus=CduParameters(setpoint_c=setpoint_c, flow=flow),
        plants=PlantParameters(rejection=REJECTION_KINDS.index("tower")),
    )
    liquid = Liquid(fleet, step_s=900.0)
    inputs = LiquidInputs(
        np.repeat(hours.load, RACKS_PER_CDU),
        np.ones(count * RACKS_PER_CDU),
        hours.outdoor_c,
        hours.wet_bulb_c,
        np.full(count, 10.0),
    )
    return liquid.step(liquid.initial_state(inputs), inputs)[1]


def cooling_w(result: LiquidResult) -> F64:
    """Power of the pumps of CDUs and facility water and of the fans of the tower."""
    return result.cdu_pump_w + result.facility_pump_w + result.cooler_fan_w


def pue(result: LiquidResult) -> F64:
    """PUE, with the cooling of the air of the hall."""
    air_w = AIR_W_PER_W * result.liquid_air_w
    return np.asarray(1.0 + (cooling_w(result) + air_w) / result.liquid_it_w)


def savings(hours: Hours, return_limit_c: float) -> tuple[float, float]:
    """Share of the cooling energy that the best flow saves, and the best flow and setpoint.

    Args:
        hours: Weather and loads.
        return_limit_c: Highest return temperature of the facility water that control may cause.
    """
    usual = simulated(hours)
    best = {flow_alone: cooling_w(usual) for flow_alone in (True, False)}
    for setpoint_c in SETPOINT_C + np.arange(-RANGE_K, RANGE_K + 0.5):
        for flow in FLOWS:
            result = simulated(hours, float(setpoint_c), float(flow))
            valid = result.facility_return_c <= return_limit_c
            power_w = np.where(valid, cooling_w(result), np.inf)
            best[False] = np.minimum(best[False], power_w)
            if setpoint_c == SETPOINT_C:
                best[True] = np.minimum(best[True], power_w)
    before = cooling_w(usual).sum()
    return 1.0 - best[True].sum() / before, 1.0 - best[False].sum() / before


def lines(hours: Hours) -> Iterator[str]:
    """The figures."""
    usual = simulated(hours)
    for name, values in (
        ("IT power (MW)", usual.liquid_it_w * RACKS / RACKS_PER_CDU / 1e6),
        ("facility water supply (C)", usual.facility_supply_c),
        ("facility water return (C)", usual.facility_return_c),
        ("PUE", pue(usual)),
    ):
        low, middle, high = np.quantile(values, (0.05, 0.5, 0.95))
        yield f"{name}: {low:.3g} .. {high:.3g} in 90 % of hours, median {middle:.3g}"
    mean = np.average(pue(usual), weights=usual.liquid_it_w)
    fans = usual.cooler_fan_w.sum() / cooling_w(usual).sum()
    yield f"PUE of the year {mean:.3f}; fans {fans:.0%} of cooling energy"
    for limit_c in (38.0, 40.0, 42.0):
        flow, both = savings(hours, limit_c)
        yield (
            f"return up to {limit_c:g} C: saved by flow {flow:.1%}, by flow and setpoint {both:.1%}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--hours", type=int, default=300)
    for line in lines(Hours.drawn(parser.parse_args(arguments).hours)):
        print(line)


if __name__ == "__main__":
    main()
