"""Episodes for offline learning: done again they are the same, in any company."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sdc_taichi
from sdc_taichi import ConfigError, Simulator, load_config, simulate
from sdc_taichi.benchmark.episodes import Collection, Episode, FollowedOptimum, episodes
from sdc_taichi.benchmark.offline import data_set_folder, require_minari
from sdc_taichi.optimum import StoppedError
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.optimum.solve import solve
from sdc_taichi.types import Actions
from test_envs_commands import CONTROLLED, RACKS

RULES = "load=greedy-ci,cooling=g36,battery=lookahead-24h"


def collection(*controllers: str, **given: Any) -> Collection:
    """Days of preset tiny in January and July."""
    values: dict[str, Any] = {"weeks": (0, 26), "days": 1, **given}
    config = load_config("tiny", ["site.location=CA"])
    return Collection(config, controllers, **values)


def assert_done_again(episode: Episode, env: Any) -> None:
    """Do the actions of an episode in its environment and compare what comes back."""
    options = {"start_day": episode.start.day}
    observation, _ = env.reset(seed=episode.start.seed, options=options)
    np.testing.assert_array_equal(observation, episode.observations[0])
    ended = False
    for step, action in enumerate(episode.actions):
        observation, reward, _, ended, info = env.step(action)
        np.testing.assert_array_equal(observation, episode.observations[step + 1])
        assert reward == episode.rewards[step]
        for name, values in episode.infos.items():
            assert info[name] == values[step + 1]
    assert ended


@pytest.mark.parametrize(
    "given",
    [
        {},
        {
            "agent": "agent_bat",
            "environment": {
                "actions": "discrete",
                "others": "load=greedy-ci",
                "costs": ["hot_inlets"],
                "forecast_error": {"ci_share": 0.1},
            },
        },
    ],
    ids=["joint", "battery alone"],
)
def test_the_actions_of_an_episode_done_again_give_it_again(given: dict[str, Any]) -> None:
    chosen = collection("random", RULES, **given)
    with closing(chosen.make_env()) as env:
        for name in chosen.controllers:
            recorded = list(episodes(chosen, name))
            assert [(e.start.week, e.start.seed) for e in recorded] == [(0, 0), (26, 26)]
            for episode in recorded:
                assert_done_again(episode, env)
                assert episode.changed_commands == 0.0
    assert {"carbon_g", "grid_kwh", "energy_cost"} <= recorded[0].infos.keys()
    assert ("cost_hot_inlets" in recorded[0].infos) == bool(given)


def test_an_episode_is_the_same_in_any_company() -> None:
    for name in ("random", RULES):
        _, beside = episodes(collection(name), name)
        (alone,) = episodes(collection(name, weeks=(26,)), name)
        np.testing.assert_array_equal(alone.actions, beside.actions)
        np.testing.assert_array_equal(alone.observations, beside.observations)
    first, again = episodes(collection("random", weeks=(3,), repeats=2), "random")
    assert (first.start.day, first.start.seed, again.start.seed) == (21, 3, 55)
    assert np.any(first.actions != again.actions)


def test_the_optimum_of_an_agent_earns_most(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    chosen = collection(RULES, weeks=(26,), agent="agent_bat")
    returns = {}
    for name in ("idle", RULES, "random", "optimum"):
        (episode,) = episodes(chosen, name)
        returns[name] = episode.rewards.sum()
        assert episode.changed_commands == 0.0
    assert max(returns, key=lambda name: returns[name]) == "optimum"
    assert returns["random"] < returns["idle"]


def test_commands_that_no_action_gives_are_counted() -> None:
    environment = {"setpoint_change_k": 0.25}
    (episode,) = episodes(collection("coldest", weeks=(26,), environment=environment), "coldest")
    # One of three commands, until the setpoint is down.
    assert 0.0 < episode.changed_commands < 1.0 / 3.0
    assert episode.actions[0, 1] == -1.0


def test_a_stopped_collection_ends_before_its_first_episode() -> None:
    with pytest.raises(StoppedError, match="random was stopped"):
        next(episodes(collection("random"), "random", stop=lambda: True))


@pytest.mark.parametrize(
    ("controllers", "given", "message"),
    [
        ((), {}, "controllers: none"),
        (("random", "random"), {}, "'random': is given twice"),
        (("random",), {"days": 8}, r"days 8: valid is .*1\.\.7"),
        (("random",), {"environment": {"days": 3}}, r"environment\.days: is not chosen here"),
        (("random",), {"environment": {"heat_map": True}}, "valid is False"),
        (("random",), {"environment": {"rewardz": "bill"}}, "did you mean 'rewards'"),
        (("g37",), {}, "did you mean 'g36'"),
        (("optimum:joy",), {}, "'joy'; valid are carbon"),
        (("g36",), {"agent": "agent_bat"}, "gives cooling; valid is one that gives battery"),
        (
            ("optimum",),
            {"agent": "agent_bat", "environment": {"others": "g36"}},
            r"others act \(g36\)",
        ),
    ],
)
def test_what_cannot_be_collected_is_refused_in_one_line(
    controllers: tuple[str, ...], given: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        collection(*controllers, **given).check()


@pytest.mark.parametrize("name", ["tiny", "tiny-v", "../tiny-v0", "/tiny-v0", "a b-v0", "a//b-v0"])
def test_names_that_minari_does_not_take_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="valid is a name of letters"):
        data_set_folder(tmp_path, name)


def test_missing_libraries_are_named_with_their_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ConfigError, match=r"sdc-taichi\[offline\]"):
        require_minari()


def test_the_followed_optimum_reaches_what_is_achieved(tmp_path: Any, monkeypatch: Any) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    carbon = Objective(carbon=1.0)
    with Simulator([load_config("tiny", ["site.location=CA", "site.start=07-01"])]) as sim:
        figures = []
        for _ in range(2):
            sim.reset(0)
            score = Score(carbon, sim, 0)
            simulate(sim, FollowedOptimum(24, carbon), 24, on_step=score.add)
            figures.append(score.figure)
        optimum = solve(sim.fleet, steps=24, start=sim.drivers.start, drivers=sim.drivers)
    np.testing.assert_allclose(figures, [optimum.achieved] * 2, rtol=1e-6)


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_actions_of_decoded_commands_are_the_actions(actions: str) -> None:
    env = sdc_taichi.parallel_env(
        config=CONTROLLED,
        actions=actions,
        commands={"agent_ls": ["load", "placement"], "agent_dc": ["fan", "cooling"]},
        days=1,
    )
    env.reset(seed=0)
    core = env.core
    rng = np.random.default_rng(1)
    for _ in range(3):
        widths = {"agent_ls": 1 + RACKS, "agent_dc": 4, "agent_bat": 1}
        if actions == "discrete":
            actions_of_agents: Any = {a: rng.integers(3, size=(1, k)) for a, k in widths.items()}
            actions_of_agents["agent_bat"] = actions_of_agents["agent_bat"][:, 0]
        else:
            actions_of_agents = {a: rng.uniform(-1.0, 1.0, (1, k)) for a, k in widths.items()}
        commands = Actions(**core._decoder.decode(actions_of_agents, core.view))
        for agent, decoded in core.actions_of(commands).items():
            np.testing.assert_allclose(decoded, actions_of_agents[agent], rtol=1e-12)
