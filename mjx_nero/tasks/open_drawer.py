"""Open a drawer: pull it out by most of its travel. For any robot with a gripper."""

from mjx_nero.envs.task import EnvCfg, Presets
from mjx_nero.mdp.fixtures import Handle
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks.handles import Task

MOST = 0.8  # share of the drawer's travel
HANDLE = Handle("cabinet", "drawer", "drawer_handle", target=MOST, share=True)


def default(robot: RobotCfg) -> EnvCfg:
    """Success: the drawer is open by four fifths of its travel."""
    task = Task(robot, "cabinet", HANDLE, beyond=0.1)
    return task.opening()


PRESETS: Presets = {"default": default}
