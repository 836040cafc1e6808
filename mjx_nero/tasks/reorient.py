"""Reorient: turn a cube over until a commanded side is up. For any robot whose hand can lean to both sides of straight down."""

import dataclasses
import math

import numpy as np

from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, CurriculumCfg, EnvCfg, Presets, SuccessCfg
from mjx_nero.mdp import metrics, observations, rewards, sides, towers
from mjx_nero.mdp.sides import Lying
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationTerm, RewardTerm, Term
from mjx_nero.sim import contacts, grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tasks.building import lets_go
from mjx_nero.tasks.usual import SHOWN, arm_state, observed, on_table, stays_on_table
from mjx_nero.types import UserError

BOX = "box"
TILT, FLAT = math.radians(10), 0.005  # [rad, m] tolerances of a box that lies as commanded
STILL = 0.005  # [m/s]
LIFTED = 0.01  # [m] height of a held box above the highest that it reaches when tipped over an edge
AWAY = 0.02  # [m] clearance of the pads beside a box that the hand has left
YAW = (-0.3, 0.3)  # [rad] heading of the box at the start
JOINTS = 6  # fewest joints of an arm whose hand can lean in any direction
# How the script moves with six joints. With seven, inverse kinematics also turns the other joints when it lifts the hand.
ROUND = {"clear": 0.02, "rises": 0.15}
WIDER = 2.0  # opening of the hand, in edges of the box


# Long: a task is one list, to read as one.
def default(robot: RobotCfg) -> EnvCfg:
    """Success: for half a second, the commanded side is up within 10 degrees, the box is at rest, and the hand is away.

    Raises:
        UserError: the arm has fewer joints than its hand needs to lean in any direction.
    """
    if len(robot.arm.joints) < JOINTS:
        few = f"{robot.name} has {len(robot.arm.joints)} joints, so its hand can only lean along its arm"
        raise UserError(f"{few}: turning a cube over needs {JOINTS}")
    there, box, one = regions.of(robot), grasp.cube_for(robot), {"object": BOX}
    edge = box.size[0]
    robot = dataclasses.replace(grasp.opened(robot, WIDER * edge), gravity_compensation=True)
    scene = scenes.around(robot, SceneCfg(objects={BOX: box}, sensors=("fingers",), goal="none"))
    lying = Lying(
        object=BOX,
        rest=box.rest_height,
        within=(round(TILT, 5), FLAT),
        clearance=round(edge / 2 + robot.pad[0] / 2 + AWAY, 4),
        minimal_height=round(edge / math.sqrt(2) + LIFTED, 4),
        grasp_radius=regions.near(there),
    )
    done, fingers = {"lying": lying, "max_speed": STILL}, {"open": robot.gripper.open, "hold": robot.gripper.close}
    state = {
        **arm_state(),
        "ee_orientation": ObservationTerm(observations.ee_orientation),
        "ee_to_object": ObservationTerm(observations.ee_to_object, params=one, noise=0.002),
        "ee_turn_to_object": ObservationTerm(towers.turn_to_object, params={"down": robot.down, **one}, noise=0.01),
        "object_position": ObservationTerm(observations.object_position, params=one, noise=0.002),
        "object_orientation": ObservationTerm(observations.object_orientation, params=one, noise=0.01),
        "side": ObservationTerm(sides.side, params=one, noise=0.01),
        "actions": ObservationTerm(observations.last_action),
    }
    spot = (round(float(np.mean(there.cube[0])), 4), round(float(np.mean(there.cube[1])), 4))
    script = {
        "object": BOX,
        "rest": box.rest_height,
        "spot": spot,
        "beyond": grasp.beyond(robot, edge),
        "lift": round(1.2 * edge, 4),
        "before": round(lying.clearance + LIFTED, 4),
        "closing": grasp.closing(robot, edge),
        **(ROUND if len(robot.arm.joints) == JOINTS else {}),
        **regions.ik(robot, "ik."),
    }
    return EnvCfg(
        robot=robot,
        scene=scene,
        # With MuJoCo's softer friction, a heavy cube creeps by a centimetre between the pads while it is turned.
        sim=contacts.sized(robot, scene, SimCfg(impratio=30.0, ramp=robot.max_step > 0)),
        episode_length_s=20.0,
        actions=lets_go(),
        controllers={"turn_over": script},
        command=CommandTerm(sides.any_side, resample_s=ONCE),
        success=SuccessCfg(
            condition=Term(sides.turned_up, params=done), distance=Term(sides.tilt, params={"lever": round(edge / 2, 4), **one})
        ),
        metrics=metrics.grasping(minimal_height=lying.minimal_height, grasp_radius=lying.grasp_radius, **one),
        observations=observed(state, **one),
        events={
            **on_table(there.cube, **one),
            "reset_object_side": Term(sides.other_side_up, params={"base": robot.base_pos, "yaw": YAW, **one}),
        },
        rewards={
            "reaching_object": RewardTerm(sides.reached, weight=1.0, params={"lying": lying, "std": 0.1}),
            "holding_object": RewardTerm(sides.carried, weight=3.0, params={"lying": lying}),
            "turning": RewardTerm(sides.turned, weight=10.0, params={"std": 1.0, **one}),
            "turning_fine": RewardTerm(sides.turned, weight=5.0, params={"std": 0.2, **one}),
            "lowering": RewardTerm(sides.lowered, weight=10.0, params={"lying": lying, "std": 0.03, "near": 0.35}),
            "standing": RewardTerm(sides.standing, weight=10.0, params={"lying": lying}),
            "releasing": RewardTerm(sides.told_to_open, weight=10.0, params={"lying": lying, **fingers}),
            "leaving": RewardTerm(sides.left, weight=10.0, params={"lying": lying}),
            "completed": RewardTerm(sides.completed, weight=15.0, params=done),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        curriculum=CurriculumCfg(expert_starts=0.5),
        training=SHOWN,
        budget=Budget(steps=250_000_000),
        terminations=stays_on_table(scene, **one),
    )


PRESETS: Presets = {"default": default}
