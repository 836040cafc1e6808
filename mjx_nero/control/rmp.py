"""Riemannian motion policies: the leaves of RMPflow's tree, and the algebra that sums them at its root (see ``rmpflow``).

A leaf is named after its group in the parameter file, and reads that group's keys.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero.control import rmpflow_config as cfg
from mjx_nero.math import solve_spd


class Rmp(NamedTuple):
    """A policy in natural form: force f = M a, and metric M. Scalar and diagonal metrics have the force's shape."""

    force: Array
    metric: Array


def cspace_target_rmp(p: cfg.CspaceTargetCfg, q, qd, default_q) -> Rmp:
    """Pull to the posture ``default_q``: constant from afar, linear within the threshold; and the joints' inertia. All [nj]."""
    error = default_q - q
    pull = error * jnp.minimum(1.0, p.robust_position_term_thresh / norm(error))
    accel = p.position_gain * pull - p.damping_gain * qd
    return Rmp(p.metric_scalar * accel, jnp.full_like(q, p.metric_scalar + p.inertia))


def joint_limit_rmp(p: cfg.JointLimitCfg, x, xd) -> Rmp:
    """Push away from a limit at distance ``x``, a share of the joint's range; the damper acts only towards the limit."""
    x = jnp.maximum(x, 0.0)
    accel = p.accel_potential_gain / ((x / p.accel_potential_exploder_length_scale) ** 2 + p.accel_potential_exploder_eps)
    accel = accel - p.accel_damper_gain * xd
    gate = 1.0 - jax.nn.sigmoid(xd / p.metric_velocity_gate_length_scale)
    metric = gate * p.metric_scalar / (x / p.metric_length_scale + p.metric_exploder_eps)
    return Rmp(metric * accel, metric)


def joint_velocity_cap_rmp(p: cfg.JointVelocityCapCfg, qd) -> Rmp:
    """Brake on a joint within ``velocity_damping_region`` of the top speed, infinitely heavy at the top speed."""
    region = p.velocity_damping_region
    excess = jnp.abs(qd) - (p.max_velocity - region)
    accel = -p.damping_gain * jnp.sign(qd) * excess
    share = jnp.minimum(excess / region, 1.0 - 1e-4)
    metric = jnp.where(excess < 0, 0.0, p.metric_weight / (1.0 - share**2))
    return Rmp(metric * accel, metric)


def target_rmp(p: cfg.TargetCfg, error: Float[Array, "3"], vel: Float[Array, "3"]) -> Rmp:
    """Pull along ``error`` = target - position [m], damping of ``vel``, the velocity relative to the target [m/s].

    Far away, mainly the direction of the error matters. Close to the target all directions do, and they matter more.
    """
    length = norm(error)
    direction = error / length
    accel = p.accel_p_gain * error / (length + p.accel_norm_eps) - p.accel_d_gain * vel
    near = (1.0 - p.min_metric_alpha) * _bell(length, p.metric_alpha_length_scale) + p.min_metric_alpha
    metric = near * p.max_metric_scalar * jnp.eye(3) + (1.0 - near) * p.min_metric_scalar * jnp.outer(direction, direction)
    return _weighted(metric * _boost(p, length), accel)


def axis_target_rmp(p: cfg.AxisTargetCfg, error: Float[Array, "3"], vel: Float[Array, "3"], distance) -> Rmp:
    """Pull of one axis (a unit vector) along ``error`` = target - axis; heavier as the ``distance`` [m] to the target shrinks."""
    metric = p.metric_scalar * (1.0 if distance is None else _boost(p, distance)) * jnp.eye(3)
    return _weighted(metric, p.accel_p_gain * error - p.accel_d_gain * vel)


def damping_rmp(p: cfg.DampingCfg, xd) -> Rmp:
    """Quadratic drag and inertia on the distance to the target, which changes by ``xd`` [m/s]."""
    metric = p.metric_scalar * jnp.abs(xd)
    return Rmp(-metric * p.accel_d_gain * jnp.abs(xd) * xd, metric + p.inertia)


def collision_rmp(p: cfg.CollisionCfg, x, xd) -> Rmp:
    """Push away from a surface at distance ``x`` [m]; metric and damper act only towards the surface."""
    x = jnp.maximum(x, 0.0)
    gate = 1.0 - jax.nn.sigmoid(xd / p.damping_velocity_gate_length_scale)
    damper = p.damping_gain * gate * xd / (x / p.damping_std_dev + p.damping_robustness_eps)
    accel = p.repulsion_gain * jnp.exp(-x / p.repulsion_std_dev) - damper
    nearness = jnp.maximum(1.0 - x / p.metric_modulation_radius, 0.0) ** 2
    metric = gate * nearness * p.metric_scalar / (x / p.metric_exploder_std_dev + p.metric_exploder_eps)
    return Rmp(metric * accel, metric)


def along(direction: Float[Array, "*n 3"], curvature: Float[Array, "*n"], leaf: Rmp) -> Rmp:
    """Pulls scalar leaves back to points. ``direction`` is the gradient of the coordinate that a leaf sees.

    ``curvature``: the coordinate's second derivative in time while the point moves straight on.
    """
    outer = direction[..., :, None] * direction[..., None, :]
    return Rmp((leaf.force - leaf.metric * curvature)[..., None] * direction, leaf.metric[..., None, None] * outer)


def clearance(point, vel, pt1, pt2) -> tuple[Array, Array, Array, Array]:
    """Distance of a point to a segment [m], its gradient, its rate, its second derivative while the point moves straight on."""
    axis = pt2 - pt1
    square = jnp.maximum(dot(axis, axis), 1e-12)
    share = jnp.clip(dot(point - pt1, axis) / square, 0.0, 1.0)
    offset = point - pt1 - share * axis
    distance = norm(offset)
    direction = offset / distance
    rate = dot(direction, vel)
    slide = jnp.where((share > 0) & (share < 1), dot(axis, vel) ** 2 / square, 0.0)  # motion along a cylinder turns nothing
    return distance, direction, rate, jnp.maximum(dot(vel, vel) - rate**2 - slide, 0.0) / distance


def box_clearance(point, vel, center, turn: Float[Array, "3 3"], size) -> tuple[Array, Array, Array, Array]:
    """``clearance`` of a point from a box with edges ``size`` [m] along the columns of ``turn``.

    Over a face the nearest point slides in two directions, over an edge in one: the distance is that of a plane, a cylinder or a
    sphere. Inside the box it is negative, and its gradient leads out through the nearest face.
    """
    local, speed = jnp.sum(turn * (point - center)[:, None], axis=0), jnp.sum(turn * vel[:, None], axis=0)
    beyond = jnp.abs(local) - size / 2
    outside = jnp.max(beyond) > 0
    nearest = jnp.arange(3) == jnp.argmax(beyond)
    offset = jnp.sign(local) * jnp.where(outside, jnp.maximum(beyond, 0.0), nearest * 1.0)
    length = norm(offset)
    distance = jnp.where(outside, length, jnp.max(beyond))
    direction = offset / length
    rate = dot(direction, speed)
    turning = jnp.where(outside & (beyond > 0), speed, 0.0)  # velocity in the coordinates that make up the offset
    curvature = jnp.maximum(dot(turning, turning) - rate**2, 0.0) / length
    return distance, jnp.sum(turn * direction, axis=1), rate, jnp.where(outside, curvature, 0.0)


def pull_back(jac: Float[Array, "n 3 nj"], curvature: Float[Array, "n 3"], node: Rmp) -> Rmp:
    """Sums policies on ``n`` points at the root; ``curvature`` = Jdot qd."""
    weighted = jnp.einsum("nab,nbj->naj", node.metric, jac, precision="highest")
    force = node.force - jnp.sum(node.metric * curvature[:, None, :], axis=-1)
    return Rmp(jnp.sum(jac * force[..., None], axis=(0, 1)), jnp.einsum("nai,naj->ij", jac, weighted, precision="highest"))


def resolve(p: cfg.ResolveCfg, root: Rmp) -> Float[Array, " nj"]:
    """The acceleration that the root asks for [rad/s^2], scaled down to the greatest norm (an assumption: no source says how)."""
    metric = root.metric
    # As large as the metric's rounding error: keeps the root solvable where no leaf acts.
    ridge = 1e-6 + float(jnp.finfo(metric.dtype).eps) * jnp.trace(metric)
    accel = solve_spd(metric + ridge * jnp.eye(len(root.force)), root.force)
    return accel * jnp.minimum(1.0, p.max_acceleration_norm / norm(accel))


def dot(a: Float[Array, " n"], b: Float[Array, " n"]) -> Float[Array, ""]:
    """Inner product in full precision: ``@`` takes the default of the device, on a GPU 10 bits."""
    return jnp.sum(a * b)


def norm(vec: Float[Array, " n"]) -> Float[Array, ""]:
    """Euclidean norm, with a derivative also at zero."""
    return jnp.sqrt(dot(vec, vec) + 1e-12)


def _bell(x, width):
    return jnp.exp(-0.5 * (x / width) ** 2)


def _boost(p: cfg.PullCfg, distance):
    beta = _bell(distance, p.proximity_metric_boost_length_scale)
    return beta * p.proximity_metric_boost_scalar + 1.0 - beta


def _weighted(metric: Float[Array, "3 3"], accel: Float[Array, "3"]) -> Rmp:
    return Rmp(jnp.sum(metric * accel, axis=-1), metric)
