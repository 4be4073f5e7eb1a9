"""Rule-based controllers of a whole fleet.

A controller has ``reset(seed)`` and ``act(view) -> Actions``. Commands that it does not give are
neutral: work is neither deferred nor drained, the setpoint holds or follows its schedule, and the
battery idles.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sdc_taichi.control.view import View
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.plant.cooling import avoid_repeats
from sdc_taichi.types import F64, I64, Actions

SLOT_MIN = 5.0
"""Interval of trim and respond, in min."""
REQUEST_INLET_C = 27.0
"""Highest recommended inlet temperature (ASHRAE TC 9.9); a rack above it requests cooling."""
COMMANDS_OF_PART: dict[str, tuple[str, ...]] = {
    "load": ("load", "placement"),
    "cooling": ("cooling", "fan", "placement"),
    "battery": ("battery",),
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
        """Commands of the next step.

        Args:
            view: state and forecasts of B data centers before the step.

        Returns:
            Commands, each (B,) or one value for all data centers; see ``Actions``.
        """


class _WithoutMemory:
    """Controllers whose commands depend on the view alone."""

    def reset(self, seed: int | I64) -> None:
        """Do nothing: no memory."""


class Idle(_WithoutMemory):
    """Neutral commands: no work moves, the battery rests, setpoints hold or follow a schedule."""

    commands: tuple[str, ...] = ()
    """Fields of ``Actions`` that it gives."""

    def act(self, view: View) -> Actions:
        """Neutral commands."""
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
        """Commands for work, setpoint and battery, each -1, 0 or 1."""
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


class TrimAndRespond(_WithoutMemory):
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
        target_c = view.setpoint_c
        for _ in range(slots_in_step(view.state.step, view.step_h)):
            target_c = trim_and_respond(
                target_c,
                requests,
                low_c=view.limits.setpoint_low_c,
                high_c=view.limits.setpoint_high_c,
            )
        return Actions(cooling=setpoint_command(target_c, view))


class FixedSetpoint(_WithoutMemory):
    """Constant setpoint, reached with the first command.

    Args:
        setpoint_c: temperature, C, or the name of a limit: ``low`` or ``high``.
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


class Lookahead(_WithoutMemory):
    """Battery that charges and discharges by the forecast carbon intensity of a coming window.

    It charges at full power if the present intensity is in the lowest quarter of the window and
    discharges if it is in the highest quarter. It idles otherwise, and if the ratio of the lowest
    to the highest intensity exceeds the round-trip efficiency. Carbon Explorer times storage by
    forecasts in the same way (Acun et al., ASPLOS 2023).

    Args:
        hours: length of the window, in h.
    """

    commands = ("battery",)
    """Fields of ``Actions`` that it gives."""

    def __init__(self, hours: float) -> None:
        self._hours = hours

    def act(self, view: View) -> Actions:
        """Battery command alone."""
        ci = view.forecast(self._hours).ci_g_per_kwh
        pays = ci.max(axis=1) * view.limits.battery_round_trip > ci.min(axis=1)
        return Actions(battery=np.where(pays, quartile_command(ci), 0.0))


class GreedyCarbon(_WithoutMemory):
    """Work and battery by the present carbon intensity relative to the mean of a coming window.

    Above the mean, work is deferred and the battery discharges; below it, the queue drains and the
    battery charges.

    Args:
        hours: length of the window, in h.
    """

    commands = ("load", "battery")
    """Fields of ``Actions`` that it gives."""

    def __init__(self, hours: float = 24.0) -> None:
        self._hours = hours

    def act(self, view: View) -> Actions:
        """Commands for work and battery."""
        ci = view.forecast(self._hours).ci_g_per_kwh
        mean, now = ci.mean(axis=1), ci[:, 0]
        # The computed mean of a constant window can differ from its value in the last bit.
        command = np.where(np.abs(mean - now) > 1e-9 * mean, np.sign(mean - now), 0.0)
        return Actions(load=command, battery=command)


class PerAgent:
    """One controller for each of load, cooling and battery.

    A controller that has several of these parts acts once per step.

    Args:
        load: gives the load command, and the placement of work if it has one.
        cooling: gives the setpoint command, and fan speeds and placement if it has them.
        battery: gives the battery command.

    Attributes:
        commands: fields of ``Actions`` that the parts give.

    Raises:
        ConfigError: the load and the cooling controller both place work.
    """

    def __init__(self, load: Controller, cooling: Controller, battery: Controller) -> None:
        parts = {"load": load, "cooling": cooling, "battery": battery}
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
        """Reset each with the same seed."""
        for controller in self._controllers:
            controller.reset(seed)

    def act(self, view: View) -> Actions:
        """Combine the commands of the parts."""
        actions = {id(controller): controller.act(view) for controller in self._controllers}
        return Actions(
            **{name: getattr(actions[id(giver)], name) for name, giver in self._giver.items()}
        )


def commands_of(controller: Controller) -> tuple[str, ...]:
    """Fields of ``Actions`` that a controller gives; all others stay neutral.

    Args:
        controller: a controller; without an attribute ``commands`` it gives load, cooling and
            battery.
    """
    return tuple(getattr(controller, "commands", AGENTS))


def trim_and_respond(
    setpoint_c: F64,
    requests: npt.ArrayLike,
    *,
    low_c: npt.ArrayLike,
    high_c: npt.ArrayLike,
    trim_k: float = 0.1,
    respond_k: float = -0.2,
    max_respond_k: float = -0.6,
    ignored: int = 2,
) -> F64:
    """One slot of trim and respond (ASHRAE Guideline 36-2021, 5.1.14) on a supply setpoint.

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
    """Number of slots of trim and respond that end within a step.

    Args:
        step: the step, from 0.
        step_h: length of a step, in h.
    """
    minutes = round(step_h * 60.0)
    return int((step + 1) * minutes // SLOT_MIN - step * minutes // SLOT_MIN)


def setpoint_command(target_c: F64, view: View) -> F64:
    """Cooling command, in steps, (B,), that moves the setpoint to ``target_c``, in C, (B,)."""
    command = (target_c - view.setpoint_c) / view.limits.setpoint_step_k
    return avoid_repeats(command, view.cooling_last)


def quartile_command(ci_g_per_kwh: F64) -> F64:
    """Battery command by the rank of the present carbon intensity within a window.

    A value is in the lowest quarter of n values if fewer than n/4 of them are lower. A value in
    both the lowest and the highest quarter, as in a constant window, gives 0.

    Args:
        ci_g_per_kwh: carbon intensity of the window in g CO2e/kWh, the present value first, (B, n).

    Returns:
        1 (charge) in the lowest quarter, -1 (discharge) in the highest, else 0, (B,).
    """
    now, quarter = ci_g_per_kwh[:, :1], ci_g_per_kwh.shape[1] / 4.0
    low = np.count_nonzero(ci_g_per_kwh < now, axis=1) < quarter
    high = np.count_nonzero(ci_g_per_kwh > now, axis=1) < quarter
    command: F64 = low.astype(np.float64) - high.astype(np.float64)
    return command
