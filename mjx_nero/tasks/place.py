"""Place: move a box to a commanded pose on the table, its heading included. For any robot with a gripper."""

import dataclasses
import math

from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, EnvCfg, Presets
from mjx_nero.mdp import commands, events, observations, towers
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationTerm, Term, groups
from mjx_nero.sim import grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg
from mjx_nero.tasks import seeing
from mjx_nero.tasks.building import Tower
from mjx_nero.tasks.usual import arm_state

TURN = (-math.pi / 6, math.pi / 6)  # [rad] heading of the box at the start and at the goal
STILL = (0.0, 0.0)
APART = 2.5  # least distance from start to goal, in heights of the box: a box already there is best left alone
LONG = 1.5  # length of the box along x, in its other edges, so that its heading shows


def default(robot: RobotCfg) -> EnvCfg:
    """Success: the box is within 2 cm and 15 degrees of the goal, at rest, with the hand away."""
    there, turns = regions.of(robot), regions.turns(robot)
    box = _box(robot, LONG if turns else 1.0)
    yaw, rest = TURN if turns else STILL, box.rest_height - robot.base_pos[2]
    scene = scenes.around(robot, SceneCfg(objects={"box": box}, goal="box", sensors=("hand",)))
    angle = math.radians(15) if turns else math.pi  # a hand that cannot turn freely is not asked to
    tower = Tower(robot, scene, (towers.GOAL, "box"), box.size[2], aside=0.02, angle=angle, lifted=_lifted(box))
    named = {"object": "box"}
    state = {
        **arm_state(),
        "ee_to_object": ObservationTerm(observations.ee_to_object, params=named, noise=0.002),
        "ee_turn_to_object": ObservationTerm(towers.turn_to_object, params={"down": robot.down, **named}, noise=0.01),
        "object_to_goal": ObservationTerm(observations.object_to_goal, params=named, noise=0.002),
        "object_turn_to_goal": ObservationTerm(towers.turn_to_goal, params=named, noise=0.01),
        "actions": ObservationTerm(observations.last_action),
    }
    seen = {
        "object_velocity": ObservationTerm(observations.object_velocity, params=named),
        "object_orientation": ObservationTerm(observations.object_orientation, params=named),
    }
    return tower.task(
        length_s=7.0,
        command=CommandTerm(
            commands.uniform_pose,
            params={"x": there.place[0], "y": there.place[1], "z": (rest, rest), "roll": STILL, "pitch": STILL, "yaw": yaw},
            resample_s=ONCE,
        ),
        events={
            "reset_object_position": Term(
                events.object_apart_from_goal,
                params={"x": there.cube[0], "y": there.cube[1], "apart": round(APART * box.size[2], 4), **named},
            ),
            "reset_object_yaw": Term(events.object_yaw_uniform, params={"yaw": yaw, **named}),
        },
        observations=groups(state, seen),
        budget=Budget(steps=70_000_000),
    )


def _box(robot: RobotCfg, long: float) -> ObjectCfg:
    """Makes a box as wide, high and dense as the cube that the robot can lift."""
    cube = grasp.cube_for(robot)
    edge = cube.size[0]
    return dataclasses.replace(cube, size=(round(long * edge, 4), edge, edge), mass=float(f"{long * cube.mass:.3g}"))


def _lifted(box: ObjectCfg) -> float:
    """Least height of a held box above its resting place [m]: higher than a box tipped over an edge.

    Tipping is easier to learn than lifting, and loses the heading.
    """
    long, _, high = box.size
    return round((math.hypot(long, high) - high) / 2 + high / 20, 4)


# Where and how the box must lie is told: the teacher observes it relative to the box.
GOAL = {"target_object_pose": ObservationTerm(observations.pose_command)}
PRESETS: Presets = {"default": default, **seeing.presets(default, GOAL)}
