"""Scenes of several robots. ``cfg.robot`` is the first; ``SceneCfg.robots`` has the others by name.

In the scene, ``joint1`` of a robot called ``taker`` is ``taker/joint1``. The joints of the scene are those of the first robot,
arm first, then those of each other robot in the same order.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping

import mujoco

from mjx_nero.sim import robot_file, touch
from mjx_nero.sim.robot import DriveCfg, RobotCfg
from mjx_nero.types import UserError

APART = 0.15  # [m] bases closer than this overlap

Robots = Mapping[str, RobotCfg]


def named(name: str, robot: RobotCfg) -> RobotCfg:
    """Returns a robot with the names that a scene gives to its joints and bodies; an empty name changes nothing."""
    if not name:
        return robot

    def drive(cfg: DriveCfg):
        return dataclasses.replace(cfg, joints=tuple(f"{name}/{joint}" for joint in cfg.joints))

    return dataclasses.replace(
        robot,
        arm=drive(robot.arm),
        gripper=drive(robot.gripper),
        ee_site=f"{name}/{robot.ee_site}",
        base_link=f"{name}/{robot.base_link}",
    )


def of(robot: RobotCfg, others: Robots) -> dict[str, RobotCfg]:
    """Lists all robots of a scene by name, as the scene names their parts. The first one's name is empty."""
    return {"": robot, **{name: named(name, other) for name, other in others.items()}}


def joints(team: Robots) -> tuple[str, ...]:
    """Names of all joints, in the order of ``ctrl``."""
    return tuple(joint for robot in team.values() for joint in robot.joints)


def drives(team: Robots) -> dict[str, DriveCfg]:
    """Groups of drives by name, in the order of ``ctrl``: ``arm`` and ``gripper``, then ``taker/arm`` and ``taker/gripper``."""
    groups = [(name, kind, getattr(robot, kind)) for name, robot in team.items() for kind in ("arm", "gripper")]
    return {f"{name}/{kind}" if name else kind: drive for name, kind, drive in groups}


def home(team: Robots) -> tuple[float, ...]:
    """Home position of all joints [rad or m]."""
    return tuple(at for robot in team.values() for at in robot.home)


def check(robot: RobotCfg, others: Robots, things: Iterable[str]) -> None:
    """Checks the robots' names and places.

    Args:
        things: names of everything else in the scene.

    Raises:
        UserError: a name is taken or impossible, or two bases overlap.
    """
    taken = set(things)
    for name in others:
        if not name or "/" in name or not name.isprintable():
            raise UserError(f"scene.robots.{name!r} is not a name: use one word, without a slash")
        if name in taken:
            raise UserError(f"scene.robots.{name} needs another name: something else in the scene has it already")
    feet = {"the first robot": robot.base_pos, **{name: other.base_pos for name, other in others.items()}}
    for (first, a), (second, b) in itertools.combinations(feet.items(), 2):
        if math.dist(a, b) < APART:
            far = f"{math.dist(a, b):.3g} m from one another"
            raise UserError(
                f"scene.robots: {first} and {second} stand {far}: give one another base_pos, at least {APART:g} m away"
            )


def alone(robots: Robots, what: str) -> None:
    """Refuses scenes of several robots; ``robots`` are those besides the first.

    Raises:
        UserError: there are others, which ``what`` does not support.
    """
    if robots:
        raise UserError(f"{what} supports only scenes of one robot, but this one also has {', '.join(robots)}")


def add(spec: mujoco.MjSpec, others: Robots, whole: bool) -> None:
    """Adds the other robots to a scene.

    Args:
        whole: keeps the shapes that only meet obstacles.
    """
    for name, robot in others.items():
        spec.attach(mounted(robot, whole), prefix=f"{name}/", frame=spec.worldbody.add_frame())


def mounted(robot: RobotCfg, whole: bool = False) -> mujoco.MjSpec:
    """Reads and mounts a robot. ``whole`` keeps the shapes that only meet obstacles."""
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
