"""Recorded episodes: what is in the files, which there are, and that nothing else changes."""

from __future__ import annotations

import copy
import gc
import pickle
import socket
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from rerun.chunk import RrdReader

import sdc_taichi
from rrd import read, scalars
from sdc_taichi import EpisodeRecorder, RecordEpisodes, SdcError, StepResult, load_config
from sdc_taichi.control import View
from sdc_taichi.control.view import ForecastError
from sdc_taichi.envs.recording import capped_cubic_schedule
from sdc_taichi.viz.recorder import Recorder
from sdc_taichi.viz.recording_output import RecordingWarning

STEPS = 96
ALL: Callable[[int], bool] = lambda episode: True  # noqa: E731
EVENTFUL = load_config(
    "tiny",
    [
        "name=hall",
        "events.sampled=[{kind: heat_wave, per_year: 2000, duration_h: [1, 4], offset_k: 5}]",
    ],
)
BUSY: dict[str, Any] = {
    "config": EVENTFUL,
    "days": 1,
    "actions": "continuous",
    "forecast_error": ForecastError(ci_share=0.2, temperature_k=3.0),
    "rewards": {"agent_dc": {"cost": 1.0, "hot_inlets": 0.1}},
}
"""Everything at once that is random, or goes on from step to step."""


def lines(
    entities: dict[str, dict[str, list[Any]]], path: str
) -> dict[str, npt.NDArray[np.float64]]:
    """Lines of a plot by name."""
    (names,) = entities[path]["SeriesLines:names"]
    return dict(zip(names, scalars(entities[path]).T, strict=True))


def steps_of(path: Path, name: str = "tiny") -> list[int]:
    """Steps that a recording of a data center holds, if it has been written to its end."""
    RrdReader(path)  # warns of a recording without its index
    return read(path)[f"/dc/{name}/series/pue"]["step"]


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def same(a: Any, b: Any) -> bool:
    return bool(data_equivalence(a, b, exact=True))


def play(env: Any, steps: int, seed: int | None = 7) -> list[Any]:
    """All that an environment gives in a number of steps; what has ended is reset."""
    random = np.random.default_rng(3)
    spaces = getattr(env, "action_spaces", None)
    out = [env.reset(seed=seed)]

    def act(space: Any) -> Any:
        size = getattr(env, "num_envs", None)
        if spaces is None:
            size = None  # Gymnasium's spaces of a batch are batched
        shape = space.shape if size is None else (size, *space.shape)
        if isinstance(space, gymnasium.spaces.Box):
            return random.uniform(-1.0, 1.0, shape).astype(np.float32)
        return random.integers(0, 3, shape)

    for _ in range(steps):
        if spaces is None:
            action = act(env.action_space)
        else:
            action = {agent: act(spaces[agent]) for agent in env.agents}
        out.append(copy.deepcopy(env.step(action)))
        over = not env.agents if hasattr(env, "possible_agents") else out[-1][3] is True
        if over:
            out.append(env.reset())
    return out


def go_on(env: Any, steps: int) -> None:
    for _ in range(steps):
        env.step(dict.fromkeys(env.agents, 1))


KINDS: dict[str, Callable[..., Any]] = {
    "parallel_env": sdc_taichi.parallel_env,
    "make": lambda **options: gymnasium.make("sdc_taichi/Joint-v0", **options),
    "make_vec": lambda **options: gymnasium.make_vec("sdc_taichi/Joint-v0", num_envs=3, **options),
    "vector_env": lambda **options: sdc_taichi.vector_env(3, **options),
}


@pytest.mark.filterwarnings(
    # Gymnasium recommends -1..1; a setpoint change is in K.
    "ignore:.*For Box action spaces, we recommend using a symmetric and normalized:UserWarning"
)
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_bits_whether_recorded_or_not(kind: str, tmp_path: Path) -> None:
    make = KINDS[kind]
    recorder = EpisodeRecorder(tmp_path / "run.rrd", episode_trigger=ALL, every=1)
    recorded, plain = make(recorder=recorder, **BUSY), make(**BUSY)
    steps = STEPS + 10
    assert same(play(recorded, steps), play(plain, steps))
    recorded.close()
    plain.close()
    assert files(tmp_path) == [f"run-episode-{i}.rrd" for i in range(2)]


def test_a_recording_holds_the_steps_and_the_rewards(tmp_path: Path) -> None:
    env = sdc_taichi.parallel_env("tiny", days=1, rewards="paper", recorder=tmp_path / "run.rrd")
    played = play(env, STEPS)
    env.close()
    path = tmp_path / "run-episode-0.rrd"
    assert steps_of(path) == list(range(STEPS))
    entities = read(path)
    infos = [step[4]["agent_ls"] for step in played[1 : STEPS + 1]]
    rewards = [step[1] for step in played[1 : STEPS + 1]]
    power = lines(entities, "/dc/tiny/series/power_kw")
    np.testing.assert_allclose(power["IT [kW]"], [i["it_w"] / 1e3 for i in infos], rtol=1e-12)
    found = lines(entities, "/dc/tiny/series/rewards")
    for agent in env.possible_agents:
        np.testing.assert_array_equal(found.pop(f"{agent} [-]"), [r[agent] for r in rewards])
    # The terms that the rewards are made of: in part of step carbon and energy shares.
    assert list(found) == [f"{t} [-]" for t in ("carbon", "facility_energy", "queue", "dropped")]
    np.testing.assert_array_equal(found["dropped [-]"], [-i["dropped_tasks"] for i in infos])
    assert np.all(found["carbon [-]"] <= 0)
    assert found["carbon [-]"].min() < 0
    day = int(played[0][1]["agent_ls"]["start_day"])
    first = entities["/dc/tiny/series/pue"]["sim_time"][0]
    assert str(first) == str(np.datetime64("2018-01-01") + day) + " 00:00:00"


# --- which episodes, which environments ---


def test_default_episodes_are_those_of_record_video() -> None:
    found = [episode for episode in range(2100) if capped_cubic_schedule(episode)]
    assert found == [0, 1, 8, 27, 64, 125, 216, 343, 512, 729, 1000, 2000]


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_file_per_chosen_episode_in_every_autoreset_mode(
    mode: AutoresetMode, tmp_path: Path
) -> None:
    env: Any = gymnasium.make_vec(
        "sdc_taichi/Battery-v0",
        num_envs=2,
        config="tiny",
        days=1,
        autoreset_mode=mode,
        recorder=EpisodeRecorder(tmp_path / "run.rrd", episode_trigger=lambda e: e != 1, every=8),
    )
    env.reset(seed=0)
    started = 1
    for _ in count():
        ended = env.step(env.action_space.sample())[3].all()
        if ended and started == 3:
            break
        if ended:
            started += 1
            if mode is AutoresetMode.DISABLED:
                env.reset()
    # The last episode is over: its file is whole before anything closes it.
    assert steps_of(tmp_path / "run-episode-2.rrd", r"tiny\#0") == list(range(STEPS))
    env.close()
    names = [f"run-episode-{episode}.rrd" for episode in (0, 2)]
    assert files(tmp_path) == names
    for name in names:
        assert steps_of(tmp_path / name, r"tiny\#0") == list(range(STEPS))


def test_chosen_environments_of_one_config(tmp_path: Path) -> None:
    recorder = EpisodeRecorder(tmp_path / "run.rrd", envs=[4, 1])
    env = sdc_taichi.vector_env(6, "tiny", days=1, recorder=recorder)
    played = play(env, 20)
    env.close()
    entities = read(tmp_path / "run-episode-0.rrd")
    recorded = {path.split("/")[2] for path in entities if path.startswith("/dc/")}
    assert recorded == {r"tiny\#1", r"tiny\#4"}
    for i in (1, 4):
        power = lines(entities, rf"/dc/tiny\#{i}/series/power_kw")["IT [kW]"]
        expected = [step[4]["it_w"][i] / 1e3 for step in played[1:]]
        np.testing.assert_allclose(power, expected, rtol=1e-12)
        rewards = lines(entities, rf"/dc/tiny\#{i}/series/rewards")
        # The recording has what the environment gives in single precision.
        given = [step[1]["agent_dc"][i] for step in played[1:]]
        np.testing.assert_array_equal(rewards["agent_dc [-]"].astype(np.float32), given)
    one, other = (lines(entities, rf"/dc/tiny\#{i}/series/power_kw") for i in (1, 4))
    assert np.any(one["IT [kW]"] != other["IT [kW]"])


def test_the_wrapper_is_the_argument(tmp_path: Path) -> None:
    options: dict[str, Any] = {"num_envs": 3, "config": "tiny", "days": 1}
    settings: dict[str, Any] = {"episode_trigger": lambda e: e == 1, "envs": [2], "every": 4}
    given = EpisodeRecorder(tmp_path / "given.rrd", **settings)
    by_argument = gymnasium.make_vec("sdc_taichi/Cooling-v0", recorder=given, **options)
    inside = gymnasium.make_vec("sdc_taichi/Cooling-v0", **options)
    wrapped = RecordEpisodes(
        gymnasium.wrappers.vector.RecordEpisodeStatistics(inside),
        tmp_path / "wrapped.rrd",
        **settings,
    )
    for env in (by_argument, wrapped):
        play(env, STEPS + 1 + 5)  # the step after an episode only starts the next
        env.close()
    names = ("given", "wrapped")
    assert files(tmp_path) == [f"{name}-episode-1.rrd" for name in names]
    found = [read(tmp_path / f"{name}-episode-1.rrd") for name in names]
    for entity in ("series/power_kw", "series/rewards"):
        a, b = (lines(entities, rf"/dc/tiny\#2/{entity}") for entities in found)
        assert same(a, b)
        assert len(next(iter(a.values()))) == 5


def test_a_recorder_of_ones_own(tmp_path: Path) -> None:
    env = sdc_taichi.parallel_env("tiny", days=1, recorder=Recorder(tmp_path / "run.rrd", every=2))
    for seed in range(3):
        play(env, 5 + seed, seed)
    env.close()
    assert files(tmp_path) == ["run-2.rrd", "run.rrd"]
    assert steps_of(tmp_path / "run.rrd") == list(range(5))
    assert steps_of(tmp_path / "run-2.rrd") == list(range(6))


# --- ends ---


def test_an_environment_that_is_dropped_leaves_a_whole_file(tmp_path: Path) -> None:
    env = sdc_taichi.parallel_env("tiny", days=1, recorder=tmp_path / "run.rrd")
    play(env, 11)
    del env
    gc.collect()
    assert steps_of(tmp_path / "run-episode-0.rrd") == list(range(11))


SCRIPT = """
import os, signal, sys
import sdc_taichi

# A shell that starts the tests in the background has switched SIGINT off.
signal.signal(signal.SIGINT, signal.default_int_handler)
plain = sdc_taichi.parallel_env("tiny", days=1)
plain.reset(seed=0)
assert "rerun" not in sys.modules, "imported without a recording"
env = sdc_taichi.parallel_env("tiny", days=1, recorder=sys.argv[1])
env.reset(seed=0)
for step in range(96):
    env.step({agent: 1 for agent in env.agents})
    if step == 41:
        os.kill(os.getpid(), signal.SIGINT)
"""


def test_interrupted_training_leaves_a_whole_file(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, tmp_path / "run.rrd"],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode != 0
    *_, last = done.stderr.splitlines()
    assert last.startswith("KeyboardInterrupt"), done.stderr
    assert done.stderr.count("Traceback") == 1, done.stderr
    assert steps_of(tmp_path / "run-episode-0.rrd") == list(range(42))


# --- copies and processes ---


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies(copied: Callable[[Any], Any], tmp_path: Path) -> None:
    env = sdc_taichi.parallel_env("tiny", days=1, recorder=tmp_path / "run.rrd")
    other = copied(env)
    env.reset(seed=0)
    with pytest.raises(SdcError, match=r"cannot be copied .*before reset.*state_dict"):
        copied(env)
    env.close()
    play(other, 3)
    other.close()
    assert steps_of(tmp_path / "run-episode-0.rrd") == [0, 1, 2]


# --- bad use ---


def test_two_environments_and_one_place(tmp_path: Path) -> None:
    options: dict[str, Any] = {"config": "tiny", "days": 1}
    path, own = tmp_path / "run.rrd", Recorder(tmp_path / "own.rrd")
    make = partial(gymnasium.make, "sdc_taichi/Load-v0", recorder=str(path), **options)
    both = SyncVectorEnv([make, make])
    with pytest.raises(SdcError, match=r"run-episode-0\.rrd: another environment"):
        both.reset(seed=0)
    both.close()
    first, second = (sdc_taichi.parallel_env(recorder=own, **options) for _ in range(2))
    first.reset(seed=0)
    with pytest.raises(SdcError, match=r"own\.rrd: another environment"):
        second.reset(seed=0)
    play(first, 2)
    first.close()
    play(second, 3)
    second.close()
    assert files(tmp_path) == ["own-2.rrd", "own.rrd"]


def test_wrapping_twice_or_something_else(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    env = gymnasium.make_vec("sdc_taichi/Load-v0", num_envs=2, config="tiny", recorder=path)
    with pytest.raises(SdcError, match="recorded already"):
        RecordEpisodes(env, path)
    env.close()
    singles = SyncVectorEnv([partial(gymnasium.make, "sdc_taichi/Load-v0", config="tiny")])
    agents: Any = sdc_taichi.vector_env(2, "tiny")
    for other in (singles, agents):
        with pytest.raises(SdcError, match=f"{type(other).__name__} cannot be recorded here"):
            RecordEpisodes(other, path)
        other.close()


def test_error_of_a_reward_function_costs_no_step_after_it(tmp_path: Path) -> None:
    calls = iter(range(1000))

    def reward(result: StepResult, view: View) -> Any:
        if next(calls) == 6:
            raise ValueError("of the user's")
        return -result.grid_kwh

    path = tmp_path / "run.rrd"
    env = sdc_taichi.parallel_env("tiny", days=1, rewards=reward, recorder=path)
    play(env, 6)
    with pytest.raises(ValueError, match="of the user's"):
        go_on(env, 1)
    with pytest.warns(RecordingWarning, match="step 7 after step 5.*goes on without a recording"):
        go_on(env, 1)
    go_on(env, 88)
    assert not env.agents
    assert steps_of(tmp_path / "run-episode-0.rrd") == list(range(6))


def test_without_a_viewer_the_episode_goes_on() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"rerun+http://127.0.0.1:{probe.getsockname()[1]}/proxy"
    env = sdc_taichi.parallel_env("tiny", days=1, recorder=address)
    with pytest.warns(RecordingWarning, match="no viewer listens") as warned:
        play(env, 5)
    assert len(warned) == 1
    env.close()


@pytest.mark.parametrize(
    ("recorder", "message"),
    [
        ("run.txt", r"must end in \.rrd"),
        ("/nowhere/at/all/run.rrd", "is no folder"),
        ("rerun+http://127.0.0.1", "no address of a viewer"),
        (3, "recorder 3: valid is a file ending in .rrd"),
        (EpisodeRecorder("run.rrd", episode_trigger=3), "episode_trigger 3: valid is a function"),  # type: ignore[arg-type]
        (EpisodeRecorder("run.rrd", envs=[6]), "different numbers of 0..5"),
        (EpisodeRecorder("run.rrd", envs=[0, 1, 2, 3, 4]), "valid is a list of 1 to 4"),
        (EpisodeRecorder("run.rrd", envs=[1.0]), r"envs \[1\.0\]: valid is a list"),  # type: ignore[list-item]
        (EpisodeRecorder("run.rrd", envs=[1, 1]), "different numbers"),
        (EpisodeRecorder("run.rrd", every=0), "every 0: valid is a positive integer"),
        (EpisodeRecorder(Recorder("run.rrd"), every=3), "without effect on a Recorder"),
    ],
)
def test_malformed_recorders(recorder: Any, message: str) -> None:
    with pytest.raises(SdcError, match=message):
        sdc_taichi.vector_env(6, "tiny", recorder=recorder)


def test_reset_close_and_saved_states_end_a_recording(tmp_path: Path) -> None:
    env = sdc_taichi.parallel_env("tiny", days=1, recorder=tmp_path / "run.rrd")
    play(env, 30)
    play(env, 7)
    assert steps_of(tmp_path / "run-episode-0.rrd") == list(range(30))
    env.load_state_dict(env.state_dict())
    go_on(env, 4)
    env.close()
    env.close()
    assert files(tmp_path) == ["run-episode-0.rrd", "run-episode-1.rrd"]
    # Episode 8 is the next that is recorded; the one that continues is number 2.
    assert steps_of(tmp_path / "run-episode-1.rrd") == list(range(7))
    unused = sdc_taichi.parallel_env("tiny", days=1, recorder=tmp_path / "other.rrd")
    unused.reset(seed=0)
    unused.close()
    assert len(files(tmp_path)) == 2
