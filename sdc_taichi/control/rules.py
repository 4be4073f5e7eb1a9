"""Rule-based controllers of a fleet of B data centers.

A controller has ``reset(seed)`` and ``act(view) -> Actions``. Commands that a controller does not
give are neutral: work is neither deferred nor drained, the setpoint stays constant or follows its
schedule, and the battery idles.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sdc_taichi.control.view import View
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C
from sdc_taichi.optimum.objective import CARBON, Objective
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.plant.cooling import avoid_repeats
from sdc_taichi.sim.step_inputs import LIQUID_COMMANDS
from sdc_taichi.types import F64, I64, Actions

SLOT_MIN = 5.0
"""Interval at which trim and respond changes the setpoint, in min."""
REQUEST_INLET_C = RECOMMENDED_C[1]
"""Inlet temperature above which a rack requests cooling, in C: the highest one that ASHRAE TC 9.9
recommends."""
IGNORED = 2
"""Number of requests for cooling without a response (ASHRAE Guideline 36)."""
COMMANDS_OF_PART: dict[str, tuple[str, ...]] = {
    "load": ("load", "placement"),
    "cooling": ("cooling", "fan", "placement", "chilled_water"),
    "battery": ("battery",),
    "geo": ("transfer",),
    "liquid": tuple(LIQUID_COMMANDS),
}
"""Fields of ``Actions`` that each part of ``PerAgent`` may give."""
_DRAWN_STEPS = 256
"""Number of steps whose random commands are drawn at once."""


class Controller(Protocol):
    """Source of the commands of each step: any object with these two methods.

    A controller that does not give exactly load, cooling and battery has an attribute ``commands``
    with the names of the fields of ``Actions`` that it gives; see ``commands_of``.
    """

    def reset(self, seed: Any) -> None:
        """Begin an episode that does not depend on earlier ones.

        Args:
            seed: seed of all randomness: an integer, or in environments one for each data center,
                (B,).
        """

    def act(self, view: View) -> Actions:
        """Return the commands of the next step.

        Args:
            view: State and forecasts of B data centers before the step.

        Returns:
            Commands, each (B,) or one value for all data centers; see ``Actions``.
        """


class WithoutMemory:
    """Base class of controllers whose commands depend on the view alone."""

    def reset(self, seed: int | I64) -> None:
        """Do nothing, because the controller has no memory."""


class Idle(WithoutMemory):
    """Neutral commands: no work moves, the battery rests, setpoints hold or follow a schedule."""

    commands: tuple[str, ...] = ()
    """Fields of ``Actions`` that it gives."""

    def act(self, view: View) -> Actions:
        """Return neutral commands."""
        return Actions()


class Random:
    """Uniformly random commands: each of the three named actions is equally likely.

    Data center i draws from ``SeedSequence([seed, i])``, or from ``SeedSequence([seed_i, 0])`` if
    each data center has a seed, so its commands do not depend on the rest of the batch.
    """

    def __init__(self) -> None:
        self.reset(0)

    def reset(self, seed: int | I64) -> None:
        """Restart the random streams from ``seed``."""
        self._seed = seed
        self._streams: list[np.random.Generator] = []
        self._drawn = np.empty((0, 0, 3))
        self._block = -1

    def act(self, view: View) -> Actions:
        """Return random commands for work, setpoint and battery, each -1, 0 or 1."""
        block, at = divmod(view.state.step, _DRAWN_STEPS)
        if len(self._streams) != view.size or block < self._block:
            self._streams = [np.random.Generator(np.random.PCG64(s)) for s in self._seeds(view)]
            self._block = -1
        while self._block < block:
            draws = [s.integers(-1, 2, size=(_DRAWN_STEPS, 3)) for s in self._streams]
            self._drawn = np.stack(draws).astype(np.float64)
            self._block += 1
        load, cooling, battery = self._drawn[:, at].T
        return Actions(load=load, cooling=cooling, battery=battery)

    def _seeds(self, view: View) -> list[np.random.SeedSequence]:
        if np.ndim(self._seed) == 0:
            pairs = [(int(self._seed), i) for i in range(view.size)]
        else:
            pairs = [(int(seed), 0) for seed in np.asarray(self._seed)]
        return [np.random.SeedSequence(pair) for pair in pairs]


class TrimAndRespond(WithoutMemory):
    """Supply setpoint by trim and respond of ASHRAE Guideline 36 (2021), section 5.1.14.

    Every 5 min the setpoint rises a little, or falls if racks request cooling. A step of 15 min
    has three such slots, all with the requests of the previous step. A rack requests cooling if its
    hottest inlet is above 27 C.
    """

    commands = ("cooling",)
    """Fields of ``Actions`` that it gives."""

    def act(self, view: View) -> Actions:
        """Setpoint command alone."""
        if view.last is None:
            requests = np.zeros(view.size)
        else:
            hot = np.asarray(
                view.last.rack_inlet_max_c > REQUEST_INLET_C + LEAST_EXCESS_K, dtype=np.float64
            )
            requests = np.add.reduceat(hot, view.fleet.rack_offsets[:-1])
        return Actions(cooling=setpoint_command(trimmed_setpoint_c(view, requests), view))


class FixedSetpoint(WithoutMemory):
    """Controller that sets a constant setpoint with its first command.

    Args:
        setpoint_c: Setpoint, C, or ``low`` or ``high`` for the lowest or the highest setpoint.
    """

    commands = ("cooling",)
    """Fields of ``Actions`` that it gives."""

    def __init__(self, setpoint_c: float | str) -> None:
        self._setpoint_c = setpoint_c

    def act(self, view: View) -> Actions:
        """Setpoint command alone."""
        if self._setpoint_c == "low":
            target_c = view.limits.setpoint_low_c
        elif self._setpoint_c == "high":
            target_c = view.limits.setpoint_high_c
        else:
            target_c = np.full(view.size, float(self._setpoint_c))
        return Actions(cooling=setpoint_command(target_c, view))


class Rank(WithoutMemory):
    """Controller of work and battery by the rank of the present value of a kWh in a coming window.

    If the present carbon intensity, or price, is among the lowest of the window, the queue drains
    and the battery charges at full power. If it is among the highest, work is deferred and the
    battery discharges. The battery idles if the ratio of the lowest to the highest value exceeds
    the round-trip efficiency. Carbon Explorer schedules storage by forecasts in the same way (Acun
    et al., ASPLOS 2023).

    Args:
        hours: Length of the window, in h.
        share: Share of the window that counts as lowest, and as highest, 0..0.5.
        objective: Quantity of which a kWh has the value that is ranked, such as carbon or cost.
        commands: Commands that the controller gives, of ``load`` and ``battery``.
    """

    def __init__(
        self,
        hours: float,
        share: float = 0.25,
        *,
        objective: Objective = CARBON,
        commands: tuple[str, ...] = ("load", "battery"),
    ) -> None:
        self._hours, self._share, self._objective = hours, share, objective
        self.commands = commands
        """Fields of ``Actions`` that it gives."""

    def act(self, view: View) -> Actions:
        """Return commands for work and battery."""
        forecast = view.forecast(self._hours)
        values = self._objective.kwh_weight(forecast.ci_g_per_kwh, forecast.price_per_kwh)
        pays = values.max(axis=1) * view.limits.battery_round_trip > values.min(axis=1)
        command = rank_command(values, self._share)
        battery = np.where(pays, command, 0.0)
        given = {"load": command, "battery": battery}
        return Actions(**{name: given[name] for name in self.commands})


class Drain(WithoutMemory):
    """Controller of work that runs waiting work as soon as there is capacity for it."""

    commands = ("load",)
    """Fields of ``Actions`` that it gives."""

    def act(self, view: View) -> Actions:
        """Return commands that drain all queues."""
        return Actions(load=np.ones(view.size))


class GreedyCarbon(WithoutMemory):
    """Controller of work and battery that compares the carbon intensity with its forecast mean.

    If the present intensity is above the mean of the coming window, work is deferred and the
    battery discharges. If it is below the mean, the queue drains and the battery charges.

    Args:
        hours: length of the window, in h.
    """

    commands = ("load", "battery")
    """Fields of ``Actions`` that it gives."""

    def __init__(self, hours: float = 24.0) -> None:
        self._hours = hours

    def act(self, view: View) -> Actions:
        """Return commands for work and battery."""
        ci = view.forecast(self._hours).ci_g_per_kwh
        mean, now = ci.mean(axis=1), ci[:, 0]
        # The computed mean of a constant window can differ from its value in the last bit.
        command = np.where(np.abs(mean - now) > 1e-9 * mean, np.sign(mean - now), 0.0)
        return Actions(load=command, battery=command)


class PerAgent:
    """Combination of one controller each for load, cooling, battery, transfers and liquid cooling.

    A controller that is used for several of them acts only once per step.

    Args:
        load: Controller of the load command, and of the placement of work if it gives one.
        cooling: Controller of the setpoint command, and of fan speeds and placement if it gives
            them.
        battery: Controller of the battery command.
        geo: Controller of the transfers between sites of a fleet; None sends nothing.
        liquid: Controller of the commands for liquid-cooled racks; None gives none.

    Attributes:
        commands: Fields of ``Actions`` that the controllers give.

    Raises:
        ConfigError: The load controller and the cooling controller both place work.
    """

    def __init__(
        self,
        load: Controller,
        cooling: Controller,
        battery: Controller,
        geo: Controller | None = None,
        liquid: Controller | None = None,
    ) -> None:
        parts = {"load": load, "cooling": cooling, "battery": battery, "geo": geo or Idle()}
        parts["liquid"] = liquid or Idle()
        self._giver: dict[str, Controller] = {}
        for part, controller in parts.items():
            for command in COMMANDS_OF_PART[part]:
                if command not in commands_of(controller):
                    continue
                if self._giver.get(command, controller) is not controller:
                    raise ConfigError(f"controllers of load and cooling: both give {command}")
                self._giver[command] = controller
        self._controllers = list({id(c): c for c in self._giver.values()}.values())
        self.commands = tuple(self._giver)

    def reset(self, seed: int | I64) -> None:
        """Reset all controllers with the same seed."""
        for controller in self._controllers:
            controller.reset(seed)

    def act(self, view: View) -> Actions:
        """Return the combined commands of all controllers."""
        actions = {id(controller): controller.act(view) for controller in self._controllers}
        return Actions(
            **{name: getattr(actions[id(giver)], name) for name, giver in self._giver.items()}
        )


def commands_of(controller: Controller) -> tuple[str, ...]:
    """Return the fields of ``Actions`` that a controller gives; all others stay neutral.

    Args:
        controller: Controller; without an attribute ``commands``, load, cooling and battery are
            returned.
    """
    return tuple(getattr(controller, "commands", AGENTS))


def trimmed_setpoint_c(view: View, requests: npt.ArrayLike, ignored: int = IGNORED) -> F64:
    """Return the setpoint after trim and respond in all intervals of a step, in C, (B,).

    Args:
        view: The view before the step.
        requests: Number of requests for cooling, (B,).
        ignored: Number of requests without a response.
    """
    target_c = view.setpoint_c
    for _ in range(slots_in_step(view.state.step, view.step_h)):
        target_c = trim_and_respond(
            target_c,
            requests,
            low_c=view.limits.setpoint_low_c,
            high_c=view.limits.setpoint_high_c,
            ignored=ignored,
        )
    return target_c


def trim_and_respond(
    setpoint_c: F64,
    requests: npt.ArrayLike,
    *,
    low_c: npt.ArrayLike,
    high_c: npt.ArrayLike,
    trim_k: float = 0.1,
    respond_k: float = -0.2,
    max_respond_k: float = -0.6,
    ignored: int = IGNORED,
) -> F64:
    """Apply one interval of trim and respond (ASHRAE Guideline 36-2021, 5.1.14) to a setpoint.

    The setpoint moves by ``trim_k``, and with more than ``ignored`` requests R also by
    max(max_respond_k, respond_k*(R - ignored)), within its range.

    Args:
        setpoint_c: present setpoint, in C, (B,).
        requests: number of requests, (B,).
        low_c: lowest setpoint, in C, (B,) or one for all.
        high_c: highest setpoint, in C, (B,) or one for all.
        trim_k: change in every slot, positive, in K.
        respond_k: change per request beyond ``ignored``, negative, in K.
        max_respond_k: largest change by requests in a slot, negative, in K.
        ignored: number of requests without effect.

    Returns:
        The new setpoint, in C, (B,).
    """
    counted = np.maximum(np.asarray(requests, dtype=np.float64) - ignored, 0.0)
    response_k = np.maximum(max_respond_k, respond_k * counted)
    return np.clip(setpoint_c + trim_k + response_k, low_c, high_c)


def slots_in_step(step: int, step_h: float) -> int:
    """Return the number of intervals of trim and respond that end within a step."""
    minutes = round(step_h * 60.0)
    return int((step + 1) * minutes // SLOT_MIN - step * minutes // SLOT_MIN)


def setpoint_command(target_c: F64, view: View) -> F64:
    """Return the command, in setpoint steps, that moves the setpoint to ``target_c``, (B,)."""
    command = (target_c - view.setpoint_c) / view.limits.setpoint_step_k
    return avoid_repeats(command, view.cooling_last)


def rank_command(values: F64, share: float) -> F64:
    """Return a command by the rank of the present value within a window.

    A value is among the lowest of n values if fewer than ``share`` n of them are lower. A value
    that is among both the lowest and the highest, as in a constant window, gives 0.

    Args:
        values: Values in the window, present value first, (B, n).
        share: Share of the window that counts as lowest, and as highest.

    Returns:
        1 among the lowest, -1 among the highest, else 0, (B,).
    """
    now, count = values[:, :1], share * values.shape[1]
    low = np.count_nonzero(values < now, axis=1) < count
    high = np.count_nonzero(values > now, axis=1) < count
    command: F64 = low.astype(np.float64) - high.astype(np.float64)
    return command
