"""Cloning: experts that a network can stand for are reproduced, and states go on as they were."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

import sdc_taichi  # noqa: E402
from sdc_taichi import make_controller  # noqa: E402
from sdc_taichi.errors import ConfigError  # noqa: E402
from sdc_taichi.learning.algorithms import ON_POLICY  # noqa: E402
from sdc_taichi.learning.cloning import Cloning, cloning_loss  # noqa: E402
from sdc_taichi.learning.on_policy import OnPolicy  # noqa: E402
from sdc_taichi.learning.settings import CloningSettings, OnPolicySettings  # noqa: E402
from sdc_taichi.learning.stream import EnvironmentStream  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")


def stream_of(seed: int = 0, **options: Any) -> EnvironmentStream:
    env = sdc_taichi.vector_env(
        4, "tiny", agents=["agent_dc"], days=1, autoreset_mode="SameStep", **options
    )
    return EnvironmentStream(env, shares_state=False, seed=seed)


def cloning_of(stream: EnvironmentStream, updates: int) -> Cloning:
    settings = CloningSettings(
        policy_share=0.5,
        epochs=20,
        batch_size=64,
        hidden=(16,),
        rate=0.02,
    )
    expert = make_controller("constant:21", stream.view.fleet)
    return Cloning(
        settings, expert, stream.spaces, episode_steps=stream.episode_steps, updates=updates, seed=3
    )


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_clone_keeps_the_setpoint_of_its_expert(actions: str) -> None:
    stream = stream_of(actions=actions)
    algorithm = cloning_of(stream, 3)
    for _ in range(3):
        logged = algorithm.update(stream)
    assert logged["agreement/agent_dc"] > 0.95
    (network,) = algorithm.networks()
    for _ in range(40):
        chosen = torch.from_numpy(network.actions(stream.observations["agent_dc"].numpy()))
        stream.step({"agent_dc": chosen})
    np.testing.assert_allclose(stream.view.setpoint_c, 21.0, atol=0.6)


def test_cloning_goes_on_from_its_state_to_the_same_bits() -> None:
    stream, other = stream_of(), stream_of()
    whole, resumed = cloning_of(stream, 3), cloning_of(other, 3)
    whole.update(stream)
    resumed.load_state_dict(copy.deepcopy(whole.state_dict()))
    other.load_state_dict(stream.state_dict())
    assert whole.update(stream) == resumed.update(other)
    for mine, given in zip(whole.networks(), resumed.networks(), strict=True):
        for (weight, bias), (other_weight, other_bias) in zip(
            mine.layers, given.layers, strict=True
        ):
            np.testing.assert_array_equal(weight, other_weight)
            np.testing.assert_array_equal(bias, other_bias)


@pytest.mark.parametrize("discrete", [True, False])
def test_gradient_of_the_loss_is_that_of_finite_differences(discrete: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    outputs = torch.randn(4, 6 if discrete else 2, generator=generator, dtype=torch.float64)
    advice = torch.tensor([[0, 2], [1, 1], [2, 0], [0, 0]])
    told = advice if discrete else advice.double() - 1.0
    assert torch.autograd.gradcheck(
        lambda x: cloning_loss(x, told, 3 if discrete else None), outputs.requires_grad_()
    )


def test_loss_of_choices_is_the_negative_log_likelihood() -> None:
    probabilities = torch.tensor([[0.2, 0.3, 0.5, 0.1, 0.6, 0.3]])
    loss = cloning_loss(probabilities.log(), torch.tensor([[2, 1]]), 3)
    assert float(loss) == pytest.approx(-0.5 * (np.log(0.5) + np.log(0.6)))


def test_trainings_start_from_a_clone() -> None:
    stream = stream_of()
    clone = cloning_of(stream, 1)
    clone.update(stream)
    settings = OnPolicySettings(hidden=(16,))
    started = OnPolicy(ON_POLICY["ippo"], settings, stream.spaces, 0, updates=1, seed=0)
    started.start_from(clone.networks(), 1000)
    seen = stream.observations["agent_dc"].numpy()
    (mine,), (given,) = started.networks(), clone.networks()
    np.testing.assert_allclose(mine.scores(seen), given.scores(seen), rtol=1e-5, atol=1e-6)
    wider = OnPolicy(ON_POLICY["ippo"], OnPolicySettings(), stream.spaces, 0, updates=1, seed=0)
    with pytest.raises(ConfigError, match=r"network of agent_dc: has .* units; valid here is"):
        wider.start_from(clone.networks(), 1000)
    with pytest.raises(ConfigError, match="has networks of agent_bat; valid is agent_dc"):
        started.start_from([replace(given, agents=("agent_bat",))], 1000)
