"""Policies of random weights, on the small preset."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from sdc_taichi import build_fleet, load_config
from sdc_taichi.envs.options import make_options
from sdc_taichi.learning.interface import Interface, interface_of
from sdc_taichi.learning.policy import About, Head, Policy, PolicyNetwork


def network(
    agents: tuple[str, ...],
    inputs: int,
    outputs: int,
    head: Head = "argmax",
    seed: int = 0,
    choices: int = 3,
) -> PolicyNetwork:
    """A network of random weights, whose actions depend on what it observes."""
    rng = np.random.default_rng(seed)
    sizes = (inputs, 11, 8, outputs)
    return PolicyNetwork(
        agents,
        mean=rng.uniform(0.0, 1.0, inputs).astype(np.float32),
        std=rng.uniform(0.05, 0.3, inputs).astype(np.float32),
        clip=5.0,
        layers=tuple(
            (
                rng.normal(size=(n, m)).astype(np.float32) / np.float32(m**0.5),
                rng.normal(0.0, 0.1, n).astype(np.float32),
            )
            for m, n in itertools.pairwise(sizes)
        ),
        activation="tanh" if seed % 2 else "relu",
        head=head,
        choices=choices,
    )


def interface(**options: Any) -> Interface:
    return interface_of(build_fleet(load_config("tiny")), make_options(**options))


def policy(
    fits: Interface, *, seed: int = 0, levels: int | None = None, decision_steps: int = 1
) -> Policy:
    """A policy of random weights, one network for each agent.

    With ``levels``, it chooses continuous actions from as many.
    """
    choices = 3 if fits.actions == "discrete" else levels
    return Policy(
        tuple(
            network(
                (agent,),
                fits.width(agent),
                fits.action_width(agent) * (choices or 1),
                "clip" if choices is None else "argmax",
                seed + i,
                choices or 3,
            )
            for i, agent in enumerate(fits.agents)
        ),
        fits,
        About(algorithm="none", seed=seed),
        decision_steps,
    )
