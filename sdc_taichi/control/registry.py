"""Controllers by name, for the command line and for benchmarks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sdc_taichi.control.mpc import is_mpc, model_predictive
from sdc_taichi.control.rules import (
    Controller,
    FixedSetpoint,
    GreedyCarbon,
    Idle,
    Lookahead,
    PerAgent,
    Random,
    TrimAndRespond,
)
from sdc_taichi.control.view import limits_of
from sdc_taichi.errors import ConfigError, suggestion
from sdc_taichi.number_text import parse_number
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.sim.fleet import Fleet

CONTROLLABLE = AGENTS
"""Names of the commands that a controller may give, as specs and ``Actions`` name them."""


class _NamedController(NamedTuple):
    """A controller that specs name."""

    make: Callable[[], Controller]
    """Makes the controller."""
    commands: tuple[str, ...]
    """Which of ``CONTROLLABLE`` it gives; the others it leaves neutral."""


_CONTROLLERS: dict[str, _NamedController] = {
    "idle": _NamedController(Idle, CONTROLLABLE),
    "random": _NamedController(Random, CONTROLLABLE),
    "g36": _NamedController(TrimAndRespond, ("cooling",)),
    "coldest": _NamedController(lambda: FixedSetpoint("low"), ("cooling",)),
    "warmest": _NamedController(lambda: FixedSetpoint("high"), ("cooling",)),
    "lookahead-3h": _NamedController(lambda: Lookahead(3.0), ("battery",)),
    "lookahead-24h": _NamedController(lambda: Lookahead(24.0), ("battery",)),
    "greedy-ci": _NamedController(GreedyCarbon, ("load", "battery")),
}
_CONSTANT = "constant:C"
_MPC = "mpc-24h"
_SUGGESTION = " (did you mean {!r}?)"


def controller_names() -> tuple[str, ...]:
    """Valid names.

    ``constant:C`` stands for a setpoint in C, such as ``constant:20``, and ``mpc-24h`` for any
    horizon, with or without an objective, such as ``mpc-72h:cost``.
    """
    return (*_CONTROLLERS, _CONSTANT, _MPC)


def make_controller(spec: str, fleet: Fleet) -> Controller:
    """A controller by name, or one per agent.

    Args:
        spec: a name, or ``agent=name`` parts joined by commas, such as
            ``load=greedy-ci,cooling=g36``; agents not mentioned stay idle.
        fleet: the data centers it is for.

    Raises:
        ConfigError: an unknown agent or name, a controller that does not act on the agent, or a
            constant setpoint that is out of range.
    """
    if "=" not in spec:
        return _make(spec.strip(), fleet, CONTROLLABLE)
    named: dict[str, str] = {}
    for part in spec.split(","):
        agent, sign, name = (text.strip() for text in part.partition("="))
        if not sign or agent not in CONTROLLABLE:
            raise ConfigError(
                f"controller {spec!r}: {part.strip()!r}: valid is agent=name with one of the "
                f"agents {', '.join(CONTROLLABLE)}{suggestion(agent, CONTROLLABLE, _SUGGESTION)}"
            )
        if agent in named:
            raise ConfigError(f"controller {spec!r}: {agent} is given twice")
        named[agent] = name
    made: dict[str, Controller] = {}
    chosen: dict[str, Controller] = {}
    for agent, name in named.items():
        if is_mpc(name):
            # One plan for all agents that it is named for.
            own = tuple(a for a in CONTROLLABLE if named.get(a) == name)
            chosen[agent] = made[name] = made.get(name) or model_predictive(name, own)
        else:
            chosen[agent] = _make(name, fleet, (agent,))
    return PerAgent(*(chosen.get(agent, Idle()) for agent in CONTROLLABLE))


def controlled_by(spec: str) -> tuple[str, ...]:
    """Commands that a valid spec of ``make_controller`` gives; all for ``idle`` and ``random``."""
    if "=" in spec:
        return tuple(part.partition("=")[0].strip() for part in spec.split(","))
    if is_mpc(spec.strip()):
        return CONTROLLABLE
    entry = _CONTROLLERS.get(spec.strip())
    return ("cooling",) if entry is None else entry.commands


def given_by(spec: str) -> tuple[str, ...]:
    """Commands that the controllers of a valid spec give themselves; ``idle`` gives none."""
    if "=" in spec:
        parts = (part.split("=") for part in spec.split(","))
        return tuple(agent.strip() for agent, name in parts if name.strip() != "idle")
    return () if spec.strip() == "idle" else controlled_by(spec)


def _make(name: str, fleet: Fleet, agents: tuple[str, ...]) -> Controller:
    """Look a name up, for use on any of ``agents``."""
    if is_mpc(name):
        return model_predictive(name, CONTROLLABLE)
    kind, colon, text = name.partition(":")
    if kind == "constant":
        entry = _NamedController(lambda: _constant(text if colon else "", fleet), ("cooling",))
    elif name in _CONTROLLERS:
        entry = _CONTROLLERS[name]
    else:
        valid = controller_names()
        meant = suggestion(name, valid, _SUGGESTION)
        raise ConfigError(f"controller {name!r}: unknown; valid: {', '.join(valid)}{meant}")
    if not set(agents) & set(entry.commands):
        (agent,) = agents
        able = [n for n, e in _CONTROLLERS.items() if agent in e.commands]
        able += [_CONSTANT, _MPC] if agent == "cooling" else [_MPC]
        raise ConfigError(
            f"controller {name!r}: does not act on {agent}; valid for {agent}: {', '.join(able)}"
        )
    return entry.make()


def _constant(text: str, fleet: Fleet) -> Controller:
    try:
        setpoint_c = parse_number(text)
    except ValueError:
        setpoint_c = math.nan
    limits = limits_of(fleet)
    inside = (limits.setpoint_low_c <= setpoint_c) & (setpoint_c <= limits.setpoint_high_c)
    if not inside.all():
        at = int(np.argmin(inside))
        raise ConfigError(
            f"controller 'constant:{text}': valid is a setpoint of "
            f"{limits.setpoint_low_c[at]:g}..{limits.setpoint_high_c[at]:g} C "
            f"(hvac.setpoint of {fleet.names[at]}), such as constant:20"
        )
    return FixedSetpoint(setpoint_c)
