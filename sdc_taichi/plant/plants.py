"""Plants by name: how the heat of the halls gets outdoors."""

from __future__ import annotations

from collections.abc import Callable

from sdc_taichi.plant.dry_plants import air_cooled, air_side
from sdc_taichi.plant.water_side import WaterSideResult, water_cooled

PLANTS: dict[str, Callable[..., WaterSideResult]] = {
    "water_cooled": water_cooled,
    "air_cooled": air_cooled,
    "air_side": air_side,
}
"""Plants by the names that ``hvac.plant`` takes."""
DRY_PLANTS = frozenset({"air_cooled", "air_side"})
"""Plants that need an air-cooled chiller and no water of a tower."""
