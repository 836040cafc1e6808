"""The parts that ``place`` and ``stack`` share: tolerances, rewards and the controller. See ``mdp.towers``."""

import dataclasses
import functools
import math
from typing import Any

from mjx_nero.envs import regions
from mjx_nero.envs.regions import Regions
from mjx_nero.envs.task import EnvCfg, SuccessCfg
from mjx_nero.envs.things.placing import AWAY
from mjx_nero.mdp import actions, metrics, rewards, terminations, towers
from mjx_nero.mdp.terms import DoneTerm, MetricTerm, RewardTerm, Term
from mjx_nero.sim import contacts, grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tasks.usual import SHOWN, nearer, velocity_actions
from mjx_nero.types import UserError

STILL = 0.005  # [m/s]
FLAT = 0.005  # [m] tolerance of an object's height at its place
LIFTED = 0.01  # [m] height of a lifted object above where it lay
RESTING = 0.3  # [rad/s] joint speed at which a hand that has left no longer counts as resting
CLOSING = 0.5  # [s] least closing time: fingers at a metre a second throw what they hit
PRESS = 0.075  # [s] least time the fingers press before an object is lifted
# Share of each of the ten phases that one control step covers: 305 steps in all, 25 to close and 20 to open.
QUICK = (0.02, 0.0334, 0.1, 0.04, 0.0334, 0.0134, 0.0286, 0.05, 0.04, 0.2)


def lets_go() -> dict[str, Term]:
    """Lists action terms: arm velocities, and a continuous gripper that lets go at once.

    Anti-windup precedes the speed limit, which starts from its targets.
    """
    others = {**velocity_actions(), "gripper": Term(actions.ContinuousGripper)}
    limit = others.pop("speed_limit")
    return {**others, "anti_windup": Term(actions.AntiWindup), "speed_limit": limit}


def working(robot: RobotCfg) -> RobotCfg:
    """Returns the robot as its own controller runs it: with gravity compensation, and fingers no faster than real ones."""
    fingers = robot.gripper
    slow = (min(v, abs(a - b) / CLOSING) for v, a, b in zip(fingers.speed, fingers.open, fingers.close, strict=True))
    return dataclasses.replace(
        robot, gravity_compensation=True, gripper=dataclasses.replace(fingers, speed=tuple(round(v, 4) for v in slow))
    )


@dataclasses.dataclass(frozen=True)
class Tower:
    """A tower and the robot that builds it.

    Attributes:
        objects: the objects from the bottom up, as in ``mdp.towers``.
        edge: an object's height, and its width between the fingers [m].
        aside: tolerance along the table, and radius within which an object may come straight down (``towers.approached``) [m].
        angle: tolerance of the angle from the goal's orientation [rad].
        lifted: height above its resting place from which an object counts as held [m].
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
        """The robot's regions."""
        return regions.of(self.robot)

    @property
    def held(self) -> dict[str, float]:
        """The least height of a held object and its greatest distance from the grasp point [m]."""
        return {"minimal_height": self.edge / 2 + self.lifted, "grasp_radius": regions.near(self.there)}

    @property
    def place(self) -> dict[str, towers.Place]:
        """The parameter that all terms of a tower share: where objects belong, and with what tolerance."""
        away = round(self.edge / 2 + self.robot.pad[0] / 2 + AWAY, 4)
        within = (self.aside, FLAT, self.angle)
        return {"place": towers.Place(tower=self.objects, rise=self.edge, within=within, clearance=away, **self.held)}

    @property
    def done(self) -> dict[str, Any]:
        """Parameters of the finished tower: all objects stand at rest, and the hand is away."""
        return {**self.place, "max_speed": STILL}

    @property
    def builder(self) -> RobotCfg:
        """The robot as its own controller runs it (``working``)."""
        return working(self.robot)

    @functools.cached_property
    def slow(self) -> float:
        """Closing time that the fingers need beyond the time in ``QUICK`` [s]."""
        return round(max(0.0, grasp.closing_time(self.builder, self.edge) + PRESS - CLOSING), 2)

    @property
    def extra(self) -> float:
        """Extra time for closing and opening on all objects [s]."""
        return round(2 * self.slow * (len(self.objects) - 1), 2)

    def task(self, length_s: float, **own: Any) -> EnvCfg:
        """Makes the task of building the tower.

        Args:
            length_s: duration of an episode with quick fingers [s].
            own: fields that a task adds or replaces.
        """
        shared = {
            "robot": self.builder,
            "scene": self.scene,
            # Stiff drives would jerk at new targets, and cubes would slide in the jaw, so targets ramp.
            "sim": contacts.sized(self.robot, self.scene, SimCfg(ramp=self.robot.max_step > 0)),
            "episode_length_s": length_s + self.extra,
            "rewards": self.rewards(),
            "success": self.success(),
            "metrics": self.metrics(),
            "terminations": self.terminations(),
            "controllers": self.controllers(),
            "actions": lets_go(),
            "training": SHOWN,
        }
        return EnvCfg(**{**shared, **own})

    def success(self) -> SuccessCfg:
        """Requires a built tower that the hand does not touch, for half a second at the end."""
        return SuccessCfg(condition=Term(towers.left_alone, params=self.done), distance=Term(towers.distance, params=self.place))

    def rewards(self) -> dict[str, RewardTerm]:
        """Rewards reaching, grasping, lifting, aligning, lowering, releasing and leaving; each stage keeps the earlier rewards.

        It rewards opening targets and penalises large gripper actions; otherwise single noisy steps never show that releasing
        pays.
        """
        place = self.place
        way = {**place, "over": round(0.75 * self.edge, 4), "flat": self.aside}
        fingers = {"open": self.robot.gripper.open, "hold": self.robot.gripper.close}
        turned = {"aligning": RewardTerm(towers.aligned, weight=10.0, params={"std": 0.3, **place})}
        return {
            "reaching_object": RewardTerm(towers.reached, weight=1.0, params={"std": 0.1, **place}),
            "holding_object": RewardTerm(towers.carried, weight=5.0, params=place),
            **nearer("approaching", towers.approached, **way),
            **(turned if self.angle < math.pi else {}),
            "standing": RewardTerm(towers.standing, weight=10.0, params=place),
            "releasing": RewardTerm(towers.told_to_open, weight=10.0, params={**place, **fingers}),
            "leaving": RewardTerm(towers.left, weight=10.0, params=place),
            "completed": RewardTerm(towers.completed, weight=15.0, params=self.done),
            "resting": RewardTerm(towers.rested, weight=10.0, params={**self.done, "std": RESTING}),
            "gripper_action": RewardTerm(rewards.gripper_action_l2, weight=-0.1),
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        }

    def metrics(self) -> dict[str, MetricTerm]:
        """Grasp metrics of the first object to move."""
        return metrics.grasping(object=self.objects[1], **self.held)

    def terminations(self) -> dict[str, DoneTerm]:
        """Ends an episode when the time is over or an object has left the table."""
        table = {"center": self.scene.table_center, "size": self.scene.table_size}
        off = {
            f"{name}_off_table": DoneTerm(terminations.object_off_table, params={**table, "object": name})
            for name in self.scene.objects
        }
        return {"time_out": DoneTerm(terminations.time_out, time_out=True), **off}

    def controllers(self) -> dict[str, dict[str, Any]]:
        """Builds the settings of the script, which builds the tower by inverse kinematics, object by object.

        Raises:
            UserError: the robot's hand cannot point down as high as the tower.
        """
        there, (low, high) = self.there, regions.box(self.robot, "pick", "where on the table it can grasp")[2]
        top = low + (len(self.objects) - 1 - (towers.GOAL in self.objects)) * self.edge
        if top + LIFTED > high:
            needs = f"its hand has to point down {top + LIFTED:.3g} m above its root, but pick ends at {high:.3g} m"
            raise UserError(f"{self.robot.name} cannot build a tower that high: {needs}")
        # The hand may have to lean above ``pick``, the region where it can point straight down.
        below = max(0.0, -there.offset[2])  # how far the grasp point is below the object's middle
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
            # Above ``pick`` the hand cannot point straight down, so it leans.
            **({"ik.orientation_weight": regions.UPRIGHT} if leave > high else {}),
        }
        return {"pick_place": fields}
