"""An ONNX graph under construction: its nodes and weights."""

from typing import Any

import numpy as np


class Graph:
    """Collects nodes and weights.

    Args:
        onnx: the package ``onnx``.

    Attributes:
        nodes, weights: arguments of ``onnx.helper.make_graph``.
    """

    def __init__(self, onnx: Any):
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.weights: list[Any] = []

    def constant(self, name: str, value: Any) -> str:
        """Adds a weight as float32; returns its name."""
        self.weights.append(self._onnx.numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def apply(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Adds a node; returns the name of its output."""
        self.nodes.append(self._onnx.helper.make_node(kind, list(inputs), [f"{kind.lower()}_{len(self.nodes)}"], **attributes))
        return self.nodes[-1].output[0]

    def normalized(self, normalizer: Any) -> str:
        """Adds the normalization of the input ``observations``."""
        x = self.apply("Sub", "observations", self.constant("mean", normalizer.mean["state"]))
        return self.apply("Div", x, self.constant("std", normalizer.std["state"]))

    def name_output(self, name: str) -> None:
        """Names the last node's output."""
        self.nodes[-1].output[0] = name
