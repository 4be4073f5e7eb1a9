"""Policies: their networks, their files, and the interface that they fit."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from policies import interface, network, policy
from sdc_taichi import SdcError, build_fleet, load_config
from sdc_taichi.envs.options import make_options
from sdc_taichi.learning.interface import Interface, interface_of
from sdc_taichi.learning.policy import WEIGHTS, About, Policy, PolicyNetwork
from sdc_taichi.types import F32

TWO_UNITS = ("hvac.crac.units=2",)


def by_numpy(net: PolicyNetwork, observations: F32) -> Any:
    """Outputs by the equations of a perceptron, in f64."""
    x = np.clip((observations.astype(float) - net.mean) / net.std, -net.clip, net.clip)
    for i, (weight, bias) in enumerate(net.layers):
        x = x @ weight.T + bias
        if i + 1 < len(net.layers):
            x = np.tanh(x) if net.activation == "tanh" else np.maximum(x, 0.0)
    return x


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("rows", [1, 7, 300])
def test_outputs_are_those_of_a_perceptron(seed: int, rows: int) -> None:
    net = network(("agent_bat",), 13, 6, seed=seed)
    observations = np.random.default_rng(9).normal(size=(rows, 13)).astype(np.float32)
    np.testing.assert_allclose(net.scores(observations), by_numpy(net, observations), atol=1e-5)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_row_is_the_same_alone_and_in_any_batch(seed: int) -> None:
    net = network(("agent_bat",), 13, 6, seed=seed)
    observations = np.random.default_rng(9).normal(size=(20_001, 13)).astype(np.float32)
    together = net.scores(observations)
    for i in (0, 1, 8, 12_345, 20_000):
        assert np.array_equal(net.scores(observations[i : i + 1])[0], together[i])


def test_heads_give_choices_and_numbers_within_the_space() -> None:
    observations = np.random.default_rng(9).normal(size=(50, 13)).astype(np.float32)
    net = network(("agent_bat",), 13, 6)
    scores = net.scores(observations)
    assert np.array_equal(net.actions(observations)[:, 1], scores[:, 3:].argmax(1))
    assert np.array_equal(replace(net, head="clip").actions(observations), scores.clip(-1, 1))
    assert np.array_equal(replace(net, head="tanh").actions(observations), np.tanh(scores))


def test_a_network_of_several_agents_reads_each_feature_once() -> None:
    fits = interface(agents=("agent_ls", "agent_bat"))
    rng = np.random.default_rng(1)
    seen: dict[str, F32] = {
        a: rng.uniform(size=(4, fits.width(a))).astype(np.float32) for a in fits.agents
    }
    names = {a: [f.name for f in fits.features[a] for _ in range(f.size)] for a in fits.agents}
    new = [i for i, name in enumerate(names["agent_bat"]) if name not in names["agent_ls"]]
    assert [names["agent_bat"][i] for i in new] == ["dc_load"]
    side_by_side = np.concatenate([seen["agent_ls"], seen["agent_bat"][:, new]], 1)
    net = network(fits.agents, side_by_side.shape[1], 6)
    actions = Policy((net,), fits, About(algorithm="none")).actions(seen)
    expected = net.actions(side_by_side)
    assert np.array_equal(actions["agent_ls"], expected[:, :1])
    assert np.array_equal(actions["agent_bat"], expected[:, 1:])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"std": np.zeros(13)}, r"std \(13,\) of mean \(13,\); valid is above 0"),
        ({"mean": np.full(13, np.nan)}, "mean has nan; valid is finite"),
        ({"mean": np.full(13, 1e39)}, r"mean has 1e\+39; valid is finite numbers of f32"),
        ({"std": np.full(13, 1e-60)}, r"std \(13,\) of mean \(13,\); valid is above 0"),
        ({"clip": 1e39}, r"clip 1e\+39; valid is a positive number of f32"),
        ({"layers": ((np.full((6, 13), -1e39), np.zeros(6)),)}, r"weight of layer 0 has -1e\+39"),
        ({"layers": ((np.zeros((6, 13)), np.full(6, 1e39)),)}, r"bias of layer 0 has 1e\+39"),
        (
            {"layers": ((np.zeros((6, 12)), np.zeros(6)),)},
            r"\(6, 12\).*valid is \(out, 13\)",
        ),
    ],
)
def test_networks_that_make_no_sense_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SdcError, match=message):
        replace(network(("agent_bat",), 13, 6), **changes)


def test_networks_that_do_not_fit_the_interface_are_refused() -> None:
    fits = interface(agents=("agent_bat",))
    n = fits.width("agent_bat")
    for net, message in (
        (network(("agent_ls",), n, 3), "networks of agent_ls; valid is one for each of agent_bat"),
        (network(("agent_bat",), n + 1, 3), f"{n + 1} inputs; observations have {n}"),
        (
            network(("agent_bat",), n, 1, "clip"),
            "head clip of 3; valid for discrete actions is argmax of 3",
        ),
    ):
        with pytest.raises(SdcError, match=message):
            Policy((net,), fits, About(algorithm="none"))


# Files


def test_a_policy_is_read_as_it_was_written(tmp_path: Path) -> None:
    made = policy(interface(actions="continuous", ci_leads_h=(1.0, 2.5)))
    made.save(tmp_path / "runs" / "a")
    read = Policy.load(tmp_path / "runs" / "a")
    assert (read.interface, read.about) == (made.interface, made.about)
    seen: dict[str, F32] = {
        a: np.random.default_rng(0).uniform(size=(5, made.interface.width(a))).astype(np.float32)
        for a in made.interface.agents
    }
    for agent, actions in made.actions(seen).items():
        assert np.array_equal(read.actions(seen)[agent], actions)


def test_the_best_policy_of_a_run_is_preferred(tmp_path: Path) -> None:
    fits = interface(agents=("agent_bat",))
    policy(fits, seed=1).save(tmp_path / "policy")
    assert Policy.load(tmp_path).about.seed == 1
    policy(fits, seed=2).save(tmp_path / "best")
    assert Policy.load(tmp_path).about.seed == 2
    assert Policy.load(tmp_path / "policy").about.seed == 1


def test_folders_without_a_policy_are_named(tmp_path: Path) -> None:
    with pytest.raises(SdcError, match=r"nowhere: no such folder"):
        Policy.load(tmp_path / "nowhere")
    with pytest.raises(SdcError, match=r"holds no policy; valid is the folder of a training run"):
        Policy.load(tmp_path)


def test_damaged_and_foreign_files_are_one_error_that_names_the_file(tmp_path: Path) -> None:
    from safetensors.numpy import save

    policy(interface(agents=("agent_bat",))).save(tmp_path)
    path = tmp_path / WEIGHTS
    whole = path.read_bytes()
    header = int.from_bytes(whole[:8], "little")
    for content in (
        b"",
        whole[: header // 2],
        whole[:-1],
        whole + b"x",
        save({"weight": np.zeros(3)}),
        save({"weight": np.zeros(3)}, {"policy": '{"format": 2}'}),
        whole.replace(b"0.mean", b"0.mild"),
        whole.replace(b"tanh", b"sinh").replace(b"relu", b"silu"),
        whole.replace(b'agent_bat\\": [', b'agent_bar\\": ['),
        whole[:-4] + np.float32(np.nan).tobytes(),
    ):
        path.write_bytes(content)
        with pytest.raises(SdcError, match=WEIGHTS) as failed:
            Policy.load(tmp_path)
        assert "\n" not in str(failed.value)


@pytest.mark.parametrize(
    "edit",
    [
        lambda x: x["interface"]["features"]["agent_bat"][0].update(size=10**9),
        lambda x: x["interface"]["features"]["agent_bat"][0].update(size=10**30),
        lambda x: x["interface"]["features"]["agent_bat"].extend(
            500 * x["interface"]["features"]["agent_bat"]
        ),
        lambda x: x["interface"].update(crac_units=10**12, commands={"agent_bat": ["cooling"]}),
        lambda x: x["interface"].update(
            agents=["crac"],
            commands={"crac": ["fan"]},
            features={"crac": x["interface"]["features"]["agent_bat"]},
            own_policies=["crac"],
            crac_units=10**12,
        ),
        lambda x: x["networks"][0].update(sizes=[10**9, *x["networks"][0]["sizes"][1:]]),
        lambda x: x["networks"][0].update(choices=10**12),
    ],
    ids=["entries", "more entries", "features", "units", "policies", "units of a layer", "choices"],
)
def test_sizes_in_the_header_are_compared_with_the_weights_before_memory_is_taken(
    edit: Callable[[Any], None], tmp_path: Path
) -> None:
    from safetensors.numpy import load, save

    policy(interface(agents=("agent_bat",))).save(tmp_path)
    path = tmp_path / WEIGHTS
    described = json.loads((tmp_path / "policy.json").read_text())
    edit(described)
    path.write_bytes(save(load(path.read_bytes()), {"policy": json.dumps(described)}))
    tracemalloc.start()
    try:
        with pytest.raises(SdcError, match=WEIGHTS):
            Policy.load(tmp_path)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 40 * path.stat().st_size + 1e6


def test_outputs_beyond_f32_are_an_error() -> None:
    net = network(("agent_bat",), 13, 6)
    huge = replace(net, layers=tuple((np.full_like(w, 3e38), b) for w, b in net.layers))
    with pytest.raises(SdcError, match="network of agent_bat: outputs beyond the range of f32"):
        huge.actions(np.ones((2, 13), dtype=np.float32))


# Interfaces


def test_options_of_an_interface_make_it_again() -> None:
    config = load_config("corrected", [*TWO_UNITS, "hvac.crac.flow_model=controlled"])
    fleet = build_fleet(config)
    for given in (
        {},
        {"agents": ("agent_bat",), "action_order": "sustaindc"},
        {"observations": "sustaindc", "agents": ("agent_ls",)},
        {"actions": "continuous", "setpoint_change_k": 1.0, "ci_leads_h": (2.0,)},
        {
            "actions": "continuous",
            "agents": ("agent_dc",),
            "commands": {"agent_dc": ("fan", "cooling")},
            "fan_change": 0.1,
            "features": {"agent_dc": ("fan_speed", "room")},
        },
    ):
        made = interface_of(fleet, make_options(**given))
        assert interface_of(fleet, made.options()) == made
        assert Interface.model_validate_json(made.model_dump_json()) == made


def test_the_difference_between_interfaces_is_named() -> None:
    base = interface()
    two_units = interface_of(build_fleet(load_config("corrected", [*TWO_UNITS])), make_options())
    (*others, soc) = base.features["agent_bat"]

    def with_soc(**changes: float) -> Interface:
        of_battery = (*others, soc.model_copy(update=changes))
        features = {**base.features, "agent_bat": of_battery}
        return base.model_copy(update={"features": features})

    assert base.difference(base) is None
    for other, said in (
        (interface(agents=("agent_ls",)), "agents: [agent_ls, agent_dc, agent_bat] in training"),
        (interface(actions="continuous"), "actions: discrete in training, continuous here"),
        (two_units, "CRAC units (hvac.crac.units): 1 in training, 2 here"),
        (
            interface(features={"agent_bat": ("soc",)}),
            "observation of agent_bat: feature 'time_of_day' (",
        ),
        (with_soc(high=2.0), "in training, feature 'soc' (1 of 0..2 share) here"),
    ):
        assert said in str(base.difference(other))


def test_data_centers_that_do_not_fit_are_refused() -> None:
    fits = interface()
    fits.require_fit("policy:x", build_fleet(load_config("tiny", ["site.location=ca"])))
    for preset, change, said in (
        ("tiny", "simulation.steps_per_hour=2", "step: 15 min in training, 30 min here"),
        ("corrected", *TWO_UNITS, r"CRAC units \(hvac.crac.units\): 1 in training, 2 here"),
    ):
        with pytest.raises(SdcError, match=rf"policy:x: does not fit these data centers \({said}"):
            fits.require_fit("policy:x", build_fleet(load_config(preset, [change])))
    fan = interface_of(
        build_fleet(load_config("tiny", ["hvac.crac.flow_model=controlled"])),
        make_options(agents=("agent_dc",), commands={"agent_dc": ("fan",)}),
    )
    with pytest.raises(SdcError, match=r"fan needs hvac\.crac\.flow_model=controlled"):
        fan.require_fit("policy:x", build_fleet(load_config("tiny")))
