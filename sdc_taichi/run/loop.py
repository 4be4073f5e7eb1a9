"""The loop of a run: a simulator, step after step, under a controller."""

from __future__ import annotations

from collections.abc import Callable

from sdc_taichi.control import Controller, view_maker
from sdc_taichi.run.metrics import Totals, add_step, empty_totals
from sdc_taichi.sim.events import require_events_start_before
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import StepResult


def simulate(
    sim: Simulator,
    controller: Controller,
    steps: int,
    seed: int = 0,
    *,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
    totals: Totals | None = None,
) -> Totals:
    """Reset a simulator and its controller, and run them for some steps.

    Args:
        sim: the simulator.
        controller: gives the actions of every step.
        steps: number of steps.
        seed: of the simulator's events and of the controller.
        on_step: called with the result of every step.
        stop: asked before every step; true ends the run.
        totals: totals that each step is added to as it is done; None makes new ones.

    Returns:
        Totals of the steps that were simulated, from which ``run.metrics`` makes metrics.

    Raises:
        ConfigError: an event that starts after the end of the run.
        PhysicalLimitError: a result that no data center can reach.
        SdcError: the controller gave actions that are not valid.
    """
    require_events_start_before(steps * sim.step_h, sim.fleet.configs)
    sim.reset(seed)
    controller.reset(seed)
    view_of = view_maker(sim)
    totals = empty_totals(sim.size, sim.step_h) if totals is None else totals
    last: StepResult | None = None
    for _ in range(steps):
        if stop is not None and stop():
            break
        last = sim.step(controller.act(view_of(last)))
        add_step(totals, last)
        if on_step is not None:
            on_step(last)
    return totals
