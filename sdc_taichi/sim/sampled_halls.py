"""Halls made of the sampled racks of large halls, whose steady air starts that of the large halls.

``sdc_taichi.hall.steady_modes`` explains modes and sampled racks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sdc_taichi.hall.initial_guess import SteadyStateTable
from sdc_taichi.hall.mix_weights import DENSE_RACKS, MixWeights
from sdc_taichi.hall.steady_modes import SteadyModes
from sdc_taichi.sim.fleet import NO_LIMIT_W, Fleet, HallAir, offsets_from_counts
from sdc_taichi.types import F64, I64

LEVELS = (np.arange(3) / 2, *(np.arange(1, n, 2) / n for n in (4, 8, 16)))
"""Loads of the steady states from which the modes of a hall are computed. The states of a level
start from the modes of the levels before, so that those of the last level cost little."""
SUPPLY_SHARES = (0.067, 0.5, 0.933)
"""Supply temperatures of these states, as shares of the range of a hall's supply temperatures: the
nodes of Chebyshev polynomials of degree 3."""
_UNIT_M3S = 1e6
"""Airflow of the one CRAC unit of a hall of sampled racks, which covers any need, in m3/s."""


def sparse_halls(fleet: Fleet) -> I64:
    """Return the data centers whose halls have more than ``DENSE_RACKS`` racks, ascending."""
    if fleet.air is None:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(np.diff(fleet.rack_offsets) > DENSE_RACKS)


def supply_range_c(fleet: Fleet) -> tuple[F64, F64]:
    """Return lowest and highest supply temperature that the setpoints allow, in C, (B,) each."""
    low_c = fleet.values("hvac.setpoint.min_c") - fleet.setpoint_over_supply_k
    return low_c, fleet.values("hvac.setpoint.max_c")


def sampled_fleet(fleet: Fleet, dcs: I64, modes: Mapping[int, SteadyModes]) -> Fleet:
    """Build a fleet of the sampled racks of data centers, with one large CRAC unit each.

    Args:
        fleet: Fleet with recirculation.
        dcs: Data centers with sparse halls, (n,).
        modes: Modes by the index of the hall in ``HallAir.steady_states``.
    """
    air = fleet.air
    assert air is not None
    entries = air.steady_state_of_dc[dcs]
    distinct, entry = np.unique(entries, return_inverse=True)
    sizes = np.array([len(modes[e].racks) for e in entries])
    racks = np.concatenate(
        [modes[e].racks + fleet.rack_offsets[dc] for e, dc in zip(entries, dcs, strict=True)]
    )
    group_0 = fleet.group_offsets[fleet.rack_offsets[:-1]]
    groups = np.diff(fleet.group_offsets)[racks]
    of_dc = np.repeat(np.arange(len(dcs)), sizes)
    rows = {}
    for e, dc in zip(entries, dcs, strict=True):
        if e not in rows:
            at = modes[e].racks + fleet.rack_offsets[dc]
            spans = [np.arange(*fleet.group_offsets[rack : rack + 2]) for rack in at]
            rows[e] = fleet.group_rows[dc][:, np.concatenate(spans) - group_0[dc]]
    group_rows = tuple(rows[e] for e in entries)
    rack_offsets = offsets_from_counts(sizes, "sampled racks")
    n = len(dcs)
    return replace(
        fleet,
        configs=tuple(fleet.configs[dc] for dc in dcs),
        models={**fleet.models, "crac_flow": "constant"},
        rack_offsets=rack_offsets,
        rack_dc=of_dc.astype(np.int32),
        unit_offsets=np.arange(n + 1, dtype=np.int32),
        group_offsets=offsets_from_counts(groups, "groups of sampled racks"),
        server_offsets=offsets_from_counts(
            np.concatenate([of_hall[0] for of_hall in group_rows]), "servers of sampled racks"
        ),
        # Sampled racks start other racks at the heat of their design point.
        liquid_racks=fleet.liquid_racks[:0],
        approach_k=fleet.approach_k[racks],
        group_rows=group_rows,
        dcs=fleet.dcs[:, dcs],
        unit_design_m3s=np.full(n, _UNIT_M3S),
        design_flow_m3s=np.full(n, _UNIT_M3S),
        unit_capacity_w=np.full(n, NO_LIMIT_W),
        setpoint_over_supply_k=np.zeros(n),
        plenum_coupling=np.zeros(n),
        oversupply_decay=np.zeros(n),
        own_return=np.zeros(n, np.bool_),
        air=HallAir(
            mix_weights=_sample_weights([modes[e] for e in entries]),
            exhaust_share=air.exhaust_share[racks],
            unit_shares=np.ones(len(racks)),
            return_shares=None,
            rack_need_m3s=air.rack_need_m3s[racks],
            tiles=(),
            unit_share_offsets=rack_offsets,
            steady_states=tuple(_table(air, int(e), modes) for e in distinct),
            steady_state_of_dc=entry.astype(np.int32),
        ),
    )


def _table(air: HallAir, entry: int, modes: Mapping[int, SteadyModes]) -> SteadyStateTable:
    states = air.steady_states[entry]
    assert not isinstance(states, SteadyStateTable)
    return states(modes[entry])


def _sample_weights(modes: list[SteadyModes]) -> MixWeights:
    """Return the mix weights of sampled racks, one run of all racks of the hall for each rack."""
    sizes = np.array([len(m.racks) for m in modes])
    offsets = offsets_from_counts(sizes, "sampled racks")
    lengths = np.repeat(sizes, sizes)
    racks = int(offsets[-1])
    return MixWeights(
        run_offsets=np.arange(racks + 1, dtype=np.int32),
        run_first_rack=np.repeat(offsets[:-1], sizes),
        run_length=lengths.astype(np.int32),
        run_first_weight=offsets_from_counts(lengths, "weights of sampled racks")[:-1],
        weights=np.concatenate([m.sample_weights.reshape(-1) for m in modes]),
        strength=np.ones(racks),
        norm=np.ones(racks),
    )
