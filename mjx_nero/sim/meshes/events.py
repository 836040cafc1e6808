"""Reset events for mesh objects: (key, start, *, params) -> start, as in ``mdp.events``."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero import math
from mjx_nero.config.bounds import Positive, Range
from mjx_nero.sim.solids import store
from mjx_nero.types import Key, Start


def at_rest(
    key: Key,
    start: Start,
    *,
    files: tuple[str, ...],
    scale: Positive = 1.0,
    yaw: Range = (-np.pi, np.pi),
    object: str = "cube",
    bank: tuple[str, ...] = (),
) -> Start:
    """Gives the object one of its shapes, lays it in one of that shape's resting poses, and turns it about the vertical.

    All shapes are equally likely. A resting pose is as likely as a throw is to end in it.

    Args:
        files: files of the shapes that it may have, all or some of its own.
        scale: factor of the meshes' lengths.
        yaw: range of the turn [rad].
        bank: all its shapes in the scene's order, its ``file`` and its ``bank``; empty: ``files``. Environments fill it in.
    """
    quats, heights, shares = (jnp.asarray(x) for x in _rests(files, scale))
    k_shape, k_rest, k_yaw = jax.random.split(key, 3)
    drawn = jax.random.randint(k_shape, (), 0, len(files))
    rest = jax.random.categorical(k_rest, jnp.log(shares[drawn]))
    angle = jax.random.uniform(k_yaw, (), minval=yaw[0], maxval=yaw[1])
    quat = math.quat_mul(math.axis_angle(jnp.array([0.0, 0.0, 1.0]), angle), quats[drawn, rest])
    pos = start.object_pos_w[object].at[2].set(heights[drawn, rest])
    shape = jnp.array([(bank or files).index(file) for file in files])[drawn]
    return dataclasses.replace(
        start,
        object_pos_w={**start.object_pos_w, object: pos},
        object_quat_w={**start.object_quat_w, object: quat},
        shape={**start.shape, object: shape} if object in start.shape else start.shape,
    )


@functools.lru_cache(maxsize=32)
def _rests(files: tuple[str, ...], scale: float) -> tuple[np.ndarray, ...]:
    """Orientations [shapes, rests, 4], heights of the centre and probabilities [shapes, rests], padded with probability 0."""
    solids = [store.find(file).scaled(scale) for file in files]
    most = max(len(solid.rest_share) for solid in solids)
    quats, heights, shares = np.zeros((len(solids), most, 4)), np.zeros((len(solids), most)), np.zeros((len(solids), most))
    quats[:, :, 0] = 1.0
    for i, solid in enumerate(solids):
        n = len(solid.rest_share)
        quats[i, :n], shares[i, :n] = solid.rest_quat, solid.rest_share
        heights[i, :n] = [solid.height(quat) for quat in solid.rest_quat]
    return tuple(x.astype(np.float32) for x in (quats, heights, shares))
