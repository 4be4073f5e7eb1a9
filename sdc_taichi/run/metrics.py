"""Metrics of a run: energy, carbon, water, work and temperatures of each data center.

``add_step`` accumulates sums step by step, so that a year of a large fleet needs no more memory
than a day; ``metrics_per_dc`` and ``metrics_of_fleet`` compute metrics from the sums. Sums are f64
and separate for each data center, so its metrics do not depend on the other data centers.

Definitions (PUE, CUE and WUE after The Green Grid, white papers 49, 32 and 35):

    facility_kwh     IT + HVAC (the devices of ``hvac.total_of``), without the battery; with
                     ``electrical.losses: counted`` also the losses of UPS and distribution
    battery_net_kwh  charged - discharged; grid_kwh = facility_kwh + battery_net_kwh
    pue              facility / IT
    pue_with_losses  (IT + HVAC + losses of UPS and distribution) / IT, counted or not
    partial_pue      (IT + chiller + tower fan) / IT
    wue_l_per_kwh    make-up water / IT
    cue_kg_per_kwh   cfp_kg / IT, cfp_kg being grid energy times carbon intensity, step by step
    battery_throughput_kwh  energy delivered, as warranties count it
    over_27_degree_h  inlet temperature in excess of 27 C, summed over time, mean over the servers
    shi, rhi, rti_pct, rci_hi_pct, rci_lo_pct  means over the steps (see ``air_metrics``)
    rci_hi_min_pct   minimum of rci_hi_pct over the steps
    time_to_throttle_min  from the start of the first event to the end of the first later step in
                     which a rack throttles or trips; None if there is no event or no such step
    energy_cost      grid energy times the price of the tariff, step by step
    demand_charge    price of a kW times the largest step-mean power of each month; a month that the
                     run covers only in part is weighted by the covered share
    cost             energy_cost + demand_charge, in the currency of the tariff

Fleets whose sites share work also have:

    moved_tasks      work that left for other sites; refused_tasks stayed for links or room
    link_use         moved_tasks / what the links could carry; None without limits
    transfer_kwh, transfer_g  energy and emissions of transfers, not part of grid_kwh and cfp_kg

A ratio to IT energy is None if there is no IT energy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C, rank
from sdc_taichi.sim.bills import BilledDemand, add_power, billed_kw_months, no_demand
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, StepResult

Metric = float | int | str | None
"""A metric: a number, the name of a data center, or None where a ratio is not defined."""

_SUMMED_FIELDS = (
    "it_kwh",
    "hvac_kwh",
    "overhead_w",
    "ups_loss_w",
    "distribution_loss_w",
    "grid_kwh",
    "charge_kwh",
    "discharge_kwh",
    "carbon_g",
    "water_l",
    "arrived_tasks",
    "executed_tasks",
    "dropped_tasks",
    "overdue_tasks",
    "queue_tasks",
    "chiller_w",
    "tower_fan_w",
    "unmet_w",
    "lost_tasks",
    "unserved_kwh",
    "grid_overload_kwh",
    "energy_cost",
    "over_27_mean_k",
    "throttled_racks",
    "tripped_racks",
    "shi",
    "rti_pct",
    "rci_hi_pct",
    "rci_lo_pct",
    "sent_tasks",
    "refused_tasks",
    "transfer_kwh",
    "transfer_g",
)
"""Fields of ``StepResult`` that are summed over the steps."""
_MEAN_FIELDS = ("shi", "rti_pct", "rci_hi_pct", "rci_lo_pct")
"""Fields of ``_SUMMED_FIELDS`` whose metric is the mean over the steps."""


@dataclass(slots=True)
class Totals:
    """Sums and extremes of quantities of B data centers over the steps of a run."""

    steps: int
    """Number of steps."""
    step_h: float
    """Length of a step, in h."""
    sums: dict[str, F64]
    """Sum over the steps of each summed field of ``StepResult``, in its unit, (B,) each."""
    hot_steps: I64
    """Number of steps with an inlet above the recommended 27 C, (B,)."""
    queue_end_tasks: F64
    """Queued work at the end of the last step, in tasks, (B,)."""
    queue_max_tasks: F64
    """Maximum queued work over the steps, in tasks, (B,)."""
    overdue_max_tasks: F64
    """Maximum overdue work over the steps, in tasks, (B,)."""
    hottest_inlet_c: F64
    """Highest server inlet temperature over the steps, in C, (B,)."""
    hottest_rack: I64
    """Index of the rack with the hottest inlet, counted from 0 in its data center, (B,)."""
    hottest_server: I64
    """Index of the server with the hottest inlet, from 0 at the floor of its rack, (B,)."""
    hottest_step: I64
    """Index of the step with the hottest inlet, counted from 0 at reset, (B,)."""
    rci_hi_min_pct: F64
    """Minimum over the steps of the rack cooling index at the high end, in %, (B,)."""
    first_event_step: I64
    """First step that an event covers, -1 if there is none, (B,)."""
    first_throttle_step: I64
    """First step, from ``first_event_step`` on, with a throttled or tripped rack, -1 if there is
    none, (B,)."""
    demand: BilledDemand
    """Peak power of each month, for demand charges."""


def finite_or_none(value: float) -> float | None:
    """Return a number for JSON: None if ``value`` is nan or infinite."""
    return float(value) if np.isfinite(value) else None


def empty_totals(size: int, step_h: float) -> Totals:
    """Return the totals before the first step of a run."""
    return Totals(
        steps=0,
        step_h=step_h,
        sums={name: np.zeros(size) for name in _SUMMED_FIELDS},
        hot_steps=np.zeros(size, dtype=np.int64),
        queue_end_tasks=np.zeros(size),
        queue_max_tasks=np.zeros(size),
        overdue_max_tasks=np.zeros(size),
        hottest_inlet_c=np.full(size, -np.inf),
        hottest_rack=np.zeros(size, dtype=np.int64),
        hottest_server=np.zeros(size, dtype=np.int64),
        hottest_step=np.zeros(size, dtype=np.int64),
        rci_hi_min_pct=np.full(size, np.inf),
        first_event_step=np.full(size, -1),
        first_throttle_step=np.full(size, -1),
        # ``loop.simulate`` replaces the billed demand by one with the actual start of the run.
        demand=no_demand(np.zeros(size, dtype=np.int64), round(1.0 / step_h)),
    )


def add_step(totals: Totals, result: StepResult) -> None:
    """Add one step to the totals, in place."""
    add_power(totals.demand, totals.steps, result.grid_kwh / totals.step_h)
    totals.steps += 1
    for name, total in totals.sums.items():
        total += getattr(result, name)
    totals.hot_steps += result.inlet_max_c > RECOMMENDED_C[1] + LEAST_EXCESS_K
    totals.queue_end_tasks[:] = result.queue_tasks
    np.maximum(totals.queue_max_tasks, result.queue_tasks, out=totals.queue_max_tasks)
    np.maximum(totals.overdue_max_tasks, result.overdue_tasks, out=totals.overdue_max_tasks)
    hotter = np.flatnonzero(result.inlet_max_c > totals.hottest_inlet_c)
    if hotter.size:
        inlet_c, before_c = result.inlet_max_c[hotter], totals.hottest_inlet_c[hotter]
        totals.hottest_inlet_c[hotter] = inlet_c
        hotter = hotter[rank(inlet_c) > rank(before_c)]
        totals.hottest_step[hotter] = result.step
        totals.hottest_rack[hotter] = result.hottest_rack[hotter]
        totals.hottest_server[hotter] = result.hottest_server[hotter]
    np.minimum(totals.rci_hi_min_pct, result.rci_hi_pct, out=totals.rci_hi_min_pct)
    first_event, first_throttle = totals.first_event_step, totals.first_throttle_step
    first_event[(first_event < 0) & (result.active_events > 0)] = result.step
    hot = (result.throttled_racks > 0) | (result.tripped_racks > 0)
    first_throttle[(first_throttle < 0) & (first_event >= 0) & hot] = result.step


def metrics_per_dc(totals: Totals, fleet: Fleet) -> list[dict[str, Metric]]:
    """Compute the metrics of every data center, in fleet order; at least one step is needed."""
    throttle_min = times_to_throttle_min(totals)
    demand_charge = _demand_charge(totals, fleet)
    link_tasks = _link_tasks(fleet)
    out = []
    for dc in range(fleet.size):
        sums = {name: float(values[dc]) for name, values in totals.sums.items()}
        out.append(
            _energy_and_work(sums, totals.step_h)
            | _cost(sums, float(demand_charge[dc]), float(totals.demand.peak_kw[dc]))
            | {
                "queue_mean_tasks": sums["queue_tasks"] / totals.steps,
                "queue_end_tasks": float(totals.queue_end_tasks[dc]),
                "queue_max_tasks": float(totals.queue_max_tasks[dc]),
                "overdue_max_tasks": float(totals.overdue_max_tasks[dc]),
                "inlet_above_27_h": int(totals.hot_steps[dc]) * totals.step_h,
                "hottest_inlet_c": float(totals.hottest_inlet_c[dc]),
                **_hottest_place(totals, dc, fleet),
                **_mean_metrics(
                    totals, {name: float(totals.sums[name][dc]) for name in _MEAN_FIELDS}
                ),
                "over_27_degree_h": sums["over_27_mean_k"] * totals.step_h,
                "rci_hi_min_pct": float(totals.rci_hi_min_pct[dc]),
                "time_to_throttle_min": throttle_min[dc],
                "hottest_step": int(totals.hottest_step[dc]),
            }
            | ({} if link_tasks is None else _transfers(sums, link_tasks[dc] * totals.steps))
        )
    return out


def metrics_of_fleet(totals: Totals, fleet: Fleet) -> dict[str, Metric]:
    """Compute the metrics of the whole fleet from totals of one or more steps.

    Energies, carbon, water, tasks, hours and costs are sums over the data centers, and ratios are
    ratios of these sums. ``queue_mean_tasks`` is the mean over the data centers, because a task is
    1 % of the capacity of its data center. ``queue_max_tasks``, ``overdue_max_tasks`` and
    ``peak_kw`` are maxima over the data centers, and ``time_to_throttle_min`` is the minimum.
    """
    sums = {name: float(values.sum()) for name, values in totals.sums.items()}
    hottest = int(np.argmax(rank(totals.hottest_inlet_c)))
    servers = fleet.per_dc_servers()
    throttle_min = times_to_throttle_min(totals)
    cost = _cost(
        sums, float(_demand_charge(totals, fleet).sum()), float(totals.demand.peak_kw.max())
    )
    link_tasks = _link_tasks(fleet)
    transfers = {} if link_tasks is None else _transfers(sums, link_tasks.sum() * totals.steps)
    return _energy_and_work(sums, totals.step_h) | {
        **cost,
        "queue_mean_tasks": sums["queue_tasks"] / totals.steps / fleet.size,
        "queue_end_tasks": float(totals.queue_end_tasks.sum()),
        "queue_max_tasks": float(totals.queue_max_tasks.max()),
        "overdue_max_tasks": float(totals.overdue_max_tasks.max()),
        "inlet_above_27_h": int(totals.hot_steps.sum()) * totals.step_h,
        "hottest_inlet_c": float(totals.hottest_inlet_c.max()),
        "hottest_dc": fleet.names[hottest],
        **_hottest_place(totals, hottest, fleet),
        **_mean_metrics(totals, {name: sums[name] / fleet.size for name in _MEAN_FIELDS}),
        "over_27_degree_h": float(totals.sums["over_27_mean_k"] @ servers)
        / servers.sum()
        * totals.step_h,
        "rci_hi_min_pct": float(totals.rci_hi_min_pct.min()),
        "time_to_throttle_min": min((x for x in throttle_min if x is not None), default=None),
        "hottest_step": int(totals.hottest_step[hottest]),
        **transfers,
    }


def times_to_throttle_min(totals: Totals) -> list[float | None]:
    """Return the minutes from the first event to the first throttled rack of each data center.

    The time ends at the end of the step in which the rack throttles. The value is None if there is
    no event or no throttled rack.
    """
    steps = totals.first_throttle_step + 1 - totals.first_event_step
    throttles = totals.first_throttle_step >= 0
    return [
        float(n * totals.step_h * 60.0) if throttled else None
        for n, throttled in zip(steps, throttles, strict=True)
    ]


def _link_tasks(fleet: Fleet) -> F64 | None:
    """Return the most work that each site can send in a step, (B,); None if all run alone."""
    return None if fleet.shared_work is None else fleet.shared_work.link_tasks


def _transfers(sums: dict[str, float], link_tasks: float) -> dict[str, Metric]:
    """Return the metrics of transfers.

    Args:
        sums: Sum over the steps of each field of ``_SUMMED_FIELDS``, by name.
        link_tasks: Most work that could be sent in these steps, in tasks, inf for no limit.
    """
    moved = sums["sent_tasks"]
    return {
        "moved_tasks": moved,
        "refused_tasks": sums["refused_tasks"],
        "link_use": moved / float(link_tasks) if 0 < link_tasks < np.inf else None,
        "transfer_kwh": sums["transfer_kwh"],
        "transfer_g": sums["transfer_g"],
    }


def _demand_charge(totals: Totals, fleet: Fleet) -> F64:
    """Return the demand charges of a run, in the currency of the tariff, (B,)."""
    kw_months = billed_kw_months(totals.demand, totals.steps)
    return np.asarray(kw_months * fleet.values("tariff.demand_charge_per_kw"))


def _cost(sums: dict[str, float], demand_charge: float, peak_kw: float) -> dict[str, Metric]:
    """Return the metrics of peak power and cost."""
    return {
        "peak_kw": peak_kw,
        "energy_cost": sums["energy_cost"],
        "demand_charge": demand_charge,
        "cost": sums["energy_cost"] + demand_charge,
    }


def _hottest_place(totals: Totals, dc: int, fleet: Fleet) -> dict[str, Metric]:
    """Return rack, row and server of the hottest inlet of a data center."""
    rack = int(totals.hottest_rack[dc])
    return {
        "hottest_rack": rack,
        "hottest_row": rack // fleet.configs[dc].hall.racks_per_row,
        "hottest_server": int(totals.hottest_server[dc]),
    }


def without_repeated_pue(names: Sequence[str], metrics: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return names of metrics, but not that of the PUE with losses where the PUE counts them.

    Args:
        names: Names of metrics.
        metrics: Metrics of the runs or data centers to print, keyed by name.
    """
    pairs = [(of.get("pue"), of.get("pue_with_losses")) for of in metrics]
    repeats = all(a == b or (a and b and math.isclose(a, b)) for a, b in pairs)
    return [name for name in names if not (repeats and name == "pue_with_losses")]


def _mean_metrics(totals: Totals, sums: dict[str, float]) -> dict[str, Metric]:
    """Return the means over the steps of the air indices, and RHI = 1 - SHI."""
    means = {name: value / totals.steps for name, value in sums.items()}
    return {**means, "rhi": 1.0 - means["shi"]}


def _energy_and_work(sums: dict[str, float], step_h: float) -> dict[str, Metric]:
    """Compute the metrics of energy, carbon, water and work.

    Args:
        sums: Sum over the steps of each field of ``_SUMMED_FIELDS``, by name.
        step_h: Length of a step, in h.
    """
    it_kwh, hvac_kwh = sums["it_kwh"], sums["hvac_kwh"]
    overhead_kwh, ups_kwh, distribution_kwh, compression_kwh = (
        power_w * step_h / 1e3
        for power_w in (
            sums["overhead_w"],
            sums["ups_loss_w"],
            sums["distribution_loss_w"],
            sums["chiller_w"] + sums["tower_fan_w"],
        )
    )
    facility_kwh = it_kwh + overhead_kwh
    cfp_kg = sums["carbon_g"] / 1e3

    def per_it(value: float) -> float | None:
        return value / it_kwh if it_kwh > 0 else None

    return {
        "it_kwh": it_kwh,
        "hvac_kwh": hvac_kwh,
        "ups_loss_kwh": ups_kwh,
        "distribution_loss_kwh": distribution_kwh,
        "facility_kwh": facility_kwh,
        "battery_net_kwh": sums["charge_kwh"] - sums["discharge_kwh"],
        "grid_kwh": sums["grid_kwh"],
        "pue": per_it(facility_kwh),
        "pue_with_losses": per_it(it_kwh + hvac_kwh + ups_kwh + distribution_kwh),
        "partial_pue": per_it(it_kwh + compression_kwh),
        "wue_l_per_kwh": per_it(sums["water_l"]),
        "cue_kg_per_kwh": per_it(cfp_kg),
        "cfp_kg": cfp_kg,
        "water_l": sums["water_l"],
        "battery_charge_kwh": sums["charge_kwh"],
        "battery_discharge_kwh": sums["discharge_kwh"],
        "battery_throughput_kwh": sums["discharge_kwh"],
        "unserved_kwh": sums["unserved_kwh"],
        "grid_overload_kwh": sums["grid_overload_kwh"],
        "unmet_cooling_kwh": sums["unmet_w"] * step_h / 1e3,
        "arrived_tasks": sums["arrived_tasks"],
        "executed_tasks": sums["executed_tasks"],
        "dropped_tasks": sums["dropped_tasks"],
        "lost_tasks": sums["lost_tasks"],
        "throttled_rack_h": sums["throttled_racks"] * step_h,
        "tripped_rack_h": sums["tripped_racks"] * step_h,
        "overdue_task_h": sums["overdue_tasks"] * step_h,
    }
