"""Stack: put one cube onto another, released and at rest. For any robot with a gripper.

The preset ``three`` adds a third cube on top.
"""

import dataclasses

from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, EnvCfg, Presets
from mjx_nero.mdp import commands, events, observations, towers
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationTerm, RewardTerm, Term, groups
from mjx_nero.sim import grasp
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg
from mjx_nero.tasks import seeing
from mjx_nero.tasks.building import LIFTED, Tower
from mjx_nero.tasks.usual import arm_state

COLORS = {"blue": (0.2, 0.35, 0.9, 1.0), "red": (0.85, 0.3, 0.2, 1.0), "yellow": (0.95, 0.75, 0.15, 1.0)}  # from the bottom up
BESIDE = 0.03  # [m] size of an open finger behind its pad, added to the gap between cubes


def default(robot: RobotCfg) -> EnvCfg:
    """Puts the red cube onto the blue one."""
    return _stack(robot, 2, 7.0)


def three(robot: RobotCfg) -> EnvCfg:
    """Puts the red cube onto the blue one, and the yellow cube onto both."""
    return _stack(robot, 3, 13.0)


def _stack(robot: RobotCfg, count: int, episode_length_s: float) -> EnvCfg:
    cube, there = grasp.cube_for(robot), regions.of(robot)
    edge, objects = cube.size[0], {name: dataclasses.replace(cube, rgba=COLORS[name]) for name in list(COLORS)[:count]}
    scene = scenes.around(robot, SceneCfg(objects=objects, goal="none", sensors=("hand",)))
    # A cube counts as on the other, and may come straight down, with its centre above the face below. It counts as held from a
    # height that a cube leaning on its edge never reaches.
    tower = Tower(robot, scene, tuple(objects), edge, aside=edge / 2, lifted=max(LIFTED, edge / 4))
    # Leaving pays in proportion to how far the fingers have opened from holding a cube, which may leave them half open already.
    fingers = {"open": robot.gripper.open, "hold": grasp.opened(robot, edge).gripper.open}
    leaving = RewardTerm(towers.left_with_open_fingers, weight=10.0, params={**tower.place, **fingers})
    state = {
        **arm_state(),
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
    return tower.task(
        length_s=episode_length_s,
        command=CommandTerm(commands.nothing, resample_s=ONCE),
        events={
            "reset_object_positions": Term(
                events.objects_apart,
                params={"objects": tuple(objects), "x": there.cube[0], "y": there.cube[1], "apart": apart},
            ),
        },
        observations=groups(state, seen),
        rewards={**tower.rewards(), "leaving": leaving},
        budget=Budget(steps=70_000_000),
    )


def _each(objects, name, func, noise=0.0) -> dict[str, ObservationTerm]:
    """Makes one term per object."""
    return {name.format(each): ObservationTerm(func, params={"object": each}, noise=noise) for each in objects}


PRESETS: Presets = {"default": default, "three": three, **seeing.presets(default)}
