"""The three agents of a data center, and the command of the simulator that each gives."""

from __future__ import annotations

from typing import Literal, get_args

Agent = Literal["agent_ls", "agent_dc", "agent_bat"]
"""Name of an agent as the released SustainDC has it: load shifting, cooling, battery."""
AGENTS: tuple[str, ...] = get_args(Agent)
"""All agents, in the order in which their actions and observations stand side by side."""
COMMAND_OF_AGENT = {"agent_ls": "load", "agent_dc": "cooling", "agent_bat": "battery"}
"""Field of ``Actions`` that each agent sets."""
