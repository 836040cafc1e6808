"""Turn a knob to a commanded angle. For any robot with a gripper."""

import math

from mjx_nero.envs.task import EnvCfg, Presets, SuccessCfg
from mjx_nero.mdp import commands, fixtures
from mjx_nero.mdp.fixtures import Handle
from mjx_nero.mdp.terms import RewardTerm, Term
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks.handles import Task

WITHIN = math.radians(5)
ANGLES = (math.radians(30), math.radians(70))  # of the command, to either side
HANDLE = Handle("knob", "knob", "knob", lever=0.03)


def default(robot: RobotCfg) -> EnvCfg:
    """Success: the knob is within 5 degrees of the commanded angle, 30 to 70 degrees to either side."""
    task = Task(robot, "knob", HANDLE, level=True)
    held = {"handle": task.held}
    within = {"within": round(WITHIN, 5), **held}
    return task.cfg(
        success=SuccessCfg(
            condition=Term(fixtures.turned, params=within),
            distance=Term(fixtures.turning_way, params=held),
        ),
        moving={
            "turning": RewardTerm(fixtures.turning, weight=10.0, params={"std": 0.5, **held}),
            "turning_fine": RewardTerm(fixtures.turning, weight=5.0, params={"std": 0.1, **held}),
            "turned": RewardTerm(fixtures.is_turned, weight=10.0, params=within),
        },
        command=Term(commands.either_side, params={"size": tuple(round(x, 5) for x in ANGLES)}),
        limit=False,
        steps=150_000_000,
    )


PRESETS: Presets = {"default": default}
