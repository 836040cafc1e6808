"""RMPflow: reactive motion generation by a tree of Riemannian motion policies.

A leaf of the tree sees the arm through a task map x = phi(q), and asks for an acceleration a there, with a metric M that says how
much each direction matters. The root sums the leaves: (sum J^T M J) qdd = sum J^T M (a - c), with the curvature c = Jdot qd.

Algebra: Cheng et al. 2018 (arXiv 1811.07049). Leaves and their parameters: Isaac Sim 5.x, "RMPflow" concept and tuning pages;
where these leave something open, the docstring states the assumption. All functions are pure, for one robot; ``jax.vmap`` them
for many.

A reactive policy has no plan: a target on the other side of the base, or behind a wall, can leave the arm stuck on the way.
"""

import dataclasses
import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from mjx_nero.config.values import unknown
from mjx_nero.control import rmp
from mjx_nero.control import rmpflow_config as cfg
from mjx_nero.math import rotate, rotation_matrix
from mjx_nero.sim import quats, scene
from mjx_nero.sim.kinematics import Chain
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError, View


@struct.dataclass
class Obstacles:
    """Capsules and boxes in the world [m], assumed at rest. A sphere is a capsule whose ends coincide."""

    pt1: Float[Array, "n 3"]
    pt2: Float[Array, "n 3"]
    radius: Float[Array, " n"]
    center: Float[Array, "m 3"] | None = None  # of the boxes; None: there are none
    quat: Float[Array, "m 4"] | None = None  # wxyz
    size: Float[Array, "m 3"] | None = None  # edges

    @classmethod
    def none(cls) -> "Obstacles":
        """Makes an empty set, which costs less than distant obstacles."""
        return cls.spheres(np.zeros((0, 3)), 0.0)

    @classmethod
    def spheres(cls, center, radius) -> "Obstacles":
        """Spheres at ``center`` [n, 3] with ``radius`` [n], or one radius for all."""
        return cls.cylinders(center, center, radius)

    @classmethod
    def cylinders(cls, pt1, pt2, radius) -> "Obstacles":
        """Cylinders round the lines from ``pt1`` to ``pt2`` [n, 3], with round caps beyond; ``radius`` [n], or one for all."""
        pt1, pt2 = jnp.asarray(pt1, jnp.float32), jnp.asarray(pt2, jnp.float32)
        return cls(pt1, pt2, jnp.broadcast_to(jnp.asarray(radius, jnp.float32), pt1.shape[:1]))

    @classmethod
    def boxes(cls, center, quat, size) -> "Obstacles":
        """Boxes with their centres at ``center`` [n, 3], turned by ``quat`` [n, 4] (wxyz), of edges ``size`` [n, 3]."""
        center, quat, size = (jnp.asarray(x, jnp.float32) for x in (center, quat, size))
        return dataclasses.replace(cls.none(), center=center, quat=quat, size=size)

    @classmethod
    def seen(cls, view: View) -> "Obstacles":
        """Makes the obstacles of the scene."""
        if not view.obstacles:
            return cls.none()
        boxes = view.obstacles.values()
        return cls.boxes(*(jnp.stack([getattr(box, part) for box in boxes]) for part in ("pos_w", "quat_w", "size")))

    def __len__(self) -> int:
        return len(self.radius) + (0 if self.center is None else len(self.center))


@struct.dataclass
class Target:
    """Target of the controlled frame in the world. None leaves a part free.

    The velocity (None: at rest) is our extension: the leaves damp motion relative to it. The original damps motion relative to
    the world, so the frame lags behind a moving target: by 50 mm instead of 1 mm on a circle at 0.157 m/s.

    The arm approaches a target out of reach as far as it can. Within about 0.2 m of it, orientation counts more than the rest of
    the way; leave orientation free to come as near as possible.
    """

    position: Float[Array, "3"] | None = None  # [m]
    orientation: Float[Array, "4"] | None = None  # wxyz
    velocity: Float[Array, "3"] | None = None  # [m/s]
    weight: Float[Array, ""] | float | None = None  # of the orientation; 0: it is free; None: 1


class RmpFlow:
    """The policy of one robot: pure functions of its joints, a target and obstacles.

    Args:
        robot: robot whose arm joints move; all others stay at the model's zero.
        frame: body or site to steer; None: the robot's grasp point.
        descriptor, config: YAML files; None: the robot's own, in ``assets/<robot>/rmpflow``.
        maximum_substep_size: longest step of the integration [s].

    Attributes:
        joints: names, in the order of ``q``.
        default_q: [nj] preferred posture [rad].
        chain: kinematics; its first frame is the one to steer.
        config: the parameters.

    Raises:
        UserError: a file cannot be read or does not fit the robot, there is no such frame, or the step is not above 0.
    """

    def __init__(
        self,
        robot: RobotCfg,
        frame: str | None = None,
        descriptor: pathlib.Path | None = None,
        config: pathlib.Path | None = None,
        maximum_substep_size: float = 0.00334,
    ):
        if not maximum_substep_size > 0:
            raise UserError(f"maximum_substep_size takes a time above 0 s, got {maximum_substep_size!r}")
        frame, folder = frame or robot.ee_site, robot.xml.parent / "rmpflow"
        descriptor = pathlib.Path(descriptor or folder / "robot_descriptor.yaml")
        config = pathlib.Path(config or folder / "rmpflow_common.yaml")
        arm, self.config = cfg.load_pair(descriptor, config, robot.arm.joints)
        self.joints, self.default_q = arm.cspace, np.array(arm.default_q, np.float32)
        self._max_substep = maximum_substep_size

        model = scene.robot_model(robot)
        frames = [model.site(i).name for i in range(model.nsite)] + [model.body(i).name for i in range(model.nbody)]
        if frame not in frames:
            raise UserError(f"{robot.name}: {unknown('frame', frame, frames)}")
        if arm.root_link not in ("world", robot.base_link):
            raise UserError(f"{descriptor}: root_link: {unknown('root', arm.root_link, ('world', robot.base_link))}")

        # Spheres: first those of the controllers, which the base repels too, then the descriptor's, which only obstacles repel.
        controllers = self.config.body_collision_controllers
        spheres = [
            (c.name, (0.0, 0.0, 0.0), c.radius, f"{config}: body_collision_controllers[{i}].name")
            for i, c in enumerate(controllers)
        ]
        for i, entry in enumerate(arm.collision_spheres):
            place = f"{descriptor}: collision_spheres[{i}]"
            spheres += [(link, s.center, s.radius, place) for link, own in entry.items() for s in own]
        for name, _, _, place in spheres:
            if name not in frames:
                raise UserError(f"{place}: {unknown('frame', name, frames)}")
        self._controllers = len(controllers)
        self._radius = np.array([radius for _, _, radius, _ in spheres], np.float32)

        # Nodes of the tree, each a vector in a frame: the steered frame's origin, its three axes, the spheres' centres.
        used = list(dict.fromkeys([frame, *(name for name, *_ in spheres)]))
        self.chain = Chain(model, self.joints, used)
        self._frame = np.array([0] * 4 + [used.index(name) for name, *_ in spheres])
        self._vector = np.array([(0, 0, 0), *np.eye(3), *(center for _, center, _, _ in spheres)], np.float32)
        self._is_point = np.array([1.0] + [0.0] * 3 + [1.0] * len(spheres), np.float32)

        self._set_base(model.body(robot.base_link))
        self._set_limits(config)

    def _set_base(self, base) -> None:
        """Places the cylinders around the base in the world."""
        cylinders = self.config.body_cylinders
        ends = np.array([(c.pt1, c.pt2) for c in cylinders]).reshape(-1, 2, 3)
        self._cylinders = (base.pos + ends @ quats.matrix(base.quat).T).astype(np.float32)
        self._cylinder_radius = np.array([c.radius for c in cylinders], np.float32)

    def _set_limits(self, config: pathlib.Path) -> None:
        """Sets the joints' ranges, less the parameters' buffers."""
        buffers = np.array(self.config.joint_limit_buffers, np.float32)
        lower, upper = self.chain.lower + buffers, self.chain.upper - buffers
        for name, low, high in zip(self.joints, lower, upper, strict=True):
            if low >= high:
                raise UserError(f"{config}: joint_limit_buffers leave {name} no range")
        limited = np.isfinite(upper - lower)
        self._limits = np.where(limited, [lower, upper], 0.0).astype(np.float32)
        self._per_range = np.where(limited, 1.0 / (upper - lower), 0.0)  # 0 switches an unlimited joint's leaves off

    def acceleration(
        self, q: Float[Array, " nj"], qd: Float[Array, " nj"], target: Target, obstacles: Obstacles
    ) -> Float[Array, " nj"]:
        """Computes joint accelerations [rad/s^2] at positions [rad] and velocities [rad/s]."""
        # Without obstacles, only the controllers' spheres can meet anything.
        count = 4 + (len(self._radius) if len(obstacles) else self._controllers)
        x, xd, curvature, jac = self._nodes(q, qd, count)
        frame = self._frame_leaves(target, x[:4], xd[:4])
        spheres = self._sphere_leaves(obstacles, x[4:], xd[4:])
        tasks = rmp.pull_back(jac, curvature, jax.tree.map(lambda a, b: jnp.concatenate([a, b]), frame, spheres))
        joints = self._joint_leaves(q, qd)
        return rmp.resolve(
            self.config.canonical_resolve, rmp.Rmp(tasks.force + joints.force, tasks.metric + jnp.diag(joints.metric))
        )

    def step(
        self, q: Float[Array, " nj"], qd: Float[Array, " nj"], target: Target, obstacles: Obstacles, dt: float
    ) -> tuple[Float[Array, " nj"], Float[Array, " nj"]]:
        """Computes positions [rad] and velocities [rad/s] ``dt`` later by explicit Euler substeps: set-points for the drives.

        Args:
            dt: control step [s]; a Python number. A target with a velocity moves on meanwhile.
        """
        n = max(1, math.ceil(dt / self._max_substep - 1e-6))
        h, cap = dt / n, self.config.rmp_params.joint_velocity_cap_rmp.max_velocity

        def substep(i, state):
            q, qd = state
            goal = target
            if target.position is not None and target.velocity is not None:
                goal = dataclasses.replace(target, position=target.position + i * h * target.velocity)
            accel = self.acceleration(q, qd, goal, obstacles)
            # The cap's leaf is one of many, so the speed may still exceed the cap after a substep.
            return q + h * qd, jnp.clip(qd + h * accel, -cap, cap)

        return jax.lax.fori_loop(0, n, substep, (q, qd))

    def spheres(self, q: Float[Array, " nj"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
        """Returns centres in the world and radii of the spheres that avoid obstacles [m]; the controllers' first."""
        return self._nodes(q, jnp.zeros_like(q), len(self._frame))[0][4:], jnp.asarray(self._radius)

    def _nodes(self, q, qd, count: int) -> tuple[Array, Array, Array, Array]:
        """Values and velocities [n, 3], Jdot qd [n, 3] and J [n, 3, nj] of the first ``count`` nodes."""
        frame, vector = self._frame[:count], jnp.asarray(self._vector[:count])
        is_point = jnp.asarray(self._is_point[:count, None])

        def moves(q):
            pos, quat, jac = self.chain.jacobians(q)
            arm = jax.vmap(rotate)(quat[frame], vector)
            jac = is_point[..., None] * jac[frame, :3] + jnp.cross(jac[frame, 3:], arm[..., None], axis=1)
            return jnp.sum(jac * qd, axis=-1), (is_point * pos[frame] + arm, jac)

        xd, curvature, (x, jac) = jax.jvp(moves, (q,), (qd,), has_aux=True)
        return x, xd, curvature, jac

    def _frame_leaves(self, target: Target, x: Float[Array, "4 3"], xd: Float[Array, "4 3"]) -> rmp.Rmp:
        """Leaves on the steered frame's origin and its three axes."""
        p, distance = self.config.rmp_params, None
        nodes = [rmp.Rmp(jnp.zeros((1, 3)), jnp.zeros((1, 3, 3))), rmp.Rmp(jnp.zeros((3, 3)), jnp.zeros((3, 3, 3)))]
        if target.position is not None:
            error, vel = target.position - x[0], xd[0] if target.velocity is None else xd[0] - target.velocity
            distance = rmp.norm(error)
            away = -error / distance
            rate = rmp.dot(away, vel)
            # Closer than a millimetre, the line to the target has no meaningful direction.
            bend = jnp.maximum(rmp.dot(vel, vel) - rate**2, 0.0) / jnp.maximum(distance, 1e-3)
            pull, drag = rmp.target_rmp(p.target_rmp, error, vel), rmp.along(away, bend, rmp.damping_rmp(p.damping_rmp, rate))
            nodes[0] = jax.tree.map(lambda a, b: (a + b)[None], pull, drag)
        if target.orientation is not None:
            errors = rotation_matrix(target.orientation).T - x[1:]
            pulls = jax.vmap(lambda e, v: rmp.axis_target_rmp(p.axis_target_rmp, e, v, distance))(errors, xd[1:])
            nodes[1] = pulls if target.weight is None else jax.tree.map(lambda x: target.weight * x, pulls)
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *nodes)

    def _sphere_leaves(self, obstacles: Obstacles, x: Float[Array, "n 3"], xd: Float[Array, "n 3"]) -> rmp.Rmp:
        """Leaves on the spheres' centres: all spheres with all obstacles, the controllers' spheres also with the base."""
        pt1 = jnp.concatenate([self._cylinders[:, 0], obstacles.pt1])
        pt2 = jnp.concatenate([self._cylinders[:, 1], obstacles.pt2])
        radius = jnp.concatenate([self._cylinder_radius, obstacles.radius])
        pairs = jax.vmap(jax.vmap(rmp.clearance, (None, None, 0, 0)), (0, 0, None, None))
        found = pairs(x, xd, pt1, pt2)
        if obstacles.center is not None:
            assert obstacles.quat is not None and obstacles.size is not None
            turn = jax.vmap(rotation_matrix)(obstacles.quat)
            boxes = jax.vmap(jax.vmap(rmp.box_clearance, (None, None, 0, 0, 0)), (0, 0, None, None, None))
            theirs = boxes(x, xd, obstacles.center, turn, obstacles.size)
            found = jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), found, theirs)
            radius = jnp.concatenate([radius, jnp.zeros(len(obstacles.center))])
        distance, direction, rate, curvature = found
        gap = distance - radius - self._radius[: len(x), None]
        meets = np.ones(gap.shape, np.float32)
        meets[self._controllers :, : len(self._cylinders)] = 0.0
        leaf = rmp.collision_rmp(self.config.rmp_params.collision_rmp, gap, rate)
        pushes = rmp.along(direction, curvature, rmp.Rmp(leaf.force * meets, leaf.metric * meets))
        return rmp.Rmp(pushes.force.sum(axis=1), pushes.metric.sum(axis=1))

    def _joint_leaves(self, q, qd) -> rmp.Rmp:
        """Leaves on the joints themselves; their metric is diagonal."""
        p = self.config.rmp_params
        leaves = [rmp.cspace_target_rmp(p.cspace_target_rmp, q, qd, self.default_q)]
        leaves.append(rmp.joint_velocity_cap_rmp(p.joint_velocity_cap_rmp, qd))
        per_range = jnp.asarray(self._per_range)
        for limit, jac in zip(self._limits, (per_range, -per_range), strict=True):
            leaf = rmp.joint_limit_rmp(p.joint_limit_rmp, jac * (q - limit), jac * qd)
            leaves.append(rmp.Rmp(jac * leaf.force, jac**2 * leaf.metric))
        return jax.tree.map(lambda *parts: sum(parts), *leaves)
