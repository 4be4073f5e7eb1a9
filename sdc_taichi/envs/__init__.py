"""Environments for reinforcement learning: PettingZoo, Gymnasium and batches around one core.

This package defines observations, rewards, action spaces and recordings of episodes. It contains
no physics: an environment only translates between a learner and the simulator.
"""

from __future__ import annotations

from types import ModuleType

IDS: dict[str, str | None] = {
    "sdc_taichi/Joint-v0": None,
    "sdc_taichi/Load-v0": "agent_ls",
    "sdc_taichi/Cooling-v0": "agent_dc",
    "sdc_taichi/Battery-v0": "agent_bat",
}
"""Gymnasium ids of the environments, each with its only learning agent. None stands for one
learner that controls all ``agents``."""


def register(gymnasium: ModuleType) -> None:
    """Register the Gymnasium ids of ``IDS`` that are not registered yet.

    ``gymnasium.make`` imports the environments. The length of an episode depends on the arguments,
    so each environment sets ``max_episode_steps`` in its own spec (``sdc_taichi.envs.base``).
    """
    for name, agent in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="sdc_taichi.envs.single:SdcEnv",
                vector_entry_point="sdc_taichi.envs.vector:SdcVectorEnv",
                kwargs={} if agent is None else {"registered_agent": agent},
            )
