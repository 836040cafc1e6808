"""Pick and place: move a cube to its place. The Isaac Sim tutorial's second task."""

import dataclasses
import functools

from mjx_nero.config.bounds import Range
from mjx_nero.envs.task import EnvCfg, Presets, SuccessCfg, drive_targets
from mjx_nero.mdp import commands, metrics, observations, rewards, success
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationGroup, ObservationTerm, RewardTerm, Term
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg
from mjx_nero.tasks.usual import on_table, stays_on_table


@dataclasses.dataclass(frozen=True)
class PickPlaceSetup:
    """Numbers that differ from robot to robot: the cube's start and goal, its travel height [m], and a time limit [s]."""

    scene: SceneCfg
    cube: tuple[Range, Range]
    goal: tuple[Range, Range]
    travel_height: float
    episode_length_s: float
    grasp_radius: float = 0.04  # greatest distance of a held cube from the grasp point [m]


def default(robot: RobotCfg, setup: PickPlaceSetup) -> EnvCfg:
    """Success: the cube is within 1 cm of its place, at rest, and released."""
    rest = setup.scene.objects["cube"].rest_height
    held = {"minimal_height": rest + 0.01, "grasp_radius": setup.grasp_radius}
    place = rest - robot.base_pos[2]  # in the robot's root frame, as all commands are
    return EnvCfg(
        robot=dataclasses.replace(robot, gravity_compensation=True),
        scene=setup.scene,
        episode_length_s=setup.episode_length_s,
        actions=drive_targets(),
        controllers={"pick_place": {"end_effector_initial_height": setup.travel_height}},
        command=CommandTerm(
            commands.uniform_position,
            params={"x": setup.goal[0], "y": setup.goal[1], "z": (place, place)},
            resample_s=ONCE,
        ),
        success=SuccessCfg(
            condition=Term(success.object_placed, params={"threshold": 0.01, "max_speed": 0.005, "clearance": 0.05}),
        ),
        metrics=metrics.grasping(**held),
        observations={
            "state": ObservationGroup(
                {
                    "joint_positions": ObservationTerm(observations.joint_pos),
                    "end_effector_position": ObservationTerm(observations.ee_position),
                    "end_effector_orientation": ObservationTerm(observations.ee_orientation),
                    "cube_position": ObservationTerm(observations.object_position),
                    "cube_orientation": ObservationTerm(observations.object_orientation),
                    "cube_target_position": ObservationTerm(observations.goal_position),
                }
            ),
        },
        events=on_table(setup.cube),
        rewards={
            "reaching_object": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1}),
            "goal_tracking": RewardTerm(rewards.goal_distance, weight=10.0, params={"std": 0.3}),
            "goal_tracking_fine": RewardTerm(rewards.goal_distance, weight=10.0, params={"std": 0.05}),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        terminations=stays_on_table(setup.scene),
    )


def presets(setup: PickPlaceSetup) -> Presets:
    """Maps preset -> robot -> config, the default first."""
    return {"default": functools.partial(default, setup=setup)}
