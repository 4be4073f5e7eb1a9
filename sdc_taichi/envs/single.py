"""One data center as a Gymnasium environment with one learner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from sdc_taichi.envs import rendering
from sdc_taichi.envs.arguments import ConfigSource, Overrides, single_core
from sdc_taichi.envs.base import (
    SingleEnv,
    as_floats,
    first_info,
    first_of_batch,
    start_day_option,
    step_info,
)
from sdc_taichi.envs.core import Observation
from sdc_taichi.envs.learners import learning_agent, make_learner
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.envs.recording import RecorderOption
from sdc_taichi.envs.spec import HasSpec
from sdc_taichi.sim.hall_solver import Precision


class SdcEnv(HasSpec, SingleEnv, gymnasium.Env[Any, Any]):
    """One data center with one learner.

    Episodes end by truncation: their length is a choice, the data center goes on. Infos:
    ``start_day`` and what was drawn after ``reset``, then every (B,) quantity of ``StepResult`` by
    name and the costs that the option ``costs`` names.

    Args:
        config: a preset, a file or a config.
        overrides: values put into the config: a dict of section.key to value, or a list of
            ``section.key=value``.
        options: options; None is the default ones.
        agent: agent that learns while ``others`` plays the rest; None is all ``agents`` as one.
        precision: precision of the server kernels, ``f32`` or ``f64``.
        render_mode: None or ``rgb_array``.
        registered_agent: set by the ids of one agent.
        recorder: records episodes: a file ending in .rrd, or what ``EpisodeRecorder`` says.
        keywords: fields of ``EnvOptions``, in place of those in ``options``.

    Raises:
        SdcError: a config or option that is not valid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  as the base class has it
        "render_modes": list(rendering.RENDER_MODES),
        "render_fps": 8,
    }

    def __init__(
        self,
        config: ConfigSource = "corrected",
        *,
        overrides: Overrides = (),
        options: EnvOptions | None = None,
        agent: str | None = None,
        precision: Precision = "f32",
        render_mode: str | None = None,
        registered_agent: str | None = None,
        recorder: RecorderOption = None,
        **keywords: Any,
    ) -> None:
        rendering.check_render_mode(render_mode)
        agent = learning_agent(agent, registered_agent)
        self.core = single_core(
            config, overrides, options, keywords, precision, recorder, only_agent=agent
        )
        self.render_mode = render_mode
        self._learner = make_learner(self.core, agent)
        self.observation_space = self._learner.observation_space
        self.action_space = self._learner.action_space
        self.state_space = self.core.state_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: decides everything random from here on; None goes on as before.
            options: ``start_day``, a day of the year as ``MM-DD`` or counted from 0.

        Raises:
            ConfigError: a seed, option or day that is not valid.
        """
        observations = self.core.reset(seed, start_day_option(options))
        super().reset(seed=None if seed is None else int(seed))
        observation = first_of_batch(self._learner.observation(observations))
        return observation, first_info(self.core)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance by one step.

        Raises:
            SdcError: an action outside its space.
            RuntimeStateError: before ``reset``, or after the end of the episode.
        """
        transition = self.core.step(self._learner.actions([action]))
        observation = first_of_batch(self._learner.observation(transition.observations))
        reward = float(self._learner.reward(transition)[0])
        info = as_floats(step_info(transition))
        return observation, reward, False, transition.ended, info

    def load_state_dict(self, values: Mapping[str, Any]) -> Observation:
        """Go on from the ``state_dict`` of an environment made alike.

        Returns:
            The observation before the next step.

        Raises:
            SdcError: made by another environment, or incomplete.
        """
        return first_of_batch(self._learner.observation(self.core.load_state_dict(values)))
