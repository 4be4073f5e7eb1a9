"""How forecasts err: standard deviations, and the random walks that errors are made of.

The error of the forecast that is issued at time t for t + h is ``s (W(t + h) - W(t))`` with a
standard deviation s at 24 h and a random walk W of unit variance per 24 h. It is zero for the
present, grows with the square root of the lead, and a later forecast of the same hour differs from
an earlier one by what the walk has done in between. Environments and controllers read the same
walks: a walk depends on the key of its data center and on the step alone.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sdc_taichi.errors import ConfigError, RuntimeStateError, suggestion
from sdc_taichi.number_text import parse_number
from sdc_taichi.types import F64, I64

MOST_CI_SHARE = 10.0
"""Largest error of carbon intensity, ten times its value: no forecast is that poor."""
MOST_TEMPERATURE_K = 40.0
"""Largest error of temperatures, in K: the largest departure from the climate on record is 39 K."""
CI_WALK, TEMPERATURE_WALK = 0, 1
"""Numbers of the walks of carbon intensity and of temperatures."""
_FIELD_OF_NAME = {"ci": "ci_share", "temperature": "temperature_k"}
"""Fields of ``ForecastError`` by the names that its text has for them."""
_DRAWN_STEPS = 128
"""Steps of the random walks that are drawn at once."""


@dataclass(frozen=True, slots=True)
class ForecastError:
    """How forecasts err: standard deviations at a lead of 24 h. Zero is perfect foresight.

    Raises:
        ConfigError: a value that is no number or out of bounds.
    """

    ci_share: Annotated[float, Field(ge=0, le=MOST_CI_SHARE)] = 0.0
    """Standard deviation of the carbon intensity at 24 h, as a share of its true value, 0..10;
    forecasts are cut at zero."""
    temperature_k: Annotated[float, Field(ge=0, le=MOST_TEMPERATURE_K)] = 0.0
    """Standard deviation of dry bulb and wet bulb at 24 h, in K, 0..40. Both err alike, so that the
    wet bulb stays below the dry bulb."""

    def __post_init__(self) -> None:
        """Check the values."""
        for name, most in (("ci_share", MOST_CI_SHARE), ("temperature_k", MOST_TEMPERATURE_K)):
            value: Any = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.number):
                raise ConfigError(f"forecast error {name}: {value!r} is no number")
            if not 0.0 <= value <= most:
                raise ConfigError(f"forecast error {name}: {value:g}; valid is 0..{most:g}")

    @classmethod
    def parse(cls, text: str) -> ForecastError:
        """Forecast errors from their text, such as ``ci=0.1,temperature=1``.

        Args:
            text: ``ci``, a share, and ``temperature``, in K, each with its value or left out.

        Raises:
            ConfigError: another name, one that is given twice, or a value that is not valid.
        """
        values: dict[str, float] = {}
        for part in text.split(","):
            name, sign, value = (piece.strip() for piece in part.partition("="))
            if not sign or name not in _FIELD_OF_NAME:
                meant = suggestion(name, _FIELD_OF_NAME, " (did you mean {!r}?)")
                raise ConfigError(
                    f"forecast error {text!r}: {part.strip()!r}; valid is ci=SHARE, temperature=K, "
                    f"or both, such as ci=0.1,temperature=1{meant}"
                )
            if _FIELD_OF_NAME[name] in values:
                raise ConfigError(
                    f"forecast error {text!r}: {name} is given twice; valid is each once"
                )
            try:
                values[_FIELD_OF_NAME[name]] = parse_number(value)
            except ValueError:
                raise ConfigError(
                    f"forecast error {text!r}: {name} {value!r} is no number"
                ) from None
        return cls(**values)


PERFECT = ForecastError()
"""Perfect foresight."""


class RandomWalks:
    """Two random walks for each data center, of unit variance per 24 h, from reset on.

    Args:
        keys: seed of each data center, (B,).
        step_h: time step, in h.
    """

    def __init__(self, keys: Sequence[int] | I64, step_h: float) -> None:
        self._generators = [np.random.Generator(np.random.PCG64(int(key))) for key in keys]
        self._scale = np.sqrt(step_h / 24.0)
        self._first = 0
        self._walk: F64 = np.zeros((2, 1, len(keys)))

    def increments(self, which: int, step: int, leads: I64) -> F64:
        """Increments of a walk between ``step`` and each lead, (k, B).

        What lies before ``step`` is dropped.

        Args:
            which: ``CI_WALK`` or ``TEMPERATURE_WALK``.
            step: steps since reset.
            leads: leads in steps, (k,).

        Raises:
            RuntimeStateError: ``step`` lies before one that was asked for already.
        """
        self._extend(step, int(leads.max()))
        now = step - self._first
        walk = self._walk[which]
        return np.asarray(walk[now + leads] - walk[now])

    def _extend(self, step: int, ahead: int) -> None:
        if step < self._first:
            raise RuntimeStateError(
                f"forecasts of step {step} after those of a later one; reset starts again"
            )
        while self._first + self._walk.shape[1] <= step + ahead:
            keep = min(step - self._first, self._walk.shape[1] - 1)
            drawn = np.stack(
                [rng.standard_normal((2, _DRAWN_STEPS)) for rng in self._generators], axis=2
            )
            more = self._walk[:, -1:] + np.cumsum(drawn * self._scale, axis=1)
            self._walk = np.concatenate([self._walk[:, keep:], more], axis=1)
            self._first += keep


def walk_keys(seeds: I64, names: Sequence[str]) -> I64:
    """Seeds of the walks of a run, (B,), apart from those of its events and controllers.

    Args:
        seeds: seed of each data center, (B,).
        names: names of the data centers, so that those of one seed err apart, B of them.
    """
    drawn = [
        np.random.SeedSequence([int(seed), zlib.crc32(name.encode())]).generate_state(1, np.uint64)
        for seed, name in zip(seeds, names, strict=True)
    ]
    return np.asarray(np.concatenate(drawn) >> 1, dtype=np.int64)
