"""Whole episodes through runtime, driver and emulator, in time that passes where somebody waits."""

import arms
import mujoco
import numpy as np
import onnx

import mjx_nero
from mjx_nero.deploy import setup
from mjx_nero.deploy.drivers import agilex, feetech, so_arm
from mjx_nero.deploy.emulators import agilex as can
from mjx_nero.deploy.emulators import feetech as serial
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.guard import Guard
from mjx_nero.deploy.loop import Brain, run
from mjx_nero.deploy.observe import Observer
from mjx_nero.deploy.places import Known, Place
from mjx_nero.interop import onnx as export
from mjx_nero.learn import policy
from mjx_nero.sim import scene

ARMS = {"so101_lift": "so101", "piper_lift": "piper", "nero_lift": "nero"}


def exported(folder, name, path=None, **kwargs):
    """Writes ``policy.onnx`` and ``scene.mjb`` of an environment in ``sim2real``; its config."""
    env = mjx_nero.make(name, preset="sim2real", impl="native", **kwargs)
    trained = policy.load_for(env, name, path or policy.shipped(name, "sim2real"))
    onnx.save(export.model(trained, env), str(folder / "policy.onnx"))
    mujoco.mj_saveModel(scene.build(env.cfg.robot, env.cfg.scene, env.cfg.sim, visuals=False), str(folder / "scene.mjb"), None)
    return env.cfg


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


def servos(told, plant, clock):
    """The SO-ARM101 at a wire, and what closes it."""
    entries = serial.calibration(told, "so101")
    known = {name: so_arm.Servo(**{f: entry[f] for f in so_arm._FIELDS}) for name, entry in entries.items()}
    arm = so_arm.SoArm("so101", told, known, "", clock)
    arm._bus = feetech.Bus(Wire(serial.servos_of(told, "so101", entries, plant)))
    return arm, lambda: None


def frames(kind):
    """A Piper or Nero on a virtual bus."""

    def made(told, plant, clock):
        port = can.CanPort(can.Arm(plant, agilex.MODELS[kind]), f"virtual:{id(plant)}")
        plant.gears = 1e4  # it lies on something
        clock.ticks = [port.take, port.say]
        arm = agilex.of(kind, told, clock, port.name)
        arm.connect()
        return arm, port.close

    return made


LATE = {"so101": 0.0, "piper": 0.02, "nero": 0.02}  # [s] until an emulated arm has got to a target
LINES = {"so101": servos, "piper": frames("piper"), "nero": frames("nero")}


class Sees(Known):
    """Places that the simulator has."""

    def __init__(self, plant):
        super().__init__()
        self._plant = plant

    def find(self, name, now):
        return Place(self._plant.place(name), self._plant.data.qpos[self._plant.objects[name] :][3:7])


def success(folder, name, cfg, episodes, faults, seed=0):
    """Share of episodes of a lift that end with the cube within 2 cm of the goal, and the faults that ended others."""
    brain, clock, rng = Brain(folder / "policy.onnx"), arms.Clock(), np.random.default_rng(seed)
    told, ended, good = brain.metadata, [], 0
    home, region = np.array(told["joints"]["home"]), np.array([told["command"][axis] for axis in "xyz"])
    event = next(term for term in cfg.events.values() if "x" in term.params)
    places = np.array([event.params[axis] for axis in "xy"])
    for _ in range(episodes):
        plant = Plant(folder / "scene.mjb", told["joints"]["names"], home, clock, told["base"]["position"])
        cube, goal = rng.uniform(*places.T), rng.uniform(*region.T)
        plant.reset(home, {"cube": np.array([*cube, told["objects"]["cube"][2] / 2 - told["base"]["position"][2]])})
        arm, close = LINES[ARMS[name]](told, plant, clock)
        arm.engage()
        plant.faults = faults
        guard = Guard(arm, setup.safety_of(told), clock)
        guard.start()
        observer = Observer(told, setup.body_of(told), goal.tolist(), Sees(plant))
        report = run(guard, brain, observer, clock, 5.0, lambda: None, delay=faults.late + LATE[ARMS[name]])
        ended += [report.fault] if report.fault.kind != "stop" else []
        good += float(np.linalg.norm(plant.place("cube") - goal)) < 0.02
        clock.ticks = []
        arm.close()
        close()
    return good / episodes, ended
