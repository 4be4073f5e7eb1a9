"""Groups of agents: their commands, and default features and reward scales.

The agents of a group have the same spaces, and by default one policy. A group has one agent for
each data center, which has the name of the group, or one for each CRAC unit (``crac_0``,
``crac_1`` and so on) or coolant distribution unit (``cdu_0`` and so on).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from sdc_taichi.types import CDUS, CRAC_UNITS, DATA_CENTERS

Agent = Literal[
    "agent_ls", "agent_dc", "agent_bat", "agent_geo", "crac", "plant", "cdu", "power_cap"
]
"""Name of a group of agents. The first three are the agents of the released SustainDC: load
shifting, cooling, battery."""
AGENTS: tuple[str, ...] = get_args(Agent)[:3]
"""Groups that learn by default, in the order of their actions and observations."""
HALL_AGENTS: tuple[str, ...] = ("crac", "plant")
"""Groups that control the cooling of a hall in place of ``agent_dc``."""
LIQUID_AGENTS: tuple[str, ...] = ("cdu", "power_cap")
"""Groups that control liquid-cooled racks beside those that control the air."""


@dataclass(frozen=True, slots=True)
class AgentDefinition:
    """Commands, default features and reward scales of a group of agents."""

    part: str
    """Part of controller specifications such as ``load=name,cooling=name`` that can replace the
    agents."""
    commands: tuple[str, ...]
    """Names of all fields of ``Actions`` that the agents can set, the default field first."""
    features: tuple[str, ...]
    """Names of the features that an agent observes by default, in order."""
    scales: dict[str, dict[str, float]]
    """Factors of an agent's reward terms, by reward set and term."""
    axis: str = DATA_CENTERS
    """Kind of element for which the group has an agent each: data centers, CRAC units or CDUs."""
    decided: int = 1
    """Number of commands that an agent sets by default, the first ones."""
    also_controlled: tuple[str, ...] = ()
    """Fields of ``Actions`` that no agent of the group sets, but a controller in its place."""

    @property
    def per_unit(self) -> bool:
        """True if the group has an agent for each unit of a kind, False for one per data center."""
        return self.axis != DATA_CENTERS

    @property
    def command(self) -> str:
        """First field of ``Actions`` that an agent sets by default."""
        return self.commands[0]

    @property
    def default_commands(self) -> tuple[str, ...]:
        """Names of all fields of ``Actions`` that an agent sets by default."""
        return self.commands[: self.decided]

    @property
    def controlled(self) -> tuple[str, ...]:
        """Names of all fields of ``Actions`` that a controller in place of the group can set."""
        return (*self.commands, *self.also_controlled)


_CLOCK = ("time_of_day", "time_of_year")
_CI = ("ci", "ci_forecast")
_OUTDOOR = ("outdoor", "outdoor_forecast")
_WEATHER = (*_OUTDOOR, "wet_bulb", "wet_bulb_forecast")
_QUEUE = ("queue", "oldest_age", "mean_age", "age_histogram")
_AIR = ("room", "hottest_inlet", "setpoint")

_OTHER_SITES = ("site_ci", "site_ci_forecast", "site_room", "site_link", "transfers")
_OWN_UNIT = (
    *("unit_speed", "unit_supply", "unit_return", "unit_running"),
    *("zone_hottest", "zone_mean", "tile_pressure", "neighbours"),
)
_TEAM_OF_HALL = {"hall_power": 1.0, "hall_heat": 0.2}
_HOT_RACKS = {"throttled_work": 20.0, "hot_junctions": 0.1, "hot_inlets": 0.1}
TEAM_OF_LIQUID: dict[str, dict[str, float]] = {
    "default": {"cooling_carbon": 10.0, **_HOT_RACKS},
    "bill": {"cooling_cost": 10.0, "high_power": 10.0, "heat_sales": 10.0, **_HOT_RACKS},
}
"""Factors of the reward terms by reward set that all agents of a hall share if some of them
control liquid cooling."""
_HALL = ("zone_hottest_highest", "unit_speed_highest", "unit_speed_mean")
_OWN_CDU = (
    *("cdu_setpoint", "cdu_supply", "cdu_return", "cdu_flow", "cdu_valve", "cdu_running"),
    *("cdu_junction", "cdu_headroom"),
)
_LOOP = (
    *("facility_supply", "facility_return", "trim_load", "heat_delivered", "heat_demand"),
    *("heat_price", "junction_headroom"),
)

AGENT_DEFINITIONS: dict[str, AgentDefinition] = {
    "agent_ls": AgentDefinition(
        part="load",
        commands=("load", "placement"),
        features=(*_CLOCK, "workload", *_QUEUE, *_CI, "ci_change", *_OUTDOOR, "soc"),
        scales={
            "default": {"work_carbon": 10.0, "cooling_carbon": 10.0, "sla": 20.0},
            "bill": {"work_cost": 10.0, "cooling_cost": 10.0, "high_power": 10.0, "sla": 60.0},
            "paper": {"carbon": 1.0, "queue": 1.0, "dropped": 10.0},
        },
    ),
    "agent_dc": AgentDefinition(
        part="cooling",
        commands=("cooling", "fan", "placement"),
        also_controlled=("chilled_water", "facility_approach_k", "reuse_share"),
        features=(*_CLOCK, "workload", *_CI, *_WEATHER, *_AIR, "it_energy", "hvac_energy"),
        scales={
            "default": {"cooling_carbon": 10.0, "hot_inlets": 0.1},
            "bill": {"cooling_cost": 10.0, "high_power": 10.0, "hot_inlets": 0.3},
            "paper": {"facility_energy": 1.0},
        },
    ),
    "agent_bat": AgentDefinition(
        part="battery",
        commands=("battery",),
        features=(*_CLOCK, *_CI, "ci_change", "dc_load", "soc"),
        scales={
            "default": {"battery_carbon": 10.0},
            "bill": {"battery_cost": 10.0, "high_power": 10.0},
            "paper": {"carbon": 1.0},
        },
    ),
    "agent_geo": AgentDefinition(
        part="geo",
        commands=("transfer",),
        features=(*_CLOCK, "workload", "queue", *_CI, *_OTHER_SITES),
        scales={
            "default": {"geo_carbon": 10.0},
            "bill": {"geo_cost": 10.0, "high_power": 10.0},
            "paper": {"carbon": 1.0},
        },
    ),
    "crac": AgentDefinition(
        part="cooling",
        commands=("fan", "cooling"),
        features=(*_OWN_UNIT, "chilled_water", "time_of_day"),
        scales={"default": _TEAM_OF_HALL, "own": {"zone_power": 1.0, "zone_heat": 0.2}},
        axis=CRAC_UNITS,
    ),
    "plant": AgentDefinition(
        part="cooling",
        commands=("cooling", "chilled_water", "facility_approach_k", "reuse_share"),
        features=(
            *("outdoor", "wet_bulb", "dc_load", *_HALL, "setpoint_mean", "chilled_water"),
            *_LOOP,
        ),
        scales={"default": _TEAM_OF_HALL},
        also_controlled=("placement",),
    ),
    "cdu": AgentDefinition(
        part="liquid",
        commands=("cdu_setpoint_c", "cdu_flow"),
        features=(*_OWN_CDU, "facility_supply", "outdoor", "wet_bulb", "workload", "ci"),
        scales=TEAM_OF_LIQUID,
        axis=CDUS,
        decided=2,
    ),
    "power_cap": AgentDefinition(
        part="liquid",
        commands=("power_cap",),
        features=(
            *_CLOCK,
            "workload",
            *_QUEUE,
            *_CI,
            "ci_change",
            "it_energy",
            "junction_headroom",
        ),
        scales=TEAM_OF_LIQUID,
    ),
}
"""Definitions of all groups by name.

The default features are the lists of the paper (A.1.2, A.2.4, A.3.3) with three additions: queue
ages and weather for the load agent, arriving work for the cooling agent, and the change of the
carbon intensity for the load and battery agents.

Reward set ``default`` charges each agent for the part of the carbon emissions that it can change.
Reward set ``bill`` uses prices instead of carbon intensity and adds a charge for high power. Reward
set ``paper`` contains r_LS, r_DC and r_BAT of the paper (4.5, F.2), with carbon and energies
divided by their values at the design point. In reward set ``own`` an agent of a CRAC unit has a
part of the reward that all agents of a hall share in ``default``; all other agents have their
rewards of ``default``. If an agent controls liquid cooling, ``crac``, ``plant``, ``cdu`` and
``power_cap`` share the rewards ``TEAM_OF_LIQUID``.
"""


ALL_AGENTS: tuple[str, ...] = tuple(AGENT_DEFINITIONS)
"""Names of all groups, in the order of their actions and observations in joint environments."""


def group_of(agent: str) -> str:
    """Return the group of an agent; the name of a group is also returned unchanged."""
    return agent if agent in AGENT_DEFINITIONS else agent.rpartition("_")[0]


def short_name(group: str) -> str:
    """Return the name of a group in tables and on the command line.

    It is the command of an agent of the released SustainDC, such as ``cooling``, and the name of
    any other group.
    """
    return AGENT_DEFINITIONS[group].command if group in AGENTS else group


def members_of(group: str, units: int) -> tuple[str, ...]:
    """Return the names of the agents of a group in one data center.

    Args:
        group: name of the group.
        units: number of units of the data center, of the kind for which the group has agents.
    """
    if not AGENT_DEFINITIONS[group].per_unit:
        return (group,)
    return tuple(f"{group}_{i}" for i in range(units))


def present_agents(agents: Sequence[str]) -> tuple[str, ...]:
    """Return the groups that exist beside those that learn, and these, in order.

    ``crac`` and ``plant`` take the place of ``agent_dc`` where one of them learns.
    """
    absent = ("agent_dc",) if set(agents) & set(HALL_AGENTS) else HALL_AGENTS
    return tuple(agent for agent in ALL_AGENTS if agent in agents or agent not in absent)


def commands_by_others(
    agents: Sequence[str], decided: Sequence[str], offered: Sequence[str]
) -> list[str]:
    """Return the names of the commands that a controller sets for the agents that do not learn.

    Args:
        agents: names of the groups that learn.
        decided: names of the commands that the learning agents decide.
        offered: names of all commands that the controller can set.
    """
    settable = dict.fromkeys(
        command
        for agent in present_agents(agents)
        if agent not in agents
        for command in AGENT_DEFINITIONS[agent].controlled
    )
    return [command for command in settable if command in offered and command not in decided]
