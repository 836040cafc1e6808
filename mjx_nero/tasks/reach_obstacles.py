"""Reach past obstacles: move from the right of the workspace to a point on its left without touching the obstacle between."""

import dataclasses
import functools
from typing import Any

from mjx_nero.config.bounds import Range
from mjx_nero.envs import regions
from mjx_nero.envs.task import EnvCfg, Presets, SuccessCfg, joint_actions
from mjx_nero.mdp import commands, events, metrics, observations, obstacles, rewards, success, terminations
from mjx_nero.mdp.terms import ONCE, CommandTerm, DoneTerm, MetricTerm, ObservationGroup, ObservationTerm, RewardTerm, Term
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObstacleCfg, SceneCfg
from mjx_nero.tasks.reach import BUDGET
from mjx_nero.tasks.usual import arm_state

NAMES = ("one", "two")  # the boxes that make an obstacle
SHARE = 0.3  # share of the region's width, at either side, from which start and goal are drawn
HAND = 0.08  # [m] from a finger's pad to the far side of the hand, with a margin


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObstaclesSetup:
    """Numbers that differ from robot to robot. None: derived from the robot's regions and gripper.

    Attributes:
        goal: ``x``, ``y`` and ``z`` of the commanded point [m], robot root frame.
        room: free space around start and goal [m].
        top: greatest height of an obstacle above the robot's foot [m].
        scene: cameras, table and object.
    """

    goal: tuple[Range, Range, Range] | None = None
    room: float | None = None
    top: float | None = None
    scene: SceneCfg | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReachObstaclesSetup(ObstaclesSetup):
    """A setup with a start.

    Attributes:
        start: ``x`` and ``y`` that the arm points at when an episode starts [m], robot root frame.
    """

    start: tuple[float, float] | None = None


def completed(robot: RobotCfg, setup: ReachObstaclesSetup) -> ReachObstaclesSetup:
    """Fills in all numbers that the setup leaves open."""
    x, y, z = regions.box(robot, "workspace", "where it can work")
    by = SHARE * (y[1] - y[0])
    return ReachObstaclesSetup(
        start=setup.start or ((x[0] + x[1]) / 2, y[0] + by / 2),
        goal=setup.goal or (x, regions.span(y[1] - by, y[1]), z),
        room=setup.room or round(robot.opening / 2 + HAND, 4),
        top=setup.top or round(z[0] + 0.6 * (z[1] - z[0]), 4),
        scene=setup.scene or scenes.around(robot, SceneCfg(objects={})),
    )


def between(setup: ReachObstaclesSetup, object: str | None = None) -> Term:
    """Draws the obstacle between start and goal. ``object`` is the one that travels; None: the end effector."""
    params = {"thickness": (0.02, 0.04), "width": (0.15, 0.3), "above": (0.0, 0.08), "top": setup.top, "room": setup.room}
    return Term(obstacles.across, params={**params, "names": NAMES, "object": object})


def with_obstacles(scene: SceneCfg) -> SceneCfg:
    """Adds the boxes to the scene, and lets the robot collide with itself."""
    return dataclasses.replace(scene, obstacles={name: ObstacleCfg() for name in NAMES}, self_collision=True)


def seen() -> dict[str, ObservationTerm]:
    """Observes positions and sizes of the obstacles."""
    return {f"obstacle_{name}": ObservationTerm(observations.obstacle, params={"obstacle": name}) for name in NAMES}


def aside(robot: RobotCfg, setup: ReachObstaclesSetup) -> dict[str, Term]:
    """Starts the arm turned towards ``start``, with small random offsets."""
    assert setup.start is not None
    turn = regions.turn_to(robot, *setup.start)
    return {
        "reset_robot_joints": Term(events.joints_by_scale, params={"low": 0.95, "high": 1.05}),
        "turn_aside": Term(events.joint_turned, params={"joint": 0, "by": (turn - 0.05, turn + 0.05)}),
    }


def controllers(robot: RobotCfg, name: str, **fields: Any) -> dict[str, dict[str, Any]]:
    """Returns the expert ``name``, with RMPflow if the robot has its files, otherwise with inverse kinematics."""
    if (robot.xml.parent / "rmpflow").is_dir():
        return {name: fields}
    return {name: {**fields, "motion": "ik", **regions.ik(robot, "ik.")}}


def default(robot: RobotCfg, setup: ReachObstaclesSetup) -> EnvCfg:
    """Success: within 2 cm of the goal for the last half second, with no touch in the whole episode."""
    setup = completed(robot, setup)
    assert setup.goal is not None and setup.scene is not None
    state = {
        **arm_state(),
        "ee_to_goal": ObservationTerm(observations.ee_to_goal),
        "goal_position": ObservationTerm(observations.command),
        **seen(),
        "actions": ObservationTerm(observations.last_action),
    }
    return EnvCfg(
        robot=dataclasses.replace(robot, gravity_compensation=True),
        scene=with_obstacles(dataclasses.replace(setup.scene, objects={})),
        episode_length_s=8.0,
        actions=joint_actions(scale=0.5, gripper=False),
        controllers=controllers(robot, "detour"),
        budget=dataclasses.replace(BUDGET, steps=100_000_000),
        command=CommandTerm(commands.uniform_position, params=dict(zip("xyz", setup.goal, strict=True)), resample_s=ONCE),
        obstacles=between(setup),
        success=SuccessCfg(
            condition=Term(success.AtGoalUntouched, params={"threshold": 0.02}),
            distance=Term(success.ee_distance),
            follows=True,
        ),
        metrics={"touched": MetricTerm(metrics.Touched)},
        observations={"state": ObservationGroup(state)},
        events=aside(robot, setup),
        rewards={
            "position_tracking": RewardTerm(rewards.ee_goal_distance, weight=0.2, params={"std": 0.3}),
            "position_tracking_fine": RewardTerm(rewards.ee_goal_distance, weight=0.4, params={"std": 0.1}),
            "position_tracking_finest": RewardTerm(rewards.ee_goal_distance, weight=0.4, params={"std": 0.02}),
            "touching": RewardTerm(rewards.touching, weight=-2.0),
            "nearness": RewardTerm(rewards.obstacle_nearness, weight=-0.2, params={"margin": 0.05}),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-1e-3),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        terminations={"time_out": DoneTerm(terminations.time_out, time_out=True)},
    )


def presets(setup: ReachObstaclesSetup | None = None) -> Presets:
    """Maps preset -> robot -> config, the default first."""
    return {"default": functools.partial(default, setup=setup or ReachObstaclesSetup())}
