"""The examples with training libraries, each at a tiny size.

A test is skipped, naming the package, when what it trains with is not installed: `make test-train`
installs all of it.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest

import sdc_taichi
from sdc_taichi.envs import IDS

pytestmark = pytest.mark.repo

EXAMPLES = Path(__file__).parent.parent / "examples"
AGENTS = ("agent_ls", "agent_dc", "agent_bat")
DAY = 96
SAME_STEP: dict[str, Any] = {"days": 1, "autoreset_mode": "SameStep"}
"""Options of the batches that the adapters of the examples take."""
Load = Callable[..., Any]


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Iterator[Load]:
    """Imports an example, or skips the test when a package it needs is missing."""
    threads: list[int] = []
    monkeypatch.syspath_prepend(str(EXAMPLES))

    def load(name: str, *packages: str) -> ModuleType:
        for package in ("torch", *packages):
            found = pytest.importorskip(
                package, reason=f"{package} is not installed: make test-train"
            )
            if package == "torch":
                threads.append(found.get_num_threads())
                found.set_num_threads(1)
        return importlib.import_module(name)

    yield load
    if threads:
        importlib.import_module("torch").set_num_threads(threads[0])


# --- Stable-Baselines3 ---


def test_sb3_adapter_hands_on_what_the_batch_gives(example: Load) -> None:
    sb3 = example("train_sb3", "stable_baselines3")
    env = sb3.BatchVecEnv(gymnasium.make_vec("sdc_taichi/Battery-v0", **SAME_STEP, num_envs=3))
    twin = gymnasium.make_vec("sdc_taichi/Battery-v0", **SAME_STEP, num_envs=3)
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), twin.reset(seed=5)[0])
    rng = np.random.default_rng(0)
    for step in range(DAY + 2):
        actions = rng.integers(0, 3, 3)
        observations, rewards, done, infos = env.step(actions)
        expected = twin.step(actions)
        np.testing.assert_array_equal(observations, expected[0])
        np.testing.assert_array_equal(rewards, expected[1].astype(np.float32))
        assert rewards.dtype == np.float32
        assert done.tolist() == [step == DAY - 1] * 3
        for i, info in enumerate(infos):
            if done[i]:
                np.testing.assert_array_equal(
                    info["terminal_observation"], expected[4]["final_obs"][i]
                )
                assert not np.array_equal(info["terminal_observation"], observations[i])
                assert info["TimeLimit.truncated"] is True
            else:
                assert info == {}
    env.close()
    twin.close()


@pytest.mark.parametrize("agent", ["Load", "Cooling", "Battery"])
def test_sb3_trains_one_agent_reproducibly(
    example: Load, agent: str, capsys: pytest.CaptureFixture[str]
) -> None:
    sb3 = example("train_sb3", "stable_baselines3")

    def weights(steps: int) -> Any:
        model = sb3.train(agent, num_envs=2, steps=steps, days=1, rollout=16, seed=3)
        return np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()])

    once, again, longer = weights(32), weights(32), weights(64)
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once, longer)
    assert f"{agent}, trained: mean episode reward -" in capsys.readouterr().out


# --- TorchRL ---


def test_torchrl_env_passes_its_check(example: Load, capsys: pytest.CaptureFixture[str]) -> None:
    rl = example("torchrl_env", "torchrl", "tensordict")
    rl.main(2, DAY + 4)
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines[-3:]] == list(AGENTS)


def test_torchrl_env_gives_what_the_batch_gives(example: Load) -> None:
    rl = example("torchrl_env", "torchrl", "tensordict")
    env = rl.BatchEnv(sdc_taichi.vector_env(2, **SAME_STEP), seed=4)
    twin = sdc_taichi.vector_env(2, **SAME_STEP)
    observations, _ = twin.reset(seed=4)
    rollout = env.rollout(DAY + 2, break_when_any_done=False)
    for t in range(DAY + 2):
        now, after = rollout[:, t], rollout["next"][:, t]
        np.testing.assert_array_equal(now["state"], twin.state())
        for a in AGENTS:
            np.testing.assert_array_equal(now[a, "observation"], observations[a])
        actions = {a: now[a, "action"].numpy() for a in AGENTS}
        observations, rewards, _, truncated, infos = twin.step(actions)
        last = infos.get("final_obs", observations)
        assert ("final_obs" in infos) == (t == DAY - 1)
        for a in AGENTS:
            np.testing.assert_array_equal(after[a, "observation"], last[a])
            np.testing.assert_array_equal(after[a, "reward"][:, 0], rewards[a])
            np.testing.assert_array_equal(after["truncated"][:, 0], truncated[a])
        assert not after["terminated"].any()
        assert bool(after["done"].all()) == (t == DAY - 1)
    env.close()
    twin.close()


WRAPPED: dict[str, Callable[[], Any]] = {
    "parallel_env": lambda: sdc_taichi.parallel_env(days=1),
    "aec_env": lambda: sdc_taichi.aec_env(days=1),
    "make": lambda: gymnasium.make("sdc_taichi/Battery-v0", days=1),
    "make-Joint": lambda: gymnasium.make("sdc_taichi/Joint-v0", days=1, actions="continuous"),
    "make_vec-SameStep": lambda: gymnasium.make_vec("sdc_taichi/Joint-v0", 2, **SAME_STEP),
    "make_vec-Disabled": lambda: gymnasium.make_vec(
        "sdc_taichi/Joint-v0", 2, days=1, autoreset_mode="Disabled"
    ),
}
"""Environments that the wrappers of TorchRL take, by interface."""


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested:UserWarning")
@pytest.mark.parametrize("interface", WRAPPED)
def test_torchrl_wrappers_take_environments(interface: str, example: Load) -> None:
    example("torchrl_env", "torchrl", "tensordict")
    envs = importlib.import_module("torchrl.envs")
    made = WRAPPED[interface]()
    has_agents = not isinstance(made, gymnasium.Env | gymnasium.vector.VectorEnv)
    if has_agents:
        env = envs.PettingZooWrapper(made, return_state=True, use_mask=interface == "aec_env")
    else:
        env = envs.GymWrapper(made)
    importlib.import_module("torchrl.envs.utils").check_env_specs(env)
    day = DAY * (len(AGENTS) if interface == "aec_env" else 1)  # AEC agents step in turn
    rollout = env.rollout(day + 2, break_when_any_done=False)
    assert rollout.shape[-1] == day + 2
    assert rollout["next", "done"].flatten()[: day + 2].nonzero().flatten().tolist() == [day - 1]
    if interface == "parallel_env":
        before, after = (x["agent_dc", "info", "it_kwh"] for x in (rollout, rollout["next"]))
        assert before[0] == 0.0
        assert (after > 0.0).all()
    env.close()


# --- BenchMARL ---

BENCHMARL = """
import train_benchmarl
for seed in (0, 0):
    train_benchmarl.main(
        [
            *("--num-envs", "2", "--days", "1", "--rollout", "24", "--steps", "96"),
            *("--seed", str(seed)),
        ]
    )
"""


def test_benchmarl_trains_all_agents_reproducibly(example: Load) -> None:
    """In a process of its own, whose warnings end with it."""
    pytest.importorskip("benchmarl", reason="benchmarl is not installed: make test-train")
    done = subprocess.run(
        [sys.executable, "-c", BENCHMARL],
        env=os.environ | {"PYTHONPATH": str(EXAMPLES)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    returns = [line for line in done.stdout.splitlines() if "mean episode return" in line]
    assert [line.partition(":")[0] for line in returns] == ["untrained", "trained"] * 2
    assert all(agent in line for line in returns for agent in AGENTS)
    assert returns[:2] == returns[2:]
    assert returns[0].partition(":")[2] != returns[1].partition(":")[2]


# --- skrl and a single file in the manner of CleanRL ---

SMALL = {"num_envs": 2, "steps": 96, "days": 1, "rollout": 24, "seed": 3}


def test_skrl_wrapper_gives_what_the_batch_gives(example: Load) -> None:
    skrl = example("train_skrl", "skrl")
    torch = importlib.import_module("torch")
    env = skrl.make(num_envs=3, days=1, seed=5)
    twin = sdc_taichi.vector_env(3, days=1, autoreset_mode="NextStep")
    first, _ = env.reset()
    expected, _ = twin.reset(seed=5)
    np.testing.assert_array_equal(first["agent_dc"], expected["agent_dc"])
    rng = np.random.default_rng(0)
    for step in range(DAY + 2):
        actions = {agent: rng.integers(0, 3, 3) for agent in AGENTS}
        columns = {agent: torch.from_numpy(x).unsqueeze(-1) for agent, x in actions.items()}
        observations, rewards, terminated, truncated, _ = env.step(columns)
        expected, paid, *_ = twin.step(actions)
        for agent in AGENTS:
            np.testing.assert_array_equal(observations[agent], expected[agent])
            np.testing.assert_array_equal(rewards[agent][:, 0], paid[agent].astype(np.float32))
            np.testing.assert_array_equal(env.state()[agent], twin.state())
            assert truncated[agent].squeeze(-1).tolist() == [step == DAY - 1] * 3
            assert not terminated[agent].any()
    env.close()
    twin.close()


@pytest.mark.parametrize("name", ["train_skrl", "train_cleanrl"])
def test_batches_train_all_agents_reproducibly(
    example: Load, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    module = example(name, *(["skrl"] if name == "train_skrl" else []))
    for _ in range(2):
        module.train(**SMALL)
    printed = [line for line in capsys.readouterr().out.splitlines() if "mean reward" in line]
    assert [line.partition(":")[0] for line in printed] == ["untrained", "trained"] * 2
    assert printed[:2] == printed[2:]
    assert printed[0].partition(":")[2] != printed[1].partition(":")[2]


def test_advantages_of_a_single_file_end_with_their_episode(example: Load) -> None:
    ppo = example("train_cleanrl")
    torch = importlib.import_module("torch")
    rewards, values = torch.tensor([[1.0], [2.0], [4.0]]), torch.tensor([[0.5], [0.25], [1.0]])
    next_values, ended = torch.tensor([[0.25], [3.0], [0.0]]), torch.tensor([[0], [1], [1]]).bool()
    ratio = ppo.GAMMA * ppo.LAMBDA
    second = 2.0 + ppo.GAMMA * 3.0 - 0.25
    expected = [1.0 + ppo.GAMMA * 0.25 - 0.5 + ratio * second, second, 4.0 - 1.0]
    advantages = ppo.advantages(rewards, values, next_values, ended)
    np.testing.assert_allclose(advantages[:, 0], expected, rtol=1e-6)


# --- RLlib ---

RLLIB = """
import train_rllib
for seed in (0, 0):
    train_rllib.main(
        [
            *("--num-envs", "2", "--days", "1", "--rollout", "24", "--steps", "96"),
            *("--seed", str(seed)),
        ]
    )
"""


def test_rllib_trains_all_agents_reproducibly_and_leaves_nothing(example: Load) -> None:
    """In a process of its own, whose warnings and threads end with it."""
    pytest.importorskip("ray.rllib", reason="RLlib is not installed: make test-train")
    cache = os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))
    # Paths of Ray's sockets must be short.
    with tempfile.TemporaryDirectory(dir="/tmp" if os.path.isdir("/tmp") else None) as folder:
        done = subprocess.run(
            [sys.executable, "-c", RLLIB],
            env=os.environ
            | {"HOME": folder, "RAY_TMPDIR": folder, "RAY_AUTH_MODE": "disabled"}
            | {"PYTHONPATH": str(EXAMPLES), "XDG_CACHE_HOME": cache},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        running = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True).stdout
        assert folder not in running
    lines = done.stdout.splitlines()
    returns = [line for line in lines if "mean episode return" in line]
    assert [line.partition(":")[0] for line in returns] == ["idle", "untrained", "trained"] * 2
    assert returns[:3] == returns[3:]
    assert returns[1].partition(":")[2] != returns[2].partition(":")[2]


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_sb3_has_nothing_to_say_against_single_environments(
    name: str, actions: str, example: Load
) -> None:
    """Its checker warns of spaces that its learners do badly with; warnings are errors here."""
    example("train_sb3", "stable_baselines3")
    checker = importlib.import_module("stable_baselines3.common.env_checker")
    env = gymnasium.make(name, config="tiny", days=1, actions=actions)
    checker.check_env(env.unwrapped)
    env.close()
