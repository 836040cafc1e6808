"""Insert peg: pick up a standing peg, and put it into the hole of a block. For any robot with a gripper.

The policy knows the block's pose to a millimetre and half a degree, and feels the rest by its wrist and its fingers. The peg is
square, or round with a rounded end.
"""

import functools
import math

from mjx_nero.envs.task import CurriculumCfg, EnvCfg, Presets
from mjx_nero.sim import grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.fixtures import FixtureCfg
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg
from mjx_nero.tasks import putting
from mjx_nero.tasks.putting import Putting
from mjx_nero.tasks.usual import PRECISE

HOLE, DEEP = 0.026, 0.025  # [m] width and depth of the hole (assets/fixtures/make.py)
LONG = 0.065  # [m] length of the peg
LOOSE, TIGHT = 0.002, 0.0005  # [m] how much wider the hole is than the peg
OFF, TURN = 0.001, 0.01  # [m, rad] greatest errors of the block's given pose
DENSITY = 1000.0  # [kg/m3]
OVER = 0.01  # [m] height over the block at which the script carries the peg
ABOVE = 0.025  # [m] height above the peg from which the hand descends; a hand that lags would knock the peg over
PRESS = 0.002  # [m] how far the script presses onto the rim
DONE = 0.005  # [m] height over the bottom at which the hand lets go: pads that slipped down the peg stand on the block
AWAY = 0.08  # [m] how far the hand rises once it has let go


def peg(width: float, square: bool) -> ObjectCfg:
    """Makes a standing plastic peg."""
    shape, size = ("box", (width, width, LONG)) if square else ("can", (width / 2, LONG))
    area = (1.0 if square else math.pi / 4) * width**2
    return ObjectCfg(shape=shape, size=tuple(round(x, 6) for x in size), mass=float(f"{DENSITY * area * LONG:.3g}"))


def inserting(robot: RobotCfg, clearance: float = LOOSE, square: bool = True) -> EnvCfg:
    """Success: the peg stands on the bottom of the hole, at rest, and the pads touch nothing."""
    width = round(HOLE - clearance, 6)
    robot, file = putting.hand(robot, width), "socket_square" if square else "socket_round"
    scene = SceneCfg(
        objects={"peg": peg(width, square)}, fixtures={"socket": FixtureCfg(file)}, sensors=("wrist", "fingers"), goal="none"
    )
    task = Putting(
        robot,
        scenes.around(robot, scene),
        ("socket/hole", "peg"),
        edge=LONG,
        aside=0.003,
        rise=LONG / 2,
        top=DEEP + 0.005,
        off=OFF,
        turn=TURN if square else 0.0,
        fold=4 if square else 0,
    )
    grip = putting.picking(task.builder, width, DEEP + grasp.lowest(robot.pad), LONG + ABOVE, object="peg", turns=(task.fold,))
    put = {**grip, "foot": LONG / 2, "over": DEEP + OVER, "top": DEEP, "turns": task.fold, "reach": 0.002}
    put |= {"press": PRESS, "done": DONE, "away": AWAY}
    # Training that begins in the expert's states, a moment before success, unlearns the way there.
    return task.cfg({"put_in": put}, training={**PRECISE, "max_std": 0.15}, curriculum=CurriculumCfg())


PRESETS: Presets = {
    "default": inserting,
    "tight": functools.partial(inserting, clearance=TIGHT),
    "round": functools.partial(inserting, square=False),
    "round_tight": functools.partial(inserting, clearance=TIGHT, square=False),
}
