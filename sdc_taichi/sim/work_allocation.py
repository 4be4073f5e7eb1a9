"""Which racks may work, and where the work of a data center goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.hall import protection
from sdc_taichi.hall.air_metrics import allowable_c
from sdc_taichi.hall.placement import make_bins, place
from sdc_taichi.hall.protection import TRIPPED
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, Reals, Status


@dataclass(frozen=True, slots=True)
class Placed:
    """Work in its place."""

    utilisation: F64
    """What was placed, as a share of all servers, (B,)."""
    rack_load: F64 | None
    """Utilisation of each rack while it is on, (R,); None loads all racks alike."""
    group_load: F64 | None
    """The same of each server group, (G,); None spreads the load of a rack by load weights."""


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
        self._limits = {
            "limit_c": limit_c[fleet.rack_dc],
            "trip_c": trip_c[fleet.rack_dc],
            "restart_c": fleet.values("protection.restart_c")[fleet.rack_dc],
        }
        self._throttle_share = fleet.values("protection.throttle_share")[fleet.rack_dc]
        self._allowable_high_c = np.array([allowable_c(c)[1] for c in classes])

    @property
    def watches_inlets(self) -> bool:
        """Whether placement needs the inlets of the last step."""
        return self._policy in ("coolest-first", "inlet-aware")

    def capacity(
        self, status: Status, powered: F64 | None, weights: F64 | None
    ) -> tuple[F64 | None, F64 | float]:
        """How much work fits.

        Args:
            status: of each rack, see ``plant.protection``, (R,).
            powered: share of the step with power, (B,); None is all of it.
            weights: of the action, per rack or server group.

        Returns:
            Utilisation each bin may reach, None if all of it, and each data center, (B,).

        Raises:
            SdcError: weights that are no numbers or of the wrong shape.
        """
        chosen = self._policy == "weights" and weights is not None
        if not chosen and self._all_on(status, powered):
            return None, 1.0
        per_rack = protection.capacity(status, self._throttle_share)
        if powered is not None:
            per_rack = per_rack * powered[self._fleet.rack_dc]
        bins = per_rack if self._per_rack else self._spread(per_rack)
        usable = np.where(self._weights(weights) > 0, bins, 0.0) if chosen else bins
        return bins, self._bins.sums(self._bin_servers * usable) / self._servers

    def place(
        self,
        utilisation: F64,
        capacity: F64 | None,
        powered: F64 | None,
        group_inlet_c: F64,
        weights: F64 | None,
    ) -> Placed:
        """Put work in its place by the policy of the fleet.

        Args:
            utilisation: work as a share of all servers, (B,).
            capacity: of each bin, see ``capacity``.
            powered: share of the step with power, (B,).
            group_inlet_c: inlets of the last step, (G,), if the policy watches them.
            weights: of the action, per rack or server group.

        Raises:
            SdcError: weights without policy ``weights``, or weights that are not valid.
        """
        if weights is not None and self._policy != "weights":
            raise SdcError(
                f"action placement: given, but workload.placement is {self._policy}; valid is None"
            )
        if self._per_rack and capacity is None:
            return Placed(utilisation, None, None)
        load, placed = place(
            self._policy,
            utilisation,
            bins=self._bins,
            count=self._bin_servers,
            capacity=np.ones(len(self._bin_servers)) if capacity is None else capacity,
            inlet_c=group_inlet_c,
            limit_c=self._allowable_high_c,
            weights=self._weights(weights) if self._policy == "weights" else None,
        )
        if powered is not None:
            on = powered[self._bins.dc]
            load = load / np.where(on > 0, on, 1.0)
        return Placed(placed, *((load, None) if self._per_rack else (None, load)))

    def powered(self, status: Status, powered: F64 | None) -> F64 | None:
        """Share of the step that each rack is on, (R,); None if all are on throughout."""
        if self._all_on(status, powered):
            return None
        on = np.ones(self._fleet.racks) if powered is None else powered[self._fleet.rack_dc]
        return np.where(status == TRIPPED, 0.0, on)

    def _all_on(self, status: Status, powered: F64 | None) -> bool:
        """Whether all racks are in order and on throughout the step."""
        lit = powered is None or bool((powered == 1.0).all())
        return lit and not (self._protected and status.any())

    def protect(self, status: Status, inlet_max_c: Reals) -> Status:
        """Status of each rack after a step with the given hottest inlets, (R,)."""
        if not self._protected:
            return status
        return protection.protect(status, inlet_max_c.astype(np.float64), **self._limits)

    def racks_in(self, status: Status, which: int) -> F64:
        """Racks of each data center that have a status of ``plant.protection``, (B,)."""
        if not (self._protected and status.any()):
            return np.zeros(len(self._servers))
        return self._fleet.rack_sums(status == which)

    def tripped_work(
        self, before: Status, after: Status, placed: Placed, rack_powered: F64 | None
    ) -> F64:
        """Work of the racks that tripped in a step, as a share of all servers, (B,).

        Args:
            before: status at the start of the step, (R,).
            after: status at its end, (R,).
            placed: the work of the step.
            rack_powered: share of the step that each rack was on, None if all were.
        """
        if after is before:
            return np.zeros(len(self._servers))
        tripped = (after == TRIPPED) & (before != TRIPPED)
        if not tripped.any():
            return np.zeros(len(self._servers))
        fleet = self._fleet
        if placed.group_load is not None:
            busy = fleet.group_sums(fleet.per_group_servers() * placed.group_load)
        elif placed.rack_load is not None:
            busy = self._rack_servers * placed.rack_load
        else:
            busy = self._rack_servers * placed.utilisation[fleet.rack_dc]
        if rack_powered is not None:
            busy = busy * rack_powered
        return fleet.rack_sums(busy * tripped) / self._servers

    def _spread(self, per_rack: F64) -> F64:
        """Rack values for each server group, (G,)."""
        return np.repeat(per_rack, np.diff(self._fleet.group_offsets))

    def _weights(self, weights: F64 | None) -> F64:
        """Weights of the server groups, (G,), from one per rack or per group."""
        groups, racks = self._fleet.groups, self._fleet.racks
        if weights is None:
            return np.ones(groups)
        try:
            given = np.asarray(weights, dtype=np.float64)
        except (TypeError, ValueError):
            raise SdcError(f"action placement: {weights!r} are no numbers") from None
        if given.shape == (groups,):
            return given
        if given.shape != (racks,):
            raise SdcError(
                f"action placement: shape {given.shape}, expected ({racks},), one per rack, or "
                f"({groups},), one per server group"
            )
        return self._spread(given)
