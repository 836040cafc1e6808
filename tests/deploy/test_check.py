"""The walk through an arm's joints: arms that are wired wrongly, off their zero, and late; and the file that it writes."""

import dataclasses

import arms
import numpy as np
import pytest
import yaml

from mjx_nero.deploy import check, identified, setup
from mjx_nero.deploy.emulators.plant import Faults, Plant
from mjx_nero.deploy.guard import Guard
from mjx_nero.envs import identified as in_training
from mjx_nero.errors import UserError
from mjx_nero.tasks import registry


@pytest.fixture(scope="module")
def told():
    return arms.metadata("so_arm101")


class Wired(arms.Ideal):
    """An arm whose commands and readings are bent; what it is told is in force some cycles later."""

    def __init__(self, told, clock, late=0):
        super().__init__(tuple(told["joints"]["names"]), told["joints"]["home"], clock)
        self.order, self.sign, self.scale = np.arange(len(self.at)), np.ones(len(self.at)), np.ones(len(self.at))
        self.sag, self._home, self._queue = np.zeros(len(self.at)), self.at.copy(), [self.at.copy()] * late

    def read(self):
        seen = super().read()
        moved = (seen.position - self._home)[self.order] * self.sign * self.scale
        return dataclasses.replace(seen, position=self._home + moved + self.sag)

    def command(self, position, velocity):
        self._queue.append(position.copy())
        self.at = self._queue.pop(0)
        return position


def walked(told, bend=lambda arm: None, late=0, ask=lambda question: None):
    clock = arms.Clock()
    arm, safety = Wired(told, clock, late), setup.safety_of(told)
    bend(arm)
    guard = Guard(arm, safety, clock)
    guard.start()
    said = []
    found, fault = check.walk(guard, safety.limits, setup.body_of(told), clock, lambda: None, ask, said.append)
    assert fault is None, fault
    return found, said


def wrong(found, name):
    return next(joint for joint in found if joint.name == name).wrong(name == "gripper")


def test_an_arm_that_is_right_is_a_go(told):
    found, said = walked(told)
    assert [joint.name for joint in found] == told["joints"]["names"]
    for joint in found:
        assert joint.wrong(False) == [] and joint.follows == joint.name
        assert joint.scale == pytest.approx(1.0, abs=0.02) and abs(joint.offset) < 1e-6 and joint.delay <= 0.021
    assert said[0] == "shoulder_pan moves by +0.10: the hand goes 20 mm to -y, its right"
    assert "wrist_roll moves by +0.10: the hand turns by 6 degrees on the spot" in said


def test_exchanged_joints_are_seen(told):
    def bend(arm):
        arm.order[[1, 2]] = 2, 1

    found, _ = walked(told, bend)
    assert wrong(found, "shoulder_lift") == ["the reading of elbow_flex moved instead: the order of the joints is wrong"]
    assert wrong(found, "shoulder_pan") == []


def test_signs_scales_and_dead_readings_are_seen(told):
    def bend(arm):
        arm.sign[3], arm.scale[0], arm.scale[4] = -1, 0.8, 0.0

    found, _ = walked(told, bend)
    assert "moved the other way: its sign is wrong" in wrong(found, "wrist_flex")[0]
    assert "its reading moved 0.80 times as far" in wrong(found, "shoulder_pan")[0]
    assert "its reading hardly moved" in wrong(found, "wrist_roll")[0] or "order" in wrong(found, "wrist_roll")[0]


@pytest.mark.parametrize("late", [1, 3])
def test_the_delay_is_measured(told, late):
    found, _ = walked(told, late=late)
    assert np.median([joint.delay for joint in found]) == pytest.approx(0.02 * late, abs=0.011)


def test_the_delay_of_late_drives_is_measured(lift, told):
    """MuJoCo's arm, whose targets come into force 60 ms late: the drives add some 10 ms of their own."""
    from mjx_nero.deploy.drivers.sim import SimArm

    clock, home = arms.Clock(), np.array(told["joints"]["home"])
    plant = Plant(lift / "scene.mjb", told["joints"]["names"], home, clock)
    plant.faults = Faults(late=0.06)
    safety = setup.safety_of(told)
    guard = Guard(SimArm(plant, tuple(told["joints"]["names"]), np.zeros(6), clock), safety, clock)
    guard.start()
    made = check.move(guard, 0, 0.1, safety.limits, clock, lambda: None)
    assert 0.055 < check.delay_of(made, 0) < 0.08


def test_what_a_person_saw_counts(told):
    found, _ = walked(told, ask=lambda question: "elbow" not in question)
    assert "you did not see it move as announced" in wrong(found, "elbow_flex")[0] and wrong(found, "shoulder_pan") == []


def test_somebody_stops_the_walk(told):
    clock = arms.Clock()
    arm, safety = Wired(told, clock), setup.safety_of(told)
    guard = Guard(arm, safety, clock)
    guard.start()
    ends = iter([None] * 40)
    fault = check.Fault("stop", "a key")
    found, why = check.walk(guard, safety.limits, setup.body_of(told), clock, lambda: next(ends, fault), lambda q: None, str)
    assert why == fault and len(found) < 6


def test_the_file_is_what_deploy_and_training_take(told, tmp_path):
    found, _ = walked(told, late=2)
    found[1] = dataclasses.replace(found[1], offset=0.012)
    path = tmp_path / "found.yaml"
    path.write_text(check.yaml_of("so_arm101", found, told["joints"]["names"][:5]))
    delay, offsets = identified.read(path, told)
    assert delay == pytest.approx(0.04, abs=0.011) and offsets == [0.0, 0.012, 0.0, 0.0, 0.0, 0.0]
    cfg = in_training.applied(dataclasses.replace(registry.env_cfg("so101_lift"), identified=str(path)))
    assert cfg.actions["delay"].params["steps"][1] >= 2 and "identified" not in cfg.randomization
    assert set(yaml.safe_load(path.read_text())["joints"]) == set(told["joints"]["names"][:5])


def test_offsets_are_subtracted(told):
    clock = arms.Clock()
    ideal = arms.Ideal(tuple(told["joints"]["names"]), told["joints"]["home"], clock)
    offset = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
    arm = identified.Offset(ideal, offset)
    np.testing.assert_allclose(arm.read().position, ideal.at - offset)
    home = ideal.at.copy()
    np.testing.assert_allclose(arm.command(home, home), home)
    np.testing.assert_allclose(ideal.told[-1], home + offset)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "is not a file of identify or deploy --check"),
        ("robot: so_arm101\ndelay: {value: 0}\njoints: 3\n", "is not a file of identify or deploy --check"),
        ("robot: nero\ndelay: {value: 0.01}\njoints: {}\n", "is for nero with joints"),
        ("robot: so_arm101\ndelay: {value: 0.01}\njoints: {elbow: {offset: {value: 0}}}\n", "is for so_arm101 with joints elbow"),
        ("robot: so_arm101\ndelay: {value: 3}\njoints: {}\n", "the delay must be 0 to 1 s"),
        ("robot: so_arm101\ndelay: {value: .nan}\njoints: {}\n", "is not a file of identify"),
    ],
)
def test_files_of_others_are_one_line(told, tmp_path, text, message):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=message):
        identified.read(path, told)
