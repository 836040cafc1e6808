"""Clutter: lift the commanded one of several objects of different shape, and hold it at a commanded point.

Three to six objects are on the table; with the preset ``four``, three or four objects of four shapes.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, EnvCfg, Presets
from mjx_nero.mdp import commands, events, metrics, observations, randomization, terminations
from mjx_nero.mdp.terms import ONCE, CommandTerm, DoneTerm, ObservationTerm, Term
from mjx_nero.sim import contacts, grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, SimCfg
from mjx_nero.tasks.lift import carrying
from mjx_nero.tasks.usual import SHOWN, arm_state, object_at_goal, observed, velocity_actions
from mjx_nero.types import TARGET

SIZES = (0.75, 1.15)  # range of the factor of an object's lengths
MASSES = (0.5, 2.0)  # range of the factor of its mass
DENSITY = 2000.0  # [kg/m3] stone: light round objects sink deep into the pads, which touch them at a point
LEAST = 3  # fewest objects on the table
MARGIN = 0.003  # [m] between an open hand and the nearest object
OPEN = 1.5  # opening of the hand in widths of the widest object: a wider hand would collide with the clutter
FOOT = 0.1  # [m] least distance of objects from the robot's axis
LIFTED = 0.005  # [m] held: at least this far above where the largest object of its shape rests
AWAY = 4.0  # [m] distance of parked objects from the table's centre

# Shape, lengths in units of the widest object's edge, and orientation. Long objects lie along x.
LYING = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
ROLLING: dict[str, Any] = {"friction": (1.0, 0.005, 0.002), "condim": 6}  # round objects would roll forever
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
    """Numbers that differ from robot to robot; lengths in m.

    Attributes:
        scene: the scene with all objects.
        robot: the robot, with a hand that opens as far as the objects need.
        there: its regions for grasping and holding.
        pitch, jitter: spacing of the objects (``events.scatter``).
        grasp: settings of the pick-up controller (``PickUpCfg``): ``lowest``, ``beyond``, ``aside`` and ``closing``.
        grasp_radius: greatest distance of a held object from the grasp point.
    """

    scene: SceneCfg
    robot: RobotCfg
    there: regions.Regions
    pitch: float
    jitter: float
    grasp: dict[str, Any]
    grasp_radius: float


def volume(item: ObjectCfg) -> float:
    """Volume of an object [m3]."""
    first, *rest = item.size
    if item.shape == "box":
        return float(np.prod(item.size))
    ends = 0.0 if item.shape in ("cylinder", "can") else 4 / 3 * np.pi * first**3
    return ends + np.pi * first**2 * sum(rest)


def extent(item: ObjectCfg) -> float:
    """Radius of a circle around the outline of a lying object, seen from above [m]."""
    first, *rest = item.size
    if item.shape == "box":
        return float(np.linalg.norm(item.size[:2])) / 2
    if item.shape in ("cylinder", "can"):
        return first
    return first + (rest[0] / 2 if rest else 0.0)


def across(item: ObjectCfg) -> float:
    """Width of an object between the pads of a well-aligned hand [m]."""
    first, *rest = item.size
    return min(first, *rest[:1]) if item.shape == "box" else 2 * first


def fitted(robot: RobotCfg, names: Iterable[str] = SHAPES) -> ClutterSetup:
    """Derives the setup from the robot's gripper and regions.

    Raises:
        UserError: the regions are unknown (``regions.of``), or the hand cannot close on all objects.
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
            "aside": tuple(grasp.aside(robot, SIZES[1] * across(item) + 2 * grasp.BESIDE) for item in objects.values()),
            "closing": grasp.closing(robot, thinnest, grasp.QUICK),
        },
        grasp_radius=regions.near(there),
    )


def _object(unit: float, size: tuple[float, ...], **fields) -> ObjectCfg:
    item = ObjectCfg(size=tuple(round(unit * length, 4) for length in size), **fields)
    return dataclasses.replace(item, mass=float(f"{DENSITY * volume(item):.3g}"))


def default(robot: RobotCfg) -> EnvCfg:
    """Three to six of six objects."""
    return _clutter(fitted(robot))


def four(robot: RobotCfg) -> EnvCfg:
    """Three or four objects, one of each shape."""
    return _clutter(fitted(robot, ("box", "cylinder", "sphere", "capsule")))


# Long: a task is one list, to read as one.
def _clutter(setup: ClutterSetup) -> EnvCfg:
    """Lift's rewards for the commanded object. The others may be touched, but must stay on the table."""
    scene, names, commanded = setup.scene, tuple(setup.scene.objects), {"object": TARGET}
    heights = tuple(round(SIZES[1] * item.rest_height + LIFTED, 4) for item in scene.objects.values())
    held = {"minimal_height": heights, "grasp_radius": setup.grasp_radius, **commanded}
    center = scene.table_center
    state = {
        **arm_state(),
        "ee_orientation": ObservationTerm(observations.ee_orientation),
        "ee_to_object": ObservationTerm(observations.ee_to_object, params=commanded, noise=0.002),
        "object_orientation": ObservationTerm(observations.object_orientation, params=commanded, noise=0.01),
        "object_to_goal": ObservationTerm(observations.object_to_goal, params=commanded, noise=0.002),
        "target_object_position": ObservationTerm(observations.command),
        "ee_to_objects": ObservationTerm(observations.ee_to_objects, params={"objects": names, "limit": 0.3}, noise=0.002),
        "actions": ObservationTerm(observations.last_action),
    }
    return EnvCfg(
        robot=dataclasses.replace(setup.robot, gravity_compensation=True),  # a robot's own controller does this
        scene=scene,
        # At lift's step of 10 ms, light round objects jump out of small pads. Nero's scripted expert lost 30 of 64 objects at
        # 10 ms, 5 at 5 ms with slower motions, and 2 at 2.5 ms.
        # With MuJoCo's softer friction, round objects creep out of the fingers within seconds. Jerks of stiff drives shake them.
        sim=contacts.crowded(setup.robot, scene, SimCfg(dt=0.005, decimation=4, impratio=30.0, ramp=setup.robot.max_step > 0)),
        episode_length_s=8.0,
        actions=velocity_actions(hysteresis=0.5),
        controllers={"pick_up": {"object": TARGET, **_fits(scene), **setup.grasp, **regions.ik(setup.robot, "ik.")}},
        command=CommandTerm(
            commands.uniform_position,
            params=dict(zip("xyz", setup.there.hold, strict=True)),
            resample_s=ONCE,
            targets=names,
        ),
        success=object_at_goal(**commanded),
        metrics=metrics.grasping(**held),
        observations=observed(state, **commanded),
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
        rewards=carrying(held, **commanded),
        training={**SHOWN, "averaging": 0.9},
        budget=Budget(steps=45_000_000),
        terminations={
            "time_out": DoneTerm(terminations.time_out, time_out=True),
            "object_off_table": DoneTerm(
                terminations.any_off_table,
                params={"center": center, "size": scene.table_size, "objects": names, "parked": AWAY / 2},
            ),
        },
    )


def _fits(scene: SceneCfg) -> dict[str, tuple[int, ...]]:
    """Says which axis of each object lies across the hand's opening, and how many turns about the vertical look the same."""
    lying = {"box": 0, "can": 0, "sphere": 0, "capsule": 2}
    turns = {"box": 2, "can": 0, "sphere": 0, "capsule": 2}
    square = {name for name, item in scene.objects.items() if item.shape == "box" and item.size[0] == item.size[1]}
    return {
        "heading": tuple(lying[item.shape] for item in scene.objects.values()),
        "turns": tuple(4 if name in square else turns[item.shape] for name, item in scene.objects.items()),
    }


PRESETS: Presets = {"default": default, "four": four}
