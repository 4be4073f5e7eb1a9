"""Search for linear policies by the cross-entropy method, which needs no gradients.

In each update, parameters of candidate policies are drawn from normal distributions, which are then
fitted to the best candidates (Rubinstein and Kroese 2004). Noise is added to the fitted standard
deviations to prevent premature convergence, and decreases during the search (Szita and Lorincz
2006).

All agents of a group that shares a policy run the same candidate in a data center, and its return
there is the mean of theirs.

In shapes, B is the number of data centers, P the number of candidates, n the number of entries of
an observation, m the number of scores, and k the number of actions. R is the number of rows of a
learner, as in module ``stream``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.algorithms import CrossEntropySettings, own_share
from sdc_taichi.learning.networks import CLIP, LEAST_STD, policy_network
from sdc_taichi.learning.policy import PolicyNetwork
from sdc_taichi.learning.stream import EnvironmentStream, learned_rewards
from sdc_taichi.types import F32, F64, I64

LEAST_SPREAD = 1e-9
"""Lower bound of the standard deviation of a data center's returns, relative to their size."""


@dataclass(slots=True)
class _Search:
    """State of the search for one learner's linear policy, from n observations to m scores."""

    mean: F64
    """Mean of the policy parameters, (m, n + 1); the last column holds the biases."""
    std: F64
    """Standard deviation of the policy parameters, (m, n + 1)."""
    seen_mean: F64
    """Mean of the observations, (n,)."""
    seen_std: F64
    """Standard deviation of the observations, (n,)."""
    usual: F64
    """Moving average of each data center's returns, (B,)."""
    spread: F64
    """Moving mean square deviation of each data center's returns from ``usual``, (B,)."""


class CrossEntropySearch:
    """Cross-entropy search; in each update, each data center runs a candidate for one episode.

    Returns differ more between data centers than between candidates. A candidate is therefore
    scored by the difference of its return from the average of its data center's earlier returns,
    divided by their standard deviation.

    Args:
        settings: settings of the algorithm.
        stream: the environments to learn in.
        updates: total number of updates of the training.
        seed: seed of all random numbers.

    Raises:
        ConfigError: there are more candidates than data centers.
    """

    def __init__(
        self,
        settings: CrossEntropySettings,
        stream: EnvironmentStream,
        *,
        updates: int,
        seed: int,
    ) -> None:
        self._size = size = stream.size
        if settings.candidates > size:
            raise ConfigError(
                f"learning.candidates {settings.candidates}: there are {size} data centers, and "
                f"each tries one at a time; valid is 2..{size}"
            )
        self._settings, self._spaces, self._updates = settings, stream.spaces, updates
        self._generator = np.random.Generator(np.random.PCG64(seed))
        self._done = 0
        self._searches: dict[str, _Search] = {}
        for name, of in self._spaces.items():
            n, m = of.observation_width, of.action_width * (of.choices or 1)
            self._searches[name] = _Search(
                mean=np.zeros((m, n + 1)),
                std=np.full((m, n + 1), settings.first_std),
                seen_mean=np.zeros(n),
                seen_std=np.ones(n),
                usual=np.zeros(size),
                spread=np.zeros(size),
            )

    def update(self, stream: EnvironmentStream) -> dict[str, float]:
        """Run candidates for an episode, and fit the distributions to the best of them.

        The first update only measures observations and returns.

        Args:
            stream: the environments, at the beginning of an episode.

        Returns:
            Values to log: ``reward/NAME``, the mean reward per step; ``spread/NAME``, the mean
            standard deviation of the policy parameters.
        """
        drawn = {name: self._draw(search) for name, search in self._searches.items()}
        tried = {name: self._shuffled() for name in self._searches}
        returns, logged = self._try(stream, drawn, tried)
        self._done += 1
        for name, search in self._searches.items():
            if self._done > 1:
                figures = _figures(returns[name], search)
                mean_figures = np.bincount(tried[name], figures) / np.bincount(tried[name])
                self._select(search, drawn[name], mean_figures)
            self._remember(search, returns[name])
            logged[f"spread/{name}"] = float(search.std.mean())
        return logged

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """Return the policies whose parameters are the means of the distributions."""
        networks = []
        for name, sizes in self._spaces.items():
            search = self._searches[name]
            layers = ((_f32(search.mean[:, :-1]), _f32(search.mean[:, -1])),)
            moments = _f32(search.seen_mean), _f32(search.seen_std)
            networks.append(policy_network(layers, *moments, sizes))
        return tuple(networks)

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state, from which a training continues with identical results."""
        fields = _Search.__dataclass_fields__
        return {
            "done": self._done,
            "generator": self._generator.bit_generator.state,
            "learners": {
                name: {field: getattr(search, field).copy() for field in fields}
                for name, search in self._searches.items()
            },
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore a state from ``state_dict`` of an algorithm with the same arguments."""
        self._done = int(values["done"])
        self._generator.bit_generator.state = values["generator"]
        for name, of in values["learners"].items():
            arrays = {field: np.array(array, dtype=np.float64) for field, array in of.items()}
            self._searches[name] = _Search(**arrays)

    def _draw(self, search: _Search) -> F64:
        """Draw the parameters of candidates, (P, m, n + 1)."""
        noise = self._generator.standard_normal((self._settings.candidates, *search.mean.shape))
        return search.mean + search.std * noise

    def _shuffled(self) -> I64:
        """Return the index of the candidate that each data center runs, in random order, (B,)."""
        order = self._generator.permutation(self._size)
        return np.asarray(order % self._settings.candidates, dtype=np.int64)

    def _try(
        self, stream: EnvironmentStream, drawn: Mapping[str, F64], tried: Mapping[str, I64]
    ) -> tuple[dict[str, F64], dict[str, float]]:
        """Run an episode; return the returns by learner, (B,) each, and mean rewards to log.

        The first episode also measures mean and standard deviation of the observations.
        """
        parameters = {name: drawn[name][tried[name]].astype(np.float32) for name in drawn}
        returns = {name: np.zeros(self._size) for name in drawn}
        own = own_share(self._settings.reward, "own")
        sums = {name: np.zeros((2, s.seen_mean.size)) for name, s in self._searches.items()}
        counts, ended = dict.fromkeys(drawn, 0), False
        logged = {f"reward/{name}": 0.0 for name in drawn}
        while not ended:
            actions = {}
            for name, search in self._searches.items():
                rows = stream.observations[name].numpy()
                if not self._done:
                    mask = stream.masks.get(name)
                    seen = rows if mask is None else rows[mask.numpy()]
                    counts[name] += len(seen)
                    sums[name] += seen.sum(0, np.float64), np.square(seen, dtype=np.float64).sum(0)
                scores = _scores(parameters[name], rows, search)
                actions[name] = torch.from_numpy(_actions(scores, self._spaces[name].choices))
            after = stream.step(actions)
            ended = after.ended
            for name, reward in after.mean_rewards.items():
                logged[f"reward/{name}"] += float(reward.mean()) / stream.episode_steps
                returns[name] += learned_rewards(reward, after.team, own).numpy()
        if not self._done:
            for name, search in self._searches.items():
                mean, square = sums[name] / max(counts[name], 1)
                search.seen_mean = mean
                search.seen_std = np.sqrt(np.maximum(square - mean * mean, LEAST_STD**2))
        return returns, logged

    def _select(self, search: _Search, drawn: F64, figures: F64) -> None:
        """Fit the distributions to the best candidates, and widen them by the current noise."""
        s = self._settings
        best = np.argsort(-figures, kind="stable")[: max(round(s.elite_share * len(figures)), 1)]
        remaining_share = max(1.0 - (self._done - 1) / max(self._updates - 1, 1), 0.0)
        noise = s.noise_std * remaining_share
        search.mean = drawn[best].mean(0)
        search.std = np.sqrt(drawn[best].var(0) + noise * noise)

    def _remember(self, search: _Search, returns: F64) -> None:
        """Update the moving averages of each data center's returns and their deviations."""
        rate = 1.0 if self._done == 1 else self._settings.memory_rate
        departure = returns - search.usual
        search.usual = search.usual + rate * departure
        if self._done > 1:
            first = 1.0 if self._done == 2 else rate
            search.spread = search.spread + first * (departure * departure - search.spread)


def _figures(returns: F64, search: _Search) -> F64:
    """Return the deviation of each return from its data center's average, standardised, (B,)."""
    departure = returns - search.usual
    spread = np.sqrt(search.spread)
    # In the second update, the standard deviation of a single data center is still unknown.
    spread = np.where(spread > 0, spread, np.sqrt(np.mean(departure * departure)))
    least = LEAST_SPREAD * np.maximum(np.abs(search.usual), 1.0)
    return np.asarray(departure / np.maximum(spread, least))


def _scores(parameters: F32, inputs: F32, search: _Search) -> F32:
    """Return the scores of the candidate that each data center runs, (R, m).

    Args:
        parameters: parameters of the candidate of each data center, (B, m, n + 1).
        inputs: observations, (R, n).
        search: state of the search of the learner.
    """
    scaled = ((inputs - search.seen_mean) / search.seen_std).clip(-CLIP, CLIP).astype(np.float32)
    by_dc = scaled.reshape(len(parameters), -1, scaled.shape[1])
    product = np.matmul(parameters[:, None, :, :-1], by_dc[..., None])[..., 0]
    return np.asarray(product + parameters[:, None, :, -1]).reshape(len(inputs), -1)


def _actions(scores: F32, choices: int | None) -> F32 | I64:
    """Convert scores to actions, (R, k): option indices, or numbers within -1..1."""
    if choices is not None:
        return np.asarray(scores.reshape(len(scores), -1, choices).argmax(2))
    return scores.clip(-1.0, 1.0)


def _f32(values: F64) -> F32:
    return values.astype(np.float32)
