"""BenchMARL's MAPPO on all three agents, with a policy for each.

    python examples/train_benchmarl.py [--num-envs 8] [--steps 50000]

The data centers are PettingZoo environments in TorchRL's own wrapper, and critics see the shared
state. Prints the mean episode return of each agent untrained and trained, in episodes that were not
trained on. BenchMARL keeps its files in a folder that is deleted at the end.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from pettingzoo.utils import BaseParallelWrapper
from torchrl.envs import EnvBase, PettingZooWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type

import sdc_taichi


class WithoutInfos(BaseParallelWrapper):
    """A PettingZoo environment without infos.

    TorchRL copies each number of the infos of each agent by itself, which takes several times as
    long as a step, and it refuses text (``trace``).
    """

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, dict[str, Any]]]:
        """Observations before the first step, and empty infos."""
        observations, infos = super().reset(seed, options)
        return observations, {agent: {} for agent in infos}

    def step(self, actions: Mapping[str, Any]) -> tuple[Any, ...]:
        """Observations, rewards, ends of episodes, and empty infos."""
        *result, infos = super().step(actions)
        return (*result, {agent: {} for agent in infos})


class DataCenterTask(PettingZooClass):
    """A data center as a task of BenchMARL, whose config are options of the environment."""

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """Function that makes one environment."""
        options = {**self.config, "actions": "continuous" if continuous_actions else "discrete"}

        def make() -> EnvBase:
            env = WithoutInfos(sdc_taichi.parallel_env(**options))
            return PettingZooWrapper(env, return_state=True, seed=seed, device=device)

        return make

    def supports_continuous_actions(self) -> bool:
        """Agents choose numbers with ``actions="continuous"``."""
        return True

    def supports_discrete_actions(self) -> bool:
        """Agents choose among three commands with ``actions="discrete"``."""
        return True

    def has_state(self) -> bool:
        """The shared state is for critics."""
        return True

    def has_render(self, env: EnvBase) -> bool:
        """No pictures."""
        return False

    def max_steps(self, env: EnvBase) -> int:
        """Steps of an episode."""
        return int(env.core.steps)

    @staticmethod
    def env_name() -> str:
        """Name of the kind of task."""
        return "sdc_taichi"


def settings(num_envs: int, steps: int, rollout: int, folder: str) -> ExperimentConfig:
    """Settings of an experiment without evaluations and logs of BenchMARL's own.

    Args:
        num_envs: data centers, each a Python environment.
        steps: of all environments together.
        rollout: steps between updates.
        folder: where BenchMARL keeps its files.
    """
    config = ExperimentConfig.get_from_yaml()
    batch = num_envs * rollout
    config.save_folder, config.loggers, config.create_json = folder, [], False
    config.evaluation = config.render = config.prefer_continuous_actions = False
    config.gamma, config.lr = 0.995, 3e-4
    config.max_n_frames = max(steps // batch, 1) * batch
    config.on_policy_n_envs_per_worker = num_envs
    config.on_policy_collected_frames_per_batch = batch
    config.on_policy_minibatch_size = max(1, batch // 4)
    config.on_policy_n_minibatch_iters = 5
    config.evaluation_episodes = 1
    return config


def print_returns(name: str, experiment: Experiment, seed: int, episodes: int) -> None:
    """Print the mean return of each agent in episodes that begin with a seed."""
    env = experiment.task.get_env_fun(1, experiment.continuous_actions, seed, "cpu")()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        played = [env.rollout(experiment.max_steps, experiment.policy) for _ in range(episodes)]
    env.close()
    means = {
        group: sum(float(one["next", group, "reward"].sum()) for one in played) / episodes
        for group in experiment.group_map
    }
    shown = ", ".join(f"{group} {mean:.3f}" for group, mean in means.items())
    print(f"{name}: mean episode return {shown}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--steps", type=int, default=50_000, help="of all environments together")
    parser.add_argument("--days", type=int, default=7, help="length of an episode")
    parser.add_argument("--rollout", type=int, default=96, help="steps between updates")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)  # faster than two for networks of this size
    warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested", UserWarning)
    with tempfile.TemporaryDirectory() as folder:
        experiment = Experiment(
            task=DataCenterTask("data_center", {"days": given.days}),
            algorithm_config=MappoConfig.get_from_yaml(),
            model_config=MlpConfig.get_from_yaml(),
            seed=given.seed,
            config=settings(given.num_envs, given.steps, given.rollout, folder),
        )
        seed = given.seed + 1_000_000  # of episodes that are not trained on
        print_returns("untrained", experiment, seed, given.num_envs)
        experiment.run()  # closes its environments at the end
        print_returns("trained", experiment, seed, given.num_envs)


if __name__ == "__main__":
    main()
