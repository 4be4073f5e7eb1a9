"""Allocation of work to racks: capacity, placement, and the thermal protection of the racks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sdc_taichi.hall import protection
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C, allowable_c
from sdc_taichi.hall.placement import make_bins, place
from sdc_taichi.hall.protection import THROTTLED, TRIPPED, Mask
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_state import HallSums
from sdc_taichi.sim.step_inputs import Commands, Surroundings
from sdc_taichi.sim.workload import WorkResult
from sdc_taichi.types import F64, I64, RackQuantities, State, Status

UNMET_SHARE = 0.01
"""Maximum share of unmet cooling load at which cooling counts as sufficient for a rack restart."""


@dataclass
class Capacity:
    """Maximum work that B data centers can run in one step."""

    utilisation: F64 | float
    """Maximum work of each data center as a share of all its servers, 0..1, (B,) or a scalar."""
    bins: F64 | None
    """Maximum utilisation of each bin (rack or server group), 0..1; None means no limit."""


@dataclass
class Placement:
    """Placement of one step's work: B data centers, R racks, G server groups."""

    utilisation: F64
    """Started work as a share of all servers, 0..1, (B,)."""
    placed_utilisation: F64
    """Started work that is placed on servers, as a share of all servers, (B,)."""
    rack_load: F64 | None
    """Utilisation of each rack while it is on, 0..1, (R,); None loads all racks equally."""
    group_load: F64 | None
    """Utilisation of each server group while it is on, 0..1, (G,); None distributes the load of a
    rack by the load weights of its servers."""
    rack_powered: F64 | None
    """Share of the step during which each rack is on, 0..1, (R,); None means the whole step."""


@dataclass
class RackOutcome(RackQuantities):
    """Status and work of R racks in B data centers after the thermal protection of a step."""

    restart_wait_min: F64
    """Time for which each tripped rack has been able to restart, in min, (R,); empty if racks have
    no protection."""


class LiquidOutcome(Protocol):
    """Effects of liquid cooling on R racks and the work of B data centers, see ``LiquidStep``."""

    tripped: I64
    without_coolant: I64
    throttled_tasks: F64
    without_room_tasks: F64


class WorkAllocation:
    """Distributes work over the racks of a fleet, and applies their thermal protection.

    Work is placed in bins. With policy ``uniform``, which preserves the load weights within a rack,
    the bins are racks; with all other policies they are server groups.

    Args:
        fleet: B data centers with R racks and G server groups.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._policy = fleet.models["placement"]
        self._per_rack = self._policy == "uniform"
        self._servers = fleet.per_dc_servers()
        self._rack_servers = fleet.per_rack_servers()
        self._bin_servers = self._rack_servers if self._per_rack else fleet.per_group_servers()
        starts = fleet.rack_offsets if self._per_rack else fleet.group_offsets[fleet.rack_offsets]
        self._bins = make_bins(starts, fleet.names)
        classes = [c.protection.ashrae_class for c in fleet.configs]
        limit_c = np.array([np.inf if c is None else allowable_c(c)[1] for c in classes])
        trip_c = limit_c + fleet.values("protection.trip_margin_k")
        self._protected = bool(np.any(np.isfinite(limit_c))) or fleet.liquid is not None
        outlet_limit_c = fleet.values("protection.outlet_limit_c")
        unlimited = np.isnan(outlet_limit_c) | np.isinf(limit_c)
        outlet_trip_c = np.where(unlimited, np.inf, fleet.values("protection.outlet_trip_c"))
        limits = {
            "limit_c": limit_c,
            "trip_c": trip_c,
            "outlet_limit_c": np.where(unlimited, np.inf, outlet_limit_c),
            "outlet_trip_c": outlet_trip_c,
        }
        self._limits = {name: each[fleet.rack_dc] + LEAST_EXCESS_K for name, each in limits.items()}
        names = ("limit_c", "trip_c"), ("outlet_limit_c", "outlet_trip_c")
        self._inlet_c, self._outlet_c = (min(self._limits[x].min() for x in of) for of in names)
        self._step_min = 60.0 / fleet.steps_per_hour
        restart_c = fleet.values("protection.restart_c")
        midway_c = 0.5 * (RECOMMENDED_C[1] + limit_c)
        restart_c = np.where(np.isnan(restart_c), midway_c, restart_c)
        self._restart_c = restart_c[fleet.rack_dc] + LEAST_EXCESS_K
        self._hold_min = fleet.values("protection.restart_hold_min")[fleet.rack_dc]
        self._most_starts = self._racks_per_step()
        self._unlimited = Capacity(utilisation=1.0, bins=None)
        self._throttle_share = fleet.values("protection.throttle_share")[fleet.rack_dc]
        self._allowable_high_c = np.array([allowable_c(c)[1] for c in classes])

    def initial_wait_min(self) -> F64:
        """Return ``restart_wait_min`` before the first step, (R,); empty without protection."""
        return np.zeros(self._fleet.racks if self._protected else 0)

    @property
    def watches_inlets(self) -> bool:
        """True if the placement policy reads the inlet temperatures of the last step."""
        return self._policy in ("coolest-first", "inlet-aware")

    def capacity(self, state: State, commands: Commands, surroundings: Surroundings) -> Capacity:
        """Return the maximum work of a step.

        Args:
            state: State at the start of the step, of which the status of each rack is read.
            commands: Commands with the weights of the server groups; groups of weight 0 get no
                work.
            surroundings: Surroundings with the powered share of the step.
        """
        weights = commands.group_weights
        if weights is None and self._fully_on(state.rack_status, surroundings):
            return self._unlimited
        per_rack = protection.capacity(state.rack_status, self._throttle_share)
        per_rack = per_rack * surroundings.powered[self._fleet.rack_dc]
        bins = per_rack if self._per_rack else self._spread(per_rack)
        usable = bins if weights is None else np.where(weights > 0, bins, 0.0)
        fits = self._bins.sums(self._bin_servers * usable)
        return Capacity(utilisation=fits / self._servers, bins=bins)

    def place(
        self,
        state: State,
        commands: Commands,
        surroundings: Surroundings,
        work: WorkResult,
        capacity: Capacity,
    ) -> Placement:
        """Place the started work on racks or server groups by the policy of the fleet.

        Args:
            state: State at the start of the step, of which status and inlets are read.
            commands: Commands with the weights of the server groups.
            surroundings: Surroundings with the powered share of the step.
            work: Work that starts in the step.
            capacity: Maximum work of the step.

        Raises:
            PlacementError: Weights are negative, not finite, or all 0.
        """
        rack_powered = self._rack_powered(state.rack_status, surroundings)
        # Rounding to whole tasks can exceed the number of servers.
        utilisation = np.minimum(work.utilisation, 1.0)
        if self._per_rack and capacity.bins is None:
            return Placement(utilisation, work.utilisation, None, None, rack_powered)
        all_bins = np.ones(len(self._bin_servers))
        weights = all_bins if commands.group_weights is None else commands.group_weights
        load, placed_utilisation = place(
            self._policy,
            work.utilisation,
            bins=self._bins,
            count=self._bin_servers,
            capacity=all_bins if capacity.bins is None else capacity.bins,
            inlet_c=state.group_inlet_c,
            limit_c=self._allowable_high_c,
            weights=weights if self._policy == "weights" else None,
        )
        if not surroundings.fully_powered:
            on = surroundings.powered[self._bins.dc]
            load = load / np.where(on > 0, on, 1.0)
        rack_load, group_load = (load, None) if self._per_rack else (None, load)
        return Placement(utilisation, placed_utilisation, rack_load, group_load, rack_powered)

    def protect(
        self,
        state: State,
        surroundings: Surroundings,
        work: WorkResult,
        placement: Placement,
        air: HallSums,
        plant: Mapping[str, Any],
        liquid: LiquidOutcome | None = None,
    ) -> RackOutcome:
        """Throttle, trip and restart racks by their hottest inlets and outlets.

        Args:
            state: State at the start of the step, of which the status of each rack is read.
            surroundings: Surroundings with running CRAC units and rack fan failures.
            work: Work that starts in the step.
            placement: Placement of the work.
            air: Hall results with the hottest inlet and outlet of each rack.
            plant: Plant results by name, with total and unmet cooling load.
            liquid: Effects of liquid cooling on racks and work; None for fleets without it.
        """
        lost_share = np.maximum(work.utilisation - placement.placed_utilisation, 0.0)
        status, wait_min = state.rack_status.copy(), state.restart_wait_min
        if self._protected:
            if status.any() or self._may_be_hot(air):
                status, wait_min = self._by_temperature(state, surroundings, air, plant, liquid)
            if liquid is not None:
                status[liquid.tripped] = TRIPPED
            if status.any():
                lost_share = lost_share + self._tripped_work(state.rack_status, status, placement)
        lost_tasks = TASKS_PER_STEP * lost_share
        executed_tasks = work.started_tasks - lost_tasks
        if liquid is not None:
            executed_tasks = executed_tasks - liquid.throttled_tasks
            lost_tasks = lost_tasks + liquid.without_room_tasks
        return RackOutcome(
            restart_wait_min=wait_min,
            rack_status=status,
            throttled_racks=self._racks_in(status, THROTTLED),
            tripped_racks=self._racks_in(status, TRIPPED),
            lost_tasks=lost_tasks,
            executed_tasks=executed_tasks,
        )

    def _may_be_hot(self, air: HallSums) -> bool:
        """Return False if no rack is warmer than the lowest of all limits."""
        inlet_c = float(np.maximum.reduce(air.rack_inlet_max_c))
        outlet_c = float(np.maximum.reduce(air.rack_outlet_max_c))
        return not (inlet_c <= self._inlet_c and outlet_c <= self._outlet_c)

    def _by_temperature(
        self,
        state: State,
        surroundings: Surroundings,
        air: HallSums,
        plant: Mapping[str, Any],
        liquid: LiquidOutcome | None,
    ) -> tuple[Status, F64]:
        """Return the status of each rack by its hottest inlet and outlet, and ``restart_wait_min``.

        Arguments are those of ``protect``; the results have the shape (R,).
        """
        before, wait_min = state.rack_status, state.restart_wait_min
        inlet_max_c = air.rack_inlet_max_c.astype(np.float64)
        fans_failed = np.zeros(len(before), np.bool_)
        if surroundings.rack_airflow is not None:
            fans_failed = surroundings.rack_airflow < 1.0
        restarts = np.zeros(len(before), np.bool_)
        if (before == TRIPPED).any():
            cooled = self._is_cooled(surroundings, plant)[self._fleet.rack_dc] & ~fans_failed
            if liquid is not None:
                cooled[liquid.without_coolant] = False
            restarts, wait_min = self._restart(before, wait_min, inlet_max_c, cooled)
        status = protection.protect(
            before,
            inlet_max_c,
            air.rack_outlet_max_c.astype(np.float64),
            **self._limits,
            throttle_share=self._throttle_share,
            fans_failed=fans_failed,
            restarts=restarts,
        )
        return status, wait_min

    def _restart(
        self, before: Status, wait_min: F64, inlet_max_c: F64, cooled: Mask
    ) -> tuple[Mask, F64]:
        """Return the racks that restart in a step, and the new ``restart_wait_min``, (R,) each."""
        wait_min = protection.ready_min(
            before, wait_min, inlet_max_c, cooled, restart_c=self._restart_c, dt=self._step_min
        )
        ready = (wait_min > 0) & (wait_min >= self._hold_min)
        restarts = protection.first_of_each(ready, self._most_starts, self._fleet.rack_offsets)
        return restarts, np.where(restarts, 0.0, wait_min)

    def _racks_per_step(self) -> I64:
        """Return the maximum number of racks that may restart in a step, at least one, (B,)."""
        racks = np.diff(self._fleet.rack_offsets)
        share = self._fleet.values("protection.restart_share") * self._step_min
        # The tolerance absorbs round-off in products that are meant to be whole numbers.
        return np.maximum(np.floor(share * racks + 1e-9), 1.0).astype(np.int64)

    def _is_cooled(self, surroundings: Surroundings, plant: Mapping[str, Any]) -> Mask:
        """Return True for data centers with a running CRAC unit and sufficient cooling, (B,)."""
        any_runs = self._fleet.unit_sums(surroundings.unit_running) > 0
        load_w = np.abs(plant["cooling_load_w"])
        return np.asarray(any_runs & (plant["unmet_w"] <= UNMET_SHARE * load_w))

    def _fully_on(self, status: Status, surroundings: Surroundings) -> bool:
        """Return True if all racks have normal status and power throughout the step."""
        return surroundings.fully_powered and not (self._protected and status.any())

    def _rack_powered(self, status: Status, surroundings: Surroundings) -> F64 | None:
        """Return the share of the step during which each rack is on, (R,); None if all are on."""
        if self._fully_on(status, surroundings):
            return None
        return np.where(status == TRIPPED, 0.0, surroundings.powered[self._fleet.rack_dc])

    def _racks_in(self, status: Status, which: int) -> F64:
        """Count the racks of each data center with status ``which``, (B,)."""
        if not (self._protected and status.any()):
            return np.zeros(len(self._servers))
        return self._fleet.rack_sums(status == which)

    def _tripped_work(self, before: Status, after: Status, placement: Placement) -> F64:
        """Return the work lost on racks that trip in a step, as a share of all servers, (B,)."""
        fleet, tripped = self._fleet, (after == TRIPPED) & (before != TRIPPED)
        if not tripped.any():
            return np.zeros(fleet.size)
        if placement.group_load is not None:
            busy = fleet.group_sums(fleet.per_group_servers() * placement.group_load)
        elif placement.rack_load is not None:
            busy = self._rack_servers * placement.rack_load
        else:
            busy = self._rack_servers * placement.placed_utilisation[fleet.rack_dc]
        if placement.rack_powered is not None:
            busy = busy * placement.rack_powered
        return fleet.rack_sums(busy * tripped) / self._servers

    def _spread(self, per_rack: F64) -> F64:
        """Repeat rack values, (R,), for each server group, (G,)."""
        return np.repeat(per_rack, np.diff(self._fleet.group_offsets))
