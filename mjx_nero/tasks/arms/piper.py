"""AgileX Piper: six joints and the Nero's gripper."""

import dataclasses
import math

from mjx_nero.envs.task import Envs
from mjx_nero.sim.robot import DriveCfg, RobotCfg
from mjx_nero.sim.scene import SceneCfg, cube
from mjx_nero.tasks import fitted, lift, lift_obstacles, reach, reach_obstacles
from mjx_nero.tasks.arms.nero import NERO

# Drives: the Isaac Lab recipe's, except for the speed. At the recipe's 10 rad/s, every change of an action drives the joints into
# their effort limits. Home: the grasp point at (0.3, 0, 0.22), 25 degrees from straight down (assets/piper/README.md).
ROBOT = PIPER = RobotCfg(
    name="piper",
    down=(0.0, 0.0, 1.0, 0.0),
    gravity_compensation=True,
    workspace=((0.3, 0.4), (-0.2, 0.2), (0.2, 0.4)),
    opening=NERO.opening,
    pad=NERO.pad,
    pick=((0.19, 0.27), (-0.12, 0.12), (0.02, 0.12)),
    hold=NERO.hold,
    arm=DriveCfg(
        joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6"),
        stiffness=(200.0, 200.0, 150.0, 150.0, 80.0, 80.0),
        damping=(40.0, 40.0, 30.0, 15.0, 8.0, 8.0),
        effort=(15.0,) * 6,
        speed=(2.0,) * 6,
        home=(0.0, 1.29, -1.161, 0.0, 1.1, 0.0),
    ),
    gripper=NERO.gripper,
)

LIFT = lift.LiftSetup(  # Nero's regions
    scene=SceneCfg(objects={"cube": cube(0.03, mass=0.03)}),
    cube=((0.3, 0.4), (-0.1, 0.2)),
    goal=((0.3, 0.35), (-0.2, 0.2), (0.2, 0.35)),
)
# The recipe's box, its level gripper along +x, and its home, nearly level too. From the other home, fingers down, learning ends
# with the wrist bent the wrong way.
REACH_PIPER = dataclasses.replace(PIPER, arm=dataclasses.replace(PIPER.arm, home=(0.0,) * 6))
REACH = reach.ReachSetup(
    position=((0.3, 0.4), (0.1, 0.15), (0.3, 0.3)),
    orientation=(reach.STILL, (math.pi / 2, math.pi / 2), reach.STILL),
    decimation=1,
    episode_length_s=6.0,
)

# Farther apart than the recipe's regions, to leave room for the obstacle.
REACH_OBSTACLES = reach_obstacles.ReachObstaclesSetup(
    start=(0.3, -0.2), goal=((0.28, 0.38), (0.14, 0.24), (0.2, 0.35)), top=0.3, scene=LIFT.scene
)
LIFT_OBSTACLES = lift_obstacles.LiftObstaclesSetup(
    cube=((0.2, 0.26), (-0.22, -0.16)), goal=((0.28, 0.36), (0.14, 0.22), (0.18, 0.28)), top=0.18, scene=LIFT.scene
)

ENVS: Envs = fitted.envs("piper", PIPER, LIFT, REACH, REACH_OBSTACLES, LIFT_OBSTACLES, reach=REACH_PIPER)
