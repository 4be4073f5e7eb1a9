"""Runs of simulators, and what one data center of a fleet did in them, for tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi import (
    Actions,
    DataCenterConfig,
    Drivers,
    Simulator,
    StepResult,
    drivers_from_arrays,
    load_config,
    make_configs,
)
from sdc_taichi.types import QUANTITIES

if TYPE_CHECKING:
    from sdc_taichi import Recorder


def short_drivers(size: int = 1, steps: int = 96, seed: int = 0) -> Drivers:
    """Random weather, carbon intensity and demand."""
    rng = np.random.default_rng(seed)
    wet_bulb = rng.uniform(-5, 24, (size, steps))
    return drivers_from_arrays(
        wet_bulb + 5,
        wet_bulb,
        rng.uniform(50, 600, (size, steps)),
        rng.uniform(0, 1, (size, steps)),
    )


def random_actions(
    steps: int, configs: Sequence[DataCenterConfig], seed: int = 0, *, places: bool = False
) -> list[Actions]:
    """Random commands of load, setpoint and battery, and with ``places`` weights of the racks."""
    rng = np.random.default_rng(seed)
    size, racks = len(configs), sum(c.hall.racks for c in configs)
    return [
        Actions(
            rng.uniform(-1, 1, size),
            rng.integers(-1, 2, size).astype(np.float64),
            rng.uniform(-1, 1, size),
            placement=rng.uniform(0, 1, racks) if places else None,
        )
        for _ in range(steps)
    ]


def small(count: int = 1) -> Simulator:
    """Simulator of data centers of preset ``tiny``."""
    return Simulator(make_configs(load_config("tiny"), count=count))


def go_on(sim: Simulator, rec: Recorder, steps: int) -> None:
    """Step, and record."""
    for _ in range(steps):
        rec.add(sim.step())


def run(sim: Simulator, actions: Sequence[Actions]) -> list[StepResult]:
    return [sim.step(a) for a in actions]


def assert_same(ones: Sequence[StepResult], others: Sequence[StepResult]) -> None:
    """Equal to the bit."""
    for one, other in zip(ones, others, strict=True):
        for f in fields(one):
            a, b = getattr(one, f.name), getattr(other, f.name)
            assert np.array_equal(a, b), (f.name, one.step)


def part_of(result: StepResult, configs: Sequence[DataCenterConfig], index: int) -> StepResult:
    """What one data center did in a step of a fleet."""
    racks = np.cumsum([0, *(c.hall.racks for c in configs)])
    units = np.cumsum([0, *(c.hvac.crac.units for c in configs)])
    cdus = [
        0 if c.liquid is None else c.liquid.cdus.manifolds * c.liquid.cdus.per_manifold
        for c in configs
    ]
    firsts = {"R": racks, "U": units, "C": np.cumsum([0, *cdus])}
    values: dict[str, Any] = {}
    for f in fields(result):
        value = getattr(result, f.name)
        if isinstance(value, np.ndarray):
            axis = QUANTITIES[f.name].axis if f.name in QUANTITIES else "B"
            first = firsts.get(axis, np.arange(len(configs) + 1))
            value = value[first[index] : first[index + 1]]
        values[f.name] = value
    return StepResult(**values)


def actions_of(actions: Actions, configs: Sequence[DataCenterConfig], index: int) -> Actions:
    """The commands of one data center of a fleet."""
    racks, one = np.cumsum([0, *(c.hall.racks for c in configs)]), slice(index, index + 1)
    load, cooling, battery = (
        np.asarray(getattr(actions, n))[one] for n in ("load", "cooling", "battery")
    )
    placement = actions.placement
    if placement is not None:
        placement = placement[racks[index] : racks[index + 1]]
    return Actions(load, cooling, battery, placement=placement)
