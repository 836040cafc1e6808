"""AgileX Nero: seven joints and a parallel gripper."""

import dataclasses
import math

from mjx_nero.envs.task import Envs
from mjx_nero.sim.robot import DriveCfg, GripperCfg, RobotCfg
from mjx_nero.sim.scene import SceneCfg, cube
from mjx_nero.tasks import fitted, follow_target, handover, lift, lift_obstacles, pick_place, reach, reach_obstacles
from mjx_nero.tasks.arms import cobotta_pro_900

# Drives and home pose follow the Isaac Lab recipe for the Nero lift. No term of the task reads the recipe's soft limit factor
# (0.9), which would exclude its own home (joint4 = 2.0), so only the joint ranges limit the targets.
ROBOT = NERO = RobotCfg(
    name="nero",
    # Half a turn: positive joint4 folds the forearm towards the base's -x, and the work lies at +x (assets/nero/README.md).
    base_quat=(0.0, 0.0, 0.0, 1.0),
    workspace=((0.3, 0.4), (-0.2, 0.2), (0.2, 0.4)),
    opening=0.1,
    pad=(0.01, 0.023, 0.006),
    pick=((0.3, 0.4), (-0.1, 0.2), (0.02, 0.15)),
    hold=((0.3, 0.35), (-0.2, 0.2), (0.2, 0.35)),
    arm=DriveCfg(
        joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "joint7"),
        stiffness=(200.0, 170.0, 120.0, 80.0, 50.0, 20.0, 10.0),
        damping=(100.0, 60.0, 70.0, 24.0, 20.0, 10.0, 5.0),
        effort=(25.0,) * 7,
        speed=(1.5,) * 7,
        home=(0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0),
    ),
    gripper=GripperCfg(
        joints=("gripper_joint1", "gripper_joint2"),
        stiffness=(800.0, 800.0),
        damping=(20.0, 20.0),
        effort=(22.0, 22.0),
        speed=(1.5, 1.5),
        home=(0.05, -0.05),
        open=(0.05, -0.05),
        close=(0.0, -0.001),
    ),
)

# The Isaac Lab recipe's numbers. The cube's region is the recipe's start (0.2, 0) plus its offsets.
LIFT = lift.LiftSetup(
    scene=SceneCfg(objects={"cube": cube(0.03, mass=0.03)}),
    cube=((0.3, 0.4), (-0.1, 0.2)),
    goal=((0.3, 0.35), (-0.2, 0.2), (0.2, 0.35)),
)
FOLLOW_TARGET = follow_target.FollowTargetSetup(
    frame="ee",
    center=(0.32, 0.0, 0.17),  # the wrist's range lets the arm point straight down up to about z = 0.25
    spread=(0.02, 0.08, 0.02),
    radius=0.05,
    scene=SceneCfg(objects={}, goal="cube"),
)
PICK_PLACE = pick_place.PickPlaceSetup(
    scene=SceneCfg(goal="cube"),
    cube=((0.3, 0.4), (-0.1, 0.0)),
    goal=((0.3, 0.4), (0.08, 0.2)),
    travel_height=0.15,  # the wrist's range lets the arm point straight down up to about z = 0.2 there
    episode_length_s=20.0,
)
# With its fingers tilted forward by 30 degrees from straight down, the arm reaches every point of its workspace.
REACH = reach.ReachSetup(orientation=((math.pi, math.pi), (-math.pi / 6, -math.pi / 6), reach.STILL))
# The Isaac Lab recipe's drives for reaching, except for the speed. At the recipe's 10 rad/s, every change of an action drives the
# joints into their effort limits, and learning takes several times as long.
REACH_NERO = dataclasses.replace(
    NERO,
    arm=dataclasses.replace(
        NERO.arm,
        stiffness=(200.0, 200.0, 150.0, 150.0, 80.0, 80.0, 50.0),
        damping=(40.0, 40.0, 30.0, 15.0, 8.0, 8.0, 5.0),
        effort=(15.0,) * 7,
        speed=(2.0,) * 7,
    ),
)

# Farther apart than the recipe's regions, to leave room for the obstacle.
REACH_OBSTACLES = reach_obstacles.ReachObstaclesSetup(
    start=(0.33, -0.2), goal=((0.3, 0.4), (0.14, 0.24), (0.2, 0.35)), top=0.3, scene=LIFT.scene
)
LIFT_OBSTACLES = lift_obstacles.LiftObstaclesSetup(
    cube=((0.3, 0.38), (-0.22, -0.16)), goal=((0.3, 0.36), (0.14, 0.22), (0.18, 0.28)), top=0.18, scene=LIFT.scene
)

ENVS: Envs = fitted.envs(
    "nero",
    NERO,
    LIFT,
    REACH,
    FOLLOW_TARGET,
    PICK_PLACE,
    REACH_OBSTACLES,
    LIFT_OBSTACLES,
    reach=REACH_NERO,
    reach_obstacles=REACH_NERO,
)
ENVS |= {
    "nero_handover": (NERO, handover.PRESETS),
    "nero_cobotta_handover": (NERO, handover.taken_by(cobotta_pro_900.ROBOT)),
}
