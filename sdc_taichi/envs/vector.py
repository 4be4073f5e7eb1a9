"""Vectorised environments: a batch of data centers in one object."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space, iterate

from sdc_taichi.envs.base import (
    METADATA,
    AgentSpaces,
    BatchEnv,
    HasSpec,
    check_steps,
    start_day_option,
)
from sdc_taichi.envs.core import Core, Observation
from sdc_taichi.envs.episodes import Seed
from sdc_taichi.envs.features import Feature
from sdc_taichi.envs.options import ConfigSource
from sdc_taichi.envs.recording import EpisodeRecorder
from sdc_taichi.envs.single import learning_agent, make_learner
from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F32, F64, Actions

if TYPE_CHECKING:
    from sdc_taichi.viz.recorder import Recorder

    _VectorWrapper: TypeAlias = VectorWrapper[Any, Any, Any]
else:
    _VectorWrapper = VectorWrapper  # Type parameters work at run time only from Gymnasium 1.4 on.

Flags = npt.NDArray[np.bool_]


class SdcVectorEnv(HasSpec, BatchEnv, VectorEnv[Any, Any, npt.NDArray[Any]]):
    """Batch of data centers with one learner each, as created by ``gymnasium.make_vec``.

    Results equal those of Gymnasium's ``SyncVectorEnv`` of single environments. All episodes have
    the same length and end, by truncation, in the same step. Only a result beyond the physical
    limits terminates an episode earlier; the next one of this environment then ends with those of
    the batch. By default the next step starts new
    episodes: it ignores its actions and returns the first observations, rewards of 0 and the infos
    of ``reset``.

    Args:
        num_envs: number of environments.
        config: a preset, a file, or configs; environment i uses config i modulo their number.
        agent: the only learning agent; the controller ``others`` commands the rest. With None one
            learner controls all ``agents``.
        registered_agent: agent of the Gymnasium id, if the id has a single agent.
        autoreset_mode: start of the next episodes, as Gymnasium's enum or its value. ``NextStep``
            means the step after the last step of an episode, ``SameStep`` the last step itself, and
            ``Disabled`` only a call of ``reset``.
        max_episode_steps: shorter length of episodes, in steps, as in Gymnasium's ``TimeLimit``;
            None and -1 mean no such limit.
        arguments: ``overrides``, ``options``, ``precision``, ``render_mode``, ``recorder`` and
            fields of ``EnvOptions``; see docs/environments.md.

    Raises:
        SdcError: a config, number or option is not valid.
    """

    closed = True
    """True if the environment is closed, or if its constructor has not finished.

    Gymnasium closes every environment on deletion, even one whose constructor failed.
    """

    def __init__(
        self,
        num_envs: int = 1,
        config: ConfigSource = "corrected",
        *,
        agent: str | None = None,
        registered_agent: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **arguments: Any,
    ) -> None:
        self._mode = _autoreset_mode(autoreset_mode)
        agent = learning_agent(agent, registered_agent)
        self._open(config, num_envs, agent, **arguments)
        self.core.end_after(check_steps(max_episode_steps, self.core))
        self.num_envs = num_envs = self.core.num_envs
        self.metadata = METADATA | {"autoreset_mode": self._mode}
        self.autoreset_mode = self._mode  # an attribute of Gymnasium's own batches as well
        self._learner = make_learner(self.core, agent)
        self.single_observation_space = self._learner.observation_space
        self.single_action_space = self._learner.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._everyone = np.ones(num_envs, dtype=np.bool_)
        self._everyone.flags.writeable = False
        self.closed = False

    def reset(
        self, *, seed: Seed = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in all environments.

        Args:
            seed: environment i uses ``seed + i``, or entry i of a sequence; None continues the
                random generators.
            options: dict with ``start_day``, a day as ``MM-DD`` or as number of the day in the
                year, from 0, or one day for each environment. Gymnasium's ``reset_mask`` is valid
                if it selects all environments.

        Raises:
            ConfigError: a seed, option or day is not valid.
        """
        reset_options: Any = dict(options) if isinstance(options, Mapping) else options
        mask = reset_options.pop("reset_mask", None) if isinstance(reset_options, dict) else None
        if mask is not None and not (np.shape(mask) == (self.num_envs,) and np.all(mask)):
            raise ConfigError(
                "reset_mask: episodes of a batch start and end together; valid selects all "
                f"{self.num_envs} environments"
            )
        observations = self.core.reset(seed, start_day_option(reset_options))
        super().reset(seed=int(seed) if isinstance(seed, int | np.integer) else None)
        return self._learner.observation(observations), self._infos(self.core.infos())

    def step(self, actions: Any) -> tuple[Observation, F64, Flags, Flags, dict[str, Any]]:
        """Advance all environments by one step.

        Args:
            actions: an element of ``action_space``.

        Raises:
            SdcError: the actions are outside their space.
            RuntimeStateError: the environment has not been reset, or its episodes are over in mode
                ``Disabled``.
        """
        starting = None
        if self._mode is AutoresetMode.NEXT_STEP:
            if self.core.episode_over:
                observation, infos = self.reset()
                none = np.zeros(self.num_envs, dtype=np.bool_)
                return observation, np.zeros(self.num_envs), none, none.copy(), infos
            starting = self.core.restart_ended()
        transition = self.core.step(self._learner.actions(actions), starting)
        observation = self._learner.observation(transition.observations)
        infos = self._infos(self.core.infos(transition))
        if transition.ended and self._mode is AutoresetMode.SAME_STEP:
            final = {"final_obs": self._one_by_one(observation), "final_info": infos}
            observation = self._learner.observation(self.core.next_episode())
            infos = self._infos({**final, **self.core.infos()})
        elif self._mode is AutoresetMode.SAME_STEP and self.core.ended_early.any():
            last = self._one_by_one(observation)
            begun = self.core.restart_ended()
            last[~begun] = None
            infos = self._infos(_begun_again(self.core.infos(transition), self.core, begun)) | {
                "final_obs": last,
                "_final_obs": begun,
                "final_info": infos,
                "_final_info": begun,
            }
            observation = self._learner.observation(self.core.observe())
        reward = self._learner.reward(transition)
        return observation, reward, transition.terminated, transition.truncated, infos

    @property
    def features(self) -> tuple[Feature, ...]:
        """Features of an observation, in the order of its entries."""
        return self._learner.features

    def actions_of(self, commands: Actions) -> npt.NDArray[Any]:
        """Return the element of ``action_space`` that is nearest to commands.

        Args:
            commands: commands of one step, such as those of a controller for ``core.view``.
        """
        return self._learner.joined(self.core.actions_of(commands))

    def _infos(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Add Gymnasium's masks to infos; the masks are true for all environments."""
        return {**values, **{f"_{name}": self._everyone for name in values}}

    def _one_by_one(self, observation: Observation) -> npt.NDArray[np.object_]:
        """Return observations as an array of objects, the form of Gymnasium's ``final_obs``."""
        out = np.empty(self.num_envs, dtype=object)
        for i, one in enumerate(iterate(self.observation_space, observation)):
            out[i] = one
        return out

    def load_state_dict(self, values: Mapping[str, Any]) -> Observation:
        """Continue from the ``state_dict`` of a batch with the same arguments.

        Returns:
            Observations before the next step.

        Raises:
            SdcError: the state belongs to another batch, or is incomplete.
        """
        return self._learner.observation(self.core.load_state_dict(values))

    def close(self, **_: Any) -> None:
        """Close the simulator; the environment cannot be used afterwards."""
        if not self.closed:
            super().close()
            self.closed = True


class RecordEpisodes(_VectorWrapper):
    """Gymnasium wrapper that records a vector environment of this package.

    ``RecordEpisodes(env, target, ...)`` has the same effect as ``make_vec`` with the argument
    ``recorder=EpisodeRecorder(target, ...)``. Closing the environment ends the recording.

    Args:
        env: a batch from ``gymnasium.make_vec("sdc_taichi/...")``, wrapped or not.
        target: destination of the recordings; see ``EpisodeRecorder.target``.
        episode_trigger: choice of episodes; see ``EpisodeRecorder.episode_trigger``.
        envs: choice of environments; see ``EpisodeRecorder.envs``.
        every: number of steps between two heat maps, and between two frames of the 3D hall.

    Raises:
        SdcError: ``env`` is another kind of environment, or an argument is not valid.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        target: str | os.PathLike[str] | Recorder,
        *,
        episode_trigger: Callable[[int], bool] | None = None,
        envs: Sequence[int] | None = None,
        every: int | None = None,
    ) -> None:
        core = getattr(getattr(env, "unwrapped", None), "core", None)
        if not (isinstance(env, VectorEnv) and isinstance(core, Core)):
            raise ConfigError(
                f"env: {type(getattr(env, 'unwrapped', env)).__name__} cannot be recorded here; "
                "valid is a batch of gymnasium.make_vec('sdc_taichi/...') that is one environment "
                "of its own; others take recorder=... when they are made"
            )
        super().__init__(env)
        core.record_episodes(EpisodeRecorder(target, episode_trigger, envs, every))


class MultiAgentVectorEnv(BatchEnv, AgentSpaces):
    """Batch of data centers with several learning agents each.

    All episodes have the same length and end, by truncation, in the same step. Only a result beyond
    the physical limits terminates an episode earlier, for all agents of that environment; its next
    episode then ends with those of the batch. By default the next step starts new episodes: it
    ignores its actions and returns the first observations and rewards of 0.

    Args:
        num_envs: number of environments; None creates one per config.
        config: a preset, a file, or configs; environment i uses config i modulo their number.
        autoreset_mode: start of the next episodes, as Gymnasium's enum or its value. ``NextStep``
            means the step after the last step of an episode, ``SameStep`` the last step itself, and
            ``Disabled`` only a call of ``reset``.
        arguments: ``overrides``, ``options``, ``precision``, ``render_mode``, ``recorder`` and
            fields of ``EnvOptions``; see docs/environments.md.

    Attributes:
        num_envs: number of environments, B.
        possible_agents: names of the learning agents. ``agents`` is always the same list, because
            no agent leaves an episode before the others.
        observation_spaces: observation space of one environment, by agent.
        action_spaces: action space of one environment, by agent.
        state_space: space of the shared state of one environment.
        metadata: name, render modes, and ``autoreset_mode`` as Gymnasium's enum.

    Raises:
        SdcError: a config, number or option is not valid.
    """

    def __init__(
        self,
        num_envs: int | None = None,
        config: ConfigSource = "corrected",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ) -> None:
        self._mode = _autoreset_mode(autoreset_mode)
        self._open(config, num_envs, **arguments)
        self.metadata = {"name": "sdc_taichi_v0", **METADATA, "autoreset_mode": self._mode}
        self.num_envs = self.core.num_envs
        self.possible_agents: list[str] = list(self.core.agents)
        self.agents: list[str] = list(self.core.agents)
        self.observation_spaces = self.core.observation_spaces
        self.action_spaces = self.core.action_spaces

    @property
    def num_agents(self) -> int:
        """Number of the learning agents."""
        return len(self.agents)

    @property
    def max_num_agents(self) -> int:
        """Number of possible agents, all of which learn."""
        return len(self.possible_agents)

    @property
    def unwrapped(self) -> Self:
        """The environment itself."""
        return self

    def reset(
        self, seed: Seed = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, Any]]:
        """Start an episode in all environments.

        Args:
            seed: environment i uses ``seed + i``, or entry i of a sequence; None continues the
                random generators.
            options: dict with ``start_day``, a day as ``MM-DD`` or as number of the day in the
                year, from 0, or one day for each environment.

        Returns:
            Observations by agent, (B, n) each, and infos, (B,) each, with the keys of the infos of
            a step. Quantities and costs are 0.

        Raises:
            ConfigError: a seed, option or day is not valid.
        """
        observations = self.core.reset(seed, start_day_option(options))
        return observations, self.core.infos()

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[
        dict[str, Observation], dict[str, F32], dict[str, Flags], dict[str, Flags], dict[str, Any]
    ]:
        """Advance all environments by one step, or start their next episodes.

        In mode ``SameStep`` the last step of the episodes also starts the next ones. It returns the
        first observations of these, and adds ``final_obs`` (by agent), ``final_state`` and the new
        ``start_day`` to the infos. In mode ``NextStep`` the step after the last one ignores its
        actions. It returns observations and infos of ``reset``, and rewards of 0.

        Args:
            actions: actions by learning agent. Discrete actions are integers, (B,), or (B, k) if
                the agent decides k values; continuous actions are floats, (B, k).

        Returns:
            Observations, rewards, terminations and truncations by agent, and infos. Infos contain
            ``start_day``, the randomly drawn inputs, the (B,) quantities of the step's
            ``StepResult`` and the costs, by name.

        Raises:
            SdcError: the actions of an agent are missing or outside their space, or there are
                actions of an agent that does not learn.
            RuntimeStateError: the environment has not been reset, or its episodes are over in mode
                ``Disabled``.
        """
        starting = None
        if self._mode is AutoresetMode.NEXT_STEP:
            if self.core.episode_over:
                first, begun = self.reset()
                none = np.zeros(self.num_envs, dtype=np.bool_)
                return (
                    first,
                    self._no_rewards(),
                    self._flags(none),
                    self._flags(none),
                    begun,
                )
            starting = self.core.restart_ended()
        transition = self.core.step(actions, starting)
        observations = transition.observations
        infos: dict[str, Any] = self.core.infos(transition)
        if transition.ended and self._mode is AutoresetMode.SAME_STEP:
            infos["final_obs"], infos["final_state"] = observations, self.core.state()
            observations = self.core.next_episode()
            infos |= self.core.start_info()
        elif self._mode is AutoresetMode.SAME_STEP and self.core.ended_early.any():
            infos["final_obs"], infos["final_state"] = observations, self.core.state()
            self.core.restart_ended()
            observations = self.core.observe()
        return (
            observations,
            {agent: reward.astype(np.float32) for agent, reward in transition.rewards.items()},
            self._flags(transition.terminated),
            self._flags(transition.truncated),
            infos,
        )

    def _no_rewards(self) -> dict[str, F32]:
        """Return rewards of 0 by group, (E,) each, or (E, W) for a group with W agents."""
        shapes = {
            group: (self.num_envs,) if names == (group,) else (self.num_envs, len(names))
            for group, names in self.core.members.items()
        }
        return {group: np.zeros(shape, dtype=np.float32) for group, shape in shapes.items()}

    def _flags(self, of_envs: Flags) -> dict[str, Flags]:
        """Return a copy of the flags of all environments, (B,), by agent."""
        return {agent: of_envs.copy() for agent in self.agents}

    def load_state_dict(self, values: Mapping[str, Any]) -> dict[str, Observation]:
        """Continue from the ``state_dict`` of a batch with the same arguments.

        Returns:
            Observations before the next step.

        Raises:
            SdcError: the state belongs to another batch, or is incomplete.
        """
        return self.core.load_state_dict(values)


vector_env = MultiAgentVectorEnv


def _begun_again(values: Mapping[str, Any], core: Core, begun: Flags) -> dict[str, Any]:
    """Replace infos of a step by those of a reset for environments that have begun again."""
    first = core.infos()
    return {name: np.where(begun, first[name], value) for name, value in values.items()}


def _autoreset_mode(mode_name: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode_name)
    except ValueError:
        valid = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ConfigError(f"autoreset_mode {mode_name!r}: valid is {valid}") from None
