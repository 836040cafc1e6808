"""Describes a robot's tree and collision shapes as plain values, for the numpy kinematics on a robot's computer
(``deploy.body``)."""

from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim import linkage, quats, scene, touch
from mjx_nero.sim.robot import RobotCfg

_KINDS = {int(mujoco.mjtJoint.mjJNT_HINGE): "hinge", int(mujoco.mjtJoint.mjJNT_SLIDE): "slide"}
_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}


def robot(cfg: RobotCfg) -> dict[str, Any]:
    """Describes a robot's joints with drives and limits, its base and its body; docs/guides/deploy_onnx.md lists the fields."""
    model, drives = scene.robot_model(cfg), (cfg.arm, cfg.gripper)
    joints = [model.joint(name) for name in cfg.joints]

    def both(field: str) -> list[float]:
        return [float(x) for drive in drives for x in getattr(drive, field)]

    return {
        "joints": {
            "names": list(cfg.joints),
            "units": ["m" if _KINDS[int(joint.type[0])] == "slide" else "rad" for joint in joints],
            "home": both("home"),
            "lower": [float(joint.range[0]) for joint in joints],
            "upper": [float(joint.range[1]) for joint in joints],
            **{field: both(field) for field in ("speed", "effort", "stiffness", "damping")},
        },
        "gripper": list(cfg.gripper.joints),
        "base": {"position": list(cfg.base_pos), "quaternion_wxyz": list(cfg.base_quat)},
        "body": body(cfg),
        "regions": {name: getattr(cfg, name) for name in ("workspace", "pick", "hold") if getattr(cfg, name)},
    }


def body(cfg: RobotCfg) -> dict[str, Any]:
    """Describes the bodies of a mounted robot (parents first), its end effector, coupled joints and collision shapes.

    Poses are those of MuJoCo's compiled model, in the parent's frame: position [m], orientation (wxyz). A shape that is not a
    sphere, capsule, cylinder or box is described by its bounding box.

    Raises:
        KeyError: the robot has no such end effector.
    """
    model = scene.robot_model(cfg, whole=True)
    names = {int(model.joint(j).qposadr[0]): model.joint(j).name for j in range(model.njnt)}
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, cfg.ee_site)
    ee = (
        (int(model.body(cfg.ee_site).id), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        if site < 0
        else (int(model.site_bodyid[site]), model.site_pos[site], model.site_quat[site])
    )
    return {
        "bodies": [_body(model, i) for i in range(1, model.nbody)],
        "ee": {"body": model.body(ee[0]).name, "pos": ee[1].tolist(), "quat": ee[2].tolist()},
        "couplings": [
            {
                "follower": names[c.follower],
                "leader": names[c.leader],
                "coefficients": list(c.coefficients),
                "reference": c.reference,
            }
            for c in linkage.couplings(model)
        ],
        "shapes": [_shape(model, g) for g in range(model.ngeom) if model.geom_conaffinity[g] or _solid(model, g)],
    }


def _solid(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_contype[geom]) or int(model.geom_group[geom]) == touch.COLLISION


def _body(model: mujoco.MjModel, i: int) -> dict[str, Any]:
    first = int(model.body_jntadr[i])
    joints = [
        {
            "name": model.joint(j).name,
            "type": _KINDS[int(model.jnt_type[j])],
            "axis": model.jnt_axis[j].tolist(),
            "pos": model.jnt_pos[j].tolist(),
            "zero": float(model.qpos0[model.jnt_qposadr[j]]),
        }
        for j in range(first, first + int(model.body_jntnum[i]))
    ]
    parent = int(model.body_parentid[i])
    return {
        "name": model.body(i).name,
        "parent": model.body(parent).name if parent else None,
        "pos": model.body_pos[i].tolist(),
        "quat": model.body_quat[i].tolist(),
        "joints": joints,
    }


def _shape(model: mujoco.MjModel, g: int) -> dict[str, Any]:
    body = model.body(model.geom_bodyid[g]).name
    pos, quat = model.geom_pos[g], model.geom_quat[g]
    kind, size = _SHAPES.get(int(model.geom_type[g])), model.geom_size[g]
    if kind is None:
        center, half = model.geom_aabb[g, :3], model.geom_aabb[g, 3:]
        kind, size, pos = "box", half, pos + quats.rotated(center, quat)
    name = model.geom(g).name or f"{body}'s shape {g - int(model.body_geomadr[model.geom_bodyid[g]]) + 1}"
    return {"name": name, "body": body, "type": kind, "size": size.tolist(), "pos": pos.tolist(), "quat": quat.tolist()}
