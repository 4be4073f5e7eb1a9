"""Rewards by the names of the released SustainDC code, and functions of its ``params``.

The formulas are those of ``utils/reward_creator.py`` (github.com/HewlettPackard/dc-rl, main at
a92b475), except for the three defaults: these are the rewards of the paper, which
``envs.released.ReleasedRewards`` computes. The default rewards of that commit scale energy by the
mean and deviation of all steps that a process has simulated, so equal steps have different rewards.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sdc_taichi.control.view import View
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.released import ReleasedRewards
from sdc_taichi.envs.rewards import collaborative_rewards
from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.types import F64, StepResult
from sdc_taichi.user_functions import checked_values, function_named

RewardFunction = Callable[[dict[str, Any]], float]
"""Function from the infos of a step, ``params``, to the reward of an agent."""
PRICES = (*[0.25] * 6, *[0.41] * 5, *[0.30] * 5, *[0.27] * 6, *[0.25] * 2)
"""Price of electricity in each hour of the day, for ``tou_reward``."""


def tou_reward(params: Mapping[str, Any]) -> float:
    """Return the negative cost of the grid energy at a time-of-use tariff, ``PRICES``.

    The released function has prices for whole hours alone, and fails in all other steps.
    """
    return float(-params["bat_total_energy_with_battery_KWh"] * PRICES[int(params["hour"])])


def energy_efficiency_reward(params: Mapping[str, Any]) -> float:
    """Return the ratio of IT power to the power of the facility."""
    return float(params["dc_ITE_total_power_kW"] / params["dc_total_power_kW"])


def energy_pue_reward(params: Mapping[str, Any]) -> float:
    """Return the negative distance of the power usage effectiveness (PUE) from 1."""
    return -abs(float(params["dc_total_power_kW"] / params["dc_ITE_total_power_kW"]) - 1.0)


def water_usage_efficiency_reward(params: Mapping[str, Any]) -> float:
    """Return -0.01 per liter of water."""
    return float(-0.01 * params["dc_water_usage"])


def custom_agent_reward(params: Mapping[str, Any]) -> float:
    """Return 0, as the template of a reward does in the released code."""
    return 0.0


DEFAULTS = {
    "default_ls_reward": "agent_ls",
    "default_dc_reward": "agent_dc",
    "default_bat_reward": "agent_bat",
}
"""Names of the rewards of the paper, with the agent whose individual reward each is."""
FUNCTIONS: dict[str, RewardFunction] = {
    "custom_agent_reward": custom_agent_reward,
    "tou_reward": tou_reward,
    "energy_efficiency_reward": energy_efficiency_reward,
    "energy_PUE_reward": energy_pue_reward,
    "water_usage_efficiency_reward": water_usage_efficiency_reward,
}
"""Further rewards of the released code by name. Two of its rewards are missing, because they read
values that its own ``params`` do not contain: ``renewable_energy_reward`` and
``temperature_efficiency_reward``."""


class Rewards:
    """Computes the rewards of the agents in each step.

    Args:
        methods: name, import path or function of the reward of each agent, by key, such as
            ``ls_reward``, in the order of ``AGENTS``.
        weight: weight of an agent's individual reward in its reward, 0..1; each of the two other
            individual rewards has the weight (1 - ``weight``)/2.

    Raises:
        ConfigError: a reward is unknown.
    """

    def __init__(self, methods: Mapping[str, Any], weight: float) -> None:
        self._weight = weight
        self._methods: list[tuple[str, str | RewardFunction]] = [
            (key, _checked(key, method)) for key, method in methods.items()
        ]
        by_paper = any(isinstance(method, str) for _, method in self._methods)
        self._of_paper = ReleasedRewards() if by_paper else None

    def reset(self, view: View) -> None:
        """Start an episode.

        Raises:
            DataError: the carbon intensity is constant, so it cannot scale a reward of the paper.
        """
        if self._of_paper is not None:
            self._of_paper.reset(view)

    def rewards(self, result: StepResult, view: View, params: dict[str, Any]) -> dict[str, F64]:
        """Return the reward of each agent in a step, (1,) each.

        Args:
            result: result of the step.
            view: the view after the step.
            params: infos of the step, which reward functions read.

        Raises:
            SdcError: a function returned no finite number.
        """
        of_paper = {} if self._of_paper is None else self._of_paper.rewards(result, view)
        individual = [
            of_paper[method]
            if isinstance(method, str)
            else checked_values(key, method(params), agent, 1)
            for agent, (key, method) in zip(AGENTS, self._methods, strict=True)
        ]
        shared = collaborative_rewards(individual, self._weight)
        return dict(zip(AGENTS, shared, strict=True))


def _checked(key: str, method: Any) -> str | RewardFunction:
    """Return the agent with a reward of the paper, or the function of another reward."""
    if callable(method):
        function: RewardFunction = method
        return function
    if not isinstance(method, str):
        raise ConfigError(f"{key} {shortened(method)}: valid is a name, a function or its path")
    if method in DEFAULTS:
        return DEFAULTS[method]
    named: RewardFunction = function_named(
        key, method, FUNCTIONS, valid=", ".join([*DEFAULTS, *FUNCTIONS])
    )
    return named
