"""Grasping of mesh objects: how they are held, when they count as lifted, and the script that picks them up."""

from typing import Any

from mjx_nero.envs import regions
from mjx_nero.sim import grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg

LIFTED = 0.01  # [m] height of the lowest point of a lifted thing
NEAR = 0.03  # [m] greatest distance of the grasp point from the box around a held thing
THINNEST = 0.006  # [m] thinnest part that the script's fingers close on
GRIP: dict[str, Any] = {"friction": (1.0, 0.01, 0.001), "condim": 4}  # without torsion, things turn about the line of contacts


def expert(robot: RobotCfg, object: str, item: ObjectCfg) -> dict[str, dict[str, Any]]:
    """Builds the settings of the script that picks things up by their own grasps."""
    fields = {
        "object": object,
        "files": (item.file, *item.bank),
        "scale": item.scale,
        "lowest": grasp.lowest(robot.pad),
        "beyond": grasp.beyond(robot, grasp.cube_for(robot).size[0]),
        "closing": grasp.closing(robot, THINNEST),
    }
    return {"grasp_thing": {**fields, **regions.ik(robot, "ik.")}}
