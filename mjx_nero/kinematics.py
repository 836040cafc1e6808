"""Forward kinematics of one site in plain JAX.

``mjx.step`` leaves body and site poses one physics step behind ``qpos``, and every backend keeps them elsewhere. A chain
of seven joints is cheap enough to compute where it is read, so the terms see poses that fit ``qpos`` on every backend,
also right after a reset.
"""

from collections.abc import Callable

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjx_nero import math

Pose = tuple[Float[Array, "3"], Float[Array, "4"]]


def site_pose_fn(model: mujoco.MjModel, site: str) -> Callable[[Float[Array, " nq"]], Pose]:
    """Builds ``qpos -> (position [m], orientation wxyz)`` of a site in the world frame.

    Raises:
        KeyError: the model has no such site.
        ValueError: a ball or free joint lies between the world and the site.
    """
    site_id = model.site(site).id
    chain = []
    body = model.site_bodyid[site_id]
    while body:
        chain.append(body)
        body = model.body_parentid[body]
    joints = {b: range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]) for b in chain}
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    if any(model.jnt_type[j] not in (hinge, slide) for b in chain for j in joints[b]):
        raise ValueError(f"site {site!r} hangs on a ball or free joint: only hinges and slides are supported")

    def pose(qpos: Float[Array, " nq"]) -> Pose:
        pos, quat = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0])
        for b in reversed(chain):
            pos = pos + math.rotate(quat, jnp.asarray(model.body_pos[b]))
            quat = math.quat_mul(quat, jnp.asarray(model.body_quat[b]))
            for j in joints[b]:
                axis, q = jnp.asarray(model.jnt_axis[j]), qpos[model.jnt_qposadr[j]]
                if model.jnt_type[j] == slide:
                    pos = pos + math.rotate(quat, axis * q)
                else:  # a turn about the joint's anchor, which stays where it is
                    anchor = jnp.asarray(model.jnt_pos[j])
                    turned = math.quat_mul(quat, math.axis_angle(axis, q))
                    pos = pos + math.rotate(quat, anchor) - math.rotate(turned, anchor)
                    quat = turned
        pos = pos + math.rotate(quat, jnp.asarray(model.site_pos[site_id]))
        return pos, math.quat_mul(quat, jnp.asarray(model.site_quat[site_id]))

    return pose
