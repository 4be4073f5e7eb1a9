"""Learning algorithms: their names, the properties in which they differ, and their settings.

This module does not import PyTorch.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

Share = Annotated[float, Field(ge=0, le=1)]
Reward = Literal["own", "team"] | Share
Hidden = tuple[Annotated[int, Field(strict=True, ge=1, le=4096)], ...]


class LearningSettings(BaseModel):
    """Settings that all algorithms have: interval of decisions, and levels to choose from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    least_updates: ClassVar[int] = 2
    """Minimum number of updates of a training. It is 2 if the first update only measures
    observations or returns."""

    decision_steps: Annotated[int, Field(strict=True, ge=1, le=96)] = 4
    """Number of steps from one decision of a policy to the next; its actions are repeated in
    between."""
    levels: Annotated[int, Field(strict=True, ge=2, le=101)] | None = 7
    """Number of equally spaced levels from -1 to 1 that a continuous action is chosen from (Tang
    and Agrawal 2020); None allows any number."""
    reward: Reward | None = None
    """Reward that learners learn from: ``own``, the reward of each learner; ``team``, the mean
    reward of all learning agents; or a mixture of both, as the share of the own reward, 0..1. None
    selects the default: that of the algorithm, but ``team`` if agents share a policy and critics
    take the shared state, which cannot distinguish such agents."""

    def steps_per_update(self, episode_steps: int) -> int:
        """Return the number of steps of each data center between two updates."""
        return episode_steps


class ActingSettings(LearningSettings):
    """Settings of algorithms that update a policy during an episode."""

    rollout_decisions: Annotated[int, Field(strict=True, ge=1, le=35_040)] = 32
    """Number of decisions of each data center between two updates."""
    against_idle: bool = True
    """True to subtract from each reward the reward of idle commands in the same step of the same
    week. No action changes that baseline. The setting has no effect if episodes begin on randomly
    drawn days."""

    def steps_per_update(self, episode_steps: int) -> int:
        """Return the number of steps of each data center between two updates."""
        return self.rollout_decisions * self.decision_steps


class OnPolicySettings(ActingSettings):
    """Settings of ``ppo``, ``ippo``, ``mappo`` and ``happo``."""

    epochs: Annotated[int, Field(strict=True, ge=1, le=100)] = 4
    """Number of passes (epochs) over the collected steps in each update (not ``haa2c``)."""
    mini_batches: Annotated[int, Field(strict=True, ge=1, le=1024)] = 4
    """Number of mini-batches that the collected steps of an update are divided into (not
    ``haa2c``)."""
    rate: Annotated[float, Field(gt=0, le=1)] = 1e-3
    """Learning rate of Adam for policies and critics."""
    anneal: bool = True
    """True if the learning rate falls linearly to 0 during the training."""
    discount: Share = 0.97
    """Discount factor gamma per decision."""
    gae_lambda: Share = 0.95
    """Parameter lambda of generalised advantage estimation (Schulman et al. 2016)."""
    clip: Annotated[float, Field(gt=0, le=10)] = 0.2
    """Clipping range epsilon of the probability ratio (not ``haa2c``)."""
    entropy: Annotated[float, Field(ge=0, le=10)] = 0.001
    """Weight of the policies' entropy in the objective."""
    gradient_norm: Annotated[float, Field(gt=0)] = 0.5
    """Maximum norm of a network's gradient; larger gradients are scaled down."""
    hidden: Hidden = (64, 64)
    """Number of units in each hidden layer of policies and critics."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Activation function of all layers except the last."""
    critic: Literal["observation", "state"] | None = None
    """Input of critics: the observation of their learner, or the shared state; None selects the
    one in the publication of the algorithm."""


class OnePassSettings(OnPolicySettings):
    """Settings of ``haa2c``, which makes one gradient step in each update."""

    rollout_decisions: Annotated[int, Field(strict=True, ge=1, le=35_040)] = 8
    """Number of decisions of each data center between two updates; small, because each update makes
    only one gradient step."""


class OffPolicySettings(ActingSettings):
    """Settings of ``had3qn`` and ``hasac``."""

    least_updates: ClassVar[int] = 1

    levels: Annotated[int, Field(strict=True, ge=2, le=101)] | None = 5
    """Number of equally spaced levels from -1 to 1 that a continuous action is chosen from; the
    critic has a value for every combination of levels. None allows any number (``hasac`` only)."""
    rollout_decisions: Annotated[int, Field(strict=True, ge=1, le=35_040)] = 8
    """Number of decisions of each data center between two updates."""
    gradient_steps: Annotated[int, Field(strict=True, ge=1, le=100_000)] = 64
    """Number of gradient steps in each update; each uses a new batch."""
    batch_size: Annotated[int, Field(strict=True, ge=1, le=1_048_576)] = 1024
    """Number of transitions in a batch."""
    replay_size: Annotated[int, Field(strict=True, ge=1, le=100_000_000)] = 262_144
    """Capacity of the replay buffer: number of decisions, summed over all data centers. Each
    decision takes four bytes for every entry of the shared state and of the observations, which
    is 250 MB in total by default."""
    n_steps: Annotated[int, Field(strict=True, ge=1, le=1000)] = 1
    """Number n of decisions that an n-step transition spans. More than one decision values a choice
    by the later choices of older policies, such as random ones, which are not corrected for."""
    rate: Annotated[float, Field(gt=0, le=1)] = 1e-3
    """Learning rate of Adam for policies and critics."""
    anneal: bool = True
    """True if the learning rate falls linearly to 0 during the training."""
    discount: Share = 0.97
    """Discount factor gamma per decision."""
    target_rate: Share = 0.005
    """Update rate tau of the target critics in each gradient step (Polyak averaging)."""
    gradient_norm: Annotated[float, Field(gt=0)] = 10.0
    """Maximum norm of a network's gradient; larger gradients are scaled down."""
    hidden: Hidden = (64, 64)
    """Number of units in each hidden layer of policies and critics."""
    activation: Literal["tanh", "relu"] = "relu"
    """Activation function of all layers except the last."""
    exploration: Share = 0.05
    """Final probability epsilon of a random choice (``had3qn`` only)."""
    exploration_share: Share = 0.5
    """Share of the training during which the probability of a random choice falls from 1 to
    ``exploration`` (``had3qn`` only)."""
    temperature: Annotated[float, Field(gt=0, le=100)] = 0.01
    """Initial weight alpha of the entropy (``hasac`` only)."""
    temperature_rate: Annotated[float, Field(ge=0, le=1)] = 1e-3
    """Learning rate of Adam for temperatures; 0 keeps them constant (``hasac`` only)."""
    entropy_share: Share = 0.3
    """Target entropy of a discrete choice, divided by the maximum entropy, which is the logarithm
    of the number of options (``hasac`` only)."""
    continuous_entropy: float = -1.0
    """Target differential entropy of each continuous action, in nats; the maximum is log 2
    (``hasac`` only)."""


class CrossEntropySettings(LearningSettings):
    """Settings of ``cross-entropy``."""

    levels: Annotated[int, Field(strict=True, ge=2, le=101)] | None = None
    """Number of equally spaced levels from -1 to 1 that a continuous action is chosen from; the
    policy has a score for each level. None allows any number."""
    candidates: Annotated[int, Field(strict=True, ge=2, le=100_000)] = 64
    """Number of candidate policies drawn in each update; at most the number of data centers."""
    elite_share: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Share of the candidates, best first, that the distributions are fitted to."""
    first_std: Annotated[float, Field(gt=0, le=100)] = 0.5
    """Initial standard deviation of the policy parameters."""
    noise_std: Annotated[float, Field(ge=0, le=100)] = 0.1
    """Initial noise that is added to the standard deviations fitted to the best candidates; it
    falls linearly to 0 during the training."""
    memory_rate: Annotated[float, Field(gt=0, le=1)] = 0.3
    """Weight of the latest episode in the moving average of a data center's returns."""


class OnPolicyDefinition(NamedTuple):
    """Properties in which the on-policy algorithms differ."""

    critic: Literal["observation", "state"]
    """Input of critics: the observation of each learner, or the shared state."""
    reward: Reward
    """Reward that critics learn by default."""
    sequential: bool
    """True if learners are updated one after another in random order, with advantages weighted by
    the probability ratios of the learners that were updated before."""
    clips: bool
    """True if probability ratios are clipped and the collected steps are used in several passes."""


class OffPolicyDefinition(NamedTuple):
    """Properties in which the off-policy algorithms differ."""

    reward: Reward
    """Reward that critics learn by default."""
    critics: int
    """Number of critics; the minimum of their values is used."""
    soft: bool
    """True if actions are drawn from stochastic policies with an entropy bonus; False if the action
    with the highest value is taken, with random exploration (epsilon-greedy)."""


ON_POLICY: dict[str, OnPolicyDefinition] = {
    "ppo": OnPolicyDefinition(critic="observation", reward="team", sequential=False, clips=True),
    "ippo": OnPolicyDefinition(critic="observation", reward="own", sequential=False, clips=True),
    "mappo": OnPolicyDefinition(critic="state", reward="own", sequential=False, clips=True),
    "happo": OnPolicyDefinition(critic="state", reward="own", sequential=True, clips=True),
    "haa2c": OnPolicyDefinition(critic="state", reward="own", sequential=True, clips=False),
}
"""On-policy algorithms, which learn from the steps of their current policies, by name."""
OFF_POLICY: dict[str, OffPolicyDefinition] = {
    "had3qn": OffPolicyDefinition(reward="team", critics=1, soft=False),
    "hasac": OffPolicyDefinition(reward="team", critics=2, soft=True),
}
"""Off-policy algorithms, which learn from the steps in a replay buffer, by name."""
LEARNING_SETTINGS: dict[str, type[LearningSettings]] = {
    **dict.fromkeys(ON_POLICY, OnPolicySettings),
    "haa2c": OnePassSettings,
    **dict.fromkeys(OFF_POLICY, OffPolicySettings),
    "cross-entropy": CrossEntropySettings,
}
"""Class of the settings of each algorithm, by name."""


def own_share(reward: Reward | None, default: Reward, *, shared_policy: bool = False) -> float:
    """Return the share of the own reward in the reward that learners learn from, 0..1.

    Args:
        reward: setting ``reward``.
        default: default reward of the algorithm.
        shared_policy: True if agents that critics cannot distinguish share a policy.
    """
    if reward is None:
        reward = "team" if shared_policy else default
    if isinstance(reward, str):
        return 1.0 if reward == "own" else 0.0
    return reward


def gradient_steps(name: str, settings: LearningSettings, updates: int) -> int:
    """Return the number of gradient steps that each learner makes in a training.

    Args:
        name: name of the algorithm.
        settings: settings of the algorithm.
        updates: number of updates; the first one of on-policy algorithms only measures.
    """
    match settings:
        case OnPolicySettings():
            passes = settings.epochs * settings.mini_batches if ON_POLICY[name].clips else 1
            return max(updates - 1, 0) * passes
        case OffPolicySettings():
            return updates * settings.gradient_steps
    return 0


def uses_state(name: str, settings: LearningSettings) -> bool:
    """Return True if an algorithm's critics take the shared state of all agents as input."""
    if isinstance(settings, OnPolicySettings):
        return (settings.critic or ON_POLICY[name].critic) == "state"
    return isinstance(settings, OffPolicySettings)
