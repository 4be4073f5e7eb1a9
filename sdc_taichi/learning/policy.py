"""Trained policies: networks with the interface of the environments that they fit, and their files.

A policy is a single file, ``policy.safetensors``, which holds the networks as arrays and everything
else as JSON in its header. ``policy.json`` is a readable copy of the header.

In shapes, B is the number of environments or data centers, n the number of entries of an
observation, and k the number of actions. Arrays of a group with an agent for each of up to W CRAC
units have the units as second axis.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.config import explain
from sdc_taichi.config.fields import Section
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, group_of
from sdc_taichi.envs.features import entries_of_new_features
from sdc_taichi.errors import SdcError, shortened
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.compiler.arrays import aligned
from sdc_taichi.kernels.perceptron_arguments import (
    PERCEPTRON_ARGUMENTS,
    RELU,
    ROWS,
    TANH,
    UNITS,
)
from sdc_taichi.learning.interface import Interface
from sdc_taichi.types import F32, I64
from sdc_taichi.user_file import decoding, read_bytes

WEIGHTS, DESCRIPTION = "policy.safetensors", "policy.json"
"""Names of the files of a policy."""
FOLDERS = ("best", "policy")
"""Subfolders of a training that can contain a policy, in order of preference."""
CHOICES = 3
"""Number of options of a discrete action."""
MOST_BYTES = 256_000_000
"""Maximum size of a policy file, in bytes (about 60 million weights)."""
MOST_DECISION_STEPS = 96
"""Maximum number of steps from one decision to the next."""
Activation = Literal["tanh", "relu"]
"""Activation function of hidden layers."""
Hidden = Literal["tanh", "relu", "tanh_normalised", "relu_normalised"]
"""Activation function of hidden layers; ``normalised`` if a layer normalisation follows each
hidden layer, and precedes the first."""
NORMALISED: dict[Activation, Hidden] = {"tanh": "tanh_normalised", "relu": "relu_normalised"}
"""Name of each activation function if layer normalisations follow it."""
NORM_EPSILON = 1e-5
"""Summand of the variance in a layer normalisation (the default of PyTorch)."""
SERIAL_PRODUCTS = 2_000_000
"""Number of multiplications per call up to which one thread is faster than several."""
Head = Literal["argmax", "clip", "tanh"]
"""Function that maps the outputs of the last layer to actions: ``argmax`` takes the option with the
highest score for each action; ``clip`` clips outputs to -1..1; ``tanh`` takes their hyperbolic
tangent."""
_FORMAT = 1
_HEADER_KEY = "policy"


@dataclass(frozen=True)
class PolicyNetwork:
    """Perceptron that acts for one agent, for each agent of a group, or for several together.

    For several agents, the input concatenates their observations, with each shared feature once,
    and the output concatenates their actions.

    Raises:
        SdcError: the shapes of the arrays are inconsistent, or a number is not finite.
    """

    agents: tuple[str, ...]
    """Agents that the network acts for, in the order of their actions; the name of a group stands
    for each of its agents."""
    mean: F32
    """Mean of each entry of the observation, subtracted for normalisation, (n,)."""
    std: F32
    """Standard deviation of each entry of the observation, the divisor of the normalisation,
    positive, (n,)."""
    clip: float
    """Maximum absolute value of a normalised entry; larger values are clipped."""
    layers: tuple[tuple[F32, F32], ...]
    """Weight, (out, in), and bias, (out,), of each layer."""
    activation: Hidden
    """Activation function of all layers except the last."""
    head: Head
    """Function that maps the outputs of the last layer to actions."""
    choices: int = CHOICES
    """Number of options, and so of scores, of each action with head ``argmax``."""
    norms: tuple[tuple[F32, F32], ...] = ()
    """Weight and bias, (width,) each, of the layer normalisation before each layer, with an
    activation that is ``normalised``; otherwise empty. The first may be wider than the observation,
    which is then padded with zeros."""

    def __post_init__(self) -> None:
        """Check shapes and values, and convert the arrays to read-only f32 copies."""
        who = f"network of {', '.join(self.agents)}"
        mean, std = (_numbers(getattr(self, n), f"{who}: {n}", 1) for n in ("mean", "std"))
        if std.shape != mean.shape or not len(mean) or std.min() <= 0.0:
            raise SdcError(
                f"{who}: std {std.shape} of mean {mean.shape}; valid is above 0 for each"
            )
        if not 0.0 < self.clip <= float(np.finfo(np.float32).max):
            raise SdcError(f"{who}: clip {self.clip}; valid is a positive number of f32")
        layers, norms, width = [], [], len(mean)
        if len(self.norms) != (len(self.layers) if self.activation in NORMALISED.values() else 0):
            raise SdcError(f"{who}: {len(self.norms)} layer normalisations for {self.activation}")
        for i, arrays in enumerate(self.layers):
            if self.norms:
                scale = _numbers(self.norms[i][0], f"{who}: weight of norm {i}", 1)
                shift = _numbers(self.norms[i][1], f"{who}: bias of norm {i}", 1)
                fits = len(scale) >= width if i == 0 else len(scale) == width
                if not fits or scale.shape != shift.shape:
                    raise SdcError(
                        f"{who}: norm {i} has weight {scale.shape} and bias {shift.shape} after "
                        f"{width} units; valid is ({width},) each"
                    )
                norms.append((scale, shift))
                width = len(scale)
            weight = _numbers(arrays[0], f"{who}: weight of layer {i}", 2)
            bias = _numbers(arrays[1], f"{who}: bias of layer {i}", 1)
            if not len(bias) or weight.shape != (len(bias), width):
                raise SdcError(
                    f"{who}: layer {i} has weight {weight.shape} and bias {bias.shape} after "
                    f"{width} units; valid is (out, {width}) and (out,)"
                )
            layers.append((weight, bias))
            width = len(bias)
        if self.head == "argmax" and width % self.choices:
            raise SdcError(
                f"{who}: {width} outputs; valid is a multiple of {self.choices} for argmax"
            )
        arrays_by_name = {"mean": mean, "std": std, "layers": layers, "norms": norms}
        for name, value in arrays_by_name.items():
            object.__setattr__(self, name, tuple(value) if isinstance(value, list) else value)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of inputs, followed by the number of units of each layer."""
        return (len(self.mean), *(len(bias) for _, bias in self.layers))

    @property
    def action_width(self) -> int:
        """Number k of actions that the network decides."""
        return self.sizes[-1] // self.choices if self.head == "argmax" else self.sizes[-1]

    def scores(self, observations: F32) -> F32:
        """Return the outputs of the last layer for observations, (B, n).

        The shape is (B, choices * k) with head ``argmax`` and (B, k) otherwise. Each row is
        independent of the other rows, to the last bit.
        """
        return self._forward(observations)

    def actions(self, observations: F32) -> F32 | I64:
        """Return actions for observations, (B, k): option indices, or numbers within -1..1."""
        scores = self.scores(observations)
        if not np.isfinite(scores).all():
            raise SdcError(
                f"network of {', '.join(self.agents)}: outputs beyond the range of f32; valid are "
                "smaller weights"
            )
        if self.head == "argmax":
            return np.asarray(scores.reshape(len(scores), -1, self.choices).argmax(axis=2))
        return np.asarray(np.tanh(scores) if self.head == "tanh" else np.clip(scores, -1.0, 1.0))

    @cached_property
    def _forward(self) -> Forward | NormalisedForward:
        if self.activation == "tanh" or self.activation == "relu":
            return Forward(self.mean, self.std, self.clip, self.layers, self.activation)
        return NormalisedForward(self)


class NormalisedForward:
    """Forward pass of a perceptron with layer normalisations, in NumPy."""

    def __init__(self, network: PolicyNetwork) -> None:
        self._network = network

    def __call__(self, inputs: F32) -> F32:
        """Return the outputs, (B, outputs), for inputs, (B, n)."""
        network = self._network
        x = (inputs.astype(np.float64) - network.mean) / network.std
        x = np.minimum(np.maximum(x, -network.clip), network.clip)
        x = np.pad(x, ((0, 0), (0, len(network.norms[0][0]) - x.shape[1])))
        for i, ((scale, shift), (weight, bias)) in enumerate(
            zip(network.norms, network.layers, strict=True)
        ):
            if i > 0:
                x = np.tanh(x) if network.activation == "tanh_normalised" else np.maximum(x, 0.0)
            deviation = x - x.mean(axis=1, keepdims=True)
            variance = np.square(deviation).mean(axis=1, keepdims=True)
            x = deviation / np.sqrt(variance + NORM_EPSILON) * scale + shift
            # Unlike a matrix product, this sums the products of each row in the same order in any
            # batch.
            x = np.einsum("bi,oi->bo", x, weight.astype(np.float64)) + bias
        return np.asarray(x, dtype=np.float32)


class Forward:
    """Compiled forward pass of a perceptron that normalises its inputs.

    Args:
        mean: mean of each input, (n,).
        std: standard deviation of each input, (n,).
        clip: maximum absolute value of a normalised input.
        layers: weight, (out, in), and bias, (out,), of each layer.
        activation: activation function of all layers except the last.
    """

    def __init__(
        self,
        mean: F32,
        std: F32,
        clip: float,
        layers: Sequence[tuple[F32, F32]],
        activation: Activation,
    ) -> None:
        from sdc_taichi.kernels.compiler.named_kernel import NamedKernel
        from sdc_taichi.kernels.perceptron import perceptron_kernel

        self._threads = runtime.ensure_started()
        widths = [len(mean), *(len(bias) for _, bias in layers)]
        self._products = sum(weight.size for weight, _ in layers)
        self._inputs, self._outputs = widths[0], widths[-1]
        self._widest = max(map(_whole_units, widths))
        self._kernel = NamedKernel(perceptron_kernel(), PERCEPTRON_ARGUMENTS)
        self._kernel.bind(
            activation={"tanh": TANH, "relu": RELU}[activation],
            clip=clip,
            widths=np.array(widths, dtype=np.int32),
            mean=mean,
            std=std,
            parameters=np.concatenate([_parameters(*layer) for layer in layers]),
        )

    def __call__(self, inputs: F32) -> F32:
        """Return the outputs, (B, outputs), for inputs, (B, n)."""
        size, blocks = len(inputs), -(-len(inputs) // ROWS)
        rows = np.zeros((blocks * ROWS, self._inputs), dtype=np.float32)
        rows[:size] = inputs
        columns = aligned((blocks, self._inputs, ROWS), np.float32)
        columns[:] = rows.reshape(blocks, ROWS, -1).transpose(0, 2, 1)
        outputs = aligned((blocks, _whole_units(self._outputs), ROWS), np.float32)
        serial = size * self._products <= SERIAL_PRODUCTS
        slices = 1 if serial else min(blocks, 4 * self._threads)
        self._kernel(
            serial=serial,
            slices=slices,
            blocks=blocks,
            inputs=columns,
            work=aligned((slices, 2 * self._widest, ROWS), np.float32),
            outputs=outputs,
        )
        by_row = outputs.transpose(0, 2, 1).reshape(blocks * ROWS, -1)
        return np.ascontiguousarray(by_row[:size, : self._outputs])


def _whole_units(count: int) -> int:
    """Round a number of units up to a multiple of ``UNITS``, the block size of the kernel."""
    return -(-count // UNITS) * UNITS


def _parameters(weight: F32, bias: F32) -> F32:
    """Return weight and bias of a layer, padded with zeros, in the kernel's memory order."""
    outs, ins = weight.shape
    by_unit = np.zeros((_whole_units(outs), 1 + ins), dtype=np.float32)
    by_unit[:outs, 0], by_unit[:outs, 1:] = bias, weight
    return by_unit.reshape(-1, UNITS, 1 + ins).transpose(0, 2, 1).reshape(-1)


class About(Section):
    """Origin of a policy: algorithm, training and version of the package."""

    algorithm: str
    """Name of the training algorithm."""
    seed: int | None = None
    """Seed of the training; None if the training had no seed."""
    steps: int = Field(default=0, ge=0)
    """Number of training steps, summed over all environments."""
    fingerprint: str = ""
    """Fingerprint of the settings and inputs of the training."""
    others: str = "idle"
    """Name of the controller of the agents that did not learn."""
    version: str = ""
    """Version of this package in the training."""


@dataclass(frozen=True)
class Policy:
    """Trained policy: networks that together act for all agents of an interface.

    Raises:
        SdcError: the networks do not fit the interface.
    """

    networks: tuple[PolicyNetwork, ...]
    """Networks of the policy; each agent belongs to exactly one network."""
    interface: Interface
    """The properties of observations and actions on which the networks depend."""
    about: About
    """Origin of the policy: algorithm, training and version of the package."""
    decision_steps: int = 1
    """Number of steps from one decision to the next; actions are repeated in between."""

    def __post_init__(self) -> None:
        """Check that the networks fit the interface."""
        served = [agent for network in self.networks for agent in network.agents]
        # The networks limit the memory that the number of units, also in a header, takes.
        units = self.interface.crac_units or 0
        if self.interface.own_policies and units > len(served):
            raise SdcError(f"policy: networks of {len(served)} agents; valid is {units} or more")
        needed = [a for group in self.interface.agents for a in self.interface.policies_of(group)]
        if sorted(served) != sorted(needed):
            raise SdcError(
                f"policy: networks of {', '.join(served)}; valid is one for each of "
                f"{', '.join(needed)}"
            )
        for network in self.networks:
            shared = [a for a in network.agents if self.is_shared(a)]
            if shared and len(network.agents) > 1:
                raise SdcError(
                    f"policy: network of {', '.join(network.agents)}; valid is {shared[0]} alone, "
                    "or own_policies"
                )
        for network in self.networks:
            # The weights limit the memory that the sizes of features, numbers in a header, take.
            width = max(map(self.interface.width, network.agents))
            if width > network.sizes[0]:
                raise SdcError(_inputs_differ(network, width))
        for network, entries in zip(self.networks, self.entries, strict=True):
            who = f"policy: network of {', '.join(network.agents)}"
            width = sum(len(np.arange(self.interface.width(a))[e]) for a, e in entries.items())
            if network.sizes[0] != width:
                raise SdcError(_inputs_differ(network, width))
            numbers = sum(map(self.interface.action_width, network.agents))
            if network.action_width != numbers:
                raise SdcError(
                    f"{who} decides {network.action_width} numbers; its agents decide {numbers}"
                )
            discrete = self.interface.actions == "discrete"
            if discrete and (network.head != "argmax" or network.choices != CHOICES):
                raise SdcError(
                    f"{who} has head {network.head} of {network.choices}; valid for discrete "
                    f"actions is argmax of {CHOICES}"
                )

    def actions(self, observations: Mapping[str, F32]) -> dict[str, F32 | I64]:
        """Return the actions of each group, (B, k), for the observations of each group, (B, n).

        Those of groups with an agent for each CRAC unit are (B, W, k) and (B, W, n).
        """
        by_agent: dict[str, F32 | I64] = {}
        for network, entries in zip(self.networks, self.entries, strict=True):
            parts = [self._seen(agent, observations)[:, e] for agent, e in entries.items()]
            actions = network.actions(parts[0] if len(parts) == 1 else np.concatenate(parts, 1))
            if network.head == "argmax" and self.interface.actions == "continuous":
                actions = action_levels(network.choices)[np.asarray(actions, dtype=np.int64)]
            first = 0
            for agent in network.agents:
                end = first + self.interface.action_width(agent)
                by_agent[agent] = actions[:, first:end]
                first = end
        by_group: dict[str, F32 | I64] = {}
        for group in self.interface.agents:
            if group in self.interface.own_policies:
                each: list[Any] = [by_agent[agent] for agent in self.interface.policies_of(group)]
                by_group[group] = np.stack(each, axis=1)
            else:
                shape = observations[group].shape[:-1]
                by_group[group] = by_agent[group].reshape(*shape, -1)
        return by_group

    def _seen(self, agent: str, observations: Mapping[str, F32]) -> F32:
        """Return the observations of an agent, or of each agent of a group, in rows, (rows, n)."""
        of_group = observations[group_of(agent)]
        if agent in self.interface.agents:
            return of_group.reshape(-1, of_group.shape[-1])
        return of_group[:, int(agent.rpartition("_")[2])]

    def is_shared(self, agent: str) -> bool:
        """Return True if a name stands for each agent of a group of CRAC units."""
        return agent in self.interface.agents and AGENT_DEFINITIONS[agent].per_unit

    @cached_property
    def entries(self) -> tuple[dict[str, npt.NDArray[np.int64] | slice], ...]:
        """Entries of each agent's observation that each network concatenates as its input."""
        features = self.interface.features
        return tuple(
            entries_of_new_features({agent: features[group_of(agent)] for agent in network.agents})
            for network in self.networks
        )

    def description(self) -> str:
        """Return everything except the arrays as JSON text."""
        described = _Description(
            format=_FORMAT,
            about=self.about,
            interface=self.interface,
            networks=tuple(
                _NetworkDescription.model_validate(network, from_attributes=True)
                for network in self.networks
            ),
            decision_steps=self.decision_steps,
        )
        return described.model_dump_json(indent=1)

    def save(self, folder: Path) -> None:
        """Write the policy to a folder; a policy that is already there is replaced.

        A concurrent reader gets either the complete old policy or the complete new one.

        Args:
            folder: the folder; created if it does not exist.

        Raises:
            SdcError: the files cannot be written.
        """
        from safetensors.numpy import save

        tensors = {
            f"{i}.{name}": values
            for i, network in enumerate(self.networks)
            for name, values in _tensors(network).items()
        }
        text = self.description()
        content = save(tensors, {_HEADER_KEY: text})
        with atomic_write(folder / WEIGHTS, parents=True) as file:
            file.write(content)
        with atomic_write(folder / DESCRIPTION) as file:
            file.write(text.encode() + b"\n")

    @classmethod
    def load(cls, folder: Path) -> Policy:
        """Read the policy in a folder.

        Args:
            folder: folder of a policy, or of a training, which has a best and a last policy; the
                best policy is preferred.

        Raises:
            SdcError: there is no policy, or its file is damaged or has a different format.
        """
        path = policy_folder(folder) / WEIGHTS
        content = read_bytes(path, MOST_BYTES)
        with decoding(path, "a policy"):
            from safetensors.numpy import load

            tensors = load(content)
            header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
            text = header.get("__metadata__", {}).get(_HEADER_KEY)
            described = None if text is None else json.loads(text)
        if not isinstance(described, Mapping):
            raise SdcError(f"{path}: holds no policy; valid is a file that Policy.save wrote")
        if described.get("format") != _FORMAT:
            raise SdcError(
                f"{path}: has format {shortened(described.get('format'))}; valid is {_FORMAT}, "
                "which this version of sdc-taichi reads"
            )
        try:
            read = _Description.model_validate_json(text)
        except ValidationError as error:
            raise SdcError(explain(error, str(path), _Description, described)) from None
        try:
            networks = tuple(_network(i, one, tensors) for i, one in enumerate(read.networks))
            if tensors:
                raise SdcError(f"unknown array {shortened(next(iter(tensors)))}")
            return cls(networks, read.interface, read.about, read.decision_steps)
        except SdcError as error:
            raise SdcError(f"{path}: {error}") from None


def _inputs_differ(network: PolicyNetwork, width: int) -> str:
    """Return the message about a network whose observations have another number of entries."""
    return (
        f"policy: network of {', '.join(network.agents)} has {network.sizes[0]} inputs; "
        f"observations have {width}"
    )


def action_levels(number: int) -> F32:
    """Return equally spaced levels from -1 to 1 for continuous actions, (number,)."""
    return np.linspace(-1.0, 1.0, number, dtype=np.float32)


def policy_folder(folder: Path) -> Path:
    """Return the folder that contains the policy files.

    Args:
        folder: folder of a policy, or of a training with a policy in a subfolder.

    Raises:
        SdcError: the folder does not exist, or contains no policy.
    """
    for candidate in (folder, *(folder / name for name in FOLDERS)):
        if (candidate / WEIGHTS).exists():
            return candidate
    if not folder.is_dir():
        raise SdcError(f"{folder}: no such folder; valid is that of a training run or a policy")
    raise SdcError(
        f"{folder}: holds no policy; valid is the folder of a training run, or one with {WEIGHTS}"
    )


class _NetworkDescription(Section):
    """Description of a network in the policy file: everything except its arrays."""

    agents: tuple[str, ...]
    sizes: tuple[int, ...] = Field(min_length=2)
    activation: Hidden
    clip: float = Field(gt=0, allow_inf_nan=False)
    head: Head
    choices: int = Field(ge=2)


class _Description(Section):
    """Content of ``policy.json``."""

    format: int
    about: About
    interface: Interface
    networks: tuple[_NetworkDescription, ...]
    decision_steps: int = Field(ge=1, le=MOST_DECISION_STEPS)


def _tensors(network: PolicyNetwork) -> dict[str, F32]:
    """Return the arrays of a network by name."""
    arrays = {"mean": network.mean, "std": network.std}
    for i, (weight, bias) in enumerate(network.layers):
        arrays |= {f"layers.{i}.weight": weight, f"layers.{i}.bias": bias}
    for i, (weight, bias) in enumerate(network.norms):
        arrays |= {f"norms.{i}.weight": weight, f"norms.{i}.bias": bias}
    return arrays


def _network(number: int, described: _NetworkDescription, tensors: dict[str, Any]) -> PolicyNetwork:
    """Build a network from its description; its arrays are removed from ``tensors``."""

    def take(name: str) -> F32:
        try:
            values: F32 = tensors.pop(f"{number}.{name}")
        except KeyError:
            raise SdcError(f"array {number}.{name} is missing") from None
        return values

    layers = tuple(
        (take(f"layers.{i}.weight"), take(f"layers.{i}.bias"))
        for i in range(len(described.sizes) - 1)
    )
    is_normalised = described.activation in NORMALISED.values()
    norms = tuple(
        (take(f"norms.{i}.weight"), take(f"norms.{i}.bias"))
        for i in range(len(layers) if is_normalised else 0)
    )
    network = PolicyNetwork(
        mean=take("mean"),
        std=take("std"),
        layers=layers,
        norms=norms,
        **described.model_dump(exclude={"sizes"}),
    )
    if network.sizes != described.sizes:
        raise SdcError(
            f"network {number} has {network.sizes} units; described as {described.sizes}"
        )
    return network


def _numbers(values: Any, what: str, ndim: int) -> F32:
    """Return a read-only f32 copy of an array, after checking dimensions and finite values."""
    array = np.asarray(values)
    if array.dtype.kind != "f" or array.ndim != ndim:
        raise SdcError(f"{what} is {array.dtype} {array.shape}; valid is {ndim}-D, of real numbers")
    with np.errstate(over="ignore"):
        copy = np.array(array, dtype=np.float32, order="C")
    if not np.all(np.isfinite(copy)):
        odd = array[~np.isfinite(copy)].flat[0]
        raise SdcError(f"{what} has {odd}; valid is finite numbers of f32")
    copy.flags.writeable = False
    return copy
