"""The same arguments make the same environments, or the same errors, at every entry point."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import sdc_taichi
from sdc_taichi import (
    ConfigError,
    DataCenterConfig,
    EnvOptions,
    ForecastError,
    load_config,
    with_values,
)
from sdc_taichi.control import FixedSetpoint, GreedyCarbon, Idle, PerAgent
from sdc_taichi.envs import IDS
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.rewards import REWARD_SETS
from sdc_taichi.envs.single import SdcEnv
from sdc_taichi.envs.vector import SdcVectorEnv

ENTRY_POINTS: dict[str, Callable[..., Any]] = {
    "parallel_env": sdc_taichi.parallel_env,
    "aec_env": sdc_taichi.aec_env,
    "make": lambda **given: gymnasium.make("sdc_taichi/Joint-v0", **given),
    "make_vec": lambda **given: gymnasium.make_vec("sdc_taichi/Joint-v0", num_envs=2, **given),
    "vector_env": lambda **given: sdc_taichi.vector_env(2, **given),
    "SdcEnv": SdcEnv,
    "SdcVectorEnv": lambda **given: SdcVectorEnv(2, **given),
}
TINY = load_config("tiny")
COLD = "hvac.setpoint.initial_c=16"
SHORT = EnvOptions(days=2, others="greedy-ci", agents=("agent_bat",))


def made_of(env: Any) -> tuple[DataCenterConfig, EnvOptions]:
    """Config of the first data center, and the options."""
    core = getattr(env, "unwrapped", env).core
    found = core.sim.fleet.configs[0], core.options
    env.close()
    return found


# --- arguments that are valid ---

VALID: list[tuple[dict[str, Any], DataCenterConfig, EnvOptions]] = [
    ({}, load_config("corrected"), EnvOptions()),
    ({"config": "tiny"}, TINY, EnvOptions()),
    ({"config": TINY}, TINY, EnvOptions()),
    ({"config": [TINY]}, TINY, EnvOptions()),
    ({"config": "tiny", "overrides": [COLD]}, load_config("tiny", [COLD]), EnvOptions()),
    ({"config": TINY, "overrides": (COLD,)}, load_config("tiny", [COLD]), EnvOptions()),
    ({"config": [TINY], "overrides": [COLD]}, load_config("tiny", [COLD]), EnvOptions()),
    (
        {"config": "tiny", "overrides": {"hvac.setpoint.initial_c": 16}},
        with_values(TINY, {"hvac.setpoint.initial_c": 16}),
        EnvOptions(),
    ),
    (
        {"config": TINY, "overrides": {"hvac.setpoint.initial_c": 16}},
        load_config("tiny", [COLD]),
        EnvOptions(),
    ),
    ({"config": TINY, "overrides": {}}, TINY, EnvOptions()),
    ({"config": TINY, "options": EnvOptions(days=2)}, TINY, EnvOptions(days=2)),
    ({"config": TINY, "options": None, "days": 2}, TINY, EnvOptions(days=2)),
    ({"config": TINY, "options": SHORT, "days": 3}, TINY, SHORT.model_copy(update={"days": 3})),
    (
        {"config": TINY, "forecast_error": ForecastError(0.1), "months": [6]},
        TINY,
        EnvOptions(forecast_error=ForecastError(0.1), months=(6,)),
    ),
]


@pytest.mark.parametrize("entry", ENTRY_POINTS)
@pytest.mark.parametrize(("given", "config", "options"), VALID)
def test_made_alike(
    entry: str, given: dict[str, Any], config: DataCenterConfig, options: EnvOptions
) -> None:
    assert made_of(ENTRY_POINTS[entry](**given)) == (config, options)


@pytest.mark.parametrize("entry", ENTRY_POINTS)
def test_made_of_a_file(entry: str, tmp_path: Path) -> None:
    path = tmp_path / "hall.yaml"
    path.write_text("extends: tiny\nname: hall\n", encoding="utf-8")
    for source in (path, str(path)):
        config, _ = made_of(ENTRY_POINTS[entry](config=source, overrides=[COLD]))
        assert config == load_config(path, [COLD])
    # With its overrides a file may be valid that is not without them.
    path.write_text("extends: tiny\nhall: {rows: 0}\n", encoding="utf-8")
    config, _ = made_of(ENTRY_POINTS[entry](config=path, overrides=["hall.rows=2"]))
    assert config.hall.rows == 2


@pytest.mark.parametrize("name", IDS)
def test_the_ids_of_one_agent_choose_who_learns(name: str) -> None:
    agents: Any = AGENTS if IDS[name] is None else (IDS[name],)
    for options in (None, EnvOptions(days=1, agents=agents)):
        _, found = made_of(gymnasium.make(name, config=TINY, options=options))
        assert found.agents == agents
        assert found.days == (7 if options is None else 1)


def test_options_that_do_have_an_effect() -> None:
    effective: list[dict[str, Any]] = [
        {"others": "load=greedy-ci", "agents": ["agent_bat"]},
        {"others": "greedy-ci", "agents": ["agent_bat"]},
        {"others": "random", "agents": ["agent_bat"]},
        {"others": "idle", "agents": ["agent_bat"]},
        {"others": PerAgent(GreedyCarbon(), Idle(), Idle()), "agents": ["agent_bat"]},
        {"action_order": "sustaindc", "agents": ["agent_bat"]},
        {"setpoint_change_k": 1.0, "actions": "continuous", "agents": ["agent_dc"]},
        {"collaboration": 0.5, "rewards": "sustaindc"},
        {"features": {"agent_bat": ["ci"]}, "agents": ["agent_bat"]},
        {"days": np.int64(1), "months": [np.int64(2)]},
    ]
    for options in effective:
        sdc_taichi.parallel_env("tiny", **{"days": 1, **options}).close()


# --- arguments that are not ---

INVALID: list[tuple[dict[str, Any], str]] = [
    ({"dayss": 3}, "dayss: unknown key; did you mean 'days'?"),
    ({"agents": ["agent_x"]}, "agent_x"),
    ({"agents": []}, "agents"),
    ({"others": "g37", "agents": ["agent_ls"]}, "'g37': unknown"),
    ({"actions": "both"}, "actions"),
    ({"days": 0}, "days"),
    ({"precision": "f16"}, "precision 'f16'"),
    ({"config": "tinny"}, "tinny"),
    ({"config": []}, "empty list"),
    ({"config": None}, "config None: valid is a preset"),
    ({"config": 3}, "config 3: valid is a preset"),
    ({"config": ["tiny"]}, "config 'tiny': valid is"),
    ({"overrides": COLD}, f"overrides '{COLD}': valid is a list of section.key=value"),
    ({"overrides": None}, "overrides None: valid is a list of section.key=value"),
    ({"overrides": [3]}, "overrides [3]: valid is a list of section.key=value"),
    ({"overrides": {3: 4}}, "overrides {3: 4}: valid is a list of section.key=value"),
    ({"overrides": ["hall.rows"]}, "override 'hall.rows': valid is section.key=value"),
    ({"overrides": ["hall.rowss=3"]}, "hall.rowss: unknown key; did you mean 'rows'?"),
    ({"overrides": {"hall.rowss": 3}}, "hall.rowss: unknown key; did you mean 'rows'?"),
    ({"overrides": {"hall.rows": "x"}}, "hall.rows"),
    ({"options": 3}, "options 3: valid is EnvOptions, or its fields by keyword"),
    ({"options": {"days": 3}}, "options {'days': 3}: valid is EnvOptions"),
    ({"options": SHORT, "agents": AGENTS}, "others: without effect as all agents learn"),
    ({"options": SHORT, "dayss": 3}, "dayss: unknown key; did you mean 'days'?"),
    ({"days": True}, "days"),
    ({"days": "7"}, "days"),
    ({"months": [1.0]}, "months"),
    ({"others": "idle"}, "others: without effect as all agents learn"),
    ({"others": 3, "agents": ["agent_ls"]}, "others"),
    ({"others": "load=greedy-ci", "agents": ["agent_ls"]}, "without effect on load"),
    ({"others": "load=idle,cooling=g36", "agents": ["agent_ls"]}, "without effect on load"),
    ({"others": "g36", "agents": ["agent_dc"]}, "without effect on cooling"),
    ({"others": "constant:20", "agents": ["agent_dc"]}, "valid is for load, battery"),
    (
        {"others": Idle, "agents": ["agent_dc"]},
        "Idle is a class; valid is an object of it, Idle()",
    ),
    ({"others": FixedSetpoint(20), "agents": ["agent_dc"]}, "rules:FixedSetpoint': without effect"),
    ({"others": object(), "agents": ["agent_dc"]}, "has no reset(); valid is the name of a con"),
    ({"action_order": "paper", "actions": "continuous"}, "action_order: without effect"),
    ({"action_order": "paper", "agents": ["agent_ls"]}, "as agent_bat does not learn"),
    ({"setpoint_change_k": 1.0}, "setpoint_change_k: without effect"),
    (
        {"setpoint_change_k": 1.0, "actions": "continuous", "agents": ["agent_ls"]},
        "as agent_dc does not learn",
    ),
    ({"collaboration": 0.5, "rewards": "no:such"}, "collaboration: without effect"),
    ({"collaboration": 0.5, "rewards": len}, "collaboration: without effect"),
    ({"rewards": "sustain"}, "rewards 'sustain': unknown; valid: default, bill, paper, sustaindc"),
    (
        {"features": {"agent_ls": ["ci"]}, "agents": ["agent_bat"]},
        "without effect for agent_ls, which does not learn",
    ),
    ({"features": {"agent_ls": ["cii"]}}, "unknown 'cii'; did you mean 'ci'?"),
    ({"observations": "sustaindc", "ci_leads_h": [1.0]}, "ci_leads_h: without effect"),
    ({"ci_leads_h": [0.1]}, "ci_leads_h: 0.1 h"),
    ({"start": "fixed", "months": [1]}, "months: without effect"),
    ({"recorder": 3}, "recorder 3: valid is a file"),
]


@pytest.mark.parametrize(("given", "message"), INVALID)
def test_refused_alike(given: dict[str, Any], message: str) -> None:
    told = set()
    for make in ENTRY_POINTS.values():
        days = {} if "options" in given else {"days": 1}
        with pytest.raises(ConfigError, match=re.escape(message)) as error:
            make(**{"config": "tiny", **days, **given})
        told.add(str(error.value))
    assert len(told) == 1


def test_render_modes_are_checked() -> None:
    for name, make in ENTRY_POINTS.items():
        if name != "make":  # Gymnasium itself makes windows of pictures.
            with pytest.raises(ConfigError, match="render_mode 'human': valid is None or rgb_arr"):
                make(config="tiny", render_mode="human")


# --- what may be chosen, and what is there ---


@pytest.mark.parametrize(
    "option",
    [
        *({"actions": name} for name in ("discrete", "continuous")),
        *({"observations": name} for name in ("default", "sustaindc")),
        *({"start": name} for name in ("sampled", "fixed")),
        *({"rewards": name} for name in REWARD_SETS),
    ],
    ids=str,
)
def test_every_choice_makes_an_environment(option: dict[str, Any]) -> None:
    env = sdc_taichi.parallel_env("tiny", days=1, **option)
    assert env.reset(seed=0)[0].keys() == set(AGENTS)
    action: Any = [0.0] if option.get("actions") == "continuous" else 1
    actions = dict.fromkeys(AGENTS, action)
    assert env.step(actions)[1].keys() == set(AGENTS)
    env.close()
