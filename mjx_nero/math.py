"""Quaternion and frame helpers. Quaternions are wxyz and of unit length."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# JAX traces such a function once per shape and inlines its operations where it is called. These are the most often called ones.
_traced_once = functools.partial(jax.jit, inline=True)


@_traced_once
def quat_mul(a: Float[Array, "4 *many"], b: Float[Array, "4 *many"]) -> Float[Array, "4 *many"]:
    """Returns the Hamilton product: rotation ``b`` first, then ``a``. One of each, or many with components on the first axis."""
    # Written out, since XLA fuses plain products into one kernel, but not the reductions and slices of dot and cross.
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


@_traced_once
def rotate(quat: Float[Array, "4 *many"], vec: Float[Array, "3 *many"]) -> Float[Array, "3 *many"]:
    """Rotates ``vec`` by ``quat``. One of each, or many with components on the first axis."""
    w, x, y, z = quat
    vx, vy, vz = vec
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return jnp.stack([vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx])


def axis_angle(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "4"]:
    """Returns the quaternion of a rotation by ``angle`` [rad] about the unit vector ``axis``."""
    return jnp.concatenate([jnp.cos(angle / 2)[None], jnp.sin(angle / 2) * axis])


def quat_from_euler(roll: Float[Array, ""], pitch: Float[Array, ""], yaw: Float[Array, ""]) -> Float[Array, "4"]:
    """Returns the quaternion of rotations about the fixed axes x, y, z, in this order [rad], as in URDF and Isaac Lab."""
    x, y, z = jnp.eye(3)
    return quat_mul(axis_angle(z, yaw), quat_mul(axis_angle(y, pitch), axis_angle(x, roll)))


def yaw(quat: Float[Array, "4"]) -> Float[Array, ""]:
    """Returns the rotation about the vertical of a frame that is upright, or nearly so [rad]."""
    w, x, y, z = quat
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quat_conj(quat: Float[Array, "4"]) -> Float[Array, "4"]:
    """Returns the inverse rotation."""
    return quat * jnp.array([1.0, -1.0, -1.0, -1.0])


def quat_log(quat: Float[Array, "4"]) -> Float[Array, "3"]:
    """Returns the rotation vector (axis times angle, angle from 0 to pi) [rad]; smooth at the identity."""
    quat = jnp.where(quat[0] < 0, -quat, quat)  # q and -q are the same rotation: take the shorter way
    v = quat[1:]
    square = v @ v
    small = square < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    return v * jnp.where(small, 2.0, 2.0 * jnp.arctan2(sine, quat[0]) / sine)


def quat_exp(vec: Float[Array, "3"]) -> Float[Array, "4"]:
    """Returns the quaternion of a rotation vector (axis times angle) [rad]: the inverse of ``quat_log``."""
    square = vec @ vec
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    return jnp.concatenate(
        [jnp.where(small, 1.0, jnp.cos(angle / 2))[None], vec * jnp.where(small, 0.5, jnp.sin(angle / 2) / angle)]
    )


def rotation_matrix(quat: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Returns the rotation matrix: its columns are the frame's axes in the outer frame."""
    w, x, y, z = quat
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def solve_spd(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solves ``a x = b`` for a small positive definite matrix by Cholesky factorization.

    It is unrolled: for thousands of tiny systems, plain arithmetic that the compiler fuses is many times faster than a batched
    call of a linear algebra library.
    """
    n = len(b)
    low: list[list[Array]] = [[] for _ in range(n)]
    y: list[Array] = []
    for i in range(n):
        for j in range(i):
            low[i].append((a[i, j] - sum(low[i][k] * low[j][k] for k in range(j))) / low[j][j])
        low[i].append(jnp.sqrt(a[i, i] - sum(x * x for x in low[i])))
        y.append((b[i] - sum(low[i][k] * y[k] for k in range(i))) / low[i][i])
    x: list[Array] = [b[0]] * n
    for i in reversed(range(n)):
        x[i] = (y[i] - sum(low[k][i] * x[k] for k in range(i + 1, n))) / low[i][i]
    return jnp.stack(x)


def box_distance(
    point: Float[Array, "3"], pos: Float[Array, "3"], quat: Float[Array, "4"], size: Float[Array, "3"]
) -> Float[Array, ""]:
    """Returns the distance from a point to the surface of a box [m], negative inside.

    Args:
        pos, quat: position of the box's centre [m], and its orientation (wxyz).
        size: lengths of its edges [m].
    """
    beyond = jnp.abs(rotate(quat_conj(quat), point - pos)) - size / 2
    outside = jnp.maximum(beyond, 0.0)
    return jnp.sqrt(jnp.sum(outside**2) + 1e-12) + jnp.minimum(jnp.max(beyond), 0.0)
