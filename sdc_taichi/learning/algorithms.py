"""The algorithms: their names, the properties in which they differ, and their settings.

PyTorch is not needed to read this module.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

Share = Annotated[float, Field(ge=0, le=1)]
Hidden = tuple[Annotated[int, Field(strict=True, ge=1, le=4096)], ...]


class LearningSettings(BaseModel):
    """Settings that all algorithms have: when a policy decides, and between what."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    least_updates: ClassVar[int] = 2
    """Fewest updates of a training; of two, the first only measures observations or returns."""

    decision_steps: Annotated[int, Field(strict=True, ge=1, le=96)] = 4
    """Steps between two decisions of a policy, in which its actions are held."""
    levels: Annotated[int, Field(strict=True, ge=2, le=101)] | None = 7
    """Number of levels, evenly from -1 to 1, that continuous actions are chosen from (Tang and
    Agrawal 2020); None is any number."""

    def steps_per_update(self, episode_steps: int) -> int:
        """Steps of each data center between two updates.

        Args:
            episode_steps: number of steps of an episode.
        """
        return episode_steps


class ActingSettings(LearningSettings):
    """Settings of how policies act while they learn."""

    rollout_decisions: Annotated[int, Field(strict=True, ge=1, le=35_040)] = 32
    """Decisions of each data center between two updates."""
    against_idle: bool = True
    """Whether rewards are learned less those of idle commands in the same step of the same week,
    as no action changes those; without effect where episodes begin on drawn days."""

    def steps_per_update(self, episode_steps: int) -> int:
        """Steps of each data center between two updates."""
        return self.rollout_decisions * self.decision_steps


class OnPolicySettings(ActingSettings):
    """Settings of ``ppo``, ``ippo``, ``mappo``, ``happo`` and ``haa2c``."""

    epochs: Annotated[int, Field(strict=True, ge=1, le=100)] = 4
    """Passes over the steps of an update; ``haa2c`` makes one."""
    mini_batches: Annotated[int, Field(strict=True, ge=1, le=1024)] = 4
    """Parts that the steps of an update are learned from in turn."""
    rate: Annotated[float, Field(gt=0, le=1)] = 1e-3
    """Learning rate of Adam for policies and critics."""
    anneal: bool = True
    """Whether the learning rate falls to 0 in even steps over the training."""
    discount: Share = 0.97
    """Weight of a reward one decision later, gamma."""
    gae_lambda: Share = 0.95
    """Weight of later decisions in the advantage, lambda (Schulman et al. 2016)."""
    clip: Annotated[float, Field(gt=0, le=10)] = 0.2
    """Largest change of the probability ratio that pays, epsilon; ``haa2c`` has none."""
    entropy: Annotated[float, Field(ge=0, le=10)] = 0.001
    """Weight of the entropy of policies."""
    gradient_norm: Annotated[float, Field(gt=0)] = 0.5
    """Largest norm of a gradient of a network."""
    hidden: Hidden = (64, 64)
    """Units of the hidden layers of policies and critics."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Activation of all layers but the last."""
    reward: Literal["own", "team"] | None = None
    """Reward that critics learn: that of each learner, or that of all together over their number;
    None is that of the algorithm's source."""
    critic: Literal["observation", "state"] | None = None
    """Input of critics: what their learner observes, or the shared state; None is that of the
    algorithm's source."""


class OffPolicySettings(ActingSettings):
    """Settings of ``had3qn`` and ``hasac``."""

    least_updates: ClassVar[int] = 1

    levels: Annotated[int, Field(strict=True, ge=2, le=101)] | None = 5
    """Number of levels, evenly from -1 to 1, that continuous actions are chosen from, of which the
    critic values every combination; None is any number, for ``hasac``."""
    rollout_decisions: Annotated[int, Field(strict=True, ge=1, le=35_040)] = 8
    """Decisions of each data center between two updates."""
    gradient_steps: Annotated[int, Field(strict=True, ge=1, le=100_000)] = 64
    """Gradient steps of an update, each from a new batch."""
    batch_size: Annotated[int, Field(strict=True, ge=1, le=1_048_576)] = 1024
    """Transitions of a batch."""
    replay_size: Annotated[int, Field(strict=True, ge=1, le=100_000_000)] = 262_144
    """Decisions of all data centers together that the replay holds; each takes four bytes for every
    entry of the shared state and of the observations, in all 250 MB by default."""
    n_steps: Annotated[int, Field(strict=True, ge=1, le=1000)] = 4
    """Decisions of a transition, n."""
    rate: Annotated[float, Field(gt=0, le=1)] = 1e-3
    """Learning rate of Adam for policies and critics."""
    anneal: bool = True
    """Whether the learning rate falls to 0 in even steps over the training."""
    discount: Share = 0.97
    """Weight of a reward one decision later, gamma."""
    target_rate: Share = 0.005
    """Share of the way to the critics that their slow copies go in a gradient step, tau."""
    gradient_norm: Annotated[float, Field(gt=0)] = 10.0
    """Largest norm of a gradient of a network."""
    hidden: Hidden = (64, 64)
    """Units of the hidden layers of policies and critics."""
    activation: Literal["tanh", "relu"] = "relu"
    """Activation of all layers but the last."""
    exploration: Share = 0.05
    """Lowest probability of a random choice, epsilon; of ``had3qn``."""
    exploration_share: Share = 0.5
    """Share of the training over which the probability of a random choice falls from 1; of
    ``had3qn``."""
    temperature: Annotated[float, Field(gt=0, le=100)] = 0.01
    """Weight of the entropy at the beginning, alpha; of ``hasac``."""
    temperature_rate: Annotated[float, Field(ge=0, le=1)] = 1e-3
    """Learning rate of Adam for temperatures, 0 for constant ones; of ``hasac``."""
    entropy_share: Share = 0.3
    """Wanted entropy of choices as a share of the largest, the logarithm of their number; of
    ``hasac``."""
    continuous_entropy: float = -1.0
    """Wanted differential entropy of each continuous number, nats; log 2 is the largest; of
    ``hasac``."""


class CrossEntropySettings(LearningSettings):
    """Settings of ``cross-entropy``."""

    levels: Annotated[int, Field(strict=True, ge=2, le=101)] | None = None
    """Number of levels, evenly from -1 to 1, that continuous actions are chosen from, each by a
    score of its own; None is any number."""
    candidates: Annotated[int, Field(strict=True, ge=2, le=100_000)] = 64
    """Policies that are drawn in an update, at most as many as there are data centers."""
    elite_share: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Share of the candidates that the distributions are fitted to."""
    first_std: Annotated[float, Field(gt=0, le=100)] = 0.5
    """Standard deviation of parameters at the beginning."""
    noise_std: Annotated[float, Field(ge=0, le=100)] = 0.1
    """Standard deviation that is added to those of the best candidates, falling to 0 in even steps
    over the training."""
    memory_rate: Annotated[float, Field(gt=0, le=1)] = 0.3
    """Weight of the last episode in what returns of a data center are usual."""


class OnPolicyDefinition(NamedTuple):
    """Properties in which algorithms that learn from their latest steps differ."""

    critic: Literal["observation", "state"]
    """Input of critics: the observation of each learner, or the state that all share."""
    reward: Literal["own", "team"]
    """Reward that critics learn: that of each learner, or that of the team."""
    sequential: bool
    """Whether learners are updated in random order, each weighted by the ratios of those before."""
    clips: bool
    """Whether probability ratios are clipped, and steps used in several passes."""


class OffPolicyDefinition(NamedTuple):
    """Properties in which algorithms that learn from a replay differ."""

    critics: int
    """Number of critics, of which the lowest value counts."""
    soft: bool
    """Whether actions are drawn from policies that are rewarded for their entropy; otherwise the
    action of the highest value is taken, and sometimes a random one."""


ON_POLICY: dict[str, OnPolicyDefinition] = {
    "ppo": OnPolicyDefinition(critic="observation", reward="own", sequential=False, clips=True),
    "ippo": OnPolicyDefinition(critic="observation", reward="own", sequential=False, clips=True),
    "mappo": OnPolicyDefinition(critic="state", reward="team", sequential=False, clips=True),
    "happo": OnPolicyDefinition(critic="state", reward="team", sequential=True, clips=True),
    "haa2c": OnPolicyDefinition(critic="state", reward="team", sequential=True, clips=False),
}
"""Algorithms that learn from the steps that their policies have just made, by name."""
OFF_POLICY: dict[str, OffPolicyDefinition] = {
    "had3qn": OffPolicyDefinition(critics=1, soft=False),
    "hasac": OffPolicyDefinition(critics=2, soft=True),
}
"""Algorithms that learn from all steps that a replay holds, by name."""
LEARNING_SETTINGS: dict[str, type[LearningSettings]] = {
    **dict.fromkeys(ON_POLICY, OnPolicySettings),
    **dict.fromkeys(OFF_POLICY, OffPolicySettings),
    "cross-entropy": CrossEntropySettings,
}
"""Class of the settings of each algorithm, by name."""


def uses_state(name: str, settings: LearningSettings) -> bool:
    """Whether critics of an algorithm take the shared state of all agents as input.

    Args:
        name: name of the algorithm.
        settings: settings of the algorithm.
    """
    if isinstance(settings, OnPolicySettings):
        return (settings.critic or ON_POLICY[name].critic) == "state"
    return isinstance(settings, OffPolicySettings)
