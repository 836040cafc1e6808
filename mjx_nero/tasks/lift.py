"""Lift: pick a cube off the table and hold it at a commanded point."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

from mjx_nero.config.bounds import Range
from mjx_nero.envs import regions
from mjx_nero.envs.task import CurriculumCfg, EnvCfg, Presets, joint_actions
from mjx_nero.mdp import commands, metrics, observations, rewards, terminations
from mjx_nero.mdp.terms import CommandTerm, DoneTerm, ObservationGroup, ObservationTerm, RewardTerm, groups
from mjx_nero.sim import grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg
from mjx_nero.tasks import seeing
from mjx_nero.tasks import sim2real as sim2reals
from mjx_nero.tasks.usual import SHOWN, arm_state, nearer, on_table, stays_on_table, step_weights, velocity_actions

SPEED = 0.4  # [m/s] of the script's hand: 5 s are short for arms with slow joints
OVER = 0.02  # [m] height over the cube from which the script's hand comes down


@dataclasses.dataclass(frozen=True)
class LiftSetup:
    """Numbers that differ from robot to robot: the cube, where it lies, and where it must go [m].

    Attributes:
        cube: ``x`` and ``y`` of the cube at the start, in the world frame.
        goal: ``x``, ``y`` and ``z`` of the commanded point, in the robot's root frame.
        grasp_radius: greatest distance of a held object from the grasp point.
    """

    scene: SceneCfg
    cube: tuple[Range, Range]
    goal: tuple[Range, Range, Range]
    grasp_radius: float = 0.04

    @property
    def lifted(self) -> dict[str, float]:
        """Height of the object's centre above which it is off the table [m]: 1 cm above a resting cube."""
        return {"minimal_height": self.scene.objects["cube"].rest_height + 0.01}

    @property
    def held(self) -> dict[str, float]:
        """Least height of a held object, and its greatest distance from the grasp point [m]."""
        return {**self.lifted, "grasp_radius": self.grasp_radius}

    def controllers(self, robot: RobotCfg) -> dict[str, dict[str, Any]]:
        """Builds the settings of the script that picks the cube up."""
        edge = self.scene.objects["cube"].size[0]
        fields = {
            "lowest": grasp.lowest(robot.pad),
            "beyond": grasp.beyond(robot, edge),
            "closing": grasp.closing(robot, edge, grasp.QUICK),
            "above": round(edge + OVER, 4),
            "speed": SPEED,
            "aside": (grasp.aside(robot, robot.opening),),  # amid the open fingers a cube that lies askew has most room
        }
        return {"pick_up": {**fields, **regions.ik(robot, "ik.")}}


def isaac(robot: RobotCfg, setup: LiftSetup) -> EnvCfg:
    """The Isaac Lab recipe's MDP, with the recipe's own numbers.

    Kept for comparison. Its lifting reward has a loophole: a cube knocked into the air scores like a held one. The recipe
    switches observation corruption on but gives no term a noise range, so none applies.
    """
    ends = stays_on_table(setup.scene)
    return EnvCfg(
        robot=robot,
        episode_length_s=5.0,
        actions=joint_actions(scale=0.5),
        scene=setup.scene,
        metrics=metrics.grasping(**setup.held),
        command=CommandTerm(
            commands.uniform_position,
            params=dict(zip("xyz", setup.goal, strict=True)),
            resample_s=5.0,
        ),
        observations={
            "state": ObservationGroup(
                {
                    "joint_pos": ObservationTerm(observations.joint_pos_rel),
                    "joint_vel": ObservationTerm(observations.joint_vel_rel),
                    "object_position": ObservationTerm(observations.object_position),
                    "target_object_position": ObservationTerm(observations.command),
                    "actions": ObservationTerm(observations.last_action),
                }
            ),
        },
        events=on_table(setup.cube),
        rewards={
            "reaching_object": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.05}),
            "lifting_object": RewardTerm(rewards.object_is_lifted, weight=15.0, params=setup.lifted),
            "object_goal_tracking": RewardTerm(rewards.object_goal_distance, weight=16.0, params={"std": 0.3, **setup.lifted}),
            "object_goal_tracking_fine_grained": RewardTerm(
                rewards.object_goal_distance, weight=5.0, params={"std": 0.05, **setup.lifted}
            ),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-1e-4),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        curriculum=CurriculumCfg(weights=step_weights(10_000, action_rate=-1e-1, joint_vel=-1e-1)),
        terminations={
            "time_out": ends["time_out"],
            "object_dropping": DoneTerm(terminations.object_below, params={"minimum_height": -0.05}),
            # The simulated table has no edge to fall from, so leaving the drawn table counts as a fall.
            "object_off_table": ends["object_off_table"],
        },
    )


def default(robot: RobotCfg, setup: LiftSetup) -> EnvCfg:
    """The preset that learns to grasp. Rewards need a held cube (``carrying``), and relative positions are observed."""
    recipe, held = isaac(robot, setup), setup.held
    state = {
        **arm_state(),
        "ee_to_object": ObservationTerm(observations.ee_to_object, noise=0.002),
        "object_to_goal": ObservationTerm(observations.object_to_goal, noise=0.002),
        "target_object_position": ObservationTerm(observations.command),
        "actions": ObservationTerm(observations.last_action),
    }
    seen = {
        "object_velocity": ObservationTerm(observations.object_velocity),
        "object_orientation": ObservationTerm(observations.object_orientation),
    }
    return dataclasses.replace(
        recipe,
        actions=velocity_actions(hysteresis=0.5),
        observations=groups(state, seen),
        rewards=carrying(held),
        curriculum=CurriculumCfg(),
        controllers=setup.controllers(robot),
        training=SHOWN,
    )


def carrying(held: Mapping[str, Any], **object: str) -> dict[str, RewardTerm]:
    """Lists rewards for reaching, holding and carrying an object to the goal; height and tracking count only while it is held.

    Args:
        held: parameters of ``rewards.held``.
        object: the parameter ``object``, if it is not the cube.
    """
    return {
        "reaching_object": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1, **object}),
        "holding_object": RewardTerm(rewards.object_is_held, weight=5.0, params=held),
        **nearer("goal_tracking", rewards.held_goal_distance, **held),
        "at_goal": RewardTerm(rewards.held_at_goal, weight=10.0, params={"threshold": 0.02, **held}),
        "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
        "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
    }


def sim2real(robot: RobotCfg, setup: LiftSetup) -> EnvCfg:
    """The default, plus the differences between a simulated arm and a real one: see ``tasks.sim2real``."""
    return sim2reals.randomized(default(robot, setup))


def seen(robot: RobotCfg, setup: LiftSetup, sees: str = "rgb") -> EnvCfg:
    """The default from pictures: the policy does not observe where the cube is. See ``seeing``."""
    return seeing.seen(default(robot, setup), sees)


def sim2real_rgb(robot: RobotCfg, setup: LiftSetup) -> EnvCfg:
    """``sim2real`` from pictures with a random look: see ``seeing.lifelike``."""
    return seeing.lifelike(sim2real(robot, setup))


SEEN = {name: functools.partial(seen, sees=name) for name in seeing.PRESETS}


def presets(setup: LiftSetup) -> Presets:
    """Maps preset -> robot -> config, the default first."""
    return {
        "default": functools.partial(default, setup=setup),
        "isaac": functools.partial(isaac, setup=setup),
        "sim2real": functools.partial(sim2real, setup=setup),
        **{name: functools.partial(factory, setup=setup) for name, factory in SEEN.items()},
        "sim2real_rgb": functools.partial(sim2real_rgb, setup=setup),
    }
