"""Inverse kinematics: damped least squares from a warm start, then from random starts; pure JAX, one pose or thousands."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from mjx_nero import math
from mjx_nero.sim import scene
from mjx_nero.sim.kinematics import Chain
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import Key

_FAR = 1e3  # above any distance between two configurations
_MIN_DAMPING = 1e-6  # keeps the factors of a singular matrix real in float32


@dataclasses.dataclass(frozen=True)
class IkCfg:
    """Tolerances and budget.

    Attributes:
        position_tolerance: greatest position error [m]. A descent ends once both tolerances are met; tighten them for accuracy.
        orientation_tolerance: greatest angle between the frames [rad].
        orientation_weight: how many metres one radian of error counts as [m/rad].
        damping: damping of a step, as a share of the squared residual: large steps far away, quadratic convergence close by.
        max_distance: distance beyond which a target pulls no harder [m].
        iterations: greatest number of steps of one descent.
        restarts: rounds of descents from random starts, if the warm start fails. A round ends as soon as all poses are solved.
        starts: descents in a round, or the number of poses if that is larger. The unsolved poses share them evenly.
        candidates: random configurations per start; the one closest to the target is used.
        free_turn: ignores turns about the vertical: for arms with too few joints to choose them while the hand points down.
        spread: share of the joint ranges, about their centres, from which candidates are drawn. Starts near a limit often get
            stuck there.
    """

    position_tolerance: float = 1e-3
    orientation_tolerance: float = 1e-2
    orientation_weight: float = 0.3
    damping: float = 0.1
    max_distance: float = 1.0
    iterations: int = 12
    restarts: int = 8
    starts: int = 8
    candidates: int = 8
    spread: float = 0.8
    free_turn: bool = False


@struct.dataclass
class Solution:
    """The result for one pose. If ``success`` is False, ``q`` is the closest configuration found, still within the limits."""

    q: Float[Array, "*b nj"]  # [rad or m]
    success: Bool[Array, "*b"]  # both tolerances met
    position_error: Float[Array, "*b"]  # [m]
    orientation_error: Float[Array, "*b"]  # [rad]


@struct.dataclass
class _Poses:
    """Poses to reach. Quaternions are of unit length, warm starts within the limits."""

    pos: Float[Array, "b 3"]
    quat: Float[Array, "b 4"]
    q0: Float[Array, "b nj"]
    valid: Bool[Array, " b"]  # finite, as given
    weight: Float[Array, ""]  # of the orientation [m/rad]

    def of(self, which: Int[Array, " n"]) -> tuple[Array, Array]:
        """Returns positions and orientations of some of the poses."""
        return self.pos[which], self.quat[which]


class InverseKinematics:
    """Finds joint positions that bring a frame of a robot to a pose in the world. It ignores collisions.

    Levenberg-Marquardt steps with the geometric Jacobian, damped in proportion to the squared residual (Sugihara, "Solvability-
    unconcerned inverse kinematics by the Levenberg-Marquardt method", 2011) and projected onto the joint limits: a joint that
    a step would push through its limit stays there and the others do the work. Whole turns away from ``q0`` are undone where the
    limits allow it.

    The methods are pure; compile them with ``jax.jit``. A target that is not finite, or a zero quaternion, gives ``q0`` (within
    the limits), no success and infinite errors.

    Args:
        robot: robot whose arm moves.
        frame: site or body to place; None: the grasp point.
        cfg: tolerances and budget.
        point: the point of the frame, in its own axes [m], that has to be where the pose puts it. It matters only if the
            orientation cannot be met: a hand that leans then still has the object between its fingers.

    Attributes:
        chain: poses and Jacobians of ``frame`` as a function of the arm joints.

    Raises:
        KeyError: the robot has no such frame.
    """

    def __init__(
        self,
        robot: RobotCfg,
        frame: str | None = None,
        cfg: IkCfg = IkCfg(),
        point: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ):
        model = scene.robot_model(robot)
        self._point = np.array(point, np.float32) if any(point) else None
        self.cfg = cfg
        self.chain = Chain(model, robot.arm.joints, [frame or robot.ee_site])
        self._hinge = np.array([model.joint(j).type[0] == mujoco.mjtJoint.mjJNT_HINGE for j in robot.arm.joints])
        # Range of the candidates; a joint without limits gets one turn, or a metre each way.
        unlimited = np.where(self._hinge, np.pi, 1.0).astype(np.float32)
        lower = np.where(np.isfinite(self.chain.lower), self.chain.lower, -unlimited)
        upper = np.where(np.isfinite(self.chain.upper), self.chain.upper, unlimited)
        self._center, self._half = (lower + upper) / 2, cfg.spread * (upper - lower) / 2
        # A controller solves at several places in a step. This way, Python traces the solver once for all of them.
        self._solve = jax.jit(self._solved, static_argnums=4)

    def solve(self, pos: Float[Array, "3"], quat: Float[Array, "4"], q0: Float[Array, " nj"], key: Key) -> Solution:
        """Solves one pose, first from ``q0``, then from random starts. Of a round's solutions, the closest to ``q0`` counts.

        Args:
            pos: position of the frame in the world [m].
            quat: its orientation, wxyz.
            q0: warm start [rad or m].
            key: random key of the starts; equal arguments give equal results.
        """
        return jax.tree.map(lambda x: x[0], self.solve_batch(pos[None], quat[None], q0[None], key))

    def local(
        self, pos: Float[Array, "3"], quat: Float[Array, "4"], q0: Float[Array, " nj"], weight: float | Array | None = None
    ) -> Solution:
        """Solves one pose from ``q0`` alone: for control loops, where targets are near and a jump to another solution harms.

        Args:
            weight: orientation weight [m/rad]; None: the config's.
        """
        weight = self.cfg.orientation_weight if weight is None else weight
        return jax.tree.map(lambda x: x[0], self._solve(pos[None], quat[None], q0[None], jax.random.PRNGKey(0), 0, weight))

    def solve_batch(self, pos: Float[Array, "b 3"], quat: Float[Array, "b 4"], q0: Float[Array, "b nj"], key: Key) -> Solution:
        """``solve`` for many poses at once. Faster than ``vmap``: the starts go to the poses that are still unsolved."""
        return self._solve(pos, quat, q0, key, self.cfg.restarts, self.cfg.orientation_weight)

    def each(
        self, pos: Float[Array, "m 3"], quat: Float[Array, "m 4"], q0: Float[Array, "m nj"], weight: Array | None = None
    ) -> Solution:
        """Solves a few poses as ``local`` does, one after another. They share one solver, which compiles faster than several.

        Args:
            weight: orientation weights [m/rad], one per pose; None: the config's.
        """
        weight = jnp.full(len(pos), self.cfg.orientation_weight) if weight is None else weight
        return jax.lax.map(lambda one: self.local(*one), (pos, quat, q0, weight))

    def solve_path(self, pos: Float[Array, "m b 3"], quat: Float[Array, "m b 4"], q0: Float[Array, "b nj"], key: Key) -> Solution:
        """Solves b paths of m poses: the first poses as ``solve_batch`` does, each later one only from the one before.

        All steps of the paths share one solver.
        """
        restarts, weight = np.array([self.cfg.restarts] + [0] * (len(pos) - 1)), jnp.asarray(self.cfg.orientation_weight)

        def follow(q, pose):
            pos, quat, restarts = pose
            found = self._solved(pos, quat, q, key, restarts if self.cfg.restarts else 0, weight)
            return found.q, found

        return jax.lax.scan(follow, q0, (pos, quat, restarts))[1]

    def _solved(self, pos: Array, quat: Array, q0: Array, key: Key, restarts: int | Array, weight: Array) -> Solution:
        # On a GPU the default precision of products is too coarse for kinematics.
        with jax.default_matmul_precision("highest"):
            norm = jnp.linalg.norm(quat, axis=-1)
            valid = jnp.all(jnp.isfinite(pos), axis=-1) & jnp.isfinite(norm) & (norm > 0)
            pos = jnp.where(valid[:, None], pos, 0.0)
            quat = jnp.where(valid[:, None], quat / norm[:, None], jnp.array([1.0, 0.0, 0.0, 0.0]))
            q0 = self._within(jnp.where(jnp.isfinite(q0), q0, self._center))
            return self._search(_Poses(pos, quat, q0, valid, weight), key, restarts)

    def _search(self, poses: _Poses, key: Key, restarts: int | Array) -> Solution:
        b, valid = len(poses.pos), poses.valid
        nothing = Solution(poses.q0, jnp.zeros(b, bool), jnp.full(b, jnp.inf), jnp.full(b, jnp.inf))
        found = self._descents(poses.q0, jnp.arange(b), poses, ~valid, nothing)

        def unsolved(carry):
            restart, found = carry
            return (restart < restarts) & ~jnp.all(found.success | ~valid)

        def again(carry):
            restart, found = carry
            solved = found.success | ~valid
            left = jnp.argsort(solved)  # the unsolved poses come first
            target = left[jnp.arange(max(b, self.cfg.starts)) % jnp.maximum(jnp.sum(~solved), 1)]
            start = self._starts(jax.random.fold_in(key, restart), *poses.of(target))
            return restart + 1, self._descents(start, target, poses, solved, found)

        if not isinstance(restarts, int) or restarts:
            _, found = jax.lax.while_loop(unsolved, again, (_zero(poses.q0), found))
        return jax.tree.map(lambda x, none: jnp.where(valid.reshape(b, *[1] * (x.ndim - 1)), x, none), found, nothing)

    def _starts(self, key: Key, pos: Float[Array, "n 3"], quat: Float[Array, "n 4"]) -> Float[Array, "n nj"]:
        shape = (len(pos), self.cfg.candidates, len(self._center))
        q = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0) * self._half + self._center
        distance = jax.vmap(jax.vmap(self._distance, (0, None, None)))(q, pos, quat)
        return q[jnp.arange(len(pos)), jnp.argmin(distance, axis=1)]

    def _descents(
        self,
        start: Float[Array, "n nj"],
        target: Int[Array, " n"],  # the pose that each start is for
        poses: _Poses,
        solved: Bool[Array, " b"],
        found: Solution,
    ) -> Solution:
        """Runs all descents until every pose is solved or the budget is spent; keeps what is better than ``found``."""

        def going(carry):
            i, trial, _ = carry
            return (i <= self.cfg.iterations) & ~jnp.all(solved.at[target].max(trial.success))

        def step(carry):
            i, trial, q = carry
            trial, following = jax.vmap(self._step, (0, 0, 0, None))(q, *poses.of(target), poses.weight)
            return i + 1, trial, jnp.where(trial.success[:, None], q, following)

        n, q0 = len(target), poses.q0
        begin = _zero(start)
        far = jnp.full(n, jnp.inf) + begin
        _, trial, _ = jax.lax.while_loop(going, step, (begin, Solution(start, far < 0, far, far), start))
        # The same pose, with each joint as close to the warm start as whole turns bring it.
        q = trial.q - 2 * jnp.pi * self._hinge * jnp.round((trial.q - q0[target]) / (2 * jnp.pi))
        trial = dataclasses.replace(trial, q=jnp.where(q == self._within(q), q, trial.q))

        rating, before = self._rating(trial, q0[target]), self._rating(found, q0)
        best = before.at[target].min(rating)[target]
        at = jnp.where((rating == best) & (rating < before[target]), target, len(q0))  # beyond the end: dropped
        return jax.tree.map(lambda old, x: old.at[at].set(x, mode="drop"), found, trial)

    def _rating(self, found: Solution, q0: Float[Array, "n nj"]) -> Float[Array, " n"]:
        """Rates solutions, lower is better: successes by distance from the warm start, then failures by error."""
        error = found.position_error + self.cfg.orientation_weight * found.orientation_error
        return jnp.where(found.success, jnp.linalg.norm(found.q - q0, axis=1), _FAR + error)

    def _step(
        self, q: Float[Array, " nj"], pos: Float[Array, "3"], quat: Float[Array, "4"], weight: Array
    ) -> tuple[Solution, Float[Array, " nj"]]:
        """Returns the distance of ``q`` from the target, and the configuration after one step."""
        at, turn, jacobian = (x[0] for x in self.chain.jacobians(q))
        if self._point is not None:
            arm = math.rotate(turn, jnp.asarray(self._point))
            at, pos = at + arm, pos + math.rotate(quat, jnp.asarray(self._point))
            jacobian = jacobian.at[:3].add(jnp.cross(jacobian[3:], arm, axisa=0, axisc=0))
        linear, angular = _residual(at, turn, pos, quat)
        counts = jnp.array([1.0, 1.0, 0.0 if self.cfg.free_turn else 1.0])
        angular = angular * counts
        position, orientation = jnp.linalg.norm(linear), jnp.linalg.norm(angular)
        met = (position <= self.cfg.position_tolerance) & (orientation <= self.cfg.orientation_tolerance)
        error = jnp.concatenate(
            [linear * jnp.minimum(1.0, self.cfg.max_distance / jnp.maximum(position, 1e-6)), weight * angular]
        )
        jacobian = jacobian * jnp.concatenate([jnp.ones(3), weight * counts])[:, None]
        uphill = error @ jacobian
        held = ((q <= self.chain.lower) & (uphill < 0)) | ((q >= self.chain.upper) & (uphill > 0))
        jacobian = jnp.where(held, 0.0, jacobian)
        normal = jacobian @ jacobian.T + (self.cfg.damping * (error @ error) + _MIN_DAMPING) * jnp.eye(6)
        return Solution(q, met, position, orientation), self._within(q + math.solve_spd(normal, error) @ jacobian)

    def _distance(self, q: Float[Array, " nj"], pos: Float[Array, "3"], quat: Float[Array, "4"]) -> Float[Array, ""]:
        at, turn = (x[0] for x in self.chain.poses(q))
        if self._point is not None:
            at, pos = (place + math.rotate(by, jnp.asarray(self._point)) for place, by in ((at, turn), (pos, quat)))
        linear, angular = _residual(at, turn, pos, quat)
        return jnp.linalg.norm(linear) + self.cfg.orientation_weight * jnp.linalg.norm(angular)

    def _within(self, q: Float[Array, "*n nj"]) -> Float[Array, "*n nj"]:
        return jnp.clip(q, self.chain.lower, self.chain.upper)


def _zero(x: Array) -> Int[Array, ""]:
    """0, batched wherever ``x`` is. Of a loop, ``jax.vmap`` traces the body again for all that becomes batched only there."""
    return jnp.where(jnp.isnan(x).any(), 0, 0)


def _residual(
    at: Float[Array, "3"], turn: Float[Array, "4"], pos: Float[Array, "3"], quat: Float[Array, "4"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Error from a pose to its target, in the world frame: distance vector [m] and rotation vector [rad]."""
    return pos - at, math.quat_log(math.quat_mul(quat, math.quat_conj(turn)))
