"""The student as an ONNX graph from pictures to actions, with normalization. ``interop.onnx`` passes the ``Graph`` to fill."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from mjx_nero.envs.task import EnvCfg
from mjx_nero.learn.pixels import networks
from mjx_nero.learn.policy import Policy

Graph = Any
TRIES = 300  # observations per check: pictures take a thousand times as long as vectors


def pictures(meta: Mapping[str, Any]) -> dict[str, tuple[tuple[int, ...], bool]]:
    """Lists the picture inputs of a policy: name -> ([height, width, channels], whether it has whole numbers from 0 to 255)."""
    sizes = meta["observation_size"].get(networks.SEEN, {}) if "student" in meta else {}
    return {f"picture_{name}": (tuple(size), size[-1] == 3) for name, size in sizes.items()}


def cameras(meta: Mapping[str, Any], cfg: EnvCfg) -> dict[str, dict[str, Any]]:
    """Describes each camera in training, by name: pose, field of view, picture size, control steps per picture, and delay."""
    lenses = [term.params for term in cfg.sensors.values() if "camera" in term.params]
    out: dict[str, dict[str, Any]] = {}
    for picture, (shape, _) in pictures(meta).items():
        name = picture.removeprefix("picture_")
        own, lens = cfg.scene.cameras[name], next((each for each in lenses if each["camera"] == name), {})
        place = {"link": own.link, "position": list(own.pos), "quaternion": list(own.quat)}
        late = {"every_steps": lens.get("every", 1), "delay_steps": list(lens.get("delay", (0, 0)))}
        out[name] = {"input": picture, "shape": list(shape), "fovy_deg": own.fovy, **place, **late}
    return out


def build(policy: Policy, graph: Graph) -> None:
    """Adds the student to a graph. Its inputs are ``observations`` and those of ``pictures``, its output is ``actions``."""
    normalizer, variables = policy.params
    params, shapes = variables["params"], pictures(policy.meta)
    sensed = graph.apply(
        "Clip", graph.normalized(normalizer), graph.constant("least", -networks.MOST), graph.constant("most", networks.MOST)
    )
    features = [_eye(graph, params[f"eye_{name.removeprefix('picture_')}"], name, *shapes[name]) for name in sorted(shapes)]
    x = graph.apply("Concat", *features, sensed, axis=-1)
    hidden = sorted((n for n in params if n.startswith("Dense_")), key=lambda n: int(n.rpartition("_")[2]))
    for name in hidden:
        x = graph.apply("Elu", _dense(graph, params[name], x, name))
    _dense(graph, params["action"], x, "action")
    graph.name_output("actions")


def _eye(graph: Graph, params: Mapping[str, Any], name: str, shape: tuple[int, ...], whole: bool) -> str:
    x = graph.apply("Cast", name, to=1)
    x = graph.apply("Mul", x, graph.constant(f"{name}_scale", 1 / 255)) if whole else x
    x = graph.apply("Sub", x, graph.constant(f"{name}_middle", 0.5))
    x = graph.apply("Transpose", x, perm=[0, 3, 1, 2])
    for i in range(sum(layer.startswith("Conv_") for layer in params)):
        layer = params[f"Conv_{i}"]
        kernel = graph.constant(f"{name}_kernel_{i}", np.transpose(np.asarray(layer["kernel"]), (3, 2, 0, 1)))
        bias = graph.constant(f"{name}_bias_{i}", layer["bias"])
        x = graph.apply("Relu", graph.apply("Conv", x, kernel, bias, auto_pad="SAME_UPPER", strides=[2, 2]))
    x = graph.apply("Flatten", graph.apply("Transpose", x, perm=[0, 2, 3, 1]))
    return graph.apply("Relu", _dense(graph, params["Dense_0"], x, f"{name}_dense"))


def _dense(graph: Graph, layer: Mapping[str, Any], x: str, name: str) -> str:
    return graph.apply(
        "Gemm", x, graph.constant(f"kernel_{name}", layer["kernel"]), graph.constant(f"bias_{name}", layer["bias"])
    )


def exact(policy: Policy) -> Any:
    """Returns the policy's act function with convolutions in float32, as in ONNX."""
    student = {**policy.meta["student"], "precision": "float32"}
    act = networks.from_meta({**policy.meta, "student": student})[1]
    return jax.jit(lambda obs: act(policy.params, obs))


def random_pictures(meta: Mapping[str, Any], count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draws pictures for a check, by input."""
    return {
        name: rng.integers(0, 256, (count, *shape), np.uint8) if whole else rng.random((count, *shape), np.float32)
        for name, (shape, whole) in pictures(meta).items()
    }
