"""A robot's fingerprint, which tells apart robots with the same name."""

import hashlib

import numpy as np

from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg


def fingerprint(robot: RobotCfg) -> str:
    """A hash of the compiled model's tree, joints and masses, of the drives and of home.

    Numbers are rounded to four digits, so that the hash is the same with another compiler or processor.
    """
    model = scene.robot_model(robot)
    bodies = ("body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "site_pos")
    joints = ("jnt_type", "jnt_pos", "jnt_axis", "jnt_range", "dof_armature", "dof_damping", "dof_frictionloss")
    drives = [
        getattr(d, name) for d in (robot.arm, robot.gripper) for name in ("stiffness", "damping", "effort", "speed", "home")
    ]
    numbers = np.concatenate([np.ravel(getattr(model, name)) for name in bodies + joints] + [np.ravel(d) for d in drives])
    text = " ".join([*robot.joints, *(f"{x:.3e}" if abs(x) > 1e-9 else "0" for x in numbers.astype(float))])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
