"""The three agents of a data center, and the commands of the simulator that each can give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

from sdc_taichi.control.rules import COMMANDS_OF_PART

Agent = Literal["agent_ls", "agent_dc", "agent_bat"]
"""Name of an agent as the released SustainDC has it: load shifting, cooling, battery."""
AGENTS: tuple[str, ...] = get_args(Agent)
"""All agents, in the order in which their actions and observations stand side by side."""
COMMAND_OF_AGENT = {"agent_ls": "load", "agent_dc": "cooling", "agent_bat": "battery"}
"""Field of ``Actions`` that each agent sets by default."""
COMMANDS_OF_AGENT: dict[str, tuple[str, ...]] = {
    agent: COMMANDS_OF_PART[part] for agent, part in COMMAND_OF_AGENT.items()
}
"""Fields of ``Actions`` that each agent can set."""


def commands_by_others(
    agents: Sequence[str], decided: Sequence[str], given: Sequence[str]
) -> list[str]:
    """Commands that a controller gives for the agents that do not learn.

    Args:
        agents: agents that learn.
        decided: commands that they decide.
        given: commands that the controller gives.
    """
    of_others = (c for a, names in COMMANDS_OF_AGENT.items() if a not in agents for c in names)
    return [name for name in dict.fromkeys(of_others) if name in given and name not in decided]
