"""The loop of a run: a simulator, step after step, under a controller."""

from __future__ import annotations

from collections.abc import Callable

from sdc_taichi.control import PERFECT, Controller, ForecastError, view_maker
from sdc_taichi.errors import whole_number
from sdc_taichi.run.metrics import Totals, add_step, empty_totals
from sdc_taichi.sim.bills import no_demand
from sdc_taichi.sim.events import require_events_start_before
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import I64, StepResult

MOST_STEPS = 100 * 8760 * 60
"""Most steps of a run: a century of minutes."""


def simulate(
    sim: Simulator,
    controller: Controller,
    steps: int,
    seed: int | I64 = 0,
    *,
    forecast_error: ForecastError = PERFECT,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
    totals: Totals | None = None,
) -> Totals:
    """Reset a simulator and its controller, and run them for some steps.

    Args:
        sim: the simulator.
        controller: gives the actions of every step.
        steps: number of steps, at most ``MOST_STEPS``.
        seed: of the simulator's events, of the controller and of errors of forecasts; or one for
            each data center, (B,).
        forecast_error: how the forecasts err that the controller sees.
        on_step: called with the result of every step.
        stop: asked before every step; true ends the run.
        totals: totals that each step is added to as it is done; None makes new ones.

    Returns:
        Totals of the steps that were simulated, from which ``run.metrics`` makes metrics.

    Raises:
        ConfigError: a number of steps out of bounds, or an event that starts after the end.
        PhysicalLimitError: a result that no data center can reach.
        SdcError: the controller gave actions that are not valid.
    """
    steps = whole_number("steps", steps, 0, MOST_STEPS)
    require_events_start_before(steps * sim.step_h, sim.fleet.configs)
    sim.reset(seed)
    controller.reset(seed)
    view_of = view_maker(sim, forecast_error)
    totals = empty_totals(sim.size, sim.step_h) if totals is None else totals
    if totals.steps == 0:
        totals.demand = no_demand(sim.drivers.start, sim.fleet.steps_per_hour)
    last: StepResult | None = None
    for _ in range(steps):
        if stop is not None and stop():
            break
        last = sim.step(controller.act(view_of(last)))
        add_step(totals, last)
        if on_step is not None:
            on_step(last)
    return totals
