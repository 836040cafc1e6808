"""Hang ring: pick a ring up from the table, and hang it over the post of a stand. For any robot with a gripper."""

from mjx_nero.envs.task import EnvCfg, Presets
from mjx_nero.sim import grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.fixtures import FixtureCfg
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg
from mjx_nero.tasks import lift_any, putting
from mjx_nero.tasks.putting import Putting
from mjx_nero.tasks.usual import PRECISE

THICK, WALL = 0.018, 0.015  # [m] thickness of the ring and of its wall (assets/objects/make.py)
TIP = 0.038  # [m] height of the post's tip over the bars on which the ring ends up (assets/fixtures/stand)
ROOM = 0.016  # [m] greatest distance between the middles of a post and a ring around it: the play is 15 mm
LIFTED = 0.003  # [m] added to half its thickness: height of the lowest point of a lifted ring
PRESS = 0.008  # [m] how far the script presses onto the post, which the ring seldom hits
OFF = 0.003  # [m] greatest error of the stand's given position


def default(robot: RobotCfg) -> EnvCfg:
    """Success: the ring lies around the post on the bars, at rest, and the pads touch nothing."""
    robot = grasp.shut(robot, WALL)
    ring = ObjectCfg(shape="mesh", file="ring", **lift_any.GRIP)
    scene = SceneCfg(objects={"ring": ring}, fixtures={"stand": FixtureCfg("stand")}, sensors=("wrist", "fingers"), goal="none")
    task = Putting(
        robot,
        scenes.around(robot, scene),
        ("stand/post", "ring"),
        edge=THICK,
        aside=ROOM,
        lifted=LIFTED,
        rise=THICK / 2,
        top=TIP + 0.005,
        off=OFF,
    )
    grip = lift_any.expert(task.builder, "ring", ring)["grasp_thing"]
    fields = {**grip, **putting.TIGHT, "above": TIP + 0.035}
    put = {
        **{f"pick.{name}": value for name, value in fields.items()},
        "over": TIP + 0.01,
        "top": TIP,
        "done": 0.004,
        "press": PRESS,
    }
    return task.cfg({"put_thing": put}, training=PRECISE)


PRESETS: Presets = {"default": default}
