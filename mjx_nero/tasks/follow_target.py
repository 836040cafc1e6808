"""Follow target: keep the end effector at a moving target cube. The Isaac Sim tutorial's first task."""

import dataclasses
import functools

from mjx_nero.envs.task import EnvCfg, Presets, SuccessCfg, drive_targets
from mjx_nero.mdp import commands, observations, rewards, success, terminations
from mjx_nero.mdp.terms import ONCE, CommandTerm, DoneTerm, ObservationGroup, ObservationTerm, RewardTerm, Term
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg
from mjx_nero.tasks.reach import BUDGET


@dataclasses.dataclass(frozen=True)
class FollowTargetSetup:
    """Numbers that differ from robot to robot: the frame that follows, and the targets' box about ``center`` [m]."""

    frame: str
    center: tuple[float, float, float]
    spread: tuple[float, float, float]
    radius: float
    scene: SceneCfg


def default(robot: RobotCfg, setup: FollowTargetSetup) -> EnvCfg:
    """The target moves round a vertical circle in four seconds. Success is to stay within 2 cm of it."""
    x, y, z = ((c - s, c + s) for c, s in zip(setup.center, setup.spread, strict=True))
    return EnvCfg(
        # A robot's own controller does this. A weak drive that sags would never arrive.
        robot=dataclasses.replace(robot, ee_site=setup.frame, gravity_compensation=True),
        scene=setup.scene,
        episode_length_s=12.0,
        actions=drive_targets(),
        controllers={"rmpflow": {}, "ik": {}},
        command=CommandTerm(
            commands.pose,
            params={"x": x, "y": y, "z": z, "quat": robot.down},
            resample_s=ONCE,
            motion=Term(commands.circle, params={"radius": setup.radius, "frequency": 0.25}),
        ),
        success=SuccessCfg(
            condition=Term(success.ee_at_goal, params={"threshold": 0.02}),
            distance=Term(success.ee_distance),
            follows=True,
        ),
        observations={
            "state": ObservationGroup(
                {
                    "joint_positions": ObservationTerm(observations.joint_pos),
                    "end_effector_position": ObservationTerm(observations.ee_position),
                    "end_effector_orientation": ObservationTerm(observations.ee_orientation),
                    "target_position": ObservationTerm(observations.goal_position),
                    "target_orientation": ObservationTerm(observations.goal_orientation),
                }
            ),
        },
        events={},
        budget=BUDGET,
        rewards={
            "position_tracking": RewardTerm(rewards.ee_goal_distance, weight=1.0, params={"std": 0.2}),
            "position_tracking_fine": RewardTerm(rewards.ee_goal_distance, weight=1.0, params={"std": 0.02}),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        terminations={"time_out": DoneTerm(terminations.time_out, time_out=True)},
    )


def static(robot: RobotCfg, setup: FollowTargetSetup) -> EnvCfg:
    """The target stands still. Success is to stay within 5 mm of it."""
    moving = default(robot, setup)
    return dataclasses.replace(
        moving,
        command=dataclasses.replace(moving.command, motion=None),
        success=SuccessCfg(
            condition=Term(success.ee_at_goal, params={"threshold": 0.005}),
            distance=Term(success.ee_distance),
            follows=True,
        ),
    )


def presets(setup: FollowTargetSetup) -> Presets:
    """Maps preset -> robot -> config, the default first."""
    return {"default": functools.partial(default, setup=setup), "static": functools.partial(static, setup=setup)}
