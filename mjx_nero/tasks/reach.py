"""Reach: bring the end effector to a commanded pose and keep it there. The Isaac Lab recipes' first task."""

import dataclasses
import functools

from mjx_nero.config.bounds import Range
from mjx_nero.envs.task import Budget, CurriculumCfg, EnvCfg, Presets, SuccessCfg, joint_actions
from mjx_nero.mdp import commands, events, observations, rewards, success, terminations
from mjx_nero.mdp.terms import CommandTerm, DoneTerm, ObservationGroup, ObservationTerm, RewardTerm, Term
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tasks import sim2real as sim2reals
from mjx_nero.tasks.usual import CALM, step_weights, velocity_actions
from mjx_nero.types import UserError

STILL: Range = (0.0, 0.0)
BUDGET = Budget(steps=60_000_000, steps_on_cpu=2_000_000, success=0.98)  # quick to learn: nothing to grasp
# The recipe's learner settings (RSL-RL).
RUNNER = {
    "num_epochs": 8,
    "num_minibatches": 4,
    "learning_rate": 1e-3,
    "max_learning_rate": 1e-2,
    "desired_kl": 0.01,
    "entropy_cost": 0.001,
    "discounting": 0.99,
    "network.actor": (64, 64),
    "network.critic": (64, 64),
}


def scene(like: SceneCfg) -> SceneCfg:
    """Removes the objects, and makes the table visual only."""
    return dataclasses.replace(like, table=False, objects={})


@dataclasses.dataclass(frozen=True)
class ReachSetup:
    """Numbers that differ from robot to robot.

    Attributes:
        position: ``x``, ``y``, ``z`` of the goals [m], robot root frame; None: the robot's ``workspace``.
        orientation: roll, pitch and yaw of the goals [rad]; None: only the position counts.
        start: range of the factors of the home position at reset.
        scene: cameras and table.
        decimation: physics steps of 1/60 s per control step.
        episode_length_s: duration of an episode [s].
    """

    position: tuple[Range, Range, Range] | None = None
    orientation: tuple[Range, Range, Range] | None = None
    start: Range = (0.5, 1.5)
    scene: SceneCfg = scene(SceneCfg())
    decimation: int = 2
    episode_length_s: float = 12.0


def isaac(robot: RobotCfg, setup: ReachSetup) -> EnvCfg:
    """The Isaac Lab recipe's MDP."""
    box = setup.position or robot.workspace
    if box is None:
        raise UserError(f"{robot.name} has no workspace to command from: add the field to its robot.yaml")
    turned = setup.orientation is not None
    at_goal = {"threshold": 0.02}
    # Nothing touches, so joint limits are the only constraints to solve.
    objects, sim = setup.scene, SimCfg(dt=1 / 60, decimation=setup.decimation, iterations=3, ls_iterations=6, elliptic=False)
    if robot.folder:  # imported
        objects = scenes.around(robot, objects)
    angles = dict(zip(("roll", "pitch", "yaw"), setup.orientation or (STILL,) * 3, strict=True))
    return EnvCfg(
        robot=robot,
        scene=dataclasses.replace(objects, goal="frame" if turned else "sphere"),
        sim=sim,
        episode_length_s=setup.episode_length_s,
        actions=joint_actions(scale=0.5, gripper=False),
        command=CommandTerm(commands.uniform_pose, params={**dict(zip("xyz", box, strict=True)), **angles}, resample_s=5.0),
        success=SuccessCfg(
            condition=Term(success.ee_at_pose, params={**at_goal, "angle": 0.1})
            if turned
            else Term(success.ee_at_goal, params=at_goal),
            distance=Term(success.ee_distance),
            follows=True,
        ),
        observations={
            "state": ObservationGroup(
                {
                    "joint_pos": ObservationTerm(observations.joint_pos_rel, noise=0.01),
                    "joint_vel": ObservationTerm(observations.joint_vel_rel, noise=0.01),
                    "pose_command": ObservationTerm(observations.pose_command),
                    "actions": ObservationTerm(observations.last_action),
                }
            ),
        },
        events={"reset_robot_joints": Term(events.joints_by_scale, params={"low": setup.start[0], "high": setup.start[1]})},
        rewards={
            "position_tracking": RewardTerm(rewards.ee_position_error, weight=-0.2),
            "position_tracking_fine": RewardTerm(rewards.ee_goal_distance, weight=0.1, params={"std": 0.1}),
            **({"orientation_tracking": RewardTerm(rewards.ee_orientation_error, weight=-0.1)} if turned else {}),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-1e-4),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        },
        curriculum=CurriculumCfg(weights=step_weights(4500, action_rate=-5e-3, joint_vel=-1e-3)),
        terminations={"time_out": DoneTerm(terminations.time_out, time_out=True)},
        training=RUNNER,
        budget=BUDGET,
    )


def default(robot: RobotCfg, setup: ReachSetup) -> EnvCfg:
    """The recipe, with the error observed, and rewarded down to the last centimetre."""
    recipe = isaac(robot, setup)
    turned = setup.orientation is not None
    state = {
        **recipe.observations["state"].terms,
        "ee_to_goal": ObservationTerm(observations.ee_to_goal),
        **({"ee_turn_to_goal": ObservationTerm(observations.ee_turn_to_goal)} if turned else {}),
        "target_error": ObservationTerm(observations.target_error),
    }
    fine = {"position_tracking_finest": RewardTerm(rewards.ee_goal_distance, weight=0.2, params={"std": 0.02})}
    if turned:
        fine["pose_tracking"] = RewardTerm(rewards.ee_goal_pose, weight=0.4, params={"std": 0.1, "angle_std": 0.2})
    return dataclasses.replace(
        recipe,
        actions=velocity_actions(gripper=False),
        observations={"state": ObservationGroup(state)},
        rewards={**recipe.rewards, **fine},
        training=CALM,
    )


def sim2real(robot: RobotCfg, setup: ReachSetup) -> EnvCfg:
    """The default, plus the differences between a simulated arm and a real one: see ``tasks.sim2real``."""
    return sim2reals.randomized(default(robot, setup))


def presets(setup: ReachSetup | None = None) -> Presets:
    """Maps preset -> robot -> config, the default first."""
    setup = setup or ReachSetup()
    return {
        "default": functools.partial(default, setup=setup),
        "isaac": functools.partial(isaac, setup=setup),
        "sim2real": functools.partial(sim2real, setup=setup),
    }
