"""Actors that HARL has stored, imported as policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from sdc_taichi import Simulator, load_config, make_controller, simulate
from sdc_taichi.cli.app import app
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.errors import SdcError
from sdc_taichi.learning.import_harl import import_harl
from sdc_taichi.learning.policy import Policy

torch = pytest.importorskip("torch")
WIDTHS = {"agent_ls": 26, "agent_dc": 14, "agent_bat": 13}


def actor(activation: str = "Tanh", hidden: tuple[int, ...] = (64, 32)) -> Any:
    """A network with the structure and the names of HARL's actors, with padded observations."""
    nn = torch.nn
    layers: list[Any] = []
    for ins, outs in zip((26, *hidden), hidden, strict=False):
        layers += [nn.Linear(ins, outs), getattr(nn, activation)(), nn.LayerNorm(outs)]
    made = nn.ModuleDict(
        {
            "base": nn.ModuleDict(
                {
                    "feature_norm": nn.LayerNorm(26),
                    "mlp": nn.ModuleDict({"fc": nn.Sequential(*layers)}),
                }
            ),
            "act": nn.ModuleDict(
                {"action_out": nn.ModuleDict({"linear": nn.Linear(hidden[-1], 3)})}
            ),
        }
    )
    for values in made.parameters():
        nn.init.normal_(values, std=0.5)
    return made


def scores_of(network: Any, observations: Any) -> Any:
    """Scores by PyTorch for observations without their padding, (B, 3)."""
    padded = np.pad(observations, ((0, 0), (0, 26 - observations.shape[1])))
    base = network["base"]
    seen = base["mlp"]["fc"](base["feature_norm"](torch.from_numpy(padded)))
    return network["act"]["action_out"]["linear"](seen).detach().numpy()


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    torch.manual_seed(3)
    paths = [tmp_path / f"actor_agent{i}.pt" for i in range(3)]
    for path in paths:
        torch.save(actor().state_dict(), path)
    return paths


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_scores_are_those_of_the_actor(activation: Any, tmp_path: Path) -> None:
    torch.manual_seed(1)
    networks = [actor({"tanh": "Tanh", "relu": "ReLU"}[activation]) for _ in AGENTS]
    paths = [tmp_path / f"{i}.pt" for i in range(3)]
    for network, path in zip(networks, paths, strict=True):
        torch.save(network.state_dict(), path)
    # The order of agents in the files may be any.
    made = import_harl(paths[::-1], AGENTS[::-1], activation)
    made.save(tmp_path / "policy")
    policy = Policy.load(tmp_path / "policy")
    rng = np.random.default_rng(2)
    by_agent = {a: rng.normal(0, 1, (50, n)).astype(np.float32) for a, n in WIDTHS.items()}
    by_agent["agent_ls"][0, 7] = 3e6  # A z-score in a window of constant values.
    actions = policy.actions(by_agent)
    for network, ours, agent in zip(networks, policy.networks, AGENTS, strict=True):
        expected = scores_of(network, by_agent[agent])
        found = ours.scores(by_agent[agent])
        assert np.allclose(found, expected, rtol=1e-3, atol=1e-3)
        assert np.array_equal(actions[agent][:, 0], expected.argmax(axis=1))
        assert np.array_equal(found[7:8], ours.scores(by_agent[agent][7:8]))


def test_an_imported_policy_runs(files: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "policy"
    done = call("policy", "import", *files, "--out", out)
    assert done.exit_code == 0, done.output
    assert "agent_ls, agent_dc, agent_bat" in done.output
    assert "exists" in call("policy", "import", *files, "--out", out).output
    assert "26 x 64 x 32 x 3, tanh_normalised" in call("policy", "show", out).output
    with Simulator(load_config("sustaindc")) as sim:
        assert simulate(sim, make_controller(f"policy:{out}", sim.fleet), 8).steps == 8
    one = call("policy", "import", files[1], "--agents", "agent_dc", "--out", tmp_path / "one")
    assert one.exit_code == 0, one.output
    exported = call("policy", "export", out, "--out", tmp_path / "policy.onnx")
    assert exported.exit_code != 0


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("code of the file",)


def test_files_that_are_no_actors(files: list[Path], tmp_path: Path) -> None:
    weights = torch.load(files[0], weights_only=True)
    bad = tmp_path / "bad.pt"

    def message(stored: Any) -> str:
        torch.save(stored, bad)
        with pytest.raises(SdcError) as raised:
            import_harl([bad], ["agent_ls"])
        return str(raised.value)

    assert "rnn.norm.weight" in message(weights | {"rnn.norm.weight": torch.zeros(3)})
    norm = {n: x for n, x in weights.items() if "feature_norm" not in n}
    assert "valid is the actor of a discrete action, not recurrent, with" in message(norm)
    cut = weights | {"base.mlp.fc.3.weight": torch.zeros(32, 63)}
    assert "bad.pt: network of agent_ls: layer 1 has weight (32, 63)" in message(cut)
    assert "cannot be read as weights of PyTorch" in message(Evil())
    with pytest.raises(SdcError, match="2 files for agents agent_ls; valid is one each"):
        import_harl(files[:2], ["agent_ls"])
