"""Which racks may work, where the work of a data center goes, and what its racks make of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.hall import protection
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C, allowable_c
from sdc_taichi.hall.placement import make_bins, place
from sdc_taichi.hall.protection import THROTTLED, TRIPPED, Mask
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import HallSums
from sdc_taichi.sim.step_inputs import Commands, Surroundings
from sdc_taichi.sim.workload import WorkResult
from sdc_taichi.types import F64, I64, RackQuantities, State, Status

UNMET_SHARE = 0.01
"""Cooling keeps up where no more than this share of the cooling load stays in the room."""


@dataclass
class Capacity:
    """How much work fits into one step: B data centers."""

    utilisation: F64 | float
    """Highest work of each data center as a share of all its servers, 0..1, (B,) or for all."""
    bins: F64 | None
    """Highest utilisation of each rack or server group, 0..1; None loads all of them freely."""


@dataclass
class Placement:
    """Work of one step in its place: B data centers, R racks, G server groups."""

    utilisation: F64
    """Work that starts, as a share of all servers, 0..1, (B,)."""
    placed_utilisation: F64
    """Work that found a place, as a share of all servers, (B,)."""
    rack_load: F64 | None
    """Utilisation of each rack while it is on, 0..1, (R,); None loads all racks alike."""
    group_load: F64 | None
    """Utilisation of each server group while it is on, 0..1, (G,); None spreads the load of a rack
    over its servers by their load weights."""
    rack_powered: F64 | None
    """Share of the step that each rack is on, 0..1, (R,); None is all of it."""


@dataclass
class RackOutcome(RackQuantities):
    """Results of one step of R racks in B data centers, from their work and inlets."""

    restart_wait_min: F64
    """Time for which tripped racks have been able to restart, in min, (R,); empty where no rack
    ever trips."""


class WorkAllocation:
    """The racks of a fleet as places for work.

    Bins of work are racks with policy ``uniform``, which keeps the load weights within a rack, and
    server groups with all others.

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
        self._protected = bool(np.any(np.isfinite(limit_c)))
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
        """``restart_wait_min`` before the first step, (R,), or empty where no rack ever trips."""
        return np.zeros(self._fleet.racks if self._protected else 0)

    @property
    def watches_inlets(self) -> bool:
        """Whether placement needs the inlets of the last step."""
        return self._policy in ("coolest-first", "inlet-aware")

    def capacity(self, state: State, commands: Commands, surroundings: Surroundings) -> Capacity:
        """How much work fits into a step.

        Args:
            state: State at the start of the step, with the status of each rack.
            commands: Weights of the server groups; those of weight 0 take no work.
            surroundings: How long each data center has power.
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
        """Put work in its place by the policy of the fleet.

        Args:
            state: State at the start of the step, with the inlets if the policy watches them.
            commands: Weights of the server groups.
            surroundings: How long each data center has power.
            work: Work that starts.
            capacity: How much of it fits.

        Raises:
            PlacementError: Weights that are negative, not finite, or all 0.
        """
        rack_powered = self._rack_powered(state.rack_status, surroundings)
        # Whole tasks may round to more than there are servers.
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
    ) -> RackOutcome:
        """Racks throttle, trip and restart by their hottest inlets and outlets.

        Args:
            state: State at the start of the step, with the status of each rack.
            surroundings: Which CRAC units run, and what is left of the racks' fans.
            work: Work that starts.
            placement: Where it runs.
            air: Hottest inlet and outlet of each rack.
            plant: Cooling load, and what of it was not met.
        """
        lost_share = np.maximum(work.utilisation - placement.placed_utilisation, 0.0)
        before, status = state.rack_status, state.rack_status.copy()
        wait_min = state.restart_wait_min
        if self._protected:
            inlet_max_c = air.rack_inlet_max_c.astype(np.float64)
            fans_failed = np.zeros(len(before), np.bool_)
            if surroundings.rack_airflow is not None:
                fans_failed = surroundings.rack_airflow < 1.0
            restarts = np.zeros(len(before), np.bool_)
            if (before == TRIPPED).any():
                cooled = self._is_cooled(surroundings, plant)[self._fleet.rack_dc] & ~fans_failed
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
            lost_share = lost_share + self._tripped_work(before, status, placement)
        lost_tasks = TASKS_PER_STEP * lost_share
        return RackOutcome(
            restart_wait_min=wait_min,
            rack_status=status,
            throttled_racks=self._racks_in(status, THROTTLED),
            tripped_racks=self._racks_in(status, TRIPPED),
            lost_tasks=lost_tasks,
            executed_tasks=work.started_tasks - lost_tasks,
        )

    def _restart(
        self, before: Status, wait_min: F64, inlet_max_c: F64, cooled: Mask
    ) -> tuple[Mask, F64]:
        """Racks that start again in a step, and ``restart_wait_min`` at its end, each (R,)."""
        wait_min = protection.ready_min(
            before, wait_min, inlet_max_c, cooled, restart_c=self._restart_c, dt=self._step_min
        )
        ready = (wait_min > 0) & (wait_min >= self._hold_min)
        restarts = protection.first_of_each(ready, self._most_starts, self._fleet.rack_offsets)
        return restarts, np.where(restarts, 0.0, wait_min)

    def _racks_per_step(self) -> I64:
        """Racks of each data center that may restart in a step, at least one, (B,)."""
        racks = np.diff(self._fleet.rack_offsets)
        share = self._fleet.values("protection.restart_share") * self._step_min
        # The tolerance keeps what is a whole number of racks one.
        return np.maximum(np.floor(share * racks + 1e-9), 1.0).astype(np.int64)

    def _is_cooled(self, surroundings: Surroundings, plant: Mapping[str, Any]) -> Mask:
        """Whether a CRAC unit of each data center runs and the plant keeps up with it, (B,)."""
        any_runs = self._fleet.unit_sums(surroundings.unit_running) > 0
        load_w = np.abs(plant["cooling_load_w"])
        return np.asarray(any_runs & (plant["unmet_w"] <= UNMET_SHARE * load_w))

    def _fully_on(self, status: Status, surroundings: Surroundings) -> bool:
        """Whether all racks are in order and on throughout the step."""
        return surroundings.fully_powered and not (self._protected and status.any())

    def _rack_powered(self, status: Status, surroundings: Surroundings) -> F64 | None:
        """Share of the step that each rack is on, (R,); None if all are on throughout."""
        if self._fully_on(status, surroundings):
            return None
        return np.where(status == TRIPPED, 0.0, surroundings.powered[self._fleet.rack_dc])

    def _racks_in(self, status: Status, which: int) -> F64:
        """Racks of each data center that have a status of ``hall.protection``, (B,)."""
        if not (self._protected and status.any()):
            return np.zeros(len(self._servers))
        return self._fleet.rack_sums(status == which)

    def _tripped_work(self, before: Status, after: Status, placement: Placement) -> F64:
        """Work of the racks that trip in a step, as a share of all servers, (B,)."""
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
        """Rack values for each server group, (G,)."""
        return np.repeat(per_rack, np.diff(self._fleet.group_offsets))
