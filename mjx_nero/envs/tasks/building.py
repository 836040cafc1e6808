"""What ``place`` and ``stack`` have in common: how near is there, what leads there, and who can do it. See ``mdp.towers``."""

import dataclasses
import functools
import math
from typing import Any

from mjx_nero.envs import regions
from mjx_nero.envs.regions import Regions
from mjx_nero.envs.task import SuccessCfg
from mjx_nero.mdp import actions, metrics, rewards, terminations, towers
from mjx_nero.mdp.terms import DoneTerm, MetricTerm, RewardTerm, Term
from mjx_nero.sim import contacts, grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.types import UserError

STILL = 0.005  # [m/s]
FLAT = 0.005  # [m] how far above or below its place an object may be
LIFTED = 0.01  # [m] above where it lies
AWAY = 0.02  # [m] the pads are as far above an object that the hand has left
CLOSING = 0.5  # [s] the fingers take to close, at least: at a metre a second they throw what they meet
PRESS = 0.075  # [s] they press before an object is lifted, at least
# Shares of the ten phases that a control step takes: 305 steps in all, 25 of them to close and 20 to open.
QUICK = (0.02, 0.0334, 0.1, 0.04, 0.0334, 0.0134, 0.0286, 0.05, 0.04, 0.2)


def lets_go(acts: dict[str, Term]) -> dict[str, Term]:
    """With anti-windup for a gripper that lets go at once, before the speed limit, which starts where it leaves the targets."""
    others = dict(acts)
    limit = others.pop("speed_limit")
    return {**others, "anti_windup": Term(actions.AntiWindup), "speed_limit": limit}


@dataclasses.dataclass(frozen=True)
class Tower:
    """A tower that a robot builds.

    Attributes:
        objects: from the bottom up, as in ``mdp.towers``.
        edge: how high an object is, and how far apart the fingers hold it [m].
        aside: how far from its place an object may be, along the table, and come straight down (``towers.approached``) [m].
        angle: from the goal's orientation, likewise [rad].
        lifted: above where it lies an object is held [m].
    """

    robot: RobotCfg
    scene: SceneCfg
    objects: tuple[str, ...]
    edge: float
    aside: float
    angle: float = math.pi
    lifted: float = LIFTED

    @property
    def there(self) -> Regions:
        """Where the robot works."""
        return regions.of(self.robot)

    @property
    def held(self) -> dict[str, float]:
        """An object is held if it is this high, and this near to the grasp point [m]."""
        return {"minimal_height": self.edge / 2 + self.lifted, "grasp_radius": regions.near(self.there)}

    @property
    def place(self) -> dict[str, towers.Place]:
        """Where objects belong, and how near is there: what all terms of a tower take."""
        away = round(self.edge / 2 + self.robot.pad[0] / 2 + AWAY, 4)
        within = (self.aside, FLAT, self.angle)
        return {"place": towers.Place(tower=self.objects, rise=self.edge, within=within, clearance=away, **self.held)}

    @property
    def done(self) -> dict[str, Any]:
        """All stand, at rest, and the hand is away."""
        return {**self.place, "max_speed": STILL}

    @property
    def builder(self) -> RobotCfg:
        """The robot as its own controller works it: its weight carried by the drives, and fingers as quick as real ones."""
        fingers = self.robot.gripper
        slow = (min(v, abs(a - b) / CLOSING) for v, a, b in zip(fingers.speed, fingers.open, fingers.close, strict=True))
        return dataclasses.replace(
            self.robot, gravity_compensation=True, gripper=dataclasses.replace(fingers, speed=tuple(round(v, 4) for v in slow))
        )

    @functools.cached_property
    def slow(self) -> float:
        """What the fingers need to close beyond the time that ``QUICK`` has for it [s]."""
        return round(max(0.0, grasp.closing_time(self.builder, self.edge) + PRESS - CLOSING), 2)

    @property
    def extra(self) -> float:
        """... and for all objects, to open, too [s]."""
        return round(2 * self.slow * (len(self.objects) - 1), 2)

    def sim(self) -> SimCfg:
        """Buffers by count."""
        return contacts.sized(self.robot, self.scene, SimCfg())

    def success(self) -> SuccessCfg:
        """For half a second at the end, without a touch of the hand."""
        return SuccessCfg(condition=Term(towers.left_alone, params=self.done), distance=Term(towers.distance, params=self.place))

    def rewards(self) -> dict[str, RewardTerm]:
        """Reach, grasp, lift, align, lower, release, retreat: what is paid for one is paid on for the next ones.

        The fingers' targets are paid for, from shut on, and a gripper that is told too firmly to hold costs: else nothing that
        noise tries for a step at a time shows that letting go pays.
        """
        place = self.place
        way = {**place, "over": round(0.75 * self.edge, 4), "flat": self.aside}
        fingers = {"open": self.robot.gripper.open, "hold": self.robot.gripper.close}
        turned = {"aligning": RewardTerm(towers.aligned, weight=10.0, params={"std": 0.3, **place})}
        return {
            "reaching_object": RewardTerm(towers.reached, weight=1.0, params={"std": 0.1, **place}),
            "holding_object": RewardTerm(towers.carried, weight=5.0, params=place),
            "approaching": RewardTerm(towers.approached, weight=10.0, params={"std": 0.3, **way}),
            "approaching_near": RewardTerm(towers.approached, weight=10.0, params={"std": 0.1, **way}),
            "approaching_fine": RewardTerm(towers.approached, weight=15.0, params={"std": 0.03, **way}),
            **(turned if self.angle < math.pi else {}),
            "standing": RewardTerm(towers.standing, weight=10.0, params=place),
            "releasing": RewardTerm(towers.told_to_open, weight=10.0, params={**place, **fingers}),
            "leaving": RewardTerm(towers.left, weight=10.0, params=place),
            "completed": RewardTerm(towers.completed, weight=15.0, params=self.done),
            "gripper_action": RewardTerm(rewards.gripper_action_l2, weight=-0.1),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        }

    def metrics(self) -> dict[str, MetricTerm]:
        """Of the first object that is to be moved."""
        return metrics.grasping(object=self.objects[1], **self.held)

    def terminations(self) -> dict[str, DoneTerm]:
        """The time is over, or an object has left the table."""
        table = {"center": self.scene.table_center, "size": self.scene.table_size}
        off = {
            f"{name}_off_table": DoneTerm(terminations.object_off_table, params={**table, "object": name})
            for name in self.scene.objects
        }
        return {"time_out": DoneTerm(terminations.time_out, time_out=True), **off}

    def controllers(self) -> dict[str, dict[str, Any]]:
        """Pick and place by inverse kinematics, object by object.

        Raises:
            UserError: the robot's hand does not point down as high as the tower is.
        """
        there, (low, high) = self.there, regions.box(self.robot, "pick", "where on the table it can grasp")[2]
        top = low + (len(self.objects) - 1 - (towers.GOAL in self.objects)) * self.edge
        if top + LIFTED > high:
            needs = f"its hand has to point down {top + LIFTED:.3g} m above its root, and pick ends at {high:.3g} m"
            raise UserError(f"{self.robot.name} cannot build a tower that high: {needs}")
        # Over a tower it may have to lean: ``pick`` is where it points straight down everywhere.
        below = max(0.0, -there.offset[2])  # the grasp point is below the middle of what it holds
        leave = max(there.travel, top + max(self.edge, below + self.place["place"].clearance + LIFTED))
        fields = {
            "tower": self.objects,
            "rise": self.edge,
            "events_dt": QUICK,
            "wait": self.slow,
            "end_effector_initial_height": round(leave, 4),
            "end_effector_offset": there.offset,
            "motion": "ik",
            "turn": self.angle < math.pi,
            **regions.ik(self.robot, "ik."),
        }
        return {"pick_place": fields}
