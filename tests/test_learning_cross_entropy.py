"""Cross-entropy search: a game with a known answer, refused settings, and batteries."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

from sdc_taichi.errors import ConfigError  # noqa: E402
from sdc_taichi.learning.algorithms import CrossEntropySettings  # noqa: E402
from sdc_taichi.learning.cross_entropy import CrossEntropySearch  # noqa: E402
from sdc_taichi.learning.stream import (  # noqa: E402
    LearnerSpaces,
    StreamStep,
)

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SIZE, STEPS = 64, 8


class Game:
    """A step pays by how near the action is to the answer, and more in some environments."""

    size, episode_steps = SIZE, STEPS

    def __init__(self, answer: Any, *, discrete: bool, width: int = 2) -> None:
        self.spaces = {"player": LearnerSpaces(("player",), width, 1, 3 if discrete else None)}
        self._answer, self._rng = answer, np.random.default_rng(0)
        self._pay, self._steps = np.geomspace(0.1, 10.0, SIZE), 0
        self._look(width)

    def _look(self, width: int) -> None:
        self._seen = self._rng.uniform(-1.0, 1.0, (SIZE, width)).astype(np.float32)
        self.observations = {"player": torch.from_numpy(self._seen)}

    def step(self, actions: Any) -> StreamStep:
        off = actions["player"].numpy()[:, 0] - self._answer(self._seen)
        reward = torch.from_numpy((self._pay * (10.0 - np.abs(off))).astype(np.float32))
        self._look(self._seen.shape[1])
        self._steps += 1
        return StreamStep(
            {"player": reward},
            reward,
            self._steps % STEPS == 0,
            self.observations,
            torch.empty(SIZE, 0),
        )


def search(game: Any, updates: int, **settings: Any) -> CrossEntropySearch:
    return CrossEntropySearch(CrossEntropySettings(**settings), game, updates=updates, seed=1)


def distance(algorithm: CrossEntropySearch, answer: Any) -> float:
    """Mean distance of actions from the answer in situations that the search has not had."""
    seen = np.random.default_rng(9).uniform(-1.0, 1.0, (200, 2)).astype(np.float32)
    (network,) = algorithm.networks()
    return float(np.abs(network.actions(seen)[:, 0] - answer(seen)).mean())


@pytest.mark.parametrize(
    ("discrete", "answer", "most"),
    [
        (True, lambda seen: np.where(seen[:, 0] > 0.0, 2, 0), 0.2),
        (False, lambda seen: 0.8 * seen[:, 1], 0.1),
    ],
)
def test_search_finds_the_answer_of_a_game(discrete: bool, answer: Any, most: float) -> None:
    game: Any = Game(answer, discrete=discrete)
    algorithm = search(game, 40)
    begin = distance(algorithm, answer)
    for _ in range(40):
        logged = algorithm.update(game)
    assert distance(algorithm, answer) < most < begin
    assert set(logged) == {"reward/player", "spread/player"}


def test_search_needs_a_data_center_for_each_candidate() -> None:
    game: Any = Game(lambda seen: seen[:, 0], discrete=False)
    with pytest.raises(ConfigError, match=r"learning\.candidates 65: there are 64 data centers"):
        search(game, 1, candidates=65)
