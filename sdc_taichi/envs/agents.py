"""The three agents of a data center: their commands, and default features and reward scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from sdc_taichi.control.rules import COMMANDS_OF_PART

Agent = Literal["agent_ls", "agent_dc", "agent_bat"]
"""Name of an agent in the released SustainDC: load shifting, cooling, battery."""
AGENTS: tuple[str, ...] = get_args(Agent)
"""All agents, in the order of their actions and observations in joint environments."""


@dataclass(frozen=True, slots=True)
class AgentDefinition:
    """Commands, default features and reward scales of an agent."""

    command: str
    """Field of ``Actions`` that the agent sets by default, and the part of a controller spec
    that stands for it."""
    features: tuple[str, ...]
    """Features that the agent observes by default."""
    scales: dict[str, dict[str, float]]
    """Scales of its reward terms, by reward set and term."""

    @property
    def commands(self) -> tuple[str, ...]:
        """Fields of ``Actions`` that the agent can set, the default one first."""
        return COMMANDS_OF_PART[self.command]


_CLOCK = ("time_of_day", "time_of_year")
_CI = ("ci", "ci_forecast")
_OUTDOOR = ("outdoor", "outdoor_forecast")
_WEATHER = (*_OUTDOOR, "wet_bulb", "wet_bulb_forecast")
_QUEUE = ("queue", "oldest_age", "mean_age", "age_histogram")
_AIR = ("room", "hottest_inlet", "setpoint")

AGENT_DEFINITIONS: dict[str, AgentDefinition] = {
    "agent_ls": AgentDefinition(
        command="load",
        features=(*_CLOCK, "workload", *_QUEUE, *_CI, "ci_change", *_OUTDOOR, "soc"),
        scales={
            "default": {"work_carbon": 10.0, "cooling_carbon": 10.0, "sla": 20.0},
            "bill": {"work_cost": 10.0, "cooling_cost": 10.0, "high_power": 10.0, "sla": 60.0},
            "paper": {"carbon": 1.0, "queue": 1.0, "dropped": 10.0},
        },
    ),
    "agent_dc": AgentDefinition(
        command="cooling",
        features=(*_CLOCK, "workload", *_CI, *_WEATHER, *_AIR, "it_energy", "hvac_energy"),
        scales={
            "default": {"cooling_carbon": 10.0, "hot_inlets": 0.1},
            "bill": {"cooling_cost": 10.0, "high_power": 10.0, "hot_inlets": 0.3},
            "paper": {"facility_energy": 1.0},
        },
    ),
    "agent_bat": AgentDefinition(
        command="battery",
        features=(*_CLOCK, *_CI, "ci_change", "dc_load", "soc"),
        scales={
            "default": {"battery_carbon": 10.0},
            "bill": {"battery_cost": 10.0, "high_power": 10.0},
            "paper": {"carbon": 1.0},
        },
    ),
}
"""Definitions of all agents by name.

Default features are the paper's lists (A.1.2, A.2.4, A.3.3) with ages of the queue and weather for
the load agent, the coming work for the cooling agent, and the change of the carbon intensity.

Reward set ``default`` charges each agent for the part of the carbon that it can change, ``bill``
does the same with prices and high power. ``paper`` is r_LS, r_DC and r_BAT of the paper (4.5, F.2),
with carbon and energies divided by those of the design point.
"""


def commands_by_others(
    agents: Sequence[str], decided: Sequence[str], offered: Sequence[str]
) -> list[str]:
    """Commands that a controller gives for the agents that do not learn.

    Args:
        agents: agents that learn.
        decided: commands that the learning agents decide.
        offered: commands that the controller gives.
    """
    settable = dict.fromkeys(
        command
        for agent, definition in AGENT_DEFINITIONS.items()
        if agent not in agents
        for command in definition.commands
    )
    return [command for command in settable if command in offered and command not in decided]
