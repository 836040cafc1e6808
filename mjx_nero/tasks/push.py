"""Push: move a box to a goal pose on the table with the gripper closed."""

import dataclasses
import math

from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, EnvCfg, Presets, SuccessCfg, joint_actions
from mjx_nero.mdp import commands, events, observations, rewards, success
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationTerm, RewardTerm, Term
from mjx_nero.sim import contacts, grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, SimCfg
from mjx_nero.tasks.usual import arm_state, observed, on_table, stays_on_table

BOX = (1.6, 1.0, 0.8)  # edges of the box, in edges of the cube that the gripper could lift
EDGE = 0.05  # [m] edge of that cube for a robot without a gripper
TURN = (-math.pi / 3, math.pi / 3)  # [rad] heading of the box at the start and at the goal
ANGLE = math.radians(15)
FOLD = 2  # the box looks the same after half a turn


def _box(robot: RobotCfg) -> ObjectCfg:
    edge = grasp.cube_for(robot).size[0] if robot.gripper.joints else EDGE
    x, y, z = (round(edge * share, 4) for share in BOX)
    return ObjectCfg(size=(x, y, z), mass=float(f"{grasp.DENSITY * x * y * z:.3g}"))


# Long: a task is one list, to read as one.
def default(robot: RobotCfg) -> EnvCfg:
    """Success: the box is within 2 cm and 15 degrees of the goal, flat on the table."""
    x, y, _ = regions.box(robot, "pick", "where on the table it can point down")
    dx, dy, dz = robot.base_pos
    box, object = _box(robot), {"object": "box"}
    start = regions.span(x[0] + dx, x[1] + dx), regions.span(y[0] + dy, y[1] + dy)
    scene = scenes.around(robot, SceneCfg(objects={"box": box}, goal="box"))
    hand = dataclasses.replace(robot.gripper, home=robot.gripper.close)
    back = round(box.size[0] / 2 + robot.pad[0] / 2, 4)  # distance of the hand from the centre, when beside the box
    place, at_goal = box.rest_height - dz, {"threshold": 0.02, "angle": ANGLE, "fold": FOLD, **object}
    state = {
        **arm_state(),
        "ee_orientation": ObservationTerm(observations.ee_orientation),
        "ee_to_object": ObservationTerm(observations.ee_to_object, params=object, noise=0.002),
        "object_heading": ObservationTerm(observations.object_heading, params=object, noise=0.02),
        "object_to_goal": ObservationTerm(observations.object_to_goal, params=object, noise=0.002),
        "object_turn_to_goal": ObservationTerm(observations.object_turn_to_goal, params={"fold": FOLD, **object}, noise=0.02),
        "actions": ObservationTerm(observations.last_action),
    }
    return EnvCfg(
        robot=dataclasses.replace(robot, gripper=hand, gravity_compensation=True),  # a robot's own controller does this
        scene=scene,
        sim=contacts.sized(robot, scene, SimCfg()),
        episode_length_s=8.0,
        actions=joint_actions(scale=0.5, gripper=False),
        command=CommandTerm(
            commands.uniform_pose,
            params={"x": x, "y": y, "z": (place, place), "roll": (0.0, 0.0), "pitch": (0.0, 0.0), "yaw": TURN},
            resample_s=ONCE,
        ),
        success=SuccessCfg(
            condition=Term(success.object_at_pose, params=at_goal),
            distance=Term(success.object_distance, params=object),
        ),
        observations=observed(state, **object),
        events={
            **on_table(start, **object),
            "reset_object_yaw": Term(events.object_yaw_uniform, params={"yaw": TURN, **object}),
        },
        rewards={
            "reaching_object": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1, **object}),
            # The rewards for where the box happens to lie vary more from start to start than the term above pays, and with that
            # term alone the hand stayed away for 30 M env steps. Besides, a push comes from behind.
            "reaching_behind": RewardTerm(
                rewards.behind_object_distance, weight=5.0, params={"std": 0.3, "behind": back, **object}
            ),
            "goal_tracking": RewardTerm(rewards.goal_distance, weight=5.0, params={"std": 0.2, **object}),
            "goal_tracking_near": RewardTerm(rewards.goal_distance, weight=5.0, params={"std": 0.05, **object}),
            "turning": RewardTerm(rewards.object_goal_turn, weight=5.0, params={"std": 1.0, "fold": FOLD, **object}),
            "pose_tracking": RewardTerm(
                rewards.object_goal_pose, weight=10.0, params={"std": 0.1, "angle_std": 0.5, "fold": FOLD, **object}
            ),
            "pose_tracking_fine": RewardTerm(
                rewards.object_goal_pose, weight=10.0, params={"std": 0.03, "angle_std": 0.2, "fold": FOLD, **object}
            ),
            "at_goal": RewardTerm(rewards.object_at_pose, weight=10.0, params=at_goal),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        budget=Budget(steps=150_000_000),
        terminations=stays_on_table(scene, **object),
    )


PRESETS: Presets = {"default": default}
