"""Input arrays of the hall kernels, built once for a fleet.

``kernels/README.md`` describes the memory layout of these arrays; ``kernels/hall_arguments.py``
documents each array and row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.hall.initial_guess import SteadyStateTable
from sdc_taichi.hall.mix_weights import DENSE_RACKS, items_of_ranges
from sdc_taichi.hall.steady_modes import SteadyModes
from sdc_taichi.kernels.arguments import in_row_order, row_index
from sdc_taichi.kernels.hall_arguments import (
    ARGUMENTS,
    BLOCK_INTS,
    CHUNK_BLOCKS,
    CHUNK_INTS,
    DC_CONTROL,
    DC_DOUBLES,
    DC_INTS,
    DENSE_LANES,
    GROUP_INPUTS,
    GROUP_OUT,
    KNEES,
    LANES,
    MIX_PATTERNS,
    MODE_VECTORS,
    PLENUM_NEED,
    RACK_INPUTS,
    RACK_OUT,
    RACK_STATE,
    RETURN_AIR,
    SCRATCH,
    SOURCE_INTS,
    SPARSE_BLOCKS,
    SPARSE_LANES,
    SUMS,
    UNIT_INPUTS,
    UNIT_STATE,
)
from sdc_taichi.sim.crac_units import SharedPlenum, shares_by_block
from sdc_taichi.sim.fleet import Fleet, offsets_from_counts
from sdc_taichi.types import F64, I32

RETURN_BAND_K = 2.0
"""Proportional band of return-air control, in K: setpoint minus return temperature without load."""
CASING_S = 0.3
"""Air in coil and casing of a CRAC unit divided by its airflow at full speed, in s."""
Array = Any
"""NumPy array of any type; an array of vectors has one more axis here than in the kernel."""


@dataclass(frozen=True, slots=True)
class RackPlaces:
    """Indices (places) of racks in the kernels' arrays, where data centers fill whole blocks.

    A block has ``LANES`` places; places without a rack are padding.
    """

    blocks: npt.NDArray[np.int64]
    """Number of blocks of each data center, (B,)."""
    block_offsets: I32
    """First block of each data center, (B + 1,)."""
    of_racks: npt.NDArray[np.int64]
    """Place of each rack, (R,)."""
    racks_per_dc: int | None
    """Number of racks of each data center if it is equal for all, else None."""

    @property
    def count(self) -> int:
        """Number of places, including padding."""
        return int(LANES * self.block_offsets[-1])

    def values_of_racks(self, rows: Array) -> Array:
        """Copy padded kernel rows, (n, places), to rows by rack without padding, (n, R)."""
        rows, size = rows.reshape(len(rows), -1), len(self.blocks)
        if self.racks_per_dc is None:
            return rows[:, self.of_racks]
        # Copying the racks of a data center as one item takes a third of the time of a gather.
        apart, item = rows.strides[0], np.dtype((np.void, self.racks_per_dc * rows.itemsize))
        parts: Any = np.ndarray((len(rows), size), item, rows, strides=(apart, apart // size))
        return parts.copy().view(rows.dtype)

    def put(self, row: Array, values: Array) -> None:
        """Write values by rack, (R,), to a padded kernel row, (places,)."""
        if self.racks_per_dc is None:
            row[self.of_racks] = values
        else:
            size, racks = len(self.blocks), self.racks_per_dc
            row.reshape(size, -1)[:, :racks] = values.reshape(size, -1)


@dataclass(frozen=True, slots=True)
class HallTables:
    """Arrays of the hall kernels for a fleet, and the positions of its racks and groups in them."""

    places: RackPlaces
    """Positions of the racks in the arrays."""
    arrays: dict[str, Array]
    """Arrays by the names of the kernels' arguments."""
    group_places: int
    """Length of arrays with one entry per block and group, such as ``server_c``."""
    slices: int
    """Number of slices into which the tasks are divided for the threads."""
    fan_knees: int
    """Number of knees of the airflow ratio of the servers of each data center."""
    cpu_knees: int
    """Number of knees of the power ratio of the servers of each data center."""
    units_per_dc: I32
    """Number of CRAC units of each data center, (B,)."""
    plenum: SharedPlenum
    """Updates ``unit_shares`` when CRAC units stop or start."""

    def rows(self, argument: str) -> dict[str, Array]:
        """Return flat views of the rows of a two-dimensional array, by row name."""
        array, rows = self.arrays[argument], ARGUMENTS[argument].rows
        return dict(zip(rows, array.reshape(len(rows), -1), strict=True))


def vectors(dtype: npt.DTypeLike, *shape: int, lanes: int = LANES) -> Array:
    """Return an aligned array of zeros that kernels can read as vectors, (*shape, lanes)."""
    from sdc_taichi.kernels.compiler.arrays import aligned

    out = aligned((*shape, lanes), dtype)
    out[:] = 0.0
    return out


def build_hall_tables(fleet: Fleet, dtype: npt.DTypeLike, most_slices: int) -> HallTables:
    """Build the arrays of the hall kernels for a fleet.

    Args:
        fleet: The data centers.
        dtype: Type of temperatures and powers, float32 or float64.
        most_slices: Maximum number of slices into which the tasks are divided for the threads.

    Raises:
        ConfigError: An array has more entries than the kernels can index.
    """
    places = _build_places(fleet)
    task_offsets, chunk_ints, first_chunk = _build_chunks(fleet, places, most_slices)
    slices = max(1, min(most_slices, len(task_offsets) - 1))
    n_chunks, units = chunk_ints.shape[1] - 1, np.diff(fleet.unit_offsets)
    block_ints, place_ints, group_inputs = _build_groups(fleet, places, dtype)
    most_groups, group_places = block_ints[1].max(), block_ints[1].sum()
    unit_shares, mix_weights, first_mix_weight = _build_air(fleet, places, dtype)
    steady_states, guess_rows = build_steady_states(fleet, places, dtype, {})
    server_knees, fan_knees, cpu_knees = _build_knees(fleet, dtype)
    dc_ints = {
        "first_chunk": first_chunk,
        "first_unit": fleet.unit_offsets,
        "first_share": offsets_from_counts(places.blocks * units, "unit shares of blocks"),
        "racks": np.diff(fleet.rack_offsets),
        "first_mix_weight": first_mix_weight,
        "first_sample": [],
    }
    rack_state = vectors(dtype, len(RACK_STATE), places.count // LANES)
    mode_amounts = vectors(dtype, slices * MODE_VECTORS)
    arrays = {
        "task_offsets": task_offsets,
        "dc_ints": _index_rows(DC_INTS, dc_ints | guess_rows),
        "chunk_ints": chunk_ints,
        "block_ints": block_ints,
        "place_ints": place_ints,
        **_build_sources(fleet, places, dtype),
        "dc_coefficients": np.array(fleet.dcs.T, dtype, order="C").reshape(-1),
        "rack_inputs": _build_rack_inputs(fleet, places, dtype),
        "server_knees": server_knees,
        "group_inputs": group_inputs,
        "unit_inputs": np.ones((len(UNIT_INPUTS), fleet.units), dtype),
        "unit_shares": unit_shares,
        "mix_weights": mix_weights,
        "steady_states": steady_states,
        "sample_outlet_c": np.zeros(1, dtype),
        "dc_control": np.zeros((len(DC_CONTROL), fleet.size), np.int32),
        "dc_doubles": np.zeros((len(DC_DOUBLES), fleet.size)),
        "unit_state": np.ones((len(UNIT_STATE), fleet.units)),
        "rack_state": rack_state,
        "rack_state_by_4": rack_state.reshape(-1, DENSE_LANES),
        "rack_state_by_16": rack_state.reshape(-1, SPARSE_LANES),
        "scratch": vectors(dtype, slices * SCRATCH),
        "mode_amounts": mode_amounts,
        "mode_amount": mode_amounts.reshape(-1),
        "unit_need_m3s": np.zeros(max(int(chunk_ints[2, -1]), 1)),
        "unit_plain_m3s": np.zeros(max(int(chunk_ints[2, -1]), 1)),
        **_build_plenum(fleet, places),
        "chunk_sums": np.zeros(len(SUMS) * n_chunks),
        "group_values": vectors(dtype, len(GROUP_OUT), slices * int(most_groups)),
        "rack_out": vectors(dtype, len(RACK_OUT), places.count // LANES),
    }
    doubles = arrays["dc_doubles"]
    adjusts_supply = doubles[row_index(DC_DOUBLES, "adjusts_supply")]
    plenum = SharedPlenum(fleet, unit_shares, dc_ints["first_share"], LANES, adjusts_supply)
    tables = HallTables(
        places, arrays, int(group_places), slices, fan_knees, cpu_knees, units, plenum
    )
    tables.rows("unit_inputs")["design_m3s"][:] = fleet.unit_design_m3s
    tables.rows("unit_inputs")["capacity_w"][:] = fleet.unit_capacity_w
    tables.rows("unit_inputs")["casing_m3"][:] = CASING_S * fleet.unit_design_m3s
    tables.rows("unit_state")["fitted_m3s"][:] = -1.0
    for name in ("strength", "drawn_ratio"):
        tables.rows("unit_state")[name][:] = 1.0
    tables.rows("unit_state")["return_offset_k"][:] = 0.0
    _set_data_center_values(fleet, tables.rows("dc_doubles"))
    return tables


def _build_places(fleet: Fleet) -> RackPlaces:
    racks = np.diff(fleet.rack_offsets)
    blocks = -(-racks // LANES)
    if fleet.air is not None and racks.max() > DENSE_RACKS:
        # Exhausts are read as vectors of SPARSE_LANES, so halls must begin at such a vector.
        blocks = -(-blocks // SPARSE_BLOCKS) * SPARSE_BLOCKS
    block_offsets = offsets_from_counts(blocks, "blocks of racks")
    return RackPlaces(
        blocks=blocks,
        block_offsets=block_offsets,
        of_racks=items_of_ranges(LANES * block_offsets[:-1], racks)[1],
        racks_per_dc=int(racks[0]) if np.all(racks == racks[0]) else None,
    )


def _build_chunks(fleet: Fleet, places: RackPlaces, most_slices: int) -> tuple[Array, Array, Array]:
    """Divide the blocks into chunks and tasks for the threads.

    Returns:
        First chunk of each task, and the number of chunks; rows ``CHUNK_INTS``; first chunk of each
        data center, and the number of chunks.
    """
    chunks = [np.arange(a, b, CHUNK_BLOCKS) for a, b in pairwise(places.block_offsets)]
    per_dc = np.array([len(c) for c in chunks])
    chunk_dc = np.repeat(np.arange(fleet.size), per_dc)
    # A data center that fits into a slice is one task; larger ones have one task per chunk.
    is_one_task = per_dc * most_slices <= max(per_dc.sum(), most_slices)
    begins_task = ~np.repeat(is_one_task, per_dc)
    begins_task[np.cumsum(per_dc) - per_dc] = True
    task_offsets = np.append(np.flatnonzero(begins_task), per_dc.sum()).astype(np.int32)
    units = np.diff(fleet.unit_offsets)
    rows = {
        "first_block": np.concatenate([*chunks, places.block_offsets[-1:]]),
        "dc": chunk_dc,
        "first_need": offsets_from_counts(units[chunk_dc], "needs of chunks"),
    }
    return task_offsets, _index_rows(CHUNK_INTS, rows), offsets_from_counts(per_dc, "chunks")


def _build_groups(
    fleet: Fleet, places: RackPlaces, dtype: npt.DTypeLike
) -> tuple[Array, Array, Array]:
    """Return rows ``BLOCK_INTS``, rows ``PLACE_INTS`` and the group inputs.

    Blocks with equal groups share their group inputs.
    """
    block = places.of_racks // LANES
    groups = np.diff(fleet.group_offsets)
    most = np.zeros(int(places.blocks.sum()), np.int64)
    np.maximum.at(most, block, groups)
    racks = np.bincount(block, minlength=len(most))
    first_rack = np.cumsum(racks) - racks
    # Padding lanes and the entry that ends the table hold the index of the group after the last
    # group of the preceding rack.
    rack = np.minimum(np.arange(LANES), racks[:, None]) + first_rack[:, None]
    first_group = fleet.group_offsets[np.append(rack, fleet.racks)]
    first_row, group_inputs = _build_group_inputs(fleet, places, first_rack, racks, most, dtype)
    block_ints = {
        "racks": racks,
        "groups": most,
        "first_row": first_row,
        "first_place": offsets_from_counts(most, "groups of blocks")[:-1],
        "first_row_along": [],
    }
    place_ints = {"first_group": first_group, "first_server": fleet.server_offsets[first_group]}
    return (
        _index_rows(BLOCK_INTS, block_ints),
        np.stack(in_row_order(ARGUMENTS["place_ints"].rows, place_ints)),
        group_inputs,
    )


def _build_group_inputs(
    fleet: Fleet,
    places: RackPlaces,
    first_rack: Array,
    racks: Array,
    groups: Array,
    dtype: npt.DTypeLike,
) -> tuple[Array, Array]:
    """Return the first entry of each block, and the entries of all distinct blocks.

    An entry holds the rows ``GROUP_INPUTS`` of one group of each rack, with racks as lanes.
    """
    row_of_block: dict[Any, int] = {}
    blocks_of_hall: dict[int, slice] = {}
    entries, first_row, total = [], np.zeros(len(groups), np.int64), 0
    is_liquid = np.zeros((len(groups), LANES), np.bool_)
    is_liquid.reshape(-1)[places.of_racks[fleet.liquid_racks]] = True
    for dc, (begin, end) in enumerate(pairwise(places.block_offsets)):
        rows, blocks = fleet.group_rows[dc], slice(begin, end)
        same = blocks_of_hall.setdefault(id(rows), blocks)
        if same != blocks:
            first_row[blocks] = first_row[same]
            continue
        group_0 = fleet.group_offsets[fleet.rack_offsets[dc]]
        for i in range(begin, end):
            if racks[i] == 0:
                continue
            end_rack = first_rack[i] + racks[i]
            offsets = fleet.group_offsets[first_rack[i] : end_rack + 1] - group_0
            values = rows[:, offsets[0] : offsets[-1]]
            # Heat of liquid-cooled racks is an input per rack, see ``Hall.take_heat_of``.
            groups_of_racks = (offsets - offsets[0]).tobytes()
            key = values.tobytes(), groups_of_racks, is_liquid[i].tobytes()
            if key not in row_of_block:
                row_of_block[key] = total
                entries.append(_block_entry(rows, offsets, groups[i], dtype))
                total += int(groups[i])
            first_row[i] = row_of_block[key]
    out = vectors(dtype, total * len(GROUP_INPUTS))
    out[:] = np.concatenate(entries).reshape(out.shape)
    return first_row, out


def _block_entry(rows: F64, offsets: Array, groups: int, dtype: npt.DTypeLike) -> Array:
    """Return the group inputs of a block, (groups, rows, LANES).

    For a block of two racks with 2 and 3 groups, ``offsets`` is [0, 2, 5]. Entry 0 holds groups 0
    and 2 in its first two lanes, entry 1 groups 1 and 3, and entry 2 groups 1 and 4: the first rack
    has no third group and repeats its last group with a server count of 0. The remaining lanes
    repeat the second lane, also with a server count of 0.

    Args:
        rows: Rows ``GROUP_INPUTS`` of the groups of the hall.
        offsets: First group of each rack of the block, and the end of the last rack.
        groups: Maximum number of groups of a rack of the block.
        dtype: Type of the result.
    """
    number, counts, n_racks = np.arange(groups)[:, None], np.diff(offsets), len(offsets) - 1
    group = offsets[:-1] + np.minimum(number, counts - 1)
    entry = np.zeros((groups, len(rows), LANES), dtype)
    entry[:, :, :n_racks] = rows[:, group].swapaxes(0, 1)
    servers = entry[:, list(GROUP_INPUTS).index("count")]
    servers[:, :n_racks] *= number < counts
    entry[:, :, n_racks:] = entry[:, :, n_racks - 1 : n_racks]
    servers[:, n_racks:] = 0.0
    return entry


def _build_knees(fleet: Fleet, dtype: npt.DTypeLike) -> tuple[Array, int, int]:
    """Return the rows ``KNEES`` of all servers, and the numbers of knees of airflow and power.

    A data center has the knees of its airflow ratio, then those of its power ratio. Curves with
    fewer knees than others have further knees that change no slope. The array is not empty, because
    kernels need an address.
    """
    curves = {id(c.servers): c.servers.curves for c in fleet.configs}
    fan = max(len(curve.fan_knees) for curve in curves.values())
    cpu = max(len(curve.cpu_knees) for curve in curves.values())
    rows_of = {}
    for servers, curve in curves.items():
        rows_of[servers] = rows = np.zeros((len(KNEES), fan + cpu), dtype)
        for first, knees in ((0, curve.fan_knees), (fan, curve.cpu_knees)):
            rows[:, first : first + len(knees)] = np.array(knees).reshape(-1, len(KNEES)).T
    rows = np.concatenate([rows_of[id(c.servers)] for c in fleet.configs], axis=1)
    return rows if rows.size else np.zeros((len(KNEES), 1), dtype), fan, cpu


def build_rows_along_racks(group_inputs: Array, block_ints: Array) -> tuple[Array, Array]:
    """Append a transposed copy of the group inputs, with LANES groups of one rack per entry.

    In the original entries of a block, lanes are racks: entry k holds group k of each rack. The
    layers kernel computes single servers and needs lanes that are groups of one rack. Each block is
    therefore cut into squares of LANES groups by LANES racks, and each square is transposed: a
    block of 20 groups becomes 3 vectors of groups for each of its 8 racks, and the last vector is
    padded with repeats of group 19.

    Returns:
        The extended group inputs, and the first transposed entry of each block.
    """
    block = dict(zip(BLOCK_INTS, block_ints, strict=True))
    entries = group_inputs.reshape(-1, len(GROUP_INPUTS), LANES)
    first_row, distinct, of_block = np.unique(
        block["first_row"], return_index=True, return_inverse=True
    )
    groups = block["groups"][distinct]
    n_squares = -(-groups // LANES)
    first_along = len(entries) + offsets_from_counts(LANES * n_squares, "groups along racks")
    longer = vectors(group_inputs.dtype, int(first_along[-1]) * entries.shape[1])
    out = longer.reshape(-1, *entries.shape[1:])
    out[: len(entries)] = entries
    for row, n_groups, along, n in zip(first_row, groups, first_along, n_squares, strict=False):
        group = np.minimum(np.arange(LANES * n), n_groups - 1)
        squares = entries[row + group].reshape(n, LANES, -1, LANES)
        out[along : along + LANES * n] = squares.transpose(3, 0, 2, 1).reshape(-1, *out.shape[1:])
    return longer, first_along[of_block]


def _build_air(
    fleet: Fleet, places: RackPlaces, dtype: npt.DTypeLike
) -> tuple[Array, Array, Array]:
    """Return unit shares by block, mix weights of dense halls, and each hall's first weight.

    The first weight is -1 for sparse halls, whose weights are apart (see ``_build_sources``).
    """
    first_mix_weight = np.full(fleet.size + 1, -1)
    air = fleet.air
    if air is None:
        return vectors(dtype, 1), vectors(dtype, 1, lanes=DENSE_LANES * LANES), first_mix_weight
    shares = _shares_by_block(fleet, places, air.unit_shares)
    weights, first_of_entry, total = [], {}, 0
    for dc, racks in enumerate(np.diff(fleet.rack_offsets)):
        n_places = int(places.blocks[dc]) * LANES
        if racks > DENSE_RACKS:
            continue
        entry = int(air.steady_state_of_dc[dc])
        if entry not in first_of_entry:
            n_sources = -(-int(racks) // DENSE_LANES) * DENSE_LANES
            padded = np.zeros((n_places, n_sources))
            padded[:racks, :racks] = _dense_weights(fleet, dc)
            by_block = padded.reshape(-1, LANES, n_sources).swapaxes(1, 2)
            weights.append(by_block.reshape(-1, DENSE_LANES * LANES))
            first_of_entry[entry] = total
            total += len(weights[-1])
        first_mix_weight[dc] = first_of_entry[entry]
    unit_shares = vectors(dtype, sum(map(len, shares)))
    unit_shares[:] = np.concatenate(shares)
    mix_weights = vectors(dtype, max(total, 1), lanes=DENSE_LANES * LANES)
    if weights:
        mix_weights[:] = np.concatenate(weights)
    return unit_shares, mix_weights, first_mix_weight


def _build_plenum(fleet: Fleet, places: RackPlaces) -> dict[str, Array]:
    """Return what weights of units are fitted to: shares by block, and airflows of the racks.

    Fleets whose units are not coupled, or draw common return air, have arrays of one entry.
    """
    air, blocks, no_shares = fleet.air, places.count // LANES, [np.zeros((1, LANES))]
    couples = air is not None and bool(np.any(fleet.plenum_coupling > 0))
    need = vectors(np.float64, len(PLENUM_NEED), blocks if couples else 1)
    supply = returns = no_shares
    if air is not None and couples:
        need.reshape(len(need), -1)[:, places.of_racks] = air.rack_need_m3s
        supply = _shares_by_block(fleet, places, air.unit_shares)
    if air is not None and air.return_shares is not None:
        returns = _shares_by_block(fleet, places, air.return_shares)
    arrays = {
        "plenum_need": need,
        "return_air": vectors(np.float64, len(RETURN_AIR), 1 if returns is no_shares else blocks),
        "unit_lanes": vectors(np.float64, fleet.units),
    }
    for name, shares in (("plenum_shares", supply), ("return_shares", returns)):
        arrays[name] = vectors(np.float64, sum(map(len, shares)))
        arrays[name][:] = np.concatenate(shares)
    return arrays


def _shares_by_block(fleet: Fleet, places: RackPlaces, flat_shares: F64) -> list[Array]:
    """Return shares of units in racks of all data centers by block, see ``shares_by_block``."""
    assert fleet.air is not None
    shares = []
    for dc, (racks, units) in enumerate(
        zip(np.diff(fleet.rack_offsets), np.diff(fleet.unit_offsets), strict=True)
    ):
        at = fleet.air.unit_share_offsets[dc]
        of_hall = flat_shares[at : at + racks * units].reshape(racks, units)
        shares.append(shares_by_block(of_hall, LANES))
        # Sparse halls are padded with blocks of zeros to whole vectors of SPARSE_LANES.
        shares.append(np.zeros((int(places.blocks[dc]) * units - len(shares[-1]), LANES)))
    return shares


def _dense_weights(fleet: Fleet, dc: int) -> F64:
    """Return the mix weights of a data center as a matrix, receiving by source rack, (R, R)."""
    assert fleet.air is not None
    weights = fleet.air.mix_weights
    first, end = fleet.rack_offsets[dc : dc + 2]
    out = np.zeros((end - first, end - first))
    for rack in range(first, end):
        for run in range(weights.run_offsets[rack], weights.run_offsets[rack + 1]):
            at, at_weight = weights.run_first_rack[run], weights.run_first_weight[run]
            count = weights.run_length[run]
            part = weights.weights[at_weight : at_weight + count]
            out[rack - first, at - first : at - first + count] += part
    return out * weights.norm[first:end, None]


def build_steady_states(
    fleet: Fleet,
    places: RackPlaces,
    dtype: npt.DTypeLike,
    modes: Mapping[int, SteadyModes],
) -> tuple[Array, dict[str, Array]]:
    """Return what gives the initial guesses of all halls, and the index rows of ``DC_INTS``.

    The array holds the patterns of each distinct hall by block. A table of the amounts of the
    patterns follows in dense halls. In sparse halls the patterns are the modes, and their amounts
    per kelvin of each sampled rack follow.

    Args:
        fleet: The data centers.
        places: Places of the racks in the arrays.
        dtype: Type of the array.
        modes: Modes of sparse halls by their index in ``HallAir.steady_states``; a hall that is
            missing starts from its supply temperature.
    """
    names = ("first_pattern", "first_steady_state", "supply_rows", "heat_levels", "modes")
    air = fleet.air
    if air is None:
        return vectors(dtype, 1), dict.fromkeys(names, np.zeros(1))
    parts: list[Array] = [np.zeros((1, LANES))]
    index_rows = []
    first_dcs = np.unique(air.steady_state_of_dc, return_index=True)[1]
    total = 1
    for entry, (table, blocks) in enumerate(
        zip(air.steady_states, places.blocks[first_dcs], strict=True)
    ):
        count = supply_rows = heat_levels = 0
        if isinstance(table, SteadyStateTable):
            heat_levels, supply_rows = table.pattern_shares.shape[:2]
            patterns = np.zeros((MIX_PATTERNS, table.patterns.shape[1]))
            patterns[: len(table.patterns)] = table.patterns
            parts += [_by_block(patterns, int(blocks)), _amounts_with_margin(table)]
        elif entry in modes:
            count = len(modes[entry].racks)
            pairs = np.stack([modes[entry].mix_k, modes[entry].outlet_k], axis=1)
            # Each sampled rack has a row of amounts, padded to whole vectors.
            amounts = np.zeros((count, -(-count // LANES) * LANES))
            amounts[:, :count] = modes[entry].amounts_per_k.T
            parts += [
                _by_block(pairs.reshape(2 * count, -1), int(blocks)),
                amounts.reshape(-1, LANES),
            ]
        else:
            parts += [np.zeros((0, LANES))] * 2
        first_amount = total + len(parts[-2])
        index_rows.append((total, first_amount, supply_rows, heat_levels, count))
        total = first_amount + len(parts[-1])
    offsets_from_counts([total], "vectors of steady states")
    out = vectors(dtype, total)
    out[:] = np.concatenate(parts)
    return out, dict(zip(names, np.array(index_rows)[air.steady_state_of_dc].T, strict=True))


def _by_block(patterns: F64, blocks: int) -> Array:
    """Return patterns over the racks, (k, R), as vectors by block, (blocks * k, LANES)."""
    padded = np.zeros((len(patterns), blocks * LANES))
    padded[:, : patterns.shape[1]] = patterns
    return padded.reshape(-1, blocks, LANES).swapaxes(0, 1).reshape(-1, LANES)


def _amounts_with_margin(table: SteadyStateTable) -> Array:
    """Return the amounts of the patterns and the feedback gain of a table as vectors.

    Cubic interpolation reads one row and column beyond the table on each side.
    """
    amounts = np.zeros((*table.pattern_shares.shape[:3], LANES))
    amounts[..., : table.pattern_shares.shape[3]] = table.pattern_shares
    amounts[0, ..., MIX_PATTERNS] = table.feedback_gain
    beyond = ((0, 0), (1, 1), (1, 1), (0, 0))
    return np.pad(amounts, beyond, mode="reflect", reflect_type="odd").reshape(-1, LANES)


def _build_sources(fleet: Fleet, places: RackPlaces, dtype: npt.DTypeLike) -> dict[str, Array]:
    """Return the mix weights of sparse halls by block of racks and vector of source racks."""
    air, n_blocks = fleet.air, places.count // LANES
    is_sparse = np.diff(fleet.rack_offsets)[fleet.rack_dc] > DENSE_RACKS
    if air is None or not is_sparse.any():
        return {
            "source_offsets": np.zeros(n_blocks + 1, np.int32),
            "source_ints": np.zeros((len(SOURCE_INTS), 1), np.int32),
            "sparse_weights": vectors(dtype, 1, lanes=SPARSE_LANES * LANES),
        }
    mix_weights = air.mix_weights
    counts = np.diff(mix_weights.run_offsets)
    of_sparse = np.repeat(is_sparse, counts) & (mix_weights.run_length > 0)
    moved = places.of_racks[fleet.rack_offsets[:-1]] - fleet.rack_offsets[:-1]
    first = (mix_weights.run_first_rack + np.repeat(moved[fleet.rack_dc], counts))[of_sparse]
    length = mix_weights.run_length[of_sparse]
    offset = mix_weights.run_first_weight[of_sparse].astype(np.int64)
    # Weights of a single rack, as vectors. Runs with equal weights share vectors if they begin at
    # the same lane.
    lane = first % SPARSE_LANES
    key = (offset * (int(length.max()) + 1) + length) * SPARSE_LANES + lane
    _, one, same = np.unique(key, return_index=True, return_inverse=True)
    n_vectors = -(-(lane + length) // SPARSE_LANES)
    # Vector 0 is that of a rack without weights.
    first_vector = 1 + offsets_from_counts(n_vectors[one], "vectors of weights").astype(np.int64)
    of_rack = np.zeros((int(first_vector[-1]), SPARSE_LANES))
    _, to = items_of_ranges(first_vector[:-1] * SPARSE_LANES + lane[one], length[one])
    _, weight_at = items_of_ranges(offset[one], length[one])
    of_rack.reshape(-1)[to] = mix_weights.weights[weight_at]
    # Vectors of the racks of a block that have the same sources.
    of_run, source = items_of_ranges(first // SPARSE_LANES, n_vectors)
    place = np.repeat(places.of_racks, counts)[of_sparse][of_run]
    # Neighbouring runs of a rack may share a vector, which then has two entries.
    at = np.arange(len(place))
    follows = np.zeros(len(place), np.bool_)
    follows[1:] = (place[1:] == place[:-1]) & (source[1:] == source[:-1])
    repeated = at - np.maximum.accumulate(np.where(follows, 0, at))
    copies = int(repeated.max()) + 1
    entry = (place // LANES * np.int64(n_blocks) + source) * copies + repeated
    entries, entry = np.unique(entry, return_inverse=True)
    block, source = np.divmod(entries // copies, n_blocks)
    of_lane = np.zeros((len(entries), LANES), np.int64)
    _, vector_at = items_of_ranges(first_vector[:-1][same], n_vectors)
    of_lane[entry, place % LANES] = vector_at
    # Entries with equal weights share them.
    shared = np.zeros(len(entries), np.int64)
    for vector in of_lane.T:
        _, one, shared = np.unique(
            shared * len(of_rack) + vector, return_index=True, return_inverse=True
        )
    weights = vectors(dtype, len(one), lanes=SPARSE_LANES * LANES)
    weights.reshape(-1, SPARSE_LANES, LANES)[:] = of_rack[of_lane[one]].swapaxes(1, 2)
    per_block = np.bincount(block, minlength=n_blocks)
    return {
        "source_offsets": offsets_from_counts(per_block, "sources of blocks"),
        "source_ints": _index_rows(SOURCE_INTS, {"vector": source, "weights": shared}),
        "sparse_weights": weights,
    }


def _build_rack_inputs(fleet: Fleet, places: RackPlaces, dtype: npt.DTypeLike) -> Array:
    """Return the padded kernel rows ``RACK_INPUTS``; every step overwrites the loads."""
    air, ones = fleet.air, np.ones(fleet.racks)
    values = {
        "approach_k": fleet.approach_k,
        "norm": ones if air is None else air.mix_weights.norm,
        "load": 0.0 * ones,
        "powered": ones,
        "fan_airflow": ones,
        "strength": ones if air is None else air.mix_weights.strength,
        "per_strength": ones if air is None else 1.0 / air.mix_weights.strength,
        "exhaust_share": 0.0 * ones if air is None else air.exhaust_share,
        "present_exhaust_share": 0.0 * ones,
        "per_server": 1.0 / fleet.per_rack_servers(),
        "heat_w": 0.0 * ones,
    }
    out = vectors(dtype, len(RACK_INPUTS), places.count // LANES)
    rows = out.reshape(len(out), -1)
    for row, of_racks in zip(rows, in_row_order(RACK_INPUTS, values), strict=True):
        row[places.of_racks] = of_racks
    return out


def _set_data_center_values(fleet: Fleet, dc: dict[str, Array]) -> None:
    """Set the constant rows of ``DC_DOUBLES``.

    Of these, only ``crac_fan_w_per_m3s`` is overwritten later, in steps of transient halls.
    """
    dc["crac_fan_w_per_m3s"][:] = fleet.values("hvac.crac.fan_w_per_m3s")
    follows = fleet.models["crac_flow"] == "hottest_inlet"
    dc["inlet_target_c"][:] = fleet.values("hvac.crac.inlet_target_c") * follows
    dc["coupling"][:] = fleet.plenum_coupling
    dc["follows_need"][:] = fleet.models["crac_flow"] == "follow_servers"
    dc["oversupply"][:] = fleet.oversupply_decay
    dc["own_return"][:] = fleet.own_return
    dc["inlet_band_k"][:] = fleet.values("hvac.crac.inlet_band_k")
    dc["least_speed"][:] = fleet.values("hvac.crac.min_flow_ratio")
    rise_k = fleet.setpoint_over_supply_k
    dc["return_rise_k"][:] = rise_k
    dc["return_gain"][:] = np.maximum(1.0 - RETURN_BAND_K / np.maximum(rise_k, 1e-9), 0.0)
    air = fleet.air
    if air is not None:
        # Sparse halls have no table; any two supply temperatures do.
        ends_c = np.array(
            [
                states.supply_c[:2] if isinstance(states, SteadyStateTable) else (0.0, 1.0)
                for states in air.steady_states
            ]
        )
        ends_c = ends_c[air.steady_state_of_dc].T
        dc["table_low_c"][:] = ends_c[0]
        dc["table_rows_per_k"][:] = 1.0 / (ends_c[1] - ends_c[0])


def _index_rows(rows: Any, values: dict[str, Any]) -> npt.NDArray[np.int32]:
    """Stack rows of indices in their order, padding rows without a closing entry with 0."""
    ordered = in_row_order(rows, values)
    out = np.zeros((len(rows), max(map(len, ordered))), np.int32)
    for row, value in zip(out, ordered, strict=True):
        row[: len(value)] = value
    return out
