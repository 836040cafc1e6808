"""Open a door: swing it open by 60 degrees. For any robot with a gripper."""

import math

from mjx_nero.envs.task import EnvCfg, Presets
from mjx_nero.mdp.fixtures import Handle
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks.handles import Task

ANGLE = math.radians(60)
HANDLE = Handle("cabinet", "door", "door_handle", target=round(ANGLE, 5), lever=0.182)


def default(robot: RobotCfg) -> EnvCfg:
    """Success: the door is open by 60 degrees."""
    # The handle's arc runs 14 cm to the right. The round bar turns in the hand, which makes half of the door's turn.
    task = Task(robot, "cabinet", HANDLE, middle=0.07, follow=0.5, beyond=0.1)
    return task.opening()


PRESETS: Presets = {"default": default}
