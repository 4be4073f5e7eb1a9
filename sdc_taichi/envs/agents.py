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

NOT_LEARNED = {"chilled_water"}
"""Fields of ``Actions`` that controllers can set, but no agent: their limits depend on the step."""


@dataclass(frozen=True, slots=True)
class AgentDefinition:
    """Commands, default features and reward scales of an agent."""

    command: str
    """Field of ``Actions`` that the agent sets by default. It also names the agent's part in
    controller specifications such as ``load=name,cooling=name``."""
    features: tuple[str, ...]
    """Names of the features that the agent observes by default, in order."""
    scales: dict[str, dict[str, float]]
    """Factors of the agent's reward terms, by reward set and term."""

    @property
    def commands(self) -> tuple[str, ...]:
        """Names of all fields of ``Actions`` that the agent can set, the default field first."""
        return tuple(name for name in self.controlled if name not in NOT_LEARNED)

    @property
    def controlled(self) -> tuple[str, ...]:
        """Names of all fields of ``Actions`` that a controller in place of the agent can set."""
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

The default features are the lists of the paper (A.1.2, A.2.4, A.3.3) with three additions: queue
ages and weather for the load agent, arriving work for the cooling agent, and the change of the
carbon intensity for the load and battery agents.

Reward set ``default`` charges each agent for the part of the carbon emissions that it can change.
Reward set ``bill`` uses prices instead of carbon intensity and adds a charge for high power. Reward
set ``paper`` contains r_LS, r_DC and r_BAT of the paper (4.5, F.2), with carbon and energies
divided by their values at the design point.
"""


def commands_by_others(
    agents: Sequence[str], decided: Sequence[str], offered: Sequence[str]
) -> list[str]:
    """Return the names of the commands that a controller sets for the agents that do not learn.

    Args:
        agents: names of the agents that learn.
        decided: names of the commands that the learning agents decide.
        offered: names of all commands that the controller can set.
    """
    settable = dict.fromkeys(
        command
        for agent, definition in AGENT_DEFINITIONS.items()
        if agent not in agents
        for command in definition.controlled
    )
    return [command for command in settable if command in offered and command not in decided]
