"""Environments against the libraries' own checkers, and the same trajectories whichever is used."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from pettingzoo.test.state_test import state_test

import sdc_taichi
from eventful_hall import EVENTFUL_HALL
from sdc_taichi import ConfigError, EndedBy, RuntimeStateError, SdcError, load_config
from sdc_taichi.control.view import ForecastError
from sdc_taichi.envs import IDS, images
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.parallel import SdcParallelEnv
from sdc_taichi.envs.reward_terms import TERMS
from sdc_taichi.envs.single import SdcEnv
from sdc_taichi.envs.vector import SdcVectorEnv

ROOT = Path(__file__).resolve().parents[1]
STEPS = 96
SUBSETS = [subset for n in (1, 2, 3) for subset in combinations(AGENTS, n)]
SEEN: dict[str, dict[str, Any]] = {
    "default": {},
    "sustaindc": {"observations": "sustaindc"},
    "heat_map": {"heat_map": True},
}
MODES = ("discrete", "continuous")
KINDS = [(seen, mode) for seen in SEEN for mode in MODES]
"""Pairs of an observation and a kind of actions; the first pair is the default of environments."""
EVENTFUL = load_config("corrected", EVENTFUL_HALL)
BUSY: dict[str, Any] = {
    "config": EVENTFUL,
    "days": 1,
    "forecast_error": ForecastError(ci_share=0.2, temperature_k=3.0),
    "rewards": {"agent_dc": {"cost": 1.0, "hot_inlets": 0.1}},
}
"""Everything at once that is random or goes on from step to step."""

probe_warning = pytest.mark.filterwarnings(
    # What PettingZoo's checkers pass as a reset option.
    "ignore:reset options. 'options' is without effect:UserWarning"
)
advice = pytest.mark.filterwarnings(
    # PettingZoo recommends agents that are alike, and named like player_0.
    "ignore:We recommend agents to be named in the format:UserWarning",
    "ignore:Agents have different observation space sizes:UserWarning",
    "ignore:Observations are different shapes:UserWarning",
    # It knows arrays and single numbers; a heat map comes in a dict, several CRAC units have a
    # number each.
    "ignore:Observation is not a NumPy array:UserWarning",
    "ignore:Observation space for each agent probably should be:UserWarning",
    "ignore:Action space for each agent probably should be:UserWarning",
)


def tiny(**options: Any) -> dict[str, Any]:
    return {"config": "tiny", "days": 1, **options}


def playing(agents: tuple[str, ...]) -> dict[str, Any]:
    """These learn, and chance plays the rest if there is any."""
    return {"agents": agents} | ({} if agents == AGENTS else {"others": "random"})


def same(a: Any, b: Any) -> bool:
    return bool(data_equivalence(a, b, exact=True))


def rows(values: Any, i: int) -> Any:
    """Environment i of nested dicts of arrays."""
    if isinstance(values, Mapping):
        return {name: rows(value, i) for name, value in values.items()}
    return values[i]


# --- the libraries' checkers ---


@probe_warning
@pytest.mark.parametrize(
    ("agents", "seen", "mode"),
    [
        *((agents, *KINDS[0]) for agents in SUBSETS),
        *((agents, *kind) for agents in (("agent_dc",), AGENTS) for kind in KINDS[1:]),
    ],
)
def test_parallel_api(agents: tuple[str, ...], seen: str, mode: str) -> None:
    def make() -> SdcParallelEnv:
        return sdc_taichi.parallel_env(**tiny(agents=agents, actions=mode, **SEEN[seen]))

    env = make()
    whole_episode = seen == "default" and mode == "discrete"
    parallel_api_test(env, num_cycles=STEPS + 1 if whole_episode else 10)
    assert env.agents == ([] if whole_episode else list(agents))
    env.close()
    parallel_seed_test(make, num_cycles=10)


@advice
@probe_warning
@pytest.mark.parametrize("agents", [("agent_bat",), AGENTS], ids="+".join)
@pytest.mark.parametrize("seen", SEEN)
@pytest.mark.parametrize("mode", MODES)
def test_aec_api(agents: tuple[str, ...], seen: str, mode: str) -> None:
    def make() -> Any:
        return sdc_taichi.aec_env(**tiny(agents=agents, actions=mode, **SEEN[seen]))

    whole_episode = seen == "default" and mode == "discrete"
    api_test(make(), num_cycles=STEPS + 1 if whole_episode else 10)
    parallel = sdc_taichi.parallel_env(**tiny(agents=agents, actions=mode, **SEEN[seen]))
    state_test(make(), parallel, num_cycles=5)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("seen", SEEN)
@pytest.mark.parametrize("mode", MODES)
def test_gymnasium_api(name: str, seen: str, mode: str) -> None:
    env = gymnasium.make(name, **tiny(actions=mode, **SEEN[seen]))
    check_env(env.unwrapped)
    env.close()


@advice
@probe_warning
@pytest.mark.parametrize("mode", MODES)
def test_several_crac_units(mode: str) -> None:
    options = {**BUSY, "actions": mode}
    parallel_api_test(sdc_taichi.parallel_env(**options), num_cycles=STEPS + 1)
    api_test(sdc_taichi.aec_env(**options), num_cycles=10)
    for name, agent in IDS.items():
        others: dict[str, Any] = {} if agent is None else {"others": "random"}
        check_env(gymnasium.make(name, **options, **others).unwrapped)
    space = sdc_taichi.parallel_env(**options).action_space("agent_dc")
    assert space.shape == (2,)


@pytest.mark.parametrize(
    ("name", "seen", "mode", "autoreset"),
    [
        *((name, "default", "discrete", AutoresetMode.SAME_STEP) for name in IDS),
        ("sdc_taichi/Joint-v0", "default", "continuous", AutoresetMode.NEXT_STEP),
        ("sdc_taichi/Cooling-v0", "sustaindc", "discrete", AutoresetMode.NEXT_STEP),
        ("sdc_taichi/Joint-v0", "heat_map", "continuous", AutoresetMode.SAME_STEP),
    ],
)
def test_batch_is_what_gymnasium_makes_of_single_environments(
    name: str, seen: str, mode: str, autoreset: AutoresetMode
) -> None:
    options = tiny(actions=mode, **SEEN[seen])
    native = gymnasium.make_vec(name, num_envs=2, autoreset_mode=autoreset, **options)
    one_by_one = SyncVectorEnv(
        [lambda: gymnasium.make(name, disable_env_checker=True, **options)] * 2,
        autoreset_mode=autoreset,
    )
    assert isinstance(native, SdcVectorEnv)
    assert native.metadata["autoreset_mode"] is autoreset
    for part in ("observation_space", "action_space"):
        for prefix in ("", "single_"):
            assert getattr(native, prefix + part) == getattr(one_by_one, prefix + part)
    assert same(native.reset(seed=3), one_by_one.reset(seed=3))
    native.action_space.seed(0)
    ends = 0
    for step in range(STEPS + 4):
        actions = native.action_space.sample()
        given, expected = native.step(actions), one_by_one.step(actions)
        assert same(given, expected), step
        assert native.observation_space.contains(given[0])
        assert ("final_obs" in given[4]) == (given[3].all() and autoreset.value == "SameStep")
        ends += int(given[3].all())
    assert ends == 1
    native.close()
    one_by_one.close()


def test_multi_agent_batches_have_the_attributes_of_pettingzoo() -> None:
    env, parallel = multi_agent(2, **BUSY), sdc_taichi.parallel_env(**BUSY)
    assert env.num_agents == len(env.agents) == 3
    assert env.max_num_agents == parallel.max_num_agents
    assert env.unwrapped is env
    for agent in AGENTS:
        assert env.observation_space(agent) == parallel.observation_space(agent)
        assert env.action_space(agent) == parallel.action_space(agent)
        assert env.action_space(agent) is env.action_space(agent)
    with pytest.raises(ConfigError, match="agent 'agent_x': does not learn here"):
        env.action_space("agent_x")


def test_bounds_are_finite() -> None:
    for options in SEEN.values():
        for agents in SUBSETS:
            env = SdcEnv(**tiny(agents=agents, actions="continuous", **options))
            for space in (env.observation_space, env.action_space, env.state_space):
                parts = space.values() if isinstance(space, gymnasium.spaces.Dict) else [space]
                for part in parts:
                    assert isinstance(part, gymnasium.spaces.Box)
                    assert part.is_bounded()
                    assert part.dtype == np.float32


# --- the same trajectories ---


def multi_agent(num_envs: int, **options: Any) -> Any:
    return sdc_taichi.vector_env(num_envs, **options)


@pytest.mark.parametrize(
    ("agents", "heat_map", "mode"),
    [
        (("agent_ls", "agent_dc"), False, AutoresetMode.SAME_STEP),
        (("agent_bat",), True, AutoresetMode.NEXT_STEP),
        (AGENTS, False, AutoresetMode.SAME_STEP),
        (AGENTS, True, AutoresetMode.NEXT_STEP),
    ],
)
def test_alone_as_in_a_batch(agents: tuple[str, ...], heat_map: bool, mode: AutoresetMode) -> None:
    options = {**BUSY, **playing(agents), "heat_map": heat_map}
    batch = multi_agent(3, autoreset_mode=mode, **options)
    assert batch.metadata["autoreset_mode"] is mode
    singles = [sdc_taichi.parallel_env(**options) for _ in range(3)]
    found, infos = batch.reset(seed=11)
    for i, env in enumerate(singles):
        alone, info = env.reset(seed=11 + i)
        assert same(rows(found, i), alone)
        assert info == dict.fromkeys(agents, rows(infos, i))
    begun_days = infos["start_day"]
    assert len(set(begun_days)) > 1
    rng = np.random.default_rng(0)
    for step in range(STEPS + 5):
        actions = {a: rng.integers(0, 3, size=(3, *(batch.action_spaces[a].shape))) for a in agents}
        found, gained, terminated, truncated, infos = batch.step(actions)
        ended = step == STEPS - 1
        ends_here = ended and mode is AutoresetMode.SAME_STEP
        seen = infos["final_obs"] if ends_here else found
        state = infos["final_state"] if ends_here else batch.state()
        assert ("final_obs" in infos) == ("final_state" in infos) == ends_here
        for i, env in enumerate(singles):
            o, r, d, t, info = env.step(rows(actions, i))
            assert same(rows(seen, i), o), step
            assert {a: gained[a][i] for a in agents} == {a: np.float32(r[a]) for a in agents}
            assert d == {a: bool(terminated[a][i]) for a in agents}
            assert t == {a: bool(truncated[a][i]) for a in agents} == dict.fromkeys(agents, ended)
            assert np.array_equal(state[i], env.state())
            of_step = infos | ({"start_day": begun_days} if ends_here else {})
            assert info[agents[0]] == {name: of_step[name][i] for name in info[agents[0]]}
        if not ended:
            continue
        if mode is AutoresetMode.NEXT_STEP:
            found, gained, terminated, truncated, infos = batch.step({})  # ignored
            assert infos.keys() == info[agents[0]].keys()
            assert same(gained, {a: np.zeros(3, np.float32) for a in agents})
            assert same(terminated, {a: np.zeros(3, np.bool_) for a in agents})
            assert same(truncated, terminated)
        for i, env in enumerate(singles):
            again, begun = env.reset()
            assert same(rows(found, i), again)
            assert begun[agents[0]]["start_day"] == infos["start_day"][i]
            assert np.array_equal(batch.state()[i], env.state())


def test_the_same_seed_gives_the_same_episodes_after_reset() -> None:
    env = multi_agent(2, **BUSY)
    first = trajectory(env, env.reset(seed=5), STEPS + 3)
    assert same(first, trajectory(env, env.reset(seed=5), STEPS + 3))
    assert not same(first, trajectory(env, env.reset(seed=6), STEPS + 3))
    assert not same(first, trajectory(env, env.reset(), STEPS + 3))
    assert same(first, trajectory(env, env.reset(seed=[5, 6]), STEPS + 3))


def test_seeds_by_environment() -> None:
    env: Any = gymnasium.make_vec("sdc_taichi/Joint-v0", num_envs=3, **tiny())
    alone = gymnasium.make("sdc_taichi/Joint-v0", **tiny())
    found, _ = env.reset(seed=[9, 4, 9])
    assert np.array_equal(found[0], found[2])
    assert np.array_equal(found[1], alone.reset(seed=4)[0])
    # None goes on with the generator that is there.
    found, _ = env.reset(seed=[None, 4, 9])
    assert np.array_equal(found[1], alone.reset(seed=4)[0])
    assert not np.array_equal(found[0], found[2])


def trajectory(env: Any, start: Any, steps: int) -> list[Any]:
    """What a multi-agent batch gives to the same actions."""
    rng = np.random.default_rng(1)
    out = [start]
    for _ in range(steps):
        actions = {
            a: rng.integers(0, 3, size=(env.num_envs, *space.shape))
            for a, space in env.action_spaces.items()
        }
        out.append((env.step(actions), env.state()))
    return out


@pytest.mark.parametrize("saved_after", [0, 1, 40, STEPS - 1, STEPS])
def test_goes_on_from_what_was_saved(saved_after: int) -> None:
    env = multi_agent(2, **{**BUSY, **playing(("agent_ls", "agent_dc"))})
    trajectory(env, env.reset(seed=2), saved_after)
    saved = pickle.dumps(env.state_dict())
    expected = trajectory(env, None, STEPS + 10)

    other = multi_agent(2, **{**BUSY, **playing(("agent_ls", "agent_dc"))})
    seen = other.load_state_dict(pickle.loads(saved))
    assert same(trajectory(other, None, STEPS + 10), expected)
    # Once more into an environment that is elsewhere.
    assert same(other.load_state_dict(pickle.loads(saved)), seen)
    assert same(trajectory(other, None, STEPS + 10), expected)


def test_agents_of_a_saved_episode() -> None:
    action = {"agent_ls": 0, "agent_dc": 2, "agent_bat": 0}
    env, other = (sdc_taichi.parallel_env(**tiny()) for _ in range(2))
    env.reset(seed=1)
    found: dict[str, Any] = {}
    for _ in range(STEPS):
        middle, found = found, env.step(action)[0]
    assert env.agents == []
    assert same(other.load_state_dict(env.state_dict()), found)
    assert other.agents == []
    env.reset(seed=1)
    assert not same(middle, found)
    saved = env.state_dict()
    other.load_state_dict(saved)
    assert other.agents == list(AGENTS)
    assert same(other.step(action), env.step(action))


def test_across_spawned_processes() -> None:
    options = {**BUSY, "agents": AGENTS}
    name = "sdc_taichi:sdc_taichi/Joint-v0"
    native = gymnasium.make_vec(name, num_envs=2, autoreset_mode="NextStep", **options)

    def make() -> Any:
        return gymnasium.make(name, **options)

    spawned = AsyncVectorEnv([make, make], context="spawn")
    try:
        assert same(spawned.reset(seed=8), native.reset(seed=8))
        native.action_space.seed(0)
        for step in range(STEPS + 3):
            actions = native.action_space.sample()
            assert same(spawned.step(actions), native.step(actions)), step
    finally:
        spawned.close()


@pytest.mark.skipif(sys.platform == "win32", reason="no fork on Windows")
def test_a_fork_after_the_start_is_refused() -> None:
    code = """
import gymnasium, sdc_taichi
from gymnasium.vector import AsyncVectorEnv
make = lambda: gymnasium.make("sdc_taichi/Joint-v0", config="tiny", days=1)
make().reset(seed=0)
forked = AsyncVectorEnv([make, make], context="fork")
try:
    forked.reset(seed=0)
except sdc_taichi.RuntimeStateError as error:
    print("refused:", error)
forked.close(terminate=True)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.startswith("refused: this process was forked after Taichi started")
    assert "'spawn'" in done.stdout


@pytest.mark.parametrize("agents", [("agent_dc",), AGENTS], ids="+".join)
def test_continuous_setpoint_changes_are_what_was_asked_for(agents: tuple[str, ...]) -> None:
    """Under the accelerating model too, which multiplies commands that are repeated exactly."""
    config = load_config("sustaindc", ["hvac.setpoint.initial_c=18"])
    env = sdc_taichi.parallel_env(config, agents=agents, actions="continuous", days=1)
    env.reset(seed=0)
    hold = dict.fromkeys(agents, np.zeros(1, dtype=np.float32))
    # A share of the largest change, 2 K by default.
    raised = hold | {"agent_dc": np.array([0.25], dtype=np.float32)}
    found = [env.step(raised)[4]["agent_dc"]["setpoint_c"] for _ in range(6)]
    assert found == pytest.approx([18.5, 19.0, 19.5, 20.0, 20.5, 21.0], abs=1e-6)
    slow = sdc_taichi.parallel_env(
        config, agents=agents, actions="continuous", days=1, setpoint_change_k=0.5
    )
    slow.reset(seed=0)
    lowered = hold | {"agent_dc": np.array([1.0], dtype=np.float32)}
    assert slow.step(lowered)[4]["agent_dc"]["setpoint_c"] == pytest.approx(18.5, abs=1e-6)


def test_a_reset_that_fails_changes_nothing() -> None:
    env, twin = (multi_agent(2, **tiny()) for _ in range(2))
    for one in (env, twin):
        one.reset(seed=1)
    wrong: list[dict[str, Any]] = [
        {"seed": 5, "options": {"start_day": "13-01"}},
        {"options": {"start_day": [1, 2, 3]}},
        {"seed": [1, "x"]},
    ]
    for given in wrong:
        with pytest.raises(ConfigError):
            env.reset(**given)
    for _ in range(3):
        assert same(env.reset(), twin.reset())


def test_terms_of_the_step_that_ends_an_episode() -> None:
    batches: list[Any] = [
        gymnasium.make_vec("sdc_taichi/Joint-v0", num_envs=2, autoreset_mode="SameStep", **tiny()),
        multi_agent(2, autoreset_mode="SameStep", **tiny()),
    ]
    single = SdcEnv(**tiny())
    single.reset(seed=3)
    expected: dict[str, float] = {}
    for _ in range(STEPS):
        single.step([0, 2, 0])
        expected = single.reward_terms()
    for env in batches:
        env.reset(seed=3)
        action: Any = np.array([[0, 2, 0]] * 2)
        if not isinstance(env, SdcVectorEnv):
            action = {a: action[:, i] for i, a in enumerate(AGENTS)}
        for _ in range(STEPS):
            env.step(action)
        assert env.core.view.last is None  # The next episode has begun.
        assert rows(env.reward_terms(), 0) == expected
        env.step(action)
        assert rows(env.reward_terms(), 0) != expected
        env.reset()
        assert env.reward_terms() == {}


# --- what one learner sees of several agents ---


@pytest.mark.parametrize("agents", SUBSETS, ids="+".join)
@pytest.mark.parametrize("seen", SEEN)
def test_joint_observation_has_every_feature_of_its_agents_once(
    agents: tuple[str, ...], seen: str
) -> None:
    options = tiny(agents=agents, rewards="paper", **SEEN[seen])
    joint, parallel = SdcEnv(**options), sdc_taichi.parallel_env(**options)
    rng = np.random.default_rng(0)
    whole: Any = joint.reset(seed=4)[0]
    parts: Any = parallel.reset(seed=4)[0]
    for _ in range(8):
        action = rng.integers(0, 3, size=len(agents))
        whole, reward, *_ = joint.step(action)
        parts, rewarded, *_ = parallel.step(dict(zip(agents, action, strict=True)))
        assert reward == pytest.approx(sum(rewarded.values()), rel=1e-12)
    features = parallel.core.features
    columns: dict[Any, npt.NDArray[np.float32]] = {}
    at = 0
    flat: Callable[[Any], npt.NDArray[np.float32]] = (
        (lambda o: o["features"]) if seen == "heat_map" else (lambda o: o)
    )
    for feature in dict.fromkeys(f for found in features.values() for f in found):
        columns[feature] = flat(whole)[at : at + feature.size]
        at += feature.size
    assert at == len(flat(whole))
    for agent, found in features.items():
        expected = np.concatenate([columns[f] for f in found])
        assert np.array_equal(flat(parts[agent]), expected)
        if seen == "heat_map":
            assert np.array_equal(whole["heat_map"], parts[agent]["heat_map"])


def test_one_agent_is_that_agent_of_the_parallel_environment() -> None:
    for name, agent in IDS.items():
        if agent is None:
            continue
        env = gymnasium.make(name, **tiny(others="greedy-ci"))
        parallel = sdc_taichi.parallel_env(**tiny(others="greedy-ci", agents=[agent]))
        found, _ = env.reset(seed=7)
        assert same(found, parallel.reset(seed=7)[0][agent])
        for action in (0, 1, 2, 2, 0):
            found, reward, *_, info = env.step(action)
            seen, rewarded, *_, infos = parallel.step({agent: action})
            assert same(found, seen[agent])
            assert reward == rewarded[agent]
            assert info == infos[agent]


def test_infos_are_quantities_of_the_step() -> None:
    env = multi_agent(2, **tiny())
    env.reset(seed=0)
    *_, infos = env.step(dict.fromkeys(AGENTS, np.array([1, 1])))
    view = env.core.view
    assert infos.keys() == {"start_day", "ended_by", *view.last.per_dc()}
    assert np.array_equal(infos["carbon_g"], view.last.carbon_g)
    assert np.all(infos["it_kwh"] > 0)
    assert env.reward_terms().keys() == TERMS.keys()
    single = SdcEnv(**tiny())
    day = single.reset(seed=0)[1]["start_day"]
    *_, info = single.step(np.array([1, 1, 1]))
    first = {"start_day": day, "ended_by": EndedBy.NOT_ENDED}
    assert info == first | {n: infos[n][0] for n in view.last.per_dc()}


INTERFACES: dict[str, Callable[..., Any]] = {
    "parallel_env": sdc_taichi.parallel_env,
    "aec_env": sdc_taichi.aec_env,
    "make": lambda **options: gymnasium.make("sdc_taichi/Battery-v0", **options),
    "make_joint": lambda **options: gymnasium.make("sdc_taichi/Joint-v0", **options),
    **{
        f"{kind}-{mode.value}": lambda make=make, mode=mode, **options: make(
            num_envs=2, autoreset_mode=mode, **options
        )
        for kind, make in (
            ("vector_env", sdc_taichi.vector_env),
            ("make_vec", lambda **options: gymnasium.make_vec("sdc_taichi/Joint-v0", **options)),
        )
        for mode in AutoresetMode
    },
    "sync": lambda **options: gymnasium.make_vec(
        "sdc_taichi/Battery-v0", num_envs=2, vectorization_mode="sync", **options
    ),
}
"""Every interface of the environments, in every mode of batches."""
BATCHES = [name for name in INTERFACES if name.startswith(("vector_env", "make_vec"))]


def infos_of_steps(env: Any, steps: int) -> list[dict[str, Any]]:
    """Infos of a reset and of steps with idle agents, those of the first agent where each has
    its own; ``final_info`` follows the infos that contain it."""
    out = []

    def add(infos: dict[str, Any]) -> None:
        first = next(iter(infos.values()))
        out.append(first if isinstance(first, dict) else infos)
        if "final_info" in infos:
            out.append(infos["final_info"])

    if hasattr(env, "agent_iter"):
        env.reset(seed=0)
        for agent in env.agent_iter(len(AGENTS) * steps):
            *_, over, info = env.last()
            out.append(info)
            env.step(None if over else env.action_space(agent).sample())
        return out
    add(env.reset(seed=0)[1])
    for _ in range(steps):
        if hasattr(env, "action_spaces"):
            shape = (env.num_envs,) if hasattr(env, "num_envs") else ()
            actions: Any = {a: np.ones(shape, np.int64) for a in AGENTS}
        else:
            actions = env.action_space.sample()
        *_, truncated, infos = env.step(actions)
        add(infos)
        over = np.all(list(truncated.values()) if isinstance(truncated, dict) else truncated)
        # Old versions of Gymnasium write a vector environment's mode into its environments, too.
        resets_itself = hasattr(env, "num_envs") and (
            env.metadata["autoreset_mode"] is not AutoresetMode.DISABLED
        )
        if over and not resets_itself:
            add(env.reset()[1])
    return out


@pytest.mark.parametrize("interface", INTERFACES)
def test_infos_of_reset_and_steps_have_the_same_keys_and_types(
    interface: str, request: pytest.FixtureRequest
) -> None:
    options = tiny(years=3, traces=["alibaba_1", "google_1"], costs=["hot_inlets"])
    env = INTERFACES[interface](**options)
    request.addfinalizer(env.close)
    infos = infos_of_steps(env, STEPS + 2)
    added = {"final_obs", "final_state", "final_info"}
    added |= {f"_{name}" for name in added}

    def kinds(info: dict[str, Any]) -> dict[str, Any]:
        return {
            name: (type(value), getattr(value, "dtype", None), np.shape(value))
            for name, value in info.items()
            if name not in added
        }

    assert {"start_day", "year", "trace", "it_kwh", "cost", "cost_hot_inlets"} <= infos[0].keys()
    assert np.all(infos[0]["it_kwh"] == 0.0)
    assert np.all(infos[0]["cost"] == 0.0)
    for info in infos[1:]:
        assert kinds(info) == kinds(infos[0])


def test_start_day() -> None:
    env = sdc_taichi.parallel_env(**tiny(months=[6]))
    days = {env.reset(seed=s)[1]["agent_ls"]["start_day"] for s in range(20)}
    assert len(days) > 5
    assert all(151 <= day < 181 for day in days)
    assert env.reset(options={"start_day": "03-01"})[1]["agent_ls"]["start_day"] == 59
    assert env.reset(options={"start_day": 200})[1]["agent_ls"]["start_day"] == 200
    batch = multi_agent(2, **tiny())
    _, infos = batch.reset(options={"start_day": ["01-01", "12-31"]})
    assert infos["start_day"].tolist() == [0, 364]
    fixed = SdcEnv(config=load_config("tiny", ["site.start=05-02"]), days=1, start="fixed")
    assert [fixed.reset(seed=seed)[1]["start_day"] for seed in (0, 1)] == [121, 121]


def test_bad_actions_of_one_learner() -> None:
    joint = SdcEnv(**tiny())
    joint.reset(seed=0)
    for action, message in (
        (np.array([1, 1]), "shape (1, 2), expected (1, 3)"),
        (np.array([1, 1, 3]), "agent_bat: 3; valid is 0, 1 or 2"),
        (np.array([1.0, 1.0, 1.0]), "1.0"),
        ([[1, 1], [1]], "is no array"),
        (1, "shape (1,), expected (1, 3)"),
    ):
        with pytest.raises(SdcError, match=re.escape(message)):
            joint.step(action)
    batch = SdcVectorEnv(2, **tiny(), agent="agent_bat")
    batch.reset(seed=0)
    with pytest.raises(SdcError, match=re.escape("shape (3,), expected (2,)")):
        batch.step(np.array([1, 1, 1]))


@pytest.mark.parametrize("clips", [None, True, False])
@pytest.mark.parametrize("interface", ["parallel_env", "aec_env", "make_joint", *BATCHES])
def test_actions_out_of_range_are_clipped_or_refused(interface: str, clips: bool | None) -> None:
    env = INTERFACES[interface](**tiny(actions="continuous", clip_actions=clips))
    env.reset(seed=0)

    def step(value: float) -> Any:
        if hasattr(env, "agent_iter"):
            for agent in AGENTS:
                env.step(np.full(env.action_space(agent).shape, value))
            return env.rewards
        if not hasattr(env, "action_spaces"):
            return env.step(np.full(env.action_space.shape, value))[1]
        size = (env.num_envs,) if interface in BATCHES else ()
        actions = {a: np.full((*size, *s.shape), value) for a, s in env.action_spaces.items()}
        return env.step(actions)[1]

    if clips or (clips is None and interface in BATCHES):
        rewards = [step(1.0)]
        for value in (1.0001, 7.0):
            env.reset(seed=0)
            rewards.append(step(value))
        assert all(same(one, rewards[0]) for one in rewards)
        env.reset(seed=0)
        assert not same(step(0.9), rewards[0])
    else:
        with pytest.raises(SdcError, match=r"1.0001; valid is within -1..1, or any number with"):
            step(1.0001)
    for value in (np.nan, np.inf):
        env.reset(seed=0)
        with pytest.raises(SdcError, match=f"{value}; valid is "):
            step(value)
    env.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_gymnasium_counts_the_steps_of_episodes(mode: AutoresetMode) -> None:
    batch = gymnasium.make_vec("sdc_taichi/Battery-v0", 2, autoreset_mode=mode, **tiny())
    env = RecordEpisodeStatistics(batch)
    env.reset(seed=0)
    for _ in range(2 * STEPS + 2):
        env.step(np.array([1, 1]))
    old = tuple(map(int, gymnasium.__version__.split(".")[:2])) < (1, 4)
    short = old and mode is AutoresetMode.SAME_STEP  # as docs/environments.md says
    assert list(env.length_queue) == [STEPS, STEPS, *[STEPS - short] * 2]
    env.close()


def test_clipping_is_no_part_of_a_saved_state() -> None:
    clips, refuses = (
        sdc_taichi.parallel_env(**tiny(actions="continuous", clip_actions=c)) for c in (True, False)
    )
    clips.reset(seed=0)
    clips.step({a: np.array([7.0]) for a in AGENTS})
    refuses.load_state_dict(clips.state_dict())
    idle = {a: np.array([0.0]) for a in AGENTS}
    assert same(clips.step(idle), refuses.step(idle))


@pytest.mark.parametrize("kind", ["make_vec", "vector_env"])
def test_without_autoreset_a_batch_waits_for_reset(kind: str) -> None:
    options = tiny(num_envs=2, autoreset_mode="Disabled")
    if kind == "make_vec":
        env: Any = gymnasium.make_vec("sdc_taichi/Battery-v0", **options)
        hold: Any = np.array([1, 1])
    else:
        env = multi_agent(**options)
        hold = {agent: np.ones(2, np.int64) for agent in AGENTS}
    env.reset(seed=0)
    for _ in range(STEPS):
        *_, truncated, infos = env.step(hold)
    ended = truncated.values() if isinstance(truncated, dict) else [truncated]
    assert all(flags.all() for flags in ended)
    assert "final_obs" not in infos
    with pytest.raises(RuntimeStateError, match="call reset"):
        env.step(hold)
    if kind == "make_vec":
        with pytest.raises(ConfigError, match=r"reset_mask: .*valid selects all 2"):
            env.reset(options={"reset_mask": np.array([True, False])})
        env.reset(options={"reset_mask": np.array([True, True])})
    else:
        env.reset()
    env.step(hold)


# --- malformed arguments ---


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"autoreset_mode": "never"}, "autoreset_mode 'never': valid is 'NextStep'"),
        ({"agents": ["agent_dc"]}, "the one agent here is agent_ls"),
        ({"agent": "agent_bat"}, "agent 'agent_bat': the one agent here is agent_ls"),
        (
            {"config": [load_config("tiny")] * 2},
            "num_envs 1: valid is at least 2, one for each config",
        ),
    ],
)
def test_batches_that_cannot_be_made(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        gymnasium.make_vec("sdc_taichi/Load-v0", num_envs=1, **tiny(**options))


def test_several_configs() -> None:
    configs = [load_config("corrected"), load_config("corrected", ["name=other"])]
    assert sdc_taichi.vector_env(config=configs, days=1).num_envs == 2
    with pytest.raises(ConfigError, match="config: 2 data centers; valid is one"):
        sdc_taichi.parallel_env(configs)
    configs[1] = load_config("corrected", ["hvac.crac.units=2"])
    with pytest.raises(ConfigError, match=r"\(hvac\.crac\.units\); it is \[1, 2\]"):
        sdc_taichi.vector_env(config=configs)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"options": {"start_day": "13-01"}}, "start_day '13-01': valid is MM-DD"),
        ({"options": {"start_day": 365}}, "start_day 365"),
        ({"options": {"start_day": 1.5}}, "start_day 1.5"),
        ({"options": {"start_day": [1, 2, 3]}}, "start_day: 3 days"),
        ({"seed": -1}, "seed -1"),
        ({"seed": "x"}, "seed 'x'"),
        ({"seed": 1.0}, "seed 1.0"),
        ({"seed": [1, 2, 3]}, "3 for"),
        ({"options": [1]}, "reset options [1]: valid is a dict"),
        ({"options": {"start_dy": 3}}, "reset options: unknown 'start_dy'; did you mean"),
    ],
)
def test_malformed_arguments_of_reset(arguments: dict[str, Any], message: str) -> None:
    for env in (SdcEnv(**tiny()), multi_agent(2, **tiny()), SdcVectorEnv(2, **tiny())):
        with pytest.raises(ConfigError, match=re.escape(message)):
            env.reset(**arguments)


def test_pettingzoo_only_warns_of_an_unknown_reset_option() -> None:
    """PettingZoo's own checkers pass an option that no environment knows."""
    parallel = sdc_taichi.parallel_env(**tiny())
    with pytest.warns(UserWarning, match="'start_dy' is without effect; did you mean 'start_day'"):
        parallel.reset(options={"start_dy": 3})


@pytest.mark.parametrize(
    ("mode", "actions", "message"),
    [
        ("discrete", None, "valid is a dict of"),
        ("discrete", {"agent_ls": 1, "agent_bat": 1}, "none for agent_dc"),
        ("discrete", dict.fromkeys((*AGENTS, "agent_x"), 1), "['agent_x'] do not learn here"),
        ("discrete", dict.fromkeys(AGENTS, 3), "agent_ls: 3"),
        ("discrete", dict.fromkeys(AGENTS, -1), "valid is 0, 1 or 2"),
        ("discrete", dict.fromkeys(AGENTS, 1.0), "1.0"),
        ("discrete", dict.fromkeys(AGENTS, "up"), "up"),
        ("discrete", {key: [1] for key in AGENTS}, "agent_ls: shape (1, 1), expected (1,)"),
        ("continuous", {key: [1.5] for key in AGENTS}, "agent_ls: 1.5; valid is within -1..1"),
        ("continuous", {key: [np.nan] for key in AGENTS}, "nan"),
        ("continuous", dict.fromkeys(AGENTS, 0.5), "shape (1,), expected (1, 1)"),
        ("continuous", {key: ["up"] for key in AGENTS}, "up"),
    ],
)
def test_malformed_actions(mode: str, actions: Any, message: str) -> None:
    options = tiny(actions=mode) | ({"clip_actions": False} if mode == "continuous" else {})
    single, batch = sdc_taichi.parallel_env(**options), multi_agent(1, **options)
    of_batch = actions and {agent: [action] for agent, action in actions.items()}
    for env, chosen in ((single, actions), (batch, of_batch)):
        env.reset(seed=0)
        with pytest.raises(SdcError, match=re.escape(message)):
            env.step(chosen)


@pytest.mark.parametrize("kind", ["parallel_env", "SdcEnv", "SdcVectorEnv", "vector_env"])
def test_calls_before_reset_and_after_close(kind: str) -> None:
    options = tiny(render_mode="rgb_array")
    makers: dict[str, tuple[Callable[..., Any], Any]] = {
        "parallel_env": (sdc_taichi.parallel_env, dict.fromkeys(AGENTS, 1)),
        "SdcEnv": (SdcEnv, np.array([1, 1, 1])),
        "SdcVectorEnv": (SdcVectorEnv, np.array([[1, 1, 1]])),
        "vector_env": (sdc_taichi.vector_env, dict.fromkeys(AGENTS, np.array([1]))),
    }
    make, action = makers[kind]
    env = make(**options)
    calls = [lambda: env.step(action), env.state, env.render, env.reward_terms, env.state_dict]
    for call in calls:
        with pytest.raises(RuntimeStateError, match="call reset"):
            call()
    env.reset(seed=0)
    assert env.reward_terms() == {}
    env.step(action)
    saved = env.state_dict()
    env.close()
    env.close()
    for call in (env.reset, lambda: env.load_state_dict(saved), *calls):
        with pytest.raises(RuntimeStateError, match="the environment is closed; create a new"):
            call()


@pytest.mark.parametrize("kind", ["parallel_env", "SdcEnv"])
def test_an_episode_that_is_over_needs_reset(kind: str) -> None:
    env: Any = sdc_taichi.parallel_env(**tiny()) if kind == "parallel_env" else SdcEnv(**tiny())
    action: Any = dict.fromkeys(AGENTS, 1) if kind == "parallel_env" else [1, 1, 1]
    env.reset(seed=0)
    for _ in range(STEPS):
        env.step(action)
    with pytest.raises(RuntimeStateError, match="the episode is over; call reset"):
        env.step(action)


# --- pictures ---


def test_render() -> None:
    options = tiny(render_mode="rgb_array")
    single, batch = SdcEnv(**options), SdcVectorEnv(2, **options)
    single.reset(seed=0)
    before = single.render()
    single.step(np.array([1, 1, 1]))
    image = single.render()
    assert image.dtype == np.uint8
    assert image.shape == (*before.shape[:2], 3)
    assert not np.array_equal(image, before)
    batch.reset(seed=0)
    batch.step(np.array([[1, 1, 1]] * 2))
    assert np.array_equal(batch.render()[0], image)
    silent = SdcEnv(**tiny())
    silent.reset(seed=0)
    with pytest.raises(ConfigError, match="render_mode='rgb_array'"):
        silent.render()


def test_racks_have_the_colour_of_their_inlet() -> None:
    hall = load_config("corrected").hall
    hot, cold = images.colours(np.array([34.0, 16.0]))
    centres = []
    for rack in range(hall.racks):
        inlet_c = np.full(hall.racks, 16.0)
        inlet_c[rack] = 34.0
        pixels = np.all(images.hall_image(hall, inlet_c) == hot, axis=2)
        centres.append(np.argwhere(pixels).mean(axis=0))
    down, right = np.array(centres).reshape(hall.rows, hall.racks_per_row, 2).transpose(2, 0, 1)
    # The page is turned: rows stand side by side, racks of a row below each other.
    assert np.all(np.diff(right, axis=0) > 0)
    assert np.all(np.diff(down, axis=1) > 0)
    assert hot.sum() > cold.sum()
