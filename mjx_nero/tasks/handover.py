"""Handover: one arm picks up a bar, and another takes it over in the air and brings it to its own side.

The arms face each other. The bar lies beside the first one, out of the other's reach; the goal is beside the other one.
"""

import functools
from collections.abc import Callable

from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, CurriculumCfg, EnvCfg, Presets, SuccessCfg
from mjx_nero.mdp import actions, commands, events, handover, metrics, observations, rewards, success
from mjx_nero.mdp.terms import ONCE, CommandTerm, DoneTerm, Groups, MetricTerm, ObservationTerm, RewardTerm, Term, groups
from mjx_nero.sim import contacts
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SimCfg
from mjx_nero.tasks.facing import ALONG, BAR, SIDE, TAKER, YAW, Pair, pair
from mjx_nero.tasks.usual import PRECISE, arm_state, nearer, on_table, stays_on_table

THERE, STILL = 0.03, 0.05  # [m, m/s] tolerances at the goal
CLASH = 0.09  # [m] distance of the grasp points below which the hands, 7 cm wide each way, would collide


def both_arms() -> dict[str, Term]:
    """Lists action terms: velocities and a continuous gripper for each robot (``tasks.building.lets_go``)."""
    own = {"arm": "arm", "gripper": "gripper", "taker_arm": f"{TAKER}/arm", "taker_gripper": f"{TAKER}/gripper"}
    kinds: dict[str, Callable] = {"arm": actions.JointVelocity, "gripper": actions.ContinuousGripper}
    grippers = {name: group for name, group in own.items() if name.endswith("gripper")}
    return {
        "delay": Term(actions.Delay, params={"steps": (0, 1)}),
        **{name: Term(kinds[name.removeprefix("taker_")], params={"group": group}) for name, group in own.items()},
        **{f"{name}_anti_windup": Term(actions.AntiWindup, params={"group": group}) for name, group in grippers.items()},
        **{f"{name}_speed_limit": Term(actions.SpeedLimit, params={"group": group}) for name, group in grippers.items()},
    }


def _observations(two: Pair) -> Groups:
    one, hands = {"object": BAR}, {"hands": two.hands}
    state = {
        **arm_state(),
        "taker_position": ObservationTerm(observations.ee_position, params={"robot": TAKER}),
        "ee_orientation": ObservationTerm(observations.ee_orientation),
        "taker_orientation": ObservationTerm(observations.ee_orientation, params={"robot": TAKER}),
        "giver_way": ObservationTerm(handover.way, params={"taker": False, **hands}, noise=0.002),
        "taker_way": ObservationTerm(handover.way, params={"taker": True, **hands}, noise=0.002),
        "axis": ObservationTerm(handover.axis, params=hands, noise=0.01),
        "to_meeting": ObservationTerm(handover.to_meeting, params={"meet": two.meet, **hands}, noise=0.002),
        "object_to_goal": ObservationTerm(observations.object_to_goal, params=one, noise=0.002),
        "holders": ObservationTerm(handover.holders, params=hands),
        "fingers": ObservationTerm(handover.fingers, params=hands),
        "actions": ObservationTerm(observations.last_action),
    }
    seen = {
        "object_velocity": ObservationTerm(observations.object_velocity, params=one),
        "object_orientation": ObservationTerm(observations.object_orientation, params=one),
    }
    return groups(state, seen)


def _rewards(two: Pair) -> dict[str, RewardTerm]:
    hands, meet = {"hands": two.hands}, {"hands": two.hands, "meet": two.meet}
    return {
        "reaching_object": RewardTerm(handover.reached, weight=1.0, params={"std": 0.1, **hands}),
        "holding_object": RewardTerm(handover.held, weight=3.0, params=hands),
        "presenting": RewardTerm(handover.presented, weight=4.0, params={"std": 0.3, **meet}),
        "presenting_near": RewardTerm(handover.presented, weight=4.0, params={"std": 0.1, **meet}),
        "pointing": RewardTerm(handover.pointed, weight=3.0, params={"std": 0.5, **hands}),
        "meeting": RewardTerm(handover.met, weight=3.0, params={"std": 0.3, **hands}),
        "meeting_near": RewardTerm(handover.met, weight=5.0, params={"std": 0.05, **hands}),
        "taking": RewardTerm(handover.taken, weight=8.0, params=hands),
        "releasing": RewardTerm(handover.released, weight=8.0, params=hands),
        "leaving": RewardTerm(handover.left, weight=8.0, params=hands),
        **nearer("bringing", handover.brought, **hands),
        "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
        "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
    }


def _goal(two: Pair) -> CommandTerm:
    """The goal: beside the taker, out from its base, in the giver's root frame."""
    (low, high), root = (two.taker.low, two.taker.high), two.giver.robot.base_pos[2]
    across, out = two.ways(two.taker)
    still = (0.0, 0.0)
    place = {
        "x": regions.span(two.between + across[0], two.between + across[1]),
        "y": out,
        "z": regions.span(min((low + high) / 2, two.height) - root, two.height - root),
    }
    heading = {"roll": still, "pitch": still, "yaw": (round(-SIDE, 6), round(-SIDE, 6))}
    return CommandTerm(commands.uniform_pose, params={**place, **heading}, resample_s=ONCE)


def _start(two: Pair) -> dict[str, Term]:
    """The bar: beside the giver, out from its base."""
    (x, y, _), (across, out) = two.giver.robot.base_pos, two.ways(two.giver)
    place = regions.span(x + across[0], x + across[1]), regions.span(y - out[1], y - out[0])
    yaw = regions.span(-SIDE - YAW, YAW - SIDE)
    return {
        **on_table(place, object=BAR),
        "reset_object_yaw": Term(events.object_yaw_uniform, params={"yaw": yaw, "object": BAR}),
    }


def default(robot: RobotCfg, taker: RobotCfg | None = None) -> EnvCfg:
    """Success: for half a second, the second hand alone holds the bar still within 3 cm of the goal, after the first held it.

    Args:
        robot: the arm that gives.
        taker: the arm that takes; None: another one of the same kind.

    Raises:
        UserError: one of the arms cannot do its part.
    """
    two = pair(robot, taker or robot)
    scene, hands, one = two.scene, {"hands": two.hands}, {"object": BAR}
    held = {"minimal_height": two.hands.minimal_height, "grasp_radius": round(ALONG + two.hands.radius, 4)}
    slowest = max(two.giver.robot.max_step, two.taker.robot.max_step)
    return EnvCfg(
        robot=two.giver.robot,
        scene=scene,
        sim=contacts.sized(two.giver.robot, scene, SimCfg(ramp=slowest > 0)),
        episode_length_s=15.0,
        actions=both_arms(),
        controllers={"hand_over": two.script()},
        command=_goal(two),
        success=SuccessCfg(
            condition=Term(handover.HeldAtGoal, params={"threshold": THERE, "max_speed": STILL, **hands}),
            distance=Term(success.object_distance, params=one),
        ),
        metrics={
            **metrics.grasping(**held, **one),
            "handed_over": MetricTerm(handover.HandedOver, params=hands, over="rate"),
        },
        observations=_observations(two),
        events=_start(two),
        rewards=_rewards(two),
        curriculum=CurriculumCfg(expert_starts=0.5),
        training=PRECISE,
        budget=Budget(steps=300_000_000, success=0.85),
        terminations={
            **stays_on_table(scene, **one),
            "hands_clash": DoneTerm(handover.hands_clash, params={"taker": TAKER, "apart": CLASH}),
        },
    )


PRESETS: Presets = {"default": default}


def taken_by(taker: RobotCfg) -> Presets:
    """The presets with ``taker`` as the arm that takes the bar."""
    return {"default": functools.partial(default, taker=taker)}
