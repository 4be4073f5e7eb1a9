"""Rewards: named terms of a step, weighed by scales and shared between agents.

Every term is at most 0 where its quantity is a cost, and about -1 at full load, so that sites and
halls of any size give rewards of one size. Terms that refer to energy are shares of what the data
center would use in a step at its design point; nothing is scaled by data of the run.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.envs.features import AGENTS
from sdc_taichi.envs.options import Tariff
from sdc_taichi.envs.released import ReleasedRewards
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.types import F64, StepResult

Reward = Callable[[StepResult, View], Any]
"""Rewards of a step, (B,), the same for all agents or by agent in a dict; gets the step and the
view after it."""

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


@dataclass(frozen=True, slots=True)
class Context:
    """What terms refer to."""

    design_kwh: F64
    """Energy of a step at the design point, (B,)."""
    tariff: Tariff
    peak_kw: F64
    """Highest power of the episode before this step, (B,)."""
    hour: F64
    """Local hour of the day at the start of the step, (B,)."""
    last_hour: float
    """Hour at the start of the last step of a day."""


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
    """Energy by the time-of-use tariff and what the step adds to the demand charge.

    Over the price of the design energy at 0.1 per kWh.
    """
    prices = np.array(c.tariff.price_per_kwh)
    price = prices[np.floor(c.hour).astype(np.int64) % len(prices)]
    above_kw = np.maximum(r.grid_kwh / r.step_h - c.peak_kw, 0.0)
    paid = r.grid_kwh * price + above_kw * c.tariff.demand_charge_per_kw
    return np.asarray(-paid / (0.1 * c.design_kwh))


def fossil_share(r: StepResult, c: Context) -> F64:
    """Energy from the grid less its renewable share, estimated as 1 - CI/FOSSIL_G_PER_KWH."""
    share = np.minimum(r.ci_g_per_kwh / FOSSIL_G_PER_KWH, 1.0)
    return -share * r.grid_kwh / c.design_kwh


def pue(r: StepResult, c: Context) -> F64:
    """HVAC power over IT power, PUE - 1; 0 without IT power."""
    return np.asarray(np.where(r.it_w > 0, -r.hvac_w / np.where(r.it_w > 0, r.it_w, 1.0), 0.0))


def water(r: StepResult, c: Context) -> F64:
    """Make-up water, over WATER_L_PER_KWH times the design energy."""
    return -r.water_l / (WATER_L_PER_KWH * c.design_kwh)


def hot_inlets(r: StepResult, c: Context) -> F64:
    """What inlets exceed the recommended 27 C by, mean over servers, K (ASHRAE TC 9.9)."""
    return -r.hot_k


def queue(r: StepResult, c: Context) -> F64:
    """Tasks queued in the last hour of the day, weighed from 0 up to 1 (paper, F.1 and F.2)."""
    span_h = c.last_hour - RUSH_START_H
    late = c.hour >= RUSH_START_H
    weight = np.where(late, (c.hour - RUSH_START_H) / span_h if span_h > 0 else 1.0, 0.0)
    return -weight * r.queue_tasks / QUEUE_SCALE_TASKS


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
        ConfigError: a name that is taken.
    """
    if name in ("default", "sustaindc") or name in _registered or not name.isidentifier():
        raise ConfigError(f"reward {name!r}: valid is a name that is not taken")
    _registered[name] = reward


class Rewards:
    """Rewards of all agents.

    Args:
        spec: ``EnvOptions.rewards``.
        collaboration: share of an agent's own reward in what it gets.
        tariff: prices for the term ``cost``.

    Raises:
        ConfigError: an unknown name, agent or term, or a path without a function.
    """

    def __init__(self, spec: Any, collaboration: float, tariff: Tariff) -> None:
        self._own, self._tariff = collaboration, tariff
        self._released = ReleasedRewards() if spec == "sustaindc" else None
        self._scales: dict[str, dict[str, float]] | None = None
        self._function: Reward | None = None
        if spec == "default":
            self._scales = DEFAULT_SCALES
        elif isinstance(spec, Mapping):
            self._scales = _checked_scales(spec)
        elif self._released is None:
            self._function = spec if callable(spec) else _find(spec)
        # Highest power of the episode, before its last step and with it.
        self._peaks_kw = np.zeros((2, 0))
        self._design_kwh = np.zeros(0)

    def reset(self, view: View) -> None:
        """Start an episode."""
        self._peaks_kw = np.zeros((2, view.size))
        self._design_kwh = view.sizing.facility_w * view.step_h / 1e3
        if self._released is not None:
            self._released.reset(view)

    def rewards(self, result: StepResult, view: View) -> dict[str, F64]:
        """Rewards of a step by agent, (B,) each, shared between agents.

        Args:
            result: the step.
            view: the view after it.

        Raises:
            SdcError: a user's function returned something of another shape, or not finite.
        """
        before_kw = self._peaks_kw[1]
        self._peaks_kw = np.stack(
            [before_kw, np.maximum(before_kw, result.grid_kwh / result.step_h)]
        )
        if self._function is not None:
            return _by_agent(self._function(result, view), view.size)
        if self._released is not None:
            own = self._released.rewards(result, view)
        else:
            own = self._weighed(result, view)
        return share(own, self._own)

    def state(self) -> F64:
        """What an episode leaves behind for its rewards: its highest power, kW, (2, B)."""
        return self._peaks_kw.copy()

    def load(self, state: F64) -> None:
        """Go on from ``state``."""
        self._peaks_kw = np.array(state)

    def terms(self, result: StepResult, view: View) -> dict[str, F64]:
        """All terms of the last step by name, (B,) each, whatever the rewards are made of."""
        context = self._context(result, view)
        return {name: term(result, context) for name, term in TERMS.items()}

    def _weighed(self, result: StepResult, view: View) -> dict[str, F64]:
        assert self._scales is not None
        context = self._context(result, view)
        wanted = {name for scales in self._scales.values() for name in scales}
        found = {name: TERMS[name](result, context) for name in wanted}
        return {
            agent: sum(
                (scale * found[name] for name, scale in self._scales[agent].items()),
                np.zeros(view.size),
            )
            for agent in AGENTS
        }

    def _context(self, result: StepResult, view: View) -> Context:
        per_day = 24 * view.fleet.steps_per_hour
        return Context(
            design_kwh=self._design_kwh,
            tariff=self._tariff,
            peak_kw=self._peaks_kw[0],
            hour=np.asarray((view.state.start + result.step) % per_day * view.step_h, np.float64),
            last_hour=24.0 - view.step_h,
        )


def share(own: Mapping[str, F64], a: float) -> dict[str, F64]:
    """Collaborative rewards: R_i = a r_i + (1 - a)/2 sum of the others' (paper, section 4.5).

    Args:
        own: r_LS, r_DC and r_BAT by agent.
        a: share of the own reward, 0..1.
    """
    total = sum(own.values(), np.zeros(1))
    rest = (1.0 - a) / (len(own) - 1)
    return {agent: a * r + rest * (total - r) for agent, r in own.items()}


def _checked_scales(given: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    for agent, scales in given.items():
        if agent not in AGENTS:
            raise ConfigError(f"rewards: unknown agent {agent!r}; {_hint(agent, AGENTS)}")
        if not isinstance(scales, Mapping):
            raise ConfigError(f"rewards of {agent}: {scales!r}; valid is a dict of term to scale")
        for name, scale in scales.items():
            if name not in TERMS:
                raise ConfigError(
                    f"rewards of {agent}: unknown term {name!r}; {_hint(name, list(TERMS))}"
                )
            if not np.isfinite(scale):
                raise ConfigError(f"rewards of {agent}: {name} is {scale}; valid is a number")
    return {agent: dict(given.get(agent, DEFAULT_SCALES[agent])) for agent in AGENTS}


def _find(spec: str) -> Reward:
    """A registered function, or one by import path."""
    if spec in _registered:
        return _registered[spec]
    module, colon, name = spec.partition(":")
    if not colon:
        valid = ["default", "sustaindc", *_registered]
        raise ConfigError(
            f"rewards {spec!r}: unknown; valid: {', '.join(valid)}, or an import path module:name"
        )
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"rewards {spec!r}: cannot be imported ({error})") from None
    if not callable(found):
        raise ConfigError(f"rewards {spec!r}: is a {type(found).__name__}; valid is a function")
    return found  # type: ignore[no-any-return]


def _by_agent(found: Any, size: int) -> dict[str, F64]:
    given = found if isinstance(found, Mapping) else dict.fromkeys(AGENTS, found)
    out = {}
    for agent in AGENTS:
        if agent not in given:
            raise SdcError(f"rewards function: returned none for {agent}")
        values = np.asarray(given[agent], dtype=np.float64)
        if values.shape not in ((), (size,)) or not np.all(np.isfinite(values)):
            raise SdcError(
                f"rewards function: returned {values.dtype} {values.shape} for {agent}; valid is "
                f"({size},) of finite numbers"
            )
        out[agent] = np.broadcast_to(values, (size,))
    return out


def _hint(name: str, valid: Sequence[str]) -> str:
    near = difflib.get_close_matches(str(name), list(valid), n=1)
    return f"did you mean {near[0]!r}?" if near else f"valid: {', '.join(valid)}"


def table_markdown() -> str:
    """The terms as a table for the docs."""
    rows = [f"| `{n}` | {(t.__doc__ or '').split(chr(10))[0]} |" for n, t in TERMS.items()]
    return "\n".join(["| term | negative of |", "|---|---|", *rows])
