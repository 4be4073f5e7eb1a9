"""Interface of a policy: the properties of an environment on which its networks depend.

A policy fits an environment, or the data centers of a run, if their interfaces are equal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any, Literal

from pydantic import Field, model_validator

from sdc_taichi.config.fields import Section
from sdc_taichi.envs.actions import AgentActions, equal_number
from sdc_taichi.envs.agents import (
    AGENT_DEFINITIONS,
    HALL_AGENTS,
    Agent,
    group_of,
    members_of,
)
from sdc_taichi.envs.features import Feature
from sdc_taichi.envs.observer import make_observer
from sdc_taichi.envs.options import EnvOptions, make_options
from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import CDUS, CRAC_UNITS

_NUMBER_OF_AXIS = {CRAC_UNITS: "crac_units", CDUS: "cdus"}
"""Field of ``Interface`` with the number of units of each kind in a data center."""


class ObservedFeature(Section):
    """A feature of an observation, with one entry or several consecutive entries."""

    name: str
    """Name of the feature, as in docs/observations.md."""
    unit: str
    """Unit of the value before scaling."""
    low: float
    """Lower end of the value range before scaling, in ``unit``."""
    high: float
    """Upper end of the value range before scaling, in ``unit``."""
    size: int = Field(ge=1)
    """Number of consecutive entries of the observation."""


class Interface(Section):
    """The properties of an environment's observations and actions on which a policy depends."""

    agents: tuple[Agent, ...]
    """Agents with a policy, in the order of their actions."""
    actions: Literal["discrete", "continuous"]
    """Type of actions: one of three discrete commands, or a continuous number."""
    action_order: Literal["paper", "sustaindc"] | None
    """Order of the battery's discrete actions; None if the battery has no discrete actions."""
    commands: dict[str, tuple[str, ...]]
    """Commands that each agent decides, in the order of the entries of its action."""
    setpoint_change_k: float | None
    """Setpoint change per step for a continuous action of 1, in K; None without such an action."""
    fan_change: float | None
    """Change of the CRAC fan speed per step for a continuous action of 1, as a share of full speed;
    None without such an action."""
    observations: Literal["default", "sustaindc"]
    """Type of observations: ``default`` for named features, ``sustaindc`` for the observation
    vectors of the SustainDC release."""
    features: dict[str, tuple[ObservedFeature, ...]]
    """Features that each agent observes, in the order of its observation."""
    ci_leads_h: tuple[float, ...]
    """Lead times of the carbon-intensity forecast, in h; empty for observations ``sustaindc``."""
    weather_leads_h: tuple[float, ...]
    """Lead times of the weather forecasts, in h; empty for observations ``sustaindc``."""
    step_min: int = Field(ge=1, le=60)
    """Length of a step, in min."""
    crac_units: int | None = Field(ge=1)
    """Number of CRAC units of a data center that the networks control together; None if no network
    controls CRAC units, or one that controls each unit alone."""
    racks: int | None = Field(ge=1)
    """Number of racks on which an agent places work in a data center; None if no agent places
    work."""
    own_policies: tuple[Agent, ...] = ()
    """Groups whose agents do not share a policy, so that the number of CRAC units is fixed."""
    sites: int | None = Field(default=None, ge=2)
    """Number of sites of a fleet among which an agent moves work; None if no agent moves work."""
    cdus: int | None = Field(default=None, ge=1)
    """Number of CDUs of a data center whose agents do not share a policy; None if they do."""
    neighbours: int | None = Field(default=None, ge=0, le=8)
    """Number of neighbouring CRAC units that an agent ``crac`` observes; None without such
    agents."""

    @model_validator(mode="after")
    def _of_all_agents(self) -> Interface:
        for name in ("commands", "features"):
            if set(getattr(self, name)) != set(self.agents):
                raise ValueError(f"{name}: valid are those of agents {', '.join(self.agents)}")
        of_units = [agent for agent in self.agents if AGENT_DEFINITIONS[agent].per_unit]
        if not set(self.own_policies) <= set(of_units):
            raise ValueError(f"own_policies {list(self.own_policies)}; valid are {of_units}")
        for group in self.own_policies:
            name = _NUMBER_OF_AXIS[AGENT_DEFINITIONS[group].axis]
            if getattr(self, name) is None:
                raise ValueError(f"{name}: None; valid with own_policies is their number")
        return self

    def policies_of(self, group: str) -> tuple[str, ...]:
        """Return what the networks act for: the group, or each of its agents."""
        if group not in self.own_policies:
            return (group,)
        count: int = getattr(self, _NUMBER_OF_AXIS[AGENT_DEFINITIONS[group].axis])
        return members_of(group, count)

    def width(self, agent: str) -> int:
        """Return the number n of entries of the observation of an agent, or of one of a group."""
        return sum(feature.size for feature in self.features[group_of(agent)])

    def action_width(self, agent: str) -> int:
        """Return the number k of entries of the action of an agent, or of one of a group."""
        numbers = {"placement": self.racks, "transfer": (self.sites or 1) - 1}
        if group_of(agent) not in HALL_AGENTS:
            numbers |= {"cooling": self.crac_units, "fan": self.crac_units}
        return sum(numbers.get(name) or 1 for name in self.commands[group_of(agent)])

    def options(self, **others: Any) -> EnvOptions:
        """Return options of environments that have this interface."""
        options: dict[str, Any] = {
            "agents": self.agents,
            "actions": self.actions,
            "action_order": self.action_order,
            "commands": self.commands,
            "setpoint_change_k": self.setpoint_change_k,
            "fan_change": self.fan_change,
            "observations": self.observations,
            "neighbours": self.neighbours,
        }
        if self.observations == "default":
            options["features"] = {
                agent: [feature.name for feature in features]
                for agent, features in self.features.items()
            }
            options["ci_leads_h"] = self.ci_leads_h
            options["weather_leads_h"] = self.weather_leads_h
        return make_options(**{k: v for k, v in options.items() if v is not None}, **others)

    def difference(self, other: Interface) -> str | None:
        """Describe the first difference from another interface; None if they are equal."""
        for name, label in _LABELS.items():
            ours, others = getattr(self, name), getattr(other, name)
            if ours != others:
                return f"{label}: {_text(ours)} in training, {_text(others)} here"
        for agent in self.agents:
            difference = _feature_difference(self.features[agent], other.features[agent])
            if difference is not None:
                return f"observation of {agent}: {difference}"
        return None

    def require_fit(self, what: str, fleet: Fleet) -> None:
        """Check that a policy with this interface fits data centers.

        Args:
            what: name of the policy in messages.
            fleet: the data centers.

        Raises:
            ConfigError: the policy does not fit; the message names the difference.
        """
        step_min = 60 // fleet.steps_per_hour
        if step_min != self.step_min:
            reason: str | None = f"step: {self.step_min} min in training, {step_min} min here"
        else:
            try:
                reason = self.difference(interface_of(fleet, self.options(), self.own_policies))
            except ConfigError as error:
                reason = str(error)
        if reason is not None:
            raise ConfigError(f"{what}: does not fit these data centers ({reason})")


_LABELS = {
    "agents": "agents",
    "observations": "observations",
    "actions": "actions",
    "action_order": "action_order",
    "commands": "commands",
    "setpoint_change_k": "setpoint_change_k",
    "fan_change": "fan_change",
    "neighbours": "neighbours",
    "step_min": "step in min",
    "ci_leads_h": "ci_leads_h",
    "weather_leads_h": "weather_leads_h",
    "crac_units": "CRAC units (hvac.crac.units)",
    "racks": "racks",
    "sites": "sites",
    "cdus": "CDUs",
}
"""Name of each field of ``Interface`` in messages, in the order of comparison."""


def interface_of(
    fleet: Fleet, options: EnvOptions, own_policies: Sequence[Agent] = ()
) -> Interface:
    """Return the interface of environments to the policies of their learning agents.

    Args:
        fleet: the data centers.
        options: options of the environments.
        own_policies: groups whose agents do not share a policy.

    Raises:
        ConfigError: the options do not fit the data centers, or observations contain heat maps; or
            the agents of CRAC units do not share a policy, and data centers differ in their number.
    """
    if options.heat_map:
        raise ConfigError("heat_map True: policies observe features alone; valid is False")
    decoder = AgentActions(fleet, options)
    features = make_observer(fleet, options).features
    decided: dict[str, tuple[str, ...]] = {
        agent: options.commands_of(agent) for agent in options.agents
    }
    names = {name for commands in decided.values() for name in commands}
    continuous, named = options.actions == "continuous", options.observations == "default"
    has_order = not continuous and "battery" in names
    of_dc = set(decided.get("agent_dc", ()))
    own_axes = {AGENT_DEFINITIONS[group].axis for group in own_policies}
    on_units = CRAC_UNITS in own_axes or not of_dc.isdisjoint(("cooling", "fan"))
    on_racks = "placement" in names
    return Interface(
        agents=options.agents,
        actions=options.actions,
        action_order=decoder.action_order if has_order else None,
        commands=decided,
        setpoint_change_k=options.setpoint_change_k if continuous and "cooling" in names else None,
        fan_change=options.fan_change if continuous and "fan" in names else None,
        observations=options.observations,
        features={agent: _observed(features[agent]) for agent in options.agents},
        ci_leads_h=options.ci_leads_h if named else (),
        weather_leads_h=options.weather_leads_h if named else (),
        step_min=60 // fleet.steps_per_hour,
        crac_units=equal_number(fleet.unit_offsets, "CRAC units") if on_units else None,
        racks=equal_number(fleet.rack_offsets, "racks") if on_racks else None,
        own_policies=tuple(own_policies),
        sites=fleet.sites_per_fleet if "transfer" in names else None,
        cdus=equal_number(fleet.cdu_offsets, "CDUs") if CDUS in own_axes else None,
        neighbours=options.neighbours if "crac" in options.agents else None,
    )


def _observed(features: Sequence[Feature]) -> tuple[ObservedFeature, ...]:
    return tuple(
        ObservedFeature(name=f.name, unit=f.unit, low=f.low, high=f.high, size=f.size)
        for f in features
    )


def _feature_difference(
    ours: Sequence[ObservedFeature], others: Sequence[ObservedFeature]
) -> str | None:
    """Describe the first difference between the features of an agent; None if they are equal."""
    for feature, other in zip_longest(ours, others):
        if feature != other:
            return f"{_feature_text(feature)} in training, {_feature_text(other)} here"
    return None


def _feature_text(feature: ObservedFeature | None) -> str:
    """Return name, number of entries and range of a feature as text."""
    if feature is None:
        return "no feature"
    values = f"{feature.low:g}..{feature.high:g} {feature.unit}"
    return f"feature {feature.name!r} ({feature.size} of {values})"


def _text(value: Any) -> str:
    """Return a field value of an interface as short text."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(entry)}" for name, entry in value.items())
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_text, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
