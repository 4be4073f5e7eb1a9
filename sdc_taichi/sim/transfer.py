"""Transfers of flexible work between the sites of a fleet, and the work that is on its way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.events import Mask
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.shared_work import SharedWork
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.workload import queue_limit_tasks
from sdc_taichi.types import F64, State, TransferQuantities

if TYPE_CHECKING:
    from sdc_taichi.kernels.compiler.launch import BoundKernel


@dataclass
class TransferResult(TransferQuantities):
    """Transfers of one step of B data centers."""

    in_flight: F64
    """Work on its way to each data center at the end of the step, by the number of steps until it
    arrives, the next step first, in tasks, (B, delay steps)."""


class Flows:
    """Computes feasible flows of work between the sites of each fleet with a kernel.

    Args:
        shared: Links of F fleets of S sites, B = F S data centers.
    """

    def __init__(self, shared: SharedWork) -> None:
        size, sites = shared.allowed.shape
        self._pairs, self._sites = (size // sites, sites, sites), (size // sites, sites)
        self._limits = (
            np.ascontiguousarray(shared.allowed.reshape(self._pairs)),
            np.ascontiguousarray(shared.pair_tasks.reshape(self._pairs)),
            np.zeros(self._sites),
        )
        self._site_tasks = shared.site_tasks
        # These arrays are bound once: passing a new array costs more than copying its entries.
        self._shares, self.flow = np.zeros(self._pairs), np.zeros(self._pairs)
        self._flexible, self._room = np.zeros(self._sites), np.zeros(self._sites)
        self._totals = np.zeros((3, *self._sites))
        self._kernel: BoundKernel | None = None

    def of(
        self, shares: F64, flexible: F64, room: F64, link_up: Mask | bool = True
    ) -> tuple[F64, F64, F64]:
        """Return work that each site sends, gets, and was to send but keeps, in tasks, (B,) each.

        ``flow`` has the work by sender and receiver, in tasks, (F, S, S), until the next call.

        Args:
            shares: Share of the flexible work of each site to send to the sites of its fleet,
                (B, S); values are limited to 0..1, and their sum to 1.
            flexible: Work that may go, in tasks, (B,).
            room: Work that each site can take, in tasks, (B,).
            link_up: True for sites that can send and get work, (B,) or one value for all.
        """
        if self._kernel is None:
            from sdc_taichi.kernels.compiler.launch import BoundKernel
            from sdc_taichi.kernels.transfer import transfer_kernel

            runtime.ensure_started()
            self._kernel = BoundKernel(transfer_kernel(), templates=1)
        from sdc_taichi.kernels.transfer import SERIAL_UP_TO

        self._shares[:] = shares.reshape(self._pairs)
        self._flexible.reshape(-1)[:], self._room.reshape(-1)[:] = flexible, room
        allowed, pair_limit, site_limit = self._limits
        site_limit.reshape(-1)[:] = np.where(link_up, self._site_tasks, 0.0)
        self._kernel(
            self._pairs[0] <= SERIAL_UP_TO,
            1,
            self._shares,
            allowed,
            pair_limit,
            site_limit,
            self._flexible,
            self._room,
            self.flow,
            self._totals,
        )
        sent, got, refused = self._totals.reshape(3, -1).copy()
        return sent, got, refused

    def release(self) -> None:
        """Release the kernel."""
        self._kernel = None


class Transfer:
    """Moves flexible work between the sites of each fleet.

    A site can take work up to the room M = queue limit - queue - work on its way to it + the part
    of the work that arrives in the step for which it has capacity beside its own work. Since own
    work does not exceed capacity, nothing is then dropped on arrival, unless a site loses capacity
    or fills its queue on command. In a batch of data centers that run alone nothing moves.
    """

    def __init__(self, fleet: Fleet, sizing: Sizing) -> None:
        self._size, self._shared = fleet.size, fleet.shared_work
        self._flows = None if self._shared is None else Flows(self._shared)
        self._sends = False
        if self._shared is not None:
            self._flexible_share = fleet.values("workload.flexible_share")
            self._max_utilisation = fleet.values("workload.max_utilisation")
            self._queue_limit = queue_limit_tasks(fleet)
            self.kwh_per_task = transfer_kwh_per_task(fleet, sizing)
            """Energy of a transfer, in kWh per task, (B,)."""

    def nothing_in_flight(self) -> F64:
        """Return the work in flight before the first step, (B, delay steps)."""
        return np.zeros((self._size, 0 if self._shared is None else self._shared.delay_steps))

    def run(
        self,
        state: State,
        shares: F64 | None,
        demand: F64,
        ci_g_per_kwh: F64,
        max_utilisation: F64 | float,
        link_up: Mask,
    ) -> TransferResult:
        """Send flexible work of a step, and return it with the work that arrives.

        Args:
            state: State at the start of the step, of which queues and work in flight are read.
            shares: Commanded shares of the flexible work, (B, S); None sends nothing.
            demand: Arriving work as a share of capacity, 0..1, (B,).
            ci_g_per_kwh: Carbon intensity of each site, in g CO2e/kWh, (B,).
            max_utilisation: Maximum work that the racks can run, as a share of all servers, (B,)
                or one value for all.
            link_up: True for sites whose links work, (B,). Work on its way arrives in any case.
        """
        sent, got, refused, kwh, carbon_g, on_way = np.zeros((6, self._size))
        if self._flows is None:
            return TransferResult(sent, got, refused, kwh, carbon_g, on_way, state.in_flight)
        in_flight = state.in_flight
        self._sends = shares is not None
        if shares is not None:
            capacity = np.minimum(self._max_utilisation, max_utilisation) * TASKS_PER_STEP
            own = demand * TASKS_PER_STEP
            runs = np.minimum(in_flight[:, 0], np.maximum(capacity - own, 0.0))
            room = self._queue_limit - state.queue[:, -1] - in_flight.sum(axis=1) + runs
            flexible = self._flexible_share * own
            sent, got, refused = self._flows.of(shares, flexible, np.maximum(room, 0.0), link_up)
            kwh = 0.5 * self.kwh_per_task * (sent + got)
            carbon_g = kwh * ci_g_per_kwh
        after = np.concatenate([in_flight[:, 1:], got[:, None]], axis=1)
        return TransferResult(
            sent, in_flight[:, 0].copy(), refused, kwh, carbon_g, after.sum(axis=1), after
        )

    def flows_tasks(self) -> F64:
        """Return the work sent in the last step by sender and receiver, in tasks, (F, S, S)."""
        if self._flows is None:
            return np.zeros((self._size, 1, 1))
        return self._flows.flow if self._sends else np.zeros_like(self._flows.flow)

    def close(self) -> None:
        """Release the kernel arrays."""
        if self._flows is not None:
            self._flows.release()


def task_kwh(fleet: Fleet, sizing: Sizing) -> F64:
    """Return the facility energy of a task, in kWh, (B,), as the mean of the sites of a fleet.

    The servers need 1 % of the difference of their full and idle power during a step, and the
    facility this energy times the PUE of the design point.
    """
    step_h = 1.0 / fleet.steps_per_hour
    servers_w = np.array([count @ (full - idle) for count, full, idle, *_ in fleet.group_rows])
    kwh = servers_w * (sizing.facility_w / sizing.it_w) * (step_h / 1e3 / TASKS_PER_STEP)
    sites = fleet.sites_per_fleet
    return np.repeat(kwh.reshape(-1, sites).mean(axis=1), sites)


def transfer_kwh_per_task(fleet: Fleet, sizing: Sizing) -> F64:
    """Return the energy of a transfer, in kWh per task, (B,), equal at all sites of a fleet."""
    kwh = fleet.values("fleet.transfer_kwh_per_task")
    by_ratio = fleet.values("fleet.transfer_energy_ratio") * task_kwh(fleet, sizing)
    return np.where(np.isnan(kwh), by_ratio, kwh)
