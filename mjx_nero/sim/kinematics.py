"""Forward kinematics and Jacobians in plain JAX.

``mjx.step`` leaves body and site poses one physics step behind ``qpos``, and every backend keeps them in another place. A chain
of a few joints is cheap to compute wherever it is read. So terms see poses consistent with ``qpos`` on every backend, even right
after a reset, and controllers need neither a simulator nor its data.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.sim import linkage, quats

Pose = tuple[Float[Array, "3"], Float[Array, "4"]]
Poses = tuple[Float[Array, "3 _"], Float[Array, "4 _"]]  # a column each
Transform = tuple[np.ndarray, np.ndarray]
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_STILL = np.array([1.0, 0.0, 0.0, 0.0])
_NOWHERE: Transform = (np.zeros(3), _STILL)
_ITSELF = (0.0, 1.0)


class _Node(NamedTuple):
    """A moving joint, with its frame at the anchor."""

    driver: int  # place in q of the joint that moves it: itself, or the one that it follows
    parent: int  # node that carries it; 0: the world
    fixed: Transform  # from there
    axis: np.ndarray
    slide: bool
    powers: tuple[float, ...]  # its offset from qpos0, as a polynomial in the driver's offset


_WORLD = _Node(-1, 0, _NOWHERE, np.zeros(3), False, (0.0,))


class _Links:
    """Transforms of nodes from what carries them, one column per node, as functions of their offsets."""

    def __init__(self, nodes: Sequence[_Node]):
        # position + slide * off, and quaternion * cos(half off) + turned * sin(half off)
        slides = np.array([node.slide for node in nodes])
        self._position, self._quaternion = _columns([node.fixed for node in nodes])
        slide, turned = _columns([_moves(node.axis, node.fixed[1]) for node in nodes])
        self._slide, self._turned, self._half = slide * slides, turned * ~slides, np.float32(0.5) * ~slides

    def at(self, off: Float[Array, " n"]) -> Poses:
        """Computes the transforms; ``off`` are distances from ``qpos0`` [rad or m]."""
        angle = off * self._half
        quat = jnp.asarray(self._quaternion) * jnp.cos(angle) + self._turned * jnp.sin(angle)
        return jnp.asarray(self._position) + self._slide * off, quat


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
        self._nodes = [_WORLD]
        self._qpos0 = np.array(model.qpos0[model.jnt_qposadr[ids]], np.float32)  # where a joint displaces nothing
        self._moved = _moved(model, ids)
        self._last: dict[int, tuple[int, Transform]] = {0: (0, _NOWHERE)}
        self._model = model
        self._ends = [self._end(name) for name in frames]
        del self._model, self._last, self._moved
        self._tabulate()

    def _body(self, body: int, frame: str) -> tuple[int, Transform]:
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

    def _end(self, name: str) -> tuple[int, Transform]:
        m = self._model
        site = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SITE, name)
        if site < 0:
            return self._body(int(m.body(name).id), name)  # KeyError lists the bodies
        node, fixed = self._body(int(m.site_bodyid[site]), name)
        return node, _compose(fixed, (m.site_pos[site], m.site_quat[site]))

    def _tabulate(self) -> None:
        """Makes the tables that the methods compute with: a column for each node or frame."""
        nodes = self._nodes
        self._links, self._fixed = _Links(nodes), _columns([fixed for _, fixed in self._ends])
        self._axes = np.array([node.axis for node in nodes], np.float32).T
        self._slides = np.array([node.slide for node in nodes])
        self._rounds = _rounds([node.parent for node in nodes])
        # path[f, n]: node n moves frame f
        self._path = np.zeros((len(self.frames), len(nodes)), np.float32)
        for f in range(len(self.frames)):
            self._path[f, self.path(f)] = 1.0
        # By joint: the nodes that it moves, filled up with the world's, which moves nothing.
        moved = [[n for n, node in enumerate(nodes) if node.driver == j] for j in range(len(self.joints))]
        most = max([1, *map(len, moved)])
        self._movers = [[(*each, *[0] * most)[k] for each in moved] for k in range(most)]
        self._powers = None
        if any(node.powers != _ITSELF for node in nodes[1:]):
            self._powers = np.zeros((max(len(node.powers) for node in nodes), len(nodes)), np.float32)
            for n, node in enumerate(nodes):
                self._powers[: len(node.powers), n] = node.powers

    def path(self, frame: int) -> list[int]:
        """Lists the nodes that move a frame, from the world on."""
        node, found = self._ends[frame][0], list[int]()
        while node:
            found.append(node)
            node = self._nodes[node].parent
        return found[::-1]

    def poses(self, q: Float[Array, " nj"]) -> tuple[Float[Array, "nf 3"], Float[Array, "nf 4"]]:
        """Computes positions [m] and orientations (wxyz) of the frames in the world."""
        pos, quat = self._frames(self._forward(q))
        return pos.T, quat.T

    def jacobians(self, q: Float[Array, " nj"]) -> tuple[Float[Array, "nf 3"], Float[Array, "nf 4"], Float[Array, "nf 6 nj"]]:
        """Computes ``poses`` and the geometric Jacobians: rows are linear, then angular velocity in the world frame."""
        anchor, turn = self._forward(q)
        pos, quat = self._frames((anchor, turn))
        axis = jnp.broadcast_to(math.rotate(turn, jnp.asarray(self._axes))[:, None], (3, *self._path.shape))
        linear, angular = jnp.cross(axis, pos[:, :, None] - anchor[:, None], axis=0), axis
        if self._slides.any():
            linear, angular = jnp.where(self._slides, axis, linear), jnp.where(self._slides, 0.0, axis)
        columns = jnp.concatenate([linear, angular]) * self._path
        if self._powers is not None:
            columns *= _polynomial(np.polynomial.polynomial.polyder(self._powers), self._driven(q))
        moved = sum(_picked(columns, nodes) for nodes in self._movers)
        return pos.T, quat.T, jnp.moveaxis(jnp.asarray(moved), 1, 0)

    def _driven(self, q: Float[Array, " nj"]) -> Float[Array, " n"]:
        """Returns the offset of each node's driver, the world's first."""
        return jnp.concatenate([jnp.zeros(1), _picked(q - self._qpos0, [node.driver for node in self._nodes[1:]])])

    def _forward(self, q: Float[Array, " nj"]) -> Poses:
        """Returns the nodes' poses, the world's first."""
        off = self._driven(q)
        if self._powers is not None:
            off = _polynomial(self._powers, off)
        pos, quat = self._links.at(off)
        for first, carriers in self._rounds:
            joined = _joined((_picked(pos, carriers), _picked(quat, carriers)), (pos[:, first:], quat[:, first:]))
            # Rounds are a third of the operations that links one by one are, and compile so much faster. Without a barrier XLA
            # recomputes a round for every number of the next.
            pos, quat = jax.lax.optimization_barrier(
                tuple(jnp.concatenate([old[:, :first], new], axis=1) for old, new in zip((pos, quat), joined, strict=True))
            )
        return pos, quat

    def _frames(self, nodes: Poses) -> Poses:
        pos, quat = (_picked(x, [node for node, _ in self._ends]) for x in nodes)
        return _joined((pos, quat), self._fixed)


def site_pose_fn(model: mujoco.MjModel, site: str) -> Callable[[Float[Array, " nq"]], Pose]:
    """Builds ``qpos -> (position [m], orientation wxyz)`` of a site or body in the world frame.

    The environments' inner loop uses this function; controllers use ``Chain``. It composes neighbouring links in pairs, then the
    pairs, so that seven joints take three rounds.

    Raises:
        KeyError: the model has no such site or body.
        ValueError: a ball or free joint lies between the world and the site.
    """
    joints = [j for j in range(model.njnt) if model.jnt_type[j] in (_HINGE, _SLIDE)]
    chain = Chain(model, [model.joint(j).name for j in joints], [site])
    nodes = [chain._nodes[n] for n in chain.path(0)]
    at = model.jnt_qposadr[[joints[node.driver] for node in nodes]]
    links, still = _Links([*nodes, _WORLD._replace(fixed=chain._ends[0][1])]), model.qpos0[at].astype(np.float32)

    def pose(qpos: Float[Array, " nq"]) -> Pose:
        pos, quat = links.at(jnp.append(qpos[at] - still, 0.0))
        while (count := pos.shape[1]) > 1:
            pairs = count // 2 * 2
            inner, outer = slice(0, pairs, 2), slice(1, pairs, 2)
            joined = _joined((pos[:, inner], quat[:, inner]), (pos[:, outer], quat[:, outer]))
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


def _rounds(parents: Sequence[int]) -> list[tuple[int, list[int]]]:
    """Lists the rounds that compose links: the first node that changes, and what carries it and each later one.

    A round doubles the links that are composed, so that a chain of seven takes three.
    """
    found, carriers = list[tuple[int, list[int]]](), list(parents)
    while any(carriers):
        first = next(n for n, carrier in enumerate(carriers) if carrier)
        found.append((first, carriers[first:]))
        carriers = [carriers[node] for node in carriers]
    return found


def _picked(x: Float[Array, "*rows n"], columns: Sequence[int]) -> Float[Array, "*rows m"]:
    """Picks columns by slices, which XLA fuses, in place of a gather."""
    if not columns:
        return x[..., :0]
    begins = [k for k, column in enumerate(columns) if not k or column != columns[k - 1] + 1]
    runs = [(columns[k], columns[end - 1] + 1) for k, end in itertools.pairwise([*begins, len(columns)])]
    return jnp.concatenate([jax.lax.slice_in_dim(x, a, b, axis=-1) for a, b in runs], axis=-1)


def _columns(transforms: Sequence[Transform]) -> tuple[np.ndarray, np.ndarray]:
    """Positions [3, n] and quaternions [4, n]."""
    n = len(transforms)
    pos, quat = (np.array([each[k] for each in transforms], np.float32).reshape(n, 3 + k).T for k in range(2))
    return pos, quat


def _moves(axis: np.ndarray, quat: np.ndarray) -> Transform:
    """Returns a joint's part of a link: times its offset of the position, times the sine of half of that of the quaternion."""
    return quats.rotated(axis, quat), quats.product(quat, [0.0, *axis])


def _polynomial(powers: np.ndarray, x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Values at ``x`` of polynomials given by their coefficients [powers, n], the constant ones first."""
    out = jnp.zeros_like(x)
    for power in powers[::-1]:
        out = out * x + power
    return out


def _joined(carriers: Any, carried: Any) -> Poses:
    """Composes transforms column by column: ``carried`` given in the frames ``carriers``."""
    (at, turn), (pos, quat) = carriers, carried
    return at + math.rotate(turn, pos), math.quat_mul(turn, quat)


def _compose(a: Transform, b: Transform) -> Transform:
    """Composes two transforms, in double precision: ``b`` given in the frame ``a``."""
    return a[0] + quats.rotated(b[0], a[1]), quats.product(a[1], b[1])
