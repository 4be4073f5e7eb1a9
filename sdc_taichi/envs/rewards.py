"""Rewards of agents: weighted sums of named terms, or the values of a user's function.

A user's reward function takes the result of a step and the controller's view after the step. The
option ``rewards`` takes the function itself, its import path, or the name under which
``register_reward`` registered it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.control.view import View
from sdc_taichi.envs.agents import (
    AGENT_DEFINITIONS,
    AGENTS,
    ALL_AGENTS,
    HALL_AGENTS,
    LIQUID_AGENTS,
    TEAM_OF_LIQUID,
    present_agents,
)
from sdc_taichi.envs.released import ReleasedRewards
from sdc_taichi.envs.reward_terms import TERMS, TermContext
from sdc_taichi.envs.unit_slots import UnitSlots, slots_of_groups
from sdc_taichi.envs.view_terms import OF_DATA_CENTERS, OF_UNITS, ViewContext
from sdc_taichi.errors import ConfigError, SdcError, suggestion_or_valid
from sdc_taichi.sim.physical_limits import POWER_LIMITS_W
from sdc_taichi.types import CRAC_UNITS, F64, StepResult
from sdc_taichi.user_functions import (
    checked_values,
    function_named,
    import_path,
    register_function,
)

RewardFunction = Callable[[StepResult, View], Any]
"""Reward function of a user. It takes the result of a step and the view after the step. It returns
rewards, (B,), for every learning agent, or a dict of rewards by learning group, (B,) each, or one
for each unit for a group with an agent for each."""

_COUNTED_ONCE = ("default", "bill", "own")
"""Reward sets whose joint reward counts each term once, even if several agents have this term. The
joint reward of all other sets is the sum of the agents' rewards."""
REWARD_SETS = ("default", "bill", "paper", "sustaindc", "own")
"""Names of the built-in reward sets that the option ``rewards`` accepts."""
SCALED_SETS = tuple(name for name in REWARD_SETS if name != "sustaindc")
"""Reward sets that are sums of terms, multiplied by the scales of ``AGENT_DEFINITIONS``."""

_OF_UNITS = {agent for agent, definition in AGENT_DEFINITIONS.items() if definition.per_unit}
"""Groups with an agent for each unit."""
VIEW_TERMS = OF_DATA_CENTERS | OF_UNITS
"""Terms that are functions of the view, by name."""
_OF_AXIS = {CRAC_UNITS: OF_UNITS}
"""Terms of the agents of units, by kind of unit."""
MOST_SCALE = 1e9
"""Maximum absolute scale of a term, large enough for prices in any currency."""
BILLED_SHARE = 0.5
"""Share of the design power that is billed even if the power never reaches it."""
MAX_PEAK_KW = POWER_LIMITS_W[1] / 1e3
"""Maximum power that a saved state may contain as billed power, in kW."""
BILL_DAYS = 30.0
"""Days between two bills."""

_registered: dict[str, RewardFunction] = {}


def register_reward(name: str, reward: RewardFunction) -> None:
    """Register a reward function, so that the option ``rewards`` accepts its name.

    Args:
        name: Python identifier that no other reward uses.
        reward: the reward function; see ``RewardFunction``. It replaces an earlier function of the
            same module and name, for example when a notebook cell runs again.

    Raises:
        ConfigError: the name belongs to another function, or ``reward`` is not a function.
    """
    register_function("reward", name, reward, _registered, reserved=REWARD_SETS)


class Rewards:
    """Computes the rewards of the agents that learn.

    Args:
        rewards: value of the option ``rewards``: a name, scales by agent and term, a function, or
            the import path of a function.
        collaboration: weight of an agent's individual reward in the reward that it receives, 0..1.
        agents: names of the agents that learn.
        days: length of an episode, in days.
        liquid: True if an agent controls liquid cooling.

    Attributes:
        identity: plain values that identify the rewards: the scales, or the path of a function.
        used_terms: names of the terms with a scale; empty for functions and for the rewards of the
            released code.

    Raises:
        ConfigError: a name, agent or term is unknown, or the import path leads to no function.
    """

    def __init__(
        self,
        rewards: Any,
        collaboration: float,
        *,
        agents: Sequence[str],
        days: float,
        liquid: bool = False,
    ) -> None:
        self._collaboration, self._agents = collaboration, tuple(agents)
        self._team = team_of(agents)
        self._released: ReleasedRewards | None = None
        self._function: RewardFunction | None = None
        self._scales: dict[str, dict[str, float]] = {}
        self._joint_scales: dict[str, float] = {}
        self.identity: Any = "sustaindc"
        if isinstance(rewards, str) and rewards == "sustaindc":
            self._released = ReleasedRewards()
        elif isinstance(rewards, Mapping):
            self._scales = self.identity = _checked_scales(rewards, self._team, liquid)
        elif isinstance(rewards, str) and rewards in SCALED_SETS:
            self._scales = self.identity = {a: _scales_of(a, rewards, liquid) for a in self._team}
            if rewards in _COUNTED_ONCE and len(self._agents) > 1:
                for agent in self._agents:
                    # The terms of units are parts of those of the plant.
                    if agent not in _OF_UNITS or "plant" not in self._agents:
                        self._joint_scales |= self._scales[agent]
        else:
            self._function = rewards if callable(rewards) else _function_named(rewards)
            self.identity = import_path(self._function)
        used = {name for scales in self._scales.values() for name in scales}
        self.used_terms = [name for name in TERMS if name in used]
        self._view_terms = [name for name in VIEW_TERMS if name in used]
        self._has_units = bool(self._view_terms) or not _OF_UNITS.isdisjoint(self._team)
        self._stage: Any = None
        self._context = TermContext(days / BILL_DAYS)
        self._of_view = ViewContext(self._context)
        # Slots of the agents that learn, and of those of the team.
        self._slots: Mapping[str, UnitSlots] = {}
        self._team_slots: Mapping[str, UnitSlots] = {}
        # Highest billed power before and after the last step, in kW, (B,) each.
        self._peak_before_kw = self._peak_kw = np.zeros(0)

    def reset(self, view: View, slots: Mapping[str, UnitSlots]) -> None:
        """Start an episode.

        Args:
            view: the view before the first step.
            slots: places of units in the rewards of their agents, by learning group.

        Raises:
            DataError: the carbon intensity is constant, so the released code's rewards cannot be
                scaled by its range.
        """
        self._peak_before_kw = self._peak_kw = BILLED_SHARE * view.sizing.facility_w / 1e3
        self._context.reset(view)
        if self._view_terms:
            self._of_view.reset(view)
        if slots is not self._slots:
            self._slots, self._stage = slots, None
            self._team_slots = slots_of_groups(view.fleet, self._team)
        if self._released is not None:
            self._released.reset(view)

    def restart(self, chosen: npt.NDArray[np.bool_], view: View) -> None:
        """Forget the highest power of environments that start an episode within that of the batch.

        Args:
            chosen: True for these environments, (B,).
            view: the view before the first step of their episodes.
        """
        billed_kw = BILLED_SHARE * view.sizing.facility_w / 1e3
        self._peak_before_kw = np.where(chosen, billed_kw, self._peak_before_kw)
        self._peak_kw = np.where(chosen, billed_kw, self._peak_kw)

    def rewards(self, result: StepResult, view: View) -> tuple[dict[str, F64], F64]:
        """Compute the rewards of a step.

        Args:
            result: result of the step.
            view: the controller's view after the step.

        Returns:
            Rewards by learning agent, (B,) each, and the joint reward, (B,). Reward sets
            ``default`` and ``bill`` count each term once in the joint reward. If a user's function
            returns one reward for all agents, this is the joint reward. In all other cases the
            joint reward is the sum of the learning agents' rewards.

        Raises:
            SdcError: a user's function returned values of a wrong shape, or not finite.
        """
        self._peak_before_kw = self._peak_kw
        if self._scales:
            if self._stage is None:
                from sdc_taichi.kernels.compiler.stage import CompiledStage

                self._stage = CompiledStage(self._stage_function, view.size)
            self._context.begin_step(result.step, self._peak_before_kw)
            by_agent: dict[str, F64] = self._stage(context=self._context, result=result)
            self._peak_kw = by_agent.pop("peak_kw")
            if self._has_units:
                return self._with_units(by_agent, result, view)
            return by_agent, by_agent.pop("joint")
        self._peak_kw = _peak_kw(self._peak_kw, result)
        if self._function is not None:
            returned = self._function(result, view)
            slots = self._slots
            if not isinstance(returned, Mapping):
                for_all = checked_values("rewards function", returned, "all agents", view.size)
                by_agent = {
                    a: for_all[:, None] * slots[a].exists if a in slots else for_all
                    for a in self._agents
                }
                return by_agent, for_all
            sizes = {a: slots[a].count if a in slots else view.size for a in self._agents}
            by_agent = _checked_by_agent(returned, sizes)
            joint = _sum([slots[a].means(x) if a in slots else x for a, x in by_agent.items()])
            return {a: slots[a].fill(x) if a in slots else x for a, x in by_agent.items()}, joint
        assert self._released is not None
        return _with_sum(self._shared([*self._released.rewards(result, view).values()]))

    def terms(self, result: StepResult, names: Iterable[str] = TERMS) -> dict[str, F64]:
        """Return unscaled terms of the last step by name, (B,) each; by default ``TERMS``."""
        self._context.begin_step(result.step, self._peak_before_kw)
        return {name: TERMS[name](result, self._context) for name in names}

    def peaks_kw(self) -> F64:
        """Return the highest billed power before and after the last step, in kW, (2, B)."""
        return np.stack([self._peak_before_kw, self._peak_kw])

    def load_peaks_kw(self, peaks_kw: F64) -> None:
        """Restore values that ``peaks_kw`` returned, in kW, (2, B); call ``reset`` before."""
        self._peak_before_kw, self._peak_kw = peaks_kw.copy()

    def _stage_function(self, context: Any, result: Any) -> dict[str, F64]:
        """Compute rewards by agent, the joint reward and the peak power of a step, (B,) each.

        With terms of the view or units, the rewards are the individual ones, without those terms.
        ``CompiledStage`` traces this function.
        """
        terms = {name: TERMS[name](result, context) for name in self.used_terms}
        peak_kw = {"peak_kw": _peak_kw(context.peak_kw, result)}
        if self._has_units:
            general = {
                agent: {name: x for name, x in self._scales[agent].items() if name in terms}
                for agent in self._team
            }
            individual_of = {a: _weighed(terms, x) for a, x in general.items() if x}
            once = {name: x for name, x in self._joint_scales.items() if name in terms}
            joint_of = {"joint": _weighed(terms, once)} if once else {}
            return individual_of | joint_of | peak_kw
        individual = [_weighed(terms, self._scales[agent]) for agent in self._team]
        by_agent, joint = _with_sum(self._shared(individual))
        if self._joint_scales:
            joint = _weighed(terms, self._joint_scales)
        return by_agent | {"joint": joint} | peak_kw

    def _shared(self, individual: Sequence[F64]) -> dict[str, F64]:
        """Return collaborative rewards by learning agent from the individual ones of the team."""
        shared = collaborative_rewards(individual, self._collaboration)
        by_agent = dict(zip(self._team, shared, strict=True))
        return {agent: by_agent[agent] for agent in self._agents}

    def _with_units(
        self, by_agent: dict[str, F64], result: StepResult, view: View
    ) -> tuple[dict[str, F64], F64]:
        """Return rewards and joint reward of a team with terms of the view, or with units.

        Each agent of a unit counts as one agent of the team.

        Args:
            by_agent: individual rewards by group, and part of the joint reward that counts each
                term once, both without terms of the view, (B,) each.
            result: result of the step.
            view: the view after the step.
        """
        slots = self._team_slots
        joint = by_agent.pop("joint", np.zeros(view.size))
        terms = {n: VIEW_TERMS[n](result, view, self._of_view) for n in self._view_terms}
        individual: dict[str, F64] = {}
        for agent in self._team:
            scales = {n: x for n, x in self._scales[agent].items() if n in terms}
            units = slots.get(agent)
            value = np.zeros(view.size if units is None else units.count)
            for name, scale in scales.items():
                term = terms[name]
                if units is not None and name in OF_DATA_CENTERS:
                    term = term[units.dc]
                value = value + scale * term
            general = by_agent.get(agent)
            if general is not None:
                value = value + (general if units is None else general[units.dc])
            individual[agent] = value
        sums = {a: slots[a].sums(x) if a in slots else x for a, x in individual.items()}
        total = _sum(list(sums.values()))
        counts: dict[str, Any] = {a: x.counts for a, x in slots.items()}
        others = _sum([counts.get(a, np.ones(view.size)) for a in self._team]) - 1.0
        own = np.where(others > 0.0, self._collaboration, 1.0)
        weight = (1.0 - own) / np.maximum(others, 1.0)
        rewards: dict[str, F64] = {}
        for agent in self._agents:
            value = individual[agent]
            if agent in slots:
                dc = slots[agent].dc
                rewards[agent] = self._slots[agent].fill(
                    own[dc] * value + weight[dc] * (total[dc] - value)
                )
            else:
                rewards[agent] = own * value + weight * (total - value)
        if not self._joint_scales:
            return rewards, _sum([sums[a] / counts.get(a, 1.0) for a in self._agents])
        for name, scale in self._joint_scales.items():
            if name in terms:
                joint = joint + scale * self._of_dcs(name, terms[name])
        return rewards, joint

    def _of_dcs(self, name: str, term: F64) -> F64:
        """Return a term of data centers, (B,), or the mean of one of units over each of them."""
        axis = next((axis for axis, names in _OF_AXIS.items() if name in names), None)
        if axis is None:
            return term
        group = next(a for a in self._team_slots if AGENT_DEFINITIONS[a].axis == axis)
        return self._team_slots[group].means(term)


def team_of(agents: Sequence[str]) -> tuple[str, ...]:
    """Return the groups whose individual rewards the collaborative rewards combine, in order.

    They are the groups that learn, and the agents of the released code that exist beside them. If
    only agents of the cooling of a hall learn, they are these; of liquid cooling those that learn.
    """
    learning, liquid = set(agents), not set(LIQUID_AGENTS).isdisjoint(agents)
    hall = set[str]() if liquid or learning.isdisjoint(HALL_AGENTS) else set(HALL_AGENTS)
    others = set(AGENTS) & set(present_agents(agents))
    if learning <= {*HALL_AGENTS, *LIQUID_AGENTS}:
        others = set()
    return tuple(agent for agent in ALL_AGENTS if agent in {*agents, *hall, *others})


def collaborative_rewards(individual: Sequence[F64], a: float) -> list[F64]:
    """Compute collaborative rewards R_i = a r_i + (1 - a)/(N - 1) sum_{j != i} r_j.

    With N = 3 agents these are those of the paper (section 4.5).

    Args:
        individual: individual reward r_i of each of the N agents, (B,) each.
        a: weight of an agent's individual reward, 0..1.

    Returns:
        R_i of each agent, (B,) each.
    """
    if len(individual) == 1:
        return list(individual)
    total, weight = _sum(individual), (1.0 - a) / (len(individual) - 1)
    return [a * reward + weight * (total - reward) for reward in individual]


def _peak_kw(before_kw: F64, result: StepResult) -> F64:
    """Return the highest power of the episode up to the end of this step, in kW, (B,)."""
    return np.maximum(before_kw, result.grid_kwh / result.step_h)


def _scales_of(agent: str, rewards: str, liquid: bool) -> dict[str, float]:
    """Return the scales of an agent in a reward set.

    In reward set ``own`` agents without scales of their own have those of ``default``, which
    already are their own parts.

    Args:
        agent: name of the group.
        rewards: name of the reward set.
        liquid: True if an agent controls liquid cooling.

    Raises:
        ConfigError: the agent has no scales in this set.
    """
    scales = AGENT_DEFINITIONS[agent].scales
    if liquid and agent in HALL_AGENTS:
        scales = TEAM_OF_LIQUID
    if rewards == "own" and rewards not in scales:
        return scales["default"]
    if rewards not in scales:
        raise ConfigError(f"rewards {rewards!r}: {agent} has none; valid are {', '.join(scales)}")
    return scales[rewards]


def _checked_scales(
    by_agent: Mapping[str, Mapping[str, float]], team: Sequence[str], liquid: bool
) -> dict[str, dict[str, float]]:
    """Check a user's scales; agents without an entry receive those of reward set ``default``."""
    for agent, scales in by_agent.items():
        if agent not in team:
            raise ConfigError(f"rewards: unknown agent {agent!r}{suggestion_or_valid(agent, team)}")
        if not isinstance(scales, Mapping):
            raise ConfigError(f"rewards of {agent}: {scales!r}; valid is a dict of term to scale")
        of_units = _OF_AXIS.get(AGENT_DEFINITIONS[agent].axis, {})
        valid = [*of_units, *OF_DATA_CENTERS, *TERMS]
        for name, scale in scales.items():
            if name not in valid:
                raise ConfigError(
                    f"rewards of {agent}: unknown term {name!r}{suggestion_or_valid(name, valid)}"
                )
            number = isinstance(scale, int | float | np.number) and not isinstance(scale, bool)
            if not number or not abs(scale) <= MOST_SCALE:
                raise ConfigError(
                    f"rewards of {agent}: {name} is {scale!r}; valid is a number within "
                    f"-{MOST_SCALE:g}..{MOST_SCALE:g}"
                )
    return {
        agent: dict(by_agent[agent] if agent in by_agent else _scales_of(agent, "default", liquid))
        for agent in team
    }


def _function_named(name: Any) -> RewardFunction:
    """Return the reward function with a registered name or an import path ``module:name``."""
    function: RewardFunction = function_named(
        "rewards",
        name,
        _registered,
        valid=f"{', '.join([*REWARD_SETS, *_registered])}, a dict of agent to term to scale",
    )
    return function


def _checked_by_agent(returned: Mapping[Any, Any], sizes: Mapping[str, int]) -> dict[str, F64]:
    """Check the dict that a user's function returned; return rewards by learning group.

    Args:
        returned: rewards by group.
        sizes: number of rewards of each learning group: of data centers, or of units.
    """
    for agent in returned:
        if agent not in ALL_AGENTS:
            raise SdcError(
                f"rewards function: unknown agent {agent!r}{suggestion_or_valid(agent, ALL_AGENTS)}"
            )
    for agent in sizes:
        if agent not in returned:
            raise SdcError(f"rewards function: returned none for {agent}")
    return {
        agent: checked_values("rewards function", returned[agent], agent, size)
        for agent, size in sizes.items()
    }


def _with_sum(by_agent: dict[str, F64]) -> tuple[dict[str, F64], F64]:
    """Return rewards by agent together with their sum, (B,)."""
    return by_agent, _sum(list(by_agent.values()))


def _weighed(terms: Mapping[str, F64], scales: Mapping[str, float]) -> F64:
    """Return the sum of terms times their scales, (B,); 0 if there are no scales."""
    none: Any = 0.0
    return _sum([scale * terms[name] for name, scale in scales.items()] or [none])


def _sum(values: Sequence[F64]) -> F64:
    """Add arrays in order; ``np.sum`` uses another order for batches of one, with other bits."""
    total, *others = values
    for other in others:
        total = total + other
    return total
