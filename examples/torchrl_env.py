"""A TorchRL environment over a batch of data centers, checked and run with random actions.

    python examples/torchrl_env.py

Observations, actions and rewards are nested under the agents' names, the shared state is ``state``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy.typing as npt
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite
from torchrl.data import Unbounded as Real
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

import sdc_taichi
from sdc_taichi.envs.vector import MultiAgentVectorEnv


class BatchEnv(EnvBase):
    """A multi-agent batch as one TorchRL environment of batch size (B,).

    The batch starts new episodes by itself in the step that ends the old ones. TorchRL wants to see
    how an episode ended and asks for the reset afterwards, so what follows is kept until it does.

    Args:
        env: what ``sdc_taichi.vector_env`` returns with ``autoreset_mode="SameStep"``.
        seed: of the first reset.
    """

    def __init__(self, env: MultiAgentVectorEnv, seed: int = 0) -> None:
        super().__init__(device="cpu", batch_size=[env.num_envs])
        self._env = env
        self._next: TensorDict | None = None
        self._set_seed(seed)
        flag = Categorical(2, shape=(env.num_envs, 1), dtype=torch.bool)
        self.observation_spec = self._group(
            state=self._spec(env.state_space),
            **{
                a: self._group(observation=self._spec(x)) for a, x in env.observation_spaces.items()
            },
        )
        self.action_spec = self._group(
            **{a: self._group(action=self._spec(x)) for a, x in env.action_spaces.items()}
        )
        reward = Real(shape=(env.num_envs, 1))
        self.reward_spec = self._group(**{a: self._group(reward=reward) for a in env.agents})
        self.done_spec = self._group(done=flag, terminated=flag, truncated=flag)

    def _group(self, **specs: Any) -> Composite:
        return Composite(specs, shape=self.batch_size)

    def _spec(self, space: gymnasium.Space[Any]) -> Any:
        if isinstance(space, gymnasium.spaces.Discrete):
            return Categorical(int(space.n), shape=self.batch_size, dtype=torch.int64)
        assert isinstance(space, gymnasium.spaces.Box), f"{space}: valid is a Box or Discrete"
        shape = (*self.batch_size, *space.shape)
        low, high = (torch.from_numpy(x).expand(shape) for x in (space.low, space.high))
        return Bounded(low, high, shape=shape, dtype=low.dtype)

    def _set_seed(self, seed: int | None) -> None:
        """Seed of the next reset; further resets go on from it."""
        self._seed = seed

    def _reset(self, tensordict: TensorDict | None = None, **_: Any) -> TensorDict:
        if tensordict is not None and "_reset" in tensordict and not tensordict["_reset"].all():
            raise ValueError("episodes of a batch end together: single ones cannot be reset")
        start, self._next = self._next, None
        if start is None or self._seed is not None:
            observations, _ = self._env.reset(seed=self._seed)
            start = self._situation(observations, self._env.state())
        self._seed = None
        return start

    def _step(self, tensordict: TensorDict) -> TensorDict:
        actions = {a: tensordict[a, "action"].numpy() for a in self._env.possible_agents}
        observations, rewards, terminated, truncated, infos = self._env.step(actions)
        after = self._situation(observations, self._env.state())
        self._next = None
        if "final_obs" in infos:
            self._next = after
            after = self._situation(infos["final_obs"], infos["final_state"])
        for agent, reward in rewards.items():
            after[agent, "reward"] = torch.from_numpy(reward).unsqueeze(-1)
        # All agents of a data center stop together.
        for name, ends in (("terminated", terminated), ("truncated", truncated)):
            after[name] = torch.from_numpy(next(iter(ends.values()))).unsqueeze(-1)
        after["done"] = after["terminated"] | after["truncated"]
        return after

    def _situation(self, observations: Mapping[str, Any], state: npt.NDArray[Any]) -> TensorDict:
        by_agent = {a: {"observation": torch.from_numpy(x)} for a, x in observations.items()}
        return TensorDict({"state": torch.from_numpy(state), **by_agent}, self.batch_size)


def main(num_envs: int = 64, steps: int = 192) -> None:
    """Check the environment, and run it with random actions.

    Args:
        num_envs: data centers of the batch.
        steps: steps of each data center.
    """
    torch.set_num_threads(1)  # faster than two at these sizes
    env = BatchEnv(sdc_taichi.vector_env(num_envs, days=1, autoreset_mode="SameStep"))
    check_env_specs(env, break_when_any_done="both")
    rollout = env.rollout(steps, break_when_any_done=False)
    for agent in env.full_action_spec.keys():  # noqa: SIM118  a spec iterates over batches
        mean = rollout["next", agent, "reward"].mean().item()
        print(f"{agent}: mean reward {mean:.4f} in {rollout.numel()} steps of random actions")


if __name__ == "__main__":
    main()
