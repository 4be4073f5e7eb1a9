"""Section ``electrical``: the connection to the grid."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sdc_taichi.config.fields import Section


class ElectricalConfig(Section):
    """Connection of a data center to the grid."""

    grid_limit_kw: Annotated[float, Field(ge=0.1, le=1e8)] | None = None
    """Most power that the grid connection carries, in kW, 0.1..1e8: from a single server to ten
    times the largest campus that has been announced; None takes ``grid_limit_ratio``."""
    grid_limit_ratio: Annotated[float, Field(ge=0.01, le=1000)] | None = None
    """Most power that the grid connection carries over the facility's power at the design point,
    0.01..1,000; None is no limit, where ``grid_limit_kw`` gives none."""
