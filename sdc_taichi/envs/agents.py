"""The three agents of a data center, and the commands of the simulator that each can give."""

from __future__ import annotations

from typing import Literal, get_args

Agent = Literal["agent_ls", "agent_dc", "agent_bat"]
"""Name of an agent as the released SustainDC has it: load shifting, cooling, battery."""
AGENTS: tuple[str, ...] = get_args(Agent)
"""All agents, in the order in which their actions and observations stand side by side."""
COMMAND_OF_AGENT = {"agent_ls": "load", "agent_dc": "cooling", "agent_bat": "battery"}
"""Field of ``Actions`` that each agent sets by default."""
COMMANDS_OF_AGENT: dict[str, tuple[str, ...]] = {
    "agent_ls": ("load", "placement"),
    "agent_dc": ("cooling", "fan", "placement"),
    "agent_bat": ("battery",),
}
"""Fields of ``Actions`` that each agent can set."""
