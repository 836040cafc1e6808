"""Stack: one cube onto another, let go of and at rest. For any robot with a gripper.

Preset ``three`` puts one more on top.
"""

import dataclasses

from mjx_nero.envs import regions
from mjx_nero.envs.task import CALM, Budget, EnvCfg, Presets, velocity_actions
from mjx_nero.envs.tasks.building import LIFTED, Tower, lets_go
from mjx_nero.mdp import commands, events, observations, towers
from mjx_nero.mdp.actions import ContinuousGripper
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationGroup, ObservationTerm, RewardTerm, Term, privileged
from mjx_nero.sim import grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg

COLORS = {"blue": (0.2, 0.35, 0.9, 1.0), "red": (0.85, 0.3, 0.2, 1.0), "yellow": (0.95, 0.75, 0.15, 1.0)}  # from the bottom up
BESIDE = 0.03  # [m] of an open finger behind its pad: cubes lie that much farther apart


def default(robot: RobotCfg) -> EnvCfg:
    """The red cube onto the blue one."""
    return _stack(robot, 2, 7.0)


def three(robot: RobotCfg) -> EnvCfg:
    """And then the yellow one onto both."""
    return _stack(robot, 3, 13.0)


def _stack(robot: RobotCfg, count: int, episode_length_s: float) -> EnvCfg:
    cube, there = grasp.cube_for(robot), regions.of(robot)
    edge, objects = cube.size[0], {name: dataclasses.replace(cube, rgba=COLORS[name]) for name in list(COLORS)[:count]}
    scene = scenes.around(robot, SceneCfg(objects=objects, goal="none", hand=True))
    # On it, as far as it stays, and so far beside it straight down: the centre within the face below. A cube counts as held from
    # where none gets that leans on its edge.
    tower = Tower(robot, scene, tuple(objects), edge, aside=edge / 2, lifted=max(LIFTED, edge / 4))
    # Leaving is paid for as far as the fingers have let go: from where they hold a cube, half open already if it is wide.
    fingers = {"open": robot.gripper.open, "hold": grasp.opened(robot, edge).gripper.open}
    leaving = RewardTerm(towers.left_with_open_fingers, weight=10.0, params={**tower.place, **fingers})
    state = {
        "joint_pos": ObservationTerm(observations.joint_pos_rel, noise=0.01),
        "joint_vel": ObservationTerm(observations.joint_vel_rel, noise=0.01),
        "target_error": ObservationTerm(observations.target_error),
        "ee_position": ObservationTerm(observations.ee_position),
        **_each(objects, "ee_to_{}", observations.ee_to_object, noise=0.002),
        **{
            f"{name}_to_{below}": ObservationTerm(towers.way, params={"below": below, "object": name, "rise": edge}, noise=0.002)
            for below, name in zip(tower.objects, tower.objects[1:], strict=False)
        },
        "actions": ObservationTerm(observations.last_action),
    }
    seen = {
        **_each(objects, "{}_velocity", observations.object_velocity),
        **_each(objects, "{}_orientation", observations.object_orientation),
    }
    apart = round(robot.opening / 2 + edge / 2 + BESIDE, 4)
    return EnvCfg(
        robot=tower.builder,
        scene=scene,
        sim=tower.sim(),
        episode_length_s=episode_length_s + tower.extra,
        actions=lets_go({**velocity_actions(), "gripper": Term(ContinuousGripper)}),
        command=CommandTerm(commands.nothing, resample_s=ONCE),
        events={
            "reset_object_positions": Term(
                events.objects_apart,
                params={"objects": tuple(objects), "x": there.cube[0], "y": there.cube[1], "apart": apart},
            ),
        },
        observations={"state": ObservationGroup(state), "privileged_state": privileged(state, seen)},
        rewards={**tower.rewards(), "leaving": leaving},
        success=tower.success(),
        metrics=tower.metrics(),
        terminations=tower.terminations(),
        controllers=tower.controllers(),
        training=CALM,
        budget=Budget(steps=180_000_000),
    )


def _each(objects, name, func, noise=0.0) -> dict[str, ObservationTerm]:
    """A term for each object."""
    return {name.format(each): ObservationTerm(func, params={"object": each}, noise=noise) for each in objects}


def presets() -> Presets:
    """Preset -> robot -> config; the default first."""
    return {"default": default, "three": three}
