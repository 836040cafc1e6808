"""A robot's drives and what they turn, as arrays along the drives."""

import math

import mujoco
import numpy as np

from mjx_nero.sim import linkage, scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg


def drives_model(robot: RobotCfg, sim: SimCfg) -> mujoco.MjModel:
    """The robot with its drives, without contacts. Where gains make it diverge, its state turns NaN instead of starting anew."""
    model = scene.build(robot, SceneCfg(objects={}), sim, visuals=False)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def driven(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Joints and degrees of freedom that the drives act on, [nu] each."""
    joints = model.actuator_trnid[:, 0]
    return joints, model.jnt_dofadr[joints]


def ranges(model: mujoco.MjModel) -> np.ndarray:
    """[njnt, 2]; half a turn to either side where there is no limit."""
    return np.where(model.jnt_limited[:, None].astype(bool), model.jnt_range, [-math.pi, math.pi])


def moves(model: mujoco.MjModel) -> np.ndarray:
    """[nv, nv] column c: how all joints move when joint c does and its followers follow, in a linkage at its zero."""
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
    """Puts the driven joints and the drives' targets at ``pose``, coupled joints where their leaders have them."""
    mujoco.mj_resetData(model, data)
    data.qpos[model.jnt_qposadr[driven(model)[0]]], data.ctrl[:] = pose, pose
    linkage.close(linkage.couplings(model), data.qpos)
    mujoco.mj_forward(model, data)
