"""Cloning: experts that a network can stand for are reproduced, and states go on as they were."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

import sdc_taichi  # noqa: E402
from sdc_taichi.learning.cloning import Cloning, cloning_loss  # noqa: E402
from sdc_taichi.learning.settings import CloningSettings  # noqa: E402
from sdc_taichi.learning.stream import EnvironmentStream  # noqa: E402


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def stream_of(seed: int = 0, **options: Any) -> EnvironmentStream:
    env = sdc_taichi.vector_env(
        4, "tiny", agents=["agent_dc"], days=1, autoreset_mode="SameStep", **options
    )
    return EnvironmentStream(env, shares_state=False, seed=seed)


def cloning_of(stream: EnvironmentStream, updates: int) -> Cloning:
    settings = CloningSettings(
        expert="constant:21",
        policy_share=0.5,
        epochs=20,
        batch_size=64,
        hidden=(16,),
        learning_rate=0.02,
    )
    return Cloning(
        settings, stream.spaces, episode_steps=stream.episode_steps, updates=updates, seed=3
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
