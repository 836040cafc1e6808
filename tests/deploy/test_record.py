"""Identification's movement on an arm: through the safety layer, and into a log that ``identify`` reads."""

import arms
import numpy as np

from mjx_nero.deploy import setup
from mjx_nero.deploy.guard import Guard
from mjx_nero.deploy.log import Log
from mjx_nero.deploy.safety import Fault
from mjx_nero.identify import log as logs
from mjx_nero.identify.excitation import RATE, sweeps
from mjx_nero.tasks import registry
from mjx_nero.tools.identification import arm as recording


def begun(tmp_path, seconds=10.2):
    robot, clock = registry.robot("so_arm101"), arms.Clock()
    told = recording.metadata_of(robot)
    swings = sweeps(robot, seconds)
    targets = np.concatenate([swings, np.tile(robot.gripper.home, (len(swings), 1))], axis=1)
    safety = setup.safety_of(told)
    ideal = arms.Ideal(tuple(told["joints"]["names"]), targets[0], clock)
    guard = Guard(ideal, safety, clock)
    guard.start(anywhere=True)
    guard.log = Log(tmp_path / "log.csv", ideal.joints, targets[0], clock.now(), 0, ["a note"])
    return robot, guard, targets, clock


def test_the_movement_is_what_identify_wants(tmp_path):
    robot, guard, targets, clock = begun(tmp_path)
    fault, limited = recording.play(guard, targets, clock, lambda: None)
    guard.close()
    assert fault is None and not limited  # the sweeps stay within all limits
    log = logs.read(tmp_path / "log.csv", robot.arm.joints)
    assert len(log.times) > 1.9 * RATE * 10
    np.testing.assert_allclose(log.targets[1 : len(targets) + 1], targets[:, :5], atol=1e-6)


def test_somebody_stops_it(tmp_path):
    robot, guard, targets, clock = begun(tmp_path)
    asked = iter([None] * 50 + [Fault("stop", "a key")])
    fault, _ = recording.play(guard, targets, clock, lambda: next(asked))
    assert fault == Fault("stop", "a key")
