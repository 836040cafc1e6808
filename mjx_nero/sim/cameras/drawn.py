"""Everything in a scene that is only drawn: table top, floor, goal marker, lights, cameras, distractors, textures."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from mjx_nero.sim import quats
from mjx_nero.sim.cameras import cfg as cameras
from mjx_nero.sim.cameras import textures
from mjx_nero.sim.meshes import body as mesh_body
from mjx_nero.sim.objects.cfg import as_geom
from mjx_nero.sim.robot import RobotCfg

if TYPE_CHECKING:
    from mjx_nero.sim.scene import SceneCfg

_HANGS = 0.5  # cosine of a base's tilt, beyond which the robot hangs from a plate


def add(spec: mujoco.MjSpec, scene: "SceneCfg", goal, robot: RobotCfg) -> None:
    """Adds the parts of a scene that are only drawn, for people and for the task's cameras; ``goal`` is the marker's body.

    Raises:
        UserError: the scene lacks a camera's link, or its photographs cannot be read.
    """
    _add_stage(spec, scene, goal, robot)
    cameras.add(spec, scene.cameras)
    _add_props(spec, scene, robot)
    textures.add(spec, scene.photographs, scene.patterns)


def _add_stage(spec: mujoco.MjSpec, scene: "SceneCfg", goal, robot: RobotCfg) -> None:
    """Adds what people see."""
    hidden = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2}
    box, half = mujoco.mjtGeom.mjGEOM_BOX, scene.goal_edge / 2
    shape, extent = (box, [half] * 3) if scene.goal == "cube" else (mujoco.mjtGeom.mjGEOM_SPHERE, [0.02, 0, 0])
    item, mesh = scene.objects.get(scene.goal), {}
    if item and item.shape == "mesh":
        shape, extent, mesh = mujoco.mjtGeom.mjGEOM_MESH, [0, 0, 0], {"meshname": mesh_body.drawn_name(scene.goal, 0)}
    elif item:
        shape, extent = as_geom(item)
    if scene.goal != "none":
        goal.add_geom(name="goal", type=shape, size=extent, rgba=[0.2, 0.8, 0.3, 0.4], **mesh, **hidden)
    if scene.goal == "frame":
        for axis, rgba in zip(np.eye(3), ([0.85, 0.2, 0.2, 1], [0.2, 0.7, 0.25, 1], [0.2, 0.35, 0.9, 1]), strict=True):
            ends = [0, 0, 0, *(0.06 * axis)]
            goal.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.003, 0, 0], fromto=ends, rgba=rgba, **hidden)
    world = spec.worldbody
    x, y = scene.table_center
    size = [scene.table_size[0] / 2, scene.table_size[1] / 2, 0.02]
    world.add_geom(name="table_top", type=box, size=size, pos=[x, y, -0.0205], rgba=[0.72, 0.6, 0.47, 1], **hidden)
    grey = [0.6, 0.62, 0.64, 1]
    if robot.floor < 0:
        world.add_geom(name="floor", type=box, size=[3, 3, 0.02], pos=[x, y, robot.floor - 0.0205], rgba=grey, **hidden)
    up = quats.matrix(robot.base_quat)[:, 2]
    if up[2] < _HANGS:  # the plate is behind its base
        behind = np.array(robot.base_pos) - 0.0105 * up
        where = {"size": [0.15, 0.15, 0.01], "pos": behind, "quat": robot.base_quat}
        world.add_geom(name="plate", type=box, **where, rgba=grey, **hidden)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.97],
        rgb2=[0.62, 0.68, 0.74],
        width=64,
        height=64,
    )
    target, far = np.array(scene.look_at), scene.view_distance
    for direction, color, shadow in (((-0.4, 0.6, -1.2), 0.7, True), ((0.0, -0.7, -1.0), 0.3, False)):
        world.add_light(pos=target - 1.1 * far * np.array(direction), dir=direction, diffuse=[color] * 3, castshadow=shadow)
    for name, direction in (("front", scene.view_from), ("side", (0.07, -0.98, 0.17))):
        pos = target + far * np.array(direction)
        world.add_camera(name=name, pos=pos, quat=cameras.look_at(pos, target), fovy=42)
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.quality.shadowsize = 2048
    spec.stat.center, spec.stat.extent = target, far


def _add_props(spec: mujoco.MjSpec, scene: "SceneCfg", robot: RobotCfg) -> None:
    """Adds distractors and backdrop, on a movable body: MuJoCo Warp assumes that others never move."""
    if not (scene.distractors or scene.backdrop):
        return
    body = spec.worldbody.add_body(name="props", mocap=True)
    hidden = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2}
    shapes = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_CYLINDER)
    for i, name in enumerate(distractors(scene)):
        body.add_geom(name=name, type=shapes[i % 3], size=[0.03, 0.03, 0.03], pos=[0, 0, -10], rgba=[0.5, 0.5, 0.5, 1], **hidden)
    if scene.backdrop:
        x, y, _ = robot.base_pos
        away = -1.0 if scene.table_center[0] >= x else 1.0
        size, pos = [0.02, 4.0, 2.0], [x + away, y, 0.5]
        body.add_geom(name="backdrop", type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, rgba=[0.7, 0.72, 0.74, 1], **hidden)


def distractors(scene: "SceneCfg") -> tuple[str, ...]:
    """Names of the geoms that ``SceneCfg.distractors`` counts."""
    return tuple(f"distractor_{i}" for i in range(scene.distractors))
