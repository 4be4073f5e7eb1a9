"""Random numbers of an algorithm, of which each use has a generator of its own."""

from __future__ import annotations

import torch

USES = ("weights", "actions", "batches", "order")
"""Uses of random numbers: first weights of networks, actions drawn from policies, steps to learn
from, and the order in which learners are updated."""


def generators(seed: int) -> dict[str, torch.Generator]:
    """Generators by use, so that drawing more for one use changes no other.

    Args:
        seed: seed of the training, from which each generator gets a seed that no other has.
    """
    return {use: torch.Generator().manual_seed(seed * len(USES) + i) for i, use in enumerate(USES)}
