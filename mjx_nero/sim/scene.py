"""Scene: a robot at a table with objects and a goal marker, as a compiled MuJoCo model."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated

import mujoco
import numpy as np

from mjx_nero import config
from mjx_nero.config.bounds import Bounds, NonNegative, OneOf, Positive
from mjx_nero.sim import fixtures, forces, objects, robot_file, touch
from mjx_nero.sim.cameras import cfg as cameras
from mjx_nero.sim.cameras import textures
from mjx_nero.sim.cameras.cfg import CameraCfg
from mjx_nero.sim.fixtures import FixtureCfg
from mjx_nero.sim.objects import body as mesh_body
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError

# Shape -> MuJoCo's type, and what ``ObjectCfg.size`` says of it.
_SHAPES = {
    "box": (mujoco.mjtGeom.mjGEOM_BOX, "its three edges"),
    "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, "its radius"),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, "its radius and the length between the centres of its ends"),
    "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, "its radius and its length"),
    "can": (mujoco.mjtGeom.mjGEOM_CYLINDER, "its radius and its length"),
}
# Contact bits: the table meets bit 1, objects bit 2; robot geoms have no type, so never meet one another. Objects meet by bit 4.
_TABLE, _OBJECT, _OBJECTS = 1, 2, 4
_HANGS = 0.5  # cosine of a base's tilt: one that is tilted further hangs from a plate
COMMANDED = (0.2, 0.8, 0.3, 1.0)  # colour of the goal, and of the object that belongs there where there are several


@dataclasses.dataclass(frozen=True)
class ObjectCfg:
    """A free body.

    Attributes:
        shape: ``box``, ``sphere``, ``capsule``, ``cylinder`` or ``can``; the last three stand along z. A can meets the table as a
            cylinder and everything else as the capsule inside it: a flat pad touches a cylinder's side at a single point that
            jumps about, and MJX-JAX finds no contact there.
        size: edges of a box; radius of a sphere; radius and length of a cylinder, or of a capsule without its ends [m].
        mass: [kg]; a mesh has its ``density``.
        friction: sliding [1], spinning and rolling [m].
        condim: contact dimension: 3 slides, 4 also spins, 6 also rolls. The larger of two geoms holds.
        pos: place before the reset events: x, y, and height above the table [m].
        quat: orientation there, wxyz.
        rgba: colour.
        file: of a ``mesh``: an OBJ, STL or GLB file, a folder with an ``object.yaml``, or one of the package's objects by name.
            It is cut into convex parts; its place is its centre of mass.
        bank: further files; in each episode the object has one of all these shapes (``sim.objects.bank``).
        scale: of a mesh's lengths.
        density: of a mesh [kg/m3], from which its mass follows; 0: what its ``object.yaml`` says, or else 500.
    """

    shape: str = "box"
    size: tuple[Positive, ...] = (0.03, 0.03, 0.03)
    mass: Positive = 0.03
    friction: tuple[NonNegative, NonNegative, NonNegative] = (1.0, 0.005, 0.0001)
    condim: int = 3
    pos: tuple[float, float, float] = (0.35, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rgba: tuple[float, float, float, float] = (0.85, 0.3, 0.2, 1.0)
    file: str = ""
    bank: tuple[str, ...] = ()
    scale: Positive = 1.0
    density: NonNegative = 0.0

    @property
    def solids(self) -> list[objects.Solid]:
        """The shapes of a mesh, at its scale."""
        return [objects.find(file).scaled(self.scale) for file in (self.file, *self.bank)]

    @property
    def masses(self) -> list[float]:
        """The masses of the shapes of a mesh [kg]."""
        return [(self.density or solid.density) * solid.volume for solid in self.solids]

    @property
    def rest_height(self) -> float:
        """Height of its centre when it rests on the table [m]."""
        if self.shape == "mesh":
            return self.solids[0].height(np.array(self.quat))
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.asarray(self.quat) / np.linalg.norm(self.quat))
        up, (first, *rest) = turn[6:], self.size
        if self.shape == "box":
            return float(np.abs(up) @ np.asarray(self.size) / 2)
        if self.shape in ("cylinder", "can"):
            return float(abs(up[2]) * rest[0] / 2 + np.sqrt(1 - min(1.0, up[2] ** 2)) * first)
        return float(first + (abs(up[2]) * rest[0] / 2 if rest else 0.0))


def cube(edge: float, mass: float) -> ObjectCfg:
    """A cube [m, kg]."""
    return ObjectCfg(size=(edge,) * 3, mass=mass)


@dataclasses.dataclass(frozen=True)
class ObstacleCfg:
    """A fixed box that stops robot and objects. It stays below the table unless a task draws its place (``EnvCfg.obstacles``).

    Attributes:
        size: edges [m].
        pos: centre in the world [m].
        quat: orientation, wxyz.
        rgba: colour.
    """

    size: tuple[Positive, Positive, Positive] = (0.05, 0.05, 0.05)
    pos: tuple[float, float, float] = (0.0, 0.0, -0.5)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rgba: tuple[float, float, float, float] = (0.32, 0.38, 0.5, 1.0)


@dataclasses.dataclass(frozen=True)
class SceneCfg:
    """Table, objects and goal marker. Lengths in m.

    The table top is the plane z = 0, because a plane costs the fewest contacts. Its drawn edges matter only to the termination
    that counts an object beyond them as fallen.

    Attributes:
        table_center, table_size: centre and size of the drawn top, along x and y.
        table: False draws the table but lets nothing touch it; without contacts the physics is several times faster.
        objects: free bodies by name.
        obstacles: fixed boxes by name. The whole arm collides with them, and ``sim.touch`` measures the contact forces.
        fixtures: things with joints of their own by name, such as a cabinet (``sim.fixtures``).
        self_collision: the robot's links collide with one another; ``sim.touch`` measures those forces, too.
        hand: ``sim.touch`` measures what the robot presses objects with.
        wrist, fingers: ``sim.forces`` measures force and torque between arm and hand, and the forces at the pads.
        goal: shape of the goal marker: ``sphere``, ``frame`` (a sphere with axes), ``cube``, ``none``, or the name of an object
            whose shape it takes.
        goal_edge: edge of the ``cube`` marker.
        look_at, view_distance: point that people's cameras look at, and their distance from it.
        view_from: direction from there to the camera ``front``.
        distractors: how many things that touch nothing cameras may see (``mdp.looks.places`` puts them somewhere).
        backdrop: a wall stands behind the robot, for cameras alone.
        photographs: folder with pictures of the user's (PNG, JPEG), which ``mdp.looks.photographs`` shows; empty: none.
        patterns: how many patterns ``mdp.looks.patterns`` may show.
        cameras: what terms and policies see through, by name; none cost nothing.
        renderer: draws their pictures: ``mujoco`` (OpenGL), ``warp`` (MuJoCo Warp's ray tracer), or ``auto``: the first with
            MuJoCo's C library as physics, the second otherwise.
    """

    table_center: tuple[float, float] = (0.3, 0.0)
    table_size: tuple[Positive, Positive] = (1.0, 1.2)
    table: bool = True
    objects: Mapping[str, ObjectCfg] = dataclasses.field(default_factory=lambda: {"cube": ObjectCfg()})
    obstacles: Mapping[str, ObstacleCfg] = dataclasses.field(default_factory=dict)
    fixtures: Mapping[str, FixtureCfg] = dataclasses.field(default_factory=dict)
    self_collision: bool = False
    hand: bool = False
    wrist: bool = False
    fingers: bool = False
    goal: str = "sphere"
    goal_edge: Positive = 0.03
    look_at: tuple[float, float, float] = (0.17, 0.0, 0.21)
    view_distance: Positive = 1.1
    view_from: tuple[float, float, float] = (0.71, -0.65, 0.28)
    distractors: Annotated[int, Bounds(0, 100)] = 0
    backdrop: bool = False
    photographs: str = ""
    patterns: Annotated[int, Bounds(0, 100)] = 0
    cameras: Mapping[str, CameraCfg] = dataclasses.field(default_factory=dict)
    renderer: Annotated[str, OneOf("auto", "mujoco", "warp")] = "auto"

    def __post_init__(self):
        config.freeze(self)


Iterations = Annotated[int, Bounds(1, 10_000)]
Slots = Annotated[int, Bounds(1, 100_000)]


@dataclasses.dataclass(frozen=True)
class SimCfg:
    """Physics options and MJX-Warp's buffer sizes. Overflows are counted, see ``Physics``."""

    dt: Annotated[float, Bounds(1e-6, 1.0)] = 0.01  # physics step [s]
    decimation: Annotated[int, Bounds(1, 10_000)] = 2  # physics steps a control step
    iterations: Iterations = 10  # of the constraint solver, at most
    ls_iterations: Iterations = 50  # of its line search, at most (MJX-JAX 20); at 20, MuJoCo's C library throws a cube at times
    impratio: Positive = 10.0  # friction as stiff as the grasp needs not to creep
    elliptic: bool = True  # friction cones; else pyramids
    contacts_per_env: Slots = 24  # Warp: contact slots, times the number of environments
    constraints_per_env: Slots = 128  # Warp: constraint rows of one environment
    solver: Annotated[str, OneOf("newton", "mujoco_warp")] = "newton"  # Warp: the package's own kernels, or the engine's

    def finer(self, max_step: float) -> "SimCfg":
        """Splits each physics step until none is longer than ``max_step`` [s]; the control step stays. 0 changes nothing."""
        times = math.ceil(self.dt / max_step - 1e-6) if max_step else 1
        return dataclasses.replace(self, dt=self.dt / times, decimation=self.decimation * times)


def build(robot: RobotCfg, scene: SceneCfg, sim: SimCfg, visuals: bool = True, fuse: bool = False) -> mujoco.MjModel:
    """Compiles robot, table, objects and goal marker. An object's body, joint and geom carry its name.

    Args:
        visuals: False drops what physics does not need (visual shapes, lights, cameras): same qpos, qvel and ctrl, faster steps.
        fuse: merges links that cannot move against their parents, unless one is the end effector. Warp goes through the tree
            level by level, so fewer levels are faster.

    Raises:
        UserError: an object's shape, size or name is not possible.
    """
    whole = bool(scene.obstacles) or scene.self_collision
    spec = _robot_spec(robot, whole)
    spec.modelname = f"{robot.name}_scene"
    if not visuals:
        spec.discard_visual()  # before things bring meshes that no geom has yet (``objects.bank``), which it would drop, too
    option = spec.option
    option.timestep = sim.dt
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.iterations, option.ls_iterations = sim.iterations, sim.ls_iterations
    option.impratio = sim.impratio
    # Box against box then goes by MJX-Warp's closed form instead of its general convex routine: faster, and quicker to compile.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if sim.elliptic else mujoco.mjtCone.mjCONE_PYRAMIDAL

    world = spec.worldbody
    if scene.table:
        world.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=_TABLE, conaffinity=0, group=3)
    for drive in (robot.arm, robot.gripper):
        _add_drives(spec, drive)
    for name, item in scene.objects.items():
        _add_object(spec, name, item, visuals)
    goal = world.add_body(name="goal", mocap=True, pos=[0.325, 0, 0.275])
    fixtures.add(spec, scene.fixtures, visuals)
    if whole:
        pairs = touch.self_pairs(robot) if scene.self_collision else ()
        touch.add(spec, robot.base_link, scene.obstacles, tuple(scene.objects), pairs)
    if scene.hand:
        touch.add_hand(spec, robot.base_link, tuple(scene.objects))
    forces.add(spec, robot, scene.wrist, scene.fingers)
    if visuals:
        _add_visuals(spec, scene, goal, robot)
        cameras.add(spec, scene.cameras)
        _add_props(spec, scene, robot)
        textures.add(spec, scene.photographs, scene.patterns)
    # Fixtures stand elsewhere in each world, so what carries them has to stay a body.
    spec.compiler.fusestatic = fuse and spec.site(robot.ee_site) is not None and not scene.fixtures
    return touch.unbounded(spec.compile())


def around(robot: RobotCfg, scene: SceneCfg) -> SceneCfg:
    """Moves table and cameras to where an imported robot works: under the robot, or in front of one that stands on the floor."""
    boxes = [np.array(box).T for box in (robot.workspace, robot.pick, robot.hold) if box]  # [2, 3]
    if not boxes:
        return scene
    base = np.array(robot.base_pos)
    work = np.array([np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))]) + base
    foot = base * [1, 1, 0]
    low, high = np.minimum(work[0], foot), np.maximum(work[1], foot)
    look_at, far = (low + high) / 2, 0.3 + 1.3 * float(np.linalg.norm(high - low))
    if robot.floor < 0:
        low, high = work[0], work[1] + 0.1 * np.sign(work.mean(0) - base)
    else:
        low, high = low - 0.15, high + 0.15
    center, size = (low + high)[:2] / 2, (high - low)[:2]
    return dataclasses.replace(
        scene,
        table_center=(float(center[0]), float(center[1])),
        table_size=(float(size[0]), float(size[1])),
        look_at=(float(look_at[0]), float(look_at[1]), float(look_at[2])),
        view_distance=far,
    )


def robot_model(robot: RobotCfg, whole: bool = False) -> mujoco.MjModel:
    """Compiles the mounted robot alone, for kinematics. ``whole`` keeps the shapes that meet obstacles only."""
    return _robot_spec(robot, whole).compile()


def _robot_spec(robot: RobotCfg, whole: bool = False) -> mujoco.MjSpec:
    """Reads and mount the robot. ``whole`` keeps the shapes that meet obstacles only."""
    spec = robot_file.model(robot)
    for geom in [] if whole else spec.geoms:
        if geom.conaffinity == touch.OBSTACLE:
            spec.delete(geom)
    base = spec.body(robot.base_link)
    base.pos, base.quat = robot.base_pos, robot.base_quat
    if robot.gravity_compensation:
        for body in [base, *base.find_all(mujoco.mjtObj.mjOBJ_BODY)]:
            body.gravcomp = 1.0
    return spec


def _add_object(spec: mujoco.MjSpec, name: str, item: ObjectCfg, visuals: bool) -> None:
    if item.shape not in (*_SHAPES, "mesh"):
        raise UserError(f"scene.objects.{name}.shape must be one of {', '.join(_SHAPES)} or mesh, got {item.shape!r}")
    if item.shape == "mesh":
        return _add_mesh(spec, name, item, visuals)
    says = _SHAPES[item.shape][1]
    count = {"box": 3, "sphere": 1}.get(item.shape, 2)
    if len(item.size) != count:
        raise UserError(f"scene.objects.{name}.size of a {item.shape} is {says}, got {item.size}")
    if item.shape == "can" and item.size[1] <= 2 * item.size[0]:
        raise UserError(f"scene.objects.{name}.size of a can is its radius and more than twice that as length, got {item.size}")
    shape, extent = _geom(item)
    body = _add_body(spec, name, item)
    body.add_geom(
        name=name,
        type=shape,
        size=extent,
        mass=item.mass,
        friction=item.friction,
        condim=item.condim,
        contype=0 if item.shape == "can" else _OBJECT | _OBJECTS,
        conaffinity=_TABLE if item.shape == "can" else _TABLE | _OBJECTS,
        rgba=item.rgba,
    )
    if item.shape == "can":
        radius, length = item.size
        body.add_geom(
            name=side(name),
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[radius, length / 2 - radius, 0.0],
            mass=0.0,
            friction=item.friction,
            condim=item.condim,
            contype=_OBJECT | _OBJECTS,
            conaffinity=_OBJECTS,
            group=3,
        )


def _add_body(spec: mujoco.MjSpec, name: str, item: ObjectCfg):
    if item.condim not in (1, 3, 4, 6):
        raise UserError(f"scene.objects.{name}.condim must be 1, 3, 4 or 6, got {item.condim}")
    if name == "goal" or spec.body(name) or spec.joint(name) or spec.geom(name):
        raise UserError(f"scene.objects.{name} needs another name: the robot or the scene has one that is called so")
    x, y, above = item.pos
    body = spec.worldbody.add_body(name=name, pos=[x, y, item.rest_height + above], quat=item.quat)
    body.add_freejoint(name=name)
    return body


def _add_mesh(spec: mujoco.MjSpec, name: str, item: ObjectCfg, visuals: bool) -> None:
    mesh_body.checked(name, item.solids, item.scale)
    slides = {"friction": item.friction, "condim": item.condim}
    table = {**slides, "contype": 0, "conaffinity": _TABLE}
    others = {**slides, "contype": _OBJECT | _OBJECTS, "conaffinity": _OBJECTS}
    mesh_body.add(spec, name, item.solids, item.masses, _add_body(spec, name, item), table, others, visuals)
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # several contacts where flat sides meet


def side(name: str) -> str:
    """Name of the geom that forms the side of can ``name``."""
    return f"{name}_side"


def _geom(item: ObjectCfg) -> tuple[mujoco.mjtGeom, list[float]]:
    """MuJoCo's geom type and size of an object."""
    half = [item.size[0], *(x / 2 for x in item.size[1:])] if item.shape != "box" else [x / 2 for x in item.size]
    return _SHAPES[item.shape][0], half + [0.0] * (3 - len(half))


def _add_drives(spec: mujoco.MjSpec, drive) -> None:
    for name, kp, kd, effort in zip(drive.joints, drive.stiffness, drive.damping, drive.effort, strict=True):
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp, kv=kd)
        actuator.forcelimited, actuator.forcerange = True, [-effort, effort]
        actuator.ctrllimited, actuator.ctrlrange = True, spec.joint(name).range


def _add_props(spec: mujoco.MjSpec, scene: SceneCfg, robot: RobotCfg) -> None:
    """Things that are drawn alone, on a body that can be moved (though nobody does), as MuJoCo Warp takes others to stay."""
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


def distractors(scene: SceneCfg) -> tuple[str, ...]:
    """Names of the geoms that ``SceneCfg.distractors`` counts."""
    return tuple(f"distractor_{i}" for i in range(scene.distractors))


def _add_visuals(spec: mujoco.MjSpec, scene: SceneCfg, goal, robot: RobotCfg) -> None:
    hidden = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2}
    box, half = mujoco.mjtGeom.mjGEOM_BOX, scene.goal_edge / 2
    shape, extent = (box, [half] * 3) if scene.goal == "cube" else (mujoco.mjtGeom.mjGEOM_SPHERE, [0.02, 0, 0])
    item, mesh = scene.objects.get(scene.goal), {}
    if item and item.shape == "mesh":
        shape, extent, mesh = mujoco.mjtGeom.mjGEOM_MESH, [0, 0, 0], {"meshname": mesh_body.drawn_name(scene.goal, 0)}
    elif item:
        shape, extent = _geom(item)
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
    up = np.zeros(9)
    mujoco.mju_quat2Mat(up, np.array(robot.base_quat) / np.linalg.norm(robot.base_quat))
    if up[8] < _HANGS:  # what it hangs from, behind its base
        behind = np.array(robot.base_pos) - 0.0105 * up.reshape(3, 3)[:, 2]
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
