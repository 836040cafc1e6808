"""An exported policy: its network in an ONNX runtime, its observations and actions as its metadata say."""

import json
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.executor import Executor, Joints, numbers

MAX_TEXT = 1_000_000  # characters of the metadata
MOST_PIXELS = 2048  # of an edge


class Policy:
    """The network of an ONNX file that ``export`` wrote, on one core.

    Args:
        path: of the file.

    Attributes:
        metadata: what the file says: see ``docs/guides/deploy_onnx.md``.
        names: of the observations that ``act`` takes.
        cameras: shape of the picture of each, [height, width, channels].
        actions: how many numbers an action has.

    Raises:
        ValueError: the file's metadata are not what ``export`` writes; one line.
    """

    def __init__(self, path: pathlib.Path | str):
        import onnxruntime  # of the extra ``onnx``

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self.metadata = _read(self._session.get_modelmeta().custom_metadata_map)
        (taken, *seen), (given,) = self._session.get_inputs(), self._session.get_outputs()
        self.cameras = _cameras(self.metadata, {each.name: tuple(each.shape[1:]) for each in seen})
        _check(self.metadata, taken.shape[-1], given.shape[-1])
        self.names = tuple(term["name"] for term in self.metadata["observations"])
        self.actions = int(given.shape[-1])
        self.reset()

    def reset(self) -> None:
        """Forgets the observations of the episode before."""
        self._past: dict[str, np.ndarray] = {}

    def act(self, observations: Mapping[str, Any], pictures: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
        """The action for observations by name, and pictures by camera (red, green and blue from 0 to 255).

        Raises:
            ValueError: one is missing, of another size, or not finite.
        """
        values = np.concatenate([self._remembered(term, observations) for term in self.metadata["observations"]])
        given = {"observations": values[None].astype(np.float32)}
        for name, shape in self.cameras.items():
            picture = np.asarray((pictures or {}).get(name))
            if picture.shape != shape or picture.dtype != np.uint8:
                raise ValueError(f"the policy looks at a picture of the camera {name!r}, {list(shape)} whole numbers to 255")
            given[f"picture_{name}"] = picture[None]
        return self._session.run(None, given)[0][0]

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
        """Makes an executor of the policy's actions that starts from where the joints are [rad or m]."""
        return Executor.of(self.metadata, position)


def _read(stored: Mapping[str, str]) -> dict[str, Any]:
    """The metadata as plain values.

    Raises:
        ValueError: they are no JSON, or too much of it; one line.
    """
    if sum(map(len, stored.values())) > MAX_TEXT:
        raise ValueError(f"the metadata have more than {MAX_TEXT:,} characters: this is no policy that export wrote")
    try:
        return {name: json.loads(text) for name, text in stored.items()}
    except (ValueError, RecursionError):
        raise ValueError("the metadata are no JSON: this is no policy that export wrote") from None


def _cameras(metadata: Mapping[str, Any], inputs: Mapping[str, tuple[Any, ...]]) -> dict[str, tuple[int, ...]]:
    """Shapes of pictures, by camera.

    Raises:
        ValueError: the network takes others than the metadata say, or depths, which no camera here gives.
    """
    told: Any = metadata.get("cameras") or {}
    out: dict[str, tuple[int, ...]] = {}
    if not isinstance(told, Mapping) or {f"picture_{name}" for name in told} != set(inputs):
        raise ValueError("the metadata do not say what the policy's cameras are: export the policy again")
    for name, camera in told.items():
        shape = inputs[f"picture_{name}"]
        if len(shape) != 3 or not all(isinstance(size, int) and 0 < size <= MOST_PIXELS for size in shape) or shape[2] != 3:
            raise ValueError(f"the camera {name!r} gives {list(shape)}: only pictures in colour can be had, not depths")
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
        raise ValueError("the description's 'observations' takes a list of terms: this is no policy that export wrote")
    for term in terms:
        size, history = (int(numbers(term, name, above=0.0)) for name in ("size", "history"))
        whole = all(isinstance(term[name], int) for name in ("size", "history"))
        if not whole or not isinstance(term.get("name"), str) or size % history:
            raise ValueError("the description's 'observations' takes terms with a name, a size, and a history that divides it")
        total += size
    made = Executor.of(metadata, Joints.of(metadata).home)
    if (total, len(made.home_action)) != (taken, given):
        raise ValueError(
            f"the metadata describe {total} observations and {len(made.home_action)} actions, the network has {taken} and {given}"
        )
