"""The parts that ``insert_peg`` and ``hang_ring`` share: a fixture at the goal, and an object to put into it or over it."""

import dataclasses
import math
from typing import Any

import numpy as np

from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, CurriculumCfg, EnvCfg, SuccessCfg
from mjx_nero.mdp import commands, events, fixtures, holes, observations, rewards, sensors, towers
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationGroup, ObservationTerm, RewardTerm, Term, groups
from mjx_nero.sim import contacts, grasp
from mjx_nero.sim import fixtures as models
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SimCfg
from mjx_nero.tasks.building import Tower
from mjx_nero.tasks.usual import arm_state, nearer
from mjx_nero.types import UserError

OPEN = 0.06  # [m] greatest opening of the hand
LENGTH = 15.0  # [s] of an episode: with velocity actions, which only approach the script's targets, the script is slow
APART = 0.08  # [m] least distance from the object's start to the fixture, along the table
WRIST = {"offset": (0.5, 0.5, 0.5, 0.02, 0.02, 0.02), "noise": (0.2, 0.2, 0.2, 0.01, 0.01, 0.01), "scale": 0.05, "delay": (0, 1)}
FINGERS = {"offset": (0.0,), "noise": (0.2,), "scale": 0.1, "delay": (0, 1)}
TIGHT = {"ik.position_tolerance": 1e-5, "ik.orientation_tolerance": 1e-4}


@dataclasses.dataclass(frozen=True)
class Putting(Tower):
    """A fixture at the goal, and the object that goes there from above.

    Attributes:
        rise: height of the object's centre over the fixture's site [m].
        top: height over its place at which the object still passes beside the fixture [m].
        off, turn: greatest errors of the goal as an estimate of the fixture's pose [m, rad].
        fold: number of turns about the vertical at which the object looks the same; 0: it is round.
    """

    rise: float = 0.0
    top: float = 0.0
    off: float = 0.0
    turn: float = 0.0
    fold: int = 0

    @property
    def object(self) -> str:
        """The object's name."""
        return self.objects[1]

    @property
    def fixture(self) -> str:
        """The fixture's name."""
        return self.objects[0].partition("/")[0]

    @property
    def place(self) -> dict[str, towers.Place]:
        """The place on the fixture's site."""
        place = super().place["place"]
        return {"place": dataclasses.replace(place, rise=self.rise)}

    def controllers(self) -> dict[str, dict[str, Any]]:
        """Returns none: each task adds its own."""
        return {}

    def success(self) -> SuccessCfg:
        """Requires the object in place and at rest, with nothing touching the pads, for half a second at the end."""
        return SuccessCfg(condition=Term(holes.let_be, params=self.done), distance=Term(towers.distance, params=self.place))

    def rewards(self) -> dict[str, RewardTerm]:
        """Replaces the tower's approach with a path that leads over the top."""
        place, one = self.place, {"object": self.object}
        way = {**place, "top": self.top, "flat": self.aside}
        turned = Term(rewards.object_goal_turn, params={"std": 0.2, "fold": max(self.fold, 1), **one})
        # ``resting`` has only been tried in place and stack.
        found = {name: term for name, term in super().rewards().items() if not name.startswith(("approaching", "resting"))}
        return {
            **found,
            **nearer("lowering", holes.lowered, **way),
            **({"turning_object": RewardTerm(turned.func, weight=2.0, params=turned.params)} if self.fold else {}),
        }

    def observations(self) -> dict[str, ObservationGroup]:
        """Observes the arm, the object, the goal, and what wrist and pads feel. The critic knows where the fixture is."""
        one, place = {"object": self.object}, self.place
        turns = {
            "ee_turn_to_object": ObservationTerm(towers.turn_to_object, params={"down": self.robot.down, **one}, noise=0.01),
            "object_turn_to_goal": ObservationTerm(
                observations.object_turn_to_goal, params={"fold": max(self.fold, 1), **one}, noise=0.01
            ),
        }
        state = {
            **arm_state(),
            "ee_to_object": ObservationTerm(observations.ee_to_object, params=one, noise=0.001),
            "object_to_goal": ObservationTerm(observations.object_to_goal, params=one, noise=0.001),
            "object_orientation": ObservationTerm(observations.object_orientation, params=one, noise=0.01),
            **(turns if self.fold else {}),
            "wrist": ObservationTerm(observations.reading, params={"name": "wrist"}),
            "fingers": ObservationTerm(observations.reading, params={"name": "fingers"}),
            "actions": ObservationTerm(observations.last_action),
        }
        seen = {
            "object_velocity": ObservationTerm(observations.object_velocity, params=one),
            "to_place": ObservationTerm(holes.to_place, params=place),
        }
        return groups(state, seen)

    def cfg(self, controllers: dict[str, dict[str, Any]], **own: Any) -> EnvCfg:
        """Makes the task.

        Args:
            controllers: the scripts that can do it.
            own: fields that a task adds or replaces.

        Raises:
            UserError: the robot's ``pick`` is too small for the fixture and the object beside it.
        """
        there, named = self.there, {"object": self.object}
        if np.hypot(*np.ptp(there.place, axis=1)) < 2 * APART:
            raise UserError(f"{self.robot.name} cannot reach a fixture and an object {APART:g} m apart: its pick is too small")
        stands = self.scene.fixtures[self.fixture]
        site, _ = models.at_rest(stands.file, self.objects[0].partition("/")[2])
        height = round(float(stands.pos[2] + site[2] + self.rise - self.robot.base_pos[2]), 4)
        still = (0.0, 0.0)
        yaw = (-math.pi / 4, math.pi / 4) if self.fold and regions.turns(self.robot) else still
        sized = contacts.crowded(self.robot, self.scene, SimCfg(ramp=self.robot.max_step > 0))
        shared = {
            "robot": self.builder,
            "sim": sized,
            "command": CommandTerm(
                commands.uniform_pose,
                params={
                    "x": there.place[0],
                    "y": there.place[1],
                    "z": (height, height),
                    "roll": still,
                    "pitch": still,
                    "yaw": yaw,
                },
                resample_s=ONCE,
            ),
            "events": {
                "stand": Term(fixtures.stand_at_goal, params={"fixture": self.fixture, "off": self.off, "turn": self.turn}),
                "reset_object_position": Term(
                    events.object_apart_from_goal, params={"x": there.cube[0], "y": there.cube[1], "apart": APART, **named}
                ),
                "reset_object_yaw": Term(events.object_yaw_uniform, params={"yaw": yaw, **named}),
            },
            "sensors": {
                "wrist": Term(sensors.Gauge, params={"reading": "wrist", **WRIST}),
                "fingers": Term(sensors.Gauge, params={"reading": "fingers", **FINGERS}),
            },
            "observations": self.observations(),
            "controllers": controllers,
            "curriculum": CurriculumCfg(expert_starts=0.5),
            "budget": Budget(steps=200_000_000),
        }
        return self.task(**{"length_s": LENGTH, **shared, **own})


def hand(robot: RobotCfg, width: float) -> RobotCfg:
    """Returns the robot with a hand that opens no further than needed, and closes on an object ``width`` wide [m].

    Raises:
        UserError: the hand cannot hold it.
    """
    if robot.gripper.joints and 0 < robot.opening < width + 2 * grasp.CLEAR:
        raise UserError(f"the hand of {robot.name} opens to {robot.opening:.3g} m: too little for an object {width:.3g} m wide")
    return grasp.shut(grasp.opened(robot, OPEN), width)


def picking(robot: RobotCfg, width: float, lowest: float, above: float, **own: Any) -> dict[str, Any]:
    """Builds the grasp settings of the scripts that put an object in place.

    Args:
        width: width of the object between the fingers [m].
        lowest: least height of the pads' middle above the table [m].
        above: height to which the object is lifted [m].
    """
    fields = {
        "lowest": round(lowest, 4),
        "beyond": grasp.beyond(robot, width),
        "aside": (grasp.aside(robot, width + 2 * grasp.BESIDE),),
        "closing": grasp.closing(robot, width),
        "above": round(above, 4),
        **TIGHT,
        **regions.ik(robot, "ik."),
        **own,
    }
    return {f"pick.{name}": value for name, value in fields.items()}
