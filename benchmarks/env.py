"""Environment steps per second with full observations and rewards, in one run.

    python benchmarks/env.py [--quick] [--preset corrected] [--transient]

For each number of environments N: the native batch (``vector_env``: three agents, dict of arrays),
the same through ``gym.make_vec`` (joint agent), and the same loop over single environments in
Gymnasium's ``SyncVectorEnv``, which is the peer. Figures are environment steps per second of wall
time, best of several runs; "to sync" is the ratio of the native batch to the peer at that N, whose
rate beyond SYNC_MOST environments is that at SYNC_MOST.
"""

import argparse
import contextlib
import time
from collections.abc import Callable, Iterator

import gymnasium as gym
import numpy as np

import sdc_taichi
from sdc_taichi.control import view_maker
from sdc_taichi.types import StepResult

SIZES = (1, 64, 1024, 4096, 16384)
QUICK_SIZES = (2,)
ALL_SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
"""Sites with a synthetic year."""
SYNC_MOST = 64


def rate(step: Callable[[], object], num_envs: int, seconds: float) -> float:
    """Best environment steps per second over three runs."""
    for _ in range(3):
        step()
    best = 0.0
    for _ in range(3):
        done, start = 0, time.perf_counter()
        while (spent := time.perf_counter() - start) < seconds or done == 0:
            step()
            done += 1
        best = max(best, done * num_envs / spent)
    return best


def single_step(config: sdc_taichi.DataCenterConfig) -> Callable[[], object]:
    """A step of one PettingZoo environment, which is reset when an episode has ended."""
    one = sdc_taichi.parallel_env(config)
    one.reset(seed=0)
    actions = dict.fromkeys(one.possible_agents, 1)

    def step() -> None:
        if not one.agents:
            one.reset()
        one.step(actions)

    return step


@contextlib.contextmanager
def controlled_step(preset: str, controller: str, count: int) -> Iterator[Callable[[], object]]:
    """A step of some data centers of eight sites under a named controller."""
    base = sdc_taichi.load_config(preset)
    configs = sdc_taichi.make_configs(base, count=count, sites=ALL_SITES[:count])
    with sdc_taichi.Simulator(configs) as sim:
        sim.reset()
        acting = sdc_taichi.make_controller(controller, sim.fleet)
        acting.reset(0)
        view_of = view_maker(sim)
        last: list[StepResult | None] = [None]

        def step() -> None:
            last[0] = sim.step(acting.act(view_of(last[0])))

        step()
        yield step


@contextlib.contextmanager
def batch_step(
    config: sdc_taichi.DataCenterConfig, num_envs: int
) -> Iterator[Callable[[], object]]:
    """A step of the multi-agent batch with random actions."""
    env = sdc_taichi.vector_env(num_envs, config)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = [{a: rng.integers(0, 3, num_envs) for a in env.possible_agents} for _ in range(8)]
    turn = iter(range(10**12))
    yield lambda: env.step(actions[next(turn) % 8])
    env.close()


def native(config: sdc_taichi.DataCenterConfig, num_envs: int, seconds: float) -> float:
    """Rate of the multi-agent batch."""
    with batch_step(config, num_envs) as step:
        return rate(step, num_envs, seconds)


def joint(
    config: sdc_taichi.DataCenterConfig, num_envs: int, seconds: float, mode: str | None
) -> float:
    """Rate of Gymnasium's joint environment; mode None is the native batch."""
    env = gym.make_vec(
        "sdc_taichi/Joint-v0", num_envs=num_envs, vectorization_mode=mode, config=config
    )
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(8)]
    turn = iter(range(10**12))
    found = rate(lambda: env.step(actions[next(turn) % 8]), num_envs, seconds)
    env.close()
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that it runs")
    parser.add_argument("--preset", default="corrected")
    parser.add_argument("--transient", action="store_true", help="halls with thermal memory")
    given = parser.parse_args()
    overrides = ["simulation.thermal=transient"] if given.transient else []
    config = sdc_taichi.load_config(given.preset, overrides)
    seconds = 0.01 if given.quick else 1.0
    print("     N   vector_env     make_vec       sync  to sync")
    peer = 0.0
    for num_envs in QUICK_SIZES if given.quick else SIZES:
        batch = native(config, num_envs, seconds)
        vector = joint(config, num_envs, seconds, None)
        if num_envs <= SYNC_MOST:
            peer = joint(config, num_envs, seconds, "sync")
        print(f"{num_envs:>6} {batch:>12,.0f} {vector:>12,.0f} {peer:>10,.0f} {batch / peer:>8.1f}")


if __name__ == "__main__":
    main()
