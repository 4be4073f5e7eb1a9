"""Search for linear policies by the cross-entropy method, which needs no gradient.

Parameters of candidates are drawn from normal distributions, which are then fitted to the best of
them (Rubinstein, Kroese 2004), with a noise that keeps them from narrowing too early and fades over
the search (Szita, Lorincz 2006).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.algorithms import CrossEntropySettings
from sdc_taichi.learning.networks import CLIP, LEAST_STD, policy_network
from sdc_taichi.learning.policy import PolicyNetwork
from sdc_taichi.learning.stream import EnvironmentStream
from sdc_taichi.types import F32, F64, I64

LEAST_SPREAD = 1e-9
"""Smallest spread of the returns of a data center relative to their size."""


@dataclass(slots=True)
class _Search:
    """Search for the policy of one learner: n entries are observed, m scores are made of them."""

    mean: F64
    """Mean of the parameters, (m, n + 1), the last column being the biases."""
    std: F64
    """Standard deviation of the parameters, (m, n + 1)."""
    seen_mean: F64
    """Mean of observations, (n,)."""
    seen_std: F64
    """Standard deviation of observations, (n,)."""
    usual: F64
    """Usual return of each data center, a moving average, (B,)."""
    spread: F64
    """Mean square of the differences between returns and the usual one, (B,)."""


class CrossEntropySearch:
    """Cross-entropy search; in an update each data center tries a candidate for an episode.

    Data centers differ more than candidates do. A candidate is therefore judged not by its return,
    but by how far that exceeds the earlier returns of its data center, in standard deviations.

    Args:
        settings: settings of the algorithm.
        stream: the environments to learn in.
        updates: number of updates of the whole training.
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
        """Try candidates for an episode, and fit the distributions to the best of them.

        The first update only measures observations and returns.

        Args:
            stream: the environments, at the beginning of an episode.

        Returns:
            Numbers to log: ``reward/NAME``, the mean over steps; ``spread/NAME``, the mean standard
            deviation of parameters.
        """
        drawn = {name: self._draw(search) for name, search in self._searches.items()}
        tried = {name: self._shuffled() for name in self._searches}
        returns = self._try(stream, drawn, tried)
        self._done += 1
        logged: dict[str, float] = {}
        for name, search in self._searches.items():
            if self._done > 1:
                figures = _figures(returns[name], search)
                of_each = np.bincount(tried[name], figures) / np.bincount(tried[name])
                self._select(search, drawn[name], of_each)
            self._remember(search, returns[name])
            logged[f"reward/{name}"] = float(returns[name].mean()) / stream.episode_steps
            logged[f"spread/{name}"] = float(search.std.mean())
        return logged

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """The policies at the means of the distributions."""
        networks = []
        for name, of in self._spaces.items():
            search = self._searches[name]
            layers = ((_f32(search.mean[:, :-1]), _f32(search.mean[:, -1])),)
            seen = _f32(search.seen_mean), _f32(search.seen_std)
            networks.append(policy_network(layers, *seen, of))
        return tuple(networks)

    def state_dict(self) -> dict[str, Any]:
        """Complete state, from which the training continues to the same bits."""
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
        """Restore what ``state_dict`` of an algorithm with equal arguments returned."""
        self._done = int(values["done"])
        self._generator.bit_generator.state = values["generator"]
        for name, of in values["learners"].items():
            arrays = {field: np.array(array, dtype=np.float64) for field, array in of.items()}
            self._searches[name] = _Search(**arrays)

    def _draw(self, search: _Search) -> F64:
        """Parameters of candidates, (P, m, n + 1)."""
        noise = self._generator.standard_normal((self._settings.candidates, *search.mean.shape))
        return search.mean + search.std * noise

    def _shuffled(self) -> I64:
        """Candidate that each data center tries, (B,)."""
        order = self._generator.permutation(self._size)
        return np.asarray(order % self._settings.candidates, dtype=np.int64)

    def _try(
        self, stream: EnvironmentStream, drawn: Mapping[str, F64], tried: Mapping[str, I64]
    ) -> dict[str, F64]:
        """Returns of an episode by learner, (B,) each; the first measures observations as well."""
        parameters = {name: drawn[name][tried[name]].astype(np.float32) for name in drawn}
        returns = {name: np.zeros(self._size) for name in drawn}
        sums = {name: np.zeros((2, s.seen_mean.size)) for name, s in self._searches.items()}
        count, ended = 0, False
        while not ended:
            count += self._size
            actions = {}
            for name, search in self._searches.items():
                seen = stream.observations[name].numpy()
                if not self._done:
                    sums[name] += seen.sum(0, np.float64), np.square(seen, dtype=np.float64).sum(0)
                scores = _scores(parameters[name], seen, search)
                actions[name] = torch.from_numpy(_actions(scores, self._spaces[name].choices))
            after = stream.step(actions)
            ended = after.ended
            for name, reward in after.rewards.items():
                returns[name] += reward.numpy()
        if not self._done:
            for name, search in self._searches.items():
                mean, square = sums[name] / count
                search.seen_mean = mean
                search.seen_std = np.sqrt(np.maximum(square - mean * mean, LEAST_STD**2))
        return returns

    def _select(self, search: _Search, drawn: F64, figures: F64) -> None:
        """Fit the distributions to the best candidates, and add noise that keeps them wide."""
        s = self._settings
        best = np.argsort(-figures, kind="stable")[: max(round(s.elite_share * len(figures)), 1)]
        left = max(1.0 - (self._done - 1) / max(self._updates - 1, 1), 0.0)
        noise = s.noise_std * left
        search.mean = drawn[best].mean(0)
        search.std = np.sqrt(drawn[best].var(0) + noise * noise)

    def _remember(self, search: _Search, returns: F64) -> None:
        """Update the usual return of each data center, and its spread, by an episode."""
        rate = 1.0 if self._done == 1 else self._settings.memory_rate
        departure = returns - search.usual
        search.usual = search.usual + rate * departure
        if self._done > 1:
            first = 1.0 if self._done == 2 else rate
            search.spread = search.spread + first * (departure * departure - search.spread)


def _figures(returns: F64, search: _Search) -> F64:
    """Returns less the usual one of their data center, in its standard deviations, (B,)."""
    departure = returns - search.usual
    spread = np.sqrt(search.spread)
    # In the second update the spread of a data center is unknown; use that of all.
    spread = np.where(spread > 0, spread, np.sqrt(np.mean(departure * departure)))
    least = LEAST_SPREAD * np.maximum(np.abs(search.usual), 1.0)
    return np.asarray(departure / np.maximum(spread, least))


def _scores(parameters: F32, seen: F32, search: _Search) -> F32:
    """Scores of each data center by the candidate that it tries, (B, m)."""
    scaled = ((seen - search.seen_mean) / search.seen_std).clip(-CLIP, CLIP).astype(np.float32)
    product = np.matmul(parameters[:, :, :-1], scaled[:, :, None])[..., 0]
    return np.asarray(product + parameters[:, :, -1])


def _actions(scores: F32, choices: int | None) -> F32 | I64:
    """Actions, (B, k): numbers of choices, or numbers within -1..1."""
    if choices is not None:
        return np.asarray(scores.reshape(len(scores), -1, choices).argmax(2))
    return scores.clip(-1.0, 1.0)


def _f32(values: F64) -> F32:
    return values.astype(np.float32)
