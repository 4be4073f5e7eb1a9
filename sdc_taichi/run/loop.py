"""Loop of a run: advance a simulator step by step under a controller."""

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
"""Maximum number of steps of a run: a century of one-minute steps."""


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
        sim: The simulator.
        controller: Controller of the run.
        steps: Number of steps, at most ``MOST_STEPS``.
        seed: Seed of the simulator's events, the controller and the forecast errors; or one seed
            per data center, (B,).
        forecast_error: Error model of the forecasts that the controller sees.
        on_step: Callback that receives the result of every step.
        stop: Callback before every step; the run ends if it returns True.
        totals: Totals to which every completed step is added; None creates new totals.

    Returns:
        Totals of the completed steps, from which ``run.metrics`` computes metrics.

    Raises:
        ConfigError: The number of steps is out of range, or an event starts after the end.
        PhysicalLimitError: A result is physically impossible.
        SdcError: An action of the controller is not valid.
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
