"""Handover: one arm takes a bar from the table, another takes it over in the air and brings it to its own side.

Two arms face one another. The bar lies beside the first one, out of the other's reach; the goal is beside the other one.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from mjx_nero.envs import regions
from mjx_nero.envs.task import SHOWN, Budget, CurriculumCfg, EnvCfg, Presets, SuccessCfg, arm_state, nearer, stays_on_table
from mjx_nero.envs.tasks.building import working
from mjx_nero.mdp import actions, commands, events, handover, metrics, observations, rewards, success
from mjx_nero.mdp.handover import Hands
from mjx_nero.mdp.terms import (
    ONCE,
    CommandTerm,
    DoneTerm,
    MetricTerm,
    ObservationGroup,
    ObservationTerm,
    RewardTerm,
    Term,
    privileged,
)
from mjx_nero.sim import contacts, grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, SimCfg
from mjx_nero.types import UserError

BAR, TAKER = "bar", "taker"
ALONG, HALF = 0.09, 0.13  # [m] from the bar's middle to a hand, and to its end
SIDE = math.pi / 2  # [rad] how far each arm turns between its own side and the meeting
YAW = 0.25  # [rad] greatest turn of the bar at the start, from straight away from the first arm
WIDER = 2.0  # opening of the hands, in widths of the bar
CLOSING = 0.4  # [s] least closing time of the script's fingers
THERE, STILL = 0.03, 0.05  # [m, m/s] tolerances at the goal
# Least deviation of a learner's actions: at half an arm's length, one of 0.1 moves the bar faster than what is still.
CALMEST = 0.05
AWAY = 0.05  # [m] a hand so far from the bar's axis has left it
CLASH = 0.09  # [m] grasp points so near to one another: the hands, 7 cm wide each way, would run into one another
JOINTS = 6  # of an arm that can point its hand down anywhere around it


@dataclasses.dataclass(frozen=True)
class Side:
    """One robot, as the task sees it.

    Attributes:
        robot: mounted, its home turned to its own side.
        near, far: least and greatest distance of the grasp point from the base, along the table [m].
        low, high: heights at which its hand points down, from the root [m].
        turn: of the first joint from home to the meeting [rad].
    """

    robot: RobotCfg
    near: float
    far: float
    low: float
    high: float
    turn: float

    @property
    def middle(self) -> float:
        """Distance from the base at which it meets the other [m]."""
        return (self.near + self.far) / 2

    @property
    def across(self) -> float:
        """Half the width of its region, across the way out from its base [m]."""
        return round(min(self.near * math.tan(YAW), self.far / 4), 4)


def _side(robot: RobotCfg, edge: float, faces: float, aside: float) -> Side:
    """Mounts a robot so that it faces ``faces`` [rad], and turns its home by ``aside`` from there [rad].

    Raises:
        UserError: the robot has too few joints, or its first one does not turn it so far about the vertical.
    """
    if len(robot.arm.joints) < JOINTS:
        few = f"{robot.name} has {len(robot.arm.joints)} joints"
        raise UserError(f"{few}: to hand a bar over, an arm needs {JOINTS}, so that its hand points down all around")
    pick = np.array(regions.box(robot, "pick", "where on the table it can grasp"))
    regions.box(robot, "hold", "where it can hold what it has grasped")
    quarter = round(float(np.arctan2(*pick.mean(1)[1::-1])) / SIDE)  # of a turn: its front
    front = np.sort(np.abs(pick[quarter % 2]))
    half = (faces - quarter * SIDE) / 2
    quat = np.zeros(4)
    mujoco.mju_mulQuat(quat, np.array([math.cos(half), 0.0, 0.0, math.sin(half)]), np.array(robot.base_quat))
    w, x, y, z = (round(float(v), 6) for v in quat)
    robot = dataclasses.replace(working(grasp.opened(robot, WIDER * edge)), base_quat=(w, x, y, z))
    ahead = regions.turn_to(robot, math.cos(faces), math.sin(faces))
    home = ahead + _turned(robot, ahead, faces, aside)
    arm = dataclasses.replace(robot.arm, home=(round(robot.arm.home[0] + home, 4), *robot.arm.home[1:]))
    margin = 0.2 * float(np.ptp(front))
    return Side(
        robot=dataclasses.replace(robot, arm=arm),
        near=round(float(front[0]) + margin, 4),
        far=round(float(front[1]) - margin, 4),
        low=float(pick[2, 0]),
        high=float(pick[2, 1]),
        turn=round(ahead - home, 4),
    )


def _turned(robot: RobotCfg, ahead: float, faces: float, aside: float) -> float:
    """Turn of the first joint from straight ahead to its own side [rad]."""
    to = regions.turn_to(robot, math.cos(faces + aside), math.sin(faces + aside)) - ahead
    if abs(abs(to) - SIDE) > 0.01:
        raise UserError(f"{robot.name}: its first joint does not turn it by 90 degrees about the vertical: a handover needs that")
    return to


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two robots that face one another, with the bar between them."""

    giver: Side
    taker: Side
    edge: float

    @property
    def height(self) -> float:
        """Height of the bar where it changes hands, from the table [m]."""
        return round(min(side.low + 0.75 * (side.high - side.low) for side in (self.giver, self.taker)), 4)

    @property
    def meet(self) -> tuple[float, float, float]:
        """The bar's middle where it changes hands, from the giver's root [m]."""
        return round(self.giver.middle + ALONG, 4), 0.0, round(self.height - self.giver.robot.base_pos[2], 4)

    @property
    def between(self) -> float:
        """Distance between the bases [m]."""
        return round(self.giver.middle + 2 * ALONG + self.taker.middle, 4)

    @property
    def mate(self) -> RobotCfg:
        """The taker in its place."""
        x, y, _ = self.giver.robot.base_pos
        place = (round(x + self.between, 4), y, self.taker.robot.base_pos[2])
        return dataclasses.replace(self.taker.robot, base_pos=place)

    @property
    def bar(self) -> ObjectCfg:
        """The bar: as heavy as the cube that the weaker hand lifts."""
        mass = min(grasp.cube_for(side.robot).mass for side in (self.giver, self.taker))
        return ObjectCfg(size=(2 * HALF, self.edge, self.edge), mass=mass, rgba=(0.85, 0.55, 0.2, 1.0))

    @property
    def scene(self) -> SceneCfg:
        """Table, bar and both robots."""
        (x, y, _), wide = self.giver.robot.base_pos, max(self.giver.far, self.taker.far) + 2 * HALF + 0.1
        return SceneCfg(
            objects={BAR: self.bar},
            robots={TAKER: self.mate},
            goal=BAR,
            table_center=(round(x + self.between / 2, 4), y),
            table_size=(round(self.between + 2 * max(self.giver.near, 0.2), 4), round(2 * wide, 4)),
            look_at=(round(x + self.between / 2, 4), y, 0.12),
            view_distance=round(1.1 * self.between + 0.8, 2),
            view_from=(0.35, -0.85, 0.55),
        )

    @property
    def hands(self) -> Hands:
        """The two hands and the bar."""
        giving, taking = ((side.robot.gripper.open, side.robot.gripper.close) for side in (self.giver, self.taker))
        return Hands(
            object=BAR,
            taker=TAKER,
            along=ALONG,
            half=HALF,
            radius=0.04,
            minimal_height=round(self.edge / 2 + 0.03, 4),
            clearance=AWAY,
            giving=giving,
            taking=taking,
        )

    def ways(self, side: Side) -> tuple[tuple[float, float], tuple[float, float]]:
        """Region of the bar's middle beside a robot, from its root: across, and out from its base [m]."""
        return (-side.across, side.across), (round(side.near + ALONG, 4), round(side.far + ALONG, 4))

    def script(self) -> dict[str, Any]:
        """Settings of the script."""
        sides, edge = (self.giver, self.taker), self.edge
        ik = regions.ik(self.giver.robot, "ik.") | regions.ik(self.taker.robot, "ik.")
        return {
            "object": BAR,
            "taker": TAKER,
            "along": ALONG,
            "meet": self.meet,
            "turns": tuple(side.turn for side in sides),
            "lowest": tuple(round(grasp.lowest(side.robot.pad), 4) for side in sides),
            "beyond": tuple(grasp.beyond(side.robot, edge) for side in sides),
            "closing": tuple(round(max(CLOSING, grasp.closing_time(side.robot, edge)), 3) for side in sides),
            **ik,
        }


def pair(giver: RobotCfg, taker: RobotCfg) -> Pair:
    """Places two robots face to face. Raises the errors of ``_side`` and of ``grasp.cube_for``."""
    edge = min(grasp.cube_for(robot).size[0] for robot in (giver, taker))
    giver, taker = (grasp.shut(robot, edge) for robot in (giver, taker))
    return Pair(_side(giver, edge, 0.0, -SIDE), _side(taker, edge, math.pi, -SIDE), edge)


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


def _observations(two: Pair) -> dict[str, ObservationGroup]:
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
    return {"state": ObservationGroup(state), "privileged_state": privileged(state, seen)}


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
    """The goal: beside the taker, out from its base, as the giver's root sees it."""
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
    place = {"x": regions.span(x + across[0], x + across[1]), "y": regions.span(y - out[1], y - out[0]), "z": (0.0, 0.0)}
    yaw = regions.span(-SIDE - YAW, YAW - SIDE)
    return {
        "reset_object_position": Term(events.object_position_uniform, params={**place, "object": BAR}),
        "reset_object_yaw": Term(events.object_yaw_uniform, params={"yaw": yaw, "object": BAR}),
    }


def default(robot: RobotCfg, taker: RobotCfg | None = None) -> EnvCfg:
    """Success: the second hand alone holds the bar, which the first had held, within 3 cm of the goal, still, for half a second.

    Args:
        robot: the arm that gives.
        taker: the arm that takes; None: another one of the same kind.

    Raises:
        UserError: one of them cannot do that.
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
        training={**SHOWN, "min_std": CALMEST},
        budget=Budget(steps=300_000_000, success=0.85),
        terminations={
            **stays_on_table(scene, **one),
            "hands_clash": DoneTerm(handover.hands_clash, params={"taker": TAKER, "apart": CLASH}),
        },
    )


def presets() -> Presets:
    """Maps preset -> robot -> config, the default first."""
    return {"default": default}


def taken_by(taker: RobotCfg) -> Presets:
    """The presets with another robot that takes the bar."""
    return {"default": functools.partial(default, taker=taker)}
