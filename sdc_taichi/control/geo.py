"""Rules that send work between the sites of a fleet, by the present carbon intensity.

No rule sends work from or to a site whose links were down in the last step.

B data centers form F fleets of S sites, see ``Fleet.sites_per_fleet``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sdc_taichi.control.rules import WithoutMemory
from sdc_taichi.control.view import View
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.transfer import task_kwh, transfer_kwh_per_task
from sdc_taichi.types import F64, I64, Actions

Destinations = Callable[[F64], F64]
"""Function that takes the carbon intensity, in g CO2e/kWh, (F, S), and returns the share of its
flexible work that each site (row) sends to each site (column), (F, S, S)."""


def all_to_cleanest(ci: F64) -> F64:
    """Send all flexible work to the site with the lowest carbon intensity."""
    return _to_first(ci, 1)


def three_cleanest(ci: F64) -> F64:
    """Send equal parts to those of the three cleanest sites that are cleaner than the sender."""
    return _to_first(ci, 3)


def all_cleaner(ci: F64) -> F64:
    """Send equal parts to all sites that are cleaner than the sender."""
    return _to_first(ci, ci.shape[1])


def _to_first(ci: F64, count: int) -> F64:
    """Send equal parts to all of the ``count`` cleanest sites that are cleaner than the sender."""
    rank = np.argsort(np.argsort(ci, axis=1, kind="stable"), axis=1)
    goes = (ci[:, None, :] < ci[:, :, None]) & (rank[:, None, :] < count)
    shares: F64 = goes / np.maximum(goes.sum(axis=2, keepdims=True), 1)
    return shares


class Alone(WithoutMemory):
    """Rule by which each site decides for itself, without knowledge of what the others send.

    Args:
        destinations: Shares by carbon intensity.
    """

    commands = ("transfer",)
    """Fields of ``Actions`` that it gives."""

    def __init__(self, destinations: Destinations) -> None:
        self._destinations = destinations

    def act(self, view: View) -> Actions:
        """Return shares of flexible work to send."""
        sites = view.fleet.sites_per_fleet
        ci = np.where(view.link_up > 0, view.now.ci_g_per_kwh, np.inf)
        shares = self._destinations(ci.reshape(-1, sites)).reshape(-1, sites)
        return Actions(transfer=shares * view.link_up[:, None])


class Central:
    """Rule that fills the cleanest sites first, from the dirtiest sender on, for a whole fleet.

    A site gets work up to the capacity that its own work of the step and its queue leave free, and
    only while the move saves more carbon than the transfer emits.
    """

    commands = ("transfer",)
    """Fields of ``Actions`` that it gives."""

    def __init__(self) -> None:
        self.reset(0)

    def reset(self, seed: int | I64) -> None:
        """Begin an episode that does not depend on earlier ones."""
        self._ratio: F64 = np.zeros(0)
        self._of: tuple[Fleet, Sizing] | None = None

    def act(self, view: View) -> Actions:
        """Return shares of flexible work to send."""
        fleet, shared = view.fleet, view.fleet.shared_work
        assert shared is not None
        if self._of is None or self._of[0] is not fleet or self._of[1] is not view.sizing:
            self._of = fleet, view.sizing
            self._ratio = transfer_kwh_per_task(fleet, view.sizing) / task_kwh(fleet, view.sizing)
            self._flexible_share = fleet.values("workload.flexible_share")
            self._link = np.where(shared.allowed > 0.0, shared.pair_tasks, 0.0)
            self._capacity = fleet.values("workload.max_utilisation") * TASKS_PER_STEP
        sites, now = fleet.sites_per_fleet, view.now
        own = now.demand * TASKS_PER_STEP
        flexible = self._flexible_share * own * view.link_up
        free = np.maximum(self._capacity - own - view.state.queue[:, -1], 0.0)
        flow = central_flows(
            now.ci_g_per_kwh.reshape(-1, sites),
            np.minimum(flexible, shared.site_tasks).reshape(-1, sites),
            (np.minimum(free, shared.site_tasks) * view.link_up).reshape(-1, sites),
            self._link.reshape(-1, sites, sites),
            self._ratio.reshape(-1, sites)[:, 0],
        )
        shares = flow.reshape(-1, sites) / np.where(flexible > 0, flexible, 1.0)[:, None]
        return Actions(transfer=shares)


def central_flows(ci: F64, flexible: F64, free: F64, link: F64, ratio: F64) -> F64:
    """Return the flows of the rule ``Central``, in the unit of the work, (F, S, S).

    Args:
        ci: Carbon intensity of each site, in g CO2e/kWh, (F, S).
        flexible: Work that each site can send, (F, S).
        free: Work that each site can take, (F, S).
        link: Most work from each site (row) to each site (column), (F, S, S).
        ratio: Energy of a transfer divided by the facility energy of the work, (F,).
    """
    fleets, sites = ci.shape
    order = np.argsort(ci, axis=1, kind="stable")
    rows = np.arange(fleets)[:, None]
    ci, left, free = (values[rows, order] for values in (ci, flexible, free))
    link = link[rows[..., None], order[:, :, None], order[:, None, :]]
    flow = np.zeros((fleets, sites, sites))
    for s in range(sites - 1, 0, -1):
        for d in range(s):
            pays = ci[:, s] - ci[:, d] > 0.5 * ratio * (ci[:, s] + ci[:, d])
            moved = np.minimum(np.minimum(left[:, s], free[:, d]), link[:, s, d]) * pays
            left[:, s] -= moved
            free[:, d] -= moved
            flow[:, s, d] = moved
    unsorted = np.zeros_like(flow)
    unsorted[rows[..., None], order[:, :, None], order[:, None, :]] = flow
    return unsorted
