"""Rewards: named terms of a step, weighed by scales and shared between agents.

Every term is 0 or less. Energies, carbon, cost, fossil share and water are shares of what the data
center would use, emit or pay in a step at its design point, about -1 at full load, so that sites
and halls of any size give rewards of one size; ``sla`` is a share of the work of a full step. The
others have units: ``pue`` is a ratio, ``hot_inlets`` in K, ``queue`` and ``dropped`` in tasks, and
``demand_charge`` is in the money of ``cost``, due in the few steps that raise the highest power.
Nothing is scaled by data of the run.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.envs.features import AGENTS
from sdc_taichi.envs.options import Tariff
from sdc_taichi.envs.released import ReleasedRewards
from sdc_taichi.errors import ConfigError, SdcError, suggestion_or_valid
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.types import F64, I64, StepResult

Reward = Callable[[StepResult, View], Any]
"""Rewards of a step, (B,), the same for all agents or by learning agent in a dict; gets the step
and the view after it."""

CI_G_PER_KWH = 500.0
"""Carbon intensity at which the design energy gives a carbon term of -1, a grid run on gas."""
FOSSIL_G_PER_KWH = 800.0
"""Intensity of a grid without renewables, for their estimated share (mixed coal and gas; IPCC AR5
WG III annex III gives medians of 820 and 490)."""
WATER_L_PER_KWH = 1.8
"""Average use of data centers per kWh of IT (Shehabi et al. 2016, LBNL-1005775)."""
RUSH_START_H = 23.0
"""Hour of the day from which queued tasks cost, more and more (paper, F.1)."""
QUEUE_SCALE_TASKS = 10.0
"""Queued tasks that cost 1 at the end of the day (paper, F.2)."""
PRICE_PER_KWH = 0.1
"""Price at which the design energy gives a cost of -1."""
BILLED_SHARE = 0.5
"""Share of the design power that is billed whatever the episode draws."""
BILL_DAYS = 30.0
"""Days between two bills."""


@dataclass(frozen=True, slots=True)
class Context:
    """What terms refer to."""

    design_kwh: F64
    """Energy of a step at the design point, (B,)."""
    tariff: Tariff
    peak_kw: F64
    """Highest power of the episode before this step, at least ``BILLED_SHARE`` of the design power,
    (B,)."""
    bills: float
    """Length of the episode over that of a bill."""
    price_per_kwh: F64
    """In this step, (B,), as the next."""
    rush: F64
    """Weight of queued tasks."""


def carbon(r: StepResult, c: Context) -> F64:
    """Carbon of the step: CFP = (E_it + E_hvac + E_bat) CI (paper, A.3.4)."""
    return -r.carbon_g / (c.design_kwh * CI_G_PER_KWH)


def facility_energy(r: StepResult, c: Context) -> F64:
    """IT and HVAC energy (paper, 4.5: r_DC)."""
    return -r.facility_kwh / c.design_kwh


def total_energy(r: StepResult, c: Context) -> F64:
    """Energy drawn from the grid, the battery included."""
    return -r.grid_kwh / c.design_kwh


def hvac_energy(r: StepResult, c: Context) -> F64:
    """HVAC energy."""
    return -r.hvac_kwh / c.design_kwh


def it_energy(r: StepResult, c: Context) -> F64:
    """IT energy."""
    return -r.it_kwh / c.design_kwh


def cost(r: StepResult, c: Context) -> F64:
    """Energy by the time-of-use tariff, over the price of the design energy at 0.1 per kWh."""
    return -r.grid_kwh * c.price_per_kwh / (PRICE_PER_KWH * c.design_kwh)


def demand_charge(r: StepResult, c: Context) -> F64:
    """What the step adds to the highest power above half the design power, in units of `cost`.

    The charge of a bill times the length of the episode over 30 days. Half the design power is
    billed in any case, so it is no part of the reward.
    """
    above_kw = np.maximum(r.grid_kwh / r.step_h - c.peak_kw, 0.0)
    charge = above_kw * c.tariff.demand_charge_per_kw * c.bills
    return -charge / (PRICE_PER_KWH * c.design_kwh)


def fossil_share(r: StepResult, c: Context) -> F64:
    """Energy from the grid less its renewable share, estimated as 1 - CI/(800 g/kWh)."""
    share = np.minimum(r.ci_g_per_kwh / FOSSIL_G_PER_KWH, 1.0)
    return -share * r.grid_kwh / c.design_kwh


def pue(r: StepResult, c: Context) -> F64:
    """HVAC power over IT power, PUE - 1; 0 without IT power."""
    return np.where(r.it_w > 0.0, -r.hvac_w / np.where(r.it_w > 0.0, r.it_w, 1.0), 0.0)


def water(r: StepResult, c: Context) -> F64:
    """Make-up water, over the design energy times 1.8 L/kWh."""
    return -r.water_l / (WATER_L_PER_KWH * c.design_kwh)


def hot_inlets(r: StepResult, c: Context) -> F64:
    """What inlets exceed the recommended 27 C by, mean over servers, K (ASHRAE TC 9.9)."""
    return -r.over_27_mean_k


def queue(r: StepResult, c: Context) -> F64:
    """Tasks queued in the last hour of the day over 10, weighed from 0 to 1 (paper, F.1, F.2)."""
    return -c.rush * r.queue_tasks / QUEUE_SCALE_TASKS


def dropped(r: StepResult, c: Context) -> F64:
    """Tasks dropped because the queue was full."""
    return -r.dropped_tasks


def sla(r: StepResult, c: Context) -> F64:
    """Work past its deadline, dropped or lost, as a share of a full step."""
    return -(r.overdue_tasks + r.dropped_tasks + r.lost_tasks) / TASKS_PER_STEP


Term = Callable[[StepResult, Context], F64]
TERMS: dict[str, Term] = {
    term.__name__: term
    for term in (
        carbon,
        total_energy,
        facility_energy,
        it_energy,
        hvac_energy,
        cost,
        demand_charge,
        fossil_share,
        pue,
        water,
        hot_inlets,
        queue,
        dropped,
        sla,
    )
}

DEFAULT_SCALES: dict[str, dict[str, float]] = {
    "agent_ls": {"carbon": 1.0, "queue": 1.0, "dropped": 10.0},
    "agent_dc": {"facility_energy": 1.0},
    "agent_bat": {"carbon": 1.0},
}
"""r_LS, r_DC and r_BAT of the paper (4.5, F.2), with CFP and energies in this module's units."""

_registered: dict[str, Reward] = {}


def register_reward(name: str, reward: Reward) -> None:
    """Make a function available as ``rewards=name``.

    Raises:
        ConfigError: a name that another function has, or no function.
    """
    if not callable(reward):
        raise ConfigError(f"reward {name!r}: is a {type(reward).__name__}; valid is a function")
    taken = name in ("default", "sustaindc") or _registered.get(name, reward) is not reward
    if not isinstance(name, str) or not name.isidentifier() or taken:
        raise ConfigError(f"reward {name!r}: valid is a name that is not taken")
    _registered[name] = reward


class Rewards:
    """Rewards of the agents that learn.

    Args:
        spec: ``EnvOptions.rewards``.
        collaboration: share of an agent's own reward in what it gets.
        tariff: prices for the terms ``cost`` and ``demand_charge``.
        agents: who learns.
        days: length of the episodes.

    Raises:
        ConfigError: an unknown name, agent or term, or a path without a function.
    """

    def __init__(
        self,
        spec: Any,
        collaboration: float,
        tariff: Tariff,
        *,
        agents: Sequence[str],
        days: float,
    ) -> None:
        self._own, self._tariff, self._agents = collaboration, tariff, tuple(agents)
        self._bills = days / BILL_DAYS
        self._released = ReleasedRewards() if spec == "sustaindc" else None
        self._scales: dict[str, dict[str, float]] | None = None
        self._function: Reward | None = None
        if spec == "default":
            self._scales = DEFAULT_SCALES
        elif isinstance(spec, Mapping):
            self._scales = _checked_scales(spec)
        elif self._released is None:
            self._function = spec if callable(spec) else _find(spec)
        # What decides the rewards, to tell environments apart.
        self.name = _name(self._function) if self._function else self._scales or "sustaindc"
        scales = self._scales or {}
        self.weighed = [name for name in TERMS if any(name in own for own in scales.values())]
        """Terms that the rewards are made of; none for a function's and the released ones."""
        self._stage: Any = None
        self._reads: tuple[str, ...] = ()
        """Quantities of a step that the stage reads."""
        # Highest power that is billed, before the last step and with it.
        self._peak_before_kw = self._peak_kw = np.zeros(0)
        self._design_kwh = np.zeros(0)
        self._step_h = 0.0
        self._first: I64 = np.zeros(0, dtype=np.int64)
        """Step of the day of the first step."""
        self._price_per_kwh = self._rush = np.zeros(0)

    def reset(self, view: View) -> None:
        """Start an episode."""
        self._peak_before_kw = self._peak_kw = BILLED_SHARE * view.sizing.facility_w / 1e3
        self._step_h = view.step_h
        self._design_kwh = view.sizing.facility_w * view.step_h / 1e3
        per_hour = view.fleet.steps_per_hour
        step = np.arange(24 * per_hour)
        prices = np.array(self._tariff.price_per_kwh)
        self._price_per_kwh = prices[step // per_hour % len(prices)]
        self._rush = _rush(step, view.step_h)
        self._first = view.state.start % len(step)
        if self._released is not None:
            self._released.reset(view)

    def rewards(self, result: StepResult, view: View) -> tuple[dict[str, F64], F64]:
        """Rewards of a step.

        Args:
            result: the step.
            view: the view after it.

        Returns:
            By learning agent, (B,) each, and of all of them as one learner, (B,): the sum, or what
            a user's function gives for all agents alike.

        Raises:
            SdcError: a user's function returned something of another shape, or not finite.
        """
        self._peak_before_kw = self._peak_kw
        if self._scales is not None:
            found = self._weighed(result)
            self._peak_kw = found.pop("peak_kw")
            return found, found.pop("joint")
        self._peak_kw = _peak_kw(self._peak_kw, result)
        if self._function is not None:
            found = self._function(result, view)
            if not isinstance(found, Mapping):
                alike = _values(found, "all agents", view.size)
                return dict.fromkeys(self._agents, alike), alike
            return _together(_by_agent(found, self._agents, view.size))
        assert self._released is not None
        return _together(self._shared([*self._released.rewards(result, view).values()]))

    def state(self) -> F64:
        """What an episode leaves behind for its rewards: its highest power, kW, (2, B)."""
        return np.stack([self._peak_before_kw, self._peak_kw])

    def load(self, state: F64) -> None:
        """Go on from ``state``, of the shape that it has."""
        self._peak_before_kw, self._peak_kw = state.copy()

    def terms(self, result: StepResult, names: Iterable[str] = TERMS) -> dict[str, F64]:
        """Terms of the last step by name, (B,) each, whatever the rewards are made of."""
        context = self._context(result)
        return {name: TERMS[name](result, context) for name in names}

    def _weighed(self, result: StepResult) -> dict[str, F64]:
        """Rewards by learning agent, of all of them by ``joint``, and ``peak_kw``, (B,)."""
        if self._stage is None:
            from sdc_taichi.kernels.compiler.stage import CompiledStage

            reads = _Reads()
            for name in self.weighed:
                TERMS[name](reads, self._context(result))  # type: ignore[arg-type]
            _peak_kw(self._peak_kw, reads)  # type: ignore[arg-type]
            self._reads = tuple(reads.names)
            self._stage = CompiledStage(self._of_terms, len(self._design_kwh))
        now = self._step_of_day(result)
        found: dict[str, F64] = self._stage(
            design_kwh=self._design_kwh,
            peak_kw=self._peak_before_kw,
            price_per_kwh=self._price_per_kwh[now],
            rush=self._rush[now],
            **{name: getattr(result, name) for name in self._reads},
        )
        return found

    def _of_terms(
        self, design_kwh: F64, peak_kw: F64, price_per_kwh: F64, rush: F64, **read: Any
    ) -> dict[str, F64]:
        """The stage: weighed terms of each agent, shared."""
        assert self._scales is not None
        context = Context(
            design_kwh, self._tariff, peak_kw, self._bills, price_per_kwh=price_per_kwh, rush=rush
        )
        result: Any = SimpleNamespace(step_h=self._step_h, **read)
        found = {name: TERMS[name](result, context) for name in self.weighed}
        none: Any = 0.0
        own = [
            _sum([scale * found[name] for name, scale in self._scales[agent].items()] or [none])
            for agent in AGENTS
        ]
        by_agent, joint = _together(self._shared(own))
        return by_agent | {"joint": joint, "peak_kw": _peak_kw(peak_kw, result)}

    def _shared(self, own: Sequence[F64]) -> dict[str, F64]:
        """Rewards by learning agent from those of all agents."""
        by_agent = dict(zip(AGENTS, share(own, self._own), strict=True))
        return {agent: by_agent[agent] for agent in self._agents}

    def _context(self, result: StepResult) -> Context:
        now = self._step_of_day(result)
        return Context(
            design_kwh=self._design_kwh,
            tariff=self._tariff,
            peak_kw=self._peak_before_kw,
            bills=self._bills,
            price_per_kwh=self._price_per_kwh[now],
            rush=self._rush[now],
        )

    def _step_of_day(self, result: StepResult) -> I64:
        """Counted from 0 at midnight, (B,)."""
        return (self._first + result.step) % len(self._rush)


def _peak_kw(before_kw: F64, result: StepResult) -> F64:
    """Highest power of the episode, (B,)."""
    return np.maximum(before_kw, result.grid_kwh / result.step_h)


class _Reads:
    """A step that notes which of its quantities are read."""

    step_h = 1.0

    def __init__(self) -> None:
        self.names: dict[str, None] = {}

    def __getattr__(self, name: str) -> F64:
        self.names[name] = None
        return np.ones(1)


def _rush(step: I64, step_h: float) -> F64:
    """Weight of queued tasks by step of the day; 1 at the last."""
    hour, span_h = step * step_h, 24.0 - step_h - RUSH_START_H
    weight = (hour - RUSH_START_H) / span_h if span_h > 0 else np.ones(len(hour))
    return np.where(hour >= RUSH_START_H, weight, 0.0)


def share(own: Sequence[F64], a: float) -> list[F64]:
    """Collaborative rewards: R_i = a r_i + (1 - a)/2 sum of the others' (paper, section 4.5).

    Args:
        own: r_LS, r_DC and r_BAT, (B,) each.
        a: share of the own reward, 0..1.

    Returns:
        R_LS, R_DC and R_BAT, (B,) each.
    """
    total, rest = _sum(own), (1.0 - a) / (len(own) - 1)
    return [a * each + rest * (total - each) for each in own]


def _checked_scales(given: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
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
            if not number or not np.isfinite(scale):
                raise ConfigError(f"rewards of {agent}: {name} is {scale!r}; valid is a number")
    return {agent: dict(given.get(agent, DEFAULT_SCALES[agent])) for agent in AGENTS}


def _find(spec: Any) -> Reward:
    """A registered function, or one by import path."""
    module, _, name = spec.partition(":") if isinstance(spec, str) else ("", "", "")
    if isinstance(spec, str) and spec in _registered:
        return _registered[spec]
    if not module or not name or module.startswith("."):
        valid = ["default", "sustaindc", *_registered]
        raise ConfigError(
            f"rewards {spec!r}: unknown; valid: {', '.join(valid)}, a dict of agent to term to "
            "scale, a function, or its import path module:name"
        )
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"rewards {spec!r}: cannot be imported ({error})") from None
    if not callable(found):
        raise ConfigError(f"rewards {spec!r}: is a {type(found).__name__}; valid is a function")
    return found  # type: ignore[no-any-return]


def _name(function: Reward) -> str:
    """Where a function comes from."""
    kind = function if hasattr(function, "__qualname__") else type(function)
    return f"{kind.__module__}:{kind.__qualname__}"


def _by_agent(given: Mapping[Any, Any], agents: Sequence[str], size: int) -> dict[str, F64]:
    """What a user's function gives to each learning agent; what it gives to others is left out."""
    for agent in given:
        if agent not in AGENTS:
            raise SdcError(
                f"rewards function: unknown agent {agent!r}{suggestion_or_valid(agent, AGENTS)}"
            )
    for agent in agents:
        if agent not in given:
            raise SdcError(f"rewards function: returned none for {agent}")
    return {agent: _values(given[agent], agent, size) for agent in agents}


def _values(given: Any, whose: str, size: int) -> F64:
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise SdcError(
            f"rewards function: returned {given!r} for {whose}; valid is ({size},) of numbers"
        ) from None
    finite = np.isfinite(values)
    if values.shape not in ((), (size,)) or not finite.all():
        odd = "" if finite.all() else f" with {values[~finite].flat[0]}"
        raise SdcError(
            f"rewards function: returned {values.dtype} {values.shape}{odd} for {whose}; valid is "
            f"({size},) of finite numbers"
        )
    return np.broadcast_to(values, (size,))


def _together(by_agent: dict[str, F64]) -> tuple[dict[str, F64], F64]:
    return by_agent, _sum(list(by_agent.values()))


def _sum(values: Sequence[F64]) -> F64:
    """In order, whatever the size of the batch; ``np.sum`` adds up single entries in another."""
    first, *others = values
    for other in others:
        first = first + other
    return first


def table_markdown() -> str:
    """The terms as a table for the docs."""
    rows = [f"| `{n}` | {(t.__doc__ or '').split(chr(10))[0]} |" for n, t in TERMS.items()]
    return "\n".join(["| term | negative of |", "|---|---|", *rows])
