"""Policies as ONNX models, in ONNX Runtime."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from policies import interface, network, policy
from sdc_taichi import build_fleet
from sdc_taichi.envs.options import make_options
from sdc_taichi.learning.interface import interface_of
from sdc_taichi.learning.policy import About, Policy
from sdc_taichi.types import F32
from small_halls import hall

runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: make test-train")
pytest.importorskip("onnx", reason="onnx is not installed: make test-train")


def outputs(path: Path, observations: dict[str, F32]) -> dict[str, Any]:
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, observations), strict=True))


def joint(actions: str) -> Policy:
    fits = interface(actions=actions)
    names = {f.name: f.size for agent in fits.agents for f in fits.features[agent]}
    outs, head = (9, "argmax") if actions == "discrete" else (3, "tanh")
    net = network(fits.agents, sum(names.values()), outs, head)  # type: ignore[arg-type]
    return Policy((net,), fits, About(algorithm="ppo"))


def continuous(head: Any) -> Policy:
    made = policy(interface(actions="continuous", agents=("agent_dc", "agent_bat")))
    return replace(made, networks=tuple(replace(n, head=head) for n in made.networks))


@pytest.mark.parametrize(
    "made",
    [
        policy(interface(), seed=3),
        continuous("clip"),
        continuous("tanh"),
        joint("discrete"),
        joint("continuous"),
    ],
    ids=["discrete", "clip", "tanh", "joint", "joint continuous"],
)
def test_the_model_acts_as_the_policy(made: Policy, tmp_path: Path) -> None:
    from sdc_taichi.learning.export import export_onnx

    path = tmp_path / "policy.onnx"
    export_onnx(made, path)
    rng = np.random.default_rng(2)
    observations: dict[str, F32] = {
        agent: rng.uniform(size=(30, made.interface.width(agent))).astype(np.float32)
        for agent in made.interface.agents
    }
    found = outputs(path, observations)
    for agent, actions in made.actions(observations).items():
        action = found[f"{agent}_action"]
        assert action.shape == actions.shape
        if made.interface.actions == "discrete":
            assert np.array_equal(action, actions)
        else:
            np.testing.assert_allclose(action, actions, atol=1e-5)
    for net in made.networks:
        if len(net.agents) == 1:
            (agent,) = net.agents
            expected = net.scores(observations[agent])
            np.testing.assert_allclose(found[f"{agent}_scores"], expected, atol=1e-5)
    assert len(np.unique([found[f"{agent}_action"] for agent in made.interface.agents])) > 1


def test_the_model_tells_what_it_fits(tmp_path: Path) -> None:
    from sdc_taichi.learning.export import export_onnx

    made = policy(interface(agents=("agent_bat",)), seed=4, decision_steps=4)
    export_onnx(made, tmp_path / "policy.onnx")
    session = runtime.InferenceSession(
        str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"]
    )
    texts = session.get_modelmeta().custom_metadata_map
    assert json.loads(texts["interface"]) == made.interface.model_dump(mode="json")
    assert json.loads(texts["about"])["seed"] == 4
    assert json.loads(texts["decision_steps"]) == 4


def test_a_group_that_shares_a_policy_is_one_input_with_a_row_for_each_agent(
    tmp_path: Path,
) -> None:
    from sdc_taichi.learning.export import export_onnx

    options = make_options(agents=("crac", "plant"), actions="continuous")
    made = policy(interface_of(build_fleet(hall(3)), options), seed=2, levels=5)
    path = tmp_path / "policy.onnx"
    export_onnx(made, path)
    rng = np.random.default_rng(2)
    of_units = rng.uniform(size=(2, 7, made.interface.width("crac"))).astype(np.float32)
    of_plant = rng.uniform(size=(2, made.interface.width("plant"))).astype(np.float32)
    found = outputs(path, {"crac": of_units.reshape(14, -1), "plant": of_plant})
    actions = made.actions({"crac": of_units, "plant": of_plant})
    assert actions["crac"].shape == (2, 7, 1)
    assert np.array_equal(found["crac_action"], actions["crac"].reshape(14, 1))
    assert np.array_equal(found["plant_action"], actions["plant"])
