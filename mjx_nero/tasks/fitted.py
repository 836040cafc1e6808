"""Tasks for any robot: positions, goals and sizes follow from what the robot can do."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_nero.config.bounds import Range
from mjx_nero.envs import regions
from mjx_nero.envs.task import EnvCfg, Envs, Presets
from mjx_nero.sim import grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg
from mjx_nero.tasks import (
    clutter,
    follow_target,
    handover,
    hang_ring,
    insert_peg,
    lift,
    lift_any,
    lift_obstacles,
    open_door,
    open_drawer,
    pick_place,
    place,
    push,
    reach,
    reach_obstacles,
    reorient,
    stack,
    turn_knob,
)

OPEN = 2.0  # opening in units of the cube's edge
SLOW = 0.3  # [s] closing times above this are slow


def lift_setup(robot: RobotCfg) -> lift.LiftSetup:
    """The cube starts anywhere in ``pick``, and its goal is anywhere in ``hold``."""
    there = regions.of(robot)
    return lift.LiftSetup(
        scene=regions.scene(robot, "sphere"), cube=there.cube, goal=there.hold, grasp_radius=regions.near(there)
    )


def pick_place_setup(robot: RobotCfg) -> pick_place.PickPlaceSetup:
    """The cube starts in the right half of ``pick``, and its place is in the left half, with a gap of one edge."""
    there, edge = regions.of(robot), grasp.cube_for(robot).size[0]

    def split(side: Range) -> tuple[Range, Range]:
        low, high = side
        middle, apart = (low + high) / 2, min(edge, (high - low) / 2) / 2
        return regions.span(low, middle - apart), regions.span(middle + apart, high)

    return pick_place.PickPlaceSetup(
        scene=regions.scene(robot, "cube"),
        cube=(there.cube[0], split(there.cube[1])[0]),
        goal=(there.place[0], split(there.place[1])[1]),
        travel_height=there.travel,
        episode_length_s=20.0,
        grasp_radius=regions.near(there),
    )


def follow_target_setup(robot: RobotCfg) -> follow_target.FollowTargetSetup:
    """The target circles within ``pick``, or within ``workspace`` if the robot cannot grasp."""
    box = np.array(robot.pick or regions.box(robot, "workspace", "where it can work"))
    half = np.ptp(box, axis=1) / 2
    (x, y, z), radius = (round(float(v), 4) for v in box.mean(1)), round(float(half[1:].min() / 2), 4)
    return follow_target.FollowTargetSetup(
        frame=robot.ee_site,
        center=(x, y, z),
        spread=(round(float(half[0] / 2), 4), round(float(half[1] / 2), 4), 0.0),
        radius=radius,
        scene=scenes.around(robot, SceneCfg(objects={}, goal="cube")),
    )


def _lift(robot: RobotCfg, factory: Callable[[RobotCfg, lift.LiftSetup], EnvCfg]) -> EnvCfg:
    """Slow fingers get extra time to close, and the goal stays where it is as much longer."""
    setup, ready = lift_setup(robot), _ready(robot)
    cfg, late = factory(ready, setup), _late(ready)
    command = dataclasses.replace(cfg.command, resample_s=round(cfg.command.resample_s + late, 2))
    return dataclasses.replace(cfg, episode_length_s=round(cfg.episode_length_s + late, 2), command=command)


def _tower(robot: RobotCfg, factory: Callable[[RobotCfg], EnvCfg]) -> EnvCfg:
    return factory(_ready(robot))


def _ready(robot: RobotCfg) -> RobotCfg:
    """Opens slow fingers no further than a cube needs.

    A jaw that turns by 85 degrees before it meets a cube seldom grasps one by chance, and learning starts from chance grasps.
    """
    edge = grasp.cube_for(robot).size[0]
    return grasp.opened(robot, OPEN * edge) if grasp.closing_time(robot, edge) > SLOW else robot


def _late(robot: RobotCfg) -> float:
    """Extra time that slow fingers need to close on the cube [s]."""
    return max(0.0, round(grasp.closing_time(robot, grasp.cube_for(robot).size[0]) - SLOW, 2))


def _pick_place(robot: RobotCfg) -> EnvCfg:
    """Uses inverse kinematics, since RMPflow needs files for the robot. Slow fingers get extra time to close."""
    robot = _even(_ready(robot))
    setup, late = pick_place_setup(robot), _late(robot)
    cfg = pick_place.default(robot, dataclasses.replace(setup, episode_length_s=round(setup.episode_length_s + 2 * late, 2)))
    fields = {**cfg.controllers["pick_place"], "end_effector_offset": regions.of(robot).offset, "motion": "ik", "wait": late}
    return dataclasses.replace(cfg, controllers={"pick_place": {**fields, **regions.ik(robot, "ik.")}})


def _even(robot: RobotCfg) -> RobotCfg:
    """Limits how far separately driven fingers close, so that their full effort just suffices.

    Drives that push against each other far beyond their effort let an object drift sideways. Within it, they centre the object
    like springs.
    """
    fingers, held = robot.gripper, grasp.opened(robot, grasp.cube_for(robot).size[0]).gripper.open
    if len(fingers.joints) < 2:
        return robot
    pressed = [effort / stiffness for effort, stiffness in zip(fingers.effort, fingers.stiffness, strict=True)]
    close = (
        float(np.clip(at + np.sign(shut - at) * by, min(at, shut), max(at, shut)))
        for at, by, shut in zip(held, pressed, fingers.close, strict=True)
    )
    return dataclasses.replace(robot, gripper=dataclasses.replace(fingers, close=tuple(round(q, 5) for q in close)))


def _follow_target(robot: RobotCfg, factory: Callable[[RobotCfg, follow_target.FollowTargetSetup], EnvCfg]) -> EnvCfg:
    return dataclasses.replace(factory(robot, follow_target_setup(robot)), controllers={"ik": regions.ik(robot)})


def _presets(fit: Callable, **factories: Callable) -> Presets:
    return {name: functools.partial(fit, factory=factory) for name, factory in factories.items()}


# These tasks take all they need from the robot, so ``nero_place`` and ``place --robot nero`` are the same task. For the other
# tasks an arm may have its own numbers, as ``nero_lift`` has those of its recipe.
FITTING: dict[str, Presets] = {
    "clutter": clutter.PRESETS,
    "open_drawer": open_drawer.PRESETS,
    "open_door": open_door.PRESETS,
    "turn_knob": turn_knob.PRESETS,
    "lift_any": lift_any.PRESETS,
    "insert_peg": insert_peg.PRESETS,
    "hang_ring": hang_ring.PRESETS,
    "reorient": reorient.PRESETS,
    "push": push.PRESETS,
    "place": _presets(_tower, **place.PRESETS),
    "stack": _presets(_tower, **stack.PRESETS),
}


# Tasks for which an arm may bring its own numbers.
SETUPS: dict[type, tuple[str, Callable[..., Presets]]] = {
    lift.LiftSetup: ("lift", lift.presets),
    reach.ReachSetup: ("reach", reach.presets),
    follow_target.FollowTargetSetup: ("follow_target", follow_target.presets),
    pick_place.PickPlaceSetup: ("pick_place", pick_place.presets),
    reach_obstacles.ReachObstaclesSetup: ("reach_obstacles", reach_obstacles.presets),
    lift_obstacles.LiftObstaclesSetup: ("lift_obstacles", lift_obstacles.presets),
}


def envs(prefix: str, robot: RobotCfg, *setups: Any, **others: RobotCfg) -> Envs:
    """Lists an arm's environments: those of its setups, then those of ``FITTING``.

    Args:
        others: by task, a robot that differs from the arm's usual one, such as one with other drives.
    """
    own = {name: presets(setup) for setup in setups for name, presets in [SETUPS[type(setup)]]}
    return {f"{prefix}_{task}": (others.get(task, robot), presets) for task, presets in {**own, **FITTING}.items()}


ENVS: Envs = {
    "reach": (None, reach.presets()),
    "lift": (None, _presets(_lift, default=lift.default, isaac=lift.isaac, sim2real=lift.sim2real, **lift.SEEN)),
    "follow_target": (None, _presets(_follow_target, default=follow_target.default, static=follow_target.static)),
    "pick_place": (None, {"default": _pick_place}),
    "reach_obstacles": (None, reach_obstacles.presets()),
    "lift_obstacles": (None, lift_obstacles.presets()),
    **{name: (None, presets) for name, presets in FITTING.items()},
    "handover": (None, handover.PRESETS),
}
