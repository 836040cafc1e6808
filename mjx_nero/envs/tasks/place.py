"""Place: a box from where it lies to a commanded pose on the table, its turn included. For any robot with a gripper."""

import dataclasses
import math

from mjx_nero.envs import regions
from mjx_nero.envs.task import QUIET, Budget, EnvCfg, Presets, joint_actions
from mjx_nero.envs.tasks.building import Tower, lets_go
from mjx_nero.mdp import commands, events, observations, towers
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationGroup, ObservationTerm, Term, privileged
from mjx_nero.sim import grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg

TURN = (-math.pi / 6, math.pi / 6)  # [rad] of the box at the start, and of its goal
STILL = (0.0, 0.0)
APART = 2.5  # from its start to its goal at least, in heights of the box: one that lies there already is best left alone
LONG = 1.5  # its longest edge, along x, in shorter ones: its turn can be seen


def default(robot: RobotCfg) -> EnvCfg:
    """Success: within 2 cm and 15 degrees of the goal, at rest, the hand away."""
    there, turns = regions.of(robot), regions.turns(robot)
    box = _box(robot, LONG if turns else 1.0)
    yaw, rest = TURN if turns else STILL, box.rest_height - robot.base_pos[2]
    scene = scenes.around(robot, SceneCfg(objects={"box": box}, goal="box", hand=True))
    angle = math.radians(15) if turns else math.pi  # a hand that cannot turn at will is not asked to
    tower = Tower(robot, scene, (towers.GOAL, "box"), box.size[2], aside=0.02, angle=angle, lifted=_lifted(box))
    named = {"object": "box"}
    state = {
        "joint_pos": ObservationTerm(observations.joint_pos_rel, noise=0.01),
        "joint_vel": ObservationTerm(observations.joint_vel_rel, noise=0.01),
        "target_error": ObservationTerm(observations.target_error),
        "ee_position": ObservationTerm(observations.ee_position),
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
    return EnvCfg(
        robot=tower.builder,
        scene=scene,
        sim=tower.sim(),
        episode_length_s=7.0 + tower.extra,
        actions=lets_go(joint_actions(scale=0.5)),
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
        observations={"state": ObservationGroup(state), "privileged_state": privileged(state, seen)},
        rewards=tower.rewards(),
        success=tower.success(),
        metrics=tower.metrics(),
        terminations=tower.terminations(),
        controllers=tower.controllers(),
        training=QUIET,
        budget=Budget(steps=150_000_000),
    )


def _box(robot: RobotCfg, long: float) -> ObjectCfg:
    """As wide and high as the cube that the robot can lift, and of its density."""
    cube = grasp.cube_for(robot)
    edge = cube.size[0]
    return dataclasses.replace(cube, size=(round(long * edge, 4), edge, edge), mass=float(f"{long * cube.mass:.3g}"))


def _lifted(box: ObjectCfg) -> float:
    """Higher than a box gets that is only tipped over an edge [m], and its turn lost: that is easier learnt than to lift it."""
    long, _, high = box.size
    return round((math.hypot(long, high) - high) / 2 + high / 20, 4)


def presets() -> Presets:
    """Preset -> robot -> config; the default first."""
    return {"default": default}
