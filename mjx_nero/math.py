"""Quaternion and frame helpers. Quaternions are wxyz and of unit length."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def quat_mul(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "4"]:
    """Hamilton product: the rotation ``b`` first, then ``a``."""
    w, v = a[0], a[1:]
    return jnp.concatenate([(w * b[0] - v @ b[1:])[None], w * b[1:] + b[0] * v + jnp.cross(v, b[1:])])


def rotate(quat: Float[Array, "4"], vec: Float[Array, "3"]) -> Float[Array, "3"]:
    """``vec`` turned by ``quat``."""
    t = 2.0 * jnp.cross(quat[1:], vec)
    return vec + quat[0] * t + jnp.cross(quat[1:], t)


def axis_angle(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "4"]:
    """Quaternion of a turn by ``angle`` [rad] about the unit vector ``axis``."""
    return jnp.concatenate([jnp.cos(angle / 2)[None], jnp.sin(angle / 2) * axis])
