"""An exported policy: its network in an ONNX runtime, its observations and actions as its metadata say."""

import json
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.executor import Executor


class Policy:
    """The network of an ONNX file that ``export`` wrote, on one core.

    Args:
        path: of the file.

    Attributes:
        metadata: what the file says: see ``docs/guides/deploy_onnx.md``.
        names: of the observations that ``act`` takes.
        actions: how many numbers an action has.
    """

    def __init__(self, path: pathlib.Path | str):
        import onnxruntime  # of the extra ``onnx``

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        stored = self._session.get_modelmeta().custom_metadata_map
        self.metadata: dict[str, Any] = {name: json.loads(text) for name, text in stored.items()}
        self.names = tuple(term["name"] for term in self.metadata["observations"])
        self.actions = int(self._session.get_outputs()[0].shape[-1])
        self.reset()

    def reset(self) -> None:
        """Forgets the observations of the episode before."""
        self._past: dict[str, np.ndarray] = {}

    def act(self, observations: Mapping[str, Any]) -> np.ndarray:
        """The action for observations by name.

        Raises:
            ValueError: one is missing, of another size, or not finite.
        """
        values = np.concatenate([self._remembered(term, observations) for term in self.metadata["observations"]])
        return self._session.run(None, {"observations": values[None].astype(np.float32)})[0][0]

    def _remembered(self, term: Mapping[str, Any], observations: Mapping[str, Any]) -> np.ndarray:
        """The last values of an observation in one, the newest at the end; before the first, it has always been that."""
        name, size = term["name"], term["size"] // term["history"]
        if name not in observations:
            raise ValueError(f"no observation {name!r}: the policy reads {', '.join(self.names)}")
        value = np.ravel(np.asarray(observations[name], float))
        if len(value) != size or not np.all(np.isfinite(value)):
            raise ValueError(f"the observation {name!r} takes {size} finite numbers, got {observations[name]!r}")
        past = self._past.get(name, np.tile(value, term["history"]))
        self._past[name] = np.concatenate([past[size:], value])
        return self._past[name]

    def executor(self, position: np.ndarray) -> Executor:
        """What turns the policy's actions into targets, from where the joints are [rad or m]."""
        return Executor.of(self.metadata, position)
