"""States that were damaged: refused with one error that changes nothing, or valid as they are."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from copy import deepcopy
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
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.errors import PhysicalLimitError
from sdc_taichi.sim.snapshot import HALL_LIMITS_C

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


# --- damage ---

OTHER_VALUES: list[Any] = [
    *(None, "x", b"x", True, -1, 2**70, 1.5, float("nan"), [], {}, [[1], [1, 2]], {"a": 1}),
    *(object(), np.zeros(0), np.array(["x"]), np.array(None), np.array([{}], dtype=object)),
]
NUMBERS = [np.nan, np.inf, -np.inf, -1.0, -1e-3, 0.5, 3.0, 1e3, 1e6, -1e6, 1e12, 1e300, -1e300]


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all entries of nested dicts and lists, outer ones too."""
    below = (
        list(value.items())
        if isinstance(value, dict)
        else list(enumerate(value))
        if isinstance(value, list)
        else []
    )
    return [path] * bool(path) + [leaf for k, v in below for leaf in leaves(v, (*path, k))]


def damaged_array(values: np.ndarray, rng: np.random.Generator) -> Any:
    """An array of another type, shape, or with another number in one entry."""
    kind = rng.integers(8)
    is_number = values.dtype.kind in "iuf"
    if kind == 0 and is_number:
        return values.astype(rng.choice(["float32", "int32", "int64", "float64", "O", "U9", "?"]))
    if kind == 1 and is_number:
        return rng.choice(np.array([0, 1])) + np.zeros((*values.shape, 2), dtype=values.dtype)
    if kind == 2 and values.ndim:
        return values[:-1]
    if kind == 3 and values.ndim:
        return np.concatenate([values, values])
    if kind == 4:
        return values.tolist()
    if not (values.size and is_number):
        return values.astype("O")
    out = values.copy()
    with np.errstate(all="ignore"):
        number = np.float64(rng.choice(NUMBERS))
        if values.dtype.kind in "iu":
            number = np.nan_to_num(number, nan=7, posinf=2**62, neginf=-(2**62))
            number = np.clip(number, np.iinfo(values.dtype).min / 2, np.iinfo(values.dtype).max / 2)
        out.reshape(-1)[rng.integers(out.size)] = number
    return out


def damaged(state: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """A copy of a state with one entry damaged."""
    out = deepcopy(state)
    paths = leaves(out)
    path = paths[rng.integers(len(paths))]
    where: Any = out
    for key in path[:-1]:
        where = where[key]
    last, kind = path[-1], rng.integers(6)
    value = where[last]
    if kind == 0:
        del where[last]
    elif kind == 1 and isinstance(value, dict | list):
        if isinstance(value, dict):
            value[rng.choice(["more", "step"])] = 1
        else:
            value.append(deepcopy(value[0]) if value else 1)
    elif kind == 2:
        where[last] = OTHER_VALUES[rng.integers(len(OTHER_VALUES))]
    elif isinstance(value, np.ndarray):
        where[last] = damaged_array(value, rng)
    elif isinstance(value, int | float):
        where[last] = rng.choice([-1, 0, 1, 2**63, -(2**63)]) * (value or 1)
    else:
        where[last] = OTHER_VALUES[rng.integers(len(OTHER_VALUES))]
    return out


def refusal(env: Any, state: Any) -> str | None:
    """What an environment or a simulator says against a state; None if it takes it."""
    try:
        env.load_state_dict(state)
    except SdcError as error:
        return str(error) if type(error) is SdcError else f"{type(error)}\n"
    return None


@pytest.mark.parametrize("kind", MAKERS)
def test_damaged_states_change_nothing_or_are_what_they_say(kind: str) -> None:
    env, twin = MAKERS[kind](), MAKERS[kind]()
    for one in (env, twin):
        one.reset(seed=2)
        play(one, STEPS)
    present = env.state_dict()
    other = MAKERS[kind]()
    other.reset(seed=7)
    first = other.state_dict()
    play(other, 9)
    saved = [first, other.state_dict()]
    rng = np.random.default_rng(0)
    refused = 0
    for i in range(100):
        state = damaged(saved[i % 5 > 0], rng)
        message = refusal(env, state)
        if message is not None:
            refused += 1
            assert "\n" not in message
            assert len(message) < 500
            assert equal(env.state_dict(), present), message
            continue
        # What was taken is in the state as it was given, and a run can go on from it.
        assert equal(env.state_dict(), state)
        with contextlib.suppress(PhysicalLimitError):
            for result in play(env, 2):
                assert all_finite(result if isinstance(result, dict) else result[4])
        env.load_state_dict(present)
    assert refused > 60
    assert equal(play(env, STEPS), play(twin, STEPS))


def all_finite(values: Any) -> bool:
    if isinstance(values, Mapping):
        return all(map(all_finite, values.values()))
    return bool(np.all(np.isfinite(values)))


@pytest.mark.parametrize("kind", MAKERS)
def test_a_damaged_state_leaves_what_was_not_reset_as_it_was(kind: str) -> None:
    env, other = MAKERS[kind](), MAKERS[kind]()
    other.reset(seed=7)
    play(other, STEPS)
    state = other.state_dict()
    simulator = state if isinstance(env, Simulator) else state["simulator"]
    simulator["room_heat_kwh"] = simulator["room_heat_kwh"] * 0 - 1e12
    with pytest.raises(SdcError, match=r"room_heat_kwh of entry 0 is -1e\+12; valid is"):
        env.load_state_dict(state)
    with pytest.raises(RuntimeStateError, match="call reset"):
        play(env, 1)
    fresh = MAKERS[kind]()
    for one in (env, fresh):
        one.reset(seed=3)
    assert equal(play(env, 2), play(fresh, 2))


def test_a_last_step_that_fails_changes_nothing() -> None:
    """Values within their limits from which no step can be done."""
    env, twin = (sdc_taichi.vector_env(2, CONFIG, **OPTIONS) for _ in range(2))
    for one in (env, twin):
        one.reset(seed=2)
        play(one, STEPS)
    state, present = env.state_dict(), env.state_dict()
    for name in ("server_c", "mixed_c"):
        state["simulator"][name][:] = HALL_LIMITS_C[1]
    with pytest.raises(SdcError, match=r"state: cannot be continued \(corrected: .* physical is"):
        env.load_state_dict(state)
    assert equal(env.state_dict(), present)
    assert equal(play(env, STEPS), play(twin, STEPS))


LIMITS: list[tuple[str, float, str]] = [
    ("stored_kwh", 1e9, r"stored_kwh of entry 0 is 1e\+09; valid is -"),
    ("stored_kwh", -1.0, "stored_kwh of entry 0 is -1"),
    ("queue", 1e4, "queue of entry 0, 0 is 10000; valid is 0..500"),
    ("setpoint_c", 60.0, "setpoint_c of entry 0 is 60; valid is 16..23"),
    ("fan_speed", 0.1, r"fan_speed of entry 0 is 0.1; valid is 0\.3\.\.1"),
    ("rack_status", 3, r"rack_status of entry 0 is 3; valid is 0\.\.2"),
    ("cooling_run", 6, "cooling_run of entry 0 is 6; valid is 0..5"),
    ("cooling_last", np.nan, "cooling_last is .* after 5 steps"),
    ("captured_m3s", -1.0, "captured_m3s of entry 0 is -1"),
    ("server_c", -300.0, "server_c of entry 0 is -300"),
    ("start", -96, "start of entry 0 is -96"),
    ("step", -1, r"step is -1; valid is 0..1e\+09"),
]


@pytest.mark.parametrize(("name", "value", "message"), LIMITS)
def test_limits_follow_from_the_config(name: str, value: float, message: str) -> None:
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


def test_agents_act_on_what_they_command() -> None:
    """A command of an agent that does not act here, or none of one that does, is refused."""
    env = sdc_taichi.parallel_env("tiny", days=1)
    env.reset(seed=0)
    env.step(dict.fromkeys(AGENTS, 1))
    state = env.state_dict()
    for missing in state["actions"]:
        actions = {name: value for name, value in state["actions"].items() if name != missing}
        with pytest.raises(SdcError, match="state: actions are"):
            env.load_state_dict({**state, "actions": actions})
