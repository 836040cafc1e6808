"""SO-ARM100: a 3D-printed arm of hobby servos, with five joints and a jaw that closes on a fixed one."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero.envs.task import EnvCfg, Envs
from mjx_nero.sim.robot import DriveCfg, GripperCfg, RobotCfg
from mjx_nero.sim.scene import SceneCfg
from mjx_nero.tasks import fitted, lift, lift_obstacles, reach, reach_obstacles

# The jaws (assets/so_arm100/README.md): the angle at which their faces are parallel [rad]; the distances from the fixed face to
# the pivot, from the pivot to the moving face, and from the pivot to the pads' middle along the fixed face [m].
_PARALLEL, _PIVOT, _FACE, _REACH = 0.156, 0.03512, 0.005157, 0.063055


def jaw_gap(q: Float[Array, "1"]) -> Float[Array, ""]:
    """Distance between the jaws at the pads' middle [m] at the jaw's angle [rad]."""
    turn = q[0] - _PARALLEL
    return _PIVOT - _FACE / jnp.cos(turn) + _REACH * jnp.tan(turn)


def jaw_positions(gap: Float[Array, ""]) -> Float[Array, "1"]:
    """The jaw's angle [rad] at which the pads' middles are ``gap`` [m] apart."""
    rest = _PIVOT - gap
    return (_PARALLEL + jnp.arctan2(_REACH, rest) - jnp.arccos(_FACE / jnp.hypot(rest, _REACH)))[None]


_RECIPE: dict[str, Any] = {  # the recipe's arm drives
    "stiffness": (200.0, 170.0, 120.0, 80.0, 50.0),
    "damping": (80.0, 65.0, 45.0, 30.0, 20.0),
    "effort": (1.9,) * 5,
}

# Mounting, home and speed: the Isaac Lab recipe's. Arm drives: the makers' (their MJCF, for the servos' P = 16). They hold a
# joint to milliradians where the recipe's take half a second to follow, but they tremble at steps above 5 ms. Jaw drive: the
# recipe's, except for the effort. At the recipe's 2.5 N m the jaw sinks 1.5 mm into the cube; 1.2 N m hold a cube with 16 N.
ROBOT = SO_ARM100 = RobotCfg(
    name="so_arm100",
    base_link="base",
    base_quat=(0.7071068, 0.0, 0.0, 0.7071068),
    workspace=((0.15, 0.3), (-0.15, 0.15), (0.05, 0.3)),
    max_step=0.005,
    opening=0.052,
    pad=(0.03, 0.012, 0.004),
    pick=((0.14, 0.23), (-0.12, 0.12), (0.02, 0.08)),
    hold=((0.1, 0.3), (-0.1, 0.1), (0.2, 0.35)),
    arm=DriveCfg(
        joints=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
        stiffness=(998.22,) * 5,
        damping=(2.731,) * 5,
        effort=(2.94,) * 5,
        speed=(1.5,) * 5,
        home=(0.0, 1.57, -1.57, 1.0, -1.57),
    ),
    gripper=GripperCfg(
        joints=("gripper",),
        stiffness=(60.0,),
        damping=(20.0,),
        effort=(1.2,),
        speed=(1.5,),
        home=(0.0,),
        open=(0.5,),
        close=(0.0,),
        gap=jaw_gap,
        positions=jaw_positions,
    ),
)

# The recipe's regions. It gives goals in the turned base's frame, where -y is ahead; ours are in the unturned frame.
SCENE = SceneCfg(table_center=(0.2, 0.0), table_size=(0.8, 0.9), look_at=(0.14, 0.0, 0.13), view_distance=0.8)
LIFT = lift.LiftSetup(
    scene=SCENE,
    cube=((0.1, 0.3), (-0.2, 0.2)),
    goal=((0.1, 0.3), (-0.1, 0.1), (0.2, 0.35)),
    grasp_radius=0.02,  # the jaws are narrow: an object off their middle slips out sideways
)
REACH = reach.ReachSetup(
    scene=reach.scene(SCENE),
    position=((0.1, 0.25), (-0.1, 0.1), (0.1, 0.3)),
)
# Farther apart than the region that it picks from, to leave room for the obstacle.
REACH_OBSTACLES = reach_obstacles.ReachObstaclesSetup(
    start=(0.16, -0.18), goal=((0.12, 0.22), (0.14, 0.2), (0.1, 0.25)), top=0.2, scene=SCENE
)
LIFT_OBSTACLES = lift_obstacles.LiftObstaclesSetup(
    cube=((0.12, 0.17), (-0.19, -0.15)), goal=((0.12, 0.2), (0.14, 0.2), (0.12, 0.2)), top=0.12, scene=SCENE
)


def so_arm(prefix: str, robot: RobotCfg, *setups: Any) -> Envs:
    """Lists the environments of an SO-ARM. The preset ``isaac`` has the recipe's drives.

    The stack of three cubes is missing, because the hand cannot point straight down that high. Reorient is missing, because the
    arm has only five joints.
    """
    envs = fitted.envs(prefix, robot, *setups, REACH_OBSTACLES, LIFT_OBSTACLES)
    for task in ("lift", "reach"):
        _, presets = envs[f"{prefix}_{task}"]
        envs[f"{prefix}_{task}"] = robot, {**presets, "isaac": functools.partial(_with_recipe, preset=presets["isaac"])}
    del envs[f"{prefix}_reorient"]
    stacks = {name: preset for name, preset in fitted.FITTING["stack"].items() if name != "three"}
    envs[f"{prefix}_stack"] = robot, stacks
    return envs


def _with_recipe(robot: RobotCfg, preset: Callable[[RobotCfg], EnvCfg]) -> EnvCfg:
    return preset(dataclasses.replace(robot, max_step=0.0, arm=dataclasses.replace(robot.arm, **_RECIPE)))


ENVS: Envs = so_arm("so100", SO_ARM100, LIFT, REACH)
