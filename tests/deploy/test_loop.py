"""The loop in a simulated arm's own time: success, timing, stops; and the way home."""

import contextlib
import os

import arms
import numpy as np
import pytest

from mjx_nero.deploy import guard, places, setup
from mjx_nero.deploy.drivers.sim import SimArm
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.executor import Lag
from mjx_nero.deploy.guard import Dry, Guard
from mjx_nero.deploy.log import Log
from mjx_nero.deploy.loop import Brain, go_home, run
from mjx_nero.deploy.observe import Observer
from mjx_nero.deploy.safety import Fault, SafetyCfg
from mjx_nero.identify import log as logs


class Sees(places.Known):
    """Places that the simulator has."""

    def __init__(self, plant):
        super().__init__()
        self._plant = plant

    def find(self, name, now):
        return places.Place(self._plant.place(name), self._plant.data.qpos[self._plant.objects[name] :][3:7])


class World:
    """The simulated arm with its cube, behind the safety layer, in time that passes where somebody waits."""

    def __init__(self, lift, start=None):
        self.clock, self.brain = arms.Clock(), Brain(lift / "policy.onnx")
        told = self.told = self.brain.metadata
        joints, home = tuple(told["joints"]["names"]), np.array(told["joints"]["home"])
        self.plant = Plant(lift / "scene.mjb", joints, home if start is None else start, self.clock)
        self.plant.reset(home if start is None else start, {"cube": np.array([0.2, 0.05, 0.015])})
        self.arm = SimArm(self.plant, joints, Lag.of(told).lead, self.clock)
        self.guard = Guard(self.arm, setup.safety_of(told), self.clock)

    def observer(self, goal=(0.2, 0.0, 0.25), source=None):
        return Observer(self.told, setup.body_of(self.told), list(goal), source or Sees(self.plant))

    def run(self, seconds=5.0, stop=lambda: None, **kinds):
        self.guard.start()
        return run(self.guard, self.brain, self.observer(**kinds), self.clock, seconds, stop)


def test_the_cube_is_lifted_to_the_goal(lift):
    world = World(lift)
    report = world.run()
    assert report.fault == Fault("stop", "5 s are over")
    assert np.linalg.norm(world.plant.place("cube") - [0.2, 0, 0.25]) < 0.02
    assert (len(report.timing.jitter), report.timing.missed) == (250, [])


def test_unlimited_targets_are_the_executors(lift):
    """Where no limit acts, the drives are told what the chain of actions says: the safety layer and the lag are not seen."""
    world, told = World(lift), []
    world.guard.start()
    command = world.arm.command
    world.arm.command = lambda *args: told.append(command(*args)) or told[-1]
    observer, brain = world.observer(), world.brain
    brain.begin(observer, world.guard.read())
    free = 0
    for _ in range(100):
        world.clock.time += 0.02
        target = brain(world.guard.read(), world.clock.now())
        sent = world.guard.command(target)
        brain.sent(sent.position)
        if not sent.limited:
            free += 1
            np.testing.assert_allclose(told[-1], brain._executor.last, atol=2e-6)
    assert free > 50


def test_somebody_stops_it(lift):
    world, asked = World(lift), iter([None] * 30 + [Fault("stop", "a key")])
    report = world.run(stop=lambda: next(asked))
    assert report.fault.text == "a key" and len(report.timing.jitter) == 30
    world.guard.close()
    assert world.guard.safety.at_rest


def test_an_object_that_is_lost_is_a_fault(lift):
    source = places.Known(fresh=0.5)
    world = World(lift)
    source.say(b'{"position": [0.2, 0.05, 0.015]}', world.clock.now())
    report = world.run(source=source)
    assert report.fault.kind == "object" and "the cube was last seen" in report.fault.text
    assert 25 <= len(report.timing.jitter) <= 27  # half a second


def test_late_cycles_are_reported_and_end_it(lift):
    world = World(lift)
    act, late = world.brain.act, {10: 0.03, 20: 0.05, **dict.fromkeys(range(40, 60), 0.021)}
    count = iter(range(1000))

    def slow(*seen):
        world.clock.time += late.get(next(count), 0.0)
        return act(*seen)

    world.brain.act = slow
    report = world.run()
    assert report.fault.kind == "deadline" and "5 cycles in a row" in report.fault.text
    assert [round(over, 3) for _, over in report.timing.missed[:2]] == [0.01, 0.03]


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_a_policy_that_is_not_finite_holds(lift, broken):
    world = World(lift)
    act, count = world.brain.act, iter(range(1000))
    world.brain.act = lambda *seen: act(*seen) * (broken if next(count) == 50 else 1.0)
    report = world.run()
    assert report.fault.kind == "nan" and len(report.timing.jitter) == 51


def test_a_stalled_joint_holds(lift):
    world = World(lift)
    step = world.plant.advance

    def advance():
        if world.clock.now() > 100.4:
            world.plant.faults.stalled = frozenset(range(3))
        step()

    world.plant.advance = advance
    report = world.run()
    assert report.fault.kind in ("stall", "load")


def test_the_log_is_what_identify_reads(lift, tmp_path):
    world = World(lift)
    joints = world.arm.joints
    world.guard.start()
    world.guard.log = Log(tmp_path / "log.csv", joints, world.guard.safety.position, world.clock.now(), 6, ["a note"])
    world.run(12.0)
    world.guard.close()
    log = logs.read(tmp_path / "log.csv", joints[:5])
    assert len(log.times) >= 595 and log.times[-1] > 11.9
    np.testing.assert_allclose(np.diff(log.sent)[5:500], 0.02, atol=1e-4)
    head = (tmp_path / "log.csv").read_text().splitlines()[1].split(",")
    rows = [dict(zip(head, line.split(","), strict=True)) for line in (tmp_path / "log.csv").read_text().splitlines()[2:]]
    sent = [row for row in rows if row["action.0"]]
    assert len(sent) == 600 and all(row["inferring"] and row["inferred"] and row["position.gripper"] == "" for row in sent)
    assert rows[-1]["held"] == "stop"


def test_home_is_reached_slowly(lift):
    far = np.array([0.9, -0.7, 0.3, 1.2, 0.5, 0.4])
    world = World(lift, far)
    feedback = world.guard.start(anywhere=True)
    np.testing.assert_allclose(feedback.position, far, atol=0.05)
    path = []
    command = world.guard.command
    world.guard.command = lambda *args: path.append(command(*args)) or path[-1]
    assert go_home(world.guard, world.guard.safety.limits, world.clock, lambda: None) is None
    np.testing.assert_allclose(path[-1].position, world.guard.safety.limits.home, atol=1e-3)
    assert max(np.abs(c.velocity / world.guard.safety.limits.speed).max() for c in path) < 0.21
    world.guard.command = command
    assert world.run(1.0).fault.text == "1 s are over"


def test_a_dry_run_tells_the_arm_nothing(lift):
    world, said = World(lift), []
    sent = []
    world.arm.command = lambda *args: sent.append(args)
    world.guard = Guard(Dry(world.arm, said.append), setup.safety_of(world.told, SafetyCfg()), world.clock)
    before = world.plant.data.ctrl.copy()
    report = world.run(2.0)
    world.guard.close()
    assert report.fault.text == "2 s are over" and not sent and len(said) >= 100
    assert (world.plant.data.ctrl == before).all()
    assert said[0] != said[-1] and said[0].startswith("shoulder_pan ")


def test_the_hurry_ends_with_the_run():
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with guard.urgent():
        hurries = os.sched_getscheduler(0) == os.SCHED_RR
    assert (os.sched_getscheduler(0), os.sched_getparam(0)) == before
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))  # this system lets it
        os.sched_setscheduler(0, *before)
        assert hurries
