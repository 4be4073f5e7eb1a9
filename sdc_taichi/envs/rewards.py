"""Rewards of agents: named terms weighed by scales, or a function of the user's, shared by agents.

A user's own reward is a function of the result of a step and the view after it. It is given as the
option ``rewards``: itself, the name that ``register_reward`` gave it, or its import path.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.released_rewards import ReleasedRewards
from sdc_taichi.envs.reward_terms import TERMS, RewardContext, TermContext
from sdc_taichi.errors import ConfigError, SdcError, suggestion_or_valid
from sdc_taichi.sim.physical_limits import POWER_LIMITS_W
from sdc_taichi.types import F64, StepResult
from sdc_taichi.user_functions import (
    checked_values,
    function_named,
    import_path,
    register_function,
)

RewardFunction = Callable[[StepResult, View], Any]
"""A user's own reward. It gets the result of a step and the view after it, and returns rewards,
(B,), which all agents get alike, or a dict of them by learning agent."""

SCALES: dict[str, dict[str, dict[str, float]]] = {
    "default": {
        "agent_ls": {"work_carbon": 10.0, "cooling_carbon": 10.0, "sla": 20.0},
        "agent_dc": {"cooling_carbon": 10.0, "hot_inlets": 0.1},
        "agent_bat": {"battery_carbon": 10.0},
    },
    "bill": {
        "agent_ls": {"work_cost": 10.0, "cooling_cost": 10.0, "high_power": 10.0, "sla": 60.0},
        "agent_dc": {"cooling_cost": 10.0, "high_power": 10.0, "hot_inlets": 0.3},
        "agent_bat": {"battery_cost": 10.0, "high_power": 10.0},
    },
    "paper": {
        "agent_ls": {"carbon": 1.0, "queue": 1.0, "dropped": 10.0},
        "agent_dc": {"facility_energy": 1.0},
        "agent_bat": {"carbon": 1.0},
    },
}
"""Scales of the terms of each agent, by the name of the set: ``default`` is carbon, to each agent
the part that it can change, ``bill`` the same with prices and high power, and ``paper`` r_LS, r_DC
and r_BAT of the paper (4.5, F.2), with carbon and energies over those of the design point."""
_COUNTED_ONCE = ("default", "bill")
"""Sets of which the reward of several agents as one counts each term once, however many of them
have it; with others it is the sum of theirs."""
REWARD_SETS = (*SCALES, "sustaindc")
"""Rewards that the option ``rewards`` takes by name, besides registered functions."""

MOST_SCALE = 1e9
"""Largest scale of a term, of either sign, which leaves room for prices in any currency."""
BILLED_SHARE = 0.5
"""Share of the design power that is billed whatever the episode draws."""
MAX_PEAK_KW = POWER_LIMITS_W[1] / 1e3
"""Highest power that can be billed, in kW."""
BILL_DAYS = 30.0
"""Days between two bills."""

OWN_FIELDS = ("peak_kw", "bills")
"""Fields of ``TermContext`` that rewards know themselves; ``RewardContext`` has the others."""

_registered: dict[str, RewardFunction] = {}


def register_reward(name: str, reward: RewardFunction) -> None:
    """Make a function available as ``rewards=name``.

    Args:
        name: an identifier that no other reward has.
        reward: the function; see ``RewardFunction``. One of the same module and name as the
            function before takes its place, as when a cell of a notebook runs again.

    Raises:
        ConfigError: a name that another function has, or no function.
    """
    register_function("reward", name, reward, _registered, reserved=REWARD_SETS)


class Rewards:
    """Rewards of the agents that learn.

    Args:
        rewards: the option ``rewards``: a name, agent to term to scale, or a function or its path.
        collaboration: share of an agent's own reward in what it gets, 0..1.
        agents: agents that learn.
        days: length of the episodes in days.

    Attributes:
        identity: plain values that tell rewards apart: scales, or the name of a function.
        used_terms: names of the terms that the rewards are made of; empty for functions and for
            those of the released code.

    Raises:
        ConfigError: an unknown name, agent or term, or a path without a function.
    """

    def __init__(
        self,
        rewards: Any,
        collaboration: float,
        *,
        agents: Sequence[str],
        days: float,
    ) -> None:
        self._collaboration, self._agents = collaboration, tuple(agents)
        self._bills = days / BILL_DAYS
        self._released = ReleasedRewards() if rewards == "sustaindc" else None
        self._scales: dict[str, dict[str, float]] | None = None
        self._joint_scales: dict[str, float] | None = None
        if isinstance(rewards, str) and rewards in _COUNTED_ONCE and len(self._agents) > 1:
            of_each = [SCALES[rewards][agent] for agent in self._agents]
            self._joint_scales = {term: x for own in of_each for term, x in own.items()}
        self._function: RewardFunction | None = None
        if isinstance(rewards, Mapping):
            self._scales = _checked_scales(rewards)
        elif isinstance(rewards, str) and rewards in SCALES:
            self._scales = SCALES[rewards]
        elif self._released is None:
            self._function = rewards if callable(rewards) else _function_named(rewards)
        self.identity: Any = (
            import_path(self._function) if self._function else self._scales or "sustaindc"
        )
        scales = self._scales or {}
        self.used_terms = [name for name in TERMS if any(name in own for own in scales.values())]
        self._stage: Any = None
        self._quantities_read: tuple[str, ...] = ()
        self._context = RewardContext()
        self._context_read: tuple[str, ...] = ()
        # Highest power that is billed, before the last step and with it, (B,) each.
        self._peak_before_kw = self._peak_kw = np.zeros(0)
        self._step_h = 0.0

    def reset(self, view: View) -> None:
        """Start an episode.

        Args:
            view: the view before the first step.

        Raises:
            DataError: a carbon intensity that never changes, with rewards of the released code.
        """
        self._peak_before_kw = self._peak_kw = BILLED_SHARE * view.sizing.facility_w / 1e3
        self._step_h = view.step_h
        self._context.reset(view)
        if self._released is not None:
            self._released.reset(view)

    def rewards(self, result: StepResult, view: View) -> tuple[dict[str, F64], F64]:
        """Rewards of a step.

        Args:
            result: the step.
            view: the view after it.

        Returns:
            Rewards by learning agent, (B,) each, and of all learning agents as one, (B,): each term
            once with ``default`` and ``bill``, what a user's function gives for all agents alike,
            and else the sum.

        Raises:
            SdcError: a user's function returned something of another shape, or not finite.
        """
        self._peak_before_kw = self._peak_kw
        if self._scales is not None:
            by_agent = self._weighed_terms(result)
            self._peak_kw = by_agent.pop("peak_kw")
            return by_agent, by_agent.pop("joint")
        self._peak_kw = _peak_kw(self._peak_kw, result)
        if self._function is not None:
            returned = self._function(result, view)
            if not isinstance(returned, Mapping):
                for_all = checked_values("rewards function", returned, "all agents", view.size)
                return dict.fromkeys(self._agents, for_all), for_all
            return _with_sum(_checked_by_agent(returned, self._agents, view.size))
        assert self._released is not None
        return _with_sum(self._shared([*self._released.rewards(result, view).values()]))

    def terms(self, result: StepResult, names: Iterable[str] = TERMS) -> dict[str, F64]:
        """Terms of the last step by name, unscaled, (B,) each, whatever the rewards are made of."""
        context = self._term_context(result)
        return {name: TERMS[name](result, context) for name in names}

    def peaks_kw(self) -> F64:
        """Highest billed power of the episode before the last step and with it, in kW, (2, B)."""
        return np.stack([self._peak_before_kw, self._peak_kw])

    def load_peaks_kw(self, peaks_kw: F64) -> None:
        """Continue from what ``peaks_kw`` gave, (2, B), in an episode that has been reset."""
        self._peak_before_kw, self._peak_kw = peaks_kw.copy()

    def _weighed_terms(self, result: StepResult) -> dict[str, F64]:
        """Rewards by learning agent, of all of them as ``joint``, and ``peak_kw``, (B,) each."""
        if self._stage is None:
            self._compile(result)
        found: dict[str, F64] = self._stage(
            peak_before_kw=self._peak_before_kw,
            **self._context.values(result.step, self._context_read),
            **{name: getattr(result, name) for name in self._quantities_read},
        )
        return found

    def _compile(self, result: StepResult) -> None:
        """Find out which quantities of a step the terms read, and compile the terms."""
        from sdc_taichi.kernels.compiler.stage import CompiledStage

        quantities, context = _NotedReads(), _NotedReads()
        for name in self.used_terms:
            TERMS[name](quantities, context)  # type: ignore[arg-type]
        _peak_kw(self._peak_kw, quantities)  # type: ignore[arg-type]
        self._quantities_read = tuple(quantities.names)
        self._context_read = tuple(name for name in context.names if name not in OWN_FIELDS)
        self._stage = CompiledStage(self._stage_function, result.grid_kwh.size)

    def _stage_function(self, peak_before_kw: F64, **read: Any) -> dict[str, F64]:
        """Weighed terms of each agent, shared, from quantities of a step, (B,) each."""
        assert self._scales is not None
        own_fields = {"peak_kw": peak_before_kw, "bills": self._bills}
        in_context = {name: read.pop(name) for name in self._context_read}
        context: Any = SimpleNamespace(**own_fields, **in_context)
        result: Any = SimpleNamespace(step_h=self._step_h, **read)
        terms = {name: TERMS[name](result, context) for name in self.used_terms}
        own = [_weighed(terms, self._scales[agent]) for agent in AGENTS]
        by_agent, joint = _with_sum(self._shared(own))
        if self._joint_scales is not None:
            joint = _weighed(terms, self._joint_scales)
        return by_agent | {"joint": joint, "peak_kw": _peak_kw(peak_before_kw, result)}

    def _shared(self, own: Sequence[F64]) -> dict[str, F64]:
        """Collaborative rewards by learning agent, from those of all agents in order."""
        by_agent = dict(zip(AGENTS, collaborative_rewards(own, self._collaboration), strict=True))
        return {agent: by_agent[agent] for agent in self._agents}

    def _term_context(self, result: StepResult) -> TermContext:
        """Everything that terms may refer to, as arrays."""
        names = [f.name for f in fields(TermContext) if f.name not in OWN_FIELDS]
        return TermContext(
            peak_kw=self._peak_before_kw,
            bills=self._bills,
            **self._context.values(result.step, names),
        )


def collaborative_rewards(own: Sequence[F64], a: float) -> list[F64]:
    """Rewards that agents share: R_i = a r_i + (1 - a)/2 sum of the others' (paper, section 4.5).

    Args:
        own: r_LS, r_DC and r_BAT, (B,) each.
        a: share of the own reward, 0..1.

    Returns:
        R_LS, R_DC and R_BAT, (B,) each.
    """
    total, rest = _sum(own), (1.0 - a) / (len(own) - 1)
    return [a * each + rest * (total - each) for each in own]


class _NotedReads:
    """Stands in for the result of a step, and notes which of its quantities are read."""

    step_h = 1.0

    def __init__(self) -> None:
        self.names: dict[str, None] = {}

    def __getattr__(self, name: str) -> F64:
        self.names[name] = None
        return np.ones(1)


def _peak_kw(before_kw: F64, result: StepResult) -> F64:
    """Highest power of the episode with this step, in kW, (B,)."""
    return np.maximum(before_kw, result.grid_kwh / result.step_h)


def _checked_scales(given: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Scales of all agents; those that are not given have their defaults."""
    for agent, scales in given.items():
        if agent not in AGENTS:
            raise ConfigError(
                f"rewards: unknown agent {agent!r}{suggestion_or_valid(agent, AGENTS)}"
            )
        if not isinstance(scales, Mapping):
            raise ConfigError(f"rewards of {agent}: {scales!r}; valid is a dict of term to scale")
        for name, scale in scales.items():
            if name not in TERMS:
                raise ConfigError(
                    f"rewards of {agent}: unknown term {name!r}{suggestion_or_valid(name, TERMS)}"
                )
            number = isinstance(scale, int | float | np.number) and not isinstance(scale, bool)
            if not number or not abs(scale) <= MOST_SCALE:
                raise ConfigError(
                    f"rewards of {agent}: {name} is {scale!r}; valid is a number within "
                    f"-{MOST_SCALE:g}..{MOST_SCALE:g}"
                )
    return {agent: dict(given.get(agent, SCALES["default"][agent])) for agent in AGENTS}


def _function_named(given: Any) -> RewardFunction:
    """A registered function, or one by its import path ``module:name``."""
    found: RewardFunction = function_named(
        "rewards",
        given,
        _registered,
        valid=f"{', '.join([*REWARD_SETS, *_registered])}, a dict of agent to term to scale",
    )
    return found


def _checked_by_agent(
    returned: Mapping[Any, Any], agents: Sequence[str], size: int
) -> dict[str, F64]:
    """Values that a user's function returned for each learning agent, without other agents."""
    for agent in returned:
        if agent not in AGENTS:
            raise SdcError(
                f"rewards function: unknown agent {agent!r}{suggestion_or_valid(agent, AGENTS)}"
            )
    for agent in agents:
        if agent not in returned:
            raise SdcError(f"rewards function: returned none for {agent}")
    return {
        agent: checked_values("rewards function", returned[agent], agent, size) for agent in agents
    }


def _with_sum(by_agent: dict[str, F64]) -> tuple[dict[str, F64], F64]:
    """Rewards by agent, and their sum, (B,)."""
    return by_agent, _sum(list(by_agent.values()))


def _weighed(terms: Mapping[str, F64], scales: Mapping[str, float]) -> F64:
    """Sum of terms times their scales, (B,); 0 without any."""
    none: Any = 0.0
    return _sum([scale * terms[name] for name, scale in scales.items()] or [none])


def _sum(values: Sequence[F64]) -> F64:
    """Sum in order, whatever the size of the batch; ``np.sum`` has another order for size 1."""
    first, *others = values
    for other in others:
        first = first + other
    return first
