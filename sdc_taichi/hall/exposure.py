"""Exposure of the racks of a row to exhaust air: which of them breathe more of it than others.

Air comes to an inlet round the ends of the rows and over the racks, and the more of it the more a
rack and its neighbours draw than the floor gives them. The exposure of rack j, whose distances to
the ends of its row are x,

    e_j = 1 + around sum_ends exp(-x / around_length) - over sum_ends exp(-x / OVER_M)
            + demand (v_j - 1)

with v_j the airflow of the racks that face the aisle around j (weights exp(-distance /
NEIGHBOURS_M)) over the mean of the aisle, kept above 0. Coefficients are fitted to the inlets that
``sdc-taichi hall solve`` finds for 63 halls of 8 to 200 racks; docs/hall.md shows how well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import HallConfig
from sdc_taichi.types import F64

OVER_M = 2.3
"""Length over which racks at the end of a row lack neighbours whose exhaust comes over them."""
NEIGHBOURS_M = 2.2
"""Length over which racks of an aisle share its supply air."""
LEAST = 0.15
"""Exposure of a rack for which the sum of the terms is 0; a rack of the mean has about 1."""
_REACH = 40.0
"""Distance of neighbours that still count, in lengths: their weight is that of a rounding."""


@dataclass(frozen=True, slots=True)
class _Coefficients:
    """How air comes to the inlets, by the place of the returns."""

    around: float
    """Exposure at the very end of a row by what comes round it."""
    around_length_m: float
    """Length over which air that comes round the end of a row fades, in m."""
    around_closed: float
    """Share of ``around`` that full containment takes away beyond what it takes from all paths."""
    over: float
    """Exposure that a rack at the very end of a row lacks of what comes over the racks."""
    over_closed: float
    """Share of ``over`` that full containment takes away beyond what it takes from all paths."""
    demand: float
    """Change of the exposure over that of the demand for air, relative to its mean."""


_BY_RETURNS = {
    "ceiling": _Coefficients(4.0, 0.6, 0.0, 0.4, 1.0, 10.0),
    "end_wall": _Coefficients(0.6, 0.5, 0.35, 0.6, 0.0, 4.0),
}


def exposure(hall: HallConfig, airflow_m3s: F64) -> F64:
    """Exposure of every rack to exhaust air, relative to others of its row, above 0, (R,).

    Args:
        hall: Rows, measures, returns and containment.
        airflow_m3s: Airflow of each rack at the design point, m3/s, (R,).
    """
    values, closed = _BY_RETURNS[hall.layout.returns], hall.layout.containment
    places: F64 = np.arange(hall.racks_per_row, dtype=np.float64)
    along = (places + 0.5) * hall.layout.rack_pitch_m
    around = values.around * (1.0 - values.around_closed * closed)
    over = values.over * (1.0 - values.over_closed * closed)
    ends: F64 = around * _from_ends(along, values.around_length_m)
    ends -= over * _from_ends(along, OVER_M)
    demand = _demand(hall, airflow_m3s.reshape(hall.rows, hall.racks_per_row))
    raw = 1.0 + ends + values.demand * (demand - 1.0)
    # Above 0 and in the same order, where the floor gives more than the racks draw.
    return np.asarray(raw + np.hypot(raw, 2.0 * LEAST)).reshape(-1) / 2.0


def _from_ends(along_m: F64, length_m: float) -> F64:
    """Sum over both ends of a row of exp(-distance / length), (P,)."""
    from_first: F64 = np.exp(-along_m / length_m)
    return np.asarray(from_first + from_first[::-1], dtype=np.float64)


def _demand(hall: HallConfig, airflow_m3s: F64) -> F64:
    """Airflow drawn from the aisle around each rack over the mean of the aisle, (rows, P).

    Args:
        hall: Gives the distance of the racks.
        airflow_m3s: Airflow of each rack, m3/s, (rows, P).
    """
    rows, per_row = airflow_m3s.shape
    # Rows 0 and 1 face each other, and so on; the last of an odd number faces the wall.
    drawn = np.add.reduceat(airflow_m3s, np.arange(0, rows, 2), axis=0)
    drawn = drawn / drawn.mean(axis=1, keepdims=True)
    pitches = NEIGHBOURS_M / hall.layout.rack_pitch_m
    reach = min(per_row - 1, int(np.ceil(_REACH * pitches)))
    weights = np.exp(-np.abs(np.arange(-reach, reach + 1)) / pitches)

    def smoothed(values: F64) -> F64:
        return np.asarray(np.convolve(values, weights)[reach : reach + per_row])

    whole = smoothed(np.ones(per_row))
    # Aisles of alike racks are most of all.
    distinct, aisle = np.unique(drawn, axis=0, return_inverse=True)
    around = np.stack([smoothed(values) / whole for values in distinct])
    return np.asarray(np.repeat(around[aisle.reshape(-1)], 2, axis=0)[:rows])
