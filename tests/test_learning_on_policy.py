"""On-policy algorithms: losses, advantages, special cases that agree, and environments."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

from torch import Tensor  # noqa: E402

import sdc_taichi  # noqa: E402
from learning_games import Game, Rooms, Turnstile, assert_same_bits, weights  # noqa: E402
from sdc_taichi import load_config  # noqa: E402
from sdc_taichi.learning import on_policy  # noqa: E402
from sdc_taichi.learning.algorithms import ON_POLICY, OnPolicySettings  # noqa: E402
from sdc_taichi.learning.networks import (  # noqa: E402
    CLIP,
    Actor,
    Adam,
    Perceptrons,
    RunningMoments,
)
from sdc_taichi.learning.on_policy import (  # noqa: E402
    OnPolicy,
    generalised_advantages,
    policy_loss,
)
from sdc_taichi.learning.stream import EnvironmentStream, LearnerSpaces  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SMALL = OnPolicySettings(
    decision_steps=1,
    rollout_decisions=6,
    hidden=(16,),
    mini_batches=2,
    rate=0.01,
    discount=0.9,
    anneal=False,
)
TEAM = SMALL.model_copy(update={"reward": "team"})
QUICK = SMALL.model_copy(update={"rate": 0.05, "epochs": 3, "mini_batches": 1})
"""Settings that learn simple games in few updates."""


def algorithm(
    name: str,
    stream: Any,
    settings: OnPolicySettings = SMALL,
    *,
    updates: int = 100,
    seed: int = 0,
    threads: int = 1,
) -> Any:
    """An algorithm that takes a game for environments."""
    definition = ON_POLICY[name]
    return OnPolicy(definition, settings, stream, updates=updates, seed=seed, threads=threads)


def trained(name: str, game: Game, settings: OnPolicySettings = SMALL, **more: int) -> Any:
    algo = algorithm(name, game, settings, **more)
    for _ in range(more.get("updates", 100)):
        algo.update(game)
    return algo


# Losses


@pytest.fixture
def f64() -> Iterator[None]:
    """Lets new tensors have double precision."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def small_actor(*, discrete: bool, width: int = 2, activation: str = "tanh") -> Actor:
    """An actor of tiny layers, none of which is near 0."""
    generator = torch.Generator().manual_seed(1)
    spaces = LearnerSpaces(("a",), 3, width, 3 if discrete else None)
    settings = OnPolicySettings(hidden=(4, 5), activation=activation)  # type: ignore[arg-type]
    actor = Actor(spaces, settings, generator)
    with torch.no_grad():
        actor.net.weights += 0.3 * torch.randn(actor.net.weights.shape, generator=generator)
    return actor


def samples(actor: Actor, rows: int = 12) -> tuple[Tensor, Tensor]:
    """Observations, and actions that the actor drew."""
    generator = torch.Generator().manual_seed(2)
    seen = torch.randn(rows, 3, generator=generator)
    return seen, actor.sample(seen, generator)[0]


@pytest.mark.usefixtures("f64")
@pytest.mark.parametrize("discrete", [True, False])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_gradients_are_those_of_automatic_differentiation(discrete: bool, activation: str) -> None:
    actor = small_actor(discrete=discrete, activation=activation)
    seen, actions = samples(actor)
    generator = torch.Generator().manual_seed(3)
    before, gain = torch.randn(2, len(seen), generator=generator)
    before += actor.evaluate(seen, actions).log_p
    found = actor.evaluate(seen, actions)
    loss, of_log_p = policy_loss((found.log_p - before).exp(), gain, 0.2)
    assert 0 < int((of_log_p == 0).sum()) < len(seen), "some ratios are beyond the clip"
    reached = actor.gradient(found, of_log_p, -0.1)

    out = actor.net(seen)[0]
    log_std = actor.net.weights[-out.shape[1] :]
    each: Any = torch.distributions.Normal(out, log_std.exp())
    if discrete:
        each = torch.distributions.Categorical(logits=out.unflatten(-1, (-1, 3)))
    ratio = (each.log_prob(actions).sum(-1) - before).exp()
    surrogate = torch.minimum(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
    torch.testing.assert_close(loss, -surrogate)
    whole = -surrogate - 0.1 * each.entropy().sum(-1).mean()
    torch.testing.assert_close(reached, *torch.autograd.grad(whole, actor.net.weights))


@pytest.mark.usefixtures("f64")
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_ensembles_are_differentiable_in_weights_and_inputs(activation: str) -> None:
    settings = OnPolicySettings(hidden=(4, 5), activation=activation)  # type: ignore[arg-type]
    nets = Perceptrons(2, 3, 2, settings, torch.Generator().manual_seed(1))
    seen = samples(small_actor(discrete=True))[0].requires_grad_()
    out = nets(seen)
    for net in range(2):
        x = seen
        for i, (weight, bias) in enumerate(nets.layers(nets.weights.detach())):
            x = getattr(torch, activation)(x) if i else x
            x = x @ weight[net] + bias[net]
        torch.testing.assert_close(out[net], x)
    assert torch.autograd.gradcheck(nets, (seen, nets.weights))


def test_adam_is_that_of_pytorch() -> None:
    generator = torch.Generator().manual_seed(0)
    ours = torch.randn(9, generator=generator).requires_grad_()
    theirs = ours.detach().clone().requires_grad_()
    mine, other = Adam(ours, 0.1, 2.0, 1e-5), torch.optim.Adam([theirs], 0.1, eps=1e-5)
    for size in (0.1, 10.0, 1.0):
        gradient = size * torch.randn(9, generator=generator)
        theirs.grad = gradient.clone()
        torch.nn.utils.clip_grad_norm_([theirs], 2.0)
        other.step()
        mine.step(gradient)
        torch.testing.assert_close(ours, theirs)


def test_ratios_beyond_the_clip_pay_no_more() -> None:
    def loss(ratio: float, advantage: float) -> float:
        return float(policy_loss(torch.tensor([ratio]), torch.tensor([advantage]), 0.2)[0])

    assert loss(1.5, 1.0) == pytest.approx(-1.2)
    assert loss(0.5, -1.0) == pytest.approx(0.8)
    assert loss(0.5, 1.0) == pytest.approx(-0.5)
    assert loss(1.5, -1.0) == pytest.approx(1.5)
    assert float(policy_loss(torch.tensor([1.5]), torch.ones(1), None)[0]) == pytest.approx(-1.5)


@pytest.mark.usefixtures("f64")
@pytest.mark.parametrize("discrete", [True, False])
def test_probabilities_and_entropy_are_those_of_independent_numbers(discrete: bool) -> None:
    actor = small_actor(discrete=discrete, width=3)
    seen, actions = samples(actor)
    found = actor.evaluate(seen, actions)
    out = actor.net(seen)[0]
    if discrete:
        each: Any = torch.distributions.Categorical(logits=out.unflatten(-1, (3, 3)))
    else:
        each = torch.distributions.Normal(out, actor.log_std.exp())
    torch.testing.assert_close(found.log_p, each.log_prob(actions).sum(-1))
    torch.testing.assert_close(found.entropy, each.entropy().sum(-1).mean())


def test_actions_are_drawn_as_often_as_they_are_probable() -> None:
    actor = small_actor(discrete=True)
    seen = samples(actor, 1)[0].expand(20_000, -1)
    actions, log_p = actor.sample(seen, torch.Generator().manual_seed(5))
    probabilities = actor.net(seen[:1])[0, 0].unflatten(-1, (2, 3)).softmax(-1)
    for number in range(2):
        drawn = torch.bincount(actions[:, number], minlength=3) / len(actions)
        torch.testing.assert_close(drawn, probabilities[number], atol=0.02, rtol=0)
    torch.testing.assert_close(log_p, actor.evaluate(seen, actions).log_p)


# Advantages and normalisation


def test_advantages_are_those_of_a_plain_loop_and_stop_where_an_episode_does() -> None:
    generator = torch.Generator().manual_seed(0)
    rewards, values, later = torch.randn(3, 7, 2, generator=generator)
    ended = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    settings = {"discount": 0.9, "gae_lambda": 0.8}
    found = generalised_advantages(rewards, values, later, ended, **settings)
    for t in range(7):
        last = 2 if t <= 2 else 6
        for b in range(2):
            expected = sum(
                (0.9 * 0.8) ** (u - t) * float(rewards[u, b] + 0.9 * later[u, b] - values[u, b])
                for u in range(t, last + 1)
            )
            assert float(found[t, b]) == pytest.approx(expected, rel=1e-4, abs=1e-5)


def critic_says(values: Mapping[str, Any], inputs: Mapping[str, Any], seen: Tensor) -> Tensor:
    """Value that a critic's ``state_dict`` gives what is seen, in rewards."""
    net = Perceptrons(1, seen.shape[-1], 1, SMALL, torch.Generator())
    moments, returns = RunningMoments(seen.shape[-1]), RunningMoments(1)
    moments.load_state_dict(dict(inputs))
    returns.load_state_dict(values["returns"])
    value = net(moments.normalise(seen), values["adam"]["weights"])[0, :, 0]
    return value * returns.std + returns.mean.float()


def test_values_go_on_beyond_the_end_of_an_episode_and_not_into_the_next() -> None:
    settings = QUICK.model_copy(update={"rollout_decisions": 10, "anneal": True, "epochs": 6})
    algo = trained("ippo", Turnstile(), settings, updates=50)
    critic = algo.state_dict()["critics"]["player_0"]
    paid, unpaid = critic_says(critic, critic["inputs"], torch.eye(2)).tolist()
    assert paid == pytest.approx(1 / (1 - 0.9), abs=0.5)
    assert unpaid == pytest.approx(0.0, abs=0.5)


def test_running_moments_are_those_of_all_rows() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(100.0, [1e-4, 2.0, 30.0], (600, 3))
    moments = RunningMoments(3)
    for part in np.split(rows, [1, 100, 350]):
        moments.add(torch.from_numpy(part))
    np.testing.assert_allclose(moments.mean.numpy(), rows.mean(0), rtol=1e-9)
    np.testing.assert_allclose(moments.variance.numpy(), rows.var(0), rtol=1e-6)
    assert moments.count == 600
    normal = moments.normalise(torch.tensor([[1e9, 100.0, -1e9]]))[0]
    assert normal[[0, 2]].tolist() == [CLIP, -CLIP]


# Cases of one update


@pytest.mark.parametrize("discrete", [True, False])
def test_happo_and_mappo_of_one_learner_are_ppo_to_the_bit(discrete: bool) -> None:
    ppo = trained("ppo", Rooms(1, discrete), updates=4)
    for name in ("ippo", "mappo", "happo"):
        assert_same_bits(trained(name, Rooms(1, discrete), updates=4), ppo)


@pytest.mark.parametrize("name", ["ippo", "happo"])
def test_threads_change_no_bit(name: str) -> None:
    one, several = (trained(name, Rooms(3), updates=4, threads=n) for n in (1, 3))
    assert_same_bits(several, one)


def test_mappo_with_critics_of_own_observations_and_rewards_is_ippo_to_the_bit() -> None:
    apart = SMALL.model_copy(update={"critic": "observation", "reward": "own"})
    ippo = trained("ippo", Rooms(3), updates=4)
    assert_same_bits(trained("mappo", Rooms(3), apart, updates=4), ippo)
    learned = np.concatenate([w.ravel() for w in weights(ippo)])
    mappo = trained("mappo", Rooms(3), TEAM, updates=4)
    other = np.concatenate([w.ravel() for w in weights(mappo)])
    assert not np.array_equal(learned, other)


def test_advantages_are_weighed_by_the_ratios_of_learners_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    game = Rooms(3)
    # HAPPO is alike but for clipping, and learns from rows in an order that is not known here.
    assert ON_POLICY["happo"]._replace(clips=False) == ON_POLICY["haa2c"]
    algo = algorithm("haa2c", game, TEAM)
    algo.update(game)
    weighed: list[Tensor] = []
    rows: list[tuple[Tensor, dict[str, Tensor]]] = []

    def loss(ratio: Tensor, advantages: Tensor, clip: float | None) -> tuple[Tensor, Tensor]:
        weighed.append(advantages)
        return policy_loss(ratio, advantages, clip)

    def step(actions: dict[str, Tensor]) -> Any:
        rows.append((game.state, {n: a.clone() for n, a in actions.items()}))
        return type(game).step(game, actions)

    monkeypatch.setattr(on_policy, "policy_loss", loss)
    monkeypatch.setattr(game, "step", step)
    before = copy.deepcopy(algo.state_dict()["learners"])
    logged = algo.update(game)
    after = algo.state_dict()["learners"]
    order = [key.partition("/")[2] for key in logged if key.startswith("policy_loss/")]
    seen = torch.cat([state for state, _ in rows])

    def log_p(of: Mapping[str, Any], learner: str) -> Tensor:
        actor = Actor(game.spaces[learner], SMALL, torch.Generator())
        Adam(actor.net.weights, 0.0).load_state_dict(of[learner]["actor"])
        moments = RunningMoments(3)
        moments.load_state_dict(before[learner]["moments"])
        made = torch.cat([actions[learner] for _, actions in rows])
        return actor.evaluate(moments.normalise(seen), made).log_p

    product = torch.ones(len(seen))
    for learner, found in zip(order, weighed, strict=True):
        torch.testing.assert_close(found, weighed[0] * product, rtol=1e-4, atol=1e-5)
        product = product * (log_p(after, learner) - log_p(before, learner)).exp()
    assert float((weighed[2] - weighed[0]).abs().max()) > 1e-3


def test_learning_rate_falls_to_nothing_over_the_training() -> None:
    game = Rooms()
    algo = algorithm("ippo", game, SMALL.model_copy(update={"anneal": True}), updates=4)
    for _ in range(5):
        last = weights(algo)
        algo.update(game)
    for before, after in zip(last, weights(algo), strict=True):
        np.testing.assert_array_equal(before, after)


# Environments


@pytest.mark.parametrize(
    ("count", "options", "widths"),
    [
        (1, {}, {"agent_ls": 1, "agent_dc": 1, "agent_bat": 1}),
        (3, {"agents": ["agent_dc", "agent_bat"]}, {"agent_dc": 2, "agent_bat": 1}),
        (2, {"actions": "continuous", "agents": ["agent_ls", "agent_dc"]}, {"joint": 3}),
    ],
)
def test_learners_of_environments(
    count: int, options: dict[str, Any], widths: dict[str, int]
) -> None:
    """Learners of one data center, of some agents, and of all; a unit of cooling or two."""
    joint = "joint" in widths
    config = load_config("corrected", ["hvac.crac.units=2"]) if len(widths) < 3 else "tiny"
    env = sdc_taichi.vector_env(count, config, autoreset_mode="SameStep", days=1, **options)
    stream = EnvironmentStream(env, joint=joint, seed=1)
    assert {name: of.action_width for name, of in stream.spaces.items()} == widths
    algo = algorithm("ppo" if joint else "happo", stream)
    for _ in range(2):
        logged = algo.update(stream)
    assert all(math.isfinite(value) for value in logged.values())
    assert [net.agents for net in algo.networks()] == [of.agents for of in stream.spaces.values()]
    assert sum(key.startswith("entropy/") for key in logged) == len(stream.spaces)
    env.close()
