"""A cloud of the robot's random poses, and inverse kinematics that starts from them."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_nero.urdf import primitives
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.tree import Body, Points, Pose, Poses, Values, Vec, body_of
from mjx_nero.urdf.tree import poses as body_poses

SAMPLES = 20_000
ITERATIONS = 40  # greatest number of steps of a descent
MISS, TILT = 2e-3, 0.03  # [m, rad] tolerances of a descent
DOWN = np.array([0.0, 0.0, -1.0])


class Cloud:
    """The mounted robot in ``SAMPLES`` random poses, and its inverse kinematics.

    Inverse kinematics is damped least squares in NumPy, thousands of goals at once. The JAX version in ``control`` would take
    longer to compile than a whole import may take.

    Attributes:
        q: driven joint -> positions [n]: first a guess of the home pose, then random ones, with an open gripper.
        poses: body -> poses [n, 4, 4] in the unturned frame (without the mount's position).
        height: of that frame above the table [m].
        arm: names of the arm's joints, with the limits ``lower`` and ``upper`` [k].
    """

    def __init__(self, parts: dict[str, Body], hand: Hand, mount: Pose, home: Mapping[str, float]):
        rng = np.random.default_rng(0)
        self.q: dict[str, Values] = {}
        bounds: dict[str, tuple[float, float]] = {}
        for joint in (b.joint for b in parts.values() if b.joint and not b.joint.mimic):
            lower, upper = (-np.pi, np.pi) if joint.type == "continuous" else (joint.lower, joint.upper)
            drawn = rng.uniform(lower, upper, SAMPLES)
            if joint.name in hand.joints:
                drawn[:] = hand.open[hand.joints.index(joint.name)]
            else:
                bounds[joint.name] = lower, upper
            drawn[0] = home[joint.name]
            self.q[joint.name] = drawn
        self.arm = list(bounds)
        self.lower, self.upper = np.array([bounds[j] for j in self.arm]).T
        self.endless = np.array([b.joint.type == "continuous" for b in parts.values() if b.joint and b.joint.name in bounds])
        self._parts, self._hand, self._turn = parts, hand, mount.copy()
        self.height, self._turn[:3, 3] = float(mount[2, 3]), 0.0
        self.poses = {name: self._turn @ p for name, p in body_poses(parts, self.q, SAMPLES).items()}
        self.site = self.sites(self.poses)

    @property
    def shoulder(self) -> Vec:
        """Position of the first turning joint."""
        turning = [b for b in self._parts.values() if b.joint and b.joint.name in self.arm and b.joint.type != "prismatic"]
        return self.poses[turning[0].name][0, :3, 3] if turning else np.zeros(3)

    @property
    def reach(self) -> float:
        """Distance of the grasp point from the shoulder that all but the farthest hundredth of the poses keep [m]."""
        return float(np.quantile(np.linalg.norm(self.site[1:, :3, 3] - self.shoulder, axis=1), 0.99))

    def at(self, q: Float[np.ndarray, "n k"]) -> dict[str, Poses]:
        """Poses [n, 4, 4] of the bodies with the arm's joints at ``q`` and an open gripper."""
        driven = {j: np.full(len(q), self.q[j][1]) for j in self._hand.joints} | dict(zip(self.arm, q.T, strict=True))
        return {name: self._turn @ p for name, p in body_poses(self._parts, driven, len(q)).items()}

    def grasp_point(self, q: Mapping[str, float]) -> Pose:
        """Pose of the grasp point [4, 4] with the arm's joints at ``q`` and an open gripper."""
        return self.sites(self.at(np.array([[q[j] for j in self.arm]])))[0]

    def sites(self, poses: Mapping[str, Poses]) -> Poses:
        """Poses of the grasp point [n, 4, 4], given the bodies' poses."""
        body = body_of(self._parts, self._hand.link)
        return poses[body.name] @ body.links[self._hand.link] @ self._hand.site

    def jacobian(self, poses: Mapping[str, Poses]) -> Float[np.ndarray, "n 6 k"]:
        """Jacobian of the grasp point over the arm's joints, including joints that follow them by mimic."""
        site, body = self.sites(poses)[:, :3, 3], body_of(self._parts, self._hand.link)
        out = np.zeros((len(site), 6, len(self.arm)))
        while body.joint is not None:
            joint, pose = body.joint, poses[body.name]
            source, factor, _ = joint.mimic or (joint.name, 1.0, 0.0)
            if source in self.arm:
                axis, k = factor * pose[:, :3, :3] @ joint.axis, self.arm.index(source)
                if joint.type == "prismatic":
                    out[:, :3, k] += axis
                else:
                    out[:, :3, k] += _cross(axis, site - pose[:, :3, 3])
                    out[:, 3:, k] += axis
            body = self._parts[body.parent]
        return out

    def solve(
        self,
        goals: Points,
        down: bool,
        starts: int,
        hold: Mapping[str, float] | None = None,
        calm: float = 0.0,
        one: bool = False,
        tilt: float = 0.0,
        along: Vec | None = None,
        shun: Bool[np.ndarray, " samples"] | None = None,
    ) -> Float[np.ndarray, "g s k"]:
        """Finds positions that bring the grasp point to each goal [g, 3], pointing down if asked; NaN where a descent fails.

        Each goal gets ``starts`` descents, from the random poses nearest to it.

        Args:
            hold: joint -> position to keep.
            calm: distance that a radian away from the guessed home pose counts as, when choosing starts [m/rad].
            one: stop at the first descent that reaches a goal.
            tilt: greatest angle from pointing down [rad].
            along: direction in the grasp point's frame that must lie along y.
            shun: poses that no descent should start from.
        """
        lower, upper = self.lower.copy(), self.upper.copy()
        for name, value in (hold or {}).items():
            if name in self.arm:
                lower[self.arm.index(name)] = upper[self.arm.index(name)] = value
        at, far = self.site[1:, :3, 3], 0.2 * self._tilt(self.site[1:]) if down else np.zeros(len(self.site) - 1)
        if calm:
            far = far + calm * np.mean([np.abs(self.q[j][1:] - self.q[j][0]) for j in self.arm], axis=0)
        if along is not None:
            far = far + 0.1 * (1 - self.site[1:, 1, :3] @ along)
        if shun is not None:
            far = far + shun[1:]
        x, y, z = np.ascontiguousarray(at.T)
        nearest = [1 + _smallest(np.sqrt((x - g[0]) ** 2 + (y - g[1]) ** 2 + (z - g[2]) ** 2) + far, starts) for g in goals]
        q = np.array([[self.q[j][i] for j in self.arm] for i in np.concatenate(nearest)])
        q = np.clip(q, lower, upper)
        found, left = np.full_like(q, np.nan), np.arange(len(q))
        wanted = np.repeat(goals, starts, axis=0)
        for _ in range(ITERATIONS):
            poses = self.at(q[left])
            error, jacobian = self._error(poses, wanted[left], down, tilt, along)
            met = np.linalg.norm(error[:, :3], axis=1) < MISS
            met &= np.linalg.norm(error[:, 3:], axis=1) < TILT
            found[left[met]] = q[left[met]]
            if one:
                met = np.isin(left // starts, left[met] // starts)
            left, error, jacobian = left[~met], error[~met], jacobian[~met]
            if not len(left):
                break
            q[left] = np.clip(q[left] + _move(error, jacobian), lower, upper)
        return found.reshape(len(goals), starts, -1)

    def followed(
        self, q: Float[np.ndarray, "n k"], goals: Points, steps: int, tilt: float, along: Vec | None
    ) -> Float[np.ndarray, "n k"]:
        """Moves ``q`` a few steps towards goals [n, 3] with the hand pointing down; ``tilt`` and ``along`` as in ``solve``."""
        for _ in range(steps):
            q = np.clip(q + _move(*self._error(self.at(q), goals, True, tilt, along)), self.lower, self.upper)
        return q

    def _error(
        self, poses: Mapping[str, Poses], wanted: Points, down: bool, tilt: float, along: Vec | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Computes the error to the goals [n, 3 or 6] and its Jacobian.

        Without ``along``, turns about the approach do not count.
        """
        sites, jacobian = self.sites(poses), self.jacobian(poses)
        away = wanted - sites[:, :3, 3]
        if not down:
            return away, jacobian[:, :3]
        approach = sites[:, :3, :3] @ self._hand.approach
        turn = _cross(approach, DOWN)
        sine = np.linalg.norm(turn, axis=1, keepdims=True)
        angle = np.arctan2(sine, approach @ DOWN[:, None])
        turn = turn / np.maximum(sine, 1e-9) * np.maximum(angle - tilt, 0.0)
        counts = np.eye(3) - approach[:, :, None] * approach[:, None, :] * (along is None)
        if along is not None:
            opening = sites[:, :3, :3] @ along
            turn[:, 2] += np.arctan2(opening[:, 0], opening[:, 1])
        counts = counts * (angle >= tilt)[:, :, None]
        return np.hstack([away, turn]), np.concatenate([jacobian[:, :3], counts @ jacobian[:, 3:]], axis=1)

    def _tilt(self, sites: Poses) -> Values:
        """Tilt of the hand from pointing down [n], from 0 to 2."""
        return 1 - (sites[:, :3, :3] @ self._hand.approach) @ DOWN

    def lowest(self, link: str, shape: primitives.Primitive, poses: Mapping[str, Poses] | None = None) -> Values:
        """Height [n] of the shape's lowest point above the table, in the given poses or else in the random ones."""
        body = body_of(self._parts, link)
        return shape.lowest((self.poses if poses is None else poses)[body.name][:, 2] @ body.links[link]) + self.height


def _move(error: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """Computes a damped step of the joints [n, k]."""
    transposed = np.moveaxis(jacobian, 1, 2)
    square = jacobian @ transposed + 1e-4 * np.eye(jacobian.shape[1])
    return np.clip((transposed @ np.linalg.solve(square, error[:, :, None]))[:, :, 0], -0.3, 0.3)


def _cross(a: Points, b: Points | Vec) -> Points:
    """Cross products [n, 3]. NumPy's own function takes several times as long for as few as these."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _smallest(values: Values, count: int) -> Int[np.ndarray, " count"]:
    """Indices of the ``count`` smallest values, in ascending order."""
    some = np.argpartition(values, count)[:count]
    return some[np.argsort(values[some])]
