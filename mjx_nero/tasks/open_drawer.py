"""Open a drawer: pull it out by most of its travel. For any robot with a gripper."""

import functools

from mjx_nero.envs.task import EnvCfg, Presets
from mjx_nero.mdp.fixtures import Handle
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks import handles
from mjx_nero.tasks.handles import Place, Task

MOST = 0.8  # share of the drawer's travel
HANDLE = Handle("cabinet", "drawer", "drawer_handle", target=MOST, share=True)


def default(robot: RobotCfg, place: Place | None = None) -> EnvCfg:
    """Success: the drawer is open by four fifths of its travel."""
    task = Task(robot, place or handles.place(robot), "cabinet", HANDLE, beyond=0.1)
    return task.opening()


def presets(place: Place | None = None) -> Presets:
    """Maps preset -> robot -> config, the default first."""
    return {"default": functools.partial(default, place=place)}
