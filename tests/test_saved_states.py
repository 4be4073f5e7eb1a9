"""Saved states that do not fit: refused with one error that changes nothing."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest

import sdc_taichi
from eventful_hall import EVENTFUL_HALL
from sdc_taichi import (
    Actions,
    ForecastError,
    LoadAction,
    RuntimeStateError,
    SdcError,
    Simulator,
    View,
    load_config,
)

CONFIG = load_config(
    "corrected",
    [
        *EVENTFUL_HALL,
        "hvac.crac.flow_model=controlled",
        "simulation.thermal=transient",
        "workload.placement=coolest-first",
        "protection.ashrae_class=A1",
    ],
)
OPTIONS: dict[str, Any] = {
    "days": 1,
    "forecast_error": ForecastError(ci_share=0.2, temperature_k=3.0),
    "rewards": {"agent_dc": {"cost": 1.0, "demand_charge": 1.0}},
}
STEPS = 5


def play(env: Any, steps: int) -> list[Any]:
    """What an environment or a simulator gives to the same actions."""
    if isinstance(env, Simulator):
        return [env.step().per_dc() for _ in range(steps)]
    if not hasattr(env, "possible_agents"):
        return [env.step(np.ones(env.action_space.shape, dtype=np.int64)) for _ in range(steps)]
    hold = {
        agent: np.ones((2, *space.shape) if hasattr(env, "num_envs") else space.shape, np.int64)
        for agent, space in env.action_spaces.items()
    }
    return [env.step(hold) for _ in range(steps)]


class LoadByTheHour:
    """A controller of a user's own that leaves the setpoint as it is."""

    def reset(self, seed: Any) -> None:
        assert len(seed) == 2

    def act(self, view: View) -> Actions:
        return Actions(load=[LoadAction.DEFER, LoadAction.DRAIN][view.state.step % 2])


MAKERS: dict[str, Callable[[], Any]] = {
    "simulator": lambda: Simulator([CONFIG, CONFIG]),
    "steady simulator": lambda: Simulator(load_config("tiny")),
    "single": lambda: gymnasium.make("sdc_taichi/Joint-v0", config="tiny", **OPTIONS).unwrapped,
    "parallel": lambda: sdc_taichi.parallel_env(CONFIG, **OPTIONS),
    "make_vec": lambda: gymnasium.make_vec(
        "sdc_taichi/Load-v0", num_envs=2, config="tiny", days=1, others="greedy-ci"
    ),
    "vector_env": lambda: sdc_taichi.vector_env(2, CONFIG, **OPTIONS),
    "commands": lambda: sdc_taichi.vector_env(
        2,
        load_config("corrected", ["hvac.crac.flow_model=controlled", "workload.placement=weights"]),
        days=1,
        agents=["agent_dc"],
        commands={"agent_dc": ["cooling", "fan", "placement"]},
        others="greedy-ci",
    ),
    "years": lambda: sdc_taichi.vector_env(2, "tiny", days=1, years=5),
    "others": lambda: sdc_taichi.vector_env(
        2, CONFIG, days=1, agents=["agent_bat"], others=LoadByTheHour()
    ),
}


def equal(one: Any, other: Any) -> bool:
    """Whether nested values are the same to the bit and to the type."""
    if type(one) is not type(other):
        return False
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(equal(one[k], other[k]) for k in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and equal_bits(one, other)
    return bool(one == other)


def equal_bits(one: Any, other: Any) -> bool:
    return bool(np.ascontiguousarray(one).tobytes() == np.ascontiguousarray(other).tobytes())


@pytest.mark.parametrize("kind", MAKERS)
def test_every_kind_goes_on_from_what_was_saved(kind: str) -> None:
    env, other = MAKERS[kind](), MAKERS[kind]()
    env.reset(seed=2)
    play(env, STEPS)
    saved = env.state_dict()
    pickled = pickle.dumps(saved)
    expected = play(env, STEPS)
    assert pickle.dumps(saved) == pickled
    for _ in range(2):  # once more into one that is elsewhere
        other.load_state_dict(pickle.loads(pickled))
        assert equal(play(other, STEPS), expected)


@pytest.mark.parametrize("kind", MAKERS)
def test_a_damaged_state_leaves_what_was_not_reset_as_it_was(kind: str) -> None:
    env, other = MAKERS[kind](), MAKERS[kind]()
    other.reset(seed=7)
    state = other.state_dict()
    simulator = state if isinstance(env, Simulator) else state["simulator"]
    simulator["room_heat_kwh"] = simulator["room_heat_kwh"] * 0 - 1e15
    with pytest.raises(SdcError, match=r"room_heat_kwh of entry 0 is -1e\+15; valid is"):
        env.load_state_dict(state)
    with pytest.raises(RuntimeStateError, match="call reset"):
        play(env, 1)


DAMAGES: list[tuple[tuple[str, ...], Any, str]] = [
    (("keys",), None, "KeyError: 'keys'"),
    (("simulator",), [1.0], "valid is what state_dict"),
    (("options",), None, "valid is what state_dict"),
    (("options", "days"), 2, "made with days 2; valid is 1, as here"),
    (("generators",), [], "made by 0 environments; valid is 2"),
    (("generators",), [{}, {}], "valid is what state_dict"),
    (("keys",), np.array([-1, 1]), r"keys are \[-1, 1\]; valid is within 0"),
    (("keys",), np.array([1.5, 2.0]), "keys are float64"),
    (("actions",), {"load": np.zeros(2)}, r"actions are \['load'\]; valid is a dict"),
    (("actions", "load"), np.zeros(3), r"actions of load are float64 \(3,\)"),
    (("actions", "battery"), np.full(2, 9.0), "battery .* within -1..1"),
    (("actions", "load"), np.full(2, np.nan), "load .* within -1..1"),
    (("rewards",), np.full((2, 2), np.inf), r"rewards are \[\[inf"),
    (("simulator", "stored_kwh"), np.zeros(2, np.float32), "stored_kwh"),
    (("simulator", "queue"), -1e15, "queue"),
]
"""Path of an entry of a state, another value (None: without it), and what the refusal says."""


def test_damaged_states_are_refused_and_change_nothing() -> None:
    env, twin = MAKERS["vector_env"](), MAKERS["vector_env"]()
    for one in (env, twin):
        one.reset(seed=2)
        play(one, STEPS)
    for (*outer, name), value, message in DAMAGES:
        state = env.state_dict()
        where = state
        for key in outer:
            where = where[key]
        if name == "queue":
            where[name] = where[name] + value
        elif name == "keys" and value is None:
            del where[name]
        else:
            where[name] = value
        with pytest.raises(SdcError, match=message):
            env.load_state_dict(state)
    assert equal(env.state_dict(), twin.state_dict())
    assert equal(play(env, 2), play(twin, 2))


def test_a_state_from_which_no_step_is_physical_ends_the_episodes() -> None:
    env = sdc_taichi.vector_env(2, CONFIG, **OPTIONS)
    env.reset(seed=2)
    play(env, STEPS)
    state = env.state_dict()
    for name in ("server_c", "mixed_c"):
        state["simulator"][name][:] = 1e6
    seen: Any = env.load_state_dict(state)
    assert all(np.all(np.isfinite(values)) for values in seen.values())
    assert env.core.episode_over
    # The step after an end starts the next episodes.
    play(env, 1)
    assert not env.core.episode_over


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"config": "corrected"}, "another fleet"),
        ({"agents": ["agent_bat"]}, "made with agents"),
        ({"actions": "continuous"}, "made with actions 'discrete'"),
        ({"forecast_error": ForecastError(0.1)}, "made with forecast_error"),
        ({"rewards": {"agent_dc": {"pue": 1.0}}}, "made with rewards {"),
        ({"rewards": lambda result, view: -result.grid_kwh}, "made with rewards {"),
        ({"tariff": {"price_per_kwh": [0.1]}}, "made with tariff"),
    ],
)
def test_saved_by_another_environment(options: dict[str, Any], message: str) -> None:
    tiny: dict[str, Any] = {"config": "tiny", "days": 1}
    env, other = sdc_taichi.parallel_env(**tiny), sdc_taichi.parallel_env(**{**tiny, **options})
    env.reset(seed=0)
    with pytest.raises(SdcError, match=message):
        other.load_state_dict(env.state_dict())


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("stored_kwh", np.nan, "stored_kwh of entry 0 is nan"),
        ("queue", np.inf, r"queue of entry 0, 0 is inf; valid is -1e\+12..1e\+12"),
        ("fan_speed", 1.1, "fan_speed of entry 0 is 1.1; valid is 0..1"),
        ("rack_status", 3, "rack_status of entry 0 is 3; valid is 0..2"),
        ("start", -96, "start of entry 0 is -96"),
        ("step", -1, r"step is -1; valid is 0..1e\+09"),
    ],
)
def test_values_out_of_range_are_refused(name: str, value: float, message: str) -> None:
    with Simulator(CONFIG) as sim:
        sim.reset()
        play(sim, 5)
        state = sim.state_dict()
        state[name] = np.full_like(state[name], value)
        with pytest.raises(SdcError, match=message):
            sim.load_state_dict(state)


def test_an_episode_has_no_more_steps_than_it_has() -> None:
    long, short = (
        gymnasium.make_vec("sdc_taichi/Joint-v0", config="tiny", days=1, max_episode_steps=most)
        for most in (None, 3)
    )
    for env in (long, short):
        env.reset(seed=0)
    play(long, 4)
    with pytest.raises(SdcError, match="state: 4 steps; valid is at most 3, the episode"):
        short.load_state_dict(long.state_dict())  # type: ignore[attr-defined]
