"""The cube that a gripper can lift, and the height above the table at which it grasps the cube."""

import dataclasses
import itertools
from collections.abc import Callable

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero.sim import linkage
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, cube, robot_model
from mjx_nero.types import UserError

SHARE, MOST = 0.4, 0.6  # of the opening: a cube's edge, and the longest edge that leaves room to miss the middle
LARGEST = 0.06  # [m]
STROKE = 5e-3  # [m] least stroke of pads that open
GRIPPED = 0.01  # [m] a cube is this much larger than the closed gripper's gap
CLEAR = 0.005  # [m] clearance of the pads above the table
BESIDE = 0.004  # [m] clearance of the pads beside an object as they come down
CLOSING, QUICK = 0.4, 0.3  # [s] least closing times of a script's fingers
DENSITY = 1000.0  # [kg/m3] 30 g at an edge of 31 mm
Pad = tuple[float, float, float]


def edge(opening: float, pad: Pad, closed: float = 0.0) -> float:
    """Edge of a cube that the gripper can lift [m]: ``SHARE`` of its opening, or more if long pads would touch the table first.

    It is larger than the gap of the closed gripper, by ``GRIPPED`` or a quarter of the stroke; 0 if no cube fits.

    Args:
        opening, closed: distance between the pads when open and when closed [m].
        pad: size of a pad along the approach, across, and along the opening [m].
    """
    wanted = min(max(SHARE * opening, pad[0] + 2 * CLEAR), MOST * opening, LARGEST)
    least = closed + min(GRIPPED, (opening - closed) / 4)
    if opening - closed < STROKE or wanted < least > opening - 2 * CLEAR:
        return 0.0
    return round(max(wanted, least), 3)


def height(opening: float, pad: Pad, closed: float = 0.0) -> float:
    """Height of the pads' middle above the table when they grasp that cube [m].

    It is the height of the cube's middle, or more to keep ``CLEAR``.
    """
    return max(edge(opening, pad, closed) / 2, lowest(pad))


def lowest(pad: Pad) -> float:
    """Least height of the pads' middle above the table, so that they keep ``CLEAR`` of it [m]."""
    return pad[0] / 2 + CLEAR


def beyond(robot: RobotCfg, gap: float) -> float:
    """Distance of the pads' middle beyond the place of a gripped cube along the approach, when they are ``gap`` apart [m].

    0 if long pads reach back over that place. A round object must be between the pads' middles, or it rolls over an edge.
    """
    hand = _Hand(robot)
    hand.move(hand.share(gap))
    site = hand.data.site(robot.ee_site)
    approach = _in_hand(robot, (0.0, 0.0, -1.0))
    centres = [hand.data.geom(i).xpos for i in hand.pads]
    off = (np.mean(centres, axis=0) - site.xpos) @ site.xmat.reshape(3, 3) - robot.grip if centres else np.zeros(3)
    return round(max(0.0, float(off @ approach)), 4)


def opening(robot: RobotCfg) -> np.ndarray:
    """The direction in which the fingers open, in the frame of ``ee_site``."""
    return _in_hand(robot, (0.0, 1.0, 0.0))


def _in_hand(robot: RobotCfg, way: tuple[float, float, float]) -> np.ndarray:
    """A direction in the world, in the frame of a hand that points down: ``math.rotate`` without JAX, which is slow to start."""
    w, x, y, z = np.array(robot.down, np.float32) * np.array([1, -1, -1, -1], np.float32)
    vx, vy, vz = np.array(way, np.float32)
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return np.array([vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx], np.float32)


def aside(robot: RobotCfg, gap: float) -> float:
    """Returns the offset of the pads' middle along the opening, from its place around the robot's cube [m].

    It is 0 if both sides move alike, and without a gripper or a known opening. If one side stands still, its pad comes down as
    near to a small object as to the cube.

    Args:
        gap: distance between the pads [m].
    """
    if not (robot.gripper.joints and robot.opening):
        return 0.0
    hand, cube = _Hand(robot), cube_for(robot).size[0] + 2 * BESIDE
    return round(hand.middle(hand.share(gap)) - hand.middle(hand.share(cube)), 3) + 0.0


def formulas(robot: RobotCfg) -> tuple[Callable, Callable] | None:
    """Returns ``gap`` and ``positions`` of the gripper, or equivalents computed from the pads as the fingers move together.

    None without a gripper, two pads, or moving fingers.
    """
    fingers = robot.gripper
    if not fingers.joints:
        return None
    if fingers.gap is not None and fingers.positions is not None:
        return fingers.gap, fingers.positions
    hand = _Hand(robot)
    close, way = hand.positions(0.0), hand.positions(1.0) - hand.positions(0.0)
    if len(hand.pads) < 2 or not way.any():
        return None
    shares = np.linspace(*hand.ends(), 65)
    apart = np.maximum.accumulate([max(0.0, hand.apart(share)) for share in shares])
    moving = np.flatnonzero(way)

    def gap(q):
        return jnp.interp(jnp.mean((jnp.asarray(q) - close)[moving] / way[moving]), shares, apart)

    def positions(gap):
        return jnp.asarray(close) + jnp.interp(gap, apart, shares) * way

    return gap, positions


def opened(robot: RobotCfg, gap: float) -> RobotCfg:
    """Returns the robot with a hand that opens no further than ``gap`` between its pads [m], and starts there.

    The robot is unchanged if it opens less, or does not have two pads.
    """
    fingers = robot.gripper
    if fingers.gap is not None and fingers.positions is not None:
        if float(fingers.gap(jnp.array(fingers.open))) <= gap:
            return robot
        positions = fingers.positions(jnp.array(gap))
    elif (share := (hand := _Hand(robot)).share(gap)) < 1:
        positions = hand.positions(share)
    else:
        return robot
    open = tuple(round(float(q), 5) for q in positions)
    return dataclasses.replace(robot, gripper=dataclasses.replace(fingers, open=open, home=open))


def shut(robot: RobotCfg, gap: float) -> RobotCfg:
    """Returns the robot with a hand that holds objects ``gap`` wide [m]. If needed, it closes as far as its joints go.

    Raises:
        UserError: the pads are still too far apart.
    """
    hand, fingers = _Hand(robot), robot.gripper
    if hand.apart(0.0) <= gap:
        return robot
    share = hand.ends()[0]
    if (least := hand.apart(share)) > gap:
        raise UserError(
            f"the hand of {robot.name} closes to {least:.3g} m between its pads: too wide to hold an object {gap:.3g} m wide"
        )
    return dataclasses.replace(
        robot, gripper=dataclasses.replace(fingers, close=tuple(round(float(q), 5) for q in hand.positions(share)))
    )


def closing_time(robot: RobotCfg, gap: float) -> float:
    """Time that the fingers take from open until their pads are ``gap`` apart [s]."""
    hand = _Hand(robot)
    way = np.abs(hand.positions(hand.share(gap)) - hand.positions(1.0))
    return float(np.max(way / np.array(robot.gripper.speed), initial=0.0))


def closing(robot: RobotCfg, gap: float, least: float = CLOSING) -> float:
    """Time that a script gives the fingers to close to ``gap`` [m]: as long as they take, but at least ``least`` [s]."""
    return round(max(least, closing_time(robot, gap)), 3)


def pads(model: mujoco.MjModel | mujoco.MjSpec) -> list[str]:
    """Lists the names of the shapes that grip."""
    geoms = model.geoms if isinstance(model, mujoco.MjSpec) else map(model.geom, range(model.ngeom))
    return [geom.name for geom in geoms if "pad" in geom.name]


class _Hand:
    """A robot's fingers, moved from closed (0) to open (1), or beyond.

    Attributes:
        pads: ids of the geoms that grip.
    """

    def __init__(self, robot: RobotCfg):
        self._robot, model = robot.gripper, robot_model(robot)
        self._couplings, self.data = linkage.couplings(model), mujoco.MjData(model)
        self.model, self.pads = model, [model.geom(name).id for name in pads(model)]
        self._site, self._opening = robot.ee_site, opening(robot)
        self._sides = self._side() if len(self.pads) > 2 else {i: k > 0 for k, i in enumerate(self.pads)}

    def positions(self, share: float) -> np.ndarray:
        """Positions of the gripper's joints at a share of the way from closed to open."""
        close, open = np.array(self._robot.close), np.array(self._robot.open)
        return close + share * (open - close)

    def move(self, share: float) -> None:
        """Places all shapes in ``data``."""
        for joint, at in zip(self._robot.joints, self.positions(share), strict=True):
            self.data.joint(joint).qpos = at
        linkage.close(self._couplings, self.data.qpos)
        mujoco.mj_kinematics(self.model, self.data)

    def ends(self) -> tuple[float, float]:
        """The shares at which the first joint reaches a limit, closing and opening; 0 and 1 if a joint has none."""
        close, way = self.positions(0.0), self.positions(1.0) - self.positions(0.0)
        joints = [self.model.joint(name).id for name in self._robot.joints]
        moving = way != 0
        if not moving.any() or not self.model.jnt_limited[joints].all():
            return 0.0, 1.0
        ends = np.sort((self.model.jnt_range[joints].T - close)[:, moving] / way[moving], axis=0)
        return float(ends[0].max()), float(ends[1].min())

    def share(self, gap: float) -> float:
        """Share at which two pads are ``gap`` apart [m]; 1 if they never are."""
        low, high = 0.0, 1.0
        while high - low > 1e-5 and self.apart(1.0) > gap:
            middle = (low + high) / 2
            low, high = (low, middle) if self.apart(middle) > gap else (middle, high)
        return high

    def apart(self, share: float) -> float:
        """Least distance between two pads on different sides of the opening [m]; if all are on one side, on different bodies."""
        self.move(share)
        bodies, far, ends = self.model.geom_bodyid, 1.0, np.zeros(6)
        pairs = [(a, b) for a, b in itertools.combinations(self.pads, 2) if bodies[a] != bodies[b]]
        opposed = [(a, b) for a, b in pairs if self._sides[a] != self._sides[b]]
        return min((mujoco.mj_geomDistance(self.model, self.data, a, b, far, ends) for a, b in opposed or pairs), default=0.0)

    def middle(self, share: float) -> float:
        """Place of the pads' middle along the opening, from the grasp point [m]."""
        along = self._along(share)
        sides = [[at for i, at in along.items() if self._sides[i] == side] for side in (False, True)]
        return float(np.mean([np.mean(side) for side in sides if side])) if along else 0.0

    def _along(self, share: float) -> dict[int, float]:
        """Place of each pad along the opening, from the grasp point [m]."""
        self.move(share)
        sites = [self.model.site(i).name for i in range(self.model.nsite)]
        frame = self.data.site(self._site) if self._site in sites else self.data.body(self._site)
        direction = frame.xmat.reshape(3, 3) @ self._opening
        return {i: float((self.data.geom(i).xpos - frame.xpos) @ direction) for i in self.pads}

    def _side(self) -> dict[int, bool]:
        """Finds the side of the opening on which each pad is when the hand is open."""
        along = self._along(1.0)
        middle = (min(along.values(), default=0.0) + max(along.values(), default=0.0)) / 2
        return {i: at > middle for i, at in along.items()}


def cube_for(robot: RobotCfg) -> ObjectCfg:
    """The cube that a robot can lift.

    Raises:
        UserError: the robot has no gripper, its opening is unknown, or no cube fits.
    """
    where = "its robot.yaml" if robot.folder else "its config"
    if not robot.gripper.joints:
        raise UserError(f"{robot.name} has no gripper: this task needs one, but reach does not")
    if robot.opening <= 0:
        raise UserError(f"how far the gripper of {robot.name} opens is unknown: give opening, between its pads [m], in {where}")
    size = edge(robot.opening, robot.pad, robot.closed)
    if not size:
        gaps = f"closes to {robot.closed:g} m and opens to {robot.opening:g} m between its pads"
        raise UserError(f"the gripper of {robot.name} {gaps}: no cube fits; correct closed and opening in {where}")
    return cube(size, mass=float(f"{DENSITY * size**3:.3g}"))
