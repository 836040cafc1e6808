"""The student's networks: made from a config, and rebuilt from the description in a policy's file."""

from collections.abc import Mapping
from typing import Any

import mjx_nero.sim.quiet  # noqa: F401

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics, specs
from flax import linen

from mjx_nero.config.values import read
from mjx_nero.learn.learner import Act, Observation
from mjx_nero.learn.pixels.cfg import StudentCfg
from mjx_nero.types import Key

SENSED, SEEN, TRUTH = "state", "pictures", "truth"  # observation groups: two inputs, and a second target
MOST = 10.0  # bound on normalized observations


class Eye(linen.Module):
    """Convolutions that turn a picture [..., height, width, channels] into features [..., n].

    Integer pictures are colours from 0 to 255. Convolutions compute in ``StudentCfg.precision``; their parameters are float32.
    """

    cfg: StudentCfg

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        cfg, kind = self.cfg, jnp.dtype(self.cfg.precision)
        scale = 1 / 255 if x.dtype == jnp.uint8 else 1.0
        x = (x.astype(jnp.float32) * scale - 0.5).astype(kind)
        for i, count in enumerate(cfg.channels):
            edge = 3 if i else 5
            x = linen.relu(linen.Conv(count, (edge, edge), strides=2, dtype=kind)(x))
        x = x.reshape(*x.shape[:-3], -1)
        return linen.relu(linen.Dense(cfg.features, dtype=kind)(x)).astype(jnp.float32)


class Student(linen.Module):
    """Computes (state [..., n], pictures by camera) -> action [..., na], and object positions.

    Attributes:
        action_size, truth_size: sizes of the action and of the object positions.
    """

    cfg: StudentCfg
    action_size: int
    truth_size: int

    @linen.compact
    def __call__(self, sensed: jax.Array, pictures: Mapping[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cfg = self.cfg
        features = [Eye(cfg, name=f"eye_{name}")(pictures[name]) for name in sorted(pictures)]
        x = jnp.concatenate([*features, sensed], axis=-1)
        truth = linen.Dense(self.truth_size, name="truth")(linen.elu(linen.Dense(cfg.layers[-1], name="where")(x)))
        for size in cfg.layers:
            x = linen.elu(linen.Dense(size)(x))
        return linen.Dense(self.action_size, kernel_init=linen.initializers.normal(0.01), name="action")(x), truth


def init_params(net: Student, sizes: Mapping[str, Any], key: Key) -> tuple[Any, Any]:
    """Makes new (statistics of state and truth, network parameters)."""
    shapes = {name: specs.Array(tuple(sizes[name]), jnp.dtype("float32")) for name in (SENSED, TRUTH)}
    normalizer = running_statistics.init_state(shapes).replace(std_eps=jnp.float32(1e-4))
    return normalizer, init_variables(net, sizes, key)


def init_variables(net: Student, sizes: Mapping[str, Any], key: Key) -> Any:
    """Makes new network parameters."""
    pictures = {name: jnp.zeros((1, *shape)) for name, shape in sizes[SEEN].items()}
    return net.init(key, jnp.zeros((1, *sizes[SENSED])), pictures)


def apply(net: Student, params: tuple[Any, Any], obs: Observation) -> tuple[jax.Array, jax.Array]:
    """Computes the action, and the positions of objects in units of their deviation."""
    normalizer, variables = params
    of_sensed = running_statistics.NestedMeanStd(mean=normalizer.mean[SENSED], std=normalizer.std[SENSED])
    sensed = running_statistics.normalize(obs[SENSED], of_sensed, max_abs_value=MOST)
    found: Any = net.apply(variables, sensed, obs[SEEN])
    return found


def stored(params: tuple[Any, Any], meta: Mapping[str, Any]) -> tuple[Any, Any]:
    """Returns parameters as a file holds them: those of the convolutions in the number format in which they compute."""
    normalizer, variables = params
    kind = jnp.dtype(meta["student"]["precision"])
    layers = {
        name: jax.tree.map(lambda x: np.asarray(x).astype(kind), layer) if name.startswith("eye_") else layer
        for name, layer in variables["params"].items()
    }
    return normalizer, {**variables, "params": layers}


def away(where: jax.Array, truth: jax.Array, normalizer: Any) -> tuple[jax.Array, jax.Array]:
    """Returns the squared error of predicted positions in units of their deviation, and the mean distance [m]."""
    of_truth = running_statistics.NestedMeanStd(mean=normalizer.mean[TRUTH], std=normalizer.std[TRUTH])
    error = where - running_statistics.normalize(truth, of_truth)
    distance = jnp.linalg.norm((error * of_truth.std).reshape(*error.shape[:-1], -1, 3), axis=-1)
    return jnp.mean(jnp.square(error)), jnp.mean(distance)


def from_meta(meta: Mapping[str, Any]) -> tuple[Any, Act]:
    """Rebuilds the student that a policy file describes: a template of its parameters, and its act function."""
    sizes = jax.tree.map(tuple, meta["observation_size"], is_leaf=lambda node: isinstance(node, list | tuple))
    net = Student(read(StudentCfg, meta["student"], "student"), meta["action_size"], sizes[TRUTH][0])
    template = jax.eval_shape(lambda: init_params(net, sizes, jax.random.PRNGKey(0)))
    return template, lambda params, obs: apply(net, params, obs)[0]


def seen_bytes(cfg: StudentCfg, pictures: Mapping[str, tuple[int, ...]]) -> float:
    """Returns the bytes of the convolutions' outputs for one picture of each shape [height, width, channels], in bfloat16."""
    total = 0.0
    for height, width, _ in pictures.values():
        total += sum(2 * count * height * width / 4 ** (i + 1) for i, count in enumerate(cfg.channels))
    return total
