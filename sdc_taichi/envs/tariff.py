"""The price of electricity that rewards may count."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator

Price = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
"""A price, 0..1e9, which leaves room for currencies of many zeros."""


class Tariff(BaseModel):
    """Prices for the reward terms ``cost`` and ``demand_charge``, in any one currency."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    price_per_kwh: tuple[Price, ...] = (
        *(0.08,) * 7, *(0.12,) * 9, *(0.20,) * 5, *(0.12,) * 3,
    )  # fmt: skip
    """Price of a kWh: one for all hours, or 24, one for each local hour of the day from midnight
    on."""
    demand_charge_per_kw: Price = 12.0
    """Price of each kW of the highest mean power of a step, per bill of 30 days."""

    @field_validator("price_per_kwh")
    @classmethod
    def _one_or_each_hour(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in (1, 24):
            raise ValueError(f"{len(value)} prices; valid is 1, or 24 from midnight on")
        return value
