"""Classical control: pure functions for one robot, vmapped for many."""

from collections.abc import Mapping
from typing import Any

from mjx_nero import config
from mjx_nero.config.registry import Registry
from mjx_nero.control.controller import Controller
from mjx_nero.control.detour import CarryPast, CarryPastCfg, Detour, DetourCfg
from mjx_nero.control.follow_joint import FollowJoint, FollowJointCfg
from mjx_nero.control.follow_target import IkFollower, RmpCfg, RmpFollower
from mjx_nero.control.grasp_thing import GraspThing, GraspThingCfg
from mjx_nero.control.hand_over import HandOver, HandOverCfg
from mjx_nero.control.ik import IkCfg
from mjx_nero.control.pick_place import PickPlace, PickPlaceCfg
from mjx_nero.control.pick_up import PickUp, PickUpCfg
from mjx_nero.control.put_in import PutIn, PutInCfg, PutThing, PutThingCfg
from mjx_nero.control.turn_over import TurnOver, TurnOverCfg
from mjx_nero.sim.robot import RobotCfg

# name -> (class, its config). The class takes (robot, dt, config), and in a scene of several robots also the others by name.
CONTROLLERS: Registry[tuple[Any, Any]] = Registry(
    "controller",
    {
        "ik": (IkFollower, IkCfg()),
        "rmpflow": (RmpFollower, RmpCfg()),
        "pick_place": (PickPlace, PickPlaceCfg()),
        "detour": (Detour, DetourCfg()),
        "carry": (CarryPast, CarryPastCfg()),
        "pick_up": (PickUp, PickUpCfg()),
        "follow_joint": (FollowJoint, FollowJointCfg()),
        "grasp_thing": (GraspThing, GraspThingCfg()),
        "put_in": (PutIn, PutInCfg()),
        "put_thing": (PutThing, PutThingCfg()),
        "turn_over": (TurnOver, TurnOverCfg()),
        "hand_over": (HandOver, HandOverCfg()),
    },
)


def make(
    name: str,
    robot: RobotCfg,
    dt: float,
    overrides: Mapping[str, Any] | None = None,
    others: Mapping[str, RobotCfg] | None = None,
) -> Controller:
    """Makes a controller by name.

    Args:
        name: one of ``CONTROLLERS``.
        dt: control step [s].
        overrides: fields of its config by dotted name.
        others: further robots of the scene by name, each as in its own file.

    Raises:
        UserError: unknown name or field, or a value that the controller refuses.
    """
    kind, default = CONTROLLERS.find(name)
    return kind(robot, dt, config.override(default, overrides or {}), *([others] if others else []))
