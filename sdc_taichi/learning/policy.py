"""Policies: networks that agents act by, and the environment that they fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sdc_taichi.types import F32


@dataclass(frozen=True, slots=True)
class PolicyNetwork:
    """A perceptron that chooses the actions of one learner.

    Its input is the observation, normalised: (x - mean) / std, within -clip..clip.
    """

    agents: tuple[str, ...]
    """Agents that it acts for, in the order of its actions."""
    mean: F32
    """Mean of each entry of the observation, (n,)."""
    std: F32
    """Standard deviation of each entry of the observation, (n,)."""
    clip: float
    """Largest normalised entry, of either sign."""
    layers: tuple[tuple[F32, F32], ...]
    """Weight, (out, in), and bias, (out,), of each layer."""
    activation: Literal["tanh", "relu"]
    """Activation of all layers but the last."""
    head: Literal["argmax", "clip", "tanh"]
    """Meaning of the k * 3 or k outputs: the largest of each three is chosen, or each is a number
    cut at -1 and 1, or its hyperbolic tangent is."""
