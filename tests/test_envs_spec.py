"""Specs of Gymnasium environments: the length of an episode, and arguments as JSON."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import data_equivalence

from sdc_taichi import ConfigError, EnvOptions, ForecastError, load_config
from sdc_taichi.config.electrical_schema import TariffConfig
from sdc_taichi.envs import IDS

STEPS = 96
TINY = load_config("tiny", ["site.location=CA"])
OPTIONS = EnvOptions(days=2, agents=("agent_bat",), others="greedy-ci")


def low_power(result: Any, view: Any) -> Any:
    """A reward with an import path."""
    return -result.grid_kwh


GIVEN: dict[str, dict[str, Any]] = {
    "nothing": {"days": 1},
    "config": {"config": TINY, "days": 1},
    "overridden": {"config": TINY, "overrides": {"hvac.crac.units": np.int64(1)}, "days": 1},
    "file": {"config": Path("config.yaml"), "days": np.int64(1)},
    "options": {"config": "tiny", "options": OPTIONS, "days": 1},
    "function": {"config": "tiny", "rewards": low_power, "days": 1},
    "nested": {
        "config": "tiny",
        "days": 1,
        "months": (6, 7),
        "forecast_error": ForecastError(0.1, 1.0),
        "tariff": TariffConfig(price_per_kwh=(0.1,)),
        "rewards": {"agent_bat": {"cost": np.float64(2.0)}},
        "features": {"agent_bat": ("soc", "ci")},
    },
}


def make_vec(spec: Any, **given: Any) -> Any:
    """A batch, of two environments unless the spec says how many."""
    if isinstance(spec, str):
        given["num_envs"] = 2
    return gymnasium.make_vec(spec, **given)


MAKERS: dict[str, Callable[..., Any]] = {"make": gymnasium.make, "make_vec": make_vec}


def played(env: Any, steps: int) -> list[Any]:
    """What an environment gives to the same actions."""
    env.action_space.seed(0)
    out = [env.reset(seed=3)]
    return out + [env.step(env.action_space.sample()) for _ in range(steps)]


@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize("how", MAKERS)
def test_an_environment_is_made_again_of_its_spec_as_json(
    how: str, given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text("extends: tiny\n", encoding="utf-8")
    make = MAKERS[how]
    env = make("sdc_taichi/Battery-v0", **GIVEN[given])
    text = env.spec.to_json()
    again = make(EnvSpec.from_json(text))
    assert data_equivalence(played(env, 5), played(again, 5), exact=True)
    for one in (env, again):
        assert one.spec.max_episode_steps == STEPS
    made_of = [one.unwrapped.state_dict()["options"] for one in (env, again)]
    assert made_of[0] == made_of[1]
    assert make(again.spec).spec == again.spec


def test_a_batch_of_several_configs_and_its_mode_are_in_the_spec() -> None:
    configs = [TINY, load_config("tiny", ["site.location=NY"])]
    env: Any = gymnasium.make_vec(
        "sdc_taichi/Joint-v0", num_envs=3, config=configs, days=1, autoreset_mode="SameStep"
    )
    again: Any = gymnasium.make_vec(EnvSpec.from_json(env.spec.to_json()))
    assert again.num_envs == 3
    assert again.metadata == env.metadata
    assert again.core.sim.fleet.configs == env.core.sim.fleet.configs
    assert data_equivalence(played(env, STEPS + 2), played(again, STEPS + 2), exact=True)


def test_what_cannot_be_imported_stays_as_it_is() -> None:
    env = gymnasium.make("sdc_taichi/Load-v0", config="tiny", rewards=lambda r, v: -r.grid_kwh)
    assert env.spec is not None
    with pytest.raises(TypeError, match="not JSON serializable"):
        env.spec.to_json()
    assert gymnasium.make(env.spec).reset(seed=0)[0].shape == env.observation_space.shape


@pytest.mark.parametrize("name", IDS)
def test_the_spec_has_the_length_of_an_episode(name: str) -> None:
    env = gymnasium.make(f"sdc_taichi:{name}", config="tiny", days=2)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 2 * STEPS
    # Episodes end by themselves; a wrapper around an environment that is made again agrees.
    assert "TimeLimit" not in str(env)
    hourly = gymnasium.make(name, config="tiny", overrides=["simulation.steps_per_hour=1"], days=30)
    assert hourly.spec is not None
    assert hourly.spec.max_episode_steps == 30 * 24


def test_both_ends_of_an_environment_made_again_agree() -> None:
    env = gymnasium.make("sdc_taichi/Battery-v0", config="tiny", days=1)
    assert env.spec is not None
    again = gymnasium.make(env.spec)
    assert "TimeLimit" in str(again)
    for one in (env, again):
        for _ in range(2):
            one.reset(seed=0)
            ends = [one.step(1)[3] for _ in range(STEPS)]
            assert ends == [False] * (STEPS - 1) + [True]


def test_fewer_steps_than_the_days_have() -> None:
    """As Gymnasium's ``TimeLimit`` around single environments."""
    given: list[Any] = [
        gymnasium.make_vec(
            "sdc_taichi/Joint-v0",
            num_envs=2,
            vectorization_mode=mode,
            config="tiny",
            days=1,
            max_episode_steps=10,
        )
        for mode in (None, "sync")
    ]
    # Gymnasium ends episodes of single environments from outside, so they do not know of it.
    batch, single = played(given[0], 25), played(given[1], 25)
    for *_, infos in (*batch, *single):
        del infos["ended_by"]
    assert data_equivalence(batch, single, exact=True)
    assert given[0].spec.max_episode_steps == 10
    assert gymnasium.make_vec(given[0].spec).spec.max_episode_steps == 10  # type: ignore[union-attr]
    no_limit: Any = gymnasium.make_vec(
        "sdc_taichi/Joint-v0", config="tiny", days=1, max_episode_steps=-1
    )
    assert no_limit.spec.max_episode_steps == STEPS
    for wrong in (0, 97, 1.5, True, "all"):
        with pytest.raises(ConfigError, match=rf"max_episode_steps {wrong!r}: valid is 1\.\.96"):
            gymnasium.make_vec(
                "sdc_taichi/Joint-v0", config="tiny", days=1, max_episode_steps=wrong
            )
