"""Whole training, beside other libraries: steps per second, what agents earn, and memory.

    python benchmarks/train.py [FOLDER] [--cases ppo sb3-ppo] [--num-envs 256] [--seeds 5]

trains the agents of preset ``corrected`` with each case from each seed: by algorithms of
``sdc_taichi.learning``, and by PPO of Stable-Baselines3, which like ``ppo`` here has the battery
alone to learn with. Networks, batches, passes, mini-batches, discount
and learning rate are equal. Cases take turns, each in a process and thread of its own, and are
measured by processor time after two rollouts, in which kernels are compiled. Writes ``train.json``
to FOLDER and prints a table: steps of data centers per second, the share of the environment's
steps in the time, the mean reward of a step in the last episodes over the agents (the mean and
range of the seeds), and by how much memory grew between the middle and the end.

Needs the extra ``recipes``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

import sdc_taichi
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.learning.algorithms import ON_POLICY, OnPolicySettings
from sdc_taichi.learning.on_policy import OnPolicy
from sdc_taichi.learning.stream import EnvironmentStream

sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))

SETTINGS = OnPolicySettings(decision_steps=1, levels=None, anneal=False)
CASES = ("ippo", "mappo", "happo", "ppo", "sb3-ppo")
WARM_UP = 2
"""Rollouts before the measurement."""
PAGE_MB = 4096 / 2**20


@dataclass(frozen=True)
class Run:
    """Speed, reward and growth of memory of one training."""

    case: str
    """Case, with ``sb3-`` before the algorithm of Stable-Baselines3."""
    seed: int
    """Seed of the training."""
    steps_per_s: float
    """Steps of data centers per second of processor time, 1/s."""
    steps_per_wall_s: float
    """Steps of data centers per second, 1/s."""
    env_share: float
    """Share of the steps of the environment in the processor time."""
    reward: float
    """Mean reward of a step over agents, data centers and the steps of the last episode."""
    growth_mb: float
    """Growth of the memory of the process between the middle of the training and its end, MB."""


class Meter:
    """Processor time within the steps of an environment, rewards, and memory at each step."""

    def __init__(self) -> None:
        self.within_s = 0.0
        self.rewards: list[float] = []
        self.memory_mb: list[float] = []

    def timed(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """The call, whose time counts as the environment's."""

        def run(*given: Any, **named: Any) -> Any:
            start = time.process_time()
            result = call(*given, **named)
            self.within_s += time.process_time() - start
            return result

        return run

    def note(self, reward: float) -> None:
        """Keep the mean reward of a step, and the memory after it."""
        self.rewards.append(reward)
        pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
        self.memory_mb.append(pages * PAGE_MB)


def ours(algorithm: str, num_envs: int, days: int, seed: int, meter: Meter) -> Callable[[int], Any]:
    """Make an algorithm of this package, and return a function that trains it for n rollouts."""
    definition = ON_POLICY[algorithm]
    agents = ["agent_bat"] if algorithm == "ppo" else list(AGENTS)
    env = sdc_taichi.vector_env(num_envs, days=days, agents=agents, autoreset_mode="SameStep")
    stream = EnvironmentStream(env, shares_state=definition.critic == "state", seed=seed)
    learner = OnPolicy(definition, SETTINGS, stream, updates=1, seed=seed)
    step = meter.timed(stream.step)

    def noted(actions: Mapping[str, torch.Tensor]) -> Any:
        after = step(actions)
        meter.note(float(np.mean([float(reward.mean()) for reward in after.rewards.values()])))
        return after

    stream.step = noted  # type: ignore[method-assign]
    return lambda rollouts: [learner.update(stream) for _ in range(rollouts)]


def sb3(algorithm: str, num_envs: int, days: int, seed: int, meter: Meter) -> Callable[[int], Any]:
    """Make PPO of Stable-Baselines3, and return a function that trains it for n rollouts."""
    import train_sb3
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    batch = gymnasium.make_vec(
        train_sb3.IDS["Battery"], num_envs=num_envs, days=days, autoreset_mode="SameStep"
    )
    env: Any = train_sb3.BatchVecEnv(batch)
    env.seed(seed)
    step = meter.timed(env.step_wait)

    def noted() -> Any:
        result = step()
        meter.note(float(result[1].mean()))
        return result

    env.step_wait = noted
    rows = num_envs * SETTINGS.rollout_decisions
    model = PPO(
        "MlpPolicy",
        VecNormalize(env, gamma=SETTINGS.discount),
        n_steps=SETTINGS.rollout_decisions,
        batch_size=rows // SETTINGS.mini_batches,
        n_epochs=SETTINGS.epochs,
        learning_rate=SETTINGS.rate,
        gamma=SETTINGS.discount,
        gae_lambda=SETTINGS.gae_lambda,
        clip_range=SETTINGS.clip,
        ent_coef=SETTINGS.entropy,
        vf_coef=0.5,
        max_grad_norm=SETTINGS.gradient_norm,
        policy_kwargs={"net_arch": list(SETTINGS.hidden)},
        seed=seed,
        device="cpu",
    )
    return lambda rollouts: model.learn(rollouts * rows, reset_num_timesteps=False)


LIBRARIES = {"": ours, "sb3": sb3}


def measure(case: str, num_envs: int, days: int, rollouts: int, seed: int) -> Run:
    """Train one case from one seed."""
    torch.set_num_threads(1)
    library, _, algorithm = case.rpartition("-")
    meter = Meter()
    train = LIBRARIES[library](algorithm, num_envs, days, seed, meter)
    train(WARM_UP)
    meter.within_s = 0.0
    wall, core = time.perf_counter(), time.process_time()
    train(rollouts)
    wall, core = time.perf_counter() - wall, time.process_time() - core
    steps = num_envs * rollouts * SETTINGS.rollout_decisions
    memory = meter.memory_mb
    return Run(
        case=case,
        seed=seed,
        steps_per_s=steps / core,
        steps_per_wall_s=steps / wall,
        env_share=meter.within_s / core,
        reward=float(np.mean(meter.rewards[-days * 96 :])),
        growth_mb=memory[-1] - memory[len(memory) // 2],
    )


def table(runs: Sequence[Run]) -> str:
    """Medians of speed, and mean and range of rewards, by case."""
    lines = [
        "| case | steps/s | wall steps/s | environment | reward of a step (range) | growth, MB |",
        "|---|---|---|---|---|---|",
    ]
    for case in dict.fromkeys(run.case for run in runs):
        of_case = [run for run in runs if run.case == case]

        def median(name: str, of_case: Sequence[Run] = of_case) -> float:
            return float(np.median([getattr(run, name) for run in of_case]))

        rewards = np.array([run.reward for run in of_case])
        lines.append(
            f"| {case} | {median('steps_per_s'):,.0f} | {median('steps_per_wall_s'):,.0f} "
            f"| {median('env_share'):.0%} | {rewards.mean():.5f} ({rewards.min():.5f} to "
            f"{rewards.max():.5f}) | {median('growth_mb'):.1f} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("runs/bench-train"))
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES)
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollouts", type=int, default=84, help="of 32 steps, measured")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seed", type=int, help="measure one case here, and print its JSON")
    given = parser.parse_args(arguments)
    sizes = {name: getattr(given, name) for name in ("num_envs", "days", "rollouts")}
    if given.seed is not None:
        print(json.dumps(asdict(measure(given.cases[0], **sizes, seed=given.seed))))
        return
    runs = []
    for seed in range(given.seeds):
        for case in given.cases:
            command = [sys.executable, __file__, "--cases", case, "--seed", str(seed)]
            for name, value in sizes.items():
                command += [f"--{name.replace('_', '-')}", str(value)]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            runs.append(Run(**json.loads(done.stdout.splitlines()[-1])))
            print(runs[-1], file=sys.stderr, flush=True)
    report = sizes | {"settings": SETTINGS.model_dump(), "runs": [asdict(run) for run in runs]}
    given.folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(report, indent=1, allow_nan=False)
    (given.folder / "train.json").write_text(text + "\n", encoding="utf-8")
    print(table(runs))


if __name__ == "__main__":
    main()
