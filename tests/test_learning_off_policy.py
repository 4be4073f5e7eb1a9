"""HAD3QN and HASAC: losses, critics, replay and refused settings."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

from torch import Tensor  # noqa: E402

from learning_games import Aim, Coordination, Meeting  # noqa: E402
from sdc_taichi.errors import ConfigError, SdcError  # noqa: E402
from sdc_taichi.learning.algorithms import OFF_POLICY, OffPolicySettings  # noqa: E402
from sdc_taichi.learning.networks import ContinuousValues, JointValues, expected  # noqa: E402
from sdc_taichi.learning.off_policy import (  # noqa: E402
    OffPolicy,
    Replay,
)
from sdc_taichi.learning.off_policy_actors import (  # noqa: E402
    GaussianActors,
    best_replies,
    squashed,
)

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SMALL = OffPolicySettings(hidden=(16,), temperature=0.1)


def normal(*shape: int, seed: int = 0, requires_grad: bool = False) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(*shape, generator=generator, dtype=torch.float64)
    return values.requires_grad_(requires_grad)


def test_a_dueling_table_has_every_joint_action_in_the_order_of_its_choices() -> None:
    critic = JointValues(1, 2, 3, SMALL, torch.Generator().manual_seed(0))
    state = torch.randn(1, 2, generator=torch.Generator().manual_seed(1))
    table = critic(state)[0, 0]
    for i, choices in enumerate(itertools.product(range(3), repeat=3)):
        assert critic.of_actions(state, torch.tensor([choices]))[0, 0] == table[i]
    assert len(table.unique()) == 27


def test_the_expected_value_of_open_choices_is_that_of_each_of_them() -> None:
    table = normal(2, 27)
    probabilities = normal(2, 3, 3, seed=1).softmax(-1)
    rows = expected(table, probabilities, (0, 2))
    for first, last in itertools.product(range(3), repeat=2):
        fixed = probabilities.clone()
        fixed[:, 0] = torch.nn.functional.one_hot(torch.tensor(first), 3)
        fixed[:, 2] = torch.nn.functional.one_hot(torch.tensor(last), 3)
        torch.testing.assert_close(rows[:, 3 * first + last], expected(table, fixed)[:, 0])


def test_the_density_of_squashed_numbers_integrates_to_one() -> None:
    actions = torch.linspace(-0.9999, 0.9999, 20_001, dtype=torch.float64)[:, None]
    mean, log_std = torch.full_like(actions, 0.4), torch.full_like(actions, -0.5)
    noise = (actions.atanh() - mean) / log_std.exp()
    drawn, log_p = squashed(mean, log_std, noise)
    torch.testing.assert_close(drawn, actions)
    assert torch.trapezoid(log_p.exp(), actions[:, 0]).item() == pytest.approx(1.0, abs=1e-3)


def test_each_choice_is_the_best_reply_to_those_before_it() -> None:
    table = Coordination.rewards.flatten()[None]
    choices = torch.tensor([[2, 2]])
    first, second = best_replies({0: table, 1: table}, choices, 3)[0]
    assert first.tolist() == [4.0, 2.0, 3.0]
    assert second.tolist() == [5.0, -3.0, 4.0]  # the first has moved to 0


def filled_replay(
    steps: int, *, rows: int = 6, n_steps: int = 3, ends: Sequence[int] = ()
) -> Replay:
    """Step t of environment e has situation and action 10 t + e and reward 1."""
    replay = Replay(2 * rows, 2, 1, 1, steps=n_steps, discount=0.5)
    for t in range(steps):
        at = torch.tensor([[10.0 * t], [10.0 * t + 1]])
        replay.add(at, at, torch.ones(2, 1))
        if t in ends:
            replay.end(at + 10.0)
    return replay


def drawn_from(replay: Replay) -> set[tuple[float, ...]]:
    drawn = replay.sample(400, torch.Generator().manual_seed(0))
    columns = (
        drawn.before[:, 0],
        drawn.actions[:, 0],
        drawn.steps,
        drawn.returns[0],
        drawn.after[:, 0],
    )
    return set(zip(*(x.tolist() for x in columns), strict=True))


def test_transitions_take_n_steps_or_those_that_there_are() -> None:
    wanted = {(0, 3, 1.75, 30), (10, 2, 1.5, 30), (20, 1, 1.0, 30)}
    expected_rows = {(b + e, b + e, n, r, a + e) for b, n, r, a in wanted for e in (0, 1)}
    assert drawn_from(filled_replay(4)) == expected_rows


def test_transitions_end_with_the_situation_that_their_episode_was_cut_off_in() -> None:
    # Two steps, the end at 20, then steps from 20 on of the next episode.
    wanted = {(0, 2, 1.5, 20), (10, 1, 1.0, 20), (20, 1, 1.0, 30)}
    expected_rows = {(b + e, b + e, n, r, a + e) for b, n, r, a in wanted for e in (0, 1)}
    assert drawn_from(filled_replay(4, ends=[1])) == expected_rows


def test_a_full_replay_holds_the_latest_steps() -> None:
    befores = {before // 10 for before, *_ in drawn_from(filled_replay(20))}
    assert befores == {14, 15, 16, 17, 18}


def test_a_replay_goes_on_from_its_state() -> None:
    first, second = filled_replay(8, ends=[6]), filled_replay(1)
    second.load_state_dict(first.state_dict())
    assert drawn_from(second) == drawn_from(first)
    with pytest.raises(SdcError, match="state: replay is"):
        filled_replay(1, rows=5).load_state_dict(first.state_dict())


def test_a_replay_too_small_for_its_transitions_is_refused() -> None:
    with pytest.raises(ConfigError, match="replay_size 8: holds 4 steps of 2 data centers"):
        Replay(8, 2, 1, 1, steps=3, discount=0.9)


def test_temperatures_rise_below_the_wanted_entropy_and_fall_above_it() -> None:
    game: Any = Aim(players=2, discrete=False)
    critic = ContinuousValues(1, 1, 2, SMALL, torch.Generator())
    actors = GaussianActors(critic, game.spaces, SMALL, 1, torch.Generator())
    for name, entropy in zip(game.spaces, (-1.1, -0.9), strict=True):
        loss = actors.nets[name](torch.ones(1, 1)).sum()
        actors._step(name, loss, torch.tensor(entropy))
    low, high = map(actors.temperature, game.spaces)
    assert low > SMALL.temperature > high


def test_actions_that_an_algorithm_does_not_take_are_refused() -> None:
    for name, game, said in (
        ("had3qn", Aim(players=2, discrete=False), "had3qn: learns choices alone"),
        ("hasac", Meeting(players=1, width=7), "7 choices of 3 in a step are 2187 joint actions"),
    ):
        stream: Any = game
        with pytest.raises(ConfigError, match=said):
            OffPolicy(OFF_POLICY[name], SMALL, stream, updates=1, seed=0)
