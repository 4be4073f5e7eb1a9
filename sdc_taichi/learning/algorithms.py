"""The algorithms by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from sdc_taichi.learning.cloning import Cloning
from sdc_taichi.learning.cross_entropy import CrossEntropySearch
from sdc_taichi.learning.experts import make_expert
from sdc_taichi.learning.off_policy import OffPolicy, OffPolicyDefinition
from sdc_taichi.learning.on_policy import OnPolicy, OnPolicyDefinition
from sdc_taichi.learning.policy import PolicyNetwork
from sdc_taichi.learning.settings import (
    CloningSettings,
    CrossEntropySettings,
    LearningSettings,
    OffPolicySettings,
)
from sdc_taichi.learning.stream import EnvironmentStream

ON_POLICY: dict[str, OnPolicyDefinition] = {
    "ppo": OnPolicyDefinition(critic="observation", reward="own", sequential=False, clips=True),
    "ippo": OnPolicyDefinition(critic="observation", reward="own", sequential=False, clips=True),
    "mappo": OnPolicyDefinition(critic="state", reward="team", sequential=False, clips=True),
    "happo": OnPolicyDefinition(critic="state", reward="team", sequential=True, clips=True),
    "haa2c": OnPolicyDefinition(critic="state", reward="team", sequential=True, clips=False),
}
"""Algorithms that learn from the steps that their policies have just made."""
OFF_POLICY: dict[str, OffPolicyDefinition] = {
    "had3qn": OffPolicyDefinition(critics=1, soft=False),
    "hasac": OffPolicyDefinition(critics=2, soft=True),
}
"""Algorithms that learn from all steps that a replay holds."""


class Algorithm(Protocol):
    """A learner in a stream of environments that makes networks of policies."""

    def update(self, stream: EnvironmentStream) -> dict[str, float]:
        """Act for some steps, learn, and return numbers to log by name."""

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """The policies as they are."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides how the training goes on."""

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Go on from what ``state_dict`` returned, of an algorithm made alike."""


def make_algorithm(
    name: str, settings: LearningSettings, stream: EnvironmentStream, *, updates: int, seed: int
) -> Algorithm:
    """An algorithm before its first update.

    Args:
        name: name of the algorithm.
        settings: settings of the algorithm.
        stream: the environments that it is to learn in.
        updates: number of updates of the whole training.
        seed: seed of all that it draws.

    Raises:
        ConfigError: actions that the algorithm does not take, fewer data centers than it needs, or
            an unknown expert.
    """
    if isinstance(settings, CloningSettings):
        return Cloning(
            settings,
            make_expert(settings.expert, stream.view.fleet, stream.episode_steps),
            stream.spaces,
            episode_steps=stream.episode_steps,
            updates=updates,
            seed=seed,
        )
    if isinstance(settings, CrossEntropySettings):
        return CrossEntropySearch(
            settings,
            stream.spaces,
            size=stream.size,
            episode_steps=stream.episode_steps,
            updates=updates,
            seed=seed,
        )
    given = stream.spaces, stream.state_width
    if isinstance(settings, OffPolicySettings):
        return OffPolicy(OFF_POLICY[name], settings, *given, updates=updates, seed=seed)
    return OnPolicy(ON_POLICY[name], settings, *given, updates=updates, seed=seed)


def uses_state(name: str, settings: LearningSettings) -> bool:
    """Whether critics of an algorithm take the shared state of all agents as input."""
    if isinstance(settings, CloningSettings | CrossEntropySettings):
        return False
    if isinstance(settings, OffPolicySettings):
        return True
    return (settings.critic or ON_POLICY[name].critic) == "state"


def steps_per_update(settings: LearningSettings, stream: EnvironmentStream) -> int:
    """Steps of each data center in an update."""
    if isinstance(settings, CloningSettings | CrossEntropySettings):
        return stream.episode_steps
    return settings.steps_per_update
