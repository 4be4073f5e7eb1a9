"""What a plan minimises: carbon, energy, cost, water, or a weighed sum of them."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields

import numpy as np

from sdc_taichi.errors import ConfigError, suggestion
from sdc_taichi.number_text import parse_number
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64

_UNITS = {"carbon": "kg CO2e", "energy": "kWh", "cost": "currency of the tariff", "water": "L"}
"""Units of the objectives of one term with weight 1."""
_TERM = re.compile(r"(?:(?P<weight>[^*]+)\*)?(?P<name>[^*]+)")


@dataclass(frozen=True, slots=True)
class Objective:
    """Weights of the terms of an objective, each 0 or more.

    The figure of a run is the sum of ``carbon`` for each kg CO2e, ``energy`` for each kWh that is
    bought, ``cost`` for each unit of the bill, and ``water`` for each litre that is made up.

    Raises:
        ConfigError: a weight that is negative or not finite, or no weight above 0.
    """

    carbon: float = 0.0
    """Weight of a kg CO2e of the energy bought."""
    energy: float = 0.0
    """Weight of a kWh bought."""
    cost: float = 0.0
    """Weight of a unit of the tariff's currency, of energy and of demand charges."""
    water: float = 0.0
    """Weight of a litre of make-up water."""

    def __post_init__(self) -> None:
        """Check the weights."""
        weights = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, weight in weights.items():
            if not 0.0 <= weight < np.inf:
                raise ConfigError(f"objective: weight {weight:g} of {name}; valid is 0 or more")
        if not any(weights.values()):
            raise ConfigError(f"objective: no weight is above 0; valid terms: {', '.join(weights)}")

    @classmethod
    def parse(cls, text: str) -> Objective:
        """An objective from its text, such as ``carbon`` or ``carbon+0.002*water``.

        Args:
            text: names of terms, joined by ``+``, each with a weight before it or with weight 1.

        Raises:
            ConfigError: an unknown term, one that is given twice, or a weight that is no number.
        """
        valid = [f.name for f in fields(cls)]
        weights: dict[str, float] = {}
        for part in text.split("+"):
            found = _TERM.fullmatch(part.strip())
            name = found["name"].strip() if found else part.strip()
            if found is None or name not in valid:
                meant = suggestion(name, valid, " (did you mean {!r}?)")
                raise ConfigError(
                    f"objective {text!r}: {part.strip()!r}; valid are {', '.join(valid)}, and sums "
                    f"such as carbon+0.002*water{meant}"
                )
            if name in weights:
                raise ConfigError(f"objective {text!r}: {name} is given twice; valid is each once")
            try:
                weights[name] = parse_number(found["weight"]) if found["weight"] else 1.0
            except ValueError:
                raise ConfigError(
                    f"objective {text!r}: weight {found['weight']!r} is no number"
                ) from None
        return cls(**weights)

    def __str__(self) -> str:
        """The text that ``parse`` reads."""
        weights = {f.name: getattr(self, f.name) for f in fields(self)}
        return "+".join(
            name if weight == 1.0 else f"{_shortest(weight)}*{name}"
            for name, weight in weights.items()
            if weight
        )

    @property
    def unit(self) -> str:
        """Unit of the figure; of a sum, the text of the objective."""
        return _UNITS.get(str(self), str(self))

    def kwh_weight(self, ci_g_per_kwh: F64, price_per_kwh: F64) -> F64:
        """Weight of a kWh bought in each step, without demand charges, (B, T).

        Args:
            ci_g_per_kwh: Carbon intensity, in g CO2e/kWh, (B, T).
            price_per_kwh: Price, in the currency of the tariff, (B, T).
        """
        return self.energy + self.carbon * ci_g_per_kwh / 1e3 + self.cost * price_per_kwh

    def kw_month_weight(self, fleet: Fleet) -> F64:
        """Weight of each kW of the highest power of a month, (B,)."""
        return np.asarray(self.cost * fleet.values("tariff.demand_charge_per_kw"))

    def figure(self, *, cfp_kg: F64, grid_kwh: F64, cost: F64, water_l: F64) -> F64:
        """The figure of a run, (B,).

        Args:
            cfp_kg: Carbon of the energy bought, in kg CO2e, (B,).
            grid_kwh: Energy bought, in kWh, (B,).
            cost: Bill of energy and demand, in the currency of the tariff, (B,).
            water_l: Make-up water, in l, (B,).
        """
        return (
            self.carbon * cfp_kg + self.energy * grid_kwh + self.cost * cost + self.water * water_l
        )


def _shortest(weight: float) -> str:
    """The shortest text that is read as this very number, without a plus sign."""
    return repr(float(weight)).removesuffix(".0").replace("e+", "e")
