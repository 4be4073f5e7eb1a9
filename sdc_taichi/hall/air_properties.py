"""Density and heat capacity of the air of a hall."""

from __future__ import annotations

from typing import NamedTuple

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.exogenous.registry import site_pressure_pa
from sdc_taichi.plant.air import CONSTANT, OF_IDEAL_GAS, REFERENCE_C, DensityRatio, density_kg_m3


class AirProperties(NamedTuple):
    """Air of a hall, whose airflows are volume flows at REFERENCE_C and the site's pressure."""

    density_kg_m3: float
    """Density at REFERENCE_C, in kg/m3."""
    j_per_m3_k: float
    """Heat capacity by volume at REFERENCE_C, rho cp, in J/(m3 K)."""
    density_ratio: DensityRatio
    """Density over that at REFERENCE_C against temperature."""


def air_properties(config: DataCenterConfig) -> AirProperties:
    """Density and heat capacity of the air of a hall.

    A density of the config holds at all temperatures; without one it follows from the height of the
    site above sea level and the temperature.

    Raises:
        DataError: a site or weather file that names no height.
    """
    hall, site = config.hall, config.site
    given = hall.air_density_kg_m3
    if given is not None:
        return AirProperties(given, given * hall.air_heat_capacity_j_per_kg_k, CONSTANT)
    density = density_kg_m3(site_pressure_pa(site.location, site.weather_file), REFERENCE_C)
    return AirProperties(density, density * hall.air_heat_capacity_j_per_kg_k, OF_IDEAL_GAS)
