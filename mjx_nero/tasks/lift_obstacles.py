"""Lift past obstacles: carry a cube from the right of the table to a point above its left.

Neither arm nor cube may touch the obstacle between.
"""

import dataclasses
import functools

from mjx_nero.config.bounds import Range
from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, CurriculumCfg, EnvCfg, Presets, SuccessCfg
from mjx_nero.mdp import curriculum, metrics, rewards, success
from mjx_nero.mdp.terms import ONCE, MetricTerm, RewardTerm, Term
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks import lift, reach_obstacles
from mjx_nero.tasks.usual import SHOWN, velocity_actions


@dataclasses.dataclass(frozen=True, kw_only=True)
class LiftObstaclesSetup(reach_obstacles.ObstaclesSetup):
    """A setup with a cube.

    Attributes:
        cube: ``x`` and ``y`` of the cube at the start [m], world frame.
    """

    cube: tuple[Range, Range] | None = None


def default(robot: RobotCfg, setup: LiftObstaclesSetup) -> EnvCfg:
    """Success: the cube is within 2 cm of the goal for the last half second, with no touch in the whole episode."""
    there = regions.of(robot)
    (x, y), (goal_x, goal_y, z) = there.cube, there.hold
    share = reach_obstacles.SHARE
    cube = setup.cube or (x, regions.span(y[0], y[0] + share * (y[1] - y[0])))
    goal = setup.goal or (goal_x, regions.span(goal_y[1] - share * (goal_y[1] - goal_y[0]), goal_y[1]), z)
    scene = reach_obstacles.with_obstacles(setup.scene or regions.scene(robot, "sphere"))
    arm = dataclasses.replace(robot, gravity_compensation=True)
    plain = lift.default(arm, lift.LiftSetup(scene=scene, cube=cube, goal=goal, grasp_radius=regions.near(there)))
    middle = (sum(cube[0]) / 2 - robot.base_pos[0], sum(cube[1]) / 2 - robot.base_pos[1])
    ways = reach_obstacles.ReachObstaclesSetup(
        start=middle, goal=goal, room=setup.room, top=setup.top or round(0.8 * z[0], 4), scene=scene
    )
    ways = reach_obstacles.completed(robot, ways)
    done = {"threshold": 0.02, "object": "cube"}
    return dataclasses.replace(
        plain,
        sim=dataclasses.replace(plain.sim, contacts_per_env=32, constraints_per_env=160),  # for a grasp, or leaning on a box
        episode_length_s=12.0,
        actions=velocity_actions(),
        controllers=reach_obstacles.controllers(robot, "carry", end_effector_offset=there.offset),
        training=SHOWN,
        budget=Budget(steps=80_000_000),
        command=dataclasses.replace(plain.command, resample_s=ONCE),
        obstacles=reach_obstacles.between(ways, "cube"),
        success=SuccessCfg(condition=Term(success.AtGoalUntouched, params=done), distance=Term(success.object_distance)),
        metrics={**plain.metrics, "touched": MetricTerm(metrics.Touched)},
        observations={
            name: dataclasses.replace(group, terms={**group.terms, **reach_obstacles.seen()})
            for name, group in plain.observations.items()
        },
        events={**plain.events, **reach_obstacles.aside(robot, ways)},
        rewards={
            **plain.rewards,
            "touching": RewardTerm(rewards.touching, weight=-10.0),
            "nearness": RewardTerm(rewards.obstacle_nearness, weight=-1.0, params={"margin": 0.05}),
            # Otherwise the hand learns to stay open so firmly that noise never closes it.
            "gripper_action": RewardTerm(rewards.gripper_action_l2, weight=-0.1),
        },
        # A touch costs a tenth until an environment succeeds. At full cost, ten times what a hand at the cube earns, the policy
        # mainly learns to keep away.
        curriculum=CurriculumCfg(
            weights={"touching": Term(curriculum.level_weight, params={"start": -1.0})},
            levels=Term(curriculum.BySuccess, params={"up": 0.5, "down": 0.1}),
        ),
    )


def presets(setup: LiftObstaclesSetup | None = None) -> Presets:
    """Maps preset -> robot -> config, the default first."""
    return {"default": functools.partial(default, setup=setup or LiftObstaclesSetup())}
