"""Random halls of one family, for policies that should control halls that they have not seen."""

from __future__ import annotations

from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig, load_config, with_values
from sdc_taichi.errors import ConfigError

LIGHT, DENSE = ("storage", "compute"), ("gpu", "gpu_dense")
"""Rack types of preset ``hall_of_2026``: racks of up to 11 kW, and of 20 kW or more."""


def hall_family(
    rng: np.random.Generator,
    count: int,
    base: DataCenterConfig | None = None,
    *,
    row_pairs: tuple[int, int] = (2, 6),
    racks_per_row: tuple[int, int] = (8, 16),
    units: tuple[int, int] = (4, 16),
    dense_share: tuple[float, float] = (0.0, 0.4),
    containment: tuple[float, float] = (0.3, 0.9),
    plenum_coupling: tuple[float, float] = (0.0, 1.0),
) -> list[DataCenterConfig]:
    """Draw halls that differ in size, units, density, containment and plenum.

    All values are uniformly distributed in their ranges. Rows stand in pairs that share a cold
    aisle; a pair has racks of one type, which is ``gpu`` or ``gpu_dense`` with the probability
    that is drawn for the hall, and ``storage`` or ``compute`` otherwise. The configs are named
    after ``base`` and numbered; they depend on ``base`` and the state of ``rng`` alone.

    Args:
        rng: Source of the random numbers.
        count: Number of halls.
        base: Data center with the rack types of ``hall_of_2026``, from which the halls have
            everything else; None means preset ``hall_agents_16``.
        row_pairs: Fewest and most pairs of rows.
        racks_per_row: Fewest and most racks of a row.
        units: Fewest and most CRAC units, of which one in eight, but at least one, is spare.
        dense_share: Least and greatest probability of dense racks, 0..1.
        containment: Least and greatest containment, 0..0.95.
        plenum_coupling: Least and greatest coupling of the units by the plenum, 0..1.

    Raises:
        ConfigError: A range is not valid, or ``base`` lacks a rack type.
    """
    base = load_config("hall_agents_16") if base is None else base
    ranges = {
        "row_pairs": (row_pairs, 1, 100),
        "racks_per_row": (racks_per_row, 2, 100),
        "units": (units, 2, 1000),
        "dense_share": (dense_share, 0, 1),
        "containment": (containment, 0, 0.95),
        "plenum_coupling": (plenum_coupling, 0, 1),
    }
    for name, ((low, high), least, most) in ranges.items():
        if not least <= low <= high <= most:
            raise ConfigError(
                f"hall family: {name} {low:g}..{high:g}; valid is a range within "
                f"{least:g}..{most:g}, the lower number first"
            )
    missing = [name for name in (*LIGHT, *DENSE) if name not in base.hall.rack_types]
    if missing:
        raise ConfigError(
            f"hall family: {base.name} has no rack type {', '.join(missing)}; valid is a config "
            "with the rack types of hall_of_2026"
        )

    def integer(limits: tuple[int, int]) -> int:
        return int(rng.integers(limits[0], limits[1] + 1))

    def number(limits: tuple[float, float]) -> float:
        return float(rng.uniform(*limits))

    halls = []
    for index in range(count):
        pairs, racks, n_units = integer(row_pairs), integer(racks_per_row), integer(units)
        dense = number(dense_share)
        kinds = [(DENSE if rng.random() < dense else LIGHT)[integer((0, 1))] for _ in range(pairs)]
        plan = [{"type": kind, "rows": [2 * pair, 2 * pair + 1]} for pair, kind in enumerate(kinds)]
        values: dict[str, Any] = {
            "name": f"{base.name}_{index}",
            "hall.rows": 2 * pairs,
            "hall.racks_per_row": racks,
            "hall.rack_plan": plan,
            "hall.layout.containment": number(containment),
            "hvac.crac.units": n_units,
            "hvac.crac.spare_units": max(1, n_units // 8),
            "hvac.crac.plenum_coupling": number(plenum_coupling),
            "hvac.crac.capacity_kw": None,
        }
        halls.append(with_values(base, values))
    return halls
