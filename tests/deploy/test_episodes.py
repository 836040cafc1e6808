"""Whole episodes through runtime, driver and emulated servos, in time that passes where somebody waits."""

import arms
import numpy as np

from mjx_nero.deploy import setup
from mjx_nero.deploy.drivers import feetech, so_arm
from mjx_nero.deploy.emulators import feetech as emulated
from mjx_nero.deploy.emulators.plant import Faults, Plant
from mjx_nero.deploy.guard import Guard
from mjx_nero.deploy.loop import Brain, run
from mjx_nero.deploy.observe import Observer
from mjx_nero.deploy.places import Known, Place


class Wire:
    """A serial line without time: what was asked is answered at once."""

    def __init__(self, servos):
        self._servos, self._waiting = servos, b""

    def reset_input_buffer(self):
        self._waiting = b""

    def write(self, data):
        self._waiting += self._servos.answer(data)

    def read(self, count):
        out, self._waiting = self._waiting[:count], self._waiting[count:]
        return out

    def close(self):
        pass


class Sees(Known):
    """Places that the simulator has."""

    def __init__(self, plant):
        super().__init__()
        self._plant = plant

    def find(self, name, now):
        return Place(self._plant.place(name), np.array([1.0, 0, 0, 0]))


def success(lift, episodes, faults, seed=0):
    """Share of episodes of ``so101_lift`` that end with the cube within 2 cm of the goal, and the faults that ended others."""
    brain, clock, rng = Brain(lift / "policy.onnx"), arms.Clock(), np.random.default_rng(seed)
    told, ended, good = brain.metadata, [], 0
    home = np.array(told["joints"]["home"])
    entries = emulated.calibration(told, "so101")
    servos = {name: so_arm.Servo(**{f: entry[f] for f in so_arm._FIELDS}) for name, entry in entries.items()}
    for _ in range(episodes):
        plant = Plant(lift / "scene.mjb", told["joints"]["names"], home, clock)
        x, y = rng.uniform([0.1, -0.2], [0.3, 0.2])
        goal = rng.uniform([0.15, -0.1, 0.2], [0.3, 0.1, 0.35]).tolist()
        plant.reset(home, {"cube": np.array([x, y, told["objects"]["cube"][2] / 2])})
        arm = so_arm.SoArm("so101", told, servos, "", clock)
        arm._bus = feetech.Bus(Wire(emulated.servos_of(told, "so101", entries, plant)))
        arm.engage()
        plant.faults = faults
        guard = Guard(arm, setup.safety_of(told), clock)
        guard.start()
        observer = Observer(told, setup.body_of(told), goal, Sees(plant))
        report = run(guard, brain, observer, clock, 5.0, lambda: None, delay=faults.late)
        ended += [report.fault] if report.fault.kind != "stop" else []
        good += float(np.linalg.norm(plant.place("cube") - goal)) < 0.02
    return good / episodes, ended


def test_episodes_succeed(lift):
    share, ended = success(lift, 2, Faults(late=0.04))
    assert share == 1.0 and not ended
