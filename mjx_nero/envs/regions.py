"""Regions where a robot can pick things up and hold them. Tasks for any robot are built from them."""

import dataclasses

import mujoco
import numpy as np

from mjx_nero.config.bounds import Range
from mjx_nero.sim import grasp, quats
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import Box, RobotCfg
from mjx_nero.sim.scene import SceneCfg
from mjx_nero.types import UserError

HELD = 0.03  # [m] greatest offset of a held cube from its place in a good grasp
TURNS = 5  # fewest joints of an arm that can turn its hand freely while the hand points down
TRAVEL = 0.1  # [m] height of a carried cube above the table, if the hand can still point down there
UPRIGHT = 0.005  # [m/rad] weight that keeps a leaning hand as upright as its position allows
LEFT = 0.06  # [m] least height of a leaving grasp point above the middle of a cube on the table


def box(robot: RobotCfg, name: str, what: str) -> Box:
    """Returns one of the robot's boxes [m], in its root frame.

    Raises:
        UserError: the robot's config lacks it.
    """
    found: Box | None = getattr(robot, name)
    if found is None:
        where = "its robot.yaml" if robot.folder else "its config"
        raise UserError(f"{robot.name} has no {name}, {what}: give it in {where} as ranges of x, y and z [m], or import it again")
    return found


@dataclasses.dataclass(frozen=True)
class Regions:
    """The regions where a robot can grasp a cube and where it can hold it.

    Attributes:
        cube: ``x`` and ``y`` of the cube on the table, in the world frame [m].
        place: the same region in the robot's root frame [m].
        hold: ``RobotCfg.hold``.
        travel: height at which the grasp point carries a cube across the table, in the robot's root frame [m].
        offset: grasp point minus the cube's centre in a grasp, in the world frame [m].
    """

    cube: tuple[Range, Range]
    place: tuple[Range, Range]
    hold: Box
    travel: float
    offset: tuple[float, float, float]


def of(robot: RobotCfg) -> Regions:
    """Derives the regions from the robot's ``pick``, ``hold`` and ``grip``.

    Raises:
        UserError: the robot has no gripper, or lacks one of these fields.
    """
    rest = grasp.cube_for(robot).rest_height
    pick = box(robot, "pick", "where on the table it can grasp")
    hold = box(robot, "hold", "where it can hold what it has grasped")
    turned = quats.rotated(robot.grip, robot.down)
    x, y = (span(low + by, high + by) for (low, high), by in zip(pick[:2], turned[:2], strict=True))
    dx, dy, dz = robot.base_pos
    return Regions(
        cube=(span(x[0] + dx, x[1] + dx), span(y[0] + dy, y[1] + dy)),
        place=(x, y),
        hold=hold,
        travel=round(max(min(pick[2][1], pick[2][0] + TRAVEL), rest - dz + LEFT), 4),
        offset=(*span(-turned[0], -turned[1]), round(pick[2][0] + dz - rest, 4)),
    )


def turns(robot: RobotCfg) -> bool:
    """True if the arm can turn its hand freely while the hand points down."""
    return robot.turns and len(robot.arm.joints) >= TURNS


def ik(robot: RobotCfg, prefix: str = "") -> dict[str, bool | float]:
    """Returns inverse-kinematics settings for an arm with few joints, or for a hand that cannot point straight down."""
    few = {} if turns(robot) else {"free_turn": True}
    leaning = {"orientation_weight": UPRIGHT} if robot.lean else {}
    return {f"{prefix}{name}": value for name, value in {**few, **leaning}.items()}


def span(low: float, high: float) -> Range:
    """Rounds a range to tenths of a millimetre, without negative zeros."""
    return round(float(low), 4) + 0.0, round(float(high), 4) + 0.0


def scene(robot: RobotCfg, goal: str) -> SceneCfg:
    """Builds a scene with a table in the robot's workspace and the cube it can lift; ``goal`` is the marker's shape."""
    cube = grasp.cube_for(robot)
    return scenes.around(robot, SceneCfg(objects={"cube": cube}, goal=goal, goal_edge=cube.size[0]))


def near(there: Regions) -> float:
    """Greatest distance of a held cube from the grasp point [m]."""
    return round(max(0.04, float(np.linalg.norm(there.offset)) + HELD), 4)


def turn_to(robot: RobotCfg, x: float, y: float) -> float:
    """Angle from home of the first joint that points the arm at ``x, y`` in the robot's root frame [rad].

    0 if that joint does not turn the arm about the vertical.
    """
    model, data = scenes.at_home(robot)
    first = model.joint(robot.arm.joints[0])
    axis, about = data.xaxis[first.id], data.xanchor[first.id]
    if first.type[0] != mujoco.mjtJoint.mjJNT_HINGE or abs(axis[2]) < 0.99:
        return 0.0
    now = (data.site(robot.ee_site).xpos - about)[:2]
    to = np.array([x, y]) + robot.base_pos[:2] - about[:2]
    turn = np.arctan2(now[0] * to[1] - now[1] * to[0], now @ to) * np.sign(axis[2])
    if first.limited[0]:
        turn = np.clip(robot.home[0] + turn, *first.range) - robot.home[0]
    return round(float(turn), 4)
