"""Sim to real, for any task: the preset ``sim2real`` adds the differences between a simulated arm and a real one.

Every range is a field (``--env.randomization.object_mass.params.scale "(0.5, 4)"``, ``--env.actions.delay.params.steps "(0,
3)"``). The ranges are those with which other libraries train manipulation (mjlab's lift_cube, MuJoCo Playground, Isaac Lab,
HumanoidVerse). The delays are those of a bus and a camera at 50 control steps a second.
"""

import dataclasses

from mjx_nero.envs.task import EnvCfg
from mjx_nero.mdp import actions, curriculum, pushes, randomization, sensors
from mjx_nero.mdp.terms import ObservationGroup, Term
from mjx_nero.sim import grasp, robot_file
from mjx_nero.sim.robot import RobotCfg

_STEPS = 100_000_000  # env steps of a run on a GPU


def randomized(cfg: EnvCfg) -> EnvCfg:
    """Adds drives, loads, objects, delays and sensor errors that differ from episode to episode."""
    late = {"delay": Term(actions.Delay, params={"steps": (0, 3), "hold": 0.9})}
    first = {name: term for name, term in cfg.actions.items() if name not in ("delay", "speed_limit")}
    noise = {"noise": Term(actions.Noise, params={"amount": 0.002})}
    objects = list(cfg.scene.objects)
    pushed = {name: Term(pushes.Push, params={"object": name, "speed": 0.1, "interval": (1.0, 3.0)}) for name in objects}
    return dataclasses.replace(
        cfg,
        actions={**late, **first, **noise, **{n: t for n, t in cfg.actions.items() if n == "speed_limit"}},
        observations={name: _late(group) if group.sensed else group for name, group in cfg.observations.items()},
        randomization={
            **cfg.randomization,
            **_arm(cfg.robot, bool(objects)),
            **{k: v for name in objects for k, v in _object(name).items()},
        },
        sensors={**cfg.sensors, "encoders": Term(sensors.Encoders), **_eyes(objects)},
        pushes={**cfg.pushes, **pushed},
        curriculum=dataclasses.replace(cfg.curriculum, levels=Term(curriculum.BySuccess)),
        budget=dataclasses.replace(cfg.budget, steps=_STEPS),
    )


def _late(group: ObservationGroup) -> ObservationGroup:
    """Delays what the arm's bus reports by up to one step."""
    told = {name: group.terms[name] for name in ("joint_pos", "joint_vel") if name in group.terms}
    late = {name: dataclasses.replace(term, delay=(0, 1), hold=0.9) for name, term in told.items()}
    return dataclasses.replace(group, terms={**group.terms, **late})


def _arm(robot: RobotCfg, grips: bool) -> dict[str, Term]:
    """Randomizes links and drives, and the pads if there is something to grip."""
    spec, joints = robot_file.model(robot), robot.arm.joints
    links = tuple(dict.fromkeys(spec.joint(name).parent.name for name in joints))
    pads = tuple(grasp.pads(spec))
    terms = {
        "link_mass": Term(randomization.mass, params={"bodies": links, "scale": (0.9, 1.1)}),
        "link_center": Term(randomization.center_of_mass, params={"bodies": links, "offset": 0.01}),
        "drives": Term(
            randomization.gains,
            params={"actuators": joints, "stiffness": (0.75, 1.25), "damping": (0.75, 1.25), "effort": (0.8, 1.0)},
        ),
        "joints": Term(randomization.joints, params={"joints": joints, "armature": (0.75, 1.25), "friction": (0.0, 0.02)}),
        "encoders": Term(randomization.encoder_bias, params={"actuators": joints, "bias": 0.005}),
    }
    if robot.gravity_compensation:
        params = {"bodies": links, "scale": (0.9, 1.1)}
        terms["gravity_compensation"] = Term(randomization.gravity_compensation, params=params)
    if pads and grips:
        ranges = {"slide": (0.6, 1.5), "spin": (1e-3, 2e-2), "roll": (1e-5, 5e-3)}
        terms["pad_friction"] = Term(randomization.friction, params={"geoms": pads, **ranges})
    return terms


def _object(name: str) -> dict[str, Term]:
    return {
        f"{name}_mass": Term(randomization.mass, params={"bodies": (name,), "scale": (0.5, 4.0)}),
        f"{name}_size": Term(randomization.size, params={"object": name, "scale": (0.85, 1.15)}),
        f"{name}_friction": Term(randomization.friction, params={"geoms": (name,), "slide": (0.5, 1.2)}),
    }


def _eyes(objects: list[str]) -> dict[str, Term]:
    """Adds the errors of cameras."""
    if not objects:
        return {}
    seen = {"offset": 0.005, "noise": 0.002, "delay": (0, 2), "hold": 0.9}
    each = {name: Term(sensors.ObjectPosition, params={"object": name, **seen}) for name in objects}
    return {"base": Term(sensors.BasePose, params={"offset": 0.003, "turn": 0.01}), **each}
