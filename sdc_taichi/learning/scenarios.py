"""Scenarios: data centers, actions and rewards that go together, by name.

A scenario is a set of settings of a training, in the form of ``TrainingSettings``, beneath those
that the user gives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.features import DEFAULT_FEATURES

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
"""Sites of all scenarios."""
_FLEXIBLE = {
    "workload": {"flexible_share": 0.4, "queue_limit_h": 5.0},
    "battery": {
        "hours_of_design_load": 4.0,
        "charge_limit_c_rate": 0.25,
        "discharge_limit_c_rate": 0.25,
    },
}
"""Twice the work that may wait, and a battery of four hours."""
_BILL = {"rewards": "bill"}
_EVENTS = [
    {"kind": "crac_down", "per_year": 26, "duration_h": [2, 24]},
    {"kind": "chiller_derate", "per_year": 13, "duration_h": [2, 24], "share": 0.5},
    {"kind": "pump_down", "per_year": 6, "duration_h": [1, 8], "share": 0.5},
    {"kind": "tower_cell_down", "per_year": 13, "duration_h": [4, 48], "share": 0.5},
    {"kind": "heat_wave", "per_year": 13, "duration_h": [24, 96], "offset_k": 8},
]
_FAILURES = {
    "hvac": {"crac": {"units": 4}},
    "protection": {"ashrae_class": "A1"},
    "events": {"sampled": _EVENTS},
}
"""Four CRAC units without a spare one, servers of class A1, and failures and heat waves that come
ten times as often as in practice, so that a few weeks have some."""
_COOL = {"agent_dc": {"cooling_carbon": 10.0, "hot_inlets": 1.0}}
"""Rewards as by default, with ten times the weight of hot inlets."""
SCENARIOS: Mapping[str, Mapping[str, Any]] = {
    "carbon": {"sites": SITES},
    "carbon-rich": {"sites": SITES, "overrides": _FLEXIBLE},
    "bill": {"sites": SITES, "environment": _BILL, "validation": {"objective": "cost"}},
    "bill-rich": {
        "sites": SITES,
        "overrides": _FLEXIBLE,
        "environment": _BILL,
        "validation": {"objective": "cost"},
    },
    "failures": {
        "sites": SITES,
        "overrides": _FAILURES,
        "environment": {"rewards": _COOL, "collaboration": 1.0},
        "validation": {"optimum": False},
    },
}
"""Settings of each scenario, all of preset ``corrected``: the carbon of the hall as it is, the same
with twice the work that may wait and a battery of four hours, and of both the electricity bill,
which is energy by time of use and a demand charge; and carbon where cooling fails and hot inlets
cost."""

CI_LEADS_H = tuple(range(1, 25))
"""Leads of the forecasts of carbon intensity and price that trained agents observe, in h."""
SETPOINT_CHANGE_K = 0.5
"""Largest change of the setpoint in a step by trained agents, who hold it for some steps, in K."""
_SHAPE_OF_DAY = ("ci_rank", "ci_relative", "ci_swing")
_OWN_PARTS = ("default", "bill")
"""Rewards that pay each agent for its own part, to which those of others would add noise."""
_PRICES = ("price", "price_forecast")


def training_environment(given: Mapping[str, Any]) -> dict[str, Any]:
    """Options of environments that trainings have beneath those given.

    Actions are continuous, and agents observe the shape of the coming day by the hour: the carbon
    intensity in relation to its own range, and with rewards of the bill the price.

    Args:
        given: options that the user or a scenario gives, by name.
    """
    agents, commands = given.get("agents") or AGENTS, given.get("commands") or {}
    # What is not valid here is refused with all other options.
    agents = [x for x in agents if x in AGENTS] if isinstance(agents, list | tuple) else []
    commands = commands if isinstance(commands, Mapping) else {}
    found: dict[str, Any] = {}
    if given.get("actions", "continuous") == "continuous":
        found["actions"] = "continuous"
        decided = commands.get("agent_dc", ("cooling",))
        moves_setpoint = isinstance(decided, list | tuple) and "cooling" in decided
        if "agent_dc" in agents and moves_setpoint:
            found["setpoint_change_k"] = SETPOINT_CHANGE_K
    if given.get("rewards", "default") in _OWN_PARTS:
        found["collaboration"] = 1.0
    if given.get("observations", "default") == "default":
        found["ci_leads_h"] = CI_LEADS_H
        if not commands:
            found["features"] = {agent: _features(agent, given) for agent in agents}
    return found


def _features(agent: str, given: Mapping[str, Any]) -> tuple[str, ...]:
    """Features of an agent: its default ones, but for forecasts that others tell better."""
    names = DEFAULT_FEATURES.get(agent, ())
    if agent == "agent_dc":
        kept = [name for name in names if name != "ci_forecast"]
        return (*kept, "queue")
    kept = [name for name in names if name not in ("ci_forecast", "ci_change")]
    prices = _PRICES if given.get("rewards") == "bill" else ()
    return (*kept, *_SHAPE_OF_DAY, *prices)
