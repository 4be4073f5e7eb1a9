"""All algorithms with learners in games: what they find, and that they resume to the same bits."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

from learning_games import (  # noqa: E402
    OFF,
    ON,
    SEARCH,
    Aim,
    Coordination,
    Game,
    Meeting,
    Patience,
    Rooms,
    Temptation,
    assert_same_bits,
    chosen,
    weights,
)
from sdc_taichi.errors import ConfigError  # noqa: E402
from sdc_taichi.learning.algorithms import (  # noqa: E402
    OFF_POLICY,
    ON_POLICY,
    LearningSettings,
)
from sdc_taichi.learning.trainer import make_algorithm  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SETTINGS: dict[str, LearningSettings] = {
    **dict.fromkeys(ON_POLICY, ON),
    **dict.fromkeys(OFF_POLICY, OFF),
    "cross-entropy": SEARCH,
}


def algorithm(name: str, game: Any, updates: int, seed: int = 0, **changes: Any) -> Any:
    settings = SETTINGS[name].model_copy(update=changes)
    return make_algorithm(name, settings, game, updates=updates, seed=seed)


def trained(name: str, game: Game, updates: int, **changes: Any) -> Any:
    made = algorithm(name, game, updates, **changes)
    for _ in range(updates):
        made.update(game)
    return made


@pytest.mark.parametrize(
    ("names", "game", "best"),
    [
        (("ippo", "mappo", "happo", "haa2c"), Meeting(3), [0, 1, 2]),
        (("had3qn", "hasac"), Coordination(2), [0, 0]),
        (("ppo", "had3qn", "hasac", "cross-entropy"), Meeting(1, width=3), [0, 1, 2]),
        (("ppo", "happo", "had3qn", "hasac"), Patience(1), [2]),
    ],
    ids=["meeting", "coordination", "several choices of one player", "patience"],
)
def test_players_find_the_best_choices(names: tuple[str, ...], game: Game, best: list[int]) -> None:
    for name in names:
        played = copy.deepcopy(game)
        learner = trained(name, played, 30 if name in ON_POLICY else 100)
        assert chosen(learner, torch.eye(game.rooms)[0]) == best, name


@pytest.mark.parametrize("name", [name for name in SETTINGS if name != "ppo"])
def test_players_learn_from_their_own_reward_that_of_the_team_or_a_mixture(name: str) -> None:
    # A higher choice gains 1 of the own reward, and loses 1/2 of the mean reward of the team.
    for reward, best in (("own", 2.0), ("team", 0.0), (0.8, 2.0), (0.1, 0.0)):
        updates = 20 if name in ON_POLICY else 60
        learner = trained(name, Temptation(2), updates, reward=reward)
        assert chosen(learner, torch.ones(1)) == [best, best], reward


@pytest.mark.parametrize(
    ("name", "updates", "changes"),
    [
        ("ippo", 80, {"anneal": True}),
        ("happo", 80, {"anneal": True}),
        ("hasac", 100, {}),
        ("cross-entropy", 40, {}),
    ],
)
def test_players_find_the_best_numbers(name: str, updates: int, changes: dict[str, Any]) -> None:
    learner = trained(name, Aim(2, discrete=False), updates, **changes)
    assert chosen(learner, torch.ones(1)) == pytest.approx([0.5, -0.5], abs=0.2)


@pytest.mark.parametrize(
    ("name", "discrete"),
    [*((name, True) for name in SETTINGS), ("happo", False), ("hasac", False)],
)
def test_training_continues_from_its_state_to_the_same_bits(name: str, discrete: bool) -> None:
    players = 1 if name == "ppo" else 2
    game, later = (Rooms(players, discrete) for _ in range(2))
    whole, other = algorithm(name, game, 9), algorithm(name, later, 9, seed=1)
    for _ in range(3):
        whole.update(game)
    state, room = copy.deepcopy((whole.state_dict(), game.state_dict()))
    numbers = [whole.update(game) for _ in range(2)]
    assert not np.array_equal(weights(other)[0], weights(whole)[0]), "another seed is another start"
    other.load_state_dict(state)
    later.load_state_dict(room)
    assert [other.update(later) for _ in range(2)] == numbers
    assert_same_bits(other, whole)


def test_search_needs_a_data_center_for_each_candidate() -> None:
    with pytest.raises(ConfigError, match=r"learning\.candidates 65: there are 32 data centers"):
        algorithm("cross-entropy", Meeting(1), 1, candidates=65)
