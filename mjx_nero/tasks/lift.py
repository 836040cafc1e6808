"""Lift: pick a cube off the table and hold it at a commanded point."""

import dataclasses

from mjx_nero.env import ActionCfg, EnvCfg
from mjx_nero.mdp import commands, curriculum, events, observations, rewards, terminations
from mjx_nero.robots import RobotCfg
from mjx_nero.scene import SceneCfg
from mjx_nero.terms import CommandTerm, DoneTerm, ObservationTerm, RewardTerm, Term

# The object's centre above this is off the table [m]; a cube at rest has its centre at 0.015.
LIFTED = {"minimal_height": 0.025}
# ... and held, if it is this near to the grasp point [m].
HELD = {**LIFTED, "grasp_radius": 0.04}


def isaac(robot: RobotCfg) -> EnvCfg:
    """The Isaac Lab recipe's MDP, its numbers word for word.

    Kept to compare with. Its lifting reward is open to a shortcut: a cube knocked into the air scores like a held one.
    The recipe switches observation corruption on but gives no term a noise range, so there is none to apply.
    """
    return EnvCfg(
        robot=robot,
        episode_length_s=5.0,
        action=ActionCfg(scale=0.5),
        object_start=(0.2, 0.0, 0.015),
        command=CommandTerm(
            commands.uniform_position,
            params={"x": (0.3, 0.35), "y": (-0.2, 0.2), "z": (0.2, 0.35)},
            resample_s=5.0,
        ),
        observations={
            "state": {
                "joint_pos": ObservationTerm(observations.joint_pos_rel),
                "joint_vel": ObservationTerm(observations.joint_vel_rel),
                "object_position": ObservationTerm(observations.object_position),
                "target_object_position": ObservationTerm(observations.command),
                "actions": ObservationTerm(observations.last_action),
            },
        },
        events={
            "reset_object_position": Term(
                events.object_position_uniform,
                params={"x": (0.1, 0.2), "y": (-0.1, 0.2), "z": (0.0, 0.0)},
            ),
        },
        rewards={
            "reaching_object": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.05}),
            "lifting_object": RewardTerm(rewards.object_is_lifted, weight=15.0, params=LIFTED),
            "object_goal_tracking": RewardTerm(rewards.object_goal_distance, weight=16.0, params={"std": 0.3, **LIFTED}),
            "object_goal_tracking_fine_grained": RewardTerm(
                rewards.object_goal_distance, weight=5.0, params={"std": 0.05, **LIFTED}
            ),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-1e-4),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        curriculum={
            "action_rate": Term(curriculum.step_weight, params={"to": -1e-1, "num_steps": 10_000}),
            "joint_vel": Term(curriculum.step_weight, params={"to": -1e-1, "num_steps": 10_000}),
        },
        terminations={
            "time_out": DoneTerm(terminations.time_out, time_out=True),
            "object_dropping": DoneTerm(terminations.object_below, params={"minimum_height": -0.05}),
            # The physics' table has no edge to fall from, so leaving the drawn one counts as the fall.
            "object_off_table": DoneTerm(
                terminations.object_off_table,
                params={"center": SceneCfg().table_center, "size": SceneCfg().table_size},
            ),
        },
    )


def default(robot: RobotCfg) -> EnvCfg:
    """The preset that learns to grasp: height and tracking count only for a held cube, and relative positions are observed."""
    recipe = isaac(robot)
    state = {
        "joint_pos": ObservationTerm(observations.joint_pos_rel, noise=0.01),
        "joint_vel": ObservationTerm(observations.joint_vel_rel, noise=0.01),
        "target_error": ObservationTerm(observations.target_error),
        "ee_position": ObservationTerm(observations.ee_position),
        "ee_to_object": ObservationTerm(observations.ee_to_object, noise=0.002),
        "object_to_goal": ObservationTerm(observations.object_to_goal, noise=0.002),
        "target_object_position": ObservationTerm(observations.command),
        "actions": ObservationTerm(observations.last_action),
    }
    exact = {name: dataclasses.replace(term, noise=0.0) for name, term in state.items()}
    return dataclasses.replace(
        recipe,
        observations={
            "state": state,
            "privileged_state": {
                **exact,
                "object_velocity": ObservationTerm(observations.object_velocity),
                "object_orientation": ObservationTerm(observations.object_orientation),
            },
        },
        rewards={
            "reaching_object": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1}),
            "holding_object": RewardTerm(rewards.object_is_held, weight=5.0, params=HELD),
            "goal_tracking": RewardTerm(rewards.held_goal_distance, weight=10.0, params={"std": 0.3, **HELD}),
            "goal_tracking_near": RewardTerm(rewards.held_goal_distance, weight=10.0, params={"std": 0.1, **HELD}),
            "goal_tracking_fine": RewardTerm(rewards.held_goal_distance, weight=15.0, params={"std": 0.03, **HELD}),
            "at_goal": RewardTerm(rewards.held_at_goal, weight=10.0, params={"threshold": 0.02, **HELD}),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        curriculum={},
    )


PRESETS = {"default": default, "isaac": isaac}
