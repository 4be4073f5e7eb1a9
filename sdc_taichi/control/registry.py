"""Registry that makes controllers by name, for command line, environments and benchmarks."""

from __future__ import annotations

import importlib.util
import math
import re
import sys
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from sdc_taichi.control.geo import Alone, Central, all_cleaner, all_to_cleanest, three_cleanest
from sdc_taichi.control.hall_rules import HALL_RULES, hall_rule, is_hall_rule
from sdc_taichi.control.liquid_rules import (
    GreedyLoops,
    JunctionReset,
    WetBulbApproach,
    require_liquid,
)
from sdc_taichi.control.mpc import is_mpc, model_predictive
from sdc_taichi.control.rules import (
    COMMANDS_OF_PART,
    Controller,
    Drain,
    FixedSetpoint,
    GreedyCarbon,
    Idle,
    PerAgent,
    Random,
    Rank,
    TrimAndRespond,
    commands_of,
)
from sdc_taichi.control.view import limits_of
from sdc_taichi.errors import (
    ConfigError,
    place_in_user_code,
    shortened,
    suggestion,
    suggestion_or_valid,
)
from sdc_taichi.number_text import parse_number
from sdc_taichi.optimum.objective import CARBON, Objective
from sdc_taichi.optimum.problem import AGENTS, ALL_AGENTS, Agent, movable_agents
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.user_functions import check_code, import_path, imported, register_function

CONTROLLABLE: tuple[Agent, ...] = AGENTS
"""Parts of a controller spec such as ``load=NAME`` that every data center has, named like commands
of ``Actions``."""
PARTS = (*CONTROLLABLE, "geo", "liquid")
"""All valid parts of a controller spec; ``geo`` sends work between the sites of a fleet, and
``liquid`` commands liquid-cooled racks."""
ControllerMaker = Callable[[str, Fleet, tuple[str, ...]], Controller]
"""Function that makes a controller. Its arguments are the text after the colon of the controller's
name, the data centers, and the parts of the spec that use this name."""


class _NamedController(NamedTuple):
    """Built-in controller: its constructor and the agents for which it is valid."""

    make: Callable[[], Controller]
    """Function that makes the controller."""
    parts: tuple[str, ...]
    """Parts of a spec (from ``PARTS``) for which the controller is valid."""


_CONTROLLERS: dict[str, _NamedController] = {
    "idle": _NamedController(Idle, PARTS),
    "random": _NamedController(Random, CONTROLLABLE),
    "g36": _NamedController(TrimAndRespond, ("cooling",)),
    "coldest": _NamedController(lambda: FixedSetpoint("low"), ("cooling",)),
    "warmest": _NamedController(lambda: FixedSetpoint("high"), ("cooling",)),
    "lookahead-3h": _NamedController(lambda: Rank(3.0, commands=("battery",)), ("battery",)),
    "lookahead-24h": _NamedController(lambda: Rank(24.0, commands=("battery",)), ("battery",)),
    "drain": _NamedController(Drain, ("load",)),
    "greedy-ci": _NamedController(GreedyCarbon, ("load", "battery")),
    "geo-all-to-cleanest": _NamedController(lambda: Alone(all_to_cleanest), ("geo",)),
    "geo-three-cleanest": _NamedController(lambda: Alone(three_cleanest), ("geo",)),
    "geo-all-cleaner": _NamedController(lambda: Alone(all_cleaner), ("geo",)),
    "geo-central": _NamedController(Central, ("geo",)),
    "liquid-wet-bulb": _NamedController(WetBulbApproach, ("liquid",)),
    "liquid-reset": _NamedController(JunctionReset, ("liquid",)),
    "liquid-greedy": _NamedController(GreedyLoops, ("liquid",)),
    "geo-mpc": _NamedController(lambda: _fleet_predictive(), ("load", "cooling", "geo")),
}
RULES = "rules"
"""Name that stands for ``RULE_OF_AGENT``, or in a spec for the rule of its agent."""
RULE_OF_AGENT = {"load": "rank-48h:0.3", "cooling": "constant:21", "battery": "rank-12h:0.2"}
"""A rule for each agent: what ``benchmark.rules_search`` finds for carbon in the validation weeks
of suite ``carbon``, with the best setpoint that every preset allows."""
_CONSTANT = "constant:C"
_MPC = "mpc-24h"
_RANK = "rank-24h"
_RANK_NAME = re.compile(r"rank-(?P<hours>[^:]*)h(?::(?P<share>[^:]*)(?::(?P<objective>.*))?)?")
_POLICY = "policy:FOLDER"
_registered: dict[str, Any] = {"policy": "sdc_taichi.learning.controller:policy_controller"}
"""Registered makers, or their import paths, by the part of a controller name before the colon.
Import paths are resolved on first use."""
_BUILT_IN = (RULES, *_CONTROLLERS, *HALL_RULES, "constant", "policy")
_SUGGESTION = " (did you mean {!r}?)"


def controller_names() -> tuple[str, ...]:
    """Return the valid controller names.

    ``follow`` and other rules for CRAC units take temperatures, see ``control.hall_rules``.
    ``constant:C`` stands for any setpoint in C, such as ``constant:20``; ``rank-24h`` for any
    window, share and objective, such as ``rank-12h:0.3:cost``; ``mpc-24h`` for any horizon and
    objective, such as ``mpc-72h:cost``; ``policy:FOLDER`` for the folder of a training run or a
    policy. An import path ``module:name`` is also valid.
    """
    added = (name for name in _registered if name not in _BUILT_IN)
    return (*_CONTROLLERS, *HALL_RULES, RULES, _CONSTANT, _RANK, _MPC, _POLICY, *added)


def register_controller(name: str, maker: ControllerMaker | type[Any] | str) -> None:
    """Register a controller under a name that every controller option accepts.

    Args:
        name: Identifier; a spec ``name:TEXT`` passes TEXT to the maker.
        maker: Function that returns the controller, class without constructor arguments, or import
            path ``module:name`` of either. A function is called with the text after the colon, the
            fleet, and the parts of the spec (load, cooling, battery, geo, liquid) that use the
            name.

    Raises:
        ConfigError: The name is taken, or ``maker`` is neither a function nor a class.
    """
    if isinstance(maker, str):
        if not (isinstance(name, str) and name.isidentifier()) or name in _BUILT_IN:
            raise ConfigError(f"controller {shortened(name)}: valid is a name that is not taken")
        _registered[name] = maker
        return
    if isinstance(_registered.get(name), str) and name not in _BUILT_IN:
        del _registered[name]
    register_function("controller", name, maker, _registered, reserved=_BUILT_IN)


def is_path(name: str) -> bool:
    """Return True if a controller's name is an import path, False if it begins with a name."""
    kind, colon, _ = name.partition(":")
    is_named = kind in (*_registered, "constant") or is_mpc(name) or is_hall_rule(name)
    is_named |= name.startswith("rank-")
    return bool(colon) and not is_named


def make_controller(spec: str | Controller, fleet: Fleet, *, allow_code: bool = True) -> Controller:
    """Make a controller from a spec, or copy a controller.

    Args:
        spec: Name of a controller; ``agent=name`` parts joined by commas, such as
            ``load=greedy-ci,cooling=g36``, where all other agents stay idle; or a controller.
        fleet: Data centers to control.
        allow_code: True if import paths ``module:name`` are valid; False for a spec of a file,
            which may come from an untrusted source. In a command, the command line decides.

    Raises:
        ConfigError: An agent or name is unknown, a controller does not act on its agent, a constant
            setpoint is out of range, or an object is not a controller.
        SdcError: A policy cannot be read or does not fit the data centers.
    """
    if not isinstance(spec, str):
        return _copy(spec)
    named = parts_of(spec)
    if not named:
        return _make(spec.strip(), fleet, None, allow_code)
    controllers: dict[str, Controller] = {}
    for name in dict.fromkeys(named.values()):
        # Parts with the same name share one controller, so that a plan covers them together.
        parts = tuple(part for part in PARTS if named.get(part) == name)
        controllers |= dict.fromkeys(parts, _make(name, fleet, parts, allow_code))
    return PerAgent(*(controllers.get(part, Idle()) for part in PARTS))


def parts_of(spec: str) -> dict[str, str]:
    """Return the controller names by agent in a spec such as ``load=greedy-ci,cooling=g36``.

    The result is empty for a plain name, except for ``rules``, which stands for such a spec.

    Raises:
        ConfigError: An agent is unknown or appears twice.
    """
    if spec.strip() == RULES:
        return dict(RULE_OF_AGENT)
    first, sign, _ = spec.partition("=")
    if not sign or ":" in first:
        return {}
    named: dict[str, str] = {}
    for part in spec.split(","):
        agent, sign, name = (text.strip() for text in part.partition("="))
        if not sign or agent not in PARTS:
            raise ConfigError(
                f"controller {spec!r}: {part.strip()!r}: valid is agent=name with one of the "
                f"agents {', '.join(PARTS)}{suggestion(agent, PARTS, _SUGGESTION)}"
            )
        if agent in named:
            raise ConfigError(f"controller {spec!r}: {agent} is given twice; valid is each once")
        named[agent] = RULE_OF_AGENT.get(agent, name) if name == RULES else name
    return named


def controller_text(spec: str | Controller) -> str:
    """Return the spec of a controller, or the import path of its class if it is an object."""
    return spec if isinstance(spec, str) else import_path(type(spec))


def check_controller(given: Any, what: str = "") -> Controller:
    """Check that an object is a controller, and return it.

    Args:
        given: Object to check.
        what: Beginning of error messages, such as the name of the option with the controller.

    Raises:
        ConfigError: The object lacks a method, is a class, or names an unknown command.
    """
    place = f"{what}: " if what else ""
    if isinstance(given, type):
        raise ConfigError(
            f"{place}{given.__name__} is a class; valid is an object of it, {given.__name__}()"
        )
    for method in ("reset", "act"):
        if not callable(getattr(given, method, None)):
            raise ConfigError(
                f"{place}{shortened(given)} has no {method}(); valid is the name of a controller, "
                "or an object with reset(seed) and act(view)"
            )
    controller: Controller = given
    known = {name for names in COMMANDS_OF_PART.values() for name in names}
    for name in commands_of(controller):
        if name not in known:
            raise ConfigError(
                f"{place}gives {shortened(name)}{suggestion_or_valid(name, sorted(known))}"
            )
    return controller


def _copy(given: Any) -> Controller:
    """Return a deep copy of a controller, because controllers may have internal state."""
    controller = check_controller(given, "controller")
    try:
        return deepcopy(controller)
    except Exception as error:
        raise ConfigError(
            f"controller {import_path(type(given))}: cannot be copied ({error}); valid is one that "
            "copy.deepcopy copies"
        ) from None


def _make(name: str, fleet: Fleet, parts: tuple[str, ...] | None, allow_code: bool) -> Controller:
    """Make a controller by name, for the ``parts`` of a spec; None stands for a plain name."""
    kind, colon, text = name.partition(":")
    if is_mpc(name):
        if "liquid" in (parts or ()):
            require_liquid(name, fleet)
        agents = tuple(a for a in movable_agents(fleet) if parts is None or a in parts)
        entry = _NamedController(lambda: model_predictive(name, agents), ALL_AGENTS)
    elif name == RULES:
        # Specs have the rules of their agents by now, so the agent is one without a rule.
        entry = _NamedController(Idle, tuple(RULE_OF_AGENT))
    elif name.startswith("rank-"):
        commands = tuple(a for a in ("load", "battery") if parts is None or a in parts)
        entry = _NamedController(lambda: _rank(name, commands), ("load", "battery"))
    elif kind == "constant":
        entry = _NamedController(lambda: _constant(text if colon else "", fleet), ("cooling",))
    elif is_hall_rule(name):
        entry = _NamedController(lambda: hall_rule(name, fleet), ("cooling",))
    elif name in _CONTROLLERS:
        entry = _CONTROLLERS[name]
    else:
        return _made_by_maker(name, fleet, parts, allow_code)
    agent = _first_missing(parts, entry.parts)
    if agent is not None:
        able = [n for n, e in _CONTROLLERS.items() if agent in e.parts]
        of_part = {
            "cooling": [*HALL_RULES, _CONSTANT, _MPC, _POLICY],
            "geo": [],
            "liquid": [_MPC, _POLICY],
        }
        able += of_part.get(agent, [_RANK, _MPC, _POLICY])
        raise ConfigError(
            f"controller {name!r}: does not act on {agent}; valid for {agent}: {', '.join(able)}"
        )
    if name.startswith("geo-") and fleet.sites_per_fleet == 1:
        raise ConfigError(
            f"controller {name!r}: the data centers share no work; valid with a config that has "
            "section fleet, such as preset fleet_of_eight"
        )
    if name.startswith("liquid-"):
        require_liquid(name, fleet)
    return entry.make()


def _rank(name: str, commands: tuple[str, ...]) -> Controller:
    """Make a rule by rank from a name such as ``rank-24h:0.3`` or ``rank-24h:0.3:cost``."""
    match = _RANK_NAME.fullmatch(name)
    try:
        hours, share = (
            parse_number(match[x] or "0.25") if match else 0.0 for x in ("hours", "share")
        )
    except ValueError:
        hours = share = math.nan
    if match is None or not hours >= 1.0 or not 0.0 < share <= 0.5:
        raise ConfigError(
            f"controller {name!r}: valid is rank-HOURSh:SHARE or rank-HOURSh:SHARE:OBJECTIVE with "
            "1 h or more and a share above 0 and up to 0.5, such as rank-24h:0.3:cost"
        )
    objective = CARBON if match["objective"] is None else Objective.parse(match["objective"])
    if objective.water or objective.heat:
        raise ConfigError(f"controller {name!r}: valid are carbon, energy, cost, and sums of them")
    return Rank(hours, share, objective=objective, commands=commands)


def _fleet_predictive() -> Controller:
    """Make the predictive controller of fleets, whose module imports SciPy's programmes."""
    from sdc_taichi.control.geo_mpc import FleetPredictive

    return FleetPredictive()


def _first_missing(parts: tuple[str, ...] | None, valid: Sequence[str]) -> str | None:
    """Return the first of ``parts`` that is not in ``valid``, or None."""
    return next((part for part in parts or () if part not in valid), None)


def _made_by_maker(
    name: str, fleet: Fleet, parts: tuple[str, ...] | None, allow_code: bool
) -> Controller:
    """Make a controller with a registered maker, or with one whose import path is ``name``."""
    kind, _, text = name.partition(":")
    maker = _registered.get(kind)
    if maker is None:
        attribute, _, rest = text.partition(":")
        if all(part.isidentifier() for part in (*kind.split("."), attribute)):
            path, known = f"{kind}:{attribute}", ", ".join(controller_names())
            check_code(f"controller {name!r}", path, valid=known, allow_code=allow_code)
            if "." in kind or kind in sys.modules or importlib.util.find_spec(kind):
                maker, text = path, rest
    if maker is None:
        valid = controller_names()
        meant = suggestion(name, valid, _SUGGESTION)
        raise ConfigError(
            f"controller {name!r}: unknown; valid: {', '.join(valid)}, or an import path "
            f"module:name{meant}"
        )
    if isinstance(maker, str):
        maker = imported("controller", maker)
    if isinstance(maker, type):
        if text:
            raise ConfigError(f"controller {name!r}: {maker.__name__} takes no text; valid is none")
        try:
            made = maker()
        except TypeError as error:
            if place_in_user_code(error):
                raise
            raise ConfigError(
                f"controller {name!r}: {error}; valid is a class that needs no arguments, or a "
                "function of the text after the name, the fleet, and the agents it is named for"
            ) from None
    else:
        made = maker(text, fleet, parts or CONTROLLABLE)
    controller = check_controller(made, f"controller {name!r}")
    commands = commands_of(controller)
    beyond = ("geo", "liquid")
    acts_on = [*commands, *(p for p in beyond if not set(COMMANDS_OF_PART[p]).isdisjoint(commands))]
    agent = _first_missing(parts, acts_on)
    if agent is not None:
        raise ConfigError(
            f"controller {name!r}: does not act on {agent}; it gives "
            f"{', '.join(commands) or 'none'}"
        )
    return controller


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
