"""A robot's drives and the joints that they move, as arrays along the drives."""

import math

import mujoco
import numpy as np

from mjx_nero.sim import linkage, scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg


def drives_model(robot: RobotCfg, sim: SimCfg) -> mujoco.MjModel:
    """Builds the robot with its drives, without contacts. If gains make it diverge, its state becomes NaN and is not reset."""
    model = scene.build(robot, SceneCfg(objects={}), sim, visuals=False)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def driven(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Returns the joints and degrees of freedom that the drives act on, [nu] each."""
    joints = model.actuator_trnid[:, 0]
    return joints, model.jnt_dofadr[joints]


def ranges(model: mujoco.MjModel) -> np.ndarray:
    """Returns the joint ranges [njnt, 2]; half a turn to either side for joints without limits."""
    return np.where(model.jnt_limited[:, None].astype(bool), model.jnt_range, [-math.pi, math.pi])


def moves(model: mujoco.MjModel) -> np.ndarray:
    """Returns a matrix [nv, nv], whose column c says how all joints move with joint c and its followers, at a linkage's zero."""
    out, dof = np.eye(model.nv), dict(zip(model.jnt_qposadr, model.jnt_dofadr, strict=True))
    for coupling in linkage.couplings(model):
        if coupling.leader != coupling.follower:
            out[dof[coupling.follower]] = (*coupling.coefficients, 0.0)[1] * out[dof[coupling.leader]]
    return out


def leaders(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Finds for each drive the degree of freedom that moves its joint, itself or its leader, and the ratio; [nu] each."""
    rows = moves(model)[driven(model)[1]]
    leader = np.abs(rows).argmax(axis=1)
    return leader, np.take_along_axis(rows, leader[:, None], axis=1)[:, 0]


def pose_model(model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray) -> None:
    """Sets driven joints and drive targets to ``pose``, and coupled joints to match their leaders."""
    mujoco.mj_resetData(model, data)
    data.qpos[model.jnt_qposadr[driven(model)[0]]], data.ctrl[:] = pose, pose
    linkage.close(linkage.couplings(model), data.qpos)
    mujoco.mj_forward(model, data)
