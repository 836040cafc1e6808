"""SO-ARMs over an emulated bus: packets byte for byte, calibration, faults of the bus, and that nothing ever drops the arm."""

import contextlib
import json
import time

import arms
import mujoco
import numpy as np
import pytest

from mjx_nero.deploy import drivers, setup
from mjx_nero.deploy.arm import ArmError
from mjx_nero.deploy.drivers import feetech, so_arm
from mjx_nero.deploy.emulators import feetech as emulated
from mjx_nero.deploy.emulators import timeless
from mjx_nero.deploy.emulators.line import Line
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.guard import Guard
from mjx_nero.deploy.safety import Safety
from mjx_nero.errors import UserError


def test_packets_are_the_makers():
    """Examples of the protocol: a ping, a read of two bytes at 56, and a goal written to two servos at once."""
    assert feetech.packet(1, feetech.PING) == bytes.fromhex("ffff010201fb")
    assert feetech.packet(1, feetech.READ, bytes([56, 2])) == bytes.fromhex("ffff0104023802be")
    goals = bytes([42, 2, 1, 0x00, 0x08, 2, 0xFF, 0x07])
    assert feetech.packet(0xFE, feetech.SYNC_WRITE, goals) == bytes.fromhex("fffffe0a832a020100 0802ff0737".replace(" ", ""))


@pytest.mark.parametrize(
    ("name", "value", "data"),
    [
        ("position", 2048, "0008"),
        ("position", -5, "0580"),
        ("velocity", -300, "2c81"),
        ("load", -500, "f405"),
        ("homing_offset", -1000, "e80b"),
        ("goal_position", 4095, "ff0f"),
        ("temperature", 40, "28"),
    ],
)
def test_signs_stand_where_the_tables_have_them(name, value, data):
    assert feetech.encode(name, value) == bytes.fromhex(data)
    assert feetech.decode(name, bytes.fromhex(data)) == value


@pytest.mark.parametrize(
    ("name", "value"), [("temperature", 256), ("load", 1024), ("goal_position", -40000), ("acceleration", -1)]
)
def test_what_does_not_fit_is_refused(name, value):
    with pytest.raises(ValueError):
        feetech.encode(name, value)


@pytest.mark.parametrize("name", [name for name in feetech.REGISTERS if name not in feetech.WRITABLE])
def test_nothing_else_can_be_written(name):
    with pytest.raises(ValueError, match="must not be written"):
        feetech.Bus(None).write(1, name, 0)
    with pytest.raises(ValueError, match="must not be written"):
        feetech.Bus(None).write_all(name, {1: 0})


def test_what_is_written_is_ram():
    assert all(40 <= feetech.REGISTERS[name][0] < 80 for name in feetech.WRITABLE)


class Bench(arms.Bench):
    """An emulated arm, its driver, and who answers at the port meanwhile, at once and however long that takes."""

    def __init__(self, folder, told, lift, kind="so101"):
        entries = emulated.calibration(told, kind)
        self.calibration = folder / "calibration.json"
        self.calibration.write_text(json.dumps(entries))
        clock = arms.Clock()
        joints = told["joints"]["names"]
        self.plant = Plant(lift / "scene.mjb", joints, np.array(told["joints"]["home"]), clock)
        self.servos = emulated.servos_of(told, kind, entries, self.plant)
        self.servos.faults.turnaround = 0.0
        self.port = emulated.Port(self.servos, Line(terminal=True))
        self.arm = so_arm.of(kind, told, clock, self.port.name, str(self.calibration))
        self.guard = Guard(self.arm, setup.safety_of(told), clock)
        self.told, self.clock, self.asked, self._heard = told, clock, 0, 0
        self._answer, self.servos.answer = self.servos.answer, self._hear
        clock.ticks = [self._wait]
        self.serve()

    def _hear(self, request):
        answer = self._answer(request)
        self._heard += 1
        return answer

    def _wait(self):
        """Time passes when all that was sent has arrived."""
        end = time.monotonic() + 2.0
        while self._heard < self.asked and time.monotonic() < end:
            time.sleep(1e-4)

    def close(self):
        self.stop()
        with contextlib.suppress(AttributeError):
            self.arm._bus.close()
        self.port.close()


@pytest.fixture
def bench(tmp_path, told, lift, monkeypatch):
    monkeypatch.setattr(so_arm, "_WAIT", 0.5)  # whoever answers may have to wait for a processor
    made, send = Bench(tmp_path, told, lift), feetech.Bus._send

    def counted(bus, request):
        send(bus, request)
        made.asked += 1

    monkeypatch.setattr(feetech.Bus, "_send", counted)
    yield made
    assert made.servos.eeprom_writes == 0 and made.servos.torque_cuts == 0
    made.close()


def test_the_arm_goes_where_it_is_told(bench):
    feedback = bench.start()
    home = np.array(bench.told["joints"]["home"])
    np.testing.assert_allclose(feedback.position, home, atol=4e-3)
    assert bench.plant.powered.all()
    goal = home + np.array([0.4, -0.3, 0.2, -0.2, 0.3, 0.4])
    bench.play([home + (goal - home) * min(1, k / 30) for k in range(60)])
    feedback = bench.guard.read()
    assert bench.guard.fault is None
    np.testing.assert_allclose(feedback.position, bench.plant.position(), atol=4e-3)
    np.testing.assert_allclose(feedback.position, goal, atol=2e-2)
    assert feedback.temperature.tolist() == [35.0] * 6 and np.abs(feedback.load).max() <= 1


def test_speeds_and_loads_are_read(bench):
    bench.start()
    home = np.array(bench.told["joints"]["home"])
    fastest = 0.0
    for k in range(30):
        due = bench.clock.now() + 0.02
        feedback = bench.guard.read()
        np.testing.assert_allclose(feedback.velocity[:5], bench.plant.velocity()[:5], atol=2e-3)  # a count a second, and more
        np.testing.assert_allclose(feedback.load, np.clip(bench.plant.load(), -1, 1), atol=1e-3)
        fastest = max(fastest, feedback.velocity[0])
        bench.guard.command(home + np.array([0.02 * k, 0, 0, 0, 0, 0]))
        bench.clock.sleep_until(due)
    assert fastest > 0.5


def test_torque_comes_only_when_the_goal_is_where_the_servo_is(bench):
    seen = []
    write = bench.servos._write

    def watch(servo, at, data):
        write(servo, at, data)
        if at == 40:
            seen.append((bench.servos._get(servo, "goal_position"), bench.servos._get(servo, "position")))

    bench.servos._write = watch
    bench.start()
    assert len(seen) == 6 and all(goal == position for goal, position in seen)
    assert bench.servos._get(6, "torque_limit") == 500 and bench.servos._get(1, "torque_limit") == 1000


def test_closing_leaves_torque_on(bench):
    bench.start()
    bench.guard.close()
    assert bench.plant.powered.all()


@pytest.mark.parametrize("fault", ["cut", "corrupt", "overload", "overheating", "unplugged"])
def test_faults_of_the_bus_end_in_hold_within_a_cycle(bench, fault):
    bench.start()
    home = np.array(bench.told["joints"]["home"])
    bench.play([home + np.array([0.01 * k, 0, 0, 0, 0, 0]) for k in range(15)])
    assert bench.guard.fault is None
    bench.arm._bus._port.timeout = 0.02
    if fault == "unplugged":
        bench.arm._bus._port.close()
    else:
        wrong = {
            "cut": {"cut": True},
            "corrupt": {"corrupt": 1.0},
            "overload": {"errors": {3: 32}},
            "overheating": {"errors": {3: 4}},
        }
        bench.servos.faults = emulated.BusFaults(turnaround=1e-4, **wrong[fault])
    bench.play([home + 0.5])
    assert bench.guard.fault.kind == "bus"
    bench.servos.faults = emulated.BusFaults(turnaround=1e-4)
    bench.play([home + 0.5] * 20)  # nothing resumes
    assert np.abs(bench.guard.safety.position - home).max() < 0.3


@pytest.mark.parametrize("fault", [{"cut": True}, {"corrupt": 1.0}, {"errors": {3: 32}}, {"errors": {1: 4}}])
def test_a_hundred_faults_of_the_bus_end_in_hold_within_a_cycle(told, lift, fault):
    """At once, in registers and packets; a damaged answer is asked for twice."""
    rng, clock, home = np.random.default_rng(1), arms.Clock(), np.array(told["joints"]["home"])
    layer, model = setup.safety_of(told), mujoco.MjModel.from_binary_path(str(lift / "scene.mjb"))
    for _ in range(100):
        plant = Plant(model, told["joints"]["names"], home, clock)
        arm, _ = timeless.engaged("so101", told, plant, clock)
        servos = arm._bus._port._servos
        guard = Guard(arm, Safety(layer.limits, layer._fence, layer.cfg), clock)
        guard.start()
        goal = rng.uniform(layer.limits.lower, layer.limits.upper)
        for k in range(count := int(rng.integers(2, 12))):
            if k == count - 1:
                assert guard.fault is None
                servos.faults = emulated.BusFaults(**fault)
            guard.read()
            guard.command(goal)
            clock.sleep_until(clock.now() + 0.02)
        assert guard.fault.kind == "bus"
        servos.faults, at = emulated.BusFaults(), guard.safety.position
        for _ in range(8):  # all is well again, and nothing resumes
            guard.command(goal)
        assert np.abs(guard.safety.position - at).max() < 0.06 and guard.safety.at_rest
        assert servos.eeprom_writes == servos.torque_cuts == 0 and plant.powered.all()


def test_hot_servos_end_in_hold(bench):
    bench.start()
    bench.servos.faults.heat = 61
    bench.play([bench.guard.safety.position])
    assert bench.guard.fault.kind == "temperature"


def test_frozen_registers_end_in_hold(bench):
    """A servo board that repeats its last answer looks like a joint that does not follow."""
    bench.start()
    home = np.array(bench.told["joints"]["home"])
    bench.servos.faults.frozen = True
    bench.play([home + np.array([0.02 * k, 0, 0, 0, 0, 0]) for k in range(60)])
    assert bench.guard.fault.kind == "stall"
    assert np.abs(bench.guard.safety.position - home).max() < 0.6


def test_one_damaged_answer_is_asked_for_again(bench):
    bench.start()
    bench.arm._bus = feetech.Bus(timeless.Wire(bench.servos))  # answers at once, or never: no machine is too slow for it
    reply, count = bench.servos._reply, iter(range(100))

    def once(servo, data=b""):
        out = reply(servo, data)
        return out[:-1] + bytes([out[-1] ^ 1]) if next(count) == 2 else out

    bench.servos._reply = once
    bench.play([bench.guard.safety.position] * 3)
    assert bench.guard.fault is None


def test_a_late_answer_is_not_taken_for_the_next_one(bench):
    """An answer that comes after its time was over belongs to nobody."""
    bench.start()
    bench.arm._bus._port.timeout = 0.15
    bench.servos.faults.turnaround = 0.2  # of one servo
    with pytest.raises(ArmError, match="servo 1 does not answer"):
        bench.arm._bus.read(1, "homing_offset")
    bench.servos.faults.turnaround, bench.arm._bus._port.timeout = 0.0, 0.5
    assert bench.arm._bus.read(1, "max_position") == bench.arm._servos[0].range_max


@pytest.mark.parametrize(
    ("register", "value", "message"),
    [
        ("homing_offset", 17, "servo 3 has homing_offset 17, but the calibration file has -26: the file is for another arm"),
        ("max_position", 4000, "servo 3 has max_position 4000"),
        ("mode", 1, "servo 3 has mode 1"),
        ("model", 1284, "servo 3 is a model 1284, not an STS3215"),
    ],
)
def test_another_arm_than_the_files_is_refused(bench, register, value, message):
    bench.servos._put(3, register, value)
    with pytest.raises(UserError, match=message):
        bench.start()


def test_an_arm_without_power_is_refused(bench, monkeypatch):
    monkeypatch.setattr(so_arm, "_WAIT", 0.02)
    bench.servos.faults.cut = True
    with pytest.raises(UserError, match="shoulder_pan: servo 1 does not answer: is the arm powered"):
        bench.start()


def test_other_gains_are_told(bench):
    bench.servos._put(2, "p", 32)
    bench.start()
    assert bench.arm.notes == ["shoulder_lift has P 32, LeRobot's followers 16"]


def test_the_calibrated_range_narrows_the_limits(told):
    narrow = np.array(told["joints"]["lower"]) + 0.1
    limits = setup.safety_of(told, ranges=(narrow, np.array(told["joints"]["upper"]))).limits
    np.testing.assert_allclose(limits.lower[:5], narrow[:5])
    with pytest.raises(UserError, match=r"home of shoulder_pan is 0\.00, but the arm's own range is 0\.20 to"):
        setup.safety_of(told, ranges=(np.full(6, 0.2), np.array(told["joints"]["upper"])))


def test_degrees_are_lerobots(told):
    """90 degrees from the middle are 4095 / 4 counts, and a gripper's 0 and 100 the ends of its range."""
    entries = {name: so_arm.Servo(i + 1, 0, 500, 3500) for i, name in enumerate(told["joints"]["names"])}
    arm = so_arm.SoArm("so101", told, entries, "", arms.Clock())
    raw = arm._raw(np.array([np.pi / 2, 0, 0, 0, 0, told["joints"]["upper"][5]]))
    assert raw.tolist() == [round(2000 + 4095 / 4), 2000, 2000, 2000, 2000, 3500]
    assert arm._raw(np.array(told["joints"]["lower"]))[5] == 500
    assert arm._raw(np.full(6, 1e9)).tolist() == [3500] * 6  # never beyond the calibrated range
    so100 = so_arm.SoArm("so100", told, entries, "", arms.Clock())
    middle = (np.array(told["joints"]["lower"]) + told["joints"]["upper"]) / 2
    assert np.abs(so100._raw(middle) - 2000).max() <= 1


BAD = [
    ("", "c.json is not JSON"),
    ("[]", "not a calibration file of LeRobot|has no joint"),
    ("{}", "has no joint shoulder_pan"),
    ('{"id": 1', "c.json is not JSON"),
]


@pytest.mark.parametrize(("text", "message"), BAD)
def test_files_that_are_no_calibration(tmp_path, told, text, message):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(UserError, match=message):
        so_arm.read_calibration(tmp_path / "c.json", tuple(told["joints"]["names"]))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("id", 1, "two joints have the same id"),
        ("id", True, "not a calibration file of LeRobot"),
        ("range_max", 5000, "elbow_flex has no range within 0 to 4095"),
        ("range_min", 4000, "elbow_flex has no range within 0 to 4095"),
        ("drive_mode", 1, "elbow_flex has a drive_mode other than 0"),
        ("homing_offset", "x", "not a calibration file of LeRobot"),
    ],
)
def test_calibrations_that_are_wrong(tmp_path, told, field, value, message):
    entries = emulated.calibration(told, "so101")
    entries["elbow_flex"][field] = value
    (tmp_path / "c.json").write_text(json.dumps(entries))
    with pytest.raises(UserError, match=message):
        so_arm.read_calibration(tmp_path / "c.json", tuple(told["joints"]["names"]))


def test_another_robots_policy_is_refused(told):
    with pytest.raises(UserError, match="--arm so100 is a so_arm100, not a so_arm101"):
        drivers.make("so100", {"port": "/dev/null", "calibration": "c.json"}, told, arms.Clock())


def test_rubbish_on_the_line_is_survived(bench):
    """Bytes of any kind into the emulated servos, and out of them into the driver."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        bench.port._take(rng.integers(0, 256, rng.integers(0, 40)).astype(np.uint8).tobytes())

    class Noise:
        def reset_input_buffer(self):
            pass

        def write(self, data):
            pass

        def read(self, count):
            return rng.integers(0, 256, rng.integers(0, count + 1)).astype(np.uint8).tobytes()

    bus = feetech.Bus(Noise())
    for _ in range(300):
        with pytest.raises(ArmError):
            bus.read_all([1, 2], *feetech.STATE)
    bench.servos.eeprom_writes = bench.servos.torque_cuts = 0  # what rubbish wrote is not the driver's
