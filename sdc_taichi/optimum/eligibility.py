"""Which data centers have tables that hold all that a step costs, and why others have none."""

from __future__ import annotations

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.optimum.problem import FacilityTable, Problem
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64

_PLACEMENT = {
    "coolest-first": "placement coolest-first follows the inlets of the step before",
    "inlet-aware": "placement inlet-aware follows the inlets of the step before",
    "weights": "placement weights lets actions move work between racks",
}
"""Policies of placement whose work lies elsewhere than in the table."""


def no_table_reasons(fleet: Fleet) -> tuple[str | None, ...]:
    """Why the cost of a step follows from more than utilisation, setpoint and weather.

    Args:
        fleet: B data centers.

    Returns:
        The reasons of each data center in words, or None where its tables are exact, B.
    """
    return tuple("; ".join(_reasons(config)) or None for config in fleet.configs)


def uncooled_reason(table: FacilityTable, utilisation: F64) -> str | None:
    """Why idle commands leave a table: steps in which no setpoint keeps up with the load.

    Args:
        table: What steps cost.
        utilisation: Utilisation of each step, 0..1, (T,).

    Returns:
        The reason in words; None where some setpoint does in every step.
    """
    cooled = (table.unmet_w == 0.0).any(axis=2)
    high = np.searchsorted(table.utilisation, utilisation).clip(1, len(table.utilisation) - 1)
    steps = np.arange(len(utilisation))
    # A utilisation at a node, if rounded, needs no more than that node.
    share = (utilisation - table.utilisation[high - 1]) / np.diff(table.utilisation)[high - 1]
    kept = (cooled[steps, high - 1] | (share > 1.0 - 1e-9)) & (cooled[steps, high] | (share < 1e-9))
    if kept.all():
        return None
    return (
        f"in {np.count_nonzero(~kept)} of {len(kept)} steps no setpoint cools the hall without "
        "heat that stays in the room or racks that throttle"
    )


def forced_discharge_reason(problem: Problem) -> str | None:
    """Why a battery that no plan moves may move: it delivers what the grid does not carry.

    Args:
        problem: Planning problem of the data center.

    Returns:
        The reason in words; None where the battery stays at rest.
    """
    table, limit_kw = problem.table, problem.grid_limit_kw
    most_kw = float(np.where(table.unmet_w == 0.0, table.facility_kwh, 0.0).max()) / problem.step_h
    if "battery" in problem.agents or problem.storage.stored_kwh <= 0 or most_kw <= limit_kw:
        return None
    return (
        f"the facility may need {most_kw:.4g} kW where the grid connection carries {limit_kw:.4g}, "
        "and a battery that plans do not move then delivers the difference"
    )


def _reasons(config: DataCenterConfig) -> list[str]:
    """What the table of a data center leaves out."""
    events = config.events
    reasons = []
    if config.simulation.thermal == "transient":
        reasons.append("servers and air of transient halls remember their temperatures")
    if events.scheduled:
        kinds = ", ".join(sorted({event.kind for event in events.scheduled}))
        reasons.append(f"scheduled events change the plant or the weather on the way ({kinds})")
    if events.sampled:
        kinds = ", ".join(sorted({event.kind for event in events.sampled}))
        reasons.append(f"sampled events are not known in advance ({kinds})")
    if config.workload.placement in _PLACEMENT:
        reasons.append(_PLACEMENT[config.workload.placement])
    if config.hvac.crac.flow_model == "controlled":
        reasons.append("actions move the fans (flow model controlled)")
    return reasons
