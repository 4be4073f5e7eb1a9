"""Export of policies as ONNX graphs, which run without this package.

The graph has one input per agent, named after the agent: its unnormalised observations, f32
(batch, n). For each agent it has the outputs ``AGENT_action``, (batch, k), and ``AGENT_scores``,
which are the outputs of the network's last layer. A group of agents that shares a policy has one
input, named after the group, with a row for each agent: (rows, n).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.policy import Policy, PolicyNetwork, action_levels

OPSET = 17
"""Version of the ONNX operator set."""
_IR_VERSION = 8


def export_onnx(policy: Policy, path: Path) -> None:
    """Write a policy as an ONNX model; interface, origin and decision steps become metadata.

    Raises:
        ConfigError: ONNX is not installed.
        SdcError: the file cannot be written.
    """
    try:
        import onnx
    except ImportError:
        raise ConfigError(
            'onnx is not installed; valid is after pip install "sdc-taichi[onnx]"'
        ) from None
    graph = _Graph(onnx)
    for group in policy.interface.agents:
        for agent in policy.interface.policies_of(group):
            graph.add_input(agent, policy.interface.width(agent), _rows_of(policy, agent))
    for number, network in enumerate(policy.networks):
        _add_network(graph, policy, number, network)
    metadata = {
        "about": policy.about.model_dump(mode="json"),
        "interface": policy.interface.model_dump(mode="json"),
        "decision_steps": policy.decision_steps,
    }
    model = graph.model(metadata)
    with atomic_write(path) as file:
        file.write(model.SerializeToString())


def _add_network(graph: _Graph, policy: Policy, number: int, network: PolicyNetwork) -> None:
    """Add the nodes that map the observations of a network's agents to their actions."""
    parts = [
        graph.columns(agent, np.arange(policy.interface.width(agent))[entries])
        for agent, entries in policy.entries[number].items()
    ]
    x = parts[0] if len(parts) == 1 else graph.node("Concat", *parts, axis=1)
    x = graph.node("Sub", x, graph.constant(network.mean))
    x = graph.node("Div", x, graph.constant(network.std))
    x = _between(graph, x, network.clip)
    if network.norms:
        raise ConfigError("policy: has layer normalisations; valid for ONNX is one without them")
    activation = {"tanh": "Tanh", "relu": "Relu"}[network.activation]
    for i, (weight, bias) in enumerate(network.layers):
        x = graph.node("Gemm", x, graph.constant(weight), graph.constant(bias), transB=1)
        if i + 1 < len(network.layers):
            x = graph.node(activation, x)
    discrete = policy.interface.actions == "discrete"
    actions = _actions(graph, network, x, discrete)
    scores_of_number = network.choices if network.head == "argmax" else 1
    first = 0
    for agent in network.agents:
        numbers = np.arange(first, first + policy.interface.action_width(agent))
        first += len(numbers)
        scores = (numbers[:, None] * scores_of_number + np.arange(scores_of_number)).reshape(-1)
        kind = np.int64 if discrete else np.float32
        for name, source, columns, element in (
            ("action", actions, numbers, kind),
            ("scores", x, scores, np.float32),
        ):
            chosen, rows = graph.columns(source, columns), _rows_of(policy, agent)
            graph.add_output(f"{agent}_{name}", chosen, len(columns), rows, element)


def _rows_of(policy: Policy, agent: str) -> str:
    """Return the name of the first dimension of an agent's inputs and outputs."""
    return "rows" if policy.is_shared(agent) else "batch"


def _actions(graph: _Graph, network: PolicyNetwork, scores: str, discrete: bool) -> str:
    """Add the nodes that map a network's outputs to its actions; return the value's name."""
    if network.head == "argmax":
        shape = graph.constant(
            np.array([-1, network.action_width, network.choices], dtype=np.int64)
        )
        chosen = graph.node("ArgMax", graph.node("Reshape", scores, shape), axis=2, keepdims=0)
        if discrete:
            return chosen
        return graph.node("Gather", graph.constant(action_levels(network.choices)), chosen)
    return graph.node("Tanh", scores) if network.head == "tanh" else _between(graph, scores, 1.0)


def _between(graph: _Graph, x: str, most: float) -> str:
    """Add a node that clips a value to -``most``..``most``; return the result's name."""
    low, high = (graph.constant(np.float32(limit)) for limit in (-most, most))
    return graph.node("Clip", x, low, high)


class _Graph:
    """ONNX graph under construction; each method refers to values by their names."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []

    def add_input(self, name: str, width: int, rows: str) -> None:
        """Add an input, f32 (rows, width), whose first dimension has the name ``rows``."""
        self._inputs.append(self._value(name, width, rows, np.float32))

    def add_output(self, name: str, source: str, width: int, rows: str, kind: Any) -> None:
        """Add an output ``name``, (rows, width), that equals the value ``source``."""
        self._nodes.append(self._onnx.helper.make_node("Identity", [source], [name]))
        self._outputs.append(self._value(name, width, rows, kind))

    def constant(self, values: npt.ArrayLike) -> str:
        """Add a constant and return its name."""
        name = f"constant_{len(self._constants)}"
        self._constants.append(self._onnx.numpy_helper.from_array(np.asarray(values), name))
        return name

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add an operator and return the name of its output."""
        name = f"value_{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(kind, inputs, [name], **attributes))
        return name

    def columns(self, source: str, numbers: npt.NDArray[np.int64]) -> str:
        """Add a node that selects columns of a value; return the result's name."""
        return self.node("Gather", source, self.constant(numbers.astype(np.int64)), axis=1)

    def model(self, metadata: dict[str, Any]) -> Any:
        """Return the checked model with its metadata."""
        helper = self._onnx.helper
        graph = helper.make_graph(
            self._nodes, "policy", self._inputs, self._outputs, self._constants
        )
        opset = helper.make_opsetid("", OPSET)
        model = helper.make_model(
            graph, producer_name="sdc-taichi", opset_imports=[opset], ir_version=_IR_VERSION
        )
        texts = {name: json.dumps(part) for name, part in metadata.items()}
        helper.set_model_props(model, texts)
        self._onnx.checker.check_model(model)
        return model

    def _value(self, name: str, width: int, rows: str, kind: Any) -> Any:
        element = self._onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind))
        return self._onnx.helper.make_tensor_value_info(name, element, [rows, width])
