"""Scene: a robot at a table with objects and a goal marker, as a compiled MuJoCo model."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated

import mujoco
import numpy as np

from mjx_nero import config
from mjx_nero.config.bounds import Bounds, Edge, Length, OneOf, Place, Point, Positive
from mjx_nero.sim import fixtures, forces, obstacles, team, touch
from mjx_nero.sim.cameras import drawn
from mjx_nero.sim.cameras.cfg import CameraCfg
from mjx_nero.sim.fixtures import FixtureCfg, Fixtures
from mjx_nero.sim.meshes import bank
from mjx_nero.sim.objects import free
from mjx_nero.sim.objects.cfg import ObjectCfg
from mjx_nero.sim.objects.cfg import cube as cube
from mjx_nero.sim.obstacles import ObstacleCfg, Obstacles
from mjx_nero.sim.parts import Parts
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import Key, ObstacleView, View


@dataclasses.dataclass(frozen=True)
class SceneCfg:
    """Table, objects and goal marker.

    The table top is the plane z = 0, because a plane costs the fewest contacts. Its drawn edges matter only to the termination
    that counts an object beyond them as fallen.

    Attributes:
        table_center: centre of the drawn table top, along x and y [m].
        table_size: size of the drawn table top, along x and y [m].
        table: False draws the table but lets nothing touch it; without contacts the physics is several times faster.
        objects: free bodies by name.
        obstacles: fixed boxes by name. The whole arm collides with them, and ``sim.touch`` measures the contact forces.
        fixtures: fixtures by name, such as cabinets, perhaps with joints of their own (``sim.fixtures``).
        robots: further robots by name, besides the task's own (``sim.team``).
        self_collision: a robot's links collide with one another; ``sim.touch`` also measures these forces.
        sensors: names of ``Sim.readings`` besides ``touch``. ``hand``: the force with which robots press objects. ``wrist``:
            force and torque between the arm and the hand of the task's own robot. ``fingers``: the forces at its pads.
        goal: shape of the goal marker: ``sphere``, ``frame`` (a sphere with axes), ``cube``, ``none``, or the name of an object
            whose shape it takes.
        goal_edge: edge of the ``cube`` marker [m].
        look_at: point that the cameras for people look at [m].
        view_distance: distance of the cameras for people from ``look_at`` [m].
        view_from: direction from ``look_at`` to the camera ``front``.
        distractors: number of things without collisions that cameras may see (``mdp.looks.places`` places them).
        backdrop: adds a wall behind the robot, which only cameras see.
        photographs: folder with the user's pictures (PNG, JPEG), which ``mdp.looks.photographs`` shows; empty: none.
        patterns: number of patterns that ``mdp.looks.patterns`` may show.
        cameras: cameras of terms and policies, by name.
        renderer: draws what cameras see: ``mujoco`` (OpenGL), ``warp`` (MuJoCo Warp's ray tracer), or ``auto``: ``mujoco`` with
            native physics, otherwise ``warp``.
    """

    table_center: tuple[Place, Place] = (0.3, 0.0)
    table_size: tuple[Length, Length] = (1.0, 1.2)
    table: bool = True
    objects: Mapping[str, ObjectCfg] = dataclasses.field(default_factory=lambda: {"cube": ObjectCfg()})
    obstacles: Mapping[str, ObstacleCfg] = dataclasses.field(default_factory=dict)
    fixtures: Mapping[str, FixtureCfg] = dataclasses.field(default_factory=dict)
    robots: Mapping[str, RobotCfg] = dataclasses.field(default_factory=dict)
    self_collision: bool = False
    sensors: tuple[Annotated[str, OneOf(touch.HAND, forces.WRIST, forces.FINGERS)], ...] = ()
    goal: str = "sphere"
    goal_edge: Edge = 0.03
    look_at: Point = (0.17, 0.0, 0.21)
    view_distance: Length = 1.1
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
    decimation: Annotated[int, Bounds(1, 10_000)] = 2  # physics steps per control step
    iterations: Iterations = 10  # most iterations of the constraint solver
    ls_iterations: Iterations = 50  # most iterations of the solver's line search (MJX-JAX 20); with 20, MuJoCo C may throw cubes
    ramp: bool = False  # spreads a change of the drives' targets over the control step: stiff drives would jerk otherwise
    impratio: Positive = 10.0  # stiffness of friction relative to normal forces: high enough that grasps do not creep
    elliptic: bool = True  # elliptic friction cones; False: pyramidal
    contacts_per_env: Slots = 24  # Warp: contact slots per environment, shared by all environments
    constraints_per_env: Slots = 128  # Warp: constraint rows of one environment
    solver: Annotated[str, OneOf("newton", "mujoco_warp")] = "newton"  # Warp: the package's own kernels, or the engine's

    def finer(self, max_step: float) -> "SimCfg":
        """Splits each physics step until none is longer than ``max_step`` [s]; the control step stays. 0 changes nothing."""
        times = math.ceil(self.dt / max_step - 1e-6) if max_step else 1
        return dataclasses.replace(self, dt=self.dt / times, decimation=self.decimation * times)


def build(robot: RobotCfg, scene: SceneCfg, sim: SimCfg, visuals: bool = True, fuse: bool = False) -> mujoco.MjModel:
    """Compiles robot, table, objects and goal marker. An object's body, joint and geom carry its name.

    Args:
        visuals: False drops what physics does not need (visual shapes, lights, cameras). qpos, qvel and ctrl stay the same.
        fuse: merges links that cannot move against their parents, unless one is the end effector. Warp goes through the tree
            level by level, so fewer levels are faster.

    Raises:
        UserError: a thing's shape, size or name is not possible.
    """
    whole = bool(scene.obstacles) or scene.self_collision
    team.check(robot, scene.robots, (*scene.objects, *scene.obstacles, *scene.fixtures))
    spec, every = team.mounted(robot, whole), team.of(robot, scene.robots)
    team.add(spec, scene.robots, whole)
    spec.modelname = f"{robot.name}_scene"
    if not visuals:
        spec.discard_visual()  # before meshes are added that no geom has yet (``meshes.bank``), which it would drop as well
    option = spec.option
    option.timestep = sim.dt
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.iterations, option.ls_iterations = sim.iterations, sim.ls_iterations
    option.impratio = sim.impratio
    # MJX-Warp then uses its closed form for box against box instead of its general convex routine: it runs and compiles faster.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if sim.elliptic else mujoco.mjtCone.mjCONE_PYRAMIDAL

    world = spec.worldbody
    if scene.table:
        world.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=free.TABLE, conaffinity=0, group=3)
    for each in every.values():
        for drive in (each.arm, each.gripper):
            _add_drives(spec, drive)
    free.add(spec, scene.objects, visuals)
    goal = world.add_body(name="goal", mocap=True, pos=[0.325, 0, 0.275])
    fixtures.add(spec, scene.fixtures, visuals)
    obstacles.add(spec, [each.base_link for each in every.values()], scene.obstacles, scene.objects)
    for name, each in every.items():
        if scene.self_collision:
            touch.add_pairs(spec, scene.robots.get(name, robot), name)
        if touch.HAND in scene.sensors:
            touch.add_hand(spec, each.base_link, tuple(scene.objects))
    forces.add(spec, robot, scene.sensors)
    if visuals:
        drawn.add(spec, scene, goal, robot)
    # Fixtures stand elsewhere in each world, so their parent has to remain a body.
    ends = all(spec.site(each.ee_site) is not None for each in every.values())
    spec.compiler.fusestatic = fuse and ends and not scene.fixtures
    return obstacles.unbounded(spec.compile())


def parts(
    scene: SceneCfg,
    model: mujoco.MjModel,
    targets: tuple[str, ...] = (),
    place: Callable[[Key, View], Mapping[str, ObstacleView]] | None = None,
    drawn: Callable[[], mujoco.MjModel] | None = None,
    varied: Callable[[], Iterable[str]] = tuple,
) -> Parts:
    """Lists the kinds of things in a scene, as one world knows them.

    Args:
        model: the compiled scene.
        targets: objects of which an episode commands one.
        place: draws where obstacles stand; None: they stay where the scene has them.
        drawn: makes the scene's model for pictures; None: no scenery is needed.
        varied: names of the model's fields that randomization draws.
    """
    return Parts(
        free.Objects(model, scene.objects, targets, drawn, varied),
        bank.Banks(model, scene.objects, drawn),
        Obstacles(model, scene.obstacles, place),
        Fixtures(model, scene.fixtures, drawn),
    )


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
    """Compiles the mounted robot alone, for kinematics. ``whole`` keeps the shapes that only meet obstacles."""
    return team.mounted(robot, whole).compile()


def at_home(robot: RobotCfg, whole: bool = False) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The model of the robot alone (``robot_model``), and its data with the poses of all bodies at home."""
    model = robot_model(robot, whole)
    data = mujoco.MjData(model)
    data.qpos[[model.joint(name).qposadr[0] for name in robot.joints]] = robot.home
    mujoco.mj_kinematics(model, data)
    return model, data


def _add_drives(spec: mujoco.MjSpec, drive) -> None:
    for name, kp, kd, effort in zip(drive.joints, drive.stiffness, drive.damping, drive.effort, strict=True):
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp, kv=kd)
        actuator.forcelimited, actuator.forcerange = True, [-effort, effort]
        actuator.ctrllimited, actuator.ctrlrange = True, spec.joint(name).range
