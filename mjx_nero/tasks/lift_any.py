"""Lift any: pick up one of the package's everyday objects in any resting pose, and hold it at a commanded point.

Three of the twelve objects are held out: no policy sees them in training. The preset ``held_out`` has only these three, and
``all`` has all twelve.
"""

import dataclasses
import functools

from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, CurriculumCfg, EnvCfg, Presets
from mjx_nero.envs.things.gripping import GRIP, LIFTED, NEAR, expert
from mjx_nero.mdp import commands, metrics, observations
from mjx_nero.mdp.terms import ONCE, CommandTerm, ObservationTerm, Term
from mjx_nero.sim import contacts, solids
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.meshes import events as thing_events
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, SimCfg
from mjx_nero.tasks.lift import carrying
from mjx_nero.tasks.usual import CALM, arm_state, object_at_goal, observed, on_table, stays_on_table, velocity_actions

THING = "thing"
HELD_OUT = ("l_bracket", "bowl", "screwdriver")
SEEN = tuple(name for name in solids.names() if name not in HELD_OUT)


def thing(files: tuple[str, ...]) -> ObjectCfg:
    """An object that has one of these shapes in each episode."""
    first, *others = files
    return ObjectCfg(shape="mesh", file=first, bank=tuple(others), **GRIP)


# Long: a task is one list, to read as one.
def lifting(robot: RobotCfg, files: tuple[str, ...]) -> EnvCfg:
    """Lift's rewards, with heights and distances measured from the thing's surface."""
    there, one, item = regions.of(robot), {"object": THING}, thing(files)
    scene = scenes.around(robot, SceneCfg(objects={THING: item}))
    held = {"minimal_height": LIFTED, "grasp_radius": NEAR, **one}
    state = {
        **arm_state(),
        "ee_orientation": ObservationTerm(observations.ee_orientation),
        "ee_to_object": ObservationTerm(observations.ee_to_object, params=one, noise=0.002),
        "object_orientation": ObservationTerm(observations.object_orientation, params=one, noise=0.01),
        "object_shape": ObservationTerm(observations.object_shape, params=one),
        "object_to_goal": ObservationTerm(observations.object_to_goal, params=one, noise=0.002),
        "target_object_position": ObservationTerm(observations.command),
        "actions": ObservationTerm(observations.last_action),
    }
    return EnvCfg(
        robot=dataclasses.replace(robot, gravity_compensation=True),  # a robot's own controller does this
        scene=scene,
        sim=contacts.crowded(robot, scene, SimCfg(dt=0.005, decimation=4, ramp=robot.max_step > 0)),
        episode_length_s=7.0,
        actions=velocity_actions(hysteresis=0.5),
        controllers=expert(robot, THING, item),
        command=CommandTerm(commands.uniform_position, params=dict(zip("xyz", there.hold, strict=True)), resample_s=ONCE),
        success=object_at_goal(**one),
        metrics=metrics.grasping(**held),
        observations=observed(state, **one),
        events={
            **on_table(there.cube, **one),
            "reset_object_shape": Term(thing_events.at_rest, params={"files": files, **one}),
        },
        rewards=carrying(held, **one),
        curriculum=CurriculumCfg(expert_starts=0.5),
        training=CALM,
        budget=Budget(steps=120_000_000),
        terminations=stays_on_table(scene, **one),
    )


_KINDS = {"default": SEEN, "held_out": HELD_OUT, "all": (*SEEN, *HELD_OUT)}
PRESETS: Presets = {name: functools.partial(lifting, files=files) for name, files in _KINDS.items()}
