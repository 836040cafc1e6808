"""Pick and place: a cube from where it lies to where it belongs. The Isaac Sim tutorial's second task."""

import dataclasses
import functools

from mjx_nero.env import ActionCfg, EnvCfg, Presets, SuccessCfg
from mjx_nero.mdp import commands, events, observations, rewards, success, terminations
from mjx_nero.robots import Range, RobotCfg
from mjx_nero.scene import SceneCfg
from mjx_nero.terms import ONCE, CommandTerm, DoneTerm, ObservationTerm, RewardTerm, Term


@dataclasses.dataclass(frozen=True)
class Work:
    """What differs from robot to robot: where the cube starts, where it has to go, how high it travels [m], and how long that may
    take [s]."""

    scene: SceneCfg
    cube: tuple[Range, Range]
    goal: tuple[Range, Range]
    travel_height: float
    episode_length_s: float


def default(robot: RobotCfg, work: Work) -> EnvCfg:
    """Success: the cube within 1 cm of its place, at rest and let go of."""
    rest = work.scene.cube_edge / 2
    return EnvCfg(
        robot=dataclasses.replace(robot, gravity_compensation=True),
        scene=work.scene,
        episode_length_s=work.episode_length_s,
        object_start=(0.0, 0.0, rest),
        action=ActionCfg(absolute=True),
        controllers={"pick_place": {"end_effector_initial_height": work.travel_height}},
        command=CommandTerm(
            commands.uniform_position,
            params={"x": work.goal[0], "y": work.goal[1], "z": (rest, rest)},
            resample_s=ONCE,
        ),
        success=SuccessCfg(
            condition=Term(success.object_placed, params={"threshold": 0.01, "max_speed": 0.005, "clearance": 0.05}),
            minimal_height=rest + 0.01,
        ),
        observations={
            "state": {
                "joint_positions": ObservationTerm(observations.joint_pos),
                "end_effector_position": ObservationTerm(observations.ee_position),
                "end_effector_orientation": ObservationTerm(observations.ee_orientation),
                "cube_position": ObservationTerm(observations.object_position),
                "cube_orientation": ObservationTerm(observations.object_orientation),
                "cube_target_position": ObservationTerm(observations.goal_position),
            },
        },
        events={
            "reset_object_position": Term(
                events.object_position_uniform, params={"x": work.cube[0], "y": work.cube[1], "z": (0.0, 0.0)}
            ),
        },
        rewards={
            "reaching_object": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1}),
            "goal_tracking": RewardTerm(rewards.goal_distance, weight=10.0, params={"std": 0.3}),
            "goal_tracking_fine": RewardTerm(rewards.goal_distance, weight=10.0, params={"std": 0.05}),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        curriculum={},
        terminations={
            "time_out": DoneTerm(terminations.time_out, time_out=True),
            "object_off_table": DoneTerm(
                terminations.object_off_table,
                params={"center": work.scene.table_center, "size": work.scene.table_size},
            ),
        },
    )


def presets(work: Work) -> Presets:
    """Preset -> robot -> config; the default first."""
    return {"default": functools.partial(default, work=work)}
