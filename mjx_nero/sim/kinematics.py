"""Forward kinematics and Jacobians in plain JAX.

``mjx.step`` leaves body and site poses one physics step behind ``qpos``, and every backend keeps them in another place. A chain
of a few joints is cheap to compute wherever it is read. So terms see poses consistent with ``qpos`` on every backend, even right
after a reset, and controllers need neither a simulator nor its data.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.sim import linkage, quats

Pose = tuple[Float[Array, "3"], Float[Array, "4"]]
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_STILL = np.array([1.0, 0.0, 0.0, 0.0])
_ITSELF = (0.0, 1.0)


class _Node(NamedTuple):
    """A moving joint, with its frame at the anchor."""

    driver: int  # place in q of the joint that moves it: itself, or the one that it follows
    parent: int  # node that carries it; -1: the world
    fixed: tuple[np.ndarray, np.ndarray]  # transform from there
    axis: np.ndarray
    slide: bool
    powers: tuple[float, ...]  # its offset from qpos0, as a polynomial in the driver's offset


class Chain:
    """Poses and Jacobians of frames as functions of some hinges and slides. Its methods are pure and take one configuration.

    A joint that an equality of the model couples to a listed one follows it, as in a palletising arm's linkage. All others stay
    at the model's ``qpos0``. The constructor merges everything fixed between two joints into one transform.

    Args:
        model: compiled model.
        joints: names, in the order of ``q``.
        frames: names of sites or bodies, in the order of the results.

    Attributes:
        joints, frames: as given.
        lower, upper: [nj] joint limits [rad or m]; +-inf where there is none.

    Raises:
        KeyError: the model has no such joint or frame.
        ValueError: a ball or free joint lies between the world and a frame, or is listed.
    """

    def __init__(self, model: mujoco.MjModel, joints: Sequence[str], frames: Sequence[str]):
        self.joints, self.frames = tuple(joints), tuple(frames)
        ids = [model.joint(j).id for j in joints]
        for name, j in zip(joints, ids, strict=True):
            if model.jnt_type[j] not in (_HINGE, _SLIDE):
                raise ValueError(f"joint {name!r} is a ball or free joint: only hinges and slides are supported")
        limited = model.jnt_limited[ids].astype(bool)
        self.lower = np.where(limited, model.jnt_range[ids, 0], -np.inf).astype(np.float32)
        self.upper = np.where(limited, model.jnt_range[ids, 1], np.inf).astype(np.float32)
        self._nodes: list[_Node] = []
        self._qpos0 = np.array(model.qpos0[model.jnt_qposadr[ids]], np.float32)  # where a joint displaces nothing
        self._moved = _moved(model, ids)
        self._last: dict[int, tuple[int, tuple[np.ndarray, np.ndarray]]] = {0: (-1, (np.zeros(3), _STILL))}
        self._model = model
        self._ends = [self._end(name) for name in frames]
        # path[f, n]: node n moves frame f
        self._path = np.zeros((len(self.frames), len(self._nodes)), np.float32)
        for f, (node, _) in enumerate(self._ends):
            while node >= 0:
                self._path[f, node] = 1.0
                node = self._nodes[node].parent
        del self._model, self._last, self._moved

    def _body(self, body: int, frame: str) -> tuple[int, tuple[np.ndarray, np.ndarray]]:
        """Returns the node that carries a body and the fixed transform from there. Adds nodes on the way."""
        if body in self._last:
            return self._last[body]
        m = self._model
        node, fixed = self._body(int(m.body_parentid[body]), frame)
        fixed = _compose(fixed, (m.body_pos[body], m.body_quat[body]))
        for j in range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]):
            if m.jnt_type[j] not in (_HINGE, _SLIDE):
                raise ValueError(f"frame {frame!r} hangs on a ball or free joint: only hinges and slides are supported")
            anchor, slide = m.jnt_pos[j], bool(m.jnt_type[j] == _SLIDE)
            if j in self._moved:
                index, powers = self._moved[j]
                self._nodes.append(_Node(index, node, _compose(fixed, (anchor, _STILL)), m.jnt_axis[j].copy(), slide, powers))
                node, fixed = len(self._nodes) - 1, (-anchor, _STILL)
        self._last[body] = node, fixed
        return node, fixed

    def _end(self, name: str) -> tuple[int, tuple[np.ndarray, np.ndarray]]:
        m = self._model
        site = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SITE, name)
        if site < 0:
            return self._body(int(m.body(name).id), name)  # KeyError lists the bodies
        node, fixed = self._body(int(m.site_bodyid[site]), name)
        return node, _compose(fixed, (m.site_pos[site], m.site_quat[site]))

    def path(self, frame: int) -> tuple[list[tuple[int, tuple[np.ndarray, np.ndarray], np.ndarray, bool]], tuple]:
        """Returns a frame's joints, from the world on: (index in ``q``, fixed transform, axis, slide?); and its own transform."""
        node, end = self._ends[frame]
        links = []
        while node >= 0:
            i, node, fixed, axis, slides, _ = self._nodes[node]
            links.append((i, fixed, axis, slides))
        return links[::-1], end

    def poses(self, q: Float[Array, " nj"]) -> tuple[Float[Array, "nf 3"], Float[Array, "nf 4"]]:
        """Computes positions [m] and orientations (wxyz) of the frames in the world."""
        return self._frames(self._forward(q))

    def jacobians(self, q: Float[Array, " nj"]) -> tuple[Float[Array, "nf 3"], Float[Array, "nf 4"], Float[Array, "nf 6 nj"]]:
        """Computes ``poses`` and the geometric Jacobians: rows are linear, then angular velocity in the world frame."""
        nodes = self._forward(q)
        pos, quat = self._frames(nodes)
        columns: list[Array] = [jnp.zeros((len(self.frames), 6))] * len(self.joints)
        off = q - self._qpos0
        for n, (node, (anchor, turn)) in enumerate(zip(self._nodes, nodes, strict=True)):
            axis_w = jnp.broadcast_to(math.rotate(turn, jnp.asarray(node.axis, jnp.float32)), pos.shape)
            linear = axis_w if node.slide else jnp.cross(axis_w, pos - anchor)
            column = jnp.concatenate([linear, jnp.zeros_like(linear) if node.slide else axis_w], axis=1)
            ratio = _polynomial(tuple(np.polynomial.polynomial.polyder(node.powers)), off[node.driver])
            columns[node.driver] += self._path[:, n, None] * ratio * column
        return pos, quat, jnp.stack(columns, axis=-1)

    def _forward(self, q: Float[Array, " nj"]) -> list[Pose]:
        nodes: list[Pose] = []
        q = q - self._qpos0
        for i, parent, fixed, axis, slide, powers in self._nodes:
            pos, quat = _attach(nodes, parent, fixed)
            along, off = jnp.asarray(axis, jnp.float32), _polynomial(powers, q[i])
            if slide:
                pos = pos + math.rotate(quat, along * off)
            else:
                quat = math.quat_mul(quat, math.axis_angle(along, off))
            # Without a barrier XLA recomputes a link's pose for every number that depends on it: ten times the work.
            nodes.append(jax.lax.optimization_barrier((pos, quat)))
        return nodes

    def _frames(self, nodes: list[Pose]) -> tuple[Float[Array, "nf 3"], Float[Array, "nf 4"]]:
        ends = [_attach(nodes, node, fixed) for node, fixed in self._ends]
        return jnp.stack([pos for pos, _ in ends]), jnp.stack([quat for _, quat in ends])


def site_pose_fn(model: mujoco.MjModel, site: str) -> Callable[[Float[Array, " nq"]], Pose]:
    """Builds ``qpos -> (position [m], orientation wxyz)`` of a site or body in the world frame.

    The environments' inner loop uses this function; controllers use ``Chain``. It composes neighbouring links in pairs, then the
    pairs, so that seven joints take three rounds.

    Raises:
        KeyError: the model has no such site or body.
        ValueError: a ball or free joint lies between the world and the site.
    """
    joints = [j for j in range(model.njnt) if model.jnt_type[j] in (_HINGE, _SLIDE)]
    links, (end_pos, end_quat) = Chain(model, [model.joint(j).name for j in joints], [site]).path(0)
    at = model.jnt_qposadr[[joints[i] for i, *_ in links]]
    # Of each link, in its parent's frame: position + slide * q, and quaternion * cos(half q) + turned * sin(half q).
    position, slide, quaternion, turned = (np.zeros((n, len(links) + 1), np.float32) for n in (3, 3, 4, 4))
    half = np.zeros(len(links) + 1, np.float32)
    for k, (_, (pos, quat), axis, slides) in enumerate(links):
        position[:, k], quaternion[:, k], half[k] = pos, quat, 0.0 if slides else 0.5
        if slides:
            slide[:, k] = _compose((np.zeros(3), quat), (axis, _STILL))[0]
        else:
            turned[:, k] = _compose((np.zeros(3), quat), (np.zeros(3), np.array([0.0, *axis])))[1]
    position[:, -1], quaternion[:, -1] = end_pos, end_quat
    still = model.qpos0[at].astype(np.float32)

    def pose(qpos: Float[Array, " nq"]) -> Pose:
        q = jnp.append(qpos[at] - still, 0.0)
        angle = q * half
        # One column per link.
        pos = jnp.asarray(position) + slide * q
        quat = jnp.asarray(quaternion) * jnp.cos(angle) + turned * jnp.sin(angle)
        while (count := pos.shape[1]) > 1:
            pairs = count // 2 * 2
            inner, outer = slice(0, pairs, 2), slice(1, pairs, 2)
            joined = pos[:, inner] + math.rotate(quat[:, inner], pos[:, outer]), math.quat_mul(quat[:, inner], quat[:, outer])
            # The barrier keeps XLA from recomputing a round for every number of the next: three rounds of that can take longer
            # than the physics.
            pos, quat = jax.lax.optimization_barrier(
                tuple(jnp.concatenate([new, old[:, pairs:]], axis=1) for new, old in zip(joined, (pos, quat), strict=True))
            )
        return pos[:, 0], quat[:, 0]

    return pose


def _moved(model: mujoco.MjModel, ids: Sequence[int]) -> dict[int, tuple[int, tuple[float, ...]]]:
    """``_Node.driver`` and ``powers`` of each joint that moves: the listed ones, and those that follow them."""
    moved: dict[int, tuple[int, tuple[float, ...]]] = {j: (i, _ITSELF) for i, j in enumerate(ids)}
    joint = {int(address): j for j, address in enumerate(model.jnt_qposadr)}
    for coupling in linkage.couplings(model):  # leaders come before their followers
        follower, leader = joint[coupling.follower], joint[coupling.leader]
        if follower not in moved and leader in moved:
            index, powers = moved[leader]
            constant, *ratios = coupling.coefficients
            own = np.polynomial.Polynomial([constant - model.qpos0[coupling.follower], *ratios])
            moved[follower] = index, tuple(float(c) for c in own(np.polynomial.Polynomial(powers)).coef)
    return moved


def _polynomial(powers: tuple[float, ...], x: Float[Array, ""]) -> Float[Array, ""]:
    """Value at ``x`` of a polynomial given by its coefficients, the constant one first."""
    if powers == _ITSELF:
        return x
    out = jnp.zeros_like(x)
    for power in powers[::-1]:
        out = out * x + power
    return out


def _attach(nodes: list[Pose], parent: int, fixed: tuple[np.ndarray, np.ndarray]) -> Pose:
    pos, quat = jnp.asarray(fixed[0], jnp.float32), jnp.asarray(fixed[1], jnp.float32)
    if parent < 0:
        return pos, quat
    at, turn = nodes[parent]
    return at + math.rotate(turn, pos), math.quat_mul(turn, quat)


def _compose(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Composes two transforms, in double precision: ``b`` given in the frame ``a``."""
    return a[0] + quats.rotated(b[0], a[1]), quats.product(a[1], b[1])
