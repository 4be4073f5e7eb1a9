"""Which racks take in more exhaust air: by their place in the hall, and by the air that racks draw.

Exhaust air reaches an inlet around the ends of the rows, over the racks, and where racks draw more
air than the floor tiles before them give. Symbols are those of docs/hall.md ("Exposure"). Arrays
over racks, (R,), list the rows one after another; P is the number of racks of a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.floor_plan import row_distance_m
from sdc_taichi.plant.air import DensityRatio
from sdc_taichi.plant.servers import ServerCurves
from sdc_taichi.types import F64

OVER_M = 2.3
"""Length, in m, of the zone at a row's end where less exhaust air comes over the racks."""
LEAST = 0.15
"""Exposure of a rack for which the sum of the terms is 0; the mean exposure is about 1."""
WALL_SHARE, WALL_M = 0.1, 2.5
"""Relative reduction of the exposure at a side wall, beyond which there is no exhaust, and its
decay length, in m."""
MOST_SUPPLY = 0.95
"""Largest airflow of the tiles divided by that of the racks for the distribution of exhaust; with
more air, recirculation shrinks, but the racks that it reaches remain the same."""
LEAST_ODDS = 0.005
"""Ratio of exhaust to supply air in an even hall at which half of the lacking air is replaced by
exhaust; a hall without recirculation has no path for it."""
LEAKS = 0.03
"""Resistance of an open cold aisle to the air that its tiles lack, divided by that of the gaps of
a closed one. It is fitted to ``sdc-taichi hall solve`` at containment 0 to 1."""


@dataclass(frozen=True, slots=True)
class _Coefficients:
    """Coefficients of the exposure of racks for one position of the return air openings."""

    around: float
    """Exposure at the end of a row to air that flows around this end."""
    around_length_m: float
    """Decay length of the exposure to air that flows around the end of a row, in m."""
    around_by_exhaust: float
    """Relative increase of ``around`` per relative increase of the exhaust behind the row."""
    around_by_wind: float
    """Increase of ``around`` per relative wind over the row."""
    over: float
    """Reduction of exposure at the end of a row, where less air flows over the racks."""
    wind: float
    """Exposure per relative wind that blows from the back of a rack to its front."""
    exhaust: float
    """Exposure per relative increase of the exhaust behind the row."""
    lack: float
    """Exhaust that a rack takes in for each part of air that its tiles lack."""
    neighbours_m: float
    """Decay length of the weights by which racks share the tiles of their aisle, in m."""


_BY_RETURNS = {
    "ceiling": _Coefficients(10.2, 0.455, 0.69, 0.0, -0.275, 7.1, -0.377, 1.1, 3.0),
    "end_wall": _Coefficients(0.25, 0.433, 0.0, 0.789, 0.584, 0.075, 0.124, 1.0, 2.4),
}


def exposure(hall: HallConfig, airflow_m3s: F64, supply_share: float) -> F64:
    """Return the relative exposure of every rack to exhaust air, above 0, (R,).

    The exposure of rack j, with distances x to the ends of its row, is

        e_j = 1 + sum_ends exp(-x / around_length) (around (1 + around_by_exhaust (h_j - 1))
                + around_by_wind |w_j|) - over sum_ends exp(-x / OVER_M)
                + wind w_j + exhaust (h_j - 1)

    and is bounded to stay above 0. h_j is the exhaust behind rack j divided by the air that its
    cold aisle draws, and w_j the wind over its row (``_wind``) divided by the air that a rack of
    its aisle draws. Both are local means along the row. The coefficients are fitted to the shares
    of exhaust air that ``sdc-taichi hall solve`` computes for 138 halls of 12 to 168 racks, in
    which rows or single racks have two to five times the power of the others.

    Args:
        hall: Configuration of the hall.
        airflow_m3s: Airflow of each rack at the design point, m3/s, (R,).
        supply_share: Airflow of all floor tiles divided by that of all racks.
    """
    values = _BY_RETURNS[hall.layout.returns]
    places: F64 = np.arange(hall.racks_per_row, dtype=np.float64)
    along = (places + 0.5) * hall.layout.rack_pitch_m
    airflow = airflow_m3s.reshape(hall.rows, hall.racks_per_row) / airflow_m3s.mean()
    row = np.arange(hall.rows)
    drawn, exhaust = cold_aisles(airflow), _hot_aisles(airflow)
    near = _smoothed(hall, np.concatenate([drawn, exhaust]))
    near_drawn, near_exhaust = near[: len(drawn)], near[len(drawn) :]
    aisle_mean = drawn.mean(axis=1, keepdims=True)
    behind = near_exhaust[(row + 1) // 2] / aisle_mean[row // 2] - 1.0
    facing_rows = np.bincount(row // 2)[row // 2, None]
    tile_share = min(supply_share, MOST_SUPPLY)
    wind = _wind(hall, drawn, exhaust, near_drawn, near_exhaust, tile_share)
    wind *= np.where(row % 2 == 0, 1.0, -1.0)[:, None] * facing_rows / aisle_mean[row // 2]
    around = values.around * (1.0 + values.around_by_exhaust * behind)
    around += values.around_by_wind * np.abs(wind)
    raw = 1.0 + around * _from_ends(along, values.around_length_m)
    raw -= values.over * _from_ends(along, OVER_M)
    raw += values.wind * wind + values.exhaust * behind
    raw *= 1.0 - WALL_SHARE * _from_walls(hall)[:, None]
    # This smooth, monotonic function keeps the exposure above 0 even if ``raw`` is negative.
    return np.asarray(raw + np.hypot(raw, 2.0 * LEAST)).reshape(-1) / 2.0


def _from_ends(along_m: F64, length_m: float) -> F64:
    """Return the sum of exp(-distance / length) over both ends of a row, for P racks, (P,)."""
    from_first: F64 = np.exp(-along_m / length_m)
    return np.asarray(from_first + from_first[::-1], dtype=np.float64)


def _from_walls(hall: HallConfig) -> F64:
    """Return the sum over both side walls of exp(-distance / WALL_M) to each row, (rows,)."""
    measures, row = hall.layout, np.arange(hall.rows)
    centre_m = measures.side_margin_m + measures.rack_depth_m / 2 + row_distance_m(measures, row)
    width_m = centre_m[-1] + measures.rack_depth_m / 2 + measures.side_margin_m
    front_m = centre_m + np.where(row % 2 == 0, 0.5, -0.5) * measures.rack_depth_m
    return np.asarray(np.exp(-front_m / WALL_M) + np.exp(-(width_m - front_m) / WALL_M))


def cold_aisles(airflow: F64) -> F64:
    """Return the air that the racks of each cold aisle draw at each place, (..., aisles, P).

    Rows 0 and 1 face the same aisle, and so on; if their number is odd, the last faces a wall.

    Args:
        airflow: Airflow of each rack, (..., rows, P).
    """
    return np.asarray(np.add.reduceat(airflow, np.arange(0, airflow.shape[-2], 2), axis=-2))


def _hot_aisles(airflow: F64) -> F64:
    """Return the exhaust into each hot aisle at each place, (aisles, P); the first is beside row 0.

    Args:
        airflow: Airflow of each rack, (rows, P).
    """
    first = np.concatenate([[0], np.arange(1, len(airflow), 2)])
    return np.asarray(np.add.reduceat(airflow, first, axis=0))


def _smoothed(hall: HallConfig, values: F64) -> F64:
    """Return local means along the rows with weights exp(-distance / length), (..., P)."""
    pitches = _BY_RETURNS[hall.layout.returns].neighbours_m / hall.layout.rack_pitch_m
    return _near_sums(values, pitches) / _near_sums(np.ones(values.shape[-1]), pitches)


def _near_sums(values: F64, pitches: float) -> F64:
    """Return sums of values along the last axis, weighted by exp(-distance / pitches)."""
    # The import of scipy.signal takes a third of a second.
    from scipy.signal import lfilter

    fall = [1.0, -np.exp(-1.0 / pitches)]
    before = lfilter([1.0], fall, values, axis=-1)
    after = lfilter([1.0], fall, values[..., ::-1], axis=-1)[..., ::-1]
    return np.asarray(before + after - values)


def _wind(
    hall: HallConfig,
    drawn: F64,
    exhaust: F64,
    near_drawn: F64,
    near_exhaust: F64,
    supply_share: float,
) -> F64:
    """Return the airflow over each rack towards larger y, divided by a rack's, (rows, P).

    It follows from the balance of the air between the first wall and the row: exhaust and air from
    the tiles enter, the racks and the returns take air. Returns in the end walls take the same from
    each metre of the width, returns in the ceiling what the tiles give the racks of their aisle.

    Args:
        hall: Configuration of the hall.
        drawn: Air that each cold aisle draws at each place, divided by a rack's, (aisles, P).
        exhaust: Exhaust into each hot aisle at each place, divided by a rack's, (aisles, P).
        near_drawn: Local means of ``drawn`` along the aisles.
        near_exhaust: Local means of ``exhaust`` along the aisles.
        supply_share: Airflow of all floor tiles divided by that of all racks.
    """
    measures, row = hall.layout, np.arange(hall.rows)
    from_cold = supply_share * drawn.mean(axis=1, keepdims=True) - near_drawn
    from_hot = near_exhaust
    if measures.returns == "ceiling":
        from_hot = near_exhaust - supply_share * exhaust.mean(axis=1, keepdims=True)
    before_cold = np.concatenate([np.zeros((1, drawn.shape[1])), np.cumsum(from_cold, axis=0)])
    over = np.cumsum(from_hot, axis=0)[row // 2] + before_cold[(row + 1) // 2]
    if measures.returns == "end_wall":
        before_m = measures.side_margin_m + measures.rack_depth_m / 2
        from_wall_m = before_m + row_distance_m(measures, row)
        returned = supply_share * drawn.sum() / drawn.shape[1]
        over = over - returned * (from_wall_m / (from_wall_m[-1] + before_m))[:, None]
    return np.asarray(over)


def with_lack(odds: F64, lack: F64) -> F64:
    """Return the ratio of exhaust to supply air in an intake whose tiles lack air, from 0 up.

    Args:
        odds: Ratio of exhaust to supply air of a rack that draws what its tiles give, any shape.
        lack: Air that the tiles lack and exhaust replaces, divided by the rack's supply air, of
            the same shape; negative where tiles give more than the racks draw. The ratio then falls
            exponentially, with the same slope at 0.
    """
    ratio = np.divide(np.minimum(lack, 0.0), odds, out=np.zeros_like(lack), where=odds > 0.0)
    return np.asarray(odds * np.exp(ratio) + np.maximum(lack, 0.0))


def lack_slope(returns: str, containment: float) -> float:
    """Return the exhaust that replaces each part of lacking air, which containment reduces.

    Args:
        returns: Position of the return air openings, ``ceiling`` or ``end_wall``.
        containment: Share of the air paths that containment closes, 0..1.
    """
    paths = 1.0 - containment
    return _BY_RETURNS[returns].lack * paths * (1.0 + LEAKS) / (paths + LEAKS)


@dataclass(frozen=True, slots=True)
class TileAir:
    """Exhaust shares of the R racks of a hall by the air that they draw from the tiles.

    A rack and its neighbours draw v_j times the air that the tiles before them give. Each part that
    is lacking is replaced by exhaust air. The tiles give each place of an aisle the same, and each
    aisle air in proportion to what its racks draw, as in ``sdc-taichi hall solve``.
    """

    hall: HallConfig
    """Configuration of the hall."""
    curves: ServerCurves
    """Airflow curve of the servers."""
    density_ratio: DensityRatio
    """Density of the air divided by that at the reference temperature."""
    full_m3s: F64
    """Airflow of each rack at an airflow ratio of 1, as volume at its inlet, in m3/s, (R,)."""
    inlet_c: float
    """Inlet temperature at which airflows are compared, in C: the mean of the reference hall."""
    odds: F64
    """Ratio of exhaust to supply air of each rack where v_j is ``balance``, (R,)."""
    balance: F64
    """v_j at which racks take in the exhaust that ``odds`` says, (R,): 1, or that of the design
    point if the exhaust shares are imposed there."""
    slope: float
    """Exhaust that replaces each part of lacking air, see ``lack_slope``."""
    supply_scale: float
    """Factor of the supply air in all intakes, at most 1, by which racks take in no more than the
    CRAC units give."""
    of_height: F64
    """Exhaust share of a server of height factor 1 divided by that of its rack, (R,)."""
    most_share: F64
    """Largest exhaust share of each rack, with which its top servers take in only exhaust, (R,)."""

    def airflow_m3s(self, load: F64) -> F64:
        """Return the airflow of each rack at a load, in m3/s, (..., R).

        Args:
            load: Load of each rack, 0..1, (..., R).
        """
        inlet_c = np.array(self.inlet_c)
        ratio = self.curves.airflow_ratio(inlet_c, load)
        moved = self.curves.moved_ratio(ratio, inlet_c, self.density_ratio)
        return np.asarray(self.full_m3s * moved)

    def draw(self, airflow_m3s: F64) -> F64:
        """Return v_j, the air that racks around j draw divided by that of their tiles, (..., R).

        Args:
            airflow_m3s: Airflow of each rack, m3/s, (..., R).
        """
        rows, per_row = self.hall.rows, self.hall.racks_per_row
        shape = airflow_m3s.shape
        drawn = cold_aisles(airflow_m3s.reshape(*shape[:-1], rows, per_row))
        ratio = _smoothed(self.hall, drawn)
        ratio /= np.maximum(drawn.mean(axis=-1, keepdims=True), 1e-30)
        return np.repeat(ratio, 2, axis=-2)[..., :rows, :].reshape(shape)

    def exhaust_share(self, airflow_m3s: F64) -> F64:
        """Return the share of exhaust air in the intake of each rack, 0..1, (..., R).

        Args:
            airflow_m3s: Airflow of each rack, m3/s, (..., R).
        """
        open_share = self.odds / (self.odds + LEAST_ODDS)
        lack = self.slope * open_share * (1.0 + self.odds)
        lack = lack * (self.draw(airflow_m3s) - self.balance)
        odds = with_lack(np.broadcast_to(self.odds, lack.shape), lack)
        return np.minimum(1.0 - self.supply_scale / (1.0 + odds), self.most_share)

    def at_full_load(self) -> F64:
        """Return the share of exhaust air in the intake of each rack at full load, (R,)."""
        return self.exhaust_share(self.airflow_m3s(np.ones(self.hall.racks)))
