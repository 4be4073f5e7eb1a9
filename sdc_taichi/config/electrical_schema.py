"""Section ``electrical``: grid connection, UPS and distribution."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sdc_taichi.config.fields import Section, Share


class UpsConfig(Section):
    """Losses of the UPS.

    The default is a UPS of 97.0 % at full load, 96.3 % at half and 94.1 % at a quarter (V. Avelar,
    "Making Large UPS Systems More Efficient", Schneider Electric white paper 108, 2010), which
    double conversion without a transformer reaches today.
    """

    no_load_share: Share = 0.01333
    """Loss without load over rated power, 0..1."""
    proportional_share: Share = 0.0064
    """Loss in proportion to the load, over the load, 0..1."""
    square_share: Share = 0.01081
    """Loss by the square of the load, over rated power at full load, 0..1."""


class DistributionConfig(Section):
    """Losses of transformers, PDUs and wiring between UPS and racks.

    The default is a dry transformer of 300 kVA as the USA have required since 2016 (99.02 % at 35 %
    of its load, half of its loss without load; 10 CFR 431.196), and 1 % in the wiring at full load
    (Rasmussen, Schneider Electric white paper 113, 2012).
    """

    no_load_share: Share = 0.0017
    """Loss without load over rated power, 0..1."""
    proportional_share: Share = 0.0
    """Loss in proportion to the load, over the load, 0..1."""
    square_share: Share = 0.024
    """Loss by the square of the load, over rated power at full load, 0..1."""


class ElectricalConfig(Section):
    """Grid connection, UPS and distribution of a data center."""

    losses: Literal["reported", "counted"] = "reported"
    """Treatment of the losses of UPS and distribution: ``counted`` in grid energy, PUE, carbon and
    cost, or only ``reported`` beside them."""
    capacity_ratio: Annotated[float, Field(ge=1, le=10)] = 1.25
    """Rated power of UPS and distribution over what they carry at the design point, 1..10: five
    modules where four suffice are 1.25, two paths of which each suffices are 2."""
    ups: UpsConfig = UpsConfig()
    """Losses of the UPS."""
    distribution: DistributionConfig = DistributionConfig()
    """Losses of transformers, PDUs and wiring."""
    grid_limit_kw: Annotated[float, Field(ge=0.1, le=1e8)] | None = None
    """Most power that the grid connection carries, in kW, 0.1..1e8: from a single server to ten
    times the largest campus that has been announced; None takes ``grid_limit_ratio``."""
    grid_limit_ratio: Annotated[float, Field(ge=0.01, le=1000)] | None = None
    """Most power that the grid connection carries over the facility's power at the design point,
    0.01..1,000; None is no limit, where ``grid_limit_kw`` gives none."""
