"""Plays an exported lift policy on an emulated arm in simulated time: measures its success rate, and logs the drives."""

import pathlib
from typing import Any

import numpy as np

from mjx_nero import identify
from mjx_nero.deploy import setup
from mjx_nero.deploy.emulators import timeless
from mjx_nero.deploy.emulators.eyes import Eyes
from mjx_nero.deploy.emulators.plant import Faults, Plant
from mjx_nero.deploy.guard import Guard
from mjx_nero.deploy.log import Log
from mjx_nero.deploy.loop import Brain, run
from mjx_nero.deploy.observe import Observer, no_pictures
from mjx_nero.deploy.safety import Fault
from mjx_nero.envs.task import EnvCfg
from mjx_nero.identify import Drives
from mjx_nero.identify.excitation import sweeps
from mjx_nero.identify.log import ROBOT
from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tools.identification.arm import metadata_of, play

_NEAR = 0.02  # distance to the goal that counts as success [m]


def lifts(
    policy: pathlib.Path,
    cfg: EnvCfg,
    kind: str,
    episodes: int,
    faults: Faults,
    delay: float | None = None,
    seed: int = 0,
) -> tuple[float, list[Fault]]:
    """Plays lifts whose cube and goal are drawn as in training.

    Args:
        cfg: the environment's config.
        kind: arm: ``sim``, ``so101``, ``piper`` or ``nero``.
        faults: faults of its drives.
        delay: delay of targets that the runtime is told [s]; None: it is told nothing.

    Returns:
        share of episodes that end with the cube within 2 cm of the goal, and the faults that ended episodes.
    """
    brain, clock, rng = Brain(policy), timeless.Clock(), np.random.default_rng(seed)
    told, ended, good = brain.metadata, [], 0
    home, region = np.array(told["joints"]["home"], float), np.array([told["command"][axis] for axis in "xyz"])
    event = next(term for term in cfg.events.values() if "x" in term.params)
    cubes, base = np.array([event.params[axis] for axis in "xy"]), told["base"]["position"]
    model, names = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False), told["joints"]["names"]
    sees, pictures = timeless.Sees(), no_pictures
    if brain.cameras:
        shown = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=True)
        pictures = Eyes(shown, told["cameras"], names, base, sees)
    for _ in range(episodes):
        plant = sees.plant = Plant(model, names, home, clock, base)
        cube, goal = rng.uniform(*cubes.T), rng.uniform(*region.T)
        plant.reset(home, {"cube": np.array([*cube, told["objects"]["cube"][2] / 2 - base[2]])})
        arm, unplug = timeless.engaged(kind, told, plant, clock)
        plant.faults = faults
        guard: Any = Guard(arm, setup.safety_of(told), clock)
        guard.start()
        observer = Observer(told, setup.body_of(told), goal.tolist(), sees, pictures)
        report = run(guard, brain, observer, clock, cfg.episode_length_s, lambda: None, delay=delay)
        ended += [report.fault] if report.fault.kind != "stop" else []
        good += float(np.linalg.norm(plant.place("cube") - goal)) < _NEAR
        unplug()
    return good / episodes, ended


def recorded(
    path: pathlib.Path, robot: RobotCfg, kind: str, faults: Faults, seconds: float, drives: Drives | None = None
) -> dict[str, int]:
    """Logs an emulated arm during identification's movement; returns how often each limit was reached.

    Args:
        drives: the arm's drives; None: the model's own. Their offsets and delay do not count.
    """
    told, clock, swings = metadata_of(robot), timeless.Clock(), sweeps(robot, seconds)
    targets = np.concatenate([swings, np.tile(robot.gripper.home, (len(swings), 1))], axis=1)
    real = identify.Plant(robot, identify.usual_step(robot))
    plant = Plant(real.with_drives(drives or real.nominal), told["joints"]["names"], targets[0], clock, told["base"]["position"])
    arm, unplug = timeless.engaged(kind, told, plant, clock)
    plant.faults = faults
    guard: Any = Guard(arm, setup.safety_of(told), clock)
    guard.start(anywhere=True)
    guard.log = Log(path, arm.joints, targets[0], clock.now(), 0, (f"{ROBOT}{robot.name}", "emulated"))
    fault, limited = play(guard, targets, clock, lambda: None)
    assert fault is None, fault
    guard.log.close()
    unplug()
    return limited
