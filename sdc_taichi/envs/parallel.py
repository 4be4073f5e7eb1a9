"""One data center as a PettingZoo environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec

from sdc_taichi.envs import rendering
from sdc_taichi.envs.core import Observation, Source
from sdc_taichi.envs.options import make_options
from sdc_taichi.envs.recording import RecordedCore, Recording
from sdc_taichi.envs.standards import OneDataCenter, first, floats, start_day, start_days
from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.hall_solver import Precision


class SdcParallelEnv(OneDataCenter, ParallelEnv[str, Observation, Any]):  # type: ignore[misc]
    """A PettingZoo environment: the learning agents of one data center act at the same time.

    Episodes end by truncation: their length is a choice, the data center goes on. Infos are the
    same for all agents: ``start_day`` after ``reset``, then every (B,) quantity of ``StepResult``
    by name.

    Args:
        config: a preset, a file or a config.
        precision: of the server kernels, ``f32`` or ``f64``.
        render_mode: None or ``rgb_array``.
        recorder: records episodes: a file ending in .rrd, or what ``EpisodeRecorder`` says.
        options: fields of ``EnvOptions``.

    Raises:
        SdcError: a config or option that is not valid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  as the base class has it
        "name": "sdc_taichi_v0",
        "render_modes": list(rendering.RENDER_MODES),
        "render_fps": 8,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        config: Source = "corrected",
        *,
        precision: Precision = "f32",
        render_mode: str | None = None,
        recorder: Recording = None,
        **options: Any,
    ) -> None:
        rendering.check_render_mode(render_mode)
        self.core = core_of_one(config, precision, options, recorder)
        self.render_mode = render_mode
        self.possible_agents: list[str] = list(self.core.agents)
        self.agents: list[str] = []
        self.observation_spaces = self.core.observation_spaces
        self.action_spaces = self.core.action_spaces
        self.state_space = self.core.state_space

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode.

        Args:
            seed: decides everything random from here on; None goes on as before.
            options: ``start_day``, a day of the year as ``MM-DD`` or counted from 0.

        Raises:
            ConfigError: a seed or day that is not valid.
        """
        observations = self.core.reset(seed, start_day(options, strict=False))
        self.agents = list(self.possible_agents)
        info = {"start_day": int(start_days(self.core)[0])}
        return _first(observations), {agent: dict(info) for agent in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Advance by one step.

        Args:
            actions: one per learning agent.

        Raises:
            SdcError: actions that are missing, too many, or outside their space.
            RuntimeStateError: before ``reset``, or after the end of the episode.
        """
        if isinstance(actions, Mapping):
            actions = {agent: [action] for agent, action in actions.items()}
        done = self.core.step(actions)
        agents, info = self.agents, floats(done.result.per_dc())
        if done.ended:
            self.agents = []
        return (
            _first(done.observations),
            floats(done.rewards),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, done.ended),
            {agent: dict(info) for agent in agents},
        )

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The space of an agent's observations.

        Raises:
            ConfigError: an agent that does not learn here.
        """
        return self._of(agent, self.observation_spaces)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """The space of an agent's actions.

        Raises:
            ConfigError: an agent that does not learn here.
        """
        return self._of(agent, self.action_spaces)

    def _of(self, agent: str, found: Mapping[str, spaces.Space[Any]]) -> spaces.Space[Any]:
        if agent not in found:
            raise ConfigError(f"agent {agent!r}: does not learn here; valid: {list(found)}")
        return found[agent]

    def load_state_dict(self, values: Mapping[str, Any]) -> dict[str, Observation]:
        """Go on from the ``state_dict`` of an environment made alike.

        Returns:
            Observations before the next step.

        Raises:
            SdcError: made by another environment, or incomplete.
        """
        observations = self.core.load_state_dict(values)
        self.agents = [] if self.core.over else list(self.possible_agents)
        return _first(observations)


parallel_env = SdcParallelEnv


def aec_env(config: Source = "corrected", **options: Any) -> AECEnv[str, Observation, Any]:
    """A PettingZoo environment whose agents act in turn, by PettingZoo's own conversion.

    Args:
        config: a preset, a file or a config.
        options: as ``parallel_env`` takes them.

    Raises:
        SdcError: a config or option that is not valid.
    """
    return parallel_to_aec(parallel_env(config, **options))


def core_of_one(
    config: Source, precision: Precision, options: Mapping[str, Any], recorder: Recording
) -> RecordedCore:
    """The core of a single environment.

    Raises:
        SdcError: several configs, or an option or recorder that is not valid.
    """
    core = RecordedCore(config, make_options(**options), precision=precision, recorder=recorder)
    if core.num_envs != 1:
        raise ConfigError(f"config: {core.num_envs} data centers; valid is one, or vector_env")
    return core


def _first(observations: Mapping[str, Observation]) -> dict[str, Observation]:
    return {agent: first(found) for agent, found in observations.items()}
