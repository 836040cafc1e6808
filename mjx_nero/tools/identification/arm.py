"""``record`` on an arm: sends identification's movement through the safety layer, and logs it."""

import argparse
import contextlib
import dataclasses
import functools
from typing import Any

import numpy as np

from mjx_nero.deploy import drivers
from mjx_nero.deploy.arm import Clock
from mjx_nero.deploy.guard import Guarded, WallClock, urgent
from mjx_nero.deploy.loop import Stop, go_home
from mjx_nero.deploy.remote import Remote
from mjx_nero.deploy.safety import Fault, Limits
from mjx_nero.deploy.stop import operator
from mjx_nero.identify.excitation import RATE, sweeps
from mjx_nero.identify.plant import usual_step
from mjx_nero.interop import description
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tools.deploy import arms
from mjx_nero.tools.deploy.world import World
from mjx_nero.tools.identification.report import MOVEMENT


def metadata_of(robot: RobotCfg) -> dict[str, Any]:
    """Describes a robot as the metadata of an exported policy does."""
    return {**description.robot(robot), "robot": robot.name, "control_dt": 1 / RATE, "command": {}, "objects": {}}


def play(arm: Guarded, targets: np.ndarray, clock: Clock, stop: Stop) -> tuple[Fault | None, dict[str, int]]:
    """Sends targets [steps, joints] at ``RATE``; returns why it stopped early (None: it did not), and how often each limit
    was reached."""
    begun, limited = clock.now(), dict[str, int]()
    for k, target in enumerate(targets):
        clock.sleep_until(begun + k / RATE)
        if ending := stop():
            arm.hold(ending)
        arm.read()
        command = arm.command(target)
        if arm.fault:
            return arm.fault, limited
        for name in command.limited:
            limited[name] = limited.get(name, 0) + 1
        clock.sleep_until(begun + (k + 0.5) / RATE)
        arm.read()  # twice as many readings as targets
    return None, limited


def record_arm(args: argparse.Namespace, robot: RobotCfg) -> bool:
    """Moves an arm home, then through identification's movement, and logs targets and readings.

    Returns:
        whether it ended in a fault.
    """
    metadata, clock = metadata_of(robot), WallClock()
    drivers.check(args.arm, metadata)
    swings = sweeps(robot, args.seconds, args.amplitude)
    targets = np.concatenate([swings, np.tile(robot.gripper.home, (len(swings), 1))], axis=1)
    limits = dataclasses.replace(Limits.of(metadata, arms.safety_of(args)), home=targets[0])
    world = functools.partial(World, robot, SceneCfg(objects={}), SimCfg(dt=usual_step(robot)), {})
    with contextlib.ExitStack() as stack:
        options = stack.enter_context(arms.options_of(args, metadata, world))
        arms.warn(args)
        note = f"{robot.name} by {args.arm}{' (emulated)' if args.emulate else ''}, {MOVEMENT}"
        remote = Remote(arms.spec(args, metadata, options, args.out, note)[0])
        stack.callback(remote.close)
        remote.ready()
        stop = stack.enter_context(operator())
        stack.enter_context(urgent())
        remote.start(anywhere=True)
        fault = go_home(remote, limits, clock, stop)
        if not fault:
            print(f"the arm is at the start of the movement, which takes {args.seconds:g} s")
            fault, limited = play(remote, targets, clock, stop)
            print("limits reached: " + (", ".join(f"{name} {n} times" for name, n in limited.items()) or "never"))
    print(f"the arm holds: {fault.text if fault else 'the movement is over'}")
    return fault is not None and fault.kind != "stop"
