"""Clutter: of several objects of different shape, lift the one that is commanded and hold it at a commanded point.

Three to six of six objects are on the table; with the preset ``four`` three or four, one of each shape.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from mjx_nero.envs import regions
from mjx_nero.envs.task import EnvCfg, Presets, SuccessCfg, joint_actions
from mjx_nero.mdp import commands, events, metrics, observations, randomization, rewards, success, terminations
from mjx_nero.mdp.terms import (
    ONCE,
    CommandTerm,
    DoneTerm,
    ObservationGroup,
    ObservationTerm,
    RewardTerm,
    Term,
    privileged,
)
from mjx_nero.sim import contacts, grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, SimCfg
from mjx_nero.types import TARGET

SIZES = (0.75, 1.15)  # an object's lengths are drawn between these shares of those below
MASSES = (0.5, 2.0)  # likewise its mass
DENSITY = 2000.0  # [kg/m3] of stone: what is round and light sinks deep into the pads, which touch it in a point
LEAST = 3  # objects on the table
MARGIN = 0.003  # [m] between an open hand and the nearest object
OPEN = 1.5  # the hand opens so many times as far as the widest object asks for: in clutter it takes no more room than it must
QUICK = 0.3  # [s] fingers take to close, at least
FOOT = 0.1  # [m] no object lies nearer to the robot's axis
LIFTED = 0.005  # [m] an object that is held is that much higher than its largest like lies
AWAY = 4.0  # [m] from the table's centre: the objects that an episode leaves out

# Shape, lengths in units of the widest object's edge, and how it lies; along x those that are longer than wide.
LYING = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
ROLLING: dict[str, Any] = {"friction": (1.0, 0.005, 0.002), "condim": 6}  # what is round would roll for ever
SHAPES: dict[str, dict[str, Any]] = {
    "box": {"shape": "box", "size": (1.0, 1.0, 1.0)},
    "bar": {"shape": "box", "size": (1.3, 0.55, 0.6)},
    "cylinder": {"shape": "can", "size": (0.4, 1.1), **ROLLING},
    "sphere": {"shape": "sphere", "size": (0.45,), **ROLLING},
    "capsule": {"shape": "capsule", "size": (0.33, 0.7), "quat": LYING, **ROLLING},
    "pill": {"shape": "capsule", "size": (0.42, 0.3), "quat": LYING, **ROLLING},
}


@dataclasses.dataclass(frozen=True)
class ClutterSetup:
    """What differs from robot to robot; lengths in m.

    Attributes:
        scene: with all objects.
        robot: its hand opens as far as these ask for.
        there: where it can grasp, and where it can hold.
        pitch, jitter: of the objects' cells (``events.scatter``).
        grasp: for the controller that picks up: how low, how far beyond the grasp point (``PickUpCfg``), and how long to close.
        grasp_radius: how near to the grasp point the object counts as held.
    """

    scene: SceneCfg
    robot: RobotCfg
    there: regions.Regions
    pitch: float
    jitter: float
    grasp: dict[str, float]
    grasp_radius: float


def volume(item: ObjectCfg) -> float:
    """Of an object [m3]."""
    first, *rest = item.size
    if item.shape == "box":
        return float(np.prod(item.size))
    ends = 0.0 if item.shape in ("cylinder", "can") else 4 / 3 * np.pi * first**3
    return ends + np.pi * first**2 * sum(rest)


def extent(item: ObjectCfg) -> float:
    """Radius of a circle around an object's outline from above as it lies [m]."""
    first, *rest = item.size
    if item.shape == "box":
        return float(np.linalg.norm(item.size[:2])) / 2
    if item.shape in ("cylinder", "can"):
        return first
    return first + (rest[0] / 2 if rest else 0.0)


def across(item: ObjectCfg) -> float:
    """How wide it is between the pads of a hand that fits it [m]."""
    first, *rest = item.size
    return min(first, *rest[:1]) if item.shape == "box" else 2 * first


def fitted(robot: RobotCfg, names: Iterable[str] = SHAPES) -> ClutterSetup:
    """What follows from the robot's gripper, and from where it can grasp and hold.

    Raises:
        UserError: as ``regions.of``, or the hand does not close on all of the objects.
    """
    there, (thickness, width) = regions.of(robot), (robot.pad[2], robot.pad[1])
    edge = grasp.cube_for(robot).size[0]
    unit = edge / SIZES[1]
    objects = {name: _object(unit, **SHAPES[name]) for name in names}
    thinnest = SIZES[0] * min(map(across, objects.values()))
    robot = grasp.opened(grasp.shut(robot, thinnest), OPEN * edge)
    around = SIZES[1] * max(extent(item) for item in objects.values())
    hand = float(np.hypot(min(OPEN * edge, robot.opening) / 2 + thickness, width / 2)) + MARGIN
    jitter = edge / 5
    pitch = round(around + max(around, hand) + 2 * jitter, 4)
    scene = regions.scene(robot, "sphere")
    size = scene.table_size[0] + 2 * pitch, scene.table_size[1] + 2 * pitch
    (low, high), foot = there.cube[0], robot.base_pos[0] + FOOT + pitch + jitter
    return ClutterSetup(
        scene=dataclasses.replace(scene, objects=objects, table_size=size),
        robot=robot,
        there=dataclasses.replace(there, cube=(regions.span(max(low, min(high, foot)), high), there.cube[1])),
        pitch=pitch,
        jitter=jitter,
        grasp={
            "lowest": grasp.lowest(robot.pad),
            "beyond": grasp.beyond(robot, edge),
            "closing": round(max(QUICK, grasp.closing_time(robot, thinnest)), 3),
        },
        grasp_radius=regions.near(there),
    )


def _object(unit: float, size: tuple[float, ...], **fields) -> ObjectCfg:
    item = ObjectCfg(size=tuple(round(unit * length, 4) for length in size), **fields)
    return dataclasses.replace(item, mass=float(f"{DENSITY * volume(item):.3g}"))


def default(robot: RobotCfg) -> EnvCfg:
    """Six objects."""
    return _clutter(fitted(robot))


def four(robot: RobotCfg) -> EnvCfg:
    """One of each shape."""
    return _clutter(fitted(robot, ("box", "cylinder", "sphere", "capsule")))


# Long: a task is one list, to be read as one.
def _clutter(setup: ClutterSetup) -> EnvCfg:
    """Lift's rewards for the commanded object; the others may be touched, but not leave the table."""
    scene, names, commanded = setup.scene, tuple(setup.scene.objects), {"object": TARGET}
    heights = tuple(round(SIZES[1] * item.rest_height + LIFTED, 4) for item in scene.objects.values())
    held = {"minimal_height": heights, "grasp_radius": setup.grasp_radius, **commanded}
    center = scene.table_center
    state = {
        "joint_pos": ObservationTerm(observations.joint_pos_rel, noise=0.01),
        "joint_vel": ObservationTerm(observations.joint_vel_rel, noise=0.01),
        "target_error": ObservationTerm(observations.target_error),
        "ee_position": ObservationTerm(observations.ee_position),
        "ee_orientation": ObservationTerm(observations.ee_orientation),
        "ee_to_object": ObservationTerm(observations.ee_to_object, params=commanded, noise=0.002),
        "object_orientation": ObservationTerm(observations.object_orientation, params=commanded, noise=0.01),
        "object_to_goal": ObservationTerm(observations.object_to_goal, params=commanded, noise=0.002),
        "target_object_position": ObservationTerm(observations.command),
        "ee_to_objects": ObservationTerm(observations.ee_to_objects, params={"objects": names, "limit": 0.3}, noise=0.002),
        "actions": ObservationTerm(observations.last_action),
    }
    return EnvCfg(
        robot=dataclasses.replace(setup.robot, gravity_compensation=True),  # as a robot's own controller does
        scene=scene,
        # At the lifts' step of 10 ms what is round and light jumps out of small pads: Nero's scripted expert then lost 30 of 64
        # objects, at 5 ms and a slower way 5, at 2.5 ms 2.
        sim=contacts.crowded(setup.robot, scene, SimCfg(dt=0.005, decimation=4)),
        episode_length_s=8.0,
        actions=joint_actions(scale=0.5),
        controllers={"pick_up": {"object": TARGET, **_fits(scene), **setup.grasp, **regions.ik(setup.robot, "ik.")}},
        command=CommandTerm(
            commands.uniform_position,
            params=dict(zip("xyz", setup.there.hold, strict=True)),
            resample_s=ONCE,
            targets=names,
        ),
        success=SuccessCfg(
            condition=Term(success.object_at_goal, params={"threshold": 0.02, **commanded}),
            distance=Term(success.object_distance, params=commanded),
        ),
        metrics=metrics.grasping(**held),
        observations={
            "state": ObservationGroup(state),
            "privileged_state": privileged(
                state, {"object_velocity": ObservationTerm(observations.object_velocity, params=commanded)}
            ),
        },
        events={
            "scatter": Term(
                events.scatter,
                params={
                    "objects": names,
                    "count": (LEAST, len(names)),
                    "x": setup.there.cube[0],
                    "y": setup.there.cube[1],
                    "pitch": setup.pitch,
                    "jitter": setup.jitter,
                    "away": (center[0] + AWAY, center[1] - AWAY),  # behind the cameras
                },
            ),
        },
        randomization={
            "masses": Term(randomization.mass, params={"bodies": names, "scale": MASSES}),
            **{f"{name}_size": Term(randomization.size, params={"object": name, "scale": SIZES}) for name in names},
            "colors": Term(randomization.color, params={"geoms": names}),
        },
        rewards={
            "reaching_object": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1, **commanded}),
            "holding_object": RewardTerm(rewards.object_is_held, weight=5.0, params=held),
            "goal_tracking": RewardTerm(rewards.held_goal_distance, weight=10.0, params={"std": 0.3, **held}),
            "goal_tracking_near": RewardTerm(rewards.held_goal_distance, weight=10.0, params={"std": 0.1, **held}),
            "goal_tracking_fine": RewardTerm(rewards.held_goal_distance, weight=15.0, params={"std": 0.03, **held}),
            "at_goal": RewardTerm(rewards.held_at_goal, weight=10.0, params={"threshold": 0.02, **held}),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        terminations={
            "time_out": DoneTerm(terminations.time_out, time_out=True),
            "object_off_table": DoneTerm(
                terminations.any_off_table,
                params={"center": center, "size": scene.table_size, "objects": names, "parked": AWAY / 2},
            ),
        },
    )


def _fits(scene: SceneCfg) -> dict[str, tuple[int, ...]]:
    """For the controller: which axis of an object lies across the opening of a hand that fits it, and in how many ways."""
    lying = {"box": 0, "can": 0, "sphere": 0, "capsule": 2}
    turns = {"box": 2, "can": 0, "sphere": 0, "capsule": 2}
    square = {name for name, item in scene.objects.items() if item.shape == "box" and item.size[0] == item.size[1]}
    return {
        "heading": tuple(lying[item.shape] for item in scene.objects.values()),
        "turns": tuple(4 if name in square else turns[item.shape] for name, item in scene.objects.items()),
    }


def presets() -> Presets:
    """Preset -> robot -> config; the default first."""
    return {"default": default, "four": four}
