"""Running mean and variance of observations and returns."""

from __future__ import annotations

import torch
from torch import Tensor

LEAST_STD = 1e-2
"""Least standard deviation to divide by: an entry that hardly moves is not blown up."""
CLIP = 10.0
"""Largest normalised value, of either sign."""


class RunningMoments:
    """Mean and variance of all rows seen, by column (Chan, Golub, LeVeque 1983).

    Args:
        width: number of columns.

    Attributes:
        mean: mean of each column, (width,).
        variance: variance of each column, (width,).
        count: number of rows seen.
    """

    def __init__(self, width: int) -> None:
        self.mean = torch.zeros(width, dtype=torch.float64)
        self.variance = torch.ones(width, dtype=torch.float64)
        self.count = 0

    @property
    def std(self) -> Tensor:
        """Standard deviation to divide by, (width,), f32."""
        return self.variance.sqrt().clamp_min(LEAST_STD).float()

    def add(self, rows: Tensor) -> None:
        """Take rows, (n, width), into account."""
        n = len(rows)
        row_mean = rows.mean(0)
        # Many times faster than Tensor.var, which goes through rows one by one.
        variance = (rows - row_mean).square_().mean(0).double()
        mean = row_mean.double()
        total = self.count + n
        shift = mean - self.mean
        weight = self.count / total
        self.variance = (
            weight * self.variance
            + (1.0 - weight) * variance
            + weight * (1.0 - weight) * shift * shift
        )
        self.mean = self.mean + (1.0 - weight) * shift
        self.count = total

    def normalise(self, values: Tensor) -> Tensor:
        """Values less the mean over the standard deviation, within -CLIP..CLIP."""
        return ((values - self.mean.float()) / self.std).clamp_(-CLIP, CLIP)

    def state_dict(self) -> dict[str, object]:
        """Everything that ``load_state_dict`` needs."""
        return {"mean": self.mean, "variance": self.variance, "count": self.count}

    def load_state_dict(self, values: dict[str, object]) -> None:
        """Go on from what ``state_dict`` returned."""
        self.mean, self.variance = _tensor(values["mean"]), _tensor(values["variance"])
        self.count = int(str(values["count"]))


def _tensor(value: object) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).clone()
