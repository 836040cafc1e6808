"""DENSO Cobotta Pro 900 with the OnRobot RG6: six joints and a gripper whose fingers a linkage keeps parallel."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero.envs.task import Envs
from mjx_nero.sim.robot import DriveCfg, GripperCfg, RobotCfg
from mjx_nero.sim.scene import SceneCfg, cube
from mjx_nero.tasks import fitted, follow_target, lift, lift_obstacles, pick_place, reach, reach_obstacles

# OnRobot RG6: parallel cranks of 80 mm (assets/cobotta_pro_900/README.md).
_CRANK, _CLOSED_ANGLE, _OFFSET = 0.08, 0.6331, 0.000488


def rg6_gap(q: Float[Array, "2"]) -> Float[Array, ""]:
    """Distance between the pads [m] at the two driven joints' positions [rad]; 0 to 0.151."""
    left, right = (_CRANK * jnp.sin(_CLOSED_ANGLE - angle) - _OFFSET for angle in (q[0], -q[1]))
    return left + right


def rg6_positions(gap: Float[Array, ""]) -> Float[Array, "2"]:
    """Positions of the two driven joints [rad] at which the pads are ``gap`` [m] apart."""
    q = _CLOSED_ANGLE - jnp.arcsin((gap / 2 + _OFFSET) / _CRANK)
    return jnp.stack([q, -q])


# Stiffness and damping: critical damping at home, from measured step responses (assets/cobotta_pro_900/README.md). Speeds: half
# of the published ones, for collaboration. Home: the grasp point at (0.5, 0, 0.28), straight down, fingers opening along y.
ROBOT = COBOTTA_PRO_900 = RobotCfg(
    name="cobotta_pro_900",
    down=(0.0, 0.0, 1.0, 0.0),
    gravity_compensation=True,
    workspace=((0.4, 0.6), (-0.3, 0.3), (0.15, 0.5)),
    opening=0.151,
    pad=(0.037, 0.025, 0.008),
    pick=((0.4, 0.6), (-0.2, 0.2), (0.03, 0.25)),
    hold=((0.4, 0.6), (-0.2, 0.2), (0.2, 0.4)),
    arm=DriveCfg(
        joints=("joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6"),
        stiffness=(2000.0, 2000.0, 1500.0, 300.0, 300.0, 100.0),
        damping=(180.0, 190.0, 95.0, 19.0, 16.0, 6.5),
        effort=(200.0, 200.0, 120.0, 50.0, 50.0, 30.0),
        speed=(2.0,) * 6,
        home=(-0.24237, 0.18845, 1.41048, 0.0, 1.54266, -0.24237),
    ),
    # The tutorial's two driven joints. The linkage couples all six, so they share the load.
    gripper=GripperCfg(
        joints=("finger_joint", "right_outer_knuckle_joint"),
        stiffness=(20.0, 20.0),
        damping=(1.0, 1.0),
        effort=(2.3, 2.3),  # 30 N per finger at a 51.5 mm grip: within the gripper's 25 to 120 N
        speed=(0.9, 0.9),  # changes the gap at the gripper's top speed, 135 mm/s
        home=(0.0, 0.0),
        open=(0.0, 0.0),
        close=(0.628, -0.628),
        gap=rg6_gap,
        positions=rg6_positions,
    ),
)

# The tutorial's cube in front of the arm, which reaches 0.9 m.
LIFT = lift.LiftSetup(
    scene=SceneCfg(
        objects={"cube": cube(0.0515, mass=0.1)},
        table_center=(0.35, 0.0),
        table_size=(1.1, 1.4),
        look_at=(0.28, 0.0, 0.36),
        view_distance=1.6,
    ),
    cube=((0.4, 0.6), (-0.2, 0.2)),
    goal=((0.4, 0.6), (-0.2, 0.2), (0.2, 0.4)),
)
# The tutorial's frame and target.
FOLLOW_TARGET = follow_target.FollowTargetSetup(
    frame="flange",
    center=(0.5, 0.0, 0.5),
    spread=(0.05, 0.15, 0.1),
    radius=0.1,
    scene=SceneCfg(objects={}, goal="cube", goal_edge=0.0515, table_size=(1.2, 1.4), look_at=(0.25, 0.0, 0.4), view_distance=1.7),
)
# Around the tutorial's goal, (-0.3, 0.6).
PICK_PLACE = pick_place.PickPlaceSetup(
    scene=SceneCfg(
        objects={"cube": cube(0.0515, mass=0.1)},
        goal="cube",
        goal_edge=0.0515,
        table_center=(0.1, 0.15),
        table_size=(1.5, 1.5),
        look_at=(0.15, 0.05, 0.27),
        view_distance=1.85,
    ),
    cube=((0.3, 0.6), (-0.3, 0.3)),
    goal=((-0.4, -0.2), (0.5, 0.65)),
    travel_height=0.2,
    episode_length_s=20.0,
)
# With its fingers tilted forward by 30 degrees from straight down, the arm reaches every point of its workspace.
REACH = reach.ReachSetup(
    orientation=(reach.STILL, (math.pi * 5 / 6, math.pi * 5 / 6), reach.STILL),
    scene=reach.scene(LIFT.scene),
)

REACH_OBSTACLES = reach_obstacles.ReachObstaclesSetup(
    start=(0.5, -0.27), goal=((0.4, 0.6), (0.14, 0.3), (0.15, 0.45)), top=0.35, scene=LIFT.scene
)
LIFT_OBSTACLES = lift_obstacles.LiftObstaclesSetup(
    cube=((0.4, 0.55), (-0.28, -0.2)), goal=((0.4, 0.55), (0.18, 0.28), (0.2, 0.35)), top=0.25, scene=LIFT.scene
)

ENVS: Envs = fitted.envs("cobotta", COBOTTA_PRO_900, LIFT, REACH, FOLLOW_TARGET, PICK_PLACE, REACH_OBSTACLES, LIFT_OBSTACLES)
