"""A TorchRL environment over a batch of data centers, checked and run with random actions.

    python examples/torchrl_env.py [--num-envs 64] [--steps 192]

Observations, actions and rewards are nested under the agents' names, the shared state is ``state``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
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
        agents, size = env.possible_agents, env.num_envs
        self.observation_spec = Composite(
            {
                "state": self._spec(env.state_space),
                **{a: self._nest(observation=env.observation_spaces[a]) for a in agents},
            },
            shape=(size,),
        )
        self.action_spec = Composite(
            {a: self._nest(action=env.action_spaces[a]) for a in agents}, shape=(size,)
        )
        self.reward_spec = Composite(
            {a: Composite(reward=Real(shape=(size, 1)), shape=(size,)) for a in agents},
            shape=(size,),
        )
        self.done_spec = Composite(
            {
                name: Categorical(2, shape=(size, 1), dtype=torch.bool)
                for name in ("done", "terminated", "truncated")
            },
            shape=(size,),
        )

    def _spec(self, space: gymnasium.Space[Any]) -> Any:
        size = self._env.num_envs
        if isinstance(space, gymnasium.spaces.Dict):
            return self._nest(**space.spaces)
        if isinstance(space, gymnasium.spaces.Discrete):
            return Categorical(int(space.n), shape=(size,), dtype=torch.int64)
        if not isinstance(space, gymnasium.spaces.Box):
            raise TypeError(f"{space}: valid is a Box, Discrete or Dict space")
        low, high = (
            torch.from_numpy(x).expand(size, *space.shape) for x in (space.low, space.high)
        )
        return Bounded(low, high, shape=(size, *space.shape), dtype=low.dtype)

    def _nest(self, **spaces: gymnasium.Space[Any]) -> Any:
        specs = {name: self._spec(space) for name, space in spaces.items()}
        return Composite(specs, shape=(self._env.num_envs,))

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
            after[agent, "reward"] = column(reward)
        # All agents of a data center stop together.
        ends = next(iter(terminated.values())), next(iter(truncated.values()))
        after["terminated"], after["truncated"] = (column(x) for x in ends)
        after["done"] = after["terminated"] | after["truncated"]
        return after

    def _situation(self, observations: Mapping[str, Any], state: npt.NDArray[Any]) -> TensorDict:
        by_agent = {a: {"observation": tensors(x)} for a, x in observations.items()}
        return TensorDict(
            {"state": torch.from_numpy(state), **by_agent}, batch_size=self.batch_size
        )


def tensors(values: Any) -> Any:
    """Arrays as tensors, of a heat map by name."""
    if isinstance(values, Mapping):
        return {name: torch.from_numpy(array) for name, array in values.items()}
    return torch.from_numpy(values)


def column(values: npt.NDArray[Any]) -> torch.Tensor:
    """(B,) as (B, 1), which is how TorchRL keeps rewards and ends."""
    return torch.from_numpy(np.asarray(values)).unsqueeze(-1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Check the environment and run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=192, help="of each environment")
    parser.add_argument("--days", type=int, default=1, help="length of an episode")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)  # faster than two at these sizes
    torch.manual_seed(given.seed)
    batch = sdc_taichi.vector_env(given.num_envs, days=given.days, autoreset_mode="SameStep")
    env = BatchEnv(batch)
    check_env_specs(env, break_when_any_done="both")
    env.set_seed(given.seed)
    start = time.perf_counter()
    rollout = env.rollout(given.steps, break_when_any_done=False)
    speed = rollout.numel() / (time.perf_counter() - start)
    env.close()
    print(f"{rollout.numel()} steps, {speed:,.0f} steps/s")
    for agent in env.full_action_spec.keys():  # noqa: SIM118  a spec iterates over batches
        mean = rollout["next", agent, "reward"].mean().item()
        print(f"{agent}: mean reward {mean:.4f} with random actions")


if __name__ == "__main__":
    main()
