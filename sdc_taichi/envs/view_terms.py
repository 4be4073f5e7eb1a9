"""Reward terms that are functions of the view: of the cooling of a hall, and of transfers.

**Cooling of a hall.** Powers are divided by the power of the cooling at the design point. The
power of the facility is compared with that of ``follow``: the same halls in a steady state at the
same mean load, in the mean weather of the year, in which the fans of the CRAC units follow the need
of the servers at the initial setpoint. No action changes it, so the comparison changes no optimal
policy, but it removes most of the influence of the load (Weaver and Tao 2001). The mean of
``zone_power`` over the units of a data center is its ``hall_power``.

**Transfers between sites.** Work that a site sends counts at the mean carbon intensity or price of
the coming 24 h at the receiver, with the transfer, less that at the sender. Work that runs at once
emits or costs less or more than that; the terms ``work_carbon`` and ``cooling_carbon``, or
``work_cost`` and ``cooling_cost``, of the receiver contain the difference.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.envs.reward_terms import CI_G_PER_KWH, PRICE_PER_KWH, TermContext
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.stages import SteadyFacility
from sdc_taichi.sim.transfer import task_kwh
from sdc_taichi.types import F64, I64, StepResult

UTILISATIONS = np.array([0.05, 0.2, 0.4, 0.6, 0.8, 1.0])
"""Utilisations at which the power of ``follow`` is computed; values between are interpolated."""
LEAST_HEADROOM_K = 5.0
"""Junction headroom below which rewards and costs charge each kelvin, in K."""
HIGHEST_RECOMMENDED_C = RECOMMENDED_C[1]
"""Highest inlet temperature that ASHRAE TC 9.9 recommends, in C."""


class ViewContext:
    """Quantities that the terms need in addition to the result and the view of a step."""

    cooling_w: F64
    """Power of the cooling at the design point, in W, (B,)."""
    terms: TermContext
    """Context of the terms that are compiled."""

    def __init__(self, terms: TermContext) -> None:
        self.terms = terms
        self._sizing: Sizing | None = None

    def reset(self, view: View) -> None:
        """Start an episode."""
        if view.sizing is self._sizing:
            return
        sizing = self._sizing = view.sizing
        self.cooling_w = sizing.facility_w - sizing.counted_loss_w - sizing.it_w
        self.moved_kwh = task_kwh(view.fleet, sizing)
        self._follow_power_w: F64 | None = None

    def follow_w(self, view: View, demand: F64) -> F64:
        """Return the power of the facility under ``follow``, in W, (B,).

        Args:
            view: the view of the step.
            demand: work of the step as a share of capacity, 0..1, (B,).
        """
        if self._follow_power_w is None:
            self._follow_power_w = _follow_w(view)
        table_w = self._follow_power_w
        last = len(UTILISATIONS) - 2
        low = np.clip(np.searchsorted(UTILISATIONS, demand) - 1, 0, last)
        dcs = np.arange(len(demand))
        weight = (demand - UTILISATIONS[low]) / (UTILISATIONS[low + 1] - UTILISATIONS[low])
        below_w, above_w = table_w[low, dcs], table_w[low + 1, dcs]
        return np.asarray(below_w + weight * (above_w - below_w))


ViewTerm = Callable[[StepResult, View, ViewContext], F64]
"""Reward term: a function of the result of a step, the view after it and the context that returns
rewards of data centers, (B,), or of CRAC units, (U,)."""


def hall_power(r: StepResult, v: View, c: ViewContext) -> F64:
    """Power of the facility less that of `follow`, divided by the design power of the cooling."""
    facility_w = r.facility_kwh * 1e3 / r.step_h
    return -(facility_w - c.follow_w(v, r.demand)) / c.cooling_w


def hall_heat(r: StepResult, v: View, c: ViewContext) -> F64:
    """Excess of the hottest inlet over the recommended 27 C, in K (ASHRAE TC 9.9)."""
    return -np.maximum(r.inlet_max_c - HIGHEST_RECOMMENDED_C, 0.0)


def zone_power(r: StepResult, v: View, c: ViewContext) -> F64:
    """`hall_power`, in which a unit has its own fan, share of the plant and servers' fans.

    A unit's share of the plant is its share of the airflow, and its servers are those of its zone.
    The power of the processors is shared equally.
    """
    fleet = v.fleet
    dc, counts = fleet.unit_dc, np.diff(fleet.unit_offsets)
    speed = r.unit_flow_m3s / fleet.unit_design_m3s
    cubes = fleet.unit_design_m3s * speed**3
    fans_w = cubes * _per_sum(r.crac_fan_w, cubes, v)[dc]
    plant_w = r.unit_flow_m3s * _per_sum(r.hvac_w - r.crac_fan_w, r.unit_flow_m3s, v)[dc]
    zones = v.zones.racks(r.unit_running)
    server_fans_w = np.add.reduceat(r.rack_fan_w[zones.racks].astype(np.float64), zones.first)
    own_w = fans_w + plant_w + server_fans_w
    mean_w = fleet.unit_sums(own_w) / counts
    excess = (own_w - mean_w[dc]) * (counts / c.cooling_w)[dc]
    return np.asarray(hall_power(r, v, c)[dc] - excess)


def zone_heat(r: StepResult, v: View, c: ViewContext) -> F64:
    """Excess of the hottest inlet of the own zone over the recommended 27 C, in K."""
    return -np.maximum(v.zone_hottest_true_c - HIGHEST_RECOMMENDED_C, 0.0)


def hot_junctions(r: StepResult, v: View, c: ViewContext) -> F64:
    """Lack of headroom of the hottest GPU junction below 5 K under its throttling limit, in K."""
    return -np.maximum(LEAST_HEADROOM_K - v.junction_headroom_k, 0.0)


def geo_carbon(r: StepResult, v: View, c: ViewContext) -> F64:
    """Carbon of the sent work at the receivers with the transfer, less that at the sender."""
    added_g = _of_sent_work(r, v, c, r.ci_g_per_kwh, c.terms.coming_ci)
    return np.asarray(-added_g / (c.terms.design_kwh * CI_G_PER_KWH))


def geo_cost(r: StepResult, v: View, c: ViewContext) -> F64:
    """Cost of the electricity of the sent work, analogous to `geo_carbon`, in units of `cost`."""
    added = _of_sent_work(r, v, c, r.price_per_kwh, c.terms.coming_price)
    return np.asarray(-added / (c.terms.design_kwh * PRICE_PER_KWH))


def _of_sent_work(r: StepResult, v: View, c: ViewContext, now: F64, coming: F64) -> F64:
    """Compute the carbon or cost that sent work adds, (B,), in the unit of ``now`` times kWh.

    Args:
        r: result of the step.
        v: the view after the step.
        c: context of the step.
        now: carbon intensity or price in the step, per kWh, (B,).
        coming: mean of the carbon intensity or price of the coming 24 h, per kWh, (B,).
    """
    flows = v.flows_tasks
    sites = flows.shape[-1]
    there, now_there = (x.reshape(-1, 1, sites) for x in (coming, now))
    here, now_here = (x.reshape(-1, sites, 1) for x in (coming, now))
    moved = (flows * (there - here)).sum(axis=2).reshape(-1) * c.moved_kwh
    fleet_tasks = flows.sum(axis=(1, 2))
    fleet_kwh = r.transfer_kwh.reshape(-1, sites).sum(axis=1)
    kwh_per_task = fleet_kwh / np.where(fleet_tasks > 0.0, fleet_tasks, 1.0)
    mean_rates = (flows * (0.5 * (now_there + now_here))).sum(axis=2)
    return np.asarray(moved + (mean_rates * kwh_per_task[:, None]).reshape(-1))


def _per_sum(of_dc: F64, per_unit: F64, view: View) -> F64:
    """Return values of data centers divided by sums over their units, (B,); 0 for sums of 0."""
    sums = view.fleet.unit_sums(per_unit)
    return np.asarray(of_dc / np.where(sums > 0.0, sums, 1.0) * (sums > 0.0))


OF_DATA_CENTERS: dict[str, ViewTerm] = {
    f.__name__: f for f in (hall_power, hall_heat, hot_junctions, geo_carbon, geo_cost)
}
"""Terms of the agents of a data center, by name."""
OF_UNITS: dict[str, ViewTerm] = {f.__name__: f for f in (zone_power, zone_heat)}
"""Terms of the agents of CRAC units, by name."""


def _follow_w(view: View) -> F64:
    """Return the power of the facility under ``follow`` at ``UTILISATIONS``, in W, (6, B)."""
    first_dc: dict[int, int] = {}
    for dc, config in enumerate(view.fleet.configs):
        first_dc.setdefault(id(config), dc)
    distinct = list(first_dc)
    which = [distinct.index(id(config)) for config in view.fleet.configs]
    dcs: I64 = np.array(list(first_dc.values()), dtype=np.int64)
    steady = SteadyFacility(
        [_with_followers(config) for config in view.fleet.configs],
        view.drivers,
        np.tile(dcs, len(UTILISATIONS)),
        np.repeat(UTILISATIONS, len(dcs)),
        np.tile(view.fleet.values("hvac.setpoint.initial_c")[dcs], len(UTILISATIONS)),
        view.precision,
    )
    means = [
        np.array([series.distinct()[0][i].mean() for i in series.distinct()[1][dcs]])
        for series in (view.drivers.outdoor_c, view.drivers.wet_bulb_c)
    ]
    step = steady.at(*(np.tile(mean_c, len(UTILISATIONS)) for mean_c in means))
    steady.close()
    power_w = step.facility_kwh.reshape(len(UTILISATIONS), -1) * 1e3 / view.step_h
    return np.asarray(power_w[:, which])


def _with_followers(config: Any) -> Any:
    """Return a config in which the fans of the CRAC units follow the need of the servers."""
    crac = config.hvac.crac.model_copy(update={"flow_model": "follow_servers"})
    work = config.workload.model_copy(update={"zone_loads": None})
    hvac = config.hvac.model_copy(update={"crac": crac})
    return config.model_copy(update={"hvac": hvac, "workload": work})
