"""Force and torque at the wrist, and the forces at the fingers' pads, measured in the last physics step of a control step.

The wrist's readings are MuJoCo's force and torque sensors: what the arm exerts on the hand, in the axes of the flange, including
the hand's own weight and inertia. A pad's reading is the net force of its contacts. ``mdp.sensors.Gauge`` has the errors of real
sensors.
"""

from collections.abc import Collection
from typing import Any

import mujoco

from mjx_nero.sim import touch
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError

WRIST, FINGERS = "wrist", "fingers"  # the readings, and the prefixes of their sensors' names


def add(spec: mujoco.MjSpec, robot: RobotCfg, names: Collection[str]) -> None:
    """Adds the sensors of the robot's wrist and of its pads, if they are named.

    Raises:
        UserError: the robot has no pads to measure at.
    """
    if WRIST in names:
        site = _hand(spec, robot).add_site(name=WRIST, size=[1e-3, 1e-3, 1e-3], rgba=[0, 0, 0, 0], group=5)
        for kind in ("force", "torque"):
            measures = getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}")
            spec.add_sensor(name=f"{WRIST}:{kind}", type=measures, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site.name)
    if FINGERS not in names:
        return
    base = spec.body(robot.base_link)
    pads = [geom for geom in base.find_all(mujoco.mjtObj.mjOBJ_GEOM) if "pad" in geom.name and geom.conaffinity]
    if not pads:
        raise UserError(f"the sensor 'fingers' measures at shapes with 'pad' in their names, but {robot.name} has none")
    for geom in pads:
        touch.add_sensor(spec, geom.name, reading=FINGERS, reduce=touch.NET)


def _hand(spec: mujoco.MjSpec, robot: RobotCfg) -> Any:
    """The first body beyond the link that the arm's last joint moves; that link itself if it is the hand."""
    last = spec.joint(robot.arm.joints[-1]).parent
    site = spec.site(robot.ee_site)
    body = beyond = site.parent if site is not None else spec.body(robot.ee_site)
    while body.name != last.name and body.name != "world":
        body, beyond = body.parent, body
    return beyond if body.name == last.name else last
