"""Import of policies that HARL has trained on the released SustainDC.

HARL (github.com/HewlettPackard/dc-rl, ``harl/models``) stores the weights of each actor in a file,
``models/actor_agent0.pt`` and so on. The observations of all agents are padded with zeros to the
longest. They pass a layer normalisation, hidden layers that are each followed by a layer
normalisation, and a linear layer with a score for each action.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.config import load_config
from sdc_taichi.envs.options import make_options
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.learning.interface import Interface, interface_of
from sdc_taichi.learning.policy import (
    MOST_BYTES,
    NORMALISED,
    About,
    Activation,
    Policy,
    PolicyNetwork,
)
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.types import F32
from sdc_taichi.user_file import decoding, read_bytes

_INPUT_NORM = "base.feature_norm"
_LAYER = "base.mlp.fc.{}"
_SCORES = "act.action_out.linear"
_HIDDEN = re.compile(r"base\.mlp\.fc\.(\d+)\.weight")


def import_harl(
    files: Sequence[Path], agents: Sequence[str], activation: Activation = "tanh"
) -> Policy:
    """Return the policy of actors that HARL has stored.

    Args:
        files: file of the weights of each agent's actor.
        agents: agents that the actors act for, in the order of ``files``.
        activation: activation function of the hidden layers, which the files do not contain.

    Raises:
        ConfigError: PyTorch is not installed, or agents and files do not fit.
        SdcError: a file is not such an actor.
    """
    if len(files) != len(agents):
        raise ConfigError(f"{len(files)} files for agents {', '.join(agents)}; valid is one each")
    options = make_options(agents=tuple(agents), observations="sustaindc")
    fits = interface_of(build_fleet([load_config("sustaindc")]), options)
    of_agents = dict(zip(agents, files, strict=True))
    networks = [_network(of_agents[agent], agent, fits, activation) for agent in fits.agents]
    return Policy(tuple(networks), fits, About(algorithm="harl", version=version("sdc-taichi")))


def _network(file: Path, agent: str, fits: Interface, activation: Activation) -> PolicyNetwork:
    """Return the network of an agent from the file of its actor."""
    arrays = _arrays(file)
    hidden = sorted(int(match[1]) for name in arrays if (match := _HIDDEN.fullmatch(name)))
    # Linear layers and layer normalisations alternate, with the activation between them.
    linear = [_LAYER.format(i) for i in hidden[::2]] + [_SCORES]
    norms = [_INPUT_NORM, *(_LAYER.format(i) for i in hidden[1::2])]
    expected = {f"{name}.{part}" for name in (*linear, *norms) for part in ("weight", "bias")}
    if expected != set(arrays) or len(linear) != len(norms):
        odd = sorted(expected ^ set(arrays))
        raise SdcError(
            f"{file}: {shortened(odd[0] if odd else hidden)}: valid is the actor of a discrete "
            "action, not recurrent, with use_feature_normalization"
        )
    width = fits.width(agent)
    try:
        return PolicyNetwork(
            agents=(agent,),
            mean=np.zeros(width, dtype=np.float32),
            std=np.ones(width, dtype=np.float32),
            clip=float(np.finfo(np.float32).max),
            layers=tuple((arrays[f"{n}.weight"], arrays[f"{n}.bias"]) for n in linear),
            activation=NORMALISED[activation],
            head="argmax",
            norms=tuple((arrays[f"{n}.weight"], arrays[f"{n}.bias"]) for n in norms),
        )
    except SdcError as error:
        raise SdcError(f"{file}: {error}") from None


def _arrays(file: Path) -> dict[str, F32]:
    """Return the arrays of a file that PyTorch has written, by name; it cannot run code."""
    try:
        import torch
    except ImportError:
        raise ConfigError(
            'PyTorch is not installed; valid is after pip install "sdc-taichi[train]"'
        ) from None
    read_bytes(file, MOST_BYTES)
    with decoding(file, "weights of PyTorch"):
        stored: Any = torch.load(file, map_location="cpu", weights_only=True)
        return {str(name): values.float().numpy() for name, values in stored.items()}
