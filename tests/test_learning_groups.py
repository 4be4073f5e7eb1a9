"""Learners of groups: agents that share a policy, agents without effect, and halls."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

from torch import Tensor  # noqa: E402

import sdc_taichi  # noqa: E402
from learning_games import OFF, ON, SEARCH, Crowd, assert_same_bits, weights  # noqa: E402
from sdc_taichi.control import view_maker  # noqa: E402
from sdc_taichi.errors import ConfigError  # noqa: E402
from sdc_taichi.learning import on_policy  # noqa: E402
from sdc_taichi.learning.algorithms import (  # noqa: E402
    LearningSettings,
    uses_state,
)
from sdc_taichi.learning.controller import PolicyController  # noqa: E402
from sdc_taichi.learning.interface import interface_of  # noqa: E402
from sdc_taichi.learning.networks import Actor, Adam, RunningMoments  # noqa: E402
from sdc_taichi.learning.on_policy import policy_loss  # noqa: E402
from sdc_taichi.learning.policy import About, Policy  # noqa: E402
from sdc_taichi.learning.stream import EnvironmentStream  # noqa: E402
from sdc_taichi.learning.trainer import make_algorithm  # noqa: E402
from sdc_taichi.sim.simulator import Simulator  # noqa: E402
from small_halls import DOWN, hall  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SETTINGS: dict[str, LearningSettings] = {
    **dict.fromkeys(("ippo", "mappo", "happo", "haa2c"), ON),
    **dict.fromkeys(("had3qn", "hasac"), OFF),
    "cross-entropy": SEARCH,
}


def trained(name: str, game: Any, updates: int, **changes: Any) -> Any:
    settings = SETTINGS[name].model_copy(update=changes)
    made = make_algorithm(name, settings, game, updates=updates, seed=0)
    for _ in range(updates):
        made.update(game)
    return made


# Games


@pytest.mark.parametrize("name", ["ippo", "happo", "had3qn", "hasac", "cross-entropy"])
def test_agents_that_share_a_policy_choose_by_what_each_sees(name: str) -> None:
    learner = trained(name, Crowd(), 30 if SETTINGS[name] is ON else 60)
    chosen = learner.networks()[0].actions(torch.eye(3).numpy())
    assert chosen[:, 0].tolist() == [0, 1, 2]


def test_agents_of_a_group_learn_as_those_of_as_many_data_centers_to_the_bit() -> None:
    alone, shared = (Crowd(alone=alone) for alone in (True, False))
    del shared.spaces["player_0"]
    of_group = type(shared).step

    def step(actions: dict[str, Tensor]) -> Any:
        return of_group(shared, actions | {"player_0": torch.zeros(shared.size, 1)})

    shared.step = step  # type: ignore[method-assign]
    assert_same_bits(trained("ippo", shared, 4), trained("ippo", alone, 4))


@pytest.mark.parametrize(
    ("name", "discrete"),
    [*((name, True) for name in SETTINGS if name != "cross-entropy"), ("hasac", False)],
)
def test_agents_without_effect_change_no_weight(name: str, discrete: bool) -> None:
    """Observations and rewards of masked agents are random, with another seed in each game."""
    game, other = Crowd((1,), discrete=discrete), Crowd((1,), discrete=discrete)
    other.noise.manual_seed(1)
    learner = trained(name, game, 3)
    assert_same_bits(learner, trained(name, other, 3))
    another = weights(trained(name, Crowd((2,), discrete=discrete), 3))
    assert not np.array_equal(weights(learner)[0], another[0])


def test_weights_of_happo_multiply_the_ratios_of_all_agents_that_act(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    game: Any = Crowd((1,))
    algo: Any = make_algorithm("haa2c", ON, game, updates=9, seed=0)
    algo.update(game)
    weighed: dict[int, Tensor] = {}
    rows: list[tuple[Tensor, Tensor]] = []

    def loss(ratio: Tensor, advantages: Tensor, clip: float | None) -> tuple[Tensor, Tensor]:
        weighed[len(advantages)] = advantages
        return policy_loss(ratio, advantages, clip)

    def step(actions: dict[str, Tensor]) -> Any:
        rows.append((seen["group"], actions["group"].clone()))
        return type(game).step(game, actions)

    monkeypatch.setattr(on_policy, "policy_loss", loss)
    monkeypatch.setattr(game, "step", step)
    tables = 6 * game.size
    for _ in range(20):  # until the group is updated before the player
        seen = game.observations
        before = copy.deepcopy(algo.state_dict()["learners"]["group"])
        rows.clear()
        logged = algo.update(game)
        if next(key for key in logged if key.startswith("policy_loss/")).endswith("group"):
            break
    after = algo.state_dict()["learners"]["group"]
    moments = RunningMoments(3)
    moments.load_state_dict(before["moments"])

    def log_p(of: Any) -> Tensor:
        actor = Actor(game.spaces["group"], ON, torch.Generator())
        Adam(actor.net.weights, 0.0).load_state_dict(of["actor"])
        inputs = moments.normalise(torch.cat([x for x, _ in rows]))
        return actor.evaluate(inputs, torch.cat([x for _, x in rows])).log_p

    ratio = (log_p(after) - log_p(before)).exp().view(tables, 3)
    product = ratio[:, 0] * ratio[:, 2]
    of_group, of_player = weighed[2 * tables].view(tables, 2), weighed[tables]
    torch.testing.assert_close(of_player, of_group[:, 0] * product, rtol=1e-4, atol=1e-5)
    assert torch.equal(of_group[:, 0], of_group[:, 1])
    assert float((product - 1.0).abs().max()) > 1e-2


# Halls


HALL_ON = ON.model_copy(update={"rollout_decisions": 3, "hidden": (8,)})
HALL_OFF = OFF.model_copy(update={"batch_size": 16, "levels": 3, "hidden": (8,)})
CASES: dict[str, tuple[str, LearningSettings, bool]] = {
    "ppo": ("ppo", HALL_ON, False),
    **{name: (name, HALL_ON, False) for name in ("ippo", "mappo", "happo", "haa2c")},
    "ippo of the state": ("ippo", HALL_ON.model_copy(update={"critic": "state"}), False),
    "ippo of the team": ("ippo", HALL_ON.model_copy(update={"reward": "team"}), False),
    "happo apart": ("happo", HALL_ON.model_copy(update={"levels": None}), True),
    "had3qn": ("had3qn", HALL_OFF, False),
    "hasac": ("hasac", HALL_OFF, False),
    "hasac of numbers": ("hasac", HALL_OFF.model_copy(update={"levels": None}), False),
    "hasac apart": ("hasac", HALL_OFF, True),
    "cross-entropy": ("cross-entropy", SEARCH.model_copy(update={"candidates": 2}), False),
}


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    """Two halls, in one of which unit 1 is down at first; episodes end after eight steps."""
    made = sdc_taichi.hall_env([hall(3), hall(3, *DOWN)], 2, autoreset_mode="SameStep")
    made.core.end_after(8)
    yield made
    made.close()


@pytest.fixture(scope="module")
def others() -> Iterator[Simulator]:
    sim = Simulator([hall(5), hall(2)])
    sim.reset(0)
    yield sim
    sim.close()


@pytest.mark.parametrize("case", CASES)
def test_policies_of_halls(case: str, env: Any, others: Simulator, tmp_path: Path) -> None:
    """Every algorithm trains, resumes to the same bits, and controls halls of other sizes."""
    name, settings, apart = CASES[case]
    of_env: dict[str, Any] = {
        "joint": name == "ppo",
        "own_policies": ("crac",) if apart else (),
        "levels": settings.levels,
        "shares_state": uses_state(name, settings),
    }

    def begun() -> tuple[Any, EnvironmentStream]:
        stream = EnvironmentStream(env, **of_env, seed=1)
        return make_algorithm(name, settings, stream, updates=3, seed=0), stream

    algo, stream = begun()
    assert (case == "ppo") == (not stream.masks)
    if not apart and name != "ppo":
        assert stream.spaces["crac"].count == 3
        assert stream.observations["crac"].shape == (6, stream.spaces["crac"].observation_width)
    for _ in range(2):
        algo.update(stream)
    saved = copy.deepcopy((algo.state_dict(), stream.state_dict()))
    logged = algo.update(stream)
    again, stream = begun()
    again.load_state_dict(saved[0])
    stream.load_state_dict(saved[1])
    assert again.update(stream) == logged
    assert_same_bits(again, algo)

    fits = interface_of(env.core.sim.fleet, env.core.options, stream.own_policies)
    Policy(algo.networks(), fits, About(algorithm=name)).save(tmp_path)
    policy = Policy.load(tmp_path)
    members = ("crac_0", "crac_1", "crac_2")
    agents = [network.agents for network in policy.networks]
    if apart or name == "ppo":
        each = [(*members, "plant")] if name == "ppo" else [(x,) for x in (*members, "plant")]
        assert agents == each
        message = r"CRAC units .*: 3 in training, 2 here|same number of CRAC units"
        with pytest.raises(ConfigError, match=message):
            PolicyController(policy, others.fleet)
        controlled = env.core.sim
    else:
        assert agents == [("crac",), ("plant",)]
        controlled = others
    controller = PolicyController(policy, controlled.fleet)
    controlled.reset(0)
    commands = controller.act(view_maker(controlled)(None))
    assert commands.fan is not None
    assert np.asarray(commands.fan).shape == (controlled.fleet.units,)
    drawn = {
        learner: torch.from_numpy(network.actions(stream.observations[learner].numpy()))
        for learner, network in zip(stream.learners, policy.networks, strict=True)
    }
    expected, actions = stream._by_agent(drawn), policy.actions(env.core.observe())
    for group in ("crac", "plant"):
        np.testing.assert_array_equal(actions[group], expected[group])


def test_units_that_are_down_are_masked_and_have_no_part_in_the_mean(env: Any) -> None:
    stream = EnvironmentStream(env, levels=None, seed=1)
    assert stream.masks["crac"].all()
    actions = {"crac": torch.zeros(6, 1), "plant": torch.zeros(2, 1)}
    after = stream.step(actions)
    assert stream.masks["crac"].tolist() == [True, True, True, True, False, True]
    assert torch.equal(after.next_masks["crac"], stream.masks["crac"])
    torch.testing.assert_close(after.mean_rewards["crac"], after.rewards["crac"].view(2, 3).mean(1))
    assert torch.equal(after.mean_rewards["plant"], after.rewards["plant"])
