"""The cube that a gripper can lift, and how high above the table it grasps it."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero import math
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, cube, robot_model
from mjx_nero.types import UserError

SHARE, MOST = 0.4, 0.6  # of the opening: an edge, and the longest that leaves room to miss the middle
LARGEST = 0.06  # [m]
CLEAR = 0.005  # [m] the pads stay this far above the table
DENSITY = 1000.0  # [kg/m3] 30 g at an edge of 31 mm
Pad = tuple[float, float, float]


def edge(opening: float, pad: Pad) -> float:
    """Of a cube that the gripper can lift [m]: ``SHARE`` of its opening, or more where long pads would touch the table before.

    Args:
        opening: between the pads when open [m].
        pad: its size along the approach, across, and along the opening [m].
    """
    return round(min(max(SHARE * opening, pad[0] + 2 * CLEAR), MOST * opening, LARGEST), 3)


def height(opening: float, pad: Pad) -> float:
    """Of the pads' middle above the table when they grasp that cube [m]: its own middle, or higher for the sake of ``CLEAR``."""
    return max(edge(opening, pad) / 2, lowest(pad))


def lowest(pad: Pad) -> float:
    """Of the pads' middle above the table, so that they keep ``CLEAR`` of it [m]."""
    return pad[0] / 2 + CLEAR


def beyond(robot: RobotCfg) -> float:
    """How far beyond the grasp point, along the approach, the middle of the closed pads lies [m]; 0 where long ones reach back
    over it. An object that is round has to be between their middles: over an edge it would roll."""
    model = robot_model(robot)
    data = mujoco.MjData(model)
    for joint, at in zip(robot.gripper.joints, robot.gripper.close, strict=True):
        data.joint(joint).qpos = at
    mujoco.mj_kinematics(model, data)
    site = data.site(robot.ee_site)
    approach = math.rotate(math.quat_conj(jnp.array(robot.down)), jnp.array([0.0, 0.0, -1.0]))
    pads = [data.geom(i).xpos for i in range(model.ngeom) if "pad" in model.geom(i).name]
    off = (np.mean(pads, axis=0) - site.xpos) @ site.xmat.reshape(3, 3) if pads else np.zeros(3)
    return round(max(0.0, float(off @ approach)), 4)


def opened(robot: RobotCfg, gap: float) -> RobotCfg:
    """The robot with a hand that opens no further than to ``gap`` between its pads [m], and begins so; as it is where nobody has
    said which positions that takes, or where it opens less."""
    hand = robot.gripper
    if hand.gap is None or hand.positions is None or float(hand.gap(jnp.array(hand.open))) <= gap:
        return robot
    open = tuple(round(float(q), 5) for q in hand.positions(jnp.array(gap)))
    return dataclasses.replace(robot, gripper=dataclasses.replace(hand, open=open, home=open))


def cube_for(robot: RobotCfg) -> ObjectCfg:
    """The cube that a robot can lift.

    Raises:
        UserError: it has no gripper, or nobody said how far that opens.
    """
    where = "its robot.yaml" if robot.folder else "its config"
    if not robot.gripper.joints:
        raise UserError(f"{robot.name} has no gripper: this task needs one; reach does without")
    if robot.opening <= 0:
        raise UserError(f"how far the gripper of {robot.name} opens is unknown: give opening, between its pads [m], in {where}")
    size = edge(robot.opening, robot.pad)
    return cube(size, mass=float(f"{DENSITY * size**3:.3g}"))
