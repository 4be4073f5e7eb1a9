"""Environments for reinforcement learning: PettingZoo, Gymnasium and batches around one core.

Observations, rewards, action spaces and recordings of episodes live here.
Physics never does: an environment only translates between a learner and the simulator.
"""

from __future__ import annotations

from types import ModuleType

IDS: dict[str, str | None] = {
    "sdc_taichi/Joint-v0": None,
    "sdc_taichi/Load-v0": "agent_ls",
    "sdc_taichi/Cooling-v0": "agent_dc",
    "sdc_taichi/Battery-v0": "agent_bat",
}
"""Gymnasium ids of the environments, and the one agent that learns in each; None is all ``agents``
as one."""


def register(gymnasium: ModuleType) -> None:
    """Register the ids that are not registered yet; the environments are imported by ``make``.

    The length of an episode depends on the arguments: ``max_episode_steps`` is in the spec of each
    environment (``sdc_taichi.envs.base``).

    Args:
        gymnasium: the package Gymnasium.
    """
    for name, agent in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="sdc_taichi.envs.single:SdcEnv",
                vector_entry_point="sdc_taichi.envs.vector:SdcVectorEnv",
                kwargs={} if agent is None else {"registered_agent": agent},
            )
