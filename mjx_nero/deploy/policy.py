"""An exported policy: its network in ONNX Runtime, with the observations and actions that its metadata describe."""

import json
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero import files
from mjx_nero.deploy.executor import Executor, Joints, numbers
from mjx_nero.errors import UserError

MAX_BYTES = 100_000_000
MAX_TEXT = 1_000_000  # maximum characters of the metadata
MOST_PIXELS = 2048  # maximum edge of a picture


class Policy:
    """The network of an ONNX file written by ``export``, on one core.

    Args:
        path: path of the file.

    Attributes:
        metadata: the file's metadata, see ``docs/guides/deploy_onnx.md``.
        names: names of the observations that ``act`` takes.
        cameras: shape of each camera's picture, [height, width, channels].
        actions: size of an action.

    Raises:
        UserError: the file cannot be read, or is not what ``export`` writes.
    """

    def __init__(self, path: pathlib.Path | str):
        content = files.read_bytes(pathlib.Path(path), MAX_BYTES)
        import onnxruntime  # of the extra ``onnx``; writes to the user's folders as it starts

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
            self._describe()
        except Exception as error:  # ONNX Runtime has its own kinds, and tells how a network was cut by any of Python's
            raise UserError(f"{path} is not a policy written by export, or it is damaged: {error}") from None
        self.reset()

    def _describe(self) -> None:
        """Reads the metadata.

        Raises:
            Exception: they are not what ``export`` writes.
        """
        self.metadata = _read(self._session.get_modelmeta().custom_metadata_map)
        (taken, *seen), (given,) = self._session.get_inputs(), self._session.get_outputs()
        self.cameras = _cameras(self.metadata, {each.name: tuple(each.shape[1:]) for each in seen})
        _check(self.metadata, taken.shape[-1], given.shape[-1])
        self.names = tuple(term["name"] for term in self.metadata["observations"])
        self.actions = int(given.shape[-1])

    def reset(self) -> None:
        """Forgets the observations of the previous episode."""
        self._past: dict[str, np.ndarray] = {}

    def act(self, observations: Mapping[str, Any], pictures: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
        """Computes the action for observations by name, and pictures by camera (red, green and blue from 0 to 255).

        Raises:
            ValueError: an observation is missing, has another size, or is not finite.
        """
        values = np.concatenate([self._remembered(term, observations) for term in self.metadata["observations"]])
        given = {"observations": values[None].astype(np.float32)}
        for name, shape in self.cameras.items():
            picture = np.asarray((pictures or {}).get(name))
            if picture.shape != shape or picture.dtype != np.uint8:
                raise ValueError(f"the policy needs a picture of the camera {name!r}, uint8 {list(shape)}")
            given[f"picture_{name}"] = picture[None]
        return self._session.run(None, given)[0][0]

    def _remembered(self, term: Mapping[str, Any], observations: Mapping[str, Any]) -> np.ndarray:
        """Returns the last values of an observation, newest last; values before the first one are copies of it."""
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
        """Makes an executor of the policy's actions that starts from the joints' positions [rad or m]."""
        return Executor.of(self.metadata, position)


def _read(stored: Mapping[str, str]) -> dict[str, Any]:
    """Reads the metadata as plain values.

    Raises:
        ValueError: they are not JSON, or too long; one line.
    """
    if sum(map(len, stored.values())) > MAX_TEXT:
        raise ValueError(f"the metadata have more than {MAX_TEXT:,} characters: this is not a policy written by export")
    try:
        return {name: json.loads(text) for name, text in stored.items()}
    except (ValueError, RecursionError):
        raise ValueError("the metadata are not JSON: this is not a policy written by export") from None


def _cameras(metadata: Mapping[str, Any], inputs: Mapping[str, tuple[Any, ...]]) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of pictures, by camera.

    Raises:
        ValueError: network and metadata disagree, or the policy needs depths, which are not supported.
    """
    told: Any = metadata.get("cameras") or {}
    out: dict[str, tuple[int, ...]] = {}
    if not isinstance(told, Mapping) or {f"picture_{name}" for name in told} != set(inputs):
        raise ValueError("the metadata do not describe the policy's cameras: export the policy again")
    for name, camera in told.items():
        shape = inputs[f"picture_{name}"]
        if len(shape) != 3 or not all(isinstance(size, int) and 0 < size <= MOST_PIXELS for size in shape) or shape[2] != 3:
            raise ValueError(f"the camera {name!r} gives {list(shape)}: only colour pictures are supported, not depths")
        fovy, every = (float(numbers(camera, field, above=0.0)) for field in ("fovy_deg", "every_steps"))
        if camera.get("shape") != list(shape) or not 1 <= fovy <= 170 or not 1 <= every <= 1000:
            raise ValueError(f"the camera {name!r} takes the network's shape, a fovy_deg to 170 and every_steps to 1000")
        out[name] = shape
    return out


def _check(metadata: Mapping[str, Any], taken: Any, given: Any) -> None:
    """Checks that the metadata describe the network's ``taken`` inputs and ``given`` outputs.

    Raises:
        ValueError: they do not; one line.
    """
    terms, total = metadata.get("observations"), 0
    if not isinstance(terms, list) or not terms:
        raise ValueError("the description's 'observations' takes a list of terms: this is not a policy written by export")
    for term in terms:
        size, history = (int(numbers(term, name, above=0.0)) for name in ("size", "history"))
        whole = all(isinstance(term[name], int) for name in ("size", "history"))
        if not whole or not isinstance(term.get("name"), str) or size % history:
            raise ValueError("the description's 'observations' takes terms with a name, a size, and a history that divides it")
        total += size
    made = Executor.of(metadata, Joints.of(metadata).home)
    if (total, len(made.home_action)) != (taken, given):
        raise ValueError(
            f"the metadata describe {total} observations and {len(made.home_action)} actions, the network {taken} and {given}"
        )
