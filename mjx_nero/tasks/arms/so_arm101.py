"""SO-ARM101: the SO-ARM100's successor, with the same drives and jaws."""

import dataclasses

from mjx_nero.envs.task import Envs
from mjx_nero.tasks import lift, reach
from mjx_nero.tasks.arms.so_arm100 import SCENE, SO_ARM100, so_arm

# Mounting and home: the Isaac Lab recipe's.
ROBOT = SO_ARM101 = dataclasses.replace(
    SO_ARM100,
    name="so_arm101",
    base_link="base_link",
    base_quat=(1.0, 0.0, 0.0, 0.0),
    hold=((0.15, 0.3), (-0.1, 0.1), (0.2, 0.35)),
    arm=dataclasses.replace(SO_ARM100.arm, home=(0.0, 0.0, 0.0, 1.57, 0.0)),
)

# The recipe keeps the SO-ARM100's goals. For this unturned arm they lie to its right, and partly out of reach (92% of the lift
# goals and 87% of the reach goals are within). Ours lie ahead, as the SO-ARM100's do.
LIFT = lift.LiftSetup(
    scene=SCENE,
    cube=((0.1, 0.3), (-0.2, 0.2)),
    goal=((0.15, 0.3), (-0.1, 0.1), (0.2, 0.35)),
    grasp_radius=0.02,
)
REACH = reach.ReachSetup(scene=reach.scene(SCENE))

ENVS: Envs = so_arm("so101", SO_ARM101, LIFT, REACH)
