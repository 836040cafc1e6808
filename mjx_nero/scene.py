"""Scene: a robot at a table with one cube and a goal marker, as a compiled MuJoCo model."""

import dataclasses

import mujoco
import numpy as np

from mjx_nero import robot_file
from mjx_nero.robots import RobotCfg


@dataclasses.dataclass(frozen=True)
class SceneCfg:
    """Table, cube and goal marker. Lengths in m, mass in kg.

    ``table`` False makes the table a picture alone: nothing meets it, and without contacts the physics is several times faster.
    ``cube`` False leaves the cube out. ``goal`` is the marker's shape, ``sphere``, ``frame``
    (a sphere with axes) or ``cube`` (of the cube's size). The cameras
    look at ``look_at`` from ``view_distance``.

    The table top is the plane z = 0 (a plane costs the fewest contacts); its drawn edges only matter to the
    termination that counts a cube beyond them as fallen.
    """

    table_center: tuple[float, float] = (0.3, 0.0)
    table_size: tuple[float, float] = (1.0, 1.2)
    table: bool = True
    cube: bool = True
    cube_edge: float = 0.03
    cube_mass: float = 0.03
    cube_friction: tuple[float, float, float] = (1.0, 0.005, 0.0001)
    goal: str = "sphere"
    look_at: tuple[float, float, float] = (0.17, 0.0, 0.21)
    view_distance: float = 1.1


@dataclasses.dataclass(frozen=True)
class SimCfg:
    """Physics options, and the buffers that MJX-Warp needs (overflows are counted, see ``Physics``)."""

    dt: float = 0.01  # physics step [s]
    decimation: int = 2  # physics steps a control step
    iterations: int = 10
    ls_iterations: int = 20
    impratio: float = 10.0  # friction as stiff as the grasp needs not to creep
    elliptic: bool = True
    contacts_per_env: int = 24  # Warp: contact slots, times the number of environments
    constraints_per_env: int = 128  # Warp: constraint rows of one environment


def build(robot: RobotCfg, scene: SceneCfg, sim: SimCfg, visuals: bool = True, fuse: bool = False) -> mujoco.MjModel:
    """Compiles robot, table, cube (joint ``cube``, if there is one) and goal marker.

    Args:
        visuals: False leaves out all that physics does not need (visual shapes, lights, cameras): same qpos, qvel and
            ctrl, less work a step.
        fuse: makes links that nothing moves against their parents a part of them, unless one serves as the end effector: Warp
            goes through the tree level by level.
    """
    spec = _robot_spec(robot)
    spec.modelname = f"{robot.name}_scene"
    option = spec.option
    option.timestep = sim.dt
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.iterations, option.ls_iterations = sim.iterations, sim.ls_iterations
    option.impratio = sim.impratio
    # Box against box then goes by MJX-Warp's closed form instead of its general convex routine: faster, and quicker to compile.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if sim.elliptic else mujoco.mjtCone.mjCONE_PYRAMIDAL

    # Contact bits: the table meets bit 1, the cube bit 2; robot geoms have no type, so never meet one another.
    world = spec.worldbody
    if scene.table:
        world.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=0, group=3)
    for drive in (robot.arm, robot.gripper):
        _add_drives(spec, drive)

    if scene.cube:
        cube = world.add_body(name="cube", pos=[0.35, 0, scene.cube_edge / 2])
        cube.add_freejoint(name="cube")
        cube.add_geom(
            name="cube",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[scene.cube_edge / 2] * 3,
            mass=scene.cube_mass,
            friction=scene.cube_friction,
            contype=2,
            conaffinity=1,
            rgba=[0.85, 0.3, 0.2, 1],
        )
    goal = world.add_body(name="goal", mocap=True, pos=[0.325, 0, 0.275])
    if visuals:
        _add_visuals(spec, scene, goal)
    else:
        spec.discard_visual()
    spec.compiler.fusestatic = fuse and spec.site(robot.ee_site) is not None
    return spec.compile()


def robot_model(robot: RobotCfg) -> mujoco.MjModel:
    """The robot alone where it is mounted: what kinematics need."""
    return _robot_spec(robot).compile()


def _robot_spec(robot: RobotCfg) -> mujoco.MjSpec:
    spec = robot_file.model(robot)
    base = spec.body(robot.base_link)
    base.pos, base.quat = robot.base_pos, robot.base_quat
    if robot.gravity_compensation:
        for body in [base, *base.find_all(mujoco.mjtObj.mjOBJ_BODY)]:
            body.gravcomp = 1.0
    return spec


def _add_drives(spec: mujoco.MjSpec, drive) -> None:
    for name, kp, kd, effort in zip(drive.joints, drive.stiffness, drive.damping, drive.effort, strict=True):
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp, kv=kd)
        actuator.forcelimited, actuator.forcerange = True, [-effort, effort]
        actuator.ctrllimited, actuator.ctrlrange = True, spec.joint(name).range


def _add_visuals(spec: mujoco.MjSpec, scene: SceneCfg, goal) -> None:
    hidden = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2}
    box, half = mujoco.mjtGeom.mjGEOM_BOX, scene.cube_edge / 2
    shape, extent = (box, [half] * 3) if scene.goal == "cube" else (mujoco.mjtGeom.mjGEOM_SPHERE, [0.02, 0, 0])
    goal.add_geom(name="goal", type=shape, size=extent, rgba=[0.2, 0.8, 0.3, 0.4], **hidden)
    if scene.goal == "frame":
        for axis, rgba in zip(np.eye(3), ([0.85, 0.2, 0.2, 1], [0.2, 0.7, 0.25, 1], [0.2, 0.35, 0.9, 1]), strict=True):
            ends = [0, 0, 0, *(0.06 * axis)]
            goal.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.003, 0, 0], fromto=ends, rgba=rgba, **hidden)
    world = spec.worldbody
    x, y = scene.table_center
    size = [scene.table_size[0] / 2, scene.table_size[1] / 2, 0.02]
    world.add_geom(name="table_top", type=box, size=size, pos=[x, y, -0.0205], rgba=[0.72, 0.6, 0.47, 1], **hidden)
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
    for name, direction in (("front", (0.71, -0.65, 0.28)), ("side", (0.07, -0.98, 0.17))):
        pos = target + far * np.array(direction)
        world.add_camera(name=name, pos=pos, quat=_look_at(pos, target), fovy=42)
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.quality.shadowsize = 2048
    spec.stat.center, spec.stat.extent = target, far


def _look_at(pos, target) -> np.ndarray:
    """Orientation (wxyz) of a camera at ``pos`` that looks at ``target`` with world z up."""
    back = np.subtract(pos, target) / np.linalg.norm(np.subtract(pos, target))
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.column_stack([right, np.cross(back, right), back]).flatten())
    return quat
